"""Traces: readings of a gauge sampled at a high rate while the tool moves along a path.

A trace is averaged in bins along the path. A polynomial of the path length describes the readings
between two reversals approximately. In each bin, a line is fitted to the deviations from the
polynomial. The sum of line and polynomial at the middle sample is the reading there. The averaging
error w² h''/24 of a bin of length w, with h the deviations, stays below a tenth of the noise of a
bin. A bin ends where the path reverses, because the approach changes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.polynomial import Chebyshev

from orthocal.arrays import Array, Indices
from orthocal.errors import ClosureError, SessionError, errors_at
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.measurement.files.coordinate_tables import stream_columns
from orthocal.measurement.files.readings_file import COORDINATES
from orthocal.measurement.motion.approach import name_approach
from orthocal.robot.model import Robot, require_tcp
from orthocal.session.completeness import require_name
from orthocal.session.session import Conditions, Posture, Reading, Session
from orthocal.units import MM

MOST_SAMPLES = 500_000
"""Largest number of samples of a trace: eight minutes at 1 kHz."""

FEWEST_SAMPLES = 8
"""Fewest samples of a bin, sufficient for a line and the noise about it."""

MOST_BINS = 360
"""Largest number of bins between two reversals."""

LONGEST_BIN = 4 * MM
"""Initial length of a bin, [m]: 5° of a circle with a diameter of 100 mm."""

BATCHES = 4
"""Batches per bin, whose means show its noise; samples may be correlated within a batch."""

MAX_AVERAGING_ERROR = 0.1
"""Largest averaging error, in standard deviations of a bin's reading."""

DEGREE = 12
"""Degree of the polynomial between two reversals: exact to some nm for two harmonics of a full
circle."""

REVERSAL_LENGTH = 0.1 * MM
"""Path length over which a reversal is detected, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """Samples of a gauge along a path of the tool."""

    points: Array
    """Commanded tool coordinates, shape (n, n_coordinates), [m]."""
    values: Array
    """Readings, shape (n,), [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class BinnedTrace:
    """Readings of a trace, averaged in bins along the path."""

    points: Array
    """Commanded tool coordinates, shape (m, n_coordinates), [m]."""
    values: Array
    """Readings, shape (m,), [m]."""
    motions: Array
    """Motion of the tool through each bin, shape (m, n_coordinates), [m]."""
    std: float
    """Standard deviation of a reading, [m]."""
    unused_bins: int
    """Number of further bins, which have too few samples."""
    unused_samples: int
    """Number of samples in these bins."""


def read_trace(path: str | Path, robot: Robot) -> Trace:
    """Read a trace from a CSV file.

    Args:
        path: CSV with the column reading_mm and the commanded coordinates of x_mm, y_mm, z_mm,
            relative to the mechanical zero. Other columns, such as a time, are ignored.
        robot: The robot.

    Raises:
        SessionError: If the file is wrong; names file and line.
    """
    file = Path(path)
    names = [*(COORDINATES[c] for c in require_tcp(robot).coordinates), "reading_mm"]
    blocks = stream_columns(
        file, dict.fromkeys(names, MM), ignored=None, name=str(file), most=MOST_SAMPLES + 1
    )
    table = np.concatenate([values for _, values in blocks])
    if len(table) < FEWEST_SAMPLES:
        raise SessionError(
            f"has {len(table)} samples; expected {FEWEST_SAMPLES} or more", where=str(file)
        )
    return Trace(table[:, :-1], table[:, -1])


def bin_trace(trace: Trace) -> BinnedTrace:
    """Average a trace in bins along its path.

    Bins are shortened until the averaging error is small, or they have too few samples.

    Raises:
        SessionError: If the tool does not move, or most of its path has too few samples.
    """
    steps = np.linalg.norm(np.diff(trace.points, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    runs = _split_runs(trace.points, length)
    if not runs:
        raise SessionError("does not move; expected the commanded position of every sample")
    first = [b for run in runs for b in _split_bins(length, run, 1)]
    if 2 * len(_usable(first)) < len(first):
        raise SessionError(
            f"has {len(length)} samples on a path of {length[-1] / MM:.0f} mm; expected at least "
            f"{FEWEST_SAMPLES} at different positions on every {LONGEST_BIN / MM:g} mm: a smaller "
            "feed, or more samples per second"
        )
    smooth = np.zeros(len(length))
    for run in runs:
        smooth[run] = Chebyshev.fit(length[run], trace.values[run], DEGREE)(length[run])
    deviations = trace.values - smooth
    count = 1
    while True:
        split = [_split_bins(length, run, count) for run in runs]
        bins_by_run = [_usable(run_bins) for run_bins in split]
        bins = [b for run_bins in bins_by_run for b in run_bins]
        fits = [_fit_line(length[b], deviations[b]) for b in bins]
        std = float(np.sqrt(np.mean([variance for _, _, variance in fits])))
        values = np.array([value for value, _, _ in fits])
        counts = [len(run_bins) for run_bins in bins_by_run]
        is_exact = _averaging_error(values, counts, std) <= MAX_AVERAGING_ERROR * std
        fewest = min(b.size for b in bins)
        if is_exact or max(counts) >= MOST_BINS or fewest < 2 * FEWEST_SAMPLES:
            break
        count += 1
    middle = np.array([b[index] for b, (_, index, _) in zip(bins, fits, strict=True)])
    values += smooth[middle]
    motions = np.array([trace.points[b[-1]] - trace.points[b[0]] for b in bins])
    unused = [b.size for run_bins in split for b in run_bins if b.size < FEWEST_SAMPLES]
    return BinnedTrace(trace.points[middle], values, motions, std, len(unused), sum(unused))


def _split_runs(points: Array, length: Array) -> list[slice]:
    """Runs of a path between reversals; runs that hardly move are omitted.

    Args:
        points: Tool coordinates, shape (n, n_coordinates), [m].
        length: Path length at the samples, shape (n,), [m].
    """
    marks = np.searchsorted(length, np.arange(0.0, length[-1], REVERSAL_LENGTH))
    marks = np.unique(np.append(marks, len(length) - 1))
    tangents = np.diff(points[marks], axis=0)
    if len(tangents) < 2:
        return []
    turns = np.flatnonzero((tangents[1:] * tangents[:-1]).sum(axis=1) < 0.0) + 1
    ends = [0, *marks[turns].tolist(), len(length) - 1]
    return [
        slice(start, end + 1)
        for start, end in pairwise(ends)
        if length[end] - length[start] > 2.0 * REVERSAL_LENGTH
    ]


def _split_bins(length: Array, run: slice, count: int) -> list[Indices]:
    """Indices of the samples of each bin of a run, with `count` bins per `LONGEST_BIN`.

    Samples at rest, which do not advance along the path, are omitted.
    """
    along = length[run]
    number = max(int(np.ceil(count * (along[-1] - along[0]) / LONGEST_BIN)), 1)
    edges = along[0] + np.arange(1, number) / number * (along[-1] - along[0])
    moving = np.flatnonzero(np.diff(along, prepend=-1.0) > 0.0)
    bins = np.split(moving, np.searchsorted(along[moving], edges))
    return [run.start + samples for samples in bins]


def _usable(bins: Sequence[Indices]) -> list[Indices]:
    """Bins with enough samples."""
    return [b for b in bins if b.size >= FEWEST_SAMPLES]


def _fit_line(along: Array, values: Array) -> tuple[float, int, float]:
    """Fit a line to the samples of a bin.

    Args:
        along: Path length, shape (n,), [m].
        values: Deviations, shape (n,), [m].

    Returns:
        Value of the line at the middle sample, [m], the index of this sample, and the variance of
        the value by batch means, [m²].
    """
    middle = int(np.abs(along - 0.5 * (along[0] + along[-1])).argmin())
    s = along - along.mean()
    slope = (s @ values) / (s @ s)
    residuals = values - values.mean() - slope * s
    means = np.array([batch.mean() for batch in np.array_split(residuals, BATCHES)])
    variance = float(means @ means) / (BATCHES - 2) / BATCHES
    return float(values.mean() + slope * s[middle]), middle, variance


def _averaging_error(values: Array, counts: list[int], std: float) -> float:
    """RMS error of the bins' values by the curvature of the readings, corrected for noise, [m].

    Args:
        values: Values of the bins, shape (n_bins,), [m].
        counts: Number of bins of each run.
        std: Standard deviation of a value, [m].
    """
    runs = np.split(values, np.cumsum(counts)[:-1])
    bends = np.concatenate([np.diff(run, 2) for run in runs])
    noise = 6.0 * std**2  # of v₁ − 2 v₂ + v₃
    return math.sqrt(max(float(bends @ bends) / max(bends.size, 1) - noise, 0.0)) / 24.0


def bin_traces(session: Session, traces: Mapping[str, Trace]) -> dict[str, BinnedTrace]:
    """Average traces in bins along their paths (see `bin_trace`), by setup.

    Args:
        session: A plan or a session.
        traces: Traces by setup.

    Raises:
        SessionError: If a setup does not exist, or a trace has too few samples; names it.
    """
    binned = {}
    for name, trace in traces.items():
        require_name(name, session.setups, "setup", where="--trace")
        with errors_at(f"trace of {name}"):
            binned[name] = bin_trace(trace)
    return binned


def with_traces(session: Session, traces: Mapping[str, BinnedTrace]) -> Session:
    """Session in which binned traces replace the readings of their setups.

    The standard deviation of their gauges becomes that of a bin.

    Args:
        session: A plan or a session.
        traces: Binned traces by setup.

    Raises:
        SessionError: If the machine does not reach a point.
    """
    readings = [r for r in session.readings if r.setup not in traces and r.is_read]
    read_postures = {p for r in readings for p in (r.posture, r.minus)}
    postures = {n: p for n, p in session.postures.items() if n in read_postures}
    stds: dict[str, list[float]] = {}
    for name, binned in traces.items():
        stds.setdefault(session.setups[name].gauge, []).append(binned.std)
        for posture, approach, value in _place_bins(session, name, binned):
            postures[posture.name] = posture
            conditions = Conditions(approach)
            readings.append(Reading(name, posture.name, value=value, conditions=conditions))
    gauges = dict(session.gauges)
    for name, bin_stds in stds.items():
        sigma = float(np.sqrt(np.mean(np.square(bin_stds))))
        gauges[name] = replace(gauges[name], sigma=sigma, resolution=None)
    read_setups = {r.setup for r in readings}
    setups = {
        n: replace(s, aligned_at=None) if n in traces else s
        for n, s in session.setups.items()
        if n in read_setups
    }
    return replace(
        session,
        gauges=gauges,
        setups=setups,
        postures=postures,
        readings=tuple(readings),
        sha256="",
        readings_path=None,
    )


def _place_bins(
    session: Session, setup: str, binned: BinnedTrace
) -> list[tuple[Posture, str, float]]:
    """Posture, approach and reading, [m], of each bin."""
    closure = nominal_closure(session.robot)
    names = [f"{setup}-{i + 1:03d}" for i in range(len(binned.values))]
    try:
        drives = closure.inverse(binned.points, names=names)
        starts = closure.inverse(binned.points - 0.5 * binned.motions, names=names)
    except ClosureError as e:
        raise SessionError(e.reason, where=f"trace of {setup}: {e.posture}") from None
    bins = []
    for name, point, end, start, value in zip(
        names, binned.points, drives, starts, binned.values.tolist(), strict=True
    ):
        posture = Posture(name, "tcp", point, end - session.active_offsets)
        bins.append((posture, name_approach(end - start), value))
    return bins
