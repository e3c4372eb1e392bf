"""Tables of a calibration: lists of plain records for pandas, polars or csv.DictWriter.

Values are in SI units, which the records of parameters state. Unknown values are None.
"""

from __future__ import annotations

import math

from orthocal.calibration.calibration import Calibration, require_calibration
from orthocal.io.fields import finite_or_none
from orthocal.session.session import Conditions

Record = dict[str, str | float | int | bool | None]


def parameter_table(calibration: Calibration) -> list[Record]:
    """Records of all parameters: free ones, known ones, then those of sensors.

    `value`, `linearised`, `std` (from noise, priors and unmodelled errors), `std_scatter` (its part
    from noise), `std_scaled` (its part from errors that the tolerance scale multiplies), `low` and
    `high` (value ± expanded uncertainty), and `prior_std` are in `unit`.
    """
    require_calibration(calibration)
    intervals = dict(
        zip((p.name for p in calibration.free), calibration.intervals, strict=True),
    )
    records: list[Record] = []
    for owner, group in (("machine", calibration.parameters), ("sensor", calibration.sensors)):
        for p in group:
            low, high = intervals.get(p.name, (math.nan, math.nan))
            records.append(
                {
                    "name": p.name,
                    "of": owner,
                    "unit": p.unit,
                    "value": p.value,
                    "linearised": p.linear,
                    "std": finite_or_none(p.std),
                    "std_scatter": finite_or_none(p.std_scatter),
                    "std_scaled": finite_or_none(p.std_scaled),
                    "low": finite_or_none(low),
                    "high": finite_or_none(high),
                    "prior_std": p.prior_std,
                    "free": p.free,
                    "resolvable": p.resolvable,
                    "at_bound": p.at_bound,
                }
            )
    return records


def reading_table(calibration: Calibration) -> list[Record]:
    """Records of all rows of readings, in metres except `studentised` and the conditions."""
    require_calibration(calibration)
    return [
        {
            "setup": r.setup,
            "posture": r.posture,
            "minus": r.minus,
            "cycle": r.cycle,
            "measured": r.measured,
            "nominal": r.nominal,
            "linearised": finite_or_none(r.linear),
            "predicted": r.predicted,
            "deviation": r.deviation,
            "residual": r.residual,
            "prediction_error": finite_or_none(r.prediction_error),
            "studentised": finite_or_none(r.studentised),
            "file": r.file or calibration.session.readings_path,
            "line": r.line,
            **_conditions(r.conditions or Conditions()),
        }
        for r in calibration.residuals
    ]


def _conditions(conditions: Conditions) -> Record:
    time = conditions.time
    return {
        "approach": conditions.approach,
        "temperature_C": conditions.temperature,
        "time": None if time is None else time.isoformat(),
    }
