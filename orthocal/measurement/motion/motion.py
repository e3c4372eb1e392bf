"""Path of the machine through the postures of a session.

A setup starts in its alignment posture, where the operator mounts and aligns the gauge. Every
posture is approached as its reading states, by the last motion of each drive. If no reading states
an approach, all postures are approached from one side. Then backlash has the same effect on all
readings. Approaches follow from the path if the sensor prescribes it between its readings: the
tool ball of a ball bar stays on a sphere. Each segment of the path is sampled to check three
conditions: the drives reach it, the tip stays on the rod, and the dial stays in its range.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import ClosureError, OrthocalError, SessionError, UnreachablePathError
from orthocal.kinematics.continuation import Failures
from orthocal.kinematics.loop_closure import find_beyond_travel, nominal_closure
from orthocal.kinematics.tool_rotation import place_turning, rotation_shift
from orthocal.kinematics.workspace import position_at_zero, tool_at_zero
from orthocal.measurement.files.readings_file import FIRST_LINE
from orthocal.measurement.motion.approach import (
    USUAL_LENGTH,
    approach_length,
    approach_share,
    approach_steps,
    fill_approach,
    name_approach,
    usual_approaches,
)
from orthocal.measurement.motion.guidance import range_of_expected
from orthocal.observation.contacts import locate_contacts
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import build_observations, drive_table
from orthocal.robot.model import Robot, require_tcp
from orthocal.sensors.points import Points
from orthocal.sensors.protocol import (
    Sensor,
    ToolPath,
    Triple,
    has_dial,
    instrument,
    reads_pairs,
    tool_path,
)
from orthocal.session.order import order_of_measurement
from orthocal.session.session import Conditions, Posture, Reading, Session
from orthocal.units import MM

Role = Literal["alignment", "reading", "subtracted", "return"]

STEP = 5e-3
"""Largest distance between samples of a segment, [m]."""

MOST_STOPS = 2000
"""Largest number of readings in one plan: two weeks of work."""


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


class _Path(NamedTuple):
    """Samples of a path."""

    points: Array
    """Tool coordinates, shape (n, n_coordinates), [m]."""
    drives: Array
    """Drive coordinates, shape (n, n_drives), [m, rad]."""
    passive: Array
    """Passive coordinates, shape (n, n_passive), [m, rad]."""


def plan_motion(session: Session) -> tuple[SetupMotion, ...]:
    """Plan the path through every setup, in the order of measurement.

    Raises:
        SessionError: If sessions are joined, there are too many readings, a setup reads pairs of
            postures, or a posture cannot be reached or approached.
    """
    if session.joined:
        raise SessionError(
            "joins sessions, each with active offsets of its own; plan each session by itself",
            where="session",
        )
    _refuse_pairs(session)
    if len(session.readings) > MOST_STOPS:
        raise SessionError(
            f"plans {len(session.readings)} readings; a sheet holds at most {MOST_STOPS}",
            where=str(session.path or "session"),
        )
    rows_by_setup: dict[str, list[tuple[int, Reading]]] = {}
    for i in order_of_measurement(session.readings):
        reading = session.readings[i]
        line = i + FIRST_LINE if reading.line is None else reading.line
        rows_by_setup.setdefault(reading.setup, []).append((line, reading))
    aligned_at = session.alignment_postures
    guided = _guided_setups(session)
    stop_at = _find_approaches(session, _unguided_places(session, guided))
    motions = []
    for number, (setup, rows) in enumerate(rows_by_setup.items(), 1):
        if setup in guided:
            on_path = _stops_on_path(session, setup)
            listed = _list_stops(rows, aligned_at[setup], on_path, any_side=True)
            stops = _follow_path(session, setup, listed, guided[setup])
        else:
            stops = _list_stops(rows, aligned_at[setup], stop_at)
            if session.robot.commands_tool:
                stops = _follow_stops(session, setup, stops)
        alignment = stops.pop(0) if stops[0].role == "alignment" else None
        motions.append(SetupMotion(setup, number, len(rows_by_setup), alignment, tuple(stops)))
    return tuple(motions)


def common_approach(session: Session) -> str | None:
    """Approach of programs in postures without a stated one; None if no common one is possible.

    It is also None if no effect of the machine depends on the approach.
    """
    places = _unguided_places(session, _guided_setups(session))
    if not places or not usual_approaches(session.robot):
        return None
    for letter in "pn":
        if _free_failure(_begin_approaches(session, places, letter)[1]) is None:
            return letter * len(session.robot.drives)
    return None


def state_program_approaches(session: Session) -> Session:
    """Session in which readings without a stated approach get that of programs, if possible."""
    guided = _guided_setups(session)
    if any(r.setup in guided and r.approach is None for r in session.readings):
        with suppress(OrthocalError):  # no program can be made
            session = state_path_approaches(session)
    common = common_approach(session)
    return _with_approaches(session, lambda _, r: r.approach or common)


def _with_approaches(session: Session, find: Callable[[int, Reading], str | None]) -> Session:
    """Session whose readings in one posture have other approaches.

    Args:
        session: The session.
        find: Function from the index of a reading and the reading to its approach; None for the
            stated one.
    """
    readings = list(session.readings)
    for i, r in enumerate(readings):
        if r.minus is None and (approach := find(i, r)) not in (None, r.approach):
            conditions = replace(r.conditions or Conditions(), approach=approach)
            readings[i] = replace(r, conditions=conditions)
    return replace(session, readings=tuple(readings))


def _refuse_pairs(session: Session) -> None:
    """Refuse setups whose readings belong to pairs of postures: no posture has a reading.

    Raises:
        SessionError: If there is such a setup; names the first.
    """
    for name in dict.fromkeys(r.setup for r in session.readings):
        if reads_pairs(session.setups[name].sensor):
            raise SessionError(
                "each reading is taken between two postures; a sheet and programs stop in one "
                "posture for each reading. Type these readings with `orthocal record`. For other "
                "setups, run `orthocal sheet` on a session without this one",
                where=f"{session.path or 'session'}: setups.{name}",
            )


def state_path_approaches(session: Session) -> Session:
    """Session whose readings state the approaches that follow from the paths of their sensors.

    The session is unchanged if no effect of the machine depends on the approach.

    Raises:
        SessionError: If there are too many readings, or a posture cannot be reached or approached.
    """
    guided = _guided_setups(session)
    if not guided or not usual_approaches(session.robot):
        return session
    rows = enumerate(session.readings)
    of_guided = tuple(replace(r, line=i) for i, r in rows if r.setup in guided)
    approach_by_row = {
        stop.line: stop.approach
        for motion in plan_motion(replace(session, readings=of_guided))
        for stop in motion.stops
        if stop.role == "reading"
    }
    return _with_approaches(session, lambda i, _: approach_by_row.get(i))


Path = Callable[[Array, Array], Array]
"""Corners of the path of the tool between two coordinates, shape (n, n_coordinates), [m]."""

Place = tuple[str, str | None]
"""Posture and stated approach, which is None if not stated."""

Approaches = dict[Place, Stop]


def _guided_setups(session: Session) -> dict[str, Path]:
    """Prescribed paths of the tool between readings, by setup, for sensors that have one."""
    if not session.robot.commands_tool:
        return {}
    return {
        name: _in_coordinates(session.robot, path, getattr(setup.sensor, "tool", (0.0, 0.0, 0.0)))
        for name, setup in session.setups.items()
        if (path := tool_path(setup.sensor)) is not None
    }


def _in_coordinates(robot: Robot, path: ToolPath, tool: Triple) -> Path:
    """Path between coordinates that the drives control: in space, or in the plane of motion.

    Args:
        robot: The robot.
        path: Path of a tool without rotation.
        tool: Point of the tool that follows the path, in the tool's frame, [m].
    """
    coordinates = list(require_tcp(robot).coordinates)
    others = [k for k in range(3) if k not in coordinates]
    normal = [np.eye(3)[others[0]]] if len(others) == 1 else []
    fixed = position_at_zero(robot)

    def between(start: Array, end: Array) -> Array:
        ends = np.array([fixed, fixed])
        on_path = np.array([start, end])
        ends[:, coordinates] = on_path + rotation_shift(robot, on_path, tool)
        return place_turning(robot, path(*ends, *normal)[:, coordinates], tool)

    return between


def _stops_on_path(session: Session, setup: str) -> Approaches:
    """Stops of a setup whose approaches follow from its path."""
    robot = session.robot
    names = list(session.postures)
    nominal = drive_table(session) + session.active_offsets
    tool = nominal_closure(robot).forward(nominal, names=names)
    points = tool[:, list(require_tcp(robot).coordinates)]
    unknown = "u" * len(robot.drives)
    readings = [r for r in session.readings if r.setup == setup]
    places = {(r.posture, r.approach) for r in readings}
    places |= {(r.minus, None) for r in readings if r.minus is not None}
    places |= {(session.alignment_postures[setup], None)}
    index = {name: i for i, name in enumerate(names)}
    stops = {}
    for name, approach in places:
        drives, point = nominal[index[name]], points[index[name]]
        stops[name, approach] = Stop(
            *(name, "reading", None, None, 1, approach or unknown),
            *(drives, drives, point, point),
        )
    return stops


def _unguided_places(session: Session, guided: Collection[str]) -> list[Place]:
    """Postures to read or to align a gauge, with stated approaches, of setups without a path."""
    ordered = (session.readings[i] for i in order_of_measurement(session.readings))
    unguided = [r for r in ordered if r.setup not in guided]
    first = {r.setup: r.minus or r.posture for r in reversed(unguided)}
    aligned_at = session.alignment_postures
    places: set[Place] = {(aligned_at[s], None) for s, p in first.items() if aligned_at[s] != p}
    places |= {(r.posture, r.approach) for r in unguided}
    places |= {(r.minus, None) for r in unguided if r.minus is not None}
    order = {name: i for i, name in enumerate(session.postures)}
    return sorted(places, key=lambda place: (order[place[0]], place[1] or ""))


def _find_approaches(session: Session, places: Sequence[Place]) -> Approaches:
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
        stops, failures = _begin_approaches(session, places, letter)
        first = _free_failure(failures)
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


def _free_failure(failures: Mapping[Place, ClosureError]) -> ClosureError | None:
    """First error of a place where the side of a drive is not stated; None without one."""
    return next((e for (_, stated), e in failures.items() if "u" in (stated or "u")), None)


def _begin_approaches(
    session: Session, places: Sequence[Place], letter: str
) -> tuple[Approaches, dict[Place, ClosureError]]:
    """Stops of postures with their approaches.

    Args:
        session: The session.
        places: Postures and stated approaches.
        letter: Direction of drives without a stated one.

    Returns:
        Stops by place, and no errors; or no stops, and errors by place whose approach is out of
        reach.
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
    if failures:
        return {}, {places[i]: error for i, error in failures.items()}
    ends: Sequence[Array | None] = [None] * len(names)
    starts = ends
    if robot.commands_tool and robot.tcp is not None:
        coordinates = list(robot.tcp.coordinates)
        ends = list(closure.forward(nominal, names=names)[:, coordinates])
        starts = list(closure.tcp(drives, passive)[:, coordinates])
    approaches = [fill_approach(robot, stated, letter) for _, stated in places]
    columns = zip(places, names, approaches, nominal, drives, ends, starts, strict=True)
    return {
        place: Stop(name, "reading", None, None, 1, *parts) for place, name, *parts in columns
    }, {}


def _list_stops(
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


def _follow_stops(session: Session, setup: str, stops: Sequence[Stop]) -> list[Stop]:
    """Stops with the paths between them and the predicted readings.

    A path leads through the mechanical zero if the direct path is out of reach.

    Raises:
        SessionError: If neither path is within reach.
    """
    robot, checked = session.robot, list(stops)
    zero = tool_at_zero(robot)
    ends = [(np.asarray(s.approach_point), np.asarray(s.point)) for s in stops]
    starts = [zero, *(point for _, point in ends[:-1])]
    paths = _sample_paths(robot, [(a, *b) for a, b in zip(starts, ends, strict=True)])
    indirect = [i for i, path in enumerate(paths) if path is None]
    if indirect:
        through_zero = _sample_paths(robot, [(starts[i], zero, *ends[i]) for i in indirect])
        for i, path in zip(indirect, through_zero, strict=True):
            paths[i], checked[i] = path, replace(checked[i], via=(zero,))
    how = ", both directly and through the mechanical zero; insert a posture between them"
    return _predict(session, setup, checked, _require_paths(session, setup, checked, paths, how))


def _follow_path(session: Session, setup: str, stops: Sequence[Stop], path: Path) -> list[Stop]:
    """Stops on the path that a sensor prescribes, with their approaches and predicted readings.

    If the stated approach of a reading has the opposite direction, the tool passes the posture and
    approaches it on the way back. A gauge that is aligned in its first posture arrives there as it
    will from the last one, unless the reading states another approach: the closing reading then
    has the approach of the first.

    Raises:
        SessionError: If the path leaves the workspace, or no direction has the stated approach.
    """
    robot, length = session.robot, approach_share(session) * USUAL_LENGTH
    first = np.asarray(stops[0].point)
    others = [s.point for s in stops if s.point is not None and not np.allclose(s.point, first)]
    ends = [np.asarray(others[i]) for i in (-1, 0)] if others else [first + length]
    # nothing is mounted yet: the tool comes from the last posture, or from the second one
    possible = [np.vstack([_walk(path(first, end), length), first]) for end in ends]
    position, begin, checked, polylines = first, first, list[Stop](), []
    for stop in stops:
        point = np.asarray(stop.point)
        if checked:  # in the same posture again: away from it and back
            stays = np.allclose(position, point)
            possible = [np.vstack([point, begin, point]) if stays else path(position, point)]
        arrival = _arrive(session, setup, stop, possible, length)
        position = position if checked else np.asarray(arrival.approach_point)
        checked.append(arrival)
        begin = np.asarray(arrival.approach_point)
        polylines.append([position, *arrival.via, begin, point])
        position = point
    paths = _sample_paths(robot, polylines)
    return _predict(session, setup, checked, _require_paths(session, setup, checked, paths))


def _require_paths(
    session: Session,
    setup: str,
    stops: Sequence[Stop],
    paths: Sequence[_Path | None],
    remark: str = "",
) -> list[_Path]:
    """Paths to the stops of a setup.

    Raises:
        UnreachablePathError: If a path leaves the workspace; names the posture.
    """
    for stop, path in zip(stops, paths, strict=True):
        if path is None:
            raise UnreachablePathError(
                f"the path to posture '{stop.posture}' of setup '{setup}' leaves the workspace"
                f"{remark}",
                setup=setup,
                posture=stop.posture,
                where=str(session.path or "session"),
            )
    return [path for path in paths if path is not None]


def _arrive(
    session: Session, setup: str, stop: Stop, possible: Sequence[Array], length: float
) -> Stop:
    """Stop that is approached along a path: forwards, or backwards after passing the posture.

    Args:
        session: The session.
        setup: Name of the setup.
        stop: The stop, with its stated approach.
        possible: Paths to it, each of shape (n, n_coordinates), [m]; the first that has the stated
            approach is followed.
        length: Length of the approach, [m].

    Raises:
        SessionError: If neither direction has the stated approach.
    """
    point, closure = possible[0][-1], nominal_closure(session.robot)
    approaches = []
    for corners, forwards in itertools.product(possible, (True, False)):
        before = _walk(corners[::-1], length)
        begin = before if forwards else 2.0 * point - before
        drives = closure.inverse(begin[None])[0]
        approach = name_approach(stop.drives - drives)
        approaches.append(approach)
        if all(a == b or "u" in (a, b) for a, b in zip(stop.approach, approach, strict=True)):
            break
    else:
        raise SessionError(
            f"cannot be approached as stated ({stop.approach}): along the path of setup "
            f"'{setup}' the drives arrive with {' or '.join(approaches)}",
            where=f"{session.path or 'session'}: postures.{stop.posture}",
        )
    via = corners[1:]
    if forwards:
        remaining = np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)[::-1])[::-1]
        via = corners[1:-1][remaining[1:] > length]
    return replace(
        stop, approach=approach, approach_drives=drives, approach_point=begin, via=tuple(via)
    )


def _walk(corners: Array, length: float) -> Array:
    """Point of a polyline at a distance from its start; its end if the polyline is shorter.

    Args:
        corners: Shape (n, n_coordinates), [m].
        length: Distance along the polyline, [m].
    """
    for start, end in pairwise(corners):
        step = float(np.linalg.norm(end - start))
        if step >= length:
            return np.asarray(start + length / step * (end - start))
        length -= step
    return np.asarray(corners[-1])


def _sample_paths(robot: Robot, polylines: Sequence[Sequence[Array]]) -> list[_Path | None]:
    """Samples of polylines of tool coordinates; None if the machine does not reach all of one."""
    sampled = [_sample(corners) for corners in polylines]
    closure, points, failures = nominal_closure(robot), np.concatenate(sampled), Failures()
    try:
        drives, passive = closure.reach(points)  # cached: gauges of a leg have the same path
    except ClosureError:
        drives, passive = closure.reach(points, failures=failures)
    paths, first = list[_Path | None](), 0
    for part in sampled:
        last = first + len(part)
        path = _Path(part, drives[first:last], passive[first:last])
        reached = failures.keys().isdisjoint(range(first, last))
        if reached and find_beyond_travel(robot, path.drives):
            reached = False
        paths.append(path if reached else None)
        first = last
    return paths


def _sample(corners: Sequence[Array]) -> Array:
    """Points of a polyline at distances of at most STEP, shape (n, n_coordinates), [m]."""
    segments = [corners[0][None]]
    for start, end in pairwise(corners):
        count = max(2, int(np.ceil(np.linalg.norm(end - start) / STEP)))
        segments.append(start + np.arange(1, count + 1)[:, None] / count * (end - start))
    return np.concatenate(segments)


def _predict(
    session: Session, setup: str, stops: Sequence[Stop], paths: Sequence[_Path]
) -> list[Stop]:
    """Stops with predicted readings, and with reasons to lift the plunger on their paths."""
    points, drives, passive = (np.concatenate(arrays) for arrays in zip(*paths, strict=True))
    aligned = session.postures[session.alignment_postures[setup]]
    names = [f"{aligned.name} {i}" for i in range(len(points))]  # all differ from aligned.name
    at_alignment = nominal_closure(session.robot).close(aligned.drives + session.active_offsets)
    sampled = replace(
        session,
        postures={
            n: Posture(n, "tcp", p, d - session.active_offsets)
            for n, p, d in zip(names, points, drives, strict=True)
        }
        | {aligned.name: aligned},
        setups={setup: replace(session.setups[setup], aligned_at=aligned.name)},
        readings=tuple(Reading(setup, n) for n in names),
    )
    observations = build_observations(sampled)
    predicted = observations.rows(
        predict_readings(
            sampled, observations=observations, passive=np.vstack([passive, at_alignment])
        )
    )
    _, contact = locate_contacts(sampled)[setup]
    sensor = sampled.setups[setup].sensor
    ends = np.cumsum([len(path.points) for path in paths]).tolist()
    first = next(i for i, stop in enumerate(stops) if stop.role != "alignment")
    gauge, differences = sampled.gauges[sampled.setups[setup].gauge], stops[first].role != "reading"
    low, high = range_of_expected(gauge, differences=differences)
    if session.setups[setup].zero != "known":
        predicted = predicted - predicted[ends[first] - 1]
        if not differences:
            predicted += gauge.middle
    finished = []
    for i, (stop, end) in enumerate(zip(stops, ends, strict=True)):
        lift = ""
        if i > 0 and has_dial(sensor):  # the gauge is mounted at the first stop
            start = end - len(paths[i].points)
            on_path = predicted[start:end]
            problems = [p for p in contact.problems[start:end] if p]
            if problems or not np.isfinite(on_path).all():
                lift = "the tip would leave the rod" if not problems else problems[0]
            elif (excess := np.maximum(low - on_path, on_path - high)).max() > 0.0:
                largest = f"{on_path[excess.argmax()] / MM:+.1f}".replace("-", "−")
                lift = f"the dial would go {largest} mm"
        expected = float(predicted[end - 1])
        finished.append(replace(stop, lift=lift, expected=expected, path=paths[i].drives))
    return finished
