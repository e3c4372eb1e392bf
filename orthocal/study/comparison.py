"""Which model do the readings support: offsets, lengths, full, each linearised and exact.

A model is judged by what the readings can check of it, not by how small its residuals are. With as
many parameters as independent readings they are zero whatever the machine is like. So a model must
leave readings to spare, describe them better than a smaller one by more than its extra parameters
buy (AICc; Hurvich and Tsai, 1989), and predict setups that it has not seen better.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from orthocal.errors import ClosureError, NotIdentifiableError, SolverError
from orthocal.identification.calibrate import assemble_calibration, repeat_calibration
from orthocal.identification.calibration import Calibration
from orthocal.identification.fit import Fit, fit_problem, require_determined
from orthocal.identification.linear import Linearisation, linearise_at_reference
from orthocal.identification.nlp import SolverOptions
from orthocal.identification.problem import CalibrationProblem, build_problem
from orthocal.identification.uncertainty import (
    decompose,
    estimate_repeatability,
    project_out_zeros,
)
from orthocal.measurement.session import Session
from orthocal.study.accuracy import (
    ErrorSize,
    ToolAccuracy,
    assess_tool,
    error_covariance,
    measure_deviations,
    measure_uncertainty,
)
from orthocal.study.repetition import Repetition, measure_repetition

Array = NDArray[np.float64]
Method = Literal["linearised", "exact"]

EXCESS_CHANCE = 0.01
"""Probability below which residuals larger than the noise are not put down to chance."""

TELLING = 0.5
"""Effective parameters by which a larger model must exceed a smaller one to say anything new."""

BEYOND = 1.5
"""Residuals by which errors must exceed their tolerances for the machine to be called worse."""

WORTHWHILE = 2.0
"""Least drop of AICc for which a larger model is preferred (Burnham and Anderson, 2002, 2.6)."""


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """How one model, identified in one way, describes and predicts the readings."""

    model: str
    method: Method
    estimates: Mapping[str, float]
    """Parameter name to estimate, [SI]."""
    residuals: Array
    """Of the rows, as the closed-loop model shows them with the estimate, shape (n_rows,), [m]."""
    rms: float
    """Of the residuals, [m]."""
    chi_square: float
    """Σ r²/σ² with the noise of the session; NaN if nothing tells it."""
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
    """Combinations of its parameters that perfect readings would tell."""
    spare: int
    """Independent readings (repeated ones once) less the rank: what is left to check it."""
    effective: float
    """Parameters that the readings determine, beside the prior."""
    linearised: Score
    exact: Score
    calibration: Calibration
    tool: ToolAccuracy | None
    """None for a robot without a tool centre point."""
    linearisation_cost: ErrorSize | None
    """Distance at the tool between the two estimates, common shift taken out."""


@dataclass(frozen=True, slots=True, eq=False)
class Undetermined:
    """A model that the readings leave open."""

    model: str
    n_free: int
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """Which model to believe, and why."""

    supported: str | None
    """The largest model that the readings support; None if they support none."""
    model_error: bool | None
    """Whether what it leaves is error of the model, not noise; None if nothing tells."""
    reasons: tuple[str, ...]

    @property
    def exit_code(self) -> int:
        """0: supported, and noise remains. 3: supported, but model error remains. 4: none is."""
        if self.supported is None:
            return 4
        return 3 if self.model_error else 0


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Models of one robot side by side on one session."""

    title: str
    labels: tuple[str, ...]
    """Of the rows of the session."""
    noise: float
    """Standard deviation of a reading that residuals are held against, [m]; NaN if unknown."""
    noise_source: Literal["cycles", "gauge", "unknown"]
    noise_dof: float
    independent: int
    """Independent readings: distinct ones less gauge zeros."""
    results: tuple[ModelResult, ...]
    undetermined: tuple[Undetermined, ...]
    repetition: Repetition | None
    """Residuals of the supported model held against those of another session."""
    verdict: Verdict

    def __getitem__(self, model: str) -> ModelResult:
        for result in self.results:
            if result.model == model:
                return result
        raise KeyError(model)

    def to_json(self) -> str:
        """As JSON, SI units."""
        document = {
            "schema": "orthocal/comparison/1",
            "title": self.title,
            "noise": _number(self.noise),
            "noise_source": self.noise_source,
            "independent_readings": self.independent,
            "models": [_result_document(r) for r in self.results],
            "undetermined": [
                {"model": u.model, "n_free": u.n_free, "reason": u.reason}
                for u in self.undetermined
            ],
            "repetition": None if self.repetition is None else self.repetition.to_document(),
            "verdict": {
                "supported": self.verdict.supported,
                "model_error": self.verdict.model_error,
                "exit_code": self.verdict.exit_code,
                "reasons": list(self.verdict.reasons),
            },
        }
        return json.dumps(document, indent=1, allow_nan=False) + "\n"


def compare_models(
    session: Session,
    *,
    models: Sequence[str] = (),
    tolerances: Mapping[str, float] | None = None,
    repeat: Session | None = None,
    options: SolverOptions | None = None,
) -> Comparison:
    """Identify a session by several models, both ways, and say which one it supports.

    Args:
        session: The session.
        models: Models of the robot's YAML; all by default.
        tolerances: Name or glob to another standard deviation than the robot's, [SI].
        repeat: Another session of the same rows: whether what remains repeats.
        options: How Ipopt is run.

    Raises:
        ParameterError: If a model or name is unknown.
        SolverError: If Ipopt does not converge.
        ClosureError: If the machine cannot reach a posture.
    """
    noise, source, noise_dof = _known_noise(session)
    results, undetermined = [], []
    own = dict(tolerances or {})
    names = list(models or session.robot.parameters.models)
    for model in names:
        parameters = session.robot.parameters
        free = parameters.select_model(model)
        matching = {g: v for g, v in own.items() if set(parameters.select([g])) & set(free)}
        problem = build_problem(session, model=model, tolerances=matching)
        try:
            results.append(_compare_one(problem, model, noise, options))
        except NotIdentifiableError as e:
            undetermined.append(Undetermined(model, problem.n_free, e.problem))
    results.sort(key=lambda r: r.n_free)
    independent = results[0].spare + results[0].rank if results else 0
    best, reasons = _choose(results, undetermined)
    headline = _headline(best, results, undetermined, independent)
    repetition = None
    model_error = None
    if best is not None:
        model_error, excess, words = _explain_remainder(best, noise, source, noise_dof)
        reasons += words
        if repeat is not None:
            repetition = measure_repetition(
                best.calibration, repeat_calibration(best.calibration, repeat)
            )
            words, model_error = _explain_repetition(repetition, repeat, model_error)
            reasons += words
        reasons += _explain_tool(best, excess)
    return Comparison(
        title=session.title,
        labels=tuple(r.label for r in session.readings),
        noise=noise,
        noise_source=source,
        noise_dof=noise_dof,
        independent=independent,
        results=tuple(results),
        undetermined=tuple(undetermined),
        repetition=repetition,
        verdict=Verdict(None if best is None else best.model, model_error, (headline, *reasons)),
    )


def _known_noise(session: Session) -> tuple[float, Literal["cycles", "gauge", "unknown"], float]:
    """Noise of a reading that no model has a part in."""
    problem = build_problem(session, free=["*.offset"])
    sigma, dof = estimate_repeatability(problem.values, problem.observations)
    if dof > 0 and sigma > 0.0:
        return sigma, "cycles", float(dof)
    if session.gauge.sigma is not None:
        return session.gauge.sigma, "gauge", math.inf
    return math.nan, "unknown", 0.0


def _compare_one(
    problem: CalibrationProblem, model: str, noise: float, options: SolverOptions | None
) -> ModelResult:
    fit = fit_problem(problem, options=options)
    linearisation = linearise_at_reference(problem)
    o = problem.observations
    effective = fit.information.effective_parameters(
        sigma=fit.sigma, precision=problem.prior_precision
    )
    _, repeated = estimate_repeatability(problem.values, o)
    rank = linearisation.information.rank
    calibration = assemble_calibration(fit)
    tool = None if problem.robot.tcp is None else assess_tool(calibration)
    scores: dict[Method, Score] = {}
    for method, theta in (("linearised", fit.linear), ("exact", fit.solution.theta)):
        try:
            residual = project_out_zeros(problem.values - problem.predict(theta), o)
        except ClosureError:
            residual = np.full(o.size, np.nan)
        unseen = _predict_unseen(fit, linearisation, method)  # type: ignore[arg-type]
        scores[method] = _score(problem, model, method, theta, residual, unseen, effective, noise)  # type: ignore[index,arg-type]
    return ModelResult(
        model=model,
        n_free=problem.n_free,
        rank=rank,
        spare=o.size - o.n_zeros - repeated - rank,
        effective=effective,
        linearised=scores["linearised"],
        exact=scores["exact"],
        calibration=calibration,
        tool=tool,
        linearisation_cost=None if tool is None else _linearisation_cost(fit, tool),
    )


def _score(
    problem: CalibrationProblem,
    model: str,
    method: Method,
    theta: Array,
    residual: Array,
    unseen: Array,
    effective: float,
    noise: float,
) -> Score:
    o = problem.observations
    count = o.size - o.n_zeros
    square = float(residual @ residual)
    rows = o.rows(residual)
    dof = count - effective
    k = effective + 1.0  # and the noise
    fit_term = count * math.log(max(square, 1e-300) / count) if square == square else math.nan
    room = count - k - 1.0
    return Score(
        model=model,
        method=method,
        estimates=dict(zip(problem.free, theta.tolist(), strict=True)),
        residuals=rows,
        rms=float(np.sqrt(np.mean(rows**2))),
        chi_square=square / noise**2,
        dof=dof,
        aicc=fit_term + 2.0 * k + 2.0 * k * (k + 1.0) / room if room > 0.0 else math.inf,
        bic=fit_term + k * math.log(count) if dof >= 0.5 else math.inf,
        unseen=unseen,
    )


def _predict_unseen(fit: Fit, linearisation: Linearisation, method: Method) -> Array:
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
                left = np.where(out[:, None], 0.0, linearisation.slopes)
                require_determined(problem, decompose(left, o))
            if method == "exact":
                theta = fit.program.solve(
                    sigma=fit.sigma,
                    start=fit.solution.theta,
                    start_passive=fit.solution.passive,
                    left_out=np.flatnonzero(out),
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
    change[: fit.problem.n_free] = fit.linear - fit.solution.theta
    moved = tool.jacobian @ change
    weights = tool.workspace.weights
    return measure_deviations(moved - weights @ moved, weights)


def _choose(
    results: Sequence[ModelResult], undetermined: Sequence[Undetermined]
) -> tuple[ModelResult | None, list[str]]:
    """The largest model that earns its parameters, and why the others do not."""
    best: ModelResult | None = None
    reasons = [f"{u.model}: not determined. {u.reason}." for u in undetermined]
    for result in results:
        total = result.rank + result.spare
        if result.spare < 1:
            reasons.append(
                f"{result.model}: not supported. Its {result.n_free} parameters take up all "
                f"{total} independent readings: what remains is decided by the tolerances, "
                "and no reading is left to check it."
            )
            continue
        if best is None:
            best = result
            reasons.append(
                f"{result.model}: supported. The readings tell {_count(result.rank)} parameters "
                f"and leave {_count(result.spare)} readings to check them."
            )
            continue
        if result.effective < best.effective + TELLING:
            reasons.append(
                f"{result.model}: no more than {best.model}. Beside the tolerances the readings "
                f"tell {result.effective:.1f} of its {result.n_free} parameters, as many as of "
                f"{best.model}: what it adds stays where the tolerances put it."
            )
            continue
        gain = best.exact.aicc - result.exact.aicc
        old, new = best.exact.unseen_rms, result.exact.unseen_rms
        predicts = not new >= old  # unknown counts for the model
        words = f"unseen setups are predicted to {new * 1e3:.4f} mm instead of {old * 1e3:.4f} mm"
        if gain > WORTHWHILE and predicts:
            reasons.append(
                f"{result.model}: supported. It describes the readings better than {best.model} "
                f"by more than its parameters buy (AICc lower by {gain:.0f}), and {words}."
            )
            best = result
        elif gain > WORTHWHILE:
            reasons.append(
                f"{result.model}: not supported. It describes these readings better than "
                f"{best.model}, but {words}: it learns what does not carry over."
            )
        else:
            reasons.append(
                f"{result.model}: no better than {best.model}. AICc is "
                f"{'higher' if gain < 0 else 'lower'} by {abs(gain):.1f}, and {words}."
            )
    return best, reasons


def _headline(
    best: ModelResult | None,
    results: Sequence[ModelResult],
    undetermined: Sequence[Undetermined],
    independent: int,
) -> str:
    if best is None:
        return "These readings support none of the models."
    count = _count(independent).capitalize()
    others = [*(r.n_free for r in results), *(u.n_free for u in undetermined)]
    only = " only" if best.n_free == min(others) < max(others) else ""
    return f"{count} independent readings support {best.model}{only}."


def _explain_remainder(
    best: ModelResult, noise: float, source: str, noise_dof: float
) -> tuple[bool | None, float, list[str]]:
    """Whether what the supported model leaves is noise, and by how much it is beyond tolerances."""
    calibration = best.calibration
    dof, chi_square = best.exact.dof, best.exact.chi_square
    found = calibration.noise.residual_sigma
    if not math.isfinite(noise) or dof < 0.5:
        words = [
            "Whether what remains is noise cannot be told: nothing says what the noise is. Repeat "
            "readings in cycles, or give gauge.sigma_mm."
        ]
        return None, 1.0, words
    if math.isinf(noise_dof):
        chance = float(special.chdtrc(dof, chi_square))
    else:
        chance = float(special.fdtrc(dof, noise_dof, chi_square / dof))
    factor = calibration.row_factor
    row = "a difference" if calibration.rows_are_differences else "a reading"
    where = {"cycles": "repeated cycles scatter", "gauge": "the gauge's own σ"}[source]
    sizes = f"σ {found * factor * 1e3:.3g} mm of {row} against {noise * factor * 1e3:.2g} mm"
    if chance >= EXCESS_CHANCE:
        return False, 1.0, [f"What {best.model} leaves is noise: {sizes} ({where})."]
    words = [
        f"What {best.model} leaves is error of the model rather than noise: {sizes} ({where}), "
        f"{found / noise:.0f} times as much."
    ]
    tolerated, scale = calibration.unmodelled.residual_rms, 1.0
    if tolerated > 0.0:
        rms = best.exact.rms
        scale = rms / tolerated
        words.append(
            f"Errors that {best.model} leaves out, at their tolerances, would leave "
            f"{tolerated * 1e3:.3f} mm r.m.s.; found are {rms * 1e3:.3f} mm"
            + (
                f": this machine is worse than its tolerances, by about {scale:.1f} times."
                if scale > BEYOND
                else ": they explain it."
            )
        )
    return True, scale if scale > BEYOND else 1.0, words


def _explain_repetition(
    repetition: Repetition, repeat: Session, model_error: bool | None
) -> tuple[list[str], bool | None]:
    sizes = f"correlation {repetition.correlation:.3f} over {repetition.matched} rows"
    if repetition.repeats is None:
        return ["Whether what remains repeats cannot be told: too few rows are shared."], (
            model_error
        )
    if repetition.repeats:
        return [
            f"What remains repeats in '{repeat.title}' ({sizes}; by chance {repetition.chance:.2g})"
            ": it is error of the model, which no repetition removes."
        ], True
    return [f"What remains does not repeat in '{repeat.title}' ({sizes})."], model_error


def _explain_tool(best: ModelResult, excess: float) -> list[str]:
    """What the supported model is good for at the tool, with errors beyond their tolerances."""
    if best.tool is None or best.tool.after is None:
        return []
    after, cost = best.tool.after.relative, best.linearisation_cost
    words = [
        f"At the tool {best.model} is good for {after.rms * 1e6:.0f} µm r.m.s. over the workspace, "
        "common shift taken out, if the tolerances hold."
    ]
    if excess > 1.0:
        covariance = error_covariance(best.calibration, excess=excess)
        size = measure_uncertainty(best.tool.jacobian, covariance, best.tool.workspace).relative
        words[0] = (
            f"At the tool {best.model} is good for about {size.rms * 1e6:.0f} µm r.m.s. over the "
            f"workspace, common shift taken out, with errors {excess:.1f} times their tolerances."
        )
    if cost is not None:
        words.append(f"Linearising it costs {cost.rms * 1e6:.1f} µm r.m.s. there.")
    return words


def _count(value: int) -> str:
    words = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
    return words[value] if 0 <= value < len(words) else str(value)


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _result_document(result: ModelResult) -> dict[str, Any]:
    def score(s: Score) -> dict[str, Any]:
        return {
            "estimates": dict(s.estimates),
            "residuals": [_number(v) for v in s.residuals.tolist()],
            "rms": _number(s.rms),
            "chi_square": _number(s.chi_square),
            "dof": s.dof,
            "aicc": _number(s.aicc),
            "bic": _number(s.bic),
            "unseen_rms": _number(s.unseen_rms),
        }

    def size(s: ErrorSize | None) -> dict[str, float] | None:
        if s is None:
            return None
        return {"rms": s.rms, "percentile_95": s.percentile_95, "largest": s.largest}

    after = None if result.tool is None else result.tool.after
    return {
        "model": result.model,
        "n_free": result.n_free,
        "rank": result.rank,
        "spare": result.spare,
        "effective_parameters": result.effective,
        "linearised": score(result.linearised),
        "exact": score(result.exact),
        "standard_deviations": {p.name: _number(p.std) for p in result.calibration.free},
        "tool_uncertainty": size(None if after is None else after.absolute),
        "tool_uncertainty_relative": size(None if after is None else after.relative),
        "linearisation_at_tool": size(result.linearisation_cost),
    }
