"""The exact identification as one nonlinear program, solved with Ipopt.

Variables are θ̂, the gauge zeros ẑ and every posture's passive coordinates q̂_k; the closures of
every posture are constraints. Derivatives are exact. One posture and one reading are written as
CasADi functions, mapped over postures and readings, and their results gathered into the sparse
gradient, Jacobian and Hessian of the whole by index: building does not grow with the session.
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
from orthocal.estimation.pieces import ReadingPiece
from orthocal.estimation.problem import LENGTH_SCALE, CalibrationProblem
from orthocal.estimation.solvers.program import LEFT_OUT, Solution, no_convergence
from orthocal.estimation.sparse import SparseSum
from orthocal.interrupts import noticed_interrupt

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
readings so far out that neither Hessian converges."""

CONVERGED = frozenset({"Solve_Succeeded"})
"""Ipopt's words for a solution; anything else is an error."""


COMPLEMENTARITY = 1e-11
"""Multiplier of a bound times the distance to it, both scaled, at most. A parameter within the root
of that of its bound is said to be held by it, whether it is or not: 16 nm of an offset of 5 mm."""


@dataclass(frozen=True, slots=True, eq=False)
class Expressions:
    """A nonlinear program as expressions."""

    variables: ca.MX
    """x: θ̂, gauge zeros and the passive coordinates of every posture, scaled."""
    parameters: ca.MX
    """p: readings, their weights and noise."""
    objective: ca.MX
    constraints: ca.MX
    """0 where all loops are closed."""
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
        self._build()
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

        exact = self.options.hessian == "exact"
        try:
            return run(self)
        except SolverError:
            if self.problem.observations.size > MOST_EXACT or (
                exact and not self.options.loss.robust
            ):
                raise
        program = self if exact else self._exact
        if not exact:
            try:
                return run(program)
            except SolverError:
                if not self.options.loss.robust:
                    raise
        for widening in WIDENINGS:  # nearly squares first, then as wanted
            solution = run(program, widening)
            start, start_passive = solution.theta, solution.passive
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
        return Solution(
            theta=x[: self._n_theta] * problem.theta_scale,
            zeros=x[self._n_theta : self._n_theta + self._n_zeros] * LENGTH_SCALE,
            passive=x[self._n_theta + self._n_zeros :].reshape(-1, self._n_passive)
            * problem.passive_scale,
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
        zeros = sigma * wide.centres(residual, o.zero, o.n_zeros, weights=np.ones(o.size))
        return np.concatenate(
            [
                at / problem.theta_scale,
                zeros / LENGTH_SCALE,
                (closed / problem.passive_scale).reshape(-1),
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

    def _bounds(self, side: Literal["lower", "upper"], held: Mapping[int, float]) -> Array:
        """Bounds of all variables, scaled: only parameters have any."""
        problem = self.problem
        k = problem.n_postures * self._n_passive + self._n_zeros
        own = getattr(problem.selection, side) / problem.theta_scale
        for i, value in held.items():
            own[i] = value / problem.theta_scale[i]
        return np.concatenate([own, np.full(k, -np.inf if side == "lower" else np.inf)])

    def _build(self) -> None:
        problem = self.problem
        k = problem.n_postures
        n_fixed = self._n_theta + self._n_zeros
        n = n_fixed + k * self._n_passive
        x = ca.MX.sym("x", n)
        entries = problem.observations.size
        p = ca.MX.sym("p", 3 * entries + 3)
        lam_f = ca.MX.sym("lam_f")
        lam_g = ca.MX.sym("lam_g", k * problem.robot.closure_rows)
        theta = x[: self._n_theta]
        prior = p[3 * entries + 1] * ca.DM(problem.prior_precision)
        from_mean = theta - ca.DM(problem.prior_mean / problem.theta_scale)

        shared = list(self._shared_call(theta[: problem.n_machine]))
        objective = 0.5 * ca.dot(prior * from_mean, from_mean)
        gradient, hessian = SparseSum(n, 1), SparseSum(n, n)
        diagonal = np.arange(self._n_theta)
        gradient.add(diagonal, np.zeros_like(diagonal), prior * from_mean)
        hessian.add(diagonal, diagonal, lam_f * prior)
        for piece in problem.reading_pieces:
            objective += self._add_readings(piece, x, p, shared, lam_f, gradient, hessian)
        constraints, jacobian = self._add_closures(x, lam_g, shared, hessian)

        f, g = ca.densify(objective), ca.densify(constraints)
        grad_f = ca.densify(gradient.build())
        functions = {
            "nlp": ca.Function("nlp", [x, p], [f, g], ["x", "p"], ["f", "g"]),
            "grad_f": ca.Function("grad_f", [x, p], [f, grad_f], ["x", "p"], ["f", "grad_f_x"]),
            "jac_g": ca.Function("jac_g", [x, p], [g, jacobian], ["x", "p"], ["g", "jac_g_x"]),
            "hess_lag": ca.Function(
                "hess_lag",
                [x, p, lam_f, lam_g],
                [hessian.build()],
                ["x", "p", "lam_f", "lam_g"],
                ["hess_gamma_x_x"],
            ),
        }
        self._functions = functions
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
        self._solver = ca.nlpsol(
            "calibration",
            "ipopt",
            functions["nlp"],
            {
                "grad_f": functions["grad_f"],
                "jac_g": functions["jac_g"],
                "hess_lag": functions["hess_lag"],
                "print_time": False,
                "calc_lam_p": False,
                "ipopt": ipopt,
            },
        )

    def _passive_variables(self, postures: Indices, index: Indices) -> Indices:
        """Positions in x of passive coordinates, shape (n_postures, n_index)."""
        first = self._n_theta + self._n_zeros
        return np.asarray(first + postures[:, None] * self._n_passive + index[None, :])

    def _shared_call(self, theta: ca.MX) -> tuple[ca.MX, ...]:
        """What depends on θ̂ alone, once for all postures and readings."""
        return tuple(self.problem.machine_map.function(theta))

    def _add_readings(
        self,
        piece: ReadingPiece,
        x: ca.MX,
        p: ca.MX,
        shared: list[ca.MX],
        lam_f: ca.MX,
        gradient: SparseSum,
        hessian: SparseSum,
    ) -> ca.MX:
        """Add the readings of one kind to gradient and Hessian; returns their objective.

        Local variables are (θ̂, û, ẑ, q̂) in the order that they have in x, û what is not known of
        the sensor.
        """
        problem, o = self.problem, self.problem.observations
        count, n_t = piece.entries.size, piece.theta_index.size
        postures = o.posture[piece.entries]
        variables = np.hstack(
            [
                np.tile(piece.theta_index, (count, 1)),
                piece.unknown_index,
                (self._n_theta + o.zero[piece.entries])[:, None],
                self._passive_variables(postures, piece.passive_index),
            ]
        )
        local, n_u = variables[:, n_t:], piece.unknown_index.shape[1]
        tolerances = ca.DM(problem.theta_scale[piece.unknown_index].T)
        own = [
            ca.reshape(x[local[:, :n_u].reshape(-1).tolist()], n_u, count),
            ca.MX(tolerances),
            x[local[:, n_u].tolist()].T,
            ca.reshape(x[local[:, n_u + 1 :].reshape(-1).tolist()], -1, count),
            p[piece.entries.tolist()].T,
            p[(o.size + piece.entries).tolist()].T,
            p[(2 * o.size + piece.entries).tolist()].T,
            ca.MX(ca.DM(problem.drives[postures].T)),
            ca.MX(ca.DM(problem.session.zero_drives[piece.setups].T)),
            ca.MX(ca.DM(piece.table.T)),
        ]
        common = [p[3 * o.size], p[3 * o.size + 2], *shared]
        arguments = [*own, *common]
        masks = [*(False for _ in own), *(True for _ in common)]
        functions = self._reading_functions(piece)

        total = functions["objective"].map(count, masks, [True])(*arguments)
        # the part of the gradient by θ̂ is a sum over readings, and so is that of the Hessian
        by_theta, by_local = functions["gradient"].map(count, masks, [True, False])(*arguments)
        gradient.add(piece.theta_index, np.zeros_like(piece.theta_index), by_theta)
        gradient.add(local, np.zeros_like(local), ca.vec(by_local))

        summed, rest = functions["hessian"].map(count, masks, [True, False])(*arguments)
        rows, columns = _triangle(n_t)
        hessian.add(piece.theta_index[rows], piece.theta_index[columns], lam_f * summed)
        rows, columns = _rest_of_triangle(variables.shape[1], n_t)
        rows, columns = variables[:, rows], variables[:, columns]
        # unknowns that setups share may come in any order
        upper = np.minimum(rows, columns), np.maximum(rows, columns)
        hessian.add(*upper, lam_f * ca.vec(rest))
        return total

    def _reading_functions(self, piece: ReadingPiece) -> dict[str, ca.Function]:
        """Objective, gradient (by θ̂; by ẑ and q̂) and Hessian (θ̂ with θ̂; the rest) of one."""
        zero, y, weight = ca.SX.sym("zero"), ca.SX.sym("y"), ca.SX.sym("weight")
        sigma, width, loss = ca.SX.sym("sigma"), ca.SX.sym("width"), self.options.loss
        n_t, n_u = piece.theta_index.size, piece.unknowns.numel()
        noise, scaled = ca.SX.sym("noise"), ca.SX.sym("scaled", n_u)
        tolerances = ca.SX.sym("tolerances", n_u)
        residual = (y - piece.reading / noise - zero * LENGTH_SCALE) / sigma
        slope = -ca.horzcat(
            piece.by_theta / noise,
            piece.by_unknowns @ ca.diag(tolerances) / noise,
            LENGTH_SCALE,
            piece.by_passive / noise,
        )
        slope = ca.densify(slope / sigma)
        pull = weight * loss.slope(residual, width)
        gradient = (pull * slope).T
        exact = self.options.hessian == "exact"
        # Gauss-Newton takes the secant ρ'/r, which is never below ρ'': far out, where ρ is nearly
        # straight, a step by ρ'' goes much too far
        bend = loss.curvature(residual, width) if exact else loss.secant(residual, width)
        second = weight * bend * (slope.T @ slope)
        if exact:
            second += pull * self._reading_curvature(piece, tolerances) / (-sigma * noise)
        inputs = [scaled, tolerances, zero, piece.passive, y, weight, noise]
        inputs += [piece.drives, piece.zero, piece.constants, sigma, width]
        inputs += self.problem.machine_map.symbols

        def pick(rows: Indices, columns: Indices) -> ca.SX:
            return ca.vertcat(*(second[int(i), int(j)] for i, j in zip(rows, columns, strict=True)))

        triangle = _triangle(n_t), _rest_of_triangle(slope.numel(), n_t)
        outputs = {
            "objective": [weight * loss.cost(residual, width)],
            "gradient": [gradient[:n_t], gradient[n_t:]],
            "hessian": [pick(*triangle[0]), pick(*triangle[1])],
        }
        own = scaled * tolerances
        return {
            name: ca.Function(
                f"{name}_{piece.group}",
                inputs,
                [ca.densify(ca.substitute(v, piece.unknowns, own) if n_u else v) for v in values],
            )
            for name, values in outputs.items()
        }

    def _reading_curvature(self, piece: ReadingPiece, tolerances: ca.SX) -> ca.SX:
        """Second derivatives of h by (θ̂, û, ẑ, q̂), in the variables of the piece."""
        direct = self.problem.direct
        theta = direct.theta[piece.theta_index.tolist()]
        passive = direct.passive[piece.passive_index.tolist()]
        unknowns, constants = direct.unknowns[piece.group], direct.constants[piece.group]
        u = ca.vertcat(theta, unknowns, ca.SX.sym("zero"), passive)
        second, _ = ca.hessian(direct.readings[piece.group], u)
        n_t, n = theta.numel(), u.numel()
        scale = ca.diag(
            ca.vertcat(ca.SX.ones(n_t), tolerances, ca.SX.ones(n - n_t - unknowns.numel()))
        )
        function = ca.Function(
            "curvature",
            [direct.theta, unknowns, passive, direct.drives, direct.zero, constants],
            [ca.densify(second)],
        )
        theta = self.problem.machine_map.symbols[0]
        found = function(
            theta, piece.unknowns, piece.passive, piece.drives, piece.zero, piece.constants
        )
        return scale @ found @ scale

    def _add_closures(
        self, x: ca.MX, lam_g: ca.MX, shared: list[ca.MX], hessian: SparseSum
    ) -> tuple[ca.MX, ca.MX]:
        """Closures of all postures and their Jacobian; their curvature goes into the Hessian."""
        problem = self.problem
        k, n_p = problem.n_postures, self._n_passive
        n_g = problem.robot.closure_rows
        piece = problem.posture_piece
        slope = ca.sparsify(ca.horzcat(piece.by_theta, piece.by_passive))
        pattern_rows, pattern_columns = (np.array(v) for v in slope.sparsity().get_triplet())
        inputs = [piece.passive, piece.drives, *problem.machine_map.symbols]
        closure_f = ca.Function("closure", inputs, [ca.densify(piece.closure)])
        slope_f = ca.Function("closure_slope", inputs, [ca.densify(slope.nz[:])])
        arguments = [
            ca.reshape(x[self._n_theta + self._n_zeros :], n_p, k),
            ca.MX(ca.DM(problem.drives.T)),
            *shared,
        ]
        masks = [False, False, *(True for _ in shared)]
        constraints = ca.vec(closure_f.map(k, masks, [False])(*arguments))
        nonzeros = slope_f.map(k, masks, [False])(*arguments)

        postures = np.arange(k)
        variables = np.hstack(
            [
                np.tile(np.arange(problem.n_machine), (k, 1)),
                self._passive_variables(postures, np.arange(n_p)),
            ]
        )
        rows = postures[:, None] * n_g + pattern_rows[None, :]
        jacobian = SparseSum(k * n_g, x.numel())
        jacobian.add(rows, variables[:, pattern_columns], ca.vec(nonzeros))
        if self.options.hessian == "exact":
            self._add_closure_curvature(arguments[:3], lam_g, variables, hessian)
        return constraints, jacobian.build()

    def _add_closure_curvature(
        self, arguments: list[ca.MX], lam_g: ca.MX, variables: Indices, hessian: SparseSum
    ) -> None:
        """Σ λᵀ ∇²ĝ of every posture; arguments are q̂, drives and θ̂."""
        direct = self.problem.direct
        k, n_g = self.problem.n_postures, self.problem.robot.closure_rows
        multiplier = ca.SX.sym("multiplier", n_g)
        u = ca.vertcat(direct.theta, direct.passive)
        second = ca.triu(ca.hessian(ca.dot(multiplier, direct.closure), u)[0])
        rows, columns = (np.array(v) for v in second.sparsity().get_triplet())
        summed_part = columns < self.problem.n_machine
        function = ca.Function(
            "closure_hessian",
            [direct.passive, direct.drives, direct.theta, multiplier],
            [
                ca.densify(second.nz[np.flatnonzero(part).tolist()])
                for part in (summed_part, ~summed_part)
            ],
        )
        summed, local = function.map(k, [False, False, True, False], [True, False])(
            *arguments, ca.reshape(lam_g, n_g, k)
        )
        hessian.add(rows[summed_part], columns[summed_part], summed)
        rest = variables[:, rows[~summed_part]], variables[:, columns[~summed_part]]
        hessian.add(*rest, ca.vec(local))


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


def _triangle(n: int) -> tuple[Indices, Indices]:
    """Rows and columns of an upper triangle."""
    rows, columns = np.triu_indices(n)
    return rows.astype(np.int64), columns.astype(np.int64)


def _rest_of_triangle(n: int, n_first: int) -> tuple[Indices, Indices]:
    """The upper triangle of n variables without that of the first ones."""
    rows, columns = _triangle(n)
    rest = columns >= n_first
    return rows[rest], columns[rest]
