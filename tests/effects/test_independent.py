"""Readings of machines with effects against a simulator that shares no formula with orthocal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_plans import write_plan
from gauges import exact
from independent import Expansion, Gauge, IndependentMachine, States
from loaded_orthoglide import settle
from tolerances import KINEMATICS

from orthocal import draw_errors, load_plan
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import build_observations, drive_table
from orthocal.observation.sensor_groups import nuisance_parameters
from orthocal.sensors.tips import Tip

EFFECTS = "backlash: {}, thermal: {}, screw: {lead_mm: 5}, drift: {}"
OFFSETS = {"*.offset_mm": 4.0}

LOADED = 2e-10
"""[m] Readings under load: orthocal computes forces on the unloaded machine. Of the 10 µm by which
rods shorten it omits a share of 3e-5, their displacement relative to their length."""


class Measured:
    """A plan in the terms of the independent simulator."""

    def __init__(self, folder, plan):
        self.folder, self.plan = folder / "machine", plan
        self.observations = o = build_observations(plan)
        self.states = States(
            drive_table(plan)[o.posture],
            o.conditions["approach"],
            o.conditions["temperature"][:, 0],
        )
        self.gauges = [describe(s.sensor, plan.robot) for s in plan.setups.values()]

    def read(self, errors, *, states=None, expansion=None, **others):
        expansion, active = expansion or Expansion(), self.plan.active_offsets
        machine = IndependentMachine(self.folder, errors, expansion=expansion, active=active)
        o, states = self.observations, states or self.states
        return machine.read(states, self.gauges, o.setup, np.arange(o.size), **others)


def describe(sensor, robot):
    """A gauge in the terms of the independent simulator."""
    direction, rod = np.eye(3)["xyz".index(sensor.direction)], sensor.rod
    radius = 0.0 if rod is None else robot.legs[sensor.leg].rods[rod].radius + sensor.tip.radius
    return Gauge(sensor.leg, direction, sensor.section.value, rod, radius)


def draw(plan, seed):
    """Errors of geometry and effects, at their priors."""
    patterns = plan.robot.parameters.patterns("full")
    return draw_errors(plan.robot, patterns, seed=seed, tolerances=OFFSETS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_plan(tmp_path_factory.mktemp("effects") / "plan", effects=EFFECTS)


@pytest.fixture(scope="module")
def plan(folder):
    return exact(load_plan(folder))


def test_the_mounting_of_a_gauge_does_not_depend_on_the_temperature(folder, plan):
    """In postures off the axis of the leg, readings depend on the section."""
    off = np.array([0.0, 0.02, -0.03])
    postures = {n: replace(p, drives=p.drives + off) for n, p in plan.postures.items()}
    aside = Measured(folder, replace(plan, postures=postures))
    (shown,) = aside.read({})
    assert np.abs(shown - predict_readings(aside.plan, {})).max() < KINEMATICS


def test_readings_with_a_ball_on_a_rod_are_those_of_the_independent_machine(folder, plan):
    setups = {
        name: replace(s, sensor=s.sensor.on_rod("ab"[i % 2], Tip("ball", 15e-3)))
        for i, (name, s) in enumerate(plan.setups.items())
    }
    on_rods = Measured(folder, exact(replace(plan, setups=setups)))
    errors = draw(plan, 1)
    (shown,) = on_rods.read(errors)
    assert np.abs(shown - predict_readings(on_rods.plan, errors)).max() < KINEMATICS


def test_readings_with_mounting_errors_and_drift_are_those_of_the_independent_machine(folder):
    mounted = Measured(folder, load_plan(folder))
    plan, o = mounted.plan, mounted.observations
    nuisance = nuisance_parameters(plan).parameters
    values = np.random.default_rng(3).normal(size=len(nuisance)) * [p.prior_std for p in nuisance]
    named = dict(zip((p.name for p in nuisance), values, strict=True))

    def of_setups(kind):
        return np.array(
            [[named.get(f"setup.{n}.{kind}", named["gauge.scale"]) for n in plan.setups]]
        )

    errors = draw(plan, 0)
    (shown,) = mounted.read(
        errors,
        nuisance={k: of_setups(k) for k in ("roll", "pitch", "section", "scale")},
        time=o.conditions["time"][:, 0],
        drift=of_setups("drift"),
    )
    assert np.abs(shown - predict_readings(plan, errors, nuisance=values)).max() < KINEMATICS


def test_readings_of_a_loaded_machine(tmp_path):
    """All effects together, with rods that shorten by 10 µm."""
    compliance = "compliance: {rod_N_per_um: 2, platform_kg: 4}"
    folder = write_plan(tmp_path / "plan", effects=f"{EFFECTS}, {compliance}")
    plan = exact(load_plan(folder))
    loaded = Measured(folder, replace(plan, readings=plan.readings[4:6]))  # in one posture
    drives, place = np.unique(loaded.states.drives, axis=0, return_inverse=True)
    weight = np.array([0.0, 0.0, -4.0 * 9.80665])
    changes = np.array([settle(d, stiffness=2e6, weight=weight)[1] for d in drives])
    states = replace(loaded.states, stretch=changes[place.reshape(-1)])
    errors = draw(loaded.plan, 1)
    (shown,) = loaded.read(errors, states=states)
    expected = predict_readings(loaded.plan, errors)
    assert np.abs(shown - expected).max() < LOADED
    assert np.abs(shown - loaded.read(errors)).max() > 100.0 * LOADED
