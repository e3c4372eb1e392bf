"""Drives that lose steps while a session is measured."""

from __future__ import annotations

import numpy as np
import pytest
from calibrated import plan_of
from made_mistakes import sound_machine

from orthocal import simulate_session
from orthocal.assessment.judgement import judge_session
from orthocal.hypotheses.families.sessions import MAX_SCORED, lost_steps
from orthocal.hypotheses.hypothesis import Rows
from orthocal.hypotheses.linear_model import LinearModel
from orthocal.hypotheses.search import find_anomalies
from orthocal.measurement.joining import join_sessions
from orthocal.observation.model import predict_readings


def lose_steps(session, errors, drive, row, size):
    """Session in which a drive moves by `size`, in metres, before a row; gauges are not touched."""
    moved = {**errors, f"{drive}.offset": errors.get(f"{drive}.offset", 0.0) + size}
    before, after = (predict_readings(session, e) for e in (errors, moved))
    later = np.arange(len(session.readings)) >= row
    values = session.values + np.where(later, after - before, 0.0)
    steps = session.gauge.resolution or 1e-9
    values = np.round(values / steps) * steps
    return session.with_values(values)


@pytest.fixture(scope="module")
def plan():
    return plan_of("workshop")


def measure(plan, drive, row, size, *, seed):
    errors, first = sound_machine(plan, seed, entered=True)
    second = simulate_session(first, errors, seed=seed + 500).session
    again = lose_steps(second, errors, drive, row, size)
    return join_sessions([first, again])


def test_lost_steps_are_named_with_drive_place_and_amount(plan):
    drive, row, size = "y_slide", 7, -1e-3
    judgement = judge_session(measure(plan, drive, row, size, seed=3))
    (anomaly,) = judgement.anomalies
    e = anomaly.explanation
    assert (e.kind, e.drives, e.sessions) == ("lost steps", (drive,), ("session-2",))
    assert abs(e.first - 18 - row) <= 2
    assert e.amount == pytest.approx(size, abs=4.0 * e.std)
    (finding,) = [f for f in judgement.findings if f.severity != "note"]
    assert (finding.kind, finding.severity) == ("lost steps", "review")
    assert {p.parameter for p in finding.places} == {drive}
    assert drive in finding.text
    assert finding.numbers[f"{drive}.offset_by_mm"] == pytest.approx(e.amount * 1e3)


def test_one_session_with_many_readings_shows_lost_steps():
    plan = plan_of("sweep")
    errors, session = sound_machine(plan, 4, entered=True)
    row = 48  # within a setup, whose readings jump
    lost = lose_steps(session, errors, "x_slide", row, 1e-3)
    (anomaly,) = find_anomalies(lost).found
    assert (anomaly.explanation.kind, anomaly.explanation.drives) == ("lost steps", ("x_slide",))
    assert abs(anomaly.explanation.first - row) <= 2


def test_a_large_session_has_few_hypotheses_or_none(plan, monkeypatch):
    session = measure(plan, "x_slide", 8, 1e-3, seed=3)
    (family,) = lost_steps(LinearModel(session), Rows(session))
    assert family.count == 3 * 2 * 11
    assert family.count * len(session.readings) < MAX_SCORED
    monkeypatch.setattr("orthocal.hypotheses.families.sessions.MAX_SCORED", 400)
    (thinned,) = lost_steps(LinearModel(session), Rows(session))
    assert 0 < thinned.count < family.count / 2
    single, joined = plan.with_values(np.zeros(18)), session
    assert [len(list(lost_steps(LinearModel(s), Rows(s)))) for s in (single, joined)] == [1, 1]
    monkeypatch.setattr("orthocal.hypotheses.linear_model.MAX_JACOBIAN", 0)
    assert [len(list(lost_steps(LinearModel(s), Rows(s)))) for s in (single, joined)] == [0, 1]
