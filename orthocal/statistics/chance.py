"""Significance tests and coverage factors."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.statistics.distributions import (
    chi_square_tail,
    f_tail,
    incomplete_beta,
    least_number,
    t_quantile,
)

BY_CHANCE = 0.01
"""Significance level of tests of residuals against noise."""

COVERAGE = 2.0
"""Coverage factor k of an expanded uncertainty."""


def chance_of_excess(chi_square: float, dof: float, *, cycles_dof: float = 0.0) -> float:
    """Probability of residuals at least as large from noise alone.

    Args:
        chi_square: Σ r²/σ² of single readings with gauge zeros eliminated.
        dof: Degrees of freedom of the residuals.
        cycles_dof: Degrees of freedom of σ from repeated cycles, for an F test of the residuals
            without the scatter of the cycles; 0 for a stated σ, for a χ² test.
    """
    if cycles_dof == 0.0:
        return chi_square_tail(dof, chi_square)
    excess_square, excess_dof = chi_square - cycles_dof, dof - cycles_dof
    if excess_dof <= 0.5 or excess_square <= 0.0:
        return 1.0
    return f_tail(excess_dof, cycles_dof, excess_square / excess_dof)


def chance_of_equal_readings(equal: int, count: int, *, sigma: float, step: float) -> float:
    """Probability that at least `equal` of `count` repeated readings are equal by chance.

    A repeated reading differs from the first by d before both are rounded, with standard deviation
    √2 σ. After rounding they are equal with probability E[max(0, 1 − |d|/step)].

    Args:
        equal: Number of repeated readings that are equal to the last digit.
        count: Number of repeated readings.
        sigma: Standard deviation of one reading, [m].
        step: Step to which the dial is read, [m].
    """
    s = math.sqrt(2.0) * sigma / step
    if s == 0.0:
        return 1.0
    chance = math.erf(1.0 / (s * math.sqrt(2.0))) + s * math.sqrt(2.0 / math.pi) * math.expm1(
        -0.5 / s**2
    )
    return incomplete_beta(equal, count - equal + 1.0, chance) if equal else 1.0  # binomial tail


def confidence_factor(dof: float, level: float = 0.95) -> float:
    """Half width of a confidence interval, in standard deviations (Student's t distribution).

    It is infinite if `dof` is not positive.
    """
    tail = 0.5 + level / 2.0
    if math.isinf(dof):
        return NormalDist().inv_cdf(tail)
    return t_quantile(dof, tail) if dof > 0 else float("inf")


def coverage_factor(dof: float) -> float:
    """Coverage factor of noise: k = 2, or Student's factor for 95 % if that is larger.

    It is NaN if `dof` is not positive, because then the noise is unknown.
    """
    factor = confidence_factor(dof)
    return max(COVERAGE, factor) if math.isfinite(factor) else math.nan


def bounded_interval(
    value: float, uncertainty: float, lower: float, upper: float
) -> tuple[float, float]:
    """Shortest interval of a normal distribution about a value that is truncated at bounds.

    Its coverage is that of the expanded uncertainty with k = 2. Without bounds it is the value ±
    that uncertainty. It is NaN if the uncertainty is unknown.

    Args:
        value: Most likely value, within the bounds.
        uncertainty: Expanded uncertainty, two standard deviations.
        lower: Lower bound; -inf without one.
        upper: Upper bound; inf without one.
    """
    if not 0.0 < uncertainty < math.inf:
        return value - uncertainty, value + uncertainty
    # lengths are in √2 standard deviations, the unit of the argument of erf
    to_deviations = COVERAGE / uncertainty / math.sqrt(2.0)
    below, above = ((value - lower) * to_deviations, (upper - value) * to_deviations)

    def doubled_coverage(half_width: float) -> float:
        """Twice the coverage of an interval without truncation of the distribution."""
        return math.erf(min(half_width, below)) + math.erf(min(half_width, above))

    required = math.erf(COVERAGE / math.sqrt(2.0)) * doubled_coverage(math.inf)
    half_width = least_number(lambda h: doubled_coverage(h) >= required) / to_deviations
    return max(value - half_width, lower), min(value + half_width, upper)


def expanded_uncertainty(
    std: ArrayLike,
    std_scatter: ArrayLike,
    std_scaled: ArrayLike,
    *,
    noise_factor: float,
    contrasts: float = math.inf,
) -> Array:
    """Expanded uncertainty U of estimates, of any shape, in their unit.

    U² = k_σ² s² + k_n² t² + 2² (u² − s² − t²). Noise causes the part s of u, and errors whose scale
    was estimated from n contrasts cause the part t. Each has its coverage factor. The variance of
    the other part is known.

    The parts are independent, and so are the estimates of their variances. Then U covers at least
    what its factors cover, 95 % (Banerjee, Sankhya 22, 1960). Effective degrees of freedom (Welch
    and Satterthwaite, GUM G.4) would cover 93 % if two contrasts caused three quarters of u².

    Args:
        std: Standard deviations u from all contributions.
        std_scatter: Parts s of them from the noise of the readings.
        std_scaled: Parts t of them from errors that the tolerance scale multiplies.
        noise_factor: Coverage factor k_σ of the noise.
        contrasts: Number n of contrasts that determine the tolerance scale; infinite if it was not
            estimated.
    """
    total, scatter, scaled = (
        np.square(np.asarray(part, dtype=np.float64)) for part in (std, std_scatter, std_scaled)
    )
    known = np.maximum(total - scatter - scaled, 0.0)
    factors = (noise_factor, coverage_factor(contrasts), COVERAGE)
    parts = (scatter, scaled, known)
    return np.asarray(np.sqrt(sum(k**2 * v for k, v in zip(factors, parts, strict=True))))
