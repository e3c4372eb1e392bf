"""What a calibration means, in sentences: its findings, as they are read."""

from __future__ import annotations

from collections.abc import Sequence

from orthocal.assessment.findings.calibration import decide
from orthocal.assessment.findings.finding import Finding, Kind
from orthocal.calibration.calibration import Calibration

WORST_SUSPICIOUS = 5
"""Suspicious readings that are named."""

ELSEWHERE: tuple[Kind, ...] = (
    "no offset",
    "at the tool",
    "out of reach",
    "controller not stated",
    "held by a bound",
    "not told apart",
    "below the noise",
)
"""Kinds of findings that stand beside the numbers that they are of."""


def advise(calibration: Calibration) -> str:
    """Whether to enter what was identified, and why; empty where no offset was."""
    decision = decide(calibration)
    if decision.of_kind("no offset"):
        return ""
    return f"{decision.headline} {decision.reason} {decision.action}".strip()


def explain_fit(calibration: Calibration) -> list[str]:
    """Sentences on what remains, what linearisation costs, and what can be believed."""
    found = [f for f in decide(calibration).findings if f.kind not in ELSEWHERE]
    sentences = []
    listed = False
    for finding in found:
        if finding.kind != "suspicious reading":
            sentences.append(finding.words)
        elif not listed:
            sentences.append(_list_suspicious([f for f in found if f.kind == finding.kind]))
            listed = True
    return sentences


def _list_suspicious(found: Sequence[Finding]) -> str:
    """Rows that all the others contradict, by file and line."""
    more = len(found) - WORST_SUSPICIOUS
    return (
        "Suspicious readings, to be looked at and read again (none was left out): "
        + "; ".join(f.text.removesuffix(".") for f in found[:WORST_SUSPICIOUS])
        + (f"; and {more} more." if more > 0 else ".")
    )
