"""From a new machine to confirmed offsets with a dial and a ball bar.

new → plan → sheet for a logger → program in LinuxCNC → record → calibrate → export → again → record
→ validate. The simulated machine has all errors within its tolerances.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from commands import run_orthocal
from linuxcnc import require_linuxcnc
from test_motion import _run_nominal

from orthocal import (
    Machine,
    assess_tool,
    draw_errors,
    load_calibration,
    load_plan,
    simulate_session,
    write_session,
)
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import build_observations
from orthocal.observation.sensor_groups import nuisance_parameters
from orthocal.observation.simulate import show_readings
from orthocal.sensors.ball_bar import BallBar
from orthocal.units import MM

SIZES = """--leg-mm 250 --travel-mm 100:325 --attachment-mm 30 --rods-apart-mm 60 --rod-radius-mm 4
--counts up,down,up --at-zero-mm 0 --effects none --paper"""
QUICK = "--along 3 --across-mm 0 --sections 0.5 --starts 1 --hours 0.6"
BAR = """sensor: ball_bar
sigma_mm: 0.002
resolution_mm: 0.001
range_mm: [-2, 2]
length_mm: 50
length_tolerance_mm: unknown
"""
SEED = 2
RECORDED = 8
"""Readings that are typed; the table contains the others."""
MOUNTED = 0.5
"""Mounting errors relative to their tolerances, so that the dials stay in their range."""


def run(folder, *words, typed=""):
    done = run_orthocal(folder, *words, typed=typed)
    assert done.returncode == 0, (words, done.stdout[-2000:], done.stderr)
    return done.stdout


def read(plan, errors, seed):
    """Readings of a session, [m]. Gauges are mounted anew; their own parameters stay the same."""
    observations, rng = build_observations(plan), np.random.default_rng(seed)
    drawn = []
    for p in nuisance_parameters(plan).parameters:
        same = np.random.default_rng([SEED, *p.name.encode()]).normal()
        value = same if p.name.startswith("gauge.") else rng.normal()
        drawn.append(MOUNTED * p.prior_std * value)
    exact = predict_readings(plan, errors, observations=observations, nuisance=np.array(drawn))
    shown, _ = show_readings(plan, observations, exact, rng=rng)
    return observations.rows(shown)


def measure(folder, session, errors, seed):
    """Complete the readings of a planned session: the last ones are recorded."""
    shown = [f"{v / MM:.3f}" for v in read(load_plan(folder / session), errors, seed)]
    table = folder / session / "readings.csv"
    head, *rows = table.read_text().splitlines()
    written = [row + v for row, v in zip(rows[:-RECORDED], shown, strict=False)]
    table.write_text("\n".join([head, *written, *rows[-RECORDED:]]) + "\n")
    text = run(folder, "record", session, typed="\n".join([*shown[-RECORDED:], "", ""]))
    assert f"All {len(shown)} readings are recorded." in text


@pytest.fixture(scope="module")
def machine(tmp_path_factory, short_reports, module_without_sensor_gains):
    """Directory with a machine, its plan with both sensors, and the errors of the machine."""
    folder = tmp_path_factory.mktemp("bar")
    (folder / "bar.yaml").write_text(BAR)
    run(folder, "new", "mill", *SIZES.split(), "--tolerance", "*.offset_mm=1")
    run(folder, "plan", "mill", *QUICK.split(), "--with", "bar.yaml", "--out", "bars")
    legs, bars = load_plan(folder / "mill/first"), load_plan(folder / "bars")
    assert {type(s.sensor).kind for s in bars.setups.values()} == {"ball_bar"}
    of_legs = {n: replace(s, gauge="dial") for n, s in legs.setups.items()}
    plan = replace(
        bars,
        gauges={"dial": legs.gauge, "bar": replace(bars.gauges["bar"], range=(-4e-3, 4e-3))},
        postures={**legs.postures, **bars.postures},
        setups={**of_legs, **bars.setups},
        readings=(*legs.readings, *bars.readings),
    )
    write_session(plan, folder / "first", blank=True)
    errors = draw_errors(plan.robot, ["*"], seed=SEED, tolerances={"*.offset_mm": 1.0})
    return folder, plan, errors


@pytest.mark.slow
def test_a_bar_is_read_where_linuxcnc_triggers(machine, tmp_path):
    """At each trigger the bar has the simulated reading of its row."""
    require_linuxcnc()
    folder, plan, errors = machine
    words = ("--dwell", "0.3", "--trigger", "0", "--feed", "6000", "--approach-feed", "1500")
    run(folder, "sheet", "first", "--out", "auto", *words)
    name = next(n for n, s in plan.setups.items() if isinstance(s.sensor, BallBar))
    (file,) = (folder / "auto").glob(f"*-{name}.ngc")
    recorded, _ = _run_nominal(plan, file.read_text(), tmp_path, output=True, half_side=0.065)
    slides, output = recorded[:, :-1] * MM, recorded[:, -1]
    rising = np.flatnonzero(np.diff(output, prepend=0.0) > 0.5)
    sensor = plan.setups[name].sensor

    def shown(errors, slides):
        """Reading of the bar, by its definition."""
        balls = Machine(plan.robot, errors).forward(slides) - np.array(sensor.centre)
        return np.linalg.norm(balls, axis=1) - sensor.length

    exact = simulate_session(plan, errors, exact=True).session
    expected = [v for r, v in zip(exact.readings, exact.values, strict=True) if r.setup == name]
    assert shown(errors, slides[rising]) == pytest.approx(expected, abs=1e-6)
    # between the readings the bar stays on its sphere, from the first trigger to the last
    on_path = shown({}, slides[rising[0] : rising[-1] : 20])
    assert np.abs(on_path).max() < 20e-6


@pytest.mark.slow
def test_the_walk_ends_with_confirmed_offsets(machine):
    folder, plan, errors = machine
    measure(folder, "first", errors, SEED)
    assert "Enter these offsets" in run(folder, "calibrate", "first", "--out", "one")
    run(folder, "export", "one", "--to", "linuxcnc", "--offsets", "--out", "cnc")
    assert "HOME_OFFSET" in (folder / "cnc/joints.ini").read_text()
    run(folder, "again", "one", "--out", "second")
    measure(folder, "second", errors, SEED + 1)
    assert "onfirmed" in run(folder, "validate", "one", "second")
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
