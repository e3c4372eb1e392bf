"""Visible shapes of a robot: the visuals of its URDF, or sticks if it has none."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import coal
import meshcat.geometry as g
import numpy as np
import pinocchio as pin
from lxml import etree

from orthocal.arrays import Array
from orthocal.errors import RobotError
from orthocal.io.files import exists, read_file, require_file
from orthocal.robot.files import MESH_FORMATS, mesh_path, robot_directory
from orthocal.robot.model import Robot
from orthocal.robot.urdf import LARGEST_PLACE, captured_stderr, parse_urdf
from orthocal.viewer.shapes import Colour, cylinder, pose_along

MAX_REPETITION = 10 * 2**20
"""Largest total size of the repetitions of a mesh file, [bytes]."""

MAX_LINE = 4_000
"""Most characters of a line in an OBJ file, for a face with some hundred corners."""

MAX_TRIANGLES = 300_000
"""Most triangles of a mesh, because a page contains each as text."""

_STICK: Colour = (0.55, 0.58, 0.62)


@dataclass(frozen=True, slots=True, eq=False)
class Visual:
    """Visible shape of a link."""

    link: str
    placement: Array
    """Pose in the frame of the link, shape (4, 4), [m]."""
    geometry: g.Geometry
    colour: Colour
    opacity: float
    """Opacity, 0 to 1."""
    corners: Array
    """Corners of the bounding box in the frame of the link, shape (8, 3), [m]."""


def load_visuals(robot: Robot) -> tuple[Visual, ...]:
    """Visible shapes of the links of a robot; without visuals, sticks between its joints.

    Raises:
        RobotError: If a mesh file is missing, unreadable or outside the robot's directory.
    """
    with robot_directory(robot) as folder:
        text = _with_absolute_meshes(robot, folder)
        try:
            with captured_stderr():
                geometry = pin.buildGeomFromUrdfString(robot.model, text, pin.GeometryType.VISUAL)
        except (ValueError, RuntimeError) as e:
            # remove the source location and the hint of the library
            reason = " ".join(str(e).split("message:")[-1].split("Hint:")[0].split())
            raise RobotError(
                f"its visuals cannot be loaded: {reason}", where=str(robot.urdf)
            ) from None
    visuals = tuple(_visual(robot, part) for part in geometry.geometryObjects)
    return visuals or tuple(_sticks(robot))


def _with_absolute_meshes(robot: Robot, folder: Path) -> str:
    """Text of the URDF with absolute paths of its meshes.

    Visuals with meshes that an embedded robot does not contain are removed.
    """
    root = parse_urdf(robot.urdf, content=robot.content[robot.urdf.name])
    uses: Counter[Path] = Counter()
    for mesh in list(root.iter("mesh")):
        name = mesh.get("filename") or ""
        where = f"{robot.urdf}:{mesh.sourceline}"
        path = (folder / mesh_path(name)).resolve()
        if not path.is_relative_to(folder):
            raise RobotError(
                f"the mesh '{name}' lies outside of the robot's directory", where=where
            )
        if path.suffix.lower() not in MESH_FORMATS:
            raise RobotError(f"the mesh '{name}' is none of {', '.join(MESH_FORMATS)}", where=where)
        if robot.folder is None and not exists(path):
            mesh.getparent().getparent().getparent().remove(mesh.getparent().getparent())
            continue
        if not exists(path):
            raise RobotError(f"there is no mesh file {path}", where=where)
        require_file(path, error=RobotError)
        if path.suffix.lower() == ".obj":
            _require_short_lines(path, where)
        repeated = path.stat().st_size * uses[path]
        uses[path] += 1
        if repeated > MAX_REPETITION:
            raise RobotError(
                f"the mesh '{name}' is drawn {uses[path]} times, {repeated / 2**20:.0f} MiB again; "
                f"expected at most {MAX_REPETITION / 2**20:g} MiB",
                where=where,
            )
        mesh.set("filename", str(path))
    return str(etree.tostring(root, encoding="unicode"))


def _require_short_lines(path: Path, where: str) -> None:
    """Refuse an OBJ file with a face of thousands of corners: its triangulation is quadratic."""
    lines = read_file(path, error=RobotError).split(b"\n")
    longest = max(len(line) for line in lines)
    if longest > MAX_LINE:
        raise RobotError(
            f"the mesh {path} has a line of {longest} characters; expected at most {MAX_LINE}",
            where=where,
        )


def _visual(robot: Robot, part: pin.GeometryObject) -> Visual:
    """Visible shape from a geometry object of Pinocchio."""
    geometry = _geometry(robot, part)
    frame = robot.model.frames[part.parentFrame]
    placement = frame.placement.inverse() * part.placement
    shape = part.geometry
    shape.computeLocalAABB()
    box = shape.aabb_local
    low, high = np.asarray(box.min_).reshape(3), np.asarray(box.max_).reshape(3)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    inside = low + corners * (high - low)
    colour = np.asarray(part.meshColor, dtype=np.float64).reshape(4)
    return Visual(
        link=frame.name,
        placement=np.asarray(placement.homogeneous),
        geometry=geometry,
        colour=(float(colour[0]), float(colour[1]), float(colour[2])),
        opacity=float(colour[3]),
        corners=inside @ placement.rotation.T + placement.translation,
    )


def _geometry(robot: Robot, part: pin.GeometryObject) -> g.Geometry:
    """Geometry of meshcat from a geometry object of Pinocchio.

    Raises:
        RobotError: If the shape is not supported.
    """
    shape = part.geometry
    if isinstance(shape, coal.Box):
        return g.Box([float(v) for v in 2.0 * np.asarray(shape.halfSide).reshape(3)])
    if isinstance(shape, coal.Sphere):
        return g.Sphere(float(shape.radius))
    if isinstance(shape, coal.Cylinder):
        half = float(shape.halfLength)
        return cylinder(2.0 * half, float(shape.radius), start=-half)
    if isinstance(shape, coal.BVHModelBase):
        _check_mesh(robot, part)
        faces = [shape.tri_indices(i) for i in range(shape.num_tris)]
        triangles = np.array([[f[0], f[1], f[2]] for f in faces], dtype=np.uint32)
        return g.TriangularMeshGeometry(np.asarray(shape.vertices()), triangles)
    raise RobotError(
        f"the visual '{part.name}' is a {type(shape).__name__}; expected a box, a cylinder, a "
        "sphere or a mesh",
        where=str(robot.urdf),
    )


def _check_mesh(robot: Robot, part: pin.GeometryObject) -> None:
    """Refuse a mesh that is too large for a scene.

    Raises:
        RobotError: If the mesh has too many triangles or vertices too far away.
    """
    vertices = np.asarray(part.geometry.vertices())
    problem = None
    if part.geometry.num_tris > MAX_TRIANGLES:
        problem = f"has {part.geometry.num_tris} triangles; expected at most {MAX_TRIANGLES}"
    elif not (np.isfinite(vertices).all() and np.abs(vertices).max(initial=0.0) <= LARGEST_PLACE):
        problem = f"reaches beyond ±{LARGEST_PLACE:g} m"
    if problem:
        raise RobotError(f"the mesh '{part.meshPath}' {problem}", where=str(robot.urdf))


def _sticks(robot: Robot) -> Iterator[Visual]:
    """Ball at every link, and a stick to each joint mounted on it."""
    model, radius = robot.model, 0.012 * robot.characteristic_length
    for i, link in enumerate(model.frames):
        if link.type != pin.FrameType.BODY:
            continue
        yield _stick(link.name, np.zeros(3), radius)
        for mount in model.frames:
            if mount.parentFrame != i:
                continue
            placement = mount.placement
            if mount.type == pin.FrameType.JOINT:
                placement = model.jointPlacements[mount.parentJoint]
            end = link.placement.inverse() * placement
            yield _stick(link.name, np.asarray(end.translation), radius)


def _stick(link: str, end: Array, radius: float) -> Visual:
    """Stick from the origin of a link to a point, [m]; a ball if the point is the origin."""
    length = float(np.linalg.norm(end))
    if length < 1e-9:
        geometry, placement = g.Sphere(1.6 * radius), np.eye(4)
    else:
        geometry, placement = cylinder(length, radius), pose_along(np.zeros(3), end / length)
    corners = np.array([np.full(3, -radius), np.full(3, radius)] * 4) + np.outer([0, 1] * 4, end)
    return Visual(link, placement, geometry, _STICK, 1.0, corners)
