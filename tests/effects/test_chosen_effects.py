"""Effects chosen by name: by the robot, a session or a calibration."""

from __future__ import annotations

import numpy as np
import pytest
from effect_plans import write_plan

from orthocal import (
    Choice,
    load_calibration,
    load_plan,
    load_session,
    restore_session,
    simulate_session,
    write_calibration,
    write_session,
)
from orthocal.calibration.identify import identify
from orthocal.effects.loading import load_robot, robot_effects, with_adjustments, with_effects
from orthocal.errors import ParameterError, RobotError, SessionError
from orthocal.measurement.joining import join_sessions

DECLARED = "screw: {lead_mm: 10}, backlash: {tolerance_mm: 0.06}"
QUICK = {"solver": "variable-projection"}


def names_of(robot):
    return [type(e).name for e in robot_effects(robot)][2:]


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    return load_plan(write_plan(tmp_path_factory.mktemp("machine") / "plan", effects=DECLARED))


@pytest.fixture(scope="module")
def session(plan):
    errors = {"x_slide.backlash": 40e-6, "y_slide.offset": 0.4e-3}
    return simulate_session(plan, errors, seed=2, sigma=1e-6).session


def test_a_machine_has_the_declared_or_the_chosen_effects(orthoglide, plan):
    assert names_of(plan.robot) == ["backlash", "screw"]  # always in the same order
    assert plan.robot.parameters["x_slide.backlash"].prior_std == 0.03e-3
    chosen = with_effects(orthoglide, ["thermal", "backlash", "thermal"])
    assert names_of(chosen) == ["backlash", "thermal"]
    assert "x_slide.backlash" in chosen.parameters
    assert "x_slide.backlash" not in orthoglide.parameters
    assert with_effects(chosen, None).parameters.names == orthoglide.parameters.names
    assert names_of(with_effects(plan.robot, [])) == []


def test_every_model_contains_the_errors_of_effects(plan):
    for model in plan.robot.parameters.models:
        selection = Choice(model).select(plan.robot.parameters)
        prior = dict(zip(selection.names, selection.prior.tolist(), strict=True))
        assert prior["y_slide.backlash"]
        assert prior["z_slide.screw_cos"]
        assert prior["x_slide.offset"] == (model != "offsets")
        without = Choice(model, free=["!*.backlash"]).select(plan.robot.parameters)
        assert "y_slide.backlash" not in without.names


def test_tolerances_stay_with_a_choice_of_effects(plan):
    stated = plan.robot.with_tolerances({"*.backlash_mm": 0.1})
    assert with_effects(stated, ["backlash"]).parameters["x_slide.backlash"].prior_std == 0.05e-3
    with pytest.raises(ParameterError, match="backlash"):
        with_effects(stated, ["thermal"])


def test_choices_of_effects_leave_loaded_robots_in_memory():
    robot = load_robot("orthoglide")
    for number in range(1, 11):
        with_effects(robot.with_tolerances({"*.offset_mm": number}), ["backlash"])
        with_adjustments(robot.with_tolerances({"*.offset_mm": number}))
    assert load_robot("orthoglide") is robot


def test_an_unknown_effect_and_a_missing_key_are_refused(orthoglide):
    with pytest.raises(ParameterError, match="'wobble'"):
        with_effects(orthoglide, ["wobble"])
    with pytest.raises(RobotError) as caught:
        with_effects(orthoglide, ["screw"])
    assert caught.value.where.endswith("orthocal.effects.screw.lead_mm")


def test_files_keep_the_chosen_effects(session, tmp_path):
    chosen = session.with_effects(["backlash"])
    write_session(chosen, tmp_path / "session")
    assert names_of(load_session(tmp_path / "session").robot) == ["backlash"]
    result, _ = identify(session, Choice("offsets", effects=["backlash"]), **QUICK)
    assert result["x_slide.backlash"].value == pytest.approx(40e-6, abs=6e-6)
    write_calibration(result, tmp_path / "calibration.json")
    again = restore_session(load_calibration(tmp_path / "calibration.json"))
    assert names_of(again.robot) == ["backlash"]
    assert "x_slide.screw_sin" not in again.robot.parameters
    path = write_session(session.with_effects([]), tmp_path / "none")
    assert "effects: []" in path.read_text()
    assert names_of(load_session(path).robot) == []


def test_joined_sessions_need_the_same_effects(session):
    other = session.with_effects(["backlash"])
    with pytest.raises(SessionError) as caught:
        join_sessions([other, session])
    assert caught.value.where.endswith("calibration.effects")
    plain = [s.with_effects([]) for s in (other, session)]
    assert names_of(join_sessions(plain).robot) == []
    result, _ = identify([other, session], Choice("offsets", effects=["backlash"]), **QUICK)
    stds = [p.std for p in result.free if p.name.endswith(".backlash")]
    assert (np.array(stds) < 12e-6).all()
