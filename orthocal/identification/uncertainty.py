"""What the readings say of the parameters, and how well: noise, covariance, identifiability.

Everything is in scaled parameters θ̂ = θ/tolerance. Gauge zeros are eliminated exactly: a zero that
several readings share takes their mean, so what is left of readings and Jacobians is their
deviation from the mean of their zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from orthocal.errors import NotIdentifiableError
from orthocal.measurement.gauge import Observations

Array = NDArray[np.float64]

RANK_THRESHOLD = 1e-10
"""Singular values below this part of the largest count as zero."""

MOST_NAMED = 6
"""Parameters that a message names one by one."""

MOST_LOST = 2
"""Ways to change parameters unseen that a message names."""

BY_CHANCE = 0.01
"""Probability below which residuals that are larger than noise are not put down to chance."""

NoiseSource = Literal["cycles", "residuals", "gauge", "unknown"]


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Standard deviation of one reading of the indicator, and where it is from."""

    sigma: float
    """[m]; NaN if nothing tells."""
    dof: float
    """Degrees of freedom; infinite for a sigma that was given."""
    source: NoiseSource
    cycles_sigma: float
    """From repeated cycles, [m]; NaN without."""
    cycles_dof: int
    residual_sigma: float
    """√(Σ r²/(m − n)), [m]; NaN without degrees of freedom."""
    residual_dof: float

    @property
    def misfit(self) -> bool:
        """Whether residuals are larger than repeated cycles explain: the model is in error."""
        return self.source == "residuals" and self.cycles_dof > 0


def project_out_zeros(
    values: Array, observations: Observations, *, weights: Array | None = None
) -> Array:
    """Values less the mean of those that share their gauge zero, shape (n_entries, ...).

    Args:
        values: Shape (n_entries, ...).
        observations: Which zero each entry has.
        weights: Of the entries in the means, shape (n_entries,); 1 by default.
    """
    flat = values.reshape(len(values), -1)
    own = np.ones(len(values)) if weights is None else weights
    totals = observations.sum_by_zero(flat, own)
    counts = np.bincount(observations.zero, own, minlength=observations.n_zeros)
    means = totals / np.where(counts > 0.0, counts, 1.0)[:, None]
    return np.asarray((flat - means[observations.zero]).reshape(values.shape))


def estimate_repeatability(values: Array, observations: Observations) -> tuple[float, int]:
    """Standard deviation of repeated readings of the same setup in the same posture.

    Within a setup the readings are fitted by one value a posture and one zero a group; what is
    left is noise whatever the machine is like.

    Args:
        values: Readings as single ones, shape (n_entries,), [m].
        observations: Which setup, posture and zero each belongs to.

    Returns:
        Standard deviation [m] (NaN without repetition) and degrees of freedom.
    """
    total, dof = 0.0, 0
    for setup in np.unique(observations.setup):
        entries = np.flatnonzero(observations.setup == setup)
        postures, at_posture = np.unique(observations.posture[entries], return_inverse=True)
        if len(postures) == len(entries):
            continue
        zeros, at_zero = np.unique(observations.zero[entries], return_inverse=True)
        design = np.zeros((len(entries), len(postures) + len(zeros)))
        rows = np.arange(len(entries))
        design[rows, at_posture] = 1.0
        design[rows, len(postures) + at_zero] = 1.0
        solution, _, rank, _ = np.linalg.lstsq(design, values[entries], rcond=1e-9)
        left = values[entries] - design @ solution
        total += float(left @ left)
        dof += len(entries) - int(rank)
    return (float(np.sqrt(total / dof)) if dof else float("nan")), dof


def noise_floor(gauge_sigma: float | None, resolution: float | None) -> float:
    """Standard deviation of a reading that no scatter can argue away, [m].

    What is stated of the gauge, and what rounding to its resolution leaves, 1/√12 of it: readings
    that happen to be alike, or are few, say nothing against either.
    """
    finest = 0.0 if resolution is None else resolution / math.sqrt(12.0)
    return max(gauge_sigma or 0.0, finest)


def estimate_noise(
    *,
    repeatability: tuple[float, int],
    residual_square: float,
    residual_dof: float,
    gauge_sigma: float | None,
    resolution: float | None = None,
) -> Noise:
    """Standard deviation of a reading: from repeated cycles, else from residuals, else the gauge's.

    Residuals win over cycles where an F test finds them too large for the cycles: then the model
    is in error, and the spread of the cycles would flatter every standard deviation. What is stated
    of the gauge is a floor (`noise_floor`): with less it is the gauge's own that counts.

    Args:
        repeatability: From `estimate_repeatability`.
        residual_square: Σ r² of single readings, zeros eliminated, [m²].
        residual_dof: Readings less zeros less (effective) parameters.
        gauge_sigma: The session's `sigma_mm`, [m].
        resolution: Of the gauge, [m].
    """
    cycles_sigma, cycles_dof = repeatability
    floor = noise_floor(gauge_sigma, resolution)
    cycles_sigma = max(cycles_sigma, noise_floor(None, resolution)) if cycles_dof else cycles_sigma
    enough = residual_dof > 0.5
    residual_sigma = math.sqrt(residual_square / residual_dof) if enough else math.nan
    source: NoiseSource
    if cycles_dof > 0:
        known, known_dof = (cycles_sigma, cycles_dof) if cycles_sigma > floor else (floor, 0)
        misfit = False
        if enough and known > 0.0:
            chi_square = residual_square / known**2
            misfit = chance_of_excess(chi_square, residual_dof, cycles_dof=known_dof) < BY_CHANCE
        source = "residuals" if misfit else "cycles"
    elif enough:
        source = "residuals"
    else:
        source = "gauge" if gauge_sigma is not None else "unknown"
    sigma, dof = {
        "cycles": (cycles_sigma, float(cycles_dof)),
        "residuals": (residual_sigma, residual_dof),
        "gauge": (floor, math.inf),
        "unknown": (math.nan, 0.0),
    }[source]
    if sigma < floor:
        source, sigma, dof = "gauge", floor, math.inf
    return Noise(
        sigma, dof, source, cycles_sigma, cycles_dof, residual_sigma, max(residual_dof, 0.0)
    )


def chance_of_excess(chi_square: float, dof: float, *, cycles_dof: float = 0.0) -> float:
    """Probability that noise alone leaves residuals as large, or larger.

    Args:
        chi_square: Σ r²/σ² of single readings, zeros eliminated.
        dof: Degrees of freedom of the residuals.
        cycles_dof: Those of σ, where it is from repeated cycles: an F test of what the residuals
            have beside the cycles' own scatter. 0 for a σ that was given: a χ² test.
    """
    if cycles_dof == 0.0:
        return float(special.chdtrc(dof, chi_square))
    rest, rest_dof = chi_square - cycles_dof, dof - cycles_dof
    if rest_dof <= 0.5 or rest <= 0.0:
        return 1.0
    return float(special.fdtrc(rest_dof, cycles_dof, rest / rest_dof))


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """What the readings say of the parameters: the identification Jacobian, zeros eliminated."""

    factor: Array
    """A matrix with the same product FᵀF as the Jacobian, shape (n, n_free), [m per tolerance]."""
    singular_values: Array
    """Descending, shape (n_free,), padded with zeros, [m per tolerance]."""
    directions: Array
    """Right singular vectors as rows, shape (n_free, n_free)."""

    @property
    def rank(self) -> int:
        """Number of singular values above RANK_THRESHOLD of the largest."""
        largest = self.singular_values[0]
        return int((self.singular_values > RANK_THRESHOLD * largest).sum()) if largest > 0 else 0

    @property
    def identifiable(self) -> NDArray[np.bool_]:
        """Whether the readings alone determine a parameter, shape (n_free,)."""
        null = self.directions[self.rank :]
        return np.asarray(np.sqrt((null**2).sum(axis=0)) < 1e-6)

    def determined(self, *, sigma: float) -> NDArray[np.bool_]:
        """Whether the readings alone tell a parameter better than its tolerance, shape (n_free,).

        Args:
            sigma: Standard deviation of one reading, [m]; if not known, what is structurally
                identifiable counts as told.
        """
        if not sigma > 0.0:
            return self.identifiable
        told = self.singular_values > RANK_THRESHOLD * self.singular_values[0]
        variance = np.zeros_like(self.singular_values)
        variance[told] = (sigma / self.singular_values[told]) ** 2
        return np.asarray(((self.directions**2).T @ variance < 1.0) & self.identifiable)

    def effective_parameters(
        self, *, sigma: float, precision: Array, held: NDArray[np.bool_] | None = None
    ) -> float:
        """Parameters that the readings determine, n − tr(P cov): the rank without a prior.

        Args:
            sigma: Standard deviation of one reading, [m].
            precision: Diagonal of P, what the prior knows: 1 or 0, shape (n_free,).
            held: Parameters that are held where they are, by a bound.
        """
        count = 0 if held is None else int(held.sum())
        if not precision.any():
            return float(self.rank - count)
        covariance = self.covariance(sigma=sigma, precision=precision, held=held)
        return float(len(precision) - count - precision @ np.diag(covariance))

    def covariance(
        self,
        *,
        sigma: float,
        precision: Array,
        held: NDArray[np.bool_] | None = None,
        loss: tuple[float, float] = (1.0, 1.0),
    ) -> Array:
        """Covariance of θ̂, (Jᵀ J/σ² + P)⁻¹, shape (n_free, n_free).

        With a robust loss it is A⁻¹ B A⁻¹, A = a Jᵀ J/σ² + P and B = b Jᵀ J/σ² + P (Huber, Robust
        Statistics, 1981, section 7.6, with a prior).

        Args:
            sigma: Standard deviation of one reading, [m].
            precision: Diagonal of P: 1 or 0, shape (n_free,).
            held: Parameters that are held where they are, by a bound: no covariance.
            loss: a, mean of ρ'', and b, mean square of ρ', of the residuals; 1 for squares.
        """
        free = np.ones(len(precision), dtype=bool) if held is None else ~held
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
    """What readings say of the first parameters, the others known to their tolerances at most.

    Args:
        information: Of all parameters.
        kept: How many are kept.
        sigma: Standard deviation of a reading, [m].
    """
    count = information.factor.shape[1] - kept
    if not count:
        return information
    rows = np.vstack([information.factor / sigma, np.zeros((count, kept + count))])
    rows[-count:, kept:] = np.eye(count)
    taken, _ = np.linalg.qr(rows[:, kept:])
    left = rows[:, :kept] - taken @ (taken.T @ rows[:, :kept])
    return _information(sigma * left)


def decompose(jacobian: Array, observations: Observations) -> Information:
    """Decompose an identification Jacobian.

    Args:
        jacobian: dh/dθ̂, shape (n_entries, n_free), [m per tolerance].
        observations: Which zero each entry has.
    """
    return _information(project_out_zeros(jacobian, observations))


def _information(factor: Array) -> Information:
    if len(factor) > 2 * factor.shape[1]:  # same singular values, far fewer rows
        factor = np.asarray(np.linalg.qr(factor, mode="r"))
    _, values, directions = np.linalg.svd(factor, full_matrices=True)
    padded = np.zeros(factor.shape[1])
    padded[: len(values)] = values
    return Information(factor, padded, directions)


def require_identifiable(
    information: Information,
    names: tuple[str, ...],
    *,
    precision: Array,
    where: str | None = None,
) -> None:
    """Refuse parameters that neither readings nor a prior determine.

    Args:
        information: Of the readings.
        names: Of the free parameters.
        precision: What the prior knows of each: 1 or 0, shape (n_free,).
        where: File, for messages.

    Raises:
        NotIdentifiableError: Naming the parameters.
    """
    if precision.all():
        return
    largest = max(float(information.singular_values[0]), 1e-300)
    stacked = np.vstack([information.factor / largest, np.diag(precision)])
    _, values, directions = np.linalg.svd(stacked, full_matrices=False)
    null = directions[values <= RANK_THRESHOLD * values[0]]
    lost = tuple(n for n, size in zip(names, (null**2).sum(axis=0), strict=True) if size > 1e-12)
    if lost:
        named = ", ".join(lost[:MOST_NAMED])
        more = f" and {len(lost) - MOST_NAMED} more" if len(lost) > MOST_NAMED else ""
        raise NotIdentifiableError(
            f"the readings do not determine {named}{more}: {information.rank} of {len(names)} free "
            f"parameters can be told from them. {_advise_lost(information, names, null)} Or use "
            "tolerances as a prior (--prior), or identify base parameters (--base)",
            parameters=lost,
            where=where,
        )


def _advise_lost(information: Information, names: tuple[str, ...], null: Array) -> str:
    """Which directions no reading sees, and what would help."""
    sizes = np.linalg.norm(information.factor, axis=0)
    unread = sizes <= RANK_THRESHOLD * max(float(sizes.max(initial=0.0)), 1e-300)
    words = []
    if unread.any():
        listed = [n for n, out in zip(names, unread, strict=True) if out]
        rest = f" and {len(listed) - MOST_NAMED} more" if len(listed) > MOST_NAMED else ""
        words.append(
            f"No reading depends on {', '.join(listed[:MOST_NAMED])}{rest}: read the legs that are "
            "missing, in postures along their own axes."
        )
    # each row of the reduced echelon form is one way to change the others that nothing sees
    rest_null = _reduce(null[:, ~unread])
    seen = [n for n, out in zip(names, unread, strict=True) if not out]
    for row in rest_null[:MOST_LOST]:
        order = np.argsort(-np.round(np.abs(row), 9), kind="stable")
        terms = [i for i in order if abs(row[i]) > 1e-6]
        ways = ", ".join(
            f"{seen[i]} {'up' if row[i] * row[terms[0]] > 0 else 'down'}"
            for i in terms[:MOST_NAMED]
        )
        others = f" and {len(terms) - MOST_NAMED} more" if len(terms) > MOST_NAMED else ""
        words.append(f"No reading sees a change of these together: {ways}{others}.")
    return " ".join(words)


def _reduce(rows: Array) -> Array:
    """Reduced echelon form of what rows span: the same for any rows that span it.

    The pivots are the largest columns; of those that are alike, the first.
    """
    _, values, basis = np.linalg.svd(rows, full_matrices=False)
    basis = basis[values > 1e-6]
    left, pivots = np.array(basis), []
    for _ in range(len(basis)):
        sizes = np.linalg.norm(left, axis=0)
        pivots.append(int(np.argmax(sizes >= (1.0 - 1e-6) * sizes.max())))
        along = left[:, pivots[-1]] / sizes[pivots[-1]]
        left -= np.outer(along, along @ left)
    return np.asarray(np.linalg.solve(basis[:, pivots], basis))


def confidence_factor(dof: float, level: float = 0.95) -> float:
    """Standard deviations on either side of an estimate that hold it with a probability."""
    tail = 0.5 + level / 2.0
    if np.isinf(dof):
        return float(special.ndtri(tail))
    return float(special.stdtrit(dof, tail)) if dof > 0 else float("inf")
