"""Wording of actions after anomalies in readings and changes between sessions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from orthocal.assessment.wording import OFFSETS_IN_LINUXCNC, joined, lines_in_file, named
from orthocal.assessment.words.effects import identify_effects
from orthocal.effects.loading import with_effects
from orthocal.hypotheses.anomaly import Explanation
from orthocal.measurement.files.session_keys import BACKLASH_KEYS, OFFSET_KEYS, keys_for_unit
from orthocal.printers.settings import FirmwareName
from orthocal.session.session import Reading, Session, split_label
from orthocal.text import quote_path, spans
from orthocal.units import MM, Unit, format_fixed, trim_zeros

ACTIVE_SETTINGS: dict[FirmwareName, str] = {
    "klipper": "printer.cfg, and its part SAVE_CONFIG that takes precedence,",
    "marlin": "what M503 prints",
    "marlin1": "what M503 prints",
    "reprapfirmware": "what M665 and M666 print",
}
"""Settings that a firmware has."""


def advise(session: Session, e: Explanation) -> str:
    """Action after an anomaly with one explanation."""
    if e.scope == "reading" and (e.factor is not None or e.kind == "misread dial"):
        stated = session.readings[e.rows[0]].value / MM
        corrected = stated - (e.amount or 0.0) / MM if e.factor is None else stated * e.factor
        new, old = (trim_zeros(format_fixed(v, 6, sign=True)) for v in (corrected, stated))
        return f"If so, write {new} instead of {old}."
    if e.kind == "reversed sign" and e.setups:
        reverse_direction = ""
        if all("direction" in session.setups[name].sensor.to_keys() for name in e.setups):
            reverse_direction = (
                " If the gauge pointed the other way, reverse `direction` of the setup."
            )
        return (
            "Look at the mounting of the gauge. If a minus sign was forgotten, reverse the signs."
            f"{reverse_direction}"
        )
    if e.factor is not None:
        return f"If so, multiply these readings by {e.factor:.6g}."
    if e.kind == "displaced gauge" and e.scope == "cycle":
        return f"If so, read cycle {e.cycle} again, or leave it out."
    if e.kind == "row offset":
        if e.missing:
            return "If so, move them down by a line and read what is missing."
        return "If so, move them up by a line and read the last one again."
    if e.kind == "displaced gauge" and session.firmware is not None:
        return "If so, fasten the probe and the bed, probe again and import the new log."
    if e.kind == "inconsistent posture" and e.scope == "postures":
        return "Check its coordinates, and read it again."
    zeroed = " If the dial was zeroed on the machine, state `zero: free` there."
    zeroed *= has_known_zero(session, e)
    remedies = {
        "displaced artefact": ("Check `reversed` of its setups. " if can_turn(session, e) else "")
        + "If it was displaced, give it another name in the later setups.",
        "wrong dimension": f"If so, measure it, and correct `{''.join(e.names[:1])}`.{zeroed}",
        "readjusted dimension": "If so, state the present "
        f"`{''.join(e.names[:1])}` in that session. If it is unknown, give its gauge another name "
        f"there.{zeroed}",
        "inconsistent setup": "Check its leg, direction, section and the mounting of its gauge; "
        "then read it again, or leave it out.",
        "swapped rows": "If so, swap them back.",
        "stuck dial": "Check that the plunger moves freely and touches, and read these again.",
        "displaced gauge": _advise_new_setup(session, e),
        "drift": "Wait until machine and gauge have the same temperature, and return to the first "
        "posture at the end of the setup. Or calibrate with `--effects "
        f"{','.join((*session.robot.effect_names, 'drift'))}`.",
    }
    return remedies.get(e.kind) or advise_repetition(session, e)


def _advise_new_setup(session: Session, e: Explanation) -> str:
    """Action after a displaced gauge."""
    command = command_to_restart(session, session.readings[e.rows[0]])
    divide = "make a new setup of the later readings."
    return f"If so, read the setup again: {command}. Or {divide}" if command else f"If so, {divide}"


def advise_repetition(session: Session, *explanations: Explanation) -> str:
    """Action to repeat or omit readings, with commands for the first one."""
    rows = [session.readings[i] for e in explanations for i in e.rows]
    if session.firmware is not None:
        repeat = "Clean the bed and the nozzle, probe again and import the new log"
        if all(r.minus is not None for r in rows):
            repeat = (
                "Measure again and correct the command DELTA_ANALYZE, then import the log again"
            )
        concerned = {i for e in explanations for i in e.rows}
        setups = {r.setup for r in rows}
        if 2 * len(concerned) > sum(r.setup in setups for r in session.readings):
            return f"{repeat}."
        name = quote_path(rows[0].file) if session.joined and rows[0].file else "readings.csv"
        omitted = "leave out what is wrong"
        if lines := lines_in_file(rows):
            omitted = f"delete {spans(lines, 'line')} of {name}"
        return f"{repeat}. Or {omitted}, and calibrate again."
    what = "it" if len(rows) == 1 else "these"
    file = rows[0].file or session.readings_path
    if file is None or rows[0].line is None:
        return f"Read {what} again, or leave out what is wrong."
    line, path = rows[0].line, quote_path(file.parent)
    others = ""
    if further := {(r.file, r.line or 0) for r in rows} - {(rows[0].file, line)}:
        one_file = {f for f, _ in further} == {rows[0].file}
        shown = spans(sorted(k for _, k in further), "line") if one_file else "the other lines"
        others = f", likewise {shown}"
    correct = f"`back {line}` corrects a mistyped reading, `drop {line}` deletes it."
    if not all(_has_present_offsets(session, r) for r in rows):
        return (
            f"Do not read {what} again, because other offsets are active now. Compare with your "
            f"notes: in `orthocal record {path}` {correct}"
        )
    moved = ""
    displaced = any(e.kind == "displaced gauge" for e in explanations)
    if displaced or any(r.setup != session.readings[-1].setup for r in rows):
        moved = (
            f" If the gauge has been moved since, type `restart {line}`: it reads the setup again."
        )
    return (
        f"Read {what} again: in `orthocal record {path}` type `repeat {line}`{others}.{moved} "
        f"{correct}"
    )


def _has_present_offsets(session: Session, reading: Reading) -> bool:
    """True if the controller had the offsets of the last reading, so that it can be read again."""
    present = session.active_during(session.readings[-1].setup)
    return bool(np.array_equal(session.active_during(reading.setup), present))


def command_to_restart(session: Session, reading: Reading) -> str:
    """Clause with the command that reads the setup of a reading again.

    Empty if other offsets are active now, or if the reading is not in a file.
    """
    file = reading.file or session.readings_path
    if file is None or reading.line is None or not _has_present_offsets(session, reading):
        return ""
    return f"in `orthocal record {quote_path(file.parent)}` type `restart {reading.line}`"


def advise_factor(explanations: Sequence[Explanation]) -> str:
    """Action if only the unit of several readings is in question; otherwise ""."""
    rows = explanations[0].rows
    factors = [e.factor for e in explanations if (e.factor or 0.0) > 0.0 and e.rows == rows]
    if len(rows) < 2 or len(factors) < len(explanations):
        return ""
    return (
        "Take one of these readings again. It shows by which factor all of them are too small or "
        f"too large: multiply them by {joined([f'{f:.6g}' for f in factors], 'or')}."
    )


def advise_about_sessions(session: Session, e: Explanation) -> str:
    """Action for numbers that were entered wrongly, or a change between sessions."""
    if session.firmware is not None:
        return _advise_about_logs(session, session.firmware.firmware, e)
    if e.kind == "lost steps":
        return (
            "Home the machine, go to the first posture of a setup and read it again. If it has "
            f"changed, look for the cause at {joined(e.drives)}, and measure the session again."
        )
    if e.kind == "offset of one drive" or (
        e.kind == "machine changed" and not e.apart and (e.drives or is_backlash(e))
    ):
        return _advise_other_number(session, e)
    if e.kind != "machine changed":
        number, keys = "offsets", OFFSET_KEYS
        if e.kind.startswith("backlash"):
            number, keys = "backlash", BACKLASH_KEYS
        key = _name_keys(session, keys, e)
        which = f"session {e.sessions[0]}" if e.sessions else "session.yaml"
        note = f" {OFFSETS_IN_LINUXCNC}" if number == "offsets" else ""
        if e.kind in ("backlash halved", "backlash entered twice"):
            note = " LinuxCNC's BACKLASH is the complete backlash."
        return (
            f"Compare the {number} in the controller with {key} of {which}.{note} If the "
            "session states wrong numbers, correct them there; otherwise enter the right ones and "
            "measure again."
        )
    first = e.sessions[0]
    if e.apart:
        first = f"{joined(e.sessions)} and the others"
        return (
            f"Make sure that the sessions state when they were measured. Calibrate {first} apart."
        )
    return (
        f"Calibrate session {first} and later ones without the earlier ones: the values to enter "
        "must belong to the present machine."
    )


def _advise_about_logs(session: Session, firmware: FirmwareName, e: Explanation) -> str:
    """Action for settings of a printer that were not active, or a change between its logs."""
    if e.kind in ("settings not entered", "settings interchanged"):
        return (
            f"Compare {ACTIVE_SETTINGS[firmware]} with the settings of the export. If they differ, "
            "enter those of the export, home, probe again and import the new log. If they agree, "
            "the log is older: import it again with the settings of its time."
        )
    if e.kind == "bed moved":
        return (
            f"Compare the endstops in {ACTIVE_SETTINGS[firmware]} with those of the export. If "
            "they differ, enter those of the export, home, probe again and import the new log. If "
            "they agree, the bed has moved: calibrate the last log alone and export its settings."
        )
    imported = ""
    if len({part.firmware for part in session.parts}) == 1:
        imported = (
            "All logs state the same settings. If others were active during the last one, import "
            "it again with these. Otherwise, c"
        )
    return (
        f"{imported or 'C'}alibrate the last log alone and export its settings: they must belong "
        "to the present printer."
    )


def _name_keys(session: Session, keys: Mapping[str, tuple[Unit, float]], e: Explanation) -> str:
    """Keys of a session.yaml that may state the offsets or backlashes of the drives of an anomaly.

    Args:
        session: The session.
        keys: OFFSET_KEYS or BACKLASH_KEYS.
        e: The anomaly; without drives it concerns all of them.
    """
    units = dict.fromkeys(
        d.unit for d in session.robot.drives if d.name in e.drives or not e.drives
    )
    names = [f"`controller.{key}`" for unit in units for key in keys_for_unit(keys, unit)]
    return joined(names, "or")


def _advise_other_number(session: Session, e: Explanation) -> str:
    """Action after a drive that changed, or has another number in the controller than stated."""
    number, keys, changed = "offsets", OFFSET_KEYS, "the drive or its home switch has moved"
    if is_backlash(e):
        number, keys, changed = "backlash", BACKLASH_KEYS, "the drive has changed"
    note = f"{OFFSETS_IN_LINUXCNC} " if number == "offsets" else ""
    return (
        f"Compare the {number} in the controller with {_name_keys(session, keys, e)} of session "
        f"{e.sessions[0]}. {note}If they differ, state there those that were in the controller, "
        f"and calibrate again. If they agree, {changed}: {_calibrate_present(session, e)}, and "
        f"enter its {number}."
    )


def is_backlash(e: Explanation) -> bool:
    """True if the backlash of a drive changed between sessions."""
    return e.kind == "machine changed" and e.parameters[0].endswith(".backlash")


def _calibrate_present(session: Session, e: Explanation) -> str:
    """Clause with the command that calibrates the sessions since a change without earlier ones."""
    names = list(dict.fromkeys(session.labels))
    present = e.sessions if e.apart else names[names.index(e.sessions[0]) :]
    clause = f"calibrate {named('session', present)} without the others"
    paths = [part.path for part in session.parts]
    if len(paths) != len(names) or None in paths:
        return clause
    directories = [
        quote_path(path.parent)
        for name, path in zip(names, paths, strict=True)
        if name in present and path is not None
    ]
    return f"{clause} (`orthocal calibrate {' '.join(directories)} --out {directories[0]}-alone`)"


def advise_effects(session: Session, explanations: Iterable[Explanation]) -> str:
    """Advice to calibrate with all missing effects in addition to those of the robot."""
    missing = [e.effect for e in explanations if e.amounts]
    robot = with_effects(session.robot, (*session.robot.effect_names, *missing))
    return identify_effects(robot.effect_names)


def can_turn(session: Session, e: Explanation) -> bool:
    """True if an artefact has two sides: a square or a straightedge."""
    _, artefact = split_label("".join(e.names[:1]), joined=session.joined)
    return artefact.startswith(("square.", "straightedge."))


def has_known_zero(session: Session, e: Explanation) -> bool:
    """True if a wrong dimension changes all readings as a wrong gauge zero does: bars."""
    return any(session.setups[name].zero == "known" for name in e.setups)
