"""Programs for controllers with nominal kinematics: correct."""

from __future__ import annotations

import gc
import io
import os
import re
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, BinaryIO

import typer

from orthocal.cli.options import CalibrationPath, app
from orthocal.cli.printing import put_note, put_part
from orthocal.errors import GcodeError, OutputError, ParameterError
from orthocal.units import MM, UM

if TYPE_CHECKING:
    from orthocal.calibration.calibration import Calibration
    from orthocal.export.correction_field import CorrectionField
    from orthocal.gcode.path import Vector
    from orthocal.gcode.program import Summary
    from orthocal.robot.model import Drive

PART = 2**16
"""Characters or bytes that are read or written together."""


PROGRESS_ASKED = "AXIS_PROGRESS_BAR"
"""Variable of the environment in which LinuxCNC's window says that it shows how far a filter is."""


class Offsets(StrEnum):
    """What is in the controller when the program runs."""

    ENTERED = "entered"
    ACTIVE = "active"


@app.command()
def correct(
    calibration: CalibrationPath,
    program: Annotated[
        Path, typer.Argument(metavar="PROGRAM", help="G-code; - for standard input.")
    ],
    within_um: Annotated[
        float,
        typer.Option(
            "--within",
            min=0.01,
            max=1000.0,
            help="By how much what is written may be off the corrected path, µm.",
        ),
    ] = 1.0,
    offsets: Annotated[
        Offsets,
        typer.Option(
            help="In the controller when the program runs: those that `calibrate` says to enter, "
            "or those that were active while measuring."
        ),
    ] = Offsets.ENTERED,
    work_offset: Annotated[
        list[str] | None,
        typer.Option(
            "--work-offset-mm",
            metavar="[G54=]X,Y,Z",
            help="Where the program's zero is in the machine's coordinates; repeat for G55 ...",
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            "--start-mm",
            metavar="X,Y,Z",
            help="Where the controller shows the tool before the program, if the first motion does "
            "not say X, Y and Z.",
        ),
    ] = None,
    tool: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="The tip of the tool in the frame of the tool centre point, mm; 0,0,0 by default.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="File for the result, instead of standard output.")
    ] = None,
    anyway: Annotated[
        bool, typer.Option("--anyway", help="Also against the verdict of the calibration.")
    ] = False,
) -> None:
    """Correct a G-code program for a controller with nominal kinematics.

    Lines and arcs are cut so that chords stay near the corrected path; feed along it and all other
    words are kept. What cannot be corrected is named by its line, and nothing is written.

    Exit code 3: the verdict is not to enter the calibration.
    """
    from orthocal.assessment.controller_entries import entered_offsets
    from orthocal.calibration.file import load_calibration
    from orthocal.export.correction_field import CorrectionField
    from orthocal.export.formats import require_entering, warn_against_verdict
    from orthocal.export.options import ExportOptions
    from orthocal.gcode.program import ProgramCorrector
    from orthocal.gcode.state import Interpreter
    from orthocal.io.files import require_writable_file, write_file

    zeros = _read_offsets(work_offset or [])
    begin = None if start is None else _read_vector(start, "--start-mm")
    tip = ExportOptions(tool=None if tool is None else _read_vector(tool, "--tool")).tool
    if out is not None:
        require_writable_file(out)
    result = load_calibration(calibration)
    if not anyway:
        require_entering(result)
    warning = warn_against_verdict(result)
    active = offsets is Offsets.ACTIVE
    values = result.active_offsets if active else entered_offsets(result)
    within = within_um * UM
    field = CorrectionField(result, values, within=within, tool=tip or (0.0, 0.0, 0.0))
    file = "standard input" if str(program) == "-" else str(program)
    interpreter = Interpreter(file, axes=field.axes, offsets=zeros, start=begin)
    corrector = ProgramCorrector(
        file, axes=field.axes, interpreter=interpreter, correct=field, within=within
    )
    with tempfile.TemporaryFile() as spool:  # nothing is written before all of it is good
        with _frozen():
            texts = corrector.run(_lines(program, file))
            _spool(_with_comment(texts, warning) if warning else texts, spool)
        if not corrector.summary.lines:
            raise GcodeError("is empty; expected a program", where=file)
        if out is not None:
            write_file(out, iter(lambda: spool.read(PART), b""))
        else:
            text = io.TextIOWrapper(spool, encoding="utf-8", errors="replace", newline="")
            while part := text.read(PART):
                put_part(part)
            sys.stdout.flush()
    put_note(
        _describe(corrector.summary, field, within)
        + "\n"
        + _describe_controller(result, values, active=active)
        + _describe_tool(tip)
        + (f"\n{warning}" if warning else "")
        + ("" if zeros else "\nThe program's coordinates are taken for the machine's own.")
        + ("\nNo G20 or G21 before its coordinates: mm." if corrector.summary.unit_assumed else "")
    )


@contextmanager
def _frozen() -> Iterator[None]:
    """Keep the collector of garbage from looking at all that is loaded, again and again.

    Lines come and go by the thousand, in no circles.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _lines(program: Path, file: str) -> Iterator[str]:
    from orthocal.gcode.words import LONGEST_LINE
    from orthocal.io.files import read_parts

    if str(program) != "-":
        source: Path | BinaryIO = program
    elif sys.stdin is None:
        raise GcodeError("is closed", where=file)
    else:
        source = sys.stdin.buffer
    parts = read_parts(source, longest=LONGEST_LINE + 2, name=file, error=GcodeError)
    if isinstance(source, Path) and PROGRESS_ASKED in os.environ:
        parts = _tell_progress(parts, source)
    for part in parts:
        text = part.decode("utf-8", "surrogateescape")
        # what is too long in bytes is so in characters: a part of a line is none
        yield text.ljust(len(part)) if len(part) > LONGEST_LINE else text


def _tell_progress(parts: Iterable[bytes], source: Path) -> Iterator[bytes]:
    """The parts of a file, and on stderr how far one is, as LinuxCNC's windows understand it."""
    done = told = size = 0
    for part in parts:
        size = size or source.stat().st_size
        done += len(part)
        if 100 * done // size > told:
            told = 100 * done // size
            put_note(f"FILTER_PROGRESS={min(told, 100)}")
        yield part


def _with_comment(texts: Iterable[str], comment: str) -> Iterator[str]:
    """A program with a comment as its first line, or after the % that begins it."""
    begun = False
    for text in texts:
        if begun or not text:
            yield text
            continue
        begun = True
        mark = re.match(r"\s*%[^\n]*(\n|$)", text)
        at = mark.end() if mark else 0
        end = "\r\n" if "\r\n" in text else "\n"
        head = text[:at] if text[:at].endswith("\n") or not at else text[:at] + end
        yield f"{head}; {comment}{end}{text[at:]}"


def _spool(texts: Iterable[str], spool: IO[bytes]) -> None:
    try:
        for text in texts:
            spool.write(text.encode("utf-8", "surrogateescape"))
        spool.seek(0)
    except OSError as e:
        raise OutputError(f"cannot be written: {e.strerror}", where="a temporary file") from None


def _read_offsets(texts: list[str]) -> dict[str, Vector]:
    from orthocal.gcode.state import SYSTEMS

    known, found = list(SYSTEMS.values()), {}
    for text in texts:
        name, has_name, values = text.rpartition("=")
        name = name.strip().upper() if has_name else known[0]
        if name not in known:
            raise ParameterError(
                f"found '{text}'; expected X,Y,Z or one of {', '.join(known)} = X,Y,Z",
                where="--work-offset-mm",
            )
        if name in found:
            raise ParameterError(f"{name} stands twice", where="--work-offset-mm")
        found[name] = _read_vector(values, "--work-offset-mm")
    return found


def _read_vector(text: str, option: str) -> Vector:
    from orthocal.io.documents import parse_number

    parts = text.split(",")
    if len(parts) != 3:
        raise ParameterError(f"found '{text}'; expected X,Y,Z", where=option)
    x, y, z = (
        parse_number(part.strip(), where=option, name=name, error=ParameterError) * MM
        for part, name in zip(parts, "XYZ", strict=True)
    )
    return (x, y, z)


def _describe(summary: Summary, field: CorrectionField, within: float) -> str:
    from orthocal.gcode.program import ROUNDING

    low, high = ((v - 1.0) * 100.0 for v in summary.stretch)
    off = summary.chord + field.error + ROUNDING * within
    return (
        f"Corrected {summary.lines} lines: {summary.points} points, by up to "
        f"{summary.correction / UM:.3g} µm. What is written is within {off / UM:.3g} µm of the "
        f"corrected path (asked for: {within / UM:g}): chords {summary.chord / UM:.3g}, correction "
        f"{field.error / UM:.2g}, decimals {ROUNDING * within / UM:.2g}. Feeds were changed by "
        f"{low:+.2f} … {high:+.2f} %, so that the tool keeps them."
    )


def _describe_tool(tip: Vector | None) -> str:
    shown = ", ".join(f"{v / MM:g}" for v in tip or ())
    return f"\nIt is for a tip at {shown} mm from the tool centre point." if tip else ""


def _describe_controller(result: Calibration, values: Iterable[float], *, active: bool) -> str:
    from orthocal.units import DRIVE_UNITS

    def show(drive: Drive, value: float) -> str:
        unit, size = DRIVE_UNITS[drive.unit]
        return f"{drive.name} {value / size:+.4f} {unit}"

    pairs = zip(result.robot.drives, values, strict=True)
    listed = ", ".join(show(d, float(v)) for d, v in pairs)
    state = "active while measuring" if active else "to enter"
    known = result.session.controller_offsets is not None
    more = "" if known else " (on top of those that were active while measuring)"
    return f"It is for a controller with the offsets {state}{more}: {listed}."
