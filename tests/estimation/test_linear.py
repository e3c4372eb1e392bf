"""Equation (8): coefficients, singular values, standard errors, and first-order agreement."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from gauges import exact
from tolerances import KINEMATICS, PRINTED

from orthocal.errors import NotIdentifiableError
from orthocal.estimation.linear import (
    TWELVE_ROWS,
    LinearProblem,
    invert_equation_8,
    leg_parallelism_matrix,
    linearise_problem,
    twelve_row_covariance,
)
from orthocal.estimation.problem import build_problem

GEOMETRY = {"length": 0.31025, "displacement_max": 0.06, "displacement_min": -0.10}


def test_coefficients_are_those_of_equation_7():
    matrix = leg_parallelism_matrix(**GEOMETRY)
    assert matrix.shape == (12, 3)
    assert np.abs(matrix[TWELVE_ROWS.index("yx+")] - [0.13668, 0.19339, 0]).max() < PRINTED
    assert np.abs(matrix[TWELVE_ROWS.index("yx-")] - [-0.06050, -0.32232, 0]).max() < PRINTED
    # the last block of (8) is (Δx_z, Δz_x)
    assert np.abs(matrix[TWELVE_ROWS.index("xz+")] - [0.19339, 0, 0.13668]).max() < PRINTED


def test_singular_values_of_the_six_equations():
    values = np.linalg.svd(leg_parallelism_matrix(**GEOMETRY, rows=6), compute_uv=False)
    assert np.abs(values - [1.00818, 0.63742, 0.63742]).max() < PRINTED


@pytest.mark.parametrize(
    ("fraction_from_tcp", "expected"), [(0.5, 1.4031), (0.2, 1.3448), (0.65, 1.3914)]
)
def test_standard_errors_of_the_six_equations(fraction_from_tcp, expected):
    matrix = leg_parallelism_matrix(**GEOMETRY, rows=6, fraction_from_tcp=fraction_from_tcp)
    inverse = invert_equation_8(matrix)
    cofactor = inverse @ inverse.T
    assert np.abs(np.sqrt(np.diag(cofactor)) - expected).max() < 0.00006
    if fraction_from_tcp == 0.5:
        correlation = cofactor[0, 1] / cofactor[0, 0]
        assert abs(correlation + 0.25) < 0.005


def test_standard_errors_per_reading_of_the_three_ways():
    six, twelve = (leg_parallelism_matrix(**GEOMETRY, rows=n) for n in (6, 12))
    covariance = twelve_row_covariance()
    assert np.array_equal(covariance[:3, :3], [[2, 0, 1], [0, 2, 0], [1, 0, 2]])

    def per_reading(matrix, rows_covariance, weighting):
        estimator = invert_equation_8(matrix, covariance=weighting)
        spread = estimator @ rows_covariance @ estimator.T
        if weighting is not None:
            cofactor = np.linalg.inv(matrix.T @ np.linalg.inv(weighting) @ matrix)
            assert np.abs(spread - cofactor).max() < KINEMATICS
        return np.sqrt(spread[0, 0])

    assert abs(per_reading(six, 2 * np.eye(6), None) - 1.984) < 0.0006
    assert abs(per_reading(twelve, covariance, None) - 2.066) < 0.0006
    assert abs(per_reading(twelve, covariance, covariance) - 1.942) < 0.0006


def test_the_rank_of_the_rows_does_not_depend_on_their_unit():
    matrix = leg_parallelism_matrix(**GEOMETRY, rows=6)
    offsets = np.array([1e-3, -2e-3, 0.5e-3])
    found = invert_equation_8(1e-11 * matrix) @ (1e-11 * (matrix @ offsets))
    assert found == pytest.approx(offsets, rel=1e-9)


def test_rows_of_one_leg_do_not_determine_three_offsets():
    with pytest.raises(NotIdentifiableError) as refused:
        invert_equation_8(leg_parallelism_matrix(**GEOMETRY, rows=6)[[2, 3]])
    assert refused.value.parameters == ("x_slide.offset", "y_slide.offset", "z_slide.offset")


def test_the_closed_loop_model_agrees_to_first_order_with_equation_8(experiment_2):
    """Six differences of the URDF's model against the reduced system, rows and solution."""
    problem = build_problem(exact(experiment_2), model="offsets")
    _, jacobian = problem.predict_and_jacobian(problem.active_theta)
    slopes = problem.observations.rows(jacobian) / problem.theta_scale
    matrix = leg_parallelism_matrix(**GEOMETRY, rows=6)
    assert np.abs(slopes - matrix).max() < 1e-11
    theta = linearise_problem(problem).solve(sigma=1e-5)
    expected = invert_equation_8(matrix) @ experiment_2.values
    assert np.abs(theta - expected).max() < 1e-13


def test_twelve_generalised_rows_are_raw_readings_with_their_zeros(exact_plan):
    """Raw readings of zero, max and min, zeros eliminated, are equation (8) with its covariance."""
    rng = np.random.default_rng(0)
    session = exact_plan.with_values(1e-3 * rng.normal(size=len(exact_plan.readings)))
    problem = build_problem(session, model="offsets")
    theta = linearise_problem(problem).solve(sigma=1e-5)
    means = {}
    for r in session.readings:
        means.setdefault((r.setup, r.posture), []).append(r.value)
    means = {k: np.mean(v) for k, v in means.items()}
    differences = [
        means[name[:2], f"{name[1]}_{'max' if name[2] == '+' else 'min'}"] - means[name[:2], "zero"]
        for name in TWELVE_ROWS
    ]
    inverse = invert_equation_8(
        leg_parallelism_matrix(**GEOMETRY), covariance=twelve_row_covariance()
    )
    assert np.abs(theta - inverse @ differences).max() < 1e-12


def test_small_residuals_have_their_optimum_within_bounds():
    """There the objective has no gradient, but towards a bound."""
    bounds = SimpleNamespace(lower=np.zeros(8), upper=np.full(8, np.inf))
    none = {"active_theta": np.zeros(8), "prior_precision": np.zeros(8), "has_prior": False}
    problem = SimpleNamespace(n_free=8, theta_scale=np.ones(8), selection=bounds, **none)
    rng = np.random.default_rng(0)
    for _ in range(40):
        jacobian, residual = 2e-5 * rng.normal(size=(12, 8)), 2e-6 * rng.normal(size=12)
        found = LinearProblem(problem, residual, jacobian, None).solve(sigma=1e-6)
        descent = jacobian.T @ (residual - jacobian @ found)
        largest = 1e-9 * np.linalg.norm(jacobian) * np.linalg.norm(residual)
        inside = found > 1e-12 * found.max()
        assert np.abs(descent[inside]).max(initial=0.0) < largest
        assert descent[~inside].max(initial=0.0) < largest
