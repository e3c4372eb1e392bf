"""Which solver, how it is run, and what a residual costs.

- `ipopt`: the whole nonlinear program, passive coordinates and gauge zeros among its variables: the
  reference.
- `eliminated`: the same optimum with nothing left but the free parameters: for repetition and size.
- `linearised`: readings to first order about what the controller already corrects, as the paper's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from orthocal.arguments import require_kind
from orthocal.errors import OrthocalError
from orthocal.estimation.loss import SQUARES, Loss

SolverKind = Literal["ipopt", "eliminated", "linearised"]
Hessian = Literal["gauss-newton", "exact"]

MOST_ITERATIONS = 10**6


@dataclass(frozen=True, slots=True, eq=False)
class SolverOptions:
    """Which solver, how it is run, and what a residual costs."""

    solver: SolverKind = "ipopt"
    hessian: Hessian = "gauss-newton"
    """Ipopt's Hessian of the Lagrangian: exact, or without the curvature of readings and closures.
    Where the latter does not converge the exact one is tried."""
    tolerance: float = 1e-6
    """Ipopt's `tol` on the gradient of the scaled problem, in units of θ̂ (one tolerance) where
    only the prior holds a parameter, and far less where readings do. Readings of 0.3 m known to
    5 µm leave rounding errors of up to 1e-7 in it."""
    closure_tolerance: float = 1e-9
    """Ipopt's largest scaled closure residual: units of 1 mm."""
    max_iterations: int = 200
    print_level: int = 0
    """Ipopt's own printing, 0 (none) to 12."""
    loss: Loss = SQUARES
    """What a residual costs."""

    def __post_init__(self) -> None:
        require_kind(self.loss, Loss, expected="Loss(...)")
        for name in ("tolerance", "closure_tolerance"):
            value = getattr(self, name)
            if not (isinstance(value, int | float) and 0.0 < value < math.inf):
                raise ValueError(f"{name} is {value!r}; expected a number above 0")
        for name in ("max_iterations", "print_level"):
            value = getattr(self, name)
            if not (isinstance(value, int) and 0 <= value <= MOST_ITERATIONS):
                raise ValueError(f"{name} is {value!r}; expected a whole number of at least 0")
        _require_one_of(self.hessian, get_args(Hessian), "Hessian", ValueError)
        _require_one_of(self.solver, get_args(SolverKind), "solver", OrthocalError)


def _require_one_of(
    value: object, names: tuple[str, ...], what: str, error: type[Exception]
) -> None:
    if value not in names:
        raise error(f"the {what} is {value!r}; expected one of {', '.join(names)}")
