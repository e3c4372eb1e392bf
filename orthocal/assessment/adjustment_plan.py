"""Plan of mechanical adjustments: which feet, shims and threads to set, by how much.

The amounts a make the expected tool error least, with the offsets entered again afterwards. To
first order the deviation of the tool after alignment of the workpiece is

    d + A a − D x,   x = the offsets that leave least of it

with d the deviation of the calibrated machine. Its uncertainty U does not depend on a, but amounts
are set with errors, of which those of the lever arms are proportional to them. Least is

    |d + A a − D x|² + Σ |A_i|² s_i²(a_i) + U²,   s_i = `Adjustment.setting_std`

The fewest adjustments that bring the most come first: forward selection with exchange. Amounts are
rounded to what can be set. The loops of the adjusted machine are closed exactly before a figure is
reported.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import lsq_linear

from orthocal.arguments import require_kind
from orthocal.arrays import Array
from orthocal.assessment.assess import assessment_of
from orthocal.assessment.calibrated_tool import (
    CalibratedTool,
    error_covariance,
    find_tool,
    place_tool,
)
from orthocal.assessment.controller_entries import (
    backlash_changes,
    compute_entries,
    entered_offsets,
    find_backlash,
    solve_in_order,
    weigh_field,
)
from orthocal.assessment.tool_error import assess_placed, require_tool, summarise_tool
from orthocal.calibration.adjusting import adjust_calibration
from orthocal.calibration.assessment_record import ControllerEntry, ToolErrorSummary
from orthocal.calibration.calibration import Calibration
from orthocal.effects.adjustment import LEVER_SHARE, Adjustment, find_adjustments
from orthocal.errors import ParameterError, RobotError
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.statistics import chance

LEAST_GAIN = 0.04
"""Reduction of the expected tool error that a further adjustment must bring."""

WORTHWHILE = 0.15
"""Reduction of the expected tool error below which no adjustment is advised."""

MOST_ROUNDS = 5
"""Corrections of the amounts on the nonlinear machine."""

Judgement = Literal["worthwhile", "small gain", "uncertain gain"]
"""Whether adjusting is worth doing: the gain is large enough, and larger than its uncertainty."""


@dataclass(frozen=True, slots=True, eq=False)
class PlannedAdjustment:
    """An adjustment to set."""

    adjustment: Adjustment
    amount: float
    """Rounded to what can be set, [m]."""
    uncertainty: float
    """Expanded uncertainty of the best amount, [m]; NaN if unknown."""
    tool_error: float
    """Expected tool error after this and all adjustments before it, offsets entered again, [m]."""

    @property
    def turns(self) -> float | None:
        """Turns of its thread; None for shims."""
        pitch = self.adjustment.keys.pitch_mm
        return None if pitch is None else self.amount / (pitch * 1e-3)


@dataclass(frozen=True, slots=True, eq=False)
class AdjustmentPlan:
    """Mechanical adjustments of a calibrated machine, in their order."""

    adjustments: tuple[PlannedAdjustment, ...]
    """The one that brings the most comes first; empty if none brings LEAST_GAIN."""
    entries: tuple[ControllerEntry, ...]
    """Offsets to enter afterwards."""
    before: ToolErrorSummary
    """Expected tool error of the present machine."""
    after: ToolErrorSummary
    """Expected tool error after the adjustments."""
    moved_uncertainty: float
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
        moved = math.sqrt(self.before.entered**2 - self.after.entered**2)
        return (
            "worthwhile" if moved > chance.COVERAGE * self.moved_uncertainty else "uncertain gain"
        )


def plan_adjustments(
    calibration: Calibration, *, among: Sequence[str] | None = None
) -> AdjustmentPlan:
    """Mechanical adjustments that reduce the expected tool error of a calibrated machine most.

    Args:
        calibration: The calibration.
        among: Names of the adjustments that may be used; all by default.

    Raises:
        RobotError: If the robot declares no adjustments, or has no tool that its drives command.
        ParameterError: If the noise of the readings is unknown.
        ClosureError: If the machine cannot reach its workspace.
    """
    require_kind(calibration, Calibration, expected="a Calibration, such as load_calibration(...)")
    candidates = [
        a for a in find_adjustments(calibration.robot) if among is None or a.name in among
    ]
    if not candidates:
        raise RobotError(
            "declares no mechanical adjustments; add orthocal.adjustments and calibrate again",
            where=str(calibration.robot.yaml),
        )
    tool = require_tool(calibration, find_tool(calibration))
    before = assessment_of(calibration).tool
    if before is None:
        raise ParameterError(
            "the noise of the readings is unknown, and with it the expected tool error; read every "
            "posture twice, or state gauge.sigma_mm"
        )
    backlash = find_backlash(calibration)
    changes = backlash_changes(calibration, backlash)
    search = _Search(calibration, tool.compensating(changes), candidates, before.compensated)
    chosen = search.choose()
    amounts, after, entries = np.zeros(len(candidates)), before, assessment_of(calibration).entries
    for _ in range(MOST_ROUNDS if chosen else 0):
        improved = search.round(chosen, search.fit(chosen))
        if np.array_equal(improved, amounts):
            break
        amounts = improved
        adjusted = adjust_calibration(calibration, search.named(amounts))
        placed = place_tool(adjusted, tool.workspace.once(tool.use.size))
        entries = compute_entries(adjusted, placed.compensating(changes))
        accuracy = assess_placed(adjusted, placed, entries, backlash)
        summary = summarise_tool(adjusted, accuracy)
        after = summary or before
        search.correct(amounts, accuracy.error_after_offsets)
    return AdjustmentPlan(
        adjustments=search.order(chosen, amounts, after.entered),
        entries=entries,
        before=before,
        after=after,
        moved_uncertainty=search.moved_uncertainty(chosen),
    )


class _Search:
    """Choice of adjustments on the linearised machine, the effect of offsets projected out.

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
        under = (
            ToolSensitivity(robot, free=names, values=calibration.errors, conditions=c)
            for c in tool.use.conditions
        )
        field = np.concatenate([sensitivity(commanded) for sensitivity in under])
        self._by_offsets = weigh_field(tool, field[:, :, : len(offsets)])
        self.effects = self._without_offsets(field[:, :, len(offsets) :])
        self._deviate(self._without_offsets(tool.deviation(entered_offsets(calibration))))
        self.floor = floor
        self.largest = np.array([a.largest for a in candidates])
        self.steps = np.array([a.step for a in candidates])
        self._rounding = np.array([a.rounding_std for a in candidates])

    def _deviate(self, deviation: Array) -> None:
        """State the deviation without adjustments, shape (3 K,), [m].

        Lengths of |d + A a| follow from the triangle of [A d], which is much smaller.
        """
        triangle: Array = np.linalg.qr(np.column_stack([self.effects, deviation])).R
        self._columns, self._deviation = triangle[:, :-1], triangle[:, -1]
        self._sizes = np.linalg.norm(self._columns, axis=0)

    def _without_offsets(self, field: Array) -> Array:
        """Field after alignment and with the best offsets, shape (3 K, ...) of (K, 3, ...), [m]."""
        fields, offsets = weigh_field(self.tool, field), self._by_offsets
        if not offsets[0].size:
            return fields[0]
        return np.asarray(fields[0] - offsets[0] @ solve_in_order(*offsets, *fields))

    def named(self, amounts: Array) -> dict[str, float]:
        """Amounts that are not 0 by the names of the adjustments."""
        return {a.name: float(v) for a, v in zip(self.candidates, amounts, strict=True) if v != 0.0}

    def error(self, amounts: Array) -> float:
        """Expected tool error with given amounts, to first order, [m]."""
        deviation = self._deviation + self._columns @ amounts
        spread = np.hypot(self._rounding * (amounts != 0.0), LEVER_SHARE * amounts) * self._sizes
        return math.hypot(*(float(np.linalg.norm(v)) for v in (deviation, spread)), self.floor)

    def fit(self, chosen: Iterable[int]) -> Array:
        """Best amounts of some adjustments within their limits, shape (n_candidates,), [m]."""
        at, amounts = list(chosen), np.zeros(len(self.candidates))
        if at:
            limit = self.largest[at]
            rows = np.vstack([self._columns[:, at], np.diag(LEVER_SHARE * self._sizes[at])])
            right = np.append(-self._deviation, np.zeros(len(at)))
            amounts[at] = lsq_linear(rows * limit, right, (-1.0, 1.0)).x * limit
        return amounts

    def choose(self) -> list[int]:
        """Indices of the fewest adjustments that bring the most: forward selection, exchange."""
        chosen: list[int] = []
        current = self.error(self.fit(chosen))
        while True:
            others = [i for i in range(len(self.candidates)) if i not in chosen]
            for count in (1, 2):  # the two feet of a slide may bring something together only
                trials = [[*chosen, *more] for more in itertools.combinations(others, count)]
                if not trials:
                    return chosen
                best = min(trials, key=lambda t: self.error(self.fit(t)))
                if self.error(self.fit(best)) < (1.0 - LEAST_GAIN) ** count * current:
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
        """Amounts in whole steps; single steps are exchanged as long as the error decreases."""
        steps = self.steps
        most = np.floor(self.largest / steps * (1.0 + 1e-12))
        counts = np.clip(np.round(amounts / steps), -most, most)
        best, improved = self.error(counts * steps), True
        while improved:
            improved = False
            for i, change in itertools.product(chosen, (-1.0, 1.0)):
                trial = np.array(counts)
                trial[i] = np.clip(trial[i] + change, -most[i], most[i])
                error = self.error(trial * steps)
                if error < best * (1.0 - 1e-12):
                    counts, best, improved = trial, error, True
        return np.asarray(counts * steps)

    def correct(self, amounts: Array, exact: Array) -> None:
        """Move the linearised deviation so that it is exact for given amounts.

        Args:
            amounts: Shape (n_candidates,), [m].
            exact: Deviation of the machine with these amounts and the best offsets, shape (K, 3).
        """
        aligned, _ = weigh_field(self.tool, exact)
        self._deviate(aligned - self.effects @ amounts)

    def _gain(self, chosen: Sequence[int]) -> Array:
        """Derivative of the best amounts by the parameters, shape (n_chosen, n), [SI]."""
        n = len(self.calibration.free) + len(self.calibration.unmodelled.names)
        by_errors = self._without_offsets(self.tool.jacobian[:, :, :n])
        effects = self.effects[:, chosen]
        normal = effects.T @ effects + np.diag((LEVER_SHARE * self._sizes[chosen]) ** 2)
        return np.asarray(-np.linalg.solve(normal, effects.T @ by_errors))

    def _covariance(self) -> Array:
        return error_covariance(self.calibration)

    def uncertainties(self, chosen: Sequence[int]) -> Array:
        """Expanded uncertainty of the best amount of each adjustment, shape (n_chosen,), [m]."""
        gain = self._gain(chosen)
        scatter = gain[:, : len(self.calibration.free)]
        total, of_noise = (
            np.sqrt(np.maximum(np.diag(g @ c @ g.T), 0.0))
            for g, c in (
                (gain, self._covariance()),
                (scatter, self.calibration.noise_covariance),
            )
        )
        return self.calibration.expand(total, of_noise)

    def moved_uncertainty(self, chosen: Sequence[int]) -> float:
        """Standard deviation of the field by which the tool moves, RMS after alignment, [m]."""
        if not chosen:
            return 0.0
        moved = self.effects[:, chosen] @ self._gain(chosen)
        return math.sqrt(max(float(np.trace(moved @ self._covariance() @ moved.T)), 0.0))

    def order(
        self, chosen: Sequence[int], amounts: Array, after: float
    ) -> tuple[PlannedAdjustment, ...]:
        """The adjustments in the order of what they bring.

        Args:
            chosen: Indices of the adjustments.
            amounts: All amounts, shape (n_candidates,), [m].
            after: Expected tool error after all of them, [m].
        """
        if not chosen:
            return ()
        uncertainty: Mapping[int, float] = dict(
            zip(chosen, self.uncertainties(chosen).tolist(), strict=True)
        )
        pending = [i for i in chosen if amounts[i] != 0.0]
        at, planned = np.zeros_like(amounts), []
        while pending:
            trials = {
                i: self.error(np.where(np.arange(at.size) == i, amounts, at)) for i in pending
            }
            best = min(trials, key=trials.__getitem__)
            pending.remove(best)
            at[best] = amounts[best]
            error = trials[best] if pending else after
            planned.append(
                PlannedAdjustment(
                    self.candidates[best], float(amounts[best]), uncertainty[best], error
                )
            )
        return tuple(planned)
