"""A machine that changed between sessions, fitted: its errors, its sensors and the changes.

    min over β, δ   Σ ((y − h(β + D δ) − z)/σ)² + Σ P (β − mean)²

by Gauss and Newton's method, with h the closed-loop model of each session's own machine.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ClosureError
from orthocal.estimation.fit import Fit
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.selection import Selection
from orthocal.hypotheses.sessions.candidates import Columns, Step
from orthocal.hypotheses.sessions.contrasts import Common
from orthocal.io.fields import read_only
from orthocal.statistics.zeros import project_out_zeros

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MOST_ITERATIONS = 12

FAINT = 1e-14
"""Part of the largest singular value below which one is nothing."""

SETTLED = 1e-3
"""Standard deviations of a change by which the last iteration may move it."""


def fit_changed_machine(
    fit: Fit,
    columns: Columns,
    common: Common,
    steps: Sequence[Step],
    *,
    session: Indices,
    sigma: Array,
) -> list[tuple[float, float]]:
    """Changes and their standard deviations, [unit], fitted together with all else.

    Args:
        fit: The fit of the sessions together, without any change.
        columns: All that is not known.
        common: What was taken for in common, with its precisions.
        steps: Changes of unknown size.
        session: Of each entry, shape (n_entries,).
        sigma: Of each entry's reading, shape (n_entries,), [m].

    Returns:
        A size and a standard deviation for each step. Where the iteration leads to no machine, to
        first order.
    """
    problem = _whole_problem(fit, columns)
    o, n = problem.observations, columns.flat.size
    own = {name: value for name, value in zip(fit.problem.free, fit.solution.theta, strict=True)}
    start = {**fit.problem.fixed, **own}
    scale = problem.theta_scale
    beta = np.array([start.get(name, 0.0) for name in problem.free]) / scale
    mean = np.zeros(n)
    means = dict(zip(fit.problem.free, fit.problem.prior_mean, strict=True))
    mean[:] = [means.get(name, 0.0) for name in problem.free] / scale
    precision = common.contrasts.precision[:n]
    used = np.flatnonzero(np.isfinite(precision))
    directions = columns.makes[:, [s.suspect for s in steps]]
    after = np.array([[k >= s.session for s in steps] for k in range(int(session.max()) + 1)])
    units = np.linalg.norm(directions, axis=0)
    size, deviation = np.zeros(len(steps)), np.full(len(steps), np.inf)
    whiten = np.sqrt(fit.weights) / sigma
    for _ in range(MOST_ITERATIONS):
        try:
            prediction, slopes = _linearise(
                problem, beta, directions @ (size * after).T, session, fit.solution.passive
            )
        except ClosureError:
            break
        changing = np.where(after[session], 1.0, 0.0) * (slopes @ directions) / units
        rows = np.column_stack([slopes[:, used], changing])
        rows = project_out_zeros(rows, o, weights=fit.weights) * whiten[:, None]
        left = project_out_zeros(problem.values - prediction, o, weights=fit.weights) * whiten
        # what is known beforehand as rows of its own: squares of both would lose what is faint
        root = np.sqrt(precision[used])
        known = np.column_stack([np.diag(root), np.zeros((used.size, len(steps)))])
        inverse = np.linalg.pinv(np.vstack([rows, known]), rcond=FAINT)
        step = inverse @ np.append(left, root * (mean - beta)[used])
        beta[used] += step[: used.size]
        size = size + step[used.size :] / units
        deviation = np.linalg.norm(inverse[used.size :], axis=1) / units
        if (np.abs(step[used.size :]) / units < SETTLED * deviation).all():
            break
    return list(zip(size.tolist(), deviation.tolist(), strict=True))


def _linearise(
    problem: CalibrationProblem,
    beta: Array,
    changed: Array,
    session: Indices,
    passive: Array,
) -> tuple[Array, Array]:
    """Readings of each session's own machine, and their slopes there.

    Args:
        problem: All errors of the machine.
        beta: What is common to all sessions, shape (n,), [tolerances].
        changed: What has changed by each session, shape (n, n_sessions), [tolerances].
        session: Of each entry, shape (n_entries,).
        passive: Passive coordinates near by, shape (n_postures, n_passive).
    """
    prediction = np.zeros(session.size)
    slopes = np.zeros((session.size, beta.size))
    machines, which = np.unique(changed, axis=1, return_inverse=True)
    for i in range(machines.shape[1]):
        of = which.ravel()[session] == i
        theta = (beta + machines[:, i]) * problem.theta_scale
        h, jacobian = problem.linearise(theta, problem.close(theta, start=passive))
        prediction[of], slopes[of] = h[of], jacobian[of]
    return prediction, slopes


def _whole_problem(fit: Fit, columns: Columns) -> CalibrationProblem:
    """The same readings, in metres of their own, with all errors of the machine free."""
    problem, parameters = fit.problem, fit.problem.robot.parameters
    own = {p.name: p for p in problem.machine_selection.parameters}
    n = len(columns.names)
    selection = Selection(
        label="",
        parameters=tuple(own.get(name, parameters[name]) for name in columns.names),
        prior=np.ones(n, dtype=bool),
        mean=read_only(np.zeros(n)),
        lower=read_only(np.full(n, -np.inf)),
        upper=read_only(np.full(n, np.inf)),
        fixed={k: v for k, v in problem.fixed.items() if k not in columns.names},
    )
    return CalibrationProblem(problem.session, selection)
