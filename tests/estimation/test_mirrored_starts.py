"""Mirrored starts: which parameters have them, both sides are tried, no extra cost elsewhere."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar
from unittest.mock import patch

import casadi as ca
import numpy as np
import pytest
from planned import entered
from tolerances import SAME_NUMBER

from orthocal.errors import ClosureError, SolverError
from orthocal.estimation.mirrored_starts import mirrored_starts
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.estimation.solvers.variable_projection import VariableProjection
from orthocal.observation.simulate import draw_errors, simulate_session
from orthocal.planning.equipment import place_tool
from orthocal.sensors.ball_bar import BallBar
from orthocal.sensors.protocol import Frames, GaugeZero, NuisanceParameter, ToolSensor
from orthocal.session.session import Gauge, Reading, Session, Setup

LENGTH, SIGMA, POINTS = 0.05, 2e-6, 8
FOOT = np.array([0.01, -0.005, 0.0])
"""Centre of the circle on which the tool moves, [m]."""


@dataclass(frozen=True, slots=True)
class HeightGauge(ToolSensor):
    """Sensor of another package: distance from a point at an uncertain height under the tool."""

    centre: tuple[float, float, float]
    kind: ClassVar[str] = "height_gauge"
    noun: ClassVar[str] = "a height gauge"
    ideal: ClassVar[str] = "its circle"
    zero: ClassVar[GaugeZero] = "known"
    mirrored: ClassVar[tuple[str, ...]] = ("height",)

    def describe(self):
        return "height gauge"

    def frames(self, robot):
        return Frames((robot.tcp.frame,))

    def constants(self, robot):
        del robot
        return np.array(self.centre)

    @property
    def nuisance_parameters(self):
        return (NuisanceParameter("height", "m", 1e-3), NuisanceParameter("radius", "m", 1e-6))

    def expression(self, view, robot):
        del robot
        (tool,) = view.frames
        lever = tool.position - view.constants[:3] - ca.vertcat(0.0, 0.0, view.nuisance[0])
        return ca.norm_2(lever) - LENGTH - view.nuisance[1]


def bar_at(height, **keys):
    return BallBar((*FOOT[:2], -height), LENGTH, **keys)


def circles(robot, sensors, *, planes=((0, 1),)):
    """Plan whose tool moves on circles about `FOOT`, read by each sensor."""
    angles = 2.0 * np.pi * np.arange(POINTS) / POINTS
    points = []
    for i, j in planes:
        circle = np.tile(FOOT, (POINTS, 1))
        circle[:, i] += LENGTH * np.cos(angles)
        circle[:, j] += LENGTH * np.sin(angles)
        points.append(circle[:, list(robot.tcp.coordinates)])
    points = np.vstack(points)
    postures = place_tool(robot, [f"p{k}" for k in range(len(points))], points)
    return Session(
        robot=robot,
        robot_reference=robot.name,
        gauges={"bar": Gauge(sigma=SIGMA)},
        postures=postures,
        setups={n: Setup(n, s, "bar", zero="known") for n, s in sensors.items()},
        readings=tuple(Reading(n, p) for n in sensors for p in postures),
    )


def problem_of(plan, *, seed=0):
    names = build_problem(plan, model="full").machine_selection.names
    errors = draw_errors(plan.robot, names, seed=seed)
    return build_problem(simulate_session(plan, errors, seed=seed).session, model="full")


def mirrored_names(problem):
    """Names of the parameters along the mirrored directions."""
    return [
        problem.free[i] for v in problem.mirrored.directions for i in np.flatnonzero(abs(v) > 0.9)
    ]


@pytest.mark.parametrize("height", [0.0, 1e-3])
@pytest.mark.parametrize("robot", ["biglide", "orthoglide"])
def test_a_height_over_the_circle_of_the_tool_is_mirrored(robot, height):
    problem = build_problem(circles(entered(robot), {"a": bar_at(height)}), model="full")
    assert mirrored_names(problem) == ["setup.a.centre_z"]


def solve(problem, **options):
    """Calls of descents while variable projection solves a problem."""
    program = VariableProjection(problem, options=SolverOptions(**options))
    descend = VariableProjection._descend
    with patch.object(VariableProjection, "_descend", autospec=True, side_effect=descend) as spy:
        program.solve(sigma=SIGMA)
    return spy.call_args_list


@pytest.mark.parametrize(
    ("height", "planes"),
    [(0.02, ((0, 1),)), (0.0, ((0, 1), (1, 2)))],
    ids=["far from the plane", "circles in two planes"],
)
def test_a_ball_in_general_position_has_one_start(height, planes):
    problem = problem_of(circles(entered("orthoglide"), {"a": bar_at(height)}, planes=planes))
    assert len(problem.mirrored) == 0
    assert len(solve(problem)) == 1


def test_of_many_directions_at_most_two_change_sides_at_once():
    """With 40 directions all 2^40 combinations would not fit into memory."""
    count, height = 40, 2.0
    starts = mirrored_starts(
        lambda changes: (np.full(count, height) + changes)[None] ** 2,
        np.full((1, count), height),
        np.eye(count),
    )
    changed = (starts[:, 0] != height).sum(axis=1)
    assert np.bincount(changed).tolist() == [0, count, count * (count - 1) // 2]
    assert np.unique(starts).tolist() == pytest.approx([-height, height])


def test_the_largest_number_of_iterations_applies_to_mirror_images():
    calls = solve(problem_of(circles(entered("biglide"), {"a": bar_at(0.0)})), max_iterations=25)
    assert len(calls) > 1
    assert {call.args[3] for call in calls} == {25}


def test_a_shared_ball_is_mirrored_once():
    bars = {n: bar_at(0.0, ball="post") for n in "ab"}
    assert mirrored_names(build_problem(circles(entered("biglide"), bars), model="full")) == [
        "ball.post.centre_z"
    ]


def test_heights_that_noise_hides_are_not_compared():
    """All circles change by less than the noise if a height changes by its prior std."""
    problem = problem_of(circles(entered("biglide"), {"a": bar_at(0.0)}))
    assert len(problem.mirrored.of_task(SIGMA, ())) == 1
    assert len(problem.mirrored.of_task(100e-6, ())) == 0
    one, other = (
        VariableProjection(problem).solve(sigma=100e-6, mirrored=m) for m in (True, False)
    )
    assert one.iterations == other.iterations


def test_mirrored_directions_are_in_the_unit_of_the_readings():
    """Readings of half the unit have twice the curvature, also of a problem in other units."""
    problem = problem_of(circles(entered("biglide"), {"a": bar_at(0.0)}))
    curvature = problem.mirrored.curvatures
    halved = problem.with_noise_ratio(np.full(problem.observations.size, 0.5))
    assert halved.mirrored.curvatures == pytest.approx(2.0 * curvature)


def test_a_prescribed_height_keeps_its_value():
    problem = problem_of(circles(entered("biglide"), {"a": bar_at(0.0), "b": bar_at(1e-3)}))
    height = problem.free.index("setup.a.centre_z")
    found = VariableProjection(problem).solve(sigma=SIGMA, prescribed={height: 0.5e-3})
    assert found.theta[height] == pytest.approx(0.5e-3)


def best_of_all_signs(problem, names):
    """Smallest and largest objective from all combinations of signs, and from 0."""
    program = VariableProjection(problem)
    objectives = [program.solve(sigma=SIGMA, mirrored=False).objective]
    for signs in itertools.product((1.0, -1.0), repeat=len(names)):
        start = problem.active_theta.copy()
        start[[problem.free.index(n) for n in names]] = np.multiply(signs, 1e-3)
        try:
            found = program.solve(sigma=SIGMA, start=start, mirrored=False)
        except (ClosureError, SolverError):
            continue
        objectives.append(found.objective)
    return min(objectives), max(objectives)


def test_all_solvers_find_the_better_sides():
    """Some other starts end in worse optima, or on the saddle between both signs."""
    plan = circles(entered("biglide"), {"a": bar_at(0.0), "b": HeightGauge(tuple(FOOT))})
    differences, values, alone = [], [], []
    for seed in (0, 1):
        problem = problem_of(plan, seed=seed)
        assert len(problem.mirrored) == 2
        best, worst = best_of_all_signs(problem, mirrored_names(problem))
        differences.append(worst - best)
        values.append(problem.values)
        found = VariableProjection(problem).solve(sigma=SIGMA)
        assert found.objective == pytest.approx(best, rel=SAME_NUMBER)
        alone.append(found.objective)
    found = NonlinearProgram(problem).solve(sigma=SIGMA)
    assert found.objective == pytest.approx(best, rel=SAME_NUMBER)
    batch = BatchSolver(problem).solve(values, sigma=SIGMA)
    assert batch.objective == pytest.approx(alone, rel=SAME_NUMBER)
    assert max(differences) > 0.1
