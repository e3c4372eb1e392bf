"""Redundant errors, which neither the tool nor a gauge can observe, and dependent closure rows.

An error of a placement moves everything that the placement carries. Passive joints follow until the
loops are closed again. An error that they compensate completely is redundant, such as a rotation
about the axis of a hinge.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import islice

import numpy as np
import pinocchio as pin

from orthocal.arrays import Array
from orthocal.errors import ClosureError, RobotError
from orthocal.robot.closing import RANK_TOLERANCE
from orthocal.robot.frames import Placement, carriers
from orthocal.robot.model import Robot, closure_row_units
from orthocal.robot.parameters import AXES, ElementaryError

N_POSTURES = 4
"""Number of random postures in which sensitivities are evaluated."""

MAX_ATTEMPTS = 200
"""Largest number of random drive coordinates that are tried, because some cannot be reached."""

UNLIMITED_TRAVEL = 0.2
"""Travel on each side of its zero that is assumed for a drive without limits, [m, rad]."""

SMALLEST_SENSITIVITY = 1e-9
"""Sensitivity below which an error is redundant, relative to the largest of its kind: translations
or rotations, whose units differ."""

ROW_RANK_TOLERANCE = 1e-8
"""Singular value below which closure rows are linearly dependent, [m per m or rad]."""


def find_redundant_errors(robot: Robot, elementary: Sequence[ElementaryError]) -> frozenset[str]:
    """Names of the placement errors that the tool and the gauges cannot observe.

    Errors of other kinds are never redundant. Without a tool and legs no error counts as redundant,
    because nothing is observed.
    """
    if robot.tcp is None and not robot.legs:
        return frozenset()
    errors = [e for e in elementary if e.axis >= 0]
    placements = [robot.placement_of(e) for e in errors]
    owners = list(dict.fromkeys(placements))
    columns = [6 * owners.index(p) + e.axis for p, e in zip(placements, errors, strict=True)]
    observed = [] if robot.tcp is None else [robot.tcp.frame]
    for leg in robot.legs.values():
        for rod in leg.rods.values() or (leg,):
            observed += [rod.root, rod.tip]
    frames = [robot.frame_id(name) for name in dict.fromkeys(observed)]
    masks = _carried_masks(robot, owners, frames)
    largest = np.zeros(len(errors))
    for coordinates in islice(_random_postures(robot), N_POSTURES):
        sensitivity = _sensitivity(robot, owners, frames, masks, coordinates)
        largest = np.maximum(largest, np.abs(sensitivity).max(axis=0)[columns])
    rotations = np.array([e.axis >= 3 for e in errors], dtype=np.bool_)
    redundant = np.zeros(len(errors), dtype=np.bool_)
    for kind in (rotations, ~rotations):
        redundant |= kind & (largest <= SMALLEST_SENSITIVITY * largest[kind].max(initial=0.0))
    return frozenset(e.name for e, r in zip(errors, redundant, strict=True) if r)


def _random_postures(robot: Robot) -> Iterator[Array]:
    """Joint coordinates of random postures with closed loops within the travel of the drives."""
    rng = np.random.default_rng(0)
    zero = robot.drive_zero
    lower, upper = np.array([(d.lower, d.upper) for d in robot.drives]).T
    unlimited = ~np.isfinite(upper)
    lower = np.where(unlimited, zero - UNLIMITED_TRAVEL, lower)
    upper = np.where(unlimited, zero + UNLIMITED_TRAVEL, upper)
    fraction = 0.5  # of the travel; reduced until enough postures can be reached
    for _ in range(MAX_ATTEMPTS):
        drives = zero + fraction * (rng.uniform(lower, upper) - zero)
        try:
            passive = robot.close_with_pinocchio(drives, robot.reference_passive)
        except ClosureError:
            fraction *= 0.8
            continue
        yield robot.joint_coordinates(drives, passive)


def _carried_masks(
    robot: Robot, owners: Sequence[Placement], observed: Sequence[int]
) -> dict[int, Array]:
    """Masks of the motions that move frames of closures and observed frames, by frame.

    A mask is 1 for motions that move the frame, else 0. The motions are the six twist components of
    each owner, then the passive coordinates.
    """
    model = robot.model
    ends = [robot.frame_id(n) for c in robot.closures for n in (c.frame_a, c.frame_b)]
    masks = {}
    for frame in {*observed, *ends}:
        supports = model.supports[model.frames[frame].parentJoint]
        moving = {Placement(int(joint), False) for joint in supports}
        moving |= {Placement(f, True) for f in carriers(model, frame)}
        mask = np.repeat([owner in moving for owner in owners], 6)
        passive = [Placement(k + 1, False) in moving for k in robot.passive_index.tolist()]
        masks[frame] = np.concatenate([mask, passive]).astype(np.float64)
    return masks


def _sensitivity(
    robot: Robot,
    owners: Sequence[Placement],
    observed: Sequence[int],
    masks: Mapping[int, Array],
    coordinates: Array,
) -> Array:
    """Sensitivity of observed points to placement errors, with the loops closed.

        dp/dξ = p_ξ − p_q g_q⁺ g_ξ

    Subscripts denote Jacobians of the observed points p and of the closures g, with respect to the
    placement errors ξ and the passive coordinates q.

    Args:
        robot: The robot.
        owners: Placements of joints and frames; each has six components of ξ, a twist in its axes.
        observed: Indices of the frames whose origins are observed.
        masks: Result of `_carried_masks`.
        coordinates: Joint coordinates with closed loops, shape (nv,), [m, rad].

    Returns:
        Shape (3 n_observed, 6 n_owners), [m/m, m/rad].
    """
    model = robot.model
    data = model.createData()
    pin.computeJointJacobians(model, data, robot.configuration(coordinates))
    pin.updateFramePlacements(model, data)
    frames = [
        data.oMf[p.index]
        if p.of_frame
        else data.oMi[model.parents[p.index]] * model.jointPlacements[p.index]
        for p in owners
    ]
    twists = np.hstack(
        [*(f.toActionMatrix() for f in frames), data.J.reshape(6, -1)[:, robot.passive_index]]
    )

    def motion(point: Array) -> Array:
        """World velocity and angular velocity at a point per unit of each motion, shape (6, n)."""
        return np.vstack([twists[:3] - pin.skew(point) @ twists[3:], twists[3:]])

    rows = [np.zeros((0, twists.shape[1]))]
    for closure in robot.closures:
        a, b = robot.frame_id(closure.frame_a), robot.frame_id(closure.frame_b)
        axes = np.kron(np.eye(2), data.oMf[a].rotation.T)
        relative = axes @ motion(data.oMf[b].translation) * (masks[b] - masks[a])
        rows.append(relative[list(closure.rows)])
    points = [motion(data.oMf[f].translation)[:3] * masks[f] for f in observed]
    g, p, n = np.vstack(rows), np.vstack(points), 6 * len(owners)
    passive_motion = np.linalg.lstsq(g[:, n:], -g[:, :n], rcond=RANK_TOLERANCE)[0]
    return np.asarray(p[:, :n] + p[:, n:] @ passive_motion)


@lru_cache(maxsize=8)
def require_independent_rows(robot: Robot) -> None:
    """Refuse closures with too few or linearly dependent rows.

    Dependent rows are redundant for the nominal machine and contradict each other for a machine
    with errors.

    Raises:
        RobotError: If rows are missing, or depend on others; names them.
    """
    where, passive = str(robot.yaml), robot.reference_passive
    rows = [(c.name, AXES[row]) for c in robot.closures for row in c.rows]
    if len(rows) < passive.size:
        raise RobotError(
            f"the closures constrain {len(rows)} coordinates of {passive.size} passive joints, so "
            f"that the drives leave {passive.size - len(rows)} motions free; complete closed_loop "
            "or orthocal.closures.<name>.rows",
            where=where,
        )
    _, jacobian = robot.evaluate_constraints(robot.drive_zero, passive)
    by_passive = (jacobian * closure_row_units(robot)[:, None])[:, robot.passive_index]
    independent = np.zeros((0, by_passive.shape[1]))
    dependent = []
    for (closure, axis), row in zip(rows, by_passive, strict=True):
        trial = np.vstack([independent, row])
        if np.linalg.matrix_rank(trial, tol=ROW_RANK_TOLERANCE) == len(trial):
            independent = trial
        else:
            dependent.append(f"{axis} of {closure}")
    if dependent:
        raise RobotError(
            f"closure rows depend on others: {', '.join(dependent)}; remove them from "
            "orthocal.closures.<name>.rows",
            where=where,
        )
