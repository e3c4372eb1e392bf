"""Random machines, their readings of a plan, and the models that identify them.

A model may lack effects beside geometry that the machines have. Elementary errors of machines have
the order of the machines' robot (`ErrorMap.names`), those of estimates that of the model's robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthocal.arrays import Array, Mask
from orthocal.errors import ClosureError, SolverError
from orthocal.estimation.choice import Choice
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.selection import Selection
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.kinematics.conditions import UseSamples, effects_by_condition, sample_use
from orthocal.kinematics.continuation import Failures
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.workspace import Workspace, gauss_box
from orthocal.observation.gauge_noise import stated_sigma
from orthocal.observation.simulate import limits_of, show_readings
from orthocal.planning.expected_error import with_gauge_noise
from orthocal.robot.model import Robot
from orthocal.session.session import Session

PILOT_MACHINES = 9
"""Machines whose residuals determine the weight of a reading if the model omits errors."""

NEGLIGIBLE = 1e-9
"""Difference of readings or tool positions that is negligible, [m]."""

CALIBRATED = "calibrated"
NO_CONTACT = "a tip misses the part it should touch"
OUT_OF_RANGE = "a reading exceeds the gauge's range"
NOT_CLOSED = "the machine cannot reach every posture"
NOT_CONVERGED = "the calibration does not converge"

Status = NDArray[np.object_]
"""CALIBRATED, or the reason why a machine cannot be calibrated, shape (n_sets,)."""


@dataclass(frozen=True, eq=False)
class MachineModel:
    """A model by which machines are identified."""

    problem: CalibrationProblem
    """Problem of the identified errors."""
    sigma: float
    """Standard deviation that weights a reading of the first gauge, [m]."""

    @staticmethod
    def of(session: Session, choice: Choice) -> MachineModel:
        """Build the model for a choice of errors, with the stated noise of the gauges."""
        problem = CalibrationProblem(session, choice.select(session.robot.parameters))
        return MachineModel(with_gauge_noise(problem), stated_sigma(session.gauge))

    @property
    def weights(self) -> Array:
        """Standard deviations that weight the readings, shape (n_entries,), [m]."""
        return self.sigma * self.problem.noise_ratio

    def estimate(self, values: Array) -> tuple[Array, Mask]:
        """Estimate the errors of machines.

        Args:
            values: Readings, shape (n_sets, n_entries), [m].

        Returns:
            Free parameters, shape (n_sets, n_free), [SI], NaN if a calibration fails; and the mask
            of the machines whose calibrations converge.
        """
        theta = np.full((len(values), self.problem.n_free), np.nan)
        converged = np.ones(len(values), dtype=np.bool_)
        program, scaled = BatchSolver(self.problem), values / self.problem.noise_ratio
        try:
            return program.solve(scaled, sigma=self.sigma).theta, converged
        except (SolverError, ClosureError):  # one by one, to find the machines that fail
            for i in range(len(values)):
                try:
                    theta[i] = program.solve(scaled[i : i + 1], sigma=self.sigma).theta[0]
                except (SolverError, ClosureError):
                    converged[i] = False
            return theta, converged

    @property
    def columns(self) -> Array:
        """Elementary errors per unit of each identified parameter, shape (n_errors, n_machine)."""
        return self.problem.functions.errors.unit_errors(self.problem.machine_selection.names)

    def reorder_errors(self, errors: Array, names: Sequence[str]) -> Array:
        """Errors of a robot with other effects in the order of this model; 0 for missing ones.

        Args:
            errors: Elementary errors, shape (n_sets, n), [SI].
            names: Names of these errors, shape (n,).
        """
        position = {name: i for i, name in enumerate(names)}
        error_names = self.problem.functions.errors.names
        reordered = np.zeros((len(errors), len(error_names)))
        common = [i for i, name in enumerate(error_names) if name in position]
        reordered[:, common] = errors[:, [position[error_names[i]] for i in common]]
        return reordered

    def identified_part(self, errors: Array, names: Sequence[str]) -> Array:
        """True values of the identified parameters, shape (n_sets, n_machine), [SI].

        A parameter that is a sum of several elementary errors has their least-squares value.

        Args:
            errors: All elementary errors, shape (n_sets, n), [SI].
            names: Their names, shape (n,).
        """
        columns = self.columns
        return np.asarray(self.reorder_errors(errors, names) @ (columns / (columns**2).sum(axis=0)))

    def explains(self, truth: CalibrationProblem) -> bool:
        """True if the model contains all errors of the machines, `truth`."""
        if not set(truth.robot.effect_names) <= set(self.problem.robot.effect_names):
            return False
        columns = self.columns
        true_errors = self.reorder_errors(truth.errors_per_theta.T, truth.functions.errors.names).T
        return np.allclose(
            columns @ (np.linalg.pinv(columns) @ true_errors), true_errors, atol=1e-12
        )


@dataclass(frozen=True, eq=False)
class Tool:
    """Tool positions at K points of a workspace under C conditions of use.

    Arrays with C K rows hold all points under the first condition, then under the second etc.
    """

    workspace: Workspace
    """The C K points."""
    use: UseSamples
    drives: Array
    """Commanded drive coordinates of the points, shape (K, n_drives), [m, rad]."""
    passive: Array
    """Passive coordinates of the nominal machine, shape (K, n_passive), [m, rad]."""
    positions: Array
    """Tool positions of the nominal machine, shape (C K, 3), [m]."""

    @staticmethod
    def of(session: Session, box: Sequence[tuple[float, float]]) -> Tool:
        """Build the tool of the nominal machine with the active offsets of a session."""
        robot = session.robot
        workspace, use = gauss_box(robot, box), sample_use(robot)
        closure = LoopClosure(robot)
        nominal = closure.inverse(workspace.points)
        drives = nominal - session.active_offsets
        positions = closure.tcp(nominal, closure.close(nominal))
        return Tool(
            workspace.repeat(use.size),
            use,
            drives,
            closure.close(drives),
            np.tile(positions, (use.size, 1)),
        )

    def __call__(self, robot: Robot, errors: Array) -> tuple[Array, Mask]:
        """Tool positions of machines.

        Args:
            robot: The nominal robot with the effects of the machines.
            errors: Elementary errors of each machine, shape (n_sets, n_errors), [SI].
        """
        conditions = self.use.conditions if effects_by_condition(robot) else (None,)
        closed, positions = np.ones(len(errors), dtype=np.bool_), []
        for stated in conditions:
            closure, failures = LoopClosure(robot, conditions=stated), Failures()
            q = closure.close(self.drives, errors=errors, start=self.passive, failures=failures)
            closed[[i // len(self.drives) for i in failures]] = False
            positions.append(closure.tcp(self.drives, q, errors=errors))
        fields = np.concatenate(positions * (self.use.size // len(positions)), axis=1)
        return np.moveaxis(fields, 0, -1), closed


@dataclass(frozen=True, eq=False)
class MeasuredMachines:
    """Random machines and their readings."""

    errors: Array
    """Elementary errors, shape (n_sets, n_errors), [SI]."""
    values: Array
    """Single readings, shape (n_sets, n_entries), [m]."""
    rows: Array
    """Readings of the rows of the session, shape (n_sets, n_rows), [m]."""
    status: Status


@dataclass(frozen=True, eq=False)
class RandomMachines:
    """Machines of a study, shared by all of its tasks."""

    seed: int
    truth: CalibrationProblem
    """Problem whose free parameters are all errors of the machines."""
    models: tuple[MachineModel, ...]
    """Model of the study; if it ignores effects, also the model with all effects."""
    tool: Tool
    limits: Array
    """Smallest and largest possible reading of each row, shape (2, n_rows), [m]."""

    @staticmethod
    def of(
        session: Session,
        truth: Selection,
        models: Sequence[tuple[Session, Choice]],
        *,
        box: Sequence[tuple[float, float]],
        seed: int,
        count: int,
    ) -> RandomMachines:
        """Build machines that are measured by a plan, and the weights of their readings.

        Args:
            session: Plan with all effects of the machines.
            truth: All errors of the machines.
            models: Plan with the effects of each model, and the identified errors.
            box: Box of the tool error, as in `AccuracyStudy`.
            seed: Seed of errors, gauges and noise.
            count: Number of machines.
        """
        unweighted = tuple(MachineModel.of(s, c) for s, c in models)
        limits = [limits_of(session, r) or (-np.inf, np.inf) for r in session.readings]
        machines = RandomMachines(
            seed,
            CalibrationProblem(session, truth),
            unweighted,
            Tool.of(session, box),
            np.array(limits).T,
        )
        weighted = tuple(machines.weight_readings(m, count) for m in unweighted)
        return replace(machines, models=weighted)

    @property
    def model(self) -> MachineModel:
        """The model of the study."""
        return self.models[0]

    @property
    def error_names(self) -> tuple[str, ...]:
        """Names of the elementary errors of the machines."""
        return self.truth.functions.errors.names

    @property
    def equal_without_errors(self) -> bool:
        """True if model and machines without errors have equal readings and tool positions."""
        readings, tools = [], []
        for problem in (self.truth, self.model.problem):
            no_errors = np.zeros((1, len(problem.functions.errors.names)))
            readings.append(problem.predict(np.zeros(problem.n_free)) * problem.noise_ratio)
            tools.append(self.tool(problem.robot, no_errors)[0])
        return all(np.abs(one - other).max() < NEGLIGIBLE for one, other in (readings, tools))

    def draw(self, number: int) -> tuple[Array, np.random.Generator]:
        """True errors of a machine and its gauges, and the generator of its noise.

        The errors have the shape (n_free,), [prior std].
        """
        rng = np.random.default_rng((self.seed, number))
        drawn = rng.normal(size=self.truth.n_free)
        positive = [p.positive for p in self.truth.parameters]
        return np.where(positive, np.abs(drawn), drawn), rng

    def true_values(self, number: int, names: Sequence[str]) -> Array:
        """True values of identified parameters and of nuisance parameters of a machine, [SI].

        Args:
            number: Number of the machine.
            names: Names of the parameters; nuisance parameters that the machines lack are 0.
        """
        truth, n = self.truth, self.truth.n_machine
        scaled = self.draw(number)[0] * truth.theta_scale
        errors = truth.elementary_errors(scaled)
        identified = self.model.identified_part(errors[None], self.error_names)[0]
        values = dict(zip(truth.free[n:], scaled[n:], strict=True))
        values |= zip(self.model.problem.machine_selection.names, identified, strict=True)
        return np.array([values.get(name, 0.0) for name in names])

    def measure(self, numbers: Sequence[int]) -> MeasuredMachines:
        """Random machines and their readings."""
        draws, generators = zip(*(self.draw(n) for n in numbers), strict=True)
        truth, observations = self.truth, self.truth.observations
        theta = np.array(draws) * truth.theta_scale
        entries, _, closed = truth.simulate(theta)
        status = np.where(closed, CALIBRATED, NOT_CLOSED).astype(object)
        for i, rng in enumerate(generators):
            entries[i], _ = show_readings(truth.session, observations, entries[i], rng=rng)
        set_reason(status, np.asarray(~np.isfinite(entries).all(axis=1)), NO_CONTACT)
        rows = np.array([observations.rows(v) for v in entries])
        out_of_range = (rows < self.limits[0]) | (rows > self.limits[1])
        set_reason(status, np.asarray(out_of_range.any(axis=1)), OUT_OF_RANGE)
        return MeasuredMachines(truth.elementary_errors(theta), entries, rows, status)

    def estimate(self, measured: MeasuredMachines) -> list[Array]:
        """Estimates by each model, shape (n_sets, n_free), [SI].

        They are NaN if a machine cannot be calibrated; `measured.status` states the reason.
        """
        status = measured.status
        calibrated = np.flatnonzero(status == CALIBRATED)
        estimates = []
        for model in self.models:
            theta = np.full((len(status), model.problem.n_free), np.nan)
            if calibrated.size:
                theta[calibrated], converged = model.estimate(measured.values[calibrated])
                set_reason(status, calibrated[~converged], NOT_CONVERGED)
            estimates.append(theta)
        return estimates

    def tool_errors(self, measured: MeasuredMachines, estimates: Sequence[Array]) -> list[Array]:
        """Tool errors before and after calibration by each model, shape (C K, 3, n_sets), [m].

        Args:
            measured: The machines; `status` is changed if the loops of a machine do not close.
            estimates: Estimates by each model, shape (n_sets, n_free), [SI].
        """
        status = measured.status
        calibrated = np.flatnonzero(status == CALIBRATED)
        machines = [(self.truth.robot, measured.errors)]
        machines += [
            (m.problem.robot, m.problem.elementary_errors(t))
            for m, t in zip(self.models, estimates, strict=True)
        ]
        tools = np.full((len(machines), *self.tool.positions.shape, len(status)), np.nan)
        for tool, (robot, errors) in zip(tools, machines, strict=True):
            if calibrated.size:
                positions, closed = self.tool(robot, errors[calibrated])
                set_reason(status, calibrated[~closed], NOT_CLOSED)
                tool[..., calibrated] = positions
        tools[..., status != CALIBRATED] = np.nan
        return [tools[0] - self.tool.positions[..., None], *(tools[0] - t for t in tools[1:])]

    def weight_readings(self, model: MachineModel, count: int) -> MachineModel:
        """Model that weights the readings of each gauge as a calibration does.

        The weights are the stated noise if the model identifies all errors of the machines.
        Otherwise they are the medians of the estimates from residuals of a few pilot machines.

        Args:
            model: Model with the stated noise.
            count: Number of machines of the study.
        """
        if model.explains(self.truth):
            return model
        measured = self.measure(range(min(PILOT_MACHINES, count)))
        options, estimates = SolverOptions(solver="variable-projection"), []
        for rows in measured.rows[measured.status == CALIBRATED]:
            with suppress(SolverError, ClosureError):
                fit = fit_problem(model.problem.with_values(rows), options=options)
                estimates.append((fit.sigma, fit.sigma * fit.problem.noise_ratio))
        if not estimates:
            return model
        sigmas, weights = zip(*estimates, strict=True)
        sigma = max(float(np.median(sigmas)), model.sigma)
        weights = np.maximum(np.median(weights, axis=0), model.weights)
        return MachineModel(model.problem.with_noise_ratio(weights / sigma), sigma)


def set_reason(status: Status, which: NDArray[Any], reason: str) -> None:
    """Record why machines have no result; an earlier reason is not changed.

    Args:
        status: Status of the machines, shape (n_sets,); it is changed.
        which: Mask or indices of the machines.
        reason: The reason.
    """
    selected = np.zeros(len(status), dtype=np.bool_)
    selected[which] = True
    status[selected & (status == CALIBRATED)] = reason
