"""Plans for machines with effects beside geometry."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from dataclasses import replace
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path

from orthocal import load_plan
from orthocal.robot.loading import packaged_robots
from orthocal.session.session import Conditions

EFFECTS = "backlash: {}, thermal: {}, screw: {lead_mm: 10}, drift: {}"
"""Keys of all effects that a session can identify."""

ALL = ("backlash", "thermal", "screw", "drift")
"""Names of these effects."""

FEW = ("yx", "xy", "xz")
"""Setups that suffice to identify backlash."""

PLAN = """robot: machine
gauge: {sigma_mm: 0.001, range_mm: [-20, 20]}
postures:
  zero: {tcp_mm: [0, 0, 0]}
"""
"""Beginning of session.yaml, before further postures and the setups."""

FIRST = datetime(2025, 3, 14, 9, 26)
ALONG = (-100, -47, 23, 60)


def write_robot(folder, effects, *, joints=None):
    """The packaged robot with further effects and keys of joints, as YAML."""
    source = packaged_robots()["orthoglide"]
    folder.mkdir(parents=True)
    shutil.copy(source / "orthoglide.urdf", folder / "machine.urdf")
    text = (source / "orthoglide.yaml").read_text()
    written = text.replace("\n  tcp: ", f"\n  effects: {{{effects}}}\n  tcp: ")
    assert written != text
    for drive, keys in (joints or {}).items():
        entry = f"{drive}: {{zero_mm: 310.25"
        assert entry in written
        written = written.replace(entry, f"{entry}, joint: {keys}")
    (folder / "machine.yaml").write_text(written)
    return folder


def write_plan(folder, *, effects, joints=None, conditions=True):
    """Six setups, each read along its own leg, approached from both sides while it gets warmer."""
    write_robot(folder / "machine", effects, joints=joints)
    postures, setups = PLAN, "setups:\n"
    columns = ",approach,temperature_C,time" if conditions else ",cycle"
    rows = [f"setup,posture,reading_mm{columns}"]
    for leg in range(3):
        for d in ALONG:
            at = [d if i == leg else 7.0 * (i - leg) for i in range(3)]
            postures += f"  {'xyz'[leg]}_{d}: {{tcp_mm: {at}}}\n"
    for leg, direction in ((a, b) for a in range(3) for b in range(3) if a != b):
        setup = "xyz"[direction] + "xyz"[leg]
        setups += f"  {setup}: {{leg: {'xyz'[leg]}, direction: {'xyz'[direction]}, section: "
        setups += "{fraction: 0.5}}\n"
        for i, posture in enumerate(["zero", *(f"{'xyz'[leg]}_{d}" for d in ALONG)]):
            for cycle, letter in enumerate("pn", start=1):
                k = len(rows)
                approach = "".join(letter if j == leg else "pn"[(i + j) % 2] for j in range(3))
                time = (FIRST + timedelta(minutes=k)).isoformat()
                stated = f",{approach},{19 + 0.25 * (k % 40)},{time}"
                rows.append(f"{setup},{posture},0.0{stated if conditions else f',{cycle}'}")
    (folder / "session.yaml").write_text(f"{postures}{setups}readings: readings.csv\n")
    (folder / "readings.csv").write_text("\n".join(rows) + "\n")
    return folder


@cache
def effect_folder(keys=EFFECTS):
    """Directory of a plan (`write_plan`), written once in a process."""
    parent = tempfile.mkdtemp(prefix="plans-", dir=os.environ.get("ORTHOCAL_CACHE"))
    atexit.register(shutil.rmtree, parent, ignore_errors=True)
    return write_plan(Path(parent) / "plan", effects=keys)


@cache
def effect_plan(*chosen, keys=EFFECTS, setups=None):
    """Plan of a machine with chosen effects and their keys; by default with all six setups."""
    plan = load_plan(effect_folder(keys)).with_effects(list(chosen))
    if setups is None:
        return plan
    return plan.select([r for r in plan.readings if r.setup in setups])


@cache
def sided_plan(setups=None):
    """`effect_plan` with backlash whose readings state their side of approach alone.

    No other effect is in question, which halves the time of a judgement.
    """
    plan = effect_plan("backlash", setups=setups)
    readings = [replace(r, conditions=Conditions(r.approach)) for r in plan.readings]
    return replace(plan, readings=tuple(readings))
