"""Identifiability: hand-made Jacobians, then real plans."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from calibrated import plan_of, session_of
from conftest import ROOT
from gauges import exact
from models import JOINTS

from orthocal import Choice, calibrate, load_session, simulate_session
from orthocal.calibration.build_record import assemble_calibration
from orthocal.calibration.identify import identify
from orthocal.errors import NotIdentifiableError, ParameterError
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import build_problem
from orthocal.robot.parameters import Parameter
from orthocal.statistics.identifiability import (
    Combination,
    analyse_identifiability,
    find_base_parameters,
)
from orthocal.statistics.information import Information, decompose

QUICK = {"solver": "variable-projection"}


def parameters(*names, prior_stds=None):
    prior_stds = prior_stds or [1.0] * len(names)
    return [Parameter(n, "m", t, ((n, 1.0),)) for n, t in zip(names, prior_stds, strict=True)]


A = np.array([3.0, 0.0, 0.0, 0.0])
B = np.array([0.0, 2.0, 0.0, 0.0])
C = np.array([0.0, 0.0, 0.5, 0.0])


def analyse(columns, names, *, sigma=0.1, prior_stds=None):
    return analyse_identifiability(
        Information(np.column_stack(columns)),
        parameters(*names, prior_stds=prior_stds),
        sigma=sigma,
        n_postures=4,
        n_readings=4,
    )


def test_of_equal_columns_the_sum_is_identifiable_and_of_opposite_ones_the_difference():
    found = analyse([A, B, A], ["x_leg.length", "y.z", "x_slide.offset"])
    assert [c.words for c in found.alike] == ["x_leg.length and x_slide.offset: only their sum"]
    assert found.resolvable == ("y.z",)
    assert found.rank == 2
    found = analyse([A, -A], ["a", "b"])
    assert found.alike[0].words == "a and b: only their difference"


def test_coefficients_are_per_unit_not_per_tolerance():
    """One tolerance of b, 0.5, moves the readings as far as one of a, 2."""
    found = analyse([A, A, B], ["a", "b", "c"], prior_stds=[2.0, 0.5, 1.0])
    assert found.alike[0].terms == (("a", 1.0), ("b", pytest.approx(4.0)))
    assert found.alike[0].words == "a and b: only a + 4 b"


def test_parameters_with_effects_below_the_noise_are_unobservable():
    found = analyse([A, 0.01 * B, C], ["a", "b", "c"])
    assert found.below_noise == ("b",)
    assert found.rank == 2
    assert found.structural_rank == 3
    perfect = analyse([A, 0.01 * B, C], ["a", "b", "c"], sigma=0.0)
    assert perfect.below_noise == ()
    assert perfect.rank == 3


def test_base_parameters_regroup_dependent_columns():
    """The third column is the first plus half of the second."""
    found = find_base_parameters(
        np.column_stack([A, B, A + 0.5 * B]), parameters("a", "b", "c"), threshold=0.1
    )
    sums = {c.terms[0][0]: dict(c.terms) for c in found}
    assert len(sums) == 2
    # base parameters predict the readings of all parameters
    theta = {"a": 0.3, "b": -1.2, "c": 0.7}
    columns = {"a": A, "b": B, "c": A + 0.5 * B}
    whole = sum(columns[n] * v for n, v in theta.items())
    base = sum(
        columns[lead] * sum(k * theta[n] for n, k in terms.items()) for lead, terms in sums.items()
    )
    assert base == pytest.approx(whole, abs=1e-12)


def test_observability_indices_solved_by_hand():
    """Singular values 3, 2 and 0.5 in four postures."""
    o = analyse([A, B, C], ["a", "b", "c"]).observability
    assert o["O1"] == pytest.approx(3.0 ** (1 / 3) / 2.0)
    assert o["O2"] == pytest.approx(0.5 / 3.0)
    assert o["O3"] == pytest.approx(0.5)
    assert o["O4"] == pytest.approx(0.25 / 3.0)
    assert o["O5"] == pytest.approx(1.0 / (1 / 3 + 1 / 2 + 2))
    assert analyse([A, B, C], ["a", "b", "c"]).condition == pytest.approx(6.0)


def test_without_identifiable_parameters_indices_are_zero():
    found = analyse([0.01 * A], ["a"])
    assert found.rank == 0
    assert set(found.observability.values()) == {0.0}
    assert found.base == ()
    assert np.isinf(found.condition)


def test_combinations_are_described_in_words():
    c = Combination((("a", 1.0), ("b", -1.0), ("c", 0.31)))
    assert c.words == "a, b and c: only a − b + 0.31 c"
    assert Combination((("a", 1.0),)).words == "a: by itself"


@pytest.fixture(scope="module")
def jacobians():
    """Identification Jacobians of all errors about the nominal machine, of sweep and lines."""
    found = {}
    for name in ("sweep", "lines"):
        plan = exact(plan_of(name))
        problem = build_problem(plan, free=JOINTS, prior=True)
        _, jacobian = problem.predict_and_jacobian(np.zeros(problem.n_free))
        found[name] = problem, jacobian
    return found


@pytest.mark.parametrize(("plan", "rank"), [("sweep", 30), ("lines", 42)])
def test_the_base_parameters_of_a_plan_predict_every_reading(jacobians, plan, rank):
    """Their number is the rank."""
    problem, jacobian = jacobians[plan]
    found = decompose(jacobian, problem.observations)
    assert found.rank == rank
    smallest = 0.5 * found.singular_values[rank - 1]
    base = find_base_parameters(found.factor, problem.parameters, threshold=1e-3 * smallest)
    assert len(base) == rank
    index = {n: i for i, n in enumerate(problem.free)}
    theta = np.random.default_rng(0).normal(size=problem.n_free) * problem.theta_scale
    reduced = np.zeros(problem.n_free)
    for combination in base:
        lead = combination.terms[0][0]
        reduced[index[lead]] = sum(k * theta[index[n]] for n, k in combination.terms)
    seen, kept = (found.factor @ (t / problem.theta_scale) for t in (theta, reduced))
    # sums omit coefficients below a thousandth of a tolerance
    assert np.abs(kept - seen).max() < 2e-3 * np.abs(found.factor).max()


def test_lines_resolve_more_combinations_than_the_sweep(jacobians):
    alike = {}
    for name, (problem, jacobian) in jacobians.items():
        information, count = decompose(jacobian, problem.observations), len(jacobian)
        alike[name] = analyse_identifiability(
            information, problem.parameters, sigma=5e-6, n_postures=1, n_readings=count
        )
    assert alike["lines"].rank > 1.5 * alike["sweep"].rank
    groups = {c.names for c in alike["sweep"].alike}
    assert ("x_slide.offset", "x_swivel.x", "x_wrist.x", "x_fork.x") in groups
    # displaced lines distinguish the position of the wrist from an offset
    assert ("x_slide.offset", "x_swivel.x", "x_fork.x") in {c.names for c in alike["lines"].alike}


def test_base_parameters_without_prior_are_the_sums_of_the_truth():
    """Exact readings, to first order."""
    truth = {"x_slide.offset": 0.4e-3, "y_slide.offset": -0.3e-3, "x_swivel.x": 0.1e-3}
    session = simulate_session(plan_of("raw-cycles"), truth, exact=True).session
    choice = Choice(free=["*.offset", "x_swivel.x"], base=True)
    result, _ = identify(session, choice, **QUICK)
    assert result.base
    assert not result.prior
    assert len(result.free) == 3
    leads = [p.name for p in result.free]
    lead = next(n for n in leads if n.startswith("x_"))
    combination = next(c for c in result.identifiability.base if c.terms[0][0] == lead)
    expected = sum(k * truth[n] for n, k in combination.terms)
    assert result[lead].value == pytest.approx(expected, abs=1e-8)
    assert result["y_slide.offset"].value == pytest.approx(-0.3e-3, abs=1e-8)


def test_base_parameters_and_a_weak_prior_predict_the_same_readings():
    session = session_of("sweep")
    base, _ = identify(session, Choice("full", base=True), **QUICK)
    prior, _ = identify(session, Choice("full", tolerances={"*.offset_m": 4e-3}), **QUICK)
    gap = [a.predicted - b.predicted for a, b in zip(base.residuals, prior.residuals, strict=True)]
    assert np.sqrt(np.mean(np.square(gap))) < 0.4 * prior.sigma
    assert len(base.free) < 30
    assert base.noise.sigma == pytest.approx(5e-6, rel=0.15)
    start = np.zeros(len(Choice("full").select(session.robot.parameters).names))
    from_nominal, _ = identify(session, Choice("full", base=True), start=start, **QUICK)
    assert from_nominal.rms_after == pytest.approx(base.rms_after, rel=1e-4)  # equal optimum


def test_base_parameters_have_no_prior(raw_cycles):
    with pytest.raises(ParameterError, match="without any prior"):
        calibrate(raw_cycles, Choice(model="full", base=True, prior=True))
    with pytest.raises(ParameterError, match=r"state x_leg\.length_m as known without ±"):
        calibrate(raw_cycles, Choice(known={"x_leg.length_m": (1e-4, 1e-5)}, base=True))


def test_readings_without_information_have_no_base_parameters(raw_cycles):
    rows = tuple(r for r in raw_cycles.readings if r.posture == "zero")
    with pytest.raises(NotIdentifiableError, match="determine none of the free parameters"):
        calibrate(replace(raw_cycles, readings=rows), Choice(base=True))


def test_the_base_parameters_of_table_1_are_the_three_offsets(experiment_2):
    """Of 129 errors its six readings resolve those that the paper identifies."""
    choices = [Choice(m, base=b) for m, b in itertools.product(("offsets", "full"), (True, False))]
    offsets, paper, base, full = (identify(experiment_2, c, **QUICK)[0] for c in choices)
    assert [p.name for p in base.free] == [p.name for p in offsets.free]
    for a, b in zip(base.free, offsets.free, strict=True):
        assert a.value == pytest.approx(b.value, abs=1e-9)
    known = [np.diag(c.model_covariance) for c in (base, offsets)]
    assert known[0] == pytest.approx(known[1], rel=1e-6)
    assert [p.value for p in base.free] == pytest.approx([p.value for p in paper.free], abs=1e-9)
    assert base.redundancy == 3
    assert full.redundancy == 0


def test_readings_that_determine_nuisance_parameters_check_nothing():
    """Redundancy is tr(I − A (AᵀA + P)⁻¹ Aᵀ): A has columns of errors, mounting and gauge zeros."""
    session = load_session(ROOT / "examples/linear_delta")  # ball bars: uncertain centre and length
    fit = fit_problem(build_problem(session, model="lengths"), options=SolverOptions(**QUICK))
    problem, o = fit.problem, fit.problem.observations
    _, jacobian = problem.predict_and_jacobian(problem.active_theta, problem.active_passive)
    a = np.hstack([jacobian / fit.sigma, problem.zero_incidence[:, ~o.zero_known]])
    p = np.zeros(a.shape[1])
    p[problem.n_machine : problem.n_free] = 1.0  # priors of nuisance parameters
    hat = a @ np.linalg.solve(a.T @ a + np.diag(p), a.T)
    calibration = assemble_calibration(fit)
    # no reading of this session is repeated
    assert calibration.redundancy == pytest.approx(o.size - np.trace(hat), rel=1e-9)
    assert calibration.redundancy < fit.independent_readings - problem.n_machine - 1.0


def test_the_position_of_the_swivel_along_its_slide_is_an_offset(raw_cycles):
    choice = Choice(free=["*.offset", "x_swivel.x"], prior=True)
    result, _ = identify(raw_cycles, choice, **QUICK)
    words = [c.words for c in result.identifiability.alike]
    assert words == ["x_slide.offset and x_swivel.x: only their difference"]
