"""Plans for machines with effects: approaches, limits, positions, times and temperatures."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest
from commands import run_orthocal
from plan_searches import calibrate_drawn
from uncompared import uncompared

from orthocal import load_plan, load_robot, simulate_session, write_session
from orthocal.assessment.effect_limits import find_limits
from orthocal.effects.loading import with_effects
from orthocal.errors import ParameterError
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.workspace import grid_points, tool_at_zero
from orthocal.measurement.motion.approach import approach_steps, can_approach, describe_approach
from orthocal.measurement.motion.motion import plan_motion
from orthocal.measurement.motion.motion_program import write_program
from orthocal.observation.conditions import MORNING, schedule_readings
from orthocal.observation.gauge_noise import stated_sigma
from orthocal.observation.model import predict_readings
from orthocal.output.sheet.soft_limits import describe_beyond_limits
from orthocal.planning.candidates import list_candidates
from orthocal.planning.equipment import Equipment
from orthocal.planning.first_plan import first_equipment, paper_plan
from orthocal.planning.further_readings import WAITING_TIMES
from orthocal.planning.plan import plan_readings
from orthocal.session.session import Gauge
from orthocal.units import MM, PPM, UM

pytestmark = pytest.mark.usefixtures("module_of_few_machines")

WITHOUT_BACKLASH = 24
"""Readings of the first plan of a machine without backlash, closing readings included."""

PROMISED = 16 * UM
"""Largest limit of backlash after the first plan."""

FEW = Equipment(sections=(0.5,), across=0.0, along=3)


@pytest.fixture(scope="module")
def machine(orthoglide):
    return with_effects(orthoglide, ["backlash"])


@pytest.fixture(scope="module")
def planned(machine):
    """First plan of a machine; its search has fewer candidates and starts than a user's plan."""
    equipment = replace(first_equipment(machine, Equipment()), along=5, across=0.0)
    with uncompared():
        return plan_readings(machine, "full", equipment=equipment, starts=1)


def test_the_first_plan_determines_backlash(planned):
    (backlash,) = planned.effects
    assert (backlash.effect, backlash.unit, backlash.count) == ("backlash", "m", 3)
    assert backlash.before == pytest.approx(0.04 * MM)
    assert backlash.after <= PROMISED
    rows = planned.session.readings
    assert len(rows) <= WITHOUT_BACKLASH + 4
    assert {r.approach for r in rows} == {"ppp", "nnn"}
    for setup in planned.session.setups:  # ends with its first posture and approach
        of_setup = [r for r in rows if r.setup == setup]
        first, last = of_setup[0], of_setup[-1]
        assert (first.posture, first.approach) == (last.posture, last.approach)


def test_readings_with_one_approach_do_not_determine_backlash(planned):
    rows = planned.session.readings
    same = tuple(
        replace(r, conditions=replace(r.conditions, approach="ppp"), cycle=i)
        for i, r in enumerate(rows, 1)
    )
    one = replace(planned.session, readings=same)
    (backlash,) = find_limits(planned.forecast.problem(one), stated_sigma(one.gauge))
    assert backlash.after > 0.9 * backlash.before


@pytest.mark.slow
def test_backlash_of_calibrated_machines_is_within_the_expected_limits(planned):
    problem, theta, found = calibrate_drawn(planned, 60, offset_mm=0.4)
    names = problem.machine_selection.names
    indices = [i for i, name in enumerate(names) if name.endswith(".backlash")]
    deviation, true = (found - theta)[:, indices], theta[:, indices]
    # near 0, where it cannot be negative, backlash is known better; the RMS of about 110 values
    # scatters by 7 %, and is 4 % larger, because the prior reduces the estimates
    expected = planned.forecast.about_nominal(planned.session)
    at = [expected.names.index(names[i]) for i in indices]
    limits = 2.0 * np.sqrt(expected.covariance[at, at])
    assert limits.max() == pytest.approx(planned.effects[0].after)
    limit = 2.0 * np.sqrt(np.mean(deviation[true > 10.0 * UM] ** 2))
    assert limit == pytest.approx(1.04 * np.sqrt(np.mean(limits**2)), rel=0.2)


def test_candidates_begin_their_approach_within_the_travel(machine):
    """The travel of the x drive ends 1 mm beyond its largest coordinate."""
    equipment = replace(FEW, along=7, box=np.array([[-0.06, 0.06]] * 3))
    session = list_candidates(machine, equipment)
    largest = max(p.drives[0] for p in session.postures.values())
    drives = (replace(machine.drives[0], upper=largest + 1e-3), *machine.drives[1:])
    session = list_candidates(replace(machine, drives=drives), equipment)
    approaches = {p: set() for p in session.postures}
    for r in session.readings:
        approaches[r.posture].add(r.approach)
    for name, posture in session.postures.items():
        near = posture.drives[0] > largest - 1e-3
        assert approaches[name] == ({"ppp"} if near else {"ppp", "nnn"})
    assert {"ppp"} in approaches.values()
    for approach in ("ppp", "nnn"):
        names = [n for n, of_posture in approaches.items() if approach in of_posture]
        at = np.array([session.postures[n].drives for n in names])
        assert can_approach(session.robot, at, approach).all()
    limits = tuple(d.joint_limits for d in drives)
    within = list_candidates(machine, replace(equipment, soft_limits=limits))
    assert [r.key for r in within.readings] == [r.key for r in session.readings]
    assert within.robot is machine


@pytest.mark.parametrize("name", ["orthoglide", "linear_delta", "inclined_orthoglide", "biglide"])
def test_approaches_are_within_the_limits_of_the_axes(name):
    """Limits of 40 mm; away from the zero the tool moves farther than the drives."""
    robot = load_robot(name)
    coordinates = list(robot.tcp.coordinates)
    axes = np.zeros((3, 2))
    axes[coordinates] = tool_at_zero(robot)[:, None] + [-0.04, 0.04]
    joints = [d.joint_limits for d in robot.drives]
    box = FEW.within_limits(robot, joints, axes).box
    corners = grid_points(*box)
    closure = LoopClosure(robot)
    drives = closure.inverse(corners)
    for side in "pn":
        begin = drives - approach_steps(robot, side * len(robot.drives))
        tool = closure.forward(begin)[:, coordinates]
        assert (tool >= axes[coordinates, 0] - 1e-9).all()
        assert (tool <= axes[coordinates, 1] + 1e-9).all()
    assert (axes[coordinates, 1] - box[:, 1] < 0.006).all()


def test_programs_of_a_plan_are_within_the_soft_limits(machine):
    """The travel is 120 to 390 mm, and 310 mm in the mechanical zero."""
    joints, axes = ((0.262, 0.353),) * 3, ((-0.035, 0.045), (-0.05, 0.03), (-np.inf, 0.04))
    with uncompared():
        free, limited = (
            plan_readings(machine, "offsets", setups=2, equipment=equipment, starts=1).session
            for equipment in (FEW, FEW.within_limits(machine, joints, axes))
        )
    beyond = describe_beyond_limits(free, joints, axes, file="machine.ini")
    assert re.search(r"(?m)^  AXIS_[XYZ], MAX_LIMIT", beyond)
    assert "MAX_LIMIT" in describe_beyond_limits(free, joints, file="machine.ini")
    assert describe_beyond_limits(limited, joints, axes, file="machine.ini") == ""
    # no change of postures helps if the programs begin beyond a limit
    beyond = describe_beyond_limits(free, [(0.32, 1.0), *joints[1:]], file="machine.ini")
    assert re.search(
        r"(?m)^  JOINT_0 .*: the mechanical zero, where every program begins, reaches 310\.250 mm$",
        beyond,
    )
    # the farthest displayed coordinates are those of the program's lines
    origin = (0.001, 0.002, 0.003)
    shifted = replace(free, controller_origin=origin)
    beyond = describe_beyond_limits(shifted, [(-1.0, 1.0)] * 3, axes, file="machine.ini")
    reached = [float(v) for v in re.findall(r"reaches (\S+?)[, ]", beyond.replace("−", "-"))]
    programs = "".join(write_program(shifted, motion) for motion in plan_motion(shifted))
    words = np.array(re.findall(r" [XYZ]([-\d.]+)", programs), dtype=float)
    assert reached
    assert all(np.abs(words - v).min() < 6e-4 for v in reached)  # rounded to 1 µm
    with pytest.raises(ParameterError, match=r"\[AXIS_Y\] leave no room"):
        FEW.within_limits(machine, joints, (axes[0], (0.2, 0.3), axes[2]))


def test_positions_lie_at_fractions_of_the_lead(orthoglide):
    """At multiples of 5 mm the periodic error of a screw with a lead of 5 mm is constant."""
    declared = orthoglide.declared.model_copy(update={"effects": {"screw": {"lead_mm": 5.0}}})
    screw = with_effects(replace(orthoglide, declared=declared), ["screw"])
    for robot, least in ((orthoglide, 1), (screw, 4)):
        session = list_candidates(robot, replace(FEW, along=7))
        along = [p.values[0] for n, p in session.postures.items() if n.startswith("x")]
        phases = {round(v / 5e-3 % 1.0 % 1.0, 6) for v in along}
        assert len(phases - {1.0}) == least


def test_a_plan_determines_both_parts_of_a_periodic_error(orthoglide):
    """Limits between the bound of readings that depend on one screw alone, and three times it.

    Readings k of a setup with the sensitivity s_k to a drive, at the phases φ_k of its screw, have
    the information Σ w_k w_kᵀ/σ² about A and B, with w_k = s_k (sin φ_k, cos φ_k) less its mean
    over the setup, whose zero is free. The prior adds 1/p².
    """
    lead, std = 5.0 * MM, 10.0 * UM
    keys = {"screw": {"lead_mm": lead / MM, "periodic_tolerance_mm": 2.0 * std / MM}}
    declared = orthoglide.declared.model_copy(update={"effects": keys})
    robot = replace(orthoglide, declared=declared)
    fine = Gauge(sigma=0.5 * UM, resolution=1.0 * UM, range=(-5.0 * MM, 5.0 * MM))
    equipment = Equipment(gauge=fine, sections=(0.5,), across=0.0)
    with uncompared():
        plan = plan_readings(with_effects(robot, ["screw"]), "full", equipment=equipment, starts=1)
    session, sigma = plan.session, stated_sigma(plan.session.gauge)
    rows = [r.posture for r in session.readings]
    setups = np.array([r.setup for r in session.readings])
    bounds = []
    for i, drive in enumerate(session.robot.drives):
        coordinates = np.array([session.postures[name].drives[i] for name in rows])
        phases = np.sort(coordinates / lead % 1.0)
        assert np.diff(np.append(phases, phases[0] + 1.0)).max() < 0.4
        ahead, behind = (
            predict_readings(session, {f"{drive.name}.offset": d}) for d in (10 * UM, -10 * UM)
        )
        turns = 2.0 * np.pi * coordinates / lead
        weights = np.column_stack([np.sin(turns), np.cos(turns)])
        weights *= ((ahead - behind) / (20.0 * UM))[:, None]
        for name in session.setups:
            weights[setups == name] -= weights[setups == name].mean(axis=0)
        information = weights.T @ weights / sigma**2
        part = np.linalg.eigvalsh(information)[0] / np.trace(information)
        assert part > 0.2  # of at most 0.5: neither A nor B alone
        bounds.append(np.diag(np.linalg.inv(information + np.eye(2) / std**2)))
    bound = 2.0 * np.sqrt(np.max(bounds))
    (screw,) = plan.effects
    assert (screw.before, screw.count) == (pytest.approx(2.0 * std), 6)
    assert bound < screw.after < 3.0 * bound < 0.25 * screw.before


def test_the_paper_plan_has_one_approach(machine, orthoglide):
    assert {r.approach for r in paper_plan(machine, Equipment()).readings} == {"ppp"}
    assert {r.conditions for r in paper_plan(orthoglide, Equipment()).readings} == {None}


@pytest.fixture(scope="module")
def warming(orthoglide):
    """Plan of two setups on a day that warms by 8 K, a reading each half hour."""
    robot = with_effects(orthoglide, ["thermal", "drift"])
    equipment = replace(FEW, temperatures=(20.0, 28.0), minutes_per_reading=30.0)
    with uncompared():
        return plan_readings(robot, "full", equipment=equipment, setups=2, starts=1)


def test_a_constant_temperature_does_not_determine_thermal_expansion(warming):
    """A day that warms by 8 K reduces the limit a little."""
    limits = {e.effect: e for e in warming.effects}
    assert limits["thermal"].before == pytest.approx(3.0 * PPM)
    assert limits["thermal"].after < limits["thermal"].before * (1.0 - 1e-4)
    assert limits["drift"].after < 0.9 * limits["drift"].before
    constant = replace(warming.equipment, temperatures=None).schedule(warming.session)
    problem = warming.forecast.problem(constant)
    limits = {e.effect: e for e in find_limits(problem, stated_sigma(constant.gauge))}
    assert limits["thermal"].after == pytest.approx(3.0 * PPM)
    assert limits["drift"].after < 0.9 * limits["drift"].before


def test_further_readings_determine_drift(orthoglide):
    """Its limit is that of a line through one posture's readings at three times, with the prior."""
    robot = with_effects(orthoglide, ["thermal", "drift"])
    with uncompared():
        plan = plan_readings(robot, "full", equipment=FEW, setups=2, starts=1)
    assert not any(e.determined for e in plan.effects)
    further = {f.limit.effect: f for f in plan.further}
    readings = [r for r in plan.session.readings if r.setup == plan.session.readings[0].setup]
    last = FEW.minutes_per_reading * (len(readings) - 1)
    std, noise = 0.25, stated_sigma(plan.session.gauge) / UM
    for wait in (w for w in WAITING_TIMES if w <= further["drift"].wait):
        times = np.array([0.0, last, last + wait])
        slope = noise / np.sqrt(((times - times.mean()) ** 2).sum())
        limit = 2.0 / np.sqrt(1.0 / std**2 + 1.0 / slope**2)
        assert (limit < 0.9 * 2.0 * std) == (wait == further["drift"].wait)
    assert further["drift"].limit.after * 60.0 / UM == pytest.approx(limit, rel=1e-2)
    assert further["drift"].limit.determined
    assert further["drift"].readings == 2
    assert further["drift"].minutes == 2 * further["drift"].wait
    assert further["thermal"].limit.after < 3.0 * PPM
    assert further["thermal"].warmer > 0.0
    assert further["thermal"].readings == len(plan.session.readings)
    for one in further.values():
        assert 0.0 < one.gain < 0.3


def test_planned_readings_have_times_and_temperatures(planned):
    session = schedule_readings(planned.session, temperatures=(20.0, 28.0))
    times = [r.conditions.time for r in session.readings]
    setups = [r.setup for r in session.readings]
    assert times[0] == MORNING
    steps = {
        (a == b, later - time)
        for a, b, time, later in zip(setups, setups[1:], times, times[1:], strict=False)
    }
    assert steps == {(True, timedelta(minutes=0.5)), (False, timedelta(minutes=10.5))}
    warmth = [r.conditions.temperature for r in session.readings]
    assert (warmth[0], warmth[-1]) == (20.0, 28.0)
    assert warmth == sorted(warmth)
    assert [r.approach for r in session.readings] == [r.approach for r in planned.session.readings]


def test_planned_approaches_are_written_and_read(planned, tmp_path):
    path = write_session(planned.session, tmp_path / "monday", blank=True)
    rows = [(r.setup, r.posture, r.cycle, r.approach) for r in load_plan(path).readings]
    assert rows == [(r.setup, r.posture, r.cycle, r.approach) for r in planned.session.readings]
    thermal = planned.session.with_effects(["backlash", "thermal"])
    write_session(thermal, tmp_path / "tuesday", blank=True)
    head = (tmp_path / "tuesday/readings.csv").read_text().partition("\n")[0]
    assert head == "setup,posture,cycle,reading_mm,approach,temperature_C"
    again = load_plan(tmp_path / "tuesday")
    assert again.robot.chosen_effects == ("backlash", "thermal")
    simulate_session(again, {"x_slide.backlash": 30e-6})


def test_arrows_show_the_direction_of_joint_coordinates(orthoglide):
    down = replace(orthoglide.drives[1], direction=-1)
    mixed = replace(orthoglide, drives=(orthoglide.drives[0], down, orthoglide.drives[2]))
    shown = [describe_approach(orthoglide, a) for a in ("ppp", "nnn", "pnu")]
    assert shown == ["↑", "↓", "↑↓·"]
    assert describe_approach(mixed, "ppp") == "↑↓↑"


@pytest.mark.usefixtures("without_sensor_gains")
def test_the_command_plans_for_effects(tmp_path):
    quick = ["--along", "3", "--across-mm", "0", "--sections", "0.5", "--starts", "1"]
    words = ["plan", "orthoglide", *quick, "--effects", "backlash,thermal", "--out", "monday"]
    words[2:2] = ["--model", "offsets"]
    with uncompared():
        code, text, _ = run_orthocal(tmp_path, *words, "--temperature", "20:28")
    assert code == 0
    assert "Backlash of each drive: known to ±" in text
    assert "↑" in text
    assert "it keeps its tolerance of ±3 ppm/K" in " ".join(text.split())
    assert load_plan(tmp_path / "monday").robot.chosen_effects == ("backlash", "thermal")
    assert "setup" in (tmp_path / "monday/readings.csv").read_text()
    assert run_orthocal(tmp_path, *words[:-2], "--temperature", "20:2800").returncode == 2
    assert run_orthocal(tmp_path, "plan", "orthoglide", "--effects", "rust").returncode == 2


def test_simulated_readings_state_the_conditions_of_effects(planned, tmp_path):
    """Approaches are the planned ones, by default those of the programs. Time and temperature are
    stated if an effect depends on them."""
    write_session(planned.session, tmp_path / "plan", blank=True)
    words = ["simulate", "plan", "--error", "x_slide.backlash_mm=0.04", "--exact"]

    def simulated(*more):
        assert run_orthocal(tmp_path, *words, *more, "--out", "try", "--force").returncode == 0
        return [r.conditions for r in load_plan(tmp_path / "try").readings]

    stated = simulated()
    assert [c.approach for c in stated] == [r.approach for r in planned.session.readings]
    assert {(c.temperature, c.time) for c in stated} == {(None, None)}
    stated = simulated("--effects", "backlash,thermal")
    assert {c.temperature for c in stated} == {20.0}
    stated = simulated("--temperature", "20:28")
    assert [stated[0].temperature, stated[-1].temperature] == [20.0, 28.0]
    later = (len(planned.session.setups) - 1) * 10 + (len(stated) - 1) * 0.5
    assert stated[-1].time - stated[0].time == timedelta(minutes=later)
    plan = replace(
        planned.session,
        readings=tuple(
            replace(r, conditions=None, cycle=i) for i, r in enumerate(planned.session.readings, 1)
        ),
    )
    write_session(plan, tmp_path / "plan", blank=True)
    assert {c.approach for c in simulated()} == {"ppp"}
