"""Complete use of the command line on simulated machines at their tolerances, up to a better part.

new → check → calibrate → enter → calibrate; and with effects new → simulate → calibrate → export →
again → simulate → validate → calibrate both → correct.
"""

from __future__ import annotations

import csv
import re
import shutil

import numpy as np
import pytest
from adjusting import aligned_rms
from commands import run_orthocal
from conftest import no_sensor_gains
from independent import Expansion, IndependentMachine, States
from linuxcnc import play
from programs import read_polyline
from uncompared import uncompared

from orthocal import (
    Machine,
    assess_tool,
    draw_errors,
    load_calibration,
    load_plan,
    load_robot,
    load_session,
    restore_session,
    simulate_session,
    write_session,
)
from orthocal.assessment.controller_entries import find_entries
from orthocal.observation.simulate import collect_errors
from orthocal.units import MM

pytestmark = pytest.mark.acceptance

DIMENSIONS = """--leg-mm 250 --travel-mm 100:325 --attachment-mm 30 --rods-apart-mm 60
--rod-radius-mm 4 --counts up,down,up --at-zero-mm 0 --effects none --paper"""


SEED = 2


def run(folder, *words, typed="", code=0):
    done = run_orthocal(folder, *words, typed=typed)
    assert done.returncode == code, (words, done.stdout[-2000:], done.stderr)
    return done.stdout


def actual_tool_error(calibration, errors, command):
    """Tool error of the actual machine over the workspace after alignment, RMS, [m]."""
    tool = assess_tool(calibration)
    reached = Machine(calibration.robot, errors).forward(command(tool.targets))
    return tool.measure(reached - tool.targets).aligned.rms


@pytest.fixture(scope="module")
def two_rounds(tmp_path_factory, short_reports):
    """Directory after two rounds, true errors, both calibrations and the last answer."""
    folder = tmp_path_factory.mktemp("walk")
    run(folder, "new", "mill", *DIMENSIONS.split(), "--tolerance", "*.offset_mm=4")
    robot = load_robot(folder / "mill")
    errors = draw_errors(robot, ["*"], seed=SEED, tolerances={"*.offset_mm": 4.0})
    plan = load_plan(folder / "mill/first")
    write_session(simulate_session(plan, errors, seed=SEED).session, folder / "mill/first")
    run(folder, "check", "mill/first")
    run(folder, "calibrate", "mill/first", "--out", "one")
    one = load_calibration(folder / "one")
    # the same plan with the offsets entered
    entered = np.array([round(e.enter, 6) for e in find_entries(one)])
    session = load_session(folder / "mill/first").with_controller(entered)
    write_session(simulate_session(session, errors, seed=SEED + 1).session, folder / "mill/second")
    answer = run(folder, "calibrate", "mill/second", "--out", "two")
    return folder, errors, one, load_calibration(folder / "two"), " ".join(answer.split())


@pytest.mark.slow
def test_actual_tool_error_is_the_expected_one(two_rounds):
    _, errors, one, two, answer = two_rounds
    nominal = Machine(one.robot, {})
    enter = np.array([e.enter for e in find_entries(one)])
    before, entered, corrected = (
        actual_tool_error(calibration, errors, command)
        for calibration, command in (
            (one, nominal.inverse),
            (one, lambda p: nominal.inverse(p) - enter + one.active_offsets),
            (two, two.machine.inverse),
        )
    )
    expected = assess_tool(two).after.sizes.aligned.rms
    assert corrected < 1.2 * expected
    assert corrected < 0.5 * entered
    assert entered < 0.5 * before
    printed = re.search(r"With all identified errors corrected: ([0-9.]+) mm", answer)
    assert float(printed[1]) == pytest.approx(expected * 1e3, abs=0.5e-3)
    assert two.assessment.tool.compensated == pytest.approx(expected)


EFFECTS = "--tolerance *.offset_mm=2 --effects backlash,thermal"
TEMPERATURES = "18:26", "19:27"
"""Temperatures of the first and the last reading of both sessions, [°C]."""

BACKLASH = 40e-6
"""Backlash of each drive, [m]."""

CUTTING_TEMPERATURE = 26.0
"""[°C]"""

HOLES = np.random.default_rng(4).uniform(-42.0, 42.0, (40, 3)).round(2)
"""Holes of the part in the order of drilling, [mm]."""

FIRST_HOLE = 3
"""Holes after which every drive has reversed."""


@pytest.fixture(scope="module")
def warming_machine(tmp_path_factory, short_reports):
    """Directory of two sessions on days that warm by 8 K, up to the corrected program.

    With the output of `validate`.
    """
    folder = tmp_path_factory.mktemp("warming")
    options = DIMENSIONS.replace("--effects none", EFFECTS)
    run(folder, "new", "mill", *options.split())
    day = "--temperature", TEMPERATURES[0]
    few = "--along 3 --across-mm 0 --sections 0.5 --starts 1".split()
    with no_sensor_gains(), uncompared():
        run(folder, "plan", "mill", *few, *day, "--out", "mill/both-sides")

    def identify(name, *sessions):  # without its report
        (folder / name).mkdir()
        document = run(folder, "calibrate", *sessions, "--json", "--solver", "variable-projection")
        (folder / name / "calibration.json").write_text(document)

    truth = [f"--error={d}_slide.backlash_mm={BACKLASH / MM:g}" for d in "xyz"]
    draw = "--draw", "full", "--seed", SEED, *truth
    run(folder, "simulate", "mill/both-sides", *draw, *day, "--out", "one")
    identify("first", "one")
    home = "--offsets", "--home-offset", "0,0,0", "--latched=+,+,+"
    run(folder, "export", "first", "--to", "linuxcnc", *home, "--out", "cnc")
    run(folder, "again", "first", "--ini", "cnc/joints.ini", "--out", "mill/second")
    same = "--errors", "one/truth.yaml", "--seed", SEED + 1
    run(folder, "simulate", "mill/second", *same, "--temperature", TEMPERATURES[1], "--out", "two")
    validated = " ".join(run(folder, "validate", "first", "two").split())
    identify("both", "one", "two")
    drilled = [
        f"N{n} {'G1' if n > 1 else 'G0'} X{x} Y{y} Z{z} F600"
        for n, (x, y, z) in enumerate(HOLES, start=1)
    ]
    (folder / "part.ngc").write_text("\n".join(["G21 G90 G61", *drilled, "M2", ""]))
    options = "--offsets", "active", "--temperature", CUTTING_TEMPERATURE
    run(folder, "correct", "both", "part.ngc", *options, "--out", "good.ngc")
    return folder, validated


def drill(folder, program):
    """Error of the actual holes after alignment of the part, RMS, [m].

    The controller has nominal kinematics and the offsets and the backlash of the second session.
    """
    both, bare = load_calibration(folder / "both"), folder / "bare"
    robot = both.robot
    if not bare.exists():
        bare.mkdir()
        for name in ("mill.urdf", "mill.yaml"):
            shutil.copy(folder / "mill" / name, bare)
    lines = (folder / program).read_text().splitlines()
    written = [(n, at) for n, points in read_polyline(lines).items() for at, _ in points if n]
    motors = Machine(robot, {}).inverse(np.array([at for _, at in written]) * MM)
    motors = motors - both.active_offsets
    steps = np.diff(motors, axis=0, prepend=motors[:1])
    moved = np.maximum.accumulate(np.where(steps, np.arange(len(steps))[:, None], 0), axis=0)
    sides = np.sign(np.take_along_axis(steps, moved, axis=0))
    slides = motors + 0.5 * sides * both.compensated_backlash
    slides = play(slides, np.full(slides.shape[1], BACKLASH))
    truth = collect_errors(robot, file=folder / "one/truth.yaml")
    rigid = {n: v for n, v in truth.items() if not n.endswith(".backlash")}
    machine = IndependentMachine(bare, rigid, expansion=Expansion())
    states = States(slides, np.zeros_like(slides), np.full(len(slides), CUTTING_TEMPERATURE))
    (reached,) = machine.tool(states)
    last = {n: i for i, (n, _) in enumerate(written)}
    holes = reached[[last[n] for n in range(1, len(HOLES) + 1)]]
    return aligned_rms(holes[FIRST_HOLE:], HOLES[FIRST_HOLE:] * MM)


@pytest.mark.slow
def test_part_of_a_machine_with_effects_has_the_expected_error(warming_machine):
    folder, validated = warming_machine
    with open(folder / "one/readings.csv") as file:
        readings = list(csv.DictReader(file))
    assert {r["approach"] for r in readings} == {"ppp", "nnn"}
    assert {float(r["temperature_C"]) for r in readings} >= {18.0, 26.0}
    first, both = (load_calibration(folder / name) for name in ("first", "both"))
    # the next session has the same approaches, without temperatures and times
    plan = load_plan(folder / "mill/second").readings
    before = restore_session(first).readings
    assert [(r.key, r.approach) for r in plan] == [(r.key, r.approach) for r in before]
    assert {(r.conditions.temperature, r.conditions.time) for r in plan} == {(None, None)}
    assert "temperature [°C]" in (folder / "mill/second/sheet.html").read_text()
    assert "The calibration is confirmed." in validated
    # the first alone corrects all errors, too, but from half of the readings
    assert "orthocal calibrate one two --out two-calibration" in validated
    for p in both.free:
        if p.name.endswith(".backlash"):  # three of them, to 99.7 %
            half = 1.5 * both.expand_estimate(p)
            assert p.value == pytest.approx(BACKLASH, abs=half)
    entered = [e.enter for e in first.assessment.backlash]
    assert both.compensated_backlash == pytest.approx(np.round(entered, 6), abs=1e-12)
    expected = both.assessment.tool.compensated
    corrected, plain = (drill(folder, name) for name in ("good.ngc", "part.ngc"))
    assert corrected < 1.15 * expected
    assert corrected < 0.8 * plain
