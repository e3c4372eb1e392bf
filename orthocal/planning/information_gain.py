"""Reduction of the expected tool error by the readings of one setup.

The state is the vector of the errors that setups share: those of the machine, and of common gauges
and artefacts. Let C be its covariance without this setup, and T its weight at the tool. Readings S
of the setup reduce tr(T C) by

    tr[(V_SS + σ² I)⁻¹ Q_SS],  V = A C Aᵀ + D,  Q = A C T C Aᵀ

with A the Jacobian of the readings and D the covariance from the setup's nuisance parameters. A
reading is one number (`SetupGain`) or a point of three (`PointGain`). A free zero of single
readings is eliminated exactly: the inverse of V_SS + σ² I becomes that of `eliminate_zero`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array, Indices, Mask
from orthocal.planning.candidates import CandidateSetup
from orthocal.planning.ranking import first_largest, first_largest_of_rows
from orthocal.statistics.zeros import eliminate_zero

PAIRS_AT_ONCE = 40_000
"""Number of pairs whose gains are computed together; their matrices stay in the cache."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Pairs of readings with which a setup can begin; the gauge is aligned in the first one."""

    first: Indices
    """First reading of each pair, shape (n_pairs,)."""
    second: Indices
    """Second reading of each pair, shape (n_pairs,)."""
    within_range: Indices
    """Number of readings within the gauge's range if the setup begins in each reading, (m,)."""

    @staticmethod
    def of(setup: CandidateSetup) -> Pairs:
        """All pairs within the gauge's range."""
        allowed = setup.reachable.copy()
        np.fill_diagonal(allowed, False)
        first, second = np.nonzero(allowed)
        return Pairs(first, second, setup.reachable.sum(axis=1))

    def with_count(self, count: int) -> Pairs:
        """Pairs whose first reading has at least `count` readings within the gauge's range."""
        if (self.within_range >= count).all():
            return self
        enough = self.within_range[self.first] >= count
        return Pairs(self.first[enough], self.second[enough], self.within_range)


def pair_gains(product: Array, spread: Array, noise: float, *, absolute: bool) -> Array:
    """Gains of all pairs of readings, shape (..., m, m).

    With a free gauge zero only the difference of the readings counts.

    Args:
        product: A C T C Aᵀ, shape (..., m, m); overwritten with a free zero.
        spread: V, shape (..., m, m), [m²]; overwritten with a free zero.
        noise: σ², [m²].
        absolute: Whether the gauge zero is known.
    """
    q, v = (np.diagonal(x, axis1=-2, axis2=-1)[..., None].copy() for x in (product, spread))
    if not absolute:
        for matrix, diagonal in ((product, q), (spread, v + noise)):
            matrix *= -2.0
            matrix += diagonal
            matrix += diagonal.mT
        product /= spread
        return product
    variance = v + noise
    gains = q * variance.mT
    gains = gains + gains.mT - 2.0 * product * spread
    return np.asarray(gains / (variance * variance.mT - spread**2))


@dataclass(frozen=True, slots=True, eq=False)
class _AlignedTerms:
    """Terms of a nuisance parameter that is aligned in the first posture of a setup.

    Each row of S is its sensitivity to the state if the setup begins in that posture.
    """

    sensitivity: Array
    """Sensitivity of the readings to the parameter, shape (m,)."""
    jacobian: Array
    """S, shape (m, n_state)."""
    jacobian_covariance: Array
    """S C, shape (m, n_state)."""
    spread: Array
    """S C Aᵀ, shape (m, m)."""
    effect: Array
    """S C R, shape (m, p)."""

    def product(self, other: _AlignedTerms) -> Array:
        """Diagonal of S C S'ᵀ with another parameter, shape (m,)."""
        return np.asarray(np.vecdot(self.jacobian_covariance, other.jacobian))


@dataclass(frozen=True, slots=True, eq=False)
class SetupGain:
    """Gain by readings of one candidate setup, conditional on all other information."""

    setup: CandidateSetup
    spread: Array
    """V, shape (m, m), [m²]."""
    effect: Array
    """A C R, shape (m, p)."""
    variance: Array
    """Diagonal of V, shape (m,)."""
    noise: float
    """σ²."""
    aligned: tuple[_AlignedTerms, ...] = ()

    @staticmethod
    def of(setup: CandidateSetup, covariance: Array, root: Array, sigma: float) -> SetupGain:
        """Gain by readings for a covariance of the state without them.

        Args:
            setup: The candidate setup.
            covariance: C, shape (n_state, n_state).
            root: C R with T = R Rᵀ, shape (n_state, p).
            sigma: Standard deviation of a reading, [m].
        """
        spread = setup.jacobian @ covariance @ setup.jacobian.T
        spread += setup.covariance
        aligned = []
        for a in setup.aligned:
            product = a.jacobian @ covariance
            cross, effect = product @ setup.jacobian.T, a.jacobian @ root
            aligned.append(_AlignedTerms(a.sensitivity, a.jacobian, product, cross, effect))
        variance = spread.diagonal().copy()
        return SetupGain(setup, spread, setup.jacobian @ root, variance, sigma**2, tuple(aligned))

    def begin_with(self, first: int) -> SetupGain:
        """Gain with the gauge aligned in the posture of one reading."""
        if not self.aligned:
            return self
        spread, effect = self.spread.copy(), self.effect.copy()
        for a in self.aligned:
            cross = np.outer(a.sensitivity, a.spread[first])
            spread += cross + cross.T
            effect += np.outer(a.sensitivity, a.effect[first])
            for other in self.aligned:
                covariance = a.jacobian_covariance[first] @ other.jacobian[first]
                spread += covariance * np.outer(a.sensitivity, other.sensitivity)
        return SetupGain(self.setup, spread, effect, spread.diagonal().copy(), self.noise)

    def gains(self, sets: Indices) -> Array:
        """Gains of sets of readings with the gauge aligned in the first of each, shape (n_sets,).

        Args:
            sets: Readings of each set, shape (n_sets, k).
        """
        first, effect = sets[:, 0], self.effect[sets]
        spread = self.spread[sets[:, :, None], sets[:, None, :]]
        spread += self.noise * np.eye(sets.shape[1])
        for a in self.aligned:
            sensitivity = a.sensitivity[sets]
            effect += sensitivity[:, :, None] * a.effect[first][:, None, :]
            cross = sensitivity[:, :, None] * a.spread[first[:, None], sets][:, None, :]
            spread += cross + np.swapaxes(cross, 1, 2)
            for other in self.aligned:
                covariance = a.product(other)[first]
                outer = sensitivity[:, :, None] * other.sensitivity[sets][:, None, :]
                spread += covariance[:, None, None] * outer
        if not self.setup.absolute:  # differences from the first reading have no zero
            effect = effect[:, 1:] - effect[:, :1]
            spread = (spread[:, 1:, 1:] - spread[:, 1:, :1]) - spread[:, :1, 1:] + spread[:, :1, :1]
        return np.asarray((effect * np.linalg.solve(spread, effect)).sum(axis=(1, 2)))

    def exchange_gains(self, rows: list[int]) -> Array:
        """Gain of each reading if it replaces each of the chosen ones, shape (k, m).

        Let W be the inverse of V_SS + σ² I and w its column of reading p. Removing p changes W by
        −w wᵀ / w_p. Residual effects and variances of all readings change by one product each.
        """
        spread = self.spread[rows]
        covariance = spread[:, rows] + self.noise * np.eye(len(rows))
        inverse = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        in_zero, of_zero = np.zeros(len(rows)), 0.0
        if not self.setup.absolute:
            inverse, in_zero, of_zero = eliminate_zero(inverse)
        solved, weighted = inverse @ spread + in_zero[:, None], inverse @ self.effect[rows]
        effect = self.effect - solved.T @ self.effect[rows]
        variance = self.variance - np.vecdot(spread.T, solved.T) - in_zero @ spread + of_zero
        share = solved / inverse.diagonal()[:, None]
        gains = np.vecdot(weighted, weighted)[:, None] * share
        gains += 2.0 * (weighted @ effect.T)
        gains *= share
        gains += np.vecdot(effect, effect)
        return np.asarray(gains / (np.maximum(variance + share * solved, 0.0) + self.noise))

    def best_pairs(self, pairs: Pairs, count: int) -> list[tuple[float, tuple[int, int]]]:
        """Best pairs of readings with their gains; the gauge is aligned in the first reading.

        With an aligned nuisance parameter all pairs begin with different readings. Otherwise they
        have no common reading.

        Args:
            pairs: Possible pairs.
            count: Largest number of pairs.
        """
        i, j = pairs.first, pairs.second
        if not i.size:
            return []
        absolute = self.setup.absolute
        if not self.aligned:
            product, spread = self.effect @ self.effect.T, self.spread.copy()
            gains = pair_gains(product, spread, self.noise, absolute=absolute)[i, j]
        else:
            gains = self.gains(np.column_stack([i, j])) if absolute else self._aligned_gains()[i, j]
        ranked: list[tuple[float, tuple[int, int]]] = []
        while True:
            best = first_largest(gains)
            gain, pair = float(gains[best]), (int(i[best]), int(j[best]))
            if gain < 0.0:
                return ranked
            ranked.append((gain, pair))
            if len(ranked) == count:
                return ranked
            if self.aligned:
                gains[i == pair[0]] = -1.0
                continue
            for row in pair:
                gains[(i == row) | (j == row)] = -1.0

    def _aligned_gains(self) -> Array:
        """Gains of the differences of all pairs, aligned in the first reading (row), (m, m).

        They are those of `gains`, in a fiftieth of its time.
        """
        product, spread = self.effect @ self.effect.T, self.spread
        gains, spreads = (
            np.add.outer(s.diagonal(), s.diagonal()) - 2.0 * s for s in (product, spread)
        )
        spreads += 2.0 * self.noise
        for a in self.aligned:
            change = a.sensitivity - a.sensitivity[:, None]
            for total, cross in ((gains, a.effect @ self.effect.T), (spreads, a.spread)):
                total += 2.0 * change * (cross - cross.diagonal()[:, None])
            for other in self.aligned:
                changes = change * (other.sensitivity - other.sensitivity[:, None])
                gains += changes * np.vecdot(a.effect, other.effect)[:, None]
                spreads += changes * a.product(other)[:, None]
        return np.asarray(gains / spreads)

    def grow(self, pair: tuple[int, int], count: int) -> tuple[tuple[float, ...], tuple[int, ...]]:
        """Add readings greedily to a pair.

        Each added reading conditions the others by one further column of the Cholesky factor of V.

        Returns:
            Gains of the first reading, of the first two, and so on; and the readings, fewer than
            `count` if the range of the gauge allows no more.
        """
        spread, effect, variance = self.spread, self.effect, self.variance
        columns, change = np.empty((count, len(variance))), np.empty_like(effect)
        chosen, gains = list(pair), list[float]()
        excluded = ~self.setup.reachable[pair[0]]
        covariances, first_variance = np.zeros_like(variance), 0.0
        if not self.setup.absolute:  # differences from the first reading have no zero
            covariances = spread[pair[0]]
            first_variance = spread[pair[0], pair[0]] + self.noise
            effect = effect - effect[pair[0]]
            variance = variance - 2.0 * covariances + first_variance
            columns[0], gains = 0.0, [0.0]
        for k in range(len(gains), count):
            if k >= len(chosen):
                excluded[chosen] = True
                single = np.vecdot(effect, effect) / (np.maximum(variance, 0.0) + self.noise)
                np.putmask(single, excluded, -1.0)
                best = first_largest(single)
                if excluded[best]:
                    break
                chosen.append(best)
            row = chosen[k]
            column = spread[row] - covariances - (covariances[row] - first_variance)
            if k:
                column = column - columns[:k, row] @ columns[:k]
            pivot = math.sqrt(column[row] + self.noise)
            column, share = np.divide(column, pivot, out=columns[k]), effect[row] / pivot
            gains.append(float(share @ share) + (gains[-1] if gains else 0.0))
            np.multiply(column[:, None], share, out=change)
            effect = np.subtract(effect, change, out=None if effect is self.effect else effect)
            variance = variance - column**2
        return tuple(gains), tuple(chosen)


@dataclass(frozen=True, slots=True, eq=False)
class PointGain:
    """Gain by points of one candidate setup, conditional on all other information.

    The methods are those of `SetupGain`; a point is a block of w rows of A. The instrument is not
    aligned to the machine.
    """

    setup: CandidateSetup
    spread: Array
    """V, shape (m w, m w), [m²]."""
    effect: Array
    """A C R, shape (m w, p)."""
    noise: float
    """σ²."""

    @staticmethod
    def of(setup: CandidateSetup, covariance: Array, root: Array, sigma: float) -> PointGain:
        """Gain by points; the arguments are those of `SetupGain.of`."""
        spread = setup.jacobian @ covariance @ setup.jacobian.T + setup.covariance
        return PointGain(setup, spread, setup.jacobian @ root, sigma**2)

    def begin_with(self, first: int) -> PointGain:
        """Gain with a first point, on which it does not depend."""
        del first
        return self

    def gains(self, sets: Indices) -> Array:
        """Gains of sets of points, shape (n_sets,)."""
        at = self.setup.numbers(sets)
        spread = self.spread[at[:, :, None], at[:, None, :]] + self.noise * np.eye(at.shape[1])
        effect = self.effect[at]
        return np.asarray((effect * np.linalg.solve(spread, effect)).sum(axis=(1, 2)))

    def exchange_gains(self, rows: list[int]) -> Array:
        """Gain of each point if it replaces each of the chosen ones, shape (k, m).

        As for single readings, with blocks: removing point p changes W by −W_·p W_pp⁻¹ W_p·.
        """
        at, k, w = self.setup.numbers(rows), len(rows), self.setup.width
        inverse = np.linalg.inv(self.spread[np.ix_(at, at)] + self.noise * np.eye(at.size))
        solved, weighted = inverse @ self.spread[at], inverse @ self.effect[at]
        effect = self.effect - solved.T @ self.effect[at]
        factors = self.spread[at].reshape(k * w, -1, w), solved.reshape(k * w, -1, w)
        spread = self._blocks(self.spread) - np.einsum("sib,sic->ibc", *factors)
        inverse_blocks = np.linalg.inv(self._blocks(np.asarray(inverse)))
        of_point = solved.reshape(k, w, -1, w)
        share = np.einsum("paib,pac->pibc", of_point, inverse_blocks)
        weighted = weighted.reshape(k, w, -1)
        rows_of_point = effect.reshape(-1, w, effect.shape[1])
        cross = np.einsum("ibr,pcr->pibc", rows_of_point, weighted, optimize=True)
        half = np.einsum("pibc,pidc->pibd", cross, share)
        square = np.einsum("pcr,pdr->pcd", weighted, weighted)
        gains = np.einsum("ibr,icr->ibc", rows_of_point, rows_of_point) + 2.0 * half
        gains += np.einsum("pibc,pcd,pied->pibe", share, square, share, optimize=True)
        spread = spread + np.einsum("pibc,pcid->pibd", share, of_point)
        return self._trace(gains, spread)

    def best_pairs(self, pairs: Pairs, count: int) -> list[tuple[float, tuple[int, int]]]:
        """Points of largest gain, each with the best additional one; no pairs share a point.

        Args:
            pairs: Possible pairs.
            count: Largest number of pairs.
        """
        allowed = np.zeros_like(self.setup.reachable)
        allowed[pairs.first, pairs.second] = True
        blocks = self.effect.reshape(len(allowed), -1, self.effect.shape[1])
        gains = self._trace(np.einsum("ibr,icr->ibc", blocks, blocks), self._blocks(self.spread))
        ranked: list[tuple[float, tuple[int, int]]] = []
        while len(ranked) < count and allowed.any():
            first = first_largest(np.where(allowed.any(axis=1), gains, -1.0))
            gains_after, (_, second) = self._grow((first,), 2, ~allowed[first])
            ranked.append((gains_after[-1], (first, second)))
            allowed[[first, second]] = False
            allowed[:, [first, second]] = False
        return ranked

    def grow(self, pair: tuple[int, int], count: int) -> tuple[tuple[float, ...], tuple[int, ...]]:
        """Add points greedily to a pair; see `SetupGain.grow`."""
        return self._grow(pair, count, ~self.setup.reachable[pair[0]])

    def _grow(
        self, first: tuple[int, ...], count: int, excluded: Mask
    ) -> tuple[tuple[float, ...], tuple[int, ...]]:
        """Add points to the first ones; each is w further columns of the Cholesky factor of V."""
        w, effect, variance = self.setup.width, self.effect, self._blocks(self.spread)
        columns = np.empty((count * w, len(self.spread)))
        chosen, gains = list(first), list[float]()
        excluded = excluded.copy()
        for k in range(count):
            if k >= len(chosen):
                excluded[chosen] = True
                blocks = effect.reshape(len(variance), w, -1)
                single = self._trace(np.einsum("ibr,icr->ibc", blocks, blocks), variance)
                best = first_largest(np.where(excluded, -1.0, single))
                if excluded[best]:
                    break
                chosen.append(best)
            at, before = self.setup.numbers([chosen[k]]), columns[: k * w]
            column = self.spread[at] - before[:, at].T @ before
            root = np.linalg.cholesky(column[:, at] + self.noise * np.eye(w))
            step = columns[k * w : (k + 1) * w] = np.linalg.solve(root, column)
            share = np.linalg.solve(root, effect[at])
            gains.append(float(np.vdot(share, share)) + (gains[-1] if gains else 0.0))
            effect = effect - step.T @ share
            of_point = step.reshape(w, -1, w)
            variance = variance - np.einsum("sib,sic->ibc", of_point, of_point)
        return tuple(gains), tuple(chosen)

    def _blocks(self, matrix: Array) -> Array:
        """Blocks of each point on the diagonal of a matrix, shape (m, w, w)."""
        w = self.setup.width
        points = np.arange(len(matrix) // w)
        return np.asarray(matrix.reshape(points.size, w, points.size, w)[points, :, points])

    def _trace(self, gains: Array, spread: Array) -> Array:
        """tr[(V + σ² I)⁻¹ Q] of blocks, shape (..., w, w) each."""
        noise = self.noise * np.eye(self.setup.width)
        solved = np.linalg.solve(spread + noise, gains)
        return np.asarray(np.trace(solved, axis1=-2, axis2=-1))


Gain = SetupGain | PointGain
"""Gain of readings of one candidate setup."""


@dataclass(frozen=True, slots=True, eq=False)
class SetupStack:
    """Candidate setups of one gauge with m readings each, whose best pairs are found at once.

    The gains are those of `SetupGain.best_pairs`, with the alignment averaged over all postures. A
    plan takes 10 to 20 % less time than with one setup at a time.
    """

    gauge: str
    absolute: bool
    """Whether the gauge zero is known."""
    which: Indices
    """Indices of the candidate setups, shape (n_setups,)."""
    jacobian: Array
    """A of each setup, shape (n_setups, m, n_state)."""
    covariance: Array
    """D of each setup, shape (n_setups, m, m), [m²]."""
    possible: Mask
    """Mask of pairs within the gauge's range, shape (n_setups, m, m)."""
    within_range: Indices
    """Number of readings within the gauge's range if it begins in each reading,
    shape (n_setups, m)."""

    def best_pairs(
        self, covariance: Array, root: Array, noise: float, count: int
    ) -> list[tuple[float, int, tuple[int, int]]]:
        """Gain, candidate setup and best pair of readings of each setup that has a pair.

        Args:
            covariance: Covariance C of the state without these readings, shape (n_state, n_state).
            root: C R with the weight T = R Rᵀ, shape (n_state, p).
            noise: σ², [m²].
            count: Number of readings that the gauge's range must allow.
        """
        best: list[tuple[float, int, tuple[int, int]]] = []
        at_once = max(1, PAIRS_AT_ONCE // self.possible[0].size)
        for begin in range(0, len(self.which), at_once):
            some = slice(begin, begin + at_once)
            jacobian = self.jacobian[some]
            effect = jacobian @ root
            spread = (jacobian @ covariance) @ jacobian.mT
            spread += self.covariance[some]
            gains = pair_gains(effect @ effect.mT, spread, noise, absolute=self.absolute)
            possible = self.possible[some] & (self.within_range[some] >= count)[:, :, None]
            np.putmask(gains, ~possible, -1.0)
            gains = gains.reshape(len(gains), -1)
            at = first_largest_of_rows(gains)
            largest = gains[np.arange(len(at)), at].tolist()
            rows = (x.tolist() for x in np.divmod(at, self.possible.shape[1]))
            columns = zip(largest, self.which[some].tolist(), *rows, strict=True)
            best += [(gain, i, (j, k)) for gain, i, j, k in columns if gain >= 0.0]
        return best


def stack_setups(setups: Sequence[CandidateSetup], which: Iterable[int]) -> Iterator[SetupStack]:
    """Stack candidate setups whose readings are single numbers, by gauge and number of readings.

    Args:
        setups: All candidate setups.
        which: Indices of the setups to stack.
    """
    groups: dict[tuple[str, bool, int], list[int]] = {}
    for i in which:
        key = setups[i].gauge, setups[i].absolute, len(setups[i].rows)
        groups.setdefault(key, []).append(i)
    for (gauge, absolute, m), members in groups.items():
        reachable = np.stack([setups[i].reachable for i in members])
        yield SetupStack(
            gauge,
            absolute,
            np.array(members),
            jacobian=np.stack([setups[i].jacobian for i in members]),
            covariance=np.stack([setups[i].covariance for i in members]),
            possible=reachable & ~np.eye(m, dtype=np.bool_),
            within_range=reachable.sum(axis=2),
        )
