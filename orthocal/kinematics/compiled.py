"""The functions of a robot that everything is computed with: built once, for all its errors.

They take where the drives really are, the passive coordinates and the placements that errors have
moved (see `ErrorMap`), so that another machine, session, model or choice of free errors is another
evaluation. Derivatives follow the geometry of the machine, not the graph: a joint or an error that
acts in a frame X moves another frame b by the twist Ad(b⁻¹ X) ξ. That is several times less work
than differentiating the expressions, and as exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocal.kinematics.backend.batch_function import BatchFunction
from orthocal.kinematics.error_map import ErrorMap, error_map
from orthocal.kinematics.function_cache import kept_function, once_a_robot
from orthocal.kinematics.symbolic import Pose, SymbolicTree, log6
from orthocal.robot.frames import hangs_on
from orthocal.robot.model import Closure, Robot, closure_row_units, joint_axis

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """A frame in which a joint or an error acts."""

    pose: Pose
    joint: int | None
    first: int | None
    """Component of the moved placements' twists where its own begin."""


class CompiledRobot:
    """Expressions of a robot, and functions of them.

    Args:
        robot: The nominal robot.
        passive: Passive coordinates instead of symbols.
        placements: Symbols of another one to share.

    Attributes:
        actuated: Symbol for where the drives are, shape (n_drives,), [m, rad].
        passive: Symbol for the passive coordinates, shape (n_passive,), [m, rad].
        placements: Symbol for the moved placements, shape (12 n_moved,), [1, m].
    """

    def __init__(
        self, robot: Robot, *, passive: ca.SX | None = None, placements: ca.SX | None = None
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
        for k, m in enumerate(moved):
            v = self.placements[12 * k : 12 * k + 12]
            (frames if m.of_frame else joints)[m.index] = Pose(ca.reshape(v[:9], 3, 3), v[9:])
        self.tree = SymbolicTree(
            robot.model, coordinates, joint_placements=joints, frame_placements=frames
        )
        self._first = {(m.index, m.of_frame): 6 * k for k, m in enumerate(moved)}
        self._positions: dict[int, BatchFunction] = {}
        self._poses: dict[int, BatchFunction] = {}

    @property
    def symbols(self) -> list[ca.SX]:
        """Actuated and passive coordinates, placements."""
        return [self.actuated, self.passive, self.placements]

    @cached_property
    def at_zero(self) -> CompiledRobot:
        """The same machine in its zero posture, its drives symbols of their own.

        Passive joints are as nominal: what moves with drives alone is where it is.
        """
        zero = ca.SX(self.robot.zero[self.robot.passive_index])
        return CompiledRobot(self.robot, passive=zero, placements=self.placements)

    @property
    def n_twists(self) -> int:
        """Components of the moved placements' twists."""
        return 6 * len(self.errors.moved)

    # ---- loops

    @cached_property
    def closure(self) -> ca.SX:
        """G of all closures, in metres: rotations times the length, shape (closure_rows,)."""
        errors = []
        for c in self.robot.closures:
            a, b = (self.tree.frame_pose(self.robot.frame_id(f)) for f in (c.frame_a, c.frame_b))
            relative = a.relative(b)
            error = relative.position if c.kind == "3d" else log6(relative)
            errors.append(error[list(c.rows)])
        return ca.vertcat(ca.SX(0, 1), *errors) * closure_row_units(self.robot)

    @cached_property
    def closure_slopes(self) -> tuple[ca.SX, ca.SX]:
        """∂g by the joint coordinates, (closure_rows, nv), and by twists, (…, n_twists)."""
        found = [self._closure_blocks(closure) for closure in self.robot.closures]
        scale = ca.diag(ca.SX(closure_row_units(self.robot)))
        nv = self.robot.model.nv
        by_joints = ca.vertcat(ca.SX(0, nv), *(joints for joints, _ in found))
        by_twists = ca.vertcat(ca.SX(0, self.n_twists), *(twists for _, twists in found))
        return ca.sparsify(scale @ by_joints), ca.sparsify(scale @ by_twists)

    @cached_property
    def closing(self) -> BatchFunction:
        """(actuated, passive, placements) to g, ∂g by the passive coordinates."""

        def outputs() -> list[ca.SX]:
            by_joints, _ = self.closure_slopes
            return [self.closure, by_joints[:, self.robot.passive_index.tolist()]]

        return self._batch("closing", outputs, matrices=(1,))

    @cached_property
    def inverting(self) -> BatchFunction:
        """(actuated, passive, placements) to g, ∂g by actuated, by passive; tool, ∂ likewise."""

        def outputs() -> list[ca.SX]:
            rows = [self._wrench_row(frame, force=ca.SX(np.eye(3)[i]))[0] for i in range(3)]
            g, _ = self.closure_slopes
            tool = self.tree.frame_pose(frame).position
            return [self.closure, *self._split(g), tool, *self._split(ca.vertcat(*rows))]

        frame = self._tool_frame()
        return self._batch("inverting", outputs, matrices=(1, 2, 4, 5))

    @cached_property
    def slopes(self) -> BatchFunction:
        """(actuated, passive, placements) to g, ∂g by actuated, by passive, and by twists.

        The last as nonzeros, where `twist_pattern` says.
        """
        return self._batch("slopes", self._slope_outputs, matrices=(1, 2), sparse=(3,))

    @cached_property
    def twist_pattern(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns of the nonzeros of ∂g by twists, column by column."""
        return self.slopes.pattern("y3")

    @cached_property
    def expressions(self) -> ca.Function:
        """The same with all outputs sparse, to be put into other expressions."""
        return self._kept("expressions", self._slope_outputs, sparse=(0, 1, 2, 3))

    def _slope_outputs(self) -> list[ca.SX]:
        joints, twists = self.closure_slopes
        return [self.closure, *self._split(joints), twists]

    # ---- frames

    def position(self, frame: str) -> BatchFunction:
        """(actuated, passive, placements) to the position of a frame, [m]."""
        index = self.robot.frame_id(frame)
        if index not in self._positions:
            self._positions[index] = self._batch(
                f"frame_{index}", lambda: [self.tree.frame_pose(index).position]
            )
        return self._positions[index]

    def pose(self, frame: str) -> BatchFunction:
        """(actuated, passive, placements) to the pose of a frame, shape (4, 4), [1, m]."""
        index = self.robot.frame_id(frame)
        if index not in self._poses:
            self._poses[index] = self._batch(f"pose_{index}", lambda: [self._homogeneous(index)])
        return self._poses[index]

    def _homogeneous(self, frame: int) -> ca.SX:
        pose = self.tree.frame_pose(frame)
        return ca.vertcat(ca.horzcat(pose.rotation, pose.position), ca.SX([[0, 0, 0, 1]]))

    @cached_property
    def tool(self) -> BatchFunction:
        """(actuated, passive, placements) to the tool, ∂ by actuated, by passive and by twists."""

        def outputs() -> list[ca.SX]:
            rows = [self._wrench_row(frame, force=ca.SX(np.eye(3)[i])) for i in range(3)]
            joints = self._split(ca.vertcat(*(j for j, _ in rows)))
            twists = ca.vertcat(*(t for _, t in rows))
            return [self.tree.frame_pose(frame).position, *joints, twists]

        frame = self._tool_frame()
        return self._batch("tool", outputs, matrices=(1, 2, 3))

    def _tool_frame(self) -> int:
        """Of the tool, which whoever asks has made sure of."""
        return self.robot.frame_id("" if self.robot.tcp is None else self.robot.tcp.frame)

    def wrench_row(
        self, frame: int, *, force: ca.SX, moment: ca.SX | None = None
    ) -> tuple[ca.SX, ca.SX]:
        """What moves f · p + m · φ of a frame, p its position and φ its rotation in the world.

        Args:
            frame: Index of the frame.
            force: f, shape (3,).
            moment: m, shape (3,); none by default.

        Returns:
            By the joint coordinates, shape (1, nv), and by the twists of the moved placements,
            shape (1, n_twists).
        """
        return self._wrench_row(frame, force=force, moment=moment)

    def split(self, by_joints: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Columns of the actuated and of the passive coordinates, of (n, nv)."""
        actuated, passive = self._split(by_joints)
        return actuated, passive

    def _wrench_row(
        self, frame: int, *, force: ca.SX, moment: ca.SX | None = None
    ) -> tuple[ca.SX, ca.SX]:
        position = self.tree.frame_pose(frame).position
        joints, twists = ca.SX(1, self.robot.model.nv), ca.SX(1, self.n_twists)
        for source in self._sources(frame).values():
            to_source = source.pose.rotation.T
            turning = ca.cross(position - source.pose.position, force)
            if moment is not None:
                turning += moment
            block = ca.vertcat(to_source @ force, to_source @ turning).T
            self._place(joints, twists, source, block)
        return joints, twists

    def _closure_blocks(self, closure: Closure) -> tuple[ca.SX, ca.SX]:
        """∂g of one closure, its rows as forces and moments on b where b is, in the world."""
        a, b = self.robot.frame_id(closure.frame_a), self.robot.frame_id(closure.frame_b)
        pose_a, pose_b = self.tree.frame_pose(a), self.tree.frame_pose(b)
        rows = list(closure.rows)
        if closure.kind == "3d":
            forces, moments = pose_a.rotation[:, rows].T, ca.SX(len(rows), 3)
        else:
            outer = log6_jacobian(pose_a.relative(pose_b))[rows, :]
            forces, moments = outer[:, :3] @ pose_b.rotation.T, outer[:, 3:] @ pose_b.rotation.T
        joints = ca.SX(len(rows), self.robot.model.nv)
        twists = ca.SX(len(rows), self.n_twists)
        of_a, of_b = self._sources(a), self._sources(b)
        for key in (*of_b, *of_a):
            if key in of_a and key in of_b:
                continue  # moves both alike
            sign, source = (1.0, of_b[key]) if key in of_b else (-1.0, of_a[key])
            arm = pose_b.position - source.pose.position
            turning = moments - forces @ ca.skew(arm)
            to_source = sign * source.pose.rotation
            block = ca.horzcat(forces @ to_source, turning @ to_source)
            self._place(joints, twists, source, block)
        return joints, twists

    def _sources(self, frame: int) -> dict[tuple[int, bool], Source]:
        """All that moves a frame: its joints, and errors of joints and of frames it hangs on."""
        found = {
            (i, False): Source(self.tree.joint_base(i), i, self._first.get((i, False)))
            for i in self.tree.joints_to(frame)
        }
        current: int | None = frame
        while current is not None:
            key = (current, True)
            if key in self._first:
                found[key] = Source(self.tree.frame_pose(current), None, self._first[key])
            current = hangs_on(self.robot.model, current)
        return found

    def _place(self, joints: ca.SX, twists: ca.SX, source: Source, block: ca.SX) -> None:
        """Put what a unit twist in a source's frame does where the source's columns are."""
        if source.first is not None:
            twists[:, source.first : source.first + 6] += block
        if source.joint is not None:
            model = self.robot.model
            joint = model.joints[source.joint]
            if joint.nv == 1:
                axis = ca.sparsify(ca.SX(joint_axis(model, source.joint)))
            else:
                axis = ca.vertcat(ca.SX.eye(3), ca.SX(3, 3))  # a translation joint
            joints[:, joint.idx_v : joint.idx_v + joint.nv] += block @ axis

    def _split(self, by_joints: ca.SX) -> list[ca.SX]:
        index = self.robot.drive_index.tolist(), self.robot.passive_index.tolist()
        return [by_joints[:, columns] for columns in index]

    def _batch(
        self,
        name: str,
        outputs: Callable[[], list[ca.SX]],
        *,
        matrices: tuple[int, ...] = (),
        sparse: tuple[int, ...] = (),
    ) -> BatchFunction:
        function = self._kept(name, outputs, sparse=sparse)
        return BatchFunction(
            function,
            shared=["placements"],
            matrices=[f"y{i}" for i in matrices],
            sparse=[f"y{i}" for i in sparse],
        )

    def _kept(
        self, name: str, outputs: Callable[[], list[ca.SX]], *, sparse: tuple[int, ...]
    ) -> ca.Function:
        """A function of the symbols; its outputs are expressed only where it is not kept."""

        def build() -> ca.Function:
            found = outputs()
            values = [y if i in sparse else ca.densify(y) for i, y in enumerate(found)]
            inputs = ["actuated", "passive", "placements"]
            labels = [f"y{i}" for i in range(len(values))]
            return ca.Function(name, self.symbols, values, inputs, labels)

        return kept_function(self.robot, name, build)


@once_a_robot(maxsize=8)
def compiled_robot(robot: Robot) -> CompiledRobot:
    """The functions of a robot, built once."""
    return CompiledRobot(robot)


def zero_poses(robot: Robot, frames: Sequence[str]) -> list[Array]:
    """Poses of frames of the nominal machine in its zero posture, shape (4, 4) each, [1, m]."""
    compiled = compiled_robot(robot)
    errors = compiled.errors
    placements = errors.placements(np.zeros(len(errors.names)))
    zero = robot.drive_zero[None], robot.zero[robot.passive_index][None]
    return [compiled.pose(frame)(*zero, placements)[0][0] for frame in frames]


def log6_jacobian(pose: Pose) -> ca.SX:
    """Derivative of log6(M exp6(ξ)) by ξ at 0, as Pinocchio's Jlog6, shape (6, 6)."""
    r, p = ca.SX.sym("r", 3, 3), ca.SX.sym("p", 3)
    error = log6(Pose(r, p))
    by_rotation = ca.jacobian(error, ca.vec(r))
    by_position = ca.jacobian(error, p) @ r
    turns = [ca.vec(r @ ca.skew(ca.SX(np.eye(3)[k]))) for k in range(3)]
    result = ca.horzcat(by_position, by_rotation @ ca.horzcat(*turns))
    return ca.Function("log6_jacobian", [r, p], [result])(pose.rotation, pose.position)
