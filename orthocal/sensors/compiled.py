"""Readings of sensors as functions: built once for each kind of sensor and the frames it looks at.

The derivatives by the poses of the frames are those of the sensor's own expression; those of the
poses follow the geometry of the machine: a frame on which the reading pulls with force f and moment
m is moved by whatever carries it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocal.kinematics.batch import BatchFunction
from orthocal.kinematics.compiled import compiled_robot
from orthocal.kinematics.kept import identify, kept_function
from orthocal.kinematics.symbolic import Pose
from orthocal.robot.model import Robot
from orthocal.sensors.protocol import Frames, Sensor, View

Array = NDArray[np.float64]

INPUTS = ["actuated", "passive", "placements", "zero", "constants", "unknowns"]


@dataclass(frozen=True, slots=True, eq=False)
class CompiledReading:
    """What a kind of sensor shows, and what moves it.

    All functions take: actuated and passive coordinates, placements, the drives in the zero
    posture, constants and unknowns.
    """

    value: BatchFunction
    """h, [m]."""
    slopes: BatchFunction
    """h; ∂h by actuated, passive, twists, zero drives and unknowns, each of one row; of that by
    twists the nonzeros alone."""
    expression: ca.Function
    """The same with sparse rows, to be put into other expressions."""
    words: str
    """What distinguishes it from other readings of the robot."""


def compile_reading(robot: Robot, sensor: Sensor) -> CompiledReading:
    """The functions of a sensor; one build for all of its kind that look at the same frames."""
    frames = sensor.frames(robot)
    return _compile(_Pattern(robot, sensor, frames))


class _Pattern:
    """Equal for sensors that have one expression."""

    def __init__(self, robot: Robot, sensor: Sensor, frames: Frames) -> None:
        self.robot, self.sensor, self.frames = robot, sensor, frames
        self.n_constants = sensor.constants(robot).size
        self._key = (
            identify(robot),
            sensor.kind,
            frames,
            self.n_constants,
            len(sensor.unknowns),
        )

    @property
    def words(self) -> str:
        """What distinguishes it from other patterns of the robot."""
        return repr(self._key[1:])

    @cached_property
    def expressions(self) -> tuple[list[ca.SX], list[ca.SX]]:
        """Inputs and outputs of its functions."""
        return _express(self)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Pattern) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


@lru_cache(maxsize=256)
def _compile(pattern: _Pattern) -> CompiledReading:
    value, slopes = (
        kept_function(pattern.robot, f"{name} {pattern.words}", partial(build, pattern))
        for name, build in (("reading", _build_value), ("reading slopes", _build_slopes))
    )
    rows = [name for name in slopes.name_out() if name not in ("h", "by_twists")]
    return CompiledReading(
        value=BatchFunction(value, shared=["placements"]),
        slopes=BatchFunction(slopes, shared=["placements"], matrices=rows, sparse=["by_twists"]),
        expression=slopes,
        words=pattern.words,
    )


def _build_value(pattern: _Pattern) -> ca.Function:
    inputs, outputs = pattern.expressions
    return ca.Function("h", inputs, [ca.densify(outputs[0])], INPUTS, ["h"])


def _build_slopes(pattern: _Pattern) -> ca.Function:
    inputs, outputs = pattern.expressions
    labels = ["h", *(f"by_{n}" for n in ("actuated", "passive", "twists", "zero", "unknowns"))]
    return ca.Function("slopes", inputs, outputs, INPUTS, labels)


def _express(pattern: _Pattern) -> tuple[list[ca.SX], list[ca.SX]]:
    """Inputs and outputs: h; ∂h by actuated, passive, twists, zero drives and unknowns."""
    robot, sensor = pattern.robot, pattern.sensor
    here = compiled_robot(robot)
    there = here.at_zero
    constants = ca.SX.sym("constants", pattern.n_constants)
    unknowns = ca.SX.sym("unknowns", len(sensor.unknowns))
    trees = [
        *((here, robot.frame_id(f)) for f in pattern.frames.in_posture),
        *((there, robot.frame_id(f)) for f in pattern.frames.at_zero),
    ]
    poses = [Pose(ca.SX.sym("rotation", 3, 3), ca.SX.sym("position", 3)) for _ in trees]
    count = len(pattern.frames.in_posture)
    view = View(poses[:count], poses[count:], constants, unknowns)
    h = sensor.expression(view, robot)
    pulls = [_pull(h, pose) for pose in poses]
    local = ca.Function(
        "sensor",
        [*(s for pose in poses for s in (pose.rotation, pose.position)), constants, unknowns],
        [h, *(v for pull in pulls for v in pull), ca.jacobian(h, unknowns)],
    )
    seen = [machine.tree.frame_pose(frame) for machine, frame in trees]
    found = local(
        *(s for pose in seen for s in (pose.rotation, pose.position)), constants, unknowns
    )
    value, by_unknowns = found[0], found[-1]
    n_d, n_p = here.actuated.numel(), here.passive.numel()
    by_actuated, by_passive = ca.SX(1, n_d), ca.SX(1, n_p)
    by_zero, by_twists = ca.SX(1, n_d), ca.SX(1, here.n_twists)
    for i, (machine, frame) in enumerate(trees):
        force, moment = found[1 + 2 * i], found[2 + 2 * i]
        joints, twists = machine.wrench_row(frame, force=force, moment=moment)
        actuated, passive = machine.split(joints)
        by_twists += twists
        if machine is there:
            by_zero += actuated
        else:
            by_actuated, by_passive = by_actuated + actuated, by_passive + passive
    inputs = [*here.symbols, there.actuated, constants, unknowns]
    return inputs, [value, by_actuated, by_passive, by_twists, by_zero, by_unknowns]


def _pull(h: ca.SX, pose: Pose) -> tuple[ca.SX, ca.SX]:
    """Force and moment, in the world, by which a pose moves a reading."""
    force = ca.jacobian(h, pose.position).T
    by_rotation = ca.reshape(ca.jacobian(h, ca.vec(pose.rotation)), 3, 3)
    moment = [ca.dot(by_rotation, ca.skew(ca.SX(np.eye(3)[i])) @ pose.rotation) for i in range(3)]
    return force, ca.vertcat(*moment)
