"""Profile-likelihood intervals, which are valid for nonlinear problems.

One parameter is prescribed and all others are estimated again. The interval contains the values
with

    2 (F(θᵢ) − F(θ̂)) ≤ q²

for the objective F and Student's factor q of a linear problem (Bates and Watts, Nonlinear
Regression Analysis, 1988, section 6.1). The noise is fixed at its estimate.
"""

from __future__ import annotations

import math

from orthocal.errors import ClosureError, NotIdentifiableError, SolverError
from orthocal.estimation.fit import Fit
from orthocal.statistics.chance import confidence_factor

END_TOLERANCE = 1e-3
"""Tolerance of the ends of an interval, [standard deviations]."""

MAX_TRIALS = 12
"""Largest number of trials for a value outside the interval."""


def profile_interval(fit: Fit, name: str, *, level: float = 0.95) -> tuple[float, float]:
    """Profile-likelihood interval of a free parameter.

    Args:
        fit: The solved problem.
        name: Name of the parameter.
        level: Probability that the interval contains the true value.

    Returns:
        Lowest and highest value within the bounds of the parameter, [SI].

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
    """End of the interval, where 2 (F − F̂) = factor², or the bound before it.

    Args:
        fit: The solved problem.
        index: Index of the parameter.
        factor: Student's factor q.
        side: -1 for the lower end, 1 for the upper end.
    """
    problem, best, sigma = fit.problem, fit.solution, fit.sigma
    optimum = fit.program.solve(sigma=sigma, start=best.theta, start_passive=best.passive)
    centre = float(optimum.theta[index])
    bound = float((problem.selection.lower if side < 0.0 else problem.selection.upper)[index])
    to_bound = abs(bound - centre)
    std = math.sqrt(float(fit.covariance()[index, index]))
    if std == 0.0:  # at a bound
        std = float(problem.theta_scale[index])

    def excess(distance: float) -> float:
        """√(2 (F − F̂)) − factor at a distance from the optimum, [SI]."""
        solution = fit.program.solve(
            sigma=sigma,
            start=best.theta,
            start_passive=best.passive,
            prescribed={index: centre + side * distance},
        )
        increase = max(solution.objective - optimum.objective, 0.0)  # a decrease is rounding
        return math.sqrt(2.0 * increase) - factor

    inside, outside, step = 0.0, None, 1.2 * factor * std
    for _ in range(MAX_TRIALS):
        trial = min(inside + step, to_bound)
        try:
            is_outside = excess(trial) > 0.0
        except (ClosureError, SolverError):  # the loops do not close at this distance
            step *= 0.25
            continue
        if is_outside:
            outside = trial
            break
        if trial == to_bound:
            return bound
        inside, step = trial, 2.0 * step
    if outside is None:
        raise SolverError(
            f"the readings contain too little information about {problem.free[index]} for a "
            "profile-likelihood interval",
            status="no interval",
            iterations=MAX_TRIALS,
        )
    from scipy.optimize import brentq

    return centre + side * float(brentq(excess, inside, outside, xtol=END_TOLERANCE * std))
