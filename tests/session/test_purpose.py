"""Model and tolerances that a session states for its calibration."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from orthocal import Choice, ParameterError, SessionError, load_calibration
from orthocal.calibration.file import write_calibration
from orthocal.calibration.identify import identify
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


def state(session, folder, *, model=None, free=(), tolerances=None):
    """The session from a file that states its calibration."""
    stated = replace(session, purpose=Purpose(model, tuple(free)))
    return load_session(write_session(stated.with_tolerances(tolerances or {}), folder))


def fit(session, choice=None):
    """Calibration of a session without its assessment."""
    return identify(session, choice, solver="variable-projection")[0]


@pytest.fixture(scope="module")
def stated(raw_cycles, tmp_path_factory):
    return state(raw_cycles, tmp_path_factory.mktemp("full"), model="full", tolerances=TOLERANCES)


def test_a_statement_has_the_effect_of_options(raw_cycles, stated):
    assert stated.purpose == Purpose("full")
    found, expected = fit(stated), fit(raw_cycles, Choice("full", tolerances=TOLERANCES))
    assert found.model == expected.model == "full"
    assert [p.prior_std for p in found.free] == [p.prior_std for p in expected.free]
    assert [(p.value, p.std) for p in found.free] == [(p.value, p.std) for p in expected.free]


def test_tolerances_apply_to_unmodelled_errors(raw_cycles, stated):
    default, wide = (fit(s, "offsets") for s in (raw_cycles, stated))
    np.testing.assert_allclose(*([p.value for p in c.free] for c in (default, wide)), atol=1e-12)
    index = default.unmodelled.names.index(FORK)
    assert default.unmodelled.prior_stds[index] == 1e-3
    assert wide.unmodelled.prior_stds[index] == pytest.approx(3e-3)
    assert wide.unmodelled.residual_rms > default.unmodelled.residual_rms


def test_a_calibration_file_keeps_tolerances(stated, tmp_path):
    first = fit(stated)
    again = load_calibration(write_calibration(first, tmp_path / "calibration.json"))
    assert again.robot.parameters[FORK].prior_std == pytest.approx(3e-3)
    repeated = repeat_calibration(again, restore_session(again))
    np.testing.assert_allclose(
        [p.value for p in repeated.free], [p.value for p in first.free], atol=1e-12
    )


def test_options_take_precedence_over_a_statement(stated):
    parameters = stated.robot.parameters
    assert resolve_choice("offsets", stated).model == "offsets"
    assert resolve_choice(Choice(free=["*.offset"]), stated).model is None
    only_known = resolve_choice(Choice(known={"x_leg.length_mm": 0.1}), stated)
    assert (only_known.model, dict(only_known.known)) == ("full", {"x_leg.length_mm": 0.1})
    narrower = resolve_choice(Choice(tolerances={"x_fork.rx_mrad": 1.0}), stated).select(parameters)
    sizes = {p.name: p.prior_std for p in narrower.parameters}
    assert sizes[FORK] == pytest.approx(0.5e-3)
    assert sizes["y_fork.rx"] == pytest.approx(3e-3)


def test_the_default_model_without_a_statement(raw_cycles, stated):
    silent = replace(raw_cycles, purpose=None).with_tolerances(TOLERANCES)
    assert resolve_choice(None, raw_cycles).model == "offsets"  # as stated
    assert resolve_choice(None, silent).model == "full"
    assert resolve_choice(None, silent, default_model="lengths").model == "lengths"
    assert resolve_choice(None, None, default_model="full").model == "full"
    assert resolve_choice(None, stated, default_model="lengths").model == "full"


def test_a_session_may_state_globs_instead_of_a_model(raw_cycles, tmp_path):
    session = state(raw_cycles, tmp_path, free=["*.offset", "!x_slide.offset"])
    assert [p.name for p in fit(session).free] == ["y_slide.offset", "z_slide.offset"]


def test_joined_sessions_must_state_one_model(raw_cycles, stated, tmp_path):
    also = state(raw_cycles, tmp_path / "also", model="full", tolerances=TOLERANCES)
    joined = join_sessions([stated, also])
    assert joined.purpose == Purpose("full")
    assert joined.robot.parameters.stated == TOLERANCES
    offsets = state(raw_cycles, tmp_path / "offsets", model="offsets", tolerances=TOLERANCES)
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
def test_joined_sessions_must_state_equal_tolerances(raw_cycles, stated, tmp_path, tolerances):
    other = state(raw_cycles, tmp_path, model="full", tolerances=tolerances)
    for pair in ([stated, other], [other, stated]):
        with pytest.raises(SessionError) as e:
            join_sessions(pair)
        assert e.value.where == f"{pair[1].path}: calibration.tolerances"
        assert str(pair[0].path) in str(e.value)
    options = [f"{key}={value:g}" for key, value in TOLERANCES.items()]
    agreed = [state_tolerances(s, options) for s in (stated, other)]
    assert join_sessions(agreed).robot.parameters.stated == TOLERANCES


def test_the_message_names_the_key_to_state(raw_cycles, stated, tmp_path):
    other = state(raw_cycles, tmp_path, tolerances={**TOLERANCES, "*.offset_mm": 4.0})
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


def test_a_worker_has_the_stated_tolerances(stated):
    there = pickle.loads(pickle.dumps(build_sensitivity_study(stated))).session
    assert there.purpose == stated.purpose
    assert there.robot.parameters[FORK].prior_std == pytest.approx(3e-3)


def test_later_tolerances_replace_earlier_ones(orthoglide):
    parameters = orthoglide.parameters.with_tolerances({"*.offset_mm": 4.0})
    parameters = parameters.with_tolerances({"x_slide.offset_mm": 2.0})
    assert [parameters[f"{a}_slide.offset"].prior_std for a in "xyz"] == [1e-3, 2e-3, 2e-3]
    parameters = parameters.with_tolerances({"*.offset_mm": 1.0})
    assert {parameters[f"{a}_slide.offset"].prior_std for a in "xyz"} == {0.5e-3}
    assert parameters.defaults is orthoglide.parameters
    assert parameters.redundant == orthoglide.parameters.redundant
