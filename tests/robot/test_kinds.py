"""Kinds of machines: closed forms, Pinocchio, and the packaged robots."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from lxml import etree
from machines import frame_pose, place
from pinocchio import log3
from pinocchio.rpy import rpyToMatrix
from tolerances import CLOSED

from orthocal import load_robot
from orthocal.builder.biglide import Biglide
from orthocal.builder.linear_delta import LinearDelta
from orthocal.builder.orthoglide import InclinedOrthoglide, Orthoglide
from orthocal.estimation.problem import build_problem
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.reachable_box import describe_unreachable_box
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.output.text.plan import describe_basis
from orthocal.planning.equipment import place_tool
from orthocal.robot import urdf
from orthocal.robot.loading import packaged_robots
from orthocal.sensors.leg_indicator import LegIndicator, Section
from orthocal.sensors.mounting import Mounting
from orthocal.sensors.tips import Tip
from orthocal.session.session import Gauge, Reading, Session, Setup
from orthocal.units import DEG

ORTHOGONAL = np.arcsin(np.sqrt(1.0 / 3.0))
"""Elevation of slides that are orthogonal, [rad]."""

POINTS = np.array([[0.0, 0.0, 0.0], [0.05, 0.02, 0.04], [-0.06, 0.05, 0.02], [0.01, -0.05, 0.05]])

SINGLE = Biglide(rods_apart=0.0, attachment=0.0)
"""Legs of one rod."""

PACKAGED = {
    "linear_delta": LinearDelta(),
    "biglide": Biglide(),
    "inclined_orthoglide": InclinedOrthoglide(),
}


def written(folder, machine, name="machine"):
    """The robot of a machine, read from its files."""
    folder = folder / name
    folder.mkdir()
    (folder / f"{name}.urdf").write_text(machine.urdf(name))
    (folder / f"{name}.yaml").write_text(machine.yaml())
    return load_robot(folder)


def test_the_travel_of_a_plan_has_the_units_of_its_drives(root):
    """Degrees for motors, and nothing for one that turns without end."""
    fivebar = load_robot(root / "examples/fivebar")
    drives = (fivebar.drives[0], replace(fivebar.drives[1], lower=-np.inf, upper=np.inf))
    basis = describe_basis(replace(fivebar, drives=drives))
    limits = np.rad2deg([fivebar.drives[0].lower, fivebar.drives[0].upper])
    assert basis["travel"] == [pytest.approx(limits, abs=1e-6), [None, None]]
    json.dumps(basis, allow_nan=False)


@pytest.mark.parametrize("angles", [(210, 330, 90), (212, 329, 91)])
def test_slides_of_a_delta_are_at_the_heights_of_the_textbook(tmp_path, angles):
    delta = LinearDelta(angles=tuple(a * DEG for a in angles))
    robot = written(tmp_path, delta)
    drives = LoopClosure(robot).inverse(POINTS)
    for k, angle in enumerate(delta.angles):
        tower = delta.radius * np.array([np.cos(angle), np.sin(angle)])
        apart = ((tower - POINTS[:, :2]) ** 2).sum(axis=1)
        height = POINTS[:, 2] + np.sqrt(delta.rod**2 - apart)
        assert np.abs(drives[:, k] - height).max() < CLOSED


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (Orthoglide(), Orthoglide(leg=0.25, attachment=0.03, rods_apart=0.06)),
        (InclinedOrthoglide(), InclinedOrthoglide(leg=0.25, elevation=30 * DEG)),
        (LinearDelta(), LinearDelta(rod=0.25, angles=tuple(a * DEG for a in (212, 329, 91)))),
        (Biglide(), Biglide(leg=0.25, attachment=0.02)),
    ],
)
def test_machines_of_one_kind_share_all_functions(tmp_path, monkeypatch, one, other):
    """Those of the loops, the tool and the readings, whatever the dimensions."""
    monkeypatch.setenv("ORTHOCAL_CACHE", str(tmp_path / "cache"))
    (tmp_path / "cache").mkdir()
    monkeypatch.setattr(urdf, "_validate_with_yourdfpy", lambda *_: None)

    def build(machine, name):
        robot = written(tmp_path, machine, name)
        LoopClosure(robot).inverse(0.1 * POINTS)
        ToolSensitivity(robot, free=robot.parameters.names)(robot.drive_zero)
        problem = build_problem(read_rods(robot), model="full")
        readings, _ = problem.predict_and_jacobian(np.zeros(problem.n_free))
        assert np.isfinite(readings).all()
        return {p.name for p in (tmp_path / "cache").iterdir()}

    assert build(one, "one") == build(other, "other")


def read_rods(robot):
    """Plan with one reading of a rod of each leg."""
    ball, setups = Tip("ball", 1.5e-3), {}
    for name, leg in robot.legs.items():
        across = np.cross(leg.axis, np.roll(leg.axis, 1) + 0.1 * np.eye(3)[2])
        direction = tuple((across / np.linalg.norm(across)).tolist())
        sensor = LegIndicator(name, direction, Section("fraction", 0.5), Mounting())
        setups[name] = Setup(name, sensor.on_rod("a", ball))
    zero = np.zeros((1, len(robot.tcp.coordinates)))
    return Session(
        robot=robot,
        robot_reference=robot.name,
        gauges={"": Gauge(5e-6)},
        postures=place_tool(robot, ["zero"], zero),
        setups=setups,
        readings=tuple(Reading(name, "zero") for name in setups),
    )


def slide_directions(machine):
    """Unit vectors of the slides by the definition of the kind, shape (n, 3)."""
    if isinstance(machine, Biglide):
        return np.eye(3)[:2]
    turns = np.arange(3) * 120 * DEG
    level, up = np.cos(machine.elevation), np.sin(machine.elevation)
    return np.column_stack([level * np.cos(turns), level * np.sin(turns), np.full(3, up)])


@pytest.mark.parametrize(
    "machine",
    [
        *(InclinedOrthoglide(elevation=angle) for angle in (20 * DEG, ORTHOGONAL, 70 * DEG)),
        SINGLE,
        Biglide(leg=0.2, travel=(0.1, 0.3), attachment=0.02, rods_apart=0.05),
    ],
)
def test_slides_are_where_the_legs_of_fixed_length_end(tmp_path, machine):
    """ρ = p·d + √(L² − |p − (p·d) d|²) along the slide's direction d, attachment or not."""
    robot = written(tmp_path, machine)
    directions = slide_directions(machine)
    points = POINTS[:, : len(machine.coordinates)] * (machine.leg / 0.31025)
    drives = LoopClosure(robot).inverse(points)
    full = np.zeros((len(points), 3))
    full[:, : points.shape[1]] = points
    along = full @ directions.T
    across = (full**2).sum(axis=1)[:, None] - along**2
    assert np.abs(drives - along - np.sqrt(machine.leg**2 - across)).max() < CLOSED
    assert np.abs(LoopClosure(robot).forward(drives) - full).max() < CLOSED


@pytest.mark.parametrize("machine", [LinearDelta(), InclinedOrthoglide(), Biglide(), SINGLE])
def test_named_lengths_and_radius_are_those_of_the_legs(tmp_path, machine):
    """Each slide stays at its distance, rod length with its error, from the hinge on the tool.

    Without errors the tool is where Pinocchio closes the loops.
    """
    robot, count = written(tmp_path, machine), len(machine.coordinates)
    drives = LoopClosure(robot).inverse(POINTS[:, :count])
    for point, coordinates in zip(POINTS, drives, strict=True):
        at = np.where(np.arange(3) < count, point, 0.0)
        assert np.abs(place(robot, coordinates, "tcp") - at).max() < CLOSED
    longer = dict(zip(machine.letters, (2e-3, -1e-3, 3e-3), strict=False))
    errors = {f"{k}_leg.length": v for k, v in longer.items()}
    moved = dict.fromkeys(machine.letters, np.zeros(2))
    if isinstance(machine, LinearDelta):
        moved = {k: np.array([4e-3, v]) for k, v in zip("abc", (1e-3, -2e-3, 0.5e-3), strict=True)}
        errors |= {"radius": 4e-3, **{f"{k}_tower.tangential": v[1] for k, v in moved.items()}}
    tool = LoopClosure(robot, fixed=errors).forward(drives)
    for leg, along in zip(machine.legs(), drives.T, strict=True):
        aside = moved[leg.name] @ np.stack([-leg.frame[:, 0], leg.frame[:, 2]])
        root = leg.root + aside + (along - leg.zero)[:, None] * leg.direction
        length = np.linalg.norm(root - leg.tip - tool, axis=1)
        assert length == pytest.approx(leg.length + longer[leg.name], abs=CLOSED)


def test_tilts_turn_the_effector_about_the_rods_of_their_arms(tmp_path):
    machine, tilts = LinearDelta(), {"a": 1e-3, "b": -2e-3, "c": 0.5e-3}
    robot = written(tmp_path, machine)
    errors = {f"{k}_effector.tilt": v for k, v in tilts.items()}
    turned = log3(frame_pose(robot.with_errors(errors), robot.drive_zero, "tcp").rotation)
    for leg in machine.legs():
        assert turned @ leg.axes[:, 0] == pytest.approx(tilts[leg.name], abs=1e-5)


@pytest.mark.parametrize(
    ("machine", "count"),
    [
        (Orthoglide(), 129),
        (LinearDelta(), 129),
        (InclinedOrthoglide(elevation=60 * DEG), 129),
        (Biglide(), 52),
        (SINGLE, 28),
    ],
)
def test_the_complete_model_has_every_error_that_moves_something(tmp_path, machine, count):
    assert len(written(tmp_path, machine).parameters.select_model("full")) == count


@pytest.mark.parametrize("name", PACKAGED)
def test_packaged_robots_are_made_from_their_dimensions(name):
    folder = packaged_robots()[name]
    assert (folder / f"{name}.urdf").read_text() == PACKAGED[name].urdf(name)
    assert (folder / f"{name}.yaml").read_text() == PACKAGED[name].yaml()


def numbers(element, key):
    return np.array([float(v) for v in element.get(key, "0 0 0").split()])


def drawn_points(visual):
    """Corners of a box, ends of a cylinder with its radius, or centre and radius of a sphere."""
    origin, shape = visual.find("origin"), visual.find("geometry")[0]
    if shape.tag == "sphere":
        return [(*numbers(origin, "xyz"), float(shape.get("radius")))]
    turned = rpyToMatrix(numbers(origin, "rpy"))
    if shape.tag == "cylinder":
        half, size = np.array([[0, 0, 1], [0, 0, -1]]), float(shape.get("length"))
        points, last = half * 0.5 * size, float(shape.get("radius"))
    else:
        corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)
        points, last = corners * numbers(shape, "size"), 0.0
    placed = np.round(points @ turned.T + numbers(origin, "xyz"), 9) + 0.0
    return sorted((*p, last) for p in placed.tolist())


def test_the_packaged_orthoglide_is_one_of_the_kinds(tmp_path, orthoglide):
    """Joints, placements, limits and drawings of the robot that was written by hand."""
    machine = Orthoglide()
    models = [written(tmp_path, machine, "orthoglide").model, orthoglide.model]
    for a, b in zip(*(m.frames for m in models), strict=True):
        assert (a.name, a.type, a.parentJoint) == (b.name, b.type, b.parentJoint)
        assert np.abs(a.placement.homogeneous - b.placement.homogeneous).max() < 1e-15
    for a, b in zip(*(zip(m.names, m.joints, strict=True) for m in models), strict=True):
        assert (a[0], a[1].shortname()) == (b[0], b[1].shortname())
    # to the last bit: ties in plans depend on it
    exact = [
        [*m.lowerPositionLimit, *m.upperPositionLimit, *(p.homogeneous for p in m.jointPlacements)]
        for m in models
    ]
    assert all(np.array_equal(a, b) for a, b in zip(*exact, strict=True))
    made = etree.fromstring(machine.urdf("orthoglide").encode())
    packaged = etree.parse(str(orthoglide.urdf)).getroot()
    for a, b in zip(made.iterfind("link"), packaged.iterfind("link"), strict=True):
        drawn = [[drawn_points(v) for v in link.iterfind("visual")] for link in (a, b)]
        assert drawn[0] == drawn[1], a.get("name")
    assert yaml.safe_load(machine.yaml()) == yaml.safe_load(orthoglide.yaml.read_text())


@pytest.mark.parametrize(
    ("machine", "name", "message"),
    [
        (InclinedOrthoglide(elevation=19.9 * DEG), "elevation", "slides at 19.9°; expected 20"),
        (InclinedOrthoglide(leg=250.0), "leg", "legs of 250000 mm; expected 20 to 5000 mm"),
        (Orthoglide(leg=250.0), "leg", "legs of 250000 mm; expected 20 to 5000 mm"),
        (Orthoglide(leg=float("nan")), "leg", "legs of nan mm"),
        (Orthoglide(leg=0.4), "travel", "does not include 400 mm, the leg length"),
        (Orthoglide(travel=(0.39, 0.12)), "travel", "390 to 120 mm; expected the lowest"),
        (Orthoglide(travel=(0.12, 0.65)), "travel", "legs of 310.25 mm reach 31.025 to 589.475"),
        (Orthoglide(attachment=-0.01), "attachment", "hinges -10 mm from the tool centre point"),
        (Orthoglide(rods_apart=0.01), "rod_radius", "rods of radius 5.5 mm, 10 mm apart"),
        (Orthoglide(rod_radius=0.0), "rod_radius", "rods of radius 0 mm"),
        (LinearDelta(rod=280.0), "rod", "rods of 280000 mm"),
        (LinearDelta(radius=0.27), "radius", "delta radius of 270 mm; expected 56 to 252 mm"),
        (LinearDelta(angles=(0.0, 1.0, 3.0)), "angles", "towers at 0, 57.295779513, 171.887338"),
        (LinearDelta(angles=(0.0, float("nan"), 3.0)), "angles", "towers at 0, nan"),
        (LinearDelta(travel=(0.3, 0.56)), "travel", "to include 242.48711306 mm"),
        (LinearDelta(platform=0.0), "platform", "hinges 0 mm from the tool centre point"),
        (LinearDelta(rod_radius=0.04), "rod_radius", "rods of radius 40 mm, 50 mm apart"),
        (replace(SINGLE, attachment=0.04), "rods_apart", "legs of one rod meet in the tool"),
        (Biglide(rods_apart=0.001), "rod_radius", "rods of radius 5.5 mm, 1 mm apart"),
    ],
)
def test_dimensions_that_make_no_machine_are_refused(machine, name, message):
    found = machine.find_problem()
    assert found is not None
    assert (found[0], message in found[1]) == (name, True), found


@pytest.mark.parametrize(("rod", "radius"), [(0.28, 0.14), (0.1277, 0.1), (0.1112, 0.1)])
def test_the_rods_of_a_delta_reach_its_default_workspace(tmp_path, rod, radius):
    """Short rods around a large radius leave little room, but some."""
    delta = LinearDelta(rod=rod, radius=radius, travel=(0.005, 0.56))
    robot = written(tmp_path, delta)
    assert describe_unreachable_box(robot, robot.workspace) == ""


@pytest.mark.parametrize("machine", [LinearDelta(), InclinedOrthoglide(), Biglide(), SINGLE])
def test_the_tool_is_where_pinocchio_closes_the_loops(tmp_path, machine):
    robot = written(tmp_path, machine)
    count = len(machine.coordinates)
    drives = LoopClosure(robot).inverse(POINTS[:, :count])
    for point, coordinates in zip(POINTS, drives, strict=True):
        at = np.where(np.arange(3) < count, point, 0.0)
        assert np.abs(place(robot, coordinates, "tcp") - at).max() < CLOSED
