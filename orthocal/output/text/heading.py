"""Subject and method of a calibration, in lines."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.assessment.plausibility import describe_legs
from orthocal.calibration.calibration import Calibration
from orthocal.output.text.layout import counted, list_places, short_name
from orthocal.units import DRIVE_UNITS

LONGEST_LINE = 150
"""Characters of a line with names from files, in the short answer."""


def render_subject(calibration: Calibration) -> RenderableType:
    """Machine and readings of a calibration, in four lines."""
    title = short_name(calibration.session.title, LONGEST_LINE)
    return Group(
        Text(_name(calibration), style="bold"),
        *([Text(title)] if title else []),
        Text(short_name(f"Machine: {describe_machine(calibration)}", LONGEST_LINE)),
        Text(short_name(_measured(calibration), LONGEST_LINE)),
    )


def render_method(calibration: Calibration, *, effort: bool = True) -> RenderableType:
    """Source of the readings, model and solver.

    Args:
        calibration: The calibration.
        effort: Whether to state iterations and time of the solver.
    """
    source = calibration.session.source
    lines = [f"Source: {source}"] if source else []
    return Group(*map(Text, [*lines, *_describe_method(calibration, effort)]))


def _name(calibration: Calibration) -> str:
    return f"Calibration of {calibration.robot_record.name}, model '{calibration.model}'"


def _measured(calibration: Calibration) -> str:
    kind = "difference" if calibration.rows_are_differences else "reading"
    read = {r.setup for r in calibration.residuals}
    setups = [s for s in calibration.setups if s.name in read]
    unread = [s.name for s in calibration.setups if s.name not in read]
    places = list_places(s.sensor.place for s in setups)
    used = {r.posture for r in calibration.residuals} | {
        r.minus for r in calibration.residuals if r.minus
    }
    return (
        f"Measured: {counted(len(calibration.residuals), kind)} in "
        f"{counted(len(used), 'posture')}, {counted(len(setups), 'setup')} on {places}"
        + (f"; no reading of {', '.join(unread)}" if unread else "")
    )


def _describe_method(calibration: Calibration, effort: bool) -> list[str]:
    solver = calibration.solver
    with_prior = sum(p.prior for p in calibration.free)
    prior = "tolerances as prior" if with_prior else "no prior"
    if 0 < with_prior < len(calibration.free):
        prior = f"{with_prior} with a prior"
    kind = "base parameter" if calibration.base else "parameter"
    loss = ", Huber's loss" if solver.loss == "huber" else ""
    lines = [f"Estimated: {counted(len(calibration.free), kind)}, {prior}{loss}"]
    if effort:
        lines.append(
            f"Solver: {solver.name}, {solver.status}, {counted(solver.iterations, 'iteration')}, "
            f"{solver.seconds_build + solver.seconds_solve:.2f} s"
        )
    return lines


def describe_machine(calibration: Calibration) -> str:
    """Dimensions of the machine: legs and travel."""
    travel = {}
    for name, unit, *ends in calibration.robot_record.travel:
        word, size = DRIVE_UNITS[unit]
        low, high = ("∞" if v is None else f"{v / size:g}" for v in ends)
        travel[name] = f"{low} … {high} {word.replace('deg', '°')}".replace("∞ …", "−∞ …")
    words = []
    if calibration.robot_record.legs:
        words.append(describe_legs(dict(calibration.robot_record.legs)))
    if len(set(travel.values())) == 1:
        words.append(f"travel {next(iter(travel.values()))}")
    else:
        words.append(f"travel {', '.join(f'{n} {t}' for n, t in travel.items())}")
    return ", ".join(words)
