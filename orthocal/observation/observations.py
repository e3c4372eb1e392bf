"""Entries of a session: single readings with gauge zeros, and their conditions."""

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
from orthocal.observation.conditions import COLUMNS_OF_CONDITIONS
from orthocal.observation.gauge_noise import assumed_sigma
from orthocal.robot.model import Robot
from orthocal.session.differences import Node, connect, find_leader
from orthocal.session.points import count_readings
from orthocal.session.session import Conditions, Reading, Session
from orthocal.text import spans

READING_INTERVAL = 60.0
"""Assumed time between successive readings of a setup without times, [s]."""

NEGLIGIBLE_CHANGE = 0.5
"""Largest change of repeated readings by their conditions, in standard deviations of a reading. It
increases their variance by at most a sixteenth, and their scatter by 3 %."""


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """Loop closures of a session.

    A posture is one state. If its readings differ in a condition on which drives or placements
    depend, it is one state for each value.
    """

    posture: Indices
    """Index of the posture of each state, ascending, shape (n_states,)."""
    commands: Array
    """Commands, shape (n_states, n_command); see `orthocal.kinematics.error_map`."""
    variant: Indices
    """Index of the conditions of placements in each state, shape (n_states,)."""
    variant_commands: Array
    """Commands with each of these conditions, shape (n_variants, n_command)."""
    names: tuple[str, ...]
    """Name of the posture of each state, with a number if the posture has several states, such as
    "p1 #2"."""

    @property
    def first_of_posture(self) -> Indices:
        """First state of each posture, shape (n_postures,)."""
        return np.unique(self.posture, return_index=True)[1]


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Entries: single readings of a session.

    The difference of two readings has two entries, a reading of a pair of postures has one.

    Differences of one setup and cycle that share postures are equivalent to single readings with a
    common free zero. Its elimination gives their covariance, such as σ² [[2, 1], [1, 2]] for two
    differences from one posture. Every entry is therefore a reading with standard deviation σ.
    """

    setup: Indices
    """Index of the setup of each entry, shape (n,)."""
    posture: Indices
    """Index of the posture of each entry, shape (n,)."""
    zero: Indices
    """Index of the zero of each entry, shape (n,)."""
    n_zeros: int
    """Number of zeros."""
    zero_setup: tuple[str, ...]
    """Setup of each zero."""
    zero_real: tuple[bool, ...]
    """True for the zero of a gauge, False for the common zero of differences."""
    zero_known: Mask
    """Mask of the zeros that are known to be 0, shape (n_zeros,)."""
    plus: Indices
    """Index of the entry of each row of the session, shape (n_rows,)."""
    minus: Indices
    """Index of the entry that a row subtracts, or -1, shape (n_rows,)."""
    state: Indices
    """Index of the loop closure of each entry, shape (n,)."""
    second: Indices
    """Index of the loop closure in the second posture of a pair, or -1, shape (n,)."""
    place: Indices
    """Index of the place of each entry, shape (n,): equal for repeated readings. They have the same
    setup, posture and approach. If the model depends on temperature or time, the differences of
    these change a reading by at most NEGLIGIBLE_CHANGE."""
    conditions: Mapping[Condition, Array]
    """Values of each condition, shape (n, size); neutral where not stated."""
    states: States
    """Loop closures of the entries."""

    @property
    def row_places(self) -> list[tuple[int, int]]:
        """Places of the entry of each row and of the one it subtracts, or -1, shape (n_rows,)."""
        subtracted = np.where(self.minus >= 0, self.place[self.minus], -1)
        return list(zip(self.place[self.plus].tolist(), subtracted.tolist(), strict=True))

    @property
    def n_free_zeros(self) -> int:
        """Number of zeros that are estimated."""
        return self.n_zeros - int(self.zero_known.sum())

    @property
    def size(self) -> int:
        """Number of entries."""
        return self.setup.size

    def free_zeros_of(self, chosen: Mask) -> int:
        """Number of estimated zeros of masked entries."""
        return int((~self.zero_known[np.unique(self.zero[chosen])]).sum())

    def only(self, chosen: Mask) -> Observations:
        """Masked entries, without the rows of the session."""
        of_entries = ("setup", "posture", "zero", "state", "second", "place")
        return replace(
            self,
            **{name: getattr(self, name)[chosen] for name in of_entries},
            conditions={c: v[chosen] for c, v in self.conditions.items()},
            plus=np.empty(0, dtype=np.int64),
            minus=np.empty(0, dtype=np.int64),
        )

    def sum_by_zero(self, values: Array, weights: Array) -> Array:
        """Weighted sums of the values of all entries with the same zero.

        Args:
            values: Values of the entries, shape (n, m).
            weights: Weights of the entries, shape (n,).

        Returns:
            Shape (n_zeros, m).
        """
        order = np.argsort(self.zero, kind="stable")
        starts = np.searchsorted(self.zero[order], np.arange(self.n_zeros))
        result = np.zeros((self.n_zeros, values.shape[1]))
        used = np.append(starts[1:], self.size) > starts
        weighted = (values * weights[:, None])[order]
        if weighted.size:
            result[used] = np.add.reduceat(weighted, starts[used], axis=0)
        return result

    def rows(self, entries: Array) -> Array:
        """Rows of the session, shape (n_rows, ...), from values of the entries, shape (n, ...)."""
        is_difference = (self.minus >= 0).reshape(-1, *(1,) * (entries.ndim - 1))
        subtracted = np.where(is_difference, entries[self.minus], 0.0)  # not used where minus is -1
        return np.asarray(entries[self.plus] - subtracted)

    def values(self, rows: Array) -> Array:
        """Values of the entries, shape (n,), from rows of the session, shape (n_rows,), [m].

        One entry of each group of differences has the value 0.
        """
        result = np.zeros(self.size)
        pending = np.flatnonzero(self.minus >= 0)
        result[self.plus] = np.where(self.minus < 0, rows, 0.0)
        _, first = np.unique(self.zero[self.plus[pending]], return_index=True)
        done = np.zeros(self.size, dtype=bool)
        done[self.minus[pending[first]]] = True
        while pending.size:  # rows of which one entry has its value
            forward, backward = done[self.plus[pending]], done[self.minus[pending]]
            for known, entries, others, sign in (
                (forward, self.minus, self.plus, -1.0),
                (backward, self.plus, self.minus, 1.0),
            ):
                solved = pending[known]
                result[entries[solved]] = result[others[solved]] + sign * rows[solved]
                done[entries[solved]] = True
            pending = pending[~(forward | backward)]
        return result


def build_observations(session: Session) -> Observations:
    """Split the readings of a session into single readings with gauge zeros.

    Raises:
        SessionError: If there are readings of pairs of postures, and effects by which the geometry
            differs between postures.
    """
    setups = {name: i for i, name in enumerate(session.setups)}
    postures = {name: i for i, name in enumerate(session.postures)}
    entries: list[tuple[int, int, int]] = []
    pairs: dict[int, int] = {}  # second postures by entry
    conditions: list[Conditions | None] = []
    # key of a gauge: its setup; key of a group of differences: setup, cycle, group
    zeros: dict[tuple[str] | Node, int] = {}
    nodes: dict[Node, int] = {}
    plus, minus = [], []
    leaders = _group_differences(session)

    def add(reading: Reading, posture: str, zero: tuple[str] | Node) -> int:
        number = zeros.setdefault(zero, len(zeros))
        entries.append((setups[reading.setup], postures[posture], number))
        conditions.append(reading.conditions if reading.minus is None else None)
        return len(entries) - 1

    def find_or_add(reading: Reading, posture: str) -> int:
        node = (reading.setup, reading.cycle, posture)
        if node not in nodes:
            nodes[node] = add(reading, posture, find_leader(leaders, node))
        return nodes[node]

    for r in session.readings:
        if r.minus is not None and session.is_difference(r):
            plus.append(find_or_add(r, r.posture))
            minus.append(find_or_add(r, r.minus))
            continue
        plus.append(add(r, r.posture, (r.setup,)))
        minus.append(-1)
        if r.minus is not None:
            pairs[plus[-1]] = postures[r.minus]
    table = np.array(entries, dtype=np.int64).reshape(-1, 3)
    values, states, state, second = _observe(session, conditions, table, pairs)
    absolute = [len(k) == 1 and session.setups[k[0]].zero == "known" for k in zeros]
    return Observations(
        setup=table[:, 0],
        posture=table[:, 1],
        zero=table[:, 2],
        n_zeros=len(zeros),
        zero_setup=tuple(k[0] for k in zeros),
        zero_real=tuple(len(k) == 1 for k in zeros),
        zero_known=np.array(absolute, dtype=np.bool_),
        plus=np.array(plus, dtype=np.int64),
        minus=np.array(minus, dtype=np.int64),
        state=state,
        second=second,
        place=_find_places(session, np.column_stack([table[:, :2], second]), values),
        conditions=values,
        states=states,
    )


def _group_differences(session: Session) -> dict[Node, Node]:
    """Groups of differences that share postures, directly or by others (see `find_leader`)."""
    leaders: dict[Node, Node] = {}
    for r in session.readings:
        if r.minus is not None and session.is_difference(r):
            connect(leaders, (r.setup, r.cycle, r.posture), (r.setup, r.cycle, r.minus))
    return leaders


def _observe(
    session: Session,
    conditions: Sequence[Conditions | None],
    table: Indices,
    pairs: Mapping[int, int],
) -> tuple[dict[Condition, Array], States, Indices, Indices]:
    """Conditions of the entries, loop closures, and the index of the closure of each entry.

    Args:
        session: The session.
        conditions: Stated conditions of the entries.
        table: Indices of setup, posture and zero of the entries, shape (n, 3).
        pairs: Entries that are pairs of postures, mapped to their second posture.

    Returns:
        Conditions; loop closures; index of the closure of each entry, shape (n,); and of the
        closure in its second posture or -1, shape (n,).
    """
    n, paired = len(table), np.array(list(pairs), dtype=np.int64)
    second_table = table[paired]
    second_table[:, 1] = list(pairs.values())
    extended = np.vstack([table, second_table])
    values = _all_conditions(session, [*conditions, *[None] * paired.size], extended)
    trims = _find_trims(session, extended[:, 0], extended[:, 1], values["approach"])
    states, state = _find_states(session, extended[:, 1], values, trims)
    _require_common_placements(states, session, bool(pairs))
    second = np.full(n, -1)
    second[paired] = state[n:]
    return {c: v[:n] for c, v in values.items()}, states, state[:n], second


def _require_common_placements(states: States, session: Session, pairs: bool) -> None:
    """Refuse readings of pairs of postures on a machine whose placements differ between states.

    Raises:
        SessionError: If there are such pairs; names the session.
    """
    if pairs and len(states.variant_commands) > 1:
        raise SessionError(
            "has readings of pairs of postures, and effects that change the geometry between "
            "postures; calibrate without these effects (--effects)",
            where=str(session.path or "session"),
        )


def _all_conditions(
    session: Session, stated: Sequence[Conditions | None], table: Indices
) -> dict[Condition, Array]:
    """Values of the conditions of entries, stated and computed, shape (n, size) each.

    Args:
        session: The session.
        stated: Stated conditions of the entries.
        table: Indices of setup, posture and zero of the entries, shape (n, 3).
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
    """Values of the stated conditions of entries, else neutral, shape (n, size) each."""
    n = len(conditions)
    neutral = neutral_values(robot)
    values = {c: np.full((n, condition_size(robot, c)), v) for c, v in neutral.items()}
    first_times: dict[int, datetime] = {}
    for i, stated in enumerate(conditions):
        if stated is None:
            continue
        if stated.approach is not None:
            values["approach"][i] = [APPROACH[letter] for letter in stated.approach]
        if stated.temperature is not None:
            values["temperature"][i] = stated.temperature
        if stated.time is not None:
            first = first_times.setdefault(int(setup[i]), stated.time)
            values["time"][i] = (stated.time - first).total_seconds()
    for k in set(setup.tolist()) - first_times.keys():
        rows = np.flatnonzero(setup == k)
        values["time"][rows, 0] = READING_INTERVAL * np.arange(rows.size)
    return values


def _find_places(session: Session, postures: Indices, values: Mapping[Condition, Array]) -> Indices:
    """Index of the place of each entry, shape (n,); see `Observations.place`.

    Args:
        session: The session.
        postures: Indices of setup, posture and second posture of the entries, shape (n, 3).
        values: Conditions of the entries.
    """
    setups = session.setups.values()
    noise = np.array([assumed_sigma(session.gauges[s.gauge]) for s in setups])
    rows = np.hstack([postures, values["approach"]])
    place = np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)
    for condition in ("temperature", "time"):
        for effect in robot_effects(session.robot):
            if condition in effect.conditions:
                changes = NEGLIGIBLE_CHANGE * noise
                tolerance = np.array([effect.negligible_difference(condition, c) for c in changes])
                place = _split_places(place, values[condition][:, 0], tolerance[postures[:, 0]])
    return place


def _split_places(place: Indices, value: Array, tolerance: Array) -> Indices:
    """Places, each within a tolerance of its smallest value of a condition, shape (n,).

    Args:
        place: Index of the place of each entry, shape (n,).
        value: Condition of each entry, shape (n,).
        tolerance: Largest difference in the place of each entry, shape (n,).
    """
    first, number, result = -1, -1, np.empty_like(place)
    for i in np.lexsort((value, place)):
        if first < 0 or place[i] != place[first] or value[i] > value[first] + tolerance[i]:
            first, number = i, number + 1
        result[i] = number
    return result


def _find_loads(session: Session, setup: Indices, posture: Indices) -> Array:
    """Axial forces of the rods at entries, shape (n, n_rods), [N]."""
    payload = np.array([s.payload for s in session.setups.values()])[setup]
    pairs = np.column_stack([posture, payload])
    unique, row = np.unique(pairs, axis=0, return_inverse=True)
    drives = drive_table(session)[unique[:, 0].astype(np.int64)]
    return find_loads(session.robot, drives, unique[:, 1])[row.reshape(-1)]


def adjustment_table(session: Session) -> Array:
    """Mechanical adjustments of the setups minus those of the session, [m].

    Shape (n_setups, n_adjustments).
    """
    names, last = list(session.robot.declared.adjustments), session.adjusted
    result = np.zeros((len(session.setups), len(names)))
    for row, setup in zip(result, session.setups.values(), strict=True):
        amounts = last if setup.adjusted is None else setup.adjusted
        for name, change in subtract_amounts(amounts, last).items():
            row[names.index(name)] = change
    return result


def _find_trims(session: Session, setup: Indices, posture: Indices, approach: Array) -> Array:
    """Displacements of the drives by compensations of the controller, (n, n_drives), [m, rad].

    Args:
        session: The session.
        setup: Index of the setup of each entry, shape (n,).
        posture: Index of the posture of each entry, shape (n,).
        approach: Approach of each entry, shape (n, n_drives).
    """
    result, drives = np.zeros(approach.shape), drive_table(session)
    active = session.robot.drive_zero - session.zero_drives
    for i, s in enumerate(session.setups.values()):
        trims = session.compensation if s.compensation is None else s.compensation
        rows = np.flatnonzero(setup == i)
        if trims and rows.size:
            displayed = drives[posture[rows]] + active[i]
            result[rows] = displace_drives(session.robot, trims, displayed, approach[rows])
    return result


def _find_states(
    session: Session, posture: Indices, conditions: Mapping[Condition, Array], trims: Array
) -> tuple[States, Indices]:
    """Loop closures of a session, and the index of the closure of each entry, shape (n,).

    Args:
        session: The session.
        posture: Index of the posture of each entry, shape (n,).
        conditions: Conditions of the entries.
        trims: Displacements of the drives by compensations of the controller, shape (n, n_drives),
            [m, rad].
    """
    map_, drives, names = error_map(session.robot), drive_table(session), list(session.postures)
    postures, n_drives = np.arange(len(names)), drives.shape[1]
    if not map_.conditions and not trims.any():
        neutral = map_.command(session.robot.drive_zero)[None]
        return States(postures, drives, np.zeros_like(postures), neutral, tuple(names)), posture
    # rows of posture, displacement and conditions: of all entries, then of postures without entries
    read = np.hstack([posture[:, None], trims, *(conditions[c] for c in map_.conditions)])
    unread = np.setdiff1d(postures, posture)
    payload = max(s.payload for s in session.setups.values())
    loaded = LoopClosure(session.robot, conditions=UseConditions(payload=payload))
    neutral = loaded.commands(drives[unread])[:, n_drives:]
    others = np.column_stack([unread, np.zeros_like(drives[unread]), neutral])
    rows, state = np.unique(np.vstack([read, others]), axis=0, return_inverse=True)
    posture_of = rows[:, 0].astype(np.int64)
    displaced = drives[posture_of] + rows[:, 1 : 1 + n_drives]
    commands = map_.with_coordinates(np.hstack([displaced, rows[:, 1 + n_drives :]]))
    first, variant = np.zeros(1, dtype=np.int64), np.zeros(len(rows), dtype=np.int64)
    if map_.of_placements.any():
        values = commands[:, map_.of_placements]
        _, first, variant = np.unique(values, axis=0, return_index=True, return_inverse=True)
    number = np.arange(len(rows)) - np.searchsorted(posture_of, posture_of)
    is_numbered = np.bincount(posture_of)[posture_of] > 1
    labels = tuple(
        f"{names[k]} #{i + 1}" if numbered else names[k]
        for k, i, numbered in zip(posture_of, number, is_numbered, strict=True)
    )
    states = States(posture_of, commands, variant.reshape(-1), commands[first], labels)
    return states, state.reshape(-1)[: posture.size]


def drive_table(session: Session) -> Array:
    """Commanded drive coordinates of all postures, shape (n_postures, n_drives), [m, rad]."""
    return np.array([p.drives for p in session.postures.values()])


def require_conditions(session: Session, free: Collection[str]) -> None:
    """Refuse readings without a condition that the effect of a free parameter needs.

    If no reading states a condition, an effect that was not chosen explicitly is accepted: its
    errors then keep their tolerances.

    Args:
        session: The session.
        free: Names of the free parameters of the machine.

    Raises:
        SessionError: If a condition is missing; names its column and the lines without it.
    """
    parameters = session.robot.parameters
    errors = {term for name in free for term, _ in parameters[name].terms}
    explicit = session.robot.chosen_effects is not None
    for effect in robot_effects(session.robot):
        if not effect.setup_errors and errors.isdisjoint(e.name for e in effect.errors):
            continue
        for condition in effect.conditions:
            missing = readings_without(session, condition)
            if not missing or (len(missing) == len(session.readings) and not explicit):
                continue
            problem = _missing_condition(session, condition, missing)
            count, total = count_readings(session, missing), count_readings(session)
            raise SessionError(
                f"{problem}. The effect '{effect.name}' needs the {condition} of each reading, "
                f"which {count} of {total} readings do not state",
                where=session.where(missing[0]),
            )


def _missing_condition(session: Session, condition: Condition, missing: Sequence[Reading]) -> str:
    """Beginning of a message: column and lines in which a condition is missing."""
    if missing[0].minus:
        return "belongs to two postures, so that it states no condition"
    first = missing[0].file or session.readings_path
    lines = [r.line for r in missing if (r.file or session.readings_path) == first]
    numbers = sorted({line for line in lines if line is not None})
    where = f" in {spans(numbers, 'line')}" if numbers else ""
    empty = "missing or empty" if len(missing) == len(session.readings) else "incomplete"
    return f"the column `{COLUMNS_OF_CONDITIONS[condition]}` is {empty}{where}"


def readings_without(session: Session, condition: Condition) -> list[Reading]:
    """Readings that do not state a condition.

    A setup in which no reading states a time needs none: READING_INTERVAL is assumed between
    successive rows.
    """
    if condition not in COLUMNS_OF_CONDITIONS:  # the session states it, or it is computed
        return []
    if condition == "approach":
        return [r for r in session.readings if r.approach is None or "u" in r.approach]
    missing = [r for r in session.readings if getattr(r.conditions, condition, None) is None]
    if condition == "time":
        timed = {r.setup for r in session.readings if r.conditions and r.conditions.time}
        return [r for r in missing if r.minus or r.setup in timed]
    return missing
