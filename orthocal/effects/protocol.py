"""Protocol of an effect: its parameters with priors, its expressions, the conditions it needs.

Each effect is one file. It reads its keys of the robot's YAML and returns CasADi expressions of its
parameters and of the conditions of a reading. Predicted readings, loop closures, the program for
Ipopt and all derivatives use these expressions.

An effect may act on

- the coordinate of a drive: backlash, periodic errors of screws
- the length of a rod: thermal expansion, compliance
- a placement: geometry
- a reading: drift of a gauge
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self, get_args

import casadi as ca
import numpy as np

from orthocal.arrays import Array
from orthocal.errors import OrthocalError
from orthocal.io.documents import Keys
from orthocal.robot.frames import Placement as Placement
from orthocal.robot.model import Robot
from orthocal.robot.parameters import ElementaryError

Symbols = Mapping[str, ca.SX]
"""Names of parameters or conditions, mapped to expressions."""

Condition = Literal[
    "approach", "temperature", "time", "load", "adjustment", "coordinates", "reference"
]
"""Condition of a reading.

- approach: direction of each drive's last motion, shape (n_drives,): 1 if its coordinate grew, -1
  if it fell, 0 if unknown
- temperature: [°C]
- time: time since the first reading of the setup, [s]
- load: axial force of each rod under the weight on the tool, tension positive, shape (n_rods,),
  [N]; computed from the posture and the payload
- adjustment: differences of the adjustments from their last amounts, shape (n_adjustments,), [m]
- coordinates: commanded coordinates of the drives, shape (n_drives,), [m, rad], for placements that
  change along the travel
- reference: commanded coordinates in the reference posture of the setup, which replace
  `coordinates` for the mounting of a gauge
"""

NEUTRAL: dict[Condition, float] = dict.fromkeys(get_args(Condition), 0.0) | {"temperature": 20.0}
"""Value of a condition that is not stated. The temperature is that of ISO 1. Without a load the
machine has no weight, as in the nominal kinematics of the controller. Coordinates that are not
stated are those of the command."""


def condition_size(robot: Robot, name: Condition) -> int:
    """Number of values of a condition, as in `Condition`."""
    sizes = {
        "approach": len(robot.drives),
        "load": len(robot.rods),
        "adjustment": len(robot.declared.adjustments),
        "coordinates": len(robot.drives),
        "reference": len(robot.drives),
    }
    return sizes.get(name, 1)


class EffectKeys(Keys):
    """Keys of an effect in the robot's YAML, under `orthocal.effects.<name>`."""


class Effect:
    """Systematic effect. A subclass overrides the methods that describe how it acts.

    In these methods `errors` maps the names of the effect's parameters to expressions, and
    `conditions` the names of the conditions that it needs.
    """

    name: ClassVar[str]
    """Key under `orthocal.effects`."""
    keys: ClassVar[type[EffectKeys]] = EffectKeys
    conditions: ClassVar[tuple[Condition, ...]] = ()
    """Conditions of a reading on which the effect's expressions depend."""

    errors: tuple[ElementaryError, ...] = ()
    """Parameters of the machine with their priors, 0 for the nominal machine. Every model
    identifies them."""
    setup_errors: tuple[ElementaryError, ...] = ()
    """Parameters of each setup with their priors: `drift` of setup yx becomes `setup.yx.drift`."""
    period: float | None = None
    """Travel of a drive after which the effect repeats, [m]; None if it is not periodic. Readings
    at multiples of the period cannot determine it."""

    @classmethod
    def from_keys(cls, keys: Any, robot: Robot) -> Self:  # noqa: ANN401 - an instance of `keys`
        """Build the effect for a robot.

        Args:
            keys: Validated keys.
            robot: The robot, without error parameters.

        Raises:
            OrthocalError: If a key does not fit the robot; names the key as `where`.
        """
        raise NotImplementedError

    @property
    def neutral(self) -> Mapping[Condition, float]:
        """Values of conditions that are not stated, if they differ from NEUTRAL."""
        return {}

    def describe(self) -> str:
        """Description in a few words."""
        raise NotImplementedError

    def drives(self, coordinates: ca.SX, errors: Symbols, conditions: Symbols) -> ca.SX:
        """Actual drive coordinates.

        Args:
            coordinates: Commanded coordinates, shape (n_drives,), [m, rad], changed by the effects
                that follow in the order of a machine. Gain and offset of the drives act last.
            errors: Parameters of the effect.
            conditions: Conditions that the effect needs.

        Returns:
            Shape (n_drives,), [m, rad].
        """
        return coordinates

    def placements(self, errors: Symbols, conditions: Symbols) -> Mapping[Placement, ca.SX]:
        """Twists δ of placements, shape (6,) each, [m, rad]; effects on one placement add up.

        A placement that changes along the travel of a drive depends on the condition `coordinates`.
        An example is a slide on a guide that is not straight.
        """
        return {}

    def rods(self, errors: Symbols, conditions: Symbols) -> Mapping[tuple[str, str], ca.SX]:
        """Changes of the lengths of rods by leg and rod, [m]; effects on one rod add up."""
        return {}

    def negligible_difference(self, condition: Condition, change: float) -> float:
        """Difference of a condition that changes no reading by more than an amount.

        Readings under such conditions repeat each other. By default only equal conditions do.

        Args:
            condition: Condition that the effect needs.
            change: Largest change of a reading, [m].

        Returns:
            In the unit of the condition.
        """
        return 0.0

    def tool_force(self, payload: float) -> Array:
        """Force on the tool centre point, from which the condition `load` is computed.

        Args:
            payload: Mass on the tool in addition to the platform, [kg].

        Returns:
            Force in the world frame, shape (3,), [N]; forces of several effects add up.
        """
        return np.zeros(3)

    def reading(self, reading: ca.SX, errors: Symbols, conditions: Symbols) -> ca.SX:
        """Reading of the gauge.

        Args:
            reading: Reading of the sensor with the preceding effects, [m].
            errors: Parameters of the effect for the setup (`setup_errors`).
            conditions: Conditions that the effect needs.

        Returns:
            Reading with this effect, [m].
        """
        return reading


def require_expression(value: object, rows: int, source: str) -> ca.SX:
    """Return value of a sensor's or effect's method, which must be a column of expressions.

    Args:
        value: The returned value.
        rows: Expected number of rows.
        source: The method, for the message.

    Raises:
        OrthocalError: If the value is no CasADi expression, or has another shape.
    """
    if isinstance(value, ca.SX) and value.shape == (rows, 1):
        return value
    found = f"the shape {value.shape}" if isinstance(value, ca.SX) else type(value).__name__
    raise OrthocalError(
        f"{source} returns {found}; expected an expression (casadi.SX) of shape ({rows}, 1)"
    )


def add_twist(twists: dict[Placement, ca.SX], placement: Placement, twist: ca.SX) -> None:
    """Add a twist, shape (6,), [m, rad], to that of a placement in a mapping of all twists."""
    present = twists.get(placement)
    twists[placement] = twist if present is None else present + twist
