"""Tool errors over a region, as tables, CSV and JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.arrays import Array
from orthocal.assessment.assess import assessment_of, changes_offsets
from orthocal.assessment.effect_limits import DETERMINED
from orthocal.assessment.remaining_errors import RemainingError, find_remaining_errors
from orthocal.assessment.tool_error import (
    ToolAccuracy,
    ToolErrorStatistics,
    assess_tool,
    summarise_tool,
)
from orthocal.assessment.wording import name_offsets, tool_mm, um
from orthocal.assessment.words.entries import (
    describe_compensated,
    describe_tool_error,
    describe_use,
    describe_use_parts,
)
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.refit import restore_session
from orthocal.errors import ClosureError, OrthocalError, RobotError
from orthocal.estimation.selection import complete_model, select_parameters
from orthocal.io.documents import format_json
from orthocal.output.text.conditions import describe_conditions_of
from orthocal.output.text.layout import noted, table_of
from orthocal.units import MM, UM, read_limit

if TYPE_CHECKING:
    from orthocal.planning.sensor_gains import SensorGain

POINT_COLUMNS = (
    *("x_mm", "y_mm", "z_mm"),
    *("absolute_x_um", "absolute_y_um", "absolute_z_um"),
    *("std_x_um", "std_y_um", "std_z_um"),
)
"""Commanded tool position; absolute error, actual less commanded; its standard deviation."""

ABSOLUTE_NOTE = (
    "Errors are absolute: actual less commanded position, without alignment of the workpiece on "
    "the machine. The tool error over the workspace, after this alignment:\n"
    "  orthocal accuracy {}"
)
"""Note beside the errors at points; {} is the calibration."""

FIRMWARE_NOTE = (
    "Settings of the firmware correct a part of this error. `orthocal export` states them with the "
    "errors to expect."
)
"""Note on the tool error of a printer, which has no offsets to enter."""

COLUMNS_NOTE = (
    "RMS, 95 % and worst point: workpiece aligned on the machine (translation and rotation "
    "removed). The last two columns are RMS without this alignment."
)

UNCERTAINTY_NOTE = (
    "Uncertainty: RMS in space. Errors that were not identified are included with their tolerances"
    "{}."
)
"""Note about the uncertainties; {} is the tolerance scale in words, or empty."""

HELPFUL = 0.1
"""Relative reduction of a tool error by which a sensor helps."""

NOTICEABLE = 0.02
"""Relative reduction of a tool error below which a sensor is not listed."""

MOST_PARTS = 5
"""Largest number of parameters that are listed of a combination."""


@dataclass(frozen=True, slots=True)
class FurtherHour:
    """Expected tool errors after another hour with each usual sensor, all errors corrected."""

    rms: float
    """Without it, [m]; NaN where it cannot be computed."""
    gains: tuple[SensorGain, ...]


def render_tool(calibration: Calibration, further: FurtherHour) -> RenderableType:
    """Tool errors over the workspace."""
    try:
        return render_accuracy(calibration, assess_tool(calibration), further)
    except (ClosureError, RobotError) as e:
        return Text(f"The tool error cannot be computed: {e}.")


def render_accuracy(
    calibration: Calibration, accuracy: ToolAccuracy, further: FurtherHour
) -> RenderableType:
    """Tool errors over a region.

    Args:
        calibration: The calibration.
        accuracy: Its tool errors.
        further: Expected tool errors after another hour.
    """
    rows = [("identified error, now", accuracy.measure(accuracy.deviation))]
    if changes_offsets(calibration):
        entered = accuracy.measure(accuracy.deviation_with_entries)
        rows.append(("identified error, offsets entered", entered))
    rows.append(("uncertainty before calibration", accuracy.before.sizes))
    if accuracy.after is not None:
        rows.append(("uncertainty after calibration", accuracy.after.sizes))
    cells = []
    for name, sizes in rows:
        a = sizes.aligned
        aligned = (None,) * 3 if a is None else (a.rms, a.percentile_95, a.largest)
        values = (*aligned, sizes.relative.rms, sizes.absolute.rms)
        cells.append((name, *("" if v is None else um(v) for v in values)))
    headers = ("[µm]", "RMS", "95 %", "worst point", "translation removed", "absolute")
    decision, first = assessment_of(calibration).decision, list[str]()
    if decision.verdict != "enter":
        first.append(f"{decision.headline} {decision.reason}".rstrip())
    notes = [f"Over {accuracy.workspace.words}. {COLUMNS_NOTE}"]
    if accuracy.use.declared is None:
        notes.append(describe_conditions_of(calibration, accuracy.use.conditions[0]))
    if accuracy.after is None:
        notes.append(
            "The uncertainty after calibration is unknown, because the noise of the readings is."
        )
    else:
        if decision.verdict == "enter":
            first += _describe_expected(calibration, accuracy)
        scale = calibration.tolerance_scale.factor
        scaled = f", after the calibration times {scale:.1f}" if scale > 1.0 else ""
        notes.append(UNCERTAINTY_NOTE.format(scaled))
        notes += describe_remaining(find_remaining_errors(calibration, accuracy, count=2))
        notes += describe_gains(further.gains, further.rms, now=False)
    return Group(*map(Text, first), noted(table_of(headers, cells), *notes))


def _describe_expected(calibration: Calibration, accuracy: ToolAccuracy) -> list[str]:
    """Expected tool errors over a region and their conditions of use, as sentences."""
    summary = summarise_tool(calibration, accuracy)
    if summary is None:
        return []
    texts = [describe_tool_error(summary, keep=assessment_of(calibration).keeps_offsets)]
    if calibration.session.firmware is not None:
        texts = [FIRMWARE_NOTE]
    if not calibration.only_offsets:
        texts.append(describe_compensated(summary.compensated))
    if summary.use is not None:
        texts.append(f"Averaged over the conditions of use: {describe_use(summary.use.stated)}.")
        texts += describe_use_parts(summary)
    return texts


def describe_undetermined(
    calibration: Calibration, further: FurtherHour | None = None
) -> list[str]:
    """Offsets that the readings do not determine, and the sensor that helps, as sentences.

    Args:
        calibration: The calibration.
        further: Expected tool errors after another hour; by default computed if needed.
    """
    drives = [d.name for d in calibration.robot.drives]
    free = {p.name: p for p in calibration.free if p.prior}
    offsets = {d: free[f"{d}.offset"] for d in drives if f"{d}.offset" in free}
    unknown = [d for d, p in offsets.items() if p.std > DETERMINED * p.prior_std]
    if not unknown:
        return []
    further = expect_further_hour(calibration) if further is None else further
    offset = name_offsets(unknown, firmware=calibration.session.firmware is not None)
    return [describe_remedy(offset, further.gains, further.rms)]


def describe_remedy(offsets: str, gains: Iterable[SensorGain], rms: float) -> str:
    """Offsets that readings do not determine, and the sensor that helps most, as sentences.

    Args:
        offsets: Noun phrase for the offsets.
        gains: Expected tool errors after another hour with each sensor.
        rms: Expected tool error now, [m].
    """
    helpful, remedy = helpful_gains(gains, rms, HELPFUL), "Plan more time or setups."
    if helpful:
        best = helpful[0]
        remedy = f"Another hour with {best.words} would reduce the error to {tool_mm(best.rms)}."
    return f"These readings do not determine {offsets}. {remedy}"


def expect_further_hour(
    calibration: Calibration, accuracy: ToolAccuracy | None = None
) -> FurtherHour:
    """Expected tool errors after another hour with each usual sensor, all errors corrected.

    To first order about the nominal machine. No gains where they cannot be computed.

    Args:
        calibration: The calibration.
        accuracy: Its tool errors over a stated region or under stated conditions; by default the
            workspace of the robot and its conditions of use.
    """
    from orthocal.planning.expected_error import ToolForecast, state_noise
    from orthocal.planning.sensor_gains import find_sensor_gains

    nothing = FurtherHour(math.nan, ())
    if calibration.only_offsets:
        return nothing
    session = restore_session(calibration)
    parameters, scale = session.robot.parameters, calibration.tolerance_scale
    selection = select_parameters(
        parameters, model=complete_model(parameters), tolerance_scale=scale
    )
    use = None if accuracy is None else accuracy.use
    workspace = None if accuracy is None else accuracy.workspace.once(accuracy.use.size)
    try:
        session = state_noise(session)
        forecast = ToolForecast(session.robot, selection, workspace, use=use)
        expected = forecast.about_nominal(session)
        gains = find_sensor_gains(forecast, session, expected)
    except OrthocalError:  # the noise of the readings is unknown, or no drives command the tool
        return nothing
    return FurtherHour(expected.reported.rms, gains)


def helpful_gains(gains: Iterable[SensorGain], rms: float, least: float) -> list[SensorGain]:
    """Sensors with which an hour reduces a tool error by a fraction, at least."""
    return [gain for gain in gains if gain.rms < (1.0 - least) * rms]


def describe_gains(gains: Iterable[SensorGain], rms: float, *, now: bool = True) -> list[str]:
    """Tool errors after another hour with each sensor that helps, in a sentence.

    Args:
        gains: Gains of the sensors.
        rms: Expected tool error without them, [m].
        now: Whether to state that error; beside that of a calibration, which is about the
            calibrated machine, it would be another number for the same.
    """
    shown = tool_mm(rms)
    helpful = [g for g in helpful_gains(gains, rms, NOTICEABLE) if tool_mm(g.rms) != shown]
    if not helpful:
        return []
    each = "; ".join(f"{tool_mm(gain.rms)} with {gain.words}" for gain in helpful)
    without = f" (now {shown})" if now else ""
    return [f"Another hour, with all errors corrected: {each}{without}."]


def describe_remaining(errors: Iterable[RemainingError]) -> list[str]:
    """Combinations of errors with the largest remaining tool errors, one per line."""
    lines = []
    for error in errors:
        parts = ", ".join(
            f"{name} {read_limit(size):+.2f}" for name, size in error.parts[:MOST_PARTS]
        )
        if error.rms > UM:
            size = f"may still move the tool by {um(error.rms)} µm RMS"
            which = f"These errors together {size}; in tolerances: {parts}."
            lines.append(which if parts else f"Errors that were not determined {size}.")
    return lines


def format_points(rows: Array) -> str:
    """Absolute error and standard deviation at points as lines of CSV with POINT_COLUMNS, µm.

    Args:
        rows: Commanded position, deviation and its standard deviation, shape (K, 9), [m]; NaN for
            unknown values.
    """
    lines = []
    for row in rows:
        numbers = [f"{round(v / MM, 6) + 0.0:.9g}" for v in row[:3]]
        numbers += [f"{v / UM:.3f}" for v in row[3:]]
        lines.append(",".join("" if n == "nan" else n for n in numbers) + "\n")
    return "".join(lines)


def accuracy_json(calibration: Calibration, accuracy: ToolAccuracy) -> str:
    """Tool errors over a region as JSON, SI units."""

    def sizes(field: ToolErrorStatistics) -> dict[str, Any]:
        forms = {"aligned": field.aligned, "relative": field.relative, "absolute": field.absolute}
        return {form: size and size.to_document() for form, size in forms.items()}

    after = accuracy.after
    document = {
        "schema": "orthocal/accuracy/3",
        "robot": calibration.robot_record.name,
        "model": calibration.model,
        "points": len(accuracy.points),
        "box": None if accuracy.workspace.box is None else accuracy.workspace.box.tolist(),
        "deviation": sizes(accuracy.measure(accuracy.deviation)),
        "offsets_entered": sizes(accuracy.measure(accuracy.deviation_with_entries)),
        "uncertainty_before": sizes(accuracy.before.sizes),
        "uncertainty_after": None if after is None else sizes(after.sizes),
        "decision": assessment_of(calibration).decision.to_document(),
    }
    return format_json(document)
