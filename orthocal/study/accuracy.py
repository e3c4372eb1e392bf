"""Study of accuracy: random machines are measured by a plan and calibrated.

Each machine has random errors, its gauges have random mounting errors, and its readings are noisy
and rounded. The calibration may identify fewer errors than the machine has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from orthocal.arrays import Array
from orthocal.errors import ClosureError, SessionError, SolverError
from orthocal.estimation.choice import Choice, resolve_choice
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.selection import Selection
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.kinematics.conditions import UseConditions, UseSamples
from orthocal.kinematics.loop_closure import Failures, LoopClosure
from orthocal.kinematics.workspace import (
    Workspace,
    cube_limits,
    find_workspace,
    gauss_box,
)
from orthocal.observation.simulate import limits_of, show_readings
from orthocal.planning.expected_error import (
    Expected,
    ToolForecast,
    noise_of,
    weigh_readings,
)
from orthocal.robot.model import Robot
from orthocal.robot.parameters import Parameter, ParameterSet
from orthocal.session.session import Session
from orthocal.study.runner import StudyTable
from orthocal.study.study import Columns, Study, columns_in_edge_units, prepare_once
from orthocal.units import UM

PREDICTED_MACHINES = 60
"""Machines over which the prediction is averaged: the Jacobian differs from machine to machine."""

PILOT_MACHINES = 9
"""Machines whose residuals give the weight of a reading where the model omits errors."""

CALIBRATED = "calibrated"
NO_CONTACT = "a tip misses the part it should touch"
OUT_OF_RANGE = "a reading exceeds the gauge's range"
NOT_ASSEMBLED = "the machine cannot be assembled in every posture"
NOT_CONVERGED = "the calibration does not converge"


@dataclass(frozen=True, eq=False)
class AccuracyStudy(Study):
    """Random machines that are calibrated from the readings of a plan."""

    kind: ClassVar[str] = "accuracy"
    counted: ClassVar[str] = "machines"
    cases_per_task: ClassVar[int] = 100

    choice: Choice
    """Identified errors."""
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

    def prepare(self) -> _Prepared:
        """Problems of the identified and of all errors, and the workspace."""
        session = self.session
        robot = session.robot
        problem = weigh_readings(CalibrationProblem(session, self.choice.select(robot.parameters)))
        workspace = gauss_box(robot, self.box)
        closure = LoopClosure(robot)
        nominal = closure.inverse(workspace.points)
        drives = nominal - session.active_offsets
        limits = [limits_of(session, r) or (-np.inf, np.inf) for r in session.readings]
        prepared = _Prepared(
            session=session,
            problem=problem,
            truth=CalibrationProblem(
                session, _true_selection(self, robot), noise_ratio=problem.noise_ratio
            ),
            program=BatchSolver(problem),
            workspace=workspace,
            drives=drives,
            passive=closure.close(drives),
            positions=closure.tcp(nominal, closure.close(nominal)),
            limits=np.array(limits).T,
            sigma=noise_of(session),
        )
        return replace(prepared, sigma=_weighting_sigma(self, prepared))

    def run(self, prepared: _Prepared, task: int) -> Columns:
        """Errors of each machine before and after its calibration."""
        numbers = self.case_numbers(task)
        p, measured = prepared, prepared.measure(self, numbers)
        status = measured.status
        theta = np.full((len(numbers), p.problem.n_free), np.nan)
        good = np.flatnonzero(status == CALIBRATED)
        if good.size:
            values = measured.values[good]
            theta[good], converged = p.estimate(values)
            _set_reason(status, good[~converged], NOT_CONVERGED)
        before, after = p.tool_errors(measured.errors, theta, status)
        theta[status != CALIBRATED] = np.nan
        aligned = p.workspace.align(after, p.positions)
        weights = p.workspace.weights

        def rms(field: Array) -> list[float]:
            return list(np.sqrt(weights @ (field**2).sum(axis=1)) / UM)

        true = p.identified_part(measured.errors)
        estimate = theta[:, : p.problem.n_machine]
        true_columns = columns_in_edge_units("true.", p.problem, true)
        error_columns = columns_in_edge_units("error.", p.problem, estimate - true)
        pairs = zip(true_columns.items(), error_columns.items(), strict=True)
        return {
            "machine": list(numbers),
            "status": list(status),
            "before_um": rms(p.workspace.align(before, p.positions)),
            "tool_um": rms(aligned),
            "tool_shift_out_um": rms(p.workspace.remove_shift(after)),
            "tool_absolute_um": rms(after),
            "tool_worst_um": list(np.sqrt((aligned**2).sum(axis=1).max(axis=0)) / UM),
            **dict(column for pair in pairs for column in pair),
        }

    @cached_property
    def predicted(self) -> Expected:
        """Predicted tool error of such machines, from the covariance at a sample of them.

        Errors that are not identified count with their prior covariance.
        """
        p: _Prepared = prepare_once(self)
        selection = p.problem.machine_selection
        unstated = UseSamples((UseConditions(),))  # as the tools of its machines
        forecast = ToolForecast(p.robot, selection, p.workspace, use=unstated, others=self.drawn)
        count = min(PREDICTED_MACHINES, self.machines)
        machines = [self._true_parameters(p, number) for number in range(count)]
        return forecast.after(p.session, weight=p.sigma, machines=machines)

    def draw(self, prepared: _Prepared, number: int) -> tuple[Array, np.random.Generator]:
        """Scaled true errors of a machine and its gauges, and the generator of its noise."""
        rng = np.random.default_rng((self.seed, number))
        return rng.normal(size=prepared.truth.n_free), rng

    def _true_parameters(self, prepared: _Prepared, number: int) -> Array:
        """True values of the identified parameters and of the nuisance parameters, [SI]."""
        truth, n = prepared.truth, prepared.truth.n_machine
        drawn, _ = self.draw(prepared, number)
        scaled = drawn * truth.theta_scale
        errors = truth.closure.errors(scaled[:n])
        return np.append(prepared.identified_part(errors[None])[0], scaled[n:])


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Data shared by all machines."""

    session: Session
    problem: CalibrationProblem
    """Of the identified errors."""
    truth: CalibrationProblem
    """Of all errors that machines have."""
    program: BatchSolver
    workspace: Workspace
    drives: Array
    """Commanded for the points of the workspace, shape (K, n_drives), [m, rad]."""
    passive: Array
    """Passive coordinates of the nominal machine there, shape (K, n_passive), [m, rad]."""
    positions: Array
    """Tool positions of the nominal machine there, shape (K, 3), [m]."""
    limits: Array
    """Smallest and largest value of each row, shape (2, n_rows), [m]."""
    sigma: float
    """Standard deviation that weights a reading, [m]."""

    @property
    def robot(self) -> Robot:
        """The nominal robot."""
        return self.session.robot

    def measure(self, study: AccuracyStudy, numbers: Sequence[int]) -> _Measured:
        """Random machines and their readings."""
        draws, generators = zip(*(study.draw(self, n) for n in numbers), strict=True)
        theta, o, truth = np.array(draws), self.problem.observations, self.truth
        predicted, _, closed = truth.simulate(theta * truth.theta_scale)
        status = np.where(closed, CALIBRATED, NOT_ASSEMBLED).astype(object)
        entries = predicted * self.problem.noise_ratio
        for i, rng in enumerate(generators):
            entries[i], _ = show_readings(self.session, o, entries[i], rng=rng)
        _set_reason(status, np.asarray(~np.isfinite(entries).all(axis=1)), NO_CONTACT)
        rows = np.array([o.rows(v) for v in entries])
        beyond = (rows < self.limits[0]) | (rows > self.limits[1])
        _set_reason(status, np.asarray(beyond.any(axis=1)), OUT_OF_RANGE)
        errors = truth.closure.errors() + theta[:, : truth.n_machine] @ truth.errors_per_theta.T
        return _Measured(errors, entries / self.problem.noise_ratio, rows, status)

    def tool_errors(
        self, true: Array, theta: Array, status: NDArray[np.object_]
    ) -> tuple[Array, Array]:
        """Tool errors before and after calibration, each of shape (K, 3, n_sets), [m].

        Args:
            true: All elementary errors, shape (n_sets, n_errors), [SI].
            theta: Estimates, shape (n_sets, n_free), [SI].
            status: Changed where the loops of a machine do not close.
        """
        names = self.problem.machine_selection.names
        columns = self.problem.functions.errors.columns(names)
        estimated = self.problem.closure.errors() + theta[:, : len(names)] @ columns.T
        good = np.flatnonzero(status == CALIBRATED)
        tools = np.full((2, *self.positions.shape, len(status)), np.nan)
        for tool, errors in zip(tools, (true, estimated), strict=True):
            if good.size:
                positions, closed = self.tool_positions(errors[good])
                _set_reason(status, good[~closed], NOT_ASSEMBLED)
                tool[..., good] = positions
        tools[..., status != CALIBRATED] = np.nan
        return tools[0] - self.positions[..., None], tools[0] - tools[1]

    def tool_positions(self, errors: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Tool positions of machines, shape (K, 3, n_sets), [m], and whether their loops close.

        Args:
            errors: All elementary errors of each machine, shape (n_sets, n_errors), [SI].
        """
        closure, failures = LoopClosure(self.robot), Failures()
        q = closure.close(self.drives, errors=errors, start=self.passive, failures=failures)
        closed = np.ones(len(errors), dtype=np.bool_)
        closed[[i // len(self.drives) for i in failures]] = False
        return np.moveaxis(closure.tcp(self.drives, q, errors=errors), 0, -1), closed

    def estimate(self, values: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Estimates of machines, and whether each calibration converges.

        Args:
            values: Readings, shape (n_sets, n_entries), [m of the first gauge].

        Returns:
            Free parameters, shape (n_sets, n_free), [SI], NaN where the calibration fails.
        """
        theta = np.full((len(values), self.problem.n_free), np.nan)
        converged = np.ones(len(values), dtype=np.bool_)
        try:
            return self.program.solve(values, sigma=self.sigma).theta, converged
        except (SolverError, ClosureError):  # one by one, to find the machines that fail
            for i in range(len(values)):
                try:
                    program = BatchSolver(self.problem)
                    theta[i] = program.solve(values[i : i + 1], sigma=self.sigma).theta[0]
                except (SolverError, ClosureError):
                    converged[i] = False
            return theta, converged

    def identified_part(self, errors: Array) -> Array:
        """True values of the identified parameters, shape (n_sets, n_machine), [SI].

        A parameter that moves several elementary errors has their least-squares value.

        Args:
            errors: All elementary errors, shape (n_sets, n_errors), [SI].
        """
        columns = self.problem.functions.errors.columns(self.problem.machine_selection.names)
        return np.asarray(errors @ (columns / (columns**2).sum(axis=0)))


@dataclass(frozen=True, eq=False)
class _Measured:
    """Random machines and their readings."""

    errors: Array
    """All elementary errors, shape (n_sets, n_errors), [SI]."""
    values: Array
    """Single readings, shape (n_sets, n_entries), [m of the first gauge]."""
    rows: Array
    """Rows of the session, shape (n_sets, n_rows), [m]."""
    status: NDArray[np.object_]
    """CALIBRATED, or the reason why a machine cannot be calibrated, shape (n_sets,)."""


def build_accuracy_study(
    session: Session,
    choice: Choice | str | None = None,
    *,
    drawn: Sequence[str] | None = None,
    fixed: Mapping[str, float] | None = None,
    machines: int = 1000,
    seed: int = 0,
    half_side: float | None = None,
) -> AccuracyStudy:
    """A study of the tool error that the readings of a plan leave.

    Args:
        session: The planned readings.
        choice: Identified errors, or the name of a model; default: the session's choice, or `full`.
            Its prior standard deviations also apply to the random errors.
        drawn: Names or globs of the random errors; default: all errors of the machine, or none if
            `fixed` is not empty.
        fixed: Errors that all machines have, [SI].
        machines: Number of machines.
        seed: Seed of errors, gauges and noise.
        half_side: Half the side of a cube around the mechanical zero over which the tool error is
            computed, [m]; by default the workspace of the robot.

    Raises:
        ParameterError: If a name or a number is invalid.
        SessionError: If the noise of a gauge is missing.
        RobotError: If the drives do not command the tool.
    """
    chosen = resolve_choice(choice, session, default_model="full")
    robot = session.robot
    parameters = robot.parameters
    chosen.select(parameters)
    fixed = dict(fixed or {})
    if drawn is None:
        drawn = () if fixed else parameters.patterns("full")
    names = _without_sums(parameters.select(drawn), parameters) if drawn else ()
    fixed_terms = {term for n in fixed for term, _ in parameters[n].terms}
    names = tuple(n for n in names if not fixed_terms & {t for t, _ in parameters[n].terms})
    stated = parameters.read_tolerances(chosen.tolerances)
    stated = {n: std for glob, std in stated.items() for n in parameters.select([glob])}
    for name, gauge in session.gauges.items():
        if gauge.sigma is None:
            key = f"gauges.{name}.sigma_mm" if name else "gauge.sigma_mm"
            raise SessionError(
                "is missing: the study needs the noise of the gauge",
                where=key if session.path is None else f"{session.path}: {key}",
            )
    box = find_workspace(robot).limits if half_side is None else cube_limits(robot, half_side)
    return AccuracyStudy(
        session=session.with_values(np.zeros(len(session.readings))),
        choice=chosen,
        drawn={n: stated.get(n, parameters[n].prior_std) for n in names},
        fixed=fixed,
        machines=machines,
        seed=seed,
        box=tuple((float(low), float(high)) for low, high in box),
    )


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


def _weighting_sigma(study: AccuracyStudy, p: _Prepared) -> float:
    """Standard deviation that weights a reading, [m].

    It is the stated noise, unless machines have errors that are not identified. Then the residuals
    give it, as in a calibration: the median of a few pilot machines.
    """
    columns = p.problem.functions.errors.columns(p.problem.machine_selection.names)
    projector = columns @ np.linalg.pinv(columns)
    if np.allclose(projector @ p.truth.errors_per_theta, p.truth.errors_per_theta, atol=1e-12):
        return p.sigma
    measured = p.measure(study, range(min(PILOT_MACHINES, study.machines)))
    options, sigmas = SolverOptions(solver="variable-projection"), []
    for rows in measured.rows[measured.status == CALIBRATED]:
        with suppress(SolverError, ClosureError):
            sigmas.append(fit_problem(p.problem.with_values(rows), options=options).sigma)
    return max(float(np.median(sigmas)), p.sigma) if sigmas else p.sigma


def _set_reason(status: NDArray[np.object_], which: NDArray[Any], reason: str) -> None:
    """Record why machines, by flag or index, have no result; an earlier reason stays."""
    selected = np.zeros(len(status), dtype=np.bool_)
    selected[which] = True
    status[selected & (status == CALIBRATED)] = reason


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
