"""Kinds of sensor that a session may name: packaged, registered, or from installed packages.

A package offers a kind by an entry point of the group `orthocal.sensors`. Its name is the kind, and
its object is the class:

    [project.entry-points."orthocal.sensors"]
    tool = "my_package.tool:ToolIndicator"
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Any

from orthocal.errors import OrthocalError
from orthocal.io.documents import validate
from orthocal.io.fields import As
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.sensors.protocol import Sensor, SetupKeys
from orthocal.sensors.rod_indicator import RodKeys, read_leg

DEFAULT = LegIndicator.kind

GROUP = "orthocal.sensors"
"""Group of the entry points by which installed packages offer kinds of sensor."""

_KINDS: dict[str, tuple[type[SetupKeys], Callable[[Any], Sensor]]] = {DEFAULT: (RodKeys, read_leg)}
"""Kind to its keys and to the function that builds a sensor from them."""


def register_sensor(kind: type[Sensor]) -> None:
    """Register a kind of sensor; it replaces one of the same name."""
    _KINDS[kind.kind] = kind.keys, kind.from_keys


def unregister_sensor(kind: str) -> None:
    """Forget a registered kind of sensor."""
    _KINDS.pop(kind, None)


def sensor_kinds() -> tuple[str, ...]:
    """Names of all kinds, with those of installed packages."""
    return tuple(dict.fromkeys([*_KINDS, *(e.name for e in entry_points(group=GROUP))]))


def _find_kind(
    name: object, *, where: str, error: type[OrthocalError]
) -> tuple[type[SetupKeys], Callable[[Any], Sensor]]:
    """Keys and builder of a kind; one of an installed package is loaded here.

    Raises:
        OrthocalError: If the kind is unknown, or its package cannot be loaded.
    """
    if isinstance(name, str) and name in _KINDS:
        return _KINDS[name]
    offered = [e for e in entry_points(group=GROUP) if e.name == name]
    if not offered:
        kinds = ", ".join(sensor_kinds())
        raise error(f"found {name!r}; expected one of {kinds}", where=where)
    point = offered[0]
    package = "" if point.dist is None else f" of package {point.dist.name}"
    try:
        kind = point.load()
        found = kind.keys, kind.from_keys
        if kind.kind != name or not issubclass(kind.keys, SetupKeys):
            raise TypeError(f"{point.value} is not a sensor with kind = '{name}' and keys")
    except Exception as e:  # whatever foreign code raises is this one problem
        reason = f"{type(e).__name__}: {e}"
        raise error(
            f"the sensor '{name}'{package} cannot be loaded: {reason}", where=where
        ) from None
    return found


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
        where: File, for messages.
        under: Key of the setup in it.
        error: Kind of error.
        gauge: Keys that its gauge states for all its setups.

    Raises:
        OrthocalError: Of that kind, naming the key that does not fit.
    """
    name = data.get("sensor", DEFAULT)
    schema, build = _find_kind(name, where=f"{where}: {under}.sensor", error=error)
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
