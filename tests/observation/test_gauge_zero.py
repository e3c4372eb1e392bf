"""Known gauge zeros: absolute readings, by all solvers, from file to record and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrated import identified
from models import TRUTH

from orthocal import load_plan, simulate_session
from orthocal.calibration.refit import restore_session
from orthocal.errors import SessionError
from orthocal.estimation.fit import build_program, fit_problem
from orthocal.estimation.loss import Loss
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.measurement.files.session_file import load_session
from orthocal.measurement.files.write_session import write_session
from orthocal.statistics.zeros import project_out_zeros

SIGMA = 5e-6


@pytest.fixture(params=[("yx",), None], ids=["one known", "all known"])
def session(request, exact_plan):
    plan = exact_plan
    known = plan.setups if request.param is None else request.param
    setups = {n: replace(s, zero="known" if n in known else "free") for n, s in plan.setups.items()}
    return simulate_session(replace(plan, setups=setups), TRUTH, sigma=SIGMA, seed=2).session


def test_solvers_agree_and_keep_known_zeros_at_0(session):
    loss = "huber" if session.setups["zx"].zero == "free" else "squares"
    problem = build_problem(session, model="offsets")
    o = problem.observations
    known = np.array([session.setups[s].zero == "known" for s in o.zero_setup])
    assert np.array_equal(o.zero_known, known)
    assert o.n_free_zeros == len(known) - known.sum()
    thetas = []
    for kind in ("ipopt", "variable-projection"):
        options = SolverOptions(solver=kind, loss=Loss(loss))
        found = build_program(problem, options).solve(sigma=SIGMA)
        assert (found.zeros[known] == 0.0).all()
        thetas.append(found.theta)
    batch = BatchSolver(problem, options=options)
    thetas += [*batch.solve(problem.values[None], sigma=SIGMA).theta]
    assert np.ptp(thetas, axis=0).max() < 1e-8
    truth = np.array([TRUTH[n] for n in problem.free])
    assert np.abs(thetas[0] - truth).max() < 50e-6


def test_an_absolute_reading_is_one_more_equation(exact_plan):
    """One posture alone determines nothing with free zeros, the offsets with known ones."""
    plan = exact_plan
    readings = tuple(r for r in plan.readings if r.posture == "x_max")
    setups = {n: replace(s, zero="known") for n, s in plan.setups.items()}
    free = build_problem(replace(plan, readings=readings), model="offsets")
    known = build_problem(replace(plan, readings=readings, setups=setups), model="offsets")
    for problem, rank in ((free, 0), (known, 2)):
        _, jacobian = problem.predict_and_jacobian(problem.active_theta)
        rows = project_out_zeros(jacobian, problem.observations)
        assert np.linalg.matrix_rank(rows, tol=1e-9) == rank


def test_degrees_of_freedom_count_free_zeros_only(session):
    fit = fit_problem(build_problem(session, model="offsets"))
    known = sum(s.zero == "known" for s in session.setups.values())
    free = len(session.setups) - known
    assert fit.noise.residual_dof == pytest.approx(len(session.readings) - free - 3)


def test_a_known_zero_survives_files_and_records(session, tmp_path):
    write_session(session, tmp_path / "again")
    again = load_session(tmp_path / "again")
    record = restore_session(identified(session, "offsets"))
    for other in (again, record):
        assert {n: s.zero for n, s in other.setups.items()} == {
            n: s.zero for n, s in session.setups.items()
        }


def test_another_word_is_refused(root, tmp_path):
    text = (root / "examples/raw-cycles/plan.yaml").read_text()
    text = text.replace("yx: {leg: x,", "yx: {zero: fixed, leg: x,")
    assert "zero: fixed" in text
    (tmp_path / "plan.yaml").write_text(text)
    with pytest.raises(SessionError) as caught:
        load_plan(tmp_path / "plan.yaml")
    assert "setups.yx.zero" in str(caught.value)
