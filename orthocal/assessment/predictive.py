"""Agreement of a new session with a calibration: predicted deviations and repeated residuals.

New readings y differ from those of the calibrated machine because of noise, the uncertainty of its
parameters, and the new mountings of the gauges:

    y − h(θ, 0) ~ N(0, V),   V = σ² I + J C Jᵀ + G Γ Gᵀ,

with h(θ, ν) the predicted readings and their derivatives J and G with respect to the calibrated
parameters θ and the mountings ν, the covariance C of θ, and the prior covariance Γ of ν.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np

from orthocal.arrays import Array
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.records import GaugeRecord
from orthocal.calibration.refit import (
    calibrated_theta,
    known_parameters,
    restore_covariances,
    restore_mounting_covariance,
)
from orthocal.errors import ClosureError
from orthocal.estimation.fit import Fit
from orthocal.observation.gauge_noise import noise_floor
from orthocal.observation.observations import Observations
from orthocal.session.session import known_approach, split_label
from orthocal.statistics.chance import BY_CHANCE
from orthocal.statistics.distributions import (
    chi_square_tail,
    f_tail,
    incomplete_beta,
    least_number,
    log_chi_square_tail,
    median_of_largest,
)
from orthocal.statistics.information import square_root
from orthocal.statistics.noise import FEW_DOF
from orthocal.statistics.zeros import project_out_zeros, zero_shares

MAX_STEPS = 12
"""Largest number of Gauss-Newton steps to the least χ²."""

SMALL_DECREASE = 1e-3
"""Decrease of χ² by a step below which it is the least one."""

MIN_ROWS = 3
"""Number of shared rows below which the correlation of residuals is unknown."""


@dataclass(frozen=True, slots=True)
class DeviationTest:
    """Test of the deviations of a new session against their prediction."""

    p_value: float
    """Probability of deviations at least as large; NaN if the calibration does not determine the
    noise."""
    critical_factor: float
    """Factor of the deviations at which `p_value` is BY_CHANCE: above 1 if they are as predicted.
    NaN if unknown."""
    worst_setup: int = 0
    """Index of the setup without which the others agree best with their prediction."""


def judge_deviations(calibration: Calibration, fit: Fit) -> DeviationTest:
    """Test the deviations of a new session against their predictive distribution.

    χ² is the least value of |y − h(θ, ν)|²/σ² + (θ − θ₁)ᵀ C⁻¹ (θ − θ₁) + νᵀ Γ⁻¹ ν, with the
    calibrated parameters θ₁. It is rᵀ V⁻¹ r if readings are linear, which a ball that is displaced
    by 1 mm is not. If the noise was estimated, χ² per degree of freedom has an F distribution.

    Args:
        calibration: The calibration.
        fit: Fit of the same parameters to the new session.
    """
    problem = fit.problem
    sigma, noise_dof = _predict_noise(calibration, fit)
    dof = problem.observations.size - problem.observations.n_free_zeros
    if not (np.all(sigma > 0.0) and noise_dof > 0.0 and dof > 0):
        return DeviationTest(math.nan, math.nan)
    root = _root_of_covariance(calibration, fit)
    centre, known = problem.prior_mean.copy(), known_parameters(calibration, problem)[0]
    centre[known] = calibrated_theta(calibration, fit)[known]
    square, worst_setup = _least_square(fit, centre, root, sigma)

    def p_value(factor: float) -> float:
        scaled = square * factor**2
        if math.isinf(noise_dof):
            return chi_square_tail(dof, scaled)
        return f_tail(dof, noise_dof, scaled / dof)

    critical_factor = least_number(lambda f: p_value(f) < BY_CHANCE) if square > 0.0 else math.nan
    return DeviationTest(p_value(1.0), critical_factor, worst_setup)


def _root_of_covariance(calibration: Calibration, fit: Fit) -> Array:
    """Square root R of the covariance R Rᵀ of calibrated parameters and new mountings.

    Args:
        calibration: The calibration.
        fit: Fit of the same parameters to the new session.

    Returns:
        Shape (n_free, n_free), [prior std].
    """
    problem, n = fit.problem, fit.problem.n_machine
    covariance = np.diag(np.append(np.zeros(n), 1.0 / problem.prior_precision[n:]))
    here, there = known_parameters(calibration, problem)
    known = calibration.model_covariance
    if here.size > n:
        known = restore_covariances(calibration)[0][np.ix_(there, there)]
    scale = problem.theta_scale[here]
    covariance[np.ix_(here, here)] = np.nan_to_num(known) / np.outer(scale, scale)
    return square_root(covariance)


def _predict_noise(calibration: Calibration, fit: Fit) -> tuple[Array, float]:
    """Noise of the readings of a new session.

    A gauge of the calibration has the noise that was estimated there, which contains unmodelled
    errors. Without priors it is that of the residuals. Another gauge has its stated noise, plus the
    unmodelled errors of the calibration. Degrees of freedom of several gauges are combined by
    Satterthwaite's formula (1946). A noise that gauges share counts once.

    Returns:
        Standard deviation of each entry, shape (n_entries,), [m], NaN if unknown; and its degrees
        of freedom.
    """
    sigma, inverse_dof = np.empty(fit.problem.observations.size), 0.0
    by_residuals = True
    for group, noise in zip(fit.groups, fit.noises.gauges, strict=True):
        stated = group.gauge.sigma, group.gauge.resolution
        same = [k for k in calibration.gauges if (k.sigma, k.resolution) == stated]
        if same:
            noises = [_of_calibration(calibration, k) for k in same]
            variance = sum(s**2 for s, _ in noises) / len(noises)
            dof = sum(dof for _, dof in set(noises))
            by_residuals &= not calibration.prior or all(
                k.noise.source == "residuals" for k in same
            )
        else:
            by_residuals, separate, dof = False, noise_floor(*stated), math.inf
            if noise.cycles_dof >= FEW_DOF:
                separate, dof = noise.without_residuals(*stated)
            if not separate > 0.0:
                separate, dof = noise.sigma, noise.dof
            variance = separate**2
            for k in calibration.gauges:
                if k.noise.source == "residuals":  # with unmodelled errors
                    total, total_dof = _of_calibration(calibration, k)
                    separate, _ = k.noise.without_residuals(k.sigma, k.resolution)
                    variance += max(total**2 - separate**2, 0.0) / len(calibration.gauges)
                    dof = min(dof, total_dof)
        sigma[group.entries] = math.sqrt(variance)
        inverse_dof += float(np.mean(group.entries)) ** 2 / dof if dof > 0.0 else math.inf
    dof = 1.0 / inverse_dof if inverse_dof else math.inf
    return sigma, min(dof, calibration.noise.residual_dof) if by_residuals else dof


def _of_calibration(calibration: Calibration, gauge: GaugeRecord) -> tuple[float, float]:
    """Noise of a gauge as new readings show it, [m], and its degrees of freedom."""
    noise = gauge.noise
    if calibration.prior:
        return float(np.fmax(noise.residual_sigma, noise.sigma)), noise.dof
    return noise.residual_sigma, noise.residual_dof


def _least_square(fit: Fit, centre: Array, root: Array, sigma: Array) -> tuple[float, int]:
    """Least |y − h(x)|²/σ² + |z|² over x = centre + root z, and the setup that increases it most.

    It is found by Gauss-Newton steps from the fit.

    Args:
        fit: Fit to the new readings.
        centre: Predicted parameters, shape (n_free,), [SI].
        root: Square root of their covariance, shape (n_free, n_free), [prior std].
        sigma: Standard deviation of each entry, shape (n_entries,), [m].
    """
    problem = fit.problem.with_noise_ratio(sigma / sigma[0])
    o, scale = problem.observations, problem.theta_scale

    def linearise(theta: Array, start: Array) -> tuple[Array, tuple[Array, Array]]:
        """Passive coordinates; residuals and derivatives, zeros projected out, [σ]."""
        closed = problem.close(theta, start=start)
        reading, jacobian = problem.predict_and_jacobian(theta, closed)
        residual = project_out_zeros(problem.values - reading, o)
        return closed, (residual / sigma[0], project_out_zeros(jacobian, o) / sigma[0])

    def least(deviation: Array, jacobian: Array) -> Array:
        along = jacobian @ root
        return np.asarray(
            np.linalg.solve(along.T @ along + np.eye(len(along.T)), along.T @ deviation)
        )

    passive, (residual, jacobian) = linearise(fit.solution.theta, fit.solution.passive)
    deviation = residual + jacobian @ ((fit.solution.theta - centre) / scale)
    z, previous, best = least(deviation, jacobian), np.zeros(len(root)), math.inf
    residual = deviation - jacobian @ root @ z
    linear = float(residual @ residual + z @ z)
    reached = residual, jacobian @ root
    for _ in range(MAX_STEPS):
        try:
            closed, (residual, jacobian) = linearise(centre + scale * (root @ z), passive)
            square = float(residual @ residual + z @ z)
        except ClosureError:
            square = math.inf
        if not (square <= best and math.isfinite(square)):  # too far, or a tip misses its rod
            z = 0.5 * (previous + z)
            continue
        converged = best - square < SMALL_DECREASE
        previous, best, passive = z, square, closed
        reached = residual, jacobian @ root
        if converged:
            break
        z = least(residual + jacobian @ root @ z, jacobian)
    return best if math.isfinite(best) else linear, _find_worst_setup(*reached, o)


def _find_worst_setup(residual: Array, along: Array, observations: Observations) -> int:
    """Index of the setup whose readings increase the least χ² with the smallest probability.

    Without the entries S of a setup χ² decreases by r_Sᵀ (I − H_SS)⁻¹ r_S with
    H = A (Aᵀ A + I)⁻¹ Aᵀ and the derivatives A: |r_S|² + r_Sᵀ A_S (Aᵀ A + I − A_Sᵀ A_S)⁻¹ A_Sᵀ r_S.

    Args:
        residual: Residuals r at the least χ², zeros projected out, shape (n_entries,), [σ].
        along: Derivatives of the readings with respect to z, shape (n_entries, n_free), [σ].
        observations: The entries.
    """
    information = along.T @ along + np.eye(along.shape[1])
    log_probabilities: dict[int, float] = {}
    for setup in np.unique(observations.setup).tolist():
        entries = observations.setup == setup
        rows, r = along[entries], residual[entries]
        dof = int(entries.sum()) - observations.free_zeros_of(entries)
        fitted = np.linalg.solve(information - rows.T @ rows, rows.T @ r)
        decrease = float(r @ r + (rows.T @ r) @ fitted)
        log_probabilities[setup] = log_chi_square_tail(dof, decrease) if dof else 0.0
    return min(log_probabilities, key=lambda setup: log_probabilities[setup])


@dataclass(frozen=True, slots=True)
class ExpectedDeviations:
    """Deviations of the rows of a new session that a calibration predicts; NaN if unknown."""

    rms: float
    """RMS of the deviations, [m]."""
    largest: float
    """Largest deviation, [m]."""


def expect_deviations(calibration: Calibration, fit: Fit) -> ExpectedDeviations:
    """Deviations that a calibration predicts in the rows of a new session.

    Deviations are from the calibrated machine with the mountings of `fit`. With priors their
    variances follow to first order from those of noise, errors and mountings; the largest is the
    median of the largest of as many independent ones. Without priors unmodelled errors exceed the
    noise and repeat. The deviations are then, as in the paper, the residuals of the calibration,
    and the effect of the mountings of both sessions: sqrt(rms² + tr(J (M_old + M_new) Jᵀ) / n).
    M_old and M_new are the covariances of the errors from the mountings of each session, and n the
    number of rows. With the same gauges rms is the RMS residual of the calibration, with others it
    is in proportion to their noise.

    Args:
        calibration: The calibration.
        fit: Fit of the same parameters to the new session.
    """
    noise, _ = _predict_noise(calibration, fit)
    if calibration.prior:
        return _expect_with_priors(calibration, fit, noise)
    problem, n = fit.problem, fit.problem.n_machine
    mounting_covariance = restore_mounting_covariance(calibration) + fit.mounting_covariance
    jacobian = project_out_zeros(
        fit.jacobian[:, :n] / problem.theta_scale[:n] * problem.noise_ratio[:, None],
        problem.observations,
    )
    square = max(float(np.trace(jacobian @ mounting_covariance @ jacobian.T)), 0.0)
    rows = problem.session.readings
    entries_per_row = sum(1.0 + problem.session.is_difference(r) for r in rows) / len(rows)
    counts = [k.readings for k in calibration.gauges]
    old = [_of_calibration(calibration, k)[0] ** 2 for k in calibration.gauges]
    ratio = float(np.mean(noise**2) / np.average(old, weights=counts))
    before, largest = calibration.rms_after, calibration.largest_after
    rms_square = before**2 * (ratio if math.isfinite(ratio) else 1.0)
    rms = math.sqrt(rms_square + entries_per_row * square / len(rows))
    return ExpectedDeviations(rms, rms / before * largest if before else rms)


def _expect_with_priors(calibration: Calibration, fit: Fit, noise: Array) -> ExpectedDeviations:
    """Deviations from noise, uncertain parameters and mountings; arguments as above.

    The fit with the normal matrix A = Jᵀ J + P⁻¹ finds the mountings ν + A⁻¹_ν (Jᵀ e − P⁻¹ x) with
    the noise e and all true parameters x = (θ, ν), from their means. The machine θ = θ₁ + δ thus
    deviates from the calibrated one θ₁ by J_θ δ + e − J_ν A⁻¹_ν (Jᵀ e − P⁻¹ x).
    """
    if not np.all(noise > 0.0):
        return ExpectedDeviations(math.nan, math.nan)
    problem = fit.problem
    o, precision = problem.observations, problem.prior_precision
    along = project_out_zeros(fit.jacobian * (problem.noise_ratio / noise)[:, None], o)
    information = along.T @ along
    determined, _ = known_parameters(calibration, problem)
    new = np.setdiff1d(np.arange(problem.n_free), determined)
    mounting = along[:, new] @ np.linalg.inv(information + np.diag(precision))[new]
    from_mean = (calibrated_theta(calibration, fit) - problem.prior_mean) / problem.theta_scale
    by_errors = mounting * precision
    known = by_errors[:, determined] @ from_mean[determined]
    by_errors[:, determined] += along[:, determined]
    by_errors = by_errors @ _root_of_covariance(calibration, fit)

    def rows(entries: Array) -> Array:
        return o.rows((entries.T * noise).T)

    share, single = zero_shares(o)[o.zero], o.minus < 0
    variances = noise[o.plus] ** 2 * np.where(single, 1.0 - share[o.plus], 1.0)
    variances += np.where(single, 0.0, noise[o.minus] ** 2)
    of_mounting = rows(mounting)
    variances += (of_mounting * (of_mounting @ information - 2.0 * rows(along))).sum(axis=1)
    squares = np.maximum(variances, 0.0) + (rows(by_errors) ** 2).sum(axis=1) + rows(known) ** 2
    rms = math.sqrt(float(np.mean(squares)))
    return ExpectedDeviations(rms, median_of_largest(np.sqrt(squares)))


@dataclass(frozen=True, slots=True, eq=False)
class Repetition:
    """Correlation of the residuals of two sessions. Unmodelled errors repeat, noise does not."""

    matched: int
    """Number of rows that both sessions contain."""
    correlation: float
    """Correlation of the residuals of both fits over those rows; NaN for fewer than MIN_ROWS."""
    p_value: float
    """Probability of at least this correlation if the residuals are noise; NaN if unknown."""

    @property
    def repeats(self) -> bool | None:
        """True if the residuals are mainly unmodelled errors, not noise; None if unknown."""
        if math.isnan(self.p_value):
            return None
        return self.p_value < BY_CHANCE and self.correlation > 0.0

    def to_document(self) -> dict[str, Any]:
        """Entries of the JSON document."""
        return {
            "matched": self.matched,
            "correlation": None if math.isnan(self.correlation) else self.correlation,
            "chance": None if math.isnan(self.p_value) else self.p_value,
            "residuals_repeat": self.repeats,
        }


def measure_repetition(first: Calibration, second: Calibration) -> Repetition:
    """Correlation of the residuals of two calibrations of the same parameters.

    The directions of noise have a uniform distribution in the space of residuals.
    """
    means = [_mean_residuals(calibration) for calibration in (first, second)]
    common = [key for key in means[0] if key in means[1]]
    a, b = (np.array([m[key] for key in common]) for m in means)
    correlation = p_value = math.nan
    if len(common) >= MIN_ROWS and np.any(a) and np.any(b):
        correlation = float(np.corrcoef(a, b)[0, 1])
        cosine = float(a @ b / np.sqrt((a @ a) * (b @ b)))
        dimensions = len(common) - len(second.residuals) + second.noise.residual_dof
        if dimensions > 1.0 and not math.isnan(correlation):
            tail = 0.5 * (1.0 - incomplete_beta(0.5, 0.5 * (dimensions - 1.0), cosine**2))
            p_value = tail if cosine > 0.0 else 1.0 - tail
    return Repetition(len(common), correlation, p_value)


def _mean_residuals(calibration: Calibration) -> dict[tuple[str | None, ...], float]:
    """Mean residual over the cycles, by the keys of rows that two sessions share, [m].

    A key is the setup, posture and subtracted posture by their names in the session, and approach.
    """
    joined = bool(calibration.session.parts)
    residuals: dict[tuple[str | None, ...], list[float]] = defaultdict(list)
    for r in calibration.residuals:
        labels = (n and split_label(n, joined=joined)[1] for n in (r.setup, r.posture, r.minus))
        residuals[*labels, known_approach(r.conditions)].append(r.residual)
    return {key: sum(v) / len(v) for key, v in residuals.items()}
