"""The observation model, against equation (7), against Pinocchio, and the taking apart of rows."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from derivatives import central_differences
from machines import reading_by_pinocchio
from tolerances import KINEMATICS, PRINTED, THREE_DECIMALS_MM

from orthocal import load_plan, load_session
from orthocal.observation.contacts import locate_contacts
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import build_observations, readings_without
from orthocal.sensors.leg_indicator import Section
from orthocal.session.session import Reading
from orthocal.statistics.zeros import project_out_zeros

OFFSETS = ("x_slide.offset", "y_slide.offset", "z_slide.offset")


def differences(session, offsets):
    o = build_observations(session)
    return o.rows(
        predict_readings(session, dict(zip(OFFSETS, offsets, strict=True)), observations=o)
    )


def test_readings_equal_those_of_a_pinocchio_machine_with_all_errors(root):
    """Every kind of section and sign, all errors at five times their tolerance."""
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    forms = {"fraction": 0.4, "from_root_mm": 0.2, "coordinate_mm": 0.15}
    sections = [Section(form, value) for form, value in forms.items()]
    setups = {}
    for i, (name, s) in enumerate(plan.setups.items()):
        direction = ("-" if i % 2 else "") + s.sensor.direction
        sensor = replace(s.sensor, section=sections[i % 3], direction=direction)
        setups[name] = replace(s, sensor=sensor)
    plan = replace(plan, setups=setups, controller_offsets=np.array([1e-3, 0.0, -2e-3]))
    o = build_observations(plan)
    # frame errors of a root would let it move with its swivel; all else is in the full model
    names = plan.robot.parameters.select(["*", "!frame.*_leg_root.*"])
    rng = np.random.default_rng(3)
    errors = {n: 5.0 * plan.robot.parameters[n].prior_std * rng.normal() for n in names}
    ours = predict_readings(plan, errors, observations=o)
    machine = plan.robot.with_errors(errors)
    places = {(r.setup, r.posture): i for i, r in enumerate(plan.readings)}
    assert len(places) == 18
    for (setup, posture), i in places.items():
        pair = plan.setups[setup], plan.postures[posture]
        assert abs(ours[i] - reading_by_pinocchio(plan, machine, *pair)) < KINEMATICS


@pytest.mark.parametrize(("size", "expected_mm"), [(1, 0.0015), (2, 0.006), (5, 0.039)])
def test_linearisation_error_grows_with_the_square_of_the_offsets(experiment_2, size, expected_mm):
    offsets = 1e-3 * size * np.array([1.0, -0.6, 0.3])
    slope = central_differences(lambda d: differences(experiment_2, d), np.zeros(3), step=1e-6)
    error = np.abs(differences(experiment_2, offsets) - slope @ offsets).max()
    assert abs(error - expected_mm * 1e-3) < THREE_DECIMALS_MM


def test_offsets_that_the_controller_corrects_do_not_show(raw_cycles):
    offsets = np.array([1.2e-3, -0.8e-3, 0.5e-3])
    postures = {n: replace(p, drives=p.drives - offsets) for n, p in raw_cycles.postures.items()}
    corrected = replace(raw_cycles, postures=postures, controller_offsets=offsets)
    o = build_observations(corrected)
    shown = predict_readings(corrected, dict(zip(OFFSETS, offsets, strict=True)), observations=o)
    assert np.abs(shown).max() < KINEMATICS * 10


def test_differences_are_taken_apart_into_readings_with_a_zero_each(tmp_path, root):
    text = (root / "examples/raw-cycles/session.yaml").read_text()
    (tmp_path / "session.yaml").write_text(text)
    (tmp_path / "readings.csv").write_text(
        "setup,posture,minus,cycle,reading_mm\n"
        "yx,x_max,zero,1,0.3\nyx,x_min,zero,1,-0.2\n"  # share the zero reading
        "yx,x_max,x_min,2,0.6\nzx,x_max,x_min,1,0.1\nzx,zero,x_max,1,0.4\n"
    )
    session = load_session(tmp_path)
    o = build_observations(session)
    assert o.size == 3 + 2 + 3
    assert o.n_zeros == 3
    assert not any(o.zero_real)
    assert np.abs(o.rows(o.values(session.values)) - session.values).max() < KINEMATICS
    # projecting the zeros out gives the inverse covariance of the differences
    projector = project_out_zeros(np.eye(o.size), o)
    incidence = np.zeros((len(session.readings), o.size))
    incidence[np.arange(len(incidence)), o.plus] = 1.0
    incidence[np.arange(len(incidence)), o.minus] -= 1.0
    covariance = incidence @ incidence.T
    assert np.array_equal(covariance[:2, :2], [[2.0, 1.0], [1.0, 2.0]])
    expected = incidence.T @ np.linalg.inv(covariance) @ incidence
    assert np.abs(projector - expected).max() < KINEMATICS


def test_values_of_many_groups_of_differences_take_little_time(raw_cycles):
    """10 000 cycles of one difference each: a search for each group would take a minute."""
    first, second = list(raw_cycles.postures)[:2]
    rows = tuple(Reading("yx", first, second, cycle, 1e-8 * cycle) for cycle in range(1, 10_001))
    session = replace(raw_cycles, readings=rows)
    o = build_observations(session)
    began = time.process_time()
    values = o.values(session.values)
    assert time.process_time() - began < 5.0
    assert np.abs(o.rows(values) - session.values).max() < KINEMATICS


@pytest.mark.parametrize("condition", ["load", "adjustment", "coordinates", "reference"])
def test_conditions_without_a_column_are_never_missing(raw_cycles, condition):
    """They are computed. An effect with such a condition and a parameter can be identified."""
    assert readings_without(raw_cycles, condition) == []


def test_contacts_move_along_the_leg_with_the_posture(raw_cycles):
    postures, contact = locate_contacts(raw_cycles)["yx"]
    assert postures == ["zero", "x_max", "x_min"]
    # the plane at half the X-leg, whose tip is 40 mm from the tool; the root moves with its slide
    leg = raw_cycles.robot.legs["x"]
    assert contact.points @ leg.axis == pytest.approx([-0.195125] * 3, abs=KINEMATICS)
    assert contact.points[:, 1:] == pytest.approx(np.zeros((3, 2)), abs=KINEMATICS)
    assert contact.problems == ["", "", ""]
    assert (contact.along == leg.axis).all()
    assert contact.direction.tolist() == [0.0, 1.0, 0.0]


def test_equation_7_comes_out_of_the_urdf(root):
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    rows = [r for r in plan.readings if r.setup == "yx" and r.cycle == 1]
    plan = replace(plan, readings=tuple(rows))
    slope = central_differences(lambda d: differences(plan, d), np.zeros(3), step=1e-6)
    zero, x_max, x_min = slope
    assert np.abs((x_max - zero) - [0.13668, 0.19339, 0.0]).max() < PRINTED
    assert np.abs((x_min - zero) - [-0.06050, -0.32232, 0.0]).max() < PRINTED
