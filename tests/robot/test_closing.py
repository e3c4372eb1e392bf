"""Damped least squares: where it ends, on functions whose zeros are known."""

from __future__ import annotations

import numpy as np
import pytest
from tolerances import CLOSED, KINEMATICS

from orthocal.robot.closing import RANK_TOLERANCE, close_loops, describe_opening, invert_closures


def close(evaluate, start, **options):
    residual, jacobian = evaluate(np.asarray(start, dtype=float))
    units = {"row_units": np.ones(len(residual)), "units": np.ones(jacobian.shape[1])}
    return close_loops(evaluate, start, **{**units, **options})


def test_steps_that_overshoot_are_shortened():
    """The root of arctan from 3: Newton's own steps grow without end, and half a unit is cut."""
    found = close(lambda x: (np.arctan(20 * x), np.diag(20 / (1 + 400 * x**2))), [3.0])
    assert found.closed
    assert abs(found.coordinates[0]) < CLOSED


def test_a_curved_valley_is_followed():
    def evaluate(x):
        residual = np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])
        return residual, np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])

    found = close(evaluate, [-1.2, 1.0])
    assert np.abs(found.coordinates - 1.0).max() < CLOSED


def test_rows_that_repeat_others_and_free_coordinates_do_no_harm():
    """Of all zeros the one straight ahead: what no row sees stays where it is."""
    matrix = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0]])
    found = close(lambda x: (matrix @ x - [0.2, 0.4], matrix), [0.0, 0.0, 0.7])
    assert found.closed
    assert np.abs(found.coordinates - [0.1, 0.1, 0.7]).max() < CLOSED


def test_bounds_hold_and_the_others_go_on():
    matrix = np.array([[1.0, 1.0]])
    found = close(
        lambda x: (matrix @ x - 1.0, matrix), [0.0, 0.0], bounds=([-1.0, -1.0], [0.1, 5.0])
    )
    assert np.abs(found.coordinates - [0.1, 0.9]).max() < CLOSED


def test_what_cannot_be_closed_ends_at_the_nearest_and_says_so():
    """Rows that contradict each other: 0.1 apart, half of it each, in a bounded number of steps."""
    calls = []

    def evaluate(x):
        calls.append(x)
        return np.array([x[0], x[0] - 0.1]), np.ones((2, 1))

    found = close(evaluate, [3.0])
    assert not found.closed
    assert abs(found.coordinates[0] - 0.05) < 1e-6
    assert len(calls) < 300


def test_numbers_that_are_none_end_it():
    found = close(lambda x: (x + np.nan, np.eye(1)), [1.0])
    assert not found.closed


@pytest.mark.parametrize(
    ("residual", "words"),
    [
        ([3.2e-3, -1e-3, 8e-4], "3.2 mm and 0.8 mrad"),
        ([0.05, 0.0, 1e-14], "50 mm"),
        ([0.0, 1e-15, -0.0125], "12.5 mrad"),
        ([1e-11, 0.0, 0.0], "1e-08 mm"),
    ],
)
def test_metres_and_radians_are_told_apart(residual, words):
    assert describe_opening(residual, [False, False, True]) == words


@pytest.mark.parametrize("shape", [(2, 4, 5, 5), (3, 6, 5), (3, 4, 5)])
def test_closure_jacobians_are_inverted_one_by_one(shape):
    """More rows than coordinates, or fewer: the shortest least-squares change."""
    jacobians = np.random.default_rng(1).normal(size=shape)
    inverses = invert_closures(jacobians)
    assert inverses.shape == (*shape[:-2], shape[-1], shape[-2])
    for index in np.ndindex(shape[:-2]):
        rows = np.eye(shape[-2])
        change = np.linalg.lstsq(jacobians[index], rows, rcond=RANK_TOLERANCE)[0]
        assert np.abs(inverses[index] - change).max() < KINEMATICS * np.abs(change).max()
