"""Corrected programs against dense samples of their motions and LinuxCNC's interpreter."""

from __future__ import annotations

import re
import shutil
import subprocess
import tracemalloc

import numpy as np
import pytest
from linuxcnc import only_one
from programs import Move, distances, own_distances, random_program, read_polyline

from orthocal import GcodeError
from orthocal.gcode.interpreter import Interpreter
from orthocal.gcode.lines import split_point_line
from orthocal.gcode.path import arc_about
from orthocal.gcode.program import ProgramCorrector

WITHIN = 1e-6

EACH = 8
"""Samples of each segment."""

READ_BACK = 0.02
"""Rounding of a random program with six decimals, [µm]: arcs end 1e-6 inch off their circle."""


def bend(mm):
    """Smooth correction of about a millimetre with the curvature of a machine's, mm to mm."""
    x, y, z = np.asarray(mm).T
    change = [
        0.8 * np.sin(x / 50.0 + y / 70.0) + 0.003 * z,
        0.6 * np.cos(y / 60.0 - z / 45.0) - 0.01 * x,
        0.7 * np.sin(z / 55.0 + x * y / 9000.0) + 0.4,
    ]
    return mm + np.array(change).T


class Bent:
    bound = 0.0

    def __call__(self, points):
        refused = {int(i): "is too far" for i in np.flatnonzero(np.abs(points).max(axis=1) > 0.5)}
        return bend(points * 1e3) * 1e-3, refused


def corrected(
    text, *, within=WITHIN, offsets=None, start=None, correct=None, one_tool=False, region=None
):
    interpreter = Interpreter(axes=(0, 1, 2), offsets=offsets or {}, start=start, one_tool=one_tool)
    corrector = ProgramCorrector(
        interpreter, correct or Bent(), file="p.ngc", within=within, region=region
    )
    lines = "".join(corrector.run(f"{line}\n" for line in text)).splitlines()
    return lines, corrector.summary


@pytest.mark.parametrize(
    ("last", "outside"),
    [
        ("G1 X60", None),
        ("G1 X60.01", 4),
        ("G2 X-30 Y0 I-30 F100", None),
        ("G3 X-30 Y0 I-30 F100", 4),  # the upper half of the same circle
    ],
)
def test_first_line_that_leaves_the_region_is_named(last, outside):
    region = np.array([[-0.06, 0.06], [-0.06, 0.02], [-np.inf, np.inf]])
    _, summary = corrected(["G21 G90", "G0 X0 Y0 Z-200", "G1 X30 F100", last], region=region)
    assert (summary.outside, summary.motions) == (outside, 3)


def check_program(program, lines, *, within, offset=(0.0, 0.0, 0.0)):
    """Check that each motion stays near its segments and keeps its duration."""
    found = read_polyline(lines, offset)
    last = None
    for move in program.moves:
        pieces = found[move.number]
        ends = np.array([p for p, _ in pieces])
        if last is not None:
            dense = bend(move.sample(EACH * len(ends) + 1))
            polyline = np.vstack([last, ends])
            off = max(own_distances(dense, polyline))
            assert off <= within * 1e3 + READ_BACK * 1e-3, f"N{move.number}: {off * 1e3} µm"
            assert np.linalg.norm(ends[-1] - dense[-1]) < within * 1e3
            if move.feed:
                time = sum(
                    np.linalg.norm(b - a) / feed
                    for (a, _), (b, feed) in zip([(last, None), *pieces], pieces, strict=False)
                )
                assert time == pytest.approx(move.length / move.feed, rel=1e-3)
        last = ends[-1]


@pytest.mark.parametrize("seed", range(27))
def test_written_program_is_near_the_corrected_path(seed):
    offset = (0.0, 0.0, 0.0) if seed % 3 else (12.5, -7.25, 3.0)
    within = [0.3e-6, 1e-6, 20e-6][seed % 3]
    program = random_program(seed, moves=6, offset=offset)
    offsets = {"G54": tuple(v * 1e-3 for v in offset)}
    lines, summary = corrected(program.text, within=within, offsets=offsets)
    check_program(program, lines, within=within, offset=offset)
    assert summary.deviation < within
    assert [line for line in lines if "(move" in line] == [
        line for line in lines if re.match(r"N\d+ .*\(move \d+\)$", line) and "N1 " not in line
    ]


PLAIN = [
    "G1 X1", "X1.5 Y-2.25 Z3", "N7 G01 X-1 Z+2.", "N8X.5Y2", "G00Z5", "Y1 ", "G0 X0 Y0 Z0", "G1 Y3",
    "G91", "X0.3333", "X0.3333Y-.1", "G90", "G20", "F4", "X.25 Y.125", "G21", "F300", "X3 Y3",
    "G54", "X0 Y-0 Z-0.00004", "G3 X2 Y0 I1 J0", "X0 I-1", "G1 X9 Y8 Z7", "N1 G1", "G1 G90 X2",
    "M4 G1 X1", "F200 X2", "X20 Y20 Z20", "%", "G1 X3",
]  # fmt: skip


@pytest.mark.parametrize("seed", range(8))
def test_shortcut_for_point_lines_equals_the_interpreter(seed, monkeypatch):
    from orthocal.gcode import program

    text = [re.sub(r" \(.*\)$", "", line) for line in random_program(seed, moves=20).text[:-1]]
    text += ["G21 G90 G91.1 G17 G0 X0 Y0 Z0", "F100", *PLAIN]
    offsets = {"G54": (0.0125, -0.001, 0.003)}
    read, split = [], program.split_point_line

    def seen(text, number):
        read.append(split(text, number))
        return read[-1]

    monkeypatch.setattr(program, "split_point_line", seen)
    short, summary = corrected(text, offsets=offsets)
    assert sum(line is not None for line in read) > 20
    monkeypatch.setattr(program, "split_point_line", lambda text, number: None)
    long, expected = corrected(text, offsets=offsets)
    assert short == long
    assert summary == expected


WITHOUT_SHORTCUT = [
    "X600", "X1 Z1e1", "X", "X1..2", "X1.2.3", "X--1", "X" + "9" * 999, "G2 X2 I1\nX3", "G20\nX1",
    "G80\nX1", "G1", "G2 X2",
]  # fmt: skip


@pytest.mark.parametrize("lines", WITHOUT_SHORTCUT, ids=lambda lines: lines[:10])
def test_shortcut_refuses_nothing_itself(lines, monkeypatch):
    from orthocal.gcode import program

    said = []
    for _ in range(2):
        with pytest.raises(GcodeError) as refused:
            corrected([*HEAD, "G1", *lines.splitlines(), "G81"])
        said.append(str(refused.value))
        monkeypatch.setattr(program, "split_point_line", lambda text, number: None)
    assert said[0] == said[1]


@pytest.mark.parametrize(
    "line",
    [
        "X1" + " " * 980 + "M8",
        "G1" + " " * 980 + "Q",
        "X" + "1" * 320 + "Y" + "2" * 320 + "Z" + "3" * 320 + "Q",
    ],
    ids=["blanks", "blanks-behind", "digits"],
)
def test_lines_are_matched_in_linear_time(line):
    """With several ways to match blanks or digits these lines would take hours."""
    assert split_point_line(f"{line}\n", 1) is None


def test_m4_is_not_a_dwell():
    lines, _ = corrected(["G21 G0 X0 Y0 Z0", "M4 S100 G0 X1"], correct=as_correction(lambda p: p))
    assert lines[1] == "M4 S100 G0 X1.0000 Y0.0000 Z0.0000"


def test_zero_has_no_sign():
    lines, _ = corrected(["G21 G0 X-0.00004 Y-0.0 Z-10.00001"], correct=as_correction(lambda p: p))
    assert lines == ["G21 G0 X0.0000 Y0.0000 Z-10.0000"]


def test_number_of_segments_follows_the_sagitta():
    """Chords of an arc of 20 mm within 1 µm: s² = 8 r h."""
    text = ["G21 G0 X20 Y0 Z0", "G3 X-20 I-20 F100"]
    lines, _ = corrected(text, correct=as_correction(lambda p: p))
    at_most = np.pi * 20.0 / np.sqrt(8 * 20.0 * 1e-3)
    assert at_most < len(lines) - 1 < 1.1 * at_most
    lines, _ = corrected(["G21 G0 X0 Y0 Z0", "G1 X100 F100"], correct=as_correction(lambda p: p))
    assert len(lines) == 11  # no segment is longer than 10 mm


def as_correction(function):
    class Simple:
        bound = 0.0

        def __call__(self, points):
            return function(points), {}

    return Simple()


def test_other_words_and_comments_are_preserved():
    text = [
        "%", "(a comment)", "", "N10 g21 G90 G17 G64 P0.01 T1 M6", "S1000 M3 ;spindle",
        "G0 X0 Y0 Z5", "  n20 G1 Z4 F100 M8 (down) ; and on", "X0.5 M30", "anything # at all", "%",
    ]  # fmt: skip
    lines, summary = corrected(text, correct=as_correction(lambda p: p + 1e-3))
    assert lines == [
        *text[:5],
        "G0 X1.0000 Y1.0000 Z6.0000",
        "n20 G1 X1.0000 Y1.0000 Z5.0000 F100 M8 (down) ; and on",
        "X1.5000 Y1.0000 Z5.0000 M30",
        *text[8:],
    ]
    assert summary.ended


def test_stops_follow_the_last_segment():
    lines, _ = corrected(
        ["G21 G0 X0 Y0 Z0", "N5 M1 G1 X25 F100 M8"], correct=as_correction(lambda p: p)
    )
    assert lines[1:] == [
        "N5 G1 X8.3333 Y0.0000 Z0.0000 F100 M8",
        "X16.6667 Y0.0000 Z0.0000",
        "X25.0000 Y0.0000 Z0.0000 M1",
    ]


def test_rounding_does_not_accumulate_in_incremental_mode():
    text = ["G21 G0 X0 Y0 Z0", "G91 F100", *["G1 X0.3333"] * 300]
    lines, _ = corrected(text)
    end = read_polyline(lines)[0][-1][0]
    assert np.linalg.norm(end - bend(np.array([[99.99, 0.0, 0.0]]))[0]) < 1e-4


def test_first_rapid_motion_has_one_segment():
    lines, _ = corrected(["G21 G0 X100 Y0 Z0"])
    assert len(lines) == 1
    lines, _ = corrected(["G21 G0 Z10"], start=(0.001, 0.002, 0.003))
    end = read_polyline(lines)[0][-1][0]
    assert np.abs(end - bend(np.array([[1.0, 2.0, 10.0]]))[0]).max() < 1e-4


HEAD = ["G21 G90 G17", "G0 X0 Y0 Z0", "F100"]

REFUSED = {
    "G81 X1 Z-1 R1": "found G81, which is a canned cycle, whose motions the controller makes",
    "G41 D1": "found G41, which is cutter compensation",
    "G43 H1": "found G43, which is a tool length offset, and the length is in the controller; "
    "remove G43, H and G49 from the program; add the length to Z of the work zero",
    "H1": "found H1, a tool length offset; remove it, and state the tip with --tool",
    "G92 X0": "found G92, which moves the zero of the program; set it before",
    "G93": "found G93, which is inverse time feed; expected G94",
    "G95 F0.1": "found G95, which is feed per revolution",
    "G53 G0 X0": "found G53, which is a motion in machine coordinates",
    "G28": "found G28, which is a motion to a position that the controller has stored",
    "G5 X1 I1 J1 P0 Q0": "found G5, which is a spline",
    "G33 Z1 K1": "found G33, which is a motion synchronised with the spindle",
    "G38.2 Z-1": "found G38.2, which is a probing motion",
    "G123": "found G123, which is unknown; expected G0 to G3",
    "G55": "found G55, whose zero in machine coordinates is not stated; expected "
    "--work-offset-mm G55=X,Y,Z",
    "M98 P1": "found M98, which calls a subroutine",
    "M100": "found M100, which is unknown",
    "G1 A10": "found A10, a rotary axis; expected X, Y, Z",
    "G1 U10": "found U10, a secondary axis; expected X, Y, Z",
    "#1=5": "found '#1=5' (parameters); expected words such as X1.5 and comments",
    "G1 X[1+2]": "found 'X[1+2]' (expressions)",
    "G1 X#1": "found 'X#1' (parameters)",
    "o100 sub": "found 'o100 sub' (subroutines and loops)",
    "O100": "found O100, subroutines and loops; write their lines out",
    "/G1 X1": "found '/G1 X1' (optional lines)",
    "G1 @1 ^2": "found '@1 ^2' (polar coordinates)",
    "G1 X1 (no end": "found '(no end' (a comment without an end)",
    "G1 X1 2": "found '2'; expected words",
    "G1 X1 X2": "found the word X twice",
    "G1 G2 X1": "found G2 and another word of its group; expected one",
    "G1 X1 I1": "found I, a word of arcs, and the motion is G1; expected G2 or G3",
    "G1 X1 P2": "found P or Q without a word that needs it",
    "G2 X1 Y1": "found an arc without a centre; expected I and J, or R",
    "G2 X1 Y1 K1 I0": "found K with G17; expected I and J",
    "G2 X1 Y1 I1 R1": "found R and I; expected one of them",
    "G2 X10 Y0 R2": "R is 2 mm, less than half the distance of the arc's ends, 5 mm",
    "G2 R2 Z1": "found R with both ends at the same X and Y, which determines no centre",
    "G2 X10 Y0 I3": "an arc has a radius of 3 mm at its start and 7 mm at its end; expected",
    "G2 X0 Y0 I3 P1.5": "P is 1.5; expected a whole number of turns",
    "G2 X0 Y0 I400 P9999": "the machine cannot make this motion: it needs more than 50000 segments",
    "G90.1 G2 X2 I1": "found only I; expected I and J, or R",
    "G80 X1": "found coordinates without a motion; expected G0 to G3",
    "G20 G1 X1": "found G1 without a feed; expected F before it, and again after a change",
    "G4 P1 X1": "found a dwell and coordinates; expected one of them",
    "G1 X1e3": "found e3, a word of splines",
    "G1 X600": "the machine cannot make this motion: X502.5 Y0 Z0 mm is too far",
    "G1 X99999999": "found X at 1e+08 mm; expected at most 1e+06 mm",
    "F-1": "found a feed of -1",
    "(\x1b[31m)": "a comment holds the control character '\\x1b'",
    "X" + "1" * 2000: "has 2002 characters; expected at most 1000",
}  # fmt: skip


@pytest.mark.parametrize("line", REFUSED, ids=lambda line: line[:20].replace("\x1b", "ESC"))
def test_refused_words_are_named_with_their_line(line):
    with pytest.raises(GcodeError) as refused:
        corrected([*HEAD, line, "G1 X1"])
    assert str(refused.value).startswith(f"p.ngc:4: {REFUSED[line]}")


CUT = ["G0 X0 Y0 Z0", "G1 X1 F100"]

ONE_TOOL = {
    "loaded once": ["T1 M6", *CUT, "M6", "T1 M6", *CUT],
    "preselected": ["T1 M6", *CUT, "T2", "X2", "T1", "M6", *CUT],
    "selected before M6": ["T1", *CUT, "T1 M6", *CUT],
    "changed before it moves": ["T2", "T3 M6", "T1 M6", *CUT],
    "retracted before": ["G0 X0 Y0 Z9", "T1 M6", *CUT],
    "unloaded at the end": ["T1 M6", *CUT, "T0 M6", "G0 Z9", "T1 M6", *CUT],
    "without a number": ["M6", *CUT],
}

SECOND_TOOL = {
    "loaded": (["T1 M6", *CUT, "T2 M6"], 4, "found T2 after motions of T1"),
    "loaded for a rapid motion": (["T1 M6", "G0 X0 Y0 Z0", "T2", "M6"], 4, "found T2 after"),
    "preselected, then loaded": (["T1 M6", "T2", *CUT, "X2", "M6"], 6, "found T2 after motions"),
    "selected without M6": (["T1", *CUT, "N9 T2"], 4, "found T2 after motions of T1"),
    "after a tool without T": ([*CUT, "T2 M6"], 3, "found T2 after motions of the tool that"),
    "both without T": (["M6", *CUT, "M6"], 4, "found M6 without T after motions of the tool"),
    "after an unloaded one": (["T1 M6", *CUT, "T0 M6", "T2 M6"], 5, "found T2 after motions of T1"),
    "after point lines": (["G0 X0 Y0 Z0", "F100", "G1", "X1", "T2 M6"], 5, "found T2 after"),
}


@pytest.mark.parametrize("text", ONE_TOOL.values(), ids=ONE_TOOL)
def test_one_tool_is_accepted_with_a_tip(text):
    assert corrected(["G21", *text], one_tool=True)[1].lines == len(text) + 1


@pytest.mark.parametrize(("text", "number", "message"), SECOND_TOOL.values(), ids=SECOND_TOOL)
def test_second_tool_is_refused_with_a_tip(text, number, message):
    with pytest.raises(GcodeError) as refused:
        corrected(["G21", *text, "G1 X9", "M2"], one_tool=True)
    assert str(refused.value).startswith(f"p.ngc:{number + 1}: {message}")
    assert "expected one tool: split the program by tools" in str(refused.value)
    corrected(["G21", *text, *CUT, "M2"])  # without a tip


def test_position_and_first_motion_must_be_known():
    for text, message in (
        (["G21 F1 G1 X1"], "the position along Y is unknown before this motion; expected a"),
        (["G91 G0 X1 Y1 Z1"], "the position along X is unknown"),
        (["F1 G1 X1 Y1 Z1"], "found G1 as the first motion, from a position that is not on"),
    ):
        with pytest.raises(GcodeError, match=message):
            corrected(text)


@pytest.mark.parametrize("change", ["T2 M6", "M60"])
def test_a_tool_change_may_have_moved_the_machine(change):
    """A retracted axis does not return to its position before the change."""
    text = ["G21 G90 G0 X1 Y2 Z3", "G1 X4 F100", change, "G0 X8 Y9", "Z3", "G1 X5"]
    lines, _ = corrected(text)
    assert lines[2:4] == text[2:4]
    for line, point in ((lines[4], (8.0, 9.0, 3.0)), (lines[-1], (5.0, 9.0, 3.0))):
        found = [float(re.search(rf"{k}(-?[\d.]+)", line)[1]) for k in "XYZ"]
        assert found == pytest.approx(bend([point])[0], abs=1e-3)
    with pytest.raises(GcodeError, match="found G1 as the first motion"):
        corrected([*text[:3], "G1 X8 Y9 Z3"])


def test_a_rapid_motion_to_a_safe_height_may_come_first():
    """As it is, up to the first position in x, y and z, which begins the corrected path."""
    text = ["G21 G90 M3 S900", "N5 G0 Z20 (up)", "X1.5", "Y-2 (over)", "G1 Z3 F100", "G0 Z20"]
    lines, _ = corrected(text)
    assert lines[:3] == text[:3]
    for line, point in ((lines[3], (1.5, -2.0, 20.0)), (lines[-1], (1.5, -2.0, 20.0))):
        found = [float(re.search(rf"{k}(-?[\d.]+)", line)[1]) for k in "XYZ"]
        assert found == pytest.approx(bend([point])[0], abs=1e-3)
    assert lines[3].endswith("(over)")
    interpreter = Interpreter(axes=(0, 1, 2), offsets={})
    list(
        ProgramCorrector(interpreter, Bent(), file="p.ngc", within=WITHIN).run(
            f"{t}\n" for t in text
        )
    )
    assert interpreter.uncorrected == 2
    both, summary = corrected(["G21 G90", "G0 Z20", "X1 Y2"], start=(0.0, 0.0, 0.0))
    assert (len(both), summary.motions) == (3, 2)
    assert both[1].startswith("G0 X")
    with pytest.raises(GcodeError, match=r"^p\.ngc:1: found Z at 2e\+06 mm"):
        corrected(["G21 G90 G0 Z2000000"])
    with pytest.raises(GcodeError, match=r"^p\.ngc:2: the position along X is unknown"):
        corrected(["G21 G90 G0 Z20", "G91 X1 Y1"])


def test_a_point_out_of_reach_is_stated_in_the_programs_coordinates():
    offsets = {"G54": (0.1, 0.0, 0.0)}  # the first sample beyond 500 mm is at 502 mm
    with pytest.raises(GcodeError, match=r"motion: X402 Y0 Z0 mm is too far"):
        corrected(["G20 G90 G54 G0 X0 Y0 Z0", "G0 X19.6850393701"], offsets=offsets)


def test_first_bad_line_is_named():
    """Unreachable points are found later than refused words."""
    with pytest.raises(GcodeError, match=r"^p\.ngc:4: the machine cannot"):
        corrected([*HEAD, "G1 X600", "G81"])


def test_memory_does_not_grow_with_the_program(monkeypatch):
    from orthocal.gcode import program

    monkeypatch.setattr(program, "LINES_PER_BLOCK", 100)

    def lines(count):
        yield from ("G21 G0 X0 Y0 Z0\n", "F100\n")
        for i in range(count):
            yield f"G1 X{i % 7} Y{i % 11}.5\n"

    peaks = []
    for count in (300, 1500):
        interpreter = Interpreter(axes=(0, 1, 2), offsets={})
        corrector = ProgramCorrector(interpreter, Bent(), file="p.ngc", within=WITHIN)
        tracemalloc.start()
        for _ in corrector.run(lines(count)):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]


@pytest.mark.parametrize("line", ["%" + " " * 260, "(" + "a" * 300 + ")", "x" * 253])
def test_long_lines_after_the_end_are_refused(line):
    with pytest.raises(GcodeError, match=r"^p\.ngc:5: has \d+ bytes after correction"):
        corrected([*HEAD, "M2", line])


RS274 = shutil.which("rs274")


def interpret(text, folder):
    """Motions of a program by LinuxCNC's interpreter."""
    path = folder / "program.ngc"
    path.write_text("\n".join(text) + "\n", newline="")
    command = [RS274, "-g", "-v", str(folder / "none.var"), str(path)]
    with only_one():  # two at a time end by a signal (SIGBUS): they share memory
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder)
    unit, plane, feed, at, moves = 1.0, 17, None, np.zeros(3), []
    for name, arguments in re.findall(r"N\S+ +(\w+)\((.*)\)", done.stdout):
        if name == "USE_LENGTH_UNITS":
            unit = 25.4 if "INCHES" in arguments else 1.0
        elif name == "SELECT_PLANE":
            plane = {"XY": 17, "XZ": 18, "YZ": 19}[arguments[-2:]]
        elif name == "SET_FEED_RATE":
            feed = float(arguments) * unit
        elif name in ("STRAIGHT_FEED", "STRAIGHT_TRAVERSE"):
            end = np.array([float(v) for v in arguments.split(",")[:3]]) * unit
            moves.append(Move(0, at, end, feed if name == "STRAIGHT_FEED" else None))
            at = end
        elif name == "ARC_FEED":
            a, b, ca, cb, turns, height = (float(v) for v in arguments.split(",")[:6])
            order = {17: (0, 1, 2), 18: (2, 0, 1), 19: (1, 2, 0)}[plane]
            end, centre, normal = np.zeros(3), np.array(at), np.zeros(3)
            end[list(order)] = np.array([a, b, height]) * unit
            centre[list(order[:2])] = np.array([ca, cb]) * unit
            normal[order[2]] = 1.0
            first, last = at - centre, end - centre
            sign = np.sign(turns)
            flat = last - normal * (normal @ last)
            angle = np.arctan2(sign * normal @ np.cross(first, flat), first @ flat) % (2 * np.pi)
            if np.linalg.norm(flat - first) < 2e-3 * unit:
                angle = 2 * np.pi
            angle += 2 * np.pi * (abs(turns) - 1)
            moves.append(Move(0, at, end, feed, centre, normal, sign * angle))
            at = end
    return moves


PRINTED_MM = 0.0002
"""Rounding of ends and centres by rs274, four decimals, [mm]."""


@pytest.mark.acceptance
@pytest.mark.skipif(RS274 is None, reason="LinuxCNC's rs274 is not installed (linuxcnc-uspace)")
@pytest.mark.parametrize("seed", range(6))
def test_linuxcnc_interpreter_before_and_after_correction(seed, tmp_path):
    """Samples of the program, corrected, against the polyline of the written program."""
    text = random_program(1000 + seed, moves=10, inches=False).text
    lines, _ = corrected(text)
    before, after = interpret(text, tmp_path), interpret(lines, tmp_path)
    assert all(move.centre is None for move in after)
    polyline = np.array([move.end for move in after])
    for move in before[1:]:
        dense = bend(move.sample(60))
        assert max(distances(dense, polyline)) < WITHIN * 1e3 + 2 * PRINTED_MM
    assert np.abs(polyline[-1] - bend(before[-1].end[None])[0]).max() < 2 * PRINTED_MM
    times = [sum(m.length / m.feed for m in moves if m.feed) for moves in (before, after)]
    assert times[1] == pytest.approx(times[0], rel=1e-3)


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("line", ["G1 X1 (%s)", "(%s)", "G1 X25 (%s)", "G1 X1 M8 ;%s", "M7%s"])
def test_longest_written_line_is_what_linuxcnc_reads(line, end, tmp_path, monkeypatch):
    """A line of 252 bytes is read; one of 253 bytes is refused here and by LinuxCNC."""
    from orthocal.gcode import program

    def written(fill):
        interpreter = Interpreter(axes=(0, 1, 2), offsets={})
        corrector = ProgramCorrector(interpreter, Bent(), file="p.ngc", within=WITHIN)
        text = "".join(corrector.run(f"{t}{end}" for t in [*HEAD, line % fill, "M2"]))
        return text, max(len(part.encode()) for part in text.split("\n"))

    fill = " " if line == "M7%s" else "\xe9"
    missing = 252 - (written(60 * "x" if fill != " " else 60 * " ")[1] - 60)
    n = len(fill.encode())
    longest = " " * (missing % n) + fill * (missing // n)
    text, size = written(longest)
    assert size == 252
    with pytest.raises(GcodeError, match=r"^p\.ngc:4: has 253 bytes after correction"):
        written(" " + longest)
    if RS274:
        interpret(text.split("\n"), tmp_path)
        monkeypatch.setattr(program, "LONGEST_READ", 1000)
        with pytest.raises(subprocess.CalledProcessError):
            interpret(written(" " + longest)[0].split("\n"), tmp_path)


@pytest.mark.parametrize("clockwise", [True, False])
@pytest.mark.parametrize("turns", [1, 3])
@pytest.mark.parametrize("off", [0.0, 1e-17, -1e-17, 1e-12, -1e-12])
def test_a_full_circle_may_end_a_rounding_error_beside_its_start(clockwise, turns, off):
    """Both points are computed, such as in G91 and then in G90."""

    def sweep(y, turns):
        start, end, centre = (10e-3, 0.0, 0.0), (10e-3, y, 0.0), (5e-3, 0.0)
        return arc_about(start, end, centre, clockwise=clockwise, plane=17, turns=turns).sweep

    assert sweep(off, turns) == pytest.approx((-1 if clockwise else 1) * turns * 2.0 * np.pi)
    assert abs(sweep(-1e-6 if clockwise else 1e-6, 1)) == pytest.approx(2e-4, rel=1e-6)
