"""Sessions held against each other: linear algebra of what differs from one session on.

Readings of several sessions of one machine are, to first order and in their standard deviations,

    y = X β + D δ + n,  n ~ N(0, 1),  β ~ N(0, diag(P)⁻¹),  D: columns of X in later sessions alone

With W = 1 − X (XᵀX + P)⁻¹ Xᵀ, the precision of y once all that the sessions have in common is taken
out, one change is estimated as δ = dᵀWy/dᵀWd with variance 1/dᵀWd. All follows from products summed
session by session.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthocal.statistics.chance import BY_CHANCE, chance_of_excess

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

NEXT_TO_NOTHING = 1e-6
"""Precision of what nothing is known of, in tolerances."""

ROUNDING = 1e-13
"""Part of the largest sum of squares that rounding may have taken from a small one."""

BLIND = 1e-9
"""Part of a column's own square that must be left of it for the readings to tell it."""

EXCESSES = (1.5, 2.2, 3.3, 5.0, 7.5, 11.0, 17.0)
"""Times the tolerances that errors of a machine are tried at where once is not enough."""

EXCESS_SPREAD = 0.5
"""Standard deviation of the logarithm of how many times its tolerances a machine's errors are."""


@dataclass(frozen=True, slots=True, eq=False)
class Contrasts:
    """Readings of several sessions, and what they have in common."""

    columns: Array
    """X, gauge zeros eliminated, shape (n_entries, n), [standard deviations]."""
    values: Array
    """y, shape (n_entries,), [standard deviations]."""
    session: Indices
    """Of each entry, shape (n_entries,)."""
    zero: Indices
    """Gauge zero of each entry, shape (n_entries,)."""
    precision: Array
    """P; infinite for a column that the sessions have not in common, shape (n,)."""
    flat: NDArray[np.bool_]
    """Columns that take up a degree of freedom each, shape (n,)."""
    products: Array
    """XᵀX of each session, shape (n_sessions, n, n)."""
    scores: Array
    """Xᵀy of each session, shape (n_sessions, n)."""

    @property
    def n_sessions(self) -> int:
        """Number of sessions."""
        return len(self.products)

    @property
    def dof(self) -> float:
        """Degrees of freedom of `square`."""
        return float(len(self.values) - np.unique(self.zero).size - self.flat.sum())

    def since(self, session: int) -> tuple[Array, Array]:
        """XᵀX and Xᵀy of a session and those after it."""
        return self.products[session:].sum(axis=0), self.scores[session:].sum(axis=0)

    def extend(self, column: Array) -> Contrasts:
        """The same with a further column of which nothing is known, shape (n_entries,)."""
        columns = np.column_stack([self.columns, column])
        n = columns.shape[1]
        products = np.zeros((self.n_sessions, n, n))
        products[:, :-1, :-1] = self.products
        scores = np.zeros((self.n_sessions, n))
        scores[:, :-1] = self.scores
        for s in range(self.n_sessions):
            own = self.session == s
            row = column[own] @ columns[own]
            products[s, -1], products[s, :, -1] = row, row
            scores[s, -1] = column[own] @ self.values[own]
        return replace(
            self,
            columns=columns,
            precision=np.append(self.precision, NEXT_TO_NOTHING),
            flat=np.append(self.flat, True),
            products=products,
            scores=scores,
        )

    def column(self, direction: Array, session: int) -> Array:
        """What a change from a session on does to the readings, shape (n_entries,).

        Args:
            direction: In the first columns, shape (m,).
            session: From which one on.
        """
        moved = self.columns[:, : direction.size] @ direction
        return np.where(self.session >= session, moved, 0.0)

    def reading(self, entry: int) -> Array:
        """What an error of a single entry does to the readings, shape (n_entries,)."""
        same = self.zero == self.zero[entry]
        result = np.where(same, -1.0 / same.sum(), 0.0)
        result[entry] += 1.0
        return result


@dataclass(frozen=True, slots=True, eq=False)
class Common:
    """What is left of contrasts once all that the sessions have in common is taken out."""

    contrasts: Contrasts
    used: Indices
    """Columns in common."""
    factor: Array
    """L of XᵀX + P = L Lᵀ."""
    estimate: Array
    """β, shape (n_used,)."""
    square: float
    """yᵀWy: χ² of all readings with `contrasts.dof`."""
    log_evidence: float
    """Of the readings, up to a constant."""

    def test(self, directions: Array, session: int) -> tuple[Array, Array]:
        """Changes from a session on, one at a time.

        Args:
            directions: In the first columns, shape (m, n_changes).
            session: From which one on.

        Returns:
            dᵀWy and dᵀWd, shape (n_changes,); 0 for what the readings do not tell.
        """
        products, scores = self.contrasts.since(session)
        moved = products[:, : len(directions)] @ directions
        own = np.einsum("ij,ij->j", directions, moved[: len(directions)])
        score = directions.T @ scores[: len(directions)] - moved[self.used].T @ self.estimate
        taken = moved[self.used] * self._solve(moved[self.used])
        information = own - taken.sum(axis=0)
        told = information > BLIND * np.maximum(own, 1e-300)
        return np.where(told, score, 0.0), np.where(told, information, 0.0)

    def test_together(self, columns: Indices, session: int) -> tuple[float, float]:
        """Any change of some columns from a session on.

        Directions that one tolerance of them does not move by a standard deviation do not count.

        Returns:
            χ² of it, and its degrees of freedom.
        """
        products, scores = self.contrasts.since(session)
        moved = products[:, columns]
        score = scores[columns] - moved[self.used].T @ self.estimate
        left = moved[columns] - moved[self.used].T @ self._solve(moved[self.used])
        sizes, directions = np.linalg.eigh(0.5 * (left + left.T))
        told = sizes > max(1.0, BLIND * float(sizes.max(initial=0.0)))
        along = directions[:, told].T @ score
        return float((along**2 / sizes[told]).sum()), float(told.sum())

    def _solve(self, right: Array) -> Array:
        return _solve(self.factor, right)

    def single_readings(self) -> tuple[Array, Array]:
        """How far each entry is off by itself: (Wy)ᵢ and Wᵢᵢ, shape (n_entries,)."""
        used = self.contrasts.columns[:, self.used]
        left = self.contrasts.values - used @ self.estimate
        taken = (used * self._solve(used.T).T).sum(axis=1)
        shown = 1.0 - 1.0 / np.bincount(self.contrasts.zero)[self.contrasts.zero]
        return left, np.where(shown - taken > BLIND, shown - taken, 0.0)


def _solve(factor: Array, right: Array) -> Array:
    """(L Lᵀ)⁻¹ of vectors or columns."""
    from scipy.linalg import cho_solve

    return np.asarray(cho_solve((factor, True), right))


def take_out_common(contrasts: Contrasts) -> Common:
    """Take out all that sessions have in common."""
    used = np.flatnonzero(np.isfinite(contrasts.precision))
    products, scores = contrasts.since(0)
    precision = contrasts.precision[used]
    whole = products[np.ix_(used, used)]
    rounding = ROUNDING * float(np.diag(whole).max(initial=0.0))
    factor: Array = np.asarray(np.linalg.cholesky(whole + np.diag(precision + rounding)))
    estimate = _solve(factor, scores[used])
    square = float(contrasts.values @ contrasts.values - scores[used] @ estimate)
    sizes = 2.0 * np.log(np.diag(factor)).sum() - np.log(precision).sum()
    return Common(contrasts, used, factor, estimate, max(square, 0.0), -0.5 * (square + sizes))


def find_excess_of_machine(contrasts: Contrasts, unsure: NDArray[np.bool_]) -> float:
    """How many times their tolerances a machine's errors are likely to be; 1 where that is enough.

    Args:
        contrasts: The readings, errors at their tolerances.
        unsure: Columns that are errors of the machine, shape (n,).
    """
    common = take_out_common(contrasts)
    if chance_of_excess(common.square, max(contrasts.dof, 1.0)) >= BY_CHANCE:
        return 1.0
    evidence = {1.0: common.log_evidence}
    for excess in EXCESSES:
        found = take_out_common(with_excess(contrasts, unsure, excess)).log_evidence
        evidence[excess] = found - 0.5 * (np.log(excess) / EXCESS_SPREAD) ** 2
    return max(evidence, key=lambda e: evidence[e])


def with_excess(contrasts: Contrasts, unsure: NDArray[np.bool_], excess: float) -> Contrasts:
    """The same with a machine's errors so many times their tolerances."""
    scale = np.where(unsure, excess**-2.0, 1.0)
    return replace(contrasts, precision=contrasts.precision * scale)


def build_contrasts(
    columns: Array,
    values: Array,
    session: Indices,
    *,
    zero: Indices,
    precision: Array,
    flat: NDArray[np.bool_],
) -> Contrasts:
    """Sum the products of columns and readings session by session.

    Args:
        columns: Zeros eliminated, shape (n_entries, n), [standard deviations].
        values: Shape (n_entries,), [standard deviations].
        session: Of each entry, shape (n_entries,).
        zero: Gauge zero of each entry, which was eliminated, shape (n_entries,).
        precision: Of each column; infinite for what sessions have not in common.
        flat: Columns of which nothing is known beforehand, shape (n,).
    """
    own = [session == s for s in range(int(session.max(initial=0)) + 1)]
    return Contrasts(
        columns=columns,
        values=values,
        session=session,
        zero=zero,
        precision=precision,
        flat=flat,
        products=np.array([columns[s].T @ columns[s] for s in own]),
        scores=np.array([columns[s].T @ values[s] for s in own]),
    )
