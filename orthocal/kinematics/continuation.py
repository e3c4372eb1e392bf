"""Newton's method for closure equations, continued from the reference posture.

All postures of all machines are solved at once. A posture that Newton's method does not reach from
the start is approached along a straight path from the reference posture. Its steps are short
enough to stay in the assembly mode in which the machine was built.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.arrays import Array, Indices, Mask
from orthocal.errors import ClosureError
from orthocal.kinematics.error_map import MachineGeometry
from orthocal.robot.closing import CLOSURE_TOLERANCE, RANK_TOLERANCE, describe_opening
from orthocal.robot.model import (
    LIMIT_TOLERANCE,
    Robot,
    closure_row_units,
    closure_turns,
    coordinate_limits,
    coordinate_names,
    coordinate_turns,
    coordinate_units,
)
from orthocal.text import percent
from orthocal.units import DRIVE_UNITS

Evaluate = Callable[[Array, Array, MachineGeometry], tuple[Array, Array]]
"""Type of `System.evaluate`."""

Prepare = Callable[[Array, MachineGeometry], Array]
"""Type of `System.prepare`."""

Failures = dict[int, ClosureError]
"""Indices of postures, mapped to the reason why they cannot be reached. Posture k of machine s has
the index s K + k if each machine has K postures."""

SINGULAR_BELOW = 1e-5
"""Ratio of smallest to largest singular value below which a posture counts as singular. Smaller
ratios would not be noticed: near a singular posture the residual is quadratic in the distance, and
Newton's method stops below CLOSURE_TOLERANCE. The ratios of the Orthoglide are 1/20 to 1/60."""

SINGULAR_MARGIN = 0.1
"""Factor of SINGULAR_BELOW that allows for rounding errors of an inverse."""

MAX_NEWTON_STEP = 1e3
"""Largest component of a Newton step, [m, rad]; linearly dependent rows cause larger ones."""

MAX_LAST_STEP = 1e-6
"""Largest component of a step from closed loops, [m, rad]; nearly singular postures cause larger
ones."""

MAX_NEWTON_STEPS = 30
"""Largest number of Newton steps for one waypoint."""

MAX_STEP_REDUCTIONS = 3
"""Number of lengths of a Newton step that are tried; each is a quarter of the one before."""

UNTESTED_STEPS = 4
"""Number of first Newton steps to which `MAX_REMAINING` does not apply."""

MAX_REMAINING = 0.5
"""Largest residual after a Newton step, relative to that before. Beyond it a posture is abandoned:
it is out of reach, or it is approached in shorter steps. Near a singular posture the ratio is 1/4.
"""

SMALLEST_CONTINUATION_STEP = 1.0 / 512.0
"""Smallest continuation step, as a fraction of the path."""

LARGEST_CONTINUATION_MOVE = 0.3
"""Largest change of a passive coordinate in one continuation step, [rad] or characteristic
lengths."""

MAX_POINTS = 4096
"""Largest number of postures of all machines that are solved at once, to limit the memory of their
Jacobians."""


class System:
    """Equations r(x, p) = 0 of many postures: closures, then coordinates of the tool, [m, rad].

    Args:
        robot: The robot.
        evaluate: Maps (x, v, geometry) to residuals, (n, n_rows), and Jacobians with respect to x,
            (n, n_rows, n_x).
        prepare: Maps (p, geometry) to v, shape (n, n_v): values that do not depend on x.
        index: Indices of x among the joint coordinates, shape (n_x,).
        start: x of the nominal machine's reference posture, shape (n_x,).
        origin: p of the nominal machine's reference posture, shape (n_p,).
        n_tool: Number of tool coordinates.

    Attributes:
        shortest: Use the shortest steps that close the loops, for robots with free motions. Their
            Jacobians are singular up to rounding, so that solving them does not give a useful step.
        units: Metres per unit of x, shape (n_x,).
        turning: Mask of the x that are rotations, shape (n_x,).
        row_units: Metres per unit of each row, shape (n_rows,).
        lower: Lower bounds of x, shape (n_x,).
        upper: Upper bounds of x, shape (n_x,).
        names: Joint of each x.
    """

    def __init__(
        self,
        robot: Robot,
        evaluate: Evaluate,
        *,
        prepare: Prepare,
        index: Indices,
        start: Array,
        origin: Array,
        n_tool: int = 0,
    ) -> None:
        self.robot, self.evaluate, self.prepare = robot, evaluate, prepare
        self.start, self.origin = start, origin
        self.n_x = index.size
        self.shortest = robot.closure_rows + n_tool != index.size
        self.units = coordinate_units(robot)[index]
        self.turning = coordinate_turns(robot.model)[index]
        self.lower, self.upper = (limits[index] for limits in coordinate_limits(robot.model))
        names = coordinate_names(robot.model)
        self.names = tuple(names[k] for k in index.tolist())
        self.row_units = np.append(closure_row_units(robot), np.ones(n_tool))
        self._turns = np.append(closure_turns(robot), np.zeros(n_tool, dtype=np.bool_))

    def step(self, residuals: Array, jacobians: Array) -> Array:
        """Newton steps, shape (n, n_x); least-squares steps if rows are linearly dependent."""
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
        """Least-squares steps of minimum norm; NaN for Jacobians that are not finite."""
        steps = np.full((len(residuals), self.n_x), np.nan)  # no step: the caller drops the posture
        usable = np.isfinite(jacobians).all(axis=(1, 2))
        rows = jacobians[usable] * self.row_units[:, None]
        inverse = np.linalg.pinv(rows, rcond=RANK_TOLERANCE)
        weighted = residuals[usable] * self.row_units
        with np.errstate(over="ignore"):
            steps[usable] = -(inverse @ weighted[..., None])[..., 0]
        return steps

    def scaled(self, jacobians: Array) -> Array:
        """Jacobians with rows and columns in metres, shape (n, n_rows, n_x)."""
        return np.asarray(jacobians * (self.row_units[:, None] / self.units))

    def regular_step(self, residuals: Array, jacobians: Array) -> tuple[Array, Mask]:
        """Newton steps, and a mask of the Jacobians that are certainly not singular.

        The ratio of singular values is at least 1/(|A| |A⁻¹|) in the Frobenius norm. The step needs
        the inverse anyway.
        """
        try:
            inverses = None if self.shortest else np.linalg.inv(jacobians)
        except np.linalg.LinAlgError:
            inverses = None
        if inverses is None:
            return self.step(residuals, jacobians), np.zeros(len(residuals), dtype=np.bool_)
        norms = np.linalg.norm(self.scaled(jacobians), axis=(1, 2))
        scaled_inverses = inverses * (self.units[:, None] / self.row_units)
        inverse_norms = np.linalg.norm(scaled_inverses, axis=(1, 2))
        steps = -(inverses @ residuals[..., None])[..., 0]
        return steps, np.asarray(norms * inverse_norms < SINGULAR_MARGIN / SINGULAR_BELOW)

    def describe_beyond(self, j: int, value: float) -> str:
        """Position and limits of a joint in words; those of a drive in controller coordinates."""
        drives = {d.name: d for d in self.robot.drives}
        if self.names[j] in drives:
            return drives[self.names[j]].describe_beyond(value)
        unit, size = DRIVE_UNITS["rad" if self.turning[j] else "m"]
        low, high = self.lower[j] / size, self.upper[j] / size
        return f"at {value / size:.4g} {unit}, outside its limits {low:g} ... {high:g} {unit}"

    def describe(self, x: Array, p: Array, geometry: MachineGeometry) -> str:
        """Description of the openings of the loops in one posture."""
        residuals, _ = self.evaluate(x[None], self.prepare(p[None], geometry), geometry)
        return describe_opening(residuals[0], self._turns)


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
    """Solve closure equations along the straight path from the reference posture to targets.

    The first trial covers the complete path. Postures that do not converge, or may have changed
    their assembly mode, are approached in halved steps.

    Args:
        system: The equations.
        targets: p of each posture, shape (K, n_p).
        geometry: S machines, or S machines in K postures.
        machines: S.
        start: Start values of x, shape (n_x,), (K, n_x) or (S, K, n_x); by default the reference
            posture.
        names: Names of the postures, for messages.
        failures: Filled with the points that cannot be reached; by default the first one raises.
        allow_singular: Accept targets with free motions.

    Returns:
        x, shape (S, K, n_x).

    Raises:
        ClosureError: If a posture cannot be reached or is outside the limits of a joint, or if it
            is singular and this is not allowed; states the posture and the residual.
        ValueError: If start values or names have another number than expected.
    """
    count = len(targets)
    labels = label_postures(names, count)
    first = system.start if start is None else np.asarray(start, dtype=np.float64)
    if first.shape[-1:] != (system.n_x,):
        raise ValueError(
            f"found the shape {first.shape}; expected {system.n_x} start values per row"
        )
    shape = machines, count, system.n_x
    x = np.array(np.broadcast_to(first, shape)).reshape(machines * count, system.n_x)
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
    return x.reshape(shape)


def label_postures(names: Sequence[str] | None, count: int) -> Sequence[str]:
    """Names of postures for messages; by default numbered from 1, such as "posture 1".

    Raises:
        ValueError: If there are more or fewer names than postures.
    """
    labels = [f"posture {i + 1}" for i in range(count)] if names is None else names
    if len(labels) != count:
        raise ValueError(f"found {len(labels)} names for {count} rows")
    return labels


class _Path:
    """Continuation from the reference posture to targets, for some points of a batch.

    Args:
        system: The equations.
        targets: p of each point, shape (n, n_p).
        geometry: One row for all points, or one row per point.
        points: Index of each point in the batch, shape (n,).
        labels: Names of the postures of a machine, for messages.
        failures: Filled with the points that cannot be reached; by default the first one raises.
        allow_singular: Accept targets with free motions.
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
        self._tolerance = CLOSURE_TOLERANCE * max(1.0, length)
        self._max_moves = LARGEST_CONTINUATION_MOVE * np.where(system.turning, 1.0, length)
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
        """Solve the equations at all targets: x, NaN at refused points, shape (n, n_x).

        Args:
            start: Start values of x, shape (n, n_x).
            restart: Restart from the reference posture if the start fails.
        """
        system, targets, count = self._system, self._targets, len(self._targets)
        for i in np.flatnonzero(~np.isfinite(targets).all(axis=1)).tolist():
            self._refuse(i, "has coordinates that are not numbers")
        # regular: known not to be singular, or not to be checked
        x, regular = np.array(start), np.full(count, self._allow_singular)
        done, step = np.zeros(count), np.ones(count)  # fractions of the path
        pending, may_restart = np.flatnonzero(~self._refused), np.full(count, restart)
        while pending.size:
            reach = np.minimum(1.0, done[pending] + step[pending])
            waypoints = system.origin + reach[:, None] * (targets[pending] - system.origin)
            trial, worst, certain = self._newton(pending, x[pending], waypoints)
            short = (np.abs(trial - x[pending]) < self._max_moves).all(axis=1)
            good = (worst < self._tolerance) & short
            reached, failed = pending[good], pending[~good]
            x[reached], done[reached] = trial[good], reach[good]
            if not self._allow_singular:
                regular[reached] = certain[good]
            retry = failed[may_restart[failed]]
            x[retry], step[retry] = system.start, 2.0  # complete path again, as it is halved below
            may_restart[pending] = False
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
        """Refuse a point whose continuation stopped at a fraction of the path."""
        target = self._targets[[i]]
        last, worst, _ = self._newton(np.array([i]), x, target)
        if worst[0] < self._tolerance:
            reason = (
                "cannot be reached from the mechanical zero without changing the way in "
                f"which the loops close, {percent(done)} of the way"
            )
        else:
            geometry = self._geometry.at(np.array([i]), len(self._points))
            reason = (
                "cannot be reached: the loops stay open by "
                f"{self._system.describe(last[0], target[0], geometry)}, {percent(done)} of the "
                "way from the mechanical zero"
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
        """Refuse solutions with free motions, the most singular one first."""
        system, geometry = self._system, self._geometry.at(rows, len(self._points))
        prepared = system.prepare(self._targets[rows], geometry)
        scaled = system.scaled(system.evaluate(x[rows], prepared, geometry)[1])
        values = np.linalg.svd(scaled, compute_uv=False)
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
        """Solve some points by damped Newton's method.

        Args:
            points: Rows of the points, shape (n,).
            start: Start values of x, shape (n, n_x).
            p: Parameters of the equations, shape (n, n_p).

        Returns:
            Solutions, shape (n, n_x), the largest residual of each, shape (n,), [m], and a mask of
            the solutions that are certainly not singular (False if singular ones are allowed).
        """
        system, tolerance, x = self._system, self._tolerance, np.array(start)
        prepared = system.prepare(p, self._geometry.at(points, len(self._points)))

        def evaluate(rows: NDArray[np.intp], x: Array) -> tuple[Array, Array, Array]:
            geometry = self._geometry.at(points[rows], len(self._points))
            residuals, jacobians = system.evaluate(x, prepared[rows], geometry)
            largest = np.abs(residuals * system.row_units).max(axis=1, initial=0.0)
            return residuals, jacobians, largest

        residuals, jacobians, worst = evaluate(np.arange(len(x)), x)
        active = np.flatnonzero(worst >= tolerance)
        for count in range(1, MAX_NEWTON_STEPS + 1):
            if not active.size:
                break
            before = worst.copy()
            step = system.step(residuals[active], jacobians[active])
            usable = np.isfinite(step).all(axis=1)
            rows, step = active[usable], step[usable]
            improved = []
            for _ in range(MAX_STEP_REDUCTIONS):
                trial = x[rows] + step
                r, j, largest = evaluate(rows, trial)
                better = largest < worst[rows]
                good = rows[better]
                x[good], residuals[good], jacobians[good] = trial[better], r[better], j[better]
                worst[good] = largest[better]
                improved.append(good)
                rows, step = rows[~better], 0.25 * step[~better]
                if not rows.size:
                    break
            active = np.sort(np.concatenate(improved))
            limit = before[active] * (MAX_REMAINING if count > UNTESTED_STEPS else 1.0)
            active = active[(worst[active] >= tolerance) & (worst[active] < limit)]
        regular = np.zeros(len(x), dtype=np.bool_)
        closed = np.flatnonzero((worst < tolerance) & np.isfinite(jacobians).all(axis=(1, 2)))
        if closed.size and system.n_x:  # a last step without evaluation: its Jacobian is known
            evaluated = residuals[closed], jacobians[closed]
            if self._allow_singular:
                step = system.step(*evaluated)
            else:
                step, regular[closed] = system.regular_step(*evaluated)
            small = np.abs(step).max(axis=1) < MAX_LAST_STEP
            x[closed[small]] += step[small]
        return x, worst, regular
