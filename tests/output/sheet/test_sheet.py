"""The measuring sheet: setups and rows, joints to command, the place of the gauge, and pictures.

Numbers are compared with Pinocchio's loop closures and placements.
"""

from __future__ import annotations

import re
import shutil
from contextlib import contextmanager
from dataclasses import replace
from itertools import combinations, permutations, product

import numpy as np
import pytest
from browser import open_browser, visit
from calibrated import plan_of
from commands import run_orthocal
from conftest import marked_pictures
from gauges import with_gauges
from lxml import etree
from machines import place
from matplotlib.path import Path
from scipy.spatial import ConvexHull

from orthocal import load_plan, write_session
from orthocal.builder.build import make_robot
from orthocal.builder.machine_file import Counting
from orthocal.builder.orthoglide import Orthoglide
from orthocal.effects.compensation import JointTrim
from orthocal.output.sheet.page import sheet_files
from orthocal.output.sheet.pictures import TOUCHED, Picture, outline
from orthocal.session.session import Conditions
from orthocal.units import MM

ROUNDED = 1e-3
"""Joints are shown with three decimals, [mm]."""

ROUNDED_PLACE = 0.06
"""Places are shown with one decimal, [mm]."""

SMALL = Orthoglide(leg=0.25, travel=(0.1, 0.32), attachment=0.03, rods_apart=0.06, rod_radius=0.004)
COUNTING = (Counting(True, 0.0), Counting(False, 0.005), Counting(False, None))

PLAN = """robot: mine
title: '<script>alert("1")</script> & more'
gauge: {range_mm: [-5, 5], resolution_mm: 0.01}
postures:
  zero: {tcp_mm: [0, 0, 0]}
  <out>: {tcp_mm: [40, -15, 4]}
  in&: {joints_mm: [200, 245, 240]}
setups:
  <b>yx: {leg: x, touches: a, tip: {ball: {radius_mm: 1.5}}, direction: y, section: {fraction: 0.5}}
  xy: {leg: y, touches: b, tip: {blade: {width_mm: 20}}, direction: -x, section: {fraction: 0.4},
       postures: [in&, <out>]}
  zx: {leg: x, direction: z, section: {fraction: 0.5}}
  oblique: {leg: z, touches: b, tip: {blade: {width_mm: 60, radius_mm: 2}}, direction: [1, 1, 0],
            section: {fraction: 0.45}}
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sheet")
    make_robot(SMALL, folder / "mine", counting=COUNTING)
    (folder / "plan.yaml").write_text(PLAN)
    return load_plan(folder / "plan.yaml")


@pytest.fixture(scope="module")
def files(small):
    return sheet_files(small)


def page_of(plan):
    """The sheet of a plan, parsed."""
    return etree.HTML(sheet_files(plan)["sheet.html"])


@pytest.fixture(scope="module")
def page(files):
    return etree.HTML(files["sheet.html"])


def words(element):
    return " ".join("".join(element.itertext()).replace("−", "-").split())


def sections(page):
    return page.xpath("//section[starts-with(@id, 'setup-')]")


def rows(section):
    """Cells of the rows of a setup."""
    lines = section.xpath(".//table[@class='boxes']/tbody/tr")
    return [[words(cell) for cell in line] for line in lines]


def test_sheet_has_every_setup_and_row(small, page):
    found = sections(page)
    names = list(small.setups)
    assert [words(s.find("h2")) for s in found] == [
        f"Setup {i} of 4: {name}" for i, name in enumerate(names, 1)
    ]
    readings = list(small.readings)
    for section, name in zip(found, names, strict=True):
        expected = [(str(i + 2), r.posture) for i, r in enumerate(readings) if r.setup == name]
        cells = rows(section)
        assert [(r[0], r[1]) for r in cells[:-1]] == expected
        # a box for the return to the first posture
        assert cells[-1][:2] == ["", f"{expected[0][1]}, again"]
        assert len(section.xpath(".//td[@class='box']")) == len(cells)


def test_joints_move_the_tool_to_the_stated_point(small, page):
    robot = small.robot
    for section in sections(page):
        for row in rows(section):
            tool = [float(v) for v in row[2].split(",")]
            joints = [float(v) * MM for v in row[3:6]]
            drives = [d.from_joint(v) for d, v in zip(robot.drives, joints, strict=True)]
            at = place(robot, drives, robot.tcp.frame) / MM
            assert at == pytest.approx(tool, abs=2.0 * ROUNDED)


def test_stated_contact_is_on_the_rod(small, page):
    """Surface of rod a in the mechanical zero: half the rods' distance up, a radius towards y."""
    text = words(sections(page)[0])
    robot, drives = small.robot, small.robot.drive_zero
    root, tip = (place(robot, drives, f) for f in ("x_bar_a", "x_coupler"))
    expected = 0.5 * (root + tip) + np.array([0.0, 0.004, 0.0])
    found = re.search(r"contact point is at X([-\d.]+) Y([-\d.]+) Z([-\d.]+) mm", text)
    assert [float(v) for v in found.groups()] == pytest.approx(expected / MM, abs=ROUNDED_PLACE)
    assert "on the +y side of rod a of leg x. Point its plunger to -y." in text
    assert "leg x, gauge in y, at 0.5 of its length from the slide at the mechanical zero" in text
    hinge = "ball of 3 mm diameter touches the rod on its centre line, 125.0 mm from the hinge"
    assert f"{hinge} on the slide. Then" in text


def test_the_contact_is_stated_from_the_tool_where_the_gauge_is_mounted(small):
    """On the centre line of leg x, which is 125 mm from the slide in the mechanical zero."""
    setups = {**small.setups, "zx": replace(small.setups["zx"], aligned_at="<out>")}
    found = sections(page_of(replace(small, setups=setups)))
    text = next(words(s) for s in found if words(s.find("h2")).endswith(": zx"))
    drives = small.postures["<out>"].drives
    root, tip, tool = (
        place(small.robot, drives, frame) for frame in ("x_leg_root", "x_leg_tip", "tcp")
    )
    at_zero = place(small.robot, small.robot.drive_zero, "x_leg_root")
    share = (root[0] - (at_zero[0] - 0.125)) / (root[0] - tip[0])
    expected = root + share * (tip - root) - tool
    found = re.search(r"contact point is at X([-\d.]+) Y([-\d.]+) Z([-\d.]+) mm", text)
    assert [float(v) for v in found.groups()] == pytest.approx(expected / MM, abs=ROUNDED_PLACE)
    assert "from the tool centre point in this posture" in text
    assert np.linalg.norm(tool) > 0.01


def test_lateral_offset_in_the_alignment_posture_is_stated(small):
    """Distance of a tip that is centred in the mechanical zero from Pinocchio's rod and hinge."""
    readings = [r for r in small.readings if r.setup == "<b>yx" and r.posture == "<out>"]
    session = replace(small, readings=tuple(readings))
    text = words(sections(page_of(session))[0])
    robot = small.robot
    drives = small.postures["<out>"].drives
    root, tip = (place(robot, drives, f) for f in ("x_bar_a", "x_coupler"))
    at_zero = place(robot, robot.drive_zero, "x_bar_a")
    share = (root[0] - (at_zero[0] - 0.125)) / (root[0] - tip[0])
    axis = root + share * (tip - root)
    across = np.cross(tip - root, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    # the plunger's line, through the rod as it was in the zero, from the rod's axis now
    aside = float((np.array([at_zero[0] - 0.125, 0.0, at_zero[2]]) - axis) @ across) / MM
    found = re.search(r"with its centre (\d+\.\d) mm off the centre line, towards", text)
    assert float(found[1]) == pytest.approx(abs(aside), abs=ROUNDED_PLACE)
    assert abs(aside) > 1.0
    at_zero = r"\(at the mechanical zero it would be 125\.0 mm\)"
    found = re.search(rf"([\d.]+) mm from the hinge on the slide {at_zero}", text)
    assert float(found[1]) == pytest.approx(np.linalg.norm(axis - root) / MM, abs=0.5)
    assert abs(float(found[1]) - 125.0) > 10.0


def test_alignment_posture_comes_before_the_first(small):
    """The operator aligns the gauge there, then moves on and sets the gauge zero."""
    setups = {**small.setups, "zx": replace(small.setups["zx"], aligned_at="in&")}
    (section,) = [
        s
        for s in sections(page_of(replace(small, setups=setups)))
        if words(s.find("h2")).endswith(": zx")
    ]
    steps = [words(li) for li in section.xpath(".//ol/li")]
    joints = next(row[3:6] for row in rows(section) if row[1] == "in&")
    assert steps[0].startswith(f"Move to the alignment posture, in&: x_slide {joints[0]} mm")
    assert steps[3].startswith("Move to the first posture, zero: x_slide 0.000 mm")
    assert "gauge zero" in steps[4]
    section = sections(page_of(small))[2]
    steps = [words(li) for li in section.xpath(".//ol/li")]
    assert steps[0].startswith("Move to the alignment posture, which is also the first posture")
    assert "gauge zero" in steps[3]


def test_each_setup_names_its_gauge_if_there_are_several(small, page):
    fine = replace(small.gauge, resolution=1e-6)
    gauge_of = {name: "fine" if i % 2 else "coarse" for i, name in enumerate(small.setups)}
    two = with_gauges(
        small,
        {"coarse": small.gauge, "fine": fine},
        [setup for setup, gauge in gauge_of.items() if gauge == "fine"],
    )
    files = sheet_files(two)
    html = etree.HTML(files["sheet.html"])
    programs = [text for name, text in sorted(files.items()) if name.endswith(".ngc")]
    table = html.xpath("//table")[0]
    column = [words(th) for th in table.xpath(".//th")].index("gauge")
    named = [words(row.xpath("./td")[column]) for row in table.xpath(".//tr[td]")]
    assert named == list(gauge_of.values())
    for gauge, section, program in zip(named, sections(html), programs, strict=True):
        step = "0.001" if gauge == "fine" else "0.01"
        assert f"Gauge: {gauge}, -5 … 5 mm, read to {step} mm." in words(section)
        assert f": mount gauge {gauge}, " in program
    assert "gauge" not in [words(th) for th in page.xpath("//table")[0].xpath(".//th")]
    assert not any("Gauge:" in words(section) for section in sections(page))


def test_steps_state_how_to_mount_and_align_the_gauge(page):
    ball, blade, line, pin = (words(s) for s in sections(page))
    for text in (ball, blade, line, pin):
        assert "The reading must grow. If it falls, enter every reading of this setup" in text
        assert "half of its travel, about 5 mm. Then turn the bezel until the dial shows 0." in text
    assert "blade 20 mm wide" in blade
    assert "on the -x side of rod b of leg y. Point its plunger to +x." in blade
    assert "assumes that it reads the line between the rods" in line
    assert "pin of 4 mm diameter, 60 mm wide" in pin
    # the leg moves sideways by more than the range of this dial
    assert "Even a perfect machine shows -32.7 mm in line 6" in blade
    hold = "Hold the plunger up on the way to line 5, line 6, in&: the dial would go -32.7 mm"
    assert hold in blade
    assert "Even a perfect" not in line
    assert "on the (0.71, 0.71, 0.00) side of rod b of leg z" in pin


def test_front_page_states_zero_travel_and_approach(page):
    text = words(page.find("body"))
    assert "must show about x_slide 0.000 mm, y_slide 5.000 mm, z_slide 250.000 mm" in text
    assert "x_slide -150.0 to 70.0 mm; y_slide -65.0 to 155.0 mm; z_slide 180.0 to 400.0 mm" in text
    assert "Its number must grow for x_slide, fall for y_slide, fall for z_slide" in text
    assert (
        "the number of x_slide grows, the number of y_slide falls, the number of z_slide falls"
    ) in text
    assert "After you have set the gauge zero, do not touch the bezel" in text
    assert "controller: {offsets_mm: [0, 0, 0]}" in text
    assert words(page.findall(".//code")[-1]) == "orthocal calibrate . --out DIRECTORY"
    assert "machine.yaml (orthocal new DIRECTORY --again)" in text
    assert "measures (section: at the mechanical zero)" in text
    assert "`" not in text


def test_front_page_states_what_the_controller_compensates(small):
    """What the session states; a question if it states nothing, only where backlash matters."""
    table = np.array([[0.0, 1e-5, -1e-5], [0.4, 2e-5, -2e-5]])
    trims = (JointTrim(table=table), JointTrim(0.05 * MM), JointTrim())

    def front(session):
        with marked_pictures():
            (page,) = (t for name, t in sheet_files(session).items() if name.endswith(".html"))
        return " ".join(words(etree.HTML(page)).split())

    stated = front(replace(small, compensation=trims))
    assert "controller compensates backlash" in stated
    assert "x_slide by a table, y_slide 0.050 mm (LinuxCNC" in stated
    assert "compensates" not in front(small)
    with_backlash = small.with_effects(["backlash"])
    assert "into session.yaml, 0 for none" in front(with_backlash)
    assert "backlash_mm: [0, 0, 0]" in front(with_backlash)
    without = replace(with_backlash, compensation=(JointTrim(),) * 3)
    assert "compensates no backlash, as session.yaml states" in front(without)


def test_sheet_after_a_calibration_has_shifted_travel_and_ends_with_validation(small):
    for active in ([0.0] * 3, [1e-3, 2e-3, 0.0]):
        session = small.with_controller(np.array(active))
        text = sheet_files(session)["sheet.html"].replace("−", "-")
        assert ("A smaller difference is normal" in text) == (not any(active))
        limits = (
            "-149.0 to 71.0 mm; y_slide -67.0 to 153.0 mm",
            "-150.0 to 70.0 mm; y_slide -65.0",
        )
        assert limits[not any(active)] in text
        following = "validate CALIBRATION ." if any(active) else "calibrate . --out DIRECTORY"
        assert f"<code>orthocal {following}</code>" in text


def test_names_from_files_are_texts(files, page):
    text = files["sheet.html"]
    assert page.xpath("//script") == []
    assert page.xpath("//b") == []
    assert '<script>alert("1")</script> & more' in words(page.find("body"))
    assert "://" not in text.replace('xmlns="http://www.w3.org/2000/svg"', "")
    assert "default-src 'none'" in text


def test_pictures_are_on_their_paper_and_labelled(page, files):
    """A picture of the machine and one of the rods for each setup."""
    drawn = re.findall(r"<svg.*?</svg>", files["sheet.html"])
    assert len(drawn) == 2 * 4
    for svg in drawn:
        root = etree.fromstring(svg.encode())
        _, _, width, height = (float(v) for v in root.get("viewBox").split())
        pairs = " ".join(e.get("points") for e in root.iter("{*}polygon", "{*}polyline"))
        points = np.array([[float(v) for v in p.split(",")] for p in pairs.split()])
        assert np.isfinite(points).all()
        assert (points >= 0.0).all()
        assert (points <= [width, height]).all()
    for section in sections(page):
        machine, cut = (words(svg) for svg in section.xpath(".//*[local-name()='svg']"))
        assert "dial grows" in machine
        assert "tool" in machine
        assert "rod a" in cut
        assert "rod b" in cut


def test_tip_near_a_hinge_causes_a_warning(small):
    sensor = small.setups["xy"].sensor
    near = replace(sensor, section=replace(sensor.section, value=0.99))
    setups = {**small.setups, "xy": replace(small.setups["xy"], sensor=near)}
    text = words(page_of(replace(small, setups=setups)).find("body"))
    assert text.count("of the middle of a hinge") == 1


def test_a_gauge_between_two_rods_causes_a_warning(small):
    """Rod b is 60 mm below rod a. The picture shows the dial between them."""
    setup = small.setups["<b>yx"]
    for direction, between in (("y", False), ("z", False), ("-z", True)):
        sensor = replace(setup.sensor, direction=direction)
        plan = replace(small, setups={**small.setups, "<b>yx": replace(setup, sensor=sensor)})
        section = sections(page_of(plan))[0]
        warning = "between rods a and b, with 52 mm for dial and plunger"
        assert (warning in words(section)) is between
        assert ("touch rod b instead" in words(section)) is between
        circles = section.findall(".//svg")[1].findall(".//circle")
        rods = [circle for circle in circles if circle.get("fill") in ("#9cc7e6", "#e3e7ec")]
        (dial,) = (circle for circle in circles if circle.get("fill") == "#fff")
        assert len(rods) == 2
        for rod in rods:
            (x, y, r), (a, b, s) = (
                [float(circle.get(key)) for key in ("cx", "cy", "r")] for circle in (dial, rod)
            )
            assert np.hypot(x - a, y - b) > r + s


def test_a_machine_with_cranks_is_described_without_slides(root, tmp_path):
    (tmp_path / "plan.yaml").write_text(
        f"robot: {root / 'examples/fivebar'}\n"
        "postures: {zero: {tcp_mm: [0, 0]}, out: {tcp_mm: [10, 0]}}\n"
        "setups: {up: {leg: left, touches: a, tip: {ball: {radius_mm: 1.5}}, "
        "direction: [0, 0, 1], section: {fraction: 0.5}}}\n"
    )
    text = words(page_of(load_plan(tmp_path / "plan.yaml")))
    assert "Jog each joint a little counterclockwise as seen from +z. Its number must grow" in text
    assert "leg left, gauge in z, at 0.5 of its length from the crank at the mechanical" in text
    assert "100.0 mm from the hinge on the crank" in text
    assert "Correct the zero in the controller" in text
    assert "or the others in fivebar.urdf and fivebar.yaml." in text
    for words_of_slides in ("slide ", "outwards", "machine.yaml", "few mm"):
        assert words_of_slides not in text


def test_sessions_have_sheets(experiment_2):
    session = experiment_2
    found = sheet_files(session)
    assert len(found) == 1 + len({r.setup for r in session.readings})
    page = etree.HTML(found["sheet.html"])
    assert len(page.xpath("//td[@class='box']")) >= len(session.readings)
    assert "set to 0" in words(page.find("body"))


def planar_sheet(folder, robot, out):
    """Files of the sheet of two postures of a planar robot."""
    (folder / "plan.yaml").write_text(
        f"robot: {robot}\npostures: {{zero: {{joints_mm: [200, 200]}}, out: {{{out}}}}}\n"
        "setups: {yx: {leg: x, direction: y, section: {fraction: 0.5}}}\n"
    )
    return sheet_files(load_plan(folder / "plan.yaml"))


def test_a_planar_robot_has_a_sheet(root, tmp_path):
    found = planar_sheet(tmp_path, root / "tests/robots/biglide", "tcp_mm: [10, -5]")
    assert "Z" not in re.sub(r"\([^)]*\)", "", found["01-yx.ngc"])
    assert len(rows(sections(etree.HTML(found["sheet.html"]))[0])) == 3


def test_sheet_without_a_tool_has_joints_alone(root, tmp_path):
    folder = tmp_path / "biglide"
    shutil.copytree(root / "tests/robots/biglide", folder)
    yaml = folder / "biglide.yaml"
    yaml.write_text(re.sub(r"(?m)^ *tcp: .*$", "", yaml.read_text()))
    found = planar_sheet(tmp_path, "./biglide", "joints_mm: [210, 195]")
    assert list(found) == ["sheet.html"]
    cells = rows(sections(etree.HTML(found["sheet.html"]))[0])
    assert [r[1:4] for r in cells][1] == ["out", "210.000", "195.000"]


def test_the_command_writes_beside_the_session_or_elsewhere(small, tmp_path):
    words, out = ("sheet", small.path, "--out", tmp_path / "out"), tmp_path / "out"
    done = run_orthocal(tmp_path, *words)
    assert done.returncode == 0
    assert f"Wrote {out}/sheet.html to print and 4 programs" in done.stderr
    assert "Z50" not in (out / "03-zx.ngc").read_text()
    # a session states where its world is in machine coordinates
    write_session(replace(small, controller_origin=(0.0, 0.0, 0.05)), tmp_path / "moved")
    assert load_plan(tmp_path / "moved").controller_origin == (0.0, 0.0, 0.05)
    assert run_orthocal(tmp_path, "sheet", "moved").returncode == 0
    assert "Z50.0000" in (tmp_path / "moved/03-zx.ngc").read_text()
    assert "world origin at (0, 0, 50) mm" in (tmp_path / "moved/sheet.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere: there is no such file"),
        (["examples/workshop/plan.yaml", "--feed", "0"], "--feed: found 0; expected 1 to 20000"),
    ],
)
def test_bad_input_is_refused(root, tmp_path, arguments, message):
    done = run_orthocal(root, "sheet", *arguments, "--out", tmp_path / "out")
    assert (done.returncode, done.stdout) == (2, "")
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "out").exists()


PRINTED = 184.0 / 25.4 * 96.0
"""Width of the text of an A4 page within the sheet's margins, [px]."""

PAGE_HEIGHT = (297.0 - 2.0 * 12.0) / 25.4 * 96.0
"""Height of an A4 page within the sheet's margins, [px]."""


@pytest.fixture(scope="module")
def browser():
    with open_browser() as found:
        yield found


@contextmanager
def printed_sheet(browser, plan, folder):
    """The sheet of a plan in a browser, as it is printed on A4."""
    path = folder / "sheet.html"
    path.write_text(sheet_files(plan)["sheet.html"])
    with visit(browser, path.as_uri()) as found:
        found.page.set_viewport_size({"width": round(PRINTED), "height": 1000})
        found.page.emulate_media(media="print")
        yield found.page


@pytest.mark.acceptance
def test_tables_of_readings_are_as_wide_as_the_text(browser, small, tmp_path):
    """With columns for approach, temperature and time, and for what a perfect machine shows."""
    plan = small.with_effects(("backlash", "thermal", "drift"))
    readings = [
        replace(r, conditions=Conditions(approach="pn"[i % 2] * 3))
        for i, r in enumerate(plan.readings)
    ]
    plan = replace(plan, readings=tuple(readings))
    with printed_sheet(browser, plan, tmp_path) as page:
        widths = page.evaluate(
            """() => [...document.querySelectorAll('table')].map((table) =>
                 [table.getBoundingClientRect().right, table.rows[0].cells.length])"""
        )
    assert max(right for right, _ in widths) <= round(PRINTED) + 0.5
    assert max(columns for _, columns in widths) == 12


@pytest.mark.acceptance
def test_a_setup_of_ten_readings_fits_on_a_page(browser, tmp_path):
    """As the front page does, with offsets and backlash that are compensated.

    Tool coordinates and names of programs are in one line.
    """
    make_robot(SMALL, tmp_path / "mine", counting=COUNTING)
    postures, setups = "", ""
    for k, leg in enumerate("xyz"):
        for i in range(9):
            position = [15 * i - 60.125 if axis == k else 0 for axis in range(3)]
            postures += f"  {leg}{i}: {{tcp_mm: {position}}}\n"
    for leg, direction in permutations("xyz", 2):
        read = ", ".join(f"{leg}{i}" for i in range(9))
        keys = f"leg: {leg}, direction: {direction}, section: {{fraction: 0.5}}"
        setups += f"  {direction}{leg}: {{{keys}, postures: [{read}]}}\n"
    (tmp_path / "plan.yaml").write_text(
        "robot: mine\ntitle: second\ngauge: {range_mm: [-5, 5], resolution_mm: 0.01}\n"
        "controller: {offsets_mm: [0.3, 0.5, -0.1], backlash_mm: [0.01, 0.02, 0.01]}\n"
        f"postures:\n{postures}setups:\n{setups}"
    )
    plan = load_plan(tmp_path / "plan.yaml").with_effects(["backlash"])
    approached = [replace(r, conditions=Conditions(approach="pnp")) for r in plan.readings]
    plan = replace(plan, readings=tuple(approached))
    with printed_sheet(browser, plan, tmp_path) as page:
        lines = page.evaluate(
            """() => {
                 const parts = 'td:nth-child(4), td:last-child:not(.note), p code';
                 return [...document.querySelectorAll(parts)].map((part) => {
                   const range = document.createRange();
                   range.selectNodeContents(part);
                   return [part.textContent, range.getClientRects().length];
                 });
               }"""
        )
        right = page.evaluate("document.documentElement.scrollWidth")
        front, *heights = page.evaluate(
            """() => {
                 const boxes = [...document.querySelectorAll('section[id]')].map(
                     (section) => section.getBoundingClientRect());
                 return [boxes[0].top, ...boxes.map((box) => box.height)];
               }"""
        )
    assert len(heights) == 6
    assert max(front, *heights) <= PAGE_HEIGHT
    assert right <= round(PRINTED)
    assert {"-60.125, 0, 0".replace("-", "−"), "01-yx.ngc"} < {text for text, _ in lines}
    assert [text for text, count in lines if count != 1] == []


def test_a_displaced_tip_is_described_in_its_alignment_posture(small, tmp_path):
    """At the mechanical zero the tip is beside its rod; nobody can mount it there."""
    setup = small.setups["xy"]
    displaced = replace(setup, sensor=replace(setup.sensor, beside=(0.0, 0.0, 0.005)))
    plan = replace(small, setups={**small.setups, "xy": displaced}).select(
        [r for r in small.readings if r.setup == "xy"]
    )
    path = write_session(replace(plan, robot_reference=str(small.robot.folder)), tmp_path / "plan")
    sheet = sheet_files(plan)
    (program,) = [text for name, text in sheet.items() if name.endswith(".ngc")]
    recorded = run_orthocal(tmp_path, "record", path.parent, typed="quit\n").stdout
    for text in (sheet["sheet.html"], program, recorded):
        assert "aligned in" in text
        assert "at 0.4 of its length from the slide at the mechanical zero" in " ".join(
            text.split()
        )
        assert "centre line by" not in text


ROUNDED_GLYPHS = 0.05
"""Browsers round the extent of glyphs, [mm]."""

SECTIONS = {
    "x": ("y", "z", "-y", "[0, 1, 1]"),
    "y": ("x", "-z", "[-1, 0, 2]"),
    "z": ("x", "-y", "[1, -1, 0]"),
}
TIPS = (
    "touches: a, beside_mm: [0, 0, 0], tip: {ball: {radius_mm: 1}}",
    "touches: b, beside_mm: [0, 0, 0], tip: {ball: {radius_mm: 8}}",
    "touches: a, tip: {blade: {width_mm: 44}}",
    "touches: b, tip: {blade: {width_mm: 60, radius_mm: 2}}",
)


@pytest.fixture(scope="module")
def all_kinds(tmp_path_factory):
    """Every leg, direction, rod and tip; aligned in `out`, where balls are off the middle."""
    setups = [
        f"  s{i}: {{leg: {leg}, direction: {way}, section: {{fraction: {at}}}{tip}}}"
        for i, (leg, way, at, tip) in enumerate(
            (leg, way, (0.3, 0.5, 0.7)[k % 3], tip)
            for leg, ways in SECTIONS.items()
            for k, (way, tip) in enumerate(
                product(ways, ("", *(f", {t}" for t in TIPS[leg != "x" :: 2])))
            )
        )
    ]
    path = tmp_path_factory.mktemp("plan") / "plan.yaml"
    path.write_text(
        "robot: orthoglide\ngauge: {range_mm: [-5, 5]}\n"
        "postures:\n  out: {tcp_mm: [2, -3, 3]}\n  far: {tcp_mm: [3, -4, 4]}\n"
        "setups:\n" + "\n".join(setups) + "\n"
    )
    return load_plan(path)


@pytest.fixture(scope="module")
def drawn(all_kinds):
    """The pictures of all setups with their placed labels, and their SVG."""
    pictures = []
    place_labels = Picture.place_labels
    with pytest.MonkeyPatch.context() as patch:

        def place(picture):
            pictures.append((picture, place_labels(picture)))
            return pictures[-1][1]

        patch.setattr(Picture, "place_labels", place)
        page = sheet_files(all_kinds)["sheet.html"]
    return pictures, re.findall(r"<svg.*?</svg>", page)


def box_of(label, middle):
    """Left, top, right and bottom, [mm]."""
    return (*(middle - label.half), *(middle + label.half))


def overlap(one, other):
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def test_no_label_overlaps_another_or_the_border(all_kinds, drawn):
    pictures, _ = drawn
    assert len(pictures) == 2 * len(all_kinds.setups) == 2 * 30
    texts = [label.text for picture, _ in pictures for label in picture.labels]
    assert sum("off centre" in text for text in texts) == 10
    for picture, placed in pictures:
        assert len(placed) == len(picture.labels)
        for one, other in combinations(placed, 2):
            assert not overlap(box_of(*one), box_of(*other)), (one[0].text, other[0].text)
        for label, middle in placed:
            assert (middle >= label.half).all(), label.text
            assert (middle + label.half <= (picture.width, picture.height)).all(), label.text


@pytest.mark.acceptance
def test_labels_in_a_browser_are_inside_their_boxes(browser, drawn, tmp_path):
    """The real extent of the text, with the fonts that are installed."""
    pictures, svgs = drawn
    path = tmp_path / "sheet.html"
    path.write_text("".join(svgs))
    with visit(browser, path.as_uri()) as found:
        extents = found.page.evaluate(
            """() => [...document.querySelectorAll('svg')].map((svg) =>
                 [...svg.querySelectorAll('text')].map((text) => text.getBBox()).map((box) =>
                   [box.x, box.y, box.x + box.width, box.y + box.height]))"""
        )
    for (_, placed), texts in zip(pictures, extents, strict=True):
        for one, other in combinations(texts, 2):
            assert not overlap(one, other)
        for (label, middle), extent in zip(placed, texts, strict=True):
            outside = np.abs(np.reshape(extent, (2, 2)) - middle) > label.half + ROUNDED_GLYPHS
            assert not outside.any(), label.text


def test_no_part_hides_the_place_of_contact_on_a_rod():
    """A rail of the inclined machine is in front of the contacts of leg c."""
    page = sheet_files(plan_of("inclined_orthoglide"))["sheet.html"]
    svgs = [etree.fromstring(svg) for svg in re.findall(r"<svg.*?</svg>", page, re.DOTALL)]
    machines = [svg for svg in svgs if svg.get("aria-label").endswith("the gauge on the machine")]
    assert len(machines) == 6
    transparent = []
    for svg in machines:
        shapes = [
            (
                p.get("fill"),
                Path([[float(v) for v in q.split(",")] for q in p.get("points").split()]),
            )
            for p in svg.iter("{*}polygon")
        ]
        dot = next(c for c in svg.iter("{*}circle") if c.get("r") == "1.10")
        contact = float(dot.get("cx")), float(dot.get("cy"))
        sizes = [np.ptp(p.vertices, axis=0).max() * (fill == TOUCHED) for fill, p in shapes]
        over = [fill for fill, p in shapes[np.argmax(sizes) + 1 :] if p.contains_point(contact)]
        assert set(over) <= {"none"}
        transparent.append(len(over))
    assert transparent == [0, 0, 0, 0, 1, 1]


def test_a_label_keeps_off_lines_and_stays_near_its_point():
    picture = Picture(60.0, 40.0)
    picture.line([(5.0, 20.0), (55.0, 20.0)])
    picture.label((30.0, 20.0), "rod a")
    ((label, middle),) = picture.place_labels()
    assert abs(middle[1] - 20.0) > label.half[1]
    assert np.linalg.norm(middle - (30.0, 20.0)) < 5.0
    assert label.text == "rod a"


def test_labels_without_room_are_omitted():
    picture = Picture(20.0, 8.0)
    for text in ("first", "second", "a label that is longer than the paper"):
        picture.label((10.0, 4.0), text)
    assert [label.text for label, _ in picture.place_labels()] == ["first"]


def test_labels_are_texts():
    picture = Picture(60.0, 40.0)
    picture.label((-10.0, 90.0), "<script>&\x1b\nsecond")
    svg = etree.fromstring(picture.to_svg('"<b>').encode())
    assert svg.get("aria-label") == '"<b>'
    assert [line.text for line in svg.iter("{*}tspan")] == [r"<script>&\x1b", "second"]


@pytest.mark.parametrize("count", [3, 10, 200])
def test_outlines_are_convex_hulls(count):
    points = np.random.default_rng(count).normal(size=(count, 2))
    corners = outline(points)
    shifted = np.roll(corners, -1, axis=0)
    area = 0.5 * abs(np.sum(corners[:, 0] * shifted[:, 1] - corners[:, 1] * shifted[:, 0]))
    assert area == pytest.approx(ConvexHull(points).volume)


def test_points_in_a_line_have_their_ends_as_outline():
    points = np.array([[1.0, 1.0], [0.0, 0.0], [0.5, 0.5], [1.0, 1.0]])
    assert outline(points).tolist() == [[0.0, 0.0], [1.0, 1.0]]


def test_arrows_need_a_length():
    picture = Picture(60.0, 40.0)
    picture.arrow((1.0, 1.0), (1.0, 1.0), stroke="#000")
    assert picture.parts == []
    picture.arrow((1.0, 1.0), (9.0, 1.0), stroke="#000", both=True)
    assert len(picture.parts) == 3
