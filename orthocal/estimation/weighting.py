"""Noise ratios of the readings of several gauges.

The noise of each gauge is estimated from its repeated cycles, otherwise from its residuals: squared
residuals divided by the redundancy of the group (variance components; Förstner, Ein Verfahren zur
Schätzung von Varianz- und Kovarianzkomponenten, 1979). It is never below the stated noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array, Mask
from orthocal.observation.observations import Observations
from orthocal.session.session import Gauge, Session
from orthocal.statistics.noise import estimate_noise, estimate_repeatability, noise_floor
from orthocal.statistics.zeros import project_out_zeros

DEFAULT_SIGMA = 10e-6
"""Assumed noise of a gauge that does not state it, [m]."""

SMALLEST_SIGMA = 1e-9
"""Smallest standard deviation of a reading, [m]; below it readings count as perfect."""

MIN_DOF = 3.0
"""Degrees of freedom below which residuals do not determine the noise of a gauge."""


@dataclass(frozen=True, slots=True, eq=False)
class GaugeReadings:
    """Entries of one gauge."""

    name: str
    """Name of the gauge."""
    gauge: Gauge
    """The gauge."""
    entries: Mask
    """Mask of the entries of the gauge, shape (n_entries,)."""


def split_by_gauge(session: Session, observations: Observations) -> tuple[GaugeReadings, ...]:
    """Entries of each gauge with readings, in the order of the session's gauges."""
    names = [s.gauge for s in session.setups.values()]
    gauge_of = np.array([list(session.gauges).index(n) for n in names])[observations.setup]
    return tuple(
        GaugeReadings(name, gauge, gauge_of == i)
        for i, (name, gauge) in enumerate(session.gauges.items())
        if (gauge_of == i).any()
    )


def stated_sigma(gauge: Gauge) -> float:
    """Standard deviation of a reading from stated noise and resolution, [m]; 0 without both."""
    return noise_floor(gauge.sigma, gauge.resolution)


def assumed_sigma(gauge: Gauge) -> float:
    """Standard deviation of a reading, [m], with DEFAULT_SIGMA for a gauge that states none."""
    return max(noise_floor(gauge.sigma or DEFAULT_SIGMA, gauge.resolution), SMALLEST_SIGMA)


def initial_sigma(gauge: Gauge, repeatability: tuple[float, int]) -> float:
    """Standard deviation of a reading before the first solution, [m].

    Args:
        gauge: The gauge.
        repeatability: Scatter of repeated cycles, [m], and its degrees of freedom.
    """
    cycles_sigma, cycles_dof = repeatability
    if cycles_dof > 0:
        return max(cycles_sigma, stated_sigma(gauge), SMALLEST_SIGMA)
    return assumed_sigma(gauge)


def initial_sigmas(session: Session, observations: Observations) -> Array:
    """Standard deviation of each entry before the first solution, shape (n_entries,), [m].

    The scatter of repeated cycles of a gauge with a stated noise is that of most of its setups, so
    that it does not contain a mistake in one of them.
    """
    values = observations.values(session.values)
    result = np.empty(observations.size)
    for g in split_by_gauge(session, observations):
        repeatability = _repeatability(values, observations, g)
        if g.gauge.sigma is not None and repeatability[1]:
            repeatability = _median_repeatability(values, observations, g), repeatability[1]
        result[g.entries] = initial_sigma(g.gauge, repeatability)
    return result


def estimate_gauge_sigmas(
    groups: Sequence[GaugeReadings],
    observations: Observations,
    *,
    residual: Array,
    leverage: Array,
    values: Array,
    sigma: Array,
) -> Array:
    """Standard deviation of each entry from the residuals of its gauge, shape (n_entries,), [m].

    Args:
        groups: The gauges.
        observations: The entries.
        residual: Residuals, gauge zeros eliminated, shape (n_entries,), [m].
        leverage: Leverage of each entry, shape (n_entries,).
        values: Readings of the entries, shape (n_entries,), [m].
        sigma: Standard deviations in the present solution, shape (n_entries,), [m]; returned for
            gauges with too few readings.
    """
    result = np.array(sigma)
    for g in groups:
        zeros = np.unique(observations.zero[g.entries]).size
        dof = float(g.entries.sum() - zeros - leverage[g.entries].sum())
        repeatability = _repeatability(values, observations, g)
        if repeatability[1] < MIN_DOF and dof < MIN_DOF:
            continue
        noise = estimate_noise(
            repeatability=repeatability,
            residual_square=float(residual[g.entries] @ residual[g.entries]),
            residual_dof=dof,
            gauge_sigma=g.gauge.sigma,
            resolution=g.gauge.resolution,
        )
        if math.isfinite(noise.sigma):
            result[g.entries] = max(noise.sigma, SMALLEST_SIGMA)
    return result


def _repeatability(values: Array, o: Observations, group: GaugeReadings) -> tuple[float, int]:
    """Scatter of the repeated cycles of a gauge, [m], and its degrees of freedom."""
    return estimate_repeatability(values[group.entries], o.only(group.entries))


def _median_repeatability(values: Array, o: Observations, group: GaugeReadings) -> float:
    """Median over the setups of a gauge of the scatter of repeated cycles, [m].

    Squares are divided by the median of χ²/ν (Wilson and Hilferty, 1931).
    """
    squares = []
    for setup in np.unique(o.setup[group.entries]):
        entries = o.setup == setup
        scatter, dof = estimate_repeatability(values[entries], o.only(entries))
        if dof:
            squares.append(scatter**2 / (1.0 - 2.0 / (9.0 * dof)) ** 3)
    return float(np.sqrt(np.median(squares)))


def leverages(
    jacobian: Array, observations: Observations, covariance: Array, sigma: float
) -> Array:
    """Leverage of each entry, shape (n_entries,); the sum is the effective number of parameters.

    Args:
        jacobian: dh/dθ̂, shape (n_entries, n_free), [m of the first gauge per prior std].
        observations: The entries.
        covariance: Covariance of θ̂, shape (n_free, n_free).
        sigma: Standard deviation of a reading of the first gauge, [m].
    """
    centred = project_out_zeros(jacobian, observations)
    return np.asarray(((centred @ covariance) * centred).sum(axis=1) / sigma**2)
