"""What free parameters make of a machine, as expressions: for programs that CasADi differentiates.

`ErrorMap` says the same in numbers. A choice of free parameters is a matrix of constants here; the
one function that is built, of a single placement, is mapped over all of them.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocal.kinematics.error_map import ErrorMap
from orthocal.kinematics.symbolic import Pose, exp6

Array = NDArray[np.float64]


class MachineMap:
    """Placements and drives of a machine by scaled parameters θ̂.

    Args:
        errors: The robot's error map.
        fixed: Errors where θ̂ is 0, shape (n_errors,), [SI].
        columns: What one unit of each θ̂ adds to them, shape (n_errors, n_free).

    Attributes:
        placements: Symbol for the moved placements, shape (12 n_moved,).
        symbols: θ̂, placements and the nonzeros of their slopes: what pieces take as inputs.
        function: θ̂ to the values of the symbols.
        digest: Of the numbers that are constants here.
    """

    def __init__(self, errors: ErrorMap, *, fixed: Array, columns: Array) -> None:
        n_moved, n_free = len(errors.moved), columns.shape[1]
        self.digest = hashlib.sha256(fixed.tobytes() + columns.tobytes()).hexdigest()
        inner, base = errors.twists_of(columns.T).T, errors.twists_of(fixed)
        theta = ca.SX.sym("theta", n_free)
        slopes = ca.SX.sym("slopes", _slope_pattern(inner))
        self.placements = ca.SX.sym("placements", 12 * n_moved)
        self.symbols = (theta, self.placements, slopes.nz[:])
        self._slopes = slopes
        self._by_offset, self._by_gain = (
            ca.sparsify(ca.SX(m.T)) for m in (errors.offsets(columns.T), errors.scales(columns.T))
        )
        self._offset = ca.SX(errors.offsets(fixed)) + self._by_offset @ theta
        self._gain = ca.SX(errors.gains(fixed)) + self._by_gain @ theta

        at = ca.MX.sym("theta", n_free)
        twists = ca.DM(base) + ca.MX(ca.sparsify(ca.DM(inner))) @ at
        values, turned = ca.MX(12, 0), ca.MX(36, 0)
        if n_moved:
            moving = _moved_placement().map(n_moved)
            values, turned = moving(ca.reshape(twists, 6, n_moved), ca.DM(errors.nominal.T))
        nonzeros = _gather_slopes(inner, slopes.sparsity()) @ ca.vec(turned)
        self.function = ca.Function(
            "machine_map", [at], [at, ca.densify(ca.vec(values)), ca.densify(nonzeros)]
        )

    def actuated(self, commanded: ca.SX) -> ca.SX:
        """Where drives really are, shape (n_drives,) of commanded coordinates, [m, rad]."""
        return self._gain * commanded + self._offset

    def chain(self, by_twists: ca.SX, by_actuated: ca.SX, commanded: ca.SX) -> ca.SX:
        """∂ by θ̂ of rows whose ∂ by twists and by actuated coordinates is known."""
        by_drives = self._by_offset + ca.diag(commanded) @ self._by_gain
        return by_twists @ self._slopes + by_actuated @ by_drives


def _slope_pattern(inner: Array) -> ca.Sparsity:
    """Where ∂ξ/∂θ̂ can differ from 0: a shift stays a shift, a turn may become both."""
    sizes = np.abs(inner).reshape(-1, 2, 3, inner.shape[1]).sum(axis=2)  # (moved, kind, n)
    turns, either = sizes[:, 1] > 0.0, sizes.sum(axis=1) > 0.0
    pattern = np.repeat(np.stack([either, turns], axis=1), 3, axis=1).reshape(inner.shape)
    columns, rows = np.nonzero(pattern.T)
    n_rows, n_columns = inner.shape
    return ca.Sparsity.triplet(n_rows, n_columns, rows.tolist(), columns.tolist())


def _gather_slopes(inner: Array, pattern: ca.Sparsity) -> ca.MX:
    """Nonzeros of T · inner, block by block, as a linear map of all T."""
    rows, columns = (np.array(v, dtype=np.int64) for v in pattern.get_triplet())
    block, row = rows // 6, rows % 6
    weights = inner.reshape(-1, 6, inner.shape[1])[block, :, columns]  # (nnz, 6)
    place = 36 * block[:, None] + 6 * np.arange(6)[None, :] + row[:, None]
    nonzero, axis = np.nonzero(weights)
    target = place[nonzero, axis]
    order = np.lexsort((nonzero, target))  # of compressed columns
    triplet = ca.Sparsity.triplet(rows.size, 6 * inner.shape[0], nonzero.tolist(), target.tolist())
    return ca.MX(ca.DM(triplet, weights[nonzero, axis][order].tolist()))


@lru_cache(maxsize=1)
def _moved_placement() -> ca.Function:
    """(twist, nominal placement) to placement · exp6(twist) and its T, both by columns."""
    twist, nominal = ca.SX.sym("twist", 6), ca.SX.sym("nominal", 12)
    pose = Pose(ca.reshape(nominal[:9], 3, 3), nominal[9:]) * exp6(twist)
    values = ca.vertcat(ca.vec(pose.rotation), pose.position)
    return ca.Function(
        "moved_placement", [twist, nominal], [values, ca.densify(ca.vec(right_jacobian(twist)))]
    )


def right_jacobian(twist: ca.SX) -> ca.SX:
    """T with exp6(δ + dδ) = exp6(δ) exp6(T dδ) to first order, shape (6, 6)."""
    delta = ca.SX.sym("delta", 6)
    pose = exp6(delta)
    by_position = pose.rotation.T @ ca.jacobian(pose.position, delta)
    columns = ca.jacobian(ca.vec(pose.rotation), delta)
    turned = [ca.inv_skew(pose.rotation.T @ ca.reshape(columns[:, k], 3, 3)) for k in range(6)]
    result = ca.vertcat(by_position, ca.horzcat(*turned))
    return ca.Function("right_jacobian", [delta], [result])(twist)
