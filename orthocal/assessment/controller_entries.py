"""Offsets, backlash and errors of screws to enter into a controller that corrects nothing else.

A machine whose legs and axes are off as well is not served best by its true offsets: others make up
for a part of its other errors. Entered is what leaves the least error at the tool, over the region
that it reaches.

A backlash or a periodic error of a screw is entered where the readings determine it: where it, or
its change, is larger than its expanded uncertainty, or where entering it lowers the expected tool
error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from orthocal.arrays import Array
from orthocal.assessment.calibrated_tool import CalibratedTool, error_covariance, find_tool
from orthocal.calibration.assessment_record import BacklashEntry, ControllerEntry
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.records import ParameterEstimate
from orthocal.effects.compensation import Compensation, JointTrim
from orthocal.effects.loading import robot_effects
from orthocal.effects.screw import SCREW_COMPONENTS, Screw
from orthocal.io.fields import read_only

DECIDED = 1e-2
"""Ratio of the aligned to the absolute tool error of a direction of the offsets, below which the
absolute error decides on it: such offsets little more than shift and turn the workspace."""

ENTERED_DECIMALS = 6
"""Step of an entered offset, [m, rad]: 1 µm."""

WORTH_ENTERING = 0.05
"""Share by which the expected tool error must fall for the offsets to be entered. Also that by
which it must fall for a correction of all errors to be recommended."""

IN_TWO = math.sqrt(-2.0 * math.log(0.05)) / 1.96
"""Radius of the ellipse that contains 95 % of two estimates, over the expanded uncertainty of one
(1.25)."""

POSITIONS = 64
"""Positions, over two turns, at which a table is compared with a periodic error."""

MOST_STEPS = 12

SETTLED = 1e-10
"""Steps of the offsets that are none, [m, rad]."""


def find_entries(calibration: Calibration) -> tuple[ControllerEntry, ...]:
    """Offsets to enter into a controller that corrects offsets only.

    As the assessment records them: those that leave the least error at the tool
    (`choose_offsets`), or the active ones where the offsets stay as they are. Empty where no offset
    was identified.
    """
    if calibration.assessment is not None:
        return calibration.assessment.entries
    tool = find_tool(calibration)
    changes = backlash_changes(calibration, compute_backlash(calibration, tool))
    return compute_entries(calibration, tool and tool.compensating(changes))


def find_backlash(calibration: Calibration) -> tuple[BacklashEntry, ...]:
    """Backlash to enter of each drive, as the assessment records it; empty without any."""
    if calibration.assessment is not None:
        return calibration.assessment.backlash
    return compute_backlash(calibration, find_tool(calibration))


def backlash_changes(calibration: Calibration, entries: Sequence[BacklashEntry]) -> Array:
    """Changes of the backlash that the controller takes up, shape (n_drives,), [m, rad]."""
    changes = {e.drive: e.change for e in entries}
    return np.array([changes.get(d.name, 0.0) for d in calibration.robot.drives])


def compensation_to_enter(calibration: Calibration) -> Compensation:
    """Compensation of a controller that takes up the backlash to enter.

    Empty where nothing changes, and beside tables: an export writes others.
    """
    changes = backlash_changes(calibration, find_backlash(calibration))
    tables = any(trim.table is not None for trim in calibration.session.compensation)
    if tables or not changes.any():
        return ()
    entered = np.round(calibration.compensated_backlash + changes, ENTERED_DECIMALS)
    return tuple(map(JointTrim, entered.tolist()))


def lowers(now: float, then: float) -> bool:
    """True if an expected tool error, [m], falls enough to enter or to correct something."""
    return not then > (1.0 - WORTH_ENTERING) * now


def compute_backlash(
    calibration: Calibration, tool: CalibratedTool | None
) -> tuple[BacklashEntry, ...]:
    """Backlash to enter of each drive, computed anew.

    Args:
        calibration: The calibration.
        tool: Its tool over the workspace; None if there is none.
    """
    by_name = {p.name: p for p in calibration.parameters}
    active = calibration.compensated_backlash.tolist()
    entries, changes, determined = [], [], []
    for drive, now in zip(calibration.robot.drives, active, strict=True):
        p = by_name.get(f"{drive.name}.backlash")
        if p is None or not (p.free or p.value):
            continue
        value, std = max(p.value, 0.0), p.std if p.free else 0.0
        scatter = p.std_scatter if p.free else 0.0
        entry = BacklashEntry(drive.name, drive.unit, now, value, value, std, scatter)
        half = float(calibration.expand(std, scatter))
        entries.append(entry)
        changes.append(_change_of(entry))
        determined.append(max(value, abs(value - now)) > half)
    entering = _choose_changes(calibration, tool, changes, determined)
    return tuple(e if enter else e.kept for e, enter in zip(entries, entering, strict=True))


def _change_of(entry: BacklashEntry) -> dict[str, float]:
    return {f"{entry.drive}.backlash": entry.change}


def _choose_changes(
    calibration: Calibration,
    tool: CalibratedTool | None,
    changes: Sequence[Mapping[str, float]],
    determined: Sequence[bool],
) -> Sequence[bool]:
    """Decide on each change: entered if it is determined, or if the others lower the tool error.

    Args:
        calibration: The calibration.
        tool: Its tool over the workspace; None if there is none.
        changes: Change of what the controller corrects, parameter to amount, [SI].
        determined: Whether each is larger than its expanded uncertainty.
    """
    unclear: dict[str, float] = {}
    for change, known in zip(changes, determined, strict=True):
        unclear |= {} if known else change
    return [True] * len(changes) if _changes_tool(calibration, tool, unclear) else determined


@dataclass(frozen=True, slots=True, eq=False)
class ScrewEntry:
    """Periodic error of a drive's screw, A sin(2πρ/lead) + B cos(2πρ/lead), for a table."""

    drive: str
    active: Array
    """A and B that the controller corrects now, shape (2,), [m]."""
    identified: Array
    """A and B of the identified machine, shape (2,), [m]."""
    enter: Array
    """A and B to enter: `identified`, or those active now if the change is undetermined."""
    uncertainty: float
    """Expanded uncertainty of the amplitude, [m]."""

    @property
    def change(self) -> Array:
        """Values to enter less the active ones, shape (2,), [m]."""
        return self.enter - self.active

    @property
    def values(self) -> dict[str, float]:
        """Parameter to value to enter, [m]."""
        return _by_parameter(self.drive, self.enter)


def find_screws(calibration: Calibration) -> tuple[ScrewEntry, ...]:
    """Periodic errors of screws to enter, by the rule for backlash; empty without any.

    An amplitude is determined if A and B are outside the ellipse that contains 95 % of their
    estimates around 0, or around the active ones.
    """
    robot = calibration.robot
    screw = next((e for e in robot_effects(robot) if isinstance(e, Screw)), None)
    if screw is None:
        return ()
    errors, entries, determined = calibration.errors, [], []
    for drive, active in zip(robot.drives, _compensated_screws(calibration, screw), strict=True):
        names = [f"{drive.name}.{kind}" for kind in SCREW_COMPONENTS]
        value = np.array([errors.get(name, 0.0) for name in names])
        if not (value.any() or active.any()):
            continue
        half = _amplitude_uncertainty(calibration, names, value)
        other = _amplitude_uncertainty(calibration, names, value - active)
        entries.append(ScrewEntry(drive.name, active, value, value, half))
        sizes = np.linalg.norm([value, value - active], axis=1)
        determined.append(bool((sizes > IN_TWO * np.array([half, other])).any()))
    changes = [_by_parameter(e.drive, e.change) for e in entries]
    entering = _choose_changes(calibration, find_tool(calibration), changes, determined)
    return tuple(
        e if enter else replace(e, enter=e.active)
        for e, enter in zip(entries, entering, strict=True)
    )


def _by_parameter(drive: str, values: Array) -> dict[str, float]:
    return dict(zip((f"{drive}.{kind}" for kind in SCREW_COMPONENTS), values.tolist(), strict=True))


def _amplitude_uncertainty(
    calibration: Calibration, names: Sequence[str], amplitude: Array
) -> float:
    """Expanded uncertainty of A and B in the direction of an amplitude, [m].

    Of the ellipse wᵀ C⁻¹ w = k² it is the radius in this direction; 0 if both are known.
    """
    free = [p.name for p in calibration.free]
    at = [free.index(name) for name in names if name in free]
    size = float(np.linalg.norm(amplitude))
    if len(at) < len(names) or not size:
        return 0.0
    total, scatter = (
        c[np.ix_(at, at)] for c in (calibration.total_covariance, calibration.noise_covariance)
    )
    unit = amplitude / size
    std = 1.0 / math.sqrt(float(unit @ np.linalg.solve(total, unit)))
    of_noise = math.sqrt(max(float(unit @ scatter @ unit), 0.0))
    return float(calibration.expand(std, min(of_noise, std)))


def _compensated_screws(calibration: Calibration, screw: Screw) -> Array:
    """A and B that tables of the controller corrected while measuring, shape (n_drives, 2), [m]."""
    robot, waves_of_drives = calibration.robot, []
    for i, drive in enumerate(robot.drives):
        displayed = np.tile(robot.drive_zero, (POSITIONS, 1))
        if drive.unit == "m":
            displayed[:, i] += np.linspace(-screw.lead, screw.lead, POSITIONS)
        moved = calibration.displacement(displayed)[:, i]
        phase = 2.0 * np.pi * (displayed[:, i] - calibration.active_offsets[i]) / screw.lead
        waves = np.column_stack([np.sin(phase), np.cos(phase), np.ones(POSITIONS)])
        waves_of_drives.append(-np.linalg.lstsq(waves, moved, rcond=None)[0][:2])
    return np.array(waves_of_drives)


def is_worth_changing(
    calibration: Calibration, tool: CalibratedTool | None, entries: Sequence[BacklashEntry]
) -> bool:
    """True if backlash is to be entered even where the offsets stay as they are."""
    changes: dict[str, float] = {}
    for e in entries:
        changes |= _change_of(e)
    return any(
        abs(e.change) > float(calibration.expand(e.std, e.std_scatter)) for e in entries
    ) or _changes_tool(calibration, tool, changes)


def _changes_tool(
    calibration: Calibration, tool: CalibratedTool | None, changes: Mapping[str, float]
) -> bool:
    """True if changes of what the controller corrects lower the expected tool error enough.

    That of a controller which corrects all other errors, to first order.

    Args:
        calibration: The calibration.
        tool: Its tool over the workspace; None if there is none.
        changes: Parameter to the change, [SI].
    """
    names = [] if tool is None else list(tool.free)
    known = {n: change for n, change in changes.items() if change}
    at = [names.index(n) for n in known if n in names]
    if tool is None or not at or not np.isfinite(calibration.model_covariance).all():
        return False
    change = np.array([known[names[i]] for i in at])
    covariance = error_covariance(calibration)
    aligned, _ = weigh_field(tool, tool.jacobian[:, :, : len(covariance)])
    uncertain = math.sqrt(max(float(np.sum((aligned @ covariance) * aligned)), 0.0))
    left = float(np.linalg.norm(aligned[:, at] @ change))
    return left > 0.0 and lowers(math.hypot(uncertain, left), uncertain)


def entered_offsets(
    calibration: Calibration, entries: Sequence[ControllerEntry] | None = None
) -> Array:
    """Offsets in the controller once they were entered, shape (n_drives,), [m, rad]."""
    offsets = calibration.active_offsets
    names = [d.name for d in calibration.robot.drives]
    for entry in find_entries(calibration) if entries is None else entries:
        offsets[names.index(entry.drive)] = entry.enter
    return offsets


def offsets_to_enter(calibration: Calibration) -> Array:
    """Offsets in the controller once they were entered as printed, shape (n_drives,), [m, rad]."""
    return np.asarray(entered_offsets(calibration).round(ENTERED_DECIMALS) + 0.0)


def compute_entries(
    calibration: Calibration, tool: CalibratedTool | None
) -> tuple[ControllerEntry, ...]:
    """Offsets with the least tool error, computed anew, to be entered all.

    Args:
        calibration: The calibration.
        tool: Its tool over the workspace; None if there is none.
    """
    drives, weights = calibration.robot.drives, calibration.offset_weights
    offset_stds = {
        i: [calibration.parameters[j] for j in np.flatnonzero(row).tolist()]
        for i, row in enumerate(weights)
        if row.any()
    }
    if not any(p.free for parts in offset_stds.values() for p in parts):
        return ()
    names = [p.name for p in calibration.free]
    identified, enter = calibration.offsets, calibration.active_offsets
    enter[list(offset_stds)] = identified[list(offset_stds)]
    of_free = weights[:, [j for j, p in enumerate(calibration.parameters) if p.free]]
    total, scatter = (
        np.array([_size(row, covariance) for row in of_free])
        for covariance in (calibration.total_covariance, calibration.noise_covariance)
    )
    judged = None if calibration.only_offsets else tool
    if judged is not None:
        chosen = choose_offsets(judged, enter, drives=list(offset_stds))
        everything = error_covariance(calibration)
        enter = chosen.offsets
        total = _spread(chosen.gain[:, : len(everything)], everything)
        scatter = _spread(chosen.gain[:, : len(names)], calibration.noise_covariance)
    active = calibration.session.controller_offsets
    return tuple(
        ControllerEntry(
            drive=drives[i].name,
            unit=drives[i].unit,
            active=None if active is None else active[i],
            identified=float(identified[i]),
            best=float(enter[i]),
            enter=float(enter[i]),
            std=float(total[i]),
            std_scatter=float(scatter[i]),
            held=_hold(parts[0]) if judged is None and len(parts) == 1 else None,
        )
        for i, parts in offset_stds.items()
    )


def _hold(p: ParameterEstimate) -> Literal["known", "lower bound", "upper bound"] | None:
    if not p.free:
        return "known"
    if p.at_bound is None:
        return None
    return "lower bound" if p.at_bound == "lower" else "upper bound"


def _size(weights: Array, covariance: Array) -> float:
    """Standard deviation of a sum of parameters; those that are not in it may be unknown."""
    at = np.flatnonzero(weights)
    weights_there = weights[at]
    return (
        math.sqrt(float(weights_there @ covariance[np.ix_(at, at)] @ weights_there))
        if at.size
        else 0.0
    )


def _spread(gain: Array, covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", gain, covariance, gain), 0.0)))


@dataclass(frozen=True, slots=True, eq=False)
class Entering:
    """Offsets that serve a controller best which knows of nothing else."""

    offsets: Array
    """Shape (n_drives,), [m, rad]."""
    gain: Array
    """How they follow from the parameters, to first order, shape (n_drives, n_parameters), [SI]."""


def choose_offsets(tool: CalibratedTool, start: Array, *, drives: Sequence[int]) -> Entering:
    """Offsets with the least tool error after alignment of the workpiece.

    Where that leaves them open, since they do little but shift and turn the whole region, the
    absolute error decides. Of a machine whose only errors are offsets these are they.

    Args:
        tool: The calibrated machine's tool; its parameters hold an offset for each of the drives.
        start: Offsets to begin with, shape (n_drives,), [m, rad].
        drives: Indices of the drives whose offsets are chosen; the others stay.

    Raises:
        ClosureError: If the machine cannot reach a point with such offsets.
    """
    names, robot = list(tool.free), tool.sensitivities[0].robot
    chosen = list(drives)
    index = [names.index(f"{robot.drives[i].name}.offset") for i in chosen]
    aligned, absolute = weigh_field(tool, tool.jacobian)
    gain = np.zeros((len(start), len(names)))
    gain[chosen] = solve_in_order(aligned[:, index], absolute[:, index], aligned, absolute)
    offsets = np.array(start, dtype=np.float64)
    for _ in range(MOST_STEPS):
        error = weigh_field(tool, tool.deviation(offsets))
        step = solve_in_order(aligned[:, index], absolute[:, index], *error)
        offsets[chosen] += step
        if np.abs(step).max() < SETTLED:
            break
    return Entering(read_only(offsets), read_only(gain))


def weigh_field(tool: CalibratedTool, field: Array) -> tuple[Array, Array]:
    """Field of position errors after alignment of the workpiece, and absolute.

    The sum of squares of either is the mean square over the workspace.

    Args:
        tool: The tool over its workspace of K points.
        field: Shape (K, 3, ...), [m].

    Returns:
        Two arrays of shape (3 K, ...), [m].
    """
    root = np.sqrt(tool.workspace.weights)[:, None]
    parts = (tool.workspace.remove_motion(field, tool.targets), field)
    aligned, absolute = (
        (root * p.reshape(len(root), -1)).reshape(-1, *field.shape[2:]) for p in parts
    )
    return aligned, absolute


def solve_in_order(first: Array, second: Array, first_rows: Array, second_rows: Array) -> Array:
    """Least-squares solution X of first X = first_rows, where ill-determined of the second system.

    A direction of X is determined by `first` if its effect there is at least DECIDED times its
    effect in `second`.
    """
    square = second.T @ second
    factor = np.linalg.cholesky(square)
    half = np.linalg.solve(factor, first.T)
    ratios, turned = np.linalg.eigh(half @ half.T)
    directions = np.linalg.solve(factor.T, turned)
    determined = ratios > DECIDED**2
    strong = directions[:, determined]
    result = strong @ np.linalg.lstsq(first @ strong, first_rows, rcond=None)[0]
    if not determined.all():
        weak = directions[:, ~determined]
        result = (
            result
            + weak @ np.linalg.lstsq(second @ weak, second_rows - second @ result, rcond=None)[0]
        )
    return np.asarray(result)
