"""A URDF file from a stranger: checked element by element, by yourdfpy, and loaded by Pinocchio."""

from __future__ import annotations

import hashlib
import io
import logging
import math
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any

import numpy as np
import pinocchio as pin
from lxml import etree

from orthocal.errors import RobotError
from orthocal.io.documents import LARGEST_NUMBER, read_text
from orthocal.robot.joint_types import retype_joints
from orthocal.runtime import disk_cache as cache
from orthocal.text import composed

MOVING = ("revolute", "continuous", "prismatic")
"""Joint types that a robot may have besides `fixed`."""

LIMITED = ("revolute", "prismatic")
"""Those that have a <limit>."""


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
"""Elements and how many numbers each of their attributes holds."""

_SHAPES = {
    "box": ("size",),
    "cylinder": ("radius", "length"),
    "sphere": ("radius",),
    "mesh": ("filename",),
}
"""What a <geometry> holds, and the attributes that it needs."""

_BOUNDED = frozenset({"xyz", "rpy", "size", "radius", "length", "scale", "rgba"})
"""Attributes that say where and how large something is."""

_NAMES = ("name", "link", "joint")
"""Attributes by which elements speak of each other."""

KEPT_NAMES = frozenset({"universe"})
"""Names that Pinocchio keeps for itself."""

LARGEST_PLACE = 1e4
"""No length [m], angle [rad] or scale is larger: loops of metres must close to nanometres."""

LARGEST_URDF = 16 * 2**20
"""URDF files above this size are refused, [bytes]."""

MOST_ELEMENTS = 20_000
"""XML elements of a URDF; a humanoid with its hands has some thousands."""

_YES = b"yes"

MOST_JOINTS = 400
"""Joints, fixed ones too: urdfdom calls itself for every one in a chain, until its stack ends."""

MOST_VISUALS = 500
"""Visuals, each of which a page draws by itself."""

MOST_MOVING = 120
"""Moving joints: their symbolic derivatives grow with the square. A humanoid with its hands has
about 80."""


def load_urdf(
    path: Path,
    *,
    content: bytes | None = None,
    joint_types: Mapping[str, str] | None = None,
    declared_in: str = "",
) -> pin.Model:
    """Pinocchio's model of a URDF file, after the file was checked.

    A joint whose <limit> has neither `lower` nor `upper` is not limited. URDF gives both a default
    of 0, by which such a joint could not move at all: who means that makes it fixed. Where one of
    the two is given, the other is 0.

    Args:
        path: The file.
        content: What it holds, where it was read already.
        joint_types: Joint to the type that it is declared to be of (see `retype_joints`).
        declared_in: File of these declarations, for messages.

    Raises:
        RobotError: Naming file and line, or file and joint.
    """
    root = parse_urdf(path, content=content)
    _check_elements(root, path)
    unlimited = _complete_limits(root)
    # as it was understood here, whatever encoding it claims to be in
    _validate_with_yourdfpy(str(etree.tostring(root, encoding="unicode")), path)
    retyped = retype_joints(root, joint_types or {}, where=declared_in)
    text = str(etree.tostring(root, encoding="unicode"))
    with captured_stderr() as messages:
        try:
            model = pin.buildModelFromXML(text)
        except (ValueError, RuntimeError) as e:
            reason = " ".join((messages() or str(e)).split())
            raise RobotError(f"Pinocchio cannot load it: {reason}", where=str(path)) from None
    for name in (*unlimited, *retyped):
        if model.existJointName(name):
            place = model.joints[model.getJointId(name)].idx_q
            model.lowerPositionLimit[place] = -np.inf
            model.upperPositionLimit[place] = np.inf
    return model


def _complete_limits(root: Any) -> list[str]:  # noqa: ANN401 - lxml has no types
    """Write URDF's default of 0 where a <limit> leaves it out, which yourdfpy does not know.

    Returns:
        The joints that have neither `lower` nor `upper`.
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


def parse_urdf(path: Path, *, content: bytes | None = None) -> Any:  # noqa: ANN401 - lxml has no types
    """The outermost element of a URDF of a sane size, without comments.

    Args:
        path: The file.
        content: What it holds, where it was read already.

    Raises:
        RobotError: Naming file and line.
    """
    text = read_text(path, error=RobotError, content=content, largest=LARGEST_URDF)
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        huge_tree=False,
        encoding="utf-8",  # whatever the file claims: nothing hides from the checks below
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
            "has a DOCTYPE; a URDF needs none, and it is refused", where=f"{path}:{number}"
        )
    if root.tag != "robot":
        raise RobotError(
            f"the outermost element is <{root.tag}>; expected <robot>",
            where=f"{path}:{root.sourceline}",
        )
    if not root.get("name"):
        raise RobotError("<robot> has no name", where=f"{path}:{root.sourceline}")
    _check_counts(root, path)
    count = sum(1 for _ in root.iter())
    if count > MOST_ELEMENTS:
        raise RobotError(f"has {count} elements; expected at most {MOST_ELEMENTS}", where=str(path))
    etree.strip_tags(root, etree.Comment)
    etree.strip_elements(root, etree.ProcessingInstruction, with_tail=False)
    for element in root.iter():
        for key in _NAMES:
            if key in element.attrib:
                element.set(key, composed(element.get(key)))
    return root


def _check_elements(root: Any, path: Path) -> None:  # noqa: ANN401 - lxml has no types
    """Names, references and numbers that yourdfpy and urdfdom take or reject without a word."""
    links: dict[str, int] = {}
    joints: dict[str, int] = {}
    parents: dict[str, str] = {}

    def at(element: Any) -> str:  # noqa: ANN401 - lxml has no types
        return f"{path}:{element.sourceline}"

    for seen, tag in ((links, "link"), (joints, "joint")):
        for element in root.findall(tag):
            name = element.get("name")
            if not name:
                raise RobotError(f"<{tag}> has no name", where=at(element))
            if name in KEPT_NAMES:
                raise RobotError(f"a {tag} cannot be named '{name}'", where=at(element))
            if name in seen:
                raise RobotError(
                    f"the {tag} '{name}' stands twice; first in line {seen[name]}",
                    where=at(element),
                )
            seen[name] = element.sourceline
    if not links:
        raise RobotError("has no <link>", where=str(path))
    for joint in root.findall("joint"):
        name, kind = joint.get("name"), joint.get("type")
        if kind not in (*MOVING, "fixed"):
            found = "has no type" if kind is None else f"is of type '{kind}'"
            raise RobotError(
                f"joint '{name}' {found}; expected {', '.join(MOVING)} or fixed",
                where=at(joint),
            )
        if joint.find("mimic") is not None:
            raise RobotError(
                f"joint '{name}' mimics another; mimic joints are not supported: Pinocchio's "
                "constraint Jacobians would be wrong",
                where=at(joint),
            )
        ends = {}
        for end in ("parent", "child"):
            element = joint.find(end)
            link = None if element is None else element.get("link")
            if link is None:
                raise RobotError(f"joint '{name}' has no <{end} link=...>", where=at(joint))
            if link not in links:
                raise RobotError(
                    f"joint '{name}': its {end} '{link}' is not a link of this file",
                    where=at(element),
                )
            ends[end] = link
        if ends["child"] in parents:
            raise RobotError(
                f"link '{ends['child']}' is the child of two joints, '{parents[ends['child']]}' "
                f"and '{name}'; close loops with closed_loop in the YAML instead",
                where=at(joint),
            )
        parents[ends["child"]] = name
        axis = joint.find("axis")
        if axis is not None and kind != "fixed":
            vector = _numbers(axis, "xyz", 3, at(axis))
            if vector is None:
                raise RobotError(f"joint '{name}': its <axis> has no xyz", where=at(axis))
            if math.hypot(*vector) < 1e-9:
                raise RobotError(f"joint '{name}' has a zero axis", where=at(axis))
        limit = joint.find("limit")
        if kind in LIMITED:
            if limit is None:
                raise RobotError(f"joint '{name}' of type {kind} has no <limit>", where=at(joint))
            for bound in ("lower", "upper", "effort", "velocity"):
                _numbers(limit, bound, 1, at(limit))
            for bound in ("effort", "velocity"):
                if limit.get(bound) is None:
                    raise RobotError(f"joint '{name}': its <limit> has no {bound}", where=at(limit))
            if float(limit.get("lower", "0")) > float(limit.get("upper", "0")):
                absent = [b for b in ("lower", "upper") if limit.get(b) is None]
                raise RobotError(
                    f"joint '{name}': its lower limit is above its upper limit"
                    + (f" ({absent[0]} is 0 where it is not given)" if absent else ""),
                    where=at(limit),
                )
    roots = [name for name in links if name not in parents]
    if len(roots) != 1:
        found = ", ".join(roots) if roots else "none"
        raise RobotError(f"has {len(roots)} root links ({found}); expected one", where=str(path))
    _check_connected(roots[0], links, root, path)
    for tag, keys in _NUMBERS.items():
        for element in root.iter(tag):
            for key, count in keys.items():
                _numbers(element, key, count, at(element))
    for tag in ("visual", "collision"):
        for element in root.iter(tag):
            geometry = element.find("geometry")
            if geometry is None:
                raise RobotError(f"<{tag}> has no <geometry>", where=at(element))
            shapes = [child for child in geometry if child.tag in _SHAPES]
            if len(shapes) != 1:
                raise RobotError(
                    f"<geometry> holds {len(shapes)} shapes; expected one of {', '.join(_SHAPES)}",
                    where=at(geometry),
                )
            for key in _SHAPES[shapes[0].tag]:
                if shapes[0].get(key) is None:
                    raise RobotError(f"<{shapes[0].tag}> has no {key}", where=at(shapes[0]))
    visuals = sum(1 for _ in root.iter("visual"))
    if visuals > MOST_VISUALS:
        raise RobotError(f"has {visuals} visuals; expected at most {MOST_VISUALS}", where=str(path))


def _check_counts(root: Any, path: Path) -> None:  # noqa: ANN401 - lxml has no types
    joints = root.findall("joint")
    moving = [joint for joint in joints if joint.get("type") != "fixed"]
    for found, most, kind in ((joints, MOST_JOINTS, ""), (moving, MOST_MOVING, "moving ")):
        if len(found) > most:
            raise RobotError(
                f"has {len(found)} {kind}joints; expected at most {most}", where=str(path)
            )


def _check_connected(top: str, links: dict[str, int], root: Any, path: Path) -> None:  # noqa: ANN401
    """Refuse links that hang on each other in a ring, apart from the root."""
    children: dict[str, list[str]] = {}
    for joint in root.findall("joint"):
        parent = joint.find("parent").get("link")
        children.setdefault(parent, []).append(joint.find("child").get("link"))
    reached, pending = {top}, [top]
    while pending:
        for child in children.get(pending.pop(), []):
            if child not in reached:
                reached.add(child)
                pending.append(child)
    apart = [name for name in links if name not in reached]
    if apart:
        raise RobotError(
            f"the links {', '.join(apart)} do not hang on the root link '{top}'", where=str(path)
        )


def _numbers(element: Any, key: str, count: int, where: str) -> list[float] | None:  # noqa: ANN401
    text = element.get(key)
    if text is None:
        return None
    try:
        values = [float(part) for part in text.split() if "_" not in part]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(v) for v in values):
        kind = "a finite number" if count == 1 else f"{count} finite numbers"
        raise RobotError(f"{key} is '{text}'; expected {kind}", where=where)
    # a limit that is far away is none, and some write a million for that
    largest = LARGEST_PLACE if key in _BOUNDED else LARGEST_NUMBER
    if max(map(abs, values)) > largest:
        kind = "a number" if count == 1 else "numbers"
        raise RobotError(f"{key} is '{text}'; expected {kind} within ±{largest:g}", where=where)
    return values


def _validate_with_yourdfpy(text: str, path: Path) -> None:
    """Refuse what yourdfpy does not accept; what it did accept is remembered, for its import."""
    digest = hashlib.sha256(text.encode()).hexdigest()
    accepted = f"yourdfpy {version('yourdfpy')} accepts {digest}"
    if cache.load(accepted) == _YES:
        return
    _ask_yourdfpy(text, path)
    cache.store(accepted, _YES)


def _ask_yourdfpy(text: str, path: Path) -> None:
    import yourdfpy

    logging.getLogger("yourdfpy").setLevel(logging.CRITICAL)
    try:
        urdf = yourdfpy.URDF.load(
            io.BytesIO(text.encode()), build_scene_graph=False, load_meshes=False
        )
        valid = urdf.validate()
    except Exception as e:  # it raises whatever its parser trips over
        reason = f"{type(e).__name__}: {e}"
        raise RobotError(f"yourdfpy cannot read it: {reason}", where=str(path)) from None
    if not valid:
        raise RobotError(f"is not a valid URDF: {urdf.errors[0]}", where=str(path))


@contextmanager
def captured_stderr() -> Iterator[Any]:
    """Catch what C++ code writes to the error stream; yields a function that returns it."""
    with _sink() as sink:
        sys.stderr.flush()
        saved = os.dup(2)
        os.dup2(sink.fileno(), 2)
        restored = False

        def restore() -> None:
            nonlocal restored
            if not restored:
                os.dup2(saved, 2)
                os.close(saved)
                restored = True

        def messages() -> str:
            restore()
            sink.seek(0)
            return sink.read().decode(errors="replace")

        try:
            yield messages
        finally:
            restore()


def _sink() -> IO[bytes]:
    """Temporary file for captured output, or a device that discards it."""
    try:
        return tempfile.TemporaryFile()
    except OSError:
        return open(os.devnull, "w+b")
