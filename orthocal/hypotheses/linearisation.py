"""Linearised model of a session about one machine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array, Mask
from orthocal.hypotheses.hypothesis import MachineShift
from orthocal.hypotheses.likelihood import Likelihood
from orthocal.statistics.distributions import log_positive_share


@dataclass(frozen=True, slots=True, eq=False)
class ModelLinearisation:
    """Linearised model about one machine, gauge zeros projected out.

    The machine of each session may differ by known errors (`shifts`).
    """

    expected: Array
    """Predictions for the reference machine, to first order, shape (n_entries,), [m]."""
    jacobian: Array
    """Jacobian ∂h per prior std of each error, shape (n_entries, n_free), [m]; shape (n_entries, 0)
    if not requested."""
    likelihood: Likelihood
    error_directions: Array
    """Errors per principal direction, shape (n_free, r), [prior std]."""
    singular_values: Array
    """Singular values, shape (r,), [m]."""
    theta: Array
    """Errors at the point of linearisation minus those of the reference, (n_free,), [prior std]."""
    passive: Array
    """Passive coordinates at that point, shape (n_states, n_passive), [m, rad]."""

    def errors_for(
        self, deviation: Array, *, tolerance_scale: float = 1.0, noise_scale: float = 1.0
    ) -> Array:
        """Most likely errors for a deviation, shape (n_free,), [prior std].

        Args:
            deviation: Readings minus predictions, shape (n_entries,), zeros projected out, [m].
            tolerance_scale: Tolerance scale e.
            noise_scale: Noise scale s.
        """
        e2 = tolerance_scale**2
        variance = e2 * self.singular_values**2 + (noise_scale * self.likelihood.sigma) ** 2
        along = self.likelihood.directions @ deviation
        return np.asarray(self.error_directions @ (e2 * self.singular_values / variance * along))

    def log_positive_share(
        self, deviation: Array, positive: Mask, *, tolerance_scale: float, noise_scale: float
    ) -> float:
        """Gain of the log likelihood by half-normal instead of normal priors.

        The gain is ln 2ᵏ P(θ₊ > 0 | y) for the k errors θ₊ that are never negative. Their prior
        density is twice the normal density, and only the positive part of the posterior counts.

        Args:
            deviation: Readings minus predictions, shape (n_entries,), zeros projected out, [m].
            positive: Mask of the errors that are never negative, shape (n_free,).
            tolerance_scale: Tolerance scale e.
            noise_scale: Noise scale s.
        """
        scales = {"tolerance_scale": tolerance_scale, "noise_scale": noise_scale}
        mean = self.errors_for(deviation, **scales)[positive]
        resolved = tolerance_scale**2 * self.singular_values**2
        resolved /= resolved + (noise_scale * self.likelihood.sigma) ** 2
        rows = self.error_directions[positive]
        covariance = tolerance_scale**2 * (np.eye(len(rows)) - rows * resolved @ rows.T)
        return len(rows) * math.log(2.0) + log_positive_share(mean, covariance)


@dataclass(frozen=True, slots=True, eq=False)
class LinearisationPoint:
    """Machine about which the model is linearised."""

    theta: Array
    """Errors minus those of the reference, shape (n_free,), [prior std]."""
    shifts: Sequence[MachineShift]
    """Known differences of the machine in some of the sessions."""
    start: Array
    """Passive coordinates to start from, shape (n_states, n_passive), [m, rad]."""
