"""Machines whose errors are drawn at a factor of their tolerances, calibrated as Experiment 2."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from orthocal import Machine, simulate_session
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.assessment.controller_entries import compute_entries, entered_offsets
from orthocal.assessment.judgement import find_tolerance_scale
from orthocal.assessment.tool_error import assess_placed, summarise_tool
from orthocal.calibration.identify import identify


@dataclass
class Outcome:
    """Results of the machines of one factor and model."""

    covered: np.ndarray
    """Whether ± of each offset contains the best value to enter, shape (n_machines, n_drives)."""
    mounted: np.ndarray
    """Whether ± of each nuisance parameter contains its value, shape (n_machines, n_nuisance)."""
    profiled: np.ndarray
    """Whether profile intervals of offsets contain their values, shape (n_machines, n_profiled)."""
    found: np.ndarray
    """Whether the readings showed errors above their tolerances, shape (n_machines,)."""
    tool: np.ndarray
    """Tool error with the offsets entered, and predicted, shape (n_machines, 2), [m]."""

    @property
    def ratio(self):
        """RMS tool error over the predicted one, of machines of which the factor was found."""
        true, predicted = np.sqrt(np.mean(self.tool[self.found] ** 2, axis=0))
        return true / predicted


def calibrate_machines(session, model, *, factor, count, solver="linearised", seed=0, profile=()):
    """Calibrate machines with errors of `full` at a factor of their tolerances, offsets at theirs.

    The offsets named in `profile` have profile-likelihood intervals.
    """
    parameters = session.robot.parameters
    names = parameters.select_model("full")
    session = session.with_gauge(replace(session.gauge, range=None))
    rng, covered, mounted, profiled = np.random.default_rng(seed), [], [], []
    found, tools = [], []
    for number in range(count):
        sizes = [
            (factor if parameters.are_scaled(n) else 1.0) * parameters[n].prior_std for n in names
        ]
        errors = dict(zip(names, (rng.normal(size=len(names)) * sizes).tolist(), strict=True))
        errors |= {n: v / 5.0 for n, v in errors.items() if parameters.are_offsets(n)}
        simulated = simulate_session(session, errors, seed=seed + number)
        calibration, _ = identify(
            simulated.session,
            model,
            solver=solver,
            find_scale=find_tolerance_scale,
            profile=profile,
        )
        tool = find_tool(calibration)
        entries = compute_entries(calibration, tool)
        accuracy = assess_placed(calibration, tool, entries)
        drives = Machine(session.robot, {}).inverse(tool.targets)
        drives -= entered_offsets(calibration, entries)
        left = Machine(session.robot, errors).forward(drives) - tool.targets
        promised = summarise_tool(calibration, accuracy).entered
        tools.append((accuracy.measure(left).reported.rms, promised))
        errors |= simulated.nuisance
        offsets = [calibration[f"{d.name}.offset"] for d in session.robot.drives]
        covered.append(_cover(calibration, offsets, errors))
        mounted.append(_cover(calibration, calibration.sensors, errors))
        intervals = [calibration[name].interval for name in profile]
        profiled.append([a <= errors[n] <= b for n, (a, b) in zip(profile, intervals, strict=True)])
        found.append(calibration.tolerance_scale.factor > 1.0)
    return Outcome(*map(np.array, (covered, mounted, profiled, found, tools)))


def _cover(calibration, estimates, truth):
    """Whether ± of each estimate, of an offset or a nuisance parameter, contains the truth."""
    return [abs(p.value - truth[p.name]) <= calibration.expand_estimate(p) for p in estimates]
