"""Tails and quantiles against SciPy's."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import special

from orthocal.statistics.distributions import (
    beta_share,
    chi_square_quantile,
    chi_square_tail,
    f_tail,
    normal_quantile,
    t_quantile,
)

AGREES = 5e-11
"""Of themselves: log Γ(2,500) is 17,000, of which rounding takes 4e-12, and there are three."""

DOFS = [0.3, 1.0, 2.0, 3.0, 7.5, 30.0, 161.0, 5000.0]


@pytest.mark.parametrize("dof", DOFS)
def test_chi_square(dof):
    for value in [1e-6, 0.1, 1.0, *(dof * np.array([0.3, 0.8, 0.99, 1.0, 1.02, 1.3, 3.0]))]:
        found = chi_square_tail(dof, float(value))
        assert found == pytest.approx(special.chdtrc(dof, value), rel=AGREES, abs=1e-300)
    for tail in (1e-6, 0.01, 0.3, 0.95):
        found = chi_square_quantile(dof, tail)
        assert found == pytest.approx(special.chdtri(dof, tail), rel=AGREES)


@pytest.mark.parametrize("dof", DOFS)
@pytest.mark.parametrize("below", DOFS)
def test_f(dof, below):
    for value in (1e-4, 0.2, 0.9, 1.0, 1.1, 2.5, 40.0):
        expected = special.fdtrc(dof, below, value)
        assert f_tail(dof, below, value) == pytest.approx(expected, rel=AGREES, abs=1e-200)
        share = value / (1.0 + value)
        expected = special.betainc(0.5 * dof, 0.5 * below, share)
        assert beta_share(0.5 * dof, 0.5 * below, share) == pytest.approx(
            expected, rel=AGREES, abs=1e-200
        )


@pytest.mark.parametrize("dof", [1.0, 2.0, 3.0, 7.5, 30.0, 161.0, 5000.0])
def test_t(dof):
    for share in (0.01, 0.3, 0.5, 0.84, 0.975, 0.9999):
        expected = special.stdtrit(dof, share)
        assert t_quantile(dof, share) == pytest.approx(expected, rel=AGREES, abs=1e-14)


def test_normal():
    for share in (1e-9, 0.01, 0.5, 0.8, 0.975, 1.0 - 1e-9):
        assert normal_quantile(share) == pytest.approx(special.ndtri(share), rel=1e-13, abs=1e-15)


def test_ends_and_nonsense():
    assert (chi_square_tail(3.0, 0.0), chi_square_tail(3.0, math.inf)) == (1.0, 0.0)
    assert (f_tail(3.0, 4.0, 0.0), f_tail(3.0, 4.0, math.inf)) == (1.0, 0.0)
    assert (normal_quantile(0.0), normal_quantile(1.0)) == (-math.inf, math.inf)
    assert (beta_share(2.0, 3.0, 0.0), beta_share(2.0, 3.0, 1.0)) == (0.0, 1.0)
    for nonsense in (
        chi_square_tail(0.0, 1.0),
        chi_square_tail(3.0, math.nan),
        f_tail(0.0, 1.0, 1.0),
        f_tail(1.0, 1.0, math.nan),
        t_quantile(0.0, 0.9),
        t_quantile(3.0, 1.0),
        chi_square_quantile(3.0, 0.0),
        normal_quantile(1.5),
    ):
        assert math.isnan(nonsense)
