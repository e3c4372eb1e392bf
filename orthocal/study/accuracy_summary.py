"""What a study of many machines says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ClosureError
from orthocal.planning.expected_error import Expected
from orthocal.robot.parameters import Parameter
from orthocal.study.accuracy import GOOD, AccuracyStudy
from orthocal.study.runner import StudyTable
from orthocal.units import UM

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Missed:
    """By how much one parameter is missed."""

    parameter: Parameter
    rms: float
    """[SI]"""
    doubt: float
    """Of the r.m.s., from drawing so many machines: one standard deviation, [SI]."""
    foretold: float
    """Standard deviation by the analytic covariance, [SI]."""
    of_tolerance: float
    """The r.m.s. over what the parameter itself is drawn with, or its tolerance."""


@dataclass(frozen=True, slots=True, eq=False)
class AccuracySummary:
    """What a study of machines says."""

    machines: int
    """That were calibrated."""
    failed: Mapping[str, int]
    """Reason to the number of machines that were not."""
    before: float
    """R.m.s. at the tool as machines are, headline form, [m]."""
    after: float
    """The same, calibrated."""
    doubt: float
    """Of that, from drawing so many machines: one standard deviation, [m]."""
    most: float
    """What 95 % of the machines stay below, [m]."""
    worst: float
    """At the worst point, r.m.s. over the machines, [m]."""
    relative: float
    absolute: float
    foretold: Expected | None
    """None where nothing can be foretold."""
    missed: tuple[Missed, ...]
    """Those first that are most of their tolerance."""


def summarise_accuracy(study: AccuracyStudy, table: StudyTable) -> AccuracySummary:
    """What a study of machines says."""
    columns = table.columns
    status = np.array(columns.get("status", []), dtype=object)
    good = status == GOOD

    def column(name: str) -> Array:
        values = np.array(columns.get(name, []), dtype=np.float64)
        return values[good] if values.size else values

    parameters = study.choice.select(study.session.unpack().robot.parameters).parameters
    tools = column("tool_um") * UM
    try:
        foretold = study.foretold if good.any() else None
    except (ClosureError, np.linalg.LinAlgError):
        foretold = None
    missed = []
    for i, p in enumerate(parameters):
        values = column(f"missed.{p.name}_{p.edge_unit}") / p.edge_factor
        rms, doubt = _root_mean_square(values)
        expected = np.nan
        if foretold is not None:
            expected = float(np.sqrt(foretold.covariance[i, i]))
        scale = study.tolerances.get(p.name, p.tolerance)
        missed.append(Missed(p, rms, doubt, expected, rms / scale))
    rms, doubt = _root_mean_square(tools)
    return AccuracySummary(
        machines=int(good.sum()),
        failed={str(s): int((status == s).sum()) for s in sorted(set(status[~good]))},
        before=_root_mean_square(column("before_um") * UM)[0],
        after=rms,
        doubt=doubt,
        most=float(np.quantile(tools, 0.95)) if tools.size else np.nan,
        worst=_root_mean_square(column("tool_worst_um") * UM)[0],
        relative=_root_mean_square(column("tool_shift_out_um") * UM)[0],
        absolute=_root_mean_square(column("tool_absolute_um") * UM)[0],
        foretold=foretold,
        missed=tuple(sorted(missed, key=lambda m: -m.of_tolerance)),
    )


def _root_mean_square(values: Array) -> tuple[float, float]:
    """R.m.s., and its standard deviation from so many values."""
    if not values.size:
        return np.nan, np.nan
    square = values**2
    rms = float(np.sqrt(square.mean()))
    if values.size < 2 or rms == 0.0:
        return rms, np.nan
    return rms, float(square.std(ddof=1) / np.sqrt(values.size) / (2.0 * rms))
