"""The loop closure solver against closed forms and Pinocchio, in batches, and its refusals."""

from __future__ import annotations

from dataclasses import replace

import closed_form
import numpy as np
import pinocchio as pin
import pytest
from linkages import joint, make_robot
from tolerances import CLOSED, CLOSED_FORM

from orthocal import load_robot
from orthocal.errors import ClosureError, RobotError
from orthocal.kinematics import continuation, loop_closure
from orthocal.kinematics.loop_closure import LoopClosure, find_beyond_travel, nominal_closure
from orthocal.kinematics.robot_functions import robot_functions
from orthocal.measurement.files.coordinate_tables import drive_columns
from orthocal.robot.model import closure_row_units

LENGTH = 0.31025


def reachable_points(count, seed=1):
    """Random points in the machine's branch and within the drives' travel."""
    rng = np.random.default_rng(seed)
    found = np.empty((0, 3))
    while len(found) < count:
        points = rng.uniform(-0.15, 0.08, (count, 3))
        joints = closed_form.inverse(points, length=LENGTH)
        inside = np.all((joints > 0.12) & (joints < 0.39), axis=1)
        found = np.vstack([found, points[inside]])
    return found[:count]


def test_closed_loops_equal_the_closed_forms_on_many_points(orthoglide):
    points = reachable_points(1000)
    joints = closed_form.inverse(points, length=LENGTH)
    closure = LoopClosure(orthoglide)
    assert np.abs(closure.forward(joints) - points).max() < CLOSED_FORM
    assert np.abs(closed_form.direct(joints, length=LENGTH) - points).max() < CLOSED_FORM
    assert np.abs(closure.inverse(points[:200]) - joints[:200]).max() < CLOSED_FORM


def test_offsets_and_lengths_act_as_in_the_closed_forms(orthoglide):
    rng = np.random.default_rng(2)
    points = reachable_points(200, seed=3)
    offsets = rng.uniform(-0.005, 0.005, 3)
    stretch = 0.0007
    errors = {f"{k}_slide.offset": v for k, v in zip("xyz", offsets, strict=True)}
    errors.update({f"{k}_leg.length": stretch for k in "xyz"})
    joints = closed_form.inverse(points, length=LENGTH + stretch, offsets=offsets)
    # a longer leg reaches further in from the same slider: the platform's own offset is unchanged
    assert (
        np.abs(LoopClosure(orthoglide, fixed=errors).forward(joints) - points).max() < CLOSED_FORM
    )


def test_batches_equal_the_newton_iteration_of_pinocchio(orthoglide):
    names = orthoglide.parameters.select_model("full")
    rng = np.random.default_rng(4)
    scale = np.array([orthoglide.parameters[n].prior_std for n in names])
    values = 5.0 * scale * rng.normal(size=len(names))
    joints = closed_form.inverse(reachable_points(20, seed=5), length=LENGTH)
    passive = LoopClosure(orthoglide, free=names).close(joints, theta=values)
    machine = orthoglide.with_errors(dict(zip(names, values, strict=True)))
    for d, ours in zip(joints, passive, strict=True):
        theirs = machine.close_with_pinocchio(d, orthoglide.reference_passive)
        assert np.abs(ours - theirs).max() < CLOSED


def test_the_zero_posture_is_as_well_conditioned_as_designed(orthoglide):
    passive = orthoglide.reference_passive
    _, jacobian = orthoglide.evaluate_constraints(orthoglide.drive_zero, passive)
    scaled = jacobian[:, orthoglide.passive_index] * closure_row_units(orthoglide)[:, None]
    values = np.linalg.svd(scaled, compute_uv=False)
    assert 1 / 30 < values[-1] / values[0] < 1 / 10


@pytest.mark.parametrize(
    "motors", [(0.2, -0.1), (0.174, 1.74), (-0.434, 1.561), (1.253, 1.651), (-1.091, 0.493)]
)
def test_large_motions_keep_the_elbows_where_they_were(fivebar, motors):
    """The apex stays on its side of the elbows; plain Newton from zero turns all but the first."""
    first = -0.1 + (-0.05 + 0.08j) * np.exp(1j * motors[0])
    second = 0.1 + (0.05 + 0.08j) * np.exp(1j * motors[1])
    between = second - first
    height = np.sqrt(abs(0.15 + 0.07j) ** 2 - abs(between) ** 2 / 4)
    apex = (first + second) / 2 + 1j * between / abs(between) * height
    passive = nominal_closure(fivebar).close(motors)
    data = fivebar.model.createData()
    q = fivebar.configuration(fivebar.joint_coordinates(motors, passive))
    pin.framesForwardKinematics(fivebar.model, data, q)
    reached = data.oMf[fivebar.frame_id("end_a")].translation
    assert np.abs(reached - [apex.real, apex.imag, 0.0]).max() < CLOSED_FORM


def test_far_postures_stay_in_the_branch_the_machine_is_built_in(orthoglide):
    """Plain Newton from the mechanical zero would assemble some of these the other way."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.19, 0.19, (1000, 3))
    joints = closed_form.inverse(points, length=LENGTH)
    joints = joints[np.all((joints > 0.12) & (joints < 0.39), axis=1)]
    expected = closed_form.direct(joints, length=LENGTH, root=-1)
    assert np.abs(nominal_closure(orthoglide).forward(joints) - expected).max() < CLOSED_FORM


def test_the_solution_at_points_is_that_of_the_machine_and_its_conditions(orthoglide):
    """Whatever was solved for others before: the last solutions are kept."""
    points = reachable_points(20, seed=7)
    machines = [LoopClosure(orthoglide, fixed={"x_slide.offset": e}) for e in (0.0, 1e-3, 0.0)]
    first, other, again = (np.hstack(m.reach(points)) for m in machines)
    assert np.abs(first - other).max() > 0.9e-3
    assert np.array_equal(first, again)
    again[:] = 0.0  # a solution that is kept is nobody's to change
    assert np.array_equal(np.hstack(machines[0].reach(points)), first)
    assert np.abs(machines[0].forward(first[:, :3]) - points).max() < CLOSED_FORM
    nominal_drives = machines[0].close(first[:, :3])
    assert np.abs(nominal_drives - first[:, 3:]).max() < CLOSED_FORM


def test_a_closure_is_solved_once_for_the_same_machine_drives_and_start(orthoglide, monkeypatch):
    solved = []
    solve = loop_closure.solve_closures

    def count(*args, **options):
        solved.append(options["start"])
        return solve(*args, **options)

    monkeypatch.setattr(loop_closure, "solve_closures", count)
    drives = orthoglide.drive_zero + np.random.default_rng(11).uniform(-0.02, 0.02, (5, 3))
    closure = LoopClosure(orthoglide, fixed={"x_slide.offset": 7e-4})
    first = closure.close(drives)
    again = closure.close(drives, start=first)
    again[:] = 0.0  # a solution that is kept is nobody's to change
    assert np.abs(closure.close(drives, start=first) - first).max() < CLOSED_FORM
    assert len(solved) == 2
    closure.close(drives, start=first + 1e-5)
    LoopClosure(orthoglide).close(drives, start=first)
    assert len(solved) == 4


def test_a_posture_out_of_reach_is_abandoned_early(orthoglide, monkeypatch):
    """Newton steps that do not reduce the residual are not repeated: 227 evaluations with them."""
    closure = LoopClosure(orthoglide)
    evaluate, calls = closure._closing.evaluate, []
    monkeypatch.setattr(
        closure._closing, "evaluate", lambda x, *rest: calls.append(x) or evaluate(x, *rest)
    )
    failures = {}
    closure.close(orthoglide.drive_zero[None] + [0.3, 0.0, 0.0], failures=failures)
    assert list(failures) == [0]
    assert len(calls) < 150


def test_an_unreachable_posture_is_named_with_what_stays_open(orthoglide):
    joints = np.array([[0.31025] * 3, [0.7, 0.3, 0.3]])
    with pytest.raises(ClosureError, match="posture 'far' cannot be reached") as caught:
        nominal_closure(orthoglide).close(joints, names=["near", "far"])
    assert caught.value.posture == "far"
    assert caught.value.residual > 0.01


def test_the_travel_of_a_revolute_drive_is_in_the_unit_of_its_column(fivebar):
    motor = replace(fivebar.drives[0], lower=-np.pi / 2, upper=np.pi / 2)
    robot = replace(fivebar, drives=(motor, *fivebar.drives[1:]))
    (failure,) = find_beyond_travel(robot, np.array([[np.pi, 0.0]])).values()
    assert failure.reason == "motor_a_deg is 180; the drive reaches from -90 to 90"
    assert f"{motor.name}_deg" in drive_columns(robot)


def test_a_hinge_of_a_machine_with_rods_of_1_m_has_limits_in_degrees(tmp_path):
    """A parallelogram: the hinge turns back as far as the motor turns."""
    limit = '<limit lower="-0.5" upper="0.5" effort="1" velocity="1"/>'
    joints = joint("j0", "base", (0, 0, 0), "z") + joint("j1", "j0", (1, 0, 0), "z", limit=limit)
    joints += joint("j2", "j1", (0, 1, 0), "z") + joint("end", "j2", (-1, 0, 0), "")
    joints += joint("post", "base", (0, 1, 0), "")
    yaml = "closed_loop: [[end, post]]\ntype: [3d]\nname_mot: [j0]\n"
    yaml += "orthocal: {closures: {loop: {rows: [x, y]}}}\n"
    closure = LoopClosure(make_robot(tmp_path / "large", joints, yaml))
    with pytest.raises(ClosureError, match=r"at -57\.3 deg, outside its limits -28\.6"):
        closure.close([1.0])


def test_coordinates_that_are_not_numbers_are_refused(orthoglide):
    with pytest.raises(ClosureError, match="posture 'here' has coordinates that are not numbers"):
        nominal_closure(orthoglide).close([[np.nan, 0.3, 0.3]], names=["here"])


def test_rows_of_different_lengths_are_refused(biglide):
    with pytest.raises(ValueError, match="found list; expected 2 coordinates per row"):
        nominal_closure(biglide).inverse([[0.0, 0.0, 0.0], [0.0, 0.0]])


def test_a_singular_posture_is_refused(biglide):
    """Sliders so far out that both rods lie on one line: the tool is free across it."""
    far = 0.2 * np.sqrt(2.0)
    with pytest.raises(ClosureError, match="posture 'line' is singular"):
        nominal_closure(biglide).close([[far, far]], names=["line"])


def test_underdriven_loops_are_singular(root, tmp_path):
    folder = tmp_path / "loose"
    folder.mkdir()
    urdf = (root / "tests/robots/fivebar/fivebar.urdf").read_text()
    (folder / "loose.urdf").write_text(urdf)
    (folder / "loose.yaml").write_text(
        "closed_loop: [[end_a, end_b]]\ntype: ['3d']\nname_mot: [motor_a, motor_b]\n"
    )
    with pytest.raises(ClosureError, match="leave 1 of 3 passive motions free"):
        LoopClosure(load_robot(folder)).close([0.1, 0.1])


def test_a_robot_without_a_tool_has_no_forward(fivebar):
    with pytest.raises(RobotError, match="no tool centre point"):
        nominal_closure(fivebar).forward([0.0, 0.0])


OPEN = 1e-12
"""Loops in metres that count as closed: some hundred roundings of a machine of a third of one."""


def draw_machines(robot, *, offset, size=1e-3, seed=0, count=6):
    """Elementary errors of machines, some drives with larger offsets; commanded postures."""
    rng = np.random.default_rng(seed)
    names = robot_functions(robot).errors.names
    errors = size * rng.normal(size=(count, len(names)))
    drives = [i for i, n in enumerate(names) if n.endswith(".offset")]
    errors[:, drives] += offset * rng.normal(size=(count, len(drives)))
    return names, errors, robot.drive_zero + 0.02 * rng.normal(size=(5, len(robot.drives)))


@pytest.mark.parametrize("name", ["orthoglide", "biglide"])
@pytest.mark.parametrize("offset", [0.0, 0.01])
def test_a_batch_of_machines_is_closed_as_pinocchio_has_them(request, name, offset):
    robot = request.getfixturevalue(name)
    names, errors, postures = draw_machines(robot, offset=offset)
    passive = LoopClosure(robot).close(postures, errors=errors)
    tools = LoopClosure(robot).tcp(postures, passive, errors=errors)
    for own, q, tool in zip(errors, passive, tools, strict=True):
        values = dict(zip(names, own.tolist(), strict=True))
        machine, alone = robot.with_errors(values), LoopClosure(robot, fixed=values)
        for drives, joints in zip(postures, q, strict=True):
            residual, _ = machine.evaluate_constraints(drives, joints)
            assert np.abs(residual).max(initial=0.0) < OPEN
        assert np.abs(alone.close(postures) - q).max() < CLOSED
        assert np.abs(alone.forward(postures) - tool).max() < CLOSED


@pytest.mark.parametrize("points", [continuation.MAX_POINTS, 7])
def test_a_machine_out_of_reach_spoils_no_other(orthoglide, monkeypatch, points):
    """Also where a batch is split: 7 postures are one machine."""
    monkeypatch.setattr(continuation, "MAX_POINTS", points)
    _, errors, postures = draw_machines(orthoglide, offset=0.0)
    alone = LoopClosure(orthoglide).close(postures, errors=errors[:3])
    far = np.array(errors)
    far[3:] += 0.5  # no machine
    for many in (far, np.where(np.arange(len(errors))[:, None] < 3, errors, np.nan)):
        failures = {}
        with np.errstate(all="ignore"):
            passive = LoopClosure(orthoglide).close(postures, errors=many, failures=failures)
        assert {i // len(postures) for i in failures} == {3, 4, 5}
        assert np.isnan(passive[3:]).any(axis=(1, 2)).all()
        assert np.abs(passive[:3] - alone).max() < OPEN


def test_a_batch_has_the_safeguards_of_one_machine(biglide):
    """The posture is singular with the first machine's drives, regular with the second's."""
    far = 0.2 * np.sqrt(2.0)
    free = tuple(f"{d.name}.offset" for d in biglide.drives)
    closure = LoopClosure(biglide, free=free)
    with pytest.raises(ClosureError, match="posture 'line' is singular"):
        closure.close([[far, far]], theta=np.zeros((2, 2)), names=["line"])
    failures = {}
    theta = np.array([[0.0, 0.0], [-0.05, -0.05]])
    passive = closure.close([[far, far]], theta=theta, names=["line"], failures=failures)
    assert list(failures) == [0]
    assert np.isnan(passive[0]).all()
    assert np.isfinite(passive[1]).all()
