"""The paper's closed forms, against equation (1), each other and central differences."""

from __future__ import annotations

import itertools

import closed_form as og
import numpy as np
import pytest
from derivatives import assert_derivative
from hypothesis import given, settings
from hypothesis import strategies as st
from tolerances import KINEMATICS, PRINTED

from orthocal.errors import UnreachableError
from orthocal.estimation.linear import displacement_angle

LENGTH = 0.31025
inside = st.floats(-0.12, 0.12)


@settings(max_examples=200, deadline=None)
@given(st.tuples(inside, inside, inside), st.tuples(*[st.floats(-0.01, 0.01)] * 3))
def test_every_configuration_of_the_inverse_satisfies_equation_1(point, offsets):
    for signs in itertools.product((-1, 1), repeat=3):
        joints = og.inverse(point, length=LENGTH, offsets=offsets, configuration=signs)
        residual = og.constraint_residual(point, joints, length=LENGTH, offsets=offsets)
        assert np.abs(residual).max() < KINEMATICS


@settings(max_examples=200, deadline=None)
@given(st.tuples(inside, inside, inside), st.tuples(*[st.floats(-0.01, 0.01)] * 3))
def test_one_root_of_the_direct_kinematics_is_the_point_and_both_satisfy_equation_1(point, offsets):
    joints = og.inverse(point, length=LENGTH, offsets=offsets)
    roots = [og.direct(joints, length=LENGTH, offsets=offsets, root=m) for m in (-1, 1)]
    for found in roots:
        residual = og.constraint_residual(found, joints, length=LENGTH, offsets=offsets)
        assert np.abs(residual).max() < KINEMATICS
    assert min(np.abs(found - point).max() for found in roots) < 1e-9


def test_the_machines_root_is_minus():
    joints = og.inverse([0.0, 0.0, 0.0], length=LENGTH)
    assert np.allclose(joints, LENGTH)
    assert np.abs(og.direct(joints, length=LENGTH, root=-1)).max() < KINEMATICS
    assert np.linalg.norm(og.direct(joints, length=LENGTH, root=1)) > 0.3


def test_everything_is_vectorised_over_postures():
    points = np.random.default_rng(0).uniform(-0.1, 0.06, (5, 7, 3))
    joints = og.inverse(points, length=LENGTH)
    assert joints.shape == points.shape
    assert np.abs(og.direct(joints, length=LENGTH) - points).max() < KINEMATICS
    assert og.jacobian(points, joints).shape == (5, 7, 3, 3)


def test_the_jacobian_is_the_derivative_of_the_direct_kinematics():
    rng = np.random.default_rng(1)
    offsets = np.array([0.001, -0.002, 0.003])
    for point in rng.uniform(-0.1, 0.06, (10, 3)):
        joints = og.inverse(point, length=LENGTH, offsets=offsets)
        assert_derivative(
            og.jacobian(point, joints, offsets=offsets),
            lambda r: og.direct(r, length=LENGTH, offsets=offsets),
            joints,
        )
        assert_derivative(
            og.inverse_jacobian(point, joints, offsets=offsets),
            lambda p: og.inverse(p, length=LENGTH, offsets=offsets),
            point,
        )


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("displacement", [0.06, -0.1, 0.0])
def test_equation_5_is_the_jacobian_on_an_axis(axis, displacement):
    point = np.zeros(3)
    point[axis] = displacement
    joints = og.inverse(point, length=LENGTH)
    expected = og.jacobian(point, joints)
    found = og.displacement_jacobian(axis, displacement, length=LENGTH)
    assert np.abs(found - expected).max() < KINEMATICS


def test_equation_6_at_the_papers_maximum():
    sensitivity = og.displacement_jacobian(0, 0.06, length=LENGTH)
    tangent = 0.06 / np.sqrt(LENGTH**2 - 0.06**2)
    assert np.abs(sensitivity - [[1, 0, 0], [tangent, 1, 0], [tangent, 0, 1]]).max() < KINEMATICS
    assert abs(np.sin(displacement_angle(-0.1, length=LENGTH)) + 0.32232) < PRINTED


def test_a_displacement_out_of_reach_is_refused():
    with pytest.raises(UnreachableError, match="400 mm is out of reach"):
        displacement_angle(0.4, length=LENGTH)
