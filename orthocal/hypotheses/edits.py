"""Edits: what would mend a mistake that may have been made, many of a kind at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from orthocal.hypotheses.mistake import MistakeKind
from orthocal.session.session import Session

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Edit:
    """One mistake that may have been made, in words."""

    kind: MistakeKind
    text: str
    """What was done, as the end of a sentence that begins with "as if"."""
    mend: str
    """What mends it, as a sentence."""
    rows: tuple[int, ...]
    """Rows of the session that are told as places, the first one first."""
    setups: tuple[str, ...] = ()
    """Setups, where whole ones are concerned."""
    factor: float = 1.0
    """What all of its readings are multiplied by."""


@dataclass(frozen=True, slots=True, eq=False)
class Family:
    """Edits of one kind."""

    edits: Sequence[Callable[[], Edit]]
    """What makes each, where it is asked for: hardly any is."""
    change: Array
    """What is added to the rows, shape (h, n_rows), [m]."""
    size: int
    """How many could have been made: none is likelier beforehand than any other."""
    wrong: Array | None = None
    """What rows may be wrong by beside that, up to an unknown amount, shape (h, n_rows)."""
    log_volume: Array = field(default_factory=lambda: np.zeros(0))
    """Logarithm of what a volume of readings grows by, shape (h,); 0 where empty."""
    unknown: Sequence[tuple[int, ...]] = ()
    """Rows that say nothing, of each edit, instead of a change."""
    loose: Sequence[Array] = ()
    """What rows may be wrong by instead, each up to an amount of its own, (k, n_rows) each."""


class Table:
    """The rows of a session as they were written down, by setup and posture.

    Args:
        session: The session.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.values = session.values
        self.count = len(session.readings)
        self.raw = np.array([r.minus is None for r in session.readings], dtype=bool)

    @cached_property
    def setups(self) -> dict[str, Indices]:
        """Setup to its rows, in the order of the file."""
        found: dict[str, list[int]] = {}
        for i, r in enumerate(self.session.readings):
            found.setdefault(r.setup, []).append(i)
        return {name: np.array(rows) for name, rows in found.items()}

    @cached_property
    def cycles(self) -> dict[tuple[str, int], Indices]:
        """Setup and cycle to the rows, in the order of the file."""
        found: dict[tuple[str, int], list[int]] = {}
        for i, r in enumerate(self.session.readings):
            found.setdefault((r.setup, r.cycle), []).append(i)
        return {key: np.array(rows) for key, rows in found.items()}

    @cached_property
    def repeated(self) -> dict[tuple[str, str], Indices]:
        """Setup and posture (or difference) to the rows of all cycles."""
        found: dict[tuple[str, str], list[int]] = {}
        for i, r in enumerate(self.session.readings):
            found.setdefault((r.setup, r.label), []).append(i)
        return {key: np.array(rows) for key, rows in found.items()}

    @cached_property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """What several setups share, in words, to their names: a leg, a gauge."""
        found: dict[str, list[str]] = {}
        for name in self.setups:
            setup = self.session.setups[name]
            leg = getattr(setup.sensor, "leg", None)
            if isinstance(leg, str):
                found.setdefault(f"leg {leg}", []).append(name)
            if len(self.session.gauges) > 1:
                found.setdefault(f"gauge {setup.gauge}", []).append(name)
        every = tuple(self.setups)
        return {k: tuple(v) for k, v in found.items() if 1 < len(v) < len(every)}

    def rows_of(self, setups: Sequence[str]) -> Indices:
        """Rows of some setups."""
        return np.concatenate([self.setups[name] for name in setups])

    def label(self, row: int) -> str:
        """A row in words, with its cycle where it is not the first."""
        r = self.session.readings[row]
        return r.label + (f", cycle {r.cycle}" if r.cycle > 1 else "")
