"""Effects beyond offsets and placements: parameters, derivatives, identification."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from derivatives import assert_derivative, assert_jacobian, assert_program_derivatives
from effect_plans import write_plan, write_robot
from gauges import exact
from slack import Slack
from tolerances import CLOSED

from orthocal import (
    Choice,
    load_calibration,
    load_plan,
    load_robot,
    restore_session,
    simulate_session,
    write_calibration,
)
from orthocal.calibration.identify import identify
from orthocal.effects import registry
from orthocal.effects.backlash import Backlash
from orthocal.effects.loading import robot_effects
from orthocal.errors import OrthocalError, ParameterError, RobotError, SessionError
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.estimation.solvers.variable_projection import VariableProjection
from orthocal.kinematics.error_map import error_map
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.measurement.joining import join_sessions
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import build_observations
from orthocal.robot.frames import Placement
from orthocal.sensors.compiled import reading_conditions
from orthocal.session.session import Conditions

KEYS = "slack: {slack_mm: 0.04, lead_mm: 10}"

TRUTH = {
    "x_slide.offset": 0.4e-3,
    "y_slide.offset": -0.3e-3,
    "z_slide.offset": 0.2e-3,
    "x_slide.slack": 30e-6,
    "y_slide.slack": 12e-6,
    "z_slide.slack": 45e-6,
    "x_slide.wave": 8e-6,
    "y_slide.wave": -5e-6,
    "z_slide.wave": 3e-6,
    "rods.growth": 9e-6,
}
FREE = ("*.offset", "*.slack", "*.wave", "rods.growth")
SOLVERS = (VariableProjection, NonlinearProgram)
QUICK = {"solver": "variable-projection"}


@pytest.fixture(autouse=True)
def registered():
    registry.register_effect(Slack)
    yield
    registry.unregister_effect("slack")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    registry.register_effect(Slack)
    return write_plan(tmp_path_factory.mktemp("slack") / "plan", effects=KEYS)


@pytest.fixture(scope="module")
def plan(folder):
    return load_plan(folder)


@pytest.fixture(scope="module")
def problem(plan):
    return build_problem(plan, free=FREE, prior=True)


def point(problem, size=0.7):
    """Free parameters away from the nominal machine, in SI."""
    rng = np.random.default_rng(2)
    theta = size * problem.theta_scale * rng.normal(size=problem.n_free)
    theta[:3] *= 0.1
    return np.maximum(theta, problem.selection.lower)


# ---- parameters and keys


def test_its_parameters_belong_to_the_robot(plan, orthoglide):
    parameters = plan.robot.parameters
    assert parameters["x_slide.slack"].prior_std == 0.04e-3
    assert parameters["rods.growth"].unit == "1/K"
    assert parameters.read_quantity("rods.growth_ppm_per_K", 3.0) == ("rods.growth", 3e-6)
    assert [e.name for e in robot_effects(plan.robot)] == ["drive", "geometry", "slack"]
    names = {e.name for e in robot_effects(plan.robot)[-1].errors}
    assert all(names <= set(parameters.select_model(m)) for m in ("offsets", "full"))
    assert all(effect.describe() for effect in robot_effects(plan.robot))
    assert [e.name for e in robot_effects(orthoglide)] == ["drive", "geometry"]
    assert error_map(orthoglide).conditions == ()


@pytest.mark.parametrize(
    ("effects", "key"),
    [
        ("slack: {slack: 3}", "orthocal.effects.slack.slack"),
        ("slack: {slack_mm: -1}", "orthocal.effects.slack.slack_mm"),
        ("slack: {lead_mm: 0.5}", "orthocal.effects.slack.lead_mm"),
        ("slack: 3", "orthocal.effects.slack"),
        ("slag: {}", "orthocal.effects.slag"),
    ],
)
def test_invalid_keys_are_refused(tmp_path, effects, key):
    folder = write_robot(tmp_path / "machine", effects)
    with pytest.raises(RobotError) as caught:
        load_robot(folder)
    assert caught.value.where == f"{folder / 'machine.yaml'}: {key}"


def test_a_parameter_of_another_effect_is_refused(tmp_path):
    class Other(Slack):
        name = "other"

    registry.register_effect(Other)
    try:
        with pytest.raises(RobotError) as caught:
            load_robot(write_robot(tmp_path / "machine", "slack: {}, other: {}"))
    finally:
        registry.unregister_effect("other")
    assert caught.value.where.endswith("orthocal.effects.other")


def test_a_replaced_effect_returns():
    class Replaced(Backlash):
        pass

    registry.register_effect(Replaced)
    kinds = [registry.find_effect("backlash", where="", error=RobotError)]
    registry.unregister_effect("backlash")
    kinds.append(registry.find_effect("backlash", where="", error=RobotError))
    assert kinds == [Replaced, Backlash]


@pytest.mark.parametrize(
    ("method", "returned", "message"),
    [
        ("drives", ca.SX(2, 1), "Wrong.drives returns the shape (2, 1); expected"),
        ("drives", np.zeros(3), "Wrong.drives returns ndarray; expected"),
        ("placements", {Placement(1, False): ca.SX(3, 1)}, "of shape (6, 1)"),
        ("rods", {("x_leg", "a"): 0.1}, "Wrong.rods returns float; expected"),
        ("reading", ca.SX(3, 1), "Wrong.reading returns the shape (3, 1); expected"),
    ],
)
def test_what_is_no_expression_of_its_shape_is_named(tmp_path, method, returned, message):
    wrong = type("Wrong", (Slack,), {method: lambda *_: returned})
    registry.register_effect(wrong)
    folder = write_plan(tmp_path / "plan", effects="slack: {}")
    with pytest.raises(OrthocalError, match=re.escape(message)):
        predict_readings(load_plan(folder), {})


def test_effects_of_installed_packages_are_found(tmp_path, monkeypatch, root):
    registry.unregister_effect("slack")
    info = tmp_path / "site/probe_effects-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: probe-effects\nVersion: 1.0\n")
    points = "slack = installed_slack:Slack\nbroken = installed_slack:SlackKeys\n"
    (info / "entry_points.txt").write_text(f"[{registry.GROUP}]\n{points}")
    shutil.copy(root / "tests/slack.py", tmp_path / "site/installed_slack.py")
    monkeypatch.syspath_prepend(tmp_path / "site")
    robot = load_robot(write_robot(tmp_path / "machine", KEYS))
    assert type(robot_effects(robot)[-1]).__module__ == "installed_slack"
    assert "broken" in registry.effect_names()
    with pytest.raises(RobotError, match="the effect 'broken' of package probe-effects"):
        load_robot(write_robot(tmp_path / "other", "broken: {}"))


def test_placements_cannot_express_a_slack(plan):
    with pytest.raises(ParameterError, match=r"x_slide\.slack"):
        plan.robot.with_errors({"x_slide.slack": 1e-5})
    assert not plan.robot.parameters.are_rigid("x_slide.slack")


def test_an_error_that_is_never_negative_has_a_bound(plan, problem):
    of_slack = np.array([n.endswith(".slack") for n in problem.free])
    assert (problem.selection.lower[of_slack] == 0.0).all()
    assert np.isneginf(problem.selection.lower[~of_slack]).all()
    bounded = build_problem(plan, free=FREE, bounds={"*.slack": (-1.0, 1e-4)}).selection
    assert (bounded.lower[of_slack] == 0.0).all()


# ---- loop closures and conditions


def test_each_posture_under_other_conditions_is_another_loop_closure(plan, folder, tmp_path):
    o = build_observations(plan)
    approach, temperature = o.conditions["approach"], o.conditions["temperature"]
    read = {
        (p, tuple(a), t)
        for p, a, t in zip(o.posture, approach.tolist(), temperature[:, 0].tolist(), strict=True)
    }
    assert o.states.posture.size == len(read)
    assert len(o.states.variant_commands) == len({t for *_, t in read})
    assert (o.states.posture[o.state] == o.posture).all()
    assert len(set(o.states.names)) == o.states.posture.size
    at = o.states.commands[o.state]
    assert np.array_equal(at[:, 3:6], approach)
    assert np.array_equal(at[:, 6:], temperature)
    assert (o.states.posture[o.states.first_of_posture] == np.arange(len(plan.postures))).all()
    # without an effect that needs them there is one for each posture
    shutil.copytree(folder, tmp_path / "plain")
    text = (tmp_path / "plain/session.yaml").read_text()
    (tmp_path / "plain/session.yaml").write_text(text.replace("machine", "orthoglide", 1))
    plain = build_observations(load_plan(tmp_path / "plain"))
    assert np.array_equal(plain.states.posture, np.arange(len(plan.postures)))
    assert np.array_equal(plain.state, plain.posture)
    assert np.array_equal(plain.conditions["approach"], approach)


def test_unstated_conditions_are_neutral(tmp_path):
    session = load_plan(write_plan(tmp_path / "plan", effects=KEYS, conditions=False))
    o = build_observations(session)
    assert o.states.posture.size == len(session.postures)
    moved = {n: v for n, v in TRUTH.items() if n.endswith(("slack", "growth"))}
    found = predict_readings(session, moved)
    assert np.array_equal(found, predict_readings(session, {}))


def test_time_counts_from_the_first_reading_of_the_setup(plan):
    o, sensor = build_observations(plan), plan.setups["yx"].sensor
    assert reading_conditions(plan.robot, sensor) == ("approach", "temperature", "time")
    for setup in np.unique(o.setup):
        seconds = o.conditions["time"][o.setup == setup, 0]
        assert np.array_equal(seconds, 60.0 * np.arange(seconds.size))


def test_longer_rods_are_a_longer_leg(plan):
    """Errors of geometry change all rods of a leg by the same length."""
    longer = 10.0 * 20e-6  # [m/m], at 30 °C
    lengths = {f"{k}_leg.length": longer * plan.robot.legs[k].rods["a"].length for k in "xyz"}
    drives = plan.robot.drive_zero + 0.02
    warm = np.r_[drives, 0.0, 0.0, 0.0, 30.0]
    grown = LoopClosure(plan.robot, fixed={"rods.growth": 20e-6}).forward(warm)
    assert np.abs(grown - LoopClosure(plan.robot, fixed=lengths).forward(drives)).max() < CLOSED
    cold = LoopClosure(plan.robot, fixed={"rods.growth": 20e-6}).forward(drives)
    assert np.abs(cold - LoopClosure(plan.robot).forward(drives)).max() < CLOSED


# ---- derivatives


def test_the_jacobian_is_that_of_the_readings(problem):
    theta = point(problem)
    _, jacobian = problem.predict_and_jacobian(theta)
    assert_jacobian(problem, theta, jacobian)
    assert (np.abs(jacobian).max(axis=0) > 0.0).all()


def test_the_derivatives_of_the_error_map_are_exact(plan):
    """Twists and drives under conditions, by every error and by the commanded coordinates."""
    map_ = error_map(plan.robot)
    rng = np.random.default_rng(1)
    errors = 1e-3 * rng.normal(size=len(map_.names))
    command = np.r_[plan.robot.drive_zero + 0.01, 1.0, -1.0, 1.0, 27.0]
    twists = map_.twist_jacobian(errors, np.eye(errors.size), command)
    assert_derivative(twists, lambda e: map_.twists_of(e, command), errors)
    assert map_.twists_moved_by(np.eye(errors.size)[:, map_.names.index("rods.growth"), None]).sum()
    geometry = map_.geometry(errors, command)
    by_commands, by_errors = geometry.drive_derivatives(command)

    def drives(values):
        return map_.actuate(np.r_[values[:3], command[3:]][None], values[3:][None])[0]

    exact_by = np.hstack([by_commands, by_errors])
    assert_derivative(exact_by, drives, np.r_[command[:3], geometry.drive_errors])


def test_the_tool_sensitivity_and_the_inverse_are_exact(plan):
    free = ("x_slide.slack", "y_slide.wave", "z_slide.scale", "x_coupler.rx")
    at = {"x_slide.wave": 2e-3, "y_slide.wave": 1e-3, "x_coupler.rx": 1e-3}
    drives = np.array([[0.011, -0.02, 0.007]]) + plan.robot.drive_zero
    by = ToolSensitivity(plan.robot, free=free, values=at)(drives)[0]
    assert_derivative(
        by,
        lambda t: LoopClosure(plan.robot, free=free, fixed=at).forward(drives[0], theta=t),
        np.array([at.get(n, 0.0) for n in free]),
    )
    closure = LoopClosure(plan.robot, fixed=at)
    assert np.abs(closure.inverse(closure.forward(drives)) - drives).max() < CLOSED


def test_the_program_has_exact_derivatives(plan):
    few = plan.select([r for r in plan.readings if r.setup == "yx"])
    problem = build_problem(few, free=FREE, prior=True)
    program = NonlinearProgram(problem, options=SolverOptions(hessian="exact"))
    x = program.initial_variables(point(problem), sigma=1e-4)
    p = program.parameter_values(sigma=1e-4)
    assert_program_derivatives(program.functions(), x, p, weight=1.0, directions=6, seed=4)


# ---- identification


@pytest.fixture(scope="module")
def simulated(plan):
    return simulate_session(plan, TRUTH, seed=6, sigma=0.2e-6)


def test_estimates_of_slack_are_never_negative(plan):
    """Without slack half of the unbounded estimates would be negative."""
    exact_plan = exact(plan)
    without = {n: v for n, v in TRUTH.items() if not n.endswith("slack")}
    session = simulate_session(exact_plan, without, seed=3, sigma=1e-6).session
    problem = build_problem(session, free=FREE, prior=True)
    projected, program = (P(problem).solve(sigma=1e-6) for P in SOLVERS)
    of_slack = [i for i, n in enumerate(problem.free) if n.endswith("slack")]
    assert (projected.theta[of_slack] >= 0.0).all()
    assert (projected.at_bound[of_slack] == program.at_bound[of_slack]).all()
    assert (projected.at_bound[of_slack] == -1).any()


def test_a_calibration_file_keeps_the_effect_and_its_conditions(simulated, tmp_path):
    result, _ = identify(simulated.session, Choice(free=FREE), **QUICK)
    assert result["x_slide.slack"].value == pytest.approx(
        30e-6, abs=4 * result["x_slide.slack"].std
    )
    write_calibration(result, tmp_path / "calibration.json")
    again = load_calibration(tmp_path / "calibration.json")
    restored = restore_session(again)
    for r, s in zip(restored.readings, simulated.session.readings, strict=True):
        assert r.conditions == s.conditions
    assert again["rods.growth"].unit == "1/K"


def test_joined_sessions_share_the_machine_but_not_the_gauges(simulated):
    joined = join_sessions([simulated.session, simulated.session])
    problem = build_problem(joined, free=FREE, prior=True)
    assert sum(n.endswith(".creep") for n in problem.free) == 12
    assert sum(n == "rods.growth" for n in problem.free) == 1


def test_readings_without_the_condition_are_refused(tmp_path):
    folder = write_plan(tmp_path / "plan", effects=KEYS, conditions=False)
    session = simulate_session(load_plan(folder), {"x_slide.offset": 1e-4}, seed=1).session
    with pytest.raises(SessionError, match="needs the approach"):
        identify(session, Choice(free=FREE, effects=["slack"]))
    numbered = tuple(replace(r, line=i + 2) for i, r in enumerate(session.readings))
    last, n = f"lines 2 to {len(numbered) + 1}", len(numbered)
    with pytest.raises(SessionError) as caught:
        identify(replace(session, readings=numbered), Choice(free=FREE, effects=["slack"]))
    assert f"column `approach` is missing or empty in {last}. The effect" in str(caught.value)
    assert f"{n} of {n} readings" in str(caught.value)
    one = session.readings[0]
    other = next(r for r in session.readings if r.posture != one.posture)
    difference = replace(session, readings=(replace(one, minus=other.posture),))
    with pytest.raises(SessionError, match="belongs to two postures, so that it states no cond"):
        identify(difference, Choice(free=FREE, effects=["slack"]))
    # errors of an effect that only the robot has keep their tolerances
    kept = identify(session, Choice(free=FREE), **QUICK)[0]["x_slide.slack"]
    assert (kept.value, kept.std) == pytest.approx((0.0, 40e-6), rel=1e-6)
    assert identify(session, "offsets", **QUICK)[0].free
    # unless some of the readings state the condition
    first, *others = simulate_session(load_plan(folder), {}, seed=1).session.readings
    stated = replace(first, conditions=Conditions(approach="ppn", temperature=21.0))
    some = replace(session, readings=(stated, *others))
    with pytest.raises(SessionError, match=f"{len(others)} of {len(others) + 1}"):
        identify(some, Choice(free=FREE), **QUICK)
