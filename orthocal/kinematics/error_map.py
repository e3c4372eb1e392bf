"""Placements and drive gains of a machine as functions of its error parameters.

A placement with errors is placement · exp6(δ). Its derivative by δ is a twist in its own frame,
exp6(δ) [T(δ) dδ], with T the right Jacobian of SE(3). All effects of errors on the kinematics pass
through these twists and through the drives' offsets and gains. `ErrorMap` computes them for NumPy
arrays with any leading batch dimensions, `SymbolicErrorMap` as CasADi expressions.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.kinematics.se3 import exp6, right_jacobian
from orthocal.kinematics.symbolic import Pose, nominal_frame_placement
from orthocal.robot.model import Robot
from orthocal.robot.parameters import ElementaryError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class MovedPlacement:
    """A joint or frame whose placement has error parameters."""

    index: int
    """Index of the joint or frame in the model."""
    of_frame: bool


class MachineGeometry(NamedTuple):
    """Geometry of one machine or of a batch of machines with errors."""

    placements: Array
    """Moved placements, shape (..., 12 n_moved), [1, m]."""
    offset: Array
    """Drive offsets, shape (..., n_drives), [m, rad]."""
    gain: Array
    """Drive gains, shape (..., n_drives)."""

    def drives(self, commanded: Array) -> Array:
        """Actual drive coordinates.

        Args:
            commanded: Shape (K, n_drives), or (n_drives,), [m, rad].

        Returns:
            Shape (..., K, n_drives): the machines' batch dimensions come first.
        """
        if commanded.ndim == 1 or self.gain.ndim == 1:
            return np.asarray(self.gain * commanded + self.offset)
        return np.asarray(self.gain[..., None, :] * commanded + self.offset[..., None, :])


@dataclass(frozen=True, slots=True, eq=False)
class ErrorJacobian:
    """Derivatives of placements and drives by n parameters."""

    twists: Array
    """∂ξ of every moved placement in its own frame, shape (..., 6 n_moved, n), [m, rad]."""
    offsets: Array
    """Derivative of the drives' offsets, shape (n_drives, n), [m, rad]."""
    gains: Array
    """Derivative of the drives' gains, shape (n_drives, n)."""


class ErrorMap:
    """The elementary errors of a robot in a fixed order, shape (..., n_errors), [m, rad, 1].

    Args:
        robot: The nominal robot.

    Attributes:
        names: Names of the errors.
        moved: Placements that have errors.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        elementary = tuple(robot.parameters.elementary.values())
        self.names = tuple(e.name for e in elementary)
        self._index = {name: i for i, name in enumerate(self.names)}
        drives = {d.name: i for i, d in enumerate(robot.drives)}
        moved: dict[MovedPlacement, int] = {}
        twist = np.full(len(elementary), -1)
        offset, scale = np.array(twist), np.array(twist)
        for i, e in enumerate(elementary):
            if e.kind == "offset":
                offset[i] = drives[e.owner]
            elif e.kind == "scale":
                scale[i] = drives[e.owner]
            else:
                place = moved.setdefault(_placement_of(robot, e), len(moved))
                twist[i] = 6 * place + e.axis
        self.moved = tuple(moved)
        self._twist, self._offset, self._scale = twist, offset, scale
        nominal = [
            nominal_frame_placement(robot.model, m.index)
            if m.of_frame
            else robot.model.jointPlacements[m.index]
            for m in self.moved
        ]
        self._rotations = np.array([p.rotation for p in nominal]).reshape(-1, 3, 3)
        self._positions = np.array([p.translation for p in nominal]).reshape(-1, 3)

    def expand(self, values: Mapping[str, float]) -> Array:
        """Elementary errors of named parameters, which may be sums, shape (n_errors,), [SI].

        Raises:
            ParameterError: If a name is unknown.
        """
        result = np.zeros(len(self.names))
        for name, value in self.robot.parameters.expand(values).items():
            result[self._index[name]] = value
        return result

    def columns(self, names: Sequence[str]) -> Array:
        """Elementary errors of one unit of each named parameter, shape (n_errors, n)."""
        result = np.zeros((len(self.names), len(names)))
        for column, name in enumerate(names):
            for term, coefficient in self.robot.parameters[name].terms:
                result[self._index[term], column] += coefficient
        return result

    def geometry(self, errors: ArrayLike) -> MachineGeometry:
        """Placements and drives of machines with errors, shape (..., n_errors), [SI]."""
        return MachineGeometry(self.placements(errors), self.offsets(errors), self.gains(errors))

    def placements(self, errors: ArrayLike) -> Array:
        """Moved placements: rotation by columns, then position.

        Args:
            errors: Shape (..., n_errors), [SI].

        Returns:
            Shape (..., 12 n_moved), [1, m].
        """
        rotation, position = exp6(self._twists(np.asarray(errors, dtype=np.float64)))
        rotations = self._rotations @ rotation
        positions = (self._rotations @ position[..., None])[..., 0] + self._positions
        columns = np.swapaxes(rotations, -1, -2).reshape(*rotations.shape[:-2], 9)
        values = np.concatenate([columns, positions], axis=-1)
        return values.reshape(*values.shape[:-2], -1)

    def offsets(self, errors: ArrayLike) -> Array:
        """Offsets of the drives, shape (..., n_drives), [m, rad]."""
        return self._of_drives(np.asarray(errors, dtype=np.float64), self._offset)

    def gains(self, errors: ArrayLike) -> Array:
        """Gains of the drives, 1 + scale error, shape (..., n_drives)."""
        return np.asarray(self.robot.drive_gain + self.scales(errors))

    def scales(self, errors: ArrayLike) -> Array:
        """Scale errors of the drives, shape (..., n_drives)."""
        return self._of_drives(np.asarray(errors, dtype=np.float64), self._scale)

    def jacobian(
        self, errors: ArrayLike, columns: Array, *, right: Array | None = None
    ) -> ErrorJacobian:
        """Derivatives of placements and drives by parameters.

        Args:
            errors: Point of differentiation, shape (..., n_errors), [SI].
            columns: Elementary errors of one unit of each parameter, shape (n_errors, n).
            right: `right_jacobians` there, if known.
        """
        right = self.right_jacobians(errors) if right is None else right
        n = columns.shape[1]
        twists = right @ self.twists_of(columns.T).T.reshape(len(self.moved), 6, n)
        twists = twists.reshape(*twists.shape[:-3], 6 * len(self.moved), n)
        return ErrorJacobian(twists, self.offsets(columns.T).T, self.scales(columns.T).T)

    def right_jacobians(self, errors: ArrayLike) -> Array:
        """Right Jacobian T(δ) of every moved placement, shape (..., n_moved, 6, 6)."""
        return right_jacobian(self._twists(np.asarray(errors, dtype=np.float64)))

    @property
    def nominal(self) -> Array:
        """Moved placements without errors: rotation by columns, position; (n_moved, 12)."""
        columns = np.swapaxes(self._rotations, 1, 2).reshape(-1, 9)
        return np.concatenate([columns, self._positions], axis=1)

    def twists_of(self, errors: ArrayLike) -> Array:
        """Twists δ of the moved placements, shape (..., 6 n_moved), [m, rad]."""
        values = np.asarray(errors, dtype=np.float64)
        result = np.zeros((*values.shape[:-1], 6 * len(self.moved)))
        chosen = self._twist >= 0
        result[..., self._twist[chosen]] = values[..., chosen]
        return result

    def _twists(self, errors: Array) -> Array:
        return self.twists_of(errors).reshape(*errors.shape[:-1], len(self.moved), 6)

    def _of_drives(self, errors: Array, index: Indices) -> Array:
        result = np.zeros((*errors.shape[:-1], len(self.robot.drives)))
        chosen = index >= 0
        result[..., index[chosen]] = errors[..., chosen]
        return result


@lru_cache(maxsize=8)
def error_map(robot: Robot) -> ErrorMap:
    """The error map of a robot, built once."""
    return ErrorMap(robot)


def _placement_of(robot: Robot, error: ElementaryError) -> MovedPlacement:
    if error.of_frame:
        return MovedPlacement(robot.frame_id(error.owner), True)
    return MovedPlacement(int(robot.model.getJointId(error.owner)), False)


class SymbolicErrorMap:
    """Placements and drives of a machine as expressions of scaled parameters θ̂.

    The choice of free parameters is a matrix of constants; the CasADi function of one placement is
    mapped over all of them.

    Args:
        errors: The robot's error map.
        fixed: Elementary errors at θ̂ = 0, shape (n_errors,), [SI].
        columns: Elementary errors of one unit of each θ̂, shape (n_errors, n_free).

    Attributes:
        placements: Symbol of the moved placements, shape (12 n_moved,).
        symbols: θ̂, placements and the nonzeros of ∂ξ/∂θ̂: the inputs of posture and reading
            functions.
        function: θ̂ to the values of the symbols.
        digest: Digest of the numbers that are constants here.
    """

    def __init__(self, errors: ErrorMap, *, fixed: Array, columns: Array) -> None:
        n_moved, n_free = len(errors.moved), columns.shape[1]
        self.digest = hashlib.sha256(fixed.tobytes() + columns.tobytes()).hexdigest()
        inner, base = errors.twists_of(columns.T).T, errors.twists_of(fixed)
        theta = ca.SX.sym("theta", n_free)
        twist_jacobian = ca.SX.sym("twist_jacobian", _twist_pattern(inner))
        self.placements = ca.SX.sym("placements", 12 * n_moved)
        self.symbols = (theta, self.placements, twist_jacobian.nz[:])
        self._twist_jacobian = twist_jacobian
        self._by_offset, self._by_gain = (
            ca.sparsify(ca.SX(m.T)) for m in (errors.offsets(columns.T), errors.scales(columns.T))
        )
        self._offset = ca.SX(errors.offsets(fixed)) + self._by_offset @ theta
        self._gain = ca.SX(errors.gains(fixed)) + self._by_gain @ theta

        at = ca.MX.sym("theta", n_free)
        twists = ca.DM(base) + ca.MX(ca.sparsify(ca.DM(inner))) @ at
        values, right = ca.MX(12, 0), ca.MX(36, 0)
        if n_moved:
            mapped = _moved_placement().map(n_moved)
            values, right = mapped(ca.reshape(twists, 6, n_moved), ca.DM(errors.nominal.T))
        nonzeros = _twist_nonzeros(inner, twist_jacobian.sparsity()) @ ca.vec(right)
        self.function = ca.Function(
            "error_map", [at], [at, ca.densify(ca.vec(values)), ca.densify(nonzeros)]
        )

    def actuated(self, commanded: ca.SX) -> ca.SX:
        """Actual drive coordinates, shape (n_drives,) of commanded ones, [m, rad]."""
        return self._gain * commanded + self._offset

    def chain(self, by_twists: ca.SX, by_actuated: ca.SX, commanded: ca.SX) -> ca.SX:
        """Derivative by θ̂ of rows with known derivatives by twists and actuated coordinates."""
        by_drives = self._by_offset + ca.diag(commanded) @ self._by_gain
        return by_twists @ self._twist_jacobian + by_actuated @ by_drives


def _twist_pattern(inner: Array) -> ca.Sparsity:
    """Pattern of ∂ξ/∂θ̂: T maps a translation to a translation, a rotation to both."""
    sizes = np.abs(inner).reshape(-1, 2, 3, inner.shape[1]).sum(axis=2)  # (moved, kind, n)
    rotates, any_motion = sizes[:, 1] > 0.0, sizes.sum(axis=1) > 0.0
    pattern = np.repeat(np.stack([any_motion, rotates], axis=1), 3, axis=1).reshape(inner.shape)
    columns, rows = np.nonzero(pattern.T)
    n_rows, n_columns = inner.shape
    return ca.Sparsity.triplet(n_rows, n_columns, rows.tolist(), columns.tolist())


def _twist_nonzeros(inner: Array, pattern: ca.Sparsity) -> ca.MX:
    """Linear map from all T, stacked, to the nonzeros of T · inner."""
    rows, columns = (np.array(v, dtype=np.int64) for v in pattern.get_triplet())
    block, row = rows // 6, rows % 6
    weights = inner.reshape(-1, 6, inner.shape[1])[block, :, columns]  # (nnz, 6)
    place = 36 * block[:, None] + 6 * np.arange(6)[None, :] + row[:, None]
    nonzero, axis = np.nonzero(weights)
    target = place[nonzero, axis]
    order = np.lexsort((nonzero, target))  # compressed columns
    triplet = ca.Sparsity.triplet(rows.size, 6 * inner.shape[0], nonzero.tolist(), target.tolist())
    return ca.MX(ca.DM(triplet, weights[nonzero, axis][order].tolist()))


@lru_cache(maxsize=1)
def _moved_placement() -> ca.Function:
    """(twist, nominal placement) to placement · exp6(twist) and T, both by columns."""
    twist, nominal = ca.SX.sym("twist", 6), ca.SX.sym("nominal", 12)
    pose = Pose(ca.reshape(nominal[:9], 3, 3), nominal[9:]) * Pose(*exp6(twist))
    values = ca.vertcat(ca.vec(pose.rotation), pose.position)
    right = ca.densify(ca.vec(right_jacobian(twist)))
    return ca.Function("moved_placement", [twist, nominal], [values, right])
