"""Plan of mechanical adjustments: amounts by which to set feet, shims and threads.

The amounts a minimise the expected tool error with offsets x that are entered again afterwards:

    min over a, x of  |d + A a − D x|² + Σ |A_i|² s_i²(a_i) + U²,   s_i = `Adjustment.setting_std`

d + A a − D x is the deviation of the tool to first order, after alignment of the workpiece. d is
that of the calibrated machine, A and D are its derivatives with respect to amounts and offsets, and
A_i is a column of A. The uncertainty U of d does not depend on a. The amount i is set with the
standard error s_i; its part from the lever arms is proportional to a_i.

Forward selection with exchange finds few adjustments with a large gain. Amounts are rounded to
steps that can be set. Before figures are reported the loops of the adjusted machine are closed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import lsq_linear

from orthocal.arrays import Array
from orthocal.assessment.assess import assessment_of
from orthocal.assessment.calibrated_tool import (
    CalibratedTool,
    find_tool,
    place_tool,
)
from orthocal.assessment.controller_entries import (
    backlash_changes,
    compute_entries,
    entered_offsets,
    find_backlash,
    solve_in_order,
    weighted_fields,
)
from orthocal.assessment.tool_error import assess_placed, require_tool, summarise_tool
from orthocal.calibration.assessment_record import BacklashEntry, ControllerEntry, ToolErrorSummary
from orthocal.calibration.build_record import adjust_calibration
from orthocal.calibration.calibration import (
    Calibration,
    propagate_stds,
    require_calibration,
)
from orthocal.effects.adjustment import (
    LEVER_SHARE,
    Adjustment,
    find_adjustments,
    require_adjustment,
)
from orthocal.errors import ParameterError, RobotError
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.statistics import chance

LEAST_GAIN = 0.04
"""Relative reduction of the expected tool error below which no adjustment is proposed. It is also
at least LEAST_STEP, so that the printed tool error shows it."""

LEAST_STEP = 1e-6
"""Last digit of the printed tool errors, [m]."""

WORTHWHILE = 0.15
"""Relative reduction of the expected tool error below which no adjustment is advised."""

MAX_CORRECTIONS = 5
"""Largest number of corrections of the amounts on the nonlinear machine."""

Judgement = Literal["worthwhile", "small gain", "uncertain gain"]
"""Judgement of the gain: large enough, too small, or smaller than its uncertainty."""


@dataclass(frozen=True, slots=True, eq=False)
class PlannedAdjustment:
    """An adjustment to set."""

    adjustment: Adjustment
    amount: float
    """Amount, rounded to a multiple of the smallest step, [m]."""
    uncertainty: float
    """Expanded uncertainty of the best amount, [m]; NaN if unknown."""
    tool_error: float | None
    """Expected tool error after this and all adjustments before it, offsets entered again, [m].
    None if it is lower only with the next adjustment, too (`is_gain`)."""

    @property
    def turns(self) -> float | None:
        """Turns of its thread; None for shims."""
        pitch = self.adjustment.keys.pitch_mm
        return None if pitch is None else self.amount / (pitch * 1e-3)


@dataclass(frozen=True, slots=True, eq=False)
class AdjustmentPlan:
    """Mechanical adjustments of a calibrated machine, in the order in which to set them."""

    adjustments: tuple[PlannedAdjustment, ...]
    """The adjustment with the largest gain comes first; empty if no gain reaches LEAST_GAIN."""
    entries: tuple[ControllerEntry, ...]
    """Offsets to enter afterwards."""
    before: ToolErrorSummary
    """Expected tool error of the present machine."""
    after: ToolErrorSummary
    """Expected tool error after the adjustments."""
    displacement_uncertainty: float
    """Uncertainty of the displacement of the tool, RMS after alignment, one σ, [m]."""

    @property
    def gain(self) -> float:
        """Reduction of the expected tool error with offsets entered, 0 to 1."""
        return 1.0 - self.after.entered / self.before.entered

    @property
    def amounts(self) -> dict[str, float]:
        """Adjustment to its amount, [m]."""
        return {p.adjustment.name: p.amount for p in self.adjustments}

    @property
    def judgement(self) -> Judgement:
        """Judgement of the gain by the adjustments."""
        if self.gain < WORTHWHILE:
            return "small gain"
        removed = math.sqrt(self.before.entered**2 - self.after.entered**2)
        significant = removed > chance.COVERAGE * self.displacement_uncertainty
        return "worthwhile" if significant else "uncertain gain"


def plan_adjustments(
    calibration: Calibration, *, among: Sequence[str] | None = None
) -> AdjustmentPlan:
    """Plan the mechanical adjustments that reduce the expected tool error most.

    Args:
        calibration: The calibration.
        among: Names of the adjustments that may be used; all by default.

    Raises:
        RobotError: If the robot declares no adjustments, or has no tool that its drives command.
        ParameterError: If no name or an unknown one is stated, or the noise of the readings is
            unknown.
        ClosureError: If the machine cannot reach its workspace.
    """
    require_calibration(calibration)
    for name in among or ():
        require_adjustment(calibration.robot, name, where="among", error=ParameterError)
    declared = find_adjustments(calibration.robot)
    if not declared:
        raise RobotError(
            "declares no mechanical adjustments; add orthocal.adjustments and calibrate again",
            where=str(calibration.robot.yaml),
        )
    candidates = [a for a in declared if among is None or a.name in among]
    if not candidates:
        raise ParameterError("names no adjustment; expected one or several", where="among")
    tool = require_tool(calibration, find_tool(calibration))
    before = assessment_of(calibration).tool
    if before is None:
        raise ParameterError(
            "the noise of the readings is unknown, and with it the expected tool error; read every "
            "posture twice, or state sigma_mm of each gauge"
        )
    backlash = find_backlash(calibration)
    changes = backlash_changes(calibration, backlash)
    search = _Search(calibration, tool.compensating(changes), candidates, before.compensated)
    chosen = search.choose()
    while True:
        amounts, after, entries = _set_amounts(search, chosen, before, backlash)
        adjustments = search.order(chosen, amounts, before.entered, after.entered)
        if not adjustments or adjustments[-1].tool_error is not None:
            break
        last = candidates.index(adjustments[-1].adjustment)  # then the others are fitted again
        chosen = [i for i in chosen if i != last]
    return AdjustmentPlan(
        adjustments=adjustments,
        entries=entries,
        before=before,
        after=after,
        displacement_uncertainty=search.displacement_uncertainty(chosen),
    )


def _set_amounts(
    search: _Search,
    chosen: Sequence[int],
    before: ToolErrorSummary,
    backlash: Sequence[BacklashEntry],
) -> tuple[Array, ToolErrorSummary, tuple[ControllerEntry, ...]]:
    """Amounts of chosen adjustments, with the tool error and the offsets of the adjusted machine.

    The loops of the adjusted machine are closed, and the amounts are corrected for it.
    """
    calibration, tool = search.calibration, search.tool
    changes = backlash_changes(calibration, backlash)
    amounts = np.zeros(len(search.candidates))
    after, entries = before, assessment_of(calibration).entries
    for _ in range(MAX_CORRECTIONS if chosen else 0):
        improved = search.round(chosen, search.fit(chosen))
        if np.array_equal(improved, amounts):
            break
        amounts = improved
        adjusted = adjust_calibration(calibration, search.named(amounts))
        placed = place_tool(adjusted, tool.workspace.once(tool.use.size))
        entries = compute_entries(adjusted, placed.compensating(changes))
        accuracy = assess_placed(adjusted, placed, entries, backlash)
        after = summarise_tool(adjusted, accuracy) or before
        search.correct(amounts, accuracy.deviation_with_entries)
    return amounts, after, entries


def is_gain(before: float, after: float, count: int = 1) -> bool:
    """True if `count` adjustments lower the expected tool error, [m], enough to be proposed."""
    return after < min((1.0 - LEAST_GAIN) ** count * before, before - count * LEAST_STEP)


class _Search:
    """Choice of adjustments on the linearised machine with the best offsets.

    Args:
        calibration: The calibration.
        tool: Its tool over the workspace.
        candidates: Adjustments that may be chosen.
        floor: Expected tool error if all identified errors were corrected, [m].
    """

    def __init__(
        self,
        calibration: Calibration,
        tool: CalibratedTool,
        candidates: Sequence[Adjustment],
        floor: float,
    ) -> None:
        self.calibration, self.tool, self.candidates = calibration, tool, candidates
        robot, drives = calibration.robot, calibration.robot.drives
        offset_columns = np.flatnonzero(calibration.offset_weights.any(axis=1)).tolist()
        offsets = [f"{drives[i].name}.offset" for i in offset_columns]
        names = [*offsets, *(a.parameter for a in candidates)]
        commanded = tool.drives - calibration.active_offsets
        sensitivities = (
            ToolSensitivity(robot, free=names, values=calibration.errors, conditions=c)
            for c in tool.use.conditions
        )
        field = np.concatenate([sensitivity(commanded) for sensitivity in sensitivities])
        self._offset_effects = weighted_fields(tool, field[:, :, : len(offsets)])
        self.effects = self._without_offsets(field[:, :, len(offsets) :])
        self._set_deviation(self._without_offsets(tool.deviation(entered_offsets(calibration))))
        self.floor = floor
        self.max_amounts = np.array([a.largest for a in candidates])
        self.steps = np.array([a.step for a in candidates])
        self._rounding = np.array([a.rounding_std for a in candidates])

    def _set_deviation(self, deviation: Array) -> None:
        """Set the deviation without adjustments, shape (3 K,), [m].

        The lengths |d + A a| are computed from the R factor of [A d], which is much smaller.
        """
        r_factor: Array = np.linalg.qr(np.column_stack([self.effects, deviation])).R
        self._columns, self._deviation = r_factor[:, :-1], r_factor[:, -1]
        self._column_norms = np.linalg.norm(self._columns, axis=0)

    def _without_offsets(self, field: Array) -> Array:
        """Field after alignment and with the best offsets, shape (3 K, ...) of (K, 3, ...), [m]."""
        weighted, offset_effects = weighted_fields(self.tool, field), self._offset_effects
        offsets = solve_in_order(*offset_effects, *weighted)
        return np.asarray(weighted[0] - offset_effects[0] @ offsets)

    def named(self, amounts: Array) -> dict[str, float]:
        """Adjustment to its amount, [m], for amounts that are not 0."""
        return {a.name: float(v) for a, v in zip(self.candidates, amounts, strict=True) if v != 0.0}

    def error(self, amounts: Array) -> float:
        """Expected tool error after adjustments, to first order, [m].

        Args:
            amounts: Shape (n_candidates,), [m].
        """
        deviation = self._deviation + self._columns @ amounts
        setting_errors = (
            np.hypot(self._rounding * (amounts != 0.0), LEVER_SHARE * amounts) * self._column_norms
        )
        return math.hypot(
            *(float(np.linalg.norm(v)) for v in (deviation, setting_errors)), self.floor
        )

    def fit(self, chosen: Iterable[int]) -> Array:
        """Best amounts of some adjustments within their limits, shape (n_candidates,), [m]."""
        columns, amounts = list(chosen), np.zeros(len(self.candidates))
        if columns:
            limit = self.max_amounts[columns]
            rows = np.vstack(
                [self._columns[:, columns], np.diag(LEVER_SHARE * self._column_norms[columns])]
            )
            right = np.append(-self._deviation, np.zeros(len(columns)))
            # the tolerance of lsq_linear is absolute
            unit = max(float(np.linalg.norm(right)), LEAST_STEP)
            amounts[columns] = lsq_linear(rows * limit / unit, right / unit, (-1.0, 1.0)).x * limit
        return amounts

    def choose(self) -> list[int]:
        """Indices of the adjustments to set, by forward selection with exchange."""
        chosen: list[int] = []
        current = self.error(self.fit(chosen))
        while True:
            others = [i for i in range(len(self.candidates)) if i not in chosen]
            for count in (1, 2):  # the two feet of a slide may have a gain only together
                trials = [[*chosen, *more] for more in itertools.combinations(others, count)]
                if not trials:
                    return chosen
                best = min(trials, key=lambda t: self.error(self.fit(t)))
                if is_gain(current, self.error(self.fit(best)), count):
                    break
            else:
                return chosen
            chosen = self._exchange(best)
            current = self.error(self.fit(chosen))

    def _exchange(self, chosen: list[int]) -> list[int]:
        """Replace single adjustments by others as long as the error decreases."""
        best = self.error(self.fit(chosen))
        improved = True
        while improved:
            improved = False
            for k, other in itertools.product(range(len(chosen)), range(len(self.candidates))):
                if other in chosen:
                    continue
                trial = [*chosen[:k], other, *chosen[k + 1 :]]
                error = self.error(self.fit(trial))
                if error < best * (1.0 - 1e-9):
                    chosen, best, improved = trial, error, True
        return chosen

    def round(self, chosen: Sequence[int], amounts: Array) -> Array:
        """Amounts in whole steps, changed by single steps as long as the error decreases."""
        steps = self.steps
        max_counts = np.floor(self.max_amounts / steps * (1.0 + 1e-12))
        counts = np.clip(np.round(amounts / steps), -max_counts, max_counts)
        best, improved = self.error(counts * steps), True
        while improved:
            improved = False
            for i, change in itertools.product(chosen, (-1.0, 1.0)):
                trial = np.array(counts)
                trial[i] = np.clip(trial[i] + change, -max_counts[i], max_counts[i])
                error = self.error(trial * steps)
                if error < best * (1.0 - 1e-12):
                    counts, best, improved = trial, error, True
        return np.asarray(counts * steps)

    def correct(self, amounts: Array, exact: Array) -> None:
        """Shift the linearised deviation so that it is exact for these amounts.

        Args:
            amounts: Shape (n_candidates,), [m].
            exact: Deviation of the machine with these amounts and the best offsets, shape (K, 3),
                [m].
        """
        aligned, _ = weighted_fields(self.tool, exact)
        self._set_deviation(aligned - self.effects @ amounts)

    def _gain(self, chosen: Sequence[int]) -> Array:
        """Derivative of the best amounts with respect to the errors, shape (n_chosen, n), [SI]."""
        n = len(self.calibration.free) + len(self.calibration.unmodelled.names)
        error_effects = self._without_offsets(self.tool.jacobian[:, :, :n])
        effects = self.effects[:, chosen]
        normal = effects.T @ effects + np.diag((LEVER_SHARE * self._column_norms[chosen]) ** 2)
        return np.asarray(-np.linalg.solve(normal, effects.T @ error_effects))

    def uncertainties(self, chosen: Sequence[int]) -> Array:
        """Expanded uncertainties of the best amounts, shape (n_chosen,), [m]."""
        stds = propagate_stds(self._gain(chosen), self.calibration.error_covariances)
        return self.calibration.expand(*stds)

    def displacement_uncertainty(self, chosen: Sequence[int]) -> float:
        """Standard deviation of the displacement of the tool, RMS after alignment, [m]."""
        if not chosen:
            return 0.0
        displacement = self.effects[:, chosen] @ self._gain(chosen)
        stds = propagate_stds(displacement, self.calibration.error_covariances[:1])
        return float(np.linalg.norm(stds))

    def order(
        self, chosen: Sequence[int], amounts: Array, before: float, after: float
    ) -> tuple[PlannedAdjustment, ...]:
        """Adjustments in the order of their gain.

        Args:
            chosen: Indices of the adjustments.
            amounts: All amounts, shape (n_candidates,), [m].
            before: Expected tool error without them, [m].
            after: Expected tool error after all of them, [m].
        """
        if not chosen:
            return ()
        uncertainty = dict(zip(chosen, self.uncertainties(chosen).tolist(), strict=True))
        pending = [i for i in chosen if amounts[i] != 0.0]
        amounts_set, planned, shown = np.zeros_like(amounts), [], before
        while pending:
            trials = {
                i: self.error(np.where(np.arange(amounts_set.size) == i, amounts, amounts_set))
                for i in pending
            }
            best = min(trials, key=trials.__getitem__)
            pending.remove(best)
            amounts_set[best] = amounts[best]
            tool_error = trials[best] if pending else after
            gains = is_gain(shown, tool_error)
            shown = tool_error if gains else shown
            planned.append(
                PlannedAdjustment(
                    self.candidates[best],
                    float(amounts[best]),
                    uncertainty[best],
                    tool_error if gains else None,
                )
            )
        return tuple(planned)
