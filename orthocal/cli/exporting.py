"""What others take: export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from orthocal.cli.options import CalibrationPath, app
from orthocal.cli.printing import put_note


@app.command()
def export(
    calibration: CalibrationPath,
    to: Annotated[
        str,
        typer.Option(
            metavar="FORMAT",
            help="yaml: parameters with their units; table: corrections of the tool over a grid; "
            "urdf: the calibrated machine as a robot folder.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the files; made if need be.")],
    anyway: Annotated[
        bool, typer.Option("--anyway", help="Also where the decision is not to enter it.")
    ] = False,
) -> None:
    """Write a calibration for a controller or for another program.

    Exit code 3: the decision is not to enter it, and nothing was written.
    """
    from orthocal.calibration.file import load_calibration
    from orthocal.export.formats import export_calibration
    from orthocal.files import write_files

    files = export_calibration(load_calibration(calibration), to, anyway=anyway)
    write_files(out, files)
    put_note(f"Wrote {' and '.join(str(out / name) for name in files)}")
