"""What linearising costs: numbers that were computed independently, and the solvers themselves."""

from __future__ import annotations

import numpy as np
import pytest
from gauges import exact
from tolerances import THREE_DECIMALS_MM

from orthocal import load_plan
from orthocal.errors import NotIdentifiableError, ParameterError
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.kinematics import orthoglide as closed_forms
from orthocal.robot.builder.build import Sizes, make_robot
from orthocal.session.session import Gauge
from orthocal.study.linearisation import METHODS, build_linearisation_study
from orthocal.study.linearisation_summary import summarise_linearisation
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


def test_readings_are_wrong_by_what_was_computed_independently(orthoglide):
    study = build_linearisation_study(orthoglide, sizes=[1.0, 2.0, 5.0], along=ALONG)
    found = run_task(study, 0)["reading_mm"]
    assert np.abs(np.array(found) - [0.0015, 0.006, 0.039]).max() * 1e-3 < THREE_DECIMALS_MM


def test_and_by_the_papers_closed_forms(orthoglide):
    """Maximum less minimum of the leg's middle, from equations (2) and (3) alone."""
    length, offsets = 0.31025, np.array(ALONG) * 2e-3
    row = run_task(build_linearisation_study(orthoglide, sizes=[2.0], along=ALONG), 0)

    def reading(setup, displacement, error):
        direction, leg = ("xyz".index(c) for c in setup)
        drives = closed_forms.inverse(displacement * np.eye(3)[leg], length=length)
        tool = closed_forms.direct(drives, length=length, offsets=error)
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


def test_standard_errors_are_those_that_were_computed_independently(study):
    found = {name: v / study.sigma for name, v in study.standard_errors.items()}
    assert found["six"] == pytest.approx(1.984, abs=5e-4)
    assert found["twelve"] == pytest.approx(2.066, abs=5e-4)
    assert found["twelve_gls"] == pytest.approx(1.942, abs=5e-4)
    assert found["first_order"] == pytest.approx(found["twelve_gls"], rel=1e-9)


def test_noise_spreads_solutions_as_standard_errors_say(study):
    """Monte-Carlo, each of the paper's three ways."""
    from orthocal.estimation.linear import SIX_ROWS, solve_equation_8, twelve_row_covariance
    from orthocal.study.linearisation import _max_less_min

    prepared, rng, count = study.prepare(), np.random.default_rng(0), 4000
    noise = rng.normal(size=(count, prepared.problem.observations.size)) * study.sigma
    twelve = noise @ prepared.rows.T
    six = np.stack([_max_less_min(twelve.T, name) for name in SIX_ROWS], axis=1)
    ways = {
        "six": (six, None),
        "twelve": (twelve, None),
        "twelve_gls": (twelve, twelve_row_covariance()),
    }
    for name, (rows, covariance) in ways.items():
        matrix = prepared.matrices[rows.shape[1]]
        found = [solve_equation_8(matrix, y, covariance=covariance).offsets for y in rows]
        spread = np.std(found, axis=0).max()
        expected = study.standard_errors[name]
        assert abs(spread / expected - 1.0) < 4.0 / np.sqrt(2.0 * count)


def test_the_exact_solution_is_the_truth_and_ipopts(study):
    rows = run_task(study, 0)
    assert max(rows["exact"]) < 1e-6
    prepared = study.prepare()
    program = NonlinearProgram(prepared.problem)
    for size in (1.0, 10.0, 50.0):
        errors = np.array(study.directions[3]) * size * 1e-3
        read = prepared.problem.predict(errors)
        found = program.solve(sigma=1e-6, values=read).theta
        assert np.abs(found - errors).max() < 1e-9


def test_a_step_is_gauss_newtons(study):
    """Slopes of many machines at once, and steps of each alone."""
    prepared = study.prepare()
    problem = prepared.problem
    errors = np.array(study.directions[:4]) * 20e-3
    read, _ = prepared._read(errors)
    theta = 0.8 * errors
    found, alive = prepared._step(read, theta)
    assert alive.all()
    from orthocal.statistics.zeros import project_out_zeros

    for y, at, step in zip(read, theta, found, strict=True):
        reading, jacobian = problem.linearise(at)
        slopes = project_out_zeros(jacobian, problem.observations)
        left = project_out_zeros(y - reading, problem.observations)
        expected = at + np.linalg.lstsq(slopes, left)[0] * problem.theta_scale
        assert np.abs(step - expected).max() < 1e-12


def test_what_is_missed_grows_with_the_square_and_each_step_squares_it(summary):
    first = method(summary, "first_order")
    assert first.missed[4] / first.missed[0] == pytest.approx(
        (summary.sizes[4] / summary.sizes[0]) ** 2, rel=0.1
    )
    assert first.beyond_resolution == pytest.approx(1.94, rel=0.1)
    assert first.beyond_noise == pytest.approx(3.83, rel=0.1)
    assert method(summary, "steps_2").beyond_resolution > 10.0
    assert summary.steps[-1] <= 6
    assert all(m.ends is None for m in summary.methods)
    assert method(summary, "exact").beyond_resolution is None


def test_where_undamped_steps_come_to_nothing_is_told(tmp_path):
    """A machine of short legs, 60 mm off."""
    robot = make_robot(Sizes(leg=0.15, lower=0.06, upper=0.24, attachment=0.02), tmp_path / "m")
    from orthocal.study.paper import Displacements

    study = build_linearisation_study(
        robot, sizes=[1.0, 60.0], directions=4, displacements=Displacements(0.03, -0.05)
    )
    found = summarise_linearisation(study, run_study(study))
    assert found.steps[0] is not None
    assert found.steps[1] is None or found.steps[1] > 5 or found.assembled < 60.0


def test_longer_legs_bend_less(tmp_path, orthoglide):
    longer = make_robot(Sizes(leg=0.6205, lower=0.43, upper=0.7), tmp_path / "long")
    errors = [
        run_task(build_linearisation_study(r, sizes=[2.0], along=ALONG), 0)["first_order"][0]
        for r in (orthoglide, longer)
    ]
    assert errors[1] < 0.6 * errors[0]


def test_any_errors_of_any_session(root):
    plan = load_plan(root / "examples/workshop/plan.yaml")
    study = build_linearisation_study(
        plan, free=["*.offset", "*_leg.length"], sizes=[0.5], directions=3
    )
    rows = run_task(study, 0)
    assert "six" not in rows
    assert set(METHODS[3:]) <= set(rows)
    assert max(rows["exact"]) < 1e-6
    assert study.resolution == 10e-6


def test_biglide_has_no_paper_but_a_session_does(biglide):
    with pytest.raises(ParameterError, match="has no legs x, y, z along these axes"):
        build_linearisation_study(biglide)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"free": ["*.scale"]}, ParameterError, "--free: expected lengths and angles"),
        ({"along": [1.0, 2.0]}, ParameterError, "--along: found 1, 2; expected 3 numbers"),
        ({"along": [0.0, 0.0, 0.0]}, ParameterError, "not all 0"),
    ],
)
def test_what_makes_no_sense_is_refused(orthoglide, arguments, error, message):
    with pytest.raises(error, match=message):
        build_linearisation_study(orthoglide, **arguments)


def test_what_readings_cannot_tell_is_refused(orthoglide):
    study = build_linearisation_study(orthoglide, free=["x_slide.offset", "x_swivel.x"])
    with pytest.raises(NotIdentifiableError):
        study.prepare()


def test_a_gauges_own_noise_stands_beside_it(orthoglide):
    study = build_linearisation_study(orthoglide, gauge=Gauge(1e-6, 2e-6, None))
    assert study.resolution == 2e-6
    assert study.sigma == pytest.approx(np.hypot(1e-6, 2e-6 / np.sqrt(12)))
    assert exact(study.session.unpack()).setups.keys() == study.session.unpack().setups.keys()
