"""Sensors at the tool in files: plans come back, wrong keys are refused by name."""

from __future__ import annotations

import pytest
from ball_bar_plans import circles
from test_points import grid
from test_rods import plan as rods_plan
from test_tool_indicator import complete_plan

from orthocal import load_plan, write_session
from orthocal.errors import SessionError

PROBE = """robot: linear_delta
gauge: {sigma_mm: 0.01, range_mm: [-30, 30]}
postures: {a: {tcp_mm: [0, 0, 0]}, b: {tcp_mm: [60, 0, 0]}, c: {tcp_mm: [0, 60, 0]}}
setups: {bed: {sensor: probe, surface: {flat_tolerance_mm: 0.2}, tool_mm: [0, 0, -20]}}
"""


MIXED = """robot: orthoglide
gauges: {dial: {sigma_mm: 0.01}, tracker: {sigma_mm: 0.02}}
postures: {zero: {tcp_mm: [0, 0, 0]}, a: {tcp_mm: [60, 0, 0]}, b: {tcp_mm: [0, 60, 0]}}
setups:
  yx: {leg: x, direction: y, section: {fraction: 0.5}, gauge: dial, postures: [zero, a]}
  track: {sensor: points, covariance_um2: [[90, 40, 0], [40, 60, 0], [0, 0, 400]], gauge: tracker}
"""


def bar(folder):
    return circles(folder, length="0.5", keys=", scale_tolerance: 0.001", tool=(0, 0, -40))


def rods(folder):
    return rods_plan(folder, "pin")


def of_text(text):
    def make(folder):
        (folder / "plan.yaml").write_text(text)
        return load_plan(folder / "plan.yaml")

    return make


@pytest.mark.parametrize("make", [bar, complete_plan, rods, of_text(PROBE), of_text(MIXED)])
def test_a_plan_comes_back_from_its_files(tmp_path, make):
    """Each principal axis of a covariance has a gauge in the session, the file has one of all."""
    plan = make(tmp_path)
    again = load_plan(write_session(plan, tmp_path / "session", blank=True))
    for name, setup in plan.setups.items():
        read = again.setups[name]
        assert (read.sensor, read.zero) == (setup.sensor, setup.zero)
        sigma = plan.gauges[setup.gauge].sigma
        assert again.gauges[read.gauge].sigma == pytest.approx(sigma)
    assert [r.key for r in again.readings] == [r.key for r in plan.readings]


@pytest.mark.parametrize(
    ("make", "old", "new", "place"),
    [
        (bar, "centre_mm: [0, 0, -40],", "centre_mm: [0, 0, 0, 1],", "centre_mm"),
        (bar, "length_mm: 50.0, ", "", "length_mm"),
        (bar, "length_tolerance_mm: 0.5", "length_tolerance_mm: about", "length_tolerance_mm"),
        (bar, "centre_mm: [0, 0, -40],", "centre_mm: [0, 0, 9],", "setups.yz"),
        (complete_plan, "direction: y", "direction: w", "direction"),
        (complete_plan, "along: x", "along: y", "artefact.along"),
        (complete_plan, "kind: square", "kind: circle", "artefact"),
        (complete_plan, "height_mm: 50", "height_mm: 0.05", "height_mm"),
        (grid, "target_mm: [3.0, -4.0, -40.0]", "target_mm: [3.0]", "target_mm"),
        (grid, "sensor: points", "sensor: points, frame: known", "frame"),
        (
            grid,
            "sensor: points",
            "sensor: points, covariance_um2: [[1,0,0],[0,1,0],[0,0,-1]]",
            "covariance_um2",
        ),
        (grid, "track:", "tr[a]ck:", "tr[a]ck"),
    ],
)
def test_a_wrong_key_is_refused_by_name(tmp_path, make, old, new, place):
    make(tmp_path)
    file = tmp_path / "plan.yaml"
    file.write_text(file.read_text().replace(old, new, 1))
    with pytest.raises(SessionError) as caught:
        load_plan(file)
    assert place in str(caught.value.where)
