"""Noise and covariance: hand-solved cases first, then sampling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrated import plan_of
from gauges import exact
from intervals import assert_coverage, coverage_band
from models import TRUTH
from scipy import stats
from tolerances import KINEMATICS

from orthocal import calibrate
from orthocal.errors import NotIdentifiableError
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import Observations, build_observations
from orthocal.statistics.chance import (
    chance_of_equal_readings,
    chance_of_excess,
    confidence_factor,
    coverage_factor,
    expanded_uncertainty,
)
from orthocal.statistics.information import Information, decompose, marginalise
from orthocal.statistics.noise import Noise, estimate_noise, estimate_repeatability


def observations(setup, posture, zero):
    s, p, z = (np.array(v, dtype=np.int64) for v in (setup, posture, zero))
    n = int(z.max()) + 1
    place = np.unique(np.column_stack([s, p]), axis=0, return_inverse=True)[1].reshape(-1)
    return Observations(
        setup=s,
        posture=p,
        zero=z,
        n_zeros=n,
        zero_setup=("s",) * n,
        zero_real=(True,) * n,
        zero_known=np.zeros(n, dtype=np.bool_),
        plus=np.arange(len(s)),
        minus=np.full(len(s), -1),
        state=p,
        second=np.full(len(s), -1),
        place=place,
        conditions={},
        states=None,
    )


def test_covariance_of_a_line_solved_by_hand():
    """y = a u + zero at u = −1, 0, 2: the slope has variance σ²/Σ(u − ū)² = σ²/(14/3)."""
    o = observations([0, 0, 0], [0, 1, 2], [0, 0, 0])
    information, square = decompose(np.array([[-1.0], [0.0], [2.0]]), o), 14 / 3
    free, weighed = (information.posterior(sigma=0.3, precision=np.array([p])) for p in (0.0, 1.0))
    assert free.covariance[0, 0] == pytest.approx(0.3**2 / square, rel=KINEMATICS)
    # with a prior of one: precisions add
    expected = 1.0 / (1.0 + square / 0.3**2)
    assert weighed.covariance[0, 0] == pytest.approx(expected, rel=KINEMATICS)
    share = square / (square + 0.3**2)
    assert weighed.effective_parameters == pytest.approx(share, rel=KINEMATICS)


def test_dependent_columns_reduce_the_rank():
    o = observations([0] * 3, [0, 1, 2], [0] * 3)
    u = np.array([-1.0, 0.0, 1.0])
    information = decompose(np.column_stack([u, 2 * u, u**2]), o)
    assert information.rank == 2
    assert list(information.identifiable) == [False, False, True]


def test_repeatability_solved_by_hand():
    """Two postures twice: ±1 and ±2 around their means, 4 readings less 2 means."""
    o = observations([0] * 4, [0, 1, 0, 1], [0] * 4)
    sigma, dof = estimate_repeatability(np.array([1.0, 7.0, -1.0, 3.0]), o)
    assert dof == 2
    assert sigma == pytest.approx(np.sqrt((1 + 1 + 4 + 4) / 2))


@pytest.mark.parametrize("of_differences", [False, True])
def test_the_repeatability_of_many_readings_needs_no_large_system(monkeypatch, of_differences):
    """1000 postures with one zero twice, and 1000 zeros of differences between two postures."""
    places, systems, solve = np.tile(np.arange(1000), 2), [], np.linalg.lstsq
    monkeypatch.setattr(
        np.linalg, "lstsq", lambda a, *rest, **kw: systems.append(a.shape) or solve(a, *rest, **kw)
    )
    one = np.repeat([0, 1], 1000) if of_differences else np.zeros_like(places)
    o = observations(np.zeros_like(places), *((one, places) if of_differences else (places, one)))
    values = np.random.default_rng(0).normal(size=(2, 1000))
    values[1] += 3.0
    sigma, dof = estimate_repeatability(values.reshape(-1), o)
    differences = values[1] - values[0] - of_differences * (values[1] - values[0]).mean()
    assert dof == 1000 - of_differences
    assert sigma == pytest.approx(np.sqrt((differences**2).sum() / 2 / dof))
    assert max(columns for _, columns in systems) <= 2


def test_repeatability_of_differences_is_that_of_one_reading():
    plan = plan_of("raw-cycles")
    rows = [replace(r, minus="zero") for r in plan.readings if r.posture != "zero"]
    plan = replace(plan, readings=tuple(rows))
    o = build_observations(plan)
    entries = predict_readings(plan, TRUTH, observations=o)
    rng = np.random.default_rng(0)
    found = []
    for _ in range(60):
        rows = o.rows(entries + 0.01e-3 * rng.normal(size=o.size))
        sigma, dof = estimate_repeatability(o.values(rows), o)
        found.append(sigma**2)
    assert dof == 6 * 2 * 2  # six setups, two differences, three cycles less one
    assert np.mean(found) / (0.01e-3) ** 2 == pytest.approx(1.0, abs=4 * np.sqrt(2 / dof / 60))


def test_repeatability_without_repeats_is_unknown():
    sigma, dof = estimate_repeatability(np.array([1.0, 2.0]), observations([0, 0], [0, 1], [0, 0]))
    assert dof == 0
    assert np.isnan(sigma)


@pytest.mark.parametrize(
    ("repeatability", "square", "dof", "gauge", "source", "sigma"),
    [
        ((np.nan, 0), 12.0, 3.0, 0.1, "residuals", 2.0),
        ((np.nan, 0), 0.0, 0.0, 0.1, "gauge", 0.1),
        ((np.nan, 0), 0.0, 0.0, None, "unknown", np.nan),
        ((1.0, 10), 13.0, 13.0, 0.1, "cycles", 1.0),
        # 10 of the cycles, and 3 more with a mean square of 100: an F of 100
        ((1.0, 10), 310.0, 13.0, 0.1, "residuals", np.sqrt(310 / 13)),
    ],
)
def test_the_source_of_sigma(repeatability, square, dof, gauge, source, sigma):
    noise = estimate_noise(
        repeatability=repeatability, residual_square=square, residual_dof=dof, gauge_sigma=gauge
    )
    assert noise.source == source
    assert noise.sigma == pytest.approx(sigma, nan_ok=True)
    if repeatability[1] > 0:
        assert noise.exceeded_by_residuals(None) is (source == "residuals")


@pytest.mark.parametrize("given", [True, False])
def test_chances_of_residuals_from_noise_alone_are_uniform(given):
    """Twelve residuals, five of them the scatter of cycles."""
    rng = np.random.default_rng(1)
    rest, cycles = rng.chisquare(7, 4000), rng.chisquare(5, 4000)
    if given:
        chances = [chance_of_excess(r + c, 12) for r, c in zip(rest, cycles, strict=True)]
    else:  # sigma² is what the cycles say it is
        chances = [
            chance_of_excess((r + c) / (c / 5), 12, cycles_dof=5)
            for r, c in zip(rest, cycles, strict=True)
        ]
    assert stats.kstest(chances, "uniform").pvalue > 0.001
    assert chance_of_excess(3.0, 5, cycles_dof=5) == 1.0  # nothing beside the cycles


def test_confidence_factors_are_students():
    assert confidence_factor(3.0) == pytest.approx(3.182446, abs=1e-6)
    assert confidence_factor(np.inf) == pytest.approx(1.959964, abs=1e-6)
    assert confidence_factor(0.0) == np.inf


def test_expanded_uncertainty_is_twice_the_deviation_or_students_factor_of_the_noise():
    assert coverage_factor(np.inf) == 2.0
    assert coverage_factor(3.0) == confidence_factor(3.0)
    assert np.isnan(coverage_factor(0.0))
    assert expanded_uncertainty(3.0, 3.0, 0.0, noise_factor=2.0) == 6.0
    assert expanded_uncertainty([5.0], [0.0], [0.0], noise_factor=5.0, contrasts=2.0) == [10.0]
    both = expanded_uncertainty(5.0, 3.0, 0.0, noise_factor=confidence_factor(3.0))
    assert both == pytest.approx(np.hypot(3.0 * confidence_factor(3.0), 8.0))
    # 1² + 2² + 2² = 3²: noise, scaled errors, priors of known size
    each = expanded_uncertainty(3.0, 1.0, 2.0, noise_factor=confidence_factor(3.0), contrasts=4.0)
    factors = np.array([confidence_factor(3.0), confidence_factor(4.0), 2.0])
    assert each == pytest.approx(np.linalg.norm(factors * [1.0, 2.0, 2.0]))


@pytest.mark.parametrize("contrasts", [2, 3, 6])
def test_expanded_uncertainty_covers_estimated_and_known_parts(contrasts):
    """At least 95 % of sums, and of one estimated part alone; effective degrees of freedom do not.

    The sum x has the known variance 1 and the variance v² of scaled errors, which is estimated.
    """
    count, rng = 20000, np.random.default_rng(1)
    low, high = coverage_band(count)
    normal, factor = rng.normal(size=count), rng.chisquare(contrasts, size=count) / contrasts
    alone = expanded_uncertainty(
        factor**0.5, 0.0, factor**0.5, noise_factor=2.0, contrasts=contrasts
    )
    assert low <= (np.abs(normal) <= alone).sum() <= high
    for v2 in (0.1, 1.0, 3.0, 10.0):
        scaled = v2 * factor
        x = np.sqrt(1.0 + v2) * normal
        half = expanded_uncertainty(
            np.sqrt(1.0 + scaled), 0.0, np.sqrt(scaled), noise_factor=2.0, contrasts=contrasts
        )
        assert (np.abs(x) <= half).sum() >= low
        if contrasts == 2 and v2 == 3.0:
            effective = (1.0 + scaled) ** 2 / (scaled**2 / contrasts)
            welch = stats.t.ppf(0.975, effective) * np.sqrt(1.0 + scaled)
            assert np.mean(np.abs(x) <= welch) == pytest.approx(0.93, abs=0.005)


def test_parts_of_a_covariance_are_those_of_the_errors_that_cause_them():
    """Errors of the estimate are linear in the noise and in the parameters less their means."""
    rng, sigma = np.random.default_rng(2), 0.3
    jacobian, precision = rng.normal(size=(7, 5)), np.array([1.0, 0.0, 1.0, 1.0, 1.0])
    scaled, held = np.array([0, 0, 1, 1, 0], dtype=bool), np.array([0, 0, 0, 1, 0], dtype=bool)
    information, free = Information(jacobian), ~held
    inverse = np.zeros((5, 5))
    rows = jacobian[:, free] / sigma
    normal = rows.T @ rows + np.diag(precision[free])
    inverse[np.ix_(free, free)] = np.linalg.inv(normal)
    known = {"sigma": sigma, "precision": precision, "at_bound": held}
    found = information.posterior(**known).prior_covariance(scaled)
    assert found == pytest.approx(np.outer(inverse[:, 2], inverse[2]))
    for loss in ((1.0, 1.0), (0.8, 0.6)):
        posterior = information.posterior(loss=loss, **known)
        parts = sum(posterior.prior_covariance(priors) for priors in (scaled, ~scaled))
        assert parts + posterior.noise_covariance == pytest.approx(posterior.covariance)


def test_undetermined_offsets_are_named(raw_cycles):
    rows = tuple(r for r in raw_cycles.readings if r.setup == "yx")
    with pytest.raises(NotIdentifiableError, match=r"do not determine z_slide\.offset") as caught:
        calibrate(replace(raw_cycles, readings=rows))
    assert caught.value.parameters == ("z_slide.offset",)


def test_predicted_covariance_is_that_of_many_simulated_calibrations():
    """The whitened errors of the complete model are standard normal in all directions."""
    sigma = 20e-6
    problem = build_problem(exact(plan_of("raw-cycles")), model="full", prior=True)
    rng = np.random.default_rng(0)
    truths = rng.normal(size=(200, problem.n_free))
    entries, _, reached = problem.simulate(truths * problem.theta_scale)
    assert reached.all()
    measured = entries + sigma * rng.normal(size=entries.shape)
    solved = BatchSolver(problem).solve(measured, sigma=sigma)
    _, found, reached = problem.simulate(solved.theta)
    assert reached.all()
    whitened = []
    _, jacobians = problem.predict_and_jacobian(solved.theta, found)
    for truth, theta, jacobian in zip(truths, solved.theta, jacobians, strict=True):
        covariance = (
            decompose(jacobian, problem.observations)
            .posterior(sigma=sigma, precision=problem.prior_precision)
            .covariance
        )
        error = theta / problem.theta_scale - truth
        whitened.append(np.linalg.solve(np.linalg.cholesky(covariance), error))
    z = np.array(whitened)
    n = len(z)
    assert np.abs(z.mean(axis=0)).max() < 4.5 / np.sqrt(n)
    assert np.abs(np.mean(z**2, axis=0) - 1.0).max() < 4.5 * np.sqrt(2.0 / n)
    # upper edge of Marchenko and Pastur for a sample covariance of white noise
    largest = np.linalg.eigvalsh(z.T @ z / n).max()
    assert largest < (1.0 + np.sqrt(z.shape[1] / n)) ** 2 + 0.15
    assert_coverage(z)


@pytest.mark.parametrize("rows", [4, 9, 40])
def test_a_covariance_is_the_inverse_of_the_sum_of_both_informations(rows):
    rng = np.random.default_rng(rows)
    factor, sigma = rng.normal(size=(rows, 6)), 0.3
    precision = np.array([1.0, 1.0, 1.0, 1e-3, 1.0, 1.0])
    found = Information(factor).posterior(sigma=sigma, precision=precision).covariance
    expected = np.linalg.inv(factor.T @ factor / sigma**2 + np.diag(precision))
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_an_information_without_readings_has_no_rank():
    information = Information(np.zeros((0, 2)))
    assert information.rank == 0
    assert not information.identifiable.any()


def test_chance_of_equal_readings():
    """Two dials are read to 10 µm with scatter of 5 µm, at any phase of their scale."""
    rng = np.random.default_rng(0)
    actual = rng.uniform(-1.0, 1.0, 200_000)
    one, other = (np.round((actual + rng.normal(0.0, 5e-3, actual.size)) / 0.01) for _ in "ab")
    single = chance_of_equal_readings(1, 1, sigma=5e-6, step=1e-5)
    assert np.mean(one == other) == pytest.approx(single, abs=0.005)
    assert chance_of_equal_readings(2, 3, sigma=5e-6, step=1e-5) == pytest.approx(
        stats.binom.sf(1, 3, single)
    )
    assert chance_of_equal_readings(9, 9, sigma=0.0, step=1e-5) == 1.0
    assert chance_of_equal_readings(0, 9, sigma=5e-6, step=1e-5) == 1.0
    many = chance_of_equal_readings(700, 2000, sigma=5e-6, step=1e-5)
    assert many == pytest.approx(stats.binom.sf(699, 2000, single))


def test_the_chance_of_an_excess_over_cycles_is_an_f_test():
    """Residuals of 12 degrees, 5 of them the cycles' own; or χ² of a given σ."""
    chi_square = 5 + 7 * 4.0  # beside the cycles' own 5: F(7, 5) at 4.0, χ² of 12 at 33
    expected = stats.f.sf(4.0, 7, 5)
    assert chance_of_excess(chi_square, 12, cycles_dof=5.0) == pytest.approx(expected)
    assert chance_of_excess(chi_square, 12) == pytest.approx(stats.chi2.sf(chi_square, 12))


@pytest.mark.parametrize(
    ("noise", "gauge", "more", "less"),
    [
        (Noise(1.0, 9.0, "residuals", np.nan, 0, 1.0, 9.0), 1.0, False, False),
        (Noise(3.0, 9.0, "residuals", np.nan, 0, 3.0, 9.0), 1.0, True, False),
        (Noise(0.1, 9.0, "residuals", np.nan, 0, 0.1, 9.0), 1.0, False, True),
        (Noise(3.0, 9.0, "residuals", np.nan, 0, 3.0, 9.0), None, None, None),
        (Noise(3.0, 9.0, "residuals", 1.0, 12, 3.0, 9.0), 1.0, True, False),
        (Noise(3.0, 12.0, "cycles", 3.0, 12, 3.0, 9.0), 1.0, False, False),
        (Noise(1.0, np.inf, "gauge", np.nan, 0, np.nan, 0.0), 1.0, False, None),
        (Noise(np.nan, 0.0, "unknown", np.nan, 0, np.nan, 0.0), None, None, None),
    ],
)
def test_residuals_against_the_noise_of_the_gauge(noise, gauge, more, less):
    assert noise.exceeded_by_residuals(gauge) is more
    assert noise.exceeds_residuals(gauge) is less


def test_marginal_information_is_that_of_the_complete_covariance():
    """The covariance of the first parameters beside a prior on the others: Schur's complement."""
    rng = np.random.default_rng(2)
    jacobian, sigma = rng.normal(size=(12, 5)), 0.3
    o = observations([0] * 12, list(range(12)), [0] * 12)
    whole = decompose(jacobian, o)
    kept = marginalise(whole, 3, sigma=sigma)
    prior = np.array([0.0, 0.0, 0.0, 1.0, 1.0])
    expected = whole.posterior(sigma=sigma, precision=prior).covariance[:3, :3]
    found = kept.posterior(sigma=sigma, precision=np.zeros(3)).covariance
    assert found == pytest.approx(expected, rel=1e-9)
    alone = decompose(jacobian[:, :3], o).posterior(sigma=sigma, precision=np.zeros(3)).covariance
    assert (np.diag(alone) < 0.99 * np.diag(expected)).all()
