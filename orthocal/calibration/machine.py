"""A machine with errors: where its tool is, and which drive coordinates bring it somewhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.kinematics.conditions import UseConditions
from orthocal.kinematics.loop_closure import LoopClosure, as_rows, find_beyond_travel
from orthocal.robot.model import Robot


@dataclass(frozen=True, slots=True, eq=False)
class Machine:
    """Kinematics of a robot with given error parameters."""

    robot: Robot
    errors: Mapping[str, float]
    """Parameter to value, such as {"x_slide.offset": 1e-3}, [SI]; others are 0."""

    def forward(
        self,
        joints: ArrayLike,
        *,
        names: Sequence[str] | None = None,
        conditions: UseConditions | None = None,
    ) -> Array:
        """Tool centre point.

        Args:
            joints: Drive coordinates as the encoders give them, without any offset of the
                controller, shape (K, n_drives) or (n_drives,), [m, rad].
            names: Labels of the rows in error messages.
            conditions: Conditions of use; by default the middle of both sides of each drive, the
                reference temperature and no payload.

        Returns:
            Shape (K, 3) or (3,), [m].

        Raises:
            ClosureError: If the machine cannot be at such coordinates.
            ParameterError: If a condition is out of range, or nothing depends on it.
        """
        rows, single = as_rows(joints, len(self.robot.drives), "drive coordinates")
        labels = names or [f"posture {i + 1}" for i in range(len(rows))]
        for error in find_beyond_travel(self.robot, rows, labels).values():
            raise error
        points = self._closure(conditions).forward(rows, names=labels)
        return points[0] if single else points

    def inverse(
        self,
        points: ArrayLike,
        *,
        names: Sequence[str] | None = None,
        conditions: UseConditions | None = None,
    ) -> Array:
        """Drive coordinates that bring the tool to given points.

        Args:
            points: Coordinates that the drives control, shape (K, n_coordinates) or
                (n_coordinates,), [m].
            names: Labels of the rows in error messages.
            conditions: As for `forward`.

        Returns:
            Drive coordinates as the encoders give them, shape (K, n_drives) or (n_drives,).

        Raises:
            ClosureError: If a point cannot be reached.
            ParameterError: As `forward`.
        """
        return self._closure(conditions).inverse(points, names=names)

    def _closure(self, conditions: UseConditions | None) -> LoopClosure:
        use = conditions or UseConditions()
        use.require_valid(self.robot)
        return LoopClosure(self.robot, fixed=self.errors, conditions=use)
