"""Agreement of a new session with a calibration: predicted deviations and repeated residuals.

New readings y differ from those of the calibrated machine because of noise, the uncertainty of its
parameters, and the new mountings of the gauges:

    y − h(θ, 0) ~ N(0, V),   V = σ² I + J C Jᵀ + G Γ Gᵀ,

with C the covariance of the calibrated parameters and Γ the prior covariance of the mountings.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from orthocal.calibration.calibration import Calibration
from orthocal.calibration.refit import restore_mounting_covariance
from orthocal.estimation.diagnostics.residual_rows import ResidualRow
from orthocal.estimation.fit import Fit
from orthocal.session.session import known_approach, split_label
from orthocal.statistics.chance import BY_CHANCE
from orthocal.statistics.distributions import (
    chi_square_tail,
    f_tail,
    incomplete_beta,
    least_number,
)
from orthocal.statistics.information import whiten
from orthocal.statistics.zeros import project_out_zeros

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


def judge_deviations(calibration: Calibration, fit: Fit) -> DeviationTest:
    """Test the deviations of a new session against their predictive distribution.

    χ² = rᵀ V⁻¹ r with r = y − h(θ, ν) + G ν, the mountings ν of the fit, and no gauge zeros.
    If the noise was estimated, χ² per degree of freedom has an F distribution. Without priors the
    residuals of the calibration are the noise, because they contain unmodelled errors.

    Args:
        calibration: The calibration.
        fit: Fit of the same parameters to the new session.
    """
    problem, n = fit.problem, fit.problem.n_machine
    scale, observations, noise = problem.theta_scale, problem.observations, calibration.noise
    sigma, sigma_dof = noise.residual_sigma, noise.residual_dof
    if calibration.prior:
        sigma, sigma_dof = float(np.fmax(sigma, noise.sigma)), noise.dof
    dof = observations.size - observations.n_free_zeros
    if not (sigma > 0.0 and sigma_dof > 0.0 and dof > 0):
        return DeviationTest(math.nan, math.nan)
    covariance = np.diag(np.append(np.zeros(n), 1.0 / problem.prior_precision[n:]))
    covariance[:n, :n] = np.nan_to_num(calibration.model_covariance) / np.outer(
        scale[:n], scale[:n]
    )
    variances, directions = np.linalg.eigh(covariance)
    root = directions * np.sqrt(np.maximum(variances, 0.0))
    # linearised about the mountings of the fit, as a ball displaced by 1 mm is not linear
    mountings = fit.solution.theta[n:]
    theta = np.append([p.value for p in calibration.free], mountings)
    shift_of_mountings = fit.jacobian[:, n:] @ ((problem.prior_mean[n:] - mountings) / scale[n:])
    deviation = project_out_zeros(
        problem.values - problem.predict(theta) - shift_of_mountings, observations
    )
    whitened = whiten(deviation, project_out_zeros(fit.jacobian, observations) @ root, sigma=sigma)
    square = float(whitened @ whitened)

    def p_value(factor: float) -> float:
        scaled = square * factor**2
        if math.isinf(sigma_dof):
            return chi_square_tail(dof, scaled)
        return f_tail(dof, sigma_dof, scaled / dof)

    critical_factor = least_number(lambda f: p_value(f) < BY_CHANCE) if square > 0.0 else math.nan
    return DeviationTest(p_value(1.0), critical_factor)


def expect_rms(calibration: Calibration, fit: Fit) -> float:
    """Predicted RMS of the deviations in the rows of a new session, [m].

    It combines the RMS residual of the calibration with the effect of the mountings of both
    sessions: sqrt(rms² + tr(J (G_old + G_new) Jᵀ) / n).

    Args:
        calibration: The calibration.
        fit: Fit of the same parameters to the new session.
    """
    problem, n = fit.problem, fit.problem.n_machine
    mounting_covariance = restore_mounting_covariance(calibration) + fit.mounting_covariance
    jacobian = project_out_zeros(
        fit.jacobian[:, :n] / problem.theta_scale[:n], problem.observations
    )
    square = max(float(np.trace(jacobian @ mounting_covariance @ jacobian.T)), 0.0)
    rows = problem.session.readings
    entries_per_row = sum(1.0 + problem.session.is_difference(r) for r in rows) / len(rows)
    return math.sqrt(calibration.rms_after**2 + entries_per_row * square / len(rows))


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
    matched, correlation, cosine = _correlate(first, second)
    dimensions = matched - len(second.residuals) + second.noise.residual_dof
    p_value = math.nan
    if matched >= MIN_ROWS and dimensions > 1.0 and not math.isnan(correlation):
        tail = 0.5 * (1.0 - incomplete_beta(0.5, 0.5 * (dimensions - 1.0), cosine**2))
        p_value = tail if cosine > 0.0 else 1.0 - tail
    return Repetition(matched, correlation, p_value)


_Row = tuple[str, str, str | None, str | None]
"""Setup, posture and subtracted posture by their names in the session, and approach."""


def _keyed_rows(calibration: Calibration) -> Iterator[tuple[_Row, ResidualRow]]:
    """Rows of a calibration with keys that two sessions share."""
    joined = bool(calibration.session.parts)
    for r in calibration.residuals:
        setup, posture = (split_label(n, joined=joined)[1] for n in (r.setup, r.posture))
        minus = None if r.minus is None else split_label(r.minus, joined=joined)[1]
        yield (setup, posture, minus, known_approach(r.conditions)), r


def _correlate(first: Calibration, second: Calibration) -> tuple[int, float, float]:
    """Number of shared rows, and correlation and cosine of their residuals averaged over cycles."""
    means = []
    for calibration in (first, second):
        residuals_of_row: dict[_Row, list[float]] = defaultdict(list)
        for key, r in _keyed_rows(calibration):
            residuals_of_row[key].append(r.residual)
        means.append({key: sum(v) / len(v) for key, v in residuals_of_row.items()})
    common = [key for key in means[0] if key in means[1]]
    a, b = (np.array([m[key] for key in common]) for m in means)
    if len(common) < MIN_ROWS or not np.any(a) or not np.any(b):
        return len(common), math.nan, math.nan
    cosine = float(a @ b / np.sqrt((a @ a) * (b @ b)))
    return len(common), float(np.corrcoef(a, b)[0, 1]), cosine
