"""Least tool error that readings can leave, in plain linear algebra."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from orthocal.assessment.tool_error import measure_uncertainty
from orthocal.estimation.problem import build_problem
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.sensitivity import ToolSensitivity


def posterior_covariance(plan, problem, jacobian):
    """Covariance of all scaled parameters; columns for free zeros."""
    gauges = [plan.gauges[plan.setups[r.setup].gauge] for r in plan.readings]
    sigma = np.array([np.hypot(g.sigma, (g.resolution or 0.0) / np.sqrt(12.0)) for g in gauges])
    free = [name for name, s in plan.setups.items() if s.zero == "free"]
    zeros = np.array([[float(r.setup == name) for name in free] for r in plan.readings])
    design = np.hstack([jacobian, zeros.reshape(len(plan.readings), -1)]) / sigma[:, None]
    precision = np.zeros(design.shape[1])
    precision[: problem.n_free] = problem.prior_precision
    return np.linalg.inv(design.T @ design + np.diag(precision))[: problem.n_free, : problem.n_free]


def bound_um(plan, space, *, offset_std=2e-3):
    """RMS tool error of the complete model, workpiece aligned, [µm]."""
    names = plan.robot.parameters.select_model("full")
    problem = build_problem(plan, free=names, prior=True, prior_stds={"*.offset": offset_std})
    n = problem.n_machine
    _, jacobian = problem.predict_and_jacobian(np.zeros(problem.n_free))
    posterior = posterior_covariance(plan, problem, jacobian)[:n, :n]
    scale = problem.theta_scale[:n]
    drives = LoopClosure(plan.robot).inverse(space.points)
    tool = ToolSensitivity(plan.robot, free=problem.free[:n])(drives)
    covariance = posterior * np.outer(scale, scale)
    return 1e6 * measure_uncertainty(tool, covariance, space, space.points).sizes.aligned.rms


def rms_band(field, weights, covariance, count):
    """99 % band of the ratio of an RMS tool error over `count` machines to its expectation.

    Its square is taken as χ² with the same mean and variance (Satterthwaite); field (K, 3, n).
    """
    rows = (np.sqrt(weights)[:, None, None] * field).reshape(-1, field.shape[-1])
    eigenvalues = np.linalg.eigvalsh(rows @ covariance @ rows.T)
    dof = count * eigenvalues.sum() ** 2 / (eigenvalues**2).sum()
    return np.sqrt(np.array(chi2.interval(0.99, dof)) / dof)
