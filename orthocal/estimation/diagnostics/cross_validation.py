"""Does the model predict what it has not seen? Each setup from all the others.

Leaving a setup s out of a solution, to first order about it, changes the estimate by

    δ = −A₋ₛ⁻¹ Fₛᵀ rₛ/σ²,  A₋ₛ = FᵀF/σ² + P − FₛᵀFₛ/σ²

with F the Jacobian and r the residuals, zeros eliminated: at the solution the others' pull is
what the setup's own was. The setup is then missed by rₛ − Fₛ δ.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import NotIdentifiableError
from orthocal.estimation.fit import Fit, require_determined
from orthocal.statistics.information import decompose
from orthocal.statistics.zeros import project_out_zeros

Array = NDArray[np.float64]


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
