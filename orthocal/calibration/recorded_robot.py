"""The robot that a calibration names, loaded and held against what the calibration says of it.

The file of a calibration can be edited, and the robot's files can change.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from orthocal.calibration.records import ParameterEstimate, PostureRecord, RobotRecord, SetupRecord
from orthocal.effects.loading import load_robot
from orthocal.errors import CalibrationFileError, ParameterError, RobotError, SessionError
from orthocal.estimation.diagnostics.residual_rows import ResidualRow
from orthocal.io.files import is_folder
from orthocal.measurement.files.readings_checks import check_conditions
from orthocal.robot.loading import packaged_robots
from orthocal.robot.model import Robot


def load_recorded_robot(record: RobotRecord, *, file: Path | None) -> Robot:
    """The nominal robot of a record, with the tolerances that are stated there.

    Args:
        record: What a calibration says of its robot.
        file: The calibration's, if it is from one: a robot is looked for beside it, too.

    Raises:
        RobotError: If the robot cannot be loaded.
        CalibrationFileError: If it cannot be found or has changed since, or a tolerance is none.
    """
    where = None if file is None else str(file)
    if record.folder is None:
        if record.name not in packaged_robots():
            raise CalibrationFileError(
                f"names the robot '{record.name}', which does not come with this orthocal",
                where=where,
            )
        robot = load_robot(record.name)
    else:
        folder = Path(record.folder)
        if not is_folder(folder) and file is not None:
            folder = file.parent / record.reference
        try:
            robot = load_robot(folder)
        except RobotError as e:
            if e.where is not None:
                raise
            raise CalibrationFileError(
                f"'{record.reference}' is neither a robot of orthocal "
                f"({', '.join(packaged_robots())}) nor a folder ({folder})",
                where=None if where is None else f"{where}: robot",
            ) from None
    if robot.sha256 != record.sha256:
        raise CalibrationFileError(
            f"was made for another version of robot '{record.name}': the files in "
            f"{robot.folder} have changed since",
            where=where,
        )
    try:
        return robot.with_tolerances(dict(record.tolerances))
    except ParameterError as e:
        at = "robot.tolerances" if where is None else f"{where}: robot.tolerances"
        raise CalibrationFileError(e.problem, where=at) from None


def require_parameters(
    robot: Robot,
    parameters: Sequence[ParameterEstimate],
    unmodelled: Sequence[str],
    *,
    prefix: str,
) -> None:
    """Refuse parameters that the robot does not have, or not in that unit.

    Args:
        robot: The robot.
        parameters: Estimates.
        unmodelled: Names of errors that were not free.
        prefix: The file, for messages.

    Raises:
        CalibrationFileError: Naming the key.
    """
    for i, p in enumerate(parameters):
        where = f"{prefix}parameters[{i}]"
        try:
            known = robot.parameters[p.name]
        except ParameterError as e:
            raise CalibrationFileError(e.problem, where=f"{where}.name") from None
        if p.unit != known.unit:
            raise CalibrationFileError(
                f"found '{p.unit}'; {p.name} is in {known.unit}", where=f"{where}.unit"
            )
    for i, name in enumerate(unmodelled):
        try:
            robot.parameters[name]
        except ParameterError as e:
            raise CalibrationFileError(e.problem, where=f"{prefix}unmodelled.names[{i}]") from None


def require_rows(
    robot: Robot,
    setups: Sequence[SetupRecord],
    postures: Sequence[PostureRecord],
    residuals: Sequence[ResidualRow],
    *,
    prefix: str,
) -> None:
    """Refuse setups and postures that the robot cannot have, and rows of what is not there.

    Args:
        robot: The robot.
        setups: Of the session.
        postures: Of the session.
        residuals: Rows that name both.
        prefix: The file, for messages.

    Raises:
        CalibrationFileError: Naming the key.
    """
    for i, setup in enumerate(setups):
        try:
            setup.sensor.require_fit(robot, where=f"{prefix}setups[{i}].reads")
        except SessionError as e:
            raise CalibrationFileError(e.problem, where=e.where) from None
    for i, posture in enumerate(postures):
        for key, values, count, kind in (
            ("drives", posture.drives, len(robot.drives), "drive"),
            ("passive", posture.passive, robot.passive_index.size, "passive joint"),
        ):
            if len(values) != count:
                raise CalibrationFileError(
                    f"has {len(values)} numbers; expected {count}, one a {kind}",
                    where=f"{prefix}postures[{i}].{key}",
                )
    for i, row in enumerate(residuals):
        if row.conditions is not None:
            where = f"{prefix}residuals[{i}].conditions"
            try:
                check_conditions(row.conditions, robot, row.minus is not None, where)
            except SessionError as e:
                raise CalibrationFileError(e.problem, where=e.where) from None
    posture_names, setup_names = {p.name for p in postures}, {s.name for s in setups}
    for i, setup in enumerate(setups):
        if setup.aligned_at not in posture_names:
            raise CalibrationFileError(
                f"'{setup.aligned_at}' is not among the file's postures",
                where=f"{prefix}setups[{i}].aligned_at",
            )
    for i, row in enumerate(residuals):
        for key, name, kind, among in (
            ("setup", row.setup, "setups", setup_names),
            ("posture", row.posture, "postures", posture_names),
            ("minus", row.minus or row.posture, "postures", posture_names),
        ):
            if name not in among:
                raise CalibrationFileError(
                    f"'{name}' is not among the file's {kind}",
                    where=f"{prefix}residuals[{i}].{key}",
                )


def require_offsets(robot: Robot, offsets: Sequence[float] | None, *, prefix: str) -> None:
    """Refuse offsets of the controller that are not one a drive.

    Raises:
        CalibrationFileError: Naming the drives.
    """
    if offsets is not None and len(offsets) != len(robot.drives):
        raise CalibrationFileError(
            f"has {len(offsets)} numbers; expected {len(robot.drives)}, one a drive: "
            f"{', '.join(d.name for d in robot.drives)}",
            where=f"{prefix}session.controller_offsets",
        )
