"""Plans with sensors at the tool: placements, ranges, tool errors against manual plans."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import replace

import numpy as np
import plans
import pytest
from ball_bar_plans import circles
from calibrated import identified
from commands import run_orthocal
from machines import frame_pose, frames
from plan_searches import assert_machines_have_the_expected_error, candidates_of
from planned import FEW, QUICK, entered, quick_plan
from tolerances import SAME_NUMBER, SAME_OPTIMUM
from uncompared import few_balls, few_machines, uncompared

from orthocal import (
    load_plan,
    load_robot,
    plan_readings,
    simulate_session,
    summarize,
)
from orthocal.assessment.judgement import judge_session
from orthocal.effects.loading import with_effects
from orthocal.errors import ParameterError, SessionError, UnreachablePathError
from orthocal.estimation.choice import resolve_choice
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.estimation.solvers.variable_projection import VariableProjection
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.measurement.joining import join_sessions
from orthocal.measurement.motion.motion import plan_motion
from orthocal.measurement.motion.motion_program import ProgramOptions, write_program
from orthocal.observation.gauge_noise import stated_sigma
from orthocal.observation.simulate import draw_errors
from orthocal.output.sheet.page import sheet_files
from orthocal.output.text.plan import describe_absent, plan_json
from orthocal.planning import plan as planning
from orthocal.planning import planned_session, tool_candidates
from orthocal.planning.candidates import list_candidates, measure_candidates
from orthocal.planning.equipment import Equipment, choose_box, equipment_of, place_tool
from orthocal.planning.expected_error import ToolForecast
from orthocal.planning.first_plan import paper_plan
from orthocal.planning.owned_sensors import load_owned_sensor
from orthocal.planning.planned_session import _order_readings, build_session
from orthocal.planning.selection import PlannedSetup, SetupSearch
from orthocal.planning.tool_candidates import list_tool_candidates, segment_distances
from orthocal.sensors.ball_bar import SAGITTA, BallBar
from orthocal.session.points import names_in_files
from orthocal.session.session import Conditions, Gauge, Reading, Session, Setup

BAR = """sensor: ball_bar
sigma_mm: 0.002
range_mm: [-25, 25]
length_mm: 50
length_tolerance_mm: unknown
"""
SQUARE = """sensor: tool_indicator
sigma_mm: 0.005
resolution_mm: 0.01
range_mm: [-5, 5]
artefact: {kind: square, straight_tolerance_mm: 0.002, square_tolerance_mrad: 0.02, length_mm: 150}
"""
PLATE = SQUARE.replace("square, straight_tolerance_mm: 0.002, square_tolerance_mrad: 0.02",
                       "plate, flat_tolerance_mm: 0.003")  # fmt: skip
BLOCK = SQUARE.replace(
    "square, straight_tolerance_mm: 0.002, square_tolerance_mrad: 0.02, length_mm: 150",
    "gauge_block, height_mm: 50, height_tolerance_mm: 0.0005",
)
PROBE = "sensor: probe\nsigma_mm: 0.01\n"
TRACKER = "sensor: points\nsigma_mm: 0.01\ntarget_mm: [0, 0, -40]\n"
CORRELATED = "covariance_um2: [[90, 40, 0], [40, 60, 0], [0, 0, 400]]\n"


@pytest.fixture(scope="module")
def owned(tmp_path_factory):
    """Sensors of files with these names and texts."""

    def load(**texts):
        folder, sensors = tmp_path_factory.mktemp("owned"), []
        for name, text in texts.items():
            (folder / f"{name}.yaml").write_text(text)
            sensors.append(load_owned_sensor(folder / f"{name}.yaml"))
        return tuple(sensors)

    return load


@pytest.fixture(scope="module")
def planned(owned):
    """Plan of two hours with a dial at the legs, a bar, a square and a plate."""
    sensors = owned(bar=BAR, square=SQUARE, plate=PLATE)
    equipment = Equipment(owned=sensors, **FEW)
    with few_balls(7), uncompared():
        return plan_readings(entered("orthoglide"), hours=2.0, equipment=equipment, starts=1)


def test_a_plan_from_a_better_usual_plan_takes_the_stated_time(owned, monkeypatch):
    """A precise bar that takes 55 minutes would replace each setup of the usual plan."""
    bar = "sensor: ball_bar\nlength_mm: 80\nsigma_mm: 0.0005\nminutes_per_setup: 55\n"
    equipment = Equipment(owned=owned(bar=bar + "centre_tolerance_mm: 0.001\n"), **FEW)

    def search_badly(timed, candidates, *_):
        which = next(i for i, s in enumerate(candidates.setups) if s.gauge == "dial")
        return timed.search.plan_of([PlannedSetup(which, (0, 1))] * 5)

    monkeypatch.setattr(planning, "_search_setups", search_badly)
    with few_balls(2), few_machines():
        plan = plan_readings(entered("orthoglide"), hours=1.0, equipment=equipment, starts=1)
    assert plan.usual_plans
    assert plan.minutes <= 60.0 + 1e-9


def test_sensors_share_the_time_of_six_setups(owned, orthoglide):
    """In whole minutes, too."""
    equipment = Equipment(owned=owned(bar=BAR), minutes_per_setup=10, minutes_per_reading=1)
    minutes = planning._counts_or_minutes(None, None, None, equipment, orthoglide)
    assert isinstance(minutes, float)
    assert minutes == 6 * (10 + 4)


def test_a_time_too_short_for_any_setup_is_refused(owned, orthoglide):
    equipment = Equipment(owned=owned(bar=BAR), **FEW)
    with few_balls(1), pytest.raises(ParameterError, match="found 3 min; expected at least"):
        plan_readings(orthoglide, hours=0.05, equipment=equipment)


def test_a_plan_beside_other_sensors_has_the_dial_of_the_legs(orthoglide):
    """Whichever gauge is listed first."""
    plan = paper_plan(orthoglide, Equipment())
    bar = BallBar(length=50e-3, centre=(50e-3, 0.0, 0.0), ball="post")
    gauges = {"bar": Gauge(1e-6, None, (-1e-3, 1e-3)), "dial": Gauge(10e-6, 10e-6, (-5e-3, 5e-3))}
    setups = {name: replace(s, gauge="dial") for name, s in plan.setups.items()}
    setups["bar"] = Setup("bar", bar, "bar", zero="known")
    readings = (*plan.readings, Reading("bar", "zero"))
    for order in (("bar", "dial"), ("dial", "bar")):
        named = {name: gauges[name] for name in order}
        session = replace(plan, gauges=named, setups=setups, readings=readings)
        found = equipment_of(session.with_values(np.zeros(len(readings))), Equipment())
        assert found.gauge == gauges["dial"]


def test_every_candidate_posture_touches_its_artefact(owned, orthoglide):
    """The zero of the bar is free, as its file states."""
    sensors = owned(bar=BAR + "zero: free\n", square=SQUARE, plate=PLATE, block=BLOCK)
    with few_balls(2):
        gauges, postures, setups, readings = list_tool_candidates(orthoglide, sensors, None)
    assert {s.zero for s in setups.values() if s.gauge == "bar"} == {"free"}
    assert set(gauges) == {"bar", "square", "plate", "block"}
    assert {s.gauge for s in setups.values()} == set(gauges)
    for name, setup in setups.items():
        points = np.array([postures[r.posture].values for r in readings if r.setup == name])
        if setup.gauge == "bar":
            distances = np.linalg.norm(points - np.array(setup.sensor.centre), axis=1)
            np.testing.assert_allclose(distances, 0.05, atol=1e-8)
        elif setup.gauge == "block":
            axis = "xyz".index(setup.sensor.direction[-1])
            assert np.ptp(points[:, axis]) == pytest.approx(0.05)
        else:
            axis = "xyz".index(setup.sensor.direction[-1])
            assert np.ptp(points[:, axis]) == pytest.approx(0.0, abs=1e-12)


def manual_plans(folder):
    """Three circles of a bar beside the paper's 18 readings, and beside 162 of the legs."""
    sweep = {**plans.sweep(), "gauge": {"sigma_mm": 0.005, "resolution_mm": 0.01}}
    bar = circles(folder / "bar")
    return circles(folder / "paper", legs=True), join_sessions(
        [bar, load_plan(plans.write(folder, sweep))]
    )


def test_two_hours_are_better_than_manual_plans_of_two_and_five_hours(planned, tmp_path):
    """The paper's readings and circles need two hours, 162 readings and circles five."""
    assert planned.minutes <= 120.0 + 1e-9
    assert planned.minutes == pytest.approx(planned.equipment.minutes_of(planned.session))
    assert {s.gauge for s in planned.session.setups.values()} == {"bar"}
    paper, sweep = (planned.forecast.after(p).reported.rms for p in manual_plans(tmp_path))
    assert paper == pytest.approx(5.5e-6, rel=0.1)
    assert sweep < 5.0e-6
    assert planned.expected.reported.rms < min(4.0e-6, 0.9 * sweep) < paper
    assert planned.expected.reported.rms < 0.4 * quick_plan().expected.reported.rms


def test_the_search_agrees_with_the_forecast_of_its_plan(planned):
    """Two gauges, a common ball and length, known zeros. The error of the stage is scaled from the
    nominal machine to machines within their tolerances."""
    once = tuple(r for r in planned.session.readings if r.cycle == 1)
    nominal = planned.forecast.about_nominal(replace(planned.session, readings=once))
    assert planned.stage.error == pytest.approx(planned.expected.reported.rms, rel=0.05)
    assert nominal.reported.rms == pytest.approx(planned.expected.reported.rms, rel=0.25)


def test_approaches_and_minutes_of_a_bar_follow_from_path_and_file(owned):
    robot = replace(with_effects(entered("orthoglide"), ("backlash",)), legs={})
    slow = BAR + "minutes_per_setup: 20\nminutes_per_reading: 2\n"
    equipment = Equipment(owned=owned(bar=slow))
    with few_balls(1), uncompared(), few_machines():
        plan = plan_readings(robot, "offsets", hours=1.0, equipment=equipment, starts=1)
    session = plan.session
    assert all(r.approach and len(r.approach) == 3 for r in session.readings)
    plan_motion(session)  # refuses approaches that are not those of the path
    assert plan.minutes == 20.0 * len(session.setups) + 2.0 * len(session.readings)
    assert 50.0 < plan.minutes <= 60.0 + 1e-9
    times = [r.conditions.time for r in equipment.schedule(session).readings]
    assert (times[-1] - times[0]).total_seconds() / 60.0 == plan.minutes - 22.0


@pytest.mark.parametrize(
    ("text", "place"),
    [
        (BAR + "minutes_per_reading: -1\n", "minutes_per_reading"),
        (BAR.replace("length_mm: 50", "length_mm: long"), "length_mm"),
        (BAR.replace("length_mm: 50\n", ""), "length_mm"),
        (BAR.replace("length_mm: 50", "length_mm: 0.05"), "length_mm"),
        (BAR.replace("length_mm: 50", "lenght_mm: 50"), "lenght_mm"),
        (BAR + "tool_mm: [1]\n", "tool_mm"),
        (BAR + "postures: [zero]\n", "postures"),
        (PLATE.replace("kind: plate", "kind: mirror"), "artefact"),
        (PLATE.replace("length_mm: 150", "length_mm: -5"), "artefact.plate.length_mm"),
        (SQUARE.replace("kind: square", "kind: square, along: x"), "artefact.along"),
        (BLOCK.replace("height_mm: 50", "height_mm: high"), "artefact.gauge_block.height_mm"),
        (PROBE + "tool_mm: low\n", "tool_mm"),
        ("sensor: [probe]\n", ""),
        (TRACKER + "station: hall\n", "station"),
        (TRACKER + "axis: {along: [1, 0, 0]}\n", "axis"),
        (TRACKER + "frame: known\n", "frame"),
        ("- 1\n", ""),
        (BAR.replace("ball_bar", "leg"), ""),
        (BAR.replace("sigma_mm: 0.002\n", ""), "sigma_mm"),
        (BAR + "centre_mm: [0, 0, 0]\n", "centre_mm"),
        (BAR + "elevation_deg: [10, -90]\n", "elevation_deg"),
        (BAR + "radius_mm: wide\n", "radius_mm"),
        (PROBE + "elevation_deg: [-90, 0]\n", "elevation_deg"),
    ],
)
def test_a_wrong_file_is_refused_by_its_key(owned, text, place):
    with pytest.raises(SessionError) as caught:
        owned(bar=text)
    assert str(caught.value.where).endswith(place or "bar.yaml")


@pytest.fixture(scope="module")
def for_printer(owned):
    """Plan of an hour for a linear delta with a bar and a probe."""
    equipment = Equipment(owned=owned(bar=BAR, probe=PROBE), **FEW)
    with few_balls(1), uncompared():
        return plan_readings(load_robot("linear_delta"), hours=1.0, equipment=equipment, starts=1)


def test_postures_of_sensors_at_the_tool_stay_above_the_bed(for_printer):
    session, robot = for_printer.session, for_printer.session.robot
    assert for_printer.minutes <= 60.0 + 1e-9
    gauges = [s.gauge for s in session.setups.values()]
    assert "bar" in gauges
    assert gauges.count("probe") <= 1
    at_tool = {n for n, s in session.setups.items() if s.gauge != "dial"}
    used = {r.posture for r in session.readings if r.setup in at_tool}
    points = np.array([session.postures[n].values for n in used])
    low, high = robot.workspace.T
    assert ((points >= low - 1e-9) & (points <= high + 1e-9)).all()
    assert for_printer.expected.reported.rms < 0.05 * for_printer.before.reported.rms


@pytest.mark.usefixtures("without_sensor_gains")
def test_a_plan_for_a_printer_is_measured_and_calibrated(for_printer):
    """With offsets of 1 mm, in the range of the gauges."""
    text, sheet = summarize(for_printer), sheet_files(for_printer.session)["sheet.html"]
    assert "Ball bar: " in text
    assert "mount the gauge so that it touches at `section`" not in text
    assert "arcs" in sheet
    assert "as its arrows show" not in sheet
    forecast = for_printer.forecast
    offsets = {"*.offset_mm": 1.0}
    errors = draw_errors(forecast.robot, forecast.names, seed=4, tolerances=offsets)
    readings = simulate_session(for_printer.session, errors, seed=4).session
    calibration = identified(readings)
    remaining = np.array([calibration[n].value - errors[n] for n in forecast.names])
    assert tool_rms(forecast, remaining) < 2.0 * for_printer.expected.reported.rms


BESIDE_ZERO = np.array([[0.0226, 0.0726], [-0.0426, 0.0526], [-0.0826, -0.0226]])


@pytest.mark.parametrize(("name", "box"), [("linear_delta", None), ("orthoglide", BESIDE_ZERO)])
def test_the_tool_stays_in_the_box(owned, name, box):
    """The workspace of the delta begins at its bed. The mechanical zero is beside the other box."""
    robot = load_robot(name)
    sensors = owned(bar=BAR, square=SQUARE, plate=PLATE, block=BLOCK, track=TRACKER)
    with few_balls(2):
        _, postures, setups, _ = list_tool_candidates(robot, sensors, box)
    assert {names_in_files(s)[1] for s in setups.values()} == {s.name for s in sensors}
    points = np.array([p.values for p in postures.values()])
    low, high = (robot.workspace if box is None else box).T
    assert ((points >= low - 1e-9) & (points <= high + 1e-9)).all()


def test_a_bed_is_probed_in_one_setup_at_the_height_of_its_plane(owned):
    sensors = owned(probe=PROBE + "tool_mm: [0, 0, -20]\n")
    for effects in ((), ("backlash",)):
        robot = with_effects(load_robot("linear_delta"), effects)
        _, postures, setups, readings = list_tool_candidates(robot, sensors, None)
        assert list(setups) == ["probe"]
        assert len(readings) > 100
        assert {p.values[2] for p in postures.values()} == {0.02}
        assert {r.approach for r in readings} == {"nnn"}


def lowest(files):
    """Lowest height of the motions of all programs, [mm]."""
    return min(
        float(z) for text in files.values() for z in re.findall(r"(?m)^G53 .* Z(.*) F", text)
    )


def test_a_bed_is_probed_from_above(owned, monkeypatch):
    """The operator probes from 10 mm above. The tool moves back before the next posture."""
    equipment = Equipment(owned=owned(probe=PROBE))
    robot = replace(load_robot("linear_delta"), legs={})
    monkeypatch.setattr(tool_candidates, "BED_POINTS", 5)
    with uncompared(), few_machines():
        plan = plan_readings(robot, "offsets", equipment=equipment, hours=0.1, starts=1)
    session = plan.session
    assert {r.approach for r in session.readings} == {"nnn"}
    files = sheet_files(session, options=ProgramOptions(dwell=1.0))
    assert "begin 10 mm before the surface" in files["sheet.html"]
    assert "Move to the" not in files["sheet.html"]
    program = files["01-probe.ngc"]
    assert lowest({"": program}) == 10.0
    assert program.count("\nM0\n") == len(session.readings)
    assert "G4 " not in program
    (motion,) = plan_motion(session)
    for before, stop in itertools.pairwise(motion.stops):
        assert np.array_equal(stop.via, [before.approach_point])
        assert stop.approach_point - stop.point == pytest.approx([0.0, 0.0, 0.01])
    lower = replace(session, postures={n: lowered(robot, p) for n, p in session.postures.items()})
    assert lowest(sheet_files(lower)) == 9.0  # as in a log, whose postures are the triggers
    stated = replace(session.readings[0], conditions=Conditions("ppp"))
    with pytest.raises(SessionError, match="probes towards its surface"):
        plan_motion(replace(session, readings=(stated, *session.readings[1:])))


def lowered(robot, posture, depth=1e-3):
    """Posture below another one by a depth, [m]."""
    (placed,) = place_tool(robot, [posture.name], posture.values[None] - [0.0, 0.0, depth]).values()
    return placed


def test_plans_of_a_machine_with_a_bed_stay_above_it(owned):
    """Postures, approaches and paths of gauges at the rods and of a ball bar."""
    robot = with_effects(load_robot("linear_delta"), ("backlash",))
    box = np.array([[-0.06, 0.06]] * 3)  # the bed cuts it
    equipment = Equipment(owned=owned(bar=BAR), box=box, along=4, sections=(0.5,))
    with few_balls(1), uncompared(), few_machines():
        listed = list_candidates(robot, equipment)
        plan = plan_readings(robot, "offsets", hours=1.0, equipment=equipment, starts=1).session
    of_rods = {r.posture for r in listed.readings if r.setup[0] != "b"}
    at_bed = {n for n, p in listed.postures.items() if p.values[2] == 0.0}
    assert min(p.values[2] for p in listed.postures.values()) == 0.0
    assert {r.approach for r in listed.readings if r.posture in at_bed & of_rods} == {"nnn"}
    assert {s.gauge for s in plan.setups.values()} == {"dial", "bar"}
    assert lowest(sheet_files(plan)) >= 0.0
    depth = 1e-3 + min(p.values[2] for p in plan.postures.values())
    below = replace(plan, postures={n: lowered(robot, p, depth) for n, p in plan.postures.items()})
    with pytest.raises((SessionError, UnreachablePathError), match="below the bed"):
        plan_motion(below)


def test_a_machine_without_a_bed_may_move_below_its_zero():
    robot = load_robot("linear_delta")
    assert choose_box(robot, None)[2].tolist() == [0.0, 0.1]
    assert choose_box(replace(robot, bed=-0.025), None)[2].tolist() == [-0.02, 0.1]
    assert choose_box(replace(robot, bed=None), None)[2].tolist() == [-0.1, 0.1]


@pytest.fixture(scope="module")
def planned_bar(owned):
    """Candidates and a planned setup of a ball bar with twelve postures."""
    robot = replace(with_effects(load_robot("linear_delta"), ["backlash"]), legs={})
    equipment = Equipment(owned=owned(bar=BAR.replace("length_mm: 50", "length_mm: 60")))
    forecast = ToolForecast(robot, resolve_choice("offsets", None).select(robot.parameters))
    with few_balls(1):
        candidates = candidates_of(forecast, equipment)
    count = len(candidates.setups[0].rows)
    planned = [PlannedSetup(0, tuple(np.random.default_rng(0).permutation(count)[:12].tolist()))]
    return candidates, planned


def test_postures_in_which_a_drive_reverses_are_omitted(planned_bar):
    """On the arcs of a bar a drive may reverse in a posture, whose approach is then unknown."""
    candidates, planned = planned_bar
    as_chosen = _order_readings(candidates, planned, None)
    unknown = {r.posture for r in as_chosen.readings if "u" in r.conditions.approach}
    assert unknown
    plan = build_session(candidates, planned)
    assert not any("u" in r.conditions.approach for r in plan.readings)
    assert {r.posture for r in plan.readings} == {r.posture for r in as_chosen.readings} - unknown
    assert plan.readings[-1].posture == plan.readings[0].posture


def test_postures_whose_path_leaves_the_workspace_are_omitted(planned_bar, monkeypatch):
    candidates, planned = planned_bar
    far = [p.name for p in build_session(candidates, planned).postures.values()][3:5]
    state = planned_session.state_path_approaches

    def with_walls(session):
        for posture in far:
            if posture in session.postures:
                raise UnreachablePathError("wall", setup="bar", posture=posture)
        return state(session)

    monkeypatch.setattr(planned_session, "state_path_approaches", with_walls)
    plan = build_session(candidates, planned)
    assert plan.readings
    assert not set(far) & set(plan.postures)
    far[:] = list(candidates.session.postures)
    with pytest.raises(UnreachablePathError):
        build_session(candidates, planned)


def on_segments(starts, ends, count=101):
    """Points on segments, shape (n, count, 3)."""
    return starts[:, None] + np.linspace(0.0, 1.0, count)[:, None] * (ends - starts)[:, None]


def nearest(one, other):
    """Least distance of the points on each pair of segments, (n,)."""
    return np.linalg.norm(one[:, :, None] - other[:, None], axis=3).min(axis=(1, 2))


def test_distances_of_segments_are_those_of_their_points():
    """Random ones, parallel ones, and ones that cross."""
    rng = np.random.default_rng(1)
    ends = rng.uniform(-1.0, 1.0, size=(4, 60, 3))
    ends[3, :10] = ends[2, :10] + ends[1, :10] - ends[0, :10]
    ends[2, 10:20], ends[3, 10:20] = ends[0, 10:20] + 0.3, 2.0 * ends[1, 10:20] - ends[0, 10:20]
    sampled = nearest(on_segments(*ends[:2]), on_segments(*ends[2:]))
    found = segment_distances(*ends)
    assert (found <= sampled + 1e-12).all()
    assert (sampled - found).max() < 0.04  # the points are up to 0.02 apart along each


@pytest.mark.parametrize(("radius", "clear"), [(10, True), (0, False)])
def test_no_rod_is_in_the_way_of_a_bar(owned, orthoglide, radius, clear):
    """Rods by Pinocchio. Without room for the bar itself, its axis passes them by 1 mm."""
    sensors = owned(bar=BAR + f"radius_mm: {radius}\n")
    _, postures, setups, readings = list_tool_candidates(orthoglide, sensors, None)
    read = [r for r in readings if r.setup == "bar@10"]
    gaps = []
    for posture in (postures[r.posture] for r in read[::5]):
        found = frames(orthoglide, posture.drives)
        bar = on_segments(found["tcp"][None], np.array([setups["bar@10"].sensor.centre]))
        for rod in orthoglide.rods.values():
            ends = on_segments(found[rod.root][None], found[rod.tip][None])
            gaps.append(nearest(bar, ends)[0] - rod.radius)
    assert (min(gaps) > 0.0099) == clear


def test_a_bar_is_as_steep_as_its_file_states(owned, orthoglide):
    """From the tool's ball downwards: the tool is above the fixed ball."""
    sensors = owned(bar=BAR + "elevation_deg: [-90, -10]\ntool_mm: [0, 0, -40]\n")
    _, postures, setups, readings = list_tool_candidates(orthoglide, sensors, None)
    bars = [
        np.array(setups[r.setup].sensor.centre) - postures[r.posture].values - [0.0, 0.0, -0.04]
        for r in readings
    ]
    sines = np.array([bar[2] / np.linalg.norm(bar) for bar in bars])
    assert -0.25 < sines.max() <= np.sin(np.radians(-10.0))
    assert sines.min() == pytest.approx(-1.0)


def test_a_bar_keeps_its_length_at_a_tool_that_turns(owned, root):
    """The ball is beside the tool centre point of a rod; its positions are Pinocchio's."""
    robot = load_robot(root / "tests/robots/biglide")
    sensors = owned(bar=BAR + "tool_mm: [20, 0, -10]\n")
    with few_balls(1):
        gauges, postures, setups, readings = list_tool_candidates(robot, sensors, None)
    (setup,) = setups.values()
    session = Session(
        robot=robot,
        robot_reference=robot.name,
        gauges=gauges,
        postures={r.posture: postures[r.posture] for r in readings[::6]},
        setups=setups,
        readings=tuple(readings[::6]),
    )
    (motion,) = plan_motion(session)

    def deviation(drives):
        ball = frame_pose(robot, drives, robot.tcp.frame).act(np.array(setup.sensor.tool))
        return abs(np.linalg.norm(ball - setup.sensor.centre) - setup.sensor.length)

    assert len(session.postures) > 2
    assert max(deviation(p.drives) for p in session.postures.values()) < SAME_NUMBER
    assert max(deviation(d) for stop in motion.stops for d in stop.path) < 3.0 * SAGITTA


def needed_range(robot, sensors, **options):
    """Range to either side that the bar needs if its dial is too short, [mm]; 0 if it is not."""
    session = list_candidates(robot, Equipment(owned=sensors))
    forecast = ToolForecast(robot, resolve_choice("offsets", None).select(robot.parameters))
    found = measure_candidates(session, forecast.problem(session), spare_range=3.0, **options)
    assert any(s.reachable.any() for s in found.setups) != bool(found.unusable)
    return 1e3 * found.unusable.get("bar", 0.0)


@pytest.mark.parametrize(
    ("length", "offset", "entered", "expected"),
    [
        ("unknown", 0.4, False, 3.0 * np.hypot(1.0, np.hypot(0.25, 0.2))),
        ("0.4", 0.4, False, 0.0),  # 3 × 0.38 mm
        ("0.4", 4.0, False, 3.0 * np.hypot(0.2, np.hypot(0.25, 2.0))),
        ("0.4", 4.0, True, 0.0),  # after a calibration, 3 × 0.38 mm
    ],
)
def test_the_range_of_a_bar_holds_the_tolerances_of_length_place_and_offsets(
    owned, monkeypatch, length, offset, entered, expected
):
    """The zero of a bar is not set. A drive moves the tool about as far as itself."""
    monkeypatch.setattr(tool_candidates, "BALLS", tool_candidates.BALLS[:1])
    text = BAR.replace("[-25, 25]", "[-3, 3]").replace("unknown", length)
    sensors = owned(bar=text + "centre_tolerance_mm: 0.5\nscale_tolerance: 0\n")
    robot = load_robot("orthoglide").with_tolerances({"*.offset_mm": offset})
    robot = replace(robot, legs={})
    assert needed_range(robot, sensors, entered=entered) == pytest.approx(expected, rel=0.05)


@pytest.mark.usefixtures("without_sensor_gains")
def test_sensors_with_too_short_a_range_or_less_gain_are_named(owned):
    robot = load_robot("orthoglide").with_tolerances({"*.offset_mm": 0.4})
    short, noisy = BAR.replace("[-25, 25]", "[-2, 2]"), BAR.replace("0.002", "1")
    equipment = Equipment(owned=owned(short=short, noisy=noisy), **FEW)
    with few_balls(1), uncompared(), few_machines():
        plan = plan_readings(robot, hours=0.3, equipment=equipment, starts=1)
    assert {s.gauge for s in plan.session.setups.values()} == {"dial"}
    assert json.loads(plan_json(plan))["unusable_mm"]["short"] == pytest.approx(4.3, abs=0.1)
    assert plan.unchosen == {"noisy": 0.0}
    title, *_ = summarize(plan).split("\n\n")
    assert " ".join(title.split()).endswith("min, without short and noisy")
    unused, unchosen = describe_absent(plan)
    remedy = (
        "To plan with it, state smaller tolerances (centre_tolerance_mm and length_tolerance_mm)"
    )
    entering = "or enter offsets of other readings first and plan from their session."
    assert unused.startswith("Not in the plan: short. Within the tolerances")
    assert unused.endswith(f"{remedy}, use a gauge of more range {entering}")
    better = (
        "Not in the plan: noisy. In this time other readings reduce the expected tool error more."
    )
    assert unchosen == better
    active = plan.session.with_controller([1e-3, 0.0, 0.0])  # offsets are entered already
    entered = replace(plan, complements_session=True, session=active, unchosen={"noisy": 6e-3})
    unused, unchosen = describe_absent(entered)
    assert unused.endswith(f"{remedy} or use a gauge of more range.")
    assert unchosen.startswith(f"{better} Within the tolerances of machine, place and gauge many ")
    assert "±6.0 mm, beyond its range" in unchosen


@pytest.mark.parametrize("names", [("dial",), ("bar", "bar")])
def test_gauges_of_one_name_are_refused(owned, orthoglide, names):
    sensors = [sensor for name in names for sensor in owned(**{name: BAR})]
    with pytest.raises(SessionError) as caught:
        list_tool_candidates(orthoglide, sensors, None)
    assert str(caught.value.where).endswith(f"{names[0]}.yaml")


def without_legs():
    """Orthoglide whose legs cannot be read, so that plans contain points alone."""
    return replace(entered("orthoglide"), legs={})


@pytest.fixture(scope="module")
def tracked(owned):
    """Plan of half an hour with a tracker: 20 minutes of mounting, and 19 points."""
    equipment = Equipment(owned=owned(track=TRACKER))
    return plan_readings(without_legs(), hours=0.5, equipment=equipment, starts=1)


@pytest.mark.parametrize(("keys", "labels"), [("", "xyz"), (CORRELATED, "123")])
def test_candidates_of_points_are_three_readings_in_postures_over_the_workspace(
    owned, orthoglide, keys, labels
):
    sensors = owned(track=TRACKER + keys)
    gauges, postures, setups, readings = list_tool_candidates(orthoglide, sensors, None)
    names = [f"track[{k}]" for k in labels]
    assert list(setups) == names
    assert {s.sensor.station for s in setups.values()} == {"track"}
    assert {s.gauge for s in setups.values()} <= set(gauges)
    assert [r.setup for r in readings] == names * len(postures)
    points = np.array([p.values for p in postures.values()])
    assert len(points) > 100
    assert np.ptp(points, axis=0).min() > 0.15  # most of the reach along each axis


def test_points_are_read_from_both_sides_on_a_machine_with_backlash(owned, orthoglide):
    both, any_side = (
        list_tool_candidates(with_effects(orthoglide, [effect]), owned(track=TRACKER), None)[3]
        for effect in ("backlash", "drift")
    )
    assert {r.conditions for r in any_side} == {None}
    found = [{(r.setup, r.posture) for r in both if r.approach == a} for a in ("ppp", "nnn")]
    assert found == [{(r.setup, r.posture) for r in any_side}] * 2
    assert len(both) == 2 * len(any_side)


def test_a_plan_of_points_is_one_setup_within_its_time(tracked):
    session = tracked.session
    assert list(session.setups) == ["track[x]", "track[y]", "track[z]"]
    assert tracked.minutes == pytest.approx(20.0 + 20 * 0.5)
    assert tracked.stage.setups == 1
    assert tracked.stage.readings == 19
    postures = [r.posture for r in session.readings]
    assert postures[0::3] == postures[1::3] == postures[2::3]
    assert len(set(postures)) == 19
    assert postures[-1] == postures[0]
    document = json.loads(plan_json(tracked))
    assert [document[k] for k in ("setups", "readings", "closing_readings")] == [1, 19, 1]
    times = [r.conditions.time for r in tracked.equipment.schedule(session).readings]
    assert times[0::3] == times[1::3] == times[2::3]
    assert (times[-1] - times[0]).total_seconds() == pytest.approx(19 * 30.0)


def search_plan(robot, sensors, counts, measured=None):
    """Plan without closing readings, the error of its search, and the forecast of lengths alone."""
    selection = resolve_choice("lengths", None).select(robot.parameters)
    forecast = ToolForecast(robot, selection, others={})
    candidates = candidates_of(forecast, Equipment(owned=sensors))
    prior = forecast.prior_information(candidates.problem, candidates.state, measured)
    weight = forecast.weight_of("aligned", len(candidates.state))
    planned = SetupSearch.of(candidates, prior, weight).choose(counts, starts=1)
    plan = build_session(candidates, planned.setups, measured)
    once = replace(plan, readings=tuple(r for r in plan.readings if r.cycle == 1))
    return once, planned.error, forecast


@pytest.mark.parametrize("keys", ["", "frame: {tolerance_mm: 1, tolerance_mrad: 2}\n", CORRELATED])
def test_the_candidates_of_points_agrees_with_the_forecast(owned, keys):
    plan, error, forecast = search_plan(without_legs(), owned(track=TRACKER + keys), [7])
    assert len(plan.readings) == 21
    assert error == pytest.approx(forecast.about_nominal(plan).reported.rms, rel=1e-6)


@pytest.mark.parametrize(
    "keys",
    [
        "length_mm: 60\nlength_tolerance_mm: 0.01\n",
        "length_mm: 50\nlength_tolerance_mm: 0\nscale_tolerance: 0.1\n",
    ],
)
def test_the_search_beside_readings_of_the_same_bar_agrees_with_the_forecast(owned, keys):
    robot = without_legs()
    bar = "sensor: ball_bar\nsigma_mm: 0.002\nrange_mm: [-25, 25]\n"
    with few_balls(2):
        measured, *_ = search_plan(robot, owned(bar=bar + keys), [6, 6])
        plan, error, forecast = search_plan(robot, owned(bar=BAR), [5, 5], measured)
    joined = join_sessions([measured, plan])
    assert error == pytest.approx(forecast.about_nominal(joined).reported.rms, rel=1e-6)


def test_the_search_beside_joined_readings_agrees_with_the_forecast(owned):
    """The first bar had another length, the second one, which is planned, another tolerance."""
    robot = without_legs()
    bars = BAR.replace("50", "60").replace("unknown", "0.01"), BAR.replace("unknown", "0.1")
    with few_balls(2):
        sessions = [search_plan(robot, owned(bar=bar), [6])[0] for bar in bars]
        measured = join_sessions(sessions)
        plan, error, forecast = search_plan(robot, owned(bar=BAR), [5, 5], measured)
    joined = join_sessions([measured, plan])
    assert error == pytest.approx(forecast.about_nominal(joined).reported.rms, rel=1e-6)


def test_measured_points_have_no_information_about_the_instrument_of_further_points(owned):
    robot = without_legs()
    session = list_candidates(robot, Equipment(owned=owned(track=TRACKER)))
    forecast = ToolForecast(robot, resolve_choice("lengths", None).select(robot.parameters))
    problem = forecast.problem(session)
    before, after = (forecast.prior_information(problem, problem.free, m) for m in (None, session))
    gained = np.diag(after - before)
    place = np.array([name.startswith("station.") for name in problem.free])
    assert place.sum() == 6
    assert (gained[place] == 0.0).all()
    assert (gained[~place] > 0.0).all()


def tool_rms(forecast, remaining):
    """RMS tool error of remaining errors of the machine, workpiece aligned, [m]."""
    field = forecast.align(forecast.jacobian @ remaining)
    return float(np.sqrt(forecast.workspace.weights @ (field**2).sum(axis=1)))


def test_calibrated_machines_have_the_expected_error_of_points(tracked):
    """The position of the instrument is unknown."""
    assert_machines_have_the_expected_error(tracked, count=15)


def test_the_curve_grows_a_setup_that_can_be_used_once(tracked):
    """Further points are part of the same setup. The plan is as good as the curve at its time."""
    assert {stage.setups for stage in tracked.curve[1:]} == {1}
    readings = [stage.readings for stage in tracked.curve]
    assert readings == sorted(set(readings))
    assert len(readings) > 3
    minutes, errors = zip(*((s.minutes, s.error) for s in tracked.curve), strict=True)
    assert tracked.stage.error < 1.01 * np.interp(tracked.minutes, minutes, errors)


@pytest.mark.usefixtures("without_sensor_gains")
def test_a_plan_of_points_is_measured_and_calibrated(tmp_path):
    """From the command line: plan, sheet, a recorded point, simulated points, calibration."""
    (tmp_path / "track.yaml").write_text(TRACKER + CORRELATED)
    words = ["orthoglide", "--with", tmp_path / "track.yaml", "--hours", 0.45, "--starts", 1]
    words += ["--along", 2, "--across-mm", 0, "--sections", 0.5]
    words += ["--tolerance", "*.offset_mm=1", "--out", tmp_path / "plan"]
    with uncompared(), few_machines():
        code, text, _ = run_orthocal(".", "plan", *map(str, words))
    assert code == 0
    assert "Points: " in text
    plan = load_plan(tmp_path / "plan")
    lines = len(plan.readings) // 3
    assert (tmp_path / "plan" / "readings.csv").read_text().count("track,") == lines
    programs = list((tmp_path / "plan").glob("*.ngc"))
    assert [p.name for p in programs] == ["01-track.ngc"]
    program = programs[0].read_text()
    assert program.count(": read)") + program.count(", then read)") == lines - 1
    assert f"(MSG, reading line {lines + 1}," in program
    assert "dial" not in program
    sheet = (tmp_path / "plan" / "sheet.html").read_text()
    assert sheet.count("</section>") == 2
    assert sheet.count('<td class="box"></td>') == 3 * lines
    code, text, _ = run_orthocal(".", "record", str(tmp_path / "plan"), typed="1 2 3\n\n")
    assert f"{lines - 1} of {lines} readings are missing" in text
    measured = str(tmp_path / "measured")
    simulated = [str(tmp_path / "plan"), "--out", measured, "--draw", "*", "--seed", "1"]
    assert run_orthocal(".", "simulate", *simulated)[0] == 0
    assert run_orthocal(".", "calibrate", measured, "--json")[0] == 0


@pytest.fixture(scope="module")
def planar(owned):
    """Plan of an hour with a ball bar for a machine whose tool moves in a plane."""
    equipment = Equipment(owned=owned(bar=BAR), **QUICK)
    with few_balls(4), uncompared():  # a plane has two of them
        return plan_readings(entered("biglide"), hours=1.0, equipment=equipment, starts=1)


def bars_of(session):
    return {n: s for n, s in session.setups.items() if s.gauge == "bar"}


def test_a_bar_on_a_planar_machine_has_circles_in_the_plane_of_motion(planar):
    session, bars = planar.session, bars_of(planar.session)
    assert len(bars) >= 2
    for name, setup in bars.items():
        postures = {r.posture for r in session.readings if r.setup == name}
        tool = LoopClosure(session.robot).forward(
            np.array([session.postures[p].drives for p in postures])
        )
        centre = np.array(setup.sensor.centre)
        np.testing.assert_allclose(tool[:, 2], centre[2], atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(tool - centre, axis=1), 0.05, atol=1e-8)


@pytest.mark.parametrize("depth", [0.0, 0.02])
def test_programs_of_a_planar_bar_move_along_its_circle(planar, depth):
    """The tool approaches the first posture freely. The fixed ball may lie below the plane."""
    session, lower = planar.session, np.array([0.0, 0.0, depth])
    setups = {
        n: replace(s, sensor=replace(s.sensor, centre=tuple(s.sensor.centre - lower)))
        for n, s in bars_of(session).items()
    }
    session = replace(session, setups={**session.setups, **setups})
    for motion in plan_motion(session):
        if motion.setup not in bars_of(session):
            continue
        program = write_program(session, motion)
        moves = re.findall(r"G53 G1 X(\S+) Y(\S+) F", program)
        assert len(moves) == program.count("\nG53 G1 ")
        centre = 1e3 * np.array(session.setups[motion.setup].sensor.centre)
        points = np.array(moves, dtype=float)[2:]
        assert len(points) > 100
        radii = np.linalg.norm(points - centre[:2], axis=1)
        assert np.abs(radii - 50.0).max() < 1e3 * SAGITTA + 1e-4
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        assert steps.max() < 5.0


def simulate_planar(planar, seed):
    errors = draw_errors(planar.session.robot, planar.forecast.names, seed=seed)
    return simulate_session(planar.session, errors, seed=seed).session


def test_calibrated_planar_machines_have_the_expected_error_of_a_bar(planar):
    """Two fixed balls lie off the plane of motion by 1 mm (standard deviation)."""
    assert len(bars_of(planar.session)) == 2
    assert planar.expected.reported.rms < 4.5e-6
    assert_machines_have_the_expected_error(planar, count=12)


def test_both_solvers_agree_where_balls_are_off_the_plane(planar):
    """Heights change readings to second order only. Both of their signs are local optima."""
    session = simulate_planar(planar, 8)
    problem = planar.forecast.problem(session)
    drives = [problem.free.index(f"{d.name}.offset") for d in session.robot.drives]
    one, other = (
        program(problem).solve(sigma=stated_sigma(session.gauge))
        for program in (VariableProjection, NonlinearProgram)
    )
    assert one.objective == pytest.approx(other.objective, rel=SAME_NUMBER)
    assert one.theta[drives] == pytest.approx(other.theta[drives], abs=SAME_OPTIMUM)


def test_fixed_balls_off_the_plane_are_no_mistakes(planar):
    """Their heights, of up to 3.9 mm, have the effect of another bar length to first order."""
    findings = judge_session(simulate_planar(planar, 18)).findings
    assert {f.severity for f in findings} <= {"note"}


def test_sensors_on_a_planar_machine(owned):
    """Those that need three coordinates are refused; points lie in its plane."""
    robot = load_robot("biglide")
    for text in (SQUARE, PLATE, PROBE):
        with pytest.raises(ParameterError) as caught:
            list_tool_candidates(robot, owned(sensor=text), None)
        assert str(caught.value.where).endswith("sensor.yaml")
    _, postures, setups, _ = list_tool_candidates(robot, owned(track=TRACKER), None)
    assert list(setups) == ["track[x]", "track[y]", "track[z]"]
    assert {len(p.values) for p in postures.values()} == {2}
    assert len(postures) == 25


@pytest.mark.usefixtures("without_sensor_gains")
def test_a_sensor_with_too_short_a_range_is_named(owned):
    robot = load_robot("orthoglide").with_tolerances({"*.offset_mm": 0.4})
    short = owned(bar=BAR.replace("[-25, 25]", "[-2, 2]"))
    with few_balls(1), uncompared(), few_machines():
        plan = plan_readings(robot, hours=0.3, equipment=Equipment(owned=short, **FEW), starts=1)
    assert {s.gauge for s in plan.session.setups.values()} == {"dial"}
    assert json.loads(plan_json(plan))["unusable_mm"]["bar"] == pytest.approx(4.3, abs=0.1)
    title, *_, last = summarize(plan).split("\n\n")
    assert title.endswith("min, without bar")
    remedy = (
        "To plan with it, state smaller tolerances (centre_tolerance_mm and length_tolerance_mm)"
    )
    entering = "or enter offsets of other readings first and plan from their session."
    assert " ".join(last.split()).startswith("Not in the plan: bar. Within the tolerances")
    assert " ".join(last.split()).endswith(f"{remedy}, use a gauge of more range {entering}")
    active = plan.session.with_controller([1e-3, 0.0, 0.0])  # offsets are entered already
    (words,) = describe_absent(replace(plan, complements_session=True, session=active))
    assert words.endswith(f"{remedy} or use a gauge of more range.")


@pytest.mark.usefixtures("without_sensor_gains")
def test_a_sensor_that_gains_less_than_others_is_named(owned):
    robot = load_robot("orthoglide").with_tolerances({"*.offset_mm": 1.0})
    noisy = owned(bar=BAR.replace("sigma_mm: 0.002", "sigma_mm: 1"))
    with few_balls(1), uncompared(), few_machines():
        plan = plan_readings(robot, hours=0.3, equipment=Equipment(owned=noisy, **FEW), starts=1)
    assert plan.unchosen == {"bar": 0.0}
    title, *_, last = summarize(plan).split("\n\n")
    assert title.endswith("min, without bar")
    better = (
        "Not in the plan: bar. In this time other readings reduce the expected tool error more."
    )
    assert " ".join(last.split()) == better
    (words,) = describe_absent(replace(plan, unchosen={"bar": 6e-3}))
    assert words.startswith(f"{better} Within the tolerances of machine, place and gauge many of ")
    assert "±6.0 mm, beyond its range" in words
