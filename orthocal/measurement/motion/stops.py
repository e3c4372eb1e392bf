"""Stops of the machine in postures, and the sides from which its drives approach them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import ClosureError, SessionError
from orthocal.kinematics.loop_closure import find_beyond_travel, nominal_closure
from orthocal.measurement.motion.approach import (
    approach_length,
    approach_share,
    approach_steps,
    fill_approach,
)
from orthocal.measurement.motion.guidance import below_bed
from orthocal.observation.observations import drive_table
from orthocal.robot.model import require_tcp
from orthocal.sensors.points import Points
from orthocal.sensors.protocol import Sensor, has_dial, instrument
from orthocal.session.order import order_of_measurement
from orthocal.session.session import Reading, Session

Role = Literal["alignment", "reading", "subtracted", "return"]


@dataclass(frozen=True, slots=True, eq=False)
class Stop:
    """Posture in which the machine stops, and the path that leads to it."""

    posture: str
    role: Role
    """Alignment of the gauge, posture to read, posture whose reading is subtracted from the next
    one, or return to the first posture."""
    line: int | None
    """Line of readings.csv; None for the alignment and the return."""
    repeats: int | None
    """Line of the setup's first reading, if this stop reads the first posture again."""
    cycle: int
    approach: str
    """Direction of each drive at the end of the path: p if its coordinate grows, n if it falls."""
    drives: Array
    """Nominal drive coordinates, shape (n_drives,), [m, rad]."""
    approach_drives: Array
    """Drive coordinates at the start of the approach, shape (n_drives,), [m, rad]."""
    point: Array | None
    """Commanded tool coordinates, shape (n_coordinates,), [m]; None if the drives do not command
    the tool."""
    approach_point: Array | None
    """Tool coordinates at the start of the approach, shape (n_coordinates,), [m]."""
    via: tuple[Array, ...] = ()
    """Tool coordinates on the path to the start of the approach, [m]: the mechanical zero if the
    direct path is out of reach, or the corners of a path that the sensor prescribes."""
    lift: str = ""
    """Reason to hold the plunger up on this path; empty if it may stay on the rod."""
    expected: float = 0.0
    """Reading of the nominal machine, [m], if the dial is set in the first posture or the gauge
    zero is known."""
    path: Array | None = None
    """Nominal drive coordinates along the path, shape (n, n_drives), [m, rad]; None if the drives
    do not command the tool."""

    @property
    def label(self) -> str:
        """Line of readings.csv, or the posture of a stop without a reading."""
        return self.posture if self.line is None else f"line {self.line}"


@dataclass(frozen=True, slots=True, eq=False)
class SetupMotion:
    """Path through all postures of a setup, and back to the first posture."""

    setup: str
    number: int
    """Position in the order of measurement, from 1."""
    count: int
    """Number of setups."""
    alignment: Stop | None
    """Stop in the alignment posture; None if that is the first posture of `stops`."""
    stops: tuple[Stop, ...]
    """Stops in the postures to read, and in the first of them again."""

    @property
    def lifting(self) -> str:
        """Instruction for the motions during which the plunger is held up; empty without them."""
        lifted = [s for s in self.stops if s.lift]
        if not lifted:
            return ""
        places = ", ".join(dict.fromkeys(s.label for s in lifted))
        return f"Hold the plunger up on the way to {places}: {lifted[0].lift} there."

    def closing(self, stop: Stop, sensor: Sensor) -> str:
        """Instruction for a stop that repeats the first posture; empty for other stops."""
        if stop.repeats is None:
            return ""
        if isinstance(sensor, Points):
            return f"the instrument must show the point of line {stop.repeats} again"
        first = "0" if self.stops[0].role == "subtracted" else f"the reading of line {stop.repeats}"
        return f"the {'dial' if has_dial(sensor) else instrument(sensor)} must show {first} again"


Place = tuple[str, str | None]
"""Posture and stated approach, which is None if not stated."""

Approaches = dict[Place, Stop]


def stops_on_path(session: Session, setup: str) -> Approaches:
    """Stops of a setup whose approaches follow from its path."""
    robot, names = session.robot, list(session.postures)
    nominal = drive_table(session) + session.active_offsets
    tool = nominal_closure(robot).forward(nominal, names=names)
    drives = dict(zip(names, nominal, strict=True))
    points = dict(zip(names, tool[:, list(require_tcp(robot).coordinates)], strict=True))
    places = _places([r for r in session.readings if r.setup == setup])
    return {
        (name, stated): Stop(
            *(name, "reading", None, None, 1, fill_approach(robot, stated, "u")),
            *(drives[name], drives[name], points[name], points[name]),
        )
        for name, stated in places | {(session.alignment_postures[setup], None)}
    }


def _places(readings: Collection[Reading]) -> set[Place]:
    """Postures and stated approaches of readings; a subtracted posture has no stated approach."""
    subtracted = {(r.minus, None) for r in readings if r.minus is not None}
    return {(r.posture, r.approach) for r in readings} | subtracted


def unguided_places(session: Session, guided: Collection[str]) -> list[Place]:
    """Postures to read or to align a gauge, with stated approaches, of setups without a path."""
    ordered = (session.readings[i] for i in order_of_measurement(session.readings))
    unguided = [r for r in ordered if r.setup not in guided]
    first = {r.setup: r.minus or r.posture for r in reversed(unguided)}
    aligned_at = session.alignment_postures
    aligned: set[Place] = {(aligned_at[s], None) for s, p in first.items() if aligned_at[s] != p}
    order = {name: i for i, name in enumerate(session.postures)}
    return sorted(_places(unguided) | aligned, key=lambda place: (order[place[0]], place[1] or ""))


def find_approaches(session: Session, places: Sequence[Place]) -> Approaches:
    """Stops to read or to align a gauge, each at the end of its approach.

    Postures without a stated approach are all approached from one side. The same side applies to
    drives with the letter u.

    Args:
        session: The session.
        places: Postures and stated approaches.

    Raises:
        SessionError: If neither side is possible in all these postures, or a posture cannot be
            approached as stated.
    """
    if not places:
        return {}
    refused: list[ClosureError] = []
    for letter in "pn":
        stops, failures = begin_approaches(session, places, letter)
        first = free_failure(failures)
        if first is not None:
            refused.append(first)
            continue
        for (name, stated), error in failures.items():
            raise SessionError(
                f"cannot be approached as stated ({stated}) by {approach_length(session)}: "
                f"{error.reason}",
                where=f"{session.path or 'session'}: postures.{name}",
            )
        return stops
    raise SessionError(
        "can be approached neither from below nor from above by "
        f"{approach_length(session)}: {refused[0].reason}",
        where=f"{session.path or 'session'}: postures.{refused[0].posture}",
    )


def free_failure(failures: Mapping[Place, ClosureError]) -> ClosureError | None:
    """First error of a place where the side of a drive is not stated; None without one."""
    return next((e for (_, stated), e in failures.items() if "u" in (stated or "u")), None)


def begin_approaches(
    session: Session, places: Sequence[Place], letter: str
) -> tuple[Approaches, dict[Place, ClosureError]]:
    """Stops of postures with their approaches.

    Args:
        session: The session.
        places: Postures and stated approaches.
        letter: Direction of drives without a stated one.

    Returns:
        Stops by place, and no errors; or no stops, and errors by place whose approach is out of
        reach or below a bed.
    """
    robot, names = session.robot, [name for name, _ in places]
    closure, unknown = nominal_closure(robot), "u" * len(robot.drives)
    nominal = np.array([session.postures[n].drives + session.active_offsets for n in names])
    share = approach_share(session)
    steps = [approach_steps(robot, stated or unknown, letter, share=share) for _, stated in places]
    drives = nominal - np.array(steps)
    failures = find_beyond_travel(robot, drives, names)
    if not failures:
        passive = closure.close(drives, names=names, failures=failures)
    ends: Sequence[Array | None] = [None] * len(names)
    starts = ends
    if not failures and robot.commands_tool and robot.tcp is not None:
        coordinates = list(robot.tcp.coordinates)
        ends = list(closure.forward(nominal, names=names)[:, coordinates])
        starts = list(closure.tcp(drives, passive)[:, coordinates])
        for points in (ends, starts):
            failures |= below_bed(session, np.array(points), names)
    if failures:
        return {}, {places[i]: error for i, error in failures.items()}
    approaches = [fill_approach(robot, stated, letter) for _, stated in places]
    columns = zip(places, names, approaches, nominal, drives, ends, starts, strict=True)
    return {
        place: Stop(name, "reading", None, None, 1, *parts) for place, name, *parts in columns
    }, {}


def list_stops(
    rows: Sequence[tuple[int, Reading]],
    aligned_at: str,
    stop_at: Approaches,
    *,
    any_side: bool = False,
) -> list[Stop]:
    """Alignment of the gauge, stops in the order of measurement, and the first posture again.

    Args:
        rows: Lines and readings of the setup in this order.
        aligned_at: Alignment posture.
        stop_at: Stops by posture and stated approach.
        any_side: Whether the first posture may be reached again from any side.
    """
    first_line, row = rows[0]
    first = row.minus or row.posture
    begin = stop_at[first, row.approach]
    stops = [] if aligned_at == first else [replace(stop_at[aligned_at, None], role="alignment")]
    for line, r in rows:
        if r.minus is not None:
            subtracted = replace(
                stop_at[r.minus, None], role="subtracted", line=line, cycle=r.cycle
            )
            stops.append(subtracted)
        same = (r.posture, r.approach) == (first, row.approach)
        again = r.minus is None and same and line != first_line
        repeats = first_line if again else None
        stop = stop_at[r.posture, r.approach]
        stops.append(replace(stop, line=line, repeats=repeats, cycle=r.cycle))
    if any_side:
        begin = replace(begin, approach="u" * len(begin.approach))
    same_side = any_side or stops[-1].approach == begin.approach
    if stops[-1].posture != first or not same_side:
        stops.append(replace(begin, role="return", repeats=first_line))
    return stops
