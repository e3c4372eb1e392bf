"""Wording of findings about what to enter, and of the decision."""

from __future__ import annotations

from collections.abc import Sequence

from orthocal.assessment.wording import joined, lengths, named, note
from orthocal.calibration.assessment_record import Finding, ToolErrorSummary, Verdict
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
    """Neither an offset nor the tool error differs significantly from its present value."""
    numbers = {"largest_change_over_std": ratio}
    too = ""
    if tool is not None:
        numbers |= {"now_um": tool.now / UM, "entered_um": tool.entered / UM}
        too = ", and entering them does not change the expected tool error significantly"
    return note(
        "no change needed",
        f"No offset differs significantly from its present value{too}.",
        "",
        named(*drives),
        **numbers,
    )


def must_change(drives: Sequence[str]) -> Finding:
    """Offsets that differ significantly from their present value."""
    return note(
        "must change",
        f"Significantly different from the present value: {joined(drives)}.",
        "",
        named(*drives),
    )


def not_significant(drives: Sequence[str]) -> Finding:
    """Offsets that do not differ significantly from their present value."""
    verb = "does" if len(drives) == 1 else "do"
    noun = "its present value" if len(drives) == 1 else "their present values"
    return note(
        "not significant",
        f"{joined(drives)} {verb} not differ significantly from {noun}.",
        "",
        named(*drives),
    )


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
    where = f"workspace {tool.region}, workpiece aligned on the machine"
    if keep:
        (now,) = lengths(tool.now)
        return f"Expected tool error with the present offsets: {now} RMS, {where}."
    entered, now = lengths(tool.entered, tool.now)
    return f"Expected tool error: {entered} RMS (now {now}), {where}."


def describe_compensated(rms: float) -> str:
    """The expected tool error with a controller that corrects all identified errors."""
    (size,) = lengths(rms)
    return f"With a controller that corrects all errors: {size} RMS."


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
