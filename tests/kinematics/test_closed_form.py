"""The paper's closed forms, against equation (1) and each other."""

from __future__ import annotations

import itertools

import closed_form
import numpy as np
import pytest
from tolerances import KINEMATICS, PRINTED

from orthocal.errors import UnreachableError
from orthocal.estimation.linear import displacement_angle

LENGTH = 0.31025


@pytest.fixture(scope="module")
def machines():
    """Points and offsets, shape (200, 3)."""
    rng = np.random.default_rng(0)
    return rng.uniform(-0.12, 0.12, (200, 3)), rng.uniform(-0.01, 0.01, (200, 3))


def residual(points, joints, offsets):
    """Equation (1): squared leg lengths less L², [m²]."""
    arms = points[:, None] - (joints + offsets)[:, :, None] * np.eye(3)
    return (arms**2).sum(axis=2) - LENGTH**2


@pytest.mark.parametrize("signs", list(itertools.product((-1, 1), repeat=3)))
def test_every_configuration_of_the_inverse_satisfies_equation_1(machines, signs):
    points, offsets = machines
    joints = closed_form.inverse(points, length=LENGTH, offsets=offsets, configuration=signs)
    assert np.abs(residual(points, joints, offsets)).max() < KINEMATICS


def test_one_root_of_the_direct_kinematics_is_the_point_and_both_satisfy_equation_1(machines):
    points, offsets = machines
    joints = closed_form.inverse(points, length=LENGTH, offsets=offsets)
    roots = [closed_form.direct(joints, length=LENGTH, offsets=offsets, root=m) for m in (-1, 1)]
    for found in roots:
        assert np.abs(residual(found, joints, offsets)).max() < KINEMATICS
    assert np.abs(np.array(roots) - points).max(axis=2).min(axis=0).max() < 1e-9


def test_the_machines_root_is_minus():
    joints = closed_form.inverse([0.0, 0.0, 0.0], length=LENGTH)
    assert np.allclose(joints, LENGTH)
    assert np.abs(closed_form.direct(joints, length=LENGTH)).max() < KINEMATICS
    assert np.linalg.norm(closed_form.direct(joints, length=LENGTH, root=1)) > 0.3


def test_the_angle_of_a_displacement_is_that_of_the_paper():
    assert abs(np.sin(displacement_angle(-0.1, length=LENGTH)) + 0.32232) < PRINTED
    with pytest.raises(UnreachableError, match="400 mm is out of reach"):
        displacement_angle(0.4, length=LENGTH)
