"""What moved while readings were taken: a bumped stand, a drift, a dial that stuck."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from orthocal.hypotheses.edits import Edit, Family, Table

Indices = NDArray[np.int64]

FEWEST = 4
"""Readings of a setup below which a tail or a drift is not told from a single reading."""

FEWEST_STUCK = 3
"""Readings alike in a row below which a dial is not said to have stuck."""

MOST_STUCK = 16
"""Readings of a run that are used."""


def find_moved(table: Table) -> Iterator[Family]:
    """Stands that were bumped, and drifts; differences of postures show neither."""
    for family in (_bumped(table), _cycles_apart(table), _drift(table), _stuck(table)):
        if family.edits:
            yield family


def _bumped(table: Table) -> Family:
    edits: list[Callable[[], Edit]] = []
    tails = []
    for name, rows in table.setups.items():
        if not table.raw[rows].all():
            continue
        for k in range(2, rows.size - 1):
            tails.append(rows[k:])
            edits.append(
                partial(
                    Edit,
                    "bumped stand",
                    f"the stand of setup {name} was bumped before {table.label(int(rows[k]))}: all "
                    "its later readings are shifted",
                    "If so, read setup "
                    f"{name} again, or make a setup of its own of what was read after that.",
                    tuple(rows[k:].tolist()),
                )
            )
    return _additive(table, edits, tails)


def _cycles_apart(table: Table) -> Family:
    edits: list[Callable[[], Edit]] = []
    groups = []
    for (name, cycle), rows in table.cycles.items():
        own = table.setups[name]
        # of the first and the last cycle the stand was bumped between
        inner = rows[0] != own[0] and rows[-1] != own[-1]
        if inner and rows.size > 1 and table.raw[rows].all():
            groups.append(rows)
            edits.append(
                partial(
                    Edit,
                    "bumped stand",
                    f"the gauge of setup {name} was set anew for cycle {cycle}, or touched",
                    f"If so, read cycle {cycle} again, or leave it out.",
                    tuple(rows.tolist()),
                )
            )
    return _additive(table, edits, groups)


def _additive(table: Table, edits: list[Callable[[], Edit]], groups: list[Indices]) -> Family:
    wrong = np.zeros((len(groups), table.count))
    for h, rows in enumerate(groups):
        wrong[h, rows] = 1.0
    return Family(edits, np.zeros_like(wrong), max(len(edits), 1), wrong=wrong)


def _drift(table: Table) -> Family:
    edits: list[Callable[[], Edit]] = []
    ramps = []
    every, drifting = np.zeros(table.count), []
    for name, rows in table.setups.items():
        if rows.size < FEWEST or not table.raw[rows].all():
            continue
        ramp = np.zeros(table.count)
        ramp[rows] = np.linspace(0.0, 1.0, rows.size)
        every += ramp
        drifting.append(rows)
        ramps.append(ramp)
        edits.append(
            partial(
                Edit,
                "drift",
                f"the readings of setup {name} drifted from the first to the last",
                "Let the machine and the stand come to one temperature, return to the first "
                "posture at the end, and read it again.",
                tuple(rows.tolist()),
                (name,),
            )
        )
    if len(ramps) > 1:
        ramps.append(every)
        edits.append(
            partial(
                Edit,
                "drift",
                "the readings of every setup drifted alike from its first to its last",
                "Let the machine and the stand come to one temperature, and read it again.",
                tuple(np.concatenate(drifting).tolist()),
                tuple(table.setups),
            )
        )
    wrong = np.array(ramps).reshape(-1, table.count)
    return Family(edits, np.zeros_like(wrong), max(len(edits), 1), wrong=wrong)


def _stuck(table: Table) -> Family:
    edits: list[Callable[[], Edit]] = []
    unknown: list[tuple[int, ...]] = []
    for name, rows in table.setups.items():
        if not table.raw[rows].all():
            continue
        values = table.values[rows]
        ends = np.flatnonzero(np.append(np.diff(values) != 0.0, True))
        begin = 0
        for end in ends:
            run = rows[begin : end + 1]
            begin = int(end) + 1
            postures = {table.session.readings[i].posture for i in run}
            if run.size < FEWEST_STUCK or len(postures) < 2:
                continue
            unknown.append(tuple(run[1 : MOST_STUCK + 1].tolist()))
            edits.append(
                partial(
                    Edit,
                    "stuck dial",
                    f"the dial stuck in setup {name}: from {table.label(int(run[0]))} on it shows "
                    f"the same {run.size} times",
                    "See whether the plunger moves freely and touches, and read these again.",
                    tuple(run.tolist()),
                )
            )
    return Family(
        edits,
        np.zeros((len(edits), table.count)),
        table.count * MOST_STUCK,
        unknown=unknown,
    )
