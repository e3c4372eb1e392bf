"""Deletion diagnostics: readings and setups compared with the prediction from all others.

Deleting a reading is equivalent to adding an unknown error to it. Readings y have the mean X θ and
the covariance σ² S. X has a column for every free gauge zero. With the prior precision P⁻¹ and

    M = S⁻¹ − S⁻¹ X A⁻¹ Xᵀ S⁻¹,  A = Xᵀ S⁻¹ X + σ² P⁻¹

the error of reading i is estimated as γᵢ = (M y)ᵢ/Mᵢᵢ with variance σ²/Mᵢᵢ. Deleting the reading
changes the estimate by −A⁻¹ Xᵀ S⁻¹ eᵢ γᵢ, with the unit vector eᵢ (Cook and Weisberg, Residuals and
Influence in Regression, 1982, 2.2). S is 1 for single readings. Differences of one setup and cycle
share postures, so that S has a block for each of these groups.

Deleting a setup s changes the estimate, to first order about the solution, by

    δ = −A₋ₛ⁻¹ Fₛᵀ rₛ/σ²,  A₋ₛ = FᵀF/σ² + P⁻¹ − FₛᵀFₛ/σ²

with the Jacobian F and the residuals r, zeros eliminated. The prediction error of the setup is then
rₛ − Fₛ δ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.errors import NotIdentifiableError
from orthocal.estimation.fit import Fit, require_determined
from orthocal.observation.gauge_noise import SMALLEST_SIGMA
from orthocal.observation.observations import Observations
from orthocal.statistics.chance import confidence_factor
from orthocal.statistics.information import Information, decompose
from orthocal.statistics.zeros import project_out_zeros

MIN_REDUNDANCY = 1e-9
"""Redundancy of a row relative to its weight, below which the other rows do not predict it."""

MIN_REMAINING_SQUARE = 1e-6
"""Smallest fraction of the sum of squares that remains when a row is deleted."""

OUTLIER_PROBABILITY = 0.01
"""Probability that a session without wrong readings has an outlier."""

LARGEST_THRESHOLD = 1e6
"""Threshold of studentised residuals above which it counts as infinite."""


@dataclass(frozen=True, slots=True, eq=False)
class Diagnostics:
    """Deletion diagnostics of every row."""

    studentised: Array
    """Studentised deleted residual, shape (n_rows,). Noise from residuals is estimated without the
    row. NaN if the other rows do not predict it."""
    max_dfbetas: Array
    """Largest |DFBETAS| over the machine's parameters: change of the estimate when the row is
    deleted, in standard deviations of the parameter, shape (n_rows,)."""
    dfbetas_parameter: Indices
    """Index in `problem.free` of the parameter with the largest change, shape (n_rows,)."""
    outlier_threshold: float
    """Studentised residual above which a row is an outlier."""


def diagnose_readings(fit: Fit) -> Diagnostics:
    """First-order deletion diagnostics of every row."""
    problem, count = fit.problem, fit.problem.observations.plus.size
    sigma, n = fit.noise.sigma, fit.problem.n_machine
    if not (np.isfinite(sigma) and sigma >= SMALLEST_SIGMA):  # no noise to compare with
        zeros = np.zeros(count)
        return Diagnostics(np.full(count, np.nan), zeros, zeros.astype(np.int64), np.inf)
    information = Information(_weighted_jacobian(fit)) if fit.loss.robust else fit.information
    inverse = information.posterior(
        sigma=sigma, precision=problem.prior_precision, at_bound=fit.at_bound
    ).covariance
    weights, s_inv_x, m_y, s_inv_diagonal = _eliminate_zeros(fit)
    gain = s_inv_x @ inverse / sigma**2
    # Mᵢᵢ divided by the weight of the row
    redundancy = s_inv_diagonal - weights * (gain * s_inv_x).sum(axis=1)
    redundancy[redundancy < MIN_REDUNDANCY * s_inv_diagonal] = np.nan
    std = np.sqrt(np.diag(inverse))[:n]
    with np.errstate(divide="ignore", invalid="ignore"):
        deleted_residual = m_y / redundancy
        sigma_without, dof = _sigma_without_rows(fit, m_y**2 / redundancy)
        dfbetas = np.abs(gain[:, :n] * (weights * deleted_residual)[:, None])
        dfbetas = np.nan_to_num(dfbetas / np.where(std > 0.0, std, np.inf))
    largest = dfbetas.argmax(axis=1)
    return Diagnostics(
        studentised=deleted_residual * np.sqrt(redundancy) / sigma_without,
        max_dfbetas=dfbetas[np.arange(count), largest],
        dfbetas_parameter=largest,
        outlier_threshold=_outlier_threshold(dof, count),
    )


def _eliminate_zeros(fit: Fit) -> tuple[Array, Array, Array, Array]:
    """Robust weights of the rows, S⁻¹ X, M y and diag S⁻¹, with gauge zeros eliminated.

    The last three are divided by the weight of the row.
    """
    o = fit.problem.observations
    weights = fit.robust_weights[o.plus]
    s_inv_x = o.rows(project_out_zeros(fit.jacobian, o, weights=fit.robust_weights))
    m_y, s_inv_diagonal = o.rows(fit.residual), np.ones(o.plus.size)
    jacobian = o.rows(fit.jacobian)
    for zero in range(o.n_zeros):
        group = np.flatnonzero(o.zero[o.plus] == zero)
        precision = _inverse_covariance(o, group)
        if precision is not None:
            s_inv_x[group], m_y[group] = precision @ jacobian[group], precision @ m_y[group]
            s_inv_diagonal[group] = np.diag(precision)
            # robust weights belong to single readings, so that differences have the weight 1
            weights[group] = 1.0
        elif not o.zero_known[zero]:
            s_inv_diagonal[group] -= weights[group] / weights[group].sum()
    return weights, s_inv_x, m_y, s_inv_diagonal


def _outlier_threshold(dof: float, count: int) -> float:
    """Bonferroni threshold of the studentised residuals of `count` readings.

    It is infinite with very few degrees of freedom, where the quantile of Student's distribution
    is about 1e28 and no reading can be judged.
    """
    factor = confidence_factor(dof, 1.0 - OUTLIER_PROBABILITY / count)
    return factor if factor < LARGEST_THRESHOLD else np.inf


def _weighted_jacobian(fit: Fit) -> Array:
    """Jacobian times roots of the robust weights, zeros eliminated, shape (n_entries, n_free)."""
    centred = project_out_zeros(fit.jacobian, fit.problem.observations, weights=fit.robust_weights)
    return np.asarray(np.sqrt(fit.robust_weights)[:, None] * centred)


def _inverse_covariance(o: Observations, group: Indices) -> Array | None:
    """Inverse covariance of differences that share postures, for readings of variance 1.

    None for single readings, which share only their gauge zero.

    Args:
        o: The entries.
        group: Indices of the rows with one zero, shape (n,).
    """
    if o.minus[group[0]] < 0:
        return None
    entries, position = np.unique([o.plus[group], o.minus[group]], return_inverse=True)
    position = position.reshape(2, -1)
    incidence = np.zeros((group.size, entries.size))
    rows = np.arange(group.size)
    incidence[rows, position[0]], incidence[rows, position[1]] = 1.0, -1.0
    return np.asarray(np.linalg.inv(incidence @ incidence.T))


def _sigma_without_rows(fit: Fit, contributions: Array) -> tuple[Array, float]:
    """Standard deviation of a reading estimated without each row, and its degrees of freedom.

    Args:
        fit: The fit.
        contributions: Contribution of each row to Σ r², shape (n_rows,), [noise-scaled m²].

    Returns:
        Standard deviations, shape (n_rows,), [noise-scaled m], and degrees of freedom.
    """
    noise = fit.noise
    if noise.source != "residuals" or fit.loss.robust:
        return np.full(contributions.size, noise.sigma), noise.dof
    dof = noise.dof - 1.0
    if dof <= 0.0:
        return np.full(contributions.size, np.nan), 0.0
    total = noise.sigma**2 * noise.dof
    # the first-order contribution of an outlier can exceed the total
    remaining = np.maximum(total - contributions, MIN_REMAINING_SQUARE * total)
    return np.sqrt(remaining / dof), dof


def cross_validate_setups(fit: Fit) -> Array:
    """Prediction errors of every row from all other setups (leave-one-out cross-validation).

    Returns:
        Measured minus predicted reading with the best gauge zeros, shape (n_rows,),
        [noise-scaled m]; NaN if the other setups do not determine the parameters.
    """
    problem, o = fit.problem, fit.problem.observations
    errors = np.full(o.plus.size, np.nan)
    setups = np.unique(o.setup)
    if setups.size < 2:
        return errors
    factor = _weighted_jacobian(fit)
    weighted_residual = np.sqrt(fit.robust_weights) * fit.residual / fit.sigma**2
    free = ~fit.at_bound
    precision = np.diag(problem.prior_precision)[np.ix_(free, free)]
    for setup in setups:
        deleted = o.setup == setup
        if not problem.prior_precision.all():
            # at the active offsets: unobservable directions seem observable at the solution
            jacobian = np.where(deleted[:, None], 0.0, fit.linearisation.jacobian)
            try:
                require_determined(problem, decompose(jacobian, o))
            except NotIdentifiableError:
                continue
        remaining = factor[~deleted][:, free] / fit.sigma
        change = np.zeros(problem.n_free)
        change[free] = -np.linalg.solve(
            remaining.T @ remaining + precision,
            factor[deleted][:, free].T @ weighted_residual[deleted],
        )
        prediction_error = project_out_zeros(fit.residual - fit.jacobian @ change, o)
        rows = deleted[o.plus]
        errors[rows] = o.rows(prediction_error)[rows]
    return errors
