"""Comparison of effects beside geometry by the evidence of the readings.

Effects that the session or its robot states are recommended, whatever the evidence for them: they
are a part of the complete model, and their tolerances say how large they may be. `calibrate`
estimates them for the same reason, and decides for each drive what to enter. Other effects are
added one after the other as long as the evidence for them is strong.

The evidence is the marginal likelihood of the complete model with a set of effects. All sets have
the same noise of several gauges, from readings that all effects together hardly change. The
cross-validation error of setups is reported, but does not decide, as it depends on few readings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.assessment.recommendation import STRONG, compute_log_evidence
from orthocal.effects.loading import identified_effects
from orthocal.effects.registry import find_effect, order_effects
from orthocal.errors import RobotError
from orthocal.estimation.selection import complete_model
from orthocal.hypotheses.families.effects import missing_effects, rows_without
from orthocal.hypotheses.linear_model import linear_model
from orthocal.session.session import Session


@dataclass(frozen=True, slots=True, eq=False)
class WeighedEffects:
    """A set of effects and the evidence for it."""

    effects: tuple[str, ...]
    log_evidence: float
    """ln p(y) minus that without any of the candidates."""
    prediction_rms: float
    """RMS error of the prediction of each setup from all others, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class EffectComparison:
    """Comparison of effects that could be identified beside geometry."""

    weighed: tuple[WeighedEffects, ...]
    """No effect first, then the stated ones together, then others that were tried."""
    recommended: tuple[str, ...]
    """The stated effects, and others with strong evidence."""
    stated: tuple[str, ...]
    """Effects that the session or its robot states."""
    shown: tuple[str, ...]
    """Recommended effects for which the evidence is strong."""
    lacking: Mapping[str, tuple[int, str]]
    """Effect that was not compared, mapped to the number of readings that lack its conditions and
    the place of the first one."""

    @property
    def best(self) -> WeighedEffects:
        """The recommended effects, without those that were not weighed."""
        weighed = {name for w in self.weighed for name in w.effects}
        return next(w for w in self.weighed if set(w.effects) == weighed & set(self.recommended))


def compare_effects(session: Session) -> EffectComparison | None:
    """Compare the effects that a session or its robot states; without a choice all possible ones.

    Without a choice, drift is compared only if the time of the readings is stated, not their order.

    Args:
        session: The session, or several that were joined.

    Returns:
        None if there is nothing to compare.

    Raises:
        ClosureError: If the nominal machine cannot reach a posture.
    """
    candidates, lacking = _candidates(session)
    stated = tuple(session.robot.effect_names)
    if not candidates:
        return EffectComparison((), stated, stated, (), lacking) if lacking else None
    present = [e.name for e in identified_effects(session.robot)]
    not_measurable = [n for n in stated if n not in present]
    model = complete_model(session.robot.parameters)
    all_effects = (*not_measurable, *order_effects(candidates))
    evidence_and_rms: dict[tuple[str, ...], tuple[float, float]] = {}

    def log_evidence(names: Sequence[str]) -> float:
        trial = order_effects(names)
        if trial not in evidence_and_rms:
            with_them = session.with_effects((*not_measurable, *trial))
            linear = linear_model(with_them, noise_effects=all_effects)
            rms = float(np.sqrt(np.mean(linear.predict_left_out(session.values) ** 2)))
            evidence, _ = compute_log_evidence(with_them, model, noise_effects=all_effects)
            evidence_and_rms[trial] = evidence, rms
        return evidence_and_rms[trial][0]

    log_evidence(())
    supported = [n for n in candidates if n in stated]
    while remaining := [n for n in candidates if n not in supported]:
        most_likely = max(remaining, key=lambda n: log_evidence((*supported, n)))
        if log_evidence((*supported, most_likely)) < log_evidence(supported) + STRONG:
            break
        supported.append(most_likely)
    shown = [
        name
        for name in supported
        if log_evidence(supported) >= log_evidence([n for n in supported if n != name]) + STRONG
    ]
    weighed = [
        WeighedEffects(effects, evidence - evidence_and_rms[()][0], rms)
        for effects, (evidence, rms) in evidence_and_rms.items()
    ]
    recommended = order_effects((*stated, *supported))
    shown_in_order = order_effects(shown)
    return EffectComparison(tuple(weighed), recommended, stated, shown_in_order, lacking)


def _candidates(session: Session) -> tuple[list[str], dict[str, tuple[int, str]]]:
    """Effects to compare, and effects whose conditions are missing in some of the readings."""
    robot = session.robot
    present = [e.name for e in identified_effects(robot)]
    any_conditions = any(r.conditions for r in session.readings)
    possible = missing_effects(session) if any_conditions and robot.chosen_effects is None else ()
    any_time = any(r.conditions and r.conditions.time for r in session.readings)
    candidates, lacking = [], {}
    for name in (*present, *possible):
        rows_lacking = rows_without(session, name)
        conditions = find_effect(name, where="effects", error=RobotError).conditions
        if "time" in conditions and name not in present and not any_time:
            continue
        if not rows_lacking.size:
            candidates.append(name)
        elif rows_lacking.size < len(session.readings) or name in present:
            first_place = session.where(session.readings[int(rows_lacking[0])])
            lacking[name] = (int(rows_lacking.size), first_place)
    return candidates, lacking
