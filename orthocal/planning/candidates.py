"""Readings to choose from: each setup that could stand, in each posture in which it could be read.

They are a session like any other, whatever its sensors are, so that all that is known of readings
holds for them: where they touch, what they show, how they answer to what is not known.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ParameterError
from orthocal.estimation.problem import CalibrationProblem
from orthocal.kinematics.loop_closure import nominal_assembly
from orthocal.kinematics.workspace import tool_at_zero
from orthocal.observation.contacts import locate_contacts
from orthocal.observation.model import nominal_sensitivity
from orthocal.observation.observations import build_observations
from orthocal.planning.equipment import Means, choose_box, reachable
from orthocal.robot.model import Leg, Robot
from orthocal.sensors.leg_indicator import Direction, LegIndicator, Section
from orthocal.sensors.protocol import Sensor
from orthocal.sensors.rod_indicator import RodByBall, RodByBlade
from orthocal.sensors.tips import Tip
from orthocal.session.session import Posture, Reading, Session, Setup
from orthocal.statistics.noise import noise_floor
from orthocal.units import MM

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

PLACES_ACROSS = 5
"""Places to the side of a leg's own way, and in it."""

STEEPEST = 0.43
"""Of the radii that touch: how far aside a ball may be, for then the rod pushes it 25° aside."""

ON_BLADE = 0.4
"""Of a blade's width: how far from its middle it may touch."""

WHOLE = 5e-3
"""Places are at multiples of this, [m]."""

OVERLAP = 1.0
"""Half widths from one place beside a rod to the next."""

ON_AXIS = 0.999
"""Cosine above which a leg lies along an axis of the world."""

ZERO_PRIOR = 0.01
"""Standard deviation of a gauge's zero, [m]: nothing is known of it."""

FEWEST = 2
"""Readings of a setup: one says nothing beside its own zero."""

MOST_CANDIDATES = 60_000


@dataclass(frozen=True, slots=True, eq=False)
class HandSet:
    """Something of a gauge that a hand sets by the machine, where the setup begins."""

    answers: Array
    """How readings answer to it, shape (m,), [m/SI]."""
    slopes: Array
    """How it answers to the state in each posture, less the mean, shape (m, n_state), [SI]."""


@dataclass(frozen=True, slots=True, eq=False)
class Kind:
    """A setup that could stand, and the readings that it could take."""

    name: str
    """Of the setup, in the session of candidates."""
    rows: Indices
    """Its candidates, shape (m,)."""
    slopes: Array
    """How they answer to the state, shape (m, n_state), [m per tolerance]; where a hand sets the
    gauge by the machine, as on the mean of their postures."""
    own: Array
    """Covariance that the setup's own unknowns and its zero give them, shape (m, m), [m²]."""
    together: NDArray[np.bool_]
    """Whether the gauge that begins in one (row) reaches another (column), shape (m, m)."""
    by_hand: tuple[HandSet, ...] = ()

    def begun(self, first: int) -> Kind:
        """The same with its gauge set in the posture of one of them."""
        if not self.by_hand:
            return self
        slopes = self.slopes
        for hand in self.by_hand:
            slopes = slopes + np.outer(hand.answers, hand.slopes[first])
        return replace(self, slopes=slopes, by_hand=())

    def only(self, chosen: Sequence[int]) -> Kind:
        """Some of its readings alone."""
        at = np.array(chosen)
        square = np.ix_(at, at)
        return Kind(
            self.name,
            self.rows[at],
            self.slopes[at],
            self.own[square],
            self.together[square],
            tuple(HandSet(h.answers[at], h.slopes[at]) for h in self.by_hand),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Readings to choose from, on a nominal machine."""

    session: Session
    problem: CalibrationProblem
    kinds: tuple[Kind, ...]
    sigma: float
    """Standard deviation of a reading, [m]."""
    state: tuple[str, ...]
    """Parameters that more than one setup tells: the machine's, and what setups share."""
    taken_range: float
    """What machines within their tolerances may take of the gauge's range to either side, [m]."""

    @property
    def count(self) -> int:
        """How many readings there are to choose from."""
        return sum(len(k.rows) for k in self.kinds)

    @property
    def bare(self) -> Candidates:
        """What a choice needs of them, without the session and its problem: what can be pickled."""
        nothing: Any = None
        return replace(self, session=nothing, problem=nothing)

    def readings(self, kind: int, chosen: Indices) -> list[Reading]:
        """Candidates of a kind."""
        return [self.session.readings[i] for i in self.kinds[kind].rows[chosen]]


def list_candidates(robot: Robot, means: Means, *, reference: str = "") -> Session:
    """Every setup that could stand and posture that it could be read in, as a session.

    Args:
        robot: The robot.
        means: What one has.
        reference: How the session names the robot; its name by default.

    Raises:
        ParameterError: If there is nothing to choose from, or too much.
    """
    if not robot.legs:
        raise ParameterError(
            f"'{robot.name}' has no legs for a gauge to touch; add orthocal.legs", where="plan"
        )
    postures: dict[str, Posture] = {}
    setups: dict[str, Setup] = {}
    readings: list[Reading] = []
    for leg in robot.legs.values():
        names = _postures(robot, leg, means, postures)
        for name, sensor in _sensors(leg, means):
            setups[name] = Setup(name, sensor)
            readings += [Reading(name, p, None, 1, 0.0, None) for p in names]
            if len(readings) > MOST_CANDIDATES * 10:
                break
    session = Session(
        robot=robot,
        robot_reference=reference or robot.name,
        title="",
        source="",
        gauges={"": means.gauge},
        postures=postures,
        setups=setups,
        readings=tuple(readings),
        controller_offsets=None,
        path=None,
        readings_path=None,
        sha256="",
    )
    session = _with_places_beside(session)
    return _touching(session)


def measure_candidates(
    session: Session, problem: CalibrationProblem, *, spare_range: float
) -> Candidates:
    """How candidates answer to what is not known, and which of them one setup can take.

    Args:
        session: Of the candidates.
        problem: Theirs, with priors for all that is free.
        spare_range: As of `Means`.
    """
    sigma = noise_floor(session.gauge.sigma, session.gauge.resolution)
    h, jacobian = problem.linearise(problem.reference)
    n, o = problem.n_machine, problem.observations
    private = {f"setup.{name}" for name in session.setups}
    owners = [name.rpartition(".")[0] for name in problem.free]
    common = [i for i, owner in enumerate(owners) if i < n or owner not in private]
    kinds, taken, set_by = [], [], _list_set_by(session, problem)
    for k, name in enumerate(session.setups):
        rows = np.flatnonzero(o.setup == k)
        if rows.size < FEWEST:
            continue
        own = [i for i in range(n, len(owners)) if owners[i] == f"setup.{name}"]
        slopes, mine = jacobian[rows][:, common], jacobian[rows][:, own]
        by_hand = []
        for index, seen in set_by.get(name, ()):
            answers = jacobian[rows, index] / problem.theta_scale[index]
            moves = np.zeros_like(slopes)
            moves[:, :n] = seen - seen.mean(axis=0)
            slopes -= np.outer(answers, moves[0])  # the first is where the session begins it
            by_hand.append(HandSet(answers, moves))
        spread = mine @ mine.T
        unknown = spare_range * _unknown_differences(slopes, spread)
        taken.append(float(unknown.max()))
        reaches = _reach_each_other(session, h[rows], unknown)
        own_spread = spread + ZERO_PRIOR**2
        kinds.append(Kind(name, rows, slopes, own_spread, reaches, tuple(by_hand)))
    state = tuple(problem.free[i] for i in common)
    typical = float(np.median(taken)) if taken else 0.0
    return Candidates(session, problem, tuple(kinds), sigma, state, typical)


def _list_set_by(
    session: Session, problem: CalibrationProblem
) -> dict[str, list[tuple[int, Array]]]:
    """Setup to what of its gauge a hand sets by the machine.

    That is which free parameter it is, and how it answers to the machine's in each of the setup's
    candidates, shape (m, n_machine), [SI per tolerance].
    """
    seen: dict[str, dict[str, Setup]] = {}
    for name, setup in session.setups.items():
        for unknown, sensor in setup.sensor.set_by(session.robot).items():
            if unknown in {u.name for u in setup.sensor.unknowns}:
                seen.setdefault(unknown, {})[name] = replace(setup, sensor=sensor)
    found: dict[str, list[tuple[int, Array]]] = {}
    for unknown, setups in seen.items():
        readings = tuple(r for r in session.readings if r.setup in setups)
        looks = replace(session, setups=setups, readings=readings)
        slopes = nominal_sensitivity(looks) @ problem.columns
        setup_of = build_observations(looks).setup
        for k, name in enumerate(setups):
            index = problem.free.index(f"setup.{name}.{unknown}")
            found.setdefault(name, []).append((index, slopes[setup_of == k]))
    return found


def _unknown_differences(slopes: Array, spread: Array) -> Array:
    """Standard deviations of differences of readings before anything is known, (m, m), [m]."""
    covariance = slopes @ slopes.T + spread
    variance = np.diag(covariance)
    square = variance[:, None] + variance[None] - 2.0 * covariance
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def _reach_each_other(session: Session, h: Array, unknown: Array) -> NDArray[np.bool_]:
    """Whether a gauge that is set to the middle of its range in one posture reaches in another."""
    if session.gauge.range is None:
        return np.ones((h.size, h.size), dtype=np.bool_)
    half = 0.5 * (session.gauge.range[1] - session.gauge.range[0])
    return np.asarray(np.abs(h[:, None] - h[None]) <= half - unknown)


def _postures(robot: Robot, leg: Leg, means: Means, postures: dict[str, Posture]) -> list[str]:
    """Names of the postures that a leg could be read in; they are added to those there are."""
    box = choose_box(robot, means.box)
    middle = tool_at_zero(robot)
    coordinates = () if robot.tcp is None else robot.tcp.coordinates
    own = [k for k, c in enumerate(coordinates) if abs(leg.axis[c]) > ON_AXIS]
    lines = []
    for k, (low, high) in enumerate(box):
        if own and k not in own:
            side = middle[k] + np.linspace(-means.across, means.across, PLACES_ACROSS)
            lines.append(np.unique(np.clip(side, low, high)))
        else:
            line = np.linspace(low, high, means.along if own else PLACES_ACROSS)
            whole = np.round(line / WHOLE) * WHOLE
            lines.append(np.unique(np.clip(whole, low, high).round(9)))
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(lines))
    points = np.unique(np.vstack([np.clip(middle, box[:, 0], box[:, 1]), points.round(9)]), axis=0)
    points = points[reachable(robot, points)]
    if len(points) < FEWEST:
        raise ParameterError("the machine reaches none of its postures", where="plan: box")
    names = [_name(p, robot, middle) for p in points]
    drives = nominal_assembly(robot).inverse(points)
    for name, point, drive in zip(names, points, drives, strict=True):
        postures.setdefault(name, Posture(name, "tcp_mm", point, drive))
    return names


def _name(point: Array, robot: Robot, middle: Array) -> str:
    """A posture's name: how far the tool is from the mechanical zero, such as x+60_y-10."""
    letters = "" if robot.tcp is None else ["xyz"[c] for c in robot.tcp.coordinates]
    parts = [
        f"{letter}{round(v / MM, 3):+g}"
        for letter, v in zip(letters, point - middle, strict=True)
        if abs(v) > 1e-9
    ]
    return "_".join(parts) or "zero"


def _sensors(leg: Leg, means: Means) -> Iterator[tuple[str, Sensor]]:
    """Indicators that could stand at a leg, by a name."""
    for direction in _directions(leg):
        word = direction if isinstance(direction, str) else "d"
        for part in means.sections:
            section = Section("fraction", part)
            if means.tip is None or not (leg.rods or means.rods):
                yield (
                    f"{word}{leg.name}_{part:g}",
                    LegIndicator(leg.name, direction, section, means.standing),
                )
                continue
            for rod in means.rods or tuple(leg.rods)[:1]:
                if rod not in leg.rods:
                    known = ", ".join(leg.rods) or "none"
                    raise ParameterError(
                        f"'{rod}' is not a rod of leg {leg.name}; rods: {known}", where="touches"
                    )
                kind = RodByBall if means.tip.form == "ball" else RodByBlade
                sensor = kind(leg.name, rod, direction, section, means.tip, means.standing)
                yield f"{word}{leg.name}_{rod}_{part:g}", sensor


def _directions(leg: Leg) -> list[Direction]:
    """Two directions across a leg, along the world's axes where these are square to it."""
    found: list[Direction] = [
        name for name, axis in zip("xyz", np.eye(3), strict=True) if abs(axis @ leg.axis) < 1e-6
    ]
    if len(found) >= 2:
        return found
    first = np.cross(leg.axis, np.eye(3)[int(np.abs(leg.axis).argmin())])
    if found:
        first = np.eye(3)["xyz".index(str(found[0]))]
    first /= np.linalg.norm(first)
    second = np.cross(leg.axis, first)
    return [(float(a), float(b), float(c)) for a, b, c in (first, second)]


def _with_places_beside(session: Session) -> Session:
    """The candidates with gauges that stand where the rod is in displaced postures, too."""
    wide = Tip("blade", 0.0, 10.0)
    reads: dict[str, list[Reading]] = {name: [] for name in session.setups}
    for reading in session.readings:
        reads[reading.setup].append(reading)
    blades = {
        name: replace(
            s,
            sensor=RodByBlade(
                s.sensor.leg, s.sensor.rod, s.sensor.direction, s.sensor.section, wide
            ),
        )
        for name, s in session.setups.items()
        if isinstance(s.sensor, RodByBall | RodByBlade)
    }
    if not blades:
        return session
    setups = {n: s for n, s in session.setups.items() if n not in blades}
    readings = [r for r in session.readings if r.setup not in blades]
    on_rods = tuple(r for r in session.readings if r.setup in blades)
    found = locate_contacts(replace(session, setups=blades, readings=on_rods))
    for name, (postures, contact) in found.items():
        sensor = session.setups[name].sensor
        if not isinstance(sensor, RodByBall | RodByBlade):
            continue
        side = sensor.constants(session.robot)[8:11]
        start = sensor.constants(session.robot)[11:14]
        aside = dict(zip(postures, ((contact.points - start) @ side).tolist(), strict=True))
        half = _room_beside(sensor, session.robot)
        step = max(round(OVERLAP * half / MM), 1) * MM
        lowest, highest = (round(f(aside.values()) / step) for f in (min, max))
        for k in range(int(lowest), int(highest) + 1):
            near = [r for r in reads[name] if abs(aside[r.posture] - k * step) <= half]
            own = name if k == 0 else f"{name}_{k * step / MM:+.3g}"
            x, y, z = (float(v) for v in (k * step * side).round(9) + 0.0)
            setups[own] = Setup(own, replace(sensor, beside=(x, y, z)))
            readings += [replace(r, setup=own) for r in near]
    return replace(session, setups=setups, readings=tuple(readings))


def distance_beside(sensor: Sensor) -> float:
    """How far from where the rod lies in the mechanical zero a sensor's tip begins, [m]."""
    if isinstance(sensor, RodByBall | RodByBlade):
        return float(np.linalg.norm(sensor.beside))
    return 0.0


def replace_beside(sensor: Sensor) -> Sensor:
    """A sensor with its tip where the rod lies in the mechanical zero."""
    if isinstance(sensor, RodByBall | RodByBlade):
        return replace(sensor, beside=(0.0, 0.0, 0.0))
    return sensor


def _room_beside(sensor: RodByBall | RodByBlade, robot: Robot) -> float:
    """How far aside a rod may be from where a tip is placed, [m]."""
    if sensor.tip.form == "ball":
        return STEEPEST * (robot.legs[sensor.leg].rods[sensor.rod].radius + sensor.tip.radius)
    return ON_BLADE * sensor.tip.width


def _touching(session: Session) -> Session:
    """The candidates that touch what they read, on the nominal machine."""
    good = {
        (setup, posture)
        for setup, (postures, contact) in locate_contacts(session).items()
        for posture, problem in zip(postures, contact.problems, strict=True)
        if not problem
    }
    readings = tuple(r for r in session.readings if (r.setup, r.posture) in good)
    if not readings:
        raise ParameterError("no gauge touches anything in any posture", where="plan")
    if len(readings) > MOST_CANDIDATES:
        raise ParameterError(
            f"{len(readings)} readings to choose from; expected at most {MOST_CANDIDATES}: give "
            "fewer sections or places",
            where="plan",
        )
    used = {r.setup for r in readings}
    stands = {r.posture for r in readings}
    return replace(
        session,
        readings=readings,
        setups={n: s for n, s in session.setups.items() if n in used},
        postures={n: p for n, p in session.postures.items() if n in stands},
    )
