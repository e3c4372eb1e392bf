"""Wording of findings about anomalies in readings and changes between sessions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

from orthocal.assessment.wording import (
    joined,
    lines_in_file,
    mm,
    name_offsets,
    named,
    note,
    plain,
    review,
    signed,
    um,
)
from orthocal.assessment.words.remedies import (
    advise,
    advise_about_sessions,
    advise_effects,
    advise_factor,
    advise_repetition,
    can_turn,
    has_known_zero,
    is_backlash,
)
from orthocal.calibration.assessment_record import Finding, Place
from orthocal.effects.loading import robot_effects, with_effects
from orthocal.hypotheses.anomaly import Anomalies, Anomaly, Explanation
from orthocal.measurement.motion.approach import label_reading
from orthocal.sensors.protocol import states_readings
from orthocal.session.session import Session, split_label
from orthocal.text import capitalised, spans, uncapitalised
from orthocal.units import EDGE_UNITS, MM, UM, Unit, unit_in_text

Correction = Literal["offsets", "compensation", "settings"]
"""What a controller corrects: offsets, backlash and screws, or settings of a printer."""

MAX_PLACES = 1000
"""Largest number of places in a finding, which limits the size of calibration.json."""

LARGEST_ODDS = 1e6
"""Odds above which the number is not printed."""

LEAST_CHANCE = 1e-4
"""Probability by chance below which only this limit is printed."""

UNITS = {25.4: "in inches", 1e3: "in m", 1e-3: "in µm"}
"""Unit of wrongly written readings by the factor that corrects them; others are mm as inches."""

BETWEEN_LOGS = "settings not entered", "settings interchanged", "bed moved"
OF_BACKLASH = "backlash not entered", "backlash halved", "backlash entered twice"
"""Kinds of anomalies that share a sentence."""


def describe_anomalies(session: Session, result: Anomalies) -> list[Finding]:
    """Findings about all anomalies, and about readings that they do not explain."""
    findings = [describe_anomaly(session, result, a) for a in result.found]
    if not result.explained and (result.found or session.joined):
        findings.append(_unexplained(session, result))
    return findings


def describe_anomaly(session: Session, result: Anomalies, anomaly: Anomaly) -> Finding:
    """Finding about one anomaly, or about several that are nearly equally likely."""
    e = anomaly.explanation
    if not e.rows and not any(c.rows for c in anomaly.alternatives):
        return _between_sessions(session, anomaly)
    if anomaly.alternatives:
        return _ambiguous(session, result, anomaly)
    first = session.readings[e.rows[0]]
    descriptions = list(dict.fromkeys(_text(session, c) for c in anomaly.causes or (e,)))
    numbers = _numbers(result, anomaly)
    text = _looks_as_if(session, anomaly, descriptions)
    if e.amounts:
        numbers["amount_um"] = (e.amount or 0.0) / UM
        action = advise_effects(session, [a.explanation for a in result.found])
        return review(e.kind, text, action, _effect_places(session, e), **numbers)
    if e.kind in ("wrong dimension", "readjusted dimension"):
        numbers["dimension_mm"], numbers["stated_mm"] = _dimensions_mm(e)
    if anomaly.expected is not None:
        numbers |= {
            "measured_mm": first.value / MM,
            "expected_mm": anomaly.expected / MM,
            "cycle": float(first.cycle),
        }
    action = advise_repetition(session, e) if anomaly.causes else advise(session, e)
    return review(e.kind, text, action, _places(session, e), **numbers)


def _looks_as_if(session: Session, anomaly: Anomaly, descriptions: Sequence[str]) -> str:
    """Sentences about one anomaly: its causes, and the reading that the others predict."""
    e, predicted = anomaly.explanation, ""
    if anomaly.expected is not None and not _is_trigger(session, e):
        value = session.readings[e.rows[0]].value
        predicted = (
            f"it reads {signed(value / MM)} mm; the other readings predict "
            f"{signed(anomaly.expected / MM)} mm."
        )
        if not _is_in_range(session, e.rows[0], anomaly.expected):
            predicted += (
                " The gauge cannot show this: the line may name another setup or posture than the "
                "one that was read."
            )
    listed = ";\n  ".join(descriptions)
    sentences = [predicted, f"one of these may have happened:\n  {listed}."]
    if len(descriptions) == 1:
        sentences = [f"it looks as if {listed}.", predicted]
    first, *others = [s for s in sentences if s]
    return " ".join(map(capitalised, [f"{_lines(session, e)}{first}", *others]))


def _is_in_range(session: Session, row: int, value: float) -> bool:
    """True if the gauge of a row can show a value, in [m], wherever its zero is set."""
    limits = session.gauges[session.setups[session.readings[row].setup].gauge].range
    return limits is None or abs(value) <= limits[1] - limits[0]


def _effect_places(session: Session, e: Explanation) -> tuple[Place, ...]:
    """Setups of a drift; for other effects parameters that differ significantly from 0."""
    if e.kind == "drift":
        return _places(session, e)
    return tuple(Place(parameter=name) for name, *_ in _significant_amounts(e))


def _describe_effect(session: Session, name: str) -> str:
    """Description of an effect that the robot's model does not contain."""
    robot = with_effects(session.robot, (*session.robot.effect_names, name))
    return next(e.describe() for e in robot_effects(robot) if e.name == name)


def _significant_amounts(e: Explanation) -> list[tuple[str, float, float, Unit]]:
    """Parameters of an effect that differ significantly from 0, at least the most significant one.

    Returns:
        Name, value, standard deviation, [SI], and unit of each.
    """
    indices = range(len(e.amounts))
    amounts = [(e.parameters[i], e.amounts[i], e.stds[i], e.units[i]) for i in indices]
    amounts.sort(key=lambda entry: -abs(entry[1]) / entry[2])
    return [f for f in amounts if abs(f[1]) > 2.0 * f[2]] or amounts[:1]


def _ambiguous(session: Session, result: Anomalies, anomaly: Anomaly) -> Finding:
    """Finding about contradictory readings with several explanations."""
    explanations = (*(anomaly.causes or (anomaly.explanation,)), *anomaly.alternatives)
    texts = dict.fromkeys(f"  {_lines(session, e)}{_text(session, e)}" for e in explanations)
    listed = ";\n".join(texts)
    action = advise_factor(explanations) or advise_repetition(session, *explanations)
    reversed_setups = [e for e in explanations if e.kind == "reversed sign" and e.setups]
    if reversed_setups:  # nothing to read again
        names = tuple(n for e in reversed_setups for n in e.setups)
        remedy = advise(session, replace(reversed_setups[0], setups=names))
        only = len(reversed_setups) == len(explanations)
        action = remedy if only else f"{remedy} Otherwise {uncapitalised(action)}"
    if any(e.amounts for e in explanations):  # costs no reading
        effect = advise_effects(session, explanations)
        repeat = uncapitalised(action)
        action = f"{effect} If the readings still contradict each other, {repeat}"
    return review(
        "ambiguous",
        f"The readings contradict each other. One of these may have happened:\n{listed}.",
        action,
        tuple(p for e in explanations for p in _places(session, e)[:1]),
        **_numbers(result, anomaly),
    )


def _unexplained(session: Session, result: Anomalies) -> Finding:
    """Finding about readings that the anomalies do not explain, or explain only in part."""
    what = "What was found above explains" if result.found else "No single change explains"
    which = "The sessions do" if session.joined else "The readings do"
    suspected = Explanation("outlier", "reading", result.suspected)
    where, action = "", "Measure again."
    if result.suspected:
        names = list(dict.fromkeys(session.readings[i].setup for i in result.suspected))
        setups = named("setup", names)
        lines = _lines(session, suspected).removesuffix(": ")
        where = f", most likely in {f'{lines} ({setups})' if lines else setups}"
        action = advise_repetition(session, suspected)
    if session.joined:
        action = (
            "Read a setup of the session that was measured last again. If its readings repeat, the "
            "machine has changed: calibrate that session alone. Otherwise measure again."
        )
    return review(
        "inconsistent readings",
        f"{which} not fit one machine. {what} "
        f"{'only a part' if result.found else 'it'}: several parts may have changed, or several "
        f"readings are wrong{where}.",
        action,
        _places(session, suspected),
        before_rms_um=result.rms_before / UM,
        after_rms_um=result.rms_after / UM,
    )


def _between_sessions(session: Session, anomaly: Anomaly) -> Finding:
    """Finding about a machine that changed, or numbers that were not entered as stated."""
    e = anomaly.explanation
    text = capitalised(f"{_text(session, e)}.")
    others = [_text(session, c) for c in (*anomaly.causes, *anomaly.alternatives) if c != e]
    if others:
        listed = ";\n  ".join(dict.fromkeys([_text(session, e), *others]))
        text = f"One of these may have happened:\n  {listed}."
    numbers = {"log_posterior_odds": anomaly.log_evidence}
    if e.amount is not None:
        for name in e.parameters:
            p = session.robot.parameters[name]
            numbers[f"{name}_by_{p.edge_unit}"] = e.amount * p.edge_factor
            numbers[f"{name}_std_{p.edge_unit}"] = (e.std or 0.0) * p.edge_factor
    if e.active:
        for drive, active in zip(session.robot.drives, e.active, strict=True):
            if drive.name in e.drives:
                numbers[f"{drive.name}_active_{drive.edge_unit}"] = active * drive.edge_factor
    names = e.drives or e.parameters
    place = Place(file=_file_of(session, e.sessions[0]) if e.sessions else None)
    if e.first is not None:
        place = place_of(session, e.first)
    return review(
        e.kind,
        text,
        advise_about_sessions(session, e),
        tuple(replace(place, parameter=name) for name in names) or (place,),
        **numbers,
    )


def describe_no_change(sizes: dict[str, float], undetectable: Sequence[str]) -> Finding:
    """Finding that no change between sessions was detected.

    Args:
        sizes: Unit to the smallest detectable change of an offset in that unit.
        undetectable: Drives of which no change can be detected.
    """
    if not sizes:
        return note(
            "change unknown",
            "Whether the machine changed between the sessions is unknown: the sessions have too "
            "few setups and postures in common.",
            "Read some of the same setups and postures in each session.",
        )
    changes = joined([f"{plain(size)} {unit}" for unit, size in sizes.items()], "or")
    text = (
        f"No change between the sessions was found. A change of one offset by {changes} "
        "would have been detected. `orthocal validate` detects smaller deviations."
    )
    if undetectable:
        text += f" A change of {joined(tuple(undetectable), 'or')} would not have been."
    return note("no change", text, **{f"seen_from_{u}": size for u, size in sizes.items()})


def describe_wrong_time(listed_last: str, last: str) -> Finding:
    """Finding about joined sessions that are not listed in the order of their times.

    Args:
        listed_last: Session that is listed last.
        last: Session that was measured last.
    """
    return review(
        "wrong order",
        f"Session {listed_last} is listed last, but session {last} was measured later.",
        f"List session {last} last, or correct the times of the readings.",
    )


def describe_wrong_order(listed_last: str, last: str, kind: Correction) -> Finding:
    """Finding about joined sessions of which an earlier one has a correction that the last lacks.

    Args:
        listed_last: Session that is listed last.
        last: Session with the correction.
        kind: The correction.
    """
    lacking, numbers = {
        "offsets": ("no offset is active", "offsets"),
        "compensation": ("the controller compensates nothing", "compensation"),
        "settings": ("the firmware corrects no tower", "settings"),
    }[kind]
    return note(
        "wrong order",
        f"In session {listed_last}, which is listed last, {lacking}, unlike in session {last}. The "
        f"present {numbers} are assumed to be those of session {listed_last}.",
        f"If session {last} is the latest, list it last.",
    )


def _numbers(result: Anomalies, anomaly: Anomaly) -> dict[str, float]:
    """Numbers of the finding about an anomaly."""
    return {
        "before_rms_um": result.rms_before / UM,
        "after_rms_um": result.rms_after / UM,
        "log_posterior_odds": anomaly.log_evidence,
    }


def describe_evidence(finding: Finding) -> str:
    """Numbers behind a finding about readings; "" without any.

    Residuals before and after the correction of an anomaly, and its odds; correlation of the
    residuals of two sessions.
    """
    numbers = finding.numbers
    sentences = []
    before, after = (numbers.get(f"{n}_rms_um", math.nan) * UM for n in ("before", "after"))
    if math.isfinite(before + after) and finding.kind != "stuck dial":
        sentences.append(f"Residual {um(before)} µm RMS as written, {um(after)} µm once corrected.")
    if "log_posterior_odds" in numbers:
        odds = math.exp(min(numbers["log_posterior_odds"], math.log(LARGEST_ODDS)))
        number = f"{float(f'{odds:.3g}'):,.0f}"
        if odds > 0.999 * LARGEST_ODDS:
            number = f"more than {LARGEST_ODDS:,.0f}"
        sentences.append(f"Odds that something is wrong: {number} to 1.")
    if "correlation" in numbers and math.isfinite(numbers["correlation"]):
        probability = f"below {100.0 * LEAST_CHANCE:g} %"
        if numbers["chance"] >= LEAST_CHANCE:
            probability = f"{100.0 * numbers['chance']:.2g} %"
        sentences.append(
            f"Correlation {numbers['correlation']:.3f} over {numbers['rows']:.0f} lines; "
            f"probability by chance {probability}."
        )
    return " ".join(sentences)


def _places(session: Session, e: Explanation) -> tuple[Place, ...]:
    """Setups or rows that an explanation concerns; otherwise the files of its sessions."""
    if not e.rows:
        return tuple(Place(file=_file_of(session, name)) for name in e.sessions)
    if e.setups:
        return tuple(Place(setup=name) for name in e.setups[:MAX_PLACES])
    return tuple(place_of(session, i) for i in e.rows[:MAX_PLACES])


def place_of(session: Session, row: int) -> Place:
    """Place of a row: file, line, setup and posture."""
    reading = session.readings[row]
    file = reading.file or session.readings_path
    has_line = reading.line is not None
    return Place(
        file=str(file) if has_line and file is not None else None,
        line=reading.line,
        setup=reading.setup,
        posture=reading.postures,
    )


def _file_of(session: Session, label: str) -> str | None:
    """Path to the session.yaml of a joined session; None if unknown."""
    path = session.path_of(label)
    return None if path is None else str(path)


def _lines(session: Session, e: Explanation) -> str:
    """Lines that an explanation concerns, such as "lines 3 and 4: ".

    It is empty if the lines are unknown, those of several files, or all.
    """
    rows = [session.readings[i] for i in e.rows]
    lines = lines_in_file(rows)
    if not lines or len(rows) == len(session.readings):
        return ""
    file = "" if session.firmware is None else " of readings.csv"  # not lines of the log
    return f"{spans(lines, 'line')}{file}: "


def _row(session: Session, row: int) -> str:
    """Setup, postures and cycle of a reading; for a printer's log with the probed point."""
    reading = session.readings[row]
    if session.firmware is None or reading.minus is not None:
        return label_reading(session.robot, reading)
    x, y = session.firmware.touched(session.postures[reading.posture].drives)[0, :2] / MM
    return f"{reading.label_with_cycle} (x {x:.1f}, y {y:.1f} mm)"


def _subject(session: Session, e: Explanation) -> str:
    """Noun phrase for the readings that an explanation concerns."""
    if e.scope == "reading":
        return _row(session, e.rows[0])
    if e.scope == "posture":
        return f"{session.readings[e.rows[0]].label} in all cycles"
    if e.scope == "cycle":
        return f"setup {e.names[0]}, cycle {e.cycle}"
    if e.scope in ("leg", "gauge"):
        return f"all readings of {e.scope} {e.names[0]}"
    if e.scope == "session":
        return "all readings"
    return named("setup", e.setups)


def _text(session: Session, e: Explanation) -> str:
    """Description of an anomaly as a clause."""
    texts: dict[str, Callable[[], str]] = {
        "wrong unit": lambda: _written(
            session, e, UNITS.get(e.factor or 0.0, "in mm and read as inches")
        ),
        "decimal point": lambda: _written(session, e, "with a misplaced decimal point"),
        "reversed sign": lambda: _reversed(session, e),
        "misread dial": lambda: (
            f"{_subject(session, e)} was read {abs(e.amount or 0.0) / MM:g} mm too "
            f"{'high' if (e.amount or 0.0) > 0 else 'low'}, by one turn or one mark of the dial"
        ),
        "outlier": lambda: _wrong_reading(session, e),
        "inconsistent posture": lambda: (
            _wrong_reading(session, e)
            if e.scope == "posture"
            else f"the machine was not in posture {e.names[0]} when that was read"
        ),
        "inconsistent setup": lambda: f"setup {e.setups[0]} was not mounted as session.yaml states",
        "swapped rows": lambda: _swapped(session, e),
        "row offset": lambda: _offset(session, e),
        "stuck dial": lambda: (
            f"the dial stuck in setup {e.names[0]}, or a reading was written twice: from "
            f"{_row(session, e.rows[0])} on it shows the same {len(e.rows)} times"
        ),
        "displaced gauge": lambda: _displaced(session, e),
        "displaced artefact": lambda: _displaced_artefact(session, e),
        "wrong dimension": lambda: _other_dimension(session, e),
        "readjusted dimension": lambda: _other_dimension(session, e),
        "drift": lambda: _drifted(e),
        "backlash": lambda: (
            f"the drives have backlash: {_amounts(e)}. Readings differ by up to "
            f"{mm(e.amount or 0.0)} mm with the side from which a posture is approached"
        ),
        "thermal expansion": lambda: (
            f"the readings follow the temperature, by up to {mm(e.amount or 0.0)} mm: legs and "
            "screws expand differently"
        ),
        "periodic screw error": lambda: (
            f"the drives have a periodic error, {_amounts(e)}: readings change with the "
            f"turn of the screws by up to {mm(e.amount or 0.0)} mm"
        ),
        "other effect": lambda: (
            f"the readings show {_describe_effect(session, e.effect)}, by up to "
            f"{mm(e.amount or 0.0)} mm: {_amounts(e)}"
        ),
        "machine changed": lambda: _changed(session, e),
        "lost steps": lambda: _lost_steps(session, e),
        "offset of one drive": lambda: _changed(session, e),
        "offsets not entered": lambda: _entered(e, "not entered"),
        "offsets reversed": lambda: _entered(e, "entered with the wrong sign"),
        "offsets entered twice": lambda: _entered(e, "added twice"),
        "offsets interchanged": lambda: _entered(e, "interchanged"),
        **dict.fromkeys(BETWEEN_LOGS, lambda: _between_logs(e)),
        **dict.fromkeys(OF_BACKLASH, lambda: _compensated(session, e)),
    }
    return texts[e.kind]()


def _wrong_reading(session: Session, e: Explanation) -> str:
    """Clause about a reading that contradicts the others."""
    subject = _subject(session, e)
    if not _is_trigger(session, e):
        return f"{subject} was misread or mistyped"
    height = e.amount or 0.0  # the prescribed one, above that of the trigger
    side, cause = (
        ("above", "a bump, dirt or filament, or a trigger that came too early")
        if height < 0.0
        else ("below", "a dent, or a trigger that came too late")
    )
    return f"{subject} triggered {mm(abs(height))} mm {side} the surface of the others: {cause}"


def _is_trigger(session: Session, e: Explanation) -> bool:
    """True if an explanation concerns a reading that a switch triggered."""
    return states_readings(session.setups[session.readings[e.rows[0]].setup].sensor)


def _amounts(e: Explanation) -> str:
    """Significant parameters of an effect, such as "x_slide.backlash 0.045 ± 0.010 mm"."""
    texts = []
    for name, amount, std, unit in _significant_amounts(e):
        _, factor = EDGE_UNITS[unit]
        shown = f"{plain(amount / factor)} ± {plain(2.0 * std / factor)}"
        texts.append(f"{name} {shown} {unit_in_text(unit)}")
    return joined(texts)


def _drifted(e: Explanation) -> str:
    """Clause about a drift of gauges."""
    if len(e.setups) == 1:
        return f"the readings of setup {e.setups[0]} drifted from the first to the last"
    if not e.amounts:
        return "the readings of every setup drifted alike from its first to its last"
    return f"the gauges drifted while they were read, by up to {mm(e.amount or 0.0)} mm in a setup"


def _written(session: Session, e: Explanation, how: str) -> str:
    """Clause about readings that were written in a wrong unit or form."""
    subject = _subject(session, e)
    be = "were" if subject.startswith(("all", "setups")) else "was"
    return f"{subject} {be} written {how}"


def _displaced(session: Session, e: Explanation) -> str:
    """Clause about a displaced gauge."""
    if e.scope == "cycle":
        return f"the gauge of setup {e.names[0]} was displaced before cycle {e.cycle}"
    if _is_trigger(session, e):
        return (
            f"the probe or the bed moved before {_row(session, e.rows[0])}: all later points are "
            "shifted"
        )
    return (
        f"the gauge of setup {e.names[0]} was displaced before {_row(session, e.rows[0])}: all "
        "later readings of that setup are shifted"
    )


def _offset(session: Session, e: Explanation) -> str:
    """Clause about readings that were written into a wrong row."""
    first = _row(session, e.rows[0])
    of_setup = f" of setup {e.names[0]}" if e.scope == "setup" else ""
    if e.missing:
        return f"{first} was not read, and all later readings{of_setup} are one line too early"
    return (
        f"the reading before {first} was written twice, and all later readings{of_setup} are one "
        "line too late"
    )


def _reversed(session: Session, e: Explanation) -> str:
    """Clause about a reversed sign."""
    signs = "sign of {} is" if e.scope in ("reading", "posture") else "signs of {} are"
    return f"the {signs.format(_subject(session, e))} reversed"


def _displaced_artefact(session: Session, e: Explanation) -> str:
    """Clause about a displaced artefact, such as a ball post, with its session."""
    label, artefact = split_label(e.names[0], joined=session.joined)
    name = f"{artefact.replace('.', ' ')}{f' of session {label}' if label else ''}"
    how = "displaced or turned over" if can_turn(session, e) else "displaced"
    return f"{name} was {how} before setup {e.setups[0]}"


def _dimensions_mm(e: Explanation) -> tuple[float, float]:
    """True and stated size of a wrong or readjusted dimension, [mm]."""
    stated = float(e.names[1])
    return stated + (e.amount or 0.0) / MM, stated


def _other_dimension(session: Session, e: Explanation) -> str:
    """Clause about a wrong or readjusted dimension with its true and stated size."""
    true, stated = _dimensions_mm(e)
    what = e.names[0].rpartition(".")[2].removesuffix("_mm")
    where, there = f" in {_subject(session, e)} is", ""
    if e.kind == "readjusted dimension":
        since = f" before session {e.names[2]}" if len(e.names) > 2 else ""
        where, there = f" was changed{since}: it is", " there"
    zeroed = f", or the dial was not zeroed at {stated:g} mm" * has_known_zero(session, e)
    return f"the {what}{where} {plain(true)} mm{there}, not {stated:g} mm{zeroed}"


def _swapped(session: Session, e: Explanation) -> str:
    """Clause about swapped rows."""
    if e.scope == "setup":
        return f"the readings of setup {e.setups[0]} were written in reverse order"
    half = len(e.rows) // 2
    names = {
        "reading": lambda: (
            f"the readings {_row(session, e.rows[0])} and {_row(session, e.rows[half])}"
        ),
        "posture": lambda: f"{e.names[1]} and {e.names[2]} in all cycles of setup {e.names[0]}",
        "postures": lambda: f"the readings of postures {e.names[0]} and {e.names[1]} in all setups",
        "setups": lambda: f"the readings of setups {e.setups[0]} and {e.setups[1]}",
        "legs": lambda: f"the readings of legs {e.names[0]} and {e.names[1]}",
    }
    return f"{names[e.scope]()} were swapped"


def _changed(session: Session, e: Explanation) -> str:
    """Clause about a change of the machine, or an offset that looks like one."""
    when = f"before session {e.sessions[0]}"
    if e.apart:
        when = f"for {named('session', e.sessions)} only"
    amount = _amount_of_change(session, e)
    if e.drives and session.firmware is None:
        return (
            f"drive {joined(e.drives)} or its home switch moved{amount} {when}, or "
            f"{_other_offset(session, e)}"
        )
    what, verb, otherwise = joined(e.parameters), "changed", ""
    if e.drives:
        what, verb = name_offsets(e.drives, firmware=True), "moved"
    elif is_backlash(e):
        otherwise = ", or the controller compensates another backlash than the stated one"
    return f"the machine changed: {what} {verb}{amount} {when}{otherwise}"


def _lost_steps(session: Session, e: Explanation) -> str:
    """Clause about a drive whose offset differs from some reading on."""
    reading = session.readings[e.first or 0]
    line = "" if reading.line is None else f"line {reading.line}, "
    of_session = f" of session {e.sessions[0]}" if e.sessions else ""
    return (
        f"drive {joined(e.drives)} lost steps or slipped, at about {line}"
        f"{_row(session, e.first or 0)}: it moved{_amount_of_change(session, e)}, and later "
        f"readings{of_session} do not fit the earlier ones"
    )


def _amount_of_change(session: Session, e: Explanation) -> str:
    """Amount of a change with its limits, such as " by +0.100 ± 0.020 mm"; "" if unknown."""
    if e.amount is None or not e.parameters:
        return ""
    p = session.robot.parameters[e.parameters[0]]
    uncertainty = "" if e.std is None else f" ± {plain(2.0 * e.std * p.edge_factor)}"
    return f" by {signed(e.amount * p.edge_factor)}{uncertainty} {p.edge_unit}"


def _other_offset(session: Session, e: Explanation) -> str:
    """Clause about a drive with another offset in the controller than the stated one.

    An offset that is too small by an amount has the effect of an offset error of this amount.
    """
    names = list(dict.fromkeys(session.labels))
    first = names.index(e.sessions[0]) if e.sessions[0] in names else None
    if e.amount is None or first is None:
        return "its offset in the controller is not the stated one"
    if len(session.parts) == len(names) and session.parts[first].controller_offsets is None:
        return "an offset is in the controller that the session does not state"
    drive = [d.name for d in session.robot.drives].index(e.drives[0])
    p = session.robot.parameters[e.parameters[0]]
    setup = list(session.setups)[session.labels.index(e.sessions[0])]
    stated = float(session.active_during(setup)[drive])
    uncertainty = "" if e.std is None else f" ± {plain(2.0 * e.std * p.edge_factor)}"
    actual = f"{signed((stated - e.amount) * p.edge_factor)}{uncertainty} {p.edge_unit}"
    return (
        f"its offset in the controller is not {signed(stated * p.edge_factor)} {p.edge_unit} as "
        f"stated, but {actual}"
    )


def _entered(e: Explanation, how: str) -> str:
    """Clause about wrongly entered offsets."""
    which = "offset of {} was" if len(e.drives) == 1 else "offsets of {} were"
    return f"in session {e.sessions[0]} the {which.format(joined(e.drives))} {how}"


def _between_logs(e: Explanation) -> str:
    """Clause about settings of a printer's firmware that were not active as stated, or its bed."""
    if e.kind == "bed moved":
        return (
            f"the bed was tilted before session {e.sessions[0]}, or endstops differ from those "
            "that it states"
        )
    if e.kind == "settings interchanged":
        return f"in session {e.sessions[0]} the firmware had interchanged {joined(e.names)}"
    return (
        f"the settings that session {e.sessions[0]} states were not active: the firmware still had "
        f"the previous {joined(e.names or ('settings',))}"
    )


def _compensated(session: Session, e: Explanation) -> str:
    """Clause about a backlash that the controller does not compensate as stated.

    A single session does not distinguish it from a larger backlash.
    """
    drives = zip(session.robot.drives, e.active, strict=True)
    part, size = "does not compensate the stated", "twice the stated one"
    if e.kind == "backlash halved":
        part, size = "compensates only half of the stated", "1.5 times the stated one"
    elif e.kind == "backlash entered twice":
        part, size = "compensates twice the stated", "almost 0"
    elif any(active for drive, active in drives if drive.name in e.drives):
        part = "still compensates the previous"
    text = f"the controller {part} backlash of {joined(e.drives)}"
    if e.sessions:
        return f"in session {e.sessions[0]} {text}"
    return f"{text}, or the backlash is {size}"
