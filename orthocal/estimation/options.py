"""Choice and options of a solver.

- `ipopt`: the complete nonlinear program, with passive coordinates and gauge zeros as variables;
  the reference.
- `variable-projection`: the same optimum by variable projection, for repetition and large sessions.
- `linearised`: one step with readings to first order about the active offsets, as in the paper.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

from orthocal.arguments import require_kind
from orthocal.errors import OrthocalError
from orthocal.estimation.loss import SQUARES, Loss

SolverKind = Literal["ipopt", "variable-projection", "linearised"]
Hessian = Literal["gauss-newton", "exact"]

OptionValue = float | int | str | bool

MOST_ITERATIONS = 10**6


@dataclass(frozen=True, slots=True, eq=False)
class SolverOptions:
    """Choice and options of a solver.

    Args:
        solver: `ipopt`, `variable-projection` or `linearised`.
        hessian: Ipopt's Hessian of the Lagrangian: exact, or without the curvature of readings and
            closures. Where the latter does not converge the exact one is tried.
        tolerance: Ipopt's `tol` on the gradient of the scaled problem, in prior standard deviations
            where only the prior holds a parameter, and far less where readings do.
            Readings of 0.3 m known to 5 µm leave rounding errors of up to 1e-7 in it.
        closure_tolerance: Ipopt's largest scaled closure residual: units of 1 mm.
        max_iterations: Ipopt's `max_iter`; also of variable projection.
        print_level: Ipopt's own printing, 0 (none) to 12.
        loss: Loss function of standardised residuals.
        ipopt: Further options of Ipopt, by its own names, such as {"mu_strategy": "adaptive"}; they
            replace those that orthocal sets. Other solvers ignore them.
    """

    solver: SolverKind = "ipopt"
    hessian: Hessian = "gauss-newton"
    tolerance: float = 1e-6
    closure_tolerance: float = 1e-9
    max_iterations: int = 200
    print_level: int = 0
    loss: Loss = SQUARES
    ipopt: Mapping[str, OptionValue] = field(default_factory=dict)

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
        if not isinstance(self.ipopt, Mapping):
            raise ValueError(f"ipopt is {self.ipopt!r}; expected names and values of options")
        for key, option in self.ipopt.items():
            if not isinstance(key, str) or not isinstance(option, bool | int | float | str):
                raise ValueError(
                    f"ipopt has {key!r}: {option!r}; expected a name and a number, text or bool"
                )
        _require_one_of(self.hessian, get_args(Hessian), "Hessian", ValueError)
        _require_one_of(self.solver, get_args(SolverKind), "solver", OrthocalError)


def _require_one_of(
    value: object, names: tuple[str, ...], what: str, error: type[Exception]
) -> None:
    if value not in names:
        raise error(f"the {what} is {value!r}; expected one of {', '.join(names)}")
