"""Comparison of models of one machine on one session, each linearised and exact."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, get_args

from orthocal.arguments import require_names
from orthocal.assessment.assess import assess, assess_readings
from orthocal.assessment.effect_comparison import EffectComparison, compare_effects
from orthocal.assessment.judgement import Judgement, judgement_of, rank
from orthocal.assessment.predictive import Repetition, measure_repetition
from orthocal.assessment.recommendation import Recommendation, recommend_model
from orthocal.assessment.scores import ModelResult, Score, Undetermined, score_model
from orthocal.assessment.words import comparison as words
from orthocal.assessment.words.validation import describe_repetition
from orthocal.calibration.assessment_record import Assessment, Finding, NoiseKind
from orthocal.calibration.refit import repeat_calibration
from orthocal.errors import NotIdentifiableError, SessionError
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem, build_problem
from orthocal.estimation.weighting import split_by_gauge, with_repeatability
from orthocal.io.documents import format_json
from orthocal.io.fields import finite_or_none
from orthocal.measurement.joining import Given, gather_sessions, join_sessions, require_same_robot
from orthocal.runtime.threads import one_thread
from orthocal.session.session import Session
from orthocal.statistics.noise import Noise, estimate_noise

CRITERIA = ("rms", "chi_square", "dof", "aicc", "bic", "prediction_rms")
"""Numbers of a score in the JSON document."""


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Comparison of models of one robot on one session."""

    title: str
    labels: tuple[str, ...]
    """Labels of the readings, with the cycle if there are several."""
    noises: Mapping[str, Noise]
    """Noise of each gauge with which residuals are compared."""
    independent: int
    """Independent readings: distinct readings minus gauge zeros."""
    results: tuple[ModelResult, ...]
    undetermined: tuple[Undetermined, ...]
    repetition: Repetition | None
    """Correlation of the residuals of the recommended model with those of another session."""
    repeat_title: str
    """Title of the other session; empty if there is none."""
    judgement: Judgement
    """Judgement of the readings, independent of the model."""
    recommendation: Recommendation | None = None
    """Recommended model; None unless the verdict is `enter`."""
    effects: EffectComparison | None = None
    """Effects beside geometry; None if the readings cannot show any, or the verdict is not
    `enter`."""
    assessments: tuple[Assessment, ...] = ()
    """Assessment of the calibration of each result, as `calibrate` states it; empty unless the
    verdict is `enter`."""

    def __iter__(self) -> Iterator[ModelResult]:
        return iter(self.results)

    def __contains__(self, model: object) -> bool:
        return any(r.model == model for r in self.results)

    def __getitem__(self, model: str) -> ModelResult:
        return {r.model: r for r in self.results}[model]

    @property
    def best(self) -> ModelResult | None:
        """The recommended model if it was compared; otherwise the largest model."""
        largest = self.results[-1] if self.results else None
        if self.recommendation is None:
            return largest
        return {r.model: r for r in self.results}.get(self.recommendation.model, largest)

    @property
    def assessment(self) -> Assessment:
        """Judgement of the readings, and findings about the models.

        Unless the verdict is `enter`, it contains the judgement alone.
        """
        judgement, best, recommendation = self.judgement, self.best, self.recommendation
        if recommendation is None:
            return assess_readings(judgement.findings, judgement.findings[0])
        notes = words.describe_recommendation(
            recommendation, judged_scale=judgement.tolerance_scale.factor
        )
        notes += [words.not_determined(u.model, u.reason) for u in self.undetermined]
        if self.effects is not None:
            notes += words.describe_effects(self.effects, len(self.labels))
        tool = None
        if best is not None:
            assessment = self.assessments[self.results.index(best)]
            tool = assessment.tool
            notes += _models_not_recommended(recommendation, self.results, best)
            notes += assessment.of_kind(*get_args(NoiseKind))
            if self.repetition is not None:
                notes.append(describe_repetition(self.repetition, title=self.repeat_title))
            notes += assessment.of_kind("tool error", "out of reach")
            if best.linearisation_cost is not None:
                notes.append(words.linearisation_cost(best.linearisation_cost.rms))
        return assess_readings(rank([*judgement.findings, *notes]), notes[0], tool)

    def to_json(self) -> str:
        """Comparison as a JSON document, SI units."""
        recommendation = self.recommendation
        document = {
            "schema": "orthocal/comparison/6",
            "title": self.title,
            "noises": [
                {"gauge": name, "sigma": finite_or_none(noise.sigma), "source": noise.source}
                for name, noise in self.noises.items()
            ],
            "independent_readings": self.independent,
            "models": [_result_document(r) for r in self.results],
            "undetermined": [asdict(u) for u in self.undetermined],
            "repetition": None if self.repetition is None else self.repetition.to_document(),
            "recommendation": recommendation
            and {
                "model": recommendation.model,
                "tolerance_scale": recommendation.tolerance_scale,
                "log_evidence": {m: finite_or_none(v) for m, v in recommendation.evidence.items()},
            },
            "effects": None if self.effects is None else _effects_document(self.effects),
        }
        return format_json(document)


@one_thread()
def compare_models(
    sessions: Given | Sequence[Given],
    *,
    models: Sequence[str] = (),
    tolerances: Mapping[str, float] | None = None,
    repeat: Given | Sequence[Given] | None = None,
    options: SolverOptions | None = None,
    judgement: Judgement | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> Comparison:
    """Identify several models from a session, linearised and exactly, and recommend one.

    Unless the verdict on the readings is `enter`, the comparison has no recommendation and no tool
    error, because both would depend on doubtful readings.

    Args:
        sessions: The session, or several, or paths to them.
        models: Models of the robot's YAML; all by default.
        tolerances: Tolerances as in `Choice`, for all models and the judgement of the readings.
        repeat: Another session of the same rows, or several, whose residuals are compared.
        options: Solver and its options.
        judgement: Judgement of the sessions with these tolerances, if it was computed already.
        report: Function that is called with lines about the progress.

    Raises:
        ParameterError: If a model or name is unknown.
        SessionError: If a session of `repeat` is of another robot, or is one of `sessions`.
        SolverError: If the solver does not converge.
        ClosureError: If the machine cannot reach a posture.
    """
    gathered = [s.with_tolerances(tolerances or {}) for s in gather_sessions(sessions)]
    session = join_sessions(gathered)
    others = _gather_repeats(() if repeat is None else repeat, tolerances or {}, gathered)
    names, noises = _require_models(session, models), find_known_noises(session)
    if judgement is None:
        report("searching the readings for anomalies")
    judgement = judgement_of(session, judgement)
    build = partial(build_problem, session, tolerance_scale=judgement.tolerance_scale)
    results, undetermined = _score_models(build, names, noises, options, report)
    if judgement.verdict != "enter":
        results = tuple(replace(r, tool=None, linearisation_cost=None) for r in results)
    comparison = Comparison(
        title=session.title,
        labels=_label_rows(session),
        noises=noises,
        independent=results[0].calibration.identifiability.n_readings if results else 0,
        results=results,
        undetermined=undetermined,
        repetition=None,
        repeat_title=join_sessions(others).title if others else "",
        judgement=judgement,
    )
    if judgement.verdict == "enter":
        report("comparing the evidence for models and effects")
        comparison = _recommend(comparison, session, names if models else ())
    if comparison.best is None or not others:
        return comparison
    best = comparison.best.calibration
    repetition = measure_repetition(best, repeat_calibration(best, others))
    return replace(comparison, repetition=repetition)


def _require_models(session: Session, models: Sequence[str]) -> Sequence[str]:
    """Names of models, by default all of the robot; unknown ones raise a ParameterError."""
    names = require_names(models or (), argument="models")
    parameters = session.robot.parameters
    for name in names:
        parameters.select_model(name)
    return names or parameters.models


def _recommend(comparison: Comparison, session: Session, models: Sequence[str]) -> Comparison:
    """Comparison with recommendations, and with assessments of its results."""
    judgement, recommendation = comparison.judgement, recommend_model(session, models)
    return replace(
        comparison,
        recommendation=recommendation,
        effects=compare_effects(session),
        assessments=tuple(
            assess(r.calibration, session, judgement=judgement, recommendation=recommendation)
            for r in comparison.results
        ),
    )


def _label_rows(session: Session) -> tuple[str, ...]:
    """Labels of the readings, with the cycle if there are several."""
    several = len({r.cycle for r in session.readings}) > 1
    return tuple(r.label + (f", cycle {r.cycle}" if several else "") for r in session.readings)


def _score_models(
    build: Callable[..., CalibrationProblem],
    models: Sequence[str],
    noises: Mapping[str, Noise],
    options: SolverOptions | None,
    report: Callable[[str], None],
) -> tuple[tuple[ModelResult, ...], tuple[Undetermined, ...]]:
    """Results of the models, the smallest first, and models that are not identifiable."""
    results, undetermined = [], []
    for model in dict.fromkeys(models):
        report(f"identifying model {model}, and predicting each setup from the others")
        result = _score_with_prior(partial(build, model=model), noises, options)
        if isinstance(result, Undetermined):
            undetermined.append(result)
        else:
            results.append(result)
    return tuple(sorted(results, key=lambda r: r.n_free)), tuple(undetermined)


def _score_with_prior(
    build: Callable[..., CalibrationProblem],
    noises: Mapping[str, Noise],
    options: SolverOptions | None,
) -> ModelResult | Undetermined:
    """Score a model, with its tolerances as a prior if the readings alone do not determine it.

    Larger models always have a prior, so a small model that lacks one would be at a disadvantage.
    """
    try:
        return score_model(build(), noises=noises, options=options)
    except NotIdentifiableError:
        problem = build(prior=True)
    try:
        return score_model(problem, noises=noises, options=options)
    except NotIdentifiableError as e:
        return Undetermined(problem.selection.label, problem.n_machine, e.problem)


def _models_not_recommended(
    recommendation: Recommendation, results: Sequence[ModelResult], best: ModelResult
) -> list[Finding]:
    """Findings about the models that are not recommended; none if the recommended is missing."""
    if best.model != recommendation.model:
        return []
    return [
        words.not_recommended(
            r.model,
            recommendation.log_evidence_of(r.model) - recommendation.log_evidence_of(best.model),
            r.exact.prediction_rms,
            best.exact.prediction_rms,
        )
        for r in results
        if r is not best
    ]


def _gather_repeats(
    repeat: Given | Sequence[Given], tolerances: Mapping[str, float], compared: Sequence[Session]
) -> list[Session]:
    """Sessions whose residuals are compared, none of which is one of the compared sessions.

    Raises:
        SessionError: If a session is of another robot, or is one of the compared sessions.
    """
    others = [s.with_tolerances(tolerances) for s in gather_sessions(repeat)]
    for other, session in itertools.product(others, compared):
        require_same_robot(other, session)
        if other.was_read_from(session.sha256):
            raise SessionError(
                "is the same session: its residuals repeat by definition",
                where=None if other.path is None else str(other.path),
            )
    return others


def find_known_noises(session: Session) -> dict[str, Noise]:
    """Noise of each gauge without any model: scatter between cycles, at least as stated."""
    problem = build_problem(session, free=["*.offset"])
    groups = split_by_gauge(session, problem.observations)
    return {
        g.name: estimate_noise(
            repeatability=g.repeatability,
            residual_square=0.0,
            residual_dof=0.0,
            gauge_sigma=g.gauge.sigma,
            resolution=g.gauge.resolution,
        )
        for g in with_repeatability(groups, problem)
    }


def _effects_document(comparison: EffectComparison) -> dict[str, Any]:
    """Entries of the JSON document about effects."""
    return {
        "recommended": list(comparison.recommended),
        "stated": list(comparison.stated),
        "shown": list(comparison.shown),
        "weighed": [
            {
                "effects": list(w.effects),
                "log_evidence": finite_or_none(w.log_evidence),
                "prediction_rms": finite_or_none(w.prediction_rms),
            }
            for w in comparison.weighed
        ],
        "lacking": {name: count for name, (count, _) in comparison.lacking.items()},
    }


def _result_document(result: ModelResult) -> dict[str, Any]:
    """Entries of the JSON document about one model."""

    def score(s: Score) -> dict[str, Any]:
        return {
            "estimates": dict(s.estimates),
            "residuals": [finite_or_none(v) for v in s.residuals.tolist()],
            **{name: finite_or_none(getattr(s, name)) for name in CRITERIA},
        }

    after = None if result.tool is None else result.tool.after
    uncertainty, cost = after and after.sizes, result.linearisation_cost
    return {
        "model": result.model,
        "n_free": result.n_free,
        "rank": result.calibration.structural_rank,
        "spare": result.calibration.redundancy,
        "effective_parameters": result.effective,
        "linearised": score(result.linearised),
        "exact": score(result.exact),
        "standard_deviations": {p.name: finite_or_none(p.std) for p in result.calibration.free},
        "tool_uncertainty": uncertainty
        and uncertainty.aligned
        and uncertainty.aligned.to_document(),
        "tool_uncertainty_relative": uncertainty and uncertainty.relative.to_document(),
        "tool_uncertainty_absolute": uncertainty and uncertainty.absolute.to_document(),
        "linearisation_at_tool": cost and cost.to_document(),
    }
