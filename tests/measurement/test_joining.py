"""Several sessions in one problem: zeros and noise of each their own, one machine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibrated import UNJUDGED, identified
from gauges import exact

from orthocal import (
    SolverOptions,
    calibrate,
    load_calibration,
    load_plan,
    simulate_session,
    summarize,
)
from orthocal.calibration.file import calibration_document, write_calibration
from orthocal.effects.compensation import JointTrim
from orthocal.errors import SessionError
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.loss import Loss
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.estimation.solvers.variable_projection import VariableProjection
from orthocal.measurement.files.session_file import load_session
from orthocal.measurement.files.write_session import write_session
from orthocal.measurement.joining import gather_sessions, join_sessions
from orthocal.session.points import base_name

TRUTH = {"x_slide.offset": 1.2e-3, "y_slide.offset": -0.8e-3, "z_slide.offset": 0.5e-3}


@pytest.fixture(scope="module")
def sweep(root):
    return load_session(root / "examples/sweep")


def part_of(session, setups):
    """Part of a session that has some of its setups."""
    return replace(
        session,
        setups={n: s for n, s in session.setups.items() if n in setups},
        readings=tuple(r for r in session.readings if r.setup in setups),
        sha256="",
    )


@pytest.mark.parametrize(
    ("model", "solver"), [("offsets", "ipopt"), ("full", "variable-projection")]
)
def test_a_session_divided_into_two_gives_the_same_estimates(sweep, model, solver):
    """With a stated noise of the gauge; otherwise each session has its estimated noise."""
    names = list(sweep.setups)
    stated = sweep.with_gauge(replace(sweep.gauge, sigma=0.5e-3, resolution=None))
    parts = [part_of(stated, names[:3]), part_of(stated, names[3:])]
    undivided = identified(stated, model, solver=solver)
    joined = identified(parts, model, solver=solver)
    assert undivided.noise.source == joined.noise.source == "gauge"
    for p, q in zip(undivided.free, joined.free, strict=True):
        assert q.value == pytest.approx(p.value, abs=1e-9 * p.prior_std)
        assert q.std == pytest.approx(p.std, rel=1e-9)
    assert [r.measured for r in joined.residuals] == [r.measured for r in undivided.residuals]
    residuals = np.array([[r.residual for r in c.residuals] for c in (undivided, joined)])
    assert np.abs(residuals[0] - residuals[1]).max() < 1e-12


def test_a_session_and_one_joined_from_it_do_not_count_twice(sweep, raw_cycles):
    joined = join_sessions([sweep, raw_cycles])
    for both in (
        [joined, raw_cycles],
        [replace(sweep, title="copy"), joined],
        [joined, join_sessions([raw_cycles, sweep])],
    ):
        with pytest.raises(SessionError, match="is the same session as one before it"):
            gather_sessions(both)
    others = joined.with_values(joined.values + 1e-6)
    assert gather_sessions([joined, others]) == [joined, others]


def test_brackets_in_names_of_directories_are_replaced(sweep):
    """Brackets name the coordinates of points: all setups of a session would count as one."""
    joined = join_sessions([replace(sweep, path=Path(f"a[{k}]/session.yaml")) for k in (1, 2)])
    assert len(set(map(base_name, joined.setups))) == len(joined.setups) == 2 * len(sweep.setups)


def test_the_same_readings_again_halve_the_variance(raw_cycles):
    stated = exact(raw_cycles).with_gauge(replace(raw_cycles.gauge, sigma=50e-6, resolution=None))
    once, twice = identified(stated), identified([stated, stated.with_values(stated.values)])
    assert twice.model_covariance == pytest.approx(0.5 * once.model_covariance, rel=1e-7)
    for p, q in zip(once.free, twice.free, strict=True):
        assert q.value == pytest.approx(p.value, abs=1e-12)
    assert len(twice.setups) == 2 * len(once.setups)


def test_offsets_that_were_active_may_differ(root):
    """Monday without active offsets, Tuesday with those of Monday: one machine."""
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    monday = simulate_session(plan, TRUTH, exact=True).session
    entered = plan.with_controller([1.1e-3, -0.7e-3, 0.4e-3])
    tuesday = simulate_session(entered, TRUTH, exact=True).session
    found = identified([monday, tuesday])
    for name, value in TRUTH.items():
        assert found[name].value == pytest.approx(value, abs=1e-9)
    # what is entered next comes on top of what is active now
    assert found.active_offsets.tolist() == [1.1e-3, -0.7e-3, 0.4e-3]
    wrong = tuesday.with_controller(np.zeros(3))  # the readings contradict that
    assert identified([monday, wrong]).rms_after > 5e-5 > 1e-8 > found.rms_after


def test_deviations_before_are_with_the_offsets_of_each_session(root):
    """Of a joined calibration as of that of the session alone, whatever its place."""
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    entered = plan.with_controller([1.1e-3, -0.7e-3, 0.4e-3])
    parts = [simulate_session(p, TRUTH, seed=k).session for k, p in enumerate((plan, entered))]
    alone = [[r.deviation for r in identified(part, "offsets").residuals] for part in parts]
    largest = [np.abs(deviations).max() for deviations in alone]
    assert largest[0] > 3.0 * largest[1]
    joined = calibrate(parts[::-1], "offsets", **UNJUDGED)
    postures = len(parts[0].postures)
    count = f"{2 * len(parts[0].readings)} readings of 2 sessions in {postures} postures, "
    assert count in " ".join(summarize(joined).split())
    expected = alone[1] + alone[0]
    assert [r.deviation for r in joined.residuals] == pytest.approx(expected, abs=1e-9)


def test_noise_is_estimated_for_each_session(root):
    """Dials of 5 µm and of 40 µm: noise as if calibrated alone; the better one counts more."""
    plan = exact(load_plan(root / "examples/raw-cycles/plan.yaml"))
    plan = plan.with_gauge(replace(plan.gauge, sigma=None, resolution=None))
    fine = simulate_session(plan, TRUTH, seed=1, sigma=5e-6).session
    coarse = simulate_session(plan, TRUTH, seed=2, sigma=40e-6).session
    found = identified([coarse, fine])
    assert [g.noise.sigma for g in found.gauges] == [
        pytest.approx(identified(s).noise.sigma, rel=0.1) for s in (coarse, fine)
    ]
    assert found.gauges[0].noise.sigma == pytest.approx(40e-6, rel=0.4)
    assert found.gauges[1].noise.sigma == pytest.approx(5e-6, rel=0.4)
    alone = identified(fine)
    for p, q in zip(alone.free, found.free, strict=True):
        assert q.std_scatter < p.std_scatter
        assert q.std_scatter > 0.9 * p.std_scatter
        assert abs(q.value - p.value) < 0.5 * p.std_scatter
    # were both to count alike, the coarse one would decide
    same = build_problem(join_sessions([coarse, fine]), model="offsets")
    alike = VariableProjection(same).solve(sigma=1e-5).theta
    assert np.abs(alike - [p.value for p in found.free]).max() > found.free[0].std_scatter


def test_deviations_of_mixed_sessions_are_those_of_many(root):
    """Offsets from a coarse and a fine session: 60 z scores, as calibrations have them.

    Their root mean square has a standard deviation of 1/√120 = 0.09 around 1.
    """
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    plan = plan.with_gauge(replace(plan.gauge, sigma=None, resolution=None))
    options, scores = SolverOptions(solver="variable-projection"), []
    for seed in range(20):
        pair = [
            simulate_session(plan, TRUTH, seed=2 * seed + i, sigma=s).session
            for i, s in enumerate((40e-6, 5e-6))
        ]
        fit = fit_problem(build_problem(join_sessions(pair), model="offsets"), options=options)
        n = fit.problem.n_machine
        names, values = fit.problem.free[:n], fit.solution.theta[:n]
        std = np.sqrt(np.diag(fit.covariance())[:n])
        scores.append((values - [TRUTH[name] for name in names]) / std)
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1.0, abs=0.2)
    found = identified(pair)
    assert [p.name for p in found.free] == list(names)
    assert [p.value for p in found.free] == values.tolist()
    known = np.sqrt(np.diag(found.model_covariance))
    assert known == pytest.approx(std, rel=1e-12)


def test_both_solvers_weigh_gauges_alike(root):
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    pair = [
        simulate_session(plan, TRUTH, seed=i, sigma=s).session for i, s in enumerate((2e-5, 5e-6))
    ]
    pair = [
        replace(s, readings=tuple(r for r in s.readings if r.cycle == 1 and r.setup[1] == "x"))
        for s in pair
    ]
    problem = build_problem(join_sessions(pair), model="offsets")
    problem = problem.with_noise_ratio(np.repeat([1.0, 0.25], problem.observations.size // 2))
    options = SolverOptions(loss=Loss("huber"), hessian="exact")
    ours = VariableProjection(problem, options=options).solve(sigma=2e-5)
    ipopts = NonlinearProgram(problem, options=options).solve(sigma=2e-5)
    difference = np.abs(ours.theta - ipopts.theta) / problem.theta_scale
    assert difference.max() < 1e-6
    assert np.abs(ours.zeros - ipopts.zeros).max() < 1e-9


def test_a_joined_calibration_is_written_and_read(root, tmp_path):
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    for i, day in enumerate(("monday", "tuesday")):
        write_session(simulate_session(plan, TRUTH, seed=i).session, tmp_path / day)
    found = calibrate([tmp_path / "monday", tmp_path / "tuesday"], **UNJUDGED)
    assert {s.name.split("/")[0] for s in found.setups} == {"monday", "tuesday"}
    assert found.where(found.residuals[-1]).startswith(str(tmp_path / "tuesday/readings.csv:"))
    write_calibration(found, tmp_path / "calibration.json")
    again = load_calibration(tmp_path / "calibration.json")
    assert calibration_document(again) == calibration_document(found)
    assert [p.path for p in again.session.parts] == [
        str(tmp_path / day / "session.yaml") for day in ("monday", "tuesday")
    ]
    assert again.where(again.residuals[0]).startswith(str(tmp_path / "monday/readings.csv:"))


def test_only_sessions_of_one_robot_are_joined(root):
    sessions = [load_session(root / "examples/raw-cycles")]
    other = replace(sessions[0], robot=replace(sessions[0].robot, sha256="another"))
    with pytest.raises(SessionError, match="another session is of 'orthoglide', or of another"):
        join_sessions([*sessions, other])
    with pytest.raises(SessionError, match="no session"):
        join_sessions([])
    assert join_sessions(sessions) is sessions[0]


def test_a_fit_is_of_one_problem_where_the_noise_does_not_settle(root):
    """The noise ratio of the last solution, not of one that nobody has solved."""
    plan = exact(load_plan(root / "examples/raw-cycles/plan.yaml"))
    plan = plan.with_gauge(replace(plan.gauge, sigma=None, resolution=None))
    sessions = [simulate_session(plan, TRUTH, seed=s, sigma=s * 10e-6).session for s in (1, 4)]
    once = [replace(s, readings=tuple(r for r in s.readings if r.cycle == 1)) for s in sessions]
    fit = fit_problem(build_problem(join_sessions(once), model="offsets"), rounds=1)
    prediction = fit.problem.predict(fit.solution.theta, fit.solution.passive)
    assert fit.prediction == pytest.approx(prediction, rel=1e-12)
    assert fit.program.problem is fit.problem


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda s: s.with_controller([1e-3, 2e-3, 0.5e-3]), "controller offsets"),
        (lambda s: replace(s, compensation=(JointTrim(20e-6),) * 3), "compensation"),
        (lambda s: replace(s, adjusted={"x_outer_foot_y": 0.1e-3}), "adjustments"),
    ],
)
def test_a_file_has_one_state_of_machine_and_controller(sweep, tmp_path, change, named):
    """It states them once, so that readings of the other setups would be read with wrong ones."""
    joined = join_sessions([sweep, change(sweep.with_values(sweep.values))])
    with pytest.raises(
        SessionError, match=f"setup 'sweep-1/.*' with other {named} than the session"
    ):
        write_session(joined, tmp_path / "joined")
    assert not (tmp_path / "joined").exists()
    alike = join_sessions([change(sweep), change(sweep.with_values(sweep.values))])
    write_session(alike, tmp_path / "alike")
