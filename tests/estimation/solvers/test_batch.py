"""Many sets of readings at once: each the optimum that it has alone."""

from __future__ import annotations

import numpy as np
import pytest

from orthocal import load_session
from orthocal.estimation.loss import Loss
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.batch import BatchProgram
from orthocal.estimation.solvers.eliminated import EliminatedProgram
from orthocal.estimation.solvers.fleet import Fleet
from orthocal.estimation.solvers.ipopt import NonlinearProgram

SIGMA = 10e-6
SETS = 60
SHOWN = 8
"""Sets that are solved alone too."""

AGREED = 1e-6
"""[tolerances]"""


def draw(problem, spread=0.4):
    """Readings of machines with errors of so many tolerances."""
    rng = np.random.default_rng(3)
    fleet = Fleet(problem, spread * rng.normal(size=(SETS, problem.n_free)))
    assert fleet.close().all()
    noise = SIGMA * rng.normal(size=(SETS, problem.observations.size))
    return fleet.predict() + noise, fleet


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
    session = load_session(root / "examples/table1/experiment-2")
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


def test_many_parameters_are_solved_too(root):
    problem = build_problem(load_session(root / "examples/sweep"), model="full")
    values, _ = draw(problem, spread=0.1)
    found = BatchProgram(problem).solve(values[:2], sigma=SIGMA)
    alone = EliminatedProgram(problem).solve(sigma=SIGMA, values=values[1])
    assert np.abs(alone.theta - found.theta[1]).max() < 1e-9
    assert found.alone.all()


def test_a_set_far_from_the_others_is_solved_alone(root):
    session = load_session(root / "examples/table1/experiment-2")
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
    session = load_session(root / "examples/table1/experiment-2")
    problem = build_problem(session, model="offsets")
    rows = np.tile(session.values, (3, 1))
    found = BatchProgram(problem).solve(rows, sigma=SIGMA)
    alone = EliminatedProgram(problem).solve(sigma=SIGMA)
    assert np.abs(found.theta - alone.theta).max() < 1e-12
    with pytest.raises(ValueError, match="expected"):
        BatchProgram(problem).solve(rows[:, 1:], sigma=SIGMA)


def test_a_fleet_shows_what_each_of_its_machines_does(root):
    problem = build_problem(load_session(root / "examples/sweep"), model="full")
    values, fleet = draw(problem, spread=0.3)
    for i in (0, SETS - 1):
        expected = problem.predict(fleet.theta[i] * problem.theta_scale)
        assert np.abs(fleet.predict()[i] - expected).max() < 1e-11
    assert values.shape == (SETS, problem.observations.size)
