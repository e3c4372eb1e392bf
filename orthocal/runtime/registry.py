"""Registry of implementations by name: built-in, registered, or from installed packages."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from orthocal.errors import OrthocalError

Kind = TypeVar("Kind")


class Registry(Generic[Kind]):
    """Kinds by name; those that are not registered are loaded on first use.

    Args:
        group: Group of the entry points of packages; an entry point has the name of its kind.
        noun: Noun for a kind in messages, such as sensor.
        read: Function from a name and the object of an entry point to a kind. It may raise any
            error for an invalid object.
        built_in: Kinds of orthocal, as `module:Class` by name.
    """

    def __init__(
        self,
        group: str,
        noun: str,
        read: Callable[[str, Any], Kind],
        built_in: Mapping[str, str],
    ) -> None:
        self._group, self._noun, self._read = group, noun, read
        self._registered: dict[str, Kind] = {}
        self._built_in = {name: EntryPoint(name, place, group) for name, place in built_in.items()}

    def register(self, name: str, kind: Kind) -> None:
        """Add a kind; it replaces a kind of the same name.

        Raises:
            TypeError: If the object is invalid.
        """
        self._registered[name] = self._read(name, kind)

    def unregister(self, name: str) -> None:
        """Remove a registered kind if it exists; a built-in kind that it replaced returns."""
        self._registered.pop(name, None)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all kinds, including those of installed packages."""
        installed = (e.name for e in self._entry_points)
        return tuple(dict.fromkeys([*self._built_in, *self._registered, *installed]))

    @property
    def _entry_points(self) -> tuple[EntryPoint, ...]:
        return _list_entry_points(self._group, tuple(sys.path))

    def find(self, name: object, *, where: str, error: type[OrthocalError]) -> Kind:
        """Find the kind of a name.

        Args:
            name: The name, from a document.
            where: File and key, for messages.
            error: Kind of error to raise.

        Raises:
            OrthocalError: If the kind is unknown, or its package cannot be loaded.
        """
        if isinstance(name, str) and name in self._registered:
            return self._registered[name]
        if isinstance(name, str) and name in self._built_in:
            self._registered[name] = self._built_in[name].load()
            return self._registered[name]
        point = next((e for e in self._entry_points if e.name == name), None)
        if point is None:
            expected = f"expected one of {', '.join(self.names)}" if self.names else "there is none"
            raise error(f"found {name!r}; {expected}", where=where)
        package = "" if point.dist is None else f" of package {point.dist.name}"
        try:
            return self._read(point.name, point.load())
        except Exception as e:  # foreign code may raise anything
            raise error(
                f"the {self._noun} '{name}'{package} cannot be loaded: {type(e).__name__}: {e}",
                where=where,
            ) from None


@lru_cache(maxsize=8)
def _list_entry_points(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Entry points of a group in a search path of modules, which is part of the cache key."""
    return tuple(entry_points(group=group))
