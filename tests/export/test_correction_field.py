"""Correction field and corrected programs, compared with the calibrated machine."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from calibrated import SOUND
from commands import run_orthocal
from programs import distances, read_polyline, rigid_motion

from orthocal import ExportError, calibrate, draw_errors, write_calibration
from orthocal.assessment.assess import assessment_of
from orthocal.assessment.controller_entries import entered_offsets, offsets_to_enter
from orthocal.export.correction_field import CorrectionField
from orthocal.gcode.interpreter import Interpreter
from orthocal.gcode.program import ProgramCorrector
from orthocal.kinematics.loop_closure import LoopClosure, nominal_closure
from orthocal.kinematics.workspace import box_workspace, cube

WITHIN = 1e-6


@pytest.fixture(scope="module")
def real(orthoglide):
    """A machine with all errors drawn from their priors, and offsets."""
    errors = draw_errors(orthoglide, ["*", "!*.offset"], seed=3)
    errors |= {"x_slide.offset": 1.2e-3, "y_slide.offset": -0.8e-3, "z_slide.offset": 0.5e-3}
    return SimpleNamespace(robot=orthoglide, errors=errors, displacement=np.zeros_like)


OFFSETS = np.array([1.1e-3, -0.7e-3, 0.6e-3])


@pytest.fixture(scope="module")
def field(real):
    return CorrectionField(real, OFFSETS, within=WITHIN)


def test_error_of_the_field_is_within_its_estimate(real, field):
    """On the real machine, at random points."""
    points = np.random.default_rng(1).uniform(-0.06, 0.06, (300, 3))
    sent, refused = field(points)
    assert not refused
    machine, nominal = LoopClosure(real.robot, fixed=real.errors), nominal_closure(real.robot)
    reached = machine.forward(nominal.inverse(sent) - OFFSETS)
    off = np.linalg.norm(reached - points, axis=1).max()
    assert off < 1.05 * field.error < 0.1 * WITHIN  # commanded and reached differ by a percent
    assert np.abs(sent - points).max() > 100e-6


@pytest.mark.parametrize("tool", [(0.0, 0.0, 0.0), (0.02, -0.005, -0.08)])
def test_aligned_corrections_keep_the_work_zero_and_the_form_of_the_part(real, tool):
    """The corrected tool is moved by the best-fit rigid motion of the uncorrected machine.

    The motion by the closed form of Kabsch, tips by Pinocchio.
    """
    workspace = cube(real.robot)
    field = CorrectionField(real, OFFSETS, within=WITHIN, tool=tool, aligned_over=workspace)
    points, weights, nominal = workspace.points, workspace.weights, nominal_closure(real.robot)

    def move(commanded):
        return tips(real.robot, real.errors, nominal.inverse(commanded) - OFFSETS, np.array(tool))

    targets, jogged = points + tool, move(points)
    rotation, translation = rigid_motion(targets, jogged, weights)
    corrected, refused = field(points)
    assert not refused
    expected = targets @ rotation.T + translation
    off = np.linalg.norm(move(corrected) - expected, axis=1).max()
    assert off < 1.05 * field.error < 0.1 * WITHIN
    assert np.linalg.norm(translation) > 50e-6
    assert np.abs(rotation - np.eye(3)).max() > 1e-4
    # motions with and without correction differ by the tool error of an aligned workpiece
    difference = np.sqrt(weights @ ((corrected - points) ** 2).sum(axis=1))
    aligned = np.sqrt(weights @ ((jogged - expected) ** 2).sum(axis=1))
    assert difference == pytest.approx(aligned, rel=0.02)


def test_line_that_leaves_the_workspace_is_refused_at_the_first_point(field):
    t = np.linspace(0.0, 1.0, 40)[:, None]
    points = t * np.array([0.09, 0.05, 0.02])
    sent, refused = field(points)
    expected, truth = field.exactly(points)
    assert 0 < min(refused) == min(truth)
    assert refused[min(truth)] == truth[min(truth)]
    assert "outside its limits" in truth[min(truth)]
    assert all(sent[i].tolist() != sent[i].tolist() for i in refused)
    good = [i for i in range(40) if i not in refused]
    assert np.linalg.norm(sent[good] - expected[good], axis=1).max() < field.error


def test_first_point_out_of_reach_is_named_in_any_order(real):
    """With boxes of exact corrections, both before and after they are made."""
    field = CorrectionField(real, OFFSETS, within=WITHIN)
    field._make = lambda key: "exact"
    field.exactly = lambda p: (
        np.where(p > 0.1, np.nan, p + 1e-3),
        {int(i): f"{p[i][0]}" for i in np.flatnonzero((p > 0.1).any(axis=1))},
    )
    for seed in range(30):
        rng = np.random.default_rng(seed)
        field._boxes.clear()
        points = rng.uniform(-0.3, 0.11, (rng.integers(1, 200), 3))
        truth = np.flatnonzero((points > 0.1).any(axis=1))
        for _ in range(2):  # boxes exist in the second pass
            sent, refused = field(points)
            first = min(truth, default=len(points))
            assert sorted(refused) == list(range(first, len(points)))
            assert refused.get(first) in (None, f"{points[first][0]}" if len(truth) else None)
            assert sent[:first] == pytest.approx(points[:first] + 1e-3)
            assert np.isnan(sent[first:]).all()


TOOL = np.array([20.0, -5.0, -80.0]) * 1e-3


def tips(robot, errors, drives, tool):
    """Tips by Pinocchio, with loops closed by Pinocchio."""
    real = robot.with_errors(errors)
    data, passive, points = real.model.createData(), real.reference_passive, []
    for row in drives:
        passive = real.close_with_pinocchio(row, passive)
        q = real.configuration(real.joint_coordinates(row, passive))
        pin.framesForwardKinematics(real.model, data, q)
        points.append(data.oMf[real.frame_id(real.tcp.frame)].act(tool))
    return np.array(points)


def correct(field, *text):
    """Corrected lines of a program."""
    interpreter = Interpreter(axes=field.axes, offsets={})
    corrector = ProgramCorrector(interpreter, field, file="p.ngc", within=WITHIN)
    return "".join(corrector.run(f"{line}\n" for line in text)).splitlines()


def test_tip_of_a_tool_follows_the_program(real, field):
    """Dense samples through a nominal controller and Pinocchio's real machine."""
    tilted = CorrectionField(real, OFFSETS, within=WITHIN, tool=tuple(TOOL))
    begin, corner, end = np.array([[-30, -20, 5], [30, 10, -10], [5, 40, 20]]) * 1e-3
    lines = correct(tilted, "G21 G0 X-30 Y-20 Z5", "N1 G1 X30 Y10 Z-10 F500", "N2 X5 Y40 Z20")
    pieces = read_polyline(lines)
    ends = [p for number in sorted(pieces) for p, _ in pieces[number]]
    dense = np.array([a + s * (b - a) for a, b in pairwise(ends) for s in (0.0, 0.3, 0.5, 0.8)])
    sent = nominal_closure(real.robot).inverse(dense * 1e-3) - OFFSETS
    reached = tips(real.robot, real.errors, sent, TOOL) - TOOL
    off = [distances(reached, np.array(line)) for line in ((begin, corner), (corner, end))]
    assert np.min(off, axis=0).max() < 1.02 * WITHIN
    points = np.array([begin, corner, end])
    difference = np.linalg.norm(tilted(points)[0] - field(points)[0], axis=1)
    assert difference.min() > 20e-6  # error without the tool


def test_points_out_of_reach_with_a_tool(real):
    tilted = CorrectionField(real, OFFSETS, within=WITHIN, tool=tuple(TOOL))
    points = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.01, 0.02, 0.03], [np.nan, 0.0, 0.0]])
    sent, refused = tilted.exactly(points)
    assert sorted(refused) == [1, 3]
    assert "cannot be reached" in refused[1]
    assert "not numbers" in refused[3]
    for i in (0, 2):
        assert sent[i].tolist() == pytest.approx(tilted.exactly(points[[i]])[0][0], abs=1e-11)
    many = np.vstack([np.zeros((1001, 3)), points])
    assert sorted(tilted.exactly(many)[1]) == [1002, 1004]


def test_real_tool_follows_an_arc(real, field):
    """Including points of a nominal controller between the commanded ones."""
    lines = correct(field, "G21 G0 X30 Y10 Z-10", "N2 G3 X10 Y30 I-20 J0 F500")
    ends = np.array([p for number in (0, 2) for p, _ in read_polyline(lines)[number]])
    machine, nominal = LoopClosure(real.robot, fixed=real.errors), nominal_closure(real.robot)
    chosen, share = np.arange(0, len(ends) - 1, len(ends) // 12), np.linspace(0.25, 1.0, 4)
    between = np.vstack(
        [
            a + s * (b - a)
            for a, b in zip(ends[chosen], ends[chosen + 1], strict=True)
            for s in share
        ]
    )
    tool = 1e3 * machine.forward(nominal.inverse(between * 1e-3) - OFFSETS)
    flat = np.hypot(tool[:, 0] - 10.0, tool[:, 1] - 10.0) - 20.0
    off = np.hypot(flat, tool[:, 2] + 10.0)
    assert 0.5e-3 < off.max() < 1.02e-3  # [mm]; an arc uses its tolerance


def test_planar_robots_and_robots_without_a_tool(biglide, orthoglide):
    drives = [d.name for d in biglide.drives]
    machine = SimpleNamespace(
        robot=biglide, errors={f"{drives[0]}.offset": 1e-3}, displacement=np.zeros_like
    )
    field = CorrectionField(machine, np.zeros(2), within=WITHIN)
    middle = nominal_closure(biglide).forward(biglide.drive_zero)
    points = middle + np.random.default_rng(0).uniform(-5e-3, 5e-3, (50, 3))
    sent, refused = field(points)
    other = [k for k in range(3) if k not in field.axes]
    assert not refused
    assert (sent[:, other] == points[:, other]).all()
    chosen = list(field.axes)
    expected, _ = field.exactly(points[:, chosen])
    assert np.abs(sent[:, chosen] - expected).max() < field.error
    with pytest.raises(ExportError, match="has no tool that its drives command"):
        CorrectionField(
            SimpleNamespace(robot=SimpleNamespace(tcp=None), errors={}, displacement=None),
            OFFSETS,
            within=WITHIN,
        )


@pytest.fixture(scope="module")
def calibration(experiment_2):
    return calibrate(experiment_2, judgement=SOUND)


@pytest.fixture
def command(calibration, tmp_path):
    write_calibration(calibration, tmp_path / "calibration.json")

    def run(text, *words, typed=""):
        source = "-" if text is None else tmp_path / "p.ngc"
        if text is not None:
            source.write_bytes(text.encode("latin-1"))
        done = run_orthocal(tmp_path, "correct", tmp_path, source, *words, typed=typed)
        return done.returncode, done.stdout, done.stderr.replace(str(tmp_path), "")

    run.calibration = calibration
    return run


PROGRAM = "G21 G0 X1 Y2 Z3\r\nG1 X5 F100 (\xe9)\r\n"


def test_command_line(command, tmp_path):
    """Offsets alone need a correction until they are entered; then rounding alone remains."""
    machine = command.calibration
    workspace = box_workspace(machine.robot, assessment_of(machine).tool.box)

    def expected(point, offsets):
        field = CorrectionField(machine, offsets, within=WITHIN, aligned_over=workspace)
        return field.exactly(np.array([point]) * 1e-3)[0][0] * 1e3

    code, out, err = command(PROGRAM)
    assert code == 0
    assert out.endswith("F100 (?)\r\n")  # not longer than in Latin-1, as LinuxCNC counts bytes
    *comments, first = out.splitlines()[:3]
    assert all(line.startswith("; ") for line in comments)
    found = re.fullmatch(r"G21 G0 X(\S+) Y(\S+) Z(\S+)", first)
    rounded = expected([1.0, 2.0, 3.0], offsets_to_enter(machine))
    assert [float(v) for v in found.groups()] == pytest.approx(rounded, abs=1e-4)
    assert "Largest correction: 0.000 mm." in err
    assert "For a controller with the offsets to enter: x_slide -0.5" in err
    assert "The program's coordinates are read as machine coordinates." in err
    code, out, err = command(PROGRAM, "--offsets", "active", "--work-offset-mm", "10,0,-5")
    assert code == 0
    assert "active during the measurement: x_slide +0.000 mm" in err
    got = read_polyline(out.splitlines())[0][0][0] + [10.0, 0.0, -5.0]
    corrected = expected([11.0, 2.0, -2.0], np.zeros(3))
    assert got == pytest.approx(corrected, abs=1e-4)
    assert np.abs(corrected - [11.0, 2.0, -2.0]).max() > 0.01
    assert np.abs(entered_offsets(machine)).max() > 1e-4
    session = replace(machine.session, controller_origin=(0.01, 0.0, -0.005))
    write_calibration(replace(machine, session=session), tmp_path / "calibration.json")
    code, out, _ = command(PROGRAM, "--offsets", "active")
    got = read_polyline(out.splitlines())[0][0][0] - [10.0, 0.0, -5.0]
    assert got == pytest.approx(expected([-9.0, 2.0, 8.0], np.zeros(3)), abs=1e-4)
    code, out, _ = command(PROGRAM, "--offsets", "active", "--work-offset-mm", "20,0,0")
    got = read_polyline(out.splitlines())[0][0][0] + [10.0, 0.0, 5.0]
    assert got == pytest.approx(expected([11.0, 2.0, 8.0], np.zeros(3)), abs=1e-4)
    code, _, err = command(PROGRAM, "--out", str(tmp_path / "o.ngc"), "--tool=-3,0,-50.5")
    assert "For a tip at -3, 0, -50.5 mm from the tool centre point." in err
    assert (tmp_path / "o.ngc").read_bytes().endswith(b"F100 (\xe9)\r\n")
    assert command(None, typed=PROGRAM)[0] == 0


def test_a_work_zero_that_is_not_the_first_is_noted(command):
    text = PROGRAM + "G55 G0 X1 Y2 Z3\r\n"
    code, _, err = command(text, "--work-offset-mm", "G55=10,10,0")
    assert code == 0
    assert "Coordinates before the first stated work zero are machine coordinates." in err


def test_several_tools_without_a_tip_are_reported(command):
    code, _, err = command("T1 M6\n" + PROGRAM + "T2 M6\nG0 X1 Y2 Z3\nG1 X6\n")
    assert code == 0
    assert "Several tools (T1, T2) and no --tool" in err
    assert "Several tools" not in command("T1 M6\n" + PROGRAM)[2]


def test_line_that_is_too_long_in_bytes_is_not_read_as_two(command):
    """The text after the longest line is a comment, not a motion."""
    line = "X1" + " " * 900 + "Y2 ;" + "é" * 48 + "G91 G0 X5\n"
    assert len(line[:-9].encode()) == 1003 > 1000 > len(line)
    code, out, err = command(None, typed="G21 G0 X1 Y2 Z3\n" + line)
    assert (code, out) == (2, "")
    assert err.startswith("orthocal: standard input:2: has 1002 characters; expected at most 1000")


@pytest.mark.parametrize(
    ("text", "words", "message"),
    [
        ("", (), "/p.ngc: is empty; expected a program"),
        (PROGRAM + "G1 X300", (), "/p.ngc:3: the machine cannot make this motion: X81"),
        (PROGRAM + "G54", (), "/p.ngc:3: found G54, whose zero in machine coordinates is not"),
        (
            "T1 M6\n" + PROGRAM + "T2 M6\n",
            ("--tool", "0,0,-50"),
            "/p.ngc:4: found T2 after motions of T1, and --tool states one tip; expected one tool",
        ),
        (
            PROGRAM,
            ("--work-offset-mm", "1,2"),
            "--work-offset-mm: found '1,2'; expected 3 numbers, X,Y,Z",
        ),
        (PROGRAM, ("--work-offset-mm", "G53=1,2,3"), "--work-offset-mm: found 'G53=1,2,3'"),
        (PROGRAM, ("--tool", "1,2"), "--tool: found '1,2'; expected 3 numbers, X,Y,Z"),
        (PROGRAM, ("--tool", "0,0,-1e6"), "--tool: found 0, 0, -1e+06 mm; expected numbers of at"),
        (PROGRAM, ("--start-mm", "1,2,q"), "--start-mm: Z is 'q'; expected a number"),
    ],
)
def test_refused_programs_write_nothing(command, tmp_path, text, words, message):
    code, out, err = command(text, *words, "--out", str(tmp_path / "o.ngc"))
    assert (code, out) == (2, "")
    assert err.startswith(f"orthocal: {message}")
    assert err.count("\n") == 1
    assert not (tmp_path / "o.ngc").exists()
