"""Choice and options of a solver.

- `ipopt`: the complete nonlinear program, with passive coordinates and gauge zeros as variables. It
  is the reference for the other solvers.
- `variable-projection`: the same optimum by variable projection, for repetition and large sessions.
- `linearised`: one step with readings linearised about the active offsets, as in the paper.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Integral, Real
from typing import Literal, get_args

from orthocal.arguments import require_kind
from orthocal.errors import OrthocalError
from orthocal.estimation.loss import SQUARES, Loss

SolverKind = Literal["ipopt", "variable-projection", "linearised"]
Hessian = Literal["gauss-newton", "exact"]

OptionValue = float | int | str | bool

LARGEST_MAX_ITERATIONS = 10**6
"""Largest value of `max_iterations`."""

LARGEST_PRINT_LEVEL = 12
"""Largest value of `print_level`."""


@dataclass(frozen=True, slots=True, eq=False)
class SolverOptions:
    """Choice and options of a solver.

    Args:
        solver: `ipopt`, `variable-projection` or `linearised`.
        hessian: Hessian of the Lagrangian for Ipopt: `exact`, or `gauss-newton` without the
            curvature of readings and closures. If Gauss-Newton does not converge, the exact
            Hessian is tried, for sessions of up to 2000 readings.
        tolerance: Largest optimality error (`tol` of Ipopt), for parameters in prior standard
            deviations. It is multiplied by n/20 000 for n > 20 000 readings. Rounding errors of
            the gradient are about 1e-7 for readings of 0.3 m with a noise of 5 µm.
        closure_tolerance: Largest scaled closure residual in Ipopt, in units of 1 mm.
        max_iterations: Largest number of iterations of Ipopt (`max_iter`) and of variable
            projection. Before that, a batch of sets of readings has up to 30 common iterations.
        print_level: Output of Ipopt, 0 (none) to 12.
        loss: Loss function of standardised residuals.
        ipopt: Further options by their names in Ipopt, such as {"mu_strategy": "adaptive"}. They
            replace those of orthocal. Other solvers ignore them.

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
            if not _is_positive(value):
                raise ValueError(f"{name} is {value!r}; expected a number above 0")
        limits = {"max_iterations": LARGEST_MAX_ITERATIONS, "print_level": LARGEST_PRINT_LEVEL}
        for name, largest in limits.items():
            value = getattr(self, name)
            is_whole = isinstance(value, Integral) and not isinstance(value, bool)
            if not (is_whole and 0 <= value <= largest):
                problem = f"{name} is {value!r}; expected a whole number from 0 to {largest}"
                raise ValueError(problem)
        if not isinstance(self.ipopt, Mapping):
            raise ValueError(f"ipopt is {self.ipopt!r}; expected names and values of options")
        for key, option in self.ipopt.items():
            if not isinstance(key, str) or not isinstance(option, bool | int | float | str):
                raise ValueError(
                    f"ipopt has {key!r}: {option!r}; expected a name and a number, text or bool"
                )
        object.__setattr__(self, "ipopt", dict(self.ipopt))
        _require_one_of(self.hessian, get_args(Hessian), "Hessian", ValueError)
        _require_one_of(self.solver, get_args(SolverKind), "solver", OrthocalError)


def _is_positive(value: object) -> bool:
    """True for a finite number above 0."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return False
    try:
        return 0.0 < float(value) < math.inf
    except OverflowError:  # an integer beyond all floats
        return False


def _require_one_of(
    value: object, names: tuple[str, ...], option: str, error: type[Exception]
) -> None:
    """Refuse a value of an option that is not one of the names."""
    if value not in names:
        raise error(f"the {option} is {value!r}; expected one of {', '.join(names)}")
