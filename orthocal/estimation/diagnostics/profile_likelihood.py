"""Profile-likelihood intervals, which are valid for nonlinear problems.

One parameter is held at a value and all others are estimated again. The interval contains the
values that increase twice the objective by at most q²,

    2 (F(θᵢ) − F(θ̂)) ≤ q²

with q Student's factor, as for a linear problem (Bates and Watts, Nonlinear Regression
Analysis, 1988, section 6.1). The noise is fixed at its estimate.
"""

from __future__ import annotations

import math

from orthocal.errors import ClosureError, NotIdentifiableError, SolverError
from orthocal.estimation.fit import Fit
from orthocal.statistics.chance import confidence_factor

SETTLED = 1e-3
"""Tolerance of the ends of an interval, [standard deviations]."""

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
        NotIdentifiableError: If the noise is unknown.
        SolverError: If a solution does not converge.
    """
    index = fit.problem.free.index(name)
    noise = fit.noise
    factor = confidence_factor(noise.dof, level)
    if not (math.isfinite(noise.sigma) and noise.sigma > 0.0 and math.isfinite(factor)):
        raise NotIdentifiableError(
            f"the noise is unknown, so {name} has no interval", parameters=(name,)
        )
    low, high = (_find_end(fit, index, factor, side) for side in (-1.0, 1.0))
    return low, high


def _find_end(fit: Fit, index: int, factor: float, side: float) -> float:
    """End of the interval, where the square root of twice the rise of the objective is `factor`."""
    problem, best, sigma = fit.problem, fit.solution, fit.sigma
    base = fit.program.solve(sigma=sigma, start=best.theta, start_passive=best.passive)
    centre = float(base.theta[index])
    bound = float((problem.selection.lower if side < 0.0 else problem.selection.upper)[index])
    room = abs(bound - centre)
    std = math.sqrt(float(fit.covariance()[index, index]))
    if std == 0.0:  # at a bound
        std = float(problem.theta_scale[index])

    def rise(distance: float) -> float:
        solution = fit.program.solve(
            sigma=sigma,
            start=best.theta,
            start_passive=best.passive,
            prescribed={index: centre + side * distance},
        )
        # a decrease is rounding
        return math.sqrt(max(2.0 * (solution.objective - base.objective), 0.0)) - factor

    inside, outside, step = 0.0, None, 1.2 * factor * std
    for _ in range(MAX_DOUBLINGS):
        trial = min(inside + step, room)
        try:
            beyond = rise(trial) > 0.0
        except (ClosureError, SolverError):  # the loops do not close at this distance
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
            f"the profile of {problem.free[index]} does not rise enough for an interval: the "
            "readings contain too little information about it",
            status="no interval",
            iterations=MAX_DOUBLINGS,
        )
    from scipy.optimize import brentq

    return centre + side * float(brentq(rise, inside, outside, xtol=SETTLED * std))
