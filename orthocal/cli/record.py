"""Measuring a session, reading by reading: record."""

from __future__ import annotations

import io
import shutil
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from orthocal.cli.options import app
from orthocal.cli.printing import put_out
from orthocal.errors import SessionError
from orthocal.runtime.interrupts import INTERRUPTED, raised_interrupt
from orthocal.text import printable, shorten

if TYPE_CHECKING:
    from orthocal.hypotheses.prediction import Foresight
    from orthocal.measurement.recording.anomalies import Oddity
    from orthocal.measurement.recording.recording import Recording

WIDEST = 100
"""Columns of a line, however wide the terminal is."""

LONGEST_LINE = 10_000
"""Characters of a line that are read at a time; a reading has ten."""


@app.command()
def record(
    session: Annotated[
        Path,
        typer.Argument(
            metavar="SESSION",
            help="session.yaml of a plan, with an empty readings.csv or none, or its folder.",
        ),
    ],
) -> None:
    """Lead through measuring: where stand and machine go, and what is odd about a reading, at once.

    Every reading is on disk before the next one is asked for. Left at any time, it goes on at the
    first reading that is missing. Over a pipe each line is what would be typed.
    """
    from orthocal.measurement.recording.recording import open_recording

    interrupted = False
    with open_recording(session) as recording:
        dialogue = _Dialogue(recording, str(session))
        try:
            dialogue.run()
        except KeyboardInterrupt:
            interrupted = True
            put_out("")
        dialogue.conclude()
    if interrupted:
        raise typer.Exit(INTERRUPTED)


class _Leave(Exception):
    """Whoever types has had enough."""


class _Dialogue:
    """Questions and answers about the rows of a recording."""

    def __init__(self, recording: Recording, path: str) -> None:
        from orthocal.measurement.motion.motion import guide

        self._recording = recording
        self._path = path
        self._guidance = guide(recording.session)
        self._foresight: Foresight | None = None
        self._skipped: set[tuple[Any, ...]] = set()
        self._told: set[str] = set()
        """Setups of which it was said that their dial is turned round."""
        self._shown: str | None = None
        """Setup that was shown last."""
        self._last: int | None = None
        """Row that was read last."""
        self._at: int | None = None
        """Row that is asked for; None where all are there or left out."""

    @property
    def _width(self) -> int:
        return min(shutil.get_terminal_size((WIDEST, 24)).columns, WIDEST)

    def run(self) -> None:
        """Ask for readings until there are no more, or whoever types leaves."""
        from orthocal.hypotheses.prediction import build_foresight
        from orthocal.output.text.recording import describe_session

        recording = self._recording
        self._say(describe_session(recording, width=self._width))
        self._go_on()
        self._foresight = build_foresight(recording.session)  # while the first posture is read
        with raised_interrupt(), suppress(_Leave):
            while True:
                self._answer(self._ask())

    def conclude(self) -> None:
        """Say what is missing, and what comes next."""
        from orthocal.output.text.recording import conclude

        r = self._recording
        self._say("", conclude(r.session, r.rows, self._path, width=self._width))

    def _go_on(self, at: int | None = None) -> None:
        """Turn to a row; to the first that is not there by default."""
        found = self._recording.next_empty(frozenset(self._skipped)) if at is None else at
        self._at = found
        self._show()

    def _show(self) -> None:
        from orthocal.output.text.recording import describe_row, describe_setup

        r, at = self._recording, self._at
        if at is None:
            left = len(r.missing)
            state = f"{left} left out." if left else "All readings are there."
            self._say("", f"{state} Enter ends; `back` corrects.")
            return
        setup = r.rows[at].setup
        if setup != self._shown:
            words = describe_setup(r.session, self._guidance, r.rows, setup, width=self._width)
            self._say("", words)
            self._shown = setup
        words = describe_row(r.session, self._guidance, r.rows, at, width=self._width)
        self._say("", words)

    def _ask(self) -> str:
        """The next line that is typed.

        Raises:
            _Leave: At the end of the input.
        """
        at = self._at
        prompt = "> "
        if at is not None:
            row = self._recording.rows[at]
            named = printable(f"{row.setup} {row.posture} [mm]> ")
            prompt = named if len(named) <= self._width // 2 else f"row {at + 1} [mm]> "
        if sys.stdin is None:
            raise _Leave
        if isinstance(sys.stdin, io.TextIOWrapper) and sys.stdin.errors != "replace":
            sys.stdin.reconfigure(errors="replace")  # what is no text is no number either
        if sys.stdin.isatty() and sys.stdout.isatty():
            with suppress(ImportError):
                import readline  # noqa: F401 - lines can be edited
            try:
                return input(prompt)
            except EOFError:
                self._say("")
                raise _Leave from None
        self._say(prompt.rstrip())
        line = _read_line()
        if line and not line.endswith("\n"):
            self._say(self._wrap(f"Not taken: '{shorten(line)}', a line without an end."))
        if not line.endswith("\n"):
            raise _Leave
        return line

    def _answer(self, line: str) -> None:
        """Do what was typed; what cannot be done is said, and asked for again."""
        from orthocal.io.tables.numerals import parse_typed_reading

        word, *rest = line.split() or [""]
        try:
            if not word:
                self._keep()
            elif word[0].isalpha() or word == "?":
                self._command(word.lower(), rest)
            elif self._at is None:
                raise SessionError("no row is asked for; `back 3` goes to row 3")
            else:
                self._take(self._at, parse_typed_reading(line))
        except SessionError as e:
            self._say(self._wrap(f"Not taken: {e}."))

    def _keep(self) -> None:
        """Enter alone."""
        if self._at is None:
            raise _Leave
        if self._recording.rows[self._at].value is None:
            raise SessionError("type what the dial shows, or `skip`, or `help`")
        self._go_on()

    def _take(self, at: int, value: float) -> None:
        from orthocal.measurement.recording.anomalies import find_oddities
        from orthocal.output.text.recording import acknowledge, describe_oddity

        recording = self._recording
        recording.read(at, value)
        self._skipped.discard(recording.rows[at].key)
        self._last = at
        self._say(acknowledge(recording.rows, at, width=self._width))
        found = find_oddities(recording.session, recording.rows, at)
        if not any(o.kind in ("cycles", "drift") for o in found):
            found += self._foreseen(at)
        for oddity in found:
            row = recording.rows[at]
            self._say(describe_oddity(oddity, row, self._guidance, width=self._width))
        self._go_on()

    def _foreseen(self, at: int) -> tuple[Oddity, ...]:
        """What is odd by what the other readings say; of a turned dial it is said once."""
        if self._foresight is None:
            return ()
        found = self._foresight.find_oddities(self._recording.rows, at)
        new = tuple(o for o in found if not (o.kind == "turned" and o.setup in self._told))
        self._told |= {o.setup for o in new if o.kind == "turned"}
        return new

    def _command(self, word: str, rest: list[str]) -> None:
        """A word that is no reading.

        Raises:
            SessionError: If it is not known, or cannot be done now.
        """
        from orthocal.output.text.recording import COMMANDS, list_commands, list_rows

        word = {"?": "help", "exit": "quit"}.get(word, word)
        names = [name for name in COMMANDS if name.startswith(word)]
        if len(names) != 1:
            which = f" ({' or '.join(names)}?)" if names else ""
            raise SessionError(f"'{shorten(word)}' is no command{which}; `help` lists them")
        name = names[0]
        if rest and (name not in ("back", "again", "drop") or len(rest) > 1):
            raise SessionError(f"`{name}` takes nothing after it that begins '{shorten(rest[0])}'")
        given = self._row(rest[0]) if rest else None
        if name == "back":
            self._back(given)
        elif name == "again":
            self._again(given)
        elif name == "skip":
            self._skip()
        elif name == "drop":
            self._drop(given)
        elif name == "restart":
            self._restart()
        elif name == "list":
            self._say(list_rows(self._recording.rows, width=self._width))
        elif name == "help":
            self._say(list_commands(width=self._width))
        elif name == "show":
            self._shown = None
            self._show()
        else:
            raise _Leave

    def _row(self, text: str) -> int:
        """Index of a row that is named by its number."""
        count = len(self._recording.rows)
        if text.isascii() and text.isdigit() and len(text) < 7 and 1 <= int(text) <= count:
            return int(text) - 1
        raise SessionError(f"'{shorten(text)}' is no row; expected 1 to {count}")

    def _current(self) -> int:
        if self._at is None:
            raise SessionError("no row is asked for; `back 3` goes to row 3")
        return self._at

    def _back(self, given: int | None) -> None:
        rows = self._recording.rows
        at = (len(rows) if self._at is None else self._at) - 1 if given is None else given
        if at < 0:
            raise SessionError("this is the first row")
        stood = None if self._last is None else rows[self._last].setup
        if stood is not None and rows[at].setup != stood and rows[at].value is not None:
            self._say(
                self._wrap(
                    f"The stand has been elsewhere since {rows[at].setup} was read: correct only "
                    "what was mistyped. To read there anew, `restart` the whole setup."
                )
            )
        self._go_on(at)

    def _again(self, given: int | None) -> None:
        rows = self._recording.rows
        before = [i for i, r in enumerate(rows[: self._at]) if r.value is not None]
        last = self._last if self._last is not None or not before else before[-1]
        at = last if given is None else given
        if at is None:
            raise SessionError("nothing was read yet")
        if rows[at].value is None:
            raise SessionError(f"row {at + 1} was not read yet")
        self._go_on(self._recording.repeat(at))

    def _skip(self) -> None:
        at = self._current()
        if self._recording.rows[at].value is None:
            self._skipped.add(self._recording.rows[at].key)
            self._say(f"  Left empty: row {at + 1}")
        self._go_on()

    def _drop(self, given: int | None) -> None:
        at = self._current() if given is None else given
        label = self._recording.rows[at].label
        self._recording.drop(at)
        if self._last is not None and self._last >= at:
            self._last = None if self._last == at else self._last - 1
        self._say(self._wrap(f"Taken out: row {at + 1}, {label}"))
        self._go_on()

    def _restart(self) -> None:
        at = self._last if self._at is None else self._at
        if at is None:
            raise SessionError("nothing was read yet")
        recording = self._recording
        setup = recording.rows[at].setup
        recording.empty(at)
        self._skipped -= {r.key for r in recording.rows if r.setup == setup}
        self._told.discard(setup)
        self._shown, self._last = None, None
        self._say(self._wrap(f"Emptied: all readings of {setup}"))
        self._go_on(next(i for i, r in enumerate(recording.rows) if r.setup == setup))

    def _wrap(self, text: str) -> str:
        from orthocal.output.text.recording import wrap

        return wrap(text, self._width, indent="  ")

    def _say(self, *texts: str) -> None:
        for text in texts:
            put_out(text)


def _read_line() -> str:
    """A line of the standard input that is no terminal; empty at its end."""
    line = sys.stdin.readline(LONGEST_LINE)
    while line and not line.endswith("\n"):
        more = sys.stdin.readline(LONGEST_LINE)
        if not more:
            break
        line = line[:LONGEST_LINE] + ("\n" if more.endswith("\n") else "")
    return line
