"""What is given to the Python interface, refused in words where it is of another kind."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from numbers import Real


def require_kind(value: object, kinds: type | tuple[type, ...], *, expected: str) -> None:
    """Refuse a value of another kind.

    Args:
        value: What was given.
        kinds: What it may be.
        expected: That in words, and where one comes from.

    Raises:
        TypeError: If it is none of them.
    """
    if not isinstance(value, kinds):
        raise TypeError(f"found a {type(value).__name__}; expected {expected}")


def require_names(values: object, *, argument: str) -> None:
    """Refuse what is no list of texts.

    Raises:
        TypeError: Naming the argument.
    """
    names = not isinstance(values, str) and isinstance(values, Iterable)
    if not (names and all(isinstance(v, str) for v in values)):  # type: ignore[attr-defined] # it is
        raise TypeError(f"{argument}: found {values!r}; expected a list of names or globs")


def require_numbers(values: object, *, argument: str, counts: tuple[int, ...] = (1,)) -> None:
    """Refuse what is no mapping of names to numbers.

    Args:
        values: What was given.
        argument: As what.
        counts: How many numbers a name may have: 1 for a number, else a tuple of so many.

    Raises:
        TypeError: Naming the argument, and the name whose value does not fit.
    """
    if not isinstance(values, Mapping):
        found = type(values).__name__
        raise TypeError(f"{argument}: found a {found}; expected a mapping of names to numbers")
    for name, value in values.items():
        given = value if isinstance(value, tuple | list) else (value,)
        fits = len(given) in counts and (len(given) > 1 or not isinstance(value, tuple | list))
        if not (isinstance(name, str) and fits and all(isinstance(v, Real) for v in given)):
            kinds = " or ".join("a number" if n == 1 else f"{n} numbers" for n in counts)
            raise TypeError(f"{argument}: found {name!r}: {value!r}; expected a name and {kinds}")
