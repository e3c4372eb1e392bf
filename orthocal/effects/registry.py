"""Effects that a robot's YAML may name: built in, registered, or from installed packages.

A package offers an effect by an entry point of the group `orthocal.effects`, with the name of the
effect and its class:

    [project.entry-points."orthocal.effects"]
    backlash = "my_package.backlash:Backlash"
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import get_args

from orthocal.arguments import require_kind
from orthocal.effects.protocol import Condition, Effect
from orthocal.errors import OrthocalError
from orthocal.runtime.registry import Registry

GROUP = "orthocal.effects"
"""Group of the entry points by which installed packages offer effects."""


def _require_effect(name: str, offered: type[Effect]) -> type[Effect]:
    """The offered class, which must be an effect with the name of its entry point.

    Raises:
        TypeError: If it is not, or if it needs a condition that does not exist.
    """
    if not issubclass(offered, Effect) or offered.name != name:
        raise TypeError(f"{offered.__qualname__} is not an Effect with name = '{name}'")
    if unknown := [c for c in offered.conditions if c not in get_args(Condition)]:
        expected = f"expected one of {', '.join(get_args(Condition))}"
        raise TypeError(f"{offered.__qualname__}.conditions: found {unknown[0]!r}; {expected}")
    return offered


BUILT_IN = {
    "backlash": "orthocal.effects.backlash:Backlash",
    "thermal": "orthocal.effects.thermal:Thermal",
    "screw": "orthocal.effects.screw:Screw",
    "drift": "orthocal.effects.drift:Drift",
    "compliance": "orthocal.effects.compliance:Compliance",
}
"""Built-in effects and their classes, which are imported on first use. A machine has its effects in
this order; on the drives they act in the reverse order."""

_EFFECTS = Registry[type[Effect]](GROUP, "effect", _require_effect, BUILT_IN)


def register_effect(effect: type[Effect]) -> None:
    """Register an effect; it replaces an effect of the same name.

    Raises:
        TypeError: If it is no class derived from Effect with a name, or needs an unknown condition.
    """
    require_kind(effect, type, expected="a class that is derived from Effect")
    _EFFECTS.register(getattr(effect, "name", ""), effect)


def unregister_effect(name: str) -> None:
    """Remove a registered effect; a built-in effect that it replaced returns."""
    _EFFECTS.unregister(name)


def effect_names() -> tuple[str, ...]:
    """Names of all effects that a robot's YAML may name."""
    return _EFFECTS.names


def order_effects(names: Iterable[str]) -> tuple[str, ...]:
    """Names of effects without repetition: built-in ones in their order, then the others."""
    order = {name: i for i, name in enumerate(BUILT_IN)}
    return tuple(sorted(dict.fromkeys(names), key=lambda name: order.get(name, len(order))))


def find_effect(name: str, *, where: str, error: type[OrthocalError]) -> type[Effect]:
    """Class of the effect of a name (see `Registry.find`).

    Raises:
        OrthocalError: Of kind `error`, if there is no such effect or its package cannot be loaded.
    """
    return _EFFECTS.find(name, where=where, error=error)
