"""A sensor of another package, in one file."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from calibrated import UNJUDGED, identified
from conftest import marked_plots
from gauges import exact
from intervals import recorded_scores
from scipy.stats import chi2
from tolerances import SAME_OPTIMUM
from tool_coordinate import ToolCoordinate

from orthocal import (
    SolverOptions,
    calibrate,
    draw_scene,
    load_calibration,
    load_plan,
    simulate_session,
    summarize,
)
from orthocal.calibration import build_record
from orthocal.calibration.file import calibration_json, write_calibration
from orthocal.errors import OrthocalError, SessionError
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.estimation.solvers.variable_projection import VariableProjection
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.measurement.files.session_file import load_session
from orthocal.measurement.files.write_session import write_session
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import build_observations
from orthocal.observation.simulate import draw_errors
from orthocal.output.report.page import build_report
from orthocal.runtime.disk_cache import cache_folder
from orthocal.sensors import registry
from orthocal.sensors.compiled import compile_reading
from orthocal.session.session import Conditions

FAST = SolverOptions(solver="variable-projection")
TRUTH = {"x_slide.offset": 1.2e-3, "y_slide.offset": -0.8e-3, "z_slide.offset": 0.5e-3}

PLAN = """robot: orthoglide
calibration: {model: offsets}
title: tool and legs
gauges:
  fine: {sigma_mm: 0.002, resolution_mm: 0.001, range_mm: [-200, 200]}
  dial: {sigma_mm: 0.01, resolution_mm: 0.01}
postures:
  zero: {tcp_mm: [0, 0, 0]}
  x_max: {tcp_mm: [60, 0, 0]}
  x_min: {tcp_mm: [-100, 0, 0]}
  y_max: {tcp_mm: [0, 60, 0]}
  y_min: {tcp_mm: [0, -100, 0]}
  z_max: {tcp_mm: [0, 0, 60]}
  corner: {tcp_mm: [50, -40, 30]}
  other: {tcp_mm: [-50, 40, -60]}
controller: {offsets_mm: [0, 0, 0]}
setups:
  tx: {sensor: tool, tool: x, slope_tolerance: 0.004, dial: d, gauge: fine}
  ty: {sensor: tool, tool: y, slope_tolerance: 0.004, dial: d, gauge: fine}
  tz: {sensor: tool, tool: z, slope_tolerance: 0.006, gauge: fine}
  yx: {leg: x, direction: y, section: {fraction: 0.5}, gauge: dial, postures: [zero, x_max, x_min]}
  zy: {leg: y, direction: z, section: {fraction: 0.5}, gauge: dial, postures: [zero, y_max, y_min]}
cycles: 2
"""


@pytest.fixture(autouse=True, scope="module")
def known():
    registry.register_sensor(ToolCoordinate)
    yield
    registry.unregister_sensor(ToolCoordinate.kind)


@pytest.fixture(scope="module")
def plan(known, tmp_path_factory):
    path = tmp_path_factory.mktemp("plan") / "plan.yaml"
    path.write_text(PLAN)
    return exact(load_plan(path))


@pytest.fixture(scope="module")
def measured(plan):
    return simulate_session(plan, TRUTH, seed=1).session


def test_its_readings_are_those_of_the_tool(plan):
    o = build_observations(plan)
    found = predict_readings(plan, TRUTH, observations=o, nuisance=np.array([1e-3, -2e-3]))
    drives = np.array([p.drives for p in plan.postures.values()])
    tool = LoopClosure(plan.robot, fixed=TRUTH).forward(drives)
    for setup, slope in enumerate((1e-3, 1e-3, -2e-3)):
        own = o.setup == setup
        expected = tool[o.posture[own], setup] * (1.0 + slope)
        assert np.abs(found[own] - expected).max() < 1e-12


def test_a_reading_of_another_shape_is_refused(plan):
    class Vector(ToolCoordinate):
        def expression(self, view, robot):
            return view.frames[0].position

    setups = {
        name: replace(s, sensor=Vector(s.sensor.axis, s.sensor.slope_tolerance, None))
        for name, s in plan.setups.items()
        if s.sensor.kind == "tool"
    }
    readings = tuple(r for r in plan.readings if r.setup in setups)
    with pytest.raises(OrthocalError, match=r"Vector.expression returns the shape \(3, 1\)"):
        predict_readings(replace(plan, setups=setups, readings=readings), {})


def test_nuisance_parameters_are_identified_with_the_machine(plan):
    """Slopes of 2 and 3 in a thousand at 0.16 m of travel, read to 2 µm: known to about 1e-5."""
    simulated = simulate_session(plan, TRUTH, seed=4)
    assert set(simulated.nuisance) == {"dial.d.slope", "setup.tz.slope"}
    result = identified(simulated.session)
    for p in result.sensors:
        assert 0.0 < p.std_scatter < 0.2 * p.prior_std
        assert abs(p.value - simulated.nuisance[p.name]) < 4.0 * p.std
    for name, value in TRUTH.items():
        assert abs(result[name].value - value) < 4.0 * result[name].std
    assert [p.name for p in result.free] == list(TRUTH)


def test_standard_deviations_hold_on_machines_with_all_errors(plan):
    """12 machines: offsets and slopes against standard deviations with unmodelled errors.

    Standard deviations that are wrong by a factor of 1.5 are refused.
    """
    others = [n for n in machine_errors(plan.robot) if not n.endswith(".offset")]
    of_offsets, of_slopes = [], []
    planned = build_problem(plan, model="offsets")
    for seed in range(12):
        errors = {**draw_errors(plan.robot, others, seed=seed), **TRUTH}
        simulated = simulate_session(plan, errors, seed=seed)
        truth = {**TRUTH, **simulated.nuisance}
        fit = fit_problem(planned.with_values(simulated.session.values), options=FAST)
        result = build_record.assemble_calibration(fit)
        of_offsets.append(recorded_scores(result, TRUTH)[0])
        total = np.sqrt(np.diag(result.total_covariance))
        assert [p.std for p in result.free] == pytest.approx(total, rel=1e-9)
        of_slopes.append([(p.value - truth[p.name]) / p.std for p in result.sensors])
    estimates = (*result.free, *result.sensors)
    assert [p.name for p in estimates] == list(fit.problem.free)
    assert [p.value for p in estimates] == fit.solution.theta.tolist()
    low, high = chi2.interval(0.99, np.size(of_offsets))
    assert low < np.square(of_offsets).sum() < high
    # the noise of the slopes is that of the residuals, which contain the other errors
    count = np.size(of_slopes)
    assert np.square(of_slopes).sum() < chi2.ppf(0.995, count)
    assert np.square(of_slopes).sum() > 0.25 * chi2.ppf(0.005, count)


def test_both_solvers_find_one_optimum(measured):
    problem = build_problem(measured, model="full")
    ours = VariableProjection(problem).solve(sigma=2e-6)
    ipopts = NonlinearProgram(problem).solve(sigma=2e-6)
    assert ours.theta.size == problem.n_machine + 2
    assert np.abs(ours.theta - ipopts.theta).max() < SAME_OPTIMUM
    assert np.abs((ours.theta - ipopts.theta) / problem.theta_scale).max() < 1e-6


def test_its_slope_is_central_differences(measured):
    problem = build_problem(measured, model="lengths")
    theta = np.append(0.3 * problem.theta_scale[:-2], [1.5e-3, -1e-3])
    _, jacobian = problem.predict_and_jacobian(theta)
    for i in (0, 4, problem.n_free - 2, problem.n_free - 1):
        step = np.zeros(problem.n_free)
        step[i] = 1e-2 * problem.theta_scale[i]
        slope = (problem.predict(theta + step) - problem.predict(theta - step)) / 2e-2
        assert np.abs(jacobian[:, i] - slope).max() < 1e-9


def test_it_is_written_and_read(plan, measured, tmp_path):
    path = write_session(measured, tmp_path / "s")
    again = load_session(path)
    assert [s.sensor for s in again.setups.values()] == [s.sensor for s in plan.setups.values()]
    assert [s.gauge for s in again.setups.values()] == ["fine"] * 3 + ["dial"] * 2
    result = calibrate(again, **UNJUDGED)
    write_calibration(result, tmp_path / "calibration.json")
    loaded = load_calibration(tmp_path / "calibration.json")
    assert json.loads(calibration_json(loaded)) == json.loads(calibration_json(result))
    assert [p.name for p in loaded.sensors] == ["dial.d.slope", "setup.tz.slope"]
    assert loaded.robot.name == "orthoglide"


@pytest.mark.usefixtures("short_reports", "without_sensor_gains")
def test_it_is_in_answer_report_and_scene(measured):
    calibration = calibrate(measured, **UNJUDGED)
    assert "legs x, y and the tool" in " ".join(summarize(calibration).split())
    with marked_plots():
        assert "dial.d.slope" in build_report(calibration)
    assert "tool" in draw_scene(calibration).to_html()


def test_what_does_not_fit_is_refused_by_key(tmp_path):

    spoilt = PLAN.replace("tool: z", "tool: w")
    (tmp_path / "plan.yaml").write_text(spoilt)
    with pytest.raises(SessionError, match=r"plan.yaml: setups.tz.tool: found 'w'"):
        load_plan(tmp_path / "plan.yaml")
    (tmp_path / "plan.yaml").write_text(PLAN.replace("sensor: tool, tool: z", "sensor: laser"))
    with pytest.raises(SessionError, match=r"setups.tz.sensor: found 'laser'; expected one of leg"):
        load_plan(tmp_path / "plan.yaml")


def test_what_differs_between_setups_belongs_into_constants(plan):
    """Setups that look at the same frames share one function: one that reads itself is refused."""

    class Selfish(ToolCoordinate):
        kind = "selfish"

        def constants(self, robot):
            return np.zeros(0)

        def expression(self, view, robot):
            return ca.dot(self._axis, view.frames[0].position) * (1.0 + view.nuisance[0])

    compile_reading(plan.robot, Selfish("x", 1e-3, None))
    compile_reading(plan.robot, Selfish("x", 2e-3, None))
    with pytest.raises(OrthocalError, match="into `constants`"):
        compile_reading(plan.robot, Selfish("y", 1e-3, None))


def test_a_sensor_may_depend_on_the_conditions_of_a_reading(plan):
    """One that shows 1 µm more for each degree, and 2 µm in the direction of the first drive."""

    class Warm(ToolCoordinate):
        conditions = ("approach", "temperature")

        def expression(self, view, robot):
            warmer = 1e-6 * (view.conditions["temperature"] - 20.0)
            return super().expression(view, robot) + warmer + 2e-6 * view.conditions["approach"][0]

    setups = {
        n: replace(s, sensor=Warm(n[1], 1e-3, None)) for n, s in plan.setups.items() if n[0] == "t"
    }
    rows = [r for r in plan.readings if r.setup in setups]
    stated = [Conditions("npp", 20.0 + i) if i % 3 else None for i in range(len(rows))]
    readings = tuple(replace(r, conditions=c) for r, c in zip(rows, stated, strict=True))
    warm = replace(plan, setups=setups, readings=readings)
    shown = predict_readings(warm, TRUTH)
    cold = predict_readings(replace(warm, readings=tuple(rows)), TRUTH)
    expected = [1e-6 * i - 2e-6 if i % 3 else 0.0 for i in range(len(rows))]
    assert np.abs(shown - cold - expected).max() < 1e-15
    o = build_observations(warm)  # it depends on conditions, the loop closures do not
    assert np.array_equal(o.state, o.posture)


OWN = """
import sys
sys.path.insert(0, {folder!r})
import numpy as np, orthocal, own
from orthocal.sensors.compiled import compile_reading
robot = orthocal.load_robot("orthoglide")
value = compile_reading(robot, own.Own("x", 1e-3, None)).value
from orthocal.kinematics.robot_functions import robot_functions
errors = robot_functions(robot).errors
zero = errors.placements(np.zeros(len(errors.names)))
h, = value(robot.drive_zero[None] + 0.01, robot.reference_passive[None], zero,
           robot.drive_zero[None], np.array([[1.0, 0.0, 0.0]]), np.zeros((1, 1)))
print(float(h[0, 0]))
"""


def test_a_sensor_that_was_changed_has_new_functions(tmp_path, root, monkeypatch, capsys):
    """What is kept on disk is of the code that it was built by, of sensors from outside, too."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # both modules are as long and as old
    code = OWN.format(folder=str(tmp_path))

    def write(factor):
        (tmp_path / "own.py").write_text(
            f"import sys; sys.path.insert(0, {str(root / 'tests')!r})\n"
            "from tool_coordinate import ToolCoordinate\n"
            "class Own(ToolCoordinate):\n"
            "    kind = 'own'\n"
            "    def expression(self, view, robot):\n"
            f"        return {factor} * (0.1 + super().expression(view, robot))\n"
        )

    write(1.0)
    kept = set(cache_folder().iterdir())
    try:
        exec(code, {})
    finally:
        sys.modules.pop("own", None)
    before = float(capsys.readouterr().out)
    assert set(cache_folder().iterdir()) > kept
    write(5.0)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout) == pytest.approx(5.0 * before, rel=1e-12)


def test_a_sensor_that_shows_no_number_is_named_by_setup_and_posture(plan, measured):
    """One that sees only tools beyond 20 mm."""

    class Broken(ToolCoordinate):
        def expression(self, view, robot):
            return ca.sqrt(view.frames[0].position[0] - 0.02) + 0.0 * view.nuisance[0]

    broken = {
        name: replace(s, sensor=Broken("x", 1e-3, None)) if name == "tx" else s
        for name, s in plan.setups.items()
    }
    session = replace(measured, setups=broken)
    with pytest.raises(SessionError, match=r"setups\.tx: the predicted reading in posture 'zero'"):
        calibrate(session)
