"""Exponential, logarithm and Jacobians of SE(3): arrays and expressions against Pinocchio."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from derivatives import assert_derivative
from tolerances import KINEMATICS

from orthocal.kinematics.se3 import SERIES_BELOW, exp6, log6, log6_jacobian, right_jacobian, skew
from orthocal.kinematics.symbolic import Pose

EDGE = float(np.sqrt(SERIES_BELOW))
ANGLES = [0.0, 1e-12, 1e-4, 0.03, 0.0447, 0.19, 0.999 * EDGE, 1.001 * EDGE, 1.0, 3.0]


def twist_of(angle, seed=2):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    return np.r_[rng.normal(size=3), angle * axis / np.linalg.norm(axis)]


def as_function(build):
    """A symbolic function of a twist as a function of arrays."""
    twist = ca.SX.sym("twist", 6)
    function = ca.Function("f", [twist], list(build(twist)))
    return lambda xi: [np.asarray(v.full()) for v in function.call([xi])]


def logarithm(rotation, position):
    """The expression of the logarithm, at arrays."""
    return np.asarray(ca.DM(log6(ca.SX(rotation), ca.SX(position))))[:, 0]


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_and_logarithm_equal_pinocchios(angle):
    xi = twist_of(angle)
    expected = pin.exp6(xi)
    rotation, position = exp6(xi)
    assert np.abs(rotation - expected.rotation).max() < KINEMATICS
    assert np.abs(position - expected.translation).max() < KINEMATICS
    # near half a turn the logarithm itself is ill-conditioned
    slack = KINEMATICS * (1.0 if angle < 2.0 else 100.0)
    assert np.abs(logarithm(rotation, position) - xi).max() < slack


@pytest.mark.parametrize("angle", ANGLES)
def test_expressions_equal_arrays(angle):
    xi = twist_of(angle)
    pose = exp6(xi)
    rotation, position, twist, right = as_function(
        lambda t: (*exp6(t), log6(*exp6(t)), right_jacobian(t))
    )(xi)
    assert np.abs(rotation - pose[0]).max() < KINEMATICS
    assert np.abs(position[:, 0] - pose[1]).max() < KINEMATICS
    assert np.abs(twist[:, 0] - logarithm(*pose)).max() < 10 * KINEMATICS
    assert np.abs(right - right_jacobian(xi)).max() < KINEMATICS


def adjoint_series(xi):
    """T = Σ (−ad ξ)^k/(k + 1)!."""
    ad = np.block([[skew(xi[3:]), skew(xi[:3])], [np.zeros((3, 3)), skew(xi[3:])]])
    term = total = np.eye(6)
    for k in range(1, 60):
        term = -(term @ ad) / (k + 1)
        total = total + term
    return total


@pytest.mark.parametrize("angle", ANGLES)
def test_the_right_jacobian_equals_its_series(angle):
    xi = twist_of(angle)
    assert np.abs(right_jacobian(xi) - adjoint_series(xi)).max() < KINEMATICS


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.1, 1.0, 3.0])  # others cancel in Pinocchio's
def test_jacobians_equal_pinocchios(angle):
    xi = twist_of(angle)
    assert np.abs(right_jacobian(xi) - pin.Jexp6(xi)).max() < KINEMATICS
    if angle < 2.0:
        pose = pin.exp6(xi)
        expression = log6_jacobian(ca.SX(pose.rotation), ca.SX(pose.translation))
        found = np.asarray(ca.DM(ca.evalf(expression)))
        assert np.abs(found - pin.Jlog6(pose)).max() < 10 * KINEMATICS


@pytest.mark.parametrize("angle", [1e-3, 0.0447, 0.0999, 0.1002, 0.3, 2.0, 3.0])
def test_the_jacobian_of_the_logarithm_is_the_inverse_of_that_of_the_exponential(angle):
    """Also beside the limit of its series, an angle of 0.1 rad."""
    xi = twist_of(angle)
    rotation, position = exp6(xi)
    inverse = np.asarray(ca.DM(ca.evalf(log6_jacobian(ca.SX(rotation), ca.SX(position)))))
    assert np.abs(inverse @ right_jacobian(xi) - np.eye(6)).max() < 10 * KINEMATICS


def test_batches_equal_single_twists():
    xi = np.array([[twist_of(a, s) for a in ANGLES] for s in (1, 2, 3)])
    rotations, positions = exp6(xi)
    assert rotations.shape == (3, len(ANGLES), 3, 3)
    jacobians = right_jacobian(xi)
    for at in np.ndindex(xi.shape[:-1]):
        rotation, position = exp6(xi[at])
        assert np.array_equal(rotations[at], rotation)
        assert np.array_equal(positions[at], position)
        assert np.array_equal(jacobians[at], right_jacobian(xi[at]))


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.0447, 0.2, 0.999 * EDGE, 1.001 * EDGE, 1.0])
def test_expressions_have_exact_first_and_second_derivatives(angle):
    twist = ca.SX.sym("twist", 6)
    pose = Pose(*exp6(twist))
    weights = np.random.default_rng(4).normal(size=18)
    relative = pose * Pose(ca.SX(pin.exp3(np.full(3, 0.01))), ca.SX(3, 1))
    outputs = ca.vertcat(
        ca.vec(pose.rotation), pose.position, log6(relative.rotation, relative.position)
    )
    scalar = ca.dot(weights, outputs)
    hessian, gradient = ca.hessian(scalar, twist)
    value, first, second = (
        ca.Function(n, [twist], [e]) for n, e in (("v", scalar), ("g", gradient), ("h", hessian))
    )
    xi = np.r_[0.3, -0.2, 0.5, angle * np.array([0.36, 0.48, 0.8])]
    assert_derivative(
        np.asarray(first(xi)).reshape(1, 6), lambda u: np.asarray(value(u)).ravel(), xi
    )
    assert_derivative(np.asarray(second(xi)), lambda u: np.asarray(first(u)).ravel(), xi)
