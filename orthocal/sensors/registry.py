"""Kinds of sensor that a session may name: built-in, registered, or from installed packages.

A package offers a kind by an entry point of the group `orthocal.sensors`. Its name is the kind, and
its object is the class:

    [project.entry-points."orthocal.sensors"]
    tool = "my_package.tool:ToolIndicator"
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import PlainSerializer, PlainValidator

from orthocal.arguments import require_kind
from orthocal.errors import OrthocalError
from orthocal.io.documents import validate
from orthocal.runtime.registry import Registry
from orthocal.sensors.protocol import Sensor, SetupKeys

DEFAULT = "leg"
"""Kind of sensor of a setup that states none."""

GROUP = "orthocal.sensors"
"""Group of the entry points by which installed packages offer kinds of sensor."""


def _require_sensor(name: str, offered: type[Sensor]) -> type[Sensor]:
    """The offered class, which must be a sensor with the kind of its entry point.

    Raises:
        TypeError: If it is not.
    """
    kind, keys = (getattr(offered, attribute, None) for attribute in ("kind", "keys"))
    if kind != name or not isinstance(keys, type) or not issubclass(keys, SetupKeys):
        raise TypeError(f"{offered.__qualname__} is not a sensor with kind = '{name}' and keys")
    return offered


BUILT_IN = {
    "leg": "orthocal.sensors.leg_indicator:LegIndicator",
    "ball_bar": "orthocal.sensors.ball_bar:BallBar",
    "distance": "orthocal.sensors.distance:Distance",
    "tool_indicator": "orthocal.sensors.tool_indicator:ToolIndicator",
    "points": "orthocal.sensors.points:Points",
    "probe": "orthocal.sensors.probe:Probe",
}
"""Built-in kinds and their classes, which are imported on first use."""

_SENSORS = Registry[type[Sensor]](GROUP, "sensor", _require_sensor, BUILT_IN)


def register_sensor(sensor: type[Sensor]) -> None:
    """Register a sensor; it replaces a sensor of the same kind.

    Raises:
        TypeError: If it is no class of a sensor with `kind` and `keys`.
    """
    require_kind(sensor, type, expected="a class with the members of Sensor")
    _SENSORS.register(getattr(sensor, "kind", ""), sensor)


def unregister_sensor(kind: str) -> None:
    """Remove a registered kind of sensor; a built-in kind that it replaced returns."""
    _SENSORS.unregister(kind)


def sensor_kinds() -> tuple[str, ...]:
    """Names of all kinds, including those of installed packages."""
    return _SENSORS.names


def read_setup(
    data: Mapping[str, Any],
    *,
    where: str,
    under: str,
    error: type[OrthocalError],
    gauge: Mapping[str, Any] | None = None,
) -> tuple[SetupKeys, Sensor]:
    """Keys of a setup and its sensor, from a document.

    Args:
        data: Keys and values of the setup.
        where: Name of the file, for messages.
        under: Key of the setup in the file.
        error: Kind of error to raise.
        gauge: Keys and values that the gauge states for all its setups.

    Raises:
        OrthocalError: Of kind `error`, if the kind of sensor is unknown, or a key is wrong; names
            the key.
    """
    name = data.get("sensor", DEFAULT)
    kind = _SENSORS.find(name, where=f"{where}: {under}.sensor", error=error)
    defaults = {k: v for k, v in (gauge or {}).items() if k in kind.keys.model_fields}
    data = {**defaults, **data}
    keys = validate(kind.keys, data, where=where, error=error, under=under)
    try:
        return keys, kind.from_keys(keys)
    except OrthocalError as e:
        raise error(e.problem, where=f"{where}: {under}.{e.where}") from None


def write_sensor(sensor: Sensor) -> dict[str, Any]:
    """Keys of a sensor for a document, without the default kind."""
    kind = {} if sensor.kind == DEFAULT else {"sensor": sensor.kind}
    return {**kind, **sensor.to_keys()}


def _read_recorded(data: object) -> Sensor:
    """Sensor from plain data.

    Raises:
        ValueError: If they are invalid, as "KEY|PROBLEM".
    """
    if not isinstance(data, Mapping):
        raise ValueError("expected keys and values")
    try:
        return read_setup(data, where="", under="", error=OrthocalError)[1]
    except OrthocalError as e:
        raise ValueError(f"{(e.where or '').strip(' :.')}|{e.problem}") from None


RecordedSensor = Annotated[Sensor, PlainValidator(_read_recorded), PlainSerializer(write_sensor)]
"""Field type of a sensor in a record."""
