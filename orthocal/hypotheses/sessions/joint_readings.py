"""The sessions of a fit side by side: which entry is of which, and what they have in common."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from orthocal.estimation.fit import Fit
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.weighting import split_by_gauge, stated_sigma
from orthocal.hypotheses.sessions.candidates import Columns
from orthocal.hypotheses.sessions.contrasts import NEXT_TO_NOTHING, Contrasts, build_contrasts
from orthocal.statistics.noise import estimate_repeatability, noise_floor
from orthocal.statistics.zeros import project_out_zeros

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LEAST_SIGMA = 0.3e-6
"""Standard deviation of a reading below which what bends in a machine counts as much, [m]."""


def label_sessions(problem: CalibrationProblem) -> tuple[tuple[str, ...], Indices]:
    """Names of the sessions that were joined, and that of each entry by its place among them.

    Returns:
        Names, of those that were read; a single "" where none were joined. And shape (n_entries,).
    """
    o = problem.observations
    if not problem.session.joined:
        return ("",), np.zeros(o.size, dtype=np.int64)
    of_setup = np.array([name.partition("/")[0] for name in problem.session.setups])
    of_entry = of_setup[o.setup]
    read = set(of_entry.tolist())
    labels = tuple(n for n in dict.fromkeys(of_setup.tolist()) if n in read)
    place = {name: i for i, name in enumerate(labels)}
    return labels, np.array([place[name] for name in of_entry.tolist()], dtype=np.int64)


def standard_deviations(fit: Fit) -> tuple[Array, float]:
    """Standard deviation of each entry's reading without any model: from cycles, or as stated.

    Returns:
        Shape (n_entries,), [m]; and degrees of freedom: infinite where they are stated, 0 where
        neither cycles nor a stated σ tell them, and they are what the fit has left.
    """
    problem, o = fit.problem, fit.problem.observations
    values, result = problem.values * problem.noise, fit.sigma * problem.noise
    dof, known = 0, True
    for g in split_by_gauge(problem.session, o):
        repeated = estimate_repeatability(values[g.entries], o.only(g.entries))
        if repeated[1] == 0 and g.gauge.sigma is None:
            known = False
            continue
        result[g.entries] = stated_sigma(g.gauge, repeated)
        if repeated[1] and repeated[0] > noise_floor(g.gauge.sigma, g.gauge.resolution):
            dof += repeated[1]
    degrees = (float(dof) if dof else math.inf) if known else 0.0
    return np.maximum(result, LEAST_SIGMA), degrees


def hold_together(fit: Fit, columns: Columns, session: Indices, sigma: Array) -> Contrasts:
    """Readings less those of a machine and sensors as they were known beforehand.

    Args:
        fit: The fit.
        columns: All that is not known.
        session: Of each entry, shape (n_entries,).
        sigma: Of each entry's reading, shape (n_entries,), [m].
    """
    problem, o = fit.problem, fit.problem.observations
    found = (fit.solution.theta - problem.prior_mean) / problem.theta_scale
    found[problem.prior_precision == 0.0] = 0.0
    weights = fit.weights
    whiten = np.sqrt(weights) * problem.noise / sigma
    left = project_out_zeros(fit.residual + fit.jacobian @ found, o, weights=weights)
    moved = project_out_zeros(columns.slopes, o, weights=weights)
    precision = np.where(columns.flat, NEXT_TO_NOTHING, 1.0)
    return build_contrasts(
        moved * whiten[:, None],
        left * whiten,
        session,
        zero=o.zero,
        precision=np.where(columns.held, np.inf, precision),
        flat=columns.flat,
    )
