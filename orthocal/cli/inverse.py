"""The command `inverse`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument

from orthocal.cli.forward import print_transformed
from orthocal.cli.options import CalibrationPath, app


@app.command()
def inverse(
    calibration: CalibrationPath,
    targets: Annotated[
        Path,
        Argument(
            metavar="TARGETS.csv",
            help="Columns of the tool: x_mm, y_mm, z_mm; - for standard input.",
        ),
    ],
) -> None:
    """Print drive coordinates for tool positions, as CSV.

    Drive coordinates are those of the encoders, without any offset of the controller. Tables can
    have any size: rows from a pipe are evaluated in blocks as they arrive.

    Exit code 3: some rows cannot be reached; they are named, and their cells are empty.
    """
    from orthocal.assessment.tool_tables import inverse_blocks
    from orthocal.calibration.file import load_calibration
    from orthocal.measurement.files.coordinate_tables import drive_columns, stream_points

    result = load_calibration(calibration)
    print_transformed(result, targets, stream_points, inverse_blocks, drive_columns(result.robot))
