"""Conditions under which a machine is used: sides of approach, temperature, payload."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array
from orthocal.effects.loading import neutral_values, robot_effects
from orthocal.effects.protocol import Condition
from orthocal.errors import ParameterError
from orthocal.kinematics.error_map import error_map
from orthocal.robot.description import HEAVIEST_KG, HIGHEST_C, LOWEST_C
from orthocal.robot.model import Robot
from orthocal.text import shorten

APPROACH = {"p": 1.0, "n": -1.0, "u": 0.0}
"""Letter of an approach to the direction of the drive's last motion."""

CONDITION_OF: Mapping[str, Condition] = {
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
    def stated(self) -> tuple[str, ...]:
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
        used = used_conditions(robot)
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
        result = {c: np.array([v]) for c, v in neutral_values(robot).items()}
        result["approach"] = np.array([APPROACH[letter] for letter in self.approach or ""])
        if self.approach is None:
            result["approach"] = np.zeros(len(robot.drives))
        if self.temperature is not None:
            result["temperature"] = np.array([self.temperature])
        return result


def used_conditions(robot: Robot) -> Collection[str]:
    """Fields of `UseConditions` on which a robot's effects depend."""
    return [name for name, c in CONDITION_OF.items() if c in error_map(robot).conditions]


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
