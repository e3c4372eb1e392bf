"""The judgement of a calibration as data: findings, one decision, what to enter, the tool error.

It is computed once (`orthocal.assessment.assess`), stored in calibration.json, and only rendered
by text, JSON, report, scene and exports.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from orthocal.hypotheses.anomaly import AnomalyKind
from orthocal.io.documents import Number, write_plain
from orthocal.io.fields import CLOSED, Many, NumberOrNaN, SizeOrNaN
from orthocal.kinematics.conditions import StatedUse, UseCondition
from orthocal.kinematics.workspace import describe_box
from orthocal.units import InUnit, Unit

Verdict = Literal["enter", "review", "reject"]

EXIT_CODES: dict[Verdict, int] = {"enter": 0, "review": 3, "reject": 3}
"""Exit codes of check, calibrate, compare and validate."""

Severity = Literal["reject", "review", "note"]
"""What a finding does to the verdict: `reject` and `review` decide it, a note does not."""

NoiseKind = Literal[
    "noise unknown",
    "noise from residuals",
    "noise as stated",
    "model error",
    "gauge overstated",
    "fits",
    "no redundancy",
]
"""Kinds of findings about the residuals of a fit."""

FindingKind = Literal[
    # mistakes in readings and changes between sessions (hypotheses)
    AnomalyKind,
    "ambiguous",
    "inconsistent readings",
    "no change",
    "change unknown",
    "scattered repeats",
    "readings missing",
    # what no machine or gauge shows
    "wrong dimensions",
    "beyond tolerances",
    "above tolerances",
    "finer than the gauge",
    "residuals too small",
    "sigma too large",
    "resolution too coarse",
    "postures too near",
    "legs differ",
    # of a fit
    "no convergence",
    NoiseKind,
    "nothing moved",
    "held by a bound",
    "linearisation error",
    "inseparable",
    "effect not shown",
    "effects inseparable",
    "below the noise",
    "line assumed",
    # of what to enter
    "no offset",
    "no change needed",
    "must change",
    "not significant",
    "controller not stated",
    "earlier readings",
    "tool error",
    "out of reach",
    # of a comparison of models
    "recommended",
    "not recommended",
    "not determined",
    "tolerances differ",
    "effects recommended",
    "effect not weighed",
    "residuals repeat",
    "residuals differ",
    "repetition unknown",
    # of a validation
    "as predicted",
    "larger than predicted",
    "nothing predicted",
    "further change",
]


@dataclass(frozen=True, slots=True)
class Place:
    """Place of a finding; None where a field does not apply."""

    __pydantic_config__ = CLOSED

    file: str | None = None
    line: int | None = None
    setup: str | None = None
    posture: str | None = None
    parameter: str | None = None
    """Name of an error parameter, or of a drive."""


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """Finding of the assessment, about readings or a result."""

    __pydantic_config__ = CLOSED

    kind: FindingKind
    severity: Severity
    text: str
    """What was found, in a sentence or two."""
    action: str = ""
    """What to do next; empty if nothing."""
    numbers: Mapping[str, NumberOrNaN] = field(default_factory=dict)
    """By name, with the unit as a suffix (_mm, _um); pure numbers without."""
    places: Many[Place] = ()
    """Where; the first is the worst."""

    @property
    def words(self) -> str:
        """Text and action; after a list the action has a line of its own."""
        return ("\n" if "\n" in self.text else " ").join((self.text, self.action)).strip()

    def to_document(self) -> dict[str, Any]:
        """Plain data for JSON; null for what is unknown."""
        return write_plain(self, Finding)


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """Decision: one verdict, its reason, and the next step."""

    __pydantic_config__ = CLOSED

    verdict: Verdict
    headline: str
    reason: str
    """Why, in a sentence or two."""
    action: str
    """What to do next; empty if nothing."""

    @property
    def words(self) -> str:
        """Headline, reason and action in one paragraph, lists included."""
        return " ".join(" ".join((self.headline, self.reason, self.action)).split())

    @property
    def exit_code(self) -> int:
        """0 for enter, 3 for review and reject."""
        return EXIT_CODES[self.verdict]

    def to_document(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {**write_plain(self, Decision), "exit_code": self.exit_code}


@dataclass(frozen=True, slots=True, eq=False)
class ControllerEntry(InUnit):
    """Value to enter into the controller for one drive."""

    __pydantic_config__ = CLOSED

    drive: str
    unit: Unit
    active: Number | None
    """Offset now in the controller, [unit]; None if the session does not state it."""
    identified: Number
    """Offset of the identified machine, [unit]."""
    best: Number
    """Offset with the least tool error, [unit]; its change if the active one is unknown."""
    enter: Number
    """Offset to enter, [unit]: `best`, or the active one where the offsets stay as they are; the
    change to add to the active one if that is unknown."""
    std: SizeOrNaN
    """Standard deviation of `best` from noise, priors and unmodelled errors, [unit]."""
    std_scatter: SizeOrNaN
    """The part of it that is due to the noise of the readings, [unit]."""
    held: Literal["known", "lower bound", "upper bound"] | None
    """What holds it instead of the readings."""

    @property
    def change(self) -> float:
        """Value to enter less the active one, [unit]: 0 where the offsets stay as they are."""
        return self.enter - (0.0 if self.active is None else self.active)

    @property
    def best_change(self) -> float:
        """Best value less the active one, [unit]."""
        return self.best - (0.0 if self.active is None else self.active)

    @property
    def kept(self) -> ControllerEntry:
        """The entry that leaves the offset as it is."""
        return replace(self, enter=0.0 if self.active is None else self.active)


@dataclass(frozen=True, slots=True, eq=False)
class BacklashEntry(InUnit):
    """Backlash of one drive for the controller to compensate."""

    __pydantic_config__ = CLOSED

    drive: str
    unit: Unit
    active: Number
    """Backlash that the controller compensates now, at the mechanical zero, [unit]."""
    identified: Number
    """Backlash of the identified machine, [unit]."""
    enter: Number
    """Backlash to enter, [unit]: `identified`, or the active one if the change is undetermined."""
    std: SizeOrNaN
    """Standard deviation of `identified` from noise, priors and unmodelled errors, [unit]."""
    std_scatter: SizeOrNaN
    """The part of it that is due to the noise of the readings, [unit]."""

    @property
    def change(self) -> float:
        """Backlash to enter less the active one, [unit]."""
        return self.enter - self.active

    @property
    def kept(self) -> BacklashEntry:
        """The entry that leaves the backlash as it is."""
        return replace(self, enter=self.active)


@dataclass(frozen=True, slots=True, eq=False)
class UsePart:
    """Contribution of a condition of use that varies to the tool error, RMS, [m]."""

    __pydantic_config__ = CLOSED

    condition: UseCondition
    effects: Many[str]
    """Effects that depend on it."""
    known: SizeOrNaN
    """Known change, with the offsets to be entered."""
    uncertain: SizeOrNaN
    """Uncertainty of the change."""

    @property
    def size(self) -> float:
        """Root of the sum of both squares, [m]."""
        return math.hypot(self.known, self.uncertain)


@dataclass(frozen=True, slots=True, eq=False)
class ToolUse:
    """Conditions of use of a tool error; None where no effect of the machine depends on one."""

    __pydantic_config__ = CLOSED

    approach: str | None
    """A letter for each drive: p or n for one side, u for both."""
    temperature: tuple[Number, Number] | None
    """Lowest and highest, [°C]."""
    payload: tuple[Number, Number] | None
    """Lightest and heaviest, [kg]."""
    parts: Many[UsePart]
    """Conditions that vary."""
    unstated: SizeOrNaN
    """Tool error, aligned, with all identified errors corrected but the conditions unknown: for the
    middle of both sides, the reference temperature and no payload, [m]."""

    @property
    def stated(self) -> StatedUse:
        """The conditions."""
        return StatedUse(approach=self.approach, temperature=self.temperature, payload=self.payload)


@dataclass(frozen=True, slots=True, eq=False)
class ToolErrorSummary:
    """Expected RMS error of the tool over the workspace, [m].

    `aligned`: after aligning the workpiece on the machine (translation and rotation removed), which
    is what counts; `absolute`: in the machine's own coordinates.
    """

    __pydantic_config__ = CLOSED

    box: Many[tuple[Number, Number]]
    """Workspace, lowest and highest coordinate about the mechanical zero, [m]."""
    coordinates: str
    """Names of the coordinates: xyz."""
    now: SizeOrNaN
    """Aligned, with the offsets that are active now."""
    entered: SizeOrNaN
    """Aligned, with the offsets and the backlash to be entered."""
    compensated: SizeOrNaN
    """Aligned, with a controller that corrects all identified errors."""
    entered_absolute: SizeOrNaN
    now_absolute: SizeOrNaN
    without_backlash: SizeOrNaN | None = None
    """Aligned, with the offsets to be entered but not the backlash; None without backlash to
    enter."""
    use: ToolUse | None = None
    """Conditions of use; None for a machine that depends on none."""

    @property
    def region(self) -> str:
        """The workspace in words: ±60 mm, or its ranges."""
        return describe_box(np.array(self.box), self.coordinates)


@dataclass(frozen=True, slots=True, eq=False)
class Assessment:
    """Assessment: verdict, findings, offsets to enter, tool error."""

    __pydantic_config__ = CLOSED

    decision: Decision
    findings: Many[Finding]
    """The gravest first."""
    entries: Many[ControllerEntry]
    """What to enter, drive by drive; empty if no offset was identified."""
    tool: ToolErrorSummary | None
    """None if the robot has no tool, or nothing determines the noise."""
    backlash: Many[BacklashEntry] = ()
    """What to enter of the backlash of each drive; empty if the model has none."""

    @property
    def keeps_offsets(self) -> bool:
        """True if the offsets in the controller need no change."""
        return bool(self.of_kind("no change needed", "no offset"))

    def of_kind(self, *kinds: FindingKind) -> tuple[Finding, ...]:
        """Findings of some kinds, in their order."""
        return tuple(f for f in self.findings if f.kind in kinds)

    def to_document(self) -> dict[str, Any]:
        """Plain data: `decision` and `findings` of a printed result."""
        return {
            "decision": self.decision.to_document(),
            "findings": [f.to_document() for f in self.findings],
        }


def first_of(findings: Sequence[Finding], *kinds: FindingKind) -> Finding | None:
    """The first finding of any of some kinds."""
    return next((f for f in findings if f.kind in kinds), None)
