"""Workbooks from strangers: what is in them within bounds, and archives that are no workbooks."""

from __future__ import annotations

import io
import time
import zipfile
from decimal import Decimal

import openpyxl
import pytest

from orthocal.errors import SessionError
from orthocal.io.tables.cell import MOST_COLUMNS, MOST_ROWS
from orthocal.io.tables.workbook import LARGEST_CONTENT, LARGEST_PART, read_workbook

PROMPT = 10.0
"""Processor time that no workbook may take, [s]."""

SHEET = "xl/worksheets/sheet1.xml"
NAMESPACE = 'xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"'


def book(rows=(("a", 1),)):
    made = openpyxl.Workbook()
    for row in rows:
        made.active.append(row)
    stream = io.BytesIO()
    made.save(stream)
    return stream.getvalue()


def with_parts(parts, content=None):
    """A workbook with some parts changed or added; None takes one out."""
    with zipfile.ZipFile(io.BytesIO(content or book())) as archive:
        all_parts = {name: archive.read(name) for name in archive.namelist()} | parts
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, part in all_parts.items():
            if part is not None:
                archive.writestr(name, part)
    return stream.getvalue()


def with_sheet(data, behind=""):
    xml = f"<worksheet {NAMESPACE}><sheetData>{data}</sheetData>{behind}</worksheet>"
    return with_parts({SHEET: xml.encode()})


def refusal(content, **options):
    began = time.process_time()
    with pytest.raises(SessionError) as caught:
        read_workbook(content, where="a.xlsx", **options)
    assert time.process_time() - began < PROMPT
    return str(caught.value)


def test_a_bomb_is_not_unpacked():
    content = with_parts({"xl/media/a.bin": bytes(LARGEST_CONTENT)})
    assert len(content) < 10**6
    assert refusal(content) == "a.xlsx: has 32 MiB unpacked; expected at most 32 MiB"
    styles = b"<styleSheet/>" + b" " * LARGEST_PART
    assert refusal(with_parts({"xl/styles.xml": styles})) == (
        "a.xlsx: has 4 MiB in xl/styles.xml; expected at most 4 MiB"
    )


def test_a_part_that_is_larger_than_it_says_is_not_read_further():
    content = with_parts({SHEET: b"<worksheet>" + b" " * 10**6})
    at = content.rindex(SHEET.encode()) - 22  # the size in the directory
    spoilt = content[:at] + (1000).to_bytes(4, "little") + content[at + 4 :]
    assert "cannot be unpacked" in refusal(spoilt) or "cannot be read" in refusal(spoilt)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_entities_are_not_resolved(encoding):
    bomb = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "x"><!ENTITY c "&b;&b;">]><a>&c;</a>'
    content = with_parts({"xl/sharedStrings.xml": bomb.encode(encoding)})
    assert refusal(content) == (
        "a.xlsx: is not an .xlsx as spreadsheets write it: xl/sharedStrings.xml is not plain XML"
    )


def test_rows_and_columns_far_away_are_not_waited_for():
    far = f'<row r="{10**9}"><c r="A{10**9}"><v>1</v></c></row>'
    assert refusal(with_sheet(far)) == f"a.xlsx: sheet 'Sheet': has more than {MOST_ROWS} rows"
    wide = '<row r="1"><c r="XFD1"><v>1</v></c></row>'
    assert refusal(with_sheet(wide)) == (
        f"a.xlsx: sheet 'Sheet' row 1: has 16384 columns; expected at most {MOST_COLUMNS}"
    )


def test_cells_merged_over_a_whole_sheet_take_nothing():
    row = '<row r="1"><c r="A1"><v>1</v></c></row>'
    merged = '<mergeCells count="1"><mergeCell ref="A1:XFD1048576"/></mergeCells>'
    (sheet,) = read_workbook(with_sheet(row, merged), where="a.xlsx")
    assert sheet.merged == ((1, 0, 1048576, 16383),)


def test_a_size_that_a_sheet_gives_wrongly_does_not_matter():
    xml = (
        f'<worksheet {NAMESPACE}><dimension ref="A1:A1"/><sheetData><row r="1"><c r="A1"><v>1</v>'
        '</c><c r="B1"><v>2</v></c></row><row r="3"><c r="B3"><v>3</v></c></row></sheetData>'
        "</worksheet>"
    )
    (sheet,) = read_workbook(with_parts({SHEET: xml.encode()}), where="a.xlsx")
    assert [(r.line, [c.text for c in r.cells]) for r in sheet.rows] == [
        (1, ["1", "2"]),
        (3, ["", "3"]),
    ]


def test_formulas_give_the_values_that_were_saved():
    row = (
        '<row r="1"><c r="A1"><f>B1*2</f><v>0.25</v></c><c r="B1"><f>1+1</f></c><c r="C1" t="str">'
        "<f>D1</f><v>yx</v></c></row>"
    )
    (sheet,) = read_workbook(with_sheet(row), where="a.xlsx")
    assert [(c.text, c.kind) for c in sheet.rows[0].cells] == [
        ("0.25", "number"),
        ("", "unsaved"),
        ("yx", "text"),
    ]
    assert sheet.formulas == 3


def test_numbers_have_the_digits_that_a_spreadsheet_shows():
    row = '<row r="1"><c r="A1"><v>0.30000000000000004</v></c><c r="B1"><v>-1E-3</v></c></row>'
    (sheet,) = read_workbook(with_sheet(row), where="a.xlsx")
    assert [c.number for c in sheet.rows[0].cells] == [Decimal("0.3"), Decimal("-0.001")]


def test_hidden_rows_are_counted():
    rows = (
        '<row r="1" hidden="1"><c r="A1"><v>1</v></c></row><row r="2"><c r="A2"><v>2</v></c></row>'
    )
    (sheet,) = read_workbook(with_sheet(rows), where="a.xlsx")
    assert (len(sheet.rows), sheet.hidden) == (2, 1)


@pytest.mark.parametrize(
    ("form", "expected"),
    [
        ('0.0" mm"', ("12.5", "number", "mm")),
        ("0.0\\ \\m\\m", ("12.5", "number", "mm")),
        ("#,##0.00", ("12.5", "number", "")),
        ('[$-407]0.0" µm";[Red]-0.0', ("12.5", "number", "µm")),
        ("0.0,", ("12.5", "shown otherwise", "")),
        ("0.0%", ("12.5", "shown otherwise", "")),
        ('0.0"%"', ("12.5", "number", "%")),
    ],
)
def test_what_a_format_writes_behind_a_number(form, expected):
    made = openpyxl.Workbook()
    made.active["A1"] = 12.5
    made.active["A1"].number_format = form
    stream = io.BytesIO()
    made.save(stream)
    (sheet,) = read_workbook(stream.getvalue(), where="a.xlsx")
    (cell,) = sheet.rows[0].cells
    assert (cell.text, cell.kind, cell.unit) == expected


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (
            {"mimetype": b"application/vnd.oasis.opendocument.spreadsheet", "content.xml": b"<a/>"},
            "is an OpenDocument table; save it as .xlsx or CSV",
        ),
        ({"xl/workbook.bin": b""}, "is an .xlsb; save it as .xlsx or CSV"),
        ({"[Content_Types].xml": None}, "is an archive, but no .xlsx"),
        ({SHEET: b"<worksheet>"}, "is not an .xlsx that can be read: no element found: line 1"),
        ({"xl/workbook.xml": b"<a/>"}, "is an .xlsx without sheets of cells"),
        ({f"a{i}": b"" for i in range(2001)}, "holds 2010 parts of 2010 names; expected at most 2"),
    ],
)
def test_other_archives_are_named(parts, message):
    assert refusal(with_parts(parts)).startswith(f"a.xlsx: {message}")


def test_sheets_that_are_all_one_part_are_not_read_again_and_again():
    with zipfile.ZipFile(io.BytesIO(book())) as archive:
        xml = archive.read("xl/workbook.xml").decode()
    start, end = xml.index("<sheet "), xml.index("</sheets>")
    many = "".join(
        xml[start:end].replace('name="Sheet"', f'name="S{i}"').replace('Id="1"', f'Id="{i}"')
        for i in range(1, 5000)
    )
    content = with_parts({"xl/workbook.xml": (xml[:start] + many + xml[end:]).encode()})
    assert refusal(content) == (
        "a.xlsx: has 4999 sheets of up to 1 MiB; expected at most 50, and 128 MiB"
    )
