"""Findings of reversed setups and of changes between sessions, as every command states them."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from calibrated import plan_of, session_of
from made_mistakes import make_mistakes, sound_session
from scipy.stats import chi2

from orthocal import check_session, join_sessions, load_session, simulate_session, write_session
from orthocal.assessment import judgement
from orthocal.hypotheses.families.sessions import changes_between_sessions, detectable_changes
from orthocal.hypotheses.hypothesis_set import explain_with_amounts
from orthocal.hypotheses.linear_model import LinearModel
from orthocal.hypotheses.search import _Search, find_anomalies

ERRORS = {"x_slide.offset": 1.2e-3, "y_slide.offset": -0.7e-3, "x_coupler.rz": 0.8e-3}
ENTERED = [0.9e-3, -0.5e-3, 0.3e-3]


@pytest.fixture(scope="module")
def plan():
    return plan_of("raw-cycles")


def joined(days, *names):
    return join_sessions([load_session(days / n) for n in names])


def test_the_likeliest_line_of_rejected_readings_is_named():
    """No mistake has clear evidence, but only readings far beyond the tolerances are explained."""
    session = sound_session(plan_of("workshop"), 0, entered=False)
    (made,) = [
        m for n, _, m in make_mistakes(session, 0, sizes=(20.0,)) if n == "sign of a reading"
    ]
    (row,) = made.rows
    found = check_session(session.with_values(made.values))
    (finding,) = found.of_kind("beyond tolerances")
    place = session.readings[row]
    assert [(p.setup, p.posture) for p in finding.places] == [(place.setup, place.posture)]


def test_one_difference_per_setup_does_not_determine_its_sign():
    session = session_of("table1/experiment-2")
    for setup in ("xy", "yz", "zx"):
        values = [-r.value if r.setup == setup else r.value for r in session.readings]
        assert not check_session(session.with_values(values)).of_kind("reversed sign")


@pytest.fixture(scope="module")
def days(plan, tmp_path_factory):
    """Monday; Tuesday with offsets entered; Wednesday with slide x displaced by 0.2 mm."""
    directory = tmp_path_factory.mktemp("days")
    entered = plan.with_controller(ENTERED)
    moved = {**ERRORS, "x_slide.offset": 1.4e-3}
    for i, (name, read, errors) in enumerate(
        (("monday", plan, ERRORS), ("tuesday", entered, ERRORS), ("wednesday", entered, moved))
    ):
        write_session(simulate_session(read, errors, seed=i).session, directory / name)
    return directory


@pytest.fixture(scope="module")
def all_days(days):
    return check_session(joined(days, "monday", "tuesday", "wednesday"))


def test_a_displaced_slide_is_named_with_its_amount_and_session(days, all_days):
    found = all_days
    assert (found.decision.verdict, found.decision.exit_code) == ("review", 3)
    (finding,) = found.of_kind("machine changed")
    amount, std = (finding.numbers[f"x_slide.offset_{n}_mm"] for n in ("by", "std"))
    assert abs(amount - 0.2) < 3.0 * std
    assert 0.003 < std < 0.025
    assert finding.places[0].file == str(days / "wednesday/session.yaml")
    assert finding.places[0].parameter == "x_slide"
    assert "x_slide or its home switch moved" in finding.text
    assert "wednesday" in finding.action


def test_a_drive_that_moved_is_described_alike_after_two_sessions_and_more(days, all_days):
    """Only the second of two sessions states new offsets; the third one states the same."""
    texts, kinds = set(), []
    for found in (check_session(joined(days, "monday", "wednesday")), all_days):
        (finding,) = [f for f in found.findings if f.severity == "review"]
        kinds.append(finding.kind)
        texts.add(re.sub(r"\d+\.\d+", "#", f"{finding.text} {finding.action}"))
    assert kinds == ["offset of one drive", "machine changed"]
    (text,) = texts
    assert "not +# mm as stated" in text


def test_without_a_change_the_detectable_size_is_stated(days):
    found = check_session(joined(days, "monday", "tuesday"))
    assert found.decision.verdict == "enter"
    (finding,) = found.of_kind("no change")
    assert 0.03 < finding.numbers["seen_from_mm"] < 0.12
    alone = check_session(load_session(days / "monday"))
    assert not alone.of_kind("no change", "change unknown", "machine changed")


def test_changes_beyond_the_travel_are_not_said_to_be_detectable(days, monkeypatch):
    sessions = joined(days, "monday", "tuesday")
    changes = {"x_slide": 200.0, "y_slide": 0.4e-3, "z_slide": 0.3e-3}
    monkeypatch.setattr(judgement, "detectable_changes", lambda _: changes)
    (finding,) = check_session(sessions).of_kind("no change")
    assert finding.numbers == {"seen_from_mm": pytest.approx(0.4)}
    assert "A change of x_slide would not have been" in finding.text
    monkeypatch.setattr(judgement, "detectable_changes", lambda _: dict.fromkeys(changes, 200.0))
    assert check_session(sessions).of_kind("change unknown")


def test_changes_above_the_stated_limit_are_found_and_small_ones_are_not(plan):
    """1.5 times the stated limit is found, 0.4 times is not."""
    first = simulate_session(plan, ERRORS, seed=1).session
    limit = detectable_changes(join_sessions([first, first]))["y_slide"]
    for factor, kinds in ((1.5, ["machine changed"]), (0.4, [])):
        errors = {**ERRORS, "y_slide.offset": ERRORS["y_slide.offset"] + factor * limit}
        second = simulate_session(plan, errors, seed=101).session
        found = find_anomalies(join_sessions([first, second])).found
        assert [a.explanation.kind for a in found] == kinds


def test_two_displaced_slides_are_both_named(plan):
    plan = plan.with_controller(ENTERED)
    moved = {"x_slide.offset": 1.5e-3, "y_slide.offset": -0.95e-3}
    sessions = [
        simulate_session(plan, errors, seed=i).session
        for i, errors in enumerate((ERRORS, {**ERRORS, **moved}))
    ]
    found = find_anomalies(join_sessions(sessions)).found
    assert {a.explanation.drives for a in found} == {("x_slide",), ("y_slide",)}
    for a in found:
        size = {"x_slide": 0.3e-3, "y_slide": -0.25e-3}[a.explanation.drives[0]]
        assert abs(a.explanation.amount - size) < 4.0 * a.explanation.std


def test_a_tilted_slide_is_not_named_as_displaced(plan):
    sessions = [
        simulate_session(plan, errors, seed=i).session
        for i, errors in enumerate((ERRORS, {**ERRORS, "x_slide.rz": 3e-3}))
    ]
    (found, *_) = find_anomalies(join_sessions(sessions)).found
    assert not found.explanation.drives
    assert found.explanation.parameters[0].startswith("x_")


def test_without_a_stated_noise_no_change_is_found(experiment_2):
    silent = experiment_2.with_gauge(replace(experiment_2.gauge, sigma=None))
    few = replace(silent, readings=silent.readings[:2])
    found = check_session(join_sessions([silent, few]))
    assert found.decision.verdict == "enter"
    assert not found.of_kind("machine changed", "inconsistent readings")


def estimate_change(session, drive):
    model = LinearModel(session)
    search = _Search(session, model)
    family = next(f for f in changes_between_sessions(model) if not f.known)
    (h,) = [h for h in range(family.count) if family.explain(h).drives == (drive,)]
    term = search.scorer.term(family, h)
    (found,) = explain_with_amounts(search.sets.evaluate([term], search.sound.about))
    return found.amount, found.std


def test_readings_that_do_not_repeat_are_found(raw_cycles):
    """The readings of a cycle, each in another row of it: no single one is an evident mistake."""
    values = raw_cycles.values
    rows = np.array([i for i, r in enumerate(raw_cycles.readings) if r.cycle == 2])
    values[rows] = values[np.random.default_rng(3).permutation(rows)]
    (finding,) = check_session(raw_cycles.with_values(values)).of_kind("scattered repeats")
    assert finding.severity == "review"
    assert finding.text.startswith("Repeated readings scatter by 0.")
    assert finding.places
    assert finding.numbers["scatter_mm"] > 10.0 * finding.numbers["gauge_mm"]
    assert finding.numbers["gauge_mm"] == pytest.approx(np.hypot(0.01, 0.01 / 12**0.5), rel=1e-12)


@pytest.mark.slow
def test_amounts_of_changes_have_the_stated_standard_deviation(plan):
    """z scores of machines with a slide displaced by 0.2 mm."""
    scores, count = [], 12
    for seed in range(count):
        drive, size = ("x_slide", "y_slide", "z_slide")[seed % 3], 0.2e-3 * (-1) ** seed
        name = f"{drive}.offset"
        pair = (ERRORS, {**ERRORS, name: ERRORS.get(name, 0.0) + size})
        sessions = [
            simulate_session(plan, errors, seed=1000 + 2 * seed + i).session
            for i, errors in enumerate(pair)
        ]
        amount, std = estimate_change(join_sessions(sessions), drive)
        scores.append((amount - size) / std)
    low, high = chi2.interval(0.997, count - 1)
    assert low < np.var(scores) * count < high
    assert abs(np.mean(scores)) < 3.0 / np.sqrt(count)
