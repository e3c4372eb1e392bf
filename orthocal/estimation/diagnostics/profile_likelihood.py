"""Profile-likelihood intervals, which are valid for nonlinear problems.

One parameter is prescribed and all others are estimated again. The interval contains the values
with

    2 (F(θᵢ) − F(θ̂)) ≤ q²,  q = U_F/s

for the objective F (Bates and Watts, Nonlinear Regression Analysis, 1988, section 6.1). U_F is the
expanded uncertainty from noise and priors, and s² = [A⁻¹]ᵢᵢ with the curvature A of F. In a linear
problem the ends are the estimate ± U_F. For a stated noise and a tolerance scale of 1, q is 2. If
the tolerance scale explains the residuals, F weighs them by more than their noise, and q is
smaller: it is the correction of a likelihood with other variances than the true ones (Kent,
Biometrika 69, 1982). Unmodelled errors are not parameters of F. They widen each side in quadrature.
"""

from __future__ import annotations

import math

from orthocal.errors import ClosureError, NotIdentifiableError, SolverError
from orthocal.estimation.fit import Fit
from orthocal.statistics.chance import coverage_factor

END_TOLERANCE = 1e-3
"""Tolerance of the ends of an interval, [standard deviations]."""

MAX_TRIALS = 12
"""Largest number of trials for a value outside the interval."""


def profile_interval(
    fit: Fit, name: str, *, uncertainty: float, bias: float = 0.0
) -> tuple[float, float]:
    """Profile-likelihood interval of a free parameter.

    Args:
        fit: The solved problem.
        name: Name of the parameter.
        uncertainty: Expanded uncertainty U_F of the linearised problem from noise and priors, [SI].
            At a bound it is 0, and the coverage factor of the noise replaces q.
        bias: Expanded uncertainty from unmodelled errors, [SI].

    Returns:
        Lowest and highest value within the bounds of the parameter, [SI].

    Raises:
        NotIdentifiableError: If the noise is unknown.
        SolverError: If a solution does not converge.
    """
    index, noise = fit.problem.free.index(name), fit.noise
    if not (0.0 < noise.sigma < math.inf and math.isfinite(uncertainty)):
        raise NotIdentifiableError(
            f"the noise is unknown, so {name} has no interval", parameters=(name,)
        )
    std = math.sqrt(float(fit.inverse_normal()[index, index]))
    factor = uncertainty / std if std > 0.0 else coverage_factor(noise.dof)
    std = std or float(fit.problem.theta_scale[index])  # 0 at a bound
    low, high = (_find_end(fit, index, factor, std, side) for side in (-1.0, 1.0))
    value, selection = float(fit.solution.theta[index]), fit.problem.selection
    return (
        max(value - math.hypot(value - low, bias), float(selection.lower[index])),
        min(value + math.hypot(value - high, bias), float(selection.upper[index])),
    )


def _find_end(fit: Fit, index: int, factor: float, std: float, side: float) -> float:
    """End of the interval, where 2 (F(θᵢ) − F(θ̂)) = q², or the bound before it.

    Args:
        fit: The solved problem.
        index: Index of the parameter.
        factor: Factor q.
        std: Standard deviation s, or at a bound the prior one, [SI].
        side: -1 for the lower end, 1 for the upper end.
    """
    problem, best, sigma = fit.problem, fit.solution, fit.sigma
    optimum = fit.program.solve(sigma=sigma, start=best.theta, start_passive=best.passive)
    centre = float(optimum.theta[index])
    bound = float((problem.selection.lower if side < 0.0 else problem.selection.upper)[index])
    to_bound = abs(bound - centre)

    def excess(distance: float) -> float:
        """√(2 (F(θᵢ) − F(θ̂))) − q at a distance from the optimum, [SI]."""
        solution = fit.program.solve(
            sigma=sigma,
            start=best.theta,
            start_passive=best.passive,
            prescribed={index: centre + side * distance},
        )
        increase = max(solution.objective - optimum.objective, 0.0)  # a decrease is rounding
        return math.sqrt(2.0 * increase) - factor

    # the first trial is just outside the interval of a linear problem
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
