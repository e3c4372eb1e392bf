"""Tails and quantiles of the normal, χ², F and t distributions, by SciPy.

It is imported when one is asked for: that takes as long as a small calibration.
"""

from __future__ import annotations


def normal_quantile(share: float) -> float:
    """Below which a share of the standard normal distribution lies."""
    from scipy import special

    return float(special.ndtri(share))


def chi_square_tail(dof: float, value: float) -> float:
    """Probability that χ² with so many degrees of freedom is larger than a value."""
    from scipy import special

    return float(special.chdtrc(dof, value))


def chi_square_quantile(dof: float, tail: float) -> float:
    """The value that χ² exceeds with a probability."""
    from scipy import special

    return float(special.chdtri(dof, tail))


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
