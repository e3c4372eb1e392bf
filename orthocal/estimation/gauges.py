"""How gauges stood, as far as it is in what is not known of a machine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthocal.estimation.problem import CalibrationProblem
from orthocal.statistics.information import Information, take_for_known

Array = NDArray[np.float64]


def find_gauge_covariance(
    problem: CalibrationProblem,
    information: Information,
    *,
    sigma: float,
    held: NDArray[np.bool_] | None = None,
) -> Array:
    """What of the covariance of the machine's parameters is from how its gauges stood.

    Other setups have it anew. It is what would be gone were all known to stand as found, shape
    (n_machine, n_machine), [SI].

    Args:
        problem: The problem.
        information: Of all its parameters.
        sigma: Standard deviation of a reading, [m].
        held: Parameters that a bound holds, shape (n_free,).
    """
    n, precision = problem.n_machine, problem.prior_precision
    held = np.zeros(problem.n_free, dtype=np.bool_) if held is None else held
    whole = information.covariance(sigma=sigma, precision=precision, held=held)
    known = take_for_known(information, n).covariance(
        sigma=sigma, precision=precision[:n], held=held[:n]
    )
    scale = problem.theta_scale[:n]
    return np.asarray((whole[:n, :n] - known) * np.outer(scale, scale))
