"""Whether what two fits leave is the same: error of the model repeats, noise does not."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from orthocal.calibration.calibration import Calibration
from orthocal.estimation.diagnostics.residual_rows import ResidualRow
from orthocal.measurement.joining import name_within
from orthocal.statistics.distributions import beta_share

FEWEST = 3
"""Rows below which there is no correlation."""

CHANCE = 0.05
"""Probability below which a repetition of residuals is not put down to chance."""


@dataclass(frozen=True, slots=True, eq=False)
class Repetition:
    """Residuals of two sessions held against each other."""

    matched: int
    """Rows that both sessions have."""
    correlation: float
    """Of the residuals of both fits over those rows; NaN below three."""
    chance: float
    """Probability of such a correlation between residuals that are noise; NaN if unknown."""

    scatter: float
    """Standard deviation of a row that does not repeat in the other session, [m]; NaN without
    degrees of freedom."""
    scatter_dof: float
    """Degrees of freedom of that."""

    @property
    def repeats(self) -> bool | None:
        """Whether what is left is the same again: model error, not noise. None if unknown."""
        if math.isnan(self.chance):
            return None
        return self.chance < CHANCE and self.correlation > 0.0

    @property
    def untold(self) -> str:
        """Why it is unknown."""
        if self.matched < FEWEST:
            return "too few rows are shared"
        return f"the fit leaves too little of the {self.matched} rows that are shared"

    def to_document(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "matched": self.matched,
            "correlation": None if math.isnan(self.correlation) else self.correlation,
            "chance": None if math.isnan(self.chance) else self.chance,
            "residuals_repeat": self.repeats,
        }


def measure_repetition(first: Calibration, second: Calibration) -> Repetition:
    """Hold the residuals of two calibrations of the same parameters against each other."""
    matched, correlation, cosine = _correlate(first, second)
    dims = _residual_dimensions(second, matched)
    chance = math.nan
    if matched >= FEWEST and dims > 1.0 and not math.isnan(correlation):
        # directions of noise are spread evenly over the space that the fit leaves to residuals
        tail = 0.5 * (1.0 - beta_share(0.5, 0.5 * (dims - 1.0), cosine**2))
        chance = tail if cosine > 0.0 else 1.0 - tail
    scatter, scatter_dof = _scatter(first, second)
    return Repetition(matched, correlation, chance, scatter, scatter_dof)


def _scatter(first: Calibration, second: Calibration) -> tuple[float, float]:
    """What does not repeat, from residuals of rows that both sessions have, cycle for cycle."""
    rows = [{(*key, r.cycle): r for key, r in _rows(c)} for c in (first, second)]
    alike = rows[0].keys() == rows[1].keys()
    if not alike or len(rows[0]) != len(first.residuals) or len(rows[1]) != len(second.residuals):
        return math.nan, 0.0
    # both fits have taken parameters and gauge zeros out, and with them out of the difference
    square = sum((rows[0][k].residual - rows[1][k].residual) ** 2 for k in rows[0])
    setups = {r.setup for r in second.residuals if r.minus is None}
    dof = float(len(rows[0]) - len(setups) - len(second.free))
    return (math.sqrt(0.5 * square / dof) if dof > 0.0 else math.nan), max(dof, 0.0)


def _residual_dimensions(refit: Calibration, matched: int) -> float:
    """Dimensions that a fit leaves to the residuals of matched rows, cycles averaged."""
    rows = refit.residuals
    zeros = len({r.setup for r in rows if r.minus is None})
    used = len(rows) - zeros - refit.noise.residual_dof
    return matched - zeros - used


_Row = tuple[str, str, str | None]
"""Setup, posture, and posture that was taken off, as their own session names them."""


def _rows(calibration: Calibration) -> Iterator[tuple[_Row, ResidualRow]]:
    joined = bool(calibration.session.parts)
    for r in calibration.residuals:
        setup, posture = (name_within(n, joined=joined) for n in (r.setup, r.posture))
        minus = None if r.minus is None else name_within(r.minus, joined=joined)
        yield (setup, posture, minus), r


def _correlate(first: Calibration, second: Calibration) -> tuple[int, float, float]:
    """Rows that two sessions share, cycles averaged; correlation and cosine of their residuals."""
    means = []
    for calibration in (first, second):
        collected: dict[_Row, list[float]] = defaultdict(list)
        for key, r in _rows(calibration):
            collected[key].append(r.residual)
        means.append({key: sum(v) / len(v) for key, v in collected.items()})
    common = [key for key in means[0] if key in means[1]]
    a, b = (np.array([m[key] for key in common]) for m in means)
    if len(common) < FEWEST or not np.any(a) or not np.any(b):
        return len(common), math.nan, math.nan
    cosine = float(a @ b / np.sqrt((a @ a) * (b @ b)))
    return len(common), float(np.corrcoef(a, b)[0, 1]), cosine
