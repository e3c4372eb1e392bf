"""What a new session is expected to show of a machine that was calibrated, and how surely.

Readings differ from those of the calibrated machine by noise, by what the calibration does not know
of its parameters, and by how the gauges stand this time: together with covariance V = σ² I + S Sᵀ.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.calibration.calibration import Calibration
from orthocal.estimation.fit import Fit
from orthocal.statistics.distributions import chi_square_tail, f_tail
from orthocal.statistics.whitening import whiten
from orthocal.statistics.zeros import project_out_zeros

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Expectation:
    """A new session's readings against those that were expected; gauge zeros are eliminated."""

    fit: Fit
    """Of the new session."""
    theta: Array
    """The calibration's parameters, gauges standing as they are said to, shape (n_free,), [SI]."""
    slopes: Array
    """How readings answer to the parameters, in units of their tolerances, shape
    (n_entries, n_free), [m]."""
    known: Array
    """Covariance of the parameters before the session, in these units, shape (n_free, n_free): of
    the machine what the calibration left, of gauges their tolerances."""
    by_gauges: Array
    """What of it is from how the gauges of the calibration stood."""
    sigma: float
    """Standard deviation of a reading, with error of the model, [m]; NaN where nothing tells it."""
    dof: int
    """Independent readings."""

    def deviations(self, *, more: Mapping[str, float] | None = None) -> Array:
        """Readings less those of the calibrated machine, shape (n_entries,), [m].

        Args:
            more: Parameter to what it has more than the calibration says, [SI].
        """
        problem = self.fit.problem
        theta = np.array(self.theta)
        for name, value in (more or {}).items():
            theta[problem.free.index(name)] += value
        return project_out_zeros(problem.values - problem.predict(theta), problem.observations)

    def spread(self, *, share: float = 1.0) -> Array:
        """S, shape (n_entries, n_free), [m].

        Args:
            share: Part of σ that is new each time: error of the model repeats, and what it did to
                the calibration's parameters it does again.
        """
        gauges = self.by_gauges
        values, vectors = np.linalg.eigh(share**2 * (self.known - gauges) + gauges)
        return np.asarray(self.slopes @ (vectors * np.sqrt(np.maximum(values, 0.0))))

    def chance(self, *, sigma_dof: float) -> float:
        """Probability that deviations are as large, or larger; NaN where nothing was expected.

        Args:
            sigma_dof: Degrees of freedom of σ, of which infinitely many are what was stated.
        """
        if not (self.sigma > 0.0 and sigma_dof > 0.0 and self.dof > 0):
            return math.nan
        weighed = whiten(self.deviations(), self.spread(), sigma=self.sigma)
        square = float(weighed @ weighed)
        if math.isinf(sigma_dof):
            return chi_square_tail(self.dof, square)
        return f_tail(self.dof, sigma_dof, square / self.dof)


def expect(calibration: Calibration, fit: Fit, *, stood: Array) -> Expectation:
    """What was expected of a session that was fitted as the calibration was.

    Args:
        calibration: The calibration.
        fit: Of the new session, with the same parameters.
        stood: What of the calibration's covariance is from how its gauges stood, shape
            (n_machine, n_machine), [SI].
    """
    problem, n = fit.problem, fit.problem.n_machine
    scale, o = problem.theta_scale, problem.observations
    gauges = problem.prior_mean[n:] * scale[n:]
    of_machine = np.outer(scale[:n], scale[:n])
    known = np.zeros((problem.n_free, problem.n_free))
    known[:n, :n] = np.nan_to_num(calibration.covariance) / of_machine
    known[n:, n:] = np.diag(1.0 / problem.prior_precision[n:])
    by_gauges = np.array(known)
    by_gauges[:n, :n] = stood / of_machine
    noise = calibration.noise
    sigmas = [s for s in (noise.sigma, noise.residual_sigma) if not math.isnan(s)]
    return Expectation(
        fit=fit,
        theta=np.append([p.value for p in calibration.free], gauges),
        slopes=project_out_zeros(fit.jacobian, o),
        known=known,
        by_gauges=by_gauges,
        sigma=max(sigmas, default=math.nan),
        dof=o.size - o.n_zeros,
    )
