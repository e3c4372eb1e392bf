"""The command export: a calibration for controllers and other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthocal.cli.options import CalibrationPath, app, read_numbers, read_vector
from orthocal.cli.printing import put_note
from orthocal.units import DRIVE_UNITS, MM, UM

if TYPE_CHECKING:
    from orthocal.calibration.calibration import Calibration


@app.command()
def export(
    calibration: CalibrationPath,
    to: Annotated[
        str,
        typer.Option(
            metavar="FORMAT",
            help="yaml: parameters with their units; table: corrections of the tool over a grid; "
            "urdf: the calibrated machine as a robot directory; linuxcnc: HOME_OFFSET, or a "
            "kinematics module if the calibration identified more than offsets.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Directory for the files; created if needed.")],
    within: Annotated[
        float | None,
        typer.Option(
            metavar="UM",
            help="linuxcnc: largest error of a module at the tool, µm; default 0.1.",
        ),
    ] = None,
    tool: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="linuxcnc: tip of the tool for a module, in the frame of the tool centre point, "
            "mm; default 0,0,0.",
        ),
    ] = None,
    home_offset: Annotated[
        str | None,
        typer.Option(
            metavar="VALUES",
            help="linuxcnc: HOME_OFFSET of each joint during the measurement, separated by commas, "
            "mm or degrees; without it the files contain changes only.",
        ),
    ] = None,
    half_side_mm: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="linuxcnc: half the side of a module's region around the zero; by default the "
            "workspace.",
        ),
    ] = None,
    module: Annotated[
        bool | None,
        typer.Option(
            "--module/--offsets",
            help="linuxcnc: write a module, or HOME_OFFSET only, whatever was identified.",
        ),
    ] = None,
    anyway: Annotated[
        bool, typer.Option("--anyway", help="Export even if the decision is not to enter.")
    ] = False,
) -> None:
    """Write a calibration for a controller or another program.

    Exit code 3: the decision is not to enter the calibration, or the machine does not reach the
    requested region or tolerance. Nothing is written then.
    """
    from orthocal.calibration.file import load_calibration
    from orthocal.export.formats import export_calibration
    from orthocal.export.linuxcnc.export import ExportOptions
    from orthocal.io.files import write_files

    result = load_calibration(calibration)
    options = ExportOptions(
        within=None if within is None else within * UM,
        tool=None if tool is None else read_vector(tool, "--tool"),
        home_offsets=None if home_offset is None else _home_offsets(home_offset, result),
        half_side=None if half_side_mm is None else half_side_mm * MM,
        module=module,
    )
    files = export_calibration(result, to, anyway=anyway, options=options)
    write_files(out, files)
    put_note(f"Wrote {' and '.join(str(out / name) for name in files)}")


def _home_offsets(text: str, calibration: Calibration) -> tuple[float, ...]:
    """HOME_OFFSET of each joint, [m, rad]."""
    drives = calibration.robot.drives
    values = read_numbers(text, "--home-offset", [d.name for d in drives])
    return tuple(v * DRIVE_UNITS[d.unit][1] for v, d in zip(values, drives, strict=True))
