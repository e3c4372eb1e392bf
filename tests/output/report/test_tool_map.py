"""Maps of the tool error show the computed errors at their points."""

from __future__ import annotations

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from calibrated import EXPERIMENT_2, calibrated, identified
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from matplotlib.text import Text

from orthocal import Choice, load_plan, simulate_session
from orthocal.assessment.tool_error import assess_tool
from orthocal.kinematics.workspace import Workspace, box_workspace, cube
from orthocal.output.report import figure as style
from orthocal.output.report import tool_map
from orthocal.printers.settings import DeltaSettings
from orthocal.robot.model import Tcp
from orthocal.units import MM

SVG = "{http://www.w3.org/2000/svg}"

GRID = 1e-9
"""[µm] Splines at the points that they go through."""

BETWEEN = 1e-3
"""Relative: polynomials of the fourth degree over a region of 120 mm."""

CONTOUR = 0.2
"""[mm] Contours of a length between points of the drawn grid, 3 mm apart."""


@pytest.fixture(scope="module")
def table1(experiment_2):
    return identified(experiment_2, Choice(model="lengths", prior=True))


@pytest.fixture(scope="module")
def accuracy(table1):
    return assess_tool(table1)


@pytest.fixture(scope="module")
def planar(root, tmp_path_factory):
    """A robot that moves in a plane."""
    folder = tmp_path_factory.mktemp("planar")
    (folder / "plan.yaml").write_text(
        f"robot: {root}/tests/robots/biglide\n"
        "gauge: {sigma_mm: 0.01}\n"
        "postures:\n  zero: {tcp_mm: [0, 0]}\n  x_max: {tcp_mm: [40, 0]}\n"
        "  x_min: {tcp_mm: [-60, 0]}\n  y_max: {tcp_mm: [0, 40]}\n  y_min: {tcp_mm: [0, -60]}\n"
        "setups:\n"
        "  yx: {leg: x, direction: y, section: {fraction: 0.5}, postures: [zero, x_max, x_min]}\n"
        "  xy: {leg: y, direction: x, section: {fraction: 0.5}, postures: [zero, y_max, y_min]}\n"
    )
    truth = {"x_slide.offset": 0.7e-3, "y_slide.offset": -1.1e-3}
    plan = load_plan(folder / "plan.yaml")
    return identified(simulate_session(plan, truth, seed=1).session)


@pytest.fixture(scope="module")
def maps(table1, accuracy):
    kinds = ("now", "uncertainty")
    return {which: tool_map.plot_tool_map(table1, accuracy, which=which) for which in kinds}


def draw(calibration, accuracy, which):
    with style.house_style():
        return tool_map._draw_tool_map(calibration, accuracy, which)


def with_error(accuracy, function):
    """The accuracy with another deviation: a function of x, y and z in mm, in µm."""
    deviation = np.stack(np.broadcast_arrays(*function(*accuracy.targets.T * 1e3)), axis=1)
    weights = np.zeros(len(deviation))  # no shift is taken out
    space = replace(accuracy.workspace, weights=weights)
    return replace(accuracy, deviation=deviation * 1e-6, workspace=space)


def contours(axes):
    """Level to the points of its line, in mm."""
    filled, *lines = [c for c in axes.collections if hasattr(c, "levels")]
    found = {}
    for drawn in lines:
        for level, path in zip(drawn.levels, drawn.get_paths(), strict=True):
            found[float(level)] = path.vertices
    return filled.levels, found


def arrows(axes):
    (found,) = (c for c in axes.collections if hasattr(c, "U"))
    return np.asarray(found.XY), np.stack([found.U, found.V], axis=1)


def texts(svg):
    return ["".join(e.itertext()) for e in ElementTree.fromstring(svg).iter(f"{SVG}text")]


def drawn_texts(figure):
    return [text.get_text() for text in figure.findobj(Text)]


def test_there_is_a_panel_for_each_plane_through_the_middle(maps):
    for which, svg in maps.items():
        shown = texts(svg)
        assert shown.count("x [mm]") == 2
        assert shown.count("y [mm]") == 2
        assert shown.count("z [mm]") == 2
        assert {"x = 0 mm", "y = 0 mm", "z = 0 mm", tool_map.TITLES[which]} <= set(shown)
        assert any("[µm]" in text for text in shown)
        assert "<image" not in svg
        root = ElementTree.fromstring(svg)
        assert root.get("aria-label").startswith(tool_map.TITLES[which])


def test_maps_of_one_page_share_no_ids(maps):
    found = []
    for which, svg in maps.items():
        found += [e.get("id") for e in ElementTree.fromstring(svg).iter() if e.get("id")]
        assert found[-1].startswith(f"tool-{which}-")
    assert len(set(found)) == len(found)


def test_sizes_are_those_of_the_error_in_question(table1, accuracy):
    def sizes(which):
        return np.linalg.norm(tool_map._error_parts(accuracy, which), axis=1)

    found = (accuracy.deviation, accuracy.deviation_with_entries)
    deviation, left = (np.linalg.norm(accuracy.align(v), axis=1) for v in found)
    np.testing.assert_allclose(sizes("now"), deviation * 1e6, rtol=GRID)
    np.testing.assert_allclose(sizes("entered"), left * 1e6, rtol=GRID)


def test_uncertainty_within_tolerances_is_that_of_the_assessment(planar):
    accuracy = assess_tool(planar)
    assert planar.tolerance_scale.factor == 1.0
    variance = np.trace(accuracy.after.aligned_covariance, axis1=1, axis2=2)
    sizes = tool_map._error_parts(accuracy, "uncertainty")[:, 0]
    np.testing.assert_allclose(sizes, np.sqrt(variance) * 1e6, rtol=GRID)


def test_the_scale_of_the_tolerances_is_stated():
    calibration = calibrated(EXPERIMENT_2)
    shown = drawn_texts(draw(calibration, assess_tool(calibration), "uncertainty"))
    excess = calibration.tolerance_scale.factor
    assert f"RMS uncertainty in space [µm], tolerances × {excess:.1f}" in shown


def test_the_map_between_its_points_is_that_of_the_machine(table1, accuracy):
    """Halfway between middle and end, by the machine itself."""
    robot, half = table1.robot, accuracy.workspace.half_side
    lines = tool_map._find_grid(accuracy.workspace.points)
    fine = assess_tool(table1, cube(robot, half_side=half, points_per_side=9))
    nine = tool_map._find_grid(fine.workspace.points)
    known = fine.deviation.reshape(9, 9, 9, 3)[:, :, 4] * 1e6
    cut = accuracy.deviation.reshape(5, 5, 5, 3)[:, :, 2] * 1e6
    between = tool_map._interpolate(lines[:2], cut)
    np.testing.assert_allclose(np.moveaxis(between(*nine[:2]), 0, -1), known, rtol=BETWEEN)


def test_contours_lie_where_the_error_has_their_size(table1, accuracy):
    sloping = with_error(accuracy, lambda x, y, z: (100.0 + x + 2.0 * z, 0.0, 0.0))
    panels = draw(table1, sloping, "now").axes[:3]
    for axes, across, along in zip(panels, (1.0, 1.0, 0.0), (0.0, 2.0, 2.0), strict=True):
        levels, lines = contours(axes)
        assert levels[0] <= 0.0
        assert levels[-1] >= 280.0
        assert len(lines) >= 2
        for level, points in lines.items():
            if level > 20.0:  # the length has an edge at zero
                value = np.abs(100.0 + across * points[:, 0] + along * points[:, 1])
                assert np.abs(value - level).max() < CONTOUR


def test_arrows_point_where_the_tool_is_off_to(table1, accuracy):
    constant = with_error(accuracy, lambda x, y, z: (30.0 + 0.0 * x, 40.0, 0.0))
    xy, xz, yz = draw(table1, constant, "now").axes[:3]
    for axes, (u, v) in ((xy, (0.6, 0.8)), (xz, (1.0, 0.0)), (yz, (1.0, 0.0))):
        place, vector = arrows(axes)
        assert len(place) == 9
        every = [(x, y) for y in (-40.0, 0.0, 40.0) for x in (-40.0, 0.0, 40.0)]
        np.testing.assert_allclose(place, every, atol=GRID)
        length = np.linalg.norm(vector, axis=1)
        np.testing.assert_allclose(vector / length[:, None], [[u, v]] * 9, atol=GRID)
        assert (length < 40.0).all()  # none reaches the next
    turning = with_error(accuracy, lambda x, y, z: (-y, x, 0.0 * z))
    place, vector = arrows(draw(table1, turning, "now").axes[0])
    np.testing.assert_allclose(vector[:, 0] * 40.0, -place[:, 1] * vector.max(), atol=GRID)
    np.testing.assert_allclose(vector[:, 1] * 40.0, place[:, 0] * vector.max(), atol=GRID)


def test_arrows_and_labels_of_a_flat_workspace_are_inside(table1):
    box = np.array([[-60, 60], [-10, 10], [-60, 60]]) * MM
    figure = draw(table1, assess_tool(table1, box_workspace(table1.robot, box)), "now")
    place, vector = arrows(figure.axes[0])  # across the flat side
    assert np.abs(place[:, 1] + 0.5 * vector[:, 1]).max() < 10.0
    assert np.linalg.norm(vector, axis=1).max() < 20.0 / 3.0
    assert figure.axes[0].texts


def test_uncertainty_has_no_arrows(table1, accuracy):
    for axes in draw(table1, accuracy, "uncertainty").axes[:3]:
        assert not [c for c in axes.collections if hasattr(c, "U")]


@pytest.mark.parametrize(("size", "number"), [(0.0, "0.0"), (1e6, "1000000")])
def test_a_constant_error_is_printed_as_a_number(table1, accuracy, size, number):
    same = with_error(accuracy, lambda x, y, z: (0.0 * x, 0.0, size))
    shown = drawn_texts(draw(table1, same, "now"))
    assert shown.count(f"{number} µm everywhere") == 3


def test_labels_of_levels_differ_however_little_the_error_does(table1, accuracy):
    error = with_error(accuracy, lambda x, y, z: (1e4 * (1.0 + 1e-7 * x), 0.0, 0.0 * y))
    figure = draw(table1, error, "now")
    with style.house_style():
        figure.draw_without_rendering()
    bar = [t.get_text() for t in figure.axes[-1].get_xticklabels()]
    assert len(set(bar)) == len(bar) >= 3


def test_contours_are_labelled_inside_the_panel_and_off_the_arrows(table1, accuracy):
    axes = draw(table1, accuracy, "now").axes[0]
    _, lines = contours(axes)
    labels = {float(t.get_text()): np.array(t.get_position()) for t in axes.texts}
    assert labels
    assert set(labels) <= set(lines)
    for place in labels.values():
        assert np.abs(place).max() < 60.0 - 0.05 * 120.0
    points = [np.array([[x, 0.0] for x in np.linspace(-60.0, 60.0, 41)])]
    side = np.linspace(-60.0, 60.0, 43)
    arrow = np.array([[0.0, 0.0], [30.0, 0.0]])
    (place,) = tool_map._place_labels(points, side, side, arrow)
    assert place == (-39.0, 0.0)  # twice as far from the arrow as from the border
    corner = [np.array([[-60.0, -57.0], [-57.0, -60.0]])]
    assert tool_map._place_labels(corner, side, side, arrow) == []


def test_lines_can_be_read_on_their_colour():
    levels = np.array([0.0, 10.0, 20.0])
    assert tool_map._ink(levels, 4.0) == "white"
    assert tool_map._ink(levels, 16.0) == "black"
    dark, light = (np.mean(to_rgb(colormaps[tool_map.COLOURS](share))) for share in (0.0, 1.0))
    assert dark < 0.4 < 0.6 < light


def test_a_planar_robot_has_one_plane(planar):
    accuracy = assess_tool(planar, cube(planar.robot, half_side=0.02))
    figure = draw(planar, accuracy, "now")
    panel, _ = figure.axes
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("x [mm]", "y [mm]")
    assert panel.get_title(loc="left") == ""
    assert tool_map.plot_tool_map(planar, accuracy, which="now")


def test_axes_are_the_coordinates_that_the_drives_control(planar):
    accuracy = assess_tool(planar, cube(planar.robot, half_side=0.02))
    turned = replace(planar.robot, tcp=Tcp(planar.robot.tcp.frame, (1, 0)))
    calibration = replace(planar, robot=turned)
    error = with_error(accuracy, lambda x, y, z: (0.0 * x, 5.0, 0.0))
    panel, _ = draw(calibration, error, "now").axes
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("y [mm]", "x [mm]")
    _, vector = arrows(panel)
    assert (vector[:, 0] > 0.0).all()
    np.testing.assert_allclose(vector[:, 1], 0.0, atol=GRID)


def test_no_map_without_uncertainty_further_errors_or_offsets_to_enter(table1, accuracy):
    assert draw(table1, replace(accuracy, after=None), "uncertainty") is None
    settings = DeltaSettings("klipper", 0.14, (0.28,) * 3, (0.56,) * 3)
    printer = replace(table1, session=replace(table1.session, firmware=settings))
    assert draw(printer, accuracy, "entered") is None
    assert draw(printer, accuracy, "now")
    offsets = replace(table1, parameters=table1.parameters[:3])
    assert draw(offsets, accuracy, "entered") is None
    assert draw(offsets, accuracy, "now")


@pytest.mark.parametrize("points_per_side", [2, 4])
def test_a_grid_without_a_middle_has_no_map(orthoglide, points_per_side):
    points = cube(orthoglide, points_per_side=points_per_side).points
    assert tool_map._find_grid(points) is None


def test_points_that_are_no_grid_have_no_map(table1, accuracy, orthoglide):
    points = cube(orthoglide, points_per_side=3).points
    assert len(tool_map._find_grid(points)) == 3
    line = np.linspace(-0.06, 0.06, 5)[:, None]
    for other in (points[:-1], points[::-1], line, points + np.eye(27, 3) * 1e-3):
        assert tool_map._find_grid(other) is None
    some = replace(accuracy, workspace=Workspace.even([[0.0, 0.0, 0.0], [0.01, 0.02, 0.03]]))
    assert tool_map.plot_tool_map(table1, some, which="now") == ""
