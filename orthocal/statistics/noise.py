"""How much readings scatter, and where that is known from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from orthocal.measurement.observations import Observations
from orthocal.statistics.chance import BY_CHANCE, chance_of_excess

Array = NDArray[np.float64]

NoiseSource = Literal["cycles", "residuals", "gauge", "unknown"]


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Standard deviation of one reading of the indicator, and where it is from."""

    sigma: float
    """[m]; NaN if nothing tells."""
    dof: float
    """Degrees of freedom; infinite for a sigma that was given."""
    source: NoiseSource
    cycles_sigma: float
    """From repeated cycles, [m]; NaN without."""
    cycles_dof: int
    residual_sigma: float
    """√(Σ r²/(m − n)), [m]; NaN without degrees of freedom."""
    residual_dof: float

    @property
    def misfit(self) -> bool:
        """Whether residuals are larger than repeated cycles explain: the model is in error."""
        return self.source == "residuals" and self.cycles_dof > 0


def estimate_repeatability(values: Array, observations: Observations) -> tuple[float, int]:
    """Standard deviation of repeated readings of the same setup in the same posture.

    Within a setup the readings are fitted by one value a posture and one zero a group; what is
    left is noise whatever the machine is like.

    Args:
        values: Readings as single ones, shape (n_entries,), [m].
        observations: Which setup, posture and zero each belongs to.

    Returns:
        Standard deviation [m] (NaN without repetition) and degrees of freedom.
    """
    total, dof = 0.0, 0
    for setup in np.unique(observations.setup):
        entries = np.flatnonzero(observations.setup == setup)
        postures, at_posture = np.unique(observations.posture[entries], return_inverse=True)
        if len(postures) == len(entries):
            continue
        zeros, at_zero = np.unique(observations.zero[entries], return_inverse=True)
        design = np.zeros((len(entries), len(postures) + len(zeros)))
        rows = np.arange(len(entries))
        design[rows, at_posture] = 1.0
        design[rows, len(postures) + at_zero] = 1.0
        solution, _, rank, _ = np.linalg.lstsq(design, values[entries], rcond=1e-9)
        left = values[entries] - design @ solution
        total += float(left @ left)
        dof += len(entries) - int(rank)
    return (float(np.sqrt(total / dof)) if dof else float("nan")), dof


def noise_floor(gauge_sigma: float | None, resolution: float | None) -> float:
    """Standard deviation of a reading that no scatter can argue away, [m].

    What is stated of the gauge, and what rounding to its resolution leaves, 1/√12 of it: readings
    that happen to be alike, or are few, say nothing against either.
    """
    finest = 0.0 if resolution is None else resolution / math.sqrt(12.0)
    return max(gauge_sigma or 0.0, finest)


def estimate_noise(
    *,
    repeatability: tuple[float, int],
    residual_square: float,
    residual_dof: float,
    gauge_sigma: float | None,
    resolution: float | None = None,
) -> Noise:
    """Standard deviation of a reading: from repeated cycles, else from residuals, else the gauge's.

    Residuals win over cycles where an F test finds them too large for the cycles: then the model
    is in error, and the spread of the cycles would flatter every standard deviation. What is stated
    of the gauge is a floor (`noise_floor`): with less it is the gauge's own that counts.

    Args:
        repeatability: From `estimate_repeatability`.
        residual_square: Σ r² of single readings, zeros eliminated, [m²].
        residual_dof: Readings less zeros less (effective) parameters.
        gauge_sigma: The session's `sigma_mm`, [m].
        resolution: Of the gauge, [m].
    """
    cycles_sigma, cycles_dof = repeatability
    floor = noise_floor(gauge_sigma, resolution)
    cycles_sigma = max(cycles_sigma, noise_floor(None, resolution)) if cycles_dof else cycles_sigma
    enough = residual_dof > 0.5
    residual_sigma = math.sqrt(residual_square / residual_dof) if enough else math.nan
    source: NoiseSource
    if cycles_dof > 0:
        known, known_dof = (cycles_sigma, cycles_dof) if cycles_sigma > floor else (floor, 0)
        misfit = False
        if enough and known > 0.0:
            chi_square = residual_square / known**2
            misfit = chance_of_excess(chi_square, residual_dof, cycles_dof=known_dof) < BY_CHANCE
        source = "residuals" if misfit else "cycles"
    elif enough:
        source = "residuals"
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
