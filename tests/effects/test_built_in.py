"""Derivatives of the effects of orthocal, and their identification with all solvers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from derivatives import assert_jacobian
from effect_plans import ALL, effect_plan
from tolerances import SAME_OPTIMUM

from orthocal import simulate_session
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.estimation.solvers.variable_projection import VariableProjection
from orthocal.measurement.joining import join_sessions
from orthocal.statistics.zeros import project_out_zeros

SIGMA = 1e-6
SOME = ("*.offset", "*.scale", "x_coupler.*", "y_leg.length")
"""Errors of geometry beside those of the effects."""


@pytest.fixture(scope="module")
def plan():
    return effect_plan(*ALL)


def errors_of(plan):
    """Names of the errors of effects."""
    geometry = plan.robot.parameters.names
    plain = plan.with_effects([]).robot.parameters.names
    return [n for n in geometry if n not in plain]


def build(plan):
    return build_problem(plan, free=(*SOME, *errors_of(plan)), prior=True)


def point(problem, seed=2):
    """Free parameters away from the nominal machine, in SI."""
    theta = 0.7 * problem.theta_scale * np.random.default_rng(seed).normal(size=problem.n_free)
    theta[[n.endswith(".offset") for n in problem.free]] *= 0.1
    return np.maximum(theta, problem.selection.lower)


def test_derivatives_are_those_of_the_readings(plan):
    """Two machines at once, under many conditions."""
    problem = build(plan)
    thetas = np.array([point(problem, seed) for seed in (3, 4)])
    _, jacobians = problem.predict_and_jacobian(thetas)
    for theta, jacobian in zip(thetas, jacobians, strict=True):
        assert_jacobian(problem, theta, jacobian, step=1e-2, least=1e-8)
    names = [*errors_of(plan), *(n for n in problem.free if n.endswith(".drift"))]
    at = [problem.free.index(n) for n in names]
    assert len(at) == 3 + 2 + 6 + 6
    assert (np.abs(jacobians[:, :, at]).max(axis=1) > 0.0).all()


def require_same(problem, sigma=SIGMA):
    """Refuse solvers with different solutions; return that of variable projection."""
    projected = VariableProjection(problem).solve(sigma=sigma)
    for solution in (
        NonlinearProgram(problem).solve(sigma=sigma).theta,
        BatchSolver(problem).solve(problem.values[None], sigma=sigma).theta[0],
    ):
        off = np.abs(solution - projected.theta) / problem.theta_scale
        assert off.max() < SAME_OPTIMUM / 1e-4
    return projected


def simulate(plan, errors, seed=5):
    return simulate_session(plan, errors, seed=seed, sigma=SIGMA)


def covariance(problem, theta):
    """Posterior covariance, [prior std²]."""
    _, jacobian = problem.predict_and_jacobian(theta)
    centred = project_out_zeros(jacobian, problem.observations)
    return np.linalg.inv(centred.T @ centred / SIGMA**2 + np.eye(problem.n_free))


def test_all_solvers_identify_the_same_errors(plan):
    problem = build(plan)
    truth = dict(zip(problem.free, point(problem), strict=True))
    simulated = simulate(plan, {n: truth[n] for n in problem.machine_selection.names})
    problem = build(simulated.session)
    found = require_same(problem)
    expected = np.array([(truth | simulated.nuisance)[n] for n in problem.free])
    stds = np.sqrt(np.diag(covariance(problem, found.theta)))
    assert (np.abs(found.theta - expected) / problem.theta_scale < 4.0 * stds).all()
    determined = [problem.free.index(n) for n in errors_of(plan) if n.endswith("backlash")]
    assert (stds[determined] < 0.2).all()


def difference_of_expansions(problem, theta):
    """Expansion of legs minus screws, value and std, [prior std]; their sum is a scale."""
    names = ("legs.expansion", "screws.expansion")
    along = np.array([float(n == names[0]) - float(n == names[1]) for n in problem.free])
    spread = np.sqrt(along @ covariance(problem, theta) @ along)
    return along @ (theta / problem.theta_scale), spread


def test_two_temperatures_determine_the_expansions(plan):
    """At one temperature they cannot be distinguished from errors of geometry."""
    plan = plan.with_effects(["thermal"])

    def at(temperature):
        readings = tuple(
            replace(r, conditions=replace(r.conditions, temperature=temperature))
            for r in plan.readings
        )
        return replace(plan, readings=readings)

    errors = {"legs.expansion": 2.4e-6, "screws.expansion": -1.9e-6, "x_slide.offset": 0.5e-3}
    days = [simulate(at(t), errors, seed=int(t)).session for t in (16.0, 27.0)]
    problem = build(join_sessions(days))
    found = require_same(problem)
    value, std = difference_of_expansions(problem, found.theta)
    parameter = plan.robot.parameters["legs.expansion"]
    assert abs(value - (2.4e-6 + 1.9e-6) / parameter.prior_std) < 4.0 * std
    alone = build(days[1])
    _, std_alone = difference_of_expansions(alone, np.zeros(alone.n_free))
    assert std_alone > 0.99 * np.sqrt(2.0)  # as before any reading
    assert std < 0.65 * std_alone
