"""Scores of a model, identified to first order and exactly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from orthocal.arrays import Array
from orthocal.assessment.tool_error import ErrorSize, ToolAccuracy, assess_tool
from orthocal.calibration.build_record import assemble_calibration
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError, NotIdentifiableError, RobotError, SolverError
from orthocal.estimation.fit import Fit, fit_problem, require_determined
from orthocal.estimation.linear import LinearProblem
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.weighting import SMALLEST_SIGMA
from orthocal.statistics.information import decompose, take_for_known
from orthocal.statistics.zeros import project_out_zeros

Method = Literal["linearised", "exact"]


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Score of one model, identified in one way."""

    method: Method
    estimates: Mapping[str, float]
    """Parameter name to estimate, [SI]."""
    residuals: Array
    """Of the rows, as the closed-loop model shows them with the estimate, shape (n_rows,), [m]."""
    rms: float
    """Of the residuals, [m]."""
    chi_square: float
    """Σ r²/σ² with the noise of the session; NaN if it is unknown."""
    dof: float
    """Independent readings, repeated ones too, less effective parameters."""
    aicc: float
    """n ln(Σ r²/n) + 2 k + 2 k (k + 1)/(n − k − 1); infinite where k is too large for n."""
    bic: float
    """n ln(Σ r²/n) + k ln n; infinite without degrees of freedom."""
    unseen: Array
    """Prediction error of the rows of each setup from all others, (n_rows,), [m]; NaN where the
    others do not determine the model."""

    @property
    def unseen_rms(self) -> float:
        """Root mean square of the prediction errors of unseen setups, [m]."""
        known = self.unseen[np.isfinite(self.unseen)]
        return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


@dataclass(frozen=True, slots=True, eq=False)
class ModelResult:
    """One model, identified both ways."""

    model: str
    n_free: int
    rank: int
    """Number of combinations of its parameters that perfect readings would determine."""
    spare: int
    """Independent readings (repeated ones once) less the rank, which check the model."""
    effective: float
    """Parameters that the readings determine, beside the prior."""
    prior: bool
    """Whether tolerances act as a prior."""
    by_choice: bool
    """Whether that is so by choice, not because the readings alone leave the model open."""
    linearised: Score
    exact: Score
    calibration: Calibration
    tool: ToolAccuracy | None
    """None for a robot without a tool centre point."""
    linearisation_cost: ErrorSize | None
    """Distance at the tool between the two estimates with shift and rotation removed."""


@dataclass(frozen=True, slots=True, eq=False)
class Undetermined:
    """A model that the readings leave open."""

    model: str
    n_free: int
    reason: str


def score_model(
    problem: CalibrationProblem,
    *,
    noise: float,
    by_choice: bool = True,
    options: SolverOptions | None = None,
) -> ModelResult:
    """Identify one model both ways and score it.

    Args:
        problem: The session with the model's parameters free.
        noise: Standard deviation of a reading that residuals are held against, [m]; NaN if unknown.
        by_choice: Whether its prior, or that it has none, is as it should be; else it has one
            because the readings leave it open.
        options: Which solver, and how it is run.

    Raises:
        NotIdentifiableError: If the readings leave the model open.
        SolverError: If the solver does not converge.
        ClosureError: If the machine cannot reach a posture.
    """
    fit = fit_problem(problem, options=options)
    linearisation = fit.linearisation
    rank = take_for_known(linearisation.information, problem.n_machine).rank
    calibration = assemble_calibration(fit)
    tool = _assess(calibration)
    return ModelResult(
        model=problem.selection.label,
        n_free=problem.n_machine,
        rank=rank,
        spare=fit.independent_readings - rank,
        effective=_effective(fit),
        prior=bool(problem.machine_selection.prior.any()),
        by_choice=by_choice,
        linearised=_score(fit, linearisation, "linearised", noise),
        exact=_score(fit, linearisation, "exact", noise),
        calibration=calibration,
        tool=tool,
        linearisation_cost=None if tool is None else _linearisation_cost(fit, tool),
    )


def _assess(calibration: Calibration) -> ToolAccuracy | None:
    try:
        return assess_tool(calibration)
    except (ClosureError, RobotError):  # no tool, or one that hardly moves
        return None


def _effective(fit: Fit) -> float:
    return fit.information.effective_parameters(
        sigma=fit.sigma, precision=fit.problem.prior_precision
    )


def _score(fit: Fit, linearisation: LinearProblem, method: Method, noise: float) -> Score:
    problem, o = fit.problem, fit.problem.observations
    theta = fit.linearised_theta if method == "linearised" else fit.solution.theta
    try:
        residual = project_out_zeros(problem.values - problem.predict(theta), o)
    except ClosureError:  # the linearised machine cannot be assembled
        residual = np.full(o.size, np.nan)
    count, effective = o.size - o.n_zeros, _effective(fit)
    square = float(residual @ residual)
    rows = o.rows(residual)
    k = effective + 1.0  # and the noise
    room = count - k - 1.0
    # readings without any scatter fit all models alike
    mean_square = max(square / count, SMALLEST_SIGMA**2)
    misfit = math.nan if math.isnan(square) else count * math.log(mean_square)
    return Score(
        method=method,
        estimates=dict(zip(problem.machine_selection.names, theta.tolist(), strict=False)),
        residuals=rows,
        rms=float(np.sqrt(np.mean(rows**2))),
        chi_square=square / noise**2,
        dof=count - effective,
        aicc=misfit + 2.0 * k + 2.0 * k * (k + 1.0) / room if room > 0.0 else math.inf,
        bic=misfit + k * math.log(count) if count - effective >= 0.5 else math.inf,
        unseen=_predict_unseen(fit, linearisation, method),
    )


def _predict_unseen(fit: Fit, linearisation: LinearProblem, method: Method) -> Array:
    """Prediction errors of every setup from all the others, (n_rows,), [m]."""
    problem, o = fit.problem, fit.problem.observations
    errors = np.full(o.plus.size, np.nan)
    setups = np.unique(o.setup)
    if setups.size < 2:
        return errors
    for setup in setups:
        out = o.setup == setup
        try:
            if not problem.prior_precision.all():
                jacobian = np.where(out[:, None], 0.0, linearisation.jacobian)
                require_determined(problem, decompose(jacobian, o))
            if method == "exact":
                theta = fit.program.solve(
                    sigma=fit.sigma,
                    start=fit.solution.theta,
                    start_passive=fit.solution.passive,
                    excluded=np.flatnonzero(out),
                ).theta
            else:
                theta = linearisation.solve(sigma=fit.sigma, use=~out)
            residual = project_out_zeros(problem.values - problem.predict(theta), o)
        except (NotIdentifiableError, ClosureError, SolverError):
            continue  # stays unknown
        rows = out[o.plus]
        errors[rows] = o.rows(residual)[rows]
    return errors


def _linearisation_cost(fit: Fit, tool: ToolAccuracy) -> ErrorSize:
    """Tool distance between the linearised and the exact estimate, to first order."""
    change = np.zeros(len(tool.names))
    n = fit.problem.n_machine
    change[:n] = (fit.linearised_theta - fit.solution.theta)[:n]
    return tool.measure(tool.jacobian @ change).reported
