"""Information of readings about parameters: rank, covariance, null space.

All quantities are in scaled parameters θ̂ = θ/(prior std), with gauge zeros eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from itertools import compress

import numpy as np

from orthocal.arrays import Array, Mask
from orthocal.errors import NotIdentifiableError
from orthocal.observation.observations import Observations
from orthocal.statistics.zeros import project_out_zeros
from orthocal.text import list_some

RANK_THRESHOLD = 1e-10
"""Ratio to the largest singular value below which others count as zero."""

NULL_COMPONENT = 1e-6
"""Component of a parameter in the null space below which it is a rounding error."""

VAGUE = 1e-8
"""Inverse variance that replaces a missing prior, [1 per prior std²]."""

MAX_LISTED = 6
"""Largest number of parameters that a message lists."""

MAX_DIRECTIONS = 2
"""Largest number of null space directions that a message lists."""

_list = partial(list_some, most=MAX_LISTED)


def square_root(covariance: Array) -> Array:
    """Square roots R of covariances C = R Rᵀ, which may be singular, shape (..., n, n)."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


class Information:
    """Identification Jacobian with gauge zeros eliminated, and its singular value decomposition.

    Args:
        factor: The Jacobian, or another matrix F with the same product FᵀF, shape (n, n_free),
            [m per prior std].

    Attributes:
        factor: Matrix F with the same product FᵀF and at most 2 n_free rows.
    """

    def __init__(self, factor: Array) -> None:
        if len(factor) > 2 * factor.shape[1]:  # same singular values, far fewer rows
            factor = np.asarray(np.linalg.qr(factor, mode="r"))
        self.factor = factor

    @cached_property
    def _decomposition(self) -> tuple[Array, Array]:
        """Singular values and right singular vectors."""
        _, values, directions = np.linalg.svd(self.factor, full_matrices=True)
        return np.append(values, np.zeros(len(directions) - len(values))), directions

    @property
    def singular_values(self) -> Array:
        """Singular values, descending, padded with zeros, shape (n_free,), [m per prior std]."""
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
        return np.asarray(np.sqrt((null**2).sum(axis=0)) < NULL_COMPONENT)

    def determined(self, *, sigma: float) -> Mask:
        """Mask of the parameters whose standard deviation from the readings is below the prior one.

        Args:
            sigma: Standard deviation of one reading, [m]. If it is NaN or 0, the mask contains all
                identifiable parameters.

        Returns:
            Mask, shape (n_free,).
        """
        if not sigma > 0.0:
            return self.identifiable
        nonzero = self.singular_values > RANK_THRESHOLD * self.singular_values[0]
        variance = np.zeros_like(self.singular_values)
        variance[nonzero] = (sigma / self.singular_values[nonzero]) ** 2
        return np.asarray(((self.directions**2).T @ variance < 1.0) & self.identifiable)

    def posterior(
        self,
        *,
        sigma: float,
        precision: Array,
        at_bound: Mask | None = None,
        loss: tuple[float, float] = (1.0, 1.0),
    ) -> Posterior:
        """Posterior of θ̂.

        Args:
            sigma: Standard deviation of one reading, [m].
            precision: Diagonal of P⁻¹: 1 or 0, shape (n_free,).
            at_bound: Mask of the parameters at a bound, shape (n_free,); none by default.
            loss: Means of the loss function's derivatives (see `Posterior`).
        """
        free = np.ones(len(precision), dtype=np.bool_) if at_bound is None else ~at_bound
        return Posterior(self.factor, sigma, precision, free, loss)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Normal posterior of θ̂ from readings and priors.

    With A = a Jᵀ J/σ² + P⁻¹ and B = b Jᵀ J/σ² + P⁻¹, the covariance is A⁻¹ B A⁻¹ (Huber, Robust
    Statistics, 1981, section 7.6, with a prior). Squares have a = b = 1. Rows and columns of
    parameters at a bound are 0 in all matrices.
    """

    factor: Array
    """Factor of JᵀJ, shape (n, n_free), [m per prior std]."""
    sigma: float
    """Standard deviation of one reading, [m]."""
    precision: Array
    """Diagonal of P⁻¹: 1 or 0, shape (n_free,)."""
    free: Mask
    """Mask of the parameters that are not at a bound, shape (n_free,)."""
    loss: tuple[float, float]
    """Mean a of ρ'' and mean square b of ρ' over the residuals; (1, 1) for squares."""

    @cached_property
    def inverse_normal(self) -> Array:
        """Inverse curvature A⁻¹ of the objective, shape (n_free, n_free)."""
        free = self.free
        rows = np.sqrt(self.loss[0]) * (self.factor[:, free] / self.sigma)
        inverse = _inverse_square(np.vstack([rows, np.diag(np.sqrt(self.precision[free]))]))
        result = np.zeros((len(free), len(free)))
        result[np.ix_(free, free)] = 0.5 * (inverse + inverse.T)
        return result

    @property
    def covariance(self) -> Array:
        """Covariance of θ̂, shape (n_free, n_free)."""
        if self.loss == (1.0, 1.0):
            return self.inverse_normal
        return self.noise_covariance + self.prior_covariance(np.ones_like(self.free))

    @property
    def noise_covariance(self) -> Array:
        """Part of `covariance` from noise, b A⁻¹ Jᵀ J A⁻¹/σ², shape (n_free, n_free)."""
        root = np.sqrt(self.loss[1]) * self.inverse_normal @ self.factor.T / self.sigma
        return np.asarray(root @ root.T)

    def prior_covariance(self, priors: Mask) -> Array:
        """Part of `covariance` from some of the priors, A⁻¹ P⁻¹ A⁻¹, shape (n_free, n_free).

        The priors draw the estimate towards their means. This part grows with their variances. Over
        all priors it is `covariance` less `noise_covariance`.

        Args:
            priors: Mask of the parameters whose priors count, shape (n_free,).
        """
        root = self.inverse_normal[:, priors] * np.sqrt(self.precision[priors])
        return np.asarray(root @ root.T)

    @property
    def effective_parameters(self) -> float:
        """Effective number of parameters for squares, n − tr(P⁻¹ C); the rank without a prior."""
        if not self.precision.any():
            return float(Information(self.factor).rank - (~self.free).sum())
        return float(self.free.sum() - self.precision @ np.diag(self.inverse_normal))


def _inverse_square(matrix: Array) -> Array:
    """(MᵀM)⁻¹ without forming MᵀM; infinite if M does not have full rank."""
    r = np.linalg.qr(matrix, mode="r")
    diagonal = np.abs(np.diag(r))
    if not diagonal.size:
        return np.zeros((0, 0))
    if diagonal.min() <= np.finfo(np.float64).eps * diagonal.max():
        return np.full((len(r), len(r)), np.inf)
    half = np.linalg.solve(r, np.eye(len(r)))
    return np.asarray(half @ half.T)


def marginalise(information: Information, n_first: int, *, sigma: float) -> Information:
    """Information about the first parameters after marginalising over the others with their priors.

    Args:
        information: Information about all parameters.
        n_first: Number of the first parameters.
        sigma: Standard deviation of a reading, [m].
    """
    n_others = information.factor.shape[1] - n_first
    if not n_others:
        return information
    rows = np.vstack([information.factor / sigma, np.zeros((n_others, n_first + n_others))])
    rows[-n_others:, n_first:] = np.eye(n_others)
    basis, _ = np.linalg.qr(rows[:, n_first:])
    remaining = rows[:, :n_first] - basis @ (basis.T @ rows[:, :n_first])
    return Information(sigma * remaining)


def assume_others_known(information: Information, n_first: int) -> Information:
    """Information about the first parameters if all others are known exactly."""
    return Information(information.factor[:, :n_first])


def count_others(information: Information, n_first: int, *, sigma: float) -> float:
    """Effective number of the other parameters, with their priors and none of the first ones.

    With F = (F₁ F₂) and P⁻¹ = diag(0, I) the hat matrix is H = F (FᵀF + σ² P⁻¹)⁻¹ Fᵀ. The number is
    tr H − rank F₁ = Σ s²/(s² + σ²). The s are the singular values of the part of F₂ that is
    orthogonal to the columns of F₁.

    Args:
        information: Information about all parameters.
        n_first: Number of the first parameters.
        sigma: Standard deviation of a reading, [m].
    """
    first, others = np.hsplit(information.factor, [n_first])
    basis, values, _ = np.linalg.svd(first, full_matrices=False)
    basis = basis[:, values > RANK_THRESHOLD * values.max(initial=0.0)]
    s = np.linalg.svd(others - basis @ (basis.T @ others), compute_uv=False)
    return float((s**2 / (s**2 + sigma**2)).sum())


def decompose(jacobian: Array, observations: Observations) -> Information:
    """Decompose an identification Jacobian.

    Args:
        jacobian: dh/dθ̂, shape (n_entries, n_free), [m per prior std].
        observations: Entries with their gauge zeros.
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
        precision: Diagonal of P⁻¹: 1 or 0, shape (n_free,).
        where: File, for messages.

    Raises:
        NotIdentifiableError: If a parameter is not identifiable; names the parameters.
    """
    if precision.all():
        return
    largest = max(float(information.singular_values[0]), 1e-300)
    stacked = np.vstack([information.factor / largest, np.diag(precision)])
    _, values, directions = np.linalg.svd(stacked, full_matrices=False)
    null = directions[values <= RANK_THRESHOLD * values[0], : len(names)]
    undetermined = tuple(compress(names, (null**2).sum(axis=0) > NULL_COMPONENT**2))
    if undetermined:
        information = assume_others_known(information, len(names))
        advice = _advise(information, names, null)
        raise NotIdentifiableError(
            f"the readings do not determine {_list(undetermined)}: {information.rank} of "
            f"{len(names)} free parameters are identifiable. {advice} Or use tolerances as a prior "
            "(--prior), or identify base parameters (--base)",
            parameters=undetermined,
            where=where,
        )


def _advise(information: Information, names: tuple[str, ...], null: Array) -> str:
    """Advice about readings that would determine the parameters.

    Args:
        information: Information about the parameters.
        names: Names of the parameters.
        null: Basis of their null space as rows, shape (k, n).
    """
    norms = np.linalg.norm(information.factor, axis=0)
    without_effect = norms <= RANK_THRESHOLD * max(float(norms.max(initial=0.0)), 1e-300)
    sentences = []
    if without_effect.any():
        sentences.append(
            f"No reading depends on {_list(list(compress(names, without_effect)))}: read the legs "
            "that are missing, in postures along their own axes."
        )
    # each row of the reduced echelon form is one unobservable change of the others
    null_rows = _reduce(null[:, ~without_effect])
    other_names = list(compress(names, ~without_effect))
    for row in null_rows[:MAX_DIRECTIONS]:
        # rounded, so that rounding errors do not decide the order of equal components
        order = np.argsort(-np.round(np.abs(row), 9), kind="stable")
        terms = [i for i in order if abs(row[i]) > NULL_COMPONENT]
        changes = [
            f"{other_names[i]} {'up' if row[i] * row[terms[0]] > 0 else 'down'}" for i in terms
        ]
        sentences.append(f"No reading depends on this combined change: {_list(changes)}.")
    return " ".join(sentences)


def _reduce(rows: Array) -> Array:
    """Reduced echelon form of the space that is spanned by rows.

    The pivots are the columns with the largest norms; of equal ones the first.
    """
    _, values, basis = np.linalg.svd(rows, full_matrices=False)
    basis = basis[values > 1e-6]
    remaining, pivots = np.array(basis), []
    for _ in range(len(basis)):
        norms = np.linalg.norm(remaining, axis=0)
        pivots.append(int(np.argmax(norms >= (1.0 - 1e-6) * norms.max())))
        direction = remaining[:, pivots[-1]] / norms[pivots[-1]]
        remaining -= np.outer(direction, direction @ remaining)
    return np.asarray(np.linalg.solve(basis[:, pivots], basis))
