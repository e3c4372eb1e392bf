"""What a machine's other errors do to an estimate that leaves them out.

Offsets that are fitted to a machine whose legs and axes are off as well take on some of those
errors. To first order the estimate moves by L θᵤ for unmodelled errors θᵤ,

    L = A⁻¹ Jᵀ Jᵤ/σ²,  A = Jᵀ J/σ² + P

and with θᵤ drawn from the priors this is known as a spread. It belongs into every honest ±.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ParameterError
from orthocal.estimation.fit import Fit
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.selection import Selection
from orthocal.estimation.weighting import SMALLEST_SIGMA
from orthocal.io.documents import Number
from orthocal.io.fields import CLOSED, Many, Matrix, Sizes, read_only
from orthocal.kinematics.function_cache import cached_per_robot
from orthocal.robot.model import Robot
from orthocal.statistics.zeros import project_out_zeros

Array = NDArray[np.float64]

WHOLE_MODEL = "full"
"""The robot's own model of its errors: what it leaves out of joint placements a machine has not."""


@dataclass(frozen=True, slots=True, eq=False)
class Unmodelled:
    """Errors that an estimate leaves out, with their priors."""

    __pydantic_config__ = CLOSED

    names: Many[str]
    prior_stds: Sizes
    """One standard deviation of each, shape (n_unmodelled,), [SI]."""
    leakage: Matrix
    """L: what the free parameters take on, shape (n_free, n_unmodelled), [SI per SI]."""
    residual_rms: Number
    """What they alone would leave of the readings' rows after the fit, r.m.s., [m]."""
    residual_dof: Number
    """Independent parts of that: its square scatters as that of so many (Satterthwaite, 1946)."""

    @property
    def bias_covariance(self) -> Array:
        """Covariance of what the free parameters take on, shape (n_free, n_free), [SI]."""
        spread = self.leakage * self.prior_stds
        return np.asarray(spread @ spread.T)


@dataclass(frozen=True, slots=True, eq=False)
class OtherErrors:
    """Errors that a machine has and a fit left out, and how they move the readings."""

    names: tuple[str, ...]
    prior_stds: Array
    """One standard deviation of each, shape (n_others,), [SI]."""
    slopes: Array
    """∂h of one prior std of each, gauge zeros eliminated, shape (n_entries, n_others), [m]."""


@cached_per_robot(maxsize=8)
def machine_errors(robot: Robot) -> tuple[str, ...]:
    """Names of all errors that a machine is taken to have, in the robot's order.

    All that change something; and of joint placements only those of its model `full`, where a
    robot lists them itself: what it leaves out there a machine has not.
    """
    parameters = robot.parameters
    try:
        whole = set(parameters.select_model(WHOLE_MODEL))
    except ParameterError:
        whole = set()
    whole |= {
        e.name
        for e in (parameters.elementary[n] for n in parameters.complete)
        if e.kind == "scale" or e.of_frame
    }
    return tuple(name for name in parameters.names if name in whole)


def find_other_errors(fit: Fit, *, spoken_for: Collection[str] = ()) -> OtherErrors:
    """The errors of the machine that a fit left out.

    Args:
        fit: The fit.
        spoken_for: Names of parameters that its own stand for, too.
    """
    problem = fit.problem
    parameters = problem.robot.parameters
    # of a sum the first error is what it is told by: the others still differ from it
    own = problem.machine_selection.names
    taken = {parameters[n].terms[0][0] for n in (*own, *problem.fixed, *spoken_for)}
    names = [
        n
        for n in machine_errors(problem.robot)
        if n not in spoken_for and not taken & {term for term, _ in parameters[n].terms}
    ]
    o = problem.observations
    if not names:
        return OtherErrors((), read_only([]), read_only(np.zeros((o.size, 0))))
    prior_stds = read_only([parameters[n].prior_std for n in names])
    return OtherErrors(tuple(names), prior_stds, read_only(error_slopes(fit, names)))


def error_slopes(fit: Fit, names: Sequence[str]) -> Array:
    """How errors of the machine move the readings at the solution of a fit that has them not free.

    Returns:
        ∂h of one prior std of each, gauge zeros eliminated, shape (n_entries, n_names), [m].
    """
    problem = fit.problem
    chosen = tuple(problem.robot.parameters[n] for n in names)
    values = problem.split_errors(fit.solution.theta)
    selection = Selection(
        label="",
        parameters=chosen,
        prior=np.ones(len(names), dtype=bool),
        mean=read_only(np.zeros(len(names))),
        lower=read_only(np.full(len(names), -np.inf)),
        upper=read_only(np.full(len(names), np.inf)),
        fixed={n: v for n, v in values.items() if n not in names},
    )
    others = CalibrationProblem(problem.session, selection, noise=problem.noise)
    at = np.append([values.get(n, 0.0) for n in names], fit.solution.theta[problem.n_machine :])
    _, jacobian = others.linearise(at, fit.solution.passive)
    return project_out_zeros(jacobian[:, : len(names)], problem.observations)


def measure_unmodelled(fit: Fit, others: OtherErrors) -> tuple[Unmodelled, Array]:
    """What errors of the machine that were not free do to an estimate.

    Returns:
        Effect on the machine's parameters; and standard deviations of the effect on the nuisance
        parameters, shape (n_nuisance,), [SI].
    """
    problem = fit.problem
    n = problem.n_machine
    if not others.names:
        none = Unmodelled((), read_only([]), read_only(np.zeros((n, 0))), 0.0, 0.0)
        return none, np.zeros(problem.n_free - n)
    o, sigma = problem.observations, max(fit.sigma, SMALLEST_SIGMA)
    slopes = project_out_zeros(fit.jacobian, o)
    inverse = fit.information.covariance(
        sigma=sigma, precision=problem.prior_precision, held=fit.held
    )
    scaled = inverse @ (slopes.T @ others.slopes) / sigma**2
    left = o.rows(others.slopes - slopes @ scaled)
    taken = scaled * problem.theta_scale[:, None]
    found = Unmodelled(
        names=others.names,
        prior_stds=others.prior_stds,
        leakage=read_only((taken / others.prior_stds)[:n]),
        residual_rms=float(np.sqrt((left**2).sum() / len(left))),
        residual_dof=_independent_parts(left),
    )
    return found, np.asarray(np.linalg.norm(taken[n:], axis=1))


def _independent_parts(spread: Array) -> float:
    """ν with which |S t|², t standard normal, scatters as χ² does: (tr SᵀS)²/tr (SᵀS)²."""
    square = spread.T @ spread
    total = float(np.trace(square)) ** 2
    return total / float((square**2).sum()) if total > 0.0 else 0.0
