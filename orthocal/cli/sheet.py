"""The command `sheet`."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import orthocal
from orthocal.cli.options import command
from orthocal.cli.overwriting import require_replaceable_results
from orthocal.cli.printing import put_note
from orthocal.errors import OrthocalError, SessionError
from orthocal.io.files import is_folder, require_writable, write_files
from orthocal.text import quote_path


@command()
def sheet(
    plan: Path,
    feed: float = 600.0,
    approach_feed: float = 120.0,
    dwell: float | None = None,
    trigger: str | None = None,
    ini: Path | None = None,
    out: Path | None = None,
    force: bool = False,
) -> None:
    """Write a measuring sheet and a G-code program for each setup.

    The programs pause in the alignment posture of each setup and at each reading. With --dwell or
    --trigger they pause only where the operator has to act, so that a logger reads the gauge.
    Without --out the files are written beside the session.

    Args:
        feed (MM/MIN): Feed between postures.
        approach_feed (MM/MIN): Feed over the last 2 mm to a posture.
        dwell (SECONDS): Time at each reading instead of a pause (G4).
        trigger (OUTPUT): Trigger of a logger after the dwell (default: 1 s): digital output 0 to
            63 (M64, M65 of LinuxCNC), or an M-code from M100 to M199.
        ini (FILE): INI file of LinuxCNC; motions beyond its soft limits and other HOME_OFFSET than
            in session.yaml are named.
    """
    from orthocal.assessment.wording import counted
    from orthocal.measurement.motion.motion_program import ProgramOptions
    from orthocal.output.sheet.page import sheet_files

    options = ProgramOptions(feed, approach_feed, dwell, trigger)
    directory = out or (plan if is_folder(plan) else plan.parent)
    require_writable(directory)
    session = orthocal.load_plan(plan)
    following = following_command(session, plan, directory)
    files = sheet_files(session, options=options, following=following)
    require_replaceable_results(directory, files, force=force)
    write_files(directory, files)
    count = len(files) - 1
    programs = "; no programs: the drives control no tool"
    if count:
        noun = "program" if session.firmware is None else "file"
        programs = f" and {counted(count, noun)}{' of lines to send' * (noun == 'file')}"
    put_note(f"Wrote {directory / 'sheet.html'} to print{programs}")
    note_contradictions(session, ini)


def following_command(plan: orthocal.Session, path: Path, directory: Path) -> str:
    """Command for the readings of a written plan; "" if it needs a calibration that is not stated.

    Args:
        plan: The plan.
        path: Path of its session.
        directory: Directory in which the command is typed.
    """
    from orthocal.output.text.answer import calibrate_command

    if plan.offsets_from is not None:
        entered = quote_path(os.path.relpath(plan.offsets_from, directory))
        return f"orthocal validate {entered} {quote_path(os.path.relpath(path, directory))}"
    if plan.active_offsets.any():
        return ""
    return calibrate_command([path], {}, folder=directory)


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


def note_contradictions(
    session: orthocal.Session, ini: Path | None, *, latching: bool = True
) -> None:
    """Note other HOME_OFFSET of an INI file, motions beyond its limits, and wrong directions.

    Args:
        session: The plan.
        ini: The INI file of LinuxCNC; None without one.
        latching: Whether wrong directions are named: to correct them moves the zero, so that only
            the first session asks for it.
    """
    from orthocal.assessment.wording import joined
    from orthocal.effects.compensation import home_positions
    from orthocal.export.linuxcnc.entered_lines import compare_homes
    from orthocal.measurement.files.linuxcnc_ini import read_controller_joints
    from orthocal.measurement.motion.approach import usual_approaches
    from orthocal.output.sheet.soft_limits import describe_beyond_limits
    from orthocal.robot.model import drive_keys

    if ini is None:
        return
    joints = read_controller_joints(ini, session.robot)
    homes = home_positions(session.compensation)
    if differences := compare_homes(session.robot, homes, joints.compensation):
        keys = drive_keys("home_offset", session.robot.drives, homes)
        put_note(
            f"{ini} has other HOME_OFFSET than session.yaml: {differences}. If you have entered "
            "the offsets of a calibration, prepare a session with `orthocal again`. Otherwise "
            f"state the present numbers in session.yaml in place of {keys}"
        )
    if latching and joints.opposed and usual_approaches(session.robot):
        verb = "has" if len(joints.opposed) == 1 else "have"
        put_note(
            f"{ini}: {joined(joints.opposed)} {verb} a HOME_LATCH_VEL whose sign is not that of "
            "HOME_SEARCH_VEL: the switch may open before the backlash is taken up. Change the sign "
            "of HOME_LATCH_VEL before the first reading, because this moves the zero"
        )
    with suppress(SessionError):  # no measuring sheet, whose reason is printed
        limits = joints.limits, joints.axis_limits
        put_note(describe_beyond_limits(session, *limits, file=str(ini)))
