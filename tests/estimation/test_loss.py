"""Huber's smooth loss against its definition, and its scale against sampling."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import quad

from orthocal.errors import OrthocalError
from orthocal.estimation.loss import HUBER_WIDTH, SQUARES, Loss

HUBER = Loss("huber")


def evaluate(expression, r):
    residual, width = ca.SX.sym("r"), ca.SX.sym("k")
    f = ca.Function("f", [residual, width], [expression(residual, width)])
    return np.array([float(f(v, HUBER_WIDTH)) for v in np.atleast_1d(r)])


R = np.array([-30.0, -1.5, -1e-9, 0.0, 1e-5, 0.7, 4.0])


def test_it_is_the_pseudo_huber_loss():
    k = HUBER_WIDTH
    assert evaluate(HUBER.value, R) == pytest.approx(
        k**2 * (np.sqrt(1 + (R / k) ** 2) - 1), abs=1e-15
    )
    # a square for what is small, to the last digit; straight far out
    assert evaluate(HUBER.value, [1e-9])[0] == pytest.approx(0.5e-18, rel=1e-12)
    assert evaluate(HUBER.influence, [1e6])[0] == pytest.approx(k)


@pytest.mark.parametrize("loss", [HUBER, SQUARES])
def test_slope_and_curvature_are_its_derivatives(loss):
    step = 1e-4
    cost = (evaluate(loss.value, R + step) - evaluate(loss.value, R - step)) / (2 * step)
    slope = (evaluate(loss.influence, R + step) - evaluate(loss.influence, R - step)) / (2 * step)
    assert evaluate(loss.influence, R) == pytest.approx(cost, abs=1e-7)
    assert evaluate(loss.curvature, R) == pytest.approx(slope, abs=1e-7)
    assert evaluate(loss.weight, R[R != 0]) == pytest.approx(
        evaluate(loss.influence, R[R != 0]) / R[R != 0]
    )
    for function in (loss.value, loss.influence, loss.weight, loss.curvature):
        assert function(R) == pytest.approx(evaluate(function, R), rel=1e-14)
    curvature = evaluate(loss.curvature, R)
    assert loss.gain(R, used=0.0) == pytest.approx(curvature.mean())
    correction = 1.0 + 2.0 / R.size * curvature.var() / curvature.mean() ** 2
    assert loss.gain(R, used=2.0) == pytest.approx(curvature.mean() / correction)


def test_its_precision_on_normal_residuals_is_95_percent_of_squares():
    def normal(z):
        return np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)

    k = HUBER_WIDTH
    square = quad(lambda z: z**2 / (1 + (z / k) ** 2) * normal(z), -12, 12)[0]
    gain = quad(lambda z: (1 + (z / k) ** 2) ** -1.5 * normal(z), -12, 12)[0]
    assert HUBER.normal_square == pytest.approx(square, rel=1e-6)
    assert gain**2 / square == pytest.approx(0.95, abs=0.005)


def test_the_robust_scale_is_that_of_the_sound_residuals():
    rng = np.random.default_rng(0)
    r = 3.0 * rng.normal(size=20_000)
    sound = np.sqrt(HUBER.robust_square(r, dof=r.size, start=1.0) / r.size)
    assert sound == pytest.approx(3.0, rel=0.02)
    r[:400] = 300.0
    spoilt = np.sqrt(HUBER.robust_square(r, dof=r.size, start=1.0) / r.size)
    assert spoilt == pytest.approx(3.0, rel=0.06)
    assert SQUARES.robust_square(r, dof=r.size, start=1.0) == pytest.approx(r @ r)


def test_nonsense_is_refused():
    with pytest.raises(OrthocalError, match="the loss is 'cubes'; expected squares or huber"):
        Loss("cubes")
    with pytest.raises(OrthocalError, match="expected more than 0"):
        Loss("huber", width=0.0)


@pytest.mark.parametrize("seed", range(5))
def test_centres_are_found_among_values_that_are_far_out(seed):
    """A hundred standard deviations apart: steps by the curvature alone go to and fro there."""
    rng = np.random.default_rng(seed)
    values = rng.choice([1.0, 30.0, 1000.0], size=60) * rng.normal(size=60)
    group, loss = np.arange(60) % 6, Loss("huber")
    weights = rng.uniform(0.5, 2.0, size=60)
    found = loss.centres(values, group, 6, weights=weights)
    pull = np.bincount(group, weights * loss.influence(values - found[group]))
    assert np.abs(pull).max() < 1e-9
