from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrated import SOUND, identified, session_of
from gauges import exact

from orthocal import compare_models
from orthocal.estimation.diagnostics.deletion import cross_validate_setups
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.loss import Loss
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import build_problem

FAST = SolverOptions("variable-projection")

FIRST_ORDER = 2e-3
"""[1] Of the largest error: what leaving a setup out to first order leaves of solving again."""


@pytest.mark.parametrize(
    ("session", "model"), [("table1/experiment-2", "offsets"), ("raw-cycles", "full")]
)
def test_leaving_a_setup_out_is_solving_without_it(session, model):
    """Against fits without each setup."""
    loaded = exact(session_of(session))
    rows = identified(loaded, model).residuals
    prediction_error = np.array([r.prediction_error for r in rows])
    compared = compare_models(loaded, models=[model], options=FAST, judgement=SOUND)
    solved = compared[model].exact.prediction_error
    assert np.abs(prediction_error - solved).max() < FIRST_ORDER * np.abs(solved).max()
    assert np.linalg.norm(prediction_error) > 1.05 * np.linalg.norm([r.residual for r in rows])


def test_a_setup_that_the_others_do_not_determine_has_no_prediction(raw_cycles):
    """Only yx sees the offset of y; each of the others sees two offsets, in two ways."""
    rows = tuple(r for r in raw_cycles.readings if r.setup in ("yx", "zx", "xz"))
    result = identified(replace(raw_cycles, readings=rows))
    assert {r.setup for r in result.residuals if np.isnan(r.prediction_error)} == {"yx"}
    assert {r.setup for r in result.residuals if np.isfinite(r.prediction_error)} == {"zx", "xz"}


def test_with_a_robust_loss_it_is_the_robust_fit_that_predicts(raw_cycles):
    """Where no residual is large Huber's loss is all but squares, and predicts as they do."""
    wide = SolverOptions(loss=Loss("huber", width=100.0))
    problem = build_problem(exact(raw_cycles), model="offsets")
    robust = cross_validate_setups(fit_problem(problem, options=wide))
    squares = cross_validate_setups(fit_problem(problem))
    assert np.abs(robust - squares).max() < 1e-3 * np.abs(squares).max()
