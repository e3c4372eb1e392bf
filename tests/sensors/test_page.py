"""The setups that the page of sensors shows: read, simulated and calibrated."""

from __future__ import annotations

import re

import numpy as np
import pytest
import yaml
from conftest import ROOT

from orthocal import draw_errors, load_plan, simulate_session
from orthocal.assessment.judgement import judge_session
from orthocal.sensors.registry import sensor_kinds

BLOCKS = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs/sensors.md").read_text(), re.S)
GAUGE = {"sigma_mm": 0.005}
CIRCLE = {
    f"p{k}": {"tcp_mm": [float(50 * np.cos(a)), float(50 * np.sin(a)), -20.0]}
    for k, a in enumerate(2.0 * np.pi * np.arange(12) / 12.0)
}


@pytest.mark.parametrize("block", BLOCKS)
def test_setups_of_the_page_are_simulated_and_judged_sound(tmp_path, block):
    document = {"robot": "orthoglide", "postures": CIRCLE, "controller": {"offsets_mm": [0, 0, 0]}}
    shown = yaml.safe_load(block)
    gauges = {name: {**g, "range_mm": [-20, 20]} for name, g in shown.get("gauges", {}).items()}
    document |= shown | ({"gauges": gauges} if gauges else {"gauge": GAUGE})
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(document))
    plan = load_plan(tmp_path / "plan.yaml")
    names = plan.robot.parameters.select_model("full")
    errors = draw_errors(plan.robot, names, seed=1, tolerances={"*.offset_mm": 1.0})
    session = simulate_session(plan, errors, seed=1).session
    assert {f.severity for f in judge_session(session).findings} <= {"note"}


def test_the_page_shows_every_kind():
    shown = {k for block in BLOCKS for k in re.findall(r"sensor: (\w+)", block)}
    assert shown <= set(sensor_kinds())
    assert shown >= {"ball_bar", "tool_indicator", "probe", "points"}
