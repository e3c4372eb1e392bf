"""Solver of the loop closures g(q, θ) = 0, for batches of machines and postures.

Forward: commanded drives to passive coordinates and tool centre point. Inverse: tool centre point
to drives. Newton's method works on all postures of all machines at once. A posture that it does not
reach from the start is approached along a straight path from the reference posture, in steps short
enough to stay in the assembly mode in which the machine was built.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.arguments import require_kind
from orthocal.arrays import Array, Indices, Mask
from orthocal.effects.rod_forces import RodForces
from orthocal.errors import ClosureError
from orthocal.kinematics.conditions import UseConditions, tool_force
from orthocal.kinematics.error_map import MachineGeometry
from orthocal.kinematics.function_cache import cached_per_robot
from orthocal.kinematics.robot_functions import robot_functions
from orthocal.robot.closing import describe_opening
from orthocal.robot.model import (
    Robot,
    closure_row_units,
    closure_turns,
    coordinate_limits,
    coordinate_names,
    coordinate_units,
    require_commanded_tool,
    require_tcp,
)
from orthocal.units import DRIVE_UNITS

Evaluate = Callable[[Array, Array, MachineGeometry], tuple[Array, Array]]
Failures = dict[int, ClosureError]
"""Index of a posture to the reason why it cannot be reached. In a batch of machines, posture k of
machine s of K postures has the index s K + k."""

CLOSED = 1e-12
"""Largest scaled residual of closed loops, relative to max(1 m, characteristic length), [m]."""

SINGULAR_BELOW = 1e-5
"""Ratio of smallest to largest singular value below which a posture counts as singular. Near a
singular posture Newton stops where the residual, quadratic in the distance, is below CLOSED: a
smaller ratio would not be noticed. The Orthoglide has 1/20 to 1/60."""

SAFETY = 0.1
"""Part of that bound at which rounding errors of an inverse do not matter."""

MAX_NEWTON_STEP = 1e3
"""A longer Newton step comes from rows that depend on each other, [m or rad]."""

MAX_LAST_STEP = 1e-6
"""A longer step from closed loops is that of a nearly singular posture, [m or rad]."""

MAX_NEWTON_STEPS = 30
MAX_STEP_HALVINGS = 6
SMALLEST_CONTINUATION_STEP = 1.0 / 512.0
LARGEST_CONTINUATION_MOVE = 0.3
"""Change of a passive coordinate in one continuation step, [rad] or characteristic lengths."""

LIMIT_TOLERANCE = 1e-9

MOST_TRANSMISSIONS = 8
"""Tables of postures whose rod forces are remembered for one robot."""

MOST_LOADS = 10
SETTLED_LOAD = 1e-7
"""Relative change of the loads of an inverse below which its drive coordinates do not change. Each
repetition reduces it at least a hundred times."""

MAX_POINTS = 4096
"""Postures of a batch of machines that are solved together, for the memory of their Jacobians."""


class System:
    """Equations r(x, p) = 0 of many postures, in metres: closures, then coordinates of the tool.

    Args:
        robot: The robot.
        evaluate: (x, p, geometry) to residuals, (n, n_rows), and Jacobians by x, (n, n_rows, n_x).
        index: Joint coordinates that are x, shape (n_x,).
        start: x of the nominal machine's reference posture, shape (n_x,).
        origin: p of the nominal machine's reference posture, shape (n_p,).
        n_tool: Number of tool coordinates.

    Attributes:
        shortest: Take the shortest steps that close the loops, for robots with free motions: the
            solution of a system that is singular up to rounding is no useful step.
        units: Metres per unit of x, shape (n_x,).
        lower: Lower bounds of x, shape (n_x,).
        upper: Upper bounds of x, shape (n_x,).
        names: Joint of each x.
    """

    def __init__(
        self,
        robot: Robot,
        evaluate: Evaluate,
        *,
        index: Indices,
        start: Array,
        origin: Array,
        n_tool: int = 0,
    ) -> None:
        self.robot, self.evaluate, self.start, self.origin = robot, evaluate, start, origin
        self.n_x = index.size
        self.shortest = robot.closure_rows + n_tool != index.size
        self.units = coordinate_units(robot)[index]
        self.lower, self.upper = (limits[index] for limits in coordinate_limits(robot))
        names = coordinate_names(robot.model)
        self.names = tuple(names[k] for k in index.tolist())
        self._row_units = np.append(closure_row_units(robot), np.ones(n_tool))
        self._turns = np.append(closure_turns(robot), np.zeros(n_tool, dtype=np.bool_))

    def step(self, residuals: Array, jacobians: Array) -> Array:
        """Newton steps, shape (n, n_x); least squares where rows depend on each other."""
        if self.shortest:
            return self._shortest_step(residuals, jacobians)
        try:
            steps = np.asarray(np.linalg.solve(jacobians, -residuals[..., None])[..., 0])
        except np.linalg.LinAlgError:
            return self._shortest_step(residuals, jacobians)
        singular = ~(np.abs(steps).max(axis=1, initial=0.0) < MAX_NEWTON_STEP)
        if singular.any():
            steps[singular] = self._shortest_step(residuals[singular], jacobians[singular])
        return steps

    def _shortest_step(self, residuals: Array, jacobians: Array) -> Array:
        steps = np.full((len(residuals), self.n_x), np.nan)  # no step: the caller drops the posture
        usable = np.isfinite(jacobians).all(axis=(1, 2))
        inverse = np.linalg.pinv(jacobians[usable], rcond=1e-10)
        with np.errstate(over="ignore"):
            steps[usable] = -(inverse @ residuals[usable][..., None])[..., 0]
        return steps

    def regular_step(self, residuals: Array, jacobians: Array) -> tuple[Array, Mask]:
        """Newton steps, and a mask of the Jacobians that are certainly not singular.

        The ratio of singular values is at least 1/(|A| |A⁻¹|) by Frobenius' norm, with the inverse
        that the step needs anyway.
        """
        try:
            if self.shortest:
                raise np.linalg.LinAlgError
            inverses = np.linalg.inv(jacobians)
        except np.linalg.LinAlgError:
            return self.step(residuals, jacobians), np.zeros(len(residuals), dtype=np.bool_)
        size = np.linalg.norm(jacobians / self.units, axis=(1, 2))
        inverse_size = np.linalg.norm(inverses * self.units[:, None], axis=(1, 2))
        steps = -(inverses @ residuals[..., None])[..., 0]
        return steps, np.asarray(size * inverse_size < SAFETY / SINGULAR_BELOW)

    def describe_beyond(self, j: int, value: float) -> str:
        """Position and limits of a joint in words; a drive's as the controller counts."""
        drives = {d.name: d for d in self.robot.drives}
        if self.names[j] in drives:
            return drives[self.names[j]].describe_beyond(value)
        unit, size = DRIVE_UNITS["m" if self.units[j] == 1.0 else "rad"]
        low, high = self.lower[j] / size, self.upper[j] / size
        return f"at {value / size:.4g} {unit}, outside its limits {low:g} ... {high:g} {unit}"

    def describe(self, x: Array, p: Array, geometry: MachineGeometry) -> str:
        """Openings of the loops of one posture, in words."""
        residuals, _ = self.evaluate(x[None], p[None], geometry)
        return describe_opening(residuals[0] / self._row_units, self._turns)


def solve_closures(
    system: System,
    targets: Array,
    geometry: MachineGeometry,
    *,
    machines: int,
    start: ArrayLike | None = None,
    names: Sequence[str] | None = None,
    failures: Failures | None = None,
    allow_singular: bool = True,
) -> Array:
    """Newton's method along the straight path from the reference posture, or a start, to targets.

    The first trial covers the complete path. Postures that do not converge, or may have changed
    their assembly mode, are approached in halved steps.

    Args:
        system: The equations.
        targets: p of each posture, shape (K, n_p).
        geometry: S machines, or S machines in K postures.
        machines: S.
        start: x to start from, shape (n_x,), (K, n_x) or (S, K, n_x); by default the system's.
        names: Names of the postures, for messages.
        failures: As for `LoopClosure.close`.
        allow_singular: Accept targets that leave motions free.

    Returns:
        x, shape (S, K, n_x).

    Raises:
        ClosureError: As `LoopClosure.close`.
    """
    count = len(targets)
    labels = [f"posture {i + 1}" for i in range(count)] if names is None else names
    if len(labels) != count:
        raise ValueError(f"found {len(labels)} names for {count} rows")
    first = system.start if start is None else np.asarray(start, dtype=np.float64)
    if first.shape[-1:] != (system.n_x,):
        raise ValueError(f"found the shape {first.shape}; expected {system.n_x} start values a row")
    begin = np.broadcast_to(first, (machines, count, system.n_x))
    x = np.array(begin).reshape(machines * count, system.n_x)
    for i in range(0, len(x), MAX_POINTS):
        points = np.arange(i, min(i + MAX_POINTS, len(x)))
        path = _Path(
            system,
            targets[points % count],
            geometry.at(points, len(x)),
            points=points,
            labels=labels,
            failures=failures,
            allow_singular=allow_singular,
        )
        x[points] = path.follow(x[points], restart=start is not None)
    return x.reshape(begin.shape)


class _Path:
    """Continuation of some points of a batch of machines from the reference posture to targets.

    Args:
        system: The equations.
        targets: p of each point, shape (n, n_p).
        geometry: One row for all points, or a row for each.
        points: Index of each point in the batch, shape (n,).
        labels: Names of the postures of a machine, for messages.
        failures: As for `LoopClosure.close`.
        allow_singular: Accept targets that leave motions free.
    """

    def __init__(
        self,
        system: System,
        targets: Array,
        geometry: MachineGeometry,
        *,
        points: NDArray[np.intp],
        labels: Sequence[str],
        failures: Failures | None,
        allow_singular: bool,
    ) -> None:
        self._system, self._targets, self._geometry = system, targets, geometry
        self._points, self._labels, self._failures = points, labels, failures
        self._allow_singular = allow_singular
        length = system.robot.characteristic_length
        self._tolerance = CLOSED * max(1.0, length)
        self._moves = LARGEST_CONTINUATION_MOVE * np.where(system.units == 1.0, length, 1.0)
        self._refused = np.zeros(len(points), dtype=np.bool_)

    def _refuse(self, i: int, reason: str, residual: float | None = None) -> None:
        """Record that a point cannot be reached.

        Raises:
            ClosureError: If failures are not collected.
        """
        point = int(self._points[i])
        posture = self._labels[point % len(self._labels)]
        error = ClosureError(reason, posture=posture, residual=residual)
        if self._failures is None:
            raise error
        self._failures.setdefault(point, error)
        self._refused[i] = True

    def follow(self, start: Array, *, restart: bool) -> Array:
        """Solutions, NaN at refused points, shape (n, n_x).

        Args:
            start: x to start from, shape (n, n_x).
            restart: Begin again at the reference posture where the start does not help.
        """
        system, targets, count = self._system, self._targets, len(self._targets)
        for i in np.flatnonzero(~np.isfinite(targets).all(axis=1)).tolist():
            self._refuse(i, "has coordinates that are not numbers")
        x, regular = np.array(start), np.full(count, self._allow_singular)
        done, step = np.zeros(count), np.ones(count)
        pending, fresh = np.flatnonzero(~self._refused), np.full(count, restart)
        while pending.size:
            reach = np.minimum(1.0, done[pending] + step[pending])
            path = system.origin + reach[:, None] * (targets[pending] - system.origin)
            trial, worst, checked = self._newton(pending, x[pending], path)
            moved = (np.abs(trial - x[pending]) < self._moves).all(axis=1)
            good = (worst < self._tolerance) & moved
            reached, failed = pending[good], pending[~good]
            x[reached], done[reached] = trial[good], reach[good]
            if not self._allow_singular:
                regular[reached] = checked[good]
            retry = failed[fresh[failed]]  # the start was no help: use the reference posture
            x[retry], step[retry] = system.start, 2.0
            fresh[pending] = False
            step[failed] *= 0.5
            for i in failed[step[failed] < SMALLEST_CONTINUATION_STEP].tolist():
                self._refuse_unreached(i, x[[i]], done[i])
            pending = pending[(done[pending] < 1.0) & ~self._refused[pending]]
        self._refuse_outside_limits(x)
        uncertain = np.flatnonzero(~regular & ~self._refused)
        if uncertain.size and system.n_x:
            self._refuse_singular(x, uncertain)
        x[self._refused] = np.nan
        return x

    def _refuse_unreached(self, i: int, x: Array, done: float) -> None:
        """Refuse a point that continuation does not reach beyond a part of the way."""
        target = self._targets[[i]]
        last, worst, _ = self._newton(np.array([i]), x, target)
        if worst[0] < self._tolerance:
            reason = (
                "cannot be reached from the mechanical zero without changing the way in "
                f"which the loops are assembled, {done:.0%} of the way"
            )
        else:
            at = self._geometry.at(np.array([i]), len(self._points))
            reason = (
                "cannot be reached: the loops stay open by "
                f"{self._system.describe(last[0], target[0], at)}, {done:.0%} of the way "
                "from the mechanical zero"
            )
        self._refuse(i, reason, float(worst[0]))

    def _refuse_outside_limits(self, x: Array) -> None:
        """Refuse solutions with a joint outside its limits."""
        system = self._system
        beyond = np.maximum(x - system.upper, system.lower - x)
        outside = ~(beyond <= LIMIT_TOLERANCE).all(axis=1)
        for i in np.flatnonzero(outside & ~self._refused).tolist():
            j = int(beyond[i].argmax())
            where = system.describe_beyond(j, float(x[i][j]))
            reason = f"cannot be reached: joint '{system.names[j]}' would be {where}"
            self._refuse(i, reason, 0.0)

    def _refuse_singular(self, x: Array, rows: NDArray[np.intp]) -> None:
        """Refuse solutions at some points that leave motions free, the most singular one first."""
        system, at = self._system, self._geometry.at(rows, len(self._points))
        _, jacobians = system.evaluate(x[rows], self._targets[rows], at)
        values = np.linalg.svd(jacobians / system.units, compute_uv=False)
        smallest = values[:, system.n_x - 1] if values.shape[1] >= system.n_x else 0.0
        largest = values.max(axis=1, initial=0.0)  # without closures there are no values
        ratio = np.broadcast_to(smallest / np.maximum(largest, 1e-300), rows.shape)
        for k in np.argsort(ratio)[: int((ratio < SINGULAR_BELOW).sum())].tolist():
            rank = int((values[k] > SINGULAR_BELOW * largest[k]).sum())
            reason = (
                f"is singular: the drives leave {system.n_x - rank} of {system.n_x} passive "
                "motions free"
            )
            self._refuse(int(rows[k]), reason)

    def _newton(
        self, points: NDArray[np.intp], start: Array, p: Array
    ) -> tuple[Array, Array, Mask]:
        """Damped Newton's method of some points at once.

        Returns:
            Solutions, shape (n, n_x), the largest residual of each, shape (n,), [m], and a mask of
            the solutions that are certainly not singular (if that matters).
        """
        system, tolerance, x = self._system, self._tolerance, np.array(start)

        def evaluate(rows: NDArray[np.intp], x: Array) -> tuple[Array, Array, Array]:
            at = self._geometry.at(points[rows], len(self._points))
            residuals, jacobians = system.evaluate(x, p[rows], at)
            return residuals, jacobians, np.abs(residuals).max(axis=1, initial=0.0)

        residuals, jacobians, worst = evaluate(np.arange(len(x)), x)
        active = np.flatnonzero(worst >= tolerance)
        for _ in range(MAX_NEWTON_STEPS):
            if not active.size:
                break
            step = system.step(residuals[active], jacobians[active])
            usable = np.isfinite(step).all(axis=1)
            rows, step = active[usable], step[usable]
            moved = []
            for _ in range(MAX_STEP_HALVINGS):
                trial = x[rows] + step
                r, j, size = evaluate(rows, trial)
                better = size < worst[rows]
                good = rows[better]
                x[good], residuals[good], jacobians[good] = trial[better], r[better], j[better]
                worst[good] = size[better]
                moved.append(good)
                rows, step = rows[~better], 0.25 * step[~better]
                if not rows.size:
                    break
            active = np.sort(np.concatenate(moved))
            active = active[worst[active] >= tolerance]
        regular = np.zeros(len(x), dtype=np.bool_)
        closed = np.flatnonzero((worst < tolerance) & np.isfinite(jacobians).all(axis=(1, 2)))
        if closed.size and system.n_x:  # a last step without evaluation: its Jacobian is at hand
            found = residuals[closed], jacobians[closed]
            if self._allow_singular:
                step = system.step(*found)
            else:
                step, regular[closed] = system.regular_step(*found)
            small = np.abs(step).max(axis=1) < MAX_LAST_STEP
            x[closed[small]] += step[small]
        return x, worst, regular


class LoopClosure:
    """Solver of the loop closures of machines with some errors fixed and some passed to each call.

    `theta` has shape (n_free,) for one machine or (S, n_free) for a batch of machines; `errors`
    passes all elementary errors instead, shape (n_errors,) or (S, n_errors). Results of a batch
    have a leading dimension S.

    Args:
        robot: The nominal robot.
        free: Names of the parameters whose values are passed to each call as `theta`, in order.
        fixed: Values of other parameters, [unit of the parameter]; 0 where absent.
        conditions: Conditions of the postures whose commands do not state them; neutral by default:
            middle of both sides of each drive, reference temperature, weightless.
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
        self._columns = self._functions.errors.columns(self.free)
        self.fixed = {k: v for k, v in (fixed or {}).items() if k not in self.free}
        """Values of the parameters that are not free."""
        self._fixed = self._functions.errors.expand(self.fixed)

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
                commands, which hold conditions too (`error_map`).
            theta: Values of the free parameters; 0 by default.
            errors: All elementary errors, instead of theta.
            start: Passive coordinates to start from, shape (n_passive,), (K, n_passive) or
                (S, K, n_passive); the reference posture by default.
            names: Names of the postures, for messages.
            allow_free: Accept loops that leave passive motions free, as those of a robot that is
                only displayed; the passive coordinates then move as little as possible.
            failures: Filled with the postures that cannot be reached, which are NaN then; by
                default the first of them raises.

        Returns:
            Shape (K, n_passive), or (n_passive,) for one posture; a batch has S in front.

        Raises:
            ClosureError: If a posture cannot be reached, is outside the limits of a passive joint
                or, unless free motions are allowed, singular; names the posture and the residual.
        """
        d, single = self._as_commands(drives)
        geometry, batch = self._batch(theta, errors, d)
        system = self._closing
        if allow_free:
            system = copy.copy(system)
            system.shortest = True
        passive = solve_closures(
            system,
            d,
            geometry,
            machines=len(geometry.drive_errors),
            start=start,
            names=names,
            failures=failures,
            allow_singular=allow_free,
        )
        passive = passive if batch else passive[0]
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
            start: As for `close`.
            names: Names of the postures, for messages.
            failures: As for `close`.

        Returns:
            Shape (K, 3) or (3,), [m]; a batch has S in front.

        Raises:
            ClosureError: As `close`.
            RobotError: If the robot has no tool centre point.
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
            points: The coordinates of the tool that the drives control, shape (K, n_drives) or
                (n_drives,), [m].
            names: Names of the postures, for messages.
            failures: As for `close`.

        Returns:
            Shape (K, n_drives) or (n_drives,), [m, rad].

        Raises:
            ClosureError: If a point cannot be reached.
            RobotError: If the robot has no tool centre point with as many coordinates as drives.
        """
        p, single = as_rows(points, len(require_tcp(self.robot).coordinates), "coordinates")
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

        Args:
            points: As for `inverse`, shape (K, n_drives).
            start: Drive and passive coordinates to start from, shape (K, n_drives + n_passive); the
                reference posture by default.
            names: As for `inverse`.
            failures: As for `inverse`.

        Returns:
            Drive coordinates, shape (K, n_drives), and passive ones, shape (K, n_passive).

        Raises:
            ClosureError, RobotError: As `inverse`.
        """
        n = len(self.robot.drives)
        if not self._has_load:
            x = self._reach(points, np.zeros((len(points), n)), start, names, failures)
            return x[:, :n], x[:, n:]
        drives = nominal_closure(self.robot).inverse(points, failures={})
        commands = self.commands(drives)
        for _ in range(MOST_LOADS):
            x = self._reach(points, commands[:, :n], start, names, failures)
            before, commands = commands[:, n:], self.commands(x[:, :n])
            change = np.abs(commands[:, n:] - before).max(initial=0.0)
            if change <= SETTLED_LOAD * np.abs(before).max(initial=0.0):
                break
            start = np.where(np.isfinite(x), x, self._inverting.start)
        return x[:, :n], x[:, n:]

    def _reach(
        self,
        points: Array,
        loaded_at: Array,
        start: Array | None,
        names: Sequence[str] | None,
        failures: Failures | None,
    ) -> Array:
        """Joint coordinates of `reach` under the loads at given drive coordinates."""
        commands = self.commands(loaded_at)
        geometry, _ = self._batch(None, None, commands)
        x: Array = solve_closures(
            self._inverting,
            np.hstack([points, commands[:, len(self.robot.drives) :]]),
            geometry,
            machines=1,
            start=start,
            names=names,
            failures=failures,
        )[0]
        return x

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
            drives: Commanded, shape (K, n_drives) or (n_drives,), [m, rad].
            passive: As `close` returns them for these drives.
            theta: As for `close`.
            errors: As for `close`.

        Returns:
            Shape (K, 3) or (3,), [m]; a batch has S in front.
        """
        frame = require_tcp(self.robot).frame
        d, single = self._as_commands(drives)
        geometry, batch = self._batch(theta, errors, d)
        machines, n = len(geometry.drive_errors), self.robot.passive_index.size
        q = np.asarray(passive, dtype=np.float64)
        if q.ndim == 0 or q.shape[-1] != n:
            raise ValueError(f"found the shape {q.shape}; expected {n} passive coordinates a row")
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
        """All elementary errors for values of the free ones, shape (..., n_errors), [SI]."""
        return np.asarray(self._fixed + self._theta(theta) @ self._columns.T)

    def geometry(self, theta: ArrayLike | None = None) -> MachineGeometry:
        """Geometry of machines for values of the free parameters; 0 by default."""
        return self._functions.errors.geometry(self.errors(theta))

    def commands(self, drives: Array) -> Array:
        """Commands of drive coordinates under the closure's conditions; commands stay as they are.

        Args:
            drives: Shape (K, n_drives), or commands, shape (K, n_command).

        Returns:
            Shape (K, n_command).
        """
        map_, conditions = self._functions.errors, self._conditions
        if conditions is None or drives.shape[1] > len(self.robot.drives) or not map_.n_conditions:
            return map_.command(drives)
        values = conditions.values(self.robot)
        if self._has_load:
            values["load"] = find_loads(self.robot, drives, conditions.payload or 0.0)
        parts = [values[c] for c in map_.conditions]
        stated = [np.broadcast_to(v, (len(drives), v.shape[-1])) for v in parts]
        return np.hstack([drives, *stated])

    @property
    def _has_load(self) -> bool:
        return self._conditions is not None and "load" in self._functions.errors.conditions

    def inputs(self, drives: Array, passive: Array) -> tuple[Array, Array, Array]:
        """Inputs of the robot's functions (`RobotFunctions`) in postures of one machine.

        Args:
            drives: Commanded, shape (K, n_drives), [m, rad], or commands, shape (K, n_command).
            passive: Shape (K, n_passive), [m, rad].
        """
        commands = self.commands(drives)
        geometry, _ = self._batch(None, None, commands)
        return geometry.drives(commands)[0], passive, geometry.placements

    def _theta(self, theta: ArrayLike | None) -> Array:
        if theta is None:
            return np.zeros(len(self.free))
        values, single = as_rows(theta, len(self.free), "values of the free parameters")
        return np.asarray(values[0] if single else values)

    def _batch(
        self, theta: ArrayLike | None, errors: ArrayLike | None, commands: Array | None = None
    ) -> tuple[MachineGeometry, bool]:
        """Geometry with a leading dimension, and whether the arguments were a batch."""
        at: Array = self.errors(theta) if errors is None else np.asarray(errors, dtype=np.float64)
        return self._functions.errors.geometry(np.atleast_2d(at), commands), at.ndim > 1

    def _as_commands(self, drives: ArrayLike) -> tuple[Array, bool]:
        """Commands, shape (K, n_command), and whether they were a single row."""
        values, map_ = np.asarray(drives), self._functions.errors
        n = len(self.robot.drives)
        if values.shape[-1:] == (n + map_.n_conditions,):
            n += map_.n_conditions
        rows, single = as_rows(drives, n, "drive coordinates")
        return self.commands(rows), single

    @cached_property
    def _closing(self) -> System:
        robot, function = self.robot, self._functions.closure_by_passive
        map_ = self._functions.errors

        def evaluate(x: Array, p: Array, geometry: MachineGeometry) -> tuple[Array, Array]:
            actuated = map_.actuate(p, geometry.drive_errors)
            g, g_q = function(actuated, x, geometry.placements)
            return g, g_q

        return System(
            robot,
            evaluate,
            index=robot.passive_index,
            start=robot.reference_passive,
            origin=map_.command(robot.drive_zero),
        )

    @cached_property
    def _inverting(self) -> System:
        robot = self.robot
        chosen = list(require_commanded_tool(robot))
        function, n_d = self._functions.closure_and_tool, len(robot.drives)
        map_ = self._functions.errors

        def evaluate(x: Array, p: Array, geometry: MachineGeometry) -> tuple[Array, Array]:
            d, q = x[:, :n_d], x[:, n_d:]
            target, conditions = p[:, : len(chosen)], p[:, len(chosen) :]
            commands = np.hstack([d, conditions])
            actuated = map_.actuate(commands, geometry.drive_errors)
            by_commands, _ = map_.differentiate_drives(commands, geometry.drive_errors)
            g, g_a, g_q, tool, t_a, t_q = function(actuated, q, geometry.placements)
            residuals = np.concatenate([g, tool[:, chosen] - target], axis=1)
            by_drives = np.concatenate([g_a, t_a[:, chosen]], axis=1)
            by_drives = by_drives @ by_commands
            by_passive = np.concatenate([g_q, t_q[:, chosen]], axis=1)
            return residuals, np.concatenate([by_drives, by_passive], axis=2)

        index = np.concatenate([robot.drive_index, robot.passive_index])
        tool_at_zero = nominal_closure(robot).tcp(robot.drive_zero, robot.reference_passive)
        neutral = map_.command(robot.drive_zero)[n_d:]
        origin = np.concatenate([tool_at_zero[chosen], neutral])
        start = np.concatenate([robot.drive_zero, robot.reference_passive])
        return System(robot, evaluate, index=index, start=start, origin=origin, n_tool=len(chosen))


@cached_per_robot(maxsize=8)
def nominal_closure(robot: Robot) -> LoopClosure:
    """The loop closure solver of a robot without errors, built once."""
    return LoopClosure(robot)


class _Transmissions:
    """Axial forces of the rods by forces on the tool, remembered for a few tables of postures.

    The same postures recur under several payloads and with several machines.

    Args:
        robot: The nominal robot.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot, self._forces = robot, RodForces(robot)
        self._find = lru_cache(maxsize=MOST_TRANSMISSIONS)(self._compute)

    def __call__(self, drives: Array) -> Array:
        """∂p/∂ℓ of all rods, 0 where the machine cannot be, shape (K, n_rods, 3)."""
        return self._find(np.ascontiguousarray(drives).tobytes())

    def _compute(self, content: bytes) -> Array:
        robot, n = self._robot, len(self._robot.drives)
        drives = np.frombuffer(content).reshape(-1, n)
        result = np.zeros((len(drives), len(robot.rods), 3))
        passive = nominal_closure(robot).close(drives, failures={}) if drives.size else drives
        reached = np.isfinite(passive).all(axis=1)
        if reached.any():
            coordinates = robot.joint_coordinates(drives[reached], passive[reached])
            result[reached] = self._forces(coordinates)
        return result


@cached_per_robot(maxsize=8)
def _transmissions(robot: Robot) -> _Transmissions:
    """The transmissions of a robot, prepared once."""
    return _Transmissions(robot)


def find_loads(robot: Robot, drives: Array, payload: ArrayLike) -> Array:
    """Axial forces of the rods of the nominal machine under the weight on its tool.

    Args:
        robot: The nominal robot.
        drives: Commanded drive coordinates, shape (K, n_drives), [m, rad].
        payload: Mass on the tool beside the platform, of all postures or of each, [kg].

    Returns:
        Tension positive, shape (K, n_rods), [N]; 0 where the nominal machine cannot be.
    """
    masses, which = np.unique(np.broadcast_to(payload, len(drives)), return_inverse=True)
    forces = np.array([tool_force(robot, float(m)) for m in masses]).reshape(-1, 3)[which]
    return np.asarray(np.einsum("kri,ki->kr", _transmissions(robot)(drives), forces))


def find_beyond_travel(robot: Robot, drives: Array, names: Sequence[str]) -> Failures:
    """Rows of drive coordinates beyond a drive's travel, with the reason.

    Args:
        robot: The robot.
        drives: Shape (K, n_drives), [m, rad].
        names: Names of the postures, for messages.
    """
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


def as_rows(values: ArrayLike, n: int, noun: str) -> tuple[Array, bool]:
    """Numbers as an array of shape (K, n), and whether they were a single row.

    Raises:
        ValueError: If they are not numbers, or not n in a row.
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"found {type(values).__name__}; expected {n} {noun} a row") from None
    if array.ndim not in (1, 2) or array.shape[-1] != n:
        raise ValueError(f"found the shape {array.shape}; expected {n} {noun} a row, (K, {n})")
    return np.atleast_2d(array), array.ndim == 1
