"""Exact identification as one nonlinear program that Ipopt solves.

Its variables are θ̂, the gauge zeros ẑ, the passive coordinates q̂_k of every state and the values
of manually aligned nuisance parameters. The loop closures of every state and the alignments are
constraints (see `nlp.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.arrays import Array
from orthocal.errors import ClosureError, OrthocalError, SolverError
from orthocal.estimation.options import OptionValue, SolverOptions
from orthocal.estimation.problem import LENGTH_SCALE, CalibrationProblem
from orthocal.estimation.solvers.nlp import ProgramFunctions
from orthocal.estimation.solvers.program import (
    CONVERGED,
    Program,
    Solution,
    SolverInput,
    advise,
    scaled_bounds,
)
from orthocal.estimation.solvers.variable_projection import VariableProjection
from orthocal.runtime.interrupts import noticed_interrupt

SMALLEST_WEIGHTING_SIGMA = 5e-6
"""Smallest standard deviation by which readings are weighted, [m]. For a smaller sigma the whole
objective is multiplied by a factor. The optimum is the same, and rounding errors remain below the
tolerance."""

FULL_TOLERANCE_READINGS = 20_000
"""Number of readings above which the tolerance grows like the rounding errors of their sum."""

MAX_EXACT_HESSIAN_READINGS = 2_000
"""Largest number of readings for which the exact Hessian is tried if Gauss-Newton fails."""

WIDTH_FACTORS = (256.0, 64.0, 16.0, 4.0, 2.0, 1.0)
"""Widths of a robust loss as multiples of the requested one. They are tried in this order if the
requested width does not converge directly. Each solution is the start of the next."""

COMPLEMENTARITY_TOLERANCE = 1e-11
"""Largest product of a bound's multiplier and the distance to the bound, both scaled. A parameter
within the square root of this counts as at its bound: 16 nm for a tolerance of 10 mm."""

LARGEST_BARRIER = 1e-3
"""Largest barrier parameter. Parameters and objective are of order one, and the first step of
squares nearly reaches the solution: a larger barrier would only delay convergence."""


@dataclass(frozen=True, slots=True, eq=False)
class Expressions:
    """Nonlinear program as CasADi expressions of its variables and parameters."""

    variables: ca.MX
    """x: θ̂, gauge zeros, the passive coordinates of every state and the values of manually
    aligned nuisance parameters, scaled."""
    parameters: ca.MX
    """p: readings, weights and noise ratios of the entries, then σ, the scale of the prior and the
    width of the loss (see `parameter_values`)."""
    objective: ca.MX
    """Σ ρ(r/σ) + ½ Σ ((θ − mean)/prior std)² over parameters with a prior, times (σ/5 µm)² if σ is
    below 5 µm."""
    constraints: ca.MX
    """Residuals of loop closures and of manual alignments, scaled; 0 at a solution."""
    errors: dict[str, ca.MX]
    """Values of the free parameters by name, [SI]: errors of the machine, nuisance parameters."""
    nuisance: dict[str, ca.MX]
    """Nuisance parameters among `errors`, as deviations from their manual alignment, [SI]."""
    zeros: ca.MX
    """Gauge zeros, shape (n_zeros,), [noise-scaled m]."""
    readings: ca.MX
    """Predicted readings with gauge zeros, in the order of `problem.observations`, shape
    (n_entries,), [noise-scaled m]."""
    residuals: ca.MX
    """Measured minus predicted readings, shape (n_entries,), [noise-scaled m]."""
    passive: dict[str, ca.MX]
    """Passive coordinates q of each state by name, shape (n_passive,), [m, rad]."""
    closures: dict[str, ca.MX]
    """Residuals g of the loop closures of each state by name, shape (closure_rows,), [m]."""


class NonlinearProgram(Program):
    """Calibration problem as a nonlinear program, built once for any number of solutions.

    Args:
        problem: The problem.
        options: Options of the solver.

    Raises:
        OrthocalError: If Ipopt does not accept one of `options.ipopt`.
    """

    kind = "ipopt"

    def __init__(
        self, problem: CalibrationProblem, *, options: SolverOptions | None = None
    ) -> None:
        super().__init__(problem, options=options)
        self._n_theta = problem.n_free
        self._n_zeros = problem.observations.n_zeros
        self._n_passive = problem.robot.passive_index.size
        self._builder = ProgramFunctions(
            problem, hessian=self.options.hessian, loss=self.options.loss
        )
        self._functions = self._builder.build()
        self._solver = self._build_solver()

    def with_problem(self, problem: CalibrationProblem) -> NonlinearProgram:
        """Program for the same problem with other readings or noise ratios.

        It shares the compiled functions.
        """
        other = super().with_problem(problem)
        if "_exact" in self.__dict__:
            other.__dict__["_exact"] = self._exact.with_problem(problem)
        return other

    def _solve(self, data: SolverInput) -> Solution:
        """Solve, if necessary with the exact Hessian and with a robust loss of decreasing width.

        Raises:
            SolverError: If Ipopt does not converge.
            ClosureError: If the machine cannot reach a posture with the start values.
            KeyboardInterrupt: At Ctrl-C, which CasADi would ignore.
        """
        exact, robust = self.options.hessian == "exact", self.options.loss.robust
        if data.mirrored and len(self.problem.mirrored):
            data = self._with_best_start(data)
        try:
            return self._run(data)
        except SolverError:
            if self.problem.observations.size > MAX_EXACT_HESSIAN_READINGS or (
                exact and not robust
            ):
                raise
        program = self if exact else self._exact
        if not robust:
            return program._run(data)
        present = data
        try:
            for width_factor in WIDTH_FACTORS:  # nearly squares first, then the requested width
                solution = program._run(present, width_factor)
                present = replace(present, start=solution.theta, start_passive=solution.passive)
        except SolverError:
            if exact:
                raise
            return program._run(data)
        return solution

    def _with_best_start(self, data: SolverInput) -> SolverInput:
        """Data with the start values on the better side of each mirrored direction.

        Variable projection compares the sides. If it fails, the start values remain.
        """
        try:
            best = VariableProjection(self.problem, options=self.options)._solve(data)
        except (ClosureError, SolverError):
            return data
        return replace(data, start=best.theta, start_passive=best.passive)

    def _run(self, data: SolverInput, width_factor: float = 1.0) -> Solution:
        """Run Ipopt once, with a multiple of the width of a robust loss.

        Raises:
            SolverError: If Ipopt does not converge.
            OrthocalError: If Ipopt lacks what an option requests, such as a linear solver.
        """
        problem, sigma, prescribed = self.problem, data.sigma, data.prescribed
        lower, upper = self.variable_bounds(prescribed)
        theta = np.clip(
            data.start,
            lower[: self._n_theta] * problem.theta_scale,
            upper[: self._n_theta] * problem.theta_scale,
        )
        x0 = self.initial_variables(
            theta,
            sigma=sigma,
            values=data.values,
            passive=data.start_passive,
            width_factor=width_factor,
        )
        p = self._pack(sigma, data.values, data.weights, width_factor)
        with noticed_interrupt():
            result = self._solver(x0=x0, p=p, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)
        stats = self._solver.stats()
        status, iterations = str(stats["return_status"]), int(stats["iter_count"])
        if status == "Invalid_Option":
            stated = ", ".join(f"'{k}': {v!r}" for k, v in self.options.ipopt.items())
            raise OrthocalError(
                f"SolverOptions(ipopt=...): Ipopt cannot use these options: {stated}; if one "
                "names a linear solver, its library is not installed"
            )
        if status != CONVERGED:
            raise SolverError(
                f"Ipopt did not converge: {status} after {iterations} iterations; "
                f"there is no result. {advise(self.options)}",
                status=status,
                iterations=iterations,
            )
        x = np.asarray(result["x"].full()).reshape(-1)
        # closures come first; constraints of manual alignments follow
        rows = problem.n_states * problem.robot.closure_rows
        closures = np.abs(np.asarray(result["g"].full())[:rows]).max(initial=0.0)
        multipliers = np.asarray(result["lam_x"].full()).reshape(-1)[: self._n_theta]
        first = self._n_theta + self._n_zeros
        passive = slice(first, first + problem.n_states * self._n_passive)
        return Solution(
            theta=np.clip(x[: self._n_theta], lower[: self._n_theta], upper[: self._n_theta])
            * problem.theta_scale,
            zeros=x[self._n_theta : self._n_theta + self._n_zeros] * LENGTH_SCALE,
            passive=x[passive].reshape(-1, self._n_passive) * problem.passive_scale,
            objective=float(result["f"]) / _weighting(sigma)[1],
            status=status,
            iterations=iterations,
            hessian=self.options.hessian,
            closure=float(closures) * LENGTH_SCALE,
            at_bound=_at_bound(x[: self._n_theta], multipliers, lower, upper, prescribed),
        )

    def initial_variables(
        self,
        theta: ArrayLike | None = None,
        *,
        sigma: float,
        values: Array | None = None,
        passive: Array | None = None,
        width_factor: float = 1.0,
    ) -> Array:
        """Variables x with closed loops and optimal zeros for values of the free parameters.

        Args:
            theta: Free parameters, shape (n_free,), [SI]; the active offsets by default.
            sigma: Standard deviation of one reading, [m].
            values: Readings of the entries, shape (n_entries,), [noise-scaled m]; the
                session's by default.
            passive: Start values of the passive coordinates, shape (n_states, n_passive),
                [m, rad].
            width_factor: Factor on the width of a robust loss.

        Raises:
            ClosureError: If the machine cannot reach a posture.
        """
        problem, o, loss = self.problem, self.problem.observations, self.options.loss
        theta = problem.active_theta if theta is None else np.asarray(theta, dtype=np.float64)
        closed = problem.close(theta, start=passive)
        y = problem.values if values is None else values
        residual = (y - problem.predict(theta, closed)) / sigma
        widened = replace(loss, width=loss.width * width_factor)
        aligned = problem.model.alignment.aligned
        zeros = sigma * widened.centres(residual, o.zero, o.n_zeros, weights=np.ones(o.size))
        zeros[o.zero_known] = 0.0
        return np.concatenate(
            [
                theta / problem.theta_scale,
                zeros / LENGTH_SCALE,
                (closed / problem.passive_scale).reshape(-1),
                problem.nuisance_values(theta)[aligned]
                / problem.theta_scale[problem.n_machine :][aligned],
            ]
        )

    def expressions(self) -> Expressions:
        """Program as CasADi expressions, for additional terms and constraints.

        `initial_variables` and `parameter_values` return values of its variables and parameters.
        """
        problem, o, nlp = self.problem, self.problem.observations, self._functions["nlp"]
        x, p = ca.MX.sym("x", nlp.size1_in(0)), ca.MX.sym("p", nlp.size1_in(1))
        objective, constraints = nlp(x, p)
        errors = {n: x[i] * float(problem.theta_scale[i]) for i, n in enumerate(problem.free)}
        first, n, rows = self._n_theta + self._n_zeros, self._n_passive, problem.robot.closure_rows
        zeros = x[self._n_theta : first] * LENGTH_SCALE
        readings = self._builder.predict(x, p) + zeros[o.zero.tolist()]
        states = list(enumerate(problem.states.names))
        return Expressions(
            variables=x,
            parameters=p,
            objective=objective,
            constraints=constraints,
            errors=errors,
            nuisance={name: errors[name] for name in problem.free[problem.n_machine :]},
            zeros=zeros,
            readings=readings,
            residuals=p[: o.size] - readings,
            passive={
                name: x[first + k * n : first + (k + 1) * n] * ca.DM(problem.passive_scale)
                for k, name in states
            },
            closures={
                name: constraints[k * rows : (k + 1) * rows] * LENGTH_SCALE for k, name in states
            },
        )

    def parameter_values(
        self,
        *,
        sigma: float,
        values: Array | None = None,
        excluded: ArrayLike | None = None,
        width_factor: float = 1.0,
    ) -> Array:
        """Values of the parameters p of `expressions()`.

        Args:
            sigma: Standard deviation of one reading, [m].
            values: Readings of the entries, shape (n_entries,), [noise-scaled m]; the
                session's by default.
            excluded: Indices of the entries to exclude.
            width_factor: Factor on the width of a robust loss.
        """
        y = self.problem.values if values is None else values
        return self._pack(sigma, y, self._weights(excluded), width_factor)

    def _pack(self, sigma: float, values: Array, weights: Array, width_factor: float) -> Array:
        """Values of the parameters p, shape (3 n_entries + 3,)."""
        weighted, scale = _weighting(sigma)
        width = self.options.loss.width * width_factor * sigma / weighted
        return np.concatenate([values, weights, self.problem.noise_ratio, [weighted, scale, width]])

    def functions(self) -> dict[str, ca.Function]:
        """Functions of x and p (the Hessian also of lam_f and lam_g), to check derivatives."""
        return dict(self._functions)

    @cached_property
    def _exact(self) -> NonlinearProgram:
        """Program with the exact Hessian, which is slower but converges in more cases."""
        return NonlinearProgram(self.problem, options=replace(self.options, hessian="exact"))

    def _build_solver(self) -> ca.Function:
        """Ipopt with its functions and options.

        Raises:
            OrthocalError: If Ipopt does not accept an option.
        """
        entries = self.problem.observations.size
        ipopt: dict[str, Any] = {
            "tol": self.options.tolerance * max(1.0, entries / FULL_TOLERANCE_READINGS),
            "constr_viol_tol": self.options.closure_tolerance,
            "compl_inf_tol": COMPLEMENTARITY_TOLERANCE,
            "acceptable_iter": 0,
            "max_iter": self.options.max_iterations,
            "print_level": self.options.print_level,
            "sb": "yes",
            "nlp_scaling_method": "none",  # variables and functions are of order one
            "linear_solver": "mumps",
            "mumps_pivot_order": 6,  # QAMD, for a few dense rows: those of the parameters
            # needs two thirds of the iterations of the monotone strategy if there are bounds
            "mu_strategy": "adaptive",
            "mu_max": LARGEST_BARRIER,
            **_plain(self.options.ipopt),
        }
        _require_accepted(self.options.ipopt)
        return ca.nlpsol(
            "calibration",
            "ipopt",
            self._functions["nlp"],
            {
                "grad_f": self._functions["grad_f"],
                "jac_g": self._functions["jac_g"],
                "hess_lag": self._functions["hess_lag"],
                "print_time": False,
                "show_eval_warnings": False,  # a tip that misses its rod has no reading
                "calc_lam_p": False,
                "ipopt": ipopt,
            },
        )

    def variable_bounds(self, prescribed: Mapping[int, float] | None = None) -> tuple[Array, Array]:
        """Scaled bounds of the variables, shape (n_variables,) each; known zeros are fixed at 0.

        Args:
            prescribed: Indices of fixed free parameters, mapped to their values, [SI].
        """
        problem = self.problem
        k = problem.n_states * self._n_passive + int(problem.model.alignment.aligned.sum())
        limits = np.full(self._n_zeros + k, np.inf)
        limits[: self._n_zeros][problem.observations.zero_known] = 0.0
        lower, upper = scaled_bounds(problem, prescribed or {})
        return np.concatenate([lower, -limits]), np.concatenate([upper, limits])


def _plain(options: Mapping[str, OptionValue]) -> dict[str, float | int | str]:
    """Options in the form of Ipopt, with yes and no for booleans."""
    words = {True: "yes", False: "no"}
    return {k: words[v] if isinstance(v, bool) else v for k, v in options.items()}


def _require_accepted(options: Mapping[str, OptionValue]) -> None:
    """Refuse options that Ipopt does not accept.

    Raises:
        OrthocalError: If an option is not accepted; names it.
    """
    x = ca.MX.sym("x")
    for name, value in options.items():
        try:
            ipopt = {"print_level": 0, "sb": "yes", **_plain({name: value})}
            ca.nlpsol("probe", "ipopt", {"x": x, "f": x**2}, {"ipopt": ipopt, "print_time": False})
        except RuntimeError as e:
            unknown = "No such IPOPT option" in str(e)
            raise OrthocalError(
                f"SolverOptions(ipopt=...): Ipopt has no option '{name}'"
                if unknown
                else f"SolverOptions(ipopt=...): {value!r} is not a value of Ipopt's '{name}'"
            ) from None


def _weighting(sigma: float) -> tuple[float, float]:
    """Standard deviation by which readings are weighted, [m], and factor on the objective."""
    weighted = max(sigma, SMALLEST_WEIGHTING_SIGMA)
    return weighted, (sigma / weighted) ** 2


def _at_bound(
    theta: Array, multipliers: Array, lower: Array, upper: Array, prescribed: Mapping[int, float]
) -> NDArray[np.int8]:
    """Values of `Solution.at_bound`, shape (n_free,).

    A parameter is at a bound if the multiplier of the bound exceeds the distance to the bound.
    """
    result = np.zeros(theta.size, dtype=np.int8)
    result[-multipliers > np.abs(theta - lower[: theta.size])] = -1
    result[multipliers > np.abs(theta - upper[: theta.size])] = 1
    result[list(prescribed)] = 0
    return result
