"""The one finite-difference checker of the tests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from tolerances import DERIVATIVE


def central_differences(
    function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, *, step: float = 1e-6
) -> np.ndarray:
    """Derivative of a function of a vector, shape (*output, n)."""
    columns = []
    for i in range(at.size):
        e = np.zeros_like(at)
        e[i] = step
        columns.append((np.asarray(function(at + e)) - np.asarray(function(at - e))) / (2 * step))
    return np.stack(columns, axis=-1)


def assert_derivative(
    exact: np.ndarray,
    function: Callable[[np.ndarray], np.ndarray],
    at: np.ndarray,
    *,
    step: float = 1e-6,
    tolerance: float = DERIVATIVE,
) -> None:
    """Compare an exact derivative with central differences, relative to the largest entry."""
    numeric = central_differences(function, at, step=step)
    assert np.all(np.isfinite(exact))
    scale = max(1.0, float(np.abs(numeric).max(initial=0.0)))
    assert np.abs(exact - numeric).max(initial=0.0) / scale < tolerance
