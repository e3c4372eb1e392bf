"""Information of readings about parameters: rank, covariance, null space.

All quantities are in scaled parameters θ̂ = θ/(prior std), with gauge zeros eliminated.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from orthocal.arrays import Array, Mask
from orthocal.errors import NotIdentifiableError
from orthocal.observation.observations import Observations
from orthocal.statistics.zeros import project_out_zeros

RANK_THRESHOLD = 1e-10
"""Singular values below this part of the largest count as zero."""

VAGUE = 1e-8
"""Inverse variance of a parameter without a prior, [1 per prior std²]."""

MOST_NAMED = 6
"""Largest number of parameters that a message lists."""

MOST_LOST = 2
"""Largest number of null space directions that a message lists."""


class Information:
    """Identification Jacobian, zeros eliminated, with its singular value decomposition.

    Args:
        factor: The Jacobian, or another matrix with the same product FᵀF, shape (n, n_free),
            [m per prior std].

    Attributes:
        factor: Such a matrix with at most 2 n_free rows.
    """

    def __init__(self, factor: Array) -> None:
        if len(factor) > 2 * factor.shape[1]:  # same singular values, far fewer rows
            factor = np.asarray(np.linalg.qr(factor, mode="r"))
        self.factor = factor

    @cached_property
    def _decomposition(self) -> tuple[Array, Array]:
        _, values, directions = np.linalg.svd(self.factor, full_matrices=True)
        return np.append(values, np.zeros(len(directions) - len(values))), directions

    @property
    def singular_values(self) -> Array:
        """Descending, shape (n_free,), padded with zeros, [m per prior std]."""
        return self._decomposition[0]

    @property
    def directions(self) -> Array:
        """Right singular vectors as rows, shape (n_free, n_free)."""
        return self._decomposition[1]

    @property
    def rank(self) -> int:
        """Number of singular values above RANK_THRESHOLD of the largest."""
        largest = self.singular_values[0]
        return int((self.singular_values > RANK_THRESHOLD * largest).sum()) if largest > 0 else 0

    @property
    def identifiable(self) -> Mask:
        """Mask of the parameters that the readings alone determine, shape (n_free,)."""
        null = self.directions[self.rank :]
        return np.asarray(np.sqrt((null**2).sum(axis=0)) < 1e-6)

    def determined(self, *, sigma: float) -> Mask:
        """Mask of the parameters with a standard deviation below the prior one without prior.

        Args:
            sigma: Standard deviation of one reading, [m]; NaN if unknown: then all structurally
                identifiable parameters count.

        Returns:
            Shape (n_free,).
        """
        if not sigma > 0.0:
            return self.identifiable
        seen = self.singular_values > RANK_THRESHOLD * self.singular_values[0]
        variance = np.zeros_like(self.singular_values)
        variance[seen] = (sigma / self.singular_values[seen]) ** 2
        return np.asarray(((self.directions**2).T @ variance < 1.0) & self.identifiable)

    def effective_parameters(
        self, *, sigma: float, precision: Array, at_bound: Mask | None = None
    ) -> float:
        """Effective number of parameters, n − tr(P⁻¹ cov): the rank without a prior.

        Args:
            sigma: Standard deviation of one reading, [m].
            precision: Diagonal of P⁻¹: 1 or 0, shape (n_free,).
            at_bound: Mask of the parameters at a bound.
        """
        count = 0 if at_bound is None else int(at_bound.sum())
        if not precision.any():
            return float(self.rank - count)
        covariance = self.covariance(sigma=sigma, precision=precision, at_bound=at_bound)
        return float(len(precision) - count - precision @ np.diag(covariance))

    def covariance(
        self,
        *,
        sigma: float,
        precision: Array,
        at_bound: Mask | None = None,
        loss: tuple[float, float] = (1.0, 1.0),
    ) -> Array:
        """Covariance of θ̂, (Jᵀ J/σ² + P⁻¹)⁻¹, shape (n_free, n_free).

        With a robust loss it is A⁻¹ B A⁻¹, A = a Jᵀ J/σ² + P⁻¹ and B = b Jᵀ J/σ² + P⁻¹ (Huber,
        Robust Statistics, 1981, section 7.6, with a prior).

        Args:
            sigma: Standard deviation of one reading, [m].
            precision: Diagonal of P⁻¹: 1 or 0, shape (n_free,).
            at_bound: Mask of the parameters at a bound, which have no covariance.
            loss: a, mean of ρ'', and b, mean square of ρ', of the residuals; 1 for squares.
        """
        free = np.ones(len(precision), dtype=bool) if at_bound is None else ~at_bound
        rows = self.factor[:, free] / sigma
        gain, noise = loss
        prior = np.diag(np.sqrt(precision[free]))
        stacked = np.vstack([np.sqrt(gain) * rows, prior])
        inverse = _inverse_square(stacked)
        if loss != (1.0, 1.0):
            spread = np.hstack([np.sqrt(noise) * inverse @ rows.T, inverse @ prior])
            inverse = spread @ spread.T
        result = np.zeros((len(free), len(free)))
        result[np.ix_(free, free)] = 0.5 * (inverse + inverse.T)
        return result

    def noise_covariance(
        self,
        *,
        sigma: float,
        precision: Array,
        at_bound: Mask | None = None,
        loss: tuple[float, float] = (1.0, 1.0),
    ) -> Array:
        """Part of `covariance` that is due to noise, b A⁻¹ Jᵀ J A⁻¹/σ², shape (n_free, n_free).

        Args:
            sigma: Standard deviation of one reading, [m].
            precision: Diagonal of P⁻¹: 1 or 0, shape (n_free,).
            at_bound: Mask of the parameters at a bound, which have no covariance.
            loss: a, mean of ρ'', and b, mean square of ρ', of the residuals; 1 for squares.
        """
        gain, noise = loss
        inverse = self.covariance(
            sigma=sigma / np.sqrt(gain), precision=precision, at_bound=at_bound
        )  # A⁻¹
        spread = np.sqrt(noise) * inverse @ self.factor.T / sigma
        return np.asarray(spread @ spread.T)


def _inverse_square(matrix: Array) -> Array:
    """(MᵀM)⁻¹ without forming MᵀM; infinite where M has not full rank."""
    r = np.linalg.qr(matrix, mode="r")
    diagonal = np.abs(np.diag(r))
    if not diagonal.size:
        return np.zeros((0, 0))
    if diagonal.min() <= np.finfo(np.float64).eps * diagonal.max():
        return np.full((len(r), len(r)), np.inf)
    half = np.linalg.solve(r, np.eye(len(r)))
    return np.asarray(half @ half.T)


def marginalise(information: Information, kept: int, *, sigma: float) -> Information:
    """Information about the first parameters, the others marginalised over their priors.

    Args:
        information: Information about all parameters.
        kept: Number of the first parameters.
        sigma: Standard deviation of a reading, [m].
    """
    count = information.factor.shape[1] - kept
    if not count:
        return information
    rows = np.vstack([information.factor / sigma, np.zeros((count, kept + count))])
    rows[-count:, kept:] = np.eye(count)
    basis, _ = np.linalg.qr(rows[:, kept:])
    remaining = rows[:, :kept] - basis @ (basis.T @ rows[:, :kept])
    return Information(sigma * remaining)


def take_for_known(information: Information, kept: int) -> Information:
    """Information about the first parameters, all others known exactly."""
    return Information(information.factor[:, :kept])


def decompose(jacobian: Array, observations: Observations) -> Information:
    """Decompose an identification Jacobian.

    Args:
        jacobian: dh/dθ̂, shape (n_entries, n_free), [m per prior std].
        observations: Zeros of the entries.
    """
    return Information(project_out_zeros(jacobian, observations))


def require_identifiable(
    information: Information,
    names: tuple[str, ...],
    *,
    precision: Array,
    where: str | None = None,
) -> None:
    """Refuse parameters that neither readings nor a prior determine.

    Args:
        information: Information of the readings.
        names: Names of the first parameters, which are checked.
        precision: Diagonal of the prior's precision: 1 or 0, shape (n_free,).
        where: File, for messages.

    Raises:
        NotIdentifiableError: Naming the parameters.
    """
    if precision.all():
        return
    largest = max(float(information.singular_values[0]), 1e-300)
    stacked = np.vstack([information.factor / largest, np.diag(precision)])
    _, values, directions = np.linalg.svd(stacked, full_matrices=False)
    null = directions[values <= RANK_THRESHOLD * values[0], : len(names)]
    lost = tuple(n for n, size in zip(names, (null**2).sum(axis=0), strict=True) if size > 1e-12)
    if lost:
        information = take_for_known(information, len(names))
        advice = _advise_lost(information, names, null)
        raise NotIdentifiableError(
            f"the readings do not determine {_list_some(lost)}: {information.rank} of "
            f"{len(names)} free parameters are identifiable. {advice} Or use tolerances as a prior "
            "(--prior), or identify base parameters (--base)",
            parameters=lost,
            where=where,
        )


def _advise_lost(information: Information, names: tuple[str, ...], null: Array) -> str:
    """Advice on the null space of the readings."""
    sizes = np.linalg.norm(information.factor, axis=0)
    unread = sizes <= RANK_THRESHOLD * max(float(sizes.max(initial=0.0)), 1e-300)
    words = []
    if unread.any():
        unread_names = [n for n, out in zip(names, unread, strict=True) if out]
        words.append(
            f"No reading depends on {_list_some(unread_names)}: read the legs that are "
            "missing, in postures along their own axes."
        )
    # each row of the reduced echelon form is one unobservable change of the others
    null_rows = _reduce(null[:, ~unread])
    seen = [n for n, out in zip(names, unread, strict=True) if not out]
    for row in null_rows[:MOST_LOST]:
        order = np.argsort(-np.round(np.abs(row), 9), kind="stable")
        terms = [i for i in order if abs(row[i]) > 1e-6]
        ways = [f"{seen[i]} {'up' if row[i] * row[terms[0]] > 0 else 'down'}" for i in terms]
        words.append(f"No reading depends on this combined change: {_list_some(ways)}.")
    return " ".join(words)


def _list_some(items: Sequence[str]) -> str:
    more = f" and {len(items) - MOST_NAMED} more" if len(items) > MOST_NAMED else ""
    return ", ".join(items[:MOST_NAMED]) + more


def _reduce(rows: Array) -> Array:
    """Reduced echelon form of the space that rows span.

    The pivots are the largest columns; of equal ones, the first.
    """
    _, values, basis = np.linalg.svd(rows, full_matrices=False)
    basis = basis[values > 1e-6]
    remaining, pivots = np.array(basis), []
    for _ in range(len(basis)):
        sizes = np.linalg.norm(remaining, axis=0)
        pivots.append(int(np.argmax(sizes >= (1.0 - 1e-6) * sizes.max())))
        along = remaining[:, pivots[-1]] / sizes[pivots[-1]]
        remaining -= np.outer(along, along @ remaining)
    return np.asarray(np.linalg.solve(basis[:, pivots], basis))


def whiten(values: Array, spread: Array, *, sigma: float) -> Array:
    """Whitened values V^(-1/2) y, V = σ² I + S Sᵀ.

    Args:
        values: Shape (n,) or (n, k).
        spread: S, root of the common covariance, shape (n, m).
        sigma: Independent standard deviation of each value, [as the values].
    """
    directions, sizes, _ = np.linalg.svd(spread, full_matrices=False)
    shrunk = 1.0 - 1.0 / np.sqrt(1.0 + (sizes / sigma) ** 2)
    common = (directions.T @ values).T * shrunk
    return np.asarray((values - directions @ common.T) / sigma)
