"""Plans of ball bars."""

from __future__ import annotations

import numpy as np

from orthocal import load_plan

RADIUS_MM, POINTS = 50.0, 16
LEGS = """  leg_{d}{leg}: {{leg: {leg}, direction: {d}, section: {{fraction: 0.5}}, gauge: dial,
    postures: [zero, {leg}_max, {leg}_min]}}"""


def circles(folder, *, length="unknown", legs=False, keys="", zero="known", tool=(0, 0, 0)):
    """Plan with three circles of a bar about one fixed ball, and the paper's readings of legs."""
    postures, setups = ["  zero: {tcp_mm: [0, 0, 0]}"], []
    for plane, (i, j) in {"xy": (0, 1), "yz": (1, 2), "zx": (2, 0)}.items():
        names = []
        for k, angle in enumerate(2.0 * np.pi * np.arange(POINTS) / POINTS):
            point = np.zeros(3)
            point[[i, j]] = RADIUS_MM * np.cos(angle), RADIUS_MM * np.sin(angle)
            names.append(f"{plane}_{k}")
            postures.append(f"  {names[-1]}: {{tcp_mm: {point.round(9).tolist()}}}")
        setups.append(
            f"  {plane}: {{sensor: ball_bar, centre_mm: {list(tool)}, ball: post, gauge: bar, "
            f"length_mm: {RADIUS_MM}, length_tolerance_mm: {length}, zero: {zero}{keys}, "
            f"tool_mm: {list(tool)}, "
            f"postures: [{', '.join(names)}]}}"
        )
    if legs:
        for k, leg in enumerate("xyz"):
            for name, value in (("max", 60), ("min", -100)):
                point = [value if k == i else 0 for i in range(3)]
                postures.append(f"  {leg}_{name}: {{tcp_mm: {point}}}")
            setups += [LEGS.format(leg=leg, d=d) for d in "xyz" if d != leg]
    gauges = (
        "gauges:\n  bar: {sigma_mm: 0.002, range_mm: [-5, 5]}\n"
        "  dial: {sigma_mm: 0.005, resolution_mm: 0.01, range_mm: [-5, 5]}\n"
    )
    if not legs:
        gauges = gauges.rsplit("  dial", 1)[0]
    text = (
        "robot: orthoglide\ncontroller: {offsets_mm: [0, 0, 0]}\n"
        f"{gauges}postures:\n{chr(10).join(postures)}\nsetups:\n{chr(10).join(setups)}\n"
    )
    folder.mkdir(exist_ok=True)
    (folder / "plan.yaml").write_text(text)
    return load_plan(folder / "plan.yaml")
