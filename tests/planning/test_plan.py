"""Plans for the Orthoglide: expected errors against manual plans and simulated machines."""

from __future__ import annotations

import gc
import json
import math
import weakref
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from adjusting import shimmed_plan
from calibrated import identified
from models import JOINTS
from plan_searches import assert_machines_have_the_expected_error, candidates_of, search_among
from planned import FEW, QUICK
from uncompared import few_machines, uncompared

from orthocal import (
    Choice,
    draw_errors,
    load_plan,
    load_robot,
    load_session,
    simulate_session,
    summarize,
)
from orthocal.builder.build import make_robot
from orthocal.builder.orthoglide import Orthoglide
from orthocal.errors import ParameterError, SessionError
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.reachable_box import find_workspace
from orthocal.kinematics.workspace import cube
from orthocal.measurement.files.write_session import write_session
from orthocal.measurement.joining import join_sessions
from orthocal.output.report.study_plots import plot_plan
from orthocal.output.text.plan import draw_plan, plan_json
from orthocal.planning import plan as planning
from orthocal.planning.candidates import list_candidates, share_columns
from orthocal.planning.cost_curve import compute_curve, find_enough
from orthocal.planning.equipment import Equipment, choose_box
from orthocal.planning.expected_error import ToolForecast
from orthocal.planning.owned_sensors import Duration
from orthocal.planning.plan import plan_readings
from orthocal.planning.ranking import is_less
from orthocal.planning.selection import PlannedSetup
from orthocal.planning.timed_search import TimedSearch
from orthocal.sensors.mounting import EXACT, Mounting
from orthocal.sensors.tips import Tip
from orthocal.session.session import Gauge
from orthocal.units import UM

OFFSETS = {"*.offset_mm": 4.0}
DIAL = Gauge(5e-6, None, (-5e-3, 5e-3))
BALL = Tip("ball", 1.5e-3)


@pytest.fixture(scope="module")
def planned(orthoglide):
    choice = Choice("full", tolerances=OFFSETS)
    return plan_readings(orthoglide, choice, equipment=Equipment(**QUICK), starts=1)


@pytest.mark.parametrize(
    ("tip", "setups", "each", "most"), [(BALL, 6, 3, 11.4), (None, 6, 16, 9.0)]
)
def test_plans_are_better_than_manual_ones(orthoglide, tip, setups, each, most):
    """Best manual plans for 126 errors, a dial of ±5 mm and 5 µm with mounting errors, [µm].

    Without a tip the dial reads the line between the rods.
    """
    choice = Choice(free=JOINTS, prior=True, tolerances=OFFSETS)
    sections = (0.2, 0.8)
    box = np.array([[-0.1, 0.06]] * 3)
    equipment = Equipment(
        gauge=DIAL, tip=tip, mounting=Mounting(lateral=0.0), sections=sections, box=box, along=5
    )
    forecast = ToolForecast(
        orthoglide, choice.select(orthoglide.parameters), cube(orthoglide, points_per_side=5)
    )
    search = search_among(candidates_of(forecast, equipment), forecast)
    plan = search.choose([each] * setups, starts=1)
    assert round(plan.error * 1e6, 1) <= most


def test_the_error_of_the_search_is_the_posterior_of_the_session(planned):
    """Low-rank algebra over setups gives the error of one problem with all readings."""
    once = replace(
        planned.session, readings=tuple(r for r in planned.session.readings if r.cycle == 1)
    )
    forecast = planned.forecast
    without, complete = (forecast.about_nominal(s).reported.rms for s in (once, planned.session))
    factor = planned.curve[0].error / planned.before.reported.rms
    assert planned.stage.error / factor == pytest.approx(without, rel=1e-4)
    assert planned.stage.error == pytest.approx(planned.expected.reported.rms)
    assert complete < without  # each first posture is read again
    errors = [s.error for s in planned.curve]
    assert errors == sorted(errors, reverse=True)


def test_setups_share_columns_and_parts_of_an_instrument_do_not():
    points, dial = [SimpleNamespace(name=n) for n in ("p.1", "p.2")], SimpleNamespace(name="x")
    owners = ["x_slide", "setup.x", "setup.x", "bar", "setup.p.1", "setup.p.2"]
    columns = share_columns(owners, [0, 3], [points, [dial]])
    assert columns.tolist() == [0, 2, 3, 1, 2, 3]


def test_no_usual_plan_is_better_at_equal_cost(planned):
    names = [a.name for a in planned.usual_plans]
    assert names == ["the paper's", "evenly spaced"]
    for usual in planned.usual_plans:
        assert usual.minutes == pytest.approx(planned.minutes)
        assert not is_less(usual.expected.reported.rms, planned.expected.reported.rms)


def test_the_picture_of_a_plan_states_when_errors_are_expected_and_shows_all_plans(planned):
    assert "after a second measurement" in draw_plan(planned)
    assert "second measurement" not in draw_plan(replace(planned, complements_session=True))
    (axes,) = plot_plan.figure(planned, UM, "").axes
    looks = {line.get_label(): line for line in axes.lines}
    papers, even, this = (looks[n] for n in ("the paper's", "evenly spaced", "this plan"))
    assert papers.get_markerfacecolor() == even.get_markerfacecolor() == "none"
    assert papers.get_markersize() > 1.3 * even.get_markersize() > 1.6 * this.get_markersize()


def test_calibrated_machines_have_the_expected_tool_error(planned):
    assert_machines_have_the_expected_error(planned, offset_mm=0.4)


def test_the_expected_tool_error_is_for_the_stated_workspace(tmp_path):
    dimensions = Orthoglide(travel=(0.1, 0.42), workspace=((-0.08, 0.08),) * 3)
    robot = make_robot(dimensions, tmp_path / "large")
    choice = Choice("full", tolerances=OFFSETS)
    with uncompared():
        plan = plan_readings(robot, choice, equipment=Equipment(**FEW), starts=1)
    assert plan.forecast.workspace.half_side == pytest.approx(0.08)
    small = ToolForecast(robot, plan.forecast.selection, cube(robot, half_side=0.06))
    assert plan.expected.reported.rms > 1.2 * small.after(plan.session).reported.rms


def test_readings_of_machines_at_tolerance_stay_in_the_gauges_range(planned):
    robot = planned.session.robot
    for seed in range(20):
        errors = draw_errors(robot, planned.forecast.selection.names, seed=seed, tolerances=OFFSETS)
        simulate_session(planned.session, errors, seed=seed)  # refuses readings beyond the range


def test_a_written_plan_is_measured_and_calibrated(planned, tmp_path):
    path = write_session(planned.session, tmp_path / "monday", blank=True)
    with pytest.raises(
        SessionError, match=r"readings.csv: no reading is entered yet; run `orthocal record`"
    ):
        load_session(path)
    again = load_plan(path)
    assert [(r.setup, r.posture, r.cycle) for r in again.readings] == [
        (r.setup, r.posture, r.cycle) for r in planned.session.readings
    ]
    errors = draw_errors(again.robot, ["*"], seed=1, tolerances=OFFSETS)
    session = simulate_session(again, errors, seed=1).session
    found = identified(session, Choice("full", tolerances=OFFSETS))
    assert found.noise.cycles_dof == len(again.setups)
    for name in ("x_slide.offset", "y_slide.offset", "z_slide.offset"):
        assert abs(found[name].value - errors[name]) < 4.0 * found[name].std


def test_sections_near_the_tool_are_best_for_the_papers_six_equations(orthoglide):
    """Offsets alone, an exact gauge: μ = 0.2 (0.8 from the root) gives 1.345 σ, 0.5 gives 1.403."""
    equipment = Equipment(
        gauge=Gauge(5e-6, None, None),
        tip=None,
        mounting=EXACT,
        sections=(0.5, 0.65, 0.8),
        box=np.array([[-0.1, 0.06]] * 3),
        along=2,
        across=0.0,
    )
    forecast = ToolForecast(orthoglide, Choice("offsets").select(orthoglide.parameters))
    candidates = candidates_of(forecast, equipment)
    found = search_among(candidates, forecast, criterion="A", prior=1e-8).choose([2] * 6, starts=4)
    setups = candidates.session.setups
    chosen = [setups[candidates.setups[s.candidate].name].sensor for s in found.setups]
    # the largest section at which the gauge touches the leg in all postures
    assert {s.section.value for s in chosen} == {0.8}
    # all six, or three of them twice, one for each leg, which have equal information
    assert sorted(s.leg for s in chosen) == list("xxyyzz")
    tolerance = np.array([orthoglide.parameters[name].prior_std for name in candidates.state])
    std = tolerance * np.sqrt(np.linalg.inv(found.information).diagonal())
    assert std / (np.sqrt(2.0) * 5e-6) == pytest.approx([1.3448] * 3, abs=1e-4)


def test_further_setups_combine_with_the_measured_session(orthoglide, root):
    measured = load_session(root / "examples/workshop")
    choice = Choice("full", tolerances=OFFSETS)
    plan = plan_readings(
        orthoglide, choice, setups=2, measured=measured, equipment=Equipment(**FEW), starts=1
    )
    forecast = plan.forecast
    assert plan.before.reported.rms == pytest.approx(
        forecast.after(measured, entered=False).reported.rms
    )
    assert plan.expected.reported.rms < plan.before.reported.rms
    # the curve begins with the readings of the session, with the same dial
    joined = join_sessions([measured.with_tolerances(OFFSETS), plan.session])
    once = replace(joined, readings=tuple(r for r in joined.readings if r.cycle == 1))
    factor = plan.stage.error / forecast.about_nominal(once).reported.rms
    known = forecast.about_nominal(measured).reported.rms
    assert plan.curve[0].error == pytest.approx(factor * known, rel=1e-3)
    assert set(plan.session.setups).isdisjoint(measured.setups)


@pytest.mark.usefixtures("without_sensor_gains")
def test_further_setups_have_the_adjustments_of_the_measured_session(tmp_path):
    planned = shimmed_plan(tmp_path / "mine")
    amounts = {next(iter(planned.robot.declared.adjustments)): 0.5e-3}
    measured = replace(simulate_session(planned, {}).session, adjusted=amounts)
    with uncompared(), few_machines():
        plan = plan_readings(
            planned.robot, setups=1, measured=measured, equipment=Equipment(**FEW), starts=1
        )
    assert plan.session.adjusted == amounts


@pytest.mark.parametrize("name", ["orthoglide", "inclined_orthoglide", "linear_delta"])
def test_each_leg_is_read_in_two_directions(name):
    """Each candidate is listed once, also at legs that no axis of the world is perpendicular to."""
    robot = load_robot(name)
    session = list_candidates(robot, Equipment(**FEW))
    assert len({r.key for r in session.readings}) == len(session.readings)
    sensors = [session.setups[n].sensor for n in {r.setup for r in session.readings}]
    assert len({(s.leg, s.direction) for s in sensors}) == 2 * len(robot.legs)


@pytest.mark.usefixtures("without_sensor_gains")
def test_setups_are_named_after_their_legs(orthoglide):
    """Also if the names of the legs end in numbers."""
    legs = {f"leg_{i}": leg for i, leg in enumerate(orthoglide.legs.values(), 1)}
    legs = {name: replace(leg, name=name) for name, leg in legs.items()}
    with uncompared(), few_machines():
        plan = plan_readings(replace(orthoglide, legs=legs), equipment=Equipment(**FEW), starts=1)
    assert {s.name[1:] == s.sensor.leg for s in plan.session.setups.values()} == {True}


def test_a_box_is_limited_to_the_reach_of_the_tool(orthoglide):
    """Drives move from 120 to 390 mm and are at 310 mm in the mechanical zero: -190 to 79 mm, less
    a margin."""
    within = np.array([[-0.12, 0.07], [-0.12, 0.07], [0.0, 0.06]])
    assert np.array_equal(choose_box(orthoglide, within), within)
    assert choose_box(orthoglide, None) == pytest.approx(np.array([[-0.1, 0.07]] * 3))
    large = choose_box(orthoglide, np.array([[-0.5, 0.5], [-0.5, 0.02], [-9.0, 9.0]]))
    assert large == pytest.approx(np.array([[-0.18, 0.07], [-0.18, 0.02], [-0.18, 0.07]]))
    beside = np.array([[0.3, 0.5]] * 3)
    assert np.array_equal(choose_box(orthoglide, beside), beside)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"setups": 3, "readings": 5}, "readings: found 5; expected at least 6, 2 for each of 3"),
        ({"setups": 41}, "setups: found 41; expected 1 to 40"),
        ({"hours": 0.1}, "hours: found 0.1; expected at least 0.2"),
        ({"hours": math.nan}, "hours: found nan; expected a positive number"),
        (
            {"hours": 1.0, "equipment": Equipment(minutes_per_setup=0, minutes_per_reading=0)},
            "hours: found 1; expected .* at most 40 setups",
        ),
        ({"hours": 1.0, "setups": 3}, "hours: found together with setups or readings"),
        (
            {"readings": 600, "setups": 2, "equipment": Equipment(**QUICK)},
            "plan: no setup can have 300 readings",
        ),
        ({"equipment": Equipment(rods=("c",))}, "touches: 'c' is not a rod of leg x; rods: a, b"),
    ],
)
def test_contradictory_arguments_are_refused(orthoglide, arguments, message):
    """Errors name arguments of the function, not options of the command line."""
    with pytest.raises(ParameterError, match=f"^{message}"):
        plan_readings(orthoglide, "full", **arguments)


@pytest.mark.parametrize("leg", [0.1, 0.31025])
def test_the_default_workspace_keeps_clear_of_the_end_of_the_reach(tmp_path, leg):
    """The machine is singular there."""
    sizes = Orthoglide(leg=leg, travel=(0.3 * leg, 1.6 * leg), attachment=0.02, rods_apart=0.04)
    robot = make_robot(sizes, tmp_path / "mine")
    space = find_workspace(robot)
    assert space.half_side == (0.06 if leg > 0.2 else pytest.approx(0.04, abs=0.02))
    drives = LoopClosure(robot).inverse(1.07 * space.points)
    assert (drives >= sizes.travel[0]).all()
    assert (drives <= sizes.travel[1]).all()
    forecast = ToolForecast(robot, Choice("full").select(robot.parameters))
    assert forecast.before.reported.largest < 0.5 * space.half_side


def make_search(robot, equipment):
    forecast = ToolForecast(robot, Choice("full").select(robot.parameters))
    return search_among(candidates_of(forecast, equipment, spare_range=3.0), forecast)


def test_the_memory_of_a_plan_is_released_with_it(orthoglide):
    """No cache holds its candidates, their matrices and pairs."""
    equipment = Equipment(**FEW)
    search = make_search(orthoglide, equipment)
    candidates = search.candidates
    plan = search.choose([3] * 3, starts=2)
    list(search.grow([3] * 3))
    arrays = [s.reachable for s in candidates.setups] + [p.first for p in search.pairs]
    kept = [weakref.ref(array) for array in arrays]
    del arrays, candidates, search, plan
    gc.collect()
    assert [ref for ref in kept if ref() is not None] == []


@pytest.mark.usefixtures("without_sensor_gains")
def test_usual_plans_that_the_dial_cannot_read_have_no_expected_error(orthoglide):
    """The paper's readings differ by more than ±0.4 mm."""
    equipment = Equipment(gauge=Gauge(5e-6, 10e-6, (-4e-4, 4e-4)), **FEW)
    choice = Choice("full", tolerances={"*.offset_mm": 0.4})
    with few_machines():
        plan = plan_readings(orthoglide, choice, equipment=equipment, starts=1)
    assert [(a.name, a.expected) for a in plan.usual_plans] == [
        ("the paper's", None),
        ("evenly spaced", None),
    ]
    assert summarize(plan).count("beyond the dial's range") == 2
    compared = json.loads(plan_json(plan))["usual_plans"]
    assert [(a["in_range"], a["aligned_um"]) for a in compared] == [(False, None)] * 2


def test_enough_does_not_depend_on_the_number_of_setups_of_the_plan(orthoglide):
    equipment = Equipment(**FEW)
    durations = {"": Duration(equipment.minutes_per_setup, equipment.minutes_per_reading)}
    search = TimedSearch(make_search(orthoglide, equipment), durations)
    curves = [compute_curve(search, 3, planned) for planned in (1, 9)]
    few, many = (find_enough(curve) for curve in curves)
    assert few == many is not None
    assert len(curves[1]) > len(curves[0]) > few.setups


def test_a_usual_plan_that_is_better_is_preferred(orthoglide, monkeypatch):
    """Ten readings repeat postures of the paper."""
    readings = 10
    plan = plan_badly(orthoglide, monkeypatch, readings=readings)
    assert len(plan.session.readings) == readings + 2
    assert len({r.key for r in plan.session.readings}) == readings + 2
    assert [a.readings for a in plan.usual_plans] == [readings + 2] * 2
    assert plan.better_usual_plans == []
    assert plan.expected.reported.rms <= min(a.expected.reported.rms for a in plan.usual_plans)


def test_usual_plans_are_preferred_for_tool_errors_only(orthoglide, monkeypatch):
    plan = plan_badly(orthoglide, monkeypatch, readings=6, criterion="D")
    assert plan.expected.reported.rms > min(a.expected.reported.rms for a in plan.usual_plans)


def plan_badly(robot, monkeypatch, **options):
    """Plan of a search that returns the first candidate setup twice."""
    monkeypatch.setattr(planning, "_search_setups", worst_setups)
    choice = Choice("full", tolerances=OFFSETS)
    with few_machines():
        return plan_readings(robot, choice, setups=2, equipment=Equipment(**QUICK), **options)


def worst_setups(timed, candidates, options, work):
    (counts,) = options
    first = candidates.setups[0]
    chosen = [tuple(np.flatnonzero(first.reachable[0])[:n].tolist()) for n in counts]
    return timed.search.plan_of([PlannedSetup(0, rows) for rows in chosen])
