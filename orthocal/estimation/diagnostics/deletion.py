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
from numpy.typing import NDArray

from orthocal.errors import NotIdentifiableError
from orthocal.estimation.fit import Fit, require_determined
from orthocal.estimation.weighting import SMALLEST_SIGMA
from orthocal.observation.observations import Observations
from orthocal.statistics.chance import confidence_factor
from orthocal.statistics.information import Information, decompose
from orthocal.statistics.zeros import project_out_zeros

Array = NDArray[np.float64]

BLIND = 1e-9
"""Part of a row's own weight below which no other row says anything of it."""

LEAST_REST = 1e-6
"""Part of the sum of squares that is left at least when a row is taken out."""

SUSPICION = 0.01
"""Probability that any of the readings of a session that is sound is called suspicious."""

LARGEST_CRITICAL = 1e6
"""Studentised residuals that are never reached; a threshold beyond is none."""


@dataclass(frozen=True, slots=True, eq=False)
class Diagnostics:
    """Every row of the readings held against all the others."""

    studentised: Array
    """Error of a row as all others see it, in its standard deviations, shape (n_rows,). The noise
    is estimated without the row where it is from residuals at all; NaN where no other row says
    anything of it."""
    deleted: Array
    """That error, [m]: measured less what the others predict."""
    influence: Array
    """Largest change of an error of the machine when the row is left out, in its standard
    deviations."""
    influenced: NDArray[np.int64]
    """Which parameter that is."""
    critical: float
    """Studentised residuals beyond this are suspicious."""

    @property
    def suspicious(self) -> NDArray[np.int64]:
        """Rows that are suspicious, the worst first."""
        size = np.nan_to_num(np.abs(self.studentised))
        rows = np.flatnonzero(size > self.critical)
        return np.asarray(rows[np.argsort(-size[rows])])


def diagnose_readings(fit: Fit) -> Diagnostics:
    """Hold every reading against all the others, to first order about the solution."""
    problem, o = fit.problem, fit.problem.observations
    count, sigma = o.plus.size, fit.noise.sigma
    if not (np.isfinite(sigma) and sigma >= SMALLEST_SIGMA):
        nothing, zeros = np.full(count, np.nan), np.zeros(count)
        return Diagnostics(nothing, nothing, zeros, zeros.astype(np.int64), np.inf)
    inverse = _weighted_information(fit).covariance(
        sigma=sigma, precision=problem.prior_precision, held=fit.held
    )
    slopes, residual, weights = o.rows(fit.jacobian), o.rows(fit.residual), fit.weights[o.plus]
    sensitivity, projected, own = np.empty_like(slopes), np.empty(count), np.empty(count)
    for zero in range(o.n_zeros):
        group = np.flatnonzero(o.zero[o.plus] == zero)
        precision = _inverse_covariance(o, group)
        if precision is None:
            w = weights[group]
            mean = (w @ slopes[group]) / w.sum()
            sensitivity[group] = slopes[group] - mean
            # in its own weight: what a robust loss has taken from a reading is not held against it
            projected[group], own[group] = residual[group], 1.0 - w / w.sum()
        else:
            sensitivity[group] = precision @ slopes[group]
            projected[group], own[group] = precision @ residual[group], np.diag(precision)
            weights[group] = 1.0
    moved = sensitivity @ inverse / sigma**2
    left = own - weights * (moved * sensitivity).sum(axis=1)
    left[left < BLIND * own] = np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        deleted = projected / left
        share = projected**2 / left
    spread, dof = _spread_without(fit, share)
    n = problem.n_machine
    std = np.sqrt(np.diag(inverse))[:n]
    with np.errstate(divide="ignore", invalid="ignore"):
        shifts = np.abs(moved[:, :n] * (weights * deleted)[:, None])
        shifts /= np.where(std > 0.0, std, np.inf)
    influenced = np.nan_to_num(shifts).argmax(axis=1)
    return Diagnostics(
        studentised=deleted * np.sqrt(left) / spread,
        deleted=deleted,
        influence=np.nan_to_num(shifts[np.arange(count), influenced]),
        influenced=influenced,
        critical=_critical(dof, count),
    )


def _critical(dof: float, count: int) -> float:
    """Studentised residual beyond which one of so many readings is suspicious; infinite for none.

    With hardly any degrees of freedom Student's distribution has no end: 1e28 is none either.
    """
    found = confidence_factor(dof, 1.0 - SUSPICION / count)
    return found if found < LARGEST_CRITICAL else np.inf


def _weighted_information(fit: Fit) -> Information:
    """What the readings say in the weights that a robust loss has left them."""
    if not fit.loss.robust:
        return fit.information
    o, weights = fit.problem.observations, fit.weights
    centred = project_out_zeros(fit.jacobian, o, weights=weights)
    return Information(
        np.sqrt(weights)[:, None] * centred,
        fit.information.singular_values,
        fit.information.directions,
    )


def _inverse_covariance(o: Observations, group: NDArray[np.int64]) -> Array | None:
    """Inverse covariance of differences that share postures, for readings of variance 1.

    None for readings as shown, which share nothing but their gauge zero.
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
    """Standard deviation of a reading as estimated without each row, and degrees of freedom."""
    noise = fit.noise
    if noise.source != "residuals" or fit.loss.robust:
        return np.full(share.size, noise.sigma), noise.dof
    dof = noise.dof - 1.0
    if dof <= 0.0:
        return np.full(share.size, np.nan), 0.0
    # to first order a reading that is far out can take more than there is
    total = noise.sigma**2 * noise.dof
    return np.sqrt(np.maximum(total - share, LEAST_REST * total) / dof), dof


def predict_unseen(fit: Fit) -> Array:
    """Errors of predicting the rows of every setup from all other setups.

    Returns:
        Measured less predicted, each with its best gauge zeros, shape (n_rows,), [m]; NaN where
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
        out = o.setup == setup
        if not problem.prior_precision.all():
            # at the reference: at the solution what is not seen looks faintly seen
            left = np.where(out[:, None], 0.0, fit.linearisation.slopes)
            try:
                require_determined(problem, decompose(left, o))
            except NotIdentifiableError:
                continue  # stays unknown
        others = factor[~out][:, free] / fit.sigma
        change = np.zeros(problem.n_free)
        change[free] = -np.linalg.solve(
            others.T @ others + precision, factor[out][:, free].T @ pull[out]
        )
        missed = project_out_zeros(fit.residual - fit.jacobian @ change, o)
        rows = out[o.plus]
        errors[rows] = o.rows(missed)[rows]
    return errors
