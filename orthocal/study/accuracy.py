"""Study of accuracy: random machines are measured by a plan and calibrated.

Machines have random errors, gauges have random mounting errors, and readings are noisy and rounded.
The calibration may identify fewer errors than the machine has. If it ignores effects of the
machines beside geometry, each machine is also calibrated with these effects. The comparison shows
the cost of ignoring them.
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
from orthocal.errors import ClosureError
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
from orthocal.study.study import Columns, Study, columns_in_edge_units, prepare_once, require_counts
from orthocal.units import UM

PREDICTED_MACHINES = 60
"""Number of machines over which the prediction is averaged, because their Jacobians differ."""


@dataclass(frozen=True, eq=False)
class AccuracyStudy(Study):
    """Random machines that are calibrated from the readings of a plan."""

    kind: ClassVar[str] = "accuracy"
    counted: ClassVar[str] = "machines"
    cases_per_task: ClassVar[int] = 100

    choice: Choice
    """Identified errors. The identified effects are those of the session's robot."""
    effects: tuple[str, ...]
    """Effects beside geometry that the machines have."""
    drawn: Mapping[str, float]
    """Random errors and their standard deviations, [SI]."""
    fixed: Mapping[str, float]
    """Errors that all machines have, [SI]."""
    machines: int
    seed: int
    box: tuple[tuple[float, float], ...]
    """Box over which the tool error is computed, relative to the mechanical zero, [m]."""

    @property
    def count(self) -> int:
        """Number of machines."""
        return self.machines

    @property
    def ignored(self) -> tuple[str, ...]:
        """Effects that the machines have and the model ignores."""
        return tuple(e for e in self.effects if e not in self.session.robot.effect_names)

    def prepare(self) -> RandomMachines:
        """Random machines, the models that identify them, and the workspace."""
        session = self.session.with_effects(self.effects)
        models = [(self.session, self.choice)]
        if self.ignored:
            models.append((self._session_with_ignored, replace(self.choice, effects=None)))
        return RandomMachines.of(
            session,
            _true_selection(self, session.robot),
            models,
            box=self.box,
            seed=self.seed,
            count=self.machines,
        )

    @property
    def _session_with_ignored(self) -> Session:
        """Plan with identified and ignored effects."""
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
        aligned, *other_fields = (
            tool.workspace.align(f, tool.positions) for f in (after, before, *with_ignored)
        )

        def rms(field: Array) -> list[float]:
            return list(np.sqrt(weights @ (field**2).sum(axis=1)) / UM)

        true_values = model.identified_part(measured.errors, prepared.error_names)
        estimated_values = theta[:, : model.problem.n_machine]
        true_columns = columns_in_edge_units("true.", model.problem, true_values)
        error_columns = columns_in_edge_units(
            "error.", model.problem, estimated_values - true_values
        )
        pairs = zip(true_columns.items(), error_columns.items(), strict=True)
        return {
            "machine": list(numbers),
            "status": list(status),
            "before_um": rms(other_fields[0]),
            "tool_um": rms(aligned),
            **({"tool_all_effects_um": rms(other_fields[1])} if self.ignored else {}),
            "tool_shift_out_um": rms(tool.workspace.remove_translation(after)),
            "tool_absolute_um": rms(after),
            "tool_worst_um": list(np.sqrt((aligned**2).sum(axis=1).max(axis=0)) / UM),
            **dict(column for pair in pairs for column in pair),
        }

    @cached_property
    def predicted(self) -> Expected | None:
        """Predicted tool error of the machines, from the covariance at a sample of them.

        Errors that are not identified contribute their prior covariance. None if the model ignores
        an effect that acts without errors of the machine, such as thermal expansion, or on gauges,
        such as drift.
        """
        session, prepared = self._session_with_ignored, prepare_once(self)
        effects = {e.name: e for e in robot_effects(session.robot)}
        if any(effects[n].setup_errors for n in self.ignored) or not prepared.equal_without_errors:
            return None
        selection = prepared.model.problem.machine_selection
        workspace = prepared.tool.workspace.once(prepared.tool.use.size)
        forecast = ToolForecast(
            session.robot, selection, workspace, use=prepared.tool.use, others=self.drawn
        )
        names = forecast.problem(session).free
        count = min(PREDICTED_MACHINES, self.machines)
        machines = [prepared.true_values(number, names) for number in range(count)]
        return forecast.after(session, weights=prepared.model.weights, machines=machines)


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
    """Build a study of the tool error after a calibration from the readings of a plan.

    The tool is used under the conditions that the robot's YAML states (`use`), by default with both
    sides of approach at the reference temperature.

    Args:
        session: The planned readings.
        choice: Identified errors, or the name of a model; default: the session's choice, or `full`.
            Its prior standard deviations also apply to the random errors. Its effects are the
            identified ones.
        effects: Effects beside geometry that the machines have; default: the identified ones.
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
    require_counts(machines=machines)
    chosen = resolve_choice(choice, session, default_model="full")
    if chosen.effects is not None:
        session = session.with_effects(chosen.effects)
    machine_effects = session.robot.effect_names if effects is None else order_effects(effects)
    plan = session.with_effects(machine_effects)
    robot, fixed = plan.robot, dict(fixed or {})
    parameters = robot.parameters.with_tolerances(chosen.tolerances)
    names = _select_drawn(drawn, fixed, parameters)
    chosen = replace(chosen, effects=None, tolerances=_tolerances_of_model(chosen, session, plan))
    chosen.select(session.robot.parameters)
    silent = [name for name, gauge in session.gauges.items() if gauge.sigma is None]
    session.refuse_missing(silent, "sigma_mm", ": the study needs the noise of the gauge")
    require_conditions(plan, names)
    box = find_workspace(robot).limits if half_side is None else cube_limits(robot, half_side)
    return AccuracyStudy(
        session=session.with_values(np.zeros(len(session.readings))),
        choice=chosen,
        effects=tuple(machine_effects),
        drawn={n: parameters[n].prior_std for n in names},
        fixed=fixed,
        machines=machines,
        seed=seed,
        box=tuple((float(low), float(high)) for low, high in box),
    )


def _tolerances_of_model(choice: Choice, session: Session, measured: Session) -> dict[str, float]:
    """Tolerances of a choice without those for effects that the model ignores."""
    ignored = set(measured.robot.parameters.names) - set(session.robot.parameters.names)
    tolerances = {}
    for key, value in choice.tolerances.items():
        glob, _ = measured.robot.parameters.read_glob(key)
        if not set(measured.robot.parameters.select([glob])) <= ignored:
            tolerances[key] = value
    return tolerances


def _select_drawn(
    drawn: Sequence[str] | None, fixed: Mapping[str, float], parameters: ParameterSet
) -> tuple[str, ...]:
    """Names of the random errors, without sums of them and without fixed errors."""
    if drawn is None:
        drawn = () if fixed else parameters.patterns("full")
    names = parameters.without_sums(parameters.select(drawn)) if drawn else ()
    fixed_terms = {term for n in fixed for term, _ in parameters[n].terms}
    return parameters.without_terms(names, fixed_terms)


def _true_selection(study: AccuracyStudy, robot: Robot) -> Selection:
    """Selection of all errors of the machines: random ones with their priors, and fixed ones."""
    parameters = tuple(
        replace(robot.parameters[n], prior_std=std) for n, std in study.drawn.items()
    )
    n = len(parameters)
    return Selection(
        label="truth",
        parameters=parameters,
        prior=np.ones(n, dtype=np.bool_),
        scaled=np.zeros(n, dtype=np.bool_),
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
    """RMS of the errors, [SI]."""
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
    """Tool error before the calibration, [m]."""
    after: float
    """Tool error after the calibration, [m]."""
    standard_error: float
    """Sampling standard error of `after`, [m]."""
    percentile_95: float
    """95th percentile over the machines after the calibration, [m]."""
    worst_point: float
    """Largest error in the workspace, RMS over the machines, [m]."""
    shift_removed: float
    """Tool error with only the mean translation removed, [m]."""
    absolute: float
    """Absolute tool error, [m]."""
    all_effects: float | None
    """Tool error if the ignored effects are identified, too, [m]; None if none is ignored."""
    cost_standard_error: float
    """Sampling standard error of `after` − `all_effects`, [m]."""
    predicted: Expected | None
    """Predicted tool error; None if it cannot be predicted."""
    parameters: tuple[EstimationError, ...]
    """Errors of the estimates, sorted by `relative`, largest first."""


def summarise_accuracy(study: AccuracyStudy, table: StudyTable) -> AccuracySummary:
    """Summary of the table of an accuracy study."""
    status = np.array(table.columns.get("status", []), dtype=object)
    calibrated = status == CALIBRATED

    def column(name: str) -> Array:
        values = np.array(table.columns.get(name, []), dtype=np.float64)
        return values[calibrated] if values.size else values

    def tool(name: str) -> tuple[float, float]:
        return _root_mean_square(column(name) * UM)

    try:
        predicted = study.predicted if calibrated.any() else None
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
        machines=int(calibrated.sum()),
        failed={str(s): int((status == s).sum()) for s in sorted(set(status[~calibrated]))},
        before=tool("before_um")[0],
        after=after,
        standard_error=standard_error,
        percentile_95=float(np.quantile(column("tool_um") * UM, 0.95))
        if calibrated.any()
        else np.nan,
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
    """Standard error of the difference of the RMS of two samples of the same machines."""
    if one.size < 2:
        return np.nan
    # d(rms) = d(mean square)/(2 rms)
    one_scaled, other_scaled = (
        v**2 / (2.0 * max(_root_mean_square(v)[0], 1e-15)) for v in (one, other)
    )
    return float((one_scaled - other_scaled).std(ddof=1) / np.sqrt(one.size))
