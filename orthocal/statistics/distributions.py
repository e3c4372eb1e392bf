"""Tails and quantiles of the normal, χ², F and t distributions.

By series and continued fractions of the incomplete gamma and beta functions (NIST Digital Library
of Mathematical Functions, 8.9 and 8.17). SciPy has them all, but to import it takes as long as a
calibration of offsets.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from statistics import NormalDist

MOST_TERMS = 100_000
SMALLEST = 1e-300
PRECISION = 1e-16


def normal_quantile(share: float) -> float:
    """Below which a share of the standard normal distribution lies."""
    if not 0.0 < share < 1.0:
        return math.copysign(math.inf, share - 0.5) if share in (0.0, 1.0) else math.nan
    return NormalDist().inv_cdf(share)


def chi_square_tail(dof: float, value: float) -> float:
    """Probability that χ² with so many degrees of freedom is larger than a value."""
    if math.isnan(value) or not dof > 0.0 or math.isinf(dof):
        return math.nan
    return _gamma_tail(0.5 * dof, 0.5 * value) if value > 0.0 else 1.0


@lru_cache(maxsize=256)
def chi_square_quantile(dof: float, tail: float) -> float:
    """The value that χ² exceeds with a probability."""
    if not (dof > 0.0 and 0.0 < tail <= 1.0):
        return math.nan
    return _find(lambda value: chi_square_tail(dof, value), tail)


def f_tail(dof: float, dof_below: float, value: float) -> float:
    """Probability that F with so many degrees of freedom is larger than a value."""
    if math.isnan(value) or not (dof > 0.0 and dof_below > 0.0) or math.isinf(dof + dof_below):
        return math.nan
    if value <= 0.0:
        return 1.0
    above, below = dof * value, dof_below
    if math.isinf(above):
        return 0.0
    return _beta_share(0.5 * dof_below, 0.5 * dof, below / (below + above), above / (below + above))


@lru_cache(maxsize=256)
def t_quantile(dof: float, share: float) -> float:
    """Below which a share of Student's t with so many degrees of freedom lies."""
    if not (dof > 0.0 and 0.0 < share < 1.0):
        return math.nan
    if share == 0.5:
        return 0.0
    size = math.sqrt(_find(lambda square: f_tail(1.0, dof, square), 2.0 * min(share, 1.0 - share)))
    return size if share > 0.5 else -size


def beta_share(a: float, b: float, x: float) -> float:
    """The regularised incomplete beta function I_x(a, b)."""
    return _beta_share(a, b, x, 1.0 - x)


def _gamma_tail(a: float, x: float) -> float:
    """Q(a, x) for a, x > 0."""
    if math.isinf(x):
        return 0.0
    front = math.exp(a * math.log(x) - x - math.lgamma(a))
    if x < a + 1.0:
        term = total = 1.0 / a
        for k in range(1, MOST_TERMS):
            term *= x / (a + k)
            total += term
            if term < PRECISION * total:
                break
        return 1.0 - front * total
    b = x + 1.0 - a
    c, d = 1.0 / SMALLEST, 1.0 / b
    found = d
    for k in range(1, MOST_TERMS):
        step = -k * (k - a)
        b += 2.0
        d = 1.0 / _away(step * d + b)
        c = _away(b + step / c)
        found *= d * c
        if abs(d * c - 1.0) < PRECISION:
            break
    return front * found


def _beta_share(a: float, b: float, x: float, rest: float) -> float:
    """I_x(a, b) with 1 − x given, too."""
    if x <= 0.0 or rest <= 0.0:
        return 0.0 if x <= 0.0 else 1.0
    if x > (a + 1.0) / (a + b + 2.0):
        return 1.0 - _beta_share(b, a, rest, x)
    both = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)
    logs = (math.log(u) if u < 0.5 else math.log1p(-v) for u, v in ((x, rest), (rest, x)))
    front = math.exp(both + sum(n * log for n, log in zip((a, b), logs, strict=True))) / a
    c, d = 1.0, 1.0 / _away(1.0 - (a + b) * x / (a + 1.0))
    found = d
    for k in range(1, MOST_TERMS):
        for step in (
            k * (b - k) * x / ((a + 2 * k - 1.0) * (a + 2 * k)),
            -(a + k) * (a + b + k) * x / ((a + 2 * k) * (a + 2 * k + 1.0)),
        ):
            d = 1.0 / _away(1.0 + step * d)
            c = _away(1.0 + step / c)
            found *= d * c
        if abs(d * c - 1.0) < PRECISION:
            break
    return front * found


def _away(value: float) -> float:
    """A divisor that is not 0."""
    return value if abs(value) > SMALLEST else SMALLEST


def _find(tail: Callable[[float], float], wanted: float) -> float:
    """Where a tail, which falls from 1 at 0, is as wanted."""
    low, high = 0.0, 1.0
    while tail(high) > wanted and high < 1e300:
        low, high = high, 2.0 * high
    while True:
        middle = 0.5 * (low + high)
        if not low < middle < high:
            return middle
        low, high = (middle, high) if tail(middle) > wanted else (low, middle)
