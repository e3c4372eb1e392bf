"""Ball bars: readings against Pinocchio and plain distances, bounds, machines with all errors."""

from __future__ import annotations

import json

import numpy as np
import pytest
from ball_bar_plans import RADIUS_MM, circles
from bounds import bound_um
from calibrated import identified
from machines import frame_pose
from sensor_machines import assert_promises, calibrate_machines
from tolerances import CLOSED_FORM

from orthocal import Choice, SolverOptions, draw_errors, load_plan
from orthocal.calibration.identify import identify
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.workspace import cube
from orthocal.observation.model import predict_readings
from orthocal.observation.sensor_groups import nuisance_parameters
from orthocal.observation.simulate import simulate_session
from orthocal.output.text.layout import to_text
from orthocal.output.text.tables import render_sensors
from orthocal.sensors.ball_bar import SAGITTA, BallBar
from orthocal.units import MM

ERRORS = {"x_slide.offset": 0.7e-3, "y_slide.offset": -0.4e-3, "z_swivel.rx": 1.5e-3}


def test_readings_are_distances_between_the_balls(tmp_path):
    """Machine by Pinocchio; errors of the fixed ball, the length, the scale; ball off the tool."""
    plan = circles(tmp_path, tool=(4, -3, -40))
    names = [p.name for p in nuisance_parameters(plan).parameters]
    assert names == [
        *(f"ball.post.centre_{k}" for k in "xyz"),
        *("gauge.bar." + n for n in ("length", "scale")),
    ]
    nuisance = np.array([0.9e-3, -0.5e-3, 0.3e-3, 0.6e-3, 1.5e-3])
    found = predict_readings(plan, ERRORS, nuisance=nuisance)
    machine = plan.robot.with_errors(ERRORS)
    tool = plan.robot.tcp.frame
    for row in range(0, len(plan.readings), 7):
        drives = plan.postures[plan.readings[row].posture].drives
        ball = frame_pose(machine, drives, tool).act(np.array([4e-3, -3e-3, -40e-3]))
        distance = np.sqrt(((ball - [4e-3, -3e-3, -40e-3] - nuisance[:3]) ** 2).sum())
        expected = (1.0 + nuisance[4]) * (distance - RADIUS_MM * 1e-3 - nuisance[3])
        assert abs(found[row] - expected) < CLOSED_FORM


@pytest.mark.parametrize(
    ("length", "zero", "published"),
    [("unknown", "known", 5.5), ("0", "known", 4.5), ("0", "free", 5.5)],
)
def test_bounds_beside_the_papers_readings(tmp_path, orthoglide, length, zero, published):
    space = cube(orthoglide, points_per_side=5)
    found = bound_um(circles(tmp_path, length=length, zero=zero, legs=True), space)
    assert found == pytest.approx(published, rel=0.10)


def test_no_gauge_counts_as_finer_than_stated(tmp_path):
    plan = circles(tmp_path, legs=True)
    errors = draw_errors(plan.robot, ["*"], seed=3, tolerances={"*.offset_mm": 1.0})
    session = simulate_session(plan, errors, seed=3).session
    found, _ = identify(session, "full", solver=SolverOptions(solver="variable-projection"))
    assert found.solver.noise_converged
    for gauge in found.gauges:
        rounding = (gauge.resolution or 0.0) / np.sqrt(12.0)
        assert gauge.noise.sigma > 0.9999 * np.hypot(gauge.sigma, rounding)


@pytest.mark.slow
def test_tool_errors_and_intervals_of_machines_with_all_errors(tmp_path, orthoglide):
    """All errors at their priors, readings by plain distances in closed loops. They determine 11
    axes of each machine."""
    plan = circles(tmp_path)
    names = plan.robot.parameters.select_model("full")
    closure = LoopClosure(plan.robot, free=names)
    commanded = np.array([plan.postures[r.posture].drives for r in plan.readings])

    def read(truth):
        balls = closure.forward(commanded, theta=truth[:, : len(names)])
        centre, (length, scale) = truth[:, None, len(names) : -2], truth[:, -2:].T[:, :, None]
        return (1.0 + scale) * (np.linalg.norm(balls - centre, axis=2) - RADIUS_MM * MM - length)

    space = cube(orthoglide, points_per_side=3)
    assert_promises(calibrate_machines(plan, space, count=40, read=read))


def test_the_printed_length_is_that_of_the_bar(tmp_path):
    """The stated length with its estimated error, which two sessions share."""
    plan = circles(tmp_path, legs=True)
    sessions = [simulate_session(plan, ERRORS, seed=s).session for s in (3, 4)]
    calibration = identified(sessions, "offsets")
    (error,) = [p.value for p in calibration.sensors if p.name == "gauge.bar.length"]
    rows = [line.split() for line in to_text(render_sensors(calibration)).splitlines()]
    (row,) = [r for r in rows if r[:1] == ["gauge.bar.length"]]
    assert float(row[1]) == pytest.approx(RADIUS_MM + error / MM, abs=6e-4)


def test_noise_of_two_gauges_is_found_on_a_machine_far_from_its_nominal_one(tmp_path):
    """Offsets of 7 mm bend the readings of a bar by far more than its noise."""
    heights, ring = (40.0, 55.0, 70.0, 100.0), 2.0 * np.pi * np.arange(10) / 10
    arms = {f"bar_{k}": np.sqrt(50.0**2 - (z - 70.0) ** 2) for k, z in enumerate(heights)}
    points = {
        f"{name}_{k}": [float(r * np.cos(a)), float(r * np.sin(a)), z]
        for (name, r), z in zip(arms.items(), heights, strict=True)
        for k, a in enumerate(ring)
    }
    points |= {"low": [50.0, -50.0, -100.0], "side": [-100.0, 0.0, -50.0]}
    keys = {"sensor": "ball_bar", "centre_mm": [0, 0, 70], "centre_tolerance_mm": 2, "ball": "post"}
    keys |= {"length_mm": 50, "length_tolerance_mm": "unknown", "gauge": "bar"}
    setups = {n: {**keys, "postures": [p for p in points if p.startswith(n)]} for n in arms}
    leg = {
        "leg": "b",
        "direction": [0.5, 0.75**0.5, 0],
        "section": {"fraction": 0.5},
        "gauge": "dial",
    }
    gauges = {"dial": {"sigma_mm": 0.005, "resolution_mm": 0.01, "range_mm": [-25, 25]}}
    gauges["bar"] = {"sigma_mm": 0.002, "range_mm": [-25, 25]}
    plan = {
        "robot": "linear_delta",
        "gauges": gauges,
        "postures": {name: {"tcp_mm": point} for name, point in points.items()},
        "setups": {"leg": leg | {"postures": ["low", "side"]}, **setups},
    }
    (tmp_path / "plan.yaml").write_text(json.dumps(plan))
    errors = {"a_slide.offset": 6e-3, "b_slide.offset": -7e-3, "c_slide.offset": 3e-3}
    session = simulate_session(load_plan(tmp_path / "plan.yaml"), errors, seed=1).session
    found = identified(session)
    assert found.noise.source == "gauge"
    assert found.noise.sigma == pytest.approx(np.hypot(5e-6, 1e-5 / np.sqrt(12.0)))


@pytest.mark.parametrize(("legs", "seed", "count"), [(False, 1, 8), (True, 3, 11)])
def test_base_parameters_beside_an_unknown_ball_are_the_recorded_ones(tmp_path, legs, seed, count):
    """A ball and a length that are unknown leave eight sums of errors, not twelve.

    The residuals show the noise of both gauges of the third session.
    """
    plan = circles(tmp_path, legs=legs)
    errors = draw_errors(plan.robot, ["*"], seed=seed, tolerances={"*.offset_mm": 1.0})
    session = simulate_session(plan, errors, seed=seed).session
    found = identified(session, Choice("full", base=True))
    recorded = {combination.terms[0][0] for combination in found.identifiability.base}
    assert {p.name for p in found.free} == recorded
    assert len(recorded) == count
    assert all(p.std < p.prior_std for p in found.free)


@pytest.mark.parametrize("height", [0.0, 0.02])
@pytest.mark.parametrize("angle", [40.0, 180.0])
def test_a_tool_that_moves_in_a_plane_stays_in_it(height, angle):
    """An arc of the angle about the foot of the fixed ball, also to the opposite side."""
    bar = BallBar((0.01, 0.02, 0.03 - height), 0.05)
    foot, radius = np.array([0.01, 0.02, 0.03]), np.sqrt(0.05**2 - height**2)
    ends = [
        foot + radius * np.array([np.cos(a), np.sin(a), 0.0]) for a in np.deg2rad([15, 15 + angle])
    ]
    corners = bar.path(*ends, np.eye(3)[2])
    np.testing.assert_allclose(corners[[0, -1]], ends, atol=CLOSED_FORM)
    np.testing.assert_allclose(corners[:, 2], 0.03, atol=CLOSED_FORM)
    np.testing.assert_allclose(np.linalg.norm(corners - bar.centre, axis=1), 0.05, atol=CLOSED_FORM)
    length = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
    assert length == pytest.approx(radius * np.deg2rad(angle), rel=1e-3)


@pytest.mark.parametrize("plane", [False, True])
def test_a_path_above_a_bed_is_nowhere_lower_than_its_ends(plane):
    """The great arc between both leads through the lowest point of the sphere."""
    bar = BallBar((0.01, 0.02, 0.03), 0.05)
    low, side = -0.6, 0.8
    ends = [bar.centre + 0.05 * np.array([s * side, 0.0, low]) for s in (1.0, -1.0)]
    normal = [np.eye(3)[1]] if plane else []
    assert bar.path(*ends, *normal)[:, 2].min() == pytest.approx(0.03 - 0.05, abs=1e-5)
    corners = bar.path(*ends, *normal, above=True)
    np.testing.assert_allclose(corners[[0, -1]], ends, atol=CLOSED_FORM)
    assert corners[:, 2].min() > -CLOSED_FORM
    if plane:
        np.testing.assert_allclose(corners[:, 1], 0.02, atol=CLOSED_FORM)
    else:
        np.testing.assert_allclose(corners[:, 2], 0.0, atol=CLOSED_FORM)
    np.testing.assert_allclose(np.linalg.norm(corners - bar.centre, axis=1), 0.05, atol=CLOSED_FORM)
    chords = corners[1:] + corners[:-1]
    assert np.linalg.norm(0.5 * chords - bar.centre, axis=1).min() > 0.05 - 2.0 * SAGITTA
