"""Solver of the loop closures g(q, θ) = 0, for batches of machines and postures.

The forward problem has the passive coordinates q and the tool centre point of commanded drive
coordinates as its solution. The inverse problem has the drive coordinates that bring the tool
centre point to a position. `continuation` solves the equations.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arguments import require_kind
from orthocal.arrays import Array, ArrayCache
from orthocal.effects.loading import robot_effects
from orthocal.effects.rod_forces import RodForces
from orthocal.errors import ClosureError
from orthocal.kinematics.conditions import UseConditions
from orthocal.kinematics.continuation import (
    Failures,
    System,
    label_postures,
    solve_closures,
)
from orthocal.kinematics.error_map import MachineGeometry
from orthocal.kinematics.function_cache import cached_per_robot
from orthocal.kinematics.robot_functions import robot_functions
from orthocal.robot.model import Robot, require_commanded_tool, require_tcp

FORCE_CACHE_SIZE = 32
"""Number of sets of postures whose rod forces are cached for one robot."""

SOLUTION_CACHE_SIZE, MAX_CACHED_POSTURES = 32, 200
"""Number of sets of postures whose solutions are cached, and most postures in such a set."""

MAX_ITERATIONS = 10
"""Largest number of fixed-point iterations of `LoopClosure.reach`. Each reduces the change of the
conditions by more than a factor of 100."""

CONDITION_TOLERANCE = 1e-9
"""Relative change at which conditions that follow from drive coordinates have converged."""


class LoopClosure:
    """Solver of the loop closures of machines, with fixed errors and errors passed to each call.

    `theta` has shape (n_free,) for one machine or (S, n_free) for a batch of machines; `errors`
    passes all elementary errors instead, shape (n_errors,) or (S, n_errors). Results of a batch
    have a leading dimension S. Commands are drive coordinates with the conditions of effects
    appended, shape (K, n_command) (`error_map`).

    Args:
        robot: The nominal robot.
        free: Names of the parameters whose values are passed to each call as `theta`, in order.
        fixed: Values of other parameters, [unit of the parameter]; 0 where absent.
        conditions: Conditions of use for drive coordinates without conditions. The default is
            neutral: middle of both sides of each drive, reference temperature, no payload.

    Attributes:
        robot: The argument `robot`.
        free: Names of the free parameters.
        fixed: Values of the parameters that are not free, [unit of the parameter].

    Raises:
        ParameterError: If the name of a parameter is unknown.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        free: Sequence[str] = (),
        fixed: Mapping[str, float] | None = None,
        conditions: UseConditions | None = None,
    ) -> None:
        require_kind(robot, Robot, expected="a Robot, such as load_robot(...)")
        self.robot = robot
        self.free = tuple(free)
        self._conditions = conditions
        self._functions = robot_functions(robot)
        self._unit_errors = self._functions.errors.unit_errors(self.free)
        self.fixed = {k: v for k, v in (fixed or {}).items() if k not in self.free}
        self._fixed = self._functions.errors.expand(self.fixed)
        self._solutions = _solutions(robot)

    def close(
        self,
        drives: ArrayLike,
        *,
        theta: ArrayLike | None = None,
        errors: ArrayLike | None = None,
        start: ArrayLike | None = None,
        names: Sequence[str] | None = None,
        allow_free: bool = False,
        failures: Failures | None = None,
    ) -> Array:
        """Solve the loop closures g(q, θ) = 0 for the passive coordinates.

        Args:
            drives: Commanded drive coordinates, shape (K, n_drives) or (n_drives,), [m, rad]; or
                commands.
            theta: Values of the free parameters; 0 by default.
            errors: All elementary errors, instead of theta.
            start: Start values of the passive coordinates, shape (n_passive,), (K, n_passive) or
                (S, K, n_passive); the reference posture by default.
            names: Names of the postures, for messages.
            allow_free: True to accept free passive motions, such as those of a robot that is only
                displayed. The passive coordinates then move as little as possible.
            failures: Filled with the postures that cannot be reached, whose results are NaN; by
                default the first of them raises.

        Returns:
            Shape (K, n_passive), or (n_passive,) for one posture; a batch has S in front.

        Raises:
            ClosureError: If a posture cannot be reached, is outside the limits of a passive joint,
                or is singular without `allow_free`; states the posture and the residual.
            ValueError: If an argument has another shape.
        """
        d, single = self._as_commands(drives)
        values = self._all_errors(theta, errors)

        def solve() -> Array:
            geometry, batch = self._batch(d, errors=values)
            passive = solve_closures(
                self._closing_freely if allow_free else self._closing,
                d,
                geometry,
                machines=len(geometry.drive_errors),
                start=start,
                names=names,
                failures=failures,
                allow_singular=allow_free,
            )
            return passive if batch else passive[0]

        is_one_machine = values.ndim == 1 and (start is None or np.ndim(start) <= 2)
        if is_one_machine and len(d) <= MAX_CACHED_POSTURES and failures is None and not allow_free:
            start_key = None if start is None else np.asarray(start).tobytes()
            passive = self._solutions.find((values.tobytes(), d.tobytes(), start_key), solve)
        else:
            passive = solve()
        return passive[..., 0, :] if single else passive

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
            theta: Values of the free parameters; 0 by default.
            start: Start values of the passive coordinates; the reference posture by default.
            names: Names of the postures, for messages.
            failures: Filled with the postures that cannot be reached; by default the first raises.

        Returns:
            Shape (K, 3) or (3,), [m]; a batch has S in front.

        Raises:
            ClosureError: If a posture cannot be reached or is singular.
            RobotError: If the robot has no tool centre point.
            ValueError: If an argument has another shape.
        """
        d, single = self._as_commands(drives)
        passive = self.close(d, theta=theta, start=start, names=names, failures=failures)
        points = self.tcp(d, passive, theta=theta)
        return points[..., 0, :] if single else points

    def inverse(
        self,
        points: ArrayLike,
        *,
        names: Sequence[str] | None = None,
        failures: Failures | None = None,
    ) -> Array:
        """Drive coordinates that bring the tool centre point to points.

        Args:
            points: Commanded coordinates of the tool, shape (K, n_drives) or (n_drives,), [m]; or
                positions as `forward` returns them, shape (K, 3) or (3,). Coordinates that are not
                commanded are ignored.
            names: Names of the postures, for messages.
            failures: Filled with the points that cannot be reached; by default the first raises.

        Returns:
            Shape (K, n_drives) or (n_drives,), [m, rad].

        Raises:
            ClosureError: If a point cannot be reached.
            RobotError: If the robot has no tool centre point with as many coordinates as drives.
            ValueError: If an argument has another shape.
        """
        coordinates = require_tcp(self.robot).coordinates
        p = _as_numbers(points, len(coordinates), "coordinates")
        if len(coordinates) < 3 and p.shape[-1:] == (3,):
            p = p[..., list(coordinates)]
        p, single = as_rows(p, len(coordinates), "coordinates")
        drives, _ = self.reach(p, names=names, failures=failures)
        return drives[0] if single else drives

    def reach(
        self,
        points: Array,
        *,
        start: Array | None = None,
        names: Sequence[str] | None = None,
        failures: Failures | None = None,
    ) -> tuple[Array, Array]:
        """All joint coordinates that bring the tool centre point of one machine to points.

        Conditions that follow from the drive coordinates, such as loads, are found by fixed-point
        iteration: each step solves the closures under the conditions of the step before.

        Args:
            points: Commanded coordinates of the tool, shape (K, n_drives), [m].
            start: Start values of drive and passive coordinates, shape
                (K, n_drives + n_passive); the reference posture by default.
            names: Names of the postures, for messages.
            failures: Filled with the points that cannot be reached; by default the first raises.

        Returns:
            Drive coordinates, shape (K, n_drives), and passive ones, shape (K, n_passive).

        Raises:
            ClosureError: If a point cannot be reached, or the conditions do not converge.
            RobotError: If the robot has no tool centre point with as many coordinates as drives.
        """
        n = len(self.robot.drives)
        if not self._depends_on_drives:
            x = self._reach(points, np.zeros((len(points), n)), start, names, failures)
            return x[:, :n], x[:, n:]
        drives = np.tile(self.robot.drive_zero, (len(points), 1))
        if self._has_load:
            drives = nominal_closure(self.robot).inverse(points, failures={})
        commands = self.commands(drives)
        for _ in range(MAX_ITERATIONS):
            x = self._reach(points, commands[:, :n], start, names, failures)
            before, commands = commands[:, n:], self.commands(x[:, :n])
            change = np.abs(commands[:, n:] - before)
            scale = np.nan_to_num(np.abs(before)).max(axis=0, initial=0.0)
            # False at refused points, whose coordinates are NaN
            changing = (change > CONDITION_TOLERANCE * scale).any(axis=1)
            if not changing.any():
                break
            start = np.where(np.isfinite(x), x, self._inverting.start)
        for i in np.flatnonzero(changing).tolist():
            error = ClosureError(
                "cannot be computed: the conditions that depend on its drive coordinates, such as "
                "loads, do not converge",
                posture=label_postures(names, len(points))[i],
            )
            if failures is None:
                raise error
            failures.setdefault(i, error)
            x[i] = np.nan
        return x[:, :n], x[:, n:]

    def _reach(
        self,
        points: Array,
        drives: Array,
        start: Array | None,
        names: Sequence[str] | None,
        failures: Failures | None,
    ) -> Array:
        """Joint coordinates of `reach` under the conditions of stated drive coordinates."""
        commands = self.commands(drives)
        targets = np.hstack([points, commands[:, len(self.robot.drives) :]])

        def solve() -> Array:
            geometry, _ = self._batch(commands)
            x: Array = solve_closures(
                self._inverting,
                targets,
                geometry,
                machines=1,
                start=start,
                names=names,
                failures=failures,
            )[0]
            return x

        if start is None and failures is None and len(points) <= MAX_CACHED_POSTURES:
            return self._solutions.find((b"tool" + self._fixed.tobytes(), targets.tobytes()), solve)
        return solve()

    def tcp(
        self,
        drives: ArrayLike,
        passive: ArrayLike,
        *,
        theta: ArrayLike | None = None,
        errors: ArrayLike | None = None,
    ) -> Array:
        """Tool centre point of joint coordinates with closed loops.

        Args:
            drives: Commanded drive coordinates, shape (K, n_drives) or (n_drives,), [m, rad].
            passive: Passive coordinates that `close` returns for these drives.
            theta: Values of the free parameters; 0 by default.
            errors: All elementary errors, instead of theta.

        Returns:
            Shape (K, 3) or (3,), [m]; a batch has S in front.

        Raises:
            RobotError: If the robot has no tool centre point.
            ValueError: If the passive coordinates do not have this shape.
        """
        frame = require_tcp(self.robot).frame
        d, single = self._as_commands(drives)
        geometry, batch = self._batch(d, theta=theta, errors=errors)
        machines, n = len(geometry.drive_errors), self.robot.passive_index.size
        q = np.asarray(passive, dtype=np.float64)
        if q.ndim == 0 or q.shape[-1] != n:
            raise ValueError(f"found the shape {q.shape}; expected {n} passive coordinates per row")
        rows = machines * len(d)
        if n and q.size != rows * n:
            raise ValueError(f"found {rows} rows of drive and {q.size // n} of passive coordinates")
        actuated = geometry.drives(d).reshape(rows, len(self.robot.drives))
        position = self._functions.position(frame)
        (points,) = position(actuated, q.reshape(rows, n), geometry.placements)
        shaped = points.reshape(machines, len(d), 3)
        shaped = shaped if batch else shaped[0]
        return np.asarray(shaped[..., 0, :] if single else shaped)

    def errors(self, theta: ArrayLike | None = None) -> Array:
        """All elementary errors for values of the free parameters, shape (..., n_errors), [SI]."""
        return np.asarray(self._fixed + self._theta(theta) @ self._unit_errors.T)

    def geometry(self, theta: ArrayLike | None = None) -> MachineGeometry:
        """Geometry of machines for values of the free parameters; 0 by default."""
        return self._functions.errors.geometry(self.errors(theta))

    def commands(self, drives: Array) -> Array:
        """Commands of drive coordinates under the conditions of this closure.

        Args:
            drives: Shape (K, n_drives), or commands, shape (K, n_command), which are returned
                unchanged.

        Returns:
            Shape (K, n_command).
        """
        map_, conditions = self._functions.errors, self._conditions
        if conditions is None or drives.shape[1] > len(self.robot.drives) or not map_.n_conditions:
            return map_.command(drives)
        values = conditions.values(self.robot)
        if self._has_load:
            values["load"] = find_loads(self.robot, drives, conditions.payload or 0.0)
        values["coordinates"], values["reference"] = drives, self.robot.drive_zero
        columns = [values[c] for c in map_.conditions]
        rows = [np.broadcast_to(v, (len(drives), v.shape[-1])) for v in columns]
        return np.hstack([drives, *rows])

    @property
    def _depends_on_drives(self) -> bool:
        """True if conditions follow from the drive coordinates."""
        return self._has_load or "coordinates" in self._functions.errors.conditions

    @property
    def _has_load(self) -> bool:
        """True if effects depend on the load, and conditions state it."""
        return self._conditions is not None and "load" in self._functions.errors.conditions

    def inputs(self, drives: Array, passive: Array) -> tuple[Array, Array, Array]:
        """Inputs of the robot's functions (`RobotFunctions`) in postures of one machine.

        Args:
            drives: Commanded drive coordinates, shape (K, n_drives), [m, rad], or commands, shape
                (K, n_command).
            passive: Shape (K, n_passive), [m, rad].
        """
        commands = self.commands(drives)
        geometry, _ = self._batch(commands)
        return geometry.drives(commands)[0], passive, geometry.placements

    def _all_errors(self, theta: ArrayLike | None, errors: ArrayLike | None) -> Array:
        """All elementary errors of a call that states either theta or errors."""
        return self.errors(theta) if errors is None else np.asarray(errors, dtype=np.float64)

    def _theta(self, theta: ArrayLike | None) -> Array:
        """Values of the free parameters, shape (n_free,) or (S, n_free); 0 by default."""
        if theta is None:
            return np.zeros(len(self.free))
        values, single = as_rows(theta, len(self.free), "values of the free parameters")
        return np.asarray(values[0] if single else values)

    def _batch(
        self, commands: Array, *, theta: ArrayLike | None = None, errors: ArrayLike | None = None
    ) -> tuple[MachineGeometry, bool]:
        """Geometry with a leading dimension, and True if the arguments were a batch."""
        values = self._all_errors(theta, errors)
        return self._functions.errors.geometry(np.atleast_2d(values), commands), values.ndim > 1

    def _as_commands(self, drives: ArrayLike) -> tuple[Array, bool]:
        """Commands, shape (K, n_command), and True if they were a single row."""
        values, map_ = np.asarray(drives), self._functions.errors
        n = len(self.robot.drives)
        if values.shape[-1:] == (n + map_.n_conditions,):
            n += map_.n_conditions
        rows, single = as_rows(drives, n, "drive coordinates")
        return self.commands(rows), single

    @cached_property
    def _closing(self) -> System:
        """Equations of the passive coordinates for commands."""
        robot, function = self.robot, self._functions.closure_by_passive
        map_ = self._functions.errors

        def prepare(p: Array, geometry: MachineGeometry) -> Array:
            return map_.actuate(p, geometry.drive_errors)

        def evaluate(x: Array, actuated: Array, geometry: MachineGeometry) -> tuple[Array, Array]:
            g, g_q = function(actuated, x, geometry.placements)
            return g, g_q

        return System(
            robot,
            evaluate,
            prepare=prepare,
            index=robot.passive_index,
            start=robot.reference_passive,
            origin=map_.command(robot.drive_zero),
        )

    @cached_property
    def _closing_freely(self) -> System:
        """Equations of `_closing`, solved by the shortest steps."""
        system = copy.copy(self._closing)
        system.shortest = True
        return system

    @cached_property
    def _inverting(self) -> System:
        """Equations of drive and passive coordinates for tool positions and conditions."""
        robot = self.robot
        axes = list(require_commanded_tool(robot))
        function, n_d = self._functions.closure_and_tool, len(robot.drives)
        map_ = self._functions.errors

        def evaluate(x: Array, p: Array, geometry: MachineGeometry) -> tuple[Array, Array]:
            d, q = x[:, :n_d], x[:, n_d:]
            target, conditions = p[:, : len(axes)], p[:, len(axes) :]
            commands = np.hstack([d, conditions])
            actuated = map_.actuate(commands, geometry.drive_errors)
            by_commands, _ = map_.differentiate_drives(commands, geometry.drive_errors)
            g, g_a, g_q, tool, t_a, t_q = function(actuated, q, geometry.placements)
            residuals = np.concatenate([g, tool[:, axes] - target], axis=1)
            by_drives = np.concatenate([g_a, t_a[:, axes]], axis=1) @ by_commands
            by_passive = np.concatenate([g_q, t_q[:, axes]], axis=1)
            return residuals, np.concatenate([by_drives, by_passive], axis=2)

        index = np.concatenate([robot.drive_index, robot.passive_index])
        tool_at_zero = nominal_closure(robot).tcp(robot.drive_zero, robot.reference_passive)
        neutral = map_.command(robot.drive_zero)[n_d:]
        origin = np.concatenate([tool_at_zero[axes], neutral])
        start = np.concatenate([robot.drive_zero, robot.reference_passive])
        return System(
            robot,
            evaluate,
            prepare=lambda p, _: p,
            index=index,
            start=start,
            origin=origin,
            n_tool=len(axes),
        )


@cached_per_robot
def _solutions(robot: Robot) -> ArrayCache:
    """Cache of solutions of a robot's closures, which several models of a session share."""
    return ArrayCache(SOLUTION_CACHE_SIZE)


@cached_per_robot
def nominal_closure(robot: Robot) -> LoopClosure:
    """Loop closure solver of a robot without errors, built once."""
    return LoopClosure(robot)


@cached_per_robot
def _rod_forces(robot: Robot) -> tuple[RodForces, ArrayCache]:
    """Rod forces of a robot, and a cache of them for sets of postures.

    The same postures recur under several payloads and with several machines.
    """
    return RodForces(robot), ArrayCache(FORCE_CACHE_SIZE)


def _unit_rod_forces(robot: Robot, drives: Array) -> Array:
    """Axial forces ∂p/∂ℓ of all rods per unit force on the tool; 0 in postures out of reach.

    Args:
        robot: The nominal robot.
        drives: Shape (K, n_drives), [m, rad].

    Returns:
        Shape (K, n_rods, 3).
    """
    forces, cache = _rod_forces(robot)

    def compute() -> Array:
        result = np.zeros((len(drives), len(robot.rods), 3))
        passive = nominal_closure(robot).close(drives, failures={}) if drives.size else drives
        reached = np.isfinite(passive).all(axis=1)
        if reached.any():
            result[reached] = forces(robot.joint_coordinates(drives[reached], passive[reached]))
        return result

    return cache.find(drives.tobytes(), compute)


def find_loads(robot: Robot, drives: Array, payload: ArrayLike) -> Array:
    """Axial forces of the rods of the nominal machine under the weight on its tool.

    Args:
        robot: The nominal robot.
        drives: Commanded drive coordinates, shape (K, n_drives), [m, rad].
        payload: Mass on the tool in addition to the platform, one value or shape (K,), [kg].

    Returns:
        Shape (K, n_rods), [N], tension positive; 0 in postures that the nominal machine cannot
        reach.
    """
    masses, mass_of = np.unique(np.broadcast_to(payload, len(drives)), return_inverse=True)
    effects = robot_effects(robot)
    forces = np.array([[e.tool_force(float(m)) for e in effects] for m in masses])
    on_tool = forces.reshape(-1, len(effects), 3).sum(axis=1)[mass_of]
    return np.asarray(np.einsum("kri,ki->kr", _unit_rod_forces(robot, drives), on_tool))


def find_beyond_travel(robot: Robot, drives: Array, names: Sequence[str] | None = None) -> Failures:
    """Indices of the postures beyond the travel of a drive, ascending, mapped to the reason.

    Args:
        robot: The robot.
        drives: Drive coordinates, shape (K, n_drives), [m, rad].
        names: Names of the postures, for messages; by default their numbers.
    """
    failures, labels = Failures(), label_postures(names, len(drives))
    for drive, values in zip(robot.drives, drives.T, strict=True):
        size = drive.joint_size
        for i in np.flatnonzero(drive.is_beyond(values)).tolist():
            reason = (
                f"{drive.name}_{drive.joint_unit} is {values[i] / size:g}; the drive reaches from "
                f"{drive.lower / size:g} to {drive.upper / size:g}"
            )
            failures.setdefault(i, ClosureError(reason, posture=labels[i]))
    return dict(sorted(failures.items()))


def require_within_travel(robot: Robot, drives: Array, names: Sequence[str] | None = None) -> None:
    """Refuse drive coordinates beyond the travel of a drive; arguments of `find_beyond_travel`.

    Args:
        robot: The robot.
        drives: Drive coordinates, shape (K, n_drives), [m, rad].
        names: Names of the rows, for messages.

    Raises:
        ClosureError: If a posture is beyond the travel; names the first one, and the drive.
    """
    for failure in find_beyond_travel(robot, drives, names).values():
        raise failure


def _as_numbers(values: ArrayLike, n: int, noun: str) -> Array:
    """Numbers as an array.

    Raises:
        ValueError: If they are not numbers, or rows have different lengths.
    """
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"found {type(values).__name__}; expected {n} {noun} per row") from None


def as_rows(values: ArrayLike, n: int, noun: str) -> tuple[Array, bool]:
    """Numbers as an array of shape (K, n), and True if they were a single row.

    Raises:
        ValueError: If they are not numbers, or if a row does not have n of them.
    """
    array = _as_numbers(values, n, noun)
    if array.ndim not in (1, 2) or array.shape[-1] != n:
        raise ValueError(f"found the shape {array.shape}; expected {n} {noun} per row, (K, {n})")
    return np.atleast_2d(array), array.ndim == 1
