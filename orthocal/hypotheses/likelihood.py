"""How likely readings are on a machine of which the tolerances alone are known.

    y = h(θ̂) + J (θ − θ̂) + z + n,  θ ~ N(θ₀, e² P),  n ~ N(0, s² σ²),  z flat

with all errors of the machine and all that is not known of its sensors in θ. How many times their
tolerances those are, e, and how many times what is stated of it the noise is, s, are known to a
factor only, and summed over. The covariance e² J P Jᵀ + s² σ² has the same directions for all e
and s, so that any number of edited readings is weighed by three products of matrices.

What is wrong with readings by an unknown amount, b d, is integrated over b ~ N(0, τ²) for a range
of τ: a likelihood again, which is the less the wider it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

EXCESSES = np.geomspace(0.1, 16.0, 9)
"""Times the tolerances that errors of the machine are tried at."""

EXCESS_SPREAD = 0.5
"""Standard deviation of the logarithm of how many times its tolerances a machine's errors are."""

NOISES = np.geomspace(0.25, 32.0, 15)
"""Times what is stated of it that the noise is tried at."""

NOISE_SPREAD = 0.25
"""Standard deviation of the logarithm of how many times what is stated of it the noise is."""

NOISE_UNKNOWN = 1.5
"""The same where nothing is stated; and of what is stated wrongly."""

STATED_WRONGLY = 0.05
"""Share of the sessions in which what is stated of the noise says next to nothing."""

AMOUNTS = np.geomspace(6.0, 6000.0, 4)
"""Standard deviations τ of what is wrong by an unknown amount, over the noise."""

LEAST = 1e-9
"""Singular values below this part of the largest one count as none."""


@dataclass(frozen=True, slots=True, eq=False)
class Likelihood:
    """What readings are like, zeros eliminated, about one linearisation."""

    directions: Array
    """Orthonormal rows that errors move readings along, shape (r, n)."""
    variances: Array
    """Of readings along each, with errors at their tolerances, shape (r,), [m²]."""
    sigma: float
    """Standard deviation of a reading as stated, [m]."""
    dof: int
    """Readings less zeros."""
    weights: Array
    """Logarithms of the weights of all pairs (e, s), shape (g,)."""

    @property
    def _noise(self) -> Array:
        """s² σ² of all pairs, shape (g,), [m²]."""
        return np.asarray(np.tile((NOISES * self.sigma) ** 2, EXCESSES.size))

    @property
    def _variance(self) -> Array:
        """Along each direction for all pairs, shape (r, g), [m²]."""
        excess = np.repeat(EXCESSES**2, NOISES.size)
        return np.asarray(self.variances[:, None] * excess + self._noise)

    def weigh(self, deviations: Array, wrong: Array | None = None) -> Array:
        """Logarithms of how likely readings are, up to a constant that all share.

        Args:
            deviations: Readings less those of the machine as expected, zeros eliminated, shape
                (h, n), [m].
            wrong: What each of them may be wrong by, up to an unknown amount, zeros eliminated,
                shape (h, n); zeros where nothing is.
        """
        logs, _ = self._weigh_pairs(deviations, wrong)
        return np.asarray(log_of_sum(logs + self.weights, axis=1))

    def settle(self, deviation: Array, wrong: Array | None = None) -> tuple[float, float, float]:
        """Most likely excess and noise, as multiples, and amount of what is wrong, [m]."""
        d = None if wrong is None else wrong[None]
        logs, amounts = self._weigh_pairs(deviation[None], d)
        best = int(np.argmax(logs[0] + self.weights))
        e, s = divmod(best, NOISES.size)
        return float(EXCESSES[e]), float(NOISES[s]), float(amounts[0, best])

    def weigh_without(self, deviation: Array, rows: Array) -> float:
        """Logarithm of how much likelier readings are where some of them may be anything.

        That is of the density of the others over that of all, [m^k] for k rows.

        Args:
            deviation: As above, shape (n,), [m].
            rows: What each of the k rows does to readings, zeros eliminated, shape (k, n).
        """
        known, square, slope = self._weigh_rows(deviation, rows)
        logs = 0.5 * (_quadratic(square, slope) - np.linalg.slogdet(square)[1])
        logs += 0.5 * len(rows) * np.log(2.0 * np.pi)
        return float(log_of_sum(known + logs) - log_of_sum(known))

    def weigh_loose(self, deviation: Array, rows: Array) -> tuple[float, Array]:
        """Logarithm of how likely readings are where each of some may be off by its own amount.

        Args:
            deviation: As above, shape (n,), [m].
            rows: What each of k unknown amounts does to readings, zeros eliminated, shape (k, n).

        Returns:
            That, as `weigh`; and the most likely amounts, shape (k,), [m].
        """
        known, square, slope = self._weigh_rows(deviation, rows)
        logs = []
        for amount in (AMOUNTS * self.sigma) ** 2:
            widened = np.eye(len(rows)) + amount * square
            gain = amount * _quadratic(widened, slope) - np.linalg.slogdet(widened)[1]
            logs.append(0.5 * gain)
        every = known + log_of_sum(np.array(logs), axis=0) - np.log(AMOUNTS.size)
        best = int(np.argmax(every))
        amounts = np.linalg.lstsq(square[best], slope[:, best], rcond=None)[0]
        return float(log_of_sum(every)), amounts

    def _weigh_rows(self, deviation: Array, rows: Array) -> tuple[Array, Array, Array]:
        """Readings, and what k rows D do to them, for all pairs (e, s).

        Returns:
            Logarithms of how likely they are as they are, shape (g,); Dᵀ V⁻¹ D, (g, k, k); and
            Dᵀ V⁻¹ y, (k, g).
        """
        (known,), _ = self._weigh_pairs(deviation[None], None)
        inverse, rest = 1.0 / self._variance, 1.0 / self._noise
        along, own = self.directions @ deviation, rows @ self.directions.T
        beside = rows - own @ self.directions
        square = np.einsum("kr,rg,lr->gkl", own, inverse, own)
        square += rest[:, None, None] * (beside @ beside.T)
        slope = (own * along) @ inverse + np.outer(beside @ deviation, rest)
        return np.asarray(known + self.weights), square, np.asarray(slope)

    def _weigh_pairs(self, deviations: Array, wrong: Array | None) -> tuple[Array, Array]:
        """Logarithms for all pairs, shape (h, g); and most likely amounts, shape (h, g)."""
        variance, noise = self._variance, self._noise
        inverse = 1.0 / variance
        along = deviations @ self.directions.T
        beside = np.maximum((deviations**2).sum(axis=1) - (along**2).sum(axis=1), 0.0)
        squares = along**2 @ inverse + beside[:, None] / noise
        logs = -0.5 * (squares + np.log(variance).sum(axis=0))
        logs -= 0.5 * max(self.dof - len(variance), 0) * np.log(noise)
        if wrong is None:
            return logs, np.zeros_like(logs)
        own = wrong @ self.directions.T
        square = np.maximum((wrong**2).sum(axis=1) - (own**2).sum(axis=1), 0.0)
        cross = (wrong * deviations).sum(axis=1) - (own * along).sum(axis=1)
        information = own**2 @ inverse + square[:, None] / noise
        slope = (own * along) @ inverse + cross[:, None] / noise
        amounts = (AMOUNTS * self.sigma) ** 2
        widened = 1.0 + amounts[:, None, None] * information
        gains = 0.5 * (amounts[:, None, None] * slope**2 / widened - np.log(widened))
        logs = logs + log_of_sum(gains, axis=0) - np.log(amounts.size)
        with np.errstate(divide="ignore", invalid="ignore"):
            return logs, np.nan_to_num(slope / information)


def log_of_sum(logs: Array, axis: int | None = None) -> Array:
    """Logarithm of the sum of numbers whose logarithms are given."""
    top = logs.max(axis=axis, keepdims=True)
    total = np.log(np.exp(logs - top).sum(axis=axis, keepdims=True)) + top
    return np.asarray(total.squeeze(axis))


def _quadratic(square: Array, slope: Array) -> Array:
    """bᵀ K⁻¹ b of all pairs, shape (g,), of K (g, k, k) and b (k, g)."""
    found = np.linalg.solve(square, slope.T[..., None])[..., 0]
    return np.asarray((slope.T * found).sum(axis=1))


def likelihood_of(
    slopes: Array, *, sigma: float, dof: int, stated: bool
) -> tuple[Likelihood, Array, Array]:
    """What readings are like about a linearisation; its errors along each direction, and sizes.

    Args:
        slopes: ∂h of one tolerance of each error, zeros eliminated, shape (n, p), [m].
        sigma: Standard deviation of a reading, [m].
        dof: Readings less zeros.
        stated: Whether anything is stated of that standard deviation.
    """
    errors, sizes, rows = np.linalg.svd(slopes.T, full_matrices=False)
    kept = sizes > LEAST * max(float(sizes.max(initial=0.0)), sigma)
    excess = -0.5 * (np.log(EXCESSES) / EXCESS_SPREAD) ** 2
    noise = noise_weights(stated=stated)
    weights = np.repeat(excess - log_of_sum(excess), NOISES.size)
    likelihood = Likelihood(
        rows[kept], sizes[kept] ** 2, sigma, dof, weights + np.tile(noise, EXCESSES.size)
    )
    return likelihood, errors[:, kept], sizes[kept]


def noise_weights(*, stated: bool) -> Array:
    """Logarithms of the prior weights of NOISES, shape (n_noises,).

    Args:
        stated: Whether the standard deviation of a reading is stated.
    """
    noise = _normal(NOISES, NOISE_UNKNOWN)
    if not stated:
        return noise
    known = np.log1p(-STATED_WRONGLY) + _normal(NOISES, NOISE_SPREAD)
    return np.asarray(np.logaddexp(known, np.log(STATED_WRONGLY) + noise))


def _normal(values: Array, spread: float) -> Array:
    logs = -0.5 * (np.log(values) / spread) ** 2
    return np.asarray(logs - log_of_sum(logs))
