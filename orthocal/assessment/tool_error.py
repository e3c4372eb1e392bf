"""Tool error over the workspace, before and after a calibration.

A machine with errors θ, commanded to a posture, has its tool at p(θ). What is not known of θ
becomes a position error J dθ with J = ∂p/∂θ (`kinematics.sensitivity`).

Every figure is given three times: with shift and rotation taken out, which is what a workpiece sees
that is aligned on the machine; with the common shift taken out; and absolute
(`kinematics.workspace`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np

from orthocal.arguments import require_kind
from orthocal.arrays import Array
from orthocal.assessment.calibrated_tool import (
    CalibratedTool,
    error_covariance,
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
from orthocal.calibration.calibration import Calibration
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

MOST_POINTS = 5_000
"""Points that are assessed together; each takes 40 kB. `accuracy_rows` takes any number."""

DRAWS = 500
"""Errors drawn to find how large 95 % of the position errors are at most."""


@dataclass(frozen=True, eq=False)
class ErrorSize:
    """Size of position errors over a workspace, [m]."""

    rms: float
    """Root mean square over the points and the uncertainty."""
    largest: float
    """Largest error; for an uncertainty the root mean square at the worst point."""
    find_percentile: Callable[[], float] = field(repr=False)
    """How the next is found, which takes time."""

    @cached_property
    def percentile_95(self) -> float:
        """95 % quantile of the errors over all points."""
        return self.find_percentile()


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSizes:
    """Size of a field of position errors: aligned, relative and absolute."""

    aligned: ErrorSize | None
    """With shift and rotation removed; None if there are too few points."""
    relative: ErrorSize
    """With the mean translation removed."""
    absolute: ErrorSize

    @property
    def reported(self) -> ErrorSize:
        """The reported form: aligned, or relative where there are too few points."""
        return self.relative if self.aligned is None else self.aligned


@dataclass(frozen=True, slots=True, eq=False)
class ToolUncertainty:
    """Uncertainty of the tool's position over a set of points."""

    covariance: Array
    """Of the position at each point, shape (K, 3, 3), [m²]."""
    aligned_covariance: Array
    """Covariance at each point with shift and rotation removed, shape (K, 3, 3), [m²]."""
    sizes: ErrorSizes


@dataclass(frozen=True, slots=True, eq=False)
class ToolAccuracy:
    """Deviation and uncertainty of the tool position, before and after a calibration."""

    workspace: Workspace
    """The points, once for each of C conditions of use."""
    use: UseSamples
    """The conditions."""
    targets: Array
    """Commanded tool positions, shape (C K, 3), [m]."""
    names: tuple[str, ...]
    """Free, then unmodelled parameters."""
    jacobian: Array
    """∂p/∂θ at every point, shape (C K, 3, n), [m per parameter unit]."""
    deviation: Array
    """Actual minus commanded tool position with the active offsets, shape (C K, 3), [m]."""
    error_after_offsets: Array
    """The same with the offsets and the backlash to enter, in a controller that corrects nothing
    else."""
    before: ToolUncertainty
    """Uncertainty from the priors alone."""
    after: ToolUncertainty | None
    """Uncertainty after the calibration; None if the noise is unknown."""
    without_backlash: Array | None = None
    """The same with the offsets to enter, but not the backlash; None without backlash to enter."""
    unstated: Array | None = None
    """Error of a controller that corrects all errors without these conditions, shape (C K, 3), [m];
    None where they do not vary."""

    @property
    def points(self) -> Array:
        """The points once, shape (K, n_coordinates), [m]."""
        return self.workspace.points[: len(self.targets) // self.use.size]

    def average(self, field: Array) -> Array:
        """Mean of a field over the conditions of use, shape (K, ...)."""
        if self.use.size == 1:
            return field
        fields = field.reshape(self.use.size, -1, *field.shape[1:])
        return np.asarray(fields.mean(axis=0))

    def align(self, field: Array) -> Array:
        """A field of position errors with shift and rotation removed, shape (C K, 3, ...)."""
        return self.workspace.align(field, self.targets)

    def measure(self, deviations: Array) -> ErrorSizes:
        """Size of known position errors, shape (K, 3), [m]."""
        return measure_deviations(deviations, self.workspace, self.targets)


def measure_uncertainty(
    jacobian: Array, covariance: Array, workspace: Workspace, positions: Array
) -> ToolUncertainty:
    """Position uncertainty from sensitivities and the covariance of the parameters.

    Args:
        jacobian: ∂p/∂θ at every point, shape (K, 3, n), [m per parameter unit].
        covariance: Of θ, shape (n, n), [SI].
        workspace: The points, and the weights of their mean.
        positions: Of the points in space, shape (K, 3), [m].
    """
    fields = {
        "absolute": jacobian,
        "relative": workspace.remove_translation(jacobian),
        "aligned": workspace.remove_motion(jacobian, positions),
    }
    n = len(covariance)
    spread = {
        name: (j.reshape(-1, n) @ covariance).reshape(j.shape) @ j.transpose(0, 2, 1)
        for name, j in fields.items()
    }
    sizes = {name: _spread_size(c, workspace) for name, c in spread.items()}
    few = len(positions) < FEWEST_ALIGNED
    return ToolUncertainty(
        covariance=spread["absolute"],
        aligned_covariance=spread["relative" if few else "aligned"],
        sizes=ErrorSizes(None if few else sizes["aligned"], sizes["relative"], sizes["absolute"]),
    )


def measure_deviations(deviations: Array, workspace: Workspace, positions: Array) -> ErrorSizes:
    """Size of known position errors.

    Args:
        deviations: Shape (K, 3), [m].
        workspace: The points, and the weights of their mean.
        positions: Of the points in space, shape (K, 3), [m].
    """

    def size(field: Array) -> ErrorSize:
        lengths = np.linalg.norm(field, axis=1)
        return ErrorSize(
            rms=float(np.sqrt(workspace.weights @ lengths**2)),
            largest=float(lengths.max()),
            find_percentile=partial(_length_percentile, field, workspace),
        )

    few = len(positions) < FEWEST_ALIGNED
    return ErrorSizes(
        aligned=None if few else size(workspace.remove_motion(deviations, positions)),
        relative=size(workspace.remove_translation(deviations)),
        absolute=size(deviations),
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
    cause in the estimate. The uncertainty before is at the stated tolerances, that after it at the
    scaled ones.

    Args:
        calibration: The calibration.
        workspace: Tool positions that are commanded; by default the workspace.
        names: What to call the points in messages.
        conditions: Conditions of use in place of those that the robot's YAML states. Squared errors
            are averaged over all that remain.

    Raises:
        RobotError: If the robot has no tool centre point, or its drives do not command it.
        ClosureError: If the machine cannot reach a point, or no box of ±1 mm.
        ParameterError: If a condition is out of range, or nothing depends on it.
    """
    require_kind(calibration, Calibration, expected="a Calibration, such as load_calibration(...)")
    use = None
    if conditions is not None:
        conditions.require_valid(calibration.robot)
        use = sample_use(calibration.robot, conditions)
        use = use if use.varying else UseSamples((conditions,))
    if workspace is None:
        return assess_placed(calibration, require_tool(calibration, find_tool(calibration, use)))
    placed = place_tool(calibration, workspace, use, names=names)
    return assess_placed(calibration, placed, names=names)


def require_tool(calibration: Calibration, tool: CalibratedTool | None) -> CalibratedTool:
    """The tool over its workspace, which exists.

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
    """`assess_tool` over points whose tool is known, with entries that may be known."""
    unmodelled = calibration.unmodelled
    prior_stds = np.r_[[p.prior_std for p in calibration.free], unmodelled.prior_stds]
    free = tuple(tool.free[: len(prior_stds)])
    prior_stds /= calibration.tolerance_scale.factors(calibration.robot.parameters, free)
    jacobian = tool.jacobian[:, :, : len(prior_stds)]
    space, where = tool.workspace, tool.targets
    after = None
    if np.isfinite(calibration.model_covariance).all():
        after = measure_uncertainty(jacobian, error_covariance(calibration), space, where)
    offsets = entered_offsets(calibration, entries)
    entered = find_backlash(calibration) if backlash is None else backlash
    changes = backlash_changes(calibration, entered)
    deviation = tool.compensating(changes).deviation(offsets, names=names)
    without = read_only(tool.deviation(offsets, names=names)) if changes.any() else None
    return ToolAccuracy(
        workspace=space,
        use=tool.use,
        targets=where,
        names=free,
        jacobian=jacobian,
        deviation=read_only(tool.deviation(calibration.active_offsets, names=names)),
        error_after_offsets=read_only(deviation),
        before=measure_uncertainty(jacobian, np.diag(prior_stds**2), space, where),
        after=after,
        without_backlash=without,
        unstated=read_only(tool.deviation_unless_stated()) if tool.use.varying else None,
    )


def summarise_tool(calibration: Calibration, accuracy: ToolAccuracy) -> ToolErrorSummary | None:
    """Expected tool error now, with the offsets entered, and with all errors compensated.

    Each is the root of the sum of squares of the known deviation and of the uncertainty.

    Returns:
        None if nothing determines the noise.
    """
    if accuracy.after is None:
        return None
    known = accuracy.after.sizes
    compensated = known.reported.rms
    now, entered = (accuracy.measure(d) for d in (accuracy.deviation, accuracy.error_after_offsets))
    field, without = accuracy.without_backlash, None
    if field is not None:
        without = math.hypot(accuracy.measure(field).reported.rms, compensated)
    return ToolErrorSummary(
        box=tuple((float(low), float(high)) for low, high in accuracy.workspace.limits),
        coordinates=accuracy.workspace.letters,
        now=math.hypot(now.reported.rms, known.reported.rms),
        entered=math.hypot(entered.reported.rms, compensated),
        compensated=compensated,
        now_absolute=math.hypot(now.absolute.rms, known.absolute.rms),
        without_backlash=without,
        entered_absolute=math.hypot(entered.absolute.rms, known.absolute.rms),
        use=_summarise_use(calibration, accuracy, compensated),
    )


def _summarise_use(
    calibration: Calibration, accuracy: ToolAccuracy, compensated: float
) -> ToolUse | None:
    """Conditions of use of the tool error, and what each that varies contributes.

    Errors are nearly linear in the conditions, and a workpiece is aligned once for all of them. So
    the mean square is that of the mean conditions and of the change by each condition, which no
    alignment removes.
    """
    use, effects = accuracy.use.declared, effects_by_condition(calibration.robot)
    stated = stated_use(calibration.robot, use)
    if use is None or stated is None:
        return None
    covariance = error_covariance(calibration)
    weights = accuracy.use.size * accuracy.workspace.weights[: len(accuracy.points)]
    known, unknown = (
        accuracy.use.changes(v) for v in (accuracy.error_after_offsets, accuracy.jacobian)
    )
    parts = []
    for name, change in known.items():
        by = unknown[name]
        spread = np.einsum("k,fkin,nm,fkim->", weights, by, covariance, by, optimize=True)
        parts.append(
            UsePart(
                name,
                effects[name],
                known=math.sqrt(float(np.einsum("k,fki->", weights, change**2))),
                uncertain=math.sqrt(max(float(spread), 0.0)),
            )
        )
    unstated = (
        0.0 if accuracy.unstated is None else accuracy.measure(accuracy.unstated).reported.rms
    )
    return ToolUse(**stated, parts=tuple(parts), unstated=math.hypot(unstated, compensated))


def _spread_size(covariances: Array, workspace: Workspace) -> ErrorSize:
    """Sizes of normal errors with given covariances, shape (K, 3, 3), at the points."""
    mean_square = np.trace(covariances, axis1=1, axis2=2)
    return ErrorSize(
        rms=float(np.sqrt(workspace.weights @ mean_square)),
        largest=float(np.sqrt(mean_square.max())),
        find_percentile=partial(_drawn_percentile, covariances, workspace),
    )


def _length_percentile(field: Array, workspace: Workspace) -> float:
    """95 % quantile of the lengths of a field, shape (K, 3)."""
    parts, weights = workspace.interpolate_to_cells(field)
    return _weighted_percentile(np.linalg.norm(parts, axis=1), weights)


def _drawn_percentile(covariances: Array, workspace: Workspace) -> float:
    """95 % quantile of normal errors, by sampling; covariances have the shape (K, 3, 3)."""
    parts, weights = workspace.interpolate_to_cells(covariances)
    values, vectors = np.linalg.eigh(parts)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    draws = np.random.default_rng(0).normal(size=(3, DRAWS))
    lengths = np.linalg.norm(roots @ draws, axis=1)
    shares = np.broadcast_to(weights[:, None] / DRAWS, lengths.shape)
    return _weighted_percentile(lengths.reshape(-1), shares.reshape(-1))


def _weighted_percentile(lengths: Array, weights: Array) -> float:
    """95 % quantile by weight."""
    if weights.min() == weights.max():  # without sorting all
        return float(np.quantile(lengths, 0.95, method="inverted_cdf"))
    order = np.argsort(lengths)
    share = np.cumsum(weights[order])
    return float(lengths[order][min(int(np.searchsorted(share, 0.95)), lengths.size - 1)])
