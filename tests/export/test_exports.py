"""Exported tables, parameters and URDFs, compared with the calibrated machine."""

from __future__ import annotations

import csv
import hashlib
import io
import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from calibrated import EXPERIMENT_2, UNJUDGED, calibrated
from commands import run_orthocal
from effect_plans import effect_plan

from orthocal import (
    ExportError,
    ExportOptions,
    ParameterError,
    calibrate,
    export_calibration,
    load_plan,
    load_robot,
    load_session,
    simulate_session,
    write_calibration,
)
from orthocal.assessment.controller_entries import entered_offsets
from orthocal.assessment.wording import MOST_ACTIONS, describe_actions, review
from orthocal.calibration.assessment_record import Assessment, Decision, Place
from orthocal.cli.correct import _with_comments
from orthocal.export.urdf import _correct_origins, _find_twists
from orthocal.io.files import write_files
from orthocal.kinematics.loop_closure import LoopClosure, nominal_closure
from orthocal.observation.simulate import load_errors
from orthocal.robot.parameters import ElementaryError

ROUNDED = 0.5e-9 * np.sqrt(3.0) * 1.5
"""Rounding of corrections to 1e-6 mm, [m]."""


@pytest.fixture(scope="module")
def full():
    return calibrated("sweep", "full", **UNJUDGED)


@pytest.fixture(scope="module")
def turned(root):
    """A machine whose setup zy was read with the wrong sign: to be reviewed."""
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    truth = {"x_slide.offset": 1.2e-3, "y_slide.offset": -0.8e-3, "z_slide.offset": 0.5e-3}
    session = simulate_session(plan, truth, seed=1).session
    rows = [replace(r, value=-r.value) if r.setup == "zy" else r for r in session.readings]
    return calibrate(replace(session, readings=tuple(rows)), solver="variable-projection")


def test_corrections_bring_the_tool_to_its_targets(full):
    """On the calibrated machine; without them the errors are tenths of a millimetre."""
    text = export_calibration(full, "table")["corrections.csv"]
    rows = list(csv.DictReader(io.StringIO(text)))
    point, change = (
        np.array([[float(r[f"{d}{k}_mm"]) for k in "xyz"] for r in rows]) * 1e-3 for d in ("", "d")
    )
    assert len(rows) == 343
    nominal, real = nominal_closure(full.robot), LoopClosure(full.robot, fixed=full.errors)
    offsets = entered_offsets(full)
    reached = real.forward(nominal.inverse(point + change) - offsets)
    assert np.abs(reached - point).max() < ROUNDED
    uncorrected = real.forward(nominal.inverse(point) - offsets)
    assert np.abs(uncorrected - point).max() > 50e-6


def test_the_parameters_say_what_their_offsets_are(full):
    """Without stated active offsets the values are changes, not offsets to enter."""
    unstated = replace(full, session=replace(full.session, controller_offsets=None))
    texts = [export_calibration(c, "yaml", anyway=True)["errors.yaml"] for c in (full, unstated)]
    assert [("# offsets to enter:" in t, "# changes of the offsets" in t) for t in texts] == [
        (True, False),
        (False, True),
    ]
    lines = export_calibration(
        unstated, "linuxcnc", anyway=True, options=ExportOptions(module=False)
    )
    assert "# controller: {offsets" not in lines["joints.ini"]
    assert "those that were active, plus these changes" in lines["README.md"]


def test_corrections_of_offsets_alone_are_zero():
    found = calibrated(EXPERIMENT_2, **UNJUDGED)
    text = export_calibration(found, "table")["corrections.csv"]
    assert {r[f"d{k}_mm"] for r in csv.DictReader(io.StringIO(text)) for k in "xyz"} == {"0.000000"}
    assert set(export_calibration(found, "urdf")) == {"orthoglide.urdf", "orthoglide.yaml"}


def test_parameters_round_trip(full, tmp_path):
    path = tmp_path / "errors.yaml"
    path.write_text(export_calibration(full, "yaml")["errors.yaml"])
    again = load_errors(path, full.robot)
    assert again.keys() == full.errors.keys()
    for name, value in full.errors.items():
        assert again[name] == pytest.approx(value, rel=1e-11)
    assert "#   x_slide_mm: " in path.read_text()


STATED = {"yaml": "errors.yaml", "table": "README.md", "urdf": "README.md", "linuxcnc": "README.md"}
"""File of each format that states that it was written against the verdict."""


@pytest.mark.parametrize("to", STATED)
def test_against_the_verdict_nothing_is_exported_unless_asked_for_and_stated(turned, full, to):
    with pytest.raises(ExportError) as refused:
        export_calibration(turned, to)
    assert refused.value.exit_code == 3
    assert turned.assessment.decision.headline in str(refused.value)
    files = export_calibration(turned, to, anyway=True)
    assert "against the verdict 'review'" in files[STATED[to]].splitlines()[0]
    options = ExportOptions(module=False) if to == "linuxcnc" else None
    sound = export_calibration(full, to, anyway=True, options=options)
    assert "against the verdict" not in sound.get(STATED[to], "")


PROGRAM = "%\nG21 G90\nG0 X0 Y0 Z0\nG1 X10 F600\nM2\n%\n"


def test_against_the_verdict_nothing_is_written_by_command(turned, tmp_path):
    file = write_calibration(turned, tmp_path / "calibration.json")
    (tmp_path / "part.ngc").write_text(PROGRAM)
    out = tmp_path / "out"
    for words in (
        ["export", str(file), "--to", "yaml", "--out", str(out)],
        ["correct", str(file), str(tmp_path / "part.ngc"), "--out", str(out / "part.ngc")],
    ):
        refused = run_orthocal(tmp_path, *words)
        assert refused.returncode == 3
        assert turned.assessment.decision.headline in refused.stderr
        assert not out.exists()
        assert run_orthocal(tmp_path, *words, "--anyway").returncode == 0
        if words[0] == "correct":
            first, *comments = (out / "part.ngc").read_text().splitlines()[:4]
            assert first == "%"
            assert comments[-1].startswith("; Written against the verdict 'review'")
        shutil.rmtree(out)


@pytest.fixture(scope="module")
def disordered(root):
    """Calibration of two sessions, the one with active offsets given first."""
    plan = load_session(root / "examples/raw-cycles")
    plan = plan.select([r for r in plan.readings if r.cycle == 1])
    truth = {f"{d.name}.offset": 1e-3 for d in plan.robot.drives}
    sessions = [
        simulate_session(plan.with_controller([v] * 3), truth, seed=k).session
        for k, v in enumerate((0.0, 0.7e-3))
    ]
    calibration = calibrate(sessions[::-1], solver="variable-projection")
    assert [f.severity for f in calibration.assessment.of_kind("wrong order")] == ["note"]
    return calibration


def test_sessions_in_another_order_are_noted_with_the_values(disordered, root, tmp_path):
    """Their present offsets may be others, so that the written ones would count twice."""
    file = write_calibration(disordered, tmp_path / "calibration.json")
    (tmp_path / "part.ngc").write_text(PROGRAM)
    (found,) = disordered.assessment.of_kind("wrong order")
    for command, *words in (
        ("export", "--to", "linuxcnc", "--offsets"),
        ("again", "--session", str(root / "examples/raw-cycles")),
        ("correct", "part.ngc"),
    ):
        done = run_orthocal(tmp_path, command, str(file), *words, "--out", f"{command}.out")
        assert done.returncode == 0, done.stderr
        assert found.words in done.stderr
    assert found.words in (tmp_path / "export.out/README.md").read_text()


def test_a_refusal_states_every_finding_with_its_action(turned):
    """Every sentence begins with a capital, also after a list."""
    findings = [
        review("ambiguous", f"Finding {i}.", f"do {i}.", (Place(setup=f"s{i}"),)) for i in range(5)
    ]
    for count in (1, 2, 5):
        decided = Decision("review", "Check.", "Finding 0.", describe_actions(findings[:count]))
        judged = Assessment(decided, tuple(findings[:count]), (), None)
        with pytest.raises(ExportError) as refused:
            export_calibration(replace(turned, assessment=judged), "yaml")
        text = str(refused.value)
        shown = min(count, MOST_ACTIONS)
        assert all(f"Finding {i}. Do {i}." in text for i in range(shown))
        assert f"Finding {shown}." not in text
        assert text.count("Finding 0.") == 1
        assert "\\n" not in text
        assert not re.search(r"[a-z]\. +[a-z]", text)
        assert ("1. " in text) == (count > 1)


def test_a_corrected_program_is_marked_and_not_corrected_again(full, tmp_path):
    """With the calibration, the offsets and the tool, in comments that a controller skips."""
    file = write_calibration(full, tmp_path / "calibration.json")
    (tmp_path / "part.ngc").write_text(PROGRAM)
    words = ["correct", file, "part.ngc", "--tool", "0,0,-50", "--offsets", "active"]
    once = run_orthocal(tmp_path, *words)
    assert once.returncode == 0, once.stderr
    first, *comments = once.stdout.splitlines()[:4]
    digest = hashlib.sha256(file.read_bytes()).hexdigest()[:12]
    assert (first, all(c.startswith("; ") for c in comments)) == ("%", True)
    assert tmp_path.name[:60] in comments[0]
    assert digest in comments[0]
    assert "offsets active during the measurement" in comments[1]
    assert "tip at 0, 0, -50 mm" in comments[2]
    (tmp_path / "once.ngc").write_text(once.stdout)
    words[2] = "once.ngc"
    again = run_orthocal(tmp_path, *words, "--out", "twice.ngc")
    assert again.returncode == 2
    assert again.stderr.startswith("orthocal: once.ngc:2: found 'Corrected by orthocal")
    assert not (tmp_path / "twice.ngc").exists()
    assert run_orthocal(tmp_path, *words, "--anyway").returncode == 0


@pytest.mark.parametrize("name", ["a_slide_of_a_long_name", "机器的滑块一号"])
def test_comments_are_complete_in_lines_that_a_controller_reads(name):
    """LinuxCNC reads 252 bytes of a line."""
    comment = " ".join(f"{name} {k} mm." for k in range(40))
    (text,) = _with_comments(["%\nG21\n"], ["Corrected.", comment])
    first, *comments, last = text.splitlines()
    assert (first, comments[0], last) == ("%", "; Corrected.", "G21")
    assert " ".join(line.removeprefix("; ") for line in comments[1:]) == comment
    assert max(len(line.encode()) for line in comments) <= 252


def test_unknown_format_is_refused():
    with pytest.raises(ParameterError, match="found 'xml'; expected one of yaml, table"):
        export_calibration(calibrated(EXPERIMENT_2, **UNJUDGED), "xml")


def test_urdf_is_the_calibrated_machine(full, tmp_path):
    files = export_calibration(full, "urdf")
    write_files(tmp_path, files)
    robot = load_robot(tmp_path)
    scales = {r["drive"]: r["scale_ppm"] for r in csv.DictReader(io.StringIO(files["scales.csv"]))}
    gain = 1.0 + 1e-6 * np.array([float(scales[d.name]) for d in robot.drives])
    points = np.random.default_rng(0).uniform(-0.06, 0.06, (20, 3))
    drives = nominal_closure(full.robot).inverse(points)
    expected = full.machine.forward(drives)
    assert np.abs(LoopClosure(robot).forward(drives * gain) - expected).max() < 1e-9
    assert np.abs(expected - points).max() > 1e-3


def test_errors_of_effects_are_beside_the_urdf():
    truth = {"x_slide.offset": 1e-3, "x_slide.backlash": 40e-6, "z_slide.backlash": 25e-6}
    session = simulate_session(effect_plan("backlash"), truth, seed=1, sigma=3e-6).session
    calibration = calibrate(session, "offsets", **UNJUDGED)
    files = export_calibration(calibration, "urdf", anyway=True)
    rows = list(csv.DictReader(io.StringIO(files["effects.csv"])))
    expected = {n: v for n, v in calibration.errors.items() if n.endswith("backlash") and v}
    assert {r["parameter"]: float(r["value"]) for r in rows} == pytest.approx(
        {name: 1e3 * value for name, value in expected.items()}, rel=1e-9
    )
    assert {r["unit"] for r in rows} == {"mm"}
    assert len(expected) >= 2


@pytest.mark.parametrize(
    ("origin", "shape"),
    [
        ("", '<joint type="fixed" name="a">\n    <origin xyz="0.001 0 0" rpy="0 0 0"/><parent'),
        ("<!-- <origin/> --><origin/>", '<!-- <origin/> --><origin xyz="0.001 0 0"/><parent'),
        ("<origin rpy = '0 0 0' />", "<origin rpy = '0 0 0' xyz=\"0.001 0 0\" /><parent"),
        ("<origin xyz = '1 2\t3'/>", "<origin xyz = '1.001 2 3'/><parent"),
        ('<origin\n xyz="1 2\n3"></origin>', '<origin\n xyz="1.001 2 3"></origin><parent'),
        ("<a b='>'/><origin rpy='0 0 0.0'/>", "<origin rpy='0 0 0.0' xyz=\"0.001 0 0\"/><parent"),
    ],
)
def test_all_forms_of_an_origin_are_rewritten(orthoglide, origin, shape):
    text = (
        f'<robot><!-- <joint name="a" type="fixed"></joint> -->'
        f'<transmission><joint name="a" type="x"><origin/></joint></transmission>'
        f'<joint type="fixed" name="a">{origin}<parent link="b"/></joint>'
        f'<transmission><joint name="a"/></transmission></robot>'
    )
    twist = np.array([1e-3, 0, 0, 0, 0, 0])
    corrected = _correct_origins(text, {"a": [twist]}, orthoglide)
    assert shape in corrected
    assert corrected.count("<joint") == text.count("<joint")
    assert corrected.endswith('<transmission><joint name="a"/></transmission></robot>')
    with pytest.raises(ExportError, match="has no joint 'c' to correct"):
        _correct_origins(text, {"c": [twist]}, orthoglide)


def test_urdf_is_preserved_byte_for_byte_but_numbers(full, tmp_path):
    """With a byte order mark, carriage returns, single quotes, comments and foreign elements."""
    folder = tmp_path / "orthoglide"
    shutil.copytree(full.robot.folder, folder)
    urdf = folder / "orthoglide.urdf"
    text = urdf.read_text().replace('"', "'")
    text = text.replace("<origin ", "<origin  ").replace(
        "</robot>", f"{OTHERS}</robot>\n<!-- ü -->"
    )
    text = text.replace("  <link", f"{OTHERS}  <link", 1)
    urdf.write_bytes(text.replace("\n", "\r\n").encode("utf-8-sig"))
    robot = load_robot(folder)
    before = urdf.read_bytes()
    errors = robot.parameters.expand(full.errors)
    after = _correct_origins(before.decode(), _find_twists(robot, errors), robot).encode()
    numbers = re.compile(rb"(?<=xyz=')[^']*|(?<=rpy=')[^']*")
    assert after != before
    assert numbers.sub(b"", after) == numbers.sub(b"", before)
    # only numbers of joints with errors change
    changed = [
        (a, b)
        for a, b in zip(numbers.findall(after), numbers.findall(before), strict=True)
        if a != b
    ]
    assert 20 < len(changed) < 60
    assert all(a.split() != b.split() for a, b in changed)


OTHERS = """\
<gazebo reference='x_slide'>
  <!-- <joint name='x_slide' type='fixed'><origin xyz='9 9 9'/></joint> -->
  <joint name='x_slide' type='fixed'><origin xyz='8 8 8'/></joint>
</gazebo>
"""
"""Elements named joint that are not joints of the robot."""


def test_error_of_a_frame_on_a_moving_link_is_refused(orthoglide):
    error = ElementaryError(
        "frame.x_crossbar.x", "translation", "x_crossbar", "m", 1e-4, of_frame=True, axis=0
    )
    parameters = SimpleNamespace(elementary={error.name: error})
    robot = SimpleNamespace(
        parameters=parameters,
        urdf=orthoglide.urdf,
        content=orthoglide.content,
        model=orthoglide.model,
    )
    with pytest.raises(ExportError, match="is an error of a frame on a moving link"):
        _find_twists(robot, {error.name: 1e-3})
