"""Robot files of a machine of given dimensions.

Dimensions and kind are in machine.yaml. Changes of the YAML that do not follow from it stay.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from orthocal.builder.dimensions import Dimensions, box_text, in_mm
from orthocal.builder.machine_file import (
    AS_DRIVE,
    MACHINE,
    Counting,
    drive_text,
    find_counting_problem,
    machine_text,
    read_machine,
)
from orthocal.builder.orthoglide import FEET
from orthocal.effects.loading import load_robot
from orthocal.effects.registry import find_effect, order_effects
from orthocal.errors import RobotError
from orthocal.io.files import read_file, write_files
from orthocal.robot.loading import find_robot_files
from orthocal.robot.model import Robot

__all__ = ["describe_machine", "make_robot", "remake_robot"]

_FEET = re.compile(rf"(?m)^ *# {re.escape(FEET)}\n(?: *#.*\n)* *adjustments:.*\n(?: {{4,}}.*\n)*")
_HEAD = re.compile(r"\A(?:# (?:A machine of the|Made from).*\n)+")
_DRIVE = r"(?m)^(?P<name> *{drive}: )\{{[^#\n]*zero_mm: [^#\n]*\}}(?P<rest> *(?:#.*)?)$"
_WORKSPACE = re.compile(r"(?m)^(?P<indent> +)workspace:.*\n(?:(?P=indent) +.*\n)*")
_ORTHOCAL = re.compile(r"(?m)^orthocal:[^\n]*\n(?: *(?:#.*)?\n)*(?P<indent> +)")
_RADIUS = re.compile(r"radius_mm: [-+.0-9e]+")
_TOLERANCES = re.compile(r"(?m)^( *tolerances: \{[^{}\n]*)\}")


def describe_machine(
    dimensions: Dimensions,
    *,
    name: str,
    counting: Sequence[Counting] | None = None,
    description: str | None = None,
    tolerances: Mapping[str, float] | None = None,
    effects: Sequence[str] = (),
) -> dict[str, str]:
    """Files of a machine: name to text.

    Args:
        dimensions: Dimensions of the machine.
        name: Name of its directory and files.
        counting: Relation of the controller's joints to the drives; by default they are equal.
        description: YAML of the robot to change; by default that of the kind.
        tolerances: Names or globs with their unit, such as *.offset_mm, mapped to tolerances that
            replace those of the kind; not with a description, which has its own.
        effects: Effects beside geometry, with their default keys; not with a description.

    Raises:
        RobotError: If the dimensions are impossible, or the YAML has no place for one of them.
    """
    impossible = dimensions.find_problem()
    if impossible:
        raise RobotError(impossible[1], where="dimensions")
    drives = dimensions.drives_of()
    joints = (AS_DRIVE,) * len(drives) if counting is None else tuple(counting)
    problem = find_counting_problem(joints, len(drives))
    if problem:
        raise RobotError(problem, where="dimensions")
    pattern = dimensions.yaml() if description is None else description
    if tolerances:
        pattern = _override(pattern, tolerances, f"{name}.yaml")
    if effects:
        pattern = f"{pattern.rstrip()}\n\n{_effects_text(effects)}"
    return {
        f"{name}.yaml": _describe(
            pattern, dimensions, joints, f"{name}.yaml", made=description is None
        ),
        f"{name}.urdf": dimensions.urdf(name),
        MACHINE: machine_text(dimensions, joints),
    }


def make_robot(
    dimensions: Dimensions,
    folder: Path,
    *,
    counting: Sequence[Counting] | None = None,
    effects: Sequence[str] = (),
) -> Robot:
    """Write the directory of a machine, with machine.yaml, and load it.

    Args:
        dimensions: Dimensions of the machine.
        folder: Directory; created if it does not exist.
        counting: Relation of the controller's joints to the drives; by default they are equal.
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


def _describe(
    pattern: str, dimensions: Dimensions, counting: Sequence[Counting], file: str, *, made: bool
) -> str:
    """YAML with zeros of the drives, radii of the rods, joints, workspace and adjustments.

    Raises:
        RobotError: If the YAML has no place for one of them.
    """
    text, count = _RADIUS.subn(f"radius_mm: {in_mm(dimensions.rod_radius)}", _HEAD.sub("", pattern))
    if not count:
        raise RobotError("has no rods with a radius_mm", where=file)
    for drive, joint in zip(dimensions.drives_of(), counting, strict=True):
        line = re.compile(_DRIVE.format(drive=drive))
        keys = f"{{{drive_text(dimensions, joint)}}}"
        text, count = line.subn(rf"\g<name>{keys}\g<rest>", text)
        if count != 1:
            raise RobotError(
                f"has no line '{drive}: {{zero_mm: ...}}'; expected one for its zero", where=file
            )
    box = box_text(dimensions.workspace)
    if box:  # a workspace in the YAML alone stays
        text, place = _WORKSPACE.sub("", text), _ORTHOCAL.search(_WORKSPACE.sub("", text))
        if place is None:
            raise RobotError("has no key orthocal with others below it", where=file)
        at = place.start("indent")
        text = f"{text[:at]}{place['indent']}workspace: {{box_mm: {box}}}\n{text[at:]}"
    feet = dimensions.adjustments()
    if feet:
        text = f"{text.rstrip()}\n\n{feet}" if made else _FEET.sub(feet, text)
    return f"# {dimensions.title}\n# Made from {MACHINE}: change dimensions there.\n{text}"


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


def _number(value: float) -> str:
    return f"{round(value, 12) + 0.0:.12g}"
