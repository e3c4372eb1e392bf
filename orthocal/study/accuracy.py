"""Study of accuracy: random machines are measured by a plan and calibrated.

Each machine has random errors, its gauges have random mounting errors, and its readings are noisy
and rounded. The calibration may identify fewer errors than the machine has. Where it ignores
effects beside geometry that the machines have, each machine is also calibrated with these effects,
which says what ignoring them costs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from orthocal.arrays import Array
from orthocal.effects.loading import robot_effects
from orthocal.effects.registry import order_effects
from orthocal.errors import ClosureError, SessionError
from orthocal.estimation.choice import Choice, resolve_choice
from orthocal.estimation.selection import Selection
from orthocal.kinematics.reachable_box import find_workspace
from orthocal.kinematics.workspace import cube_limits
from orthocal.observation.observations import require_conditions
from orthocal.planning.expected_error import Expected, ToolForecast
from orthocal.robot.model import Robot
from orthocal.robot.parameters import Parameter, ParameterSet
from orthocal.session.session import Session
from orthocal.study.random_machines import CALIBRATED, RandomMachines
from orthocal.study.runner import StudyTable
from orthocal.study.study import Columns, Study, columns_in_edge_units, prepare_once
from orthocal.units import UM

PREDICTED_MACHINES = 60
"""Machines over which the prediction is averaged: the Jacobian differs from machine to machine."""


@dataclass(frozen=True, eq=False)
class AccuracyStudy(Study):
    """Random machines that are calibrated from the readings of a plan."""

    kind: ClassVar[str] = "accuracy"
    counted: ClassVar[str] = "machines"
    cases_per_task: ClassVar[int] = 100

    choice: Choice
    """Identified errors; the session's robot has the identified effects."""
    effects: tuple[str, ...]
    """Effects beside geometry that the machines have."""
    drawn: Mapping[str, float]
    """Names of the errors that are random, with their standard deviations, [SI]."""
    fixed: Mapping[str, float]
    """Errors that all machines have, [SI]."""
    machines: int
    seed: int
    box: tuple[tuple[float, float], ...]
    """Box over which the tool's error is computed, relative to the mechanical zero, [m]."""

    @property
    def count(self) -> int:
        """Number of machines."""
        return self.machines

    @property
    def ignored(self) -> tuple[str, ...]:
        """Effects that the machines have and the model ignores."""
        return tuple(e for e in self.effects if e not in self.session.robot.effect_names)

    def prepare(self) -> RandomMachines:
        """Machines, the models that identify them, and the workspace."""
        session = self._measured
        models = [(self.session, self.choice)]
        if self.ignored:
            models.append((self._with_ignored, replace(self.choice, effects=None)))
        return RandomMachines.of(
            session,
            _true_selection(self, session.robot),
            models,
            box=self.box,
            seed=self.seed,
            count=self.machines,
        )

    @property
    def _measured(self) -> Session:
        """The plan, of the robot with the effects of the machines."""
        return self.session.with_effects(self.effects)

    @property
    def _with_ignored(self) -> Session:
        """The plan, of the robot with identified and ignored effects."""
        return self.session.with_effects((*self.session.robot.effect_names, *self.ignored))

    def run(self, prepared: RandomMachines, task: int) -> Columns:
        """Errors of each machine before and after its calibration."""
        numbers = self.case_numbers(task)
        measured = prepared.measure(numbers)
        status, tool, model = measured.status, prepared.tool, prepared.model
        estimates = prepared.estimate(measured)
        before, after, *with_ignored = prepared.tool_errors(measured, estimates)
        theta = np.where((status == CALIBRATED)[:, None], estimates[0], np.nan)
        weights = tool.workspace.weights
        aligned, *others = (
            tool.workspace.align(f, tool.positions) for f in (after, before, *with_ignored)
        )

        def rms(field: Array) -> list[float]:
            return list(np.sqrt(weights @ (field**2).sum(axis=1)) / UM)

        true = model.identified_part(measured.errors, prepared.error_names)
        estimate = theta[:, : model.problem.n_machine]
        true_columns = columns_in_edge_units("true.", model.problem, true)
        error_columns = columns_in_edge_units("error.", model.problem, estimate - true)
        pairs = zip(true_columns.items(), error_columns.items(), strict=True)
        return {
            "machine": list(numbers),
            "status": list(status),
            "before_um": rms(others[0]),
            "tool_um": rms(aligned),
            **({"tool_all_effects_um": rms(others[1])} if self.ignored else {}),
            "tool_shift_out_um": rms(tool.workspace.remove_translation(after)),
            "tool_absolute_um": rms(after),
            "tool_worst_um": list(np.sqrt((aligned**2).sum(axis=1).max(axis=0)) / UM),
            **dict(column for pair in pairs for column in pair),
        }

    @cached_property
    def predicted(self) -> Expected | None:
        """Predicted tool error of such machines, from the covariance at a sample of them.

        Errors that are not identified count with their prior covariance. None where the model
        ignores an effect that changes a machine without errors, such as thermal expansion, or a
        gauge, such as drift.
        """
        session, p = self._with_ignored, prepare_once(self)
        effects = {e.name: e for e in robot_effects(session.robot)}
        if any(effects[n].setup_errors for n in self.ignored) or not p.alike_without_errors:
            return None
        selection = p.model.problem.machine_selection
        workspace = p.tool.workspace.once(p.tool.use.size)
        forecast = ToolForecast(
            session.robot, selection, workspace, use=p.tool.use, others=self.drawn
        )
        names = forecast.problem(session).free
        count = min(PREDICTED_MACHINES, self.machines)
        machines = [p.true_values(number, names) for number in range(count)]
        return forecast.after(session, weight=p.model.sigma, machines=machines)


def build_accuracy_study(
    session: Session,
    choice: Choice | str | None = None,
    *,
    effects: Sequence[str] | None = None,
    drawn: Sequence[str] | None = None,
    fixed: Mapping[str, float] | None = None,
    machines: int = 1000,
    seed: int = 0,
    half_side: float | None = None,
) -> AccuracyStudy:
    """A study of the tool error that the readings of a plan leave.

    The tool is used under the conditions that the robot's YAML states (`use`), by default from both
    sides of approach at the reference temperature.

    Args:
        session: The planned readings.
        choice: Identified errors, or the name of a model; default: the session's choice, or `full`.
            Its prior standard deviations also apply to the random errors. Its effects are those
            that are identified.
        effects: Effects beside geometry that the machines have; default: those that are identified.
        drawn: Names or globs of the random errors; default: all errors of the machine, or none if
            `fixed` is not empty.
        fixed: Errors that all machines have, [SI].
        machines: Number of machines.
        seed: Seed of errors, gauges and noise.
        half_side: Half the side of a cube around the mechanical zero over which the tool error is
            computed, [m]; by default the workspace of the robot.

    Raises:
        ParameterError: If a name or a number is invalid.
        SessionError: If the noise of a gauge is missing, or a condition that an effect needs.
        RobotError: If the drives do not command the tool.
    """
    chosen = resolve_choice(choice, session, default_model="full")
    if chosen.effects is not None:
        session = session.with_effects(chosen.effects)
    has = session.robot.effect_names if effects is None else order_effects(effects)
    measured = session.with_effects(has)
    robot, fixed = measured.robot, dict(fixed or {})
    parameters = robot.parameters
    names = _select_drawn(drawn, fixed, parameters)
    stated = parameters.read_tolerances(chosen.tolerances)
    stated = {n: std for glob, std in stated.items() for n in parameters.select([glob])}
    chosen = replace(chosen, effects=None, tolerances=_known_tolerances(chosen, session, measured))
    chosen.select(session.robot.parameters)
    _require_noise(session)
    require_conditions(measured, names)
    box = find_workspace(robot).limits if half_side is None else cube_limits(robot, half_side)
    return AccuracyStudy(
        session=session.with_values(np.zeros(len(session.readings))),
        choice=chosen,
        effects=tuple(has),
        drawn={n: stated.get(n, parameters[n].prior_std) for n in names},
        fixed=fixed,
        machines=machines,
        seed=seed,
        box=tuple((float(low), float(high)) for low, high in box),
    )


def _require_noise(session: Session) -> None:
    """Refuse a session with a gauge whose noise is not stated."""
    for name, gauge in session.gauges.items():
        if gauge.sigma is None:
            key = f"gauges.{name}.sigma_mm" if name else "gauge.sigma_mm"
            raise SessionError(
                "is missing: the study needs the noise of the gauge",
                where=key if session.path is None else f"{session.path}: {key}",
            )


def _known_tolerances(choice: Choice, session: Session, measured: Session) -> dict[str, float]:
    """Tolerances of a choice without those of effects that the model ignores."""
    ignored = set(measured.robot.parameters.names) - set(session.robot.parameters.names)
    result = {}
    for key, value in choice.tolerances.items():
        glob, _ = measured.robot.parameters.read_glob(key)
        if not set(measured.robot.parameters.select([glob])) <= ignored:
            result[key] = value
    return result


def _select_drawn(
    drawn: Sequence[str] | None, fixed: Mapping[str, float], parameters: ParameterSet
) -> tuple[str, ...]:
    """Names of the random errors, without sums of others and without fixed ones."""
    if drawn is None:
        drawn = () if fixed else parameters.patterns("full")
    names = _without_sums(parameters.select(drawn), parameters) if drawn else ()
    fixed_terms = {term for n in fixed for term, _ in parameters[n].terms}
    return tuple(n for n in names if not fixed_terms & {t for t, _ in parameters[n].terms})


def _without_sums(names: Sequence[str], parameters: ParameterSet) -> tuple[str, ...]:
    """Names without sums of errors that are in the list themselves, and would be drawn twice."""
    return tuple(
        n
        for n in names
        if len(parameters[n].terms) == 1 or not {t for t, _ in parameters[n].terms} & set(names)
    )


def _true_selection(study: AccuracyStudy, robot: Robot) -> Selection:
    """All errors of the machines: random ones with their priors, and fixed ones."""
    parameters = tuple(
        replace(robot.parameters[n], prior_std=std) for n, std in study.drawn.items()
    )
    n = len(parameters)
    return Selection(
        label="truth",
        parameters=parameters,
        prior=np.ones(n, dtype=np.bool_),
        mean=np.zeros(n),
        lower=np.full(n, -np.inf),
        upper=np.full(n, np.inf),
        fixed=study.fixed,
    )


@dataclass(frozen=True, slots=True, eq=False)
class EstimationError:
    """Error of the estimates of one parameter."""

    parameter: Parameter
    rms: float
    """[SI]"""
    standard_error: float
    """Sampling standard error of the RMS, [SI]."""
    predicted: float
    """Standard deviation from the covariance, [SI]."""
    relative: float
    """RMS divided by the prior standard deviation."""


@dataclass(frozen=True, slots=True, eq=False)
class AccuracySummary:
    """Summary of an accuracy study. Tool errors are aligned RMS errors unless stated."""

    machines: int
    """Number of calibrated machines."""
    failed: Mapping[str, int]
    """Reason to number of machines without a calibration."""
    before: float
    """[m]"""
    after: float
    """[m]"""
    standard_error: float
    """Sampling standard error of `after`, [m]."""
    percentile_95: float
    """95th percentile of the machines after calibration, [m]."""
    worst_point: float
    """Largest error in the workspace, RMS over the machines, [m]."""
    shift_removed: float
    """With the translation removed only, [m]."""
    absolute: float
    """[m]"""
    all_effects: float | None
    """With the effects identified that the model ignores, [m]; None if it ignores none."""
    cost_standard_error: float
    """Sampling standard error of `after` less `all_effects`, [m]."""
    predicted: Expected | None
    """None where nothing can be predicted."""
    parameters: tuple[EstimationError, ...]
    """Sorted by `relative`, largest first."""


def summarise_accuracy(study: AccuracyStudy, table: StudyTable) -> AccuracySummary:
    """Summary of the table of an accuracy study."""
    status = np.array(table.columns.get("status", []), dtype=object)
    good = status == CALIBRATED

    def column(name: str) -> Array:
        values = np.array(table.columns.get(name, []), dtype=np.float64)
        return values[good] if values.size else values

    def tool(name: str) -> tuple[float, float]:
        return _root_mean_square(column(name) * UM)

    try:
        predicted = study.predicted if good.any() else None
    except (ClosureError, np.linalg.LinAlgError):
        predicted = None
    errors = []
    selection = study.choice.select(study.session.robot.parameters)
    for i, p in enumerate(selection.parameters):
        values = column(f"error.{p.name}_{p.edge_unit}") / p.edge_factor
        rms, standard_error = _root_mean_square(values)
        std = np.nan if predicted is None else float(np.sqrt(predicted.covariance[i, i]))
        relative = rms / study.drawn.get(p.name, p.prior_std)
        errors.append(EstimationError(p, rms, standard_error, std, relative))
    after, standard_error = tool("tool_um")
    all_effects, cost_error = None, np.nan
    if study.ignored:
        all_effects, _ = tool("tool_all_effects_um")
        cost_error = _standard_error_of_difference(
            column("tool_um") * UM, column("tool_all_effects_um") * UM
        )
    return AccuracySummary(
        machines=int(good.sum()),
        failed={str(s): int((status == s).sum()) for s in sorted(set(status[~good]))},
        before=tool("before_um")[0],
        after=after,
        standard_error=standard_error,
        percentile_95=float(np.quantile(column("tool_um") * UM, 0.95)) if good.any() else np.nan,
        worst_point=tool("tool_worst_um")[0],
        shift_removed=tool("tool_shift_out_um")[0],
        absolute=tool("tool_absolute_um")[0],
        all_effects=all_effects,
        cost_standard_error=cost_error,
        predicted=predicted,
        parameters=tuple(sorted(errors, key=lambda e: -e.relative)),
    )


def _root_mean_square(values: Array) -> tuple[float, float]:
    """RMS of a sample and its standard error."""
    if not values.size:
        return np.nan, np.nan
    square = values**2
    rms = float(np.sqrt(square.mean()))
    if values.size < 2 or rms == 0.0:
        return rms, np.nan
    return rms, float(square.std(ddof=1) / np.sqrt(values.size) / (2.0 * rms))


def _standard_error_of_difference(one: Array, other: Array) -> float:
    """Standard error of the RMS of a sample less that of another of the same machines."""
    if one.size < 2:
        return np.nan
    # d(rms) = d(mean square)/(2 rms)
    ours, theirs = (v**2 / (2.0 * max(_root_mean_square(v)[0], 1e-15)) for v in (one, other))
    return float((ours - theirs).std(ddof=1) / np.sqrt(one.size))
