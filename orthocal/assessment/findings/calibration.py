"""All findings of a calibration, and the one decision that follows from them."""

from __future__ import annotations

from orthocal.arguments import require_kind
from orthocal.assessment.controller_entries import find_entries
from orthocal.assessment.findings.changes import find_machine_changes
from orthocal.assessment.findings.decision import Answer, Decision, first_of
from orthocal.assessment.findings.finding import Finding, Severity
from orthocal.assessment.findings.parameters import (
    find_controller,
    find_held,
    find_hidden,
    find_linearisation,
    find_standstill,
    find_trust,
    find_worth,
)
from orthocal.assessment.findings.readings import (
    find_line,
    find_scattered,
    find_suspicious,
    find_turned,
)
from orthocal.assessment.findings.residuals import find_check, find_remainder, find_tolerances
from orthocal.assessment.findings.session import MISTAKES, add_mistakes
from orthocal.assessment.findings.tool import find_at_tool
from orthocal.assessment.plausibility import find_doubts
from orthocal.assessment.wording import joined
from orthocal.calibration.calibration import Calibration

CONFIRM = (
    "Measure again with these in the controller (`orthocal again` makes that session), and hold it "
    "against this calibration: `orthocal validate`."
)

_GRAVITY: dict[Severity, int] = {"stops": 0, "warns": 1, "informs": 2}


def decide(calibration: Calibration) -> Decision:
    """Whether to enter what was identified, why, what to do next, and all that was found.

    One decision follows from the findings: what stops decides, then what warns, then whether
    anything is worth changing; of what is alike grave the first in the order of `find_findings`.
    """
    require_kind(calibration, Calibration, expected="a Calibration, such as load_calibration(...)")
    return calibration.remember("decision", lambda: _decide(calibration))


def find_findings(calibration: Calibration) -> tuple[Finding, ...]:
    """All that is recognised in a calibration, the gravest first, else in the order of deciding."""
    at_tool = find_at_tool(calibration)
    promised = [f for f in at_tool if f.kind == "at the tool"]
    turned, changes = find_turned(calibration), find_machine_changes(calibration)
    if changes and _leaves_offsets_open(calibration):  # they look like gauges turned round
        turned = []
    found = [
        *turned,
        *changes,
        *find_tolerances(calibration),
        *find_doubts(calibration),
        *find_suspicious(calibration),
        *find_scattered(calibration),
        *find_remainder(calibration),
        *find_check(calibration),
        *find_no_offset(calibration),
        *find_standstill(calibration),
        *find_worth(calibration, promised),
        *at_tool,
        *find_controller(calibration),
        *find_trust(calibration),
        *find_held(calibration),
        *find_linearisation(calibration),
        *find_hidden(calibration),
        *find_line(calibration),
    ]
    found = add_mistakes(calibration, found)
    # postures of another machine say more than what they leave of its tolerances
    order = {"turned setup": -2, "wrong size": -1, **dict.fromkeys(MISTAKES, -2)}
    return tuple(sorted(found, key=lambda f: (_GRAVITY[f.severity], order.get(f.kind, 0))))


def _leaves_offsets_open(calibration: Calibration) -> bool:
    """Whether some sessions say which offsets were active in the controller, and others do not."""
    return len({p.controller_offsets is None for p in calibration.session.parts}) > 1


def find_no_offset(calibration: Calibration) -> list[Finding]:
    """Whether no offset was identified, so that there is nothing to enter."""
    if find_entries(calibration):
        return []
    return [Finding("no offset", "informs", "No offset was identified.")]


def _decide(calibration: Calibration) -> Decision:
    findings = find_findings(calibration)
    lead = findings[0]
    none = first_of(findings, "no offset")
    still = first_of(findings, "nothing moved", "nothing worth changing")
    if none is not None:
        return _decision("nothing to enter", none, findings)
    if lead.severity == "stops":
        return _decision("do not enter", lead, findings)
    if lead.severity == "warns":
        return _decision("check before entering", lead, findings)
    if still is not None:
        return _decision("nothing to enter", still, findings)
    # what the readings cannot check says more than how small the remainder is
    why = first_of(findings, "nothing to check by") or first_of(
        findings, "model error", "noise not known apart", "gauge overstated", "fits"
    )
    reason, more = ("", "") if why is None else (why.text, why.action)
    return Decision("enter", reason, f"{CONFIRM} {more}".strip(), findings)


def _decision(answer: Answer, lead: Finding, findings: tuple[Finding, ...]) -> Decision:
    alike = [f for f in findings if f.kind == lead.kind]
    reason = lead.text
    if lead.kind == "suspicious reading":
        setups = list(dict.fromkeys(p.setup or "" for f in alike for p in f.places))
        few = f" ({'setup' if len(setups) == 1 else 'setups'} {joined(setups)})"
        what = "1 reading contradicts" if len(alike) == 1 else f"{len(alike)} readings contradict"
        reason = f"{what} all others{few if len(setups) <= 3 else ''}."
    return Decision(answer, reason, lead.action, findings)
