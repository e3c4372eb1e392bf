"""Tables, sections and numbers of all printed results."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import groupby
from typing import TypeVar

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.measure import Measurement
from rich.padding import Padding
from rich.segment import Segment, Segments
from rich.table import Table
from rich.text import Text

from orthocal.estimation.diagnostics.residual_rows import ResidualRow
from orthocal.io.html import items, paragraph, table
from orthocal.text import printable
from orthocal.units import format_fixed

Row = TypeVar("Row")

MANY_ROWS = 60
"""Readings above which only the worst are listed, unless all are asked for."""

WORST_ROWS = 20

LONGEST_NAME = 44
"""Longest name in a plot or a label, [characters]."""

WIDTH = 100
"""Columns of plain text."""

EXPANDED = (
    "±: expanded uncertainty (k = 2; Student's factor for 95 % if noise or tolerance scale were "
    "estimated from few readings), including all errors that were not identified."
)
"""Meaning of ± in tables of values."""

NOISE_SOURCES = {
    "cycles": "from repeated cycles",
    "residuals": "from the residuals",
    "gauge": "as stated for the gauge, with rounding to its resolution",
    "unknown": "unknown",
}
"""Source of the noise of a reading, in words."""

BULLET = "• "
"""Start of an item of a list."""

SHORTEST_WORD = 12
"""Columns that a column of words keeps in a narrow console, where longer words are cut."""

GAP = 3
"""Columns between those of a table."""

TIGHT_GAP = 1
"""Columns between those of a table that is too wide with GAP."""


class NumberTable(Table):
    """A table whose numbers are never cut: where it is too wide each row becomes a paragraph.

    Words are not cut either, unless a table with narrower columns of words still fits.
    """

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render the table, or each row as a paragraph (rich's protocol)."""
        for longest in (LONGEST_NAME, SHORTEST_WORD):
            for gap, padding in ((GAP, (0, 1)), (TIGHT_GAP, (0, 0))):
                widths = self._fit(options.max_width - gap * (len(self.columns) - 1), longest)
                if widths is not None:
                    self.padding = padding
                    for column, width in zip(self.columns, widths, strict=True):
                        column.width = width
                    yield from super().__rich_console__(console, options)
                    return
        lead = max(1, next((i for i, c in enumerate(self.columns) if c.no_wrap), 1))
        cells = [[_plain(cell) for cell in column.cells] for column in self.columns]
        headers = [_plain(column.header) for column in self.columns]
        for row in zip(*cells, strict=True):
            yield Text(" ".join(text.strip() for text in row[:lead] if text), style="bold")
            for header, text in zip(headers[lead:], row[lead:], strict=True):
                if text:
                    words = f"{header}: {text}" if header else text
                    yield indented(Text(words))

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        """Measure the table; it may be as narrow as its paragraphs (rich's protocol)."""
        return super().__rich_measure__(console, options).with_maximum(options.max_width)

    def _fit(self, available: int, longest: int) -> list[int] | None:
        """Widths of the columns, of which those with words are narrowed, the widest first.

        Args:
            available: Columns of the console without gaps.
            longest: Columns of the longest word that is not cut.

        Returns:
            The widths; None if a number or such a word would be cut.
        """
        widths, least = [], []
        for column in self.columns:
            texts = [_plain(column.header), *(_plain(cell) for cell in column.cells)]
            widths.append(max(map(cell_len, texts)))
            words = (cell_len(word) for text in texts for word in text.split())
            least.append(widths[-1] if column.no_wrap else min(max(words, default=0), longest))
        if sum(least) > available:
            return None
        for _ in range(sum(widths) - available):
            wide = [i for i, width in enumerate(widths) if width > least[i]]
            widths[max(wide, key=widths.__getitem__)] -= 1
        return widths


def to_text(content: RenderableType, *, width: int = WIDTH) -> str:
    """Rich renderables as plain text.

    Args:
        content: The renderables.
        width: Columns.
    """
    stream = io.StringIO()
    console = Console(file=stream, width=width, no_color=True, highlight=False)
    console.print(Segments(console.render(content)), soft_wrap=True)
    lines = printable(stream.getvalue(), keep="\n").split("\n")
    return "\n".join(line.rstrip() for line in lines[:-1]) + "\n"


def print_rich(content: RenderableType) -> None:
    """Print rich renderables: in colour on a terminal, else as plain text."""
    if sys.stdout.isatty():
        console = Console(highlight=False)
        segments = console.render(content)
        shown = (Segment(printable(s.text, keep="\n"), s.style, s.control) for s in segments)
        console.print(Segments(shown), end="", soft_wrap=True)
    else:
        sys.stdout.write(to_text(content))
    sys.stdout.flush()


def to_markup(content: RenderableType) -> str:
    """Rich tables, texts and groups of them as HTML.

    Raises:
        TypeError: For another kind of renderable.
    """
    pieces = []
    for is_item, run in groupby(_flatten(content), key=_is_item):
        if is_item:
            pieces.append(items(str(part).removeprefix(BULLET) for part in run))
        else:
            pieces += [paragraph(p) if isinstance(p, str) else _from_rich(p) for p in run if p]
    return "\n".join(pieces)


def _flatten(content: RenderableType) -> list[str | Table]:
    if isinstance(content, Group):
        return [part for inner in content.renderables for part in _flatten(inner)]
    if isinstance(content, Padding):
        return _flatten(content.renderable)
    if isinstance(content, Text):  # a command is not wrapped
        return [f"`{content.plain.strip()}`" if content.no_wrap else content.plain]
    if isinstance(content, Table):
        return [content]
    raise TypeError(f"no HTML for a {type(content).__name__}")


def _is_item(part: str | Table) -> bool:
    return isinstance(part, str) and part.startswith(BULLET)


def _from_rich(content: Table) -> str:
    headers = [_plain(column.header) for column in content.columns]
    columns = [[_plain(cell) for cell in column.cells] for column in content.columns]
    justified = [column.justify == "left" for column in content.columns]
    left = justified.index(False) if False in justified else len(justified)
    return table(headers, zip(*columns, strict=True), left=left)


def indented(part: RenderableType) -> RenderableType:
    """A part that begins two columns later."""
    return Padding(part, (0, 0, 0, 2))


def section(title: str, body: RenderableType) -> RenderableType:
    """A titled, indented part."""
    return Group(Text(), Text(title, style="bold cyan"), indented(body))


def bullets(sentences: list[str]) -> RenderableType:
    """Sentences, each with a bullet."""
    return Group(*(Text(f"{BULLET}{s}") for s in sentences))


def noted(body: RenderableType, *notes: str) -> RenderableType:
    """A table with notes below it; empty notes are left out."""
    return Group(body, *(Text(note) for note in notes if note))


def table_of(headers: Sequence[str], rows: Iterable[Sequence[str]], *, left: int = 1) -> Table:
    """A table with a rule under its header; columns after the first `left` are numbers.

    Cells are plain text: names come from files, and are not markup.
    """
    table = NumberTable(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for i, header in enumerate(headers):
        word = i < left or header == "unit"
        table.add_column(
            Text(header), justify="left" if word else "right", overflow="fold", no_wrap=i >= left
        )
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    return table


def table_of_records(rows: Sequence[Mapping[str, str]]) -> Table:
    """A table of rows with the same keys, which are its headers; empty without rows."""
    return table_of(list(rows[0]) if rows else (), [list(row.values()) for row in rows])


def _plain(cell: RenderableType) -> str:
    return cell.plain if isinstance(cell, Text) else str(cell)


def typeset(value: float, decimals: int = 3) -> str:
    """A number with its sign for a page or a picture: with a true minus, and zero without a sign.

    Args:
        value: The number.
        decimals: Number of decimals.
    """
    return true_minus(format_fixed(value, decimals, sign=round(value, decimals) != 0.0))


def true_minus(text: str) -> str:
    """A number with a true minus."""
    return text.replace("-", "−")


def choose_worst(
    rows: Sequence[Row], key: Callable[[Row], float], *, all_rows: bool
) -> tuple[Sequence[Row], str]:
    """The worst of many rows by a key, or all, with a note about omitted ones."""
    if all_rows or len(rows) <= MANY_ROWS:
        return rows, ""
    worst = sorted(rows, key=key, reverse=True)[:WORST_ROWS]
    return worst, f"The {WORST_ROWS} largest of {len(rows)}; --all lists every reading."


def residual_table(
    residuals: Sequence[ResidualRow],
    columns: Mapping[str, Callable[[ResidualRow], str]],
    *notes: str,
    all_rows: bool,
    key: Callable[[ResidualRow], float] = lambda r: abs(r.residual),
) -> RenderableType:
    """A table of readings, the worst of many or all, with notes.

    Args:
        residuals: The readings.
        columns: Headers of the columns with numbers, and their cells.
        notes: Notes below the table.
        all_rows: Whether to list all.
        key: Size by which the worst are chosen.
    """
    rows, note = choose_worst(residuals, key, all_rows=all_rows)
    places: dict[str, Callable[[ResidualRow], str]] = {
        "setup": lambda r: r.setup,
        "posture": lambda r: r.postures,
    }
    if any(r.cycle != 1 for r in residuals):
        places["cycle"] = lambda r: str(r.cycle)
    shown = places | dict(columns)
    cells = [[cell(r) for cell in shown.values()] for r in rows]
    return noted(table_of(list(shown), cells, left=2), *notes, note)


def short_name(text: str, longest: int = LONGEST_NAME, *, head: int | None = None) -> str:
    """A name from a file as it can be shown: printable, and not too long.

    Args:
        text: The name.
        longest: Largest number of characters.
        head: Number of characters before the gap of a longer name; half of them by default.
    """
    shown = printable(text)
    head = longest // 2 if head is None else head
    return shown if len(shown) <= longest else f"{shown[:head]}…{shown[head + 1 - longest :]}"


def short_names(texts: Sequence[str], longest: int = LONGEST_NAME) -> list[str]:
    """Names of one list, cut where most of them remain distinct."""
    heads = sorted(range(1, longest - 1), key=lambda head: abs(head - longest // 2))
    cut = ([short_name(text, longest, head=head) for text in texts] for head in heads)
    return max(cut, key=lambda names: len(set(names)))


def list_places(places: Iterable[tuple[str, str]]) -> str:
    """Places of sensors, such as "legs x, y, z" or "leg x and the tool"."""
    named: dict[str, list[str]] = {}
    for kind, name in sorted(set(places)):
        named.setdefault(kind, []).append(name)
    words = [
        f"{kind}{'' if len(names) == 1 else 's'} {', '.join(names)}"
        if any(names)
        else f"the {kind}"
        for kind, names in named.items()
    ]
    return " and ".join(words)
