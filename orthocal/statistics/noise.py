"""Noise of the readings: its estimate, its source, and tests of residuals against it.

Tests return True or False, or None if the noise is unknown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from orthocal.arrays import Array
from orthocal.io.documents import Count
from orthocal.io.fields import CLOSED, Size, SizeOrInf, SizeOrNaN
from orthocal.observation.observations import Observations
from orthocal.statistics.chance import BY_CHANCE, chance_of_excess

FEW_DOF = 5.0
"""Degrees of freedom below which residuals replace the stated noise only if they are significant:
with a prior, a larger sigma leads to larger residuals and would confirm itself."""

LEAST_DOF = 0.5
"""Degrees of freedom below which residuals do not determine the noise."""

NoiseSource = Literal["cycles", "residuals", "gauge", "unknown"]


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Standard deviation of one reading of the indicator, and its source."""

    __pydantic_config__ = CLOSED

    sigma: SizeOrNaN
    """Standard deviation of a reading, [m]; NaN if unknown. A difference of two has √2 of it."""
    dof: SizeOrInf
    """Degrees of freedom; infinite for a stated sigma."""
    source: NoiseSource
    cycles_sigma: SizeOrNaN
    """Standard deviation from repeated cycles, [m]; NaN without cycles."""
    cycles_dof: Count
    residual_sigma: SizeOrNaN
    """√(Σ r²/(m − n)), [m]; NaN without degrees of freedom."""
    residual_dof: Size

    def apart_from_residuals(
        self, gauge: float | None, resolution: float | None
    ) -> tuple[float, float]:
        """Standard deviation that is stated or that repeated readings show, and its dof.

        Args:
            gauge: Stated standard deviation of a reading, [m].
            resolution: Resolution of the gauge, [m].
        """
        floor = noise_floor(gauge, resolution)
        if self.cycles_dof > 0 and self.cycles_sigma > floor:
            return self.cycles_sigma, float(self.cycles_dof)
        return floor, math.inf

    def leaves_more(self, gauge: float | None) -> bool | None:
        """Test for residuals larger than noise, which means a model discrepancy.

        Args:
            gauge: Stated standard deviation of a reading, [m]; None if not stated.

        Returns:
            None if the noise is known from the residuals only.
        """
        if self.source in ("cycles", "gauge"):
            return False
        if self.source == "residuals" and self.cycles_dof > 0:
            return True  # otherwise sigma would come from the cycles
        if self.source == "unknown" or gauge is None:
            return None
        return self._chance_in_residuals(gauge) < BY_CHANCE

    def leaves_less(self, gauge: float | None) -> bool | None:
        """Test for residuals smaller than the noise of a gauge with standard deviation [m].

        Returns:
            None if it is not stated, or there are no residual degrees of freedom.
        """
        if gauge is None or not self.residual_dof > 0.0 or math.isnan(self.residual_sigma):
            return None
        return self._chance_in_residuals(gauge) > 1.0 - BY_CHANCE

    def is_finer_than(self, sigma: float, *, dof: float) -> bool | None:
        """Test for residuals smaller than rounding.

        Args:
            sigma: Standard deviation of rounding, [m].
            dof: Degrees of freedom of the residuals; repeated readings may have been rounded alike.
        """
        if dof < 1.0 or not self.residual_dof > LEAST_DOF or math.isnan(self.residual_sigma):
            return None
        return chance_of_excess(dof * (self.residual_sigma / sigma) ** 2, dof) >= 1.0 - BY_CHANCE

    def _chance_in_residuals(self, sigma: float) -> float:
        chi_square = (self.residual_sigma / sigma) ** 2 * self.residual_dof
        return chance_of_excess(chi_square, self.residual_dof)


@dataclass(frozen=True, slots=True, eq=False)
class KnownNoise:
    """Noise of a reading that is independent of the model."""

    sigma: float
    """Standard deviation of a reading, [m]; NaN if unknown."""
    source: Literal["cycles", "gauge", "unknown"]


def estimate_repeatability(values: Array, observations: Observations) -> tuple[float, int]:
    """Standard deviation of repeated readings of the same setup in the same posture.

    Within a setup the readings are fitted by one value for each posture and approach and one zero
    for each group; their residuals are noise, independent of the machine.

    Args:
        values: Readings as single ones, shape (n_entries,), [m].
        observations: Setup, place and zero of each entry.

    Returns:
        Standard deviation [m] (NaN without repetition) and degrees of freedom.
    """
    total, dof = 0.0, 0
    for setup in np.unique(observations.setup):
        entries = np.flatnonzero(observations.setup == setup)
        postures, at_posture = np.unique(observations.place[entries], return_inverse=True)
        if len(postures) == len(entries):
            continue
        zeros, at_zero = np.unique(observations.zero[entries], return_inverse=True)
        design = np.zeros((len(entries), len(postures) + len(zeros)))
        rows = np.arange(len(entries))
        design[rows, at_posture] = 1.0
        design[rows, len(postures) + at_zero] = 1.0
        solution, _, rank, _ = np.linalg.lstsq(design, values[entries], rcond=1e-9)
        residual = values[entries] - design @ solution
        total += float(residual @ residual)
        dof += len(entries) - int(rank)
    return (float(np.sqrt(total / dof)) if dof else float("nan")), dof


def noise_floor(gauge_sigma: float | None, resolution: float | None) -> float:
    """Lower limit of the standard deviation of a reading, [m].

    The stated noise of the gauge, plus rounding, 1/√12 of its resolution. A small scatter of few
    readings does not disprove either.
    """
    return math.hypot(gauge_sigma or 0.0, (resolution or 0.0) / math.sqrt(12.0))


def estimate_noise(
    *,
    repeatability: tuple[float, int],
    residual_square: float,
    residual_dof: float,
    gauge_sigma: float | None,
    resolution: float | None = None,
) -> Noise:
    """Noise of a reading: from repeated cycles, otherwise from residuals, otherwise as stated.

    Residuals replace cycles if an F test finds them too large: then the model has errors, and the
    scatter of the cycles would give too small standard deviations. The stated noise of the gauge is
    a lower limit (`noise_floor`).

    Args:
        repeatability: From `estimate_repeatability`.
        residual_square: Σ r² of single readings, zeros eliminated, [m²].
        residual_dof: Readings minus zeros minus effective parameters.
        gauge_sigma: The session's `sigma_mm`, [m].
        resolution: Resolution of the gauge, [m].
    """
    cycles_sigma, cycles_dof = repeatability
    floor = noise_floor(gauge_sigma, resolution)
    cycles_sigma = max(cycles_sigma, noise_floor(None, resolution)) if cycles_dof else cycles_sigma
    enough = residual_dof > LEAST_DOF
    residual_sigma = math.sqrt(residual_square / residual_dof) if enough else math.nan
    source: NoiseSource
    if cycles_dof > 0:
        base, base_dof = (cycles_sigma, cycles_dof) if cycles_sigma > floor else (floor, 0)
        misfit = False
        if enough and base > 0.0:
            chi_square = residual_square / base**2
            misfit = chance_of_excess(chi_square, residual_dof, cycles_dof=base_dof) < BY_CHANCE
        source = "residuals" if misfit else "cycles"
    elif enough:
        provisional = residual_dof < FEW_DOF and floor > 0.0 and gauge_sigma is not None
        excess = not provisional or (
            chance_of_excess(residual_square / floor**2, residual_dof) < BY_CHANCE
        )
        source = "residuals" if excess else "gauge"
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
