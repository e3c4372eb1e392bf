"""What a check of readings finds, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

MistakeKind = Literal[
    "wrong unit",
    "decimal place",
    "turned setup",
    "turned reading",
    "misread dial",
    "suspicious reading",
    "suspicious posture",
    "suspicious setup",
    "exchanged readings",
    "shifted rows",
    "stuck dial",
    "bumped stand",
    "drift",
]


@dataclass(frozen=True, slots=True, eq=False)
class Mistake:
    """A mistake that the readings speak for, or one of several."""

    kind: MistakeKind
    text: str
    """What was done, as the end of a sentence that begins with "as if"."""
    mend: str
    """What mends it, as a sentence."""
    rows: tuple[int, ...]
    """Rows of the session, the first one first."""
    setups: tuple[str, ...]
    evidence: float
    """Logarithm of how many times likelier the readings are with it than without, chances of
    finding one of so many taken off."""
    before: float
    """Root mean square of what a machine within its tolerances leaves of the readings, [m]."""
    after: float
    """The same once it is mended, [m]."""
    expected: float | None
    """What the first of its rows should read, where it is a single one, [m]."""
    perhaps: tuple[str, ...] = ()
    """How it may have come about, where that is not clear, each as `text`."""
    others: tuple[Mistake, ...] = ()
    """Others elsewhere that are nearly as likely."""
