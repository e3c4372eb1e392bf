"""A machine under its effects, as expressions: actual drive coordinates and placement twists."""

from __future__ import annotations

from collections.abc import Mapping

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


def neutral_conditions(robot: Robot) -> dict[Condition, ca.SX]:
    """Neutral values of all conditions, as constants."""
    values = neutral_values(robot)
    return {name: ca.SX([v] * condition_size(robot, name)) for name, v in values.items()}


def express_machine(
    robot: Robot,
    commanded: ca.SX,
    errors: Symbols,
    conditions: Mapping[Condition, ca.SX],
) -> tuple[ca.SX, dict[Placement, ca.SX]]:
    """Drives and placements of a robot with all its effects.

    Args:
        robot: The nominal robot.
        commanded: Commanded drive coordinates, shape (n_drives,), [m, rad].
        errors: All elementary errors by name, [SI].
        conditions: All conditions of the posture by name, in the units of `Condition`.

    Returns:
        Actual drive coordinates, shape (n_drives,), [m, rad]; and the placements on which effects
        act, mapped to their twist δ, shape (6,), [m, rad].

    Raises:
        OrthocalError: If an effect returns no expression, or one of another shape.
    """
    actuated = commanded
    twists: dict[Placement, ca.SX] = {}
    for effect in reversed(robot_effects(robot)):  # gain and offset of the drives act last
        parameters = {e.name: errors[e.name] for e in effect.errors}
        needed: Symbols = {name: conditions[name] for name in effect.conditions}
        source = type(effect).__qualname__
        changed = effect.drives(actuated, parameters, needed)
        actuated = require_expression(changed, len(robot.drives), f"{source}.drives")
        displacements = [effect.placements(parameters, needed)]
        for rod, change in effect.rods(parameters, needed).items():
            change = require_expression(change, 1, f"{source}.rods")
            displacements.append(stretch_rod(robot, robot.rods[rod], change))
        for displacement in displacements:
            for placement, twist in displacement.items():
                twist = require_expression(twist, 6, f"{source}.placements")
                add_twist(twists, placement, twist)
    return actuated, twists
