"""The command `sheet`."""

from __future__ import annotations

import os

import orthocal
from orthocal.cli.options import Force, OptionalOutDirectory, PlanPath, command, read_numbers
from orthocal.cli.overwriting import require_replaceable_results
from orthocal.cli.printing import put_note
from orthocal.errors import OrthocalError
from orthocal.io.files import is_folder, require_writable, write_files


@command()
def sheet(
    session: PlanPath,
    feed: float = 600.0,
    approach_feed: float = 120.0,
    shift_mm: str = "0,0,0",
    dwell: float | None = None,
    trigger: str | None = None,
    out: OptionalOutDirectory = None,
    force: Force = False,
) -> None:
    """Write a measuring sheet and a G-code program for each setup.

    The programs pause in the alignment posture of each setup and at each reading. With --dwell or
    --trigger they pause only where the operator has to act, so that a logger reads the gauge.
    Without --out the files are written beside the session.

    Args:
        feed (MM/MIN): Feed between postures.
        approach_feed (MM/MIN): Feed over the last 2 mm to a posture.
        shift_mm (X,Y,Z): Machine coordinates (G53) of the tool centre point at the
            mechanical zero, mm.
        dwell (SECONDS): Time at each reading instead of a pause (G4).
        trigger (OUTPUT): Trigger of a logger after the dwell (default: 1 s): digital output 0 to
            63 (M64, M65 of LinuxCNC), or an M-code from M100 to M199.
    """
    from orthocal.measurement.motion.motion_program import ProgramOptions
    from orthocal.output.sheet.page import sheet_files
    from orthocal.output.text.answer import quote_path

    x, y, z = read_numbers(shift_mm, "--shift-mm", "XYZ")
    options = ProgramOptions(feed, approach_feed, (x, y, z), dwell, trigger)
    directory = out or (session if is_folder(session) else session.parent)
    require_writable(directory)
    plan, following = orthocal.load_plan(session), ""
    if plan.offsets_from is not None:
        following = (
            f"orthocal validate {quote_path(os.path.relpath(plan.offsets_from, directory))} ."
        )
    files = sheet_files(plan, options=options, following=following)
    require_replaceable_results(directory, files, force=force)
    write_files(directory, files)
    count = len(files) - 1
    programs = f" and {count} programs" if count else "; no programs: the drives control no tool"
    put_note(f"Wrote {directory / 'sheet.html'} to print{programs}")


def sheet_or_problem(
    session: orthocal.Session, *, following: str = ""
) -> tuple[dict[str, str], str]:
    """Text of the files of a new session's measuring sheet by name, or no files and the reason.

    Args:
        session: The plan, before `write_session` writes it.
        following: Command for the readings; see `sheet_files`.
    """
    from orthocal.measurement.files.write_session import number_rows
    from orthocal.output.sheet.page import sheet_files

    try:
        return sheet_files(number_rows(session), following=following), ""
    except OrthocalError as e:
        return {}, f"orthocal: no measuring sheet: {e}"
