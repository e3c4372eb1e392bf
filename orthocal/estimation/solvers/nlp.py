"""Functions of the complete nonlinear program, with exact and sparse derivatives.

CasADi functions of one posture and of one reading are mapped over all postures and readings. Their
results are gathered by index into the gradient, Jacobian and Hessian of the program. The build time
therefore does not grow with the session. The functions are cached in memory and on disk.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from functools import partial

import casadi as ca
import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.estimation.loss import Loss
from orthocal.estimation.options import Hessian
from orthocal.estimation.problem import LENGTH_SCALE, CalibrationProblem
from orthocal.estimation.solvers.symbolic_problem import ReadingExpressions, SymbolicProblem
from orthocal.kinematics.function_cache import OPTIONS, cached_function, fingerprint, function_key


class SparseSum:
    """Sparse matrix or vector whose nonzeros are sums of contributions."""

    def __init__(self, n_rows: int, n_columns: int) -> None:
        self._shape = (n_rows, n_columns)
        self._rows: list[Indices] = []
        self._columns: list[Indices] = []
        self._values: list[ca.MX] = []

    def add(self, rows: Indices, columns: Indices, values: ca.MX) -> None:
        """Add values, a column vector, at positions of the matrix."""
        self._rows.append(np.asarray(rows, dtype=np.int64).reshape(-1))
        self._columns.append(np.asarray(columns, dtype=np.int64).reshape(-1))
        self._values.append(values)

    def build(self) -> ca.MX:
        """Build the sparse matrix."""
        rows, columns = np.concatenate(self._rows), np.concatenate(self._columns)
        values = ca.vertcat(*self._values)
        keys = columns * self._shape[0] + rows  # order of compressed columns
        unique, position = np.unique(keys, return_inverse=True)
        counts = np.bincount(unique // self._shape[0], minlength=self._shape[1])
        starts = np.concatenate([[0], np.cumsum(counts)])  # first nonzero of each column
        sparsity = ca.Sparsity(*self._shape, starts.tolist(), (unique % self._shape[0]).tolist())
        if unique.size == keys.size:
            nonzeros = values[np.argsort(position).tolist()]
        else:
            summing = ca.Sparsity(
                unique.size, keys.size, list(range(keys.size + 1)), position.tolist()
            )
            nonzeros = ca.mtimes(ca.MX(ca.DM.ones(summing)), values)
        return ca.MX(sparsity, ca.densify(nonzeros))


class ProgramFunctions:
    """Builder of the functions of a problem's program.

    Variables x are θ̂, gauge zeros, the passive coordinates of every state and the manually aligned
    nuisance parameters, scaled. Parameters p are readings, weights and noise ratios of all entries,
    then σ, the scale of the prior and the width of the loss.

    Args:
        problem: The problem.
        hessian: Hessian of the Lagrangian: exact, or Gauss-Newton without the curvature of readings
            and closures.
        loss: Cost of a residual.
    """

    def __init__(self, problem: CalibrationProblem, *, hessian: Hessian, loss: Loss) -> None:
        self.problem, self.hessian, self.loss = problem, hessian, loss
        self._symbolic = SymbolicProblem(problem)
        self._n_theta = problem.n_free
        self._n_zeros = problem.observations.n_zeros
        self._n_passive = problem.robot.passive_index.size
        first = self._n_theta + self._n_zeros + problem.n_states * self._n_passive
        # the value of an aligned nuisance parameter is a variable in addition to its deviation in θ̂
        self._aligned = problem.n_machine + np.flatnonzero(problem.model.alignment.aligned)
        self._value_of = np.arange(self._n_theta)
        self._value_of[self._aligned] = first + np.arange(self._aligned.size)

    def build(self) -> dict[str, ca.Function]:
        """Build objective and constraints, gradient, Jacobian and Hessian.

        Returns:
            Functions nlp, grad_f, jac_g of (x, p) and hess_lag of (x, p, lam_f, lam_g).
        """
        problem = self.problem
        k = problem.n_states
        n = self._n_theta + self._n_zeros + k * self._n_passive + self._aligned.size
        x = ca.MX.sym("x", n)
        entries = problem.observations.size
        p = ca.MX.sym("p", 3 * entries + 3)
        lam_f = ca.MX.sym("lam_f")
        lam_g = ca.MX.sym("lam_g", k * problem.robot.closure_rows + self._aligned.size)
        theta = x[: self._n_theta]
        prior = p[3 * entries + 1] * ca.DM(problem.prior_precision)  # scaled like the objective
        from_mean = theta - ca.DM(problem.prior_mean / problem.theta_scale)

        shared = self._shared_values(theta[: problem.n_machine])
        objective = 0.5 * ca.dot(prior * from_mean, from_mean)
        gradient, hessian = SparseSum(n, 1), SparseSum(n, n)
        diagonal = np.arange(self._n_theta)
        gradient.add(diagonal, np.zeros_like(diagonal), prior * from_mean)
        hessian.add(diagonal, diagonal, lam_f * prior)
        for expressions in self._symbolic.readings:
            objective += self._add_readings(expressions, x, p, shared, lam_f, gradient, hessian)
        constraints, jacobian = self._add_closures(x, lam_g, shared, hessian)

        f, g = ca.densify(objective), ca.densify(constraints)
        grad_f = ca.densify(gradient.build())
        return {
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

    def _passive_variables(self, states: Indices, index: Indices) -> Indices:
        """Positions in x of passive coordinates, shape (n_states, n_index)."""
        first = self._n_theta + self._n_zeros
        return np.asarray(first + states[:, None] * self._n_passive + index[None, :])

    def _shared_values(self, theta: ca.MX) -> list[ca.MX]:
        """Values that depend on θ̂ alone, evaluated once for all states and readings.

        The first one is θ̂. Values of placements that vary have one column per variant.
        """
        commands = self.problem.states.variant_commands
        conditions = commands[:, len(self.problem.robot.drives) :]
        return self._symbolic.error_map.values(theta, conditions)

    def _shared_arguments(
        self, shared: list[ca.MX], states: Indices
    ) -> tuple[list[ca.MX], list[bool]]:
        """Shared values for states, and a mask of the values that are common to all states."""
        variant = self.problem.states.variant[states].tolist()
        common = [v.size2() == 1 for v in shared]
        arguments = [
            v if is_common else v[:, variant] for v, is_common in zip(shared, common, strict=True)
        ]
        return arguments, common

    def _add_readings(
        self,
        expressions: ReadingExpressions,
        x: ca.MX,
        p: ca.MX,
        shared: list[ca.MX],
        lam_f: ca.MX,
        gradient: SparseSum,
        hessian: SparseSum,
    ) -> ca.MX:
        """Add the readings of one sensor group to gradient and Hessian; return their objective.

        Local variables are θ̂, nuisance parameters ν̂, gauge zeros ẑ and passive coordinates q̂.
        """
        count, n_t = expressions.group.entries.size, expressions.theta_index.size
        theta = np.tile(expressions.theta_index, (count, 1))
        variables = np.hstack([theta, self._local_variables(expressions)])
        local = variables[:, n_t:]
        arguments, masks = self._reading_arguments(expressions, local, x, p, shared)
        names = ("objective", "gradient", "hessian")
        functions = self._reading_functions(expressions, names)

        total = functions["objective"].map(count, masks, [True])(*arguments)
        # the parts of gradient and Hessian for θ̂ are sums over readings
        by_theta, by_local = functions["gradient"].map(count, masks, [True, False])(*arguments)
        gradient.add(expressions.theta_index, np.zeros_like(expressions.theta_index), by_theta)
        gradient.add(local, np.zeros_like(local), ca.vec(by_local))

        summed, separate = functions["hessian"].map(count, masks, [True, False])(*arguments)
        rows, columns = np.triu_indices(n_t)
        hessian.add(expressions.theta_index[rows], expressions.theta_index[columns], lam_f * summed)
        rows, columns = _rest_of_triangle(variables.shape[1], n_t)
        rows, columns = variables[:, rows], variables[:, columns]
        # the values of aligned ν̂ are last in x, and shared ν̂ may have any order
        upper = np.minimum(rows, columns), np.maximum(rows, columns)
        hessian.add(*upper, lam_f * ca.vec(separate))
        return total

    def _local_variables(self, expressions: ReadingExpressions) -> Indices:
        """Positions in x of the (ν̂, ẑ, q̂) of a sensor group's entries, shape (n, n_local)."""
        o, entries = self.problem.observations, expressions.group.entries
        return np.hstack(
            [
                self._value_of[self.problem.n_machine + expressions.group.nuisance],
                (self._n_theta + o.zero[entries])[:, None],
                self._passive_variables(o.state[entries], expressions.passive_index),
                self._passive_variables(o.second[entries], expressions.second_index),
            ]
        )

    def predict(self, x: ca.MX, p: ca.MX) -> ca.MX:
        """Predicted readings of all entries, gauge zeros at 0.

        Args:
            x: Variables of the program.
            p: Parameters of the program.

        Returns:
            Shape (n_entries,), [noise-scaled m].
        """
        shared = self._shared_values(x[: self.problem.n_machine])
        values, entries = [], []
        for expressions in self._symbolic.readings:
            local = self._local_variables(expressions)
            arguments, masks = self._reading_arguments(expressions, local, x, p, shared)
            function = self._reading_functions(expressions, ("reading",))["reading"]
            values.append(
                ca.vec(function.map(expressions.group.entries.size, masks, [False])(*arguments))
            )
            entries.append(expressions.group.entries)
        order = np.argsort(np.concatenate(entries)) if entries else np.empty(0, dtype=np.int64)
        return ca.vertcat(ca.MX(0, 1), *values)[order.tolist()]

    def _reading_arguments(
        self,
        expressions: ReadingExpressions,
        local: Indices,
        x: ca.MX,
        p: ca.MX,
        shared: list[ca.MX],
    ) -> tuple[list[ca.MX], list[bool]]:
        """Arguments of the mapped functions of a sensor group, and a mask of the common ones.

        Args:
            expressions: A reading of the group.
            local: Positions in x of (ν̂, ẑ, q̂) of its entries, shape (n, n_local).
            x: Variables of the program.
            p: Parameters of the program.
            shared: Result of `_shared_values`.
        """
        problem, o, group = self.problem, self.problem.observations, expressions.group
        count, n_u = group.nuisance.shape
        references = problem.model.reference_commands
        prior_stds = problem.theta_scale[problem.n_machine + group.nuisance]
        # in the order of the inputs in `_build_reading`
        separate = [
            ca.reshape(x[local[:, :n_u].reshape(-1).tolist()], n_u, count),  # ν̂
            _columns(prior_stds),
            x[local[:, n_u].tolist()].T,  # ẑ
            ca.reshape(x[local[:, n_u + 1 :].reshape(-1).tolist()], -1, count),  # q̂
            # readings, weights and noise ratios
            *(p[(i * o.size + group.entries).tolist()].T for i in range(3)),
            _columns(problem.states.commands[o.state[group.entries]]),
            _columns(references[group.setups]),
            _columns(group.constants),
        ]
        if group.reading.pairs:
            separate.append(_columns(problem.states.commands[o.second[group.entries]]))
        machine, machine_mask = self._shared_arguments(shared, o.state[group.entries])
        common = [p[3 * o.size], p[3 * o.size + 2]]  # σ and the width of the loss
        masks = [False] * len(separate) + [True] * len(common) + machine_mask
        return [*separate, *common, *machine], masks

    def _cached(self, name: str, build: Callable[[], ca.Function]) -> ca.Function:
        """Cached function of one posture or one reading; its constants are part of the key."""
        problem = self.problem
        parts = [name, self.hessian, self.loss.kind, self._symbolic.error_map.digest]
        parts += [problem.passive_scale.tobytes().hex(), str(problem.n_free - problem.n_machine)]
        digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()
        key = function_key(f"program {digest}", fingerprint(problem.robot))
        return cached_function(key, build)

    def _reading_functions(
        self, expressions: ReadingExpressions, names: Sequence[str]
    ) -> dict[str, ca.Function]:
        """Some of the cached functions of a reading, by name (see `_build_reading`)."""
        sensor = expressions.group.reading.pattern.name
        built: dict[str, ca.Function] = {}

        def build(name: str) -> ca.Function:
            if not built:  # all functions at once, from the same expressions
                built.update(self._build_reading(expressions))
            return built[name]

        return {name: self._cached(f"{name} of {sensor}", partial(build, name)) for name in names}

    def _build_reading(self, expressions: ReadingExpressions) -> dict[str, ca.Function]:
        """Functions of a reading by name: value, objective, gradient and Hessian."""
        zero, y, weight = ca.SX.sym("zero"), ca.SX.sym("y"), ca.SX.sym("weight")
        sigma, width, loss = ca.SX.sym("sigma"), ca.SX.sym("width"), self.loss
        n_t, n_u = expressions.theta_index.size, expressions.nuisance.numel()
        ratio, scaled = ca.SX.sym("noise"), ca.SX.sym("scaled", n_u)
        prior_stds = ca.SX.sym("prior_stds", n_u)
        residual = (y - expressions.reading / ratio - zero * LENGTH_SCALE) / sigma
        # derivative of the residual with respect to (θ̂, ν̂, ẑ, q̂)
        row = -ca.horzcat(
            expressions.by_theta / ratio,
            expressions.by_nuisance @ ca.diag(prior_stds) / ratio,
            LENGTH_SCALE,
            expressions.by_passive / ratio,
        )
        row = ca.densify(row / sigma)
        influence = weight * loss.influence(residual, width)
        gradient = (influence * row).T
        exact = self.hessian == "exact"
        # Gauss-Newton uses the secant ρ'/r, which is never below ρ'': for large residuals, where ρ
        # is nearly linear, a step with ρ'' is much too long
        curvature = loss.curvature(residual, width) if exact else loss.weight(residual, width)
        hessian = weight * curvature * (row.T @ row)
        if exact:
            hessian += (
                influence
                * self._reading_curvature(expressions, zero, prior_stds)
                / (-sigma * ratio)
            )
        symbolic = self._symbolic
        inputs = [scaled, prior_stds, zero, symbolic.passive_of(expressions), y, weight, ratio]
        inputs += [symbolic.command, symbolic.reference, expressions.constants]
        inputs += [symbolic.second[0]] if expressions.group.reading.pairs else []
        inputs += [sigma, width, *symbolic.error_map.symbols]

        def pick(rows: Indices, columns: Indices) -> ca.SX:
            elements = zip(rows.tolist(), columns.tolist(), strict=True)
            return ca.vertcat(*(hessian[i, j] for i, j in elements))

        triangle = np.triu_indices(n_t), _rest_of_triangle(row.numel(), n_t)
        outputs = {
            "reading": [expressions.reading / ratio],
            "objective": [weight * loss.value(residual, width)],
            "gradient": [gradient[:n_t], gradient[n_t:]],
            "hessian": [pick(*triangle[0]), pick(*triangle[1])],
        }
        nuisance = scaled * prior_stds
        return {
            name: ca.Function(
                name,
                inputs,
                [
                    ca.densify(ca.substitute(v, expressions.nuisance, nuisance) if n_u else v)
                    for v in values
                ],
                OPTIONS,
            )
            for name, values in outputs.items()
        }

    def _reading_curvature(
        self, expressions: ReadingExpressions, zero: ca.SX, prior_stds: ca.SX
    ) -> ca.SX:
        """Second derivatives of h with respect to (θ̂, ν̂, ẑ, q̂)."""
        symbolic = self._symbolic
        theta = symbolic.theta[expressions.theta_index.tolist()]
        passive = symbolic.passive_of(expressions)
        u = ca.vertcat(theta, expressions.nuisance, zero, passive)
        hessian, _ = ca.hessian(symbolic.direct_reading(expressions), u)
        ones = ca.SX.ones(theta.numel()), ca.SX.ones(1 + passive.numel())
        scale = ca.diag(ca.vertcat(ones[0], prior_stds, ones[1]))
        return ca.densify(scale @ hessian @ scale)

    def _add_closures(
        self, x: ca.MX, lam_g: ca.MX, shared: list[ca.MX], hessian: SparseSum
    ) -> tuple[ca.MX, ca.MX]:
        """Closures of all states and their Jacobian; adds their curvature to the Hessian."""
        problem = self.problem
        k, n_p = problem.n_states, self._n_passive
        n_g, first = problem.robot.closure_rows, self._n_theta + self._n_zeros
        names = ("closure", "closure_jacobian")
        closure_f, jacobian_f = (self._closure_function(name) for name in names)
        pattern_rows, pattern_columns = (
            np.array(v) for v in jacobian_f.sparsity_out(0).get_triplet()
        )
        passive = ca.reshape(x[first : first + k * n_p], n_p, k)
        commands = _columns(problem.states.commands)
        machine = np.tile(np.arange(problem.n_machine), (k, 1))
        variables = np.hstack([machine, self._passive_variables(np.arange(k), np.arange(n_p))])
        jacobian = SparseSum(k * n_g + self._aligned.size, x.numel())
        values, mask = self._shared_arguments(shared, np.arange(k))
        arguments, masks = [passive, commands, *values], [False, False, *mask]
        constraints = ca.vec(closure_f.map(k, masks, [False])(*arguments))
        nonzeros = jacobian_f.map(k, masks, [False])(*arguments).nz[:]
        rows = np.arange(k)[:, None] * n_g + pattern_rows[None, :]
        jacobian.add(rows, variables[:, pattern_columns], nonzeros)
        if self.hessian == "exact":
            arguments = [passive, commands, shared[0], ca.reshape(lam_g[: k * n_g], n_g, k)]
            self._add_closure_curvature(arguments, variables, hessian)
        if self._aligned.size:
            matrix, start = self._alignment_constraints()
            constraints = ca.vertcat(constraints, matrix @ x + start)
            rows, columns = (np.array(v) for v in matrix.sparsity().get_triplet())
            jacobian.add(k * n_g + rows, columns, ca.MX(ca.DM(matrix.nonzeros())))
        return constraints, jacobian.build()

    def _closure_function(self, name: str) -> ca.Function:
        """Function of the closures of a posture, or of their sparse Jacobian ∂ĝ/∂(θ̂, q̂)."""

        def build() -> ca.Function:
            symbolic = self._symbolic
            inputs = [symbolic.passive, symbolic.command, *symbolic.error_map.symbols]
            closure, jacobian = symbolic.closure
            value = ca.densify(closure) if name == "closure" else ca.sparsify(jacobian)
            return ca.Function(name, inputs, [value], OPTIONS)

        return self._cached(name, build)

    def _alignment_constraints(self) -> tuple[ca.DM, ca.DM]:
        """Matrix A and constants b of A x + b = 0 for manually aligned nuisance parameters.

        A x + b is the alignment (a function of the errors) plus the deviation minus the value,
        [prior std].
        """
        problem, n = self.problem, self.problem.n_machine
        index, scale = self._aligned - n, problem.theta_scale[self._aligned]
        rows = np.arange(self._aligned.size)
        matrix = np.zeros((rows.size, int(self._value_of.max()) + 1))
        alignment = problem.model.alignment
        matrix[:, :n] = (alignment.sensitivity @ problem.errors_per_theta)[index] / scale[:, None]
        matrix[rows, self._aligned] = 1.0
        matrix[rows, self._value_of[self._aligned]] = -1.0
        start = alignment(problem.closure.errors())[index] / scale
        return ca.sparsify(ca.DM(matrix)), ca.DM(start)

    def _add_closure_curvature(
        self, arguments: list[ca.MX], variables: Indices, hessian: SparseSum
    ) -> None:
        """Add λᵀ ∇²ĝ of every state to the Hessian; arguments are q̂, commands, θ̂ and λ."""
        symbolic = self._symbolic
        multiplier = ca.SX.sym("multiplier", self.problem.robot.closure_rows)
        u = ca.vertcat(symbolic.theta, symbolic.passive)
        curvature = ca.triu(ca.hessian(ca.dot(multiplier, symbolic.direct_closure), u)[0])
        rows, columns = (np.array(v) for v in curvature.sparsity().get_triplet())
        summed_part = columns < self.problem.n_machine
        function = ca.Function(
            "closure_hessian",
            [symbolic.passive, symbolic.command, symbolic.theta, multiplier],
            [
                ca.densify(curvature.nz[np.flatnonzero(part).tolist()])
                for part in (summed_part, ~summed_part)
            ],
            OPTIONS,
        )
        masks = [False, False, True, False], [True, False]
        summed, local = function.map(len(variables), *masks)(*arguments)
        hessian.add(rows[summed_part], columns[summed_part], summed)
        positions = variables[:, rows[~summed_part]], variables[:, columns[~summed_part]]
        hessian.add(*positions, ca.vec(local))


def _columns(rows: Array) -> ca.MX:
    """Constants, one row per call of a mapped function, as columns."""
    return ca.MX(ca.DM(rows.T))


def _rest_of_triangle(n: int, n_first: int) -> tuple[Indices, Indices]:
    """Positions in the upper triangle of n variables, except that of the first n_first."""
    rows, columns = np.triu_indices(n)
    later = columns >= n_first
    return rows[later], columns[later]
