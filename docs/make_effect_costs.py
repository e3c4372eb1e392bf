"""Simulate what effects beside geometry cost if a calibration ignores them.

It prints the rows of the table in docs/not-geometry.md.

python docs/make_effect_costs.py
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import orthocal
from orthocal.cli.files import state_conditions
from orthocal.output.text.study import report_study

MACHINES = 100
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


def write_robot(folder: Path, use: str, stiffness: str) -> Path:
    """The packaged robot with effects and a use."""
    source = Path(orthocal.__file__).parents[1] / "robots" / "orthoglide"
    shutil.copytree(source, folder)
    file = folder / "orthoglide.yaml"
    keys = f"\n  effects: {EFFECTS.replace('STIFFNESS', stiffness)}\n  use: {use}\n  tcp: "
    file.write_text(file.read_text().replace("\n  tcp: ", keys))
    return folder


def main() -> None:
    """Print the rows of the table."""
    with tempfile.TemporaryDirectory() as directory:
        machine = write_robot(Path(directory) / "plan", "{}", STEEL)
        chosen = orthocal.Choice("full", effects=["backlash"])
        plan = orthocal.plan_readings(orthocal.load_robot(machine), chosen).session
        plan = state_conditions(plan, (18.0, 26.0))
        for i, (effect, circumstances, use, stiffness) in enumerate(CASES):
            robot = orthocal.load_robot(write_robot(Path(directory) / f"{i}", use, stiffness))
            session = orthocal.Session(
                **{name: getattr(plan, name) for name in plan.__slots__} | {"robot": robot}
            )
            study = orthocal.build_accuracy_study(
                session,
                orthocal.Choice("full", effects=[], tolerances=NEAR),
                effects=[effect],
                machines=MACHINES,
                half_side=0.06,
            )
            document = report_study(orthocal.run_study(study)).document
            sizes = (1e-3 * document[k] for k in ("after_um", "after_all_effects_um"))
            row = " | ".join(f"{size:.4f}" for size in sizes)
            sys.stdout.write(f"| {effect} | {circumstances} | {row} |\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
