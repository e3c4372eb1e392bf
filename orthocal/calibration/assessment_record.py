"""Assessment of a calibration as data: findings, decision, values to enter and tool error.

It is computed once (`orthocal.assessment.assess`) and stored in calibration.json. Text, JSON,
report, scene and exports only render it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from orthocal.hypotheses.anomaly import AnomalyKind
from orthocal.io.documents import Number, write_plain
from orthocal.io.fields import FileRecord, Many, NumberOrNaN, SizeOrNaN
from orthocal.kinematics.conditions import StatedUse, UseCondition
from orthocal.kinematics.workspace import describe_box
from orthocal.units import InUnit, Unit

Verdict = Literal["enter", "review", "reject"]

EXIT_CODES: dict[Verdict, int] = {"enter": 0, "review": 3, "reject": 3}
"""Exit codes of check, calibrate, compare and validate."""

Severity = Literal["reject", "review", "note"]
"""Severity of a finding: `reject` and `review` determine the verdict, a note does not."""

NoiseKind = Literal[
    "noise unknown",
    "noise from residuals",
    "noise as stated",
    "noise from cycles",
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
    "wrong order",
    "scattered repeats",
    "sides exchanged",
    "differing closing reading",
    "readings missing",
    "no anomaly",
    # implausible readings and settings
    "wrong dimensions",
    "beyond tolerances",
    "outstanding error",
    "above tolerances",
    "finer than the gauge",
    "residuals too small",
    "sigma too large",
    "resolution too coarse",
    "resolution too fine",
    "postures too near",
    "legs differ",
    # a fit
    "no convergence",
    NoiseKind,
    "no sensitivity",
    "no deviation",
    "held by a bound",
    "linearisation error",
    "inseparable",
    "effect not shown",
    "common approach",
    "effects inseparable",
    "below the noise",
    "line assumed",
    # values to enter
    "no offset",
    "no change needed",
    "settings improve",
    "settings unknown",
    "must change",
    "not significant",
    "controller not stated",
    "compensation not stated",
    "periodic errors",
    "earlier readings",
    "tool error",
    "out of reach",
    # a comparison of models
    "linearisation cost",
    "recommended",
    "not recommended",
    "not determined",
    "tolerances differ",
    "effects recommended",
    "effect not weighed",
    "residuals repeat",
    "residuals differ",
    "repetition unknown",
    # a validation
    "controller assumed",
    "as predicted",
    "larger than predicted",
    "nothing predicted",
    "further change",
]


@dataclass(frozen=True, slots=True)
class Place(FileRecord):
    """Place of a finding; None where a field does not apply."""

    file: str | None = None
    line: int | None = None
    setup: str | None = None
    posture: str | None = None
    parameter: str | None = None
    """Name of an error parameter, or of a drive."""


@dataclass(frozen=True, slots=True, eq=False)
class Finding(FileRecord):
    """Finding of the assessment, about readings or a result."""

    kind: FindingKind
    severity: Severity
    text: str
    """Statement, one or two sentences."""
    action: str = ""
    """Recommended action; empty if there is none."""
    numbers: Mapping[str, NumberOrNaN] = field(default_factory=dict)
    """Numbers by name; the unit is a suffix (_mm, _um), pure numbers have none."""
    places: Many[Place] = ()
    """Places, the worst first."""

    @property
    def words(self) -> str:
        """Text and action; after a list the action begins a new line."""
        return ("\n" if "\n" in self.text else " ").join((self.text, self.action)).strip()

    def to_document(self) -> dict[str, Any]:
        """Plain data for JSON; unknown numbers are null."""
        return write_plain(self, Finding)


@dataclass(frozen=True, slots=True, eq=False)
class Decision(FileRecord):
    """Verdict with its reason and the next step."""

    verdict: Verdict
    headline: str
    reason: str
    """Reason, one or two sentences."""
    action: str
    """Recommended action; empty if there is none."""

    @property
    def words(self) -> str:
        """Headline, reason and action in one paragraph, without line breaks."""
        return " ".join(" ".join((self.headline, self.reason, self.action)).split())

    @property
    def exit_code(self) -> int:
        """0 for enter, 3 for review and reject."""
        return EXIT_CODES[self.verdict]

    def to_document(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {**write_plain(self, Decision), "exit_code": self.exit_code}


@dataclass(frozen=True, slots=True, eq=False)
class ControllerEntry(FileRecord, InUnit):
    """Value to enter into the controller for one drive."""

    drive: str
    unit: Unit
    active: Number | None
    """Active offset in the controller, [unit]; None if the session does not state it."""
    identified: Number
    """Offset of the identified machine, [unit]."""
    best: Number
    """Offset with the smallest tool error, [unit]; its change if the active offset is unknown."""
    enter: Number
    """Offset to enter, [unit]. It is `best`, or `active` if the offsets are kept, or the change if
    the active offset is unknown."""
    std: SizeOrNaN
    """Standard deviation of `best` from noise, priors and unmodelled errors, [unit]."""
    std_scatter: SizeOrNaN
    """Part of `std` from the noise of the readings, [unit]."""
    std_scaled: SizeOrNaN
    """Part of `std` from errors whose tolerances the tolerance scale multiplies, [unit]."""
    held: Literal["known", "lower bound", "upper bound"] | None
    """Reason why the readings do not determine the offset; None if they do."""

    @property
    def change(self) -> float:
        """Value to enter minus the active one, [unit]; 0 if the offsets are kept."""
        return self.enter - (0.0 if self.active is None else self.active)

    @property
    def best_change(self) -> float:
        """Best value minus the active one, [unit]."""
        return self.best - (0.0 if self.active is None else self.active)

    @property
    def kept(self) -> ControllerEntry:
        """Entry that keeps the active offset."""
        return replace(self, enter=0.0 if self.active is None else self.active)


@dataclass(frozen=True, slots=True, eq=False)
class BacklashEntry(FileRecord, InUnit):
    """Backlash of one drive for the controller to compensate."""

    drive: str
    unit: Unit
    active: Number
    """Backlash that the controller compensates at present, at the mechanical zero, [unit]."""
    identified: Number
    """Backlash of the identified machine, [unit]."""
    enter: Number
    """Backlash to enter, [unit]: `identified`, or the active one if the change is undetermined."""
    std: SizeOrNaN
    """Standard deviation of `identified` from noise, priors and unmodelled errors, [unit]."""
    std_scatter: SizeOrNaN
    """Part of `std` from the noise of the readings, [unit]."""

    @property
    def change(self) -> float:
        """Backlash to enter minus the active one, [unit]."""
        return self.enter - self.active

    @property
    def kept(self) -> BacklashEntry:
        """Entry that keeps the active backlash."""
        return replace(self, enter=self.active)


@dataclass(frozen=True, slots=True, eq=False)
class UsePart(FileRecord):
    """Contribution of a varying condition of use to the tool error, RMS, [m]."""

    condition: UseCondition
    effects: Many[str]
    """Effects that depend on the condition."""
    known: SizeOrNaN
    """Estimated change of the tool error with the offsets to enter."""
    uncertain: SizeOrNaN
    """Uncertainty of that change."""

    @property
    def size(self) -> float:
        """Root sum of squares of both parts, [m]."""
        return math.hypot(self.known, self.uncertain)


@dataclass(frozen=True, slots=True, eq=False)
class ToolUse(FileRecord):
    """Conditions of use of a tool error. A condition is None if no effect depends on it."""

    approach: str | None
    """Letter for each drive: p or n for one side of approach, u for both."""
    temperature: tuple[Number, Number] | None
    """Lowest and highest temperature, [°C]."""
    payload: tuple[Number, Number] | None
    """Smallest and largest payload, [kg]."""
    parts: Many[UsePart]
    """Conditions that vary."""
    unstated: SizeOrNaN
    """Aligned tool error, [m], if all identified errors are corrected for the reference conditions
    only: the mean of both sides of approach, the reference temperature and no payload."""

    @property
    def stated(self) -> StatedUse:
        """Conditions that are stated."""
        return StatedUse(approach=self.approach, temperature=self.temperature, payload=self.payload)


@dataclass(frozen=True, slots=True, eq=False)
class ToolErrorSummary(FileRecord):
    """Expected RMS error of the tool over the workspace, [m].

    "Aligned" errors are those after aligning the workpiece on the machine: the best-fit translation
    and rotation are removed. "Absolute" errors are in coordinates of the machine.
    """

    box: Many[tuple[Number, Number]]
    """Workspace: lowest and highest value of each coordinate, [m]."""
    coordinates: str
    """Names of the coordinates, such as "xyz"."""
    now: SizeOrNaN
    """Aligned error with the active offsets."""
    entered: SizeOrNaN
    """Aligned error with the offsets and the backlash to enter."""
    compensated: SizeOrNaN
    """Aligned error if the controller corrects all identified errors."""
    entered_absolute: SizeOrNaN
    """Absolute error with the offsets and the backlash to enter."""
    now_absolute: SizeOrNaN
    """Absolute error with the active offsets."""
    without_backlash: SizeOrNaN | None = None
    """Aligned error with the offsets to enter and the present backlash; None without backlash to
    enter."""
    use: ToolUse | None = None
    """Conditions of use; None if the tool error depends on none."""

    @property
    def region(self) -> str:
        """Workspace in words, such as "±60 mm"."""
        return describe_box(np.array(self.box), self.coordinates)


@dataclass(frozen=True, slots=True, eq=False)
class Assessment(FileRecord):
    """Assessment of a calibration or of readings."""

    decision: Decision
    findings: Many[Finding]
    """Findings, the gravest first."""
    entries: Many[ControllerEntry]
    """Offsets to enter; empty if no offset was identified."""
    tool: ToolErrorSummary | None
    """Expected tool error; None if the robot has no tool, or if the noise is unknown."""
    backlash: Many[BacklashEntry] = ()
    """Backlash to enter; empty if the model has none."""

    @property
    def keeps_offsets(self) -> bool:
        """True if the active offsets, or the settings of a firmware, are not to be changed."""
        return bool(self.of_kind("no change needed", "no offset", "settings unknown"))

    def of_kind(self, *kinds: FindingKind) -> tuple[Finding, ...]:
        """Findings of the stated kinds, in their order."""
        return tuple(f for f in self.findings if f.kind in kinds)

    def to_document(self) -> dict[str, Any]:
        """Plain data: `decision` and `findings` of a printed result."""
        return {
            "decision": self.decision.to_document(),
            "findings": [f.to_document() for f in self.findings],
        }


def first_of(findings: Sequence[Finding], *kinds: FindingKind) -> Finding | None:
    """First finding of one of the stated kinds; None if there is none."""
    return next((f for f in findings if f.kind in kinds), None)
