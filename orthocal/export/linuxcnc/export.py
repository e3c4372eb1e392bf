"""A calibration for LinuxCNC: what to type, and what to build where typing is not enough."""

from __future__ import annotations

from orthocal.assessment.controller_entries import find_entries
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ExportError, ParameterError
from orthocal.export.linuxcnc.approximation import approximate
from orthocal.export.linuxcnc.c_source import write_component, write_core
from orthocal.export.linuxcnc.home_offsets import find_homes
from orthocal.export.linuxcnc.ini import write_home_lines, write_module_lines
from orthocal.export.linuxcnc.page import write_home_page, write_module_page
from orthocal.export.options import WITHIN, ExportOptions


def export_linuxcnc(calibration: Calibration, options: ExportOptions) -> dict[str, str]:
    """HOME_OFFSET where offsets alone were identified, or asked for; else a kinematics module.

    Returns:
        README.md and joints.ini; or README.md, kinematics.ini, orthocal_kins.c, orthocal_core.c and
        orthocal_core.h.

    Raises:
        ExportError: If there is nothing to enter, or no module keeps to what was asked.
        ParameterError: If an option is of a module and none is made, or values are missing.
    """
    homes = find_homes(calibration, old=options.home_offsets)
    module = not calibration.only_offsets if options.module is None else options.module
    if not module:
        of_module = {"within": "--within", "tool": "--tool", "half_side": "--half-side-mm"}
        given = [of_module[name] for name in options.asked if name in of_module]
        if given:
            why = (
                "offsets alone were identified: they are entered as HOME_OFFSET; give --module for "
                "a module with nominal legs and axes"
                if options.module is None
                else "--offsets asks for HOME_OFFSET"
            )
            raise ParameterError(f"is of a kinematics module, and {why}", where=given[0])
        if not find_entries(calibration):
            raise ExportError("no offset was identified: there is nothing to enter")
        return {
            "README.md": write_home_page(calibration, homes),
            "joints.ini": write_home_lines(homes),
        }
    found = approximate(
        calibration,
        within=WITHIN if options.within is None else options.within,
        tool=(0.0, 0.0, 0.0) if options.tool is None else options.tool,
        half_side=options.half_side,
    )
    return {
        "README.md": write_module_page(calibration, found, homes),
        "kinematics.ini": write_module_lines(found, homes),
        **write_component(found),
        **write_core(calibration, found),
    }
