"""What a session is measured for: the errors of the machine that are to be identified from it."""

from __future__ import annotations

from dataclasses import dataclass

from orthocal.errors import ParameterError, SessionError
from orthocal.measurement.schema import CalibrationKeys
from orthocal.robot.model import Robot


@dataclass(frozen=True, slots=True)
class Purpose:
    """Which errors are free; `calibrate` takes them where nothing else is said."""

    model: str | None = None
    """A model of the robot's YAML."""
    free: tuple[str, ...] = ()
    """Names or globs that are free too, or instead of a model; '!' takes out."""


def read_purpose(
    keys: CalibrationKeys | None, robot: Robot, *, where: str
) -> tuple[Purpose | None, Robot]:
    """What a session.yaml says under `calibration`.

    Args:
        keys: That.
        robot: The robot of the session.
        where: File and key, for messages.

    Returns:
        What is to be identified, None where that is not said; and the robot with the tolerances
        that are stated.

    Raises:
        SessionError: If a model, name, unit or number is none of the robot's.
    """
    if keys is None:
        return None, robot
    parameters = robot.parameters
    at = "model"
    try:
        patterns = [] if keys.model is None else parameters.patterns(keys.model)
        at = "free"
        free = parameters.select([*patterns, *keys.free])
        at = "tolerances"
        robot = robot.with_tolerances(keys.tolerances)
    except ParameterError as e:
        raise SessionError(e.problem, where=f"{where}.{at}") from None
    if keys.model is None and not keys.free:
        return None, robot
    if not free:
        raise SessionError("leaves no error free", where=f"{where}.free")
    return Purpose(keys.model, tuple(keys.free)), robot
