"""Formulas and numbers of docs/mathematics.md, each written out and compared with the program."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from calibrated import identified
from conftest import ROOT
from scipy.optimize import brentq
from tolerances import KINEMATICS, LAST_SIGMA, SAME_NUMBER

import orthocal
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.assessment.tool_error import assess_tool
from orthocal.calibration.calibration import Calibration
from orthocal.estimation.diagnostics.unmodelled import error_jacobian
from orthocal.estimation.fit import Fit, build_program, fit_problem
from orthocal.estimation.linear import invert_equation_8, leg_parallelism_matrix
from orthocal.estimation.loss import Loss
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.hypotheses.family_scores import N_FAMILIES
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.reachable_box import find_workspace
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.observation.gauge_noise import noise_floor
from orthocal.robot.model import joint_axis
from orthocal.robot.parameters import AXES
from orthocal.sensors.leg_indicator import Section
from orthocal.statistics.distributions import t_quantile
from orthocal.statistics.zeros import project_out_zeros

EXPERIMENT = ROOT / "examples/table1/experiment-2"
PAGE = " ".join((ROOT / "docs/mathematics.md").read_text().split())


@cache
def experiment() -> tuple[Calibration, Fit]:
    session = orthocal.load_session(EXPERIMENT)
    problem = CalibrationProblem(
        session, orthocal.Choice("offsets").select(session.robot.parameters)
    )
    calibration = orthocal.calibrate(session, "offsets")
    selection = replace(problem.machine_selection, tolerance_scale=calibration.tolerance_scale)
    return calibration, fit_problem(CalibrationProblem(session, selection))


def without_zeros(problem, jacobian):
    return project_out_zeros(jacobian, problem.observations)


def rms(space, field):
    return math.sqrt(float(space.weights @ (field**2).sum(axis=1)))


def test_covariance_bias_and_expanded_uncertainty():
    calibration, fit = experiment()
    problem, sigma, n = fit.problem, fit.sigma, fit.problem.n_machine
    jacobian = without_zeros(problem, fit.jacobian)
    prior = np.diag(problem.prior_precision)
    scaled = np.linalg.inv(jacobian.T @ jacobian / sigma**2 + prior)
    units = np.outer(problem.theta_scale, problem.theta_scale)
    stated = noise_floor(problem.session.gauge.sigma, problem.session.gauge.resolution)
    noise = scaled @ jacobian.T @ jacobian @ scaled * stated**2 / sigma**4 * units
    c = (noise + scaled @ prior @ scaled * units)[:n, :n]
    np.testing.assert_allclose(c, calibration.model_covariance, rtol=SAME_NUMBER)
    eta = calibration.tolerance_scale
    by_one_std = eta.factor * error_jacobian(fit, calibration.unmodelled.names)
    bias = (scaled @ jacobian.T @ by_one_std / sigma**2 * problem.theta_scale[:, None])[:n]
    np.testing.assert_allclose(c + bias @ bias.T, calibration.total_covariance, rtol=SAME_NUMBER)

    total, scatter = np.diag(calibration.total_covariance), np.diag(noise)[:n]
    # offsets have no prior here, and mountings none that is scaled
    parameters = problem.robot.parameters
    chosen = [parameters.are_scaled(name) for name in calibration.unmodelled.names]
    from_scaled = (bias[:, chosen] ** 2).sum(axis=1)
    np.testing.assert_allclose(from_scaled, [p.std_scaled**2 for p in calibration.free])
    t = t_quantile(eta.contrasts, 0.975)
    assert f"differences have {eta.contrasts:.2f} of them, so $k_\\eta = {t:.2f}$" in PAGE
    expanded = np.sqrt(4.0 * scatter + t**2 * from_scaled + 4.0 * (total - scatter - from_scaled))
    np.testing.assert_allclose(expanded, calibration.expanded_uncertainties, rtol=SAME_NUMBER)
    effective = problem.n_free - np.trace(prior @ scaled)
    dof = problem.observations.size - problem.observations.n_free_zeros - effective
    assert dof == pytest.approx(calibration.dof, rel=LAST_SIGMA)
    square = float((fit.residual**2).sum())
    assert math.sqrt(square / dof) == pytest.approx(sigma, rel=LAST_SIGMA)


def test_covariance_at_the_tool():
    calibration, _ = experiment()
    accuracy, tool = assess_tool(calibration), find_tool(calibration)
    n, out = len(calibration.free), calibration.unmodelled
    space = accuracy.workspace
    field = space.remove_motion(tool.jacobian[:, :, : n + len(out.names)], accuracy.targets)
    e, e_u = field[:, :, :n], field[:, :, n:]

    def mean(covariance):
        return float(space.weights @ np.trace(covariance, axis1=1, axis2=2))

    direct = (e_u - e @ out.leakage) * out.prior_stds
    c = e @ calibration.model_covariance @ e.transpose(0, 2, 1)
    square = mean(c + direct @ direct.transpose(0, 2, 1))
    assert math.sqrt(square) == pytest.approx(accuracy.after.sizes.aligned.rms, rel=SAME_NUMBER)
    eta, known = calibration.tolerance_scale, accuracy.measure(accuracy.deviation_with_entries)
    total = math.sqrt(square + known.aligned.rms**2)
    assert total == pytest.approx(calibration.assessment.tool.entered, rel=SAME_NUMBER)
    without = math.sqrt(mean(e @ calibration.total_covariance @ e.transpose(0, 2, 1)))
    text = f"give {without * 1e6:.0f} µm instead of {math.sqrt(square) * 1e6:.0f} µm"
    assert text in PAGE
    text = f"from {eta.contrasts:.2f} contrasts, and a tool error of {total * 1e6:.0f} µm"
    assert f"$\\eta = {eta.factor:.1f}$ {text}" in PAGE


def test_singular_values_with_the_mounting_marginalised():
    calibration, fit = experiment()
    problem, n = fit.problem, fit.problem.n_machine
    jacobian = without_zeros(problem, problem.predict_and_jacobian(problem.active_theta)[1])
    mounting = jacobian[:, n:]
    values, vectors = np.linalg.eigh(
        np.eye(len(mounting)) + mounting @ mounting.T / calibration.noise.sigma**2
    )
    root = vectors / np.sqrt(values) @ vectors.T
    expected = np.linalg.svd(root @ jacobian[:, :n], compute_uv=False)
    found = calibration.identifiability
    np.testing.assert_allclose(found.singular_values, expected, rtol=SAME_NUMBER)
    p, k = int((expected > calibration.noise.sigma).sum()), len(calibration.postures)
    last, first = expected[p - 1], expected[0]
    indices = {
        "O1": np.prod(expected[:p]) ** (1.0 / p) / math.sqrt(k),
        "O2": last / first,
        "O3": last,
        "O4": last**2 / first,
        "O5": 1.0 / np.sum(1.0 / expected[:p]),
    }
    assert found.observability == pytest.approx(indices, rel=SAME_NUMBER)


@pytest.mark.parametrize("kind", ["squares", "huber"])
def test_the_objective_has_priors_means_and_the_pseudo_huber_loss(kind):
    session = orthocal.load_session(EXPERIMENT)
    choice = orthocal.Choice("lengths", known={"x_leg.length_mm": (0.12, 0.02)})
    problem = CalibrationProblem(session, choice.select(session.robot.parameters))
    sigma = 20e-6
    solution = build_program(problem, SolverOptions(loss=Loss(kind))).solve(sigma=sigma)
    x = (problem.values - problem.predict(solution.theta)) / sigma
    x -= solution.zeros[problem.observations.zero] / sigma
    w = 1.345
    loss = 0.5 * x**2 if kind == "squares" else w**2 * (np.sqrt(1.0 + x**2 / w**2) - 1.0)
    mean = np.where([n == "x_leg.length" for n in problem.free], 0.12e-3, 0.0)
    prior = 0.5 * ((solution.theta - mean) / [p.prior_std for p in problem.parameters]) ** 2
    assert problem.selection.prior_stds[3] == pytest.approx(0.01e-3)
    assert solution.objective == pytest.approx(loss.sum() + prior.sum(), rel=SAME_NUMBER)


def test_offsets_with_the_section_at_the_slide_and_in_the_world():
    session = orthocal.load_session(EXPERIMENT)
    setups = {}
    for name, setup in session.setups.items():
        leg = session.robot.legs[setup.sensor.leg]
        at = leg.reference_root + setup.sensor.section.value * leg.length * leg.axis
        world = Section("coordinate_mm", float(at[np.abs(leg.axis).argmax()]))
        setups[name] = replace(setup, sensor=replace(setup.sensor, section=world))

    def shown(of):
        values = [p.value * 1e3 for p in identified(of, "offsets").free]
        first, second, third = (f"{v:.3f}".replace("-", "−") for v in values)
        return f"{first}, {second} and {third} mm"

    assert shown(session) in PAGE
    assert shown(replace(session, setups=setups)) in PAGE


def test_other_displacements_with_the_same_residuals_have_other_offsets():
    """The residuals of the six equations depend on c/b alone, and the offsets scale with 1/b."""
    differences = np.array([-0.43, -0.37, 0.42, -0.18, -1.14, -0.70]) * 1e-3

    def equations(most, least):
        return leg_parallelism_matrix(
            length=0.31025, displacement_max=most, displacement_min=least, rows=6
        )

    def ratio(most, least):
        b, c = equations(most, least)[0, :2]
        return c / b

    assumed = ratio(0.06, -0.1)
    matrix = equations(0.06, -0.1)
    predicted = matrix @ invert_equation_8(matrix) @ differences
    assert f"$c/b = {assumed:.4f}$" in PAGE
    for most, low, high in ((0.04, -0.1, -0.06), (0.06, -0.11, -0.09), (0.08, -0.14, -0.1)):
        least = brentq(lambda x, most=most: ratio(most, x) - assumed, low, high, xtol=1e-15)
        matrix = equations(most, least)
        found = invert_equation_8(matrix) @ differences
        np.testing.assert_allclose(matrix @ found, predicted, atol=KINEMATICS)
        offsets = ", ".join(f"{v * 1e3:.3f}".replace("-", "−") for v in found)
        assert f"| {matrix[0, 0]:.3f} | {offsets} |" in PAGE


def by_offsets_and_lengths(name):
    session = orthocal.load_session(ROOT / "examples" / name)
    choice = orthocal.Choice("lengths").select(session.robot.parameters)
    problem = CalibrationProblem(session, choice)
    return without_zeros(
        problem, problem.predict_and_jacobian(problem.active_theta, units="SI")[1]
    )[:, :6]


def test_an_offset_with_an_equal_change_of_its_leg_length_is_weak():
    ratios = {}
    for name in ("table1/experiment-2", "raw-cycles", "sweep", "workshop"):
        jacobian = by_offsets_and_lengths(name)
        offset, both = jacobian[:, 0], jacobian[:, 0] + jacobian[:, 3]
        ratios[name] = np.linalg.norm(offset) / np.linalg.norm(both)
        common = np.linalg.svd(jacobian[:, :3])[2][0]
        np.testing.assert_allclose(np.abs(common), math.sqrt(1.0 / 3.0), rtol=SAME_NUMBER)
    of_paper = ratios.pop("table1/experiment-2")
    assert f"Readings change {of_paper:.0f} times less" in PAGE
    assert f"{min(ratios.values()):.0f} to {max(ratios.values()):.0f} times less" in PAGE

    robot = orthocal.load_robot("orthoglide")
    space, nominal = find_workspace(robot), nominal_closure(robot)
    drives, passive = nominal.reach(space.points)
    names = ("x_slide.offset", "x_leg.length")
    field = ToolSensitivity(robot, free=names)(drives, passive=passive)
    aligned = space.remove_motion(field, nominal.tcp(drives, passive)) * 1e3
    both, alone = rms(space, aligned.sum(axis=2)), rms(space, aligned[:, :, 0])
    assert f"is {both:.1f} µm, against {alone:.0f} µm for the offset alone" in PAGE


def test_a_rigid_motion_of_the_machine_changes_no_reading():
    session = orthocal.load_session(EXPERIMENT)
    robot, motion = session.robot, pin.Motion(np.array([2.0, -1.0, 3.0, 1.0, 2.0, -1.5]))
    problem = CalibrationProblem(session, orthocal.Choice("full").select(robot.parameters))
    theta = np.zeros(problem.n_free)
    for drive in robot.drives:
        joint = robot.model.getJointId(drive.name)
        twist = robot.model.jointPlacements[joint].actInv(motion).vector
        along = joint_axis(robot.model, joint)
        theta[problem.free.index(f"{drive.name}.offset")] = along @ twist
        for axis in np.flatnonzero(along == 0.0):
            theta[problem.free.index(f"{drive.name}.{AXES[axis]}")] = twist[axis]
    jacobian = without_zeros(
        problem, problem.predict_and_jacobian(problem.active_theta, units="SI")[1]
    )
    assert np.abs(jacobian @ theta).max() < KINEMATICS
    assert (theta != 0.0).sum() == 18


def test_families_of_hypotheses_are_counted_as_on_the_page():
    count = f"{N_FAMILIES:g}"
    assert f"There are {count} families of hypotheses" in PAGE
    assert f"The prior probability $p(H)$ is 1/{count}," in PAGE
