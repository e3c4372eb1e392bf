"""Broken inputs: each has its exact message, exit code 2, no traceback, and leaves no file behind.

Every case spoils one good input in one way and runs one command. Paths in the messages are written
with `{tmp}` for the folder of the case.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from orthocal import calibrate, load_session
from orthocal.calibration.file import calibration_json
from orthocal.cli import main

ROOT = Path(__file__).parents[1]
DIFFERENCES = ROOT / "examples/table1/experiment-2"
CYCLES = ROOT / "examples/raw-cycles"

Edit = Callable[[Path], None]

CALIBRATE = "calibrate {tmp} --out {tmp}/out"
FORWARD = "forward {tmp}/calibration.json {tmp}/joints.csv"
INVERSE = "inverse {tmp}/calibration.json {tmp}/points.csv"
VALIDATE = "validate {tmp}/calibration.json {tmp}"
CORRECT = "correct {tmp}/calibration.json {tmp}/part.ngc --out {tmp}/out.ngc --anyway"
SIMULATE = "simulate {tmp}/plan.yaml --out {tmp}/out"
ONE_ERROR = " --error x_slide.offset_mm=1.2"

PROGRAM = "G21 G0 X0 Y0 Z0\nG1 X1 F100\n"

COMMA = "; a decimal comma? write a point"
MAKE_ONE = "; `orthocal calibrate SESSION --out FOLDER` makes one"

YAML = "machine/orthoglide.yaml"
URDF = "machine/orthoglide.urdf"


@dataclass(frozen=True)
class Case:
    """One broken input."""

    name: str
    message: str
    """What stands on stderr after 'orthocal: '."""
    edits: tuple[Edit, ...] = ()
    command: str = CALIBRATE
    base: str = "differences"
    """differences, cycles, or machine: differences on a robot folder beside the session."""
    calibrated: bool = False
    """Whether a good calibration.json is there too."""


X_CROSSBAR = """<child link="x_crossbar_end"/>
    <origin xyz="0 0 -0.08" rpy="0 0 0"/>"""


def swap(file: str, old: str, new: str) -> Edit:
    def edit(folder: Path) -> None:
        text = (folder / file).read_text(encoding="utf-8")
        assert old in text, f"{file} does not hold {old!r}"
        (folder / file).write_text(text.replace(old, new), encoding="utf-8")

    return edit


def write(file: str, content: str | bytes) -> Edit:
    def edit(folder: Path) -> None:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(content if isinstance(content, bytes) else content.encode())

    return edit


def remove(file: str) -> Edit:
    def edit(folder: Path) -> None:
        (folder / file).unlink()

    return edit


def make_folder(name: str) -> Edit:
    def edit(folder: Path) -> None:
        (folder / name).mkdir(parents=True)

    return edit


def put(file: str, keys: str, value: Any) -> Edit:
    """Set what stands in a JSON file under keys such as parameters.0.name."""

    def edit(folder: Path) -> None:
        document = json.loads((folder / file).read_text(encoding="utf-8"))
        *path, last = (int(k) if k.isdigit() else k for k in keys.split("."))
        inner = document
        for key in path:
            inner = inner[key]
        assert isinstance(last, int) or last in inner, f"{file} has no {keys}"
        inner[last] = value
        (folder / file).write_text(json.dumps(document, indent=1), encoding="utf-8")

    return edit


def session(name: str, old: str, new: str, message: str, *more: Edit) -> Case:
    edits = (swap("session.yaml", old, new), *more)
    return Case(f"session-{name}", "{tmp}/session.yaml" + message, edits)


def session_file(name: str, content: str | bytes, message: str) -> Case:
    return Case(
        f"session-{name}", "{tmp}/session.yaml" + message, (write("session.yaml", content),)
    )


def readings(name: str, old: str, new: str, message: str, base: str = "differences") -> Case:
    return Case(
        f"readings-{name}",
        "{tmp}/readings.csv" + message,
        (swap("readings.csv", old, new),),
        base=base,
    )


def readings_file(name: str, content: str | bytes, message: str) -> Case:
    return Case(
        f"readings-{name}", "{tmp}/readings.csv" + message, (write("readings.csv", content),)
    )


def robot(name: str, old: str, new: str, message: str, *more: Edit) -> Case:
    edits = (swap(YAML, old, new), *more)
    return Case(f"robot-{name}", "{tmp}/" + YAML + message, edits, base="machine")


def urdf(name: str, old: str, new: str, message: str) -> Case:
    edits = (swap(URDF, old, new),)
    return Case(f"urdf-{name}", "{tmp}/" + URDF + message, edits, base="machine")


def urdf_file(name: str, content: str | bytes, message: str) -> Case:
    edits = (write(URDF, content),)
    return Case(f"urdf-{name}", "{tmp}/" + URDF + message, edits, base="machine")


def calibration(name: str, message: str, *edits: Edit, command: str = FORWARD) -> Case:
    return Case(f"calibration-{name}", message, edits, command, "machine", calibrated=True)


def joints(name: str, table: str, message: str) -> Case:
    edits = (write("joints.csv", table),)
    message = "{tmp}/joints.csv" + message
    return Case(f"joints-{name}", message, edits, FORWARD, "machine", calibrated=True)


def points(name: str, table: str, message: str) -> Case:
    edits = (write("points.csv", table),)
    message = "{tmp}/points.csv" + message
    return Case(f"points-{name}", message, edits, INVERSE, "machine", calibrated=True)


def program(name: str, content: str | bytes, message: str, options: str = "") -> Case:
    edits = (write("part.ngc", content),)
    message = message if message.startswith("--") else "{tmp}/part.ngc" + message
    return Case(f"program-{name}", message, edits, CORRECT + options, "machine", calibrated=True)


def simulate(name: str, options: str, message: str, *edits: Edit) -> Case:
    return Case(f"simulate-{name}", message, edits, SIMULATE + options)


X_MAX = "x_max: {tcp_mm: [60, 0, 0]}"
XY = "xy: {leg: y, direction: x, section: {fraction: 0.5}}"
OFFSETS = "controller: {offsets_mm: [0, 0, 0]}\n"
RANGE = "range_mm: [-5, 5]"
SIGMA = "sigma_mm: 0.02"
TITLE = "title: Experiment 2, after mechanical tuning, before calibration"
FORMS = "coordinate_mm, from_root_mm, fraction"
SESSION_KEYS = (
    "robot, title, source, gauge, gauges, postures, controller, calibration, setups, cycles, "
    "readings"
)
SETUPS = "xy, xz, yx, yz, zx, zy"
POSTURES = "x_max, x_min, y_max, y_min, z_max, z_min"
DRIVES = "x_slide, y_slide, z_slide"
LONG = "a" * 300

SESSION_KEY_CASES = [
    session("key-unknown", "title:", "titel:", f": titel: unknown key; known keys: {SESSION_KEYS}"),
    session(
        "key-unknown-in-gauge",
        "sigma_mm:",
        "sigma:",
        ": gauge.sigma: unknown key; known keys: sigma_mm, resolution_mm, range_mm, tip, "
        "scale_tolerance",
    ),
    session(
        "key-unknown-in-posture",
        "x_max: {tcp_mm:",
        "x_max: {tcp:",
        ": postures.x_max.tcp: unknown key; known keys: tcp_mm, joints_mm, joints_deg",
    ),
    session(
        "key-unknown-in-setup",
        "xy: {leg:",
        "xy: {legs:",
        ": setups.xy.legs: unknown key; known keys: sensor, gauge, postures, "
        "aligned_at, zero, direction_tolerance_mrad, section_tolerance_mm, lateral_tolerance_mm, "
        "scale_tolerance, stand, square_tolerance_mrad, leg, direction, section, touches, tip, "
        "beside_mm",
    ),
    session(
        "key-unknown-in-section",
        XY,
        XY.replace("fraction", "part"),
        f": setups.xy.section.part: unknown key; known keys: {FORMS}",
    ),
    session("key-missing", "robot: orthoglide\n", "", ": robot: is missing"),
    session(
        "calibration-model",
        "calibration: {model: offsets}",
        "calibration: {model: all}",
        ": calibration.model: 'all' is not a model of this robot; models: offsets, lengths, full",
    ),
    session(
        "calibration-free",
        "calibration: {model: offsets}",
        "calibration: {free: ['*.ofset']}",
        ": calibration.free: '*.ofset' matches no error parameter; did you mean z_slide.offset, "
        "y_slide.offset, x_slide.offset?",
    ),
    session(
        "calibration-nothing-free",
        "calibration: {model: offsets}",
        "calibration: {model: offsets, free: ['!*.offset']}",
        ": calibration.free: leaves no error free",
    ),
    session(
        "calibration-tolerance-without-unit",
        "calibration: {model: offsets}",
        "calibration: {tolerances: {'*.offset': 2}}",
        ": calibration.tolerances: '*.offset' carries no unit; expected one of the suffixes _mm, "
        "_um, _m, _mrad, _deg, _rad, _ppm, _ppm_per_K, _um_per_min",
    ),
    session(
        "calibration-tolerance-in-metres",
        "calibration: {model: offsets}",
        "calibration: {tolerances: {'*.offset_m': 2}}",
        ": calibration.tolerances: the tolerance of 'x_slide.offset' is 2000 mm; expected at most "
        "200 times the robot's own, 5 mm",
    ),
    session(
        "calibration-tolerance-below-zero",
        "calibration: {model: offsets}",
        "calibration: {tolerances: {'*.offset_mm': -2}}",
        ": calibration.tolerances.*.offset_mm: found '-2'; expected greater than 0",
    ),
    session("key-missing-in-setup", "xy: {leg: y, ", "xy: {", ": setups.xy.leg: is missing"),
    session(
        "key-twice",
        TITLE,
        TITLE + "\ntitle: 2",
        ":8: is not valid YAML: the key 'title' occurs twice",
    ),
    session(
        "posture-twice",
        "  x_min:",
        "  x_max:",
        ":13: is not valid YAML: the key 'x_max' occurs twice",
    ),
    session(
        "key-a-number",
        "  x_max:",
        "  1:",
        ": postures: found the key 1; expected text: put it in quotes",
    ),
    session(
        "key-a-truth-value",
        "  xy: {",
        "  on: {",
        ": setups: found the key True; expected text: put it in quotes",
    ),
    session(
        "key-a-list",
        TITLE,
        "[a, b]: c",
        ":7: is not valid YAML: a key is a list or a mapping; expected text",
    ),
    session(
        "template-left-in",
        "robot: orthoglide",
        "robot: {{ robot }}",
        ":6: is not valid YAML: a key is a list or a mapping; expected text",
    ),
    session(
        "name-with-blank",
        "  x_max:",
        "  x max:",
        ": postures.x max: found 'x max'; expected a name without blanks, commas, semicolons or "
        "quotes",
    ),
]

SESSION_TYPE_CASES = [
    session(
        "text-for-number",
        SIGMA,
        "sigma_mm: small",
        ": gauge.sigma_mm: found 'small'; expected number, unable to parse string as a number",
    ),
    session(
        "number-for-text", "robot: orthoglide", "robot: 5", ": robot: found '5'; expected string"
    ),
    session(
        "number-for-list",
        X_MAX,
        "x_max: {tcp_mm: 60}",
        ": postures.x_max.tcp_mm: found '60'; expected list",
    ),
    session(
        "list-for-keys",
        X_MAX,
        "x_max: [60, 0, 0]",
        ": postures.x_max: found '[60, 0, 0]'; expected keys and values",
    ),
    session(
        "nothing-for-keys",
        f"gauge: {{{SIGMA}, resolution_mm: 0.01, {RANGE}}}",
        "gauge:",
        ": gauge: found nothing; expected keys and values",
    ),
    session(
        "yes-for-number",
        SIGMA,
        "sigma_mm: yes",
        ": gauge.sigma_mm: found 'True'; expected number",
    ),
    session(
        "no-for-coordinate",
        X_MAX,
        "x_max: {tcp_mm: [60, no, 0]}",
        ": postures.x_max.tcp_mm[1]: found 'False'; expected number",
    ),
    session(
        "sigma-negative",
        SIGMA,
        "sigma_mm: -0.02",
        ": gauge.sigma_mm: found '-0.02'; expected greater than 0",
    ),
    session(
        "sigma-infinite",
        SIGMA,
        "sigma_mm: .inf",
        ": gauge.sigma_mm: found 'inf'; expected a finite number",
    ),
    session(
        "sigma-decimal-comma",
        SIGMA,
        "sigma_mm: 0,02",
        ": gauge.sigma_mm: found '0'; expected greater than 0",
    ),
    session(
        "range-reversed",
        RANGE,
        "range_mm: [5, -5]",
        ": gauge.range_mm: found [5.0, -5.0]; expected [lowest, highest]",
    ),
    session(
        "range-of-one",
        RANGE,
        "range_mm: [5]",
        ": gauge.range_mm: found '[5]'; expected at least 2 items",
    ),
    session(
        "cycles-zero",
        "readings: readings.csv",
        "readings: readings.csv\ncycles: 0",
        ": cycles: found '0'; expected greater than or equal to 1",
    ),
]

SESSION_FILE_CASES = [
    session(
        "tab",
        "postures:\n  x_max",
        "postures:\n\tx_max",
        ":12: is not valid YAML: found character that cannot start any token (a tab; indent with "
        "spaces)",
    ),
    session(
        "bracket-open",
        "[60, 0, 0]}\n",
        "[60, 0, 0\n",
        ":13: is not valid YAML: did not find expected ',' or ']'",
    ),
    session(
        "colon-in-text",
        "title: Experiment 2",
        "title: Experiment: 2",
        ":7: is not valid YAML: mapping values are not allowed in this context",
    ),
    session(
        "alias",
        X_MAX,
        "x_max: &p {tcp_mm: [60, 0, 0]}\n  x_far: *p",
        ":13: is not valid YAML: aliases (*name) are not allowed here",
    ),
    session(
        "python-object",
        TITLE,
        "title: !!python/object/apply:os.getcwd []",
        ":7: is not valid YAML: could not determine a constructor for the tag "
        "'tag:yaml.org,2002:python/object/apply:os.getcwd'",
    ),
    session(
        "tag-that-does-not-fit",
        SIGMA,
        "sigma_mm: !!bool perhaps",
        ":9: is not valid YAML: 'perhaps' does not fit its tag !!bool",
    ),
    session(
        "two-documents",
        "readings: readings.csv",
        "readings: readings.csv\n---\nmore: 1",
        ":32: is not valid YAML: expected a single document in the stream, but found another "
        "document",
    ),
    session(
        "half-a-character",
        TITLE,
        'title: "\\ud800"',
        ":7: is not valid YAML: found invalid Unicode character escape code",
    ),
    session_file("list", "- robot\n- setups\n", ": holds a list; expected keys and values"),
    session_file("text", "calibrate this\n", ": holds text; expected keys and values"),
    session_file("empty", "", ": holds nothing; expected keys and values"),
    session_file("comments-only", "# to do\n", ": holds nothing; expected keys and values"),
    session_file(
        "not-utf8", "title: Präzision\n".encode("latin-1"), ": is not UTF-8 text (byte 9)"
    ),
    Case("session-missing", "{tmp}/session.yaml: there is no such file", (remove("session.yaml"),)),
    Case(
        "session-path-missing",
        "{tmp}/first.yaml: there is no such file",
        command="calibrate {tmp}/first.yaml --out {tmp}/out",
    ),
    Case(
        "session-folder-without",
        "{tmp}/machine/session.yaml: there is no such file",
        command="calibrate {tmp}/machine --out {tmp}/out",
    ),
    Case(
        "plan-cube-not-reached",
        "--workspace-mm: the machine does not reach the workspace ±500 mm (cannot be reached: the "
        "loops stay open by # mm, #% of the way from the mechanical zero); it reaches ±79 mm",
        command="plan orthoglide --workspace-mm 500",
    ),
    Case(
        "plan-cube-below-zero",
        "--workspace-mm: found '-5'; expected half the side of a cube, such as 80, or LOW:HIGH of "
        "x,y,z, such as -80:80,-80:80,-80:80, in mm",
        command="plan orthoglide --workspace-mm -5",
    ),
    Case(
        "session-folder-above",
        "{tmp}/above/session.yaml: there is no such file; sessions in it: {tmp}/above/first",
        (write("above/x", ""), write("above/first/session.yaml", "")),
        command="calibrate {tmp}/above --out {tmp}/out",
    ),
    Case(
        "session-folder-above-many",
        "{tmp}/above/session.yaml: there is no such file; sessions in it: "
        + ", ".join(f"{{tmp}}/above/{k}" for k in range(1, 6))
        + ", ...",
        tuple(write(f"above/{k}/session.yaml", "") for k in range(1, 8)),
        command="calibrate {tmp}/above --out {tmp}/out",
    ),
    Case(
        "session-folder-of-a-calibration",
        "{tmp}/one/session.yaml: there is no such file; the folder holds a calibration: name the "
        "session that it was made from",
        (write("one/calibration.json", "{{}}"),),
        command="calibrate {tmp}/one --out {tmp}/out",
    ),
    Case(
        "session-name-too-long",
        f"{{tmp}}/{LONG}: cannot be read: File name too long",
        command=f"calibrate {{tmp}}/{LONG} --out {{tmp}}/out",
    ),
]

SESSION_SENSE_CASES = [
    session(
        "robot-unknown",
        "robot: orthoglide",
        "robot: hexapod",
        ": robot: 'hexapod' is neither a robot of orthocal (orthoglide) nor a folder "
        "({tmp}/hexapod)",
    ),
    session(
        "robot-empty",
        "robot: orthoglide",
        "robot: ''",
        ": robot: '' is neither a robot of orthocal (orthoglide) nor a folder ({tmp})",
    ),
    session(
        "robot-name-too-long",
        "robot: orthoglide",
        f"robot: {LONG}",
        f": robot: '{LONG}' is neither a robot of orthocal (orthoglide) nor a folder "
        f"({{tmp}}/{LONG})",
    ),
    session(
        "leg-unknown",
        XY,
        XY.replace("leg: y", "leg: w"),
        ": setups.xy.leg: 'w' is not a leg of orthoglide; legs: x, y, z",
    ),
    session(
        "direction-along-leg",
        XY,
        XY.replace("direction: x", "direction: -y"),
        ": setups.xy.direction: '-y' is along leg y; a gauge measures across it; square to "
        "it: x, z, -x, -z",
    ),
    session(
        "direction-unknown",
        XY,
        XY.replace("direction: x", "direction: up"),
        ": setups.xy.direction: found 'up'; expected one of x, y, z, -x, -y, -z, or a vector",
    ),
    session(
        "section-two-forms",
        XY,
        XY.replace("0.5", "0.5, from_root_mm: 100"),
        f": setups.xy.section: found from_root_mm and fraction; expected one of {FORMS}",
    ),
    session(
        "section-no-form",
        XY,
        XY.replace("fraction: 0.5", ""),
        f": setups.xy.section: found none; expected one of {FORMS}",
    ),
    session(
        "section-fraction-above-1",
        XY,
        XY.replace("0.5", "1.5"),
        ": setups.xy.section.fraction: found 1.5; expected 0 (root) to 1 (tip)",
    ),
    session(
        "section-off-the-leg",
        XY,
        XY.replace("fraction: 0.5", "coordinate_mm: 500"),
        ": setups.xy.section: in posture 'y_max' the gauge would touch at -89.8 mm from the root; "
        "the leg reaches from 0 to 310.2 mm",
    ),
    session(
        "setup-in-unknown-posture",
        "xy: {leg: y",
        "xy: {postures: [top], leg: y",
        f": setups.xy.postures: 'top' is not a posture; postures: {POSTURES}",
    ),
    session(
        "posture-two-forms",
        X_MAX,
        "x_max: {tcp_mm: [60, 0, 0], joints_mm: [370, 305, 305]}",
        ": postures.x_max: found tcp_mm and joints_mm; expected one of tcp_mm, joints_mm, "
        "joints_deg",
    ),
    session(
        "posture-no-form",
        X_MAX,
        "x_max: {}",
        ": postures.x_max: found none; expected one of tcp_mm, joints_mm, joints_deg",
    ),
    session(
        "posture-two-coordinates",
        X_MAX,
        "x_max: {tcp_mm: [60, 0]}",
        ": postures.x_max.tcp_mm: has 2 coordinates; expected 3",
    ),
    session(
        "posture-no-coordinates",
        X_MAX,
        "x_max: {tcp_mm: []}",
        ": postures.x_max.tcp_mm: found '[]'; expected at least 1 item",
    ),
    session(
        "posture-two-joints",
        X_MAX,
        "x_max: {joints_mm: [370, 305]}",
        f": postures.x_max.joints_mm: has 2 numbers; expected 3, one a drive: {DRIVES}",
    ),
    session(
        "posture-in-degrees",
        X_MAX,
        "x_max: {joints_deg: [370, 305, 305]}",
        ": postures.x_max.joints_deg: drive x_slide is in mm",
    ),
    session(
        "posture-not-a-number",
        X_MAX,
        "x_max: {tcp_mm: [.nan, 0, 0]}",
        ": postures.x_max.tcp_mm[0]: found 'nan'; expected a finite number",
    ),
    session(
        "posture-unreachable",
        X_MAX,
        "x_max: {tcp_mm: [600, 0, 0]}",
        ": postures.x_max: cannot be reached: the loops stay open by # mm, #% of "
        "the way from the mechanical zero",
    ),
    session(
        "posture-beyond-travel",
        X_MAX,
        "x_max: {joints_mm: [500, 310, 310]}",
        ": postures.x_max: x_slide would be at 500.00 mm; it reaches from 120 to 390 mm",
    ),
    session(
        "posture-by-tool-beyond-travel",
        X_MAX,
        "x_max: {tcp_mm: [90, 0, 0]}",
        ": postures.x_max: cannot be reached: joint 'x_slide' would be at "
        "400.3 mm, outside its limits 120 ... 390 mm",
    ),
    session(
        "offsets-two",
        OFFSETS,
        "controller: {offsets_mm: [0, 0]}\n",
        f": controller.offsets_mm: has 2 numbers; expected 3, one a drive: {DRIVES}",
    ),
    session(
        "offsets-none",
        OFFSETS,
        "controller: {}\n",
        ": controller: found none; expected offsets_mm, offsets_deg, offsets_mrad",
    ),
    session(
        "offsets-in-degrees",
        OFFSETS,
        "controller: {offsets_deg: [0, 0, 0]}\n",
        ": controller.offsets_deg: orthoglide has no revolute drive; expected offsets_mm",
    ),
    session(
        "offsets-in-degrees-and-mrad",
        OFFSETS,
        "controller: {offsets_mm: [0, 0, 0], offsets_deg: [0], offsets_mrad: [0]}\n",
        ": controller: found offsets_deg and offsets_mrad; expected one of them",
    ),
    session(
        "offsets-beyond-travel",
        OFFSETS,
        "controller: {offsets_mm: [500, 0, 0]}\n",
        ": controller.offsets_mm: in posture 'x_max' x_slide would be at -129.75 mm; it reaches "
        "from 120 to 390 mm",
    ),
    session(
        "readings-not-named",
        "readings: readings.csv\n",
        "",
        ": readings: is missing; expected the name of a CSV file",
    ),
    Case(
        "session-readings-file-missing",
        "{tmp}/data.csv: there is no such file",
        (swap("session.yaml", "readings.csv", "data.csv"),),
    ),
    Case(
        "session-readings-a-folder",
        "{tmp}/machine: is a directory; expected a file",
        (swap("session.yaml", "readings.csv", "machine"),),
    ),
    session(
        "readings-with-null",
        "readings.csv",
        '"a\\0.csv"',
        ":31: is not valid YAML: a text contains a control character",
    ),
    Case(
        "model-unknown",
        "'ofsets' is not a model of this robot; models: offsets, lengths, full",
        command=CALIBRATE + " --model ofsets",
    ),
    Case(
        "out-a-file",
        "{tmp}/readings.csv: is a file; expected a directory",
        command="calibrate {tmp} --out {tmp}/readings.csv",
    ),
]


def option(name: str, options: str, message: str, command: str = CALIBRATE) -> Case:
    return Case(f"option-{name}", message, command=f"{command} {options}")


OPTION_CASES = [
    option("free-unknown", "--free w_*", "free: 'w_*' matches no error parameter"),
    option("free-nothing", "--free !*", "no free parameters: there is nothing to identify"),
    option(
        "free-twice-the-same",
        "--free x_leg.length,x_coupler.x",
        "'x_coupler.x' and 'x_leg.length' are partly the same error: x_leg.length is made of "
        "x_coupler.x, frame.x_rod_b_tip.x; take one of them out, such as '!x_coupler.x'",
    ),
    option(
        "free-more-than-told",
        "--free *.offset,*_leg.length,*_fork.x --no-prior",
        "{tmp}/readings.csv: the readings do not determine x_slide.offset, y_slide.offset, "
        "z_slide.offset, x_fork.x, y_fork.x, z_fork.x and 3 more: 5 of 9 free parameters can be "
        "told from them. No reading sees a change of these together: x_fork.x up, x_slide.offset "
        "up. No reading sees a change of these together: y_fork.x up, y_slide.offset up. Or use "
        "tolerances as a prior (--prior), or identify base parameters (--base)",
    ),
    option(
        "known-without-value",
        "--known x_leg.length",
        "--known: found 'x_leg.length'; expected NAME=VALUE or NAME=VALUE±TOLERANCE",
    ),
    option(
        "known-without-unit",
        "--known x_leg.length=1",
        "--known: 'x_leg.length' carries no unit; expected one of the suffixes _mm, _um, _m, "
        "_mrad, _deg, _rad, _ppm, _ppm_per_K, _um_per_min",
    ),
    option(
        "known-half-a-tolerance",
        "--known x_leg.length_mm=1±",
        "--known: x_leg.length_mm is ''; expected a number",
    ),
    option(
        "known-negative-tolerance",
        "--known x_leg.length_mm=1+--0.5",
        "known: the tolerance of 'x_leg.length' is -0.5 mm; expected at least 1e-06 mm",
    ),
    option(
        "known-nan",
        "--known x_leg.length_mm=nan",
        "--known: x_leg.length_mm is 'nan'; expected a finite number",
    ),
    option(
        "known-twice",
        "--known x_leg.length_mm=1 --known x_leg.length_mm=2",
        "--known: 'x_leg.length' is given twice",
    ),
    option(
        "known-everything",
        "--known x_slide.offset_mm=1 --known y_slide.offset_mm=1 --known z_slide.offset_mm=1",
        "no free parameters: there is nothing to identify",
    ),
    option(
        "tolerance-tiny",
        "--tolerance *.offset_mm=1e-9",
        "tolerances: the tolerance of 'x_slide.offset' is 1e-09 mm; expected at least 1e-06 mm",
    ),
    option(
        "tolerance-of-what-is-not-free",
        "--tolerance x_leg.length_mm=1",
        "tolerances: 'x_leg.length' matches no free parameter",
    ),
    option(
        "tolerance-of-other-unit",
        "--tolerance *.offset_mrad=1",
        "--tolerance: '*.offset_mrad' has the wrong unit; x_slide.offset is in mm",
    ),
    option(
        "bound-upside-down",
        "--bound x_slide.offset_mm=2:-2",
        "bounds: those of 'x_slide.offset' leave nothing between them",
    ),
    option(
        "bound-half",
        "--bound x_slide.offset_mm=1",
        "--bound: found 'x_slide.offset_mm=1'; expected NAME=LOWEST:HIGHEST",
    ),
    option("loss-unknown", "--loss cubes", "the loss is 'cubes'; expected squares or huber"),
    option(
        "profile-of-what-is-not-free",
        "--profile x_leg.length",
        "x_leg.length: no free parameter to find the interval of",
    ),
    option(
        "base-beside-a-prior",
        "--base --prior",
        "base parameters are identified without any prior",
    ),
    option(
        "compare-unknown-model",
        "--models offsets,all",
        "'all' is not a model of this robot; models: offsets, lengths, full",
        command="compare {tmp}",
    ),
    option(
        "compare-with-nothing",
        "--repeat {tmp}/again",
        "{tmp}/again: there is no such file",
        command="compare {tmp}",
    ),
    option(
        "compare-with-itself",
        "--repeat {tmp}/session.yaml",
        "{tmp}/session.yaml: is the same session: what remains repeats by itself",
        command="compare {tmp}",
    ),
    option(
        "known-a-whole-length",
        "--known x_leg.length_mm=310.25±0.02",
        "known: 'x_leg.length' is 310.25 mm; expected the deviation from nominal (its tolerance is "
        "0.1 mm), not the whole length",
    ),
    option(
        "simulate-tolerance-of-no-use",
        "--error x_slide.offset_mm=1 --tolerance *.offset_mm=2",
        "--tolerance: has no effect without --draw",
        command="simulate {tmp}/session.yaml --out {tmp}/out",
    ),
    Case(
        "accuracy-beyond-reach",
        "{tmp}/points.csv:2: cannot be reached: the loops stay open by # mm, #% of the way from "
        "the mechanical zero",
        (write("points.csv", "x_mm,y_mm,z_mm\n0,0,900\n"),),
        command="accuracy {tmp}/calibration.json {tmp}/points.csv",
        base="machine",
        calibrated=True,
    ),
    Case(
        "accuracy-cube-too-large",
        "--half-side-mm: the machine does not reach a cube of ±500 mm; without this it is ±60 mm "
        "(cannot be reached: the loops stay open by # mm, #% of the way from the mechanical zero)",
        command="accuracy {tmp}/calibration.json --half-side-mm 500",
        base="machine",
        calibrated=True,
    ),
]

HEADER = "setup,posture,minus,reading_mm"
COLUMNS = (
    "expected setup, posture, reading_mm and optionally minus, cycle, approach, temperature_C, time"
)

APPROACH = (
    "expected 3 letters, one for each drive (x_slide, y_slide, z_slide): p if its coordinate grew "
    "in its last motion, n if it fell, u if unknown"
)
TIME = (
    "expected date and time of ISO 8601, such as 2025-03-14T09:26:53 or 2025-03-14T09:26:53+01:00"
)

READINGS_CASES = [
    readings(
        "column-unknown", "reading_mm", "reading_um", f":1: unknown column 'reading_um'; {COLUMNS}"
    ),
    readings(
        "column-missing",
        HEADER,
        "setup,minus,reading_mm",
        ":1: the column 'posture' is missing; found setup, minus, reading_mm",
    ),
    readings(
        "column-twice",
        HEADER,
        "setup,posture,minus,minus,reading_mm",
        ":1: the column 'minus' occurs twice",
    ),
    readings("header-missing", HEADER + "\n", "", f":1: unknown column 'xy'; {COLUMNS}"),
    readings("fields-few", "y_min,-0.43", "-0.43", f":2: has 3 fields; expected 4 ({HEADER})"),
    readings("fields-many", "-0.43", "-0.43,1", f":2: has 5 fields; expected 4 ({HEADER}){COMMA}"),
    readings("setup-unknown", "xy,", "yy,", f":2: 'yy' is not a setup; setups: {SETUPS}"),
    readings(
        "posture-unknown",
        "xy,y_max",
        "xy,y_top",
        f":2: 'y_top' is not a posture; postures: {POSTURES}",
    ),
    readings("posture-empty", "xy,y_max", "xy,", f":2: '' is not a posture; postures: {POSTURES}"),
    readings(
        "minus-unknown",
        "xy,y_max,y_min",
        "xy,y_max,y_low",
        f":2: 'y_low' is not a posture; postures: {POSTURES}",
    ),
    readings(
        "minus-itself", "xy,y_max,y_min", "xy,y_max,y_max", ":2: takes posture 'y_max' off itself"
    ),
    readings("not-a-number", "-0.43", "n/a", ":2: reading_mm is 'n/a'; expected a number"),
    readings(
        "empty-field",
        "-0.43",
        "",
        ":2: reading_mm is empty; expected what the gauge showed, or no row where nothing was read "
        "(`orthocal record` takes it, or drops the row)",
    ),
    readings_file(
        "nothing-read",
        "setup,posture,minus,reading_mm\nxy,y_max,y_min,\nxz,z_max,z_min,\n",
        ": nothing was read yet; `orthocal record` takes the readings",
    ),
    readings(
        "unit-in-field", "-0.43", "-0.43 mm", ":2: reading_mm is '-0.43 mm'; expected a number"
    ),
    readings("underscore", "-0.43", "-0_4.3", ":2: reading_mm is '-0_4.3'; expected a number"),
    readings("other-digits", "-0.43", "٣", ":2: reading_mm is '٣'; expected a number"),
    readings("nan", "-0.43", "NaN", ":2: reading_mm is 'NaN'; expected a finite number"),
    readings("infinite", "-0.43", "-inf", ":2: reading_mm is '-inf'; expected a finite number"),
    readings_file(
        "decimal-comma",
        "setup;posture;minus;reading_mm\nxy;y_max;y_min;-0.43\nxz;z_max;z_min;-0,37\n",
        ":3: reading_mm is '-0,37'; expected a number (a decimal comma? write a point)",
    ),
    readings_file(
        "decimal-comma-or-thousand",
        "setup;posture;minus;reading_mm\nxy;y_max;y_min;-1,234\n",
        ":2: the reading '-1,234' is -1.234 with a decimal comma and -1234 with a decimal point, "
        "and no other reading decides; write it with a decimal point, or use `orthocal import "
        "--decimal comma|point`",
    ),
    readings_file(
        "german-column",
        "Aufstellung;Stellung;Bemerkung;Messwert [mm]\nxy;y_max;;0,43\n",
        f":1: unknown column 'Bemerkung'; {COLUMNS}",
    ),
    readings_file(
        "german-unit",
        "Aufstellung;Stellung;Messwert [µm]\nxy;y_max;0,43\n",
        f":1: unknown column 'Messwert [µm]'; {COLUMNS}",
    ),
    readings_file(
        "two-signs",
        "Aufstellung;Stellung;Messwert [mm]\nxy;y_max;0,43\nxy;y_min;0.3\n",
        ":3: the reading '0.3' has a decimal point, and '0,43' in line 2 a decimal comma; use "
        "one decimal sign",
    ),
    readings_file(
        "three-and-five",
        "Aufstellung,Stellung,Messwert [mm],Zyklus\nxy,y_max,3,5\n",
        ":2: '3,5' may be two cells or one number with a decimal comma; for two cells use "
        "`orthocal import --separator comma`, for one number save the table with semicolons",
    ),
    readings_file(
        "workbook",
        b"PK\x03\x04",
        ": is a workbook; expected a CSV file: `orthocal import` makes one of it",
    ),
    readings(
        "decimal-comma-between-commas",
        "-0.43",
        "-0,43",
        f":2: has 5 fields; expected 4 ({HEADER}){COMMA}",
    ),
    readings_file(
        "approach-too-short",
        "setup,posture,reading_mm,approach\nxy,y_max,0.1,ppn\nxy,y_min,0.2,pp\n",
        f":3: approach is 'pp'; {APPROACH}",
    ),
    readings_file(
        "approach-other-letter",
        "setup,posture,reading_mm,approach\nxy,y_max,0.1,p+n\n",
        f":2: approach is 'p+n'; {APPROACH}",
    ),
    readings_file(
        "temperature-not-a-number",
        "setup,posture,reading_mm,temperature_C\nxy,y_max,0.1,warm\n",
        ":2: temperature_C is 'warm'; expected a number",
    ),
    readings_file(
        "temperature-in-kelvin",
        "setup,posture,reading_mm,temperature_C\nxy,y_max,0.1,294\n",
        ":2: temperature_C is 294; expected degrees Celsius from -50 to 100",
    ),
    readings_file(
        "time-of-a-clock",
        "setup,posture,reading_mm,time\nxy,y_max,0.1,9:26\n",
        f":2: time is '9:26'; {TIME}",
    ),
    readings_file(
        "time-is-a-date",
        "setup,posture,reading_mm,time\nxy,y_max,0.1,2025-03-14\n",
        f":2: time is '2025-03-14'; {TIME}",
    ),
    readings_file(
        "times-with-and-without-zone",
        "setup,posture,reading_mm,time\nxy,y_max,0.1,2025-03-14T09:00\n"
        "xy,y_min,0.1,2025-03-14T09:01+01:00\n",
        ":3: time is '2025-03-14T09:01+01:00'; expected all times of a session with a time zone, "
        "or all without one, as in line 2",
    ),
    *(
        readings_file(
            f"difference-with-{column}",
            f"setup,posture,minus,reading_mm,{column}\nxy,y_max,y_min,0.1,{cell}\n",
            f":2: {column} is '{cell}'; expected an empty cell: the row is a difference, and "
            "conditions belong to single readings",
        )
        for column, cell in (
            ("approach", "ppp"),
            ("temperature_C", "20"),
            ("time", "2025-03-14T09:00"),
        )
    ),
    readings(
        "cycle-zero", "yx,zero,1,", "yx,zero,0,", ":2: cycle is '0'; expected 1, 2, 3 ...", "cycles"
    ),
    readings(
        "cycle-half",
        "yx,zero,1,",
        "yx,zero,1.5,",
        ":2: cycle is '1.5'; expected 1, 2, 3 ...",
        "cycles",
    ),
    readings(
        "cycle-superscript",
        "yx,zero,1,",
        "yx,zero,²,",
        ":2: cycle is '²'; expected 1, 2, 3 ...",
        "cycles",
    ),
    readings(
        "cycle-endless",
        "yx,zero,1,",
        f"yx,zero,{'9' * 5000},",
        f":2: cycle is '{'9' * 55}...'; expected 1, 2, 3 ...",
        "cycles",
    ),
    readings(
        "row-twice",
        "yx,zero,2,",
        "yx,zero,1,",
        ":5: repeats yx zero of cycle 1, first in line 2; number repeated measurements in the "
        "column 'cycle'",
        "cycles",
    ),
    readings(
        "out-of-range",
        "yx,x_min,1,0.19",
        "yx,x_min,1,-5.40",
        ":4: reading_mm is -5.4; the gauge's range allows a reading from -5 to 5",
        "cycles",
    ),
    readings(
        "difference-out-of-range",
        "-0.43",
        "-43",
        ":2: reading_mm is -43; the gauge's range allows a difference from -10 to 10",
    ),
    readings(
        "difference-reversed",
        "xz,z_max,z_min",
        "xy,y_min,y_max",
        ":3: xy y_min − y_max follows from the other differences of setup xy in cycle 1; leave it "
        "out, or give it its own cycle if it was measured apart",
    ),
    readings(
        "difference-redundant",
        "xz,z_max,z_min,",
        "xy,y_max,x_max,1\nxy,y_min,x_max,",
        ":4: xy y_min − x_max follows from the other differences of setup xy in cycle 1; leave it "
        "out, or give it its own cycle if it was measured apart",
    ),
    readings(
        "readings-and-differences",
        "xz,z_max,z_min",
        "xy,y_max,",
        ":3: setup xy has both readings and differences in cycle 1; give the readings only",
    ),
    readings("quote-within", "xy,", '"xy"a,', ":2: is not valid CSV: ',' expected after '\"'"),
    readings_file("empty", "", ":1: is empty; expected a header: setup,posture,reading_mm"),
    readings_file(
        "first-line-blank",
        f"\n{HEADER}\nxy,y_max,y_min,-0.43\n",
        ":1: is blank; expected a header: setup,posture,reading_mm",
    ),
    readings_file("header-only", HEADER + "\n", ": holds no readings"),
    readings_file("not-text", b"\x81\x00\xff", ": is not UTF-8 text (byte 0)"),
    readings_file("utf16", f"{HEADER}\n".encode("utf-16"), ": holds no readings"),
    Case(
        "readings-too-few",
        "{tmp}/readings.csv: the readings do not determine x_slide.offset, y_slide.offset, "
        "z_slide.offset: 1 of 3 free parameters can be told from them. No reading depends on "
        "z_slide.offset: read the legs that are missing, in postures along their own axes. No "
        "reading sees a change of these together: y_slide.offset up, x_slide.offset down. Or use "
        "tolerances as a prior (--prior), or identify base parameters (--base)",
        (write("readings.csv", f"{HEADER}\nxy,y_max,y_min,-0.43\n"),),
    ),
]

PAIR = "[platform, z_foot_end]"
MOTORS = "name_mot: [x_slide, y_slide, z_slide]"
ROWS = "x_parallelogram: {rows: [x, z]}"
SUM = "[x_coupler.x, frame.x_rod_b_tip.x]"
ZERO = "x_slide: {zero_mm: 310.25}"
LEG = "root: x_leg_root\n      tip: x_leg_tip"
RODS = "a: {root: x_bar_a, tip: x_coupler, radius_mm: 5.5}"
LEGS = "  legs:\n" + "".join(
    f"    {leg}:\n      root: {leg}_leg_root\n      tip: {leg}_leg_tip\n      rods:\n"
    f"        a: {{root: {leg}_bar_a, tip: {leg}_coupler, radius_mm: 5.5}}\n"
    f"        b: {{root: {leg}_bar_b, tip: {leg}_rod_b_tip, radius_mm: 5.5}}\n"
    for leg in "xyz"
)
SUFFIXES = "_mm, _um, _m, _mrad, _deg, _rad, _ppm, _ppm_per_K, _um_per_min"
MOVING = ", ".join(
    f"{leg}_{joint}"
    for leg in "xyz"
    for joint in ("slide", "swivel", "bar_a", "coupler", "wrist", "fork", "bar_b")
)

ROBOT_CASES = [
    robot(
        "key-unknown",
        "name_mot:",
        "motors:",
        ": motors: unknown key; known keys: closed_loop, type, name_mot, joint_name, joint_type, "
        "orthocal",
    ),
    robot(
        "key-unknown-in-tcp",
        "tcp: {frame:",
        "tcp: {link:",
        ": orthocal.tcp.link: unknown key; known keys: frame, coordinates",
    ),
    robot("key-missing", "type: [3d, 3d, 3d, 6d, 6d]\n", "", ": type: is missing"),
    robot(
        "nothing-below-orthocal",
        LEGS,
        "  legs:\n",
        ": orthocal.legs: found nothing; expected keys and values",
    ),
    robot("types-too-few", "3d, 6d, 6d]", "3d, 6d]", ": type has 4 entries; closed_loop has 5"),
    robot("type-unknown", "6d, 6d]", "6d, 5d]", ": type[4]: found '5d'; expected '3d' or '6d'"),
    robot(
        "closures-too-few",
        "    z_platform: {}\n",
        "",
        ": orthocal.closures has 4 entries; closed_loop has 5, and each needs one, in the same "
        "order",
    ),
    robot(
        "pair-of-three",
        PAIR,
        "[platform, z_foot_end, tcp]",
        ": closed_loop[4]: found '['platform', 'z_foot_end', 'tcp']'; expected at most 2 items",
    ),
    robot(
        "pair-with-itself",
        PAIR,
        "[platform, platform]",
        ": closed_loop[4]: closes the frame 'platform' on itself",
    ),
    robot(
        "frame-unknown",
        PAIR,
        "[platform, z_hand]",
        ": closed_loop[4]: the URDF has no frame 'z_hand'",
    ),
    robot(
        "motor-unknown",
        MOTORS,
        "name_mot: [x_slide, y_slide, w_slide]",
        f": name_mot: the URDF has no moving joint 'w_slide'; joints: {MOVING}",
        swap(YAML, "    z_slide: {zero_mm: 310.25}\n", ""),
    ),
    robot(
        "motor-twice",
        MOTORS,
        "name_mot: [x_slide, y_slide, y_slide]",
        ": name_mot names a motor twice",
    ),
    robot(
        "joint-name-unknown",
        MOTORS,
        f"{MOTORS}\njoint_name: [x_swivle]\njoint_type: [FIXED]",
        ": joint_name: the URDF has no moving joint 'x_swivle'; did you mean x_swivel?",
    ),
    robot("motor-none", MOTORS, "name_mot: []", ": name_mot: found '[]'; expected at least 1 item"),
    robot(
        "drive-not-a-motor",
        f"    {ZERO}",
        "    w_slide: {zero_mm: 310.25}",
        f": orthocal.drives.w_slide is not in name_mot; motors: {DRIVES}",
    ),
    robot(
        "rows-unknown",
        ROWS,
        ROWS.replace("z]", "w]"),
        ": orthocal.closures.x_parallelogram.rows[1]: found 'w'; expected 'x', 'y', 'z', 'rx', "
        "'ry' or 'rz'",
    ),
    robot(
        "rows-twice",
        ROWS,
        ROWS.replace("z]", "x]"),
        ": orthocal.closures.x_parallelogram.rows is empty or names a row twice",
    ),
    robot(
        "rows-rotation-in-3d",
        ROWS,
        ROWS.replace("z]", "rz]"),
        ": orthocal.closures.x_parallelogram.rows holds a rotation; a 3d closure has x, y, z",
    ),
    robot(
        "sum-unknown",
        SUM,
        SUM.replace("rod_b_tip", "rod_tip"),
        ": orthocal: parameters.x_leg.length: 'frame.x_rod_tip.x' is not an elementary error; did "
        "you mean frame.x_rod_b_tip.x, frame.x_rod_b_tip.rx, frame.z_rod_b_tip.x?",
    ),
    robot(
        "sum-of-two-units",
        SUM,
        SUM.replace("tip.x", "tip.rx"),
        ": orthocal: parameters.x_leg.length: 'frame.x_rod_b_tip.rx' is in rad, 'x_coupler.x' in "
        "m; a sum needs one unit",
    ),
    robot(
        "sum-with-itself",
        SUM,
        "[x_coupler.x, -x_coupler.x]",
        ": orthocal: parameters.x_leg.length: 'x_coupler.x' stands twice",
    ),
    robot(
        "sum-name-taken",
        "    x_leg.length: [",
        "    x_slide.offset: [",
        ": orthocal: parameters.x_slide.offset: this name is taken by an elementary error",
    ),
    robot(
        "model-glob-matches-nothing",
        "['*.offset']",
        "['*.ofset']",
        ": orthocal: models.offsets: '*.ofset' matches no error parameter; did you mean "
        "z_slide.offset, y_slide.offset, x_slide.offset?",
    ),
    robot(
        "model-frees-nothing",
        "['*.offset']",
        "['!*.offset']",
        ": orthocal: models.offsets: leaves no error parameter free",
    ),
    robot(
        "tolerance-without-unit",
        "scale_ppm: 100}",
        "scale_ppm: 100, overrides: {x_slide.offset: 2}}",
        f": orthocal: 'x_slide.offset' carries no unit; expected one of the suffixes {SUFFIXES}",
    ),
    robot(
        "tolerance-of-other-unit",
        "scale_ppm: 100}",
        "scale_ppm: 100, overrides: {x_slide.offset_mrad: 2}}",
        ": orthocal: 'x_slide.offset_mrad' has the wrong unit; x_slide.offset is in mm",
    ),
    robot(
        "tolerance-negative",
        "offset_mm: 5",
        "offset_mm: -5",
        ": orthocal.tolerances.offset_mm: found '-5'; expected greater than 0",
    ),
    robot(
        "tolerance-infinite",
        "offset_mm: 5",
        "offset_mm: .inf",
        ": orthocal.tolerances.offset_mm: found 'inf'; expected a finite number",
    ),
    robot(
        "zero-beyond-limits",
        ZERO,
        "x_slide: {zero_mm: 410.25}",
        ": orthocal.drives.x_slide: the zero, 410.25 mm, is outside the joint's limits 120 ... "
        "390 mm",
    ),
    robot(
        "zero-in-degrees",
        ZERO,
        "x_slide: {zero_deg: 310.25}",
        ": orthocal.drives.x_slide.zero_deg: the drive is prismatic; expected zero_mm",
    ),
    robot(
        "leg-without-length",
        LEG,
        LEG.replace("x_leg_tip", "x_leg_root"),
        ": orthocal.legs.x: root 'x_leg_root' and tip 'x_leg_root' are at the same place",
    ),
    robot(
        "leg-frame-unknown",
        LEG,
        LEG.replace("x_leg_tip", "x_leg_end"),
        ": orthocal.legs.x: the URDF has no frame 'x_leg_end'",
    ),
    robot(
        "rod-without-length",
        RODS,
        RODS.replace("x_coupler", "x_bar_a"),
        ": orthocal.legs.x.rods.a: root 'x_bar_a' and tip 'x_bar_a' are at the same place",
    ),
    robot(
        "rod-frame-unknown",
        RODS,
        RODS.replace("x_coupler", "x_coupling"),
        ": orthocal.legs.x.rods.a: the URDF has no frame 'x_coupling'",
    ),
    robot(
        "rod-radius-zero",
        RODS,
        RODS.replace("5.5", "0"),
        ": orthocal.legs.x.rods.a.radius_mm: found '0'; expected greater than 0",
    ),
    robot(
        "rod-radius-wrong-unit",
        RODS,
        RODS.replace("5.5", "5500"),
        ": orthocal.legs.x.rods.a.radius_mm: found '5500'; expected less than or equal to 500",
    ),
    robot(
        "tcp-unknown",
        "tcp: {frame: tcp",
        "tcp: {frame: tool",
        ": orthocal.tcp.frame: the URDF has no frame 'tool'",
    ),
    robot(
        "passive-start-of-a-drive",
        "  legs:",
        "  passive_start: {x_slide_mm: 0}\n  legs:",
        ": orthocal.passive_start.x_slide_mm: 'x_slide' is not a passive joint of the URDF",
    ),
    robot(
        "passive-start-in-mm",
        "  legs:",
        "  passive_start: {x_swivel_mm: 0}\n  legs:",
        ": orthocal.passive_start.x_swivel_mm: has the wrong unit; the joint is in rad",
    ),
    Case(
        "robot-without-tcp",
        "{tmp}/session.yaml: postures.x_max: machine cannot be commanded by its tool; give joints",
        (swap(YAML, "  tcp: {frame: tcp, coordinates: [x, y, z]}\n", ""),),
        base="machine",
    ),
    Case(
        "robot-two-urdf-files",
        "{tmp}/machine: expected one URDF file, or one named machine.urdf; found orthoglide.urdf, "
        "other.urdf",
        (write("machine/other.urdf", "<robot/>"),),
        base="machine",
    ),
    Case(
        "robot-without-urdf",
        "{tmp}/machine: expected one URDF file, or one named machine.urdf; found none",
        (remove(URDF),),
        base="machine",
    ),
]

XML = '<?xml version="1.0"?>'
SWIVEL = '<joint name="x_swivel" type="revolute">'
SWIVEL_LIMIT = (
    '<axis xyz="0 0 1"/>\n    <limit lower="-1.3" upper="1.3" effort="1000" velocity="2"/>\n'
    '  </joint>\n  <link name="x_rod_a">'
)
TCP_LINK = '<link name="tcp"/>'
BOX = '<geometry><box size="0.034 0.034 0.034"/></geometry>'
TYPES = "expected revolute, continuous, prismatic or fixed"

URDF_CASES = [
    urdf_file(
        "not-xml",
        "robot: orthoglide\n",
        ":1: is not valid XML: Start tag expected, '<' not found, line 1, column 1",
    ),
    urdf_file("no-links", '<robot name="bare"/>', ": has no <link>"),
    Case(
        "urdf-no-joints",
        "{tmp}/machine/orthoglide.yaml: name_mot: the URDF has no moving joint 'x_slide'; "
        "joints: none",
        (write(URDF, '<robot name="bare"><link name="base"/></robot>'),),
        base="machine",
    ),
    urdf_file("not-utf8", "<robot name='ä'/>".encode("latin-1"), ": is not UTF-8 text (byte 13)"),
    urdf(
        "entities",
        XML,
        f'{XML}<!DOCTYPE robot [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>',
        ":1: has a DOCTYPE; a URDF needs none, and it is refused",
    ),
    urdf(
        "entity-from-file",
        XML,
        f'{XML}\n<!DOCTYPE robot [<!ENTITY a SYSTEM "readings.csv">]>',
        ":2: has a DOCTYPE; a URDF needs none, and it is refused",
    ),
    urdf(
        "entity-unknown",
        TCP_LINK,
        TCP_LINK + "&b;",
        ":536: is not valid XML: Entity 'b' not defined, line 536, column 24",
    ),
    Case(
        "urdf-other-root",
        "{tmp}/" + URDF + ":12: the outermost element is <sdf>; expected <robot>",
        (swap(URDF, "<robot name=", "<sdf name="), swap(URDF, "</robot>", "</sdf>")),
        base="machine",
    ),
    urdf("robot-without-name", '<robot name="orthoglide">', "<robot>", ":12: <robot> has no name"),
    urdf(
        "link-twice",
        TCP_LINK,
        f"{TCP_LINK}\n  {TCP_LINK}",
        ":537: the link 'tcp' stands twice; first in line 536",
    ),
    urdf(
        "joint-twice",
        '<joint name="x_fork"',
        '<joint name="x_wrist"',
        ":185: the joint 'x_wrist' stands twice; first in line 171",
    ),
    urdf("link-without-name", TCP_LINK, "<link/>", ":536: <link> has no name"),
    urdf(
        "child-missing",
        '    <child link="x_yoke"/>\n',
        "",
        ":71: joint 'x_swivel' has no <child link=...>",
    ),
    urdf(
        "child-unknown",
        '<child link="x_yoke"/>',
        '<child link="x_joke"/>',
        ":73: joint 'x_swivel': its child 'x_joke' is not a link of this file",
    ),
    urdf(
        "parent-unknown",
        '<parent link="x_slider"/>',
        '<parent link="x_glider"/>',
        ":72: joint 'x_swivel': its parent 'x_glider' is not a link of this file",
    ),
    urdf(
        "mimic",
        SWIVEL,
        f'{SWIVEL}<mimic joint="y_swivel"/>',
        ":71: joint 'x_swivel' mimics another; mimic joints are not supported: Pinocchio's "
        "constraint Jacobians would be wrong",
    ),
    urdf(
        "joint-floating",
        SWIVEL,
        SWIVEL.replace("revolute", "floating"),
        f":71: joint 'x_swivel' is of type 'floating'; {TYPES}",
    ),
    urdf(
        "joint-without-type",
        SWIVEL,
        '<joint name="x_swivel">',
        f":71: joint 'x_swivel' has no type; {TYPES}",
    ),
    urdf(
        "limit-missing",
        SWIVEL_LIMIT,
        re.sub("<limit.*>", "", SWIVEL_LIMIT),
        ":71: joint 'x_swivel' of type revolute has no <limit>",
    ),
    urdf(
        "limit-below-the-lower-left-out",
        SWIVEL_LIMIT,
        SWIVEL_LIMIT.replace('lower="-1.3" upper="1.3"', 'upper="-1.3"'),
        ":76: joint 'x_swivel': its lower limit is above its upper limit (lower is 0 where it is "
        "not given)",
    ),
    urdf(
        "limit-without-effort",
        SWIVEL_LIMIT,
        SWIVEL_LIMIT.replace('effort="1000" ', ""),
        ":76: joint 'x_swivel': its <limit> has no effort",
    ),
    urdf(
        "limit-reversed",
        SWIVEL_LIMIT,
        SWIVEL_LIMIT.replace('upper="1.3"', 'upper="-1.4"'),
        ":76: joint 'x_swivel': its lower limit is above its upper limit",
    ),
    urdf(
        "limit-decimal-comma",
        SWIVEL_LIMIT,
        SWIVEL_LIMIT.replace("-1.3", "-1,3"),
        ":76: lower is '-1,3'; expected a finite number",
    ),
    urdf(
        "axis-zero",
        SWIVEL_LIMIT,
        SWIVEL_LIMIT.replace("0 0 1", "0 0 0"),
        ":75: joint 'x_swivel' has a zero axis",
    ),
    urdf(
        "axis-of-two",
        SWIVEL_LIMIT,
        SWIVEL_LIMIT.replace("0 0 1", "0 1"),
        ":75: xyz is '0 1'; expected 3 finite numbers",
    ),
    urdf(
        "axis-empty",
        SWIVEL_LIMIT,
        SWIVEL_LIMIT.replace(' xyz="0 0 1"', ""),
        ":75: joint 'x_swivel': its <axis> has no xyz",
    ),
    urdf(
        "origin-with-text",
        'xyz="0.04 0 0" rpy="0 0 3.141592653589793"',
        'xyz="0.04 0 0" rpy="0 0 pi"',
        ":534: rpy is '0 0 pi'; expected 3 finite numbers",
    ),
    urdf(
        "damping-with-text",
        SWIVEL,
        f'{SWIVEL}<dynamics damping="low"/>',
        ":71: damping is 'low'; expected a finite number",
    ),
    urdf("visual-without-shape", BOX, "", ":515: <visual> has no <geometry>"),
    urdf(
        "box-with-text",
        BOX,
        BOX.replace("0.034 0", "wide 0", 1),
        ":517: size is 'wide 0.034 0.034'; expected 3 finite numbers",
    ),
    urdf(
        "two-roots",
        TCP_LINK,
        f'{TCP_LINK}\n  <link name="stray"/>',
        ": has 2 root links (base, stray); expected one",
    ),
    urdf(
        "two-parents",
        TCP_LINK,
        f"{TCP_LINK}\n"
        '  <joint name="second" type="fixed"><parent link="base"/><child link="tcp"/></joint>',
        ":538: link 'tcp' is the child of two joints, 'second' and 'tcp_mount'; close loops with "
        "closed_loop in the YAML instead",
    ),
    urdf(
        "no-root",
        TCP_LINK,
        f"{TCP_LINK}\n"
        '  <joint name="back" type="fixed"><parent link="tcp"/><child link="base"/></joint>',
        ": has 0 root links (none); expected one",
    ),
    urdf(
        "ring-apart",
        TCP_LINK,
        f'{TCP_LINK}\n  <link name="p"/>\n  <link name="q"/>\n'
        '  <joint name="pq" type="fixed"><parent link="p"/><child link="q"/></joint>\n'
        '  <joint name="qp" type="fixed"><parent link="q"/><child link="p"/></joint>',
        ": the links p, q do not hang on the root link 'base'",
    ),
    Case(
        "urdf-loops-do-not-close",
        "{tmp}/machine/orthoglide.yaml: its loops do not close in any posture that was found "
        "within the limits of its joints: the best leaves 'x_crossbar_end' and 'x_rod_b_tip' "
        "apart by # mm; set orthocal.drives.<motor>.zero_mm (or zero_deg) and "
        "orthocal.passive_start near a posture that closes",
        # of one leg alone: of three alike any may be the one that stays open
        (swap(URDF, X_CROSSBAR, X_CROSSBAR.replace("-0.08", "-0.9")),),
        base="machine",
    ),
]

NO_CONTROLLER = swap("session.yaml", OFFSETS, "")
CALIBRATION = "{tmp}/calibration.json"
FILE = "calibration.json"

CALIBRATION_CASES = [
    calibration("missing", f"{CALIBRATION}: there is no such file{MAKE_ONE}", remove(FILE)),
    calibration(
        "folder-without",
        f"{{tmp}}/machine/calibration.json: there is no such file{MAKE_ONE}",
        command="forward {tmp}/machine {tmp}/joints.csv",
    ),
    calibration(
        "not-json", f"{CALIBRATION}:1: is not valid JSON: Expecting value", write(FILE, "robot: 1")
    ),
    calibration(
        "cut-off",
        f"{CALIBRATION}:2: is not valid JSON: Expecting property name enclosed in double quotes",
        write(FILE, "{\n"),
    ),
    calibration(
        "a-list", f"{CALIBRATION}: holds a list; expected keys and values", write(FILE, "[]")
    ),
    calibration(
        "schema-other",
        f"{CALIBRATION}: schema is 'orthocal/calibration/9'; expected 'orthocal/calibration/6'",
        swap(FILE, "orthocal/calibration/6", "orthocal/calibration/9"),
    ),
    calibration(
        "schema-missing",
        f"{CALIBRATION}: schema: is missing; expected 'orthocal/calibration/6'",
        write(FILE, "{}"),
    ),
    calibration(
        "key-unknown",
        f"{CALIBRATION}: solver.steps: unknown key; known keys: name, status, iterations, "
        "seconds_build, seconds_solve, hessian, loss, loss_width",
        swap(FILE, '"iterations"', '"steps"'),
    ),
    calibration(
        "key-missing",
        f"{CALIBRATION}: model: is missing",
        swap(FILE, ' "model": "offsets",\n', ""),
    ),
    calibration(
        "key-twice",
        f"{CALIBRATION}: is not valid JSON: the key 'model' occurs twice",
        swap(FILE, ' "model": "offsets",\n', ' "model": "offsets",\n "model": "lengths",\n'),
    ),
    calibration(
        "type-wrong",
        f"{CALIBRATION}: parameters[0].value: found 'none'; expected number, unable to parse "
        "string as a number",
        put(FILE, "parameters.0.value", "none"),
    ),
    calibration(
        "value-infinite",
        f"{CALIBRATION}: noise.dof: found 'inf'; expected a finite number",
        swap(FILE, '"dof": 2.99', '"dof": 1e999'),
    ),
    calibration(
        "covariance-too-large",
        f"{CALIBRATION}: model_covariance: expected rows of the same length",
        put(FILE, "model_covariance.0", [1e-9, 0.0, 0.0, 0.0]),
    ),
    calibration(
        "covariance-too-small",
        f"{CALIBRATION}: model_covariance: expected 3 × 3 numbers, as free parameters",
        put(FILE, "model_covariance", [[1e-9, 0.0], [0.0, 1e-9]]),
    ),
    calibration(
        "section-form",
        f"{CALIBRATION}: setups[0].reads.section.middle: unknown key; known keys: coordinate_mm, "
        "from_root_mm, fraction",
        put(FILE, "setups.0.reads.section", {"middle": 0.5}),
    ),
    calibration(
        "posture-with-too-few-drives",
        f"{CALIBRATION}: postures[1].drives: has 2 numbers; expected 3, one a drive",
        put(FILE, "postures.1.drives", [0.3, 0.3]),
    ),
    calibration(
        "posture-with-too-many-passive",
        f"{CALIBRATION}: postures[0].passive: has 1 numbers; expected 18, one a passive joint",
        put(FILE, "postures.0.passive", [0.0]),
    ),
    calibration(
        "no-residuals",
        f"{CALIBRATION}: residuals: found '[]'; expected at least 1 item",
        put(FILE, "residuals", []),
    ),
    calibration(
        "parameter-unknown",
        f"{CALIBRATION}: parameters[0].name: 'w_slide.offset' is not an error parameter; did you "
        "mean z_slide.offset, y_slide.offset, x_slide.offset?",
        put(FILE, "parameters.0.name", "w_slide.offset"),
    ),
    calibration(
        "parameter-twice",
        f"{CALIBRATION}: parameters[1].name: 'y_slide.offset' stands twice",
        put(FILE, "parameters.0.name", "y_slide.offset"),
    ),
    calibration(
        "parameter-of-other-unit",
        f"{CALIBRATION}: parameters[0].unit: found 'rad'; x_slide.offset is in m",
        put(FILE, "parameters.0.unit", "rad"),
    ),
    calibration(
        "robot-changed",
        f"{CALIBRATION}: was made for another version of robot 'machine': the files in "
        "{tmp}/machine have changed since",
        swap(URDF, 'lower="0.12"', 'lower="0.13"'),
    ),
    calibration(
        "robot-of-another-orthocal",
        f"{CALIBRATION}: names the robot 'hexapod', which does not come with this orthocal",
        put(FILE, "robot.folder", None),
        put(FILE, "robot.name", "hexapod"),
    ),
    calibration(
        "robot-gone",
        f"{CALIBRATION}: robot: 'elsewhere' is neither a robot of orthocal (orthoglide) nor a "
        "folder ({tmp}/elsewhere)",
        put(FILE, "robot.reference", "elsewhere"),
    ),
    calibration(
        "of-other-robot",
        "{tmp}/calibration.json: was made for another version of robot 'machine': the files in "
        "{tmp}/machine have changed since",
        swap(YAML, "zero_mm: 310.25", "zero_mm: 310.2"),
        command=VALIDATE,
    ),
    calibration(
        "offsets-not-entered",
        "{tmp}/session.yaml: controller.offsets_mm: x_slide has 0 mm where the calibration "
        "says to enter -0.527 mm; y_slide has 0 mm where the calibration says to enter 0.592 mm; "
        "z_slide has 0 mm where the calibration says to enter -1.761 mm. A validation needs a "
        "session that was measured with what the calibration says to enter",
        command=VALIDATE,
    ),
    calibration(
        "files-in-wrong-order",
        f"{{tmp}}/session.yaml: is no calibration.json{MAKE_ONE}",
        command="validate {tmp}/session.yaml {tmp}/calibration.json",
    ),
    calibration(
        "controller-offsets-too-few",
        f"{CALIBRATION}: session.controller_offsets: has 0 numbers; expected 3, one a drive: "
        f"{DRIVES}",
        NO_CONTROLLER,
        put(FILE, "session.controller_offsets", []),
        command=VALIDATE,
    ),
    calibration(
        "deviation-negative",
        f"{CALIBRATION}: parameters[0].std: found '-1.0'; expected greater than or equal to 0",
        put(FILE, "parameters.0.std", -1.0),
    ),
    calibration(
        "tolerance-zero",
        f"{CALIBRATION}: parameters[0].tolerance: found '0.0'; expected greater than 0",
        put(FILE, "parameters.0.tolerance", 0.0),
    ),
    calibration(
        "sigma-negative",
        f"{CALIBRATION}: noise.sigma: found '-1.0'; expected greater than or equal to 0",
        put(FILE, "noise.sigma", -1.0),
    ),
    calibration(
        "covariance-asymmetric",
        f"{CALIBRATION}: model_covariance: is not a covariance: expected symmetric numbers without "
        "negative variances",
        put(FILE, "model_covariance.0.1", 1e-9),
    ),
    calibration(
        "covariance-negative",
        f"{CALIBRATION}: model_covariance: is not a covariance: expected symmetric numbers without "
        "negative variances",
        put(FILE, "model_covariance.0.0", -1e-9),
    ),
    calibration(
        "unmodelled-unknown",
        f"{CALIBRATION}: unmodelled.names[1]: 'x_slid.y' is not an error parameter; did you mean "
        "x_slide.y, x_slide.ry, z_slide.y?",
        put(FILE, "unmodelled.names.1", "x_slid.y"),
    ),
    calibration(
        "unmodelled-too-few",
        f"{CALIBRATION}: unmodelled.tolerances: has 1 numbers; expected 126, as names",
        put(FILE, "unmodelled.tolerances", [1e-4]),
    ),
    calibration(
        "leakage-too-small",
        f"{CALIBRATION}: unmodelled.leakage: expected 3 × 126 numbers, free parameters by names",
        put(FILE, "unmodelled.leakage", [[0.0]]),
    ),
    calibration(
        "degrees-of-freedom-negative",
        f"{CALIBRATION}: noise.residual_dof: found '-5.0'; expected greater than or equal to 0",
        NO_CONTROLLER,
        put(FILE, "noise.residual_dof", -5.0),
        command=VALIDATE,
    ),
]

JOINTS = "x_slide_mm,y_slide_mm,z_slide_mm"

TABLE_CASES = [
    joints(
        "column-missing",
        "x_slide_mm,y_slide_mm\n310,310\n",
        ":1: the column 'z_slide_mm' is missing; found x_slide_mm, y_slide_mm",
    ),
    joints(
        "column-unknown",
        "x_mm,y_mm,z_mm\n310,310,310\n",
        ":1: unknown column 'x_mm'; expected x_slide_mm, y_slide_mm, z_slide_mm",
    ),
    joints(
        "beyond-travel",
        f"{JOINTS}\n500,310,310\n",
        ":2: x_slide_mm is 500; the drive reaches from 120 to 390",
    ),
    joints(
        "not-a-number", f"{JOINTS}\nhome,310,310\n", ":2: x_slide_mm is 'home'; expected a number"
    ),
    joints("nan", f"{JOINTS}\n310,nan,310\n", ":2: y_slide_mm is 'nan'; expected a finite number"),
    joints(
        "decimal-comma",
        "x_slide_mm;y_slide_mm;z_slide_mm\n310,25;310;310\n",
        ":2: x_slide_mm is '310,25'; expected a number (a decimal comma? write a point)",
    ),
    joints("empty", "", f":1: is empty; expected a header: {JOINTS}"),
    joints("header-only", f"{JOINTS}\n", ": holds no rows"),
    joints(
        "unreachable",
        f"{JOINTS}\n390,390,390\n",
        ":2: cannot be reached: the loops stay open by # mm, #% of the way from the mechanical "
        "zero",
    ),
    points(
        "column-missing", "x_mm,y_mm\n0,0\n", ":1: the column 'z_mm' is missing; found x_mm, y_mm"
    ),
    points(
        "in-metres", "x_m,y_m,z_m\n0,0,0\n", ":1: unknown column 'x_m'; expected x_mm, y_mm, z_mm"
    ),
    points(
        "beyond-travel",
        "x_mm,y_mm,z_mm\n100,0,0\n",
        ":2: cannot be reached: joint 'x_slide' would be at 410.8 mm, outside its limits 120 ... "
        "390 mm",
    ),
]

PLAN_YX = "yx: {leg: x, direction: y, section: {fraction: 0.5}, postures: [zero, x_max, x_min]}"
PLAN_POSTURES = "zero, x_max, x_min, y_max, y_min, z_max, z_min"

SIMULATE_CASES = [
    simulate(
        "error-unknown",
        " --error x_slide.ofset_mm=1",
        "--error: 'x_slide.ofset' is not an error parameter; did you mean x_slide.offset, "
        "z_slide.offset, y_slide.offset?",
    ),
    simulate(
        "error-of-other-unit",
        " --error x_slide.offset_mrad=1",
        "--error: 'x_slide.offset_mrad' has the wrong unit; x_slide.offset is in mm",
    ),
    simulate(
        "error-without-unit",
        " --error x_slide.offset=1",
        f"--error: 'x_slide.offset' carries no unit; expected one of the suffixes {SUFFIXES}",
    ),
    simulate(
        "error-without-value",
        " --error x_slide.offset_mm",
        "--error: found 'x_slide.offset_mm'; expected NAME=VALUE",
    ),
    simulate(
        "error-decimal-comma",
        " --error x_slide.offset_mm=1,2",
        "--error: x_slide.offset_mm is '1,2'; expected a number (a decimal comma? write a point)",
    ),
    simulate(
        "error-nan",
        " --error x_slide.offset_mm=nan",
        "--error: x_slide.offset_mm is 'nan'; expected a finite number",
    ),
    simulate("no-errors", "", "no errors: give them by --errors, --error or --draw"),
    simulate(
        "draw-unknown",
        " --draw ofsets",
        "--draw: 'ofsets' is neither a model (offsets, lengths, full) nor the name of an error "
        "parameter",
    ),
    simulate(
        "errors-file-missing",
        " --errors {tmp}/lost.yaml",
        "{tmp}/lost.yaml: there is no such file",
    ),
    simulate(
        "errors-file-key-unknown",
        " --errors {tmp}/errors.yaml",
        "{tmp}/errors.yaml: offsets: unknown key; known keys: errors, zeros_mm, sensors",
        write("errors.yaml", "offsets: {x_slide.offset_mm: 1}\n"),
    ),
    simulate(
        "errors-file-name-unknown",
        " --errors {tmp}/errors.yaml",
        "{tmp}/errors.yaml: errors: 'x_slid.offset' is not an error parameter; did you mean "
        "x_slide.offset, z_slide.offset, y_slide.offset?",
        write("errors.yaml", "errors: {x_slid.offset_mm: 1}\n"),
    ),
    simulate(
        "errors-file-name-twice",
        " --errors {tmp}/errors.yaml",
        "{tmp}/errors.yaml: errors: 'x_slide.offset' is given twice",
        write("errors.yaml", "errors: {x_slide.offset_mm: 1, x_slide.offset_um: 1}\n"),
    ),
    simulate(
        "errors-file-without-errors",
        " --errors {tmp}/errors.yaml",
        "{tmp}/errors.yaml: errors: found '{}'; expected at least 1 item",
        write("errors.yaml", "errors: {}\n"),
    ),
    simulate(
        "plan-sigma-missing",
        ONE_ERROR,
        "{tmp}/plan.yaml: gauge.sigma_mm: is missing: the noise to simulate is not known",
        swap("plan.yaml", "sigma_mm: 0.01, ", ""),
    ),
    simulate(
        "plan-missing",
        ONE_ERROR,
        "{tmp}/plan.yaml: there is no such file",
        remove("plan.yaml"),
    ),
    simulate(
        "plan-posture-unknown",
        ONE_ERROR,
        f"{{tmp}}/plan.yaml: setups.yx.postures: 'top' is not a posture; postures: {PLAN_POSTURES}",
        swap("plan.yaml", PLAN_YX, PLAN_YX.replace("[zero", "[top")),
    ),
    simulate(
        "plan-posture-twice",
        ONE_ERROR,
        "{tmp}/plan.yaml: setups.yx.postures: 'zero' stands twice",
        swap("plan.yaml", PLAN_YX, PLAN_YX.replace("[zero", "[zero, zero")),
    ),
    simulate(
        "plan-no-postures",
        ONE_ERROR,
        "{tmp}/plan.yaml: setups.yx.postures: found '[]'; expected at least 1 item",
        swap("plan.yaml", PLAN_YX, PLAN_YX.replace("zero, x_max, x_min", "")),
    ),
    simulate(
        "plan-off-the-leg",
        ONE_ERROR,
        "{tmp}/plan.yaml: setups.yx.section: in posture 'x_max' the gauge would touch at 339.2 mm "
        "from the root; the leg reaches from 0 to 310.2 mm",
        swap("plan.yaml", PLAN_YX, PLAN_YX.replace("0.5", "0.9")),
    ),
    simulate(
        "out-of-range",
        " --exact --error x_slide.offset_mm=25",
        "{tmp}/plan.yaml: gauge.range_mm: the simulated reading xy y_min is -8.146 mm; the "
        "gauge's range ends at -5 mm",
    ),
    simulate(
        "session-there",
        ONE_ERROR,
        "{tmp}/out/session.yaml: exists already; --force overwrites it",
        write("out/session.yaml", "mine"),
    ),
    simulate(
        "readings-there",
        ONE_ERROR,
        "{tmp}/out/readings.csv: exists already; --force overwrites it",
        write("out/readings.csv", "mine"),
    ),
    Case(
        "simulate-out-a-file",
        "{tmp}/readings.csv: is a file; expected a directory",
        command="simulate {tmp}/plan.yaml --out {tmp}/readings.csv" + ONE_ERROR,
    ),
    Case(
        "simulate-out-name-too-long",
        f"{{tmp}}/{LONG}: cannot be written: File name too long",
        command=f"simulate {{tmp}}/plan.yaml --out {{tmp}}/{LONG}" + ONE_ERROR,
    ),
]

VIEW = "view {tmp}/session.yaml --html {tmp}/out/page.html"
NO_SUBJECT = (
    ": there is no such file or folder; expected a calibration.json, a session.yaml, a folder that "
    "holds one, or a robot (orthoglide, or its folder)"
)
MESH_LINE = '<geometry><box size="0.36 0.05 0.018"/></geometry>'


def mesh(name: str, filename: str, message: str, *more: Edit) -> Case:
    """A robot whose first visual is a mesh."""
    old = MESH_LINE + '\n      <material name="frame"/>\n    </visual>\n    <visual>'
    new = old.replace(MESH_LINE, f'<geometry><mesh filename="{filename}"/></geometry>')
    return Case(
        f"view-mesh-{name}",
        "{tmp}/machine/orthoglide.urdf" + message,
        (swap(URDF, old, new), *more),
        command="view {tmp}/machine --html {tmp}/out/page.html",
    )


VIEW_CASES = [
    *(
        Case(
            f"view-calibration-{keys}",
            f"{{tmp}}/calibration.json: {where}: {message}",
            (put("calibration.json", keys, "w"),),
            command="view {tmp}/calibration.json --html {tmp}/a.html",
            base="machine",
            calibrated=True,
        )
        for keys, where, message in (
            (
                "setups.1.reads.leg",
                "setups[1].reads.leg",
                "'w' is not a leg of machine; legs: x, y, z",
            ),
            (
                "setups.0.reads.direction",
                "setups[0].reads.direction",
                "found 'w'; expected one of x, y, z, -x, -y, -z, or a vector",
            ),
            (
                "residuals.2.posture",
                "residuals[2].posture",
                "'w' is not among the file's postures",
            ),
            (
                "residuals.3.minus",
                "residuals[3].minus",
                "'w' is not among the file's postures",
            ),
            ("residuals.0.setup", "residuals[0].setup", "'w' is not among the file's setups"),
        )
    ),
    Case("view-nothing", "{tmp}/none" + NO_SUBJECT, command="view {tmp}/none --html {tmp}/a.html"),
    Case("view-robot-unknown", "delta" + NO_SUBJECT, command="view delta --html {tmp}/a.html"),
    Case(
        "view-empty-folder",
        "{tmp}/empty: holds neither a calibration.json nor a session.yaml, nor is it a robot's "
        "folder (no *.urdf)",
        (write("empty/note.txt", ""),),
        command="view {tmp}/empty --html {tmp}/a.html",
    ),
    Case(
        "view-readings-as-subject",
        "{tmp}/readings.csv: is neither a calibration.json nor a session.yaml, nor a robot's URDF "
        "or YAML",
        command="view {tmp}/readings.csv --html {tmp}/a.html",
    ),
    Case(
        "view-posture",
        "posture: 'x_top' is not a posture; postures: x_max, x_min, y_max, y_min, z_max, z_min",
        command=VIEW + " --posture x_top",
    ),
    Case(
        "view-posture-of-a-robot",
        "posture: a robot has no postures; name a session",
        command="view orthoglide --html {tmp}/a.html --posture zero",
    ),
    Case(
        "view-exaggerate",
        "exaggeration: is -3; expected a positive number",
        command=VIEW + " --exaggerate -3",
    ),
    Case(
        "view-show",
        "show: 'arrows' is none of readings, tool, all",
        command=VIEW + " --show arrows",
    ),
    *(
        Case(
            f"view-size-{size}",
            f"--size: found '{size}'; expected WIDTHxHEIGHT in pixels, such as 1400x900, each 100 "
            "to 8000",
            command=f"view orthoglide --png {{tmp}}/a.png --size {size}",
        )
        for size in ("big", "1400", "0x900", "1400x900x3", "9000x900", "-1x200", "1.5x200")
    ),
    Case(
        "view-html-is-a-folder",
        "{tmp}/machine: is a directory; expected a file",
        command="view orthoglide --html {tmp}/machine",
    ),
    Case(
        "view-html-in-a-file",
        "{tmp}/session.yaml: is a file; expected a directory",
        command="view orthoglide --html {tmp}/session.yaml/page.html",
    ),
    Case(
        "view-html-ends-otherwise",
        "{tmp}/page.png: expected a name that ends with .html",
        command="view orthoglide --html {tmp}/page.png",
    ),
    Case(
        "view-png-ends-otherwise",
        "{tmp}/a.jpg: expected a name that ends with .png",
        command="view orthoglide --png {tmp}/a.jpg",
    ),
    Case(
        "view-show-of-a-session",
        "show: applies to a calibration only",
        command=VIEW + " --show tool",
    ),
    Case(
        "view-exaggerate-a-session",
        "exaggeration: applies to a calibration only",
        command=VIEW + " --exaggerate 3",
    ),
    Case(
        "report-in-a-file",
        "{tmp}/session.yaml: is a file; expected a directory",
        command="report {tmp}/calibration.json --out {tmp}/session.yaml/page.html",
        base="machine",
        calibrated=True,
    ),
    Case(
        "report-ends-otherwise",
        "{tmp}/page.pdf: expected a name that ends with .html",
        command="report {tmp}/calibration.json --out {tmp}/page.pdf",
        base="machine",
        calibrated=True,
    ),
    Case(
        "out-with-a-folder-in-the-way",
        "{tmp}/out/calibration.json: is a directory; expected a file",
        (make_folder("out/calibration.json"),),
    ),
    Case(
        "view-exaggerate-beyond-the-machine",
        "exaggeration: is 100000; the largest deviation of 2.18 mm would be drawn larger than the "
        "machine: expected at most 265",
        command="view {tmp}/calibration.json --html {tmp}/page.html --exaggerate 1e5",
        base="machine",
        calibrated=True,
    ),
    Case(
        "calibrate-readings",
        "{tmp}/readings.csv: is no session.yaml",
        command="calibrate {tmp}/readings.csv",
    ),
    Case(
        "report-of-nothing",
        "{tmp}/calibration.json: there is no such file" + MAKE_ONE,
        command="report {tmp}",
    ),
    mesh("missing", "part.stl", ":24: there is no mesh file {tmp}/machine/part.stl"),
    mesh(
        "outside",
        "../../etc/part.stl",
        ":24: the mesh '../../etc/part.stl' lies outside of the robot's directory",
    ),
    mesh(
        "absolute",
        "/etc/part.stl",
        ":24: the mesh '/etc/part.stl' lies outside of the robot's directory",
    ),
    mesh("kind", "session.yaml", ":24: the mesh 'session.yaml' is none of .stl, .obj, .dae, .ply"),
    mesh(
        "broken",
        "package://orthoglide/part.stl",
        ": its visuals cannot be loaded: #",
        write("machine/part.stl", "this is no mesh"),
    ),
]

EXPECTED = "; expected words such as X1.5 and comments"

PROGRAM_CASES = [
    program("empty", "", ": is empty; expected a program"),
    program("binary", b"\x7fELF\x02\x01", ":1: found '\\x7fELF\\x02\\x01'" + EXPECTED),
    program("utf-16", "G0".encode("utf-16"), ":1: found '\\xff\\xfeG\\x000\\x00'" + EXPECTED),
    program("zero-bytes", PROGRAM + "G1 \0 X2\n", ":3: found '\\x00 X2'" + EXPECTED),
    program(
        "no-feed",
        "G0 X0 Y0 Z0\nG1 X1\n",
        ":2: found G1 without a feed; expected F before it, and again after a change of unit",
    ),
    program(
        "too-far",
        PROGRAM + "G1 X999\n",
        ":3: the machine cannot make this motion: it cannot be reached: joint 'x_slide' would be "
        "at 391.6 mm, outside its limits 120 ... 390 mm",
    ),
    program(
        "cycle",
        PROGRAM + "G81 Z-1 R1\n",
        ":3: found G81, which is a canned cycle, whose motions the controller makes; write the "
        "motion as lines and arcs (G0 to G3)",
    ),
    program(
        "long-line",
        PROGRAM + "(" + "a" * 300 + ")\n",
        ":3: has 302 bytes after correction; expected at most 252, as LinuxCNC reads: shorten "
        "its comments",
    ),
    program(
        "longer-line",
        PROGRAM + "X1" + " " * 2000,
        ":3: has 1002 characters; expected at most 1000",
    ),
    program("tool-one", PROGRAM, "--tool: found '5'; expected X,Y,Z", " --tool 5"),
    program(
        "tool-no-number",
        PROGRAM,
        "--tool: Z is 'nan'; expected a finite number",
        " --tool 0,0,nan",
    ),
    program(
        "tool-long",
        PROGRAM,
        "--tool: found 0, 0, 1e+06 mm; expected numbers of at most 10000 mm",
        " --tool 0,0,1e6",
    ),
    program(
        "system-unknown",
        PROGRAM,
        "--work-offset-mm: found 'G60=0,0,0'; expected X,Y,Z or one of G54, G55, G56, G57, G58, "
        "G59, G59.1, G59.2, G59.3 = X,Y,Z",
        " --work-offset-mm G60=0,0,0",
    ),
    program(
        "system-twice",
        PROGRAM,
        "--work-offset-mm: found G54 twice",
        " --work-offset-mm 0,0,0 --work-offset-mm G54=0,0,0",
    ),
    Case(
        "program-missing",
        "{tmp}/part.ngc: there is no such file",
        (remove("part.ngc"),),
        CORRECT,
        "machine",
        calibrated=True,
    ),
    Case(
        "program-folder",
        "{tmp}/part.ngc: is a directory; expected a file",
        (remove("part.ngc"), make_folder("part.ngc")),
        CORRECT,
        "machine",
        calibrated=True,
    ),
    Case(
        "program-out-a-folder",
        "{tmp}/out.ngc: is a directory; expected a file",
        (make_folder("out.ngc"),),
        CORRECT,
        "machine",
        calibrated=True,
    ),
]


CASES = [
    *SESSION_KEY_CASES,
    *SESSION_TYPE_CASES,
    *SESSION_FILE_CASES,
    *SESSION_SENSE_CASES,
    *OPTION_CASES,
    *READINGS_CASES,
    *ROBOT_CASES,
    *URDF_CASES,
    *CALIBRATION_CASES,
    *TABLE_CASES,
    *SIMULATE_CASES,
    *VIEW_CASES,
    *PROGRAM_CASES,
]

BY_NAME = {case.name: case for case in CASES}

USAGE = {
    "within-nothing": CORRECT + " --within 0",
    "within-no-number": CORRECT + " --within nan",
    "no-command": "",
    "command-unknown": "calibrat {tmp}",
    "session-missing": "calibrate",
    "two-sessions": "calibrate {tmp} {tmp}",
    "option-unknown": "calibrate {tmp} --modell full",
    "option-without-value": "calibrate {tmp} --model",
    "joints-missing": "forward {tmp}",
    "new-session-missing": "validate {tmp}",
    "out-missing": "simulate {tmp}/plan.yaml" + ONE_ERROR,
    "seed-negative": SIMULATE + ONE_ERROR + " --seed -1",
    "seed-text": SIMULATE + ONE_ERROR + " --seed lucky",
}


def lay_out(folder: Path, base: str) -> None:
    """Good input of all kinds: a session, a plan and a robot folder."""
    example = CYCLES if base == "cycles" else DIFFERENCES
    for file in ("session.yaml", "readings.csv"):
        shutil.copy(example / file, folder)
    shutil.copy(CYCLES / "plan.yaml", folder)
    shutil.copytree(ROOT / "robots/orthoglide", folder / "machine")
    if base == "machine":
        swap("session.yaml", "robot: orthoglide", "robot: machine")(folder)


@pytest.fixture(scope="module")
def calibrated() -> str:
    """Text of a good calibration.json; the folder that it names is no longer there."""
    with tempfile.TemporaryDirectory() as name:
        lay_out(Path(name), "machine")
        return calibration_json(calibrate(load_session(name)))


@pytest.fixture
def spoil(tmp_path: Path, calibrated: str) -> Callable[[Case], None]:
    def prepare(case: Case) -> None:
        lay_out(tmp_path, case.base)
        if case.calibrated:
            (tmp_path / FILE).write_text(calibrated, encoding="utf-8")
            (tmp_path / "joints.csv").write_text(f"{JOINTS}\n310,310,310\n")
            (tmp_path / "points.csv").write_text("x_mm,y_mm,z_mm\n0,0,0\n")
            (tmp_path / "part.ngc").write_text(PROGRAM)
        for edit in case.edits:
            edit(tmp_path)

    return prepare


def arguments(command: str, folder: Path) -> list[str]:
    return [part.replace("{tmp}", str(folder)) for part in command.split()]


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def without_digits(message: str) -> str:
    """A message without what others say in it: a residual in vain, the words of a mesh reader."""
    message = re.sub(r"stay open by \S+ mm( and \S+ mrad)?, \d+%", "stay open by # mm, #%", message)
    message = re.sub(r"(visuals cannot be loaded: ).*\n", r"\1#\n", message)
    return re.sub(r"apart by \S+ mm( and \S+ mrad)?;", "apart by # mm;", message)


def check_message(case: Case, stderr: str, folder: Path) -> None:
    assert "Traceback" not in stderr
    found = without_digits(stderr.replace(str(folder), "{tmp}"))
    assert found == f"orthocal: {case.message}\n"


def test_cases_have_names_of_their_own():
    assert len(BY_NAME) == len(CASES)


@pytest.mark.parametrize("base", ["differences", "cycles", "machine"])
def test_what_the_cases_spoil_is_good(base, tmp_path, monkeypatch, capfd):
    lay_out(tmp_path, base)
    monkeypatch.setattr(sys, "argv", ["orthocal", *arguments(CALIBRATE, tmp_path)])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 0
    out = f"{tmp_path}/out"
    assert capfd.readouterr().err == f"Wrote {out}/calibration.json and {out}/report.html\n"


@pytest.mark.parametrize("command", [FORWARD, INVERSE, CORRECT, SIMULATE + ONE_ERROR, "validate"])
def test_what_other_commands_spoil_is_good(command, spoil, tmp_path, monkeypatch, capfd):
    validates = command == "validate"
    edits = (NO_CONTROLLER,) if validates else ()
    spoil(Case("good", "", edits, base="machine", calibrated=True))
    command = VALIDATE if validates else command
    monkeypatch.setattr(sys, "argv", ["orthocal", *arguments(command, tmp_path)])
    with pytest.raises(SystemExit) as stopped:
        main()
    # the readings are those before the offsets were entered, which is not confirmed
    assert stopped.value.code == (3 if validates else 0)
    assert "orthocal:" not in capfd.readouterr().err


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_bad_input_is_refused(case, spoil, tmp_path, monkeypatch, capfd):
    spoil(case)
    before = files_of(tmp_path)
    monkeypatch.setattr(sys, "argv", ["orthocal", *arguments(case.command, tmp_path)])
    with pytest.raises(SystemExit) as stopped:
        main()
    out, err = capfd.readouterr()
    check_message(case, err, tmp_path)
    assert stopped.value.code == 2
    assert out == ""
    assert files_of(tmp_path) == before


@pytest.mark.parametrize("name", ["session-key-unknown", "readings-not-a-number", "urdf-mimic"])
def test_bad_input_is_refused_in_a_process_of_its_own(name, spoil, tmp_path):
    case = BY_NAME[name]
    spoil(case)
    before = files_of(tmp_path)
    command = [sys.executable, "-m", "orthocal", *arguments(case.command, tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, encoding="utf-8", check=False)
    check_message(case, done.stderr, tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert files_of(tmp_path) == before


@pytest.mark.parametrize("command", USAGE.values(), ids=USAGE.keys())
def test_wrong_usage_is_refused(command, spoil, tmp_path, monkeypatch, capfd):
    spoil(Case("usage", ""))
    before = files_of(tmp_path)
    monkeypatch.setattr(sys, "argv", ["orthocal", *arguments(command, tmp_path)])
    with pytest.raises(SystemExit) as stopped:
        main()
    out, err = capfd.readouterr()
    assert stopped.value.code == 2
    assert "Traceback" not in out + err
    assert files_of(tmp_path) == before
