"""Changes of the rows of a session by effects, nuisance parameters and stated dimensions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from orthocal.arrays import Array
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.selection import select_parameters
from orthocal.hypotheses.hypothesis import SystematicEffect
from orthocal.hypotheses.linear_model import CACHE_SIZE, LinearModel
from orthocal.observation.model import predict_readings
from orthocal.sensors.protocol import DIMENSION_STEP, stated_dimensions
from orthocal.session.session import Setup


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


@lru_cache(maxsize=CACHE_SIZE)
def nuisance_columns(model: LinearModel) -> Array:
    """Change of the rows by one prior std of each nuisance parameter, [m].

    The shape is (n_nuisance, n_rows). The machine has no errors. Gauge zeros are not projected out.
    """
    problem = model.problem
    passive = model.at_reference(keep_jacobian=False).passive
    _, jacobian = problem.predict_and_jacobian(problem.active_theta, passive)
    columns = jacobian[:, problem.n_machine :] * problem.noise_ratio[:, None]
    return problem.observations.rows(columns).T


@lru_cache(maxsize=CACHE_SIZE)
def dimension_changes(model: LinearModel) -> Mapping[tuple[str, str], Mapping[str, Array]]:
    """Derivative of the rows with respect to each dimension that setups state.

    The machine has no errors.

    Returns:
        Key of the dimension and its stated value, to setup, to the derivative, shape (n_rows,).
    """
    session, o = model.problem.session, model.problem.observations
    setups = {r.setup: session.setups[r.setup] for r in session.readings}
    enlarged: dict[str, Setup] = {}
    dimensions: dict[str, tuple[str, str]] = {}
    for name, setup in setups.items():
        for key, sensor in stated_dimensions(setup.sensor).items():
            enlarged[name] = replace(setup, sensor=sensor)
            dimensions[name] = key, _stated_value(setup.sensor.to_keys(), key)
    if not enlarged:
        return {}
    other = replace(session, setups={**session.setups, **enlarged})
    passive = model.at_reference(keep_jacobian=False).passive
    stated, changed = (
        o.rows(predict_readings(s, observations=o, passive=passive)) for s in (session, other)
    )
    change = (changed - stated) / DIMENSION_STEP
    changes: dict[tuple[str, str], dict[str, Array]] = {}
    for name, dimension in dimensions.items():
        of_setup = [r.setup == name for r in session.readings]
        changes.setdefault(dimension, {})[name] = np.where(of_setup, change, 0.0)
    return changes


def _stated_value(keys: Mapping[str, Any], key: str) -> str:
    """Value of a key of a setup such as artefact.height_mm, as text."""
    first, _, others = key.partition(".")
    return _stated_value(keys[first], others) if others else f"{keys[first]:g}"
