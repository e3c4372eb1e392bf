"""Order of gains and errors in which rounding decides nothing.

Mirrored readings, such as those of the two sides of approach, have equal gains. Rounding differs
between processors: without these functions, so would plans.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import numpy as np

from orthocal.arrays import Array

Item = TypeVar("Item")

EQUAL = 1e-7
"""Relative difference up to which values are equal: far above rounding, far below what matters."""


def first_largest(values: Array) -> int:
    """Index of the first value that is the largest one, or equals it.

    Args:
        values: Shape (n,), n > 0.
    """
    largest = values.max()
    return int((values >= largest - EQUAL * abs(largest)).argmax())


def is_less(value: float, other: float) -> bool:
    """True if a value is less than another one, and does not equal it."""
    return value < other - EQUAL * abs(other)


def best_of(items: Iterable[Item], value: Callable[[Item], float]) -> Item:
    """First of the items with the largest value.

    Args:
        items: At least one.
        value: Value of an item.
    """
    listed = list(items)
    return listed[first_largest(np.array([value(item) for item in listed]))]


def sort_by(items: Sequence[Item], value: Callable[[Item], float]) -> list[Item]:
    """Items by decreasing value; those of equal values in their order.

    Args:
        items: The items.
        value: Value of an item.
    """
    values = np.array([value(item) for item in items])
    order = np.argsort(-values, kind="stable")
    falls = -np.diff(values[order]) > EQUAL * np.abs(values[order[:-1]])
    rank = np.concatenate([[0], np.cumsum(falls)])[: order.size]
    return [items[i] for i in order[np.lexsort((order, rank))]]
