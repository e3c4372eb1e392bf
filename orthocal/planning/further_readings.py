"""Readings that would determine effects that a plan does not, and what they bring.

For the expansion of a machine they are a second round of the plan on a warmer machine, for the
drift of a gauge the first posture of each setup once more, some time after its last reading.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import NamedTuple

from orthocal.assessment.effect_limits import EffectLimits, find_limits
from orthocal.assessment.effect_separability import WARMER
from orthocal.effects.loading import measurable_effects, neutral_values
from orthocal.effects.protocol import Condition
from orthocal.planning.expected_error import noise_of
from orthocal.planning.plan_comparison import Comparison
from orthocal.session.points import one_row_a_point
from orthocal.session.session import Conditions, Reading, Session

WAITS = (10.0, 20.0, 30.0, 60.0, 120.0)
"""Minutes between the last reading of a setup and the further one that are tried."""


@dataclass(frozen=True, slots=True)
class FurtherReadings:
    """Readings beside a plan for an effect that it does not determine."""

    limit: EffectLimits
    """Limit of the effect before the readings and after all of them."""
    readings: int
    minutes: float
    """Time that they take."""
    warmer: float
    """Kelvin by which the machine is warmer in a second round of the plan; 0 for no such round."""
    wait: float
    """Minutes after the last reading of each setup at which its first posture is read again."""
    gain: float
    """Part by which they reduce the tool error, to first order about the nominal machine."""


class _Extension(NamedTuple):
    """A plan with further readings; fields as in `FurtherReadings`."""

    session: Session
    readings: int
    minutes: float
    warmer: float = 0.0
    wait: float = 0.0


def find_further_readings(
    comparison: Comparison, limits: Sequence[EffectLimits]
) -> tuple[FurtherReadings, ...]:
    """Readings for each effect that a plan does not determine.

    Args:
        comparison: The plan with its equipment.
        limits: Limits of the effects after it.

    Returns:
        One for each effect: the shortest that determine it, or else the longest that are tried.
        None for effects that no readings of these kinds would show.
    """
    conditions = {e.name: e.conditions for e in measurable_effects(comparison.plan.robot)}
    proposals = []
    for limit in limits:
        tried = list[FurtherReadings]()
        if not limit.determined:
            for extension in _extensions(comparison, conditions[limit.effect]):
                tried.append(_evaluate(comparison, extension, limit))
                if tried[-1].limit.determined:
                    break
        proposals += [further for further in tried[-1:] if further.limit.after < limit.after]
    return tuple(proposals)


def _evaluate(
    comparison: Comparison, extension: _Extension, limit: EffectLimits
) -> FurtherReadings:
    """The limit of an effect after further readings, and their gain at the tool."""
    forecast, plan = comparison.forecast, comparison.equipment.in_course(comparison.plan)
    session = comparison.join(extension.session)
    limits = find_limits(forecast.problem(session), noise_of(session))
    after = next(e for e in limits if (e.effect, e.unit) == (limit.effect, limit.unit))
    sessions = session, comparison.join(plan)
    tool, without = (forecast.about_nominal(s).reported.rms for s in sessions)
    return FurtherReadings(
        limit=after,
        readings=extension.readings,
        minutes=extension.minutes,
        warmer=extension.warmer,
        wait=extension.wait,
        gain=1.0 - tool / without,
    )


def _extensions(comparison: Comparison, conditions: Sequence[Condition]) -> Iterator[_Extension]:
    """Plans with further readings for an effect, the shortest first."""
    plan = comparison.equipment.in_course(comparison.plan)
    rows = one_row_a_point(plan)
    setups, readings = len(rows.setups), len(rows.readings)
    if "temperature" in conditions:
        minutes = comparison.equipment.minutes_of(plan)
        yield _Extension(_read_again_warmer(plan), readings, minutes, warmer=WARMER)
    if "time" in conditions:
        for wait in WAITS:
            yield _Extension(_read_again_later(plan, wait), setups, wait * setups, wait=wait)


def _read_again_warmer(plan: Session) -> Session:
    """Plan with a second round, for which the gauges are mounted again, on a warmer machine."""
    names = {name: f"{name}_warm" for name in plan.setups}
    again = {names[n]: replace(setup, name=names[n]) for n, setup in plan.setups.items()}
    reference = neutral_values(plan.robot)["temperature"]
    readings = list(plan.readings)
    for r in plan.readings:
        known = r.conditions or Conditions()
        cool = reference if known.temperature is None else known.temperature
        warm = replace(known, temperature=cool + WARMER)
        readings.append(replace(r, setup=names[r.setup], conditions=warm))
    return replace(plan, setups={**plan.setups, **again}, readings=tuple(readings), sha256="")


def _read_again_later(plan: Session, wait: float) -> Session:
    """Plan in which the first posture of each setup is read again after its last reading.

    Args:
        plan: The plan, with times.
        wait: Minutes between the two.
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
