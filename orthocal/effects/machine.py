"""A machine under its effects, as expressions: actual drive coordinates and placement twists."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from orthocal.effects.loading import neutral_values, robot_effects
from orthocal.effects.protocol import Condition, Placement, Symbols, condition_size
from orthocal.effects.rods import stretch_rod
from orthocal.robot.model import Robot


@dataclass(frozen=True, slots=True, eq=False)
class MachineExpressions:
    """Drives and placements of a machine as expressions of errors, commands and conditions."""

    actuated: ca.SX
    """Actual drive coordinates, shape (n_drives,), [m, rad]."""
    twists: Mapping[Placement, ca.SX]
    """Twist δ of each placement that effects act on, shape (6,), [m, rad]."""


def neutral_conditions(robot: Robot) -> dict[Condition, ca.SX]:
    """Conditions that are not stated, as constants."""
    values = neutral_values(robot)
    return {name: ca.SX([v] * condition_size(robot, name)) for name, v in values.items()}


def express_machine(
    robot: Robot,
    commanded: ca.SX,
    errors: Mapping[str, ca.SX | float],
    conditions: Mapping[Condition, ca.SX] | None = None,
) -> MachineExpressions:
    """Drives and placements of a robot under all of its effects.

    Args:
        robot: The nominal robot.
        commanded: Commanded drive coordinates, shape (n_drives,), [m, rad].
        errors: Parameter name to expression or number, [unit of the parameter]; 0 where absent.
        conditions: Conditions of the posture; neutral where absent.
    """
    elementary: dict[str, ca.SX] = dict.fromkeys(robot.parameters.elementary, ca.SX(1, 1))
    for name, value in errors.items():
        for term, coefficient in robot.parameters[name].terms:
            elementary[term] = elementary[term] + coefficient * value
    known = {**neutral_conditions(robot), "coordinates": commanded, **(conditions or {})}
    actuated, twists = commanded, dict[Placement, ca.SX]()
    for effect in reversed(robot_effects(robot)):  # the drive's gain and offset act last
        of_effect = {e.name: elementary[e.name] for e in effect.errors}
        needed: Symbols = {name: known[name] for name in effect.conditions}
        actuated = effect.drives(actuated, of_effect, needed)
        changes = [effect.placements(of_effect, needed)]
        for rod, change in effect.rods(of_effect, needed).items():
            changes.append(stretch_rod(robot, robot.rods[rod], change))
        for placement, twist in (item for part in changes for item in part.items()):
            before = twists.get(placement)
            twists[placement] = twist if before is None else before + twist
    return MachineExpressions(actuated, twists)
