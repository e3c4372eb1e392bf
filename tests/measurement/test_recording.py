"""Readings as they are taken: nothing accepted is ever lost, and the session always loads."""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import shutil
import signal
import sys

import numpy as np
import pytest

from orthocal import load_session, simulate_session
from orthocal.cli import record, recording
from orthocal.errors import OrthocalError, OutputError, SessionError
from orthocal.io.tables.numerals import parse_typed_reading
from orthocal.measurement import recording as module
from orthocal.measurement.files import session_file
from orthocal.measurement.files.session_file import load_plan
from orthocal.measurement.motion.motion import plan_motion
from orthocal.measurement.recorded_rows import NextConditions
from orthocal.measurement.recording import SUFFIX, open_recording
from orthocal.runtime.interrupts import ending_at_interrupt
from orthocal.session.session import Conditions
from orthocal.units import MM

STEPS = (3, 7, *range(20, 26))
"""Steps of writing at which a recording is killed: some of its start, all of several readings."""
FORK = multiprocessing.get_context("fork")

PLAN = """# a comment that stays
robot: orthoglide
gauge: {sigma_mm: 0.005, resolution_mm: 0.01, range_mm: [-5, 5]}
postures:
  zero: {tcp_mm: [0, 0, 0]}
  x_max: {tcp_mm: [60, 0, 0]}
  x_min: {tcp_mm: [-100, 0, 0]}
setups:
  yx: {leg: x, direction: y, section: {fraction: 0.5}}
  zx: {leg: x, direction: z, section: {fraction: 0.5}}
cycles: CYCLES
"""


def make_plan(folder, *, cycles=2):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "session.yaml").write_text(PLAN.replace("CYCLES", str(cycles)))
    return folder


@pytest.fixture
def plan(tmp_path):
    return make_plan(tmp_path / "session")


def values(folder):
    """Readings by their rows, [mm]; None where there is none."""
    session = load_plan(folder)
    return {
        (r.setup, r.posture, r.cycle): round(r.value / MM, 9) if r.is_read else None
        for r in session.readings
    }


def test_a_plan_without_readings_gets_its_rows_and_keeps_its_words(plan):
    with open_recording(plan) as r:
        assert [row.label_with_cycle for row in r.rows][:4] == [
            *("yx zero", "yx x_max", "yx x_min"),
            "yx zero, cycle 2",
        ]
        assert r.missing == tuple(range(12))
    text = (plan / "session.yaml").read_text()
    assert text == PLAN.replace("CYCLES", "2") + "readings: readings.csv\n"
    assert set(values(plan).values()) == {None}
    with open_recording(plan) as r:
        assert len(r.rows) == 12


def test_killed_between_rows_and_their_name_a_plan_is_made_a_session_all_the_same(plan):
    with open_recording(plan):
        pass
    (plan / "session.yaml").write_text(PLAN.replace("CYCLES", "2"))
    with open_recording(plan) as r:
        assert len(r.rows) == 12


def test_a_plan_writes_over_no_other_readings(plan):
    (plan / "readings.csv").write_text("setup,posture,reading_mm\nyx,zero,0.1\n")
    with (
        pytest.raises(SessionError, match=r"readings\.csv: holds other rows than session\.yaml"),
        open_recording(plan),
    ):
        pass
    assert (plan / "readings.csv").read_text().endswith("yx,zero,0.1\n")


def test_what_was_measured_is_a_session_of_the_rows_that_were_read(plan):
    with open_recording(plan) as r:
        for i in (1, 3, 4):
            r.read(i, 0.1 * i * MM)
        read = r.measured()
        assert [x.line for x in read.readings] == [3, 5, 6]
        assert [x.line for x in r.measured(without=[3]).readings] == [3, 6]
        assert read.values == pytest.approx(np.array([0.1, 0.3, 0.4]) * MM)
        aligned_at = r.session.alignment_postures["yx"]
        assert read.alignment_postures == {"yx": aligned_at}
        r.drop(0)
        assert [x.line for x in r.measured().readings] == [3, 5, 6]  # as before
        for i in r.missing:
            r.read(i, 0.0)
        complete = r.measured()
    loaded = load_session(plan)
    assert [x.line for x in complete.readings] == [x.line for x in loaded.readings]
    assert complete.values == pytest.approx(loaded.values, abs=1e-15)
    assert complete.alignment_postures == loaded.alignment_postures


def test_unchanged_rows_remain_byte_by_byte(root, tmp_path):
    folder = shutil.copytree(root / "examples/table1/experiment-2", tmp_path / "s")
    before = (folder / "readings.csv").read_bytes()
    with open_recording(folder) as r:
        assert r.missing == ()
    assert (folder / "readings.csv").read_bytes() == before
    with open_recording(folder) as r:
        r.read(0, 0.1 * MM)
        one = r.repeat(0)
        r.read(one, 0.2 * MM)
    assert [load_session(folder).readings[i].cycle for i in (0, -1)] == [1, 2]


def test_repeating_dropping_emptying_and_correcting(plan):
    with open_recording(plan) as r:
        r.read(0, 0.1 * MM)
        assert r.repeat(0) == 12
        assert r.rows[12].label_with_cycle == "yx zero, cycle 3"
        r.read(12, 0.11 * MM)
        r.read(0, 0.2 * MM)
        r.drop(1)
        r.read(7, -0.3 * MM)
        assert [row.line for row in r.rows if row.is_read] == [2, 10, 14]
        r.empty(0)
        assert [row.line for row in r.rows if row.is_read] == [10]
        assert [row.line for row in r.rows][:3] == [2, 4, 5]
    found = values(plan)
    assert len(found) == 12
    assert ("yx", "x_max", 1) not in found
    lines = (plan / f"readings.csv{SUFFIX}").read_text().splitlines()
    said = [json.loads(line).get("done") for line in lines]
    assert said == [*(None, "read", "added", "read", "read", "dropped", "read", "emptied", None)]


def test_the_closing_reading_follows_added_rows_in_record_and_on_the_sheet(plan):
    """Rows that are added to the file, repeated, or deleted and added again."""
    rows = ["yx,zero,1,", "yx,x_max,1,", "yx,x_min,1,", "yx,zero,2,", "yx,x_max,2,"]
    rows += ["zx,zero,1,", "zx,x_max,1,", "zx,x_min,1,", "zx,zero,2,"]
    (plan / "readings.csv").write_text("\n".join(["setup,posture,cycle,reading_mm", *rows, ""]))
    with (plan / "session.yaml").open("a") as stream:
        stream.write("readings: readings.csv\n")
    asked = []
    with open_recording(plan) as r:
        r.drop(7)  # line 9
        r.restore(9)  # line 11
        r.repeat(1)  # line 3 again: line 12
        while (i := r.next_empty()) is not None:
            asked.append(r.rows[i].line)
            r.read(i, 0.0)
    assert asked == [2, 3, 4, 6, 12, 5, 7, 8, 11, 10]
    motions = plan_motion(load_plan(plan))
    assert [s.line for m in motions for s in m.stops] == asked
    assert {s.role for m in motions for s in m.stops} == {"reading"}


def test_deleted_rows_and_the_temperature_are_known_to_the_next_recording(plan):
    with open_recording(plan) as r:
        r.read(1, 0.1 * MM, Conditions("nnn", 21.0))
        r.drop(1)  # line 3, with a typed approach
        r.drop(2)  # line 5
        r.restore(5)  # line 14
        r.note(NextConditions(temperature=21.0, clock=False))
        r.note(NextConditions(temperature=22.5))
    with open_recording(plan) as r:
        assert r.following == NextConditions(temperature=22.5, clock=False)
        assert [line for line in range(20) if r.is_deleted(line)] == [3]
        assert [r.present_line(line) for line in (3, 5, 6)] == [None, 14, None]
        index = r.restore(3)
        assert r.rows[index].label_with_cycle == "yx x_max"
        assert (r.rows[index].line, r.rows[index].approach, r.is_deleted(3)) == (15, None, False)
        r.drop(0)
    text = (plan / "session.yaml").read_text()  # the operator removes the posture of line 2
    (plan / "session.yaml").write_text(text.replace("zero:", "other:"))
    table = (plan / "readings.csv").read_text()
    (plan / "readings.csv").write_text(table.replace("zero", "other"))
    with open_recording(plan) as r:
        assert not r.is_deleted(2)
        assert r.present_line(3) == 15


def test_a_repeated_difference_gets_a_cycle_that_holds_no_readings_of_another_form(plan):
    text = "setup,posture,minus,cycle,reading_mm\nyx,x_max,zero,1,\nyx,x_min,,2,\n"
    (plan / "readings.csv").write_text(text)
    with (plan / "session.yaml").open("a") as stream:
        stream.write("readings: readings.csv\n")
    with open_recording(plan) as r:
        r.repeat(0)
        r.repeat(1)
    assert [r.cycle for r in load_plan(plan).readings] == [1, 2, 3, 4]


@pytest.mark.parametrize("value", [5.01, -7.0, 1234.0, np.nan])
def test_what_the_gauge_cannot_show_is_not_taken(plan, value):
    with open_recording(plan) as r:
        with pytest.raises(SessionError, match=r"yx zero: reading_mm is"):
            r.read(0, value * MM)
        assert r.missing[0] == 0
    load_plan(plan)


def test_the_only_row_stays(plan):
    (plan / "readings.csv").write_text("setup,posture,reading_mm\nyx,zero,\n")
    with (plan / "session.yaml").open("a") as stream:
        stream.write("readings: readings.csv\n")
    with open_recording(plan) as r, pytest.raises(SessionError, match="it is the only row"):
        r.drop(0)


def test_two_people_do_not_record_one_session(plan):
    with (
        open_recording(plan),
        pytest.raises(
            OrthocalError, match=r"journal: .* recorded by another process; one at a time"
        ),
        open_recording(plan),
    ):
        pass


@pytest.mark.parametrize("when", ["after the journal", "before the CSV's name"])
def test_cut_off_between_journal_and_table_a_reading_is_there_all_the_same(plan, monkeypatch, when):
    def fail(*_):
        raise OutputError("cannot be written: no room", where="readings.csv")

    with open_recording(plan) as r:
        r.read(0, 0.1 * MM)
        monkeypatch.setattr(module, "_write" if when.startswith("after") else "write_file", fail)
        monkeypatch.setattr(module.Recording, "close", lambda self: None)
        with pytest.raises(OutputError):
            r.read(1, 0.2 * MM)
    monkeypatch.undo()
    assert list(values(plan).values())[:2] == [0.1, None]
    with open_recording(plan) as r:
        assert (r.restored, r.edited) == (1, False)
        assert r.missing[0] == 2
    assert list(values(plan).values())[:3] == [0.1, 0.2, None]


def test_after_a_power_cut_several_changes_are_done_again(plan, monkeypatch):
    monkeypatch.setattr(module.Recording, "close", lambda self: None)
    with open_recording(plan) as r:
        r.read(0, 0.1 * MM)
        old = (plan / "readings.csv").read_bytes()
        r.read(1, 0.2 * MM)
        r.repeat(1)
        r.read(2, 0.3 * MM)
        r.drop(4)
        new = (plan / "readings.csv").read_bytes()
    (plan / "readings.csv").write_bytes(old)
    with open_recording(plan) as r:
        assert r.restored == 4
    assert (plan / "readings.csv").read_bytes() == new


BLOCKS = """# aligned by hand
robot: orthoglide
gauge: {sigma_mm: 0.005, tip: {ball: {radius_mm: 1.5}}}
postures:
  zero: {tcp_mm: [0, 0, 0]}
  a-b: {tcp_mm: [-10, 0, 0]}
  x_min: {tcp_mm: [-100, 0, 0]}
setups:  # two forms
  yx:  # with a comment
    leg: x
    touches: a  # the upper one
    direction: y
    section: {fraction: 0.5}
    postures: [zero, x_min]
  zx: {leg: x, touches: a, direction: z, section: {fraction: 0.5}, postures: [a-b, x_min],}
"""


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_deleted_rows_change_no_alignment_posture(tmp_path, line_end):
    """The posture is stated in the session.yaml as soon as the rows imply another one."""
    file = tmp_path / "session.yaml"
    text = BLOCKS.replace("\n", line_end)
    file.write_bytes(text.encode())
    with open_recording(tmp_path) as r:
        named = file.read_bytes().decode()
        assert r.drop(3) == {}
        assert file.read_bytes().decode() == named
        assert r.session.alignment_postures == {"yx": "zero", "zx": "a-b"}
        assert r.drop(2) == {"zx": "a-b"}
        assert r.drop(0) == {"yx": "zero"}
        r.read(0, 0.1 * MM)
        assert r.measured().alignment_postures == {"yx": "zero", "zx": "a-b"}
    session = load_session(tmp_path)
    assert [(x.setup, x.posture) for x in session.readings] == [("yx", "x_min")]
    assert session.alignment_postures == {"yx": "zero", "zx": "a-b"}
    expected = named.replace("    leg", "    aligned_at: zero\n    leg")
    assert file.read_bytes().decode() == expected.replace("zx: {", "zx: {aligned_at: a-b, ")


@pytest.mark.parametrize(
    ("old", "new"), [("    leg: x", "    ? leg\n    : x"), ("  yx:", "  y:"), ("setups", "setup")]
)
def test_a_row_is_kept_if_its_alignment_posture_cannot_be_stated(tmp_path, old, new):
    """The session.yaml has an unusual form, or was edited meanwhile."""
    file = tmp_path / "session.yaml"
    file.write_text(BLOCKS)
    with open_recording(tmp_path) as r:
        file.write_text(file.read_text().replace(old, new, 1))
        before = file.read_text()
        with pytest.raises(SessionError, match=r"setups\.yx: .* add `aligned_at: zero`"):
            r.drop(0)
        assert len(r.rows) == 4
    assert file.read_text() == before


def test_a_table_edited_by_hand_counts(plan, monkeypatch):
    with open_recording(plan) as r:
        blank = (plan / "readings.csv").read_bytes()
        r.read(0, 0.1 * MM)
    (plan / "readings.csv").write_bytes(blank)  # as it was once: left in order, nothing is restored
    with open_recording(plan) as r:
        assert (r.restored, r.missing[0]) == (0, 0)
        monkeypatch.setattr(module.Recording, "close", lambda self: None)
        r.read(0, 0.3 * MM)
    edited = (plan / "readings.csv").read_text().replace("0.30", "0.35")
    (plan / "readings.csv").write_text(edited)
    with open_recording(plan) as r:
        assert (r.restored, r.edited) == (0, True)
    assert values(plan)["yx", "zero", 1] == 0.35


def test_a_line_without_an_end_was_never_accepted(plan, monkeypatch):
    monkeypatch.setattr(module.Recording, "close", lambda self: None)
    with open_recording(plan) as r:
        r.read(0, 0.1 * MM)
    journal = plan / f"readings.csv{SUFFIX}"
    with journal.open("a") as stream:
        stream.write('{"done": "read", "rows": [["yx", "x_max", null, 1]], "read')
    with open_recording(plan) as r:
        assert r.missing[0] == 1
        r.read(1, 0.2 * MM)
    assert all(json.loads(line) for line in journal.read_text().splitlines())


READ = '{"done": "read", "rows": [["yx", "zero", null, 1]], "reading_mm": 0.1, "at": "", '
ADDED = READ.replace("read", "added", 1).replace("1]]", '1], ["yx", "x_max", null, 9]]')
DIGESTS = '"before": "BEFORE", "after": ""}'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("nonsense\n", "is not the journal of a recording; move it away"),
        ('{"format": "orthocal/study/1"}\n', "is not the journal of a recording"),
        ("HEAD" + "[1]\n", r"journal:2: is not a line of a recording: the journal is damaged"),
        ("HEAD" + READ.replace("0.1", "NaN") + DIGESTS + "\n", ":2: is not a line of a recording"),
        ("HEAD" + READ.replace("0.1", "1e9") + DIGESTS + "\n", ":2: is not a line of a recording"),
        (
            "HEAD" + READ.replace("read", "burnt", 1) + DIGESTS + "\n",
            "is not a line of a recording",
        ),
        ("HEAD" + "[" * 70_000 + "\n", "is not a line of a recording"),
        ("HEAD" + "x" * 70_000, "is not a line of a recording"),
        ("HEAD" + READ.replace("yx", "no") + DIGESTS + "\n", r":2: does not fit readings\.csv"),
        (
            "HEAD" + ADDED.replace('"yx", "x_max"', '"no", "x_max"') + DIGESTS + "\n",
            ":2: .* it has no setup 'no'",
        ),
        ("HEAD" + ADDED.replace("x_max", "far") + DIGESTS + "\n", ":2: .* it has no posture 'far'"),
    ],
)
def test_a_damaged_journal_is_refused_and_nothing_changes(plan, content, message):
    with open_recording(plan):
        pass
    csv = (plan / "readings.csv").read_bytes()
    content = content.replace("HEAD", '{"format": "orthocal/recording/1"}\n')
    content = content.replace("BEFORE", module._digest(csv))
    journal = plan / f"readings.csv{SUFFIX}"
    journal.write_text(content)
    with pytest.raises(OrthocalError, match=message), open_recording(plan):
        pass
    assert journal.read_text() == content
    assert (plan / "readings.csv").read_bytes() == csv


def kill_at(step):
    """Kill this process at a step of writing; a line of the journal is half written then."""
    left = step

    def stopping(original):
        def do(*args, **kwargs):
            nonlocal left
            left -= 1
            if left <= 0:
                if original is write:
                    original(args[0], args[1][: len(args[1]) // 2])
                os.kill(os.getpid(), signal.SIGKILL)
            return original(*args, **kwargs)

        return do

    write = os.write
    os.write, os.fsync, os.replace = map(stopping, (os.write, os.fsync, os.replace))


def talk(folder, lines, said, step):
    """In a child: record with what comes from a pipe, and answer into another, until killed."""
    os.dup2(lines, 0)
    os.dup2(said, 1)
    sys.stdin = os.fdopen(0, "r", encoding="utf-8", closefd=False)
    sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
    kill_at(step)
    with ending_at_interrupt():
        record.record(folder)


KEPT = re.compile(r"Recorded: line \d+, (\S+) (\S+?)(?:, cycle (\d+))?: (-?[0-9.]+) mm\n")


def test_killed_many_times_no_accepted_reading_is_lost(tmp_path, monkeypatch):
    """Killed at all steps of writing, while readings, corrections and repeats come in."""
    monkeypatch.setenv("COLUMNS", "100")
    folder = make_plan(tmp_path / "session", cycles=12)  # more than are read before all ends
    monkeypatch.setattr(recording.Dialogue, "_is_doubtful", lambda *_, **__: False)
    monkeypatch.setattr(recording.Dialogue, "_judge", lambda *_, **__: False)
    robot = load_plan(folder).robot
    monkeypatch.setattr(session_file, "load_robot", lambda *_, **__: robot)
    rng = np.random.default_rng(0)
    accepted, restored = {}, []
    for step in STEPS:
        lines_out, lines_in = os.pipe()
        said_out, said_in = os.pipe()
        child = FORK.Process(target=talk, args=(folder, lines_out, said_in, step))
        child.start()
        os.close(lines_out)
        os.close(said_in)
        text = []
        for value in rng.integers(-400, 400, size=1500):
            text.append(f"{value / 100:.2f}")
            if value % 7 == 0:
                text += ["repeat", f"{value / 100 + 0.01:.2f}"]
            if value % 11 == 0:
                text += ["back", f"{value / 100 - 0.01:.2f}"]
        os.write(lines_in, ("\n".join(text) + "\n").encode()[:60_000])
        answer = b""
        while more := os.read(said_out, 65536):
            answer += more
        os.close(said_out)
        os.close(lines_in)
        child.join()
        assert child.exitcode == -signal.SIGKILL
        found = KEPT.findall(answer.decode())
        numbers = [float(line) for line in text if line[-1].isdigit()]
        assert [float(value) for *_, value in found] == numbers[: len(found)]
        accepted |= {(s, p, int(c or 1)): float(v) for s, p, c, v in found}
        with open_recording(folder) as r:  # it loads as it lies there, whenever it was
            assert r.restored <= 1
            restored.append(r.restored)
            there = {
                row.key[:2] + row.key[3:]: round(row.value / MM, 9) for row in r.rows if row.is_read
            }
        other = {key: v for key, v in there.items() if accepted.get(key) != v}
        assert accepted.keys() <= there.keys()
        # one more may be there, of which nothing could be said any more: what was typed next
        assert list(other.values()) in ([], [numbers[len(found)]])
        accepted = there
    assert len(accepted) > len(STEPS)
    assert sorted(set(restored)) == [0, 1]


TYPED = {
    "0.12": 0.12, " -0,35 ": -0.35, "−0.35": -0.35, "– 1,5": -1.5, "+.5": 0.5, "5.": 5.0,
    "0,123": 0.123, "1.234": 1.234, "1,23": 1.23, "1,2345": 1.2345, "0.12 mm": 0.12, "0,12MM": 0.12,
    "-0": 0.0,
}  # fmt: skip
"""Numbers as people type them, [mm]."""


@pytest.mark.parametrize("text", TYPED)
def test_numbers_as_people_type_them(text):
    assert parse_typed_reading(text) / MM == pytest.approx(TYPED[text], abs=1e-15)
    assert not np.signbit(parse_typed_reading("-0"))


def test_a_comma_is_decimal_if_the_number_would_exceed_the_range():
    assert parse_typed_reading("-1,781", largest=0.01) == pytest.approx(-1.781e-3)
    with pytest.raises(SessionError, match="may be"):
        parse_typed_reading("1,781", largest=2.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,234", "'1,234' may be 1.234 or 1234; write 1.234 with a point, or 1234 without"),
        ("-12,345", "may be -12.345 or -12345"),
        ("1.234,5", "more than one separator"),
        ("1'234.5", "more than one separator"),
        ("1 234", "more than one separator"),
        ("120 µm", "'120 µm' is in µm; readings are in mm"),
        ("0.256in", "'0.256in' is in inches; readings are in mm"),
        ('0.1"', "is in inches; readings are in mm"),
        ("1e3", "is neither a number nor a command"),
        ("0.1.", "is neither"),
        ("--1", "is neither"),
        ("٣", "is neither"),
        ("nan", "is neither"),
        ("1" * 5000, "is neither"),
        (",", "is neither"),
    ],
)
def test_what_may_be_meant_otherwise_is_asked_back(text, message):
    with pytest.raises(SessionError, match=re.escape(message)):
        parse_typed_reading(text)


POINTS = """robot: orthoglide
controller: {offsets_mm: [0, 0, 0]}
gauges: {tracker: {sigma_mm: 0.01}, dial: {sigma_mm: 0.005}}
postures:
"""


@pytest.fixture
def tracked(tmp_path):
    """Plan of a tracker and a dial, the points of a machine, (8, 3), [m], and its dial."""
    corners = [(x, y, z) for x in (-50, 40) for y in (-50, 40) for z in (-40, 50)]
    postures = "".join(f"  p{i}: {{tcp_mm: {list(p)}}}\n" for i, p in enumerate(corners))
    names = ", ".join(f"p{i}" for i in range(8))
    (tmp_path / "session.yaml").write_text(
        f"{POINTS}{postures}setups:\n"
        f"  track: {{sensor: points, gauge: tracker, target_mm: [0, 0, -40],\n"
        f"    postures: [{names}]}}\n"
        "  yx: {leg: x, direction: y, section: {fraction: 0.5}, gauge: dial,\n"
        "    postures: [p1, p2]}\n"
    )
    shown = simulate_session(load_plan(tmp_path), {"x_slide.offset": 1e-3}, seed=2).session
    return tmp_path, shown.values[:24].reshape(8, 3), shown.values[24:]


def test_readings_of_a_probe_state_the_side_of_its_motion(tmp_path):
    """By closed form: the y_slide is at y + √(L² − x² − z²), which falls from x = 10 to 20 mm."""
    (tmp_path / "session.yaml").write_text(
        "robot: orthoglide\ncalibration: {effects: [backlash]}\ngauge: {sigma_mm: 0.01}\n"
        "postures: {a: {tcp_mm: [20, 20, 20]}, b: {tcp_mm: [20, 30, 40]}}\nsetups:\n"
        "  wall: {sensor: probe, direction: x, surface: plane, postures: [a, b]}\n"
        "  yx: {leg: x, direction: y, section: {fraction: 0.5}, postures: [a, b]}\n"
    )
    with open_recording(tmp_path) as recording:
        assert [r.approach for r in recording.rows] == ["pnn", "pnn", None, None]


def test_points_are_recorded_three_coordinates_at_once(tracked):
    folder, points, dial = tracked
    with open_recording(folder) as recording:
        assert (recording.count, recording.missing_count) == (10, 10)
        for point in points:
            recording.read(recording.next_empty(), point)
        for value in dial:
            recording.read(recording.next_empty(), value)
        assert recording.missing == ()
        again = recording.repeat(3)
        assert recording.point(again) == [26, 27, 28]
        assert [r.line for r in recording.rows[26:]] == [12, 12, 12]
        recording.read(again, points[1])
        with pytest.raises(SessionError, match="100000"):
            recording.read(again, np.array([0.0, 0.0, 101.0]))
        with pytest.raises(SessionError, match="reading_mm is nan"):
            recording.read(again, np.array([0.0, 0.0, np.nan]))
    session = load_session(folder)
    assert session.values[:24].reshape(8, 3) == pytest.approx(points, abs=1e-12)
    assert session.values[24:26] == pytest.approx(dial, abs=1e-12)
    assert session.values[26:] == pytest.approx(points[1], abs=1e-12)


def test_a_point_is_deleted_and_emptied_with_all_its_coordinates(tracked):
    folder, points, dial = tracked
    with open_recording(folder) as recording:
        for point in points[:3]:
            recording.read(recording.next_empty(), point)
        recording.read(24, dial[0])
        recording.drop(3)
        assert (len(recording.rows), recording.count, recording.missing_count) == (23, 9, 6)
        recording.empty(0)
        assert [r.setup for r in recording.rows if r.is_read] == ["yx"]


def test_a_deleted_point_comes_back_if_fewer_rows_remain(tracked):
    """A point has three rows; those that remain are the two of the dial."""
    folder, *_ = tracked
    with open_recording(folder) as recording:
        while len(recording.rows) > 2:
            line = recording.rows[0].line
            recording.drop(0)
        index = recording.restore(line)
        assert (index, recording.point(index)) == (2, [2, 3, 4])
    assert len(load_plan(folder).readings) == 5


def test_a_killed_recording_of_points_is_restored(tracked, monkeypatch):
    """The journal has a point before the CSV does: it comes back with all three coordinates."""
    folder, points, _ = tracked

    def die(*_):
        raise KeyError

    with open_recording(folder) as recording:
        recording.read(recording.next_empty(), points[0])
        monkeypatch.setattr(module, "_write", die)
        monkeypatch.setattr(module.Recording, "close", lambda _: None)
        with pytest.raises(KeyError):
            recording.read(recording.next_empty(), points[1])
    monkeypatch.undo()
    with open_recording(folder) as recording:
        assert recording.restored == 1
        values = np.array([r.value for r in recording.rows[:6]]).reshape(2, 3)
        assert values == pytest.approx(points[:2], abs=1e-12)


def test_points_of_correlated_coordinates_are_recorded_as_typed(tracked):
    """The rows are principal axes then; files and operator have x, y and z."""
    folder, points, _ = tracked
    file = folder / "session.yaml"
    covariance = "covariance_um2: [[90, 40, 0], [40, 60, 5], [0, 5, 400]], "
    file.write_text(file.read_text().replace("target_mm", covariance + "target_mm"))
    with open_recording(folder) as recording:
        assert [r.setup for r in recording.rows[:3]] == [f"track[{k}]" for k in (1, 2, 3)]
        recording.read(0, points[0])
    line = (folder / "readings.csv").read_text().splitlines()[1].split(",")
    assert [float(v) for v in line if "." in v] == pytest.approx(points[0] / MM, abs=1e-8)
