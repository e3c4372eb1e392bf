"""Deletion diagnostics: formulas against fits without the reading, and outliers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrated import UNJUDGED, identified, session_of
from gauges import exact
from models import TRUTH

from orthocal import Calibration, SolverOptions, calibrate, check_session, simulate_session
from orthocal.errors import SolverError
from orthocal.estimation.diagnostics.deletion import diagnose_readings
from orthocal.estimation.diagnostics.residual_rows import ResidualRow
from orthocal.estimation.fit import fit_problem, require_reachable
from orthocal.estimation.loss import Loss
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.variable_projection import VariableProjection
from orthocal.session.session import Gauge, Session

FAST = SolverOptions("variable-projection")

FIRST_ORDER = 0.02
"""[1] Formula to first order against a new exact solution: readings bend by a few per mille of the
offsets' standard errors, relative to the change itself."""


def without(session: Session, row: int) -> Session:
    return replace(session, readings=session.readings[:row] + session.readings[row + 1 :])


def outliers(calibration: Calibration) -> list[ResidualRow]:
    """Rows beyond the critical value, the worst first."""
    rows = [r for r in calibration.residuals if abs(r.studentised) > calibration.critical]
    return sorted(rows, key=lambda r: -abs(r.studentised))


def differences_of(session: Session) -> Session:
    """The same session read as differences from the zero posture: they share its reading."""
    zeros = {(r.setup, r.cycle): r.value for r in session.readings if r.posture == "zero"}
    rows = tuple(
        replace(r, minus="zero", value=r.value - zeros[r.setup, r.cycle])
        for r in session.readings
        if r.posture != "zero"
    )
    return replace(session, readings=rows)


@pytest.fixture(scope="module")
def single_cycle(exact_plan):
    rows = tuple(r for r in exact_plan.readings if r.cycle == 1)
    return replace(exact_plan, readings=rows)


@pytest.fixture(scope="module")
def readings(single_cycle):
    session = simulate_session(single_cycle, TRUTH, seed=5).session
    return session.with_gauge(Gauge(None, None, None))  # the residuals alone tell the noise


@pytest.fixture(scope="module")
def absolute(single_cycle):
    """Readings of which two gauges measure absolutely."""
    known = {n: replace(single_cycle.setups[n], zero="known") for n in ("yx", "zy")}
    plan = replace(single_cycle, setups=single_cycle.setups | known)
    session = simulate_session(plan, TRUTH, seed=5).session
    return session.with_gauge(Gauge(None, None, None))


FORMS = {"readings": "lengths", "differences": "offsets", "Table 1": "lengths", "known": "offsets"}


@pytest.mark.parametrize(("form", "model"), FORMS.items())
def test_leaving_a_row_out_changes_the_estimate_as_predicted(
    readings, absolute, experiment_2, form, model
):
    session = {
        "known": absolute,
        "readings": readings,
        "differences": differences_of(readings),
        "Table 1": exact(experiment_2),
    }[form]
    fit = fit_problem(build_problem(session, model=model), options=FAST)
    found = diagnose_readings(fit)
    sigma = fit.sigma
    best = fit.program.solve(sigma=sigma)
    std = np.sqrt(np.diag(fit.covariance()))
    for row in range(0, len(session.readings), 3):
        reduced = build_problem(without(session, row), model=model)
        again = VariableProjection(reduced).solve(sigma=sigma)  # the same noise
        shift = np.abs(again.theta - best.theta) / std
        assert shift.max() == pytest.approx(found.max_dfbetas[row], rel=FIRST_ORDER, abs=1e-3)
        assert shift.argmax() == found.dfbetas_parameter[row] or np.isclose(
            shift[found.dfbetas_parameter[row]], shift.max(), rtol=FIRST_ORDER
        )


@pytest.mark.parametrize("zeros_known", [False, True])
def test_studentised_residuals_are_those_of_a_regression_with_an_extra_column(
    readings, absolute, zeros_known
):
    """The error of one reading as a parameter of its own, in plain least squares."""
    fit = fit_problem(build_problem(absolute if zeros_known else readings, model="offsets"))
    problem, o = fit.problem, fit.problem.observations
    found = diagnose_readings(fit)
    zeros = problem.zero_incidence[:, ~o.zero_known]
    y = problem.values - fit.prediction
    for row in (0, 4, 11, 17):
        own = np.zeros((o.size, 1))
        own[row] = 1.0
        design = np.hstack([own, fit.jacobian * 1e3, zeros])
        solution, square, _, _ = np.linalg.lstsq(design, y, rcond=None)
        dof = o.size - design.shape[1]
        variance = float(square[0]) / dof * np.linalg.inv(design.T @ design)[0, 0]
        assert found.studentised[row] == pytest.approx(solution[0] / np.sqrt(variance), rel=1e-6)


def test_studentised_residuals_of_noise_are_students(single_cycle):
    """Over 30 sessions: a variance of dof/(dof − 2), and rarely an outlier."""
    plan = differences_of(single_cycle.with_gauge(Gauge(None, None, None)))
    problem = build_problem(plan, model="offsets")
    exact_rows = simulate_session(plan, TRUTH, exact=True).session.values
    rng, sigma = np.random.default_rng(0), single_cycle.gauge.sigma
    values, alarms = [], 0
    for _ in range(30):
        noise = sigma * rng.normal(size=len(single_cycle.readings))
        noise = differences_of(single_cycle.with_values(noise)).values
        found = diagnose_readings(
            fit_problem(problem.with_values(exact_rows + noise), options=FAST)
        )
        values.append(found.studentised)
        alarms += bool((np.abs(found.studentised) > found.outlier_threshold).any())
    t = np.array(values)
    dof = 12 - 3 - 1
    assert np.mean(t**2) == pytest.approx(dof / (dof - 2), rel=0.25)
    assert alarms <= 3  # 1 % of 30, and four standard deviations


def test_a_wrong_reading_is_named_with_file_and_line(root):
    session = session_of("sweep")
    row = 77
    values = session.values.copy()
    values[row] += 0.060e-3
    spoilt = session.with_values(values)
    result = identified(spoilt, "full")
    assert [r.line for r in outliers(result)][:1] == [session.readings[row].line]
    assert session.readings[row].line == row + 2 + _comment_lines(root / "examples/sweep")
    (found,) = [f for f in check_session(spoilt).findings if f.severity == "review"]
    assert found.places[0].line == session.readings[row].line
    assert len(result.residuals) == len(session.readings)


def _comment_lines(folder):
    head = (folder / "readings.csv").read_text().splitlines()
    return sum(line.startswith("#") for line in head)


def test_a_sound_session_has_no_outliers(experiment_2):
    assert outliers(identified(session_of("sweep"), "full")) == []
    assert outliers(identified(experiment_2)) == []


@pytest.mark.parametrize("size", [0.2e-3, 14e-3])
def test_hubers_loss_is_hardly_moved_by_a_wrong_reading(size):
    """Offsets by squares and by Huber's loss."""
    session = session_of("raw-cycles")
    values = session.values.copy()
    values[4] += size
    spoilt = session.with_values(values)
    sound, squares = identified(session, "offsets"), identified(spoilt, "offsets")
    huber = identified(spoilt, "offsets", loss="huber")
    offsets = [np.array([p.value for p in r.free]) for r in (sound, squares, huber)]
    assert np.abs(offsets[2] - offsets[0]).max() < 0.15 * np.abs(offsets[1] - offsets[0]).max()
    assert huber.noise.sigma < 0.6 * squares.noise.sigma
    assert outliers(huber)[0].line == outliers(squares)[0].line == session.readings[4].line
    assert huber.solver.loss == "huber"


def test_without_a_noise_no_reading_is_an_outlier(experiment_2):
    """Three rows for three offsets, and no gauge."""
    rows = tuple(experiment_2.readings[i] for i in (2, 0, 4))
    gauge = replace(experiment_2.gauge, sigma=None)
    session = replace(experiment_2, readings=rows).with_gauge(gauge)
    result = identified(session)
    assert np.isinf(result.critical)
    assert all(np.isnan(r.studentised) for r in result.residuals)


def test_errors_that_make_no_machine_are_refused(readings):
    fit = fit_problem(build_problem(readings, model="offsets"))
    absurd = replace(fit.solution, theta=np.array([0.3, 0.0, 0.0]))
    with pytest.raises(SolverError, match="are impossible: posture 'zero' cannot be reached"):
        require_reachable(fit.problem, absurd, options=SolverOptions())
    with pytest.raises(SolverError) as caught:
        require_reachable(fit.problem, absurd, options=SolverOptions(loss=Loss("huber")))
    assert "huber" not in str(caught.value)


def test_hubers_loss_converges_on_few_readings():
    session = session_of("table1/experiment-1-printed")
    found = calibrate(session, "lengths", loss="huber", **UNJUDGED)
    plain = identified(session, "lengths")
    gap = [a.value - b.value for a, b in zip(found.free, plain.free, strict=True)]
    assert np.abs(gap).max() < 2.0 * plain["x_slide.offset"].std
    assert not found.assessment.of_kind("linearisation error")
