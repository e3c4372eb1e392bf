"""Where the tip of a plunger touches a round rod: closed forms.

A rod has the axis a + s u and the radius r. The plunger moves along the unit vector d, in which the
reading h grows: it stands on the rod's d side. Its tip is at c + h d.

- A blade is an edge along e: it touches where the plane through the edge and along the rod is a
  radius away from the rod's axis. With n = e × u, turned so that n · d > 0,

      h = ((a − c) · n + r |n|)/(d · n);

  without a radius that is where the edge meets the axis. A pin as edge adds its radius to r.
- A ball of radius R touches where |(c + h d − a) × u| = r + R; of the two roots the larger. Where
  there is none the plunger passes the rod.
"""

from __future__ import annotations

import casadi as ca


def touch_by_blade(
    *, at: ca.SX, along: ca.SX, radius: ca.SX, edge: ca.SX, tip: ca.SX, direction: ca.SX
) -> ca.SX:
    """What an indicator with a blade reads, [m].

    Args:
        at: A point of the rod's axis, shape (3,), [m].
        along: The rod's axis, of any length, shape (3,).
        radius: Of the rod, and of the edge where that is a pin, [m].
        edge: The blade's edge, of any length, shape (3,).
        tip: A point of the edge at reading 0, shape (3,), [m].
        direction: Of the plunger, in which the reading grows; a unit vector, shape (3,).
    """
    normal = ca.cross(edge, along)
    normal = normal * ca.sign(ca.dot(normal, direction))
    return (ca.dot(at - tip, normal) + radius * ca.norm_2(normal)) / ca.dot(direction, normal)


def touch_by_ball(*, at: ca.SX, along: ca.SX, radius: ca.SX, tip: ca.SX, direction: ca.SX) -> ca.SX:
    """What an indicator with a ball reads, [m]; NaN where it passes the rod.

    Args:
        at: A point of the rod's axis, shape (3,), [m].
        along: The rod's axis, of any length, shape (3,).
        radius: Of the rod and the ball together, [m].
        tip: The ball's centre at reading 0, shape (3,), [m].
        direction: Of the plunger, in which the reading grows; a unit vector, shape (3,).
    """
    unit = along / ca.norm_2(along)
    apart = tip - at
    apart = apart - ca.dot(apart, unit) * unit
    across = direction - ca.dot(direction, unit) * unit
    square, mixed = ca.dot(across, across), ca.dot(apart, across)
    rest = mixed**2 - square * (ca.dot(apart, apart) - radius**2)
    return (ca.sqrt(rest) - mixed) / square
