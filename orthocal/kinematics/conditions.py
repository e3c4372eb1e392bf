"""Conditions under which a machine is used: sides of approach, temperature, payload."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypedDict

import numpy as np

from orthocal.arrays import Array
from orthocal.effects.loading import neutral_values, robot_effects
from orthocal.effects.protocol import Condition, condition_size
from orthocal.errors import ParameterError
from orthocal.kinematics.error_map import error_map
from orthocal.robot.description import HEAVIEST_KG, HIGHEST_C, LOWEST_C
from orthocal.robot.model import Robot, Use
from orthocal.text import shorten

APPROACH = {"p": 1.0, "n": -1.0, "u": 0.0}
"""Letter of an approach to the direction of the drive's last motion."""

UseCondition = Literal["approach", "temperature", "payload"]
"""Field of `UseConditions`."""

CONDITION_OF: Mapping[UseCondition, Condition] = {
    "approach": "approach",
    "temperature": "temperature",
    "payload": "load",
}
"""Field of `UseConditions` to the condition on which effects depend."""


@dataclass(frozen=True, slots=True)
class UseConditions:
    """Conditions under which a machine is used.

    Args:
        approach: A letter for each drive in the robot's order: p if its coordinate grew in its last
            motion, n if it fell, u if unknown, which is the middle of both sides; all are unknown
            by default.
        temperature: Temperature of the machine, [°C]; the effects' reference by default.
        payload: Mass on the tool beside the platform, [kg].
    """

    approach: str | None = None
    temperature: float | None = None
    payload: float | None = None

    @property
    def stated(self) -> tuple[UseCondition, ...]:
        """Names of the fields that are stated."""
        return tuple(name for name in CONDITION_OF if getattr(self, name) is not None)

    def require_valid(self, robot: Robot, *, prefix: str = "conditions.") -> None:
        """Refuse conditions that are out of range, or on which nothing depends.

        Args:
            robot: The robot with its effects.
            prefix: Text before the name of a field in messages.

        Raises:
            ParameterError: Naming the field.
        """
        used = effects_by_condition(robot)
        for name in self.stated:
            value, where = getattr(self, name), f"{prefix}{name}"
            if name == "approach":
                if problem := find_approach_problem(value, robot):
                    raise ParameterError(f"found {problem}", where=where)
            elif name == "temperature":
                require_range(value, LOWEST_C, HIGHEST_C, "degrees Celsius", where=where)
            else:
                require_range(value, 0.0, HEAVIEST_KG, "kilograms", where=where)
            if name not in used:
                effects = ", ".join(robot.effect_names) or "none"
                raise ParameterError(
                    f"found {value}; no effect of the machine depends on it (effects: {effects})",
                    where=where,
                )

    def values(self, robot: Robot) -> dict[Condition, Array]:
        """Values of the conditions except the load, neutral where not stated."""
        neutral = neutral_values(robot).items()
        result: dict[Condition, Array] = {
            c: np.full(condition_size(robot, c), v) for c, v in neutral
        }
        if self.approach is not None:
            result["approach"] = np.array([APPROACH[letter] for letter in self.approach])
        if self.temperature is not None:
            result["temperature"] = np.array([self.temperature])
        return result


@dataclass(frozen=True, slots=True, eq=False)
class UseSamples:
    """Equally likely conditions that represent how a machine is used.

    Each condition that varies has two values: both sides of a drive, or the middle of a range less
    and plus its standard deviation. The combinations are orthogonal columns of a Hadamard matrix,
    so that mean squares are exact for errors that are linear in the conditions.
    """

    conditions: tuple[UseConditions, ...]
    varying: tuple[UseCondition, ...] = ()
    """Field of `UseConditions` of each condition that varies; approach once for each such drive."""
    signs: Array = field(default_factory=lambda: np.zeros((1, 0)))
    """-1 and 1 for their values, shape (n_samples, n_varying)."""
    declared: Use | None = None
    """What the robot's YAML states, if they represent that."""

    @property
    def size(self) -> int:
        """Number of samples."""
        return len(self.conditions)

    def changes(self, values: Array) -> dict[UseCondition, Array]:
        """Changes of a field by the conditions that vary.

        Args:
            values: Fields of all samples in turn, shape (n_samples K, ...).

        Returns:
            Field of `UseConditions` to half the difference of its two values, one for each drive
            with two sides of approach, shape (n, K, ...).
        """
        fields = values.reshape(self.size, -1, *values.shape[1:])
        halves = np.tensordot(self.signs.T, fields, axes=1) / self.size
        names = np.array(self.varying)
        return {name: halves[names == name] for name in dict.fromkeys(self.varying)}


def sample_use(robot: Robot, conditions: UseConditions | None = None) -> UseSamples:
    """Conditions of use that the robot's YAML states, as far as its effects depend on them.

    Args:
        robot: The robot.
        conditions: Conditions that replace those of the YAML; an approach that is unknown is from
            both sides.
    """
    use, used = _narrow(robot.use, conditions), effects_by_condition(robot)
    varying, widths = list[UseCondition](), dict[UseCondition, float]()
    if "approach" in used:
        varying += ["approach"] * use.approach.count("u")
    ranges: tuple[UseCondition, ...] = ("temperature", "payload")
    for name in ranges:
        low, high = getattr(use, name) or (0.0, 0.0)
        if name in used and low < high:
            varying.append(name)
            widths[name] = (high - low) / np.sqrt(12.0)
    size = 1 << len(varying).bit_length() if varying else 1
    columns = range(1, len(varying) + 1)
    parity = [[(i & j).bit_count() % 2 for j in columns] for i in range(size)]
    signs = 1.0 - 2.0 * np.array(parity, dtype=np.float64).reshape(size, len(varying))
    samples = []
    for row in signs:
        stated: dict[str, Any] = {}
        if "approach" in used:
            sides = iter("p" if sign > 0.0 else "n" for sign in row)
            stated["approach"] = "".join(next(sides) if c == "u" else c for c in use.approach)
        for name in ranges:
            limits = getattr(use, name)
            if name in used and limits is not None:
                sign = row[varying.index(name)] if name in widths else 0.0
                stated[name] = float(np.mean(limits) + sign * widths.get(name, 0.0))
        samples.append(UseConditions(**stated))
    return UseSamples(tuple(samples), tuple(varying), signs, use)


def _narrow(use: Use, conditions: UseConditions | None) -> Use:
    """Use in which stated conditions do not vary."""
    if conditions is None:
        return use
    values: dict[str, Any] = {name: getattr(conditions, name) for name in conditions.stated}
    for name in values.keys() - {"approach"}:
        values[name] = (values[name], values[name])
    return replace(use, **values)


def effects_by_condition(robot: Robot) -> dict[UseCondition, tuple[str, ...]]:
    """Fields of `UseConditions` on which a machine depends, with the effects that need each."""
    conditions, effects = error_map(robot).conditions, robot_effects(robot)
    return {
        name: tuple(effect.name for effect in effects if c in effect.conditions)
        for name, c in CONDITION_OF.items()
        if c in conditions
    }


class StatedUse(TypedDict):
    """Conditions of use on which a machine depends; None for others."""

    approach: str | None
    """A letter for each drive: p or n for one side, u for both."""
    temperature: tuple[float, float] | None
    """Lowest and highest, [°C]."""
    payload: tuple[float, float] | None
    """Lightest and heaviest, [kg]."""


def stated_use(robot: Robot, use: Use | None = None) -> StatedUse | None:
    """Conditions of use, by default of a robot's YAML; None if no effect depends on any."""
    use, effects = use or robot.use, effects_by_condition(robot)
    if not effects:
        return None
    reference = neutral_values(robot)["temperature"]
    temperature = use.temperature or (reference, reference)
    return StatedUse(
        approach=use.approach if "approach" in effects else None,
        temperature=temperature if "temperature" in effects else None,
        payload=use.payload if "payload" in effects else None,
    )


def find_approach_problem(text: str, robot: Robot) -> str:
    """The text and what was expected, if it is not a letter for each drive; else ""."""
    if len(text) == len(robot.drives) and not text.strip("".join(APPROACH)):
        return ""
    drives = ", ".join(d.name for d in robot.drives)
    return (
        f"'{shorten(text)}'; expected {len(robot.drives)} letters, one for each drive ({drives}): "
        "p if its coordinate grew in its last motion, n if it fell, u if unknown"
    )


def require_range(value: float, low: float, high: float, unit: str, *, where: str) -> None:
    """Refuse a number outside a closed range.

    Raises:
        ParameterError: At `where`.
    """
    if not low <= value <= high:
        raise ParameterError(
            f"found {value:g}; expected {unit} from {low:g} to {high:g}", where=where
        )


def tool_force(robot: Robot, payload: float) -> Array:
    """Force of all effects on the tool centre point, shape (3,), [N]."""
    forces = [effect.tool_force(payload) for effect in robot_effects(robot)]
    return np.asarray(np.sum(forces, axis=0))
