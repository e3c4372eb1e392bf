"""Comparison of a controller's lines with those that an export of a calibration would write."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.assessment.wording import joined
from orthocal.calibration.calibration import Calibration
from orthocal.effects.compensation import (
    Compensation,
    JointTrim,
    compensates_alike,
    home_positions,
)
from orthocal.errors import ExportError, ParameterError
from orthocal.export.linuxcnc.drive_compensation import (
    compensate_with_offsets,
    find_active_compensation,
)
from orthocal.export.linuxcnc.home_offsets import find_homes
from orthocal.robot.model import Drive, Robot, drive_keys

SAME_OFFSET = 0.6e-6
"""Largest difference between equal offsets, [m, rad]: they are printed to 1 µm."""


def find_unstated_tables(calibration: Calibration, stated: Compensation) -> tuple[str, ...]:
    """Drives whose table (COMP_FILE) of an export differs from a stated compensation.

    Args:
        calibration: The calibration.
        stated: Compensation that a new session states; empty for none.
    """
    return tuple(
        drive.name
        for drive, joint, trim in _pair_trims(calibration, stated)
        if joint.table is not None and not compensates_alike([joint], [trim])
    )


def states_offsets(offsets: Sequence[float] | None, entered: Array) -> bool:
    """True if the comment of exported lines states the offsets of a session.

    Args:
        offsets: Offsets of the comment, [m, rad]; None without it.
        entered: Offsets of the session, shape (n_drives,), [m, rad].
    """
    return offsets is not None and bool(np.abs(np.array(offsets) - entered).max() <= SAME_OFFSET)


def describe_other_lines(
    calibration: Calibration,
    compensation: Compensation,
    offsets: Sequence[float] | None,
    *,
    latched: Sequence[int] | None = None,
    entered: Array,
    file: str,
) -> str:
    """Differences between the lines of a controller and those that an export would write.

    Args:
        calibration: The calibration, with the adjustments since then.
        compensation: BACKLASH, COMP_FILE and HOME_OFFSET of the controller.
        offsets: Offsets that a comment of exported lines states, [m, rad]; None without it.
        latched: Sign of HOME_LATCH_VEL of each joint; 0 or None if unknown.
        entered: Offsets that the new session states, shape (n_drives,), [m, rad].
        file: Name of the file with the lines.

    Returns:
        Sentences; "" without a difference.
    """
    sentences = []
    if offsets is not None and not states_offsets(offsets, entered):
        values = joined(
            [
                f"{d.name} {_show(d, v, e, '+')} instead of {_show(d, e, v, '+')}"
                for d, v, e in zip(calibration.robot.drives, offsets, entered.tolist(), strict=True)
                if abs(v - e) > SAME_OFFSET
            ]
        )
        sentences.append(
            f"{file} has HOME_OFFSET for other offsets of the drives than the new session: "
            f"{values}. Enter lines with the offsets of the new session."
        )
    pairs = _pair_trims(calibration, compensation)
    other_trims = compare_joints(pairs)
    homes = expected_homes(calibration, compensation, latched)
    if not sentences and (other := compare_homes(calibration.robot, homes, compensation)):
        to_enter = tuple(trim for _, trim, _ in pairs)
        homes = expected_homes(calibration, to_enter, latched) if other_trims else None
        if homes is not None and not compare_homes(calibration.robot, homes, compensation):
            sentences.append(
                f"{file} has the HOME_OFFSET that this calibration says to enter, but "
                f"{other_trims}. These lines belong together: enter them all, and run `orthocal "
                "again --force` once more."
            )
        else:
            sentences.append(
                f"{file} does not have the offsets that the new session states. With its BACKLASH "
                f"and its sign of HOME_LATCH_VEL, {other}. Enter lines with these offsets, and run "
                "`orthocal again --force` once more."
            )
    elif other_trims:
        sentences.append(
            f"{file} differs from the lines that this calibration says to enter: "
            f"{other_trims}. The new session states what the file contains: measure with "
            "these lines, or enter the others and run `orthocal again --force` once more."
        )
    return "\n".join(sentences)


def compare_joints(joints: Iterable[tuple[Drive, JointTrim, JointTrim]]) -> str:
    """Differences between the expected and the present compensation of joints; "" without any.

    Args:
        joints: Drive, expected and present compensation of each joint.
    """
    return joined(
        [
            f"JOINT_{i} has {_describe(drive, trim, joint)} instead of "
            f"{_describe(drive, joint, trim)}"
            for i, (drive, joint, trim) in enumerate(joints)
            if not compensates_alike([joint], [trim])
        ]
    )


def compare_homes(robot: Robot, expected: ArrayLike | None, joints: Sequence[JointTrim]) -> str:
    """Differences between the expected and the present HOME_OFFSET of joints; "" without any.

    Args:
        robot: The robot.
        expected: HOME_OFFSET of each joint, shape (n_drives,), or all possible ones, the likely one
            first, shape (n_drives, n), [m, rad]; None if they are unknown.
        joints: Present HOME_OFFSET of each joint; those that are not stated do not differ.
    """
    if expected is None:
        return ""
    possible = np.reshape(np.asarray(expected, dtype=np.float64), (len(robot.drives), -1))
    return joined(
        [
            f"JOINT_{i} has HOME_OFFSET {drive.show(trim.home, '.4f')} instead of "
            f"{_either(drive, homes)}"
            for i, (drive, homes, trim) in enumerate(
                zip(robot.drives, possible, joints, strict=False)
            )
            if trim.home is not None and np.abs(homes - trim.home).min() > SAME_OFFSET
        ]
    )


def require_same_homes(
    calibration: Calibration, present: Sequence[float] | None, *, where: str
) -> None:
    """Refuse other HOME_OFFSET than during the measurement: offsets would be entered twice.

    Args:
        calibration: The calibration.
        present: Present HOME_OFFSET of each joint, [m, rad]; None if unknown.
        where: File or option, for messages.

    Raises:
        ParameterError: If it differs.
    """
    homes = home_positions(calibration.session.compensation)
    joints = [JointTrim(home=home) for home in present or ()]
    if differences := compare_homes(calibration.robot, homes, joints):
        keys = drive_keys("home_offset", calibration.robot.drives, homes)
        raise ParameterError(
            f"has other HOME_OFFSET than the session states (controller: {{{keys}}}): "
            f"{differences}. Expected is HOME_OFFSET during the measurement, before the offsets of "
            "this calibration were entered. If the session states it wrongly, correct it there "
            "and calibrate again",
            where=where,
        )


def _either(drive: Drive, homes: Array) -> str:
    """One position, or those of both directions of latching if they differ, shape (n,)."""
    shown = dict.fromkeys(drive.show(home, ".4f") for home in homes.tolist())
    return ", or ".join(shown) + " with a negative HOME_LATCH_VEL" * (len(shown) > 1)


def expected_homes(
    calibration: Calibration, stated: Compensation, latched: Sequence[int] | None
) -> Array | None:
    """Possible HOME_OFFSET of each joint with the offsets to enter and a stated compensation.

    It is one number if the direction of latching is known or does not matter, otherwise one for
    each direction.

    Args:
        calibration: The calibration, with the adjustments since then.
        stated: Compensation of the controller.
        latched: Sign of HOME_LATCH_VEL of each joint; 0 or None if unknown.

    Returns:
        Shape (n_drives, 1) or (n_drives, 2), [m, rad]; None if the calibrated session does not
        state HOME_OFFSET.
    """
    before = find_active_compensation(calibration, latched)
    old = home_positions(before)
    if old is None:
        return None
    now = find_active_compensation(calibration, latched, stated)
    changes = [
        [h.change, h.change if h.compensation.latched else h.opposite]
        for h in find_homes(calibration, now, before, old)
    ]
    homes = np.array(old)[:, None] + np.array(changes)
    same = np.ptp(homes, axis=1).max(initial=0.0) <= SAME_OFFSET
    return np.asarray(homes[:, :1] if same else homes)


def states_homes(
    calibration: Calibration, stated: Compensation, latched: Sequence[int] | None
) -> bool | None:
    """True if a controller has HOME_OFFSET for the offsets to enter; None if that is unknown.

    Args:
        calibration: The calibration, with the adjustments since then.
        stated: Joints of the controller.
        latched: Sign of HOME_LATCH_VEL of each joint; 0 or None if unknown.
    """
    expected = expected_homes(calibration, stated, latched)
    if expected is None or home_positions(stated) is None:
        return None
    return not compare_homes(calibration.robot, expected, stated)


def _pair_trims(
    calibration: Calibration, stated: Compensation
) -> list[tuple[Drive, JointTrim, JointTrim]]:
    """Drives with the trim that an export writes and a stated trim; empty if it writes none."""
    drives = calibration.robot.drives
    try:
        expected = compensate_with_offsets(calibration)
    except ExportError:
        return []
    trims = stated or (JointTrim(),) * len(drives)
    return list(zip(drives, expected, trims, strict=True))


def _describe(drive: Drive, trim: JointTrim, other: JointTrim) -> str:
    """Compensation of a joint in a few words, beside another one."""
    if trim.table is not None:
        return "another table" if other.table is not None else "a table (COMP_FILE)"
    if not trim.backlash:
        return "BACKLASH 0 or none"
    return f"BACKLASH {_show(drive, trim.backlash, other.backlash)}"


def _show(drive: Drive, value: float, other: float, sign: str = "") -> str:
    """Value with its unit, with more decimals if three do not distinguish it from another one."""
    alike = drive.show(value) == drive.show(other)
    return drive.show(value, f"{sign}{'.7f' if alike else '.3f'}")
