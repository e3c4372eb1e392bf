"""Findings: what was recognised, how grave it is, where, by which numbers, and what to do.

All that shows a result renders these: text, JSON, report, notebook and exit code. A mistake that
can be recognised is recognised once, and is a kind of finding.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from orthocal.calibration.calibration import Calibration
from orthocal.estimation.diagnostics.residual_rows import ResidualRow

Kind = Literal[
    # of a calibration: what its decision rests on
    "turned setup",
    "wrong size",
    "tolerances exceeded",
    "finer than the dial",
    "too little left",
    "sigma too coarse",
    "posture too near",
    "legs differ",
    "suspicious reading",
    "suspicious setup",
    "many contradicted",
    "scattered cycles",
    "noise unknown",
    "nothing to check by",
    "model error",
    "noise not known apart",
    "noise as given",
    "gauge overstated",
    "fits",
    "line in the air",
    "machine changed",
    "nothing changed",
    "change not known",
    # of how readings were taken and written down
    "wrong unit",
    "decimal place",
    "turned reading",
    "misread dial",
    "suspicious posture",
    "exchanged readings",
    "shifted rows",
    "stuck dial",
    "bumped stand",
    "drift",
    "one of several",
    "nothing odd",
    # of what is entered, and of single parameters
    "no offset",
    "nothing moved",
    "nothing worth changing",
    "must change",
    "may stay",
    "held by a bound",
    "controller not stated",
    "cost of linearising",
    "not told apart",
    "below the noise",
    "at the tool",
    "out of reach",
    # of a comparison
    "supported",
    "not supported",
    "within tolerances",
    # of a validation
    "as expected",
    "more than expected",
    "nothing expected",
    "further change",
    "not entered",
    "wrong sign",
    "entered twice",
    "wrong column",
    "interchanged",
    "one drive differs",
    "geometry changed",
    "not the offsets",
    "repeats",
    "does not repeat",
    "repetition unknown",
]

Severity = Literal["stops", "warns", "informs"]
"""What a finding means for the decision: it stops entering; it is to be looked at before; it tells
what else is to be known."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where something was found; what does not apply is None."""

    file: str | None = None
    line: int | None = None
    setup: str | None = None
    posture: str | None = None
    parameter: str | None = None
    """Of an error parameter, or of a drive."""


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """Something that was recognised in a result."""

    kind: Kind
    severity: Severity
    text: str
    """What was found, in a sentence or two."""
    action: str = ""
    """What to do next, in a sentence; empty where nothing is to be done."""
    numbers: Mapping[str, float] = field(default_factory=dict)
    """By name, with the unit as a suffix (_mm, _um); without one they are numbers."""
    places: tuple[Place, ...] = ()
    """Where; the first is the worst."""

    @property
    def words(self) -> str:
        """What was found, and what to do."""
        return f"{self.text} {self.action}".strip()

    def to_document(self) -> dict[str, Any]:
        """As plain data; what is not known is None."""
        return {
            "kind": self.kind,
            "severity": self.severity,
            "text": self.text,
            "action": self.action,
            "numbers": {k: v if math.isfinite(v) else None for k, v in self.numbers.items()},
            "places": [{k: getattr(p, k) for k in Place.__slots__} for p in self.places],
        }


def place_of(calibration: Calibration, row: ResidualRow) -> Place:
    """Where a row of the readings stands."""
    known = row.line is not None
    return Place(
        file=calibration.session.readings_path if known else None,
        line=row.line,
        setup=row.setup,
        posture=row.postures,
    )


def places_of(*names: str) -> tuple[Place, ...]:
    """Parameters, or drives, as places."""
    return tuple(Place(parameter=name) for name in names)
