"""Marginal likelihood of the readings of a machine with normally distributed errors.

    y = h(θ) + z + n,  h(θ) ≈ h(θ₁) + J (θ − θ₁),  θ ~ N(θ₀, e² P),  n ~ N(0, s² σ²),  z flat

with all errors of the machine and all nuisance parameters of its sensors in θ. The likelihood is
summed over grids of the tolerance scale e and the noise scale s. The covariance e² J P Jᵀ + s² σ²
has the same r principal directions for all e and s. So any number of corrected readings is scored
by products with these directions.

An effect of unknown amount, b w with b ~ N(0, τ²), is integrated over b in closed form and averaged
over a grid of τ. Rows without information are removed from all vectors (`restricted`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from orthocal.arrays import Array, Mask

SCALE_NODES = np.geomspace(0.1, 16.0, 9)
"""Tolerance scales e over which the likelihood is summed."""

TOLERANCE_SCALE_SPREAD = 0.5
"""Prior standard deviation of ln e."""

NOISE_SCALES = np.geomspace(0.25, 32.0, 15)
"""Grid of the noise scale s."""

STATED_NOISE_SPREAD = 0.25
"""Prior standard deviation of ln s if the gauge's noise is stated."""

UNSTATED_NOISE_SPREAD = 1.5
"""Prior standard deviation of ln s if the gauge's noise is not stated, or wrongly stated."""

WRONG_NOISE_PROBABILITY = 0.05
"""Prior probability that the stated noise is wrong."""

AMOUNT_STDS = np.geomspace(6.0, 6000.0, 4)
"""Grid of the standard deviation τ of an effect's amount, relative to the noise of its gauge."""

MIN_RELATIVE_SINGULAR_VALUE = 1e-9
"""Singular values up to this, relative to the largest, count as 0."""

LARGEST_AMOUNT = 1e9
"""Standard deviation of the amount of an effect without influence on the entries, relative to the
noise."""

MIN_PROBABILITY = 1e-300
"""Lower bound of a probability before its logarithm is taken."""

MAX_SEPARATE_GROUPS = 2
"""Most groups of effects with separate τ; more groups share one τ."""


@dataclass(frozen=True, slots=True, eq=False)
class Products:
    """Inner products of vectors over the entries, gauge zeros projected out."""

    along: Array
    """Components along the principal directions, shape (h, r), [m]."""
    square: Array
    """Squared norms, shape (h,), [m²]."""


@dataclass(frozen=True, slots=True, eq=False)
class AmountPrior:
    """Prior of the amounts of a group of effects, per unit."""

    stds: Array
    """Grid of their common standard deviation τ, shape (t,)."""
    positive: Mask
    """Mask of amounts that are never negative (half-normal), shape (k,)."""


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Marginal likelihood of one hypothesis, and its most likely scales and amounts."""

    log_likelihood: float
    tolerance_scale: float
    noise_scale: float
    amounts: Array
    """Amounts of all effects, shape (k,), [m]."""
    stds: Array
    """Standard deviations of the amounts, shape (k,), [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Likelihood:
    """Marginal likelihood about one linearisation."""

    directions: Array
    """Orthonormal principal directions of the entries, shape (r, n_entries)."""
    errors: Array
    """Errors of the machine per principal direction, shape (n_free, r), [prior std]."""
    singular_values: Array
    """Prior standard deviation along each direction at tolerance scale 1, shape (r,), [m]."""
    sigma: float
    """Stated standard deviation of a reading, [m]."""
    dof: int
    """Number of entries minus number of gauge zeros."""
    weights: Array
    """Logarithms of the prior weights of all pairs (e, s), shape (g,)."""

    @property
    def variances(self) -> Array:
        """Prior variance along each direction at tolerance scale 1, shape (r,), [m²]."""
        return np.asarray(self.singular_values**2)

    def grid(
        self, tolerance_scales: Array = SCALE_NODES, noise_scales: Array = NOISE_SCALES
    ) -> tuple[Array, Array]:
        """Variances of all pairs (e, s), [m²]: of the noise, (g,), and along directions, (r, g)."""
        noise = np.tile((noise_scales * self.sigma) ** 2, tolerance_scales.size)
        scale = np.repeat(tolerance_scales**2, noise_scales.size)
        return noise, self.variances[:, None] * scale + noise

    def products(self, vectors: Array) -> Products:
        """Products of dense vectors (h, n_entries), zeros projected out, [m]."""
        return Products(vectors @ self.directions.T, (vectors**2).sum(axis=1))

    def misfit(self, deviation: Array) -> float:
        """Misfit dᵀ V⁻¹ d of a deviation (n_entries,), [m], with tolerances and noise as stated."""
        along = self.directions @ deviation
        perpendicular = max(float(deviation @ deviation - along @ along), 0.0)
        noise = self.sigma**2
        return float((along**2 / (self.variances + noise)).sum()) + perpendicular / noise

    def estimate_amounts(self, deviation: Array, effects: Array) -> tuple[Array, Array]:
        """Generalised least-squares estimate of the amount of each effect alone, without prior.

        Tolerances and noise are as stated.

        Args:
            deviation: Readings minus predictions, shape (n_entries,), zeros projected out, [m].
            effects: Effects per unit, shape (h, n_entries), zeros projected out.

        Returns:
            The amounts and their standard deviations, shape (h,); 0 and infinity for an effect
            without influence on the entries.
        """
        (gram,), (slope,) = self._gram(deviation, effects, np.ones(1), np.ones(1))
        information = np.maximum(np.diag(gram), 0.0)
        positive = np.where(information > 0.0, information, np.inf)
        return slope / positive, np.where(information > 0.0, positive**-0.5, np.inf)

    def score(
        self, deviations: Products, effects: Products | None = None, cross: Array | None = None
    ) -> Array:
        """Logarithm of the marginal likelihood of many hypotheses, up to a common constant.

        Args:
            deviations: Products of readings minus predictions of each hypothesis.
            effects: Products of the effect of each hypothesis per unit of its unknown amount.
            cross: Inner products of effect and deviation, shape (h,), [m²].

        Returns:
            Shape (h,).
        """
        logs = self.log_densities(deviations)
        if effects is not None and cross is not None:
            noise, variance = self.grid()
            inverse = 1.0 / variance
            perpendicular = np.maximum(effects.square - (effects.along**2).sum(axis=1), 0.0)
            cross_perpendicular = cross - (effects.along * deviations.along).sum(axis=1)
            information = effects.along**2 @ inverse + perpendicular[:, None] / noise
            slope = (effects.along * deviations.along) @ inverse
            slope += cross_perpendicular[:, None] / noise
            logs = logs + self._gain(information, slope)
        return np.asarray(log_of_sum(logs + self.weights, axis=1))

    def _gain(self, information: Array, slope: Array) -> Array:
        """Gain of log likelihood by an amount with normal prior, averaged over τ, shape (h, g).

        Args:
            information: wᵀ V⁻¹ w, shape (h, g).
            slope: wᵀ V⁻¹ d, shape (h, g).
        """
        gains = []
        for tau in (AMOUNT_STDS * self.sigma) ** 2:
            widened = 1.0 + tau * information
            gains.append(0.5 * (tau * slope**2 / widened - np.log(widened)))
        return np.asarray(log_of_sum(np.array(gains), axis=0) - np.log(AMOUNT_STDS.size))

    def log_densities(
        self,
        deviations: Products,
        tolerance_scales: Array = SCALE_NODES,
        noise_scales: Array = NOISE_SCALES,
    ) -> Array:
        """Logarithms of the normal densities at all pairs (e, s), up to a constant, (h, g)."""
        noise, variance = self.grid(tolerance_scales, noise_scales)
        perpendicular = np.maximum(deviations.square - (deviations.along**2).sum(axis=1), 0.0)
        squares = deviations.along**2 @ (1.0 / variance) + perpendicular[:, None] / noise
        logs = -0.5 * (squares + np.log(variance).sum(axis=0))
        return np.asarray(logs - 0.5 * max(self.dof - len(variance), 0) * np.log(noise))

    def score_set(
        self,
        deviation: Array,
        groups: Sequence[Array] = (),
        *,
        priors: Sequence[AmountPrior | None] = (),
    ) -> Score:
        """Marginal likelihood of one deviation with any number of effects.

        Args:
            deviation: Readings minus predictions, shape (n_entries,), zeros projected out, [m].
            groups: Effects per unit, zeros projected out, (k, n_entries) each; the amounts of a
                group share one prior standard deviation τ.
            priors: Prior of the amounts of each group; None for a normal prior with τ on the grid
                AMOUNT_STDS.
        """
        logs = self.log_densities(self.products(deviation[None]))[0] + self.weights
        sizes = [len(g) for g in groups]
        if not sum(sizes):
            return self._best(logs, np.zeros((logs.size, 0)), np.zeros((logs.size, 0, 0)))
        vectors = np.concatenate(list(groups))
        gram, slope = self._gram(deviation, vectors)
        group_priors = list(priors) or [None] * len(groups)
        grid = _grid_of_stds(
            [AMOUNT_STDS * self.sigma if p is None else p.stds for p in group_priors]
        )
        positive_by_group = [
            np.zeros(k, bool) if p is None else p.positive
            for p, k in zip(group_priors, sizes, strict=True)
        ]
        precision = np.repeat(np.array(grid) ** -2.0, sizes, axis=1)
        gains = _integrate_amounts(gram, slope, precision, np.concatenate(positive_by_group))
        evidence = logs + log_of_sum(gains, axis=0) - np.log(len(grid))
        # an effect without influence on the entries has the amount 0 and a huge standard deviation
        floor = 1e-12 * np.trace(gram, axis1=1, axis2=2) + (LARGEST_AMOUNT * self.sigma) ** -2
        gram = gram + floor[:, None, None] * np.eye(len(vectors))
        likeliest_stds = grid[int(np.argmax(log_of_sum(logs + gains, axis=1)))]
        given_precision = [
            t**-2.0 if p else 0.0 for p, t in zip(group_priors, likeliest_stds, strict=True)
        ]
        gram = gram + np.diag(np.repeat(given_precision, sizes))
        return self._best(evidence, np.linalg.solve(gram, slope[..., None])[..., 0], gram)

    def restricted(self, restrict: Callable[[Array], Array], n_silent: int) -> Likelihood:
        """Likelihood of the entries with information.

        Args:
            restrict: Orthogonal projection of vectors, shape (h, n_entries), onto those without the
                silent entries and without zeros.
            n_silent: Number of silent entries.
        """
        jacobian = restrict(self.singular_values[:, None] * self.directions).T
        dof = self.dof - n_silent
        other = build_likelihood(jacobian, sigma=self.sigma, dof=dof, stated=True)
        return replace(other, weights=self.weights)

    def predict(self, deviation: Array, restricted: Likelihood, score: Score) -> Array:
        """Expected deviation of all entries by that of the entries with information, (n_entries,).

        With the restricted covariance V' it is V V'⁻¹ d, at the most likely scales.

        Args:
            deviation: Restricted deviation d without effects, shape (n_entries,), [m].
            restricted: The restricted likelihood.
            score: Its score.
        """
        scales = np.array([score.tolerance_scale]), np.array([score.noise_scale])
        noise, variance = self.grid(*scales)
        directions = restricted.directions
        along = directions @ deviation
        weights = 1.0 / restricted.grid(*scales)[1][:, 0] - 1.0 / noise
        weighted = deviation / noise + (weights * along) @ directions
        return np.asarray(
            noise * weighted
            + ((variance[:, 0] - noise) * (self.directions @ weighted)) @ self.directions
        )

    def _best(self, logs: Array, amounts: Array, gram: Array) -> Score:
        """Score with the amounts of the most likely pair (e, s).

        Their standard deviations are averaged over all pairs, because both scales are uncertain.

        Args:
            logs: Log evidence at each pair, shape (g,).
            amounts: Estimated amounts, shape (g, k).
            gram: Information matrix of the amounts, shape (g, k, k).
        """
        best = int(np.argmax(logs))
        e, s = divmod(best, NOISE_SCALES.size)
        total = log_of_sum(logs)
        probability = np.exp(logs - total)[:, None]
        variances = np.diagonal(np.linalg.inv(gram), axis1=1, axis2=2)
        spread = variances + (amounts - amounts[best]) ** 2
        return Score(
            float(total),
            float(SCALE_NODES[e]),
            float(NOISE_SCALES[s]),
            amounts[best],
            np.sqrt((probability * spread).sum(axis=0)),
        )

    def _gram(
        self,
        deviation: Array,
        vectors: Array,
        tolerance_scales: Array = SCALE_NODES,
        noise_scales: Array = NOISE_SCALES,
    ) -> tuple[Array, Array]:
        """Information W V⁻¹ Wᵀ, shape (g, k, k), and slope W V⁻¹ d, shape (g, k), at all (e, s).

        Args:
            deviation: Deviation d, shape (n_entries,).
            vectors: Effects W, shape (k, n_entries).
            tolerance_scales: Grid of e.
            noise_scales: Grid of s.
        """
        inverse_noise, inverse = (1.0 / v for v in self.grid(tolerance_scales, noise_scales))
        along, components = self.directions @ deviation, vectors @ self.directions.T
        perpendicular = vectors - components @ self.directions
        gram = np.einsum("kr,rg,lr->gkl", components, inverse, components)
        gram += inverse_noise[:, None, None] * (perpendicular @ perpendicular.T)
        slope = (
            (components * along) @ inverse + np.outer(perpendicular @ deviation, inverse_noise)
        ).T
        return gram, np.asarray(slope)


def _grid_of_stds(stds: Sequence[Array]) -> list[tuple[float, ...]]:
    """Grid of the standard deviations of all groups.

    It has all combinations for at most MAX_SEPARATE_GROUPS groups. Otherwise all groups move along
    their grids together.
    """
    if len(stds) <= MAX_SEPARATE_GROUPS:
        return list(product(*(s.tolist() for s in stds)))
    longest = max(s.size for s in stds)
    return [tuple(float(s[i % s.size]) for s in stds) for i in range(longest)]


def _integrate_amounts(gram: Array, slope: Array, precision: Array, positive: Mask) -> Array:
    """Gain of log likelihood by amounts with normal or half-normal priors, shape (t, g).

    A half-normal amount a ≥ 0 with posterior N(m, s²) adds ln 2 Φ(m/s). Several amounts are treated
    as independent, which is much faster than their joint probability
    (`statistics.distributions.log_positive_share`). The correlation of the backlashes of three
    drives is 0.02 (66 readings) to 0.12 (the plan of `orthocal new`). This makes the log evidence
    wrong by up to 0.17 with backlash and 0.4 without; the limit CLEAR_EFFECT_LOG_BAYES is 4.5. It
    changes the judgement of none of 240 simulated machines.

    Args:
        gram: W V⁻¹ Wᵀ, shape (g, k, k).
        slope: W V⁻¹ d, shape (g, k).
        precision: Inverse prior variances of t sets of priors, 0 for a flat one, shape (t, k).
        positive: Mask of half-normal priors, shape (k,).
    """
    full = gram + precision[:, None, :, None] * np.eye(precision.shape[1])
    right = np.broadcast_to(slope[..., None], (*full.shape[:3], 1))
    solution = np.linalg.solve(full, right)[..., 0]
    gain = 0.5 * ((slope * solution).sum(axis=-1) - np.linalg.slogdet(full)[1])
    gain += 0.5 * np.log(np.where(precision > 0.0, precision, 1.0)).sum(axis=1)[:, None]
    if positive.any():
        stds = np.sqrt(np.diagonal(np.linalg.inv(full), axis1=-2, axis2=-1))
        ratio = (solution / stds)[..., positive]
        doubled = [math.erfc(-r / math.sqrt(2.0)) for r in ratio.ravel().tolist()]
        gain += np.log(np.maximum(doubled, MIN_PROBABILITY)).reshape(ratio.shape).sum(axis=-1)
    return np.asarray(gain)


def log_of_sum(logs: Array, axis: int | None = None) -> Array:
    """Logarithm of the sum of numbers from their logarithms."""
    top = logs.max(axis=axis, keepdims=True)
    total = np.log(np.exp(logs - top).sum(axis=axis, keepdims=True)) + top
    return np.asarray(total.squeeze(axis))


def build_likelihood(jacobian: Array, *, sigma: float, dof: int, stated: bool) -> Likelihood:
    """Likelihood of a linearised model.

    Args:
        jacobian: ∂h per prior std of each error, zeros projected out, (n_entries, n_free), [m].
        sigma: Standard deviation of a reading, [m].
        dof: Number of entries minus number of gauge zeros.
        stated: Whether `sigma` is stated in the session.
    """
    basis, factor = None, jacobian
    if len(jacobian) > 2 * jacobian.shape[1]:  # a tall matrix: decompose its triangular factor
        basis, factor = np.linalg.qr(jacobian)
    vectors, singular_values, errors = np.linalg.svd(factor, full_matrices=False)
    significant = singular_values > MIN_RELATIVE_SINGULAR_VALUE * max(
        float(singular_values.max(initial=0.0)), sigma
    )
    vectors = vectors[:, significant]
    directions = (vectors if basis is None else basis @ vectors).T
    scale = log_normal(SCALE_NODES, TOLERANCE_SCALE_SPREAD)
    noise = noise_weights(stated=stated)
    weights = np.repeat(scale, NOISE_SCALES.size)
    return Likelihood(
        np.ascontiguousarray(directions),
        errors[significant].T,
        singular_values[significant],
        sigma,
        dof,
        weights + np.tile(noise, SCALE_NODES.size),
    )


def noise_weights(*, stated: bool) -> Array:
    """Log prior weights of NOISE_SCALES, shape (n_scales,).

    Args:
        stated: Whether the standard deviation of a reading is stated.
    """
    noise = log_normal(NOISE_SCALES, UNSTATED_NOISE_SPREAD)
    if not stated:
        return noise
    stated_noise = np.log1p(-WRONG_NOISE_PROBABILITY) + log_normal(
        NOISE_SCALES, STATED_NOISE_SPREAD
    )
    return np.asarray(np.logaddexp(stated_noise, np.log(WRONG_NOISE_PROBABILITY) + noise))


def log_normal(values: Array, spread: float) -> Array:
    """Log weights of a grid under a normal prior of ln(value), normalised to a sum of 1."""
    logs = -0.5 * (np.log(values) / spread) ** 2
    return np.asarray(logs - log_of_sum(logs))
