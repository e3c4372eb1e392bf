"""Path of the machine through the postures of a session.

A setup starts in its alignment posture, where the operator mounts and aligns the gauge. Every
posture is approached as its reading states, by the last motion of each drive. If no reading states
an approach, all postures are approached from one side. Then backlash has the same effect on all
readings. Approaches follow from the path if the sensor prescribes it between its readings: the
tool ball of a ball bar stays on a sphere. A probe moves straight towards the surface, and back
before the next posture. Each segment of the path is sampled to check four conditions: the drives
reach it, it is not below a bed, the tip stays on the rod, and the dial stays in its range.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from orthocal.arrays import Array, Triple
from orthocal.errors import ClosureError, OrthocalError, SessionError, UnreachablePathError
from orthocal.kinematics.continuation import Failures
from orthocal.kinematics.loop_closure import find_beyond_travel, nominal_closure
from orthocal.kinematics.tool_rotation import place_turning, rotation_shift
from orthocal.kinematics.workspace import position_at_zero
from orthocal.measurement.files.readings_file import FIRST_LINE
from orthocal.measurement.motion.approach import (
    USUAL_LENGTH,
    approach_share,
    name_approach,
    probing_starts,
    usual_approaches,
)
from orthocal.measurement.motion.guidance import below_bed, range_of_expected, start_point
from orthocal.measurement.motion.stops import (
    SetupMotion,
    Stop,
    begin_approaches,
    find_approaches,
    free_failure,
    list_stops,
    stops_on_path,
    unguided_places,
)
from orthocal.observation.contacts import locate_contacts
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import build_observations
from orthocal.robot.model import require_tcp
from orthocal.sensors.protocol import ToolPath, has_dial, probing_direction, reads_pairs, tool_path
from orthocal.session.order import order_of_measurement
from orthocal.session.session import Conditions, Posture, Reading, Session
from orthocal.units import MM

MOST_STOPS = 2000
"""Largest number of readings in one plan: two weeks of work."""

STEP = 5e-3
"""Largest distance between samples of a segment, [m]."""

Path = Callable[[Array, Array], Array]
"""Corners of the path of the tool between two coordinates, shape (n, n_coordinates), [m]."""


class SampledPath(NamedTuple):
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
    guided, probed = _guided_setups(session), _probed_setups(session)
    stop_at = find_approaches(session, unguided_places(session, {*guided, *probed}))
    motions = []
    for number, (setup, rows) in enumerate(rows_by_setup.items(), 1):
        if setup in guided or setup in probed:
            on_path = stops_on_path(session, setup)
            listed = list_stops(rows, aligned_at[setup], on_path, any_side=True)
            if setup in guided:
                stops = _follow_path(session, setup, listed, guided[setup])
            else:
                stops = _probe_stops(session, setup, listed, probed[setup])
        else:
            stops = list_stops(rows, aligned_at[setup], stop_at)
            if session.robot.commands_tool:
                stops = _follow_stops(session, setup, stops)
        alignment = stops.pop(0) if stops[0].role == "alignment" else None
        motions.append(SetupMotion(setup, number, len(rows_by_setup), alignment, tuple(stops)))
    return tuple(motions)


def common_approach(session: Session) -> str | None:
    """Approach of programs in postures without a stated one; None if no common one is possible.

    It is also None if no effect of the machine depends on the approach.
    """
    places = unguided_places(session, {*_guided_setups(session), *_probed_setups(session)})
    if not places or not usual_approaches(session.robot):
        return None
    for letter in "pn":
        if free_failure(begin_approaches(session, places, letter)[1]) is None:
            return letter * len(session.robot.drives)
    return None


def state_program_approaches(session: Session) -> Session:
    """Session in which readings without a stated approach get that of programs, if possible."""
    session = state_possible_path_approaches(session)
    common = common_approach(session)
    return _with_approaches(session, lambda _, r: r.approach or common)


def state_possible_path_approaches(session: Session) -> Session:
    """Session as by `state_path_approaches`; unchanged if no program can be made."""
    guided = {*_guided_setups(session), *_probed_setups(session)}
    if any(r.setup in guided and r.approach is None for r in session.readings):
        with suppress(OrthocalError):
            return state_path_approaches(session)
    return session


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

    The session is unchanged if no effect of the machine depends on the approach. Then the paths
    are still tested where the machine has a bed.

    Raises:
        SessionError: If there are too many readings, or a posture cannot be reached or approached.
    """
    guided = {*_guided_setups(session), *_probed_setups(session)}
    if not guided:
        return session
    if not usual_approaches(session.robot):
        if session.robot.bed is not None:
            plan_motion(session.select([r for r in session.readings if r.setup in guided]))
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


def _follow_stops(session: Session, setup: str, stops: Sequence[Stop]) -> list[Stop]:
    """Stops with the paths between them and the predicted readings.

    A path leads through the mechanical zero if the direct path is out of reach.

    Raises:
        SessionError: If neither path is within reach.
    """
    checked, zero = list(stops), start_point(session)
    ends = [(np.asarray(s.approach_point), np.asarray(s.point)) for s in stops]
    starts = [zero, *(point for _, point in ends[:-1])]
    paths = _sample_paths(session, [(a, *b) for a, b in zip(starts, ends, strict=True)])
    indirect = [i for i, path in enumerate(paths) if path is None]
    if indirect:
        through_zero = _sample_paths(session, [(starts[i], zero, *ends[i]) for i in indirect])
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
    length = approach_share(session) * USUAL_LENGTH
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
    paths = _sample_paths(session, polylines)
    return _predict(session, setup, checked, _require_paths(session, setup, checked, paths))


def _probe_stops(
    session: Session, setup: str, stops: Sequence[Stop], direction: Triple
) -> list[Stop]:
    """Stops of a probe, approached towards its surface, with their predicted readings.

    The tool moves back before it moves to the next posture. The posture may be below a bed: the
    surface stops the probe, and programs stop where the probing begins.

    Raises:
        SessionError: If a path leaves the workspace, or a reading states another approach.
    """
    robot = session.robot
    points = np.array([stop.point for stop in stops])
    starts = probing_starts(robot, points, direction)
    polylines = [[start_point(session), starts[0], points[0]]]
    polylines += [
        [points[i], starts[i], *ends]
        for i, ends in enumerate(zip(starts[1:], points[1:], strict=True))
    ]
    sampled = _sample_paths(session, polylines, probing=True)
    paths, checked = _require_paths(session, setup, stops, sampled), list[Stop]()
    drives = nominal_closure(robot).inverse(starts, names=[stop.posture for stop in stops])
    for i, (stop, begin) in enumerate(zip(stops, drives, strict=True)):
        approach = name_approach(stop.drives - begin)
        if not _agree(stop.approach, approach):
            raise SessionError(
                f"cannot be approached as stated ({stop.approach}): setup '{setup}' probes towards "
                f"its surface, and the drives arrive with {approach}",
                where=f"{session.path or 'session'}: postures.{stop.posture}",
            )
        via = () if i == 0 else (starts[i - 1],)
        end = {"approach": approach, "approach_drives": begin, "approach_point": starts[i]}
        checked.append(replace(stop, via=via, **end))
    return _predict(session, setup, checked, paths)


def _agree(stated: str, approach: str) -> bool:
    """True if no drive has two opposite directions in two approaches."""
    return all(a == b or "u" in (a, b) for a, b in zip(stated, approach, strict=True))


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
    for corners, forwards in product(possible, (True, False)):
        before = _walk(corners[::-1], length)
        begin = before if forwards else 2.0 * point - before
        drives = closure.inverse(begin[None])[0]
        approach = name_approach(stop.drives - drives)
        approaches.append(approach)
        if _agree(stop.approach, approach):
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


def _predict(
    session: Session, setup: str, stops: Sequence[Stop], paths: Sequence[SampledPath]
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
            elif (beyond := np.maximum(low - on_path, on_path - high)).max() > 0.0:
                largest = f"{on_path[beyond.argmax()] / MM:+.1f}".replace("-", "−")
                lift = f"the dial would go {largest} mm"
        expected = float(predicted[end - 1])
        finished.append(replace(stop, lift=lift, expected=expected, path=paths[i].drives))
    return finished


def _guided_setups(session: Session) -> dict[str, Path]:
    """Prescribed paths of the tool between readings, by setup, for sensors that have one."""
    if not session.robot.commands_tool:
        return {}
    return {
        name: _in_coordinates(session, path, getattr(setup.sensor, "tool", (0.0, 0.0, 0.0)))
        for name, setup in session.setups.items()
        if (path := tool_path(setup.sensor)) is not None
    }


def _probed_setups(session: Session) -> dict[str, Triple]:
    """Directions of probes, by setup."""
    if not session.robot.commands_tool:
        return {}
    return {
        name: direction
        for name, setup in session.setups.items()
        if (direction := probing_direction(setup.sensor)) is not None
    }


def _in_coordinates(session: Session, path: ToolPath, tool: Triple) -> Path:
    """Path between coordinates that the drives control: in space, or in the plane of motion.

    Args:
        session: The session.
        path: Path of a tool without rotation.
        tool: Point of the tool that follows the path, in the tool's frame, [m].
    """
    robot = session.robot
    coordinates = list(require_tcp(robot).coordinates)
    others = [k for k in range(3) if k not in coordinates]
    normal = [np.eye(3)[others[0]]] if len(others) == 1 else []
    fixed = position_at_zero(robot)

    def between(start: Array, end: Array) -> Array:
        ends = np.array([fixed, fixed])
        on_path = np.array([start, end])
        ends[:, coordinates] = on_path + rotation_shift(robot, on_path, tool)
        corners = place_turning(robot, path(*ends, *normal)[:, coordinates], tool)
        if below_bed(session, corners) and not below_bed(session, on_path):
            corners = place_turning(robot, path(*ends, *normal, above=True)[:, coordinates], tool)
        return corners

    return between


def _require_paths(
    session: Session,
    setup: str,
    stops: Sequence[Stop],
    paths: Sequence[SampledPath | None],
    remark: str = "",
) -> list[SampledPath]:
    """Paths to the stops of a setup.

    Raises:
        UnreachablePathError: If a path leaves the workspace; names the posture.
    """
    below = "" if session.robot.bed is None else " or goes below the bed"
    for stop, path in zip(stops, paths, strict=True):
        if path is None:
            raise UnreachablePathError(
                f"the path to posture '{stop.posture}' of setup '{setup}' leaves the workspace"
                f"{below}{remark}",
                setup=setup,
                posture=stop.posture,
                where=str(session.path or "session"),
            )
    return [path for path in paths if path is not None]


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


def _sample_paths(
    session: Session, polylines: Sequence[Sequence[Array]], *, probing: bool = False
) -> list[SampledPath | None]:
    """Samples of polylines of tool coordinates; None if the machine does not reach all of one.

    Args:
        session: The session.
        polylines: Corners of each, shape (n_coordinates,) each, [m].
        probing: Whether a surface stops the last motion of each, so that its end may be below it.
    """
    robot, sampled = session.robot, [_sample(corners) for corners in polylines]
    closure, points, failures = nominal_closure(robot), np.concatenate(sampled), Failures()
    try:
        drives, passive = closure.reach(points)  # cached: gauges of a leg have the same path
    except ClosureError:
        drives, passive = closure.reach(points, failures=failures)
    paths, first = list[SampledPath | None](), 0
    for part, corners in zip(sampled, polylines, strict=True):
        last = first + len(part)
        path = SampledPath(part, drives[first:last], passive[first:last])
        reached = failures.keys().isdisjoint(range(first, last))
        moved = np.array(corners[1:-1] if probing else corners[1:])
        if reached and (find_beyond_travel(robot, path.drives) or below_bed(session, moved)):
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
