"""Candidate readings of a plan: every possible setup in all its possible postures.

The candidates are an ordinary session. So contacts, predicted readings and Jacobians of all sensors
come from the usual functions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from orthocal.arrays import Array, Indices, Mask
from orthocal.effects.loading import robot_effects
from orthocal.errors import ParameterError
from orthocal.estimation.problem import CalibrationProblem
from orthocal.kinematics.workspace import grid_points, tool_at_zero
from orthocal.measurement.motion.approach import possible_approaches
from orthocal.observation.contacts import locate_contacts
from orthocal.observation.gauge_noise import stated_sigma
from orthocal.observation.model import nominal_sensitivity
from orthocal.observation.observations import build_observations
from orthocal.planning.equipment import Equipment, choose_box, indicators, place_reachable
from orthocal.planning.expected_error import ENTERED_OFFSET_STD
from orthocal.planning.owned_sensors import DIAL
from orthocal.planning.tool_candidates import PLACE, list_tool_candidates
from orthocal.robot.model import Leg, Robot
from orthocal.robot.parameters import is_offset
from orthocal.sensors.direction import Direction
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.sensors.tips import Tip
from orthocal.session.points import names_in_files
from orthocal.session.session import Conditions, Posture, Reading, Session, Setup
from orthocal.statistics.zeros import eliminate_zero
from orthocal.units import MM

POSITIONS_ACROSS = 5
"""Number of positions of the tool across a leg's direction."""

MAX_BALL_OFFSET = 0.43
"""Largest lateral distance of ball and rod, as a fraction of the sum of their radii: 25°."""

MAX_BLADE_OFFSET = 0.4
"""Largest distance of the contact from the centre of a blade, as a fraction of its width."""

POSITION_STEP = 5e-3
"""Step of the positions, [m]."""

PHASES = 4
"""Number of phases of a periodic error that successive positions along a leg sample."""

LATERAL_SPACING = 1.0
"""Distance of neighbouring lateral positions of a tip, in half widths of the tip."""

ON_AXIS = 0.999
"""Smallest cosine between a leg and an axis of the world that count as parallel."""

ZERO_PRIOR = 0.01
"""Prior standard deviation of each free zero of a point, [m]; larger than any reading."""

MIN_READINGS = 2
"""Fewest readings of a setup: a single one only determines the gauge zero."""

MIN_POINTS = 4
"""Fewest points of a setup: three determine the frame of the instrument."""

MAX_CANDIDATES = 60_000
"""Most candidate readings of a plan, to limit time and memory."""


@dataclass(frozen=True, slots=True, eq=False)
class AlignedParameter:
    """Nuisance parameter that the operator aligns to the machine in a setup's first posture."""

    sensitivity: Array
    """Sensitivity of the readings to the parameter, shape (m,), [m/SI]."""
    jacobian: Array
    """Sensitivity of the parameter to the state if it is aligned in each posture, minus the mean
    of the postures, shape (m, n_state), [SI per prior std]."""


@dataclass(frozen=True, slots=True, eq=False)
class CandidateSetup:
    """Possible setup with its candidate readings."""

    name: str
    """Name in the session of candidates."""
    rows: Indices
    """Row of each reading in that session, the first one of a point, shape (m,)."""
    jacobian: Array
    """Sensitivity of the readings to the state, shape (m width, n_state), [m per prior std],
    averaged over the postures in which the gauge may be aligned."""
    covariance: Array
    """Covariance of the readings from the setup's nuisance parameters, for points with their free
    zeros, shape (m width, m width), [m²]."""
    reachable: Mask
    """Mask of readings (columns) within the range of a gauge that begins in another reading (rows),
    shape (m, m)."""
    aligned: tuple[AlignedParameter, ...] = ()
    absolute: bool = False
    """Whether the gauge zero is known. The free zero of a single reading has no prior."""
    gauge: str = ""
    """Name of the gauge."""
    width: int = 1
    """Numbers that the gauge shows in a posture: 3 for a point, in successive rows."""

    @property
    def min_readings(self) -> int:
        """Fewest readings of a setup."""
        return MIN_READINGS if self.width == 1 else MIN_POINTS

    def numbers(self, chosen: Sequence[int] | Indices) -> Indices:
        """Indices in the Jacobian of some readings, shape (..., n_chosen width)."""
        first = np.asarray(chosen, dtype=np.int64)[..., None] * self.width
        rows = first + np.arange(self.width)
        return rows.reshape(*rows.shape[:-2], rows.shape[-2] * self.width)

    def weights_of(self, chosen: Sequence[int], noise: float) -> Array:
        """Inverse covariance of some readings, with a free gauge zero eliminated.

        Args:
            chosen: The readings.
            noise: Variance of a reading, [m²].

        Returns:
            Shape (n_chosen width, n_chosen width), [1/m²].
        """
        rows = self.numbers(chosen)
        covariance = self.covariance[np.ix_(rows, rows)] + noise * np.eye(len(rows))
        weights = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        if self.absolute or self.width > 1:
            return weights
        return eliminate_zero(weights)[0]

    def jacobian_of(self, chosen: Sequence[int]) -> Array:
        """Jacobian of some readings if the gauge is aligned in the first.

        The shape is (n_chosen width, n_state).
        """
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
    """Names of the parameters on which more than one setup may depend."""
    spare_range: float
    """Range of the gauge to either side that errors within the tolerances need, [m]; median."""
    needed: Mapping[str, float] = field(default_factory=dict)
    """Range to either side that readings of a gauge need, by gauge, [m]; median."""

    @property
    def count(self) -> int:
        """Number of candidate readings."""
        return sum(len(s.rows) for s in self.setups)

    @property
    def unusable(self) -> dict[str, float]:
        """Gauges whose range is too small for any setup, with `needed`, [m]."""
        usable = {s.gauge for s in self.setups if s.reachable.sum(axis=1).max() >= s.min_readings}
        return {gauge: v for gauge, v in self.needed.items() if gauge not in usable}

    @property
    def without_session(self) -> Candidates:
        """Copy without the session and its problem, which cannot be pickled."""
        absent: Any = None
        return replace(self, session=absent, problem=absent)


def list_candidates(robot: Robot, equipment: Equipment, *, reference: str = "") -> Session:
    """Session of every possible setup in all its possible postures.

    Args:
        robot: The robot.
        equipment: Gauge, tip and region of the postures.
        reference: Name of the robot in the session; by default that of the model.

    Raises:
        ParameterError: If there are no candidates, or too many.
    """
    if not robot.legs and not equipment.owned:
        raise ParameterError(
            f"'{robot.name}' has no legs for a gauge; add orthocal.legs", where="plan"
        )
    limited = equipment.limit_travel(robot)
    tool_gauges, tool_postures, tool_setups, tool_readings = list_tool_candidates(
        limited, equipment.owned, equipment.box
    )
    dial = DIAL if equipment.owned else ""
    postures: dict[str, Posture] = {}
    setups: dict[str, Setup] = {}
    readings: list[Reading] = []
    for leg in robot.legs.values():
        names = _add_postures(limited, leg, equipment, postures)
        for name, sensor in _sensors(leg, equipment):
            setups[name] = Setup(name, sensor, dial)
            readings += [Reading(name, p) for p in names]
            if len(readings) > MAX_CANDIDATES * 10:
                break
    session = Session(
        robot=limited,
        robot_reference=reference or robot.name,
        gauges={dial: equipment.gauge},
        postures=postures,
        setups=setups,
        readings=tuple(readings),
    )
    if session.readings:  # the noise is that of the first gauge
        session = _with_approaches(_touching(_with_lateral_positions(session)))
        tool_gauges = {**session.gauges, **tool_gauges}
    return replace(
        session,
        robot=robot,
        gauges=tool_gauges,
        postures={**session.postures, **tool_postures},
        setups={**session.setups, **tool_setups},
        readings=(*session.readings, *tool_readings),
    )


def measure_candidates(
    session: Session, problem: CalibrationProblem, *, spare_range: float, entered: bool = False
) -> Candidates:
    """Compute Jacobians, covariances and gauge ranges of candidate readings.

    Args:
        session: Session of the candidates.
        problem: Calibration problem of that session, with priors for all free parameters.
        spare_range: Prior standard deviations of readings that must fit into the gauge's range.
        entered: True if offsets of a calibration are active, so that the remaining ones are small.
    """
    sigma = stated_sigma(session.gauge)
    n, o = problem.n_machine, problem.observations
    owners = [name.rpartition(".")[0] for name in problem.free]
    common = _find_state(session, owners, n)
    state, all_parts = tuple(problem.free[i] for i in common), _find_parts(session)
    column = share_columns(owners, common, all_parts)
    h, jacobian = _predict_and_jacobian(problem, column[n:] - n)
    stds = np.array([ENTERED_OFFSET_STD if entered and is_offset(s) else 1.0 for s in state])
    setups, margins, aligned_of = [], [], _list_aligned(session, problem)
    spans: dict[str, list[float]] = {}
    aligned_at, order = session.alignment_postures, list(session.setups)
    for parts in all_parts:
        width, name, (_, base) = len(parts), parts[0].name, names_in_files(parts[0])
        rows = np.flatnonzero(np.isin(o.setup, [order.index(p.name) for p in parts]))
        if rows.size < MIN_READINGS * width:
            continue
        of_parts = {f"setup.{part.name}" for part in parts}
        of_setup = [column[i] for i in range(n, len(owners)) if owners[i] in of_parts]
        of_rows = jacobian[rows]
        by_state, by_nuisance = of_rows[:, : len(common)].copy(), of_rows[:, of_setup]
        aligned = []
        for index, alignment in aligned_of.get(name, ()):
            sensitivity = of_rows[:, column[index]] / problem.theta_scale[index]
            a = AlignedParameter(sensitivity, _about_mean(alignment, len(common)))
            first = [session.readings[i].posture for i in rows].index(aligned_at[name])
            by_state -= np.outer(a.sensitivity, a.jacobian[first])  # the session aligns it here
            aligned.append(a)
        covariance, absolute = by_nuisance @ by_nuisance.T, parts[0].zero == "known"
        reachable = np.ones((rows.size // width, rows.size // width), dtype=np.bool_)
        for c, part in enumerate(parts):
            of_part, ratio = slice(c, None, width), float(problem.noise_ratio[rows[c]])
            prior = by_state[of_part] * stds
            prior = prior @ prior.T + covariance[of_part, of_part]
            margin = spare_range * ratio * _prior_std(prior, absolute=absolute)
            margins.append(float(margin.max()))
            gauge, predicted = session.gauges[part.gauge], ratio * h[rows[of_part]]
            if gauge.range is not None:
                span = margin + _distances(predicted, gauge.middle if absolute else None)
                reachable &= span <= gauge.half_range
                each = np.diag(span) if absolute else span
                spans.setdefault(base, []).append(float(np.median(each)))
            zero = 0.0 if absolute or width == 1 else ZERO_PRIOR / ratio
            covariance[of_part, of_part] += zero**2
        candidate = name, rows[::width], by_state, covariance, reachable, tuple(aligned), absolute
        setups.append(CandidateSetup(*candidate, base, width))
    median = float(np.median(margins)) if margins else 0.0
    needed = {gauge: float(np.median(v)) for gauge, v in spans.items()}
    return Candidates(session, problem, tuple(setups), sigma, state, median, needed)


def _find_state(session: Session, owners: Sequence[str], n_machine: int) -> list[int]:
    """Indices of the free parameters on which more than one setup may depend.

    Args:
        session: Session of the candidates.
        owners: Owner of each free parameter.
        n_machine: Number of parameters of the machine, which are the first.
    """
    private = {f"setup.{name}" for name in session.setups}
    return [i for i, owner in enumerate(owners) if i < n_machine or owner not in private]


def share_columns(
    owners: Sequence[str], common: Sequence[int], parts: list[list[Setup]]
) -> Indices:
    """Column of each free parameter in a Jacobian whose private columns all setups share.

    Args:
        owners: Owner of each free parameter.
        common: Indices of the free parameters that setups share; they have the first columns.
        parts: Setups that are read together.
    """
    column = np.empty(len(owners), dtype=np.int64)
    column[common] = np.arange(len(common))
    instrument = {f"setup.{setup.name}": i for i, of in enumerate(parts) for setup in of}
    n_private: Counter[int] = Counter()
    for i in sorted(set(range(len(owners))) - set(common)):
        owner = instrument[owners[i]]
        column[i] = len(common) + n_private[owner]
        n_private[owner] += 1
    return column


def _predict_and_jacobian(
    problem: CalibrationProblem, nuisance_columns: Indices
) -> tuple[Array, Array]:
    """Predicted readings and Jacobian, as of the problem but with shared columns."""
    theta = problem.active_theta
    scale = problem.theta_scale[problem.n_machine :]
    free = problem.model.parametrise(problem.errors_per_theta, scale, nuisance_columns)
    linear = problem.linearise(theta, problem.close(theta), free=free)
    return linear.reading, linear.jacobian


def _find_parts(session: Session) -> list[list[Setup]]:
    """Setups that are read together: the three of points, or one."""
    parts: dict[str, list[Setup]] = {}
    for setup in session.setups.values():
        parts.setdefault(names_in_files(setup)[0], []).append(setup)
    return list(parts.values())


def _list_aligned(
    session: Session, problem: CalibrationProblem
) -> dict[str, list[tuple[int, Array]]]:
    """Nuisance parameters that are aligned to the machine.

    Returns:
        Pairs by setup: index among the free parameters; and sensitivity to the machine's parameters
        in the posture of each reading, shape (m, n_machine), [SI per prior std].
    """
    by_parameter: dict[str, dict[str, Setup]] = {}
    for name, setup in session.setups.items():
        for parameter, sensor in setup.sensor.aligned_to(session.robot).items():
            if parameter in {u.name for u in setup.sensor.nuisance_parameters}:
                by_parameter.setdefault(parameter, {})[name] = replace(setup, sensor=sensor)
    aligned: dict[str, list[tuple[int, Array]]] = {}
    for parameter, setups in by_parameter.items():
        # the alignment does not depend on the approach
        readings = tuple(replace(r, conditions=None) for r in session.readings if r.setup in setups)
        virtual = replace(session, setups=setups, readings=readings)
        jacobian = nominal_sensitivity(virtual, problem.errors_per_theta)
        setup_of_row = build_observations(virtual).setup
        for k, name in enumerate(setups):
            index = problem.free.index(f"setup.{name}.{parameter}")
            aligned.setdefault(name, []).append((index, jacobian[setup_of_row == k]))
    return aligned


def _about_mean(alignment: Array, n_state: int) -> Array:
    """Sensitivities minus their mean over the postures, padded with 0, shape (m, n_state)."""
    padded = np.zeros((len(alignment), n_state))
    padded[:, : alignment.shape[1]] = alignment - alignment.mean(axis=0)
    return padded


def _prior_std(covariance: Array, *, absolute: bool) -> Array:
    """Prior standard deviations that the range of a gauge must contain, shape (m, m), [m].

    They are those of the differences of two readings. If the gauge zero is known, they are the
    larger ones of both readings: the operator cannot set the dial to the middle of its range.

    Args:
        covariance: Prior covariance of the readings, shape (m, m), [m²].
        absolute: Whether the gauge zero is known.
    """
    variance = np.diag(covariance)
    if absolute:
        return np.asarray(np.sqrt(np.maximum(variance[:, None], variance)))
    square = variance[:, None] + variance[None] - 2.0 * covariance
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def _distances(h: Array, middle: float | None) -> Array:
    """Distances of readings from the middle of the dial, shape (m, m), [m].

    Args:
        h: Predicted readings, shape (m,), [m].
        middle: Middle of the range, [m]; None for a dial that is set to it in the first reading
            (rows).
    """
    if middle is None:
        return np.asarray(np.abs(h[:, None] - h))
    distances = np.abs(h - middle)
    return np.asarray(np.maximum(distances[:, None], distances))


def _add_postures(
    robot: Robot, leg: Leg, equipment: Equipment, postures: dict[str, Posture]
) -> list[str]:
    """Add the postures in which a leg can be read, and return their names."""
    box = choose_box(robot, equipment.box)
    middle = tool_at_zero(robot)
    coordinates = () if robot.tcp is None else robot.tcp.coordinates
    along = [k for k, c in enumerate(coordinates) if abs(leg.axis[c]) > ON_AXIS]
    coordinate_values = []
    for k, (low, high) in enumerate(box):
        if along and k not in along:
            values = middle[k] + np.linspace(-equipment.across, equipment.across, POSITIONS_ACROSS)
            coordinate_values.append(np.unique(np.clip(values, low, high)))
        else:
            values = np.linspace(low, high, equipment.along if along else POSITIONS_ACROSS)
            values = np.round(values / POSITION_STEP) * POSITION_STEP + _phases(robot, values.size)
            coordinate_values.append(np.unique(np.clip(values, low, high).round(9)))
    points = grid_points(*coordinate_values).round(9)
    points = np.unique(np.vstack([np.clip(middle, *box.T), points]), axis=0)
    placed = place_reachable(robot, points, middle)
    if len(placed) < MIN_READINGS:
        within = " and within the soft limits" if equipment.soft_limits else ""
        raise ParameterError(
            f"the machine reaches no posture in this box{within}", where="plan: box"
        )
    for name, posture in placed.items():
        postures.setdefault(name, posture)
    return list(placed)


def _phases(robot: Robot, count: int) -> Array:
    """Shifts of positions along a leg by fractions of a periodic error's period, (count,), [m]."""
    period = next((e.period for e in robot_effects(robot) if e.period is not None), 0.0)
    return np.asarray(np.arange(count) % PHASES * (period / PHASES))


def _sensors(leg: Leg, equipment: Equipment) -> Iterator[tuple[str, LegIndicator]]:
    """Names and indicators of all possible setups at a leg."""
    for i, direction in enumerate(directions_across(leg), 1):
        prefix = direction if isinstance(direction, str) else f"d{i}"
        for fraction in equipment.sections:
            for sensor in equipment.list_sensors(leg, direction, fraction):
                rod = "" if sensor.rod is None else f"{sensor.rod}_"
                yield f"{prefix}{leg.name}{PLACE}{rod}{fraction:g}", sensor


def directions_across(leg: Leg) -> list[Direction]:
    """Two directions across a leg, along axes of the world if these are perpendicular to it."""
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
    """Add setups with the gauge at further lateral positions, for postures that displace the rod.

    A very wide blade locates the contact with the rod in every posture.
    """
    robot, wide, sensors = session.robot, Tip("blade", 0.0, 10.0), indicators(session)
    on_rods = {
        n: replace(session.setups[n], sensor=s.on_rod(s.rod, wide))
        for n, s in sensors.items()
        if s.rod is not None
    }
    if not on_rods:
        return session
    setups = {n: s for n, s in session.setups.items() if n not in on_rods}
    readings = [r for r in session.readings if r.setup not in on_rods]
    of_setup: dict[str, list[Reading]] = {name: [] for name in sensors}
    for reading in session.readings:
        of_setup[reading.setup].append(reading)
    rod_readings = tuple(r for name in on_rods for r in of_setup[name])
    contacts = locate_contacts(replace(session, setups=on_rods, readings=rod_readings))
    for name, (postures, contact) in contacts.items():
        sensor = sensors[name]
        constants, half = sensor.constants(robot), _max_lateral_distance(sensor, robot)
        side, start = constants[8:11], constants[11:14]
        lateral = dict(zip(postures, ((contact.points - start) @ side).tolist(), strict=True))
        step = max(round(LATERAL_SPACING * half / MM), 1) * MM
        lowest, highest = (round(f(lateral.values()) / step) for f in (min, max))
        for k in range(lowest, highest + 1):
            near = [r for r in of_setup[name] if abs(lateral[r.posture] - k * step) <= half]
            new_name = name if k == 0 else f"{name}_{k * step / MM:+.3g}"
            x, y, z = (float(v) for v in (k * step * side).round(9) + 0.0)
            displaced = replace(sensor, beside=(x, y, z))
            setups[new_name] = replace(session.setups[name], name=new_name, sensor=displaced)
            readings += [Reading(new_name, r.posture) for r in near]
    return replace(session, setups=setups, readings=tuple(readings))


def _max_lateral_distance(sensor: LegIndicator, robot: Robot) -> float:
    """Largest lateral distance of a rod from the middle of a tip that touches it, [m]."""
    if sensor.tip.form == "ball":
        return MAX_BALL_OFFSET * float(sensor.constants(robot)[14])  # sum of both radii
    return MAX_BLADE_OFFSET * sensor.tip.width


def _with_approaches(session: Session) -> Session:
    """Repeat each candidate for every approach that the robot's effects distinguish.

    Raises:
        ParameterError: If no posture can be approached.
    """
    by_approach = possible_approaches(session.robot, session.postures)
    if not by_approach:
        return session
    conditions = {a: Conditions(a) for a in by_approach}
    readings = tuple(
        Reading(r.setup, r.posture, conditions=conditions[a])
        for r in session.readings
        for a, possible in by_approach.items()
        if r.posture in possible
    )
    if not readings:
        raise ParameterError("no posture can be approached within the travel", where="plan")
    return replace(session, readings=readings).select(readings)


def _touching(session: Session) -> Session:
    """Select the candidates whose tip touches the rod on the nominal machine."""
    touching = {
        (setup, posture)
        for setup, (postures, contact) in locate_contacts(session).items()
        for posture, problem in zip(postures, contact.problems, strict=True)
        if not problem
    }
    readings = tuple(r for r in session.readings if (r.setup, r.posture) in touching)
    if not readings:
        raise ParameterError("no gauge touches a rod in any posture", where="plan")
    if len(readings) > MAX_CANDIDATES:
        raise ParameterError(
            f"{len(readings)} candidate readings; expected at most {MAX_CANDIDATES}: choose fewer "
            "sections or positions",
            where="plan",
        )
    return replace(session, readings=readings).select(readings)
