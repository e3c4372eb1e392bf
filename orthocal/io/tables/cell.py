"""Cells and rows: what a table is made of, whatever file it came from."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from typing import Literal

MOST_ROWS = 200_000
"""Rows of a table, for its memory; a session has 50,000 readings at most."""

MOST_CELLS = 600_000
"""Cells of a table that are not blank rows: twelve for each reading that a session may have."""

MOST_COLUMNS = 500
"""Columns of a table; a hundred cycles side by side are more than anybody reads."""


@dataclass(frozen=True, slots=True)
class Cell:
    """What stands in a cell."""

    text: str
    """As written; of a number from a workbook in plain decimals."""
    number: Decimal | None = None
    """Of a workbook's number: there is no decimal sign to tell."""
    kind: Literal["text", "number", "date", "truth", "unsaved", "shown otherwise"] = "text"
    """`unsaved` is a formula whose value was not saved, `shown otherwise` a number that is shown as
    a percentage or in thousands."""
    unit: str = ""
    """What the format of a workbook's number writes behind it."""

    @property
    def is_blank(self) -> bool:
        """Whether nothing stands there."""
        return self.kind == "text" and not self.text.strip()


@dataclass(frozen=True, slots=True)
class Row:
    """A row that holds something."""

    line: int
    """Counted from 1, as an editor or a spreadsheet does."""
    cells: tuple[Cell, ...]
    """Without blank ones at the end."""
    written: int
    """Cells with the blank ones at the end."""

    def cell(self, index: int | None) -> Cell:
        """A cell; a blank one beyond the end."""
        return self.cells[index] if index is not None and index < len(self.cells) else BLANK


BLANK = Cell("")


def make_row(line: int, cells: list[Cell]) -> Row | None:
    """A row without blank cells at its end; None if it has no others."""
    end = len(cells)
    while end and cells[end - 1].is_blank:
        end -= 1
    return Row(line, tuple(cells[:end]), len(cells)) if end else None


def column_letters(index: int) -> str:
    """Name of a column as spreadsheets count: A, B, ... Z, AA."""
    letters = ""
    index += 1
    while index:
        index, rest = divmod(index - 1, 26)
        letters = chr(ord("A") + rest) + letters
    return letters
