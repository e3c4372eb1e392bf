"""Elementary errors of placements: joints, and the frames of closures, legs and the tool.

    placement · exp6(δ),  δ = (translation, rotation)

A parameter is one component of the twist δ, in the axes of the joint or frame:

    x_coupler.rx      rotation of the placement of joint x_coupler about the joint's x axis
    frame.tcp.z       translation of frame tcp along the frame's z axis
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Self

import casadi as ca
import numpy as np
import pinocchio as pin

from orthocal.effects.protocol import Effect, EffectKeys, Placement, Symbols
from orthocal.io.documents import PositiveNumber
from orthocal.robot.closing import RANK_TOLERANCE
from orthocal.robot.frames import carriers, frame_jacobian
from orthocal.robot.model import Closure, Robot, joint_axis
from orthocal.robot.parameters import AXES, ElementaryError
from orthocal.units import MM, MRAD, read_limit

SMALLEST_TURN = 1e-6
"""Turn of two frames against each other that is not a rounding error, [rad/m, rad/rad]."""


class GeometryTolerances(EffectKeys):
    """Tolerances of placements under `orthocal.tolerances`: ±2 prior standard deviations."""

    translation_mm: PositiveNumber = 0.2
    rotation_mrad: PositiveNumber = 2.0


@dataclass(frozen=True, eq=False)
class GeometryErrors(Effect):
    """Elementary errors of the placements of joints and frames."""

    name = "geometry"
    keys = GeometryTolerances

    robot: Robot
    errors: tuple[ElementaryError, ...]
    """Errors of joint placements, then of the frames in use.

    The component of a drive's placement along or about the axis of the drive is omitted, because
    it is the same error as the offset. Of an axis oblique to the joint frame the component with
    the largest direction cosine is omitted.
    """

    @classmethod
    def from_keys(cls, keys: GeometryTolerances, robot: Robot) -> Self:
        """Build the effect for a robot (see `Effect.from_keys`)."""
        return cls(robot, (*_joint_errors(robot, keys), *_frame_errors(robot, keys)))

    def describe(self) -> str:
        """Description in a few words."""
        return "position and orientation of each joint and frame"

    def placements(self, errors: Symbols, conditions: Symbols) -> Mapping[Placement, ca.SX]:
        """Twists of placements (see `Effect.placements`)."""
        components: dict[Placement, list[ca.SX]] = {}
        for e in self.errors:
            zeros = [ca.SX(1, 1)] * 6  # structural zeros: absent errors cost nothing
            twist = components.setdefault(self.robot.placement_of(e), zeros)
            twist[e.axis] = twist[e.axis] + errors[e.name]
        return {placement: ca.vertcat(*twist) for placement, twist in components.items()}


def _joint_errors(robot: Robot, keys: GeometryTolerances) -> Iterator[ElementaryError]:
    """Errors of the placements of all joints."""
    model, drives = robot.model, {d.name for d in robot.drives}
    for i in range(1, model.njoints):
        name = str(model.names[i])
        # of an oblique axis the largest component: the others and the offset replace it
        drive_axis = int(np.abs(joint_axis(model, i)).argmax()) if name in drives else None
        for axis in range(6):
            if axis != drive_axis:
                yield _error(name, axis, keys, complete=True, of_frame=False)


def _frame_errors(robot: Robot, keys: GeometryTolerances) -> Iterator[ElementaryError]:
    """Errors of the placements of all frames in use."""
    complete = _of_complete_model(robot)
    for frame in robot.frames:
        for axis in range(6):
            yield _error(frame, axis, keys, complete=axis in complete[frame], of_frame=True)


def _error(
    owner: str, axis: int, keys: GeometryTolerances, *, complete: bool, of_frame: bool
) -> ElementaryError:
    """One component of the twist of a joint or a frame, with its prior."""
    translation = axis < 3
    limit = keys.translation_mm * MM if translation else keys.rotation_mrad * MRAD
    return ElementaryError(
        name=f"{'frame.' if of_frame else ''}{owner}.{AXES[axis]}",
        kind="translation" if translation else "rotation",
        owner=owner,
        unit="m" if translation else "rad",
        prior_std=read_limit(limit),
        of_frame=of_frame,
        axis=axis,
        complete=complete,
    )


def _of_complete_model(robot: Robot) -> dict[str, range]:
    """Components of the twist of each frame that belong to the complete model.

    Two frames of a closure are ends of links, such as rods.

    | frame                                              | components               |
    |----------------------------------------------------|--------------------------|
    | on a link that does not carry the tool             | all                      |
    | on the tool's link, turns against the other frame  | translation; all of `6d` |
    | on the tool's link, does not turn                  | none: those of the other |
    | of no closure, such as the tool centre point       | none                     |

    A frame of several closures has the largest set.
    """
    tool = set(carriers(robot.model, robot.frame_id(robot.tcp.frame))) if robot.tcp else set()
    complete = dict.fromkeys(robot.frames, range(0))
    for closure in robot.closures:
        for frame in (closure.frame_a, closure.frame_b):
            parts = range(6)
            if robot.frame_id(frame) in tool:
                size = 3 if closure.kind == "3d" else 6
                parts = range(size if _turns(robot, closure) else 0)
            complete[frame] = max(complete[frame], parts, key=len)
    return complete


def _turns(robot: Robot, closure: Closure) -> bool:
    """True if the frames of a closure turn against each other as the drives begin to move."""
    model, coordinates = robot.model, robot.reference_posture
    data = model.createData()
    pin.computeJointJacobians(model, data, robot.configuration(coordinates))
    pin.updateFramePlacements(model, data)
    first, second = (
        frame_jacobian(model, data, robot.frame_id(frame))[3:]
        for frame in (closure.frame_a, closure.frame_b)
    )
    _, g = robot.evaluate_constraints_at(coordinates)
    drives, passive = robot.drive_index.tolist(), robot.passive_index.tolist()
    following = np.linalg.lstsq(g[:, passive], -g[:, drives], rcond=RANK_TOLERANCE)[0]
    turn = (second - first)[:, drives] + (second - first)[:, passive] @ following
    return bool(np.abs(turn).max(initial=0.0) > SMALLEST_TURN)
