"""Compiled functions of a robot: loop closures, tool and frames, with their derivatives.

Their inputs are the actual drive coordinates, the passive coordinates and the placements with
errors (see `ErrorMap`). One function therefore serves all machines, sessions, models, tolerances
and choices of free errors. Derivatives follow the geometry: a joint or an error that acts in a
frame X moves another frame b by the twist Ad(b⁻¹ X) ξ. This needs several times fewer operations
than differentiating the expressions and is as exact.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.kinematics.backend.batch_function import BatchFunction
from orthocal.kinematics.error_map import ErrorMap, error_map
from orthocal.kinematics.function_cache import (
    OPTIONS,
    cached_function,
    cached_per_robot,
    function_key,
)
from orthocal.kinematics.se3 import log6_jacobian
from orthocal.kinematics.symbolic import (
    Pose,
    SymbolicTree,
    closure_residual,
    moved_frames,
    nominal_placement,
)
from orthocal.robot.frames import Placement, carriers
from orthocal.robot.model import Closure, Robot, joint_axis, require_tcp


@dataclass(frozen=True, slots=True, eq=False)
class _MotionSource:
    """Frame in which a joint or an error acts."""

    pose: Pose
    """Pose of the frame in the world."""
    joint: int | None
    """Index of the joint; None if only an error acts."""
    first: int | None
    """Index of the first of the six twist components of the error; None if no error acts."""


class RobotFunctions:
    """Expressions of a robot, and compiled functions of them.

    Args:
        robot: The nominal robot.
        passive: Values of the passive coordinates; symbols by default.
        placements: Symbols of the placements, shared with other functions; new ones by default.
        reference: True to use the placements in the reference posture where they depend on drive
            coordinates.

    Attributes:
        actuated: Symbol of the actual drive coordinates, shape (n_drives,), [m, rad].
        passive: Symbol of the passive coordinates, shape (n_passive,), [m, rad].
        placements: Symbol of the moved placements, shape (12 n_moved,), [1, m].
    """

    def __init__(
        self,
        robot: Robot,
        *,
        passive: ca.SX | None = None,
        placements: ca.SX | None = None,
        reference: bool = False,
    ) -> None:
        self.robot = robot
        self.errors: ErrorMap = error_map(robot)
        moved = self.errors.moved
        self.actuated = ca.SX.sym("actuated", len(robot.drives))
        self.passive = (
            ca.SX.sym("passive", robot.passive_index.size) if passive is None else passive
        )
        self.placements = (
            ca.SX.sym("placements", 12 * len(moved)) if placements is None else placements
        )
        coordinates = ca.SX(robot.model.nv, 1)
        coordinates[robot.drive_index.tolist()] = self.actuated
        coordinates[robot.passive_index.tolist()] = self.passive
        joints: dict[int, Pose] = {}
        frames: dict[int, Pose] = {}
        in_reference = self.errors.in_reference
        count = len(moved) - len(in_reference)
        rows = {k: in_reference.get(k, k) if reference else k for k in range(count)}
        for k, row in rows.items():
            m, v = moved[k], self.placements[12 * row : 12 * row + 12]
            (frames if m.of_frame else joints)[m.index] = Pose(ca.reshape(v[:9], 3, 3), v[9:])
        self.tree = SymbolicTree(
            robot.model, coordinates, joint_placements=joints, frame_placements=frames
        )
        self._first = {(moved[k].index, moved[k].of_frame): 6 * r for k, r in rows.items()}
        self._frame_functions: dict[str, BatchFunction] = {}

    @property
    def symbols(self) -> list[ca.SX]:
        """Symbols of the actuated coordinates, the passive coordinates and the placements."""
        return [self.actuated, self.passive, self.placements]

    @cached_property
    def reference(self) -> RobotFunctions:
        """Functions in the reference posture, with separate drive symbols.

        Passive joints have their nominal values, because they do not move frames whose chain to the
        base contains only drives.
        """
        passive = ca.SX(self.robot.reference_passive)
        return RobotFunctions(
            self.robot, passive=passive, placements=self.placements, reference=True
        )

    @cached_property
    def second(self) -> RobotFunctions:
        """Functions in a second posture, with separate symbols of all coordinates."""
        return RobotFunctions(self.robot, placements=self.placements)

    @cached_property
    def digest(self) -> str:
        """Digest of all that the expressions depend on; robots with equal digests share functions.

        Moved placements are inputs of the functions, so that their nominal values do not count.
        Machines of one kind share functions, whatever their dimensions, if effects move the frames
        of their closures, legs and tool.
        """
        robot, model = self.robot, self.robot.model
        joints, moved = range(1, model.njoints), set(self.errors.moved)
        ends = {robot.frame_id(name) for c in robot.closures for name in (c.frame_a, c.frame_b)}
        tool = () if robot.tcp is None else (robot.frame_id(robot.tcp.frame),)
        parts: list[object] = [
            [(j.shortname(), j.idx_v) for j in model.joints],
            [joint_axis(model, i).tolist() for i in joints],
            list(model.parents),
            [(f.name, f.parentJoint, f.parentFrame) for f in model.frames],
            self._fixed([p for i in joints if (p := Placement(i, False)) not in moved]),
            self.fixed_frames([*sorted(ends), *tool]),
            (self.errors.moved, self.errors.in_reference),
            (robot.closures, robot.tcp and robot.tcp.frame),
            (robot.drive_index.tolist(), robot.passive_index.tolist()),
        ]
        return hashlib.sha256("\n".join(map(repr, parts)).encode()).hexdigest()

    def fixed_frames(self, frames: Sequence[int]) -> str:
        """Text of the placements of those frames that have no error, for digests.

        Args:
            frames: Indices of frames.
        """
        moved = moved_frames(self.errors.moved)
        return self._fixed([Placement(f, True) for f in frames if f not in moved])

    def fixed_passive(self, frames: Sequence[int]) -> str:
        """Text of the reference values of the passive coordinates that move frames, for digests.

        Args:
            frames: Indices of frames.
        """
        joints = self.robot.model.joints
        moving = {joints[j].idx_v for f in frames for j in self.tree.joints_to(f)}
        coordinates = zip(self.robot.passive_index, self.robot.reference_passive, strict=True)
        return repr([(int(k), float(value)) for k, value in coordinates if k in moving])

    def _fixed(self, placements: Sequence[Placement]) -> str:
        """Text of the values of placements without errors."""
        model, moved = self.robot.model, moved_frames(self.errors.moved)
        values = (nominal_placement(model, p, moved).homogeneous.tolist() for p in placements)
        return repr(list(zip(placements, values, strict=True)))

    @property
    def n_twists(self) -> int:
        """Number of components of the twists of all moved placements."""
        return 6 * len(self.errors.moved)

    # ---- loops

    @cached_property
    def closure(self) -> ca.SX:
        """Residual g of all closures, shape (closure_rows,), [m, rad]."""
        return closure_residual(self.robot, self.tree)

    @cached_property
    def _closure_derivatives(self) -> tuple[ca.SX, ca.SX]:
        """∂g/∂q, shape (closure_rows, nv), and ∂g/∂ξ, shape (closure_rows, n_twists)."""
        blocks = [self._closure_blocks(closure) for closure in self.robot.closures]
        nv = self.robot.model.nv
        by_joints = ca.vertcat(ca.SX(0, nv), *(joints for joints, _ in blocks))
        by_twists = ca.vertcat(ca.SX(0, self.n_twists), *(twists for _, twists in blocks))
        return ca.sparsify(by_joints), ca.sparsify(by_twists)

    @cached_property
    def closure_by_passive(self) -> BatchFunction:
        """Function of `symbols`: g, and its derivative with respect to the passive coordinates."""

        def outputs() -> list[ca.SX]:
            by_joints, _ = self._closure_derivatives
            return [self.closure, by_joints[:, self.robot.passive_index.tolist()]]

        return self._batch("closure_by_passive", outputs, matrices=(1,))

    @cached_property
    def closure_and_tool(self) -> BatchFunction:
        """Function of `symbols`: g, ∂g/∂actuated, ∂g/∂passive, p, ∂p/∂actuated, ∂p/∂passive."""

        def outputs() -> list[ca.SX]:
            tool, joints, _ = self._tool()
            g, _ = self._closure_derivatives
            return [self.closure, *self.split(g), tool, *self.split(joints)]

        return self._batch("closure_and_tool", outputs, matrices=(1, 2, 4, 5))

    @cached_property
    def closure_jacobian(self) -> BatchFunction:
        """Function of `symbols`: g, ∂g/∂actuated, ∂g/∂passive and the nonzeros of ∂g/∂ξ.

        The nonzeros are in the order of `twist_pattern`.
        """
        return self._batch("closure_jacobian", self._jacobian_outputs, matrices=(1, 2), sparse=(3,))

    @cached_property
    def twist_pattern(self) -> tuple[Indices, Indices]:
        """Rows and columns of the nonzeros of ∂g/∂ξ, column by column."""
        return self.closure_jacobian.patterns["y3"]

    @cached_property
    def closure_expressions(self) -> ca.Function:
        """Closure Jacobian with all outputs sparse, for use in other expressions."""
        return self._function("closure_expressions", self._jacobian_outputs, sparse=(0, 1, 2, 3))

    def _jacobian_outputs(self) -> list[ca.SX]:
        """Residual g, ∂g/∂actuated, ∂g/∂passive and ∂g/∂ξ."""
        joints, twists = self._closure_derivatives
        return [self.closure, *self.split(joints), twists]

    # ---- frames

    def position(self, frame: str) -> BatchFunction:
        """Function of `symbols`: position of a frame in the world, shape (3,), [m]."""
        return self._frame_function("frame", frame, lambda pose: pose.position)

    def pose(self, frame: str) -> BatchFunction:
        """Function of `symbols`: pose of a frame in the world, shape (4, 4), [1, m]."""
        last = ca.SX([[0, 0, 0, 1]])
        return self._frame_function(
            "pose", frame, lambda pose: ca.blockcat([[pose.rotation, pose.position], [last]])
        )

    def _frame_function(
        self, kind: str, frame: str, express: Callable[[Pose], ca.SX]
    ) -> BatchFunction:
        """Function of `symbols`: an expression of the pose of a frame."""
        index = self.robot.frame_id(frame)
        name = f"{kind}_{index}"
        if name not in self._frame_functions:
            pose = self.tree.frame_pose
            self._frame_functions[name] = self._batch(
                name, lambda: [express(pose(index))], digest=self.fixed_frames([index])
            )
        return self._frame_functions[name]

    @cached_property
    def tool_jacobian(self) -> BatchFunction:
        """Function of `symbols`: tool p, ∂p/∂actuated, ∂p/∂passive and ∂p/∂ξ."""

        def outputs() -> list[ca.SX]:
            tool, joints, twists = self._tool()
            return [tool, *self.split(joints), twists]

        return self._batch("tool_jacobian", outputs, matrices=(1, 2, 3))

    def _tool(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Position p of the tool, ∂p/∂q and ∂p/∂ξ."""
        frame = self.robot.frame_id(require_tcp(self.robot).frame)
        return self.tree.frame_pose(frame).position, *self.wrench_rows(frame, ca.SX.eye(3))

    def wrench_rows(
        self, frame: int, forces: ca.SX, moments: ca.SX | None = None
    ) -> tuple[ca.SX, ca.SX]:
        """Derivatives of f · p + m · φ, with p the position and φ the rotation of a frame.

        Args:
            frame: Index of the frame.
            forces: f of each row, shape (n, 3).
            moments: m of each row, shape (n, 3); none by default.

        Returns:
            Derivatives with respect to the joint coordinates, shape (n, nv), and to the twists of
            the moved placements, shape (n, n_twists).
        """
        sources = [(1.0, source) for source in self._sources(frame).values()]
        return self._rows(sources, self.tree.frame_pose(frame).position, forces, moments)

    def _closure_blocks(self, closure: Closure) -> tuple[ca.SX, ca.SX]:
        """∂g/∂q and ∂g/∂ξ of one closure: its rows act as forces and moments on frame b."""
        a, b = self.robot.frame_id(closure.frame_a), self.robot.frame_id(closure.frame_b)
        pose_a, pose_b = self.tree.frame_pose(a), self.tree.frame_pose(b)
        rows, moments = list(closure.rows), None
        if closure.kind == "3d":
            forces = pose_a.rotation[:, rows].T
        else:
            relative = pose_a.relative(pose_b)
            outer = log6_jacobian(relative.rotation, relative.position)[rows, :]
            forces, moments = outer[:, :3] @ pose_b.rotation.T, outer[:, 3:] @ pose_b.rotation.T
        of_a, of_b = self._sources(a), self._sources(b)  # common sources move both alike
        sources = [(1.0, source) for key, source in of_b.items() if key not in of_a]
        sources += [(-1.0, source) for key, source in of_a.items() if key not in of_b]
        return self._rows(sources, pose_b.position, forces, moments)

    def _rows(
        self,
        sources: Sequence[tuple[float, _MotionSource]],
        position: ca.SX,
        forces: ca.SX,
        moments: ca.SX | None,
    ) -> tuple[ca.SX, ca.SX]:
        """Derivatives of rows of forces and moments at a position, from unit twists of sources."""
        n = forces.size1()
        joints, twists = ca.SX(n, self.robot.model.nv), ca.SX(n, self.n_twists)
        for sign, source in sources:
            torques = -forces @ ca.skew(position - source.pose.position)
            if moments is not None:
                torques += moments
            to_source = sign * source.pose.rotation
            block = ca.horzcat(forces @ to_source, torques @ to_source)
            self._add_block(joints, twists, source, block)
        return joints, twists

    def _sources(self, frame: int) -> dict[tuple[int, bool], _MotionSource]:
        """Joints that move a frame, and errors of these joints and of the frames that carry it."""
        sources = {
            (i, False): _MotionSource(self.tree.joint_base(i), i, self._first.get((i, False)))
            for i in self.tree.joints_to(frame)
        }
        for carrier in carriers(self.robot.model, frame):
            key = (carrier, True)
            if key in self._first:
                sources[key] = _MotionSource(self.tree.frame_pose(carrier), None, self._first[key])
        return sources

    def _add_block(self, joints: ca.SX, twists: ca.SX, source: _MotionSource, block: ca.SX) -> None:
        """Add the derivative with respect to the twist of a source to the columns of the source.

        Args:
            joints: Derivative with respect to the joint coordinates, shape (n, nv); changed.
            twists: Derivative with respect to the twists, shape (n, n_twists); changed.
            source: The source.
            block: Derivative with respect to a twist in the frame of the source, shape (n, 6).
        """
        if source.first is not None:
            twists[:, source.first : source.first + 6] += block
        if source.joint is not None:
            model = self.robot.model
            axis = ca.sparsify(ca.SX(joint_axis(model, source.joint)))
            joints[:, model.joints[source.joint].idx_v] += block @ axis

    def split(self, by_joints: ca.SX) -> list[ca.SX]:
        """Split a derivative, shape (n, nv), into its actuated and its passive columns."""
        index = self.robot.drive_index.tolist(), self.robot.passive_index.tolist()
        return [by_joints[:, columns] for columns in index]

    def _batch(
        self,
        name: str,
        outputs: Callable[[], list[ca.SX]],
        *,
        matrices: tuple[int, ...] = (),
        sparse: tuple[int, ...] = (),
        digest: str = "",
    ) -> BatchFunction:
        """Batch function of the symbols; `matrices` and `sparse` are indices of outputs."""
        return BatchFunction(
            lambda: self._function(name, outputs, sparse=sparse, digest=digest),
            matrices=[f"y{i}" for i in matrices],
            sparse=[f"y{i}" for i in sparse],
            key=function_key(name, self.digest, digest),
        )

    def _function(
        self,
        name: str,
        outputs: Callable[[], list[ca.SX]],
        *,
        sparse: tuple[int, ...],
        digest: str = "",
    ) -> ca.Function:
        """Cached function of the symbols; `outputs` is called only if it is not cached."""

        def build() -> ca.Function:
            values = [y if i in sparse else ca.densify(y) for i, y in enumerate(outputs())]
            inputs = ["actuated", "passive", "placements"]
            labels = [f"y{i}" for i in range(len(values))]
            return ca.Function(name, self.symbols, values, inputs, labels, OPTIONS)

        return cached_function(function_key(name, self.digest, digest), build)


@cached_per_robot
def robot_functions(robot: Robot) -> RobotFunctions:
    """Functions of a robot, built once."""
    return RobotFunctions(robot)


def reference_poses(robot: Robot, frames: Sequence[str]) -> list[Array]:
    """Poses of frames of the nominal machine in its reference posture, (4, 4) each, [1, m]."""
    functions = robot_functions(robot)
    errors = functions.errors
    placements = errors.placements(np.zeros(len(errors.names)))
    posture = robot.drive_zero[None], robot.reference_passive[None]
    return [functions.pose(frame)(*posture, placements)[0][0] for frame in frames]
