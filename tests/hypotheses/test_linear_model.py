"""Linearised model about several machines at once, and its caches."""

from __future__ import annotations

import numpy as np
import pytest
from calibrated import session_of
from scipy.linalg import null_space
from scipy.stats import multivariate_normal

from orthocal import join_sessions
from orthocal.hypotheses import linear_model as module
from orthocal.hypotheses.hypothesis import MachineShift
from orthocal.hypotheses.linear_model import LinearModel, linear_model
from orthocal.hypotheses.linearisation import LinearisationPoint
from orthocal.measurement.joining import split_sessions


@pytest.fixture(scope="module")
def joined():
    return join_sessions([session_of(name) for name in ("raw-cycles", "workshop")])


@pytest.fixture(scope="module")
def model(joined):
    return LinearModel(joined)


def points(model, rng, *, unreachable=()):
    """Machines with errors of half their tolerances; the last two have machine shifts."""
    start, n = model.problem.active_passive, model.problem.n_free
    changes = [
        MachineShift(model.sessions.of_entry == 1, rng.normal(size=n)),
        MachineShift(model.sessions.of_entry == 0, 0.3 * rng.normal(size=n)),
    ]
    return [
        LinearisationPoint(
            1e3 * np.ones(n) if i in unreachable else 0.5 * rng.normal(size=n),
            changes[: max(0, i - 1)],
            start,
        )
        for i in range(4)
    ]


@pytest.mark.parametrize(("unreachable", "most"), [((), 1600), ((), 100), ((1,), 1600)])
def test_several_machines_are_linearised_like_single_ones(model, unreachable, most, monkeypatch):
    monkeypatch.setattr(module, "MAX_LINEARISED_ENTRIES", most)
    chosen = points(model, np.random.default_rng(3), unreachable=unreachable)
    together = model.linearise_all(chosen, keep_jacobian=True)
    assert [i for i, one in enumerate(together) if one is None] == list(unreachable)
    for point, found in zip(chosen, together, strict=True):
        if found is None:
            continue
        alone = model.linearise(point.theta, point.shifts, point.start, keep_jacobian=True)
        scale = np.abs(alone.jacobian).max()
        assert np.abs(found.jacobian - alone.jacobian).max() < 1e-12 * scale
        assert np.abs(found.expected - alone.expected).max() < 1e-12 * scale
        assert np.abs(found.passive - alone.passive).max() < 1e-12
        assert np.array_equal(found.theta, point.theta)


def test_a_machine_shift_changes_the_readings_of_its_sessions(model):
    plain, _, changed, _ = points(model, np.random.default_rng(3))
    later = model.sessions.of_entry == 1
    given = LinearisationPoint(plain.theta, changed.shifts, plain.start)
    without, found = model.linearise_all([plain, given], keep_jacobian=True)
    assert np.array_equal(found.jacobian[~later], without.jacobian[~later])
    assert np.abs(found.jacobian - without.jacobian)[later].max() > 1e-8


@pytest.mark.parametrize("name", ["raw-cycles", "linear_delta"])
def test_the_density_of_readings_is_that_of_their_contrasts(name):
    model = LinearModel(session_of(name))
    o, at = model.problem.observations, model.at_reference(keep_jacobian=True)
    free = model.problem.zero_incidence[:, ~o.zero_known]
    contrasts = null_space(free.T).T if free.size else np.eye(o.size)
    deviation = contrasts.T @ np.random.default_rng(2).normal(size=len(contrasts)) * model.sigma
    scales = np.array([0.5, 1.0, 3.0])
    rows = contrasts @ at.jacobian
    covariances = (rows @ rows.T + (s * model.sigma) ** 2 * np.eye(len(contrasts)) for s in scales)
    zero = np.zeros(len(contrasts))
    expected = [multivariate_normal(zero, c).logpdf(contrasts @ deviation) for c in covariances]
    products = at.likelihood.products(deviation[None])
    (found,) = at.likelihood.log_densities(products, np.ones(1), scales)
    assert np.diff(found) == pytest.approx(np.diff(expected))


def test_the_model_of_the_same_rows_is_built_once(joined):
    assert linear_model(joined).problem.model is linear_model(joined).problem.model
    for one, other in zip(split_sessions(joined), split_sessions(joined), strict=True):
        assert one is other
        # the complete model by its name, with other readings
        named = linear_model(one.with_values(one.values + 1e-5), "full")
        assert named.problem.model is linear_model(one).problem.model
    values = joined.values + 1e-5 * (np.arange(joined.values.size) % 3)
    changed = linear_model(joined.with_values(values))
    # the noise of several gauges depends on the readings
    assert changed.problem.model is not linear_model(joined).problem.model


def test_the_most_likely_machine_is_that_of_the_readings(joined):
    one, _ = split_sessions(joined)
    first = linear_model(one).most_likely(one.values)
    assert linear_model(one).most_likely(one.values) is first
    other = linear_model(one).most_likely(1.1 * one.values)
    assert np.abs(other.theta - first.theta).max() > 1e-3
    again = LinearModel(one).most_likely(one.values)
    assert np.abs(again.theta - first.theta).max() < 1e-9
