"""Closing the loops of a robot numerically: Newton's method over many postures at once.

Forward: commanded drives to passive coordinates and tool centre point. Inverse: tool centre point
to drives. A posture that a plain start does not reach is approached along a straight path from the
mechanical zero, so that the loops stay in the branch of assembly in which the machine was built.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.arguments import require_kind
from orthocal.errors import ClosureError, RobotError
from orthocal.kinematics.compiled import compiled_robot
from orthocal.kinematics.kept import once_a_robot
from orthocal.robot.closing import describe_opening
from orthocal.robot.model import (
    Robot,
    Tcp,
    closure_row_units,
    closure_turns,
    coordinate_limits,
    coordinate_units,
)
from orthocal.units import DRIVE_UNITS

Array = NDArray[np.float64]
Failures = dict[int, ClosureError]
"""Index of a posture to why it cannot be reached."""

CLOSED = 1e-12
"""Largest scaled residual of closed loops, relative to max(1 m, characteristic length), [m]."""

SINGULAR_BELOW = 1e-5
"""Ratio of smallest to largest singular value below which a posture counts as singular. Near a
singular posture Newton stops where the residual, quadratic in the distance, is below CLOSED: a
smaller ratio would not be seen. The Orthoglide has 1/20 to 1/60."""

SURELY = 0.1
"""Part of the bound at which rounding errors of an inverse are of no account."""

TOO_FAR = 1e3
"""A Newton step that goes farther comes from rows that depend on each other, [m or rad]."""

LAST_STEP = 1e-6
"""A step from closed loops that goes farther is that of a nearly singular posture, [m or rad]."""

SOLUTIONS_REMEMBERED = 4
MOST_REMEMBERED = 1000
"""Solutions that an assembly keeps, of at most so many postures: what asks for one asks again."""

MAX_NEWTON_STEPS = 30
SMALLEST_CONTINUATION_STEP = 1.0 / 512.0
LARGEST_CONTINUATION_MOVE = 0.3
"""Change of a passive coordinate in one continuation step, [rad] or characteristic lengths."""

_LIMIT_SLACK = 1e-9


class Machine(NamedTuple):
    """What errors make of a machine: numbers that every posture shares."""

    placements: Array
    """Shape (12 n_moved,), [1, m]."""
    offset: Array
    """Shape (n_drives,), [m, rad]."""
    gain: Array
    """Shape (n_drives,)."""

    def drives(self, commanded: Array) -> Array:
        """Where drives really are, shape (..., n_drives) of commanded coordinates, [m, rad]."""
        return np.asarray(self.gain * commanded + self.offset)


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """A square or redundant system r(x, p) = 0 of many postures, in metres."""

    evaluate: Callable[[Array, Array, Machine], tuple[Array, Array]]
    """(x, p, machine) -> residuals (K, n_rows), Jacobians by x (K, n_rows, n_x)."""
    n_rows: int
    n_x: int
    start: Array
    """x of the mechanical zero of the nominal machine, shape (n_x,)."""
    origin: Array
    """p of the mechanical zero of the nominal machine, shape (n_p,)."""
    units: Array
    """Metres that one unit of x amounts to, shape (n_x,)."""
    lower: Array
    upper: Array
    """Bounds of x, shape (n_x,)."""
    names: tuple[str, ...]
    """Joint of each x."""
    row_units: Array
    """Metres that one unit of each row amounts to, by which it was multiplied, shape (n_rows,)."""
    turns: NDArray[np.bool_]
    """Which rows are rotations, shape (n_rows,)."""
    shortest: bool = False
    """Whether steps are the shortest that close it: where motions may be free, what a solve makes
    of a matrix that is singular but for its rounding is no step."""

    def step(self, residuals: Array, jacobians: Array) -> Array:
        """Newton steps, shape (K, n_x); least squares where rows depend on each other."""
        if self.n_rows == self.n_x and not self.shortest:
            try:
                steps = np.asarray(np.linalg.solve(jacobians, -residuals[..., None])[..., 0])
            except np.linalg.LinAlgError:
                return self._shortest_step(residuals, jacobians)
            lost = ~(np.abs(steps).max(axis=1, initial=0.0) < TOO_FAR)
            if lost.any():
                steps[lost] = self._shortest_step(residuals[lost], jacobians[lost])
            return steps
        return self._shortest_step(residuals, jacobians)

    def _shortest_step(self, residuals: Array, jacobians: Array) -> Array:
        steps = np.full((len(residuals), self.n_x), np.nan)  # no step: dropped by who asks
        usable = np.isfinite(jacobians).all(axis=(1, 2))
        inverse = np.linalg.pinv(jacobians[usable], rcond=1e-10)
        with np.errstate(over="ignore"):  # likewise
            steps[usable] = -(inverse @ residuals[usable][..., None])[..., 0]
        return steps

    def describe(self, x: Array, p: Array, machine: Machine) -> str:
        """By how much the rows of one posture are open, in words."""
        residuals, _ = self.evaluate(x[None], p[None], machine)
        return describe_opening(residuals[0] / self.row_units, self.turns)

    def within_limits(self, x: Array) -> NDArray[np.bool_]:
        """Whether each posture keeps its joints within their limits, shape (K,)."""
        inside = (x >= self.lower - _LIMIT_SLACK) & (x <= self.upper + _LIMIT_SLACK)
        return np.asarray(inside.all(axis=1))


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
        machine: Machine,
        start: ArrayLike | None,
        names: Sequence[str] | None,
        failures: Failures | None,
        *,
        allow_free: bool,
    ) -> Array:
        system = replace(self._closing, shortest=allow_free)
        passive = self._solve(system, drives, machine, start, names, failures)
        if not allow_free:
            self._refuse_singular(drives, passive, machine, names, failures)
        return passive

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
        names: Sequence[str] | None = None,
        failures: Failures | None = None,
    ) -> tuple[Array, Array]:
        """All joint coordinates that bring the tool centre point to given points.

        Args:
            points: As for `inverse`, shape (K, n_drives).
            theta: As for `inverse`.
            names: As for `inverse`.
            failures: As for `inverse`.

        Returns:
            Drive coordinates, shape (K, n_drives), and passive ones, shape (K, n_passive).

        Raises:
            ClosureError, RobotError: As `inverse`.
        """
        p, machine = points, self.machine(theta)
        if failures is not None:
            x = self._solve(self._inverting, p, machine, None, names, failures)
        else:
            x = self._once(
                ("inverse", p.tobytes(), *(part.tobytes() for part in machine)),
                lambda: self._solve(self._inverting, p, machine, None, names, None),
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

    def machine(self, theta: ArrayLike | None = None) -> Machine:
        """The machine for values of the free parameters, shape (n_free,); 0 by default."""
        errors, at = self._compiled.errors, self.errors(theta)
        return Machine(errors.placements(at), errors.offsets(at), errors.gains(at))

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
    def _closing(self) -> _System:
        robot, function = self.robot, self._compiled.closing

        def evaluate(x: Array, p: Array, machine: Machine) -> tuple[Array, Array]:
            g, g_q = function(machine.drives(p), x, machine.placements)
            return g, g_q

        lower, upper = coordinate_limits(robot)
        return _System(
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
        )

    @cached_property
    def _inverting(self) -> _System:
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

        def evaluate(x: Array, p: Array, machine: Machine) -> tuple[Array, Array]:
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
        return _System(
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
        )

    def _solve(
        self,
        system: _System,
        targets: Array,
        machine: Machine,
        start: ArrayLike | None,
        names: Sequence[str] | None,
        failures: Failures | None,
    ) -> Array:
        """Newton along the straight path from the origin (or a given start) to each target.

        The first try is the whole way; a posture that does not converge, or moves so far that it
        may have changed its branch of assembly, is approached in halved steps.
        """
        tolerance = CLOSED * max(1.0, self.robot.characteristic_length)
        count = len(targets)

        labels = names if names is not None else [f"posture {i + 1}" for i in range(count)]
        if len(labels) != count:
            raise ValueError(f"found {len(labels)} names for {count} rows")

        lost_for_good = np.zeros(count, dtype=bool)

        def refuse(i: int, reason: str, residual: float | None) -> None:
            error = ClosureError(reason, posture=labels[i], residual=residual)
            if failures is None:
                raise error
            failures.setdefault(i, error)
            lost_for_good[i] = True

        for i in np.flatnonzero(~np.isfinite(targets).all(axis=1)).tolist():
            refuse(i, "has coordinates that are not numbers", None)
        first = system.start if start is None else as_rows(start, system.n_x, "start values")[0]
        x = np.array(np.broadcast_to(first, (count, system.n_x)))
        moves = np.where(system.units == 1.0, self.robot.characteristic_length, 1.0)
        done, step = np.zeros(count), np.ones(count)
        pending = np.flatnonzero(~lost_for_good)
        fresh = np.full(count, start is not None)
        while pending.size:
            reach = np.minimum(1.0, done[pending] + step[pending])
            way = system.origin + reach[:, None] * (targets[pending] - system.origin)
            trial, worst = _newton(system, x[pending], way, machine, tolerance)
            moved = np.abs((trial - x[pending]) / moves).max(axis=1, initial=0.0)
            good = (worst < tolerance) & (moved < LARGEST_CONTINUATION_MOVE)
            x[pending[good]] = trial[good]
            done[pending[good]] = reach[good]
            lost = pending[~good & fresh[pending]]  # the given start was no help: begin at zero
            x[lost], step[lost] = system.start, 2.0
            fresh[pending] = False
            step[pending[~good]] *= 0.5
            for i in pending[~good & (step[pending] < SMALLEST_CONTINUATION_STEP)].tolist():
                last, final = _newton(system, x[[i]], targets[[i]], machine, tolerance)
                reason = (
                    "cannot be reached from the mechanical zero without changing the way in "
                    f"which the loops are assembled, {done[i]:.0%} of the way"
                    if final[0] < tolerance
                    else "cannot be reached: the loops stay open by "
                    f"{system.describe(last[0], targets[i], machine)}, {done[i]:.0%} of the way "
                    "from the mechanical zero"
                )
                refuse(i, reason, float(final[0]))
            pending = pending[(done[pending] < 1.0) & ~lost_for_good[pending]]
        for i in np.flatnonzero(~system.within_limits(x) & ~lost_for_good).tolist():
            over = np.maximum(x[i] - system.upper, system.lower - x[i])
            j = int(over.argmax())
            unit, size = DRIVE_UNITS["m" if system.units[j] == 1.0 else "rad"]
            reason = (
                f"cannot be reached: joint '{system.names[j]}' would be at "
                f"{x[i][j] / size:.4g} {unit}, outside its limits "
                f"{system.lower[j] / size:g} ... {system.upper[j] / size:g} {unit}"
            )
            refuse(i, reason, 0.0)
        x[lost_for_good] = np.nan
        return x

    def _refuse_singular(
        self,
        drives: Array,
        passive: Array,
        machine: Machine,
        names: Sequence[str] | None,
        failures: Failures | None,
    ) -> None:
        system = self._closing
        if system.n_x == 0:
            return
        solved = np.flatnonzero(np.isfinite(passive).all(axis=1))
        _, jacobians = system.evaluate(passive[solved], drives[solved], machine)
        scaled = jacobians / system.units
        doubtful = ~_far_from_singular(scaled)
        solved, scaled = solved[doubtful], scaled[doubtful]
        values = np.linalg.svd(scaled, compute_uv=False)
        smallest = values[:, system.n_x - 1] if values.shape[1] >= system.n_x else 0.0
        largest = values.max(axis=1, initial=0.0)  # without closures there are no values
        ratio = np.broadcast_to(smallest / np.maximum(largest, 1e-300), solved.shape)
        for k in np.argsort(ratio)[: int((ratio < SINGULAR_BELOW).sum())].tolist():
            i = int(solved[k])
            free = int((values[k] > SINGULAR_BELOW * largest[k]).sum())
            error = ClosureError(
                f"is singular: the drives leave {system.n_x - free} of "
                f"{system.n_x} passive motions free",
                posture=names[i] if names is not None else f"posture {i + 1}",
            )
            if failures is None:
                raise error
            failures[i] = error
            passive[i] = np.nan


def _far_from_singular(matrices: Array) -> NDArray[np.bool_]:
    """Whether the ratio of singular values is above SINGULAR_BELOW for sure, shape (K,).

    By Frobenius' norm it is at least 1/(|A| |A⁻¹|), which takes half the time.
    """
    if matrices.shape[1] != matrices.shape[2] or not matrices.size:
        return np.zeros(len(matrices), dtype=np.bool_)
    try:
        inverses = np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        return np.zeros(len(matrices), dtype=np.bool_)
    sizes = np.linalg.norm(matrices, axis=(1, 2)) * np.linalg.norm(inverses, axis=(1, 2))
    return np.asarray(sizes < SURELY / SINGULAR_BELOW)


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


def as_rows(values: ArrayLike, n: int, what: str) -> tuple[Array, bool]:
    """Numbers as an array of shape (K, n), and whether they were a single row.

    Raises:
        ValueError: If they are no numbers, or not so many a row.
    """
    try:
        given = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"found {type(values).__name__}; expected {n} {what} a row") from None
    if given.ndim not in (1, 2) or given.shape[-1] != n:
        raise ValueError(f"found the shape {given.shape}; expected {n} {what} a row, (K, {n})")
    return np.atleast_2d(given), given.ndim == 1


def _newton(
    system: _System, x: Array, p: Array, machine: Machine, tolerance: float
) -> tuple[Array, Array]:
    """Damped Newton of many postures at once.

    Returns:
        Solutions, shape (K, n_x), and the largest residual of each, shape (K,), [m].
    """
    x = np.array(x)
    residuals, jacobians = system.evaluate(x, p, machine)
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
        for _ in range(6):
            rows = active[pending]
            trial = x[rows] + scale[pending, None] * step[pending]
            r, j = system.evaluate(trial, p[rows], machine)
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
    closed = np.flatnonzero((worst < tolerance) & np.isfinite(jacobians).all(axis=(1, 2)))
    if closed.size and system.n_x:  # what is left goes too: residual and slope are at hand
        step = system.step(residuals[closed], jacobians[closed])
        small = np.abs(step).max(axis=1) < LAST_STEP
        x[closed[small]] += step[small]
    return x, worst


def _joint_names(robot: Robot, index: NDArray[np.int64]) -> tuple[str, ...]:
    owner = {}
    for i in range(1, robot.model.njoints):
        joint = robot.model.joints[i]
        for k in range(joint.nv):
            owner[joint.idx_v + k] = robot.model.names[i]
    return tuple(owner[int(i)] for i in index)
