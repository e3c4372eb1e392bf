"""`orthocal record`: dialogue over a pipe and on a terminal, warnings, conditions, points."""

from __future__ import annotations

import html
import os
import pty
import re
import select
import shlex
import shutil
import signal
import sys
import time
from datetime import datetime

import numpy as np
import pytest
from commands import orthocal
from conftest import marked_pictures
from made_mistakes import sound_session

from orthocal import check_session, draw_errors, load_session, simulate_session, write_session
from orthocal.assessment.wording import review
from orthocal.calibration.assessment_record import Place
from orthocal.cli import recording
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.measurement.files.session_file import load_plan
from orthocal.measurement.motion.guidance import guide
from orthocal.measurement.motion.motion import plan_motion
from orthocal.measurement.recording import SUFFIX, open_recording
from orthocal.output.sheet.page import sheet_files
from orthocal.output.text.recording import RecordingText
from orthocal.robot.loading import packaged_robots
from orthocal.units import MM

PLAN = """robot: orthoglide
title: Monday
gauge: {sigma_mm: 0.005, resolution_mm: 0.01, range_mm: [-5, 5], tip: {ball: {radius_mm: 1.5}}}
postures:
  zero: {tcp_mm: [0, 0, 0]}
  x_max: {tcp_mm: [60, 0, 0]}
  x_min: {tcp_mm: [-100, 0, 0]}
setups:
  yx: {leg: x, touches: a, direction: y, section: {fraction: 0.5}}
  zx: {leg: x, touches: a, direction: -z, section: {fraction: 0.5}}
"""

TIMEOUT = 60.0
"""Longest time of a process, [s]."""


@pytest.fixture
def folder(tmp_path):
    made = tmp_path / "monday"
    made.mkdir()
    (made / "session.yaml").write_text(PLAN)
    return made


@pytest.fixture
def run(monkeypatch):
    def record(folder, *lines, columns=100, terminal=False):
        monkeypatch.setenv("COLUMNS", str(columns))
        typed = "".join(f"{line}\n" for line in lines)
        return orthocal("record", folder, typed=typed, terminal=terminal)

    return record


@pytest.fixture
def unjudged(monkeypatch):
    """Readings without predictions, warnings and motions: most of the time of a dialogue."""
    monkeypatch.setattr(recording.Dialogue, "_is_judged", False)
    monkeypatch.setattr(RecordingText, "_lifting", lambda *_: "")


@pytest.mark.parametrize(
    ("sensor", "instrument"),
    [
        ("ball_bar, centre_mm: [0, 0, -100], length_mm: 100}", "ball bar"),
        ("probe, direction: -z}", "probe"),
        ("distance}", "calliper"),
        ("tool_indicator, direction: -z, artefact: {kind: plate}}", "dial"),
    ],
)
def test_words_of_the_instrument(folder, run, sensor, instrument):
    """Nobody looks for a dial on a ball bar, a probe or a calliper."""
    pairs = sensor.startswith("distance")
    plan = PLAN[: PLAN.index("gauge:")] + PLAN[PLAN.index("postures:") : PLAN.index("setups:")]
    (folder / "session.yaml").write_text(
        f"{plan}gauge: {{sigma_mm: 0.005}}\nsetups:\n  s: {{sensor: {sensor}\n"
        + ("readings: readings.csv\n" if pairs else "")
    )
    if pairs:
        (folder / "readings.csv").write_text("setup,posture,minus,reading_mm\ns,x_max,x_min,\n")
    done = run(folder, "", "quit")
    assert f"Type the reading of the {instrument} in mm" in done.stdout
    assert f"type the reading of the {instrument}," in done.stdout
    head = " ".join(done.stdout[: done.stdout.index("[mm]>")].split())
    words = {"ball bar": "ball bar", "probe": "probe", "gauge or its stand": "dial"}
    touched = [noun for text, noun in words.items() if f"do not touch the {text}" in head]
    assert touched == ([] if pairs else [instrument])
    is_probe = instrument == "probe"
    assert ("that of the posture minus that at the trigger" in head) == is_probe
    assert ("and align the" in head) == (instrument in ("dial", "ball bar"))


def rows_of(folder):
    """Rows of readings.csv without the blank lines of deleted rows."""
    head, *rows = (folder / "readings.csv").read_text().splitlines()
    return [dict(zip(head.split(","), row.split(","), strict=True)) for row in rows if row]


def cells(folder):
    return [row["reading_mm"] for row in rows_of(folder)]


def sound_readings(folder):
    """Readings of a plan on a machine within its tolerances, [mm]."""
    return [f"{v / MM:.2f}" for v in sound_session(load_plan(folder), 0, entered=False).values]


def blank(example, folder, *, cycles=None, recorded=0):
    """Copy a session, or some of its cycles, with some recorded readings; returns all as text."""
    shutil.copytree(example, folder)
    header, *rows = (example / "readings.csv").read_text().splitlines()
    if cycles is not None:
        cycle = header.split(",").index("cycle")
        rows = [row for row in rows if int(row.split(",")[cycle]) <= cycles]
    empty = [f"{row.rpartition(',')[0]}," for row in rows[recorded:]]
    (folder / "readings.csv").write_text("\n".join([header, *rows[:recorded], *empty]) + "\n")
    return [row.rpartition(",")[2] for row in rows]


@pytest.mark.usefixtures("unjudged")
def test_session_with_active_offsets_is_to_be_validated(folder, run):
    with (folder / "session.yaml").open("a") as stream:
        stream.write("controller: {offsets_mm: [1.2, 0, 0]}\n")
    _, out, _ = run(folder, *sound_readings(folder))
    assert "All 6 readings are recorded." in out
    assert f"by their calibration,\n  orthocal validate CALIBRATION {folder}\n" in out
    together = f"orthocal calibrate EARLIER {folder} --out {folder}-calibration"
    assert out.rstrip().endswith(f"sessions together:\n  {together}")
    with (folder / "session.yaml").open("a") as stream:
        stream.write("offsets_from: ../out/one\n")
    entered = folder.parent / "out/one"
    assert run(folder)[1].rstrip().endswith(f"Next:\n  orthocal validate {entered} {folder}")


def test_instructions_of_a_setup_and_a_posture(folder, run):
    _, out, _ = run(folder)
    text = " ".join(out.split())
    # in the middle of the leg
    for words in (
        "Monday: 6 readings in 2 setups on orthoglide; none is recorded yet.",
        "Setup yx, 1 of 2: 3 readings Place: leg x, gauge in y, at 0.5",
        "of its length from the slide at the mechanical zero",
        "Stand: on the +y side, so that the tip in posture zero touches 155.1 mm from the hinge",
        "Push the plunger in: the reading must grow. If it falls, enter every reading of",
        "Dial: -5 to 5 mm, resolution 0.01 mm",
        "Go to zero and align the gauge. Set the gauge so that its plunger is pressed in",
        "Line 2: yx zero (6 of 6 missing)",
        "joints x_slide 310.250 mm, y_slide 310.250 mm, z_slide 310.250 mm",
        "tool x 0.000, y 0.000, z 0.000 mm",
        "6 of 6 readings are missing: yx all and zx all.",
        f"Continue with: orthocal record {folder}",
    ):
        assert words in text


def test_a_setup_names_the_motions_with_the_plunger_up_as_the_sheet_does(folder, run, monkeypatch):
    monkeypatch.setattr(recording.Dialogue, "_is_judged", False)
    plan = PLAN.replace("x_max: {tcp_mm: [60, 0, 0]}", "aside: {tcp_mm: [0, 12, 0]}")
    (folder / "session.yaml").write_text(plan)
    (motion, other) = plan_motion(load_plan(folder))
    assert [bool(s.lift) for s in motion.stops] == [False, True, True, False]
    assert not other.lifting
    with marked_pictures():
        sheet = html.unescape(sheet_files(load_plan(folder))["sheet.html"])
    out = [" ".join(text.split()) for text in run(folder, *"0000").stdout.split("Setup ")]
    hint = "Hold the plunger up on the way to line 3, line 4"
    assert [text.count(hint) for text in (sheet, *out)] == [1, 0, 1, 0]
    assert motion.lifting in sheet
    assert motion.lifting in out[1]
    out = " ".join(run(folder, "back 2").stdout.split())  # the setup is read already
    assert hint not in out


@pytest.mark.usefixtures("unjudged")
def test_each_setup_names_its_gauge_if_there_are_several(folder, run):
    digital = "  digital: {sigma_mm: 0.001, tip: {ball: {radius_mm: 1.5}}}"
    text = PLAN.replace("gauge: {", "gauges:\n  dial: {")
    text = text.replace("postures:", f"{digital}\npostures:")
    text = text.replace("{leg", "{gauge: dial, leg", 1).replace("{leg", "{gauge: digital, leg")
    (folder / "session.yaml").write_text(text)
    _, out, _ = run(folder, "0.01", "0.02", "0.03")
    first, second = out.split("Setup zx")
    assert "  Dial 'dial': -5 to 5 mm, resolution 0.01 mm\n" in first
    assert "  Dial 'digital'\n" in second


def test_joints_have_the_coordinates_of_the_controller(tmp_path):
    """The x joint counts down from 5 mm at the mechanical zero; active offsets are not shown."""
    machine = shutil.copytree(packaged_robots()["orthoglide"], tmp_path / "orthoglide")
    file = machine / "orthoglide.yaml"
    joint = "{zero_mm: 310.25, joint: {counts: down, at_zero_mm: 5}}"
    file.write_text(file.read_text().replace("x_slide: {zero_mm: 310.25}", f"x_slide: {joint}"))
    plan = PLAN.replace("robot: orthoglide", f"robot: {machine}")
    plan += "controller: {offsets_mm: [1.5, -0.5, 0.25]}\n"
    (tmp_path / "session.yaml").write_text(plan)
    session = load_plan(tmp_path)
    shown = guide(session)
    length = 310.25
    for name, x in (("zero", 0.0), ("x_max", 60.0), ("x_min", -100.0)):
        others = np.sqrt(length**2 - x**2)  # equation (2): what a nominal controller commands
        assert shown.joints[name] / MM == pytest.approx([5.0 - x, others, others])
        assert shown.tool[name] / MM == pytest.approx([x, 0.0, 0.0], abs=1e-9)


def test_tool_position_of_postures_stated_by_joints(tmp_path):
    text = PLAN.replace("{tcp_mm: [60, 0, 0]}", "{joints_mm: [370, 305, 305]}")
    (tmp_path / "session.yaml").write_text(text)
    shown = guide(load_plan(tmp_path))
    assert shown.joints["x_max"] / MM == pytest.approx([370.0, 305.0, 305.0])
    tool = shown.tool["x_max"] / MM
    back = tool + np.sqrt(310.25**2 - (tool @ tool - tool**2))  # equation (2)
    assert back == pytest.approx([370.0, 305.0, 305.0])


ENTRIES = """
; 0.1 | 0.10 | Not recorded: type the reading of the dial, or `skip`
0.1; back; 0,2 | 0.20 | Recorded: 0.10 mm; Enter keeps it.
0.1; b;  | 0.10 | Line 3: yx x_max (5 of 6 missing)
0.1; 0.2; back 2; 0.3 | 0.30 0.20 | Line 2: yx zero (4 of 6 missing)
0.1; 0.1; 0.1; 0.1; back 2; 0.2 | 0.20 0.10 0.10 0.10 |
    has moved since, correct typing errors only, or type `restart 2`
0.1; repeat; 0.11; back; 0.12 | 0.10 - - - - - 0.12 | Recorded: 0.11 mm; Enter keeps it.
back | - | Not recorded: this is the first line.
back 1 | - | Not recorded: '1' is not a line; expected 2 to 7.
back to | - | Not recorded: 'to' is not a line; expected 2 to 7.
0.1; repeat; 0.11 | 0.10 - - - - - 0.11 | Line 8: yx zero, cycle 2 (6 of 7 missing)
0.1; 0.2; repeat 2; 0.11; 0.3 | 0.10 0.20 0.30 - - - 0.11 |
    Added: line 8, which repeats line 2. Line 8: yx zero, cycle 2
0.1; 0.2; 0.3; 0.4; repeat 2 | 0.10 0.20 0.30 0.40 |
    Another setup was read after yx. If the gauge or its stand has moved since
repeat | - | Not recorded: nothing was read yet.
repeat 3 | - | Not recorded: line 3 was not read yet.
skip; 0.2 | - 0.20 | Skipped: line 2
0.1; drop; 0.3 | 0.10 0.30 | Line 4: yx x_min (4 of 5 missing)
0.1; drop 2; 0.3 | 0.30 | Line 4: yx x_min (4 of 5 missing)
0.1; drop 3; back 3; 0.2 | 0.10 - - - - 0.20 |
    `back 3` adds it again, as the last line. Line 4: yx x_min (4 of 5 missing)
drop 3; back 3; back 3 | - - - - - - | Not recorded: line 3 is line 8 now.
0.1; drop 2; repeat 2 | - - - - - |
    Not recorded: line 2 was deleted; `back 2` adds it again, as the last line.
drop 3; back 3; drop; back 3; 0.1 | - - - - - 0.10 | Added: line 8, yx x_max.
drop 7; 0.1; repeat 2; repeat 7 | 0.10 | Not recorded: line 7 was not read yet.
0.1; 0.2; restart; restart; 0.3 | 0.30 |
    2 readings of yx. Type it again to delete; any other line keeps them.
0.1; 0.2; restart; list; restart; 0.3; restart 2 | 0.10 0.20 0.30 |
    `restart` deletes 3 readings of yx.
0.1; 0.1; 0.1; 0.1; restart; restart 2; restart | 0.10 0.10 0.10 0.10 |
    `restart` deletes 3 readings of yx.
restart; 0.3 | 0.30 | yx has no readings yet. `restart 7`
0.1; 0.2; 0.3; 0.4; restart 3; restart 3; 0.5 | 0.50 - - 0.40 |
    Deleted: all readings of yx Setup yx, 1 of 2
restart 1 | - | Not recorded: '1' is not a line; expected 2 to 7.
0.1; list | 0.10 | 3 yx x_max: not read
show | - | Setup yx, 1 of 2
help | - | repeat: read the last line once more, as another cycle
? | - | Ctrl-D and Ctrl-C end, too.
quit; 0.1 | - | 6 of 6 readings are missing
exit; 0.1 | - | 6 of 6 readings are missing
0.1; Q; 0.2 | 0.10 | 5 of 6 readings are missing: yx lines 3, 4 and zx all
s | - | Not recorded: 's' is not a command (skip or side or show?); `help` lists them.
burn | - | Not recorded: 'burn' is not a command; `help` lists them.
skip 3 | - | Not recorded: `skip` has no argument '3'.
1,234 | 1.234 | Line 3
5.5 | - | yx zero: reading_mm is 5.5; the gauge's range allows a reading from
0.123 | 0.123 | ! Finer than the gauge (line 2): The gauge shows steps of 0.01 mm
\ufffd\x1b[2J | - | is neither a number nor a command
"""
"""What is typed, the recorded cells, and words of the answer."""


JUDGED = (
    "drop 3; back 3; drop; back 3; 0.1",
    "0.1; 0.1; 0.1; 0.1; restart; restart 2; restart",
    "0.123",
)
"""Entries for which readings are predicted and judged, too."""


@pytest.mark.parametrize("entry", ENTRIES.strip().replace("\n    ", " ").splitlines())
def test_entries_on_a_narrow_terminal(folder, run, request, entry):
    typed, read, words = entry.split(" | ")
    if typed not in JUDGED:
        request.getfixturevalue("unjudged")
    code, out, err = run(folder, *typed.split("; "), columns=40)
    assert (code, err) == (0, "")
    assert words in " ".join(out.split())
    expected = [cell.strip("-") for cell in read.split()] + [""] * 7
    assert cells(folder) == expected[: len(cells(folder))]
    assert "\x1b" not in out
    *narrow, command = out.splitlines()
    assert max(map(len, narrow)) <= 40
    assert command == f"  orthocal record {folder}"  # to be copied


WARNING = re.compile(r"^! ([^(:\n]+)(?: \((lines? [^)]*)\))?:(?= |$)", re.MULTILINE)
"""Kind and lines of a warning."""


def require_agreement(out, folder):
    """Compare the warnings at the end of a recording with the findings of `check`."""
    state = out.partition("All readings are recorded.")[2].partition("Enter ends;")[0]
    checked = check_session(load_session(folder)).findings
    findings = [f for f in checked if f.severity != "note"]
    assert [kind.lower() for kind, _ in WARNING.findall(state)] == [f.kind for f in findings]
    for f in findings:
        assert "".join(f.words.split()) in "".join(state.split())
    return findings


def reverse_sign(values, row):
    values[row] = f"{-float(values[row]):.2f}"


def test_misread_turn_is_named_at_once_and_by_check(root, run, tmp_path):
    folder, row = tmp_path / "typed", 13
    values = blank(root / "examples/workshop", folder, recorded=12)
    values[row] = f"{float(values[row]) + 1.0:.2f}"
    _, out, err = run(folder, *values[12:])
    assert err == ""
    at_once = out.partition(f"Recorded: line {row + 2},")[2].partition("Recorded: line")[0]
    assert f"Line {row + 2} differs by" in " ".join(at_once.split())
    assert WARNING.search(at_once)[2].startswith((f"line {row + 2}", f"lines {row + 2}"))
    (finding, *_) = require_agreement(out, folder)
    assert row + 2 in [p.line for p in finding.places]
    assert out.endswith(f"Next: correct or repeat these readings,\n  orthocal record {folder}\n")


def test_a_contradiction_names_the_lines_of_the_most_likely_mistakes(root, run, tmp_path):
    """A wrong sign that only a later reading of another posture shows, without clear evidence."""
    session = sound_session(load_plan(root / "examples/workshop/plan.yaml"), 0, entered=False)
    values = session.values
    values[5] *= -1.0
    blank(root / "examples/workshop", tmp_path / "typed")
    _, out, _ = run(tmp_path / "typed", *(f"{v / MM:.3f}" for v in values[:8]))
    _, last = out.split("! Line 9 differs by ")
    advice = "Check the dial, and lines 5, 7. About one correct reading in 400 is marked, too."
    assert advice in " ".join(last.split())


def test_no_lines_are_suspected_if_warnings_name_all(root, tmp_path):
    blank(root / "examples/workshop", tmp_path / "typed")
    folder = tmp_path / "typed"
    with open_recording(folder) as opened:
        assert recording.Dialogue(opened, str(folder))._find_suspected_lines() == []


def test_a_reading_that_shows_another_offset_is_no_contradiction(root, run, tmp_path):
    """Large offsets, whose signs the first setup does not show."""
    plan = load_plan(root / "examples/workshop/plan.yaml")
    errors = draw_errors(plan.robot, machine_errors(plan.robot), seed=34)
    values = simulate_session(plan, errors, seed=34).session.values
    blank(root / "examples/workshop", tmp_path / "typed")
    _, out, _ = run(tmp_path / "typed", *(f"{v / MM:.3f}" for v in values[:5]))
    assert "The other readings predict -1.65" in out
    assert "differs by" not in out


def test_a_warning_names_all_of_its_lines(root, run, tmp_path):
    """30 of 54 readings have more digits than the dial shows."""
    session = load_session(root / "examples/raw-cycles")
    fine = session.values + 3e-7 * (np.arange(len(session.readings)) < 30)
    write_session(session.with_values(fine), tmp_path / "fine")
    text = run(tmp_path / "fine").stdout
    words = " ".join(text.split())
    assert "Finer than the gauge (lines 2 to 31): The gauge shows" in words
    assert "but 30 of its 54 readings have more digits" in words


def test_reversed_setup_is_named_at_its_end_and_by_check(root, run, tmp_path):
    folder = tmp_path / "typed"
    setups = [r.setup for r in load_plan(root / "examples/raw-cycles").readings if r.cycle == 1]
    start, end = setups.index("xz"), setups.index("yz")
    values = blank(root / "examples/raw-cycles", folder, cycles=1, recorded=start)
    for row in range(start, end):
        reverse_sign(values, row)
    _, out, _ = run(folder, *values[start:])
    first = next(iter(WARNING.finditer(out)))
    assert out.count("Recorded: line", 0, first.start()) <= end - start
    (finding,) = require_agreement(out, folder)
    assert (finding.kind, [p.setup for p in finding.places]) == ("reversed sign", ["xz"])


def test_corrected_mistake_is_resolved(root, run, tmp_path):
    """Until then its reading is excluded from predictions."""
    folder = tmp_path / "typed"
    values = blank(root / "examples/raw-cycles", folder, recorded=12)
    sound = values[13]
    reverse_sign(values, 13)
    _, out, _ = run(folder, *values[12:17], "back 15", sound, values[17])
    assert [kind for kind, _ in WARNING.findall(out)] == ["Reversed sign"]
    assert out.count("Resolved: reversed sign zx x_max.") == 1
    predicted = re.findall(r"predict (\S+) ± (\S+) mm", out.partition("Line 19:")[0])
    for value, (mean, half) in zip(values[14:17], predicted[-3:], strict=True):
        assert abs(float(value) - float(mean)) <= 1.5 * float(half)


def test_warning_that_another_mistake_hides_is_not_resolved(root, run, tmp_path, monkeypatch):
    """The search warns of the second setup unless a later reading is far off."""
    folder, wrong = tmp_path / "typed", 24
    values = blank(root / "examples/raw-cycles", folder, recorded=16)
    sound, values[wrong] = values[wrong], "4.00"
    warning = review("reversed sign", "Reversed.", "", (Place(setup="zx"),))

    def search(session):
        hidden = len(session.readings) < 18 or session.values.max() > 3.9 * MM
        return () if hidden else (warning,)

    monkeypatch.setattr(recording, "find_warnings", search)
    _, out, _ = run(folder, *values[16 : wrong + 1], "back", sound)
    assert [kind for kind, _ in WARNING.findall(out)] == ["Reversed sign"]
    assert f"! Line {wrong + 2} differs by" in out
    assert "Resolved" not in out


def test_warning_is_not_resolved_while_readings_are_inconsistent(root, run, tmp_path, monkeypatch):
    """That finding names no reading: it may be about those of the earlier warning."""
    folder = tmp_path / "typed"
    values = blank(root / "examples/raw-cycles", folder)
    warning = review("reversed sign", "Reversed.", "", (Place(setup="zx"),))
    inconsistent = review("inconsistent readings", "They do not fit.", "Measure again.")
    monkeypatch.setattr(recording.Dialogue, "_is_doubtful", lambda *_: False)
    findings = ((), (), (warning,), (inconsistent,), ())  # from the end of each setup on
    monkeypatch.setattr(
        recording, "find_warnings", lambda session: findings[len(session.readings) // 9]
    )
    _, out, _ = run(folder, *values[:36])
    before, after = out.split("  Recorded: line 37,")
    assert "! Inconsistent readings:" in before
    assert "Resolved" not in before
    assert "Resolved: inconsistent readings and reversed sign zx." in after


def test_a_missing_prediction_is_explained(root, run, tmp_path, monkeypatch):
    """Readings with a warning are excluded: here all others of the setup."""
    folder = tmp_path / "typed"
    values = blank(root / "examples/raw-cycles", folder)
    places = tuple(Place(setup="xy", line=line, file="readings.csv") for line in (2, 3))
    warning = review("ambiguous", "One of these.", "", places)
    monkeypatch.setattr(recording, "find_warnings", lambda session: (warning,))
    monkeypatch.setattr(recording, "is_doubtful", lambda *_: True)
    _, out, _ = run(folder, *values[:4])
    reason = "No prediction: all other readings of this setup have a warning ({})."
    assert re.findall(r"No prediction.*|predict (?=.*±)|Recorded: line \d", out) == [
        "Recorded: line 2",
        "Recorded: line 3",
        reason.format("line 2"),
        "Recorded: line 4",
        reason.format("lines 2, 3"),
        "Recorded: line 5",
        "predict ",
    ]


def test_warnings_of_sound_sessions_are_findings_of_check(root, run, tmp_path):
    """A contradiction in 78 % of all sessions is seen with 95 % probability by these two."""
    example, entered = root / "examples/workshop", tmp_path / "entered"
    write_session(sound_session(load_plan(example), 1, entered=True), entered)
    for source in (example, entered):
        folder = tmp_path / f"typed-{source.name}"
        typed = [v.replace(".", ",").replace("-", "−") for v in blank(source, folder)]
        code, out, err = run(folder, *typed)
        assert (code, err) == (0, "")
        values = load_session(folder).values
        assert values == pytest.approx(load_session(source).values, abs=1e-12)
        warned = {kind.lower() for kind, _ in WARNING.findall(out)}
        assert warned <= {f.kind for f in require_agreement(out, folder)}
        if source == example:
            assert not warned
            assert "All readings are recorded.\nEnter ends; `back` corrects.\n" in out
            assert out.endswith(f"  orthocal calibrate {folder} --out {folder}-calibration\n")


REPEATED = ("zero", "x_max", "zero", "x_max", "zero")
"""Postures of a setup that returns to the first one."""


@pytest.mark.parametrize(
    ("gauge", "values", "kinds"),
    [
        ("sigma_mm: 0.005, resolution_mm: 0.01", (0.1, 0.5, 0.12), []),
        ("sigma_mm: 0.005, resolution_mm: 0.01", (0.1, 0.5, 0.16), ["differing closing reading"]),
        ("sigma_mm: 0.005, resolution_mm: 0.01", (0.1, 0.5, 0.1, 0.45), ["scattered repeats"]),
        ("sigma_mm: 0.005, resolution_mm: 0.01", (0.1, 0.5, 0.1, 0.51, 0.11), []),
        ("sigma_mm: 0.02", (0.1, 0.5, 0.16), []),
        ("sigma_mm: 0.02", (0.1, 0.5, 0.26), ["differing closing reading"]),
        ("sigma_mm: 0.005, resolution_mm: 0.01", (0.1, 0.505), ["finer than the gauge"]),
        ("range_mm: [-5, 5]", (0.1, 0.5, 4.0), ["ambiguous"]),
    ],
)
def test_repeats_that_differ_warn_before_the_setup_is_complete(folder, run, gauge, values, kinds):
    plan = PLAN.replace("sigma_mm: 0.005, resolution_mm: 0.01, range_mm: [-5, 5]", gauge)
    (folder / "session.yaml").write_text(plan + "readings: readings.csv\n")
    rows = [f"yx,{p},{1 + k // 2}," for k, p in enumerate(REPEATED)]
    rows += ["yx,x_max,3,", "zx,zero,1,"]
    (folder / "readings.csv").write_text(
        "\n".join(["setup,posture,cycle,reading_mm", *rows]) + "\n"
    )
    _, out, _ = run(folder, *values)
    assert [kind.lower() for kind, _ in WARNING.findall(out)] == kinds


def test_gauge_is_aligned_in_the_stated_posture(folder, run):
    text = PLAN.replace("yx: {leg: x,", "yx: {leg: x, aligned_at: x_min,")
    (folder / "session.yaml").write_text(text)
    _, out, _ = run(folder)
    words = " ".join(out.partition("Line 2:")[0].split())
    # rod a remains parallel to x, and the section where it is in the reference posture
    assert "the tip in posture x_min touches 55.1 mm from the hinge" in words
    assert "Go to x_min and align the gauge. Then go to zero." in words
    assert "x_min: joints x_slide 210.250 mm" in words


def test_alignment_posture_stays_if_its_line_is_deleted(folder, run):
    code, out, _ = run(folder, "drop 2", "0.1")
    assert code == 0
    assert "session.yaml states now that yx is aligned at zero." in out
    assert load_session(folder, partial=True).alignment_postures == {"yx": "zero", "zx": "zero"}


@pytest.mark.usefixtures("unjudged")
def test_recording_continues_after_an_interruption(folder, run):
    run(folder, "0.1", "skip", "0.3", "0.4", "quit")
    code, out, _ = run(folder, "0.2", "0.5", "0.6", "")
    assert code == 0
    text = " ".join(out.split())
    assert "3 are recorded" in text
    assert "This setup has readings. If the gauge or its stand has moved since" in text
    assert cells(folder) == ["0.10", "0.20", "0.30", "0.40", "0.50", "0.60"]
    assert "State in session.yaml which offsets are active in the controller" in text
    load_session(folder)


@pytest.mark.usefixtures("unjudged")
def test_last_reading_can_be_corrected_at_the_end(folder, run):
    _, out, _ = run(folder, *["0.1"] * 6, "0.3", "back", "0.2", "", "0.9")
    assert cells(folder) == [*["0.10"] * 5, "0.20"]
    assert "no line is asked for; `back 7` goes to line 7" in " ".join(out.split())


def test_line_without_an_end_is_not_recorded(folder):
    done = orthocal("record", folder, typed="0.1\n0.2")
    assert "Not recorded: '0.2', a line without an end." in done.stdout
    assert cells(folder)[:2] == ["0.10", ""]


def test_bytes_that_are_not_text_are_refused(folder):
    done = orthocal("record", folder, typed=b"\xff\xfe\n" + b"9" * 30_000 + b"\n0,12\n")
    assert (done.returncode, done.stderr) == (0, "")
    assert " ".join(done.stdout.split()).count("neither a number nor a command") == 2
    assert cells(folder)[0] == "0.12"


def test_ctrl_c_ends_a_recording_on_a_terminal(folder):
    """Lines can be edited there; recorded readings remain."""
    child, terminal = pty.fork()
    if child == 0:
        os.environ.update(COLUMNS="60", TERM="dumb")
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # ignored if the tests run in the background
        os.execv(sys.executable, [sys.executable, "-m", "orthocal", "record", str(folder)])
    shown = b""

    def until(words, within=TIMEOUT):
        nonlocal shown
        end, start = time.monotonic() + within, len(shown)
        while words not in shown[start:] and time.monotonic() < end:
            if select.select([terminal], [], [], 0.1)[0]:
                try:
                    shown += os.read(terminal, 65536)
                except OSError:
                    return

    until(b"yx zero [mm]> ")
    os.write(terminal, "−0,1X\x7f2\n".encode())
    until(b"yx x_max [mm]> ")
    ended, end = 0, time.monotonic() + TIMEOUT
    while not ended and time.monotonic() < end:
        if b"orthocal record" not in shown:  # readline may miss the first of them
            os.kill(child, signal.SIGINT)
        until(b"orthocal record", within=5.0)
        ended, status = os.waitpid(child, os.WNOHANG)
    assert ended
    os.close(terminal)
    assert os.waitstatus_to_exitcode(status) == 130
    assert b"5 of 6 readings are missing" in shown
    assert cells(folder)[:2] == ["-0.12", ""]
    with open_recording(folder) as recording:
        assert recording.restored == 0


def test_session_that_another_process_records_is_refused(folder, run):
    with open_recording(folder):
        code, out, err = run(folder, "0.1")
    assert (code, out) == (2, "")
    assert err == (
        f"orthocal: {folder}/readings.csv{SUFFIX}: these readings are being recorded by another "
        "process; one at a time\n"
    )


def test_reading_out_of_range_is_read_again(folder, run):
    """Nothing is written before a reading is typed, and a wrong unit is refused."""
    table = "setup,posture,cycle,reading_mm\nyx,zero,1,0.1\nyx,x_max,1,12.3\nyx,x_min,1,0.3\n"
    with (folder / "session.yaml").open("a") as stream:
        stream.write("readings: readings.csv\n")
    csv = folder / "readings.csv"
    csv.write_text(table)
    code, out, _ = run(folder)
    assert code == 0
    assert "readings.csv:3: reading_mm is 12.3;" in " ".join(out.split())
    assert csv.read_text() == table
    run(folder, "12.2", "1.23")
    assert cells(folder) == ["0.10", "1.23", "0.30"]
    csv.write_text(table.replace("0.1", "100").replace("0.3", "30"))
    code, _, err = run(folder)
    assert (code, "for readings in µm" in err) == (2, True)


def with_effects(folder, effects, table=None):
    """Add effects to the plan, and a readings.csv that states approaches."""
    with (folder / "session.yaml").open("a") as stream:
        stream.write(f"calibration: {{effects: [{effects}]}}\n")
    if table is not None:
        (folder / "readings.csv").write_text(table)
        with (folder / "session.yaml").open("a") as stream:
            stream.write("readings: readings.csv\n")


TABLE = """setup,posture,cycle,reading_mm,approach
yx,zero,1,,ppp
yx,zero,1,,nnn
yx,x_min,1,,ppp
zx,zero,1,,ppp
zx,x_min,1,,nnn
"""


@pytest.mark.usefixtures("unjudged")
def test_planned_approach_and_temperature_are_recorded(folder, run):
    """Each setup asks for the temperature; a command changes it."""
    with_effects(folder, "backlash, thermal", TABLE)
    code, out, _ = run(folder, "21,5", "0.01", "0.02", "t 22.5", "0.03", "", "0.04", "-0.05")
    assert code == 0
    text = " ".join(out.split())
    assert text.count("Temperature of the machine in °C?") == 2
    assert "Enter leaves it open" in text
    assert "Enter keeps 22.5 °C" in text
    assert "in the last 2 mm the displayed number of the joint grows (↑) or falls (↓)" in text
    assert "Line 3: yx zero ↓ (4 of 5 missing)" in text
    assert "All 5 readings are recorded." in text
    rows = rows_of(folder)
    assert [r["approach"] for r in rows] == ["ppp", "nnn", "ppp", "ppp", "nnn"]
    assert [r["temperature_C"] for r in rows] == ["21.5", "21.5", "22.5", "22.5", "22.5"]
    assert "time" not in rows[0]  # lines of a pipe have no time
    journal = (folder / f"readings.csv{SUFFIX}").read_text()
    assert journal.count('"temperature_C": 22.5') == 4  # as typed, and with three readings
    session = load_session(folder)
    assert [r.conditions.temperature for r in session.readings][:3] == [21.5, 21.5, 22.5]


CONDITIONS = {
    "without effects": ("", "'t 19,5' 0.01", "19.5", ""),
    "of a setup that continues": ("thermal", "19 0.01 quit '' 0.02", "19 19", ""),
    "of a corrected typing error": (  # the stand was moved since
        "thermal",
        "20 0.1 0.2 0.3 quit 't 27' 'back 2' 0.11",
        "20 20 20",
        "",
    ),
    "corrected after another setup": (
        "thermal",
        "20 0.1 0.2 0.3 30 0.4 'back 2' 't 21' ''",
        "21 20 20 30",
        "",
    ),
    "not of the readings after a corrected one": (
        "backlash, thermal",
        "p 20 0.01 0.02 0.03 '' 0.04 'back 2' 'side n' '' 'back 3' 'side u' 't 25' 0.02 0.05"
        " 'side pnp' 't 21' 0.06",
        "20 25 20 20 20 21",
        "nnn uuu ppp ppp ppp pnp",
    ),
}


@pytest.mark.usefixtures("unjudged")
@pytest.mark.parametrize("name", CONDITIONS)
def test_conditions_of_readings(folder, run, name):
    """`quit` ends a recording, which the next command continues."""
    effects, typed, *columns = CONDITIONS[name]
    with_effects(folder, effects)
    for part in typed.split(" quit "):
        code, out, _ = run(folder, *shlex.split(part))
        assert code == 0, out
    for column, expected in zip(("temperature_C", "approach"), columns, strict=True):
        values = expected.split()
        assert [row.get(column) for row in rows_of(folder)][: len(values)] == values


@pytest.mark.usefixtures("unjudged")
def test_recording_continues_without_a_temperature(folder, run):
    with_effects(folder, "thermal")
    wrong = "hot", "t hot", "t 400"
    code, out, _ = run(folder, "", "0.01", *wrong, "0.02", "t", "0.03", "t 20", "0.04")
    assert code == 0
    assert out.count("Not recorded") == 4
    assert [r.get("temperature_C") for r in rows_of(folder)] == ["", "", "", "20", "", ""]


@pytest.mark.usefixtures("unjudged")
def test_a_recording_that_continues_keeps_temperature_and_deleted_lines(folder, run):
    run(folder, "0.1", "t 22", "drop 3")
    code, out, _ = run(folder, "0.2", "back 3", "t 25", "0.3")
    assert code == 0
    assert "Noted with the next readings, as typed before: 22 °C. `t 20` changes it." in out
    assert "Added: line 8, yx x_max." in out
    rows = {row["posture"]: row for row in rows_of(folder) if row["setup"] == "yx"}
    noted = {p: (row["reading_mm"], row["temperature_C"]) for p, row in rows.items()}
    assert noted == {"zero": ("0.10", ""), "x_min": ("0.20", "22"), "x_max": ("0.30", "25")}
    _, out, _ = run(folder, "back 2", "t 18", "", "0.4", "back 3")
    assert "as typed before: 25 °C" in out
    assert "Not recorded: line 3 is line 8 now." in out
    assert [r["temperature_C"] for r in rows_of(folder)] == ["18", "22", "25", "", "", "25"]
    assert "as typed before: 25 °C" in run(folder)[1]  # 18 °C was that of a corrected reading


@pytest.mark.usefixtures("unjudged")
def test_a_recording_that_continues_keeps_the_side_and_the_stopped_clock(folder, run):
    """No effect needs the side, so that nothing asks for it. A pipe has no clock."""
    run(folder, "side n", "clock", "0.1", "clock", "0.2")
    code, out, _ = run(folder, "0.3", "back 2", "side u", "", "0.4", terminal=True)
    assert code == 0
    text = " ".join(out.split())
    assert "as typed before: approach ↓ (nnn). `side n` changes it." in text
    assert "in their order, a minute apart. `clock` changes it." in text
    rows = rows_of(folder)
    assert [r["approach"] for r in rows] == ["uuu", "nnn", "nnn", "nnn", "", ""]
    assert [bool(r["time"]) for r in rows] == [True, False, False, False, False, False]


def test_setups_of_a_dial_and_gauges_have_no_brackets(folder, run):
    """They name the coordinates of points."""
    plan = (folder / "session.yaml").read_text()
    for changed, named in (
        (plan.replace("yx:", "'y[1]':"), "setups.y[1]"),
        (re.sub("gauge: (.*)", r"gauges: {'dial[1]': \1}", plan), "gauges.dial[1]"),
    ):
        (folder / "session.yaml").write_text(changed)
        code, _, err = run(folder, "0.1")
        assert code == 2
        assert f"{named}: has brackets; expected a name without them" in " ".join(err.split())


@pytest.mark.usefixtures("unjudged")
def test_unusual_temperatures_are_doubted_and_recorded(folder, run):
    """Such as a reading that is typed where the temperature is asked for."""
    with_effects(folder, "thermal")
    _, out, _ = run(folder, "-0.19", "t 20", "0.01", "t 31", "t 35")
    doubted = re.findall(r"Is (\S+) °C the temperature of the machine", " ".join(out.split()))
    assert doubted == ["-0.19", "31"]
    assert rows_of(folder)[0]["temperature_C"] == "20"


@pytest.mark.usefixtures("unjudged")
def test_side_of_approach_is_asked_for_if_the_plan_states_none(folder, run):
    """Enter is the side of the programs; one letter applies to all drives."""
    with_effects(folder, "backlash")
    code, out, _ = run(folder, "", "0.01", "side n", "0.02", "side pnu", "0.03", "side up", "0.04")
    assert code == 0
    text = " ".join(out.split())
    assert text.count("From which side are the postures approached?") == 1
    assert "Enter: ppp (↑), as the programs do" in text
    assert text.count("Not recorded: the side") == 1
    assert [r["approach"] for r in rows_of(folder)] == ["ppp", "nnn", "pnu", "pnu", "", ""]
    # the same command continues, and asks again; Enter keeps the side
    _, out, _ = run(folder, "", "0.05", "side n")
    assert "Enter: pnu (↑↓·), as typed before." in " ".join(out.split())
    assert [r["approach"] for r in rows_of(folder)][4:] == ["pnu", ""]


@pytest.mark.usefixtures("unjudged")
def test_a_typed_side_is_corrected(folder, run):
    """For the line that is asked for: with the reading, or by Enter alone."""
    with_effects(folder, "backlash")
    _, out, _ = run(folder, "p", "0.01", "back", "side n", "0.02", "0.03", "back 3", "side u", "")
    assert "Recorded: line 2, yx zero ↓: 0.02 mm" in out
    # without `side` a corrected reading keeps its approach
    _, out, _ = run(folder, "n", "0.04", "side p", "back 2", "0.05", "back 4", "0.06")
    approaches = [r["approach"] for r in rows_of(folder)]
    assert approaches == ["nnn", "uuu", "nnn", "", "", ""]
    assert cells(folder)[:3] == ["0.05", "0.03", "0.06"]
    # later, and after another setup was read
    _, out, _ = run(folder, "n", "0.07", "back 2", "side pnp", "0.05", "back 3", "side p", "")
    assert "Noted with this reading only: approach ↑↓↑ (pnp)." in " ".join(out.split())
    assert [r["approach"] for r in rows_of(folder)] == ["pnp", "ppp", "nnn", "nnn", "", ""]
    assert cells(folder)[:3] == ["0.05", "0.03", "0.06"]


@pytest.mark.usefixtures("unjudged")
def test_restart_deletes_typed_sides(folder, run):
    """The same command asks for the side again."""
    with_effects(folder, "backlash", TABLE + "yx,x_max,1,,\nyx,x_max,2,,\n")
    run(folder, "0.01", "0.02", "0.03", "n", "0.04")
    run(folder, "restart 2", "restart 2")
    rows = rows_of(folder)
    assert [r["approach"] for r in rows] == ["ppp", "nnn", "ppp", "ppp", "nnn", "", ""]
    assert set(cells(folder)) == {""}
    _, out, _ = run(folder, "0.01", "0.02", "0.03", "p", "0.04")
    assert "From which side are the postures approached?" in out
    assert rows_of(folder)[5]["approach"] == "ppp"


def test_a_wrong_side_is_shown_as_it_was_typed(folder, run):
    with_effects(folder, "backlash")
    _, out, _ = run(folder, "side q", "side pq", "side ↑↓↑")
    text = " ".join(out.split())
    assert "expected 3 letters ('pnp' for these arrows), one for each drive" in text
    expected = "expected 3 letters, one for each drive (x_slide, y_slide, z_slide): p if"
    for typed in ("q", "pq"):
        assert f"Not recorded: the side is '{typed}'; {expected}" in text
    assert text.count("u if unknown; or one of these letters for all drives") == 3


@pytest.mark.usefixtures("unjudged")
def test_a_planned_side_of_approach_stays(folder, run):
    run(folder, "0.01")
    file = folder / "readings.csv"
    head, *rows = file.read_text().splitlines()
    file.write_text("\n".join([f"{head},approach", *(f"{row},ppp" for row in rows), ""]))
    _, out, _ = run(folder, "side n", "0.02")
    assert "Noted with" not in out
    text = " ".join(out.split())
    assert "The plan states the side of this reading: ↑ (ppp)" in text
    assert "approach the posture again as the arrows show" in text
    assert [r["approach"] for r in rows_of(folder)] == ["ppp"] * 6


@pytest.mark.usefixtures("unjudged")
def test_no_condition_is_asked_for_without_effects(folder, run):
    code, out, _ = run(folder, *sound_readings(folder))
    assert code == 0
    assert "Temperature of" not in out
    assert "From which side" not in out
    assert out.endswith(f"Next:\n  orthocal calibrate {folder} --out {folder}-calibration\n")
    assert (folder / "readings.csv").read_text().startswith("setup,posture,reading_mm\n")


@pytest.mark.usefixtures("unjudged")
def test_times_are_recorded_while_the_clock_runs(folder, run):
    """A setup that continues without times gets no further times."""
    _, out, _ = run(folder, "clock", "0.01", "0.02", "clock", "0.03", "clock", "0.04")
    assert "The time is not noted; lines count as read in their order" in " ".join(out.split())
    times = [r["time"] for r in rows_of(folder)]
    assert [bool(t) for t in times] == [True, True, False, True, False, False]
    stamp = datetime.fromisoformat(times[0])
    assert abs((datetime.now().astimezone() - stamp).total_seconds()) < TIMEOUT
    _, out, _ = run(folder, "clock", "0.05")
    assert rows_of(folder)[4]["time"]
    # the first setup has a reading without a time
    _, out, _ = run(folder, "clock", "repeat 2", "0.06")
    assert rows_of(folder)[-1]["time"] == ""


TRACKER = """robot: orthoglide
controller: {offsets_mm: [0, 0, 0]}
gauge: {sigma_mm: 0.01}
postures:
"""


def test_points_are_recorded_and_compared_with_their_prediction(tmp_path, run):
    """A line holds three numbers in any usual form; an error of 1 mm is named at once."""
    corners = [(x, y, z) for x in (-50, 40) for y in (-50, 40) for z in (-40, 50)]
    postures = "".join(f"  p{i}: {{tcp_mm: {list(p)}}}\n" for i, p in enumerate(corners))
    text = f"{TRACKER}{postures}setups:\n  track: {{sensor: points, target_mm: [0, 0, -40]}}\n"
    (tmp_path / "session.yaml").write_text(text)
    shown = simulate_session(load_plan(tmp_path), {"x_slide.offset": 1e-3}, seed=2).session
    points = shown.values.reshape(8, 3) / MM
    forms = ["{:.3f} {:.3f} {:.3f}", "{:.3f}, {:.3f}, {:.3f}", "{:.3f};{:.3f};{:.3f}"]
    typed = [forms[i % 3].format(*p) for i, p in enumerate(points[:-1])]
    points[3] = points[3].round(2)
    typed[3] = "{:.2f} {:.2f} {:.2f}".format(*points[3]).replace(".", ",")
    slip = points[-1] + [0.0, 1.0, 0.0]
    incomplete = ("1 2", "1, ,2", "1.5,,2", "1;2;")
    last = forms[0].format(*slip), "back 9", "", ""
    code, out, err = run(tmp_path, "", *incomplete, *typed, *last)
    assert (code, err) == (0, "")
    assert "Setup track, 1 of 1: 8 readings" in out
    assert "Not recorded: type x, y and z of the point" in out
    assert all(f"Not recorded: '{text}' is no point" in out for text in incomplete)
    differs = re.search(r"! Line 9 y differs by ([0-9.]+) mm\.", out)
    assert float(differs[1]) == pytest.approx(1.0, abs=0.1)
    recorded = [[float(row[f"{k}_mm"]) for k in "xyz"] for row in rows_of(tmp_path)]
    assert np.array(recorded) == pytest.approx(np.vstack([points[:-1], slip]), abs=5e-4)


def test_points_with_their_own_covariance_belong_to_one_setup(tmp_path, run):
    """The instrument is placed once, and the lines are asked for in their order."""
    places = [[0, 0, 0], [-50, 0, 0], [0, 40, 0], [0, 0, -30]]
    postures = "".join(f"  p{i}: {{tcp_mm: {at}}}\n" for i, at in enumerate(places))
    tracker = TRACKER.replace("gauge: {", "gauges: {tracker: {").replace("01}", "01}, dial: {}}")
    (tmp_path / "session.yaml").write_text(
        f"{tracker}{postures}setups:\n  track: {{sensor: points, gauge: tracker}}\n"
        "  yx: {leg: x, direction: y, section: {fraction: 0.5}, gauge: dial}\n"
        "readings: readings.csv\n"
    )
    covariances = ["90,60,400,0,0,0", "", "90,60,400,40,0,0", "90,60,400,0,0,0"]
    rows = [f"track,p{i},,,,,{c or ',,,,,'}" for i, c in enumerate(covariances)]
    rows.insert(2, "yx,p1" + "," * 10)
    header = "setup,posture,x_mm,y_mm,z_mm,reading_mm,cov_xx_um2,cov_yy_um2,cov_zz_um2,cov_xy_um2"
    header += ",cov_xz_um2,cov_yz_um2"
    (tmp_path / "readings.csv").write_text("\n".join([header, *rows]) + "\n")
    code, out, _ = run(tmp_path, *["1 2 3"] * 4, "repeat 2", "", "repeat 3", "4 5 6")
    assert code == 0
    assert re.findall(r"Setup (\w+, . of 2: . reading)", out) == [
        *("track, 1 of 2: 4 reading", "yx, 2 of 2: 1 reading", "track, 1 of 2: 5 reading"),
    ]
    assert "Instrument 'tracker'\n" in out
    assert re.findall(r"^Line (\d+): track", out, re.M)[:5] == ["2", "3", "5", "6", "7"]
    assert [row["cycle"] for row in rows_of(tmp_path)[-2:]] == ["2", "2"]


def test_interrupted_recording_of_points_continues(tmp_path, run):
    """One point does not determine the instrument's frame, yet the session opens."""
    postures = "".join(f"  p{i}: {{tcp_mm: [{i}, 0, {i}]}}\n" for i in range(3))
    text = f"{TRACKER}{postures}setups:\n  track: {{sensor: points}}\n"
    (tmp_path / "session.yaml").write_text(text)
    assert "2 of 3 readings are missing: track lines 3, 4." in run(tmp_path, "1 2 3")[1]
    code, out, _ = run(tmp_path, "4 5 6")
    assert (code, "1 are recorded" in out, "track line 4" in out) == (0, True, True)


def test_a_probe_has_no_rule_for_its_approach(tmp_path, run):
    """It reaches each posture by the motion towards its surface."""
    text = (
        "robot: orthoglide\ngauge: {sigma_mm: 0.01}\npostures: {a: {tcp_mm: [0, 0, 0]}}\nsetups:\n"
    )
    for setups, stated in (
        ("  bed: {sensor: probe, surface: plane}\n", False),
        ("  bed: {sensor: probe, surface: plane}\n  track: {sensor: points}\n", True),
    ):
        folder = tmp_path / str(stated)
        folder.mkdir()
        (folder / "session.yaml").write_text(text + setups)
        assert ("Approach every posture" in run(folder)[1]) == stated


@pytest.mark.usefixtures("unjudged")
def test_a_setup_that_continues_keeps_its_temperature(folder, run):
    with_effects(folder, "thermal")
    run(folder, "19", "0.01")
    _, out, _ = run(folder, "", "0.02")
    assert "Enter keeps 19 °C" in out
    assert [r["temperature_C"] for r in rows_of(folder)][:2] == ["19", "19"]
