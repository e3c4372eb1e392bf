"""Tool error over the workspace, before and after a calibration.

A machine with errors θ, commanded to a posture, has its tool at p(θ). An error dθ of the estimate
causes the position error J dθ with J = ∂p/∂θ (`kinematics.sensitivity`).

Statistics have three forms (`kinematics.workspace`):

- aligned: the best-fit translation and rotation are removed, as for a workpiece that is aligned on
  the machine;
- relative: the mean translation is removed;
- absolute.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from orthocal.arguments import require_kind
from orthocal.arrays import Array
from orthocal.assessment.calibrated_tool import (
    CalibratedTool,
    find_tool,
    place_tool,
)
from orthocal.assessment.controller_entries import (
    backlash_changes,
    entered_offsets,
    find_backlash,
)
from orthocal.calibration.assessment_record import (
    BacklashEntry,
    ControllerEntry,
    ToolErrorSummary,
    ToolUse,
    UsePart,
)
from orthocal.calibration.calibration import Calibration, require_calibration
from orthocal.io.fields import read_only
from orthocal.kinematics.conditions import (
    UseConditions,
    UseSamples,
    effects_by_condition,
    sample_use,
    stated_use,
)
from orthocal.kinematics.reachable_box import no_workspace_error
from orthocal.kinematics.workspace import FEWEST_ALIGNED, Workspace
from orthocal.robot.model import require_commanded_tool
from orthocal.statistics.information import square_root

MOST_POINTS = 5_000
"""Largest number of points that are assessed together; each needs 40 kB. `accuracy_rows` has no
limit."""

SAMPLES = 500
"""Monte Carlo samples per point for the 95 % quantile."""


@dataclass(frozen=True, slots=True, eq=False)
class ErrorStatistics:
    """Statistics of position errors over a workspace, [m]."""

    rms: float
    """RMS over the points, and over the distribution of uncertain errors."""
    largest: float
    """Largest error; for uncertain errors the RMS at the worst point."""
    find_percentile: Callable[[], float] = field(repr=False)
    """Function that computes `percentile_95`, which needs time."""

    @property
    def percentile_95(self) -> float:
        """95 % quantile over the points, and over the distribution of uncertain errors.

        For uncertain errors it can exceed `largest`, which is an RMS.
        """
        return self.find_percentile()

    def to_document(self) -> dict[str, float]:
        """Plain data for JSON, [m]."""
        return {"rms": self.rms, "percentile_95": self.percentile_95, "largest": self.largest}


@dataclass(frozen=True, slots=True, eq=False)
class ToolErrorStatistics:
    """Statistics of a field of position errors: aligned, relative and absolute."""

    aligned: ErrorStatistics | None
    """Statistics after removing the best-fit translation and rotation; None for too few points."""
    relative: ErrorStatistics
    """Statistics after removing the mean translation."""
    absolute: ErrorStatistics
    """Statistics without alignment."""

    @property
    def reported(self) -> ErrorStatistics:
        """Reported form: aligned, or relative if there are too few points."""
        return self.relative if self.aligned is None else self.aligned


@dataclass(frozen=True, slots=True, eq=False)
class ToolUncertainty:
    """Uncertainty of the tool position at K points under C conditions of use."""

    covariance: Array
    """Covariance of the absolute position at each point, shape (C K, 3, 3), [m²]."""
    aligned_covariance: Array
    """Covariance at each point in the reported form, shape (C K, 3, 3), [m²]."""
    sizes: ToolErrorStatistics


@dataclass(frozen=True, slots=True, eq=False)
class ToolAccuracy:
    """Deviation and uncertainty of the tool position, before and after a calibration.

    Arrays with C K rows hold the K points under each of C conditions of use.
    """

    workspace: Workspace
    """The C K points."""
    use: UseSamples
    """The C conditions."""
    targets: Array
    """Commanded tool positions, shape (C K, 3), [m]."""
    names: tuple[str, ...]
    """Names of the free parameters, then of the unmodelled ones."""
    jacobian: Array
    """∂p/∂θ at every point, shape (C K, 3, n), [m per parameter unit]."""
    deviation: Array
    """Actual minus commanded tool position with the active offsets, shape (C K, 3), [m]."""
    deviation_with_entries: Array
    """Actual minus commanded tool position with the offsets and the backlash to enter, shape
    (C K, 3), [m]. The controller corrects nothing else."""
    before: ToolUncertainty
    """Uncertainty from the priors alone."""
    after: ToolUncertainty | None
    """Uncertainty after the calibration; None if the noise is unknown."""
    deviation_without_backlash: Array | None = None
    """Actual minus commanded tool position with the offsets to enter and the present backlash,
    shape (C K, 3), [m]; None without backlash to enter."""
    deviation_ignoring_conditions: Array | None = None
    """Tool error if all errors are corrected for the reference conditions only, shape (C K, 3),
    [m]; None if the conditions do not vary."""

    @property
    def points(self) -> Array:
        """The K points, shape (K, n_coordinates), [m]."""
        return self.workspace.once(self.use.size).points

    def average(self, field: Array) -> Array:
        """Mean over the conditions of use, shape (K, ...) of a field of shape (C K, ...)."""
        if self.use.size == 1:
            return field
        fields = field.reshape(self.use.size, -1, *field.shape[1:])
        return np.asarray(fields.mean(axis=0))

    def align(self, field: Array) -> Array:
        """Field of position errors with the best-fit translation and rotation removed.

        Args:
            field: Position errors or their derivatives, shape (C K, 3, ...), [m].
        """
        return self.workspace.align(field, self.targets)

    def measure(self, deviations: Array) -> ToolErrorStatistics:
        """Statistics of position errors of shape (C K, 3), [m]."""
        return measure_deviations(deviations, self.workspace, self.targets)


def measure_uncertainty(
    jacobian: Array, covariance: Array, workspace: Workspace, positions: Array
) -> ToolUncertainty:
    """Uncertainty of positions from sensitivities and the covariance of the parameters.

    Args:
        jacobian: ∂p/∂θ at every point, shape (K, 3, n), [m per parameter unit].
        covariance: Covariance of θ, shape (n, n), [SI].
        workspace: The points and their weights.
        positions: Tool positions, shape (K, 3), [m].
    """

    def propagate(j: Array) -> Array:
        n = len(covariance)
        return (j.reshape(-1, n) @ covariance).reshape(j.shape) @ j.transpose(0, 2, 1)

    absolute, relative = propagate(jacobian), propagate(workspace.remove_translation(jacobian))
    aligned, sizes_aligned = relative, None
    if len(positions) >= FEWEST_ALIGNED:
        aligned = propagate(workspace.remove_motion(jacobian, positions))
        sizes_aligned = _normal_statistics(aligned, workspace)
    sizes = [_normal_statistics(c, workspace) for c in (relative, absolute)]
    return ToolUncertainty(absolute, aligned, ToolErrorStatistics(sizes_aligned, *sizes))


def measure_deviations(
    deviations: Array, workspace: Workspace, positions: Array
) -> ToolErrorStatistics:
    """Statistics of position errors.

    Args:
        deviations: Position errors, shape (K, 3), [m].
        workspace: The points and their weights.
        positions: Tool positions, shape (K, 3), [m].
    """

    def statistics(field: Array) -> ErrorStatistics:
        lengths = np.linalg.norm(field, axis=1)
        return ErrorStatistics(
            rms=float(np.sqrt(workspace.weights @ lengths**2)),
            largest=float(lengths.max()),
            find_percentile=partial(_length_percentile, field, workspace),
        )

    few = len(positions) < FEWEST_ALIGNED
    return ToolErrorStatistics(
        aligned=None if few else statistics(workspace.remove_motion(deviations, positions)),
        relative=statistics(workspace.remove_translation(deviations)),
        absolute=statistics(deviations),
    )


def assess_tool(
    calibration: Calibration,
    workspace: Workspace | None = None,
    *,
    names: Sequence[str] | None = None,
    conditions: UseConditions | None = None,
) -> ToolAccuracy:
    """Deviation and uncertainty of the tool position, before and after a calibration.

    Unmodelled errors contribute with their prior standard deviations, and with the bias that they
    cause in the estimate. `before` uses the stated tolerances, `after` the scaled ones.

    Args:
        calibration: The calibration.
        workspace: Commanded tool positions; by default the reachable workspace.
        names: Names of the points, for messages.
        conditions: Conditions of use in place of those that the robot's YAML states. Squared errors
            are averaged over conditions that are not stated here.

    Raises:
        RobotError: If the robot has no tool centre point, or its drives do not command it.
        ClosureError: If the machine cannot reach a point, or no box of ±1 mm.
        ParameterError: If a condition is out of range, or nothing depends on it.
        TypeError: If an argument is of another kind.
    """
    require_calibration(calibration)
    if workspace is not None:
        require_kind(workspace, Workspace, expected="a Workspace, such as Workspace.even(points)")
    use = None
    if conditions is not None:
        require_kind(conditions, UseConditions, expected="UseConditions(...)")
        conditions.require_valid(calibration.robot)
        use = sample_use(calibration.robot, conditions)
        if not use.varying:  # one sample: the stated conditions, also those that no effect needs
            use = UseSamples((conditions,))
    if workspace is None:
        return assess_placed(calibration, require_tool(calibration, find_tool(calibration, use)))
    placed = place_tool(calibration, workspace, use, names=names)
    return assess_placed(calibration, placed, names=names)


def require_tool(calibration: Calibration, tool: CalibratedTool | None) -> CalibratedTool:
    """Tool over its workspace; raises an error if there is none.

    Raises:
        RobotError: If the robot has no tool centre point, or its drives do not command it.
        ClosureError: If no box of ±1 mm can be reached.
    """
    require_commanded_tool(calibration.robot)
    if tool is None:
        raise no_workspace_error()
    return tool


def assess_placed(
    calibration: Calibration,
    tool: CalibratedTool,
    entries: Sequence[ControllerEntry] | None = None,
    backlash: Sequence[BacklashEntry] | None = None,
    *,
    names: Sequence[str] | None = None,
) -> ToolAccuracy:
    """Deviation and uncertainty of a tool, as `assess_tool` returns them.

    Args:
        calibration: The calibration.
        tool: Its tool at the points.
        entries: Offsets to enter; by default those of the assessment.
        backlash: Backlash to enter; by default that of the assessment.
        names: Names of the points, for messages.
    """
    unmodelled = calibration.unmodelled
    prior_stds = np.r_[[p.prior_std for p in calibration.free], unmodelled.prior_stds]
    # back to the stated tolerances
    prior_stds[calibration.scaled] /= calibration.tolerance_scale.factor
    jacobian = tool.jacobian[:, :, : len(prior_stds)]
    workspace, targets = tool.workspace, tool.targets
    after = None
    if np.isfinite(calibration.model_covariance).all():
        after = measure_uncertainty(jacobian, calibration.error_covariances[0], workspace, targets)
    offsets = entered_offsets(calibration, entries)
    backlash_entries = find_backlash(calibration) if backlash is None else backlash
    changes = backlash_changes(calibration, backlash_entries)
    deviation = tool.compensating(changes).deviation(offsets, names=names)
    deviation_without_backlash = None
    if changes.any():
        deviation_without_backlash = read_only(tool.deviation(offsets, names=names))
    deviation_ignoring_conditions = None
    if tool.use.varying:
        deviation_ignoring_conditions = read_only(tool.deviation_ignoring_conditions())
    return ToolAccuracy(
        workspace=workspace,
        use=tool.use,
        targets=targets,
        names=tuple(tool.free[: len(prior_stds)]),
        jacobian=jacobian,
        deviation=read_only(tool.deviation(calibration.active_offsets, names=names)),
        deviation_with_entries=read_only(deviation),
        before=measure_uncertainty(jacobian, np.diag(prior_stds**2), workspace, targets),
        after=after,
        deviation_without_backlash=deviation_without_backlash,
        deviation_ignoring_conditions=deviation_ignoring_conditions,
    )


def summarise_tool(calibration: Calibration, accuracy: ToolAccuracy) -> ToolErrorSummary | None:
    """Expected tool error now, with the entries, and with all identified errors corrected.

    Each is sqrt(deviation² + uncertainty²) in RMS; with all errors corrected the deviation is 0.

    Returns:
        None if the noise is unknown.
    """
    if accuracy.after is None:
        return None
    uncertainty = accuracy.after.sizes
    compensated, absolute = uncertainty.reported.rms, uncertainty.absolute.rms
    now, entered = (
        accuracy.measure(d) for d in (accuracy.deviation, accuracy.deviation_with_entries)
    )
    deviation, without_backlash = accuracy.deviation_without_backlash, None
    if deviation is not None:
        without_backlash = math.hypot(accuracy.measure(deviation).reported.rms, compensated)
    return ToolErrorSummary(
        box=tuple((float(low), float(high)) for low, high in accuracy.workspace.limits),
        coordinates=accuracy.workspace.letters,
        now=math.hypot(now.reported.rms, compensated),
        entered=math.hypot(entered.reported.rms, compensated),
        compensated=compensated,
        now_absolute=math.hypot(now.absolute.rms, absolute),
        without_backlash=without_backlash,
        entered_absolute=math.hypot(entered.absolute.rms, absolute),
        use=_summarise_use(calibration, accuracy, compensated),
    )


def _summarise_use(
    calibration: Calibration, accuracy: ToolAccuracy, compensated: float
) -> ToolUse | None:
    """Conditions of use of the tool error, and the contribution of each varying condition.

    Errors are nearly linear in the conditions, and the workpiece is aligned once for all of them.
    The mean square is therefore the sum of that at the mean conditions and of those of the changes
    by each condition, which alignment does not remove.
    """
    use, effects = accuracy.use.declared, effects_by_condition(calibration.robot)
    stated = stated_use(calibration.robot, use)
    if use is None or stated is None:
        return None
    covariance = calibration.error_covariances[0]
    weights = accuracy.workspace.once(accuracy.use.size).weights
    deviation_changes, jacobian_changes = (
        accuracy.use.changes(v) for v in (accuracy.deviation_with_entries, accuracy.jacobian)
    )
    parts = []
    for name, change in deviation_changes.items():
        j = jacobian_changes[name]
        # weighted mean over points k, summed over changes f, of the trace of J C Jᵀ
        variance = np.einsum("k,fkin,nm,fkim->", weights, j, covariance, j, optimize=True)
        parts.append(
            UsePart(
                name,
                effects[name],
                known=math.sqrt(float(np.einsum("k,fki->", weights, change**2))),
                uncertain=math.sqrt(max(float(variance), 0.0)),
            )
        )
    unstated, ignoring = 0.0, accuracy.deviation_ignoring_conditions
    if ignoring is not None:
        unstated = accuracy.measure(ignoring).reported.rms
    return ToolUse(**stated, parts=tuple(parts), unstated=math.hypot(unstated, compensated))


def _normal_statistics(covariances: Array, workspace: Workspace) -> ErrorStatistics:
    """Statistics of normal errors with mean 0 and covariances of shape (K, 3, 3), [m²]."""
    mean_square = np.trace(covariances, axis1=1, axis2=2)
    return ErrorStatistics(
        rms=float(np.sqrt(workspace.weights @ mean_square)),
        largest=float(np.sqrt(mean_square.max())),
        find_percentile=partial(_sampled_percentile, covariances, workspace),
    )


def _length_percentile(field: Array, workspace: Workspace) -> float:
    """95 % quantile of the lengths of position errors, shape (K, 3)."""
    errors, weights = workspace.interpolate_to_cells(field)
    return _weighted_percentile_95(np.linalg.norm(errors, axis=1), weights)


def _sampled_percentile(covariances: Array, workspace: Workspace) -> float:
    """95 % quantile of the lengths of normal errors by sampling; covariances (K, 3, 3)."""
    interpolated, weights = workspace.interpolate_to_cells(covariances)
    roots = square_root(interpolated)
    samples = np.random.default_rng(0).normal(size=(3, SAMPLES))
    lengths = np.linalg.norm(roots @ samples, axis=1)
    shares = np.broadcast_to(weights[:, None] / SAMPLES, lengths.shape)
    return _weighted_percentile_95(lengths.reshape(-1), shares.reshape(-1))


def _weighted_percentile_95(lengths: Array, weights: Array) -> float:
    """Weighted 95 % quantile."""
    differing = None if weights.min() == weights.max() else weights  # equal ones need no sorting
    return float(np.quantile(lengths, 0.95, method="inverted_cdf", weights=differing))
