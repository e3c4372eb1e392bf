"""Scores of a model that is identified to first order and exactly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import numpy as np

from orthocal.arrays import Array
from orthocal.assessment.tool_error import ErrorStatistics, ToolAccuracy, assess_tool
from orthocal.calibration.build_record import assemble_calibration
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError, NotIdentifiableError, RobotError, SolverError
from orthocal.estimation.fit import Fit, fit_problem, require_determined
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.observation.gauge_noise import SMALLEST_SIGMA
from orthocal.statistics.information import decompose
from orthocal.statistics.noise import Noise
from orthocal.statistics.zeros import project_out_zeros, zero_shares

Method = Literal["linearised", "exact"]


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Score of one model, identified by one method."""

    method: Method
    estimates: Mapping[str, float]
    """Parameter name to estimate, [SI]."""
    residuals: Array
    """Residuals of the rows with the loops closed for the estimate, shape (n_rows,), [m]."""
    rms: float
    """RMS of the residuals, [m]."""
    chi_square: float
    """Σ r²/σ² with the known noise of each gauge; NaN if one is unknown."""
    dof: float
    """Independent readings, including repeated ones, minus effective parameters."""
    aicc: float
    """m + 2 k + 2 k (k + 1)/(n − k − 1); infinite if n − k − 1 is not positive.

    m = n ln(Σ (r/w)²/n) + Σ ln w² over independent readings, with the noise w of their gauge
    relative to that of the first gauge. k is the effective number of parameters, plus 1 for the
    noise that m eliminates, plus the number of ratios w that are estimated. Stated ratios are known
    and do not count; gauges with few readings share one estimate."""
    bic: float
    """m + k ln n; infinite without degrees of freedom."""
    prediction_error: Array
    """Cross-validation errors of the rows of each setup, predicted from all other setups, shape
    (n_rows,), [m]; NaN if these do not determine the model."""

    @property
    def prediction_rms(self) -> float:
        """RMS of the cross-validation errors, [m]."""
        finite = self.prediction_error[np.isfinite(self.prediction_error)]
        return float(np.sqrt(np.mean(finite**2))) if finite.size else math.nan


@dataclass(frozen=True, slots=True, eq=False)
class ModelResult:
    """One model, identified by both methods."""

    model: str
    n_free: int
    effective: float
    """Effective number of parameters."""
    linearised: Score
    exact: Score
    calibration: Calibration
    tool: ToolAccuracy | None
    """Tool errors; None for a robot without a tool centre point."""
    linearisation_cost: ErrorStatistics | None
    """Difference of the tool position between both estimates after alignment."""


@dataclass(frozen=True, slots=True, eq=False)
class Undetermined:
    """A model that the readings do not determine."""

    model: str
    n_free: int
    reason: str


def score_model(
    problem: CalibrationProblem,
    *,
    noises: Mapping[str, Noise],
    options: SolverOptions | None = None,
) -> ModelResult:
    """Identify one model by both methods and score it.

    Args:
        problem: Problem with the parameters of the model free.
        noises: Known noise of each gauge for χ².
        options: Solver and its options.

    Raises:
        NotIdentifiableError: If the readings do not determine the model.
        SolverError: If the solver does not converge.
        ClosureError: If the machine cannot reach a posture.
    """
    fit = fit_problem(problem, options=options)
    calibration = assemble_calibration(fit)
    tool = None
    with suppress(ClosureError, RobotError):  # no tool, or no reachable workspace
        tool = assess_tool(calibration)
    effective = fit.information.posterior(
        sigma=fit.sigma, precision=problem.prior_precision, at_bound=fit.at_bound
    ).effective_parameters
    return ModelResult(
        model=problem.selection.label,
        n_free=problem.n_machine,
        effective=effective,
        linearised=_score(fit, "linearised", noises, effective),
        exact=_score(fit, "exact", noises, effective),
        calibration=calibration,
        tool=tool,
        linearisation_cost=None if tool is None else _linearisation_cost(fit, tool),
    )


def _score(fit: Fit, method: Method, noises: Mapping[str, Noise], effective: float) -> Score:
    """Score of one method.

    Args:
        fit: Fit of the model.
        method: The method.
        noises: Known noise of each gauge.
        effective: Effective number of parameters.
    """
    problem, observations = fit.problem, fit.problem.observations
    theta = fit.linearised_theta if method == "linearised" else fit.solution.theta
    try:
        residual = project_out_zeros(problem.values - problem.predict(theta), observations)
    except ClosureError:  # the linearised machine cannot reach a posture
        residual = np.full(observations.size, np.nan)
    count = observations.size - observations.n_free_zeros
    sum_of_squares = float(residual @ residual)
    errors = residual * problem.noise_ratio
    rows = observations.rows(errors)
    k = effective + 1.0 + fit.noises.estimated_ratios
    denominator = count - k - 1.0
    # without any scatter all models fit equally well
    mean_square = max(sum_of_squares / count, SMALLEST_SIGMA**2)
    misfit = math.nan
    if not math.isnan(sum_of_squares):
        independent = 1.0 - zero_shares(observations)[observations.zero]
        misfit = count * math.log(mean_square)
        misfit += 2.0 * float(independent @ np.log(problem.noise_ratio))
    return Score(
        method=method,
        estimates=dict(zip(problem.machine_selection.names, theta.tolist(), strict=False)),
        residuals=rows,
        rms=float(np.sqrt(np.mean(rows**2))),
        chi_square=_chi_square(fit, errors, noises),
        dof=count - effective,
        aicc=misfit + 2.0 * k + 2.0 * k * (k + 1.0) / denominator
        if denominator > 0.0
        else math.inf,
        bic=misfit + k * math.log(count) if count - effective >= 0.5 else math.inf,
        prediction_error=_cross_validate(fit, method),
    )


def _chi_square(fit: Fit, errors: Array, noises: Mapping[str, Noise]) -> float:
    """Σ r²/σ² over the entries, with residuals of shape (n_entries,), [m]; NaN if σ is unknown."""
    total = 0.0
    for group in fit.groups:
        sigma = noises[group.name].sigma
        of_group = errors[group.entries]
        total += float(of_group @ of_group) / sigma**2 if sigma > 0.0 else math.nan
    return total


def _cross_validate(fit: Fit, method: Method) -> Array:
    """Cross-validation errors as in `Score.prediction_error`."""
    problem, observations = fit.problem, fit.problem.observations
    errors = np.full(observations.plus.size, np.nan)
    setups = np.unique(observations.setup)
    if setups.size < 2:
        return errors
    for setup in setups:
        entries_left_out = observations.setup == setup
        try:
            if not problem.prior_precision.all():
                jacobian = np.where(entries_left_out[:, None], 0.0, fit.linearisation.jacobian)
                require_determined(problem, decompose(jacobian, observations))
            if method == "exact":
                theta = fit.program.solve(
                    sigma=fit.sigma,
                    start=fit.solution.theta,
                    start_passive=fit.solution.passive,
                    excluded=np.flatnonzero(entries_left_out),
                ).theta
            else:
                theta = fit.linearisation.solve(sigma=fit.sigma, use=~entries_left_out)
            residual = project_out_zeros(problem.values - problem.predict(theta), observations)
        except (NotIdentifiableError, ClosureError, SolverError):
            continue  # errors remain NaN
        rows = entries_left_out[observations.plus]
        errors[rows] = observations.rows(residual * problem.noise_ratio)[rows]
    return errors


def _linearisation_cost(fit: Fit, tool: ToolAccuracy) -> ErrorStatistics:
    """Difference of the tool position between the linearised and the exact estimate."""
    change = np.zeros(len(tool.names))
    n = fit.problem.n_machine
    change[:n] = (fit.linearised_theta - fit.solution.theta)[:n]
    return tool.measure(tool.jacobian @ change).reported
