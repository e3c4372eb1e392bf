"""Single readings: a slip, a forgotten minus, a point in the wrong place, the dial misread.

Each also in all cycles of a posture, where only other postures can tell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from orthocal.hypotheses.edits import Edit, Family, Table
from orthocal.hypotheses.mistake import MistakeKind
from orthocal.units import MM

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

PLACES = (10.0, 0.1, 100.0, 0.01)
"""What a reading is multiplied by where its decimal point is put right."""

MISREAD = (1e-3, 0.5e-3, 0.2e-3, 0.1e-3)
"""What a dial is misread by: a turn, half a turn, a turn of a fine dial, a numbered mark, [m]."""

FEWEST_POSTURES = 3
"""Postures of a setup of which one may be wrong in all cycles."""


def find_single(table: Table) -> Iterator[Family]:
    """All that may be wrong with one reading, or with one posture in all cycles."""
    single = [np.array([i]) for i in range(table.count)]
    yield _slips(table, single, "suspicious reading")
    yield _multiplied(table, single, (-1.0,), "turned reading")
    yield _multiplied(table, single, PLACES, "decimal place")
    yield _misread(table, single)
    several = [
        rows
        for (setup, _), rows in table.repeated.items()
        if len(rows) > 1 and len(table.setups[setup]) >= FEWEST_POSTURES * len(rows)
    ]
    if several:
        yield _slips(table, several, "suspicious posture")
        yield _multiplied(table, several, (-1.0,), "turned reading")
        yield _multiplied(table, several, PLACES, "decimal place")


def _words(table: Table, rows: Indices) -> str:
    if len(rows) == 1:
        return table.label(int(rows[0]))
    return f"{table.session.readings[int(rows[0])].label} in all cycles"


def _marks(table: Table, groups: Sequence[Indices]) -> Array:
    result = np.zeros((len(groups), table.count))
    for h, rows in enumerate(groups):
        result[h, rows] = 1.0
    return result


def _slips(table: Table, groups: Sequence[Indices], kind: MistakeKind) -> Family:
    edits = [partial(_slip, table, rows, kind) for rows in groups]
    marks = _marks(table, groups)
    return Family(edits, np.zeros_like(marks), len(groups), wrong=marks)


def _slip(table: Table, rows: Indices, kind: MistakeKind) -> Edit:
    what = f"{_words(table, rows)} was misread or mistyped"
    return Edit(kind, what, "Read it again, or leave it out.", tuple(rows.tolist()))


def _multiplied(
    table: Table, groups: Sequence[Indices], factors: Sequence[float], kind: MistakeKind
) -> Family:
    marks = _marks(table, groups)
    edits: list[Callable[[], Edit]] = []
    change, volume = [], []
    for factor in factors:
        change.append(marks * table.values * (factor - 1.0))
        volume.append(marks.sum(axis=1) * np.log(abs(factor)))
        edits += [partial(_multiplied_edit, table, rows, factor, kind) for rows in groups]
    return Family(
        edits,
        np.concatenate(change),
        len(edits),
        log_volume=np.concatenate(volume),
    )


def _multiplied_edit(table: Table, rows: Indices, factor: float, kind: MistakeKind) -> Edit:
    words = _words(table, rows)
    found = table.values[int(rows[0])] / MM
    put = f"If so, write {found * factor:+.6g} instead of {found:+.6g}."
    if len(rows) > 1:
        put = f"If so, multiply these by {factor:g}."
    what = (
        f"the sign of {words} was turned"
        if factor == -1.0
        else f"the decimal point of {words} is in the wrong place"
    )
    return Edit(kind, what, put, tuple(rows.tolist()), factor=factor)


def _misread(table: Table, groups: Sequence[Indices]) -> Family:
    steps = [sign * size for size in MISREAD for sign in (1.0, -1.0)]
    marks = _marks(table, groups)
    edits = [partial(_misread_edit, table, rows, step) for step in steps for rows in groups]
    return Family(edits, np.concatenate([marks * step for step in steps]), len(edits))


def _misread_edit(table: Table, rows: Indices, step: float) -> Edit:
    found = table.values[int(rows[0])]
    what = (
        f"{_words(table, rows)} was read {abs(step) / MM:g} mm too "
        f"{'low' if step > 0 else 'high'}, by a turn or a mark of the dial"
    )
    put = f"If so, write {(found + step) / MM:+.6g} instead of {found / MM:+.6g}."
    return Edit("misread dial", what, put, tuple(rows.tolist()))
