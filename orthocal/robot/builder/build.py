"""A machine of the Orthoglide's kind in other sizes: URDF and YAML, made from the packaged ones.

Leg length, travel, how far a leg's hinge is from slider and platform, and its two rods; everything
else, joints, loops, legs, error parameters and models, is as there.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from lxml import etree

from orthocal.errors import RobotError
from orthocal.io.files import exists, read_file, write_files
from orthocal.robot.builder.dimensions import (
    AS_DRIVE,
    Counting,
    Sizes,
    find_counting_problem,
    in_mm,
)
from orthocal.robot.builder.machine_file import MACHINE, drive_text, machine_text, read_machine
from orthocal.robot.loading import load_robot, packaged_robots
from orthocal.robot.model import Robot

__all__ = ["Counting", "Sizes", "describe_machine", "make_robot", "remake_robot"]

PATTERN = "orthoglide"
"""The packaged robot that others are made from."""

AXES = "xyz"

SLIDER = 0.03
"""From a leg's hinge axis on the slider to the middle of what is drawn of it, less the offset, [m].
"""

RAIL = 0.09
"""What a rail is longer than the travel, [m]."""

_HEAD = re.compile(r"\A(?:# (?:A machine of the Orthoglide's kind|Made from).*\n)+")
_DRIVE = r"(?m)^(?P<name> *{axis}_slide: )\{{[^#\n]*zero_mm: [^#\n]*\}}(?P<rest> *(?:#.*)?)$"
_RADIUS = re.compile(r"radius_mm: [-+.0-9e]+")
_TOLERANCES = re.compile(r"(?m)^( *tolerances: \{[^{}\n]*)\}")


def describe_machine(
    sizes: Sizes,
    *,
    name: str,
    counting: Sequence[Counting] = (AS_DRIVE,) * 3,
    where: str = "sizes",
    description: str | None = None,
    tolerances: Mapping[str, float] | None = None,
) -> dict[str, str]:
    """The files of a machine: name to text.

    Args:
        sizes: Of the machine.
        name: Of its folder and files.
        counting: How the controller's joints of x, y and z count.
        where: For messages.
        description: The robot's YAML to put the sizes into; the packaged one's by default.
        tolerances: Names or globs with their unit, such as *.offset_mm, to tolerances that hold
            instead of the packaged ones; none beside a description, which has its own.

    Raises:
        RobotError: If the sizes make no machine, or the YAML has no place for them.
    """
    sizes.require_machine(where)
    problem = find_counting_problem(counting)
    if problem:
        raise RobotError(problem, where=where)
    folder = packaged_robots()[PATTERN]
    urdf, packaged = (
        read_file(folder / f"{PATTERN}.{kind}", error=RobotError) for kind in ("urdf", "yaml")
    )
    pattern = packaged.decode() if description is None else description
    if tolerances:
        pattern = _override(pattern, tolerances, f"{name}.yaml")
    return {
        f"{name}.yaml": _describe(pattern, sizes, counting, f"{name}.yaml"),
        f"{name}.urdf": _draw(urdf, sizes),
        MACHINE: machine_text(sizes, tuple(counting)),
    }


def make_robot(
    sizes: Sizes, folder: Path, *, counting: Sequence[Counting] = (AS_DRIVE,) * 3
) -> Robot:
    """Write the folder of a machine, with machine.yaml, and load it.

    Args:
        sizes: Of the machine.
        folder: Made if need be.
        counting: How the controller's joints of x, y and z count.

    Raises:
        RobotError: If the sizes make no machine.
        OrthocalError: If the folder cannot be written.
    """
    name = folder.resolve().name
    write_files(folder, describe_machine(sizes, name=name, counting=counting))
    return load_robot(folder.resolve())


def remake_robot(folder: Path) -> Robot:
    """Make URDF and YAML of a machine again from its machine.yaml, and load it.

    What else was changed in the YAML stays; what does not load is not written.

    Raises:
        RobotError: If there is no machine.yaml, its sizes make no machine, or the YAML has no
            place for them.
        OrthocalError: If the folder cannot be written.
    """
    name = folder.resolve().name
    sizes, counting = read_machine(folder / MACHINE)
    own = folder / f"{name}.yaml"
    if not exists(own):
        others = sorted(p.name for p in folder.glob("*.yaml") if p.name != MACHINE)
        there = (
            f"; there is {', '.join(others[:3])}: was the folder named otherwise?" if others else ""
        )
        raise RobotError(f"there is no such file{there}", where=str(own))
    description = read_file(own, error=RobotError).decode("utf-8", "replace")
    files = describe_machine(sizes, name=name, counting=counting, description=description)
    del files[MACHINE]
    with tempfile.TemporaryDirectory(prefix="orthocal-") as trial:
        write_files(Path(trial) / name, files)
        try:
            load_robot(Path(trial) / name)
        except RobotError as e:
            where = None if e.where is None else e.where.replace(f"{trial}/{name}", str(folder))
            raise RobotError(e.problem, where=where) from None
    write_files(folder, files)
    return load_robot(folder.resolve())


def _draw(pattern: bytes, sizes: Sizes) -> str:
    """The URDF: every number that a size stands for, by the joint or link that it stands in."""
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    root = etree.fromstring(pattern, parser)
    half = sizes.rods_apart / 2.0
    joints = {j.get("name"): j for j in root.findall("joint")}
    links = {link.get("name"): link for link in root.findall("link")}

    def place(owner: etree._Element, x: float, y: float, z: float) -> None:
        owner.find("origin").set("xyz", " ".join(_number(v) for v in (x, y, z)))

    def visual(link: str, index: int) -> etree._Element:
        return links[link].findall("visual")[index]

    for k in AXES:
        limit = joints[f"{k}_slide"].find("limit")
        limit.set("lower", _number(sizes.lower))
        limit.set("upper", _number(sizes.upper))
        place(joints[f"{k}_swivel"], -sizes.attachment, 0.0, 0.0)
        place(joints[f"{k}_bar_a"], 0.0, 0.0, half)
        place(joints[f"{k}_bar_b"], 0.0, 0.0, -half)
        place(joints[f"{k}_rod_b_tip_mount"], sizes.leg, 0.0, 0.0)
        place(joints[f"{k}_coupler"], sizes.leg, 0.0, 0.0)
        place(joints[f"{k}_crossbar_end_mount"], 0.0, 0.0, -sizes.rods_apart)
        place(joints[f"{k}_leg_tip_mount"], 0.0, 0.0, -half)
        place(joints[f"{k}_wrist"], 0.0, 0.0, -half)
        place(visual(f"{k}_slider", 0), -sizes.attachment - SLIDER, 0.036, 0.0)
        place(visual(f"{k}_slider", 1), -sizes.attachment - 0.005, 0.012, 0.0)
        _set_cylinder(visual(f"{k}_yoke", 0), length=sizes.rods_apart + 0.03)
        for rod in "ab":
            body, near, far = (visual(f"{k}_rod_{rod}", i) for i in range(3))
            place(body, sizes.leg / 2.0, 0.0, 0.0)
            _set_cylinder(body, length=sizes.leg, radius=sizes.rod_radius)
            place(far, sizes.leg, 0.0, 0.0)
            for joint in (near, far):
                _set_cylinder(
                    joint, length=4.0 * sizes.rod_radius, radius=sizes.rod_radius + 0.0035
                )
        place(visual(f"{k}_crossbar", 0), 0.0, 0.0, -half)
        _set_cylinder(visual(f"{k}_crossbar", 0), length=sizes.rods_apart + 0.02)
    for mount in ("platform_mount", "y_foot_end_mount", "z_foot_end_mount"):
        place(joints[mount], sizes.attachment, 0.0, 0.0)
    middle = 0.5 * (sizes.lower + sizes.upper) + sizes.attachment + SLIDER
    rail = sizes.upper - sizes.lower + RAIL
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
    return f'<?xml version="1.0"?>\n<!-- {_words(sizes)} -->\n{text}\n'


def _describe(pattern: str, sizes: Sizes, counting: Sequence[Counting], file: str) -> str:
    """The YAML: zeros and radii in mm, how joints count, and where the sizes stand.

    Raises:
        RobotError: If there is no place for one of them.
    """
    text, found = _RADIUS.subn(f"radius_mm: {in_mm(sizes.rod_radius)}", _HEAD.sub("", pattern))
    if not found:
        raise RobotError("has no rods with a radius_mm any more", where=file)
    for axis, joint in zip(AXES, counting, strict=True):
        line = re.compile(_DRIVE.format(axis=axis))
        drive = f"{{{drive_text(sizes, joint)}}}"
        text, found = line.subn(rf"\g<name>{drive}\g<rest>", text)
        if found != 1:
            raise RobotError(
                f"has no line '{axis}_slide: {{zero_mm: ...}}' any more, where its zero would "
                "stand",
                where=file,
            )
    return f"# {_words(sizes)}\n# Made from {MACHINE}: change sizes there.\n{text}"


def _override(pattern: str, tolerances: Mapping[str, float], file: str) -> str:
    """The YAML with other tolerances of some errors.

    Raises:
        RobotError: If there is no place for them.
    """
    given = ", ".join(f"{json.dumps(name)}: {_number(v)}" for name, v in tolerances.items())
    text, found = _TOLERANCES.subn(lambda m: f"{m[1]}, overrides: {{{given}}}}}", pattern)
    if found != 1:
        raise RobotError("has no line 'tolerances: {...}', where others would stand", where=file)
    return text


def _words(sizes: Sizes) -> str:
    return f"A machine of the Orthoglide's kind: {sizes.words}."


def _set_cylinder(visual: etree._Element, *, length: float, radius: float | None = None) -> None:
    cylinder = visual.find("geometry/cylinder")
    cylinder.set("length", _number(length))
    if radius is not None:
        cylinder.set("radius", _number(radius))


def _number(value: float) -> str:
    return f"{round(value, 12) + 0.0:.12g}"
