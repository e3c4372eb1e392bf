"""Derivatives of readings and closures with respect to the twists of placements.

Machine parameters θ̂ move placements by twists ξ (see `error_map`). `ClosurePattern` holds the
nonzeros of ∂g/∂ξ of the loop closures g. `TwistChain` applies the chain rule from ξ to θ̂.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.kinematics.error_map import ErrorMap, VaryingDerivatives, twist_components
from orthocal.kinematics.robot_functions import RobotFunctions
from orthocal.observation.observations import States


@dataclass(frozen=True, slots=True, eq=False)
class FreeParameters:
    """Scaled free parameters θ̂: machine errors first, then nuisance parameters."""

    unit_errors: Array
    """Elementary errors for one unit of each machine parameter, (n_errors, n_machine), [SI]."""
    nuisance_scale: Array
    """Values of one unit of each nuisance parameter, shape (n_nuisance,), [SI]."""
    nuisance_columns: Indices
    """Column of each nuisance parameter, counted after the machine parameters, (n_nuisance,).
    Parameters may share a column if no reading depends on more than one of them."""
    pattern: ClosurePattern
    """Nonzeros of ∂g/∂ξ for the twists ξ that the machine parameters change."""

    @property
    def n_nuisance_columns(self) -> int:
        """Number of columns of the nuisance parameters."""
        return int(self.nuisance_columns.max(initial=-1)) + 1


@dataclass(frozen=True, slots=True, eq=False)
class ClosurePattern:
    """Nonzeros of ∂g/∂ξ for the twists that free parameters change, sorted by rows of g."""

    used: Indices
    """Indices of the twists that free parameters change, shape (n_used,)."""
    position: Indices
    """Position of each twist in `used`, -1 for other twists, shape (n_twists,)."""
    chosen: Indices
    """Positions of the chosen nonzeros among all nonzeros, shape (nnz,)."""
    rows: Indices
    """Row of each chosen nonzero, shape (nnz,)."""
    columns: Indices
    """Twist of each chosen nonzero, shape (nnz,)."""

    @staticmethod
    def of(functions: RobotFunctions, unit_errors: Array) -> ClosurePattern:
        """Pattern for parameters.

        Args:
            functions: Functions of the robot.
            unit_errors: Elementary errors for one unit of each parameter, shape (n_errors, n).
        """
        moved = functions.errors.twists_moved_by(unit_errors).reshape(-1, 6).any(axis=1)
        used = np.flatnonzero(np.repeat(moved, 6))
        position = np.full(functions.n_twists, -1)
        position[used] = np.arange(used.size)
        rows, twists = functions.twist_pattern
        chosen = np.flatnonzero(position[twists] >= 0)
        chosen = chosen[np.argsort(rows[chosen], kind="stable")]
        return ClosurePattern(used, position, chosen, rows[chosen], twists[chosen])

    def dense(self, nonzeros: Array, n_rows: int) -> Array:
        """Dense ∂g/∂ξ, shape (S, k, n_rows, n_used), of nonzeros, shape (S, k, nnz)."""
        result: Array = np.zeros((*nonzeros.shape[:2], n_rows * self.used.size))
        result[:, :, self.rows * self.used.size + self.position[self.columns]] = nonzeros
        return result.reshape(*nonzeros.shape[:2], n_rows, self.used.size)

    def times(self, nonzeros: Array, twists: Array, n_rows: int) -> Array:
        """Product ∂g/∂ξ · ξ.

        Args:
            nonzeros: Nonzeros of ∂g/∂ξ, shape (S, k, nnz).
            twists: ξ, shape (S, k, n_twists) or (S, 1, n_twists).
            n_rows: Number of rows of g.

        Returns:
            Shape (S, k, n_rows).
        """
        n_sets = max(len(twists), len(nonzeros))
        result = np.zeros((n_sets, nonzeros.shape[1], n_rows))
        starts = np.searchsorted(self.rows, np.arange(n_rows + 1)).tolist()
        for row, (first, end) in enumerate(itertools.pairwise(starts)):
            part = slice(first, end)
            factors = twists[:, :, self.columns[part]]
            if twists.shape[1] == 1:
                result[..., row] = (nonzeros[..., part] @ np.swapaxes(factors, 1, 2))[..., 0]
            else:
                result[..., row] = (nonzeros[..., part] * factors).sum(axis=-1)
        return result


class TwistChain:
    """Chain rule from the twists of placements to the machine parameters, for S machines.

    Args:
        map_: The error map.
        errors: Elementary errors of the machines, shape (S, n_errors), [SI].
        states: Loop closures, with the conditions of their placements.
        free: The free parameters.
        sparse: Use a sparse matrix, which is possible for one machine.
    """

    def __init__(
        self, map_: ErrorMap, errors: Array, states: States, free: FreeParameters, *, sparse: bool
    ) -> None:
        pattern, commands = free.pattern, states.variant_commands
        self._used, self._variant = pattern.used, states.variant
        self._unit_errors = free.unit_errors
        self._map, self._errors, self._command = map_, errors, commands[0]
        self._sparse = sparse and self._used.size > 0
        self._twist_jacobian = map_.twist_jacobian(errors, free.unit_errors, self._command)
        self._right = np.zeros((1, len(map_.moved), 6, 6))
        if self._used.size:
            self._right = map_.right_jacobians(errors, self._command)
        self._varying: VaryingDerivatives | None = None
        if len(commands) > 1 and self._used.size:
            self._varying = map_.varying_derivatives(errors, free.unit_errors, commands)
            self._of_varying = twist_components(map_.varying)
            self._positions = pattern.position[self._of_varying]

    @cached_property
    def _matrix(self) -> Any:  # noqa: ANN401 - SciPy has no types
        """∂ξ/∂θ̂ of the used twists, shape (S, n_used, n); or its transpose as a sparse matrix.

        Rows of twists that vary with the conditions are 0.
        """
        jacobian = self._map.placement_jacobian(
            self._errors, self._unit_errors, commands=self._command, right=self._right
        )
        if self._varying is not None:
            jacobian[:, self._of_varying] = 0.0
        matrix = jacobian[:, self._used]
        if not self._sparse:
            return matrix
        from scipy.sparse import csr_array

        return csr_array(matrix[0].T)

    def __call__(self, rows: Array, states: Indices) -> Array:
        """Derivatives with respect to machine parameters.

        Args:
            rows: Derivatives with respect to the used twists, shape (S, n, n_used).
            states: Loop closure of each row, shape (n,).

        Returns:
            Shape (S, n, n_machine).
        """
        if self._sparse:
            result = np.asarray((self._matrix @ np.ascontiguousarray(rows[0].T)).T[None])
        else:
            result = np.asarray(rows @ self._matrix)
        if self._varying is not None:
            result += self._by_varying(self._varying, rows, self._variant[states])
        return result

    def _by_varying(self, varying: VaryingDerivatives, rows: Array, variant: Indices) -> Array:
        """Contribution of the placements that vary to the result of a call.

        Derivatives with respect to ξ are multiplied by T, then by ∂δ (see `VaryingDerivatives`).
        """
        by_xi = np.where(self._positions >= 0, rows[:, :, self._positions], 0.0)
        by_delta = by_xi.reshape(*rows.shape[:2], -1, 1, 6) @ varying.right[:, variant]
        by_delta = by_delta.reshape(*rows.shape[:2], -1)
        by_errors = (by_delta[:, :, None, varying.rows] @ varying.by_errors[:, variant])[:, :, 0]
        return np.asarray(by_delta @ varying.constant + by_errors @ varying.unit_errors)

    def follow(self, change: Array) -> Array:
        """Twists ∂ξ for changes of machine parameters.

        Args:
            change: D changes of θ̂, shape (D, n_machine, 1).

        Returns:
            Shape (D, 1, n_twists), or (D, V, n_twists) if placements vary under V conditions.
        """
        delta = (self._twist_jacobian @ change).reshape(len(change), -1, 6, 1)
        result = np.asarray((self._right @ delta).reshape(len(change), 1, -1))
        varying = self._varying
        if varying is None:
            return result
        result = np.repeat(result, varying.right.shape[1], axis=1)
        delta = np.repeat((varying.constant @ change)[:, None], result.shape[1], axis=1)
        delta[:, :, varying.rows] += varying.by_errors @ (varying.unit_errors @ change)[:, None]
        xi = varying.right @ delta.reshape(*delta.shape[:2], -1, 6, 1)
        result[:, :, self._of_varying] = xi.reshape(*delta.shape[:2], -1)
        return result
