"""Line drawings: texts are texts, outlines are convex, all stays on the paper."""

from __future__ import annotations

import numpy as np
import pytest
from lxml import etree
from scipy.spatial import ConvexHull

from orthocal.output.sheet.strokes import Drawing, outline


def test_words_are_texts_and_stay_on_the_paper():
    drawing = Drawing(60.0, 40.0)
    drawing.text((-10.0, 90.0), "<script>&\x1b")
    svg = etree.fromstring(drawing.to_svg('"<b>').encode())
    assert svg.get("aria-label") == '"<b>'
    (text,) = svg.findall("{*}text")
    assert text.text == r"<script>&\x1b"
    assert 0.0 < float(text.get("x")) < 60.0
    assert 0.0 < float(text.get("y")) < 40.0


@pytest.mark.parametrize("count", [3, 10, 200])
def test_an_outline_is_the_convex_hull(count):
    points = np.round(np.random.default_rng(count).normal(size=(count, 2)), 6)
    hull = points[ConvexHull(points).vertices]
    found = outline(points)
    assert {tuple(p) for p in found} == {tuple(p) for p in hull}
    shifted = np.roll(found, -1, axis=0)
    assert ConvexHull(points).volume == pytest.approx(
        0.5 * abs(np.sum(found[:, 0] * shifted[:, 1] - found[:, 1] * shifted[:, 0]))
    )


def test_points_in_a_line_have_an_outline():
    assert len(outline(np.array([[0.0, 0.0], [1.0, 1.0], [1.0, 1.0]]))) == 2


def test_an_arrow_without_length_is_none():
    drawing = Drawing(60.0, 40.0)
    drawing.arrow((1.0, 1.0), (1.0, 1.0), stroke="#000")
    assert drawing.parts == []
    drawing.arrow((1.0, 1.0), (9.0, 1.0), stroke="#000", both=True)
    assert len(drawing.parts) == 3
