"""Correction of a program in one pass, block by block."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import GcodeError
from orthocal.gcode.interpreter import Interpreter, Step
from orthocal.gcode.lines import CONTROL, Line, split_line, split_point_line
from orthocal.gcode.path import AXES, Motion, Paths
from orthocal.gcode.reversals import Sides
from orthocal.gcode.segmentation import LONGEST_SEGMENT, Correction, Refused, segment_motions
from orthocal.gcode.writer import Writer
from orthocal.units import MM, UM

LINES_PER_BLOCK = 2000
"""Largest number of lines of a block."""

SEGMENTS_PER_BLOCK = 20_000
"""Estimated number of segments above which a block ends."""

ROUNDING = 0.1
"""Share of the tolerance for the rounding of coordinates."""

LONGEST_READ = 252
"""Number of bytes of a line that LinuxCNC reads, without the newline."""

SHORT = LONGEST_READ // 4
"""Number of characters that never need more than LONGEST_READ bytes in UTF-8."""


@dataclass(slots=True)
class Summary:
    """Statistics of a corrected program."""

    lines: int = 0
    motions: int = 0
    points: int = 0
    outside: int | None = None
    """First line with a motion that leaves the region."""
    deviation: float = 0.0
    """Largest distance of the corrected path from a chord, [m]."""
    correction: float = 0.0
    """Largest correction, [m]."""
    stretch: list[float] = field(default_factory=lambda: [1.0, 1.0])
    """Smallest and largest factor by which a feed changes."""
    unit_assumed: bool = False
    """Whether coordinates precede any G20 or G21."""
    ended: bool = False
    """Whether the program has an end (M2, M30 or a second %)."""


class ProgramCorrector:
    """Corrector of one program.

    Args:
        interpreter: New interpreter of the program.
        correct: Correction of points.
        file: Name of the program, for messages.
        within: Tolerance: largest distance of the written path from the exact corrected path, [m].
        region: Limits of x, y and z, shape (3, 2), [m]. The summary has the first line beyond them.
        sides: Sides of approach of the drives, if the program compensates backlash.

    Raises:
        GcodeError: If the error bound of the correction exceeds the tolerance.
    """

    def __init__(
        self,
        interpreter: Interpreter,
        correct: Correction,
        *,
        file: str,
        within: float,
        region: Array | None = None,
        sides: Sides | None = None,
    ) -> None:
        self._interpreter, self._correct, self._region = interpreter, correct, region
        self._sides = sides
        self._file = file
        self._writer = Writer(
            interpreter.axes, rounding=ROUNDING * within, start=interpreter.position
        )
        self._tolerance = (1.0 - ROUNDING) * within - correct.bound
        if self._tolerance < ROUNDING * within:
            raise GcodeError(
                f"found {within / UM:.3g} µm; the correction has an error of up to "
                f"{correct.bound / UM:.3g} µm: expected more",
                where="--within",
            )
        self.summary = Summary()

    def run(self, lines: Iterable[str]) -> Iterator[str]:
        """Lines of the corrected program, block by block.

        Args:
            lines: Lines of the program, each with its line end.

        Raises:
            GcodeError: If a line cannot be corrected; names the first such line.
        """
        steps: list[Step | str] = []
        segment_count, percent_signs = 0.0, 0  # the second % ends a program
        summary, interpreter = self.summary, self._interpreter
        for text in lines:
            summary.lines += 1
            if text.strip() == "%" or interpreter.modes.ended or percent_signs > 1:
                percent_signs += text.strip() == "%"
                if CONTROL.search(text.rstrip("\r\n")):
                    where = f"{self._file}:{summary.lines}"
                    raise GcodeError("holds a control character", where=where)
                self._require_readable([text], summary.lines)
                steps.append(text)
            else:
                step = self._read(text, steps)
                steps.append(step)
                if step.motion is not None:
                    summary.unit_assumed |= not step.modes.has_unit
                    segment_count += _estimate_segments(step.motion)
            if len(steps) >= LINES_PER_BLOCK or segment_count > SEGMENTS_PER_BLOCK:
                yield self._write(steps)
                steps, segment_count = [], 0.0
        yield self._write(steps)
        summary.ended = interpreter.modes.ended or percent_signs > 1

    def _read(self, text: str, pending: Sequence[Step | str]) -> Step:
        """Effect of a line.

        Args:
            text: Text of the line.
            pending: Effects of the previous lines of the block.
        """
        number, interpreter = self.summary.lines, self._interpreter
        point = split_point_line(text, number)
        step = None if point is None else interpreter.read_point(point)
        if step is not None:
            return step
        try:
            return interpreter.read(split_line(text, number))
        except GcodeError as e:
            self._write(pending)  # raises if an earlier line is out of reach
            raise GcodeError(e.problem, where=f"{self._file}:{number}") from None

    def _write(self, steps: Sequence[Step | str]) -> str:
        """Corrected text of a block."""
        moving = [s for s in steps if isinstance(s, Step) and s.motion is not None]
        motions = [s.motion for s in moving if s.motion is not None]
        paths = Paths.from_motions(motions)
        if self.summary.outside is None and self._region is not None and moving:
            leaving = np.flatnonzero(paths.leaves_region(self._region))
            if leaving.size:
                self.summary.outside = moving[leaving[0]].line.number
        results = iter(
            segment_motions(paths, self._correct, tolerance=self._tolerance, sides=self._sides)
        )
        summary, low, high = self.summary, *self.summary.stretch
        texts: list[str] = []
        for step in steps:
            if isinstance(step, str):
                texts.append(step)
                continue
            if isinstance(step.line, Line) and step.motion is None:
                written = [self._writer.copy(step.line)]
            else:
                segments = next(results)
                if isinstance(segments, Refused):
                    raise GcodeError(
                        f"the machine cannot make this motion: {_subject(step, segments)} "
                        f"{segments.reason}",
                        where=f"{self._file}:{step.line.number}",
                    )
                summary.motions += 1
                summary.points += len(segments.points)
                summary.deviation = max(summary.deviation, segments.deviation)
                summary.correction = max(summary.correction, segments.correction)
                if not step.end_only and step.modes.motion:
                    low = min(low, *segments.stretch)
                    high = max(high, *segments.stretch)
                written = self._writer.write(step, segments)
            # lines between the first and the last contain coordinates only and are short
            if len(written[0]) > SHORT or len(written[-1]) > SHORT:
                self._require_readable(written, step.line.number)
            texts += written
        summary.stretch = [low, high]
        return "".join(texts)

    def _require_readable(self, texts: Sequence[str], number: int) -> None:
        """Refuse lines that a controller would truncate."""
        for text in texts:
            size = len(text.removesuffix("\n").encode("utf-8", "surrogateescape"))
            if size > LONGEST_READ:
                raise GcodeError(
                    f"has {size} bytes after correction; expected at most {LONGEST_READ}, "
                    "as LinuxCNC reads: shorten its comments",
                    where=f"{self._file}:{number}",
                )


def _subject(step: Step, refused: Refused) -> str:
    """Subject of the message: the point out of reach in the program's coordinates, else "it"."""
    if refused.point is None:
        return "it"
    values = zip(AXES, refused.point, step.offset, strict=True)
    coordinates = (f"{letter}{(v - zero) / MM + 0.0:.4g}" for letter, v, zero in values)
    return f"{' '.join(coordinates)} mm"


def _estimate_segments(motion: Motion) -> float:
    """Estimated number of segments of a motion; those of an arc are about a tenth as long."""
    length = math.dist(motion.start, motion.end)
    if motion.arc is None:
        return 1.0 + length / LONGEST_SEGMENT
    return 1.0 + (length + 10.0 * abs(motion.arc.sweep) * motion.arc.radii[0]) / LONGEST_SEGMENT
