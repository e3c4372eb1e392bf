"""Choice and options of a solver.

- `ipopt`: the complete nonlinear program, with passive coordinates and gauge zeros as variables;
  the solver that the others are tested against.
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
"""Largest `max_iterations`."""

MOST_PRINTING = 12
"""Largest `print_level` of Ipopt."""


@dataclass(frozen=True, slots=True, eq=False)
class SolverOptions:
    """Choice and options of a solver.

    Args:
        solver: `ipopt`, `variable-projection` or `linearised`.
        hessian: Ipopt's Hessian of the Lagrangian: exact, or without the curvature of readings and
            closures. If the latter does not converge, the exact one is tried, for sessions of up to
            2000 readings.
        tolerance: Ipopt's `tol`: largest optimality error, for parameters in prior standard
            deviations. Multiplied by n/20 000 for n > 20 000 readings. Rounding errors of the
            gradient are about 1e-7 for readings of 0.3 m known to 5 µm.
        closure_tolerance: Ipopt's largest scaled closure residual: units of 1 mm.
        max_iterations: Ipopt's `max_iter`; also of variable projection. Sets of readings that are
            solved in a batch have at most 30 common iterations first.
        print_level: Ipopt's own printing, 0 (none) to 12.
        loss: Loss function of standardised residuals.
        ipopt: Further options of Ipopt, by its own names, such as {"mu_strategy": "adaptive"}; they
            replace those that orthocal sets. Other solvers ignore them.

    Raises:
        OrthocalError: If the solver is unknown.
        TypeError: If the loss is not a `Loss`.
        ValueError: If another option is invalid.
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
        for name, most in (("max_iterations", MOST_ITERATIONS), ("print_level", MOST_PRINTING)):
            value = getattr(self, name)
            if not (isinstance(value, int) and 0 <= value <= most):
                raise ValueError(f"{name} is {value!r}; expected a whole number from 0 to {most}")
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
    """Check that an option has one of some names."""
    if value not in names:
        raise error(f"the {what} is {value!r}; expected one of {', '.join(names)}")
