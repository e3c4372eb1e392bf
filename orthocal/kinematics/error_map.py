"""Placements and actual drive coordinates of a machine as functions of its error parameters.

A placement with errors is placement · exp6(δ). A change dδ moves it by the twist dξ = T(δ) dδ in
its frame, with T the right Jacobian of SE(3). Effects change the kinematics only by the twists δ
and by the actual drive coordinates. `ErrorMap` computes both from the expressions of the effects
for NumPy arrays, `SymbolicErrorMap` for CasADi expressions.

A command consists of the commanded drive coordinates of a posture and the conditions on which
drives or placements depend (`ErrorMap.conditions`). Coordinates alone are a command under neutral
conditions.

Matrices for n parameters, one unit of each, have these names.

- `unit_errors`: elementary errors, shape (n_errors, n).
- `twist_jacobian`: ∂δ of the moved placements, shape (6 n_moved, n).
- `right`: T of each placement, shape (n_moved, 6, 6).
- `placement_jacobian`: ∂ξ = T ∂δ, shape (6 n_moved, n).

Effects may make placements depend on the coordinates of the drives (`Effect.placements`), which
are then conditions too. Because a gauge is mounted in the reference posture, such a placement
exists twice: with the coordinates of the posture, and with those of the reference posture.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.arrays import Array, ArrayCache, Indices, Mask
from orthocal.effects.loading import neutral_values
from orthocal.effects.machine import express_machine, neutral_conditions
from orthocal.effects.protocol import NEUTRAL, Condition, condition_size
from orthocal.kinematics.backend.batch_function import BatchFunction
from orthocal.kinematics.function_cache import cached_per_robot
from orthocal.kinematics.se3 import exp6, right_jacobian
from orthocal.kinematics.symbolic import ROUNDING_ERROR, Pose, moved_frames, nominal_placement
from orthocal.robot.frames import Placement
from orthocal.robot.model import Robot

PLACEMENTS_CACHE_SIZE = 16
"""Number of machines whose placements are cached, for solvers, loop closures and readings."""


@dataclass(frozen=True, slots=True, eq=False)
class MachineGeometry:
    """Geometry of one machine or of a batch of machines with errors.

    With S rows for n points, each row applies to n/S successive points.
    """

    map: ErrorMap
    """Error map of the robot."""
    placements: Array
    """Moved placements, shape (..., 12 n_moved), [1, m]."""
    drive_errors: Array
    """Errors on which the drives depend, shape (..., n_drive_errors), [m, rad, 1]."""

    def drives(self, commands: Array) -> Array:
        """Actual drive coordinates of all machines for the same commands.

        Args:
            commands: Shape (K, n_command), or (n_command,).

        Returns:
            Shape (..., K, n_drives): the machines' batch dimensions come first.
        """
        drives = self.map.actuate(*self._combine(commands))
        return drives.reshape(*self._shape(commands), drives.shape[-1])

    def drive_derivatives(self, commands: Array) -> tuple[Array, Array]:
        """Derivatives of `drives` with respect to the commanded coordinates and `drive_errors`.

        Returns:
            Shapes (..., K, n_drives, n_drives) and (..., K, n_drives, n_drive_errors).
        """
        derivatives = self.map.differentiate_drives(*self._combine(commands))
        by_commands, by_errors = (
            v.reshape(*self._shape(commands), *v.shape[1:]) for v in derivatives
        )
        return by_commands, by_errors

    def at(self, points: NDArray[np.intp], count: int) -> MachineGeometry:
        """Geometry of some of `count` points: one row per point, or one row for all.

        Args:
            points: Indices of the points, shape (n,).
            count: Number of all points, a multiple of the number of rows.
        """

        def choose(values: Array) -> Array:
            rows = values.reshape(-1, values.shape[-1])
            return rows if len(rows) == 1 else rows[points // (count // len(rows))]

        return MachineGeometry(self.map, choose(self.placements), choose(self.drive_errors))

    def _combine(self, commands: Array) -> tuple[Array, Array]:
        """Commands of all machines, (S K, n_command), and drive errors, (S, n_drive_errors)."""
        errors = self.drive_errors.reshape(-1, self.drive_errors.shape[-1])
        return np.tile(np.atleast_2d(commands), (len(errors), 1)), errors

    def _shape(self, commands: Array) -> tuple[int, ...]:
        """Leading dimensions of a result: those of the machines, then of the commands."""
        return *self.drive_errors.shape[:-1], *commands.shape[:-1]


class ErrorMap:
    """Placements and drives of a robot as functions of its elementary errors.

    The elementary errors have a fixed order, shape (..., n_errors), [m, rad, 1].

    Args:
        robot: The nominal robot.

    Attributes:
        names: Names of the errors.
        moved: Placements on which effects act. Placements that differ in the reference posture
            follow at the end.
        in_reference: Index of each moved placement that differs in the reference posture, mapped
            to its index there; empty unless placements depend on the coordinates of drives.
        conditions: Conditions that follow the drive coordinates in a command.
        placement_conditions: Conditions on which placements depend.
        of_placements: Mask of `placement_conditions` in a command, shape (n_command,).
        varying: Indices of the moved placements that may depend on conditions, shape (n_varying,).
        drive_errors: Indices of the errors on which the drives depend, shape (n_drive_errors,).
        drives: Function of a command and `drive_errors`: actual drive coordinates.
        twists: Function of the conditions and of all errors: twists of the moved placements, and
            their derivatives with respect to the errors.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.names = tuple(robot.parameters.elementary)
        self._index = {name: i for i, name in enumerate(self.names)}
        errors = ca.SX.sym("errors", len(self.names))
        commanded = ca.SX.sym("commanded", len(robot.drives))
        symbols = {c: ca.SX.sym(c, condition_size(robot, c)) for c in NEUTRAL}
        actuated, machine_twists = express_machine(
            robot, commanded, {n: errors[i] for i, n in enumerate(self.names)}, symbols
        )
        sparse = {p: ca.sparsify(t) for p, t in machine_twists.items()}
        twist_of = {p: t for p, t in sparse.items() if t.nnz()}
        moved, reference = list(twist_of), _reference_twists(robot, twist_of, symbols)
        self.moved = (*moved, *reference)
        self.in_reference = {moved.index(p): len(moved) + i for i, p in enumerate(reference)}
        twists = ca.vertcat(ca.SX(0, 1), *twist_of.values(), *reference.values())
        self.conditions = _conditions_in(ca.vertcat(twists, actuated), symbols)
        self.placement_conditions = _conditions_in(twists, symbols)
        neutral = neutral_values(robot)
        sizes = [condition_size(robot, c) for c in self.conditions]
        of_placements = np.repeat([c in self.placement_conditions for c in self.conditions], sizes)
        of_drives = np.zeros(len(robot.drives), dtype=np.bool_)
        self.of_placements = np.concatenate([of_drives, of_placements.astype(np.bool_)])
        self._neutral = np.repeat([neutral[c] for c in self.conditions], sizes).astype(np.float64)
        of_condition = np.repeat(np.array(self.conditions, dtype=object), sizes)
        self._coordinates = len(robot.drives) + np.flatnonzero(of_condition == "coordinates")
        for name in ("coordinates", "reference"):
            if name in self.conditions:
                self._neutral[of_condition == name] = robot.drive_zero
        conditions = ca.vertcat(ca.SX(0, 1), *(symbols[c] for c in self.conditions))
        by_errors = ca.jacobian(actuated, errors)
        self.drive_errors = np.unique(np.array(by_errors.sparsity().get_triplet()[1], np.int64))
        chosen = self.drive_errors.tolist()
        inputs = [ca.vertcat(commanded, conditions), errors[chosen]]
        self.drives = ca.Function("drives", inputs, [actuated])
        self._drives = BatchFunction(self.drives)
        by_commands = ca.jacobian(actuated, commanded)
        labels = ["by_commands", "by_errors"]
        self._drive_derivatives = BatchFunction(
            ca.Function(
                "derivatives", inputs, [by_commands, by_errors[:, chosen]], ["u", "e"], labels
            ),
            matrices=labels,
        )
        outputs = [twists, ca.jacobian(twists, errors)]
        self.twists = ca.Function("twists", [conditions, errors], outputs)
        self._twists = _Twists(self.twists)
        self.varying = np.unique(self._twists.general // 6)
        frames = moved_frames(self.moved)
        nominal = [nominal_placement(robot.model, p, frames) for p in self.moved]
        self._rotations = np.array([p.rotation for p in nominal]).reshape(-1, 3, 3)
        self._positions = np.array([p.translation for p in nominal]).reshape(-1, 3)
        self._placements = ArrayCache(PLACEMENTS_CACHE_SIZE)

    @property
    def n_conditions(self) -> int:
        """Number of values of conditions in a command, after the drive coordinates."""
        return self._neutral.size

    def expand(self, values: Mapping[str, float]) -> Array:
        """Elementary errors of parameters, which may be sums of several, shape (n_errors,), [SI].

        Raises:
            ParameterError: If a name is unknown.
        """
        result = np.zeros(len(self.names))
        for name, value in self.robot.parameters.expand(values).items():
            result[self._index[name]] = value
        return result

    def unit_errors(self, names: Sequence[str]) -> Array:
        """Elementary errors for one unit of each named parameter, shape (n_errors, n)."""
        return self.robot.parameters.coefficients(self.names, names)

    def command(self, coordinates: Array) -> Array:
        """Commands of drive coordinates under neutral conditions, shape (..., n_command).

        Args:
            coordinates: Drive coordinates, shape (..., n_drives), or commands, which are returned
                unchanged.
        """
        missing = len(self.robot.drives) + self._neutral.size - coordinates.shape[-1]
        if not missing:
            return coordinates
        neutral = np.broadcast_to(self._neutral, (*coordinates.shape[:-1], missing))
        return self.with_coordinates(np.concatenate([coordinates, neutral], axis=-1))

    def with_coordinates(self, commands: Array) -> Array:
        """Commands with the drive coordinates copied to the condition `coordinates`."""
        if not self._coordinates.size:
            return commands
        result = np.array(commands)
        result[..., self._coordinates] = commands[..., : self._coordinates.size]
        return result

    def geometry(self, errors: ArrayLike, commands: Array | None = None) -> MachineGeometry:
        """Placements and drives of machines with errors.

        Args:
            errors: Shape (..., n_errors), [SI].
            commands: Commands on which placements may depend; neutral conditions by default. One
                command, shape (n_command,), applies to all machines. K commands, shape
                (K, n_command), apply to each of S machines.

        Returns:
            Placements of each machine, shape (..., 12 n_moved). If they depend on conditions, K
            commands give rows for each machine and each command, shape (S K, 12 n_moved).
        """
        values = np.asarray(errors, dtype=np.float64)
        drive_errors = values[..., self.drive_errors]
        if commands is not None and commands.ndim > 1 and self.placement_conditions:
            machines = values.reshape(-1, values.shape[-1])
            placements = self.placements_under(machines, commands)
            rows = placements.reshape(-1, placements.shape[-1])
            return MachineGeometry(self, rows, drive_errors)
        command = commands if commands is not None and commands.ndim == 1 else None
        return MachineGeometry(self, self.placements(values, command), drive_errors)

    def placements(self, errors: ArrayLike, commands: Array | None = None) -> Array:
        """Moved placements: rotation column by column, then position.

        Args:
            errors: Shape (..., n_errors), [SI].
            commands: Shape (n_command,) or (..., n_command); neutral conditions by default.

        Returns:
            Shape (..., 12 n_moved), [1, m].
        """
        values = np.asarray(errors, dtype=np.float64)

        def move() -> Array:
            placed = self._move(self._shaped(self.twists_of(values, commands)), slice(None))
            return placed.reshape(*placed.shape[:-2], -1)

        if values.size > len(self.names):  # several machines
            return move()
        command = None if commands is None else (commands.shape, commands.tobytes())
        return self._placements.find((values.shape, values.tobytes(), command), move)

    def placements_under(self, errors: Array, commands: Array) -> Array:
        """Moved placements of S machines under the conditions of V commands.

        Only placements that vary are computed for each command.

        Args:
            errors: Shape (S, n_errors), [SI].
            commands: Shape (V, n_command).

        Returns:
            Shape (S, V, 12 n_moved), [1, m].
        """
        first = self.placements(errors, commands[0])
        result = np.repeat(first[:, None], len(commands), axis=1)
        if len(commands) > 1:
            shaped = result.reshape(*result.shape[:2], -1, 12)
            twists = self._varying_twists(errors, commands)
            shaped[:, :, self.varying] = self._move(twists, self.varying)
        return result

    def _move(self, twists: Array, chosen: slice | Indices) -> Array:
        """Chosen placements moved by twists δ, (..., n, 6): rotations, positions, (..., n, 12)."""
        rotation, position = exp6(twists)
        nominal = self._rotations[chosen]
        positions = (nominal @ position[..., None])[..., 0] + self._positions[chosen]
        columns = np.swapaxes(nominal @ rotation, -1, -2).reshape(*positions.shape[:-1], 9)
        return np.concatenate([columns, positions], axis=-1)

    def _varying_twists(self, errors: Array, commands: Array) -> Array:
        """Twists of the varying placements, shape (S, V, n_varying, 6)."""
        twists = self.twists_of(_repeat_for(errors, commands), commands[None])
        return self._shaped(twists)[:, :, self.varying]

    def varying_derivatives(
        self, errors: Array, unit_errors: Array, commands: Array
    ) -> VaryingDerivatives:
        """Derivatives of the varying placements of S machines under V conditions.

        Args:
            errors: Shape (S, n_errors), [SI].
            unit_errors: Elementary errors for one unit of each parameter, shape (n_errors, n).
            commands: Shape (V, n_command).
        """
        of_varying = twist_components(self.varying)
        constant, by_errors, general_unit_errors = self._twists.split(
            _repeat_for(errors, commands), unit_errors, self._conditions(commands[None])
        )
        return VaryingDerivatives(
            right_jacobian(self._varying_twists(errors, commands)),
            constant[of_varying],
            np.searchsorted(of_varying, self._twists.general),
            by_errors,
            general_unit_errors,
        )

    def actuate(self, commands: Array, drive_errors: Array) -> Array:
        """Actual drive coordinates.

        Args:
            commands: Shape (n, n_command).
            drive_errors: Shape (n, n_drive_errors), or (S, n_drive_errors) if each row applies to
                n/S successive commands.

        Returns:
            Shape (n, n_drives), [m, rad].
        """
        (actuated,) = self._drives(self.command(commands), drive_errors)
        return actuated

    def differentiate_drives(self, commands: Array, drive_errors: Array) -> tuple[Array, Array]:
        """Derivatives of `actuate` with respect to the commanded coordinates and the errors.

        Returns:
            Shapes (n, n_drives, n_drives) and (n, n_drives, n_drive_errors).
        """
        by_commands, by_errors = self._drive_derivatives(self.command(commands), drive_errors)
        return by_commands, by_errors

    def placement_jacobian(
        self,
        errors: ArrayLike,
        unit_errors: Array,
        *,
        commands: Array | None = None,
        right: Array | None = None,
    ) -> Array:
        """Derivatives of the moved placements with respect to parameters, ∂ξ = T ∂δ.

        Args:
            errors: Point of differentiation, shape (..., n_errors), [SI].
            unit_errors: Elementary errors for one unit of each parameter, shape (n_errors, n).
            commands: Shape (n_command,) or (..., n_command); neutral conditions by default.
            right: `right_jacobians` of these errors; computed by default.

        Returns:
            Twists in the frames of the placements, shape (..., 6 n_moved, n), [m, rad].
        """
        right = self.right_jacobians(errors, commands) if right is None else right
        n = unit_errors.shape[1]
        inner = self.twist_jacobian(errors, unit_errors, commands)
        twists = right @ inner.reshape(*inner.shape[:-2], len(self.moved), 6, n)
        return twists.reshape(*twists.shape[:-3], 6 * len(self.moved), n)

    def right_jacobians(self, errors: ArrayLike, commands: Array | None = None) -> Array:
        """Right Jacobian T(δ) of every moved placement, shape (..., n_moved, 6, 6)."""
        return right_jacobian(self._shaped(self.twists_of(errors, commands)))

    @property
    def nominal(self) -> Array:
        """Moved placements without errors, shape (n_moved, 12): rotation columns, position."""
        columns = np.swapaxes(self._rotations, 1, 2).reshape(-1, 9)
        return np.concatenate([columns, self._positions], axis=1)

    def twists_of(self, errors: ArrayLike, commands: Array | None = None) -> Array:
        """Twists δ of the moved placements, shape (..., 6 n_moved), [m, rad].

        Args:
            errors: Shape (..., n_errors), [SI].
            commands: Shape (n_command,) or (..., n_command); neutral conditions by default.
        """
        return self._twists(np.asarray(errors, dtype=np.float64), self._conditions(commands))

    def twist_jacobian(
        self, errors: ArrayLike, unit_errors: Array, commands: Array | None = None
    ) -> Array:
        """Derivatives of the twists δ of the moved placements with respect to parameters.

        Args:
            errors: Point of differentiation, shape (..., n_errors), [SI].
            unit_errors: Elementary errors for one unit of each parameter, shape (n_errors, n).
            commands: Shape (n_command,) or (..., n_command); neutral conditions by default.

        Returns:
            Shape (6 n_moved, n), [m, rad]; (..., 6 n_moved, n) if they depend on the errors.
        """
        values = np.asarray(errors, dtype=np.float64)
        return self._twists.jacobian(values, unit_errors, self._conditions(commands))

    def twists_moved_by(self, unit_errors: Array) -> Mask:
        """Mask of the components of twists that parameters change, shape (6 n_moved,).

        Args:
            unit_errors: Elementary errors for one unit of each parameter, shape (n_errors, n).
        """
        return self._twists.moved_by(np.asarray(unit_errors.any(axis=1)))

    def _conditions(self, commands: Array | None) -> Array:
        """Conditions of commands, shape (..., n_conditions); neutral by default."""
        return self._neutral if commands is None else commands[..., len(self.robot.drives) :]

    def _shaped(self, twists: Array) -> Array:
        """Twists with one row per placement, shape (..., n_moved, 6)."""
        return twists.reshape(*twists.shape[:-1], len(self.moved), 6)


@dataclass(frozen=True, slots=True, eq=False)
class VaryingDerivatives:
    """Derivatives ∂ξ = T ∂δ of the placements that vary, for S machines under V conditions.

    ∂δ is `constant`, plus `by_errors` @ `unit_errors` in the rows `rows`.
    """

    right: Array
    """T, shape (S, V, n_varying, 6, 6)."""
    constant: Array
    """Constant part of ∂δ with respect to the parameters, shape (6 n_varying, n)."""
    rows: Indices
    """Rows of ∂δ that have a varying part, shape (n_rows,)."""
    by_errors: Array
    """Derivatives of these rows with respect to some errors, shape (S, V, n_rows, n_some)."""
    unit_errors: Array
    """Values of these errors for one unit of each parameter, shape (n_some, n)."""


class _Twists:
    """Twists as a function of conditions and errors, and their derivative.

    Components with a single linear term, as of geometric errors, are assigned by index. General
    terms are evaluated by CasADi.

    Attributes:
        general: Indices of the components of twists with general terms, shape (n_general,).
    """

    def __init__(self, function: ca.Function) -> None:
        conditions, errors = (function.sx_in(i) for i in range(2))
        twists, jacobian = function(conditions, errors)
        self._n = twists.numel()
        of_twist, of_error = (np.array(v, np.int64) for v in jacobian.sparsity().get_triplet())
        self._of_twist, self._of_error = of_twist, of_error  # twist and error of each nonzero
        nonzeros = [jacobian.nz[k] for k in range(of_twist.size)]
        constant = np.array([v.is_constant() for v in nonzeros], dtype=np.bool_)
        # at most one linear error per component, so that terms can be assigned by index
        first = np.isin(np.arange(of_twist.size), np.unique(of_twist, return_index=True)[1])
        self._general_errors = np.unique(of_error[~(constant & first)])
        linear = ~np.isin(of_error, self._general_errors)
        self._linear_twists, self._linear_errors = of_twist[linear], of_error[linear]
        self._slopes = np.array([float(v) for v, ok in zip(nonzeros, linear, strict=True) if ok])
        linear_errors = np.unique(self._linear_errors).tolist()
        general = ca.SX(twists)
        if linear_errors:
            zeros = ca.SX.zeros(len(linear_errors))
            general = ca.substitute(general, errors[linear_errors], zeros)
        chosen = errors[self._general_errors.tolist()]
        sparsity = ca.sparsify(general).sparsity()
        self.general = np.array(sparsity.get_triplet()[0], dtype=np.int64)
        terms = general[self.general.tolist()]
        self._general = BatchFunction(
            ca.Function("general", [conditions, chosen], [terms, ca.jacobian(terms, chosen)]),
            matrices=["o1"],
        )

    def __call__(self, errors: Array, conditions: Array) -> Array:
        """Twists δ, shape (..., 6 n_moved): `ErrorMap.twists_of`."""
        result = np.zeros((*errors.shape[:-1], self._n))
        result[..., self._linear_twists] = self._slopes * errors[..., self._linear_errors]
        if self.general.size:
            result[..., self.general] += self._evaluate(errors, conditions)[0]
        return result

    def jacobian(self, errors: Array, unit_errors: Array, conditions: Array) -> Array:
        """Derivatives ∂δ with respect to parameters: `ErrorMap.twist_jacobian`."""
        constant, by_errors, general_unit_errors = self.split(errors, unit_errors, conditions)
        if not self.general.size:
            return constant
        result = np.array(np.broadcast_to(constant, (*errors.shape[:-1], *constant.shape)))
        result[..., self.general, :] += by_errors @ general_unit_errors
        return result

    def split(
        self, errors: Array, unit_errors: Array, conditions: Array
    ) -> tuple[Array, Array, Array]:
        """Constant part and general part of ∂δ with respect to parameters.

        Returns:
            The constant part, shape (n_components, n); the Jacobian of the general terms with
            respect to some errors, shape (..., n_general, n_some); and the values of these errors
            for one unit of each parameter, shape (n_some, n).
        """
        constant = np.zeros((self._n, unit_errors.shape[1]))
        constant[self._linear_twists] = self._slopes[:, None] * unit_errors[self._linear_errors]
        general_unit_errors = unit_errors[self._general_errors]
        if not self.general.size:
            empty = np.zeros((*errors.shape[:-1], 0, len(general_unit_errors)))
            return constant, empty, general_unit_errors
        return constant, self._evaluate(errors, conditions)[1], general_unit_errors

    def moved_by(self, errors: Mask) -> Mask:
        """Mask of the components of twists that masked errors change, shape (n_components,)."""
        result = np.zeros(self._n, dtype=np.bool_)
        result[self._of_twist[errors[self._of_error]]] = True
        return result

    def _evaluate(self, errors: Array, conditions: Array) -> tuple[Array, Array]:
        """General terms, shape (..., n_general), and their Jacobian with respect to the errors."""
        shape, values = errors.shape[:-1], errors.reshape(-1, errors.shape[-1])
        rows = np.broadcast_to(conditions, (*shape, conditions.shape[-1]))
        twists, by_errors = self._general(
            rows.reshape(len(values), -1), values[:, self._general_errors]
        )
        return twists.reshape(*shape, -1), by_errors.reshape(*shape, *by_errors.shape[1:])


@cached_per_robot
def error_map(robot: Robot) -> ErrorMap:
    """Error map of a robot, built once."""
    return ErrorMap(robot)


def twist_components(placements: Indices) -> Indices:
    """Indices of the components of the twists of moved placements, shape (6 n,).

    Args:
        placements: Indices of the moved placements, shape (n,).
    """
    return np.asarray((6 * placements[:, None] + np.arange(6)).reshape(-1))


def _repeat_for(errors: Array, commands: Array) -> Array:
    """Errors of S machines for each of V commands, shape (S, V, n_errors)."""
    return np.broadcast_to(errors[:, None], (len(errors), len(commands), errors.shape[-1]))


def _reference_twists(
    robot: Robot, twists: Mapping[Placement, ca.SX], symbols: Mapping[Condition, ca.SX]
) -> dict[Placement, ca.SX]:
    """Twists in the reference posture of placements that depend on drive coordinates.

    Other conditions are neutral, except adjustments.
    """
    neutral = {**neutral_conditions(robot), "coordinates": symbols["reference"]}
    names = [c for c in symbols if c not in ("adjustment", "reference")]
    old, new = (ca.vertcat(*(v[c] for c in names)) for v in (symbols, neutral))
    depends = [p for p, t in twists.items() if ca.jacobian(t, symbols["coordinates"]).nnz()]
    return {p: ca.sparsify(ca.substitute(twists[p], old, new)) for p in depends}


def _conditions_in(expression: ca.SX, symbols: Mapping[Condition, ca.SX]) -> tuple[Condition, ...]:
    """Conditions on which an expression depends."""
    return tuple(c for c, symbol in symbols.items() if ca.jacobian(expression, symbol).nnz())


class SymbolicErrorMap:
    """Placements and drives of a machine as expressions of scaled parameters θ̂.

    The choice of free parameters is a matrix of constants. The CasADi function of one placement is
    mapped over all placements. Constant placements are evaluated once for all conditions, varying
    ones for each.

    Args:
        map_: The robot's error map.
        fixed: Elementary errors at θ̂ = 0, shape (n_errors,), [SI].
        unit_errors: Elementary errors for one unit of each θ̂, shape (n_errors, n_free).

    Attributes:
        placements: The moved placements, shape (12 n_moved,).
        symbols: Inputs of posture and reading functions: θ̂, the constant placements, the nonzeros
            of their ∂ξ/∂θ̂, the varying placements, the nonzeros of their ∂ξ/∂θ̂.
        digest: Digest of `fixed` and `unit_errors`.
    """

    def __init__(self, map_: ErrorMap, *, fixed: Array, unit_errors: Array) -> None:
        self.digest = hashlib.sha256(fixed.tobytes() + unit_errors.tobytes()).hexdigest()
        varying = map_.varying
        constant = np.setdiff1d(np.arange(len(map_.moved)), varying)
        theta = ca.SX.sym("theta", unit_errors.shape[1])
        symbols, jacobians = [theta], []
        self._functions = []
        for chosen in (constant, varying):
            function, sparsity = _moved_placements(
                map_, chosen, fixed=fixed, unit_errors=unit_errors
            )
            jacobians.append(ca.SX.sym("placement_jacobian", sparsity))
            symbols += [ca.SX.sym("placements", 12 * chosen.size), jacobians[-1].nz[:]]
            self._functions.append(function)
        self.symbols = tuple(symbols)
        order = np.argsort(np.concatenate([constant, varying]))

        def ordered(parts: list[ca.SX], size: int) -> ca.SX:
            rows = (size * order[:, None] + np.arange(size)).reshape(-1)
            return ca.vertcat(*parts)[rows.tolist(), :]

        self.placements = ordered([symbols[1], symbols[3]], 12)
        self._placement_jacobian = ordered(jacobians, 6)
        self._map = map_
        self._errors = ca.SX(fixed) + ca.sparsify(ca.SX(unit_errors)) @ theta

    def values(self, theta: ca.MX, conditions: Array) -> list[ca.MX]:
        """Values of the symbols: one column, or one for each of V > 1 conditions if they vary.

        Args:
            theta: θ̂, shape (n_free,).
            conditions: Conditions of a command, shape (V, n_conditions).
        """
        constant, varying = self._functions
        if len(conditions) > 1:
            varying = varying.map(len(conditions), [True, False], [False, False])
        return [
            theta,
            *constant(theta, ca.DM(conditions[0])),
            *varying(theta, ca.DM(conditions.T)),
        ]

    def actuated(self, command: ca.SX) -> ca.SX:
        """Actual drive coordinates of a command, shape (n_drives,), [m, rad]."""
        return self._map.drives(command, self._errors[self._map.drive_errors.tolist()])

    def direct_placements(self, command: ca.SX) -> ca.SX:
        """Moved placements of a command as expressions of θ̂, shape (12 n_moved,)."""
        twists, _ = self._map.twists(command[len(self._map.robot.drives) :], self._errors)
        nominal = np.where(np.abs(self._map.nominal) < ROUNDING_ERROR, 0.0, self._map.nominal)
        placements = [
            _moved_placement()(twists[6 * k : 6 * k + 6], ca.SX(row))[0]
            for k, row in enumerate(nominal)
        ]
        return ca.vertcat(ca.SX(0, 1), *placements)

    def chain(self, by_twists: ca.SX, by_actuated: ca.SX, command: ca.SX) -> ca.SX:
        """Derivative of rows with respect to θ̂, by the chain rule.

        Args:
            by_twists: Derivative of the rows with respect to twists, shape (n, 6 n_moved).
            by_actuated: Derivative with respect to actual drive coordinates, shape (n, n_drives).
            command: The command, shape (n_command,).
        """
        by_theta = ca.jacobian(self.actuated(command), self.symbols[0])
        return by_twists @ self._placement_jacobian + by_actuated @ by_theta


def _moved_placements(
    map_: ErrorMap, chosen: Indices, *, fixed: Array, unit_errors: Array
) -> tuple[ca.Function, ca.Sparsity]:
    """Function of θ̂ and conditions: some placements and the nonzeros of their ∂ξ/∂θ̂.

    Args:
        map_: The robot's error map.
        chosen: Indices of the moved placements, shape (n,).
        fixed: Elementary errors at θ̂ = 0, shape (n_errors,), [SI].
        unit_errors: Elementary errors for one unit of each θ̂, shape (n_errors, n_free).

    Returns:
        The function, and the sparsity of ∂ξ/∂θ̂, shape (6 n, n_free).
    """
    theta, conditions = ca.MX.sym("theta", unit_errors.shape[1]), ca.MX.sym("u", map_.n_conditions)
    rows = twist_components(chosen).tolist()
    symbols = map_.twists.sx_in()
    outputs = [v[rows, :] for v in map_.twists(*symbols)]
    twists = ca.Function("twists", symbols, outputs)
    by_theta = ca.MX(ca.sparsify(ca.DM(unit_errors)))
    delta, by_errors = twists(conditions, ca.DM(fixed) + by_theta @ theta)
    sparsity = _right_jacobian_sparsity()
    values, right = ca.MX(12, 0), ca.MX(sparsity.nnz(), 0)
    if chosen.size:
        mapped = _moved_placement().map(chosen.size)
        values, right = mapped(ca.reshape(delta, 6, -1), ca.DM(map_.nominal[chosen].T))
    blocks = ca.diagcat(ca.Sparsity(0, 0), *[sparsity] * chosen.size)
    by_twists = ca.MX(blocks, ca.vec(right)) @ (by_errors @ by_theta)
    function = ca.Function(
        "error_map", [theta, conditions], [ca.densify(ca.vec(values)), by_twists.nz[:]]
    )
    return function, by_twists.sparsity()


@lru_cache(maxsize=1)
def _right_jacobian_sparsity() -> ca.Sparsity:
    """Sparsity of T: rotations of a placement do not depend on translations."""
    return right_jacobian(ca.SX.sym("twist", 6)).sparsity()


@lru_cache(maxsize=1)
def _moved_placement() -> ca.Function:
    """Function of a twist and a nominal placement: placement · exp6(twist), nonzeros of T."""
    twist, nominal = ca.SX.sym("twist", 6), ca.SX.sym("nominal", 12)
    pose = Pose(ca.reshape(nominal[:9], 3, 3), nominal[9:]) * Pose(*exp6(twist))
    values = ca.vertcat(ca.vec(pose.rotation), pose.position)
    return ca.Function("moved_placement", [twist, nominal], [values, right_jacobian(twist).nz[:]])
