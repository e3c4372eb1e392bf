"""A table of a file of any kind: its heading, its rows, and what was understood."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from orthocal.errors import SessionError
from orthocal.io.tables.cell import BLANK, Cell, Row, column_letters
from orthocal.io.tables.decoding import decode
from orthocal.io.tables.separated import LOOKED_AT, FindHeader, find_separator, split
from orthocal.io.tables.workbook import BEGINNING, CellRange, read_workbook
from orthocal.text import shorten


@dataclass(frozen=True, slots=True)
class Table:
    """A table with headings."""

    path: Path
    sheet: str | None
    """Name of the sheet, of a workbook."""
    encoding: str | None
    """None of a workbook, as the following."""
    encoding_reason: str
    separator: str | None
    """Name of the separator."""
    separator_reason: str
    header: tuple[str, ...]
    """Headings without blank ones at the end."""
    header_line: int
    header_written: int
    """Cells of the heading with blank ones at the end."""
    above: tuple[int, ...]
    """Lines above the heading that are not blank."""
    rows: tuple[Row, ...]
    """Those below the heading that hold something."""
    merged: tuple[CellRange, ...] = ()
    formulas: int = 0
    hidden: int = 0

    def place(self, line: int, column: int | None = None) -> str:
        """File and line of a row, or sheet and cell, for messages."""
        if self.sheet is None:
            return f"{self.path}:{line}"
        at = f"row {line}" if column is None else f"{column_letters(column)}{line}"
        return f"{self.path}: sheet '{self.sheet}' {at}"

    def spans(self, columns: Iterable[int]) -> dict[int, list[tuple[int, int]]]:
        """First and last rows of cells that are merged downwards in some columns, by column."""
        found: dict[int, list[tuple[int, int]]] = {}
        wanted = set(columns)
        for top, left, bottom, right in sorted(self.merged):
            if top < bottom and left == right and left in wanted:
                found.setdefault(left, []).append((top, bottom))
        return found

    def filled(self, columns: Iterable[int]) -> Iterator[Row]:
        """Rows in which merged cells of some columns hold, each, what stands in their first."""
        pending = {column: iter(spans) for column, spans in self.spans(columns).items()}
        following = {column: next(spans) for column, spans in pending.items()}
        current: dict[int, tuple[int, Cell]] = {}
        for row in self.rows:
            cells = list(row.cells)
            for column in pending:
                while column in following and following[column][0] <= row.line:
                    top, bottom = following[column]
                    current[column] = (bottom, row.cell(column) if top == row.line else BLANK)
                    after = next(pending[column], None)
                    if after is None:
                        del following[column]
                    else:
                        following[column] = after
                last, cell = current.get(column, (0, BLANK))
                if row.line <= last:
                    cells += [BLANK] * (column + 1 - len(cells))
                    cells[column] = cell
            yield Row(row.line, tuple(cells), row.written)


def read_table(
    path: Path,
    content: bytes,
    find_header: FindHeader,
    *,
    expected: str,
    sheet: str | None = None,
    separator: str | None = None,
    encoding: str | None = None,
) -> Table:
    """The table of a file that has the headings that are looked for.

    Args:
        path: The file, for messages.
        content: What it holds.
        find_header: Tells which of some rows holds the headings, if any.
        expected: The headings in words, for messages.
        sheet: Sheet of a workbook; else the only one that has them.
        separator: Name of the separator, where it is said.
        encoding: Name of the encoding, where it is said.

    Raises:
        SessionError: If there is no such table, or if there are several.
    """
    if content.startswith(BEGINNING):
        for flag, given in (("--separator", separator), ("--encoding", encoding)):
            if given is not None:
                raise SessionError(f"is of no use: {path} is an .xlsx", where=flag)
        return _read_sheet(path, content, find_header, expected, sheet)
    if sheet is not None:
        raise SessionError(f"is of no use: {path} is no .xlsx", where="--sheet")
    decoded = decode(content, where=str(path), encoding=encoding)
    if not decoded.text.strip():
        raise SessionError(f"is empty; expected {expected}", where=str(path))
    name, reason = find_separator(decoded.text, find_header, where=str(path), asked=separator)
    rows = list(split(decoded.text, name, where=str(path)))
    at = find_header(rows[:LOOKED_AT])
    if at is None:
        raise _no_header(f"{path}", rows, expected, f", with {name} as separator")
    return Table(
        path=path,
        sheet=None,
        encoding=decoded.encoding,
        encoding_reason=decoded.reason,
        separator=name,
        separator_reason=reason,
        header=tuple(c.text for c in rows[at].cells),
        header_line=rows[at].line,
        header_written=rows[at].written,
        above=tuple(r.line for r in rows[:at]),
        rows=tuple(rows[at + 1 :]),
    )


def _read_sheet(
    path: Path, content: bytes, find_header: FindHeader, expected: str, sheet: str | None
) -> Table:
    sheets = read_workbook(content, where=str(path), sheet=sheet)
    fitting = [(s, at) for s in sheets if (at := find_header(s.rows[:LOOKED_AT])) is not None]
    if not fitting:
        if len(sheets) == 1:
            place = f"{path}: sheet '{sheets[0].name}'"
            raise _no_header(place, list(sheets[0].rows), expected, "")
        names = ", ".join(f"'{s.name}'" for s in sheets)
        raise SessionError(f"no sheet has {expected}; sheets: {names}", where=str(path))
    if len(fitting) > 1:
        names = ", ".join(f"'{s.name}'" for s, _ in fitting)
        raise SessionError(
            f"several sheets have readings: {names}; say which: --sheet NAME", where=str(path)
        )
    found, at = fitting[0]
    head = found.rows[at]
    return Table(
        path=path,
        sheet=found.name,
        encoding=None,
        encoding_reason="",
        separator=None,
        separator_reason="",
        header=tuple(c.text for c in head.cells),
        header_line=head.line,
        header_written=head.written,
        above=tuple(r.line for r in found.rows[:at]),
        rows=found.rows[at + 1 :],
        merged=found.merged,
        formulas=found.formulas,
        hidden=found.hidden,
    )


def _no_header(place: str, rows: list[Row], expected: str, how: str) -> SessionError:
    if not rows:
        return SessionError(f"is empty; expected {expected}", where=place)
    most = max(rows[:LOOKED_AT], key=lambda r: len(r.cells))
    shown = shorten(", ".join(f"'{' '.join(c.text.split())}'" for c in most.cells))
    return SessionError(
        f"no row has {expected}; row {most.line} has {shown}{how}. --column ROLE=HEADING says "
        "which column is which",
        where=place,
    )
