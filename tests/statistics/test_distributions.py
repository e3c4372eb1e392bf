"""Distributions against SciPy."""

from __future__ import annotations

import pytest
from scipy import special

from orthocal.statistics.distributions import (
    chi_square_tail,
    f_tail,
    incomplete_beta,
    normal_quantile,
    t_quantile,
)

RELATIVE = {"rel": 1e-11, "abs": 0.0}
"""The logarithms of the gamma function lose digits where there are many degrees of freedom."""


@pytest.mark.parametrize("dof", [0.5, 1.0, 3.0, 12.0, 1000.0])
def test_distributions_agree_with_scipy(dof):
    for value in (1e-6, 0.5, 1.0, 0.9 * dof, dof, 2.0 * dof, 5.0 * dof):
        expected = special.chdtrc(dof, value)
        assert chi_square_tail(dof, value) == pytest.approx(expected, **RELATIVE)
    for below in (1.0, 7.5, 50.0):
        for value in (0.01, 1.0, 10.0):
            expected = special.fdtrc(dof, below, value)
            assert f_tail(dof, below, value) == pytest.approx(expected, **RELATIVE)
    for share in (0.6, 0.975, 0.995):
        assert t_quantile(dof, share) == pytest.approx(special.stdtrit(dof, share), **RELATIVE)
        assert normal_quantile(share) == pytest.approx(special.ndtri(share), **RELATIVE)


def test_distributions_at_their_ends():
    assert chi_square_tail(3.0, 0.0) == 1.0
    assert chi_square_tail(3.0, float("inf")) == chi_square_tail(0.0, 1.0) == 0.0
    assert (incomplete_beta(0.5, 2.0, 0.0), incomplete_beta(0.5, 2.0, 1.0)) == (0.0, 1.0)
