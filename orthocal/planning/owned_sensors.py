"""Sensors at the tool that are available for a plan, loaded from files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field, model_validator

from orthocal.errors import SessionError
from orthocal.io.documents import Keys, Number, read_yaml, validate
from orthocal.measurement.files.session_keys import GaugeKeys
from orthocal.observation.gauge_noise import stated_sigma
from orthocal.sensors.registry import read_setup
from orthocal.session.session import Gauge
from orthocal.units import DEG, MM

DIAL = "dial"
"""Name of the gauge for legs in plans with sensors at the tool."""

SLACK = 1e-9
"""Rounding error of a time that is accepted, [min]."""


class Duration(NamedTuple):
    """Durations of a setup and a reading with a gauge, [min]."""

    setup: float
    reading: float

    def of(self, readings: int) -> float:
        """Minutes of a setup with `readings` readings and a closing one."""
        return self.setup + (readings + 1) * self.reading

    def max_readings(self, minutes: float, limit: int) -> int:
        """Largest number of readings of a setup within a time, without the closing one."""
        available = minutes - self.setup + SLACK
        if available < 0.0:
            return 0
        if available < self.reading * (limit + 1):
            return max(int(available / self.reading) - 1, 0)
        return limit


DURATIONS = {
    "ball_bar": Duration(10.0, 0.5),
    "points": Duration(20.0, 0.5),
    "probe": Duration(2.0, 0.1),
    "tool_indicator": Duration(10.0, 0.5),
}
"""Usual durations by kind of sensor. A probe is read automatically."""

Minutes = Annotated[Number, Field(ge=0.0, le=1e4)]
Angle = Annotated[Number, Field(ge=-90.0, le=90.0)]

BAR_RADIUS = 10 * MM
"""Default radius of a ball bar with its sleeve and cups, [m]."""

OF_BARS = ("radius_mm", "elevation_deg")
"""Keys of a plan that only ball bars have."""


class PlanKeys(Keys):
    """Keys of a sensor's file that only a plan uses."""

    minutes_per_setup: Minutes | None = None
    minutes_per_reading: Minutes | None = None
    radius_mm: Annotated[Number, Field(ge=0.0, le=1000.0)] = BAR_RADIUS / MM
    """Radius about the axis of a ball bar in which no rod may be."""
    elevation_deg: tuple[Angle, Angle] = (-90.0, 90.0)
    """Lowest and highest angle of a ball bar above the plane of x and y, from the tool's ball."""

    @model_validator(mode="after")
    def _require_order(self) -> PlanKeys:
        """Refuse an empty range of elevations."""
        low, high = self.elevation_deg
        if not low < high:
            raise ValueError(f"elevation_deg|found [{low:g}, {high:g}]; expected [LOW, HIGH]")
        return self

    def to_duration(self, usual: Duration) -> Duration:
        """Stated durations; the usual ones by default."""
        setup, reading = self.minutes_per_setup, self.minutes_per_reading
        return Duration(
            usual.setup if setup is None else float(setup),
            usual.reading if reading is None else float(reading),
        )


PLACEMENT_KEYS: Mapping[str, Mapping[str, Any]] = {
    "ball_bar": {"centre_mm": [0.0, 0.0, 0.0], "ball": "ball"},
    "tool_indicator": {"direction": "x"},
    "probe": {},
    "points": {"station": "station"},
}
"""Kinds of sensor that a plan can place, with the keys that the plan chooses. Their values here
are examples for the validation of the other keys."""

ARTEFACT_PLACEMENT_KEYS: Mapping[str, Mapping[str, Any]] = {
    "square": {"along": "y", "name": "square"},
    "straightedge": {"along": "y", "name": "edge"},
    "plate": {},
    "gauge_block": {"table_mm": 0.0},
}
"""Kinds of artefact with the keys that the plan chooses, and example values."""

CHOSEN_KEYS = ("gauge", "postures", "aligned_at", "axis")
"""Keys that the plan chooses in every setup, or that no file of a session may have."""


@dataclass(frozen=True, slots=True, eq=False)
class OwnedSensor:
    """Sensor at the tool that is available for a plan."""

    name: str
    gauge: Gauge
    keys: Mapping[str, Any]
    """Keys of a setup in a session.yaml, without the keys that the plan chooses."""
    file: Path
    duration: Duration
    radius: float = BAR_RADIUS
    """Radius about the axis of a ball bar in which no rod may be, [m]."""
    elevation: tuple[float, float] = (-0.5 * math.pi, 0.5 * math.pi)
    """Lowest and highest angle of a ball bar above the plane of x and y, [rad]."""


def load_owned_sensor(path: str | Path) -> OwnedSensor:
    """Load a sensor from a file with the keys of its gauge and of a setup without placement.

    Args:
        path: YAML with `sensor`, keys of a gauge such as `sigma_mm` and `range_mm`, keys of a
            setup, and those of `PlanKeys`.

    Raises:
        SessionError: If the file is invalid; names file and key.
    """
    file = Path(path)
    data = read_yaml(file, error=SessionError)
    if not isinstance(data, dict) or data.get("sensor") not in list(PLACEMENT_KEYS):
        raise SessionError(
            f"expected the key sensor: {' or '.join(PLACEMENT_KEYS)}, and keys of this sensor",
            where=str(file),
        )
    _suggest_keys(data, file)
    for key in OF_BARS:
        if key in data and data["sensor"] != "ball_bar":
            raise SessionError("only a ball bar has it; delete this key", where=f"{file}: {key}")
    of_plan = {k: data.pop(k) for k in PlanKeys.model_fields if k in data}
    planned = validate(PlanKeys, of_plan, where=str(file), error=SessionError)
    gauge_keys = {k: v for k, v in data.items() if k in GaugeKeys.model_fields}
    shared = {"scale_tolerance", "tip"}
    gauge = validate(GaugeKeys, gauge_keys, where=str(file), error=SessionError).to_gauge()
    if not stated_sigma(gauge) > 0.0:
        raise SessionError(
            "is missing; a plan needs the repeatability of the readings", where=f"{file}: sigma_mm"
        )
    keys = {k: v for k, v in data.items() if k not in gauge_keys or k in shared}
    _require_keys(keys, file)
    name = "".join(c for c in file.stem if c.isalnum() or c in "_-") or "sensor"
    low, high = (angle * DEG for angle in planned.elevation_deg)
    duration, radius = planned.to_duration(DURATIONS[data["sensor"]]), planned.radius_mm * MM
    return OwnedSensor(name, gauge, keys, file, duration, radius, (low, high))


def _suggest_keys(data: Mapping[str, Any], file: Path) -> None:
    """Refuse a key that resembles one of the gauge or of the plan.

    Raises:
        SessionError: Naming file, key and the key that was probably meant.
    """
    known = [*GaugeKeys.model_fields, *PlanKeys.model_fields]
    for key in data:
        similar = [k for k in known if k.rpartition("_")[0] == key]
        if similar:
            raise SessionError(f"unknown key; expected {similar[0]}", where=f"{file}: {key}")


def _require_keys(keys: Mapping[str, Any], file: Path) -> None:
    """Refuse keys that the plan chooses, and invalid values.

    Raises:
        SessionError: If a key or value is refused; names file and key.
    """
    chosen = PLACEMENT_KEYS[keys["sensor"]]
    complete, artefact = {**keys, **chosen}, keys.get("artefact")
    refused = [key for key in (*chosen, *CHOSEN_KEYS) if key in keys]
    if isinstance(artefact, Mapping) and artefact.get("kind") in list(ARTEFACT_PLACEMENT_KEYS):
        of_artefact = ARTEFACT_PLACEMENT_KEYS[artefact["kind"]]
        refused += [f"artefact.{key}" for key in of_artefact if key in artefact]
        complete["artefact"] = {**artefact, **of_artefact}
    if refused:
        raise SessionError("the plan chooses it; delete this key", where=f"{file}: {refused[0]}")
    read_setup(complete, where=str(file), under="", error=SessionError)
