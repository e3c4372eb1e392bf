"""A machine under its effects, as expressions: actual drive coordinates and placement twists."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from orthocal.effects.loading import neutral_values, robot_effects
from orthocal.effects.protocol import (
    Condition,
    Placement,
    Symbols,
    add_twist,
    condition_size,
    require_expression,
)
from orthocal.effects.rods import stretch_rod
from orthocal.robot.model import Robot


@dataclass(frozen=True, slots=True, eq=False)
class MachineExpressions:
    """Drives and placements of a machine as expressions of errors, commands and conditions."""

    actuated: ca.SX
    """Actual drive coordinates, shape (n_drives,), [m, rad]."""
    twists: Mapping[Placement, ca.SX]
    """Placements on which effects act, mapped to their twist δ, shape (6,), [m, rad]."""


def neutral_conditions(robot: Robot) -> dict[Condition, ca.SX]:
    """Neutral values of all conditions, as constants."""
    values = neutral_values(robot)
    return {name: ca.SX([v] * condition_size(robot, name)) for name, v in values.items()}


def express_machine(
    robot: Robot,
    commanded: ca.SX,
    errors: Mapping[str, ca.SX | float],
    conditions: Mapping[Condition, ca.SX] | None = None,
) -> MachineExpressions:
    """Drives and placements of a robot with all its effects.

    Args:
        robot: The nominal robot.
        commanded: Commanded drive coordinates, shape (n_drives,), [m, rad].
        errors: Names of parameters, mapped to expressions or numbers, [unit of the parameter]; 0
            where absent.
        conditions: Conditions of the posture; neutral where absent.
    """
    elementary: dict[str, ca.SX] = dict.fromkeys(robot.parameters.elementary, ca.SX(1, 1))
    for name, value in errors.items():
        for term, coefficient in robot.parameters[name].terms:
            part = value if coefficient == 1.0 else coefficient * value  # a product costs time
            elementary[term] = elementary[term] + part
    stated = {**neutral_conditions(robot), "coordinates": commanded, **(conditions or {})}
    actuated, twists = commanded, dict[Placement, ca.SX]()
    for effect in reversed(robot_effects(robot)):  # gain and offset of the drives act last
        parameters = {e.name: elementary[e.name] for e in effect.errors}
        needed: Symbols = {name: stated[name] for name in effect.conditions}
        source = type(effect).__qualname__
        moved = effect.drives(actuated, parameters, needed)
        actuated = require_expression(moved, len(robot.drives), f"{source}.drives")
        displacements = [effect.placements(parameters, needed)]
        for rod, change in effect.rods(parameters, needed).items():
            change = require_expression(change, 1, f"{source}.rods")
            displacements.append(stretch_rod(robot, robot.rods[rod], change))
        for displacement in displacements:
            for placement, twist in displacement.items():
                twist = require_expression(twist, 6, f"{source}.placements")
                add_twist(twists, placement, twist)
    return MachineExpressions(actuated, twists)
