"""The command `inverse`."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import orthocal
from orthocal.cli.forward import print_transformed
from orthocal.cli.options import UseOptions, command


@command()
def inverse(calibration: Path, targets: Path, *, use: UseOptions) -> None:
    """Print drive coordinates for tool positions, as CSV.

    Drive coordinates are those of the encoders, without any offset of the controller. Tables can
    have any size: rows from a pipe are evaluated in blocks as they arrive.

    Exit code 3: some rows cannot be reached; they are named, and their cells are empty.

    Args:
        targets (TARGETS.csv): Columns of the tool: x_mm, y_mm, z_mm; - for standard input.
    """
    from orthocal.assessment.tool_tables import inverse_blocks
    from orthocal.measurement.files.coordinate_tables import drive_columns, stream_points

    result = orthocal.load_calibration(calibration)
    conditions = use.read(result.robot)
    columns, transform = drive_columns(result.robot), partial(inverse_blocks, conditions=conditions)
    print_transformed(result, targets, stream_points, transform, columns, conditions)
