"""Linearised complete model of a session: all errors of the machine and of its sensors at once."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property, lru_cache
from typing import Any, TypeVar, cast

import numpy as np

from orthocal.arrays import Array, Indices, Mask
from orthocal.errors import ClosureError, SessionError
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.estimation.linear import require_finite
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.selection import select_parameters
from orthocal.estimation.weighting import DEFAULT_SIGMA, initial_noise_ratio
from orthocal.hypotheses.hypothesis import (
    MOST_DENSE,
    MachineShift,
    Patterns,
    Sparse,
    SystematicEffect,
    row_products,
)
from orthocal.hypotheses.likelihood import Likelihood, Products, build_likelihood
from orthocal.observation.model import predict_readings
from orthocal.sensors.protocol import DIMENSION_STEP, stated_dimensions
from orthocal.session.session import Session, Setup
from orthocal.statistics.distributions import log_positive_share
from orthocal.statistics.noise import noise_floor
from orthocal.statistics.zeros import project_out_zeros

Result = TypeVar("Result")

KEPT = 6
"""Models that are kept."""

MOST_ROUNDS = 2
"""Relinearisations per hypothesis."""

NEAR = 0.2
"""Change of the errors, in prior std, below which a linearisation is kept."""

FURTHEST = 6.0
"""Errors, in prior std, beyond which a hypothesis is not relinearised."""

MOST_ENTRIES = 1600
"""Entries of all points that are linearised together, for their memory."""

MOST_STEPS = 8
"""Gauss-Newton steps to the most likely machine."""

SETTLED = 0.02
"""Change of the errors, in prior std, below which the most likely machine is found."""

HIDDEN = 0.1
"""Effect of a prior std on readings that counts as none, [σ]."""

LEAST_SIGMA = 1e-9
"""Least standard deviation of a reading, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class ModelLinearisation:
    """Linearised model about one machine, gauge zeros projected out.

    With K sessions each may have a machine that differs by known errors (`shifts`).
    """

    expected: Array
    """Predictions for the reference machine, to first order, shape (n_entries,), [m]."""
    slopes: Array
    """∂h per prior std of each error, shape (n_entries, n_free), [m]; empty where no hypothesis
    needs them."""
    likelihood: Likelihood
    errors: Array
    """Errors per principal direction, shape (n_free, r), [prior std]."""
    sizes: Array
    """Singular values, shape (r,), [m]."""
    theta: Array
    """Errors at the point of linearisation less the reference, shape (n_free,), [prior std]."""
    passive: Array
    """Passive coordinates there, shape (n_states, n_passive), [m, rad]."""

    def errors_for(
        self, deviation: Array, *, tolerance_scale: float = 1.0, noise_scale: float = 1.0
    ) -> Array:
        """Most likely errors for a deviation, shape (n_free,), [prior std]."""
        e2 = tolerance_scale**2
        variance = e2 * self.sizes**2 + (noise_scale * self.likelihood.sigma) ** 2
        along = self.likelihood.directions @ deviation
        return np.asarray(self.errors @ (e2 * self.sizes / variance * along))

    def log_positive_share(
        self, deviation: Array, positive: Mask, *, tolerance_scale: float, noise_scale: float
    ) -> float:
        """Gain of the log likelihood by half-normal in place of normal priors.

        ln 2ᵏ P(θ₊ > 0 | y), for k errors that are never negative: their prior density is twice that
        of a normal prior, and only the positive part of the posterior counts.

        Args:
            deviation: As for `errors_for`.
            positive: Mask of these errors, shape (n_free,).
            tolerance_scale: As for `errors_for`.
            noise_scale: As for `errors_for`.
        """
        scales = {"tolerance_scale": tolerance_scale, "noise_scale": noise_scale}
        mean = self.errors_for(deviation, **scales)[positive]
        known = tolerance_scale**2 * self.sizes**2
        known /= known + (noise_scale * self.likelihood.sigma) ** 2
        rows = self.errors[positive]
        covariance = tolerance_scale**2 * (np.eye(len(rows)) - rows * known @ rows.T)
        return len(rows) * math.log(2.0) + log_positive_share(mean, covariance)


@dataclass(frozen=True, slots=True, eq=False)
class LinearisationPoint:
    """A machine about which the model is linearised."""

    theta: Array
    """Errors less the reference, shape (n_free,), [prior std]."""
    shifts: Sequence[MachineShift]
    """Known differences of the machine in some of the sessions."""
    start: Array
    """Passive coordinates to start from, shape (n_states, n_passive), [m, rad]."""


class LinearModel:
    """Predictions and derivatives of a session for all errors of the machine and its sensors.

    All calls of the calibration problem by the hypothesis engine are here.

    Args:
        session: A session, or several joined ones.
        names: Errors that the machine may have; all by default.

    Raises:
        RobotError: If closures of the robot depend on each other.
    """

    def __init__(self, session: Session, names: Sequence[str] | None = None) -> None:
        session = _refer_to_most_corrected(session)
        free = machine_errors(session.robot) if names is None else names
        selection = select_parameters(session.robot.parameters, free=free, prior=True)
        problem = CalibrationProblem(session, selection)
        self.problem = problem.with_noise_ratio(initial_noise_ratio(session, problem.observations))
        o = self.problem.observations
        self.stated = session.gauge.sigma is not None
        floor = noise_floor(session.gauge.sigma or DEFAULT_SIGMA, session.gauge.resolution)
        self.sigma = max(floor, LEAST_SIGMA)
        """Standard deviation of a reading of the first gauge, in whose metres all entries are."""
        self.dof = o.size - o.n_zeros
        self.labels, self.session_of_entry = label_sessions(session, o.setup)
        self._counts = np.bincount(o.zero, minlength=o.n_zeros).astype(np.float64)
        self._incidence = self.problem.zero_incidence
        self._shared: dict[Hashable, object] = {}
        self._kept_most_likely: list[tuple[bytes, ModelLinearisation]] = []

    def with_values(self, values: Array) -> LinearModel:
        """The model for other readings of the same rows, shape (n_rows,), [m]."""
        other = copy.copy(self)
        other.problem = self.problem.with_values(values)
        return other

    def share(self, name: Hashable, compute: Callable[[], Result]) -> Result:
        """A result that does not depend on the values of the readings, computed once."""
        if name not in self._shared:
            self._shared[name] = compute()
        return cast(Result, self._shared[name])

    def at_reference(self, *, slopes: bool) -> ModelLinearisation:
        """The model linearised about the machine without errors; errors as for `linearise`.

        A nuisance parameter that changes readings noticeably, but to second order, such as the
        height of a fixed ball across the plane of motion, has one standard deviation there.
        """

        def linearise() -> ModelLinearisation:
            theta = np.zeros(self.problem.n_free)
            about = self.linearise(theta, (), None, slopes=True)
            theta[self._find_hidden(about)] = 1.0
            if theta.any():
                about = self.linearise(theta, (), about.passive, slopes=slopes)
            return about if slopes else replace(about, slopes=np.empty((len(about.slopes), 0)))

        return self.share(("reference", slopes), linearise)

    def _find_hidden(self, about: ModelLinearisation) -> Indices:
        """Nuisance parameters without effect on readings at 0, but with one at their prior std."""
        n = self.problem.n_machine
        hidden = n + np.flatnonzero(np.abs(about.slopes[:, n:]).max(axis=0) < HIDDEN * self.sigma)
        if not hidden.size:
            return hidden
        theta = np.zeros(self.problem.n_free)
        theta[hidden] = 1.0
        beside = self.linearise(theta, (), about.passive, slopes=True)
        return np.asarray(hidden[np.abs(beside.slopes[:, hidden]).max(axis=0) > self.sigma])

    @property
    def offsets(self) -> dict[str, int]:
        """Drive to the place of its offset among the free parameters."""
        place = {name: i for i, name in enumerate(self.problem.free)}
        drives = self.problem.robot.drives
        return {d.name: place[f"{d.name}.offset"] for d in drives if f"{d.name}.offset" in place}

    @property
    def active(self) -> Array:
        """Offsets stated as active in the controller, shape (n_sessions, n_drives), [m, rad]."""
        session = self.problem.session
        indices = [
            session.active_offsets if s.active is None else s.active
            for s in session.setups.values()
        ]
        setups = self.problem.observations.setup
        first = [
            int(setups[np.argmax(self.session_of_entry == k)]) for k in range(len(self.labels))
        ]
        return np.array([indices[i] for i in first])

    @property
    def order(self) -> Indices:
        """Sessions in the order of measuring, shape (n_sessions,).

        By the times of their readings where all state them. Otherwise those without active offsets
        come first, the others in the order in which they were joined.
        """
        session = self.problem.session
        keys: list[datetime | bool] = [bool(a.any()) for a in self.active]
        times: dict[str, list[datetime | None]] = {}
        for r in session.readings:
            time = None if r.conditions is None else r.conditions.time
            times.setdefault(r.setup.partition("/")[0], []).append(time)
        if session.joined and None not in (t for several in times.values() for t in several):
            firsts = {
                k: min(t.replace(tzinfo=t.tzinfo or UTC) for t in v if t) for k, v in times.items()
            }
            keys = [firsts[label] for label in self.labels]
        return np.array(sorted(range(len(self.labels)), key=keys.__getitem__))

    @cached_property
    def to_entries(self) -> Sparse:
        """Entries per row of the session, in the first gauge's metres, (n_rows, n_entries)."""
        o = self.problem.observations
        n = o.plus.size
        if n > MOST_DENSE and self._has_single_zeros:
            from scipy.sparse import csr_array

            return csr_array(
                (1.0 / self.problem.noise_ratio[o.plus], (np.arange(n), o.plus)), (n, o.size)
            )
        blocks = np.array([o.values(row) / self.problem.noise_ratio for row in np.eye(n)])
        if n <= MOST_DENSE:
            return blocks
        from scipy.sparse import csr_array

        return csr_array(blocks)

    def entries(self, rows: Array) -> Array:
        """Entries of rows, zeros projected out, shape (h, n_entries), [m].

        Args:
            rows: Shape (h, n_rows), [m].
        """
        return self.project(np.asarray(self.to_entries.T @ rows.T).T)

    def project(self, entries: Array) -> Array:
        """Vectors over the entries with their gauge zeros projected out, shape (h, n_entries)."""
        o = self.problem.observations
        return np.asarray(project_out_zeros(np.ascontiguousarray(entries.T), o).T)

    def linearise(
        self, theta: Array, shifts: Sequence[MachineShift], start: Array | None, *, slopes: bool
    ) -> ModelLinearisation:
        """Linearise the model.

        Args:
            theta: Errors less the reference, shape (n_free,), [prior std].
            shifts: Known differences of the machine in some of the sessions.
            start: Passive coordinates to start from.
            slopes: Whether to keep the derivatives.

        Raises:
            ClosureError: If the machine cannot reach a posture.
            SessionError: If a predicted reading is not finite.
        """
        machines, of_session = self._machines(theta, shifts)
        starts = None if start is None else np.broadcast_to(start, (len(machines), *start.shape))
        return self._assemble(theta, of_session, *self._predict(machines, starts), slopes=slopes)

    def linearise_all(
        self, points: Sequence[LinearisationPoint], *, slopes: bool
    ) -> list[ModelLinearisation | None]:
        """Linearise the model about several points: half the time of one after the other.

        Args:
            points: The points.
            slopes: Whether to keep the derivatives.

        Returns:
            The linearisations; None where a machine cannot reach a posture, or a predicted reading
            is not finite.
        """
        size = max(1, MOST_ENTRIES // self.problem.observations.size)
        return [
            linear
            for first in range(0, len(points), size)
            for linear in self._linearise_some(points[first : first + size], slopes=slopes)
        ]

    def _linearise_some(
        self, points: Sequence[LinearisationPoint], *, slopes: bool
    ) -> Iterator[ModelLinearisation | None]:
        """Linearise the model about a few points at once, or one by one if one of them fails."""
        machines = [self._machines(p.theta, p.shifts) for p in points]
        place: dict[tuple[bytes, int], int] = {}
        rows = [
            [place.setdefault((theta.tobytes(), id(p.start)), len(place)) for theta in thetas]
            for p, (thetas, _) in zip(points, machines, strict=True)
        ]
        every = np.empty((len(place), self.problem.n_free))
        starts = np.empty((len(place), *points[0].start.shape))
        for point, (thetas, _), at in zip(points, machines, rows, strict=True):
            every[at], starts[at] = thetas, point.start
        together = None
        if len(points) > 1:
            with suppress(ClosureError, np.linalg.LinAlgError):
                together = self._predict(every, starts)
        for point, (thetas, of_session), at in zip(points, machines, rows, strict=True):
            try:
                predicted = (
                    self._predict(thetas, starts[at])
                    if together is None
                    else [values[at] for values in together]
                )
                yield self._assemble(point.theta, of_session, *predicted, slopes=slopes)
            except (ClosureError, SessionError, np.linalg.LinAlgError):
                yield None

    def _machines(self, theta: Array, shifts: Sequence[MachineShift]) -> tuple[Array, Indices]:
        """Different machines, shape (M, n_free), [SI], and that of each session, shape (K,)."""
        each = [
            sum((s.direction for s in shifts if s.sessions[k]), np.zeros_like(theta))
            for k in range(len(self.labels))
        ]
        different = {shift.tobytes(): shift for shift in each}
        place = {key: m for m, key in enumerate(different)}
        errors = (theta + np.array(list(different.values()))) * self.problem.theta_scale
        return self.problem.active_theta + errors, np.array([place[s.tobytes()] for s in each])

    def _predict(self, machines: Array, starts: Array | None) -> tuple[Array, Array, Array]:
        """Readings, their derivatives and the passive coordinates of machines.

        Args:
            machines: Shape (M, n_free), [SI].
            starts: Passive coordinates to start from, shape (M, n_states, n_passive).

        Returns:
            Shapes (M, n_entries), (M, n_entries, n_free) and (M, n_states, n_passive).
        """
        passive = self.problem.close(machines, start=starts)
        return *self.problem.predict_and_jacobian(machines, passive), passive

    def _assemble(
        self,
        theta: Array,
        of_session: Indices,
        readings: Array,
        jacobians: Array,
        passive: Array,
        *,
        slopes: bool,
    ) -> ModelLinearisation:
        """Linearisation from the readings of the machine of each session.

        Raises:
            SessionError: If a predicted reading is not finite.
        """
        o, which = self.problem.observations, of_session[self.session_of_entry]
        every = np.arange(o.size)
        expected, jacobian = readings[which, every], jacobians[which, every]
        require_finite(self.problem, expected, jacobian)
        jacobian = project_out_zeros(jacobian, o)
        likelihood, vectors, sizes = build_likelihood(
            jacobian, sigma=self.sigma, dof=self.dof, stated=self.stated
        )
        return ModelLinearisation(
            project_out_zeros(expected, o) - jacobian @ theta,
            jacobian if slopes else np.empty((o.size, 0)),
            likelihood,
            vectors,
            sizes,
            theta,
            passive[-1],
        )

    def most_likely(self, rows: Array) -> ModelLinearisation:
        """Linearise about the most likely machine, with the tolerances as prior.

        The result for the last readings is kept: a judgement and a recommendation need it.

        Args:
            rows: Readings, shape (n_rows,), [m].

        Raises:
            ClosureError: If the nominal machine cannot reach a posture.
        """
        key, kept = rows.tobytes(), self._kept_most_likely
        if not kept or kept[0][0] != key:
            entries = self.entries(rows[None])[0]
            kept[:] = [(key, self._approach(entries, np.zeros_like(entries)))]
        return kept[0][1]

    def predict_row(self, rows: Array, row: int) -> tuple[float, float]:
        """Predictive distribution of a reading, conditional on all other readings.

        y_i | y_j, j ≠ i, about the machine that is most likely by the others, with errors at their
        tolerances, noise as stated and free gauge zeros. A reading that says nothing is the sum of
        its prediction and an effect of unknown amount.

        Args:
            rows: Readings, shape (n_rows,), [m]; the value of the predicted one does not matter.
            row: Place of the predicted reading.

        Returns:
            Mean and standard deviation, [m]; NaN and infinity for a reading that no other one
            predicts, such as the first of a setup.

        Raises:
            ClosureError: If the nominal machine cannot reach a posture.
        """
        entries, effect = self.entries(np.array([rows, np.arange(rows.size) == row]))
        about = self._approach(entries, effect)
        (amount,), (std,) = about.likelihood.estimate_amounts(
            entries - about.expected, effect[None]
        )
        return (math.nan if math.isinf(std) else float(rows[row] - amount)), float(std)

    def predict_left_out(self, rows: Array) -> Array:
        """Errors of the prediction of each setup from all others, shape (n_rows,), [m].

        About the most likely machine, with errors at their tolerances and noise as stated.

        Args:
            rows: Readings, shape (n_rows,), [m].

        Raises:
            ClosureError: If the nominal machine cannot reach a posture.
        """
        near = self.most_likely(rows)
        about = self.linearise(near.theta, (), near.passive, slopes=True)
        deviation = self.entries(rows[None])[0] - about.expected
        o, errors = self.problem.observations, np.zeros(deviation.size)
        for setup in np.unique(o.setup):
            out = o.setup == setup
            slopes = about.slopes[~out]
            normal = slopes.T @ slopes + self.sigma**2 * np.eye(slopes.shape[1])
            theta = np.linalg.solve(normal, slopes.T @ deviation[~out])
            errors[out] = deviation[out] - about.slopes[out] @ theta
        return o.rows(errors * self.problem.noise_ratio)

    def _approach(self, entries: Array, effect: Array) -> ModelLinearisation:
        """Linearise about the most likely machine, beside an effect of unknown amount.

        Gauss-Newton steps end when the errors change by less than SETTLED prior std, or before the
        first machine that cannot reach a posture. Readings are not linear over offsets of some mm.

        Args:
            entries: Readings, zeros projected out, shape (n_entries,), [m].
            effect: Effect per unit, zeros projected out, shape (n_entries,); 0 for none.
        """
        about = self.at_reference(slopes=False)
        for _ in range(MOST_STEPS):
            deviation = entries - about.expected
            (amount,), _ = about.likelihood.estimate_amounts(deviation, effect[None])
            errors = about.errors_for(deviation - amount * effect)
            if not np.abs(errors - about.theta).max(initial=0.0) > SETTLED:
                break
            try:
                about = self.linearise(errors, (), about.passive, slopes=False)
            except (ClosureError, SessionError, np.linalg.LinAlgError):
                break
        return about

    def linearise_effect(self, name: str) -> SystematicEffect:
        """Change of the rows by an effect that the robot lacks, about the nominal machine.

        Args:
            name: Name of the effect.

        Raises:
            RobotError: If the effect needs keys that the robot's YAML lacks.
        """
        session, o = self.problem.session, self.problem.observations
        robot = session.robot
        other = session.with_effects((*robot.effect_names, name))
        known = other.robot.parameters
        errors = [n for n in known.names if n not in robot.parameters]
        offsets = [self.problem.free[i] for i in self.offsets.values()]
        selection = select_parameters(known, free=[*offsets, *errors], prior=True)
        problem = CalibrationProblem(other, selection)
        reading, jacobian = problem.predict_and_jacobian(problem.active_theta)
        nominal = self.problem.predict(self.problem.active_theta) * self.problem.noise_ratio
        present = set(self.problem.free) | set(offsets)
        new = [i for i, n in enumerate(problem.free) if n not in present]
        return SystematicEffect(
            name,
            tuple(problem.parameters[i] for i in new),
            o.rows(reading - nominal),
            o.rows(jacobian[:, new]).T,
        )

    def nuisance_columns(self) -> Array:
        """Change of the rows by one prior std of each nuisance parameter, [m].

        About the machine without errors, shape (n_nuisance, n_rows); zeros are not projected out.
        """

        def compute() -> Array:
            problem = self.problem
            passive = self.at_reference(slopes=False).passive
            _, jacobian = problem.predict_and_jacobian(problem.active_theta, passive)
            columns = jacobian[:, problem.n_machine :] * problem.noise_ratio[:, None]
            return problem.observations.rows(columns).T

        return self.share("nuisance", compute)

    def dimension_changes(self) -> dict[tuple[str, str], dict[str, Array]]:
        """Change of the rows by each dimension that setups state, per unit, (n_rows,) each.

        About the machine without errors.

        Returns:
            Key of the dimension and its stated size, to setup, to the change.
        """

        def compute() -> dict[tuple[str, str], dict[str, Array]]:
            session, o = self.problem.session, self.problem.observations
            setups = {r.setup: session.setups[r.setup] for r in session.readings}
            larger: dict[str, Setup] = {}
            sizes: dict[str, tuple[str, str]] = {}
            for name, setup in setups.items():
                for key, sensor in stated_dimensions(setup.sensor).items():
                    larger[name] = replace(setup, sensor=sensor)
                    sizes[name] = key, _stated(setup.sensor.to_keys(), key)
            if not larger:
                return {}
            other = replace(session, setups={**session.setups, **larger})
            passive = self.at_reference(slopes=False).passive
            stated, changed = (
                o.rows(predict_readings(s, observations=o, passive=passive))
                for s in (session, other)
            )
            change = (changed - stated) / DIMENSION_STEP
            changes: dict[tuple[str, str], dict[str, Array]] = {}
            for name, size in sizes.items():
                of_setup = [r.setup == name for r in session.readings]
                changes.setdefault(size, {})[name] = np.where(of_setup, change, 0.0)
            return changes

        return self.share("dimensions", compute)

    def shift_entries(self, about: ModelLinearisation, shift: MachineShift) -> Array:
        """Effect of a machine shift on the entries, zeros projected out, (n_entries,), [m]."""
        moved = np.asarray(about.slopes @ shift.direction)
        changed = np.where(shift.sessions[self.session_of_entry], moved, 0.0)
        return np.asarray(self.project(changed[None])[0])

    def products(
        self, patterns: Patterns, about: ModelLinearisation, deviation: Array
    ) -> tuple[Products, Array]:
        """Products of patterns over the rows with the principal directions and a deviation.

        Args:
            patterns: Over the rows, shape (h, n_rows), [m].
            about: The linearisation.
            deviation: Shape (n_entries,), zeros projected out, [m].

        Returns:
            The products; and the inner products with the deviation, shape (h,), [m²].
        """
        directions = about.likelihood.directions
        patterns = self._write_out(patterns)
        entries = patterns.rows @ self.to_entries
        square = row_products(entries, entries)
        if patterns.tails is not None:  # an entry is a row over its noise
            scale = np.asarray(self.to_entries.sum(axis=1))
            square += patterns.tails.product(scale[:, None] ** 2, power=2)[:, 0]
        square -= self._sums_by_zero(patterns) ** 2 @ (1.0 / self._counts)
        along = patterns.product(self.to_entries @ directions.T)
        cross = patterns.product((self.to_entries @ deviation)[:, None])[:, 0]
        return Products(along, np.maximum(square, 0.0)), cross

    def inner(self, patterns: Patterns, others: Patterns) -> Array:
        """Inner products of patterns, pair by pair, zeros projected out, shape (h,), [m²].

        Args:
            patterns: Over the rows, shape (h, n_rows).
            others: The same number, without tails. Tails are 0 in their rows.
        """
        patterns = self._write_out(patterns)
        one, other = (p.rows @ self.to_entries for p in (patterns, others))
        means = self._sums_by_zero(patterns) * self._sums_by_zero(others) @ (1.0 / self._counts)
        return row_products(one, other) - means

    def _sums_by_zero(self, patterns: Patterns) -> Array:
        """Sums of the entries of patterns over each gauge zero, shape (h, n_zeros), [m]."""
        return patterns.product(np.asarray(self.to_entries @ self._incidence))

    def _write_out(self, patterns: Patterns) -> Patterns:
        """Patterns without tails, where cumulative sums do not apply or gain little."""
        few = isinstance(patterns.rows, np.ndarray)
        if patterns.tails is None or (self._has_single_zeros and not few):
            return patterns
        return Patterns(patterns.to_sparse())

    @property
    def _has_single_zeros(self) -> bool:
        """True if all rows are single readings, so that the rows of a setup share one zero."""
        return bool((self.problem.observations.minus < 0).all())

    def rms(self, deviation: Array, about: ModelLinearisation) -> float:
        """RMS residual of a machine within its tolerances, to first order, [m].

        Args:
            deviation: Readings less predictions, shape (n_entries,), zeros projected out, [m].
            about: The linearisation.
        """
        errors = about.errors_for(deviation)
        along = about.sizes * (about.errors.T @ errors)
        residuals = (deviation - along @ about.likelihood.directions) * self.problem.noise_ratio
        return float(np.sqrt(np.mean(self.problem.observations.rows(residuals) ** 2)))


def linear_model(
    session: Session, model: str | None = None, *, free: tuple[str, ...] = ()
) -> LinearModel:
    """Linearised model; of the last sessions with the same rows it is built once.

    Args:
        session: As for `LinearModel`.
        model: Name of the model of the errors that the machine may have; all by default.
        free: Names of further errors.

    Raises:
        RobotError: As for `LinearModel`.
        ParameterError: If the model or a name is unknown.
    """
    robot = session.robot
    names = machine_errors(robot) if model is None else robot.parameters.select_model(model)
    return _build(_Rows(session, (*names, *free))).with_values(session.values)


class _Rows:
    """All of a session but the values of its readings; equal for the same objects.

    The values of several gauges count: the ratio of their noise may come from them.
    """

    def __init__(self, session: Session, names: tuple[str, ...]) -> None:
        self.session, self.names = session, names
        offsets = session.controller_offsets
        gauges = {session.setups[r.setup].gauge for r in session.readings}
        same = (
            *(session.robot, session.postures, session.setups, *session.gauges.values()),
            *(session.compensation, session.firmware, session.adjusted, session.path),
        )
        self._key = (
            *map(id, same),
            *(None if offsets is None else offsets.tobytes(), session.joined, names),
            session.values.tobytes() if len(gauges) > 1 else None,
            tuple(
                (r.setup, r.posture, r.minus, r.cycle, r.line, r.file, r.conditions)
                for r in session.readings
            ),
        )

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Rows) and self._key == other._key


@lru_cache(maxsize=KEPT)
def _build(rows: _Rows) -> LinearModel:
    return LinearModel(rows.session, rows.names)


def _refer_to_most_corrected(session: Session) -> Session:
    """Joined sessions with the largest active offsets of them as the reference of the errors.

    The reference, at which the prior is centred, does not depend on the order of the sessions.
    """
    if not session.joined:
        return session
    active = [
        session.active_offsets if s.active is None else s.active for s in session.setups.values()
    ]
    largest = max(active, key=lambda offsets: (float(np.abs(offsets).max()), *offsets.tolist()))
    return replace(session, controller_offsets=largest)


def label_sessions(session: Session, setup: Indices) -> tuple[tuple[str, ...], Indices]:
    """Names of joined sessions, and the session of each entry.

    Args:
        session: The session.
        setup: Setup of each entry, shape (n_entries,).

    Returns:
        Names of the sessions with readings, a single "" where none were joined; and the place
        among them, shape (n_entries,).
    """
    if not session.joined:
        return ("",), np.zeros(setup.size, dtype=np.int64)
    of_setup = [name.partition("/")[0] for name in session.setups]
    read = {of_setup[i] for i in np.unique(setup)}
    labels = tuple(n for n in dict.fromkeys(of_setup) if n in read)
    place = np.array([labels.index(n) if n in labels else -1 for n in of_setup])
    return labels, place[setup]


def _stated(keys: Mapping[str, Any], key: str) -> str:
    """Value of a key of a setup such as artefact.height_mm, as text."""
    first, _, others = key.partition(".")
    return _stated(keys[first], others) if others else f"{keys[first]:g}"
