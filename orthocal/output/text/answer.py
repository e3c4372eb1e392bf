"""The short answer of a calibration: whether to enter what, what that is good for, what is next."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.text import Text

from orthocal.assessment.findings.calibration import decide
from orthocal.assessment.findings.decision import Decision
from orthocal.assessment.findings.finding import Finding, Kind
from orthocal.assessment.tool_error import assess_tool
from orthocal.assessment.wording import joined
from orthocal.calibration.calibration import Calibration
from orthocal.output.text.entries import short_entry_table
from orthocal.output.text.heading import render_subject
from orthocal.output.text.layout import bullets, plain, short_name, signed

MOST_SUSPICIOUS = 5
"""Suspicious readings that are named."""

MOST_FURTHER = 4
"""Further findings that are told."""

LONGEST_PATH = 60
"""Characters of a file's path that are shown where it has a line of its own."""

LONGEST_LABEL = 24
"""Characters of a setup and a posture that leave a suspicious reading on one line."""

FURTHER: tuple[Kind, ...] = (
    "nothing changed",
    "change not known",
    "suspicious setup",
    "many contradicted",
    "nothing to check by",
    "held by a bound",
    "may stay",
    "line in the air",
)
"""Kinds of findings that are told here though they only inform."""

TOUCHES_NOTHING: tuple[Kind, ...] = ("nothing worth changing", "nothing moved")
"""Kinds of findings beside which it says nothing that offsets may stay as they are."""

MORE = "--details shows every reading, the fit, the tool and what was identified."


def render_answer(calibration: Calibration, *, heading: bool = True) -> RenderableType:
    """The short answer.

    Args:
        calibration: The calibration.
        heading: Whether to begin with what was measured, and of which machine.
    """
    decision = decide(calibration)
    parts: list[RenderableType] = [render_subject(calibration), Text()] if heading else []
    parts += [_verdict(decision), Text()]
    if shows_entries(decision):
        parts += _indented(short_entry_table(calibration), Text(_how(calibration)))
        parts += [Text(), *_at_tool(calibration, decision)]
    listed = _suspicious(decision)
    if listed and shows_entries(decision):
        parts.append(Text())
    parts += listed
    parts.append(bullets([f.text for f in _further(calibration, decision)]))
    if decision.action:
        parts.append(Text.assemble(("Next: ", "bold"), decision.action))
    return Group(*parts)


def shows_entries(decision: Decision) -> bool:
    """Whether a short answer lists what was found for every drive."""
    return decision.answer != "do not enter" and not decision.of_kind("no offset")


def _verdict(decision: Decision) -> Text:
    style = {"enter": "bold green", "nothing to enter": "bold green", "do not enter": "bold red"}
    headline = (decision.headline, style.get(decision.answer, "bold yellow"))
    return Text.assemble(headline, f" {decision.reason}")


def _how(calibration: Calibration) -> str:
    """How to enter what the table lists, and what ± is."""
    decision = decide(calibration)
    spread = (
        "±: one standard deviation of all that is not known, the machine's other errors at their "
        "tolerances."
    )
    unstated = decision.of_kind("controller not stated")
    if decision.answer == "nothing to enter":
        return spread
    if unstated:
        return f"{unstated[0].text} {unstated[0].action} {spread}"
    falling = [d.name for d in calibration.robot.drives if d.direction < 0]
    way = ""
    if falling:
        one = len(falling) == 1
        way = (
            f"{joined(falling)} {'counts' if one else 'count'} down in the controller: there "
            f"{'its joint' if one else 'their joints'} must show so much less, not more (`orthocal "
            "export --to linuxcnc --offsets` writes the lines). "
        )
    return f"Enter the whole offset, in place of the active one. {way}{spread}"


def _at_tool(calibration: Calibration, decision: Decision) -> list[RenderableType]:
    """What the tool will be good for, in µm."""
    unreached = decision.of_kind("out of reach")
    found = decision.of_kind("at the tool")
    if unreached:
        return [Text(unreached[0].text)]
    if not found:
        return [Text("What the tool is good for cannot be told: nothing tells the noise.")]
    n = found[0].numbers
    where = assess_tool(calibration).workspace.words
    kept = decision.answer == "nothing to enter"
    expected = _um(n["expected_as_it_is_um" if kept else "expected_um"])
    instead = "as it is" if kept else f"instead of {_um(n['expected_as_it_is_um'])} µm as it is"
    absolute = "" if kept else f"; absolute, expect {_um(n['expected_absolute_um'])} µm"
    text = (
        f" with these entered, {instead}" if not kept else f" {instead}"
    ) + f" (r.m.s. over {where}, shift and rotation taken out, as a workpiece sees it that is "
    text += f"aligned on the machine{absolute})."
    if n["times_tolerances"] > 1.0:
        text += (
            f" Errors that were not identified are taken at {n['times_tolerances']:.1f} times "
            "their tolerances, for what remains of the readings."
        )
    if not calibration.only_offsets:
        text += f" In a controller that knows all errors: {_um(n['all_errors_known_um'])} µm."
    return [Text.assemble("At the tool expect ", (f"{expected} µm", "bold"), text)]


def _um(value: float) -> str:
    return plain(value, 0 if abs(value) >= 20.0 else 1)


def _suspicious(decision: Decision) -> list[RenderableType]:
    """Suspicious readings by file and line; not those that a graver finding explains."""
    found = decision.of_kind("suspicious reading")
    if decision.of_kind("wrong size"):
        return []
    turned = {p.setup for f in decision.of_kind("turned setup") for p in f.places}
    found = tuple(f for f in found if f.places[0].setup not in turned)
    if not found:
        return []
    file = found[0].places[0].file
    where = "" if file is None else f", in {short_name(file, LONGEST_PATH)}"
    more = len(found) - MOST_SUSPICIOUS
    return [
        Text(f"Suspicious readings (none was left out){where}:"),
        *_indented(*(Text(_suspicion(f)) for f in found[:MOST_SUSPICIOUS])),
        *(_indented(Text(f"and {more} more")) if more > 0 else []),
    ]


def _suspicion(finding: Finding) -> str:
    n, place = finding.numbers, finding.places[0]
    line = "" if place.line is None else f"line {place.line}: "
    cycle = f", cycle {n['cycle']:.0f}" if n["cycle"] > 1 else ""
    label = short_name(f"{place.setup} {place.posture}", LONGEST_LABEL)
    read, expected = signed(n["measured_mm"]), signed(n["expected_mm"])
    if read == expected:
        return f"{line}{label}{cycle}: read {read} mm; the fit gives way, all others say otherwise"
    return f"{line}{label}{cycle}: read {read} mm, expected {expected} mm"


def _further(calibration: Calibration, decision: Decision) -> list[Finding]:
    """What else is to be known before anything is entered, the gravest first."""
    decided = decision.reason
    found = [
        f
        for f in decision.findings
        if (f.severity != "informs" or f.kind in FURTHER)
        and f.kind != "suspicious reading"
        and f.text != decided
    ]
    if not shows_entries(decision) or decision.of_kind(*TOUCHES_NOTHING):
        found = [f for f in found if f.kind != "may stay"]
    if calibration.only_offsets:  # they leave out more than that
        found = [f for f in found if f.kind != "line in the air"]
    if decision.of_kind("turned setup"):
        found = [f for f in found if f.kind != "suspicious setup"]
    return found[:MOST_FURTHER]


def _indented(*parts: RenderableType) -> list[RenderableType]:
    return [Padding(part, (0, 0, 0, 2)) for part in parts]
