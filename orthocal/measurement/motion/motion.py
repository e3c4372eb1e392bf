"""The way of the machine through a plan: where it stops to be read, and how it gets there.

Every posture is approached from one side: the last move of each drive goes the same way, so that
play in it is always taken up alike. Ways are looked at in steps: whether the drives reach, and
whether the tip stays on what it touches and the dial within its range.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.errors import ClosureError, SessionError
from orthocal.kinematics.loop_closure import find_beyond_travel, nominal_assembly
from orthocal.kinematics.workspace import tool_at_zero
from orthocal.observation.contacts import locate_contacts
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import build_observations
from orthocal.robot.model import Robot
from orthocal.session.session import Posture, Reading, Session
from orthocal.units import DEG, MM

Array = NDArray[np.float64]
Role = Literal["reading", "taken off", "return"]

APPROACH = 2e-3
"""What a sliding drive comes back by to a posture, [m]."""

APPROACH_TURN = 0.5 * DEG
"""The same of a turning drive, [rad]."""

STEP = 5e-3
"""From one place that is looked at to the next on a way, at most, [m]."""

MOST_STOPS = 2000
"""Of a session that one machine goes through by a sheet: two weeks of reading."""


@dataclass(frozen=True, slots=True, eq=False)
class Stop:
    """A posture in which the machine stands still, and the way to it."""

    posture: str
    role: Role
    """Whether it is read, read and taken off the next reading, or only gone back to."""
    line: int | None
    """Of the readings.csv; None for none."""
    cycle: int
    drives: Array
    """Nominal drive coordinates, shape (n_drives,), [m, rad]."""
    approach_drives: Array
    """The same a little before it, on the side from which it is approached."""
    point: Array | None
    """Tool coordinates that the drives control, shape (n_coordinates,), [m]; None where they
    command no tool."""
    approach_point: Array | None
    """The same a little before it."""
    over_zero: bool = False
    """Whether the way here goes over the mechanical zero, for the straight one cannot be gone."""
    lift: str = ""
    """Why the plunger is to be held up on the way here; empty where it may stay on."""
    expected: float = 0.0
    """What a perfect machine shows here, less in the first posture, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class SetupMotion:
    """The way through all postures of a setup, and back to the first."""

    setup: str
    number: int
    """Of the setup in the order of measuring, from 1."""
    count: int
    """Setups in all."""
    side: int
    """From which side every drive comes: -1 from lesser coordinates, 1 from larger ones."""
    stops: tuple[Stop, ...]


def plan_motion(session: Session) -> tuple[SetupMotion, ...]:
    """The way through a plan, a setup after the other in the order of its rows.

    Raises:
        SessionError: If there are too many stops, or a posture cannot be approached or gone to.
    """
    rows: dict[str, list[tuple[int, Reading]]] = {}
    for i, reading in enumerate(session.readings):
        line = i + 2 if reading.line is None else reading.line
        rows.setdefault(reading.setup, []).append((line, reading))
    if len(session.readings) > MOST_STOPS:
        raise SessionError(
            f"plans {len(session.readings)} readings; a sheet holds at most {MOST_STOPS}",
            where=str(session.path or "session"),
        )
    side, approaches = _find_approaches(session)
    found = []
    for number, (setup, own) in enumerate(rows.items(), 1):
        stops = _go(session, setup, [_stop(session, visit, approaches) for visit in _visits(own)])
        found.append(SetupMotion(setup, number, len(rows), side, tuple(stops)))
    return tuple(found)


def shown_joints(robot: Robot, drives: ArrayLike) -> Array:
    """What the controller's joints show at nominal drive coordinates, shape (..., n_drives)."""
    values = np.asarray(drives, dtype=np.float64)
    columns = [d.to_joint(values[..., i]) for i, d in enumerate(robot.drives)]
    return np.stack(columns, axis=-1)


_Visit = tuple[str, Role, int | None, int]
"""A posture with its role, line and cycle."""


def _visits(rows: Sequence[tuple[int, Reading]]) -> Iterator[_Visit]:
    """Postures in order; the first one again at the end."""
    first = rows[0][1].minus or rows[0][1].posture
    last = first
    for line, reading in rows:
        if reading.minus is not None:
            yield reading.minus, "taken off", line, reading.cycle
        yield reading.posture, "reading", line, reading.cycle
        last = reading.posture
    if last != first:
        yield first, "return", None, 1


def _stop(
    session: Session,
    visit: _Visit,
    approaches: Mapping[str, tuple[Array, Array | None, Array | None]],
) -> Stop:
    posture, role, line, cycle = visit
    before, before_point, point = approaches[posture]
    drives = session.postures[posture].drives + session.active_offsets
    return Stop(posture, role, line, cycle, drives, before, point, before_point)


def _commands_tool(robot: Robot) -> bool:
    return robot.tcp is not None and len(robot.tcp.coordinates) == len(robot.drives)


def _find_approaches(
    session: Session,
) -> tuple[int, dict[str, tuple[Array, Array | None, Array | None]]]:
    """From which side postures are approached, and of each where from and where to.

    Raises:
        SessionError: If some can be approached from neither side.
    """
    robot = session.robot
    used = {p for r in session.readings for p in (r.posture, r.minus) if p is not None}
    names = [n for n in session.postures if n in used]
    nominal = np.array([session.postures[n].drives + session.active_offsets for n in names])
    step = np.array([APPROACH if d.unit == "m" else APPROACH_TURN for d in robot.drives])
    assembly = nominal_assembly(robot)
    refused: ClosureError | None = None
    for side in (-1, 1):
        before = nominal + side * step
        failures = find_beyond_travel(robot, before, names)
        if not failures:
            passive = assembly.close(before, names=names, failures=failures)
        if failures:
            refused = refused or next(iter(failures.values()))
            continue
        points: Sequence[Array | None] = [None] * len(names)
        places: Sequence[Array | None] = points
        if _commands_tool(robot) and robot.tcp is not None:
            chosen = list(robot.tcp.coordinates)
            points = list(assembly.tcp(before, passive)[:, chosen])
            places = list(assembly.forward(nominal, names=names)[:, chosen])
        return side, dict(zip(names, zip(before, points, places, strict=True), strict=True))
    given = "" if refused is None else f": {refused.reason}"
    posture = "" if refused is None else refused.posture
    raise SessionError(
        f"can be approached neither from below nor from above by {APPROACH / MM:g} mm{given}",
        where=f"{session.path or 'session'}: postures.{posture}",
    )


def _go(session: Session, setup: str, stops: list[Stop]) -> list[Stop]:
    """The same stops with their ways: over the zero where need be, and where the tip is lost."""
    robot = session.robot
    if not _commands_tool(robot):
        return stops
    zero = tool_at_zero(robot)
    gone: list[Stop] = []
    ways: list[_Gone] = []
    for stop in stops:
        start = gone[-1].point if gone else zero
        way = _follow(robot, _way(start, stop))
        over_zero = way is None
        if way is None:
            way = _follow(robot, _way(start, stop, zero))
        if way is None:
            raise SessionError(
                f"the way to posture '{stop.posture}' of setup '{setup}' leaves what the machine "
                "reaches, straight and over the mechanical zero; put a posture between",
                where=str(session.path or "session"),
            )
        gone.append(replace(stop, over_zero=over_zero))
        ways.append(way)
    return _touch(session, setup, gone, ways)


def _way(start: Array | None, stop: Stop, over: Array | None = None) -> Array:
    """Places on a way to a stop, before which it is approached, shape (n, n_coordinates), [m]."""
    corners = [start, *([] if over is None else [over]), stop.approach_point, stop.point]
    places = [np.asarray(start)[None]]
    for a, b in pairwise(corners):
        first, last = np.asarray(a), np.asarray(b)
        count = max(2, int(np.ceil(np.linalg.norm(last - first) / STEP)))
        shares = np.arange(1, count + 1)[:, None] / count
        places.append(first + shares * (last - first))
    return np.concatenate(places)


_Gone = tuple[Array, Array, Array]
"""Places on a way with the drives and passive coordinates there."""


def _follow(robot: Robot, way: Array) -> _Gone | None:
    """A way as the machine goes it; None where it does not reach."""
    try:
        drives, passive = nominal_assembly(robot).reach(way)
    except ClosureError:
        return None
    if find_beyond_travel(robot, drives, [""] * len(way)):
        return None
    return way, drives, passive


def _touch(session: Session, setup: str, stops: list[Stop], ways: Sequence[_Gone]) -> list[Stop]:
    """The same stops, with what a perfect machine shows, and where the plunger is to be lifted."""
    places, drives, passive = (np.concatenate(part) for part in zip(*ways, strict=True))
    names = [str(i) for i in range(len(places))]
    along = replace(
        session,
        postures={
            n: Posture(n, "tcp_mm", p, d - session.active_offsets)
            for n, p, d in zip(names, places, drives, strict=True)
        },
        setups={setup: session.setups[setup]},
        readings=tuple(Reading(setup, n, None, 1, 0.0, None) for n in names),
    )
    observations = build_observations(along)
    shown = observations.rows(predict_readings(along, observations=observations, passive=passive))
    _, contact = locate_contacts(along)[setup]
    ends = np.cumsum([len(way) for way, _, _ in ways])
    zero = shown[ends[0] - 1]
    gauge = session.gauges[session.setups[setup].gauge]
    room = np.inf if gauge.range is None else 0.5 * (gauge.range[1] - gauge.range[0])
    found = []
    for i, (stop, end) in enumerate(zip(stops, ends.tolist(), strict=True)):
        own = range(end - len(ways[i][0]), end)
        lift = ""
        if i > 0:  # before the first stop no gauge stands there
            off = shown[own.start : own.stop] - zero
            problems = [contact.problems[k] for k in own if contact.problems[k]]
            if problems or not np.isfinite(off).all():
                lift = "the tip would leave the rod" if not problems else problems[0]
            elif np.abs(off).max() > room:
                far = f"{off[np.abs(off).argmax()] / MM:+.1f}".replace("-", "−")
                lift = f"the dial would go {far} mm"
        found.append(replace(stop, lift=lift, expected=float(shown[end - 1] - zero)))
    return found
