"""Tables through pipes: served as they come, in bounded memory, wrong lines by their number."""

from __future__ import annotations

import io
import tracemalloc

import numpy as np
import pytest
from calibrated import EXPERIMENT_2, calibrated
from commands import run_orthocal

from orthocal.assessment.tool_tables import inverse_blocks
from orthocal.calibration.file import write_calibration
from orthocal.cli import printing
from orthocal.errors import SessionError
from orthocal.io.files import read_lines
from orthocal.measurement.files import coordinate_tables as table
from orthocal.units import MM

HEADER = "x_mm,y_mm,z_mm\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("calibration")
    return write_calibration(calibrated(EXPERIMENT_2), path / "calibration.json").parent


@pytest.fixture
def orthocal(monkeypatch, folder):
    monkeypatch.setattr(table, "BLOCK_ROWS", 4)

    def run(command, text, *, path="-"):
        done = run_orthocal(folder, command, folder, path, typed=text)
        return done.returncode, done.stdout, done.stderr

    return run


def test_a_pipe_gives_what_a_file_gives(orthocal, tmp_path):
    points = np.random.default_rng(0).uniform(-40, 40, (11, 3))
    text = HEADER + "".join(f"{x:.3f},{y:.3f},{z:.3f}\r\n" for x, y, z in points)
    (tmp_path / "t.csv").write_text(text)
    expected = orthocal("inverse", "", path=tmp_path / "t.csv")
    found = orthocal("inverse", "\ufeff" + text)
    assert found == expected
    assert (found[0], found[1].count("\n")) == (0, 12)
    back = orthocal("forward", found[1])[1].splitlines()[1:]
    again = np.array([[float(v) for v in line.split(",")] for line in back])
    assert np.abs(again - points).max() < 1e-3


def test_rows_have_no_negative_zero():
    rows = np.array([[-1e-12, 2.0], [-0.6e-9, np.nan], [-0.6e-9, 0.4e-9]])
    text = table.format_rows({"x_mm": MM, "y_mm": MM}, rows)
    assert text.split() == ["0.000000,2000.000000", ",", "-0.000001,0.000000"]


def test_a_wrong_line_of_a_pipe_is_named_and_what_came_before_is_served(orthocal, tmp_path):
    text = HEADER + "0,0,0\n" * 9 + "0,q,0\n"
    code, out, err = orthocal("inverse", text)
    assert (code, out.count("\n")) == (2, 9)
    assert err == (
        "orthocal: standard input:11: y_mm is 'q'; expected a number; the 8 rows in blocks before "
        "it were evaluated\n"
    )
    (tmp_path / "t.csv").write_text(text)
    code, out, err = orthocal("inverse", "", path=tmp_path / "t.csv")
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
def test_what_is_no_table_is_refused(orthocal, text, message):
    assert orthocal("inverse", text) == (2, "", f"orthocal: {message}\n")


def test_many_rows_out_of_reach_are_not_kept(orthocal, monkeypatch):
    monkeypatch.setattr(printing, "MOST_HELD", 8)
    code, out, err = orthocal("inverse", HEADER + "0,0,900\n" * 13)
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
    monkeypatch.setattr(table, "BLOCK_ROWS", 50)
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
        blocks = table.stream_points(pipe, calibration.robot, name="p")
        served = sum(len(c.values) for c in inverse_blocks(calibration, blocks))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert served == count
    assert peaks[1] < 1.3 * peaks[0]
