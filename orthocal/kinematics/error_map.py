"""All errors of a robot as one vector, and the placements that they make: numbers, nothing built.

A placement with errors is placement · exp6(δ). Its derivative by δ is a twist in its own frame,

    d exp6(δ) = exp6(δ) T(δ) dδ,  T(δ) = Σ (−ad δ)^k/(k + 1)!

(Chirikjian, Stochastic Models, Information Theory, and Lie Groups, volume 2, 2012, section 10.8).
Everything that errors do to a machine goes through these twists and through where its drives are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.io.fields import read_only
from orthocal.kinematics.symbolic import SERIES_BELOW, nominal_frame_placement
from orthocal.robot.model import Robot
from orthocal.robot.parameters import ElementaryError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SERIES_TERMS = 40
"""Terms of the series of T, at most: enough for a turn by π."""


@dataclass(frozen=True, slots=True)
class MovedPlacement:
    """A joint or frame whose placement errors can move."""

    index: int
    """Of the joint, or of the frame."""
    of_frame: bool


@dataclass(frozen=True, slots=True, eq=False)
class Slopes:
    """What errors do to placements and drives to first order, for a choice of n parameters."""

    twists: Array
    """∂ξ of every moved placement in its own frame, shape (6 n_moved, n), [m, rad]."""
    offsets: Array
    """∂ of where the drives are, shape (n_drives, n), [m, rad]."""
    gains: Array
    """The same as a multiple of the commanded coordinates, shape (n_drives, n)."""


class ErrorMap:
    """The elementary errors of a robot in a fixed order, shape (n_errors,), [m, rad, 1].

    Args:
        robot: The nominal robot.

    Attributes:
        names: Of the errors.
        moved: Placements that they move.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        elementary = tuple(robot.parameters.elementary.values())
        self.names = tuple(e.name for e in elementary)
        self._index = {name: i for i, name in enumerate(self.names)}
        drives = {d.name: i for i, d in enumerate(robot.drives)}
        moved: dict[MovedPlacement, int] = {}
        twist = np.full(len(elementary), -1)
        offset, scale = np.array(twist), np.array(twist)
        for i, e in enumerate(elementary):
            if e.kind == "offset":
                offset[i] = drives[e.owner]
            elif e.kind == "scale":
                scale[i] = drives[e.owner]
            else:
                place = moved.setdefault(_placement_of(robot, e), len(moved))
                twist[i] = 6 * place + e.axis
        self.moved = tuple(moved)
        self._twist, self._offset, self._scale = twist, offset, scale
        nominal = [
            nominal_frame_placement(robot.model, m.index)
            if m.of_frame
            else robot.model.jointPlacements[m.index]
            for m in self.moved
        ]
        self._rotations = np.array([p.rotation for p in nominal]).reshape(-1, 3, 3)
        self._positions = np.array([p.translation for p in nominal]).reshape(-1, 3)

    def expand(self, values: Mapping[str, float]) -> Array:
        """The vector of named parameters, which may be sums, shape (n_errors,), [SI].

        Raises:
            ParameterError: If a name is unknown.
        """
        result = np.zeros(len(self.names))
        for name, value in self.robot.parameters.expand(values).items():
            result[self._index[name]] = value
        return result

    def columns(self, names: Sequence[str]) -> Array:
        """What one unit of each named parameter adds to the vector, shape (n_errors, n)."""
        result = np.zeros((len(self.names), len(names)))
        for column, name in enumerate(names):
            for term, coefficient in self.robot.parameters[name].terms:
                result[self._index[term], column] += coefficient
        return result

    def placements(self, errors: ArrayLike) -> Array:
        """Moved placements: rotation by columns, then position.

        Args:
            errors: Shape (..., n_errors), [SI].

        Returns:
            Shape (..., 12 n_moved), [1, m].
        """
        twists = self._twists(np.asarray(errors, dtype=np.float64))
        turn, shift = exp6(twists)
        rotations = self._rotations @ turn
        positions = (self._rotations @ shift[..., None])[..., 0] + self._positions
        columns = np.swapaxes(rotations, -1, -2).reshape(*rotations.shape[:-2], 9)
        values = np.concatenate([columns, positions], axis=-1)
        return values.reshape(*values.shape[:-2], -1)

    def drives(self, errors: ArrayLike, commanded: ArrayLike) -> Array:
        """Where the drives really are, gain · commanded + offset, shape (..., n_drives), [m, rad].

        Args:
            errors: Shape (n_errors,) or (..., n_errors), [SI].
            commanded: Shape (..., n_drives), [m, rad].
        """
        offset, gain = self.offsets(errors), self.gains(errors)
        return np.asarray(gain * np.asarray(commanded, dtype=np.float64) + offset)

    def offsets(self, errors: ArrayLike) -> Array:
        """Offsets of the drives, shape (..., n_drives), [m, rad]."""
        return self._of_drives(np.asarray(errors, dtype=np.float64), self._offset)

    def gains(self, errors: ArrayLike) -> Array:
        """1 + scale error of the drives, shape (..., n_drives)."""
        return np.asarray(self.robot.drive_gain + self.scales(errors))

    def scales(self, errors: ArrayLike) -> Array:
        """Scale errors of the drives, shape (..., n_drives)."""
        return self._of_drives(np.asarray(errors, dtype=np.float64), self._scale)

    def slopes(self, errors: ArrayLike, columns: Array) -> Slopes:
        """Derivatives of placements and drives by parameters.

        Args:
            errors: Where, shape (n_errors,), [SI].
            columns: What one unit of each parameter adds to them, shape (n_errors, n).
        """
        at = right_jacobian(self._twists(np.asarray(errors, dtype=np.float64)))
        n = columns.shape[1]
        twists = at @ self.twists_of(columns.T).T.reshape(len(self.moved), 6, n)
        return Slopes(twists.reshape(-1, n), self.offsets(columns.T).T, self.scales(columns.T).T)

    @property
    def nominal(self) -> Array:
        """Moved placements without errors: rotation by columns, position; (n_moved, 12)."""
        columns = np.swapaxes(self._rotations, 1, 2).reshape(-1, 9)
        return np.concatenate([columns, self._positions], axis=1)

    def twists_of(self, errors: ArrayLike) -> Array:
        """Twists δ of the moved placements, shape (..., 6 n_moved), [m, rad]."""
        given = np.asarray(errors, dtype=np.float64)
        result = np.zeros((*given.shape[:-1], 6 * len(self.moved)))
        chosen = self._twist >= 0
        result[..., self._twist[chosen]] = given[..., chosen]
        return result

    def _twists(self, errors: Array) -> Array:
        return self.twists_of(errors).reshape(*errors.shape[:-1], len(self.moved), 6)

    def _of_drives(self, errors: Array, index: Indices) -> Array:
        result = np.zeros((*errors.shape[:-1], len(self.robot.drives)))
        chosen = index >= 0
        result[..., index[chosen]] = errors[..., chosen]
        return result


@lru_cache(maxsize=8)
def error_map(robot: Robot) -> ErrorMap:
    """The error map of a robot, made once."""
    return ErrorMap(robot)


def _placement_of(robot: Robot, error: ElementaryError) -> MovedPlacement:
    if error.of_frame:
        return MovedPlacement(robot.frame_id(error.owner), True)
    return MovedPlacement(int(robot.model.getJointId(error.owner)), False)


def exp6(twists: Array) -> tuple[Array, Array]:
    """Exponentials of twists (translation v, rotation ω), as Pinocchio's exp6.

    Args:
        twists: Shape (..., 6), [m, rad].

    Returns:
        Rotations, shape (..., 3, 3), and positions, shape (..., 3), [m].
    """
    v, w = twists[..., :3], twists[..., 3:]
    square = (w * w).sum(axis=-1)[..., None]
    near = square < SERIES_BELOW
    safe = np.where(near, 1.0, square)
    angle = np.sqrt(safe)
    sine, cosine = np.sin(angle), np.cos(angle)
    a, b, c = (
        np.where(near, _alternating(square, first), far)
        for first, far in (
            (1, sine / angle),
            (2, (1.0 - cosine) / safe),
            (3, (angle - sine) / (safe * angle)),
        )
    )
    hat = _hat(w)
    rotations = np.eye(3) + a[..., None] * hat + b[..., None] * (hat @ hat)
    turned = hat @ v[..., None]
    return rotations, v + b * turned[..., 0] + c * (hat @ turned)[..., 0]


def _alternating(square: Array, first: int) -> Array:
    """Σ (−θ²)^k / (first + 2k)!, enough terms for double precision below SERIES_BELOW."""
    total = np.zeros_like(square)
    for k in reversed(range(7)):
        total = total * -square + 1.0 / math.factorial(first + 2 * k)
    return total


def right_jacobian(twists: Array) -> Array:
    """T with exp6(δ + dδ) = exp6(δ) exp6(T dδ) to first order, shape (..., 6, 6) of (..., 6)."""
    ad = _small_adjoint(twists)
    term = np.broadcast_to(np.eye(6), ad.shape)
    total = np.array(term)
    for k in range(1, SERIES_TERMS):
        term = -(term @ ad) / (k + 1)
        total += term
        if not term.any() or np.abs(term).max() < 1e-18:
            break
    return read_only(total)


def _small_adjoint(twists: Array) -> Array:
    """Ad of twists (v, ω): [[ω, v], [0, ω]] of their cross products, shape (..., 6, 6)."""
    result = np.zeros((*twists.shape, 6))
    hat_v, hat_w = _hat(twists[..., :3]), _hat(twists[..., 3:])
    result[..., :3, :3] = result[..., 3:, 3:] = hat_w
    result[..., :3, 3:] = hat_v
    return result


def _hat(vectors: Array) -> Array:
    result = np.zeros((*vectors.shape, 3))
    x, y, z = (vectors[..., i] for i in range(3))
    result[..., 0, 1], result[..., 0, 2] = -z, y
    result[..., 1, 0], result[..., 1, 2] = z, -x
    result[..., 2, 0], result[..., 2, 1] = -y, x
    return result
