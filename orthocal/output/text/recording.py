"""Text of the dialogue in which readings are recorded, wrapped to the terminal."""

from __future__ import annotations

import math
import shutil
import textwrap
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from orthocal.assessment.judgement import is_far
from orthocal.assessment.wording import counted, joined, mm, name_direction
from orthocal.calibration.assessment_record import Finding
from orthocal.errors import OrthocalError
from orthocal.measurement.motion.approach import (
    approach_length,
    approach_rule,
    describe_approach,
    fill_approach,
    label_reading,
)
from orthocal.measurement.motion.guidance import (
    describe_mounting,
    guide,
    set_dial,
    shown_tool,
)
from orthocal.measurement.motion.motion import common_approach, plan_motion
from orthocal.measurement.recorded_rows import RecordedReading
from orthocal.measurement.recording import Recording
from orthocal.output.sheet.gauge_position import hinge_distances
from orthocal.output.text.answer import calibrate_command
from orthocal.robot.model import drive_keys, name_coordinates
from orthocal.sensors.points import Points
from orthocal.sensors.protocol import instrument, mounting_steps, probing_direction, reads_pairs
from orthocal.session.points import base_name, one_row_per_point
from orthocal.session.session import Conditions, Reading, Session, Setup
from orthocal.text import printable, quote_path, spans
from orthocal.units import MM, format_fixed, to_mm, trim_zeros

WIDEST = 100
"""Largest width of a line, [columns]."""

MAX_SUSPECTS = 3
"""Most lines of possible mistakes that are listed."""

GLUE = "\u00a0"
"""Space at which no line ends."""

COMMANDS = {
    "back": "correct the last reading; `back 7` line 7, also after `drop 7`",
    "repeat": "read the last line once more, as another cycle; `repeat 7` line 7",
    "skip": "leave this line empty for now",
    "drop": "delete this line from the session; `drop 7` line 7",
    "restart": "delete the readings of this setup and read it again, if gauge or stand has moved; "
    "`restart 7` the setup of line 7; it is typed twice",
    "temperature": "temperature in °C of this reading and the next ones, such as `t 22.5`; after "
    "`back`, of the corrected reading only",
    "side": "approach of this reading and the next ones, unless the plan states it: `side n`; "
    "after `back`, of the corrected reading only",
    "clock": "begin or stop to note the time of each reading; stop if you type from paper",
    "list": "all lines and their readings",
    "show": "this setup and posture once more",
    "help": "this list",
    "quit": "end; all readings are kept, and the same command continues",
}
"""Commands instead of a reading; any unique beginning of the name suffices."""


class RecordingText:
    """Texts of the dialogue about a recording, in lines of the terminal's width."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._session = recording.session
        self._guidance = guide(recording.session)

    @property
    def programmed_approach(self) -> str:
        """Approach of a program whose plan states none."""
        return common_approach(self._session) or fill_approach(self._session.robot, None, "p")

    def question(self, condition: str, temperature: float | None, approach: str) -> str:
        """Question for a condition of the next readings.

        Args:
            condition: "approach" or "temperature".
            temperature: That of the readings before, [°C].
            approach: Approach that Enter accepts.
        """
        if condition == "temperature":
            keep = "leaves it open" if temperature is None else f"keeps {temperature:g} °C"
            return f"Temperature of the machine in °C? Enter {keep}. `t 22.5` changes it later."
        source = "typed before"
        if approach == self.programmed_approach:
            printer = self._session.firmware is not None
            source = "the lines to send do" if printer else "the programs do"
        drives = ", ".join(d.name for d in self._session.robot.drives)
        return (
            f"From which side are the postures approached? One letter for each of {drives}, or "
            "one for all: p if its drive coordinate grows at the end, n if it falls, u if unknown. "
            f"Enter: {approach} ({describe_approach(self._session.robot, approach)}), "
            f"as {source}. `side n` changes it later."
        )

    def conditions(self, conditions: Conditions, *, alone: bool) -> str:
        """Conditions that are noted with the reading that is asked for.

        Args:
            conditions: The conditions.
            alone: Whether they are not noted with the next readings, too.
        """
        noted = ", ".join(self._by_command(conditions).values())
        readings = "this reading only" if alone else "this reading and the next ones"
        return f"Noted with {readings}: {noted or 'no temperature'}."

    def _by_command(self, conditions: Conditions) -> dict[str, str]:
        """Stated approach and temperature, by a command that changes them."""
        noted = {}
        if conditions.approach is not None:
            noted["side n"] = f"approach {self._side(conditions.approach)}"
        if conditions.temperature is not None:
            noted["t 20"] = f"{conditions.temperature:g} °C"
        return noted

    def _side(self, approach: str) -> str:
        """Arrows of an approach, and its letters in brackets."""
        return f"{describe_approach(self._session.robot, approach)} ({approach})"

    def unusual_temperature(self, temperature: float) -> str:
        """Question whether a temperature, [°C], is right."""
        return f"Is {temperature:g} °C the temperature of the machine? Otherwise type it: `t 20`."

    def planned_side(self, approach: str) -> str:
        """Refusal of a side for a reading whose approach the plan states."""
        return (
            f"The plan states the side of this reading: {self._side(approach)}. `side` cannot "
            "change it. If the machine came from another side, approach the posture again as the "
            "arrows show. Then read the gauge and type the reading."
        )

    def clock(self, *, on: bool) -> str:
        """Answer to the command that begins or stops noting the times of readings."""
        if on:
            return "The time of each reading is noted."
        return "The time is not noted; lines count as read in their order, a minute apart."

    @property
    def width(self) -> int:
        """Width of the terminal, [columns]."""
        return min(shutil.get_terminal_size((WIDEST, 24)).columns, WIDEST)

    def wrap(self, text: str, *, indent: str = "", first: str | None = None) -> str:
        """A paragraph in lines.

        Args:
            text: The paragraph.
            indent: Beginning of each line.
            first: Beginning of the first line, if it is another.
        """
        lines = textwrap.wrap(
            printable(text, keep=GLUE),
            max(self.width, 20),
            initial_indent=indent if first is None else first,
            subsequent_indent=indent,
            break_on_hyphens=False,
        )
        return "\n".join(lines).replace(GLUE, " ")

    def introduction(self, conditions: Conditions) -> str:
        """Number of readings, state of the recording, and how to type readings.

        Args:
            conditions: Conditions of the next readings that an earlier recording states.
        """
        recording, session, rows = self._recording, self._session, self._recording.rows
        restored = recording.restored
        every, done = recording.count, recording.count - recording.missing_count
        title = f"{session.title}: " if session.title else ""
        count = counted(len({r.setup_in_file for r in rows}), "setup")
        state = "none is recorded yet" if not done else f"{done} are recorded"
        parts = [f"{title}{counted(every, 'reading')} in {count} on {session.robot.name}; {state}."]
        if restored:
            parts.append(
                f"The last recording was interrupted; {counted(restored, 'change')} of it "
                f"{'was' if restored == 1 else 'were'} restored."
            )
        if recording.edited:
            parts.append(
                f"{recording.path.name} was edited after the last recording was interrupted; its "
                "content counts."
            )
        parts += [
            f"{e}. It counts as missing: type it again." for e in recording.wrong[:MAX_SUSPECTS]
        ]
        parts.append(
            f"{self._what_to_type()} It is stored at once. `help` lists the commands. "
            "Lines are those of the sheet and of readings.csv."
        )
        parts += [
            f"Noted with the next readings, as typed before: {noted}. `{change}` changes it."
            for change, noted in self._by_command(conditions).items()
        ]
        if recording.following.clock is False:
            parts.append(f"{self.clock(on=False)} `clock` changes it.")
        if rule := approach_rule(replace(session, readings=rows)):
            parts.append(rule.format(approach_length(session)))
        return "\n".join(self.wrap(part) for part in parts)

    def _what_to_type(self) -> str:
        """Instruction for typing a reading or a point."""
        sensors = [s.sensor for s in self._session.setups.values()]
        nouns = dict.fromkeys(instrument(s) for s in sensors if not isinstance(s, Points))
        reading = f"Type the reading of the {joined(tuple(nouns), 'or')} in mm." if nouns else ""
        points = any(isinstance(s, Points) for s in sensors)
        point = "Type x, y and z of a point in mm, with blanks between them." if points else ""
        return f"{reading} {point}".strip()

    def instrument(self, index: int) -> str:
        """Noun for what shows the reading of a row."""
        return instrument(self._session.setups[self._recording.rows[index].setup].sensor)

    def moved(self, index: int) -> str:
        """Advice for a row of a setup after which another setup was read.

        Empty if the setup has no gauge that stays in its place.
        """
        row = self._recording.rows[index]
        setup, name = self._session.setups[row.setup], row.setup_in_file
        if reads_pairs(setup.sensor):
            return ""
        return (
            f"Another setup was read after {name}. If the {_name_gauge(setup, stand=True)} has "
            f"moved since, correct typing errors only, or type `restart {row.line}` to read {name} "
            "again."
        )

    def setup(self, index: int) -> str:
        """Position of the gauge of a row's setup, and preparation of its dial."""
        session, rows = self._session, self._recording.rows
        name, in_file = rows[index].setup, rows[index].setup_in_file
        setup = session.setups[name]
        names = list(dict.fromkeys(r.setup_in_file for r in rows))
        of_setup = [
            r
            for i, r in enumerate(rows)
            if r.setup_in_file == in_file and self._recording.point(i)[0] == i
        ]
        aligned, first = self._guidance.aligned_at[name], of_setup[0].minus or of_setup[0].posture
        go = "" if aligned == first else f"Then go to {first}. "
        title = (
            f"Setup {in_file}, {names.index(in_file) + 1} of {len(names)}: "
            f"{counted(len(of_setup), 'reading')}"
        )
        sensor = setup.sensor.in_file if isinstance(setup.sensor, Points) else setup.sensor
        measured = describe_mounting(session.robot, sensor, aligned)
        parts = [f"Place: {measured}", self._stand(name), _gauge(session, setup)]
        gauge, gauge_or_stand = _name_gauge(setup), _name_gauge(setup, stand=True)
        if any(r.is_read for r in of_setup) and any(r.minus is None for r in of_setup):
            parts.append(
                f"This setup has readings. If the {gauge_or_stand} has moved since, `restart` the "
                "setup."
            )
        elif isinstance(setup.sensor, Points):
            parts.append("From then on do not touch the instrument until the setup is complete.")
        elif probing_direction(setup.sensor) is not None:
            parts.append(
                f"{set_dial(session, name)} From the first reading on do not touch the "
                f"{gauge_or_stand} until the setup is complete."
            )
        elif not reads_pairs(setup.sensor):
            parts.append(
                f"Go to {aligned} and align the {gauge}. {go}{set_dial(session, name)} From then "
                f"on do not touch the {gauge_or_stand} until the setup is complete."
            )
        if any(not r.is_read for r in of_setup):
            parts.append(self._lifting(of_setup))
        if all(map(session.is_difference, of_setup)):
            parts.append(
                "Each line is a difference: the reading in its first posture minus that in its "
                "second."
            )
        lines = [self.wrap(title), *(self.wrap(part, indent="  ") for part in parts if part)]
        if aligned != first and not isinstance(setup.sensor, Points):
            lines.append(self._coordinates(aligned, f"{aligned}: "))
        return "\n".join(lines)

    def _lifting(self, readings: Sequence[Reading]) -> str:
        """Motions of a setup during which the plunger is held up, as the sheet names them.

        Args:
            readings: The readings of the setup.
        """
        session = replace(self._session, readings=tuple(readings), sha256="")
        try:
            (motion,) = plan_motion(one_row_per_point(session))
        except OrthocalError:  # the machine cannot go through the plan, so there is no sheet
            return ""
        return motion.lifting

    def _stand(self, setup: str) -> str:
        steps = mounting_steps(self._session.setups[setup].sensor)
        if steps is not None:
            return " ".join(steps)
        guidance = self._guidance
        aligned = guidance.aligned_at[setup]
        side = name_direction(guidance.contacts[setup][1].direction)
        distances = hinge_distances(self._session, setup, guidance)
        if distances:
            driven = self._session.robot.driven_noun
            at = f"{distances[aligned] / MM:.1f} mm from the hinge on the {driven}"
        else:
            point, origin = guidance.contact_point(setup)
            place = ", ".join(format_fixed(v / MM, 1) for v in point)
            at = f"at ({place}) mm from {origin}"
        return (
            f"Stand: on the {side} side, so that the tip in posture {aligned} touches {at}. Push "
            "the plunger in: the reading must grow. If it falls, enter every reading of this setup "
            "with the opposite sign."
        )

    def label(self, row: RecordedReading) -> str:
        """Setup, posture with the arrows of its approach, and the cycle from the second on."""
        return label_reading(self._session.robot, replace(row, setup=row.setup_in_file))

    def value(self, index: int) -> str:
        """Reading of a row, or the coordinates of its point, in mm, with two decimals or more."""
        values = np.atleast_1d(self._recording.value(index)).tolist()
        return ", ".join(trim_zeros(f"{to_mm(value) + 0.0:.6f}") for value in values)

    def row(self, index: int) -> str:
        """Next reading, and the posture of the machine for it."""
        rows = self._recording.rows
        row = rows[index]
        missing = self._recording.missing_count
        state = f" ({missing} of {self._recording.count} missing)" if missing else ""
        lines = [self.wrap(f"Line {row.line}: {self.label(row)}{state}")]
        for posture in (row.posture, *([row.minus] if row.minus else [])):
            name = f"{posture}: " if row.minus else ""
            lines.append(self._coordinates(posture, name))
        if row.is_read:
            lines.append(
                self.wrap(f"Recorded: {self.value(index)} mm; Enter keeps it.", indent="  ")
            )
        return "\n".join(lines)

    def _coordinates(self, posture: str, name: str) -> str:
        guidance = self._guidance
        lines = []
        if self._session.firmware is None:
            joints = name_coordinates(self._session.robot.drives, guidance.joints[posture])
            text = ", ".join(joint.replace(" ", GLUE) for joint in joints)
            lines.append(self.wrap(f"{name}joints {text}", indent="  "))
        if posture in guidance.tool:
            place = guidance.tool[posture]
            values = zip("xyz", shown_tool(self._session, place[None])[0], strict=True)
            tool = ", ".join(f"{axis}{GLUE}{format_fixed(v / MM, 3)}" for axis, v in values)
            lines.append(self.wrap(f"{name}tool {tool}{GLUE}mm", indent="  "))
        return "\n".join(lines)

    def confirmation(self, index: int) -> str:
        """Confirmation that a reading is on disk."""
        row = self._recording.rows[index]
        text = f"Recorded: line {row.line}, {self.label(row)}: {self.value(index)} mm"
        return self.wrap(text, indent="  ")

    def prediction(
        self, index: int, mean: float, std: float, *, excluded: Sequence[int] = ()
    ) -> str:
        """Prediction of a reading by the others, with its expanded uncertainty (k = 2).

        Args:
            index: Index of the row.
            mean: Predicted reading, [m].
            std: Its standard deviation, [m]; infinite without a prediction.
            excluded: Indices of the rows that are excluded because of warnings.
        """
        rows = self._recording.rows
        row = rows[index]
        if math.isinf(std):
            of_setup = [rows[i].line or 0 for i in excluded if rows[i].setup == row.setup]
            if not of_setup:
                return ""
            where = spans(of_setup, "line")
            text = f"No prediction: all other readings of this setup have a warning ({where})."
            return self.wrap(text, indent="  ")
        of = ""
        if row.setup_in_file != row.setup:  # a coordinate of a point
            of = f" {row.setup.partition('[')[2].rstrip(']')}"
        text = f"The other readings predict{of} {format_fixed(mean / MM, 3)} ± {mm(2.0 * std)} mm."
        lines = [self.wrap(text, indent="  ")]
        if is_far(row.value, mean, std):
            differs = f"Line {row.line}{of} differs by {mm(abs(row.value - mean))} mm."
            lines.append(self.wrap(differs, indent="  ", first="! "))
        return "\n".join(lines)

    def suspects(self, index: int, lines: Sequence[int]) -> str:
        """Advice for a row that contradicts the others without a finding.

        About one correct reading in 400 deviates by more than three standard deviations.

        Args:
            index: Index of the row.
            lines: Lines of the most likely mistakes; too many of them are not listed.
        """
        is_point = len(self._recording.point(index)) > 1
        others = [n for n in lines if n != self._recording.rows[index].line]
        where = "the lines before"
        if 0 < len(others) <= MAX_SUSPECTS:
            where = spans(others, "line")
        noun = "point" if is_point else self.instrument(index)
        advice = f"Check the {noun}, and {where}. About one correct reading in 400 is marked, too."
        return self.wrap(advice, indent="  ")

    def warning(self, finding: Finding, *, last: int | None = None) -> str:
        """A finding about the readings so far, in the words of `check`.

        Args:
            finding: The finding.
            last: Index of the row that was read last; it is named first.
        """
        rows = self._recording.rows
        lines = list(dict.fromkeys(rows[i].line or 0 for i in find_rows(finding, rows)))
        first = [n for n in lines if last is not None and n == rows[last].line]
        parts = (first, [n for n in lines if n not in first])
        named = "; or ".join(spans(part, "line") for part in parts if part)
        is_named = not named or finding.words.startswith(("Line ", "Lines "))
        where = "" if is_named else f" ({named})"
        head, *others = f"{finding.kind.capitalize()}{where}: {finding.words}".split("\n")
        paragraphs = [self.wrap(head, indent="  ", first="! ")]
        for other in others:  # causes, and what to do
            margin = "    " if other.startswith(" ") else ""
            paragraphs.append(self.wrap(other.strip(), indent=f"  {margin}", first=margin or "  "))
        return "\n".join(paragraphs)

    def resolved(self, findings: Sequence[Finding]) -> str:
        """Warnings that the readings no longer support."""
        names = [
            " ".join([f.kind, *(n for p in f.places[:1] for n in (p.setup, p.posture) if n)])
            for f in findings
        ]
        return self.wrap(f"Resolved: {joined(names)}.", indent="  ")

    def list_rows(self) -> str:
        """All rows and their readings."""
        rows = self._recording.rows
        last = len(str(rows[-1].line))
        return "\n".join(
            self.wrap(
                f"{r.line:>{last}}  {self.label(r)}: ".replace("  ", GLUE * 2)
                + (f"{self.value(i)}{GLUE}mm" if r.is_read else "not read"),
                indent=" " * (last + 2),
            )
            for i, r in enumerate(rows)
            if self._recording.point(i)[0] == i
        )

    def list_commands(self) -> str:
        """Readings and commands that can be typed."""
        lines = [
            self.wrap("A reading in mm, such as -0.12 or -0,12; or"),
            *(
                self.wrap(f"{name}: {words}", indent="    ", first="  ")
                for name, words in COMMANDS.items()
            ),
            self.wrap("Ctrl-D and Ctrl-C end, too. Enter alone keeps the recorded reading."),
        ]
        return "\n".join(lines)

    def state(self, warnings: Sequence[Finding]) -> str:
        """State of a recording in which no row is asked for, with all its warnings."""
        skipped = self._recording.missing_count
        state = f"{skipped} skipped." if skipped else "All readings are recorded."
        if warnings:
            state += " Check these first:"
        words = [self.warning(f) for f in warnings]
        return "\n".join([self.wrap(state), *words, self.wrap("Enter ends; `back` corrects.")])

    def conclusion(self, warnings: Sequence[Finding], path: str) -> str:
        """Missing rows and the next command, on a line of its own and not wrapped.

        Args:
            warnings: Findings about its readings.
            path: Path of the session as it was typed.
        """
        recording, session, rows = self._recording, self._session, self._recording.rows
        command = quote_path(path)
        if recording.missing:
            parts = []
            for setup in dict.fromkeys(rows[i].setup_in_file for i in recording.missing):
                numbers = [
                    rows[i].line for i in recording.missing if rows[i].setup_in_file == setup
                ]
                every = len(numbers) == sum(r.setup_in_file == setup for r in rows)
                which = spans(sorted({line or 0 for line in numbers}), "line")
                parts.append(f"{setup} {'all' if every else which}")
            count = recording.missing_count
            state = (
                f"{count} of {counted(recording.count, 'reading')} {'is' if count == 1 else 'are'} "
                f"missing: {joined(parts)}."
            )
            return f"{self.wrap(state)}\nContinue with:\n  orthocal record {command}"
        lines = [f"All {counted(recording.count, 'reading')} are recorded."]
        if session.controller_offsets is None:
            keys = drive_keys("offsets", session.robot.drives)
            lines.append(
                "State in session.yaml which offsets are active in the controller, one number per "
                f"drive, such as `controller: {{{keys}}}`. Without them only their "
                "changes can be calculated."
            )
        following = f"Next:\n  {calibrate_command([Path(path)], {})}"
        if warnings:
            following = f"Next: correct or repeat these readings,\n  orthocal record {command}"
        elif session.controller_offsets is not None and any(session.controller_offsets):
            joint = calibrate_command([Path("EARLIER"), Path(path)], {})
            following = (
                "Next: validate the offsets that were entered, by their calibration,\n"
                f"  orthocal validate CALIBRATION {command}\n"
                f"or calibrate all sessions together:\n  {joint}"
            )
            if session.offsets_from is not None:
                entered = quote_path(session.offsets_from)
                following = f"Next:\n  orthocal validate {entered} {command}"
        return "\n".join([*(self.wrap(line) for line in lines), following])


def _name_gauge(setup: Setup, *, stand: bool = False) -> str:
    """Noun for the gauge of a setup; also for the stand of an indicator on request."""
    noun = instrument(setup.sensor)
    return f"gauge{' or its stand' * stand}" if noun == "dial" else noun


def _gauge(session: Session, setup: Setup) -> str:
    gauge = session.gauges[setup.gauge]
    facts = []
    if gauge.range is not None:
        facts.append(f"{gauge.range[0] / MM:g} to {gauge.range[1] / MM:g} mm")
    if gauge.resolution is not None:
        facts.append(f"resolution {gauge.resolution / MM:g} mm")
    name = base_name(session.distinguish_gauge(setup.gauge))
    if not facts and not name:
        return ""
    noun = instrument(setup.sensor).capitalize()
    return ": ".join(t for t in (f"{noun} '{name}'" if name else noun, ", ".join(facts)) if t)


def find_rows(finding: Finding, rows: Sequence[Reading]) -> list[int]:
    """Indices of the rows with a reading that a finding names, by line or by setup."""
    lines = {p.line for p in finding.places if p.line is not None}
    setups = {p.setup for p in finding.places if p.line is None}
    named = [row.line in lines or row.setup in setups for row in rows]
    return [i for i, row in enumerate(rows) if named[i] and row.is_read]
