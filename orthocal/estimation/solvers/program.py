"""Interface of the solvers. The same problem gives the same solution."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.estimation.options import Hessian, SolverOptions
from orthocal.estimation.problem import CalibrationProblem

Array = NDArray[np.float64]

LEFT_OUT = 1e-9
"""Weight of excluded readings: negligible, but their gauge zeros stay determined."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Solution of a calibration problem."""

    theta: Array
    """Free parameters, shape (n_free,), [SI]."""
    zeros: Array
    """Gauge zeros, shape (n_zeros,), [m]."""
    passive: Array
    """Passive coordinates, shape (n_states, n_passive), [m, rad]."""
    objective: float
    """Σ ρ((y − h − z)/σ) plus the contribution of the prior."""
    status: str
    """Status as Ipopt names it."""
    iterations: int
    hessian: Hessian
    """Hessian of the solver; always Gauss-Newton for solvers other than Ipopt."""
    seconds_build: float
    seconds_solve: float
    closure: float
    """Largest remaining closure residual, rotations times characteristic length, [m]."""
    at_bound: NDArray[np.int8]
    """-1 for a parameter at its lower bound, 1 at its upper bound, else 0, shape (n_free,)."""


class Program(Protocol):
    """A problem prepared for a solver, for any number of solutions."""

    problem: CalibrationProblem
    options: SolverOptions

    def with_problem(self, problem: CalibrationProblem) -> Program:
        """The same program for a `with_values` of its problem; nothing is built again."""

    def solve(
        self,
        *,
        sigma: float,
        values: ArrayLike | None = None,
        start: ArrayLike | None = None,
        start_passive: Array | None = None,
        left_out: ArrayLike | None = None,
        held: Mapping[int, float] | None = None,
    ) -> Solution:
        """Solve for given readings.

        Args:
            sigma: Standard deviation of one reading, [m].
            values: Readings as single ones, shape (n_entries,), [m of the first gauge]; the
                session's by default.
            start: Free parameters to start from, shape (n_free,), [SI]; by default the
                reference.
            start_passive: Passive coordinates to start closing the loops from.
            left_out: Indices of the entries to exclude.
            held: Index of a free parameter to the value it is held at, [SI].

        Raises:
            SolverError: If it does not converge.
            ClosureError: If the machine cannot reach a posture with the start values.
        """


def no_convergence(options: SolverOptions) -> str:
    """Advice after a solver did not converge."""
    return "there is no result. Look for a reading with a wrong sign or in a wrong row first" + (
        "" if options.loss.robust else "; with the loss 'huber' it may be named"
    )
