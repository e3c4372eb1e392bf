"""Calibrated machine as a robot directory: the robot's URDF with corrected placements.

The origin T of a joint becomes T · exp6(δ) · exp6(a Δρ), with its error δ, axis a and offset Δρ.
Errors of a frame (of a closure, a leg or the tool) correct the fixed joint that places its link.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from xml.parsers import expat

import numpy as np
import pinocchio as pin

from orthocal.arrays import Array
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ExportError
from orthocal.robot.description import load_description
from orthocal.robot.frames import find_frame
from orthocal.robot.model import Robot, joint_axis
from orthocal.robot.urdf import load_urdf, parse_urdf
from orthocal.text import composed
from orthocal.units import PPM, tidy

TOLERANCE = 1e-9
"""Largest difference of a written placement from the calibrated machine, [m, rad]."""

_TAG = re.compile(rb"""<[^\s/>]+(?:[^>"']|"[^"]*"|'[^']*')*>""")
_ATTRIBUTE = r"""(?<![\w:.-]){name}\s*=\s*(?P<quote>["'])(?P<value>.*?)(?P=quote)"""


def export_urdf(calibration: Calibration) -> dict[str, str]:
    """Texts of the robot's URDF with the identified errors, and of its unchanged YAML.

    A URDF has placements only. Scales of drives are in scales.csv, and errors of effects such as
    backlash in effects.csv.

    Raises:
        ExportError: If the URDF cannot express an error.
    """
    robot = calibration.robot
    urdf, description = (robot.content[p.name].decode() for p in (robot.urdf, robot.yaml))
    rigid, effects = dict[str, float](), list[str]()
    for name, value in calibration.errors.items():
        p = robot.parameters[name]
        if robot.parameters.are_rigid(name):
            rigid[name] = value
        elif value:
            effects.append(f"{name},{tidy(value * p.edge_factor)},{p.edge_unit}\n")
    errors = robot.parameters.expand(rigid)
    text = _correct_origins(urdf, _find_twists(robot, errors), robot)
    _require_calibrated(robot.with_errors(rigid), text)
    files = {robot.urdf.name: text, robot.yaml.name: description}
    scales = [
        f"{e.owner},{tidy(value / PPM)}\n"
        for name, value in errors.items()
        if (e := robot.parameters.elementary[name]).kind == "scale" and value
    ]
    if scales:  # a drive that is commanded to q moves to (1 + scale) q
        files["scales.csv"] = "drive,scale_ppm\n" + "".join(scales)
    if effects:
        files["effects.csv"] = "parameter,value,unit\n" + "".join(effects)
    return files


def _find_twists(robot: Robot, errors: Mapping[str, float]) -> dict[str, list[Array]]:
    """Joints of the URDF with the twists that displace their origins, in the order of composition.

    Raises:
        ExportError: If an error belongs to no fixed placement.
    """
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
                f"{name} is an error of a frame on a moving link: a URDF cannot express it"
            )
        twists.setdefault(owner, np.zeros(6))[e.axis] += value
    return {
        joint: [of_joint[joint] for of_joint in (twists, offsets) if joint in of_joint]
        for joint in {**twists, **offsets}
    }


def _mounts(robot: Robot) -> dict[str, str]:
    """Link or fixed joint, to the fixed joint that places it."""
    mounts = {}
    content = robot.content[robot.urdf.name]
    for joint in parse_urdf(robot.urdf, content=content).findall("joint"):
        if joint.get("type") == "fixed":
            name = str(joint.get("name"))
            mounts[name] = name
            mounts[str(joint.find("child").get("link"))] = name
    return mounts


def _correct_origins(text: str, twists: Mapping[str, list[Array]], robot: Robot) -> str:
    """URDF with displaced origins of joints; all other bytes are unchanged."""
    content = text.encode()
    line_end = "\r\n" if b"\r\n" in content else "\n"
    changes: list[tuple[int, int, str]] = []
    pending = dict(twists)
    for name, start, origin in _find_joints(content):
        if name not in pending:
            continue
        displacements = pending.pop(name)
        tag = _TAG.match(content, start if origin is None else origin)
        if tag is None:
            continue
        if origin is None:
            numbers = _displaced({}, displacements)
            new = "".join(f' {key}="{numbers.get(key, "0 0 0")}"' for key in ("xyz", "rpy"))
            changes.append((tag.end(), tag.end(), f"{line_end}    <origin{new}/>"))
        else:
            changes.append((*tag.span(), _rewrite(tag[0].decode(), displacements)))
    if pending:
        raise ExportError(
            f"its URDF has no joint '{next(iter(pending))}' to correct",
            where=str(robot.urdf),
        )
    for first, last, changed in sorted(changes, reverse=True):
        content = content[:first] + changed.encode() + content[last:]
    return content.decode()


def _find_joints(content: bytes) -> list[tuple[str, int, int | None]]:
    """Names of the robot's joints with the byte positions of their tags and origins.

    A parser excludes comments and joints of other elements.
    """
    joints: list[tuple[str, int, int | None]] = []
    path: list[str] = []
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        path.append(tag)
        position = parser.CurrentByteIndex
        if path[1:] == ["joint"]:
            joints.append((composed(attributes.get("name", "")), position, None))
        elif path[1:] == ["joint", "origin"] and joints[-1][2] is None:
            joints[-1] = (*joints[-1][:2], position)

    def end(_: str) -> None:
        path.pop()

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(content, True)
    return joints


def _rewrite(origin: str, twists: list[Array]) -> str:
    """Origin element with displaced numbers; unchanged numbers keep their text."""
    numbers = {m[0]: m[1]["value"] for m in _attributes(origin)}
    for key, value in _displaced(numbers, twists).items():
        attribute = next((m for name, m in _attributes(origin) if name == key), None)
        if attribute is not None:
            start, end = attribute.span("value")
            origin = f"{origin[:start]}{value}{origin[end:]}"
        else:
            closing = re.search(r"\s*/?>$", origin)
            end = len(origin) if closing is None else closing.start()
            origin = f'{origin[:end]} {key}="{value}"{origin[end:]}'
    return origin


def _attributes(origin: str) -> list[tuple[str, re.Match[str]]]:
    """Matches of the attributes xyz and rpy."""
    matches = ((n, re.search(_ATTRIBUTE.format(name=n), origin, re.S)) for n in ("xyz", "rpy"))
    return [(name, match) for name, match in matches if match is not None]


def _displaced(origin: Mapping[str, str], twists: list[Array]) -> dict[str, str]:
    """Attributes of an origin that its displacement changes, with their new numbers."""
    xyz, rpy = (
        np.array([float(v) for v in origin.get(k, "0 0 0").split()]) for k in ("xyz", "rpy")
    )
    place = pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)
    for twist in twists:
        place = place * pin.exp6(twist)
    numbers = {}
    if not np.array_equal(place.translation, xyz):
        numbers["xyz"] = place.translation
    if any(twist[3:].any() for twist in twists):
        numbers["rpy"] = pin.rpy.matrixToRpy(place.rotation)
    return {k: " ".join(f"{v + 0.0:.15g}" for v in n) for k, n in numbers.items()}


def _require_calibrated(machine: Robot, text: str) -> None:
    """Refuse a URDF that differs from the calibrated machine.

    Raises:
        ExportError: If a placement differs; names the first such joint or frame.
    """
    keys = load_description(machine.yaml, content=machine.content[machine.yaml.name])
    model = load_urdf(machine.urdf, content=text.encode(), joint_types=keys.joint_types)
    pairs = list(
        zip(model.names, model.jointPlacements, machine.model.jointPlacements, strict=True)
    )
    for frame in machine.frames:
        placements = (
            m.frames[find_frame(m, frame, where=str(machine.urdf))].placement
            for m in (model, machine.model)
        )
        pairs.append((frame, *placements))
    for name, written, expected in pairs:
        if np.abs(pin.log6(expected.inverse() * written).vector).max() > TOLERANCE:
            raise ExportError(f"a URDF cannot express an error of '{name}'")
