"""Interface of the solvers. The same problem gives the same solution."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.arrays import Array
from orthocal.estimation.options import Hessian, SolverKind, SolverOptions
from orthocal.estimation.problem import CalibrationProblem

EXCLUDED_WEIGHT = 1e-9
"""Weight of excluded readings: negligible, but their gauge zeros stay determined."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Solution of a calibration problem."""

    theta: Array
    """Free parameters, shape (n_free,), [SI]."""
    zeros: Array
    """Gauge zeros, shape (n_zeros,), [m of the first gauge]."""
    passive: Array
    """Passive coordinates, shape (n_states, n_passive), [m, rad]."""
    objective: float
    """Objective: Σ ρ((y − h − z)/σ) plus the contribution of the prior."""
    status: str
    """Status as Ipopt names it."""
    iterations: int
    hessian: Hessian
    """Hessian of the solver; always Gauss-Newton for solvers other than Ipopt."""
    closure: float
    """Largest remaining closure residual, rotations times characteristic length, [m]."""
    at_bound: NDArray[np.int8]
    """-1 for a parameter at its lower bound, 1 at its upper bound, else 0, shape (n_free,)."""


@dataclass(frozen=True, slots=True, eq=False)
class SolverInput:
    """One set of readings to solve for."""

    sigma: float
    """Standard deviation of one reading, [m]."""
    values: Array
    """Readings of the entries, shape (n_entries,), [m of the first gauge]."""
    weights: Array
    """Weights of the entries, shape (n_entries,): 1, or `EXCLUDED_WEIGHT` for excluded ones."""
    start: Array
    """Free parameters to start from, shape (n_free,), [SI]."""
    start_passive: Array | None
    """Passive coordinates to start closing the loops from, (n_states, n_passive), [m, rad]."""
    prescribed: Mapping[int, float]
    """Index of a free parameter to its prescribed value, [SI]."""


class Program(ABC):
    """A problem prepared for a solver, for any number of solutions.

    Args:
        problem: The problem.
        options: Options of the solver.
    """

    kind: ClassVar[SolverKind]

    def __init__(
        self, problem: CalibrationProblem, *, options: SolverOptions | None = None
    ) -> None:
        self.problem = problem
        self.options = options or SolverOptions(solver=self.kind)

    def with_problem(self, problem: CalibrationProblem) -> Self:
        """The program for the same problem with other readings or noise ratios.

        Its compiled functions are kept.
        """
        other = copy.copy(self)
        other.problem = problem
        return other

    def solve(
        self,
        *,
        sigma: float,
        values: ArrayLike | None = None,
        start: ArrayLike | None = None,
        start_passive: Array | None = None,
        excluded: ArrayLike | None = None,
        prescribed: Mapping[int, float] | None = None,
    ) -> Solution:
        """Solve for one set of readings.

        Args:
            sigma: Standard deviation of one reading, [m].
            values: Readings of the entries, shape (n_entries,), [m of the first gauge]; the
                session's by default.
            start: Free parameters to start from, shape (n_free,), [SI]; the active offsets by
                default.
            start_passive: Passive coordinates to start closing the loops from.
            excluded: Indices of the entries to exclude.
            prescribed: Index of a free parameter to its prescribed value, [SI].

        Raises:
            SolverError: If it does not converge.
            ClosureError: If the machine cannot reach a posture with the start values.
        """
        problem = self.problem
        return self._solve(
            SolverInput(
                sigma=sigma,
                values=np.asarray(problem.values if values is None else values, dtype=np.float64),
                weights=self._weights(excluded),
                start=np.array(problem.active_theta if start is None else start, dtype=np.float64),
                start_passive=start_passive,
                prescribed=prescribed or {},
            )
        )

    def _weights(self, excluded: ArrayLike | None) -> Array:
        """Weights of the entries, shape (n_entries,): 1, or `EXCLUDED_WEIGHT` for excluded ones."""
        weights = np.ones(self.problem.observations.size)
        if excluded is not None:
            weights[np.asarray(excluded, dtype=np.int64)] = EXCLUDED_WEIGHT
        return weights

    @abstractmethod
    def _solve(self, given: SolverInput) -> Solution:
        """Solve for one set of readings."""


def scaled_bounds(
    problem: CalibrationProblem, prescribed: Mapping[int, float]
) -> tuple[Array, Array]:
    """Lower and upper bounds of θ̂, shape (n_free,), equal for prescribed parameters."""
    lower, upper = (
        b / problem.theta_scale for b in (problem.selection.lower, problem.selection.upper)
    )
    for i, value in prescribed.items():
        lower[i] = upper[i] = value / problem.theta_scale[i]
    return lower, upper


def advise(options: SolverOptions) -> str:
    """Advice after a solver did not converge, or converged to an impossible machine."""
    return "Look for a reading with a wrong sign or in a wrong row" + (
        "" if options.loss.robust else "; the robust loss ('huber') may show which one"
    )
