"""The command `again`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import orthocal
from orthocal.cli.options import (
    OutDirectory,
    command,
    read_number,
    read_pairs,
    require_between,
    split_globs,
)
from orthocal.cli.overwriting import require_new_session, write_plan
from orthocal.cli.printing import put_note, put_out
from orthocal.cli.sheet import note_contradictions, sheet_or_problem
from orthocal.errors import ExportError, ParameterError
from orthocal.io.files import exists
from orthocal.text import quote_path
from orthocal.units import MM

if TYPE_CHECKING:
    from orthocal.arrays import Array
    from orthocal.measurement.files.linuxcnc_ini import ControllerJoints
    from orthocal.robot.model import Drive


@command()
def again(
    calibration: Path,
    out: OutDirectory,
    session: Path | None = None,
    adjusted: str | None = None,
    ini: Path | None = None,
    anyway: bool = False,
    force: bool = False,
) -> None:
    """Plan the same readings again, with the values to enter.

    The directory receives session.yaml, an empty readings.csv and a measuring sheet.

    Exit code 3: the verdict is not `enter`, or the planned adjustments are not worth doing. The
    reason is printed, and nothing is written.

    Args:
        session (SESSION): Session with the setups and postures; default: that of the calibration,
            of several the last.
        adjusted (NAME=MM,...): Mechanical adjustments since the calibration and their amounts, such
            as x_outer_foot_y=0.12; or plan, for those that `orthocal adjust` prints.
        ini (FILE): INI file of LinuxCNC with the entered lines, or joints.ini of an export, whose
            BACKLASH, COMP_FILE and HOME_OFFSET the session then states; default: the backlash to
            enter, and the tables of the last session. Motions beyond its soft limits are named.
    """
    from orthocal.export.formats import note_wrong_order, require_entering, require_offsets
    from orthocal.measurement.files.linuxcnc_ini import read_controller_joints

    require_new_session(out, ("session.yaml", "readings.csv", "sheet.html"), force=force)
    result = orthocal.load_calibration(calibration)
    require_offsets(result, where=str(calibration))
    if not anyway:
        require_entering(result)
    amounts = _read_amounts(result, adjusted, anyway=anyway)
    new = replace(_plan_again(result, session, amounts), offsets_from=calibration)
    joints = None if ini is None else read_controller_joints(ini, result.robot)
    adjusted_result = orthocal.adjust_calibration(result, amounts)
    new, entered = _state_joints(new, result, adjusted_result, joints)
    _write(new, out, f"orthocal validate {quote_path(os.path.relpath(calibration, out))} .")
    put_note(note_wrong_order(result))
    if amounts:
        settings = ", ".join(f"{name} {v / MM:+.3f} mm" for name, v in amounts.items())
        put_out(f"Set these adjustments before you measure: {settings}.")
    _note_other_lines(adjusted_result, new, ini, joints)
    _note_numbers(new)
    note_contradictions(new, ini, latching=False)
    put_out(_describe_entries(new, result, calibration, ini=ini if entered else None))
    folder, validated = quote_path(out), quote_path(calibration)
    put_out(f"  orthocal record {folder}\n  orthocal validate {validated} {folder}")
    put_note(f"Wrote {out / 'session.yaml'}, readings.csv to fill in, sheet.html and its programs")


def _state_joints(
    new: orthocal.Session,
    calibration: orthocal.Calibration,
    adjusted: orthocal.Calibration,
    joints: ControllerJoints | None,
) -> tuple[orthocal.Session, bool]:
    """Session that states the joints of the controller, and whether they have its offsets.

    Without a file the joints are those to enter. Home positions for other offsets are not stated.

    Args:
        new: The session.
        calibration: The calibration that it repeats.
        adjusted: The same with the adjustments since then.
        joints: Joints of an INI file; None without the file.
    """
    from orthocal.assessment.controller_entries import compensation_to_enter
    from orthocal.effects.compensation import with_homes
    from orthocal.export.linuxcnc.entered_lines import expected_homes, states_homes, states_offsets

    if joints is None:
        trims = compensation_to_enter(calibration) or calibration.session.compensation
        possible = expected_homes(adjusted, trims, None)
        certain = possible is not None and possible.shape[1] == 1
        homes = possible[:, 0].tolist() if possible is not None and certain else None
        if possible is not None and not certain:
            put_note("To compare HOME_OFFSET, add --ini and the INI file with the new lines.")
        return replace(new, compensation=with_homes(trims, homes)), False
    trims = joints.compensation
    entered = states_homes(adjusted, trims, joints.latched)
    if entered is None:
        entered = states_offsets(joints.offsets, new.active_offsets)
    return replace(new, compensation=trims if entered else with_homes(trims, None)), entered


def _write(new: orthocal.Session, out: Path, validating: str) -> None:
    """Write the planned session with its sheet.

    Args:
        new: The session.
        out: Its directory.
        validating: Command that compares its readings with the calibration, in this directory.
    """
    comment = (
        "A plan: enter these offsets, then run `orthocal record .` in this directory, or fill in\n"
        f"readings.csv. Compare the readings with the calibration:\n{validating}"
    )
    sheet, problem = sheet_or_problem(new, following=validating)
    put_note(problem)
    write_plan(new, out, comment=comment, files=sheet)


def _note_numbers(new: orthocal.Session) -> None:
    """Note that the rows of a new session have other lines than in the session that it repeats."""
    from orthocal.measurement.files.write_session import number_rows

    numbered = number_rows(new).readings
    if any(r.line != n.line for r, n in zip(new.readings, numbered, strict=True)):
        put_note(
            "Lines were deleted or added while the readings were taken. The new lines therefore "
            "have other numbers: measure with the new sheet only."
        )


def _note_other_lines(
    calibration: orthocal.Calibration,
    new: orthocal.Session,
    ini: Path | None,
    joints: ControllerJoints | None,
) -> None:
    """Note tables of an export that a session does not state, or other lines of an INI file.

    Args:
        calibration: The calibration, with the adjustments since then.
        new: The new session.
        ini: INI file of the option `--ini`.
        joints: Its joints; None without the file.
    """
    from orthocal.assessment.wording import joined
    from orthocal.export.linuxcnc.entered_lines import describe_other_lines, find_unstated_tables

    if joints is None:
        if tables := find_unstated_tables(calibration, new.compensation):
            put_note(
                f"An export writes a table (COMP_FILE) for {joined(tables)}, and the new session "
                "does not state it. If you enter this table, prepare the session with it: --ini "
                "and the file joints.ini of the export."
            )
        return
    put_note(
        describe_other_lines(
            calibration,
            joints.compensation,
            joints.offsets,
            latched=joints.latched,
            entered=new.active_offsets,
            file=str(ini),
        )
    )


def _describe_entries(
    new: orthocal.Session, calibration: orthocal.Calibration, path: Path, *, ini: Path | None
) -> str:
    """Instructions about the corrections of the controller for a new session.

    Args:
        new: The session.
        calibration: The calibration that it repeats.
        path: Path of this calibration.
        ini: INI file whose lines contain the offsets of the session; None if no file is known to.
    """
    from orthocal.effects.compensation import describe_trims, home_positions

    drives = new.robot.drives
    offsets = _list_lengths(drives, new.active_offsets)
    text = f"The controller must correct these total offsets of the drives: {offsets}."
    if calibration.session.controller_offsets is None:
        text = (
            f"Add these to the active offsets of the drives, unless they are added already: "
            f"{offsets}. The new session.yaml states these changes, since the calibrated session "
            "states no offsets (`controller`)."
        )
    if ini is not None:
        text += f" The lines of {ini} contain them: enter these lines if they are not active yet."
    else:
        text += f" Do not type them as HOME_OFFSET: {_describe_conversion(new, calibration, path)}"
        if down := [d.name for d in drives if d.direction < 0]:
            they = "it counts" if len(down) == 1 else "they count"
            text += (
                f" If the controller is not LinuxCNC, enter {', '.join(down)} with the opposite "
                f"sign: {they} down."
            )
    if backlash := describe_trims(new.robot, new.compensation):
        text += (
            f"\nCheck that the controller compensates this backlash: {backlash}. If it does not, "
            "state under `controller` in session.yaml what it compensates, 0 for none"
            f"{', and its HOME_OFFSET' * (home_positions(new.compensation) is not None)}."
        )
    return (
        f"{text}\nThen home, measure and compare. If other sessions were measured with these "
        "offsets, name them, too:"
    )


def _describe_conversion(
    new: orthocal.Session, calibration: orthocal.Calibration, path: Path
) -> str:
    """Clause about the way from the offsets of a new session to HOME_OFFSET.

    An export contains no adjustments that were made since the calibration.

    Args:
        new: The session.
        calibration: The calibration that it repeats.
        path: Path of this calibration.
    """
    from orthocal.effects.compensation import compensates_alike

    if dict(new.adjusted) == dict(calibration.session.adjusted):
        return (
            f"`orthocal export {quote_path(path)} --to linuxcnc --offsets --ini FILE --out "
            "DIRECTORY` writes the lines that contain them, unless you have entered them already."
        )
    drives = new.robot.drives
    changes = (new.active_offsets - calibration.active_offsets) * [d.direction for d in drives]
    text = f"it changes by {_list_lengths(drives, changes)} since the calibrated measurement"
    same = compensates_alike(new.compensation, calibration.session.compensation)
    return f"{text}{'' if same else ', and by half of the change of BACKLASH'}."


def _list_lengths(drives: Sequence[Drive], values: Array) -> str:
    """Values of drives with their names and units.

    Args:
        drives: The drives.
        values: Shape (n_drives,), [m, rad].
    """
    return ", ".join(
        f"{d.name} {v * d.edge_factor:+.3f} {d.edge_unit}"
        for d, v in zip(drives, values.tolist(), strict=True)
    )


def _read_amounts(
    calibration: orthocal.Calibration, text: str | None, *, anyway: bool
) -> dict[str, float]:
    """Amounts of the adjustments of the option `--adjusted`, [m], by name, without zeros.

    Raises:
        ParameterError: If the text is not NAME=MM, or a name is unknown or stated twice.
        RobotError: If the text is `plan`, and the robot declares no adjustments.
        ExportError: If the text is `plan`, and the planned adjustments are not worth doing.
    """
    from orthocal.assessment.words.adjustment import HEADLINES
    from orthocal.effects.adjustment import LARGEST_AMOUNT_MM, require_adjustment

    where, amounts = "--adjusted", dict[str, float]()
    if text == "plan":
        plan = orthocal.plan_adjustments(calibration)
        if not plan.adjustments or (plan.judgement != "worthwhile" and not anyway):
            raise ExportError(HEADLINES[plan.judgement], where=where)
        return plan.amounts
    parts = None if text is None else split_globs([text])
    for name, value in read_pairs(parts, where, "NAME=MM, or plan").items():
        require_adjustment(calibration.robot, name, where=where, error=ParameterError)
        amount = read_number(value, where, name)
        require_between(amount, -LARGEST_AMOUNT_MM, LARGEST_AMOUNT_MM, where)
        if amount:
            amounts[name] = amount * MM
    return amounts


def _plan_again(
    calibration: orthocal.Calibration, path: Path | None, amounts: Mapping[str, float]
) -> orthocal.Session:
    """Plan of the rows of a session, with the offsets to enter as active offsets.

    The rows are in the order of measurement.

    Args:
        calibration: The calibration.
        path: A session with these rows; None for the last session of the calibration.
        amounts: Amounts of the mechanical adjustments since the calibration, [m], by name.
    """
    from orthocal.assessment.controller_entries import offsets_to_enter
    from orthocal.calibration.recorded_robot import require_calibrated_robot
    from orthocal.effects.adjustment import add_amounts
    from orthocal.session.order import order_of_measurement

    parts = calibration.session.parts
    if path is None and parts:
        last = None if parts[-1].path is None else Path(parts[-1].path)
        if last is None or not exists(last):
            raise ParameterError(
                "is missing; the last session of the calibration does not exist any more",
                where="--session",
            )
        path = last
        put_note(f"The readings are those of the last session, {last}; --session names another.")
    if path is not None:
        planned = orthocal.load_plan(path)
        require_calibrated_robot(calibration, planned)
        planned = replace(planned, robot=calibration.robot)  # its tolerances and effects
    else:
        planned = orthocal.restore_session(calibration)
    title = planned.title.removeprefix("Simulated").removeprefix(": ")
    planned = planned.with_controller(
        offsets_to_enter(orthocal.adjust_calibration(calibration, amounts))
    )
    adjusted = add_amounts(dict(calibration.session.adjusted), amounts)
    readings = tuple(planned.readings[i] for i in order_of_measurement(planned.readings))
    return replace(planned, readings=readings, title=title, source="", seed=None, adjusted=adjusted)
