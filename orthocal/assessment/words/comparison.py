"""Wording of findings about a comparison of models."""

from __future__ import annotations

import math

from orthocal.assessment.effect_comparison import EffectComparison
from orthocal.assessment.recommendation import Recommendation
from orthocal.assessment.wording import joined, mm, note, tool_mm
from orthocal.assessment.words.effects import identify_effects
from orthocal.calibration.assessment_record import Finding
from orthocal.effects.registry import order_effects
from orthocal.io.documents import LARGEST_NUMBER
from orthocal.units import MM, UM


def describe_recommendation(found: Recommendation, *, chosen: str | None = None) -> list[Finding]:
    """The recommended model, and tolerances of another size if they are strongly supported.

    Args:
        found: The recommendation.
        chosen: The model that was identified.
    """
    evidence = found.of(found.model)
    if evidence > 0.0:
        reason = (
            "The readings support it strongly against the complete model: errors beyond it are "
            "too small to be seen."
        )
    else:
        reason = "It is the complete model, and the readings support no smaller one strongly."
    other = -found.of(chosen) + evidence if chosen is not None else math.nan
    numbers = {"log_evidence": evidence}
    if math.isfinite(other) and chosen != found.model:
        # of a gauge that would be far finer than any machine, without meaning as a number
        numbers["log_evidence_against_chosen"] = min(max(other, -LARGEST_NUMBER), LARGEST_NUMBER)
    findings = [note("recommended", f"Recommended model: {found.model}. {reason}", **numbers)]
    if found.tolerance_scale != 1.0:
        findings.append(
            note(
                "tolerances differ",
                f"The readings strongly support tolerances of {found.tolerance_scale:.2g} times "
                "the stated ones.",
                "State other tolerances in the session or by --tolerance if that is plausible.",
                tolerance_scale=found.tolerance_scale,
                log_evidence=found.scale_evidence,
            )
        )
    return findings


def describe_effects(found: EffectComparison | None, readings: int) -> list[Finding]:
    """Effects that the readings support, and those that they cannot show.

    Args:
        found: The comparison; None without candidates.
        readings: Number of readings.
    """
    if found is None:
        return []
    notes = [
        note(
            "effect not weighed",
            f"{name} was not weighed: {count} of {readings} readings lack its conditions, the "
            f"first in {first}.",
            readings=float(count),
        )
        for name, (count, first) in found.lacking.items()
    ]
    if not found.weighed:
        return notes
    none, best = found.weighed[0], found.best
    tried = joined([w.effects[0] for w in found.weighed if len(w.effects) == 1], "or")
    if not found.recommended:
        text, action = (
            f"Recommended effects: none. The readings do not support {tried} strongly.",
            "",
        )
    else:
        names, missing = found.recommended, set(found.recommended) - set(found.identified)
        them, are = ("it", "is") if len(names) == 1 else ("them", "are")
        worse = round(best.unseen_rms / MM, 3) > round(none.unseen_rms / MM, 3)  # as printed
        text = (
            f"Recommended effects: {joined(names)}. The readings are much more likely with {them} "
            f"(ln evidence {best.log_evidence:+.1f}). Left-out setups are predicted "
            f"{'worse, ' if worse else ''}to {mm(best.unseen_rms)} mm, without to "
            f"{mm(none.unseen_rms)} mm"
        )
        text += "; the evidence counts, which is of all readings together." if worse else "."
        action = ""
        if missing or found.named:
            every = order_effects({*found.identified, *names})
            action = identify_effects(every, found.named)
        else:
            text += f" {joined(names).capitalize()} {are} identified already."
    numbers = {"log_evidence": best.log_evidence, "unseen_rms_mm": best.unseen_rms / MM}
    return [note("effects recommended", text, action, **numbers), *notes]


def not_recommended(model: str, evidence: float, unseen: float, best_unseen: float) -> Finding:
    """A model that is not recommended, and why."""
    predicts = f"it predicts left-out setups to {mm(unseen)} mm instead of {mm(best_unseen)} mm"
    return note(
        "not recommended",
        f"{model}: ln evidence {evidence:+.1f} relative to the recommended model; {predicts}.",
        log_evidence=evidence,
        unseen_rms_mm=unseen / MM,
        recommended_unseen_rms_mm=best_unseen / MM,
    )


def not_determined(model: str, reason: str) -> Finding:
    """A model that the readings do not determine."""
    return note("not determined", f"{model}: not determined. {reason}.")


def linearisation_cost(rms: float) -> Finding:
    """Tool error that linearisation costs."""
    return note(
        "linearisation error",
        f"Linearisation costs {tool_mm(rms)} RMS at the tool.",
        cost_um=rms / UM,
    )
