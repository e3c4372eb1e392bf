"""The paper's third experiment, and validations that must fail."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from tolerances import THREE_DECIMALS_MM

from orthocal import (
    Choice,
    calibrate,
    load_plan,
    load_session,
    simulate_session,
    summarize,
    validate_calibration,
)
from orthocal.assessment.controller_entries import find_entries
from orthocal.errors import SessionError
from orthocal.observation.simulate import load_errors

TRUTH = {"x_slide.offset": 1.2e-3, "y_slide.offset": -0.8e-3, "z_slide.offset": 0.5e-3}


@pytest.fixture(scope="module")
def table1(root):
    return {n: load_session(root / f"examples/table1/experiment-{n}") for n in (2, 3)}


@pytest.fixture(scope="module")
def plan(root):
    return load_plan(root / "examples/raw-cycles/plan.yaml")


def with_offsets(plan, offsets):
    postures = {n: replace(p, drives=p.drives - offsets) for n, p in plan.postures.items()}
    return replace(plan, postures=postures, controller_offsets=np.array(offsets))


def test_experiment_3_validates_experiment_2_as_in_the_paper(table1):
    result = validate_calibration(calibrate(table1[2]), table1[3])
    expected, achieved = (0.195e-3, 0.278e-3), (0.213e-3, 0.340e-3)
    assert abs(result.expected_rms - expected[0]) < THREE_DECIMALS_MM
    assert abs(result.expected_largest - expected[1]) < THREE_DECIMALS_MM
    assert abs(result.achieved_rms - achieved[0]) < THREE_DECIMALS_MM
    assert abs(result.achieved_largest - achieved[1]) < THREE_DECIMALS_MM
    changes = np.array([c.change for c in result.changes]) * 1e3
    assert np.abs(changes - [0.0667, 0.1411, 0.0025]).max() < 0.005
    assert result.as_expected
    assert result.nothing_to_change
    assert result.repetition.repeats is True
    assert result.repetition.chance < 0.01
    assert not result.offsets_stated
    assert result.assessment.of_kind("confirmed")
    assert result.assessment.of_kind("residuals repeat")
    assert result.assessment.decision.headline in summarize(result)


def test_offsets_that_were_entered_with_their_sign_turned_are_found_out(plan):
    before = calibrate(simulate_session(plan, TRUTH, seed=1).session)
    turned = with_offsets(plan, [-p.value for p in before.free])
    after = simulate_session(turned, TRUTH, seed=2).session
    # the session believes that the right offsets were entered
    lied = replace(after, controller_offsets=None, postures=plan.postures)
    result = validate_calibration(before, lied)
    assert result.as_expected is False
    assert not result.nothing_to_change
    (found,) = result.assessment.of_kind("wrong sign")
    assert found.text in " ".join(summarize(result).split())
    assert result.assessment.decision.verdict == "review"


def test_a_right_calibration_with_noise_alone_does_not_repeat_its_residuals(plan):
    verdicts = []
    for seed in range(2, 42, 2):
        first = simulate_session(plan, TRUTH, seed=seed + 1).session
        before = calibrate(first, solver="eliminated")
        entered = np.round([p.value * 1e3 for p in before.free], 3) * 1e-3
        after = simulate_session(with_offsets(plan, entered), TRUTH, seed=seed).session
        result = validate_calibration(before, after)
        assert result.offsets_stated
        verdicts.append((result.as_expected, result.nothing_to_change, result.repetition.repeats))
    # 1 %, 5 % and 5 % by construction: more than these of 20 have a chance below 1 %
    assert sum(ok is False for ok, _, _ in verdicts) <= 2
    assert sum(not nothing for _, nothing, _ in verdicts) <= 4
    assert sum(bool(again) for _, _, again in verdicts) <= 4


def test_a_session_with_other_offsets_is_no_validation(table1):
    stated = with_offsets(table1[3], np.zeros(3))
    with pytest.raises(SessionError, match="measured with what the calibration says to enter"):
        validate_calibration(calibrate(table1[2]), stated)


def test_offsets_that_were_not_identified_need_not_be_the_controllers(table1):
    calibration = calibrate(table1[2], Choice(free=["x_slide.offset", "z_slide.offset"]))
    entered = [calibration.errors.get(f"{leg}_slide.offset", 0.0) for leg in "xyz"]
    stated = with_offsets(table1[3], np.array(entered))
    assert validate_calibration(calibration, stated).offsets_stated
    with pytest.raises(
        SessionError, match=r"z_slide has 0 mm where the calibration says to enter -1\.6"
    ):
        validate_calibration(calibration, with_offsets(table1[3], np.array([entered[0], 0, 0])))


def test_json_is_plain(table1):
    document = json.loads(validate_calibration(calibrate(table1[2]), table1[3]).to_json())
    assert document["schema"] == "orthocal/validation/2"
    assert document["nothing_to_change"] is True


def test_another_robot_is_refused(table1, biglide):
    calibration = calibrate(table1[2])
    with pytest.raises(SessionError, match="is of robot 'biglide'"):
        validate_calibration(calibration, replace(table1[3], robot=biglide))


def test_a_calibration_without_readings_to_spare_expects_nothing(table1):
    few = tuple(r for r in table1[2].readings if r.setup in ("yx", "xy", "xz"))
    result = validate_calibration(calibrate(replace(table1[2], readings=few)), table1[3])
    assert result.as_expected is None
    assert result.assessment.of_kind("nothing predicted")


def test_a_calibration_of_all_errors_is_confirmed_with_its_offsets_entered(root):
    """The other errors cannot be entered: the new readings are expected to show them."""
    plan = load_plan(root / "tests/sessions/lines/plan.yaml")
    truth = load_errors(root / "tests/sessions/lines/truth.yaml", plan.robot)
    session = load_session(root / "tests/sessions/lines")
    calibration = calibrate(session, Choice(model="full", tolerances={"*.offset_m": 2e-3}))
    offsets = np.array([e.enter for e in find_entries(calibration)])
    entered = with_offsets(plan, offsets)
    again = simulate_session(entered, truth, seed=99).session
    found = validate_calibration(calibration, again)
    assert found.achieved_rms < 2.0 * found.expected_rms
    assert found.confirmed
    # a machine that has changed since is told
    other = simulate_session(entered, {**truth, "x_coupler.x": 0.5e-3}, seed=99).session
    changed = validate_calibration(calibration, other)
    assert changed.confirmed is False
    (found,) = changed.assessment.of_kind("geometry changed")
    assert "x_coupler.x" in {p.parameter for p in found.places}
    text = " ".join(summarize(changed).split())
    worst = max(changed.rows, key=lambda r: abs(r.deviation))
    assert f"{worst.setup} {worst.posture}" in text  # the largest deviations are listed
    assert "z_fork.rz" not in text  # nor is every parameter


def test_rows_that_are_shared_are_not_said_to_be_too_few(root):
    session = load_session(root / "examples/workshop")
    calibration = calibrate(session, Choice(model="full"))
    entered = with_offsets(session, np.array([e.enter for e in find_entries(calibration)]))
    found = validate_calibration(calibration, simulate_session(entered, {}, seed=3).session)
    assert found.repetition.repeats is None
    assert found.repetition.matched == len({(r.setup, r.posture) for r in session.readings})
    (unknown,) = found.assessment.of_kind("repetition unknown")
    assert f"too little of the {found.repetition.matched} rows" in unknown.text


def test_several_sessions_validate_together(plan):
    """Two days' readings with the offsets entered: as one, each with zeros of its own."""
    calibration = calibrate(simulate_session(plan, TRUTH, seed=1).session)
    entered = {e.drive: e.enter for e in find_entries(calibration)}
    offsets = [entered[f"{k}_slide"] for k in "xyz"]
    days = [simulate_session(with_offsets(plan, offsets), TRUTH, seed=s).session for s in (2, 3)]
    both = validate_calibration(calibration, days)
    assert both.confirmed
    assert len(both.rows) == sum(len(d.readings) for d in days)
    assert both.repetition.matched == 18
    alone = validate_calibration(calibration, days[0])
    stds = [[c.std for c in v.changes] for v in (alone, both)]
    assert all(two < one for one, two in zip(*stds, strict=True))
    wrong = simulate_session(with_offsets(plan, offsets), {}, seed=4).session
    assert not validate_calibration(calibration, [days[0], wrong]).confirmed


def test_each_of_several_sessions_must_have_the_offsets(plan):
    calibration = calibrate(simulate_session(plan, TRUTH, seed=1).session)
    entered = [e.enter for e in find_entries(calibration)]
    right = simulate_session(with_offsets(plan, entered), TRUTH, seed=2).session
    other = simulate_session(with_offsets(plan, [0.0, 0.0, 0.0]), TRUTH, seed=3).session
    with pytest.raises(SessionError, match="x_slide has 0 mm where the calibration says to enter"):
        validate_calibration(calibration, [right, other])
