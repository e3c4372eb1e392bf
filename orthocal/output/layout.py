"""Tables, sections and numbers as all printed results have them."""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Callable, Iterable

from rich import box
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from orthocal.identification.records import ResidualRow

MANY_ROWS = 60
"""Readings above which only the worst are listed, unless all are asked for."""

WORST_ROWS = 20

LONGEST_NAME = 44
"""Characters of a name that are shown where there is little room."""


WIDTH = 100
"""Columns of plain text."""


def to_text(content: RenderableType) -> str:
    """Rich renderables as plain text."""
    stream = io.StringIO()
    console = Console(file=stream, width=WIDTH, no_color=True, highlight=False)
    console.print(content)
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()) + "\n"


def print_rich(content: RenderableType) -> None:
    """Print rich renderables: in colour on a terminal, else as plain text."""
    if sys.stdout.isatty():
        Console(highlight=False).print(content)
    else:
        sys.stdout.write(to_text(content))


def section(title: str, body: RenderableType) -> RenderableType:
    """A titled, indented part."""
    return Group(Text(), Text(title, style="bold cyan"), Padding(body, (0, 0, 0, 2)))


def bullets(sentences: list[str]) -> RenderableType:
    """Sentences, each with a bullet."""
    return Group(*(Text(f"• {s}") for s in sentences))


def table_of(*columns: str, left: int = 1) -> Table:
    """A table with a rule under its header; columns after the first are numbers."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(Text(column), justify="left" if i < left or column == "unit" else "right")
    return table


def add_row(table: Table, *cells: str) -> None:
    """Add a row of plain text: names come from files, and are not markup."""
    table.add_row(*(Text(cell) for cell in cells))


def mm(value: float) -> str:
    """A length in mm, three decimals."""
    return plain(value * 1e3)


def plain(value: float, decimals: int = 3) -> str:
    """A number, or the word unknown."""
    return f"{value:.{decimals}f}" if math.isfinite(value) else "unknown"


def signed(value: float, decimals: int = 3) -> str:
    """A number with its sign, or the word unknown."""
    return f"{value:+.{decimals}f}" if math.isfinite(value) else "unknown"


def typeset(value: float, decimals: int = 3) -> str:
    """A number with its sign for a page or a picture: with a true minus, and zero without a sign.

    Args:
        value: The number.
        decimals: Of them.
    """
    rounded = round(value, decimals)
    text = signed(rounded, decimals) if rounded else plain(0.0, decimals)
    return text.replace("-", "−")


def counted(count: int, noun: str) -> str:
    """So many of something, in words: 1 reading, 2 readings."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def um(value: float) -> str:
    """A length in µm, as many decimals as say something."""
    size = value * 1e6
    return f"{size:.0f}" if abs(size) >= 20.0 else f"{size:.1f}"


def choose_rows(
    rows: tuple[ResidualRow, ...],
    all_rows: bool,
    *,
    key: Callable[[ResidualRow], float] = lambda r: abs(r.residual),
) -> tuple[Iterable[ResidualRow], str]:
    """All rows, or the worst of many, and a note that says so."""
    if all_rows or len(rows) <= MANY_ROWS:
        return rows, ""
    worst = sorted(rows, key=key, reverse=True)[:WORST_ROWS]
    return worst, f"The {WORST_ROWS} largest of {len(rows)}; --all lists every reading."


def short_name(text: str, longest: int = LONGEST_NAME) -> str:
    """A name from a file as it can be shown: printable, and not too long."""
    shown = "".join(c if c.isprintable() else " " for c in text)
    half = longest // 2
    return shown if len(shown) <= longest else f"{shown[:half]}…{shown[-half + 1 :]}"
