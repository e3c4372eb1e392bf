"""What is printed: results on stdout, all else on stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import typer

from orthocal.characters import printable
from orthocal.errors import SessionError

if TYPE_CHECKING:
    from orthocal.assess.rows import Chunk


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


def print_rows(columns: Iterable[str], form: Callable[[Any], str], chunks: Iterable[Chunk]) -> None:
    """Print a table as it is evaluated; rows that are refused are named, and their cells empty.

    Raises:
        SessionError: If the machine can be at none of the rows.
        typer.Exit: With code 3 if it cannot be at some.
    """
    refused: list[str] = []
    count, begun, rest = 0, False, ""
    first: tuple[str, str] | None = None
    for chunk in chunks:
        count += len(chunk.refused)
        for e in chunk.refused.values():
            first = first or (e.posture, e.reason)
            refused.append(f"orthocal: {e.posture}: {e.reason}")
        rest += form(chunk.values)
        if not begun and len(chunk.refused) == len(chunk.values):
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
