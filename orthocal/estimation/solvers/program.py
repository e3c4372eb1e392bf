"""What every solver is: a function of a problem. Same problem in, same solution out."""

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
"""Weight of readings that are left out: next to nothing, and their gauge zeros stay determined."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """What a solver found."""

    theta: Array
    """Free parameters, shape (n_free,), [SI]."""
    zeros: Array
    """Gauge zeros, shape (n_zeros,), [m]."""
    passive: Array
    """Passive coordinates, shape (n_postures, n_passive), [m, rad]."""
    objective: float
    """Σ ρ((y − h − z)/σ), and the prior's share."""
    status: str
    """Ipopt's word, or the same of another solver."""
    iterations: int
    hessian: Hessian
    """With which it was found; that of the others is Gauss-Newton's."""
    seconds_build: float
    seconds_solve: float
    closure: float
    """Largest closure residual that is left, rotations times characteristic length, [m]."""
    at_bound: NDArray[np.int8]
    """-1 where a parameter is held by its lower bound, 1 by its upper one, else 0, (n_free,)."""


class Program(Protocol):
    """A problem made ready for a solver; solved again and again without rebuilding."""

    problem: CalibrationProblem
    options: SolverOptions

    def with_problem(self, problem: CalibrationProblem) -> Program:
        """The same for another `with_values` of its problem; nothing is built again."""

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
            start: Free parameters to start from, shape (n_free,), [SI]; by default what the
                controller already corrects.
            start_passive: Passive coordinates to start closing the loops from.
            left_out: Entries not to be used, as indices.
            held: Index of a free parameter to the value it is held at, [SI].

        Raises:
            SolverError: If it does not converge.
            ClosureError: If the machine cannot reach a posture with the start values.
        """


def no_convergence(options: SolverOptions) -> str:
    """What to look for where a solver does not converge."""
    return "there is no result. Look for a reading with a wrong sign or in a wrong row first" + (
        "" if options.loss.robust else "; with the loss 'huber' it may be named"
    )
