"""Joints of a LinuxCNC machine from its INI file, and the commands that read them."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from calibrated import UNJUDGED, plan_of
from closed_form import inverse
from commands import run_orthocal
from conftest import marked_pictures
from effect_plans import write_plan

from orthocal import (
    ParameterError,
    calibrate,
    load_calibration,
    load_plan,
    restore_session,
    simulate_session,
    write_calibration,
    write_session,
)
from orthocal.assessment.controller_entries import find_backlash
from orthocal.cli.options import ControllerOptions
from orthocal.cli.sheet import note_contradictions
from orthocal.effects.compensation import JointTrim, compensates_alike, home_positions, with_homes
from orthocal.effects.loading import with_effects
from orthocal.export.linuxcnc import entered_lines
from orthocal.kinematics.workspace import cube
from orthocal.measurement.files.linuxcnc_ini import read_controller_joints
from orthocal.output.text.answer import render_answer
from orthocal.output.text.layout import to_text
from orthocal.planning.equipment import Equipment
from orthocal.units import DEG

MM = 1e-3

LEG = 310.25e-3
"""Length of the legs of the packaged Orthoglide, [m]."""

INI = """# a machine
[TRAJ]
LINEAR_UNITS = mm
[JOINT_0]
HOME_OFFSET = 352.5   # at the switch
HOME_LATCH_VEL = -1.5
BACKLASH = 0.031
[JOINT_1]
HOME_OFFSET = 340
HOME_LATCH_VEL = 2
HOME_LATCH_VEL = 2
; BACKLASH = 0.5
[JOINT_2]
HOME_OFFSET = -3.25
HOME_LATCH_VEL = 0.5
COMP_FILE = trims.comp
COMP_FILE_TYPE = 1
BACKLASH = 0.2
"""


HOMES = (352.5, 340.0, -3.25)
"""HOME_OFFSET of its joints, [mm]."""


@pytest.fixture(scope="module", autouse=True)
def without_pictures():
    with marked_pictures():
        yield


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "trims.comp").write_text("0 0.01 -0.02\n100 0.03 -0.04\n")
    (tmp_path / "machine.ini").write_text(INI)
    return tmp_path


def test_joints_are_read(folder, orthoglide):
    joints = read_controller_joints(folder / "machine.ini", orthoglide)
    assert np.array(joints.home_offsets) / MM == pytest.approx(HOMES)
    assert home_positions(joints.compensation) == joints.home_offsets
    assert joints.latched == (-1, 1, 1)
    at = np.array([0.05])
    shown = [trim(at)[0] / MM for trim in joints.compensation]
    assert np.array(shown) == pytest.approx(
        np.array([[0.0155, -0.0155], [0.0, 0.0], [0.02, -0.03]]), abs=1e-12
    )


def test_limits_that_limit_nothing_are_infinite(folder, orthoglide):
    """LinuxCNC's defaults are -1e99 and 1e99."""
    limits = "[JOINT_0]\nMIN_LIMIT = -1e99\nMAX_LIMIT = 1e99\n"
    text = INI.replace("[JOINT_0]\n", limits).replace("[JOINT_1]\n", "[JOINT_1]\nMIN_LIMIT = 5\n")
    (folder / "machine.ini").write_text(text)
    unlimited = (-np.inf, np.inf)
    found = read_controller_joints(folder / "machine.ini", orthoglide)
    assert found.limits == (unlimited, (5 * MM, np.inf), unlimited)
    assert found.axis_limits == (unlimited,) * 3
    axes = "[AXIS_X]\nMIN_LIMIT = -60\nMAX_LIMIT = 70\n[AXIS_Z]\nMAX_LIMIT = 50\n"
    (folder / "machine.ini").write_text(INI + axes)
    found = read_controller_joints(folder / "machine.ini", orthoglide)
    assert found.axis_limits == ((-60 * MM, 70 * MM), unlimited, (-np.inf, 50 * MM))
    (folder / "machine.ini").write_text((INI + axes).replace("= 70", "= -70"))
    with pytest.raises(ParameterError, match=r"\[AXIS_X\]: MIN_LIMIT is -60 mm, not below MAX"):
        read_controller_joints(folder / "machine.ini", orthoglide)


@pytest.mark.parametrize(
    ("least", "side", "noted"), [(-60, None, True), (-61, None, False), (-60, 0.05, False)]
)
def test_limits_that_exclude_a_part_of_the_workspace_are_noted(
    folder, orthoglide, capsys, least, side, noted
):
    """The workspace is ±60 mm in coordinates that are 1 mm less than the displayed ones."""
    (folder / "machine.ini").write_text(f"{INI}[AXIS_X]\nMIN_LIMIT = {least + 1.5}\n")
    workspace = None if side is None else cube(orthoglide, half_side=side)
    options = ControllerOptions(ini=folder / "machine.ini")
    options.limit(Equipment(), orthoglide, (0.001, 0.0, 0.0), workspace)
    note = " ".join(capsys.readouterr().err.split())
    assert ("the soft limits of [AXIS_X] exclude a part of the workspace" in note) is noted


@pytest.mark.parametrize(("effects", "noted"), [(["backlash"], True), ([], False)])
def test_a_latch_against_the_search_is_noted(folder, orthoglide, capsys, effects, noted):
    text = INI.replace("[JOINT_0]\n", "[JOINT_0]\nHOME_SEARCH_VEL = 9\n")
    text = text.replace("[JOINT_1]\n", "[JOINT_1]\nHOME_SEARCH_VEL = 9\n")
    (folder / "machine.ini").write_text(text)
    assert read_controller_joints(folder / "machine.ini", orthoglide).opposed == ("[JOINT_0]",)
    session = replace(plan_of("raw-cycles"), robot=with_effects(orthoglide, effects))
    note_contradictions(session, folder / "machine.ini")
    assert ("[JOINT_0] has a HOME_LATCH_VEL whose sign" in capsys.readouterr().err) == noted


@pytest.mark.parametrize(
    ("pattern", "line", "latched"),
    [
        ("HOME_LATCH_VEL.*", "", (0, 0, 0)),
        ("HOME_LATCH_VEL = 0.5", "", (-1, 1, 0)),
        ("HOME_LATCH_VEL = 0.5", "HOME_LATCH_VEL = 0", (-1, 1, 0)),
    ],
)
def test_an_unstated_direction_of_latching_is_unknown(folder, orthoglide, pattern, line, latched):
    (folder / "machine.ini").write_text(re.sub(pattern, line, INI))
    assert read_controller_joints(folder / "machine.ini", orthoglide).latched == latched


def test_a_key_with_two_values_is_refused(folder, orthoglide):
    """As if the exported lines were appended: LinuxCNC would not read them."""
    path, appended = folder / "machine.ini", "\n[JOINT_1]\n# new\nHOME_OFFSET = {}\n"
    path.write_text(INI + appended.format(340))
    assert read_controller_joints(path, orthoglide).home_offsets[1] == pytest.approx(0.34)
    path.write_text(INI + appended.format(341.5))
    line = len((INI + appended).splitlines())
    first = INI.splitlines().index("HOME_OFFSET = 340") + 1
    expected = rf"ini:{line}: \[JOINT_1\] has HOME_OFFSET = 341.5, but 340 in line {first}"
    with pytest.raises(ParameterError, match=expected):
        read_controller_joints(path, orthoglide)


def test_a_machine_without_compensation_has_none(folder, orthoglide):
    lines = [v for v in INI.splitlines() if not v.startswith(("BACKLASH", "COMP"))]
    (folder / "machine.ini").write_text("\n".join(lines))
    found = read_controller_joints(folder / "machine.ini", orthoglide).compensation
    assert len(found) == 3  # stated, not unknown
    assert compensates_alike(found, ())


def test_a_table_of_zeros_compensates_nothing():
    """Stated or not, a controller without compensation adds nothing to a position."""
    zeros = JointTrim(table=np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]))
    trims = JointTrim(table=np.array([[0.0, 1e-6, 0.0], [0.1, 0.0, 0.0]]))
    for other in ((), (JointTrim(), JointTrim())):
        for table, same in ((zeros, True), (trims, False)):
            assert compensates_alike((JointTrim(), table), other) is same
            assert compensates_alike(other, (JointTrim(), table)) is same
    assert compensates_alike((), ())


@pytest.mark.parametrize("size", [MM, DEG])
def test_backlash_as_written_is_the_same(size):
    """Rounded to 1e-6 mm or 1e-6 degrees, but not to 1e-4."""
    exact = JointTrim(0.0901262614999 * size)
    for decimals, same in ((6, True), (4, False)):
        written = JointTrim(round(0.0901262614999, decimals) * size)
        assert compensates_alike([exact], [written]) is same


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("LINEAR_UNITS = mm", "LINEAR_UNITS = inch", "[TRAJ]"),
        ("BACKLASH = 0.031", "UNITS = INCH", "[JOINT_0]"),
        ("[JOINT_2]", "[JOINT_3]", "[JOINT_2]"),
        ("HOME_OFFSET = 340", "HOME_OFFSET = 340,0", "[JOINT_1]"),
        ("BACKLASH = 0.031", "BACKLASH = -0.031", "[JOINT_0]"),
        ("COMP_FILE_TYPE = 1", "COMP_FILE_TYPE = 0", "[JOINT_2]"),
        ("BACKLASH = 0.2", "MIN_LIMIT = 70\nMAX_LIMIT = -150", "[JOINT_2]"),
        ("BACKLASH = 0.2", "MIN_LIMIT = 1e99\nMAX_LIMIT = 1e99", "[JOINT_2]"),
        ("BACKLASH = 0.2", "BACKLASH = 1e99", "[JOINT_2]"),
    ],
)
def test_wrong_files_are_refused(folder, orthoglide, old, new, where):
    assert old in INI
    (folder / "machine.ini").write_text(INI.replace(old, new))
    with pytest.raises(ParameterError) as caught:
        read_controller_joints(folder / "machine.ini", orthoglide)
    assert caught.value.where == f"{folder / 'machine.ini'}: {where}"


def test_included_files_are_refused(folder, orthoglide):
    """Their HOME_OFFSET would be read as 0."""
    text = INI.replace("HOME_OFFSET = 340", "#INCLUDE y.inc")
    (folder / "machine.ini").write_text(text)
    with pytest.raises(ParameterError) as caught:
        read_controller_joints(folder / "machine.ini", orthoglide)
    line = text.splitlines().index("#INCLUDE y.inc") + 1
    assert caught.value.where == f"{folder / 'machine.ini'}:{line}"


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    """Directory of a calibration with backlash."""
    folder = tmp_path_factory.mktemp("calibrated")
    plan = load_plan(write_plan(folder / "plan", effects="backlash: {}"))
    truth = {f"{d}_slide.backlash": 30e-6 for d in "xyz"}
    truth |= {"x_slide.offset": 0.4e-3, "y_slide.offset": -0.3e-3}
    session = simulate_session(plan.with_controller(np.zeros(3)), truth, seed=1).session
    (folder / "one").mkdir()
    result = calibrate(session, "offsets", **UNJUDGED)
    write_calibration(result, folder / "one" / "calibration.json")
    return folder / "one"


@pytest.fixture
def plain(folder):
    """INI file of a controller that compensates nothing, as during the measurement."""
    lines = [v for v in INI.splitlines() if not v.startswith(("BACKLASH", "COMP"))]
    (folder / "plain.ini").write_text("\n".join(lines))
    return folder / "plain.ini"


@pytest.fixture(scope="module")
def at_home(one, tmp_path_factory):
    """Directory of the same calibration, whose session states HOME_OFFSET."""
    result, folder = load_calibration(one), tmp_path_factory.mktemp("at-home")
    trims = with_homes((JointTrim(),) * 3, np.array(HOMES) * MM)
    session = replace(result.session, compensation=trims)
    write_calibration(replace(result, session=session), folder / "calibration.json")
    return folder


def with_lines(text, exported):
    """Lines of a controller after HOME_OFFSET and BACKLASH of an export were entered."""
    for i in range(3):
        section = exported.partition(f"[JOINT_{i}]")[2].partition("[")[0]
        lines = re.findall(r"(?m)^(?:HOME_OFFSET|BACKLASH) = .*$", section)
        before, mark, after = text.partition(f"[JOINT_{i}]\n")
        after = re.sub(r"HOME_OFFSET = .*", "\n".join(lines), after, count=1)
        text = before + mark + after
    return text


def run(folder, command, *words, code=0):
    """A command, and that it ends as expected."""
    done = run_orthocal(folder, command, *words)
    assert done.returncode == code, done.stderr
    return done


def export(folder, one, out, *words, code=0):
    to = ("--to", "linuxcnc", "--offsets", "--out", out)
    return run(folder, "export", one, *to, *words, code=code)


def again(folder, one, out, *words):
    return run(folder, "again", one, "--out", out, *words)


def test_export_refuses_the_file_of_another_controller(folder, one):
    done = export(folder, one, "home", "--ini", folder / "machine.ini", code=2)
    assert "machine.ini" in done.stderr
    message = " ".join(done.stderr.split())
    assert "JOINT_0 has BACKLASH 0.031 mm instead of BACKLASH 0 or none" in message
    assert not (folder / "home").exists()


def test_export_takes_home_and_latching_from_the_file(folder, one, plain):
    by_file = export(folder, one, "file", "--ini", plain)
    assert "Assumed" not in by_file.stderr
    stated = ["--home-offset", "352.5,340,-3.25", "--latched=-,+,+"]
    export(folder, one, "stated", *stated)
    other = ["--home-offset", "352.5,340,-3.25", "--latched=+,+,+"]
    export(folder, one, "other", *other)
    lines = [(folder / name / "joints.ini").read_text() for name in ("file", "stated", "other")]
    assert lines[0] == lines[1] != lines[2]
    for name, expected in (("file", (-1, 1, 1)), ("other", (1, 1, 1))):  # for the next commands
        path = folder / name / "joints.ini"
        assert read_controller_joints(path, load_calibration(one).robot).latched == expected
    twice = export(folder, one, "twice", "--ini", plain, "--latched", "+,+,+", code=2)
    assert "--latched" in twice.stderr


def test_a_fragment_of_changes_states_no_home_offset(folder, one, plain):
    """As exported without HOME_OFFSET; then the option states it."""
    lines = [v for v in plain.read_text().splitlines() if not v.startswith("HOME_")]
    (folder / "changes.ini").write_text("\n".join(lines))
    home = ["--home-offset", "352.5,340,-3.25"]
    for name, words in (("no-file", []), ("stated", home)):
        export(folder, one, name, *words)
        export(folder, one, f"{name}-ini", "--ini", "changes.ini", *words)
        texts = [(folder / n / "joints.ini").read_text() for n in (name, f"{name}-ini")]
        entered = [re.findall(r"^(?:# )?HOME_OFFSET = .*", text, re.M) for text in texts]
        assert entered[0] == entered[1]
        assert len(entered[0]) == 3


def test_home_beyond_the_new_limits_is_named(folder, one, plain):
    """HOME of joint 1 is at its limit of 380 mm, which moves with the offset, or far from it."""
    limit = "[JOINT_1]\nMAX_LIMIT = 380\nHOME = "
    for home in (380, 200):
        text = plain.read_text().replace("[JOINT_1]\n", f"{limit}{home}\n")
        (folder / "limit.ini").write_text(text)
        done = export(folder, one, f"home-{home}", "--ini", folder / "limit.ini")
        lines = folder / f"home-{home}/joints.ini"
        assert read_controller_joints(lines, load_calibration(one).robot).limits[1][1] < 0.38
        assert ("HOME of JOINT_1 is 380 mm" in done.stderr) == (home == 380)


def test_narrower_soft_limits_of_the_file_are_kept(folder, one, plain):
    """They are positions of the slide, which change with the offset; wider ones do not count."""
    own = "[JOINT_1]\nMIN_LIMIT = 160\nMAX_LIMIT = 999\n"
    (folder / "narrow.ini").write_text(plain.read_text().replace("[JOINT_1]\n", own))
    limits = []
    for name in ("plain", "narrow"):
        export(folder, one, name, "--ini", folder / f"{name}.ini")
        text = (folder / name / "joints.ini").read_text()
        found = re.findall(r"^(?:MIN|MAX)_LIMIT = (\S+)", text, re.M)
        limits.append(np.array(found, dtype=float).reshape(3, 2))
    page = " ".join((folder / "narrow/README.md").read_text().split())
    assert "They contain the narrower limits of your INI file." in page
    change = limits[1] - limits[0]
    assert limits[0][1] == pytest.approx((120.0, 390.0), abs=1.0)
    offset = limits[0][1, 0] - 120.0
    export(folder, one, "none", "--home-offset", "352.5,340,-3.25")
    page = " ".join((folder / "none/README.md").read_text().split())
    assert float(re.search(r"change by: .* JOINT_1 (\S+) mm", page)[1]) == pytest.approx(offset)
    assert limits[1][1, 0] == pytest.approx(160.0 + offset, abs=1e-3)
    change[1, 0] = 0.0
    assert not change.any()


def test_the_assumed_direction_of_a_single_joint_is_named(folder, one, plain):
    """If it is positive by assumption, the other number is beside it; an option states it."""
    done = export(folder, one, "default", "--home-offset", "352.5,340,-3.25")
    assert "Assumed: HOME_LATCH_VEL of all joints is positive. " in done.stderr
    text = plain.read_text().replace("HOME_LATCH_VEL = 0.5", "")
    (folder / "partial.ini").write_text(text)
    done = export(folder, one, "assumed", "--ini", "partial.ini")
    note = " ".join(done.stderr.split())
    assert "Assumed: HOME_LATCH_VEL of JOINT_2 is positive (partial.ini does not state" in note
    assert "--ini FILE" not in note
    assert "The sign + of JOINT_2 is assumed" in (folder / "assumed/README.md").read_text()
    path = folder / "assumed/joints.ini"
    assert read_controller_joints(path, load_calibration(one).robot).latched == (0, 0, 0)
    lines = path.read_text()
    assert lines.count("# if HOME_LATCH_VEL of this joint is negative: HOME_OFFSET") == 1
    done = export(folder, one, "stated", "--ini", "partial.ini", "--latched=-,+,-")
    assert "Assumed" not in done.stderr
    stated = (folder / "stated/joints.ini").read_text()
    (other,) = re.findall(r"negative: (HOME_OFFSET = .*)", lines)
    assert re.findall(r"(?m)^HOME_OFFSET = .*", stated)[2] == other
    done = export(folder, one, "against", "--ini", "partial.ini", "--latched=+,+,-", code=2)
    assert "--latched: contradicts the HOME_LATCH_VEL of JOINT_0" in done.stderr


def test_again_states_the_backlash_of_the_file(folder, one, plain):
    export(folder, one, "home", "--ini", plain)
    ini = folder / "home/joints.ini"
    done = again(folder, one, "second", "--ini", ini)
    second, result = load_plan(folder / "second"), load_calibration(one)
    entered = [trim.backlash for trim in second.compensation]
    identified = [result.errors[f"{d.name}.backlash"] for d in second.robot.drives]
    assert entered == pytest.approx(np.round(identified, 6), abs=1e-12)
    assert "x_slide" in done.stdout.partition("compensates this backlash")[2]
    assert "instead of" not in done.stderr
    assert f"The lines of {ini} contain them: enter these lines" in done.stdout
    assert "as HOME_OFFSET" not in done.stdout
    # a controller that does not compensate it
    assert "what it compensates, 0 for none, and its HOME_OFFSET" in " ".join(done.stdout.split())
    file = folder / "second/session.yaml"
    file.write_text(re.sub(r"backlash_mm: \[.*?\]", "backlash_mm: [0, 0, 0]", file.read_text()))
    assert [trim.backlash for trim in load_plan(file.parent).compensation] == [0.0] * 3


def program_joints(folder):
    """Joints on the straight lines of the programs, by the closed form, shape (n, 3), [mm]."""
    rows = []
    for program in folder.glob("*.ngc"):
        words = re.findall(r"(?m)^G53 G1 X(\S+) Y(\S+) Z(\S+)", program.read_text())
        points = np.array([np.zeros(3), *np.array(words, dtype=float)])
        share = np.linspace(0.0, 1.0, 200)[:, None]
        for start, end in pairwise(points):
            rows.append(inverse((start + share * (end - start)) * MM, length=LEG) / MM)
    return np.concatenate(rows)


def test_again_names_motions_beyond_the_soft_limits_of_the_file(folder, one, plain):
    """Also those of an approach: the posture itself may be within the limits."""
    again(folder, one, "free", "--ini", plain)
    joints = program_joints(folder / "free")
    highest, lowest = joints[:, 1].max(), joints[:, 1].min()
    for excess in (-0.01, 0.01):
        own = f"[JOINT_1]\nMIN_LIMIT = {lowest + excess}\nMAX_LIMIT = {highest - excess}\n"
        (folder / "narrow.ini").write_text(plain.read_text().replace("[JOINT_1]\n", own))
        out = "beyond" if excess > 0 else "within"
        done = again(folder, one, out, "--ini", "narrow.ini")
        assert ("narrow.ini: the controller refuses" in done.stderr) == (excess > 0)
    named = re.findall(
        r"JOINT_(\d) \((\w+)\), (M.._LIMIT) (\S+) mm: (.*) reaches (\S+) mm", done.stderr
    )
    assert [(n, drive, key) for n, drive, key, *_ in named] == [
        ("1", "y_slide", "MIN_LIMIT"),
        ("1", "y_slide", "MAX_LIMIT"),
    ]
    numbers = np.array([[float(limit), float(reached)] for *_, limit, _, reached in named])
    expected = np.array([[lowest + 0.01, lowest], [highest - 0.01, highest]])
    assert numbers == pytest.approx(expected, abs=1e-3)
    rows = (folder / "beyond/readings.csv").read_text().splitlines()
    setups = {row.partition(",")[0] for row in rows}
    assert all(place.partition(" ")[0] in setups for *_, place, _ in named)


def test_again_says_what_differs_in_the_file_of_another_calibration(folder, one, plain):
    """HOME_OFFSET by the comment of exported lines, BACKLASH by its values."""
    export(folder, one, "home", "--ini", plain)
    lines = (folder / "home/joints.ini").read_text()
    (stated,) = re.findall(r"(?m)^# controller: \{offsets_mm: \[(\S+), .*\]\}$", lines)
    (backlash, *_) = re.findall(r"(?m)^BACKLASH = (\S+)$", lines)
    other = f"{float(stated) + 0.1:.6g}"
    (folder / "other.ini").write_text(lines.replace(f"[{stated},", f"[{other},"))
    done = again(folder, one, "second", "--ini", "other.ini")
    text = " ".join(done.stderr.split())
    assert f"x_slide {float(other):+.3f} mm instead of {float(stated):+.3f} mm" in text
    assert "y_slide" not in text
    assert "JOINT_" not in text
    done = again(folder, one, "third", "--ini", "plain.ini")
    text = " ".join(done.stderr.split())
    expected = f"JOINT_0 has BACKLASH 0 or none instead of BACKLASH {float(backlash):.3f} mm"
    assert expected in text
    assert len(re.findall(r"JOINT_\d has", text)) == 3
    assert "other offsets" not in text  # an INI file states none


def test_again_states_the_tables_of_the_file(folder, one):
    """The tables are copied beside the new session."""
    done = again(folder, one, "second", "--ini", "machine.ini")
    first, _, last = load_plan(folder / "second").compensation
    assert first.backlash == pytest.approx(0.031 * MM)
    expected = np.array([[0.0, 0.01, -0.02], [100.0, 0.03, -0.04]]) * MM
    assert last.table == pytest.approx(expected, abs=1e-12)
    assert "z_slide by a table" in done.stdout


def test_again_without_the_file_states_the_backlash_of_the_answer(folder, one):
    """What `calibrate` says to enter is what the next session is read with."""
    done = again(folder, one, "second")
    second = load_plan(folder / "second")
    entries = load_calibration(one).assessment.backlash
    assert any(e.change for e in entries)
    stated = [trim.backlash for trim in second.compensation]
    assert stated == pytest.approx([e.active + e.change for e in entries], abs=5e-7)
    export = f"`orthocal export {one} --to linuxcnc --offsets --ini FILE --out DIRECTORY`"
    assert f"Do not type them as HOME_OFFSET: {export} writes" in done.stdout
    assert "x_slide" in done.stdout.partition("compensates this backlash")[2]


def test_home_offsets_are_written_and_read(folder, orthoglide):
    plan = load_plan(write_plan(folder / "plan", effects="backlash: {}"))
    trims = read_controller_joints(folder / "machine.ini", orthoglide).compensation
    write_session(replace(plan, compensation=trims), folder / "written")
    controller = yaml.safe_load((folder / "written/session.yaml").read_text())["controller"]
    assert controller["home_offset_mm"] == list(HOMES)
    run(folder, "sheet", "written")
    sheet = (folder / "written/sheet.html").read_text()
    assert "HOME_OFFSET is as session.yaml states: x_slide 352.5 mm, y_slide 340.0 mm" in sheet
    read = load_plan(folder / "written").compensation
    assert np.array(home_positions(read)) / MM == pytest.approx(HOMES)
    assert compensates_alike(read, trims)


def test_export_begins_with_the_home_offsets_of_the_session(folder, at_home, plain):
    for name, words in (("session", ["--latched=-,+,+"]), ("file", ["--ini", plain])):
        export(folder, at_home, name, *words)
    texts = [(folder / name / "joints.ini").read_text() for name in ("session", "file")]
    entered = [re.findall(r"(?m)^HOME_OFFSET = .*", text) for text in texts]
    assert entered[0] == entered[1]
    assert len(entered[0]) == 3


def test_the_next_commands_of_linuxcnc_export_first(one, at_home):
    """If the session states HOME_OFFSET; the new session is that of the exported lines."""
    for path, linuxcnc in ((one, False), (at_home, True)):
        answer = to_text(render_answer(load_calibration(path), saved=path))
        export = f"  orthocal export {path} --to linuxcnc --offsets --ini FILE --out {path}-home\n"
        again = f"  orthocal again {path} --ini {path}-home/joints.ini --out "
        assert (export + again in answer) == linuxcnc
        assert (f"  orthocal again {path} --out " in answer) != linuxcnc


def test_offsets_are_not_entered_twice(folder, at_home, plain):
    export(folder, at_home, "home", "--ini", plain)
    lines = (folder / "home/joints.ini").read_text()
    new = re.search(r"(?m)^HOME_OFFSET = (\S+)", lines)[1]
    entered = re.sub("BACKLASH = .*", "", with_lines(plain.read_text(), lines))
    (folder / "entered.ini").write_text(entered)
    for name, words in (
        ("entered.ini", ["--ini", "entered.ini"]),
        ("--home-offset", ["--home-offset", f"{new},340,-3.25"]),
    ):
        done = export(folder, at_home, "twice", *words, code=2)
        message = " ".join(done.stderr.split())
        assert f"{name}: has other HOME_OFFSET" in message
        expected = f"JOINT_0 has HOME_OFFSET {float(new):.4f} mm instead of 352.5000 mm"
        assert expected in message
        assert not (folder / "twice").exists()


@pytest.mark.usefixtures("quick_plans", "without_sensor_gains")
def test_plans_keep_the_home_offsets_of_their_offsets(folder, at_home, plain):
    """Offsets that were entered since the session was measured would be entered twice."""
    write_session(restore_session(load_calibration(at_home)), folder / "first")
    (folder / "moved.ini").write_text(plain.read_text().replace("340", "340.5"))
    words = ("plan", "first", "--add", "1", "--out", "second")
    planned = run(folder, *words, "--ini", "moved.ini")
    stated = home_positions(load_plan(folder / "second").compensation)
    assert np.array(stated) / MM == pytest.approx(HOMES)
    moved, same = (
        run_orthocal(folder, "sheet", "second", "--force", "--ini", ini)
        for ini in ("moved.ini", plain)
    )
    expected = "JOINT_1 has HOME_OFFSET 340.5000 mm instead of 340.0000 mm."
    found = [expected in " ".join(done.stderr.split()) for done in (planned, moved, same)]
    assert found == [True, True, False]


def test_again_compares_home_offsets(folder, at_home, plain):
    """With those that the calibration says to enter."""
    export(folder, at_home, "home", "--ini", plain)
    lines = (folder / "home/joints.ini").read_text()
    (folder / "entered.ini").write_text(with_lines(plain.read_text(), lines))
    found = [float(v) for v in re.findall(r"(?m)^HOME_OFFSET = (\S+)", lines)]
    for k, ini in enumerate(("entered.ini", "home/joints.ini")):  # the latter has a comment on it
        done = again(folder, at_home, f"second-{k}", "--ini", ini)
        assert f"The lines of {ini} contain them" in " ".join(done.stdout.split())
        assert "instead of" not in done.stderr
        stated = home_positions(load_plan(folder / f"second-{k}").compensation)
        assert np.array(stated) / MM == pytest.approx(found)
    # a line that was not entered
    entered = (folder / "entered.ini").read_text()
    (folder / "partly.ini").write_text(re.sub("BACKLASH = .*\n", "", entered, count=1))
    done = again(folder, at_home, "partly", "--ini", "partly.ini")
    text = " ".join(done.stderr.split())
    assert "says to enter, but JOINT_0 has BACKLASH 0 or none instead of BACKLASH 0." in text
    assert "has HOME_OFFSET 3" not in text
    assert home_positions(load_plan(folder / "partly").compensation) is None
    # one wrong number, whatever the comment states
    (folder / "wrong.ini").write_text(re.sub("(HOME_OFFSET = )3", r"\g<1>9", lines, count=1))
    result = load_calibration(at_home)
    change = result.robot.drives[0].direction * round(result.assessment.entries[0].enter, 6)
    own = HOMES[0] + change / MM  # without BACKLASH
    for ini, number in (("wrong.ini", found[0]), (plain, own)):
        done = again(folder, at_home, "x", "--force", "--ini", ini)
        assert "The lines of" not in done.stdout
        text = " ".join(done.stderr.split())
        assert "does not have the offsets that the new session states. With its" in text
        place = r"JOINT_0 has HOME_OFFSET \S+ mm instead of (\S+ mm, or )?"
        assert re.search(rf"{place}{number:.4f} mm", text)
        assert "measure with these lines" not in text
        assert home_positions(load_plan(folder / "x").compensation) is None


def test_home_offsets_to_enter_depend_on_the_backlash_of_the_file(folder, at_home, plain):
    """HOME_OFFSET contains half of BACKLASH: other BACKLASH, other numbers for the same offsets."""
    result, text = load_calibration(at_home), plain.read_text()
    for home, drive, entry in zip(
        HOMES, result.robot.drives, result.assessment.entries, strict=True
    ):
        new = home + drive.direction * entry.enter / MM
        text = text.replace(f"HOME_OFFSET = {home:g}", f"HOME_OFFSET = {new:.4f}")
    (folder / "own.ini").write_text(text)
    done = again(folder, at_home, "second", "--ini", "own.ini")
    assert "The lines of own.ini contain them" in " ".join(done.stdout.split())
    assert "HOME_OFFSET" not in done.stderr
    assert "BACKLASH 0 or none instead of" in " ".join(done.stderr.split())
    assert home_positions(load_plan(folder / "second").compensation) is not None


def test_again_states_home_offsets_that_it_knows(folder, at_home):
    """Half of a changed backlash has the sign of HOME_LATCH_VEL, which only a file states."""
    result = load_calibration(at_home)
    done = again(folder, at_home, "second")
    assert "To compare HOME_OFFSET, add --ini" in done.stderr
    assert home_positions(load_plan(folder / "second").compensation) is None
    trims = with_homes([JointTrim(e.enter) for e in find_backlash(result)], np.array(HOMES) * MM)
    known = replace(result, session=replace(result.session, compensation=trims))
    possible = entered_lines.expected_homes(known, trims, None)
    changes = [
        e.enter * d.direction
        for e, d in zip(result.assessment.entries, result.robot.drives, strict=True)
    ]
    rounded = np.array(HOMES) * MM + np.round(changes, 6)
    assert possible[:, 0] == pytest.approx(rounded, abs=1e-12)
    assert possible.shape == (3, 1)


def test_small_differences_are_shown_with_all_their_decimals(fivebar, monkeypatch):
    """5 µrad are 0.0002865 degrees."""
    monkeypatch.setattr(entered_lines, "_pair_trims", lambda *_: [])
    monkeypatch.setattr(entered_lines, "expected_homes", lambda *_: None)
    entered = np.radians([0.1, 0.2])
    stated = (entered + np.array([5e-6, 0.0])).tolist()
    text = entered_lines.describe_other_lines(
        SimpleNamespace(robot=fivebar), (), stated, entered=entered, file="joints.ini"
    )
    drive = fivebar.drives[0]
    assert f"{drive.name} +0.1002865 deg instead of +0.1000000 deg." in text
    pair = (drive, JointTrim(1.0e-3 * DEG), JointTrim(1.1e-3 * DEG))
    text = entered_lines.compare_joints([pair])
    assert text == "JOINT_0 has BACKLASH 0.0011000 deg instead of BACKLASH 0.0010000 deg"


def test_latching_is_positive_by_default_and_said_to_be(folder, one, plain):
    home = ["--home-offset", "352.5,340,-3.25"]
    default = export(folder, one, "default", *home)
    assert "Assumed: HOME_LATCH_VEL of all joints is positive. " in default.stderr
    lines = [v for v in plain.read_text().splitlines() if not v.startswith("HOME_LATCH_VEL")]
    (folder / "unlatched.ini").write_text("\n".join(lines))
    by_file = export(folder, one, "unlatched", "--ini", folder / "unlatched.ini")
    assert "unlatched.ini does not state it" in by_file.stderr
    assert "--ini" not in by_file.stderr
    stated = export(folder, one, "stated", *home, "--latched", "+,+,+")
    assert "Assumed" not in stated.stderr
    texts = [(folder / name / "joints.ini").read_text() for name in ("default", "stated")]
    entered = [re.findall(r"^HOME_OFFSET = (\S+)", text, re.M) for text in texts]
    assert entered[0] == entered[1]
    assert len(entered[0]) == 3
