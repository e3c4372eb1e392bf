"""The command `correct`."""

from __future__ import annotations

import gc
import hashlib
import io
import os
import re
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import IO, TYPE_CHECKING, Annotated, BinaryIO, NamedTuple

from typer import Option

import orthocal
from orthocal.cli.options import command, read_vector
from orthocal.cli.overwriting import require_replaceable_file
from orthocal.cli.printing import put_note
from orthocal.errors import CalibrationFileError, GcodeError, OutputError, ParameterError
from orthocal.io.files import is_folder, read_file, read_parts, write_file
from orthocal.text import comment_safe, shorten
from orthocal.units import MM, UM, format_fixed

if TYPE_CHECKING:
    from orthocal.arrays import Array
    from orthocal.export.correction_field import CorrectionField
    from orthocal.gcode.path import Vector
    from orthocal.gcode.program import Summary
    from orthocal.kinematics.conditions import UseCondition
    from orthocal.kinematics.workspace import Workspace

MARK = "Corrected by orthocal"
"""Beginning of the comment that marks a corrected program."""

BLOCK_SIZE = 2**16
"""Number of characters or bytes that are read or written at once."""

LONGEST_COMMENT = 240
"""Largest number of bytes of a comment's line; LinuxCNC reads lines of 252 bytes."""

BYTES = 3
"""Largest number of bytes of a character."""

CONDITIONS: tuple[UseCondition, ...] = ("temperature", "payload")
"""Conditions of use of a program; the side of approach follows from its motions."""

PROGRESS_VARIABLE = "AXIS_PROGRESS_BAR"
"""Environment variable by which the user interface of LinuxCNC requests progress."""


class Offsets(StrEnum):
    """Offsets in the controller when the program runs."""

    ENTERED = "entered"
    ACTIVE = "active"


class Backlash(StrEnum):
    """Place at which the backlash of the drives is compensated."""

    PROGRAM = "program"
    CONTROLLER = "controller"


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectionOptions:
    """Options about controller, tool and machine.

    Args:
        within (UM): Largest distance of the written path from the corrected path, µm.
        offsets: Offsets in the controller when the program runs: those that `calibrate` says to
            enter, or those that were active during the measurement.
        backlash: Who takes up identified backlash: the program, or the controller (LinuxCNC:
            BACKLASH). Default: the controller, which has the values to enter; with --offsets active
            the program, except for the part that the controller compensates already.
        work_offset_mm ([G54=]X,Y,Z): Zero of the program in machine coordinates; repeat for G55 ...
        start_mm (X,Y,Z): Position that the controller displays before the program. Without it,
            rapid motions before the first position in X, Y and Z are not corrected.
        temperature (C): Temperature of the machine, °C; default: the robot's reference temperature
            (20 °C).
    """

    within: Annotated[float, Option(min=0.01, max=1000.0)] = 1.0
    offsets: Offsets = Offsets.ENTERED
    backlash: Backlash | None = None
    work_offset_mm: list[str] | None = None
    start_mm: str | None = None
    tool: str | None = None
    temperature: float | None = None
    payload: float | None = None


@command()
def correct(
    calibration: Path,
    program: Path,
    *,
    options: CorrectionOptions,
    out: Path | None = None,
    anyway: bool = False,
    force: bool = False,
) -> None:
    """Correct a G-code program for the errors of the machine.

    The program is for a controller without the kinematics module of `export`. Lines and arcs are
    divided into short lines that stay near the corrected path. The feed along the path and all
    other words are preserved.
    Comments at the top mark the program as corrected; such a program is refused.
    With --tool the program may use one tool only. If a line cannot be corrected, its number and
    the reason are reported, and nothing is written. A note names the first line that leaves the
    workspace.

    Exit code 3: the verdict is not `enter`; the reason is printed.

    Args:
        program (PROGRAM): G-code file; - for standard input.
        out (FILE): File for the corrected program; default: standard output.
    """
    from orthocal.export.formats import require_entering, require_offsets, warn_against_verdict

    controller = _read_controller(options)
    if out is not None:
        require_replaceable_file(out, force=force)
    result = orthocal.load_calibration(calibration)
    require_offsets(result, where=str(calibration))
    if not anyway:
        require_entering(result)
    file = "standard input" if str(program) == "-" else str(program)
    correction = _Correction(result, options, controller, file)
    warning = warn_against_verdict(result)
    mark = f"{MARK}: calibration {_identify(calibration)}. Do not correct again."
    comments = [mark, *correction.list_comments(), warning]
    source = _lines(program, file)
    with tempfile.TemporaryFile() as spool:  # nothing is written before all lines are corrected
        with _frozen():
            texts = correction.corrector.run(source if anyway else _refuse_corrected(source, file))
            _spool(_with_comments(texts, [c for c in comments if c]), spool)
        if not correction.corrector.summary.lines:
            raise GcodeError("is empty; expected a program", where=file)
        _put_program(spool, out)
    put_note("\n".join(note for note in correction.list_notes(warning) if note))


class _Controller(NamedTuple):
    """Stated controller and tool."""

    work_offsets: dict[str, Vector]
    start: Vector | None
    tip: Vector | None


def _read_controller(options: CorrectionOptions) -> _Controller:
    """Controller and tool of the options.

    Raises:
        ParameterError: If an option is malformed.
    """
    start, tool = options.start_mm, options.tool
    return _Controller(
        _read_offsets(options.work_offset_mm or []),
        None if start is None else read_vector(start, "--start-mm"),
        orthocal.ExportOptions(tool=None if tool is None else read_vector(tool, "--tool")).tool,
    )


class _Correction:
    """Correction of one program by a calibration, and the facts for its notes.

    Raises:
        OrthocalError: If a condition of use is invalid, or the correction cannot be computed.
    """

    def __init__(
        self,
        result: orthocal.Calibration,
        options: CorrectionOptions,
        controller: _Controller,
        file: str,
    ) -> None:
        from orthocal.assessment.controller_entries import offsets_to_enter
        from orthocal.export.approach_sides import ApproachSides
        from orthocal.export.correction_field import CorrectionField
        from orthocal.gcode.interpreter import Interpreter
        from orthocal.gcode.program import ProgramCorrector

        active, tip = options.offsets is Offsets.ACTIVE, controller.tip
        values = result.active_offsets if active else offsets_to_enter(result)
        self.result, self.controller, self.file = result, controller, file
        self.tolerance = options.within * UM
        """Largest distance of the written path from the corrected path, [m]."""
        self.conditions = orthocal.UseConditions(None, options.temperature, options.payload)
        self.conditions.require_valid(result.robot, prefix="--")
        self.field = CorrectionField(
            result,
            values,
            within=self.tolerance,
            tool=tip or (0.0, 0.0, 0.0),
            conditions=self.conditions,
            aligned_over=_find_workspace(result),
        )
        self.interpreter = Interpreter(
            axes=self.field.axes,
            offsets=controller.work_offsets,
            origin=result.session.controller_origin,
            start=controller.start,
            one_tool=tip is not None,
        )
        region, self.region = _find_region(result)
        lags = _find_lags(result)
        usual = Backlash.PROGRAM if active else Backlash.CONTROLLER
        by_program = (options.backlash or usual) is Backlash.PROGRAM and bool(lags.any())
        sides = ApproachSides(result, values, lags) if by_program else None
        self.backlash = _describe_backlash(result, lags, by_program=by_program)
        self.corrector = ProgramCorrector(
            self.interpreter,
            self.field,
            file=file,
            within=self.tolerance,
            region=region,
            sides=sides,
        )
        self.for_controller = _describe_controller(result, values, active=active)

    def list_comments(self) -> list[str]:
        """Comments about controller and machine; empty ones do not apply."""
        from orthocal.output.text.conditions import describe_conditions_of

        return [
            self.for_controller,
            self.backlash,
            describe_conditions_of(self.result, self.conditions, fields=CONDITIONS),
            _describe_tip(self.controller.tip),
        ]

    def list_notes(self, warning: str) -> list[str]:
        """Notes about the corrected program; empty ones do not apply."""
        from orthocal.export.formats import note_wrong_order
        from orthocal.output.text.conditions import describe_assumed

        summary, tools = self.corrector.summary, self.interpreter.tools.used
        notes = [
            _describe(summary, self.field, self.tolerance),
            self.for_controller,
            note_wrong_order(self.result),
            _describe_tip(self.controller.tip) or _describe_tools(tools),
            describe_assumed(self.result, self.conditions, fields=CONDITIONS),
            self.backlash,
            warning,
        ]
        if (line := self.interpreter.uncorrected) is not None:
            notes.append(
                f"{self.file}:{line}: this rapid motion comes before the first position in X, Y "
                "and Z and is not corrected: the tool may be off by the largest correction. "
                "--start-mm corrects it."
            )
        if summary.outside is not None:
            notes.append(
                f"{self.file}:{summary.outside}: leaves the workspace {self.region} around the "
                "mechanical zero, over which the correction was determined. Beyond it the "
                "correction is less certain."
            )
        if not self.controller.work_offsets:
            notes.append("The program's coordinates are read as machine coordinates.")
        elif "G54" not in self.controller.work_offsets:
            notes.append("Coordinates before the first stated work zero are machine coordinates.")
        if self.region:
            notes.append("A work zero that was touched off without correction remains valid.")
        if summary.unit_assumed:
            notes.append("No G20 or G21 before the first coordinates: read as mm.")
        return notes


def _put_program(spool: IO[bytes], out: Path | None) -> None:
    """Write a corrected program to its file, or to standard output; closes the spool."""
    if out is not None:
        write_file(out, iter(lambda: spool.read(BLOCK_SIZE), b""))
        return
    # a byte in another encoding becomes one question mark: lines keep their length
    with io.TextIOWrapper(spool, encoding="utf-8", errors="surrogateescape", newline="") as text:
        while part := text.read(BLOCK_SIZE):
            sys.stdout.write(part)
    sys.stdout.flush()


@contextmanager
def _frozen() -> Iterator[None]:
    """Exclude all loaded objects from garbage collection inside the block.

    The correction creates and frees many objects without cycles; scanning the loaded ones each time
    would take longer.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _lines(program: Path, file: str) -> Iterator[str]:
    """Lines of a program or of the standard input; long lines are split into parts."""
    from orthocal.gcode.lines import LONGEST_LINE

    if str(program) != "-":
        source: Path | BinaryIO = program
    elif sys.stdin is None:
        raise GcodeError("is closed", where=file)
    else:
        source = sys.stdin.buffer
    parts = read_parts(source, longest=LONGEST_LINE + 2, name=file, error=GcodeError)
    if isinstance(source, Path) and PROGRESS_VARIABLE in os.environ:
        parts = _report_progress(parts, source)
    for part in parts:
        text = part.decode("utf-8", "surrogateescape")
        # padding, so that a part with too many bytes also has too many characters
        yield text.ljust(len(part)) if len(part) > LONGEST_LINE else text


def _report_progress(parts: Iterable[bytes], source: Path) -> Iterator[bytes]:
    """Pass on the parts of a file; report progress on stderr in the form of LinuxCNC's filters."""
    done = percent = size = 0
    for part in parts:
        size = size or source.stat().st_size
        done += len(part)
        if 100 * done // size > percent:
            percent = 100 * done // size
            put_note(f"FILTER_PROGRESS={min(percent, 100)}")
        yield part


def _identify(calibration: Path) -> str:
    """Name of a calibration, and the first digits of the SHA-256 of its file."""
    file = calibration / "calibration.json" if is_folder(calibration) else calibration
    digest = hashlib.sha256(read_file(file, error=CalibrationFileError)).hexdigest()
    return f"{comment_safe(file.resolve().parent.name)}, SHA-256 {digest[:12]}"


def _refuse_corrected(texts: Iterable[str], file: str) -> Iterator[str]:
    """Pass on the lines of a program that is not corrected yet.

    Raises:
        GcodeError: If a comment marks the program as corrected.
    """
    for number, text in enumerate(texts, start=1):
        if MARK in text:
            raise GcodeError(
                f"found '{shorten(text.strip().lstrip('; '))}': the program is corrected already; "
                "expected the original program (--anyway corrects it a second time)",
                where=f"{file}:{number}",
            )
        yield text


def _with_comments(texts: Iterable[str], comments: Sequence[str]) -> Iterator[str]:
    """Program with comments as its first lines, or after a % at its beginning."""
    texts = iter(texts)
    first = next((text for text in texts if text), "")
    if not first:
        return
    percent = re.match(r"\s*%[^\n]*(\n|$)", first)
    split = percent.end() if percent else 0
    line_end = "\r\n" if "\r\n" in first else "\n"
    head = first[:split]
    if head and not head.endswith("\n"):
        head += line_end
    for comment in comments:  # a controller reads each line completely
        longest = LONGEST_COMMENT if comment.isascii() else LONGEST_COMMENT // BYTES
        head += "".join(f"; {part}{line_end}" for part in wrap(comment, longest))
    yield head + first[split:]
    yield from texts


def _spool(texts: Iterable[str], spool: IO[bytes]) -> None:
    """Write texts to a temporary file and rewind it."""
    try:
        for text in texts:
            spool.write(text.encode("utf-8", "surrogateescape"))
        spool.seek(0)
    except OSError as e:
        raise OutputError(f"cannot be written: {e.strerror}", where="a temporary file") from None


def _read_offsets(texts: list[str]) -> dict[str, Vector]:
    """Work offsets of the option `--work-offset-mm`, [m], by coordinate system."""
    from orthocal.gcode.interpreter import SYSTEMS

    option, systems = "--work-offset-mm", list(SYSTEMS.values())
    offsets: dict[str, Vector] = {}
    for text in texts:
        name, has_name, values = text.rpartition("=")
        name = name.strip().upper() if has_name else systems[0]
        if name not in systems:
            raise ParameterError(
                f"found '{text}'; expected X,Y,Z or one of {', '.join(systems)} = X,Y,Z",
                where=option,
            )
        if name in offsets:
            raise ParameterError(f"found {name} twice", where=option)
        offsets[name] = read_vector(values, option)
    return offsets


def _describe(summary: Summary, field: CorrectionField, within: float) -> str:
    """Note about the size and the accuracy of the correction."""
    from orthocal.assessment.wording import counted, mm
    from orthocal.gcode.program import ROUNDING

    change = max(abs(v - 1.0) * 100.0 for v in summary.stretch)
    bound = summary.deviation + field.error + ROUNDING * within
    return (
        f"Corrected {counted(summary.motions, 'motion')}, written as "
        f"{counted(summary.points, 'point')}. Largest correction: {mm(summary.correction)} mm. The "
        f"path is within {bound / UM:.2g} µm of the exact correction (limit {within / UM:g} µm). "
        f"Feeds change by at most {change:.2f} %, so that the tool keeps its speed."
    )


def _find_workspace(result: orthocal.Calibration) -> Workspace | None:
    """Workspace of the assessment; None without a reachable one."""
    from orthocal.assessment.assess import assessment_of
    from orthocal.kinematics.workspace import box_workspace

    tool = assessment_of(result).tool
    return None if tool is None else box_workspace(result.robot, tool.box)


def _find_region(result: orthocal.Calibration) -> tuple[Array | None, str]:
    """Limits of x, y and z of the workspace, shape (3, 2), [m], and its description."""
    import numpy as np

    from orthocal.assessment.assess import assessment_of
    from orthocal.kinematics.workspace import tool_at_zero

    tool = assessment_of(result).tool
    if tool is None or result.robot.tcp is None:
        return None, ""
    region = np.tile([-np.inf, np.inf], (3, 1))
    region[list(result.robot.tcp.coordinates)] = (
        np.array(tool.box) + tool_at_zero(result.robot)[:, None]
    )
    return region, tool.region


def _describe_tip(tip: Vector | None) -> str:
    """Note about the stated tip; empty if there is none."""
    if tip is None:
        return ""
    return f"For a tip at {', '.join(f'{v / MM:g}' for v in tip)} mm from the tool centre point."


def _describe_tools(tools: Sequence[str]) -> str:
    """Note about a program with several tools; empty for one tool."""
    if len(tools) < 2:
        return ""
    return (
        f"Several tools ({', '.join(tools)}) and no --tool: corrected at the tool centre point. "
        "The tilt of the platform moves their tips."
    )


def _describe_backlash(result: orthocal.Calibration, lags: Array, *, by_program: bool) -> str:
    """Note about the backlash to be compensated; empty if there is none.

    Args:
        result: The calibration.
        lags: Half of the backlash to be compensated, shape (n_drives,), [m, rad].
        by_program: Whether the program compensates it, not the controller.
    """
    from orthocal.assessment.controller_entries import backlash_changes, find_backlash
    from orthocal.effects.compensation import describe_trims

    backlash = 2.0 * lags
    if not by_program:
        backlash = result.compensated_backlash + backlash_changes(result, find_backlash(result))
    listed = ", ".join(
        f"{drive.name} {drive.show(value)}"
        for drive, value in zip(result.robot.drives, backlash.tolist(), strict=True)
        if float(format_fixed(value / drive.joint_size, 3))
    )
    if not listed:
        return ""
    if by_program and describe_trims(result.robot, result.session.compensation):
        return (
            "Where drives reverse, the program takes up the backlash that the controller does not "
            f"compensate, as the session states: {listed}."
        )
    if by_program:
        return (
            f"Where drives reverse, the program takes up their backlash: {listed}. The controller "
            "must not compensate it."
        )
    return (
        f"The controller must compensate the backlash of the drives: {listed}. If it cannot, use "
        "--backlash program."
    )


def _find_lags(result: orthocal.Calibration) -> Array:
    """Lags of the drives that the controller does not compensate, shape (n_drives,), [m, rad].

    A lag is half of the backlash, minus the compensation that the session states. It is 0 for a
    drive whose backlash is not entered as identified.
    """
    from orthocal.assessment.controller_entries import find_backlash
    from orthocal.export.approach_sides import find_lags

    lags: Array = find_lags(result.robot, result.errors) - 0.5 * result.compensated_backlash
    unchanged = {e.drive for e in find_backlash(result) if e.enter != e.identified}
    lags[[d.name in unchanged for d in result.robot.drives]] = 0.0
    return lags


def _describe_controller(
    result: orthocal.Calibration, values: Iterable[float], *, active: bool
) -> str:
    """Note about the offsets in the controller, [m, rad], when the program runs."""
    from orthocal.assessment.assess import assessment_of
    from orthocal.robot.model import name_coordinates

    listed = name_coordinates(result.robot.drives, values, partial(format_fixed, sign=True))
    keep = assessment_of(result).keeps_offsets
    state = "active during the measurement" if active else "that stay" if keep else "to enter"
    if result.session.controller_offsets is None:
        state += " (in addition to those that were active during the measurement)"
    return f"For a controller with the offsets {state}: {', '.join(listed)}."
