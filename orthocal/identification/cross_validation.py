"""Does the model predict what it has not seen? Each setup from all the others.

Leaving a setup s out of a solution, to first order about it, changes the estimate by

    δ = −A₋ₛ⁻¹ Fₛᵀ rₛ/σ²,  A₋ₛ = FᵀF/σ² + P − FₛᵀFₛ/σ²

with F the Jacobian and r the residuals, zeros eliminated: at the solution the others' pull is
what the setup's own was. The setup is then missed by rₛ − Fₛ δ.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import NotIdentifiableError
from orthocal.identification.fit import Fit, require_determined
from orthocal.identification.records import ResidualRow, root_mean_square, rows_by_setup
from orthocal.identification.uncertainty import decompose, project_out_zeros

Array = NDArray[np.float64]

CLEARLY = 5.0
"""Times by which readings must agree better with all others for a turned sign to be believed. Of 60
simulated machines each, with cycles of 10 to 20 µm, none without a turned setup is accused up to
errors of three times their tolerances, and 49 to 59 with one are found out."""


@dataclass(frozen=True, slots=True, eq=False)
class TurnedSetup:
    """A setup whose readings agree with all others once their sign is turned."""

    name: str
    as_read: float
    """Root mean square of what they differ by from what all others say, [m]."""
    turned: float
    """The same with the sign turned, [m]."""


def predict_unseen(fit: Fit) -> Array:
    """Errors of predicting the rows of every setup from all other setups.

    Returns:
        Measured less predicted, each with its best gauge zeros, shape (n_rows,), [m]; NaN where
        the other setups do not determine the parameters.
    """
    problem, o = fit.problem, fit.problem.observations
    errors = np.full(o.plus.size, np.nan)
    setups = np.unique(o.setup)
    if setups.size < 2:
        return errors
    root = np.sqrt(fit.weights)[:, None]
    factor = root * project_out_zeros(fit.jacobian, o, weights=fit.weights)
    pull = root[:, 0] * fit.residual / fit.sigma**2
    free = ~fit.held
    precision = np.diag(problem.prior_precision)[np.ix_(free, free)]
    for setup in setups:
        out = o.setup == setup
        if not problem.prior_precision.all():
            # at the reference: at the solution what is not seen looks faintly seen
            left = np.where(out[:, None], 0.0, fit.linearisation.slopes)
            try:
                require_determined(problem, decompose(left, o))
            except NotIdentifiableError:
                continue  # stays unknown
        others = factor[~out][:, free] / fit.sigma
        change = np.zeros(problem.n_free)
        change[free] = -np.linalg.solve(
            others.T @ others + precision, factor[out][:, free].T @ pull[out]
        )
        missed = project_out_zeros(fit.residual - fit.jacobian @ change, o)
        rows = out[o.plus]
        errors[rows] = o.rows(missed)[rows]
    return errors


def find_turned_setup(rows: Iterable[ResidualRow]) -> TurnedSetup | None:
    """The setup that all others would agree with, were its sign the other one.

    With y the readings and u what others miss them by, both without their gauge zero, others
    predict y − u; readings of the other sign would be missed by −2 y + u. Two independent readings
    are the least that can tell.
    """
    found = None
    for name, group in rows_by_setup(rows).items():
        raw = np.array([r.minus is None for r in group])
        independent = len({(r.posture, r.minus) for r in group}) - int(raw.any())
        measured = np.array([r.measured for r in group])
        missed = np.array([r.unseen for r in group])
        if independent < 2 or not np.isfinite(missed).all():
            continue
        if raw.any():
            measured[raw] -= measured[raw].mean()
        as_read, turned = (root_mean_square(v) for v in (missed, missed - 2.0 * measured))
        if as_read > CLEARLY * turned and (found is None or as_read > found.as_read):
            found = TurnedSetup(name, as_read, turned)
    return found
