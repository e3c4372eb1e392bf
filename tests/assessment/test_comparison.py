"""Comparison of models: scores, predictions of omitted setups, and one recommendation."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from calibrated import SOUND, plan_of, session_of
from gauges import with_gauges, with_scatter

from orthocal import calibrate, draw_errors, join_sessions, simulate_session, summarize
from orthocal.assessment.comparison import compare_models, find_known_noises
from orthocal.assessment.recommendation import STRONG, Recommendation, recommend_model
from orthocal.assessment.scores import score_model
from orthocal.assessment.wording import tool_mm
from orthocal.assessment.words.comparison import describe_recommendation
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.output.text.comparison import MORE
from orthocal.output.text.summary import result_json
from orthocal.session.session import Gauge
from orthocal.statistics.zeros import project_out_zeros

QUICK = SolverOptions("variable-projection")


def compare(session, *models, **options):
    return compare_models(session, models=models, options=QUICK, **options)


EXAMPLES = {"table1": "table1/experiment-2", "cycles": "raw-cycles"}


@pytest.fixture(scope="module")
def table1():
    session, again = (session_of(f"table1/experiment-{n}") for n in (2, 3))
    return compare_models(session, repeat=again, options=QUICK)


@pytest.fixture(scope="module")
def cycles():
    return compare_models(session_of("raw-cycles"), options=QUICK)


def test_the_complete_model_is_recommended_for_table_1(table1):
    assert table1.recommendation.model == "full"
    assert table1.best is table1["full"]
    assert [r.model for r in table1] == ["offsets", "lengths", "full"]
    assert "full" in table1
    assert [table1[m].calibration.redundancy for m in ("offsets", "full")] == [3, 0]
    found = table1.assessment
    assert (found.decision.verdict, found.decision.exit_code) == ("enter", 0)
    (recommended,) = found.of_kind("recommended")
    assert recommended.numbers["log_evidence"] == 0.0
    others = {f.text.split(":")[0]: f.numbers for f in found.of_kind("not recommended")}
    assert others.keys() == {"offsets", "lengths"}
    assert others["offsets"]["log_evidence"] == pytest.approx(-116.95, abs=0.05)
    expected = table1["offsets"].exact.prediction_rms * 1e3
    assert others["offsets"]["prediction_rms_mm"] == pytest.approx(expected, rel=1e-12)
    (scale,) = found.of_kind("above tolerances")
    assert scale.numbers["tolerance_scale"] == table1.judgement.tolerance_scale.factor > 1.0
    assert found.of_kind("repetition unknown")  # no reading is redundant


def test_models_are_compared_with_the_recommended_one_only(table1):
    """Without the complete model, which is recommended, the largest is no reference."""
    session = session_of("table1/experiment-2")
    compared = compare(session, "offsets", "lengths", judgement=table1.judgement)
    assert compared.recommendation.model == "full"
    assert compared.best.model == "lengths"
    assert compared.assessment.of_kind("recommended")
    assert not compared.assessment.of_kind("not recommended")


RECOMMENDED = {"table1": ("full", -116.95), "cycles": ("offsets", 11.8)}
"""Recommended model, and ln evidence of offsets against the complete model at the stated noise."""


@pytest.mark.parametrize("name", RECOMMENDED)
def test_compare_and_calibrate_state_the_same_model_and_tool_error(name, request):
    compared = request.getfixturevalue(name)
    model, evidence = RECOMMENDED[name]
    assert compared.recommendation.model == model
    assert compared.recommendation.log_evidence_of("offsets") == pytest.approx(evidence, abs=0.05)
    session, judgement = session_of(EXAMPLES[name]), compared.judgement
    calibration = calibrate(session, model, solver="variable-projection", judgement=judgement)
    both = compared.assessment, calibration.assessment
    for assessment in both:
        (finding,) = assessment.of_kind("recommended")
        assert model in finding.text
    first, second = (assessment.of_kind("tool error") for assessment in both)
    assert [f.text for f in first] == [f.text for f in second]
    assert both[0].tool.box == both[1].tool.box
    row = next(r for r in summarize(compared).splitlines() if r.split()[:1] == [model])
    assert tool_mm(both[1].tool.entered) in row
    for figure in ("now", "entered", "compensated"):
        values = [getattr(assessment.tool, figure) for assessment in both]
        assert values[0] == pytest.approx(values[1], rel=1e-6)


def test_doubtful_readings_get_no_recommendation(raw_cycles):
    session = raw_cycles.select([r for r in raw_cycles.readings if r.cycle <= 2])
    sides = [-1.0 if r.setup == "yx" else 1.0 for r in session.readings]
    session = session.with_values(session.values * sides)
    compared = compare(session, "offsets")
    assessed, judgement = compared.assessment, compared.judgement
    assert judgement.verdict == "review"
    assert (compared.recommendation, compared.effects, assessed.tool) == (None, None, None)
    assert assessed.findings == judgement.findings
    document = json.loads(result_json(compared))
    assert document["decision"]["verdict"] == "review"
    assert document["recommendation"] is None
    assert "tool" not in document
    assert {m["tool_uncertainty"] for m in document["models"]} == {None}
    text = summarize(compared)
    assert "ecommended" not in text
    assert "tool error" not in text
    assert assessed.decision.action.split()[0] in text
    calibration = calibrate(session, "offsets", solver="variable-projection", judgement=judgement)
    assert not calibration.assessment.of_kind("recommended")


def test_residuals_of_offsets_repeat(experiment_2):
    again = session_of("table1/experiment-3")
    found = compare(experiment_2, "offsets", repeat=again, judgement=SOUND)
    assert found.best is found["offsets"]  # the largest compared model
    assert found.repetition.repeats
    assert found.repetition.correlation == pytest.approx(0.9937, abs=5e-5)
    (repeat,) = found.assessment.of_kind("residuals repeat")
    assert repeat.numbers["correlation"] == found.repetition.correlation
    (excess,) = found.assessment.of_kind("model error")
    assert excess.numbers["ratio"] == pytest.approx(9.8, abs=0.05)


def test_the_scores_of_table_1_solved_by_hand(table1):
    """χ² of six differences with σ√2 each, three parameters; AICc and BIC by their formulas.

    The dial has a stated σ of 20 µm and a step of 10 µm.
    """
    score = table1["offsets"].exact
    square = float(np.sum(score.residuals**2))
    assert score.rms == pytest.approx(np.sqrt(square / 6))
    assert score.chi_square == pytest.approx(
        square / (2 * (0.02e-3**2 + 0.01e-3**2 / 12)), rel=1e-9
    )
    assert 2.998 < score.dof < 3.0  # nuisance parameters reduce it a little
    k = 7.0 - score.dof
    # six independent differences are six readings of variance one without their zeros
    term = 6 * math.log(square / 2 / 6)
    assert score.aicc == pytest.approx(term + 2 * k + 2 * k * (k + 1) / (6 - k - 1))
    assert score.bic == pytest.approx(term + k * math.log(6))
    assert math.isinf(table1["full"].exact.aicc)


def test_a_known_zero_takes_no_degree_of_freedom():
    """That of a ball bar. One reading of the dial fixes its zero."""
    session = session_of("linear_delta")
    result = score_of(session)
    assert result.exact.dof == pytest.approx(len(session.readings) - 1 - result.effective)


COARSE, FINE = Gauge(20e-6), Gauge(2e-6)


def score_of(session, model="offsets", **options):
    problem = build_problem(session, model=model, **options)
    return score_model(problem, noises=find_known_noises(session), options=QUICK)


def read_with_two_gauges(fine_setups, *, scale, seed):
    session = session_of("raw-cycles")
    session = with_gauges(session, {"coarse": COARSE, "fine": FINE}, fine_setups)
    problem = build_problem(session, model="full", prior=True)
    rng = np.random.default_rng(seed)
    drawn = rng.normal(size=problem.n_free) * problem.theta_scale * scale
    return with_scatter(session, drawn, problem, rng)


def test_scores_of_several_gauges_are_in_metres():
    """Residuals, RMS and predictions are those of `calibrate`; χ² has the noise of each gauge."""
    session = read_with_two_gauges(("xz", "yz", "zy"), scale=0.01, seed=1)
    result = score_of(session)
    score, rows = result.exact, result.calibration.residuals
    assert score.residuals == pytest.approx([r.residual for r in rows], rel=1e-6, abs=1e-12)
    assert score.rms == pytest.approx(result.calibration.rms_after, rel=1e-6)
    predicted = np.sqrt(np.mean([r.prediction_error**2 for r in rows]))
    assert score.prediction_rms == pytest.approx(predicted, rel=0.02)  # to first order there
    known = {
        g.name: g.noise.without_residuals(g.sigma, g.resolution)[0]
        for g in result.calibration.gauges
    }
    assert known["coarse"] > 5.0 * known["fine"]
    square = sum((r.residual / known[session.setups[r.setup].gauge]) ** 2 for r in rows)
    assert score.chi_square == pytest.approx(square, rel=1e-6)
    assert 0.5 < score.chi_square / score.dof < 2.0


@pytest.mark.parametrize(
    ("unexplained", "noises"), [(1.0, 2.0), (0.0, 1.0)], ids=["estimated", "stated"]
)
def test_criteria_of_several_gauges_solved_by_hand(unexplained, noises):
    """-2 ln L of independent contrasts of variance σ²: n ln σ² and 2 ln of each gauge's ratio.

    The ratio of two stated noises is known. If residuals exceed both, it is estimated as well.
    """
    session = read_with_two_gauges(("xz", "yz"), scale=unexplained, seed=7)
    if not unexplained:  # half of the stated scatter, which remains the lower limit
        problem = build_problem(session, model="offsets")
        nominal = problem.observations.rows(problem.predict(np.zeros(3)))
        session = session.with_values(0.5 * (session.values + nominal))
    result = score_of(session)
    sources = {g.noise.source for g in result.calibration.gauges}
    assert sources == ({"residuals"} if unexplained else {"gauge"})
    o = build_problem(session, free=["*.offset"]).observations
    sigmas = {g.name: g.noise.sigma for g in result.calibration.gauges}
    gauge_of = {n: s.gauge for n, s in session.setups.items()}
    counts = {
        name: sum(gauge_of[r.setup] == name for r in session.readings)
        - sum(gauge_of[s] == name for s in o.zero_setup)
        for name in sigmas
    }
    square = sum(
        (r.residual / sigmas[gauge_of[r.setup]]) ** 2 for r in result.calibration.residuals
    )
    n = sum(counts.values())
    misfit = n * math.log(square / n)
    misfit += 2.0 * sum(counts[name] * math.log(sigmas[name]) for name in sigmas)
    k = result.effective + noises
    assert result.exact.bic == pytest.approx(misfit + k * math.log(n), rel=1e-7)
    aicc = misfit + 2.0 * k + 2.0 * k * (k + 1.0) / (n - k - 1.0)
    assert result.exact.aicc == pytest.approx(aicc, rel=1e-7)


def test_a_parameter_at_a_bound_is_no_effective_one(raw_cycles):
    result = score_of(raw_cycles, bounds={"x_slide.offset": (0.0, 0.05e-3)})
    assert result.calibration.free[0].at_bound == "upper"
    assert result.effective == pytest.approx(2.0, abs=0.01)
    assert result.exact.dof == pytest.approx(result.calibration.noise.residual_dof)


def assert_predicted_without(setup, session, result, tolerance):
    """Its prediction errors are those of a fit without its rows; its own mounting counts as 0."""
    rest = replace(session, readings=tuple(r for r in session.readings if r.setup != setup))
    problem = build_problem(session, model=result.model)
    fit = fit_problem(build_problem(rest, model=result.model))
    sigma = result.calibration.noise.sigma  # the weight beside the priors
    solution = NonlinearProgram(fit.problem).solve(sigma=sigma)
    found = dict(zip(fit.problem.free, solution.theta, strict=True))
    theta = np.array([found.get(name, 0.0) for name in problem.free])
    o = problem.observations
    errors = o.rows(project_out_zeros(problem.values - problem.predict(theta), o))
    rows = [i for i, r in enumerate(session.readings) if r.setup == setup]
    assert rows
    assert result.exact.prediction_error[rows] == pytest.approx(errors[rows], abs=tolerance)


def test_omitted_setups_are_predicted_by_fits_without_their_rows(experiment_2, table1):
    for row in experiment_2.readings[::2]:
        assert_predicted_without(row.setup, experiment_2, table1["offsets"], 1e-9)


def test_an_omitted_setup_is_predicted_with_priors(raw_cycles, cycles):
    assert_predicted_without("xz", raw_cycles, cycles["lengths"], 2e-8)


def test_linearised_and_exact_predictions_nearly_agree(cycles):
    offsets = cycles["offsets"]
    gap = np.abs(offsets.linearised.prediction_error - offsets.exact.prediction_error)
    assert 0.0 < gap.max() < 0.01e-3
    assert offsets.linearisation_cost.rms < 2e-6


def test_repeated_readings_are_not_counted_as_new_ones(cycles):
    """Six setups in three postures, three times over: twelve differences, whatever the cycles."""
    assert cycles.independent == 12
    assert cycles["full"].calibration.redundancy == 0
    # the cycles scatter by 10.2 µm, less than the 10.4 µm that the gauge states with its rounding
    assert {n.source for n in cycles.noises.values()} == {"gauge"}
    assert cycles.recommendation.model == "offsets"
    assert cycles.assessment.of_kind("fits")
    assert cycles.assessment.decision.verdict == "enter"


def test_an_unstated_noise_is_unknown(experiment_2):
    session = experiment_2.with_gauge(replace(experiment_2.gauge, sigma=None))
    found = compare(session, "offsets", judgement=SOUND)
    assert found.assessment.of_kind("noise from residuals")
    assert found.assessment.decision.exit_code == 0
    assert json.loads(found.to_json())["noises"] == [
        {"gauge": "", "sigma": None, "source": "unknown"}
    ]


def test_a_setup_that_the_others_do_not_determine_has_no_prediction(raw_cycles):
    session = raw_cycles.select([r for r in raw_cycles.readings if r.setup in ("yx", "zx", "xz")])
    assert np.isnan(score_of(session).exact.prediction_error).any()


def test_an_undetermined_offset_has_a_prior_in_all_models(raw_cycles):
    rows = tuple(r for r in raw_cycles.readings if r.setup == "yx")
    session = replace(raw_cycles, readings=rows)
    found = compare(session, "offsets", "lengths", judgement=SOUND)
    assert found.undetermined == ()
    assert found["offsets"].calibration.redundancy == 0
    json.loads(found.to_json())
    assert [r.model for r in found.results] == ["offsets", "lengths"]
    assert all(r.calibration.prior for r in found.results)


def test_the_summary_has_all_scores(table1):
    text = summarize(table1, details=True)
    assert text.startswith(summarize(table1).removesuffix(f"{MORE}\n"))
    assert text.index("Recommended model") < text.index("Scores")
    for words in ("linear", "exact", "χ²", "AICc", "BIC", "CV", "tool", "ln evidence"):
        assert words in text
    rows = text[text.index("Scores") : text.index("Estimates")].splitlines()
    full = next(i for i, row in enumerate(rows) if row.strip().startswith("full"))
    assert rows[full].split()[4:9] == rows[full + 1].split()[1:6] == ["–"] * 5  # no redundancy
    row = next(line for line in text.splitlines() if line.strip().startswith("x_slide.offset"))
    assert row.split() == ["x_slide.offset", "offsets", "-0.522", "-0.527", "3.030", "mm"]
    assert max(len(line) for line in text.splitlines()) <= 100
    document = json.loads(table1.to_json())
    assert document["recommendation"]["model"] == "full"
    assert document["models"][0]["exact"]["rms"] == pytest.approx(0.195e-3, abs=5e-7)


def test_readings_without_deviation_support_offsets_and_small_tolerances(raw_cycles):
    still = raw_cycles.with_values(np.zeros(len(raw_cycles.readings)))
    recommendation = recommend_model(still, ["offsets", "lengths"])
    assert recommendation.log_evidence_of("offsets") > STRONG
    assert recommendation.tolerance_scale < 0.2
    assert math.isfinite(score_of(still, "lengths").exact.aicc)


def test_more_sessions_of_one_machine_support_its_errors_more():
    """Errors of 0.3 tolerances repeat in all sessions: each new one speaks against none of them.

    As readings of three different machines they would support the offsets alone.
    """
    plan = plan_of("workshop")
    errors = draw_errors(plan.robot, machine_errors(plan.robot), seed=0)
    errors = {n: (0.2 if n.endswith(".offset") else 0.3) * e for n, e in errors.items()}
    near = [round(errors[f"{d.name}.offset"], 5) for d in plan.robot.drives]
    plans = [plan.with_controller(np.zeros(3)), *[plan.with_controller(near)] * 2]
    sessions = [simulate_session(p, errors, seed=k).session for k, p in enumerate(plans)]
    first, *others = (
        recommend_model(join_sessions(sessions[:n]), ["offsets"]).log_evidence_of("offsets")
        for n in (1, 2, 3)
    )
    assert first > others[0] > others[1]


def test_one_tolerance_scale_is_stated():
    """The calibration applies that of the judgement."""
    recommendation = Recommendation("full", 2.2, {"full": 0.0}, 9.0)
    kinds = {
        scale: [f.kind for f in describe_recommendation(recommendation, judged_scale=scale)]
        for scale in (1.0, 3.0)
    }
    assert kinds == {1.0: ["recommended", "tolerances differ"], 3.0: ["recommended"]}
