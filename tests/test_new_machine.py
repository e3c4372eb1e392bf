"""orthocal new: from options or answers to a machine, a plan, a sheet and programs."""

from __future__ import annotations

import io
import json
import re
import shlex
import shutil
import sys

import numpy as np
import pytest
import yaml
from calibrated import identified
from commands import Terminal, orthocal
from folders import files_of
from lxml import etree

from orthocal import load_plan, load_robot, load_session
from orthocal.builder.build import remake_robot
from orthocal.builder.orthoglide import Orthoglide
from orthocal.cli import dialogue as asking
from orthocal.effects.loading import robot_effects
from orthocal.errors import ClosureError, ParameterError
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.reachable_box import find_workspace
from orthocal.output.scene.drawing import draw_scene
from orthocal.output.sheet import page
from orthocal.planning import first_plan
from orthocal.planning.equipment import USUAL_BALL
from orthocal.planning.sensor_gains import SensorGain
from orthocal.session.session import Purpose

pytestmark = pytest.mark.usefixtures("short_reports")

DIMENSIONS = """--leg-mm 250 --travel-mm 100:320 --attachment-mm 30 --rods-apart-mm 60
--rod-radius-mm 4 --counts up,down,up --at-zero-mm 0""".split()
SIZES = dict(zip(DIMENSIONS[::2], DIMENSIONS[1::2], strict=True))
QUICK = ["--solver", "variable-projection"]
PROGRAMS = [f"{i:02d}-{name}.ngc" for i, name in enumerate("yx zx xy zy xz yz".split(), 1)]


def options(**changed):
    given = {**SIZES, **{f"--{k.replace('_', '-')}": v for k, v in changed.items()}}
    return [word for option, value in given.items() if value for word in (option, value)]


@pytest.fixture
def unsheeted(monkeypatch):
    """A mark in place of sheets and programs."""
    monkeypatch.setattr(page, "sheet_files", lambda *_, **__: {"sheet.html": "<html></html>"})


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A machine by options, with the paper's plan."""
    folder = tmp_path_factory.mktemp("new") / "mill"
    assert orthocal("new", folder, *options(), "--paper").returncode == 0
    return folder


@pytest.fixture
def copied(made, tmp_path):
    shutil.copytree(made, tmp_path / "mill")
    return tmp_path / "mill"


def test_a_new_directory_has_all_files(made):
    assert {p.name for p in made.iterdir()} == {"machine.yaml", "mill.yaml", "mill.urdf", "first"}
    assert {p.name for p in (made / "first").iterdir()} == {
        *("session.yaml", "readings.csv", "sheet.html"),
        *PROGRAMS,
    }
    robot = load_robot(made)
    assert [d.direction for d in robot.drives] == [1, -1, 1]
    assert [float(d.to_joint(d.zero)) for d in robot.drives] == [0.0, 0.0, 0.0]
    rows = (made / "first/readings.csv").read_text().splitlines()
    assert rows[:2] == ["setup,posture,cycle,reading_mm,approach", "yx,zero,1,,ppp"]
    assert len(rows) == 1 + 24
    session = load_plan(made / "first")
    assert session.controller_offsets.tolist() == [0.0, 0.0, 0.0]
    assert session.robot.sha256 == robot.sha256
    commands = etree.HTML((made / "first/sheet.html").read_text()).xpath("//code/text()")
    assert commands[-1] == "orthocal calibrate . --out ../first-calibration"
    assert f"# {commands[-1]}\n" in (made / "first/session.yaml").read_text()
    assert session.purpose == Purpose("full")


@pytest.mark.usefixtures("unsheeted")
def test_a_new_machine_has_backlash(made, tmp_path):
    """It is identified from readings that state their approach; 0.03 mm come back."""
    robot = load_robot(made)
    assert robot.effect_names == ("backlash",)
    assert robot.parameters["x_slide.backlash"].prior_std == 2e-5
    plain, folder = tmp_path / "plain", tmp_path / "warm"
    assert orthocal("new", plain, *options(), "--paper", "--effects", "none").returncode == 0
    assert load_robot(plain).effect_names == ()
    assert "approach" not in (plain / "first/readings.csv").read_text()
    words = ["--paper", "--effects", "thermal,backlash"]
    assert orthocal("new", folder, *options(), *words).returncode == 0
    assert load_robot(folder).effect_names == ("backlash", "thermal")
    head = (folder / "first/readings.csv").read_text().partition("\n")[0]
    assert head == "setup,posture,cycle,reading_mm,approach,temperature_C"
    assert orthocal("new", folder, "--again").returncode == 0
    assert load_robot(folder).effect_names == ("backlash", "thermal")


@pytest.mark.usefixtures("unsheeted")
def test_a_new_machine_has_screws_of_a_lead(tmp_path):
    folder = tmp_path / "screws"
    assert orthocal("new", folder, *options(), "--paper", "--screw-lead-mm", "5").returncode == 0
    robot = load_robot(folder)
    assert robot.effect_names == ("backlash", "screw")
    assert [e.period for e in robot_effects(robot) if e.period] == pytest.approx([5e-3])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--effects rust", "--effects: found 'rust'; expected one of"),
        ("--effects screw", "--screw-lead-mm: is missing"),
        *((f"--screw-lead-mm {lead}", "--screw-lead-mm: ") for lead in ("0", "-5", "nan", "500")),
    ],
)
def test_wrong_effects_are_refused(tmp_path, words, message):
    """A lead of 500 mm is longer than the travel."""
    code, _, err = orthocal("new", tmp_path / "mill", *options(), "--paper", *words.split())
    assert code == 2
    assert f"orthocal: {message}" in err
    assert not (tmp_path / "mill").exists()


def offset_limits(machine):
    """Tolerances of the zeros, [mm]: those of the machine, which its session does not repeat."""
    robot, session = load_robot(machine), load_plan(machine / "first")
    assert session.robot.parameters.stated == {}
    names = [f"{drive.name}.offset" for drive in robot.drives]
    limits = [robot.parameters.limit_of(name) for name in names]
    assert [session.robot.parameters.limit_of(name) for name in names] == limits
    return limits


def test_zeros_have_one_usual_tolerance(made, tmp_path):
    """4 mm, with all dimensions as options as in the dialogue; the sheet's limit follows it."""
    assert offset_limits(made) == [4.0, 4.0, 4.0]
    assert load_robot(made).parameters["z_slide.offset"].prior_std == 2e-3
    sheet = (made / "first/sheet.html").read_text()
    assert "differs by more than 7 mm" in sheet  # 4 mm, and half a degree of legs of 250 mm
    words = [*options(), "--paper", "--tolerance", "x_slide.offset_mm=12", "--backlash", "0"]
    code, _, err = orthocal("new", tmp_path / "mill", *words)
    assert (code, err.splitlines()) == (0, ["orthocal: drawing the measuring sheet"])
    assert offset_limits(tmp_path / "mill") == [12.0, 4.0, 4.0]
    sheet = (tmp_path / "mill/first/sheet.html").read_text()
    assert "differs by more than 15 mm" in sheet
    assert "compensates no backlash, as session.yaml states" in sheet
    first = tmp_path / "mill/first/session.yaml"
    assert yaml.safe_load(first.read_text())["controller"]["backlash_mm"] == [0.0, 0.0, 0.0]
    assert "compensates no backlash" not in (made / "first/sheet.html").read_text()


def test_numbers_of_drives_are_those_of_the_controller(made):
    """0 in the mechanical zero; the travel is 150 mm inwards and 70 mm outwards, y counts down."""
    robot = load_robot(made)
    assert "Mechanical zero: x_slide 0 mm, y_slide 0 mm, z_slide 0 mm." in draw_scene(robot).facts
    for axis, name, limits in ((0, "x_slide", "-150 ... 70"), (1, "y_slide", "-70 ... 150")):
        point = np.zeros((1, 3))
        point[0, axis] = 0.08
        with pytest.raises(ClosureError) as refused:
            nominal_closure(robot).inverse(point)
        number = 80 if axis == 0 else -80
        place = f"joint '{name}' would be at {number} mm, outside its limits {limits} mm"
        assert place in str(refused.value)


def test_what_is_read_on_it_calibrates_it(made, tmp_path):
    """1.5 mm in one drive's zero come back, the controller counting down or not."""
    out = tmp_path / "try"
    error = ["--error", "y_slide.offset_mm=1.5", "--exact"]
    code, _, err = orthocal("simulate", made / "first", "--out", out, *error)
    assert code == 0, err
    code, text, _ = orthocal("calibrate", out, "--model", "offsets", *QUICK)
    found = dict(re.findall(r"(?m)^  ([xyz])_slide +\+0\.000 +([-+]\d\.\d+)", text))
    assert {k: float(v) for k, v in found.items()} == pytest.approx(
        {"x": 0.0, "y": 1.5, "z": 0.0}, abs=0.002
    )
    assert code == 0
    assert "y_slide counts down." in " ".join(text.split())
    row = next(line.split() for line in text.splitlines() if line.split()[:1] == ["y_slide"])
    assert row[-2] == f"{-float(row[2]):+.3f}"  # the change of the joint


def test_a_machine_is_made_again_after_a_change(copied):
    replace_in("machine.yaml", "leg_mm: 250", "leg_mm: 260")(copied)
    code, out, _ = orthocal("new", copied, "--again")
    assert code == 0
    assert f"Made {copied}/first/sheet.html and its programs again." in out
    # x_max: 60 mm out, and the other two legs lean: 260 − √(260² − 60²) = 7.0178
    assert "joints 60.0000 7.0178 -7.0178" in (copied / "first/01-yx.ngc").read_text()
    assert "7.018" in (copied / "first/sheet.html").read_text()
    assert load_robot(copied).drive_zero == pytest.approx([0.26] * 3)
    assert load_plan(copied / "first").purpose == Purpose("full")


def test_readings_are_not_overwritten(copied):
    file = copied / "first/readings.csv"
    head, *rows = file.read_text().splitlines()
    read = [row.replace(",,", ",0.12,") for row in rows]
    read[0] = rows[0].replace(",,", ",12,")  # out of range, but measured
    file.write_text("\n".join([head, *read]) + "\n")
    before = files_of(copied)
    for words in (
        ["new", copied, *options(), "--paper"],
        ["plan", copied, "--out", copied / "first"],
    ):
        code, _, err = orthocal(*words, "--force")
        assert (code, err) == (
            2,
            f"orthocal: {copied}/first/readings.csv: contains {len(rows)} readings, which "
            "--force does not overwrite; move them first\n",
        )
    assert files_of(copied) == before


@pytest.fixture(scope="module")
def planned(tmp_path_factory, short_reports, quick_plans):
    """A machine with options for its workspace and a tolerance, and a plan of 15 minutes."""
    mill = tmp_path_factory.mktemp("planned") / "mill"
    words = options(workspace_mm="40", tolerance="*.offset_mm=4", hours="0.25")
    return mill, orthocal("new", mill, *words)


@pytest.mark.usefixtures("unsheeted")
def test_a_gauge_without_a_tip_has_the_usual_ball(tmp_path):
    """The line between two rods, which the gauge would read without a tip, is empty space."""
    dial, folder = tmp_path / "dial.yaml", tmp_path / "my mill"
    dial.write_text("sigma_mm: 0.0005\nresolution_mm: 0.001\nrange_mm: [-6, 6]\n")
    code, out, err = orthocal("new", folder, *options(), "--paper", "--gauge", dial)
    assert code == 0
    commands = [shlex.split(line) for line in out.splitlines() if line.startswith("  orthocal ")]
    assert [words[:3] for words in commands] == [
        ["orthocal", "new", str(folder)],
        ["orthocal", "view", str(folder)],
        ["orthocal", "record", str(folder / "first")],
        ["orthocal", "calibrate", str(folder / "first")],
    ]
    assert f"Gauge: ball of 3 mm diameter (not stated in {dial})." in err
    session = load_plan(folder / "first")
    assert {(s.sensor.rod, s.sensor.tip) for s in session.setups.values()} == {("a", USUAL_BALL)}
    assert session.gauge.range == (-6e-3, 6e-3)


def test_without_paper_a_plan_is_chosen(planned):
    mill, (code, out, err) = planned
    assert code == 0, err
    steps = [line.split()[1] for line in err.splitlines()]
    assert list(dict.fromkeys(steps)) == ["computing", "choosing", "search", "comparing", "drawing"]
    size = r"(\d+) readings \((\d) closing\) in (\d) setups?"
    read, closing, setups = map(int, re.search(rf"Plan: {size}, about 1\d min\.", out).groups())
    assert (read, setups) == (len(load_plan(mill / "first").readings), closing)
    errors = r"[\d.]+ mm after this measurement, [\d.]+ mm after a second one"
    assert re.search(rf"all identified errors corrected {errors}\.", " ".join(out.split()))
    assert "RMS over the workspace ±40 mm" in out
    first = mill / "first"
    names = {p.name for p in first.iterdir() if p.suffix != ".ngc"}
    assert names == {"session.yaml", "readings.csv", "sheet.html", "plan.json", "plan.svg"}
    session = load_plan(first)
    assert len(list(first.glob("*.ngc"))) == len(session.setups)
    assert {s.sensor.tip.form for s in session.setups.values()} == {"ball"}
    assert session.purpose == Purpose("full")
    assert session.robot.parameters.stated == {}
    assert session.robot.parameters["y_slide.offset"].prior_std == 2e-3
    machine = load_robot(mill)  # later plans for the machine use these tolerances, too
    assert machine.parameters["y_slide.offset"].prior_std == 2e-3
    assert machine.parameters["x_leg.length"].prior_std == 1e-4
    assert remake_robot(mill).parameters["y_slide.offset"].prior_std == 2e-3
    assert "of the middle of a hinge" not in (first / "sheet.html").read_text()


def test_the_workspace_is_written_and_a_plan_for_another_one_is_old(planned, tmp_path):
    """Into machine.yaml and the robot's YAML; each of both changes makes the plan old."""
    mill = shutil.copytree(planned[0], tmp_path / "mill")
    assert find_workspace(load_robot(mill)).half_side == pytest.approx(0.04)
    assert json.loads((mill / "first/plan.json").read_text())["workspace_mm"] == [[-40, 40]] * 3
    code, _, _ = orthocal("new", mill, "--again")
    assert code == 0
    file = mill / "machine.yaml"
    before = file.read_text()
    for old, new, changed in (
        ("[[-40, 40], [-40, 40], [-40, 40]]", "[[-40, 50], [-40, 40], [-30, 40]]", "workspace"),
        ("travel_mm: [100, 320]", "travel_mm: [90, 320]", "travel"),
    ):
        assert old in before
        file.write_text(before.replace(old, new))
        code, _, err = orthocal("new", mill, "--again")
        assert code == 3
        assert f"{mill}/first: the plan is old ({changed} changed)" in err
    assert load_robot(mill).drives[0].lower == pytest.approx(0.09)


@pytest.mark.parametrize(
    "words",
    [
        *("--hours 2", "--effects none", "--effects thermal", "--paper", "--model offsets"),
        *("--screw-lead-mm 5", "--temperature 20:28", "--gauge dial.yaml", "--with bar.yaml"),
        *("--tolerance *.offset_mm=9", "--workspace-mm 50", "--force"),
    ],
)
def test_options_of_a_plan_are_refused_with_again(copied, words):
    before = files_of(copied)
    code, _, err = orthocal("new", copied, "--again", *words.split())
    option = words.split()[0]
    expected = f"orthocal: {option}: found with --again, which reads machine.yaml\n"
    assert (code, err) == (2, expected)
    assert files_of(copied) == before


def write(file, content):
    return lambda folder: (folder / file).write_text(content)


def replace_in(file, old, new):
    def change(folder):
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new))

    return change


SPOILT = {
    "a workspace out of reach": (
        replace_in(
            "machine.yaml",
            "# workspace_mm: [[-60, 60], [-60, 60], [-60, 60]]",
            "workspace_mm: [[-90, 90], [-90, 90], [-90, 90]]",
        ),
        "machine.yaml: workspace_mm: the machine does not reach the workspace ±90 mm",
    ),
    "a posture beyond the travel": (  # with the controller's number
        replace_in("first/session.yaml", "tcp_mm: [0.0, 60.0, 0.0]", "joints_mm: [250, 330, 250]"),
        "y_slide would be at -80.000 mm; it reaches from -70 to 150 mm",
    ),
    "files of two robots": (
        lambda folder: (
            [shutil.copy(folder / "mill.urdf", folder / f"{k}.urdf") for k in "ab"]
            and (folder / "mill.urdf").unlink()
        ),
        "one URDF file, or one named mill.urdf; found a.urdf, b.urdf",
    ),
    "dimensions alone": (
        lambda folder: (folder / "mill.yaml").unlink(),
        "contains machine.yaml but no YAML of a robot",
    ),
    **{
        f"a plan of {content}": (write(f"first/{file}", content), f"mill/first/{file}:")
        for file, content in (
            *(("plan.json", "5"), ("plan.json", "null"), ("plan.json", "{")),
            ("session.yaml", "robot: ["),
        )
    },
}


@pytest.mark.parametrize("name", SPOILT)
def test_spoilt_machines_are_refused(copied, name):
    spoil, message = SPOILT[name]
    spoil(copied)
    before = files_of(copied)
    by_check = name in ("a posture beyond the travel", "files of two robots")
    words = ["check", copied / "first"] if by_check else ["new", copied, "--again"]
    code, _, err = orthocal(*words)
    assert code == 2
    assert message in err
    assert ("does not reach" in err) == ("workspace" in name)
    assert ("; the largest box of this shape is ±" in err) == ("workspace" in name)
    assert files_of(copied) == before


def test_a_renamed_directory_works(copied):
    """machine.yaml is not the robot's; the files keep their names, also if made again."""
    before = load_robot(copied)
    renamed = copied.rename(copied.with_name("lathe"))
    assert load_robot(renamed).sha256 == before.sha256
    assert load_plan(renamed / "first").robot.name == "lathe"
    names = set(files_of(renamed))
    replace_in("machine.yaml", "leg_mm: 250", "leg_mm: 260")(renamed)
    code, _, err = orthocal("new", renamed, "--again")
    assert (code, err) == (0, "")
    assert set(files_of(renamed)) == names
    assert load_robot(renamed).drive_zero == pytest.approx([0.26] * 3)


def test_sheets_with_readings_stay_unchanged(copied):
    replace_in("first/readings.csv", "yx,zero,1,", "yx,zero,1,0.12")(copied)
    before = (copied / "first/sheet.html").read_text()
    code, out, err = orthocal("new", copied, "--again")
    assert code == 0
    assert f"orthocal: {copied}/first: has readings, which belong to the dimensions at" in err
    assert "sheet.html" not in out
    assert (copied / "first/sheet.html").read_text() == before


def test_a_plan_out_of_reach_is_old(copied):
    replace_in("machine.yaml", "[100, 320]", "[200, 320]")(copied)
    code, _, err = orthocal("new", copied, "--again")
    assert code == 3
    assert "first/session.yaml: postures.x_min: " in err
    assert "first: the plan is old (the machine does not reach its postures); plan again" in err
    # which `plan --force` would not replace
    replace_in("first/readings.csv", "yx,zero,1,", "yx,zero,1,0.12")(copied)
    code, _, err = orthocal("new", copied, "--again")
    assert code == 3
    assert "it has readings, so check the dimensions" in err
    assert "--force" not in err


@pytest.mark.usefixtures("unsheeted")
def test_existing_files_are_not_overwritten(copied):
    before = (copied / "mill.urdf").read_text()
    given = ["new", copied, *options(leg_mm="260"), "--paper"]
    code, _, err = orthocal(*given)
    assert code == 2
    assert err == f"orthocal: {copied}/machine.yaml: exists already; --force overwrites it\n"
    assert (copied / "mill.urdf").read_text() == before
    code, _, _ = orthocal(*given, "--force")
    assert code == 0
    assert load_robot(copied).drive_zero == pytest.approx([0.26] * 3)


@pytest.mark.usefixtures("unsheeted")
def test_invalid_answers_are_asked_for_again(tmp_path):
    answers = ["250000\n", "\n", "250\n", "10:600\n", "100:320\n", "30\n", "60\n", "40\n", "4\n"]
    answers += ["sideways\n", "up,down,up\n", "0\n", "90\n", "40:30\n", "-50:60,-50:60,-40:40\n"]
    answers += ["0\n", "3\n"]
    words = "new", tmp_path / "mill", "--paper"
    code, *printed = orthocal(*words, typed="".join(answers), terminal=True)
    said = "".join(printed)
    assert code == 0, said
    assert said.count("Leg length, from hinge to hinge of a rod, mm: ") == 3
    assert "  legs of 250000 mm; expected 20 to 5000 mm" in said
    assert "  travel from 10 to 600 mm; legs of 250 mm reach 25 to 475 mm" in said
    assert "  rods of radius 40 mm, 60 mm apart; expected a radius above 0" in said
    assert "  found 'sideways'; expected up or down" in said
    assert "  the machine does not reach the workspace ±90 mm" in said
    assert "  found '40:30'; expected half the side of a cube" in said
    assert "  found 0 mm; expected more than 0, and at most 100 mm" in said
    assert "Plan: 24 readings (6 closing) in 6 setups." in said
    robot = load_robot(tmp_path / "mill")
    assert robot.workspace.tolist() == [[-0.05, 0.06], [-0.05, 0.06], [-0.04, 0.04]]
    assert [d.direction for d in robot.drives] == [1, -1, 1]
    assert robot.legs["x"].rods["a"].radius == pytest.approx(0.004)
    assert offset_limits(tmp_path / "mill") == [3.0, 3.0, 3.0]


def test_nothing_is_written_when_the_input_ends(tmp_path):
    words = "new", tmp_path / "mill", "--paper"
    code, _, err = orthocal(*words, typed="250\n", terminal=True)
    assert code == 2
    assert "orthocal: --travel-mm: was not answered: the input ended" in err
    assert not (tmp_path / "mill").exists()


def test_options_are_not_asked_for(monkeypatch):
    """At a terminal, too; what is missing is asked for in its place."""
    monkeypatch.setattr(sys, "stdin", Terminal(io.BytesIO(b"260\n" * 2)))
    given = {
        option.strip("-").replace("-", "_"): asking.Stated(option, text)
        for option, text in SIZES.items()
        if option != "--leg-mm"
    }
    assert asking.find_answers(Orthoglide, given).dimensions.leg == pytest.approx(0.26)
    given["travel_mm"] = asking.Stated("--travel-mm", "10:20")
    with pytest.raises(ParameterError, match=r"--travel-mm: travel from 10 to 20 mm"):
        asking.find_answers(Orthoglide, given)


USUAL = ["--travel-mm", "120:390", "--rod-radius-mm", "5.5", "--counts", "up", "--at-zero-mm", "0"]
KINDS = {
    "biglide": ["--leg-mm", "310.25", "--attachment-mm", "60", "--rods-apart-mm", "80", *USUAL],
    "inclined-orthoglide": [
        *("--dimension", "elevation_deg=45", "--dimension", "leg_mm=310.25"),
        *("--attachment-mm", "40", "--rods-apart-mm", "80", *USUAL),
    ],
}


@pytest.mark.parametrize("kind", KINDS)
def test_machines_of_other_kinds_are_made_and_calibrated(tmp_path, kind):
    """1.5 mm in the zero of a drive come back from exact readings of the legs."""
    folder, out = tmp_path / "mill", tmp_path / "try"
    code, said, _ = orthocal("new", folder, "--kind", kind, *KINDS[kind], "--paper")
    assert code == 0
    assert f"Wrote {folder}: " in said
    robot = load_robot(folder)
    name = robot.drives[1].name
    error = ["--error", f"{name}.offset_mm=1.5", "--exact"]
    assert orthocal("simulate", folder / "first", "--out", out, *error).returncode == 0
    found = identified(load_session(out), "offsets")
    for drive in robot.drives:
        expected = 1.5e-3 if drive.name == name else 0.0
        assert found[f"{drive.name}.offset"].value == pytest.approx(expected, abs=2e-6)
    assert orthocal("new", folder, "--again").returncode == 0


DELTA = [
    *("--kind", "linear-delta", "--dimension", "rod_mm=280", "--dimension", "radius_mm=140"),
    *("--travel-mm", "30:560", "--rods-apart-mm", "50", "--rod-radius-mm", "3"),
]


@pytest.mark.usefixtures("unsheeted")
def test_the_first_plan_of_a_delta_is_its_bed_and_names_what_helps(tmp_path, monkeypatch):
    """`test_sensor_gains.py` has the gains."""
    searched, gains = [], (SensorGain("a ball bar", 1, 30, 60.0, 31e-6),)
    monkeypatch.setattr(first_plan, "find_sensor_gains", lambda *of: searched.append(of) or gains)
    code, said, _ = orthocal("new", tmp_path / "delta", *DELTA)
    assert code == 0
    assert "Plan: 26 readings (1 closing) in 1 setup" in said
    assert "Another hour, with all errors corrected: 0.031 mm with a ball bar" in said
    ((forecast, planned, expected),) = searched
    assert expected.reported.rms == forecast.after(planned).reported.rms
    session = load_plan(tmp_path / "delta/first")
    assert {s.sensor.kind for s in session.setups.values()} == {"tool_indicator"}
    assert load_robot(tmp_path / "delta").workspace.tolist()[2] == [0.0, 0.14]
    file = tmp_path / "delta/machine.yaml"
    text = file.read_text().replace("travel_mm: [30,", "travel_mm: [180,")
    file.write_text(text.replace("[[-70, 70], [-70, 70], [0, 140]]", "[[-9, 9], [-9, 9], [0, 9]]"))
    code, _, err = orthocal("new", tmp_path / "delta", "--again")
    assert (code, "orthocal new" in err, "orthocal plan" in err) == (3, True, False)


@pytest.mark.usefixtures("unsheeted")
def test_a_default_workspace_out_of_reach_is_refused_by_the_option(tmp_path, without_sensor_gains):
    """The workspace of a linear delta depends on its radius; short slides do not reach it."""
    short = [w.replace("30:560", "200:300") for w in DELTA]
    code, _, err = orthocal("new", tmp_path / "delta", *short)
    assert code == 2
    assert err.startswith("orthocal: --workspace-mm: by default the machine does not reach")
    assert "'c_slide' would be at" in err
    assert "the largest box of this shape is x ±40, y ±40, z 0…11.43 mm" in err
    assert "yaml" not in err
    box = "--workspace-mm=-40:40,-40:40,0:11"
    assert orthocal("new", tmp_path / "delta", *short, box).returncode == 0


def test_a_posture_beyond_the_travel_is_named_with_the_controllers_number(copied):
    file = copied / "first/session.yaml"
    text = file.read_text()
    assert "y_max:\n    tcp_mm: [0.0, 60.0, 0.0]" in text
    file.write_text(text.replace("tcp_mm: [0.0, 60.0, 0.0]", "joints_mm: [250.0, 330.0, 250.0]"))
    code, _, err = orthocal("check", copied / "first")
    assert code == 2
    assert "y_slide would be at -80.000 mm; it reaches from -70 to 150 mm" in err


def test_a_directory_with_files_of_two_robots_is_refused(copied):
    renamed = copied.rename(copied.with_name("lathe"))
    (renamed / "other.urdf").write_bytes((renamed / "mill.urdf").read_bytes())
    code, _, err = orthocal("check", renamed / "first")
    assert code == 2
    assert "one URDF file, or one named lathe.urdf; found mill.urdf, other.urdf" in err
