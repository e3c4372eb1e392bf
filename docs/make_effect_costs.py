"""Simulate what effects beside geometry cost if a calibration ignores them.

It prints the rows of the two tables in docs/not-geometry.md.

python docs/make_effect_costs.py
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from pathlib import Path

import orthocal
from orthocal.cli.files import state_conditions
from orthocal.output.text.study import report_study

MACHINES, MACHINES_OF_LARGER_PLAN = 100, 200
NEAR = {"*.offset_mm": 0.4}
"""Offsets have been entered once."""

EFFECTS = "{backlash: {}, thermal: {}, screw: {lead_mm: 5}, drift: {}, compliance: {STIFFNESS}}"
STEEL, LIGHT = "rod_N_per_um: 64", "rod_N_per_um: 5"

CASES = (
    ("backlash", "both sides", "{}", STEEL),
    ("backlash", "one side", "{approach: ppp}", STEEL),
    ("thermal", "at 22 °C", "{temperature_C: [22, 22]}", STEEL),
    ("thermal", "at 30 °C", "{temperature_C: [30, 30]}", STEEL),
    ("screw", "lead 5 mm", "{}", STEEL),
    ("drift", "0.5 µm/min", "{}", STEEL),
    ("compliance", "steel rods of 64 N/µm, up to 5 kg", "{payload_kg: [0, 5]}", STEEL),
    ("compliance", "light rods of 5 N/µm, up to 5 kg", "{payload_kg: [0, 5]}", LIGHT),
)
"""Ignored effect, circumstances, use of the machine, stiffness of its rods."""


LARGER_CASES = (
    (["backlash"], "both sides", "{temperature_C: [22, 22]}"),
    (["backlash", "thermal", "screw", "drift"], "both sides", "{temperature_C: [22, 22]}"),
    (["backlash"], "one side", "{approach: ppp, temperature_C: [22, 22]}"),
    (
        ["backlash", "thermal", "screw", "drift"],
        "one side",
        "{approach: ppp, temperature_C: [22, 22]}",
    ),
)
"""Ignored effects, sides of use, use of the machine."""

ALONG_MM = (0.0, -98.6, -41.3, 39.1, 57.8)
"""Positions of the plan of 60 readings along each leg, at different angles of the screw."""


def write_robot(folder: Path, use: str, stiffness: str) -> Path:
    """The packaged robot with effects and a use."""
    source = Path(orthocal.__file__).parents[1] / "robots" / "orthoglide"
    shutil.copytree(source, folder)
    file = folder / "orthoglide.yaml"
    keys = f"\n  effects: {EFFECTS.replace('STIFFNESS', stiffness)}\n  use: {use}\n  tcp: "
    file.write_text(file.read_text().replace("\n  tcp: ", keys))
    return folder


def write_larger_plan(folder: Path) -> Path:
    """Plan of 60 readings: six setups, each at five positions along its leg, from both sides."""
    postures = {
        f"{leg}{at:+.0f}": {"tcp_mm": [at * (axis == leg) for axis in "xyz"]}
        for leg in "xyz"
        for at in ALONG_MM
    }
    setups = {
        direction + leg: {"leg": leg, "direction": direction, "section": {"fraction": 0.5}}
        for leg in "xyz"
        for direction in "xyz"
        if direction != leg
    }
    rows = ["setup,posture,cycle,reading_mm,approach"]
    for i, name in enumerate(setups):
        for at in ALONG_MM:
            for letter in "pn":
                others = len(rows) - 1
                sides = (letter if a == name[1] else "pn"[(i + others) % 2] for a in "xyz")
                rows.append(f"{name},{name[1]}{at:+.0f},1,0.0,{''.join(sides)}")
    gauge = {"sigma_mm": 0.005, "range_mm": [-20, 20]}
    keys = {"robot": "../plan", "gauge": gauge, "postures": postures, "setups": setups}
    folder.mkdir()
    (folder / "session.yaml").write_text(json.dumps({**keys, "readings": "readings.csv"}))
    (folder / "readings.csv").write_text("\n".join(rows) + "\n")
    return folder


def simulate_costs(plan: orthocal.Session, machine: Path, effects: list[str], machines: int) -> str:
    """Tool errors with effects ignored and identified, [mm], as cells of a table."""
    robot = orthocal.load_robot(machine)
    fields = {name: getattr(plan, name) for name in plan.__slots__}
    study = orthocal.build_accuracy_study(
        orthocal.Session(**fields | {"robot": robot}),
        orthocal.Choice("full", effects=[], tolerances=NEAR),
        effects=effects,
        machines=machines,
        half_side=0.06,
    )
    document = report_study(orthocal.run_study(study)).document
    return " | ".join(f"{1e-3 * document[k]:.4f}" for k in ("after_um", "after_all_effects_um"))


def main() -> None:
    """Print the rows of the tables."""
    with tempfile.TemporaryDirectory() as directory:
        machine = write_robot(Path(directory) / "plan", "{}", STEEL)
        chosen = orthocal.Choice("full", effects=["backlash"])
        plan = orthocal.plan_readings(orthocal.load_robot(machine), chosen).session
        plan = state_conditions(plan, (18.0, 26.0))
        for i, (effect, circumstances, use, stiffness) in enumerate(CASES):
            used = write_robot(Path(directory) / f"{i}", use, stiffness)
            row = simulate_costs(plan, used, [effect], MACHINES)
            sys.stdout.write(f"| {effect} | {circumstances} | {row} |\n")
            sys.stdout.flush()
        larger = orthocal.load_plan(write_larger_plan(Path(directory) / "larger"))
        larger = state_conditions(larger.with_effects(LARGER_CASES[1][0]), (17.0, 27.0))
        for i, (effects, circumstances, use) in enumerate(LARGER_CASES):
            used = write_robot(Path(directory) / f"larger-{i}", use, STEEL)
            row = simulate_costs(larger, used, effects, MACHINES_OF_LARGER_PLAN)
            sys.stdout.write(f"| {', '.join(effects)} | {circumstances} | {row} |\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
