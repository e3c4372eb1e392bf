"""Motion plans and measuring programs: order, approach from one side, reach.

Joints are compared with Pinocchio's loop closure, programs with a reader of their own, with
LinuxCNC's interpreter and with LinuxCNC's joints in simulation.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from itertools import pairwise
from types import SimpleNamespace

import lxml.html
import numpy as np
import pytest
from calibrated import UNJUDGED
from linuxcnc import Joint, few_nodes, play, run_programs
from machines import place

from orthocal import (
    Machine,
    calibrate,
    draw_errors,
    export_calibration,
    load_plan,
    load_robot,
    simulate_session,
)
from orthocal.builder.build import make_robot
from orthocal.builder.machine_file import Counting
from orthocal.builder.orthoglide import Orthoglide
from orthocal.effects.loading import with_effects
from orthocal.errors import ParameterError, SessionError, UnreachablePathError
from orthocal.export.linuxcnc.export import ExportOptions
from orthocal.io.files import write_files
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.measurement.motion.approach import (
    USUAL_ANGLE,
    USUAL_LENGTH,
    approach_length,
    approach_share,
)
from orthocal.measurement.motion.guidance import shown_joints
from orthocal.measurement.motion.motion import plan_motion, state_program_approaches
from orthocal.measurement.motion.motion_program import ProgramOptions, program_name, write_program
from orthocal.output.sheet.page import sheet_files
from orthocal.session.session import Conditions, Gauge, Reading
from orthocal.units import MM

ROUNDED = 1e-4
"""Rounding of coordinates and joints in a program, [mm]. Half a unit in each of three
joints moves the tool by less."""

SMALL = Orthoglide(leg=0.25, travel=(0.1, 0.32), attachment=0.03, rods_apart=0.06, rod_radius=0.004)
COUNTING = (Counting(True, 0.0), Counting(False, 0.005), Counting(False, None))

PLAN = """robot: mine
gauge: {sigma_mm: 0.005, range_mm: [-5, 5], tip: {ball: {radius_mm: 1.5}}}
postures:
  zero: {tcp_mm: [0, 0, 0]}
  out: {tcp_mm: [50, -10, 5]}
  in: {joints_mm: [200, 245, 240]}
setups:
  "y(x)#ä": {leg: x, touches: a, direction: y, section: {fraction: 0.5}}
  xy: {leg: y, touches: b, direction: -x, section: {fraction: 0.4}, postures: [in, out],
       aligned_at: zero}
"""


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    """Directory with a machine of other dimensions and three joint conventions."""
    folder = tmp_path_factory.mktemp("motion")
    make_robot(SMALL, folder / "mine", counting=COUNTING)
    return folder


@pytest.fixture(scope="module")
def small(directory):
    """Plan with a dial at two legs of that machine."""
    (directory / "plan.yaml").write_text(PLAN)
    return load_plan(directory / "plan.yaml")


@pytest.fixture(scope="module")
def motions(small):
    return plan_motion(small)


@pytest.mark.parametrize(("half_mm", "least_mrad"), [(0.2, 4.0), (5.0, 8.7)])
def test_approaches_of_motors_take_up_their_backlash(root, half_mm, least_mrad):
    """Twice its limit, also for a gauge of short range."""
    robot = with_effects(load_robot(root / "examples/fivebar"), ["backlash"])
    robot = robot.with_tolerances({"*.backlash_mrad": 2.0})
    limits = (-half_mm * MM, half_mm * MM)
    session = SimpleNamespace(robot=robot, gauges={"": Gauge(5e-6, 10e-6, limits)})
    angle = approach_share(session) * USUAL_ANGLE
    assert angle == pytest.approx(least_mrad * 1e-3, rel=0.01)
    assert approach_length(session) == f"{np.rad2deg(angle):.3g}°"


def read_program(text, robot):
    """All coordinates of a program's motions; coordinates and commented joints at its pauses."""
    position: dict[str, float] = {}
    points, pauses, joints = [], [], None
    for line in text.splitlines():
        message = re.search(r"joints ([-0-9. ]+)\)", line)
        joints = [float(v) for v in message[1].split()] if message else joints
        code = re.sub(r"\([^)]*\)", "", line).strip()
        assert code.startswith("G53 G1 ") or not re.search("[XYZ]", code)
        if code.startswith("G53 G1 "):
            position.update({w[0]: float(w[1:]) for w in code.split()[2:]})
            points.append([position[c] for c in "XYZ"])
        elif code == "M0" and points:
            pauses.append((np.array(points[-1]), np.array(joints)))
    return np.array(points), pauses


def test_program_pauses_in_the_alignment_posture_and_at_each_reading(small, motions):
    for motion in motions:
        assert {s.approach for s in motion.stops} == {"ppp"}
        text = write_program(small, motion)
        _, pauses = read_program(text, small.robot)
        rows = [r.posture for r in small.readings if r.setup == motion.setup]
        assert [s.posture for s in motion.stops if s.role == "reading"] == rows
        if motion.setup == "xy":  # aligned in a posture that it does not read
            rows = ["zero", *rows]
        assert len(pauses) == text.splitlines().count("M0") == len(rows)
        expected = nominal_closure(small.robot).forward(
            np.array([small.postures[p].drives for p in rows])
        )
        for (at, _), point in zip(pauses, expected, strict=True):
            assert at == pytest.approx(point / MM, abs=ROUNDED)
        assert "(Before start: gauge removed, machine at its mechanical zero)" in text
        assert text.endswith("remove the gauge, then jog the machine to its mechanical zero)\nM2\n")
        assert max(len(line) for line in text.splitlines()) < 255
        assert text.isascii()


@pytest.mark.parametrize(
    ("aligned_at", "separate"), [(None, False), ("zero", False), ("in", True), ("out", True)]
)
def test_gauge_is_aligned_at_the_first_pause(small, aligned_at, separate):
    """The first setup reads zero first, the other postures later."""
    name = next(iter(small.setups))
    setups = {**small.setups, name: replace(small.setups[name], aligned_at=aligned_at)}
    session = replace(small, setups=setups)
    motion = plan_motion(session)[0]
    assert (motion.alignment is not None) == separate
    before_first_pause, between, *_ = write_program(session, motion).split("\nM0\n")
    assert "mount the gauge, align its ball as the sheet shows" in before_first_pause
    assert ("set the dial to 0, then read" in before_first_pause) == (not separate)
    assert ("set the dial to 0, then read" in between) == separate
    if motion.alignment is not None:
        assert (motion.alignment.posture, motion.alignment.line) == (aligned_at, None)
        assert motion.alignment.lift == ""
        # the gauge is on the rod on the way to the first reading: its plunger is checked there
        shallow = replace(small.gauge, range=(-2e-3, 2e-3))
        first = plan_motion(replace(session, gauges={"": shallow}))[0].stops[0]
        assert bool(first.lift) == (np.abs(motion.alignment.expected) > 2e-3)


def test_commented_joints_reach_the_coordinates_by_pinocchio(small, motions):
    robot = small.robot
    for motion in motions:
        _, pauses = read_program(write_program(small, motion), robot)
        for at, joints in pauses:
            drives = [d.from_joint(v * MM) for d, v in zip(robot.drives, joints, strict=True)]
            assert place(robot, drives, robot.tcp.frame) / MM == pytest.approx(at, abs=ROUNDED)
    shown = shown_joints(robot, robot.drive_zero)
    assert shown == pytest.approx([0.0, 0.005, 0.25])
    assert shown_joints(robot, robot.drive_zero + 0.01) == pytest.approx([0.01, -0.005, 0.24])


def test_every_drive_approaches_from_the_same_side(small, motions):
    """Each drive coordinate grows monotonically by the approach length."""
    robot = small.robot
    for motion in motions:
        points, _ = read_program(write_program(small, motion), robot)
        assert {s.approach for s in motion.stops} == {"ppp"}
        for before, after in zip(points[0::2], points[1::2], strict=True):
            shares = np.linspace(0.0, 1.0, 9)[:, None]
            drives = nominal_closure(robot).inverse((before + shares * (after - before)) * MM)
            assert np.all(np.diff(drives, axis=0) > 0.0)
            assert drives[-1] - drives[0] == pytest.approx([USUAL_LENGTH] * 3, abs=3e-7)


def test_approach_from_the_other_side_at_the_end_of_travel(small):
    lower = replace(small.robot.drives[0], lower=0.2)
    robot = replace(small.robot, drives=(lower, *small.robot.drives[1:]))
    motion = plan_motion(replace(small, robot=robot))[0]
    assert {s.approach for s in motion.stops} == {"nnn"}
    stop = motion.stops[0]
    assert stop.approach_drives - stop.drives == pytest.approx([USUAL_LENGTH] * 3)
    both = replace(lower, upper=max(s.drives[0] for s in motion.stops) + 1e-3)
    robot = replace(small.robot, drives=(both, *small.robot.drives[1:]))
    with pytest.raises(SessionError, match="neither from below nor from above by 2 mm: x_slide"):
        plan_motion(replace(small, robot=robot))


@pytest.mark.parametrize(
    ("half", "backlash", "length"),
    [
        (5e-3, 40e-6, 2e-3),
        (0.4e-3, 40e-6, 0.4e-3),
        (50e-6, 40e-6, 0.2e-3),
        (0.4e-3, 0.3e-3, 0.6e-3),
    ],
)
def test_an_approach_is_no_longer_than_the_dial_allows(small, half, backlash, length):
    """Half the range, unless the backlash needs more; the sheet and `record` name this length."""
    robot = with_effects(small.robot, ["backlash"])
    tolerances = {"*.backlash_mm": backlash / MM}
    gauge = replace(small.gauge, range=(-half, half))
    session = replace(small, robot=robot).with_tolerances(tolerances).with_gauge(gauge)
    assert approach_length(session) == f"{length / MM:g} mm"
    for motion in plan_motion(session):
        for stop in motion.stops:
            assert stop.drives - stop.approach_drives == pytest.approx([length] * 3)


@pytest.mark.parametrize(("half", "approach"), [(0.4e-3, "ppp"), (5e-3, "nnn")])
def test_readings_without_an_approach_get_that_of_the_program(small, half, approach):
    """A drive ends 1 mm below its shortest coordinate: only a short approach is from below."""
    robot = with_effects(small.robot, ["backlash"])
    least = min(p.drives[0] for p in small.postures.values())
    robot = replace(robot, drives=(replace(robot.drives[0], lower=least - 1e-3), *robot.drives[1:]))
    session = replace(small, robot=robot).with_gauge(replace(small.gauge, range=(-half, half)))
    assert {r.approach for r in state_program_approaches(session).readings} == {approach}
    for motion in plan_motion(session):
        assert {s.approach for s in motion.stops} == {approach}


@pytest.fixture(scope="module")
def sided(small):
    """The first setup, with another approach for each reading; zero is read from all sides."""
    name = next(iter(small.setups))
    postures = ("zero", "out", "out", "zero", "in", "zero", "zero", "zero")
    sides = ("nnn", "ppp", "nnn", "ppp", "pnp", "npp", "puu", "nnn")
    readings = (
        Reading(name, p, cycle=i, line=i + 1, conditions=Conditions(side))
        for i, (p, side) in enumerate(zip(postures, sides, strict=True), 1)
    )
    return replace(small, readings=tuple(readings))


def directions(side):
    return np.array([{"p": 1.0, "n": -1.0}[letter] for letter in side])


def test_every_drive_approaches_as_its_reading_states(sided):
    """Drives whose direction is unknown come from the usual side."""
    motion = plan_motion(sided)[0]
    stated = [r.approach for r in sided.readings]
    assert [s.approach for s in motion.stops] == [side.replace("u", "p") for side in stated]
    # only the last stop is that of the first reading again
    assert [s.repeats for s in motion.stops] == [None] * 7 + [2]
    text = write_program(sided, motion)
    points, pauses = read_program(text, sided.robot)
    assert len(pauses) == len(stated) == len(points) / 2
    inverse = nominal_closure(sided.robot).inverse
    for before, after, stop in zip(points[0::2], points[1::2], motion.stops, strict=True):
        shares = np.linspace(0.0, 1.0, 9)[:, None]
        drives = inverse((before + shares * (after - before)) * MM)
        way = directions(stop.approach)
        assert np.all(np.diff(drives, axis=0) * way > 0.0)
        assert drives[-1] - drives[0] == pytest.approx(USUAL_LENGTH * way, abs=3e-7)
        signs = "".join(
            "+" if w * d.direction > 0 else "-"
            for w, d in zip(way, sided.robot.drives, strict=True)
        )
        signs = signs[0] if len(set(signs)) == 1 else signs
        assert f"approach {signs}; joints" in text


def test_an_approach_from_beyond_the_travel_is_refused(sided):
    """Growing from below to the shortest coordinate of the x drive, which is the end of it."""
    least = sided.postures["in"].drives[0]
    lower = replace(sided.robot.drives[0], lower=least - 1e-3)
    robot = replace(sided.robot, drives=(lower, *sided.robot.drives[1:]))
    with pytest.raises(SessionError, match=r"as stated \(pnp\) by 2 mm: x_slide") as refused:
        plan_motion(replace(sided, robot=robot))
    assert refused.value.where.endswith("postures.in")


def test_the_setup_returns_from_the_side_of_its_first_reading(sided):
    motion = plan_motion(replace(sided, readings=sided.readings[:7]))[0]
    assert [(s.posture, s.role, s.approach) for s in motion.stops[-2:]] == [
        ("zero", "reading", "ppp"),
        ("zero", "return", "nnn"),
    ]


def test_motion_ends_in_the_first_posture(motions, raw_cycles):
    for motion in motions:
        assert motion.stops[-1].posture == motion.stops[0].posture
        assert motion.stops[-1].role == "return"
    cycles = plan_motion(raw_cycles)[0]
    # zero, max, min three times over, and back
    assert [s.posture for s in cycles.stops[-2:]] == ["x_min", "zero"]
    assert [s.line for s in cycles.stops] == [*range(2, 11), None]
    assert [s.line for s in cycles.stops if s.repeats == 2] == [5, 8, None]
    text = write_program(raw_cycles, cycles)
    assert text.count("the dial must show the reading of line 2 again") == 3


def test_a_difference_stops_in_both_postures(experiment_2):
    session = experiment_2
    stops = plan_motion(session)[0].stops
    reading = session.readings[0]
    assert [(s.posture, s.role) for s in stops[:2]] == [
        (reading.minus, "subtracted"),
        (reading.posture, "reading"),
    ]


def test_active_offsets_do_not_change_the_program(small, motions):
    entered = small.with_controller([1e-3, -2e-3, 0.0])
    for before, after in zip(motions, plan_motion(entered), strict=True):
        assert write_program(entered, after) == write_program(small, before)


def test_predicted_readings_of_a_machine_without_errors(small, motions):
    for motion in motions:
        first, *rest = motion.stops
        assert first.expected == 0.0
        assert rest[-1].expected == pytest.approx(0.0, abs=1e-12)
    aside = motions[0].stops[1]
    # y is -10 mm at the tool and less at mid-leg; the rod also moves 5 mm sideways under the ball
    assert -0.01 < aside.expected < -0.004


def test_plunger_is_lifted_where_the_dial_would_leave_its_range(small):
    gauge = replace(small.gauge, range=(-2e-3, 2e-3))
    motion = plan_motion(replace(small, gauges={"": gauge}))[0]
    lifts = [s.lift for s in motion.stops]
    assert lifts[0] == ""
    assert "the dial would go" in lifts[1]
    text = write_program(small, motion)
    assert "hold the plunger up on the way to reading line 3" in text


def test_path_that_leaves_the_travel_passes_through_the_mechanical_zero(small):
    """Between the postures, 10 mm above zero, the z leg is upright and its drive farthest."""
    robot = small.robot
    points = np.array([[60.0, 0.0, 10.0], [-60.0, 0.0, 10.0]]) * MM
    drives = nominal_closure(robot).inverse(points)
    assert drives[:, 2] == pytest.approx(0.25 * np.cos(np.arcsin(0.06 / 0.25)) + 0.01)
    z = replace(robot.drives[2], upper=0.256)  # 252.7 mm at the ends, 260 mm between, 250 at zero
    posture = small.postures["zero"]
    postures = {
        n: replace(posture, name=n, values=p, drives=d)
        for n, p, d in zip("ab", points, drives, strict=True)
    }
    readings = tuple(replace(small.readings[0], posture=n, cycle=i) for i, n in enumerate("ab"))
    session = replace(small, postures=postures, readings=readings)
    assert not any(s.via for s in plan_motion(session)[0].stops)
    session = replace(session, robot=replace(robot, drives=(*robot.drives[:2], z)))
    motion = plan_motion(session)[0]
    assert [len(s.via) for s in motion.stops] == [0, 1, 1]
    points, _ = read_program(write_program(session, motion), robot)
    assert np.flatnonzero(np.abs(points).max(axis=1) == 0.0).tolist() == [2, 5]
    for start, end in pairwise(points * MM):
        path = start + np.linspace(0.0, 1.0, 50)[:, None] * (end - start)
        assert nominal_closure(robot).inverse(path)[:, 2].max() < z.upper


def test_the_origin_moves_all_coordinates(small, motions):
    motion = motions[0]
    plain, _ = read_program(write_program(small, motion), small.robot)
    elsewhere = replace(small, controller_origin=(1e-3, -2e-3, 300.5e-3))
    text = write_program(elsewhere, motion, ProgramOptions(feed=1000.0))
    moved, _ = read_program(text, small.robot)
    assert moved - plain == pytest.approx(np.tile([1.0, -2.0, 300.5], (len(plain), 1)))
    assert "F1000" in text


@pytest.mark.parametrize(
    ("option", "value", "where"),
    [
        ("feed", 0.0, "--feed"),
        ("approach_feed", float("nan"), "--approach-feed"),
        ("dwell", 0.01, "--dwell"),
        ("dwell", float("nan"), "--dwell"),
        ("trigger", "64", "--trigger"),
        ("trigger", "M30", "--trigger"),
    ],
)
def test_options_out_of_range_are_refused(option, value, where):
    with pytest.raises(ParameterError) as refused:
        ProgramOptions(**{option: value})
    assert refused.value.where == where


def codes(text):
    """Lines of a program without comments and motions."""
    return [line for line in text.splitlines() if line and line[0] != "(" and "G53" not in line]


@pytest.fixture(scope="module")
def unlimited(small):
    """The plan with a gauge that reads in all postures without a hand."""
    return replace(small, gauges={"": replace(small.gauge, range=None)})


def test_an_automatic_program_dwells_and_triggers_at_each_reading(unlimited):
    motion = plan_motion(unlimited)[0]
    readings = sum(r.setup == motion.setup for r in unlimited.readings)
    begin, end = ["G21 G90 G94 G40 G49", "F600", "M0"], ["M2"]
    by_options = {
        ProgramOptions(dwell=2.5): ["G4 P2.5"],
        ProgramOptions(dwell=2.5, trigger="M110"): ["G4 P2.5", "M110"],
        ProgramOptions(trigger="3"): ["G4 P1", "M64 P3", "G4 P0.1", "M65 P3"],
    }
    plain, _ = read_program(write_program(unlimited, motion), unlimited.robot)
    for options, lines in by_options.items():
        text = write_program(unlimited, motion, options)
        assert codes(text) == [*begin, *readings * lines, *end]
        moved, _ = read_program(text, unlimited.robot)
        assert moved == pytest.approx(plain)


def test_an_automatic_program_pauses_where_a_hand_is_needed(small, motions, experiment_2):
    motion = motions[0]
    assert [bool(s.lift) for s in motion.stops] == [False, True, True, False]
    text = write_program(small, motion, ProgramOptions(dwell=2.0))
    # mounted, read, held; released, read, held; released, read
    assert codes(text)[2:-1] == ["M0", "G4 P2", "M0", "M0", "G4 P2", "M0", "M0", "G4 P2"]
    difference = plan_motion(experiment_2)[0]
    text = write_program(experiment_2, difference, ProgramOptions(dwell=2.0))
    assert codes(text)[2:-1] == ["M0", "M0", "G4 P2"]  # mounted; set to 0; read


def test_too_many_readings_are_refused(small):
    many = tuple(replace(small.readings[0], cycle=i) for i in range(2001))
    with pytest.raises(SessionError, match="plans 2001 readings; a sheet holds at most 2000"):
        plan_motion(replace(small, readings=many))


def test_program_names_hold_safe_characters(small, motions):
    assert [program_name(small, m) for m in motions] == ["01-y_x___.ngc", "02-xy.ngc"]


RESET = ["G92.1", "G49", *(f"G10 L2 P{k} X0 Y0 Z0 R0" for k in (1, 2)), "G54 G90 G21 G17"]

CONTROLLER_STATES = {
    "initial": [],
    "all": ["G10 L2 P2 X3 Y-2 Z6 R-40", "G55", "G92 X1 Y2 Z3", "G43.1 X3 Z-5", "G20 G91 G18"],
}
"""Lines before the program; no two displacements in `all` cancel."""


@cache
def _export_nominal(session):
    """Files of the module with nominal kinematics, from exact readings of a session."""
    gauges = {n: replace(g, range=None) for n, g in session.gauges.items()}
    anything = replace(session, gauges=gauges)
    exact = simulate_session(anything, {}, exact=True).session
    options = ExportOptions(module=True, half_side=0.055, within=0.1e-6)
    calibration = calibrate(exact, "offsets", **UNJUDGED)
    with few_nodes():
        return export_calibration(calibration, "linuxcnc", anyway=True, options=options)


def _run_nominal(session, program, folder, before=((),), *, output=False):
    """A program on nominal legs, after lines of MDI; as `run_programs`."""
    robot = session.robot
    files = _export_nominal(session)
    write_files(folder, files)
    switch = [d.zero / MM + 10.0 for d in robot.drives]
    joints = [
        Joint(d.direction, s, float(d.to_joint(s * MM)) / MM, float(d.to_joint(d.zero)) / MM)
        for d, s in zip(robot.drives, switch, strict=True)
    ]
    runs = [([*RESET, *mdi], program.splitlines()) for mdi in before]
    lines = files["kinematics.ini"]
    return run_programs(runs, joints, lines=lines, module=folder, output=output)


@pytest.mark.acceptance
def test_linuxcnc_joints_do_not_depend_on_offsets_rotation_or_tool_length(small, motions, tmp_path):
    """At every pause LinuxCNC's joints equal those in the program's comment, on nominal legs."""
    robot = small.robot
    fast = ProgramOptions(feed=12_000.0, approach_feed=3_000.0)
    program = write_program(small, motions[0], fast)
    before = [[*RESET, *mdi] for mdi in CONTROLLER_STATES.values()]
    _, pauses = _run_nominal(small, program, tmp_path, before)
    expected = np.array([shown for _, shown in read_program(program, robot)[1]])
    for state, shown in zip(CONTROLLER_STATES, pauses, strict=True):
        assert shown == pytest.approx(expected, abs=2 * ROUNDED), state


STANDSTILL = 50
"""Servo periods without motion in a pause."""


@pytest.mark.acceptance
def test_linuxcnc_takes_up_backlash_from_the_stated_side(small, sided, tmp_path):
    """Slides that stay behind by half of the backlash, however they went before."""
    motion = plan_motion(sided)[0]
    program = write_program(sided, motion, ProgramOptions(feed=12_000.0, approach_feed=3_000.0))
    # the driver resumes at once
    slides, (pauses,) = _run_nominal(small, program.replace("\nM0", "\nG4 P0.1\nM0"), tmp_path)
    still = np.abs(np.diff(slides, axis=0)).max(axis=1) < 1e-6
    edges = np.flatnonzero(np.diff(np.r_[False, still, False].astype(int)))
    begun = [a for a, b in edges.reshape(-1, 2) if b - a > STANDSTILL]
    expected = np.array([stop.drives for stop in motion.stops]) / MM
    assert len(pauses) == len(expected)
    at = begun[-len(expected) :]
    assert slides[at] == pytest.approx(expected, abs=5e-4)
    backlash = np.array([0.03, 0.04, 0.05])
    actual = play(slides, backlash)
    sides = np.array([directions(stop.approach) for stop in motion.stops])
    assert actual[at] - slides[at] == pytest.approx(-backlash / 2.0 * sides, abs=1e-6)


BAR = """robot: mine
gauge: {sigma_mm: 0.002, range_mm: [-0.5, 0.5]}
postures:
  a: {tcp_mm: [54, -3, -40]}
  b: {tcp_mm: [4, 47, -40]}
  c: {tcp_mm: [-46, -3, -40]}
  d: {tcp_mm: [4, -3, 10]}
setups:
  bar: {sensor: ball_bar, centre_mm: [4, -3, -80], tool_mm: [0, 0, -40], length_mm: 50}
"""


@pytest.fixture(scope="module")
def bar(directory):
    """Plan of a ball bar: quarters of circles, and half a circle over the pole."""
    (directory / "bar.yaml").write_text(BAR)
    session = load_plan(directory / "bar.yaml")
    rows = [Reading("bar", name) for name in "abcadb"]
    return replace(session, readings=tuple(replace(r, cycle=i + 1) for i, r in enumerate(rows)))


@pytest.mark.acceptance
def test_linuxcnc_triggers_a_logger_in_every_posture_of_a_ball_bar(small, bar, tmp_path):
    """At each trigger the slides rest in the posture, and the bar shows its simulated reading."""
    bar = replace(bar, readings=bar.readings[3:])  # quarters of circles
    (motion,) = plan_motion(bar)
    options = ProgramOptions(6000.0, 1500.0, dwell=0.4, trigger="0")
    program = write_program(bar, motion, options)
    recorded, (pauses,) = _run_nominal(small, program, tmp_path, output=True)
    assert len(pauses) == 2  # before the first motion, and where the bar is mounted
    slides, output = recorded[:, :-1], recorded[:, -1]
    rising = np.flatnonzero(np.diff(output, prepend=0.0) > 0.5)
    read = [stop for stop in motion.stops if stop.role == "reading"]
    assert slides[rising] == pytest.approx(np.array([s.drives for s in read]) / MM, abs=5e-4)
    for k in rising:
        # 180 ms of the joints: on a busy computer they run slower than the clock of the dwell
        before = slides[max(k - 180, 0) : k]
        assert np.abs(before - slides[k]).max() < 1e-6

    def shown(errors, slides):
        """Reading of the bar, by its definition, [m]."""
        ball = Machine(bar.robot, errors).forward(slides * MM) + np.array([0.0, 0.0, -40.0]) * MM
        return np.linalg.norm(ball - np.array([4.0, -3.0, -80.0]) * MM, axis=1) - 50.0 * MM

    errors = draw_errors(bar.robot, ["*.offset"], seed=2, tolerances={"*.offset_mm": 1.0})
    wide = replace(bar, gauges={"": replace(bar.gauge, range=None)})
    expected = simulate_session(wide, errors, exact=True).session.values
    assert np.ptp(expected) > 0.3 * MM
    assert shown(errors, slides[rising]) == pytest.approx(expected, abs=1e-6)
    # between the readings the bar stays on its sphere, from the first trigger to the last
    assert np.abs(shown({}, slides[rising[0] : rising[-1] : 20])).max() < 20e-6


def test_a_ball_bar_keeps_its_length_between_its_readings(bar):
    (motion,) = plan_motion(bar)
    points, pauses = read_program(write_program(bar, motion), bar.robot)
    balls = points - np.array([4.0, -3.0, -40.0])  # ball at the tool and fixed ball
    first = next(i for i, p in enumerate(points) if np.array_equal(p, pauses[0][0]))
    lengths = np.linalg.norm(balls[first:], axis=1)
    assert np.abs(lengths - 50.0).max() < 0.005 + ROUNDED  # `SAGITTA` in the approach of 0.5 mm
    chords = np.diff(balls[first:], axis=0)
    assert 50.0 * (1.0 - np.cos(np.linalg.norm(chords, axis=1).max() / 100.0)) < 0.006
    assert not any(s.lift for s in motion.stops)
    robot = bar.robot
    for stop, before in zip(motion.stops[1:], motion.stops, strict=False):
        change = stop.drives - nominal_closure(robot).inverse(np.array([stop.approach_point]))[0]
        signs = {"p": 1.0, "n": -1.0, "u": 0.0}
        known = np.abs(change) > 1e-6
        assert [signs[k] for k in stop.approach] == np.where(known, np.sign(change), 0.0).tolist()
        assert np.linalg.norm(stop.approach_point - stop.point) == pytest.approx(0.5 * MM, rel=1e-4)
        assert stop.posture != before.posture


OVER_BED = """robot: linear_delta
gauge: {sigma_mm: 0.005, range_mm: [-1, 1]}
postures:
  a: {tcp_mm: [60, 0, 0]}
  b: {tcp_mm: [0, 60, 0]}
  below: {tcp_mm: [0, 0, 0]}
setups:
  bar: {sensor: ball_bar, centre_mm: [0, 0, 80], length_mm: 100}
"""


def test_a_bar_with_its_fixed_ball_above_moves_over_the_bed(tmp_path):
    """Half way on a great arc it would be 8.3 mm below the bed."""
    (tmp_path / "bar.yaml").write_text(OVER_BED)
    plan = load_plan(tmp_path / "bar.yaml")
    session = replace(plan, readings=(Reading("bar", "a"), Reading("bar", "b", cycle=2)))
    (motion,) = plan_motion(session)
    points, _ = read_program(write_program(session, motion), session.robot)
    assert points[:, 2].min() > -ROUNDED
    lengths = np.linalg.norm(points - [0.0, 0.0, 80.0], axis=1)
    assert np.abs(lengths[-10:] - 100.0).max() < 0.005 + ROUNDED
    # shorter below the fixed ball: then each path bulges through the bed
    rows = (Reading("bar", "a"), Reading("bar", "below", cycle=2))
    with pytest.raises(UnreachablePathError, match=r"posture 'below' .* goes below the bed"):
        plan_motion(replace(session, readings=rows))


def test_readings_of_a_bar_without_an_approach_get_that_of_their_path(bar):
    session = replace(bar, robot=with_effects(bar.robot, ["backlash"]))
    stated = state_program_approaches(session)
    (motion,) = plan_motion(stated)
    read = [s.approach for s in motion.stops if s.role == "reading"]
    assert [r.approach for r in stated.readings] == read


@pytest.mark.parametrize("aligned_at", ["a", "c"])
def test_a_program_waits_before_it_moves_where_a_fixed_ball_may_stand(bar, aligned_at):
    """It names its first posture, in machine coordinates, where the ball stays."""
    setups = {"bar": replace(bar.setups["bar"], aligned_at=aligned_at)}
    session = replace(bar, setups=setups, controller_origin=(1e-3, 2e-3, 3e-3))
    (motion,) = plan_motion(session)
    lines = write_program(session, motion, ProgramOptions(dwell=1.0)).splitlines()
    pause = lines.index("M0")
    assert pause < next(i for i, line in enumerate(lines) if line.startswith("G53"))
    begin = motion.alignment or motion.stops[0]
    assert begin.posture == aligned_at
    assert (motion.alignment is None) == (aligned_at == "a")
    at = np.array(bar.postures[aligned_at].values) / MM + [1.0, 2.0, 3.0]
    for text in (lines[pause - 1], "".join(line for line in lines[:pause] if "jogged" in line)):
        found = re.search(r"X([-\d.]+) Y([-\d.]+) Z([-\d.]+)", text)
        assert [float(v) for v in found.groups()] == pytest.approx(at, abs=ROUNDED)
    assert max(map(len, lines)) < 255
    assert "\n".join(lines).isascii()


def test_a_posture_is_passed_where_its_approach_has_the_other_direction(bar):
    (motion,) = plan_motion(bar)
    natural = motion.stops[1].approach
    other = natural.translate(str.maketrans("pn", "np"))
    rows = list(bar.readings)
    rows[1] = replace(rows[1], conditions=Conditions(other))
    (turned,) = plan_motion(replace(bar, readings=tuple(rows)))
    stop = turned.stops[1]
    assert stop.approach == other
    passed = np.linalg.norm(np.array(stop.via) - stop.point, axis=1)
    assert passed[-1] < 1e-9  # through the posture, and back to it
    middle = 0.5 * (stop.approach_point + motion.stops[1].approach_point)
    np.testing.assert_allclose(middle, stop.point, atol=1e-9)
    rows[1] = replace(rows[1], conditions=Conditions("ppp"))
    with pytest.raises(SessionError, match="along the path of setup 'bar'"):
        plan_motion(replace(bar, readings=tuple(rows)))


def test_the_closing_reading_of_a_bar_repeats_the_first_one(bar):
    """The path chooses the approach of the first reading, as nothing is mounted before it."""
    setups = {"bar": replace(bar.setups["bar"], aligned_at="a")}
    rows = tuple(Reading("bar", name, cycle=1 + i // 3) for i, name in enumerate("adba"))
    (motion,) = plan_motion(replace(bar, setups=setups, readings=rows))
    first, *_, last = motion.stops
    assert (first.approach, last.approach) == ("pnn", "pnn")
    assert last.repeats == first.line
    # a session may state the side of the path to the second posture
    begin = replace(rows[0], conditions=Conditions("nnn"))
    (other,) = plan_motion(replace(bar, setups=setups, readings=(begin, *rows[1:])))
    assert (other.stops[0].approach, other.stops[-1].approach) == ("nnn", "pnn")
    assert other.stops[-1].repeats is None


def test_a_path_returns_to_its_first_posture_from_either_side(bar):
    """Readings state the approaches that the path gives them; the return states none."""
    rows = tuple(Reading("bar", name) for name in "adb")
    (motion,) = plan_motion(replace(bar, readings=rows))
    arrived = [s.approach for s in motion.stops if s.role == "reading"]
    stated = tuple(replace(r, conditions=Conditions(a)) for r, a in zip(rows, arrived, strict=True))
    (again,) = plan_motion(replace(bar, readings=stated))
    assert [s.approach for s in again.stops[:-1]] == arrived
    assert (again.stops[-1].role, again.stops[-1].posture) == ("return", "a")
    back = again.stops[-1].approach
    assert back not in (arrived[0], arrived[0].translate(str.maketrans("pn", "np")))


def warnings_of(session):
    """Expected readings of a sheet, and its warnings."""
    page = lxml.html.fromstring(sheet_files(session)["sheet.html"])
    shown = [row[-3].text_content() for row in page.xpath("//table[contains(@class,'boxes')]//tr")]
    return shown[1:], [p.text_content() for p in page.xpath("//p[@class='warn']")]


@pytest.mark.parametrize(
    "sensor",
    [
        "{sensor: probe, direction: -z, surface: plane, zero: free}",
        "{sensor: points, target_mm: [0, 0, -40], zero: free}",
    ],
)
def test_an_instrument_without_a_dial_has_no_bezel_and_no_plunger(directory, sensor):
    plan = f"{PLAN[: PLAN.index('setups:')]}setups:\n  s: {sensor}\n"
    (directory / "free.yaml").write_text(plan)
    files = sheet_files(load_plan(directory / "free.yaml"))
    assert len(files) == 2  # the sheet and one program
    for text in files.values():
        assert not re.search(r"set the dial|bezel|plunger|the hand must", text)


@pytest.mark.parametrize(
    ("lengths", "shown", "beyond"),
    [
        ((49.2, 50.8), ["-0.80", "+0.80", "-0.80"], ""),
        ((51.4, 51.4), ["+1.40", "+1.40", "+1.40"], "+1.4 mm in line 2"),
    ],
)
def test_expected_readings_of_a_known_zero_are_absolute(bar, lengths, shown, beyond):
    """A bar of 50 mm with a range of ±1 mm: its readings are distances less 50 mm."""
    postures = {
        n: replace(bar.postures[n], values=p, drives=nominal_closure(bar.robot).inverse(p[None])[0])
        for n, length, along in zip("ab", lengths, np.eye(3), strict=False)
        for p in [(np.array([4.0, -3.0, -40.0]) + length * along) * MM]
    }
    gauges = {"": replace(bar.gauge, range=(-1.0 * MM, 1.0 * MM))}
    rows = (Reading("bar", "a"), Reading("bar", "b"))
    session = replace(bar, postures=postures, gauges=gauges, readings=rows)
    expected, warnings = warnings_of(session)
    assert [text.replace("−", "-") for text in expected] == shown
    assert len(warnings) == 2 * bool(beyond)  # of the reading, and of the path
    assert beyond in "".join(warnings).replace("−", "-")
