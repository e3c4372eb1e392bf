"""The command `export`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

import orthocal
from orthocal.cli.options import OutDirectory, command, read_numbers, read_vector
from orthocal.cli.overwriting import mark_written, require_replaceable_results, require_same_text
from orthocal.cli.printing import put_note, put_out, write_results
from orthocal.errors import ParameterError
from orthocal.io.files import exists
from orthocal.text import printable
from orthocal.units import MM, UM

if TYPE_CHECKING:
    from orthocal.measurement.files.linuxcnc_ini import ControllerJoints

ALTERNATIVES = ("joints.ini", "kinematics.ini")
"""Files that exclude each other: new HOME_OFFSET, and a module that contains the offsets."""


@command()
def export(
    calibration: Path,
    to: Annotated[str, Option()],
    out: OutDirectory,
    module: Annotated[bool | None, Option("--module/--offsets")] = None,
    within: float | None = None,
    half_side_mm: float | None = None,
    tool: str | None = None,
    payload: float | None = None,
    home_offset: str | None = None,
    latched: str | None = None,
    ini: Path | None = None,
    anyway: bool = False,
    force: bool = False,
) -> None:
    """Write a calibration for a controller or another program.

    --half-side-mm, --tool and --payload apply to a module for LinuxCNC.

    Exit code 3: the verdict is not `enter`, or the machine does not reach the requested region,
    or no module meets --within. The reason is printed, and nothing is written.

    Args:
        to (FORMAT): yaml: parameters with their units; table: corrections of the tool over a grid;
            urdf: the calibrated machine as a robot directory; linuxcnc: HOME_OFFSET, or a
            kinematics module if the calibration identified more than offsets; klipper, marlin,
            marlin1 or reprapfirmware: settings of a delta printer.
        module: linuxcnc: write a module, or HOME_OFFSET only; default: by what was identified.
        within (UM): linuxcnc: largest error of the module itself at the tool, µm; default: 0.1.
        home_offset (VALUES): linuxcnc: HOME_OFFSET of each joint during the measurement, separated
            by commas, mm or degrees; default: as the session states. If neither states it, the
            files contain changes only.
        latched (SIGNS): linuxcnc: sign of HOME_LATCH_VEL of each joint, such as +,+,-; it matters
            for drives with backlash. Default: + for all joints.
        ini (FILE): linuxcnc: INI file during the measurement: HOME_OFFSET, latching, soft limits.
    """
    result = orthocal.load_calibration(calibration)
    stated = {"--home-offset": home_offset, "--latched": latched}
    joints = None if ini is None else _read_joints(ini, result, to, stated)
    options = orthocal.ExportOptions(
        within=None if within is None else within * UM,
        tool=None if tool is None else read_vector(tool, "--tool"),
        home_offsets=_home_offsets(home_offset, joints, result),
        latched=_latched(latched, joints),
        joint_limits=joints.limits if joints else None,
        axis_limits=joints.axis_limits if joints else None,
        half_side=None if half_side_mm is None else half_side_mm * MM,
        payload=payload,
        module=module,
    )
    files = mark_written(orthocal.export_calibration(result, to, anyway=anyway, options=options))
    _require_free(out, files, force=force)
    write_results(out, files)
    if result.session.firmware is not None:
        _show_settings(result, to, calibration, out)
    if to == "linuxcnc":
        _note_assumptions(result, options, ini, module="kinematics.ini" in files)
        _note_home(result, joints, out, files)
    if "README.md" in files and result.session.firmware is None:
        put_out(f"Next: follow {out / 'README.md'}.")


def _show_settings(
    calibration: orthocal.Calibration, firmware: str, saved: Path, out: Path
) -> None:
    """Print the new settings of a firmware, with their uncertainty, and the next step.

    Args:
        calibration: The calibration.
        firmware: Format of the export.
        saved: Directory of the calibration.
        out: Directory of the export.
    """
    from orthocal.assessment.printer_settings import fit_firmware
    from orthocal.export.printer import describe_next, describe_settings
    from orthocal.printers.firmwares import FIRMWARES

    for name in FIRMWARES:
        if firmware == name:
            fit = fit_firmware(calibration, name)
            put_out(describe_settings(fit))
            put_out(printable(describe_next(fit, saved, out), keep="\n"))


def _note_assumptions(
    calibration: orthocal.Calibration,
    options: orthocal.ExportOptions,
    ini: Path | None,
    *,
    module: bool,
) -> None:
    """Note the assumed payload, order of sessions, and directions of homing onto the switches."""
    from orthocal.assessment.wording import joined
    from orthocal.export.formats import note_wrong_order
    from orthocal.export.linuxcnc.export import find_assumed_latching
    from orthocal.output.text.conditions import describe_assumed

    if module:
        conditions = orthocal.UseConditions(payload=options.payload)
        put_note(describe_assumed(calibration, conditions, fields=["payload"]))
    put_note(note_wrong_order(calibration))
    if module and options.module is None and options.home_offsets:
        put_note(
            "A kinematics module does not change HOME_OFFSET. For HOME_OFFSET of the offsets alone "
            "add --offsets."
        )
    if assumed := find_assumed_latching(calibration, options):
        several = len(assumed) == len(calibration.robot.drives) > 1
        joints = "all joints" if several else joined([f"JOINT_{i}" for i in assumed])
        unstated = "" if ini is None else f" ({ini} does not state it)"
        put_note(
            f"Assumed: HOME_LATCH_VEL of {joints} is positive{unstated}. On its sign depends "
            f"half of the backlash in {'the module' if module else 'HOME_OFFSET'}. If it is "
            f"negative, state the signs by {'--ini FILE or ' * (ini is None)}--latched."
        )


def _note_home(
    calibration: orthocal.Calibration,
    joints: ControllerJoints | None,
    out: Path,
    files: Mapping[str, str],
) -> None:
    """Note joints whose HOME is outside of the new soft limits: LinuxCNC refuses to move there.

    Args:
        calibration: The calibration.
        joints: Joints of the INI file; None without a file.
        out: Directory of the export.
        files: The written files by name.
    """
    from orthocal.measurement.files.linuxcnc_ini import read_controller_joints

    if joints is None:
        return
    robot, lines = calibration.robot, next(out / name for name in ALTERNATIVES if name in files)
    new = zip(robot.drives, read_controller_joints(lines, robot).limits, strict=True)
    for i, ((drive, (low, high)), home) in enumerate(zip(new, joints.after_homing, strict=True)):
        if home is not None and not low <= home <= high:
            limits = " to ".join(f"{v / drive.joint_size:g}" for v in (low, high))
            put_note(
                f"HOME of JOINT_{i} is {home / drive.joint_size:g} {drive.joint_unit}, outside of "
                f"its new limits, {limits} {drive.joint_unit}: change HOME in your INI file, too."
            )


def _require_free(out: Path, files: Mapping[str, str], *, force: bool) -> None:
    """Refuse a directory with an alternative file, other lines, or files of somebody else.

    Raises:
        OrthocalError: If there is such a file; names it.
    """
    for new, other in (ALTERNATIVES, ALTERNATIVES[::-1]):
        if new in files and exists(out / other):
            raise ParameterError(
                f"belongs to another export; with both {new} and {other} entered the controller "
                "would correct offsets twice: choose another directory",
                where=str(out / other),
            )
    require_replaceable_results(out, files, force=force)
    if not force:
        require_same_text(out, {name: files[name] for name in ALTERNATIVES if name in files})


def _read_joints(
    path: Path, calibration: orthocal.Calibration, to: str, stated: Mapping[str, str | None]
) -> ControllerJoints:
    """Read the joints of an INI file; refuse other joints than the session states.

    Args:
        path: The INI file.
        calibration: The calibration.
        to: Format of the export.
        stated: Values of the options that the file replaces, by option.

    Raises:
        ParameterError: If the format is another one, HOME_OFFSET or the compensation differs, or
            such an option is stated.
    """
    from orthocal.effects.compensation import JointTrim
    from orthocal.export.formats import require_format
    from orthocal.export.linuxcnc.entered_lines import compare_joints, require_same_homes
    from orthocal.measurement.files.linuxcnc_ini import read_controller_joints

    require_format(to)
    if to != "linuxcnc":
        raise ParameterError("is an option of --to linuxcnc only", where="--ini")
    joints = read_controller_joints(path, calibration.robot)
    in_file = {
        "--home-offset": joints.home_offsets,
        "--latched": joints.latched if all(joints.latched) else None,
    }
    for option, value in stated.items():
        if value is not None and in_file[option] is not None:
            raise ParameterError("is stated by --ini, too; state one of them", where=option)
    drives, stated_trims = calibration.robot.drives, calibration.session.compensation
    require_same_homes(calibration, joints.home_offsets, where=str(path))
    expected = stated_trims or (JointTrim(),) * len(drives)
    if differences := compare_joints(zip(drives, expected, joints.compensation, strict=True)):
        raise ParameterError(
            "has other BACKLASH or COMP_FILE than the session states under `controller` "
            f"(backlash, comp_file): {differences}. Expected is the INI file of the measurement",
            where=str(path),
        )
    return joints


def _home_offsets(
    text: str | None, joints: ControllerJoints | None, calibration: orthocal.Calibration
) -> tuple[float, ...] | None:
    """HOME_OFFSET of each joint by the INI file or the option, [m, rad]; None without both.

    Raises:
        ParameterError: If the option is malformed.
    """
    if joints is not None and joints.home_offsets is not None:
        return joints.home_offsets
    if text is None:
        return None
    drives = calibration.robot.drives
    values = read_numbers(text, "--home-offset", [d.name for d in drives])
    return tuple(v * d.joint_size for v, d in zip(values, drives, strict=True))


def _latched(text: str | None, joints: ControllerJoints | None) -> tuple[int, ...] | None:
    """Signs of HOME_LATCH_VEL of an option, such as +,+,-, or of an INI file; None without both.

    Raises:
        ParameterError: If a part is not a sign, or a sign contradicts the file.
    """
    known = None if joints is None else joints.latched
    if text is None:
        return known
    signs = {"+": 1, "-": -1}
    parts = [part.strip() for part in text.split(",")]
    if not set(parts) <= signs.keys():
        raise ParameterError(
            f"found '{text}'; expected signs separated by commas, such as +,+,-", where="--latched"
        )
    stated = tuple(signs[part] for part in parts)
    for i, (sign, in_file) in enumerate(zip(stated, known or (), strict=False)):
        if sign == -in_file:
            raise ParameterError(
                f"contradicts the HOME_LATCH_VEL of JOINT_{i} in the INI file", where="--latched"
            )
    return stated
