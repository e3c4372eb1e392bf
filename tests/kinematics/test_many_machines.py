"""Loops of many machines at once, held against Pinocchio machine by machine."""

from __future__ import annotations

import numpy as np
import pytest

from orthocal.kinematics import machine_batch as fleet
from orthocal.kinematics.compiled import compiled_robot
from orthocal.kinematics.loop_closure import Assembly
from orthocal.kinematics.machine_batch import Machines

OPEN = 1e-12
"""Loops in metres that count as closed: some hundred roundings of a machine of a third of one."""


def machines(robot, *, offset, size=1e-3, seed=0, count=6):
    """Drawn errors, some drives further off than others; postures about the zero."""
    rng = np.random.default_rng(seed)
    names = compiled_robot(robot).errors.names
    errors = size * rng.normal(size=(count, len(names)))
    drives = [i for i, n in enumerate(names) if n.endswith(".offset")]
    errors[:, drives] += offset * rng.normal(size=(count, len(drives)))
    postures = robot.drive_zero + 0.02 * rng.normal(size=(5, len(robot.drives)))
    passive = Assembly(robot).close(postures)
    return names, errors, postures, passive


@pytest.mark.parametrize("name", ["orthoglide", "biglide"])
@pytest.mark.parametrize("offset", [0.0, 0.01])
def test_loops_are_closed_as_pinocchio_has_them(request, name, offset):
    robot = request.getfixturevalue(name)
    names, errors, postures, passive = machines(robot, offset=offset)
    found = Machines(robot, errors, postures, passive)
    assert found.close().all()
    for own, q in zip(errors, found.passive, strict=True):
        machine = robot.with_errors(dict(zip(names, own.tolist(), strict=True)))
        for drives, joints in zip(postures, q, strict=True):
            residual, _ = machine.evaluate_constraints(drives, joints)
            assert np.abs(residual).max(initial=0.0) < OPEN


def test_one_that_is_far_off_spoils_no_other(orthoglide):
    _, errors, postures, passive = machines(orthoglide, offset=0.0)
    alone = Machines(orthoglide, errors[:3], postures, passive)
    assert alone.close().all()
    spoilt = np.array(errors)
    spoilt[3:] += 0.5  # no machine
    for many in (spoilt, np.where(np.arange(len(errors))[:, None] < 3, errors, np.nan)):
        with np.errstate(all="ignore"):
            beside = Machines(orthoglide, many, postures, passive)
            closed = beside.close()
        assert closed[:3].all()
        assert not closed[3:].any()
        assert np.abs(beside.passive[:3] - alone.passive).max() < OPEN


def test_few_evaluations_close_machines_near_each_other(orthoglide, monkeypatch):
    _, errors, postures, passive = machines(orthoglide, offset=0.0, size=1e-4)
    steps = []
    solve = fleet._solve
    monkeypatch.setattr(fleet, "_solve", lambda a, b: steps.append(len(a)) or solve(a, b))
    assert Machines(orthoglide, errors, postures, passive).close().all()
    assert steps == [len(postures), len(errors) * len(postures), len(errors) * len(postures)]
