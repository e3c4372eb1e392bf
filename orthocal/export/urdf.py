"""The calibrated machine as a robot folder: placements corrected in its own URDF, all else as is.

A joint's origin T becomes T · exp6(δ) · exp6(a Δρ), with its error δ, axis a and offset Δρ; so does
that of a fixed joint whose link, a frame that closures, legs or the tool name, is off.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from orthocal.calibration.calibration import Calibration
from orthocal.errors import ExportError, RobotError
from orthocal.files import read_file
from orthocal.robot.description import load_description
from orthocal.robot.frames import find_frame
from orthocal.robot.model import Robot, joint_axis
from orthocal.robot.urdf import load_urdf, parse_urdf
from orthocal.units import PPM, tidy

Array = NDArray[np.float64]

SAME = 1e-9
"""Placements of what was written and of the calibrated machine, [m, rad]."""

_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_JOINT = re.compile(r"<joint\b[^>]*\btype\s*=[^>]*>", re.DOTALL)
_NAME = re.compile(r"\bname\s*=\s*([\"'])(.*?)\1", re.DOTALL)
_ORIGIN = re.compile(r"<origin\b[^>]*?/?>", re.DOTALL)
_END = re.compile(r"</joint\s*>")


def export_urdf(calibration: Calibration) -> dict[str, str]:
    """The robot's URDF with the errors that were identified, and its YAML as it is.

    A drive's scale has no place in a URDF: it is told in a file of its own.

    Raises:
        ExportError: If an error has no place in the URDF.
    """
    robot = calibration.robot
    content, description = (read_file(p, error=RobotError) for p in (robot.urdf, robot.yaml))
    errors = robot.parameters.expand(calibration.errors)
    try:
        text = content.decode()
    except UnicodeDecodeError:
        raise ExportError("its URDF is not UTF-8", where=str(robot.urdf)) from None
    text = _correct(text, _find_twists(robot, errors), robot)
    _require_same(robot.with_errors(calibration.errors), text)
    files = {robot.urdf.name: text, robot.yaml.name: description.decode()}
    gains = [
        f"{e.owner},{tidy(value / PPM)}\n"
        for name, value in errors.items()
        if (e := robot.parameters.elementary[name]).kind == "scale" and value
    ]
    if gains:  # a drive that is sent to q goes to (1 + scale) q
        files["scales.csv"] = "drive,scale_ppm\n" + "".join(gains)
    return files


def _find_twists(robot: Robot, errors: Mapping[str, float]) -> dict[str, list[Array]]:
    """Joint of the URDF to the twists that its origin is moved by, in order."""
    twists: dict[str, Array] = {}
    offsets: dict[str, Array] = {}
    mounts = _mounts(robot)
    for name, value in errors.items():
        e = robot.parameters.elementary[name]
        if e.kind == "scale" or not value:
            continue
        if e.kind == "offset":
            offsets[e.owner] = joint_axis(robot.model, robot.model.getJointId(e.owner)) * value
            continue
        owner = mounts.get(e.owner) if e.of_frame else e.owner
        if owner is None:
            raise ExportError(
                f"{name} is an error of a frame on a moving link: a URDF has no place for it"
            )
        twists.setdefault(owner, np.zeros(6))[e.axis] += value
    return {
        joint: [own[joint] for own in (twists, offsets) if joint in own]
        for joint in {**twists, **offsets}
    }


def _mounts(robot: Robot) -> dict[str, str]:
    """Link, or fixed joint, to the fixed joint that places it."""
    found = {}
    for joint in parse_urdf(robot.urdf).findall("joint"):
        if joint.get("type") == "fixed":
            name = str(joint.get("name"))
            found[name] = name
            found[str(joint.find("child").get("link"))] = name
    return found


def _correct(text: str, twists: Mapping[str, list[Array]], robot: Robot) -> str:
    """The text with the origins of these joints moved, and nothing else changed."""
    # comments may hold anything: they keep their length, and lose their content
    bare = _COMMENT.sub(lambda m: " " * len(m[0]), text)
    changes: list[tuple[int, int, str]] = []
    left = dict(twists)
    for joint in _JOINT.finditer(bare):
        name = _NAME.search(joint[0])
        if name is None or name[2] not in left:
            continue
        moved = left.pop(name[2])
        end = _END.search(bare, joint.end())
        stop = len(bare) if end is None else end.start()
        origin = _ORIGIN.search(bare, joint.end(), stop)
        if origin is None:
            placed = _moved({}, moved)
            new = f"<origin xyz={placed['xyz']} rpy={placed['rpy']}/>".replace("'", '"')
            changes.append((joint.end(), joint.end(), f"\n    {new}"))
        else:
            changes.append((*origin.span(), _rewrite(origin[0], moved)))
    if left:
        raise ExportError(
            f"its URDF has no joint '{next(iter(left))}' of its own to correct",
            where=str(robot.urdf),
        )
    for first, last, new in sorted(changes, reverse=True):
        text = text[:first] + new + text[last:]
    return text


def _rewrite(origin: str, twists: list[Array]) -> str:
    """An origin element with other numbers."""
    given = {m[1]: m[3] for m in re.finditer(r"\b(xyz|rpy)\s*=\s*([\"'])(.*?)\2", origin, re.S)}
    for key, value in _moved(given, twists).items():
        place = re.search(rf"\b{key}\s*=\s*([\"']).*?\1", origin, re.S)
        if place is not None:
            origin = f"{origin[: place.start()]}{key}={value}{origin[place.end() :]}"
        else:
            end = re.search(r"\s*/?>$", origin)
            at = len(origin) if end is None else end.start()
            origin = f"{origin[:at]} {key}={value}{origin[at:]}"
    return origin


def _moved(given: Mapping[str, str], twists: list[Array]) -> dict[str, str]:
    """The numbers of an origin after it was moved, in quotes."""
    xyz, rpy = (np.array([float(v) for v in given.get(k, "0 0 0").split()]) for k in ("xyz", "rpy"))
    place = pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)
    for twist in twists:
        place = place * pin.exp6(twist)
    numbers = {"xyz": place.translation, "rpy": pin.rpy.matrixToRpy(place.rotation)}
    return {k: '"' + " ".join(f"{v + 0.0:.15g}" for v in n) + '"' for k, n in numbers.items()}


def _require_same(machine: Robot, text: str) -> None:
    """Refuse what does not load, or is another machine.

    Raises:
        ExportError: Naming the first joint or frame that is elsewhere.
    """
    keys = load_description(machine.yaml)
    model = load_urdf(machine.urdf, content=text.encode(), joint_types=keys.joint_types)
    used = {f for c in machine.closures for f in (c.frame_a, c.frame_b)}
    used |= {f for leg in machine.legs.values() for f in (leg.root, leg.tip)}
    used |= {machine.tcp.frame} if machine.tcp else set()
    pairs = list(
        zip(model.names, model.jointPlacements, machine.model.jointPlacements, strict=True)
    )
    for frame in sorted(used):
        ids = [find_frame(m, frame, where=str(machine.urdf)) for m in (model, machine.model)]
        pairs.append(
            (
                frame,
                *(m.frames[i].placement for m, i in zip((model, machine.model), ids, strict=True)),
            )
        )
    for name, there, expected in pairs:
        if np.abs(pin.log6(expected.inverse() * there).vector).max() > SAME:
            raise ExportError(f"an error of '{name}' has no place in a URDF")
