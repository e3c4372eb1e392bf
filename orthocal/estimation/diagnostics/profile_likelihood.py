"""Profile-likelihood intervals: those that hold where the problem is not linear.

One parameter is held at a value and all others are identified again; the interval holds the values
for which this costs no more than q² in twice the objective,

    2 (F(θᵢ) − F(θ̂)) ≤ q²

with q Student's factor, as a linear problem would have it (Bates and Watts, Nonlinear Regression
Analysis, 1988, section 6.1). Noise is held at its estimate.
"""

from __future__ import annotations

import math

from orthocal.errors import ClosureError, NotIdentifiableError, SolverError
from orthocal.estimation.fit import Fit
from orthocal.statistics.chance import confidence_factor

SETTLED = 1e-3
"""Ends of an interval are found to this part of a standard deviation."""

MAX_DOUBLINGS = 12


def profile_interval(fit: Fit, name: str, *, level: float = 0.95) -> tuple[float, float]:
    """Profile-likelihood interval of a free parameter.

    Args:
        fit: The solved problem.
        name: Of the parameter.
        level: Probability that the interval holds the true value.

    Returns:
        Lowest and highest value, [SI]; a bound of the parameter where that comes first.

    Raises:
        NotIdentifiableError: If nothing tells the noise, or the parameter.
        SolverError: If a solution does not converge.
    """
    index = fit.problem.free.index(name)
    noise = fit.noise
    factor = confidence_factor(noise.dof, level)
    if not (math.isfinite(noise.sigma) and noise.sigma > 0.0 and math.isfinite(factor)):
        raise NotIdentifiableError(
            f"nothing tells the noise, so {name} has no interval", parameters=(name,)
        )
    low, high = (_find_end(fit, index, factor, side) for side in (-1.0, 1.0))
    return low, high


def _find_end(fit: Fit, index: int, factor: float, side: float) -> float:
    """Where the root of the rise of the objective, straight for a linear problem, is `factor`."""
    problem, best, sigma = fit.problem, fit.solution, fit.sigma
    base = fit.program.solve(sigma=sigma, start=best.theta, start_passive=best.passive)
    centre = float(base.theta[index])
    bound = float((problem.selection.lower if side < 0.0 else problem.selection.upper)[index])
    room = abs(bound - centre)
    std = math.sqrt(float(fit.covariance()[index, index]))
    if std == 0.0:  # a bound holds it
        std = float(problem.theta_scale[index])

    def rise(distance: float) -> float:
        solution = fit.program.solve(
            sigma=sigma,
            start=best.theta,
            start_passive=best.passive,
            held={index: centre + side * distance},
        )
        # a little better than the best is rounding
        return math.sqrt(max(2.0 * (solution.objective - base.objective), 0.0)) - factor

    inside, outside, step = 0.0, None, 1.2 * factor * std
    for _ in range(MAX_DOUBLINGS):
        trial = min(inside + step, room)
        try:
            beyond = rise(trial) > 0.0
        except (ClosureError, SolverError):  # so far the loops do not close
            step *= 0.25
            continue
        if beyond:
            outside = trial
            break
        if trial == room:
            return bound
        inside, step = trial, 2.0 * step
    if outside is None:
        raise SolverError(
            f"the profile of {problem.free[index]} does not rise as an interval needs: the "
            "readings say too little of it",
            status="no interval",
            iterations=MAX_DOUBLINGS,
        )
    from scipy.optimize import brentq

    return centre + side * float(brentq(rise, inside, outside, xtol=SETTLED * std))
