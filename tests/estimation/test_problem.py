"""The identification Jacobian, by central differences of machines that are closed anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from derivatives import assert_jacobian
from tolerances import KINEMATICS

from orthocal import load_plan, load_session
from orthocal.errors import RobotError
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.symbolic_problem import SymbolicProblem
from orthocal.observation.model import predict_readings


@pytest.fixture(scope="module")
def plan(root):
    return load_plan(root / "examples/raw-cycles/plan.yaml")


@pytest.mark.parametrize(
    ("free", "size"),
    [
        (["*.offset"], 0.0),
        (["*.offset", "*_leg.length"], 3.0),
        (["*.offset", "*.scale", "frame.*"], 1.0),
    ],
)
def test_the_implicit_jacobian_is_the_derivative(plan, free, size):
    """Of sums, frames and scales; `test_observation_model` has the complete model."""
    problem = build_problem(plan, free=free)
    scale, rng = problem.theta_scale, np.random.default_rng(1)
    theta = size * rng.normal(size=problem.n_free) * scale
    _, jacobian = problem.predict_and_jacobian(theta)
    assert_jacobian(problem, theta, jacobian, least=1e-3)


def test_known_values_are_held(plan):
    fixed = {"x_leg.length": 0.3e-3, "x_slide.offset": 1e-3}
    problem = build_problem(plan, model="lengths", known=fixed)
    assert "x_slide.offset" not in problem.free
    entries = predict_readings(plan, fixed)
    assert np.abs(problem.predict(np.zeros(problem.n_free)) - entries).max() < KINEMATICS * 10


def test_what_the_controller_corrects_is_the_reference(exact_plan):
    active = replace(exact_plan, controller_offsets=np.array([1e-3, 2e-3, 3e-3]))
    assert np.array_equal(build_problem(active, model="offsets").active_theta, [1e-3, 2e-3, 3e-3])


def test_a_gauge_that_misses_the_nominal_rod_counts_as_aligned(root):
    """Its mounting was estimated from wrong readings; other setups keep theirs."""
    session = load_session(root / "examples/workshop")
    problem = build_problem(session, free=["*.offset"])
    mounting = 1e-5 * np.ones(problem.n_free - problem.n_machine)
    before = problem.predict_nominal(mounting)
    name = next(n for n in problem.free if n.endswith(".lateral"))
    mounting[problem.free.index(name) - problem.n_machine] = 0.02
    after = problem.predict_nominal(mounting)
    of_setup = np.array(
        [name.split(".")[1] == list(session.setups)[i] for i in problem.observations.setup]
    )
    np.testing.assert_array_equal(after[~of_setup], before[~of_setup])
    aligned = problem.predict_nominal(np.zeros_like(mounting))
    np.testing.assert_array_equal(after[of_setup], aligned[of_setup])
    assert not np.array_equal(before[of_setup], aligned[of_setup])


def test_readings_depend_on_few_variables(plan):
    """A reading knows its own leg only: this is what makes large problems fast."""
    problem = build_problem(plan, model="full")
    setups = list(plan.setups.values())
    for piece in SymbolicProblem(problem).readings:
        (leg,) = {setups[i].sensor.leg for i in piece.group.setups}
        assert piece.passive_index.size == 3
        assert piece.theta_index.size == 21
        names = {problem.free[i].split("_")[0] for i in piece.theta_index}
        assert names == {leg}


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("{}", r"closure rows depend on others: z of apex; remove them"),
        ("{rows: [x]}", r"the closures constrain 1 coordinates of 2 passive joints"),
    ],
)
def test_closure_rows_that_are_too_few_or_too_many_are_named(root, tmp_path, rows, message):
    folder = tmp_path / "biglide"
    folder.mkdir()
    for name in ("biglide.urdf", "biglide.yaml"):
        text = (root / "tests/robots/biglide" / name).read_text()
        (folder / name).write_text(text.replace("{rows: [x, y]}", rows))
    (tmp_path / "plan.yaml").write_text(
        "robot: ./biglide\npostures: {zero: {tcp_mm: [0, 0]}}\n"
        "setups:\n  yx: {leg: x, direction: y, section: {fraction: 0.5}}\n"
    )
    with pytest.raises(RobotError, match=message):
        load_plan(tmp_path / "plan.yaml")


def test_other_noise_ratios_are_in_the_linearisation(plan):
    """Also if the first problem has already been linearised."""
    problem = build_problem(plan, model="offsets")
    jacobian = problem.linearisation_at_active.jacobian
    other = problem.with_noise_ratio(np.full(problem.observations.size, 4.0))
    assert np.allclose(other.linearisation_at_active.jacobian, jacobian / 4.0, rtol=1e-12)
