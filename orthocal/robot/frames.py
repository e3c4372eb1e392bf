"""Frames of a Pinocchio model: by name, what they hang on, and errors written into them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from orthocal.errors import RobotError

Array = NDArray[np.float64]


def find_frame(model: pin.Model, name: str, *, where: str) -> int:
    """Index of the frame of a link, or else of a fixed or moving joint, of this name.

    Raises:
        RobotError: If there is none.
    """
    for kind in (pin.FrameType.BODY, pin.FrameType.FIXED_JOINT, pin.FrameType.JOINT):
        if model.existFrame(name, kind):
            return int(model.getFrameId(name, kind))
    raise RobotError(f"the URDF has no frame '{name}'", where=where)


def hangs_on(model: pin.Model, frame: int) -> int | None:
    """The frame of the same joint that a frame hangs on, whose errors move it; None if none."""
    f = model.frames[frame]
    parent = int(f.parentFrame)
    if f.type == pin.FrameType.JOINT or frame == parent:
        return None
    return parent if model.frames[parent].parentJoint == f.parentJoint else None


def place_frames(model: pin.Model, nominal: pin.Model, twists: Mapping[str, Array]) -> None:
    """Write frame errors into a model; frames that hang on a frame move with it."""
    moved: dict[int, pin.SE3] = {}
    targets = {find_frame(nominal, name, where="frame"): t for name, t in twists.items()}
    for i, frame in enumerate(nominal.frames):
        parent = frame.parentFrame
        shift = targets.get(i)
        hangs = nominal.frames[parent].parentJoint == frame.parentJoint and parent in moved
        if frame.type == pin.FrameType.JOINT or (shift is None and not hangs):
            continue
        placement = frame.placement
        if hangs:
            placement = moved[parent] * nominal.frames[parent].placement.inverse() * placement
        moved[i] = placement if shift is None else placement * pin.exp6(shift)
        model.frames[i].placement = moved[i]
