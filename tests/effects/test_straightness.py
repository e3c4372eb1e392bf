"""Placements that change along the travel of a drive: guides that are not straight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from derivatives import assert_derivative
from effect_plans import write_plan
from gauges import exact
from independent import Gauge, States
from straightness import BentMachine, Straightness
from tolerances import KINEMATICS, SAME_OPTIMUM

from orthocal import draw_errors, load_plan, simulate_session
from orthocal.effects import registry
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.estimation.solvers.variable_projection import VariableProjection
from orthocal.kinematics.conditions import UseConditions
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import build_observations, drive_table
from orthocal.sensors.tips import Tip

ACTIVE = np.array([1.5e-3, -2.0e-3, 0.7e-3])
"""[m] Offsets that are active while the gauges are mounted."""

EXACT = 1e-7
"""σ of exact readings, [m]: the prior of a bow changes it by less than 1e-9."""

BOWS = {"x_slide.bow": 40e-6, "y_slide.bow": -25e-6, "z_slide.bow": 60e-6}


@pytest.fixture(scope="module", autouse=True)
def registered():
    registry.register_effect(Straightness)
    yield
    registry.unregister_effect("straightness")


@pytest.fixture(scope="module")
def folder(tmp_path_factory, registered):
    return write_plan(tmp_path_factory.mktemp("bent") / "plan", effects="straightness: {}")


@pytest.fixture(scope="module")
def plan(folder):
    return exact(load_plan(folder)).with_controller(ACTIVE)


@pytest.fixture(scope="module")
def errors(plan):
    names = plan.robot.parameters.patterns("full")
    return {**draw_errors(plan.robot, names, seed=1, tolerances={"*.offset_mm": 4.0}), **BOWS}


@pytest.fixture(scope="module")
def closure(plan, errors):
    return LoopClosure(plan.robot, fixed=errors)


def points(closure):
    drives = closure.robot.drive_zero + np.array([[0, 0, 0], [30, -70, 20], [-80, 40, 50]]) * 1e-3
    return drives, closure.forward(drives)


def test_readings_are_those_of_the_independent_machine(folder, plan, errors):
    """Gauges are mounted in the reference posture of the setup."""
    o = build_observations(plan)
    assert o.states.posture.size == len(o.states.variant_commands) == len(plan.postures)
    drives = drive_table(plan)[o.posture]
    states = States(drives, np.zeros_like(drives), np.full(o.size, 20.0))
    machine = BentMachine(folder / "machine", errors, active=ACTIVE)
    gauges = [
        Gauge(s.sensor.leg, np.eye(3)["xyz".index(s.sensor.direction)], s.sensor.section.value)
        for s in plan.setups.values()
    ]
    (shown,) = machine.read(states, gauges, o.setup, np.arange(o.size))
    predicted = predict_readings(plan, errors)
    assert np.abs(shown - predicted).max() < KINEMATICS
    straight = predict_readings(plan, {n: v for n, v in errors.items() if n not in BOWS})
    assert np.ptp(predicted - straight) > 10e-6


def test_the_tool_is_that_of_the_independent_machine(folder, closure, errors):
    drives, tools = points(closure)
    states = States(drives, np.zeros_like(drives), np.full(len(drives), 20.0))
    (found,) = BentMachine(folder / "machine", errors).tool(states)
    assert np.abs(found - tools).max() < KINEMATICS
    for conditions in (None, UseConditions()):
        inverse = LoopClosure(closure.robot, fixed=errors, conditions=conditions).inverse(tools)
        assert np.abs(inverse - drives).max() < 10 * KINEMATICS


def test_sensitivities_are_central_differences(plan, errors, closure):
    drives, _ = points(closure)
    names = (*BOWS, "x_slide.offset", "y_slide.rz", "z_slide.y")
    at = np.array([errors[n] for n in names])

    def tool(values):
        fixed = {**errors, **dict(zip(names, values, strict=True))}
        return LoopClosure(plan.robot, fixed=fixed).forward(drives)

    assert_derivative(ToolSensitivity(plan.robot, free=names, values=errors)(drives), tool, at)
    problem = build_problem(plan, free=names, prior=True)
    theta = np.append(at, np.zeros(problem.n_free - at.size))
    _, jacobian = problem.predict_and_jacobian(theta, units="SI")
    n = problem.n_machine
    assert_derivative(
        jacobian[:, :n], lambda v: problem.predict(np.append(v, theta[n:])), theta[:n]
    )


def test_solvers_find_bows_from_exact_readings(plan):
    setups = {
        name: replace(s, sensor=s.sensor.on_rod("a", Tip("ball", 15e-3)))
        for name, s in plan.setups.items()
    }
    plan = replace(plan, setups=setups)
    truth = {"x_slide.offset": 1.8e-3, "y_slide.offset": -1.7e-3, "z_slide.offset": 0.5e-3, **BOWS}
    session = simulate_session(plan, truth, exact=True, seed=1).session
    problem = build_problem(session, free=tuple(truth), prior=False)
    expected = [truth[n] for n in problem.free]
    programs = [
        VariableProjection(problem),
        NonlinearProgram(problem),
        NonlinearProgram(problem, options=SolverOptions(hessian="exact")),
    ]
    for program in programs:
        found = program.solve(sigma=EXACT)
        assert np.abs(found.theta - expected).max() < SAME_OPTIMUM
    batch = BatchSolver(problem).solve(np.tile(problem.values, (2, 1)), sigma=EXACT)
    assert np.abs(batch.theta - expected).max() < SAME_OPTIMUM
