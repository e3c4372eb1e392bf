"""Visuals of links: primitives and meshes as in the URDF, otherwise sticks."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import yourdfpy

from orthocal import draw_scene, load_robot
from orthocal.viewer.visuals import load_visuals

BOX = '<geometry><box size="0.36 0.05 0.018"/></geometry>'
TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.3]])
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]


def stl():
    """A tetrahedron as text."""
    lines = ["solid t"]
    for face in FACES:
        corners = (f"vertex {' '.join(str(v) for v in TETRAHEDRON[i])}" for i in face)
        lines += ["facet normal 0 0 0", "outer loop", *corners, "endloop", "endfacet"]
    return "\n".join([*lines, "endsolid t", ""])


@pytest.fixture
def with_mesh(root, tmp_path):
    """The Orthoglide, the rail of its x axis a tetrahedron of twice the file's size."""
    folder = tmp_path / "meshed"
    shutil.copytree(root / "robots/orthoglide", folder)
    (folder / "parts").mkdir()
    (folder / "parts/rail.stl").write_text(stl())
    urdf = folder / "orthoglide.urdf"
    mesh = '<geometry><mesh filename="package://any/parts/rail.stl" scale="2 2 2"/></geometry>'
    urdf.write_text(urdf.read_text().replace(BOX, mesh))
    return load_robot(folder)


def test_visuals_are_those_that_yourdfpy_reads(orthoglide):
    """Parts, sizes, colours and poses as another reader of the same file has them."""
    other = yourdfpy.URDF.load(str(orthoglide.urdf), build_scene_graph=False, load_meshes=False)
    found = load_visuals(orthoglide)
    for link in other.robot.links:
        mine = [v for v in found if v.link == link.name]
        assert len(mine) == len(link.visuals)
        for visual, theirs in zip(mine, link.visuals, strict=True):
            assert visual.placement == pytest.approx(theirs.origin, abs=1e-12)
            colours = {m.name: m.color.rgba for m in other.robot.materials}
            rgba = colours[theirs.material.name]
            assert (*visual.colour, visual.opacity) == pytest.approx(rgba, abs=1e-6)
            shape = visual.geometry.lower({})
            if theirs.geometry.box is not None:
                sides = [shape[k] for k in ("width", "height", "depth")]
                assert sides == pytest.approx(theirs.geometry.box.size)
                size = np.abs(theirs.origin[:3, :3]) @ theirs.geometry.box.size
                assert np.ptp(visual.corners, axis=0) == pytest.approx(size, abs=1e-9)
            elif theirs.geometry.sphere is not None:
                assert shape["radius"] == pytest.approx(theirs.geometry.sphere.radius)
            else:
                cylinder = theirs.geometry.cylinder
                assert shape["height"] == pytest.approx(cylinder.length)
                assert shape["radiusTop"] == shape["radiusBottom"]
                assert shape["radiusTop"] == pytest.approx(cylinder.radius)


def test_cylinders_lie_along_z_as_in_a_urdf(orthoglide):
    """meshcat's cylinders lie along y; the ends of the rod must be the joints."""
    rod = next(v for v in load_visuals(orthoglide) if v.link == "x_rod_a")
    inner = rod.geometry.intrinsic_transform().T  # three.js stores columns
    half = rod.geometry.height / 2.0
    ends = [rod.placement @ inner @ np.array([0.0, y, 0.0, 1.0]) for y in (-half, half)]
    assert ends[0][:3] == pytest.approx(np.zeros(3), abs=1e-9)
    assert ends[1][:3] == pytest.approx([0.31025, 0.0, 0.0], abs=1e-9)


def test_meshes_of_the_robot_are_drawn(with_mesh):
    mesh = next(v for v in load_visuals(with_mesh) if v.link == "base")
    vertices = np.unique(np.round(mesh.geometry.vertices, 6), axis=0)
    expected = np.unique(np.round(2.0 * TETRAHEDRON, 6), axis=0)
    assert vertices == pytest.approx(expected, abs=1e-6)
    assert len(mesh.geometry.faces) == len(FACES)
    local = np.linalg.inv(mesh.placement) @ np.c_[mesh.corners, np.ones(8)].T
    assert local[:3].max(axis=1) == pytest.approx([0.2, 0.4, 0.6], abs=1e-6)
    assert "Machine/base/part 1" in draw_scene(with_mesh).nodes


def test_sticks_join_links_and_their_joints(fivebar):
    """Every link has a ball, and a stick to each joint or mount on it."""
    found = load_visuals(fivebar)
    model = fivebar.model
    for joint in range(1, model.njoints):
        parent = model.parents[joint]
        ends = [
            v.placement[:3, 3] + v.placement[:3, 2] * v.geometry.height
            for v in found
            if hasattr(v.geometry, "height")
            and model.frames[fivebar.frame_id(v.link)].parentJoint == parent
        ]
        target = model.jointPlacements[joint].translation
        assert any(np.abs(e - target).max() < 1e-9 for e in ends) or np.abs(target).max() < 1e-9
