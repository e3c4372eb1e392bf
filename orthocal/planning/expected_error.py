"""Expected tool error after a calibration from planned readings.

It is the mean over machines within their tolerances. For each machine the covariance of the errors
is computed to first order. It includes unmodelled errors and their effect on the identified
parameters.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.assessment.effect_limits import EffectLimits, find_limits
from orthocal.assessment.tool_error import (
    ErrorStatistics,
    ToolErrorStatistics,
    ToolUncertainty,
    measure_uncertainty,
)
from orthocal.errors import ClosureError
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.estimation.problem import CalibrationProblem, build_problem
from orthocal.estimation.selection import Selection
from orthocal.estimation.weighting import split_by_gauge
from orthocal.kinematics.conditions import UseSamples, effects_by_condition, sample_use
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.reachable_box import find_workspace
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.kinematics.workspace import Workspace
from orthocal.observation.gauge_noise import stated_sigma
from orthocal.observation.observations import build_observations
from orthocal.observation.sensor_groups import shared_gauge_parameters
from orthocal.robot.model import Robot
from orthocal.robot.parameters import is_offset
from orthocal.runtime.worker_pool import call_in_parallel, current_worker_budget
from orthocal.session.session import Session
from orthocal.statistics.information import VAGUE, Information, decompose, marginalise
from orthocal.statistics.noise import estimate_repeatability
from orthocal.statistics.zeros import project_out_zeros

Criterion = Literal["aligned", "relative", "absolute", "worst", "A", "D"]
"""Criterion of a plan. `aligned`, `relative`, `absolute`: RMS tool error. `worst`: error at the
worst point with translation and rotation removed. A, D: trace or determinant of the covariance of
the parameters, in prior std."""

CRITERIA: tuple[Criterion, ...] = get_args(Criterion)

WORST_POWER = 8.0
"""Exponent of the power mean that approximates the largest variance of the points."""

N_MACHINES = 12
"""Number of machines over which the expected error is averaged."""

MAX_LINEARISED = 1_500
"""Most readings of all machines that are linearised together. Machines with few readings share the
constant part of the time, which halves it for 24 readings."""

ENTERED_OFFSET_STD = 0.1
"""Standard deviation of the remaining offsets after offsets were entered, [prior std]."""


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """Expected tool error after a calibration."""

    tool: ToolUncertainty
    names: tuple[str, ...]
    """Identified parameters of the machine, then unmodelled ones."""
    prior_stds: Array
    """Prior standard deviations of these parameters, shape (n,), [SI]."""
    covariance: Array
    """Covariance of the errors of the estimate, shape (n, n), [SI]."""
    lost: float = 0.0
    """Fraction of the readings that are impossible on machines within their tolerances, because the
    tip misses the rod."""

    @property
    def sizes(self) -> ToolErrorStatistics:
        """Tool error in its three forms."""
        return self.tool.sizes

    @property
    def reported(self) -> ErrorStatistics:
        """Tool error in the reported form."""
        return self.tool.sizes.reported

    def rms_by(self, criterion: Criterion) -> float:
        """RMS tool error of a criterion, [m]; NaN if it minimises no RMS tool error."""
        sizes = self.sizes
        forms = {"aligned": sizes.reported, "relative": sizes.relative, "absolute": sizes.absolute}
        return forms[criterion].rms if criterion in forms else math.nan


class ToolForecast:
    """Expected tool errors of machines within their tolerances.

    Args:
        robot: The robot.
        selection: Identified parameters.
        workspace: Region over which the tool error is computed; by default the robot's.
        use: Conditions of use; by default those that the robot's YAML states.
        others: Unmodelled parameters with prior standard deviations, [SI]; by default all other
            errors of the machine.

    Raises:
        RobotError: If the drives do not command the tool.
        ClosureError: If the machine cannot reach the workspace.
    """

    def __init__(
        self,
        robot: Robot,
        selection: Selection,
        workspace: Workspace | None = None,
        *,
        use: UseSamples | None = None,
        others: Mapping[str, float] | None = None,
    ) -> None:
        self.robot, self.selection = robot, selection
        region = find_workspace(robot) if workspace is None else workspace
        use = sample_use(robot) if use is None else use
        parameters = robot.parameters
        free = selection.names
        determined = {parameters[n].terms[0][0] for n in (*free, *selection.fixed)}
        self.others = parameters.without_terms(
            machine_errors(robot) if others is None else others, determined
        )
        self.names = (*free, *self.others)
        stds = {**(others or {}), **{p.name: p.prior_std for p in selection.parameters}}
        self.prior_stds = np.array([stds.get(n, parameters[n].prior_std) for n in self.names])
        nominal = nominal_closure(robot)
        drives, passive = nominal.reach(region.points)
        self.workspace = region.repeat(use.size)
        """Workspace with its K points repeated for each of C conditions of use."""
        self.positions = np.tile(nominal.tcp(drives, passive), (use.size, 1))
        tools = [ToolSensitivity(robot, free=self.names, conditions=c) for c in use.conditions]
        closed = [passive]
        if effects_by_condition(robot):
            closed = [tool.closure.close(drives, start=passive) for tool in tools]
        self.jacobian = np.concatenate(
            [tool(drives, passive=q) for tool, q in zip(tools, closed, strict=True)]
        )
        """∂p/∂θ, shape (C K, 3, n_names), [m per parameter unit]."""

    @property
    def before(self) -> Expected:
        """Expected tool error of a machine without calibration."""
        return self._expected(np.diag(self.prior_stds**2))

    def align(self, field: Array) -> Array:
        """Tool errors with translation and rotation removed, shape (C K, 3, ...)."""
        return self.workspace.align(field, self.positions)

    def problem(self, session: Session) -> CalibrationProblem:
        """Calibration problem of a session's readings."""
        return with_gauge_noise(CalibrationProblem(session, self.selection))

    def limits(self, session: Session) -> tuple[EffectLimits, ...]:
        """Limits of the effects beside geometry, before and after a session's readings."""
        return find_limits(self.problem(session), stated_sigma(session.gauge))

    def prior_information(
        self, problem: CalibrationProblem, state: Sequence[str], measured: Session | None
    ) -> Array:
        """Inverse covariance of the state from its priors and from existing readings.

        The existing readings determine errors of the machine and of gauges that are used again. All
        their other parameters are marginalised. They include the positions of fixed balls and
        instruments, which further readings do not share.

        Args:
            problem: Problem whose free parameters include the state.
            state: Names of the parameters of the state.
            measured: Existing readings.

        Returns:
            Shape (n_state, n_state), in units of the prior standard deviations of `problem`.
        """
        index = [problem.free.index(name) for name in state]
        precision = np.maximum(problem.prior_precision[index], VAGUE)
        if measured is None:
            return np.diag(precision)
        existing = self.problem(measured)
        shared = {name: name for name in self.selection.names}
        shared |= shared_gauge_parameters(problem.session, measured)
        known = [i for i, name in enumerate(state) if name in shared]
        columns = [existing.free.index(shared[state[i]]) for i in known]
        scale = problem.theta_scale[index][known] / existing.theta_scale[columns]
        # joined sessions have the prior that the first of them states
        precision[known] = np.maximum(existing.prior_precision[columns], VAGUE) * scale**2
        others = [i for i in range(existing.n_free) if i not in columns]
        _, jacobian = existing.predict_and_jacobian(existing.active_theta)
        information = decompose(jacobian[:, columns + others], existing.observations)
        sigma = stated_sigma(measured.gauge)
        rows = marginalise(information, len(columns), sigma=sigma).factor * scale / sigma
        result = np.diag(precision)
        result[np.ix_(known, known)] += rows.T @ rows
        return result

    def after(
        self,
        session: Session,
        *,
        weights: Array | None = None,
        entered: bool = True,
        machines: Sequence[Array] | None = None,
    ) -> Expected:
        """Expected tool error after a calibration from a session's readings.

        The result is the mean over machines drawn from the priors, with mounting errors of their
        gauges. Each is linearised about itself, because a ball beside the crest of its rod is less
        sensitive.

        Args:
            session: Setups and postures; the values of the readings are not used.
            weights: Standard deviations that weight the readings, shape (n_entries,), [m]; by
                default those of the gauges. They are larger if the model omits errors.
            entered: True if identified offsets were entered before and the remaining ones are
                small; False to draw offsets from their priors.
            machines: Machines instead of drawn ones: free parameters of the session's problem,
                shape (n_free,) each, [SI].

        Raises:
            ClosureError: If no machine allows enough readings.
        """
        problem = self.problem(session)
        others = self._jacobian_of_others(session)
        drawn = self._draw(problem, entered=entered) if machines is None else machines
        theta = np.array(list(drawn))
        _, passive, reached = problem.simulate(theta)
        size = max(MAX_LINEARISED // max(problem.observations.size, 1), 1)
        budget = current_worker_budget()
        blocks = np.array_split(np.arange(len(theta)), max(budget, math.ceil(len(theta) / size)))

        def posteriors(block: Indices) -> list[tuple[Array | None, float]]:
            closed = block[reached[block]]
            jacobians = dict.fromkeys(block.tolist())
            if closed.size:
                _, of_closed = problem.predict_and_jacobian(theta[closed], passive[closed])
                jacobians.update(zip(closed.tolist(), of_closed, strict=True))
            for i in block[~reached[block]].tolist():
                with suppress(ClosureError):
                    jacobians[i] = problem.predict_and_jacobian(theta[i])[1]
            return [self._posterior(problem, others, j, weights) for j in jacobians.values()]

        results = [
            result
            for of_block in call_in_parallel([partial(posteriors, b) for b in blocks])
            for result in of_block
        ]
        covariances = [covariance for covariance, _ in results if covariance is not None]
        lost = sum(fraction / len(theta) for _, fraction in results)
        if not covariances:
            raise ClosureError(
                "cannot be read on machines within their tolerances", posture="the planned ones"
            )
        return replace(self._expected(np.mean(covariances, axis=0)), lost=lost)

    def about_nominal(self, session: Session) -> Expected:
        """Expected tool error to first order about the nominal machine, as in the search."""
        return self.after(session, machines=[self.problem(session).active_theta])

    def _jacobian_of_others(self, session: Session) -> Array | None:
        """Change of a session's readings by one prior std of each unmodelled error.

        The shape is (n_entries, n_others), [m]. None without unmodelled errors.
        """
        if not self.others:
            return None
        n = len(self.selection.names)
        stds = dict(zip(self.others, self.prior_stds[n:].tolist(), strict=True))
        problem = with_gauge_noise(
            build_problem(session, free=self.others, prior=True, prior_stds=stds)
        )
        _, jacobian = problem.predict_and_jacobian(np.zeros(problem.n_free))
        return jacobian[:, : len(self.others)]

    def _draw(self, problem: CalibrationProblem, *, entered: bool) -> Iterator[Array]:
        """Draw machines within their tolerances, with mounting errors of their gauges.

        Yields:
            Free parameters, shape (n_free,), [SI].
        """
        offsets = [i for i, name in enumerate(problem.free) if is_offset(name)]
        for seed in range(N_MACHINES):
            drawn = np.random.default_rng(seed).normal(size=problem.n_free) * problem.theta_scale
            if entered:
                drawn[offsets] *= ENTERED_OFFSET_STD
            # parameters without a prior are drawn, too
            yield problem.active_theta + drawn

    def _posterior(
        self,
        problem: CalibrationProblem,
        others: Array | None,
        jacobian: Array | None,
        weights: Array | None = None,
    ) -> tuple[Array | None, float]:
        """Covariance of the errors of the estimate about a machine.

        Args:
            problem: Calibration problem of the readings.
            others: Jacobian of unmodelled errors, shape (n_entries, n_others), [m per prior std].
            jacobian: Jacobian of the readings about the machine, shape (n_entries, n_free), [m per
                prior std]; None if the machine does not reach the postures.
            weights: As in `after`; equal for readings with a common zero.

        Returns:
            The covariance, shape (n_names, n_names), [SI], or None if too few readings are
            possible; and the fraction of impossible readings.
        """
        o, n = problem.observations, problem.n_machine
        if jacobian is None:
            return None, 1.0
        possible = np.asarray(np.isfinite(jacobian).all(axis=1))
        lost = 1.0 - float(possible.mean())
        if possible.sum() <= o.n_free_zeros:
            return None, lost
        o, noise = o.only(possible), stated_sigma(problem.session.gauge)
        inflation = np.ones((o.size, 1))  # of the standard deviations for weighting
        if weights is not None:
            inflation = (weights / (noise * problem.noise_ratio))[possible, None]
        precision = np.maximum(problem.prior_precision, VAGUE)
        jacobian = project_out_zeros(jacobian[possible], o) / inflation
        inverse = Information(jacobian).posterior(sigma=noise, precision=precision).covariance
        scale = problem.theta_scale[:n]
        # the scatter of the readings is smaller than their weights imply
        gain = inverse @ jacobian.T / noise
        covariance = inverse - gain * (1.0 - inflation.T**-2) @ gain.T
        identified = covariance[:n, :n] * np.outer(scale, scale)
        if others is None:
            return identified, lost
        others = project_out_zeros(others[possible], o) / inflation
        bias = (inverse @ (jacobian.T @ others) / noise**2)[:n] * scale[:, None]
        variance = np.diag(self.prior_stds[n:] ** 2)
        cross = bias * self.prior_stds[n:]
        return np.block([[identified + bias @ bias.T, -cross], [-cross.T, variance]]), lost

    def _expected(self, covariance: Array) -> Expected:
        """Expected tool error for a covariance of the errors, shape (n_names, n_names), [SI]."""
        tool = measure_uncertainty(self.jacobian, covariance, self.workspace, self.positions)
        return Expected(tool, self.names, self.prior_stds, covariance)

    def weight_of(self, criterion: Criterion, n_state: int) -> CriterionWeight:
        """Weight of a criterion for a state that begins with the identified parameters."""
        n = len(self.selection.names)
        scaled = self.jacobian[:, :, :n] * self.prior_stds[:n]
        if criterion in ("aligned", "worst"):
            field = self.align(scaled)
        elif criterion == "relative":
            field = self.workspace.remove_translation(scaled)
        else:
            field = scaled
        padded = np.zeros((*field.shape[:2], n_state))
        padded[:, :, :n] = field
        return CriterionWeight(criterion, padded, self.workspace.weights, n)


class CriterionWeight:
    """Root R of the weight of the state; tr(Rᵀ C R) is the square of a criterion.

    Args:
        criterion: The criterion.
        field: Jacobian of the tool errors, shape (C K, 3, n_state), [m per prior std].
        weights: Weights of the points, shape (C K,).
        n: Number of parameters of the machine, which are the first of the state.
    """

    def __init__(self, criterion: Criterion, field: Array, weights: Array, n: int) -> None:
        self._criterion, self._field, self._weights, self._n = criterion, field, weights, n
        self._constant = None if criterion in ("worst", "D") else self._mean_square()

    def __call__(self, covariance: Array) -> Array:
        """R for a covariance of the state, shape (n_state, p)."""
        if self._constant is not None:
            return self._constant
        if self._criterion == "worst":
            return self._worst(covariance)
        n = self._n
        root = np.zeros((len(covariance), n))
        # derivative of det(C)^(1/n) with respect to C: det(C)^(1/n) C⁻¹ / n
        values, vectors = np.linalg.eigh(covariance[:n, :n])
        values = np.maximum(values, 1e-300)
        mean = float(np.exp(np.mean(np.log(values))))
        root[:n] = vectors * np.sqrt(mean / (n * values))
        return root

    def _mean_square(self) -> Array:
        """R of the trace or of the mean square tool error, shape (n_state, p)."""
        if self._criterion == "A":
            size = self._field.shape[2]
            return np.asarray(np.eye(size)[:, : self._n] / np.sqrt(self._n))
        return _root(self._field, self._weights)

    def _worst(self, covariance: Array) -> Array:
        """R of the power mean of the points' variances, shape (n_state, p)."""
        variance = np.einsum("kin,nm,kim->k", self._field, covariance, self._field, optimize=True)
        share = (variance / variance.max()) ** (WORST_POWER - 1.0)
        total = float(np.mean(share * variance / variance.max()))
        weights = share * total ** (1.0 / WORST_POWER - 1.0) / len(share)
        return _root(self._field, weights)


def _root(field: Array, weights: Array) -> Array:
    """R with R Rᵀ = Σ w fᵀ f and the smallest number of columns, shape (n, p).

    Args:
        field: Jacobian f of each point, shape (K, 3, n).
        weights: Weights w of the points, shape (K,).
    """
    rows = (np.sqrt(weights)[:, None, None] * field).reshape(-1, field.shape[2])
    values, vectors = np.linalg.eigh(rows.T @ rows)
    positive = values > values[-1] * 1e-14
    return np.asarray(vectors[:, positive] * np.sqrt(values[positive]))


def with_gauge_noise(problem: CalibrationProblem) -> CalibrationProblem:
    """Problem with noise ratios from the stated repeatability of the gauges."""
    session = problem.session
    if len(session.gauges_with_readings) < 2:
        return problem
    noise = np.array([stated_sigma(session.gauges[s.gauge]) for s in session.setups.values()])
    return problem.with_noise_ratio(noise[problem.observations.setup] / stated_sigma(session.gauge))


def state_noise(session: Session) -> Session:
    """Session in which all gauges state their noise; if necessary, repeats estimate it.

    Raises:
        SessionError: If the repeatability of a gauge is unknown.
    """
    o = build_observations(session)
    gauges, unknown = dict(session.gauges), []
    for group in split_by_gauge(session, o):
        if group.gauge.sigma is not None or group.gauge.resolution is not None:
            continue
        values = o.values(session.values)[group.entries]
        sigma, dof = estimate_repeatability(values, o.only(group.entries))
        if dof and sigma > 0.0:
            gauges[group.name] = replace(group.gauge, sigma=sigma)
        else:
            unknown.append(group.name)
    reason = "; a plan needs the repeatability of the readings"
    session.refuse_missing(unknown, "sigma_mm", reason)
    return replace(session, gauges=gauges)
