"""Which machines a study of accuracy draws, and what it identifies of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from orthocal.errors import SessionError
from orthocal.estimation.choice import Choice, choose
from orthocal.kinematics.workspace import cube_limits, find_workspace
from orthocal.robot.model import Robot
from orthocal.robot.parameters import ParameterSet
from orthocal.session.session import Session
from orthocal.study.accuracy import AccuracyStudy
from orthocal.study.shipped_functions import ShippedSession


def build_accuracy_study(
    session: Session,
    choice: Choice | str | None = None,
    *,
    drawn: Sequence[str] | None = None,
    given: Mapping[str, float] | None = None,
    machines: int = 1000,
    seed: int = 0,
    half_side: float | None = None,
) -> AccuracyStudy:
    """A study of what a plan's readings leave of machines.

    Args:
        session: What is read where.
        choice: What is identified, or the name of a model; by default what the session is for, or
            `full`. Its tolerances are those by which errors are drawn, too.
        drawn: Names or globs of the errors that machines have; by default all of the machine's,
            unless errors are given.
        given: Errors that all machines have, [SI].
        machines: How many.
        seed: Of errors, gauges and noise.
        half_side: Half the side of a cube around the mechanical zero over which the tool's error
            is computed, [m]; by default the workspace of the robot.

    Raises:
        ParameterError: If a name or number makes no sense.
        SessionError: If the noise of a gauge is not known.
        RobotError: If the drives do not command the tool.
    """
    chosen = choose(choice, session, usual="full")
    robot = session.robot
    parameters = robot.parameters
    chosen.select(parameters)
    given = dict(given or {})
    if drawn is None:
        drawn = () if given else parameters.patterns("full")
    names = _without_sums(parameters.select(drawn), parameters) if drawn else ()
    taken = {t for n in given for t, _ in parameters[n].terms}
    names = tuple(n for n in names if not taken & {t for t, _ in parameters[n].terms})
    own = parameters.read_tolerances(chosen.tolerances)
    of = {n: value for glob, value in own.items() for n in parameters.select([glob])}
    for name in session.gauges:
        gauge = session.gauges[name]
        if gauge.sigma is None:
            key = f"gauges.{name}.sigma_mm" if name else "gauge.sigma_mm"
            raise SessionError(
                "is missing: the noise to draw is not known",
                where=key if session.path is None else f"{session.path}: {key}",
            )
    return AccuracyStudy(
        session=ShippedSession.of(session.with_values(np.zeros(len(session.readings)))),
        choice=chosen,
        drawn=names,
        tolerances={n: of.get(n, parameters[n].tolerance) for n in names},
        given=given,
        machines=machines,
        seed=seed,
        box=_find_box(robot, half_side),
    )


def _find_box(robot: Robot, half_side: float | None) -> tuple[tuple[float, float], ...]:
    """Box over which the tool's error is computed, [m]."""
    box = find_workspace(robot).limits if half_side is None else cube_limits(robot, half_side)
    return tuple((float(low), float(high)) for low, high in box)


def _without_sums(names: Sequence[str], parameters: ParameterSet) -> tuple[str, ...]:
    """Names without the sums of errors that are among them: these would be drawn twice."""
    return tuple(
        n
        for n in names
        if len(parameters[n].terms) == 1 or not {t for t, _ in parameters[n].terms} & set(names)
    )
