"""The paper's equations on slides of any inclination: how well readings of the legs determine
offsets."""

from __future__ import annotations

import numpy as np
import pytest

from orthocal import load_robot
from orthocal.builder.orthoglide import InclinedOrthoglide
from orthocal.estimation.linear import leg_parallelism_matrix
from orthocal.observation.model import nominal_sensitivity
from orthocal.planning.equipment import place_tool
from orthocal.sensors.leg_indicator import LegIndicator, Section
from orthocal.sensors.mounting import EXACT
from orthocal.session.session import Gauge, Reading, Session, Setup
from orthocal.units import DEG

ENDS = (0.06, -0.1)
"""Displacements along a leg, [m] (paper, section 4)."""

LENGTH = 0.31025

ORTHOGONAL = np.arcsin(np.sqrt(1.0 / 3.0))
"""Elevation of orthogonal slides, [rad]."""


def across(direction):
    """Two unit vectors across a leg: horizontal, and in its vertical plane."""
    level = np.cross([0.0, 0.0, 1.0], direction)
    level = level / np.linalg.norm(level)
    return level, np.cross(direction, level)


def differences(folder, elevation):
    """Sensitivity to the offsets of the twelve differences from zero, shape (12, 3), [m/m]."""
    machine = InclinedOrthoglide(elevation=elevation)
    (folder / "m").mkdir(exist_ok=True)
    (folder / "m/m.urdf").write_text(machine.urdf("m"))
    (folder / "m/m.yaml").write_text(machine.yaml())
    robot = load_robot(folder / "m")
    names, points, setups, readings = ["zero"], [np.zeros(3)], {}, []
    for leg in machine.legs():
        for end in ENDS:
            names.append(f"{leg.name}{end:+g}")
            points.append(end * leg.direction)
        for i, vector in enumerate(across(leg.direction)):
            name = f"{leg.name}{i}"
            sensor = LegIndicator(leg.name, tuple(vector), Section("fraction", 0.5), EXACT)
            setups[name] = Setup(name, sensor)
            readings += [Reading(name, p) for p in ("zero", *names[-2:])]
    session = Session(
        robot=robot,
        robot_reference="m",
        gauges={"": Gauge(5e-6, None, None)},
        postures=place_tool(robot, names, np.array(points)),
        setups=setups,
        readings=tuple(readings),
    )
    errors = list(robot.parameters.elementary)
    columns = [errors.index(f"{k}_slide.offset") for k in "abc"]
    zero, *ends = nominal_sensitivity(session)[:, columns].reshape(6, 3, 3).transpose(1, 0, 2)
    return np.stack([end - zero for end in ends], axis=1).reshape(12, 3)


def by_hand(elevation):
    """The same by the geometry of legs of fixed length, and a gauge in the middle of each."""
    turns, level = np.arange(3) * 120 * DEG, np.cos(elevation)
    slides = np.column_stack(
        [np.cos(turns) * level, np.sin(turns) * level, np.full(3, np.sin(elevation))]
    )
    rows = []
    for slide in slides:
        for vector in across(slide):
            slopes = []
            for end in (0.0, *ENDS):
                tool = end * slide
                along = slides @ tool
                rods = (
                    tool - (along + np.sqrt(LENGTH**2 - tool @ tool + along**2))[:, None] * slides
                )
                # |tool - root|² = L² of each leg, to first order
                moved = np.linalg.solve(rods, np.diag((rods * slides).sum(axis=1)))
                rod = rods[(slides == slide).all(axis=1)][0]
                root = tool - rod
                part = (0.5 * LENGTH - root @ slide) / (rod @ slide)
                root_moved = np.outer(slide, (slides == slide).all(axis=1))
                tangent = (1.0 - part) * root_moved + part * moved
                # where the leg crosses the plane of the section
                on_plane = tangent - np.outer(rod / (rod @ slide), slide @ tangent)
                slopes.append(vector @ on_plane)
            rows += [slopes[1] - slopes[0], slopes[2] - slopes[0]]
    return np.array(rows)


def test_sensitivities_to_offsets_are_those_of_the_geometry(tmp_path):
    elevation = 70 * DEG
    assert differences(tmp_path, elevation) == pytest.approx(by_hand(elevation), abs=1e-9)


def test_the_equations_are_best_conditioned_near_45_degrees():
    """Condition number of the twelve equations (8) and mean uncertainty per σ: docs/robots.md."""
    angles = np.arange(20.0, 70.5, 0.5)
    condition = np.array([np.linalg.cond(by_hand(a * DEG)) for a in angles])
    assert 43.0 < angles[condition.argmin()] < 46.0
    weight = np.linalg.inv(np.kron(np.eye(6), [[2.0, 1.0], [1.0, 2.0]]))
    for angle, ratio, spread in ((45 * DEG, 1.064, 1.97), (ORTHOGONAL, 1.473, 1.942)):
        a = by_hand(angle)
        assert np.linalg.cond(a) == pytest.approx(ratio, abs=5e-4)
        found = np.sqrt(np.trace(np.linalg.inv(a.T @ weight @ a)) / 3.0)
        assert found == pytest.approx(spread, abs=5e-3)


def test_orthogonal_slides_have_the_papers_equations():
    paper = leg_parallelism_matrix(length=LENGTH, displacement_max=0.06, displacement_min=-0.1)
    values = [np.linalg.svd(a, compute_uv=False) for a in (paper, by_hand(ORTHOGONAL))]
    assert values[0] == pytest.approx(values[1], abs=1e-9)
