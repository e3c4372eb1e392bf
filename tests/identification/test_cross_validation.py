from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from orthocal import calibrate, compare_models, load_plan, load_session, simulate_session
from orthocal.identification.cross_validation import find_turned_setup, predict_unseen
from orthocal.identification.fit import fit_problem
from orthocal.identification.loss import Loss
from orthocal.identification.nlp import NonlinearProgram, SolverOptions
from orthocal.identification.problem import build_problem
from orthocal.identification.uncertainty import project_out_zeros

FIRST_ORDER = 2e-3
"""[1] Of the largest error: what leaving a setup out to first order leaves of solving again."""


@pytest.mark.parametrize(
    ("session", "model"),
    [("table1/experiment-2", "offsets"), ("table1/experiment-2", "lengths"), ("sweep", "full")],
)
def test_leaving_a_setup_out_is_solving_without_it(root, session, model):
    """Against Ipopt, which solves again without every setup in turn."""
    loaded = load_session(root / "examples" / session)
    unseen = np.array([r.unseen for r in calibrate(loaded, model=model).residuals])
    solved = compare_models(loaded, models=[model])[model].exact.unseen
    assert np.abs(unseen - solved).max() < FIRST_ORDER * np.abs(solved).max()
    fitted = [r.residual for r in calibrate(loaded, model=model).residuals]
    assert np.linalg.norm(unseen) > 1.05 * np.linalg.norm(fitted)


def test_a_setup_that_the_others_do_not_determine_has_no_prediction(raw_cycles):
    """Only yx sees the offset of y; each of the others sees two offsets, in two ways."""
    rows = tuple(r for r in raw_cycles.readings if r.setup in ("yx", "zx", "xz"))
    result = calibrate(replace(raw_cycles, readings=rows))
    assert {r.setup for r in result.residuals if np.isnan(r.unseen)} == {"yx"}
    assert {r.setup for r in result.residuals if np.isfinite(r.unseen)} == {"zx", "xz"}


def test_one_setup_alone_predicts_nothing(raw_cycles):
    rows = tuple(r for r in raw_cycles.readings if r.setup == "yx")
    result = calibrate(replace(raw_cycles, readings=rows), model="lengths")
    assert all(np.isnan(r.unseen) for r in result.residuals)


def test_with_a_robust_loss_it_is_the_robust_fit_that_predicts(raw_cycles):
    """Where no residual is large Huber's loss is all but squares, and predicts as they do."""
    wide = SolverOptions(loss=Loss("huber", width=100.0))
    robust = predict_unseen(fit_problem(build_problem(raw_cycles), options=wide))
    squares = predict_unseen(fit_problem(build_problem(raw_cycles)))
    assert np.abs(robust - squares).max() < 1e-3 * np.abs(squares).max()


def turn(session, setup):
    values = [-r.value if r.setup == setup else r.value for r in session.readings]
    return session.with_values(values)


@pytest.mark.parametrize(
    ("session", "model", "setup"),
    [
        *(("raw-cycles", "offsets", s) for s in ("yx", "zx", "xy", "zy", "xz", "yz")),
        ("sweep", "full", "zy_50"),
        ("lines", "offsets", "yx"),
    ],
)
def test_a_setup_with_its_sign_turned_is_found(root, session, model, setup):
    """It and no other; what it would leave with the right sign is what Ipopt, without it, misses.

    All others read the same, turned or not; sigma, which weighs a prior, is that of the turned one.
    """
    right = load_session(root / "examples" / session)
    assert find_turned_setup(calibrate(right, model=model).residuals) is None
    found = find_turned_setup(calibrate(turn(right, setup), model=model).residuals)
    assert found.name == setup
    sigma = fit_problem(build_problem(turn(right, setup), model=model)).sigma
    problem = build_problem(right, model=model)
    o = problem.observations
    out = np.flatnonzero(o.setup == list(right.setups).index(setup))
    solved = NonlinearProgram(problem).solve(sigma=sigma, left_out=out)
    missed = project_out_zeros(problem.values - problem.predict(solved.theta), o)[out]
    # up to the curvature between the two solutions
    assert found.turned == pytest.approx(np.sqrt(np.mean(missed**2)), rel=0.02)


@pytest.mark.parametrize("setup", ["zx", "xy", "xz", "yz"])
def test_a_turned_setup_is_found_among_coarse_readings(root, setup):
    """Deviations of 0.12 to 0.26 mm, two cycles with 20 µm."""
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    truth = {"x_slide.offset": 0.8e-3, "y_slide.offset": -0.45e-3, "z_slide.offset": 0.3e-3}
    session = simulate_session(plan, truth, sigma=20e-6, seed=1).session
    two = replace(session, readings=tuple(r for r in session.readings if r.cycle < 3))
    assert find_turned_setup(calibrate(two).residuals) is None
    assert find_turned_setup(calibrate(turn(two, setup)).residuals).name == setup


@pytest.mark.parametrize("number", ["1-printed", "1-corrected", "2", "3"])
def test_one_difference_a_setup_cannot_tell_of_its_sign(root, number):
    session = load_session(root / f"examples/table1/experiment-{number}")
    for setup in (None, *session.setups):
        given = session if setup is None else turn(session, setup)
        assert find_turned_setup(calibrate(given).residuals) is None
