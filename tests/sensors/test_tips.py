"""Closed forms of touching, against bisection on the distance between solids."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from derivatives import central_differences

from orthocal.sensors.tips import touch_by_ball, touch_by_blade

COUNT = 80
AGREED = 1e-9


def draw(rng):
    """A rod, and a plunger more or less across it; legs within 0.3 of square."""
    u = rng.normal(size=3)
    u /= np.linalg.norm(u)
    d = np.cross(u, rng.normal(size=3))
    d = d / np.linalg.norm(d) + 0.3 * rng.normal(size=3)
    d /= np.linalg.norm(d)
    a = rng.normal(size=3)
    return a, u, d, rng.uniform(0.0, 0.01) * (rng.random() > 0.2), rng.uniform(1e-4, 5e-3)


def distance_to_axis(point, a, u):
    """By the nearest point of the axis."""
    return np.linalg.norm(point - (a + ((point - a) @ u) * u))


def distance_of_lines(p, e, a, u):
    """Of an endless edge and an endless axis: the least over both of them, by least squares."""
    s = np.linalg.lstsq(np.column_stack([e, -u]), a - p, rcond=None)[0]
    return np.linalg.norm(p + s[0] * e - (a + s[1] * u))


def moving(distance, start, direction, *rest):
    """A distance as a function of how far a tip has moved."""
    return lambda h: distance(start + h * direction, *rest)


def come_near(distance, touching, far):
    """The largest h at which solids touch, by bisection; None where they never do.

    The distance is convex in h: first where it is least, then from there outwards.
    """
    low, high = -far, far
    for _ in range(120):
        a, b = low + (high - low) / 3.0, high - (high - low) / 3.0
        low, high = (low, b) if distance(a) < distance(b) else (a, high)
    near, outside = 0.5 * (low + high), far
    if distance(near) > touching:
        return None
    for _ in range(100):
        middle = 0.5 * (near + outside)
        near, outside = (middle, outside) if distance(middle) < touching else (near, middle)
    return 0.5 * (near + outside)


def evaluate(form, **values):
    return float(form(**{k: ca.SX(np.asarray(v, dtype=float)) for k, v in values.items()}))


def test_a_ball_touches_where_solids_do():
    rng, touched, missed = np.random.default_rng(0), 0, 0
    for _ in range(COUNT):
        a, u, d, r, ball = draw(rng)
        c = a + rng.uniform(-0.2, 0.2) * u + rng.uniform(-0.01, 0.01, 3)
        found = evaluate(touch_by_ball, point=a, along=2.0 * u, radius=r + ball, tip=c, direction=d)
        expected = come_near(moving(distance_to_axis, c, d, a, u), r + ball, 0.05)
        if expected is None:
            missed += 1
            assert np.isnan(found)
        else:
            touched += 1
            assert found == pytest.approx(expected, abs=AGREED)
    assert touched > 30
    assert missed > 5


def test_a_blade_touches_where_solids_do():
    """Its edge, an endless line, comes as near to the rod's axis as the radius."""
    rng = np.random.default_rng(1)
    for _ in range(40):
        a, u, d, r, _ = draw(rng)
        e = np.cross(u, d) + 0.1 * rng.normal(size=3)
        c = a + rng.uniform(-0.2, 0.2) * u + rng.uniform(-0.01, 0.01, 3)
        r = max(r, 1e-5)
        found = evaluate(
            touch_by_blade, point=a, along=0.3 * u, radius=r, edge=-2.0 * e, tip=c, direction=d
        )
        expected = come_near(moving(distance_of_lines, c, d, e, a, u), r, 0.2)
        assert found == pytest.approx(expected, abs=AGREED)


def test_without_a_radius_a_blade_reads_the_axis_in_the_edges_plane():
    """The paper's reading: the coordinate of the line where the section's plane cuts it."""
    rng = np.random.default_rng(2)
    for _ in range(100):
        a, u, _, _, _ = draw(rng)
        axis = np.array([1.0, 0.0, 0.0])
        d = np.array([0.0, 1.0, 0.0])
        u = axis + 0.1 * u  # nearly along the leg
        plane = rng.uniform(-0.1, 0.1)
        crossing = a + (plane - a[0]) / u[0] * u
        tip = np.array([plane, 0.0, 0.0])
        found = evaluate(
            touch_by_blade,
            point=a,
            along=u,
            radius=0.0,
            edge=np.cross(axis, d),
            tip=tip,
            direction=d,
        )
        assert found == pytest.approx(crossing[1], abs=1e-12)


@pytest.mark.parametrize("form", [touch_by_ball, touch_by_blade])
def test_slopes_are_central_differences(form):
    rng = np.random.default_rng(3)
    names = {"point": 3, "along": 3, "radius": 1, "tip": 3, "direction": 3}
    if form is touch_by_blade:
        names["edge"] = 3
    symbols = {n: ca.SX.sym(n, k) for n, k in names.items()}
    x = ca.vertcat(*symbols.values())
    h = form(**symbols)
    value, slope = ca.Function("h", [x], [h]), ca.Function("s", [x], [ca.jacobian(h, x)])
    for _ in range(50):
        a, u, d, r, ball = draw(rng)
        given = {"point": a, "along": u, "radius": [r + ball], "tip": a + 0.1 * u, "direction": d}
        if form is touch_by_blade:
            given["edge"] = np.cross(u, d)
        at = np.concatenate([given[n] for n in names])
        found = central_differences(lambda v: np.array(value(v)).reshape(-1), at)
        assert np.asarray(slope(at)) == pytest.approx(found, abs=2e-6)
