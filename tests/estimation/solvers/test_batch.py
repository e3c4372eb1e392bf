"""Many sets of readings solved at once: each has the optimum that it has alone."""

from __future__ import annotations

import numpy as np
import pytest
from gauges import exact

from orthocal import load_session
from orthocal.estimation.loss import Loss
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.estimation.solvers.variable_projection import VariableProjection

SIGMA = 10e-6
SETS = 8
SHOWN = 4
"""Sets that are solved alone too."""

AGREED = 1e-6
"""[prior std]"""


def draw(problem, spread=0.4, sets=SETS):
    """Readings of machines with errors of so many tolerances."""
    rng = np.random.default_rng(3)
    theta = spread * rng.normal(size=(sets, problem.n_free)) * problem.theta_scale
    readings, _, reached = problem.simulate(theta)
    assert reached.all()
    noise = SIGMA * rng.normal(size=(sets, problem.observations.size))
    return readings + noise, theta


BOUNDS = {"bounds": {"x_slide.offset": (-1e-3, 1e-3)}}


@pytest.mark.parametrize(
    ("loss", "given"),
    [
        ("squares", BOUNDS),
        ("huber", {"prior": True}),
        ("huber", BOUNDS),
    ],
    ids=["bounds", "huber-prior", "huber-bounds"],
)
def test_each_set_has_the_optimum_that_it_has_alone(root, loss, given):
    session = exact(load_session(root / "examples/table1/experiment-2"))
    problem = build_problem(session, model="offsets", **given)
    options = SolverOptions(loss=Loss(loss))
    values, _ = draw(problem)
    found = BatchSolver(problem, options=options).solve(values, sigma=SIGMA)
    # far beyond its bounds the common steps of a robust loss converge slowly
    assert ("bounds" in given and loss == "huber") or not found.solved_alone.any()
    # far beyond its bounds Ipopt does not find the optimum of a robust loss
    ipopts = 0 if "bounds" in given and loss == "huber" else 2
    for kind, few in ((VariableProjection, SHOWN), (NonlinearProgram, ipopts)):
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


def test_many_parameters_are_solved_at_once(sweep):
    options = SolverOptions(loss=Loss("huber"))
    values, _ = draw(sweep, spread=1.0)
    values[:, 3] += 40e-6  # an outlier in each set
    found = BatchSolver(sweep, options=options).solve(values, sigma=SIGMA)
    assert not found.solved_alone.any()
    program = VariableProjection(sweep, options=options)
    for i in (0, 3):
        alone = program.solve(sigma=SIGMA, values=values[i])
        assert np.abs((alone.theta - found.theta[i]) / sweep.theta_scale).max() < AGREED
        assert np.abs(alone.zeros - found.zeros[i]).max() < 1e-9
        assert found.objective[i] == pytest.approx(alone.objective, rel=1e-8)


def test_a_machine_far_off_is_solved_alone_and_one_at_a_bound_is_not(root):
    session = exact(load_session(root / "examples/sweep"))
    problem = build_problem(session, model="full", **BOUNDS)
    values, truth = draw(problem)
    values[3] += 2e-3 * np.sin(np.arange(values.shape[1]))  # hardly a machine reads like this
    found = BatchSolver(problem).solve(values, sigma=SIGMA)
    held = np.abs(truth[:, 0]) > 1.2e-3
    assert held.any()
    assert found.solved_alone[3]
    assert found.solved_alone.sum() == 1
    assert (found.at_bound[held, 0] != 0).all()
    program = VariableProjection(problem)
    for i in (3, int(np.flatnonzero(held)[0]), int(np.flatnonzero(~found.solved_alone)[0])):
        alone = program.solve(sigma=SIGMA, values=values[i])
        assert np.abs((alone.theta - found.theta[i]) / problem.theta_scale).max() < AGREED


def test_a_set_is_solved_alike_beside_any_others(sweep):
    values, _ = draw(sweep, spread=0.5, sets=4)
    together = BatchSolver(sweep).solve(values, sigma=SIGMA)
    for i in range(4):
        alone = BatchSolver(sweep).solve(values[i : i + 1], sigma=SIGMA)
        apart = np.abs(alone.theta[0] - together.theta[i]) / sweep.theta_scale
        assert apart.max() < 1e-11  # sums of a product may be added in another order
        assert not alone.solved_alone.any()


def test_a_set_far_from_the_others_is_solved_as_well(root):
    session = exact(load_session(root / "examples/table1/experiment-2"))
    problem = build_problem(session, model="offsets")
    values, _ = draw(problem, spread=0.01, sets=60)
    values = np.tile(values, (8, 1))
    values[7] = problem.predict(np.full(3, 2.0) * problem.theta_scale)
    found = BatchSolver(problem).solve(values, sigma=SIGMA)
    assert np.abs(found.theta[7] / problem.theta_scale - 2.0).max() < AGREED
