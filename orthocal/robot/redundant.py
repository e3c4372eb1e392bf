"""Errors that change nothing: neither the tool nor what a gauge touches, in any posture.

Loops closed by Pinocchio, in postures drawn from the travel of the drives; an error of a placement
is a small motion of all that it carries. What passive joints take up changes nothing, such as an
error about a hinge's own axis.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from orthocal.errors import ClosureError
from orthocal.robot.frames import hangs_on
from orthocal.robot.model import Robot, joint_axis
from orthocal.robot.parameters import ElementaryError

Array = NDArray[np.float64]

POSTURES = 4

TRIES = 200

UNBOUNDED = 0.2
"""How far a drive without limits is moved, [m, rad]."""

NOTHING = 1e-9
"""Of the largest effect of an error of its kind."""


def find_redundant_errors(robot: Robot, elementary: Sequence[ElementaryError]) -> frozenset[str]:
    """Names of the elementary errors of placements that change nothing.

    Errors of other kinds are never idle. A robot without tool and legs has no idle errors that
    anyone could tell.
    """
    errors = [e for e in elementary if e.axis >= 0]
    if robot.tcp is None and not robot.legs:
        return frozenset()
    owners = list(dict.fromkeys((e.owner, e.of_frame) for e in errors))
    place = np.array([owners.index((e.owner, e.of_frame)) for e in errors])
    axes = np.array([e.axis for e in errors])
    parts = _Parts(robot, owners)
    largest = np.zeros(len(errors))
    for coordinates in _postures(robot):
        effect = np.abs(parts.effects(coordinates)).max(axis=0)
        largest = np.maximum(largest, effect[place, axes])
    turns = np.array([e.axis >= 3 for e in errors])
    idle = np.zeros(len(errors), dtype=np.bool_)
    for kind in (turns, ~turns):
        idle |= kind & (largest <= NOTHING * largest[kind].max(initial=0.0))
    return frozenset(e.name for e, out in zip(errors, idle, strict=True) if out)


def _postures(robot: Robot) -> Iterator[Array]:
    """Joint coordinates of machines in postures all over the travel, loops closed."""
    rng = np.random.default_rng(0)
    model = robot.model
    lower, upper = robot.drive_zero - UNBOUNDED, robot.drive_zero + UNBOUNDED
    for i, v in enumerate(robot.drive_index.tolist()):
        joint = next(j for j in model.joints if j.idx_v == v and j.nv == 1)
        if joint.nq == 1 and np.isfinite(model.upperPositionLimit[joint.idx_q]):
            lower[i] = model.lowerPositionLimit[joint.idx_q]
            upper[i] = model.upperPositionLimit[joint.idx_q]
    found, share = 0, 0.5
    for _ in range(TRIES):
        drives = robot.drive_zero + share * (rng.uniform(lower, upper) - robot.drive_zero)
        try:
            passive = robot.close_with_pinocchio(drives, robot.reference_passive)
        except ClosureError:
            share *= 0.8
            continue
        yield robot.joint_coordinates(drives, passive)
        found += 1
        if found == POSTURES:
            return


class _Parts:
    """Parts of a machine, and how it moves with a small motion of each.

    Args:
        robot: The robot.
        owners: Joints and frames that are moved, and whether it is a frame.
    """

    def __init__(self, robot: Robot, owners: list[tuple[str, bool]]) -> None:
        self._robot, model = robot, robot.model
        passive = set(robot.passive_index.tolist())
        self._joints = [j for j in range(1, model.njoints) if model.joints[j].idx_v in passive]
        self._axes = np.array([joint_axis(model, j) for j in self._joints]).reshape(-1, 6)
        self._owners = [
            (robot.frame_id(n) if of_frame else model.getJointId(n), of_frame)
            for n, of_frame in owners
        ]
        looked_at = [] if robot.tcp is None else [robot.tcp.frame]
        for leg in robot.legs.values():
            for rod in leg.rods.values() or (leg,):
                looked_at += [rod.root, rod.tip]
        self._seen = [robot.frame_id(name) for name in looked_at]
        self._ends = [
            (robot.frame_id(c.frame_a), robot.frame_id(c.frame_b)) for c in robot.closures
        ]
        moved = [*self._owners, *((j, False) for j in self._joints)]
        self._carried = {}
        for frame in {*self._seen, *(f for pair in self._ends for f in pair)}:
            carriers = self._carriers(frame)
            self._carried[frame] = np.array([m in carriers for m in moved], dtype=np.float64)

    def effects(self, coordinates: Array) -> Array:
        """Sensitivity of observed points along the closed loops, (n, n_owners, 6), [m/m, m/rad]."""
        robot, model = self._robot, self._robot.model
        data = model.createData()
        pin.framesForwardKinematics(model, data, robot.configuration(coordinates))
        places = [
            data.oMf[i] if of_frame else data.oMi[model.parents[i]] * model.jointPlacements[i]
            for i, of_frame in self._owners
        ]
        errors = np.array([p.toActionMatrix() for p in places])
        joints = np.array([data.oMi[j].toActionMatrix() for j in self._joints]).reshape(-1, 6, 6)
        turns = joints @ self._axes[:, :, None]
        n, count = len(places), len(self._joints)
        rows, by_error, by_joint = [], [], []

        def move(frame: int, point: Array, twists: Array, carried: Array) -> Array:
            velocity = np.hstack([np.eye(3), -pin.skew(point)])
            turning = np.hstack([np.zeros((3, 3)), np.eye(3)])
            return np.asarray(carried[:, None, None] * (np.vstack([velocity, turning]) @ twists))

        for closure, (a, b) in zip(robot.closures, self._ends, strict=True):
            point, turned = data.oMf[b].translation, np.kron(np.eye(2), data.oMf[a].rotation.T)
            apart = self._carried[b] - self._carried[a]
            own = list(closure.rows)
            rows.append(
                (
                    (turned @ move(b, point, errors, apart[:n]))[:, own],
                    (turned @ move(b, point, turns, apart[n:]))[:, own],
                )
            )
        for frame in self._seen:
            point, carried = data.oMf[frame].translation, self._carried[frame]
            by_error.append(move(frame, point, errors, carried[:n])[:, :3])
            by_joint.append(move(frame, point, turns, carried[n:])[:, :3])
        closing = np.concatenate([np.zeros((n, 0, 6)), *(r for r, _ in rows)], axis=1)
        following = np.concatenate([np.zeros((count, 0, 1)), *(r for _, r in rows)], axis=1)
        seen, carried = np.concatenate(by_error, axis=1), np.concatenate(by_joint, axis=1)
        closing, seen = (np.moveaxis(v, 1, 0).reshape(v.shape[1], -1) for v in (closing, seen))
        followed = np.linalg.lstsq(following[:, :, 0].T, -closing, rcond=1e-10)[0]
        return np.asarray(seen + carried[:, :, 0].T @ followed).reshape(-1, n, 6)

    def _carriers(self, frame: int) -> set[tuple[int, bool]]:
        """The joints and frames that carry a frame, and whether each is a frame."""
        model = self._robot.model
        found = {(joint, False) for joint in model.supports[model.frames[frame].parentJoint]}
        current: int | None = frame
        while current is not None:
            found.add((current, True))
            current = hangs_on(model, current)
        return found
