"""The three measuring plans whose value was computed by an independent rigid-body model."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import yaml

AXES = "xyz"


def paper(**ends: float) -> dict:
    """The paper's seven postures, gauge in the middle of the leg: 18 readings."""
    postures = {"zero": {"tcp_mm": [0, 0, 0]}}
    for k, axis in enumerate(AXES):
        for name, value in (ends or {"max": 60.0, "min": -100.0}).items():
            postures[f"{axis}_{name}"] = {"tcp_mm": [value * (i == k) for i in range(3)]}
    read = {a: ["zero", f"{a}_max", f"{a}_min"] for a in AXES}
    return {"robot": "orthoglide", "postures": postures, "setups": setups(read, [0.5])}


def sweep() -> dict:
    """Nine postures on each axis, three sections: 162 readings."""
    postures, read = {}, {a: [] for a in AXES}
    for k, axis in enumerate(AXES):
        for n, value in enumerate(np.linspace(-100, 60, 9)):
            postures[f"{axis}{n}"] = {"tcp_mm": [float(value) * (i == k) for i in range(3)]}
            read[axis].append(f"{axis}{n}")
    return {"robot": "orthoglide", "postures": postures, "setups": setups(read, [0.35, 0.5, 0.65])}


def lines() -> dict:
    """Nine lines parallel to each axis, displaced by 0 and ±20 mm, five postures: 270 readings."""
    postures, read = {}, {a: [] for a in AXES}
    for k, axis in enumerate(AXES):
        for a, b in itertools.product((-20.0, 0.0, 20.0), repeat=2):
            for n, value in enumerate(np.linspace(-100, 60, 5)):
                point = [a, b]
                point.insert(k, float(value))
                name = f"{axis}_{a:.0f}_{b:.0f}_{n}"
                postures[name] = {"tcp_mm": point}
                read[axis].append(name)
    return {"robot": "orthoglide", "postures": postures, "setups": setups(read, [0.5])}


def setups(read: dict[str, list[str]], fractions: list[float]) -> dict:
    """Both directions across every leg, at every section."""
    return {
        f"{d}{leg}{round(100 * f)}": {
            "leg": leg,
            "direction": d,
            "section": {"fraction": f},
            "postures": list(read[leg]),
        }
        for leg in AXES
        for d in AXES
        if d != leg
        for f in fractions
    }


def write(folder: Path, plan: dict) -> Path:
    """Write a plan as a file."""
    file = folder / "plan.yaml"
    file.write_text(yaml.safe_dump(plan))
    return file
