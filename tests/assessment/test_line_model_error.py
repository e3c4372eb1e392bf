"""How far a rod is from the line that is read, against Pinocchio's machines one error at a time."""

from __future__ import annotations

import numpy as np
import pytest
from calibrated import UNJUDGED, identified
from gauges import with_gauges
from machines import place, reading_by_pinocchio

from orthocal import calibrate, load_plan, simulate_session
from orthocal.assessment.fit_findings import _idealisation, find_idealised
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.session.session import Gauge
from orthocal.units import MM

QUICK = {"solver": "variable-projection"}


def test_the_deviation_of_a_rod_from_its_line_is_that_by_pinocchio(raw_cycles):
    """Every error at a tenth of its tolerance: central differences of the two readings."""
    robot, setup = raw_cycles.robot, raw_cycles.setups["yx"]
    zero, low = (raw_cycles.postures[n] for n in ("zero", "x_min"))
    rod, axis = robot.legs["x"].rods["a"], robot.legs["x"].axis

    def difference(machine):
        found = []
        for posture in (zero, low, raw_cycles.postures["x_max"]):
            root, tip = (place(machine, posture.drives, f) for f in (rod.root, rod.tip))
            at_zero = axis @ place(machine, zero.drives, "x_leg_root")
            plane = setup.sensor.plane(machine)[0] + at_zero
            on_rod = root + (plane - axis @ root) / (axis @ (tip - root)) * (tip - root)
            line = reading_by_pinocchio(raw_cycles, machine, setup, posture)
            found.append(on_rod[1] - line)
        return found[1] - np.mean(found)

    total = 0.0
    for name in machine_errors(robot):
        step = 0.1 * robot.parameters[name].prior_std
        plus, minus = (difference(robot.with_errors({name: s * step})) for s in (1.0, -1.0))
        total += ((plus - minus) / 0.2) ** 2
    found = find_idealised(raw_cycles, {"": 1e-5})
    assert (found.setup[0], found.touches) in {(leg, "a") for leg in "xyz"}  # they tie
    assert found.size == pytest.approx(np.sqrt(total), rel=1e-4)


def test_an_assumed_line_matters_for_the_gauge_that_reads_it(raw_cycles):
    """The coarse first gauge reads five setups, the fine one the sixth."""
    gauges = {"coarse": Gauge(0.2 * MM), "fine": Gauge(5e-6)}
    for names in (["coarse", "fine"], ["fine", "coarse"]):
        session = with_gauges(raw_cycles, {n: gauges[n] for n in names}, ["zy"])
        found = identified(session, "full")
        (assumed,) = _idealisation(found)
        sigma = next(g.noise.sigma for g in found.gauges if g.name == "fine")
        assert assumed.numbers["sigma_mm"] == pytest.approx(sigma / MM)
        assert "zy" in assumed.text


def test_an_assumed_line_is_named_where_it_matters(root, raw_cycles):
    (assumed,) = calibrate(raw_cycles, "full", **UNJUDGED).assessment.of_kind("line assumed")
    assert assumed.numbers["off_line_mm"] == pytest.approx(0.032, abs=1e-3)
    assert "`touches: a`" in assumed.action
    coarse = raw_cycles.with_values(raw_cycles.values)
    coarse = coarse.with_gauge(type(coarse.gauge)(0.1 * MM, 0.01 * MM, None))
    assert not calibrate(coarse, **UNJUDGED).assessment.of_kind("line assumed")
    plan = load_plan(root / "examples/workshop/plan.yaml")
    on_rods = simulate_session(plan, {}, seed=0).session
    assert find_idealised(on_rods, {}) is None
    assert not calibrate(on_rods, "offsets", **UNJUDGED).assessment.of_kind("line assumed")
