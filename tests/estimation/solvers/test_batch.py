"""Many sets of readings at once: each the optimum that it has alone."""

from __future__ import annotations

import numpy as np
import pytest
from gauges import exact
from tool_coordinate import ToolCoordinate

from orthocal import load_plan, load_session
from orthocal.estimation.loss import Loss
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.batch import BatchProgram
from orthocal.estimation.solvers.batch_adjoint import FleetSlopes
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.estimation.solvers.machine_readings import Fleet
from orthocal.estimation.solvers.second_order import find_curvature
from orthocal.estimation.solvers.variable_projection import EliminatedProgram
from orthocal.runtime import worker_pool as cores
from orthocal.sensors import registry

SIGMA = 10e-6
SETS = 60
SHOWN = 8
"""Sets that are solved alone too."""

AGREED = 1e-6
"""[tolerances]"""

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
  tx: {sensor: tool, tool: x, slope_tolerance: 0.002, dial: d, gauge: fine}
  ty: {sensor: tool, tool: y, slope_tolerance: 0.002, dial: d, gauge: fine}
  tz: {sensor: tool, tool: z, slope_tolerance: 0.003, gauge: fine}
  line: {leg: x, direction: y, section: {fraction: 0.5}, gauge: dial}
  rod: {leg: x, direction: z, section: {fraction: 0.4}, gauge: dial, touches: a,
    tip: {blade: {width_mm: 50, radius_mm: 0.5}}}
"""


def draw(problem, spread=0.4, sets=SETS):
    """Readings of machines with errors of so many tolerances."""
    rng = np.random.default_rng(3)
    fleet = Fleet(problem, spread * rng.normal(size=(sets, problem.n_free)))
    assert fleet.close().all()
    noise = SIGMA * rng.normal(size=(sets, problem.observations.size))
    return fleet.predict() + noise, fleet


@pytest.fixture
def several_sensors(tmp_path):
    """A problem with a rod's indicator, a line's, and one with unknowns of its own."""
    registry.register_sensor(ToolCoordinate)
    (tmp_path / "plan.yaml").write_text(SEVERAL_SENSORS)
    yield build_problem(load_plan(tmp_path / "plan.yaml"), model="full")
    registry._KINDS.pop(ToolCoordinate.kind)


@pytest.mark.parametrize("loss", ["squares", "huber"])
@pytest.mark.parametrize(
    "given",
    [
        {},
        {"prior": True},
        {"bounds": {"x_slide.offset": (-1e-3, 1e-3)}},
        {"known": {"y_slide.offset": (0.1e-3, 0.05e-3)}},
    ],
    ids=["plain", "prior", "bounds", "known"],
)
def test_each_set_has_the_optimum_that_it_has_alone(root, loss, given):
    session = exact(load_session(root / "examples/table1/experiment-2"))
    problem = build_problem(session, model="offsets", **given)
    options = SolverOptions(loss=Loss(loss))
    values, _ = draw(problem)
    found = BatchProgram(problem, options=options).solve(values, sigma=SIGMA)
    assert "bounds" in given or not found.alone.any()
    # far beyond its bounds Ipopt does not find the optimum of a robust loss
    ipopts = 0 if "bounds" in given and loss == "huber" else 2
    for kind, few in ((EliminatedProgram, SHOWN), (NonlinearProgram, ipopts)):
        program = kind(problem, options=options)
        for i in range(few):
            alone = program.solve(sigma=SIGMA, values=values[i])
            apart = np.abs(alone.theta - found.theta[i]) / problem.theta_scale
            assert apart.max() < AGREED
            assert np.abs(alone.zeros - found.zeros[i]).max() < 1e-8
            assert found.objective[i] == pytest.approx(alone.objective, rel=1e-6, abs=1e-7)
            assert (found.at_bound[i] == alone.at_bound).all()
    if "bounds" in given:
        assert found.at_bound.any()


@pytest.fixture(scope="module")
def sweep(root):
    return build_problem(exact(load_session(root / "examples/sweep")), model="full")


@pytest.mark.parametrize("loss", ["squares", "huber"])
def test_many_parameters_are_solved_by_the_curvature_they_share(sweep, loss):
    options = SolverOptions(loss=Loss(loss))
    values, _ = draw(sweep, spread=1.0, sets=100)
    values[:, 3] += 40e-6  # an outlier
    found = BatchProgram(sweep, options=options).solve(values, sigma=SIGMA)
    assert not found.alone.any()
    program = EliminatedProgram(sweep, options=options)
    for i in range(SHOWN // 2):
        alone = program.solve(sigma=SIGMA, values=values[i])
        assert np.abs((alone.theta - found.theta[i]) / sweep.theta_scale).max() < AGREED
        assert np.abs(alone.zeros - found.zeros[i]).max() < 1e-9
        assert found.objective[i] == pytest.approx(alone.objective, rel=1e-8)
    if loss == "squares":
        alone = NonlinearProgram(sweep, options=options).solve(sigma=SIGMA, values=values[0])
        assert np.abs((alone.theta - found.theta[0]) / sweep.theta_scale).max() < AGREED


def test_a_bound_or_a_machine_far_off_is_solved_alone(root):
    bounds = {"x_slide.offset": (-1e-3, 1e-3)}
    session = exact(load_session(root / "examples/sweep"))
    problem = build_problem(session, model="full", bounds=bounds)
    values, fleet = draw(problem, spread=0.4, sets=100)
    values[3] += 2e-3 * np.sin(np.arange(values.shape[1]))  # hardly a machine reads like this
    found = BatchProgram(problem).solve(values, sigma=SIGMA)
    held = np.abs(fleet.theta[:, 0] * problem.theta_scale[0]) > 1.2e-3
    assert held.any()
    assert found.alone[held].all()
    assert not found.alone.all()
    assert (found.at_bound[held, 0] != 0).all()
    program = EliminatedProgram(problem)
    for i in (3, int(np.flatnonzero(held)[0]), int(np.flatnonzero(~found.alone)[0])):
        alone = program.solve(sigma=SIGMA, values=values[i])
        assert np.abs((alone.theta - found.theta[i]) / problem.theta_scale).max() < AGREED


def test_a_few_sets_are_solved_one_by_one(sweep):
    values, _ = draw(sweep, spread=0.1)
    found = BatchProgram(sweep).solve(values[:2], sigma=SIGMA)
    alone = EliminatedProgram(sweep).solve(sigma=SIGMA, values=values[1])
    assert np.abs(alone.theta - found.theta[1]).max() < 1e-9
    assert found.alone.all()


@pytest.mark.parametrize("read", ["sweep", "several_sensors"])
def test_slopes_of_a_fleet_are_those_of_each_machine(read, request):
    problem = request.getfixturevalue(read)
    rng = np.random.default_rng(1)
    theta = 0.5 * rng.normal(size=(3, problem.n_free))
    passive = np.array([problem.close(t * problem.theta_scale) for t in theta])
    passive += 1e-5 * rng.normal(size=passive.shape)
    forces = rng.normal(size=(3, problem.observations.size))
    change = 1e-3 * rng.normal(size=theta.shape)
    slopes = FleetSlopes(problem, theta, passive)
    pulls, follows = slopes.pull(forces), slopes.follow(change)
    for i in range(3):
        alone = problem.expand(theta[i] * problem.theta_scale, passive[i])
        expected = forces[i] @ alone.jacobian
        assert np.abs(pulls[i] - expected).max() < 1e-12 * np.abs(expected).max()
        assert np.abs(follows[i] - alone.follow(change[i])).max() < 1e-14
        assert np.abs(slopes.reading[i] - alone.reading - alone.opening).max() < 1e-14


def test_curved_readings_leave_the_third_order(sweep):
    curved = find_curvature(sweep)
    rng = np.random.default_rng(2)
    direction = rng.normal(size=(1, sweep.n_free))
    left = []
    for size in (0.5, 0.25):
        fleet = Fleet(sweep, curved.reference + size * direction)
        assert fleet.close().all()
        reading, jacobian = curved(fleet.theta)
        exact = sweep.expand(fleet.theta[0] * sweep.theta_scale, fleet.passive[0]).jacobian
        left.append((np.abs(reading - fleet.predict()).max(), np.abs(jacobian - exact).max()))
    (reading, slope), (reading_half, slope_half) = left
    assert 7.0 < reading / reading_half < 9.0
    assert 3.5 < slope / slope_half < 4.5


def test_curvature_is_the_same_from_any_number_of_processes(sweep, monkeypatch):
    monkeypatch.setattr(cores, "can_fork", lambda: True)
    alone = find_curvature(sweep)
    with cores.worker_budget(3):
        together = find_curvature(sweep)
    assert np.array_equal(together.curvature, alone.curvature)


def test_a_set_far_from_the_others_is_solved_alone(root):
    session = exact(load_session(root / "examples/table1/experiment-2"))
    problem = build_problem(session, model="offsets")
    values, _ = draw(problem, spread=0.01)
    values = np.tile(values, (40, 1))
    far = Fleet(problem, np.full((1, 3), 2.0))
    assert far.close().all()
    values[7] = far.predict()[0]
    found = BatchProgram(problem).solve(values, sigma=SIGMA)
    assert np.flatnonzero(found.alone).tolist() == [7]
    assert np.abs(found.theta[7] / problem.theta_scale - 2.0).max() < AGREED


def test_rows_of_the_session_are_readings_too(root):
    session = exact(load_session(root / "examples/table1/experiment-2"))
    problem = build_problem(session, model="offsets")
    rows = np.tile(session.values, (3, 1))
    found = BatchProgram(problem).solve(rows, sigma=SIGMA)
    alone = EliminatedProgram(problem).solve(sigma=SIGMA)
    assert np.abs(found.theta - alone.theta).max() < 1e-12
    with pytest.raises(ValueError, match="expected"):
        BatchProgram(problem).solve(rows[:, 1:], sigma=SIGMA)


def test_a_fleet_shows_what_each_of_its_machines_does(root):
    problem = build_problem(exact(load_session(root / "examples/sweep")), model="full")
    values, fleet = draw(problem, spread=0.3)
    for i in (0, SETS - 1):
        expected = problem.predict(fleet.theta[i] * problem.theta_scale)
        assert np.abs(fleet.predict()[i] - expected).max() < 1e-11
    assert values.shape == (SETS, problem.observations.size)
