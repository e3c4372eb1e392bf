"""What a session says of its calibration: a model and tolerances, where nothing else is said."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from orthocal import Choice, ParameterError, SessionError, calibrate, load_calibration
from orthocal.calibration.file import write_calibration
from orthocal.calibration.refit import repeat_calibration, restore_session
from orthocal.cli.options import state_tolerances
from orthocal.estimation.choice import resolve_choice
from orthocal.measurement.files.session_file import load_session
from orthocal.measurement.files.write_session import session_document, write_session
from orthocal.measurement.joining import join_sessions
from orthocal.session.session import Purpose
from orthocal.study.sensitivity import build_sensitivity_study

TOLERANCES = {"*_fork.rx_mrad": 6.0, "*_swivel.rx_mrad": 4.0, "*.offset_mm": 0.8}
FORK = "x_fork.rx"


def say(session, folder, **said):
    """The session from a folder where its file says this of its calibration."""
    told = replace(session, purpose=Purpose(said.get("model"), tuple(said.get("free", ()))))
    return load_session(write_session(told.with_tolerances(said.get("tolerances", {})), folder))


@pytest.fixture(scope="module")
def stated(raw_cycles, tmp_path_factory):
    return say(raw_cycles, tmp_path_factory.mktemp("full"), model="full", tolerances=TOLERANCES)


def test_what_a_session_says_is_what_options_would(raw_cycles, stated):
    assert stated.purpose == Purpose("full")
    found, expected = (
        calibrate(stated, solver="variable-projection"),
        calibrate(raw_cycles, Choice("full", tolerances=TOLERANCES), solver="variable-projection"),
    )
    assert found.model == expected.model == "full"
    assert [p.prior_std for p in found.free] == [p.prior_std for p in expected.free]
    assert [(p.value, p.std) for p in found.free] == [(p.value, p.std) for p in expected.free]


def test_tolerances_hold_for_what_is_left_out(raw_cycles, stated):
    own, told = (
        calibrate(s, "offsets", solver="variable-projection") for s in (raw_cycles, stated)
    )
    np.testing.assert_allclose(*([p.value for p in c.free] for c in (own, told)), atol=1e-12)
    index = own.unmodelled.names.index(FORK)
    assert own.unmodelled.prior_stds[index] == 1e-3
    assert told.unmodelled.prior_stds[index] == pytest.approx(3e-3)
    assert told.unmodelled.residual_rms > own.unmodelled.residual_rms


def test_a_calibration_keeps_them(stated, tmp_path):
    first = calibrate(stated, solver="variable-projection")
    again = load_calibration(write_calibration(first, tmp_path / "calibration.json"))
    assert again.robot.parameters[FORK].prior_std == pytest.approx(3e-3)
    repeated = repeat_calibration(again, restore_session(again))
    np.testing.assert_allclose(
        [p.value for p in repeated.free], [p.value for p in first.free], atol=1e-12
    )


def test_options_come_before_what_a_session_says(stated):
    parameters = stated.robot.parameters
    assert resolve_choice("offsets", stated).model == "offsets"
    assert resolve_choice(Choice(free=["*.offset"]), stated).model is None
    only_known = resolve_choice(Choice(known={"x_leg.length_mm": 0.1}), stated)
    assert (only_known.model, dict(only_known.known)) == ("full", {"x_leg.length_mm": 0.1})
    narrower = resolve_choice(Choice(tolerances={"x_fork.rx_mrad": 1.0}), stated).select(parameters)
    sizes = {p.name: p.prior_std for p in narrower.parameters}
    assert sizes[FORK] == pytest.approx(0.5e-3)
    assert sizes["y_fork.rx"] == pytest.approx(3e-3)


def test_where_nothing_is_said(raw_cycles, stated):
    silent = replace(raw_cycles, purpose=None).with_tolerances(TOLERANCES)
    assert resolve_choice(None, raw_cycles).model == "offsets"  # as it states
    assert resolve_choice(None, silent).model == "full"
    assert resolve_choice(None, silent, default_model="lengths").model == "lengths"
    assert resolve_choice(None, None, default_model="full").model == "full"
    assert resolve_choice(None, stated, default_model="lengths").model == "full"


def test_globs_instead_of_a_model(raw_cycles, tmp_path):
    session = say(raw_cycles, tmp_path, free=["*.offset", "!x_slide.offset"])
    assert [p.name for p in calibrate(session, solver="variable-projection").free] == [
        "y_slide.offset",
        "z_slide.offset",
    ]


def test_sessions_agree_or_are_asked(raw_cycles, stated, tmp_path):
    also = say(raw_cycles, tmp_path / "also", model="full", tolerances=TOLERANCES)
    joined = join_sessions([stated, also])
    assert joined.purpose == Purpose("full")
    assert joined.robot.parameters.stated == TOLERANCES
    offsets = say(raw_cycles, tmp_path / "offsets", model="offsets", tolerances=TOLERANCES)
    joined = join_sessions([stated, offsets])
    with pytest.raises(ParameterError) as e:
        resolve_choice(None, joined)
    assert str(e.value) == (
        f"model: sessions are for different models: full in {stated.path}; offsets in "
        f"{offsets.path}; choose one"
    )
    assert resolve_choice("full", joined).model == "full"
    silent = replace(raw_cycles, purpose=None).with_tolerances(TOLERANCES)
    assert resolve_choice(None, join_sessions([stated, silent])).model == "full"


@pytest.mark.parametrize(
    "tolerances",
    [
        {"*.offset_mm": 4.0},
        {},  # those of the robot
        {**TOLERANCES, "x_slide.offset_mm": 4.0},  # another key, the same error
    ],
)
def test_one_machine_has_one_tolerance(raw_cycles, stated, tmp_path, tolerances):
    other = say(raw_cycles, tmp_path, model="full", tolerances=tolerances)
    for pair in ([stated, other], [other, stated]):
        with pytest.raises(SessionError) as e:
            join_sessions(pair)
        assert e.value.where == f"{pair[1].path}: calibration.tolerances"
        assert str(pair[0].path) in str(e.value)
    options = [f"{key}={value:g}" for key, value in TOLERANCES.items()]
    agreed = [state_tolerances(s, options) for s in (stated, other)]
    assert join_sessions(agreed).robot.parameters.stated == TOLERANCES


def test_the_message_says_what_to_state(raw_cycles, stated, tmp_path):
    other = say(raw_cycles, tmp_path, tolerances={**TOLERANCES, "*.offset_mm": 4.0})
    with pytest.raises(SessionError) as e:
        join_sessions([stated, other])
    assert str(e.value) == (
        f"{other.path}: calibration.tolerances: 'x_slide.offset' is within ±4 mm, but within "
        f"±0.8 mm in {stated.path}; expected one value, because the machine is the same. A session "
        "without `tolerances` has those of the robot's YAML. For all: "
        "--tolerance '*_fork.rx_mrad=6' --tolerance '*_swivel.rx_mrad=4' "
        "--tolerance '*.offset_mm=0.8'"
    )


def test_a_session_states_only_what_differs_from_the_robot(raw_cycles):
    """Also where a general key, a repeated one and one of another unit say what the robot says."""
    own = 2e3 * raw_cycles.robot.parameters["x_slide.offset"].prior_std
    same = raw_cycles.with_tolerances({"*.offset_mm": own, "x_slide.offset_m": own * 1e-3})
    assert same.robot.parameters.stated == {}
    assert "tolerances" not in session_document(same).get("calibration", {})
    narrow = {"*.offset_mm": 1.0, "x_slide.offset_mm": own}  # the second key undoes the first
    assert raw_cycles.with_tolerances(narrow).robot.parameters.stated == narrow


def test_a_worker_gets_them(stated):
    there = pickle.loads(pickle.dumps(build_sensitivity_study(stated))).session
    assert there.purpose == stated.purpose
    assert there.robot.parameters[FORK].prior_std == pytest.approx(3e-3)


def test_later_ones_come_on_top(orthoglide):
    parameters = orthoglide.parameters.with_tolerances({"*.offset_mm": 4.0})
    parameters = parameters.with_tolerances({"x_slide.offset_mm": 2.0})
    assert [parameters[f"{a}_slide.offset"].prior_std for a in "xyz"] == [1e-3, 2e-3, 2e-3]
    parameters = parameters.with_tolerances({"*.offset_mm": 1.0})
    assert {parameters[f"{a}_slide.offset"].prior_std for a in "xyz"} == {0.5e-3}
    assert parameters.defaults is orthoglide.parameters
    assert parameters.redundant == orthoglide.parameters.redundant
