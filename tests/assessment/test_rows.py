"""Tables row by row, from files and pipes: the same numbers as all at once, in bounded memory."""

from __future__ import annotations

import csv
import io
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from calibrated import EXPERIMENT_2, calibrated, identified
from commands import run_orthocal
from effect_plans import effect_plan

from orthocal import assess_tool, simulate_session
from orthocal.assessment import tool_tables as module
from orthocal.assessment.tool_error import Workspace
from orthocal.assessment.tool_tables import (
    accuracy_rows,
    forward_blocks,
    inverse_blocks,
    row_blocks,
)
from orthocal.calibration.file import write_calibration
from orthocal.cli import printing
from orthocal.effects.compensation import JointTrim
from orthocal.errors import SessionError
from orthocal.io.files import read_lines
from orthocal.kinematics.conditions import UseConditions
from orthocal.measurement.files import coordinate_tables
from orthocal.units import MM

OUT_OF_REACH = [0.0, 0.0, 0.9]
BEYOND_TRAVEL = [0.1, 0.0, 0.0]


@pytest.fixture(scope="module")
def calibration():
    return calibrated(EXPERIMENT_2)


@pytest.fixture(scope="module")
def compensated():
    """Calibration of a machine whose controller compensates another backlash than it has."""
    trims = tuple(JointTrim(amount) for amount in (0.1e-3, 0.06e-3, 0.02e-3))
    plan = replace(effect_plan("backlash"), compensation=trims)
    errors = {"x_slide.backlash": 0.03e-3, "y_slide.offset": 0.2e-3}
    return identified(simulate_session(plan, errors, seed=1).session, "full")


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(module, "CHUNK_SIZE", 7)


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(0).uniform(-0.05, 0.05, (20, 3))


def inverse_rows(calibration, points, names=None):
    return inverse_blocks(calibration, row_blocks(points, names))


def joined(chunks):
    return np.concatenate([c.values for c in chunks])


def test_chunks_equal_all_rows_at_once(calibration, points):
    chunks = list(inverse_rows(calibration, points))
    assert [c.first for c in chunks] == [0, 7, 14]
    drives = joined(chunks)
    assert drives == pytest.approx(calibration.machine.inverse(points), abs=1e-12)
    back = joined(forward_blocks(calibration, row_blocks(drives)))
    assert back == pytest.approx(points, abs=1e-12)
    whole = assess_tool(calibration, Workspace.even(points))
    found = joined(accuracy_rows(calibration, points))
    assert whole.after is not None
    sigma = np.sqrt(np.diagonal(whole.after.covariance, axis1=1, axis2=2))
    expected = np.hstack([whole.targets, whole.deviation, sigma])
    assert found == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("approach", ["ppp", "nnn", "pnp"])
def test_rows_of_a_compensated_machine_are_those_of_the_tool_error(compensated, points, approach):
    conditions = UseConditions(approach=approach)
    whole = assess_tool(compensated, Workspace.even(points), conditions=conditions)
    expected = np.sqrt(np.diagonal(whole.after.covariance, axis1=1, axis2=2))
    found = joined(accuracy_rows(compensated, points, conditions=conditions))
    assert found[:, 3:6] == pytest.approx(whole.deviation, abs=1e-12)
    assert found[:, 6:] == pytest.approx(expected, rel=1e-3)  # linearised elsewhere


@pytest.mark.parametrize("table", [inverse_rows, accuracy_rows])
def test_rows_that_cannot_be_reached_are_named_and_the_others_served(table, calibration, points):
    odd = np.array(points)
    odd[3], odd[12], odd[13] = OUT_OF_REACH, BEYOND_TRAVEL, [np.nan, 0.0, 0.0]
    names = [f"file:{i + 2}" for i in range(len(odd))]
    chunks = list(table(calibration, odd, names=names))
    refused = {i: e for c in chunks for i, e in c.refused.items()}
    assert sorted(refused) == [3, 12, 13]
    assert "the loops stay open by" in refused[3].reason
    assert "outside its limits" in refused[12].reason
    assert "not numbers" in refused[13].reason
    assert refused[12].posture == "file:14"
    found, expected = joined(chunks), joined(table(calibration, points))
    served = np.setdiff1d(np.arange(len(odd)), list(refused))
    assert found[served] == pytest.approx(expected[served], abs=1e-12)
    assert np.isnan(found[list(refused)]).all()


def test_joints_beyond_the_travel_are_refused_one_by_one(calibration):
    rows = np.array([[0.31, 0.31, 0.31], [0.5, 0.31, 0.31]])
    chunks = list(forward_blocks(calibration, row_blocks(rows)))
    assert np.isfinite(chunks[0].values[0]).all()
    assert chunks[0].refused[1].reason == "x_slide_mm is 500; the drive reaches from 120 to 390"


@pytest.fixture
def orthocal(tmp_path, calibration):
    write_calibration(calibration, tmp_path / "calibration.json")

    def run(command, text, *options):
        (tmp_path / "table.csv").write_text(text)
        done = run_orthocal(tmp_path, command, tmp_path, tmp_path / "table.csv", *options)
        table = list(csv.reader(io.StringIO(done.stdout)))
        return done.returncode, table, done.stderr.replace(str(tmp_path), "")

    return run


def test_the_command_line_names_rows_with_empty_cells(orthocal):
    good = "0,0,0\n" * 19
    text = f"x_mm,y_mm,z_mm\n{good}0,0,900\n{good}100,0,0\n"
    for command, columns in (("inverse", 3), ("accuracy", 9)):
        code, table, err = orthocal(command, text)
        assert code == 3
        assert len(table) == 1 + 40
        assert table[20] == table[40] == [""] * columns
        assert all(cell for i, row in enumerate(table) if i not in (20, 40) for cell in row)
        lines = [line for line in err.splitlines() if line.startswith("orthocal: ")]
        assert lines[0].startswith("orthocal: /table.csv:21: cannot be reached: the loops stay")
        assert lines[1].startswith("orthocal: /table.csv:41: cannot be reached: joint 'x_slide'")
        assert lines[2] == "orthocal: 2 rows cannot be reached; their cells are empty"


def test_a_table_of_which_no_row_can_be_reached_is_bad_input(orthocal):
    text = "x_mm,y_mm,z_mm\n" + "0,0,900\n" * 10
    code, table, err = orthocal("inverse", text)
    assert (code, table) == (2, [])
    assert err.count("\n") == 1
    assert err.startswith("orthocal: /table.csv:2: cannot be reached")
    code, table, err = orthocal("inverse", f"{text}0,0,0\n")
    assert (code, len(table)) == (3, 12)
    assert all(row == ["", "", ""] for row in table[1:11])
    assert err.count("cannot be reached: the loops") == 10


def test_memory_does_not_grow_with_the_table(calibration, monkeypatch):
    """What is held is a chunk and the rows themselves."""
    monkeypatch.setattr(module, "CHUNK_SIZE", 40)
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (400, 3))
    peaks = []
    for count in (40, 400):
        tracemalloc.start()
        for _ in accuracy_rows(calibration, points[:count]):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0]


def test_json_of_too_many_points_is_refused(orthocal):
    code, _, err = orthocal("accuracy", "x_mm,y_mm,z_mm\n" + "0,0,0\n" * 5001, "--json")
    assert code == 2
    assert "contains 5001 points; expected at most 5000 with --json" in err


HEADER = "x_mm,y_mm,z_mm\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("calibration")
    return write_calibration(calibrated(EXPERIMENT_2), path / "calibration.json").parent


@pytest.fixture
def through_pipe(monkeypatch, folder):
    monkeypatch.setattr(coordinate_tables, "BLOCK_ROWS", 4)

    def run(command, text, *, path="-"):
        done = run_orthocal(folder, command, folder, path, typed=text)
        return done.returncode, done.stdout, done.stderr

    return run


def test_a_pipe_gives_what_a_file_gives(through_pipe, tmp_path):
    points = np.random.default_rng(0).uniform(-40, 40, (11, 3))
    text = HEADER + "".join(f"{x:.3f},{y:.3f},{z:.3f}\r\n" for x, y, z in points)
    (tmp_path / "t.csv").write_text(text)
    expected = through_pipe("inverse", "", path=tmp_path / "t.csv")
    found = through_pipe("inverse", "\ufeff" + text)
    assert found == expected
    assert (found[0], found[1].count("\n")) == (0, 12)
    back = through_pipe("forward", found[1])[1].splitlines()[1:]
    again = np.array([[float(v) for v in line.split(",")] for line in back])
    assert np.abs(again - points).max() < 1e-3


def test_rows_have_no_negative_zero():
    rows = np.array([[-1e-12, 2.0], [-0.6e-9, np.nan], [-0.6e-9, 0.4e-9]])
    text = coordinate_tables.format_rows({"x_mm": MM, "y_mm": MM}, rows)
    assert text.split() == ["0.000000,2000.000000", ",", "-0.000001,0.000000"]


def test_a_wrong_line_of_a_pipe_is_named_and_what_came_before_is_served(through_pipe, tmp_path):
    text = HEADER + "0,0,0\n" * 9 + "0,q,0\n"
    code, out, err = through_pipe("inverse", text)
    assert (code, out.count("\n")) == (2, 9)
    assert err == (
        "orthocal: standard input:11: y_mm is 'q'; expected a number; the 8 rows in blocks before "
        "it were evaluated\n"
    )
    (tmp_path / "t.csv").write_text(text)
    code, out, err = through_pipe("inverse", "", path=tmp_path / "t.csv")
    assert (code, out) == (2, "")
    assert err == f"orthocal: {tmp_path}/t.csv:11: y_mm is 'q'; expected a number\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "standard input:1: is empty; expected a header: x_mm,y_mm,z_mm"),
        ("\n0,0,0\n", "standard input:1: is blank; expected a header: x_mm,y_mm,z_mm"),
        (HEADER, "standard input: holds no rows"),
        ("a,b\n", "standard input:1: unknown column 'a'; expected x_mm, y_mm, z_mm"),
        (HEADER + "0" * 200_000, "standard input:2: has a line of more than 131072 characters"),
    ],
)
def test_what_is_no_table_is_refused(through_pipe, text, message):
    assert through_pipe("inverse", text) == (2, "", f"orthocal: {message}\n")


def test_many_rows_out_of_reach_are_not_kept(through_pipe, monkeypatch):
    monkeypatch.setattr(printing, "MOST_HELD", 8)
    code, out, err = through_pipe("inverse", HEADER + "0,0,900\n" * 13)
    assert (code, out.count("\n")) == (3, 14)
    assert err.count("cannot be reached: ") == 13


def test_text_that_is_none_is_named_by_its_byte():
    text = b"\xef\xbb\xbfabc\r\n" * 3 + b"d\rlast"
    lines = list(read_lines(io.BytesIO(text[3:]), longest=100, name="t"))
    assert lines == ["abc\n", "\ufeffabc\n", "\ufeffabc\n", "d\n", "last"]
    content = b"good\n" * 20_000 + b"\xff"
    with pytest.raises(SessionError, match=r"^t: is not UTF-8 text \(byte 100000\)"):
        list(read_lines(io.BytesIO(content), longest=100, name="t", error=SessionError))


def test_memory_does_not_grow_with_the_stream(monkeypatch):
    """Reading, evaluating and printing a long pipe, whose lines are made as they are read."""
    monkeypatch.setattr(coordinate_tables, "BLOCK_ROWS", 50)
    calibration = calibrated(EXPERIMENT_2)

    class Pipe(io.RawIOBase):
        def __init__(self, count):
            self.lines = iter([HEADER.encode(), *[b"1,2,3\n"] * count])

        def readable(self):
            return True

        def readline(self, size=-1):
            return next(self.lines, b"")

    peaks = []
    for count in (100, 1000):
        pipe = Pipe(count)
        tracemalloc.start()
        blocks = coordinate_tables.stream_points(pipe, calibration.robot, name="p")
        served = sum(len(c.values) for c in inverse_blocks(calibration, blocks))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert served == count
    assert peaks[1] < 1.3 * peaks[0]
