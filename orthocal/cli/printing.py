"""Output of commands: results on stdout, notes on stderr, files, and the exit code."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

import orthocal
from orthocal.errors import ClosureError, OrthocalError, SessionError, SolverError
from orthocal.io.files import Content, write_files
from orthocal.text import printable

if TYPE_CHECKING:
    from rich.console import RenderableType

    from orthocal.assessment.tool_tables import Chunk

    Judged = orthocal.Assessment | orthocal.Calibration | orthocal.Comparison | orthocal.Validation


def put_out(text: str) -> None:
    """Print a result on stdout."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def put_note(text: str) -> None:
    """Print a note on stderr; an empty one does not apply."""
    if text:
        sys.stderr.write(printable(text, keep="\n") + "\n")


def deliver(
    document: Callable[[], str],
    render: Callable[[], RenderableType],
    *,
    json: bool,
    out: Path | None = None,
    files: Callable[[], Mapping[str, Content]] = dict,
) -> None:
    """Print a result and write its files.

    Args:
        document: Function that returns the result as JSON.
        render: Function that returns the result for the terminal: rich renderables, or lines that
            are not wrapped.
        json: Whether to print JSON instead of text.
        out: Directory of the files; None to write no files.
        files: Function that returns the contents of the files by name.
    """
    from orthocal.output.text.layout import print_rich

    if json:
        put_out(document().rstrip("\n"))
    elif isinstance(rendered := render(), str):
        put_out(printable(rendered, keep="\n"))
    else:
        print_rich(rendered)
    if out is not None:
        write_results(out, files())


def deliver_judged(
    result: Judged,
    *,
    json: bool,
    out: Path | None = None,
    files: Callable[[], Mapping[str, Content]] = dict,
    **shown: Any,  # noqa: ANN401 - arguments of `render_result`
) -> None:
    """Print a result with a decision about readings, and exit with its code.

    For the arguments see `deliver`.

    Raises:
        typer.Exit: With the code of the decision if it is not 0.
    """
    from orthocal.calibration.assessment_record import Assessment
    from orthocal.output.text.answer import render_decision
    from orthocal.output.text.summary import assessment_in, render_result, result_json

    def render() -> RenderableType:
        if isinstance(result, Assessment):
            return render_decision(result, **shown)
        return render_result(result, **shown)

    deliver(lambda: result_json(result), render, json=json, out=out, files=files)
    if code := assessment_in(result).decision.exit_code:
        raise typer.Exit(code)


@contextmanager
def judgement_on_failure(
    session: orthocal.Session,
    judgement: orthocal.Judgement | None = None,
    *,
    json: bool,
    details: bool,
) -> Iterator[None]:
    """Print the judgement of the readings instead of a failure of the solver, if it explains it.

    The failure is a finding of the printed assessment.

    Args:
        session: The readings.
        judgement: Their judgement, if it was made before.
        json: Whether to print JSON instead of text.
        details: Whether to list the evidence for each finding.
    """
    from orthocal.assessment.words.fit import no_solution

    try:
        yield
    except (SolverError, ClosureError) as failure:
        try:
            assessment = orthocal.check_session(session, judgement=judgement)
        except OrthocalError:
            raise failure from None
        if not assessment.decision.exit_code:
            raise
        findings = (*assessment.findings, no_solution())
        deliver_judged(replace(assessment, findings=findings), json=json, details=details)


def write_results(directory: Path, files: Mapping[str, Content]) -> None:
    """Write the files of a result, all or none, and name them on stderr."""
    from orthocal.assessment.wording import joined

    write_files(directory, files)
    put_note(f"Wrote {joined([str(directory / name) for name in files])}")


MOST_HELD = 10_000
"""Largest number of refused rows that are withheld until the first row within reach."""


def print_rows(columns: Iterable[str], form: Callable[[Any], str], chunks: Iterable[Chunk]) -> None:
    """Print a table block by block; refused rows are named on stderr, and their cells are empty.

    Args:
        columns: Names of the columns.
        form: Function from the values of a block to lines of CSV.
        chunks: Blocks of the table.

    Raises:
        SessionError: If the machine reaches none of the rows, or a block has an error; the message
            then has the number of rows before it.
        typer.Exit: With code 3 if the machine does not reach some rows.
    """
    header = printable(",".join(columns)) + "\n"
    withheld, notes = "", list[str]()
    refused = evaluated = 0
    first_refused: tuple[str, str] | None = None
    try:
        for chunk in chunks:
            refused += len(chunk.refused)
            evaluated += len(chunk.values)
            for error in chunk.refused.values():
                first_refused = first_refused or (error.posture, error.reason)
                notes.append(f"orthocal: {error.posture}: {error.reason}")
            withheld += form(chunk.values)
            if header and len(chunk.refused) == len(chunk.values) and refused < MOST_HELD:
                continue  # perhaps the machine reaches none of the rows
            put_out((header + withheld).removesuffix("\n"))
            for note in notes:
                put_note(note)
            header, withheld = "", ""
            notes.clear()
    except SessionError as e:
        if header:
            raise
        done = f"; the {evaluated} rows in blocks before it were evaluated"
        raise SessionError(e.problem + done, where=e.where) from None
    if first_refused is not None and header:
        raise SessionError(first_refused[1], where=first_refused[0])
    if refused:
        rows, cells = ("1 row", "its") if refused == 1 else (f"{refused} rows", "their")
        put_note(f"orthocal: {rows} cannot be reached; {cells} cells are empty")
        raise typer.Exit(3)
