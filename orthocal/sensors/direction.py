"""Direction of a plunger: an axis of the world or a vector, square to the leg that it touches."""

from __future__ import annotations

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
"""Names of measured directions, and their unit vectors in the world."""

Direction = str | tuple[float, float, float]
"""A name of `DIRECTIONS`, or a vector in the world, of any length."""

PARALLEL_DEG = 1.0
"""Angle to a leg below which a direction counts as along it."""


def direction_vector(direction: Direction) -> Array:
    """Unit vector of a growing reading in the world, shape (3,); 0 for the vector 0."""
    vector = np.array(DIRECTIONS[direction] if isinstance(direction, str) else direction)
    if isinstance(direction, str) or not vector.any():
        return vector
    vector = vector / np.abs(vector).max()  # its square is not too large for a number
    return np.asarray(vector / np.linalg.norm(vector))


def direction_name(direction: Direction) -> str:
    """Name of a direction, or its vector in brackets."""
    if isinstance(direction, str):
        return direction
    return f"({', '.join(f'{v:g}' for v in direction)})"


def check_direction(direction: Direction, leg: Leg, largest_deg: float, *, where: str) -> None:
    """Refuse an unknown direction, and a gauge that does not measure square to the leg.

    The reading of an oblique plunger also changes when the leg moves along itself.

    Args:
        direction: Direction of the plunger.
        leg: The leg that it touches.
        largest_deg: Largest deviation from square, [°].
        where: File and key, for messages.

    Raises:
        SessionError: With the angle to the leg, and the directions that are square to it.
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

    def angle(axis: ArrayLike) -> float:
        return float(np.degrees(np.arccos(np.clip(np.dot(axis, leg.axis), -1.0, 1.0))))

    to_leg = angle(direction_vector(direction))
    if abs(to_leg - 90.0) <= largest_deg:
        return
    square = [n for n, a in DIRECTIONS.items() if abs(angle(a) - 90.0) <= largest_deg]
    choice = f"; square to it: {', '.join(square)}" if square else ""
    acute, named = min(to_leg, 180.0 - to_leg), f"'{direction_name(direction)}'"
    if acute < PARALLEL_DEG:
        problem = f"{named} is along leg {leg.name}; a gauge measures across it{choice}"
    else:
        problem = (
            f"{named} is at {acute:.1f}° to leg {leg.name} in the mechanical zero; expected "
            f"a direction square to the leg, to within {largest_deg:g}°{choice}"
            + ("" if square else _crooked(leg))
        )
    raise SessionError(problem, where=where)


def _crooked(leg: Leg) -> str:
    """Hint for a leg that lies along no axis of the world."""
    along = ", ".join(f"{v:.3f}" for v in leg.axis)
    return (
        f". In the mechanical zero the leg lies along ({along}): where it should lie along an axis "
        "of the world, check lengths and zeros in the robot's files"
    )
