"""Joint types that a robot's YAML declares instead of those in its URDF.

URDF has neither ball joints nor universal joints. The keys `joint_name` and `joint_type` of the
Gepetto "extended URDF" declare the revolute joints that represent one. Such a joint is replaced by
revolute joints in series with a common origin. A ball joint turns about x, y and z. It is singular
at a quarter turn about y, far beyond the range of a ball joint.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lxml import etree

from orthocal.errors import RobotError
from orthocal.robot.parameters import suggest

Element = Any
"""Element of lxml, which has no types."""

FIXED = "FIXED"
"""Declared type of a joint that does not move."""

JOINT_TYPES: dict[str, str] = {
    FIXED: "",
    "SPHERICAL": "XYZ",
    **{f"UJOINT_{a}{b}": a + b for a in "XYZ" for b in "XYZ" if a != b},
}
"""Declared types, mapped to their rotation axes in the joint's frame, in order."""

_AXES = {"X": "1 0 0", "Y": "0 1 0", "Z": "0 0 1"}
"""Vectors of the axes in the form of URDF."""


def retype_joints(root: Element, types: Mapping[str, str], *, where: str) -> list[str]:
    """Write declared joint types into a checked URDF.

    Args:
        root: Root element of the URDF, which is changed.
        types: Names of moving joints, mapped to `JOINT_TYPES`. Joint j of type `UJOINT_XY` becomes
            j_X and j_Y.
        where: File of the declarations, for messages.

    Returns:
        Names of the new joints, which have no limits.

    Raises:
        RobotError: If a joint does not exist or is fixed, or a new name already exists.
    """
    joints = {j.get("name"): j for j in root.findall("joint")}
    moving = [name for name, joint in joints.items() if joint.get("type") != "fixed"]
    added: list[str] = []
    for name, declared in types.items():
        if name not in moving:
            raise RobotError(
                f"the URDF has no moving joint '{name}'{suggest(name, moving)}",
                where=f"{where}: joint_name",
            )
        if declared == FIXED:
            joints[name].set("type", "fixed")
        else:
            added += _split(root, joints[name], JOINT_TYPES[declared], where=where)
    return added


def _split(root: Element, joint: Element, axes: str, *, where: str) -> list[str]:
    """Replace a joint by revolute joints in series, one per axis.

    Returns:
        Names of the new joints.

    Raises:
        RobotError: If the URDF already has one of these names.
    """
    name = joint.get("name")
    new_names = [f"{name}_{axis}" for axis in axes]
    existing = {e.get("name") for tag in ("link", "joint") for e in root.findall(tag)}
    for new in new_names:
        if new in existing:
            raise RobotError(
                f"'{name}' needs the name '{new}', which the URDF has already",
                where=f"{where}: joint_name",
            )
    parent, origin = joint.find("parent").get("link"), joint.find("origin")
    links = [*new_names[:-1], joint.find("child").get("link")]
    for new, axis, child in zip(new_names, axes, links, strict=True):
        part = etree.SubElement(root, "joint", name=new, type="revolute")
        if origin is not None and axis == axes[0]:
            part.append(origin)
        etree.SubElement(part, "parent", link=parent)
        etree.SubElement(part, "child", link=child)
        etree.SubElement(part, "axis", xyz=_AXES[axis])
        # placeholders that URDF requires; `load_urdf` removes the limits
        etree.SubElement(part, "limit", effort="1", velocity="1", lower="0", upper="0")
        if child != links[-1]:
            etree.SubElement(root, "link", name=child)
        parent = child
    root.remove(joint)
    return new_names
