"""Machines with an effect that the model lacks, and the effects that a search names.

The gain is the ln evidence of the true effect with its tolerances over no effect.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import timedelta

import numpy as np
from effect_plans import FIRST, effect_plan

from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.estimation.problem import build_problem
from orthocal.hypotheses import search
from orthocal.hypotheses.families.effects import unmodelled_effects
from orthocal.hypotheses.hypothesis import Rows
from orthocal.hypotheses.linear_model import LinearModel

SIGMA, STEP = 5e-6, 10e-6
ENTERED = 0.02
"""Errors of offsets after they were entered, relative to their tolerances."""


def plan_with_conditions(setups=None, *, pace=1.0):
    """A plan for a dial of 0.01 mm, each posture approached from both sides while it gets warmer.

    A setup ends with its first reading; `pace` are the minutes between readings.
    """
    plan = effect_plan(setups=setups)
    plan = plan.with_gauge(replace(plan.gauge, sigma=SIGMA, resolution=STEP))
    return plan.select([_slower(r, pace) for name in plan.setups for r in _closed(plan, name)])


def _slower(reading, pace):
    """Reading at a time so many times later after the first one of the session."""
    time = FIRST + pace * (reading.conditions.time - FIRST)
    return replace(reading, conditions=replace(reading.conditions, time=time))


def _closed(plan, setup):
    """Readings of a setup, and its first one again at the end."""
    readings = [r for r in plan.readings if r.setup == setup]
    first, last = readings[0], readings[-1].conditions
    time = last.time + timedelta(seconds=30)
    conditions = replace(first.conditions, temperature=last.temperature, time=time)
    return [*readings, replace(first, cycle=3, conditions=conditions)]


def read_machines(plan, effect, count, *, level=1.0, seed=0):
    """Readings of machines drawn from their tolerances, shape (count, n_rows), [m].

    `level` is a factor of the tolerances of their effect, if they have one.
    """
    machine = plan.with_effects([effect] if effect else [])
    problem = build_problem(machine, free=machine_errors(machine.robot), prior=True)
    rng = np.random.default_rng(seed)
    scale = problem.theta_scale * [ENTERED if n.endswith(".offset") else 1.0 for n in problem.free]
    known = machine.robot.parameters.of_effects
    own = [n in known or n.endswith(".drift") for n in problem.free]
    theta = rng.normal(size=(count, problem.n_free)) * scale * np.where(own, level, 1.0)
    positive = [p.positive for p in problem.parameters]
    values, _, reached = problem.simulate(np.where(positive, np.abs(theta), theta))
    assert reached.all()
    shown = values + SIGMA * rng.normal(size=values.shape)
    return np.round(shown / STEP) * STEP


@dataclass
class Named:
    """Result of the first step of the search for one machine."""

    gain: float
    effects: tuple[str, ...]
    """Effects that are clear, the most likely first."""


class EffectSearch:
    """The search for effects in many sessions of one plan."""

    def __init__(self, plan, effect):
        bare = plan.with_effects([])
        self.bare, self.model = bare, LinearModel(bare)
        self.true = LinearModel(plan.with_effects([effect] if effect else []))
        self.about = self.true.linearise(
            np.zeros(self.true.problem.n_free), (), None, keep_jacobian=False
        )

    def name(self, values):
        """Effects that are named in the readings of a machine, shape (n_rows,), [m]."""
        found = search._Search(self.bare.with_values(values), self.model)
        families = unmodelled_effects(Rows(self.bare, values), found.effects)
        scores = {
            f.systematic[0].name: float(evidence[0])
            for f, evidence in found.scorer.score(found.sound, families)
            if f.systematic
        }
        needed = search.CLEAR_EFFECT_LOG_BAYES - np.log(search.N_FAMILIES)
        clear = sorted((n for n in scores if scores[n] >= needed), key=lambda n: -scores[n])
        gain = self._evidence(self.true, self.about, values)
        return Named(gain - self._evidence(self.model, found.sound.about, values), tuple(clear))

    @staticmethod
    def _evidence(model, about, values):
        deviation = model.entries(values[None])[0] - about.expected
        return float(about.likelihood.score(about.likelihood.products(deviation[None]))[0])
