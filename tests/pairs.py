"""Machines measured in several sessions that are calibrated together, nothing built again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from orthocal import SolverOptions, join_sessions, simulate_session
from orthocal.estimation.diagnostics.unmodelled import find_other_errors, machine_errors
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.problem import build_problem
from orthocal.hypotheses.sessions.changes import find_session_changes
from orthocal.hypotheses.sessions.joint_readings import label_sessions


class Several:
    """Machines drawn from their robot's tolerances, each read by the same plans in turn."""

    def __init__(self, plans, *, model="offsets", offset=0.3e-3):
        ideal = [simulate_session(plan, {}, exact=True).session for plan in plans]
        self.session = join_sessions(ideal)
        robot = self.session.robot
        sums = [p.name for p in robot.parameters if len(p.terms) > 1]
        self.machine = build_problem(self.session, free=machine_errors(robot), prior=True)
        self.sums = {n: robot.parameters.expand({n: 1.0}) for n in sums}
        self.names = list(self.machine.free)
        _, self.part = label_sessions(self.machine)
        self.sigma = np.array(
            [self.session.gauges[s.gauge].sigma for s in self.session.setups.values()]
        )[self.machine.observations.setup]
        self.resolution = self.session.gauge.resolution
        self.tolerances = np.array([p.tolerance for p in self.machine.parameters])
        self.tolerances[[n.endswith(".offset") for n in self.names]] = offset
        self.problem = build_problem(self.session, model=model)
        options = SolverOptions(solver="eliminated")
        self.nominal = fit_problem(self.problem, options=options)
        self.others = find_other_errors(self.nominal)

    def draw(self, rng, *, level=1.0):
        """Errors of a machine and how its gauges stand, [SI]."""
        errors = self.tolerances * rng.normal(size=self.tolerances.size)
        errors[: self.machine.n_machine] *= level
        return errors

    def read(self, rng, errors, changes=()):
        """Readings, rounded to the gauge's resolution, [m].

        Args:
            rng: For the noise.
            errors: Of the machine in the first session, [SI].
            changes: Name, size [SI], and from which session on, each.
        """
        values = np.empty(self.part.size)
        for k in range(self.part.max() + 1):
            now = np.array(errors)
            for name, size, since in changes:
                for term, share in self.sums.get(name, {name: 1.0}).items():
                    if since <= k and term in self.names:
                        now[self.names.index(term)] += share * size
            of = self.part == k
            values[of] = self.machine.predict(now)[of]
        values += self.sigma * rng.normal(size=values.size)
        if self.resolution:
            values = np.round(values / self.resolution) * self.resolution
        return self.machine.observations.rows(values)

    def fit(self, values):
        """The fit of readings."""
        return fit_problem(self.problem.with_values(values), program=self.nominal.program)

    def find(self, values):
        """What is said to have changed."""
        fit = self.fit(values)
        return find_session_changes(fit, find_other_errors(fit))

    def find_near(self, values):
        """The same by slopes of the nominal machine: what is fitted is taken out either way."""
        problem = self.nominal.problem.with_values(values)
        program = self.nominal.program.with_problem(problem)
        fit = replace(self.nominal, problem=problem, program=program)
        return find_session_changes(fit, self.others)
