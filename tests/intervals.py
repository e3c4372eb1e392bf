"""Coverage of 95 % intervals, counted on independent ones."""

from __future__ import annotations

import numpy as np
from scipy.stats import binom

FEWEST = 1000
"""Independent intervals below which their coverage is not judged."""

LIMIT = 1.959964
"""Half width of a 95 % interval, [standard deviations]."""

DETERMINED = 0.5
"""Variance over that of the prior below which a direction is determined by the readings."""


def independent_scores(error, covariance):
    """Independent standardised errors by a predicted covariance Σ, in prior standard deviations.

    All of them, Σ^(-1/2) e with the symmetric root, and those along the principal axes that the
    readings determine. The other axes are arbitrary: the variance along each of them is 1.
    """
    variances, axes = np.linalg.eigh(covariance)
    along = axes.T @ error / np.sqrt(variances)
    return axes @ along, along[variances < DETERMINED]


def recorded_scores(calibration, errors):
    """`independent_scores` of a calibration record; errors by their names, [SI]."""
    chosen = [p for p in calibration.parameters if p.name in errors]
    at = [calibration.parameters.index(p) for p in chosen]
    scale = np.array([p.prior_std for p in chosen])
    apart = np.array([p.value - errors[p.name] for p in chosen])
    covariance = calibration.total_covariance[np.ix_(at, at)] / np.outer(scale, scale)
    return independent_scores(apart / scale, covariance)


def coverage_band(count):
    """Least and largest number of 95 % intervals, of `count`, within the 99 % binomial band."""
    return binom.interval(0.99, count, 0.95)


def assert_coverage(scores, *, fewest=FEWEST):
    """Compare the number of intervals that contain the truth with its 99 % binomial band."""
    scores = np.concatenate([np.ravel(s) for s in scores])
    assert scores.size >= fewest
    low, high = coverage_band(scores.size)
    covered = int((np.abs(scores) < LIMIT).sum())
    assert low <= covered <= high, f"{covered} of {scores.size}, expected {low:.0f} to {high:.0f}"
