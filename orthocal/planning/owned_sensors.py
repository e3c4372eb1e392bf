"""Sensors at the tool that are available for a plan, from files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orthocal.errors import SessionError
from orthocal.io.documents import read_yaml, validate
from orthocal.measurement.files.schema import GaugeKeys
from orthocal.session.session import Gauge
from orthocal.statistics.noise import noise_floor

PLACED = {
    "ball_bar": ("centre_mm", "ball"),
    "tool_indicator": ("direction",),
}
"""Kinds of sensor that a plan places, with the keys that the plan chooses."""


@dataclass(frozen=True, slots=True, eq=False)
class OwnedSensor:
    """A sensor at the tool that is available for a plan."""

    name: str
    gauge: Gauge
    keys: Mapping[str, Any]
    """Keys of its setups in a session.yaml, without those that the plan chooses."""
    file: Path


def load_owned_sensor(path: str | Path) -> OwnedSensor:
    """A sensor from a file: the keys of its gauge and those of a setup, without its place.

    Args:
        path: YAML with `sensor`, `sigma_mm`, `range_mm` and the like, and the keys of a setup.

    Raises:
        SessionError: Naming file and key.
    """
    file = Path(path)
    data = read_yaml(file, error=SessionError)
    if not isinstance(data, dict) or data.get("sensor") not in PLACED:
        raise SessionError(
            f"expected the key sensor: {' or '.join(PLACED)}, and those of the sensor",
            where=str(file),
        )
    gauge_keys = {k: v for k, v in data.items() if k in GaugeKeys.model_fields}
    shared = {"scale_tolerance", "tip"}
    gauge = validate(GaugeKeys, gauge_keys, where=str(file), error=SessionError).to_gauge()
    if not noise_floor(gauge.sigma, gauge.resolution) > 0.0:
        raise SessionError(
            "is missing; a plan needs the repeatability of the readings", where=f"{file}: sigma_mm"
        )
    keys = {k: v for k, v in data.items() if k not in gauge_keys or k in shared}
    for key in PLACED[data["sensor"]]:
        if key in keys:
            raise SessionError("the plan chooses it; leave it out", where=f"{file}: {key}")
    name = "".join(c for c in file.stem if c.isalnum() or c in "_-") or "sensor"
    return OwnedSensor(name, gauge, keys, file)
