"""Interface of the solvers, which are deterministic."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.arguments import require_kind
from orthocal.arrays import Array
from orthocal.estimation.options import Hessian, SolverKind, SolverOptions
from orthocal.estimation.problem import CalibrationProblem

CONVERGED = "Solve_Succeeded"
"""Status of a solution, in the terms of Ipopt; any other status is an error."""

EXCLUDED_WEIGHT = 1e-9
"""Weight of excluded readings: negligible, but it determines their gauge zeros."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Solution of a calibration problem."""

    theta: Array
    """Free parameters, shape (n_free,), [SI]."""
    zeros: Array
    """Gauge zeros, shape (n_zeros,), [noise-scaled m]."""
    passive: Array
    """Passive coordinates, shape (n_states, n_passive), [m, rad]."""
    objective: float
    """Objective: Σ ρ((y − h − z)/σ) plus the contribution of the prior."""
    status: str
    """Status in the terms of Ipopt (see `CONVERGED`)."""
    iterations: int
    """Number of iterations."""
    hessian: Hessian
    """Hessian of the solver; always Gauss-Newton for solvers other than Ipopt."""
    closure: float
    """Largest remaining closure residual of Ipopt, rotations times characteristic length, [m]; 0
    for other solvers, which close the loops."""
    at_bound: NDArray[np.int8]
    """-1 for a parameter at its lower bound, 1 at its upper bound, else 0, shape (n_free,)."""


@dataclass(frozen=True, slots=True, eq=False)
class SolverInput:
    """Set of readings, with start values and prescribed parameters."""

    sigma: float
    """Standard deviation of one reading, [m]."""
    values: Array
    """Readings of the entries, shape (n_entries,), [noise-scaled m]."""
    weights: Array
    """Weights of the entries, shape (n_entries,): 1, or `EXCLUDED_WEIGHT` for excluded ones."""
    start: Array
    """Start values of the free parameters, shape (n_free,), [SI]."""
    start_passive: Array | None
    """Start values of the passive coordinates, (n_states, n_passive), [m, rad]."""
    prescribed: Mapping[int, float]
    """Indices of free parameters, mapped to prescribed values, [SI]."""
    mirrored: bool = True
    """True to start from mirror images of the solution, too."""


class Program(ABC):
    """Problem prepared for a solver, for any number of solutions.

    Args:
        problem: The problem.
        options: Options of the solver.
    """

    kind: ClassVar[SolverKind]

    def __init__(
        self, problem: CalibrationProblem, *, options: SolverOptions | None = None
    ) -> None:
        require_kind(problem, CalibrationProblem, expected="a CalibrationProblem")
        self.problem = problem
        self.options = options or SolverOptions(solver=self.kind)

    def with_problem(self, problem: CalibrationProblem) -> Self:
        """Program for the same problem with other readings or noise ratios.

        It shares the compiled functions.
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
        mirrored: bool = True,
    ) -> Solution:
        """Solve for one set of readings.

        Args:
            sigma: Standard deviation of one reading, [m].
            values: Readings of the entries, shape (n_entries,), [noise-scaled m]; the
                session's by default.
            start: Start values of the free parameters, shape (n_free,), [SI]; the active offsets by
                default.
            start_passive: Start values of the passive coordinates, shape (n_states, n_passive),
                [m, rad].
            excluded: Indices of the entries to exclude.
            prescribed: Indices of free parameters, mapped to prescribed values, [SI].
            mirrored: Start from mirror images of the solution, too, if the problem has mirrored
                directions. False for start values on the better sides.

        Raises:
            ValueError: If a reading is missing, as in a plan, or their number is wrong.
            SolverError: If the solver does not converge.
            ClosureError: If the machine cannot reach a posture with the start values.
        """
        problem = self.problem
        return self._solve(
            SolverInput(
                sigma=sigma,
                values=self._readings(problem.values if values is None else values),
                weights=self._weights(excluded),
                start=np.array(problem.active_theta if start is None else start, dtype=np.float64),
                start_passive=start_passive,
                prescribed=prescribed or {},
                mirrored=mirrored,
            )
        )

    def _readings(self, values: ArrayLike) -> Array:
        """Readings of the entries, shape (n_entries,), [noise-scaled m].

        Raises:
            ValueError: If a reading is missing, or their number is wrong.
        """
        readings = np.asarray(values, dtype=np.float64)
        shape = (self.problem.observations.size,)
        if readings.shape != shape:
            raise ValueError(f"values: found the shape {readings.shape}; expected {shape}")
        missing = int((~np.isfinite(readings)).sum())
        if missing:
            raise ValueError(
                f"values: {missing} of {readings.size} readings have no value; expected readings "
                "in m. A plan has none until it is measured or simulated"
            )
        return readings

    def _weights(self, excluded: ArrayLike | None) -> Array:
        """Weights of the entries, shape (n_entries,): 1, or `EXCLUDED_WEIGHT` for excluded ones."""
        weights = np.ones(self.problem.observations.size)
        if excluded is not None:
            weights[np.asarray(excluded, dtype=np.int64)] = EXCLUDED_WEIGHT
        return weights

    @abstractmethod
    def _solve(self, data: SolverInput) -> Solution:
        """Solve for one set of readings."""


def scaled_bounds(
    problem: CalibrationProblem, prescribed: Mapping[int, float]
) -> tuple[Array, Array]:
    """Lower and upper bounds of θ̂, shape (n_free,) each; equal for prescribed parameters."""
    lower, upper = (
        b / problem.theta_scale for b in (problem.selection.lower, problem.selection.upper)
    )
    for i, value in prescribed.items():
        lower[i] = upper[i] = value / problem.theta_scale[i]
    return lower, upper


def advise(options: SolverOptions) -> str:
    """Advice if a solver does not converge, or converges to an impossible machine."""
    stopped_early = options.max_iterations < SolverOptions().max_iterations
    few = f"Allow more than {options.max_iterations} iterations. " if stopped_early else ""
    return f"{few}Look for a reading with a wrong sign or in a wrong row" + (
        "" if options.loss.robust else "; the loss 'huber' (option --loss) may show which one"
    )
