"""Effects of a machine's model that its readings do not show, or do not separate.

Effects a and b change readings alike if the columns of a, weighted by the covariance of the
readings under all other errors,

    V = σ² I + J P Jᵀ,  A = Wᵀ V⁻¹ W,

are nearly combinations of those of b: R² = A_ab A_bb⁻¹ A_ba / A_aa, as in a regression.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.assessment.effect_limits import find_limits
from orthocal.assessment.words import effects as words
from orthocal.calibration.assessment_record import Finding
from orthocal.effects.loading import (
    errors_of_no_model,
    measurable_effects,
    neutral_values,
)
from orthocal.hypotheses.linear_model import linear_model
from orthocal.observation.observations import drive_table
from orthocal.session.session import Conditions, Session

ALIKE = 0.95
"""Part R² of a parameter's information that another effect shares, from which on the readings do
not separate them: the standard deviation is more than four times as large as without the other."""

WARMER = 5.0
"""Change of the temperature at which a setup is supposed to be read again: that of a day, [K]."""

LEAST_INFORMATION = 1e-2
"""Information about a parameter, over that of its prior, below which readings do not show it."""


def find_unshown_effects(session: Session) -> list[Finding]:
    """Effects of the robot's model that its readings do not show, or do not separate.

    Raises:
        ClosureError: If the nominal machine cannot reach a posture.
    """
    if not measurable_effects(session.robot):
        return []
    findings = [*_unshown_backlash(session), *_unshown_expansion(session)]
    return [*findings, *_alike(session)] if len(session.readings) > 1 else findings


def _unshown_backlash(session: Session) -> Iterator[Finding]:
    """Drives that all readings approach from one side, or whose approach none states."""
    if "backlash" not in session.robot.effect_names:
        return
    stated = [r.approach for r in session.readings if r.approach is not None]
    if not stated:
        yield words.approach_not_stated()
        return
    names = list(session.postures)
    read = sorted({names.index(r.posture) for r in session.readings})
    distance = np.abs(drive_table(session)[read] - session.robot.drive_zero)
    one_sided = {
        drive.name: names[read[int(distance[:, i].argmax())]]
        for i, drive in enumerate(session.robot.drives)
        if len({letters[i] for letters in stated} - {"u"}) < 2
    }
    if one_sided:
        yield words.approached_from_one_side(one_sided)


def _unshown_expansion(session: Session) -> Iterator[Finding]:
    """Readings that were all taken at one temperature."""
    if "thermal" not in session.robot.effect_names:
        return
    stated = {r.conditions.temperature for r in session.readings if r.conditions} - {None}
    if len(stated) < 2:
        setup = session.readings[0].setup
        helps = _shows_expansion(_read_warmer(session, setup))
        yield words.one_temperature(next(iter(stated), None), setup if helps else "")


def _read_warmer(session: Session, setup: str) -> Session:
    """Session in which one setup is read once more, after the machine has become warmer."""
    reference = neutral_values(session.robot)["temperature"]
    readings = []
    for r in session.readings:
        known = r.conditions or Conditions()
        cool = reference if known.temperature is None else known.temperature
        readings.append(replace(r, conditions=replace(known, temperature=cool)))
        if r.setup == setup:
            warm = replace(known, temperature=cool + WARMER)
            readings.append(replace(r, conditions=warm))
    return replace(session, readings=tuple(readings), parts=(), sha256="")


def _shows_expansion(session: Session) -> bool:
    """True if readings determine coefficients of expansion, as a plan states it."""
    model = linear_model(session)
    limits = find_limits(model.problem, model.sigma)
    return any(limit.determined for limit in limits if limit.effect == "thermal")


def _alike(session: Session) -> Iterator[Finding]:
    """Parameters of effects that change the readings alike."""
    free = errors_of_no_model(session.robot)
    model = linear_model(session, free=free)
    about = model.at_reference(keep_jacobian=True)
    effects = {e.name: e for e in measurable_effects(session.robot)}
    members = _members(session, model.problem.free)
    every = [i for indices in members.values() for i in indices]
    columns, others = about.jacobian[:, every], np.delete(about.jacobian, every, axis=1)
    normal = others.T @ others + model.sigma**2 * np.eye(others.shape[1])
    white = columns - others @ np.linalg.solve(normal, others.T @ columns)
    information = columns.T @ white / model.sigma**2
    place = {i: k for k, i in enumerate(every)}
    seen = {
        name: np.array(
            [k for k in (place[i] for i in indices) if information[k, k] > LEAST_INFORMATION], int
        )
        for name, indices in members.items()
    }
    labels = [model.problem.free[i] for i in every]
    for one, other in combinations_with_replacement(seen, 2):
        alike = _explained(information, seen[one], seen[other], same=one == other)
        if alike:
            partners = sorted({labels[q] for _, q in alike} - {labels[p] for p, _ in alike})
            yield words.effects_alike(
                effects[one], effects[other], [labels[p] for p, _ in alike], partners
            )


def _members(session: Session, free: tuple[str, ...]) -> dict[str, list[int]]:
    """Places of the parameters of each effect among the free ones."""
    members: dict[str, list[int]] = {}
    for effect in measurable_effects(session.robot):
        names = {e.name for e in effect.errors}
        names |= {f"setup.{s}.{e.name}" for s in session.setups for e in effect.setup_errors}
        members[effect.name] = [i for i, name in enumerate(free) if name in names]
    return members


def _explained(
    information: Array, one: Indices, other: Indices, *, same: bool
) -> list[tuple[int, int]]:
    """Parameters of one effect that another explains, with the most similar one of that."""
    explained = []
    for p in one:
        among = other[other != p] if not same else other[other > p]
        if not among.size:
            continue
        shared = information[p, among]
        inverse = np.linalg.pinv(information[np.ix_(among, among)], hermitian=True)
        if shared @ inverse @ shared > ALIKE * information[p, p]:
            alone = shared**2 / np.diag(information)[among]
            explained.append((int(p), int(among[int(alone.argmax())])))
    return explained
