"""Wording of findings about values to enter, and of the decision."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from orthocal.assessment.controller_entries import ScrewEntry
from orthocal.assessment.wording import counted, joined, note, parameter_places, tool_mm
from orthocal.assessment.words.anomalies import MAX_PLACES, place_of
from orthocal.calibration.assessment_record import (
    Assessment,
    Finding,
    ToolErrorSummary,
    Verdict,
)
from orthocal.kinematics.conditions import StatedUse
from orthocal.measurement.files.readings_checks import describe_missing
from orthocal.robot.model import Drive, drive_keys
from orthocal.session.points import count_readings
from orthocal.session.session import Session
from orthocal.text import capitalised, percent
from orthocal.units import UM, format_fixed

HEADLINES: dict[Verdict, str] = {
    "enter": "Enter these offsets, then measure again.",
    "review": "Check these readings before you enter anything.",
    "reject": "Do not enter offsets from these readings.",
}
"""Headlines of the verdicts on a calibration."""

FIRMWARE_HEADLINES: dict[Verdict, str] = {
    "enter": "Write new settings for the firmware, then probe again.",
    "review": "Check these points before you write new settings.",
    "reject": "Write no settings from this log.",
}
"""Headlines of a calibration of a printer, whose firmware has settings beside offsets."""

FIRMWARE_KEEP_HEADLINE = "Leave the settings as they are."
"""Headline of a calibration of a printer that changes no setting."""

FIRMWARE_STEP = "`orthocal export` writes the settings."
"""Next step after the calibration of a printer."""

CHOICE_HEADLINE = "Enter these offsets, or correct all identified errors."
"""Headline of a calibration that measured again: both are possible now."""

CHOICE_STEP = (
    "Choose one: enter these offsets; or leave the present ones, and correct all identified errors "
    "in LinuxCNC or in programs."
)
"""Next step of such a calibration."""

KEEP_HEADLINE = "Leave the offsets as they are."
"""Headline of a calibration that changes no offset."""

NOTHING_HEADLINE = "Nothing to enter: no offset was identified."
"""Headline of a calibration without offsets."""

BACKLASH_HEADLINE = "Enter the backlash."
"""Addition to the headline of a calibration that changes no offset."""

SESSION_HEADLINES: dict[Verdict, str] = {
    "enter": "No anomaly found.",
    "review": "Check these readings first.",
    "reject": "These readings cannot be used.",
}
"""Headlines of the verdicts on readings."""

COMPENSATED = {"backlash": "backlash", "screw": "periodic errors of screws"}
"""Nouns for what a controller compensates, by the name of the effect."""

NEXT_STEP = "`orthocal again` makes the session that measures again, `orthocal validate` judges it."
"""Next step after the offsets are entered."""


def no_anomaly(readings: int, *, within_tolerances: bool) -> Finding:
    """Finding about readings that show no anomaly.

    Args:
        readings: Number of readings, at least 1.
        within_tolerances: Whether errors within the tolerances explain the readings.
    """
    machine = "with a machine within its tolerances"
    if readings > 1:
        agreement = f"with each other and {machine}" if within_tolerances else "with each other"
        text = f"The {counted(readings, 'reading')} agree {agreement}."
    elif within_tolerances:
        text = f"The reading agrees {machine}."
    else:
        text = "There is no second reading to compare the reading with."
    return note("no anomaly", text, readings=float(readings))


def readings_missing(session: Session) -> Finding:
    """Finding that some readings are missing."""
    missing = {i: r for i, r in enumerate(session.readings) if not r.is_read}
    return note(
        "readings missing",
        f"{describe_missing(session)}.",
        "Record them with `orthocal record`, or delete their lines there (`drop`).",
        [place_of(session, i) for i in [*missing][:MAX_PLACES]],
        readings=float(count_readings(session)),
        missing=float(count_readings(session, [*missing.values()])),
    )


def no_offset() -> Finding:
    """Finding that no offset was identified."""
    return note("no offset", "No offset was identified.")


def no_change_needed(
    drives: Sequence[str], ratio: float, best: ToolErrorSummary | None, *, share: float
) -> Finding:
    """Finding that the active offsets are kept.

    Args:
        drives: Drives with an offset that could be entered.
        ratio: Largest |change| of these offsets, in standard deviations.
        best: Expected tool error with the best offsets; None if unknown.
        share: Relative reduction of the tool error that is required.
    """
    numbers = {"largest_change_over_std": ratio}
    text = "No offset changes by more than its uncertainty."
    if best is not None:
        numbers |= {"now_um": best.now / UM, "best_um": best.entered / UM}
        text = (
            "Keep the active offsets: others would lower the expected tool error by less than "
            f"{percent(share)}."
        )
    return note("no change needed", text, "", parameter_places(*drives), **numbers)


def settings_change(*, tool: tuple[float, ...], layer: tuple[float, ...], keep: bool) -> Finding:
    """Finding about the errors with the present and with the best settings of a firmware.

    Args:
        tool: Expected tool error with the present and with the best settings, [m].
        layer: Expected height error of the first layer with them, [m].
        keep: Whether the present settings are kept.
    """
    texts = [f"from {tool_mm(now)} to {tool_mm(new)}" for now, new in (layer, tool)]
    head = (
        "Nothing more has to be entered: the best settings would change"
        if keep
        else "New settings change"
    )
    return note(
        "no change needed" if keep else "settings improve",
        f"{head} the expected height error of the first layer {texts[0]}, and the tool error "
        f"{texts[1]}.",
        now_um=tool[0] / UM,
        best_um=tool[1] / UM,
        layer_now_um=layer[0] / UM,
        layer_best_um=layer[1] / UM,
    )


def find_settings_errors(assessment: Assessment) -> tuple[float, float]:
    """Tool error with the present and with the best settings of a firmware, [m]; NaN if unknown."""
    for finding in assessment.findings:
        if "layer_now_um" in finding.numbers:
            return finding.numbers["now_um"] * UM, finding.numbers["best_um"] * UM
    return math.nan, math.nan


def settings_unknown(reason: str) -> Finding:
    """Finding that a calibration determines no settings of a firmware, with the reason."""
    return note("settings unknown", f"{capitalised(reason)}.")


def must_change(drives: Sequence[str]) -> Finding:
    """Finding about offsets that change by more than their uncertainty."""
    return note("must change", _describe_change(drives, "more"), "", parameter_places(*drives))


def not_significant(drives: Sequence[str], *, keep: bool) -> Finding:
    """Finding about offsets that change by less than their uncertainty.

    Args:
        drives: The drives.
        keep: Whether the active offsets are kept.
    """
    text = _describe_change(drives, "less")
    if not keep:
        text += " Enter all offsets together: the tool error depends on all of them."
    return note("not significant", text, "", parameter_places(*drives))


def _describe_change(drives: Sequence[str], compared: str) -> str:
    """Sentence that drives change by more or less than their uncertainty."""
    change, their = ("changes", "its") if len(drives) == 1 else ("change", "their")
    return f"{joined(drives)} {change} by {compared} than {their} uncertainty."


def controller_not_stated(drives: Sequence[str], *, keep: bool, last: str = "") -> Finding:
    """Finding that the values to enter are changes, as the active offsets are not stated.

    Args:
        drives: Drives with a value to enter.
        keep: Whether the active offsets are kept.
        last: Label of the last of several sessions; "" for one session.
    """
    which = f"The last session, {last}," if last else "The session"
    if len(drives) == 1:
        meaning = "The value is a change, not a total offset"
        action = f"Add it to the active offset of {drives[0]}."
    else:
        meaning = "The values are changes, not total offsets"
        action = "Add each to the active offset of its drive."
    return note(
        "controller not stated",
        f"{which} does not state the active offsets (`controller`). {meaning}.",
        "" if keep else action,
    )


def compensation_not_stated(
    sessions: Sequence[str], effects: Sequence[str], drives: Sequence[Drive]
) -> Finding:
    """Finding that a session does not state what its controller compensates.

    Args:
        sessions: Labels of these sessions within a joined one; otherwise an empty label.
        effects: Names of the identified effects that a controller compensates.
        drives: The drives.
    """
    zeros = drive_keys("backlash", drives)
    compensated = joined([COMPENSATED[effect] for effect in effects])
    which = "The session does"
    if all(sessions):
        which = f"Sessions {joined(sessions)} do" if sessions[1:] else f"Session {sessions[0]} does"
    return note(
        "compensation not stated",
        f"{which} not state which {compensated} the controller compensates. It counts as none.",
        f"State it in session.yaml, such as controller: {{{zeros}}} for none"
        f"{', or comp_file for tables' if 'screw' in effects else ''}.",
    )


def periodic_errors(entries: Sequence[ScrewEntry]) -> Finding:
    """Finding about periodic errors of screws that a table of the controller corrects.

    Args:
        entries: Periodic errors of the screws.
    """
    amplitudes = joined(
        [
            f"{e.drive} {format_fixed(float(np.linalg.norm(e.enter)) / UM, 0)} "
            f"±{format_fixed(e.uncertainty / UM, 0)} µm"
            for e in entries
            if e.change.any()
        ]
    )
    return note(
        "periodic errors",
        f"Periodic errors of the screws (amplitude): {amplitudes}. Offsets and BACKLASH do not "
        "correct them.",
        "`orthocal export --to linuxcnc --offsets` writes tables (COMP_FILE) that do.",
    )


def earlier_readings() -> Finding:
    """Finding about active offsets, which may result from readings of another session."""
    return note(
        "earlier readings",
        "The controller had offsets in this session. If they come from earlier readings of this "
        "machine, this answer does not use these readings, and may differ from that of all.",
        "Calibrate both sessions together: that answer counts, unless the machine has changed.",
    )


def describe_tool_error(tool: ToolErrorSummary, *, keep: bool = False, joint: bool = False) -> str:
    """Sentence about the expected tool error, the same in every output.

    Args:
        tool: The tool error.
        keep: Whether the active offsets are kept.
        joint: Whether the values to enter are named as those from all readings.
    """
    backlash = tool.without_backlash is not None
    if keep and not backlash:
        return f"Expected tool error with the active offsets: {tool_mm(tool.now)} RMS."
    offsets, this, source = ("the", "", " from all readings") if joint else ("these", "this ", "")
    named = [] if keep else [f"{offsets} offsets"]
    named += [f"{'the ' if joint and keep else this}backlash"] if backlash else []
    entered = " and ".join(named) + source
    return (
        f"Expected tool error with {entered}: {tool_mm(tool.entered)} RMS "
        f"(now {tool_mm(tool.now)})."
    )


def describe_compensated(rms: float) -> str:
    """Sentence about the tool error with a controller that corrects all identified errors.

    Args:
        rms: RMS of that tool error, [m].
    """
    return f"With all identified errors corrected: {tool_mm(rms)}."


def describe_region(tool: ToolErrorSummary) -> str:
    """Sentence about workspace, alignment and conditions of use of tool errors."""
    use = None if tool.use is None else tool.use.stated
    return describe_aligned(f"the workspace {tool.region}", use)


def describe_aligned(region: str, use: StatedUse | None) -> str:
    """Sentence about the alignment of tool errors over a region under conditions of use."""
    under = "" if use is None else f", {describe_use(use)}"
    return f"RMS over {region}, workpiece aligned on the machine{under}."


def describe_use(use: StatedUse) -> str:
    """Conditions of use, separated by commas."""
    parts = []
    approach, temperature, payload = use["approach"], use["temperature"], use["payload"]
    if approach is not None:
        both = not approach.strip("u")
        parts.append("approaches from both sides" if both else f"approach {approach}")
    if temperature is not None:
        parts.append(f"{_describe_range(temperature)} °C")
    if payload is not None:
        heaviest = payload[1]
        parts.append(f"payload {_describe_range(payload)} kg" if heaviest else "no payload")
    return ", ".join(parts)


def describe_use_parts(tool: ToolErrorSummary) -> list[str]:
    """Sentences about the part of the tool error that each varying condition of use adds."""
    if tool.use is None:
        return []
    lines = []
    for part in tool.use.parts:
        if part.condition == "approach" and tool.without_backlash is not None:
            present = tool_mm(tool.without_backlash)
            if present != tool_mm(tool.entered):
                lines.append(
                    f"With the backlash that the controller compensates now: {present}, unless all "
                    "positions are approached from one side."
                )
            continue
        without = math.sqrt(max(tool.entered**2 - part.size**2, 0.0))
        added = tool.entered - without
        negligible = added < 0.5 * UM
        amount = "less than 0.001 mm" if negligible else tool_mm(added)
        if part.condition == "approach":
            effects_text = joined([*part.effects]).capitalize()
            verb = "adds" if len(part.effects) == 1 else "add"
            circumstances = " if the tool is used from both sides"
            circumstances += (
                "" if negligible else "; to approach all positions from one side avoids it"
            )
            lines.append(f"{effects_text} {verb} {amount}{circumstances}.")
        elif part.condition == "temperature" and tool.use.temperature is not None:
            lines.append(
                f"Temperatures of {_describe_range(tool.use.temperature)} °C add {amount}."
            )
        elif tool.use.payload is not None:
            lines.append(f"A payload of {_describe_range(tool.use.payload)} kg adds {amount}.")
    return lines


def _describe_range(limits: tuple[float, float]) -> str:
    """Range of a condition, such as "18…25"."""
    low, high = limits
    return f"{low:g}" if low == high else f"{low:g}…{high:g}"


def tool_error(tool: ToolErrorSummary, *, keep: bool) -> Finding:
    """Finding about the expected tool error; `keep` as in `describe_tool_error`."""
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
    """Finding that the tool error cannot be computed, with the reason."""
    return note("out of reach", f"The tool error is unknown: {reason}.")
