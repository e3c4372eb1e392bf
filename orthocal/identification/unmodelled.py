"""What a machine's other errors do to an estimate that leaves them out.

Offsets that are fitted to a machine whose legs and axes are off as well take on some of those
errors. To first order the estimate moves by L θᵤ for unmodelled errors θᵤ,

    L = A⁻¹ Jᵀ Jᵤ/σ²,  A = Jᵀ J/σ² + P

and with θᵤ within the tolerances this is known as a spread. It belongs into every honest ±.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ParameterError
from orthocal.identification.fit import SMALLEST_SIGMA, Fit
from orthocal.identification.problem import CalibrationProblem
from orthocal.identification.selection import select_parameters
from orthocal.identification.uncertainty import project_out_zeros
from orthocal.robot.model import read_only

Array = NDArray[np.float64]

WHOLE_MODEL = "full"
"""The model whose errors a machine is taken to have."""


@dataclass(frozen=True, slots=True, eq=False)
class Unmodelled:
    """Errors that an estimate leaves out, at their tolerances."""

    names: tuple[str, ...]
    tolerances: Array
    """One standard deviation of each, shape (n_unmodelled,), [SI]."""
    leakage: Array
    """L: what the free parameters take on, shape (n_free, n_unmodelled), [SI per SI]."""
    residual_rms: float
    """What they alone would leave of the readings' rows after the fit, r.m.s., [m]."""

    @property
    def bias_covariance(self) -> Array:
        """Covariance of what the free parameters take on, shape (n_free, n_free), [SI]."""
        spread = self.leakage * self.tolerances
        return np.asarray(spread @ spread.T)


def measure_unmodelled(fit: Fit) -> Unmodelled:
    """What the errors of the robot's whole model that were not free do to an estimate."""
    problem = fit.problem
    parameters = problem.robot.parameters
    taken = {term for name in (*problem.free, *problem.fixed) for term, _ in parameters[name].terms}
    try:
        whole = parameters.select_model(WHOLE_MODEL)
    except ParameterError:
        whole = ()
    names = [n for n in whole if not taken & {term for term, _ in parameters[n].terms}]
    if not names:
        return Unmodelled((), read_only([]), read_only(np.zeros((problem.n_free, 0))), 0.0)
    selection = select_parameters(
        parameters, free=names, known=problem.split_errors(fit.solution.theta)
    )
    others = CalibrationProblem(problem.session, selection)
    _, jacobian = others.linearise(np.zeros(len(names)), fit.solution.passive)
    o, sigma = problem.observations, max(fit.sigma, SMALLEST_SIGMA)
    slopes, other_slopes = (project_out_zeros(j, o) for j in (fit.jacobian, jacobian))
    inverse = fit.information.covariance(
        sigma=sigma, precision=problem.prior_precision, held=fit.held
    )
    scaled = inverse @ (slopes.T @ other_slopes) / sigma**2
    left = o.rows(other_slopes - slopes @ scaled)
    tolerances = selection.tolerances
    return Unmodelled(
        names=tuple(names),
        tolerances=read_only(tolerances),
        leakage=read_only(scaled * problem.theta_scale[:, None] / tolerances),
        residual_rms=float(np.sqrt((left**2).sum() / len(left))),
    )
