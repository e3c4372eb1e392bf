"""Property tests: readings of any spreadsheet dialect are imported exactly, or refused."""

from __future__ import annotations

import csv
import io
import itertools
import os
from decimal import Decimal
from pathlib import Path

import openpyxl
import pytest
from hypothesis import event, example, given, settings
from hypothesis import strategies as st

from orthocal.errors import SessionError
from orthocal.io.tables.delimited import SEPARATORS
from orthocal.io.tables.table import read_table
from orthocal.measurement.importing.headings import EXPECTED, UNITS, choose_columns, find_header
from orthocal.measurement.importing.long_table import make_long_table

NAMES = {"setup": ["xy", "yx"], "posture": ["zero", "x_max", "x_-40"]}
PLACES = [(s, p) for s in NAMES["setup"] for p in NAMES["posture"]]
EXAMPLES = int(os.environ.get("ORTHOCAL_EXAMPLES", "120"))
"""Number of examples; more in a long run."""

HEADINGS = {
    "english": ("setup", "posture", "cycle", "reading", "note"),
    "german": ("Aufstellung", "Stellung", "Zyklus", "Messwert", "Bemerkung"),
}
GROUPS = {"point": ["", ",", " ", "\u202f", "'"], "comma": ["", ".", " ", "\u00a0", "’"]}

readings = st.decimals(-9999, 9999, places=3) | st.integers(-9999, 9999).map(Decimal)
readings |= st.decimals(-3, 3, places=2) | st.integers(1, 9).map(lambda v: Decimal(v) * 1000)


def written(value: Decimal, *, decimal: str, group: str, minus: str, digits: int | None) -> str:
    """A number as a spreadsheet program shows it."""
    text = f"{abs(value):f}" if digits is None else f"{abs(value):.{digits}f}"
    whole, _, fraction = text.partition(".")
    if group and len(whole) > 3:
        whole = f"{int(whole):,}".replace(",", group)
    sign = minus if value < 0 else ""
    return sign + whole + ({"point": ".", "comma": ","}[decimal] + fraction if fraction else "")


@st.composite
def tables(draw):
    """A table in any dialect, and its readings in mm by setup, posture and cycle."""
    values = draw(st.lists(st.none() | readings, min_size=1, max_size=8))
    decimal = draw(st.sampled_from(["point", "comma"]))
    unit = draw(st.sampled_from(["mm", "um", "inch"]))
    separator = draw(st.sampled_from([*SEPARATORS.values()]))
    group = draw(st.sampled_from(GROUPS[decimal]))
    minus = draw(st.sampled_from("-−–"))
    digits = draw(st.sampled_from([None, 3]))
    quoting = draw(st.sampled_from(["where needed", "all", "never"]))
    form = draw(st.sampled_from(["long", "long, cycle behind", "wide", "noted"]))
    ragged = draw(st.booleans())
    setup, posture, cycle, reading, note = HEADINGS[draw(st.sampled_from([*HEADINGS]))]
    cells = [
        "" if v is None else written(v, decimal=decimal, group=group, minus=minus, digits=digits)
        for v in values
    ]
    truth = {}
    if form == "wide":
        count = draw(st.integers(1, 3))
        rows = [[setup, posture, *(f"{cycle} {i + 1} [{unit}]" for i in range(count))]]
        for at in range(0, len(cells), count):
            place = PLACES[at // count % len(PLACES)]
            block = at // count // len(PLACES)
            if block:
                break
            these = cells[at : at + count]
            rows.append([*place, *these, *[""] * (count - len(these))])
            truth |= {
                (*place, i + 1): v for i, v in enumerate(values[at : at + count]) if v is not None
            }
    else:
        heads = {"long": [cycle, f"{reading} [{unit}]"], "noted": ["T", f"{reading}_{unit}", note]}
        heads["long, cycle behind"] = [f"{reading} ({unit})", cycle]
        rows = [[setup, posture, *heads[form]]]
        temperature = written(Decimal("21.5"), decimal=decimal, group="", minus="-", digits=None)
        for at, (cell, value) in enumerate(zip(cells, values, strict=True)):
            place, number = PLACES[at % len(PLACES)], at // len(PLACES) + 1
            if form == "noted":
                if number > 1:
                    break
                rows.append([*place, temperature, cell, draw(st.sampled_from(["", "7", "gut"]))])
            else:
                given = [str(number), cell] if form == "long" else [cell, str(number)]
                rows.append([*place, *given])
            if value is not None:
                truth[(*place, number)] = value
    if ragged:
        rows = [row[: max((i + 1 for i, c in enumerate(row) if c), default=0)] for row in rows]
    if quoting == "never":
        text = "".join(separator.join(row) + "\r\n" for row in rows)
    else:
        stream = io.StringIO()
        how = csv.QUOTE_ALL if quoting == "all" else csv.QUOTE_MINIMAL
        csv.writer(stream, delimiter=separator, quoting=how).writerows(rows)
        text = stream.getvalue()
    encodings = ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252"]
    encoding = draw(st.sampled_from(encodings))
    content = text.encode(encoding, errors="replace")
    exact = {key: v if digits is None else round(v, digits) for key, v in truth.items()}
    return content, {key: v * UNITS[unit] for key, v in exact.items()}


def read(content: bytes, **options) -> dict[tuple[str, str, int], Decimal]:
    path = Path("table")
    table = read_table(path, content, find_header, expected=EXPECTED)
    columns = choose_columns(table.header, {}, where="table")
    long = make_long_table(table, columns, **{"names": NAMES, **options})
    found = {(r.setup, r.posture, int(r.cycle or 1)): Decimal(r.reading_mm) for r in long.rows}
    assert len(found) == len(long.rows)
    return found


UNQUOTED = b"setup,posture,cycle 1 [mm],cycle 2 [mm]\r\nxy,zero,1 000,000\r\n"
"""One number with a decimal comma, or two cells."""


@settings(max_examples=EXAMPLES, deadline=None)
@given(tables())
@example((UNQUOTED, {("xy", "zero", 1): Decimal("1000.000")}))
def test_any_dialect_is_imported_exactly_or_refused(table):
    content, truth = table
    try:
        found = read(content)
    except SessionError:
        event("refused")
        return
    event("exact")
    assert found == truth


DECISIVE = [Decimal("0.125"), Decimal("-1234.5"), Decimal(7), Decimal("1.234")]
"""Readings of which one at least is a number with one decimal sign only."""


@pytest.mark.parametrize("decimal", ["point", "comma"])
@pytest.mark.parametrize("separator", SEPARATORS)
def test_every_dialect_with_a_decisive_number_is_read(separator, decimal):
    encodings = ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252"]
    for encoding, minus, group in itertools.product(encodings, "-−–", GROUPS[decimal]):
        if encoding == "cp1252" and (minus == "−" or group == "\u202f"):
            continue
        stream = io.StringIO()
        rows = csv.writer(stream, delimiter=SEPARATORS[separator])
        rows.writerow(["Aufstellung", "Stellung", "Zyklus", "Messwert in µm"])
        for at, value in enumerate(DECISIVE):
            text = written(value, decimal=decimal, group=group, minus=minus, digits=None)
            rows.writerow(["xy", "zero", at + 1, text])
        found = read(stream.getvalue().encode(encoding))
        assert [*found.values()] == [value / 1000 for value in DECISIVE]


@settings(max_examples=30, deadline=None)
@given(st.lists(readings, min_size=1, max_size=6), st.booleans(), st.sampled_from([*UNITS]))
def test_numbers_of_a_workbook_are_imported_exactly(values, as_text, unit):
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.append(["Setup", "Posture", "Cycle", f"Reading [{unit}]"])
    for at, value in enumerate(values):
        plain = f"{value:f}".replace(".", ",")
        sheet.append(["xy", "zero", at + 1, plain if as_text else float(value)])
    stream = io.BytesIO()
    book.save(stream)
    try:
        found = read(stream.getvalue())
    except SessionError:
        assert as_text  # 1,234 alone is two numbers
        found = read(stream.getvalue(), decimal="comma")
    assert [*found.values()] == [value * UNITS[unit] for value in values]


@pytest.mark.parametrize(
    ("written", "expected"), [("x_max", "x_max"), ("X_MAX", "X_MAX"), ("X_Max", "X_Max")]
)
def test_a_name_that_two_names_of_the_session_match_is_not_replaced(written, expected):
    content = f"setup,posture,reading_mm\nXY,{written},1\n".encode()
    found = read(content, names={"setup": ["xy"], "posture": ["x_max", "X_MAX"]})
    assert found == {("xy", expected, 1): 1}
