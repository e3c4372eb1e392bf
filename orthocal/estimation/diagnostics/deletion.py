"""Deletion diagnostics: a reading or a setup against the prediction from all the others.

Deleting a reading is equivalent to adding an unknown error to it. With y ~ (X θ, σ² S), X with a
column for every gauge zero and the prior as P,

    M = S⁻¹ − S⁻¹ X A⁻¹ Xᵀ S⁻¹,  A = Xᵀ S⁻¹ X + σ² P

this error is estimated as γᵢ = (M y)ᵢ/Mᵢᵢ with variance σ²/Mᵢᵢ, and deleting the reading changes
the estimate by −A⁻¹ Xᵀ S⁻¹ eᵢ γᵢ (Cook and Weisberg, Residuals and Influence, 1982, 2.2).
Differences of one setup and cycle share postures: S has a block for each group.

Deleting a setup s changes the estimate, to first order about the solution, by

    δ = −A₋ₛ⁻¹ Fₛᵀ rₛ/σ²,  A₋ₛ = FᵀF/σ² + P − FₛᵀFₛ/σ²

with F the Jacobian and r the residuals, zeros eliminated. The setup is then missed by rₛ − Fₛ δ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.errors import NotIdentifiableError
from orthocal.estimation.fit import Fit, require_determined
from orthocal.estimation.weighting import SMALLEST_SIGMA
from orthocal.observation.observations import Observations
from orthocal.statistics.chance import confidence_factor
from orthocal.statistics.information import Information, decompose
from orthocal.statistics.zeros import project_out_zeros

MIN_REDUNDANCY = 1e-9
"""Redundancy of a row, relative to its weight, below which no other row predicts it."""

MIN_REMAINING_SQUARE = 1e-6
"""Part of the sum of squares that remains at least when a row is deleted."""

OUTLIER_PROBABILITY = 0.01
"""Probability that a session without wrong readings has an outlier."""

LARGEST_CRITICAL = 1e6
"""Studentised residual above which a threshold counts as infinite."""


@dataclass(frozen=True, slots=True, eq=False)
class Diagnostics:
    """Deletion diagnostics of every row."""

    studentised: Array
    """Studentised deleted residual, shape (n_rows,). Noise from residuals is estimated without the
    row. NaN if no other row predicts it."""
    deleted: Array
    """Deleted residual, [m]: measured minus predicted from the others."""
    influence: Array
    """Largest change of an error of the machine when the row is deleted, in its standard
    deviations."""
    influenced: Indices
    """Index of that parameter."""
    critical: float
    """Studentised residual above which a row is an outlier."""

    @property
    def suspicious(self) -> Indices:
        """Outliers, the largest first."""
        size = np.nan_to_num(np.abs(self.studentised))
        rows = np.flatnonzero(size > self.critical)
        return np.asarray(rows[np.argsort(-size[rows])])


def diagnose_readings(fit: Fit) -> Diagnostics:
    """Deletion diagnostics of every reading, to first order about the solution."""
    problem, o = fit.problem, fit.problem.observations
    count, sigma = o.plus.size, fit.noise.sigma
    if not (np.isfinite(sigma) and sigma >= SMALLEST_SIGMA):
        undefined, zeros = np.full(count, np.nan), np.zeros(count)
        return Diagnostics(undefined, undefined, zeros, zeros.astype(np.int64), np.inf)
    inverse = _weighted_information(fit).covariance(
        sigma=sigma, precision=problem.prior_precision, held=fit.held
    )
    jacobian, residual, weights = o.rows(fit.jacobian), o.rows(fit.residual), fit.weights[o.plus]
    sensitivity, projected, diagonal = np.empty_like(jacobian), np.empty(count), np.empty(count)
    for zero in range(o.n_zeros):
        group = np.flatnonzero(o.zero[o.plus] == zero)
        precision = _inverse_covariance(o, group)
        if precision is None:
            w = weights[group]
            mean = (w @ jacobian[group]) / w.sum()
            sensitivity[group] = jacobian[group] - mean
            # the weight of a robust loss is not part of the residual
            projected[group], diagonal[group] = residual[group], 1.0 - w / w.sum()
        else:
            sensitivity[group] = precision @ jacobian[group]
            projected[group], diagonal[group] = precision @ residual[group], np.diag(precision)
            weights[group] = 1.0
    gain = sensitivity @ inverse / sigma**2
    redundancy = diagonal - weights * (gain * sensitivity).sum(axis=1)
    redundancy[redundancy < MIN_REDUNDANCY * diagonal] = np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        deleted = projected / redundancy
        share = projected**2 / redundancy
    spread, dof = _spread_without(fit, share)
    n = problem.n_machine
    std = np.sqrt(np.diag(inverse))[:n]
    with np.errstate(divide="ignore", invalid="ignore"):
        shifts = np.abs(gain[:, :n] * (weights * deleted)[:, None])
        shifts /= np.where(std > 0.0, std, np.inf)
    influenced = np.nan_to_num(shifts).argmax(axis=1)
    return Diagnostics(
        studentised=deleted * np.sqrt(redundancy) / spread,
        deleted=deleted,
        influence=np.nan_to_num(shifts[np.arange(count), influenced]),
        influenced=influenced,
        critical=_critical(dof, count),
    )


def _critical(dof: float, count: int) -> float:
    """Studentised residual above which one of `count` readings is an outlier; infinite for none.

    With very few degrees of freedom the quantile of Student's distribution is about 1e28.
    """
    factor = confidence_factor(dof, 1.0 - OUTLIER_PROBABILITY / count)
    return factor if factor < LARGEST_CRITICAL else np.inf


def _weighted_information(fit: Fit) -> Information:
    """Information of the readings with the weights of a robust loss."""
    if not fit.loss.robust:
        return fit.information
    centred = project_out_zeros(fit.jacobian, fit.problem.observations, weights=fit.weights)
    return Information(np.sqrt(fit.weights)[:, None] * centred)


def _inverse_covariance(o: Observations, group: Indices) -> Array | None:
    """Inverse covariance of differences that share postures, for readings of variance 1.

    None for single readings, which share only their gauge zero.
    """
    if o.minus[group[0]] < 0:
        return None
    entries, position = np.unique([o.plus[group], o.minus[group]], return_inverse=True)
    position = position.reshape(2, -1)
    incidence = np.zeros((group.size, entries.size))
    rows = np.arange(group.size)
    incidence[rows, position[0]], incidence[rows, position[1]] = 1.0, -1.0
    return np.asarray(np.linalg.inv(incidence @ incidence.T))


def _spread_without(fit: Fit, share: Array) -> tuple[Array, float]:
    """Standard deviation of a reading without each row, and its degrees of freedom."""
    noise = fit.noise
    if noise.source != "residuals" or fit.loss.robust:
        return np.full(share.size, noise.sigma), noise.dof
    dof = noise.dof - 1.0
    if dof <= 0.0:
        return np.full(share.size, np.nan), 0.0
    # to first order the share of an outlier can exceed the total
    total = noise.sigma**2 * noise.dof
    return np.sqrt(np.maximum(total - share, MIN_REMAINING_SQUARE * total) / dof), dof


def predict_unseen(fit: Fit) -> Array:
    """Errors of predicting the rows of every setup from all other setups.

    Returns:
        Measured minus predicted, each with its best gauge zeros, shape (n_rows,), [m]; NaN where
        the other setups do not determine the parameters.
    """
    problem, o = fit.problem, fit.problem.observations
    errors = np.full(o.plus.size, np.nan)
    setups = np.unique(o.setup)
    if setups.size < 2:
        return errors
    root = np.sqrt(fit.weights)[:, None]
    factor = root * project_out_zeros(fit.jacobian, o, weights=fit.weights)
    pull = root[:, 0] * fit.residual / fit.sigma**2
    free = ~fit.held
    precision = np.diag(problem.prior_precision)[np.ix_(free, free)]
    for setup in setups:
        deleted = o.setup == setup
        if not problem.prior_precision.all():
            # at the reference: at the solution unobservable directions look slightly observable
            jacobian = np.where(deleted[:, None], 0.0, fit.linearisation.jacobian)
            try:
                require_determined(problem, decompose(jacobian, o))
            except NotIdentifiableError:
                continue  # stays unknown
        others = factor[~deleted][:, free] / fit.sigma
        change = np.zeros(problem.n_free)
        change[free] = -np.linalg.solve(
            others.T @ others + precision, factor[deleted][:, free].T @ pull[deleted]
        )
        missed = project_out_zeros(fit.residual - fit.jacobian @ change, o)
        rows = deleted[o.plus]
        errors[rows] = o.rows(missed)[rows]
    return errors
