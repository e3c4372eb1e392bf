"""Table with headings, from a delimited text file or a workbook."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orthocal.errors import SessionError
from orthocal.io.tables.cell import BLANK, ZIP_SIGNATURE, MergedCells, Row, column_letters
from orthocal.io.tables.delimited import HEADER_ROWS, FindHeader, decode, find_separator, split_rows
from orthocal.text import shorten


@dataclass(frozen=True, slots=True)
class Table:
    """Table with headings."""

    path: Path
    header: tuple[str, ...]
    """Headings without blank ones at the end."""
    header_line: int
    """Line of the row of headings."""
    header_width: int
    """Number of cells of the row of headings, including blank ones at the end."""
    above: tuple[int, ...]
    """Lines above the row of headings that are not blank."""
    rows: tuple[Row, ...]
    """Rows below the row of headings that are not blank."""
    encoding: str | None = None
    """Encoding of a text file."""
    encoding_reason: str | None = None
    separator: str | None = None
    """Name of the separator of a text file."""
    separator_reason: str | None = None
    sheet: str | None = None
    """Name of the worksheet of a workbook."""
    merged: tuple[MergedCells, ...] = ()
    """Cells that are merged downwards."""
    formulas: int = 0
    """Number of cells with a formula."""
    hidden: int = 0
    """Number of hidden rows."""

    def place(self, line: int, column: int | None = None) -> str:
        """File and line of a row, or worksheet and cell, for messages."""
        if self.sheet is None:
            return f"{self.path}:{line}"
        cell = f"row {line}" if column is None else f"{column_letters(column)}{line}"
        return f"{self.path}: sheet '{self.sheet}' {cell}"

    def fill_merged(self, columns: Iterable[int]) -> Iterator[Row]:
        """Rows in which the content of merged cells of some columns is repeated."""
        row_by_line = {row.line: row for row in self.rows}
        merged_by_column = {c: [m for m in self.merged if m[0] == c] for c in columns}
        for row in self.rows:
            cells = list(row.cells)
            for column, merged in merged_by_column.items():
                index = bisect_right(merged, row.line, key=lambda m: m[1]) - 1
                if index < 0 or merged[index][2] < row.line:
                    continue
                first_row = row_by_line.get(merged[index][1])
                cells += [BLANK] * (column + 1 - len(cells))
                cells[column] = BLANK if first_row is None else first_row.cell(column)
            yield Row(row.line, tuple(cells), row.width)


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
    """Read the table with the expected headings from a file.

    Args:
        path: Path of the file, for messages.
        content: Content of the file.
        find_header: Function that finds the expected headings.
        expected: Description of the headings, for messages.
        sheet: Worksheet of a workbook; by default the only one with these headings.
        separator: Name of the separator; detected by default.
        encoding: Name of the encoding; detected by default.

    Raises:
        SessionError: If the file has no such table, or several tables.
    """
    if content.startswith(ZIP_SIGNATURE):
        for option, value in (("--separator", separator), ("--encoding", encoding)):
            if value is not None:
                raise SessionError(f"does not apply to the workbook {path}", where=option)
        return _read_sheet(path, content, find_header, expected, sheet)
    if sheet is not None:
        raise SessionError(f"applies to .xlsx workbooks only; {path} is not one", where="--sheet")
    decoded = decode(content, where=str(path), encoding=encoding)
    if not decoded.text.strip():
        raise SessionError(f"is empty; expected {expected}", where=str(path))
    name, reason = find_separator(decoded.text, find_header, where=str(path), requested=separator)
    rows = tuple(split_rows(decoded.text, name, where=str(path)))
    header_index = find_header(rows[:HEADER_ROWS])
    if header_index is None:
        raise _no_header(str(path), rows, expected, f" with {name} as separator")
    return _make_table(
        path,
        rows,
        header_index,
        encoding=decoded.encoding,
        encoding_reason=decoded.reason,
        separator=name,
        separator_reason=reason,
    )


def _read_sheet(
    path: Path, content: bytes, find_header: FindHeader, expected: str, sheet: str | None
) -> Table:
    """Table with the expected headings from a workbook."""
    from orthocal.io.tables.workbook import read_workbook

    sheets = read_workbook(content, where=str(path), sheet=sheet)
    matching = [(s, i) for s in sheets if (i := find_header(s.rows[:HEADER_ROWS])) is not None]
    names = ", ".join(f"'{s.name}'" for s in [s for s, _ in matching] or sheets)
    if not matching and len(sheets) == 1:
        raise _no_header(f"{path}: sheet {names}", sheets[0].rows, expected, "")
    if not matching:
        raise SessionError(f"no sheet has {expected}; sheets: {names}", where=str(path))
    if len(matching) > 1:
        raise SessionError(
            f"several sheets have {expected}: {names}; choose one by --sheet NAME", where=str(path)
        )
    chosen, header_index = matching[0]
    return _make_table(
        path,
        chosen.rows,
        header_index,
        sheet=chosen.name,
        merged=chosen.merged,
        formulas=chosen.formulas,
        hidden=chosen.hidden,
    )


def _make_table(path: Path, rows: tuple[Row, ...], header_index: int, **origin: Any) -> Table:  # noqa: ANN401 - fields of a table
    """Table of rows, one of which contains the headings."""
    header = rows[header_index]
    return Table(
        path=path,
        header=tuple(c.text for c in header.cells),
        header_line=header.line,
        header_width=header.width,
        above=tuple(r.line for r in rows[:header_index]),
        rows=rows[header_index + 1 :],
        **origin,
    )


def _no_header(where: str, rows: tuple[Row, ...], expected: str, remark: str) -> SessionError:
    """Error for a table without the expected headings; it shows the widest row."""
    if not rows:
        return SessionError(f"is empty; expected {expected}", where=where)
    widest = max(rows[:HEADER_ROWS], key=lambda r: len(r.cells))
    shown = shorten(", ".join(f"'{' '.join(c.text.split())}'" for c in widest.cells))
    return SessionError(
        f"no row has {expected}; row {widest.line} has {shown}{remark}; assign columns by --column "
        "ROLE=HEADING",
        where=where,
    )
