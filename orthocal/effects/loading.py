"""Loading of robots with their effects and error parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

from pydantic import Field

from orthocal.effects.adjustment import AdjustmentChanges, adjustment_parameters
from orthocal.effects.drive import DriveErrors, DriveTolerances
from orthocal.effects.geometry import GeometryErrors, GeometryTolerances
from orthocal.effects.protocol import NEUTRAL, Condition, Effect
from orthocal.effects.registry import effect_names, find_effect, order_effects
from orthocal.errors import OrthocalError, ParameterError, RobotError
from orthocal.io.documents import PositiveNumber, validate
from orthocal.robot.loading import MAX_LOADED, load_bare_content, load_bare_robot
from orthocal.robot.model import Robot
from orthocal.robot.parameters import (
    COMPLETE,
    ElementaryError,
    ParameterSet,
    build_parameters,
)
from orthocal.robot.redundant import find_redundant_errors

MODELS: Mapping[str, Sequence[str]] = {"offsets": ("*.offset",), "full": COMPLETE}
"""Models of a robot whose YAML does not define models with these names."""


class ToleranceKeys(GeometryTolerances, DriveTolerances):
    """Keys under `orthocal.tolerances`: ±2 prior standard deviations of each kind of error."""

    overrides: dict[str, PositiveNumber] = Field(default_factory=dict)
    """Names or globs of parameters with the unit as suffix, mapped to tolerances; later entries
    replace earlier ones."""


def load_robot(robot: str | Path, *, beside: Path | None = None) -> Robot:
    """Load a robot from its URDF and YAML, check them against each other and close its loops.

    Unchanged files give the same object again. Its arrays, legs and rods are read-only. Do not
    modify its Pinocchio `model`, but a copy.

    Args:
        robot: Name of a built-in robot, or path to a robot directory.
        beside: Directory to which a relative path refers; the working directory by default.

    Raises:
        RobotError: If the files do not describe a robot; names the file and the line or key.
    """
    return _add_loaded_parameters(load_bare_robot(robot, beside=beside))


def load_robot_content(
    name: str, content: Mapping[str, bytes], *, folder: Path | None = None
) -> Robot:
    """Load a robot from the content of its files, like `load_robot` from a directory.

    Args:
        name: Name of the robot.
        content: File names, mapped to contents: one URDF, one YAML, and meshes.
        folder: Directory from which the files were read; it need not exist any more.

    Raises:
        RobotError: If the files do not describe a robot; names NAME/FILE and the line or key.
    """
    return _add_loaded_parameters(load_bare_content(name, content, folder=folder))


def with_effects(robot: Robot, names: Sequence[str] | None) -> Robot:
    """Robot with chosen effects in addition to those of geometry and drives.

    Args:
        robot: The robot; tolerances that were stated for it remain.
        names: Names of the effects, in any order; None for those in its YAML. Effects that the
            YAML does not state have their default keys.

    Raises:
        ParameterError: If an effect does not exist, or a stated tolerance belongs to an effect that
            was not chosen.
        RobotError: If an effect needs keys that the robot's YAML lacks.
    """
    chosen = None if names is None else order_effects(names)
    if chosen == robot.chosen_effects:
        return robot
    existing = effect_names()
    for name in chosen or ():  # `robot_effects` would name the YAML as the source of the name
        if name not in existing:
            raise ParameterError(f"'{name}' is not an effect; effects: {', '.join(existing)}")
    return _choose_effects(robot, chosen)


@lru_cache(maxsize=4 * MAX_LOADED)
def _choose_effects(robot: Robot, chosen: tuple[str, ...] | None) -> Robot:
    """Robot with ordered names of effects, cached."""
    return _with_parameters(replace(robot, chosen_effects=chosen))


def with_adjustments(robot: Robot) -> Robot:
    """Robot whose placements depend on the mechanical adjustments of each session.

    Raises:
        RobotError: If an adjustment in its YAML does not fit the robot.
    """
    return robot if robot.adjusted else _with_parameters(replace(robot, adjusted=True))


def _with_parameters(robot: Robot) -> Robot:
    """Robot with the parameters of its present effects, and the tolerances stated before."""
    plain = replace(robot, parameters=ParameterSet())
    return _add_parameters(plain).with_tolerances(robot.parameters.stated)


@lru_cache(maxsize=MAX_LOADED)
def _add_loaded_parameters(robot: Robot) -> Robot:
    """`_add_parameters` of a robot of unchanged files, cached."""
    return _add_parameters(robot)


def _add_parameters(robot: Robot) -> Robot:
    """Robot with the error parameters of its effects.

    Raises:
        RobotError: If two effects have a parameter of the same name, or a sum, tolerance or model
            names a parameter that does not exist.
    """
    where, declared = f"{robot.yaml}: orthocal", robot.declared
    errors: dict[str, ElementaryError] = {}
    for effect in robot_effects(robot):
        for error in effect.errors:
            if errors.setdefault(error.name, error) is not error:
                raise RobotError(
                    f"its parameter '{error.name}' exists already",
                    where=f"{where}.effects.{effect.name}",
                )
    elementary = tuple(errors.values())
    try:
        parameters = build_parameters(
            elementary,
            sums=declared.parameters,
            overrides=_read_tolerances(robot).overrides,
            models=declared.models | {k: v for k, v in MODELS.items() if k not in declared.models},
            find_redundant=partial(find_redundant_errors, robot, elementary),
            further=adjustment_parameters(robot, errors),
        )
    except ParameterError as e:
        raise RobotError(str(e), where=where) from None
    return replace(robot, parameters=parameters)


@lru_cache(maxsize=2 * MAX_LOADED)
def robot_effects(robot: Robot) -> tuple[Effect, ...]:
    """Effects of a robot: drives, geometry, adjustments between sessions, then named effects.

    Raises:
        RobotError: If a tolerance is invalid, a named effect does not exist, or one of its keys is
            missing or invalid.
    """
    tolerances = _read_tolerances(robot)
    effects: list[Effect] = [
        DriveErrors.from_keys(tolerances, robot),
        GeometryErrors.from_keys(tolerances, robot),
        *([AdjustmentChanges.of_robot(robot)] if robot.adjusted else []),
    ]
    for name in order_effects(robot.effect_names):
        data, prefix = robot.declared.effects.get(name, {}), f"orthocal.effects.{name}"
        kind = find_effect(name, where=f"{robot.yaml}: {prefix}", error=RobotError)
        for key, field in kind.keys.model_fields.items():
            if field.is_required() and key not in data:
                raise RobotError(
                    f"is missing; the effect {name} needs it. Write `{name}: {{{key}: NUMBER}}` "
                    "under `orthocal: effects:`",
                    where=f"{robot.yaml}: {prefix}.{key}",
                )
        keys = validate(kind.keys, data, where=str(robot.yaml), error=RobotError, under=prefix)
        try:
            effects.append(kind.from_keys(keys, robot))
        except OrthocalError as e:
            key = ".".join(part for part in (prefix, e.where) if part)
            raise RobotError(e.problem, where=f"{robot.yaml}: {key}") from None
    return tuple(effects)


def identified_effects(robot: Robot) -> tuple[Effect, ...]:
    """Named effects of a robot with parameters; every model identifies them."""
    return tuple(
        e
        for e in robot_effects(robot)
        if e.name in robot.effect_names and (e.errors or e.setup_errors)
    )


def neutral_values(robot: Robot) -> dict[Condition, float]:
    """Values for conditions that are not stated; under them the effects change nothing."""
    values = dict(NEUTRAL)
    for effect in robot_effects(robot):
        values.update(effect.neutral)
    return values


def reading_effects(robot: Robot) -> tuple[Effect, ...]:
    """Effects of a robot that change the readings of gauges: those that override `reading`."""
    return tuple(e for e in robot_effects(robot) if type(e).reading is not Effect.reading)


def _read_tolerances(robot: Robot) -> ToleranceKeys:
    """Tolerances in the robot's YAML.

    Raises:
        RobotError: If a key or a value is invalid.
    """
    where, under, data = str(robot.yaml), "orthocal.tolerances", robot.declared.tolerances
    return validate(ToleranceKeys, data, where=where, error=RobotError, under=under)
