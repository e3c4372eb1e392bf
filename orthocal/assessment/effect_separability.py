"""Effects of the robot's model that its readings do not show or do not separate.

With W the Jacobian of the readings with respect to the parameters of all effects, and V their
covariance from noise and all other errors, the information about the parameters is

    A = Wᵀ V⁻¹ W,  V = σ² I + J P Jᵀ.

A parameter a cannot be separated from parameters b if the coefficient of determination of a
regression, R² = A_ab A_bb⁻¹ A_ba / A_aa, is close to 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.assessment.effect_limits import find_limits, parameter_units
from orthocal.assessment.wording import lines_in_file
from orthocal.assessment.words import effects as words
from orthocal.calibration.assessment_record import Finding
from orthocal.effects.loading import (
    identified_effects,
    neutral_values,
)
from orthocal.hypotheses.linear_model import linear_model
from orthocal.observation.conditions import COLUMNS_OF_CONDITIONS
from orthocal.observation.observations import drive_table, readings_without
from orthocal.session.points import count_readings
from orthocal.session.session import Conditions, Session

MAX_R_SQUARED = 0.95
"""R² above which parameters are inseparable. The standard deviation is then more than four times as
large as without the other effect."""

WARMER = 5.0
"""Typical change of the temperature during a day, after which a setup is read again, [K]."""

MIN_INFORMATION = 1e-2
"""Information about a parameter, relative to that of its prior, below which it is not shown."""


def find_unshown_effects(session: Session) -> list[Finding]:
    """Findings about effects that the readings do not show or do not separate.

    Raises:
        ClosureError: If the nominal machine cannot reach a posture.
    """
    if not identified_effects(session.robot):
        return []
    findings = [
        *_incomplete_conditions(session),
        *_unshown_backlash(session),
        *_unshown_expansion(session),
    ]
    return [*findings, *_inseparable(session)] if len(session.readings) > 1 else findings


def _incomplete_conditions(session: Session) -> Iterator[Finding]:
    """Findings about readings without a condition that `calibrate` needs (`require_conditions`)."""
    explicit = session.robot.chosen_effects is not None
    for effect in identified_effects(session.robot):
        for condition in (c for c in COLUMNS_OF_CONDITIONS if c in effect.conditions):
            missing = readings_without(session, condition)
            if missing and (explicit or len(missing) < len(session.readings)):
                yield words.condition_incomplete(
                    effect,
                    condition,
                    lines_in_file(missing),
                    count_readings(session, missing),
                    count_readings(session),
                    two_postures=any(r.minus for r in missing),
                )


def _unshown_backlash(session: Session) -> Iterator[Finding]:
    """Finding about drives that all readings approach from one side, or without stated approach."""
    if "backlash" not in session.robot.effect_names:
        return
    approaches = {r.approach for r in session.readings}
    if approaches == {None}:
        if session.robot.chosen_effects is None:
            yield words.approach_not_stated()
        return
    names = list(session.postures)
    rows_read = sorted({names.index(r.posture) for r in session.readings})
    distance = np.abs(drive_table(session)[rows_read] - session.robot.drive_zero)
    one_sided = {
        drive.name: names[rows_read[int(distance[:, i].argmax())]]
        for i, drive in enumerate(session.robot.drives)
        if {a and a[i] for a in approaches} in ({"p"}, {"n"})
    }
    if one_sided:
        yield words.approached_from_one_side(one_sided, common=len(approaches) == 1)


def _unshown_expansion(session: Session) -> Iterator[Finding]:
    """Finding about readings that were all taken at one temperature, or state none."""
    if "thermal" not in session.robot.effect_names:
        return
    temperatures = {(r.conditions or Conditions()).temperature for r in session.readings}
    if len(temperatures) == 1 and not (temperatures == {None} and session.robot.chosen_effects):
        setup = session.readings[0].setup
        repeating_helps = _shows_expansion(_read_warmer(session, setup))
        yield words.one_temperature(temperatures.pop(), setup if repeating_helps else "")


def _read_warmer(session: Session, setup: str) -> Session:
    """Session in which one setup is read again after the temperature has risen."""
    reference = neutral_values(session.robot)["temperature"]
    readings = []
    for r in session.readings:
        conditions = r.conditions or Conditions()
        temperature = reference if conditions.temperature is None else conditions.temperature
        readings.append(replace(r, conditions=replace(conditions, temperature=temperature)))
        if r.setup == setup:
            warm = replace(conditions, temperature=temperature + WARMER)
            readings.append(replace(r, conditions=warm))
    return replace(session, readings=tuple(readings), parts=(), sha256="")


def _shows_expansion(session: Session) -> bool:
    """True if the readings determine coefficients of expansion by the criterion of a plan."""
    model = linear_model(session)
    limits = find_limits(model.problem, model.sigma)
    return any(limit.determined for limit in limits if limit.effect == "thermal")


def _inseparable(session: Session) -> Iterator[Finding]:
    """Findings about parameters of effects that are inseparable."""
    model = linear_model(session)
    linearisation = model.at_reference(keep_jacobian=True)
    effects = {e.name: e for e in identified_effects(session.robot)}
    members = {name: parameter_units(effect, session) for name, effect in effects.items()}
    free = list(enumerate(model.problem.free))
    effect_columns = [i for names in members.values() for i, n in free if n in names]
    labels = [model.problem.free[i] for i in effect_columns]
    effect_slopes = linearisation.jacobian[:, effect_columns]
    other_slopes = np.delete(linearisation.jacobian, effect_columns, axis=1)
    normal = other_slopes.T @ other_slopes + model.sigma**2 * np.eye(other_slopes.shape[1])
    whitened = effect_slopes - other_slopes @ np.linalg.solve(
        normal, other_slopes.T @ effect_slopes
    )
    information = effect_slopes.T @ whitened / model.sigma**2
    visible = np.diag(information) > MIN_INFORMATION
    shown = {
        name: np.array([k for k, n in enumerate(labels) if n in names and visible[k]], int)
        for name, names in members.items()
    }
    for one, other in combinations_with_replacement(shown, 2):
        pairs = _explained(information, shown[one], shown[other], same=one == other)
        if pairs:
            partners = sorted({labels[q] for _, q in pairs} - {labels[p] for p, _ in pairs})
            yield words.effects_alike(
                effects[one], effects[other], [labels[p] for p, _ in pairs], partners
            )


def _explained(
    information: Array, one: Indices, other: Indices, *, same: bool
) -> list[tuple[int, int]]:
    """Pairs of a parameter that another effect explains and the most similar one of that effect.

    Args:
        information: Matrix A of all parameters, shape (n, n).
        one: Parameters to explain.
        other: Parameters of the other effect.
        same: Whether both effects are the same one.
    """
    explained = []
    for p in one:
        candidates = other[other != p] if not same else other[other > p]
        if not candidates.size:
            continue
        shared = information[p, candidates]
        inverse = np.linalg.pinv(information[np.ix_(candidates, candidates)], hermitian=True)
        if shared @ inverse @ shared > MAX_R_SQUARED * information[p, p]:
            single_shares = shared**2 / np.diag(information)[candidates]
            explained.append((int(p), int(candidates[int(single_shares.argmax())])))
    return explained
