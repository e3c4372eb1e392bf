"""The whole nonlinear program as functions, with exact and sparse derivatives.

One posture and one reading are written as CasADi functions, mapped over postures and readings, and
their results gathered into the gradient, Jacobian and Hessian of the whole by index: building does
not grow with the session. Functions of a posture and of a reading are kept, in memory and on disk.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocal.estimation.loss import Loss
from orthocal.estimation.options import Hessian
from orthocal.estimation.pieces import ReadingPiece
from orthocal.estimation.problem import LENGTH_SCALE, CalibrationProblem
from orthocal.estimation.sparse import SparseSum
from orthocal.kinematics.function_cache import kept_function

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class ProgramFunctions:
    """Builds the functions of a problem's program.

    Variables x are θ̂, gauge zeros, the passive coordinates of every posture and where gauges stand
    that were set by the machine, scaled; parameters p are readings, weights and noise of each
    entry, then σ, the prior's scale and the loss's width.

    Args:
        problem: The problem.
        hessian: Of the Lagrangian: exact, or without the curvature of readings and closures.
        loss: What a residual costs.
    """

    def __init__(self, problem: CalibrationProblem, *, hessian: Hessian, loss: Loss) -> None:
        self.problem, self.hessian, self.loss = problem, hessian, loss
        self._n_theta = problem.n_free
        self._n_zeros = problem.observations.n_zeros
        self._n_passive = problem.robot.passive_index.size
        first = self._n_theta + self._n_zeros + problem.n_postures * self._n_passive
        # free parameters that a hand sets by the machine; where they stand is a variable of its own
        self._set = problem.n_machine + np.flatnonzero(problem.setting.follows)
        self._standing = np.arange(self._n_theta)
        self._standing[self._set] = first + np.arange(self._set.size)

    def build(self) -> dict[str, ca.Function]:
        """Objective and constraints, gradient, Jacobian and Hessian, of (x, p[, lam_f, lam_g])."""
        problem = self.problem
        k = problem.n_postures
        n = self._n_theta + self._n_zeros + k * self._n_passive + self._set.size
        x = ca.MX.sym("x", n)
        entries = problem.observations.size
        p = ca.MX.sym("p", 3 * entries + 3)
        lam_f = ca.MX.sym("lam_f")
        lam_g = ca.MX.sym("lam_g", k * problem.robot.closure_rows + self._set.size)
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
        return functions

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
                self._standing[piece.unknown_index],
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

    def _kept(self, name: str, build: Callable[[], ca.Function]) -> ca.Function:
        """A function of one posture or one reading, kept by all that is a constant in it."""
        problem = self.problem
        parts = [name, self.hessian, self.loss.kind, problem.machine_map.digest]
        parts += [problem.passive_scale.tobytes().hex(), str(problem.n_free - problem.n_machine)]
        digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()
        return kept_function(problem.robot, f"program {digest}", build)

    def _reading_functions(self, piece: ReadingPiece) -> dict[str, ca.Function]:
        """Objective, gradient (by θ̂; by ẑ and q̂) and Hessian (θ̂ with θ̂; the rest) of one."""
        words = self.problem.sensor_groups[piece.group].reading.words
        built: dict[str, ca.Function] = {}

        def build(name: str) -> ca.Function:
            if not built:  # all from the same expressions
                built.update(self._build_reading(piece))
            return built[name]

        return {
            name: self._kept(f"{name} of {words}", partial(build, name))
            for name in ("objective", "gradient", "hessian")
        }

    def _build_reading(self, piece: ReadingPiece) -> dict[str, ca.Function]:
        zero, y, weight = ca.SX.sym("zero"), ca.SX.sym("y"), ca.SX.sym("weight")
        sigma, width, loss = ca.SX.sym("sigma"), ca.SX.sym("width"), self.loss
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
        exact = self.hessian == "exact"
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
                name,
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
        n_g, first = problem.robot.closure_rows, self._n_theta + self._n_zeros
        closure_f, slope_f = (self._closure_function(name) for name in ("closure", "closure_slope"))
        pattern_rows, pattern_columns = (np.array(v) for v in slope_f.sparsity_out(0).get_triplet())
        arguments = [
            ca.reshape(x[first : first + k * n_p], n_p, k),
            ca.MX(ca.DM(problem.drives.T)),
            *shared,
        ]
        masks = [False, False, *(True for _ in shared)]
        constraints = ca.vec(closure_f.map(k, masks, [False])(*arguments))
        nonzeros = slope_f.map(k, masks, [False])(*arguments).nz[:]

        postures = np.arange(k)
        variables = np.hstack(
            [
                np.tile(np.arange(problem.n_machine), (k, 1)),
                self._passive_variables(postures, np.arange(n_p)),
            ]
        )
        rows = postures[:, None] * n_g + pattern_rows[None, :]
        jacobian = SparseSum(k * n_g + self._set.size, x.numel())
        jacobian.add(rows, variables[:, pattern_columns], nonzeros)
        if self.hessian == "exact":
            self._add_closure_curvature(arguments[:3], lam_g[: k * n_g], variables, hessian)
        if self._set.size:
            slopes, start = self._set_by_machine()
            constraints = ca.vertcat(constraints, slopes @ x + start)
            of_rows, columns = (np.array(v) for v in slopes.sparsity().get_triplet())
            jacobian.add(k * n_g + of_rows, columns, ca.MX(ca.DM(slopes.nonzeros())))
        return constraints, jacobian.build()

    def _closure_function(self, name: str) -> ca.Function:
        """The closures of a posture, or their slope by (θ̂, q̂), sparse."""

        def build() -> ca.Function:
            piece = self.problem.posture_piece
            inputs = [piece.passive, piece.drives, *self.problem.machine_map.symbols]
            values = {
                "closure": ca.densify(piece.closure),
                "closure_slope": ca.sparsify(ca.horzcat(piece.by_theta, piece.by_passive)),
            }
            return ca.Function(name, inputs, [values[name]])

        return self._kept(name, build)

    def _set_by_machine(self) -> tuple[ca.DM, ca.DM]:
        """Slopes by x, and constants, of what is 0 where gauges stand as they were set.

        That is how much the tolerance of a parameter has of: set by the machine, and beside that,
        less where it stands.
        """
        problem, n = self.problem, self.problem.n_machine
        own, scale = self._set - n, problem.theta_scale[self._set]
        rows = np.arange(self._set.size)
        slopes = np.zeros((rows.size, int(self._standing.max()) + 1))
        slopes[:, :n] = problem.set_by[own] / scale[:, None]
        slopes[rows, self._set] = 1.0
        slopes[rows, self._standing[self._set]] = -1.0
        start = problem.setting(problem.assembly.errors())[own] / scale
        return ca.sparsify(ca.DM(slopes)), ca.DM(start)

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


def _triangle(n: int) -> tuple[Indices, Indices]:
    """Rows and columns of an upper triangle."""
    rows, columns = np.triu_indices(n)
    return rows.astype(np.int64), columns.astype(np.int64)


def _rest_of_triangle(n: int, n_first: int) -> tuple[Indices, Indices]:
    """The upper triangle of n variables without that of the first ones."""
    rows, columns = _triangle(n)
    rest = columns >= n_first
    return rows[rest], columns[rest]
