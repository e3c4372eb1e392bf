"""Robot files of a machine from its kind and dimensions in machine.yaml.

Manual changes of the YAML that do not contradict machine.yaml are preserved.
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
from orthocal.io.documents import read_text
from orthocal.io.files import write_files
from orthocal.robot.loading import find_robot_files
from orthocal.robot.model import Robot

__all__ = ["describe_machine", "make_robot", "remake_robot"]

# Parts of a robot's YAML that follow from machine.yaml. They are replaced as text, so that comments
# and other changes are preserved.
_FEET_SECTION = re.compile(
    rf"(?m)^ *# {re.escape(FEET)}\n(?: *#.*\n)* *adjustments:.*\n(?: {{4,}}.*\n)*"
)
_TITLE_LINES = re.compile(r"\A(?:# (?:A machine of the|Made from).*\n)+")
_DRIVE_LINE = r"(?m)^(?P<name> *{drive}: )\{{[^#\n]*zero_mm: [^#\n]*\}}(?P<rest> *(?:#.*)?)$"
_WORKSPACE_KEY = re.compile(r"(?m)^(?P<indent> +)workspace:.*\n(?:(?P=indent) +.*\n)*")
_ORTHOCAL_KEY = re.compile(r"(?m)^orthocal:[^\n]*\n(?: *(?:#.*)?\n)*(?P<indent> +)")
_RADIUS_KEY = re.compile(r"radius_mm: [-+.0-9e]+")
_TOLERANCES_LINE = re.compile(r"(?m)^( *tolerances: \{[^{}\n]*)\}")

EffectKeyValues = Mapping[str, Mapping[str, float]]
"""Effects beside geometry, mapped to keys that replace their defaults."""


def describe_machine(
    dimensions: Dimensions,
    *,
    name: str,
    counting: Sequence[Counting] | None = None,
    description: str | None = None,
    tolerances: Mapping[str, float] | None = None,
    effects: Sequence[str] | EffectKeyValues = (),
) -> dict[str, str]:
    """Texts of the files of a machine by file name.

    Args:
        dimensions: Dimensions of the machine.
        name: Name of its directory and files.
        counting: Relation of the controller's joints to the drives; by default they are equal.
        description: YAML of the robot to change; by default that of the kind.
        tolerances: Tolerances that replace those of the kind, by error name or glob with its unit,
            such as *.offset_mm.
        effects: Effects beside geometry, with their default keys, or mapped to other keys.

    Raises:
        RobotError: If the dimensions are impossible, an effect does not exist, or the YAML lacks
            the line of a dimension or of the tolerances.
    """
    if impossible := dimensions.find_problem():
        raise RobotError(impossible[1], where="dimensions")
    drives = dimensions.drives_of()
    joints = (AS_DRIVE,) * len(drives) if counting is None else tuple(counting)
    if problem := find_counting_problem(joints, len(drives)):
        raise RobotError(problem, where="dimensions")
    base = dimensions.yaml() if description is None else description
    if tolerances:
        base = _override_tolerances(base, tolerances, f"{name}.yaml")
    if effects:
        base = f"{base.rstrip()}\n\n{_effects_text(effects)}"
    return {
        f"{name}.yaml": _complete_yaml(
            base, dimensions, joints, f"{name}.yaml", is_new=description is None
        ),
        f"{name}.urdf": dimensions.urdf(name),
        MACHINE: machine_text(dimensions, joints),
    }


def make_robot(
    dimensions: Dimensions,
    folder: str | Path,
    *,
    counting: Sequence[Counting] | None = None,
    effects: Sequence[str] | EffectKeyValues = (),
) -> Robot:
    """Write the directory of a machine, with machine.yaml, and load it.

    Args:
        dimensions: Dimensions of the machine.
        folder: Directory; created if it does not exist.
        counting: Relation of the controller's joints to the drives; by default they are equal.
        effects: Effects beside geometry, with their default keys, or mapped to other keys.

    Raises:
        RobotError: If the dimensions are impossible, or an effect does not exist or lacks a key.
        OrthocalError: If the directory cannot be written.
    """
    folder = Path(folder)
    name = folder.resolve().name
    files = describe_machine(dimensions, name=name, counting=counting, effects=effects)
    write_files(folder, files)
    return load_robot(folder.resolve())


def remake_robot(folder: Path, *, check: Callable[[Robot], object] | None = None) -> Robot:
    """Update URDF and YAML of a machine from its machine.yaml, and load the robot.

    Other changes of the YAML are preserved. Files are written only if the robot loads and passes
    the check.

    Args:
        folder: Directory of the machine.
        check: Function that raises RobotError for a robot that must not be written.

    Raises:
        RobotError: If there is no machine.yaml, its dimensions are impossible, or the YAML lacks
            the line of one of them; also if the new robot does not load or fails the check.
        OrthocalError: If the directory cannot be written.
    """
    dimensions, counting = read_machine(folder / MACHINE)
    yaml_file = find_robot_files(folder)[0]
    if yaml_file.name == MACHINE:
        raise RobotError(f"contains {MACHINE} but no YAML of a robot", where=str(folder))
    files = describe_machine(
        dimensions,
        name=yaml_file.stem,
        counting=counting,
        description=read_text(yaml_file, error=RobotError),
    )
    del files[MACHINE]
    with tempfile.TemporaryDirectory(prefix="orthocal-") as temporary:
        trial = Path(temporary) / folder.resolve().name
        write_files(trial, files)
        try:
            robot = load_robot(trial)
            if check is not None:
                check(robot)
        except RobotError as e:
            where = None if e.where is None else e.where.replace(str(trial), str(folder))
            raise RobotError(e.problem, where=where) from None
    write_files(folder, files)
    return load_robot(folder.resolve())


def _complete_yaml(
    base: str, dimensions: Dimensions, counting: Sequence[Counting], file: str, *, is_new: bool
) -> str:
    """YAML of a robot with the zeros, rod radii, joints, workspace and adjustments of a machine.

    Args:
        base: YAML of the robot to change.
        dimensions: Dimensions of the machine.
        counting: Relation of the controller's joints to the drives.
        file: Name of the YAML, for messages.
        is_new: Whether adjustments are added; otherwise only existing ones are replaced.

    Raises:
        RobotError: If the YAML lacks one of the keys.
    """
    text = _TITLE_LINES.sub("", base)
    text, count = _RADIUS_KEY.subn(f"radius_mm: {in_mm(dimensions.rod_radius)}", text)
    if not count:
        raise RobotError("has no rods with a radius_mm", where=file)
    for drive, joint in zip(dimensions.drives_of(), counting, strict=True):
        line = re.compile(_DRIVE_LINE.format(drive=drive))
        keys = f"{{{drive_text(dimensions, joint)}}}"
        text, count = line.subn(rf"\g<name>{keys}\g<rest>", text)
        if count != 1:
            raise RobotError(
                f"has no line '{drive}: {{zero_mm: ...}}'; expected one for its zero", where=file
            )
    box = box_text(dimensions.box)
    if box:  # without it, a workspace in the YAML is preserved
        text = _WORKSPACE_KEY.sub("", text)
        place = _ORTHOCAL_KEY.search(text)
        if place is None:
            raise RobotError("has no key orthocal with others below it", where=file)
        start = place.start("indent")
        text = f"{text[:start]}{place['indent']}workspace: {{box_mm: {box}}}\n{text[start:]}"
    feet = dimensions.adjustments()
    if feet:
        text = f"{text.rstrip()}\n\n{feet}" if is_new else _FEET_SECTION.sub(feet, text)
    return f"# {dimensions.title}\n# Made from {MACHINE}: change dimensions there.\n{text}"


def _effects_text(effects: Sequence[str] | EffectKeyValues) -> str:
    """YAML of effects beside geometry, with their default keys unless others are stated.

    Raises:
        RobotError: If an effect does not exist.
    """
    stated = effects if isinstance(effects, Mapping) else {}
    lines = []
    for name in order_effects(effects):
        fields = find_effect(name, where="effects", error=RobotError).keys.model_fields.items()
        # required keys, vectors and mappings have no number as default
        keys = {key: f.default for key, f in fields if isinstance(f.default, float)}
        keys |= stated.get(name, {})
        mapping = json.dumps(keys).replace('"', "")  # in YAML's flow style without quotes
        lines.append(f"    {name}: {mapping}\n")
    return (
        "  # Effects beside geometry: limits of backlash and others, which are identified from\n"
        f"  # readings that state their conditions.\n  effects:\n{''.join(lines)}"
    )


def _override_tolerances(text: str, tolerances: Mapping[str, float], file: str) -> str:
    """YAML with other tolerances of some errors.

    Raises:
        RobotError: If the YAML has no line of tolerances.
    """
    stated = ", ".join(f"{json.dumps(name)}: {v:.12g}" for name, v in tolerances.items())
    text, count = _TOLERANCES_LINE.subn(lambda m: f"{m[1]}, overrides: {{{stated}}}}}", text)
    if count != 1:
        raise RobotError(
            "has no line 'tolerances: {...}'; expected one for other tolerances", where=file
        )
    return text
