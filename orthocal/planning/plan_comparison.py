"""What a plan is held against: usual ones at equal cost, and the same readings by other means."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import OrthocalError
from orthocal.kinematics.workspace import tool_at_zero
from orthocal.measurement.joining import join_sessions
from orthocal.planning.candidates import Candidates, Kind
from orthocal.planning.equipment import Means
from orthocal.planning.expected_error import Expected, ToolForecast
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.sensors.rod_indicator import RodByBall, RodByBlade, RodIndicator
from orthocal.sensors.tips import Tip
from orthocal.session.session import Gauge, Reading, Session, Setup

Array = NDArray[np.float64]

MIDDLE = 0.5
"""Of a leg: where the paper's gauges stand."""

BLADE = Tip("blade", 0.0, 20e-3)

FINER = 0.5
"""Of the scatter and the resolution of the dial at hand."""


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """Another plan, or the same one by other means."""

    name: str
    setups: int
    readings: int
    minutes: float
    expected: Expected


def list_usual_plans(
    candidates: Candidates,
    plan: Session,
    means: Means,
    forecast: ToolForecast,
    measured: Session | None,
) -> tuple[Alternative, ...]:
    """What is read without a plan, with as many setups and readings.

    The paper's: each leg in the middle, in both directions, in the mechanical zero and as far as
    it goes to either side, again and again. And evenly along the same ways.
    """
    kinds = _middle_kinds(candidates)
    count, total = len(plan.setups), len(plan.readings)
    chosen = [kinds[i % len(kinds)] for i in range(count)] if kinds else []
    each = [total // count + (i < total % count) for i in range(count)]
    found = []
    for name, select in (("the paper's", _ends_and_middle), ("even", _evenly)):
        setups, readings = {}, []
        for i, (kind, n) in enumerate(zip(chosen, each, strict=True)):
            rows = select(_own_way(candidates, kind), n)
            own = f"{kind.name}.{i}"
            setups[own] = replace(candidates.session.setups[kind.name], name=own)
            seen: dict[str, int] = {}
            for r in rows:
                seen[r.posture] = seen.get(r.posture, 0) + 1
                readings.append(replace(r, setup=own, cycle=seen[r.posture]))
        if not readings:
            continue
        session = replace(candidates.session, setups=setups, readings=tuple(readings))
        session = session.select(session.readings)
        found.append(_alternative(name, session, means, forecast, measured))
    return tuple(found)


def list_alternatives(
    plan: Session, means: Means, forecast: ToolForecast, measured: Session | None
) -> tuple[Alternative, ...]:
    """The same readings with a finer dial, a blade, or the gauges of a leg on a square block."""
    changes: list[tuple[str, Callable[[Session], Session]]] = [
        ("a dial of half the scatter and resolution", _with_finer_dial),
        ("each leg's gauges on one square block", _with_blocks),
    ]
    if any(isinstance(s.sensor, RodByBall) for s in plan.setups.values()):
        changes.append(("a blade instead of the ball", _with_blade))
    found = []
    for name, change in changes:
        try:
            found.append(_alternative(name, change(plan), means, forecast, measured))
        except OrthocalError:
            continue  # what cannot stand so is no help
    return tuple(found)


def _alternative(
    name: str, session: Session, means: Means, forecast: ToolForecast, measured: Session | None
) -> Alternative:
    whole = session if measured is None else join_sessions([measured, session])
    minutes = means.minutes(len(session.setups), len(session.readings))
    expected = forecast.after(whole)
    return Alternative(name, len(session.setups), len(session.readings), minutes, expected)


def _middle_kinds(candidates: Candidates) -> list[Kind]:
    """Setups in the middle of each leg, for rods where they lie in the zero posture."""
    best: dict[tuple[str, object], tuple[float, Kind]] = {}
    for kind in candidates.kinds:
        sensor = candidates.session.setups[kind.name].sensor
        if not isinstance(sensor, LegIndicator | RodIndicator):
            continue
        if isinstance(sensor, RodIndicator) and any(sensor.beside):
            continue
        key = (sensor.leg, sensor.direction)
        away = abs(sensor.section.value - MIDDLE)
        if key not in best or away < best[key][0]:
            best[key] = (away, kind)
    return [kind for _, kind in best.values()]


def _own_way(candidates: Candidates, kind: Kind) -> list[Reading]:
    """Readings of a setup while the tool moves along its leg through the zero, in order."""
    session = candidates.session
    middle = tool_at_zero(session.robot)
    readings = [session.readings[i] for i in kind.rows]
    points = np.array([session.postures[r.posture].values for r in readings]) - middle
    spans = np.ptp(points, axis=0)
    along = int(spans.argmax())
    aside = np.delete(np.abs(points), along, axis=1).max(axis=1, initial=0.0)
    on = np.flatnonzero(aside < 1e-9)
    return [readings[i] for i in on[np.argsort(points[on, along])]]


def _ends_and_middle(way: Sequence[Reading], count: int) -> list[Reading]:
    """Zero, last and first, over and over."""
    if not way:
        return []
    zero = min(range(len(way)), key=lambda i: (way[i].posture != "zero", abs(2 * i - len(way))))
    three = [way[zero], way[-1], way[0]]
    return [three[i % 3] for i in range(count)]


def _evenly(way: Sequence[Reading], count: int) -> list[Reading]:
    """Evenly from the first to the last."""
    if not way:
        return []
    places = np.linspace(0, len(way) - 1, count).round().astype(int)
    return [way[i] for i in places]


def _with_finer_dial(session: Session) -> Session:
    old = session.gauge
    gauge = Gauge(
        None if old.sigma is None else FINER * old.sigma,
        None if old.resolution is None else FINER * old.resolution,
        old.range,
    )
    return replace(session, gauges={"": gauge})


def _with_blocks(session: Session) -> Session:
    def blocked(setup: Setup) -> Setup:
        sensor = setup.sensor
        if not isinstance(sensor, LegIndicator | RodIndicator):
            return setup
        standing = replace(sensor.standing, stand=f"block_{sensor.leg}")
        return replace(setup, sensor=replace(sensor, standing=standing))

    return replace(session, setups={n: blocked(s) for n, s in session.setups.items()})


def _with_blade(session: Session) -> Session:
    def bladed(setup: Setup) -> Setup:
        s = setup.sensor
        if not isinstance(s, RodByBall):
            return setup
        sensor = RodByBlade(s.leg, s.rod, s.direction, s.section, BLADE, s.standing, s.beside)
        return replace(setup, sensor=sensor)

    return replace(session, setups={n: bladed(s) for n, s in session.setups.items()})
