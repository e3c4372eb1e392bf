"""Dialogue of the command `record`."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from orthocal.arrays import Array
from orthocal.assessment.judgement import find_warnings, is_doubtful, is_far, judge_session
from orthocal.assessment.wording import counted
from orthocal.calibration.assessment_record import Finding
from orthocal.cli.printing import put_out
from orthocal.cli.recorded_conditions import RecordedConditions
from orthocal.errors import OrthocalError, SessionError
from orthocal.hypotheses.linear_model import linear_model
from orthocal.hypotheses.search import find_suspected_rows
from orthocal.io.tables.numerals import parse_typed_point, parse_typed_reading
from orthocal.measurement.recording import Recording
from orthocal.output.text.recording import COMMANDS, RecordingText, find_rows
from orthocal.runtime.interrupts import raised_interrupt
from orthocal.session.session import Conditions, ReadingKey
from orthocal.text import printable, shorten

LONGEST_LINE = 10_000
"""Largest number of characters of a line that are read at once; a reading has ten."""


LONGEST_NUMBER = 9
"""Largest number of digits of a line's number."""


class _EndOfDialogue(Exception):
    """End of the input, or the command `quit`."""


class Dialogue:
    """Questions and answers about the rows of a recording."""

    def __init__(self, recording: Recording, path: str) -> None:
        self._recording = recording
        self._path = path
        self._text = RecordingText(recording)
        self._conditions = RecordedConditions(recording, self._text.programmed_approach)
        self._warnings: tuple[Finding, ...] = ()
        """Findings about the present readings."""
        self._hidden: tuple[Finding, ...] = ()
        """Earlier findings that are absent only because of later doubtful readings."""
        self._far: set[ReadingKey] = set()
        """Rows that contradicted their prediction when they were read."""
        self._can_judge = True
        """Whether readings are judged, which needs a robot that can be calibrated."""
        self._skipped: set[ReadingKey] = set()
        self._shown: str | None = None
        """Setup that was described last."""
        self._last: int | None = None
        """Index of the row that was read last."""
        self._asked: int | None = None
        """Index of the row that is asked for; None if all are read or skipped."""
        self._offered: str | None = None
        """Setup whose readings the last line, a `restart`, offered to delete."""
        self._stated: set[str] = set()
        """Conditions that were typed while this row is asked for."""

    def run(self) -> None:
        """Ask for readings until none is missing and Enter is typed, or the input ends."""
        before = Conditions(self._conditions.approach, self._conditions.temperature)
        self._say(self._text.introduction(before))
        with raised_interrupt(), suppress(_EndOfDialogue):
            self._judge()
            self._ask_for_next()
            while True:
                self._answer(self._read_line())

    def conclude(self) -> None:
        """Print the missing rows and the next command."""
        self._say("", self._text.conclusion(self._warnings, self._path))

    def _ask_for(self, index: int | None) -> None:
        """Ask for a row; None if all are read or skipped."""
        self._conditions.end_correction()
        self._asked, self._stated = index, set()
        self._show()

    def _ask_for_next(self) -> None:
        self._ask_for(self._next)

    @property
    def _next(self) -> int | None:
        """Index of the first row that is neither read nor skipped."""
        return self._recording.next_empty(frozenset(self._skipped))

    def _show(self) -> None:
        index = self._asked
        if index is None:
            self._say("", self._text.state(self._warnings))
            return
        setup = self._recording.rows[index].setup_in_file
        if setup != self._shown:
            self._say("", self._text.setup(index))
            self._shown = setup
        self._say("", self._text.row(index))
        self._ask_for_condition()

    def _ask_for_condition(self) -> None:
        """Print the question about a condition, if there is one."""
        if self._question is not None:
            noted = self._conditions
            self._note(self._text.question(self._question, noted.temperature, noted.proposed))

    @property
    def _question(self) -> str | None:
        """Condition that is asked for before the reading."""
        if self._asked is None or self._keeps_conditions(self._asked):
            return None
        return self._conditions.question(self._recording.rows[self._asked])

    def _keeps_conditions(self, index: int) -> bool:
        """True for a reading that is not taken again, so that only its typing is corrected.

        Another setup was read since, or the program was restarted.
        """
        is_past = self._last is None or self._is_of_earlier_setup(index)
        return self._recording.rows[index].is_read and is_past

    def _is_of_earlier_setup(self, index: int) -> bool:
        """True for a row after whose setup this program recorded another setup."""
        if self._last is None:
            return False
        rows = self._recording.rows
        return rows[self._last].setup_in_file != rows[index].setup_in_file

    def _conditions_of(self, index: int) -> Conditions:
        """Conditions to record with a reading that is typed now; those that are None do not change.

        A reading that exists already keeps its approach, unless another one was typed for it.
        """
        row = self._recording.rows[index]
        present = self._conditions.of(row)
        if not row.is_read:
            return present
        repeated = {"approach"}
        if self._keeps_conditions(index):
            repeated |= {"temperature", "time"}
        return replace(present, **dict.fromkeys(repeated - self._stated))

    def _show_again(self) -> None:
        self._shown = None
        self._show()

    def _read_line(self) -> str:
        """Next typed line.

        Raises:
            _EndOfDialogue: At the end of the input.
        """
        prompt = "> "
        if self._asked is not None:
            row = self._recording.rows[self._asked]
            point = " x y z" * (len(self._recording.point(self._asked)) > 1)
            prompt = printable(f"{row.setup_in_file} {row.posture}{point} [mm]> ")
            if len(prompt) > self._text.width // 2:
                prompt = f"line {row.line} [mm]> "
            prompt = {None: prompt, "temperature": "temperature [°C]> "}.get(
                self._question, f"{self._question}> "
            )
        if sys.stdin is None:
            raise _EndOfDialogue
        if isinstance(sys.stdin, io.TextIOWrapper) and sys.stdin.errors != "replace":
            sys.stdin.reconfigure(errors="replace")  # invalid bytes are refused as text
        if sys.stdin.isatty() and sys.stdout.isatty():
            with suppress(ImportError):
                import readline  # noqa: F401 - lines can be edited
            try:
                return input(prompt)
            except EOFError:
                self._say("")
                raise _EndOfDialogue from None
        self._say(prompt.rstrip())
        line = _read_piped_line()
        if line and not line.endswith("\n"):
            self._note(f"Not recorded: '{shorten(line)}', a line without an end.")
        if not line.endswith("\n"):
            raise _EndOfDialogue
        return line

    def _answer(self, line: str) -> None:
        """Execute a line; errors are printed, and the question is repeated."""
        word, *arguments = line.split() or [""]
        offered = self._offered
        try:
            if self._question is not None and self._is_answer(word, arguments):
                self._set_condition(self._question, word)
                self._ask_for_condition()
            elif not word:
                self._keep()
            elif word[0].isalpha() or word == "?":
                self._command(word.lower(), arguments)
            else:
                index = self._require_row()
                if len(self._recording.point(index)) > 1:
                    self._record(index, parse_typed_point(line))
                else:
                    largest = self._recording.largest_reading(index)
                    self._record(index, parse_typed_reading(line, largest=largest))
        except SessionError as e:
            self._note(f"Not recorded: {e}.")
        if self._offered == offered:
            self._offered = None

    def _is_answer(self, word: str, arguments: list[str]) -> bool:
        """True if a line is a single word that answers the question about a condition."""
        if arguments:
            return False
        if self._question == "approach" and word and not word.strip("pnu"):
            return True
        return not (word and (word[0].isalpha() or word == "?"))

    def _set_condition(self, condition: str, text: str) -> None:
        """Set a condition of the reading that is asked for; see `RecordedConditions`."""
        row = None if self._asked is None else self._recording.rows[self._asked]
        self._conditions.set_condition(condition, text, row)
        if self._asked is None or row is None:
            return
        if condition == "approach" and row.planned_approach is not None:
            self._note(self._text.planned_side(row.planned_approach))
            return
        self._stated.add(condition)
        conditions = self._conditions_of(self._asked)
        self._note(self._text.conditions(conditions, alone=row.is_read))
        if self._conditions.is_unusual and self._conditions.temperature is not None:
            self._note(self._text.unusual_temperature(self._conditions.temperature))
            self._conditions.is_unusual = False

    def _keep(self) -> None:
        """Keep the reading of the row that is asked for, with the conditions typed for it.

        The dialogue ends if no row is asked for.
        """
        if self._asked is None:
            raise _EndOfDialogue
        if not self._recording.rows[self._asked].is_read:
            is_point = len(self._recording.point(self._asked)) > 1
            reading = f"the reading of the {self._text.instrument(self._asked)}"
            expected = "x, y and z of the point" if is_point else reading
            raise SessionError(f"type {expected}, or `skip`, or `help`")
        if self._stated:
            self._record(self._asked, self._recording.value(self._asked))
        else:
            self._ask_for_next()

    def _record(self, index: int, value: float | Array) -> None:
        """Record a reading, compare it with its prediction, and judge the readings if necessary."""
        recording = self._recording
        corrected = recording.rows[index].is_read
        recording.read(index, value, self._conditions_of(index))
        row = recording.rows[index]
        self._skipped -= {recording.rows[i].key for i in recording.point(index)}
        self._last = index
        self._say(self._text.confirmation(index))
        following = self._next
        is_end_of_setup = (
            following is None or recording.rows[following].setup_in_file != row.setup_in_file
        )
        warned = False
        if self._is_doubtful(index) or is_end_of_setup or corrected:
            warned = self._judge(last=index)
        if not warned and self._far & {recording.rows[i].key for i in recording.point(index)}:
            self._say(self._text.suspects(index, self._find_suspected_lines()))
        self._ask_for(following)

    def _is_doubtful(self, index: int) -> bool:
        """Print the prediction of a reading; True if the reading contradicts it.

        Each coordinate of a point is predicted by the other points, so that one wrong coordinate
        does not change the predictions of the others. Readings with a warning are excluded.
        """
        return any([self._contradicts(i) for i in self._recording.point(index)])

    def _contradicts(self, index: int) -> bool:
        """Print the prediction of a row; True if its value contradicts it."""
        if not self._is_judged:
            return False
        rows = self._recording.rows
        excluded = self._rows_with_warning() - set(self._recording.point(index))
        session, position = self._recording.measured_coordinate(index, without=excluded)
        try:
            mean, std = linear_model(session).compare_row(session.values, position)
        except (OrthocalError, np.linalg.LinAlgError) as e:
            self._stop_judging(e)
            return False
        if prediction := self._text.prediction(index, mean, std, excluded=sorted(excluded)):
            self._say(prediction)
        self._far.discard(rows[index].key)
        if is_far(rows[index].value, mean, std):
            self._far.add(rows[index].key)
        return is_doubtful(session, position, mean, std)

    @property
    def _is_judged(self) -> bool:
        """True if there are readings that can be judged."""
        is_empty = len(self._recording.missing) == len(self._recording.rows)
        return self._can_judge and not is_empty and self._recording.is_located

    def _rows_with_warning(self) -> set[int]:
        """Indices of the rows that present or hidden findings name."""
        findings = (*self._warnings, *self._hidden)
        return {i for f in findings for i in find_rows(f, self._recording.rows)}

    def _find_suspected_lines(self) -> list[int]:
        """Lines of the most likely mistakes, if no finding names a line; empty if unknown."""
        excluded, rows = self._rows_with_warning(), self._recording.rows
        measured = [r for i, r in enumerate(rows) if r.is_read and i not in excluded]
        if not measured:
            return []
        try:
            suspected = find_suspected_rows(self._recording.measured(without=excluded))
        except (OrthocalError, np.linalg.LinAlgError):
            return []
        return sorted({measured[i].line or 0 for i in suspected})

    def _judge(self, *, last: int | None = None) -> bool:
        """Judge the present readings; print new and resolved warnings.

        A complete session is judged as by `check`; `_show` prints its warnings.

        Args:
            last: Index of the row that was just read.

        Returns:
            True if there are new warnings.
        """
        recording = self._recording
        if not self._is_judged:
            self._warnings = self._hidden = ()
            return False
        try:
            if recording.missing:
                warnings = find_warnings(recording.measured())
            else:
                findings = judge_session(recording.measured()).findings
                warnings = tuple(f for f in findings if f.severity != "note")
            new, absent = _compare((*self._warnings, *self._hidden), warnings)
            hidden = [f for f in absent if self._is_hidden(f, warnings)]
        except (OrthocalError, np.linalg.LinAlgError) as e:
            self._stop_judging(e)
            return False
        resolved = [f for f in absent if f not in hidden]
        self._warnings, self._hidden = warnings, tuple(hidden)
        if recording.missing:
            for finding in new:
                self._say(self._text.warning(finding, last=last))
        if resolved:
            self._say(self._text.resolved(resolved))
        return bool(new)

    def _is_hidden(self, finding: Finding, warnings: Sequence[Finding]) -> bool:
        """True if a finding occurs again without all other doubtful readings.

        A present finding that names no reading, such as inconsistent readings, may be about any.

        Args:
            finding: An earlier finding that is absent now.
            warnings: The present findings.
        """
        rows = self._recording.rows
        concerned = set(find_rows(finding, rows))
        if concerned and not all(find_rows(f, rows) for f in warnings):
            return True
        excluded = {i for f in warnings for i in find_rows(f, rows)}
        excluded |= {i for i, row in enumerate(rows) if row.key in self._far}
        excluded -= concerned
        if not excluded or not concerned:
            return False
        findings = find_warnings(self._recording.measured(without=excluded))
        return any(concerned & set(find_rows(f, rows)) for f in findings)

    def _stop_judging(self, error: Exception) -> None:
        """Print once the reason why readings cannot be judged; recording continues."""
        self._can_judge = False
        reason = error if isinstance(error, OrthocalError) else "a posture is singular"
        self._note(f"Readings are recorded without a check: {reason}. Use `orthocal check` later.")

    def _command(self, word: str, arguments: list[str]) -> None:
        """Execute a command.

        Raises:
            SessionError: If the command is unknown, or cannot be executed now.
        """
        word = {"?": "help", "exit": "quit"}.get(word, word)
        names = [name for name in COMMANDS if name.startswith(word)]
        if len(names) != 1:
            which = f" ({' or '.join(names)}?)" if names else ""
            raise SessionError(f"'{shorten(word)}' is not a command{which}; `help` lists them")
        name, argument = names[0], arguments[0] if arguments else ""
        examples = {"temperature": "21.5", "side": "p or n"}
        actions = {
            **{"skip": self._skip, "clock": self._switch_clock, "show": self._show_again},
            "list": lambda: self._say(self._text.list_rows()),
            "help": lambda: self._say(self._text.list_commands()),
            "quit": self._quit,
        }
        if len(arguments) > (name not in actions):
            raise SessionError(f"`{name}` has no argument '{shorten(arguments[-1])}'")
        if name in actions:
            actions[name]()
        elif name not in examples:
            self._row_command(name, argument)
        elif argument:
            self._set_condition("approach" if name == "side" else name, argument)
        else:
            raise SessionError(f"`{name}` needs a value, such as {examples[name]}")

    def _row_command(self, name: str, line: str) -> None:
        """Execute a command for a line; "" for the line that the command chooses.

        Raises:
            SessionError: If there is no such line, or the command cannot be executed now.
        """
        lines = [str(row.line) for row in self._recording.rows]
        number = int(line) if line.isdecimal() and len(line) < LONGEST_NUMBER else 0
        if name == "back" and line not in lines and self._recording.is_deleted(number):
            self._restore(number)
            return
        if line and line not in lines:
            raise SessionError(self._describe_missing(line, number, lines))
        commands = {
            **{"back": self._back, "repeat": self._repeat},
            **{"drop": self._drop, "restart": self._restart},
        }
        commands[name](lines.index(line) if line else None)

    def _describe_missing(self, line: str, number: int, lines: Sequence[str]) -> str:
        """Reason why there is no such line.

        Args:
            line: The line as typed.
            number: Its number; 0 if it is none.
            lines: All lines.
        """
        if self._recording.is_deleted(number):
            return f"line {line} was deleted; `back {line}` adds it again, as the last line"
        if now := self._recording.present_line(number):
            return f"line {line} is line {now} now"
        return f"'{shorten(line)}' is not a line; expected {lines[0]} to {lines[-1]}"

    def _switch_clock(self) -> None:
        self._conditions.switch_clock()
        self._note(self._text.clock(on=self._conditions.clock))

    def _quit(self) -> None:
        raise _EndOfDialogue

    def _require_row(self) -> int:
        if self._asked is None:
            raise SessionError("no line is asked for; `back 7` goes to line 7")
        return self._asked

    def _back(self, index: int | None) -> None:
        rows = self._recording.rows
        if index is None:
            index = self._before(len(rows) if self._asked is None else self._asked)
        if index < 0:
            raise SessionError("this is the first line")
        index = self._recording.point(index)[0]
        if rows[index].is_read:
            self._note_moved(index)
        self._ask_for(index)

    def _before(self, asked: int) -> int:
        """Index of the reading that was typed last; from a line that is read, of the line above."""
        rows = self._recording.rows
        if self._last is not None and (asked == len(rows) or not rows[asked].is_read):
            return self._last
        return asked - 1

    def _note_moved(self, index: int) -> None:
        """Print advice about the setup of a row, if another setup was read since."""
        if self._is_of_earlier_setup(index) and (advice := self._text.moved(index)):
            self._note(advice)

    def _repeat(self, index: int | None) -> None:
        rows = self._recording.rows
        if index is None:
            before = [i for i, r in enumerate(rows[: self._asked]) if r.is_read]
            index = self._last
            if index is None and before:
                index = self._recording.point(before[-1])[0]
        if index is None:
            raise SessionError("nothing was read yet")
        if not rows[index].is_read:
            raise SessionError(f"line {rows[index].line} was not read yet")
        self._note_moved(index)
        line = rows[index].line
        index = self._recording.repeat(index)
        self._note(f"Added: line {self._recording.rows[index].line}, which repeats line {line}.")
        self._ask_for(index)

    def _skip(self) -> None:
        index = self._require_row()
        if not self._recording.rows[index].is_read:
            rows = self._recording.rows
            self._skipped |= {rows[i].key for i in self._recording.point(index)}
            self._say(f"  Skipped: line {self._recording.rows[index].line}")
        self._ask_for_next()

    def _drop(self, index: int | None) -> None:
        index = self._require_row() if index is None else index
        row, count = self._recording.rows[index], len(self._recording.point(index))
        stated = self._recording.drop(index)
        if self._last is not None and self._last >= index:
            self._last = None if self._last == index else self._last - count
        self._note(
            f"Deleted: line {row.line}, {self._text.label(row)}. Other lines keep their numbers. "
            f"`back {row.line}` adds it again, as the last line."
        )
        for setup, posture in stated.items():
            self._note(f"session.yaml states now that {setup} is aligned at {posture}.")
        self._judge()
        self._ask_for_next()

    def _restore(self, line: int) -> None:
        index = self._recording.restore(line)
        row = self._recording.rows[index]
        self._note(f"Added: line {row.line}, {self._text.label(row)}.")
        self._ask_for(index)

    def _restart(self, index: int | None) -> None:
        if index is None:
            index = self._last if self._asked is None else self._asked
        if index is None:
            raise SessionError("no line is asked for; `restart 7` reads the setup of line 7 again")
        recording = self._recording
        setup = recording.rows[index].setup_in_file
        indices = [i for i, r in enumerate(recording.rows) if r.setup_in_file == setup]
        count = len({recording.rows[i].line for i in indices if recording.rows[i].is_read})
        if count and self._offered != setup:
            self._offered = setup
            self._note(
                f"`restart` deletes {counted(count, 'reading')} of {setup}. Type it again to "
                "delete; any other line keeps them."
            )
            return
        recording.empty(index)
        self._skipped -= {recording.rows[i].key for i in indices}
        self._shown, self._last = None, None
        self._note(
            f"Deleted: all readings of {setup}"
            if count
            else f"{setup} has no readings yet. `restart 7` reads the setup of line 7 again."
        )
        self._judge()
        self._ask_for(indices[0])

    def _note(self, text: str) -> None:
        """Print an indented paragraph."""
        self._say(self._text.wrap(text, indent="  "))

    def _say(self, *texts: str) -> None:
        put_out("\n".join(texts))


def _compare(
    before: Sequence[Finding], after: Sequence[Finding]
) -> tuple[list[Finding], list[Finding]]:
    """New findings, and absent ones whose setups have no finding any more."""

    def identify(finding: Finding) -> tuple[object, ...]:
        places = [(p.setup, p.posture) for p in finding.places[:1]]
        return finding.kind, *places, finding.numbers.get("cycle")

    earlier, present = ({identify(f) for f in findings} for findings in (before, after))
    setups = {p.setup for f in after for p in f.places}
    new = [f for f in after if identify(f) not in earlier]
    absent = [f for f in before if identify(f) not in present]
    return new, [f for f in absent if not setups & {p.setup for p in f.places}]


def _read_piped_line() -> str:
    """Line of the standard input without a terminal, cut to LONGEST_LINE; empty at its end."""
    line = sys.stdin.readline(LONGEST_LINE)
    while line and not line.endswith("\n"):
        more = sys.stdin.readline(LONGEST_LINE)
        if not more:
            break
        line = line[:LONGEST_LINE] + ("\n" if more.endswith("\n") else "")
    return line
