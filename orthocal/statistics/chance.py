"""What chance alone explains, and how wide an interval has to be."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

BY_CHANCE = 0.01
"""Probability below which residuals that are larger than noise are not put down to chance."""

COVERAGE = 2.0
"""Coverage factor k of an expanded uncertainty."""


def chance_of_excess(chi_square: float, dof: float, *, cycles_dof: float = 0.0) -> float:
    """Probability that noise alone leaves residuals as large, or larger.

    Args:
        chi_square: Σ r²/σ² of single readings, zeros eliminated.
        dof: Degrees of freedom of the residuals.
        cycles_dof: Those of σ, where it is from repeated cycles: an F test of what the residuals
            have beside the cycles' own scatter. 0 for a σ that was given: a χ² test.
    """
    if cycles_dof == 0.0:
        return chi_square_tail(dof, chi_square)
    rest, rest_dof = chi_square - cycles_dof, dof - cycles_dof
    if rest_dof <= 0.5 or rest <= 0.0:
        return 1.0
    return f_tail(rest_dof, cycles_dof, rest / rest_dof)


def confidence_factor(dof: float, level: float = 0.95) -> float:
    """Standard deviations on either side of an estimate that hold it with a probability."""
    tail = 0.5 + level / 2.0
    if math.isinf(dof):
        return normal_quantile(tail)
    return t_quantile(dof, tail) if dof > 0 else float("inf")


def coverage_factor(dof: float) -> float:
    """Coverage factor of noise: k = 2, or Student's factor for 95 % if that is larger.

    NaN where nothing determines the noise.
    """
    factor = confidence_factor(dof)
    return max(COVERAGE, factor) if math.isfinite(factor) else math.nan


def expanded_uncertainty(
    std: ArrayLike, std_scatter: ArrayLike, *, dof: float
) -> NDArray[np.float64]:
    """Expanded uncertainty U of estimates, of any shape, in their unit.

    U² = (k_ν s)² + k² (u² − s²), k = 2, with Student's factor k_ν for the part s that is due to
    noise estimated with ν degrees of freedom.

    Args:
        std: Standard deviations u, everything that is not known included.
        std_scatter: The parts s of them that are due to the noise of the readings.
        dof: Degrees of freedom ν of the noise.
    """
    total, scatter = np.asarray(std, dtype=np.float64), np.asarray(std_scatter, dtype=np.float64)
    rest = np.sqrt(np.maximum(total**2 - scatter**2, 0.0))
    return np.asarray(np.hypot(coverage_factor(dof) * scatter, COVERAGE * rest))


def normal_quantile(share: float) -> float:
    """Below which a share of the standard normal distribution lies."""
    from scipy import special

    return float(special.ndtri(share))


def chi_square_tail(dof: float, value: float) -> float:
    """Probability that χ² with so many degrees of freedom is larger than a value."""
    from scipy import special

    return float(special.chdtrc(dof, value))


def f_tail(dof: float, dof_below: float, value: float) -> float:
    """Probability that F with so many degrees of freedom is larger than a value."""
    from scipy import special

    return float(special.fdtrc(dof, dof_below, value))


def t_quantile(dof: float, share: float) -> float:
    """Below which a share of Student's t with so many degrees of freedom lies."""
    from scipy import special

    return float(special.stdtrit(dof, share))


def beta_share(a: float, b: float, x: float) -> float:
    """The regularised incomplete beta function I_x(a, b)."""
    from scipy import special

    return float(special.betainc(a, b, x))
