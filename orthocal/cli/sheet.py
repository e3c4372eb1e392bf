"""The command `sheet`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthocal.cli.options import app
from orthocal.cli.printing import put_note
from orthocal.errors import OrthocalError, ParameterError, SessionError

if TYPE_CHECKING:
    from orthocal.session.session import Session


@app.command()
def sheet(
    session: Annotated[
        Path,
        typer.Argument(
            metavar="SESSION", help="Plan or session: session.yaml, or the directory that holds it."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Output directory; default: the directory of the session.")
    ] = None,
    feed: Annotated[float, typer.Option(help="Feed between postures, mm/min.")] = 600.0,
    approach_feed: Annotated[
        float, typer.Option(help="Feed over the last millimetres to a posture, mm/min.")
    ] = 120.0,
    shift_mm: Annotated[
        str,
        typer.Option(
            "--shift-mm",
            metavar="X,Y,Z",
            help="Machine coordinates (G53) of the world's origin, mm.",
        ),
    ] = "0,0,0",
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
) -> None:
    """Write a measuring sheet to print and one G-code program per setup.

    The programs pause at each reading.
    """
    from orthocal.io.documents import parse_number
    from orthocal.io.files import exists, is_folder, require_writable, write_files
    from orthocal.measurement.files.session_file import load_plan
    from orthocal.measurement.motion.motion_program import ProgramOptions
    from orthocal.output.sheet.page import sheet_files

    parts = shift_mm.split(",")
    if len(parts) != 3:
        raise ParameterError(f"found '{shift_mm}'; expected X,Y,Z, in mm", where="--shift-mm")
    x, y, z = (
        parse_number(p.strip(), where="--shift-mm", name="part", error=ParameterError)
        for p in parts
    )
    options = ProgramOptions(feed=feed, approach_feed=approach_feed, shift_mm=(x, y, z))
    options.require_sane()
    folder = out or (session if is_folder(session) else session.parent)
    require_writable(folder)
    planned = load_plan(session)
    files = sheet_files(planned, options=options)
    for name in files:
        if exists(folder / name) and not force:
            raise SessionError("is there already; --force writes over it", where=str(folder / name))
    write_files(folder, files)
    programs = len(files) - 1
    more = f" and {programs} programs" if programs else "; no programs: the drives control no tool"
    put_note(f"Wrote {folder / 'sheet.html'} to print{more}")


def sheet_or_nothing(session: Session) -> dict[str, str]:
    """Files of the measuring sheet; none, with a note on stderr, if it cannot be made."""
    files, problem = sheet_or_problem(session)
    if problem:
        put_note(problem)
    return files


def sheet_or_problem(session: Session) -> tuple[dict[str, str], str]:
    """Files of the measuring sheet, or none and the reason."""
    from orthocal.output.sheet.page import sheet_files

    try:
        return sheet_files(session), ""
    except OrthocalError as e:
        return {}, f"orthocal: no measuring sheet: {e}"
