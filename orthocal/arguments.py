"""Checks of the arguments of public functions, with messages that name the argument."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from numbers import Real

import numpy as np
from numpy.typing import NDArray


def require_kind(value: object, kinds: type | tuple[type, ...], *, expected: str) -> None:
    """Check the type of an argument.

    Args:
        value: The argument.
        kinds: Allowed types.
        expected: Description of the allowed types and of the function that returns one.

    Raises:
        TypeError: If the type is not allowed.
    """
    if not isinstance(value, kinds):
        raise TypeError(f"found a {type(value).__name__}; expected {expected}")


def require_names(values: object, *, argument: str) -> tuple[str, ...]:
    """Texts of an argument, which may be an iterator.

    Raises:
        TypeError: Naming the argument, if it is not a list of texts.
    """
    if isinstance(values, Iterable) and not isinstance(values, str):
        names = tuple(values)
        if all(isinstance(name, str) for name in names):
            return names
    raise TypeError(f"{argument}: found {values!r}; expected a list of names or globs")


def require_numbers(values: object, *, argument: str, counts: tuple[int, ...] = (1,)) -> None:
    """Check that an argument maps names to numbers.

    Args:
        values: The argument.
        argument: Its name.
        counts: Allowed numbers of values per name: 1 for a number, n for a tuple of n numbers.

    Raises:
        TypeError: Naming the argument and the invalid entry.
    """
    if not isinstance(values, Mapping):
        kind = type(values).__name__
        raise TypeError(f"{argument}: found a {kind}; expected a mapping of names to numbers")
    for name, value in values.items():
        several = isinstance(value, tuple | list)
        numbers = value if several else (value,)
        fits = len(numbers) in counts and (len(numbers) > 1 or not several)
        if not (isinstance(name, str) and fits and all(isinstance(v, Real) for v in numbers)):
            kinds = " or ".join("a number" if n == 1 else f"{n} numbers" for n in counts)
            raise TypeError(f"{argument}: found {name!r}: {value!r}; expected a name and {kinds}")


def require_array(
    values: object, *, shape: tuple[int, ...], argument: str, missing: bool = False
) -> NDArray[np.float64]:
    """A new array of finite real numbers of a given shape.

    Args:
        values: The argument.
        shape: Its shape.
        argument: Its name.
        missing: Whether NaN is allowed.

    Raises:
        TypeError: If the values are not real numbers.
        ValueError: If the shape differs, or a number is not finite.
    """
    try:
        if np.asarray(values).dtype.kind not in "iuf":
            raise TypeError
        result = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        kind = type(values).__name__
        raise TypeError(f"{argument}: found a {kind}; expected real numbers") from None
    if result.shape != shape:
        raise ValueError(f"{argument}: found the shape {result.shape}; expected {shape}")
    wrong = np.isinf(result) if missing else ~np.isfinite(result)
    if wrong.any():
        raise ValueError(f"{argument}: found {result[wrong][0]}; expected finite numbers")
    return result


def require_seed(seed: object) -> None:
    """Check that an argument is a seed.

    Raises:
        ValueError: If it is not a whole number of at least 0.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"seed: found {seed!r}; expected a whole number of at least 0")
