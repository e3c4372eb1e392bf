"""One plan of readings on many machines at once: their loops closed, and what they show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthocal.estimation.problem import CalibrationProblem
from orthocal.kinematics.machine_batch import Machines

Array = NDArray[np.float64]


class Fleet(Machines):
    """Machines that differ in the free parameters of a problem, in its postures.

    Args:
        problem: The problem.
        theta: θ̂ of each, shape (n_sets, n_free).
    """

    def __init__(self, problem: CalibrationProblem, theta: Array) -> None:
        self._problem = problem
        self.theta = np.array(theta)
        n = problem.n_machine
        errors = problem.assembly.errors() + self.theta[:, :n] @ problem.columns.T
        self._unknowns = problem.setting(errors) + self.theta[:, n:] * problem.theta_scale[n:]
        super().__init__(problem.robot, errors, problem.drives, problem.reference_passive)

    def predict(self) -> Array:
        """Readings of all, gauge zeros at 0, shape (n_sets, n_entries), [m of the first gauge]."""
        problem, o = self._problem, self._problem.observations
        result = np.empty((self.size, o.size))
        zero, actuated = self.actuated(problem.session.zero_drives), self.actuated(problem.drives)
        for group in problem.sensor_groups:
            at = o.posture[group.entries]
            n = at.size
            (h,) = group.reading.value.unshared(
                actuated[:, at].reshape(self.size * n, -1),
                self.passive[:, at].reshape(self.size * n, -1),
                self.placements,
                zero[:, group.setups].reshape(self.size * n, -1),
                np.tile(group.constants, (self.size, 1)),
                self._unknowns[:, group.unknowns].reshape(self.size * n, -1),
            )
            result[:, group.entries] = h[:, 0].reshape(self.size, n)
        return np.asarray(result / problem.noise)
