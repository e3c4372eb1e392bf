"""Workbooks: cells, number formats, merged cells, bounds, and archives that are not workbooks."""

from __future__ import annotations

import datetime
import io
import zipfile
from decimal import Decimal

import openpyxl
import pytest
from watchdog import cpu_limit

from orthocal.errors import SessionError
from orthocal.io.tables import workbook
from orthocal.io.tables.cell import MOST_COLUMNS, MOST_ROWS
from orthocal.io.tables.workbook import LARGEST_CONTENT, LARGEST_PART, MOST_PARTS, read_workbook

SHEET = "xl/worksheets/sheet1.xml"
STYLES = "xl/styles.xml"
NAMESPACE = 'xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"'
CELLS, TAGS = 5_000, 40_000
"""Bounds in place of those of the module, for short tests."""

CELL = '<c r="A1"><v>1</v></c>'


RELATIONS = "http://schemas.openxmlformats.org/package/2006/relationships"
STRINGS = "xl/sharedStrings.xml"


def saved(made):
    stream = io.BytesIO()
    made.save(stream)
    return stream.getvalue()


def book(rows=(("a", 1),)):
    made = openpyxl.Workbook()
    for row in rows:
        made.active.append(row)
    return saved(made)


def with_parts(parts):
    """A workbook with parts changed or added; None removes a part."""
    with zipfile.ZipFile(io.BytesIO(book())) as archive:
        all_parts = {name: archive.read(name) for name in archive.namelist()} | parts
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, part in all_parts.items():
            if part is not None:
                archive.writestr(name, part)
    return stream.getvalue()


def with_strings(strings, data=""):
    """A workbook with shared strings, as Excel writes it; openpyxl writes texts into cells."""
    kind = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    relations = "".join(
        f'<Relationship Id="rId{at}" Type="{kind}/{name}" Target="{target}"/>'
        for at, (name, target) in enumerate(
            [("worksheet", "worksheets/sheet1.xml"), ("sharedStrings", "sharedStrings.xml")], 1
        )
    )
    return with_parts(
        {
            "xl/_rels/workbook.xml.rels": (
                f'<Relationships xmlns="{RELATIONS}">{relations}</Relationships>'.encode()
            ),
            SHEET: f"<worksheet {NAMESPACE}><sheetData>{data}</sheetData></worksheet>".encode(),
            STRINGS: strings,
        }
    )


def with_sheet(data, behind="", *, before=""):
    xml = f"<worksheet {NAMESPACE}>{before}<sheetData>{data}</sheetData>{behind}</worksheet>"
    return with_parts({SHEET: xml.encode()})


def read_one(content):
    (sheet,) = read_workbook(content, where="a.xlsx")
    return sheet


def refusal(content, **options):
    with cpu_limit(), pytest.raises(SessionError) as caught:
        read_workbook(content, where="a.xlsx", **options)
    return str(caught.value)


# ---- bounds


@pytest.mark.parametrize(
    "text", ["<row ", "<mergeCell ", "<f", "<c ", "<!-", "]", "&amp;"], ids=lambda text: text
)
def test_xml_is_read_in_linear_time(text):
    """A comment or text of a megabyte: expressions over the XML took minutes for 20 kB."""
    comment = "" if text == "<!-" else f"<!--{text * 200_000}-->"
    with cpu_limit():
        sheet = read_one(with_sheet(f'<row r="1">{CELL}</row>', before=comment))
        assert [row.line for row in sheet.rows] == [1]
        read_one(with_sheet('<row r="1"><c r="A1" t="str"><v>1</v></c></row>', before=comment))


def test_a_number_format_is_read_in_linear_time():
    """openpyxl takes 7 s for a format of 100,000 brackets."""
    style = (
        f'<styleSheet {NAMESPACE}><numFmts><numFmt numFmtId="164" formatCode="{"[" * 100_000}"/>'
        '</numFmts><cellXfs><xf numFmtId="164"/></cellXfs></styleSheet>'
    )
    assert "format" in refusal(with_parts({STYLES: style.encode()}))


@pytest.mark.parametrize(
    ("part", "size", "limit"),
    [
        (SHEET, LARGEST_CONTENT, LARGEST_CONTENT),
        (STYLES, LARGEST_PART, LARGEST_PART),
        ("xl/workbook.xml", LARGEST_PART, LARGEST_PART),
    ],
)
def test_a_large_part_is_not_unpacked(part, size, limit):
    content = with_parts({part: b"<a/>" + b" " * size})
    assert len(content) < 10**6
    message = refusal(content)
    assert part in message
    assert message.endswith(f"expected at most {limit / 2**20:g} MiB")


def test_large_shared_strings_are_not_unpacked():
    assert STRINGS in refusal(with_strings(b"<sst/>" + b" " * LARGEST_CONTENT))


def test_parts_without_cells_do_not_count():
    assert read_one(with_parts({"xl/media/a.bin": bytes(LARGEST_CONTENT)})).rows


def test_sheets_of_one_part_count_each():
    """Thousands of sheets can name the same part."""
    with zipfile.ZipFile(io.BytesIO(book())) as archive:
        xml = archive.read("xl/workbook.xml").decode()
    start, end = xml.index("<sheet "), xml.index("</sheets>")
    sheet = xml[start:end]
    many = "".join(sheet.replace('name="Sheet"', f'name="S{i}"') for i in range(5000))
    rows = f"<worksheet {NAMESPACE}>{' ' * 10_000}</worksheet>"
    content = with_parts(
        {"xl/workbook.xml": (xml[:start] + many + xml[end:]).encode(), SHEET: rows.encode()}
    )
    assert refusal(content).endswith("expected at most 32 MiB")


def test_a_part_that_is_larger_than_stated_is_refused():
    content = with_parts({SHEET: b"<worksheet>" + b" " * 10**6})
    at = content.rindex(SHEET.encode()) - 22  # the size in the directory
    changed = content[:at] + (1000).to_bytes(4, "little") + content[at + 4 :]
    assert "cannot be unpacked" in refusal(changed)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_entities_are_not_resolved(encoding):
    bomb = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "x"><!ENTITY c "&b;&b;">]><a>&c;</a>'
    assert refusal(with_strings(bomb.encode(encoding))) == (
        f"a.xlsx: is not a regular .xlsx workbook: {STRINGS} is not plain XML"
    )


UNREADABLE = "is not a readable .xlsx workbook: "
REFUSED = {
    "far-row": (
        f'<row r="{10**9}"><c r="A{10**9}"><v>1</v></c></row>',
        f"sheet 'Sheet': has more than {MOST_ROWS} rows",
    ),
    "far-column": (
        '<row r="1"><c r="XFD1"><v>1</v></c></row>',
        f"sheet 'Sheet': has 16384 columns; expected at most {MOST_COLUMNS}",
    ),
    "cells": (
        f"<row>{'<c><v>1</v></c>' * 500}</row>" * (CELLS // 500 + 1),
        f"sheet 'Sheet': has more than {CELLS} cells",
    ),
    "tags": ("<x/>" * (TAGS + 1), f"has more than {TAGS} XML tags in {SHEET}"),
    "row-order": ('<row r="2"/><row r="1"/>', UNREADABLE + "row 1 follows row 2"),
    "cell-order": (
        '<row r="1"><c r="B1"/><c r="A1"/></row>',
        UNREADABLE + "cell A1 is out of order",
    ),
    "type": (
        '<row r="1"><c r="A1" t="x"><v>1</v></c></row>',
        UNREADABLE + "'x' is not the type of a cell",
    ),
    "index": (
        '<row r="1"><c r="A1" t="s"><v>-1</v></c></row>',
        UNREADABLE + "'-1' is not an index",
    ),
}


@pytest.mark.parametrize(("rows", "message"), REFUSED.values(), ids=REFUSED)
def test_sheets_that_are_refused(rows, message, monkeypatch):
    monkeypatch.setattr(workbook, "MOST_CELLS", CELLS)
    monkeypatch.setattr(workbook, "MOST_TAGS", TAGS)
    assert refusal(with_sheet(rows)) == f"a.xlsx: {message}"


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (
            {"mimetype": b"application/vnd.oasis.opendocument.spreadsheet", "content.xml": b"<a/>"},
            "is an OpenDocument table; save it as .xlsx or CSV",
        ),
        ({"xl/workbook.bin": b""}, "is an .xlsb workbook; save it as .xlsx or CSV"),
        ({"[Content_Types].xml": None}, "is a ZIP archive, but not an .xlsx workbook"),
        ({SHEET: b"<worksheet>"}, "is not a readable .xlsx workbook: Premature end of data"),
        ({SHEET: None}, f"is damaged: {SHEET} is missing"),
        ({"xl/workbook.xml": b"<a/>"}, "is a workbook without worksheets"),
        ({f"a{i}": b"" for i in range(2001)}, f"has 2010 parts; expected at most {MOST_PARTS}"),
    ],
    ids=["ods", "xlsb", "zip", "cut-off", "no-sheet", "no-sheets", "many-parts"],
)
def test_archives_that_are_not_workbooks(parts, message):
    assert refusal(with_parts(parts)).startswith(f"a.xlsx: {message}")


# ---- cells


def test_the_stated_dimension_is_ignored():
    sheet = read_one(
        with_sheet(
            f'<row r="1">{CELL}<c r="B1"><v>2</v></c></row><row r="3"><c r="B3"><v>3</v></c></row>',
            before='<dimension ref="A1:A1"/>',
        )
    )
    rows = [(r.line, [c.text for c in r.cells]) for r in sheet.rows]
    assert rows == [(1, ["1", "2"]), (3, ["", "3"])]


def test_cells_without_addresses_follow_each_other():
    sheet = read_one(with_sheet("<row/><row><c><v>1</v></c><c/><c><v>2</v></c></row>"))
    assert [(r.line, [c.text for c in r.cells]) for r in sheet.rows] == [(2, ["1", "", "2"])]


def test_merged_cells_of_one_column():
    merged = "".join(
        f'<mergeCell ref="{ref}"/>' for ref in ("B2:B1048576", "A1:XFD1", "C3", "A4:A9")
    )
    sheet = read_one(with_sheet(f'<row r="1">{CELL}</row>', f"<mergeCells>{merged}</mergeCells>"))
    assert sheet.merged == ((0, 4, 9), (1, 2, 1048576))


def test_formulas_have_their_saved_values():
    row = (
        '<row r="1"><c r="A1"><f>B1*2</f><v>0.25</v></c><c r="B1"><f>1+1</f></c><c r="C1" t="str">'
        "<f>D1</f><v>yx</v></c></row>"
    )
    sheet = read_one(with_sheet(row))
    assert [(c.text, c.kind) for c in sheet.rows[0].cells] == [
        ("0.25", "number"),
        ("", "unsaved formula"),
        ("yx", "text"),
    ]
    assert sheet.formulas == 3


def test_kinds_of_cells():
    row = (
        '<row r="1"><c t="inlineStr"><is><r><t>a</t></r><r><t>b</t></r><rPh sb="0" eb="1"><t>x</t>'
        '</rPh></is></c><c t="b"><v>0</v></c><c t="e"><v>#N/A</v></c><c t="d"><v>2026-05-01</v></c>'
        "<c><v>1_0</v></c><c><v>1e16</v></c></row>"
    )
    assert [(c.text, c.kind) for c in read_one(with_sheet(row)).rows[0].cells] == [
        ("ab", "text"),
        ("FALSE", "boolean"),
        ("#N/A", "text"),
        ("2026-05-01", "date"),
        ("1_0", "text"),
        ("1e16", "text"),
    ]


def test_shared_strings():
    strings = (
        f"<sst {NAMESPACE}><si><t>a b</t></si><si><r><t>c</t></r><r><rPr><b/></rPr><t>d</t></r>"
        "<rPh><t>x</t></rPh></si><si/></sst>"
    )
    cells = "".join(f'<c t="s"><v>{at}</v></c>' for at in (1, 2, 0))
    sheet = read_one(with_strings(strings.encode(), f"<row>{cells}</row>"))
    assert [c.text for c in sheet.rows[0].cells] == ["cd", "", "a b"]


def test_a_strict_workbook():
    """ISO 29500 Strict has other namespaces than the files of most programs."""
    with zipfile.ZipFile(io.BytesIO(book([["a", 0.5]]))) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    for old, new in (
        ("schemas.openxmlformats.org/spreadsheetml/2006/main", "ooxml/spreadsheetml/main"),
        ("schemas.openxmlformats.org/officeDocument/2006", "ooxml/officeDocument"),
    ):
        strict = f"purl.oclc.org/{new}"
        parts = {n: part.replace(old.encode(), strict.encode()) for n, part in parts.items()}
    assert [c.text for c in read_one(with_parts(parts)).rows[0].cells] == ["a", "0.5"]


def test_numbers_have_the_digits_that_a_spreadsheet_shows():
    row = '<row r="1"><c r="A1"><v>0.30000000000000004</v></c><c r="B1"><v>-1E-3</v></c></row>'
    numbers = [c.number for c in read_one(with_sheet(row)).rows[0].cells]
    assert numbers == [Decimal("0.3"), Decimal("-0.001")]


def test_hidden_rows_are_counted():
    rows = f'<row r="1" hidden="1">{CELL}</row><row r="2" hidden="0"/><row r="3" hidden="1"/>'
    sheet = read_one(with_sheet(rows))
    assert (len(sheet.rows), sheet.hidden) == (1, 1)


def test_times_and_dates():
    """Days as Excel saves them: 14:59.999997 minutes are 15, and a time of day has no date."""
    made = openpyxl.Workbook()
    days = (45000.4270833333, 45000.0, 0.4270833333, 0.0, 45000.5 + 0.25 / 86400.0, 1e12)
    made.active.append(days)
    for cell in made.active[1]:
        cell.number_format = "yyyy-mm-dd hh:mm:ss"
    (row,) = read_one(saved(made)).rows
    assert [(c.text, c.kind) for c in row.cells] == [
        ("2023-03-15 10:15:00", "date"),
        ("2023-03-15 00:00:00", "date"),
        ("10:15:00", "date"),
        ("00:00:00", "date"),
        ("2023-03-15 12:00:00.250000", "date"),
        ("1000000000000", "number"),  # beyond the calendar
    ]
    assert row.cells[-1].number == Decimal(10**12)


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        ('<c r="B2" s="7"><v>1</v></c>', "has the style 7, but the workbook has "),
        ('<c r="B2" t="s"><v>3</v></c>', "has the shared text 3, but the workbook has 0"),
    ],
)
def test_cells_with_an_index_beyond_its_table_are_named(cell, message):
    found = refusal(with_sheet(f'<row r="2">{cell}</row>'))
    assert found.startswith(f"a.xlsx: sheet 'Sheet' B2: {message}")


@pytest.mark.parametrize(
    ("form", "expected"),
    [
        ('0.0" mm"', ("12.5", "number", "mm")),
        ("0.0\\ \\m\\m", ("12.5", "number", "mm")),
        ("#,##0.00", ("12.5", "number", "")),
        ('[$-407]0.0" µm";[Red]-0.0', ("12.5", "number", "µm")),
        ("0.0,", ("12.5", "scaled number", "")),
        ("0.0%", ("12.5", "scaled number", "")),
        ("0%", ("12.5", "scaled number", "")),
        ('0.0"%"', ("12.5", "number", "%")),
        ("dd/mm/yy", ("1900-01-11 12:00:00", "date", "")),
        ("mm-dd-yy", ("1900-01-11 12:00:00", "date", "")),
        ("[h]:mm", ("1900-01-11 12:00:00", "date", "")),
        *((form, ("1900-01-11 12:00:00", "date", "")) for form in ("[h]", "[mm]", "[S]")),
        ("[Red]0.0", ("12.5", "number", "")),
        ("\\+0.000", ("12.5", "number", "")),
        ('"R "0.0" mm"', ("12.5", "number", "mm")),
        ('"R "General" mm"', ("12.5", "number", "mm")),
        ('0.0" mm;"', ("12.5", "number", "mm;")),
        ('0.0" a;b";0%', ("12.5", "number", "a;b")),
        ("0.0\\;", ("12.5", "number", ";")),
        ("General", ("12.5", "number", "")),
    ],
)
def test_number_formats(form, expected):
    made = openpyxl.Workbook()
    made.active["A1"] = 12.5
    made.active["A1"].number_format = form
    (cell,) = read_one(saved(made)).rows[0].cells
    assert (cell.text, cell.kind, cell.unit) == expected


@pytest.mark.parametrize(
    "epoch", [openpyxl.utils.datetime.WINDOWS_EPOCH, openpyxl.utils.datetime.MAC_EPOCH]
)
def test_dates_of_both_epochs(epoch):
    made = openpyxl.Workbook()
    made.epoch = epoch
    made.active["A1"] = datetime.datetime(2026, 5, 1, 12)
    (cell,) = read_one(saved(made)).rows[0].cells
    assert (cell.text, cell.kind) == ("2026-05-01 12:00:00", "date")
