"""Loss functions: squares, or the pseudo-Huber loss for outliers.

A residual r, in standard deviations, contributes ρ(r) to the objective, without a further factor.
For squares ρ = r²/2. `huber` is the pseudo-Huber loss (Hartley and Zisserman, Multiple View
Geometry, 2004, A6.8)

    ρ(r) = k² (√(1 + (r/k)²) − 1)

It is about r²/2 for small residuals and k |r| for large ones, so that the influence of a wrong
reading is bounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeVar

import casadi as ca
import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.errors import OrthocalError

LossKind = Literal["squares", "huber"]
Values = TypeVar("Values", Array, ca.SX)

HUBER_WIDTH = 1.345
"""k for an efficiency of about 95 % relative to squares if all residuals are normal."""

MAX_CENTRE_STEPS = 100
"""Largest number of steps of a search for a centre."""

CENTRE_TOLERANCE = 1e-11
"""Step of a search for a centre below which it has converged, [standard deviations]."""

MAX_SCALE_STEPS = 200
"""Largest number of fixed-point steps for a robust scale."""

SCALE_TOLERANCE = 1e-10
"""Relative change of a robust scale below which it has converged."""


@dataclass(frozen=True, slots=True)
class Loss:
    """Loss function of standardised residuals.

    Args:
        kind: `squares` or `huber`, the pseudo-Huber loss.
        width: k, [standard deviations]; not used for squares.

    Raises:
        OrthocalError: If the kind is unknown, or the width is not a number above 0.
    """

    kind: LossKind = "squares"
    width: float = HUBER_WIDTH

    def __post_init__(self) -> None:
        if self.kind not in ("squares", "huber"):
            raise OrthocalError(f"the loss is '{self.kind}'; expected squares or huber")
        if not (math.isfinite(self.width) and self.width > 0.0):
            raise OrthocalError(f"the width of the loss is {self.width:g}; expected more than 0")

    @property
    def robust(self) -> bool:
        """True if large residuals count less than their squares."""
        return self.kind == "huber"

    def value(self, r: Values, width: Values | None = None) -> Values:
        """Cost ρ(r) of residuals. `influence`, `weight` and `curvature` have the same arguments.

        Args:
            r: Residuals, array or expression of any shape, [standard deviations].
            width: k as an expression; `width` by default.
        """
        # equal to k² (√… − 1), which loses all digits of a small r
        return r**2 / (1.0 + self._root(r, width)) if self.robust else 0.5 * r**2

    def influence(self, r: Values, width: Values | None = None) -> Values:
        """Influence ρ'(r) of residuals."""
        return r / self._root(r, width) if self.robust else r

    def weight(self, r: Values, width: Values | None = None) -> Values:
        """Weight ρ'(r)/r of squared residuals, 1 at 0."""
        return 1.0 / self._root(r, width) if self.robust else r**0

    def curvature(self, r: Values, width: Values | None = None) -> Values:
        """Curvature ρ''(r) of the cost, 1 at 0."""
        return self._root(r, width) ** -3 if self.robust else r**0

    def _root(self, r: Values, width: Values | None) -> Values:
        """Root √(1 + (r/k)²) of the pseudo-Huber loss."""
        return (1.0 + (r / (self.width if width is None else width)) ** 2) ** 0.5

    def centres(self, values: Array, group: Indices, count: int, *, weights: Array) -> Array:
        """Centre c of each group of values that minimises Σ w ρ(v − c); the mean for squares.

        Args:
            values: Values v, shape (n,), [standard deviations].
            group: Index of the group of each value, shape (n,).
            count: Number of groups; none is empty.
            weights: Weights w of the values, shape (n,).

        Returns:
            Shape (count,), [standard deviations].
        """

        def sums(terms: Array) -> Array:
            total = np.bincount(group, weights * terms, minlength=count)
            return np.asarray(total, dtype=np.float64)

        result = sums(values) / sums(np.ones_like(values))
        if not np.isfinite(values).all():  # a sensor has no reading: the cost is NaN anyway
            return result
        low, high = np.full(count, np.inf), np.full(count, -np.inf)
        np.minimum.at(low, group, values)
        np.maximum.at(high, group, values)
        last_gradient = np.full(count, np.inf)
        for _ in range(MAX_CENTRE_STEPS if self.robust else 0):
            residual = values - result[group]
            gradient = sums(self.influence(residual))
            low = np.where(gradient > 0.0, result, low)
            high = np.where(gradient < 0.0, result, high)
            # Newton step if the gradient decreases fast enough, otherwise bisection
            decreasing = np.abs(gradient) < 0.5 * last_gradient
            last_gradient = np.abs(gradient)
            # the curvature of huge residuals may be 0 after rounding
            newton = result + gradient / np.maximum(sums(self.curvature(residual)), 1e-300)
            inside = decreasing & (newton >= low) & (newton <= high)
            trial = np.where(inside, newton, 0.5 * (low + high))
            trial = np.where(gradient == 0.0, result, trial)
            step, result = np.abs(trial - result).max(initial=0.0), trial
            if step < CENTRE_TOLERANCE:
                break
        return result

    def gain(self, r: Array, *, used: float) -> float:
        """Mean of ρ''(r), corrected for the number of fitted parameters; 1 for squares.

        It is divided by 1 + (p/n) var ρ''/(mean ρ'')² (Huber, Robust Statistics, 1981, section
        7.6).

        Args:
            r: Residuals, shape (n,), [standard deviations].
            used: p, number of fitted parameters and zeros.
        """
        if not self.robust or not r.size:
            return 1.0
        curvature = self.curvature(r)
        mean = float(np.mean(curvature))
        return mean / (1.0 + used / r.size * float(np.var(curvature)) / mean**2)

    @property
    def normal_square(self) -> float:
        """Mean of ρ'(r)² of standard normal residuals; 1 for squares."""
        return _normal_square(self.width) if self.robust else 1.0

    def robust_square(self, residual: Array, *, dof: float, start: float) -> float:
        """Σ r² without the effect of outliers: s² dof, [unit of r²].

        s solves Σ ρ'(r/s)² = dof E ρ'(z)² (Huber's proposal 2). For squares it is Σ r².

        Args:
            residual: Residuals r, shape (n,).
            dof: Degrees of freedom of the residuals.
            start: Start value of s, [unit of r].
        """
        if not self.robust or dof <= 0.0:
            return float(residual @ residual)
        scale = start
        for _ in range(MAX_SCALE_STEPS):
            mean_square = float(np.sum(self.influence(residual / scale) ** 2)) / dof
            new = scale * math.sqrt(mean_square / self.normal_square)
            if new == 0.0 or abs(new / scale - 1.0) < SCALE_TOLERANCE:
                return new**2 * dof
            scale = new
        return scale**2 * dof


SQUARES = Loss()
"""Loss function of least squares."""


@lru_cache(maxsize=16)
def _normal_square(width: float) -> float:
    """Mean of ρ'(z)² for a standard normal z, by Gauss-Hermite quadrature."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(120)
    values = nodes**2 / (1.0 + (nodes / width) ** 2)
    return float(weights @ values / weights.sum())
