"""Compiled functions of a sensor's reading, built once per kind of sensor and frames.

The derivatives with respect to the poses of the frames follow from the sensor's expression. They
are equivalent to a force f and a moment m on each frame. The derivatives of the poses follow from
the kinematics of the machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import casadi as ca
import numpy as np

from orthocal.effects.loading import reading_effects
from orthocal.effects.protocol import (
    NEUTRAL,
    Condition,
    Symbols,
    condition_size,
    require_expression,
)
from orthocal.errors import OrthocalError
from orthocal.kinematics.backend.batch_function import BatchFunction
from orthocal.kinematics.function_cache import (
    OPTIONS,
    cached_function,
    fingerprint,
    function_key,
    identify,
    source_digest,
)
from orthocal.kinematics.robot_functions import RobotFunctions, robot_functions
from orthocal.kinematics.symbolic import Pose
from orthocal.robot.model import Robot
from orthocal.sensors.protocol import Frames, Sensor, View, sensor_conditions

INPUTS = ["actuated", "passive", "placements", "zero", "constants", "nuisance"]
"""Inputs of the functions of a reading (see `CompiledReading`)."""

FUNCTIONS = "reading", "reading jacobian"
"""Names of the functions of a reading."""

SECOND_INPUTS = ["actuated_2", "passive_2"]
"""Additional inputs for a pair of postures: coordinates in the second posture."""


@dataclass(frozen=True, slots=True, eq=False)
class CompiledReading:
    """Functions of the reading of one kind of sensor.

    Their inputs are actuated and passive coordinates, placements, drives in the reference posture,
    constants and nuisance parameters. For a pair of postures, actuated and passive coordinates in
    the second posture follow.
    """

    value: BatchFunction
    """Reading h, [m]."""
    jacobian: BatchFunction
    """Reading h, then its derivatives with respect to actuated coordinates, passive coordinates,
    twists, drives in the reference posture and nuisance parameters. Each is one row; that with
    respect to the twists contains its nonzeros only. For a pair, derivatives with respect to the
    coordinates in the second posture follow."""
    expression: ca.Function
    """Function with the outputs of `jacobian` as sparse rows, for use in other expressions."""
    pattern: ReadingPattern
    """Pattern that the sensors share."""
    pairs: bool
    """Whether a reading belongs to a pair of postures."""
    probe: float | None
    """Value of the expression at fixed arguments for a sensor from another package, else None."""


def compile_reading(robot: Robot, sensor: Sensor) -> CompiledReading:
    """Functions of a sensor's reading, built once for all sensors of its kind and frames.

    Raises:
        OrthocalError: If sensors of one kind and with the same frames have different expressions,
            or an expression is not a single one of CasADi.
    """
    pattern = ReadingPattern(robot, sensor, sensor.frames(robot))
    reading = _compile(pattern)
    if reading.probe is not None and not np.array_equal(
        _probe(pattern), reading.probe, equal_nan=True
    ):
        raise OrthocalError(
            f"the expression of a sensor '{sensor.kind}' depends on more than its frames, "
            "constants and nuisance parameters: put what differs between setups into `constants`"
        )
    return reading


class ReadingPattern:
    """Key of a sensor's expression; sensors with equal patterns share compiled functions."""

    def __init__(self, robot: Robot, sensor: Sensor, frames: Frames) -> None:
        self.robot, self.sensor, self.frames = robot, sensor, frames
        self.conditions = reading_conditions(robot, sensor)
        """Conditions that follow the constants of the sensor in the inputs."""
        sizes = (condition_size(robot, c) for c in self.conditions)
        self.n_constants = np.size(sensor.constants(robot)) + sum(sizes)
        effect_errors = (e.name for effect in reading_effects(robot) for e in effect.setup_errors)
        self.nuisance_parameters = (*(p.name for p in sensor.nuisance_parameters), *effect_errors)
        """Names of the nuisance parameters of the sensor, then of the effects."""
        self._key = (
            identify(robot),
            type(sensor),
            (sensor.kind, type(sensor).__qualname__),
            frames,
            self.n_constants,
            self.nuisance_parameters,
            self.conditions,
            source_digest(type(sensor)),
        )

    @property
    def name(self) -> str:
        """Name that is unique among the patterns of the robot."""
        return repr(self._key[2:])

    @property
    def digests(self) -> tuple[str, ...]:
        """Digests of everything beside the name on which the expression depends.

        Sensors and effects of other packages may use any property of the robot. Then a digest of
        all its properties is among them.
        """
        effects = reading_effects(self.robot)
        kinds: list[type] = [type(self.sensor), *(type(e) for e in effects)]
        declared = repr([(type(e), self.robot.declared.effects.get(e.name)) for e in effects])
        foreign = any(source_digest(kind) for kind in kinds)
        of_robot = (fingerprint(self.robot),) if foreign else ()
        functions, names = robot_functions(self.robot), self.frames
        at_zero = [self.robot.frame_id(f) for f in names.at_zero]
        others = [self.robot.frame_id(f) for f in (*names.in_posture, *names.in_second)]
        frames = functions.fixed_frames([*at_zero, *others]), functions.fixed_passive(at_zero)
        return (functions.digest, *frames, declared, *of_robot)

    @cached_property
    def expressions(self) -> tuple[list[ca.SX], list[ca.SX]]:
        """Inputs and outputs of the compiled functions."""
        return _express(self)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ReadingPattern) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


@lru_cache(maxsize=256)
def _compile(pattern: ReadingPattern) -> CompiledReading:
    """Compile the functions of a pattern, or load them from the cache."""
    value_key, jacobian_key = (
        function_key(f"{name} {pattern.name}", *pattern.digests) for name in FUNCTIONS
    )
    build_value, build_jacobian = (partial(_build, pattern, name) for name in FUNCTIONS)
    jacobian = cached_function(jacobian_key, build_jacobian)
    rows = [name for name in jacobian.name_out() if name not in ("h", "by_twists")]
    return CompiledReading(
        value=BatchFunction(partial(cached_function, value_key, build_value), key=value_key),
        jacobian=BatchFunction(jacobian, matrices=rows, sparse=["by_twists"], key=jacobian_key),
        expression=jacobian,
        pattern=pattern,
        pairs=bool(pattern.frames.in_second),
        probe=_probe(pattern) if source_digest(type(pattern.sensor)) else None,
    )


def _build(pattern: ReadingPattern, name: str) -> ca.Function:
    """Build the function of a pattern with a name of FUNCTIONS."""
    inputs, outputs = pattern.expressions
    second = SECOND_INPUTS if pattern.frames.in_second else []
    if name == FUNCTIONS[0]:
        value = ca.densify(outputs[0])
        return ca.Function("h", inputs, [value], [*INPUTS, *second], ["h"], OPTIONS)
    variables = ("actuated", "passive", "twists", "zero", "nuisance", *second)
    labels = ["h", *(f"by_{variable}" for variable in variables)]
    return ca.Function("jacobian", inputs, outputs, [*INPUTS, *second], labels, OPTIONS)


def _express(pattern: ReadingPattern) -> tuple[list[ca.SX], list[ca.SX]]:
    """Inputs and outputs of the compiled functions, as in `CompiledReading.jacobian`.

    Each frame contributes fᵀ ∂p + mᵀ ∂φ to the derivatives, where p is its position and φ its
    rotation. Force f and moment m are the derivative of the sensor's expression (`_wrench`).
    """
    robot = pattern.robot
    here: RobotFunctions = robot_functions(robot)
    there = here.reference
    # machine in one posture and index of a frame, in the order of the poses of `_sensor_expression`
    trees = [
        *((here, robot.frame_id(f)) for f in pattern.frames.in_posture),
        *((there, robot.frame_id(f)) for f in pattern.frames.at_zero),
        *((here.second, robot.frame_id(f)) for f in pattern.frames.in_second),
    ]
    poses, symbols, h = _sensor_expression(pattern)
    constants, nuisance = symbols[-2:]
    wrenches = (v for pose in poses for v in _wrench(h, pose))
    local = ca.Function("sensor", symbols, [h, *wrenches, ca.jacobian(h, nuisance)])
    actual_poses = [machine.tree.frame_pose(frame) for machine, frame in trees]
    arguments = (s for pose in actual_poses for s in (pose.rotation, pose.position))
    values = local(*arguments, constants, nuisance)
    value, by_nuisance = values[0], values[-1]
    n_d, n_p = here.actuated.numel(), here.passive.numel()
    by_zero, by_twists = ca.SX(1, n_d), ca.SX(1, here.n_twists)
    by_coordinates = {m: (ca.SX(1, n_d), ca.SX(1, n_p)) for m, _ in trees if m is not there}
    for i, (machine, frame) in enumerate(trees):
        force, moment = values[1 + 2 * i], values[2 + 2 * i]
        joints, twists = machine.wrench_rows(frame, force.T, moment.T)
        actuated, passive = machine.split(joints)
        by_twists += twists
        if machine is there:
            by_zero += actuated
        else:
            by_actuated, by_passive = by_coordinates[machine]
            by_coordinates[machine] = by_actuated + actuated, by_passive + passive
    inputs = [*here.symbols, there.actuated, constants, nuisance]
    outputs = [value, *by_coordinates[here], by_twists, by_zero, by_nuisance]
    if pattern.frames.in_second:
        inputs += [here.second.actuated, here.second.passive]
        outputs += by_coordinates[here.second]
    return inputs, outputs


def _sensor_expression(pattern: ReadingPattern) -> tuple[list[Pose], list[ca.SX], ca.SX]:
    """Poses of a sensor's frames, all symbols, and the reading as an expression of them.

    The symbols are rotation and position of each pose, the constants and the nuisance parameters.
    """
    constants = ca.SX.sym("constants", pattern.n_constants)
    nuisance = ca.SX.sym("nuisance", len(pattern.nuisance_parameters))
    frames, at_zero, second = (
        [Pose(ca.SX.sym("rotation", 3, 3), ca.SX.sym("position", 3)) for _ in names]
        for names in (pattern.frames.in_posture, pattern.frames.at_zero, pattern.frames.in_second)
    )
    h = express_reading(
        pattern.robot, pattern.sensor, frames, at_zero, constants, nuisance, second=second
    )
    poses = [*frames, *at_zero, *second]
    symbols = [s for pose in poses for s in (pose.rotation, pose.position)]
    return poses, [*symbols, constants, nuisance], h


def express_reading(
    robot: Robot,
    sensor: Sensor,
    frames: Sequence[Pose],
    at_zero: Sequence[Pose],
    constants: ca.SX,
    nuisance: ca.SX,
    *,
    second: Sequence[Pose] = (),
) -> ca.SX:
    """Reading with the gauge zero at 0: the sensor's expression, modified by effects on readings.

    Args:
        robot: The robot.
        sensor: The sensor.
        frames: Poses of its frames in the posture.
        at_zero: Poses of its frames in the reference posture.
        constants: Constants of the sensor, then the conditions of the reading.
        nuisance: Nuisance parameters of the sensor, then those of the effects.
        second: Poses of its frames in the second posture of a pair.
    """
    names = reading_conditions(robot, sensor)
    sizes = [condition_size(robot, c) for c in names]
    n_constants = constants.numel() - sum(sizes)
    values = ca.vertsplit(constants, np.cumsum([0, n_constants, *sizes]).tolist())
    conditions = dict(zip(names, values[1:], strict=True))
    first = len(sensor.nuisance_parameters)
    seen: dict[str, ca.SX] = {c: conditions[c] for c in sensor_conditions(sensor)}
    view = View(frames, at_zero, values[0], nuisance[:first], seen, second)
    reading = require_expression(
        sensor.expression(view, robot), 1, f"{type(sensor).__qualname__}.expression"
    )
    for effect in reading_effects(robot):
        errors = {e.name: nuisance[first + i] for i, e in enumerate(effect.setup_errors)}
        needed: Symbols = {c: conditions[c] for c in effect.conditions}
        changed = effect.reading(reading, errors, needed)
        reading = require_expression(changed, 1, f"{type(effect).__qualname__}.reading")
        first += len(errors)
    return reading


def reading_conditions(robot: Robot, sensor: Sensor) -> tuple[Condition, ...]:
    """Conditions on which the reading of a sensor depends directly or through effects."""
    needed = {c for effect in reading_effects(robot) for c in effect.conditions}
    needed |= set(sensor_conditions(sensor))
    return tuple(c for c in NEUTRAL if c in needed)


def _probe(pattern: ReadingPattern) -> float:
    """Reading of a sensor at fixed arguments; equal expressions give equal readings."""
    _, symbols, h = _sensor_expression(pattern)
    rng = np.random.default_rng(0)
    values = [ca.DM(rng.uniform(0.1, 1.0, s.shape)) for s in symbols]
    return float(ca.Function("probe", symbols, [h])(*values))


def _wrench(h: ca.SX, pose: Pose) -> tuple[ca.SX, ca.SX]:
    """Derivative of a reading with respect to a pose, as force and moment in the world frame.

    f = ∂h/∂p, and m = ∂h/∂φ for a rotation φ of the frame about its origin.
    """
    force = ca.jacobian(h, pose.position).T
    by_rotation = ca.reshape(ca.jacobian(h, ca.vec(pose.rotation)), 3, 3)
    moment = [ca.dot(by_rotation, ca.skew(ca.SX(np.eye(3)[i])) @ pose.rotation) for i in range(3)]
    return force, ca.vertcat(*moment)
