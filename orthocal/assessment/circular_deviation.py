"""Circular deviation of ball-bar readings, as ISO 230-4 evaluates it.

The readings of a circle, as radii over the angle, are fitted by the least-squares circle
r + a cos φ + b sin φ, which removes the place of the fixed ball and the length of the bar. The
circular deviation G is the range of what remains.
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

FLAT = 1e-3
"""Largest distance of readings from one plane, in radii."""

LEAST_ARC = math.pi
"""Arc that readings must cover to be a circle, [rad]."""

FEWEST = 6
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
    """Deviations that remain with all identified errors corrected, shape (n,), [m]."""

    @property
    def g_before(self) -> float:
        """Circular deviation G as measured, [m]."""
        return float(np.ptp(self.before))

    @property
    def g_after(self) -> float:
        """Circular deviation G that remains, [m]."""
        return float(np.ptp(self.after))


def find_circles(calibration: Calibration) -> tuple[Circle, ...]:
    """Circles among the setups of a calibration, in their order."""
    robot = calibration.robot
    drives = {p.name: np.array(p.drives) for p in calibration.postures}
    circles = []
    for setup in calibration.setups:
        if not isinstance(setup.sensor, BallBar):
            continue
        bar = setup.sensor
        rows = [r for r in calibration.residuals if r.setup == setup.name and r.minus is None]
        if len(rows) < FEWEST:
            continue
        active = calibration.active_offsets if setup.active is None else np.array(setup.active)
        commanded = np.array([drives[r.posture] for r in rows]) + active
        tool = nominal_closure(robot).forward(commanded)
        balls = tool + np.array(bar.tool) - np.array(bar.centre)
        circle = _fit_circle(setup.name, balls, rows)
        circles += [] if circle is None else [circle]
    return tuple(circles)


def _fit_circle(setup: str, balls: Array, rows: Sequence[ResidualRow]) -> Circle | None:
    """Circle of readings; None if their balls lie on none about the fixed ball.

    Args:
        setup: Name of the setup.
        balls: Nominal positions from the fixed ball, shape (n, 3), [m].
        rows: The readings.
    """
    _, sizes, directions = np.linalg.svd(balls, full_matrices=False)
    normal = directions[2]
    if sizes[2] > FLAT * sizes[0] or sizes[1] < FLAT * sizes[0]:
        return None
    main = int(np.abs(normal).argmax())
    normal = normal * np.sign(normal[main])
    first = np.eye(3)[(main + 1) % 3]
    first = first - (first @ normal) * normal
    first /= np.linalg.norm(first)
    angles = np.arctan2(balls @ np.cross(normal, first), balls @ first) % (2.0 * math.pi)
    order = np.argsort(angles, kind="stable")
    gaps = np.diff(angles[order], append=angles[order][0] + 2.0 * math.pi)
    if 2.0 * math.pi - float(gaps.max()) < LEAST_ARC:
        return None
    design = np.column_stack([np.ones(len(rows)), np.cos(angles), np.sin(angles)])

    def remainder(values: Array) -> Array:
        return np.asarray(values - design @ np.linalg.lstsq(design, values, rcond=None)[0])[order]

    plane = "".join("xyz"[(main + k) % 3] for k in (1, 2))
    return Circle(
        setup,
        plane,
        angles[order],
        remainder(np.array([r.measured for r in rows])),
        remainder(np.array([r.residual for r in rows])),
    )
