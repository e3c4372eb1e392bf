"""Random programs with their motions, and a reader of polylines, independent of orthocal."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

NORMALS = {17: (0.0, 0.0, 1.0), 18: (0.0, 1.0, 0.0), 19: (1.0, 0.0, 0.0)}
CENTRES = {17: (0, 1), 18: (0, 2), 19: (1, 2)}
INCH = 25.4


@dataclass
class Move:
    """A motion in machine coordinates, [mm]."""

    number: int
    start: np.ndarray
    end: np.ndarray
    feed: float | None
    """[mm/min]; None for a rapid motion."""
    centre: np.ndarray | None = None
    normal: np.ndarray | None = None
    angle: float = 0.0

    def sample(self, count):
        """Points of the motion, by Rodrigues' rotation about its centre, shape (count, 3)."""
        t = np.linspace(0.0, 1.0, count)[:, None]
        if self.centre is None:
            return self.start + t * (self.end - self.start)
        arm, n = self.start - self.centre, self.normal
        phi = self.angle * t
        turned = (
            arm * np.cos(phi) + np.cross(n, arm) * np.sin(phi) + n * (n @ arm) * (1 - np.cos(phi))
        )
        return self.centre + turned + t * n * (n @ (self.end - self.start))

    @property
    def length(self):
        points = self.sample(2 if self.centre is None else 1001)
        return np.linalg.norm(np.diff(points, axis=0), axis=1).sum()


@dataclass
class Program:
    text: list[str] = field(default_factory=list)
    moves: list[Move] = field(default_factory=list)


def random_program(seed, *, moves=12, box=40.0, offset=(0.0, 0.0, 0.0), inches=True):
    """A program of lines, arcs, helices and full circles in all modes."""
    rng = np.random.default_rng(seed)
    program = Program()
    offset = np.array(offset)
    unit, absolute, plane, arc_absolute, feed = 1.0, True, 17, False, None
    at = rng.uniform(-0.5, 0.5, 3) * box
    program.text.append("G21 G90 G17 G94 G91.1 (begins)")
    program.text.append(f"N1 G0 {words('XYZ', at - offset, 1.0)}")
    at = written(at - offset, 1.0) + offset
    program.moves.append(Move(1, at, at, None))
    for number in range(2, moves + 2):
        modes = []
        if rng.random() < 0.3:
            absolute = not absolute
            modes.append("G90" if absolute else "G91")
        if inches and rng.random() < 0.2:
            unit = INCH if unit == 1.0 else 1.0
            modes.append("G20" if unit == INCH else "G21")
            feed = None
        if rng.random() < 0.3:
            arc_absolute = not arc_absolute
            modes.append("G90.1" if arc_absolute else "G91.1")
        if rng.random() < 0.4:
            plane = int(rng.choice([17, 18, 19]))
            modes.append(f"G{plane}")
        if modes:
            program.text.append(" ".join(modes))
        kind = rng.choice(["G0", "G1", "G2", "G3"], p=[0.1, 0.3, 0.3, 0.3])
        feed_word = ""
        if kind != "G0" and (feed is None or rng.random() < 0.3):
            feed = written(float(rng.uniform(100, 2000)) / unit, 1.0) * unit
            feed_word = f" F{feed / unit:.4f}"
        base = offset if absolute else at
        normal = np.array(NORMALS[plane])
        if kind in ("G0", "G1"):
            end = base + written(rng.uniform(-1, 1, 3) * box - base, unit)
            move = Move(number, at, end, None if kind == "G0" else feed)
            axes = words("XYZ", end - base, unit)
        else:
            sign = 1.0 if kind == "G3" else -1.0
            i, j = CENTRES[plane]
            radius = rng.uniform(2.0, 25.0)
            toward = -at + rng.normal(size=3) * 5.0
            toward -= normal * (normal @ toward)
            arm = radius * toward / np.linalg.norm(toward)
            center_base = offset if arc_absolute else at
            centre = center_base + written(at + arm - center_base, unit)
            centre = np.where(normal > 0, at, centre)
            full = rng.random() < 0.2
            angle = 2 * np.pi if full else rng.uniform(0.2, 6.0)
            end = Move(0, at, at, None, centre, normal, sign * angle).sample(2)[1]
            if rng.random() < 0.4:
                end = end + normal * (rng.uniform(-10, 10) - normal @ at * 0.3)
            end = at + normal * (normal @ (end - at)) if full else end
            exact = base + written(end - base, unit)
            exact = np.where((normal == 0) & full, at, exact)
            first, last = at - centre, exact - centre
            first, last = (v - normal * (normal @ v) for v in (first, last))
            if not full:
                turned = np.arctan2(sign * normal @ np.cross(first, last), first @ last)
                angle = turned % (2 * np.pi)
            turns = int(rng.integers(1, 4)) if rng.random() < 0.2 else 1
            move = Move(
                number, at, exact, feed, centre, normal,
                sign * (angle + 2 * np.pi * (turns - 1)),
            )  # fmt: skip
            names = "".join("XYZ"[k] for k in range(3) if not (full and k in (i, j)))
            axes = words(names, [(exact - base)["XYZ".index(c)] for c in names], unit)
            if not full and turns == 1 and rng.random() < 0.25 and 0.5 < angle < 5.5:
                r = np.linalg.norm(first) * (1.0 if angle < np.pi else -1.0)
                if abs(angle - np.pi) > 0.3:
                    axes += f" R{r / unit:.9f}"
                else:
                    axes += center_words(centre - center_base, i, j, unit)
            else:
                axes += center_words(centre - center_base, i, j, unit)
            axes += f" P{turns}" if turns > 1 else ""
            end = exact
        program.text.append(f"N{number} {kind} {axes}{feed_word} (move {number})")
        program.moves.append(move)
        at = end
    program.text.append("M2")
    return program


def written(value, unit):
    """A value in mm, rounded to six decimals in another unit."""
    return np.round(np.asarray(value) / unit, 6) * unit


def words(names, values, unit):
    return " ".join(f"{n}{v / unit:.6f}" for n, v in zip(names, values, strict=True))


def center_words(values, i, j, unit):
    return f" {'IJK'[i]}{values[i] / unit:.6f} {'IJK'[j]}{values[j] / unit:.6f}"


def read_polyline(lines, offset=(0.0, 0.0, 0.0)):
    """Points and feeds of a program of G0 and G1 by line number, [mm], [mm/min]."""
    points, number, at = {}, 0, np.full(3, np.nan)
    unit, absolute, feed, rapid = 1.0, True, None, None
    for line in lines:
        text = re.sub(r"\([^)]*\)", "", line).split(";")[0]
        pairs = [(a, float(b)) for a, b in re.findall(r"([A-Z])([-+.0-9]+)", text)]
        codes = {b for a, b in pairs if a == "G"}
        assert not codes & {2.0, 3.0}
        unit = INCH if 20.0 in codes else 1.0 if 21.0 in codes else unit
        absolute = True if 90.0 in codes else False if 91.0 in codes else absolute
        rapid = True if 0.0 in codes else False if 1.0 in codes else rapid
        feed = next((b * unit for a, b in pairs if a == "F"), feed)
        number = next((int(b) for a, b in pairs if a == "N"), number)
        moved = {a: b for a, b in pairs if a in "XYZ"}
        if moved:
            old = np.array(at)
            for k, name in enumerate("XYZ"):
                if name in moved:
                    at[k] = moved[name] * unit + (offset[k] if absolute else old[k])
            points.setdefault(number, []).append((np.array(at), None if rapid else feed))
    return points


AT_ONCE = 100_000
"""Number of pairs of a point and a piece of a polyline that are compared at once."""


def distances(points, polyline):
    """Distances of points from a polyline, shape (k,)."""
    a, along = polyline[:-1], np.diff(polyline, axis=0)
    square = np.maximum(np.einsum("ij,ij->i", along, along), 1e-30)
    result, step = [], max(1, AT_ONCE // len(a))
    for first in range(0, len(points), step):
        away = points[first : first + step, None] - a
        t = np.clip(np.einsum("kij,ij->ki", away, along) / square, 0.0, 1.0)
        result.append(np.linalg.norm(away - t[..., None] * along, axis=2).min(axis=1))
    return np.concatenate(result)


def own_distances(points, polyline):
    """Distances of points from their segments, with equally many points each, shape (k,)."""
    each = (len(points) - 1) // (len(polyline) - 1)
    piece = np.minimum(np.arange(len(points)) // each, len(polyline) - 2)
    a, along = polyline[piece], np.diff(polyline, axis=0)[piece]
    square = np.maximum(np.einsum("ij,ij->i", along, along), 1e-30)
    t = np.clip(np.einsum("ij,ij->i", points - a, along) / square, 0.0, 1.0)
    return np.linalg.norm(a + t[:, None] * along - points, axis=1)


def rigid_motion(before, after, weights):
    """Rotation R and translation t that best map points p to R p + t (Kabsch 1976).

    The weights of the points have the sum 1.
    """
    first, second = weights @ before, weights @ after
    u, _, vt = np.linalg.svd((weights[:, None] * (after - second)).T @ (before - first))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation, second - rotation @ first
