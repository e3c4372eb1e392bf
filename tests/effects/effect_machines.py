"""Machines with effects at their priors: read by the independent simulator, identified by orthocal.

One plan: six setups, each read at five positions along its own leg from both sides, at several
temperatures, positions off the multiples of the screws' lead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timedelta

import numpy as np
import yaml
from effect_plans import write_robot
from independent import Expansion, Gauge, IndependentMachine, States
from intervals import independent_scores

from orthocal import load_plan
from orthocal.assessment.tool_error import measure_deviations, measure_uncertainty
from orthocal.effects.protocol import NEUTRAL
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.kinematics.workspace import Workspace, cube
from orthocal.observation.observations import drive_table
from orthocal.statistics.chance import confidence_factor
from orthocal.statistics.information import decompose

KEYS = "backlash: {}, thermal: {}, screw: {lead_mm: 5}, drift: {}"
EFFECTS = ("backlash", "thermal", "screw", "drift")
SIGMA = 5e-6
OFFSETS = {"*.offset": 2e-3}

ALONG = (0.0, -98.6, -41.3, 39.1, 57.8)
"""Positions, [mm]: 0, -100, -40, 40 and 60 off the same phase of the screw."""

COOLEST, WARMEST, USED_AT = 17.0, 27.0, 22.0
"""Temperatures of readings and of use, [°C]."""

BESIDE_BOUND = 1.2
"""Largest ratio of the RMS tool error to that of the linear Bayesian estimate."""

COST = 1.05
"""Largest ratio of tool errors of machines without effects, with effects identified and without."""

FIRST = datetime(2025, 3, 14, 8)
BETWEEN = timedelta(minutes=1)


def write_plan(folder, *, between=BETWEEN, growing=False):
    """A plan of 60 readings on a machine with all effects; the temperature grows with the time, or
    goes up and down."""
    write_robot(folder / "machine", KEYS)
    postures, setups = {}, {}
    rows = ["setup,posture,reading_mm,approach,temperature_C,time"]
    for leg in "xyz":
        for d in ALONG:
            postures[f"{leg}{d:+.0f}"] = {"tcp_mm": [d * (k == leg) for k in "xyz"]}
    for leg in "xyz":
        for direction in sorted(set("xyz") - {leg}):
            keys = {"leg": leg, "direction": direction, "section": {"fraction": 0.5}}
            setups[direction + leg] = keys
    for i, name in enumerate(setups):
        for d in ALONG:
            for letter in "pn":
                k = len(rows) - 1
                approach = "".join(letter if j == name[1] else "pn"[(i + k) % 2] for j in "xyz")
                warm = COOLEST + (WARMEST - COOLEST) * (k if growing else (7 * k) % 60) / 59
                when = (FIRST + k * between).isoformat()
                rows.append(f"{name},{name[1]}{d:+.0f},0.0,{approach},{warm:.1f},{when}")
    plan = {"robot": "machine", "gauge": {"sigma_mm": 1e3 * SIGMA, "range_mm": [-20, 20]}}
    plan |= {"postures": postures, "setups": setups, "readings": "readings.csv"}
    (folder / "session.yaml").write_text(yaml.safe_dump(plan))
    (folder / "readings.csv").write_text("\n".join(rows) + "\n")
    return folder


@dataclass
class Outcome:
    """What calibrations of machines promised and what came out."""

    found: np.ndarray
    """Tool error of each machine, [m]."""
    predicted: np.ndarray
    """Its prediction."""
    bound: float
    """That of the linear Bayesian estimate from these readings, about the nominal machine."""
    covered: np.ndarray
    """Whether independent 95 % intervals contain the truth, of all errors but the backlashes."""
    covered_determined: np.ndarray
    """The same of those along the principal axes that the readings determine."""
    covered_backlash: np.ndarray
    """Whether the interval of each backlash by itself contains the truth."""
    at_bound: int
    """Backlashes that are estimated as 0."""


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


class EffectMachines:
    """Machines with all errors of geometry and some effects, and a model of them; all readings and
    the use are at one temperature, [°C], if it is stated."""

    def __init__(self, folder, effects, *, temperature=None):
        self.folder, self.effects = folder / "machine", effects
        self.plan = load_plan(folder).with_effects(list(effects))
        if temperature is not None:
            readings = self.plan.readings
            stated = (replace(r.conditions, temperature=temperature) for r in readings)
            readings = [replace(r, conditions=c) for r, c in zip(readings, stated, strict=True)]
            self.plan = replace(self.plan, readings=tuple(readings))
        self.problem = build_problem(self.plan, model="full", prior=True, prior_stds=OFFSETS)
        robot = self.plan.robot
        closure = LoopClosure(robot)
        points = np.repeat(cube(robot, points_per_side=3).points, 2, axis=0)
        sides = np.sign(np.random.default_rng(0).normal(size=(len(points) // 2, 3)))
        used_at = USED_AT if temperature is None else temperature
        self.used = States(
            closure.inverse(points),
            np.stack([sides, -sides], axis=1).reshape(-1, 3),  # each point from both sides
            np.full(len(points), used_at),
        )
        self.workspace = Workspace.even(points)

    def draw(self, rng, count):
        """Errors and nuisance parameters at their priors, shape (count, n_free), [SI]."""
        problem = self.problem
        values = rng.normal(size=(count, problem.n_free)) * problem.theta_scale
        positive = [p.positive for p in problem.parameters]
        return np.where(positive, np.abs(values), values)

    def machines(self, truth):
        """The independent machines with some errors."""
        errors = dict(zip(self.problem.machine_selection.names, truth.T, strict=False))
        expansion = Expansion() if "thermal" in self.effects else None
        return IndependentMachine(self.folder, errors, expansion=expansion)

    def read(self, truth, rng):
        """Readings of machines with noise, shape (count, n_entries), [m]."""
        problem, o = self.problem, self.problem.observations
        setups = list(self.plan.setups.values())
        gauges = [
            Gauge(s.sensor.leg, np.eye(3)["xyz".index(s.sensor.direction)], s.sensor.section.value)
            for s in setups
        ]
        states = States(
            drive_table(self.plan)[o.posture],
            o.conditions["approach"],
            o.conditions["temperature"][:, 0],
        )

        def of_setups(kind):
            names = [f"setup.{s.name}.{kind}" for s in setups]
            at = [problem.free.index(n if n in problem.free else "gauge.scale") for n in names]
            return truth[:, at]

        shown = self.machines(truth).read(
            states,
            gauges,
            o.setup,
            np.arange(o.size),
            nuisance={k: of_setups(k) for k in ("roll", "pitch", "section", "scale")},
            time=o.conditions["time"][:, 0],
            drift=of_setups("drift") if "drift" in self.effects else None,
        )
        return shown + SIGMA * rng.normal(size=shown.shape)

    def covariance(self, theta, at_bound=None):
        """Posterior covariance of the free parameters about theta, [SI]."""
        problem = self.problem
        _, jacobian = problem.predict_and_jacobian(theta)
        information = decompose(jacobian, problem.observations)
        held = None if at_bound is None else problem.selection.held_at_bound(at_bound)
        covariance = information.posterior(
            sigma=SIGMA, precision=problem.prior_precision, at_bound=held
        ).covariance
        return covariance * np.outer(problem.theta_scale, problem.theta_scale)

    def tool(self, theta):
        """Tool under the conditions of use as the model has it, shape (count, K, 3), [m]."""
        names = self.problem.machine_selection.names
        closure = LoopClosure(self.plan.robot, free=names)
        return closure.forward(self.commands, theta=theta[:, : len(names)])

    @property
    def commands(self):
        """Commands of the states of use."""
        by_condition = {
            "approach": self.used.approach,
            "temperature": self.used.temperature[:, None],
        }
        conditions = self.problem.functions.errors.conditions
        return np.hstack([self.used.drives, *(by_condition[c] for c in conditions)])

    def tool_errors(self, machines, theta):
        """RMS tool error of each of the independent machines, aligned, [m]."""
        apart = self.tool(theta) - machines.tool(self.used)
        points = self.workspace.points
        return np.array([measure_deviations(a, self.workspace, points).aligned.rms for a in apart])

    def identify(self, truth, rng):
        """Identify machines with parameters of shape (count, n_free), [SI], from their readings."""
        problem, n = self.problem, self.problem.n_machine
        solved = BatchSolver(problem).solve(self.read(truth, rng), sigma=SIGMA)
        free = problem.machine_selection.names
        sensitivity = ToolSensitivity(self.plan.robot, free=free)(self.commands)

        def predict(covariance):
            sizes = measure_uncertainty(
                sensitivity, covariance[:n, :n], self.workspace, self.workspace.points
            ).sizes
            return sizes.aligned.rms

        of_backlash = np.array([name.endswith(".backlash") for name in free])
        others, backlash = np.flatnonzero(~of_backlash), np.flatnonzero(of_backlash)
        limit, covered, covered_determined = confidence_factor(np.inf), [], []
        covered_backlash, predicted = [], []
        for true, theta, at_bound in zip(truth, solved.theta, solved.at_bound, strict=True):
            covariance = self.covariance(theta, at_bound)
            scale = problem.theta_scale[others]
            inner = covariance[np.ix_(others, others)] / np.outer(scale, scale)
            scores, along = independent_scores((theta - true)[others] / scale, inner)
            covered.extend(np.abs(scores) < limit)
            covered_determined.extend(np.abs(along) < limit)
            stds = np.sqrt(np.diag(covariance))
            covered_backlash.extend(np.abs(true - theta)[backlash] < limit * stds[backlash])
            predicted.append(predict(covariance))
        return Outcome(
            self.tool_errors(self.machines(truth), solved.theta),
            np.array(predicted),
            predict(self.covariance(np.zeros(problem.n_free))),
            np.array(covered),
            np.array(covered_determined),
            np.array(covered_backlash),
            int((solved.at_bound[:, :n][:, of_backlash] == -1).sum()),
        )


def identify_nothing(folder, count):
    """Tool errors of machines without effects, with effects identified and without, [m]."""
    told = EffectMachines(folder, EFFECTS, temperature=NEUTRAL["temperature"])
    plain = EffectMachines(folder, (), temperature=NEUTRAL["temperature"])
    truth = plain.draw(np.random.default_rng(3), count)
    values = plain.read(truth, np.random.default_rng(4))
    errors = []
    for model in (told, plain):
        theta = BatchSolver(model.problem).solve(values, sigma=SIGMA).theta
        errors.append(rms(model.tool_errors(plain.machines(truth), theta)))
    return errors
