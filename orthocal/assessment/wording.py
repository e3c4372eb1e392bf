"""Constructors of findings; formats of numbers, lists and directions in sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from orthocal.arrays import Array
from orthocal.calibration.assessment_record import Assessment, Finding, FindingKind, Place, Severity
from orthocal.session.session import Reading
from orthocal.text import capitalised, list_some, uncapitalised
from orthocal.units import MM, UM, format_fixed

MOST_ACTIONS = 3
"""Largest number of actions in the next step of a decision."""

MOST_SETUPS = 6
"""Largest number of setups that an action names."""

ALONG_AXIS = 0.9999
"""Cosine above which a direction is named after an axis of the world."""

OFFSETS_IN_LINUXCNC = (
    "They are not HOME_OFFSET. In LinuxCNC, HOME_OFFSET must be that in the joints.ini of "
    "`orthocal export`, whose comment `controller` states these offsets."
)
"""Sentences about the place where LinuxCNC users find the offsets of a session."""


def _finding(
    severity: Severity,
    kind: FindingKind,
    text: str,
    action: str = "",
    places: Sequence[Place] = (),
    /,
    **numbers: float,
) -> Finding:
    """Finding of a severity. The names of its numbers end in their units."""
    return Finding(kind, severity, text, action, numbers, tuple(places))


note = partial(_finding, "note")
"""Finding for information."""

review = partial(_finding, "review")
"""Finding after which the user should check the readings."""

reject = partial(_finding, "reject")
"""Finding after which the readings must not be used."""


def describe_actions(findings: Sequence[Finding]) -> str:
    """Actions of the findings that are not notes: one sentence, or a numbered list with places.

    The list has at most MOST_ACTIONS lines, then the number of findings with other actions.
    """
    by_action: dict[str, list[Finding]] = {}
    for finding in findings:
        if finding.severity != "note" and finding.action:
            by_action.setdefault(finding.action, []).append(finding)
    if len(by_action) < 2:
        return next(iter(by_action), "")
    groups = list(by_action.values())
    lines = [f"{i}. {_after_place(g[0])}" for i, g in enumerate(groups[:MOST_ACTIONS], start=1)]
    further = sum(map(len, groups[MOST_ACTIONS:]))
    remaining = [f"Then {counted(further, 'further finding')} above."] if further else []
    return "\n  ".join(["do the following.", *lines, *remaining])


def describe_refusal(assessment: Assessment) -> str:
    """Headline of an assessment, and the findings that decide with their actions.

    One paragraph without line breaks. Several findings are numbered, at most MOST_ACTIONS.
    """
    texts = [
        f"{f.text} {capitalised(f.action)}" for f in assessment.findings if f.severity != "note"
    ]
    items = texts[:MOST_ACTIONS]
    if len(texts) > 1:
        items = [f"{i}. {text}" for i, text in enumerate(items, start=1)]
    if further := len(texts) - len(items):
        items.append(f"{counted(further, 'further finding')}: see the report.")
    return " ".join(" ".join([assessment.decision.headline, *items]).split())


def join_texts(texts: Sequence[str]) -> str:
    """Texts of findings in one text; after a list the next one begins a new line."""
    joined_texts = ""
    for i, text in enumerate(texts):
        separator = "\n" if i and "\n" in texts[i - 1] else " " * bool(i)
        joined_texts += separator + text
    return joined_texts


def _after_place(finding: Finding) -> str:
    """Action of a finding after its place, such as "Setup yx, line 4: read it again.".

    Of several places in one setup it is the first one. The text of the finding is not before it.
    """
    place = finding.places[0] if finding.places else Place()
    action = finding.action.replace("If so, ", "If this was the mistake, ", 1)
    if place.setup is None and place.parameter is None:
        return action
    line = "" if place.line is None else f", line {place.line}"
    setups = list(dict.fromkeys(p.setup for p in finding.places if p.setup is not None))
    if len(setups) > 1:
        label = f"Setups {list_some(setups, MOST_SETUPS)}"
    elif setups:
        label = f"Setup {setups[0]}{line}"
    else:
        parameters = dict.fromkeys(p.parameter for p in finding.places if p.parameter is not None)
        label = list_some(list(parameters), MOST_SETUPS)
    return f"{label}: {uncapitalised(action)}"


def parameter_places(*names: str) -> tuple[Place, ...]:
    """Places of a finding for the names of parameters or drives."""
    return tuple(Place(parameter=name) for name in names)


def lines_in_file(readings: Sequence[Reading | Place]) -> list[int]:
    """Lines of readings, ascending; none if they are unknown or in several files."""
    one_file = len({r.file for r in readings}) == 1
    return sorted({r.line for r in readings if r.line is not None}) if one_file else []


def mm(value: float) -> str:
    """Length in mm with three decimals, or "unknown"."""
    return plain(value / MM)


def plain(value: float, decimals: int = 3) -> str:
    """Number with fixed decimals, or "unknown"."""
    return format_fixed(value, decimals) if math.isfinite(value) else "unknown"


def signed(value: float, decimals: int = 3) -> str:
    """Number with its sign, or "unknown"."""
    return format_fixed(value, decimals, sign=True) if math.isfinite(value) else "unknown"


def um(value: float) -> str:
    """Length in µm, with one decimal below 20 µm, or "unknown"."""
    size = value / UM
    return plain(size, 0 if abs(size) >= 20.0 else 1)


def name_offsets(drives: Sequence[str], *, firmware: bool) -> str:
    """Noun phrase for the offsets of drives; on a printer for its endstops."""
    s = "" if len(drives) == 1 else "s"
    if not firmware:
        return f"the offset{s} of {joined(tuple(drives))}"
    return f"the endstop{s} of tower{s} {joined([d.partition('_')[0] for d in drives])}"


def counted(count: int, noun: str) -> str:
    """Number with a noun, such as "1 reading" or "2 readings"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def named(noun: str, names: Sequence[str]) -> str:
    """Names with their noun, such as "setup yx" or "setups yx and zx"."""
    return f"{noun}{'s' * (len(names) > 1)} {joined(names)}"


def times(ratio: float) -> str:
    """Ratio in words, such as "2.5 times"."""
    return f"{ratio:.1f} times" if ratio < 3.0 else f"{ratio:.0f} times"


def joined(names: Sequence[str], word: str = "and") -> str:
    """Names as a list in a sentence, such as "a, b and c"."""
    return f" {word} ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def tool_mm(value: float) -> str:
    """Tool error in mm with two significant digits and at most three decimals, or "unknown".

    Args:
        value: Length, [m].
    """
    size = value / MM
    if not math.isfinite(size):
        return "unknown"
    digits = 1 - math.floor(math.log10(size)) if size > 0.0 else 3
    return f"{size:.{min(max(digits, 0), 3)}f} mm"


def axis_name(direction: Array, *, cosine: float = ALONG_AXIS) -> str:
    """Name of the world axis along a direction, such as "−y"; "" for other directions."""
    k = int(np.abs(direction).argmax())
    if abs(direction[k]) <= cosine * np.linalg.norm(direction):
        return ""
    return f"{'+' if direction[k] > 0.0 else '−'}{'xyz'[k]}"


def name_direction(direction: Array, *, cosine: float = ALONG_AXIS) -> str:
    """Name of the world axis along a direction; otherwise the components of the unit vector."""
    unit = direction / (np.linalg.norm(direction) or 1.0)
    components = ", ".join(f"{round(v, 2) + 0.0:.2f}".replace("-", "−") for v in unit)
    return axis_name(direction, cosine=cosine) or f"({components})"
