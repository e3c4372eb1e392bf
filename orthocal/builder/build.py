"""Robot files of an Orthoglide with given dimensions, made from the packaged ones.

The dimensions are leg length, travel, hinges of the platform, rods of a leg, and workspace.
Joints, loops, legs, error parameters and models are those of the packaged robot.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from lxml import etree

from orthocal.builder.machine_file import (
    AS_DRIVE,
    MACHINE,
    Counting,
    Dimensions,
    drive_text,
    find_counting_problem,
    in_mm,
    machine_text,
    read_machine,
    workspace_text,
)
from orthocal.effects.loading import load_robot
from orthocal.effects.registry import find_effect, order_effects
from orthocal.errors import RobotError
from orthocal.io.files import read_file, write_files
from orthocal.robot.loading import find_robot_files, packaged_robots
from orthocal.robot.model import Robot

__all__ = ["Counting", "Dimensions", "describe_machine", "make_robot", "remake_robot"]

PATTERN = "orthoglide"
"""Packaged robot whose files are changed."""

AXES = "xyz"

SLIDER = 0.03
"""Distance from a leg's hinge on the slide to the centre of the drawn slide, less the attachment
offset, [m]."""

RAIL = 0.09
"""Length of a rail beyond the travel, [m]."""

FEET = "Feet of the rails, made from machine.yaml until this line is removed."
"""Comment above the adjustments of a machine whose feet follow its dimensions."""

_FEET = re.compile(rf"(?m)^ *# {re.escape(FEET)}\n(?: *#.*\n)* *adjustments:.*\n(?: {{4,}}.*\n)*")
_HEAD = re.compile(r"\A(?:# (?:A machine of the Orthoglide's kind|Made from).*\n)+")
_DRIVE = r"(?m)^(?P<name> *{axis}_slide: )\{{[^#\n]*zero_mm: [^#\n]*\}}(?P<rest> *(?:#.*)?)$"
_WORKSPACE = re.compile(r"(?m)^(?P<indent> +)workspace:.*\n(?:(?P=indent) +.*\n)*")
_ORTHOCAL = re.compile(r"(?m)^orthocal:[^\n]*\n(?: *(?:#.*)?\n)*(?P<indent> +)")
_RADIUS = re.compile(r"radius_mm: [-+.0-9e]+")
_TOLERANCES = re.compile(r"(?m)^( *tolerances: \{[^{}\n]*)\}")


def describe_machine(
    dimensions: Dimensions,
    *,
    name: str,
    counting: Sequence[Counting] = (AS_DRIVE,) * 3,
    description: str | None = None,
    tolerances: Mapping[str, float] | None = None,
    effects: Sequence[str] = (),
) -> dict[str, str]:
    """Files of a machine: name to text.

    Args:
        dimensions: Dimensions of the machine.
        name: Name of its directory and files.
        counting: Relation of the controller's joints x, y and z to the drives.
        description: YAML of the robot to change; by default the packaged one.
        tolerances: Names or globs with their unit, such as *.offset_mm, mapped to tolerances that
            replace the packaged ones; not with a description, which has its own.
        effects: Effects beside geometry, with their default keys; not with a description.

    Raises:
        RobotError: If the dimensions are impossible, or the YAML has no place for one of them.
    """
    impossible = dimensions.find_problem()
    if impossible:
        raise RobotError(impossible[1], where="dimensions")
    problem = find_counting_problem(counting)
    if problem:
        raise RobotError(problem, where="dimensions")
    folder = packaged_robots()[PATTERN]
    urdf, packaged = (
        read_file(folder / f"{PATTERN}.{kind}", error=RobotError) for kind in ("urdf", "yaml")
    )
    pattern = packaged.decode() if description is None else description
    if tolerances:
        pattern = _override(pattern, tolerances, f"{name}.yaml")
    if effects:
        pattern = f"{pattern.rstrip()}\n\n{_effects_text(effects)}"
    return {
        f"{name}.yaml": _describe(
            pattern, dimensions, counting, f"{name}.yaml", made=description is None
        ),
        f"{name}.urdf": _draw(urdf, dimensions),
        MACHINE: machine_text(dimensions, tuple(counting)),
    }


def make_robot(
    dimensions: Dimensions,
    folder: Path,
    *,
    counting: Sequence[Counting] = (AS_DRIVE,) * 3,
    effects: Sequence[str] = (),
) -> Robot:
    """Write the directory of a machine, with machine.yaml, and load it.

    Args:
        dimensions: Dimensions of the machine.
        folder: Directory; created if it does not exist.
        counting: Relation of the controller's joints x, y and z to the drives.
        effects: Effects beside geometry, with their default keys.

    Raises:
        RobotError: If the dimensions are impossible, or an effect has no default keys.
        OrthocalError: If the directory cannot be written.
    """
    name = folder.resolve().name
    files = describe_machine(dimensions, name=name, counting=counting, effects=effects)
    write_files(folder, files)
    return load_robot(folder.resolve())


def remake_robot(folder: Path, *, check: Callable[[Robot], object] | None = None) -> Robot:
    """Make URDF and YAML of a machine again from its machine.yaml, and load it.

    Other changes in the YAML stay. Files are written only if the robot loads and passes the check.

    Args:
        folder: Directory of the machine.
        check: Raises RobotError for a robot that is not to be written.

    Raises:
        RobotError: If there is no machine.yaml, its dimensions are impossible, or the YAML has no
            place for one of them.
        OrthocalError: If the directory cannot be written.
    """
    dimensions, counting = read_machine(folder / MACHINE)
    yaml_file = find_robot_files(folder)[0]
    if yaml_file.name == MACHINE:
        raise RobotError(f"contains no YAML of a robot beside {MACHINE}", where=str(folder))
    name, description = yaml_file.stem, read_file(yaml_file, error=RobotError)
    files = describe_machine(
        dimensions, name=name, counting=counting, description=description.decode("utf-8", "replace")
    )
    del files[MACHINE]
    with tempfile.TemporaryDirectory(prefix="orthocal-") as trial:
        place = Path(trial) / folder.resolve().name
        write_files(place, files)
        try:
            robot = load_robot(place)
            if check is not None:
                check(robot)
        except RobotError as e:
            where = None if e.where is None else e.where.replace(str(place), str(folder))
            raise RobotError(e.problem, where=where) from None
    write_files(folder, files)
    return load_robot(folder.resolve())


def _draw(pattern: bytes, dimensions: Dimensions) -> str:
    """URDF with every number that depends on a dimension."""
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    root = etree.fromstring(pattern, parser)
    half = dimensions.rods_apart / 2.0
    joints = {j.get("name"): j for j in root.findall("joint")}
    links = {link.get("name"): link for link in root.findall("link")}

    def place(owner: etree._Element, x: float, y: float, z: float) -> None:
        owner.find("origin").set("xyz", " ".join(_number(v) for v in (x, y, z)))

    def visual(link: str, index: int) -> etree._Element:
        return links[link].findall("visual")[index]

    for k in AXES:
        limit = joints[f"{k}_slide"].find("limit")
        limit.set("lower", _number(dimensions.lower))
        limit.set("upper", _number(dimensions.upper))
        place(joints[f"{k}_swivel"], -dimensions.attachment, 0.0, 0.0)
        place(joints[f"{k}_bar_a"], 0.0, 0.0, half)
        place(joints[f"{k}_bar_b"], 0.0, 0.0, -half)
        place(joints[f"{k}_rod_b_tip_mount"], dimensions.leg, 0.0, 0.0)
        place(joints[f"{k}_coupler"], dimensions.leg, 0.0, 0.0)
        place(joints[f"{k}_crossbar_end_mount"], 0.0, 0.0, -dimensions.rods_apart)
        place(joints[f"{k}_leg_tip_mount"], 0.0, 0.0, -half)
        place(joints[f"{k}_wrist"], 0.0, 0.0, -half)
        place(visual(f"{k}_slider", 0), -dimensions.attachment - SLIDER, 0.036, 0.0)
        place(visual(f"{k}_slider", 1), -dimensions.attachment - 0.005, 0.012, 0.0)
        _set_cylinder(visual(f"{k}_yoke", 0), length=dimensions.rods_apart + 0.03)
        for rod in "ab":
            body, near, far = (visual(f"{k}_rod_{rod}", i) for i in range(3))
            place(body, dimensions.leg / 2.0, 0.0, 0.0)
            _set_cylinder(body, length=dimensions.leg, radius=dimensions.rod_radius)
            place(far, dimensions.leg, 0.0, 0.0)
            for joint in (near, far):
                _set_cylinder(
                    joint, length=4.0 * dimensions.rod_radius, radius=dimensions.rod_radius + 0.0035
                )
        place(visual(f"{k}_crossbar", 0), 0.0, 0.0, -half)
        _set_cylinder(visual(f"{k}_crossbar", 0), length=dimensions.rods_apart + 0.02)
    for mount in ("platform_mount", "y_foot_end_mount", "z_foot_end_mount"):
        place(joints[mount], dimensions.attachment, 0.0, 0.0)
    middle, rail = _rail(dimensions)
    for i in range(3):
        origin = visual("base", i).find("origin")
        places = origin.get("xyz").split()
        places[i] = _number(middle)
        origin.set("xyz", " ".join(places))
        box = visual("base", i).find("geometry/box")
        lengths = box.get("size").split()
        lengths[i] = _number(rail)
        box.set("size", " ".join(lengths))
    text = str(etree.tostring(root, encoding="unicode"))
    return f'<?xml version="1.0"?>\n<!-- {_words(dimensions)} -->\n{text}\n'


def _describe(
    pattern: str, dimensions: Dimensions, counting: Sequence[Counting], file: str, *, made: bool
) -> str:
    """YAML with zeros of the drives, radii of the rods, joints, workspace, and feet of the rails.

    Raises:
        RobotError: If the YAML has no place for one of them.
    """
    text, count = _RADIUS.subn(f"radius_mm: {in_mm(dimensions.rod_radius)}", _HEAD.sub("", pattern))
    if not count:
        raise RobotError("has no rods with a radius_mm", where=file)
    for axis, joint in zip(AXES, counting, strict=True):
        line = re.compile(_DRIVE.format(axis=axis))
        drive = f"{{{drive_text(dimensions, joint)}}}"
        text, count = line.subn(rf"\g<name>{drive}\g<rest>", text)
        if count != 1:
            raise RobotError(
                f"has no line '{axis}_slide: {{zero_mm: ...}}'; expected one for its zero",
                where=file,
            )
    box = workspace_text(dimensions)
    if box:  # a workspace in the YAML alone stays
        text, place = _WORKSPACE.sub("", text), _ORTHOCAL.search(_WORKSPACE.sub("", text))
        if place is None:
            raise RobotError("has no key orthocal with others below it", where=file)
        at = place.start("indent")
        text = f"{text[:at]}{place['indent']}workspace: {{box_mm: {box}}}\n{text[at:]}"
    feet = _feet_text(dimensions)
    text = f"{text.rstrip()}\n\n{feet}" if made else _FEET.sub(feet, text)
    return f"# {_words(dimensions)}\n# Made from {MACHINE}: change dimensions there.\n{text}"


def _feet_text(dimensions: Dimensions) -> str:
    """Adjustments at both ends of each rail, across it, and under one of its sides, as YAML."""
    inner, outer = (_rail(dimensions)[0] + s * _rail(dimensions)[1] / 2.0 for s in (-1.0, 1.0))
    half = dimensions.rods_apart / 2.0

    def point(axis: int, along: float, across: int = 0, beside: float = 0.0) -> str:
        values = [0.0, 0.0, 0.0]
        values[axis] = along
        values[(axis + across) % 3] += beside
        return f"[{', '.join(in_mm(v) for v in values)}]"

    def unit(axis: int) -> str:
        return f"[{', '.join('1' if k == axis else '0' for k in range(3))}]"

    lines = []
    for axis, letter in enumerate(AXES):
        moves = f"{{moves: {letter}_slide, at_mm:"
        for end, at, pivot in (("inner", inner, outer), ("outer", outer, inner)):
            for k in ((axis + 1) % 3, (axis + 2) % 3):
                lines.append(
                    f"{letter}_{end}_foot_{AXES[k]}: {moves} {point(axis, at)}, "
                    f"direction: {unit(k)}, pivot_mm: {point(axis, pivot)}}}"
                )
        side, other = (point(axis, 0.5 * (inner + outer), 1, s * half) for s in (1.0, -1.0))
        k = (axis + 2) % 3
        lines.append(
            f"{letter}_side_foot_{AXES[k]}: {moves} {side}, direction: {unit(k)}, "
            f"pivot_mm: {other}}}"
        )
    body = "".join(f"    {line}\n" for line in lines)
    return (
        f"  # {FEET}\n"
        "  # Shims move the ends of a rail, and raise one of its sides, as far apart as two rods.\n"
        f"  adjustments:\n{body}"
    )


def _effects_text(names: Sequence[str]) -> str:
    """Effects beside geometry with their default limits, as YAML."""
    lines = []
    for name in order_effects(names):
        fields = find_effect(name, where="effects", error=RobotError).keys.model_fields.items()
        keys = {key: f.default for key, f in fields if isinstance(f.default, float)}
        lines.append(f"    {name}: {json.dumps(keys).replace(chr(34), '')}\n")
    return (
        "  # Effects beside geometry: limits of backlash and others, which are identified from\n"
        f"  # readings that state their conditions.\n  effects:\n{''.join(lines)}"
    )


def _rail(dimensions: Dimensions) -> tuple[float, float]:
    """Middle of a rail along its axis, and its length, as drawn, [m]."""
    middle = 0.5 * (dimensions.lower + dimensions.upper) + dimensions.attachment + SLIDER
    return middle, dimensions.upper - dimensions.lower + RAIL


def _override(pattern: str, tolerances: Mapping[str, float], file: str) -> str:
    """YAML with other tolerances of some errors.

    Raises:
        RobotError: If the YAML has no place for them.
    """
    stated = ", ".join(f"{json.dumps(name)}: {_number(v)}" for name, v in tolerances.items())
    text, count = _TOLERANCES.subn(lambda m: f"{m[1]}, overrides: {{{stated}}}}}", pattern)
    if count != 1:
        raise RobotError(
            "has no line 'tolerances: {...}'; expected one for other tolerances", where=file
        )
    return text


def _words(dimensions: Dimensions) -> str:
    return f"A machine of the Orthoglide's kind: {dimensions.words}."


def _set_cylinder(visual: etree._Element, *, length: float, radius: float | None = None) -> None:
    cylinder = visual.find("geometry/cylinder")
    cylinder.set("length", _number(length))
    if radius is not None:
        cylinder.set("radius", _number(radius))


def _number(value: float) -> str:
    return f"{round(value, 12) + 0.0:.12g}"
