"""Circular deviations: circle fit by SciPy, planes by hand; arcs and spheres are no circles."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares
from tolerances import SAME_NUMBER

from orthocal.assessment.circular_deviation import find_circles
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.output.report.reading_plots import plot_circle
from orthocal.sensors.ball_bar import BallBar

CENTRE, TOOL, RADIUS = np.array([2e-3, -1e-3, -50e-3]), np.array([0.0, 0.0, -40e-3]), 0.05


def measured(robot, balls, readings, residuals, *, active=0.0):
    """What `find_circles` reads of a calibration with one ball bar."""
    drives = nominal_closure(robot).inverse(balls + CENTRE - TOOL) - active
    bar = BallBar(tuple(CENTRE), RADIUS, tool=tuple(TOOL))
    rows = [
        SimpleNamespace(setup="bar", posture=str(i), minus=None, measured=v, residual=r)
        for i, (v, r) in enumerate(zip(readings, residuals, strict=True))
    ]
    return SimpleNamespace(
        robot=robot,
        postures=[SimpleNamespace(name=str(i), drives=d) for i, d in enumerate(drives)],
        setups=[SimpleNamespace(name="bar", sensor=bar, active=None)],
        residuals=rows,
        active_offsets=np.full(3, active),
    )


def circle(plane, angles):
    balls = np.zeros((len(angles), 3))
    balls[:, ["xyz".index(k) for k in plane]] = RADIUS * np.column_stack(
        [np.cos(angles), np.sin(angles)]
    )
    return balls


@pytest.mark.parametrize("plane", ["xy", "yz", "zx"])
def test_it_is_the_range_about_the_least_squares_circle(orthoglide, plane):
    rng = np.random.default_rng(0)
    angles = rng.permutation(2.0 * np.pi * (np.arange(20) + 0.1) / 20.0)
    oval = 30e-6 * np.cos(2.0 * (angles - 0.4))
    readings = oval + 80e-6 + 1e-3 * np.cos(angles - 1.0) + 2e-6 * rng.normal(size=20)
    residuals = 2e-6 * rng.normal(size=20)
    (found,) = find_circles(
        measured(orthoglide, circle(plane, angles), readings, residuals, active=1e-3)
    )
    assert found.plane == plane
    np.testing.assert_allclose(found.angles, np.sort(angles), atol=1e-6)

    def misses(parameters):
        r, a, b = parameters
        return readings - r - a * np.cos(angles) - b * np.sin(angles)

    expected = misses(least_squares(misses, np.zeros(3), xtol=1e-15, gtol=1e-15, ftol=1e-15).x)
    np.testing.assert_allclose(found.before, expected[np.argsort(angles)], atol=SAME_NUMBER * 1e-3)
    assert found.g_before == pytest.approx(np.ptp(expected), rel=1e-5)
    assert found.g_before == pytest.approx(60e-6, rel=0.15)
    assert 1e-6 < found.g_after < 12e-6
    assert "G = " in plot_circle(found)


@pytest.mark.parametrize("angles", [np.linspace(0.0, 3.0, 20), np.linspace(0.0, 5.0, 5)])
def test_short_arcs_and_few_readings_are_no_circle(orthoglide, angles):
    nothing = np.zeros(len(angles))
    assert not find_circles(measured(orthoglide, circle("xy", angles), nothing, nothing))


def test_a_sphere_is_no_circle(orthoglide):
    balls = np.random.default_rng(1).normal(size=(20, 3))
    balls *= RADIUS / np.linalg.norm(balls, axis=1)[:, None]
    assert not find_circles(measured(orthoglide, balls, np.zeros(20), np.zeros(20)))
