"""Use of the command line with a home-made ball bar, up to confirmed offsets.

new → record → calibrate → export → again → record → validate. The machine is simulated, with all
its errors at tolerance. `test_motion.py` runs the program of a ball bar in LinuxCNC.
"""

from __future__ import annotations

import numpy as np
import pytest
from commands import run_orthocal

from orthocal import Machine, assess_tool, draw_errors, load_calibration, load_plan, write_session
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import build_observations
from orthocal.observation.sensor_groups import nuisance_parameters
from orthocal.observation.simulate import show_readings
from orthocal.units import MM

SIZES = """--leg-mm 250 --travel-mm 100:325 --attachment-mm 30 --rods-apart-mm 60 --rod-radius-mm 4
--counts up,down,up --at-zero-mm 0 --effects none --hours 0.25"""
BAR = """sensor: ball_bar
sigma_mm: 0.002
resolution_mm: 0.001
range_mm: [-5, 5]
length_mm: 50
length_tolerance_mm: unknown
"""
SEED = 3
QUICK = ("--solver", "variable-projection")
CARE = 0.5
"""Part of the tolerances to which gauges are mounted, so that the dials stay in their range."""


def run(folder, *words, typed=""):
    done = run_orthocal(folder, *words, typed=typed)
    assert done.returncode == 0, (words, done.stdout[-2000:], done.stderr)
    return done.stdout


def read(plan, errors, seed):
    """Readings of a session, [m]: balls and dials are mounted anew, gauges stay the same."""
    observations, rng = build_observations(plan), np.random.default_rng(seed)
    drawn = []
    for p in nuisance_parameters(plan).parameters:
        of_gauge = np.random.default_rng([SEED, *p.name.encode()]).normal()
        drawn.append(
            CARE * p.prior_std * (of_gauge if p.name.startswith("gauge.") else rng.normal())
        )
    exact = predict_readings(plan, errors, observations=observations, nuisance=np.array(drawn))
    shown, _ = show_readings(plan, observations, exact, rng=rng)
    return observations.rows(shown)


def measure(folder, session, errors, seed):
    """Read a planned session on the machine, and type it in."""
    shown = read(load_plan(folder / session), errors, seed)
    typed = "".join(f"{v / MM:.3f}\n" for v in shown)
    said = run(folder, "record", session, typed=typed + "\n")
    assert f"All {len(shown)} readings are recorded." in said


@pytest.fixture(scope="module")
def machine(tmp_path_factory, short_reports, quick_plans, module_without_sensor_gains):
    """Directory with a planned machine, its plan with a ball bar, and the machine's errors."""
    folder = tmp_path_factory.mktemp("bar")
    (folder / "bar.yaml").write_text(BAR)
    tolerance = "*.offset_mm=1"
    run(folder, "new", "mill", *SIZES.split(), "--tolerance", tolerance, "--with", "bar.yaml")
    plan = load_plan(folder / "mill/first")
    errors = draw_errors(plan.robot, ["*"], seed=SEED, tolerances={"*.offset_mm": 1.0})
    assert plan.robot.effect_names == ()
    assert {s.sensor.kind for s in plan.setups.values()} == {"ball_bar"}
    return folder, plan, errors


@pytest.mark.slow
def test_entered_offsets_are_confirmed(machine):
    folder, plan, errors = machine
    measure(folder, "mill/first", errors, SEED)
    said = run(folder, "calibrate", "mill/first", "--out", "one", *QUICK)
    assert "Enter these offsets" in said
    run(folder, "export", "one", "--to", "linuxcnc", "--offsets", "--out", "cnc")
    assert "HOME_OFFSET" in (folder / "cnc/joints.ini").read_text()
    run(folder, "again", "one", "--out", "second")
    again = load_plan(folder / "second")
    write_session(again.with_values(read(again, errors, SEED + 1)), folder / "second")
    said = run(folder, "validate", "one", "second")
    assert "onfirmed" in said
    one = load_calibration(folder / "one")
    entered = np.array([e.enter for e in one.assessment.entries])
    tool = assess_tool(one)
    nominal, real = Machine(plan.robot, {}), Machine(plan.robot, errors)

    def size(offsets):
        """RMS tool error of the real machine over the workspace after alignment, [m]."""
        reached = real.forward(nominal.inverse(tool.targets) - offsets)
        return tool.measure(reached - tool.targets).aligned.rms

    assert size(entered) < 0.5 * size(np.zeros(3))
    assert size(entered) == pytest.approx(one.assessment.tool.entered, rel=0.3)
