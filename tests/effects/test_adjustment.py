"""Mechanical adjustments: displacements by feet and threads, sessions before and after."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from adjusting import TOLERANCES, shim, shimmed_plan, turned
from commands import run_orthocal
from derivatives import assert_derivative, assert_jacobian
from machines import frames, reading_by_pinocchio
from tolerances import CLOSED, KINEMATICS

from orthocal import (
    Choice,
    join_sessions,
    load_calibration,
    load_robot,
    load_session,
    restore_session,
    simulate_session,
    write_calibration,
    write_session,
)
from orthocal.calibration.identify import identify
from orthocal.errors import ParameterError, RobotError, SessionError
from orthocal.estimation.problem import build_problem
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.observation.simulate import collect_errors, load_errors, truth_document
from orthocal.robot.loading import packaged_robots
from orthocal.statistics.zeros import project_out_zeros

QUICK = {"solver": "variable-projection"}

FEET = """
  adjustments:
    far: {moves: x_slide, at_mm: [480, 20, 5], direction: [0, 2, 1], pivot_mm: [150, -30, 0]}
    along: {moves: y_slide, at_mm: [0, 0, 0], direction: [0, 3, 0]}
    tilted: {moves: z_slide, at_mm: [30, 10, 300], direction: [1, 0, 0.2], pivot_mm: [-5, -40, 200]}
    thread: {lengthens: x.b, pitch_mm: 0.5, step_mm: 0.05}
"""


def write_robot(folder, text=FEET):
    source = packaged_robots()["orthoglide"]
    folder.mkdir(parents=True)
    shutil.copy(source / "orthoglide.urdf", folder / "machine.urdf")
    (folder / "machine.yaml").write_text((source / "orthoglide.yaml").read_text() + text)
    return folder


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return load_robot(write_robot(tmp_path_factory.mktemp("feet") / "machine"))


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    return shimmed_plan(tmp_path_factory.mktemp("shimmed") / "mill")


# ---- displacements by an adjustment


@pytest.mark.parametrize("name", ["far", "along", "tilted"])
def test_a_foot_moves_the_slide_as_a_rigid_body(robot, name):
    """Position of the leg's root at a fixed drive coordinate."""
    leg, drives = keys_of(robot, name)["moves"][0], robot.drive_zero + 0.03
    frame = robot.frame_id(f"{leg}_leg_root")
    q = robot.configuration(robot.joint_coordinates(drives, robot.reference_passive))

    def place(model):
        data = model.createData()
        pin.framesForwardKinematics(model, data, q)
        return np.array(data.oMf[frame].homogeneous)

    def by_shims(t):
        return place(shim(robot, {name: 1e-3 * t[0]})).ravel()

    def by_errors(t):
        return place(robot.with_errors({f"{name}.adjustment": 1e-3 * t[0]}).model).ravel()

    slope = (by_errors(np.array([1e-3])) - by_errors(np.array([-1e-3])))[:, None] / 2e-3
    assert_derivative(slope, by_shims, np.zeros(1))
    assert np.abs(slope).max() > 1e-4
    # at 1 mm the rail turns by 3 mrad; the difference is of second order
    assert np.abs(by_errors([1.0]) - by_shims(np.ones(1))).max() < 3e-5


def keys_of(robot, name):
    return robot.declared.adjustments[name]


def test_the_foot_moves_by_its_amount_and_the_pivot_is_fixed(robot):
    keys, amount = keys_of(robot, "far"), 1e-6
    rotation, shift = turned(keys, amount)
    direction = np.array(keys["direction"]) / np.linalg.norm(keys["direction"])
    at, pivot = (np.array(keys[k]) * 1e-3 for k in ("at_mm", "pivot_mm"))
    assert abs(direction @ (rotation @ at + shift - at) - amount) < 1e-11
    assert np.abs(rotation @ pivot + shift - pivot).max() < KINEMATICS


def test_an_adjustment_along_the_axis_of_the_drive_is_an_offset(robot):
    assert robot.parameters["along.adjustment"].terms == (("y_slide.offset", pytest.approx(1.0)),)


def test_a_thread_lengthens_its_rod(robot):
    longer = robot.with_errors({"thread.adjustment": 0.4e-3})
    rods = robot.legs["x"].rods
    for machine, rod, length in (
        (longer, "b", rods["b"].length + 0.4e-3),
        (longer, "a", rods["a"].length),
        (robot, "b", rods["b"].length),
    ):
        at = frames(machine, robot.drive_zero)
        distance = np.linalg.norm(at[rods[rod].tip] - at[rods[rod].root])
        assert distance == pytest.approx(length, abs=CLOSED * 10)


def test_adjustments_belong_to_no_model(robot):
    for model in robot.parameters.models:
        assert not [n for n in robot.parameters.select_model(model) if n.endswith("adjustment")]
    assert not [n for n in robot.parameters.elementary if n.endswith(("adjustment", "setting"))]


# ---- bad keys


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("{at_mm: [0, 0, 0], direction: [0, 1, 0]}", "moves"),
        ("{moves: w_slide, at_mm: [0, 0, 0], direction: [0, 1, 0]}", "moves"),
        ("{moves: x_slide, direction: [0, 1, 0]}", "at_mm"),
        ("{moves: x_slide, at_mm: [0, 0, 0]}", "direction"),
        ("{moves: x_slide, at_mm: [0, 0], direction: [0, 1, 0]}", "at_mm"),
        ("{moves: x_slide, at_mm: [0, 0, 0], direction: [0, 0, 0]}", "direction"),
        ("{moves: x_slide, at_mm: [0, 9, 0], direction: [0, 1, 0], pivot_mm: [0, 0, 0]}", "pivot"),
        ("{lengthens: x.c}", "lengthens"),
        ("{lengthens: x.a, at_mm: [0, 0, 0]}", "at_mm"),
        ("{lengthens: x.a, step_mm: 0}", "step_mm"),
        ("{lengthens: x.a, step_mm: 0.5, largest_mm: 0.4}", "step_mm"),
        ("{lengthens: x.a, step_mm: 2}", "step_mm"),
        ("{lengthens: x.a, largest_mm: 51}", "largest_mm"),
        ("{lengthens: x.a, turns: 3}", "turns"),
        ("3", ""),
    ],
)
def test_an_invalid_key_is_named(tmp_path, text, key):
    folder = write_robot(tmp_path / "machine", f"\n  adjustments:\n    foot: {text}\n")
    with pytest.raises(RobotError) as caught:
        load_robot(folder)
    assert f"orthocal.adjustments.foot{key and f'.{key}'}" in str(caught.value)
    assert "machine.yaml" in str(caught.value)


def test_a_sum_cannot_have_its_name(tmp_path):
    yaml = write_robot(tmp_path / "machine") / "machine.yaml"
    taken = "    far.adjustment: [x_slide.y]\n    x_leg.length:"
    yaml.write_text(yaml.read_text().replace("    x_leg.length:", taken))
    with pytest.raises(RobotError, match=r"far\.adjustment"):
        load_robot(yaml.parent)


# ---- sessions before and after


AMOUNTS = {"x_outer_foot_z": 0.5e-3, "y_side_foot_x": -0.3e-3}
TRUTH = {
    "x_slide.offset": 0.4e-3,
    "y_slide.offset": -0.3e-3,
    "x_slide.ry": -2e-3,
    "y_slide.rx": 3e-3,
    "z_slide.rx": 1e-3,
}
"""Errors after the adjustments."""


def sessions_of(plan, *, stated=AMOUNTS, exact=True):
    """Sessions before and after adjustments; the second one states some."""
    before = {f"{n}.adjustment": -v for n, v in AMOUNTS.items()}
    return [
        replace(
            simulate_session(plan, {**TRUTH, **more}, seed=k, exact=exact).session,
            adjusted=adjusted,
        )
        for k, (more, adjusted) in enumerate(((before, {}), ({}, stated)))
    ]


def test_sessions_before_and_after_are_one_machine(plan):
    """Without stated adjustments the second session contradicts the first."""
    largest = []
    for stated in (AMOUNTS, {}):
        problem = build_problem(join_sessions(sessions_of(plan, stated=stated)), model="full")
        assert problem.robot.adjusted == bool(stated)
        assert ("x_outer_foot_z.setting" in problem.free) == bool(stated)
        theta = np.array([TRUTH.get(n, 0.0) for n in problem.free])
        residual = project_out_zeros(problem.values - problem.predict(theta), problem.observations)
        largest.append(np.abs(residual).max())
    assert largest[0] < 2e-6
    assert largest[1] > 2e-5


def test_errors_are_those_of_the_last_session(plan):
    first, last = sessions_of(plan)
    moved = [dict(plan.robot.parameters[f"{n}.adjustment"].terms) for n in AMOUNTS]
    choice = Choice(free=sorted({*TRUTH, *moved[0], *moved[1]}))
    change = AMOUNTS["x_outer_foot_z"] * moved[0]["x_slide.ry"]
    found = identify([first, last], choice, **QUICK)[0].errors["x_slide.ry"]
    assert found == pytest.approx(TRUTH["x_slide.ry"], abs=0.05 * abs(change))
    found = identify([last, first], choice, **QUICK)[0].errors["x_slide.ry"]
    assert found == pytest.approx(TRUTH["x_slide.ry"] - change, abs=0.05 * abs(change))


def test_sessions_with_equal_adjustments_need_no_further_parameters(plan):
    first, last = sessions_of(plan)
    same = join_sessions([replace(first, adjusted=AMOUNTS), last])
    assert not same.robot.adjusted
    assert not [n for n in build_problem(same, model="full", prior=True).free if "setting" in n]


def test_the_jacobian_under_adjustments_is_exact(plan):
    """Also with respect to the errors of the setting, at random errors."""
    problem = build_problem(join_sessions(sessions_of(plan)), model="full", prior=True)
    rng = np.random.default_rng(2)
    theta = 0.1 * problem.theta_scale * rng.normal(size=problem.n_free)
    _, jacobian = problem.predict_and_jacobian(theta)
    chosen = [problem.free.index(n) for n in problem.free if n.endswith(".setting")]
    chosen += list(rng.choice(problem.n_machine, 12, replace=False))
    assert_jacobian(problem, theta, jacobian, columns=chosen, step=1e-2, tolerance=1e-5)
    moved = problem.free.index("x_outer_foot_z.setting")
    still = problem.free.index("x_inner_foot_z.setting")
    assert np.abs(jacobian[:, moved]).max() > 1e-8
    assert not jacobian[:, still].any()


def test_a_calibration_file_keeps_the_adjustments(plan, tmp_path):
    result, _ = identify(sessions_of(plan, exact=False), **QUICK)
    write_calibration(result, tmp_path / "calibration.json")
    again = load_calibration(tmp_path / "calibration.json")
    assert dict(again.session.adjusted) == pytest.approx(AMOUNTS)
    assert again.robot.adjusted
    assert again["x_outer_foot_z.setting"].std > 0.0
    restored = restore_session(again)
    assert restored.adjusted == pytest.approx(AMOUNTS)
    stated = {s.name: s.adjusted for s in restored.setups.values()}
    assert sorted(map(len, stated.values())) == [0] * 6 + [2] * 6


def test_a_session_file_states_the_adjustments(plan, tmp_path):
    _, after = sessions_of(plan)
    write_session(after, tmp_path / "after")
    text = (tmp_path / "after/session.yaml").read_text()
    assert "adjusted_mm: {x_outer_foot_z: 0.5, y_side_foot_x: -0.3}" in text
    assert load_session(tmp_path / "after").adjusted == pytest.approx(AMOUNTS)
    for wrong, message in (("z_foot: 0.5", "z_foot"), ("x_outer_foot_z: 80", "x_outer_foot_z")):
        changed = text.replace("x_outer_foot_z: 0.5", wrong)
        (tmp_path / "after/session.yaml").write_text(changed)
        with pytest.raises(SessionError) as caught:
            load_session(tmp_path / "after")
        assert "adjusted_mm" in str(caught.value)
        assert message in str(caught.value)


# ---- simulation after an adjustment


def test_simulated_readings_are_those_of_the_shimmed_machine(plan, tmp_path):
    """By command, with the truth.yaml of before; the shims are rigid motions in Pinocchio."""
    write_session(replace(plan, adjusted=AMOUNTS), tmp_path / "plan", blank=True)
    before = simulate_session(plan, TRUTH, exact=True)
    (tmp_path / "truth.yaml").write_text(truth_document(before))
    words = "simulate plan --errors truth.yaml --exact --effects none --out".split()
    assert run_orthocal(tmp_path, *words, "after").returncode == 0
    shown = load_session(tmp_path / "after")
    machine = plan.robot.with_errors(TRUTH)
    machine = replace(machine, model=shim(machine, AMOUNTS)).displaced({})
    largest = differing = 0.0
    for name in shown.setups:
        rows = [i for i, r in enumerate(shown.readings) if r.setup == name]
        postures = [shown.postures[shown.readings[i].posture] for i in rows]
        expected = [reading_by_pinocchio(shown, machine, shown.setups[name], p) for p in postures]
        difference = shown.values[rows] - (np.array(expected) - expected[0])
        differing = max(differing, np.abs(difference).max())
        change = shown.values[rows] - before.session.values[rows]
        largest = max(largest, np.abs(change).max())
    assert largest > 50e-6
    assert differing < 0.05 * largest  # of second order: rails with errors of 3 mrad turn by 1.4


def test_errors_of_an_adjusted_machine_are_adjusted_once(plan, tmp_path):
    """A truth.yaml states the adjustments of its machine."""
    robot, file = plan.robot, tmp_path / "truth.yaml"
    of = {n: f"{n}.adjustment" for n in AMOUNTS}
    adjusted = replace(plan, adjusted=AMOUNTS)
    file.write_text(truth_document(simulate_session(plan, TRUTH, exact=True)))
    errors = load_errors(file, robot, adjusted=AMOUNTS)
    assert {n: errors[of[n]] for n in AMOUNTS} == pytest.approx(AMOUNTS)
    # an amount that is stated alone replaces the planned amount
    single = ["x_outer_foot_z.adjustment_mm=0.45"]
    errors = collect_errors(robot, file=file, single=single, adjusted=AMOUNTS)
    assert errors[of["x_outer_foot_z"]] == pytest.approx(0.45e-3)
    file.write_text(truth_document(simulate_session(adjusted, errors, exact=True)))
    again = load_errors(file, robot, adjusted=AMOUNTS)
    assert again == pytest.approx(errors)
    further = load_errors(file, robot, adjusted={**AMOUNTS, "x_outer_foot_z": 0.7e-3})
    assert further[of["x_outer_foot_z"]] == pytest.approx(0.65e-3)
    assert further[of["y_side_foot_x"]] == pytest.approx(AMOUNTS["y_side_foot_x"])
    assert load_errors(file, robot) == pytest.approx(errors)
    file.write_text(file.read_text().replace("y_side_foot_x:", "y_side_feet_x:"))
    with pytest.raises(ParameterError, match="adjusted_mm"):
        load_errors(file, robot)


def test_feet_follow_the_dimensions(plan):
    """Drawn rails are 90 mm longer than the travel."""
    keys = plan.robot.declared.adjustments
    assert len(keys) == 15
    inner, outer = (keys[f"y_{end}_foot_x"]["at_mm"][1] for end in ("inner", "outer"))
    assert outer - inner == pytest.approx(390 - 120 + 90)
    side = keys["z_side_foot_y"]
    assert abs(side["at_mm"][0] - side["pivot_mm"][0]) == 80
    assert plan.robot.parameters.stated == TOLERANCES


def test_the_tool_after_an_adjustment_is_that_by_pinocchio(robot):
    amounts = {"far": 0.3e-3, "tilted": -0.2e-3}
    values = {f"{n}.adjustment": v for n, v in amounts.items()}
    drives = robot.drive_zero + np.array([0.02, -0.03, 0.01])
    tool = LoopClosure(robot, fixed=values).forward(drives)
    shimmed = replace(robot, model=shim(robot, amounts))
    rebuilt = shimmed.displaced({})
    by_shims = frames(rebuilt, drives)[robot.tcp.frame]
    unmoved = LoopClosure(robot).forward(drives)
    assert np.linalg.norm(tool - by_shims) < 2e-3 * np.linalg.norm(tool - unmoved)
    assert np.linalg.norm(tool - unmoved) > 2e-5
