"""Forward and inverse kinematics of a machine with errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from numpy.typing import ArrayLike

from orthocal.arguments import require_kind, require_numbers
from orthocal.arrays import Array
from orthocal.kinematics.conditions import UseConditions
from orthocal.kinematics.loop_closure import LoopClosure, as_rows, require_within_travel
from orthocal.robot.model import Robot


@dataclass(frozen=True, slots=True, eq=False)
class Machine:
    """Kinematics of a robot with error parameters."""

    robot: Robot
    errors: Mapping[str, float]
    """Parameter to value, such as {"x_slide.offset": 1e-3}, [SI]; absent ones are 0."""

    def __post_init__(self) -> None:
        require_kind(self.robot, Robot, expected="a Robot, such as load_robot(...)")
        require_numbers(self.errors, argument="errors")
        object.__setattr__(self, "errors", dict(self.errors))

    def forward(
        self,
        joints: ArrayLike,
        *,
        names: Sequence[str] | None = None,
        conditions: UseConditions | None = None,
    ) -> Array:
        """Tool centre point for drive coordinates.

        Args:
            joints: Drive coordinates of the encoders, without offsets of the controller, shape
                (K, n_drives) or (n_drives,), [m, rad].
            names: Names of the rows, for messages.
            conditions: Conditions of use; by default the mean of both sides of approach, the
                reference temperature and no payload.

        Returns:
            Tool positions, shape (K, 3) or (3,), [m].

        Raises:
            ClosureError: If the machine cannot reach such coordinates.
            ParameterError: If a condition is out of range, or nothing depends on it.
        """
        rows, single = as_rows(joints, len(self.robot.drives), "drive coordinates")
        require_within_travel(self.robot, rows, names)
        points = self._closure(conditions).forward(rows, names=names)
        return points[0] if single else points

    def inverse(
        self,
        points: ArrayLike,
        *,
        names: Sequence[str] | None = None,
        conditions: UseConditions | None = None,
    ) -> Array:
        """Drive coordinates for tool positions.

        Args:
            points: Commanded coordinates of the tool, shape (K, n_coordinates) or
                (n_coordinates,), [m]; or positions, shape (K, 3) or (3,).
            names: Names of the rows, for messages.
            conditions: Conditions of use, as for `forward`.

        Returns:
            Drive coordinates of the encoders, shape (K, n_drives) or (n_drives,), [m, rad].

        Raises:
            ClosureError: If a point cannot be reached.
            ParameterError: If a condition is out of range, or nothing depends on it.
        """
        return self._closure(conditions).inverse(points, names=names)

    def _closure(self, conditions: UseConditions | None) -> LoopClosure:
        """Loop closures of the machine under conditions of use."""
        use = UseConditions() if conditions is None else conditions
        require_kind(use, UseConditions, expected="UseConditions, such as UseConditions('ppp')")
        use.require_valid(self.robot)
        return LoopClosure(self.robot, fixed=self.errors, conditions=use)
