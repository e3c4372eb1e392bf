"""Effect of unmodelled errors on an estimate: the formula against machines with these errors."""

from __future__ import annotations

import numpy as np
import pytest
from calibrated import identified
from drawn_machines import DrawnMachines
from intervals import recorded_scores
from models import JOINTS
from scipy.stats import binom, chi2

from orthocal import Choice, simulate_session
from orthocal.assessment.judgement import FALSE_ALARM_RATE
from orthocal.calibration import build_record as recording
from orthocal.estimation.diagnostics.unmodelled import (
    find_unmodelled_errors,
    machine_errors,
    propagate_unmodelled,
)
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.estimation.solvers.variable_projection import VariableProjection
from orthocal.statistics.distributions import chi_square_tail
from orthocal.statistics.zeros import project_out_zeros


@pytest.mark.parametrize(("model", "name"), [("offsets", "x_slide.rz"), ("lengths", "z_bar_b.z")])
def test_an_unmodelled_error_moves_the_estimate_by_its_leakage(exact_plan, name, model):
    """Perfect readings of a machine with one small error, calibrated without it."""
    probe = simulate_session(exact_plan, {}, exact=True).session
    fit = fit_problem(build_problem(probe, model=model))
    found, _ = propagate_unmodelled(fit, find_unmodelled_errors(fit))
    column = found.leakage[:, found.names.index(name)]
    size = 1e-6
    problem = build_problem(
        simulate_session(exact_plan, {name: size}, exact=True).session, model=model
    )
    moved = VariableProjection(problem).solve(sigma=fit.sigma).theta / size
    assert moved == pytest.approx(column, abs=2e-3 * max(1.0, np.abs(column).max()))


@pytest.fixture(scope="module")
def machines(exact_plan):
    """Offsets and residuals found on 1,000 machines with all other errors, perfect readings."""
    offsets = build_problem(exact_plan, model="offsets")
    errors = [n for n in machine_errors(exact_plan.robot) if not n.endswith(".offset")]
    others = build_problem(exact_plan, free=errors)
    rng = np.random.default_rng(0)
    drawn = rng.normal(size=(1000, others.n_free)) * others.theta_scale
    values, _, reached = others.simulate(drawn)
    assert reached.all()
    theta = BatchSolver(offsets).solve(values, sigma=1e-5).theta
    found, _, reached = offsets.simulate(theta)
    assert reached.all()
    residuals = [project_out_zeros(r, offsets.observations) for r in values - found]
    return theta, np.array(residuals)


@pytest.fixture(scope="module")
def result(exact_plan):
    return identified(simulate_session(exact_plan, {}, exact=True).session)


def test_residuals_of_machines_with_all_errors_have_the_predicted_rms(result, machines):
    rms = np.sqrt(np.mean(machines[1] ** 2))
    assert rms == pytest.approx(result.unmodelled.residual_rms, rel=0.06)


def test_one_machine_in_a_hundred_exceeds_the_limit_of_residuals(result, machines):
    """Squares of residuals scatter as χ²; few machines are beyond its 99 %."""
    parts = result.unmodelled.residual_dof
    squares = np.mean(machines[1] ** 2, axis=1) / result.unmodelled.residual_rms**2
    assert 2.0 / squares.var() == pytest.approx(parts, rel=0.25)
    beyond = np.mean([chi_square_tail(parts, parts * s) < FALSE_ALARM_RATE for s in squares])
    assert 0.0 < beyond < 0.025  # 10 of 1,000, and three standard deviations


def test_offsets_of_machines_with_all_errors_have_the_predicted_covariance(result, machines):
    """Whitened by the predicted covariance they are standard normal."""
    root = np.linalg.cholesky(result.unmodelled.bias_covariance)
    white = np.linalg.solve(root, machines[0].T)
    spread = np.linalg.eigvalsh(white @ white.T / white.shape[1])
    edge = np.sqrt(3 / white.shape[1])
    assert (1 - edge) ** 2 - 0.1 < spread.min()
    assert spread.max() < (1 + edge) ** 2 + 0.1


def test_a_machine_has_all_errors_of_its_parts(orthoglide, biglide):
    """21 placements and offsets, three scales, both ends of what its loops join, but idle ones."""
    names = machine_errors(orthoglide)
    assert names == orthoglide.parameters.select_model("full")
    owners = {n.rsplit(".", 1)[0] for n in names if n.startswith("frame.")}
    rods = {f"frame.{k}_{end}" for k in "xyz" for end in ("crossbar_end", "rod_b_tip")}
    assert owners == rods | {"frame.y_foot_end", "frame.z_foot_end"}
    # the tool is the end of rod x, and the only frame whose error is the length of this rod
    tool = [n for n in machine_errors(biglide) if n.startswith("frame.x_tip")]
    assert tool == ["frame.x_tip.x", "frame.x_tip.z"]


def test_the_full_model_has_no_unmodelled_errors(exact_plan):
    session = simulate_session(exact_plan, {"x_slide.offset": 1e-3}, seed=1).session
    assert identified(session, "full").unmodelled.names == ()
    free = exact_plan.robot.parameters.select(JOINTS)
    found = identified(session, Choice(free=JOINTS, prior=True)).unmodelled
    assert set(found.names) == set(machine_errors(exact_plan.robot)) - set(free)
    assert found.leakage.shape == (126, len(found.names))
    assert len(found.names) == 3 * 4 + 12 + 3  # ends of rods, feet, scales


def test_parts_of_a_free_sum_may_differ(exact_plan):
    """The coupler has the length of a leg; the second rod may be longer than the first."""
    session = simulate_session(exact_plan, {"x_slide.offset": 1e-3}, seed=1).session
    found = identified(session, "lengths").unmodelled
    assert "x_coupler.x" not in found.names
    assert "frame.x_rod_b_tip.x" in found.names


@pytest.mark.slow
def test_uncertainties_contain_unmodelled_errors(exact_plan, monkeypatch):
    """30 machines with all errors: independent scores of three offsets each, 99 % band of χ².

    The scatter of the readings alone is exceeded by far.
    """
    machines = DrawnMachines(exact_plan, model="lengths")
    # they hardly depend on the machine, and take longest to find
    monkeypatch.setattr(recording, "find_unmodelled_errors", lambda *_, **__: machines.others)
    known = machines.machine.free
    offsets = {n: known.index(n) for n in machines.problem.free if n in known}
    scores, of_scatter, covered = [], [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        errors = machines.draw(rng)
        result = recording.assemble_calibration(machines.fit(machines.read(rng, errors)))
        truth = {n: errors[i] for n, i in offsets.items()}
        scores.append(recorded_scores(result, truth)[0])
        ends = dict(zip((p.name for p in result.free), result.intervals, strict=True))
        for name, value in truth.items():
            covered.append(ends[name][0] <= value <= ends[name][1])
            of_scatter.append((result[name].value - value) / result[name].std_scatter)
    count = np.size(scores)
    assert count == 90
    low, high = chi2.interval(0.99, count)
    assert low < np.square(scores).sum() < high
    assert np.mean(np.abs(of_scatter) < 2.0) < 0.6
    # three offsets of a machine are correlated: the band of as many machines
    assert np.mean(covered) >= binom.ppf(0.005, count // 3, 0.95) / (count // 3)
