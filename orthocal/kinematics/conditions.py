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
"""Letters of an approach, mapped to the direction of the drive's last motion."""

ARROWS = {1.0: "↑", -1.0: "↓", 0.0: "·"}
"""Arrows by the direction in which the displayed number of a joint moves."""

UseCondition = Literal["approach", "temperature", "payload"]
"""Name of a field of `UseConditions`."""

CONDITION_OF: Mapping[UseCondition, Condition] = {
    "approach": "approach",
    "temperature": "temperature",
    "payload": "load",
}
"""Fields of `UseConditions`, mapped to the conditions on which effects depend."""


@dataclass(frozen=True, slots=True)
class UseConditions:
    """Conditions under which a machine is used.

    Args:
        approach: A letter for each drive in the robot's order: p if its coordinate grew in its last
            motion, n if it fell, u if unknown. Unknown means the middle of both sides and is the
            default of all drives.
        temperature: Temperature of the machine, [°C]; the reference of the effects by default.
        payload: Mass on the tool in addition to the platform, [kg].
    """

    approach: str | None = None
    temperature: float | None = None
    payload: float | None = None

    @property
    def stated(self) -> tuple[UseCondition, ...]:
        """Names of the fields that are stated."""
        return tuple(name for name in CONDITION_OF if getattr(self, name) is not None)

    def require_valid(self, robot: Robot, *, prefix: str = "conditions.") -> None:
        """Refuse conditions that are out of range or that affect nothing.

        Args:
            robot: The robot with its effects.
            prefix: Text before the name of a field in messages.

        Raises:
            ParameterError: If a condition is refused; names the field.
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
        """Values of the conditions, neutral where not stated. The load is always neutral."""
        result: dict[Condition, Array] = {
            c: np.full(condition_size(robot, c), v) for c, v in neutral_values(robot).items()
        }
        if self.approach is not None:
            result["approach"] = np.array([APPROACH[letter] for letter in self.approach])
        if self.temperature is not None:
            result["temperature"] = np.array([self.temperature])
        return result


@dataclass(frozen=True, slots=True, eq=False)
class UseSamples:
    """Equally likely conditions that represent how a machine is used.

    Each condition that varies has two values: both sides of a drive, or the middle of a range minus
    and plus its standard deviation. Their combinations follow orthogonal columns of a Hadamard
    matrix. Mean squares are therefore exact for errors that are linear in the conditions.
    """

    conditions: tuple[UseConditions, ...]
    """Conditions of each sample."""
    varying: tuple[UseCondition, ...] = ()
    """Names of the fields that vary; `approach` once for each drive with two sides."""
    signs: Array = field(default_factory=lambda: np.zeros((1, 0)))
    """Lower (-1) or upper (1) value of each varying condition, shape (n_samples, n_varying)."""
    declared: Use | None = None
    """Use that the samples represent; None for a single condition."""

    @property
    def size(self) -> int:
        """Number of samples."""
        return len(self.conditions)

    def changes(self, values: Array) -> dict[UseCondition, Array]:
        """Changes of a quantity by the conditions that vary.

        Args:
            values: The quantity at K points under each sample in turn, shape (n_samples K, ...).

        Returns:
            Fields of `UseConditions`, mapped to half the difference between both values, shape
            (n, K, ...). n is the number of drives with two sides for `approach`, else 1.
        """
        fields = values.reshape(self.size, -1, *values.shape[1:])
        halves = np.tensordot(self.signs.T, fields, axes=1) / self.size
        names = np.array(self.varying)
        return {name: halves[names == name] for name in dict.fromkeys(self.varying)}


def sample_use(robot: Robot, conditions: UseConditions | None = None) -> UseSamples:
    """Samples of the conditions of use on which the effects of a robot depend.

    Args:
        robot: The robot, whose YAML declares its use.
        conditions: Conditions that replace the declared ones. An unknown approach means both sides.
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
    # Hadamard matrix (Sylvester): the smallest with as many columns beside the constant first one
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
    """Use with stated conditions held constant."""
    if conditions is None:
        return use
    values: dict[str, Any] = {name: getattr(conditions, name) for name in conditions.stated}
    for name in values.keys() - {"approach"}:
        values[name] = (values[name], values[name])
    return replace(use, **values)


def effects_by_condition(robot: Robot) -> dict[UseCondition, tuple[str, ...]]:
    """Fields of `UseConditions` on which a machine depends, mapped to the names of the effects."""
    conditions, effects = error_map(robot).conditions, robot_effects(robot)
    return {
        name: tuple(effect.name for effect in effects if c in effect.conditions)
        for name, c in CONDITION_OF.items()
        if c in conditions
    }


class StatedUse(TypedDict):
    """Conditions of use on which a machine depends; None for the others."""

    approach: str | None
    """A letter for each drive: p or n for one side, u for both."""
    temperature: tuple[float, float] | None
    """Lowest and highest, [°C]."""
    payload: tuple[float, float] | None
    """Lightest and heaviest, [kg]."""


def stated_use(robot: Robot, use: Use | None = None) -> StatedUse | None:
    """Conditions of use, declared in the YAML by default; None if no effect depends on any."""
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
    """Message about an approach that is not one letter per drive; "" for a valid one."""
    text = text if isinstance(text, str) else repr(text)
    if len(text) == len(robot.drives) and not text.strip("".join(APPROACH)):
        return ""
    drives = ", ".join(d.name for d in robot.drives)
    meant = _letters_of_arrows(text, robot)
    meant = f" ('{meant}' for these arrows)" if meant else ""
    return (
        f"'{shorten(text)}'; expected {len(robot.drives)} letters{meant}, one for each drive "
        f"({drives}): p if its coordinate grew in its last motion, n if it fell, u if unknown"
    )


def _letters_of_arrows(text: str, robot: Robot) -> str:
    """Letters of an approach that is written in the arrows of the sheet; "" for other text."""
    signs = {arrow: sign for sign, arrow in ARROWS.items()}
    arrows = text * len(robot.drives) if len(text) == 1 else text
    if len(arrows) != len(robot.drives) or not set(arrows) <= signs.keys():
        return ""
    letters = {sign: letter for letter, sign in APPROACH.items()}
    moved = zip(arrows, robot.drives, strict=True)
    return "".join(letters[signs[arrow] * drive.direction] for arrow, drive in moved)


def require_range(value: float, low: float, high: float, unit: str, *, where: str) -> None:
    """Refuse a number outside a closed range.

    Raises:
        ParameterError: If the number is outside; names `where`.
    """
    if not low <= value <= high:
        raise ParameterError(
            f"found {value:g}; expected {unit} from {low:g} to {high:g}", where=where
        )
