"""Search over all pairs of hypotheses: two anomalies may hide each other from single hypotheses.

Two edits Δ_a, Δ_b of a deviation d have the misfit |d + Δ_a + Δ_b|². The gain by an effect w of
unknown amount depends on its slope w·x, with x the edited deviation, and its information w·w. All
inner products are weighted by the inverse covariance of the entries, x·y = xᵀ V(e, s)⁻¹ y, for each
pair (e, s) of scales.

All pairs are scored at the best scales of a coarse grid, then the most likely pairs on the full
grid.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np
from numpy.typing import NDArray

from orthocal.arrays import Array, Indices
from orthocal.hypotheses.likelihood import AMOUNT_STDS, NOISE_SCALES, Likelihood, log_of_sum

COARSE_TOLERANCE_PLACES = (2, 3, 4, 5, 6)
"""Indices of the coarse grid in the grid of tolerance scales."""

COARSE_NOISE_PLACES = (3, 4, 5, 7, 10)
"""Indices of the coarse grid in the grid of noise scales."""

MAX_REFINED = 300
"""Most pairs that are scored on the full grid."""

BLOCK_SIZE = 128
"""Hypotheses whose pairs are scored at once, to limit the memory."""


@dataclass(frozen=True, slots=True, eq=False)
class Singles:
    """Single hypotheses of a small session as dense arrays: edits first, then effects."""

    edits: Array
    """Changes of the entries, zeros projected out, shape (n_edits, n_entries), [m]."""
    effects: Array
    """Effects per unit of an unknown amount, shape (n_effects, n_entries)."""
    prior: Array
    """Logarithms of their prior probabilities with volume factors, (n_edits + n_effects,)."""
    changed_rows: NDArray[np.bool_]
    """Mask of rows that each hypothesis changes, shape (n_edits + n_effects, n_rows)."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """The most likely pairs of hypotheses, the most likely one first."""

    members: Indices
    """Indices of both single hypotheses, shape (m, 2)."""
    log_posterior: Array
    """Logarithms of marginal likelihood times prior probability, shape (m,)."""


class _Scaled:
    """Deviation, edits and effects at one pair (e, s), in coordinates in which V is the identity.

    Args:
        likelihood: The likelihood.
        vectors: Deviation (n_entries,), edits (n_edits, n_entries), effects (n_effects, n_entries),
            in a basis that begins with the principal directions.
        grid: Variances of `Likelihood.grid`.
        g: Index of the pair (e, s).
    """

    def __init__(
        self, likelihood: Likelihood, vectors: Sequence[Array], grid: tuple[Array, Array], g: int
    ) -> None:
        noise, variance = (v[..., g] for v in grid)
        scale = np.full(vectors[0].shape[-1], 1.0 / np.sqrt(noise))
        scale[: variance.size] = 1.0 / np.sqrt(variance)
        self.vectors = tuple(v * scale for v in vectors)
        logs = np.log(variance).sum() + max(likelihood.dof - len(variance), 0) * np.log(noise)
        self.largest = float(likelihood.weights[g] - 0.5 * logs)
        """Log marginal likelihood of a deviation of 0, the upper bound of all pairs."""

    @cached_property
    def _second_edits(self) -> Array:
        """Edits e, 1 and -|e|²/2: their products with (x, c, 1) are c + x·e - |e|²/2."""
        edits = self.vectors[1]
        return np.column_stack([edits, np.ones(len(edits)), -0.5 * (edits**2).sum(axis=1)])

    @cached_property
    def _information(self) -> Array:
        """Information of each effect, shape (n_effects,)."""
        return np.asarray((self.vectors[2] ** 2).sum(axis=1))

    def score_edits(self, block: slice, taus: Array) -> Array:
        """Log likelihoods of a block of edits, paired with these and later edits and all effects.

        Args:
            block: The edits.
            taus: Grid of τ², shape (t,).
        """
        deviation, edits, effects = self.vectors
        changed, later = deviation + edits[block], self._second_edits[block.start :]
        level = self.largest - 0.5 * (changed**2).sum(axis=1)
        score = np.empty((len(changed), len(later) + len(effects)))
        first = np.column_stack([-changed, level, np.ones(len(changed))])
        np.matmul(first, later.T, out=score[:, : len(later)])
        square, gain = (changed @ effects.T) ** 2, score[:, len(later) :]
        gain[...] = -np.inf
        for tau in taus:
            widened = 1.0 + tau * self._information
            np.maximum(gain, square * (0.5 * tau / widened) - 0.5 * np.log(widened), out=gain)
        gain += level[:, None] - np.log(taus.size)
        return score

    def score_effects(self, block: slice, taus: Array) -> Array:
        """Log likelihoods of a block of effects, paired with these and later effects.

        Args:
            block: The effects.
            taus: Grid of τ², shape (t,).
        """
        deviation, _, effects = self.vectors
        later = slice(block.start, None)
        information, slope = self._information, effects @ deviation
        forms = (
            *(information[block, None], information[later], effects[block] @ effects[later].T),
            *(slope[block, None], slope[later]),
        )
        gain = _largest(_gain(tau, *forms) for tau in taus)
        return np.asarray(gain - np.log(taus.size) + self.largest - 0.5 * (deviation @ deviation))


def find_pairs(
    likelihood: Likelihood, deviation: Array, singles: Singles, *, min_log: float = -np.inf
) -> Pairs:
    """Find the most likely pairs of hypotheses that act on different rows.

    Args:
        likelihood: Likelihood of one linearisation.
        deviation: Readings minus predictions, zeros projected out, shape (n_entries,), [m].
        singles: The single hypotheses.
        min_log: Pairs with a smaller log posterior on the coarse grid are omitted.
    """
    # principal directions up to their signs, then a basis of their orthogonal complement
    basis = np.linalg.qr(likelihood.directions.T, mode="complete").Q
    vectors = (deviation @ basis, singles.edits @ basis, singles.effects @ basis)
    taus = (AMOUNT_STDS * likelihood.sigma) ** 2
    places = [
        e * NOISE_SCALES.size + s for e in COARSE_TOLERANCE_PLACES for s in COARSE_NOISE_PLACES
    ]
    full = likelihood.grid()
    grid = [_Scaled(likelihood, vectors, full, g) for g in places]
    best_prior = 2.0 * singles.prior.max(initial=-np.inf)
    grid = [scaled for scaled in grid if scaled.largest + best_prior > min_log]
    members, scores = [np.empty((0, 2), dtype=np.int64)], [np.empty(0)]
    for block, score in _score_blocks(grid, taus):
        log = score + singles.prior[block, None] + singles.prior[block.start :]
        one, other = np.nonzero(np.triu(log > min_log, k=1))
        pairs = np.column_stack([one, other]) + block.start
        changed = singles.changed_rows[pairs]
        disjoint = ~(changed[:, 0] & changed[:, 1]).any(axis=1)
        members.append(pairs[disjoint])
        scores.append(log[one, other][disjoint])
    likeliest = np.concatenate(members)[np.argsort(-np.concatenate(scores))[:MAX_REFINED]]
    refined = _score_pairs(likelihood, vectors, likeliest, taus)
    refined += singles.prior[likeliest].sum(axis=1)
    ranked = np.argsort(-refined)
    return Pairs(likeliest[ranked], refined[ranked])


def _score_blocks(grid: list[_Scaled], taus: Array) -> Iterator[tuple[slice, Array]]:
    """Score blocks of hypotheses, each paired with all hypotheses from its first one on.

    Yields:
        The block and the largest log likelihoods over the coarse grid.
    """
    if not grid:
        return
    n, m = len(grid[0].vectors[1]), len(grid[0].vectors[2])
    for begin in range(0, n, BLOCK_SIZE):
        block = slice(begin, min(begin + BLOCK_SIZE, n))
        yield block, _largest(scaled.score_edits(block, taus) for scaled in grid)
    for begin in range(0, m, BLOCK_SIZE):
        block = slice(begin, min(begin + BLOCK_SIZE, m))
        score = _largest(scaled.score_effects(block, taus) for scaled in grid)
        yield slice(n + block.start, n + block.stop), score


def _largest(scores: Iterator[Array]) -> Array:
    """Element-wise maximum of arrays, in the memory of the first one."""
    return reduce(lambda best, score: np.maximum(best, score, out=best), scores)


def _gain(tau: float, one: Array, other: Array, shared: Array, s: Array, t: Array) -> Array:
    """Gain of log likelihood by two amounts of prior variance τ².

    Args:
        tau: Prior variance τ².
        one: Information of the first effect.
        other: Information of the second effect.
        shared: Inner product of both effects.
        s: Slope of the first effect.
        t: Slope of the second effect.
    """
    a, b, c = 1.0 + tau * one, 1.0 + tau * other, tau * shared
    det = np.maximum(a * b - c**2, 1.0)
    return np.asarray(0.5 * (tau * (s**2 * b - 2.0 * s * t * c + t**2 * a) / det - np.log(det)))


def _score_pairs(
    likelihood: Likelihood, vectors: Sequence[Array], members: Indices, taus: Array
) -> Array:
    """Log marginal likelihoods of some pairs on the full grid, shape (m,).

    Args:
        likelihood: The likelihood.
        vectors: Deviation, edits and effects, as for `_Scaled`.
        members: Indices of both hypotheses, shape (m, 2).
        taus: Grid of τ², shape (t,).
    """
    deviation, edits, effects = vectors
    changed = deviation + np.vstack([edits, np.zeros_like(effects)])[members].sum(axis=1)
    pair_effects = np.vstack([np.zeros_like(edits), effects])[members]
    logs, grid = np.empty((likelihood.weights.size, len(members))), likelihood.grid()
    for g in range(len(logs)):
        scaled = _Scaled(likelihood, (changed, pair_effects[:, 0], pair_effects[:, 1]), grid, g)
        x, one, other = scaled.vectors
        products = [(one, one), (other, other), (one, other), (one, x), (other, x), (x, x)]
        *forms, misfit = (np.einsum("ij,ij->i", a, b) for a, b in products)
        gains = np.array([_gain(tau, *forms) for tau in taus])
        # a pair of edits has no effects, and its gains are 0
        gain = log_of_sum(gains, axis=0) - np.log(taus.size)
        logs[g] = scaled.largest - 0.5 * misfit + gain
    return np.asarray(log_of_sum(logs, axis=0))
