"""Linear machines with normal errors: intervals if few contrasts determine the tolerance scale.

The formulas of docs/mathematics.md, in NumPy; the scale is estimated for every machine.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh, null_space

from orthocal.estimation.problem import build_problem
from orthocal.statistics.chance import COVERAGE, coverage_factor, expanded_uncertainty
from orthocal.statistics.zeros import project_out_zeros

SCALES = np.geomspace(0.05, 60.0, 401)


class LinearMachines:
    """Machines with all errors of `full`, read as in a session, in prior standard deviations."""

    def __init__(self, session):
        problem = build_problem(session, model="full", prior=True)
        _, jacobian = problem.predict_and_jacobian(problem.active_theta)
        self.jacobian = project_out_zeros(jacobian, problem.observations)
        self.names, self.sigma = problem.free, session.gauge.sigma
        parameters, index = session.robot.parameters, np.arange(problem.n_free)
        machine = problem.machine_selection.names
        self.is_offset = np.isin(index, [i for i, k in enumerate(machine) if k.endswith(".offset")])
        self.is_scaled = np.isin(
            index, [i for i, k in enumerate(machine) if parameters.are_scaled(k)]
        )
        self.is_mounting = index >= problem.n_machine
        # contrasts: without zeros and offsets, uncorrelated at every scale
        unit = np.eye(len(self.jacobian))
        zeros = unit - project_out_zeros(unit, problem.observations)
        free = null_space(np.column_stack([zeros, self.jacobian[:, self.is_offset]]).T)
        others = free.T @ self.jacobian[:, ~(self.is_scaled | self.is_offset)]
        scaled = free.T @ self.jacobian[:, self.is_scaled]
        rest = others @ others.T + self.sigma**2 * np.eye(free.shape[1])
        self.variances, axes = eigh(scaled @ scaled.T, rest)
        self.contrasts = (free @ axes).T

    def estimate_scales(self, readings):
        """Index of the most likely scale of each machine; effective contrasts at every scale."""
        variances = 1.0 + SCALES[:, None] ** 2 * self.variances
        squares = (self.contrasts @ readings) ** 2
        costs = (1.0 / variances) @ squares + np.log(variances).sum(axis=1)[:, None]
        return costs.argmin(axis=0), np.array([self.count_contrasts(s) for s in SCALES])

    def count_contrasts(self, scale):
        """Effective number of contrasts at a scale."""
        variances = scale**2 * self.variances
        return float(((variances / (1.0 + variances)) ** 2).sum())

    def identify(self, scale):
        """Gain of the estimate, and its std with the parts from noise and scaled errors."""
        precision = np.where(self.is_scaled, scale**-2.0, 1.0)
        rows = self.jacobian / self.sigma
        inverse = np.linalg.inv(rows.T @ rows + np.diag(precision))
        gain = inverse @ rows.T / self.sigma
        scatter = (gain**2).sum(axis=1) * self.sigma**2
        scaled = inverse[:, self.is_scaled] ** 2 @ precision[self.is_scaled]
        return gain, np.sqrt([np.diag(inverse), scatter, scaled])

    def cover(self, scale, count, *, seed=0):
        """Share of machines of a true scale whose intervals contain the truth, for each error."""
        rng = np.random.default_rng(seed)
        truth = rng.normal(size=(len(self.names), count))
        truth[self.is_scaled] *= scale
        readings = self.jacobian @ truth
        readings += self.sigma * rng.normal(size=readings.shape)
        best, contrasts = self.estimate_scales(readings)
        covered = np.zeros(len(self.names))
        for i in np.unique(best):
            gain, stds = self.identify(SCALES[i])
            half = expanded_uncertainty(*stds, noise_factor=COVERAGE, contrasts=contrasts[i])
            factor = np.where(self.is_scaled, coverage_factor(contrasts[i]) * SCALES[i], COVERAGE)
            chosen = best == i
            apart = np.abs(gain @ readings[:, chosen] - truth[:, chosen])
            covered += (apart <= np.minimum(half, factor)[:, None]).sum(axis=1)
        return covered / count
