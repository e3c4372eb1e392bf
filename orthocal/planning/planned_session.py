"""Session of planned setups, in the order of measuring."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import UnreachablePathError
from orthocal.measurement.motion.motion import state_path_approaches
from orthocal.planning.candidates import Candidates
from orthocal.planning.selection import PlannedSetup
from orthocal.planning.tool_candidates import PLACE
from orthocal.printers.settings import DeltaSettings
from orthocal.sensors.protocol import tool_path
from orthocal.session.points import base_name, names_in_files
from orthocal.session.session import Posture, Reading, Session, Setup


def build_session(
    candidates: Candidates, planned: Sequence[PlannedSetup], measured: Session | None = None
) -> Session:
    """Session of named setups and readings in the order of measuring.

    Each setup begins with the posture in which its gauge is aligned, continues with short motions,
    and ends with the first posture. If an effect depends on the approach, postures in which a drive
    reverses on the path of the tool are omitted, because their approach is unknown. So are postures
    to which a prescribed path, such as that of a ball bar, leaves the workspace.

    Raises:
        UnreachablePathError: If too few postures of a setup remain.
    """
    while True:
        plan: Session | UnreachablePathError
        try:
            plan = _order_readings(candidates, planned, measured)
            unusable = {
                (base_name(r.setup), r.posture)
                for r in plan.readings
                if tool_path(plan.setups[r.setup].sensor) is not None and "u" in (r.approach or "")
            }
        except UnreachablePathError as e:
            plan, unusable = e, {(base_name(e.setup), e.posture)}
        reduced = [
            _without(candidates, setup, {p for s, p in unusable if s == name})
            for name, setup in _named(candidates, planned, measured)
        ]
        if sum(len(s.chosen) for s in reduced) == sum(len(s.chosen) for s in planned):
            if isinstance(plan, UnreachablePathError):
                raise plan
            return plan
        planned = reduced


def _without(candidates: Candidates, setup: PlannedSetup, postures: set[str]) -> PlannedSetup:
    """Setup without some postures; unchanged if too few readings would remain."""
    source, candidate = candidates.session, candidates.setups[setup.candidate]
    of_row = [source.readings[i].posture for i in candidate.rows]
    chosen = tuple(i for i in setup.chosen if of_row[i] not in postures)
    return setup if len(chosen) < candidate.min_readings else replace(setup, chosen=chosen)


def _in_order(candidates: Candidates, planned: Sequence[PlannedSetup]) -> list[PlannedSetup]:
    """Setups in the order of measuring: at the legs, then with sensors at the tool."""
    source = candidates.session
    legs = list(source.robot.legs)

    def place(setup: PlannedSetup) -> tuple[int, str]:
        name = candidates.setups[setup.candidate].name
        leg = source.setups[name].sensor.place[1]
        return (legs.index(leg) if leg in legs else len(legs), name)

    return sorted(planned, key=place)


def _named(
    candidates: Candidates, planned: Sequence[PlannedSetup], measured: Session | None
) -> list[tuple[str, PlannedSetup]]:
    """Planned setups with their names, in the order of measuring."""
    source, named = candidates.session, []
    used_names = set() if measured is None else {base_name(name) for name in measured.setups}
    for setup in _in_order(candidates, planned):
        base, _ = names_in_files(source.setups[candidates.setups[setup.candidate].name])
        name = _setup_name(base, used_names)
        used_names.add(name)
        named.append((name, setup))
    return named


def _order_readings(
    candidates: Candidates, planned: Sequence[PlannedSetup], measured: Session | None
) -> Session:
    """Session of planned setups with the approaches that follow from their paths."""
    source = candidates.session
    setups: dict[str, Setup] = {}
    readings: list[Reading] = []
    postures: dict[str, Posture] = {}
    for name, setup in _named(candidates, planned, measured):
        candidate = candidates.setups[setup.candidate]
        base, _ = names_in_files(source.setups[candidate.name])
        lines = [source.readings[i : i + candidate.width] for i in candidate.rows[[*setup.chosen]]]
        first = lines[0][0].posture
        for r in lines[0]:
            new = name + r.setup.removeprefix(base)
            setups[new] = replace(source.setups[r.setup], name=new, aligned_at=first)
        points = np.array([source.postures[r.posture].values for r, *_ in lines])
        cycles: Counter[tuple[str | None, ...]] = Counter()
        for row in (r for i in (*order_postures(points), 0) for r in lines[i]):
            cycles[row.place] += 1
            new = name + row.setup.removeprefix(base)
            readings.append(replace(row, setup=new, cycle=cycles[row.place]))
        postures.update((r.posture, source.postures[r.posture]) for r, *_ in lines)
    gauges = {n for s in setups.values() for n in (s.gauge, names_in_files(s)[1])}
    plan = replace(
        source,
        title="Planned readings",
        setups=setups,
        readings=tuple(readings),
        gauges={n: g for n, g in source.gauges.items() if n in gauges},
        postures={n: p for n, p in source.postures.items() if n in postures},
    )
    if measured is None:
        return state_path_approaches(plan)
    plan = replace(
        plan,
        compensation=measured.compensation,
        controller_origin=measured.controller_origin,
        firmware=measured.firmware,
        postures=_commanded(plan.postures, measured.firmware),
        adjusted=measured.adjusted,
    )
    if measured.controller_offsets is not None:
        plan = plan.with_controller(measured.controller_offsets)
    return state_path_approaches(plan)


def _commanded(
    postures: Mapping[str, Posture], firmware: DeltaSettings | None
) -> Mapping[str, Posture]:
    """Postures with the drive coordinates to which a printer's firmware moves its carriages."""
    if firmware is None:
        return postures
    drives = firmware.inverse([p.values for p in postures.values()])
    return {n: Posture(n, "joints", d, d) for n, d in zip(postures, drives, strict=True)}


def order_postures(points: Array) -> list[int]:
    """Order of points on a short closed path that begins with the first one.

    Each point is followed by the nearest one. Then parts are reversed while this shortens the path
    (2-opt).

    Args:
        points: Tool positions, shape (n, n_coordinates), [m].
    """
    distance = np.linalg.norm(points[:, None] - points[None], axis=2).round(9)  # [nm]

    def length(order: list[int]) -> float:
        return float(sum(distance[a, b] for a, b in pairwise([*order, order[0]])))

    order, unvisited = [0], set(range(1, len(points)))
    while unvisited:
        nearest = min(unvisited, key=lambda i: (distance[order[-1], i], i))
        order.append(nearest)
        unvisited.remove(nearest)
    shorter = True
    while shorter:
        shorter = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                other = order[:i] + order[i : j + 1][::-1] + order[j + 1 :]
                if length(other) < length(order) - 1e-12:
                    order, shorter = other, True
    return order


def _setup_name(candidate: str, used_names: set[str]) -> str:
    """Name of a setup without its place, with a number where there are several."""
    short = candidate.rpartition(PLACE)[0] or candidate
    if short not in used_names:
        return short
    return next(
        f"{short}_{i}" for i in range(2, len(used_names) + 3) if f"{short}_{i}" not in used_names
    )
