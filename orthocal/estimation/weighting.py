"""Noise of the readings of each gauge.

The noise of each gauge is estimated from its repeated cycles, otherwise from its residuals: squared
residuals divided by the redundancy of the group (variance components; Förstner, Ein Verfahren zur
Schätzung von Varianz- und Kovarianzkomponenten, 1979). It is never below the stated noise. Gauges
with too few readings share one factor of their initial noise. No estimate depends on the order of
the gauges.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from orthocal.arrays import Array, Mask
from orthocal.estimation.loss import Loss
from orthocal.estimation.problem import CalibrationProblem
from orthocal.observation.gauge_noise import (
    SMALLEST_SIGMA,
    assumed_sigma,
    stated_sigma,
)
from orthocal.observation.observations import Observations
from orthocal.session.session import Gauge, Session
from orthocal.statistics.noise import Noise, combine_noises, estimate_noise, estimate_repeatability
from orthocal.statistics.zeros import project_out_zeros

MIN_DOF = 3.0
"""Degrees of freedom below which readings do not determine the noise of one of several gauges."""


@dataclass(frozen=True, slots=True, eq=False)
class GaugeReadings:
    """Entries of one gauge."""

    name: str
    """Name of the gauge."""
    gauge: Gauge
    """The gauge."""
    entries: Mask
    """Mask of the entries of the gauge, shape (n_entries,)."""
    repeatability: tuple[float, int] = (math.nan, 0)
    """Scatter of repeated cycles, [m], and its degrees of freedom, once it is computed."""


def split_by_gauge(session: Session, observations: Observations) -> tuple[GaugeReadings, ...]:
    """Entries of each gauge with readings, in the order of the session's gauges."""
    names = [s.gauge for s in session.setups.values()]
    gauge_of = np.array([list(session.gauges).index(n) for n in names])[observations.setup]
    return tuple(
        GaugeReadings(name, gauge, gauge_of == i)
        for i, (name, gauge) in enumerate(session.gauges.items())
        if (gauge_of == i).any()
    )


def with_repeatability(
    groups: Sequence[GaugeReadings], problem: CalibrationProblem
) -> tuple[GaugeReadings, ...]:
    """Entries of the gauges, with the scatter of their repeated cycles."""
    o, values = problem.observations, problem.values * problem.noise_ratio
    return tuple(replace(g, repeatability=_repeatability(values, o, g.entries)) for g in groups)


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


def first_sigma(problem: CalibrationProblem, groups: Sequence[GaugeReadings]) -> float:
    """Standard deviation of a reading of the first gauge before the first solution, [m].

    For several gauges it is that of `initial_sigmas`.
    """
    if len(groups) > 1:
        sigmas = initial_sigmas(problem.session, problem.observations)
        return float(sigmas[groups[0].entries][0])
    repeatability = estimate_repeatability(problem.values, problem.observations)
    return initial_sigma(groups[0].gauge, repeatability)


def with_initial_noise(problem: CalibrationProblem) -> CalibrationProblem:
    """Problem with the noise ratios of several gauges before the first solution."""
    groups = split_by_gauge(problem.session, problem.observations)
    if len(groups) < 2:
        return problem
    sigmas = initial_sigmas(problem.session, problem.observations)
    return problem.with_noise_ratio(sigmas / sigmas[groups[0].entries][0])


def initial_sigmas(
    session: Session, observations: Observations, *, without: int | None = None
) -> Array:
    """Standard deviation of each entry before the first solution, shape (n_entries,), [m].

    For a gauge with a stated noise, the scatter of repeated cycles is the median over its setups. A
    mistake in one setup does not change it.

    Args:
        session: The session.
        observations: Its entries.
        without: Index of a row to be predicted; its reading has no influence. The result is then
            at least the assumed noise, because few others may be equal by chance.
    """
    values = observations.values(session.values)
    used = np.ones(observations.size, dtype=np.bool_)
    if without is not None:
        used[observations.plus[without]] = False
        if observations.minus[without] >= 0:
            used[observations.minus[without]] = False
    result = np.empty(observations.size)
    for g in split_by_gauge(session, observations):
        entries = g.entries & used
        scatter, dof = _repeatability(values, observations, entries)
        if g.gauge.sigma is not None and dof:
            scatter = _median_repeatability(values, observations, entries)
        sigma = initial_sigma(g.gauge, (scatter, dof))
        result[g.entries] = sigma if without is None else max(sigma, assumed_sigma(g.gauge))
    return result


@dataclass(frozen=True, slots=True, eq=False)
class NoiseEstimate:
    """Noise of the readings of one or several gauges."""

    gauges: tuple[Noise, ...]
    """Noise of each gauge."""
    common: Noise
    """Noise of the first gauge, with the degrees of freedom and residuals of all gauges."""
    ratio: Array
    """Noise of each entry relative to the first gauge, shape (n_entries,)."""
    estimated_ratios: int = 0
    """Number of ratios between gauges that are estimated from the readings, not stated."""

    def with_sigmas(self, groups: Sequence[GaugeReadings], sigmas: Array) -> NoiseEstimate:
        """The estimate with standard deviations of the entries, shape (n_entries,), [m].

        An unknown noise remains unknown.
        """
        firsts = [float(sigmas[g.entries][0]) for g in groups]
        return replace(
            self,
            gauges=tuple(n.with_sigma(s) for n, s in zip(self.gauges, firsts, strict=True)),
            common=self.common.with_sigma(firsts[0]),
            ratio=sigmas / firsts[0],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Readings and residuals from which the noise is estimated; arrays are (n_entries,)."""

    groups: Sequence[GaugeReadings]
    """The gauges."""
    observations: Observations
    """The entries."""
    loss: Loss
    """Cost of a residual."""
    residual: Array
    """Residuals, gauge zeros projected out, [m]."""
    used: Array
    """Leverages, whose sum is the effective number of parameters."""
    sigma: Array
    """Standard deviations that weighted the entries in the present solution, [m]."""

    def estimate(self, initial: Array) -> NoiseEstimate:
        """Noise of each gauge.

        Args:
            initial: Standard deviations before the first solution, shape (n_entries,), [m].
        """
        ones = np.ones_like(self.sigma)
        noises = [self.pool([g], ones) for g in self.groups]
        if len(noises) == 1:
            return NoiseEstimate((noises[0],), noises[0], ones)
        few = [i for i, noise in enumerate(noises) if not _is_determined(noise)]
        if few:
            shared = self.pool([self.groups[i] for i in few], initial)
            if not _is_determined(shared):
                shared = self.pool(self.groups, initial)
            for i in few if shared.source != "unknown" else ():
                g = self.groups[i]
                noise = shared.scaled(float(initial[g.entries][0]))
                noises[i] = noise.at_least(stated_sigma(g.gauge))
        sigmas = np.array(initial)
        for g, noise in zip(self.groups, noises, strict=True):
            if math.isfinite(noise.sigma):
                sigmas[g.entries] = max(noise.sigma, SMALLEST_SIGMA)
        first = float(sigmas[self.groups[0].entries][0])
        pooled = self.pool(self.groups, sigmas).scaled(first)
        common = combine_noises(noises, pooled, sigma=first)
        ratios = _count_estimated_ratios(noises, few)
        return NoiseEstimate(tuple(noises), common, sigmas / first, ratios)

    def common(self) -> Noise:
        """Noise of the first gauge, with the present ratios of the gauges."""
        first = float(self.sigma[self.groups[0].entries][0])
        return self.pool(self.groups, self.sigma).scaled(first)

    def pool(self, groups: Sequence[GaugeReadings], unit: Array) -> Noise:
        """Common noise of the readings of several gauges, as a multiple of units.

        Args:
            groups: The gauges.
            unit: Length by which each entry is divided, shape (n_entries,), [m].
        """
        o, chosen = self.observations, np.logical_or.reduce([g.entries for g in groups])
        cycles = [(*g.repeatability, float(unit[g.entries][0])) for g in groups]
        unit = unit[chosen]
        dof = float(chosen.sum() - o.free_zeros_of(chosen) - self.used[chosen].sum())
        start = float(np.sqrt(np.mean((self.sigma[chosen] / unit) ** 2)))
        square = self.loss.robust_square(self.residual[chosen] / unit, dof=dof, start=start)
        cycles_dof = sum(n for _, n, _ in cycles)
        # a wrong reading in repeated cycles would increase the noise of all readings
        if self.loss.robust and dof > 1.0:
            cycles_dof = 0
        cycles_square = sum((s / u) ** 2 * n for s, n, u in cycles if n)
        scatter = math.sqrt(cycles_square / cycles_dof) if cycles_dof else math.nan
        stated = all(g.gauge.sigma is not None for g in groups)
        sigmas, resolutions = np.zeros((2, len(self.sigma)))
        for g in groups:
            sigmas[g.entries] = g.gauge.sigma or 0.0
            resolutions[g.entries] = g.gauge.resolution or 0.0
        # without stated noise, the rounding of one gauge is no lower limit for another
        has_floor = stated or len(groups) == 1
        return estimate_noise(
            repeatability=(scatter, cycles_dof),
            residual_square=square,
            residual_dof=dof,
            gauge_sigma=_root_mean_square(sigmas[chosen] / unit) if stated else None,
            resolution=_root_mean_square(resolutions[chosen] / unit) if has_floor else None,
        )


def _is_determined(noise: Noise) -> bool:
    """True if there are enough readings for the noise of one of several gauges."""
    return max(noise.cycles_dof, noise.residual_dof) >= MIN_DOF


def _count_estimated_ratios(noises: Sequence[Noise], few: Sequence[int]) -> int:
    """Number of noise ratios of several gauges that their readings determine.

    Gauges with a stated or unknown noise have known ratios to each other.

    Args:
        noises: Noise of each gauge.
        few: Indices of the gauges that share one factor.
    """
    is_estimated = [n.source in ("cycles", "residuals") for n in noises]
    # the gauges that share one factor count as one, -1
    estimates = {-1 if i in few else i for i, estimated in enumerate(is_estimated) if estimated}
    return len(estimates) - all(is_estimated)  # if all are, one of them is the reference


def _root_mean_square(values: Array) -> float:
    """RMS of values."""
    return float(np.sqrt(np.mean(values**2)))


def _repeatability(values: Array, o: Observations, entries: Mask) -> tuple[float, int]:
    """Scatter of repeated cycles of masked entries, [m], and its degrees of freedom."""
    return estimate_repeatability(values[entries], o.only(entries))


def _median_repeatability(values: Array, o: Observations, of_gauge: Mask) -> float:
    """Median over the setups of a gauge of the scatter of repeated cycles, [m].

    Squares of setups with ν degrees of freedom are divided by the median of χ²/ν (Wilson and
    Hilferty, Proc. Natl. Acad. Sci. 17, 1931).
    """
    squares = []
    for setup in np.unique(o.setup[of_gauge]):
        entries = of_gauge & (o.setup == setup)
        scatter, dof = _repeatability(values, o, entries)
        if dof:
            squares.append(scatter**2 / (1.0 - 2.0 / (9.0 * dof)) ** 3)
    return float(np.sqrt(np.median(squares)))


def leverages(
    jacobian: Array, observations: Observations, covariance: Array, sigma: float
) -> Array:
    """Leverage of each entry, shape (n_entries,); the sum is the effective number of parameters.

    Args:
        jacobian: dh/dθ̂, shape (n_entries, n_free), [noise-scaled m per prior std].
        observations: The entries.
        covariance: Covariance of θ̂, shape (n_free, n_free).
        sigma: Standard deviation of a reading of the first gauge, [m].
    """
    centred = project_out_zeros(jacobian, observations)
    return np.asarray(((centred @ covariance) * centred).sum(axis=1) / sigma**2)
