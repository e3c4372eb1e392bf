"""Corrected programs against dense samples of what they mean, and another interpreter."""

from __future__ import annotations

import re
import shutil
import subprocess
import tracemalloc

import numpy as np
import pytest
from programs import Move, distances, own_distances, random_program, read_polyline

from orthocal import GcodeError
from orthocal.gcode import words as program_words
from orthocal.gcode.program import ProgramCorrector
from orthocal.gcode.state import Interpreter

WITHIN = 1e-6

EACH = 8
"""Samples of a piece."""

READ_BACK = 0.02
"""[µm] By how much what a random program says with six decimals may differ from what was meant:
arcs end 1e-6 inch off their circle."""


def bend(mm):
    """A smooth correction of a millimetre, bent as those of machines are, mm to mm."""
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


def corrected(text, *, within=WITHIN, offsets=None, start=None, correct=None, file="p.ngc"):
    interpreter = Interpreter(file, axes=(0, 1, 2), offsets=offsets or {}, start=start)
    corrector = ProgramCorrector(
        file, axes=(0, 1, 2), interpreter=interpreter, correct=correct or Bent(), within=within
    )
    lines = "".join(corrector.run(f"{line}\n" for line in text)).splitlines()
    return lines, corrector.summary


def check_program(program, lines, *, within, offset=(0.0, 0.0, 0.0)):
    """Every motion's samples near its pieces, every piece near its motion, its time as it was."""
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


@pytest.mark.parametrize("seed", range(100))
def test_what_is_written_is_near_the_corrected_path(seed):
    offset = (0.0, 0.0, 0.0) if seed % 3 else (12.5, -7.25, 3.0)
    within = [0.3e-6, 1e-6, 20e-6][seed % 3]
    program = random_program(seed, moves=6, offset=offset)
    offsets = {"G54": tuple(v * 1e-3 for v in offset)}
    lines, summary = corrected(program.text, within=within, offsets=offsets)
    check_program(program, lines, within=within, offset=offset)
    assert summary.chord < within
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
def test_lines_that_are_nothing_but_a_place_are_read_the_short_way_alike(seed, monkeypatch):
    """Most lines are; what they mean is told once more, and must be what the long way says."""
    from orthocal.gcode import program

    text = [re.sub(r" \(.*\)$", "", line) for line in random_program(seed, moves=20).text[:-1]]
    text += ["G21 G90 G91.1 G17 G0 X0 Y0 Z0", "F100", *PLAIN]
    offsets = {"G54": (0.0125, -0.001, 0.003)}
    read, split = [], program.split_plain

    def seen(text, number):
        read.append(split(text, number))
        return read[-1]

    monkeypatch.setattr(program, "split_plain", seen)
    short, summary = corrected(text, offsets=offsets)
    assert sum(line is not None for line in read) > 20
    monkeypatch.setattr(program, "split_plain", lambda text, number: None)
    long, expected = corrected(text, offsets=offsets)
    assert short == long
    assert summary == expected


BY_THE_LONG_WAY = [
    "X600", "X1 Z1e1", "X", "X1..2", "X1.2.3", "X--1", "X" + "9" * 999, "G2 X2 I1\nX3", "G20\nX1",
    "G80\nX1", "G1", "G2 X2",
]  # fmt: skip


@pytest.mark.parametrize("lines", BY_THE_LONG_WAY, ids=lambda lines: lines[:10])
def test_the_short_way_refuses_nothing_by_itself(lines, monkeypatch):
    from orthocal.gcode import program

    said = []
    for _ in range(2):
        with pytest.raises(GcodeError) as refused:
            corrected([*HEAD, "G1", *lines.splitlines(), "G81"])
        said.append(str(refused.value))
        monkeypatch.setattr(program, "split_plain", lambda text, number: None)
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
def test_a_line_is_read_once_however_long_its_blanks_and_digits_are(line):
    """In steps in proportion to its length: with as many ways to read it this would take hours."""
    assert program_words.split_plain(f"{line}\n", 1) is None


def test_a_spindle_that_turns_left_is_no_dwell():
    lines, _ = corrected(["G21 G0 X0 Y0 Z0", "M4 S100 G0 X1"], correct=lambda_of(lambda p: p))
    assert lines[1] == "M4 S100 G0 X1.0000 Y0.0000 Z0.0000"


def test_no_zero_is_below_nought():
    lines, _ = corrected(["G21 G0 X-0.00004 Y-0.0 Z-10.00001"], correct=lambda_of(lambda p: p))
    assert lines == ["G21 G0 X0.0000 Y0.0000 Z-10.0000"]


def test_as_few_pieces_as_that_takes():
    """The chord of an arc of 20 mm within 1 µm: s² = 8 r h."""
    text = ["G21 G0 X20 Y0 Z0", "G3 X-20 I-20 F100"]
    lines, _ = corrected(text, correct=lambda_of(lambda p: p))
    at_most = np.pi * 20.0 / np.sqrt(8 * 20.0 * 1e-3)
    assert at_most < len(lines) - 1 < 1.1 * at_most
    lines, _ = corrected(["G21 G0 X0 Y0 Z0", "G1 X100 F100"], correct=lambda_of(lambda p: p))
    assert len(lines) == 11  # none is longer than 10 mm


def lambda_of(function):
    class Simple:
        bound = 0.0

        def __call__(self, points):
            return function(points), {}

    return Simple()


def test_all_else_stays_where_it_is():
    text = [
        "%", "(a comment)", "", "N10 g21 G90 G17 G64 P0.01 T1 M6", "S1000 M3 ;spindle",
        "G0 X0 Y0 Z5", "  n20 G1 Z4 F100 M8 (down) ; and on", "X0.5 M30", "anything # at all", "%",
    ]  # fmt: skip
    lines, summary = corrected(text, correct=lambda_of(lambda p: p + 1e-3))
    assert lines == [
        *text[:5],
        "G0 X1.0000 Y1.0000 Z6.0000",
        "n20 G1 X1.0000 Y1.0000 Z5.0000 F100 M8 (down) ; and on",
        "X1.5000 Y1.0000 Z5.0000 M30",
        *text[8:],
    ]
    assert summary.ended


def test_what_stops_the_program_comes_after_the_last_piece():
    lines, _ = corrected(
        ["G21 G0 X0 Y0 Z0", "N5 M1 G1 X25 F100 M8"], correct=lambda_of(lambda p: p)
    )
    assert lines[1:] == [
        "N5 G1 X8.3333 Y0.0000 Z0.0000 F100 M8",
        "X16.6667 Y0.0000 Z0.0000",
        "X25.0000 Y0.0000 Z0.0000 M1",
    ]


def test_decimals_do_not_add_up_in_steps():
    text = ["G21 G0 X0 Y0 Z0", "G91 F100", *["G1 X0.3333"] * 300]
    lines, _ = corrected(text)
    end = read_polyline(lines)[0][-1][0]
    assert np.linalg.norm(end - bend(np.array([[99.99, 0.0, 0.0]]))[0]) < 1e-4


def test_a_rapid_from_an_unknown_place_goes_straight_to_its_end():
    lines, _ = corrected(["G21 G0 X100 Y0 Z0"])
    assert len(lines) == 1
    lines, _ = corrected(["G21 G0 Z10"], start=(0.001, 0.002, 0.003))
    end = read_polyline(lines)[0][-1][0]
    assert np.abs(end - bend(np.array([[1.0, 2.0, 10.0]]))[0]).max() < 1e-4


HEAD = ["G21 G90 G17", "G0 X0 Y0 Z0", "F100"]

REFUSED = {
    "G81 X1 Z-1 R1": "found G81, which is a canned cycle, whose motions the controller makes",
    "G41 D1": "found G41, which is cutter compensation",
    "G43 H1": "found G43, which is a tool length",
    "G92 X0": "found G92, which moves the program's zero; leave it out, and say where",
    "G93": "found G93, which is inverse time feed; expected G94",
    "G95 F0.1": "found G95, which is feed a revolution",
    "G53 G0 X0": "found G53, which is a motion in other coordinates",
    "G28": "found G28, which goes by way of a place that the controller has stored",
    "G5 X1 I1 J1 P0 Q0": "found G5, which is a spline",
    "G33 Z1 K1": "found G33, which is a motion that the spindle leads",
    "G38.2 Z-1": "found G38.2, which is a probing move",
    "G123": "found G123, which is not known here; expected G0 to G3",
    "G55": "found G55, and nothing says where its zero is in the machine's coordinates; expected "
    "--work-offset-mm G55=X,Y,Z",
    "M98 P1": "found M98, which calls a subroutine",
    "M100": "found M100, which is not known here",
    "G1 A10": "found A10, a rotary axis; expected X, Y, Z",
    "G1 U10": "found U10, a further axis; expected X, Y, Z",
    "#1=5": "found '#1=5' (parameters); expected words such as X1.5 and comments",
    "G1 X[1+2]": "found 'X[1+2]' (expressions)",
    "G1 X#1": "found 'X#1' (parameters)",
    "o100 sub": "found 'o100 sub' (subroutines and loops)",
    "O100": "found O100, subroutines and loops; write their lines out",
    "/G1 X1": "found '/G1 X1' (lines that the controller may leave out)",
    "G1 @1 ^2": "found '@1 ^2' (polar coordinates)",
    "G1 X1 (no end": "found '(no end' (a comment that does not end)",
    "G1 X1 2": "found '2'; expected words",
    "G1 X1 X2": "the word X stands twice",
    "G1 G2 X1": "found G2 beside another word of its kind; expected one",
    "G1 X1 I1": "found I, a word of arcs, where the motion is G1; expected G2 or G3",
    "G1 X1 P2": "found P or Q, which nothing on the line takes",
    "G2 X1 Y1": "found an arc without a centre; expected I and J, or R",
    "G2 X1 Y1 K1 I0": "found K with G17; expected I and J",
    "G2 X1 Y1 I1 R1": "found R and I; expected one of them",
    "G2 X10 Y0 R2": "R is 2 mm, less than half the distance of the arc's ends, 5 mm",
    "G2 R2 Z1": "R with both ends at the same X and Y tells no centre; expected I and J",
    "G2 X10 Y0 I3": "an arc begins 3 mm from its centre and ends 7 mm from it; expected the same",
    "G2 X0 Y0 I3 P1.5": "P is 1.5; expected a whole number of turns",
    "G2 X0 Y0 I400 P9999": "the machine cannot make this motion: it needs more than 50000 pieces",
    "G90.1 G2 X2 I1": "found only I; expected I and J, or R",
    "G80 X1": "found coordinates without a motion; expected G0 to G3",
    "G20 G1 X1": "found G1, and no feed is known; expected F before it, and again after another",
    "G4 P1 X1": "found a dwell and coordinates; expected one of them",
    "G1 X1e3": "found e3, a word of splines",
    "G1 X600": "the machine cannot make this motion: it is too far",
    "G1 X99999999": "X is beyond any machine",
    "F-1": "found a feed of -1",
    "(\x1b[31m)": "a comment holds the control character '\\x1b'",
    "X" + "1" * 2000: "has 2002 characters; expected at most 1000",
}  # fmt: skip


@pytest.mark.parametrize("line", REFUSED, ids=lambda line: line[:20].replace("\x1b", "ESC"))
def test_what_is_not_known_is_refused_by_its_line(line):
    with pytest.raises(GcodeError) as refused:
        corrected([*HEAD, line, "G1 X1"])
    assert str(refused.value).startswith(f"p.ngc:4: {REFUSED[line]}")


def test_what_must_be_known_before():
    for text, message in (
        (["G21 F1 G1 X1"], "where the tool is along Y is not known before this motion; expected a"),
        (["G91 G0 X1 Y1 Z1"], "where the tool is along X is not known"),
        (["F1 G1 X1 Y1 Z1"], "found G1 as the first motion: where the machine stands is not on"),
    ):
        with pytest.raises(GcodeError, match=message):
            corrected(text)


def test_the_first_line_that_is_wrong_is_named():
    """What cannot be reached is found later than words that are not known."""
    with pytest.raises(GcodeError, match=r"^p\.ngc:4: the machine cannot"):
        corrected([*HEAD, "G1 X600", "G81"])


def test_memory_does_not_grow_with_the_program(monkeypatch):
    from orthocal.gcode import program

    monkeypatch.setattr(program, "LINES_AT_ONCE", 100)

    def lines(count):
        yield from ("G21 G0 X0 Y0 Z0\n", "F100\n")
        for i in range(count):
            yield f"G1 X{i % 7} Y{i % 11}.5\n"

    peaks = []
    for count in (300, 3000):
        interpreter = Interpreter("p", axes=(0, 1, 2), offsets={})
        corrector = ProgramCorrector(
            "p", axes=(0, 1, 2), interpreter=interpreter, correct=Bent(), within=WITHIN
        )
        tracemalloc.start()
        for _ in corrector.run(lines(count)):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]


@pytest.mark.parametrize("line", ["%" + " " * 260, "(" + "a" * 300 + ")", "x" * 253])
def test_no_line_behind_the_end_is_longer_than_linuxcnc_reads(line):
    with pytest.raises(GcodeError, match=r"^p\.ngc:5: has \d+ bytes once it is corrected"):
        corrected([*HEAD, "M2", line])


RS274 = shutil.which("rs274")


def interpret(text, folder):
    """Motions of a program as LinuxCNC's interpreter makes them."""
    path = folder / "program.ngc"
    path.write_text("\n".join(text) + "\n", newline="")
    done = subprocess.run(
        [RS274, "-g", "-v", str(folder / "none.var"), str(path)],
        capture_output=True, text=True, check=True, cwd=folder,
    )  # fmt: skip
    unit, plane, feed, at, moves = 1.0, 17, None, np.zeros(3), []
    for name, told in re.findall(r"N\S+ +(\w+)\((.*)\)", done.stdout):
        if name == "USE_LENGTH_UNITS":
            unit = 25.4 if "INCHES" in told else 1.0
        elif name == "SELECT_PLANE":
            plane = {"XY": 17, "XZ": 18, "YZ": 19}[told[-2:]]
        elif name == "SET_FEED_RATE":
            feed = float(told) * unit
        elif name in ("STRAIGHT_FEED", "STRAIGHT_TRAVERSE"):
            end = np.array([float(v) for v in told.split(",")[:3]]) * unit
            moves.append(Move(0, at, end, feed if name == "STRAIGHT_FEED" else None))
            at = end
        elif name == "ARC_FEED":
            a, b, ca, cb, turns, height = (float(v) for v in told.split(",")[:6])
            order = {17: (0, 1, 2), 18: (2, 0, 1), 19: (1, 2, 0)}[plane]
            end, center, normal = np.zeros(3), np.array(at), np.zeros(3)
            end[list(order)] = np.array([a, b, height]) * unit
            center[list(order[:2])] = np.array([ca, cb]) * unit
            normal[order[2]] = 1.0
            first, last = at - center, end - center
            sign = np.sign(turns)
            flat = last - normal * (normal @ last)
            angle = np.arctan2(sign * normal @ np.cross(first, flat), first @ flat) % (2 * np.pi)
            if np.linalg.norm(flat - first) < 2e-3 * unit:
                angle = 2 * np.pi
            angle += 2 * np.pi * (abs(turns) - 1)
            moves.append(Move(0, at, end, feed, center, normal, sign * angle))
            at = end
    return moves


PRINTED_MM = 0.0002
"""rs274 prints ends and centres with four decimals."""


@pytest.mark.skipif(RS274 is None, reason="LinuxCNC's rs274 is not installed (linuxcnc-uspace)")
@pytest.mark.parametrize("seed", range(12))
def test_another_interpreter_before_and_after(seed, tmp_path):
    """Its samples of the program, corrected, against its polyline of what was written."""
    text = random_program(1000 + seed, moves=10, inches=False).text
    lines, _ = corrected(text)
    before, after = interpret(text, tmp_path), interpret(lines, tmp_path)
    assert all(move.center is None for move in after)
    polyline = np.array([move.end for move in after])
    for move in before[1:]:
        dense = bend(move.sample(60))
        assert max(distances(dense, polyline)) < WITHIN * 1e3 + 2 * PRINTED_MM
    assert np.abs(polyline[-1] - bend(before[-1].end[None])[0]).max() < 2 * PRINTED_MM
    times = [sum(m.length / m.feed for m in moves if m.feed) for moves in (before, after)]
    assert times[1] == pytest.approx(times[0], rel=1e-3)


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("line", ["G1 X1 (%s)", "(%s)", "G1 X25 (%s)", "G1 X1 M8 ;%s", "M7%s"])
def test_no_line_is_written_that_is_longer_than_linuxcnc_reads(line, end, tmp_path, monkeypatch):
    """One of 252 bytes, which it reads; one of 253, which is refused here, and there."""
    from orthocal.gcode import program

    def written(fill):
        interpreter = Interpreter("p.ngc", axes=(0, 1, 2), offsets={})
        corrector = ProgramCorrector(
            "p.ngc", axes=(0, 1, 2), interpreter=interpreter, correct=Bent(), within=WITHIN
        )
        text = "".join(corrector.run(f"{t}{end}" for t in [*HEAD, line % fill, "M2"]))
        return text, max(len(part.encode()) for part in text.split("\n"))

    fill = " " if line == "M7%s" else "\xe9"
    missing = 252 - (written(60 * "x" if fill != " " else 60 * " ")[1] - 60)
    n = len(fill.encode())
    longest = " " * (missing % n) + fill * (missing // n)
    text, size = written(longest)
    assert size == 252
    with pytest.raises(GcodeError, match=r"^p\.ngc:4: has 253 bytes once it is corrected"):
        written(" " + longest)
    if RS274:
        interpret(text.split("\n"), tmp_path)
        monkeypatch.setattr(program, "LONGEST_READ", 1000)
        with pytest.raises(subprocess.CalledProcessError):
            interpret(written(" " + longest)[0].split("\n"), tmp_path)
