"""Combinations of unknown errors that contribute most to the tool error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array
from orthocal.assessment.calibrated_tool import error_covariance
from orthocal.assessment.tool_error import ToolAccuracy
from orthocal.calibration.calibration import Calibration

NOTABLE = 0.1
"""Prior standard deviations by which a parameter must be off to be named in a combination."""


@dataclass(frozen=True, slots=True, eq=False)
class RemainingError:
    """A combination of parameters that is not well known, and what it does at the tool."""

    rms: float
    """RMS over the workspace with shift and rotation removed, [m]."""
    parts: tuple[tuple[str, float], ...]
    """Parameters and by how many prior standard deviations each is off, the largest first."""


def find_remaining_errors(
    calibration: Calibration, accuracy: ToolAccuracy, *, count: int = 3
) -> tuple[RemainingError, ...]:
    """The combinations of errors that matter most at the tool after a calibration.

    Principal directions of what is not known of the parameters, weighed by the mean square that it
    makes at the tool with shift and rotation taken out; the largest first.
    """
    prior_stds = np.r_[[p.prior_std for p in calibration.free], calibration.unmodelled.prior_stds]
    return rank_errors(
        accuracy.align(accuracy.jacobian),
        error_covariance(calibration),
        weights=accuracy.workspace.weights,
        prior_stds=prior_stds,
        names=accuracy.names,
        count=count,
    )


def rank_errors(
    field: Array,
    covariance: Array,
    *,
    weights: Array,
    prior_stds: Array,
    names: Sequence[str],
    count: int,
) -> tuple[RemainingError, ...]:
    """The combinations of parameters that matter most at the tool, the largest first.

    Args:
        field: What the parameters do at the tool, shape (K, 3, n), [m per parameter unit].
        covariance: Of them, shape (n, n), [SI].
        weights: Of the points, shape (K,).
        prior_stds: Shape (n,), [SI].
        names: Of the parameters.
        count: Of combinations.
    """
    root = _square_root(covariance)
    effect = field @ root
    _, directions = np.linalg.eigh(np.einsum("k,kin,kim->nm", weights, effect, effect))
    errors = []
    for direction in directions.T[::-1][:count]:
        change = root @ direction
        moved = field @ change
        in_prior_stds = change / prior_stds
        order = np.argsort(-np.abs(in_prior_stds))
        lead = np.sign(in_prior_stds[order[0]]) or 1.0
        errors.append(
            RemainingError(
                rms=float(np.sqrt(weights @ (moved**2).sum(axis=1))),
                parts=tuple(
                    (names[i], float(lead * in_prior_stds[i]))
                    for i in order
                    if abs(in_prior_stds[i]) > NOTABLE
                ),
            )
        )
    return tuple(errors)


def _square_root(covariance: Array) -> Array:
    """A matrix whose product with its transpose is the covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
