"""Search over all pairs of hypotheses: two anomalies may hide each other from every single one.

Of two edits Δ_a, Δ_b of a deviation d the misfit is |d + Δ_a + Δ_b|². An effect w of unknown amount
gains by its slope w·x on what remains, x, and its information w·w. All inner products are weighted
by the inverse covariance of the entries, x·y = xᵀ V(e, s)⁻¹ y, one for each pair (e, s) of scales.

All pairs are scored at the best pair of scales on a coarse grid, the most likely ones on the full
grid.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np
from numpy.typing import NDArray

from orthocal.arrays import Array, Indices
from orthocal.hypotheses.likelihood import AMOUNTS, NOISE_SCALES, Likelihood, log_of_sum

COARSE_TOLERANCES = (2, 3, 4, 5, 6)
"""Places in the grid of tolerance scales that all pairs are scored at."""

COARSE_NOISES = (3, 4, 5, 7, 10)
"""Places in the grid of noise scales that all pairs are scored at."""

MOST_REFINED = 300
"""Pairs that are scored on the full grid."""

BLOCK = 128
"""Hypotheses whose pairs are scored at a time."""


@dataclass(frozen=True, slots=True, eq=False)
class Singles:
    """Single hypotheses of a small session, dense: edits first, then effects."""

    edits: Array
    """Changes of the entries, zeros projected out, shape (n_edits, n_entries), [m]."""
    effects: Array
    """Effects per unit of an unknown amount, shape (n_effects, n_entries)."""
    prior: Array
    """Logarithms of their prior probabilities, volumes included, shape (n_edits + n_effects,)."""
    touched: NDArray[np.bool_]
    """Rows that each acts on, shape (n_edits + n_effects, n_rows)."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """The most likely pairs of hypotheses, the most likely one first."""

    members: Indices
    """Shape (m, 2)."""
    log_posterior: Array
    """Logarithms of marginal likelihood times prior probability, shape (m,)."""


class _Scaled:
    """Vectors at one pair (e, s) of scales, in coordinates in which V is the identity."""

    def __init__(
        self, likelihood: Likelihood, vectors: Sequence[Array], grid: tuple[Array, Array], g: int
    ) -> None:
        noise, variance = (v[..., g] for v in grid)
        scale = np.full(vectors[0].shape[-1], 1.0 / np.sqrt(noise))
        scale[: variance.size] = 1.0 / np.sqrt(variance)
        self.vectors = tuple(v * scale for v in vectors)
        logs = np.log(variance).sum() + max(likelihood.dof - len(variance), 0) * np.log(noise)
        self.largest = float(likelihood.weights[g] - 0.5 * logs)
        """Logarithm of the marginal likelihood of a deviation of 0, which no pair exceeds."""

    @cached_property
    def _second_edits(self) -> Array:
        """Edits e, 1 and -|e|²/2: with x, c and 1 their products are c + x·e - |e|²/2."""
        edits = self.vectors[1]
        return np.column_stack([edits, np.ones(len(edits)), -0.5 * (edits**2).sum(axis=1)])

    @cached_property
    def _information(self) -> Array:
        """Information of each effect, shape (n_effects,)."""
        return np.asarray((self.vectors[2] ** 2).sum(axis=1))

    def score_edits(self, block: slice, taus: Array) -> Array:
        """Logarithms of pairs of a block of edits with these and later edits, and all effects."""
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
        """Logarithms of pairs of a block of effects with these and later effects."""
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
    likelihood: Likelihood, deviation: Array, singles: Singles, *, least: float = -np.inf
) -> Pairs:
    """Find the most likely pairs of hypotheses that act on different rows.

    Args:
        likelihood: About one linearisation.
        deviation: Readings less predictions, zeros projected out, shape (n_entries,), [m].
        singles: The single hypotheses.
        least: Log posterior on the coarse grid below which pairs are left out.
    """
    # the directions, up to their signs, and a basis of what is perpendicular to them
    basis = np.linalg.qr(likelihood.directions.T, mode="complete").Q
    vectors = (deviation @ basis, singles.edits @ basis, singles.effects @ basis)
    taus = (AMOUNTS * likelihood.sigma) ** 2
    places = [e * NOISE_SCALES.size + s for e in COARSE_TOLERANCES for s in COARSE_NOISES]
    full = likelihood.grid()
    grid = [_Scaled(likelihood, vectors, full, g) for g in places]
    best_prior = 2.0 * singles.prior.max(initial=-np.inf)
    grid = [scaled for scaled in grid if scaled.largest + best_prior > least]
    members, scores = [np.empty((0, 2), dtype=np.int64)], [np.empty(0)]
    for block, score in _score_blocks(grid, taus):
        log = score + singles.prior[block, None] + singles.prior[block.start :]
        one, other = np.nonzero(np.triu(log > least, k=1))
        pairs = np.column_stack([one, other]) + block.start
        apart = ~(singles.touched[pairs[:, 0]] & singles.touched[pairs[:, 1]]).any(axis=1)
        members.append(pairs[apart])
        scores.append(log[one, other][apart])
    likeliest = np.concatenate(members)[np.argsort(-np.concatenate(scores))[:MOST_REFINED]]
    refined = _score_pairs(likelihood, vectors, likeliest, taus)
    refined += singles.prior[likeliest].sum(axis=1)
    ranked = np.argsort(-refined)
    return Pairs(likeliest[ranked], refined[ranked])


def _score_blocks(grid: list[_Scaled], taus: Array) -> Iterator[tuple[slice, Array]]:
    """Largest logarithms on the coarse grid, of a block of hypotheses with all from its first."""
    if not grid:
        return
    n, m = len(grid[0].vectors[1]), len(grid[0].vectors[2])
    for begin in range(0, n, BLOCK):
        block = slice(begin, min(begin + BLOCK, n))
        yield block, _largest(scaled.score_edits(block, taus) for scaled in grid)
    for begin in range(0, m, BLOCK):
        block = slice(begin, min(begin + BLOCK, m))
        score = _largest(scaled.score_effects(block, taus) for scaled in grid)
        yield slice(n + block.start, n + block.stop), score


def _largest(scores: Iterator[Array]) -> Array:
    """Largest of the elements of arrays, in the memory of the first one."""
    return reduce(lambda best, score: np.maximum(best, score, out=best), scores)


def _gain(tau: float, one: Array, other: Array, shared: Array, s: Array, t: Array) -> Array:
    """Gain in the logarithm by two amounts of variance τ² with a 2 × 2 information matrix."""
    a, b, c = 1.0 + tau * one, 1.0 + tau * other, tau * shared
    det = np.maximum(a * b - c**2, 1.0)
    return np.asarray(0.5 * (tau * (s**2 * b - 2.0 * s * t * c + t**2 * a) / det - np.log(det)))


def _score_pairs(
    likelihood: Likelihood, vectors: Sequence[Array], members: Indices, taus: Array
) -> Array:
    """Logarithms of the marginal likelihood of some pairs on the full grid, shape (m,)."""
    deviation, edits, effects = vectors
    changed = deviation + np.vstack([edits, np.zeros_like(effects)])[members].sum(axis=1)
    both = np.vstack([np.zeros_like(edits), effects])[members]
    logs, grid = np.empty((likelihood.weights.size, len(members))), likelihood.grid()
    for g in range(len(logs)):
        scaled = _Scaled(likelihood, (changed, both[:, 0], both[:, 1]), grid, g)
        x, one, other = scaled.vectors
        products = [(one, one), (other, other), (one, other), (one, x), (other, x), (x, x)]
        *forms, misfit = (np.einsum("ij,ij->i", a, b) for a, b in products)
        gains = np.array([_gain(tau, *forms) for tau in taus])
        # without an effect all gains are 0
        gain = log_of_sum(gains, axis=0) - np.log(taus.size)
        logs[g] = scaled.largest - 0.5 * misfit + gain
    return np.asarray(log_of_sum(logs, axis=0))
