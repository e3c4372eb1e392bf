"""Sound readings of a ball bar, whose search once ended at another machine."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from orthocal import draw_errors, load_plan, simulate_session
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.hypotheses.search import find_anomalies

CIRCLES = {"xy": (0, 1), "yz": (1, 2), "zx": (2, 0)}


@pytest.mark.parametrize("seed", [14, 26])
def test_a_known_bar_on_a_machine_with_large_offsets_is_not_accused(root, tmp_path, seed):
    """Without a hypothesis the search began at a machine that fits worse than the most likely."""
    doc = yaml.safe_load((root / "examples/inclined_orthoglide/plan.yaml").read_text())
    doc["gauges"] = {"dial": doc.pop("gauge") | {"range_mm": [-20, 20]}}
    doc["gauges"]["bar"] = {"sigma_mm": 0.002, "resolution_mm": 0.001, "range_mm": [-20, 20]}
    for setup in doc["setups"].values():
        setup["gauge"] = "dial"
    for plane, axes in CIRCLES.items():
        names = [f"{plane}{k}" for k in range(8)]
        for name, angle in zip(names, 2.0 * np.pi * np.arange(8) / 8, strict=True):
            point = np.zeros(3)
            point[list(axes)] = np.round([50.0 * np.cos(angle), 50.0 * np.sin(angle)], 3)
            doc["postures"][name] = {"tcp_mm": point.tolist()}
        bar = {"sensor": "ball_bar", "ball": "post", "centre_mm": [0, 0, 0], "gauge": "bar"}
        bar |= {"length_mm": 50, "length_tolerance_mm": 0.005, "postures": names}
        doc["setups"][f"bar_{plane}"] = bar
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(doc))
    plan = load_plan(tmp_path / "plan.yaml")
    tolerances = {"*.offset_mm": 4.0}
    errors = draw_errors(plan.robot, machine_errors(plan.robot), seed=seed, tolerances=tolerances)
    assert find_anomalies(simulate_session(plan, errors, seed=seed).session).found == ()
