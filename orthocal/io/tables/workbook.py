"""Worksheets of an .xlsx workbook.

A workbook is a ZIP archive of XML parts (ECMA-376, part 1) from an untrusted source. Only the parts
with cells, their texts and their formats are read. Every part is bounded before it is unpacked.
Cells are read as a stream of XML events without entities, in linear time.
"""

from __future__ import annotations

import datetime
import io
import math
import posixpath
import re
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from lxml import etree

from orthocal.errors import SessionError
from orthocal.io.strict_yaml import LONGEST_NUMBER
from orthocal.io.tables.cell import (
    BLANK,
    MOST_CELLS,
    MOST_COLUMNS,
    MOST_ROWS,
    Cell,
    CellKind,
    Row,
    make_row,
)
from orthocal.text import shorten, text_problem

ZIP_SIGNATURE = b"PK\x03\x04"
"""First bytes of a workbook."""

LARGEST_CONTENT = 32 * 2**20
"""Maximum size of all unpacked parts, [bytes]; 50,000 rows of ten cells take 22 MiB."""

LARGEST_PART = 2 * 2**20
"""Maximum size of a part other than cells and their texts, unpacked, [bytes]."""

MOST_PARTS = 2_000
"""Maximum number of parts of a workbook."""

MOST_ELEMENTS = 4 * MOST_CELLS
"""Maximum number of XML elements of a part, for the time to read it."""

LONGEST_FORMAT = 255
"""Maximum length of a number format; the limit of Excel."""

_DIRECTORY_ENTRY = b"PK\x01\x02"

_PERCENT_FORMATS = {9, 10}
_DATE_FORMATS = {*range(14, 23), *range(27, 37), *range(45, 48), *range(50, 59)}
"""Numbers of the built-in formats of percentages and dates (ECMA-376, part 1, 18.8.30)."""

_LITERAL = re.compile(r'"([^"]*)"|\\(.)|\[[^\]]*\]|_.|\*.')
"""Parts of a number format that are literal text or layout."""
_THOUSANDS = re.compile(r"[0#?],+(?![0#?,])")
_DATE_CODE = re.compile(r"[dmhys]", re.I)
_NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]{1,3})?")
_ADDRESS = re.compile(r"([A-Z]{1,3})([0-9]{1,10})")
_DOCTYPE = re.compile(rb"<!(?:DOCTYPE|ENTITY)")

MergedCells = tuple[int, int, int]
"""Column from 0, first row and last row from 1 of cells of one column that are merged."""


@dataclass(frozen=True, slots=True)
class Sheet:
    """A worksheet."""

    name: str
    rows: tuple[Row, ...]
    """Rows that are not blank."""
    merged: tuple[MergedCells, ...]
    """Cells that are merged downwards."""
    formulas: int
    """Number of cells with a formula."""
    hidden: int
    """Number of hidden rows."""


@dataclass(frozen=True, slots=True)
class NumberFormat:
    """Meaning of a number format."""

    kind: CellKind
    """`number`, `date` or `scaled number`."""
    unit: str = ""
    """Text behind the number."""


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
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            _require_workbook(archive.namelist(), where)
            return _Workbook(archive, where).read(sheet)
    except (SessionError, MemoryError):
        raise
    except Exception as e:  # a damaged archive makes zipfile and lxml raise many kinds of errors
        words = " ".join(str(e).split())
        raise SessionError(
            f"is not a readable .xlsx workbook: {shorten(words or type(e).__name__)}", where=where
        ) from None


def _require_workbook(names: list[str], where: str) -> None:
    """Refuse archives of other kinds."""
    if "mimetype" in names and "content.xml" in names:
        raise SessionError("is an OpenDocument table; save it as .xlsx or CSV", where=where)
    if "xl/workbook.bin" in names:
        raise SessionError("is an .xlsb workbook; save it as .xlsx or CSV", where=where)
    if "[Content_Types].xml" not in names:
        raise SessionError("is a ZIP archive, but not an .xlsx workbook", where=where)
    if len(set(names)) != len(names):
        raise SessionError("has several parts of the same name", where=where)


class _Workbook:
    """Parts of a workbook, unpacked within a budget."""

    def __init__(self, archive: zipfile.ZipFile, where: str) -> None:
        self._archive = archive
        self._where = where
        self._unpacked = 0
        targets = {kind: target for kind, target in self._relations("").values()}
        main = targets.get("officeDocument", "xl/workbook.xml")
        root, relations = self._tree(main), self._relations(main)
        self._sheets = [
            (e.get("name", ""), e.get("state", "visible") == "visible", target)
            for e in root.iter("{*}sheet")
            for key, value in e.attrib.items()
            if key.endswith("}id")
            for kind, target in [relations.get(value, ("", ""))]
            if kind == "worksheet"
        ]
        by_kind = {kind: target for kind, target in relations.values()}
        self._formats: list[NumberFormat] = []
        if "styles" in by_kind:
            self._formats = _read_formats(self._tree(by_kind["styles"]))
        self._strings: list[str] = []
        if "sharedStrings" in by_kind:
            self._strings = self._parse(by_kind["sharedStrings"], _StringTarget())
        old_epoch = any(e.get("date1904") in ("1", "true") for e in root.iter("{*}workbookPr"))
        self._epoch = datetime.datetime(*((1904, 1, 1) if old_epoch else (1899, 12, 30)))

    def read(self, name: str | None) -> list[Sheet]:
        """Read the visible sheets, or the one that is named."""
        if not self._sheets:
            raise SessionError("is a workbook without worksheets", where=self._where)
        chosen = [s for s in self._sheets if s[1]] or self._sheets
        if name is not None:
            chosen = [s for s in self._sheets if s[0] == name] or [
                s for s in self._sheets if s[0].strip().casefold() == name.strip().casefold()
            ]
            if not chosen:
                names = ", ".join(f"'{title}'" for title, _, _ in self._sheets)
                raise SessionError(
                    f"has no sheet '{shorten(name)}'; sheets: {names}", where=self._where
                )
            chosen = chosen[:1]
        return [
            self._parse(
                part,
                _SheetTarget(
                    title,
                    strings=self._strings,
                    formats=self._formats,
                    epoch=self._epoch,
                    where=f"{self._where}: sheet '{title}'",
                ),
            )
            for title, _, part in chosen
        ]

    def _relations(self, part: str) -> dict[str, tuple[str, str]]:
        """Kinds and targets of the relations of a part, by their identifiers."""
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
        return etree.fromstring(self._unpack(part, LARGEST_PART), _parser())

    def _parse(self, part: str, target: _StringTarget) -> Any:  # noqa: ANN401 - what the target makes
        """Result of a target that receives the XML events of a part."""
        return etree.fromstring(self._unpack(part, LARGEST_CONTENT), _parser(target=target))

    def _unpack(self, part: str, largest: int) -> bytes:
        """Content of a part.

        Raises:
            SessionError: If it is too large, damaged, or not plain XML.
        """
        try:
            info = self._archive.getinfo(part)
        except KeyError:
            raise SessionError(
                f"is damaged: {shorten(part)} is missing", where=self._where
            ) from None
        self._unpacked += info.file_size
        for size, limit in ((info.file_size, largest), (self._unpacked, LARGEST_CONTENT)):
            if size > limit:
                raise SessionError(
                    f"has {size / 2**20:.1f} MiB unpacked up to {shorten(part)}; expected at most "
                    f"{limit / 2**20:g} MiB",
                    where=self._where,
                )
        try:
            text = self._archive.read(info)
        except Exception:
            raise SessionError(
                f"is damaged or protected by a password: {shorten(part)} cannot be unpacked",
                where=self._where,
            ) from None
        if _DOCTYPE.search(text) or not text.removeprefix(b"\xef\xbb\xbf").startswith(b"<"):
            raise SessionError(
                f"is not a regular .xlsx workbook: {shorten(part)} is not plain XML",
                where=self._where,
            )
        return text


def _parser(**options: object) -> Any:  # noqa: ANN401 - lxml has no types
    """XML parser that resolves no entities and loads nothing."""
    return etree.XMLParser(
        resolve_entities=False, load_dtd=False, no_network=True, huge_tree=False, **options
    )


def _read_formats(styles: Any) -> list[NumberFormat]:  # noqa: ANN401 - lxml has no types
    """Number formats of the cell styles, in their order."""
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
    """Meaning of a number format such as `0.0" mm"`.

    Raises:
        ValueError: If it is longer than spreadsheet programs permit.
    """
    if len(code) > LONGEST_FORMAT:
        raise ValueError(f"a number format has more than {LONGEST_FORMAT} characters")
    positive = code.split(";")[0]
    bare = _LITERAL.sub("", positive)
    if "%" in bare or _THOUSANDS.search(bare):
        return NumberFormat("scaled number")
    if _DATE_CODE.search(bare):
        return NumberFormat("date")
    return NumberFormat("number", "".join(a + b for a, b in _LITERAL.findall(positive)).strip())


class _StringTarget:
    """Texts of the items of the shared strings, from XML events."""

    def __init__(self) -> None:
        self._elements = 0
        self._strings: list[str] = []
        self._text: list[str] = []
        self._collects = False
        self._phonetic = False

    def start(self, tag: str, attributes: Mapping[str, str]) -> None:
        self._elements += 1
        if self._elements > MOST_ELEMENTS:
            raise ValueError(f"a part has more than {MOST_ELEMENTS} XML elements")
        name = _local_name(tag)
        if name == "rPh":
            self._phonetic = True
        elif name in ("t", "v"):
            self._collects = not self._phonetic

    def data(self, text: str) -> None:
        if self._collects:
            self._text.append(text)

    def end(self, tag: str) -> None:
        name = _local_name(tag)
        if name == "rPh":
            self._phonetic = False
        elif name in ("t", "v"):
            self._collects = False
        elif name == "si":
            self._strings.append(self._take_text())

    def close(self) -> Any:  # noqa: ANN401 - a target makes what it likes
        return self._strings

    def _take_text(self) -> str:
        text = "".join(self._text)
        self._text.clear()
        return text


class _SheetTarget(_StringTarget):
    """Rows of a worksheet, from XML events."""

    def __init__(
        self,
        title: str,
        *,
        strings: list[str],
        formats: list[NumberFormat],
        epoch: datetime.datetime,
        where: str,
    ) -> None:
        super().__init__()
        self._title = title
        self._shared = strings
        self._formats = formats
        self._epoch = epoch
        self._where = where
        self._rows: list[Row] = []
        self._merged: list[MergedCells] = []
        self._count = self._formulas = self._hidden = 0
        self._line = 0
        self._cells: list[Cell] = []
        self._column = -1
        self._type = "n"
        self._style = 0
        self._formula = False
        self._starts: dict[str, Callable[[Mapping[str, str]], None]] = {
            "row": self._start_row,
            "c": self._start_cell,
            "f": self._start_formula,
            "mergeCell": self._add_merged,
        }

    def start(self, tag: str, attributes: Mapping[str, str]) -> None:
        super().start(tag, attributes)
        begin = self._starts.get(_local_name(tag))
        if begin is not None:
            begin(attributes)

    def end(self, tag: str) -> None:
        name = _local_name(tag)
        if name == "c":
            self._end_cell()
        elif name == "row":
            self._end_row()
        else:
            super().end(tag)

    def close(self) -> Sheet:
        return Sheet(
            self._title,
            tuple(self._rows),
            tuple(sorted(self._merged)),
            self._formulas,
            self._hidden,
        )

    def _start_row(self, attributes: Mapping[str, str]) -> None:
        line = _parse_index(attributes["r"]) if "r" in attributes else self._line + 1
        if line <= self._line:
            raise ValueError(f"row {line} follows row {self._line}")
        self._line = line
        self._cells, self._column = [], -1
        self._hidden += attributes.get("hidden") in ("1", "true")

    def _end_row(self) -> None:
        row = make_row(self._line, self._cells)
        self._cells = []
        if row is None:
            return
        if row.line > MOST_ROWS:
            raise SessionError(f"has more than {MOST_ROWS} rows", where=self._where)
        self._count += len(row.cells)
        if self._count > MOST_CELLS:
            raise SessionError(f"has more than {MOST_CELLS} cells", where=self._where)
        self._rows.append(row)

    def _start_cell(self, attributes: Mapping[str, str]) -> None:
        column = self._column + 1
        if "r" in attributes:
            line, column = _parse_address(attributes["r"])
            if line != self._line or column <= self._column:
                raise ValueError(f"cell {attributes['r']} is out of order")
        self._column = column
        self._type = attributes.get("t", "n")
        self._style = _parse_index(attributes.get("s", "0"))
        self._formula = False
        self._text.clear()

    def _start_formula(self, _: Mapping[str, str]) -> None:
        self._formulas += not self._formula
        self._formula = True

    def _end_cell(self) -> None:
        cell = self._make_cell(self._take_text())
        if cell.is_blank:
            return
        if self._column >= MOST_COLUMNS:
            raise SessionError(
                f"has {self._column + 1} columns; expected at most {MOST_COLUMNS}",
                where=f"{self._where} row {self._line}",
            )
        self._cells += [BLANK] * (self._column - len(self._cells))
        self._cells.append(cell)

    def _make_cell(self, text: str) -> Cell:
        """Cell of a text, by the type and the style of the cell."""
        if not text:
            return Cell("", kind="unsaved formula") if self._formula else BLANK
        if self._type == "n":
            return self._make_number(text)
        if self._type == "b":
            return Cell("TRUE" if text in ("1", "true") else "FALSE", kind="boolean")
        if self._type == "d":
            return Cell(text, kind="date")
        if self._type == "s":
            text = self._shared[_parse_index(text)]
        problem = text_problem(text.replace("\r", "\n"))
        if problem:
            raise SessionError(problem, where=f"{self._where} row {self._line}")
        return Cell(text)

    def _make_number(self, text: str) -> Cell:
        """Number to the 15 digits that a spreadsheet program shows."""
        value = math.nan
        if len(text) <= LONGEST_NUMBER and _NUMBER.fullmatch(text):
            value = float(text)
        if not abs(value) <= 1e15:
            return Cell(text)
        number = Decimal(f"{value:.15g}")
        plain = f"{number:f}" if number.adjusted() > -20 else str(number)
        if "." in plain:
            plain = plain.rstrip("0").rstrip(".")
        form = self._formats[self._style] if self._formats else NumberFormat("number")
        if form.kind == "date":
            with suppress(OverflowError):  # a number beyond the calendar is shown as it is
                plain = str(self._epoch + datetime.timedelta(days=value))
            return Cell(plain, kind="date")
        return Cell(plain, number, form.kind, form.unit)

    def _add_merged(self, attributes: Mapping[str, str]) -> None:
        first, _, last = attributes.get("ref", "").partition(":")
        (top, left), (bottom, right) = _parse_address(first), _parse_address(last or first)
        if top < bottom and left == right:
            self._merged.append((left, top, bottom))
        if len(self._merged) > MOST_ROWS:
            raise SessionError(f"has more than {MOST_ROWS} merged cells", where=self._where)


def _local_name(tag: str) -> str:
    return tag.rpartition("}")[2]


def _parse_index(text: str) -> int:
    if not (text.isascii() and text.isdigit()):
        raise ValueError(f"'{shorten(text)}' is not an index")
    return int(text)


def _parse_address(text: str) -> tuple[int, int]:
    """Row from 1 and column from 0 of an address such as B3."""
    found = _ADDRESS.fullmatch(text)
    if not found:
        raise ValueError(f"'{shorten(text)}' is not the address of a cell")
    column = 0
    for letter in found[1]:
        column = 26 * column + ord(letter) - ord("A") + 1
    return int(found[2]), column - 1
