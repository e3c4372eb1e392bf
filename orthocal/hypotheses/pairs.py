"""Search over all pairs of hypotheses: two anomalies may hide each other from every single one.

With deviations d + Δ_a + Δ_b and effects w_a, w_b, all quadratic forms of a pair follow from the
Gram matrices of the single hypotheses, one for each pair (e, s) of scales:

    q_ab = d·d + 2 d·(Δ_a + Δ_b) + Δ_a·Δ_a + Δ_b·Δ_b + 2 Δ_a·Δ_b,  x·y = xᵀ V(e, s)⁻¹ y

All pairs are scored on a coarse grid of scales, the best of them on the full one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.hypotheses.likelihood import AMOUNTS, NOISE_SCALES, Likelihood, log_of_sum

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

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
    """Single hypotheses of a small session, dense."""

    edits: Array
    """Changes of the entries, zeros projected out, shape (h, n_entries), [m]."""
    effects: Array
    """Effects per unit of an unknown amount, shape (h, n_entries); 0 where there is none."""
    prior: Array
    """Logarithms of their prior probabilities, volumes included, shape (h,)."""
    touched: NDArray[np.bool_]
    """Rows that each acts on, shape (h, n_rows)."""

    @property
    def best_prior(self) -> float:
        """Upper bound of the logarithm of the prior probability of a pair."""
        return float(2.0 * self.prior.max(initial=-np.inf))


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """The most likely pairs of hypotheses, the most likely one first."""

    members: Indices
    """Shape (m, 2)."""
    log_posterior: Array
    """Logarithms of marginal likelihood times prior probability, shape (m,)."""


class _Forms:
    """Quadratic forms of the deviation (0), edits (1 to h) and effects for one pair (e, s).

    V⁻¹ = (1 − Rᵀ (1 − s²σ²/v) R)/s²σ², with R the principal directions and v their variances.
    """

    def __init__(self, likelihood: Likelihood, vectors: Array, along: Array, g: int) -> None:
        noise, variance = likelihood.noise[g], likelihood.variance[:, g]
        scaled = along * np.sqrt((1.0 - noise / variance) / noise)
        self.left = np.hstack([vectors / np.sqrt(noise), -scaled])
        self.right = np.hstack([self.left[:, : vectors.shape[1]], scaled])
        self.own = (self.left * self.right).sum(axis=1)
        self.shown = self.left @ self.right[0]
        logs = np.log(variance).sum() + max(likelihood.dof - len(variance), 0) * np.log(noise)
        self.constant = float(likelihood.weights[g] - 0.5 * logs)

    def gram(self, one: slice | Indices, other: slice | Indices) -> Array:
        """Matrix of inner products, shape (a, b)."""
        return np.asarray(self.left[one] @ self.right[other].T)

    def dots(self, one: Indices, other: Indices) -> Array:
        """Inner products pair by pair, shape (m,)."""
        return np.asarray((self.left[one] * self.right[other]).sum(axis=1))


def find_pairs(
    likelihood: Likelihood, deviation: Array, singles: Singles, *, least: float = -np.inf
) -> Pairs:
    """Find the most likely pairs of hypotheses that act on different rows.

    Args:
        likelihood: About one linearisation.
        deviation: Readings less predictions, zeros projected out, shape (n_entries,), [m].
        singles: The single hypotheses.
        least: Largest term of the logarithm on the coarse grid below which pairs are left out.
    """
    n = len(singles.edits)
    order = np.argsort((np.abs(singles.effects).max(axis=1) > 0.0).astype(np.int64), kind="stable")
    edits, effects = singles.edits[order], singles.effects[order]
    prior, touched = singles.prior[order], singles.touched[order].astype(np.float32)
    first_effect = n - int((np.abs(effects).max(axis=1) > 0.0).sum())
    vectors = np.concatenate([deviation[None], edits, effects[first_effect:]])
    found_one, found_other, found_score = [], [], []
    along = vectors @ likelihood.directions.T
    forms = [
        _Forms(likelihood, vectors, along, e * NOISE_SCALES.size + s)
        for e in COARSE_TOLERANCES
        for s in COARSE_NOISES
    ]
    taus = (AMOUNTS * likelihood.sigma) ** 2
    for begin in range(0, n, BLOCK):
        a = np.arange(begin, min(begin + BLOCK, n))
        best = _score_block(forms, a, n, first_effect, taus)
        best += prior[a][:, None] + prior[begin:]
        best[touched[a] @ touched[begin:].T > 0.0] = -np.inf
        best[np.tril_indices(len(a), 0, best.shape[1])] = -np.inf
        flat = best.ravel()
        top = np.argpartition(-flat, min(MOST_REFINED, flat.size - 1))[:MOST_REFINED]
        top = top[np.isfinite(flat[top])]
        found_one.append(a[top // best.shape[1]])
        found_other.append(begin + top % best.shape[1])
        found_score.append(flat[top])
    score = np.concatenate(found_score)
    kept = np.argsort(-score)[:MOST_REFINED]
    kept = kept[score[kept] > least]
    if not kept.size:
        return Pairs(np.empty((0, 2), dtype=np.int64), np.empty(0))
    members = np.column_stack([np.concatenate(found_one), np.concatenate(found_other)])[kept]
    refined = _score_pairs(likelihood, vectors, members, first_effect, n, taus)
    refined = refined + prior[members].sum(axis=1)
    ranked = np.argsort(-refined)
    return Pairs(order[members[ranked]], refined[ranked])


def _score_block(forms: list[_Forms], a: Indices, n: int, first: int, taus: Array) -> Array:
    """Largest logarithm over a coarse grid of all pairs of a block, shape (a, n − a[0])."""
    begin = int(a[0])
    best = np.full((a.size, n - begin), -np.inf)
    rest = np.arange(begin, n)
    for form in forms:
        single = form.shown[1 : n + 1] + 0.5 * form.own[1 : n + 1]
        logs = -form.gram(1 + a, slice(1 + begin, n + 1))
        logs -= single[a][:, None] + (single[begin:] + 0.5 * form.own[0] - form.constant)
        # only pairs with an effect in them gain from one; effects come last in the order
        if n > first:
            columns = rest >= first
            if a[-1] >= first:
                columns[:] = True
            b = rest[columns]
            logs[:, columns] += _gain_of_block(form, a, b, n, first, taus)
        np.maximum(best, logs, out=best)
    return best


def _gain_of_block(form: _Forms, a: Indices, b: Indices, n: int, first: int, taus: Array) -> Array:
    """Largest gain over τ by the unknown amounts of pairs (a, b), shape (a, b)."""
    has_a, has_b = a >= first, b >= first
    w_a, w_b = 1 + n + a[has_a] - first, 1 + n + b[has_b] - first
    if not w_a.size:  # one amount alone, which is most of the pairs
        square = (form.gram(1 + a, w_b) + (form.dots(w_b, 1 + b) + form.shown[w_b])) ** 2
        info = form.own[w_b]
        best = np.full(square.shape, -np.inf)
        for tau in taus:
            gains = square * (0.5 * tau / (1.0 + tau * info)) - 0.5 * np.log1p(tau * info)
            np.maximum(best, gains, out=best)
        return np.asarray(best - np.log(taus.size))
    shape = (a.size, b.size)
    slope_a, slope_b, shared = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    info_a, info_b = np.zeros(a.size), np.zeros(b.size)
    if w_a.size:
        own = form.dots(w_a, 1 + a[has_a]) + form.shown[w_a]
        slope_a[has_a] = own[:, None] + form.gram(w_a, 1 + b)
        info_a[has_a] = form.own[w_a]
    if w_b.size:
        own = form.dots(w_b, 1 + b[has_b]) + form.shown[w_b]
        slope_b[:, has_b] = own + form.gram(1 + a, w_b)
        info_b[has_b] = form.own[w_b]
    if w_a.size and w_b.size:
        shared[np.ix_(has_a, has_b)] = form.gram(w_a, w_b)
    gain = np.full(shape, -np.inf)
    for tau in taus:
        gains = _gain(tau, info_a[:, None], info_b[None, :], shared, slope_a, slope_b)
        np.maximum(gain, gains, out=gain)
    return np.asarray(gain - np.log(taus.size))


def _gain(tau: float, one: Array, other: Array, shared: Array, s: Array, t: Array) -> Array:
    """Gain in the logarithm by two amounts of variance τ² with a 2 × 2 information matrix."""
    a, b, c = 1.0 + tau * one, 1.0 + tau * other, tau * shared
    det = np.maximum(a * b - c**2, 1.0)
    return np.asarray(0.5 * (tau * (s**2 * b - 2.0 * s * t * c + t**2 * a) / det - np.log(det)))


def _score_pairs(
    likelihood: Likelihood, vectors: Array, members: Indices, first: int, n: int, taus: Array
) -> Array:
    """Logarithm of the marginal likelihood of some pairs on the full grid, shape (m,)."""
    one, other = members.T
    logs = np.empty((likelihood.weights.size, len(members)))
    along = vectors @ likelihood.directions.T
    has = [one >= first, other >= first]
    w_one, w_other = (
        np.where(h, 1 + n + m - first, 0) for h, m in zip(has, (one, other), strict=True)
    )
    for g in range(likelihood.weights.size):
        form = _Forms(likelihood, vectors, along, g)
        a, b = 1 + one, 1 + other
        dot, shown, own = form.dots, form.shown, form.own
        q = own[0] + 2.0 * (shown[a] + shown[b] + dot(a, b)) + own[a] + own[b]
        slopes = [
            np.where(h, shown[w] + dot(w, a) + dot(w, b), 0.0)
            for h, w in zip(has, (w_one, w_other), strict=True)
        ]
        info = [np.where(h, own[w], 0.0) for h, w in zip(has, (w_one, w_other), strict=True)]
        shared = np.where(has[0] & has[1], dot(w_one, w_other), 0.0)
        gains = np.array(
            [_gain(tau, info[0], info[1], shared, slopes[0], slopes[1]) for tau in taus]
        )
        any_effect = has[0] | has[1]
        gain = np.where(any_effect, log_of_sum(gains, axis=0) - np.log(taus.size), 0.0)
        logs[g] = form.constant - 0.5 * q + gain
    return np.asarray(log_of_sum(logs, axis=0))
