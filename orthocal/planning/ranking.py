"""Order of gains and errors that does not depend on rounding.

Mirrored readings, such as approaches from either side, have equal gains. Without these functions
plans would differ between processors, because rounding does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import numpy as np

from orthocal.arrays import Array, Indices

Item = TypeVar("Item")

EQUALITY_TOLERANCE = 1e-7
"""Relative difference of values that count as equal, far above rounding errors."""


def first_largest(values: Array) -> int:
    """Index of the first value that equals the largest one.

    Args:
        values: Values, shape (n,), n > 0.
    """
    return int(first_largest_of_rows(values[None])[0])


def first_largest_of_rows(values: Array) -> Indices:
    """Index in each row of the first value that equals the largest one of the row, shape (k,).

    Args:
        values: Values, shape (k, n), n > 0.
    """
    largest = values.max(axis=1, keepdims=True)
    equal = values >= largest - EQUALITY_TOLERANCE * np.abs(largest)
    return np.asarray(equal.argmax(axis=1))


def is_less(value: float, other: float) -> bool:
    """True if a value is less than another one by more than EQUALITY_TOLERANCE."""
    return value < other - EQUALITY_TOLERANCE * abs(other)


def best_of(items: Iterable[Item], value: Callable[[Item], float]) -> Item:
    """First of the items with the largest value.

    Args:
        items: The items, at least one.
        value: Function for the value of an item.
    """
    listed = list(items)
    return listed[first_largest(np.array([value(item) for item in listed]))]


def sort_by(items: Sequence[Item], value: Callable[[Item], float]) -> list[Item]:
    """Items by decreasing value; items with equal values keep their order.

    Args:
        items: The items.
        value: Function for the value of an item.
    """
    values = np.array([value(item) for item in items])
    order = np.argsort(-values, kind="stable")
    falls = -np.diff(values[order]) > EQUALITY_TOLERANCE * np.abs(values[order[:-1]])
    rank = np.concatenate([[0], np.cumsum(falls)])[: order.size]
    return [items[i] for i in order[np.lexsort((order, rank))]]
