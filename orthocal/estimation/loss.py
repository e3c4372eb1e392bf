"""How residuals count: their squares, or less than that far out.

A residual r, in standard deviations, costs ρ(r). Beside squares, ρ = r²/2, there is a smooth form
of Huber's loss (Hartley and Zisserman, Multiple View Geometry, 2004, A6.8)

    ρ(r) = k² (√(1 + (r/k)²) − 1)

which is r²/2 for small residuals and k |r| for large ones, so that a single wrong reading cannot
pull the estimate as far as it likes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocal.errors import OrthocalError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
LossKind = Literal["squares", "huber"]

HUBER_WIDTH = 1.345
"""k at which the estimate is 95 % as precise as by squares where all residuals are normal."""

MOST_STEPS = 100
SETTLED = 1e-11
"""Last step of a search for a centre, [standard deviations]."""


@dataclass(frozen=True, slots=True)
class Loss:
    """What a residual costs."""

    kind: LossKind = "squares"
    width: float = HUBER_WIDTH
    """k, [standard deviations]; of no account for squares."""

    def __post_init__(self) -> None:
        if self.kind not in ("squares", "huber"):
            raise OrthocalError(f"the loss is '{self.kind}'; expected squares or huber")
        if not (math.isfinite(self.width) and self.width > 0.0):
            raise OrthocalError(f"the width of the loss is {self.width:g}; expected more than 0")

    @property
    def robust(self) -> bool:
        """Whether large residuals count less than their squares."""
        return self.kind == "huber"

    def cost(self, r: ca.SX, width: ca.SX) -> ca.SX:
        """ρ(r)."""
        if not self.robust:
            return 0.5 * r**2
        # not k² (√… − 1), which loses all digits of a small r
        return r**2 / (1.0 + ca.sqrt(1.0 + (r / width) ** 2))

    def slope(self, r: ca.SX, width: ca.SX) -> ca.SX:
        """ρ'(r)."""
        return r / ca.sqrt(1.0 + (r / width) ** 2) if self.robust else r

    def curvature(self, r: ca.SX, width: ca.SX) -> ca.SX:
        """ρ''(r)."""
        return (1.0 + (r / width) ** 2) ** -1.5 if self.robust else ca.SX(1.0)

    def secant(self, r: ca.SX, width: ca.SX) -> ca.SX:
        """ρ'(r)/r: how much of a square a residual counts."""
        return 1.0 / ca.sqrt(1.0 + (r / width) ** 2) if self.robust else ca.SX(1.0)

    def value(self, r: Array) -> Array:
        """ρ(r) of residuals in standard deviations, shape as r."""
        if not self.robust:
            return np.asarray(0.5 * r**2)
        return np.asarray(r**2 / (1.0 + np.sqrt(1.0 + (r / self.width) ** 2)))

    def influence(self, r: Array) -> Array:
        """ρ'(r) of residuals in standard deviations, shape as r."""
        return r / np.sqrt(1.0 + (r / self.width) ** 2) if self.robust else r

    def weight(self, r: Array) -> Array:
        """ρ'(r)/r: how much of a square a residual counts, 1 at 0, shape as r."""
        return 1.0 / np.sqrt(1.0 + (r / self.width) ** 2) if self.robust else np.ones_like(r)

    def bend(self, r: Array) -> Array:
        """ρ''(r): how steeply its influence grows, 1 at 0, shape as r."""
        return np.asarray((1.0 + (r / self.width) ** 2) ** -1.5) if self.robust else np.ones_like(r)

    def centres(self, values: Array, group: Indices, count: int, *, weights: Array) -> Array:
        """What is best taken off the values of each group: their mean, for squares.

        Args:
            values: In standard deviations, shape (n,).
            group: Of each value, shape (n,).
            count: Number of groups; none is empty.
            weights: How often each value counts, shape (n,).

        Returns:
            c with Σ w ρ(v − c) least, shape (count,).
        """

        def sums(each: Array) -> Array:
            total = np.bincount(group, weights * each, minlength=count)
            return np.asarray(total, dtype=np.float64)

        result = sums(values) / sums(np.ones_like(values))
        if not np.isfinite(values).all():  # a reading that does not exist
            return result
        low, high = np.full(count, np.inf), np.full(count, -np.inf)
        np.minimum.at(low, group, values)
        np.maximum.at(high, group, values)
        steepest = np.full(count, np.inf)
        for _ in range(MOST_STEPS if self.robust else 0):
            residual = values - result[group]
            pull = sums(self.influence(residual))
            low, high = np.where(pull > 0.0, result, low), np.where(pull < 0.0, result, high)
            # by ρ'' as long as that brings it nearer; else half of where it can be
            nearer = np.abs(pull) < 0.5 * steepest
            steepest = np.abs(pull)
            newton = result + pull / np.maximum(sums(self.bend(residual)), 1e-300)
            inside = nearer & (newton >= low) & (newton <= high)
            found = np.where(inside, newton, 0.5 * (low + high))
            found = np.where(pull == 0.0, result, found)
            step, result = np.abs(found - result).max(initial=0.0), found
            if step < SETTLED:
                break
        return result

    def gain(self, r: Array, *, used: float) -> float:
        """Mean of ρ''(r): how steeply the estimate answers to the readings; 1 for squares.

        Divided by Huber's correction for few residuals, 1 + (p/n) var ρ''/(mean ρ'')² (Robust
        Statistics, 1981, section 7.6).

        Args:
            r: Residuals, [standard deviations], shape (n,).
            used: p, parameters and zeros that the residuals were fitted with.
        """
        if not self.robust or not r.size:
            return 1.0
        curvature = self.bend(r)
        mean = float(np.mean(curvature))
        return mean / (1.0 + used / r.size * float(np.var(curvature)) / mean**2)

    @property
    def normal_square(self) -> float:
        """Mean of ρ'(r)² of standard normal residuals; 1 for squares."""
        return _normal_square(self.width) if self.robust else 1.0

    def robust_square(self, residual: Array, *, dof: float, start: float) -> float:
        """Σ r² that residuals would have without those that are far out, [unit of r²].

        The scale s with Σ ρ'(r/s)² = dof E ρ'(z)² (Huber's proposal 2), times dof.

        Args:
            residual: Shape (n,).
            dof: Degrees of freedom of the residuals.
            start: A first scale.
        """
        if not self.robust or dof <= 0.0:
            return float(residual @ residual)
        scale = start
        for _ in range(200):
            found = float(np.sum(self.influence(residual / scale) ** 2)) / dof
            new = scale * math.sqrt(found / self.normal_square)
            if new == 0.0 or abs(new / scale - 1.0) < 1e-10:
                return new**2 * dof
            scale = new
        return scale**2 * dof


SQUARES = Loss()


@lru_cache(maxsize=16)
def _normal_square(width: float) -> float:
    nodes, weights = np.polynomial.hermite_e.hermegauss(120)
    values = nodes**2 / (1.0 + (nodes / width) ** 2)
    return float(weights @ values / weights.sum())
