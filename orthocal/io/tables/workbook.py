"""Worksheets of an .xlsx workbook.

A workbook is a ZIP archive of XML parts (ECMA-376, part 1) from an untrusted source. Only the parts
with cells, their texts and their formats are read. Every part is bounded before it is unpacked.
Cells are read one by one, without entities, in linear time.
"""

from __future__ import annotations

import datetime
import io
import math
import posixpath
import re
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any, TypeVar

from lxml import etree

from orthocal.errors import SessionError, errors_at
from orthocal.io.strict_yaml import LONGEST_NUMBER
from orthocal.io.tables.cell import (
    BLANK,
    MOST_CELLS,
    MOST_COLUMNS,
    MOST_ROWS,
    Cell,
    CellKind,
    MergedCells,
    Row,
    make_row,
)
from orthocal.io.tables.numerals import format_decimal
from orthocal.text import shorten, text_problem

LARGEST_CONTENT = 32 * 2**20
"""Maximum size of all unpacked parts, [bytes]; 50,000 rows of ten cells take 22 MiB."""

LARGEST_PART = 2 * 2**20
"""Maximum size of a part other than cells and their texts, unpacked, [bytes]."""

MOST_PARTS = 2_000
"""Maximum number of parts of a workbook."""

MOST_TAGS = 5 * MOST_CELLS
"""Maximum number of XML tags of a part: five for each cell. A cell has four, with a formula six."""

LONGEST_FORMAT = 255
"""Maximum length of a number format, as in Excel."""

MS_PER_DAY = 86_400_000

_Entry = TypeVar("_Entry")

_SAFE = {
    "resolve_entities": False,
    "load_dtd": False,
    "no_network": True,
    "huge_tree": False,
    "remove_comments": True,
    "remove_pis": True,
}
"""Options of the XML parsers."""

_DIRECTORY_ENTRY = b"PK\x01\x02"

_PERCENT_FORMATS = {9, 10}
_DATE_FORMATS = {*range(14, 23), *range(27, 37), *range(45, 48), *range(50, 59)}
"""Numbers of the built-in formats of percentages and dates (ECMA-376, part 1, 18.8.30)."""

_LITERAL = re.compile(r'"([^"]*)"|\\(.)|\[(?!(?:h+|m+|s+)\])[^\]]*\]|_.|\*.', re.I)
"""Parts of a number format that are literal text, colours or layout; not elapsed times as [h]."""
_PLACEHOLDER = re.compile(r"[0#?]|General", re.I)
"""Part of a number format that shows a digit or the number."""
_THOUSANDS = re.compile(r"[0#?],+(?![0#?,])")
_DATE_CODE = re.compile(r"[dmhys]", re.I)
_NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]{1,3})?")
_ADDRESS = re.compile(r"([A-Z]{1,3})([0-9]{1,10})")
_DOCTYPE = re.compile(rb"<!(?:DOCTYPE|ENTITY)")


@dataclass(frozen=True, slots=True)
class Sheet:
    """Worksheet of a workbook."""

    name: str
    rows: tuple[Row, ...]
    """Rows that are not blank."""
    merged: tuple[MergedCells, ...]
    """Cells that are merged downwards."""
    formulas: int
    """Number of cells with a formula."""
    hidden: int
    """Number of hidden rows that are not blank."""


@dataclass(frozen=True, slots=True)
class NumberFormat:
    """Interpretation of a number format."""

    kind: CellKind
    """`number`, `date` or `scaled number`."""
    unit: str = ""
    """Literal text behind the number."""


def read_workbook(content: bytes, *, where: str, sheet: str | None = None) -> list[Sheet]:
    """Read the visible sheets of a workbook, or one sheet by its name.

    Args:
        content: Content of the file.
        where: Path of the file, for messages.
        sheet: Name of a sheet, visible or hidden.

    Raises:
        SessionError: If the file is not a workbook, is too large, or has no such sheet.
    """
    parts = content.count(_DIRECTORY_ENTRY)
    if parts > MOST_PARTS:
        raise SessionError(f"has {parts} parts; expected at most {MOST_PARTS}", where=where)
    try:
        with errors_at(where), zipfile.ZipFile(io.BytesIO(content)) as archive:
            _require_workbook(archive.namelist())
            return _Workbook(archive, where).read(sheet)
    except (SessionError, MemoryError):
        raise
    except Exception as e:  # a damaged archive makes zipfile and lxml raise many kinds of errors
        words = " ".join(str(e).split())
        raise SessionError(
            f"is not a readable .xlsx workbook: {shorten(words or type(e).__name__)}", where=where
        ) from None


def _require_workbook(names: list[str]) -> None:
    """Refuse archives of other kinds."""
    if "mimetype" in names and "content.xml" in names:
        raise SessionError("is an OpenDocument table; save it as .xlsx or CSV")
    if "xl/workbook.bin" in names:
        raise SessionError("is an .xlsb workbook; save it as .xlsx or CSV")
    if "[Content_Types].xml" not in names:
        raise SessionError("is a ZIP archive, but not an .xlsx workbook")
    if len(set(names)) != len(names):
        raise SessionError("has several parts of the same name")


class _Workbook:
    """Parts of a workbook, unpacked within limits of their size."""

    def __init__(self, archive: zipfile.ZipFile, where: str) -> None:
        self._archive = archive
        self._where = where
        self._unpacked = 0
        main = dict(self._relations("").values()).get("officeDocument", "xl/workbook.xml")
        root, relations = self._tree(main), self._relations(main)
        self._sheets = [
            (e.get("name", ""), e.get("state", "visible") == "visible", target)
            for e in root.iter("{*}sheet")
            for key, value in e.attrib.items()
            if key.endswith("}id")
            for kind, target in [relations.get(value, ("", ""))]
            if kind == "worksheet"
        ]
        by_kind = dict(relations.values())
        self._formats: list[NumberFormat] = []
        if "styles" in by_kind:
            self._formats = _read_formats(self._tree(by_kind["styles"]))
        self._strings: list[str] = []
        if "sharedStrings" in by_kind:
            items = self._elements(by_kind["sharedStrings"], "si")
            self._strings = [_join_text(item) for item in items]
        old_epoch = any(e.get("date1904") in ("1", "true") for e in root.iter("{*}workbookPr"))
        self._epoch = datetime.datetime(*((1904, 1, 1) if old_epoch else (1899, 12, 30)))

    def read(self, name: str | None) -> list[Sheet]:
        """Read the visible sheets, all sheets if none is visible, or the sheet with a name.

        Raises:
            SessionError: If there is no such sheet, or none at all.
        """
        if not self._sheets:
            raise SessionError("is a workbook without worksheets")
        chosen = [s for s in self._sheets if s[1]] or self._sheets
        if name is not None:
            chosen = [s for s in self._sheets if s[0] == name] or [
                s for s in self._sheets if s[0].strip().casefold() == name.strip().casefold()
            ]
            if not chosen:
                names = ", ".join(f"'{title}'" for title, _, _ in self._sheets)
                raise SessionError(f"has no sheet '{shorten(name)}'; sheets: {names}")
            chosen = chosen[:1]
        return [self._read_sheet(title, part) for title, _, part in chosen]

    def _read_sheet(self, title: str, part: str) -> Sheet:
        """Read the rows and merged cells of a sheet."""
        where = f"{self._where}: sheet '{title}'"
        rows: list[Row] = []
        merged: list[MergedCells] = []
        cells: list[Cell] = []
        column, line, count, formulas, hidden = -1, 0, 0, 0, 0
        for element in self._elements(part, "c", "row", "mergeCell"):
            kind = _local_name(element)
            if kind == "c":
                address, previous = element.get("r"), column
                column = previous + 1 if address is None else _parse_address(address)[1]
                if column <= previous:
                    raise ValueError(f"cell {address} is out of order")
                children = {_local_name(child): child for child in reversed(element)}
                formulas += "f" in children
                cell = self._read_cell(element, children, where)
                if cell.is_blank:
                    continue
                if column >= MOST_COLUMNS:
                    raise SessionError(
                        f"has {column + 1} columns; expected at most {MOST_COLUMNS}", where=where
                    )
                cells += [BLANK] * (column - len(cells))
                cells.append(cell)
            elif kind == "row":
                number = _parse_index(element.get("r", str(line + 1)))
                if number <= line:
                    raise ValueError(f"row {number} follows row {line}")
                line, column = number, -1
                row = make_row(line, cells)
                cells = []
                if row is not None:
                    rows.append(row)
                    hidden += element.get("hidden") in ("1", "true")
                    count += len(row.cells)
                    if line > MOST_ROWS or count > MOST_CELLS:
                        limit = f"{MOST_ROWS} rows" if line > MOST_ROWS else f"{MOST_CELLS} cells"
                        raise SessionError(f"has more than {limit}", where=where)
            else:
                first, _, last = element.get("ref", "").partition(":")
                (top, column_a), (bottom, column_b) = map(_parse_address, (first, last or first))
                if top < bottom and column_a == column_b:
                    merged.append((column_a, top, bottom))
        return Sheet(title, tuple(rows), tuple(sorted(merged)), formulas, hidden)

    def _read_cell(self, element: Any, children: dict[str, Any], where: str) -> Cell:  # noqa: ANN401 - lxml has no types
        """Content of a cell, by its type and its style.

        Args:
            element: Element of the cell.
            children: First child element of each name, by name.
            where: File and worksheet, for messages.
        """
        if not children:
            return BLANK
        kind, place = element.get("t", "n"), f"{where} {element.get('r', '')}".rstrip()
        if kind not in ("n", "b", "d", "e", "s", "str", "inlineStr"):
            raise ValueError(f"'{shorten(kind)}' is not the type of a cell")
        text = _join_text(element) if kind == "inlineStr" else ""
        if kind != "inlineStr" and "v" in children:
            text = children["v"].text
        if not text:
            return Cell("", kind="unsaved formula") if "f" in children else BLANK
        if kind == "n":
            if not self._formats:
                return self._read_number(text, NumberFormat("number"))
            style = _parse_index(element.get("s", "0"))
            return self._read_number(text, _entry(self._formats, style, "style", place))
        if kind == "b":
            return Cell("TRUE" if text in ("1", "true") else "FALSE", kind="boolean")
        if kind == "d":
            return Cell(text, kind="date")
        if kind == "s":
            text = _entry(self._strings, _parse_index(text), "shared text", place)
        problem = text_problem(text.replace("\r", "\n"))
        if problem:
            raise SessionError(problem, where=where)
        return Cell(text)

    def _read_number(self, text: str, number_format: NumberFormat) -> Cell:
        """Number rounded to the 15 digits of a spreadsheet program, date or time of day.

        Numbers beyond the calendar are no dates. Text that is no plain number remains text.
        """
        value = math.nan
        if len(text) <= LONGEST_NUMBER and _NUMBER.fullmatch(text):
            value = float(text)
        if not abs(value) <= 1e15:
            return Cell(text)
        kind = number_format.kind
        if kind == "date":
            try:
                return Cell(self._describe_date(value), kind="date")
            except OverflowError:
                kind = "number"
        number = Decimal(f"{value:.15g}")
        return Cell(format_decimal(number), number, kind, number_format.unit)

    def _describe_date(self, days: float) -> str:
        """Date and time, to a millisecond, of days since the epoch; below one day only the time.

        Raises:
            OverflowError: If the date is beyond the calendar.
        """
        # the binary number of days is exact to microseconds only
        date = self._epoch + datetime.timedelta(milliseconds=round(days * MS_PER_DAY))
        return str(date.time() if 0.0 <= days < 1.0 else date)

    def _relations(self, part: str) -> dict[str, tuple[str, str]]:
        """Kinds and targets of the relations of a part, by identifier."""
        folder, name = posixpath.split(part)
        root = self._tree(posixpath.join(folder, "_rels", f"{name}.rels"))
        return {
            e.get("Id", ""): (
                posixpath.basename(e.get("Type", "")),
                posixpath.normpath(posixpath.join("/", folder, e.get("Target", "")))[1:],
            )
            for e in root.iter("{*}Relationship")
        }

    def _tree(self, part: str) -> Any:  # noqa: ANN401 - lxml has no types
        """Root element of a small part."""
        return etree.fromstring(self._unpack(part, LARGEST_PART), etree.XMLParser(**_SAFE))

    def _elements(self, part: str, *names: str) -> Iterator[Any]:
        """Elements of a part in the order of their ends; each is freed after its use."""
        stream = io.BytesIO(self._unpack(part, LARGEST_CONTENT))
        tags = tuple(f"{{*}}{name}" for name in names)
        for _, element in etree.iterparse(stream, tag=tags, **_SAFE):
            yield element
            element.clear()
            while element.getprevious() is not None:
                del element.getparent()[0]

    def _unpack(self, part: str, largest: int) -> bytes:
        """Content of a part.

        Raises:
            SessionError: If the part is missing, too large, damaged, or not plain XML.
        """
        try:
            info = self._archive.getinfo(part)
        except KeyError:
            raise SessionError(f"is damaged: {shorten(part)} is missing") from None
        self._unpacked += info.file_size
        for size, limit in ((info.file_size, largest), (self._unpacked, LARGEST_CONTENT)):
            if size > limit:
                raise SessionError(
                    f"has {size / 2**20:.1f} MiB unpacked up to {shorten(part)}; expected at most "
                    f"{limit / 2**20:g} MiB"
                )
        try:
            text = self._archive.read(info)
        except Exception:  # damaged archives raise zlib.error, BadZipFile, RuntimeError and more
            raise SessionError(
                f"is damaged or protected by a password: {shorten(part)} cannot be unpacked"
            ) from None
        if _DOCTYPE.search(text) or not text.removeprefix(b"\xef\xbb\xbf").startswith(b"<"):
            raise SessionError(f"is not a regular .xlsx workbook: {shorten(part)} is not plain XML")
        if text.count(b"<") > MOST_TAGS:
            raise SessionError(f"has more than {MOST_TAGS} XML tags in {shorten(part)}")
        return text


def _read_formats(styles: Any) -> list[NumberFormat]:  # noqa: ANN401 - lxml has no types
    """Number formats of the cell styles, in the order of the styles."""
    codes = {
        e.get("numFmtId"): e.get("formatCode", "") for e in styles.iterfind("{*}numFmts/{*}numFmt")
    }
    meanings = {key: parse_number_format(code) for key, code in codes.items()}
    built_in = {str(n): NumberFormat("scaled number") for n in _PERCENT_FORMATS}
    built_in |= {str(n): NumberFormat("date") for n in _DATE_FORMATS}
    meanings = built_in | meanings
    plain = NumberFormat("number")
    return [meanings.get(e.get("numFmtId"), plain) for e in styles.iterfind("{*}cellXfs/{*}xf")]


def parse_number_format(code: str) -> NumberFormat:
    """Interpret a number format such as `0.0" mm"`.

    Raises:
        ValueError: If the format is longer than spreadsheet programs permit.
    """
    if len(code) > LONGEST_FORMAT:
        raise ValueError(f"a number format has more than {LONGEST_FORMAT} characters")
    bare = _LITERAL.sub(lambda literal: "\0" * len(literal[0]), code).partition(";")[0]
    if "%" in bare or _THOUSANDS.search(bare):
        return NumberFormat("scaled number")
    if _DATE_CODE.search(bare):
        return NumberFormat("date")
    end = max((match.end() for match in _PLACEHOLDER.finditer(bare)), default=0)
    behind = _LITERAL.findall(code[end : len(bare)])
    return NumberFormat("number", "".join(quoted + escaped for quoted, escaped in behind).strip())


def _entry(table: Sequence[_Entry], index: int, noun: str, where: str) -> _Entry:
    """Entry of a table of the workbook, by its index in a cell.

    Raises:
        SessionError: If the table has no such entry.
    """
    if index >= len(table):
        raise SessionError(
            f"has the {noun} {index}, but the workbook has {len(table)}", where=where
        )
    return table[index]


def _local_name(element: Any) -> str:  # noqa: ANN401 - lxml has no types
    """Name of an element without its namespace, which differs in ECMA-376 and ISO 29500."""
    return str(element.tag.rpartition("}")[2])


def _join_text(item: Any) -> str:  # noqa: ANN401 - lxml has no types
    """Text of all runs of an item, without phonetic guides."""
    return "".join(e.text or "" for e in item.iter("{*}t") if _local_name(e.getparent()) != "rPh")


def _parse_index(text: str) -> int:
    if not (text.isascii() and text.isdigit()):
        raise ValueError(f"'{shorten(text)}' is not an index")
    return int(text)


def _parse_address(text: str) -> tuple[int, int]:
    """Row from 1 and column from 0 of an address such as B3."""
    match = _ADDRESS.fullmatch(text)
    if not match:
        raise ValueError(f"'{shorten(text)}' is not the address of a cell")
    column = 0
    for letter in match[1]:
        column = 26 * column + ord(letter) - ord("A") + 1
    return int(match[2]), column - 1
