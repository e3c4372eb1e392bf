"""Checks of the machine before a session, and rules for all of its readings."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np
import pinocchio as pin

from orthocal.assessment.wording import OFFSETS_IN_LINUXCNC, name_direction
from orthocal.effects.compensation import describe_trims, home_positions
from orthocal.kinematics.workspace import tool_at_zero
from orthocal.measurement.motion.approach import AS_ARROWS_SHOW, approach_length, describe_approach
from orthocal.measurement.motion.stops import SetupMotion
from orthocal.observation.conditions import needed_conditions
from orthocal.output.sheet.coordinates import joint_list, show_number
from orthocal.output.text.layout import true_minus
from orthocal.robot.model import PARALLEL_SINE, Robot, drive_keys, name_coordinates
from orthocal.sensors.protocol import PROBING_DISTANCE, has_dial, probing_direction, tool_path
from orthocal.session.session import Session
from orthocal.units import DRIVE_UNITS, LIMIT, MM, tidy

PROBING = (
    "A probe reaches each posture by the motion towards its surface. The programs stop "
    f"{PROBING_DISTANCE / MM:g} mm before each posture, and you probe."
)
"""Rule for the approach of postures that are probed."""

CHECKS_OF_PRINTER = [
    "Warm the printer up and home it. The firmware must have the settings that session.yaml states "
    "(`controller`). Do not change them until all readings are taken.",
    "Switch the mesh of the bed and other corrections of the height off (Klipper: BED_MESH_CLEAR, "
    "Marlin: M420 S0, RepRapFirmware: G29 S2), and set G90 and G21.",
    "Copy the lines of one reading after the other from the file of the setup (lines to send) into "
    "the console of the firmware. Nothing may be in the way of the first motion of a setup. Mount "
    "the gauge after it.",
    "Check each rod and each hinge for play that the dial shows, and remove it: the calibration "
    "cannot correct it.",
]
"""Checks of a printer."""

BY_EYE = 0.01
"""Angle between a leg and its axis that the eye does not see: half a degree, [rad]."""


def checks_of_machine(session: Session) -> list[str]:
    """Checks of a machine whose drives are joints of its controller."""
    robot = session.robot
    normal = (
        ""
        if is_corrected(session)
        else " A smaller difference is normal: the calibration finds it."
    )
    return [
        "Warm the machine up. Home it once. Do not home it again until all readings are taken. If "
        "you must home it again, repeat the interrupted setup.",
        f"Move the machine to its mechanical zero by eye, once: {_zero_by_eye(robot)}. The "
        f"controller must show about {joint_list(robot, robot.drive_zero)}. If a number differs by "
        f"more than {_largest_difference(robot)}, which its tolerance and your eye do not explain, "
        "the zero of the joint, a dimension or the direction of counting is wrong."
        f"{normal} Correct the zero in the controller (LinuxCNC: "
        f"HOME_OFFSET), or the others in {_dimension_files(robot)}. From now on, drive to the "
        "numbers printed here, not by eye. Travel of the joints: "
        f"{'; '.join(_travel(session))}.",
        f"Jog each joint a little {_growing(robot)}. Its number must {_count_outwards(robot)}.",
        _active_offsets(session),
        *([text] if (text := _compensation(session)) else []),
        *([text] if (text := _homes(session)) else []),
        "Check each rod and each hinge for play that the dial shows, and remove it: the "
        "calibration cannot correct it.",
    ]


def _largest_difference(robot: Robot) -> str:
    """Largest difference of a joint's number in the mechanical zero that errors explain.

    The tolerance of its offset, and what the eye does not see.
    """
    leg = max((leg.length for leg in robot.legs.values()), default=0.0)
    largest: dict[str, float] = {}
    for drive in robot.drives:
        unit, size = DRIVE_UNITS[drive.unit]
        by_eye = BY_EYE * (leg if drive.unit == "m" else 1.0)
        offset = robot.parameters[f"{drive.name}.offset"]
        limit = math.ceil((LIMIT * offset.prior_std + by_eye) / size)
        largest[unit] = max(largest.get(unit, 0), limit)
    return " or ".join(f"{limit} {unit}" for unit, limit in largest.items())


def _dimension_files(robot: Robot) -> str:
    """Files in which the user states dimensions and directions of counting."""
    if robot.folder is not None and (robot.folder / "machine.yaml").is_file():
        return "machine.yaml (`orthocal new DIRECTORY --again`)"
    return f"{robot.urdf.name} and {robot.yaml.name}"


def _active_offsets(session: Session) -> str:
    """The offsets that must be active in the controller."""
    drives = session.robot.drives
    if session.controller_offsets is None:
        keys = drive_keys("offsets", drives)
        return (
            "session.yaml does not state the offsets of the controller. Before the first "
            f"calibration write `controller: {{{keys}}}` into it, afterwards the offsets that you "
            "entered. They are not HOME_OFFSET."
        )
    if not is_corrected(session):
        return (
            "session.yaml states that the controller has no offsets of a calibration yet. If it "
            "has, state them there (`controller`). Do not change the controller's zeros until all "
            "readings are taken."
        )
    active = ", ".join(name_coordinates(drives, session.active_offsets, show_number))
    return (
        f"Check that these offsets of a calibration are entered, as session.yaml states: {active}. "
        f"{OFFSETS_IN_LINUXCNC} Do not change them until all readings are taken."
    )


def _compensation(session: Session) -> str:
    """The backlash that the controller must compensate; empty where that does not matter."""
    stated = describe_trims(session.robot, session.compensation)
    if stated:
        return (
            f"Check that the controller compensates backlash, as session.yaml states: {stated} "
            "(LinuxCNC: BACKLASH, COMP_FILE)."
        )
    if "approach" not in needed_conditions(session.robot):
        return ""
    if session.compensation:
        return (
            "Check that the controller compensates no backlash, as session.yaml states (LinuxCNC: "
            "BACKLASH is 0 or missing, no COMP_FILE)."
        )
    return (
        "session.yaml does not state which backlash the controller compensates (LinuxCNC: "
        "BACKLASH, COMP_FILE). Write it into session.yaml, 0 for none, in the order "
        f"{', '.join(d.name for d in session.robot.drives)}: controller: "
        f"{{{drive_keys('backlash', session.robot.drives)}}}."
    )


def _homes(session: Session) -> str:
    """HOME_OFFSET that the session states; empty if it does not."""
    homes = home_positions(session.compensation)
    if homes is None:
        return ""
    drives = session.robot.drives
    stated = ", ".join(
        f"{d.name} {true_minus(str(tidy(h / d.joint_size)))} {d.joint_unit}"
        for d, h in zip(drives, homes, strict=True)
    )
    keys = ", ".join(dict.fromkeys(f"home_offset_{d.joint_unit}" for d in drives))
    return (
        f"Check that HOME_OFFSET is as session.yaml states: {stated}. If not, state the present "
        f"numbers there ({keys}), and the offsets that they contain."
    )


def _zero_by_eye(robot: Robot) -> str:
    """The mechanical zero as the operator sees it."""
    if robot.tcp is None or all(leg.follows_slide for leg in robot.legs.values()):
        return "each leg parallel to its axis"
    at = zip(robot.tcp.coordinates, tool_at_zero(robot), strict=True)
    words = ", ".join(f"{'xyz'[c]} {round(v / MM, 3) + 0.0:g}" for c, v in at)
    return f"the tool at {words} mm"


def _growing(robot: Robot) -> str:
    """Direction in which the drives move as their coordinates grow."""
    legs = robot.legs.values()
    upwards = legs and all(leg.root_motion[2] > 1.0 - PARALLEL_SINE for leg in legs)
    slide = "upwards" if upwards else "outwards"
    ways = [slide if d.unit == "m" else _describe_rotation(robot, d.name) for d in robot.drives]
    if len(set(ways)) == 1:
        return ways[0]
    return ", ".join(f"{d.name} {way}" for d, way in zip(robot.drives, ways, strict=True))


def _describe_rotation(robot: Robot, drive: str) -> str:
    """Sense of rotation of a drive as its coordinate grows, in the reference posture."""
    model, data = robot.model, robot.model.createData()
    pin.computeJointJacobians(model, data, robot.configuration(robot.reference_posture))
    joint, world = model.getJointId(drive), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    jacobian = np.reshape(pin.getJointJacobian(model, data, joint, world), (6, model.nv))
    axis = jacobian[3:, model.joints[joint].idx_v]
    sense = "clockwise" if axis[np.abs(axis).argmax()] < 0.0 else "counterclockwise"
    seen_from = -axis if sense == "clockwise" else axis
    return f"{sense} as seen from {name_direction(seen_from)}"


def _count_outwards(robot: Robot) -> str:
    """Direction in which the joint numbers change if the coordinates of the drives grow."""
    verbs = {1: "grow", -1: "fall"}
    if len({d.direction for d in robot.drives}) == 1:
        return verbs[robot.drives[0].direction]
    return ", ".join(f"{verbs[d.direction]} for {d.name}" for d in robot.drives)


def reading_rules(session: Session, motions: Sequence[SetupMotion]) -> list[str]:
    """Rules for all readings; those about contact and bezel only where an indicator reads."""
    approach = _approach_rule(session, motions)
    empty = "If you could not take a reading, leave the box empty."
    if not any(has_dial(setup.sensor) for setup in session.setups.values()):
        return [approach, f"Write down what the instrument shows, with its sign. {empty}"]
    is_set = any(setup.zero == "free" for setup in session.setups.values())
    begin = "After you have set the gauge zero" if is_set else "During a setup"
    untouched = f"{begin}, do not touch the bezel of the gauge or what holds it."
    return [
        approach,
        _contact_rule(session, motions),
        f"{untouched} If the gauge was bumped, start that setup again.",
        f"Write down what the dial shows, with its sign, to the nearest step of its scale. {empty}",
    ]


def _contact_rule(session: Session, motions: Sequence[SetupMotion]) -> str:
    """Rule for the tip between the readings of a setup."""
    on_legs = all(s.sensor.place[0] == "leg" for s in session.setups.values())
    kept = "the tip on its rod" if on_legs else "each gauge in contact"
    rule = f"Keep {kept} from the first reading of a setup to the last"
    if not any(stop.lift for m in motions for stop in m.stops):
        return f"{rule}."
    return (
        f"{rule}, except during the motions that the setup names. Hold the plunger up during these "
        "motions, then lower it again. Do not touch the bezel of the gauge or what holds it."
    )


def _approach_rule(session: Session, motions: Sequence[SetupMotion]) -> str:
    """Rule for the last motion to a posture, in joint numbers."""
    robot, length = session.robot, approach_length(session)
    guided = [n for n, s in session.setups.items() if tool_path(s.sensor) is not None]
    probed = [n for n, s in session.setups.items() if probing_direction(s.sensor) is not None]
    if session.firmware is not None:
        by_hand = (
            f" The lines of a probe stop {PROBING_DISTANCE / MM:g} mm before the posture. Then "
            "move the probe towards the surface until it triggers."
        )
        return (
            "Send all lines of a reading in their order: the last one approaches the posture from "
            f"the right side.{by_hand * bool(probed)}"
        )
    motions = [m for m in motions if m.setup not in probed]
    others = [PROBING] if probed else []
    if guided and not any(r.approach for r in session.readings if r.setup in guided):
        motions = [m for m in motions if m.setup not in guided]
        others.append(
            "Around a fixed ball the programs move along arcs. If you jog, stay near the sphere."
        )
    if not motions:
        return " ".join(others)
    arrows = {describe_approach(robot, s.approach) for m in motions for s in m.stops}
    if len(arrows) > 1:
        rule = (
            f"{AS_ARROWS_SHOW.format(length)}{_order_of_arrows(robot, arrows)} The programs do "
            f"this. If you jog, first move each joint to a number {length} smaller (↑) or larger "
            "(↓) than that of the posture. Then move all joints to the posture, one after the "
            "other or together. If a joint went too far, begin the approach again."
        )
        return " ".join([rule, *others])
    (arrow,) = arrows
    rule = (
        f"Approach every posture from the same side: in the last {length} "
        f"{_describe_arrow(robot, arrow)}. The programs do this. If you jog, begin {length} "
        f"before the posture with every joint and move each joint to it in one motion."
    )
    return " ".join([rule, *others])


def _order_of_arrows(robot: Robot, arrows: Collection[str]) -> str:
    """Meaning of several arrows side by side."""
    if all(len(arrow) == 1 for arrow in arrows):
        return ""
    return f" Several arrows are in the order {', '.join(d.name for d in robot.drives)}."


def _describe_arrow(robot: Robot, arrow: str) -> str:
    """Direction of an approach in words."""
    verbs = {"↑": "grow", "↓": "fall"}
    if len(arrow) == 1:
        return f"the numbers of all joints {verbs[arrow]}"
    ways = zip(arrow, robot.drives, strict=True)
    return ", ".join(f"the number of {d.name} {verbs[a]}s" for a, d in ways)


def is_corrected(session: Session) -> bool:
    """True if the controller has offsets of a calibration."""
    return session.controller_offsets is not None and bool(np.any(session.controller_offsets))


def _travel(session: Session) -> list[str]:
    """Limits of the joints, with the active offsets."""
    texts = []
    for drive, active in zip(session.robot.drives, session.active_offsets, strict=True):
        unit, size = DRIVE_UNITS[drive.unit]
        low, high = ((v + drive.direction * active) / size for v in drive.joint_limits)
        if np.isfinite([low, high]).all():
            texts.append(f"{drive.name} {show_number(low, 1)} to {show_number(high, 1)} {unit}")
    return texts or ["no limits"]
