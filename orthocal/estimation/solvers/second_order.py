"""Readings to second order in many parameters: the curvature that many machines share.

To first order one Jacobian serves all machines of a plan, and solves none of them: readings tell
some sums of errors a thousand times better than others, so that a change of the Jacobian by a
hundredth couples the two. To second order what is left is a hundredth of that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.solvers.batch_adjoint import FleetSlopes
from orthocal.observation.expansion import Expansion
from orthocal.runtime.worker_pool import call_in_parallel, current_worker_budget

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

STEP = 0.01
"""Over which slopes are compared, [tolerances]."""

MOST_BYTES = 2**28
"""Of the curvature; problems with more than that are solved one by one."""


@dataclass(frozen=True, slots=True, eq=False)
class CurvedReadings:
    """Readings about the reference of a problem."""

    reference: Array
    """θ̂ there, shape (n_free,)."""
    reading: Array
    """Shape (n_entries,), [m of the first gauge]."""
    jacobian: Array
    """Shape (n_entries, n_free), [m per tolerance]."""
    curvature: NDArray[np.float32]
    """d²h/dθ̂² at [k, j n_free + i] of entry j, shape (n_free, n_entries n_free)."""

    machine: FleetSlopes
    """The one there."""

    def __call__(self, theta: Array) -> tuple[Array, Array]:
        """Readings and slopes, shape (n_sets, n_entries[, n_free]), of θ̂, (n_sets, n_free)."""
        change = theta - self.reference
        curved = (change.astype(np.float32) @ self.curvature).reshape(-1, *self.jacobian.shape)
        slopes = self.jacobian + 0.5 * curved
        reading = self.reading + (slopes @ change[..., None])[..., 0]
        return reading, slopes + 0.5 * curved


def find_curvature(problem: CalibrationProblem) -> CurvedReadings | None:
    """Readings to second order, by differences of slopes.

    None where that takes too much memory, or the machine is singular in a posture near the
    reference.
    """
    if 4 * problem.n_free**2 * problem.observations.size > MOST_BYTES:
        return None
    try:
        return _find_curvature(problem)
    except np.linalg.LinAlgError:
        return None


def _find_curvature(problem: CalibrationProblem) -> CurvedReadings:
    n, m = problem.n_free, problem.observations.size
    about = problem.expand(problem.reference, problem.reference_passive)
    parts = np.array_split(np.arange(n), current_worker_budget())
    found = call_in_parallel([partial(_differences, problem, about, part) for part in parts])
    curvature = np.concatenate(found)
    for k in range(n):  # by either parameter first
        half = 0.5 * (curvature[k, :, k:] + curvature[k:, :, k].T)
        curvature[k, :, k:], curvature[k:, :, k] = half, half.T
    there = problem.reference / problem.theta_scale
    return CurvedReadings(
        reference=there,
        reading=about.reading + about.opening,
        jacobian=about.jacobian,
        curvature=curvature.reshape(n, m * n),
        machine=FleetSlopes(problem, there[None], problem.reference_passive[None]),
    )


def _differences(
    problem: CalibrationProblem, about: Expansion, parts: Indices
) -> NDArray[np.float32]:
    """How slopes change with some parameters, shape (n_parts, n_entries, n_free)."""
    moves, scale = STEP * np.eye(problem.n_free), problem.theta_scale
    result = np.empty((len(parts), *about.jacobian.shape), dtype=np.float32)
    for change, moved in zip(result, moves[parts], strict=True):
        passive = problem.reference_passive + about.follow(moved)
        found = problem.expand(problem.reference + moved * scale, passive)
        change[...] = (found.jacobian - about.jacobian) / STEP
    return result
