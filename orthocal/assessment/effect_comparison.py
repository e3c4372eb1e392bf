"""Effects beside geometry, weighed by the readings as models are.

By the marginal likelihood of the complete model with each set of effects. Effects are added one
after the other as long as the evidence for them is strong. The prediction of each setup from all
others is stated, too, but does not decide: it depends on few readings. Under a model that the
readings support, the estimate with it has the least expected tool error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.assessment.recommendation import STRONG, weigh_model
from orthocal.effects.loading import errors_of_no_model, measurable_effects
from orthocal.effects.registry import find_effect, order_effects
from orthocal.errors import RobotError
from orthocal.estimation.selection import complete_model
from orthocal.hypotheses.families.effects import missing_effects, rows_without
from orthocal.hypotheses.linear_model import linear_model
from orthocal.session.session import Session


@dataclass(frozen=True, slots=True, eq=False)
class WeighedEffects:
    """A set of effects, and what speaks for it."""

    effects: tuple[str, ...]
    log_evidence: float
    """ln p(y) less that without any of the candidates."""
    unseen_rms: float
    """RMS error of the prediction of setups from all others, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class EffectComparison:
    """Effects that could be identified beside geometry, weighed by the readings."""

    weighed: tuple[WeighedEffects, ...]
    """Without effects first, then each by itself, then the supported ones together."""
    recommended: tuple[str, ...]
    """Those for which the evidence is strong, whatever left-out setups say."""
    identified: tuple[str, ...]
    """Effects that the session or its robot chooses."""
    named: tuple[str, ...]
    """Errors of recommended effects that no model contains: `--free` names them."""
    lacking: Mapping[str, tuple[int, str]]
    """Effect that was not weighed to the number of readings without its conditions, and the place
    of the first."""

    @property
    def best(self) -> WeighedEffects:
        """The recommended set."""
        return next(w for w in self.weighed if w.effects == self.recommended)


def compare_effects(session: Session) -> EffectComparison | None:
    """Weigh the effects that a session or its robot chooses; without a choice all possible ones.

    Without a choice drift needs the time of the readings, not only their order.

    Args:
        session: The session, or several that were joined.

    Returns:
        None if there is nothing to weigh.

    Raises:
        ClosureError: If the nominal machine cannot reach a posture.
    """
    candidates, lacking = _candidates(session)
    chosen = tuple(session.robot.effect_names)
    if not candidates:
        return EffectComparison((), (), chosen, (), lacking) if lacking else None
    present = [e.name for e in measurable_effects(session.robot)]
    computed = [n for n in chosen if n not in present]
    model = complete_model(session.robot.parameters)
    known: dict[tuple[str, ...], tuple[float, float]] = {}

    def weigh(names: Sequence[str]) -> float:
        trial = order_effects(names)
        if trial not in known:
            with_them = session.with_effects((*computed, *trial))
            free = errors_of_no_model(with_them.robot)
            errors = linear_model(with_them, free=free).predict_left_out(session.values)
            rms = float(np.sqrt(np.mean(errors**2)))
            known[trial] = weigh_model(with_them, model, free=free)[0], rms
        return known[trial][0]

    weigh(())
    supported: tuple[str, ...] = ()
    while more := [n for n in candidates if n not in supported]:
        likeliest = max(more, key=lambda n: weigh((*supported, n)))
        if weigh((*supported, likeliest)) < weigh(supported) + STRONG:
            break
        supported = order_effects((*supported, likeliest))
    weighed = [WeighedEffects(n, e - known[()][0], rms) for n, (e, rms) in known.items()]
    named = errors_of_no_model(session.with_effects(supported).robot)
    return EffectComparison(tuple(weighed), supported, chosen, named, lacking)


def _candidates(session: Session) -> tuple[list[str], dict[str, tuple[int, str]]]:
    """Effects to weigh, and those that lack conditions in some of the readings."""
    robot = session.robot
    present = [e.name for e in measurable_effects(robot)]
    stated = any(r.conditions for r in session.readings)
    possible = missing_effects(session) if stated and robot.chosen_effects is None else ()
    timed = any(r.conditions and r.conditions.time for r in session.readings)
    candidates, lacking = [], {}
    for name in (*present, *possible):
        rows = rows_without(session, name)
        conditions = find_effect(name, where="effects", error=RobotError).conditions
        if "time" in conditions and name not in present and not timed:
            continue
        if not rows.size:
            candidates.append(name)
        elif rows.size < len(session.readings) or name in present:
            first = session.where(session.readings[int(rows[0])])
            lacking[name] = (int(rows.size), first)
    return candidates, lacking
