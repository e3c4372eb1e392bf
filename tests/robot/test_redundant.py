"""Redundant errors have no effect; all others have one."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from orthocal import Biglide, load_robot, make_robot
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.robot_functions import robot_functions

STEP = 1e-6
"""[m, rad]"""


def observed_points(robot, errors, drives):
    """Tool and ends of all rods of machines with closed loops, shape (count K, n), [m]."""
    closure, compiled = LoopClosure(robot), robot_functions(robot)
    passive = closure.close(drives, errors=errors)
    frames = [robot.tcp.frame] + [
        frame
        for leg in robot.legs.values()
        for rod in (leg.rods.values() or (leg,))
        for frame in (rod.root, rod.tip)
    ]
    machines = compiled.errors.geometry(errors)
    rows = (v.reshape(-1, v.shape[-1]) for v in (machines.drives(drives), passive))
    at = *rows, machines.placements
    return np.hstack([compiled.position(f)(*at)[0] for f in dict.fromkeys(frames)])


@pytest.mark.parametrize("kind", ["orthoglide", "biglide with one rod a slide"])
def test_redundant_errors_have_no_effect_and_all_others_have(tmp_path, orthoglide, kind):
    """Effect of every elementary error by central differences, [m/m, m/rad]."""
    machine = orthoglide
    if kind != "orthoglide":
        machine = make_robot(Biglide(rods_apart=0.0, attachment=0.0), tmp_path / "simple")
    rng = np.random.default_rng(7)
    tool = rng.uniform(-0.08, 0.05, (2, 3))[:, : len(machine.drives)]
    drives = LoopClosure(machine).inverse(tool)
    names = robot_functions(machine).errors.names
    assert set(names) == set(machine.parameters.elementary)
    steps = STEP * np.eye(len(names))
    plus, minus = (observed_points(machine, errors, drives) for errors in (steps, -steps))
    sizes = np.abs(plus - minus).reshape(len(names), -1).max(axis=1) / (2.0 * STEP)
    for name, size in zip(names, sizes, strict=True):
        redundant = name in machine.parameters.redundant
        assert (size < 1e-6) if redundant else (size > 1e-3), name


def test_rotations_about_hinge_axes_are_redundant(orthoglide):
    redundant = orthoglide.parameters.redundant
    assert {f"{k}_{j}" for k in "xyz" for j in ("swivel.rz", "bar_a.ry", "wrist.rz")} <= redundant
    assert {f"frame.{k}_crossbar_end.rx" for k in "xyz"} <= redundant
    assert not any(n.endswith((".offset", ".scale")) for n in redundant)


def test_the_complete_model_has_no_redundant_errors(orthoglide):
    """Of 177 errors (126 of joints and offsets, ends of loops, scales) 129 change something."""
    p = orthoglide.parameters
    full = p.select_model("full")
    assert len(p.of_parts) == 126 + 8 * 6 + 3
    assert set(full) == set(p.of_parts) - p.redundant
    assert len(full) == 129
    assert not any(
        n.endswith(".length") or n.startswith(("frame.tcp", "frame.x_leg")) for n in full
    )


def test_both_rods_have_their_length_if_the_tool_hangs_below_the_end_of_one(biglide):
    """The tool is the end of rod x: a longer rod moves it, and no other error does the same."""
    assert biglide.tcp.frame == "x_tip"
    complete = set(biglide.parameters.complete)
    assert {"frame.x_tip.x", "frame.y_tip.x"} <= complete
    # a rotation of the frame only turns the tool
    assert not complete & {f"frame.x_tip.r{axis}" for axis in "xyz"}


def test_without_observations_no_error_is_redundant(fivebar, biglide):
    assert fivebar.parameters.redundant == frozenset()
    # two drives on one rail each: only what leaves the plane is taken up by nothing
    assert biglide.parameters.complete
    assert set(biglide.parameters.complete) == set(biglide.parameters.of_parts) - set(
        biglide.parameters.redundant
    )


def test_a_robot_may_list_its_full_model_itself(tmp_path, root):
    folder = shutil.copytree(root / "robots/orthoglide", tmp_path / "orthoglide")
    path = folder / "orthoglide.yaml"
    path.write_text(path.read_text().replace("full: complete", "full: ['*.offset', 'x_slide.ry']"))
    robot = load_robot(folder)
    assert robot.parameters.select_model("full")[-1] == "x_slide.ry"
