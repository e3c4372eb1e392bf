"""Comparison of a plan with usual plans at equal cost, and with other gauges."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from orthocal.errors import OrthocalError
from orthocal.kinematics.workspace import tool_at_zero
from orthocal.measurement.joining import join_sessions
from orthocal.planning.candidates import MIN_READINGS, Candidates, CandidateSetup
from orthocal.planning.equipment import Equipment, indicators
from orthocal.planning.expected_error import Expected, ToolForecast
from orthocal.planning.planned_session import build_session
from orthocal.planning.selection import PlannedSetup
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.sensors.tips import Tip
from orthocal.session.points import one_row_per_point
from orthocal.session.session import Gauge, Session

MIDDLE_SECTION = 0.5
"""Section of the paper's gauges, as a fraction of the leg."""

BLADE = Tip("blade", 0.0, 20e-3)
"""Blade of 20 mm width."""

PAPER_READINGS = 4
"""Readings of each of the paper's setups: mechanical zero, both ends, mechanical zero again."""

FINE_DIAL_FACTOR = 0.5
"""Factor of sigma and resolution of a finer dial."""


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """Another plan, or the same plan with another gauge."""

    name: str
    setups: int
    readings: int
    minutes: float
    expected: Expected | None
    """Expected tool error; None if readings are out of the gauge's range."""
    planned: tuple[PlannedSetup, ...] = ()
    """Setups of another plan, without their closing readings; empty for another gauge."""


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A plan and its alternatives."""

    candidates: Candidates
    plan: Session
    equipment: Equipment
    forecast: ToolForecast
    measured: Session | None

    @property
    def entered(self) -> bool:
        """True if identified offsets are entered before the readings are taken.

        Readings that complement a session are taken with the active offsets of the session.
        """
        return self.measured is None or bool(np.any(self.measured.active_offsets))

    def join(self, planned: Session) -> Session:
        """Join planned readings with the existing readings, if any."""
        return planned if self.measured is None else join_sessions([self.measured, planned])

    def list_usual_plans(self) -> tuple[Alternative, ...]:
        """Usual plans with the same numbers of setups and readings as the plan.

        The paper's plan reads each leg at its middle in both directions, in the mechanical zero and
        at both ends of the travel, repeatedly. The other has evenly spaced postures on the same
        lines. Each setup ends with its first posture.
        """
        setups = self._middle_setups()
        if not setups:
            return ()
        count, total = len(self.plan.setups), len(self.plan.readings)
        if self.equipment.owned:  # setups with dials at the legs in the same time
            minutes = self.equipment.minutes_of(self.plan)
            count = max(int(minutes / self.equipment.minutes(1, PAPER_READINGS)), 1)
            total = PAPER_READINGS * count
        chosen = [setups[i % len(setups)] for i in range(count)]
        counts = [total // count + (i < total % count) for i in range(count)]
        lines = [self._line(setup) for setup in chosen]
        plans = []
        for name, select in (("the paper's", _ends_and_zero), ("evenly spaced", _evenly)):
            rows = [select(*line, n - 1) for line, n in zip(lines, counts, strict=True)]
            if any(len(indices) < MIN_READINGS for indices in rows):
                continue
            planned = [self._as_planned(*of_setup) for of_setup in zip(chosen, rows, strict=True)]
            session = build_session(self.candidates, planned, self.measured)
            usual = self._assess(name, session, in_range=all(map(_is_in_range, chosen, rows)))
            plans.append(replace(usual, planned=tuple(planned)))
        return tuple(plans)

    def _as_planned(self, setup: CandidateSetup, rows: Sequence[int]) -> PlannedSetup:
        """Planned setup with rows of the session of candidates."""
        chosen = np.searchsorted(setup.rows, rows).tolist()
        return PlannedSetup(self.candidates.setups.index(setup), tuple(chosen))

    def expect(self, session: Session) -> Expected:
        """Expected tool error after planned readings, joined with the existing ones."""
        joined = self.join(self.equipment.schedule(session))
        return self.forecast.after(joined, entered=self.entered)

    def list_alternatives(self) -> tuple[Alternative, ...]:
        """The plan with a finer dial, a blade, or one square block per leg."""
        sensors = indicators(self.plan).values()
        if not sensors:
            return ()
        changes: list[tuple[str, Callable[[Session], Session]]] = [
            ("a dial of half the scatter and resolution", _with_finer_dial),
            ("each leg's gauges on one square block", _with_blocks),
        ]
        if any(s.tip.form == "ball" for s in sensors):
            changes.append(("a blade instead of the ball", _with_blade))
        alternatives = []
        for name, change in changes:
            try:
                alternatives.append(self._assess(name, change(self.plan)))
            except OrthocalError:
                continue  # this gauge cannot be mounted
        return tuple(alternatives)

    def _assess(self, name: str, session: Session, *, in_range: bool = True) -> Alternative:
        """Alternative with its expected tool error."""
        minutes, rows = self.equipment.minutes_of(session), one_row_per_point(session)
        expected = self.expect(session) if in_range else None
        return Alternative(name, len(rows.setups), len(rows.readings), minutes, expected)

    def _middle_setups(self) -> list[CandidateSetup]:
        """Setup nearest to the middle of each leg in each direction, with the tip on the rod."""
        best: dict[tuple[str, object], tuple[float, CandidateSetup]] = {}
        at_legs = indicators(self.candidates.session)
        for setup in self.candidates.setups:
            sensor = at_legs.get(setup.name)
            if sensor is None or any(sensor.beside):
                continue
            key = (sensor.leg, sensor.direction)
            distance = abs(sensor.section.value - MIDDLE_SECTION)
            if key not in best or distance < best[key][0]:
                best[key] = (distance, setup)
        return [setup for _, setup in best.values()]

    def _line(self, setup: CandidateSetup) -> tuple[list[int], int]:
        """Readings of a setup on the line along the leg through the mechanical zero.

        All readings have the same approach.

        Returns:
            Rows in the order of the line, and the index of the row nearest to the mechanical zero.
        """
        session = self.candidates.session
        readings = [session.readings[i] for i in setup.rows]
        points = np.array([session.postures[r.posture].values for r in readings])
        points -= tool_at_zero(session.robot)
        along = int(np.ptp(points, axis=0).argmax())
        across = np.delete(np.abs(points), along, axis=1).max(axis=1, initial=0.0)
        same_approach = np.array([r.approach == readings[0].approach for r in readings])
        line = np.flatnonzero((across < 1e-9) & same_approach)
        line = line[np.argsort(points[line, along])]
        nearest = int(np.abs(points[line, along]).argmin()) if line.size else 0
        return setup.rows[line].tolist(), nearest


def _is_in_range(setup: CandidateSetup, rows: Sequence[int]) -> bool:
    """True if all readings are within the range of a gauge that is centred on the first one."""
    chosen = np.searchsorted(setup.rows, rows)
    return bool(setup.reachable[chosen[:1], chosen].all())


def _ends_and_zero(line: Sequence[int], zero: int, count: int) -> list[int]:
    """Mechanical zero, last and first posture of a line, repeated up to a count."""
    if not line:
        return []
    postures = [line[zero], line[-1], line[0]]
    return [postures[i % 3] for i in range(count)]


def _evenly(line: Sequence[int], zero: int, count: int) -> list[int]:
    """Evenly spaced postures of a line; the one nearest to the mechanical zero comes first."""
    if not line:
        return []
    places = np.linspace(0, len(line) - 1, count).round().astype(int)
    first = int(np.abs(places - zero).argmin())
    return [line[i] for i in [places[first], *np.delete(places, first)]]


def _with_finer_dial(session: Session) -> Session:
    """Session with finer gauges at the legs."""
    gauges = dict(session.gauges)
    for name in {session.setups[n].gauge for n in indicators(session)}:
        old = gauges[name]
        sigma, resolution = (
            None if v is None else FINE_DIAL_FACTOR * v for v in (old.sigma, old.resolution)
        )
        gauges[name] = Gauge(sigma, resolution, old.range)
    return replace(session, gauges=gauges)


def _with_blocks(session: Session) -> Session:
    """Session in which all gauges of a leg are mounted on one square block."""
    return _with_sensors(
        session, lambda s: replace(s, mounting=replace(s.mounting, stand=f"block_{s.leg}"))
    )


def _with_blade(session: Session) -> Session:
    """Session in which all gauges at rods have a blade."""
    return _with_sensors(
        session, lambda s: s if s.rod is None else s.on_rod(s.rod, BLADE, s.beside)
    )


def _with_sensors(session: Session, change: Callable[[LegIndicator], LegIndicator]) -> Session:
    """Session with changed indicators at the legs."""
    changed = {
        name: replace(session.setups[name], sensor=change(sensor))
        for name, sensor in indicators(session).items()
    }
    return replace(session, setups={**session.setups, **changed})
