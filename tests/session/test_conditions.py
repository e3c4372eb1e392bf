"""Conditions of readings: in files, joined sessions, recordings, imports and records."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
from commands import run_orthocal

from orthocal import (
    Choice,
    import_readings,
    load_calibration,
    load_plan,
    load_session,
    reading_table,
    restore_session,
    write_calibration,
    write_import,
    write_session,
)
from orthocal.assessment.repeated_readings import find_scattered
from orthocal.calibration.identify import identify
from orthocal.errors import CalibrationFileError, SessionError
from orthocal.measurement.importing.import_readings import TableOptions
from orthocal.measurement.joining import join_sessions, split_sessions
from orthocal.measurement.recorded_rows import Change
from orthocal.measurement.recording import SUFFIX, open_recording
from orthocal.observation.observations import build_observations
from orthocal.output.text.import_report import format_import
from orthocal.session.session import Conditions
from orthocal.statistics.noise import estimate_repeatability
from orthocal.units import MM

SESSION = """robot: orthoglide
calibration: {model: offsets}
gauge: {sigma_mm: 0.005, range_mm: [-5, 5]}
postures:
  zero: {tcp_mm: [0, 0, 0]}
  x_max: {tcp_mm: [60, 0, 0]}
  x_min: {tcp_mm: [-100, 0, 0]}
  y_max: {tcp_mm: [0, 60, 0]}
setups:
  yx: {leg: x, direction: y, section: {fraction: 0.5}}
  xy: {leg: y, direction: x, section: {fraction: 0.5}}
readings: readings.csv
"""

TABLE = """setup,posture,cycle,reading_mm,approach,temperature_C,time
yx,zero,1,0.01,ppp,21.5,2025-03-14T09:26:53+01:00
yx,zero,1,0.03,npp,21.5,2025-03-14T09:27:53+01:00
yx,x_max,1,-0.43,puu,,2025-03-14T09:29:00+01:00
yx,x_min,1,0.12,,22.25,
yx,x_min,2,0.13,,,
xy,zero,1,0.2,uuu,,
xy,y_max,1,-0.3,,20,2025-03-14T11:00:00+01:00
"""

BERLIN = timezone(timedelta(hours=1))


def write(folder, table=TABLE):
    folder.mkdir(exist_ok=True)
    (folder / "session.yaml").write_text(SESSION)
    (folder / "readings.csv").write_text(table)
    return folder


@pytest.fixture
def session(tmp_path):
    return load_session(write(tmp_path / "first"))


# ---- files


def test_each_reading_has_its_conditions(session):
    stated = [r.conditions for r in session.readings]
    time = datetime(2025, 3, 14, 9, 26, 53, tzinfo=BERLIN)
    assert stated[0] == Conditions("ppp", 21.5, time)
    assert stated[2].temperature is None
    assert stated[3] == Conditions(temperature=22.25)
    assert stated[4] is None
    assert [r.approach for r in session.readings] == ["ppp", "npp", "puu", None, None, None, None]


def test_conditions_are_written_as_they_were_read(session, tmp_path):
    write_session(session, tmp_path / "second")
    assert (tmp_path / "second/readings.csv").read_text() == TABLE.replace(
        ",0.2,", ",0.20,"
    ).replace(",-0.3,", ",-0.30,")
    again = load_session(tmp_path / "second")
    assert [r.conditions for r in again.readings] == [r.conditions for r in session.readings]


def test_empty_columns_are_not_written(session, tmp_path):
    plain = replace(
        session, readings=tuple(replace(r, conditions=None) for r in session.readings[1:])
    )
    write_session(plain, tmp_path / "second")
    header = (tmp_path / "second/readings.csv").read_text().partition("\n")[0]
    assert header == "setup,posture,cycle,reading_mm"


def test_the_formats_of_a_spreadsheet_are_read(tmp_path):
    table = (
        "setup;posture;reading_mm;approach;temperature_C;time\n"
        "yx;zero;0,01;ppp;21,5;2025-03-14 09:26\nyx;zero;0,02;npp;20.125;\n"
    )
    found = load_session(write(tmp_path / "first", table)).readings
    assert found[0].conditions == Conditions("ppp", 21.5, datetime(2025, 3, 14, 9, 26))
    assert found[1].value == pytest.approx(0.02e-3)
    assert found[1].conditions.temperature == 20.125


def test_times_without_zone_are_kept(tmp_path):
    table = "setup,posture,reading_mm,time\nyx,zero,0.01,2025-03-14T09:26:53.5\n"
    found = load_session(write(tmp_path / "first", table))
    assert found.readings[0].conditions.time == datetime(2025, 3, 14, 9, 26, 53, 500_000)
    write_session(found, tmp_path / "second")
    assert "2025-03-14T09:26:53.500000" in (tmp_path / "second/readings.csv").read_text()


def test_times_with_and_without_zone_are_refused(tmp_path):
    table = TABLE.replace("2025-03-14T11:00:00+01:00", "2025-03-14T11:00:00")
    with pytest.raises(SessionError) as caught:
        load_session(write(tmp_path / "first", table))
    assert caught.value.where.endswith("readings.csv:8")


# ---- repeats


def test_readings_with_different_approaches_are_no_repeats(session, tmp_path):
    o = build_observations(session)
    assert o.place[0] != o.place[1]
    assert o.place[3] == o.place[4]
    assert o.posture[0] == o.posture[1]
    scatter, dof = estimate_repeatability(o.values(session.values), o)
    assert dof == 1
    assert scatter == pytest.approx(0.01e-3 / np.sqrt(2.0))
    with pytest.raises(SessionError, match="repeats"):
        load_session(write(tmp_path / "other", TABLE.replace("npp", "ppp")))


def test_backlash_is_no_scatter_of_the_gauge(tmp_path):
    """Two approaches 60 µm apart, each read twice within 2 µm, by a dial of 5 µm."""
    rows = ["setup,posture,cycle,reading_mm,approach"]
    for cycle, off in enumerate((0.0, 0.002), start=1):
        for posture in ("zero", "x_max", "x_min"):
            for approach, step in (("ppp", 0.0), ("nnn", 0.06)):
                rows.append(f"yx,{posture},{cycle},{0.1 + off + step},{approach}")
    session = load_session(write(tmp_path / "first", "\n".join(rows) + "\n"))
    assert not find_scattered(session)
    unstated = [replace(r, conditions=None) for r in session.readings]
    assert find_scattered(session.select(unstated))


# ---- joined and repeated sessions


def test_joined_sessions_keep_conditions(session, tmp_path):
    other = load_session(write(tmp_path / "second", TABLE.replace("+01:00", "")))
    joined = join_sessions([session, other])
    stated = [r.conditions for r in (*session.readings, *other.readings)]
    assert [r.conditions for r in joined.readings] == stated
    assert [len(s.readings) for s in split_sessions(joined)] == [7, 7]
    o = build_observations(joined)  # times with and without zone, in different setups
    assert np.array_equal(o.conditions["time"][:7], o.conditions["time"][7:])
    assert session.with_values(session.values + 1e-6).readings[0].conditions == stated[0]
    assert session.select(session.readings[2:4]).readings[0].conditions == stated[2]


def test_a_repeated_session_plans_the_approaches(tmp_path, raw_cycles):
    first = raw_cycles
    stated = Conditions("ppp", 21.0, datetime(2025, 3, 14, tzinfo=UTC))
    readings = tuple(replace(r, conditions=stated) for r in first.readings)
    write_session(replace(first, readings=readings), tmp_path / "first")
    result, _ = identify(load_session(tmp_path / "first"), "offsets", solver="variable-projection")
    write_calibration(result, tmp_path / "calibration.json")
    words = ["again", "calibration.json", "--out", "second", "--anyway"]
    done = run_orthocal(tmp_path, *words)
    assert done.returncode == 0, done.stderr
    lines = (tmp_path / "second/readings.csv").read_text().splitlines()
    assert lines[0] == "setup,posture,cycle,reading_mm,approach,temperature_C,time"
    assert all(line.endswith(",,ppp,,") for line in lines[1:])
    assert {r.conditions for r in load_plan(tmp_path / "second").readings} == {Conditions("ppp")}


# ---- recordings


PLANNED = """setup,posture,reading_mm,approach,temperature_C
yx,zero,,ppp,
yx,zero,,nnn,
yx,x_max,,,21.5
"""


def rows_of(folder):
    return (folder / "readings.csv").read_text().splitlines()[1:]


def test_a_recording_keeps_planned_and_adds_stated_conditions(tmp_path):
    folder = write(tmp_path / "first", PLANNED)
    time = datetime(2025, 3, 14, 9, 30)
    with open_recording(folder) as recording:
        assert [row.key[4:] for row in recording.rows] == [("ppp",), ("nnn",), ()]
        recording.read(0, 0.01 * MM, Conditions(temperature=20.5, time=time))
        recording.read(1, 0.02 * MM)
        recording.read(2, 0.03 * MM, Conditions(approach="pnu"))
        repeated = recording.repeat(1)
        assert recording.rows[repeated].key == ("yx", "zero", None, 2, "nnn")
        assert recording.rows[repeated].place == recording.rows[1].place
    assert rows_of(folder) == [
        "yx,zero,1,0.01,ppp,20.5,2025-03-14T09:30:00",
        "yx,zero,1,0.02,nnn,,",
        "yx,x_max,1,0.03,pnu,21.5,",
        "yx,zero,2,,nnn,,",
    ]
    with open_recording(folder) as recording:
        recording.empty(0)  # planned approaches are kept
    assert rows_of(folder) == [
        *("yx,zero,1,,ppp", "yx,zero,1,,nnn", "yx,x_max,1,,", "yx,zero,2,,nnn")
    ]


def test_a_typed_approach_is_corrected_and_deleted_with_its_reading(tmp_path):
    """Also in later recordings; a planned approach stays."""
    folder = write(tmp_path / "first", PLANNED)
    with open_recording(folder) as recording:
        recording.read(0, 0.01 * MM)
        recording.read(2, 0.03 * MM, Conditions("pnu"))
        recording.read(2, 0.04 * MM)
    assert rows_of(folder)[2] == "yx,x_max,0.04,pnu,21.5"
    with open_recording(folder) as recording:
        assert [row.planned_approach for row in recording.rows] == ["ppp", "nnn", None]
        recording.read(2, 0.04 * MM, Conditions("uuu"))
    with open_recording(folder) as recording:
        recording.read(2, 0.05 * MM, Conditions("nnp", temperature=22.0))
        repeated = recording.repeat(2)
        assert recording.rows[repeated].key == ("yx", "x_max", None, 2)
        recording.drop(repeated)
    assert rows_of(folder) == ["yx,zero,0.01,ppp,", "yx,zero,,nnn,", "yx,x_max,0.05,nnp,22"]
    with open_recording(folder) as recording:
        recording.empty(2)
        assert [row.approach for row in recording.rows] == ["ppp", "nnn", None]


def test_an_approach_that_the_table_states_is_planned(tmp_path):
    """Even if such a row was read in the journal of a plan that stated no approach."""
    folder = write(tmp_path / "first", PLANNED)
    with open_recording(folder) as recording:
        recording.read(2, 0.03 * MM, Conditions("pnu"))
    (folder / "readings.csv").write_text(PLANNED.replace("x_max,,", "x_max,,pnu"))
    for _ in range(2):
        with open_recording(folder) as recording:
            assert recording.rows[2].planned_approach == "pnu"
            recording.read(2, 0.03 * MM)
    with open_recording(folder) as recording:
        recording.empty(2)
        assert recording.rows[2].approach == "pnu"


def test_an_approach_is_not_typed_if_two_rows_became_the_same(tmp_path):
    folder = write(tmp_path / "first", PLANNED + "yx,zero,,,\n")
    with open_recording(folder) as recording:
        with pytest.raises(SessionError, match="exists already"):
            recording.read(3, 0.0, Conditions("nnn"))
        recording.read(3, 0.0, Conditions("pnp"))
        repeated = recording.repeat(3)
        assert recording.rows[repeated].key == ("yx", "zero", None, 2)


def test_the_journal_restores_conditions(tmp_path):
    folder = write(tmp_path / "first", PLANNED)
    with open_recording(folder) as recording:
        before = (folder / "readings.csv").read_bytes()
        recording.read(1, 0.02 * MM, Conditions(temperature=20.5))
        recording.read(2, 0.02 * MM, Conditions("pnp"))
        after = (folder / "readings.csv").read_bytes()
        journal = (folder / f"readings.csv{SUFFIX}").read_bytes()
    (folder / "readings.csv").write_bytes(before)
    (folder / f"readings.csv{SUFFIX}").write_bytes(journal)  # not closed
    assert json.loads(journal.splitlines()[-2])["conditions"] == {"temperature_C": 20.5}
    with open_recording(folder) as recording:
        assert recording.restored == 2
        assert [row.planned_approach for row in recording.rows] == ["ppp", "nnn", None]
    assert (folder / "readings.csv").read_bytes() == after


def test_a_recording_refuses_impossible_conditions(tmp_path):
    folder = write(tmp_path / "first", PLANNED)
    with open_recording(folder) as recording:
        for wrong in (Conditions("pp"), Conditions(temperature=300.0)):
            with pytest.raises(SessionError, match="expected"):
                recording.read(0, 0.0, wrong)
        with pytest.raises(SessionError, match="the plan states the approach ppp"):
            recording.read(0, 0.0, Conditions("nnn"))
        assert recording.missing == (0, 1, 2)
        recording.read(0, 0.0, Conditions("ppp"))
        assert recording.rows[0].planned_approach == "ppp"
    with pytest.raises(ValueError, match="approach"):
        Change.model_validate(
            {"done": "read", "rows": [["yx", "zero", None, 1]], "conditions": {"approach": "x"}}
        )


# ---- imports


IMPORTED = """Setup;Posture;Reading [mm];Approach;temperature_C;Time;Note
yx;zero;0,01;ppp;21,5;2025-03-14 09:26;a
yx;zero;0,02;nnn;21,5;2025-03-14 09:27;b
yx;x_max;0,03;;;;c
"""


def imported(folder, text=IMPORTED, *, overwrite=False, **options):
    table = folder.parent / "table.csv"
    table.write_text(text)
    return import_readings(table, folder, TableOptions(**options), overwrite=overwrite)


def test_an_import_fills_the_rows_of_the_same_approach(tmp_path):
    folder = write(tmp_path / "first", PLANNED)
    result = imported(folder)
    assert (result.filled, result.added, result.replaced) == (3, 0, 0)
    write_import(result)
    assert rows_of(folder) == [
        "yx,zero,0.01,ppp,21.5,2025-03-14 09:26",
        "yx,zero,0.02,nnn,21.5,2025-03-14 09:27",
        "yx,x_max,0.03,,21.5,",
    ]
    assert not imported(folder).changes
    assert load_session(folder).readings[1].conditions.temperature == 21.5


def test_an_import_matches_rows_with_one_stated_approach(tmp_path):
    folder = write(tmp_path / "first", "setup,posture,reading_mm\nyx,zero,0.01\nyx,x_max,\n")
    result = imported(folder, "setup,posture,reading_mm,approach\nyx,zero,0.01,ppp\n")
    assert (result.filled, result.added) == (1, 0)
    other = write(tmp_path / "other", "setup,posture,reading_mm,approach\nyx,zero,,ppp\n")
    with pytest.raises(SessionError, match=r"is approached with 'nnn', but .*:2 plans 'ppp'"):
        imported(other, "setup,posture,reading_mm,approach\nyx,zero,0.01,nnn\n")
    table = "setup,posture,reading_mm,approach\nyx,zero,0.01,ppp\nyx,zero,0.02,nnn\n"
    result = imported(other, table)  # the other side in addition to the planned one
    assert (result.filled, result.unplanned) == (1, (3,))
    assert "In addition to the rows of the session: row 3 of the table." in format_import(result)


def test_an_import_changes_conditions_only_with_overwrite(tmp_path):
    folder = write(tmp_path / "first", "setup,posture,reading_mm,temperature_C\nyx,zero,0.01,20\n")
    table = "setup,posture,reading_mm,temperature_C\nyx,zero,0.01,21.0\n"
    with pytest.raises(SessionError, match=r"20 °C, but 0\.01 mm, 21\.0 °C"):
        imported(folder, table)
    assert imported(folder, table, overwrite=True).replaced == 1
    assert not imported(folder, table.replace("21.0", "20.0")).changes


# ---- records


def test_a_calibration_file_keeps_conditions(session, tmp_path):
    result, _ = identify(session, Choice("offsets", prior=True), solver="variable-projection")
    write_calibration(result, tmp_path / "calibration.json")
    again = load_calibration(tmp_path / "calibration.json")
    stated = [r.conditions for r in session.readings]
    assert [r.conditions for r in restore_session(again).readings] == stated
    table = reading_table(again)
    assert (table[0]["approach"], table[0]["temperature_C"]) == ("ppp", 21.5)
    assert table[0]["time"] == "2025-03-14T09:26:53+01:00"
    assert table[4]["approach"] is None
    assert again.residuals[0].label == session.readings[0].label != session.readings[1].label
    document = json.loads((tmp_path / "calibration.json").read_text())
    assert document["residuals"][3]["conditions"]["temperature_C"] == 22.25
    document["residuals"][0]["conditions"]["approach"] = "pp"
    (tmp_path / "calibration.json").write_text(json.dumps(document))
    with pytest.raises(CalibrationFileError) as caught:
        load_calibration(tmp_path / "calibration.json")
    assert caught.value.where.endswith("residuals[0].conditions")
