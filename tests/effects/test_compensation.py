"""Readings under a controller that compensates backlash and errors of screws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_plans import FEW, write_plan
from gauges import exact
from independent import States
from test_independent import Measured, draw
from tolerances import KINEMATICS

from orthocal import (
    SessionError,
    join_sessions,
    load_calibration,
    load_plan,
    load_session,
    restore_session,
    simulate_session,
    write_calibration,
    write_session,
)
from orthocal.assessment.controller_entries import find_entries
from orthocal.assessment.predictive import judge_deviations
from orthocal.calibration.identify import identify
from orthocal.calibration.refit import repeat_fit
from orthocal.measurement.recording import _is_outdated
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import drive_table
from orthocal.statistics.chance import BY_CHANCE

MM = 1e-3
QUICK = {"solver": "variable-projection"}
EFFECTS = "backlash: {}, thermal: {}, screw: {lead_mm: 5}"
JOINTS = {"y_slide": "{counts: down}", "z_slide": "{counts: down, at_zero_mm: 0}"}
ACTIVE = [0.4, -0.1, 0.2]
BACKLASH = [0.03, 0.05, 0.02]
DOWN = [False, True, True]
SHOWN_AT_ZERO = [310.25, 310.25, 0.0]


def trims_of(number, count=200):
    """Lines of the table of a joint, [mm]."""
    wave = np.random.default_rng(number)
    places = np.linspace(-200.0, 560.0, count)
    both = wave.normal(scale=0.01, size=(count, 2)) + np.array([0.01, -0.01])
    return np.column_stack([places, both])


def write_tables(folder, numbers):
    for i in numbers:
        text = "\n".join(f"{p:.6f} {f:.6f}\t{r:.6f}" for p, f, r in trims_of(i))
        (folder / f"trims{i}.comp").write_text(text + "\n\n")


def state_controller(folder, controller):
    file = folder / "session.yaml"
    file.write_text(file.read_text().replace("setups:", f"controller: {controller}\nsetups:"))


@pytest.fixture(scope="module")
def compensated(tmp_path_factory):
    """Plan under a controller that compensates backlash of y, and x and z by tables."""
    folder = write_plan(tmp_path_factory.mktemp("c") / "plan", effects=EFFECTS, joints=JOINTS)
    write_tables(folder, [0, 2])
    state_controller(
        folder,
        f"{{offsets_mm: {ACTIVE}, backlash_mm: {BACKLASH}, "
        "comp_file: [trims0.comp, null, trims2.comp]}",
    )
    return folder


def displaced(session, approach):
    """Drive coordinates to which LinuxCNC moves, shape (n, 3), [m]."""
    result = []
    for drives, sides in zip(drive_table(session), approach, strict=True):
        row = []
        for i, (drive, side) in enumerate(zip(drives / MM, sides, strict=True)):
            way = -1.0 if DOWN[i] else 1.0
            joint = SHOWN_AT_ZERO[i] + way * (drive + ACTIVE[i] - 310.25)
            grew = way * side > 0
            if i == 1:
                trim = BACKLASH[i] / 2.0 if grew else -BACKLASH[i] / 2.0
            else:
                table = trims_of(i)
                after = next(k for k in range(len(table)) if table[k, 0] >= joint)
                before, column = after - 1, 1 if grew else 2
                part = (joint - table[before, 0]) / (table[after, 0] - table[before, 0])
                a, b = table[before, column], table[after, column]
                trim = round(a, 6) + part * (round(b, 6) - round(a, 6))
            row.append((drive + way * trim) * MM)
        result.append(row)
    return np.array(result)


def read_independently(folder, session, errors):
    measured = Measured(folder, session)
    o = measured.observations
    at = split_postures(session, o)
    states = States(
        displaced(at, o.conditions["approach"]),
        o.conditions["approach"],
        measured.states.temperature,
    )
    return measured.read(errors, states=states)[0]


def split_postures(session, observations):
    """Session with a separate posture for each entry."""
    postures = list(session.postures.values())
    rows = {str(i): postures[k] for i, k in enumerate(observations.posture)}
    return replace(session, postures=rows)


def test_readings_are_those_of_the_independent_machine(compensated):
    plan = exact(load_plan(compensated))
    errors = draw(plan, 1)
    shown = read_independently(compensated, plan, errors)
    assert np.abs(shown - predict_readings(plan, errors)).max() < 2e-9  # files have 1e-6 mm
    without = predict_readings(replace(plan, compensation=()), errors)
    assert np.abs(shown - without).max() > 3e-6


def test_joined_sessions_keep_their_controllers(compensated):
    plan = exact(load_plan(compensated))
    before = replace(plan, compensation=())
    errors = draw(plan, 5)
    both = predict_readings(join_sessions([before, plan]), errors)
    apart = [predict_readings(s, errors) for s in (before, plan)]
    assert np.abs(both - np.concatenate(apart)).max() < KINEMATICS
    assert np.abs(both - predict_readings(join_sessions([plan, plan]), errors)).max() > 1e-6


def test_the_total_backlash_is_identified_under_a_controller_that_compensates(compensated):
    plan = load_plan(compensated)
    truth = {f"{d}_slide.backlash": b * MM for d, b in zip("xyz", (0.05, 0.04, 0.03), strict=True)}
    session = simulate_session(plan, truth, seed=2, sigma=0.3e-6).session
    result, _ = identify(session, **QUICK)
    for p in result.free:
        if p.name in truth:
            assert abs(p.value - truth[p.name]) < 3.0 * p.std
            assert p.std < 4e-6


def test_files_keep_the_compensation(compensated, tmp_path):
    plan = load_plan(compensated)
    session = simulate_session(plan, {"x_slide.offset": 0.2 * MM}, seed=1).session
    write_session(session, tmp_path / "written")
    again = load_session(tmp_path / "written")
    assert not _is_outdated(again)  # a recording reads the files once
    result, _ = identify(again, "offsets", **QUICK)
    write_calibration(result, tmp_path / "calibration.json")
    restored = restore_session(load_calibration(tmp_path / "calibration.json"))
    for other in (again, restored):
        for one, two in zip(plan.compensation, other.compensation, strict=True):
            assert one.backlash == pytest.approx(two.backlash, rel=1e-12)
            assert (one.table is None) == (two.table is None)
            if one.table is not None:
                assert np.abs(one.table - two.table).max() < 1e-12
    read = np.abs(predict_readings(again, {}) - predict_readings(restored, {}))
    assert read.max() < KINEMATICS


def test_compensation_of_effects_that_the_model_lacks_is_ignored(compensated):
    plan = exact(load_plan(compensated)).with_effects(())
    plain = predict_readings(replace(plan, compensation=()), {})
    assert np.array_equal(predict_readings(plan, {}), plain)
    sided = plan.with_effects(["backlash"])
    moved = predict_readings(sided, {}) - plain
    opposite, other_side = [], str.maketrans("pn", "np")
    for r in sided.readings:
        approach = r.conditions.approach.translate(other_side)
        opposite.append(replace(r, conditions=replace(r.conditions, approach=approach)))
    turned = predict_readings(replace(sided, readings=tuple(opposite)), {}) - plain
    assert np.abs(moved).max() > 1e-6
    assert np.abs(moved + turned).max() < 0.05 * np.abs(moved).max()


def test_validation_expects_the_stated_compensation(compensated):
    plan = load_plan(compensated).with_effects(["backlash"])
    plan = plan.select([r for r in plan.readings if r.setup in FEW])
    first = replace(plan, compensation=())
    truth = {f"{d}_slide.backlash": 0.04 * MM for d in "xyz"}
    result, _ = identify(simulate_session(first, truth, seed=3).session, "offsets", **QUICK)
    entered = plan.with_controller([e.enter for e in find_entries(result)])
    measured = simulate_session(entered, truth, seed=4).session
    unstated = replace(measured, compensation=())
    stated, wrong = (
        judge_deviations(result, repeat_fit(result, s)).p_value for s in (measured, unstated)
    )
    assert stated > BY_CHANCE > wrong


@pytest.mark.parametrize(
    ("controller", "where"),
    [
        ("{backlash_mm: [0.03, 0.02]}", "controller.backlash_mm"),
        ("{backlash_deg: [0.1, 0.1, 0.1]}", "controller.backlash_deg"),
        ("{backlash_mm: [0.03, -0.02, 0]}", "controller.backlash_mm"),
        ("{comp_file: [trims0.comp]}", "controller.comp_file"),
        ("{comp_file: [missing.comp, null, null]}", "missing.comp"),
        ("{comp_file: [two.comp, null, null]}", "two.comp:2"),
        ("{comp_file: [falling.comp, null, null]}", "falling.comp:2"),
        ("{comp_file: [positions.comp, null, null]}", "positions.comp:1"),
        ("{comp_file: [one.comp, null, null]}", "one.comp"),
        ("{}", "controller"),
    ],
)
def test_bad_controllers_are_refused(tmp_path, controller, where):
    folder = write_plan(tmp_path / "plan", effects=EFFECTS)
    write_tables(folder, [0])
    for name, text in {
        "two.comp": "0 0 0\n1 0\n",
        "falling.comp": "1 0 0\n0 0 0\n",
        "positions.comp": "100 100.01 99.99\n200 200 200\n",
        "one.comp": "1 0 0\n",
    }.items():
        (folder / name).write_text(text)
    state_controller(folder, controller)
    with pytest.raises(SessionError) as caught:
        load_plan(folder)
    assert caught.value.where.endswith(where) or f"{where}[" in caught.value.where


def test_backlash_alone_states_no_offsets(tmp_path):
    folder = write_plan(tmp_path / "plan", effects=EFFECTS)
    state_controller(folder, "{backlash_mm: [0.03, 0.02, 0]}")
    plan = load_plan(folder)
    assert plan.controller_offsets is None
    assert [t.backlash for t in plan.compensation] == pytest.approx([3e-5, 2e-5, 0.0])
