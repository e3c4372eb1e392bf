"""Study of linearisation: independent numbers, and the exact solvers."""

from __future__ import annotations

import closed_form
import numpy as np
import pytest
from gauges import exact, with_gauges
from tolerances import THREE_DECIMALS_MM

from orthocal import load_plan
from orthocal.builder.build import make_robot
from orthocal.builder.orthoglide import Orthoglide
from orthocal.errors import NotIdentifiableError, ParameterError
from orthocal.estimation.linear import linearise_problem
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.planning.first_plan import Displacements
from orthocal.session.session import Gauge
from orthocal.statistics.zeros import project_out_zeros
from orthocal.study.linearisation import (
    IDENTIFIED,
    METHODS,
    build_linearisation_study,
    summarise_linearisation,
)
from orthocal.study.random_machines import NO_CONTACT
from orthocal.study.runner import run_study
from orthocal.study.study import run_task

ALONG = (1.0, -0.6, 0.3)


@pytest.fixture(scope="module")
def study(orthoglide):
    return build_linearisation_study(orthoglide, count=12, directions=20)


@pytest.fixture(scope="module")
def summary(study):
    return summarise_linearisation(study, run_study(study))


def method(summary, name):
    return next(m for m in summary.methods if m.name == name)


def test_linearisation_errors_of_readings(orthoglide):
    study = build_linearisation_study(orthoglide, sizes=[1.0, 2.0, 5.0], along=ALONG)
    found = run_task(study, 0)["reading_mm"]
    assert np.abs(np.array(found) - [0.0015, 0.006, 0.039]).max() * 1e-3 < THREE_DECIMALS_MM


def test_linearisation_errors_agree_with_the_closed_forms(orthoglide):
    """Maximum less minimum of the leg's middle, from equations (2) and (3) alone."""
    length, offsets = 0.31025, np.array(ALONG) * 2e-3
    row = run_task(build_linearisation_study(orthoglide, sizes=[2.0], along=ALONG), 0)

    def reading(setup, displacement, error):
        direction, leg = ("xyz".index(c) for c in setup)
        drives = closed_form.inverse(displacement * np.eye(3)[leg], length=length)
        tool = closed_form.direct(drives, length=length, offsets=error)
        root = np.eye(3)[leg] * (drives + error)[leg]
        # where the section of the leg is that the gauge stands at
        at = length / 2 + error[leg]
        share = (at - root[leg]) / (tool[leg] - root[leg])
        return (root + share * (tool - root))[direction]

    def differences(error):
        return np.array(
            [
                reading(s, d, error) - reading(s, 0.0, error)
                for s in ("yx", "zx", "xy", "zy", "xz", "yz")
                for d in (0.06, -0.1)
            ]
        ).reshape(6, 2)

    step = 1e-6
    slopes = [(differences(step * e) - differences(-step * e)) / (2 * step) for e in np.eye(3)]
    wrong = differences(offsets) - np.tensordot(offsets, slopes, axes=1)
    spread = np.max(np.c_[np.abs(wrong), np.abs(wrong[:, 0] - wrong[:, 1])])
    assert row["reading_mm"][0] == pytest.approx(spread * 1e3, rel=1e-4)


def test_standard_errors(study):
    found = {name: v / study.sigma for name, v in study.standard_errors.items()}
    assert found["six"] == pytest.approx(1.984, abs=5e-4)
    assert found["twelve"] == pytest.approx(2.066, abs=5e-4)
    assert found["twelve_gls"] == pytest.approx(1.942, abs=5e-4)
    assert found["first_order"] == pytest.approx(found["twelve_gls"], rel=1e-9)


def test_scatter_agrees_with_the_standard_errors(study):
    """Monte-Carlo, each of the paper's three ways."""
    prepared, rng, count = study.prepare(), np.random.default_rng(0), 4000
    noise = rng.normal(size=(count, prepared.problem.observations.size)) * study.sigma
    for name, solution in prepared.paper.items():
        scatter = np.std(noise @ solution.T, axis=0).max()
        assert abs(scatter / study.standard_errors[name] - 1.0) < 4.0 / np.sqrt(2.0 * count)


def test_exact_solution_equals_the_truth_and_ipopt(study):
    rows = run_task(study, 0)
    assert max(rows["exact"]) < 1e-6
    prepared = study.prepare()
    program = NonlinearProgram(prepared.problem)
    for size in (1.0, 10.0, 50.0):
        errors = np.array(study.directions[3]) * size * 1e-3
        read = prepared.problem.predict(errors)
        found = program.solve(sigma=1e-6, values=read).theta
        assert np.abs(found - errors).max() < 1e-9


def test_batch_step_equals_single_gauss_newton_steps(study):
    """Slopes of many machines at once, and steps of each alone."""
    prepared = study.prepare()
    problem = prepared.problem
    errors = np.array(study.directions[:4]) * 20e-3
    read, _, _ = problem.simulate(errors)
    theta = 0.8 * errors
    found, alive = prepared.step(read, theta)
    assert alive.all()
    for y, at, step in zip(read, theta, found, strict=True):
        reading, jacobian = problem.predict_and_jacobian(at)
        slopes = project_out_zeros(jacobian, problem.observations)
        left = project_out_zeros(y - reading, problem.observations)
        expected = at + np.linalg.lstsq(slopes, left)[0] * problem.theta_scale
        assert np.abs(step - expected).max() < 1e-12


def test_order_of_convergence(summary):
    first = method(summary, "first_order")
    assert first.errors[4] / first.errors[0] == pytest.approx(
        (summary.sizes[4] / summary.sizes[0]) ** 2, rel=0.1
    )
    assert first.exceeds_resolution == pytest.approx(1.94, rel=0.1)
    assert first.exceeds_noise == pytest.approx(3.83, rel=0.1)
    assert method(summary, "steps_2").exceeds_resolution > 10.0
    assert summary.steps[-1] <= 6
    assert all(m.fails is None for m in summary.methods)
    assert method(summary, "exact").exceeds_resolution is None


def test_gauss_newton_diverges_on_short_legs(tmp_path):
    """A machine of short legs, 60 mm off."""
    robot = make_robot(Orthoglide(leg=0.15, travel=(0.06, 0.24), attachment=0.02), tmp_path / "m")
    study = build_linearisation_study(
        robot, sizes=[1.0, 60.0], directions=4, displacements=Displacements(0.03, -0.05)
    )
    found = summarise_linearisation(study, run_study(study))
    assert found.steps[0] is not None
    assert found.steps[1] is None or found.steps[1] > 5 or found.measurable < 60.0


def test_session_and_other_errors(root):
    plan = load_plan(root / "examples/workshop/plan.yaml")
    study = build_linearisation_study(
        plan, free=["*.offset", "*_leg.length"], sizes=[0.5], directions=3
    )
    rows = run_task(study, 0)
    assert "six" not in rows
    assert set(METHODS[3:]) <= set(rows)
    assert max(rows["exact"]) < 1e-6
    assert study.resolution == 10e-6


def test_errors_are_those_that_active_offsets_do_not_correct(root):
    """In the same postures. The linearisation point has the active offsets."""
    session = load_plan(root / "examples/table1/experiment-2")
    sessions = session, session.with_controller([3e-3, -2e-3, 1e-3])
    studies = [build_linearisation_study(s, count=2, directions=2) for s in sessions]
    one, other = (run_study(s).columns for s in studies)
    for name in ("first_order", "reading_mm", "exact"):
        assert other[name] == pytest.approx(one[name], abs=1e-9)


def test_machines_without_contact_are_counted(root):
    """Large errors move the rod away from the ball of some gauge."""
    plan = load_plan(root / "examples/workshop/plan.yaml")
    study = build_linearisation_study(plan, sizes=[1.0, 50.0], directions=2)
    table = run_study(study)
    assert table.columns["status"][:2] == [IDENTIFIED] * 2
    assert NO_CONTACT in table.columns["status"][2:]
    assert summarise_linearisation(study, table).measurable == 1.0


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"free": ["*.scale"]}, ParameterError, "--free: expected lengths and angles"),
        ({"along": [0.0, 0.0, 0.0]}, ParameterError, "not all 0"),
    ],
)
def test_invalid_arguments(orthoglide, arguments, error, message):
    with pytest.raises(error, match=message):
        build_linearisation_study(orthoglide, **arguments)


@pytest.mark.parametrize("order", [("coarse", "fine"), ("fine", "coarse")])
def test_readings_are_weighted_by_the_noise_of_their_gauge(root, order):
    """As in a calibration. The errors are so large that the equations contradict each other."""
    plan = exact(load_plan(root / "examples/raw-cycles/plan.yaml"))
    gauges = {name: Gauge({"coarse": 20e-6, "fine": 2e-6}[name]) for name in order}
    session = with_gauges(plan, gauges, set(list(plan.setups)[:3]))
    study = build_linearisation_study(session, along=[1.0, -0.5, 0.25], sizes=[20.0])
    columns = run_study(study).columns
    problem = build_problem(session, model="offsets", prior=False)
    truth = np.array([20e-3, -10e-3, 5e-3])
    change = problem.predict(truth) - problem.predict(np.zeros(3))
    jacobian = linearise_problem(problem).jacobian / problem.theta_scale
    sigma = np.array([2e-6 if i < 3 else 20e-6 for i in range(6)])[problem.observations.setup]
    rows = np.hstack([jacobian, problem.zero_incidence]) / sigma[:, None]
    variances = np.linalg.inv(rows.T @ rows).diagonal()[:3]
    assert study.standard_errors["exact"] == pytest.approx(np.sqrt(variances.max()), rel=1e-6)
    found = np.linalg.lstsq(rows, change / sigma)[0][:3]
    assert columns["first_order"] == pytest.approx([np.abs(found - truth).max() * 1e3], rel=1e-6)
    remaining = change - jacobian @ truth
    of_zero = [np.ptp(remaining[problem.observations.zero == z]) for z in range(6)]
    assert columns["reading_mm"][0] == pytest.approx(max(of_zero) * 1e3, rel=1e-6)
    assert columns["exact"][0] < 1e-6


def test_unidentifiable_errors(orthoglide):
    study = build_linearisation_study(orthoglide, free=["x_slide.offset", "x_swivel.x"])
    with pytest.raises(NotIdentifiableError):
        study.prepare()


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_last_size_is_the_largest(orthoglide, count):
    sizes = build_linearisation_study(orthoglide, largest=17.61, count=count).sizes
    assert sizes == tuple(sorted(sizes))
    assert len(sizes) == count
    assert sizes[-1] == 17.61
    assert count == 1 or sizes[0] == 0.1


def test_paper_plan_requires_an_orthoglide(biglide):
    with pytest.raises(ParameterError, match="has no legs x, y, z along these axes"):
        build_linearisation_study(biglide)


def test_noise_and_resolution_of_the_gauge(orthoglide):
    study = build_linearisation_study(orthoglide, gauge=Gauge(1e-6, 2e-6, None))
    assert study.resolution == 2e-6
    assert study.sigma == pytest.approx(np.hypot(1e-6, 2e-6 / np.sqrt(12)))
    assert exact(study.session).setups.keys() == study.session.setups.keys()
