"""What is odd about a session, whatever the fit is like: units, sizes, numbers too good."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from orthocal.assessment.findings.finding import Finding, Place, place_of
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.records import PostureRecord
from orthocal.estimation.diagnostics.residual_rows import root_mean_square, rows_by_setup
from orthocal.units import DRIVE_UNITS, MM, UM

Array = NDArray[np.float64]

FINER = 1e-3
"""Part of a step of the gauge by which a reading may miss it: rounding of numbers."""

BY_CHANCE = 1e-3
"""Probability below which residuals are too small for readings that were rounded."""

UNSUITED = 3.0
"""Times what the gauge saw that a nominal machine would have to show it in these postures, for them
to be another machine's. Errors of the machine add to what is seen, they do not take it away."""

LEAST_UNSUITED = 1e-3
"""Deviations below this are those of a machine, [m]."""

FEWEST = 5.0
"""Degrees of freedom below which a scatter says little."""

TOO_COARSE = 30.0
"""Times what readings scatter by that no σ of a gauge is, in the right unit."""

COMPUTED = 1e-7
"""Scatter below which no dial showed the readings, [m]."""

TINY = 2e-3
"""Part of the largest distance of postures below which no two are meant to be apart."""

MANY_PLACES = 500
"""Postures above which their distances are not all computed."""
MOST_PLACES = 20
"""Places of a finding that are kept; how many there are is a number of it."""

DIFFERENT = 5.0
"""Tolerances of a length by which legs of one machine may differ by intent."""


def find_doubts(calibration: Calibration) -> tuple[Finding, ...]:
    """What is odd, the gravest first."""
    found = (
        _postures(calibration),
        _finer(calibration),
        _smooth(calibration),
        _coarse(calibration),
        _tiny(calibration),
        _legs(calibration),
    )
    return tuple(doubt for doubt in found if doubt is not None)


def _postures(calibration: Calibration) -> Finding | None:
    """Postures that would be another machine's: there the nominal one would show far more."""
    seen = []
    for rows in rows_by_setup(calibration.residuals).values():
        raw = [r.measured for r in rows if r.minus is None]
        mean = sum(raw) / len(raw) if raw else 0.0
        seen += [r.measured - mean for r in rows if r.minus is None]
        seen += [r.measured for r in rows if r.minus is not None]
    measured, deviation = root_mean_square(seen), calibration.rms_before
    if deviation < LEAST_UNSUITED or deviation < UNSUITED * measured:
        return None
    lengths = _leg_words(calibration.robot_record.legs)
    return Finding(
        "wrong size",
        "stops",
        f"In these postures the robot with {lengths} would have shown the gauge "
        f"{deviation / MM:.1f} mm (r.m.s.) that it did not see: the postures are those of a "
        "machine of another size, or the robot is.",
        "Check `robot` and the joint coordinates.",
        numbers={"foretold_rms_mm": deviation / MM, "measured_rms_mm": measured / MM},
    )


def _finer(calibration: Calibration) -> Finding | None:
    """Readings between the steps of the gauge: another unit, or another gauge."""
    rows = calibration.residuals
    return find_finer(
        [r.measured for r in rows],
        calibration.session.gauge_resolution,
        where=lambda i: calibration.where(rows[i]),
        place=lambda i: place_of(calibration, rows[i]),
    )


def find_finer(
    values: Sequence[float],
    step: float | None,
    *,
    where: Callable[[int], str],
    place: Callable[[int], Place],
) -> Finding | None:
    """Whether most readings stand between the steps of a gauge.

    Args:
        values: Readings, [m].
        step: Resolution of the gauge, [m]; None where it is not stated.
        where: File and line of a reading, by its number.
        place: The same as a place.
    """
    if not step:
        return None
    steps = np.asarray(values, dtype=np.float64) / step
    finer = np.flatnonzero(np.abs(steps - np.round(steps)) > FINER).tolist()
    if len(finer) * 2 < len(values):
        return None
    first = finer[0]
    return Finding(
        "finer than the dial",
        "warns",
        f"{len(finer)} of {len(values)} readings are finer than the gauge's "
        f"resolution of {step / MM:g} mm, the first in {where(first)} "
        f"({values[first] / MM:.6g} mm).",
        "Make sure that they are in mm, not in inches, and that the resolution is right.",
        numbers={"finer": float(len(finer)), "resolution_mm": step / MM},
        places=tuple(place(i) for i in finer[:MOST_PLACES]),
    )


def _smooth(calibration: Calibration) -> Finding | None:
    """Residuals that are smaller than rounding to the gauge's steps leaves."""
    step, noise = calibration.session.gauge_resolution, calibration.noise
    if not step:
        return None
    total = len(calibration.residuals)
    zeros = len({r.setup for r in calibration.residuals if r.minus is None})
    used = total - zeros - noise.residual_dof
    # repeated readings may have been rounded alike: each counts once
    dof = calibration.identifiability.n_readings - used
    least = step / math.sqrt(12.0)
    if not noise.is_finer_than(least, dof=dof):
        return None
    return Finding(
        "too little left",
        "warns",
        f"What remains, {noise.residual_sigma / UM:.2g} µm, is less than rounding to the gauge's "
        f"resolution of {step / MM:g} mm leaves ({least / UM:.2g} µm): the readings are in "
        "another unit than mm, were computed, or the dial did not move.",
        "Make sure that the readings are what the dial showed, in mm.",
        numbers={
            "left_um": noise.residual_sigma / UM,
            "rounding_um": least / UM,
            "resolution_mm": step / MM,
        },
    )


def _coarse(calibration: Calibration) -> Finding | None:
    """A σ far above what repeated readings scatter by, or what remains: in another unit."""
    given, noise = calibration.session.gauge_sigma, calibration.noise
    scatter = noise.cycles_sigma if noise.cycles_dof >= FEWEST else noise.residual_sigma
    dof = noise.cycles_dof if noise.cycles_dof >= FEWEST else noise.residual_dof
    if given is None or dof < FEWEST or not COMPUTED < TOO_COARSE * scatter < given:
        return None  # readings without any scatter were computed
    return Finding(
        "sigma too coarse",
        "warns",
        f"The σ given for the gauge, {given / MM:g} mm, is {given / scatter:.0f} times what its "
        f"readings scatter by ({scatter / MM:.2g} mm).",
        "Make sure that gauge.sigma_mm is in mm.",
        numbers={"given_mm": given / MM, "scatter_mm": scatter / MM, "times": given / scatter},
    )


def _tiny(calibration: Calibration) -> Finding | None:
    """Postures hardly away from another one, beside far ones: given in metres."""
    joined = bool(calibration.session.parts)
    sessions: dict[str, list[PostureRecord]] = {}
    for posture in calibration.postures:  # another session's differ by the offsets active in it
        sessions.setdefault(posture.name.partition("/")[0] if joined else "", []).append(posture)
    return next(filter(None, map(_tiny_among, sessions.values())), None)


def _tiny_among(postures: Sequence[PostureRecord]) -> Finding | None:
    drives = np.array([p.drives for p in postures])
    places, first = np.unique(drives, axis=0, return_index=True)
    if len(places) < 3:
        return None
    gaps = _nearest(places)
    largest = float(np.linalg.norm(np.ptp(places, axis=0)))
    near = np.flatnonzero(gaps < TINY * largest)
    if not near.size:
        return None
    worst = near[first[near].argmax()]
    name = postures[int(first[worst])].name
    return Finding(
        "posture too near",
        "warns",
        f"Posture '{name}' is {gaps[worst] / MM:.2g} mm from another one, where postures "
        f"are up to {largest / MM:.0f} mm apart.",
        "Make sure that it is in mm, not in metres.",
        numbers={"gap_mm": float(gaps[worst]) / MM, "largest_mm": largest / MM},
        places=(Place(posture=name),),
    )


def _nearest(places: Array) -> Array:
    """Distance of each place from the one next to it, shape (n,) of (n, 3)."""
    if len(places) > MANY_PLACES:
        from scipy.spatial import KDTree

        return np.asarray(KDTree(places).query(places, k=2)[0])[:, 1]
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return np.asarray(apart.min(axis=1))


def _legs(calibration: Calibration) -> Finding | None:
    """Legs that are not of one length, on a machine whose drives are all alike."""
    legs = calibration.robot_record.legs
    drives = {(d.unit, d.zero, d.lower, d.upper) for d in calibration.robot.drives}
    if len(legs) < 2 or len(drives) > 1:
        return None
    lengths = [length for _, length in legs]
    tolerance = _length_tolerance(calibration)
    if max(lengths) - min(lengths) < DIFFERENT * tolerance:
        return None
    return Finding(
        "legs differ",
        "warns",
        f"The machine's legs are not of one length ({_leg_words(legs)}).",
        "Make sure that its size was changed in every place of the URDF.",
        numbers={f"{name}_mm": length / MM for name, length in legs},
    )


def _length_tolerance(calibration: Calibration) -> float:
    """What the workshop can be trusted with in a length, [m]."""
    found = [
        e.name for e in calibration.robot.parameters.elementary.values() if e.kind == "translation"
    ]
    return max((calibration.robot.parameters[n].tolerance for n in found), default=0.0)


def _leg_words(legs: tuple[tuple[str, float], ...]) -> str:
    shown = {name: f"{length / MM:g}" for name, length in legs}
    if len(set(shown.values())) == 1:
        return f"legs of {next(iter(shown.values()))} mm"
    return f"legs of {', '.join(f'{n} {v}' for n, v in shown.items())} mm"


def describe_machine(calibration: Calibration) -> str:
    """The machine's size: legs and travel, in words."""
    travel = {}
    for name, unit, *ends in calibration.robot_record.travel:
        word, size = DRIVE_UNITS[unit]
        low, high = ("∞" if v is None else f"{v / size:g}" for v in ends)
        travel[name] = f"{low} … {high} {word.replace('deg', '°')}".replace("∞ …", "−∞ …")
    words = []
    if calibration.robot_record.legs:
        words.append(_leg_words(calibration.robot_record.legs))
    if len(set(travel.values())) == 1:
        words.append(f"travel {next(iter(travel.values()))}")
    else:
        words.append(f"travel {', '.join(f'{n} {t}' for n, t in travel.items())}")
    return ", ".join(words)
