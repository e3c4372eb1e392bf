"""The observation model: batches against single machines, derivatives against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrated import plan_of, session_of
from derivatives import assert_jacobian
from gauges import exact
from tool_coordinate import ToolCoordinate

from orthocal import load_plan
from orthocal.estimation.problem import build_problem
from orthocal.observation.model import predict_readings
from orthocal.sensors import registry

SEVERAL_SENSORS = """robot: orthoglide
title: tool, a line and a rod
gauges:
  fine: {sigma_mm: 0.002, range_mm: [-200, 200]}
  dial: {sigma_mm: 0.01, resolution_mm: 0.01}
postures:
  zero: {tcp_mm: [0, 0, 0]}
  x_max: {tcp_mm: [60, 0, 0]}
  x_min: {tcp_mm: [-100, 0, 0]}
  corner: {tcp_mm: [50, -40, 30]}
setups:
  tx: {sensor: tool, tool: x, slope_tolerance: 0.004, dial: d, gauge: fine}
  ty: {sensor: tool, tool: y, slope_tolerance: 0.004, dial: d, gauge: fine}
  tz: {sensor: tool, tool: z, slope_tolerance: 0.006, gauge: fine}
  line: {leg: x, direction: y, section: {fraction: 0.5}, gauge: dial}
  rod: {leg: x, direction: z, section: {fraction: 0.4}, gauge: dial, touches: a,
    tip: {blade: {width_mm: 50, radius_mm: 0.5}}}
"""

TOOL_SENSORS = """robot: orthoglide
controller: {offsets_mm: [0, 0, 0]}
gauge: {sigma_mm: 0.005, range_mm: [-9, 9]}
postures:
  zero: {tcp_mm: [0, 0, 0]}
  x_max: {tcp_mm: [60, 10, 0]}
  y_max: {tcp_mm: [0, 60, -20]}
  corner: {tcp_mm: [50, -40, 30]}
setups:
  bar: {sensor: ball_bar, centre_mm: [0, 0, -80], length_mm: 80, length_tolerance_mm: 1,
    tool_mm: [3, -2, -40]}
  arm: {sensor: tool_indicator, direction: y, tool_mm: [3, -2, -40], artefact: {kind: square,
    name: s, along: x, straight_tolerance_mm: 0.01, square_tolerance_mrad: 0.5}}
  plate: {sensor: tool_indicator, direction: -z, artefact: {kind: plate, flat_tolerance_mm: 0.01}}
  bed: {sensor: probe, direction: -z, surface: {flat_tolerance_mm: 0.3, length_mm: 200}}
  edge: {sensor: tool_indicator, direction: -z, tool_mm: [3, -2, -40], artefact:
    {kind: straightedge, along: x, length_mm: 150, straight_tolerance_mm: 0.01, reversed: true}}
  block: {sensor: tool_indicator, direction: -x, tool_mm: [3, -2, -40], artefact:
    {kind: gauge_block, height_mm: 50, height_tolerance_mm: 0.005, table_mm: 15}}
  track: {sensor: points, target_mm: [3, -4, -40], frame: {tolerance_mm: 2, tolerance_mrad: 10},
    scale_tolerance: 0.001, covariance_um2: [[90, 40, -10], [40, 60, 5], [-10, 5, 400]]}
"""

STATION = {"position": (0.21, -0.34, 0.07), "rotation": (0.3, -1.1, 0.5)}
"""Position [m] and rotation vector of a tracker in the world."""


def move_station(plan):
    """The plan with its tracker at `STATION`."""
    setups = {
        n: replace(s, sensor=replace(s.sensor, **STATION)) if s.sensor.kind == "points" else s
        for n, s in plan.setups.items()
    }
    return replace(plan, setups=setups)


@pytest.fixture(params=["sweep", "workshop", "tool", "several sensors"])
def problem(request, tmp_path):
    """Lines, balls aligned by eye, sensors at the tool, and three kinds with different noise."""
    if request.param == "sweep":
        yield build_problem(exact(session_of("sweep")), model="full")
    elif request.param == "workshop":
        yield build_problem(plan_of("workshop"), model="full")
    elif request.param == "tool":
        (tmp_path / "plan.yaml").write_text(TOOL_SENSORS)
        yield build_problem(move_station(load_plan(tmp_path / "plan.yaml")), model="full")
    else:
        registry.register_sensor(ToolCoordinate)
        (tmp_path / "plan.yaml").write_text(SEVERAL_SENSORS)
        ratio = np.random.default_rng(0).uniform(0.5, 2.0, 20)
        yield build_problem(load_plan(tmp_path / "plan.yaml"), model="full").with_noise_ratio(ratio)
        registry.unregister_sensor(ToolCoordinate.kind)


def draw(problem, count=3, size=0.5):
    """Parameters of machines, and passive coordinates near closed loops."""
    rng = np.random.default_rng(1)
    theta = size * rng.normal(size=(count, problem.n_free)) * problem.theta_scale
    readings, passive, reached = problem.simulate(theta)
    assert reached.all()
    return theta, readings, passive, rng


def test_a_batch_equals_its_machines_one_by_one(problem):
    theta, readings, passive, rng = draw(problem)
    near = passive + 1e-5 * rng.normal(size=passive.shape)
    linear = problem.linearise(theta, near)
    change = 1e-3 * rng.normal(size=theta.shape)
    follow = linear.follow(change)
    for i, own in enumerate(theta):
        assert np.abs(problem.close(own) - passive[i]).max() < 1e-12
        assert np.abs(problem.predict(own) - readings[i]).max() < 1e-12
        alone = problem.linearise(own, near[i])
        assert np.abs(linear.reading[i] - alone.reading).max() < 1e-15
        assert np.abs(linear.opening[i] - alone.opening).max() < 1e-15
        scale = np.abs(alone.jacobian).max()
        assert np.abs(linear.jacobian[i] - alone.jacobian).max() < 1e-12 * scale
        assert np.abs(follow[i] - alone.follow(change[i])).max() < 1e-14


def test_simulation_and_problem_predict_the_same_readings(problem):
    theta, readings, _, _ = draw(problem, count=1)
    own, n = theta[0], problem.n_machine
    errors = dict(zip(problem.free[:n], own[:n].tolist(), strict=True))
    nuisance = own[n:] if own.size > n else None
    alone = predict_readings(problem.session, errors, nuisance=nuisance) / problem.noise_ratio
    assert np.abs(readings[0] - alone).max() < 1e-12
    reading, _ = problem.predict_and_jacobian(own)
    assert np.abs(reading - alone).max() < 1e-12


def test_the_jacobian_is_that_of_central_differences(problem):
    theta, _, passive, _ = draw(problem, count=1)
    reading, jacobian = problem.predict_and_jacobian(theta, passive)
    assert_jacobian(problem, theta[0], jacobian[0], least=1e-3)
    si_reading, si = problem.predict_and_jacobian(theta, passive, units="SI")
    assert np.array_equal(si_reading, reading)
    assert np.allclose(si * problem.theta_scale, jacobian, rtol=1e-14, atol=0.0)


def test_opening_and_follow_close_the_loops_to_first_order(problem):
    theta, _, passive, rng = draw(problem, count=1)
    for size in (1e-4, 1e-5):
        near = passive + size * rng.normal(size=passive.shape)
        linear = problem.linearise(theta, near)
        left = np.abs(near + linear.correction - passive).max()
        assert left < 100.0 * size**2
        predicted = linear.reading + linear.opening - problem.predict(theta, passive)
        assert np.abs(predicted).max() < 100.0 * size**2
    change = 1e-4 * rng.normal(size=theta.shape)
    follow = problem.linearise(theta, passive).follow(change)[0]
    closed = problem.close(theta[0] + change[0] * problem.theta_scale)
    assert np.abs(passive[0] + follow - closed).max() < 1e-9


def test_a_machine_out_of_reach_spoils_no_other():
    problem = build_problem(exact(session_of("sweep")), model="offsets")
    theta = np.array([[1e-3, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 1e-3]])
    readings, passive, reached = problem.simulate(theta)
    assert reached.tolist() == [True, False, True]
    assert np.isnan(passive[1]).any()
    for i in (0, 2):
        assert np.abs(readings[i] - problem.predict(theta[i])).max() < 1e-12
