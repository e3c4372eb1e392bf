"""Stated noise of gauges: standard deviation of a reading and its rounding."""

from __future__ import annotations

import math

from orthocal.session.session import Gauge

DEFAULT_SIGMA = 10e-6
"""Assumed noise of a gauge that does not state it, [m].

Half of the resolution would be too little for gauges that scatter by more than they resolve: with
0.001 mm and a scatter of 0.03 mm, correct readings would count as mistakes."""

USUAL_STDS = 4.0
"""Largest usual difference of two readings of one posture, in standard deviations of a difference.
Of about 16,000 correct differences one is larger."""

USUAL_STEPS = 3
"""Largest usual difference, in steps of the resolution, of a gauge whose noise is not stated."""

ROUNDING_ERROR = 1e-9
"""Rounding error of a difference of two readings, [m]."""

SMALLEST_SIGMA = 1e-9
"""Smallest standard deviation of a reading, [m]; below it readings count as perfect."""


def noise_floor(gauge_sigma: float | None, resolution: float | None) -> float:
    """Lower limit of the standard deviation of a reading, [m].

    It combines the stated noise of the gauge and rounding, 1/√12 of the resolution. A smaller
    scatter of few readings does not disprove these.
    """
    return math.hypot(gauge_sigma or 0.0, (resolution or 0.0) / math.sqrt(12.0))


def stated_sigma(gauge: Gauge) -> float:
    """Standard deviation of a reading from stated noise and resolution, [m]; 0 without both."""
    return noise_floor(gauge.sigma, gauge.resolution)


def usual_difference(gauge: Gauge) -> float:
    """Largest usual difference of two readings of one posture, [m]; 0 if unknown.

    It is a multiple of the resolution, if the gauge states one.
    """
    step = gauge.resolution or 0.0
    if not gauge.sigma:
        return USUAL_STEPS * step
    largest = USUAL_STDS * math.sqrt(2.0) * stated_sigma(gauge)
    return max(math.floor(largest / step), 1) * step if step else largest


def assumed_sigma(gauge: Gauge) -> float:
    """Standard deviation of a reading, [m], with DEFAULT_SIGMA for a gauge that states none."""
    return max(noise_floor(gauge.sigma or DEFAULT_SIGMA, gauge.resolution), SMALLEST_SIGMA)
