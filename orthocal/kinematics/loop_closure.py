"""Closing the loops of a robot numerically, many postures at once.

Forward: commanded drives to passive coordinates and tool centre point. Inverse: tool centre point
to drives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.arguments import require_kind
from orthocal.errors import ClosureError, RobotError
from orthocal.kinematics.compiled import compiled_robot
from orthocal.kinematics.continuation import (
    Failures,
    MachineNumbers,
    System,
    as_rows,
    follow,
)
from orthocal.kinematics.function_cache import once_a_robot
from orthocal.robot.model import (
    Robot,
    Tcp,
    closure_row_units,
    closure_turns,
    coordinate_limits,
    coordinate_units,
)

Array = NDArray[np.float64]
SOLUTIONS_REMEMBERED = 4
MOST_REMEMBERED = 1000
"""Solutions that an assembly keeps, of at most so many postures: what asks for one asks again."""


class Assembly:
    """Closes the loops of a robot with some errors fixed and some given at each call.

    Args:
        robot: The nominal robot.
        free: Names of the parameters whose values are given at each call as `theta`, in this order.
        fixed: Values of other parameters, [unit of the parameter]; 0 where absent.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        free: Sequence[str] = (),
        fixed: Mapping[str, float] | None = None,
    ) -> None:
        require_kind(robot, Robot, expected="a Robot, such as load_robot(...)")
        self.robot = robot
        self.free = tuple(free)
        self._compiled = compiled_robot(robot)
        self._columns = self._compiled.errors.columns(self.free)
        others = {k: v for k, v in (fixed or {}).items() if k not in self.free}
        self._fixed = self._compiled.errors.expand(others)
        self._recent: dict[tuple[object, ...], Array] = {}

    def close(
        self,
        drives: ArrayLike,
        *,
        theta: ArrayLike | None = None,
        start: ArrayLike | None = None,
        names: Sequence[str] | None = None,
        allow_free: bool = False,
        failures: Failures | None = None,
    ) -> Array:
        """Passive coordinates that close the loops, g(q, θ) = 0.

        Args:
            drives: Commanded drive coordinates, shape (K, n_drives) or (n_drives,), [m, rad].
            theta: Values of the free parameters, shape (n_free,); 0 by default.
            start: Passive coordinates to start from, shape (n_passive,) or (K, n_passive); the
                mechanical zero by default.
            names: Names of the postures, for messages.
            allow_free: Whether the loops may leave passive motions free, as those of a robot that
                is only looked at: they then move as little as closes the loops.
            failures: Filled with the postures that cannot be reached, which are NaN then; by
                default the first of them raises.

        Returns:
            Shape (K, n_passive), or (n_passive,) for one posture.

        Raises:
            ClosureError: If a posture cannot be reached, is outside the limits of a passive joint
                or, unless free motions are allowed, singular; names the posture and the residual.
        """
        d, single = as_rows(drives, len(self.robot.drives), "drive coordinates")
        machine = self.machine(theta)
        if failures is not None:
            passive = self._close(d, machine, start, names, failures, allow_free=allow_free)
        else:
            passive = self._once(
                ("close", allow_free, d.tobytes(), *(part.tobytes() for part in machine)),
                lambda: self._close(d, machine, start, names, None, allow_free=allow_free),
            )
        return passive[0] if single else passive

    def _close(
        self,
        drives: Array,
        machine: MachineNumbers,
        start: ArrayLike | None,
        names: Sequence[str] | None,
        failures: Failures | None,
        *,
        allow_free: bool,
    ) -> Array:
        system = replace(self._closing, shortest=allow_free)
        return follow(system, drives, machine, start, names, failures, allow_singular=allow_free)

    def _once(self, key: tuple[object, ...], solve: Callable[[], Array]) -> Array:
        """What was solved for the same numbers a moment ago, or is now."""
        if key in self._recent:
            return np.array(self._recent[key])
        found = solve()
        if len(found) <= MOST_REMEMBERED:
            recent = [*self._recent.items(), (key, np.array(found))]
            self._recent = dict(recent[-SOLUTIONS_REMEMBERED:])
        return found

    def forward(
        self,
        drives: ArrayLike,
        *,
        theta: ArrayLike | None = None,
        start: ArrayLike | None = None,
        names: Sequence[str] | None = None,
        failures: Failures | None = None,
    ) -> Array:
        """Tool centre point of commanded drive coordinates.

        Args:
            drives: Shape (K, n_drives) or (n_drives,), [m, rad].
            theta: Values of the free parameters, shape (n_free,); 0 by default.
            start: As for `close`.
            names: Names of the postures, for messages.
            failures: As for `close`.

        Returns:
            Shape (K, 3) or (3,), [m].

        Raises:
            ClosureError: As `close`.
            RobotError: If the robot has no tool centre point.
        """
        d, single = as_rows(drives, len(self.robot.drives), "drive coordinates")
        passive = self.close(d, theta=theta, start=start, names=names, failures=failures)
        points = self.tcp(d, passive, theta=theta)
        return points[0] if single else points

    def inverse(
        self,
        points: ArrayLike,
        *,
        theta: ArrayLike | None = None,
        names: Sequence[str] | None = None,
        failures: Failures | None = None,
    ) -> Array:
        """Drive coordinates that bring the tool centre point to given points.

        Args:
            points: The coordinates of the tool that the drives control, shape (K, n_drives) or
                (n_drives,), [m].
            theta: Values of the free parameters, shape (n_free,); 0 by default.
            names: Names of the postures, for messages.
            failures: As for `close`.

        Returns:
            Shape (K, n_drives) or (n_drives,), [m, rad].

        Raises:
            ClosureError: If a point cannot be reached.
            RobotError: If the robot has no tool centre point with as many coordinates as drives.
        """
        p, single = as_rows(points, len(self._require_tcp().coordinates), "coordinates")
        drives, _ = self.reach(p, theta=theta, names=names, failures=failures)
        return drives[0] if single else drives

    def reach(
        self,
        points: Array,
        *,
        theta: ArrayLike | None = None,
        start: Array | None = None,
        names: Sequence[str] | None = None,
        failures: Failures | None = None,
    ) -> tuple[Array, Array]:
        """All joint coordinates that bring the tool centre point to given points.

        Args:
            points: As for `inverse`, shape (K, n_drives).
            theta: As for `inverse`.
            start: Drive and passive coordinates to start from, shape (K, n_drives + n_passive); the
                mechanical zero by default.
            names: As for `inverse`.
            failures: As for `inverse`.

        Returns:
            Drive coordinates, shape (K, n_drives), and passive ones, shape (K, n_passive).

        Raises:
            ClosureError, RobotError: As `inverse`.
        """
        p, machine = points, self.machine(theta)
        if failures is not None:
            x = follow(self._inverting, p, machine, start, names, failures)
        elif start is not None:
            x = follow(self._inverting, p, machine, start, names, None)
        else:
            x = self._once(
                ("inverse", p.tobytes(), *(part.tobytes() for part in machine)),
                lambda: follow(self._inverting, p, machine, None, names, None),
            )
        return x[:, : len(self.robot.drives)], x[:, len(self.robot.drives) :]

    def tcp(
        self, drives: ArrayLike, passive: ArrayLike, *, theta: ArrayLike | None = None
    ) -> Array:
        """Tool centre point of joint coordinates with closed loops, shape (K, 3) or (3,), [m]."""
        frame = self._require_tcp().frame
        d, _ = as_rows(drives, len(self.robot.drives), "drive coordinates")
        q, _ = as_rows(passive, self.robot.passive_index.size, "passive coordinates")
        if len(d) != len(q):
            raise ValueError(f"found {len(d)} rows of drive and {len(q)} of passive coordinates")
        machine = self.machine(theta)
        (points,) = self._compiled.position(frame)(machine.drives(d), q, machine.placements)
        return points[0] if np.ndim(drives) == 1 else points

    def errors(self, theta: ArrayLike | None = None) -> Array:
        """All errors of the machine for values of the free ones, shape (n_errors,), [SI]."""
        return np.asarray(self._fixed + self._columns @ self._theta(theta))

    def machine(self, theta: ArrayLike | None = None) -> MachineNumbers:
        """The machine for values of the free parameters, shape (n_free,); 0 by default."""
        errors, at = self._compiled.errors, self.errors(theta)
        return MachineNumbers(errors.placements(at), errors.offsets(at), errors.gains(at))

    def _theta(self, theta: ArrayLike | None) -> Array:
        if theta is None:
            return np.zeros(len(self.free))
        values, single = as_rows(theta, len(self.free), "values of the free parameters")
        if not single:
            raise ValueError(f"found the shape {values.shape}; expected ({len(self.free)},)")
        return np.asarray(values[0])

    def _require_tcp(self) -> Tcp:
        if self.robot.tcp is None:
            raise RobotError(
                "has no tool centre point; add orthocal.tcp", where=str(self.robot.yaml)
            )
        return self.robot.tcp

    @cached_property
    def _closing(self) -> System:
        robot, function = self.robot, self._compiled.closing

        def evaluate(x: Array, p: Array, machine: MachineNumbers) -> tuple[Array, Array]:
            g, g_q = function(machine.drives(p), x, machine.placements)
            return g, g_q

        lower, upper = coordinate_limits(robot)
        return System(
            evaluate=evaluate,
            n_rows=robot.closure_rows,
            n_x=robot.passive_index.size,
            start=robot.zero[robot.passive_index],
            origin=robot.drive_zero,
            units=coordinate_units(robot)[robot.passive_index],
            lower=lower[robot.passive_index],
            upper=upper[robot.passive_index],
            names=_joint_names(robot, robot.passive_index),
            row_units=closure_row_units(robot),
            turns=closure_turns(robot),
            length=robot.characteristic_length,
        )

    @cached_property
    def _inverting(self) -> System:
        robot = self.robot
        tcp = self._require_tcp()
        chosen = list(tcp.coordinates)
        if len(chosen) != len(robot.drives):
            raise RobotError(
                f"orthocal.tcp.coordinates names {len(tcp.coordinates)} coordinates for "
                f"{len(robot.drives)} drives; the inverse needs as many",
                where=str(robot.yaml),
            )
        function, n_d = self._compiled.inverting, len(robot.drives)

        def evaluate(x: Array, p: Array, machine: MachineNumbers) -> tuple[Array, Array]:
            d, q = x[:, :n_d], x[:, n_d:]
            g, g_a, g_q, tool, t_a, t_q = function(machine.drives(d), q, machine.placements)
            residuals = np.concatenate([g, tool[:, chosen] - p], axis=1)
            by_drives = np.concatenate([g_a, t_a[:, chosen]], axis=1) * machine.gain
            by_passive = np.concatenate([g_q, t_q[:, chosen]], axis=1)
            return residuals, np.concatenate([by_drives, by_passive], axis=2)

        index = np.concatenate([robot.drive_index, robot.passive_index])
        lower, upper = coordinate_limits(robot)
        zero_passive = robot.zero[robot.passive_index]
        origin = nominal_assembly(robot).tcp(robot.drive_zero, zero_passive)[chosen]
        return System(
            evaluate=evaluate,
            n_rows=robot.closure_rows + len(chosen),
            n_x=index.size,
            start=np.concatenate([robot.drive_zero, zero_passive]),
            origin=origin,
            units=coordinate_units(robot)[index],
            lower=lower[index],
            upper=upper[index],
            names=_joint_names(robot, index),
            row_units=np.append(closure_row_units(robot), np.ones(len(chosen))),
            turns=np.append(closure_turns(robot), np.zeros(len(chosen), dtype=np.bool_)),
            length=robot.characteristic_length,
        )


@once_a_robot(maxsize=8)
def nominal_assembly(robot: Robot) -> Assembly:
    """The assembly of a robot without errors, built once."""
    return Assembly(robot)


def find_beyond_travel(robot: Robot, drives: Array, names: Sequence[str]) -> Failures:
    """The rows that are beyond a drive's travel, shape (K, n_drives), [m, rad]."""
    failures: Failures = {}
    for drive, values in zip(robot.drives, drives.T, strict=True):
        factor, unit = drive.edge_factor, drive.edge_unit
        for i in np.flatnonzero((values < drive.lower) | (values > drive.upper)).tolist():
            reason = (
                f"{drive.name}_{unit} is {values[i] * factor:g}; the drive reaches from "
                f"{drive.lower * factor:g} to {drive.upper * factor:g}"
            )
            failures.setdefault(i, ClosureError(reason, posture=names[i]))
    return failures


def _joint_names(robot: Robot, index: NDArray[np.int64]) -> tuple[str, ...]:
    owner = {}
    for i in range(1, robot.model.njoints):
        joint = robot.model.joints[i]
        for k in range(joint.nv):
            owner[joint.idx_v + k] = robot.model.names[i]
    return tuple(owner[int(i)] for i in index)
