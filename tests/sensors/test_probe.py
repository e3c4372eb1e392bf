"""A probe on the bed of a linear delta: planes, a printer that was published, machines with errors.

The seven triggers are of a printer with rods of 280 mm, from the public NixOS configuration of the
GitHub user gianarb, together with what Klipper's `DELTA_CALIBRATE` saved: delta radius, angles of
two towers, and endstops. Facts; read in November 2026.
"""

from __future__ import annotations

import numpy as np
import pytest
import simulated_printer
from calibrated import identified
from intervals import assert_coverage, recorded_scores
from machines import frame_pose
from scipy.spatial.transform import Rotation
from sensor_machines import assert_promises, calibrate_machines
from tolerances import CLOSED_FORM

from orthocal import Choice, draw_errors, load_plan, load_session, simulate_session
from orthocal.builder.linear_delta import LinearDelta
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.workspace import cube
from orthocal.observation.model import predict_readings
from orthocal.observation.sensor_groups import nuisance_parameters
from orthocal.units import MM

STEP_MM = 0.01
TRIGGERS = (
    (35612.667, 35612.667, 35612.667),
    (41651.333, 41651.333, 32050.333),
    (34755.667, 45279.667, 34755.667),
    (32169.333, 40578.0, 40578.0),
    (34586.333, 34586.333, 42096.333),
    (39715.0, 32422.333, 39715.0),
    (43607.0, 34688.0, 34688.0),
)
"""Steps of the carriages a, b and c below their endstops where the probe triggered."""

PROBE_MM = 17.197
"""Height of the nozzle where it triggered."""

ENDSTOPS_MM = (372.971746, 373.433577, 373.629930)
RADIUS_MM, ANGLES_DEG = 141.553523, (210.181908, 329.784204)
KLIPPER_MM, KLIPPER_DEG = 1e-3, 5e-4


@pytest.fixture(scope="module")
def printer(tmp_path_factory):
    """Directory of a printer with rods of 280 mm and a radius of 140 mm."""
    folder = tmp_path_factory.mktemp("printer") / "printer"
    folder.mkdir()
    delta = LinearDelta(travel=(0.02, 0.75))
    (folder / "printer.urdf").write_text(delta.urdf("printer"))
    (folder / "printer.yaml").write_text(delta.yaml())
    return folder


def bed(folder, printer, postures, *, surface="plane", keys="", readings=None):
    """Session with a probe over a bed; a plan without readings."""
    names = [f"p{i}" for i in range(len(postures))]
    lines = [
        f"robot: {printer}",
        "gauge: {sigma_mm: 0.01, range_mm: [-30, 30]}",
        "controller: {offsets_mm: [0, 0, 0]}",
        "postures:",
        *(f"  {n}: {p}" for n, p in zip(names, postures, strict=True)),
        f"setups:\n  bed: {{sensor: probe, surface: {surface}{keys}}}",
    ]
    folder.mkdir(exist_ok=True)
    if readings is not None:
        lines.append("readings: readings.csv")
        rows = [f"bed,{n},{r:.6f}" for n, r in zip(names, readings, strict=True)]
        (folder / "readings.csv").write_text("\n".join(["setup,posture,reading_mm", *rows]) + "\n")
    (folder / "session.yaml").write_text("\n".join(lines) + "\n")
    return folder


def rings():
    """41 points on the bed."""
    return [f"{{tcp_mm: [{x:.3f}, {y:.3f}, 0]}}" for x, y in simulated_printer.rings()]


def test_readings_are_heights_of_the_tip_above_the_surface(tmp_path, printer):
    surface = "{flat_tolerance_mm: 0.1, length_mm: 160}"
    folder = bed(tmp_path, printer, rings()[::8], surface=surface, keys=", tool_mm: [3, -2, -15]")
    plan = load_plan(folder)
    names = [p.name.rpartition(".")[2] for p in nuisance_parameters(plan).parameters]
    rng = np.random.default_rng(2)
    stds = np.array([p.prior_std for p in nuisance_parameters(plan).parameters])
    nuisance = stds * rng.normal(size=len(names))
    value = dict(zip(names, nuisance, strict=True))
    errors = {"a_slide.offset": 0.8e-3, "radius": 1.2e-3, "b_slide.ry": 3e-3}
    found = predict_readings(plan, errors, nuisance=nuisance)
    machine = plan.robot.with_errors(errors)
    turn = Rotation.from_rotvec([0.0, value["yaw"], 0.0])
    normal = (turn * Rotation.from_rotvec([value["roll"], 0.0, 0.0])).apply([0.0, 0.0, -1.0])
    legendre = np.polynomial.legendre.Legendre.basis
    for row, reading in enumerate(plan.readings):
        pose = frame_pose(machine, plan.postures[reading.posture].drives, "tcp")
        tip = pose.act(np.array([3e-3, -2e-3, -15e-3]))
        height = -(normal @ tip) / (normal @ pose.rotation @ [0.0, 0.0, -1.0])
        for name in names:
            if name.startswith("flat"):
                i, j = int(name[-2]), int(name[-1])
                height -= value[name] * legendre(i)(tip[0] / 0.08) * legendre(j)(tip[1] / 0.08)
        assert abs(found[row] - height + value["trigger"]) < CLOSED_FORM


def test_a_reading_is_the_coordinate_of_the_posture_minus_that_at_the_trigger(tmp_path, printer):
    """If all slides move down by the same distance, so does the tool; with a leaning one nearly."""
    plan = load_plan(bed(tmp_path, printer, rings()[::8]))
    errors = {"a_slide.offset": 0.8e-3, "radius": 1.2e-3, "b_slide.ry": 3e-3, "c_slide.scale": 2e-4}
    machine = plan.robot.with_errors(errors)
    expected = predict_readings(plan, errors, nuisance=np.zeros(2 + 1))
    for row, reading in enumerate(plan.readings):
        commanded = plan.postures[reading.posture].drives
        lowered = 0.0
        for _ in range(5):
            lowered += frame_pose(machine, commanded - lowered, "tcp").translation[2]
        assert abs(lowered) > 0.1e-3
        assert expected[row] == pytest.approx(lowered, rel=1e-3)
    above, rule = plan.setups["bed"].sensor.mounting_steps
    assert "begin 10 mm before the surface" in above
    assert "the coordinate z, that of the posture minus that at the trigger" in rule


def published(folder, printer):
    """Session of the published triggers."""
    middle = ENDSTOPS_MM[0] + np.sqrt(280.0**2 - 140.0**2)
    heights = middle - STEP_MM * np.array(TRIGGERS)
    postures = [f"{{joints_mm: {[round(float(v), 6) for v in row]}}}" for row in heights]
    keys = f", direction_tolerance_mrad: 0, trigger_tolerance_mm: 0, tool_mm: [0, 0, -{PROBE_MM}]"
    return load_session(bed(folder, printer, postures, keys=keys, readings=np.zeros(7)))


SIX = ["radius", "a_tower.tangential", "b_tower.tangential", "*.offset"]


def test_parameters_of_klipper_from_its_triggers(tmp_path, printer):
    """Six parameters without priors, as Klipper's search has them.

    It prints six decimals. The readings leave a millimetre of radius, and with all errors of a
    printer they improve the offsets by half at most.
    """
    session = published(tmp_path, printer)
    free = identified(session, Choice(free=SIX, prior=False))
    value = {p.name: p.value / MM for p in free.free}
    radius = 140.0 + value["radius"]
    assert radius == pytest.approx(RADIUS_MM, abs=KLIPPER_MM)
    for name, angle, expected in zip("ab", (210.0, 330.0), ANGLES_DEG, strict=True):
        turned = angle + np.degrees(value[f"{name}_tower.tangential"] / radius)
        assert turned == pytest.approx(expected, abs=KLIPPER_DEG)
    offsets = np.array([value[f"{k}_slide.offset"] for k in "abc"])
    apart = np.array(ENDSTOPS_MM) - ENDSTOPS_MM[0]
    assert offsets - offsets[0] == pytest.approx(apart, abs=KLIPPER_MM)
    assert free["radius"].std > 0.5e-3
    complete = identified(session)
    shares = {p.name: p.std / p.prior_std for p in complete.free if p.name.endswith(".offset")}
    assert min(shares.values()) > 0.4


def test_heights_of_printers_with_all_errors(tmp_path, printer):
    """Heights of the bed over 41 points after the calibration; coverage of the record's intervals.

    The readings determine 10 axes of each printer, too few here: that is the next test's part.
    """
    plan = load_plan(bed(tmp_path, printer, rings()))
    robot = plan.robot
    names = robot.parameters.select_model("full")
    drives = np.array([plan.postures[r.posture].drives for r in plan.readings])
    scores = []
    for seed in range(10):
        errors = draw_errors(robot, names, seed=seed)
        session = simulate_session(plan, errors, seed=seed).session
        result = identified(session)
        scores.append(recorded_scores(result, errors)[0])
        truth = LoopClosure(robot, free=names).forward(
            drives, theta=np.array([errors[n] for n in names])
        )
        fitted = np.array([result[n].value for n in names])
        missed = truth[:, 2] - LoopClosure(robot, free=names).forward(drives, theta=fitted)[:, 2]
        plane = np.column_stack([np.ones(len(truth)), truth[:, :2]])
        missed -= plane @ np.linalg.lstsq(plane, missed, rcond=None)[0]
        assert np.sqrt(np.mean(missed**2)) < 0.01 * MM
    assert_coverage(scores)


@pytest.mark.slow
def test_tool_errors_and_intervals_of_printers_with_all_errors(tmp_path, printer):
    """The tool error is ten times that of other sensors: a bed does not show the scale."""
    plan = load_plan(bed(tmp_path, printer, rings()))
    space = cube(plan.robot, points_per_side=3)
    outcome = calibrate_machines(plan, space, count=45)
    assert_promises(outcome)
    assert outcome.bound == pytest.approx(outcome.predicted, rel=0.05)
