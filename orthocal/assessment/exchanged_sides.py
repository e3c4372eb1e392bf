"""Sides of approach that were exchanged in the readings: p instead of n.

A backlash is at least 0 and the same in all setups. Exchanged sides change the sign of its effect.
So the evidence of the readings is compared with and without the exchange,

    y = h(θ) + S B b + z + n,  b ≥ 0,

with the effect B of the backlashes b on the readings as stated, and the signs S of the setups.
All errors θ, the gauge zeros z and the tolerance scale are integrated out (`recommendation`). The
search for anomalies does not see this mistake, because its model allows negative backlashes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import replace

import numpy as np

from orthocal.assessment.recommendation import weigh_scales
from orthocal.assessment.wording import lines_in_file
from orthocal.assessment.words import plausibility as words
from orthocal.assessment.words.anomalies import MAX_PLACES, place_of
from orthocal.calibration.assessment_record import Finding
from orthocal.hypotheses.anomaly import Anomalies
from orthocal.hypotheses.family_scores import N_FAMILIES, SIMILAR_LOG_BAYES
from orthocal.hypotheses.likelihood import (
    SCALE_NODES,
    TOLERANCE_SCALE_SPREAD,
    build_likelihood,
    log_normal,
    log_of_sum,
)
from orthocal.hypotheses.linear_model import linear_model
from orthocal.hypotheses.search import find_anomalies
from orthocal.measurement.joining import split_sessions
from orthocal.session.session import Session

EXCHANGED_EVIDENCE = 10.0
"""ln evidence above which the sides of approach of a setup are exchanged."""

OTHER_SIDE = str.maketrans("pn", "np")
"""Letters of the other sides of approach."""

EQUAL_EVIDENCE = 1.5
"""Difference of ln evidence up to which two explanations are equally good."""


def weigh_exchanged_sides(
    session: Session, anomalies: Anomalies
) -> tuple[Anomalies, tuple[Finding, ...]]:
    """Anomalies beside exchanged sides of approach, and findings about these sides.

    Sides that were exchanged in one of several joined sessions look like a change between them. So
    anomalies are compared with those of the session with the right sides. The more likely ones
    count; findings about both are returned if they are nearly equally likely.

    Args:
        session: A session, or several joined ones.
        anomalies: Anomalies of its readings with the stated sides.

    Raises:
        ClosureError: If the machine cannot reach a posture.
        RobotError: If closures of the robot depend on each other.
    """
    findings = find_exchanged_sides(session)
    if not findings or (anomalies.explained and not anomalies.found):
        return anomalies, findings
    right = find_anomalies(exchange_sides(session, {p.setup for f in findings for p in f.places}))
    choices = N_FAMILIES * (1 + 2 * len(session.setups))
    log_odds = right.log_posterior - float(np.log(choices)) - anomalies.log_posterior
    if log_odds < -SIMILAR_LOG_BAYES:
        return anomalies, ()
    return (right if log_odds > SIMILAR_LOG_BAYES else anomalies), findings


def exchange_sides(session: Session, setups: Collection[str | None]) -> Session:
    """Session with the other side of approach in all readings of some setups."""
    readings = tuple(
        replace(r, conditions=replace(r.conditions, approach=r.approach.translate(OTHER_SIDE)))
        if r.setup in setups and r.approach and r.conditions
        else r
        for r in session.readings
    )
    return replace(session, readings=readings)


def find_exchanged_sides(session: Session) -> tuple[Finding, ...]:
    """Findings about setups whose readings show a backlash only with exchanged sides of approach.

    The sides of all setups, of one, or of all but one may be exchanged. If several agree equally
    with the readings, all setups are named, otherwise as few as possible.
    """
    findings = []
    for part in split_sessions(session):
        exchanged = _find_exchanged(part)
        rows = [i for i, r in enumerate(part.readings) if r.setup in exchanged and r.approach]
        if rows:
            findings.append(
                words.exchanged_sides(
                    lines_in_file([part.readings[i] for i in rows]),
                    exchanged,
                    [place_of(part, i) for i in rows[:MAX_PLACES]],
                )
            )
    return tuple(findings)


def _find_exchanged(session: Session) -> list[str]:
    """Setups whose sides are exchanged."""
    names = list(dict.fromkeys(r.setup for r in session.readings))
    sides = {name: {r.approach for r in session.readings if r.setup == name} for name in names}
    two_sided = [name for name in names if len(sides[name] - {None}) > 1]
    log_evidence = _evidence_of_exchange(session) if two_sided else None
    if log_evidence is None:
        return []
    every = frozenset(names)
    choices = [every, *(frozenset([n]) for n in two_sided), *(every - {n} for n in two_sided)]
    evidence = {exchanged: log_evidence(exchanged) for exchanged in choices}
    largest = max(evidence.values())
    if largest < log_evidence(frozenset()) + EXCHANGED_EVIDENCE:
        return []
    agreeing = [e for e, value in evidence.items() if value > largest - EQUAL_EVIDENCE]
    best = every if every in agreeing else min(agreeing, key=len)
    return [name for name in two_sided if name in best]


def _evidence_of_exchange(session: Session) -> Callable[[Iterable[str]], float] | None:
    """Function from setups with exchanged sides to the ln evidence of the readings.

    None if the model of the machine has no backlash.
    """
    model = linear_model(session)
    problem = model.problem
    backlashes = [f"{d.name}.backlash" for d in session.robot.drives]
    if not set(backlashes) <= set(problem.free):
        return None
    columns = [problem.free.index(name) for name in backlashes]
    about = model.most_likely(session.values)
    stated = about.likelihood
    jacobian = (stated.directions.T * stated.singular_values) @ stated.errors.T
    setup_of_entry = np.array(list(session.setups))[problem.observations.setup]

    def log_evidence(exchanged: Iterable[str]) -> float:
        signed = jacobian.copy()
        rows = np.flatnonzero(np.isin(setup_of_entry, list(exchanged)))
        signed[np.ix_(rows, np.array(columns))] *= -1.0
        likelihood = build_likelihood(signed, sigma=model.sigma, dof=model.dof, stated=model.stated)
        exchange = replace(about, likelihood=likelihood)
        by_scale = weigh_scales(model, exchange, session.values, SCALE_NODES)
        return float(log_of_sum(by_scale + log_normal(SCALE_NODES, TOLERANCE_SCALE_SPREAD)))

    return log_evidence
