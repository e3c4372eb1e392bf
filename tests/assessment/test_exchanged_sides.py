"""Sides of approach that were exchanged in the readings."""

from __future__ import annotations

from dataclasses import replace
from itertools import cycle, product

import numpy as np
import pytest
from calibrated import identified, plan_of

from orthocal import check_session, draw_errors, join_sessions, simulate_session
from orthocal.assessment.exchanged_sides import find_exchanged_sides
from orthocal.assessment.fit_findings import _above_tolerances
from orthocal.assessment.judgement import judge_session
from orthocal.effects.compensation import JointTrim
from orthocal.session.session import Conditions, Gauge

BACKLASHES = {"x_slide.backlash": 40e-6, "y_slide.backlash": 55e-6, "z_slide.backlash": 30e-6}


@pytest.fixture(scope="module")
def sided():
    """Function from a seed to sound readings from both sides."""
    plan = plan_of("raw-cycles").with_effects(["backlash"])
    readings = tuple(
        replace(r, conditions=Conditions(approach=3 * side))
        for r in plan.readings
        if r.cycle == 1
        for side in "pn"
    )
    plan = replace(plan.with_controller(np.zeros(3)), readings=readings)
    plan = plan.with_gauge(Gauge(5e-6, 1e-5))

    def simulate(seed):
        errors = draw_errors(plan.robot, ["*"], seed=seed, tolerances={"*.offset_mm": 4.0})
        return simulate_session(plan, errors | BACKLASHES, seed=seed).session

    return simulate


def with_exchanged_sides(session, setups):
    turned = str.maketrans("pn", "np")
    readings = tuple(
        replace(r, conditions=replace(r.conditions, approach=r.approach.translate(turned)))
        if r.setup in setups
        else r
        for r in session.readings
    )
    return replace(session, readings=readings)


@pytest.mark.parametrize("which", [slice(None), slice(1, 2)], ids=["all", "2"])
def test_exchanged_sides_are_named_with_their_setups(sided, which):
    session = sided(3)
    setups = list(session.setups)[which]
    assessment = check_session(with_exchanged_sides(session, setups))
    (finding,) = assessment.of_kind("sides exchanged")
    assert {p.setup for p in finding.places} <= set(setups)
    assert all(name in finding.text for name in setups)
    assert assessment.decision.verdict == "review"


@pytest.mark.parametrize(
    ("exchanged", "compensated", "named"),
    [
        ((0,), False, {"session-1"}),
        ((1,), False, {"session-2"}),
        ((0, 1), False, {"session-1", "session-2"}),
        ((0, 1), True, {"session-1"}),  # the second one shows no backlash that has a sign
    ],
)
def test_exchanged_sides_of_joined_sessions_are_no_change_between_them(
    sided, exchanged, compensated, named
):
    first = sided(0)
    errors = draw_errors(first.robot, ["*"], seed=0, tolerances={"*.offset_mm": 4.0}) | BACKLASHES
    plan = first
    if compensated:
        plan = replace(first, compensation=tuple(map(JointTrim, BACKLASHES.values())))
    sessions = [first, simulate_session(plan, errors, seed=1000).session]
    for k in exchanged:
        sessions[k] = with_exchanged_sides(sessions[k], sessions[k].setups)
    judgement = judge_session(join_sessions(sessions))
    anomalies = judgement.anomalies
    assert not any(e.sessions for a in anomalies for e in (a.explanation, *a.alternatives))
    found = [f for f in judgement.findings if f.kind == "sides exchanged"]
    assert {p.setup.partition("/")[0] for f in found for p in f.places} == named
    assert judgement.verdict == "review"


def test_sides_of_sound_sessions_are_not_exchanged(sided):
    """Also where the controller compensates too much, or nothing is left of the backlash."""
    for seed in range(10):
        session = sided(seed)
        assert find_exchanged_sides(session) == ()
        trims = tuple(JointTrim(v + 10e-6) for v in BACKLASHES.values())
        plan = replace(session, compensation=trims)
        errors = draw_errors(plan.robot, ["*.offset"], seed=seed) | BACKLASHES
        assert find_exchanged_sides(simulate_session(plan, errors, seed=seed).session) == ()


def test_exchanged_sides_are_found_where_no_posture_is_read_from_both(sided):
    """With a gauge of 1 µm, the readings of all postures together show the sign of the backlash."""
    session = sided(0).with_gauge(Gauge(1e-6, 1e-6))
    first = {r.setup: r for r in reversed(session.readings)}
    plan = replace(
        session,
        readings=tuple(
            replace(first[setup], posture=posture, conditions=Conditions(approach=3 * side))
            for (setup, posture), side in zip(
                product(session.setups, session.postures), cycle("pn"), strict=False
            )
        ),
    )
    for seed in range(2):
        errors = draw_errors(plan.robot, ["*"], seed=seed) | BACKLASHES
        sound = simulate_session(plan, errors, seed=seed).session
        assert find_exchanged_sides(sound) == ()
        exchanged = with_exchanged_sides(sound, list(sound.setups))
        assert [f.kind for f in check_session(exchanged).findings] == ["sides exchanged"]


def test_a_backlash_far_above_its_tolerance_is_reported(sided):
    session = sided(1)
    assert not _above_tolerances(identified(session, "full"))
    errors = draw_errors(session.robot, ["*"], seed=1) | BACKLASHES | {"x_slide.backlash": 120e-6}
    worn = simulate_session(session, errors, seed=1).session
    (finding,) = _above_tolerances(identified(worn, "full"))
    assert [p.parameter for p in finding.places] == ["x_slide.backlash"]
    assert finding.numbers["tolerance_mm"] == pytest.approx(0.04)  # of all Orthoglides
    assert finding.severity == "note"
