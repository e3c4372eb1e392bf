"""Tool error in use: approach from both sides, a range of temperatures, a payload."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from commands import run_orthocal
from conftest import few_tool_points, no_sensor_gains
from effect_plans import write_plan, write_robot
from programs import read_polyline
from scipy.spatial.distance import pdist

from orthocal import (
    Choice,
    UseConditions,
    Workspace,
    assess_tool,
    load_calibration,
    load_plan,
    load_robot,
    simulate_session,
    summarize,
    write_calibration,
)
from orthocal.assessment.assess import assess
from orthocal.assessment.calibrated_tool import place_tool
from orthocal.assessment.controller_entries import entered_offsets, find_backlash
from orthocal.assessment.judgement import Judgement
from orthocal.assessment.recommendation import Recommendation
from orthocal.assessment.tool_error import assess_placed, summarise_tool
from orthocal.calibration.identify import identify
from orthocal.errors import ParameterError, RobotError
from orthocal.estimation.tolerance_scale import AS_STATED
from orthocal.kinematics.conditions import sample_use
from orthocal.kinematics.loop_closure import LoopClosure, nominal_closure
from orthocal.kinematics.workspace import box_workspace, cube_limits, tool_at_zero
from orthocal.planning.expected_error import ToolForecast
from orthocal.units import MM

EFFECTS = "backlash: {}, thermal: {}, compliance: {rod_N_per_um: 0.2, platform_kg: 3}"
USE = "use: {temperature_C: [15, 35], payload_kg: [0, 4]}"
TRUTH = {
    "x_slide.offset": 4e-4,
    "y_slide.offset": -3e-4,
    "x_slide.backlash": 30e-6,
    "y_slide.backlash": 12e-6,
    "z_slide.backlash": 40e-6,
    "legs.expansion": 1e-6,
}
MACHINES = 24
"""Sampled machines; their RMS tool error scatters by less than 8 %."""


def state_use(folder, use):
    text = (folder / "machine.yaml").read_text()
    (folder / "machine.yaml").write_text(text.replace("\n  tcp: ", f"\n  {use}\n  tcp: "))
    return folder


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    folder = write_plan(tmp_path_factory.mktemp("use") / "plan", effects=EFFECTS)
    state_use(folder / "machine", USE)
    table = (folder / "readings.csv").read_text().splitlines()
    head, *rows = (line.split(",") for line in table)
    at = head.index("temperature_C")
    rows = [[*r[:at], "20" if i % 2 else "26", *r[at + 1 :]] for i, r in enumerate(rows)]
    (folder / "readings.csv").write_text("\n".join(",".join(r) for r in (head, *rows)) + "\n")
    session = simulate_session(load_plan(folder), TRUTH, seed=4, sigma=1e-6).session
    choice = Choice("offsets", prior=True)
    identified, _ = identify(session, choice, solver="variable-projection")
    judged, recommended = Judgement((), AS_STATED), Recommendation("full", 1.0, {}, 0.0)
    with few_tool_points():
        assessment = assess(identified, judgement=judged, recommendation=recommended)
    return replace(identified, assessment=assessment)


@pytest.fixture(scope="module")
def workspace(calibration):
    robot = calibration.robot
    return box_workspace(robot, cube_limits(robot), points_per_side=3)


def with_use(calibration, **changes):
    robot = calibration.robot
    return replace(calibration, robot=replace(robot, use=replace(robot.use, **changes)))


# ---- samples


def test_samples_have_the_moments_of_the_use(calibration):
    use = sample_use(calibration.robot)
    assert use.varying == ("approach",) * 3 + ("temperature", "payload")
    assert use.size == 8
    assert np.array_equal(use.signs.T @ use.signs, 8 * np.eye(5))
    assert not use.signs.sum(axis=0).any()
    for name, (low, high) in (("temperature", (15, 35)), ("payload", (0, 4))):
        values = [getattr(c, name) for c in use.conditions]
        assert np.mean(values) == pytest.approx(0.5 * (low + high))
        assert np.std(values) == pytest.approx((high - low) / np.sqrt(12))
    for k in range(3):
        assert sorted(c.approach[k] for c in use.conditions) == ["n"] * 4 + ["p"] * 4


def test_only_conditions_of_the_effects_are_sampled(orthoglide, tmp_path):
    plain = sample_use(orthoglide)
    assert (plain.size, plain.conditions) == (1, (UseConditions(),))
    folder = state_use(write_robot(tmp_path / "machine", "backlash: {}"), "use: {approach: pun}")
    one = sample_use(load_robot(folder))
    assert [c.approach for c in one.conditions] == ["ppn", "pnn"]
    assert {c.temperature for c in one.conditions} == {None}


def test_a_machine_without_effects_is_assessed_at_each_point_once(orthoglide):
    forecast = ToolForecast(orthoglide, Choice("offsets").select(orthoglide.parameters))
    assert len(forecast.workspace.weights) == 125
    assert forecast.workspace.n_conditions == 1


@pytest.mark.parametrize(
    ("use", "key"),
    [
        ("use: {approach: one}", "approach"),
        ("use: {temperature_C: [18, 260]}", "temperature_C"),
        ("use: {temperature_C: 20}", "temperature_C"),
        ("use: {payload_kg: [-1, 2]}", "payload_kg"),
        ("use: {payload_kg: [0, 1, 2]}", "payload_kg"),
        ("use: {speed: 3}", "speed"),
    ],
)
def test_impossible_conditions_of_use_are_refused(tmp_path, use, key):
    folder = state_use(write_robot(tmp_path / "machine", "backlash: {}"), use)
    with pytest.raises(RobotError) as caught:
        load_robot(folder)
    assert f"orthocal.use.{key}" in caught.value.where


# ---- the tool error


def conditions_of_use():
    """Half of all combinations of both sides and two Gauss points of each range.

    The combinations have an even number of upper levels. Sums of products of two conditions are
    therefore those of all combinations.
    """
    nodes, _ = np.polynomial.legendre.leggauss(2)
    for signs in itertools.product((-1, 1), repeat=5):
        if np.prod(signs) == 1:
            approach = "".join("p" if s > 0 else "n" for s in signs[:3])
            t, m = (nodes[(1 + s) // 2] for s in signs[3:])
            yield UseConditions(approach, 25 + 10 * t, 2 + 2 * m)


def align(fields, positions):
    """Fields of all conditions less one shift and rotation by least squares, shape (n, K, 3)."""
    rows = [
        np.hstack([np.eye(3), -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])])
        for x, y, z in positions
    ]
    basis = np.tile(np.vstack(rows), (len(fields), 1))
    motion = np.linalg.lstsq(basis, fields.reshape(-1))[0]
    return fields - (basis @ motion).reshape(fields.shape)


def test_tool_errors_are_those_of_sampled_machines_under_sampled_conditions(calibration):
    """Machines about the estimate, commanded by controllers that correct offsets, or everything."""
    robot = calibration.robot
    corners = np.array(list(itertools.product((-0.05, 0.05), repeat=3)))
    workspace = replace(Workspace.even(tool_at_zero(robot) + corners), box=cube_limits(robot, 0.05))
    accuracy = assess_tool(calibration, workspace)
    figures = summarise_tool(calibration, accuracy)
    names, at = accuracy.names, calibration.errors
    values, vectors = np.linalg.eigh(calibration.error_covariances[0])
    draws = np.random.default_rng(7).normal(size=(MACHINES, values.size))
    errors = (draws * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    theta = np.array([at.get(n, 0.0) for n in names]) + errors
    nominal = nominal_closure(robot)
    drives, passive = nominal.reach(workspace.points)  # other machines are near it
    targets = nominal.tcp(drives, passive)
    commanded = {
        "now": drives - calibration.active_offsets,
        "entered": drives - entered_offsets(calibration),
        "without_backlash": drives - entered_offsets(calibration),
        "unstated": calibration.machine.inverse(workspace.points),
    }
    half = 0.5 * np.array([e.change for e in find_backlash(calibration)])
    assert half.any()
    fields = {name: [] for name in (*commanded, "compensated")}
    for c in conditions_of_use():
        closure = LoopClosure(robot, free=names, fixed=at, conditions=c)
        for name, at_drives in commanded.items():
            sides = np.array([1.0 if s == "p" else -1.0 for s in c.approach])
            at_drives = at_drives + (sides * half if name == "entered" else 0.0)
            fields[name].append(closure.forward(at_drives, theta=theta, start=passive) - targets)
        corrected = calibration.machine.inverse(workspace.points, conditions=c)
        placed = closure.forward(corrected, theta=theta, start=passive)
        fields["compensated"].append(placed - targets)
    expected = {name: getattr(figures, name) for name in fields if name != "unstated"}
    expected["unstated"] = figures.use.unstated
    for name, field in fields.items():
        of_machines = np.array(field).swapaxes(0, 1)
        squares = [(align(f, targets) ** 2).sum(axis=2).mean() for f in of_machines]
        assert np.sqrt(np.mean(squares)) == pytest.approx(expected[name], rel=0.08), name
    assert figures.entered > 1.1 * figures.compensated
    assert figures.use.unstated > figures.compensated


def summarise_without_backlash(calibration, workspace):
    placed = place_tool(calibration, workspace)
    return summarise_tool(calibration, assess_placed(calibration, placed, backlash=()))


def test_a_part_is_the_share_of_one_varying_condition(calibration, workspace):
    both = summarise_without_backlash(calibration, workspace)
    parts = {p.condition: p.size for p in both.use.parts}
    assert list(parts) == ["approach", "temperature", "payload"]
    lag = [0.5 * calibration[f"{k}_slide.backlash"].value for k in "xyz"]
    assert both.use.parts[0].known == pytest.approx(np.linalg.norm(lag), rel=0.05)
    assert both.use.parts[0].effects == ("backlash",)
    changes = {
        "approach": {"approach": "ppp"},
        "temperature": {"temperature": (25.0, 25.0)},
        "payload": {"payload": (2.0, 2.0)},
    }
    for name, change in changes.items():
        other = with_use(calibration, **change)
        constant = summarise_without_backlash(other, workspace)
        without = np.sqrt(both.entered**2 - parts[name] ** 2)
        assert constant.entered == pytest.approx(without, rel=0.02), name
        assert name not in [p.condition for p in constant.use.parts]


def test_stated_conditions_are_those_of_the_figures(calibration, workspace):
    use = UseConditions("pnp", 30.0, 1.0)
    accuracy = assess_tool(calibration, workspace, conditions=use)
    assert len(accuracy.targets) == len(workspace.points)
    machine = calibration.machine
    drives = nominal_closure(calibration.robot).inverse(workspace.points)
    off = machine.forward(drives - calibration.active_offsets, conditions=use) - accuracy.targets
    assert np.abs(off - accuracy.deviation).max() < 1e-11
    assert accuracy.deviation_ignoring_conditions is None
    assert summarise_tool(calibration, accuracy).use is None
    with pytest.raises(ParameterError):
        assess_tool(calibration, workspace, conditions=UseConditions("pn"))


def test_percentiles_and_single_points_are_over_all_conditions(calibration, workspace):
    accuracy = assess_tool(calibration, workspace)
    field = accuracy.align(accuracy.deviation)
    parts, weights = accuracy.workspace.interpolate_to_cells(field)
    assert weights.sum() == pytest.approx(1.0)
    one = [workspace.interpolate_to_cells(f)[0] for f in field.reshape(8, -1, 3)]
    assert np.array_equal(np.sort(parts, axis=0), np.sort(np.concatenate(one), axis=0))
    even = assess_tool(calibration, Workspace.even(workspace.points[:3]))
    assert len(even.points) == 3
    assert len(even.targets) == 24


def test_the_forecast_of_a_plan_is_over_the_same_conditions(calibration, workspace):
    robot = calibration.robot
    forecast = ToolForecast(robot, Choice("offsets", prior=True).select(robot.parameters))
    assert len(forecast.positions) == 8 * 125
    names = list(forecast.names)
    covariance = np.zeros((len(names),) * 2)
    chosen = [names.index(f"{k}_slide.backlash") for k in "xyz"]
    covariance[chosen, chosen] = (20e-6) ** 2
    tool = forecast._expected(covariance).sizes
    # half the backlash of three drives, which no alignment removes
    assert tool.aligned.rms == pytest.approx(np.sqrt(3) * 10e-6, rel=0.05)
    one_sided = replace(robot, use=replace(robot.use, approach="pnp"))
    selection = Choice("offsets", prior=True).select(robot.parameters)
    one = ToolForecast(one_sided, selection)._expected(covariance).sizes
    assert one.aligned.rms < 0.3 * tool.aligned.rms
    assert one.absolute.rms == pytest.approx(tool.absolute.rms, rel=0.05)


# ---- the assessment


def test_the_assessment_states_the_tool_error_in_use(calibration, tmp_path):
    tool = calibration.assessment.tool
    assert (tool.use.approach, tool.use.temperature, tool.use.payload) == (
        "uuu",
        (15.0, 35.0),
        (0.0, 4.0),
    )
    write_calibration(calibration, tmp_path / "calibration.json")
    document = json.loads((tmp_path / "calibration.json").read_text())
    use = document["assessment"]["tool"]["use"]
    assert [p["condition"] for p in use["parts"]] == ["approach", "temperature", "payload"]
    again = load_calibration(tmp_path / "calibration.json").assessment.tool
    assert again.use.unstated == tool.use.unstated
    text = " ".join(summarize(calibration).split())
    assert "approaches from both sides, 15…35 °C, payload 0…4 kg." in text
    assert "With the backlash that the controller compensates now: " in text
    assert "Temperatures of 15…35 °C add" in text
    added = float(re.search(r"A payload of 0…4 kg adds ([0-9.]+) mm", text)[1])
    without = np.sqrt(tool.entered**2 - tool.use.parts[-1].size ** 2)
    assert added == pytest.approx((tool.entered - without) / MM, abs=5e-4)


# ---- commands


JOINTS = "x_slide_mm,y_slide_mm,z_slide_mm\n310.25,330,300\n"


@pytest.fixture(scope="module")
def folder(calibration, tmp_path_factory):
    folder = tmp_path_factory.mktemp("commands")
    write_calibration(calibration, folder / "calibration.json")
    (folder / "joints.csv").write_text(JOINTS)
    return folder


def numbers(text):
    return np.array([float(v) for v in text.splitlines()[1].split(",")])


def test_forward_and_inverse_take_conditions(folder, calibration):
    stated = ("--approach", "pnp", "--temperature", "31", "--payload", "2.5")
    code, out, note = run_orthocal(folder, "forward", ".", "joints.csv", *stated)
    assert (code, note) == (0, "")
    drives = [0.31025, 0.33, 0.3]
    use = UseConditions("pnp", 31.0, 2.5)
    tool = calibration.machine.forward(drives, conditions=use)
    assert numbers(out) == pytest.approx(tool * 1e3, abs=1e-6)
    (folder / "points.csv").write_text(out)
    back = run_orthocal(folder, "inverse", ".", "points.csv", *stated)
    assert numbers(back.stdout) == pytest.approx(np.array(drives) * 1e3, abs=1e-5)
    opposite = calibration.machine.forward(drives, conditions=replace(use, approach="npn"))
    assert np.linalg.norm(opposite - tool) > 20e-6


def test_assumed_conditions_are_stated_with_their_cost(folder, calibration):
    code, out, note = run_orthocal(folder, "forward", ".", "joints.csv")
    assert code == 0
    (folder / "points.csv").write_text(out)
    assert numbers(out) == pytest.approx(calibration.machine.forward([0.31025, 0.33, 0.3]) * 1e3)
    tool = calibration.assessment.tool
    assert "--approach" in note
    assert "20 °C (--temperature)" in note
    assert "no payload (--payload)" in note
    shown = [float(v) for v in re.findall(r"(0\.\d+) mm", note)]
    assert shown == pytest.approx([tool.use.unstated * 1e3, tool.compensated * 1e3], abs=6e-4)
    _, _, note = run_orthocal(folder, "inverse", ".", "points.csv", "--approach", "uuu")
    assert "approach" not in note
    assert "20 °C" in note
    _, out, note = run_orthocal(folder, "accuracy", ".", "points.csv", "--payload", "1")
    assert "--payload" not in note
    assert "--temperature" in note


def test_accuracy_is_under_stated_conditions(folder, calibration):
    stated = ("--approach", "ppp", "--temperature", "25", "--payload", "2")
    with no_sensor_gains():
        _, text, _ = run_orthocal(folder, "accuracy", ".", *stated)
    assert "Conditions: approach ppp, 25 °C and payload 2 kg." in " ".join(text.split())
    _, text, _ = run_orthocal(folder, "accuracy", ".", *stated, "--json")
    document = json.loads(text)
    use = UseConditions("ppp", 25.0, 2.0)
    expected = assess_tool(calibration, conditions=use)
    assert document["points"] == 125
    assert document["deviation"]["aligned"]["rms"] == pytest.approx(
        expected.measure(expected.deviation).aligned.rms
    )


def test_a_corrected_program_is_that_of_its_temperature_and_payload(folder, calibration):
    # within one box of the correction field
    points = np.array([[1.0, 1.0, 1.0], [12.0, 18.0, 5.0], [18.0, 3.0, 14.0], [5.0, 9.0, 19.0]])
    lines = [f"N{n} G0 X{x} Y{y} Z{z}" for n, (x, y, z) in enumerate(points, start=1)]
    (folder / "part.ngc").write_text("\n".join(["G21", *lines, ""]))
    (folder / "point.ngc").write_text("G21\nN1 G0 X1 Y1 Z1\n")

    def correct(file, *options):
        """A corrected program, the comments at its top, and the notes."""
        done = run_orthocal(folder, "correct", ".", file, "--anyway", *options)
        assert done.returncode == 0
        lines = done.stdout.splitlines()
        return done.stdout, [c for c in lines if c.startswith(";")], done.stderr

    active, controller = ("--offsets", "active"), ("--backlash", "controller")
    cold, at_20, note = correct("part.ngc", *active, *controller)
    assert "20 °C (--temperature)" in note
    stated = ("--temperature", "34", "--payload", "4")
    warm, at_34, note = correct("part.ngc", *active, *controller, *stated)
    assert "--temperature" not in note
    assert ["20 °C and no payload" in c for c in at_20 if "°C" in c] == [True]
    assert ["34 °C and payload 4 kg" in c for c in at_34 if "°C" in c] == [True]
    assert any("controller must compensate the backlash" in c for c in at_34)
    # with the values to enter, the controller compensates the backlash, unless it cannot
    for options, part in (
        ((), "must compensate"),
        (("--backlash", "program"), "must not"),
    ):
        _, comments, _ = correct("point.ngc", *options)
        assert any(f"controller {part}" in c.lower() for c in comments)

    def commanded(text):
        """Ends of the motions of the program, shape (4, 3), [m]."""
        written = read_polyline(text.splitlines())
        return np.array([written[n][-1][0] for n in range(1, 5)]) * 1e-3

    # a common shift and rotation does not change distances
    for text, use in ((cold, UseConditions()), (warm, UseConditions(None, 34.0, 4.0))):
        drives = nominal_closure(calibration.robot).inverse(commanded(text))
        drives = drives - calibration.active_offsets
        reached = calibration.machine.forward(drives, conditions=use)
        assert pdist(reached) == pytest.approx(pdist(points * 1e-3), abs=1e-6)
    assert np.abs(commanded(cold) - commanded(warm)).max() > 5e-6


@pytest.mark.parametrize(
    ("command", "option", "value"),
    [("accuracy", "--approach", "xyz"), ("accuracy", "--temperature", "nan")],
)
def test_conditions_out_of_range_are_refused(folder, command, option, value):
    code, out, message = run_orthocal(folder, command, ".", "joints.csv", option, value)
    assert (code, out) == (2, "")
    assert option in message
