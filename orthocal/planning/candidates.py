"""Candidate readings of a plan: every possible setup in every posture in which it can be read.

Candidates are a session like any other, for all sensors: contacts, predicted readings and
Jacobians come from the same functions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthocal.arrays import Array, Indices
from orthocal.effects.loading import robot_effects
from orthocal.errors import ParameterError
from orthocal.estimation.problem import CalibrationProblem
from orthocal.kinematics.workspace import tool_at_zero
from orthocal.measurement.motion.approach import can_approach, usual_approaches
from orthocal.observation.contacts import locate_contacts
from orthocal.observation.model import nominal_sensitivity
from orthocal.observation.observations import build_observations
from orthocal.planning.equipment import Equipment, choose_box, place_tool, posture_name, reachable
from orthocal.planning.owned_sensors import DIAL
from orthocal.planning.tool_candidates import list_tool_candidates
from orthocal.robot.model import Leg, Robot
from orthocal.sensors.direction import Direction
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.sensors.tips import Tip
from orthocal.session.points import names_in_files
from orthocal.session.session import Conditions, Gauge, Posture, Reading, Session, Setup
from orthocal.statistics.noise import noise_floor
from orthocal.units import MM

PLACES_ACROSS = 5
"""Number of positions across a leg's direction."""

STEEPEST = 0.43
"""Largest lateral distance of ball and rod, as a fraction of the sum of their radii: 25°."""

ON_BLADE = 0.4
"""Largest distance of the contact from the centre of a blade, as a fraction of its width."""

WHOLE = 5e-3
"""Step of the positions, [m]."""

PHASES = 4
"""Phases of a periodic error in which successive positions along a leg lie."""

OVERLAP = 1.0
"""Distance of neighbouring lateral positions of a tip, in half widths."""

ON_AXIS = 0.999
"""Cosine above which a leg is parallel to an axis of the world."""

ZERO_PRIOR = 0.01
"""Prior standard deviation of a gauge zero, [m]: large beside any reading."""

FEWEST = 2
"""Fewest readings of a setup: one alone only determines the gauge zero."""

FEWEST_POINTS = 4
"""Fewest points of a setup: three determine the frame of the instrument."""

MOST_CANDIDATES = 60_000


@dataclass(frozen=True, slots=True, eq=False)
class AlignedParameter:
    """Nuisance parameter that the operator aligns to the machine in a setup's first posture."""

    sensitivity: Array
    """Sensitivity of the readings to it, shape (m,), [m/SI]."""
    jacobian: Array
    """Its sensitivity to the state in each posture, less the mean, shape (m, n_state), [SI]."""


@dataclass(frozen=True, slots=True, eq=False)
class CandidateSetup:
    """Possible setup, with the readings that it could have."""

    name: str
    """Name in the session of candidates."""
    rows: Indices
    """Row of each reading, the first one of a point, shape (m,)."""
    jacobian: Array
    """Sensitivity of the readings to the state, shape (m width, n_state), [m per prior std]; with
    the gauge aligned on the mean of the postures."""
    covariance: Array
    """Covariance of the readings from the setup's nuisance parameters and zero, shape
    (m width, m width), [m²]."""
    reachable: NDArray[np.bool_]
    """Whether a gauge that begins in one reading (row) has another (column) in its range,
    shape (m, m)."""
    aligned: tuple[AlignedParameter, ...] = ()
    absolute: bool = False
    """Whether the gauge zero is known."""
    gauge: str = ""
    """Name of its gauge."""
    width: int = 1
    """Numbers that the gauge shows in a posture: 3 for a point, in successive rows."""

    @property
    def fewest(self) -> int:
        """Fewest readings of a setup."""
        return FEWEST if self.width == 1 else FEWEST_POINTS

    def numbers(self, chosen: Sequence[int] | Indices) -> Indices:
        """Indices in the Jacobian of some readings, shape (..., n_chosen width)."""
        first = np.asarray(chosen, dtype=np.int64)[..., None] * self.width
        every = first + np.arange(self.width)
        return every.reshape(*every.shape[:-2], every.shape[-2] * self.width)

    def jacobian_of(self, chosen: Sequence[int]) -> Array:
        """Jacobian of some readings, the gauge aligned in the first, (n_chosen width, n_state)."""
        rows = self.numbers(chosen)
        jacobian = self.jacobian[rows]
        for a in self.aligned:
            jacobian = jacobian + np.outer(a.sensitivity[rows], a.jacobian[rows[0]])
        return jacobian


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Candidate setups and readings on a nominal machine."""

    session: Session
    problem: CalibrationProblem
    setups: tuple[CandidateSetup, ...]
    sigma: float
    """Standard deviation of a reading, [m]."""
    state: tuple[str, ...]
    """Parameters on which more than one setup depends."""
    spare_range: float
    """Part of the gauge's range to either side that the tolerances of the machine need, [m]."""

    @property
    def count(self) -> int:
        """Number of candidate readings."""
        return sum(len(s.rows) for s in self.setups)

    @property
    def without_session(self) -> Candidates:
        """Candidates without the session and its problem, which cannot be pickled."""
        nothing: Any = None
        return replace(self, session=nothing, problem=nothing)


def list_candidates(robot: Robot, equipment: Equipment, *, reference: str = "") -> Session:
    """Session of every possible setup in every posture in which it can be read.

    Args:
        robot: The robot.
        equipment: Gauge, tip and region of the postures.
        reference: Name of the robot in the session; by default its own.

    Raises:
        ParameterError: If there are no candidates, or too many.
    """
    if not robot.legs and not equipment.owned:
        raise ParameterError(
            f"'{robot.name}' has no legs for a gauge; add orthocal.legs", where="plan"
        )
    tool = list_tool_candidates(robot, equipment.owned, equipment.box)
    dial = DIAL if equipment.owned else ""
    postures: dict[str, Posture] = {}
    setups: dict[str, Setup] = {}
    readings: list[Reading] = []
    for leg in robot.legs.values():
        names = _add_postures(robot, leg, equipment, postures)
        for name, sensor in _sensors(leg, equipment):
            setups[name] = Setup(name, sensor, dial)
            readings += [Reading(name, p) for p in names]
            if len(readings) > MOST_CANDIDATES * 10:
                break
    session = Session(
        robot=robot,
        robot_reference=reference or robot.name,
        gauges={dial: equipment.gauge},
        postures=postures,
        setups=setups,
        readings=tuple(readings),
    )
    gauges, further, of_tool, more = tool
    if session.readings:  # the noise is that of the first gauge
        session = _with_approaches(_touching(_with_lateral_positions(session)))
        gauges = {**session.gauges, **gauges}
    return replace(
        session,
        gauges=gauges,
        postures={**session.postures, **further},
        setups={**session.setups, **of_tool},
        readings=(*session.readings, *more),
    )


def measure_candidates(
    session: Session, problem: CalibrationProblem, *, spare_range: float
) -> Candidates:
    """Jacobians and covariances of candidate readings, and which of them fit a gauge's range.

    Args:
        session: Session of the candidates.
        problem: Its calibration problem, with priors for all free parameters.
        spare_range: As in `Equipment`.
    """
    sigma = noise_floor(session.gauge.sigma, session.gauge.resolution)
    h, jacobian = problem.predict_and_jacobian(problem.active_theta)
    n, o = problem.n_machine, problem.observations
    private = {f"setup.{name}" for name in session.setups}
    owners = [name.rpartition(".")[0] for name in problem.free]
    common = [i for i, owner in enumerate(owners) if i < n or owner not in private]
    setups, needed, aligned_of = [], [], _list_aligned(session, problem)
    aligned_at, order = session.alignment_postures, list(session.setups)
    for parts in _find_parts(session):
        width, name = len(parts), parts[0].name
        rows = np.flatnonzero(np.isin(o.setup, [order.index(p.name) for p in parts]))
        if rows.size < FEWEST * width:
            continue
        own = {f"setup.{part.name}" for part in parts}
        of_setup = [i for i in range(n, len(owners)) if owners[i] in own]
        shared, mine = jacobian[rows][:, common], jacobian[rows][:, of_setup]
        aligned = []
        for index, seen in aligned_of.get(name, ()):
            sensitivity = jacobian[rows, index] / problem.theta_scale[index]
            moved = np.zeros_like(shared)
            moved[:, :n] = seen - seen.mean(axis=0)
            at = [session.readings[i].posture for i in rows].index(aligned_at[name])
            shared -= np.outer(sensitivity, moved[at])  # the session aligns the gauge there
            aligned.append(AlignedParameter(sensitivity, moved))
        covariance, absolute = mine @ mine.T, parts[0].zero == "known"
        reachable = np.ones((rows.size // width, rows.size // width), dtype=np.bool_)
        for c, part in enumerate(parts):
            of_part, ratio = slice(c, None, width), float(problem.noise_ratio[rows[c]])
            spread = covariance[of_part, of_part]
            # the operator places a fixed ball so that its first reading is in the middle of the
            # range
            unknown = spare_range * ratio * _difference_std(shared[of_part], spread)
            needed.append(float(unknown.max()))
            gauge = session.gauges[part.gauge]
            reachable &= _find_reachable(gauge, ratio * h[rows[of_part]], unknown)
            spread += 0.0 if absolute else (ZERO_PRIOR / ratio) ** 2
        candidate = CandidateSetup(
            *(name, rows[::width], shared, covariance, reachable, tuple(aligned), absolute),
            *(names_in_files(parts[0])[1], width),
        )
        setups.append(candidate)
    state = tuple(problem.free[i] for i in common)
    typical = float(np.median(needed)) if needed else 0.0
    return Candidates(session, problem, tuple(setups), sigma, state, typical)


def _find_parts(session: Session) -> list[list[Setup]]:
    """Setups that are read together: the three of points, or one."""
    parts: dict[str, list[Setup]] = {}
    for setup in session.setups.values():
        parts.setdefault(names_in_files(setup)[0], []).append(setup)
    return list(parts.values())


def _list_aligned(
    session: Session, problem: CalibrationProblem
) -> dict[str, list[tuple[int, Array]]]:
    """Nuisance parameters that are aligned to the machine, by setup.

    Each has its index among the free parameters, and its sensitivity to the machine's parameters
    in each of the setup's readings, shape (m, n_machine), [SI per prior std].
    """
    aligned: dict[str, dict[str, Setup]] = {}
    for name, setup in session.setups.items():
        for unknown, sensor in setup.sensor.aligned_to(session.robot).items():
            if unknown in {u.name for u in setup.sensor.nuisance_parameters}:
                aligned.setdefault(unknown, {})[name] = replace(setup, sensor=sensor)
    listed: dict[str, list[tuple[int, Array]]] = {}
    for unknown, setups in aligned.items():
        # operators align a gauge whatever the approach was
        readings = tuple(replace(r, conditions=None) for r in session.readings if r.setup in setups)
        views = replace(session, setups=setups, readings=readings)
        jacobian = nominal_sensitivity(views) @ problem.errors_per_theta
        setup_of = build_observations(views).setup
        for k, name in enumerate(setups):
            index = problem.free.index(f"setup.{name}.{unknown}")
            listed.setdefault(name, []).append((index, jacobian[setup_of == k]))
    return listed


def _difference_std(jacobian: Array, spread: Array) -> Array:
    """Prior standard deviations of differences of readings, shape (m, m), [m]."""
    covariance = jacobian @ jacobian.T + spread
    variance = np.diag(covariance)
    square = variance[:, None] + variance[None] - 2.0 * covariance
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def _find_reachable(gauge: Gauge, h: Array, unknown: Array) -> NDArray[np.bool_]:
    """True if a gauge with the middle of its range in one posture has another in its range."""
    if gauge.range is None:
        return np.ones((h.size, h.size), dtype=np.bool_)
    half = 0.5 * (gauge.range[1] - gauge.range[0])
    return np.asarray(np.abs(h[:, None] - h[None]) <= half - unknown)


def _add_postures(
    robot: Robot, leg: Leg, equipment: Equipment, postures: dict[str, Posture]
) -> list[str]:
    """Add the postures in which a leg can be read; their names."""
    box = choose_box(robot, equipment.box)
    middle = tool_at_zero(robot)
    coordinates = () if robot.tcp is None else robot.tcp.coordinates
    along = [k for k, c in enumerate(coordinates) if abs(leg.axis[c]) > ON_AXIS]
    lines = []
    for k, (low, high) in enumerate(box):
        if along and k not in along:
            side = middle[k] + np.linspace(-equipment.across, equipment.across, PLACES_ACROSS)
            lines.append(np.unique(np.clip(side, low, high)))
        else:
            line = np.linspace(low, high, equipment.along if along else PLACES_ACROSS)
            rounded = np.round(line / WHOLE) * WHOLE + _phases(robot, line.size)
            lines.append(np.unique(np.clip(rounded, low, high).round(9)))
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(lines))
    points = np.unique(np.vstack([np.clip(middle, box[:, 0], box[:, 1]), points.round(9)]), axis=0)
    points = points[reachable(robot, points)]
    if len(points) < FEWEST:
        raise ParameterError("the machine reaches no posture in it", where="plan: box")
    names = [posture_name(p, robot, middle) for p in points]
    for name, posture in place_tool(robot, names, points).items():
        postures.setdefault(name, posture)
    return names


def _phases(robot: Robot, count: int) -> Array:
    """Fractions of a period by which positions along a leg are shifted, shape (count,), [m]."""
    period = next((e.period for e in robot_effects(robot) if e.period is not None), 0.0)
    return np.asarray(np.arange(count) % PHASES * (period / PHASES))


def _sensors(leg: Leg, equipment: Equipment) -> Iterator[tuple[str, LegIndicator]]:
    """Possible indicators at a leg, with names."""
    for direction in directions_across(leg):
        word = direction if isinstance(direction, str) else "d"
        for part in equipment.sections:
            for sensor in equipment.list_sensors(leg, direction, part):
                rod = "" if sensor.rod is None else f"_{sensor.rod}"
                yield f"{word}{leg.name}{rod}_{part:g}", sensor


def directions_across(leg: Leg) -> list[Direction]:
    """Two directions across a leg, along axes of the world that are perpendicular to it."""
    directions: list[Direction] = [
        name for name, axis in zip("xyz", np.eye(3), strict=True) if abs(axis @ leg.axis) < 1e-6
    ]
    if len(directions) >= 2:
        return directions
    first = np.cross(leg.axis, np.eye(3)[int(np.abs(leg.axis).argmin())])
    if directions:
        first = np.eye(3)["xyz".index(str(directions[0]))]
    first /= np.linalg.norm(first)
    second = np.cross(leg.axis, first)
    return [(float(a), float(b), float(c)) for a, b, c in (first, second)]


def _with_lateral_positions(session: Session) -> Session:
    """Candidates with further gauges where the rod is in displaced postures."""
    robot, wide = session.robot, Tip("blade", 0.0, 10.0)
    sensors = {
        name: sensor
        for name, setup in session.setups.items()
        if (sensor := indicator_of(setup)) is not None
    }
    views = {
        n: replace(session.setups[n], sensor=s.on_rod(s.rod, wide))
        for n, s in sensors.items()
        if s.rod is not None
    }
    if not views:
        return session
    setups = {n: s for n, s in session.setups.items() if n not in views}
    readings = [r for r in session.readings if r.setup not in views]
    read: dict[str, list[Reading]] = {name: [] for name in sensors}
    for reading in session.readings:
        read[reading.setup].append(reading)
    on_rods = tuple(r for name in views for r in read[name])
    contacts = locate_contacts(replace(session, setups=views, readings=on_rods))
    for name, (postures, contact) in contacts.items():
        sensor = sensors[name]
        constants, half = sensor.constants(robot), _lateral_room(sensor, robot)
        side, start = constants[8:11], constants[11:14]
        aside = dict(zip(postures, ((contact.points - start) @ side).tolist(), strict=True))
        step = max(round(OVERLAP * half / MM), 1) * MM
        lowest, highest = (round(f(aside.values()) / step) for f in (min, max))
        for k in range(lowest, highest + 1):
            near = [r for r in read[name] if abs(aside[r.posture] - k * step) <= half]
            view_name = name if k == 0 else f"{name}_{k * step / MM:+.3g}"
            x, y, z = (float(v) for v in (k * step * side).round(9) + 0.0)
            lateral = replace(sensor, beside=(x, y, z))
            setups[view_name] = replace(session.setups[name], name=view_name, sensor=lateral)
            readings += [replace(r, setup=view_name) for r in near]
    return replace(session, setups=setups, readings=tuple(readings))


def indicator_of(setup: Setup) -> LegIndicator | None:
    """Indicator at a leg of a candidate setup; None for another sensor."""
    return setup.sensor if isinstance(setup.sensor, LegIndicator) else None


def _lateral_room(sensor: LegIndicator, robot: Robot) -> float:
    """Largest lateral distance of a rod from a tip, [m]."""
    if sensor.tip.form == "ball":
        return STEEPEST * float(sensor.constants(robot)[14])  # radii of rod and ball
    return ON_BLADE * sensor.tip.width


def _with_approaches(session: Session) -> Session:
    """Each candidate once for every approach that the robot's effects distinguish.

    Raises:
        ParameterError: If no posture can be approached.
    """
    approaches = usual_approaches(session.robot)
    if not approaches:
        return session
    drives = np.array([p.drives for p in session.postures.values()])
    possible = {
        a: dict(zip(session.postures, can_approach(session.robot, drives, a), strict=True))
        for a in approaches
    }
    readings = tuple(
        replace(r, conditions=Conditions(a))
        for r in session.readings
        for a in approaches
        if possible[a][r.posture]
    )
    if not readings:
        raise ParameterError("no posture can be approached within the travel", where="plan")
    return replace(session, readings=readings).select(readings)


def _touching(session: Session) -> Session:
    """Candidates whose tip touches the rod on the nominal machine."""
    good = {
        (setup, posture)
        for setup, (postures, contact) in locate_contacts(session).items()
        for posture, problem in zip(postures, contact.problems, strict=True)
        if not problem
    }
    readings = tuple(r for r in session.readings if (r.setup, r.posture) in good)
    if not readings:
        raise ParameterError("no gauge touches a rod in any posture", where="plan")
    if len(readings) > MOST_CANDIDATES:
        raise ParameterError(
            f"{len(readings)} candidate readings; expected at most {MOST_CANDIDATES}: choose fewer "
            "sections or positions",
            where="plan",
        )
    return replace(session, readings=readings).select(readings)
