"""A line drawing as an inline `<svg>`: polygons, lines, arrows and words on paper, in mm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.io.html import escape

Array = NDArray[np.float64]

TEXT = 3.1
"""Height of words, [mm on paper]."""

HEAD = 2.2
"""Length of an arrow's head, [mm on paper]."""


@dataclass(slots=True)
class Drawing:
    """What is drawn, the later above the earlier; places in mm on paper, y downwards."""

    width: float
    height: float
    parts: list[str] = field(default_factory=list)

    def polygon(
        self, points: Array, *, fill: str, stroke: str = "#555", width: float = 0.2
    ) -> None:
        """A closed outline, points of shape (n, 2)."""
        self.parts.append(
            f'<polygon points="{_pairs(points)}" fill="{fill}" stroke="{stroke}" '
            f'stroke-width="{width:g}" stroke-linejoin="round"/>'
        )

    def line(
        self, points: ArrayLike, *, stroke: str = "#111", width: float = 0.4, dash: str = ""
    ) -> None:
        """A line through points, shape (n, 2)."""
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        self.parts.append(
            f'<polyline points="{_pairs(np.asarray(points))}" fill="none" stroke="{stroke}" '
            f'stroke-width="{width:g}"{dashed}/>'
        )

    def circle(
        self,
        centre: ArrayLike,
        radius: float,
        *,
        fill: str = "none",
        stroke: str = "#111",
        width: float = 0.3,
    ) -> None:
        """A circle."""
        x, y = np.asarray(centre)
        self.parts.append(
            f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{radius:.2f}" fill="{fill}" '
            f'stroke="{stroke}" stroke-width="{width:g}"/>'
        )

    def arrow(
        self,
        foot: ArrayLike,
        tip: ArrayLike,
        *,
        stroke: str,
        width: float = 0.6,
        both: bool = False,
    ) -> None:
        """An arrow, or one with heads at both ends; nothing where it has no length."""
        a, b = np.asarray(foot, dtype=np.float64), np.asarray(tip, dtype=np.float64)
        length = float(np.linalg.norm(b - a))
        if length < 0.5:
            return
        along = (b - a) / length
        head = min(HEAD + width, 0.6 * length)
        start = a + (0.8 * head * along if both else 0.0)
        self.line([start, b - 0.8 * head * along], stroke=stroke, width=width)
        self._head(b, along, head, stroke)
        if both:
            self._head(a, -along, head, stroke)

    def _head(self, tip: Array, along: Array, length: float, colour: str) -> None:
        side = 0.38 * length * np.array([-along[1], along[0]])
        foot = tip - length * along
        self.polygon(
            np.array([tip, foot + side, foot - side]), fill=colour, stroke=colour, width=0.1
        )

    def text(
        self,
        place: ArrayLike,
        words: str,
        *,
        colour: str = "#111",
        anchor: str = "middle",
        size: float = TEXT,
        bold: bool = False,
    ) -> None:
        """Words around a place, or from it on (`start`), or up to it (`end`); kept on the paper."""
        x, y = np.asarray(place, dtype=np.float64)
        long = 0.56 * size * len(words)
        left = {"middle": 0.5, "start": 0.0, "end": 1.0}[anchor] * long
        x = min(max(x, left + 0.5), self.width - (long - left) - 0.5)
        y = min(max(y, 0.6 * size), self.height - 0.6 * size)
        weight = ' font-weight="bold"' if bold else ""
        self.parts.append(
            f'<text x="{x:.2f}" y="{y + 0.35 * size:.2f}" font-size="{size:g}" fill="{colour}" '
            f'text-anchor="{anchor}"{weight} stroke="#fff" stroke-width="0.8" '
            f'paint-order="stroke" stroke-linejoin="round">{escape(words)}</text>'
        )

    def to_svg(self, label: str) -> str:
        """The drawing as an element of a page.

        Args:
            label: What it shows, for those who do not see it.
        """
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width:g} '
            f'{self.height:g}" style="width:{self.width:g}mm;max-width:100%;height:auto" '
            f'role="img" aria-label="{escape(label)}" font-family="Helvetica, Arial, sans-serif">'
            f"<title>{escape(label)}</title>{''.join(self.parts)}</svg>"
        )


def outline(points: Array) -> Array:
    """The convex outline of points in the plane, shape (n, 2), in turn (Andrew's chain)."""
    ordered = np.unique(np.round(points, 6), axis=0)
    if len(ordered) < 3:
        return ordered

    def half(rows: Sequence[Array]) -> list[Array]:
        chain: list[Array] = []
        for row in rows:
            while len(chain) > 1 and _turn(chain[-2], chain[-1], row) <= 0.0:
                chain.pop()
            chain.append(row)
        return chain[:-1]

    rows = list(ordered)
    return np.array([*half(rows), *half(rows[::-1])])


def circle_points(count: int = 24) -> Array:
    """Points of the unit circle, shape (count, 2)."""
    turns = np.arange(count) * 2.0 * math.pi / count
    return np.column_stack([np.cos(turns), np.sin(turns)])


def _turn(a: Array, b: Array, c: Array) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _pairs(points: Array) -> str:
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in points)
