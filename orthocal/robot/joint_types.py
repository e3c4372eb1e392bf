"""Joints that a robot's YAML declares to be of another type than its URDF says.

A URDF has neither ball joints nor universal joints; Gepetto's keys `joint_name` and `joint_type`
say which of its revolute joints stand for one. Such a joint is written into the URDF as revolute
joints in series at the same place, with links without extent between them. A ball joint's turns
about x, y and z reach every orientation; at a quarter turn about y two of them coincide, which a
machine's ball joint does not come near.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

from lxml import etree

from orthocal.errors import RobotError

FIXED = "FIXED"

JOINT_TYPES: dict[str, str] = {
    FIXED: "",
    "SPHERICAL": "XYZ",
    **{f"UJOINT_{a}{b}": a + b for a in "XYZ" for b in "XYZ" if a != b},
}
"""What a joint may be declared to be, and the axes of its own frame that it turns about."""

_AXES = {"X": "1 0 0", "Y": "0 1 0", "Z": "0 0 1"}


def retype_joints(
    root: Any,  # noqa: ANN401 - lxml has no types
    types: Mapping[str, str],
    *,
    where: str,
) -> list[str]:
    """Write declared types into a URDF that was checked.

    Args:
        root: Its outermost element, which is changed.
        types: Name of a moving joint to one of `JOINT_TYPES`; joint j of `UJOINT_XY` becomes j_X
            and j_Y.
        where: File of the declarations, for messages.

    Returns:
        The new joints, none of which is limited.

    Raises:
        RobotError: If there is no such moving joint, or one of its new names is taken.
    """
    joints = {j.get("name"): j for j in root.findall("joint")}
    moving = [name for name, joint in joints.items() if joint.get("type") != "fixed"]
    added: list[str] = []
    for name, declared in types.items():
        if name not in moving:
            close = difflib.get_close_matches(name, moving, n=1, cutoff=0.5)
            hint = f"; did you mean {close[0]}?" if close else ""
            raise RobotError(
                f"the URDF has no moving joint '{name}'{hint}", where=f"{where}: joint_name"
            )
        if declared == FIXED:
            joints[name].set("type", "fixed")
        else:
            added += _split(root, joints[name], JOINT_TYPES[declared], where=where)
    return added


def _split(root: Any, joint: Any, axes: str, *, where: str) -> list[str]:  # noqa: ANN401
    """Replace a joint by revolute joints in series, one an axis; returns their names."""
    name = joint.get("name")
    links = [*(f"{name}_{axis}" for axis in axes[:-1]), joint.find("child").get("link")]
    taken = {e.get("name") for tag in ("link", "joint") for e in root.findall(tag)}
    parent = joint.find("parent").get("link")
    for axis, child in zip(axes, links, strict=True):
        own = f"{name}_{axis}"
        if own in taken:
            raise RobotError(
                f"'{name}' needs the name '{own}', which the URDF has already",
                where=f"{where}: joint_name",
            )
        part = etree.SubElement(root, "joint", name=own, type="revolute")
        if parent == joint.find("parent").get("link") and joint.find("origin") is not None:
            part.append(joint.find("origin"))
        etree.SubElement(part, "parent", link=parent)
        etree.SubElement(part, "child", link=child)
        etree.SubElement(part, "axis", xyz=_AXES[axis])
        etree.SubElement(part, "limit", effort="1", velocity="1", lower="0", upper="0")
        if child != links[-1]:
            etree.SubElement(root, "link", name=child)
        parent = child
    root.remove(joint)
    return [f"{name}_{axis}" for axis in axes]
