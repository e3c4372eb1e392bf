"""What unmodelled errors do to an estimate: the formula against machines that have them."""

from __future__ import annotations

import numpy as np
import pytest

from orthocal import calibrate, load_plan, simulate_session
from orthocal.identification.fit import fit_problem
from orthocal.identification.nlp import NonlinearProgram
from orthocal.identification.problem import build_problem
from orthocal.identification.uncertainty import project_out_zeros
from orthocal.identification.unmodelled import measure_unmodelled


@pytest.fixture(scope="module")
def plan(root):
    return load_plan(root / "examples/raw-cycles/plan.yaml")


@pytest.mark.parametrize("name", ["x_slide.rz", "x_swivel.x", "y_coupler.x", "z_bar_b.z"])
@pytest.mark.parametrize("model", ["offsets", "lengths"])
def test_an_unmodelled_error_moves_the_estimate_by_its_leakage(plan, name, model):
    """Perfect readings of a machine with one small error, calibrated without it."""
    probe = simulate_session(plan, {}, exact=True).session
    found = measure_unmodelled(fit_problem(build_problem(probe, model=model)))
    if name not in found.names:
        assert (model, name) == ("lengths", "y_coupler.x")  # the length of the leg has it
        return
    column = found.leakage[:, found.names.index(name)]
    size = 1e-6
    problem = build_problem(simulate_session(plan, {name: size}, exact=True).session, model=model)
    sigma = fit_problem(build_problem(probe, model=model)).sigma
    moved = NonlinearProgram(problem).solve(sigma=sigma).theta / size
    assert moved == pytest.approx(column, abs=2e-3 * max(1.0, np.abs(column).max()))


@pytest.fixture(scope="module")
def machines(plan):
    """Offsets and residuals found on 200 machines with all other errors, perfect readings."""
    offsets = build_problem(plan)
    patterns = ["*", "!*.offset", "!frame.*", "!*.scale", "!*_leg.length"]
    others = build_problem(plan, free=patterns)
    program, rng = NonlinearProgram(offsets), np.random.default_rng(0)
    found, left = [], []
    for _ in range(200):
        values = others.predict(rng.normal(size=others.n_free) * others.theta_scale)
        solution = program.solve(sigma=1e-5, values=values)
        residual = values - offsets.predict(solution.theta, solution.passive)
        found.append(solution.theta)
        left.append(project_out_zeros(residual, offsets.observations))
    return np.array(found), np.array(left)


def test_residuals_of_machines_with_all_errors_are_as_large_as_foretold(plan, machines):
    result = calibrate(simulate_session(plan, {}, exact=True).session)
    rms = np.sqrt(np.mean(machines[1] ** 2))
    assert rms == pytest.approx(result.unmodelled.residual_rms, rel=0.06)


def test_the_offsets_of_machines_with_all_errors_scatter_as_foretold(plan, machines):
    """Whitened by the covariance foretold they are standard normal."""
    result = calibrate(simulate_session(plan, {}, exact=True).session)
    root = np.linalg.cholesky(result.unmodelled.bias_covariance)
    white = np.linalg.solve(root, machines[0].T)
    spread = np.linalg.eigvalsh(white @ white.T / white.shape[1])
    edge = np.sqrt(3 / white.shape[1])
    assert (1 - edge) ** 2 - 0.1 < spread.min()
    assert spread.max() < (1 + edge) ** 2 + 0.1


def test_the_full_model_leaves_nothing_out(plan):
    session = simulate_session(plan, {"x_slide.offset": 1e-3}, seed=1).session
    found = calibrate(session, model="full").unmodelled
    assert found.names == ()
    assert found.leakage.shape == (126, 0)
    assert found.residual_rms == 0.0
