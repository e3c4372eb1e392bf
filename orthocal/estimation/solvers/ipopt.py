"""The exact identification as one nonlinear program, solved with Ipopt.

Variables are θ̂, the gauge zeros ẑ and every posture's passive coordinates q̂_k; the closures of
every posture are constraints (`nlp.py` has the functions).
"""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.errors import SolverError
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import LENGTH_SCALE, CalibrationProblem
from orthocal.estimation.solvers.nlp import ProgramFunctions
from orthocal.estimation.solvers.program import LEFT_OUT, Solution, no_convergence
from orthocal.runtime.interrupts import noticed_interrupt

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

FINEST_WEIGHT = 5e-6
"""Readings are weighted as if they had at least this standard deviation, [m], and the prior is
scaled down with them: the same optimum, with rounding errors that stay below the tolerance."""

EXACT_READINGS = 20_000
"""Readings up to which the tolerance is kept; with more it grows as their sum's rounding errors."""

MOST_EXACT = 2_000
"""Readings up to which the exact Hessian is tried where the other does not converge."""

WIDENINGS = (256.0, 64.0, 16.0, 4.0, 2.0, 1.0)
"""Widths of a robust loss, as multiples of the one wanted, each solution the next one's start: for
readings so far out that a loss as narrow as wanted does not converge at once."""

CONVERGED = frozenset({"Solve_Succeeded"})
"""Ipopt's words for a solution; anything else is an error."""


COMPLEMENTARITY = 1e-11
"""Multiplier of a bound times the distance to it, both scaled, at most. A parameter within the root
of that of its bound is said to be held by it, whether it is or not: 16 nm of an offset of 5 mm."""


@dataclass(frozen=True, slots=True, eq=False)
class Expressions:
    """A nonlinear program as expressions."""

    variables: ca.MX
    """x: θ̂, gauge zeros, the passive coordinates of every posture and where gauges stand that were
    set by the machine, scaled."""
    parameters: ca.MX
    """p: readings, their weights and noise."""
    objective: ca.MX
    constraints: ca.MX
    """0 where all loops are closed, and gauges stand as they were set."""
    errors: dict[str, ca.MX]
    """Free parameter to its value, [SI]."""


class NonlinearProgram:
    """A calibration problem as a nonlinear program; solved again and again without rebuilding.

    Args:
        problem: The problem.
        options: How Ipopt is run.
    """

    def __init__(
        self, problem: CalibrationProblem, *, options: SolverOptions | None = None
    ) -> None:
        began = time.perf_counter()
        self.problem = problem
        self.options = options or SolverOptions()
        self._n_theta = problem.n_free
        self._n_zeros = problem.observations.n_zeros
        self._n_passive = problem.robot.passive_index.size
        functions = ProgramFunctions(problem, hessian=self.options.hessian, loss=self.options.loss)
        self._functions = functions.build()
        self._solver = self._start_ipopt()
        self.seconds_build = time.perf_counter() - began

    def with_problem(self, problem: CalibrationProblem) -> NonlinearProgram:
        """The same program for another `with_values` of its problem; nothing is built again."""
        other = copy.copy(self)
        other.problem = problem
        other.__dict__.pop("_exact", None)
        return other

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
        """Solve for given readings; arguments as for `Program.solve`.

        Raises:
            SolverError: If Ipopt does not converge.
            ClosureError: If the machine cannot reach a posture with the start values.
            KeyboardInterrupt: At Ctrl-C, which CasADi would swallow.
        """
        y = self.problem.values if values is None else np.asarray(values, dtype=np.float64)
        begun = start, start_passive

        def run(program: NonlinearProgram, widening: float = 1.0) -> Solution:
            return program._solve(
                start,
                start_passive,
                sigma=sigma,
                values=y,
                left_out=left_out,
                held=held or {},
                widening=widening,
            )

        exact, robust = self.options.hessian == "exact", self.options.loss.robust
        try:
            return run(self)
        except SolverError:
            if self.problem.observations.size > MOST_EXACT or (exact and not robust):
                raise
        program = self if exact else self._exact
        if not robust:
            return run(program)
        try:
            for widening in WIDENINGS:  # nearly squares first, then as wanted
                solution = run(program, widening)
                start, start_passive = solution.theta, solution.passive
        except SolverError:
            if exact:
                raise
            start, start_passive = begun
            return run(program)
        return solution

    def _solve(
        self,
        start: ArrayLike | None,
        start_passive: Array | None,
        *,
        sigma: float,
        values: Array,
        left_out: ArrayLike | None,
        held: Mapping[int, float],
        widening: float,
    ) -> Solution:
        """One run of Ipopt, the width of a robust loss a multiple of the one wanted."""
        problem = self.problem
        lower, upper = (self._bounds(side, held) for side in ("lower", "upper"))
        theta = np.array(problem.reference if start is None else start, dtype=np.float64)
        theta = np.clip(
            theta,
            lower[: self._n_theta] * problem.theta_scale,
            upper[: self._n_theta] * problem.theta_scale,
        )
        x0 = self.begin(theta, sigma=sigma, values=values, passive=start_passive, widening=widening)
        p = self.pack(sigma=sigma, values=values, left_out=left_out, widening=widening)
        began = time.perf_counter()
        with noticed_interrupt():
            answer = self._solver(x0=x0, p=p, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)
        seconds = time.perf_counter() - began
        stats = self._solver.stats()
        status, iterations = str(stats["return_status"]), int(stats["iter_count"])
        if status not in CONVERGED:
            raise SolverError(
                f"Ipopt did not converge: {status} after {iterations} iterations; "
                f"{no_convergence(self.options)}",
                status=status,
                iterations=iterations,
            )
        x = np.asarray(answer["x"].full()).reshape(-1)
        closures = np.abs(np.asarray(answer["g"].full())).max(initial=0.0)
        pull = np.asarray(answer["lam_x"].full()).reshape(-1)[: self._n_theta]
        first = self._n_theta + self._n_zeros
        passive = slice(first, first + problem.n_postures * self._n_passive)
        return Solution(
            theta=x[: self._n_theta] * problem.theta_scale,
            zeros=x[self._n_theta : self._n_theta + self._n_zeros] * LENGTH_SCALE,
            passive=x[passive].reshape(-1, self._n_passive) * problem.passive_scale,
            objective=float(answer["f"]) / _weighting(sigma)[1],
            status=status,
            iterations=iterations,
            hessian=self.options.hessian,
            seconds_build=self.seconds_build,
            seconds_solve=seconds,
            closure=float(closures) * LENGTH_SCALE,
            at_bound=_at_bound(x[: self._n_theta], pull, lower, upper, held),
        )

    def begin(
        self,
        theta: ArrayLike | None = None,
        *,
        sigma: float,
        values: Array | None = None,
        passive: Array | None = None,
        widening: float = 1.0,
    ) -> Array:
        """The program's variables x with closed loops and the best zeros for some parameters.

        Args:
            theta: Free parameters, shape (n_free,), [SI]; what the controller already corrects by
                default.
            sigma: Standard deviation of one reading, [m].
            values: Readings as single ones, shape (n_entries,), [m]; the session's by default.
            passive: Passive coordinates to start closing the loops from.
            widening: What the width of a robust loss is multiplied by.

        Raises:
            ClosureError: If the machine cannot reach a posture.
        """
        problem, o, loss = self.problem, self.problem.observations, self.options.loss
        at = problem.reference if theta is None else np.asarray(theta, dtype=np.float64)
        closed = problem.close(at, start=passive)
        y = problem.values if values is None else values
        residual = (y - problem.predict(at, closed)) / sigma
        wide = replace(loss, width=loss.width * widening)
        aligned = problem.model.alignment.aligned
        zeros = sigma * wide.centres(residual, o.zero, o.n_zeros, weights=np.ones(o.size))
        return np.concatenate(
            [
                at / problem.theta_scale,
                zeros / LENGTH_SCALE,
                (closed / problem.passive_scale).reshape(-1),
                problem.nuisance_values(at)[aligned]
                / problem.theta_scale[problem.n_machine :][aligned],
            ]
        )

    def expressions(self) -> Expressions:
        """The program as expressions of CasADi, for terms and constraints of one's own.

        `begin` and `pack` give values of its variables and parameters.
        """
        nlp = self._functions["nlp"]
        x, p = ca.MX.sym("x", nlp.size1_in(0)), ca.MX.sym("p", nlp.size1_in(1))
        objective, constraints = nlp(x, p)
        scale = self.problem.theta_scale
        errors = {name: x[i] * float(scale[i]) for i, name in enumerate(self.problem.free)}
        return Expressions(x, p, objective, constraints, errors)

    def pack(
        self,
        *,
        sigma: float,
        values: Array | None = None,
        left_out: ArrayLike | None = None,
        widening: float = 1.0,
    ) -> Array:
        """The program's parameters p: readings, weights, noise, σ, the prior's scale, the width.

        Args:
            sigma: Standard deviation of one reading, [m].
            values: Readings as single ones, shape (n_entries,), [m]; the session's by default.
            left_out: Entries not to be used, as indices.
            widening: What the width of a robust loss is multiplied by.
        """
        y = self.problem.values if values is None else values
        weights = np.ones(y.size)
        if left_out is not None:
            weights[np.asarray(left_out, dtype=np.int64)] = LEFT_OUT
        weighted, scale = _weighting(sigma)
        width = self.options.loss.width * widening * sigma / weighted
        return np.concatenate([y, weights, self.problem.noise, [weighted, scale, width]])

    def functions(self) -> dict[str, ca.Function]:
        """The program's functions of (x, p[, lam_f, lam_g]), for checks of their derivatives."""
        return dict(self._functions)

    @cached_property
    def _exact(self) -> NonlinearProgram:
        """The same with the exact Hessian: slower, and it converges where the other does not."""
        return NonlinearProgram(self.problem, options=replace(self.options, hessian="exact"))

    def _start_ipopt(self) -> ca.Function:
        """Ipopt, ready to solve."""
        entries = self.problem.observations.size
        ipopt: dict[str, Any] = {
            "tol": self.options.tolerance * max(1.0, entries / EXACT_READINGS),
            "constr_viol_tol": self.options.closure_tolerance,
            "compl_inf_tol": COMPLEMENTARITY,
            "acceptable_iter": 0,
            "max_iter": self.options.max_iterations,
            "print_level": self.options.print_level,
            "sb": "yes",
            "nlp_scaling_method": "none",  # everything is of order one already
            "linear_solver": "mumps",
            "mumps_pivot_order": 6,  # QAMD, made for a few dense rows: the parameters
        }
        return ca.nlpsol(
            "calibration",
            "ipopt",
            self._functions["nlp"],
            {
                "grad_f": self._functions["grad_f"],
                "jac_g": self._functions["jac_g"],
                "hess_lag": self._functions["hess_lag"],
                "print_time": False,
                "show_eval_warnings": False,  # a tip that passes its rod has no reading
                "calc_lam_p": False,
                "ipopt": ipopt,
            },
        )

    def _bounds(self, side: Literal["lower", "upper"], held: Mapping[int, float]) -> Array:
        """Bounds of all variables, scaled: only parameters have any."""
        problem = self.problem
        k = problem.n_postures * self._n_passive + self._n_zeros
        k += int(problem.model.alignment.aligned.sum())
        own = getattr(problem.selection, side) / problem.theta_scale
        for i, value in held.items():
            own[i] = value / problem.theta_scale[i]
        return np.concatenate([own, np.full(k, -np.inf if side == "lower" else np.inf)])


def _weighting(sigma: float) -> tuple[float, float]:
    """Standard deviation that readings are weighted by, and the scale of the whole objective."""
    weighted = max(sigma, FINEST_WEIGHT)
    return weighted, (sigma / weighted) ** 2


def _at_bound(
    theta: Array, pull: Array, lower: Array, upper: Array, held: Mapping[int, float]
) -> NDArray[np.int8]:
    """Which parameters their bounds hold: the multiplier outweighs what is left of the way."""
    result = np.zeros(theta.size, dtype=np.int8)
    result[-pull > np.abs(theta - lower[: theta.size])] = -1
    result[pull > np.abs(theta - upper[: theta.size])] = 1
    result[list(held)] = 0
    return result
