"""What is left out of a complete model changes nothing; what is in it changes something."""

from __future__ import annotations

import numpy as np
import pytest
from models import JOINTS

from orthocal import load_robot
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.robot_functions import robot_functions

STEP = 1e-6
"""[m, rad]"""


def seen_by(robot, errors, drives):
    """Tool and ends of all rods of a machine, loops closed anew, shape (K, n), [m]."""
    closure = LoopClosure(robot, fixed=errors)
    passive, machine = closure.close(drives), closure.geometry()
    frames = [robot.tcp.frame] + [
        frame
        for leg in robot.legs.values()
        for rod in (leg.rods.values() or (leg,))
        for frame in (rod.root, rod.tip)
    ]
    compiled = robot_functions(robot)
    at = machine.drives(drives), passive, machine.placements
    return np.hstack([compiled.position(f)(*at)[0] for f in dict.fromkeys(frames)])


@pytest.fixture(scope="module")
def effects(orthoglide):
    """Of every elementary error by central differences, loops closed anew, [m/m, m/rad]."""
    rng = np.random.default_rng(7)
    tool = rng.uniform(-0.08, 0.05, (4, 3))
    drives = LoopClosure(orthoglide).inverse(tool)
    found = {}
    for name in orthoglide.parameters.elementary:
        plus, minus = (seen_by(orthoglide, {name: s}, drives) for s in (STEP, -STEP))
        found[name] = np.abs(plus - minus).max() / (2.0 * STEP)
    return found


def test_idle_errors_change_nothing_and_all_others_do(orthoglide, effects):
    idle = orthoglide.parameters.redundant
    for name, size in effects.items():
        if name in idle:
            assert size < 1e-6, name
        else:
            assert size > 1e-3, name


def test_hinges_take_up_errors_about_their_own_axes(orthoglide):
    idle = orthoglide.parameters.redundant
    assert {f"{k}_{j}" for k in "xyz" for j in ("swivel.rz", "bar_a.ry", "wrist.rz")} <= idle
    assert {f"frame.{k}_crossbar_end.rx" for k in "xyz"} <= idle
    assert not any(n.endswith((".offset", ".scale")) for n in idle)


def test_the_complete_model_is_the_parts_errors_without_idle_ones(orthoglide):
    """Of 177 errors (126 of joints and offsets, ends of loops, scales) 129 change something."""
    p = orthoglide.parameters
    full = p.select_model("full")
    assert len(p.select(JOINTS)) == 126
    assert len(p.of_parts) == 126 + 8 * 6 + 3
    assert set(full) == set(p.of_parts) - p.redundant
    assert len(full) == 129
    assert not any(
        n.endswith(".length") or n.startswith(("frame.tcp", "frame.x_leg")) for n in full
    )


def test_a_robot_that_nothing_is_seen_of_has_no_idle_errors(fivebar, biglide):
    assert fivebar.parameters.redundant == frozenset()
    # two drives on one rail each: only what leaves the plane is taken up by nothing
    assert biglide.parameters.complete
    assert set(biglide.parameters.complete) == set(biglide.parameters.of_parts) - set(
        biglide.parameters.redundant
    )


def test_a_robot_may_list_its_full_model_itself(tmp_path, root):
    import shutil

    folder = shutil.copytree(root / "robots/orthoglide", tmp_path / "orthoglide")
    path = folder / "orthoglide.yaml"
    path.write_text(path.read_text().replace("full: complete", "full: ['*.offset', 'x_slide.ry']"))
    robot = load_robot(folder)
    assert robot.parameters.select_model("full")[-1] == "x_slide.ry"
