"""Combinations of errors with the largest contributions to the tool error after a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array
from orthocal.assessment.tool_error import ToolAccuracy
from orthocal.calibration.calibration import Calibration
from orthocal.statistics.information import square_root

MIN_LISTED = 0.1
"""Smallest part of a parameter in a combination that is listed, in prior standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class RemainingError:
    """An uncertain combination of parameters and its effect on the tool."""

    rms: float
    """RMS tool error over the workspace after alignment, [m]."""
    parts: tuple[tuple[str, float], ...]
    """Parameters and their errors in prior standard deviations, the largest first."""


def find_remaining_errors(
    calibration: Calibration, accuracy: ToolAccuracy, *, count: int = 3
) -> tuple[RemainingError, ...]:
    """Combinations of errors with the largest contributions to the tool error after a calibration.

    They are the principal directions of the uncertainty of the tool after alignment.

    Args:
        calibration: The calibration.
        accuracy: Its tool errors.
        count: Number of combinations.
    """
    prior_stds = np.r_[[p.prior_std for p in calibration.free], calibration.unmodelled.prior_stds]
    return rank_errors(
        accuracy.align(accuracy.jacobian),
        calibration.error_covariances[0],
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
    """Combinations of parameters with the largest tool errors, the largest first.

    Args:
        field: Jacobian of the tool position, shape (K, 3, n), [m per parameter unit].
        covariance: Covariance of the parameters, shape (n, n), [SI].
        weights: Weights of the points, shape (K,).
        prior_stds: Prior standard deviations, shape (n,), [SI].
        names: Names of the parameters.
        count: Number of combinations.
    """
    root = square_root(covariance)
    effect = field @ root
    _, directions = np.linalg.eigh(np.einsum("k,kin,kim->nm", weights, effect, effect))
    errors = []
    for direction in directions.T[::-1][:count]:
        change = root @ direction
        displacement = field @ change
        in_prior_stds = change / prior_stds
        order = np.argsort(-np.abs(in_prior_stds))
        sign = np.sign(in_prior_stds[order[0]]) or 1.0
        errors.append(
            RemainingError(
                rms=float(np.sqrt(weights @ (displacement**2).sum(axis=1))),
                parts=tuple(
                    (names[i], float(sign * in_prior_stds[i]))
                    for i in order
                    if abs(in_prior_stds[i]) > MIN_LISTED
                ),
            )
        )
    return tuple(errors)
