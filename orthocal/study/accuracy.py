"""How good a calibration leaves machines: many are drawn, read by a plan and calibrated.

Each machine has its errors, its gauges stand as they may, and its readings have noise and rounding.
What is identified may be less than what machines have wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ClosureError, SolverError
from orthocal.estimation.choice import Choice
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.selection import Selection
from orthocal.estimation.solvers.batch import BatchProgram
from orthocal.kinematics.loop_closure import Failures, LoopClosure
from orthocal.kinematics.workspace import FEWEST_ALIGNED, Workspace, gauss_cube
from orthocal.observation.simulate import limits_of, show_readings
from orthocal.planning.expected_error import (
    Expected,
    ToolForecast,
    noise_of,
    weigh_readings,
)
from orthocal.robot.model import Robot
from orthocal.session.session import Session
from orthocal.study.shipped_functions import ShippedSession
from orthocal.study.study import Columns, Study, prepare_once
from orthocal.units import UM

Array = NDArray[np.float64]

MACHINES_A_TASK = 100

FORETOLD = 60
"""Machines of which the mean is what is foretold: each is another one to first order."""

PILOTS = 9
"""Machines that tell by what readings are weighed where the model leaves errors out."""

GOOD = "calibrated"
NO_CONTACT = "a tip passes what it should touch"
OUT_OF_RANGE = "a reading leaves the gauge's range"
NO_MACHINE = "cannot be assembled in every posture"
NO_SOLUTION = "the calibration does not converge"


@dataclass(frozen=True, eq=False)
class AccuracyStudy(Study):
    """Machines that are calibrated from the readings of a plan."""

    kind: ClassVar[str] = "accuracy"
    counted: ClassVar[str] = "machines"

    session: ShippedSession
    """What is read where; readings do not matter."""
    choice: Choice
    """What is identified."""
    drawn: tuple[str, ...]
    """Errors that differ from machine to machine: names of parameters."""
    tolerances: Mapping[str, float]
    """Their standard deviations, [SI]."""
    given: Mapping[str, float]
    """Errors that all machines have, [SI]."""
    machines: int
    seed: int
    half_side: float
    """Of the cube in which the tool's error counts, [m]."""

    @property
    def record(self) -> dict[str, Any]:
        """All that the table depends on."""
        return {
            **self.session.record,
            "choice": self.choice.document,
            "drawn": {n: self.tolerances[n] for n in self.drawn},
            "given": dict(self.given),
            "machines": self.machines,
            "seed": self.seed,
            "half_side": self.half_side,
        }

    @property
    def task_sizes(self) -> tuple[int, ...]:
        """Machines of each task."""
        whole, rest = divmod(self.machines, MACHINES_A_TASK)
        return (MACHINES_A_TASK,) * whole + ((rest,) if rest else ())

    def prepare(self) -> _Prepared:
        """Problems of what is identified and of what machines have wrong, and the tool."""
        return _Prepared.of(self)

    def run(self, prepared: _Prepared, task: int) -> Columns:
        """Errors that are left of each machine."""
        first = task * MACHINES_A_TASK
        numbers = range(first, first + self.task_sizes[task])
        return _Calibrated.of(self, prepared, numbers).columns(prepared)

    @cached_property
    def foretold(self) -> Expected:
        """What is to be expected of such machines, by the analytic covariance about some of them.

        Errors that are not identified are taken as they are drawn.
        """
        p: _Prepared = prepare_once(self)
        others = {n: self.tolerances[n] for n in self.drawn}
        forecast = ToolForecast(p.robot, p.problem.machine_selection, p.workspace, others=others)
        count = min(FORETOLD, self.machines)
        machines = [self._identified(p, number) for number in range(count)]
        return forecast.after(p.session, weight=p.sigma, machines=machines)

    def draw(self, prepared: _Prepared, number: int) -> tuple[Array, np.random.Generator]:
        """θ̂ of a machine and its gauges, and what draws its noise."""
        rng = np.random.default_rng((self.seed, number))
        return rng.normal(size=prepared.truth.n_free), rng

    def _identified(self, prepared: _Prepared, number: int) -> Array:
        """What a machine's parameters and gauges really are, as far as they are identified."""
        truth = prepared.truth
        drawn, _ = self.draw(prepared, number)
        errors = truth.closure.errors(
            truth.theta_scale[: truth.n_machine] * drawn[: truth.n_machine]
        )
        own = drawn[truth.n_machine :] * truth.theta_scale[truth.n_machine :]
        return np.append(prepared.true_values(errors[None])[0], own)


@dataclass(frozen=True, eq=False)
class _Prepared:
    """What all machines share."""

    session: Session
    problem: CalibrationProblem
    """Of what is identified."""
    truth: CalibrationProblem
    """Of all that machines have wrong."""
    program: BatchProgram
    workspace: Workspace
    drives: Array
    """Commanded for the points of the workspace, shape (K, n_drives)."""
    passive: Array
    positions: Array
    """Of the tool of the nominal machine there, shape (K, 3), [m]."""
    limits: Array
    """Lowest and highest value of each row, shape (2, n_rows), [m]."""
    sigma: float
    """Standard deviation by which readings are weighed, [m]."""

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.session.robot

    @classmethod
    def of(cls, study: AccuracyStudy) -> _Prepared:
        session = study.session.unpack()
        robot = session.robot
        problem = weigh_readings(CalibrationProblem(session, study.choice.select(robot.parameters)))
        workspace = gauss_cube(robot, half_side=study.half_side)
        assembly = LoopClosure(robot)
        nominal = assembly.inverse(workspace.points)
        drives = nominal - session.active_offsets
        passive = assembly.close(drives)
        limits = [limits_of(session, r) or (-np.inf, np.inf) for r in session.readings]
        found = cls(
            session=session,
            problem=problem,
            truth=CalibrationProblem(session, _truth(study, robot), noise=problem.noise),
            program=BatchProgram(problem),
            workspace=workspace,
            drives=drives,
            passive=passive,
            positions=assembly.tcp(nominal, assembly.close(nominal)),
            limits=np.array(limits).T,
            sigma=noise_of(session),
        )
        return replace(found, sigma=_weight(study, found))

    def read(self, study: AccuracyStudy, numbers: Sequence[int]) -> _Read:
        """Machines, and what dials show of them."""
        drawn, generators = zip(*(study.draw(self, n) for n in numbers), strict=True)
        truth, o = self.truth, self.problem.observations
        readings, _, reached = truth.simulate(np.array(drawn) * truth.theta_scale)
        status = np.where(reached, GOOD, NO_MACHINE).astype(object)
        entries = readings * self.problem.noise
        for i, rng in enumerate(generators):
            entries[i], _ = show_readings(self.session, o, entries[i], rng=rng)
        _mark(status, np.asarray(~np.isfinite(entries).all(axis=1)), NO_CONTACT)
        rows = np.array([o.rows(v) for v in entries])
        beyond = (rows < self.limits[0]) | (rows > self.limits[1])
        _mark(status, np.asarray(beyond.any(axis=1)), OUT_OF_RANGE)
        machines = np.array(drawn)[:, : truth.n_machine]
        return _Read(
            truth.closure.errors() + machines @ truth.columns.T,
            entries / self.problem.noise,
            rows,
            status,
        )

    def true_values(self, errors: Array) -> Array:
        """What identified parameters really are, shape (n_sets, n_machine), [SI].

        Of a sum of errors that differ from each other, the sum that is nearest to them.

        Args:
            errors: All elementary errors, shape (n_sets, n_errors), [SI].
        """
        columns = self.problem.functions.errors.columns(self.problem.machine_selection.names)
        return np.asarray(errors @ (columns / (columns**2).sum(axis=0)))

    def align(self, field: Array) -> Array:
        """Tool errors, shape (K, 3, n), with shift and rotation taken out."""
        if len(self.positions) < FEWEST_ALIGNED:
            return self.workspace.remove_shift(field)
        return self.workspace.remove_motion(field, self.positions)


@dataclass(frozen=True, eq=False)
class _Read:
    """Machines, and what dials show of them."""

    errors: Array
    """All elementary errors, shape (n_sets, n_errors), [SI]."""
    values: Array
    """As single readings, shape (n_sets, n_entries), [m of the first gauge]."""
    rows: Array
    """As rows of the session, shape (n_sets, n_rows), [m]."""
    status: NDArray[np.object_]
    """GOOD, or why a machine cannot be calibrated, shape (n_sets,)."""


@dataclass(frozen=True, eq=False)
class _Calibrated:
    """Machines, and what was identified of them."""

    numbers: Sequence[int]
    status: list[str]
    true: Array
    """What identified parameters really are, shape (n_sets, n_machine), [SI]."""
    found: Array
    before: Array
    """Errors of the tool as it is, shape (K, 3, n_sets), [m]; NaN without result."""
    after: Array
    """The same in a controller that knows all that was identified."""

    @classmethod
    def of(cls, study: AccuracyStudy, p: _Prepared, numbers: Sequence[int]) -> _Calibrated:
        read = p.read(study, numbers)
        status, true = read.status, read.errors
        theta = _identify(p, read.values, status)
        names = p.problem.machine_selection.names
        n, columns = len(names), p.problem.functions.errors.columns(names)
        errors = p.problem.closure.errors() + theta[:, :n] @ columns.T
        good = np.flatnonzero(status == GOOD)
        tools = np.full((2, *p.positions.shape, len(status)), np.nan)
        for tool, machines in zip(tools, (true, errors), strict=True):
            if not good.size:
                break
            closure = LoopClosure(p.robot)
            lost: Failures = {}
            q = closure.close(p.drives, errors=machines[good], start=p.passive, failures=lost)
            failed = good[sorted({i // len(p.drives) for i in lost})]
            _mark(status, np.isin(np.arange(len(status)), failed), NO_MACHINE)
            points = closure.tcp(p.drives, q, errors=machines[good])
            tool[..., good] = np.moveaxis(points, 0, -1)
        bad = status != GOOD
        before, after = tools[0] - p.positions[..., None], tools[0] - tools[1]
        for values in (before, after):
            values[..., bad] = np.nan
        theta[bad] = np.nan
        return cls(numbers, list(status), p.true_values(true), theta[:, :n], before, after)

    def columns(self, p: _Prepared) -> dict[str, list[Any]]:
        """A row a machine."""
        weights = p.workspace.weights
        aligned = p.align(self.after)

        def rms(field: Array) -> list[float]:
            return list(np.sqrt(weights @ (field**2).sum(axis=1)) / UM)

        columns: dict[str, list[Any]] = {
            "machine": list(self.numbers),
            "status": self.status,
            "before_um": rms(p.align(self.before)),
            "tool_um": rms(aligned),
            "tool_shift_out_um": rms(p.workspace.remove_shift(self.after)),
            "tool_absolute_um": rms(self.after),
            "tool_worst_um": list(np.sqrt((aligned**2).sum(axis=1).max(axis=0)) / UM),
        }
        for i, parameter in enumerate(p.problem.machine_selection.parameters):
            name = f"{parameter.name}_{parameter.edge_unit}"
            columns[f"true.{name}"] = list(self.true[:, i] * parameter.edge_factor)
            missed = (self.found[:, i] - self.true[:, i]) * parameter.edge_factor
            columns[f"missed.{name}"] = list(missed)
        return columns


def _truth(study: AccuracyStudy, robot: Robot) -> Selection:
    """All that machines have wrong: what is drawn, by its tolerances, and what is given."""
    parameters = tuple(
        replace(robot.parameters[n], tolerance=study.tolerances[n]) for n in study.drawn
    )
    n = len(parameters)
    return Selection(
        label="truth",
        parameters=parameters,
        prior=np.ones(n, dtype=np.bool_),
        mean=np.zeros(n),
        lower=np.full(n, -np.inf),
        upper=np.full(n, np.inf),
        fixed=study.given,
    )


def _weight(study: AccuracyStudy, p: _Prepared) -> float:
    """Standard deviation by which readings are weighed, [m].

    What is stated of the gauge, unless machines have errors that are not identified: then, as in
    a calibration, what remains of the readings tells it, of a few machines in the middle.
    """
    columns = p.problem.functions.errors.columns(p.problem.machine_selection.names)
    known = columns @ np.linalg.pinv(columns)
    if np.allclose(known @ p.truth.columns, p.truth.columns, atol=1e-12):
        return p.sigma
    numbers = range(min(PILOTS, study.machines))
    read, found = p.read(study, numbers), []
    for rows, status in zip(read.rows, read.status, strict=True):
        if status != GOOD:
            continue
        with suppress(SolverError, ClosureError):
            options = SolverOptions(solver="eliminated")
            found.append(fit_problem(p.problem.with_values(rows), options=options).sigma)
    return max(float(np.median(found)), p.sigma) if found else p.sigma


def _identify(p: _Prepared, values: Array, status: NDArray[np.object_]) -> Array:
    """θ of each machine that could be read, shape (n_sets, n_free), [SI]; NaN for others."""
    theta = np.full((len(values), p.problem.n_free), np.nan)
    good = np.flatnonzero(status == GOOD)
    if not good.size:
        return theta
    sigma = p.sigma
    try:
        theta[good] = p.program.solve(values[good], sigma=sigma).theta
    except (SolverError, ClosureError):  # which ones do not converge is found one by one
        for i in good:
            try:
                theta[i] = BatchProgram(p.problem).solve(values[i : i + 1], sigma=sigma).theta[0]
            except (SolverError, ClosureError):
                status[i] = NO_SOLUTION
    return theta


def _mark(status: NDArray[np.object_], which: NDArray[np.bool_], word: str) -> None:
    """Say why machines have no result that had none of the reasons before."""
    status[which & (status == GOOD)] = word
