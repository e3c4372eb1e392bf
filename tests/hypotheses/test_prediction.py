"""Prediction of a reading by the others, by dense conditioning and for drawn machines."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import plans
import pytest
import yaml
from calibrated import plan_of, session_of
from gauges import with_gauges

from orthocal import draw_errors, load_plan, simulate_session
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.estimation.problem import build_problem
from orthocal.hypotheses.linear_model import CONVERGED_CHANGE, MAX_STEPS, LinearModel
from orthocal.observation.simulate import limits_of, show_readings
from orthocal.session.session import Reading
from orthocal.units import MM

NEAR_THE_EDGE = """
gauge: {sigma_mm: 0.005, resolution_mm: 0.01, range_mm: [-5, 5], tip: {ball: {radius_mm: 1.5}}}
controller: {offsets_mm: [0, 0, 0]}
calibration: {tolerances: {"*.offset_mm": 4}}
setups:
  yx: {leg: x, direction: y, section: {fraction: 0.5}, touches: a, postures: [zero, x_max, x_min]}
  zy: {leg: y, direction: z, section: {fraction: 0.5}, touches: a, postures: [zero, y_max, y_min]}
  xz: {leg: z, direction: x, section: {fraction: 0.5}, touches: a, beside_mm: [0, 5, 0],
    postures: [z_max, zero, z_min], aligned_at: z_max}
"""
"""Keys of a plan of the paper's postures; its reading `xz z_min` is near the edge of the rod if the
offset of y is large."""

ZERO = 1.0
"""Standard deviation of a free gauge zero in the dense covariance, [m]: 10⁵ times the noise."""

ROUNDING = 1e-5
"""Relative error of conditioning with variances of ZERO² and of the noise side by side."""

CHANCE = (0.7, 1.3)
"""Range of the standard deviation of 60 scores: ± three standard errors."""


def part(session, count):
    return session.select(session.readings[:count])


def with_two_gauges(session, *, stated=True):
    fine = replace(session.gauge, sigma=1e-6 if stated else None, resolution=None)
    return with_gauges(session, {"coarse": session.gauge, "fine": fine}, list(session.setups)[1::2])


def with_known_zero(session, name):
    known = replace(session.setups[name], zero="known")
    return replace(session, setups=session.setups | {name: known})


def condition(session, row):
    """Mean and standard deviation of a reading, from the covariance of all rows written out."""
    problem = LinearModel(session).problem
    o = problem.observations
    of_rows = o.rows(np.eye(o.size))
    gauges = [session.gauges[session.setups[r.setup].gauge] for r in session.readings]
    sigma = np.zeros(o.size)
    for i, gauge in enumerate(gauges):
        for entry in (o.plus[i], o.minus[i]):
            if entry >= 0:
                sigma[entry] = math.hypot(gauge.sigma, (gauge.resolution or 0.0) / math.sqrt(12.0))
    zeros = problem.zero_incidence[:, ~o.zero_known] * ZERO
    others = np.delete(np.arange(len(session.readings)), row)
    theta = np.zeros(problem.n_free)
    for _ in range(MAX_STEPS):
        reading, jacobian = problem.predict_and_jacobian(
            problem.active_theta + theta * problem.theta_scale
        )
        jacobian = of_rows @ (jacobian * problem.noise_ratio[:, None])
        mean = of_rows @ (reading * problem.noise_ratio) - jacobian @ theta
        spread = of_rows @ np.hstack([zeros, np.diag(sigma)])
        covariance = jacobian @ jacobian.T + spread @ spread.T
        known = np.linalg.solve(covariance[np.ix_(others, others)], (session.values - mean)[others])
        if np.abs(jacobian[others].T @ known - theta).max() < CONVERGED_CHANGE:
            break
        theta = jacobian[others].T @ known
    gain = np.linalg.solve(covariance[np.ix_(others, others)], covariance[others, row])
    variance = covariance[row, row] - gain @ covariance[others, row]
    return mean[row] + covariance[row, others] @ known, math.sqrt(variance)


CASES = {
    "last reading": (lambda: part(session_of("workshop"), 11), 10),
    "earlier reading": (lambda: part(session_of("workshop"), 11), 4),
    "repeated": (lambda: part(session_of("raw-cycles"), 23), 22),
    "differences": (lambda: session_of("table1/experiment-2"), 3),
    "two gauges": (lambda: with_two_gauges(session_of("workshop")), 16),
    "known zero": (lambda: with_known_zero(part(session_of("workshop"), 7), "xy"), 6),
}


@pytest.mark.parametrize("case", CASES)
def test_a_prediction_equals_dense_conditioning(case):
    make, row = CASES[case]
    session = make()
    if session.gauge.sigma is None:
        session = session.with_gauge(replace(session.gauge, sigma=5e-6))
    mean, std = LinearModel(session).predict_row(session.values, row)
    expected, spread = condition(session, row)
    assert mean == pytest.approx(expected, abs=ROUNDING * spread)
    assert std == pytest.approx(spread, rel=ROUNDING)
    other = session.values.copy()
    other[row] += 0.1 * MM
    again = LinearModel(session.with_values(other)).predict_row(other, row)
    assert again == pytest.approx((mean, std), rel=1e-9)


def test_repeated_readings_predict_their_mean():
    """Solved by hand: with a free zero the mean of the others, to σ √(1 + 1/n)."""
    plan = plan_of("raw-cycles")
    rows = [r for r in plan.readings if (r.setup, r.posture) == ("yx", "x_max")]
    session = plan.select(rows).with_values(np.array([0.1, 0.12, 0.7]) * MM)
    for predict in (LinearModel(session).predict_row, LinearModel(session).compare_row):
        mean, std = predict(session.values, 2)
        assert mean == pytest.approx(0.11 * MM, abs=1e-12)
        assert std == pytest.approx(np.hypot(0.01, 0.01 / np.sqrt(12.0)) * MM * np.sqrt(1.5))


@pytest.mark.parametrize("stated", [True, False])
def test_a_repeated_reading_of_several_gauges_does_not_change_its_own_prediction(stated):
    """The noise of several gauges is estimated from repeated readings, but not from this one."""
    session = with_two_gauges(session_of("raw-cycles"), stated=stated)
    (row, *_) = [
        i
        for i, r in enumerate(session.readings)
        if session.setups[r.setup].gauge == "fine" and r.cycle == 3
    ]
    mean, std = LinearModel(session).compare_row(session.values, row)
    assert abs(session.values[row] - mean) < 3.0 * std
    for error in (0.4 * MM, 0.95 * MM):
        wrong = session.values.copy()
        wrong[row] += error
        model = LinearModel(session.with_values(wrong))
        assert model.predict_row(wrong, row) == pytest.approx((mean, std), rel=1e-9)
        compared, larger = model.compare_row(wrong, row)
        assert compared == pytest.approx(mean, rel=1e-9)
        assert error > 3.0 * larger


def test_a_reading_that_shows_another_offset_does_not_contradict_the_others():
    """The offset of slide z changes the first setup to second order: its sign is unknown."""
    plan = plan_of("workshop")
    errors = draw_errors(plan.robot, machine_errors(plan.robot), seed=34)
    session = part(simulate_session(plan, errors, seed=34).session, 5)
    model, value = LinearModel(session), session.values[4]
    mean, std = model.predict_row(session.values, 4)
    assert abs(value - mean) > 10.0 * std
    same, larger = model.compare_row(session.values, 4)
    assert same == mean
    assert abs(value - mean) < 3.0 * larger


def test_the_first_reading_of_a_setup_has_no_prediction():
    session = part(session_of("workshop"), 7)
    for only in (session, part(session, 1)):
        mean, std = LinearModel(only).predict_row(only.values, len(only.readings) - 1)
        assert math.isnan(mean)
        assert math.isinf(std)


def test_a_difference_is_predicted_without_other_readings():
    session = replace(
        plan_of("raw-cycles"), readings=(Reading("yx", "x_max", "x_min", 1, 0.0, None),)
    )
    mean, std = LinearModel(session).predict_row(session.values, 0)
    assert mean == pytest.approx(0.0, abs=1e-9)
    assert 0.5 * MM < std < 5.0 * MM  # from offsets of 2 mm


def draw_sessions(plan, count, seed):
    """Sessions of machines within their tolerances, closed exactly, in the range of the dial."""
    problem = build_problem(plan, free=machine_errors(plan.robot), prior=True)
    theta = np.random.default_rng(seed).normal(size=(count, problem.n_free))
    o = problem.observations
    entries, _, closed = problem.simulate(problem.active_theta + theta * problem.theta_scale)
    limits = [limits_of(plan, r) for r in plan.readings]
    for k in np.flatnonzero(closed & np.isfinite(entries).all(axis=1)).tolist():
        rng = np.random.default_rng((seed, k))
        values = o.rows(show_readings(plan, o, entries[k], rng=rng)[0])
        if all(low <= v <= high for (low, high), v in zip(limits, values, strict=True)):
            yield plan.with_values(values)


def test_readings_scatter_about_their_predictions_as_stated():
    plan, scores = plan_of("workshop"), []
    models = {count: LinearModel(part(plan, count)) for count in (6, 12, 18)}
    for session in draw_sessions(plan, 20, 5):
        for count, model in models.items():
            values = session.values[:count]
            mean, std = model.predict_row(values, count - 1)
            scores.append((values[-1] - mean) / std)
    assert len(scores) >= 60
    assert CHANCE[0] < np.std(scores) < CHANCE[1]
    assert abs(np.mean(scores)) < 0.3


def test_a_correct_reading_near_the_edge_of_a_rod_is_not_contradicted(tmp_path):
    """The first step to the most likely machine is to one whose rod the tip misses.

    The nominal machine predicts the reading to 0.1 mm, although it is wrong by more than 1 mm.
    """
    keys = plans.paper() | yaml.safe_load(NEAR_THE_EDGE)
    (tmp_path / "session.yaml").write_text(yaml.safe_dump(keys, sort_keys=False))
    plan = load_plan(tmp_path)
    session = simulate_session(plan, {"y_slide.offset": 4.3e-3}, seed=1).session
    row = [(r.setup, r.posture) for r in session.readings].index(("xz", "z_min"))
    mean, std = LinearModel(session).compare_row(session.values, row)
    assert abs(session.values[row] - mean) < 2.0 * std
