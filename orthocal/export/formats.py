"""Export of a calibration by format, with the formats yaml (parameters) and table (corrections)."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from functools import partial

import yaml

from orthocal.assessment.assess import assessment_of
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.assessment.controller_entries import entered_offsets, find_entries
from orthocal.assessment.wording import describe_refusal
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ExportError, ParameterError
from orthocal.export.correction_field import command_points
from orthocal.export.linuxcnc.export import OPTIONS, ExportOptions, export_linuxcnc
from orthocal.export.printer import export_printer
from orthocal.export.tool_tip import ToolTip
from orthocal.export.urdf import export_urdf
from orthocal.kinematics.workspace import uniform_grid
from orthocal.printers.firmwares import FIRMWARES
from orthocal.units import MM, format_fixed, tidy

POINTS_PER_SIDE = 7
"""Number of points along each side of the table's grid."""

_YAML_HEAD = """\
# Identified errors of the machine, relative to the nominal robot.
# `offsets to enter` are those for a controller that corrects offsets of its drives only.
"""


def export_parameters(calibration: Calibration) -> dict[str, str]:
    """Text of errors.yaml: parameters with their units, and the offsets to enter as a comment.

    `orthocal simulate --errors` reads the file.
    """
    errors = {
        f"{p.name}_{p.edge_unit}": tidy(p.value * p.edge_factor) for p in calibration.parameters
    }
    enter = [
        f"#   {e.drive}_{e.edge_unit}: {tidy(e.enter * e.edge_factor)}"
        for e in find_entries(calibration)
    ]
    stated = calibration.session.controller_offsets is not None
    meaning = "offsets to enter" if stated else "changes of the offsets, which are not stated"
    comment = "\n".join([f"# {meaning}:", *enter, ""]) if enter else ""
    text = yaml.safe_dump({"errors": errors}, sort_keys=False, default_flow_style=False)
    return {"errors.yaml": f"{_YAML_HEAD}{comment}{text}"}


def export_corrections(calibration: Calibration) -> dict[str, str]:
    """Text of corrections.csv: corrections of the tool over a grid, for a nominal controller.

    The point to command is p + d, with d as in `command_points` for the offsets to enter.

    Raises:
        ExportError: If the drives do not command a tool, or the machine does not reach the grid.
    """
    tool, robot = find_tool(calibration), calibration.robot
    if tool is None or robot.tcp is None:
        raise ExportError("the machine has no tool that its drives command over a region")
    points = uniform_grid(robot, tool.workspace.limits, points_per_side=POINTS_PER_SIDE)
    commanded, refused = command_points(ToolTip(calibration), entered_offsets(calibration), points)
    for reason in refused.values():
        raise ExportError(
            f"the calibrated machine does not reach every point of the grid: {reason}"
        )
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    names = ["xyz"[k] for k in robot.tcp.coordinates]
    rows.writerow([*(f"{n}_mm" for n in names), *(f"d{n}_mm" for n in names)])
    for point, correction in zip(points / MM, (commanded - points) / MM, strict=True):
        rows.writerow(
            [*(format_fixed(v, 3) for v in point), *(format_fixed(v, 6) for v in correction)]
        )
    return {"corrections.csv": text.getvalue()}


EXPORTERS: dict[str, Callable[[Calibration], dict[str, str]]] = {
    "yaml": export_parameters,
    "table": export_corrections,
    "urdf": export_urdf,
}
"""Formats without options: functions from a calibration to texts of files by file name."""

EXPORTERS |= {name: partial(export_printer, firmware=name) for name in FIRMWARES}

FORMATS = (*EXPORTERS, "linuxcnc")

OF_OFFSETS = ("table", "linuxcnc")
"""Formats for a controller with offsets of the drives."""


def require_format(to: str) -> None:
    """Refuse a name that is no format.

    Raises:
        ParameterError: If the format is unknown; lists the formats.
    """
    if to not in FORMATS:
        raise ParameterError(f"found '{to}'; expected one of {', '.join(FORMATS)}", where="--to")


def export_calibration(
    calibration: Calibration,
    to: str,
    *,
    anyway: bool = False,
    options: ExportOptions | None = None,
) -> dict[str, str]:
    """Export a calibration as files for a controller or another program.

    Args:
        calibration: The calibration.
        to: Name of the format.
        anyway: Whether to export a calibration with the verdict review or reject, with a warning
            in the files.
        options: Options of the format.

    Returns:
        Texts of files by file name.

    Raises:
        ParameterError: If the format is unknown, does not have an option, or does not apply to the
            firmware of a printer.
        ExportError: If the verdict is review or reject, or the machine does not reach the region of
            the format.
    """
    require_format(to)
    if to in OF_OFFSETS:
        require_offsets(calibration, where="--to")
    if not anyway:
        require_entering(calibration)
    options = options or ExportOptions()
    if to not in EXPORTERS:
        files = export_linuxcnc(calibration, options)
        files = _add_warning(files, note_wrong_order(calibration))
    elif options.requested:
        raise ParameterError(
            "is an option of --to linuxcnc only", where=OPTIONS[options.requested[0]]
        )
    else:
        files = EXPORTERS[to](calibration)
    return _add_warning(files, warn_against_verdict(calibration))


def require_offsets(calibration: Calibration, *, where: str) -> None:
    """Refuse a printer, whose firmware has settings instead of offsets.

    Args:
        calibration: The calibration.
        where: Option or file that requires offsets, for the message.

    Raises:
        ParameterError: If the session states the settings of a firmware.
    """
    firmware = calibration.session.firmware
    if firmware is not None:
        raise ParameterError(
            "the calibration is that of a printer, whose firmware has settings instead of offsets: "
            f"`orthocal export --to {firmware.firmware}` writes them. After they are entered, "
            "probe again, and `orthocal import` the new log",
            where=where,
        )


def require_entering(calibration: Calibration) -> None:
    """Refuse a calibration with the verdict review or reject.

    Raises:
        ExportError: If the verdict is not `enter`.
    """
    assessment = assessment_of(calibration)
    if assessment.decision.verdict != "enter":
        raise ExportError(describe_refusal(assessment))


def note_wrong_order(calibration: Calibration) -> str:
    """Note that the present offsets may be those of an earlier session; empty otherwise."""
    return " ".join(f.words for f in assessment_of(calibration).of_kind("wrong order"))


def warn_against_verdict(calibration: Calibration) -> str:
    """Warning written with a calibration whose verdict is review or reject; empty otherwise."""
    verdict = assessment_of(calibration).decision.verdict
    if verdict == "enter":
        return ""
    return f"Written against the verdict '{verdict}' of the calibration (--anyway)."


def _add_warning(files: dict[str, str], warning: str) -> dict[str, str]:
    """Files with a warning, if it is not empty, at the beginning of each one that has comments."""
    if not warning:
        return files
    commented = {n: f"# {warning}\n{t}" for n, t in files.items() if n.endswith((".yaml", ".ini"))}
    files = {**files, **commented}
    if "errors.yaml" in files:
        return files
    page = files.get("README.md", "")
    return {**files, "README.md": f"**{warning}**\n" + (f"\n{page}" if page else "")}
