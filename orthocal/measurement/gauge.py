"""The observation model: what an indicator shows of a leg that is not parallel to its motion.

The gauge stands on the base and touches the leg where the leg's line, from root to tip, crosses
the plane of the section. Its reading is the coordinate of that point along its direction, plus the
unknown zero of the setup:

    h = d · (root + t (tip − root)),  t = (c − a · root) / (a · (tip − root))

with a the leg's nominal axis and c the plane: a world coordinate, or counted from the root in the
zero posture (the paper's X-leg midpoint, section 3.2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocal.kinematics.assembly import Assembly, nominal_assembly
from orthocal.kinematics.batch import BatchFunction
from orthocal.kinematics.symbolic import SymbolicRobot
from orthocal.measurement.session import DIRECTIONS, Session, section_plane
from orthocal.robot.model import Leg, Robot

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


def reading_expression(
    root: ca.SX, tip: ca.SX, *, axis: Array, direction: ca.SX, section: ca.SX
) -> ca.SX:
    """H of a gauge on a leg, [m].

    Args:
        root: Position of the leg's root, shape (3,), [m].
        tip: Position of its tip, shape (3,), [m].
        axis: The leg's nominal axis, shape (3,).
        direction: Unit vector of a growing reading, shape (3,).
        section: Coordinate of the section's plane along the axis, [m].
    """
    a = ca.sparsify(ca.SX(np.array(axis)))
    t = (section - ca.dot(a, root)) / ca.dot(a, tip - root)
    return ca.dot(direction, root + t * (tip - root))


def zero_root_coordinate(leg: Leg, at_zero: SymbolicRobot) -> ca.SX:
    """Where sections that count from the root begin: a · root in the zero posture, [m].

    Args:
        leg: The leg.
        at_zero: The machine in the zero posture, passive joints as nominal: the root needs only
            its drive.
    """
    return ca.dot(ca.sparsify(ca.SX(np.array(leg.axis))), at_zero.frame_pose(leg.root).position)


def setup_columns(session: Session) -> Array:
    """Constants of every setup: direction (3), plane, from_root; shape (n_setups, 5), [1, m, 1]."""
    columns = []
    for setup in session.setups.values():
        plane, from_root = section_plane(session.robot, setup)
        columns.append([*DIRECTIONS[setup.direction], plane, float(from_root)])
    return np.array(columns)


def drive_table(session: Session) -> Array:
    """Commanded drive coordinates of all postures, shape (n_postures, n_drives), [m, rad]."""
    return np.array([p.drives for p in session.postures.values()])


def predict_entries(
    session: Session,
    observations: Observations,
    errors: Mapping[str, float] | None = None,
    *,
    passive: Array | None = None,
) -> Array:
    """Readings that a machine with given errors shows, gauge zeros at 0, shape (n,), [m].

    Args:
        session: Postures, setups and robot.
        observations: Which setup is read in which posture.
        errors: Parameter name to value, [unit of the parameter].
        passive: Passive coordinates of every posture, if they are known, [m, rad].

    Raises:
        ClosureError: If the machine cannot reach a posture.
    """
    robot = session.robot
    drives = drive_table(session)
    if passive is None:
        passive = Assembly(robot, fixed=errors).close(drives, names=list(session.postures))
    columns = setup_columns(session)
    result = np.empty(observations.size)
    leg_of_setup = np.array(
        [list(robot.legs).index(s.leg) for s in session.setups.values()], dtype=np.int64
    )
    for i, leg in enumerate(robot.legs.values()):
        chosen = np.flatnonzero(leg_of_setup[observations.setup] == i)
        if chosen.size:
            function = _reading_function(robot, leg, errors)
            postures = observations.posture[chosen]
            (h,) = function(
                drives[postures],
                passive[postures],
                session.zero_drives,
                columns[observations.setup[chosen]],
            )
            result[chosen] = h[:, 0]
    return result


def _reading_function(robot: Robot, leg: Leg, errors: Mapping[str, float] | None) -> BatchFunction:
    drives = ca.SX.sym("drives", len(robot.drives))
    passive = ca.SX.sym("passive", robot.passive_index.size)
    zero_drives = ca.SX.sym("zero_drives", len(robot.drives))
    column = ca.SX.sym("setup", 5)
    at_posture = SymbolicRobot(robot, drives=drives, passive=passive, errors=errors)
    zero_passive = ca.SX(robot.zero[robot.passive_index])
    at_zero = SymbolicRobot(robot, drives=zero_drives, passive=zero_passive, errors=errors)
    section = column[3] + column[4] * zero_root_coordinate(leg, at_zero)
    root, tip = (at_posture.frame_pose(f).position for f in (leg.root, leg.tip))
    h = reading_expression(root, tip, axis=leg.axis, direction=column[:3], section=section)
    function = ca.Function(
        "reading",
        [drives, passive, zero_drives, column],
        [h],
        ["drives", "passive", "zero_drives", "setup"],
        ["h"],
    )
    return BatchFunction(function, shared=["zero_drives"])


def locate_contacts(session: Session) -> dict[tuple[str, str], float]:
    """Where on the leg the gauge touches, nominally: 0 at the root, 1 at the tip.

    Returns:
        (setup, posture) to the fraction t, for every pair that is read.
    """
    robot = session.robot
    nominal = drive_table(session) + session.active_offsets
    passive = nominal_assembly(robot).close(nominal, names=list(session.postures))
    drives_in = ca.SX.sym("drives", len(robot.drives))
    passive_in = ca.SX.sym("passive", robot.passive_index.size)
    machine = SymbolicRobot(robot, drives=drives_in, passive=passive_in)
    ends = []
    for leg in robot.legs.values():
        for frame in (leg.root, leg.tip):
            ends.append(ca.dot(ca.SX(np.array(leg.axis)), machine.frame_pose(frame).position))
    function = BatchFunction(ca.Function("ends", [drives_in, passive_in], [ca.vertcat(*ends)]))
    (along,) = function(nominal, passive)
    postures = {name: i for i, name in enumerate(session.postures)}
    legs = {name: i for i, name in enumerate(robot.legs)}
    read: dict[str, set[str]] = {name: set() for name in session.setups}
    for reading in session.readings:
        read[reading.setup].update(p for p in (reading.posture, reading.minus) if p is not None)
    result = {}
    for setup in session.setups.values():
        plane, from_root = section_plane(robot, setup)
        leg = robot.legs[setup.leg]
        if from_root:
            plane += float(leg.axis @ leg.zero_root)
        for name in sorted(read[setup.name], key=postures.__getitem__):
            root, tip = along[postures[name], 2 * legs[leg.name] :][:2]
            result[setup.name, name] = float((plane - root) / (tip - root))
    return result
