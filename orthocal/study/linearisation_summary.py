"""What a study of linearising says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.study.linearisation import IDENTIFIED, METHODS, SOLVED, LinearisationStudy
from orthocal.study.runner import StudyTable
from orthocal.units import MM

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Method:
    """What one way costs as errors grow."""

    name: str
    missed: Array
    """R.m.s. over the directions of the largest error of an estimate, by size, [mm or mrad]; NaN
    where it came to nothing in some direction."""
    standard_error: float
    """By noise, [mm or mrad]."""
    beyond_resolution: float | None
    """Size from which on it misses more than the resolution of a reading; None for none."""
    beyond_noise: float | None
    """Size from which on it misses more than a standard error."""
    ends: float | None
    """Size from which on it comes to nothing in some direction; None for none."""


@dataclass(frozen=True, slots=True, eq=False)
class LinearisationSummary:
    """What a study of linearising says."""

    sizes: Array
    """[mm or mrad]"""
    methods: tuple[Method, ...]
    reading: Array
    """Largest error of a linearised difference of readings, r.m.s. over directions, [mm]."""
    steps: tuple[int | None, ...]
    """Gauss-Newton steps that do in every direction, by size; None where it does not converge."""
    resolution: float
    """[mm]"""
    assembled: float | None
    """Largest size at which machines can be assembled in every direction."""


def summarise_linearisation(study: LinearisationStudy, table: StudyTable) -> LinearisationSummary:
    """What a study of linearising says."""
    c = table.columns
    size, status = np.array(c["size"], dtype=np.float64), np.array(c["status"], dtype=object)
    sizes = np.unique(size)
    errors, resolution = study.standard_errors, study.resolution / MM
    whole = [s for s in sizes if (status[size == s] == IDENTIFIED).all()]

    def by_size(name: str) -> Array:
        values = np.array(c[name], dtype=np.float64)
        # what cannot be assembled is nobody's failure
        known = [values[(size == s) & (status == IDENTIFIED)] for s in sizes]
        return np.array([np.sqrt(np.mean(v**2)) if v.size else np.nan for v in known])

    methods = []
    for name in (m for m in METHODS if m in c):
        missed, scatter = by_size(name), errors[name] / MM
        failed = np.isnan(missed) & np.isin(sizes, whole)
        if name == "exact":
            failed |= missed > SOLVED / MM
        methods.append(
            Method(
                name=name,
                missed=missed,
                standard_error=scatter,
                beyond_resolution=_crossing(sizes, missed, resolution),
                beyond_noise=_crossing(sizes, missed, scatter),
                ends=float(sizes[failed].min()) if failed.any() else None,
            )
        )
    steps: list[int | None] = []
    for s in sizes:
        own = [
            v
            for v, at, st in zip(c["steps"], size, status, strict=True)
            if at == s and st == IDENTIFIED
        ]
        known = [int(v) for v in own if v is not None]
        steps.append(max(known) if known and len(known) == len(own) else None)
    return LinearisationSummary(
        sizes=sizes,
        methods=tuple(methods),
        reading=by_size("reading_mm"),
        steps=tuple(steps),
        resolution=resolution,
        assembled=max(whole) if whole else None,
    )


def _crossing(sizes: Array, values: Array, level: float) -> float | None:
    """Size from which on values are above a level, between sizes by powers; None for none."""
    above = np.flatnonzero(values > level)
    if not above.size or not level > 0.0:
        return None
    k = int(above[0])
    if k == 0 or not values[k - 1] > 0.0:
        return float(sizes[k])
    share = np.log(level / values[k - 1]) / np.log(values[k] / values[k - 1])
    return float(sizes[k - 1] * (sizes[k] / sizes[k - 1]) ** share)
