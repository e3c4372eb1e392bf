"""Machines whose feet were shimmed, as rigid bodies: nothing here is a formula of orthocal's."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pinocchio as pin
from machines import place
from scipy.spatial.transform import Rotation

from orthocal import Orthoglide, make_robot
from orthocal.assessment.controller_entries import offsets_to_enter
from orthocal.effects.adjustment import find_adjustments
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.planning.equipment import Equipment
from orthocal.planning.first_plan import paper_plan

TOLERANCES = {"*_slide.r?_mrad": 6.0, "*.offset_mm": 2.0}
"""A machine whose axes are three times as far off as the packaged tolerances say."""


def shimmed_plan(folder):
    """The paper's readings on a machine as `orthocal new` makes it, with feet under its rails."""
    robot = make_robot(Orthoglide(), folder)
    return paper_plan(robot, Equipment()).with_tolerances(TOLERANCES)


def turned(keys, amount):
    """World displacement (rotation, translation) of a rail one of whose feet is moved, [m]."""
    direction = np.array(keys["direction"], dtype=float)
    direction /= np.linalg.norm(direction)
    if "pivot_mm" not in keys:
        return np.eye(3), amount * direction
    pivot = np.array(keys["pivot_mm"]) * 1e-3
    arm = np.array(keys["at_mm"]) * 1e-3 - pivot
    arm = arm - (arm @ direction) * direction
    axis = np.cross(arm, direction)
    axis /= np.linalg.norm(axis)
    rotation = Rotation.from_rotvec(np.arctan(amount / np.linalg.norm(arm)) * axis).as_matrix()
    return rotation, pivot - rotation @ pivot


def shim(machine, amounts):
    """Pinocchio model of a machine whose feet are moved, one after the other, [m]."""
    model = machine.model.copy()
    for name, amount in amounts.items():
        keys = machine.declared.adjustments[name]
        joint = model.getJointId(keys["moves"])
        assert model.parents[joint] == 0
        model.jointPlacements[joint] = pin.SE3(*turned(keys, amount)) * model.jointPlacements[joint]
    return model


def aligned_rms(positions, targets):
    """RMS distance after the best rigid motion (Kabsch), [m]."""
    a, b = positions - positions.mean(axis=0), targets - targets.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return float(np.sqrt((((u @ flip @ vt).T @ a.T - b.T) ** 2).sum(axis=0).mean()))


def reached(errors, adjusted, amounts, *, seed):
    """Tool error of the real machine with shims as they are set, by Pinocchio alone, [m]."""
    robot, rng = adjusted.robot, np.random.default_rng(seed)
    real = {
        a.name: amounts[a.name] + a.setting_std(amounts[a.name]) * rng.normal()
        for a in find_adjustments(robot)
        if a.name in amounts
    }
    machine = robot.with_errors(errors)
    machine = replace(machine, model=shim(machine, real)).displaced({})
    # nodes of Gauss for the mean over the cube
    points = np.array(list(itertools.product((-0.06, 0.06), repeat=3))) / np.sqrt(3.0)
    drives, _ = nominal_closure(robot).reach(points)
    entered = drives - offsets_to_enter(adjusted)
    return aligned_rms(np.array([place(machine, d, robot.tcp.frame) for d in entered]), points)
