"""The command `report`."""

from __future__ import annotations

from pathlib import Path

import orthocal
from orthocal.cli.options import command
from orthocal.cli.overwriting import require_replaceable_file
from orthocal.cli.printing import put_note
from orthocal.io.files import is_folder


@command()
def report(calibration: Path, out: Path | None = None, force: bool = False) -> None:
    """Write the report of a calibration as a page.

    Args:
        out: Page, or existing directory; default: report.html beside the calibration.
    """
    result = orthocal.load_calibration(calibration)
    target = out or (Path() if result.path is None else result.path.parent)
    if is_folder(target):
        target = target / "report.html"
    require_replaceable_file(target, force=force, kinds=(".html", ".htm"))
    put_note(f"Wrote {orthocal.write_report(result, target)}")
