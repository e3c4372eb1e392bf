"""Compliance of the rods under platform and payload: forces, closures, readings, files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from derivatives import assert_derivative, assert_jacobian
from effect_plans import write_plan, write_robot
from loaded_orthoglide import settle
from tolerances import CLOSED, KINEMATICS

from orthocal import (
    Choice,
    load_calibration,
    load_plan,
    load_robot,
    load_session,
    restore_session,
    simulate_session,
    write_calibration,
    write_session,
)
from orthocal.calibration.identify import identify
from orthocal.errors import ClosureError, RobotError, SessionError
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.estimation.solvers.variable_projection import VariableProjection
from orthocal.kinematics import loop_closure
from orthocal.kinematics.conditions import UseConditions
from orthocal.kinematics.loop_closure import LoopClosure, find_loads, nominal_closure
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.measurement.joining import join_sessions
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import build_observations

SOFT = "compliance: {rod_N_per_um: 1, platform_kg: 5}"
G = 9.80665
QUICK = {"solver": "variable-projection"}
FREE = ("*.offset", "*.scale", "x_coupler.rx")

LINEAR = 1e-3
"""Relative difference of forces of the unloaded and the loaded machine: rods change by 1e-4."""

POSTURES = [(0.0, 0.0, 0.0), (0.02, -0.03, 0.04), (-0.08, 0.03, 0.05)]


@pytest.fixture(scope="module")
def soft(tmp_path_factory):
    return load_robot(write_robot(tmp_path_factory.mktemp("soft") / "machine", SOFT))


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    folder = write_plan(tmp_path_factory.mktemp("soft") / "plan", effects=SOFT)
    text = (folder / "session.yaml").read_text()
    (folder / "session.yaml").write_text(f"payload_kg: 2\n{text}")
    return load_plan(folder)


# ---- statics


def test_the_loaded_machine_has_the_least_energy(soft):
    drives = soft.drive_zero + POSTURES[2]
    tool, changes = settle(drives, stiffness=1e6, weight=np.array([0.0, 0.0, -7.0 * G]))
    loads = find_loads(soft, drives[None], 2.0)[0]
    assert np.abs(loads / 1e6 - changes).max() < LINEAR * np.abs(changes).max()
    moved = LoopClosure(soft, conditions=UseConditions(payload=2.0)).forward(drives)
    sag = tool - nominal_closure(soft).forward(drives)
    assert np.abs(moved - tool).max() < LINEAR * np.abs(sag).max()
    assert sag[2] < -30e-6


def test_in_the_mechanical_zero_two_rods_carry_the_weight(soft):
    loads = find_loads(soft, soft.drive_zero[None], 0.0)[0]
    assert loads == pytest.approx([0.0, 0.0, 0.0, 0.0, 2.5 * G, 2.5 * G], abs=1e-9)


def test_steel_rods_shorten_by_less_than_half_a_micrometre_under_five_kilograms(tmp_path):
    keys = "compliance: {rod_N_per_um: 64, platform_kg: 5}"
    robot = load_robot(write_robot(tmp_path / "machine", keys))
    moved = LoopClosure(robot, conditions=UseConditions()).forward(robot.drive_zero)
    assert moved == pytest.approx([0.0, 0.0, -2.5 * G / 64e6], abs=1e-9)
    assert f"{-moved[2] * 1e6:.1f}" == "0.4"
    # the nominal kinematics of the controller have no load
    assert np.abs(nominal_closure(robot).forward(robot.drive_zero)).max() < CLOSED


def test_gravity_has_a_direction(tmp_path):
    keys = "compliance: {rod_N_per_um: 1, platform_kg: 5, down: [0, 3, 0]}"
    robot = load_robot(write_robot(tmp_path / "machine", keys))
    loads = find_loads(robot, robot.drive_zero[None], 0.0)[0]
    assert loads == pytest.approx([0.0, 0.0, -2.5 * G, -2.5 * G, 0.0, 0.0], abs=1e-9)


def test_the_inverse_under_load_returns_the_drives(soft):
    drives = soft.drive_zero + np.array(POSTURES)
    errors = {"x_slide.offset": 2e-3, "y_coupler.rx": 2e-3}
    closure = LoopClosure(soft, fixed=errors, conditions=UseConditions(payload=200.0))
    tool = closure.forward(drives)
    assert np.abs(tool - LoopClosure(soft, fixed=errors).forward(drives)).max() > 1e-4
    assert np.abs(closure.inverse(tool) - drives).max() < CLOSED
    failures = {}
    beyond = np.vstack([tool, [[9.0, 0.0, 0.0]]])
    back = closure.inverse(beyond, failures=failures)
    assert list(failures) == [3]
    assert np.abs(back[:3] - drives).max() < CLOSED


def test_loads_that_do_not_converge_are_refused(soft, monkeypatch):
    monkeypatch.setattr(loop_closure, "MAX_ITERATIONS", 1)
    closure, failures = LoopClosure(soft, conditions=UseConditions()), {}
    with pytest.raises(ClosureError, match=r"posture 'posture 1' .* do not converge"):
        closure.inverse(POSTURES)
    drives = closure.inverse([*POSTURES, (1.0, 1.0, 1.0)], failures=failures)
    assert sorted(failures) == [0, 1, 2, 3]
    assert np.isnan(drives).all()
    assert "cannot be reached" in str(failures[3])


def test_the_tool_under_conditions_follows_its_derivatives(tmp_path):
    keys = f"{SOFT}, backlash: {{}}, thermal: {{}}"
    robot = load_robot(write_robot(tmp_path / "machine", keys))
    free = ("x_slide.backlash", "legs.expansion", "screws.expansion", "z_slide.scale")
    free += ("x_coupler.rx", "y_bar_a.z")
    at = {"x_slide.backlash": 3e-5, "legs.expansion": 1e-6, "x_coupler.rx": 1e-3}
    use = UseConditions("pun", 31.0, 3.0)
    drives = robot.drive_zero + np.array(POSTURES)
    by = ToolSensitivity(robot, free=free, values=at, conditions=use)(drives)
    closure = LoopClosure(robot, free=free, fixed=at, conditions=use)
    start = np.array([at.get(n, 0.0) for n in free])
    for k in range(len(drives)):
        assert_derivative(by[k], lambda t, d=drives[k]: closure.forward(d, theta=t), start)
    # half of a backlash; where the legs lean, a drive moves the tool by a little more or less
    assert np.abs(by[0, :, 0]).max() == pytest.approx(0.5, rel=1e-2)


# ---- readings


def test_readings_are_those_of_a_machine_with_other_rods(plan, orthoglide):
    """Errors of geometry change the rods by the same lengths in each posture."""
    o = build_observations(plan)
    found = predict_readings(plan)
    plain = replace(plan, robot=orthoglide)
    assert np.abs(found - predict_readings(plain)).max() > 5e-6
    loads = find_loads(orthoglide, o.states.commands[:, :3], 0.0)
    assert not loads.any()  # a machine without weight
    loads = find_loads(plan.robot, o.states.commands[:, :3], 2.0)
    assert np.array_equal(o.states.commands[:, 3:], loads)
    names = [name for k in "xyz" for name in (f"{k}_coupler.x", f"frame.{k}_rod_b_tip.x")]
    for k in np.unique(o.state):
        lengths = dict(zip(names, loads[k] / 1e6, strict=True))
        other = predict_readings(plain, lengths)
        here = o.state == k
        assert np.abs(found[here] - other[here]).max() < CLOSED


def test_the_payload_of_a_setup_changes_only_its_readings(plan):
    name = next(iter(plan.setups))
    setups = {**plan.setups, name: replace(plan.setups[name], payload=8.0)}
    moved = predict_readings(replace(plan, setups=setups)) - predict_readings(plan)
    of_setup = build_observations(plan).setup == 0
    assert np.abs(moved[of_setup]).max() > 1e-6
    assert not moved[~of_setup].any()


def test_the_jacobian_is_exact_and_solvers_agree(plan):
    session = simulate_session(plan, {"x_slide.offset": 4e-4}, seed=3, sigma=1e-6).session
    problem = build_problem(session, free=FREE, prior=True)
    theta = 0.3 * problem.theta_scale * np.random.default_rng(1).normal(size=problem.n_free)
    theta[:3] *= 0.1
    _, jacobian = problem.predict_and_jacobian(theta)
    assert_jacobian(problem, theta, jacobian)
    one, other = (P(problem).solve(sigma=1e-6) for P in (VariableProjection, NonlinearProgram))
    assert (np.abs(one.theta - other.theta) / problem.theta_scale).max() < 1e-5
    assert one.objective == pytest.approx(other.objective, rel=1e-9)


def test_identified_offsets_do_not_absorb_the_sag(plan):
    """Readings of a loaded machine, calibrated with and without load."""
    truth = {f"{k}_slide.offset": v for k, v in zip("xyz", (4e-4, -3e-4, 2e-4), strict=True)}
    session = simulate_session(plan, truth, seed=3, sigma=0.05e-6).session
    ignoring = session.with_effects([])
    choice = Choice("offsets", prior=True)
    results = [identify(s, choice, **QUICK)[0] for s in (session, ignoring)]
    off, absorbed = (max(abs(r[n].value - v) / r[n].std for n, v in truth.items()) for r in results)
    assert off < 4.0
    assert max(abs(results[1][n].value - v) for n, v in truth.items()) > 5e-6
    assert absorbed > off


# ---- files


def test_files_keep_the_payload(plan, tmp_path):
    session = simulate_session(plan, {}, seed=1, sigma=1e-6).session
    write_session(session, tmp_path / "session", decimals=12)
    again = load_session(tmp_path / "session")
    assert {s.payload for s in again.setups.values()} == {2.0}
    assert np.abs(predict_readings(again) - predict_readings(session)).max() < KINEMATICS
    lighter = replace(
        session, setups={n: replace(s, payload=0.5) for n, s in session.setups.items()}
    )
    joined = join_sessions([session, lighter])
    assert {s.payload for s in joined.setups.values()} == {2.0, 0.5}
    with pytest.raises(SessionError, match=r"0\.5, 2 kg"):
        write_session(joined, tmp_path / "joined")
    result, _ = identify([session, lighter], "offsets", **QUICK)
    write_calibration(result, tmp_path / "calibration.json")
    restored = restore_session(load_calibration(tmp_path / "calibration.json"))
    assert [s.payload for s in restored.setups.values()] == [
        s.payload for s in joined.setups.values()
    ]


@pytest.mark.parametrize("payload", ["-1", "20000", "heavy", ".nan"])
def test_an_impossible_payload_is_refused(plan, tmp_path, payload):
    write_session(simulate_session(plan, {}, seed=1).session, tmp_path)
    text = (tmp_path / "session.yaml").read_text()
    (tmp_path / "session.yaml").write_text(text.replace("payload_kg: 2", f"payload_kg: {payload}"))
    with pytest.raises(SessionError) as caught:
        load_session(tmp_path)
    assert caught.value.where.endswith("payload_kg")


@pytest.mark.parametrize(
    ("keys", "where"),
    [
        ("{}", "rod_N_per_um"),
        ("{rod_N_per_um: 0}", "rod_N_per_um"),
        ("{rod_N_per_um: 60, platform_kg: -1}", "platform_kg"),
        ("{rod_N_per_um: 60, down: [0, 0, 0]}", "down"),
        ("{rod_N_per_um: 60, down: [0, 1]}", "down"),
    ],
)
def test_invalid_keys_are_refused(tmp_path, keys, where):
    with pytest.raises(RobotError) as caught:
        load_robot(write_robot(tmp_path / "machine", f"compliance: {keys}"))
    assert caught.value.where.split("compliance.")[1].startswith(where)


def test_a_robot_without_rods_is_refused(tmp_path):
    folder = write_robot(tmp_path / "machine", "compliance: {rod_N_per_um: 60}")
    text = (folder / "machine.yaml").read_text()
    for _ in "xyz":
        start = text.find("      rods:\n")
        end = start + len("\n".join(text[start:].splitlines()[:3])) + 1
        text = text[:start] + text[end:]
    (folder / "machine.yaml").write_text(text)
    with pytest.raises(RobotError, match="rods"):
        load_robot(folder)
