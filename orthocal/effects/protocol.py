"""Protocol of an effect: its parameters with priors, how it acts, the conditions it needs.

Each effect is one file. It reads its own keys of the robot's YAML and returns CasADi expressions of
its parameters and of the conditions of a reading. All derivatives come from these expressions, and
the same expressions serve the predicted readings, the loop closures and the program for Ipopt.

An effect may act on the coordinate of a drive (backlash, periodic errors of screws), on the length
of a rod (thermal expansion, compliance), on a placement (geometry) and on a reading (drift of a
gauge).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

import casadi as ca
import numpy as np
from pydantic import BaseModel, ConfigDict

from orthocal.arrays import Array
from orthocal.robot.frames import Placement as Placement
from orthocal.robot.model import Robot
from orthocal.robot.parameters import ElementaryError

Symbols = Mapping[str, ca.SX]
"""Names to expressions."""

Condition = Literal[
    "approach", "temperature", "time", "load", "adjustment", "coordinates", "reference"
]
"""Condition of a reading: the direction of each drive's last motion, shape (n_drives,), 1 where its
coordinate grew, -1 where it fell, 0 if unknown; the temperature, [°C]; the time since the first
reading of the setup, [s]; the axial force of each rod under the weight on the tool, tension
positive, shape (n_rods,), [N], which is computed from the posture and the payload; the amounts by
which the machine was adjusted otherwise than it is at last, shape (n_adjustments,), [m]; the
commanded coordinates of the drives, shape (n_drives,), [m, rad], for placements that change along
the travel; the same in the reference posture of the setup, which replace them where a gauge is
mounted."""

NEUTRAL: dict[Condition, float] = {
    "approach": 0.0,
    "temperature": 20.0,
    "time": 0.0,
    "load": 0.0,
    "adjustment": 0.0,
    "coordinates": 0.0,
    "reference": 0.0,
}
"""Value of a condition that is not stated. The temperature is that of ISO 1. Without a load a
machine is weightless, as in the controller's nominal kinematics. Coordinates that are not stated
are those of the command."""


def condition_size(robot: Robot, name: Condition) -> int:
    """Numbers of a condition."""
    sizes = {
        "approach": len(robot.drives),
        "load": len(robot.rods),
        "adjustment": len(robot.declared.adjustments),
        "coordinates": len(robot.drives),
        "reference": len(robot.drives),
    }
    return sizes.get(name, 1)


class EffectKeys(BaseModel):
    """Keys of an effect in the robot's YAML, under `orthocal.effects.<name>`."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class Effect:
    """A systematic effect; those methods that do not apply are inherited.

    In expressions `errors` maps the names of the effect's parameters, and `conditions` those of the
    conditions that it needs.
    """

    name: ClassVar[str]
    """Key under `orthocal.effects`."""
    keys: ClassVar[type[EffectKeys]] = EffectKeys
    conditions: ClassVar[tuple[Condition, ...]] = ()
    """Conditions of a reading that its expressions depend on."""

    errors: tuple[ElementaryError, ...] = ()
    """Parameters of the machine, 0 for the nominal machine, with their tolerances. Those that are
    `complete` are identified with every model."""
    setup_errors: tuple[ElementaryError, ...] = ()
    """Parameters of each setup; the name of the setup comes before theirs."""
    period: float | None = None
    """Travel of a drive after which its errors repeat, [m]: readings at multiples of it show none
    of their variation."""

    @classmethod
    def from_keys(cls, keys: Any, robot: Robot) -> Self:  # noqa: ANN401 - an instance of `keys`
        """The effect of a robot.

        Args:
            keys: Validated keys.
            robot: The robot, without error parameters.

        Raises:
            OrthocalError: If a key does not fit the robot; its `where` is the key.
        """
        raise NotImplementedError

    @property
    def neutral(self) -> Mapping[Condition, float]:
        """Values of conditions that are not stated, where they are others than in NEUTRAL."""
        return {}

    def describe(self) -> str:
        """Description in a few words."""
        raise NotImplementedError

    def drives(self, coordinates: ca.SX, errors: Symbols, conditions: Symbols) -> ca.SX:
        """Actual drive coordinates.

        Args:
            coordinates: Commanded coordinates, shape (n_drives,), [m, rad], after those effects
                that the robot's YAML names later. Gain and offset of the drives act last.
            errors: The effect's parameters.
            conditions: The conditions that it needs.

        Returns:
            Shape (n_drives,), [m, rad].
        """
        return coordinates

    def placements(self, errors: Symbols, conditions: Symbols) -> Mapping[Placement, ca.SX]:
        """Twists δ of placements, shape (6,) each, [m, rad]; effects on one placement add up.

        A placement that changes along the travel of a drive, such as that of a slide whose guide is
        not straight, depends on the condition `coordinates`.
        """
        return {}

    def rods(self, errors: Symbols, conditions: Symbols) -> Mapping[tuple[str, str], ca.SX]:
        """Leg and rod to the change of the rod's length, [m]; effects on one rod add up."""
        return {}

    def tool_force(self, payload: float) -> Array:
        """Force on the tool centre point, from which the condition `load` is computed.

        Args:
            payload: Mass on the tool beside the platform, [kg].

        Returns:
            In the world, shape (3,), [N]; forces of several effects add up.
        """
        return np.zeros(3)

    def reading(self, reading: ca.SX, errors: Symbols, conditions: Symbols) -> ca.SX:
        """Reading of the gauge.

        Args:
            reading: Reading after the preceding effects, [m]; that of the sensor for the first.
            errors: The effect's parameters of the setup (`setup_errors`).
            conditions: The conditions that it needs.

        Returns:
            [m].
        """
        return reading
