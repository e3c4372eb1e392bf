"""Circular deviation of ball-bar readings according to ISO 230-4.

The least-squares circle r + a cos φ + b sin φ is fitted to the readings (radii) at the angles φ. It
removes the position of the fixed ball and the length of the bar. The circular deviation G is the
range of the residuals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array
from orthocal.calibration.calibration import Calibration
from orthocal.estimation.diagnostics.residual_rows import ResidualRow
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.sensors.ball_bar import BallBar

FLATNESS = 1e-3
"""Largest singular value normal to the plane of a circle, relative to the largest in it."""

MIN_ARC = math.pi
"""Smallest arc that is evaluated as a circle, [rad]."""

MIN_READINGS = 6
"""Fewest readings of a circle: three more than the parameters of the fit."""


@dataclass(frozen=True, slots=True, eq=False)
class Circle:
    """Readings of a ball bar on a circle."""

    setup: str
    plane: str
    """Axes of the plane, such as xy: the first is at angle 0."""
    angles: Array
    """Angles of the readings, ascending, shape (n,), [rad]."""
    before: Array
    """Deviations from the least-squares circle as measured, shape (n,), [m]."""
    after: Array
    """Deviations with all identified errors corrected, shape (n,), [m]."""

    @property
    def g_before(self) -> float:
        """Circular deviation G as measured, [m]."""
        return float(np.ptp(self.before))

    @property
    def g_after(self) -> float:
        """Circular deviation G with all identified errors corrected, [m]."""
        return float(np.ptp(self.after))


def find_circles(calibration: Calibration) -> tuple[Circle, ...]:
    """Circles among the setups of a calibration, in the order of the setups."""
    robot = calibration.robot
    drives = {p.name: np.array(p.drives) for p in calibration.postures}
    circles = []
    for setup in calibration.setups:
        if not isinstance(setup.sensor, BallBar):
            continue
        bar = setup.sensor
        rows = [r for r in calibration.residuals if r.setup == setup.name and r.minus is None]
        if len(rows) < MIN_READINGS:
            continue
        active = calibration.active_offsets if setup.active is None else np.array(setup.active)
        commanded = np.array([drives[r.posture] for r in rows]) + active
        tool = nominal_closure(robot).forward(commanded)
        balls = tool + np.array(bar.tool) - np.array(bar.centre)
        circle = _fit_circle(setup.name, balls, rows)
        if circle is not None:
            circles.append(circle)
    return tuple(circles)


def _fit_circle(setup: str, balls: Array, rows: Sequence[ResidualRow]) -> Circle | None:
    """Circle of readings; None if the moving balls are not on a circle about the fixed ball.

    Args:
        setup: Name of the setup.
        balls: Nominal positions relative to the fixed ball, shape (n, 3), [m].
        rows: The readings.
    """
    _, singular_values, directions = np.linalg.svd(balls, full_matrices=False)
    normal = directions[2]
    if (
        singular_values[2] > FLATNESS * singular_values[0]
        or singular_values[1] < FLATNESS * singular_values[0]
    ):
        return None
    normal_axis = int(np.abs(normal).argmax())
    normal = normal * np.sign(normal[normal_axis])  # along the positive axis
    first = np.eye(3)[(normal_axis + 1) % 3]
    first = first - (first @ normal) * normal
    first /= np.linalg.norm(first)
    angles = np.arctan2(balls @ np.cross(normal, first), balls @ first) % (2.0 * math.pi)
    order = np.argsort(angles, kind="stable")
    gaps = np.diff(angles[order], append=angles[order][0] + 2.0 * math.pi)
    if 2.0 * math.pi - float(gaps.max()) < MIN_ARC:
        return None
    design = np.column_stack([np.ones(len(rows)), np.cos(angles), np.sin(angles)])

    def deviations(values: Array) -> Array:
        return np.asarray(values - design @ np.linalg.lstsq(design, values, rcond=None)[0])[order]

    plane = "".join("xyz"[(normal_axis + k) % 3] for k in (1, 2))
    return Circle(
        setup,
        plane,
        angles[order],
        deviations(np.array([r.measured for r in rows])),
        deviations(np.array([r.residual for r in rows])),
    )
