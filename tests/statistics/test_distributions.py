"""Distributions in cases with a closed form."""

from __future__ import annotations

import math
import warnings
from statistics import NormalDist

import numpy as np
import pytest
from tolerances import KINEMATICS

from orthocal.statistics.distributions import (
    chi_square_tail,
    f_tail,
    incomplete_beta,
    log_chi_square_tail,
    median_of_largest,
    t_quantile,
)

RELATIVE = {"rel": 1e3 * KINEMATICS, "abs": 0.0}


@pytest.mark.parametrize("value", [1e-6, 0.5, 3.0, 40.0])
def test_tails_with_two_degrees_of_freedom(value):
    assert chi_square_tail(2.0, value) == pytest.approx(math.exp(-0.5 * value), **RELATIVE)
    expected = (1.0 + 2.0 * value / 7.5) ** (-0.5 * 7.5)
    assert f_tail(2.0, 7.5, value) == pytest.approx(expected, **RELATIVE)


@pytest.mark.parametrize("share", [0.6, 0.975, 0.995])
def test_quantiles(share):
    """One and two degrees of freedom; many ones are those of the normal distribution."""
    cauchy = math.tan(math.pi * (share - 0.5))
    assert t_quantile(1.0, share) == pytest.approx(cauchy, **RELATIVE)
    centred = 2.0 * share - 1.0
    expected = centred * math.sqrt(2.0 / (1.0 - centred**2))
    assert t_quantile(2.0, share) == pytest.approx(expected, **RELATIVE)
    assert t_quantile(1e8, share) == pytest.approx(NormalDist().inv_cdf(share), rel=1e-6)


def test_constants_do_not_change_the_median_of_the_largest():
    with warnings.catch_warnings(action="error"):
        with_constant = median_of_largest(np.array([0.0, 2.0, 1.0]))
    assert with_constant == median_of_largest(np.array([2.0, 1.0]))


def test_distributions_at_their_ends():
    assert chi_square_tail(3.0, 0.0) == 1.0
    assert chi_square_tail(3.0, float("inf")) == chi_square_tail(0.0, 1.0) == 0.0
    assert (incomplete_beta(0.5, 2.0, 0.0), incomplete_beta(0.5, 2.0, 1.0)) == (0.0, 1.0)


@pytest.mark.parametrize("stds", [[2.0], [1.0] * 10, [0.1, 1.0, 3.0]])
def test_the_median_of_the_largest_is_that_of_samples(stds):
    drawn = np.random.default_rng(1).normal(size=(40_000, len(stds))) * stds
    largest = np.abs(drawn).max(axis=1)
    assert median_of_largest(np.array(stds)) == pytest.approx(np.median(largest), rel=0.02)


@pytest.mark.parametrize("value", [1.0, 1400.0, 2000.0, 1e6])
def test_logarithms_of_tails_too_small_for_a_number(value):
    """For an even number of degrees of freedom the tail is a finite sum."""
    x = 0.5 * value
    assert log_chi_square_tail(2.0, value) == pytest.approx(-x, **RELATIVE)
    assert log_chi_square_tail(4.0, value) == pytest.approx(math.log1p(x) - x, rel=1e-8)
    expected = math.log(1.0 + x + 0.5 * x**2) - x
    assert log_chi_square_tail(6.0, value) == pytest.approx(expected, rel=1e-8)
