"""Which model the readings support: Table 1 says offsets only, displaced lines say all."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from orthocal.assessment.findings.comparison import decide_comparison

from orthocal import load_session, summarize
from orthocal.assessment.comparison import compare_models
from orthocal.errors import ParameterError
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.statistics.zeros import project_out_zeros


def reasons(comparison):
    return [f.words for f in decide_comparison(comparison).findings]


OFFSETS = {"*.offset_mm": 2.0}


@pytest.fixture(scope="module")
def table1(root, experiment_2):
    again = load_session(root / "examples/table1/experiment-3")
    return compare_models(experiment_2, repeat=again)


@pytest.fixture(scope="module")
def cycles(raw_cycles):
    return compare_models(raw_cycles)


@pytest.fixture(scope="module")
def lines(root):
    session = load_session(root / "tests/sessions/lines")
    return compare_models(session, models=["offsets", "full"], tolerances=OFFSETS)


def test_six_readings_support_offsets_only(table1):
    verdict = table1.verdict
    assert verdict.supported == "offsets"
    assert reasons(table1)[0] == "Six independent readings support offsets only."
    assert (table1["offsets"].spare, table1["full"].spare) == (3, 0)
    assert any(s.startswith("full: not supported. Its 129 parameters") for s in reasons(table1))
    assert any(s.startswith("lengths: no") for s in reasons(table1))


def test_tolerances_that_shrink_offsets_do_not_make_lengths_supported(experiment_2):
    """Beside a narrow prior lengths use up less than three parameters, which AICc rewards."""
    found = compare_models(experiment_2, models=["offsets", "lengths"], tolerances=OFFSETS)
    assert found["lengths"].exact.aicc < found["offsets"].exact.aicc - 2.0
    assert found.verdict.supported == "offsets"
    assert any(s.startswith("lengths: no more than offsets") for s in reasons(found))


def test_what_remains_of_table_1_is_model_error_not_noise(table1):
    text = " ".join(reasons(table1))
    assert table1.verdict.model_error is True
    assert decide_comparison(table1).exit_code == 3
    assert "error of the model rather than noise: σ 0.276 mm of a difference against 0.028" in text
    assert "10 times as much" in text
    assert "worse than its tolerances, by about 2.1 times" in text
    assert table1.repetition.repeats
    assert table1.repetition.correlation == pytest.approx(0.9937, abs=5e-5)
    assert "What remains repeats in 'Experiment 3" in text


def test_the_scores_of_table_1_solved_by_hand(table1):
    """χ² of six differences with σ√2 each, three parameters; AICc and BIC by their formulas."""
    score = table1["offsets"].exact
    square = float(np.sum(score.residuals**2))
    assert score.rms == pytest.approx(np.sqrt(square / 6))
    assert score.chi_square == pytest.approx(square / (2 * 0.02e-3**2), rel=1e-9)
    assert 2.998 < score.dof < 3.0  # what is not known of gauges takes the rest
    k = 7.0 - score.dof
    # six independent differences are six readings of variance one with their zeros taken out
    term = 6 * math.log(square / 2 / 6)
    assert score.aicc == pytest.approx(term + 2 * k + 2 * k * (k + 1) / (6 - k - 1))
    assert score.bic == pytest.approx(term + k * math.log(6))
    assert math.isinf(table1["full"].exact.aicc)


def with_gauges_of(problem, fit):
    """Parameters of a fit to fewer setups, the gauges of the others as they are said to stand."""
    found = dict(zip(fit.problem.free, fit.solution.theta, strict=True))
    return np.array([found.get(name, 0.0) for name in problem.free])


def test_leaving_a_setup_out_is_really_leaving_it_out(experiment_2, table1):
    """Against sessions without the setup's rows, each calibrated and asked for the missing row."""
    for i, row in enumerate(experiment_2.readings):
        rest = replace(
            experiment_2, readings=tuple(r for r in experiment_2.readings if r.setup != row.setup)
        )
        problem = build_problem(experiment_2)
        fit = fit_problem(build_problem(rest))
        sigma = table1["offsets"].calibration.noise.sigma  # as gauges' tolerances weigh beside it
        solution = NonlinearProgram(fit.problem).solve(sigma=sigma)
        theta = with_gauges_of(problem, replace(fit, solution=solution))
        o = problem.observations
        error = o.rows(project_out_zeros(problem.values - problem.predict(theta), o))[i]
        assert table1["offsets"].exact.unseen[i] == pytest.approx(error, abs=1e-9)


def test_leaving_a_setup_out_beside_a_prior(raw_cycles, cycles):
    setup = "xz"
    rest = replace(raw_cycles, readings=tuple(r for r in raw_cycles.readings if r.setup != setup))
    result = cycles["lengths"]
    sigma = result.calibration.noise.sigma
    problem = build_problem(raw_cycles, model="lengths")
    fit = fit_problem(build_problem(rest, model="lengths"))
    solution = NonlinearProgram(fit.problem).solve(sigma=sigma)
    theta = with_gauges_of(problem, replace(fit, solution=solution))
    o = problem.observations
    errors = o.rows(project_out_zeros(problem.values - problem.predict(theta), o))
    for i, row in enumerate(raw_cycles.readings):
        if row.setup == setup:
            assert result.exact.unseen[i] == pytest.approx(errors[i], abs=2e-8)


def test_linearised_and_exact_predict_alike_but_not_the_same(cycles):
    offsets = cycles["offsets"]
    gap = np.abs(offsets.linearised.unseen - offsets.exact.unseen)
    assert 0.0 < gap.max() < 0.01e-3
    assert offsets.linearisation_cost.rms < 2e-6


def test_repeated_readings_are_not_counted_as_new_ones(cycles):
    """Six setups in three postures, three times over: twelve differences, whatever the cycles."""
    assert cycles.independent == 12
    assert cycles["full"].spare == 0
    assert cycles.noise.source == "cycles"
    assert cycles.verdict.supported == "offsets"
    assert cycles.verdict.model_error is False
    assert decide_comparison(cycles).exit_code == 0


def test_displaced_lines_support_the_full_model(lines):
    verdict = lines.verdict
    assert verdict.supported == "full"
    assert decide_comparison(lines).exit_code == 0
    full, offsets = lines["full"], lines["offsets"]
    assert full.exact.unseen_rms < 0.8 * offsets.exact.unseen_rms
    # errors that no reading of a leg tells are in both, those of drives and rods' ends too
    assert full.tool.after.sizes.aligned.rms < 0.25 * offsets.tool.after.sizes.aligned.rms
    assert "264 independent readings support full." in reasons(lines)


def test_readings_that_leave_an_offset_open_support_nothing(raw_cycles):
    rows = tuple(r for r in raw_cycles.readings if r.setup == "yx")
    found = compare_models(replace(raw_cycles, readings=rows), models=["offsets"])
    assert found.verdict.supported is None
    assert decide_comparison(found).exit_code == 4
    (result,) = found.results  # held by the tolerances, as larger models are
    assert (result.prior, result.by_choice, result.spare) == (True, False, 0)
    assert "no reading is left to check it" in " ".join(reasons(found))
    assert "support none of the models" in summarize(found)
    json.loads(found.to_json())


def test_without_word_on_the_noise_it_says_so(experiment_2):
    session = experiment_2.with_gauge(replace(experiment_2.gauge, sigma=None))
    found = compare_models(session, models=["offsets"])
    assert found.verdict.model_error is None
    assert decide_comparison(found).exit_code == 0
    assert "nothing says what the noise is" in " ".join(reasons(found))
    assert json.loads(found.to_json())["noise"] is None


def test_a_setup_that_the_others_do_not_determine_has_no_prediction(raw_cycles):
    """Two setups of leg x tell two offsets: without either one is lost."""
    rows = tuple(r for r in raw_cycles.readings if r.setup in ("yx", "zx", "xz"))
    found = compare_models(replace(raw_cycles, readings=rows), models=["offsets"])
    assert np.isnan(found["offsets"].exact.unseen).any()


def test_an_unknown_model_is_refused(experiment_2):
    with pytest.raises(ParameterError, match="'all' is not a model"):
        compare_models(experiment_2, models=["all"])


def test_a_small_model_is_not_worse_off_for_having_no_prior(raw_cycles):
    """Without leg z its offset is open; what holds it in larger models holds it in this one."""
    rows = tuple(r for r in raw_cycles.readings if r.setup in ("yx", "xy"))
    found = compare_models(replace(raw_cycles, readings=rows), models=["offsets", "lengths"])
    assert found.undetermined == ()
    assert found.verdict.supported == "offsets"
    assert "do not determine it: what they leave open is held by the tolerances" in " ".join(
        reasons(found)
    )


def test_the_reasons_stand_before_the_criteria_and_what_cannot_be_compared_is_left_out(table1):
    text = summarize(table1)
    assert text.index("Verdict") < text.index("Models side by side")
    rows = text[text.index("Models side by side") : text.index("Estimates")].splitlines()
    full = next(i for i, row in enumerate(rows) if row.strip().startswith("full"))
    assert rows[full].split()[4:] == ["–"] * 6
    assert rows[full + 1].split()[1:7] == ["–"] * 6
    assert json.loads(table1.to_json())["verdict"]["models"]["full"]["standing"] == "no check"


def test_the_summary_shows_all_that_was_promised(table1):
    text = summarize(table1)
    for words in ("linear", "exact", "χ²", "AICc", "BIC", "unseen", "tool", "Verdict"):
        assert words in text
    row = next(line for line in text.splitlines() if line.strip().startswith("x_slide.offset"))
    assert row.split() == ["x_slide.offset", "offsets", "-0.522", "-0.527", "0.511", "mm"]
    assert max(len(line) for line in text.splitlines()) <= 100
    document = json.loads(table1.to_json())
    assert document["verdict"]["supported"] == "offsets"
    assert document["models"][0]["exact"]["rms"] == pytest.approx(0.195e-3, abs=5e-7)


def test_readings_without_any_deviation_support_offsets_only(raw_cycles):
    still = raw_cycles.with_values(np.zeros(len(raw_cycles.readings)))
    found = compare_models(still, models=["offsets", "lengths"])
    assert found.verdict.supported == "offsets"
    assert math.isfinite(found["lengths"].exact.aicc)
