"""A session's readings as single ones with unknown zeros, and what a machine shows of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthocal.kinematics.assembly import Assembly, nominal_assembly
from orthocal.kinematics.compiled import compiled_robot, zero_poses
from orthocal.measurement.session import Session
from orthocal.robot.parameters import Parameter
from orthocal.sensors.compiled import CompiledReading, compile_reading
from orthocal.sensors.protocol import Contact

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Readings as the gauge showed them, one an entry; differences taken apart.

    Differences of one setup and cycle that share postures are the same as readings with one
    unknown zero: their covariance, σ² [[2, 1], [1, 2]] for two differences from one posture, comes
    out of eliminating it. So every reading here is a single one with standard deviation σ.
    """

    setup: Indices
    """Index of the setup, shape (n,)."""
    posture: Indices
    """Index of the posture, shape (n,)."""
    zero: Indices
    """Index of the unknown zero, shape (n,)."""
    n_zeros: int
    zero_setup: tuple[str, ...]
    """Setup of each zero."""
    zero_real: tuple[bool, ...]
    """Whether a zero is that of a gauge, not one that stands for differences."""
    plus: Indices
    """Entry of each row of the session, shape (n_rows,)."""
    minus: Indices
    """Entry taken off, or -1, shape (n_rows,)."""

    @property
    def size(self) -> int:
        """Number of entries."""
        return self.setup.size

    def only(self, chosen: NDArray[np.bool_]) -> Observations:
        """Some of the entries: which setup, posture and zero they have; no rows."""
        none = np.empty(0, dtype=np.int64)
        return replace(
            self,
            setup=self.setup[chosen],
            posture=self.posture[chosen],
            zero=self.zero[chosen],
            plus=none,
            minus=none,
        )

    def sum_by_zero(self, values: Array, weights: Array) -> Array:
        """Weighted sums of those with the same zero, shape (n_zeros, m) of (n, m)."""
        order = np.argsort(self.zero, kind="stable")
        starts = np.searchsorted(self.zero[order], np.arange(self.n_zeros))
        result = np.zeros((self.n_zeros, values.shape[1]))
        used = np.append(starts[1:], self.size) > starts
        weighted = (values * weights[:, None])[order]
        if weighted.size:
            result[used] = np.add.reduceat(weighted, starts[used], axis=0)
        return result

    def rows(self, entries: Array) -> Array:
        """Rows of the session from values of the entries, shape (n_rows, ...)."""
        taken = np.where(
            (self.minus >= 0).reshape(-1, *(1,) * (entries.ndim - 1)), entries[self.minus], 0.0
        )
        return np.asarray(entries[self.plus] - taken)

    def values(self, rows: Array) -> Array:
        """Values of the entries from rows of the session, shape (n,) of (n_rows,), [m].

        Where rows are differences, the first posture of each group is given the value 0.
        """
        result = np.zeros(self.size)
        known = np.zeros(self.size, dtype=bool)
        raw = self.minus < 0
        result[self.plus[raw]] = rows[raw]
        known[self.plus[raw]] = True
        pending = list(np.flatnonzero(~raw))
        while pending:
            left = []
            for row in pending:
                p, m = self.plus[row], self.minus[row]
                if known[p]:
                    result[m] = result[p] - rows[row]
                elif known[m]:
                    result[p] = result[m] + rows[row]
                else:
                    left.append(row)
                    continue
                known[p] = known[m] = True
            if len(left) == len(pending):  # nothing touches a known one: begin a new group
                known[self.minus[left[0]]] = True
            pending = left
        return result


def build_observations(session: Session) -> Observations:
    """Take a session's readings apart into single ones with unknown zeros."""
    setups = {name: i for i, name in enumerate(session.setups)}
    postures = {name: i for i, name in enumerate(session.postures)}
    entries: list[tuple[int, int, int]] = []
    zeros: dict[tuple[object, ...], int] = {}
    zero_setup: list[str] = []
    zero_real: list[bool] = []
    nodes: dict[tuple[str, int, str], int] = {}
    plus, minus = [], []
    groups = _difference_groups(session)

    def zero_index(key: tuple[object, ...], setup: str, real: bool) -> int:
        if key not in zeros:
            zeros[key] = len(zeros)
            zero_setup.append(setup)
            zero_real.append(real)
        return zeros[key]

    for reading in session.readings:
        setup = setups[reading.setup]
        if reading.minus is None:
            zero = zero_index((reading.setup,), reading.setup, True)
            plus.append(len(entries))
            minus.append(-1)
            entries.append((setup, postures[reading.posture], zero))
            continue
        ends = []
        for posture in (reading.posture, reading.minus):
            node = (reading.setup, reading.cycle, posture)
            if node not in nodes:
                key = (reading.setup, reading.cycle, groups[node])
                nodes[node] = len(entries)
                entries.append((setup, postures[posture], zero_index(key, reading.setup, False)))
            ends.append(nodes[node])
        plus.append(ends[0])
        minus.append(ends[1])
    table = np.array(entries, dtype=np.int64).reshape(-1, 3)
    return Observations(
        setup=table[:, 0],
        posture=table[:, 1],
        zero=table[:, 2],
        n_zeros=len(zeros),
        zero_setup=tuple(zero_setup),
        zero_real=tuple(zero_real),
        plus=np.array(plus, dtype=np.int64),
        minus=np.array(minus, dtype=np.int64),
    )


def _difference_groups(session: Session) -> dict[tuple[str, int, str], str]:
    """Posture of a setup and cycle to a name for all postures that differences join it with."""
    leader: dict[tuple[str, int, str], tuple[str, int, str]] = {}

    def find(node: tuple[str, int, str]) -> tuple[str, int, str]:
        while (above := leader.setdefault(node, node)) != node:
            leader[node] = leader.setdefault(above, above)  # half the way next time
            node = above
        return node

    for r in session.readings:
        if r.minus is not None:
            leader[find((r.setup, r.cycle, r.posture))] = find((r.setup, r.cycle, r.minus))
    return {node: find(node)[2] for node in list(leader)}


def drive_table(session: Session) -> Array:
    """Commanded drive coordinates of all postures, shape (n_postures, n_drives), [m, rad]."""
    return np.array([p.drives for p in session.postures.values()])


@dataclass(frozen=True, slots=True, eq=False)
class SensorGroup:
    """Entries whose sensors have one expression."""

    reading: CompiledReading
    entries: Indices
    """Shape (n,)."""
    setups: Indices
    """Their setups, shape (n,)."""
    constants: Array
    """Of their setups, shape (n, n_constants)."""
    unknowns: Indices
    """Which of the session's unknowns are theirs, shape (n, n_unknowns)."""

    def parts(self, size: int) -> Iterator[tuple[Indices, slice]]:
        """Entries, and where they are in the group, not more than so many at a time."""
        for first in range(0, self.entries.size, size):
            part = slice(first, first + size)
            yield self.entries[part], part


@dataclass(frozen=True, slots=True, eq=False)
class SensorUnknowns:
    """What of a session's sensors is not known exactly."""

    parameters: tuple[Parameter, ...]
    """Named after their setups, or after what several share; they add to no error of a machine."""
    of_setup: tuple[tuple[int, ...], ...]
    """Which of them each setup has, in the order of its sensor's."""


def sensor_unknowns(session: Session) -> SensorUnknowns:
    """The unknowns of all setups that are read."""
    found: dict[str, Parameter] = {}
    places = []
    read = {r.setup for r in session.readings}
    for setup in session.setups.values():
        own = []
        for unknown in setup.sensor.unknowns if setup.name in read else ():
            owner = unknown.shared_by or f"setup.{setup.name}"
            name = f"{owner}.{unknown.name}"
            found.setdefault(name, Parameter(name, unknown.unit, unknown.tolerance, ()))
            own.append(list(found).index(name))
        places.append(tuple(own))
    return SensorUnknowns(tuple(found.values()), tuple(places))


def group_sensors(session: Session, observations: Observations) -> tuple[SensorGroup, ...]:
    """Entries by the expression that they are readings of."""
    robot = session.robot
    setups = list(session.setups.values())
    unknowns = sensor_unknowns(session).of_setup
    found: dict[int, tuple[CompiledReading, list[int]]] = {}
    for i in np.unique(observations.setup).tolist():
        reading = compile_reading(robot, setups[i].sensor)
        found.setdefault(id(reading), (reading, []))[1].append(i)
    groups = []
    for reading, members in found.values():
        entries = np.flatnonzero(np.isin(observations.setup, members))
        constants = {i: setups[i].sensor.constants(robot) for i in members}
        of_entry = observations.setup[entries]
        table = np.array([constants[i] for i in of_entry.tolist()])
        own = np.array([unknowns[i] for i in of_entry.tolist()], dtype=np.int64)
        own = own.reshape(entries.size, -1)
        groups.append(SensorGroup(reading, entries, of_entry, table, own))
    return tuple(groups)


def predict_entries(
    session: Session,
    observations: Observations,
    errors: Mapping[str, float] | None = None,
    *,
    passive: Array | None = None,
    unknowns: Array | None = None,
) -> Array:
    """Readings that a machine with given errors shows, gauge zeros at 0, shape (n,), [m].

    Args:
        session: Postures, setups and robot.
        observations: Which setup is read in which posture.
        errors: Parameter name to value, [unit of the parameter].
        passive: Passive coordinates of every posture, if they are known, [m, rad].
        unknowns: Those of the sensors, in the order of `sensor_unknowns`, [SI]; 0 by default.

    Raises:
        ClosureError: If the machine cannot reach a posture.
    """
    robot = session.robot
    drives = drive_table(session)
    assembly = Assembly(robot, fixed=errors)
    if passive is None:
        passive = assembly.close(drives, names=list(session.postures))
    machine = assembly.machine()
    actuated, zero = machine.drives(drives), machine.drives(session.zero_drives)
    if unknowns is None:
        unknowns = np.zeros(len(sensor_unknowns(session).parameters))
    result = np.empty(observations.size)
    for group in group_sensors(session, observations):
        at = observations.posture[group.entries]
        (h,) = group.reading.value(
            actuated[at],
            passive[at],
            machine.placements,
            zero[group.setups],
            group.constants,
            unknowns[group.unknowns],
        )
        result[group.entries] = h[:, 0]
    return result


def locate_contacts(session: Session) -> dict[str, tuple[list[str], Contact]]:
    """Where sensors touch the nominal machine.

    Returns:
        Setup to the postures that it is read in, and where it touches in them.
    """
    robot = session.robot
    nominal = drive_table(session) + session.active_offsets
    assembly = nominal_assembly(robot)
    passive = assembly.close(nominal, names=list(session.postures))
    machine, compiled = assembly.machine(), compiled_robot(robot)

    def poses(frame: str, drives: Array, passive: Array) -> Array:
        (found,) = compiled.pose(frame)(drives, passive, machine.placements)
        return found

    postures = {name: i for i, name in enumerate(session.postures)}
    read: dict[str, set[str]] = {name: set() for name in session.setups}
    for reading in session.readings:
        read[reading.setup].update(p for p in (reading.posture, reading.minus) if p is not None)
    result = {}
    for setup in session.setups.values():
        names = sorted(read[setup.name], key=postures.__getitem__)
        rows, frames = [postures[n] for n in names], setup.sensor.frames(robot)
        contact = setup.sensor.contact(
            [poses(f, nominal[rows], passive[rows]) for f in frames.in_posture],
            zero_poses(robot, frames.at_zero),
            robot,
        )
        result[setup.name] = names, contact
    return result
