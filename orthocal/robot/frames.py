"""Frames of a Pinocchio model: search by name, parent frames, and placement errors."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from orthocal.arrays import Array
from orthocal.errors import RobotError


@dataclass(frozen=True, slots=True)
class Placement:
    """Placement of a joint in its parent, or of a frame in the frame or joint that carries it."""

    index: int
    """Index of the joint or frame in the robot's model."""
    of_frame: bool
    """True for a frame, False for a joint."""


def find_frame(model: pin.Model, name: str, *, where: str) -> int:
    """Index of a frame by its name: of a link, a fixed joint or a moving joint, in this order.

    Raises:
        RobotError: If there is no such frame.
    """
    for kind in (pin.FrameType.BODY, pin.FrameType.FIXED_JOINT, pin.FrameType.JOINT):
        if model.existFrame(name, kind):
            return int(model.getFrameId(name, kind))
    raise RobotError(f"the URDF has no frame '{name}'", where=where)


def parent_frame(model: pin.Model, frame: int) -> int | None:
    """Parent frame on the same joint, whose errors move this frame; None if there is none."""
    f = model.frames[frame]
    parent = int(f.parentFrame)
    same_joint = model.frames[parent].parentJoint == f.parentJoint
    return parent if same_joint and frame != parent else None


def carriers(model: pin.Model, frame: int) -> Iterator[int]:
    """Frame and its ancestors on the same joint, whose errors move it, from the frame upwards."""
    current: int | None = frame
    while current is not None:
        yield current
        current = parent_frame(model, current)


def nearest_carrier(model: pin.Model, frame: int, frames: Container[int]) -> int | None:
    """Nearest of some frames that carries a frame on the same joint; None if none does."""
    return next((f for f in carriers(model, frame) if f != frame and f in frames), None)


def frame_jacobian(model: pin.Model, data: pin.Data, frame: int) -> Array:
    """Jacobian of a frame's velocity and angular velocity in the world, shape (6, nv).

    Args:
        model: The model.
        data: Its data after `computeJointJacobians` and `updateFramePlacements`.
        frame: Index of the frame.
    """
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    # a vector for a model of one joint
    return np.reshape(pin.getFrameJacobian(model, data, frame, world), (6, model.nv))


def place_frames(model: pin.Model, nominal: pin.Model, twists: Mapping[int, Array]) -> None:
    """Write frame errors into a model: placement · exp6(δ). Child frames move with their parents.

    Args:
        model: The model to change.
        nominal: The model without errors.
        twists: Indices of frames, mapped to their errors δ, shape (6,), [m, rad].
    """
    moved: dict[int, pin.SE3] = {}  # parents precede their children in a model
    for i, frame in enumerate(nominal.frames):
        carrier, placement = parent_frame(nominal, i), frame.placement
        if carrier is not None and carrier in moved:
            placement = moved[carrier] * nominal.frames[carrier].placement.inverse() * placement
        elif i not in twists:
            continue
        moved[i] = placement * pin.exp6(twists[i]) if i in twists else placement
        model.frames[i].placement = moved[i]
