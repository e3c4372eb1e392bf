"""What others take: export."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthocal.cli.options import CalibrationPath, app
from orthocal.cli.printing import put_note
from orthocal.errors import ParameterError
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
            "urdf: the calibrated machine as a robot folder; linuxcnc: HOME_OFFSET, or a "
            "kinematics module where more than offsets was identified.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the files; made if need be.")],
    within: Annotated[
        float | None,
        typer.Option(
            metavar="UM",
            help="linuxcnc: by how much a module may miss the calibrated machine's tool, µm; 0.1 "
            "by default.",
        ),
    ] = None,
    tool: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="linuxcnc: the tip that a module is made for, in the frame of the tool centre "
            "point, mm; 0,0,0 by default.",
        ),
    ] = None,
    home_offset: Annotated[
        str | None,
        typer.Option(
            metavar="VALUES",
            help="linuxcnc: HOME_OFFSET of each joint while measuring, with commas between, mm or "
            "degrees; without them the change alone is told.",
        ),
    ] = None,
    half_side_mm: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="linuxcnc: half the side of a module's region around the zero; by default the "
            "largest that the machine reaches, of 60 mm at most.",
        ),
    ] = None,
    module: Annotated[
        bool | None,
        typer.Option(
            "--module/--offsets",
            help="linuxcnc: a module, or HOME_OFFSET alone, whatever was identified.",
        ),
    ] = None,
    anyway: Annotated[
        bool, typer.Option("--anyway", help="Also against the verdict of the calibration.")
    ] = False,
) -> None:
    """Write a calibration for a controller or for another program.

    Exit code 3: the verdict is not to enter it, or the machine cannot be what was asked; nothing
    was written.
    """
    from orthocal.calibration.file import load_calibration
    from orthocal.export.formats import export_calibration
    from orthocal.export.options import ExportOptions
    from orthocal.io.files import write_files

    result = load_calibration(calibration)
    tip = None if tool is None else _numbers(tool, "--tool", count=3)
    options = ExportOptions(
        within=None if within is None else within * UM,
        tool=None if tip is None else (tip[0] * MM, tip[1] * MM, tip[2] * MM),
        home_offsets=None if home_offset is None else _home_offsets(home_offset, result),
        half_side=None if half_side_mm is None else half_side_mm * MM,
        module=module,
    )
    files = export_calibration(result, to, anyway=anyway, options=options)
    write_files(out, files)
    put_note(f"Wrote {' and '.join(str(out / name) for name in files)}")


def _home_offsets(text: str, calibration: Calibration) -> tuple[float, ...]:
    """In SI, by the unit of each drive."""
    drives = calibration.robot.drives
    values = _numbers(text, "--home-offset", count=len(drives))
    return tuple(v * DRIVE_UNITS[d.unit][1] for v, d in zip(values, drives, strict=True))


def _numbers(text: str, option: str, *, count: int) -> list[float]:
    """Numbers with commas between."""
    example = ",".join(["0"] * count)
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        raise ParameterError(
            f"found '{text}'; expected {count} numbers with commas between, as {example}",
            where=option,
        )
    return values
