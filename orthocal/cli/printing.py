"""What is printed: results on stdout, all else on stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import typer

from orthocal.errors import SessionError
from orthocal.text import printable

if TYPE_CHECKING:
    from orthocal.assessment.tool_tables import Chunk


def put_out(text: str) -> None:
    """A result, on stdout."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def put_part(text: str) -> None:
    """A part of a long result, on stdout."""
    sys.stdout.write(text)


def put_note(text: str) -> None:
    """Anything else, on stderr."""
    sys.stderr.write(printable(text, keep="\n") + "\n")


MOST_HELD = 10_000
"""Refused rows before the first that is served; the table begins after so many at the latest."""


def print_rows(columns: Iterable[str], form: Callable[[Any], str], chunks: Iterable[Chunk]) -> None:
    """Print a table as it is evaluated; rows that are refused are named, and their cells empty.

    Raises:
        SessionError: If the machine can be at none of the rows; or as the chunks do, and how many
            rows were served before.
        typer.Exit: With code 3 if it cannot be at some.
    """
    refused: list[str] = []
    count, served, begun, rest = 0, 0, False, ""
    first: tuple[str, str] | None = None
    rows = iter(chunks)
    while True:
        try:
            chunk = next(rows, None)
        except SessionError as e:
            if not begun:
                raise
            before = f"; the {served} rows in blocks before it were served"
            raise SessionError(e.problem + before, where=e.where) from None
        if chunk is None:
            break
        count += len(chunk.refused)
        served += len(chunk.values)
        for why in chunk.refused.values():
            first = first or (why.posture, why.reason)
            refused.append(f"orthocal: {why.posture}: {why.reason}")
        rest += form(chunk.values)
        if not begun and len(chunk.refused) == len(chunk.values) and count < MOST_HELD:
            continue  # there may be none to be served at all
        text, rest = rest if begun else printable(",".join(columns)) + "\n" + rest, ""
        begun = True
        put_out(text.removesuffix("\n"))
        for line in refused:
            put_note(line)
        refused.clear()
    if first is not None and not begun:
        raise SessionError(first[1], where=first[0])
    if count:
        put_note(f"orthocal: {count} of the rows cannot be reached; their cells are empty")
        raise typer.Exit(3)
