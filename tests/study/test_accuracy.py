"""Uncertainty at the tool: sensitivities, sizes, and the value of three plans."""

from __future__ import annotations

import numpy as np
import plans
import pytest
from derivatives import assert_derivative

from orthocal import load_plan
from orthocal.errors import RobotError
from orthocal.identification.problem import build_problem
from orthocal.identification.uncertainty import decompose, project_out_zeros
from orthocal.robot.assembly import Assembly
from orthocal.study.accuracy import ToolSensitivity, Workspace, cube, measure_uncertainty

OFFSET_SIGMA = 2e-3

# r.m.s. position error over the cube of ±60 mm, common shift taken out (mm), of an independent
# rigid-body model: plan, sigma (µm), full, offsets only
TABLE = [
    (plans.paper, 5.0, 0.064, 0.102),
    (plans.sweep, 5.0, 0.062, 0.102),
    (plans.lines, 5.0, 0.008, 0.101),
    (plans.lines, 10.0, 0.014, 0.101),
]
BEFORE = 0.593
SAMPLING = 0.03
"""Relative: that model's points in the cube are not known, nor more than three digits of it."""


@pytest.fixture(scope="module")
def tool(orthoglide):
    return ToolSensitivity(orthoglide, free=orthoglide.parameters.select_model("full"))


@pytest.fixture(scope="module")
def workspace(orthoglide):
    return cube(orthoglide)


@pytest.fixture(scope="module")
def jacobian(tool, workspace):
    return tool(tool.assembly.inverse(workspace.points))


@pytest.fixture(scope="module")
def tolerances(orthoglide, tool):
    scale = [
        OFFSET_SIGMA if n.endswith(".offset") else orthoglide.parameters[n].tolerance
        for n in tool.free
    ]
    return np.array(scale)


@pytest.mark.parametrize("size", [0.0, 3.0])
def test_the_sensitivity_is_the_derivative_of_the_forward_kinematics(orthoglide, size):
    names = orthoglide.parameters.select(["*", "!frame.*", "frame.tcp.*"])
    scale = np.array([orthoglide.parameters[n].tolerance for n in names])
    at = size * np.random.default_rng(0).normal(size=len(names))
    drives = np.array([0.33, 0.29, 0.27])
    values = dict(zip(names, at * scale, strict=True))
    found = ToolSensitivity(orthoglide, free=names, values=values)(drives)[0] * scale
    assembly = Assembly(orthoglide, free=names)
    assert_derivative(
        found * 1e3,
        lambda t: assembly.forward(drives, theta=t * scale) * 1e3,
        at,
        step=1e-3,
        tolerance=1e-6,  # steps of a thousandth of a tolerance, third order
    )


def test_offsets_alone_move_the_tool_as_in_the_paper(orthoglide):
    """At the mechanical zero the sensitivity is the identity (paper, section 2.5)."""
    tool = ToolSensitivity(orthoglide, free=orthoglide.parameters.select_model("offsets"))
    assert np.abs(tool(orthoglide.drive_zero)[0] - np.eye(3)).max() < 1e-11


def test_sizes_solved_by_hand():
    """Two points, one parameter of σ = 2: 1 and 3 per unit, so 2·2 absolute, 2·1 relative."""
    jacobian = np.zeros((2, 3, 1))
    jacobian[0, 0, 0], jacobian[1, 0, 0] = 1.0, 3.0
    workspace = Workspace(np.zeros((2, 3)), np.array([0.5, 0.5]))
    found = measure_uncertainty(jacobian, np.array([[4.0]]), workspace)
    assert found.absolute.rms == pytest.approx(2.0 * np.sqrt(5.0))
    assert found.absolute.largest == pytest.approx(6.0)
    assert found.relative.rms == pytest.approx(2.0)
    assert found.relative.percentile_95 == pytest.approx(2.0 * 1.96, rel=0.05)
    assert found.covariance[1, 0, 0] == pytest.approx(36.0)


def test_a_cube_has_the_mean_square_of_a_cube(orthoglide):
    workspace = cube(orthoglide, half_side=0.06)
    assert workspace.weights.sum() == pytest.approx(1.0)
    mean = workspace.weights @ workspace.points**2
    assert mean == pytest.approx(np.full(3, 0.06**2 / 3.0))


def test_before_calibration(jacobian, tolerances, workspace):
    found = measure_uncertainty(jacobian, np.diag(tolerances**2), workspace)
    assert found.relative.rms * 1e3 == pytest.approx(BEFORE, rel=SAMPLING)


@pytest.mark.parametrize(("plan", "sigma", "full", "offsets"), TABLE)
def test_what_three_plans_are_worth(
    tmp_path, tool, jacobian, tolerances, workspace, plan, sigma, full, offsets
):
    session = load_plan(plans.write(tmp_path, plan()))
    own = dict(zip(tool.free, tolerances, strict=True))
    problem = build_problem(session, free=tool.free, tolerances=own)
    _, slopes = problem.linearise(np.zeros(problem.n_free))
    information = decompose(slopes, problem.observations)
    scale = np.outer(tolerances, tolerances)
    precision = problem.prior_precision
    posterior = information.covariance(sigma=sigma * 1e-6, precision=precision) * scale
    found = measure_uncertainty(jacobian, posterior, workspace)
    # three digits are printed, fewer where the number is small
    slack = max(SAMPLING * full, 0.0006)
    assert abs(found.relative.rms * 1e3 - full) < slack

    # offsets fitted to a machine that has all errors: what they leave, and what they get wrong
    free = [i for i, n in enumerate(tool.free) if n.endswith(".offset")]
    projected = project_out_zeros(slopes, problem.observations) / tolerances
    estimator = np.linalg.pinv(projected[:, free])
    left = np.eye(len(tool.free))
    left[free] -= estimator @ projected
    noise = np.zeros((len(tool.free), len(projected)))
    noise[free] = estimator * sigma * 1e-6
    remaining = (left * tolerances**2) @ left.T + noise @ noise.T
    found = measure_uncertainty(jacobian, remaining, workspace)
    assert found.relative.rms * 1e3 == pytest.approx(offsets, rel=SAMPLING)


def test_a_robot_without_a_tool_is_refused(fivebar):
    with pytest.raises(RobotError, match="no tool centre point"):
        ToolSensitivity(fivebar, free=["motor_a.offset"])
