"""Short answer of a calibration: subject, decision, values to enter, tool error, next step."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from orthocal.assessment.assess import assessment_of, gains_from_correction
from orthocal.assessment.controller_entries import expanded_uncertainty, readings_limit
from orthocal.assessment.plausibility import describe_legs
from orthocal.assessment.wording import counted, joined, plain, signed
from orthocal.assessment.words.anomalies import describe_evidence
from orthocal.assessment.words.entries import (
    CHOICE_STEP,
    describe_compensated,
    describe_region,
    describe_use_parts,
)
from orthocal.calibration.assessment_record import (
    Assessment,
    Decision,
    Finding,
    FindingKind,
    Verdict,
)
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.refit import restore_session
from orthocal.effects.compensation import home_positions
from orthocal.output.text.accuracy import FurtherHour, describe_undetermined
from orthocal.output.text.layout import (
    EXPANDED,
    bullets,
    indented,
    list_places,
    noted,
    section,
    short_name,
    table_of,
    table_of_records,
)
from orthocal.session.points import one_row_per_point
from orthocal.session.session import split_label
from orthocal.text import quote_path, uncapitalised
from orthocal.units import DRIVE_UNITS, show_limit, tidy

NEXT_NAMES = dict(pairwise(("first", "second", "third", "fourth", "fifth", "sixth")))
"""Directory of a session, mapped to that of the next one."""

MOST_LISTED = 4
"""Further findings that the short answer lists."""

LISTED: tuple[FindingKind, ...] = (
    "wrong order",
    "no change",
    "change unknown",
    "above tolerances",
    "no redundancy",
    "no convergence",
    "earlier readings",
    "compensation not stated",
    "periodic errors",
    "held by a bound",
    "not significant",
    "settings improve",
    "line assumed",
    "effect not shown",
    "effects inseparable",
)
"""Kinds of notes that the short answer lists."""

DETAILS: tuple[FindingKind, ...] = ("common approach",)
"""Kinds of findings about readings that only `--details` prints."""

STYLES: dict[Verdict, str] = {"enter": "bold green", "review": "bold yellow", "reject": "bold red"}

LONGEST_LINE = 150
"""Characters of a line with names from files, in the short answer."""

CONVERTED = "`orthocal export` converts it to HOME_OFFSET."
"""How an offset becomes a value of the controller."""

NEW_NOTE = f"new: total offset, which replaces now. {CONVERTED}"
"""Meaning of the column `new` of offsets."""

PRINT = "print. After a crash or a change of the printer probe again."
"""Next step if the settings of a printer are kept."""

MORE = "--details prints all readings, all errors of the machine and the tool error."


def render_answer(
    calibration: Calibration,
    *,
    heading: bool = True,
    saved: Path | None = None,
    further: FurtherHour | None = None,
) -> RenderableType:
    """The short answer.

    Args:
        calibration: The calibration.
        heading: Whether to begin with the machine and its readings.
        saved: Directory in which the calibration was written, for the next step.
        further: Expected tool errors after another hour; by default computed if needed.
    """
    assessment = assessment_of(calibration)
    parts: list[RenderableType] = [render_subject(calibration), Text()] if heading else []
    parts += [render_headline(assessment.decision), Text()]
    notes = [_describe(f, assessment.decision) for f in _listed(calibration, assessment)]
    if assessment.decision.verdict == "enter":
        parts += _values(calibration, assessment) + _tool(calibration, assessment)
        notes += describe_undetermined(calibration, further)
    parts.append(bullets(notes))
    return Group(*parts, render_next(*_next_step(calibration, assessment, saved)))


def _values(calibration: Calibration, assessment: Assessment) -> list[RenderableType]:
    """Values to enter, with notes."""
    parts: list[RenderableType] = []
    unstated = [f.words for f in assessment.of_kind("controller not stated")]
    if assessment.entries:
        notes = unstated or describe_columns(calibration)
        parts += [indented(entry_table(calibration)), *(indented(Text(t)) for t in notes), Text()]
    if assessment.backlash:
        parts += [indented(render_backlash(calibration)), Text()]
    return parts


def render_next(words: str, commands: Sequence[str] = ()) -> RenderableType:
    """The next step, with commands on lines of their own that can be copied."""
    lines = [Text(f"  {command}", no_wrap=True, overflow="ignore") for command in commands]
    return Group(Text.assemble(("Next: ", "bold"), words), *lines)


def render_decision(assessment: Assessment, *, details: bool = False) -> RenderableType:
    """A decision about readings, its findings, and the next step.

    Args:
        assessment: The assessment.
        details: Whether to list all findings, and the evidence for each.
    """
    decision = assessment.decision
    parts: list[RenderableType] = [render_headline(decision)]
    further = [
        _describe(f, decision)
        for f in assessment.findings
        if f.text != decision.reason and (details or f.kind not in DETAILS)
    ]
    if further:
        parts += [Text(), bullets(further)]
    if decision.action:
        parts.append(render_next(decision.action))
    evidence = [e for f in assessment.findings if (e := describe_evidence(f))]
    if details and evidence:
        parts.append(section("Evidence", bullets(evidence)))
    return Group(*parts)


def _describe(finding: Finding, decision: Decision) -> str:
    """Text of a finding, and its action if the decision does not contain it."""
    return finding.text if finding.action[1:] in decision.action else finding.words


def render_headline(decision: Decision) -> Text:
    """Headline of a decision, and its reason."""
    doubtful = decision.verdict == "enter" and decision.exit_code  # not confirmed
    headline = (decision.headline, STYLES["review" if doubtful else decision.verdict])
    return Text.assemble(headline, f" {decision.reason}".rstrip())


def describe_columns(calibration: Calibration) -> list[str]:
    """Meaning of the columns `new` and `joint`, in sentences; none without these columns."""
    assessment = assessment_of(calibration)
    if assessment.keeps_offsets:
        return []
    notes = [] if assessment.of_kind("controller not stated") else [NEW_NOTE]
    if down := [d.name for d in calibration.robot.drives if d.direction < 0]:
        verb = "counts" if len(down) == 1 else "count"
        notes.append(
            f"joint: change of the controller's joint, with its sign; {joined(down)} {verb} down."
        )
    return notes


def _tool(calibration: Calibration, assessment: Assessment) -> list[RenderableType]:
    """The expected tool error."""
    if assessment.tool is None:
        unreached = assessment.of_kind("out of reach")
        return [Text(unreached[0].text if unreached else "The tool error is unknown.")]
    texts = [f.text for f in assessment.of_kind("tool error")]
    return [Text(text) for text in (*texts, *describe_conditions(calibration))]


def describe_conditions(calibration: Calibration) -> list[str]:
    """Tool error with more than offsets corrected, if identified; region and conditions of use."""
    tool = assessment_of(calibration).tool
    if tool is None:
        return []
    compensated = describe_compensated(tool.compensated)
    if calibration.session.firmware is not None:  # no other sentence introduces the tool error
        compensated = f"Expected tool error {uncapitalised(compensated)}"
    first = [] if calibration.only_offsets else [compensated]
    return [*first, describe_region(tool), *describe_use_parts(tool)]


def _listed(calibration: Calibration, assessment: Assessment) -> Sequence[Finding]:
    """Further findings that matter before anything is entered, the gravest first."""
    kinds = LISTED if assessment.decision.verdict == "enter" else ()
    listed = [
        f
        for f in assessment.findings
        if (f.severity != "note" or f.kind in kinds) and f.text != assessment.decision.reason
    ]
    if assessment.keeps_offsets:
        listed = [f for f in listed if f.kind not in ("must change", "not significant")]
    if calibration.only_offsets:  # legs and axes are left out, which matters more
        listed = [f for f in listed if f.kind != "line assumed"]
    return listed[:MOST_LISTED]


def _next_step(
    calibration: Calibration, assessment: Assessment, saved: Path | None
) -> tuple[str, tuple[str, ...]]:
    """The next action, and the commands for it."""
    decision, unchanged = assessment.decision, assessment.keeps_offsets
    if decision.verdict != "enter":
        return decision.action or "none.", ()
    if saved is None:
        return "keep the result by adding `--out DIRECTORY` to this command.", ()
    firmware = calibration.session.firmware
    if firmware is not None:
        if unchanged:
            return "none." if assessment.of_kind("settings unknown") else PRINT, ()
        directory, new = (quote_path(p) for p in (saved, f"{saved}-{firmware.firmware}"))
        return "write settings for the firmware; its README says what to expect.", (
            f"orthocal export {directory} --to {firmware.firmware} --out {new}",
        )
    paths = (saved, next_session(calibration, saved), f"{saved}-linuxcnc")
    directory, new, module = (quote_path(path) for path in paths)
    home = f"{saved}-home"
    offsets = (
        f"orthocal export {directory} --to linuxcnc --offsets --ini FILE --out {quote_path(home)}"
    )
    gains = gains_from_correction(calibration, assessment.tool)
    if gains and (unchanged or calibration.measured_again):
        words = "correct the other errors, in LinuxCNC or in programs."
        if not unchanged:
            words = uncapitalised(CHOICE_STEP)
        active = "" if unchanged else " --offsets active"
        return words, (
            *(() if unchanged else (offsets,)),
            f"orthocal export {directory} --to linuxcnc --ini FILE --out {module}",
            f"orthocal correct {directory} PROGRAM.ngc{active} --out CORRECTED.ngc",
        )
    changes = [] if unchanged else ["the offsets"]
    changes += ["the backlash"] * any(e.change for e in assessment.backlash)
    words = "nothing to enter. After a crash or a change of the machine measure again."
    if changes:
        words = (
            f"enter {joined(changes)} (the first command writes the lines for LinuxCNC), home the "
            "machine and measure again."
        )
    in_linuxcnc = bool(changes) and home_positions(calibration.session.compensation) is not None
    ini = f" --ini {quote_path(f'{home}/joints.ini')}" if in_linuxcnc else ""
    return words, (
        *([offsets] if changes else []),
        f"orthocal again {directory}{ini} --out {new}",
        f"orthocal record {new}",
        f"orthocal validate {directory} {new}",
    )


def next_session(calibration: Calibration, saved: Path) -> Path:
    """Directory of the next session, beside a calibration; named after the last session."""
    last = (calibration.session.parts or (calibration.session,))[-1].path
    if last is None:
        return Path(f"{saved}-again")
    name = Path(os.path.abspath(last)).parent.name
    return saved.parent / NEXT_NAMES.get(name, f"{name}-again")


def calibrate_command(
    sessions: Sequence[Path],
    tolerances: Mapping[str, float],
    *,
    folder: Path | None = None,
    calibration: Calibration | None = None,
) -> str:
    """Command that calibrates from several sessions.

    Args:
        sessions: Directories of the sessions.
        tolerances: Tolerances that differ from those of the robot, by their keys.
        folder: Directory in which the command is typed; by default the present one.
        calibration: Calibration whose model, effects and known values the command repeats.
    """
    paths = sessions if folder is None else [os.path.relpath(s, folder) for s in sessions]
    names = [quote_path(path) for path in paths]
    options = [f"--tolerance {quote_path(f'{key}={value:g}')}" for key, value in tolerances.items()]
    options += [] if calibration is None else _repeat_choice(calibration)
    out = quote_path(_name_calibration(sessions[-1], folder))
    return " ".join(["orthocal calibrate", *names, *options, "--out", out])


def _name_calibration(session: Path, folder: Path | None) -> str:
    """Directory of a calibration beside its session, as seen from a directory.

    Args:
        session: Directory or YAML of the session.
        folder: The directory; None for the present one.
    """
    named = session.parent if session.suffix == ".yaml" else session
    if folder is None and named.name not in ("", ".."):
        return f"{named}-calibration"
    return os.path.relpath(f"{os.path.abspath(named)}-calibration", folder or Path())


def _repeat_choice(calibration: Calibration) -> list[str]:
    """Options of a command that estimates the same: model, effects and known values."""
    purpose, robot = calibration.session.purpose, calibration.robot
    stated = purpose.model if purpose is not None and purpose.model else "full"
    options = []
    if calibration.model != stated and calibration.model in robot.parameters.models:
        options.append(f"--model {quote_path(calibration.model)}")
    if robot.chosen_effects is not None:
        options.append(f"--effects {quote_path(','.join(robot.chosen_effects) or 'none')}")
    for p in calibration.parameters:
        value = f"{p.name}_{p.edge_unit}={tidy((p.mean if p.free else p.value) * p.edge_factor)}"
        if not p.free:
            options.append(f"--known {quote_path(value)}")
        elif p.prior and p.mean != 0.0:
            limit = tidy(show_limit(p.prior_std) * p.edge_factor)
            options.append(f"--known {quote_path(f'{value}±{limit}')}")
    return options


def render_subject(calibration: Calibration) -> RenderableType:
    """Machine and readings of a calibration, in four lines."""
    title = short_name(calibration.session.title, LONGEST_LINE)
    return Group(
        Text(
            f"Calibration of {calibration.robot_record.name}, model '{calibration.model}'",
            style="bold",
        ),
        *([Text(title)] if title else []),
        Text(short_name(f"Machine: {describe_machine(calibration)}", LONGEST_LINE)),
        Text(short_name(_measured(calibration), LONGEST_LINE)),
    )


def render_method(calibration: Calibration, *, effort: bool = True) -> RenderableType:
    """Source of the readings, model and solver.

    Args:
        calibration: The calibration.
        effort: Whether to state iterations and time of the solver.
    """
    source, solver = calibration.session.source, calibration.solver
    with_prior = sum(p.prior for p in calibration.free)
    prior = "tolerances as prior" if with_prior else "no prior"
    if 0 < with_prior < len(calibration.free):
        prior = f"{with_prior} with a prior"
    kind = "base parameter" if calibration.base else "parameter"
    loss = ", Huber's loss" if solver.loss == "huber" else ""
    lines = [f"Source: {source}"] if source else []
    lines.append(f"Estimated: {counted(len(calibration.free), kind)}, {prior}{loss}")
    if effort:
        lines.append(
            f"Solver: {solver.name}, {solver.status}, {counted(solver.iterations, 'iteration')}, "
            f"{solver.seconds_build + solver.seconds_solve:.2f} s"
        )
    return Group(*map(Text, lines))


def _measured(calibration: Calibration) -> str:
    kind = "difference" if calibration.rows_are_differences else "reading"
    session = one_row_per_point(restore_session(calibration))
    read = {r.setup for r in session.readings}
    setups = [s for s in session.setups.values() if s.name in read]
    unread = [name for name in session.setups if name not in read]
    places = list_places(s.sensor.place for s in setups)
    sessions = len(calibration.session.parts)
    used = {
        split_label(name, joined=sessions > 0)[1]
        for r in session.readings
        for name in (r.posture, r.minus)
        if name
    }
    of_sessions = f" of {counted(sessions, 'session')}" if sessions else ""
    return (
        f"Measured: {counted(len(session.readings), kind)}{of_sessions} in "
        f"{counted(len(used), 'posture')}, {counted(len(setups), 'setup')} on {places}"
        + (f"; no reading of {', '.join(unread)}" if unread else "")
    )


def describe_machine(calibration: Calibration) -> str:
    """Dimensions of the machine: legs and travel."""
    travel = {}
    for name, unit, *ends in calibration.robot_record.travel:
        word, size = DRIVE_UNITS[unit]
        low, high = ("∞" if v is None else f"{v / size:g}" for v in ends)
        travel[name] = f"{low} … {high} {word.replace('deg', '°')}".replace("∞ …", "−∞ …")
    words = []
    if calibration.robot_record.legs:
        words.append(describe_legs(calibration.robot))
    if len(set(travel.values())) == 1:
        words.append(f"travel {next(iter(travel.values()))}")
    else:
        words.append(f"travel {', '.join(f'{n} {t}' for n, t in travel.items())}")
    return ", ".join(words)


def name_values(calibration: Calibration) -> str:
    """Heading of `render_values`: what happens to the offsets."""
    assessment = assessment_of(calibration)
    if assessment.decision.verdict != "enter":
        return "Values (do not enter them)"
    return "Offsets" if assessment.keeps_offsets else "Values to enter"


def render_values(calibration: Calibration) -> RenderableType:
    """Meaning of the values to enter, and those that the short answer does not list."""
    assessment = assessment_of(calibration)
    if calibration.session.firmware is not None:
        settings = (
            "No offsets: the firmware has settings. `orthocal export` states them with their ±."
        )
        return noted(Text(settings), EXPANDED)
    if not assessment.entries:
        return noted(Text("None: no offset was identified."), EXPANDED)
    trusted = assessment.decision.verdict == "enter"
    complete = trusted and calibration.only_offsets
    table = entry_table(calibration, identified=not calibration.only_offsets)
    keep, stated = assessment.keeps_offsets, assessment.entries[0].active is not None
    meaning = "Drive coordinate = encoder coordinate + offset."
    has_new = trusted and stated and not keep
    notes = [meaning, *([NEW_NOTE] if has_new and not complete else [])]
    notes += [f.words for f in assessment.of_kind("controller not stated")]
    notes.append(EXPANDED)
    if trusted and not calibration.only_offsets:
        notes.append(
            "For a controller that corrects nothing else the best value is "
            f"`{'best' if keep else 'new'}`; it compensates a part of the other errors. "
            "identified: offset of the drive, for a controller that corrects all identified errors."
        )
    return noted(Group() if complete else table, *notes)


def render_backlash(calibration: Calibration) -> RenderableType:
    """Backlash for the controller to take up, drive by drive; a line if there is none to enter.

    "unchanged" and "not determined" keep the present value. Readings do not limit a backlash that
    is not determined.
    """
    entries = assessment_of(calibration).backlash
    rows, known, small = [], False, True
    largest: dict[str, float] = {}
    for e in entries:
        factor, uncertainty = e.edge_factor, expanded_uncertainty(calibration, e)
        half = plain(uncertainty * factor)
        is_known = e.active > 0.0 or e.identified > uncertainty
        known |= is_known or bool(e.change)
        limited = readings_limit(calibration, f"{e.drive}.backlash")
        small &= limited
        keep = "unchanged" if limited else "not determined"
        enter = plain(e.enter * factor) if e.change else keep
        rows.append((e.drive, plain(e.active * factor), enter, half, e.edge_unit))
        largest[e.edge_unit] = max(uncertainty * factor, largest.get(e.edge_unit, 0.0))
    if not known:
        halves = joined([f"±{plain(v)} {unit}" for unit, v in largest.items()])
        return Text(f"Backlash: {'not significant' if small else 'not determined'} ({halves}).")
    return table_of(("backlash", "now", "new", "±", "unit"), rows)


def entry_table(calibration: Calibration, *, identified: bool = False) -> Table:
    """Values to enter, drive by drive.

    Args:
        calibration: The calibration.
        identified: Whether to list the identified offsets, too.
    """
    assessment = assessment_of(calibration)
    keep = assessment.keeps_offsets
    directions = {d.name: d.direction for d in calibration.robot.drives}
    counts_down = not keep and any(directions[e.drive] < 0 for e in assessment.entries)
    rows = []
    for e in assessment.entries:
        factor, best = e.edge_factor, "add"
        row = {"drive": e.drive}
        if e.active is not None:
            row["now"], best = signed(e.active * factor), "new"
        row["best" if keep else best] = signed(e.best * factor)
        row["±"] = e.held or plain(expanded_uncertainty(calibration, e) * factor)
        if counts_down:
            row["joint"] = signed(directions[e.drive] * e.change * factor)
        if identified:
            row["identified"] = signed(e.identified * factor)
        rows.append(row | {"unit": e.edge_unit})
    return table_of_records(rows)
