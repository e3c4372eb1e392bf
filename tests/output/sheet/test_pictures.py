"""Pictures of the sheet: labels that cover nothing, outlines that are convex, texts as texts."""

from __future__ import annotations

import re
from itertools import combinations, product

import numpy as np
import pytest
from browser import open_browser, visit
from calibrated import plan_of
from lxml import etree
from matplotlib.path import Path
from scipy.spatial import ConvexHull

from orthocal import load_plan
from orthocal.output.sheet.page import sheet_files
from orthocal.output.sheet.pictures import TOUCHED, Picture, outline

ROUNDED = 0.05
"""Browsers round the extent of glyphs, [mm]."""

SECTIONS = {
    "x": ("y", "z", "-y", "[0, 1, 1]"),
    "y": ("x", "-z", "[-1, 0, 2]"),
    "z": ("x", "-y", "[1, -1, 0]"),
}
TIPS = (
    "touches: a, beside_mm: [0, 0, 0], tip: {ball: {radius_mm: 1}}",
    "touches: b, beside_mm: [0, 0, 0], tip: {ball: {radius_mm: 8}}",
    "touches: a, tip: {blade: {width_mm: 44}}",
    "touches: b, tip: {blade: {width_mm: 60, radius_mm: 2}}",
)


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """Every leg, direction, rod and tip; aligned in `out`, where balls are off the middle."""
    setups = [
        f"  s{i}: {{leg: {leg}, direction: {way}, section: {{fraction: {at}}}{tip}}}"
        for i, (leg, way, at, tip) in enumerate(
            (leg, way, (0.3, 0.5, 0.7)[k % 3], tip)
            for leg, ways in SECTIONS.items()
            for k, (way, tip) in enumerate(
                product(ways, ("", *(f", {t}" for t in TIPS[leg != "x" :: 2])))
            )
        )
    ]
    path = tmp_path_factory.mktemp("plan") / "plan.yaml"
    path.write_text(
        "robot: orthoglide\ngauge: {range_mm: [-5, 5]}\n"
        "postures:\n  out: {tcp_mm: [2, -3, 3]}\n  far: {tcp_mm: [3, -4, 4]}\n"
        "setups:\n" + "\n".join(setups) + "\n"
    )
    return load_plan(path)


@pytest.fixture(scope="module")
def drawn(plan):
    """The pictures of all setups with their placed labels, and their SVG."""
    pictures = []
    place_labels = Picture.place_labels
    with pytest.MonkeyPatch.context() as patch:

        def place(picture):
            pictures.append((picture, place_labels(picture)))
            return pictures[-1][1]

        patch.setattr(Picture, "place_labels", place)
        page = sheet_files(plan)["sheet.html"]
    return pictures, re.findall(r"<svg.*?</svg>", page)


def box_of(label, middle):
    """Left, top, right and bottom, [mm]."""
    return (*(middle - label.half), *(middle + label.half))


def overlap(one, other):
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def test_no_label_overlaps_another_or_the_border(plan, drawn):
    pictures, _ = drawn
    assert len(pictures) == 2 * len(plan.setups) == 2 * 30
    texts = [label.text for picture, _ in pictures for label in picture.labels]
    assert sum("off centre" in text for text in texts) == 10
    for picture, placed in pictures:
        assert len(placed) == len(picture.labels)
        for one, other in combinations(placed, 2):
            assert not overlap(box_of(*one), box_of(*other)), (one[0].text, other[0].text)
        for label, middle in placed:
            assert (middle >= label.half).all(), label.text
            assert (middle + label.half <= (picture.width, picture.height)).all(), label.text


@pytest.mark.acceptance
def test_labels_in_a_browser_are_inside_their_boxes(drawn, tmp_path):
    """The real extent of the text, with the fonts that are installed."""
    pictures, svgs = drawn
    path = tmp_path / "sheet.html"
    path.write_text("".join(svgs))
    with open_browser() as browser, visit(browser, path.as_uri()) as found:
        extents = found.page.evaluate(
            """() => [...document.querySelectorAll('svg')].map((svg) =>
                 [...svg.querySelectorAll('text')].map((text) => text.getBBox()).map((box) =>
                   [box.x, box.y, box.x + box.width, box.y + box.height]))"""
        )
    for (_, placed), texts in zip(pictures, extents, strict=True):
        for one, other in combinations(texts, 2):
            assert not overlap(one, other)
        for (label, middle), extent in zip(placed, texts, strict=True):
            outside = np.abs(np.reshape(extent, (2, 2)) - middle) > label.half + ROUNDED
            assert not outside.any(), label.text


def test_no_part_hides_the_place_of_contact_on_a_rod():
    """A rail of the inclined machine is in front of the contacts of leg c."""
    page = sheet_files(plan_of("inclined_orthoglide"))["sheet.html"]
    svgs = [etree.fromstring(svg) for svg in re.findall(r"<svg.*?</svg>", page, re.DOTALL)]
    machines = [svg for svg in svgs if svg.get("aria-label").endswith("the gauge on the machine")]
    assert len(machines) == 6
    transparent = []
    for svg in machines:
        shapes = [
            (
                p.get("fill"),
                Path([[float(v) for v in q.split(",")] for q in p.get("points").split()]),
            )
            for p in svg.iter("{*}polygon")
        ]
        dot = next(c for c in svg.iter("{*}circle") if c.get("r") == "1.10")
        contact = float(dot.get("cx")), float(dot.get("cy"))
        sizes = [np.ptp(p.vertices, axis=0).max() * (fill == TOUCHED) for fill, p in shapes]
        over = [fill for fill, p in shapes[np.argmax(sizes) + 1 :] if p.contains_point(contact)]
        assert set(over) <= {"none"}
        transparent.append(len(over))
    assert transparent == [0, 0, 0, 0, 1, 1]


def test_a_label_keeps_off_lines_and_stays_near_its_point():
    picture = Picture(60.0, 40.0)
    picture.line([(5.0, 20.0), (55.0, 20.0)])
    picture.label((30.0, 20.0), "rod a")
    ((label, middle),) = picture.place_labels()
    assert abs(middle[1] - 20.0) > label.half[1]
    assert np.linalg.norm(middle - (30.0, 20.0)) < 5.0
    assert label.text == "rod a"


def test_labels_without_room_are_omitted():
    picture = Picture(20.0, 8.0)
    for text in ("first", "second", "a label that is longer than the paper"):
        picture.label((10.0, 4.0), text)
    assert [label.text for label, _ in picture.place_labels()] == ["first"]


def test_labels_are_texts():
    picture = Picture(60.0, 40.0)
    picture.label((-10.0, 90.0), "<script>&\x1b\nsecond")
    svg = etree.fromstring(picture.to_svg('"<b>').encode())
    assert svg.get("aria-label") == '"<b>'
    assert [line.text for line in svg.iter("{*}tspan")] == [r"<script>&\x1b", "second"]


@pytest.mark.parametrize("count", [3, 10, 200])
def test_outlines_are_convex_hulls(count):
    points = np.random.default_rng(count).normal(size=(count, 2))
    corners = outline(points)
    shifted = np.roll(corners, -1, axis=0)
    area = 0.5 * abs(np.sum(corners[:, 0] * shifted[:, 1] - corners[:, 1] * shifted[:, 0]))
    assert area == pytest.approx(ConvexHull(points).volume)


def test_points_in_a_line_have_their_ends_as_outline():
    points = np.array([[1.0, 1.0], [0.0, 0.0], [0.5, 0.5], [1.0, 1.0]])
    assert outline(points).tolist() == [[0.0, 0.0], [1.0, 1.0]]


def test_arrows_need_a_length():
    picture = Picture(60.0, 40.0)
    picture.arrow((1.0, 1.0), (1.0, 1.0), stroke="#000")
    assert picture.parts == []
    picture.arrow((1.0, 1.0), (9.0, 1.0), stroke="#000", both=True)
    assert len(picture.parts) == 3
