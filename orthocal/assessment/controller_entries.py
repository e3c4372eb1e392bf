"""Offsets, backlash and errors of screws to enter into a controller that corrects nothing else.

The true offsets are not the best ones if legs and axes have errors, too: other offsets compensate
a part of them. The offsets to enter minimise the tool error over the workspace.

A backlash or a periodic error of a screw is entered if the readings determine it. Then it, or its
change, is larger than its expanded uncertainty, or entering it lowers the expected tool error. A
backlash alone, beside offsets that are kept, is entered by the rule for offsets (WORTH_ENTERING).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from orthocal.arrays import Array
from orthocal.assessment.calibrated_tool import CalibratedTool, find_tool
from orthocal.assessment.effect_limits import DETERMINED
from orthocal.calibration.assessment_record import BacklashEntry, ControllerEntry
from orthocal.calibration.calibration import Calibration, propagate_stds
from orthocal.calibration.records import ParameterEstimate
from orthocal.effects.compensation import Compensation, JointTrim
from orthocal.effects.loading import robot_effects
from orthocal.effects.screw import SCREW_COMPONENTS, Screw
from orthocal.robot.model import Robot

ALIGNED_SHARE = 1e-2
"""Ratio of aligned to absolute tool error below which the absolute error determines a combination
of offsets. Such offsets mainly translate and rotate the workspace."""

ENTERED_DECIMALS = 6
"""Decimals of an entered offset in m or rad: 1 µm, 1 µrad."""

WORTH_ENTERING = 0.05
"""Smallest relative reduction of the expected tool error for which offsets or a backlash alone are
entered, or a correction of all errors is recommended."""

ELLIPSE_FACTOR = math.sqrt(-2.0 * math.log(0.05)) / 1.96
"""Radius of the ellipse that contains 95 % of two estimates, relative to the expanded uncertainty
of one (1.25)."""

POSITIONS = 64
"""Positions over two turns at which a periodic error is fitted to a table."""

MAX_STEPS = 12
"""Largest number of Gauss-Newton steps."""

STEP_TOLERANCE = 1e-10
"""Step of the offsets at which the iteration ends, [m, rad]."""


def find_entries(calibration: Calibration) -> tuple[ControllerEntry, ...]:
    """Offsets to enter into a controller that corrects offsets only.

    These are the entries of the assessment: the offsets with the least tool error
    (`choose_offsets`), or the active ones if they are kept. Empty if no offset was identified.
    """
    if calibration.assessment is not None:
        return calibration.assessment.entries
    tool = find_tool(calibration)
    changes = backlash_changes(calibration, compute_backlash(calibration, tool))
    return compute_entries(calibration, tool and tool.compensating(changes))


def find_backlash(calibration: Calibration) -> tuple[BacklashEntry, ...]:
    """Backlash to enter for each drive, as recorded in the assessment; empty if there is none."""
    if calibration.assessment is not None:
        return calibration.assessment.backlash
    return compute_backlash(calibration, find_tool(calibration))


def backlash_changes(calibration: Calibration, entries: Sequence[BacklashEntry]) -> Array:
    """Changes of the backlash that the controller compensates, shape (n_drives,), [m, rad]."""
    changes = {e.drive: e.change for e in entries}
    return np.array([changes.get(d.name, 0.0) for d in calibration.robot.drives])


def compensation_to_enter(calibration: Calibration) -> Compensation:
    """Compensation of the controller with the backlash to enter.

    Empty if nothing changes, or if the controller has tables: an export replaces these.
    """
    changes = backlash_changes(calibration, find_backlash(calibration))
    has_tables = any(trim.table is not None for trim in calibration.session.compensation)
    if has_tables or not changes.any():
        return ()
    entered = np.round(calibration.compensated_backlash + changes, ENTERED_DECIMALS)
    return tuple(map(JointTrim, entered.tolist()))


def lowers(now: float, then: float) -> bool:
    """True if a change of the expected tool error, [m], is worth entering or correcting."""
    return not then > (1.0 - WORTH_ENTERING) * now


def compute_backlash(
    calibration: Calibration, tool: CalibratedTool | None
) -> tuple[BacklashEntry, ...]:
    """Compute the backlash to enter for each drive.

    Args:
        calibration: The calibration.
        tool: Its tool over the workspace; None if there is none.
    """
    by_name = {estimate.name: estimate for estimate in calibration.parameters}
    active = calibration.compensated_backlash.tolist()
    entries, changes = [], []
    for drive, active_backlash in zip(calibration.robot.drives, active, strict=True):
        name = f"{drive.name}.backlash"
        estimate = by_name.get(name)
        if estimate is None or not (estimate.free or estimate.value):
            continue
        value, stds = max(estimate.value, 0.0), (estimate.std, estimate.std_scatter)
        entry = BacklashEntry(drive.name, drive.unit, active_backlash, value, value, *stds)
        uncertainty = expanded_uncertainty(calibration, entry)
        determined = max(value, abs(value - active_backlash)) > uncertainty
        entries.append(entry)
        limited = readings_limit(calibration, name)
        changes.append(_Change({name: entry.change}, determined, limited))
    entering = _choose_changes(calibration, tool, changes)
    return tuple(e if enter else e.kept for e, enter in zip(entries, entering, strict=True))


def readings_limit(calibration: Calibration, *names: str) -> bool:
    """True if one of some parameters is known, or known better than before the readings."""
    estimates = [p for p in calibration.parameters if p.name in names]
    return any(not p.free or p.std < DETERMINED * p.prior_std for p in estimates)


class _Change(NamedTuple):
    """Change of what the controller corrects on one drive."""

    amounts: Mapping[str, float]
    """Parameter to its change, [SI]."""
    determined: bool
    """Whether the change is larger than its expanded uncertainty."""
    limited: bool
    """Whether the readings limit the change (`readings_limit`)."""


def _choose_changes(
    calibration: Calibration, tool: CalibratedTool | None, changes: Sequence[_Change]
) -> Sequence[bool]:
    """Decide which changes are entered: the determined ones, and others that lower the tool error.

    The smallest undetermined changes are omitted that together do not lower it enough. A change
    that the readings do not limit is an assumption and is never entered.

    Args:
        calibration: The calibration.
        tool: Its tool over the workspace; None if there is none.
        changes: Changes of the controller's correction.
    """
    entered = [change.limited for change in changes]
    omitted: dict[str, float] = {}
    undetermined = [i for i, c in enumerate(changes) if c.limited and not c.determined]
    for i in sorted(undetermined, key=lambda i: max(map(abs, changes[i].amounts.values()))):
        omitted |= changes[i].amounts
        if _changes_tool(calibration, tool, omitted):
            break
        entered[i] = False
    return entered


@dataclass(frozen=True, slots=True, eq=False)
class ScrewEntry:
    """Periodic error of a screw, A sin(2πρ/lead) + B cos(2πρ/lead), for a table."""

    drive: str
    active: Array
    """A and B that the controller corrects at present, shape (2,), [m]."""
    identified: Array
    """A and B of the identified machine, shape (2,), [m]."""
    enter: Array
    """A and B to enter, shape (2,), [m]: `active` if the change is undetermined."""
    uncertainty: float
    """Expanded uncertainty of the amplitude, [m]."""

    @property
    def change(self) -> Array:
        """Values to enter minus the active ones, shape (2,), [m]."""
        return self.enter - self.active

    @property
    def values(self) -> dict[str, float]:
        """Parameter to value to enter, [m]."""
        return _screw_parameters(self.drive, self.enter)


def find_screw_effect(robot: Robot) -> Screw | None:
    """Effect of periodic errors of a robot; None without any."""
    return next((e for e in robot_effects(robot) if isinstance(e, Screw)), None)


def find_screws(calibration: Calibration) -> tuple[ScrewEntry, ...]:
    """Periodic errors of screws to enter, by the rule for backlash; empty if there are none.

    An amplitude is determined if (A, B) is outside the ellipse that contains 95 % of the estimates
    around 0, or outside that around the active values.
    """
    robot = calibration.robot
    screw = find_screw_effect(robot)
    if screw is None:
        return ()
    errors, entries, changes = calibration.errors, [], []
    for drive, active in zip(robot.drives, _compensated_screws(calibration, screw), strict=True):
        names = [f"{drive.name}.{kind}" for kind in SCREW_COMPONENTS]
        identified = np.array([errors.get(name, 0.0) for name in names])
        if not (identified.any() or active.any()):
            continue
        uncertainty = _amplitude_uncertainty(calibration, names, identified)
        change_uncertainty = _amplitude_uncertainty(calibration, names, identified - active)
        entry = ScrewEntry(drive.name, active, identified, identified, uncertainty)
        amplitudes = np.linalg.norm([identified, identified - active], axis=1)
        limits = ELLIPSE_FACTOR * np.array([uncertainty, change_uncertainty])
        entries.append(entry)
        amounts = _screw_parameters(drive.name, entry.change)
        limited = readings_limit(calibration, *names)
        changes.append(_Change(amounts, bool((amplitudes > limits).any()), limited))
    entering = _choose_changes(calibration, find_tool(calibration), changes)
    return tuple(
        e if enter else replace(e, enter=e.active)
        for e, enter in zip(entries, entering, strict=True)
    )


def _screw_parameters(drive: str, values: Array) -> dict[str, float]:
    """Parameters A and B of the screw of a drive to their values, [m]."""
    return dict(zip((f"{drive}.{kind}" for kind in SCREW_COMPONENTS), values.tolist(), strict=True))


def _amplitude_uncertainty(
    calibration: Calibration, names: Sequence[str], amplitude: Array
) -> float:
    """Expanded uncertainty of A and B in the direction of an amplitude, [m].

    It is the radius of the ellipse wᵀ C⁻¹ w = k² in this direction; 0 if A and B are not free.
    """
    free = [p.name for p in calibration.free]
    columns = [free.index(name) for name in names if name in free]
    length = float(np.linalg.norm(amplitude))
    if len(columns) < len(names) or not length:
        return 0.0
    covariances = [c[np.ix_(columns, columns)] for c in calibration.error_covariances]
    direction = amplitude / length
    stds = propagate_stds(direction[None], covariances)[:, 0]
    # the ellipse is narrower than its projection
    radius = 1.0 / math.sqrt(float(direction @ np.linalg.solve(covariances[0], direction)))
    return float(calibration.expand(*(stds * radius / stds[0])))


def _compensated_screws(calibration: Calibration, screw: Screw) -> Array:
    """A and B that tables of the controller corrected while measuring, shape (n_drives, 2), [m]."""
    robot, amplitudes = calibration.robot, []
    for i, drive in enumerate(robot.drives):
        displayed = np.tile(robot.drive_zero, (POSITIONS, 1))
        if drive.unit == "m":
            displayed[:, i] += np.linspace(-screw.lead, screw.lead, POSITIONS)
        displacement = calibration.displacement(displayed)[:, i]
        phase = 2.0 * np.pi * (displayed[:, i] - calibration.active_offsets[i]) / screw.lead
        waves = np.column_stack([np.sin(phase), np.cos(phase), np.ones(POSITIONS)])
        amplitudes.append(-np.linalg.lstsq(waves, displacement, rcond=None)[0][:2])
    return np.array(amplitudes)


def expanded_uncertainty(calibration: Calibration, entry: ControllerEntry | BacklashEntry) -> float:
    """Expanded uncertainty of the best value to enter, [unit of the drive]."""
    if isinstance(entry, BacklashEntry):
        names = [p.name for p in calibration.free]
        halves = dict(zip(names, calibration.expanded_uncertainties.tolist(), strict=True))
        return float(halves.get(f"{entry.drive}.backlash", 0.0))
    return float(calibration.expand(entry.std, entry.std_scatter, entry.std_scaled))


def is_worth_changing(
    calibration: Calibration,
    entries: Sequence[BacklashEntry],
    now: float | None,
    then: float | None,
) -> bool:
    """True if the backlash is worth entering although the offsets are kept: the rule for offsets.

    Args:
        calibration: The calibration.
        entries: The backlash to enter.
        now: Tool error with the present backlash, [m]; None if unknown.
        then: Tool error with that to enter, [m]. If it is None, significance decides.
    """
    if now is not None and then is not None:
        return lowers(now, then)
    return any(abs(e.change) > expanded_uncertainty(calibration, e) for e in entries)


def _changes_tool(
    calibration: Calibration, tool: CalibratedTool | None, changes: Mapping[str, float]
) -> bool:
    """True if changes of the controller's correction lower the expected tool error enough.

    The tool error is computed to first order, as if all other errors were corrected.

    Args:
        calibration: The calibration.
        tool: Its tool over the workspace; None if there is none.
        changes: Parameter to its change, [SI].
    """
    names = [] if tool is None else list(tool.free)
    nonzero = {n: change for n, change in changes.items() if change}
    columns = [names.index(n) for n in nonzero if n in names]
    if tool is None or not columns or not np.isfinite(calibration.model_covariance).all():
        return False
    change = np.array([nonzero[names[i]] for i in columns])
    covariance = calibration.error_covariances[0]
    aligned, _ = weighted_fields(tool, tool.jacobian[:, :, : len(covariance)])
    uncertainty = math.sqrt(max(float(np.sum((aligned @ covariance) * aligned)), 0.0))
    deviation = float(np.linalg.norm(aligned[:, columns] @ change))
    return deviation > 0.0 and lowers(math.hypot(uncertainty, deviation), uncertainty)


def entered_offsets(
    calibration: Calibration, entries: Sequence[ControllerEntry] | None = None
) -> Array:
    """Offsets in the controller after the entries, shape (n_drives,), [m, rad]."""
    offsets = calibration.active_offsets
    names = [d.name for d in calibration.robot.drives]
    for entry in find_entries(calibration) if entries is None else entries:
        offsets[names.index(entry.drive)] = entry.enter
    return offsets


def offsets_to_enter(calibration: Calibration) -> Array:
    """Offsets in the controller after the entries as printed, shape (n_drives,), [m, rad]."""
    return np.asarray(entered_offsets(calibration).round(ENTERED_DECIMALS) + 0.0)


def compute_entries(
    calibration: Calibration, tool: CalibratedTool | None
) -> tuple[ControllerEntry, ...]:
    """Compute the offsets with the least tool error; all of them are to be entered.

    Args:
        calibration: The calibration.
        tool: Its tool over the workspace; None if there is none.
    """
    drives, weights = calibration.robot.drives, calibration.offset_weights
    parameters_of_drive = {
        i: [calibration.parameters[j] for j in np.flatnonzero(row).tolist()]
        for i, row in enumerate(weights)
        if row.any()
    }
    if not any(p.free for parts in parameters_of_drive.values() for p in parts):
        return ()
    identified, enter = calibration.offsets, calibration.active_offsets
    enter[list(parameters_of_drive)] = identified[list(parameters_of_drive)]
    free_weights = weights[:, [j for j, p in enumerate(calibration.parameters) if p.free]]
    covariances = calibration.error_covariances
    stds = propagate_stds(free_weights, covariances)
    if calibration.only_offsets:
        tool = None
    if tool is not None:
        enter, gain = choose_offsets(tool, enter, drives=list(parameters_of_drive))
        stds = propagate_stds(gain[:, : len(covariances[0])], covariances)
    active = calibration.session.controller_offsets
    return tuple(
        ControllerEntry(
            drive=drives[i].name,
            unit=drives[i].unit,
            active=None if active is None else active[i],
            identified=float(identified[i]),
            best=float(enter[i]),
            enter=float(enter[i]),
            std=float(stds[0, i]),
            std_scatter=float(stds[1, i]),
            std_scaled=float(stds[2, i]),
            held=_reason_held(parts[0]) if tool is None and len(parts) == 1 else None,
        )
        for i, parts in parameters_of_drive.items()
    )


def _reason_held(p: ParameterEstimate) -> Literal["known", "lower bound", "upper bound"] | None:
    """Reason why the readings do not determine a parameter; None if they do."""
    if not p.free:
        return "known"
    if p.at_bound is None:
        return None
    return "lower bound" if p.at_bound == "lower" else "upper bound"


def choose_offsets(
    tool: CalibratedTool, start: Array, *, drives: Sequence[int]
) -> tuple[Array, Array]:
    """Offsets with the least tool error after alignment of the workpiece.

    Combinations of offsets that mainly translate and rotate the workspace are determined by the
    absolute error. If a machine has no other errors, the result equals its true offsets.

    Args:
        tool: Tool of the calibrated machine; its parameters contain the offsets of the drives.
        start: Initial offsets, shape (n_drives,), [m, rad].
        drives: Indices of the drives whose offsets are chosen; the others are fixed.

    Returns:
        Offsets, shape (n_drives,), [m, rad], and their derivative with respect to the parameters,
        shape (n_drives, n_parameters), [SI].

    Raises:
        ClosureError: If the machine cannot reach a point with such offsets.
    """
    names, robot = list(tool.free), tool.sensitivities[0].robot
    rows = list(drives)
    columns = [names.index(f"{robot.drives[i].name}.offset") for i in rows]
    aligned, absolute = weighted_fields(tool, tool.jacobian)
    gain = np.zeros((len(start), len(names)))
    gain[rows] = solve_in_order(aligned[:, columns], absolute[:, columns], aligned, absolute)
    offsets = np.array(start, dtype=np.float64)
    for _ in range(MAX_STEPS):
        error = weighted_fields(tool, tool.deviation(offsets))
        step = solve_in_order(aligned[:, columns], absolute[:, columns], *error)
        offsets[rows] += step
        if np.abs(step).max() < STEP_TOLERANCE:
            break
    return offsets, gain


def weighted_fields(tool: CalibratedTool, field: Array) -> tuple[Array, Array]:
    """Weighted position errors, after alignment of the workpiece and absolute.

    The sum of squares of each array is the mean square over the workspace.

    Args:
        tool: Tool over a workspace of K points.
        field: Position errors or their derivatives, shape (K, 3, ...), [m].

    Returns:
        Two arrays of shape (3 K, ...), [m].
    """
    roots = np.sqrt(tool.workspace.weights)[:, None]
    fields = (tool.workspace.remove_motion(field, tool.targets), field)
    aligned, absolute = (
        (roots * f.reshape(len(roots), -1)).reshape(3 * len(roots), *f.shape[2:]) for f in fields
    )
    return aligned, absolute


def solve_in_order(first: Array, second: Array, first_rows: Array, second_rows: Array) -> Array:
    """Least-squares solution X of first X = first_rows.

    Directions that the first system determines poorly are solved from second X = second_rows: those
    whose effect in `first` is less than ALIGNED_SHARE times their effect in `second`.

    Args:
        first: Shape (m, n).
        second: Shape (m, n), of full rank.
        first_rows: Shape (m, ...).
        second_rows: Shape (m, ...).
    """
    factor = np.linalg.cholesky(second.T @ second)
    half = np.linalg.solve(factor, first.T)
    ratios, rotation = np.linalg.eigh(half @ half.T)
    directions = np.linalg.solve(factor.T, rotation)
    determined = ratios > ALIGNED_SHARE**2
    strong = directions[:, determined]
    solution = strong @ np.linalg.lstsq(first @ strong, first_rows, rcond=None)[0]
    if not determined.all():
        weak = directions[:, ~determined]
        solution = (
            solution
            + weak @ np.linalg.lstsq(second @ weak, second_rows - second @ solution, rcond=None)[0]
        )
    return np.asarray(solution)
