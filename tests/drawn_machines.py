"""Many machines measured by one plan: readings and fits without building anything again.

A machine whose identified offsets were entered, and that is measured again, reads as one whose
offsets are what the identification has left of them: the controller takes the entered ones off.
"""

from __future__ import annotations

import numpy as np

from orthocal.estimation.diagnostics.unmodelled import find_unmodelled_errors, machine_errors
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import build_problem


class DrawnMachines:
    """Machines drawn from their robot's tolerances, all read by one plan."""

    def __init__(self, plan, *, model="offsets"):
        self.plan = plan
        robot = plan.robot
        self.machine = build_problem(plan, free=machine_errors(robot), prior=True)
        self.is_offset = np.array([n.endswith(".offset") for n in self.machine.free])
        self.prior_stds = np.array([p.prior_std for p in self.machine.parameters])
        exact = plan.with_values(np.zeros(len(plan.readings)))
        problem = build_problem(exact, model=model)
        # the same optimum as Ipopt's (`test_solvers`), in less time
        self.nominal = fit_problem(problem, options=SolverOptions(solver="variable-projection"))
        self.problem, self.others = problem, find_unmodelled_errors(self.nominal)

    def draw(self, rng, *, level=1.0):
        """Errors of a machine, all but its offsets so many times their tolerances, [SI]."""
        scale = np.where(self.is_offset, 1.0, level) * self.prior_stds
        return scale * rng.normal(size=scale.size)

    def by_name(self, errors):
        """Errors of a machine by their names, [SI]."""
        return dict(zip(self.machine.machine_selection.names, errors.tolist(), strict=False))

    def read(self, rng, errors, *, sigma=None):
        """Readings of a machine, rounded to the gauge's resolution, [m]."""
        gauge, o = self.plan.gauge, self.problem.observations
        noise = (gauge.sigma if sigma is None else sigma) * rng.normal(size=o.size)
        values = self.machine.predict(errors) + noise
        if gauge.resolution:
            values = np.round(values / gauge.resolution) * gauge.resolution
        return values

    def fit(self, values):
        """The fit of readings."""
        return fit_problem(self.problem.with_values(values), program=self.nominal.program)

    def enter(self, errors, fit):
        """What is left of a machine's errors with the offsets of a fit in the controller."""
        left = np.array(errors)
        for name, value in zip(fit.problem.free, fit.solution.theta, strict=True):
            if name.endswith(".offset"):
                left[self.machine.free.index(name)] -= value
        return left
