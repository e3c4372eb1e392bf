"""Validation of calibrations: the paper's third experiment, entry mistakes, changed machines."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from calibrated import UNJUDGED, calibrated, identified, plan_of, session_of
from effect_plans import FEW, sided_plan
from models import TRUTH
from planned import quick_plan
from scipy.stats import binom, chi2
from scipy.stats import t as student
from tolerances import THREE_DECIMALS_MM

from orthocal import (
    Choice,
    calibrate,
    draw_errors,
    join_sessions,
    simulate_session,
    summarize,
    validate_calibration,
)
from orthocal.assessment.assess import assessment_of
from orthocal.assessment.controller_entries import compensation_to_enter, entered_offsets
from orthocal.assessment.judgement import judge_session
from orthocal.assessment.predictive import (
    Repetition,
    _find_worst_setup,
    _predict_noise,
    expect_deviations,
    judge_deviations,
    measure_repetition,
)
from orthocal.assessment.validation import (
    ENTRY_KINDS,
    _assumed,
    _compare_tool_errors,
    _with_active_offsets,
)
from orthocal.assessment.wording import join_texts, tool_mm
from orthocal.assessment.words import validation as words
from orthocal.assessment.words.anomalies import describe_evidence
from orthocal.assessment.words.validation import describe_repetition
from orthocal.calibration.build_record import assemble_calibration
from orthocal.calibration.refit import calibrated_theta, repeat_fit
from orthocal.errors import SessionError
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.observation.observations import build_observations
from orthocal.output.text.summary import result_json
from orthocal.statistics.chance import BY_CHANCE

pytestmark = pytest.mark.usefixtures("assessed_once", "module_of_few_tool_points")

QUICK = {"solver": "variable-projection"}

MACHINES = 25
"""Machines of which expected and actual deviations are compared."""


@pytest.fixture(scope="module")
def plan():
    return plan_of("raw-cycles")


@pytest.fixture(scope="module")
def paper():
    return calibrated("table1/experiment-2")


@pytest.fixture(scope="module")
def experiment_3():
    return session_of("table1/experiment-3")


def draw_machine(robot, seed):
    errors = draw_errors(robot, machine_errors(robot), seed=seed)
    for drive in robot.drives:
        errors[f"{drive.name}.offset"] *= 0.4
    return errors


@cache
def calibrated_machine(name, model, seed):
    """Errors of a machine, its session by the plan of an example, and its calibration."""
    plan = plan_of(name)
    errors = draw_machine(plan.robot, seed)
    session = simulate_session(plan, errors, seed=seed).session
    return errors, session, calibrate(session, model, **UNJUDGED)


def measure_again(plan, calibration, errors, *, seed, **options):
    """Session of a machine with the offsets of a calibration in its controller."""
    entered = plan.with_controller(entered_offsets(calibration))
    return simulate_session(entered, errors, seed=seed, **options).session


def misread(session):
    return session.with_values(session.values + 0.3e-3 * (np.arange(len(session.values)) == 4))


def test_experiment_3_validates_experiment_2_as_in_the_paper(paper, experiment_3):
    result = validate_calibration(paper, experiment_3)
    expected, achieved = (0.195e-3, 0.278e-3), (0.213e-3, 0.340e-3)
    assert abs(result.expected_rms - expected[0]) < THREE_DECIMALS_MM
    assert abs(result.expected_largest - expected[1]) < THREE_DECIMALS_MM
    assert abs(result.refit.rms_before - achieved[0]) < THREE_DECIMALS_MM
    assert abs(result.refit.largest_before - achieved[1]) < THREE_DECIMALS_MM
    refit = assessment_of(result.refit)
    changes = np.array([e.best_change for e in refit.entries]) * 1e3
    assert np.abs(changes - [0.0667, 0.1411, 0.0025]).max() < 0.005
    assert result.as_expected
    assert result.nothing_to_change
    assert result.repetition.repeats is True
    assert result.repetition.p_value < 0.01
    assert not result.offsets_stated
    decision = result.assessment.decision
    assert (decision.verdict, decision.exit_code) == ("enter", 0)
    (lead,) = result.assessment.of_kind("as predicted")
    assert lead.numbers["achieved_rms_mm"] == pytest.approx(0.213, abs=0.001)
    assert result.assessment.of_kind("residuals repeat")
    assert result.assessment.of_kind("controller assumed")
    assert decision.headline in summarize(result)
    document = json.loads(result.to_json())
    assert document["schema"] == "orthocal/validation/4"
    assert document["confirmed"] is True
    assert document["nothing_to_change"] is True


@pytest.mark.parametrize(("ratio", "stated"), [(0.6, False), (1.1, False), (2.0, True)])
def test_a_larger_tool_error_than_before_is_stated_beside_the_confirmation(paper, ratio, stated):
    assessment = assessment_of(paper)
    promised = assessment.tool.entered
    tool = replace(assessment.tool, now=ratio * promised)
    joint = replace(paper, assessment=replace(assessment, tool=tool))
    agreement = words.as_predicted(1e-5, 2e-5, 1e-5, {"chance": 0.5})
    found = _compare_tool_errors(agreement, paper, joint)
    assert (found.kind, found.severity) == (agreement.kind, "note")
    assert (found.text != agreement.text) == stated
    assert found.text.startswith(agreement.text)
    if stated:
        assert found.numbers["before_um"] == pytest.approx(promised * 1e6)
        assert found.numbers["now_um"] == pytest.approx(2.0 * promised * 1e6)
        assert tool_mm(tool.now) in found.text
        assert tool_mm(promised) in found.text


@pytest.mark.slow
def test_deviations_with_priors_are_as_large_as_expected():
    plan, sizes = session_of("table1/experiment-2"), []
    for seed in range(MACHINES):
        errors = draw_machine(plan.robot, seed)
        first, second = (simulate_session(plan, errors, seed=seed + k).session for k in (0, 1000))
        found = identified(first, "full")
        fit = repeat_fit(found, second)
        expected = expect_deviations(found, fit)
        refit = assemble_calibration(fit, nominal=calibrated_theta(found, fit))
        sizes.append((expected.rms, refit.rms_before, expected.largest, refit.largest_before))
    rms, achieved, median, largest = np.array(sizes).T
    ratio = np.sqrt(np.mean(achieved**2) / np.mean(rms**2))
    error = 0.5 * np.std(achieved**2) / np.mean(achieved**2) / np.sqrt(MACHINES)  # of the ratio
    assert abs(ratio - 1.0) < 3.0 * error
    assert 0.25 < np.mean(largest < median) < 0.9  # deviations that are correlated are smaller


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_probability_of_a_repetition_is_that_of_a_random_direction(sign):
    """The cosine c of residuals of noise in d dimensions: c √((d−1)/(1−c²)) is Student's t."""
    first, second = (identified(session_of(f"table1/experiment-{n}")) for n in (2, 3))
    rows = tuple(replace(r, predicted=r.measured - sign * r.residual) for r in second.residuals)
    found = measure_repetition(first, replace(second, residuals=rows))
    key = [(r.setup, r.posture, r.minus) for r in second.residuals]
    assert [(r.setup, r.posture, r.minus) for r in first.residuals] == key
    a, b = (np.array([r.residual for r in c]) for c in (first.residuals, rows))
    cosine = a @ b / np.sqrt((a @ a) * (b @ b))
    d = second.noise.residual_dof  # all rows of the second session are in the first
    expected = student.sf(cosine * np.sqrt((d - 1.0) / (1.0 - cosine**2)), d - 1.0)
    assert found.p_value == pytest.approx(expected, rel=1e-6)
    assert found.correlation == pytest.approx(np.corrcoef(a, b)[0, 1])
    assert found.repeats is (sign > 0.0)


@pytest.mark.parametrize(
    ("chance", "text"), [(0.22, "by chance 22 %"), (1e-9, "by chance below 0.01 %")]
)
def test_the_probability_of_a_repetition_is_printed(chance, text):
    found = describe_repetition(Repetition(6, 0.5, chance))
    assert (text in found.text, text in describe_evidence(found)) == (False, True)


def test_residuals_of_noise_repeat_as_seldom_as_stated(plan):
    """p-values of ten validations are uniform."""
    count, probabilities, repeats = 10, [], []
    for seed in range(2, 2 + 2 * count, 2):
        first = simulate_session(plan, TRUTH, seed=seed + 1).session
        before = identified(first)
        entered = np.round([p.value for p in before.free], 6)
        after = simulate_session(plan.with_controller(entered), TRUTH, seed=seed).session
        fit = repeat_fit(before, after)
        probabilities.append(judge_deviations(before, fit).p_value)
        repeats.append(measure_repetition(before, assemble_calibration(fit)).repeats)
    # 1 % by construction
    assert sum(p < BY_CHANCE for p in probabilities) <= binom.ppf(0.99, count, BY_CHANCE)
    assert sum(map(bool, repeats)) <= binom.ppf(0.99, count, BY_CHANCE)
    assert np.mean(probabilities) == pytest.approx(0.5, abs=3.0 / np.sqrt(12 * count))


@pytest.mark.parametrize(("sigma_um", "seed"), [(2.0, 3), (50.0, 5)])
def test_another_gauge_has_its_own_noise(plan, sigma_um, seed):
    first = simulate_session(plan, TRUTH, seed=seed).session
    before = identified(first, "full")
    other = plan.with_gauge(replace(plan.gauge, sigma=sigma_um * 1e-6, resolution=None))
    offsets = [before[f"{d.name}.offset"].value for d in plan.robot.drives]
    entered = other.with_controller(np.round(offsets, 6))
    sound = simulate_session(entered, TRUTH, seed=100 + seed).session
    p_sound = judge_deviations(before, repeat_fit(before, sound)).p_value
    assert 0.01 < p_sound < 0.99
    rng, place = np.random.default_rng(seed), [(r.setup, r.posture) for r in sound.readings]
    errors = {key: 2e-4 * rng.normal() for key in dict.fromkeys(place)}  # in all cycles
    worse = sound.with_values(sound.values + [errors[key] for key in place])
    assert judge_deviations(before, repeat_fit(before, worse)).p_value < 1e-6


def test_a_session_with_other_offsets_is_refused(paper, experiment_3):
    with pytest.raises(SessionError, match="not measured with the offsets to enter"):
        validate_calibration(paper, experiment_3.with_controller(np.zeros(3)))
    assessment = assessment_of(paper)
    doubtful = replace(assessment.decision, verdict="review")
    calibration = replace(paper, assessment=replace(assessment, decision=doubtful))
    with pytest.raises(SessionError, match="is 'review': its offsets are not to be entered"):
        validate_calibration(calibration, experiment_3.with_controller(np.zeros(3)))


def test_only_identified_offsets_must_be_active(experiment_3):
    choice = Choice(free=["x_slide.offset", "z_slide.offset"])
    calibration = calibrate(session_of("table1/experiment-2"), choice, **UNJUDGED)
    entered = np.add(entered_offsets(calibration), [0.0, 0.3e-3, 1e-3])
    with pytest.raises(SessionError, match=r"controller\.offsets_mm: z_slide has"):
        validate_calibration(calibration, experiment_3.with_controller(entered))


def test_a_session_without_stated_offsets_has_the_offsets_after_the_entries(raw_cycles):
    """A drive whose offset the calibration does not identify keeps the one while measuring."""
    active = [0.2e-3, -0.1e-3, 1e-3]
    choice = Choice(free=["x_slide.offset", "y_slide.offset"])
    calibration = calibrate(raw_cycles.with_controller(active), choice, **UNJUDGED)
    new = replace(raw_cycles, controller_offsets=None)
    assumed = _with_active_offsets(calibration, new).active_offsets
    assert assumed[2] == active[2]
    assert assumed.tolist() == entered_offsets(calibration).tolist()


def test_sessions_of_the_calibration_are_refused(experiment_3):
    session = session_of("table1/experiment-2")
    both = identified([session, experiment_3])
    for used in (session, experiment_3, join_sessions([experiment_3, session])):
        with pytest.raises(SessionError, match="belongs to the calibration itself"):
            validate_calibration(both, used)


def test_a_calibration_without_redundant_readings_predicts_nothing(experiment_3):
    session = session_of("table1/experiment-2")
    few = session.select([r for r in session.readings if r.setup in ("yx", "xy", "xz")])
    result = validate_calibration(calibrate(few, **UNJUDGED), experiment_3)
    assert result.as_expected is None
    assert result.assessment.of_kind("nothing predicted")
    assert result.assessment.decision.exit_code == 3


def test_several_sessions_are_validated_together(plan):
    errors, _, calibration = calibrated_machine("raw-cycles", None, 3)
    days = [measure_again(plan, calibration, errors, seed=s) for s in (2, 3)]
    both = validate_calibration(calibration, days)
    assert both.confirmed
    assert len(both.refit.residuals) == sum(len(d.readings) for d in days)
    assert both.repetition.matched == 18
    wrong = plan.with_controller(np.zeros(3)).with_values(days[1].values)
    message = rf"x_slide has 0 mm instead of {entered_offsets(calibration)[0] * 1e3:.3f} mm"
    with pytest.raises(SessionError, match=message):
        validate_calibration(calibration, [days[0], wrong])


@pytest.mark.slow
def test_validate_and_calibrate_agree_on_the_same_sessions():
    """A sound machine is confirmed, and both commands state the same values to enter."""
    name, model, seed = "workshop", "full", 1
    errors, first, calibration = calibrated_machine(name, model, seed)
    session = measure_again(plan_of(name), calibration, errors, seed=seed + 1000)
    result = validate_calibration(calibration, session)
    again = calibrate([first, session], model, **QUICK).assessment
    assert result.confirmed
    assert result.refit.rms_before < 2.0 * result.expected_rms
    assert result.final_calibration is result.joint
    assert result.assessment.decision.verdict == again.decision.verdict == "enter"
    assert result.nothing_to_change is again.keeps_offsets is False
    stated = [e.enter for e in result.enter]
    assert stated == pytest.approx([e.enter for e in again.entries], abs=1e-6)
    for validated, joint in zip(assessment_of(result.joint).entries, again.entries, strict=True):
        assert validated.enter == pytest.approx(joint.enter, abs=1e-8)
        assert validated.std == pytest.approx(joint.std, rel=1e-4)
    judged = {f.kind for f in judge_session(session).findings}
    assert judged <= {f.kind for f in result.assessment.findings}
    # the fit absorbs the shared lines
    assert result.repetition.repeats is None
    assert result.repetition.matched == len({(r.setup, r.posture) for r in session.readings})
    (unknown,) = result.assessment.of_kind("repetition unknown")
    assert unknown.numbers["rows"] == result.repetition.matched


@pytest.mark.slow
def test_a_reversed_setup_that_only_the_new_readings_show_is_named():
    """The verdict is that of both sessions; the first session alone shows nothing.

    Setup zx of the new session may be reversed, too: its sign makes no difference.
    """
    plan = plan_of("workshop")
    errors = draw_machine(plan.robot, 28)
    sound = simulate_session(plan, errors, seed=28).session
    signs = [-1.0 if r.setup == "xy" else 1.0 for r in sound.readings]
    calibration = calibrate(sound.with_values(signs * sound.values), "full", **QUICK)
    assert calibration.assessment.decision.verdict == "enter"
    session = measure_again(plan, calibration, errors, seed=1028)
    result = validate_calibration(calibration, session)
    assert result.confirmed is False
    assert result.joint is None
    assert result.assessment.decision.verdict == "review"
    (found,) = result.assessment.of_kind("reversed sign")
    assert {p.setup for p in found.places} == {"session-1/xy"}
    assert "the signs of setup session-1/xy are reversed" in result.assessment.decision.reason


def test_a_change_that_keeps_the_offsets_is_found_by_validation_alone(plan):
    """The axis of a drive turned by 1 mrad."""
    errors, _, calibration = calibrated_machine("raw-cycles", None, 1)
    turned = {**errors, "x_slide.rz": errors["x_slide.rz"] + 1e-3}
    session = measure_again(plan, calibration, turned, seed=5)
    result = validate_calibration(calibration, session)
    assert result.nothing_to_change
    assert calibrate(session, **UNJUDGED).assessment.keeps_offsets
    assert result.confirmed is False
    assert result.mistake.explanation.parameters == ("x_slide.rz",)
    assert result.assessment.of_kind("machine changed")
    assert result.assessment.decision.exit_code == 3
    worst = max(result.refit.residuals, key=lambda r: abs(r.deviation))
    place = f"{worst.setup} {worst.posture}"
    assert place in " ".join(summarize(result, details=True).split())
    assert place not in " ".join(summarize(result).split())


def test_the_setup_to_read_again_is_the_one_that_disagrees_with_the_others():
    """Not that of the largest deviation: its reading may only be predicted less well."""
    plan, named, unconfirmed = quick_plan().session, 0, 0
    for seed in range(3):
        errors = draw_machine(plan.robot, seed)
        first = simulate_session(plan, errors, seed=seed).session
        calibration = identified(first)
        session = measure_again(plan, calibration, errors, seed=seed + 1000)
        setup = list(session.setups)[seed % len(session.setups)]
        values = session.values
        displaced = [i for i, r in enumerate(session.readings) if r.setup == setup][1:-1]
        values[displaced] += 0.15e-3
        fit = repeat_fit(calibration, session.with_values(values))
        test = judge_deviations(calibration, fit)
        if test.p_value < BY_CHANCE:
            unconfirmed += 1
            named += list(fit.problem.session.setups)[test.worst_setup] == setup
    assert named == unconfirmed >= 3


GROSS = ((2000.0, 3000.0), (3500.0, 3000.0))
"""Squares whose probabilities are below exp(-900)."""


@pytest.mark.parametrize(
    ("squares", "worst", "known"),
    [
        ((chi2.isf(0.002, 8), chi2.isf(0.001, 1)), "zx", "yx"),
        (GROSS[0], "zx", None),
        (GROSS[1], "yx", None),
    ],
)
def test_a_free_zero_takes_a_degree_of_freedom_of_its_setup(raw_cycles, squares, worst, known):
    """Nine readings of setup yx and two of zx; the worst one also with known zeros."""
    chosen = [r for r in raw_cycles.readings if r.setup == "yx"]
    chosen += [r for r in raw_cycles.readings if r.setup == "zx"][:2]
    o = build_observations(raw_cycles.select(chosen))
    residual = np.zeros(o.size)
    for name, square in zip(("yx", "zx"), squares, strict=True):
        of_setup = np.array(o.zero_setup)[o.zero] == name
        residual[np.flatnonzero(of_setup)[:2]] = np.array([1.0, -1.0]) * np.sqrt(square / 2.0)

    def find(observations):
        setup = _find_worst_setup(residual, np.zeros((o.size, 1)), observations)
        return list(raw_cycles.setups)[setup]

    assert find(o) == worst
    if known:
        assert find(replace(o, zero_known=np.ones(o.n_zeros, dtype=bool))) == known


def test_the_noise_that_several_sessions_share_counts_once(experiment_3):
    """Eight entries of each of two sessions, with eleven parameters and zeros: five checks."""
    session = session_of("table1/experiment-2")
    days = [replace(s.select(s.readings[:4]), title=s.title) for s in (session, experiment_3)]
    calibration = identified(days, "offsets")
    shared = [g.noise.residual_dof for g in calibration.gauges]
    assert shared == [calibration.noise.residual_dof] * 2
    assert shared[0] == pytest.approx(5.0, abs=0.01)
    _, dof = _predict_noise(calibration, repeat_fit(calibration, experiment_3))
    assert dof == pytest.approx(shared[0])


def test_number_and_limit_are_printed_differently():
    for achieved, limit, text in (
        (26.4e-6, 25.6e-6, "0.0264 mm RMS (limit 0.0256 mm)"),
        (26e-6, 22e-6, "0.026 mm RMS (limit 0.022 mm)"),
        (330e-6, 26.3e-3, "0.330 mm RMS (expected 0.208 mm)"),
    ):
        finding = words.as_predicted(achieved, limit, 208e-6, {})
        assert finding.text.endswith(f"by {text}.")


@pytest.mark.parametrize(
    ("mistake", "kind", "by_calibration"),
    [
        (lambda e: 0.0 * e, "offsets not entered", True),
        (lambda e: np.add(e, (0.0, -0.37e-3, 0.0)), "offset of one drive", False),
    ],
)
def test_values_to_enter_after_a_mistake(plan, mistake, kind, by_calibration):
    errors, _, calibration = calibrated_machine("raw-cycles", None, 3)
    right = entered_offsets(calibration)
    measured = simulate_session(plan.with_controller(mistake(right)), errors, seed=7).session
    session = plan.with_controller(right).with_values(measured.values)
    result = validate_calibration(calibration, session)
    assert result.confirmed is False
    assert result.assessment.decision.exit_code == 3
    assert result.mistake.explanation.kind == kind
    (cause,) = result.assessment.of_kind(kind)
    document = json.loads(result_json(result))
    assert document["decision"]["verdict"] == "review"
    assert document["mistake"]["kind"] == kind
    drives = {"y_slide"} if kind == "offset of one drive" else {"x_slide", "y_slide", "z_slide"}
    assert {p.parameter for p in cause.places} == drives
    if kind == "offsets not entered":
        assert cause.numbers["x_slide_active_mm"] == 0.0
    else:
        stated, found, limit = map(
            float,
            re.search(r"is not (\S+) mm as stated, but (\S+) ± (\S+) mm", cause.text).groups(),
        )
        assert stated == pytest.approx(1e3 * right[1], abs=5e-4)
        assert found == pytest.approx(1e3 * mistake(right)[1], abs=1.5 * limit)
    text = " ".join(summarize(result).split())
    assert cause.text in text
    entered = np.array([e.enter for e in result.enter])
    assert entered == pytest.approx(right if by_calibration else [], abs=0.0)
    assert all(f"{e.enter * 1e3:+.3f}" in text for e in result.enter)
    assert_nothing_new_to_enter(result)


def assert_nothing_new_to_enter(result):
    """No values from the new readings, and no tool error, neither as text nor as JSON."""
    found = result.assessment
    assert found.tool is None
    assert found.backlash == ()
    assert not found.of_kind(*ENTRY_KINDS)
    document = json.loads(result_json(result))
    assert document["changes"] == []
    assert document["nothing_to_change"] is None
    new = assessment_of(result.refit)
    for text in (summarize(result), summarize(result, details=True)):
        assert not any(f.text in text for f in new.of_kind("tool error"))
        assert "tool error" not in text
        assert "backlash     now" not in text
        assert not any(f"{e.drive}  {e.enter * 1e3:+.3f}" in text for e in new.entries)


@pytest.fixture(scope="module")
def with_backlash():
    """Plan and errors of a machine with backlash, and its calibration."""
    plan = sided_plan(FEW).with_controller(np.zeros(3))
    errors = draw_errors(plan.robot, machine_errors(plan.robot), seed=1)
    errors |= {f"{d.name}.offset": 0.2e-3 for d in plan.robot.drives}
    errors |= {f"{d.name}.backlash": 60e-6 for d in plan.robot.drives}
    session = simulate_session(plan, errors, seed=1).session
    return plan, errors, calibrate(session, "full", **UNJUDGED)


def test_values_to_enter_after_a_backlash_that_was_not_entered(with_backlash):
    plan, errors, calibration = with_backlash
    session = measure_again(plan, calibration, errors, seed=2)
    session = replace(session, compensation=compensation_to_enter(calibration))
    result = validate_calibration(calibration, session)
    assert result.confirmed is False
    assert result.mistake.explanation.kind == "backlash not entered"
    assert result.mistake.explanation.drives == ("x_slide", "y_slide", "z_slide")
    assert json.loads(result_json(result))["mistake"]["active"] == [0.0] * 3
    found = [e.enter for e in result.enter]
    assert found == pytest.approx(entered_offsets(calibration).tolist())
    backlash = [round(e.enter, 6) for e in result.enter_backlash]
    assert backlash == pytest.approx([t.backlash for t in compensation_to_enter(calibration)])
    text = summarize(result)
    assert [f"{d.name} backlash" in text for d in plan.robot.drives] == [True] * 3


def test_backlash_of_the_calibration_is_assumed_with_its_offsets(with_backlash):
    """The controller has both. A session that states the offsets alone may lack the backlash."""
    plan, errors, calibration = with_backlash
    entered = plan.with_controller(entered_offsets(calibration))
    entered = replace(entered, compensation=compensation_to_enter(calibration))
    stated = replace(simulate_session(entered, errors, seed=2).session, compensation=())
    silent = replace(stated.with_controller(np.zeros(3)), controller_offsets=None)
    assumed = _with_active_offsets(calibration, silent)
    backlash = [[t.backlash for t in s.compensation] for s in (assumed, entered)]
    assert backlash[0] == backlash[1]
    assert assumed.active_offsets.tolist() == entered.active_offsets.tolist()
    (note,) = _assumed(calibration, [silent])
    assert "offsets and the backlash" in note.text
    result = validate_calibration(calibration, stated)
    assert result.confirmed is False
    changed = result.assessment.of_kind("machine changed")
    assert {p.parameter for f in changed for p in f.places} <= {
        f"{d.name}.backlash" for d in plan.robot.drives
    }
    assert all("compensates another backlash" in f.text for f in changed)
    assert "`controller.backlash_mm`" in changed[0].action


def test_the_verdict_is_that_of_all_sessions_and_the_exit_code_the_confirmation(plan):
    """New readings with three times the noise: nothing odd in all of them, but not as predicted."""
    errors, _, calibration = calibrated_machine("raw-cycles", "full", 3)
    session = measure_again(plan, calibration, errors, seed=4, sigma=15e-6)
    result = validate_calibration(calibration, session)
    (larger,) = result.assessment.of_kind("larger than predicted")
    limit = float(re.search(r"\(limit ([0-9.]+) mm\)", larger.text)[1])
    assert larger.numbers["limit_of_pattern_mm"] == pytest.approx(limit, abs=5e-4)
    fit = repeat_fit(calibration, session)
    worst = judge_deviations(calibration, fit).worst_setup
    assert larger.places[0].setup == list(fit.problem.session.setups)[worst]
    document = json.loads(result_json(result))
    assert document["confirmed"] is False
    assert document["decision"]["exit_code"] == 3
    assert document["decision"]["verdict"] == "enter"


def test_a_wrong_new_reading_makes_a_validation_inconclusive(plan):
    """The answer names it and says nothing of deviations that it causes."""
    errors, _, calibration = calibrated_machine("raw-cycles", None, 3)
    result = validate_calibration(
        calibration, misread(measure_again(plan, calibration, errors, seed=2))
    )
    assert result.confirmed is None
    assert result.as_expected is False
    assert result.enter == result.assessment.entries == ()
    (outlier,) = result.assessment.of_kind("outlier")
    assert result.assessment.decision.reason == outlier.text
    (larger,) = result.assessment.of_kind("larger than predicted")
    assert larger.severity == "note"
    assert larger.text not in summarize(result)
    assert result.assessment.decision.exit_code == 3
    assert_nothing_new_to_enter(result)


def test_new_readings_that_do_not_repeat_make_a_validation_inconclusive(plan):
    errors, _, calibration = calibrated_machine("raw-cycles", None, 3)
    session = measure_again(plan, calibration, errors, seed=4, sigma=40e-6)
    result = validate_calibration(calibration, session)
    (scatter,) = result.assessment.of_kind("scattered repeats")
    assert "the gauge alone by" in scatter.text
    assert result.confirmed is None
    assert result.as_expected is False
    assert result.assessment.decision.action.endswith("Then validate again.")


def test_after_a_list_the_next_reason_begins_a_new_line():
    assert join_texts(["a.", "Causes:\n  b;\n  c.", "d."]) == "a. Causes:\n  b;\n  c.\nd."
