"""Solver of the loop closures g(q, θ) = 0, for batches of machines and postures.

Forward: commanded drives to passive coordinates and tool centre point. Inverse: tool centre point
to drives. Newton's method works on all postures of all machines at once. A posture that it does not
reach from the start is approached along a straight path from the reference posture, in steps short
enough to stay in the assembly mode in which the machine was built.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.arguments import require_kind
from orthocal.errors import ClosureError
from orthocal.kinematics.error_map import MachineGeometry
from orthocal.kinematics.function_cache import cached_per_robot
from orthocal.kinematics.robot_functions import robot_functions
from orthocal.robot.closing import describe_opening
from orthocal.robot.model import (
    Robot,
    closure_row_units,
    closure_turns,
    coordinate_joints,
    coordinate_limits,
    coordinate_units,
    require_commanded_tool,
    require_tcp,
)
from orthocal.units import DRIVE_UNITS

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
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

MAX_POINTS = 4096
"""Postures of a batch of machines that are solved together, for the memory of their Jacobians."""


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """Equations r(x, p) = 0 of many postures, in metres: square, or with redundant rows."""

    evaluate: Evaluate
    """(x, p, geometry) to residuals, (n, n_rows), and Jacobians by x, (n, n_rows, n_x)."""
    n_rows: int
    n_x: int
    start: Array
    """x of the nominal machine's reference posture, shape (n_x,)."""
    origin: Array
    """p of the nominal machine's reference posture, shape (n_p,)."""
    units: Array
    """Metres per unit of x, shape (n_x,)."""
    lower: Array
    upper: Array
    """Bounds of x, shape (n_x,)."""
    names: tuple[str, ...]
    """Joint of each x."""
    row_units: Array
    """Metres per unit of each row, already multiplied in, shape (n_rows,)."""
    turns: NDArray[np.bool_]
    """Mask of the rows that are rotations, shape (n_rows,)."""
    length: float
    """Length that converts rotations to displacements, [m]."""
    shortest: bool = False
    """Take the shortest steps that close the loops, for robots with free motions: the solution of a
    system that is singular up to rounding is no useful step."""

    def step(self, residuals: Array, jacobians: Array) -> Array:
        """Newton steps, shape (n, n_x); least squares where rows depend on each other."""
        if self.n_rows == self.n_x and not self.shortest:
            try:
                steps = np.asarray(np.linalg.solve(jacobians, -residuals[..., None])[..., 0])
            except np.linalg.LinAlgError:
                return self._shortest_step(residuals, jacobians)
            singular = ~(np.abs(steps).max(axis=1, initial=0.0) < MAX_NEWTON_STEP)
            if singular.any():
                steps[singular] = self._shortest_step(residuals[singular], jacobians[singular])
            return steps
        return self._shortest_step(residuals, jacobians)

    def _shortest_step(self, residuals: Array, jacobians: Array) -> Array:
        steps = np.full((len(residuals), self.n_x), np.nan)  # no step: the caller drops the posture
        usable = np.isfinite(jacobians).all(axis=(1, 2))
        inverse = np.linalg.pinv(jacobians[usable], rcond=1e-10)
        with np.errstate(over="ignore"):
            steps[usable] = -(inverse @ residuals[usable][..., None])[..., 0]
        return steps

    def describe(self, x: Array, p: Array, geometry: MachineGeometry) -> str:
        """Openings of the loops of one posture, in words."""
        residuals, _ = self.evaluate(x[None], p[None], geometry)
        return describe_opening(residuals[0] / self.row_units, self.turns)

    def within_limits(self, x: Array) -> NDArray[np.bool_]:
        """Mask of the postures with all joints within their limits, shape (n,)."""
        inside = (x >= self.lower - LIMIT_TOLERANCE) & (x <= self.upper + LIMIT_TOLERANCE)
        return np.asarray(inside.all(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class _Batch:
    """The geometry of machines in K postures each, point by point."""

    geometry: MachineGeometry
    """Geometry of each machine, or of each machine in each posture."""
    machines: int
    postures: int

    def at(self, points: NDArray[np.intp]) -> MachineGeometry:
        """Geometry of points s K + k: one row for all of them, or a row for each."""
        return self.geometry.at(points, self.machines * self.postures)


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
    result = np.empty(begin.shape)
    size = max(1, MAX_POINTS // max(count, 1))
    for i in range(0, machines, size):
        part = slice(i, min(i + size, machines))
        n = part.stop - i
        block = geometry.of_machines(part, machines)
        refused: Failures | None = None if failures is None else {}
        result[part] = _follow(
            system,
            np.tile(targets, (n, 1)),
            _Batch(block, n, max(count, 1)),
            begin[part].reshape(n * count, system.n_x),
            _Refusals(list(labels) * n, refused),
            restart=start is not None,
            allow_singular=allow_singular,
        ).reshape(n, count, system.n_x)
        for point, error in (refused or {}).items():
            if failures is not None:
                failures.setdefault(i * count + point, error)
    return result


class _Refusals:
    """Points that cannot be reached.

    Args:
        labels: Names of the points, for messages.
        failures: Filled with the refused points; without it the first refusal raises.
    """

    def __init__(self, labels: Sequence[str], failures: Failures | None) -> None:
        self._labels, self._failures = labels, failures
        self.mask = np.zeros(len(labels), dtype=np.bool_)

    def add(self, point: int, reason: str, residual: float | None) -> None:
        """Refuse a point.

        Raises:
            ClosureError: If refusals are not collected.
        """
        error = ClosureError(reason, posture=self._labels[point], residual=residual)
        if self._failures is None:
            raise error
        self._failures.setdefault(point, error)
        self.mask[point] = True


def _follow(
    system: System,
    targets: Array,
    batch: _Batch,
    start: Array,
    refusals: _Refusals,
    *,
    restart: bool,
    allow_singular: bool,
) -> Array:
    """Continuation of the points of a batch; arguments as for `solve_closures`."""
    tolerance = CLOSED * max(1.0, system.length)
    count = len(targets)
    regular = np.full(count, allow_singular)
    for i in np.flatnonzero(~np.isfinite(targets).all(axis=1)).tolist():
        refusals.add(i, "has coordinates that are not numbers", None)
    x = np.array(start)
    moves = np.where(system.units == 1.0, system.length, 1.0)
    done, step = np.zeros(count), np.ones(count)
    pending = np.flatnonzero(~refusals.mask)
    fresh = np.full(count, restart)
    while pending.size:
        reach = np.minimum(1.0, done[pending] + step[pending])
        path = system.origin + reach[:, None] * (targets[pending] - system.origin)
        geometry = batch.at(pending)
        trial, worst, checked = _newton(
            system, x[pending], path, geometry, tolerance, check=not allow_singular
        )
        moved = np.abs((trial - x[pending]) / moves).max(axis=1, initial=0.0)
        good = (worst < tolerance) & (moved < LARGEST_CONTINUATION_MOVE)
        x[pending[good]] = trial[good]
        done[pending[good]] = reach[good]
        if not allow_singular:
            regular[pending[good]] = checked[good]
        retry = pending[~good & fresh[pending]]  # the start was no help: use the reference posture
        x[retry], step[retry] = system.start, 2.0
        fresh[pending] = False
        step[pending[~good]] *= 0.5
        for i in pending[~good & (step[pending] < SMALLEST_CONTINUATION_STEP)].tolist():
            at = batch.at(np.array([i]))
            last, final, _ = _newton(system, x[[i]], targets[[i]], at, tolerance, check=False)
            reason = (
                "cannot be reached from the mechanical zero without changing the way in "
                f"which the loops are assembled, {done[i]:.0%} of the way"
                if final[0] < tolerance
                else "cannot be reached: the loops stay open by "
                f"{system.describe(last[0], targets[i], at)}, {done[i]:.0%} of the way "
                "from the mechanical zero"
            )
            refusals.add(i, reason, float(final[0]))
        pending = pending[(done[pending] < 1.0) & ~refusals.mask[pending]]
    _refuse_outside_limits(system, x, refusals)
    uncertain = np.flatnonzero(~regular & ~refusals.mask)
    if uncertain.size and system.n_x:
        _refuse_singular(system, targets, x, batch, uncertain, refusals)
    x[refusals.mask] = np.nan
    return x


def _refuse_outside_limits(system: System, x: Array, refusals: _Refusals) -> None:
    """Refuse solutions with a joint outside its limits."""
    for i in np.flatnonzero(~system.within_limits(x) & ~refusals.mask).tolist():
        j = int(np.maximum(x[i] - system.upper, system.lower - x[i]).argmax())
        unit, size = DRIVE_UNITS["m" if system.units[j] == 1.0 else "rad"]
        reason = (
            f"cannot be reached: joint '{system.names[j]}' would be at "
            f"{x[i][j] / size:.4g} {unit}, outside its limits "
            f"{system.lower[j] / size:g} ... {system.upper[j] / size:g} {unit}"
        )
        refusals.add(i, reason, 0.0)


def _refuse_singular(
    system: System,
    targets: Array,
    x: Array,
    batch: _Batch,
    points: NDArray[np.intp],
    refusals: _Refusals,
) -> None:
    """Refuse solutions at some points that leave motions free, the most singular one first."""
    _, jacobians = system.evaluate(x[points], targets[points], batch.at(points))
    values = np.linalg.svd(jacobians / system.units, compute_uv=False)
    smallest = values[:, system.n_x - 1] if values.shape[1] >= system.n_x else 0.0
    largest = values.max(axis=1, initial=0.0)  # without closures there are no values
    ratio = np.broadcast_to(smallest / np.maximum(largest, 1e-300), points.shape)
    for k in np.argsort(ratio)[: int((ratio < SINGULAR_BELOW).sum())].tolist():
        rank = int((values[k] > SINGULAR_BELOW * largest[k]).sum())
        reason = (
            f"is singular: the drives leave {system.n_x - rank} of {system.n_x} passive motions "
            "free"
        )
        refusals.add(int(points[k]), reason, None)


def _newton(
    system: System,
    x: Array,
    p: Array,
    geometry: MachineGeometry,
    tolerance: float,
    *,
    check: bool,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Damped Newton's method of many points at once.

    Returns:
        Solutions, shape (n, n_x), the largest residual of each, shape (n,), [m], and a mask of
        the solutions that are certainly not singular (if checked).
    """
    x = np.array(x)
    residuals, jacobians = system.evaluate(x, p, geometry)
    worst = np.abs(residuals).max(axis=1, initial=0.0)
    active = np.flatnonzero(worst >= tolerance)
    for _ in range(MAX_NEWTON_STEPS):
        if not active.size:
            break
        step = system.step(residuals[active], jacobians[active])
        usable = np.isfinite(step).all(axis=1)
        active, step = active[usable], step[usable]
        scale = np.ones(len(active))
        pending = np.arange(len(active))
        moved = np.zeros(len(active), dtype=bool)
        for _ in range(MAX_STEP_HALVINGS):
            rows = active[pending]
            trial = x[rows] + scale[pending, None] * step[pending]
            r, j = system.evaluate(trial, p[rows], geometry.at(rows, len(x)))
            size = np.abs(r).max(axis=1, initial=0.0)
            better = size < worst[rows]
            good = rows[better]
            x[good], residuals[good], jacobians[good] = trial[better], r[better], j[better]
            worst[good] = size[better]
            moved[pending[better]] = True
            pending = pending[~better]
            scale[pending] *= 0.25
            if not pending.size:
                break
        active = active[moved]
        active = active[worst[active] >= tolerance]
    regular = np.zeros(len(x), dtype=np.bool_)
    closed = np.flatnonzero((worst < tolerance) & np.isfinite(jacobians).all(axis=(1, 2)))
    if closed.size and system.n_x:  # a last step without evaluation: its Jacobian is at hand
        step, regular[closed] = _last_step(system, residuals[closed], jacobians[closed], check)
        small = np.abs(step).max(axis=1) < MAX_LAST_STEP
        x[closed[small]] += step[small]
    return x, worst, regular


def _last_step(
    system: System, residuals: Array, jacobians: Array, check: bool
) -> tuple[Array, NDArray[np.bool_] | bool]:
    """Newton steps, and a mask of the Jacobians that are certainly not singular (if checked).

    The ratio of singular values is at least 1/(|A| |A⁻¹|) by Frobenius' norm, with the inverse that
    the step needs anyway.
    """
    if check and system.n_rows == system.n_x:
        try:
            inverses = np.linalg.inv(jacobians)
        except np.linalg.LinAlgError:
            return system.step(residuals, jacobians), False
        size = np.linalg.norm(jacobians / system.units, axis=(1, 2))
        inverse_size = np.linalg.norm(inverses * system.units[:, None], axis=(1, 2))
        steps = -(inverses @ residuals[..., None])[..., 0]
        return steps, np.asarray(size * inverse_size < SAFETY / SINGULAR_BELOW)
    return system.step(residuals, jacobians), False


class LoopClosure:
    """Solver of the loop closures of machines with some errors fixed and some passed to each call.

    `theta` has shape (n_free,) for one machine or (S, n_free) for a batch of machines; `errors`
    passes all elementary errors instead, shape (n_errors,) or (S, n_errors). Results of a batch
    have a leading dimension S.

    Args:
        robot: The nominal robot.
        free: Names of the parameters whose values are passed to each call as `theta`, in order.
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
        self._functions = robot_functions(robot)
        self._columns = self._functions.errors.columns(self.free)
        others = {k: v for k, v in (fixed or {}).items() if k not in self.free}
        self._fixed = self._functions.errors.expand(others)

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
        system = replace(self._closing, shortest=allow_free)

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
        theta: ArrayLike | None = None,
        names: Sequence[str] | None = None,
        failures: Failures | None = None,
    ) -> Array:
        """Drive coordinates that bring the tool centre point to points.

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
        p, single = as_rows(points, len(require_tcp(self.robot).coordinates), "coordinates")
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
        """All joint coordinates that bring the tool centre point of one machine to points.

        Args:
            points: As for `inverse`, shape (K, n_drives).
            theta: As for `inverse`.
            start: Drive and passive coordinates to start from, shape (K, n_drives + n_passive); the
                reference posture by default.
            names: As for `inverse`.
            failures: As for `inverse`.

        Returns:
            Drive coordinates, shape (K, n_drives), and passive ones, shape (K, n_passive).

        Raises:
            ClosureError, RobotError: As `inverse`.
        """
        geometry, _ = self._batch(theta, None)
        x = solve_closures(
            self._inverting,
            points,
            geometry,
            machines=1,
            start=start,
            names=names,
            failures=failures,
        )[0]
        return x[:, : len(self.robot.drives)], x[:, len(self.robot.drives) :]

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

    def _theta(self, theta: ArrayLike | None) -> Array:
        if theta is None:
            return np.zeros(len(self.free))
        values, single = as_rows(theta, len(self.free), "values of the free parameters")
        return np.asarray(values[0] if single else values)

    def _batch(
        self, theta: ArrayLike | None, errors: ArrayLike | None, commands: Array | None = None
    ) -> tuple[MachineGeometry, bool]:
        """Geometry with a leading dimension, and whether the arguments were a batch."""
        at = self.errors(theta) if errors is None else np.asarray(errors, dtype=np.float64)
        return self._functions.errors.geometry(np.atleast_2d(at), commands), at.ndim > 1

    def _as_commands(self, drives: ArrayLike) -> tuple[Array, bool]:
        """Commands, shape (K, n_command), and whether they were a single row."""
        values, map_ = np.asarray(drives), self._functions.errors
        n = len(self.robot.drives)
        if values.shape[-1:] == (n + map_.n_conditions,):
            n += map_.n_conditions
        rows, single = as_rows(drives, n, "drive coordinates")
        return map_.command(rows), single

    @cached_property
    def _closing(self) -> System:
        robot, function = self.robot, self._functions.closure_by_passive
        map_ = self._functions.errors

        def evaluate(x: Array, p: Array, geometry: MachineGeometry) -> tuple[Array, Array]:
            actuated = map_.actuate(p, geometry.drive_errors)
            g, g_q = function(actuated, x, geometry.placements)
            return g, g_q

        origin = map_.command(robot.drive_zero)
        return _build_system(robot, evaluate, robot.passive_index, robot.reference_passive, origin)

    @cached_property
    def _inverting(self) -> System:
        robot = self.robot
        chosen = list(require_commanded_tool(robot))
        function, n_d = self._functions.closure_and_tool, len(robot.drives)
        map_ = self._functions.errors

        def evaluate(x: Array, p: Array, geometry: MachineGeometry) -> tuple[Array, Array]:
            d, q = x[:, :n_d], x[:, n_d:]
            actuated = map_.actuate(d, geometry.drive_errors)
            by_commands, _ = map_.differentiate_drives(d, geometry.drive_errors)
            g, g_a, g_q, tool, t_a, t_q = function(actuated, q, geometry.placements)
            residuals = np.concatenate([g, tool[:, chosen] - p], axis=1)
            by_drives = np.concatenate([g_a, t_a[:, chosen]], axis=1)
            by_drives = by_drives @ by_commands
            by_passive = np.concatenate([g_q, t_q[:, chosen]], axis=1)
            return residuals, np.concatenate([by_drives, by_passive], axis=2)

        index = np.concatenate([robot.drive_index, robot.passive_index])
        origin = nominal_closure(robot).tcp(robot.drive_zero, robot.reference_passive)[chosen]
        start = np.concatenate([robot.drive_zero, robot.reference_passive])
        return _build_system(robot, evaluate, index, start, origin, n_tool=len(chosen))


def _build_system(
    robot: Robot,
    evaluate: Evaluate,
    index: Indices,
    start: Array,
    origin: Array,
    *,
    n_tool: int = 0,
) -> System:
    """System of closure rows, followed by rows of tool coordinates.

    Args:
        robot: The robot.
        evaluate: As for `System`.
        index: Joint coordinates that are x, shape (n_x,).
        start: As for `System`.
        origin: As for `System`.
        n_tool: Number of tool coordinates.
    """
    lower, upper = coordinate_limits(robot)
    joints = coordinate_joints(robot.model)
    return System(
        evaluate=evaluate,
        n_rows=robot.closure_rows + n_tool,
        n_x=index.size,
        start=start,
        origin=origin,
        units=coordinate_units(robot)[index],
        lower=lower[index],
        upper=upper[index],
        names=tuple(str(robot.model.names[joints[k]]) for k in index.tolist()),
        row_units=np.append(closure_row_units(robot), np.ones(n_tool)),
        turns=np.append(closure_turns(robot), np.zeros(n_tool, dtype=np.bool_)),
        length=robot.characteristic_length,
    )


@cached_per_robot(maxsize=8)
def nominal_closure(robot: Robot) -> LoopClosure:
    """The loop closure solver of a robot without errors, built once."""
    return LoopClosure(robot)


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
