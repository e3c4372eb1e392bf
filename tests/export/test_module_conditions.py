"""Kinematics modules of machines that depend on temperature and payload, compiled and run."""

from __future__ import annotations

import ctypes
import re
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from calibrated import SOUND
from effect_plans import write_plan, write_robot
from independent import Expansion, IndependentMachine, States
from linuxcnc import few_nodes, require_linuxcnc, run_programs
from loaded_orthoglide import settle
from test_linuxcnc import SWITCH, Core, homes_of, joints_at_switch, joints_of, machine_of

from orthocal import (
    Choice,
    ExportOptions,
    ParameterError,
    UseConditions,
    calibrate,
    export_calibration,
    load_plan,
    load_robot,
    simulate_session,
)
from orthocal.calibration.calibration import Machine
from orthocal.effects.compliance import GRAVITY
from orthocal.export.linuxcnc import approximation as approximating
from orthocal.export.linuxcnc import instructions
from orthocal.export.linuxcnc.approximation import approximate, check_points
from orthocal.export.linuxcnc.c_source import write_component, write_core
from orthocal.export.linuxcnc.instructions import write_module_page
from orthocal.io.files import write_files

MM = 1e-3
JOINTS = {"y_slide": "{counts: down}", "z_slide": "{counts: down, at_zero_mm: 0}"}
WITHIN = 0.1e-6
"""Tolerance of the modules, [m]."""

SMALL = 0.03
"""Half the side of a region that a polynomial of a lower degree suffices for, [m]."""

CLOSED = 1e-11
"""Error of the independent machine's loops, [m]."""

TRUTH = {
    "x_slide.offset": 1.2 * MM,
    "y_slide.offset": -0.8 * MM,
    "y_leg.length": 60e-6,
    "z_coupler.rx": 1e-3,
    "legs.expansion": 2e-6,
    "screws.expansion": -1e-6,
}
SCREWS = {"x_slide.screw_sin": 9e-6, "y_slide.screw_cos": -7e-6, "z_slide.screw_sin": 4e-6}
THERMAL = "thermal: {reference_C: 22, screws_ppm: 9}"
TEMPERATURES = (7.0, 13.1, 22.0, 28.7, 37.0)
"""The module covers 15 K to both sides of the reference."""


def points_in_region(count, seed, *, half_side=0.06):
    return np.random.default_rng(seed).uniform(-half_side, half_side, (count, 3))


def drives_of(robot, joints):
    """Drive coordinates, [m], of LinuxCNC's joints, mm; no offset is active."""
    columns = zip(robot.drives, (joints * MM).T, strict=True)
    return np.stack([d.from_joint(j) for d, j in columns], axis=-1)


class ThermalCore(Core):
    """Core that depends on the temperature."""

    def at(self, temperature):
        self.library.orthocal_set_temperature(ctypes.c_double(temperature))
        return self


def build(tmp_path, known, *, periodic=False, within=WITHIN, half_side=0.06, **options):
    with few_nodes(degree=4 if half_side == SMALL else 6):
        approximation = approximate(known, within=within, half_side=half_side, **options)
    files = write_core(known, approximation, homes_of(known))
    return approximation, ThermalCore(tmp_path, files, periodic=periodic)


@pytest.fixture(scope="module", autouse=True)
def cheap_modules():
    with few_nodes(degree=6):
        yield


@pytest.fixture(scope="module")
def thermal(tmp_path_factory):
    """Machine with thermal expansion, its approximation and its core."""
    folder = tmp_path_factory.mktemp("thermal")
    known = machine_of(load_robot(write_robot(folder / "m", THERMAL, joints=JOINTS)), TRUTH)
    return known, *build(folder, known)


def test_core_equals_the_machine_at_every_temperature(thermal):
    """At points that were neither fitted nor checked."""
    known, approximation, core = thermal
    points = points_in_region(150, seed=4)
    largest = []
    for t in TEMPERATURES:
        drives = drives_of(known.robot, core.at(t).inverse(points / MM))
        reached = known.machine.forward(drives, conditions=UseConditions(temperature=t))
        largest.append(np.linalg.norm(reached - points, axis=1).max())
    assert max(largest) < approximation.achieved <= WITHIN
    # a module without the temperature
    drives = drives_of(known.robot, core.at(22.0).inverse(points / MM))
    reached = known.machine.forward(drives, conditions=UseConditions(temperature=37.0))
    error = np.linalg.norm(reached - points, axis=1).max()
    assert 20e-6 < error < approximation.error_without_thermometer < 1.5 * error


def test_core_reaches_points_on_an_independent_machine(tmp_path):
    folder = write_robot(tmp_path / "machine", f"{THERMAL}, screw: {{lead_mm: 5}}", joints=JOINTS)
    errors = TRUTH | SCREWS
    known = machine_of(load_robot(folder), errors)
    approximation, core = build(tmp_path, known, periodic=True, half_side=SMALL)
    expansion = Expansion(legs=11.5e-6, screws=9e-6, reference=22.0)
    machine = IndependentMachine(folder, errors, lead=5 * MM, expansion=expansion)
    points = points_in_region(25, seed=3, half_side=SMALL)
    for t in TEMPERATURES:
        drives = drives_of(known.robot, core.at(t).inverse(points / MM))
        states = States(drives, np.zeros_like(drives), np.full(len(drives), t))
        errors = np.linalg.norm(machine.tool(states)[0] - points, axis=1)
        assert errors.max() < approximation.achieved + CLOSED
        assert (
            np.abs(core.forward(core.inverse(points / MM), start=[0.0] * 3) * MM - points).max()
            < 1e-12
        )


def test_temperature_is_clamped_and_begins_at_the_reference(thermal, tmp_path):
    known, approximation, core = thermal
    point = [[30.0, -20.0, 10.0]]
    first = ThermalCore(tmp_path, write_core(known, approximation, homes_of(known))).inverse(point)
    change = approximation.inverse.thermal
    assert (change.reference, change.lowest, change.highest) == (22.0, 7.0, 37.0)
    for t, same in ((60.0, 37.0), (-40.0, 7.0), (float("nan"), 22.0), (float("inf"), 37.0)):
        assert np.array_equal(core.at(t).inverse(point), core.at(same).inverse(point))
    assert np.array_equal(core.at(22.0).inverse(point), first)
    assert np.abs(core.at(37.0).inverse(point) - first).max() > 0.01


def test_range_of_use_widens_that_of_the_module(tmp_path):
    folder = write_robot(tmp_path / "m", THERMAL)
    text = (folder / "machine.yaml").read_text()
    (folder / "machine.yaml").write_text(
        text.replace("\n  tcp: ", "\n  use: {temperature_C: [10, 45]}\n  tcp: ")
    )
    change = approximate(
        machine_of(load_robot(folder), {}), within=1e-6, half_side=SMALL
    ).inverse.thermal
    assert (change.lowest, change.highest) == (7.0, 45.0)


SOFT = "compliance: {rod_N_per_um: 1, platform_kg: 5}"


def test_module_corrects_the_deflection_by_a_payload(tmp_path, monkeypatch):
    """At rest the energy of springs and weight is least. Few checks state a smaller error."""
    monkeypatch.setattr(approximating, "check_points", partial(check_points, count=50))
    known = machine_of(load_robot(write_robot(tmp_path / "m", SOFT)), {})
    approximation, core = build(tmp_path, known, payload=3.0, within=1e-6, half_side=SMALL)
    assert approximation.payload == 3.0
    weight = np.array([0.0, 0.0, -(5.0 + 3.0) * GRAVITY])
    points = points_in_region(1, seed=5, half_side=SMALL)
    for point, drives in zip(
        points, drives_of(known.robot, core.inverse(points / MM)), strict=True
    ):
        tool, _ = settle(drives, stiffness=1e6, weight=weight)
        assert np.linalg.norm(tool - point) < approximation.achieved + SECOND_ORDER
        heavier, _ = settle(drives, stiffness=1e6, weight=weight * 9.0 / 8.0)
        error = np.linalg.norm(heavier - point)
        assert 1e-6 < error < approximation.error_of_heavier_payload < 5.0 * error


SECOND_ORDER = 50e-9
"""Forces of the loaded machine differ from those of the nominal one by 1e-3, [m]."""


def test_page_states_temperature_and_payload(thermal, monkeypatch):
    monkeypatch.setattr(instructions, "_describe_remaining", lambda *_: "")  # of an assessment
    known, approximation, _ = thermal
    known = SimpleNamespace(**vars(known), only_offsets=False)
    loaded = replace(approximation, payload=0.5, error_of_heavier_payload=1.2e-6)
    page = write_module_page(known, loaded, homes_of(known), own_limits=False)
    assert "`orthocal.temperature`" in page
    assert "From 7 to 37 °C" in page
    assert "for 0.5 kg on the tool" in page
    assert "1 kg more the\nerror is up to 1.2 µm" in page
    unheated = float(re.search(r"Without a thermometer .* up to ([\d.]+) mm", page)[1])
    assert unheated * MM == pytest.approx(approximation.error_without_thermometer, rel=0.1)
    assert "hal_pin_float_newf" in write_component(approximation)["orthocal_kins.c"]


def test_module_without_thermal_expansion_has_no_pin(tmp_path):
    known = machine_of(load_robot("orthoglide"), {})
    approximation = approximate(known, within=1e-6, half_side=SMALL)
    files = write_core(known, approximation, homes_of(known))
    assert "#define ORTHOCAL_THERMAL 0\n" in files["orthocal_core.h"]
    assert (
        approximation.error_without_thermometer
        is approximation.payload
        is approximation.error_of_heavier_payload
        is None
    )
    with pytest.raises(ParameterError) as caught:
        approximate(known, within=1e-6, payload=1.0)
    assert caught.value.where == "--payload"


@pytest.mark.parametrize("payload", [-1.0, float("nan"), 1e9])
def test_bad_payloads_are_refused(tmp_path, payload):
    known = machine_of(load_robot(write_robot(tmp_path / "m", SOFT)), {})
    with pytest.raises(ParameterError) as caught:
        approximate(known, within=1e-6, half_side=SMALL, payload=payload)
    assert caught.value.where == "--payload"


# ---- LinuxCNC itself

FOLLOWED = 0.2e-6
"""Tolerance of points at rest, [m]: 0.1 µm of the module, and homing of three drives."""


@pytest.mark.acceptance
def test_joints_follow_the_pin_in_linuxcnc(tmp_path):
    """The pin changes while the machine is at rest at two points."""
    require_linuxcnc()
    plan = load_plan(write_plan(tmp_path / "plan", effects=THERMAL, joints=JOINTS))
    truth = {k: v for k, v in TRUTH.items() if k.endswith((".offset", ".expansion"))}
    session = simulate_session(
        plan.with_controller(np.array([0.4, -0.1, 0.2]) * MM), truth, exact=True
    )
    result = calibrate(
        session.session, Choice("offsets"), solver="variable-projection", judgement=SOUND
    )
    options = ExportOptions(module=True, within=WITHIN)
    files = export_calibration(result, "linuxcnc", anyway=True, options=options)
    write_files(tmp_path, files)
    points = np.array([[25.0, -30.0, 15.0], [-40.0, 10.0, -35.0]])
    words = [" ".join(f"{c}{v:g}" for c, v in zip("XYZ", p, strict=True)) for p in points]
    rest = ["M0", "G4 P0.3"]
    lines = [f"G21 G90 G61 F6000 G1 {words[0]}", *rest * 3, f"G1 {words[1]}", *rest * 2, "M2"]
    steps = [(0, 22.0, ""), (0, 31.0, "31"), (0, 37.0, "80"), (1, 37.0, ""), (1, 12.5, "12.5")]
    halcmd = [f"setp orthocal.temperature {t}" if t else "" for *_, t in steps]
    _, pauses = run_programs(
        [(lines[:1], lines)],
        joints_of(result, joints_at_switch(result, SWITCH)),
        lines=files["kinematics.ini"],
        module=tmp_path,
        halcmd=halcmd,
    )
    active = result.active_offsets
    for (at, temperature, _), joints in zip(steps, pauses[0], strict=True):
        columns = zip(result.robot.drives, joints * MM, active, strict=True)
        drives = np.array([d.from_joint(j) - a for d, j, a in columns])
        machine = Machine(result.robot, result.errors)
        tool = machine.forward(drives, conditions=UseConditions(temperature=temperature))
        assert np.linalg.norm(tool - points[at] * MM) < FOLLOWED
    assert np.abs(pauses[0][1] - pauses[0][0]).max() > 0.01
