"""Wording of findings about a comparison of models."""

from __future__ import annotations

import math

from orthocal.assessment.effect_comparison import EffectComparison
from orthocal.assessment.recommendation import Recommendation
from orthocal.assessment.wording import joined, mm, note, tool_mm
from orthocal.assessment.words.effects import identify_effects
from orthocal.calibration.assessment_record import Finding
from orthocal.io.documents import LARGEST_NUMBER
from orthocal.units import MM, UM


def describe_recommendation(
    recommendation: Recommendation, *, judged_scale: float, identified: str | None = None
) -> list[Finding]:
    """Findings about the recommended model and the recommended tolerance scale.

    Args:
        recommendation: The recommendation.
        judged_scale: Tolerance scale of the judgement. If it is not 1, it is stated already, and
            the recommended one, which also scales mountings and offsets, is not.
        identified: The identified model, which may be another one.
    """
    evidence = recommendation.log_evidence_of(recommendation.model)
    reason = "It is the complete model, and the readings support no smaller one strongly."
    if evidence > 0.0:
        reason = (
            "The readings support it strongly against the complete model: the other errors are "
            "too small to detect."
        )
    numbers = {"log_evidence": evidence}
    if identified is not None and identified != recommendation.model:
        against = evidence - recommendation.log_evidence_of(identified)
        if math.isfinite(against):  # clipped: huge if the stated noise is unrealistically small
            against = min(max(against, -LARGEST_NUMBER), LARGEST_NUMBER)
            numbers["log_evidence_against_chosen"] = against
    findings = [
        note("recommended", f"Recommended model: {recommendation.model}. {reason}", **numbers)
    ]
    if recommendation.tolerance_scale != 1.0 and judged_scale == 1.0:
        findings.append(
            note(
                "tolerances differ",
                "The readings strongly support tolerances of "
                f"{recommendation.tolerance_scale:.2g} times the stated ones.",
                "If that is plausible, state these tolerances in the session "
                "(calibration.tolerances) or by --tolerance.",
                tolerance_scale=recommendation.tolerance_scale,
                log_evidence=recommendation.scale_evidence,
            )
        )
    return findings


def describe_effects(comparison: EffectComparison, readings: int) -> list[Finding]:
    """Findings about recommended effects and about effects whose conditions are missing.

    Args:
        comparison: The comparison.
        readings: Number of readings.
    """
    notes = [
        note(
            "effect not weighed",
            f"{name} was not compared: {count} of {readings} readings lack its conditions, the "
            f"first in {first}.",
            readings=float(count),
        )
        for name, (count, first) in comparison.lacking.items()
    ]
    if not comparison.weighed:
        return notes
    names, best = comparison.recommended, comparison.best
    texts = [f"Recommended effects: {joined(names) if names else 'none'}."]
    if comparison.stated:
        texts.append(
            f"The machine states {joined(comparison.stated)}, so every model contains "
            f"{'it' if len(comparison.stated) == 1 else 'them'}."
        )
    unshown = [n for n in best.effects if n not in comparison.shown]
    if comparison.shown:
        texts.append(f"The readings clearly show {joined(comparison.shown)}.")
    if unshown:
        entering = "; `calibrate` decides for each drive whether to enter it"
        texts.append(
            f"The readings together do not clearly show {joined(unshown)}"
            f"{entering if 'backlash' in unshown else ''}."
        )
    if not best.effects:
        single = [w.effects[0] for w in comparison.weighed if len(w.effects) == 1]
        texts.append(f"The readings do not clearly show {joined(single, 'or')}.")
    action = ""
    if set(names) - set(comparison.stated):
        action = identify_effects(names)
    numbers = {"log_evidence": best.log_evidence, "prediction_rms_mm": best.prediction_rms / MM}
    return [note("effects recommended", " ".join(texts), action, **numbers), *notes]


def not_recommended(
    model: str, evidence: float, prediction_error: float, best_error: float
) -> Finding:
    """Finding about a model that is not recommended.

    Args:
        model: Name of the model.
        evidence: Log evidence relative to the recommended model.
        prediction_error: RMS cross-validation error of the model, [m].
        best_error: RMS cross-validation error of the recommended model, [m].
    """
    predicts = (
        f"it predicts left-out setups to {mm(prediction_error)} mm instead of {mm(best_error)} mm"
    )
    return note(
        "not recommended",
        f"{model}: ln evidence {evidence:+.1f} relative to the recommended model; {predicts}.",
        log_evidence=evidence,
        prediction_rms_mm=prediction_error / MM,
        recommended_prediction_rms_mm=best_error / MM,
    )


def not_determined(model: str, reason: str) -> Finding:
    """Finding about a model that the readings do not determine."""
    return note("not determined", f"{model}: not determined. {reason}.")


def linearisation_cost(rms: float) -> Finding:
    """Finding about the increase of the tool error by linearisation, RMS, [m]."""
    return note(
        "linearisation cost",
        f"Linearisation costs {tool_mm(rms)} RMS at the tool.",
        cost_um=rms / UM,
    )
