"""Wording of findings about what to enter, and of the decision."""

from __future__ import annotations

import math
from collections.abc import Sequence

from orthocal.assessment.wording import joined, named, note, tool_mm
from orthocal.calibration.assessment_record import Finding, ToolErrorSummary, Verdict
from orthocal.kinematics.conditions import StatedUse
from orthocal.units import UM

HEADLINES: dict[Verdict, str] = {
    "enter": "Enter these offsets, then measure again.",
    "review": "Check these readings before you enter anything.",
    "reject": "Do not enter these offsets.",
}
KEEP = "Leave the offsets as they are."
NOTHING = "Nothing to enter: no offset was identified."

SOUND = "No anomaly found."
SESSION_HEADLINES: dict[Verdict, str] = {
    "enter": SOUND,
    "review": "Check these readings first.",
    "reject": "These readings cannot be used.",
}


def next_step(session: str | None) -> str:
    """Next step after the offsets are entered."""
    return "`orthocal again` makes the session that measures again, `orthocal validate` judges it."


def sound(readings: int, *, within_tolerances: bool) -> Finding:
    """No anomaly was found."""
    noun = "reading agrees" if readings == 1 else "readings agree"
    return note(
        "fits",
        f"The {readings} {noun} with each other"
        + (" and with a machine within its tolerances." if within_tolerances else "."),
        readings=float(readings),
    )


def no_offset() -> Finding:
    """No offset was identified."""
    return note("no offset", "No offset was identified.")


def no_change_needed(drives: Sequence[str], ratio: float, tool: ToolErrorSummary | None) -> Finding:
    """Neither an offset nor the tool error changes by more than its uncertainty."""
    numbers = {"largest_change_over_std": ratio}
    too = ""
    if tool is not None:
        numbers |= {"now_um": tool.now / UM, "entered_um": tool.entered / UM}
        too = ", and the expected tool error would change by less than its uncertainty"
    return note(
        "no change needed",
        f"No offset changes by more than its uncertainty{too}.",
        "",
        named(*drives),
        **numbers,
    )


def must_change(drives: Sequence[str]) -> Finding:
    """Offsets that change by more than their uncertainty."""
    return note(
        "must change",
        f"{_changes(drives)} by more than {_their(drives)} uncertainty.",
        "",
        named(*drives),
    )


def not_significant(drives: Sequence[str]) -> Finding:
    """Offsets that change by less than their uncertainty."""
    return note(
        "not significant",
        f"{_changes(drives)} by less than {_their(drives)} uncertainty. Entering "
        f"{'it' if len(drives) == 1 else 'them'} does no harm.",
        "",
        named(*drives),
    )


def _changes(drives: Sequence[str]) -> str:
    return f"{joined(drives)} {'changes' if len(drives) == 1 else 'change'}"


def _their(drives: Sequence[str]) -> str:
    return "its" if len(drives) == 1 else "their"


def controller_not_stated(drives: Sequence[str]) -> Finding:
    """The session does not state the offsets that were active."""
    return note(
        "controller not stated",
        "The session does not state the offsets that were active (`controller`).",
        f"Add these values to the present offsets of {joined(drives)}.",
    )


def describe_tool_error(tool: ToolErrorSummary, *, keep: bool = False) -> str:
    """The expected tool error in one sentence, the same in every output.

    Args:
        tool: The tool error.
        keep: Whether the offsets stay as they are.
    """
    if keep:
        return f"Expected tool error with the present offsets: {tool_mm(tool.now)} RMS."
    return (
        f"Expected tool error with these offsets: {tool_mm(tool.entered)} RMS "
        f"(now {tool_mm(tool.now)})."
    )


def describe_compensated(rms: float) -> str:
    """The expected tool error with a controller that corrects all identified errors."""
    return f"With all errors corrected: {tool_mm(rms)}."


def describe_region(tool: ToolErrorSummary) -> str:
    """Region, alignment and conditions of use of the tool errors of an answer."""
    use = None if tool.use is None else tool.use.stated
    return describe_aligned(f"the workspace {tool.region}", use)


def describe_aligned(region: str, use: StatedUse | None) -> str:
    """The same for a region and conditions of use."""
    under = "" if use is None else f", {describe_use(use)}"
    return f"RMS over {region}, workpiece aligned on the machine{under}."


def describe_use(use: StatedUse) -> str:
    """Conditions of use."""
    parts = []
    approach, temperature, payload = use["approach"], use["temperature"], use["payload"]
    if approach is not None:
        both = not approach.strip("u")
        parts.append("used from both sides" if both else f"approach {approach}")
    if temperature is not None:
        parts.append(f"{_describe_range(temperature)} °C")
    if payload is not None:
        heaviest = payload[1]
        parts.append(f"payload {_describe_range(payload)} kg" if heaviest else "no payload")
    return ", ".join(parts)


def describe_use_parts(tool: ToolErrorSummary) -> list[str]:
    """What each condition of use that varies adds to the tool error with the offsets entered."""
    if tool.use is None:
        return []
    lines = []
    for part in tool.use.parts:
        without = math.sqrt(max(tool.entered**2 - part.size**2, 0.0))
        added = tool.entered - without
        amount = "less than 0.001 mm" if added < 0.5 * UM else tool_mm(added)
        if part.condition == "approach":
            what = joined([*part.effects]).capitalize()
            verb = "adds" if len(part.effects) == 1 else "add"
            how = " if the tool is used from both sides; approach from one side avoids it"
            lines.append(f"{what} {verb} {amount}{how}.")
        elif part.condition == "temperature" and tool.use.temperature is not None:
            lines.append(
                f"Temperatures of {_describe_range(tool.use.temperature)} °C add {amount}."
            )
        elif tool.use.payload is not None:
            lines.append(f"A payload of {_describe_range(tool.use.payload)} kg adds {amount}.")
    return lines


def _describe_range(limits: tuple[float, float]) -> str:
    low, high = limits
    return f"{low:g}" if low == high else f"{low:g}…{high:g}"


def tool_error(tool: ToolErrorSummary, *, keep: bool) -> Finding:
    """Expected error of the tool."""
    return note(
        "tool error",
        describe_tool_error(tool, keep=keep),
        entered_um=tool.entered / UM,
        now_um=tool.now / UM,
        compensated_um=tool.compensated / UM,
        entered_absolute_um=tool.entered_absolute / UM,
        now_absolute_um=tool.now_absolute / UM,
    )


def out_of_reach(reason: str) -> Finding:
    """The tool error cannot be computed."""
    return note("out of reach", f"The tool error is unknown: {reason}.")
