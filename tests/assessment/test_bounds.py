"""What readings can give at best, with gauges as they stand: the table of the design, in µm.

Posterior of all errors (translations 0.1 mm, rotations 1 mrad, offsets 2 mm, scales 100 ppm),
r.m.s. over the cube of ±60 mm; direction of a gauge 10 mrad, section 0.5 mm, scale 0.2 %. The
figures are an independent rigid-body model's by finite differences.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from folders import session_folder
from models import JOINTS

from orthocal import load_plan
from orthocal.assessment.tool_error import measure_uncertainty
from orthocal.estimation.problem import build_problem
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.kinematics.workspace import cube
from orthocal.sensors.mounting import Mounting
from orthocal.statistics.information import decompose

OFFSETS = {"*.offset": 2e-3}
SIGMA = 5e-6
AGREED = 0.03


@pytest.fixture(scope="module")
def space(orthoglide):
    return cube(orthoglide, points_per_side=5)


def mounted(plan, how):
    """The plan with gauges that are known so well where and how they stand."""
    setups = {
        name: replace(s, sensor=replace(s.sensor, mounting=how)) for name, s in plan.setups.items()
    }
    return replace(plan, setups=setups)


def once(plan):
    """Each posture of a setup read once."""
    first = {(r.setup, r.posture): r for r in reversed(plan.readings)}
    return replace(plan, readings=tuple(r for r in plan.readings if r in first.values()))


def bound(plan, space, *, sigma, free):
    """R.m.s. error at the tool that the posterior leaves: shift out, and rotation too, [µm]."""
    robot = plan.robot
    names = robot.parameters.select(free)
    problem = build_problem(plan, free=names, prior=True, prior_stds=OFFSETS)
    n = problem.n_machine
    tool = ToolSensitivity(robot, free=problem.free[:n])(LoopClosure(robot).inverse(space.points))
    _, slopes = problem.predict_and_jacobian(np.zeros(problem.n_free))
    posterior = decompose(slopes, problem.observations).covariance(
        sigma=sigma, precision=problem.prior_precision
    )
    scale = problem.theta_scale[:n]
    covariance = posterior[:n, :n] * np.outer(scale, scale)
    sizes = measure_uncertainty(tool, covariance, space, space.points).sizes
    return 1e6 * sizes.relative.rms, 1e6 * sizes.aligned.rms


@pytest.mark.parametrize(
    ("name", "sigma", "joints", "complete"),
    [
        ("raw-cycles", 5e-6, (63.0, 12.2), 14.8),
        ("raw-cycles", 10e-6, (66.0, 16.6), 18.6),
        ("sweep", 5e-6, (61.0, 9.9), 12.7),
        ("sweep", 10e-6, (62.0, 11.1), 13.8),
        ("lines", 5e-6, (None, 8.8), 11.4),
        ("lines", 10e-6, (58.0, 10.1), 12.9),
    ],
)
def test_bounds_are_those_of_the_design(root, space, name, sigma, joints, complete):
    plan = once(load_plan(session_folder(root, name) / "plan.yaml"))
    shift, both = bound(plan, space, sigma=sigma, free=JOINTS)
    assert joints[0] is None or shift == pytest.approx(joints[0], rel=AGREED)
    assert both == pytest.approx(joints[1], rel=AGREED)
    whole = plan.robot.parameters.select_model("full")
    _, both = bound(plan, space, sigma=sigma, free=whole)
    assert both == pytest.approx(complete, rel=AGREED)


@pytest.mark.parametrize(("roll", "left"), [(0.2e-3, 14.8), (1e-3, 39.5), (5e-3, 50.3)])
def test_lines_tell_squareness_as_well_as_the_gauges_direction_is_known(
    root, space, monkeypatch, roll, left
):
    """Roll alone: the pitch of an edge, which the figures do not have, makes 1 to 5 % of it."""
    plan = mounted(
        load_plan(root / "tests/sessions/lines/plan.yaml"), Mounting(roll, 0.0, 0.0, 0.0)
    )
    own = Mounting.nuisance_parameters
    monkeypatch.setattr(
        Mounting,
        "nuisance_parameters",
        lambda self, *, ball: tuple(u for u in own(self, ball=ball) if u.name == "roll"),
    )
    shift, _ = bound(plan, space, sigma=SIGMA, free=JOINTS)
    assert shift == pytest.approx(left, rel=AGREED)


def test_what_was_left_out_of_the_complete_model_is_worth_nothing(root, space, orthoglide):
    """Of all 177 errors the 129 that change something say it all."""
    plan = once(load_plan(root / "examples/raw-cycles/plan.yaml"))
    p = orthoglide.parameters
    assert bound(plan, space, sigma=SIGMA, free=p.of_parts) == pytest.approx(
        bound(plan, space, sigma=SIGMA, free=p.complete), rel=1e-6
    )
