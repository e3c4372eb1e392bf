"""Entries of a session: its readings as single ones with gauge zeros, and their conditions."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from orthocal.arrays import Array, Indices, Mask
from orthocal.effects.adjustment import subtract_amounts
from orthocal.effects.compensation import displace_drives
from orthocal.effects.loading import neutral_values, robot_effects
from orthocal.effects.protocol import Condition, condition_size
from orthocal.errors import SessionError
from orthocal.kinematics.conditions import APPROACH, UseConditions
from orthocal.kinematics.error_map import error_map
from orthocal.kinematics.loop_closure import LoopClosure, find_loads
from orthocal.robot.model import Robot
from orthocal.session.session import Conditions, Reading, Session

TIME_OF_READING = 60.0
"""Time between successive readings of a setup that states none, [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """Loop closures of a session.

    A posture is one state, unless its readings differ in a condition on which drives or placements
    depend: then it is one state for each value.
    """

    posture: Indices
    """Posture of each state, in the order of the postures, shape (n_states,)."""
    commands: Array
    """Commands, shape (n_states, n_command); see `orthocal.kinematics.error_map`."""
    variant: Indices
    """Index of the conditions of its placements among all such conditions, shape (n_states,)."""
    variant_commands: Array
    """A command with the conditions of each variant, shape (n_variants, n_command)."""
    names: tuple[str, ...]
    """Posture of each state, with a number where it has several states."""

    @property
    def first_of_posture(self) -> Indices:
        """First state of each posture, shape (n_postures,)."""
        return np.unique(self.posture, return_index=True)[1]


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Readings as the gauge showed them, one an entry; differences are split.

    A reading of a pair of postures is one entry.

    Differences of one setup and cycle that share postures are equivalent to readings with one free
    zero: eliminating it gives their covariance, σ² [[2, 1], [1, 2]] for two differences from one
    posture. So every entry is a single reading with standard deviation σ.
    """

    setup: Indices
    """Index of the setup, shape (n,)."""
    posture: Indices
    """Index of the posture, shape (n,)."""
    zero: Indices
    """Index of the gauge zero, shape (n,)."""
    n_zeros: int
    zero_setup: tuple[str, ...]
    """Setup of each zero."""
    zero_real: tuple[bool, ...]
    """True for the zero of a gauge, False for one that replaces differences."""
    zero_known: Mask
    """Mask of the zeros that are known to be 0, shape (n_zeros,)."""
    plus: Indices
    """Entry of each row of the session, shape (n_rows,)."""
    minus: Indices
    """Entry to subtract, or -1, shape (n_rows,)."""
    state: Indices
    """Index of the loop closure, shape (n,)."""
    second: Indices
    """Index of the loop closure in the second posture of a pair, or -1, shape (n,)."""
    place: Indices
    """Index of setup, posture and approach: entries with the same place repeat each other, (n,)."""
    conditions: Mapping[Condition, Array]
    """Condition to its values, shape (n, size); neutral where not stated."""
    states: States

    @property
    def n_free_zeros(self) -> int:
        """Number of zeros that are estimated."""
        return self.n_zeros - int(self.zero_known.sum())

    @property
    def size(self) -> int:
        """Number of entries."""
        return self.setup.size

    def only(self, chosen: Mask) -> Observations:
        """Some of the entries, without rows."""
        none = np.empty(0, dtype=np.int64)
        return replace(
            self,
            setup=self.setup[chosen],
            posture=self.posture[chosen],
            state=self.state[chosen],
            second=self.second[chosen],
            place=self.place[chosen],
            conditions={c: v[chosen] for c, v in self.conditions.items()},
            zero=self.zero[chosen],
            plus=none,
            minus=none,
        )

    def sum_by_zero(self, values: Array, weights: Array) -> Array:
        """Weighted sums of the values with the same zero, shape (n_zeros, m) of (n, m)."""
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
        subtracted = np.where(
            (self.minus >= 0).reshape(-1, *(1,) * (entries.ndim - 1)), entries[self.minus], 0.0
        )
        return np.asarray(entries[self.plus] - subtracted)

    def values(self, rows: Array) -> Array:
        """Values of the entries from rows of the session, shape (n,) of (n_rows,), [m].

        Where rows are differences, the first posture of each group is given the value 0.
        """
        result = np.zeros(self.size)
        done = np.zeros(self.size, dtype=bool)
        raw = self.minus < 0
        result[self.plus[raw]] = rows[raw]
        done[self.plus[raw]] = True
        pending = list(np.flatnonzero(~raw))
        while pending:
            postponed = []
            for row in pending:
                p, m = self.plus[row], self.minus[row]
                if done[p]:
                    result[m] = result[p] - rows[row]
                elif done[m]:
                    result[p] = result[m] + rows[row]
                else:
                    postponed.append(row)
                    continue
                done[p] = done[m] = True
            if len(postponed) == len(pending):  # start a new group
                done[self.minus[postponed[0]]] = True
            pending = postponed
        return result


def build_observations(session: Session) -> Observations:
    """Split a session's readings into single ones with gauge zeros."""
    setups = {name: i for i, name in enumerate(session.setups)}
    postures = {name: i for i, name in enumerate(session.postures)}
    entries: list[tuple[int, int, int]] = []
    pairs: dict[int, int] = {}  # entry to its second posture
    conditions: list[Conditions | None] = []
    # of a gauge by its setup, of a group of differences by setup, cycle and group
    zeros: dict[tuple[str] | tuple[str, int, str], int] = {}
    nodes: dict[tuple[str, int, str], int] = {}
    plus, minus = [], []
    groups = _difference_groups(session)

    def add(reading: Reading, posture: str, zero: tuple[str] | tuple[str, int, str]) -> int:
        number = zeros.setdefault(zero, len(zeros))
        entries.append((setups[reading.setup], postures[posture], number))
        conditions.append(reading.conditions if reading.minus is None else None)
        return len(entries) - 1

    def find(reading: Reading, posture: str) -> int:
        node = (reading.setup, reading.cycle, posture)
        if node not in nodes:
            nodes[node] = add(reading, posture, (reading.setup, reading.cycle, groups[node]))
        return nodes[node]

    for r in session.readings:
        if r.minus is None:
            plus.append(add(r, r.posture, (r.setup,)))
            minus.append(-1)
        elif not session.is_difference(r):
            plus.append(add(r, r.posture, (r.setup,)))
            pairs[plus[-1]] = postures[r.minus]
            minus.append(-1)
        else:
            plus.append(find(r, r.posture))
            minus.append(find(r, r.minus))
    table = np.array(entries, dtype=np.int64).reshape(-1, 3)
    values, states, state, second = _observe(session, conditions, table, pairs)
    places = np.hstack([table[:, :2], values["approach"], second[:, None]])
    zero_setup, zero_real = tuple(k[0] for k in zeros), tuple(len(k) == 1 for k in zeros)
    absolute = [len(k) == 1 and session.setups[k[0]].zero == "known" for k in zeros]
    return Observations(
        setup=table[:, 0],
        posture=table[:, 1],
        zero=table[:, 2],
        n_zeros=len(zeros),
        zero_setup=zero_setup,
        zero_real=zero_real,
        zero_known=np.array(absolute, dtype=np.bool_),
        plus=np.array(plus, dtype=np.int64),
        minus=np.array(minus, dtype=np.int64),
        state=state,
        second=second,
        place=np.unique(places, axis=0, return_inverse=True)[1].reshape(-1),
        conditions=values,
        states=states,
    )


def _observe(
    session: Session,
    conditions: Sequence[Conditions | None],
    table: Indices,
    pairs: Mapping[int, int],
) -> tuple[dict[Condition, Array], States, Indices, Indices]:
    """Conditions of entries, loop closures, and the closures of each entry.

    Args:
        session: The session.
        conditions: Conditions of the entries as stated.
        table: Setup, posture and zero of the entries, shape (n, 3).
        pairs: Entry of a pair of postures to its second posture.

    Returns:
        Conditions; the loop closures; that of each entry, shape (n,); that of its second posture.
    """
    n, paired = len(table), np.array(list(pairs), dtype=np.int64)
    of_second = table[paired]
    of_second[:, 1] = list(pairs.values())
    both = np.vstack([table, of_second])
    values = _all_conditions(session, [*conditions, *[None] * paired.size], both)
    trims = _find_trims(session, both[:, 0], both[:, 1], values["approach"])
    states, state = _find_states(session, both[:, 1], values, trims)
    _require_common_placements(states, session, bool(pairs))
    second = np.full(n, -1)
    second[paired] = state[n:]
    return {c: v[:n] for c, v in values.items()}, states, state[:n], second


def _require_common_placements(states: States, session: Session, pairs: bool) -> None:
    """Refuse pairs of postures on a machine whose placements differ between its postures.

    Raises:
        SessionError: Naming the session.
    """
    if pairs and len(states.variant_commands) > 1:
        raise SessionError(
            "has readings of pairs of postures, and effects that change the geometry between "
            "postures; calibrate without these effects (--effects)",
            where=str(session.path or "session"),
        )


def _difference_groups(session: Session) -> dict[tuple[str, int, str], str]:
    """Posture of a setup and cycle to a name of its group of differences."""
    leader: dict[tuple[str, int, str], tuple[str, int, str]] = {}

    def find(node: tuple[str, int, str]) -> tuple[str, int, str]:
        while (above := leader.setdefault(node, node)) != node:
            leader[node] = leader.setdefault(above, above)  # half the way next time
            node = above
        return node

    for r in session.readings:
        if r.minus is not None and session.is_difference(r):
            leader[find((r.setup, r.cycle, r.posture))] = find((r.setup, r.cycle, r.minus))
    return {node: find(node)[2] for node in list(leader)}


def _all_conditions(
    session: Session, stated: Sequence[Conditions | None], table: Indices
) -> dict[Condition, Array]:
    """Values of the conditions of entries, stated and computed, shape (n, size) each.

    Args:
        session: The session.
        stated: Conditions of the entries as stated.
        table: Setup, posture and zero of the entries, shape (n, 3).
    """
    values = _condition_values(session.robot, stated, table[:, 0])
    if "load" in error_map(session.robot).conditions:
        values["load"] = _find_loads(session, table[:, 0], table[:, 1])
    values["adjustment"] = adjustment_table(session)[table[:, 0]]
    values["coordinates"] = drive_table(session)[table[:, 1]]
    values["reference"] = session.zero_drives[table[:, 0]]
    return values


def _condition_values(
    robot: Robot, conditions: Sequence[Conditions | None], setup: Indices
) -> dict[Condition, Array]:
    """Values of the conditions of entries, neutral where not stated, shape (n, size) each."""
    n = len(conditions)
    neutral = neutral_values(robot)
    values = {c: np.full((n, condition_size(robot, c)), v) for c, v in neutral.items()}
    began: dict[int, datetime] = {}
    for i, stated in enumerate(conditions):
        if stated is None:
            continue
        if stated.approach is not None:
            values["approach"][i] = [APPROACH[letter] for letter in stated.approach]
        if stated.temperature is not None:
            values["temperature"][i] = stated.temperature
        if stated.time is not None:
            first = began.setdefault(int(setup[i]), stated.time)
            values["time"][i] = (stated.time - first).total_seconds()
    for k in set(setup.tolist()) - began.keys():
        rows = np.flatnonzero(setup == k)
        values["time"][rows, 0] = TIME_OF_READING * np.arange(rows.size)
    return values


def _find_loads(session: Session, setup: Indices, posture: Indices) -> Array:
    """Axial forces of the rods at entries, shape (n, n_rods), [N]."""
    payload = np.array([s.payload for s in session.setups.values()])[setup]
    pairs = np.column_stack([posture, payload])
    unique, place = np.unique(pairs, axis=0, return_inverse=True)
    drives = drive_table(session)[unique[:, 0].astype(np.int64)]
    return find_loads(session.robot, drives, unique[:, 1])[place.reshape(-1)]


def adjustment_table(session: Session) -> Array:
    """Adjustments of the setups less those of the session, shape (n_setups, n_adjustments), [m]."""
    names, last = list(session.robot.declared.adjustments), session.adjusted
    result = np.zeros((len(session.setups), len(names)))
    for row, setup in zip(result, session.setups.values(), strict=True):
        amounts = last if setup.adjusted is None else setup.adjusted
        for name, change in subtract_amounts(amounts, last).items():
            row[names.index(name)] = change
    return result


def _find_trims(session: Session, setup: Indices, posture: Indices, approach: Array) -> Array:
    """Displacement of the drives by the controller at entries, shape (n, n_drives), [m, rad]."""
    result, drives = np.zeros(approach.shape), drive_table(session)
    active = session.robot.drive_zero - session.zero_drives
    for i, of_setup in enumerate(session.setups.values()):
        stated = of_setup.compensation
        trims = session.compensation if stated is None else stated
        rows = np.flatnonzero(setup == i)
        if trims and rows.size:
            displayed = drives[posture[rows]] + active[i]
            result[rows] = displace_drives(session.robot, trims, displayed, approach[rows])
    return result


def _find_states(
    session: Session, posture: Indices, conditions: Mapping[Condition, Array], trims: Array
) -> tuple[States, Indices]:
    """Loop closures of a session, and the one of each entry.

    Args:
        session: The session.
        posture: Posture of each entry, shape (n,).
        conditions: Conditions of the entries.
        trims: Displacement of the drives by the controller, shape (n, n_drives), [m, rad].
    """
    map_, drives, names = error_map(session.robot), drive_table(session), list(session.postures)
    count = np.arange(len(names))
    if not map_.conditions and not trims.any():
        one = map_.command(session.robot.drive_zero)[None]
        return States(count, drives, np.zeros_like(count), one, tuple(names)), posture
    read = np.hstack([posture[:, None], trims, *(conditions[c] for c in map_.conditions)])
    unread = np.setdiff1d(count, posture)
    payload = max(s.payload for s in session.setups.values())
    loaded = LoopClosure(session.robot, conditions=UseConditions(payload=payload))
    neutral = loaded.commands(drives[unread])[:, drives.shape[1] :]
    others = np.column_stack([unread, np.zeros_like(drives[unread]), neutral])
    rows, place = np.unique(np.vstack([read, others]), axis=0, return_inverse=True)
    of_state = rows[:, 0].astype(np.int64)
    moved = drives[of_state] + rows[:, 1 : 1 + drives.shape[1]]
    commands = np.hstack([moved, rows[:, 1 + drives.shape[1] :]])
    commands = map_.with_coordinates(commands)
    first, variant = np.zeros(1, dtype=np.int64), np.zeros(len(rows), dtype=np.int64)
    if map_.of_placements.any():
        values = commands[:, map_.of_placements]
        _, first, variant = np.unique(values, axis=0, return_index=True, return_inverse=True)
    number = np.arange(len(rows)) - np.searchsorted(of_state, of_state)
    several = np.bincount(of_state)[of_state] > 1
    labels = tuple(
        f"{names[k]} #{i + 1}" if more else names[k]
        for k, i, more in zip(of_state, number, several, strict=True)
    )
    states = States(of_state, commands, variant.reshape(-1), commands[first], labels)
    return states, place.reshape(-1)[: posture.size]


def drive_table(session: Session) -> Array:
    """Commanded drive coordinates of all postures, shape (n_postures, n_drives), [m, rad]."""
    return np.array([p.drives for p in session.postures.values()])


def require_conditions(session: Session, free: Collection[str]) -> None:
    """Refuse readings without a condition that the effect of a free parameter needs.

    An effect that only the robot's YAML names may find its conditions in no reading: its errors
    then keep their tolerances.

    Args:
        session: The session.
        free: Names of the free parameters of the machine.

    Raises:
        SessionError: Naming the first such reading.
    """
    parameters = session.robot.parameters
    errors = {term for name in free for term, _ in parameters[name].terms}
    chosen = session.robot.chosen_effects is not None
    for effect in robot_effects(session.robot):
        if not effect.setup_errors and errors.isdisjoint(e.name for e in effect.errors):
            continue
        for condition in effect.conditions:
            lacking = readings_without(session, condition)
            if not lacking or (len(lacking) == len(session.readings) and not chosen):
                continue
            first, among = lacking[0], f"{len(lacking)} of {len(session.readings)} readings"
            what = "is a difference" if first.minus else f"is a reading without {condition}"
            raise SessionError(
                f"{what}; the effect '{effect.name}' needs the {condition} of each reading, "
                f"which {among} do not state",
                where=session.where(first),
            )


def readings_without(session: Session, condition: Condition) -> list[Reading]:
    """Readings that do not state a condition.

    Where no reading of a setup states its time, its rows are in the order of time.
    """
    if condition in ("adjustment", "coordinates"):  # the session states it
        return []
    if condition == "approach":
        return [r for r in session.readings if r.approach is None or "u" in r.approach]
    lacking = [r for r in session.readings if getattr(r.conditions, condition, None) is None]
    if condition == "time":
        timed = {r.setup for r in session.readings if r.conditions and r.conditions.time}
        return [r for r in lacking if r.minus or r.setup in timed]
    return lacking
