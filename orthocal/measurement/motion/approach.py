"""Approach of a posture: the last motion of each drive before a reading.

An approach is written as in readings.csv, with a letter for each drive: p if its coordinate grows,
n if it falls, u if the direction is not stated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from orthocal.arrays import Array, Mask, Triple
from orthocal.effects.loading import robot_effects
from orthocal.kinematics.conditions import APPROACH as SIGN_OF_LETTER
from orthocal.kinematics.conditions import ARROWS
from orthocal.kinematics.continuation import Failures
from orthocal.kinematics.loop_closure import find_beyond_travel, nominal_closure
from orthocal.kinematics.workspace import find_below_bed
from orthocal.robot.model import Robot, require_tcp
from orthocal.sensors.protocol import PROBING_DISTANCE, probing_direction, tool_path
from orthocal.session.session import Posture, Reading, Session
from orthocal.units import DEG, LIMIT, MM, Unit

AS_ARROWS_SHOW = (
    "Approach each posture as its arrows show: in the last {} the displayed number of the joint "
    "grows (↑) or falls (↓)."
)
"""Rule for readings with stated approaches; {} is the length of the approach."""

FROM_ONE_SIDE = "Approach every posture from the same side: the last {} in one direction."
"""Rule for readings without stated approaches; {} is the length of the approach."""

USUAL_LENGTH = 2e-3
"""Usual length of the approach of a prismatic drive, [m]."""

USUAL_ANGLE = 0.5 * DEG
"""Usual angle of the approach of a revolute drive, [rad]."""

USUAL: dict[Unit, float] = {"m": USUAL_LENGTH, "rad": USUAL_ANGLE}
"""Both by the unit of the drive."""

SHORTEST_APPROACH = 0.2e-3
"""Least length of the approach of a prismatic drive: five times a usual backlash, [m]."""

STEP = 0.1e-3
"""Increment of the length of shortened approaches, [m]."""

LEAST_MOTION = 1e-6
"""Motion of a drive in an approach below which it has no direction, [m, rad]."""

APPROACH_PER_BACKLASH = 2.0
"""Least length of an approach, as a multiple of the limit of the backlash."""


def usual_approaches(robot: Robot) -> tuple[str, ...]:
    """Approaches of planned readings: all drives outwards, or all inwards.

    Empty if no effect of the robot depends on the approach.
    """
    if not any("approach" in e.conditions for e in robot_effects(robot)):
        return ()
    return tuple(letter * len(robot.drives) for letter in "pn")


def approach_share(session: Session) -> float:
    """Length of the approaches of a session, as a share of the usual length.

    The length is at most half the range of the gauges, so that the tip stays in contact. It is
    never too short to take up the backlash of a drive.
    """
    half_range = min((USUAL_LENGTH, *(g.half_range for g in session.gauges.values())))
    least = max(
        (
            APPROACH_PER_BACKLASH
            * LIMIT
            * session.robot.parameters[error.name].prior_std
            / USUAL[error.unit]
            for effect in robot_effects(session.robot)
            if "approach" in effect.conditions
            for error in effect.errors
            if error.unit in USUAL
        ),
        default=0.0,
    )
    length = max(math.floor(half_range / STEP + 1e-6) * STEP, SHORTEST_APPROACH)
    return max(min(length / USUAL_LENGTH, 1.0), least)


def approach_length(session: Session) -> str:
    """Length of the approaches of a session, as text with its unit."""
    share, units = approach_share(session), {d.unit for d in session.robot.drives}
    texts = {"m": f"{share * USUAL_LENGTH / MM:.3g} mm", "rad": f"{share * USUAL_ANGLE / DEG:.3g}°"}
    return " or ".join(text for unit, text in texts.items() if unit in units)


def approach_rule(session: Session) -> str:
    """AS_ARROWS_SHOW or FROM_ONE_SIDE; empty if the paths of sensors determine all approaches.

    The arrows of a sensor with a path are for operators who jog; a probe has only one way.
    """
    approaches = [
        r.approach
        for r in session.readings
        if probing_direction(sensor := session.setups[r.setup].sensor) is None
        and (r.approach is not None or tool_path(sensor) is None)
    ]
    if not approaches:
        return ""
    return AS_ARROWS_SHOW if any(approaches) else FROM_ONE_SIDE


def describe_approach(robot: Robot, approach: str) -> str:
    """Arrows of an approach: ↑ if the displayed number of a joint grows, ↓ if it falls.

    The arrow is · if the direction is not stated. If all arrows are equal, one is returned.
    """
    arrows = [
        ARROWS[SIGN_OF_LETTER[letter] * d.direction]
        for letter, d in zip(approach, robot.drives, strict=True)
    ]
    return arrows[0] if len(set(arrows)) == 1 else "".join(arrows)


def label_reading(robot: Robot, reading: Reading) -> str:
    """Setup, posture with the arrows of its approach, and the cycle from the second on."""
    if reading.approach is None:
        return reading.label_with_cycle
    arrows = describe_approach(robot, reading.approach)
    cycle = f", cycle {reading.cycle}" if reading.cycle > 1 else ""
    return f"{reading.setup} {reading.within_session(reading.posture)} {arrows}{cycle}"


def name_approach(motion: Array) -> str:
    """Letters of an approach from its motion; u for a drive that moves less than LEAST_MOTION.

    Args:
        motion: Motion of the drives, shape (n_drives,), [m, rad].
    """
    return "".join(
        "u" if abs(v) < LEAST_MOTION else "p" if v > 0.0 else "n" for v in motion.tolist()
    )


def approach_steps(robot: Robot, approach: str, other: str = "p", *, share: float = 1.0) -> Array:
    """Motion of each drive in an approach, shape (n_drives,), [m, rad].

    Args:
        robot: The robot.
        approach: A letter for each drive.
        other: Letter used in place of u.
        share: Length as a share of the usual length.
    """
    lengths = share * np.array([USUAL[d.unit] for d in robot.drives])
    return lengths * [SIGN_OF_LETTER[letter] or SIGN_OF_LETTER[other] for letter in approach]


def probing_starts(robot: Robot, points: Array, direction: Triple) -> Array:
    """Tool positions at which a probe begins to move towards the surface.

    Args:
        robot: The robot.
        points: Commanded tool coordinates of the postures, shape (n, n_coordinates), [m].
        direction: Direction of the probe, a unit vector.

    Returns:
        Shape (n, n_coordinates), [m].
    """
    along = np.array(direction)[list(require_tcp(robot).coordinates)]
    return np.asarray(points - PROBING_DISTANCE * along)


def possible_approaches(robot: Robot, postures: Mapping[str, Posture]) -> dict[str, frozenset[str]]:
    """Usual approaches, mapped to the names of the postures that allow them."""
    names, drives = np.array(list(postures)), np.array([p.drives for p in postures.values()])
    return {
        a: frozenset(names[can_approach(robot, drives, a)].tolist())
        for a in (usual_approaches(robot) if names.size else ())
    }


def fill_approach(robot: Robot, stated: str | None, other: str) -> str:
    """Stated approach with `other` in place of every u; `other` for all drives if unstated."""
    return (stated or "u" * len(robot.drives)).replace("u", other)


def can_approach(robot: Robot, drives: Array, approach: str) -> Mask:
    """Mask of the postures whose approach starts within reach, and above a bed, shape (n,).

    Args:
        robot: The robot.
        drives: Nominal drive coordinates of the postures, shape (n, n_drives), [m, rad].
        approach: A letter for each drive.
    """
    start = drives - approach_steps(robot, approach)
    beyond_travel = find_beyond_travel(robot, start)
    possible = np.ones(len(drives), dtype=np.bool_)
    possible[list(beyond_travel)] = False
    failures = Failures()
    inside = np.flatnonzero(possible)
    closure = nominal_closure(robot)
    passive = closure.close(start[inside], failures=failures)
    possible[inside[list(failures)]] = False
    if robot.bed is not None:
        tool = closure.tcp(start[inside], passive)[:, list(require_tcp(robot).coordinates)]
        possible[inside[list(find_below_bed(robot, tool))]] = False
    return possible
