"""Linearised complete model of a session: all errors of the machine and of its sensors at once."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.errors import ClosureError, SessionError
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.estimation.linear import require_finite
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.selection import select_parameters
from orthocal.estimation.weighting import initial_sigmas, split_by_gauge
from orthocal.hypotheses.hypothesis import (
    MAX_DENSE_COLUMNS,
    MachineShift,
    Patterns,
    Sparse,
    row_products,
    sparse_rows,
)
from orthocal.hypotheses.joined_sessions import JoinedSessions
from orthocal.hypotheses.likelihood import Products, build_likelihood
from orthocal.hypotheses.linearisation import LinearisationPoint, ModelLinearisation
from orthocal.observation.gauge_noise import assumed_sigma
from orthocal.observation.observations import Observations, build_observations
from orthocal.session.session import Session
from orthocal.statistics.zeros import project_out_zeros, zero_shares

MAX_JACOBIAN = 2_000_000
"""Largest size of the Jacobian of a single session in which drives may lose steps."""

CACHE_SIZE = 6
"""Number of cached models, and of cached most likely machines."""

MAX_RELINEARISATIONS = 2
"""Most relinearisations per hypothesis."""

SMALL_CHANGE = 0.2
"""Largest change of the errors without a relinearisation, [prior std]."""

LARGEST_ERROR = 6.0
"""Largest error about which a hypothesis is relinearised, [prior std]."""

MAX_LINEARISED_ENTRIES = 1600
"""Most entries of all points that are linearised at once, to limit the memory."""

MAX_HALVINGS = 4
"""Largest number of halvings of a step to a machine without all readings."""

MAX_STEPS = 8
"""Most Gauss-Newton steps to the most likely machine."""

CONVERGED_CHANGE = 0.02
"""Largest change of the errors in the last Gauss-Newton step, [prior std]."""

HIDDEN = 0.1
"""Largest change of readings by one prior std that counts as no change, [σ]."""


class LinearModel:
    """Predictions and derivatives of a session for all errors of the machine and its sensors.

    The search for anomalies calls the calibration problem through this class only. The values of
    the session's readings are not used, unless noise ratios are estimated from them.

    Args:
        session: A session, or several joined ones.
        names: Names of the errors that the machine may have; all by default.
        noise_effects: Effects that change readings of one posture, so that their scatter shows the
            noise of one of several gauges only without such a change; by default those of the
            session.
        sigmas: Standard deviations of the entries of several gauges, shape (n_entries,), [m]; by
            default those of `initial_sigmas`.

    Raises:
        RobotError: If closures of the robot depend on each other.
    """

    def __init__(
        self,
        session: Session,
        names: Sequence[str] | None = None,
        noise_effects: Sequence[str] | None = None,
        *,
        sigmas: Array | None = None,
    ) -> None:
        self._names = names
        session = _refer_to_most_corrected(session)
        free = machine_errors(session.robot) if names is None else names
        selection = select_parameters(session.robot.parameters, free=free, prior=True)
        problem = CalibrationProblem(session, selection)
        o = problem.observations
        gauges = split_by_gauge(session, o)
        if len(gauges) == 1:
            sigmas = np.full(o.size, assumed_sigma(session.gauge))
        elif sigmas is None:
            sigmas = _sigmas_of_entries(session, o, noise_effects)
        self._sigmas = sigmas
        self.stated = all(g.gauge.sigma is not None for g in gauges)
        self.sigma = float(sigmas[gauges[0].entries][0])
        """Standard deviation of a reading of the first gauge, [m]; all entries refer to it."""
        self.problem = problem.with_noise_ratio(sigmas / self.sigma)
        self.dof = o.size - o.n_free_zeros
        self.sessions = JoinedSessions.of(session, o.setup)
        self.reference = self.problem.active_theta.copy()
        """Free parameters of the reference, shape (n_free,), [SI]: the controller corrects its
        offsets and backlashes as stated. It is the mean of the prior."""
        compensated = self.sessions.compensated.max(axis=0).tolist()
        for drive, backlash in zip(session.robot.drives, compensated, strict=True):
            if (name := f"{drive.name}.backlash") in free:
                self.reference[self.problem.free.index(name)] = backlash
        self._shares = zero_shares(o)
        self._incidence = self.problem.zero_incidence
        self._references: dict[bool, ModelLinearisation] = {}

    def at_reference(self, *, keep_jacobian: bool) -> ModelLinearisation:
        """Linearisation about the machine without errors; raises as `linearise` does.

        Some nuisance parameters change readings noticeably, but only to second order, such as the
        height of a fixed ball across the plane of motion. They are one standard deviation there.
        """
        if keep_jacobian not in self._references:
            self._references[keep_jacobian] = self._linearise_reference(keep_jacobian=keep_jacobian)
        return self._references[keep_jacobian]

    def _linearise_reference(self, *, keep_jacobian: bool) -> ModelLinearisation:
        """Linearisation about the machine without errors."""
        theta = np.zeros(self.problem.n_free)
        about = self.linearise(theta, (), None, keep_jacobian=True)
        theta[self._find_hidden(about)] = 1.0
        if theta.any():
            return self.linearise(theta, (), about.passive, keep_jacobian=keep_jacobian)
        if keep_jacobian:
            return about
        none = np.empty((len(about.jacobian), 0))
        return replace(about, jacobian=none, complete_jacobian=none)

    def _find_hidden(self, about: ModelLinearisation) -> Indices:
        """Indices of nuisance parameters that change readings at one prior std, but not at 0."""
        n = self.problem.n_machine
        changes = np.abs(about.jacobian[:, n:]).max(axis=0)
        hidden = n + np.flatnonzero(changes < HIDDEN * self.sigma)
        if not hidden.size:
            return hidden
        theta = np.zeros(self.problem.n_free)
        theta[hidden] = 1.0
        displaced = self.linearise(theta, (), about.passive, keep_jacobian=True)
        return np.asarray(hidden[np.abs(displaced.jacobian[:, hidden]).max(axis=0) > self.sigma])

    @property
    def offsets(self) -> dict[str, int]:
        """Drive to the index of its offset among the free parameters."""
        place = {name: i for i, name in enumerate(self.problem.free)}
        drives = self.problem.robot.drives
        return {d.name: place[f"{d.name}.offset"] for d in drives if f"{d.name}.offset" in place}

    @cached_property
    def has_shifts(self) -> bool:
        """True if the machine may differ between readings, which needs their Jacobian.

        In a large single session it may not, because that would take much memory.
        """
        small = self.problem.observations.size * self.problem.n_free <= MAX_JACOBIAN
        several = len(self.sessions.labels) > 1 or bool(self.sessions.compensated.any())
        return several or (small and bool(self.offsets))

    @cached_property
    def to_entries(self) -> Sparse:
        """Entries per unit of each row, in units of the first gauge, (n_rows, n_entries)."""
        o, ratio = self.problem.observations, self.problem.noise_ratio
        if self._has_single_readings:
            return sparse_rows(list(o.plus[:, None]), list(1.0 / ratio[o.plus, None]), o.size)
        matrix = np.array([o.values(row) / ratio for row in np.eye(o.plus.size)])
        if len(matrix) <= MAX_DENSE_COLUMNS:
            return matrix
        from scipy.sparse import csr_array

        return csr_array(matrix)

    def entries(self, rows: Array) -> Array:
        """Entries of rows, zeros projected out, shape (h, n_entries), [m].

        Args:
            rows: Values of the rows, shape (h, n_rows), [m].
        """
        return self.project(np.asarray(self.to_entries.T @ rows.T).T)

    def project(self, entries: Array) -> Array:
        """Project gauge zeros out of vectors over the entries, shape (h, n_entries)."""
        o = self.problem.observations
        return np.asarray(project_out_zeros(np.ascontiguousarray(entries.T), o).T)

    def linearise(
        self,
        theta: Array,
        shifts: Sequence[MachineShift],
        start: Array | None,
        *,
        keep_jacobian: bool,
    ) -> ModelLinearisation:
        """Linearise the model.

        Args:
            theta: Errors minus those of the reference, shape (n_free,), [prior std].
            shifts: Known differences of the machine in some of the readings.
            start: Passive coordinates to start from, shape (n_states, n_passive), [m, rad].
            keep_jacobian: Whether the result includes the Jacobian.

        Raises:
            ClosureError: If the machine cannot reach a posture.
            SessionError: If a predicted reading is not finite.
        """
        machines, of_entry = self._machines(theta, shifts)
        starts = None if start is None else np.broadcast_to(start, (len(machines), *start.shape))
        return self._assemble(
            theta, of_entry, *self._predict(machines, starts), keep_jacobian=keep_jacobian
        )

    def linearise_all(
        self, points: Sequence[LinearisationPoint], *, keep_jacobian: bool
    ) -> list[ModelLinearisation | None]:
        """Linearise the model about several points, in half the time of separate calls.

        Args:
            points: The points.
            keep_jacobian: Whether the results include the Jacobian.

        Returns:
            The linearisations; None if a machine cannot reach a posture or a predicted reading is
            not finite.
        """
        size = max(1, MAX_LINEARISED_ENTRIES // self.problem.observations.size)
        return [
            linearisation
            for first in range(0, len(points), size)
            for linearisation in self._linearise_block(
                points[first : first + size], keep_jacobian=keep_jacobian
            )
        ]

    def _linearise_block(
        self, points: Sequence[LinearisationPoint], *, keep_jacobian: bool
    ) -> Iterator[ModelLinearisation | None]:
        """Linearise the model about a few points at once, or one by one if one of them fails."""
        machines = [self._machines(p.theta, p.shifts) for p in points]
        place: dict[tuple[bytes, int], int] = {}
        places = [
            [place.setdefault((theta.tobytes(), id(p.start)), len(place)) for theta in thetas]
            for p, (thetas, _) in zip(points, machines, strict=True)
        ]
        distinct = np.empty((len(place), self.problem.n_free))
        starts = np.empty((len(place), *points[0].start.shape))
        for point, (thetas, _), m in zip(points, machines, places, strict=True):
            distinct[m], starts[m] = thetas, point.start
        predictions = None
        if len(points) > 1:
            with suppress(ClosureError, np.linalg.LinAlgError):
                predictions = self._predict(distinct, starts)
        for point, (thetas, of_entry), m in zip(points, machines, places, strict=True):
            try:
                predicted = (
                    self._predict(thetas, starts[m])
                    if predictions is None
                    else [values[m] for values in predictions]
                )
                yield self._assemble(point.theta, of_entry, *predicted, keep_jacobian=keep_jacobian)
            except (ClosureError, SessionError, np.linalg.LinAlgError):
                yield None

    def _machines(self, theta: Array, shifts: Sequence[MachineShift]) -> tuple[Array, Indices]:
        """Errors of distinct machines and the machine of each entry.

        Returns:
            Free parameters of M machines, shape (M, n_free), [SI], and the machine of each entry,
            shape (n_entries,).
        """
        if not shifts:
            machine_of_entry = np.zeros(self.problem.observations.size, dtype=np.int64)
            return (self.reference + theta * self.problem.theta_scale)[None], machine_of_entry
        shifted = np.column_stack([s.entries for s in shifts])
        combinations, machine_of_entry = np.unique(shifted, axis=0, return_inverse=True)
        errors = theta + combinations @ np.array([s.direction for s in shifts])
        return self.reference + errors * self.problem.theta_scale, machine_of_entry.reshape(-1)

    def _predict(self, machines: Array, starts: Array | None) -> tuple[Array, Array, Array]:
        """Predicted entries, their Jacobians and the passive coordinates of machines.

        Args:
            machines: Free parameters, shape (M, n_free), [SI].
            starts: Passive coordinates to start from, shape (M, n_states, n_passive).

        Returns:
            Arrays of the shapes (M, n_entries), (M, n_entries, n_free), (M, n_states, n_passive).
        """
        passive = self.problem.close(machines, start=starts)
        return *self.problem.predict_and_jacobian(machines, passive), passive

    def _assemble(
        self,
        theta: Array,
        machine: Indices,
        readings: Array,
        jacobians: Array,
        passive: Array,
        *,
        keep_jacobian: bool,
    ) -> ModelLinearisation:
        """Linearisation from the predictions of the machine of each entry.

        Raises:
            SessionError: If a predicted reading is not finite.
        """
        o = self.problem.observations
        entry = np.arange(o.size)
        expected, complete = readings[machine, entry], jacobians[machine, entry]
        require_finite(self.problem, expected, complete)
        jacobian, none = project_out_zeros(complete, o), np.empty((o.size, 0))
        likelihood = build_likelihood(jacobian, sigma=self.sigma, dof=self.dof, stated=self.stated)
        return ModelLinearisation(
            project_out_zeros(expected, o) - jacobian @ theta,
            jacobian if keep_jacobian else none,
            complete if keep_jacobian else none,
            likelihood,
            theta,
            passive[-1],
        )

    def most_likely(self, rows: Array) -> ModelLinearisation:
        """Linearise about the most likely machine, with the tolerances as prior.

        The last results are cached because a judgement and a recommendation need the same.

        Args:
            rows: Readings, shape (n_rows,), [m].

        Raises:
            ClosureError: If the nominal machine cannot reach a posture.
        """
        return _cached_most_likely(self, rows.astype(np.float64).tobytes())

    def predict_row(self, rows: Array, row: int) -> tuple[float, float]:
        """Predictive distribution of a reading, conditional on all other readings.

        The distribution of y_i | y_j, j ≠ i, follows from a linearisation about the most likely
        machine of the other readings. Tolerances and noise are as stated, gauge zeros have flat
        priors. An effect of unknown amount removes the information of reading i.

        Args:
            rows: Readings, shape (n_rows,), [m]; the value of the predicted one has no influence.
            row: Index of the predicted reading.

        Returns:
            Mean and standard deviation, [m]; NaN and infinity if no other reading predicts it, such
            as for the only reading of a setup.

        Raises:
            ClosureError: If the nominal machine cannot reach a posture.
        """
        model = self._without_noise_of(row)
        entries, effect = model.entries(np.array([rows, np.arange(rows.size) == row]))
        about = model.approach(entries, effect)
        (amount,), (std,) = about.likelihood.estimate_amounts(
            entries - about.expected, effect[None]
        )
        return (math.nan if math.isinf(std) else float(rows[row] - amount)), float(std)

    def compare_row(self, rows: Array, row: int) -> tuple[float, float]:
        """Prediction of a reading, with a larger std than by `predict_row` if it is not linear.

        Readings are not linear over offsets of some mm. So a reading far from its prediction may
        show another machine that explains all readings nearly as well. In terms of the misfits to
        all readings and to the others, std = |y_i − mean| / √(χ²_all − χ²_others). It is that of
        `predict_row` if readings are linear.

        Args:
            rows: Readings, shape (n_rows,), [m].
            row: Index of the reading.

        Raises:
            ClosureError: If the nominal machine cannot reach a posture.
        """
        model = self._without_noise_of(row)
        mean, std = model.predict_row(rows, row)
        deviation = abs(rows[row] - mean)
        if not deviation > std:
            return mean, std
        with_mean = np.where(np.arange(rows.size) == row, mean, rows)
        misfits = []
        for values in (rows, with_mean):
            (entries,) = model.entries(values[None])
            about = model.approach(entries, np.zeros_like(entries))
            misfits.append(about.likelihood.misfit(entries - about.expected))
        increase = max(misfits[0] - misfits[1], 0.0)
        return mean, max(std, deviation / max(math.sqrt(increase), 1.0))

    def _without_noise_of(self, row: int) -> LinearModel:
        """Model whose noise is estimated without a row; the same model if it does not change."""
        session = self.problem.session
        if len(session.gauges_with_readings) == 1:
            return self
        sigmas = initial_sigmas(session, self.problem.observations, without=row)
        if np.array_equal(sigmas, self._sigmas):
            return self
        return LinearModel(session, self._names, sigmas=sigmas)

    def predict_left_out(self, rows: Array) -> Array:
        """Readings of each setup minus their predictions from all other setups, (n_rows,), [m].

        The model is linearised about the most likely machine. Tolerances and noise are as stated.

        Args:
            rows: Readings, shape (n_rows,), [m].

        Raises:
            ClosureError: If the nominal machine cannot reach a posture.
        """
        near = self.most_likely(rows)
        about = self.linearise(near.theta, (), near.passive, keep_jacobian=True)
        deviation = self.entries(rows[None])[0] - about.expected
        o, errors = self.problem.observations, np.zeros(deviation.size)
        for setup in np.unique(o.setup):
            left_out = o.setup == setup
            jacobian = about.jacobian[~left_out]
            normal = jacobian.T @ jacobian + self.sigma**2 * np.eye(jacobian.shape[1])
            theta = np.linalg.solve(normal, jacobian.T @ deviation[~left_out])
            errors[left_out] = deviation[left_out] - about.jacobian[left_out] @ theta
        return o.rows(errors * self.problem.noise_ratio)

    def approach(self, entries: Array, effect: Array) -> ModelLinearisation:
        """Linearise about the most likely machine, with a further effect of unknown amount.

        Directions that change readings only to second order, such as the height of a fixed ball
        across the plane of motion, may have an optimum on both sides; the more likely one counts.

        Args:
            entries: Readings, zeros projected out, shape (n_entries,), [m].
            effect: Effect per unit, zeros projected out, shape (n_entries,); 0 without an effect.
        """

        def misfit(about: ModelLinearisation) -> float:
            deviation = entries - about.expected
            (amount,), _ = about.likelihood.estimate_amounts(deviation, effect[None])
            return about.likelihood.misfit(deviation - amount * effect)

        best = self._descend(self.at_reference(keep_jacobian=False), entries, effect)
        mirrored = [LinearisationPoint(t, (), best.passive) for t in self._mirrored(best)]
        starts = self.linearise_all(mirrored, keep_jacobian=False)
        minima = [best, *(self._descend(s, entries, effect) for s in starts if s is not None)]
        return min(minima, key=misfit)

    def _mirrored(self, about: ModelLinearisation) -> Array:
        """Starts on the other sides of directions of second order, (n_starts, n_free)."""
        problem = self.problem
        directions = problem.mirrored.of_task(self.sigma, ())
        if not len(directions):
            return np.empty((0, problem.n_free))
        theta = self.reference + about.theta * problem.theta_scale
        starts = problem.mirrored_starts(theta[None], about.passive[None], directions)
        return np.asarray((starts[:, 0] - self.reference) / problem.theta_scale)

    def _descend(
        self, about: ModelLinearisation, entries: Array, effect: Array
    ) -> ModelLinearisation:
        """Gauss-Newton steps, because readings are not linear over offsets of some mm.

        They end when no error changes by more than CONVERGED_CHANGE. A step to a machine that
        cannot reach a posture, or whose rod the tip misses, is halved.
        """
        for _ in range(MAX_STEPS):
            deviation = entries - about.expected
            (amount,), _ = about.likelihood.estimate_amounts(deviation, effect[None])
            errors = about.errors_for(deviation - amount * effect)
            if not np.abs(errors - about.theta).max(initial=0.0) > CONVERGED_CHANGE:
                break
            nearer = self._linearise_towards(errors, about)
            if nearer is None:
                break
            about = nearer
        return about

    def _linearise_towards(
        self, errors: Array, about: ModelLinearisation
    ) -> ModelLinearisation | None:
        """Linearisation about errors, or about the first machine halfway to them that works.

        None if no machine on the way has all readings.
        """
        step = errors - about.theta
        for share in 0.5 ** np.arange(MAX_HALVINGS + 1):
            point = LinearisationPoint(about.theta + share * step, (), about.passive)
            (nearer,) = self.linearise_all([point], keep_jacobian=False)
            if nearer is not None:
                return nearer
        return None

    def shift_entries(self, about: ModelLinearisation, shift: MachineShift) -> Array:
        """Effect of a machine shift on the entries, zeros projected out, (n_entries,), [m]."""
        change = np.asarray(about.complete_jacobian @ shift.direction)
        change = np.where(shift.entries, change, 0.0)
        return np.asarray(self.project(change[None])[0])

    def products(
        self, patterns: Patterns, about: ModelLinearisation, deviation: Array
    ) -> tuple[Products, Array]:
        """Products of patterns over the rows with the principal directions and a deviation.

        Args:
            patterns: Patterns over the rows, shape (h, n_rows), [m].
            about: The linearisation.
            deviation: Readings minus predictions, shape (n_entries,), zeros projected out, [m].

        Returns:
            The products; and the inner products with the deviation, shape (h,), [m²].
        """
        directions = about.likelihood.directions
        patterns = self._without_tails(patterns)
        entries = patterns.rows @ self.to_entries
        square = row_products(entries, entries)
        if patterns.tails is not None:  # then each entry is one row divided by its noise ratio
            scale = np.asarray(self.to_entries.sum(axis=1))
            square += patterns.tails.product(scale[:, None] ** 2, power=2)[:, 0]
        square -= self._sums_by_zero(patterns) ** 2 @ self._shares
        along = patterns.product(self.to_entries @ directions.T)
        cross = patterns.product((self.to_entries @ deviation)[:, None])[:, 0]
        return Products(along, np.maximum(square, 0.0)), cross

    def relative_noise(self, patterns: Patterns) -> Array:
        """Noise of the rows that patterns change, relative to that of the first gauge, shape (h,).

        It is that of their most precise gauge, and 1 for a pattern without rows.
        """
        smallest = patterns.smallest(self.problem.noise_ratio[self.problem.observations.plus])
        return np.asarray(np.where(np.isfinite(smallest), smallest, 1.0))

    def inner(self, patterns: Patterns, others: Patterns) -> Array:
        """Inner products of patterns, pair by pair, zeros projected out, shape (h,), [m²].

        Args:
            patterns: Patterns over the rows, shape (h, n_rows). Their tails are 0 in all nonzero
                rows of `others`.
            others: Patterns without tails, shape (h, n_rows).
        """
        patterns = self._without_tails(patterns)
        one, other = (p.rows @ self.to_entries for p in (patterns, others))
        means = self._sums_by_zero(patterns) * self._sums_by_zero(others) @ self._shares
        return row_products(one, other) - means

    def _sums_by_zero(self, patterns: Patterns) -> Array:
        """Sums of the entries of patterns over each gauge zero, shape (h, n_zeros), [m]."""
        return patterns.product(np.asarray(self.to_entries @ self._incidence))

    def _without_tails(self, patterns: Patterns) -> Patterns:
        """Patterns with their tails as a matrix, if cumulative sums do not apply or gain little."""
        is_small = isinstance(patterns.rows, np.ndarray)
        if patterns.tails is None or (self._has_single_readings and not is_small):
            return patterns
        return Patterns(patterns.to_sparse())

    @property
    def _has_single_readings(self) -> bool:
        """True if all rows are single readings; then all rows of a setup share one gauge zero."""
        return bool((self.problem.observations.minus < 0).all())

    def rms(self, deviation: Array, about: ModelLinearisation) -> float:
        """RMS residual of the most likely machine, to first order, [m].

        Args:
            deviation: Readings minus predictions, shape (n_entries,), zeros projected out, [m].
            about: The linearisation.
        """
        errors, likelihood = about.errors_for(deviation), about.likelihood
        along = likelihood.singular_values * (likelihood.errors.T @ errors)
        residuals = (deviation - along @ likelihood.directions) * self.problem.noise_ratio
        return float(np.sqrt(np.mean(self.problem.observations.rows(residuals) ** 2)))


def linear_model(
    session: Session, model: str | None = None, *, noise_effects: Sequence[str] | None = None
) -> LinearModel:
    """Linearised model of a session, cached for sessions with the same rows.

    Args:
        session: A session, or several joined ones.
        model: Name of the model of the errors that the machine may have; all errors by default.
        noise_effects: As for `LinearModel`.

    Raises:
        RobotError: If closures of the robot depend on each other.
        ParameterError: If the model is unknown.
    """
    robot = session.robot
    names = machine_errors(robot) if model is None else robot.parameters.select_model(model)
    effects = None if noise_effects is None else tuple(noise_effects)
    return _cached_model(_Rows(session, names, effects))


def _sigmas_of_entries(
    session: Session, o: Observations, noise_effects: Sequence[str] | None
) -> Array:
    """Standard deviation of each entry, shape (n_entries,), [m]; arguments as for `LinearModel`."""
    if noise_effects is None:
        return initial_sigmas(session, o)
    with_effects = session.with_effects(noise_effects)
    other = build_observations(with_effects)
    sigmas, result = initial_sigmas(with_effects, other), np.empty(o.size)
    for gauge, same in zip(
        split_by_gauge(session, o), split_by_gauge(with_effects, other), strict=True
    ):
        result[gauge.entries] = sigmas[same.entries][0]
    return result


class _Rows:
    """Cache key of a session: everything except the values of its readings.

    With several gauges the values count, because their noise ratio may be estimated from them.
    """

    def __init__(
        self, session: Session, names: tuple[str, ...], noise_effects: tuple[str, ...] | None
    ) -> None:
        self.session, self.names, self.noise_effects = session, names, noise_effects
        offsets = session.controller_offsets
        same_objects = (
            *(session.robot, session.postures, session.setups, *session.gauges.values()),
            *(session.compensation, session.firmware, session.adjusted, session.path),
        )
        self._key = (
            *map(id, same_objects),
            *(None if offsets is None else offsets.tobytes(), session.joined, names, noise_effects),
            session.values.tobytes() if len(session.gauges_with_readings) > 1 else None,
            tuple(
                (r.setup, r.posture, r.minus, r.cycle, r.line, r.file, r.conditions)
                for r in session.readings
            ),
        )

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Rows) and self._key == other._key


@lru_cache(maxsize=CACHE_SIZE)
def _cached_model(rows: _Rows) -> LinearModel:
    return LinearModel(rows.session, rows.names, rows.noise_effects)


@lru_cache(maxsize=CACHE_SIZE)
def _cached_most_likely(model: LinearModel, rows: bytes) -> ModelLinearisation:
    entries = model.entries(np.frombuffer(rows)[None])[0]
    return model.approach(entries, np.zeros_like(entries))


def _refer_to_most_corrected(session: Session) -> Session:
    """Use the largest active offsets of joined sessions as the reference of the errors.

    The prior is centred at the reference, which does not depend on the order of the sessions.
    """
    if not session.joined:
        return session
    largest = max(
        [session.active_during(name) for name in session.setups],
        key=lambda offsets: (float(np.abs(offsets).max()), *offsets.tolist()),
    )
    return replace(session, controller_offsets=largest)
