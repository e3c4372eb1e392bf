"""The command `export`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from typer import Option

from orthocal.cli.options import (
    Anyway,
    CalibrationPath,
    HalfSideMm,
    OutDirectory,
    ToolTip,
    app,
    read_numbers,
    read_vector,
)
from orthocal.cli.printing import write_results
from orthocal.units import DRIVE_UNITS, MM, UM

if TYPE_CHECKING:
    from orthocal.calibration.calibration import Calibration


@app.command()
def export(
    calibration: CalibrationPath,
    to: Annotated[
        str,
        Option(
            metavar="FORMAT",
            help="yaml: parameters with their units; table: corrections of the tool over a grid; "
            "urdf: the calibrated machine as a robot directory; linuxcnc: HOME_OFFSET, or a "
            "kinematics module if the calibration identified more than offsets.",
        ),
    ],
    out: OutDirectory,
    module: Annotated[
        bool | None,
        Option(
            "--module/--offsets",
            help="linuxcnc: write a module, or HOME_OFFSET only; default: by what was identified.",
        ),
    ] = None,
    within: Annotated[
        float | None,
        Option(
            metavar="UM", help="linuxcnc: largest error of a module at the tool, µm; default: 0.1."
        ),
    ] = None,
    half_side_mm: HalfSideMm = None,
    tool: ToolTip = None,
    home_offset: Annotated[
        str | None,
        Option(
            metavar="VALUES",
            help="linuxcnc: HOME_OFFSET of each joint during the measurement, separated by commas, "
            "mm or degrees; without it the files contain changes only.",
        ),
    ] = None,
    anyway: Anyway = False,
) -> None:
    """Write a calibration for a controller or another program.

    --half-side-mm and --tool apply to a module for LinuxCNC.

    Exit code 3: the verdict is not to enter the calibration, or the machine does not reach the
    requested region or tolerance. Nothing is written then.
    """
    from orthocal.calibration.file import load_calibration
    from orthocal.export.formats import export_calibration
    from orthocal.export.linuxcnc.export import ExportOptions

    result = load_calibration(calibration)
    options = ExportOptions(
        within=None if within is None else within * UM,
        tool=None if tool is None else read_vector(tool, "--tool"),
        home_offsets=None if home_offset is None else _home_offsets(home_offset, result),
        half_side=None if half_side_mm is None else half_side_mm * MM,
        module=module,
    )
    write_results(out, export_calibration(result, to, anyway=anyway, options=options))


def _home_offsets(text: str, calibration: Calibration) -> tuple[float, ...]:
    """HOME_OFFSET of each joint, [m, rad]."""
    drives = calibration.robot.drives
    values = read_numbers(text, "--home-offset", [d.name for d in drives])
    return tuple(v * DRIVE_UNITS[d.unit][1] for v, d in zip(values, drives, strict=True))
