"""Decisions: one answer for a result, why, and what to do next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from orthocal.assessment.findings.finding import Finding, Kind

Answer = Literal[
    "enter",
    "check before entering",
    "do not enter",
    "nothing to enter",
    "confirmed",
    "not confirmed",
    "cannot be told",
    "nothing odd",
    "something odd",
    "supported",
    "supported with model error",
    "none supported",
]

HEADLINES: dict[Answer, str] = {
    "enter": "Enter these, and measure again.",
    "check before entering": "Check before you enter these.",
    "do not enter": "Do not enter these.",
    "nothing to enter": "Nothing to enter.",
    "confirmed": "The calibration is confirmed.",
    "not confirmed": "The calibration is not confirmed.",
    "cannot be told": "Whether this is as expected cannot be told.",
    "nothing odd": "Nothing odd.",
    "something odd": "Look at these readings first.",
    "supported": "The readings support a model.",
    "supported with model error": "The readings support a model, but it leaves more than noise.",
    "none supported": "The readings support none of the models.",
}

EXIT_CODES: dict[Answer, int] = {
    "do not enter": 3,
    "not confirmed": 3,
    "something odd": 3,
    "supported with model error": 3,
    "none supported": 4,
}
"""Exit codes of decisions against what was found; 0 for all others."""


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """What follows from the findings of a result."""

    answer: Answer
    reason: str
    """Why, in a sentence or two."""
    action: str
    """What to do next, in a sentence; empty where nothing is to be done."""
    findings: tuple[Finding, ...]
    """All that was found, the gravest first."""

    @property
    def headline(self) -> str:
        """The answer as a sentence."""
        return HEADLINES[self.answer]

    @property
    def exit_code(self) -> int:
        """0; 3 or 4 for a decision against what was found."""
        return EXIT_CODES.get(self.answer, 0)

    def of_kind(self, *kinds: Kind) -> tuple[Finding, ...]:
        """Findings of some kinds, in their order."""
        return tuple(f for f in self.findings if f.kind in kinds)

    def to_document(self) -> dict[str, Any]:
        """As plain data: `decision` and `findings` of a printed result."""
        return {
            "decision": {
                "answer": self.answer,
                "headline": self.headline,
                "reason": self.reason,
                "action": self.action,
                "exit_code": self.exit_code,
            },
            "findings": [f.to_document() for f in self.findings],
        }


def first_of(findings: Sequence[Finding], *kinds: Kind) -> Finding | None:
    """The first finding of any of some kinds."""
    return next((f for f in findings if f.kind in kinds), None)
