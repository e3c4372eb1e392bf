"""The kinds of sensor that a session may name: each is known from here on by its protocol."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from orthocal.errors import OrthocalError
from orthocal.io.documents import validate
from orthocal.io.fields import As
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.sensors.protocol import Sensor, SetupKeys
from orthocal.sensors.rod_indicator import RodKeys, read_leg

DEFAULT = LegIndicator.kind

_KINDS: dict[str, tuple[type[SetupKeys], Callable[[Any], Sensor]]] = {DEFAULT: (RodKeys, read_leg)}
"""What a document may say of each kind, and what makes a sensor of it."""


def register_sensor(kind: type[Sensor]) -> None:
    """Make a kind of sensor known by its name; one that is known already is replaced."""
    _KINDS[kind.kind] = kind.keys, kind.from_keys


def unregister_sensor(kind: str) -> None:
    """Forget a registered kind of sensor."""
    _KINDS.pop(kind, None)


def sensor_kinds() -> tuple[str, ...]:
    """Names of the kinds that are known."""
    return tuple(_KINDS)


def read_setup(
    data: Mapping[str, Any],
    *,
    where: str,
    under: str,
    error: type[OrthocalError],
    gauge: Mapping[str, Any] | None = None,
) -> tuple[SetupKeys, Sensor]:
    """What a document says of a setup, and the sensor that stands there.

    Args:
        data: Keys and values of the setup.
        where: File, for messages.
        under: Key of the setup in it.
        error: Kind of error.
        gauge: What its gauge says for all its setups, where a kind of sensor wants to know.

    Raises:
        OrthocalError: Of that kind, naming the key that does not fit.
    """
    name = data.get("sensor", DEFAULT)
    if not isinstance(name, str) or name not in _KINDS:
        raise error(
            f"found {name!r}; expected one of {', '.join(_KINDS)}",
            where=f"{where}: {under}.sensor",
        )
    schema, build = _KINDS[name]
    known = {k: v for k, v in (gauge or {}).items() if k in schema.model_fields}
    data = {**known, **data}
    keys = validate(schema, data, where=where, error=error, under=under)
    try:
        return keys, build(keys)
    except OrthocalError as e:
        raise error(e.problem, where=f"{where}: {under}.{e.where}") from None


def write_sensor(sensor: Sensor) -> dict[str, Any]:
    """A sensor as a document describes it."""
    kind = {} if sensor.kind == DEFAULT else {"sensor": sensor.kind}
    return {**kind, **sensor.to_keys()}


def _read_recorded(data: object) -> Sensor:
    if not isinstance(data, Mapping):
        raise ValueError("expected keys and values")
    try:
        return read_setup(data, where="", under="", error=OrthocalError)[1]
    except OrthocalError as e:
        raise ValueError(f"{(e.where or '').strip(' :.')}|{e.problem}") from None


RECORDED = As(_read_recorded, write_sensor)
"""A sensor in a record: as a document describes it."""
