"""Setups that were read with the wrong sign: the gauge turned round, or a minus forgotten.

Under either hypothesis, as read or with the sign of one setup turned, the readings are normal,

    y = h(θ̂) + J (θ − θ̂) + U u + z + n,  θ flat,  u ~ e · tolerances,  n ~ σ

with θ the offsets and what else has no prior, u all other errors of the machine (those that were
fitted with a prior, and those that were left out), z the gauge zeros. How many times their
tolerances those errors are, e, is known to a factor only, and integrated over. A setup is said to
be turned where that makes the readings more likely by the factor `CLEARLY`: what is turned lies
beyond noise and beyond what errors of the machine explain. Readings that show next to nothing, as
those of a machine whose offsets were entered, are about as likely either way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ClosureError, SolverError
from orthocal.estimation.diagnostics.residual_rows import ResidualRow, root_mean_square
from orthocal.estimation.diagnostics.unmodelled import OtherErrors
from orthocal.estimation.fit import Fit, first_sigma
from orthocal.estimation.problem import CalibrationProblem
from orthocal.io.documents import Number
from orthocal.io.fields import CLOSED, NumberOrNaN
from orthocal.statistics.information import RANK_THRESHOLD
from orthocal.statistics.noise import estimate_repeatability
from orthocal.statistics.zeros import project_out_zeros

Array = NDArray[np.float64]

CLEARLY = 8.0
"""Logarithm of the factor by which a turned sign must make the readings more likely. For machines
as the hypothesis has them it is exceeded by chance once in e⁸ = 3,000 sessions at most, for each
setup that could be turned (Markov's inequality for a likelihood ratio)."""

EXCESSES = np.geomspace(0.02, 20.0, 41)
"""Times the tolerances that errors of the machine are tried at."""

EXCESS_SPREAD = 0.5
"""Standard deviation of the logarithm of how many times its tolerances a machine's errors are."""

LEAST_READINGS = 2
"""Independent readings that a setup must have, a posture less: one is as right with either sign."""


@dataclass(frozen=True, slots=True, eq=False)
class TurnedSetup:
    """A setup whose readings agree with all others once their sign is turned."""

    __pydantic_config__ = CLOSED

    name: str
    as_read: NumberOrNaN
    """Root mean square of what they differ by from what all others say, [m]; NaN if not known."""
    turned: NumberOrNaN
    """The same with the sign turned, [m]."""
    evidence: Number
    """Logarithm of the factor by which the turned sign makes all readings more likely."""
    also: tuple[str, ...] = ()
    """Setups of which it is nearly as likely that they are the one."""


@dataclass(frozen=True, slots=True, eq=False)
class _Spread:
    """Readings without what is flat: which directions errors of the machine move them in."""

    directions: Array
    """Orthonormal rows, shape (r, n)."""
    variances: Array
    """What errors at their tolerances do along each, shape (r,), [m²]."""
    flat: Array
    """Orthonormal rows of what is not known at all, shape (f, n)."""
    sigma: float
    """Of a reading, [m]."""

    def log_likelihood(self, deviation: Array) -> float:
        """Of readings, over all sizes of the machine's errors; up to a constant.

        Args:
            deviation: Readings less the model's, zeros eliminated, shape (n,), [m].
        """
        left = deviation - self.flat.T @ (self.flat @ deviation)
        along = self.directions @ left
        rest = max(float(left @ left - along @ along), 0.0)
        variance = self.sigma**2 + EXCESSES[:, None] ** 2 * self.variances
        squares = (along**2 / variance).sum(axis=1) + rest / self.sigma**2
        logs = np.log(variance / self.sigma**2).sum(axis=1)
        weights = -0.5 * (np.log(EXCESSES) / EXCESS_SPREAD) ** 2
        likelihoods = weights - 0.5 * (squares + logs)
        largest = float(likelihoods.max())
        return largest + float(np.log(np.exp(likelihoods - largest).sum()))


NEARLY = 3.0
"""Logarithm of the factor up to which another setup is nearly as likely to be the turned one."""


def find_turned_setup(
    fit: Fit, others: OtherErrors, rows: Sequence[ResidualRow]
) -> TurnedSetup | None:
    """The setup whose readings are far more likely with the sign turned, if there is one.

    Args:
        fit: The fit of the readings as they are.
        others: Errors of the machine that it left out.
        rows: Its rows, each with what all other setups say of it.
    """
    name, evidence, also = weigh_signs(fit, others)
    if not evidence > CLEARLY:
        return None
    own = [r for r in rows if r.setup == name]
    missed, measured = (np.array([getattr(r, k) for r in own]) for k in ("unseen", "measured"))
    raw = np.array([r.minus is None for r in own])
    if raw.any():
        measured[raw] -= measured[raw].mean()
    return TurnedSetup(
        name,
        as_read=root_mean_square(missed),
        turned=root_mean_square(missed - 2.0 * measured),
        evidence=evidence,
        also=also,
    )


def weigh_signs(fit: Fit, others: OtherErrors) -> tuple[str, float, tuple[str, ...]]:
    """The setup that is turned most likely, and how much more likely its turned sign is.

    Args:
        fit: The fit of the readings as they are.
        others: Errors of the machine that it left out.

    Returns:
        Its name, and the logarithm of the factor; "" and -inf where none is worth a look. And the
        names of others that are nearly as likely to be the one.
    """
    problem, o = fit.problem, fit.problem.observations
    sigma = first_sigma(problem.session, estimate_repeatability(problem.values, o))
    spread = _spread(problem, fit.jacobian, others, sigma)
    deviation = _deviation(problem, fit.residual, fit.solution.theta, fit.jacobian)
    as_read = spread.log_likelihood(deviation)
    centred = project_out_zeros(problem.values, o)
    gains: dict[str, float] = {}
    signs: dict[str, Array] = {}
    for i, name in enumerate(problem.session.setups):
        entries = o.setup == i
        if np.unique(o.posture[entries]).size > LEAST_READINGS:
            turned = deviation - np.where(entries, 2.0 * centred, 0.0)
            gains[name] = spread.log_likelihood(turned) - as_read
            signs[name] = np.where(entries, -1.0, 1.0)
    best = max(gains, key=lambda n: gains[n], default="")
    if not best or gains[best] <= 0.0:
        return "", -np.inf, ()
    evidence = _likelihood_refitted(fit, others, signs[best] * problem.values, sigma) - as_read
    also = tuple(n for n in gains if n != best and gains[n] > gains[best] - NEARLY)
    return best, evidence, also


def _likelihood_refitted(fit: Fit, others: OtherErrors, values: Array, sigma: float) -> float:
    """Log-likelihood of other readings, linearised about their own solution; -inf without one."""
    problem = fit.problem
    try:
        solution = fit.program.solve(sigma=fit.sigma, values=values, start=problem.reference)
        prediction, jacobian = problem.linearise(solution.theta, solution.passive)
    except (ClosureError, SolverError):
        return -np.inf
    residual = project_out_zeros(values - prediction, problem.observations)
    spread = _spread(problem, jacobian, others, sigma)
    return spread.log_likelihood(_deviation(problem, residual, solution.theta, jacobian))


def _is_flat(problem: CalibrationProblem) -> NDArray[np.bool_]:
    """Parameters of which nothing is known beforehand: without a prior, and all offsets."""
    elementary = problem.robot.parameters.elementary
    offset = [
        bool(p.terms) and elementary[p.terms[0][0]].kind == "offset" for p in problem.parameters
    ]
    return np.asarray((problem.prior_precision == 0.0) | np.array(offset, dtype=bool))


def _deviation(
    problem: CalibrationProblem, residual: Array, theta: Array, jacobian: Array
) -> Array:
    """Readings less those of a machine whose errors are what was known of them beforehand."""
    found = np.where(_is_flat(problem), 0.0, (theta - problem.prior_mean) / problem.theta_scale)
    return project_out_zeros(residual + jacobian @ found, problem.observations)


def _spread(
    problem: CalibrationProblem, jacobian: Array, others: OtherErrors, sigma: float
) -> _Spread:
    """What readings can be like, zeros and flat parameters taken out."""
    slopes, flat = project_out_zeros(jacobian, problem.observations), _is_flat(problem)
    basis, _ = _principal(slopes[:, flat], 0.0)
    known = np.column_stack([slopes[:, ~flat], others.slopes])
    directions, sizes = _principal(known - basis.T @ (basis @ known), sigma)
    return _Spread(directions, sizes**2, basis, sigma)


def _principal(columns: Array, least: float) -> tuple[Array, Array]:
    """Orthonormal rows that span columns, and the singular values of each.

    Args:
        columns: Shape (n, m).
        least: Size that counts as one, where all are smaller.
    """
    factor = np.linalg.qr(columns, mode="r") if len(columns) > columns.shape[1] else columns
    _, sizes, rows = np.linalg.svd(factor, full_matrices=False)
    kept = sizes > RANK_THRESHOLD * max(float(sizes.max(initial=0.0)), least)
    return np.asarray((columns @ (rows[kept].T / sizes[kept])).T), sizes[kept]
