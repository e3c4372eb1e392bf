"""Direction of a plunger: an axis of the world frame or a vector, perpendicular to its leg."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.errors import SessionError
from orthocal.robot.model import Leg

DIRECTIONS: dict[str, tuple[float, float, float]] = {
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
}
"""Unit vectors of measured directions in the world frame, by name."""

Direction = str | tuple[float, float, float]
"""Name of `DIRECTIONS`, or vector in the world frame, of any length."""

CACHE_SIZE = 256
"""Directions whose vectors are cached: a plan has many setups with few directions."""

ALONG_AXIS = 1.0 - 1e-9
"""Cosine above which a vector has the name of an axis."""

PARALLEL_DEG = 1.0
"""Angle to a leg below which a direction counts as along the leg."""


@lru_cache(maxsize=CACHE_SIZE)
def direction_vector(direction: Direction) -> Array:
    """Unit vector of a direction in the world frame, shape (3,); 0 for the vector 0.

    The array is read-only, because all calls share it.
    """
    vector = np.array(DIRECTIONS[direction] if isinstance(direction, str) else direction)
    if vector.any() and not isinstance(direction, str):
        vector = vector / np.abs(vector).max()  # avoids an overflow of the square
        vector = np.asarray(vector / np.linalg.norm(vector))
    vector.flags.writeable = False
    return vector


@lru_cache(maxsize=CACHE_SIZE)
def side_vector(axis: tuple[float, float, float], direction: Direction) -> Array:
    """Unit vector perpendicular to the axis of a leg and to a direction, shape (3,), read-only."""
    side = np.cross(axis, direction_vector(direction))
    side /= np.linalg.norm(side)
    side.flags.writeable = False
    return side


def direction_name(direction: Direction) -> str:
    """Name of a direction along an axis; otherwise its vector in parentheses, with three digits."""
    if isinstance(direction, str):
        return direction
    unit = direction_vector(direction)
    for name, axis in DIRECTIONS.items():
        if unit @ axis > ALONG_AXIS:
            return name
    # adding 0 removes the sign of a negative zero
    return f"({', '.join(f'{round(v, 9) + 0.0:.3g}' for v in direction)})"


def check_direction(direction: Direction, leg: Leg, largest_deg: float, *, where: str) -> None:
    """Refuse an unknown direction, and a direction that is not square to the leg.

    The reading of an oblique plunger also changes when the leg moves along its axis.

    Args:
        direction: Direction of the plunger.
        leg: The leg that it touches.
        largest_deg: Largest deviation from square, [°].
        where: File and key, for messages.

    Raises:
        SessionError: If the direction is unknown or oblique; states the angle to the leg and the
            directions that are square to it.
    """
    if isinstance(direction, str) and direction not in DIRECTIONS:
        raise SessionError(
            f"found '{direction}'; expected one of {', '.join(DIRECTIONS)}, or a vector",
            where=where,
        )
    if not np.any(direction_vector(direction)):
        raise SessionError(
            "found [0, 0, 0], which has no direction; expected a vector such as [0, 1, 1]",
            where=where,
        )

    def angle_to_leg(vector: ArrayLike) -> float:
        return float(np.degrees(np.arccos(np.clip(np.dot(vector, leg.axis), -1.0, 1.0))))

    angle = angle_to_leg(direction_vector(direction))
    if abs(angle - 90.0) <= largest_deg:
        return
    square = [n for n, a in DIRECTIONS.items() if abs(angle_to_leg(a) - 90.0) <= largest_deg]
    choice = f"; square to it: {', '.join(square)}" if square else ""
    acute, name = min(angle, 180.0 - angle), direction_name(direction)
    if acute < PARALLEL_DEG:
        problem = f"'{name}' is along leg {leg.name}; a gauge measures across it{choice}"
    else:
        problem = (
            f"'{name}' is at {acute:.1f}° to leg {leg.name} in the mechanical zero; expected "
            f"a direction square to the leg, to within {largest_deg:g}°{choice}"
            + ("" if square else _oblique_leg_hint(leg))
        )
    raise SessionError(problem, where=where)


def _oblique_leg_hint(leg: Leg) -> str:
    """Hint for a leg that is not along an axis of the world frame."""
    along = ", ".join(f"{v:.3f}" for v in leg.axis)
    return (
        f". In the mechanical zero the leg is along ({along}). If it should be along an axis of "
        "the world frame, check lengths and zeros in the robot's files"
    )
