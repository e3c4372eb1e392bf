"""Instructions for a LinuxCNC machine: lines of its INI file, and README.md."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from orthocal.assessment.assess import assessment_of
from orthocal.assessment.controller_entries import (
    ENTERED_DECIMALS,
    expanded_uncertainty,
    find_backlash,
    find_entries,
    find_screws,
    offsets_to_enter,
)
from orthocal.assessment.wording import joined, tool_mm
from orthocal.calibration.calibration import Calibration
from orthocal.export.linuxcnc.approximation import (
    BEYOND_FACE,
    HEAVIER_PAYLOAD,
    LETTERS,
    LONGER_TOOL,
    Approximation,
    millimetres,
    rounded_up,
)
from orthocal.export.linuxcnc.c_source import fill_template
from orthocal.export.linuxcnc.drive_compensation import NEGLIGIBLE, JointCompensation
from orthocal.export.linuxcnc.home_offsets import JointHome
from orthocal.export.linuxcnc.nominal_form import Tangent
from orthocal.robot.model import drive_keys
from orthocal.text import comment_safe
from orthocal.units import MM, UM

UNSTATED = "those that were active, plus these changes"
"""Offsets of the drives if the session does not state the active ones."""

SMALLEST_ERROR = 1e-9
"""Smallest error that README.md states, [m]."""


def write_home_lines(calibration: Calibration, homes: Sequence[JointHome]) -> str:
    """INI lines with HOME_OFFSET, MIN_LIMIT and MAX_LIMIT of each joint."""
    lines = ["# HOME_OFFSET and soft limits with the calibrated offsets. Keep all other lines."]
    if calibration.session.controller_offsets is not None:  # otherwise only changes are known
        lines += [
            "# With these lines a session states the offsets of the drives:",
            f"# {_describe_offsets(calibration)}",
        ]
    lines += _latching_lines(homes)
    for i, home in enumerate(homes):
        lines += [
            "",
            f"[JOINT_{i}]",
            f"# {comment_safe(home.drive.name)}, counts {home.counting}: "
            f"{home.show(home.change, sign=True)} {home.drive.joint_unit}",
            *_home_lines(home),
            *_opposite_lines(home),
            *_compensation_lines(i, home),
        ]
    return "\n".join(lines) + "\n"


def _describe_offsets(calibration: Calibration) -> str:
    """Key of session.yaml with the offsets to enter."""
    offsets = offsets_to_enter(calibration).tolist()
    return f"controller: {{{drive_keys('offsets', calibration.robot.drives, offsets)}}}"


def _latching_lines(homes: Sequence[JointHome]) -> list[str]:
    """Comment with the signs of HOME_LATCH_VEL for the next commands; none if one is unknown."""
    signs = [_latching_sign(home) for home in homes]
    known = all(home.compensation.latched for home in homes)
    return [f"# signs of HOME_LATCH_VEL: [{', '.join(signs)}]"] if known else []


def _latching_sign(home: JointHome) -> str:
    """Sign of HOME_LATCH_VEL, known or assumed."""
    return "+" if home.compensation.latches_upwards else "-"


def write_module_lines(
    approximation: Approximation,
    homes: Sequence[JointHome],
    limits: Mapping[int, tuple[float, float]],
) -> str:
    """INI lines for the kinematics module: limits of the axes, unchanged joints.

    Args:
        approximation: The module.
        homes: The joints.
        limits: Limits by coordinate, 0 for X, and so on, [m].
    """
    lines = [
        "# Calibrated kinematics module. HOME_OFFSET remains that of the measurement.",
        *_latching_lines(homes),
        "",
        "[KINS]",
        "KINEMATICS = orthocal_kins",
        f"JOINTS = {len(homes)}",
        "",
        "[TRAJ]",
        f"COORDINATES = {''.join(LETTERS[k] for k in sorted(limits))}",
        "LINEAR_UNITS = mm",
        "ANGULAR_UNITS = degree",
    ]
    for k, (low, high) in limits.items():
        lines += [
            "",
            f"[AXIS_{LETTERS[k]}]",
            f"MIN_LIMIT = {millimetres([low])}",
            f"MAX_LIMIT = {millimetres([high])}",
        ]
    for i, home in enumerate(homes):
        kind = "LINEAR" if home.drive.unit == "m" else "ANGULAR"
        lines += ["", f"[JOINT_{i}]", f"# {comment_safe(home.drive.name)}", f"TYPE = {kind}"]
        if home.old is not None:
            lines.append(f"HOME_OFFSET = {home.show(home.old)}")
        if home.limits is not None:
            lines += _limit_lines(home, home.limits)
        lines += _compensation_lines(i, home)
    return "\n".join(lines) + "\n"


def _home_lines(home: JointHome) -> list[str]:
    """HOME_OFFSET, MIN_LIMIT and MAX_LIMIT of a joint."""
    return [
        _line("HOME_OFFSET", home, home.new, home.change),
        *_limit_lines(home, None if home.new is None else home.new_limits),
    ]


def _opposite_lines(home: JointHome) -> list[str]:
    """Comments with the lines that differ for the other sign of an unknown HOME_LATCH_VEL."""
    if not _assumes_latching(home):
        return []
    lines, opposite = _home_lines(home), _home_lines(replace(home, change=home.opposite))
    return [
        f"# if HOME_LATCH_VEL of this joint is negative: {line.removeprefix('# ')}"
        for line in opposite
        if line not in lines
    ]


def _assumes_latching(home: JointHome) -> bool:
    """True if the printed HOME_OFFSET depends on an unknown direction of latching."""
    return not home.compensation.latched and home.show(home.change) != home.show(home.opposite)


def _limit_lines(home: JointHome, limits: tuple[float, float] | None) -> list[str]:
    """MIN_LIMIT and MAX_LIMIT of a joint; a change each if the limits are None."""
    names = ("MIN_LIMIT", "MAX_LIMIT")
    values = (None, None) if limits is None else limits
    return [
        _line(name, home, value, home.limit_change)
        for name, value in zip(names, values, strict=True)
        if value is None or math.isfinite(value)
    ]


def _line(name: str, home: JointHome, value: float | None, change: float) -> str:
    """INI line with a value, or a comment with its change if the value is None."""
    if value is None:
        return f"# {name} = present value {home.show(change, sign=True)}"
    return f"{name} = {home.show(value)}"


def _compensation_lines(joint: int, home: JointHome) -> list[str]:
    """BACKLASH of a joint, or COMP_FILE, which replaces it."""
    if home.compensation.table is not None:
        if home.compensation.table is home.was.table:
            return []
        return [f"COMP_FILE = {home.compensation.file_name(joint)}", "COMP_FILE_TYPE = 1"]
    lines = ["# delete COMP_FILE and COMP_FILE_TYPE"] if home.was.table is not None else []
    backlash = home.compensation.backlash
    if backlash or home.was.backlash:
        lines.append(f"BACKLASH = {home.show(backlash)}")
    return lines


_IN_MODULE = (
    "The module contains half\nof the change of the backlash, which depends on the sign of "
    "HOME_LATCH_VEL; HOME_OFFSET does not change"
)
_IN_HOME_OFFSET = (
    "Half of the change of\nthe backlash is subtracted from HOME_OFFSET if HOME_LATCH_VEL is "
    "positive, and added if it is negative"
)
_MOVED_TABLES = (
    "**Tables:** copy the files `joint_*.comp` beside your INI file. Tables that the calibration\n"
    "does not change move with HOME_OFFSET, so that they still match the screws."
)


def describe_compensation(homes: Sequence[JointHome], *, module: bool = False) -> str:
    """Paragraph about BACKLASH and COMP_FILE; empty without them.

    Args:
        homes: Homes of the joints.
        module: Whether a module displaces the joints, instead of HOME_OFFSET.
    """
    paragraphs = []
    changes = any(h.compensation_changes for h in homes)
    listed = ", ".join(
        f"JOINT_{i} {h.show(h.compensation.backlash)} {h.drive.joint_unit}"
        + f" (latched in {_latching_sign(h)} direction)" * changes
        for i, h in enumerate(homes)
        if h.compensation.backlash
    )
    if listed and not changes:
        paragraphs.append(
            f"**Backlash:** {listed}, as during the measurement. Keep these lines BACKLASH."
        )
    elif listed:
        paragraphs.append(
            f"**Backlash:** {listed}.\nLinuxCNC compensates it by the lines BACKLASH, or by the "
            f"columns of COMP_FILE. {_IN_MODULE if module else _IN_HOME_OFFSET}. The numbers\n"
            "are for the signs stated here. If one differs in your INI file, do not change it: "
            "export again with `--ini`."
        )
        assumed = [f"JOINT_{i}" for i, home in enumerate(homes) if _assumes_latching(home)]
        if assumed:
            paragraphs[-1] += (
                f"\nThe sign + of {joined(assumed)} is assumed, because neither an INI file "
                "(`--ini FILE`) nor `--latched` states it."
            )
    with_table = [h for h in homes if h.compensation.table is not None]
    written = [h for h in with_table if h.compensation.table is not h.was.table]
    tables = [h.compensation for h in written if h.compensation_changes]
    if any(c.with_module for c in tables):
        paragraphs.append(
            "**Tables:** copy the files `joint_*_module.comp` beside your INI file. They replace\n"
            "the tables of the measurement. The periodic errors of the screws are in the module;\n"
            "the tables contain the part that depends on the side." + _between_entries(tables)
        )
    elif tables:
        paragraphs.append(
            "**Periodic error of the screws:** copy the files `joint_*.comp` beside your INI file."
            f"{_between_entries(tables)} A kinematics module\n(`--module`) corrects it exactly."
        )
    if len(tables) < len(written):
        paragraphs.append(_MOVED_TABLES)
    error = max((h.compensation.error for h in homes if h.compensation.table is None), default=0.0)
    if error > NEGLIGIBLE:
        paragraphs.append(
            "**Periodic error of the screws:** the module corrects it for the middle of both\n"
            f"sides. On one side the error is up to {rounded_up(error / UM)} µm, because backlash "
            "shifts its phase."
        )
    return "".join(f"\n{paragraph}\n" for paragraph in paragraphs)


def _between_entries(tables: Sequence[JointCompensation]) -> str:
    """Sentence about the error of tables between their entries."""
    error = max(max(table.error for table in tables), SMALLEST_ERROR)
    return f"\nBetween the entries of a table the error is up to {rounded_up(error / UM)} µm."


def _describe_conditions(approximation: Approximation) -> str:
    """Paragraphs about temperature and payload; empty if the machine depends on neither."""
    paragraphs, change = [], approximation.inverse.thermal
    if change is not None and approximation.error_without_thermometer is not None:
        values = {
            "reference": f"{change.reference:g}",
            "lowest": f"{change.lowest:g}",
            "highest": f"{change.highest:g}",
            "unheated": rounded_up(approximation.error_without_thermometer / MM),
        }
        paragraphs.append(fill_template("temperature.md", values))
    if approximation.payload is not None and approximation.error_of_heavier_payload is not None:
        values = {
            "payload": f"{approximation.payload:g}",
            "more": f"{HEAVIER_PAYLOAD:g}",
            "error": rounded_up(max(approximation.error_of_heavier_payload, SMALLEST_ERROR) / UM),
        }
        paragraphs.append(fill_template("payload.md", values))
    return "".join(f"\n{paragraph}" for paragraph in paragraphs)


def _describe_unchanged(calibration: Calibration, *, module: bool = False) -> str:
    """Paragraphs about drives whose compensation does not change; empty without any.

    Args:
        calibration: The calibration.
        module: Whether a module corrects the periodic errors of the screws.
    """
    backlash = [e for e in find_backlash(calibration) if not e.change]
    screws = [e for e in find_screws(calibration) if not (module or e.change.any())]
    uncertainties = {
        "Backlash": [(e.drive, expanded_uncertainty(calibration, e)) for e in backlash],
        "Periodic error of the screw": [(e.drive, e.uncertainty) for e in screws],
    }
    joints, paragraphs = {d.name: (i, d) for i, d in enumerate(calibration.robot.drives)}, ""
    for quantity, of_drives in uncertainties.items():
        numbered = [(*joints[name], half) for name, half in of_drives]
        listed = ", ".join(f"JOINT_{i} (±{drive.show(half)})" for i, drive, half in numbered)
        if listed:
            paragraphs += (
                f"\n**{quantity} unchanged, because its change is not determined or hardly lowers "
                f"the tool error:** {listed}.\n"
            )
    return paragraphs


def write_home_page(
    calibration: Calibration, homes: Sequence[JointHome], *, own_limits: bool
) -> str:
    """README.md for offsets that are entered as HOME_OFFSET.

    Args:
        calibration: The calibration.
        homes: The joints.
        own_limits: Whether the limits are those of the controller, not only the robot's travel.
    """
    half = {e.drive: expanded_uncertainty(calibration, e) for e in find_entries(calibration)}
    rows = []
    for i, home in enumerate(homes):
        change = home.show(home.change, sign=True)
        if home.old is None or home.new is None:
            entered = f"present value {change}"
        else:
            entered = f"{home.show(home.old)} → **{home.show(home.new)}**"
        expanded = round(half.get(home.drive.name, math.nan), ENTERED_DECIMALS)
        uncertainty = "" if math.isnan(expanded) else f"± {home.show(expanded)}"
        cells = (
            f"JOINT_{i}",
            comment_safe(home.drive.name),
            home.counting,
            entered,
            change,
            uncertainty,
            home.drive.joint_unit,
        )
        rows.append(f"| {' | '.join(cells)} |")
    scope = "The calibration identified offsets of the drives only."
    if not calibration.only_offsets:
        scope = (
            "The calibration identified more than offsets. These offsets minimise the tool error\n"
            "if the controller corrects nothing else."
        )
    if assessment_of(calibration).keeps_offsets:
        scope = "The offsets do not change."
    stated_offsets = calibration.session.controller_offsets is not None
    values = {
        "robot": comment_safe(calibration.robot.name),
        "scope": scope,
        "table": "\n".join(rows),
        "active": f"`{_describe_offsets(calibration)}`" if stated_offsets else UNSTATED,
        "limits": _describe_limits(homes, own=own_limits),
        "compensation": describe_compensation(homes) + _describe_unchanged(calibration),
    }
    return fill_template("home_offset.md", values)


def _describe_limits(homes: Sequence[JointHome], *, own: bool) -> str:
    """Sentence about narrower soft limits of the controller."""
    if own:
        return "They contain the narrower limits of your INI file."
    changes = ", ".join(
        f"JOINT_{i} {home.show(home.limit_change, sign=True)} {home.drive.joint_unit}"
        for i, home in enumerate(homes)
    )
    return f"Narrower limits of your own change by: {changes}."


def _describe_remaining(calibration: Calibration, approximation: Approximation) -> str:
    """Sentences about the tool error without a module, and that which remains with it."""
    text = ""
    if approximation.nominal_error is not None:
        error = f"{approximation.nominal_error / MM:.3f}"
        text = (
            f"Without the module the tool is wrong by up to {error} mm. This includes a shift and\n"
            "rotation of all positions, which do not matter on a workpiece that is aligned on the "
            "machine.\n"
        )
    tool = assessment_of(calibration).tool
    if tool is None:
        return f"{text}The uncertainty of the calibration is in its report."
    expected = tool_mm(tool.compensated)
    return (
        f"{text}Expected tool error with all identified errors corrected: {expected} RMS. The\n"
        "calibration knows the machine no better."
    )


def write_module_page(
    calibration: Calibration,
    approximation: Approximation,
    homes: Sequence[JointHome],
    *,
    own_limits: bool,
) -> str:
    """README.md of a kinematics module: steps to build and enter it, errors and limits.

    Args:
        calibration: The calibration.
        approximation: The module.
        homes: The joints.
        own_limits: Whether the limits of the axes are also those of the controller.
    """
    inverse = approximation.inverse
    polynomial = inverse.correction
    letters = [c for k, c in enumerate(LETTERS) if k not in approximation.coordinates]
    terms = f"{len(polynomial.exponents)} terms per joint"
    form = f"a polynomial of degree {polynomial.degree} ({terms})"
    if isinstance(inverse.nominal, Tangent):
        form = f"The inverse kinematics are {form}."
    else:
        form = f"The inverse kinematics are the nominal closed form, corrected by\n{form}."
    beyond = ""
    if approximation.error_beyond is not None:
        error = rounded_up(approximation.error_beyond / UM)
        beyond = f" {BEYOND_FACE / MM:g} mm beyond a face the error is up to {error} µm."
    reason = "The calibration identified more than offsets."
    if calibration.only_offsets:
        reason = "The calibration identified offsets only; a module was requested."
    old = [f"JOINT_{i} {h.show(h.old)}" for i, h in enumerate(homes) if h.old is not None]
    values = {
        "robot": comment_safe(calibration.robot.name),
        "reason": reason,
        "form": form,
        "achieved": rounded_up(max(approximation.achieved, SMALLEST_ERROR) / UM),
        "region": approximation.region,
        "tool": millimetres(approximation.tool),
        "checked": approximation.checked,
        "remaining": _describe_remaining(calibration, approximation),
        "compensation": describe_compensation(homes, module=True)
        + _describe_conditions(approximation)
        + _describe_unchanged(calibration, module=True),
        "old_values": f" ({', '.join(old)})" if old else "",
        "last": len(homes) - 1,
        "drives": ", ".join(comment_safe(h.drive.name) for h in homes),
        "others": ", ".join(letters),
        "beyond": beyond,
        "own_limits": " and to the limits of your INI file" if own_limits else "",
        "longer_mm": f"{LONGER_TOOL / MM:g}",
        "longer": rounded_up(approximation.error_of_longer_tool / UM),
    }
    return fill_template("kinematics.md", values)
