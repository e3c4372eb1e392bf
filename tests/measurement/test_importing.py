"""Import of tables: the exact readings of every form of table, or its refusal."""

from __future__ import annotations

import datetime
import io
import json
import shutil
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any

import openpyxl
import pytest
from commands import orthocal
from conftest import ROOT

from orthocal import load_session
from orthocal.errors import SessionError
from orthocal.measurement.importing.import_readings import (
    TableOptions,
    import_readings,
    write_import,
)

SESSION = """
robot: machine
gauge: {sigma_mm: 0.01, resolution_mm: 0.01, range_mm: [-60, 60]}
postures:
  zero: {tcp_mm: [0, 0]}
  x_max: {tcp_mm: [40, 0]}
  x_-40: {tcp_mm: [-40, 0]}
setups:
  xy: {leg: x, direction: y, section: {fraction: 0.5}}
  yx: {leg: y, direction: -x, section: {fraction: 0.5}}
readings: readings.csv
"""

THREE = (("xy", "zero", "", 1, "0"), ("xy", "x_max", "", 1, "-0.43"), ("yx", "zero", "", 1, "1.5"))
"""Readings of most forms."""

WIDE = (
    ("xy", "zero", "", 1, "0.01"),
    ("xy", "zero", "", 2, "-0.02"),
    ("xy", "x_max", "", 1, "0.5"),
    ("xy", "x_max", "", 2, "0.52"),
)


@dataclass(frozen=True)
class Form:
    """A table, and its expected readings or refusal."""

    name: str
    content: bytes
    expected: tuple[tuple[str, str, str, int, str], ...] | str
    """Readings in mm, or the refusal with {} for the path of the table."""
    options: dict[str, Any] = field(default_factory=dict)


def text(name, content, expected=THREE, *, encoding="utf-8", **options):
    return Form(name, content.encode(encoding), expected, options)


def book(name, rows, expected=THREE, *, edit=None, **options):
    """A workbook of openpyxl; rows of one sheet, or sheets by name."""
    made = openpyxl.Workbook()
    sheets = rows if isinstance(rows, dict) else {"Tabelle1": rows}
    made.remove(made.active)
    for title, lines in sheets.items():
        sheet = made.create_sheet(title)
        for line in lines:
            sheet.append(line)
    if edit:
        edit(made)
    stream = io.BytesIO()
    made.save(stream)
    return Form(name, stream.getvalue(), expected, options)


ENGLISH = "setup,posture,reading_mm\nxy,zero,0.00\nxy,x_max,-0.43\nyx,zero,1.5\n"
GERMAN = "Aufstellung;Stellung;Messwert [mm]\r\nxy;zero;0,00\r\nxy;x_max;-0,43\r\nyx;zero;1,5\r\n"
CELLS = [
    ["Setup", "Posture", "Reading [mm]"],
    ["xy", "zero", 0],
    ["xy", "x_max", -0.43],
    ["yx", "zero", 1.5],
]
HEAD = "setup;posture;reading_mm\n"
UNITLESS = "setup;posture;value\nxy;zero;0,5\n"
WHICH = "and no other reading decides; choose one by --decimal comma or --decimal point"


def in_sheet(cell, **changes):
    def edit(made):
        for key, value in changes.items():
            setattr(made.worksheets[0][cell], key, value)

    return edit


def merge(made):
    made.worksheets[0].merge_cells("A2:A3")


def hide_second(made):
    made.worksheets[1].sheet_state = "hidden"


def one(value, *, unit="mm"):
    """The only reading of a table, in mm."""
    factor = {"mm": 1, "um": Decimal("0.001"), "inch": Decimal("25.4")}[unit]
    return (("xy", "zero", "", 1, str(Decimal(value) * factor)),)


FORMS = [
    text("house", ENGLISH),
    text("german-excel", GERMAN),
    text("german-cp1252-en-dash", GERMAN.replace("-0", "–0"), encoding="cp1252"),
    text("minus-sign", GERMAN.replace("-0", "−0")),
    text("minus-hyphens", GERMAN.replace("-0", "‐0")),
    text("minus-and-blank", GERMAN.replace("-0", "− 0")),
    text("plus-sign", GERMAN.replace("1,5", "+1,5")),
    text("byte-order-mark", GERMAN, encoding="utf-8-sig"),
    text("utf16-with-mark", GERMAN.replace(";", "\t"), encoding="utf-16"),
    text("utf16-le", GERMAN, encoding="utf-16-le"),
    text("utf16-be", GERMAN.replace("-0", "−0"), encoding="utf-16-be"),
    Form("utf16-cut", GERMAN.encode("utf-16-le")[:-1],
         f"{{}}: is not utf-16-le text (byte {2 * len(GERMAN) - 2})"),
    text("tabs", ENGLISH.replace(",", "\t")),
    text("tabs-and-decimal-commas", GERMAN.replace(";", "\t")),
    text("pipes", ENGLISH.replace(",", "|")),
    text("commas-and-quoted-decimal-commas", ENGLISH.replace("0.00", '"0,00"')
         .replace("-0.43", '"-0,43"').replace("1.5", '"1,5"')),
    text("all-quoted", '"Setup";"Posture";"Reading_mm"\n"xy";"zero";"0,00"\n"xy";"x_max";"-0,43"\n'
         '"yx";"zero";"1,5"\n'),
    text("lines-of-a-mac", GERMAN.replace("\r\n", "\r")),
    text("stated-separator", f"sep=;\n{GERMAN}"),
    text("capitals", ENGLISH.replace("setup,posture,reading_mm", " SETUP , Posture ,READING_MM")
         .replace("xy,", "XY,").replace("x_max", "X max")),
    text("bracketed-unit", GERMAN.replace("Messwert [mm]", "Ablesung (mm)")),
    text("line-break-in-heading", GERMAN.replace("Messwert [mm]", '"Messwert\n[mm]"')),
    text("unit-after-in", GERMAN.replace("Messwert [mm]", "Wert in mm")),
    text("unit-in-a-row-of-its-own", "Setup;Posture;Value\n;;mm\nxy;zero;0,00\nxy;x_max;-0,43\n"
         "yx;zero;1,5\n"),
    text("unit-in-cells", "Setup;Posture;Value\nxy;zero;0,00 mm\nxy;x_max;-430 µm\n"
         "yx;zero;1,5mm\n"),
    text("rows-above", f"Messprotokoll;;\n;;\nMaschine 3;12.05.2026;\n{GERMAN}"),
    text("rows-below", f"{GERMAN};;\nGemessen von Meier;;\n"),
    text("empty-columns-and-rows", GERMAN.replace("\r\n", ";;;\r\n") + ";;;;;\r\n;;;;;\r\n"),
    text("extra-columns", "Nr;setup;Temperatur;posture;Messwert_mm;Bemerkung\n"
         "1;xy;21,5;zero;0,00;\n2;xy;21,5;x_max;-0,43;gut\n3;yx;21,5;zero;1,5;\n"),
    text("cells-without-heading", GERMAN.replace("-0,43", "-0,43;;wackelt")),
    text("not-yet-read", GERMAN + "yx;x_max;\r\nyx;x_-40;–\r\nxy;x_-40;n/a\r\n"),
    text("order-of-columns", "Reading (mm);Posture;Setup\n0,00;zero;xy\n-0,43;x_max;xy\n"
         "1,5;zero;yx\n"),
    text("named-columns", "A;B;C\nxy;zero;0,00\nxy;x_max;-0,43\nyx;zero;1,5\n",
         columns={"setup": "A", "posture": "b", "reading": "#3"}, unit="mm"),
    text("fill", "setup;posture;Wert mm\nxy;zero;0,00\n;x_max;-0,43\nyx;zero;1,5\n", fill=True),
    text("fill-below-setups", "setup;posture;Wert mm\nxy;;\n;zero;0,00\n;x_max;-0,43\nyx;;\n"
         ";zero;1,5\n", fill=True),
    text("fill-below-postures", "posture;setup;Wert mm\nzero;;\n;xy;0,00\nx_max;;\n;xy;-0,43\n"
         "zero;;\n;yx;1,5\n", fill=True),
    text("not-filled", "setup;posture;Wert mm\nxy;zero;0,00\n;x_max;-0,43\n",
         "{}:3: has a reading but no setup; --fill copies the setup from the row above"),
    text("total", "setup;posture;Wert mm\nxy;zero;0,00\n;Summe:;-0,43\n",
         "{}:3: has a reading but no setup; it seems to be a total of others: delete it"),
    text("groups-by-point", HEAD.replace("mm", "um") + "xy;zero;1.234,5\n",
         one("1234.5", unit="um")),
    text("groups-by-comma", HEAD.replace("mm", "um") + "xy;zero;1,234.5\n",
         one("1234.5", unit="um")),
    text("groups-by-blank", HEAD.replace("mm", "um") + "xy;zero;1\u202f234,5\n",
         one("1234.5", unit="um")),
    text("groups-by-apostrophe", HEAD.replace("mm", "µm") + "xy;zero;1’234.5\n",
         one("1234.5", unit="um")),
    text("micrometres", "setup;posture;Wert in µm\nxy;zero;-12,5\n", one("-12.5", unit="um")),
    text("micrometres-cp1252", "setup;posture;Wert [µm]\nxy;zero;-12,5\n", one("-12.5", unit="um"),
         encoding="cp1252"),
    text("inches", 'setup;posture;reading (in)\nxy;zero;-.0125\n', one("-.0125", unit="inch")),
    text("inch-marks", 'setup|posture|reading\nxy|zero|0.005"\n', one("0.005", unit="inch")),
    text("unit-from-option", UNITLESS, one("0.5"), unit="mm"),
    text("inch-from-option", UNITLESS, one("0.5", unit="inch"), unit="inch"),
    text("no-unit", UNITLESS, "{}:2: neither the heading 'value' nor the cell has a unit; state it "
         "by --unit mm, um, inch or hundredths"),
    text("other-unit-than-option", UNITLESS.replace("value", "value_mm"),
         "{}:2: the reading is in mm, which contradicts --unit um", unit="um"),
    text("other-unit-in-a-cell", HEAD + "xy;zero;0,5 µm\n",
         "{}:2: the reading is in um, and its heading says mm"),
    text("exponents", HEAD + "xy;zero;-1,25E-02\n", one("-0.0125")),
    text("many-digits", HEAD + "xy;zero;0,12345678901234567890123\n",
         one("0.12345678901234567890123")),
    text("wide-cycles", "setup,posture,cycle 1,cycle 2\nxy,zero,0.01,-0.02\nxy,x_max,0.5,0.52\n",
         WIDE, unit="mm"),
    text("wide-readings", "setup;posture;reading 1_mm;reading 2_mm\nxy;zero;0,01;-0,02\n"
         "xy;x_max;0,5;0,52\n", WIDE),
    text("wide-units-first", "setup;posture;reading_mm_1;reading_mm_2\nxy;zero;0,01;-0,02\n"
         "xy;x_max;0,5;0,52\n", WIDE),
    text("wide-german", "Aufstellung\tStellung\t1. Durchgang [mm]\t2. Durchgang [mm]\tMittelwert\n"
         "xy\tzero\t0,01\t-0,02\t-0,005\nxy\tx_max\t0,5\t0,52\t0,51\n", WIDE),
    text("wide-numbers", "setup;posture;1;2\nxy;zero;0,01;-0,02\nxy;x_max;0,5;0,52\n", WIDE,
         unit="mm"),
    text("wide-assigned", "setup;posture;Uhr A [mm];Uhr B [mm]\nxy;zero;0,01;-0,02\n"
         "xy;x_max;0,5;0,52\n", WIDE,
         columns={"reading 2": "Uhr B [mm]", "reading1": "Uhr A [mm]"}),
    text("wide-half-read", "setup;posture;cycle 1;cycle 2\nxy;zero;0,01;-0,02\nxy;x_max;0,5;\n",
         WIDE[:3], unit="mm"),
    text("wide-and-a-cycle", "setup;posture;cycle;reading 1;reading 2\nxy;zero;1;0,1;0,2\n",
         "{}:1: has cycles side by side ('reading 1' ...) and a column 'cycle' as well; choose one "
         "by --column", unit="mm"),
    text("cycles-below-each-other", "setup;posture;Zyklus;mm\nxy;zero;1;0,01\n",
         "{}: no row has the headings setup, posture and reading; row 1 has 'setup', 'posture', "
         "'Zyklus', 'mm' with semicolon as separator; assign columns by --column ROLE=HEADING"),
    text("cycles-in-rows", "setup;posture;Zyklus;Wert mm\nxy;zero;1;0,01\nxy;zero;2;-0,02\n"
         "xy;x_max;1;0,5\nxy;x_max;2;0,52\n", WIDE),
    text("differences", "setup;posture;minus;reading_mm\nxy;x_max;zero;-0,43\n",
         (("xy", "x_max", "zero", 1, "-0.43"),)),
    text("dash-for-no-minus", "setup;posture;minus;reading_mm\nxy;zero;–;0,5\n", one("0.5")),
    text("name-with-a-dash", HEAD + "xy;x_–40;0,5\n", (("xy", "x_-40", "", 1, "0.5"),)),
    text("thousand-or-decimal", HEAD + "xy;zero;12\nxy;x_max;1,234\n",
         "{}:3: the reading '1,234' is 1.234 with a decimal comma and 1234 with a decimal point, "
         + WHICH),
    text("thousand-or-decimal-by-point", UNITLESS.replace("0,5", "-1.234"),
         "{}:2: the reading '-1.234' is -1234 with a decimal comma and -1.234 with a decimal "
         "point, " + WHICH, unit="um"),
    text("sign-from-another-cell", HEAD + "xy;zero;1,234\nxy;x_max;0,5\n",
         (("xy", "zero", "", 1, "1.234"), ("xy", "x_max", "", 1, "0.5"))),
    text("sign-from-an-option", HEAD + "xy;zero;1,234\n", one("1.234"), decimal="comma"),
    text("thousand-by-an-option", HEAD.replace("mm", "um") + "xy;zero;1,234\n",
         one("1234", unit="um"), decimal="point"),
    text("leading-zero", HEAD + "xy;zero;0,123\n", one("0.123")),
    text("both-signs", HEAD + "xy;zero;0,5\nxy;x_max;0.5\n",
         "{}:3: the reading '0.5' has a decimal point, and '0,5' in line 2 a decimal comma; use "
         "one decimal sign"),
    text("other-sign-than-option", HEAD + "xy;zero;0,5\n",
         "{}:2: the reading is '0,5'; expected a number with a decimal point", decimal="point"),
    text("three-and-five", "setup,posture,Wert_um,Zyklus\nxy,zero,3,5\n",
         "{}:2: '3,5' may be two cells or one number with a decimal comma; for two cells use "
         "`orthocal import --separator comma`, for one number save the table with semicolons"),
    text("three-and-five-with-option", "setup,posture,Wert_um,Zyklus\nxy,zero,3,5\n",
         (("xy", "zero", "", 5, "0.003"),), separator="comma"),
    text("thousands-or-two-cycles", "setup,posture,cycle 1 [mm],cycle 2 [mm]\nxy,zero,1,000.000\n",
         "{}:2: '1,000.000' may be two cells or one number with a comma between thousands; for two "
         "cells use `orthocal import --separator comma`, for one number save the table with "
         "semicolons"),
    text("thousands-or-two-cycles-beside-another-row",
         "setup,posture,cycle 1 [um],cycle 2 [um]\nxy,zero,1,100.0\nxy,x_max,0.5,0.4\n",
         "{}:2: '1,100.0' may be two cells or one number with a comma between thousands; for two "
         "cells use `orthocal import --separator comma`, for one number save the table with "
         "semicolons"),
    text("two-cycles-with-option",
         "setup,posture,cycle 1 [um],cycle 2 [um]\nxy,zero,1,100.0\nxy,x_max,0.5,0.4\n",
         (("xy", "zero", "", 1, "0.001"), ("xy", "zero", "", 2, "0.1"),
          ("xy", "x_max", "", 1, "0.0005"), ("xy", "x_max", "", 2, "0.0004")), separator="comma"),
    text("two-cycles-of-similar-size",
         "setup,posture,cycle 1 [um],cycle 2 [um]\nxy,zero,101,100.0\nxy,x_max,0.5,0.4\n",
         (("xy", "zero", "", 1, "0.101"), ("xy", "zero", "", 2, "0.1"),
          ("xy", "x_max", "", 1, "0.0005"), ("xy", "x_max", "", 2, "0.0004"))),
    text("thousands-without-an-empty-last-cell",
         "setup,posture,cycle 1,cycle 2\nxy,x_max,1,000\nxy,zero,,0.000\n",
         "{}:2: '1,000' may be two cells or one number with a comma between thousands; for two "
         "cells use `orthocal import --separator comma`, for one number save the table with "
         "semicolons"),
    text("decimal-comma-between-commas", "setup,posture,reading_mm\nxy,zero,0,5\n",
         "{}:2: has 4 fields; expected 3; a decimal comma between commas? Save the table with "
         "semicolons, or its numbers in quotes"),
    text("temperature-between-commas", "setup,posture,T,reading_mm\nxy,zero,21,5,\n",
         "{}:2: has 5 fields; expected 4; a decimal comma between commas? Save the table with "
         "semicolons, or its numbers in quotes"),
    text("no-number", HEAD + "xy;zero;gut\n", "{}:2: the reading is 'gut'; expected a number"),
    text("error-of-a-spreadsheet", HEAD + "xy;zero;#DIV/0!\n",
         "{}:2: the reading is '#DIV/0!'; expected a number"),
    text("wrong-digits", HEAD + "xy;zero;٣\n", "{}:2: the reading is '٣'; expected a number"),
    text("minus-behind", HEAD + "xy;zero;0,5-\n", "{}:2: the reading is '0,5-'; expected a number"),
    text("unknown-setup", HEAD + "xz;zero;0,5\n", "{}:2: 'xz' is not a setup; setups: xy, yx"),
    text("unknown-posture", HEAD + "xy;null;0,5\n",
         "{}:2: 'null' is not a posture; postures: zero, x_max, x_-40"),
    text("twice", HEAD + "xy;zero;0,5\nXY;Zero;0,6\n",
         "{}:3: repeats xy zero of cycle 1, first in line 2; number repeated measurements in the "
         "column 'cycle', and different sides of approach in 'approach'"),
    text("two-readings-a-row", "setup;posture;Messwert_mm;Anzeige_mm\nxy;zero;0,5;0,6\n",
         "{}:1: several columns have the role reading: 'Messwert_mm' (#3) and 'Anzeige_mm' (#4); "
         "choose one by --column reading=HEADING"),
    text("two-readings-assigned", "setup;posture;Messwert_mm;Anzeige_mm\nxy;zero;0,5;0,6\n",
         one("0.6"), columns={"reading": "Anzeige_mm"}),
    text("beyond-the-gauge", HEAD + "xy;zero;500,5\n", "{}:2: reading_mm is 500.5; expected a "
         "number within ±300, the limit of this kind of sensor; for readings in µm or in "
         "hundredths of a mm use `orthocal import` with `--unit um` or `--unit hundredths`"),
    text("nothing", "", "{}: is empty; expected the headings setup, posture and reading"),
    text("no-rows", HEAD, "{}: holds no readings"),
    text("open-quote", f'{HEAD}xy;"zero;0,5\n', "{}:2: is not valid CSV: unexpected end of data"),
    Form("control-characters", b"\x00\x01\x02\x03" * 9,
         "{}:1: contains the control character 0x00; expected text (utf-8)"),
    Form("half-utf8", b"\xef\xbb\xbfsetup\xff", "{}: is not utf-8 text (byte 8)"),
    Form("requested-utf8", GERMAN.replace("-0", "–0").encode("cp1252"),
         "{}: is not utf-8 text (byte 59)", {"encoding": "utf-8"}),
    Form("old-workbook", b"\xd0\xcf\x11\xe0" + bytes(600),
         "{}: is an old .xls, or protected by a password; save it as .xlsx or CSV"),
    book("workbook", CELLS),
    book("workbook-with-a-title", [["Protokoll"], [], *CELLS]),
    book("workbook-of-texts", [CELLS[0], ["xy", "zero", "0,00"], ["xy", "x_max", "−0,43"],
                               ["yx", "zero", "1,5"]]),
    book("workbook-of-both", [CELLS[0], ["xy", "zero", "0,00"], *CELLS[2:]]),
    book("workbook-merged", [*CELLS[:2], [None, "x_max", -0.43], CELLS[3]], edit=merge),
    book("workbook-not-merged", [*CELLS[:2], [None, "x_max", -0.43]],
         "{}: sheet 'Tabelle1' row 3: has a reading but no setup; --fill copies the setup from the "
         "row above"),
    book("workbook-merged-readings", [*CELLS[:2], ["xy", "x_max"]],
         "{}: sheet 'Tabelle1' C2: is merged with cells below; expected one cell for each reading",
         edit=lambda made: made.worksheets[0].merge_cells("C2:C3")),
    book("workbook-date", [*CELLS[:2], ["xy", "x_max", datetime.date(2026, 5, 1)]],
         "{}: sheet 'Tabelle1' C3: the reading is the date 2026-05-01 00:00:00; expected a number: "
         "the spreadsheet program took the typed number for a date"),
    book("workbook-truth", [CELLS[0], ["xy", "zero", True]],
         "{}: sheet 'Tabelle1' C2: the reading is TRUE; expected a number"),
    book("workbook-unsaved-formula", [CELLS[0], ["xy", "zero", "=1+1"]],
         "{}: sheet 'Tabelle1' C2: the reading is a formula without a saved value: open the "
         "workbook in a spreadsheet program and save it"),
    book("workbook-percentage", [CELLS[0], ["xy", "zero", 0.12]],
         "{}: sheet 'Tabelle1' C2: the reading is 0.12, shown as a percentage or in thousands; "
         "format its cell as a plain number",
         edit=in_sheet("C2", number_format="0%")),
    book("workbook-unit-of-a-format", [["setup", "posture", "value"], ["xy", "zero", 12.5]],
         one("12.5", unit="um"), edit=in_sheet("C2", number_format='0.0" µm"')),
    book("workbook-digits-as-shown", [CELLS[0], ["xy", "zero", 0.1 + 0.2]], one("0.3")),
    book("workbook-numbers-as-names", [["setup", "posture", "1", 2], ["xy", "zero", 0.01, -0.02],
                                       ["xy", "x_max", 0.5, 0.52]], WIDE, unit="mm"),
    book("workbook-sheets", {"Notizen": [["nichts"]], "Messung": CELLS}),
    book("workbook-two-sheets", {"Montag": CELLS, "Dienstag": CELLS},
         "{}: several sheets have the headings setup, posture and reading: 'Montag', 'Dienstag'; "
         "choose one by --sheet NAME"),
    book("workbook-chosen-sheet", {"Montag": CELLS[:2], "Dienstag": CELLS}, sheet="dienstag"),
    book("workbook-hidden-sheet", {"Montag": CELLS, "Dienstag": CELLS}, edit=hide_second),
    book("workbook-no-such-sheet", {"Montag": CELLS},
         "{}: has no sheet 'Mittwoch'; sheets: 'Montag'", sheet="Mittwoch"),
    book("workbook-no-readings", {"Montag": [["a", "b"]], "Dienstag": [["c"]]},
         "{}: no sheet has the headings setup, posture and reading; sheets: 'Montag', 'Dienstag'"),
    Form("archive", b"PK\x03\x04" + bytes(50), "{}: is not a readable .xlsx workbook: File is "
         "not a zip file"),
    text("sheet-of-a-csv", ENGLISH, "--sheet: applies to .xlsx workbooks only; {} is not one",
         sheet="a"),
    text("no-such-separator", ENGLISH, "--separator: '!' is not a separator; expected one of "
         "semicolon, tab, comma, pipe", separator="!"),
    text("no-such-encoding", ENGLISH, "--encoding: 'x' is not an encoding; expected one of utf-8, "
         "utf-16, utf-16-le, utf-16-be, cp1252, latin-1, cp1250, cp850, cp437, mac-roman",
         encoding_option="x"),
    text("no-such-unit", ENGLISH, "--unit: 'm' is not a unit of readings; expected mm, um, inch, "
         "cm, thou, hundredths", unit="m"),
    text("no-such-decimal", ENGLISH, "--decimal: ',' is not a decimal sign; expected point, comma",
         decimal=","),
    text("no-such-role", ENGLISH, "--column: 'date' is not the role of a column; expected one of "
         "setup, posture, minus, cycle, approach, temperature, time, reading, x, y, z, nominal x, "
         "nominal y, nominal z, or reading 1, "
         "reading 2 ... for cycles side by side", columns={"date": "setup"}),
    text("no-such-column", ENGLISH, "{}: no row has the headings setup, posture and reading; row 1 "
         "has 'setup', 'posture', 'reading_mm' with comma as separator; assign columns by "
         "--column ROLE=HEADING", columns={"setup": "Aufbau"}),
    Form("mac-roman", GERMAN.replace("-0", "–0").encode("mac-roman"), THREE,
         {"encoding": "mac-roman"}),
    Form("mac-roman-undetected", GERMAN.replace("-0", "–0").encode("mac-roman"),
         "{}:3: the reading is 'Ð0,43'; expected a number"),
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("session")
    shutil.copytree(ROOT / "tests/robots/biglide", made / "machine")
    (made / "session.yaml").write_text(SESSION)
    return made


@pytest.fixture
def session(folder):
    yield folder
    (folder / "readings.csv").unlink(missing_ok=True)


def read(session, form):
    """Import of a form, or the message of its refusal."""
    table = session / "table"
    table.write_bytes(form.content)
    options = {k.replace("encoding_option", "encoding"): v for k, v in form.options.items()}
    try:
        found = import_readings(table, session, TableOptions(**options))
    except SessionError as e:
        return str(e).replace(str(table), "{}")
    write_import(found)
    return found


def test_names_of_forms_are_unique():
    assert len({form.name for form in FORMS}) == len(FORMS)


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.name)
def test_a_table_is_imported_exactly_or_refused(form, session):
    found = read(session, form)
    if isinstance(form.expected, str):
        assert found == form.expected
        assert not (session / "readings.csv").exists()
        return
    assert not isinstance(found, str), found
    rows = [
        (r.setup, r.posture, r.minus, int(r.cycle or 1), Decimal(r.reading_mm))
        for r in found.long_table.rows
    ]
    assert rows == [(*key, Decimal(value)) for *key, value in form.expected]
    again = load_session(session)
    loaded = [(r.setup, r.posture, r.minus or "", r.cycle, r.value) for r in again.readings]
    assert loaded == [(*key, float(Decimal(value)) * 1e-3) for *key, value in form.expected]


# ---- into a session

PLANNED = "setup,posture,cycle,reading_mm\nxy,zero,1,\nxy,x_max,1,\nxy,zero,2,\nxy,x_max,2,\n"


def put(session, table, readings=PLANNED):
    (session / "table.csv").write_text(table, encoding="utf-8")
    if readings is not None:
        (session / "readings.csv").write_text(readings)
    return session / "table.csv"


def test_a_planned_session_is_filled_in_its_order(session):
    table = put(session, "setup;posture;Zyklus 1 [mm];2 [mm]\nxy;x_max;0,5;\nxy;zero;0,01;-0,02\n")
    code, out, err = orthocal("import", table, session)
    assert (code, err) == (0, f"Wrote {session}/readings.csv\n")
    assert (session / "readings.csv").read_text() == (
        "setup,posture,cycle,reading_mm\nxy,zero,1,0.01\nxy,x_max,1,0.50\nxy,zero,2,-0.02\n"
        "xy,x_max,2,\n"
    )
    assert out.splitlines() == [
        f"3 readings in {table}",
        "  encoding       utf-8 (ASCII only)",
        "  separator      semicolon (detected from the headings)",
        "  decimal sign   comma (from '0,5' in row 2)",
        "  unit           mm (stated in the table)",
        "  setup          'setup'",
        "  posture        'posture'",
        "  reading        'Zyklus 1 [mm]' as cycle 1, '2 [mm]' as cycle 2",
        "  empty          1 reading: row 2",
        f"{session}/readings.csv: 3 filled in; 1 row still without a reading",
    ]


def test_later_imports_add_readings(session):
    first = put(session, HEAD + "xy;zero;0,01\n")
    assert orthocal("import", first, session)[0] == 0
    second = put(session, HEAD + "xy;zero;0,010\nxy;x_max;0,5\nyx;zero;1\n", None)
    code, out, _ = orthocal("import", second, session)
    assert code == 0
    assert out.endswith(
        "1 filled in, 1 added, 1 unchanged; 2 rows still without a reading\n"
        "In addition to the rows of the session: row 4 of the table.\n"
    )
    rows = (session / "readings.csv").read_text().splitlines()
    assert rows[1:] == ["xy,zero,1,0.01", "xy,x_max,1,0.50", "xy,zero,2,", "xy,x_max,2,",
                        "yx,zero,1,1.00"]  # fmt: skip
    before = (session / "readings.csv").stat()
    code, _, err = orthocal("import", second, session)
    assert (code, err) == (0, "Nothing written: the session already has all readings\n")
    assert (session / "readings.csv").stat().st_mtime_ns == before.st_mtime_ns


def test_an_existing_reading_is_overwritten_with_replace_only(session):
    there = PLANNED.replace("zero,1,", "zero,1,0.02")
    table = put(session, HEAD + "xy;zero;0,01\n", there)
    code, out, err = orthocal("import", table, session)
    assert (code, out) == (2, "")
    assert err == (
        f"orthocal: {session}/readings.csv:2: xy zero of cycle 1 is 0.02 mm, but 0.01 mm in "
        f"{table}:2; --replace overwrites existing readings\n"
    )
    assert (session / "readings.csv").read_text() == there
    code, out, _ = orthocal("import", table, session, "--replace")
    assert code == 0
    assert "1 replaced" in out
    assert "zero,1,0.01\n" in (session / "readings.csv").read_text()


def test_a_dry_run_prints_the_same_and_writes_nothing(session):
    table = put(session, HEAD + "xy;zero;0,01\n")
    code, out, err = orthocal("import", table, session, "--dry-run")
    assert (code, err) == (0, "Nothing written (--dry-run)\n")
    assert (session / "readings.csv").read_text() == PLANNED
    assert orthocal("import", table, session)[1] == out


def test_json_report(session):
    table = put(session, "Setup;posture;T;Wert\nXY;zero;21;-12,5;gut\n;;;\nxy;x_max;21;\nEnde\n")
    code, out, _ = orthocal("import", table, session, "--json", "--unit", "um")
    assert code == 0
    document = json.loads(out)
    assert document["readings"] == [
        {"row": 2, "setup": "xy", "posture": "zero", "minus": None, "cycle": 1,
         "reading_mm": -0.0125}
    ]  # fmt: skip
    assert document["units"] == ["um"]
    assert (document["encoding"], document["separator"]) == ("utf-8", "semicolon")
    assert document["decimal"] == "comma"
    assert document["unused"] == ["'T'"]
    assert document["skipped"] == [
        {"row": 2, "reason": "1 cell without a heading"}, {"row": 5, "reason": "no reading"}
    ]  # fmt: skip
    assert document["rows_without_reading"] == [4]
    assert document["renamed"] == {"XY": "xy"}
    assert document["written"] == f"{session}/readings.csv"
    assert (document["filled"], document["empty"]) == (1, 3)


def test_the_readings_csv_itself_is_rewritten_with_replace_only(session):
    own = session / "readings.csv"
    german = "Aufstellung;Stellung;Notiz;Wert_mm\nxy;zero;a;1,234\nxy;x_max;b;\n"
    put(session, "", german)
    code, _, err = orthocal("import", own, session, "--decimal", "comma")
    assert code == 2
    assert err == (
        f"orthocal: {own}: is the session's own table; --replace rewrites it with its readings "
        "only\n"
    )
    assert own.read_text() == german
    assert orthocal("import", own, session, "--decimal", "comma", "--replace")[0] == 0
    assert own.read_text() == "setup,posture,reading_mm\nxy,zero,1.234\nxy,x_max,\n"


def test_readings_that_contradict_the_session_are_refused(session):
    table = put(session, "setup;posture;minus;reading_mm\nxy;x_max;zero;0,5\n", PLANNED)
    code, _, err = orthocal("import", table, session)
    assert code == 2
    assert "setup xy has both readings and differences in cycle 1; keep the readings only" in err
    assert (session / "readings.csv").read_text() == PLANNED


# ---- a session's readings.csv

CLEAN = {
    "semicolons": "setup;posture;reading_mm\nxy;zero;0,00\nxy;x_max;-0,43\nyx;zero;1,5\n",
    "german": GERMAN,
    "quoted": 'setup,posture,reading_mm\nxy,zero,0\nxy,x_max,"-0,43"\nyx,zero,"1,5"\n',
    "typographic": ENGLISH.replace("-", "−"),
    "tabs": ENGLISH.replace(",", "\t"),
    "trailing": GERMAN.replace("\r\n", ";;\r\n"),
    "capitals": ENGLISH.replace("setup,posture", "Setup,Posture"),
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "cp1252"])
@pytest.mark.parametrize("table", CLEAN.values(), ids=CLEAN.keys())
def test_a_clean_table_is_read_as_readings_csv(table, encoding, session):
    if encoding == "cp1252":
        table = table.replace("−", "–")
    (session / "readings.csv").write_bytes(table.encode(encoding))
    found = load_session(session).readings
    assert [(r.setup, r.posture, "", r.cycle) for r in found] == [key[:4] for key in THREE]
    assert [r.value for r in found] == [float(value) * 1e-3 for *_, value in THREE]
    assert [r.line for r in found] == [2, 3, 4]


# ---- conditions

SIDES = """setup,posture,cycle,reading_mm,approach
xy,zero,1,,pp
xy,zero,1,,nn
xy,x_max,1,,nn
"""


@pytest.mark.parametrize(
    ("heading", "cells", "expected"),
    [
        ("temperature_C", ("21.5", "", "22"), [21.5, None, 22.0]),
        ("Temperatur [°C]", ("21,5", "−1", "22 °C"), [21.5, -1.0, 22.0]),
        ("Temperatur [°C]", ("21,5", "-", "–"), [21.5, None, None]),
        ("temperature", ("70 °F", "21", "68 deg F"), [21.111, 21.0, 20.0]),
        ("Temperature (F)", ("70", "68", "21 °C"), [21.111, 20.0, 21.0]),
        ("temp", ("20", "70", ""), "the temperature '70' may be in °C or °F"),
        ("temperature_C", ("20", "700", ""), "temperature_C is 700; expected degrees Celsius"),
        ("temperature_C", ("20", "warm", ""), "temperature_C is 'warm'"),
    ],
)
def test_temperatures_of_a_table(heading, cells, expected, session):
    head, *rows = GERMAN.splitlines()
    lines = [f"{head};{heading}", *(f"{r};{c}" for r, c in zip(rows, cells, strict=True))]
    found = read(session, text("warm", "\n".join(lines)))
    if isinstance(expected, str):
        assert expected in found
        return
    loaded = [r.conditions and r.conditions.temperature for r in load_session(session).readings]
    assert loaded == expected


def test_temperatures_have_the_unit_of_their_number_format(session):
    rows = [["setup", "posture", "reading [mm]", "temperature"], ["xy", "zero", 0.5, 41]]
    form = book("fahrenheit", rows, edit=in_sheet("D2", number_format='0.0 "°F"'))
    assert [float(r.temperature_C) for r in read(session, form).long_table.rows] == [5.0]


def test_merged_cells_of_conditions_apply_to_all_their_rows(session):
    conditions = ["approach", "temperature_C", "time"], ["pp", 21.5, "2025-03-14T09:26:00"]
    head, first, second, third = CELLS
    rows = [[*head, *conditions[0]], [*first, *conditions[1]], second, third]

    def merge_conditions(made):
        for column in "DEF":
            made.worksheets[0].merge_cells(f"{column}2:{column}3")

    found = read(session, book("merged", rows, edit=merge_conditions))
    assert not isinstance(found, str), found
    *merged, other = [r.conditions for r in load_session(session).readings]
    assert other is None
    for read_back in merged:
        assert read_back.approach == "pp"
        assert read_back.temperature == 21.5
        assert read_back.time == datetime.datetime.fromisoformat(conditions[1][2])


def test_times_of_a_table(session):
    """Dates of German tables too; clock times alone are no column of a session."""
    times = ("14.03.2025 9:26", "14.3.2025 09:28:10", "2025-03-14 09:30")
    head, *rows = GERMAN.splitlines()
    lines = [f"{head};Datum und Uhrzeit", *(f"{r};{c}" for r, c in zip(rows, times, strict=True))]
    assert not isinstance(read(session, text("day", "\n".join(lines))), str)
    found = [r.conditions.time.isoformat() for r in load_session(session).readings]
    assert found == ["2025-03-14T09:26:00", "2025-03-14T09:28:10", "2025-03-14T09:30:00"]
    (session / "readings.csv").unlink()
    clock = [f"{head};Zeitpunkt", *(f"{r};9:26" for r in rows)]
    read(session, text("clock", "\n".join(clock)))
    assert {r.conditions for r in load_session(session).readings} == {None}
    refused = read(session, text("clock", "\n".join(clock), columns={"time": "Zeitpunkt"}))
    assert "time is '9:26'" in refused


def test_planned_sides_are_matched_or_asked_for(session):
    """The only reading of a posture needs no approach in the table; two need it."""
    table = put(session, "setup;posture;Messwert [mm]\nxy;x_max;0,5\n", SIDES)
    assert orthocal("import", table, session)[0] == 0
    assert "xy,x_max,0.50,nn\n" in (session / "readings.csv").read_text()
    table = put(session, "setup;posture;Messwert [mm]\nxy;zero;0,5\n", None)
    before = (session / "readings.csv").read_text()
    code, _, err = orthocal("import", table, session)
    assert code == 2
    assert f"{table}:2: xy zero of cycle 1 is read from several sides (pp, nn)" in err
    assert (session / "readings.csv").read_text() == before
    lines = "setup;posture;Messwert [mm];Anfahrrichtung\nxy;zero;0,5;NN\nxy;zero;0,4;PP\n"
    assert orthocal("import", put(session, lines, None), session)[0] == 0
    assert (session / "readings.csv").read_text().splitlines()[1:] == [
        *("xy,zero,0.40,pp", "xy,zero,0.50,nn", "xy,x_max,0.50,nn")
    ]
