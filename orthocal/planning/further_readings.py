"""Further readings that determine an effect if a plan does not, and their gain.

For thermal expansion, a second round of the plan is measured on a warmer machine. For drift of a
gauge, the first posture of each setup is read again some time after its last reading.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta

from orthocal.assessment.effect_limits import EffectLimits
from orthocal.assessment.effect_separability import WARMER
from orthocal.effects.loading import identified_effects, neutral_values
from orthocal.effects.protocol import Condition
from orthocal.planning.plan_comparison import Comparison
from orthocal.session.points import one_row_per_point
from orthocal.session.session import Conditions, Reading, Session

WAITING_TIMES = (10.0, 20.0, 30.0, 60.0, 120.0)
"""Possible times between the last reading of a setup and the further one, [min]."""


@dataclass(frozen=True, slots=True)
class FurtherReadings:
    """Readings in addition to a plan, for an effect that the plan does not determine."""

    limit: EffectLimits
    """Limits of the effect before the plan, and after the plan and these readings."""
    readings: int
    minutes: float
    """Additional time, [min]."""
    warmer: float = 0.0
    """Temperature rise of the machine in a second round of the plan, [K]; 0 without one."""
    wait: float = 0.0
    """Time after the last reading of each setup when its first posture is read again, [min]."""
    gain: float = 0.0
    """Relative reduction of the tool error, to first order about the nominal machine."""


def find_further_readings(
    comparison: Comparison, limits: Sequence[EffectLimits]
) -> tuple[FurtherReadings, ...]:
    """Further readings for each effect that a plan does not determine.

    Args:
        comparison: The plan with its equipment.
        limits: Limits of the effects after the plan.

    Returns:
        The shortest further readings that determine the effect, or else the longest ones. Effects
        whose limit no further readings reduce have no entry.
    """
    conditions = {e.name: e.conditions for e in identified_effects(comparison.plan.robot)}
    proposals = []
    for limit in limits:
        if limit.determined:
            continue
        further = None
        for session, proposed in _extensions(comparison, limit, conditions[limit.effect]):
            further = _evaluate(comparison, session, proposed)
            if further.limit.determined:
                break
        if further is not None and further.limit.after < limit.after:
            proposals.append(further)
    return tuple(proposals)


def _evaluate(
    comparison: Comparison, session: Session, further: FurtherReadings
) -> FurtherReadings:
    """Further readings with the limit of the effect after them, and their gain at the tool."""
    forecast, plan = comparison.forecast, comparison.equipment.schedule(comparison.plan)
    session, limit = comparison.join(session), further.limit
    limits = forecast.limits(session)
    after = next(e for e in limits if (e.effect, e.unit) == (limit.effect, limit.unit))
    sessions = session, comparison.join(plan)
    tool, without = (forecast.about_nominal(s).reported.rms for s in sessions)
    return replace(further, limit=after, gain=1.0 - tool / without)


def _extensions(
    comparison: Comparison, limit: EffectLimits, conditions: Sequence[Condition]
) -> Iterator[tuple[Session, FurtherReadings]]:
    """Plans with further readings for an effect, and these readings, the shortest first."""
    plan = comparison.equipment.schedule(comparison.plan)
    rows = one_row_per_point(plan)
    setups, readings = len(rows.setups), len(rows.readings)
    if "temperature" in conditions:
        minutes = comparison.equipment.minutes_of(plan)
        yield _read_again_warmer(plan), FurtherReadings(limit, readings, minutes, WARMER)
    if "time" in conditions:
        for wait in WAITING_TIMES:
            further = FurtherReadings(limit, setups, wait * setups, wait=wait)
            yield _read_again_later(plan, wait), further


def _read_again_warmer(plan: Session) -> Session:
    """Plan with a second round on a warmer machine, with gauges mounted again."""
    names = {name: f"{name}_warm" for name in plan.setups}
    warm_setups = {names[n]: replace(setup, name=names[n]) for n, setup in plan.setups.items()}
    reference = neutral_values(plan.robot)["temperature"]
    readings = list(plan.readings)
    for r in plan.readings:
        conditions = r.conditions or Conditions()
        cool = reference if conditions.temperature is None else conditions.temperature
        warm = replace(conditions, temperature=cool + WARMER)
        readings.append(replace(r, setup=names[r.setup], conditions=warm))
    setups = {**plan.setups, **warm_setups}
    return replace(plan, setups=setups, readings=tuple(readings), sha256="")


def _read_again_later(plan: Session, wait: float) -> Session:
    """Plan in which the first posture of each setup is read again after its last reading.

    Args:
        plan: The plan, with times.
        wait: Time between these two readings, [min].
    """
    of_setup: dict[str, list[Reading]] = {}
    for r in plan.readings:
        of_setup.setdefault(r.setup, []).append(r)
    readings = []
    for rows in of_setup.values():
        first, last = rows[0], rows[-1].conditions or Conditions()
        time = None if last.time is None else last.time + timedelta(minutes=wait)
        cycle = max(r.cycle for r in rows if r.posture == first.posture) + 1
        conditions = replace(first.conditions or Conditions(), time=time)
        readings += [*rows, replace(first, cycle=cycle, conditions=conditions)]
    return replace(plan, readings=tuple(readings), sha256="")
