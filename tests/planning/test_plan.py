"""Plans on the Orthoglide: what they promise, against what was tried by hand, and what comes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from models import JOINTS

from orthocal import Choice, calibrate, draw_errors, load_plan, load_session, simulate_session
from orthocal.errors import ParameterError, SessionError
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.solvers.batch import BatchProgram
from orthocal.kinematics.loop_closure import Assembly
from orthocal.kinematics.workspace import cube
from orthocal.measurement.files.write_session import write_session
from orthocal.measurement.joining import join_sessions
from orthocal.planning.candidates import list_candidates, measure_candidates
from orthocal.planning.equipment import Means, choose_box, find_box
from orthocal.planning.expected_error import ToolForecast, default_workspace
from orthocal.planning.plan import plan_readings
from orthocal.planning.selection import choose_setups
from orthocal.robot.builder.build import Sizes, make_robot
from orthocal.sensors.mounting import EXACT, Standing
from orthocal.sensors.tips import Tip
from orthocal.session.session import Gauge

OFFSETS = {"*.offset_mm": 2.0}
DIAL = Gauge(5e-6, None, (-5e-3, 5e-3))
BALL = Tip("ball", 1.5e-3)


@pytest.fixture(scope="module")
def planned(orthoglide):
    return plan_readings(orthoglide, Choice("full", tolerances=OFFSETS), starts=1)


@pytest.mark.parametrize(
    ("tip", "setups", "each", "most"),
    [(BALL, 6, 3, 11.4), (BALL, 6, 9, 10.3), (None, 6, 16, 9.0)],
)
def test_plans_beat_what_was_tried_by_hand(orthoglide, tip, setups, each, most):
    """126 errors, a dial of ±5 mm that stands as dials do, 5 µm: the design's best so far, [µm].

    An edge across the leg reads the line between its rods.
    """
    choice = Choice(free=JOINTS, prior=True, tolerances=OFFSETS)
    sections = (0.2, 0.4, 0.6, 0.8)
    box = np.array([[-0.1, 0.06]] * 3)
    means = Means(
        gauge=DIAL, tip=tip, standing=Standing(lateral=0.0), sections=sections, box=box, along=9
    )
    forecast = ToolForecast(
        orthoglide, choice.select(orthoglide.parameters), cube(orthoglide, points_a_side=5)
    )
    session = list_candidates(orthoglide, means)
    candidates = measure_candidates(session, forecast.problem(session), spare_range=0.0)
    found = choose_setups(
        candidates,
        [each] * setups,
        prior=np.eye(len(candidates.state)),
        weigh=forecast.weigh("aligned", len(candidates.state)),
        starts=4 if each == 3 else 1,
    )
    assert round(found.left * 1e6, 1) <= most


def test_what_is_promised_is_the_posterior_of_the_session_itself(planned):
    """All errors free: low-rank algebra over setups against one problem of the whole session."""
    first = replace(
        planned.session,
        readings=tuple(r for r in planned.session.readings if r.cycle == 1),
    )
    forecast = planned.forecast
    whole, again = (forecast.about_nominal(s).headline.rms for s in (first, planned.session))
    more = planned.expected.headline.rms / again
    stage = planned.curve[len(planned.session.setups)]
    assert stage.error == pytest.approx(more * whole, rel=1e-4)
    assert again < whole  # each first posture is read again
    errors = [s.error for s in planned.curve]
    assert errors == sorted(errors, reverse=True)


def test_a_plan_is_no_worse_than_usual_ones_at_equal_cost(planned):
    names = [a.name for a in planned.compared]
    assert names == ["the paper's", "even"]
    for usual in planned.compared:
        assert usual.minutes == pytest.approx(planned.minutes)
        assert planned.expected.headline.rms < usual.expected.headline.rms


def test_machines_that_were_read_as_planned_are_as_good_as_promised(planned):
    """Readings of 100 machines near nominal, gauges as they stand, calibrated with all errors."""
    robot = planned.session.robot
    problem = CalibrationProblem(planned.session, planned.forecast.selection)
    rng = np.random.default_rng(0)
    names = problem.machine_selection.names
    truths = []
    for seed in range(100):
        drawn = draw_errors(robot, names, seed=seed, tolerances={"*.offset_mm": 0.2})
        own = rng.normal(size=problem.n_free - problem.n_machine)
        truths.append([*(drawn[n] for n in names), *(own * problem.theta_scale[len(names) :])])
    theta = np.array(truths)
    sigma = float(np.hypot(5e-6, 10e-6 / np.sqrt(12.0)))
    values, _, reached = problem.simulate(theta)
    assert reached.all()
    values = values + sigma * rng.normal(size=values.shape)
    found = BatchProgram(problem).solve(values, sigma=sigma).theta
    forecast = planned.forecast
    drives = Assembly(robot).inverse(forecast.workspace.points)
    assembly, n = Assembly(robot, free=names), problem.n_machine
    squares = []
    for truth, estimate in zip(theta, found, strict=True):
        missed = assembly.forward(drives, theta=estimate[:n]) - assembly.forward(
            drives, theta=truth[:n]
        )
        aligned = forecast.align(missed)
        squares.append(forecast.workspace.weights @ (aligned**2).sum(axis=1))
    assert np.sqrt(np.mean(squares)) == pytest.approx(planned.expected.headline.rms, rel=0.05)


def test_readings_of_machines_at_tolerance_stay_in_the_gauges_range(planned):
    robot = planned.session.robot
    for seed in range(20):
        errors = draw_errors(robot, planned.forecast.selection.names, seed=seed, tolerances=OFFSETS)
        simulate_session(planned.session, errors, seed=seed)  # refuses what leaves it


def test_a_setup_begins_where_its_gauge_is_set_and_ends_there(planned):
    for name in planned.session.setups:
        own = [r for r in planned.session.readings if r.setup == name]
        assert (own[0].posture, own[0].cycle, own[-1].cycle) == (own[-1].posture, 1, 2)
        assert len({r.posture for r in own}) == len(own) - 1


def test_a_folder_is_ready_to_measure(planned, tmp_path):
    path = write_session(planned.session, tmp_path / "monday", blank=True)
    with pytest.raises(
        SessionError, match=r"readings.csv: nothing was read yet; `orthocal record` takes"
    ):
        load_session(path)
    again = load_plan(path)
    assert [(r.setup, r.posture, r.cycle) for r in again.readings] == [
        (r.setup, r.posture, r.cycle) for r in planned.session.readings
    ]
    errors = draw_errors(again.robot, ["*"], seed=1, tolerances=OFFSETS)
    session = simulate_session(again, errors, seed=1).session
    found = calibrate(session, Choice("full", tolerances=OFFSETS), solver="eliminated")
    assert found.noise.cycles_dof == len(again.setups)
    for name in ("x_slide.offset", "y_slide.offset", "z_slide.offset"):
        assert abs(found[name].value - errors[name]) < 4.0 * found[name].std


def test_sections_near_the_tool_are_best_for_the_papers_six_equations(orthoglide):
    """Offsets alone, an exact gauge: μ = 0.2 (0.8 from the root) gives 1.345 σ, 0.5 gives 1.403."""
    means = Means(
        gauge=Gauge(5e-6, None, None),
        tip=None,
        standing=EXACT,
        sections=(0.5, 0.65, 0.8),
        box=np.array([[-0.1, 0.06]] * 3),
        along=2,
        across=0.0,
    )
    forecast = ToolForecast(orthoglide, Choice("offsets").select(orthoglide.parameters))
    session = list_candidates(orthoglide, means)
    # the gauge's section is where the leg still is with the tool at its far end
    candidates = measure_candidates(session, forecast.problem(session), spare_range=0.0)
    found = choose_setups(
        candidates,
        [2] * 6,
        prior=1e-8 * np.eye(len(candidates.state)),
        weigh=forecast.weigh("A", len(candidates.state)),
    )
    chosen = [session.setups[candidates.kinds[s.kind].name].sensor for s in found.setups]
    assert {s.section.value for s in chosen} == {0.8}
    # all six, or three of them twice, one a leg, which say exactly as much
    assert sorted(s.leg for s in chosen) == list("xxyyzz")
    tolerance = np.array([orthoglide.parameters[name].tolerance for name in candidates.state])
    std = tolerance * np.sqrt(np.linalg.inv(found.information).diagonal())
    assert std / (np.sqrt(2.0) * 5e-6) == pytest.approx([1.3448] * 3, abs=1e-4)


def test_more_setups_on_top_of_a_session_are_worth_what_both_say(orthoglide, root):
    measured = load_session(root / "examples/workshop")
    choice = Choice("full", tolerances=OFFSETS)
    plan = plan_readings(orthoglide, choice, setups=2, measured=measured, starts=1)
    forecast = plan.forecast
    assert plan.known.headline.rms == pytest.approx(forecast.after(measured).headline.rms)
    assert plan.expected.headline.rms < plan.known.headline.rms
    # the curve begins with what is known: readings of the session, with the same dial
    whole = join_sessions([measured, plan.session])
    more = plan.expected.headline.rms / forecast.about_nominal(whole).headline.rms
    known = forecast.about_nominal(measured).headline.rms
    assert plan.curve[0].error == pytest.approx(more * known, rel=1e-3)
    assert set(plan.session.setups).isdisjoint(measured.setups)


def test_a_box_ends_where_the_tool_still_gets(orthoglide):
    """Drives go from 120 to 390 mm and are at 310 in the zero: -190 to 79 mm, less some room."""
    whole = np.array([[-0.12, 0.07], [-0.12, 0.07], [0.0, 0.06]])
    assert np.array_equal(choose_box(orthoglide, whole), whole)
    assert np.array_equal(choose_box(orthoglide, None), find_box(orthoglide))
    large = choose_box(orthoglide, np.array([[-0.5, 0.5], [-0.5, 0.02], [-9.0, 9.0]]))
    assert large == pytest.approx(np.array([[-0.18, 0.07], [-0.18, 0.02], [-0.18, 0.07]]))
    beside = np.array([[0.3, 0.5]] * 3)
    assert np.array_equal(choose_box(orthoglide, beside), beside)


def test_the_box_is_what_the_tool_reaches(orthoglide):
    assert find_box(orthoglide) == pytest.approx(np.array([[-0.1, 0.07]] * 3))


def test_hours_are_shared_out(orthoglide):
    plan = plan_readings(
        orthoglide, "full", hours=1.0, starts=1, means=Means(along=3, across=0.0, sections=(0.5,))
    )
    assert 45.0 < plan.minutes <= 60.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"setups": 3, "readings": 5}, "--readings: found 5; expected at least 6, 2 for each of 3"),
        ({"setups": 41}, "--setups: found 41; expected 1 to 40"),
        ({"hours": 0.1}, "--hours: found 0.1; expected at least 0.2"),
        ({"hours": 1.0, "setups": 3}, "--hours: found with --setups or --readings"),
        ({"readings": 600, "setups": 2}, "no setup can take 300 readings"),
        ({"means": Means(rods=("c",))}, "touches: 'c' is not a rod of leg x; rods: a, b"),
    ],
)
def test_what_cannot_be_planned_is_refused(orthoglide, arguments, message):
    with pytest.raises(ParameterError, match=message):
        plan_readings(orthoglide, "full", **arguments)


@pytest.mark.parametrize("leg", [0.1, 0.31025])
def test_the_cube_keeps_clear_of_where_a_machine_just_gets_to(tmp_path, leg):
    """There it is singular: nothing that is promised of the tool would mean anything."""
    sizes = Sizes(leg=leg, lower=0.3 * leg, upper=1.6 * leg, attachment=0.02, rods_apart=0.04)
    robot = make_robot(sizes, tmp_path / "mine")
    space = default_workspace(robot)
    assert space.half_side == (0.06 if leg > 0.2 else pytest.approx(0.04, abs=0.02))
    drives = Assembly(robot).inverse(1.07 * space.points)
    assert (drives >= sizes.lower).all()
    assert (drives <= sizes.upper).all()
    forecast = ToolForecast(robot, Choice("full").select(robot.parameters))
    assert forecast.before.headline.largest < 0.5 * space.half_side
