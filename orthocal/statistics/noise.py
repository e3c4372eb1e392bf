"""Noise of the readings: its estimate, its source, and tests of residuals against it.

Tests return None if the noise is unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from orthocal.arrays import Array
from orthocal.io.documents import Count
from orthocal.io.fields import FileRecord, Size, SizeOrInf, SizeOrNaN
from orthocal.observation.gauge_noise import noise_floor
from orthocal.observation.observations import Observations
from orthocal.statistics.chance import BY_CHANCE, chance_of_excess

FEW_DOF = 5.0
"""Degrees of freedom below which residuals replace the stated noise only if they exceed it
significantly. With a prior, a larger σ causes larger residuals and would confirm itself."""

MIN_DOF = 0.5
"""Degrees of freedom below which residuals do not determine the noise."""

NoiseSource = Literal["cycles", "residuals", "gauge", "unknown"]
"""Source of the noise: scatter of repeated cycles, residuals, or the stated value of the gauge."""

_SOURCES: tuple[NoiseSource, ...] = ("residuals", "cycles", "gauge", "unknown")
"""Sources in their order of precedence: the noise of several gauges has the first of theirs."""


@dataclass(frozen=True, slots=True, eq=False)
class Noise(FileRecord):
    """Standard deviation of one reading of the indicator, and its source."""

    sigma: SizeOrNaN
    """Standard deviation of a reading, [m]; NaN if unknown. That of a difference is √2 of it."""
    dof: SizeOrInf
    """Degrees of freedom; infinite for a stated sigma."""
    source: NoiseSource
    """Source of `sigma`."""
    cycles_sigma: SizeOrNaN
    """Standard deviation from repeated cycles, [m]; NaN without cycles."""
    cycles_dof: Count
    """Degrees of freedom of `cycles_sigma`; 0 without cycles."""
    residual_sigma: SizeOrNaN
    """Standard deviation from residuals, √(Σ r²/dof), [m]; NaN without degrees of freedom."""
    residual_dof: Size
    """Degrees of freedom of the residuals."""

    def without_residuals(
        self, gauge: float | None, resolution: float | None
    ) -> tuple[float, float]:
        """Standard deviation of a reading without use of the residuals, and its degrees of freedom.

        It is that of repeated readings if this exceeds the lower limit (`noise_floor`), otherwise
        the limit.

        Args:
            gauge: Stated standard deviation of a reading, [m].
            resolution: Resolution of the gauge, [m].
        """
        floor = noise_floor(gauge, resolution)
        if self.cycles_dof > 0 and self.cycles_sigma > floor:
            return self.cycles_sigma, float(self.cycles_dof)
        return floor, math.inf

    def scaled(self, factor: float) -> Noise:
        """Noise with all standard deviations multiplied by a factor."""
        return replace(
            self,
            sigma=self.sigma * factor,
            cycles_sigma=self.cycles_sigma * factor,
            residual_sigma=self.residual_sigma * factor,
        )

    def with_sigma(self, sigma: float) -> Noise:
        """Noise with another standard deviation of a reading, unless it is unknown."""
        return self if math.isnan(self.sigma) else replace(self, sigma=sigma)

    def at_least(self, floor: float) -> Noise:
        """This noise, or that of a gauge with the standard deviation `floor`, [m], if it is larger.

        An unknown noise, NaN, remains unknown.
        """
        if not self.sigma < floor:
            return self
        return replace(self, sigma=floor, dof=math.inf, source="gauge")

    def exceeded_by_residuals(self, gauge: float | None) -> bool | None:
        """Test for residuals larger than the noise, which shows unmodelled errors.

        Args:
            gauge: Stated standard deviation of a reading with rounding (`noise_floor`), [m]; None
                if not stated.

        Returns:
            Result of the test; None if the noise is known from the residuals only.
        """
        if self.source in ("cycles", "gauge"):
            return False
        if self.source == "residuals" and self.cycles_dof > 0:
            return True  # otherwise the noise would be that of the cycles
        if self.source == "unknown" or gauge is None:
            return None
        return self._chance_of_residuals(gauge) < BY_CHANCE

    def exceeds_residuals(self, gauge: float | None) -> bool | None:
        """Test for residuals smaller than the stated noise of the gauge.

        Args:
            gauge: Stated standard deviation of a reading, [m]; None if not stated.

        Returns:
            Result of the test; None if the noise is not stated, or if the residuals have no degrees
            of freedom.
        """
        if gauge is None or not self.residual_dof > 0.0 or math.isnan(self.residual_sigma):
            return None
        return self._chance_of_residuals(gauge) > 1.0 - BY_CHANCE

    def is_finer_than(self, sigma: float, *, dof: float) -> bool | None:
        """Test for residuals smaller than rounding errors.

        Args:
            sigma: Standard deviation of rounding, [m].
            dof: Degrees of freedom of the residuals without repetitions, which may have the same
                rounding error.

        Returns:
            Result of the test; None without sufficient degrees of freedom.
        """
        if dof < 1.0 or not self.residual_dof > MIN_DOF or math.isnan(self.residual_sigma):
            return None
        return chance_of_excess(dof * (self.residual_sigma / sigma) ** 2, dof) >= 1.0 - BY_CHANCE

    def _chance_of_residuals(self, sigma: float) -> float:
        """Probability of residuals at least as large from a noise `sigma` of the readings, [m]."""
        chi_square = (self.residual_sigma / sigma) ** 2 * self.residual_dof
        return chance_of_excess(chi_square, self.residual_dof)


def estimate_repeatability(values: Array, observations: Observations) -> tuple[float, int]:
    """Standard deviation of repeated readings of the same setup in the same posture.

    The readings of a setup are fitted by one value for each posture and approach, and by one gauge
    zero for each group. The residuals are noise, independent of the machine.

    Args:
        values: Single readings, shape (n_entries,), [m].
        observations: Setup, place and gauge zero of each entry.

    Returns:
        Standard deviation, [m], NaN without repetitions; and degrees of freedom.
    """
    total, dof = 0.0, 0
    for setup in np.unique(observations.setup):
        entries = np.flatnonzero(observations.setup == setup)
        at_place, at_zero = (
            np.unique(index[entries], return_inverse=True)[1]
            for index in (observations.place, observations.zero)
        )
        if at_place.max() + 1 == len(entries):
            continue
        # the more numerous of places and zeros are eliminated by their means, which is faster
        few, many = sorted((at_zero, at_place), key=np.max)
        centred = np.column_stack([values[entries], np.eye(few.max() + 1)[few]])
        means = np.zeros((many.max() + 1, centred.shape[1]))
        np.add.at(means, many, centred)
        centred -= (means / np.bincount(many)[:, None])[many]
        solution, _, rank, _ = np.linalg.lstsq(centred[:, 1:], centred[:, 0], rcond=1e-9)
        residual = centred[:, 0] - centred[:, 1:] @ solution
        total += float(residual @ residual)
        dof += len(entries) - len(means) - int(rank)
    return (float(np.sqrt(total / dof)) if dof else float("nan")), dof


def estimate_noise(
    *,
    repeatability: tuple[float, int],
    residual_square: float,
    residual_dof: float,
    gauge_sigma: float | None,
    resolution: float | None = None,
) -> Noise:
    """Noise of a reading: from repeated cycles, otherwise from residuals, otherwise as stated.

    Residuals replace cycles if an F test shows that they are too large. The model then has errors,
    and standard deviations from the scatter of the cycles would be too small. Few residuals do not
    replace the stated noise, which is always a lower limit (`noise_floor`).

    Args:
        repeatability: Result of `estimate_repeatability`.
        residual_square: Σ r² of single readings with gauge zeros eliminated, [m²].
        residual_dof: Readings minus gauge zeros minus effective parameters.
        gauge_sigma: Stated standard deviation of a reading, [m]; None if not stated.
        resolution: Resolution of the gauge, [m].
    """
    cycles_sigma, cycles_dof = repeatability
    floor = noise_floor(gauge_sigma, resolution)
    cycles_sigma = max(cycles_sigma, noise_floor(None, resolution)) if cycles_dof else cycles_sigma
    has_dof = residual_dof > MIN_DOF
    residual_sigma = math.sqrt(residual_square / residual_dof) if has_dof else math.nan

    def is_exceeded(sigma: float, dof: int) -> bool:
        """True if residuals exceed a noise with degrees of freedom from cycles, 0 if stated."""
        chi_square = residual_square / sigma**2
        return chance_of_excess(chi_square, residual_dof, cycles_dof=dof) < BY_CHANCE

    source: NoiseSource
    if cycles_dof > 0:
        reference = (cycles_sigma, cycles_dof) if cycles_sigma > floor else (floor, 0)
        misfit = has_dof and reference[0] > 0.0 and is_exceeded(*reference)
        source = "residuals" if misfit else "cycles"
    elif has_dof:
        few_dof = residual_dof < FEW_DOF and floor > 0.0 and gauge_sigma is not None
        source = "gauge" if few_dof and not is_exceeded(floor, 0) else "residuals"
    else:
        source = "gauge" if gauge_sigma is not None else "unknown"
    sigma, dof = {
        "cycles": (cycles_sigma, float(cycles_dof)),
        "residuals": (residual_sigma, residual_dof),
        "gauge": (floor, math.inf),
        "unknown": (math.nan, 0.0),
    }[source]
    if sigma < floor:
        source, sigma, dof = "gauge", floor, math.inf
    return Noise(
        sigma, dof, source, cycles_sigma, cycles_dof, residual_sigma, max(residual_dof, 0.0)
    )


def combine_noises(noises: Sequence[Noise], pooled: Noise, *, sigma: float) -> Noise:
    """Noise of the first of several gauges, with degrees of freedom of the readings of all.

    Args:
        noises: Noise of each gauge.
        pooled: Noise of all readings after scaling each to the noise of the first gauge.
        sigma: Standard deviation of a reading of the first gauge, [m].
    """
    source = min((n.source for n in noises), key=_SOURCES.index)
    dof = {
        "residuals": pooled.residual_dof,
        "cycles": float(pooled.cycles_dof),
        "gauge": math.inf,
        "unknown": 0.0,
    }[source]
    sigma = math.nan if source == "unknown" else sigma
    return replace(pooled, sigma=sigma, dof=dof, source=source)
