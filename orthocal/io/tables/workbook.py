"""Sheets of an .xlsx to rows, within bounds: a workbook is an archive of XML from a stranger."""

from __future__ import annotations

import datetime
import io
import itertools
import math
import re
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from orthocal.errors import SessionError
from orthocal.io.tables.cell import BLANK, MOST_CELLS, MOST_COLUMNS, MOST_ROWS, Cell, Row, make_row
from orthocal.text import shorten, text_problem

BEGINNING = b"PK\x03\x04"
"""What a workbook begins with: it is a ZIP archive."""

LARGEST_CONTENT = 32 * 2**20
"""All of a workbook unpacked, [bytes]; 50,000 rows of ten cells take 22 MiB."""

LARGEST_PART = 4 * 2**20
"""The same of styles and whatever else is not cells or their texts."""

MOST_PARTS = 2_000
MOST_SHEETS = 50

LARGEST_SHEETS = 4 * LARGEST_CONTENT
"""Sheets times the size of the largest part, [bytes]: several may name the same part."""

_MERGED = re.compile(
    rb'<(?:\w+:)?mergeCell\s[^>]*?ref="([A-Z]{1,3})([0-9]{1,7}):([A-Z]{1,3})([0-9]{1,7})"'
)
_HIDDEN = re.compile(rb'<(?:\w+:)?row\s[^>]*?hidden="(?:1|true)"')
_FORMULA = re.compile(rb"<(?:\w+:)?f[\s/>]")
_SHEET = re.compile(rb"<(?:\w+:)?sheet\s")
_DOCTYPE = re.compile(rb"<!(?:DOCTYPE|ENTITY)")
_XML_BEGINS = (b"<", b"\xef\xbb\xbf<")

_QUOTED = re.compile(r'"([^"]*)"|\\(.)|\[[^\]]*\]|_.|\*.')
"""What a format of numbers writes or steers literally."""
_SCALED = re.compile(r"[0#?],+(?![0#?,])")

CellRange = tuple[int, int, int, int]
"""First row, first column, last row, last column of merged cells, rows from 1, columns from 0."""


@dataclass(frozen=True, slots=True)
class Sheet:
    """A sheet of a workbook."""

    name: str
    rows: tuple[Row, ...]
    """Those that hold something."""
    merged: tuple[CellRange, ...]
    formulas: int
    """Cells whose value was computed by the spreadsheet program."""
    hidden: int
    """Rows that the program does not show."""


def read_workbook(content: bytes, *, where: str, sheet: str | None = None) -> list[Sheet]:
    """The sheets of a workbook that are shown; or one that is named, shown or not.

    Args:
        content: The file.
        where: Its path, for messages.
        sheet: Name of a sheet.

    Raises:
        SessionError: If it is no workbook, too large, or has no such sheet.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            _check_parts(archive, where)
            with _opened(content, saved=True) as book:
                chosen = _choose(book, sheet, where)
                return [_read_sheet(s, archive, content, where) for s in chosen]
    except (SessionError, MemoryError):
        raise
    except Exception as e:  # a stranger's archive: openpyxl fails in as many ways as there are
        words = " ".join(str(e).split())
        raise SessionError(
            f"is not an .xlsx that can be read: {shorten(words or type(e).__name__)}", where=where
        ) from None


def _check_parts(archive: zipfile.ZipFile, where: str) -> None:
    """Refuse an archive that is no workbook, is too large unpacked, or defines entities."""
    parts = archive.infolist()
    names = {p.filename for p in parts}
    if "mimetype" in names and "content.xml" in names:
        raise SessionError("is an OpenDocument table; save it as .xlsx or CSV", where=where)
    if "xl/workbook.bin" in names:
        raise SessionError("is an .xlsb; save it as .xlsx or CSV", where=where)
    if "[Content_Types].xml" not in names:
        raise SessionError("is an archive, but no .xlsx", where=where)
    if len(parts) > MOST_PARTS or len(names) != len(parts):
        raise SessionError(
            f"holds {len(parts)} parts of {len(names)} names; expected at most {MOST_PARTS}, each "
            "once",
            where=where,
        )
    total = sum(p.file_size for p in parts)
    if total > LARGEST_CONTENT:
        raise SessionError(
            f"has {total / 2**20:.0f} MiB unpacked; expected at most {LARGEST_CONTENT / 2**20:g} "
            "MiB",
            where=where,
        )
    largest = max((p.file_size for p in parts if p.filename.endswith(".xml")), default=0)
    for part in parts:
        if not part.filename.endswith((".xml", ".rels")):
            continue
        cells = part.filename.startswith("xl/worksheets/") or "haredStrings" in part.filename
        if part.file_size > LARGEST_PART and not cells:
            raise SessionError(
                f"has {part.file_size / 2**20:.0f} MiB in {shorten(part.filename)}; expected at "
                f"most {LARGEST_PART / 2**20:g} MiB",
                where=where,
            )
        try:
            text = archive.read(part)
        except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError):
            raise SessionError(
                f"is damaged, or protected by a password: {shorten(part.filename)} cannot be "
                "unpacked",
                where=where,
            ) from None
        if _DOCTYPE.search(text) or (text and not text.startswith(_XML_BEGINS)):
            raise SessionError(
                f"is not an .xlsx as spreadsheets write it: {shorten(part.filename)} is not plain "
                "XML",
                where=where,
            )
        count = 0 if cells else len(_SHEET.findall(text))
        if count > MOST_SHEETS or count * largest > LARGEST_SHEETS:
            raise SessionError(
                f"has {count} sheets of up to {largest / 2**20:.0f} MiB; expected at most "
                f"{MOST_SHEETS}, and {LARGEST_SHEETS / 2**20:g} MiB",
                where=where,
            )


@contextmanager
def _opened(content: bytes, *, saved: bool) -> Iterator[Any]:
    """A workbook of openpyxl that is read cell by cell.

    Args:
        content: The file.
        saved: Whether formulas have the values that were saved with them.
    """
    import openpyxl

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of charts, validations and styles, which are not read
        book = openpyxl.load_workbook(
            io.BytesIO(content), read_only=True, data_only=saved, keep_links=False
        )
        try:
            yield book
        finally:
            book.close()


def _choose(book: Any, name: str | None, where: str) -> list[Any]:  # noqa: ANN401 - openpyxl's
    """Sheets of cells that are shown, or the one that is named."""
    sheets = list(book.worksheets)
    if not sheets:
        raise SessionError("is an .xlsx without sheets of cells", where=where)
    if name is None:
        return [s for s in sheets if s.sheet_state == "visible"] or sheets
    found = [s for s in sheets if s.title == name] or [
        s for s in sheets if s.title.strip().casefold() == name.strip().casefold()
    ]
    if not found:
        names = ", ".join(f"'{s.title}'" for s in sheets) or "none"
        raise SessionError(f"has no sheet '{shorten(name)}'; sheets: {names}", where=where)
    return found[:1]


def _read_sheet(sheet: Any, archive: zipfile.ZipFile, content: bytes, where: str) -> Sheet:  # noqa: ANN401 - openpyxl's
    source = archive.read(sheet._worksheet_path.lstrip("/"))
    formulas = _find_formulas(content, sheet.title) if _FORMULA.search(source) else frozenset()
    place = f"{where}: sheet '{sheet.title}'"
    rows = []
    count = 0
    for line, given in _rows(sheet, place):
        cells = [
            _read_cell(cell, (line, column) in formulas, f"{place} row {line}")
            for column, cell in enumerate(given)
        ]
        row = make_row(line, cells)
        if row is None:
            continue
        count += len(row.cells)
        if count > MOST_CELLS:
            raise SessionError(f"has more than {MOST_CELLS} cells", where=place)
        rows.append(row)
    return Sheet(
        sheet.title,
        tuple(rows),
        tuple(_merged(source)),
        len(formulas),
        len(_HIDDEN.findall(source)),
    )


def _rows(sheet: Any, place: str) -> Iterator[tuple[int, tuple[Any, ...]]]:  # noqa: ANN401 - openpyxl's
    """Rows with their numbers, whatever size the sheet says that it has."""
    sheet.reset_dimensions()
    for line, row in enumerate(sheet.iter_rows(), start=1):
        if line > MOST_ROWS:
            raise SessionError(f"has more than {MOST_ROWS} rows", where=place)
        if len(row) > MOST_COLUMNS and any(c.value is not None for c in row[MOST_COLUMNS:]):
            raise SessionError(
                f"has {len(row)} columns; expected at most {MOST_COLUMNS}",
                where=f"{place} row {line}",
            )
        yield line, row[:MOST_COLUMNS]


def _find_formulas(content: bytes, title: str) -> frozenset[tuple[int, int]]:
    """Where there are formulas: row from 1, column from 0."""
    with _opened(content, saved=False) as book:
        return frozenset(
            (line, column)
            for line, row in _rows(book[title], title)
            for column, cell in enumerate(row)
            if cell.data_type == "f"
        )


def _read_cell(cell: Any, formula: bool, place: str) -> Cell:  # noqa: ANN401 - openpyxl's
    value = cell.value
    if value is None:
        return Cell("", kind="unsaved") if formula else BLANK
    if isinstance(value, bool):
        return Cell(str(value).upper(), kind="truth")
    if isinstance(value, datetime.date | datetime.time | datetime.timedelta):
        return Cell(str(value), kind="date")
    if isinstance(value, int | float):
        return _read_number(value, str(cell.number_format or ""))
    text = str(value)
    problem = text_problem(text.replace("\r", "\n"))
    if problem:
        raise SessionError(problem, where=place)
    return Cell(text)


def _read_number(value: float, form: str) -> Cell:
    """A number as the spreadsheet shows it at full length: to 15 digits."""
    if not math.isfinite(value) or abs(value) > 1e15:
        return Cell(str(value))
    number = Decimal(value) if isinstance(value, int) else Decimal(f"{value:.15g}")
    text = f"{number:f}" if number.adjusted() > -20 else str(number)
    if "." in text:
        text = text.rstrip("0").rstrip(".")
    shown = form.split(";")[0]
    bare = _QUOTED.sub("", shown)
    if "%" in bare or _SCALED.search(bare):
        return Cell(text, number, kind="shown otherwise")
    unit = "".join(a + b for a, b in _QUOTED.findall(shown)).strip()
    return Cell(text, number, "number", unit)


def _merged(source: bytes) -> Iterator[CellRange]:
    for found in itertools.islice(_MERGED.finditer(source), MOST_ROWS):
        left, top, right, bottom = (g.decode() for g in found.groups())
        yield int(top), _column_index(left), int(bottom), _column_index(right)


def _column_index(letters: str) -> int:
    index = 0
    for letter in letters:
        index = 26 * index + ord(letter) - ord("A") + 1
    return index - 1
