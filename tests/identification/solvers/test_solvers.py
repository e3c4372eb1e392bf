"""The eliminated solver and Ipopt on the whole program: each checks the other."""

from __future__ import annotations

import numpy as np
import pytest

from orthocal import load_session
from orthocal.errors import SolverError
from orthocal.identification.loss import Loss
from orthocal.identification.options import SolverOptions
from orthocal.identification.problem import build_problem
from orthocal.identification.solvers.eliminated import EliminatedProgram
from orthocal.identification.solvers.ipopt import NonlinearProgram

AGREED = 1e-6
"""Largest difference of two solvers' parameters, [tolerances]."""

EXAMPLES = (
    "table1/experiment-1-printed",
    "table1/experiment-2",
    "table1/experiment-3",
    "raw-cycles",
    "sweep",
)
CHOICES = {
    "plain": {},
    "bounds": {"bounds": {"x_slide.offset": (-0.1e-3, 0.1e-3), "y_slide.offset": (0.6e-3, np.inf)}},
    "known": {"known": {"x_slide.offset": 0.3e-3, "y_slide.offset": (0.1e-3, 0.05e-3)}},
}


def both(problem, *, loss, sigma, **given):
    options = SolverOptions(loss=Loss(loss))
    programs = (
        EliminatedProgram(problem, options=options),
        NonlinearProgram(problem, options=options),
    )
    return [program.solve(sigma=sigma, **given) for program in programs]


@pytest.mark.parametrize("example", EXAMPLES)
@pytest.mark.parametrize("model", ["offsets", "lengths", "full"])
@pytest.mark.parametrize("loss", ["squares", "huber"])
@pytest.mark.parametrize("choice", CHOICES)
def test_two_solvers_find_one_optimum(root, example, model, loss, choice):
    session = load_session(root / "examples" / example)
    problem = build_problem(session, model=model, **CHOICES[choice])
    ours, ipopts = both(problem, loss=loss, sigma=20e-6)
    difference = np.abs(ours.theta - ipopts.theta) / problem.theta_scale
    assert difference.max() < AGREED
    assert np.abs(ours.zeros - ipopts.zeros).max() < 1e-9
    assert np.abs(ours.passive - ipopts.passive).max() < 1e-8
    assert ours.objective == pytest.approx(ipopts.objective, rel=1e-6)
    assert (ours.at_bound == ipopts.at_bound).all()
    if choice == "bounds":
        assert ours.at_bound.any()


def test_readings_left_out_and_parameters_held(root):
    problem = build_problem(load_session(root / "examples/raw-cycles"), model="lengths")
    given = {"left_out": [3, 11], "held": {0: 0.4e-3}}
    ours, ipopts = both(problem, loss="squares", sigma=10e-6, **given)
    assert np.abs((ours.theta - ipopts.theta) / problem.theta_scale).max() < AGREED
    assert ours.theta[0] == pytest.approx(0.4e-3, abs=1e-15)
    assert not ours.at_bound.any()
    free, _ = both(problem, loss="squares", sigma=10e-6)
    assert np.abs(free.theta - ours.theta).max() > 1e-5


def test_the_gradient_vanishes_by_central_differences(root):
    """No derivative of the solver's own is asked."""
    session = load_session(root / "examples/table1/experiment-1-printed")
    problem = build_problem(session, model="lengths")
    solution = EliminatedProgram(problem).solve(sigma=20e-6)
    o = problem.observations

    def objective(theta):
        deviation = problem.values - problem.predict(theta)
        counts = np.bincount(o.zero, minlength=o.n_zeros)
        residual = deviation - (np.bincount(o.zero, deviation) / counts)[o.zero]
        off = problem.prior_precision * (theta - problem.prior_mean) / problem.theta_scale
        return 0.5 * (residual @ residual) / 20e-6**2 + 0.5 * (off @ off)

    assert objective(solution.theta) == pytest.approx(solution.objective, rel=1e-9)
    for i, scale in enumerate(problem.theta_scale):
        step = np.zeros(problem.n_free)
        step[i] = 1e-3 * scale
        up, down = objective(solution.theta + step), objective(solution.theta - step)
        curvature = up + down - 2.0 * objective(solution.theta)
        # where the parabola through the three points has its lowest, in steps
        assert abs(0.5 * (down - up) / curvature) < 1e-4


def test_it_says_when_it_does_not_converge(root):
    problem = build_problem(load_session(root / "examples/sweep"), model="full")
    with pytest.raises(SolverError, match=r"the step is still .* after 1 iterations"):
        EliminatedProgram(problem, options=SolverOptions(max_iterations=1)).solve(sigma=5e-6)
