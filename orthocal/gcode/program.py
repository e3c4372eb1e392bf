"""A program corrected as it is read: lines in, lines out, and little in between."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from orthocal.errors import GcodeError
from orthocal.gcode.cutting import LONGEST_PIECE, Correct, Refused, cut
from orthocal.gcode.path import Motion, Paths
from orthocal.gcode.state import Interpreter, Step
from orthocal.gcode.words import Line, split_line, split_plain
from orthocal.gcode.writing import Writer

LINES_AT_ONCE = 2000

PIECES_AT_ONCE = 20_000
"""Of motions as they are first cut."""

ROUNDING = 0.1
"""Part of what is asked for that the decimals of coordinates may take."""

LONGEST_READ = 252
"""Bytes of a line that LinuxCNC reads, without the newline."""

SHORT = LONGEST_READ // 4
"""Characters of which there are not more bytes than that."""

_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f]")


@dataclass(slots=True)
class Summary:
    """What was done to a program."""

    lines: int = 0
    points: int = 0
    chord: float = 0.0
    """Largest distance of the corrected path from a chord, [m]."""
    correction: float = 0.0
    """Largest correction, [m]."""
    stretch: list[float] = field(default_factory=lambda: [1.0, 1.0])
    """Least and largest share by which a feed was changed."""
    unit_assumed: bool = False
    """Whether coordinates stood before any G20 or G21."""
    ended: bool = False
    """Whether it says that it ends."""


class ProgramCorrector:
    """Corrects programs.

    Args:
        file: Name of the program, for messages.
        axes: Indices of the axes that the drives command.
        interpreter: What the program's lines mean; new.
        correct: The correction.
        within: Largest distance of what is written from the corrected path, [m].

    Raises:
        GcodeError: If the correction itself is not known that well.
    """

    def __init__(
        self,
        file: str,
        *,
        axes: Sequence[int],
        interpreter: Interpreter,
        correct: Correct,
        within: float,
    ) -> None:
        self._file, self._correct, self._interpreter = file, correct, interpreter
        self._writer = Writer(axes, rounding=ROUNDING * within, start=interpreter.position)
        self._tolerance = (1.0 - ROUNDING) * within - correct.bound
        if self._tolerance < ROUNDING * within:
            raise GcodeError(
                f"the correction is known to {correct.bound * 1e6:.3g} µm; expected more",
                where="--within",
            )
        self.summary = Summary()

    def run(self, lines: Iterable[str]) -> Iterator[str]:
        """Lines of the corrected program, a block at a time.

        Args:
            lines: Of the program, each with what ends it.

        Raises:
            GcodeError: Naming the first line that cannot be corrected.
        """
        steps: list[Step | str] = []
        pieces, marks = 0.0, 0
        summary, interpreter = self.summary, self._interpreter
        for text in lines:
            summary.lines += 1
            if text.strip() == "%":
                marks += 1
                self._require_readable([text], summary.lines)
                steps.append(text)
            elif interpreter.modes.ended or marks > 1:
                if _CONTROL.search(text.rstrip("\r\n")):
                    raise GcodeError("is no text", where=f"{self._file}:{summary.lines}")
                self._require_readable([text], summary.lines)
                steps.append(text)
            else:
                plain = split_plain(text, summary.lines)
                step = None if plain is None else interpreter.read_plain(plain)
                try:
                    if step is None:
                        line = split_line(text, summary.lines, file=self._file)
                        step = interpreter.read(line)
                except GcodeError:
                    self._flush(steps)  # what cannot be reached stands before it
                    raise
                steps.append(step)
                if step.motion is not None:
                    summary.unit_assumed |= not step.modes.unit_told
                    pieces += _estimate(step.motion)
            if len(steps) >= LINES_AT_ONCE or pieces > PIECES_AT_ONCE:
                yield self._flush(steps)
                steps, pieces = [], 0.0
        yield self._flush(steps)
        summary.ended = interpreter.modes.ended or marks > 1

    def _flush(self, steps: Sequence[Step | str]) -> str:
        """What is written for some steps."""
        moving = [s for s in steps if isinstance(s, Step) and s.motion is not None]
        motions = [s.motion for s in moving if s.motion is not None]
        cuts = iter(cut(Paths.of(motions), self._correct, tolerance=self._tolerance))
        summary, low, high = self.summary, *self.summary.stretch
        texts: list[str] = []
        for step in steps:
            if isinstance(step, str):
                texts.append(step)
                continue
            if isinstance(step.line, Line) and step.motion is None:
                own = [self._writer.keep(step.line)]
            else:
                found = next(cuts)
                if isinstance(found, Refused):
                    where = f"{self._file}:{step.line.number}"
                    raise GcodeError(
                        f"the machine cannot make this motion: it {found.reason}", where=where
                    )
                summary.points += len(found.points)
                summary.chord = max(summary.chord, found.chord)
                summary.correction = max(summary.correction, found.correction)
                if not step.straight and step.modes.motion:
                    low = min(low, *found.stretch)
                    high = max(high, *found.stretch)
                own = self._writer.write(step, found)
            if len(own[0]) > SHORT or len(own[-1]) > SHORT:  # those between are places and feeds
                self._require_readable(own, step.line.number)
            texts += own
        summary.stretch = [low, high]
        return "".join(texts)

    def _require_readable(self, texts: Sequence[str], number: int) -> None:
        """Refuse lines that a controller would cut off or stop at."""
        for text in texts:
            size = len(text.removesuffix("\n").encode("utf-8", "surrogateescape"))
            if size > LONGEST_READ:
                raise GcodeError(
                    f"has {size} bytes once it is corrected; expected at most {LONGEST_READ}, "
                    "as LinuxCNC reads: shorten what stands beside its words",
                    where=f"{self._file}:{number}",
                )


def _estimate(motion: Motion) -> float:
    """Pieces of a motion, about."""
    a, b = motion.start, motion.end
    length = abs(b[0] - a[0]) + abs(b[1] - a[1]) + abs(b[2] - a[2])
    if motion.arc is None:
        return 1.0 + length / LONGEST_PIECE
    return 1.0 + (length + 10.0 * abs(motion.arc.sweep) * motion.arc.radii[0]) / LONGEST_PIECE
