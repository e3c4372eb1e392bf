"""Which mistake in entering offsets explains new readings: forgotten, wrong sign, entered twice.

The calibration said which offsets to enter, d more than were active. If other ones are active
instead, by m d less for some of the drives, the machine shows J m d more than it should: m is 1
where they were not entered, 2 where their sign was turned, −1 where they were entered twice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mistake = Literal["not entered", "wrong sign", "entered twice"]

MULTIPLES: Mapping[Mistake, float] = {"not entered": 1.0, "wrong sign": 2.0, "entered twice": -1.0}
"""What of the change that was asked for is missing in the controller."""

EXPLAINED = 0.5
"""Part of what offsets can explain that a mistake may leave of it at most, r.m.s., to be taken for
the reason."""

AS_GOOD = 1.05
"""Times what the best of the mistakes leaves up to which fewer of the drives are held to be it:
what hardly shows is not said of a drive."""


@dataclass(frozen=True, slots=True, eq=False)
class EnteringMistake:
    """A mistake in entering offsets that explains what a new session shows."""

    kind: Mistake
    drives: tuple[str, ...]
    """Of which drives."""
    all_drives: bool
    """Whether these are all drives whose offsets were to change."""
    active: Array
    """Offsets that are in the controller then, shape (n_drives,), [m, rad]."""
    rms: float
    """What it leaves of the deviations, [m]."""


def find_mistake(
    deviations: Array,
    slopes: Array,
    change: Array,
    *,
    entered: Array,
    names: tuple[str, ...],
    rounding: Array,
) -> EnteringMistake | None:
    """The mistake that explains deviations best, if one does.

    Args:
        deviations: New readings less those of the calibrated machine, zeros eliminated, (n,), [m].
        slopes: How the readings answer to the offsets of the drives, zeros eliminated, shape
            (n, n_drives), [m per m or rad].
        change: d, what was to be entered more than was active, shape (n_drives,), [m, rad].
        entered: Offsets that are taken to be active, shape (n_drives,), [m, rad].
        names: Of the drives.
        rounding: Changes that are none, shape (n_drives,), [m, rad].
    """
    # what offsets have no part in is error of the model, and stays whatever is entered
    shown = slopes @ np.linalg.lstsq(slopes, deviations, rcond=None)[0]
    moved = [i for i in range(change.size) if abs(change[i]) > rounding[i]]
    found: list[tuple[float, int, Mistake, tuple[int, ...]]] = []
    for kind, multiple in MULTIPLES.items():
        for count in range(1, len(moved) + 1):
            for drives in combinations(moved, count):
                missing = np.zeros_like(change)
                missing[list(drives)] = multiple * change[list(drives)]
                found.append((_rms(shown - slopes @ missing), count, kind, drives))
    if not found:
        return None
    least = min(f[0] for f in found)
    if not least < EXPLAINED * _rms(shown):
        return None
    _, _, kind, drives = min(
        (f for f in found if f[0] <= AS_GOOD * least), key=lambda f: (f[1], f[0])
    )
    missing = np.zeros_like(change)
    missing[list(drives)] = MULTIPLES[kind] * change[list(drives)]
    return EnteringMistake(
        kind=kind,
        drives=tuple(names[i] for i in drives),
        all_drives=len(drives) == len(moved),
        active=entered - missing,
        rms=_rms(deviations - slopes @ missing),
    )


def _rms(values: Array) -> float:
    return math.sqrt(float(values @ values) / max(values.size, 1))
