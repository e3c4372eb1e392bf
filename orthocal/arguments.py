"""What is given to the Python interface, refused in words where it is of another kind."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from numbers import Real

import numpy as np
from numpy.typing import NDArray


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


def require_array(values: object, *, shape: tuple[int, ...], argument: str) -> NDArray[np.float64]:
    """Finite real numbers of a shape, as an array of their own.

    Raises:
        TypeError: If they are no real numbers.
        ValueError: If there are not so many, or one is not finite.
    """
    try:
        given = np.asarray(values)
        if given.dtype.kind not in "iuf":
            raise TypeError
        result = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        found = type(values).__name__
        raise TypeError(f"{argument}: found a {found}; expected real numbers") from None
    if result.shape != shape:
        raise ValueError(f"{argument}: found the shape {result.shape}; expected {shape}")
    if not np.isfinite(result).all():
        raise ValueError(
            f"{argument}: found {result[~np.isfinite(result)][0]}; expected finite numbers"
        )
    return result


def require_seed(seed: object) -> None:
    """Refuse what is no seed.

    Raises:
        ValueError: If it is no whole number of at least 0.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"seed: found {seed!r}; expected a whole number of at least 0")
