"""Export of a calibration for LinuxCNC: HOME_OFFSET, or a kinematics module."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

from orthocal.assessment.assess import assessment_of
from orthocal.assessment.controller_entries import find_entries, find_screws
from orthocal.calibration.calibration import Calibration
from orthocal.effects.compensation import compensates_alike, format_table, home_positions
from orthocal.errors import ExportError, ParameterError
from orthocal.export.linuxcnc.approximation import (
    LETTERS,
    Approximation,
    approximate,
    millimetres,
)
from orthocal.export.linuxcnc.c_source import write_component, write_core
from orthocal.export.linuxcnc.drive_compensation import (
    JointCompensation,
    compensate_with_module,
    compensate_with_offsets,
    find_active_compensation,
    find_compensation,
    round_backlash,
)
from orthocal.export.linuxcnc.entered_lines import require_same_homes
from orthocal.export.linuxcnc.home_offsets import JointHome, find_homes
from orthocal.export.linuxcnc.instructions import (
    write_home_lines,
    write_home_page,
    write_module_lines,
    write_module_page,
)
from orthocal.export.tool_tip import require_tip
from orthocal.units import MM, UM

DEFAULT_TOLERANCE = 0.1 * UM
"""Default tolerance of a kinematics module, [m]."""

OPTIONS = {
    "within": "--within",
    "tool": "--tool",
    "home_offsets": "--home-offset",
    "latched": "--latched",
    "joint_limits": "--ini",
    "axis_limits": "--ini",
    "half_side": "--half-side-mm",
    "payload": "--payload",
    "module": "--module or --offsets",
}
"""Fields of ExportOptions, to their options on the command line."""

MODULE_OPTIONS = ("within", "tool", "half_side", "payload")
"""Fields that are options of a kinematics module only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """Options of an export; None selects the default.

    Raises:
        ParameterError: If a number is out of range.
    """

    within: float | None = None
    """Largest error of a kinematics module at the tool, [m]."""
    tool: tuple[float, float, float] | None = None
    """Tip of the tool in the frame of the robot's tool centre point, [m]."""
    home_offsets: tuple[float, ...] | None = None
    """HOME_OFFSET of each joint during the measurement, [m, rad]."""
    latched: tuple[int, ...] | None = None
    """Sign of HOME_LATCH_VEL of each joint, 1 or -1; 0 if unknown, which counts as 1, the default.
    It has an effect with backlash only."""
    joint_limits: tuple[tuple[float, float], ...] | None = None
    """MIN_LIMIT and MAX_LIMIT of each joint during the measurement, [m, rad]. The travel of the
    robot limits them too."""
    axis_limits: tuple[tuple[float, float], ...] | None = None
    """MIN_LIMIT and MAX_LIMIT of the axes X, Y and Z during the measurement, [m]. The region of a
    kinematics module limits them too."""
    half_side: float | None = None
    """Half the side of the module's region around the mechanical zero, [m]."""
    payload: float | None = None
    """Mass on the tool, in addition to the platform, for which the module holds, [kg]; none by
    default."""
    module: bool | None = None
    """Whether to write a kinematics module or HOME_OFFSET; by default a module if the calibration
    identified more than offsets."""

    def __post_init__(self) -> None:
        for value, unit, symbol, option in (
            (self.within, UM, "µm", "--within"),
            (self.half_side, MM, "mm", "--half-side-mm"),
        ):
            if value is not None and not 0.0 < value < math.inf:
                raise ParameterError(
                    f"found {value / unit:g} {symbol}; expected more than 0", where=option
                )
        if self.tool is not None:
            require_tip(self.tool)
        if self.home_offsets is not None and not all(map(math.isfinite, self.home_offsets)):
            raise ParameterError("expected finite numbers", where="--home-offset")
        for sign in self.latched or ():
            if sign not in (-1, 0, 1):
                raise ParameterError(f"found {sign!r}; expected 1, 0 or -1", where="--latched")
        for low, high in (*(self.joint_limits or ()), *(self.axis_limits or ())):
            if not low < high:
                raise ParameterError(
                    f"found limits {low:g} and {high:g}; expected the lowest and the highest",
                    where="--ini",
                )

    @property
    def requested(self) -> tuple[str, ...]:
        """Names of the fields that are not None."""
        names = (f.name for f in fields(self))
        return tuple(n for n in names if getattr(self, n) is not None)


def export_linuxcnc(calibration: Calibration, options: ExportOptions) -> dict[str, str]:
    """Export a calibration for LinuxCNC.

    Returns:
        Texts of files by file name. HOME_OFFSET (if it is requested, or the calibration identified
        offsets only): README.md, joints.ini and a joint_N.comp for each drive with a periodic
        error. Module: README.md, kinematics.ini, orthocal_kins.c, orthocal_core.c, orthocal_core.h,
        and a joint_N_module.comp for each joint that had a table during the measurement.

    Raises:
        ExportError: If there is no offset to enter, or no module meets the tolerance.
        ParameterError: If an option of a module is stated for HOME_OFFSET, values are missing, or
            HOME_OFFSET differs from what the session states.
    """
    require_same_homes(calibration, options.home_offsets, where=OPTIONS["home_offsets"])
    before = find_active_compensation(calibration, options.latched)
    options = replace(options, home_offsets=options.home_offsets or home_positions(before))
    module = not calibration.only_offsets if options.module is None else options.module
    if module:
        compensation = find_compensation(calibration, options.latched)
        compensation = compensate_with_module(calibration, compensation, before)
        compensation = round_backlash(compensation, before)
        if not compensates_alike(compensation, before):
            _require_home_offsets(options, before)
    else:
        _refuse_module_options(options)
        if not find_entries(calibration):
            raise ExportError("the calibration identified no offset: there is nothing to enter")
        compensation = compensate_with_offsets(calibration, options.latched)
        _require_change(calibration, compensation, before)
        _require_home_offsets(options, [*before, *compensation])
    homes = find_homes(
        calibration, compensation, before, options.home_offsets, options.joint_limits
    )
    tables = {
        h.compensation.file_name(i): format_table(h.compensation, h.drive)
        for i, h in enumerate(homes)
        if h.compensation.table is not None and h.compensation.table is not h.was.table
    }
    if not module:
        own_limits = options.joint_limits is not None
        page = write_home_page(calibration, homes, own_limits=own_limits)
        lines = write_home_lines(calibration, homes)
        return {"README.md": page, "joints.ini": lines, **tables}
    return {**_write_module(calibration, homes, options), **tables}


def _write_module(
    calibration: Calibration, homes: Sequence[JointHome], options: ExportOptions
) -> dict[str, str]:
    """Texts of a kinematics module by file name.

    Raises:
        ExportError: If no module meets the tolerance.
        ParameterError: If the region of the module is beyond the limits of an axis.
    """
    approximation = approximate(
        calibration,
        within=DEFAULT_TOLERANCE if options.within is None else options.within,
        tool=(0.0, 0.0, 0.0) if options.tool is None else options.tool,
        half_side=options.half_side,
        payload=options.payload,
    )
    stated = options.axis_limits
    limits = _limit_axes(approximation, stated, calibration.session.controller_origin)
    own_limits = any(math.isfinite(limit) for axis in stated or () for limit in axis)
    return {
        "README.md": write_module_page(calibration, approximation, homes, own_limits=own_limits),
        "kinematics.ini": write_module_lines(approximation, homes, limits),
        **write_component(approximation),
        **write_core(calibration, approximation, homes),
    }


def _limit_axes(
    approximation: Approximation,
    stated: tuple[tuple[float, float], ...] | None,
    origin: tuple[float, float, float],
) -> dict[int, tuple[float, float]]:
    """Limits that the region of a module and the stated limits have in common, [m].

    Args:
        approximation: The module.
        stated: MIN_LIMIT and MAX_LIMIT of X, Y and Z with nominal kinematics, [m].
        origin: Displayed coordinates of the origin of the world with nominal kinematics, [m]; with
            the module they are 0.

    Returns:
        Limits by coordinate: 0 for X, and so on.

    Raises:
        ParameterError: If they have nothing in common; names the axis.
    """
    inverse, limits = approximation.inverse, {}
    for k, low, high in zip(
        approximation.coordinates, inverse.lower.tolist(), inverse.upper.tolist(), strict=True
    ):
        axis = (-math.inf, math.inf) if stated is None else stated[k]
        limits[k] = max(low, axis[0] - origin[k]), min(high, axis[1] - origin[k])
        if not limits[k][0] < limits[k][1]:
            raise ParameterError(
                f"[AXIS_{LETTERS[k]}] has the limits {millimetres(axis)} mm; expected a part of "
                f"the region of the module, {millimetres([low + origin[k], high + origin[k]])} mm",
                where="--ini",
            )
    return limits


def _refuse_module_options(options: ExportOptions) -> None:
    """Refuse options of a module for HOME_OFFSET.

    Raises:
        ParameterError: If there is such an option; names the first one.
    """
    unused = [OPTIONS[name] for name in options.requested if name in MODULE_OPTIONS]
    if unused:
        reason = (
            "the calibration identified offsets only, which are entered as HOME_OFFSET; "
            "--module requests a module with nominal legs and axes"
            if options.module is None
            else "--offsets requests HOME_OFFSET"
        )
        raise ParameterError(f"is an option of a kinematics module, and {reason}", where=unused[0])


def _require_change(
    calibration: Calibration,
    compensation: Sequence[JointCompensation],
    before: Sequence[JointCompensation],
) -> None:
    """Refuse an export that changes nothing.

    Raises:
        ExportError: If neither the offsets nor the compensation change.
    """
    assessment = assessment_of(calibration)
    if assessment.keeps_offsets and compensates_alike(compensation, before):
        more = "" if calibration.only_offsets else " --module writes a correction of all errors."
        raise ExportError(f"{assessment.decision.words} HOME_OFFSET does not change.{more}")


def _require_home_offsets(options: ExportOptions, joints: Sequence[JointCompensation]) -> None:
    """Refuse tables of trims without HOME_OFFSET, which determines the trim at the home switch.

    Raises:
        ParameterError: If there is a table and no HOME_OFFSET.
    """
    if options.home_offsets is None and any(joint.table is not None for joint in joints):
        raise ParameterError(
            "is missing; the trim of a table at the home switch depends on it",
            where="--home-offset",
        )


def find_assumed_latching(calibration: Calibration, options: ExportOptions) -> tuple[int, ...]:
    """Joints for which the export depends on a sign of HOME_LATCH_VEL that is not stated."""
    old, new = (
        f(calibration, options.latched) for f in (find_active_compensation, find_compensation)
    )
    screws = {e.drive for e in find_screws(calibration) if e.change.any()}
    return tuple(
        i
        for i, (drive, was, joint) in enumerate(
            zip(calibration.robot.drives, old, new, strict=True)
        )
        if not joint.latched and (drive.name in screws or not compensates_alike([was], [joint]))
    )
