"""The same readings once more, after what was identified was entered: again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthocal.cli.options import CalibrationPath, app
from orthocal.cli.printing import put_note, put_out
from orthocal.cli.sheet import sheet_or_nothing
from orthocal.errors import ParameterError, SessionError

if TYPE_CHECKING:
    from orthocal.calibration.calibration import Calibration
    from orthocal.session.session import Session

FILES = ("session.yaml", "readings.csv", "sheet.html")

DIGITS = 7
"""Decimals of an offset, [m, rad]: what is typed is told to 0.1 µm."""


@app.command()
def again(
    calibration: CalibrationPath,
    out: Annotated[Path, typer.Option(help="Folder for the new session; made if need be.")],
    session: Annotated[
        Path | None,
        typer.Option(
            help="Whose setups and postures are read again; by default those of the calibration.",
        ),
    ] = None,
    anyway: Annotated[
        bool, typer.Option("--anyway", help="Also against the verdict of the calibration.")
    ] = False,
) -> None:
    """The same readings once more, with the offsets entered: session, empty readings, sheet.

    Exit code 3: the decision is not to enter them; nothing was written.
    """
    from orthocal.calibration.file import load_calibration
    from orthocal.export.formats import require_entering
    from orthocal.io.files import exists, require_writable
    from orthocal.measurement.files.write_session import write_session

    require_writable(out)
    for name in FILES:
        if exists(out / name):
            raise SessionError("is there already; expected a new folder", where=str(out / name))
    result = load_calibration(calibration)
    if not anyway:
        require_entering(result)
    new = _read_again(result, session)
    comment = (
        "To be measured with these offsets entered: `orthocal record .` in this folder leads "
        "through it,\nor fill in readings.csv; then hold it against the calibration by "
        "`orthocal validate`."
    )
    write_session(new, out, comment=comment, extra=sheet_or_nothing(new), blank=True)
    told = ", ".join(
        f"{d.name} {v * d.edge_factor:+.4f} {d.edge_unit}"
        for d, v in zip(new.robot.drives, new.active_offsets.tolist(), strict=True)
    )
    put_out(
        f"Enter these offsets, home, and measure again: {told}.\n"
        f"  orthocal record {out}\n"
        f"  orthocal validate {calibration} {out}"
    )
    put_note(f"Wrote {out / 'session.yaml'}, readings.csv to fill in, and a sheet")


def _read_again(result: Calibration, given: Path | None) -> Session:
    """The rows of a session, with what was identified active."""
    from orthocal.assessment.controller_entries import entered_offsets
    from orthocal.measurement.files.session_file import load_plan

    file = result.session.path if given is None else str(given)
    if file is None:
        raise ParameterError(
            "is missing: the calibration is of several sessions; which of them is read again?",
            where="--session",
        )
    found = load_plan(file)
    if found.robot.sha256 != result.robot.sha256:
        raise SessionError("is of another robot than the calibration", where=str(file))
    offsets = entered_offsets(result).round(DIGITS) + 0.0
    title = found.title.removeprefix("Simulated: ")
    return replace(found.with_controller(offsets), title=title, source="")
