"""Indicators at the tool: rays of a plunger against planes by Pinocchio and SciPy, and bounds."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from bounds import bound_um
from calibrated import identified
from conftest import ROOT
from machines import frame_pose
from scipy.spatial.transform import Rotation
from sensor_machines import assert_promises, calibrate_machines
from tolerances import CLOSED_FORM

from orthocal import load_plan, load_robot, simulate_session
from orthocal.kinematics.workspace import cube
from orthocal.observation.model import predict_readings
from orthocal.observation.sensor_groups import nuisance_parameters

ERRORS = {"x_slide.offset": 0.7e-3, "y_slide.offset": -0.4e-3, "z_swivel.rx": 1.5e-3}
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
STEPS = (-60, -30, 0, 30, 60)
SQUARE = "kind: square, name: granite, square_tolerance_mrad: 0.02, straight_tolerance_mm: 0.002"
PLATE = "kind: plate, flat_tolerance_mm: 0.003, bed: true"
BLOCK = "kind: gauge_block, height_mm: 50, height_tolerance_mm: 0.0005, table_mm: -25"
PAPER = """  leg_{d}{leg}: {{leg: {leg}, direction: {d}, section: {{fraction: 0.5}},
    postures: [zero, {leg}_60, {leg}_-100]}}"""
TIP = (6.0, -5.0, -40.0)


class Plan:
    """Session file in the making.

    Args:
        tip: Whether the tip is away from the tool centre point.
    """

    def __init__(self, *, tip=False):
        self.points = {"zero": (0, 0, 0)}
        self.setups = []
        self.tip = f", tool_mm: {list(TIP)}" if tip else ""

    def read(self, name, direction, artefact, points):
        """Add a setup."""
        names = []
        for point in points:
            label = "p" + "_".join(f"{v:g}" for v in point)
            names.append("zero" if not np.any(point) else label)
            self.points[names[-1]] = point
        self.setups.append(
            f"  {name}: {{sensor: tool_indicator, direction: {direction}, "
            f"artefact: {{{artefact}}}{self.tip}, postures: [{', '.join(names)}]}}"
        )

    def squares(self, *, artefact=SQUARE):
        """Both arms of a square in each plane."""
        for a, b in ("xy", "yz", "zx"):
            own = artefact.replace("granite", f"granite_{a}{b}")
            for along, across in ((a, b), (b, a)):
                points = [tuple(s * v for v in AXES[along]) for s in STEPS]
                self.read(f"{a}{b}_{along}", across, f"{own}, along: {along}", points)

    def plates(self):
        """Nine places of a plate square to each axis."""
        for k, d in enumerate("xyz"):
            i, j = (k + 1) % 3, (k + 2) % 3
            points = [
                tuple(a * (m == i) + b * (m == j) for m in range(3))
                for a in (-60, 0, 60)
                for b in (-60, 0, 60)
            ]
            self.read(f"plate_{d}", f"-{d}", PLATE, points)

    def blocks(self):
        """A block along each axis, and the plane on which it lies."""
        for d in "xyz":
            points = [tuple(v * np.array(AXES[d])) for v in (-25, 25)]
            self.read(f"block_{d}", f"-{d}", BLOCK, points)

    def legs(self):
        """The paper's readings."""
        for leg, axis in AXES.items():
            for value in (60, -100):
                self.points[f"{leg}_{value}"] = tuple(value * np.array(axis))
            self.setups += [PAPER.format(leg=leg, d=d) for d in "xyz" if d != leg]

    def load(self, folder):
        """The plan, read from its file."""
        points = (f"  {n}: {{tcp_mm: {np.asarray(p).tolist()}}}" for n, p in self.points.items())
        text = (
            "robot: orthoglide\ncontroller: {offsets_mm: [0, 0, 0]}\n"
            "gauge: {sigma_mm: 0.005, resolution_mm: 0.01, range_mm: [-5, 5]}\n"
            f"postures:\n{chr(10).join(points)}\nsetups:\n{chr(10).join(self.setups)}\n"
        )
        folder.mkdir(exist_ok=True)
        (folder / "plan.yaml").write_text(text)
        return load_plan(folder / "plan.yaml")


def complete_plan(folder, *, tip=True):
    """A plan with every kind of artefact."""
    plan = Plan(tip=tip)
    plan.squares()
    plan.plates()
    plan.blocks()
    edge = (
        "kind: straightedge, along: x, length_mm: 150, straight_tolerance_mm: 0.01, reversed: true"
    )
    plan.read("edge", "-z", edge, [(v, 0, 0) for v in STEPS])
    return plan.load(folder)


def touch(machine, drives, tool, sensor, errors):
    """Reading by a ray along the plunger that ends on a plane, found from three of its points."""
    pose = frame_pose(machine, drives, tool)
    d = np.array(AXES[sensor.direction[-1]]) * (-1.0 if "-" in sensor.direction else 1.0)
    q = pose.translation + pose.rotation @ np.array(sensor.tool)
    a = sensor.artefact
    k = int(np.abs(d).argmax())
    along = np.array(AXES[a.along or "xyz"[(k + 1) % 3]])
    third = np.ones(3) - np.abs(d) - along
    turned_over = -1.0 if a.reversed else 1.0
    half = {"x": -0.5, "y": 0.5}
    order = "xyzx".find((a.along or "x") + sensor.direction[-1]) >= 0
    yaw = errors.get("yaw", 0.0)
    yaw += turned_over * half["x" if order else "y"] * errors.get("square", 0.0)
    turn = Rotation.from_rotvec(yaw * third) * Rotation.from_rotvec(errors.get("roll", 0.0) * along)
    lifted = np.zeros(3)
    if a.kind == "gauge_block" and pose.translation @ np.abs(d) > a.table + 0.5 * a.height:
        lifted = -d * (a.height + errors.get("height", 0.0))
    corners = [turn.apply(v) for v in (np.zeros(3), along, third)]
    # |q - h u - w corners| = 0 within the plane
    u = pose.rotation @ d
    system = np.column_stack([u, corners[1], corners[2]])
    # a block lifts the plane along its normal
    normal = turn.apply(d)
    at_zero = np.array(sensor.tool)  # the plane contains the tip in the mechanical zero
    h = np.linalg.solve(system, q - at_zero - normal * (normal @ (turn.apply(lifted))))[0]
    s, t = along @ q / (0.5 * a.length), third @ q / (0.5 * a.length)
    p2, p3 = np.polynomial.legendre.Legendre.basis(2), np.polynomial.legendre.Legendre.basis(3)
    forms = {
        "straight_2": p2(s),
        "straight_3": p3(s),
        "flat_20": p2(s),
        "flat_11": s * t,
        "flat_02": p2(t),
    }
    h += turned_over * sum(errors.get(name, 0.0) * f for name, f in forms.items())
    return (1.0 + errors.get("scale", 0.0)) * h


def test_readings_are_where_rays_meet_planes(tmp_path):
    plan = complete_plan(tmp_path)
    parameters = nuisance_parameters(plan).parameters
    rng = np.random.default_rng(5)
    nuisance = np.array([p.prior_std for p in parameters]) * rng.normal(size=len(parameters))
    named = dict(zip([p.name for p in parameters], nuisance, strict=True))
    found = predict_readings(plan, ERRORS, nuisance=nuisance)
    machine, tool = plan.robot.with_errors(ERRORS), plan.robot.tcp.frame
    of_setup = nuisance_parameters(plan).of_setup
    for row in range(0, len(plan.readings), 3):
        r = plan.readings[row]
        i = list(plan.setups).index(r.setup)
        errors = {list(named)[k].rpartition(".")[2]: nuisance[k] for k in of_setup[i]}
        sensor, drives = plan.setups[r.setup].sensor, plan.postures[r.posture].drives
        expected = touch(machine, drives, tool, sensor, errors)
        assert abs(found[row] - expected) < CLOSED_FORM, (r.setup, r.posture)


def test_a_tool_that_turns_reads_along_its_plunger(tmp_path):
    """The tool of this biglide turns with a rod, its frame is oblique, its zero off the origin."""
    folder = shutil.copytree(ROOT / "tests/robots/biglide", tmp_path / "biglide")
    urdf, place = folder / "biglide.urdf", 'xyz="0.1 0.05 0"'
    text = urdf.read_text().replace('xyz="-0.2 0 0"', 'xyz="-0.2 0 0" rpy="0 0 0.4"', 1)
    text = text.replace('<child link="x_slider"/>', f'<child link="x_slider"/> <origin {place}/>')
    urdf.write_text(text.replace("<origin rpy", f"<origin {place} rpy"))
    robot = load_robot(folder)
    zero = frame_pose(robot, robot.drive_zero, "x_tip")
    offsets = [(x, y) for x in (-30.0, 0.0, 30.0) for y in (0.0, 10.0)]
    points = [1e3 * zero.translation[:2] + offset for offset in offsets]
    postures = "".join(f"  p{i}: {{tcp_mm: {p.tolist()}}}\n" for i, p in enumerate(points))
    setups = "".join(
        f"  {kind}: {{sensor: tool_indicator, direction: {d}, tool_mm: [4, 0, 0], "
        f"artefact: {{kind: {kind}{more}}}}}\n"
        for kind, d, more in (("straightedge", "y", ", along: x"), ("plate", "-y", ""))
    )
    text = f"robot: {folder}\ngauge: {{sigma_mm: 0.005}}\n"
    (tmp_path / "plan.yaml").write_text(f"{text}postures:\n{postures}setups:\n{setups}")
    plan = load_plan(tmp_path / "plan.yaml")
    tip_at_zero, turned = zero.act(np.array([4e-3, 0.0, 0.0])), []
    for reading, found in zip(plan.readings, predict_readings(plan, {}), strict=True):
        normal = np.array([0.0, 1.0 if reading.setup == "straightedge" else -1.0, 0.0])
        pose = frame_pose(robot, plan.postures[reading.posture].drives, "x_tip")
        turn = pose.rotation @ zero.rotation.T
        distance = normal @ (pose.act(np.array([4e-3, 0.0, 0.0])) - tip_at_zero)
        turned.append(normal @ turn @ normal)
        assert abs(found - distance / turned[-1]) < CLOSED_FORM
    assert np.abs(zero.translation).max() > 0.05
    assert zero.rotation[0, 1] < -0.3
    assert min(turned) < 0.999


def test_arms_of_a_square_share_its_yaw_until_it_is_turned_over(tmp_path):
    plan = Plan()
    plan.squares()
    over = SQUARE.replace("granite", "granite_xy") + ", reversed: true"
    for along, across in ("xy", "yx"):
        points = [tuple(s * v for v in AXES[along]) for s in STEPS]
        plan.read(f"over_{along}", across, f"{over}, along: {along}", points)
    names = [p.name for p in nuisance_parameters(plan.load(tmp_path)).parameters]
    assert {n for n in names if "granite_xy" in n and "yaw" in n} == {
        "square.granite_xy.yaw",
        "square.granite_xy.reversed.yaw",
    }
    assert [n for n in names if n.endswith("granite_xy.square")] == ["square.granite_xy.square"]


def test_reversal_removes_the_error_of_the_square(tmp_path):
    """A square of 0.5 mrad is known to 0.02 after it was turned over: the reading of both."""
    loose = SQUARE.replace("square_tolerance_mrad: 0.02", "square_tolerance_mrad: 1")

    def errors(over):
        plan = Plan()
        for turned in (False, True)[: 1 + over]:
            for along, across in ("xy", "yx"):
                points = [tuple(s * v for v in AXES[along]) for s in STEPS]
                key = f"{loose}, along: {along}, reversed: {str(turned).lower()}"
                plan.read(f"{turned}_{along}", across, key, points)
        session = simulate_session(plan.load(tmp_path / str(over)), ERRORS, seed=2)
        result = identified(session.session)
        (found,) = (p for p in result.sensors if p.name == "square.granite.square")
        assert abs(found.value - session.nuisance[found.name]) < 4.0 * found.std
        return found.std

    alone, both = errors(over=False), errors(over=True)
    assert alone > 0.3e-3
    assert both < 0.15e-3


@pytest.mark.parametrize(
    ("parts", "design"),
    [(("squares",), 8.4), (("plates",), 11.1), (("blocks",), 14.6), (("squares", "blocks"), 7.1)],
)
def test_bounds_beside_the_papers_readings(tmp_path, orthoglide, parts, design):
    plan = Plan()
    plan.legs()
    for part in parts:
        getattr(plan, part)()
    found = bound_um(plan.load(tmp_path), cube(orthoglide, points_per_side=5))
    assert found == pytest.approx(design, rel=0.1)


@pytest.mark.slow
def test_tool_errors_and_intervals_of_machines_with_all_errors(tmp_path, orthoglide):
    """All errors at their priors; artefacts and mounting, too."""
    made = Plan()
    for part in (made.legs, made.squares, made.plates, made.blocks):
        part()
    space = cube(orthoglide, points_per_side=3)
    assert_promises(calibrate_machines(made.load(tmp_path), space, count=40))
