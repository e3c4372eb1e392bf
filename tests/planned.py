"""Plans that several files of tests share, and machines that are measured by a plan."""

from __future__ import annotations

from functools import cache

import numpy as np
from bounds import rms_band
from uncompared import uncompared

from orthocal import draw_errors, load_robot, plan_readings
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.observation.gauge_noise import stated_sigma
from orthocal.planning.equipment import Equipment

FEW = {"along": 3, "across": 0.0, "sections": (0.5,)}
"""Arguments of Equipment with the fewest candidate readings."""

QUICK = {"along": 5, "across": 0.0, "sections": (0.5,)}
"""Arguments of Equipment with few candidate readings."""


def entered(robot):
    """A packaged robot whose offsets were entered: ±1 mm remain."""
    return load_robot(robot).with_tolerances({"*.offset_mm": 1.0})


@cache
def quick_plan(robot="orthoglide"):
    """Plan with a dial at the legs of a packaged robot."""
    with uncompared():
        return plan_readings(entered(robot), equipment=Equipment(**FEW), starts=1)


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
