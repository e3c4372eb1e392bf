"""Systematic effects that the readings show but the machine's model lacks.

Each effect states its parameters and their priors (`linearise_effect`). So effects of
other packages are tested like those of orthocal. Effects of the model are not tested.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np

from orthocal.arrays import Indices
from orthocal.effects.loading import identified_effects, with_effects
from orthocal.effects.registry import effect_names, find_effect, order_effects
from orthocal.errors import RobotError
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.selection import select_parameters
from orthocal.hypotheses.anomaly import EFFECT_KINDS, Explanation
from orthocal.hypotheses.hypothesis import Family, Rows, SystematicEffect, group_rows
from orthocal.hypotheses.linear_model import CACHE_SIZE, LinearModel
from orthocal.observation.observations import readings_without
from orthocal.session.session import Session

MIN_READINGS = 4
"""Fewest readings of a setup in which a drift differs from an outlier."""

MIN_RELATIVE_CHANGE = 1e-3
"""Smallest change of the readings by one prior std of a considered parameter, relative to the
noise."""


def missing_effects(session: Session) -> tuple[str, ...]:
    """Names of the effects with parameters that the robot's YAML allows but its model lacks."""
    present, names = session.robot.effect_names, []
    for name in order_effects(effect_names()):
        if name in present:
            continue
        try:
            robot = with_effects(session.robot, (*present, name))
        except RobotError:  # the YAML lacks one of its keys, or a package is broken
            continue
        if any(e.name == name for e in identified_effects(robot)):
            names.append(name)
    return tuple(names)


def rows_without(session: Session, name: str) -> Indices:
    """Rows without a condition that an effect needs."""
    effect = find_effect(name, where="effects", error=RobotError)
    lacking = {id(r) for c in effect.conditions for r in readings_without(session, c)}
    return np.flatnonzero([id(r) in lacking for r in session.readings])


@lru_cache(maxsize=CACHE_SIZE)
def find_effects(model: LinearModel) -> tuple[SystematicEffect, ...]:
    """Effects that the model lacks but the readings of a session could show.

    They are linearised and have only their visible parameters.
    """
    session, effects = model.problem.session, []
    for name in missing_effects(session):
        lacking = rows_without(session, name)
        if lacking.size == len(session.readings):
            continue
        effect = linearise_effect(model, name)
        visible = np.abs(effect.columns).max(axis=1) > MIN_RELATIVE_CHANGE * model.sigma
        if lacking.size:  # only parameters of setups whose rows all state the conditions
            visible &= ~effect.columns[:, lacking].any(axis=1)
            visible &= [p.name.startswith("setup.") for p in effect.parameters]
        if visible.any():
            effects.append(effect.select(visible))
    return tuple(effects)


def linearise_effect(model: LinearModel, name: str) -> SystematicEffect:
    """Linearised change of the rows by an effect that the robot's model lacks.

    The point of linearisation is the nominal machine.

    Args:
        model: The linearised model.
        name: Name of the effect.

    Raises:
        RobotError: If the effect needs keys that the robot's YAML lacks.
    """
    session, o = model.problem.session, model.problem.observations
    robot = session.robot
    other = session.with_effects((*robot.effect_names, name))
    parameters = other.robot.parameters
    errors = [n for n in parameters.names if n not in robot.parameters]
    offsets = [model.problem.free[i] for i in model.offsets.values()]
    selection = select_parameters(parameters, free=[*offsets, *errors], prior=True)
    problem = CalibrationProblem(other, selection)
    reading, jacobian = problem.predict_and_jacobian(problem.active_theta)
    nominal = model.problem.predict(model.problem.active_theta) * model.problem.noise_ratio
    present = set(model.problem.free) | set(offsets)
    new = [i for i, n in enumerate(problem.free) if n not in present]
    return SystematicEffect(
        name,
        tuple(problem.parameters[i] for i in new),
        o.rows(reading - nominal),
        o.rows(jacobian[:, new]).T,
    )


def unmodelled_effects(rows: Rows, effects: Sequence[SystematicEffect]) -> Iterator[Family]:
    """Effects with all their parameters, and drifts of single setups.

    Args:
        rows: The rows.
        effects: The effects, as from `find_effects`.
    """
    for effect in effects:
        if effect.name == "drift":
            yield _drifts(rows, effect)
        concerned = np.flatnonzero(effect.change.astype(bool) | effect.columns.any(axis=0))
        setups = tuple(dict.fromkeys(rows.session.readings[i].setup for i in concerned))
        kind = EFFECT_KINDS.get(effect.name, "other effect")
        e = Explanation(kind, "session", tuple(concerned.tolist()), setups, effect=effect.name)
        yield Family.of([e], systematic=[effect])


def _drifts(rows: Rows, effect: SystematicEffect) -> Family:
    """Drift of each setup by an unknown amount, and one common drift of all setups."""
    session, explanations, ramps = rows.session, [], []
    of_setup = group_rows(r.setup for r in session.readings)
    for column in effect.columns:
        setup = session.readings[int(np.abs(column).argmax())].setup
        if of_setup[setup].size >= MIN_READINGS:
            explanations.append(
                Explanation("drift", "setup", tuple(of_setup[setup].tolist()), (setup,))
            )
            ramp = column[of_setup[setup]]
            ramps.append(ramp / np.ptp(ramp))
    if len(explanations) > 1:
        concerned = tuple(i for e in explanations for i in e.rows)
        names = tuple(e.setups[0] for e in explanations)
        explanations.append(Explanation("drift", "session", concerned, names))
        ramps.append(np.concatenate(ramps))
    return Family.with_effects(rows, explanations, ramps)
