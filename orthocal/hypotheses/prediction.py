"""What readings before let expect of the next one, of machines within their tolerances.

To first order about the nominal machine a reading is h = h₀ + J θ̂ + z, θ̂ of mean 0 and
covariance 1 (errors of the machine and of how gauges stand, per tolerance), z the free zero of its
setup. What is not of first order is taken from machines that are drawn and closed exactly: its
covariance is added. So readings y of all rows are normal,

    cov(y) = J Jᵀ + C + σ² + zeros,

and any is expected from the others. That says nothing where little is known, and more from row to
row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import OrthocalError
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.estimation.problem import CalibrationProblem, build_problem
from orthocal.measurement.recording.anomalies import Oddity, name_slip, noise_of_row
from orthocal.measurement.recording.recording import Row
from orthocal.session.session import Gauge, Reading, Session

Array = NDArray[np.float64]

DRAWN = 60
"""Machines for what is not of first order."""

MOST_CELLS = 1500
"""Setups times their postures of a session up to which readings are foretold."""

MOST_BEFORE = 400
"""Readings from which the next one is foretold: those nearest before it."""

ZERO = 20e-3
"""Standard deviation that a dial's zero is given: nothing is known of it, [m]."""

UNLIKELY = 6.0
"""Standard deviations from where a reading is expected that are told."""

LEAST_OFF = 3.0
"""How many times the noise of a reading it must be off besides."""

TURNED = 40.0
"""By how much χ² must fall, were all signs of a setup turned round, to say so."""

APART = 9.0
"""By how much more than for any other setup."""


@dataclass(frozen=True, slots=True, eq=False)
class Foresight:
    """Readings of a session's setups in their postures, as they may be."""

    gauges: dict[str, Gauge]
    """Of each setup."""
    cells: dict[tuple[str, str], int]
    """Setup and posture to a place in what follows."""
    nominal: Array
    """h₀, shape (n_cells,), [m]."""
    spread: Array
    """J and a root of C side by side, shape (n_cells, n), [m]."""

    def expect(self, rows: Sequence[Row], index: int) -> tuple[float, float]:
        """A reading as the others let expect it, and one standard deviation, [m].

        Args:
            rows: In the order of measuring; those without a value say nothing.
            index: Of the one that is asked for; its own value does not matter.
        """
        near = sorted((i for i in range(len(rows)) if i != index), key=lambda i: abs(i - index))
        others = [rows[i] for i in near if rows[i].value is not None][:MOST_BEFORE]
        chosen = [rows[index], *others]
        covariance = self._covariance(chosen)
        mean = self._mean(chosen)
        if not others:
            return float(mean[0]), float(np.sqrt(covariance[0, 0]))
        values = np.array([r.value for r in others], dtype=np.float64)
        gain = np.linalg.solve(covariance[1:, 1:], covariance[1:, 0])
        expected = mean[0] + gain @ (values - mean[1:])
        variance = covariance[0, 0] - gain @ covariance[1:, 0]
        return float(expected), float(np.sqrt(max(variance, 0.0)))

    def find_turned(self, rows: Sequence[Row]) -> str | None:
        """The setup whose readings would fit far better had all of them the other sign."""
        read = [r for r in rows if r.value is not None][-MOST_BEFORE:]
        setups = list(dict.fromkeys(r.setup for r in read))
        if not read:
            return None
        values = np.array([r.value for r in read], dtype=np.float64)
        mean, inverse = self._mean(read), np.linalg.inv(self._covariance(read))

        def square(signs: Array) -> float:
            off = signs * values - mean
            return float(off @ inverse @ off)

        as_read = square(np.ones(len(read)))
        gains = {}
        for setup in setups:
            signs = np.array([-1.0 if r.setup == setup else 1.0 for r in read])
            gains[setup] = as_read - square(signs)
        best, *rest = sorted(gains.values(), reverse=True)
        if best < TURNED or (rest and best - rest[0] < APART):
            return None
        return max(gains, key=lambda s: gains[s])

    def find_oddities(self, rows: Sequence[Row], index: int) -> tuple[Oddity, ...]:
        """What is odd about a reading that was just taken."""
        row = rows[index]
        if row.value is None:
            return ()
        turned = self.find_turned(rows)
        if turned is not None:
            return (Oddity("turned", turned),)
        expected, spread = self.expect(rows, index)
        off = abs(row.value - expected)
        noise = self._noise(row)
        if off < UNLIKELY * spread or off < LEAST_OFF * noise:
            return ()
        slip = name_slip(row.value, expected, spread)
        return (Oddity("unexpected", row.setup, expected, spread, slip),)

    def _noise(self, row: Row) -> float:
        return noise_of_row(self.gauges[row.setup], row) or 0.0

    def _weights(self, rows: Sequence[Row]) -> Array:
        """Which cells each row is made of, shape (n_rows, n_cells)."""
        result = np.zeros((len(rows), len(self.cells)))
        for i, row in enumerate(rows):
            result[i, self.cells[row.setup, row.posture]] = 1.0
            if row.minus is not None:
                result[i, self.cells[row.setup, row.minus]] = -1.0
        return result

    def _mean(self, rows: Sequence[Row]) -> Array:
        return np.asarray(self._weights(rows) @ self.nominal)

    def _covariance(self, rows: Sequence[Row]) -> Array:
        root = self._weights(rows) @ self.spread
        raw = np.array([r.minus is None for r in rows])
        setups = np.array([list(self.gauges).index(r.setup) for r in rows])
        same = (setups[:, None] == setups) & raw[:, None] & raw
        noise = np.diag([self._noise(r) ** 2 for r in rows])
        return np.asarray(root @ root.T + ZERO**2 * same + noise)


def build_foresight(session: Session) -> Foresight | None:
    """What a session's readings may be; None where nothing can be said.

    That is of robots that cannot be calibrated, gauges of which no noise is stated, and sessions
    that are too large to answer at once.

    Args:
        session: Its readings' values do not matter.
    """
    pairs = dict.fromkeys(
        (r.setup, posture)
        for r in session.readings
        for posture in (r.posture, r.minus)
        if posture is not None
    )
    gauges = {s.name: session.gauges[s.gauge] for s in session.setups.values()}
    stated = all(g.sigma is not None or g.resolution is not None for g in gauges.values())
    if not stated or len(pairs) > MOST_CELLS:
        return None
    readings = tuple(Reading(s, p, None, 1, 0.0, None) for s, p in pairs)
    single = replace(session, readings=readings, sha256="")
    try:
        problem = build_problem(single, free=machine_errors(session.robot), prior=True)
        nominal, jacobian = problem.linearise(problem.reference)
        bent = _not_of_first_order(problem, nominal, jacobian)
    except (OrthocalError, np.linalg.LinAlgError):
        return None
    spread = np.hstack([jacobian, bent])
    if not np.isfinite(spread).all():
        return None
    return Foresight(gauges, {pair: i for i, pair in enumerate(pairs)}, nominal, spread)


def _not_of_first_order(problem: CalibrationProblem, nominal: Array, jacobian: Array) -> Array:
    """A root of the second moments of what readings have beyond first order, (n_entries, DRAWN)."""
    drawn = np.random.default_rng(0).normal(size=(DRAWN, problem.n_free))
    readings, _, reached = problem.simulate(problem.reference + drawn * problem.theta_scale)
    rest = (readings - nominal - drawn @ jacobian.T)[reached].T
    there = np.isfinite(rest)
    count = np.maximum(there.sum(axis=1, keepdims=True), 1)
    return np.asarray(np.where(there, rest, 0.0) / np.sqrt(count))
