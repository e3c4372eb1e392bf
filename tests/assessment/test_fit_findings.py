"""Findings about a fit: tolerances, bounds, linearisation, and rods that are read as lines."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from calibrated import UNJUDGED, identified, session_of
from gauges import with_gauges
from machines import place, reading_by_pinocchio

from orthocal import calibrate, load_plan, simulate_session
from orthocal.assessment.fit_findings import (
    BLADE,
    _above_tolerances,
    _line_model_error,
    _linearisation,
    _nominal_expansion,
    find_line_model_error,
)
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.session.session import Gauge
from orthocal.units import MM, PPM


@pytest.fixture(scope="module")
def calibration():
    return identified(session_of("raw-cycles"), "offsets")


def test_the_error_of_an_effect_is_compared_with_its_stated_value(calibration):
    robot = session_of("raw-cycles").with_effects(["backlash"]).robot
    stated = replace(
        calibration.free[0], name="x_slide.backlash", mean=0.2 * MM, prior_std=2e-3 * MM
    )

    def find(value_mm):
        return _above_tolerances(
            SimpleNamespace(robot=robot, free=[replace(stated, value=value_mm * MM)])
        )

    assert not find(0.2)
    assert not find(0.205)
    for value, sign in ((0.22, "+"), (0.18, "-")):
        (found,) = find(value)
        assert f"{sign}0.020 mm from its stated value, 5 times its tolerance" in found.text
        expected = {"value_mm": value, "tolerance_mm": 4e-3}
        assert found.numbers == pytest.approx(expected)
    (found,) = _above_tolerances(
        SimpleNamespace(robot=robot, free=[replace(stated, mean=0.0, value=0.02 * MM)])
    )
    assert "is estimated to be 0.020 mm, 5 times its tolerance" in found.text
    expansion = replace(stated, unit="1/K", mean=0.0, value=20 * PPM, prior_std=2 * PPM)
    (found,) = _above_tolerances(SimpleNamespace(robot=robot, free=[expansion]))
    assert "is estimated to be 20.000 ppm/K, 5 times" in found.text
    assert [*found.numbers] == ["value_ppm_per_K", "tolerance_ppm_per_K"]


def test_a_parameter_at_a_bound_does_not_hide_the_linearisation_error(calibration):
    first, second, third = (
        replace(p, value=1e-3, linear=1e-3 + change, std=std)
        for p, change, std in zip(
            calibration.free, (1e-3, 1e-5, 1e-3), (0.0, 1e-5, np.nan), strict=True
        )
    )
    solver = SimpleNamespace(shows_linearisation_error=True)
    (found,) = _linearisation(SimpleNamespace(solver=solver, free=[first, second, third]))
    assert found.places[0].parameter == second.name
    assert found.numbers == pytest.approx({"part_of_std": 1.0})
    assert not _linearisation(SimpleNamespace(solver=solver, free=[first, third]))


QUICK = {"solver": "variable-projection"}


def test_the_deviation_of_a_rod_from_its_line_is_that_by_pinocchio(raw_cycles):
    """Every error at a hundredth of its tolerance: differences of the two readings."""
    robot, setup = raw_cycles.robot, raw_cycles.setups["yx"]
    postures = [raw_cycles.postures[n] for n in ("zero", "x_min", "x_max")]
    zero, axis = postures[0], robot.legs["x"].axis

    def difference(machine, rod):
        found = []
        for posture in postures:
            root, tip = (place(machine, posture.drives, f) for f in (rod.root, rod.tip))
            at_zero = axis @ place(machine, zero.drives, "x_leg_root")
            plane = setup.sensor.plane(machine)[0] + at_zero
            on_rod = root + (plane - axis @ root) / (axis @ (tip - root)) * (tip - root)
            line = reading_by_pinocchio(raw_cycles, machine, setup, posture)
            found.append(on_rod[1] - line)
        return np.array(found) - np.mean(found)

    rods = robot.legs["x"].rods
    squares = np.zeros((len(rods), len(postures)))
    nominal = [difference(robot.with_errors({}), rod) for rod in rods.values()]
    for name in machine_errors(robot):
        machine = robot.with_errors({name: 0.01 * robot.parameters[name].prior_std})
        for k, rod in enumerate(rods.values()):
            squares[k] += ((difference(machine, rod) - nominal[k]) / 0.01) ** 2
    sizes = dict(zip(rods, np.sqrt(squares.max(axis=1)), strict=True))
    found = find_line_model_error(raw_cycles, {"": 1e-5})
    assert found.touches == max(sizes, key=lambda name: sizes[name])
    assert found.size == pytest.approx(sizes[found.touches], rel=1e-4)  # legs tie


def test_an_assumed_line_matters_for_the_gauge_that_reads_it(raw_cycles):
    """The coarse first gauge reads five setups, the fine one the sixth."""
    gauges = {"coarse": Gauge(0.2 * MM), "fine": Gauge(5e-6)}
    for names in (["coarse", "fine"], ["fine", "coarse"]):
        session = with_gauges(raw_cycles, {n: gauges[n] for n in names}, ["zy"])
        found = identified(session, "full")
        (assumed,) = _line_model_error(found)
        sigma = next(g.noise.sigma for g in found.gauges if g.name == "fine")
        assert assumed.numbers["sigma_mm"] == pytest.approx(sigma / MM)
        assert "zy" in assumed.text


def test_an_assumed_line_is_named_where_it_matters(root, raw_cycles):
    (assumed,) = calibrate(raw_cycles, "full", **UNJUDGED).assessment.of_kind("line assumed")
    found = find_line_model_error(raw_cycles, {"": 1e-5})
    assert assumed.numbers["off_line_mm"] == pytest.approx(found.size / MM)
    assert f"On rod {found.touches} the readings" in assumed.text
    assert f"`touches: {found.touches}`" in assumed.action
    coarse = raw_cycles.with_values(raw_cycles.values)
    coarse = coarse.with_gauge(type(coarse.gauge)(0.5 * MM, 0.01 * MM, None))
    assert not _line_model_error(identified(coarse))
    plan = load_plan(root / "examples/workshop/plan.yaml")
    on_rods = simulate_session(plan, {}, seed=0).session
    assert find_line_model_error(on_rods, {}) is None
    assert not _line_model_error(identified(on_rods, "offsets"))


def test_the_rod_that_deviates_most_is_reported():
    session = session_of("table1/experiment-2")
    sigmas = dict.fromkeys(session.gauges, 1e-5)
    found = find_line_model_error(session, sigmas)
    sizes = []
    for rod in ("a", "b"):
        setup = session.setups[found.setup]
        setups = {found.setup: replace(setup, sensor=setup.sensor.on_rod(rod, BLADE))}
        readings = [r for r in session.readings if r.setup == found.setup]
        part = session.select(readings)
        difference = _nominal_expansion(replace(part, setups=setups)) - _nominal_expansion(part)
        sizes.append(np.linalg.norm(difference, axis=1).max())
    assert found.size == pytest.approx(max(sizes))
    assert found.touches == "ab"[int(np.argmax(sizes))]
