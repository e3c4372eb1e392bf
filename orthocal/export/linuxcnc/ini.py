"""Lines for LinuxCNC's INI: joints that begin to count elsewhere, or a kinematics module."""

from __future__ import annotations

import math
from collections.abc import Sequence

from orthocal.export.linuxcnc.approximation import Approximation
from orthocal.export.linuxcnc.home_offsets import JointHome
from orthocal.export.linuxcnc.words import LETTERS, as_millimetres, plain


def write_home_lines(homes: Sequence[JointHome]) -> str:
    """HOME_OFFSET, MIN_LIMIT and MAX_LIMIT of each joint, where they are known."""
    lines = ["# HOME_OFFSET and soft limits for identified offsets; all else stays as it is."]
    for i, home in enumerate(homes):
        way = "up" if home.direction > 0 else "down"
        lines += [
            "",
            f"[JOINT_{i}]",
            f"# {plain(home.drive)}, counts {way}: {home.show(home.change, sign=True)} "
            f"{home.joint_unit}",
            _line("HOME_OFFSET", home, home.new),
            *_limit_lines(home, home.new_limits),
        ]
    return "\n".join(lines) + "\n"


def write_module_lines(found: Approximation, homes: Sequence[JointHome]) -> str:
    """The kinematics module, the region as limits of the axes, and joints as while measuring."""
    n = len(homes)
    letters = "".join(LETTERS[k] for k in sorted(found.coordinates))
    lines = [
        "# The calibrated kinematics module; HOME_OFFSET stays as it was while measuring.",
        "",
        "[KINS]",
        "KINEMATICS = orthocal_kins",
        f"JOINTS = {n}",
        "",
        "[TRAJ]",
        f"COORDINATES = {letters}",
        "LINEAR_UNITS = mm",
        "ANGULAR_UNITS = degree",
    ]
    for k, low, high in zip(found.coordinates, found.lower, found.upper, strict=True):
        lines += [
            "",
            f"[AXIS_{LETTERS[k]}]",
            f"MIN_LIMIT = {as_millimetres([low])}",
            f"MAX_LIMIT = {as_millimetres([high])}",
        ]
    for i, home in enumerate(homes):
        kind = "LINEAR" if home.unit == "m" else "ANGULAR"
        lines += ["", f"[JOINT_{i}]", f"# {plain(home.drive)}", f"TYPE = {kind}"]
        if home.old is not None:
            lines.append(f"HOME_OFFSET = {home.show(home.old)}")
        if home.limits is not None:
            lines += _limit_lines(home, home.limits)
    return "\n".join(lines) + "\n"


def _limit_lines(home: JointHome, limits: tuple[float, float] | None) -> list[str]:
    names = ("MIN_LIMIT", "MAX_LIMIT")
    values = (None, None) if limits is None else limits
    return [
        _line(name, home, value)
        for name, value in zip(names, values, strict=True)
        if value is None or math.isfinite(value)
    ]


def _line(name: str, home: JointHome, value: float | None) -> str:
    if value is None:
        return f"# {name} = what it is now {home.show(home.change, sign=True)}"
    return f"{name} = {home.show(value)}"
