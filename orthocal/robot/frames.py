"""Frames of a Pinocchio model: search by name, parent frames, and placement errors."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass

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
    if f.type == pin.FrameType.JOINT or frame == parent:
        return None
    return parent if model.frames[parent].parentJoint == f.parentJoint else None


def carriers(model: pin.Model, frame: int) -> Iterator[int]:
    """Frame and its ancestors on the same joint, whose errors move it, from the frame upwards."""
    current: int | None = frame
    while current is not None:
        yield current
        current = parent_frame(model, current)


def nearest_carrier(model: pin.Model, frame: int, frames: Container[int]) -> int | None:
    """Nearest of some frames that carries a frame on the same joint; None if none does."""
    return next((f for f in carriers(model, frame) if f != frame and f in frames), None)


def place_frames(model: pin.Model, nominal: pin.Model, twists: Mapping[str, Array]) -> None:
    """Write frame errors into a model: placement · exp6(δ). Child frames move with their parents.

    Args:
        model: The model to change.
        nominal: The model without errors.
        twists: Names of frames, mapped to their errors δ, shape (6,), [m, rad].
    """
    moved: dict[int, pin.SE3] = {}
    errors = {find_frame(nominal, name, where="frame"): t for name, t in twists.items()}
    for i, frame in enumerate(nominal.frames):
        parent = frame.parentFrame
        error = errors.get(i)
        is_carried = nominal.frames[parent].parentJoint == frame.parentJoint and parent in moved
        if frame.type == pin.FrameType.JOINT or (error is None and not is_carried):
            continue
        placement = frame.placement
        if is_carried:
            placement = moved[parent] * nominal.frames[parent].placement.inverse() * placement
        moved[i] = placement if error is None else placement * pin.exp6(error)
        model.frames[i].placement = moved[i]
