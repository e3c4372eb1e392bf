"""Cells and rows of a table, from text files or workbooks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Literal

ZIP_SIGNATURE = b"PK\x03\x04"
"""First bytes of a workbook."""

MOST_ROWS = 200_000
"""Maximum number of rows of a table; a session has at most 50,000 readings."""

MOST_CELLS = 600_000
"""Maximum number of cells of a table, without blank cells at the end of a row."""

MOST_COLUMNS = 500
"""Maximum number of columns of a table."""

MergedCells = tuple[int, int, int]
"""Column from 0, first row and last row from 1 of cells of one column that are merged."""

CellKind = Literal["text", "number", "date", "boolean", "unsaved formula", "scaled number"]
"""Kind of a cell.

An `unsaved formula` has no saved value. A `scaled number` is shown as a percentage or in thousands.
"""


@dataclass(frozen=True, slots=True)
class Cell:
    """Content of one cell."""

    text: str
    """Text as written; plain decimals for a number of a workbook."""
    number: Decimal | None = None
    """Value of a workbook's number, which has no decimal sign."""
    kind: CellKind = "text"
    unit: str = ""
    """Unit that the number format of a workbook appends."""

    @property
    def is_blank(self) -> bool:
        """True for a cell without content."""
        return self.kind == "text" and not self.text.strip()


BLANK = Cell("")


@dataclass(frozen=True, slots=True)
class Row:
    """Row with at least one cell that is not blank."""

    line: int
    """Number of the row, from 1, as in an editor or a spreadsheet program."""
    cells: tuple[Cell, ...]
    """Cells without blank cells at the end."""
    width: int
    """Number of cells, including blank ones at the end."""

    def cell(self, index: int | None) -> Cell:
        """Cell of a column; blank beyond the end of the row or without an index."""
        return self.cells[index] if index is not None and index < len(self.cells) else BLANK


def make_row(line: int, cells: Sequence[Cell]) -> Row | None:
    """Row without blank cells at its end; None for a blank row."""
    end = len(cells)
    while end and cells[end - 1].is_blank:
        end -= 1
    return Row(line, tuple(cells[:end]), len(cells)) if end else None


def column_letters(index: int) -> str:
    """Name of a column in spreadsheet notation: A, B, ... Z, AA."""
    letters = ""
    index += 1
    while index:
        index, digit = divmod(index - 1, 26)
        letters = chr(ord("A") + digit) + letters
    return letters
