"""Agreement of a new session with a calibration: predicted deviations, and residuals that repeat.

New readings y differ from those of the calibrated machine by noise, by the uncertainty of its
parameters, and by how the gauges are mounted this time:

    y - h(θ, 0) ~ N(0, V),   V = σ² I + J C Jᵀ + G Γ Gᵀ,

with C the covariance of the calibration's parameters and Γ the tolerances of the mountings.
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
from orthocal.measurement.joining import name_within
from orthocal.session.session import known_approach
from orthocal.statistics.chance import BY_CHANCE
from orthocal.statistics.distributions import (
    beta_share,
    chi_square_tail,
    f_tail,
    least_number,
)
from orthocal.statistics.information import whiten
from orthocal.statistics.zeros import project_out_zeros

FEWEST = 3
"""Rows below which residuals have no correlation."""

CHANCE = 0.05
"""Probability below which a repetition of residuals is not due to chance."""


@dataclass(frozen=True, slots=True)
class DeviationTest:
    """Test of the deviations of a new session against their prediction."""

    chance: float
    """Probability of deviations as large, or larger; NaN if the calibration does not determine the
    noise."""
    limit: float
    """Factor on the deviations at which this probability is BY_CHANCE: they are as predicted if it
    is above 1. NaN if unknown."""


def judge_deviations(calibration: Calibration, fit: Fit) -> DeviationTest:
    """Test of the deviations of a new session against their predictive distribution.

    χ² = rᵀ V⁻¹ r with r = y - h(θ, ν) + G ν and the mountings ν of the fit, gauge zeros eliminated.
    It is an F statistic where the noise was estimated. Without a prior the residuals of the
    calibration are the noise: they contain the errors that its model omits.

    Args:
        calibration: The calibration.
        fit: The same parameters fitted to the new session.

    """
    problem, n = fit.problem, fit.problem.n_machine
    scale, o, noise = problem.theta_scale, problem.observations, calibration.noise
    sigma, sigma_dof = noise.residual_sigma, noise.residual_dof
    if calibration.prior:
        sigma, sigma_dof = float(np.fmax(sigma, noise.sigma)), noise.dof
    dof = o.size - o.n_free_zeros
    if not (sigma > 0.0 and sigma_dof > 0.0 and dof > 0):
        return DeviationTest(math.nan, math.nan)
    covariance = np.diag(np.append(np.zeros(n), 1.0 / problem.prior_precision[n:]))
    covariance[:n, :n] = np.nan_to_num(calibration.model_covariance) / np.outer(
        scale[:n], scale[:n]
    )
    variances, directions = np.linalg.eigh(covariance)
    root = directions * np.sqrt(np.maximum(variances, 0.0))
    # about the mountings of the fit: a ball of a bar that is 1 mm beside its place is not linear
    mounted = fit.solution.theta[n:]
    theta = np.append([p.value for p in calibration.free], mounted)
    as_stated = fit.jacobian[:, n:] @ ((problem.prior_mean[n:] - mounted) / scale[n:])
    deviation = project_out_zeros(problem.values - problem.predict(theta) - as_stated, o)
    white = whiten(deviation, project_out_zeros(fit.jacobian, o) @ root, sigma=sigma)
    square = float(white @ white)

    def chance(factor: float) -> float:
        scaled = square * factor**2
        if math.isinf(sigma_dof):
            return chi_square_tail(dof, scaled)
        return f_tail(dof, sigma_dof, scaled / dof)

    limit = least_number(lambda f: chance(f) < BY_CHANCE) if square > 0.0 else math.nan
    return DeviationTest(chance(1.0), limit)


def expect_rms(calibration: Calibration, fit: Fit) -> float:
    """RMS of the deviations that are expected in the rows of a new session, [m].

    It is the RMS residual of the calibration, and the effect of mountings that differ from session
    to session: rms² + tr(J (G_old + G_new) Jᵀ) / n.

    Args:
        calibration: The calibration.
        fit: The same parameters fitted to the new session.
    """
    problem, n = fit.problem, fit.problem.n_machine
    by_gauges = restore_mounting_covariance(calibration) + fit.mounting_covariance
    slopes = project_out_zeros(fit.jacobian[:, :n] / problem.theta_scale[:n], problem.observations)
    square = max(float(np.trace(slopes @ by_gauges @ slopes.T)), 0.0)
    rows = problem.session.readings
    per_row = sum(1.0 + problem.session.is_difference(r) for r in rows) / len(rows)
    return math.sqrt(calibration.rms_after**2 + per_row * square / len(rows))


@dataclass(frozen=True, slots=True, eq=False)
class Repetition:
    """Correlation of the residuals of two sessions: unmodelled errors repeat, noise does not."""

    matched: int
    """Rows that both sessions have."""
    correlation: float
    """Of the residuals of both fits over those rows; NaN below three."""
    chance: float
    """Probability of such a correlation between residuals that are noise; NaN if unknown."""

    @property
    def repeats(self) -> bool | None:
        """True if the residuals are unmodelled errors, not noise; None if unknown."""
        if math.isnan(self.chance):
            return None
        return self.chance < CHANCE and self.correlation > 0.0

    def to_document(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "matched": self.matched,
            "correlation": None if math.isnan(self.correlation) else self.correlation,
            "chance": None if math.isnan(self.chance) else self.chance,
            "residuals_repeat": self.repeats,
        }


def measure_repetition(first: Calibration, second: Calibration) -> Repetition:
    """Correlation of the residuals of two calibrations of the same parameters.

    Directions of noise are distributed evenly over the space that the fit leaves to residuals.
    """
    matched, correlation, cosine = _correlate(first, second)
    dimensions = matched - len(second.residuals) + second.noise.residual_dof
    chance = math.nan
    if matched >= FEWEST and dimensions > 1.0 and not math.isnan(correlation):
        tail = 0.5 * (1.0 - beta_share(0.5, 0.5 * (dimensions - 1.0), cosine**2))
        chance = tail if cosine > 0.0 else 1.0 - tail
    return Repetition(matched, correlation, chance)


_Row = tuple[str, str, str | None, str | None]
"""Setup, posture, posture that was subtracted, as named in their session, and approach."""


def _rows(calibration: Calibration) -> Iterator[tuple[_Row, ResidualRow]]:
    joined = bool(calibration.session.parts)
    for r in calibration.residuals:
        setup, posture = (name_within(n, joined=joined) for n in (r.setup, r.posture))
        minus = None if r.minus is None else name_within(r.minus, joined=joined)
        yield (setup, posture, minus, known_approach(r.conditions)), r


def _correlate(first: Calibration, second: Calibration) -> tuple[int, float, float]:
    """Rows that two sessions share, cycles averaged; correlation and cosine of their residuals."""
    means = []
    for calibration in (first, second):
        collected: dict[_Row, list[float]] = defaultdict(list)
        for key, r in _rows(calibration):
            collected[key].append(r.residual)
        means.append({key: sum(v) / len(v) for key, v in collected.items()})
    common = [key for key in means[0] if key in means[1]]
    a, b = (np.array([m[key] for key in common]) for m in means)
    if len(common) < FEWEST or not np.any(a) or not np.any(b):
        return len(common), math.nan, math.nan
    cosine = float(a @ b / np.sqrt((a @ a) * (b @ b)))
    return len(common), float(np.corrcoef(a, b)[0, 1]), cosine
