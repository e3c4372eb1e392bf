"""Linear deltas and inclined Orthoglides: closed forms, Pinocchio, and the packaged Orthoglide."""

from __future__ import annotations

import numpy as np
import pytest
from machines import place
from tolerances import CLOSED, KINEMATICS

from orthocal import load_robot
from orthocal.builder.families import ORTHOGONAL, InclinedOrthoglide, LinearDelta
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.robot.loading import packaged_robots
from orthocal.units import DEG

POINTS = np.array([[0.0, 0.0, 0.0], [0.05, 0.02, 0.04], [-0.06, 0.05, 0.02], [0.01, -0.05, 0.05]])


def written(folder, machine, name="machine"):
    """The robot of a machine, read from its files."""
    folder = folder / name
    folder.mkdir()
    (folder / f"{name}.urdf").write_text(machine.urdf(name))
    (folder / f"{name}.yaml").write_text(machine.yaml())
    return load_robot(folder)


@pytest.mark.parametrize("angles", [(210, 330, 90), (212, 329, 91)])
def test_slides_of_a_delta_are_at_the_heights_of_the_textbook(tmp_path, angles):
    delta = LinearDelta(angles=tuple(a * DEG for a in angles))
    robot = written(tmp_path, delta)
    drives = LoopClosure(robot).inverse(POINTS)
    for k, angle in enumerate(delta.angles):
        tower = delta.radius * np.array([np.cos(angle), np.sin(angle)])
        apart = ((tower - POINTS[:, :2]) ** 2).sum(axis=1)
        height = POINTS[:, 2] + np.sqrt(delta.rod**2 - apart)
        assert np.abs(drives[:, k] - height).max() < CLOSED


@pytest.mark.parametrize("machine", [LinearDelta(), InclinedOrthoglide()])
def test_the_tool_is_where_pinocchio_closes_the_loops(tmp_path, machine):
    robot = written(tmp_path, machine)
    drives = LoopClosure(robot).inverse(POINTS)
    for point, coordinates in zip(POINTS, drives, strict=True):
        assert np.abs(place(robot, coordinates, "tcp") - point).max() < CLOSED


def test_orthogonal_slides_make_an_orthoglide(tmp_path, orthoglide):
    """Equal but for the orientation of the world."""
    robot = written(tmp_path, InclinedOrthoglide(elevation=ORTHOGONAL))
    axes = np.column_stack(
        [leg.direction for leg in InclinedOrthoglide(elevation=ORTHOGONAL).legs()]
    )
    assert np.abs(axes.T @ axes - np.eye(3)).max() < KINEMATICS
    drives = LoopClosure(robot).inverse(POINTS)
    assert np.abs(drives - LoopClosure(orthoglide).inverse(POINTS @ axes)).max() < CLOSED


@pytest.mark.parametrize("machine", [LinearDelta(), InclinedOrthoglide(elevation=60 * DEG)])
def test_the_complete_model_has_the_errors_of_the_orthoglide(tmp_path, machine):
    assert len(written(tmp_path, machine).parameters.select_model("full")) == 129


def test_the_packaged_delta_is_made_from_its_dimensions():
    folder, delta = packaged_robots()["linear_delta"], LinearDelta()
    assert (folder / "linear_delta.urdf").read_text() == delta.urdf("linear_delta")
    assert (folder / "linear_delta.yaml").read_text() == delta.yaml()
