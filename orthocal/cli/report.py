"""The command `report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Option

from orthocal.cli.options import CalibrationPath, app
from orthocal.cli.printing import put_note


@app.command()
def report(
    calibration: CalibrationPath,
    out: Annotated[
        Path | None,
        Option(help="Page, or existing directory; default: report.html beside the calibration."),
    ] = None,
) -> None:
    """Write the report of a calibration as a page."""
    from orthocal.calibration.file import load_calibration
    from orthocal.io.files import is_folder, require_writable_file
    from orthocal.output.report.page import write_report

    result = load_calibration(calibration)
    target = out or (Path() if result.path is None else result.path.parent)
    if is_folder(target):
        target = target / "report.html"
    require_writable_file(target, kinds=(".html", ".htm"))
    put_note(f"Wrote {write_report(result, target)}")
