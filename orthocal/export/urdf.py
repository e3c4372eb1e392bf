"""The calibrated machine as a robot folder: placements corrected in its own URDF, all else as is.

A joint's origin T becomes T · exp6(δ) · exp6(a Δρ), with its error δ, axis a and offset Δρ; so does
that of a fixed joint whose link, a frame that closures, legs or the tool name, is off.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from xml.parsers import expat

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from orthocal.calibration.calibration import Calibration
from orthocal.errors import ExportError, RobotError
from orthocal.io.files import read_file
from orthocal.robot.description import load_description
from orthocal.robot.frames import find_frame
from orthocal.robot.model import Robot, joint_axis
from orthocal.robot.urdf import load_urdf, parse_urdf
from orthocal.text import composed
from orthocal.units import PPM, tidy

Array = NDArray[np.float64]

SAME = 1e-9
"""Placements of what was written and of the calibrated machine, [m, rad]."""

_TAG = re.compile(rb"""<[^\s/>]+(?:[^>"']|"[^"]*"|'[^']*')*>""")
_ATTRIBUTE = r"""(?<![\w:.-]){name}\s*=\s*(?P<quote>["'])(?P<value>.*?)(?P=quote)"""


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
    """The text with the numbers of these joints' origins moved, and no other byte changed."""
    content = text.encode()
    line_end = "\r\n" if b"\r\n" in content else "\n"
    changes: list[tuple[int, int, str]] = []
    left = dict(twists)
    for name, start, origin in _find_joints(content):
        if name not in left:
            continue
        moved = left.pop(name)
        found = _TAG.match(content, start if origin is None else origin)
        if found is None:
            continue
        if origin is None:
            placed = _moved({}, moved)
            new = "".join(f' {key}="{placed.get(key, "0 0 0")}"' for key in ("xyz", "rpy"))
            changes.append((found.end(), found.end(), f"{line_end}    <origin{new}/>"))
        else:
            changes.append((*found.span(), _rewrite(found[0].decode(), moved)))
    if left:
        raise ExportError(
            f"its URDF has no joint '{next(iter(left))}' of its own to correct",
            where=str(robot.urdf),
        )
    for first, last, changed in sorted(changes, reverse=True):
        content = content[:first] + changed.encode() + content[last:]
    return content.decode()


def _find_joints(content: bytes) -> list[tuple[str, int, int | None]]:
    """Name of each of the robot's own joints, and where in the file it and its origin begin.

    What a parser sees: not what stands in comments, nor joints that other elements name.
    """
    found: list[tuple[str, int, int | None]] = []
    path: list[str] = []
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        path.append(tag)
        at = parser.CurrentByteIndex
        if path[1:] == ["joint"]:
            found.append((composed(attributes.get("name", "")), at, None))
        elif path[1:] == ["joint", "origin"] and found[-1][2] is None:
            found[-1] = (*found[-1][:2], at)

    def end(_: str) -> None:
        path.pop()

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(content, True)
    return found


def _rewrite(origin: str, twists: list[Array]) -> str:
    """An origin element with other numbers where they are others."""
    given = {m[0]: m[1]["value"] for m in _attributes(origin)}
    for key, value in _moved(given, twists).items():
        place = next((m for name, m in _attributes(origin) if name == key), None)
        if place is not None:
            origin = f"{origin[: place.start('value')]}{value}{origin[place.end('value') :]}"
        else:
            end = re.search(r"\s*/?>$", origin)
            at = len(origin) if end is None else end.start()
            origin = f'{origin[:at]} {key}="{value}"{origin[at:]}'
    return origin


def _attributes(origin: str) -> list[tuple[str, re.Match[str]]]:
    """Its attributes of numbers, and where they stand."""
    found = ((n, re.search(_ATTRIBUTE.format(name=n), origin, re.S)) for n in ("xyz", "rpy"))
    return [(name, match) for name, match in found if match is not None]


def _moved(given: Mapping[str, str], twists: list[Array]) -> dict[str, str]:
    """The numbers of an origin that are others after it was moved."""
    xyz, rpy = (np.array([float(v) for v in given.get(k, "0 0 0").split()]) for k in ("xyz", "rpy"))
    place = pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)
    for twist in twists:
        place = place * pin.exp6(twist)
    numbers = {}
    if not np.array_equal(place.translation, xyz):
        numbers["xyz"] = place.translation
    if any(twist[3:].any() for twist in twists):
        numbers["rpy"] = pin.rpy.matrixToRpy(place.rotation)
    return {k: " ".join(f"{v + 0.0:.15g}" for v in n) for k, n in numbers.items()}


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
