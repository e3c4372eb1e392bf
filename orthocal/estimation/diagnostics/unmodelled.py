"""Effect of unmodelled errors of the machine on an estimate.

Offsets that are fitted to a machine with errors of legs and axes absorb some of these errors. To
first order, unmodelled errors θᵤ bias the estimate by B θᵤ,

    B = A⁻¹ Jᵀ Jᵤ/σ²,  A = Jᵀ J/σ² + P⁻¹

with the Jacobians J and Jᵤ of the readings with respect to the estimated parameters and θᵤ, and the
prior covariance P of the former. The priors of θᵤ therefore add a covariance to the uncertainty of
the estimate. Readings are scaled to the noise of the first gauge (`CalibrationProblem`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array, Mask
from orthocal.estimation.fit import Fit
from orthocal.io.documents import Number
from orthocal.io.fields import FileRecord, Many, Matrix, Sizes, read_only
from orthocal.kinematics.function_cache import cached_per_robot
from orthocal.robot.model import Robot
from orthocal.statistics.zeros import project_out_zeros

FULL_MODEL = "full"
"""Model of all errors that are not redundant; every loaded robot has it."""


@dataclass(frozen=True, slots=True, eq=False)
class UnmodelledEffect(FileRecord):
    """Unmodelled errors and their effect on an estimate."""

    names: Many[str]
    """Names of the unmodelled errors."""
    prior_stds: Sizes
    """Prior standard deviation of each error with the tolerance scale, shape (n_unmodelled,),
    [SI]."""
    leakage: Matrix
    """Matrix B of docs/mathematics.md: bias of the machine's free parameters per unit of each
    unmodelled error, shape (n_machine, n_unmodelled), [SI per SI]."""
    residual_rms: Number
    """Expected RMS of the rows' residuals due to unmodelled errors with their priors,
    [noise-scaled m]."""
    residual_dof: Number
    """Effective degrees of freedom of these residuals (Satterthwaite, 1946)."""

    @property
    def bias_covariance(self) -> Array:
        """Covariance of the machine's parameters due to unmodelled errors, [SI].

        Shape (n_machine, n_machine).
        """
        biases = self.leakage * self.prior_stds
        return np.asarray(biases @ biases.T)


@dataclass(frozen=True, slots=True, eq=False)
class UnmodelledErrors:
    """Errors of the machine that a fit does not model, and their Jacobian."""

    names: tuple[str, ...]
    """Names of the errors."""
    prior_stds: Array
    """Prior standard deviation of each error with the tolerance scale, shape (n_unmodelled,),
    [SI]."""
    scaled: Mask
    """Mask of the errors whose tolerances the scale multiplies, shape (n_unmodelled,)."""
    jacobian: Array
    """∂h/∂θ̂ᵤ: change of the readings by one prior standard deviation of each error, zeros
    eliminated, shape (n_entries, n_unmodelled), [noise-scaled m]."""


@cached_per_robot
def machine_errors(robot: Robot) -> tuple[str, ...]:
    """Names of all errors of a machine, in the robot's order.

    These are the errors of the model `full`, all scale errors of drives and all errors of closure
    frames.
    """
    parameters = robot.parameters
    names = set(parameters.select_model(FULL_MODEL))
    names |= {
        e.name
        for e in (parameters.elementary[n] for n in parameters.complete)
        if e.kind == "scale" or e.of_frame
    }
    return tuple(name for name in parameters.names if name in names)


def find_unmodelled_errors(fit: Fit, *, represented: Collection[str] = ()) -> UnmodelledErrors:
    """Errors of the machine that a fit does not model.

    Args:
        fit: The fit.
        represented: Names of parameters that free base parameters represent. They count as
            modelled.
    """
    problem = fit.problem
    parameters = problem.robot.parameters
    # a free sum counts only its first term as modelled
    free = problem.machine_selection.names
    modelled = {parameters[n].terms[0][0] for n in (*free, *problem.fixed, *represented)}
    names = parameters.without_terms(machine_errors(problem.robot), modelled)
    o = problem.observations
    if not names:
        none = np.zeros(0, dtype=np.bool_)
        return UnmodelledErrors((), read_only([]), none, read_only(np.zeros((o.size, 0))))
    factors = problem.machine_selection.tolerance_scale.factors(parameters, names)
    return UnmodelledErrors(
        names,
        read_only(factors * [parameters[n].prior_std for n in names]),
        np.array([parameters.are_scaled(n) for n in names], dtype=np.bool_),
        read_only(error_jacobian(fit, names) * factors),
    )


def error_jacobian(fit: Fit, names: Sequence[str]) -> Array:
    """Jacobian of the readings with respect to errors that are not free, at the solution of a fit.

    Args:
        fit: The fit.
        names: Names of the errors.

    Returns:
        ∂h/∂θ̂ᵤ per stated prior standard deviation of each error, zeros eliminated, shape
        (n_entries, n_names), [noise-scaled m].
    """
    problem, parameters = fit.problem, fit.problem.robot.parameters
    prior_stds = np.array([parameters[n].prior_std for n in names])
    columns = problem.functions.errors.unit_errors(names) * prior_stds
    nuisance_scale = problem.theta_scale[problem.n_machine :]
    linear = problem.linearise(
        fit.solution.theta,
        fit.solution.passive,
        free=problem.model.parametrise(columns, nuisance_scale),
    )
    return project_out_zeros(linear.jacobian[:, : len(names)], problem.observations)


def propagate_unmodelled(fit: Fit, errors: UnmodelledErrors) -> tuple[UnmodelledEffect, Array]:
    """Effect of unmodelled errors on an estimate.

    Returns:
        Effect on the machine's parameters, and bias of the nuisance parameters by one prior
        standard deviation of each error, shape (n_nuisance, n_unmodelled), [SI].
    """
    problem = fit.problem
    n = problem.n_machine
    if not errors.names:
        no_effect = UnmodelledEffect((), read_only([]), read_only(np.zeros((n, 0))), 0.0, 0.0)
        return no_effect, np.zeros((problem.n_free - n, 0))
    o, sigma = problem.observations, fit.sigma
    jacobian = project_out_zeros(fit.jacobian, o)
    covariance = fit.information.posterior(
        sigma=sigma, precision=problem.prior_precision, at_bound=fit.at_bound
    ).covariance
    scaled_bias = covariance @ (jacobian.T @ errors.jacobian) / sigma**2
    residual = o.rows(errors.jacobian - jacobian @ scaled_bias)
    bias = scaled_bias * problem.theta_scale[:, None]  # per prior standard deviation of each error
    effect = UnmodelledEffect(
        names=errors.names,
        prior_stds=errors.prior_stds,
        leakage=read_only((bias / errors.prior_stds)[:n]),
        residual_rms=float(np.sqrt((residual**2).sum() / len(residual))),
        residual_dof=_effective_dof(residual),
    )
    return effect, np.asarray(bias[n:])


def _effective_dof(matrix: Array) -> float:
    """Effective degrees of freedom of |S t|² for a standard normal t: (tr SᵀS)²/tr (SᵀS)²."""
    square = matrix.T @ matrix
    total = float(np.trace(square)) ** 2
    return total / float((square**2).sum()) if total > 0.0 else 0.0
