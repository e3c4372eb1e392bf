"""Searches of plans, and simulated machines that are measured by a plan."""

from __future__ import annotations

import numpy as np
from bounds import rms_band

from orthocal import draw_errors
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.observation.gauge_noise import stated_sigma
from orthocal.planning.candidates import list_candidates, measure_candidates
from orthocal.planning.selection import SetupSearch


def candidates_of(forecast, equipment, *, spare_range=0.0):
    """Candidate setups of some equipment."""
    session = list_candidates(forecast.robot, equipment)
    return measure_candidates(session, forecast.problem(session), spare_range=spare_range)


def search_among(candidates, forecast, *, criterion="aligned", prior=1.0):
    """Search among candidates; `prior` is the information about each error in its prior."""
    n = len(candidates.state)
    return SetupSearch.of(candidates, prior * np.eye(n), forecast.weight_of(criterion, n))


def calibrate_drawn(plan, count, *, offset_mm=1.0):
    """Calibrate machines whose errors, of machine and mounting, are drawn from their priors.

    Returns:
        Problem of the plan; true and estimated parameters, each of shape (count, n_free), [SI].
    """
    problem = plan.forecast.problem(plan.session)
    names, rng = problem.machine_selection.names, np.random.default_rng(0)
    truth = rng.normal(size=(count, problem.n_free)) * problem.theta_scale
    tolerances = {"*.offset_mm": offset_mm}
    for seed in range(count):
        drawn = draw_errors(plan.session.robot, names, seed=seed, tolerances=tolerances)
        truth[seed, : len(names)] = [drawn[n] for n in names]
    values, _, reached = problem.simulate(truth)
    assert reached.all()
    sigma = stated_sigma(plan.session.gauge)
    values = values + sigma * rng.normal(size=values.shape)
    return problem, truth, BatchSolver(problem).solve(values, sigma=sigma).theta


def assert_machines_have_the_expected_error(plan, *, count=25, offset_mm=1.0):
    """Compare tool errors of calibrated machines, in closed loops, with the expected error."""
    problem, truth, found = calibrate_drawn(plan, count, offset_mm=offset_mm)
    forecast, names = plan.forecast, problem.machine_selection.names
    closure, weights = LoopClosure(plan.session.robot, free=names), forecast.workspace.weights
    drives = closure.inverse(forecast.workspace.points)
    shown, real = (closure.forward(drives, theta=t[:, : len(names)]) for t in (found, truth))
    aligned = forecast.align(np.moveaxis(shown - real, 0, -1))
    rms = np.sqrt(np.mean(weights @ (aligned**2).sum(axis=1)))
    field = forecast.align(forecast.jacobian)
    low, high = rms_band(field, weights, plan.expected.covariance, count)
    assert low < rms / plan.expected.reported.rms < high
