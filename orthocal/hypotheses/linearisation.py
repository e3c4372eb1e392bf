"""Linearised model of a session about one machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array, Mask
from orthocal.hypotheses.hypothesis import MachineShift
from orthocal.hypotheses.likelihood import Likelihood
from orthocal.statistics.distributions import (
    log_positive_share,
    log_positive_share_of_independent,
)


@dataclass(frozen=True, slots=True, eq=False)
class ModelLinearisation:
    """Linearised model about one machine, gauge zeros projected out.

    The machine of some readings may differ by known errors (`shifts`).
    """

    expected: Array
    """Predictions for the reference machine, to first order, shape (n_entries,), [m]."""
    jacobian: Array
    """Jacobian ∂h per prior std of each error, shape (n_entries, n_free), [m]; shape (n_entries, 0)
    if not requested."""
    complete_jacobian: Array
    """The Jacobian before the gauge zeros are projected out, of the same shape, [m]."""
    likelihood: Likelihood
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
        e2, likelihood = tolerance_scale**2, self.likelihood
        sizes = likelihood.singular_values
        variance = e2 * sizes**2 + (noise_scale * likelihood.sigma) ** 2
        along = likelihood.directions @ deviation
        return np.asarray(likelihood.errors @ (e2 * sizes / variance * along))

    def log_positive_share(
        self,
        deviation: Array,
        positive: Mask,
        reference: Array,
        *,
        tolerance_scale: float,
        noise_scale: float,
    ) -> float:
        """Gain of the log likelihood by truncated instead of normal priors.

        The gain is ln P(θ₊ > 0 | y) − ln P(θ₊ > 0) for the errors θ₊ that are never negative. For
        a reference of 0 the priors are half-normal, and P(θ₊ > 0) = 2⁻ᵏ for k errors.

        Args:
            deviation: Readings minus predictions, shape (n_entries,), zeros projected out, [m].
            positive: Mask of the errors that are never negative, shape (n_free,).
            reference: Errors of the reference, shape (n_free,), [prior std].
            tolerance_scale: Tolerance scale e.
            noise_scale: Noise scale s.
        """
        scales = {"tolerance_scale": tolerance_scale, "noise_scale": noise_scale}
        prior_mean = reference[positive]
        mean = prior_mean + self.errors_for(deviation, **scales)[positive]
        resolved = tolerance_scale**2 * self.likelihood.variances
        resolved /= resolved + (noise_scale * self.likelihood.sigma) ** 2
        rows = self.likelihood.errors[positive]
        prior = tolerance_scale**2 * np.eye(len(rows))
        covariance = prior - tolerance_scale**2 * (rows * resolved @ rows.T)
        prior_share = log_positive_share_of_independent(prior_mean, tolerance_scale)
        return log_positive_share(mean, covariance) - prior_share


@dataclass(frozen=True, slots=True, eq=False)
class LinearisationPoint:
    """Machine about which the model is linearised."""

    theta: Array
    """Errors minus those of the reference, shape (n_free,), [prior std]."""
    shifts: Sequence[MachineShift]
    """Known differences of the machine in some of the readings."""
    start: Array
    """Passive coordinates to start from, shape (n_states, n_passive), [m, rad]."""
