"""Headings of tables of readings: role, cycle and unit."""

from __future__ import annotations

import pytest
from watchdog import cpu_limit

from orthocal.errors import SessionError
from orthocal.measurement.importing.headings import (
    LONGEST_HEADING,
    UNITS,
    choose_columns,
    read_heading,
)

MEANINGS = {
    "Setup": ("setup", None, None), "minus_posture": ("minus", None, None),
    "Messwert": ("reading", None, None), "Messwert 2 [mm]": ("reading", 2, "mm"),
    "2. Durchgang (µm)": ("reading", 2, "um"), "reading_mm_2": ("reading", 2, "mm"),
    "reading_in_mm": ("reading", None, "mm"), "Wert in mm": ("reading", None, "mm"),
    "reading (in inch)": ("reading", None, "inch"), "reading (in)": ("reading", None, "inch"),
    "reading_in": ("reading", None, "inch"), "reading_in_2": ("reading", 2, "inch"),
    "measured in": None, "reading [0.001 in]": ("reading", None, "thou"),
    "reading_0.001 inch": ("reading", None, "thou"),
    "reading in 0,001 inch": ("reading", None, "thou"),
    "Messwert [1/100 mm]": ("reading", None, "hundredths"),
    "Messwert in 1/100 mm": ("reading", None, "hundredths"),
    "reading (0,01 mm)": ("reading", None, "hundredths"),
    "reading 2 [hundredths of a mm]": ("reading", 2, "hundredths"),
    "Ablesung in hundertstel mm": ("reading", None, "hundredths"),
    "reading [1/1000 mm]": ("reading", None, "um"), "reading 0.001 mm": ("reading", None, "um"),
    "reading [1/1000 in]": ("reading", None, "thou"), "reading [1/10 mm]": None,
    "reading in 0.02 mm": None, "reading [10 um]": None, "reading mm um": None, "mm": None,
    "1": ("reading", 1, None), "#3 mm": ("reading", 3, "mm"), "setup 2": None,
    "temperature_C": ("temperature", None, None), "Temperatur [°C]": ("temperature", None, None),
    "temperature (deg F)": ("temperature", None, None),
    "Machine temperature in °F": ("temperature", None, None), "temp": ("temperature", None, None),
    "Temp. [°C]": ("temperature", None, None), "Wdh.": ("cycle", None, None), "reading [°C]": None,
    "Anfahrrichtung": ("approach", None, None), "Datum und Uhrzeit": ("time", None, None),
    "setup [mm]": None, "x" * 300: None,
}  # fmt: skip
"""Role, cycle and unit of headings."""


@pytest.mark.parametrize("text", MEANINGS)
def test_meaning_of_a_heading(text):
    heading = read_heading(text)
    assert (heading and (heading.role, heading.cycle, heading.unit)) == MEANINGS[text]


@pytest.mark.parametrize(
    ("heading", "unit"),
    [
        ("Uhr A [mm]", "mm"),
        ("Uhr_in_mm", "mm"),
        ("Uhr 0.001 inch", "thou"),
        ("Uhr [1/100 mm]", "hundredths"),
        ("Uhr 1/10 mm", None),
        ("Mikrometer [mm]", "mm"),
        ("Uhr mm um", None),
        ("Uhr", None),
    ],
)
def test_unit_of_an_assigned_column(heading, unit):
    columns = choose_columns(["setup", "posture", heading], {"reading": heading}, where="t")
    assert columns.readings[2].unit == unit
    assert unit is None or unit in UNITS


@pytest.mark.parametrize(
    "part", ["mm_", "mm ", "[", "[mm", "_in", "a (", "1 ", "\u0301\u0323", " ", "/ "]
)
def test_a_long_heading_takes_no_time(part):
    """A heading of 24 kB took more than a minute."""
    for length in (LONGEST_HEADING, 8_000, 200_000):
        heading = (part * length)[:length]
        with cpu_limit():
            read_heading(heading)
            with pytest.raises(SessionError):
                choose_columns([heading] * 3, {"setup": heading}, where="t")


def test_a_column_without_a_cycle_is_refused_with_the_numbered_ones():
    with pytest.raises(SessionError, match=r"'reading' \(#3\) and 'reading 2' \(#4\)"):
        choose_columns(["setup", "posture", "reading", "reading 2"], {}, where="t")
