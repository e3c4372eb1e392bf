"""Checks of untrusted URDF files, element by element and by yourdfpy, and loading by Pinocchio."""

from __future__ import annotations

import hashlib
import io
import logging
import math
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import IO

import numpy as np
import pinocchio as pin
from lxml import etree

from orthocal.errors import RobotError
from orthocal.io.documents import LARGEST_NUMBER, read_text
from orthocal.robot.joint_types import Element, retype_joints
from orthocal.runtime import disk_cache as cache
from orthocal.text import composed

MOVING = ("revolute", "continuous", "prismatic")
"""Joint types that a robot may have besides `fixed`."""

LIMITED = ("revolute", "prismatic")
"""Joint types with a <limit>."""

_PARTS = ("link", "joint", "material")
"""Elements of a robot. Others belong to other programs, such as <gazebo>, which has visuals of its
own kind."""

_NUMBERS: dict[str, dict[str, int]] = {
    "origin": {"xyz": 3, "rpy": 3},
    "dynamics": {"damping": 1, "friction": 1},
    "mass": {"value": 1},
    "inertia": dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), 1),
    "box": {"size": 3},
    "cylinder": {"radius": 1, "length": 1},
    "sphere": {"radius": 1},
    "mesh": {"scale": 3},
    "color": {"rgba": 4},
}
"""Elements, mapped to their numeric attributes and the count of numbers of each."""

_SHAPES = {
    "box": ("size",),
    "cylinder": ("radius", "length"),
    "sphere": ("radius",),
    "mesh": ("filename",),
}
"""Shapes of a <geometry>, with their required attributes."""

_BOUNDED = frozenset({"xyz", "rpy", "size", "radius", "length", "scale", "rgba"})
"""Attributes for positions and dimensions, which have a smaller limit."""

_NAMES = ("name", "link", "joint")
"""Attributes that name elements."""

RESERVED_NAMES = frozenset({"universe"})
"""Names that Pinocchio reserves."""

LARGEST_PLACE = 1e4
"""Largest length [m], angle [rad] or scale. Far from the origin, rounding errors would exceed the
tolerance of closed loops."""

LARGEST_URDF = 16 * 2**20
"""Largest size of a URDF file, [bytes]."""

MOST_ELEMENTS = 20_000
"""Largest number of XML elements; a humanoid with its hands has some thousands."""

_ACCEPTED = b"yes"
"""Entry of the disk cache for a URDF that yourdfpy accepts."""

MOST_JOINTS = 400
"""Largest number of joints including fixed ones; urdfdom recurses once per joint of a chain."""

MOST_VISUALS = 500
"""Largest number of visuals; a page draws each as an object."""

MOST_MOVING = 120
"""Largest number of moving joints; symbolic derivatives grow with its square. A humanoid with its
hands has about 80."""


def load_urdf(
    path: Path,
    *,
    content: bytes | None = None,
    joint_types: Mapping[str, str] | None = None,
    declared_in: str = "",
) -> pin.Model:
    """Check a URDF file and load it as a Pinocchio model.

    A joint whose <limit> has neither `lower` nor `upper` has no limits. URDF's default of 0 for
    both would fix such a joint. If only one of them is present, the other is 0.

    Args:
        path: The file.
        content: Content of the file; read from it by default.
        joint_types: Names of joints, mapped to declared types (see `retype_joints`).
        declared_in: File of these declarations, for messages.

    Raises:
        RobotError: If the URDF is invalid; names file and line, or file and joint.
    """
    root = parse_urdf(path, content=content)
    _check_elements(root, path)
    unlimited = _complete_limits(root)
    # the parsed text, independent of the encoding that the file declares
    _validate_with_yourdfpy(str(etree.tostring(root, encoding="unicode")), path)
    retyped = retype_joints(root, joint_types or {}, where=declared_in)
    text = str(etree.tostring(root, encoding="unicode"))
    try:
        with captured_stderr() as messages:
            model = pin.buildModelFromXML(text)
    except (ValueError, RuntimeError) as e:
        reason = " ".join((messages[0] or str(e)).split())
        raise RobotError(f"Pinocchio cannot load it: {reason}", where=str(path)) from None
    for name in (*unlimited, *retyped):
        if model.existJointName(name):
            index = model.joints[model.getJointId(name)].idx_q
            model.lowerPositionLimit[index] = -np.inf
            model.upperPositionLimit[index] = np.inf
    return model


def _complete_limits(root: Element) -> list[str]:
    """Write URDF's default of 0 for absent bounds, because yourdfpy requires both.

    Returns:
        Names of the joints with neither bound.
    """
    unlimited = []
    for joint in root.findall("joint"):
        if joint.get("type") not in LIMITED:
            continue
        limit = joint.find("limit")
        absent = [bound for bound in ("lower", "upper") if limit.get(bound) is None]
        if len(absent) == 2:
            unlimited.append(joint.get("name"))
        for bound in absent:
            limit.set(bound, "0")
    return unlimited


def parse_urdf(path: Path, *, content: bytes | None = None) -> Element:
    """Root element of a URDF of limited size, without comments and elements of other programs.

    Args:
        path: The file.
        content: Content of the file; read from it by default.

    Raises:
        RobotError: If it is not the XML of a URDF; names file and line.
    """
    text = read_text(path, error=RobotError, content=content, largest=LARGEST_URDF)
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        huge_tree=False,
        encoding="utf-8",  # independent of the declared encoding, so that checks see all text
    )
    try:
        root = etree.fromstring(text.encode(), parser=parser)
    except etree.XMLSyntaxError as e:
        line = "" if not e.lineno else f":{e.lineno}"
        raise RobotError(
            f"is not valid XML: {str(e.msg).splitlines()[0]}", where=f"{path}{line}"
        ) from None
    if root.getroottree().docinfo.doctype:
        number = text[: text.find("<!DOCTYPE")].count("\n") + 1
        raise RobotError(
            "has a DOCTYPE, which is refused; a URDF needs none", where=f"{path}:{number}"
        )
    if root.tag != "robot":
        raise RobotError(
            f"the outermost element is <{root.tag}>; expected <robot>", where=_place(path, root)
        )
    if not root.get("name"):
        raise RobotError("<robot> has no name", where=_place(path, root))
    _check_counts(root, path)
    count = sum(1 for _ in root.iter())
    if count > MOST_ELEMENTS:
        raise RobotError(f"has {count} elements; expected at most {MOST_ELEMENTS}", where=str(path))
    for child in list(root):
        if child.tag not in _PARTS:
            root.remove(child)
    etree.strip_tags(root, etree.Comment)
    etree.strip_elements(root, etree.ProcessingInstruction, with_tail=False)
    for element in root.iter():
        for key in _NAMES:
            if key in element.attrib:
                element.set(key, composed(element.get(key)))
    return root


def _place(path: Path, element: Element) -> str:
    """File and line of an element, for messages."""
    return f"{path}:{element.sourceline}"


def _check_elements(root: Element, path: Path) -> None:
    """Refuse invalid elements that yourdfpy and urdfdom accept or refuse without a message."""
    links = _check_names(root, path)
    parents: dict[str, str] = {}
    for joint in root.findall("joint"):
        _check_joint(joint, path)
        child = _check_ends(joint, links, path)
        if child in parents:
            raise RobotError(
                f"link '{child}' is the child of two joints, '{parents[child]}' and "
                f"'{joint.get('name')}'; close loops with closed_loop in the YAML instead",
                where=_place(path, joint),
            )
        parents[child] = joint.get("name")
    _check_connected(root, links, parents, path)
    for tag, keys in _NUMBERS.items():
        for element in root.iter(tag):
            for key, count in keys.items():
                _numbers(element, key, count, _place(path, element))
    _check_shapes(root, path)


def _check_names(root: Element, path: Path) -> list[str]:
    """Names of the links; refuses missing, reserved and repeated names of links and joints."""
    names: dict[str, dict[str, int]] = {"link": {}, "joint": {}}
    for tag, lines in names.items():
        for element in root.findall(tag):
            name, where = element.get("name"), _place(path, element)
            if not name:
                raise RobotError(f"<{tag}> has no name", where=where)
            if name in RESERVED_NAMES:
                raise RobotError(f"a {tag} cannot be named '{name}'", where=where)
            if name in lines:
                raise RobotError(
                    f"the {tag} '{name}' occurs twice; first in line {lines[name]}", where=where
                )
            lines[name] = element.sourceline
    if not names["link"]:
        raise RobotError("has no <link>", where=str(path))
    return list(names["link"])


def _check_joint(joint: Element, path: Path) -> None:
    """Refuse a joint with an invalid type, axis or limit."""
    name, kind, where = joint.get("name"), joint.get("type"), _place(path, joint)
    if kind not in (*MOVING, "fixed"):
        problem = "has no type" if kind is None else f"is of type '{kind}'"
        raise RobotError(
            f"joint '{name}' {problem}; expected {', '.join(MOVING)} or fixed", where=where
        )
    if joint.find("mimic") is not None:
        raise RobotError(
            f"joint '{name}' mimics another; mimic joints are not supported: Pinocchio's "
            "constraint Jacobians would be wrong",
            where=where,
        )
    axis, limit = joint.find("axis"), joint.find("limit")
    if axis is not None and kind != "fixed":
        vector = _numbers(axis, "xyz", 3, _place(path, axis))
        if vector is None or math.hypot(*vector) < 1e-9:
            problem = "its <axis> has no xyz" if vector is None else "its axis is zero"
            raise RobotError(f"joint '{name}': {problem}", where=_place(path, axis))
    if kind not in LIMITED:
        return
    if limit is None:
        raise RobotError(f"joint '{name}' of type {kind} has no <limit>", where=where)
    where = _place(path, limit)
    values = {b: _numbers(limit, b, 1, where) for b in ("lower", "upper", "effort", "velocity")}
    for bound in ("effort", "velocity"):
        if values[bound] is None:
            raise RobotError(f"joint '{name}': its <limit> has no {bound}", where=where)
    if (values["lower"] or [0.0]) > (values["upper"] or [0.0]):  # lists of one number
        absent = next((b for b in ("lower", "upper") if values[b] is None), "")
        hint = f" ({absent} is 0 by default)" if absent else ""
        raise RobotError(
            f"joint '{name}': its lower limit is above its upper limit{hint}", where=where
        )


def _check_ends(joint: Element, links: Sequence[str], path: Path) -> str:
    """Name of a joint's child link; refuses links that do not exist."""
    link: str | None = None
    for end in ("parent", "child"):
        element = joint.find(end)
        link = None if element is None else element.get("link")
        if link is None:
            raise RobotError(
                f"joint '{joint.get('name')}' has no <{end} link=...>", where=_place(path, joint)
            )
        if link not in links:
            raise RobotError(
                f"joint '{joint.get('name')}': its {end} '{link}' is not a link of this file",
                where=_place(path, element),
            )
    return str(link)


def _check_connected(
    root: Element, links: Sequence[str], parents: Mapping[str, str], path: Path
) -> None:
    """Require a single root link with all links connected to it.

    Args:
        root: Root element.
        links: Names of the links.
        parents: Names of links, mapped to the joint whose child they are.
        path: The file.
    """
    roots = [name for name in links if name not in parents]
    if len(roots) != 1:
        names = ", ".join(roots) or "none"
        raise RobotError(f"has {len(roots)} root links ({names}); expected one", where=str(path))
    children: dict[str, list[str]] = {}
    for joint in root.findall("joint"):
        parent = joint.find("parent").get("link")
        children.setdefault(parent, []).append(joint.find("child").get("link"))
    reached, pending = set(roots), list(roots)
    while pending:  # each link has one parent and is reached once
        following = children.get(pending.pop(), [])
        reached.update(following)
        pending += following
    unreached = [name for name in links if name not in reached]
    if unreached:
        raise RobotError(
            f"the links {', '.join(unreached)} are not connected to the root link '{roots[0]}'",
            where=str(path),
        )


def _check_shapes(root: Element, path: Path) -> None:
    """Require one shape with its attributes in every visual and collision; limit the visuals."""
    for element in root.iter("visual", "collision"):
        geometry = element.find("geometry")
        if geometry is None:
            raise RobotError(f"<{element.tag}> has no <geometry>", where=_place(path, element))
        shapes = [child for child in geometry if child.tag in _SHAPES]
        if len(shapes) != 1:
            raise RobotError(
                f"<geometry> holds {len(shapes)} shapes; expected one of {', '.join(_SHAPES)}",
                where=_place(path, geometry),
            )
        for key in _SHAPES[shapes[0].tag]:
            if shapes[0].get(key) is None:
                raise RobotError(f"<{shapes[0].tag}> has no {key}", where=_place(path, shapes[0]))
    visuals = sum(1 for _ in root.iter("visual"))
    if visuals > MOST_VISUALS:
        raise RobotError(f"has {visuals} visuals; expected at most {MOST_VISUALS}", where=str(path))


def _check_counts(root: Element, path: Path) -> None:
    """Limit the number of joints."""
    joints = root.findall("joint")
    moving = [joint for joint in joints if joint.get("type") != "fixed"]
    for elements, limit, kind in ((joints, MOST_JOINTS, ""), (moving, MOST_MOVING, "moving ")):
        if len(elements) > limit:
            raise RobotError(
                f"has {len(elements)} {kind}joints; expected at most {limit}", where=str(path)
            )


def _numbers(element: Element, key: str, count: int, where: str) -> list[float] | None:
    """Numbers of an attribute; None if it is absent.

    Raises:
        RobotError: If their count is wrong, or one is not finite or too large.
    """
    text = element.get(key)
    if text is None:
        return None
    try:
        # `float` also accepts digits with underscores, which URDF does not
        values = [float(part) for part in text.split() if "_" not in part]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(v) for v in values):
        kind = "a finite number" if count == 1 else f"{count} finite numbers"
        raise RobotError(f"{key} is '{text}'; expected {kind}", where=where)
    # limits of joints may be larger than places: large ones are common for unlimited joints
    largest = LARGEST_PLACE if key in _BOUNDED else LARGEST_NUMBER
    if max(map(abs, values)) > largest:
        kind = "a number" if count == 1 else "numbers"
        raise RobotError(f"{key} is '{text}'; expected {kind} within ±{largest:g}", where=where)
    return values


def _validate_with_yourdfpy(text: str, path: Path) -> None:
    """Refuse a URDF that yourdfpy does not accept.

    Accepted files are recorded in the disk cache, because importing yourdfpy takes 0.8 s.
    """
    digest = hashlib.sha256(text.encode()).hexdigest()
    key = f"yourdfpy {version('yourdfpy')} accepts {digest}"
    if cache.load(key) == _ACCEPTED:
        return
    _run_yourdfpy(text, path)
    cache.store(key, _ACCEPTED)


def _run_yourdfpy(text: str, path: Path) -> None:
    """Refuse a URDF that yourdfpy does not accept, without the cache."""
    import yourdfpy

    logging.getLogger("yourdfpy").setLevel(logging.CRITICAL)
    try:
        urdf = yourdfpy.URDF.load(
            io.BytesIO(text.encode()), build_scene_graph=False, load_meshes=False
        )
        valid = urdf.validate()
    except Exception as e:  # its parser raises many kinds of errors
        reason = f"{type(e).__name__}: {e}"
        raise RobotError(f"yourdfpy cannot read it: {reason}", where=str(path)) from None
    if not valid:
        raise RobotError(f"is not a valid URDF: {urdf.errors[0]}", where=str(path))


@contextmanager
def captured_stderr() -> Iterator[list[str]]:
    """Capture the error stream of C++ code; the yielded list contains the text afterwards."""
    messages: list[str] = []
    with _sink() as sink:
        sys.stderr.flush()
        saved = os.dup(2)
        os.dup2(sink.fileno(), 2)
        try:
            yield messages
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            sink.seek(0)
            messages.append(sink.read().decode(errors="replace"))


def _sink() -> IO[bytes]:
    """Temporary file for captured output, or a device that discards it."""
    try:
        return tempfile.TemporaryFile()
    except OSError:
        return open(os.devnull, "w+b")
