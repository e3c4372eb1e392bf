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

from orthocal.effects.protocol import Effect, EffectKeys, Placement, Symbols
from orthocal.io.documents import PositiveNumber
from orthocal.robot.frames import carriers
from orthocal.robot.model import Robot, joint_axis
from orthocal.robot.parameters import AXES, ElementaryError
from orthocal.units import MM, MRAD, read_limit


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
    it is the same error as the offset.
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
            twist = components.setdefault(self.robot.placement_of(e), [ca.SX(1, 1)] * 6)
            twist[e.axis] = twist[e.axis] + errors[e.name]
        return {placement: ca.vertcat(*twist) for placement, twist in components.items()}


def _joint_errors(robot: Robot, keys: GeometryTolerances) -> Iterator[ElementaryError]:
    """Errors of the placements of all joints."""
    model, drives = robot.model, {d.name for d in robot.drives}
    for i in range(1, model.njoints):
        name = str(model.names[i])
        drive_axis = int(np.abs(joint_axis(model, i)).argmax()) if name in drives else None
        for axis in range(6):
            if axis != drive_axis:
                yield _error(name, axis, keys, complete=True, of_frame=False)


def _frame_errors(robot: Robot, keys: GeometryTolerances) -> Iterator[ElementaryError]:
    """Errors of the placements of all frames in use."""
    complete = _loop_frames(robot)
    for frame in robot.frames:
        for axis in range(6):
            yield _error(frame, axis, keys, complete=frame in complete, of_frame=True)


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


def _loop_frames(robot: Robot) -> frozenset[str]:
    """Frames of closures, except those that carry the tool.

    Their errors belong to parts of the machine. An error of a frame that carries the tool only
    moves the tool on the platform.
    """
    tool = set(carriers(robot.model, robot.frame_id(robot.tcp.frame))) if robot.tcp else set()
    ends = {frame for c in robot.closures for frame in (c.frame_a, c.frame_b)}
    return frozenset(frame for frame in ends if robot.frame_id(frame) not in tool)
