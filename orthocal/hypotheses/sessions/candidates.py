"""What of a machine may have changed between sessions: drives, legs, and all the rest of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from orthocal.estimation.diagnostics.unmodelled import OtherErrors, error_slopes, machine_errors
from orthocal.estimation.fit import Fit
from orthocal.io.fields import read_only
from orthocal.kinematics.function_cache import cached_per_robot
from orthocal.robot.frames import find_frame
from orthocal.robot.model import Robot
from orthocal.robot.parameters import ElementaryError, Parameter

Array = NDArray[np.float64]
Part = Literal["drive", "leg", "rest"]

SPANNED = 1e-9
"""Part of a parameter that known columns may leave of it to be made of them."""


@dataclass(frozen=True, slots=True)
class Suspect:
    """A parameter that may have changed, and what it is a number of."""

    parameter: Parameter
    part: Part
    of: str
    """Name of the drive or leg; of the joint or frame for the rest."""
    named: bool
    """Whether it is the offset of a drive, or a sum that the robot's YAML names."""

    @property
    def words(self) -> str:
        """The drive, leg or part."""
        return self.of if self.part in ("drive", "rest") else f"leg {self.of}"


@dataclass(frozen=True, slots=True)
class Step:
    """A change of one suspect."""

    suspect: int
    """Which, among those of the columns."""
    session: int
    """From which one on, counted from 0."""
    square: float
    """χ² that it explains by itself."""


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """How all that is not known of a machine and its sensors moves the readings."""

    slopes: Array
    """∂h of one tolerance of each, shape (n_entries, n), [m of the first gauge]."""
    names: tuple[str, ...]
    """Of the machine's, the first ones."""
    flat: NDArray[np.bool_]
    """Of which nothing is known beforehand, shape (n,)."""
    unsure: NDArray[np.bool_]
    """Errors of the machine that may be more than their tolerances, shape (n,)."""
    held: NDArray[np.bool_]
    """Errors that are known, so that they have none in common to all sessions, shape (n,)."""
    suspects: tuple[Suspect, ...]
    makes: Array
    """What one unit of each suspect is in these columns, shape (n, n_suspects)."""

    @property
    def named(self) -> NDArray[np.int64]:
        """Suspects that are named."""
        return np.flatnonzero([s.named for s in self.suspects])


def gather_columns(fit: Fit, others: OtherErrors) -> Columns:
    """The columns of a fit, of what it left out, and of what it took for known.

    Args:
        fit: The fit.
        others: Errors of the machine that it left out.
    """
    problem = fit.problem
    known = problem.robot.parameters
    suspects = list_suspects(problem.robot)
    own = problem.machine_selection.parameters
    given = [(p.name, p.tolerance) for p in own]
    given += list(zip(others.names, others.tolerances.tolist(), strict=True))
    makes, made = _compose(problem.robot, given, suspects)
    lost = {t for s, ok in zip(suspects, made, strict=True) if not ok for t, _ in s.parameter.terms}
    lost -= {*dict(given), *known.idle}
    more = tuple(n for n in known.names if n in lost)
    slopes = [fit.jacobian[:, : len(own)], others.slopes]
    if more:
        slopes.append(error_slopes(fit, more))
        given += [(n, known[n].tolerance) for n in more]
        makes, made = _compose(problem.robot, given, suspects)
    n, unknowns = len(given), fit.jacobian[:, len(own) :]
    fixed = {t for name in problem.fixed for t, _ in known[name].terms}
    elementary = known.elementary
    offset = np.array([elementary[known[name].terms[0][0]].kind == "offset" for name, _ in given])
    free = np.zeros(n, dtype=bool)
    free[: len(own)] = problem.prior_precision[: len(own)] == 0.0
    held = np.array([all(t in fixed for t, _ in known[name].terms) for name, _ in given])
    none = np.zeros(unknowns.shape[1], dtype=bool)
    return Columns(
        slopes=np.column_stack([*slopes, unknowns]),
        names=tuple(name for name, _ in given),
        flat=np.append((offset | free) & ~held, none),
        unsure=np.append(~(offset | free | held), none),
        held=np.append(held, none),
        suspects=tuple(s for s, ok in zip(suspects, made, strict=True) if ok),
        makes=read_only(np.vstack([makes[:, made], np.zeros((none.size, int(made.sum())))])),
    )


@cached_per_robot(maxsize=8)
def list_suspects(robot: Robot) -> tuple[Suspect, ...]:
    """All errors of a machine, drives' offsets and the sums that its YAML names first."""
    parameters, joints = robot.parameters, _joints_of_legs(robot)
    errors = set(machine_errors(robot))
    offsets = {f"{d.name}.offset": d.name for d in robot.drives}
    found = []
    for p in parameters:
        of = {_part_of(robot, parameters.elementary[t], joints) for t, _ in p.terms}
        part, name = next(iter(of)) if len(of) == 1 else ("rest", p.name)
        is_sum = len(p.terms) > 1 and not all(t in parameters.idle for t, _ in p.terms)
        named = p.name in offsets or is_sum
        if named or p.name in errors:
            found.append(Suspect(p, part, name, named))
    return tuple(sorted(found, key=lambda s: (not s.named, s.parameter.name not in offsets)))


def _part_of(
    robot: Robot, error: ElementaryError, joints: dict[int, str | None]
) -> tuple[Part, str]:
    """The drive or leg that an elementary error is of."""
    if error.owner in {d.name for d in robot.drives} and not error.of_frame:
        return "drive", error.owner
    model = robot.model
    if error.of_frame:
        joint = model.frames[find_frame(model, error.owner, where="frame")].parentJoint
    else:
        joint = model.getJointId(error.owner)
    leg = joints.get(int(joint))
    return ("rest", error.owner) if leg is None else ("leg", leg)


def _joints_of_legs(robot: Robot) -> dict[int, str | None]:
    """Joints that carry the ends of a leg or of its rods, drives apart: to the leg.

    What carries several legs is of none.
    """
    model = robot.model
    drives = {int(model.getJointId(d.name)) for d in robot.drives}
    found: dict[int, str | None] = {}
    for name, leg in robot.legs.items():
        ends = [leg.root, leg.tip, *(e for r in leg.rods.values() for e in (r.root, r.tip))]
        carrying: set[int] = set()
        for end in ends:
            joint = int(model.frames[find_frame(model, end, where="frame")].parentJoint)
            carrying |= set(model.supports[joint]) - {0}
        for joint in carrying - drives:
            found[int(joint)] = None if joint in found else name
    return found


def _compose(
    robot: Robot, given: list[tuple[str, float]], suspects: tuple[Suspect, ...]
) -> tuple[Array, NDArray[np.bool_]]:
    """Suspects as sums of given parameters, each in its tolerance, and which of them are."""
    parameters = robot.parameters
    index = {name: i for i, name in enumerate(parameters.elementary)}
    basis = np.zeros((len(index), len(given)))
    for j, (name, tolerance) in enumerate(given):
        for term, coefficient in parameters[name].terms:
            basis[index[term], j] = coefficient * tolerance
    makes = np.zeros((len(given), len(suspects)))
    made = np.zeros(len(suspects), dtype=bool)
    by_name = {name: j for j, (name, _) in enumerate(given)}
    for i, suspect in enumerate(suspects):
        p = suspect.parameter
        if p.name in by_name:
            makes[by_name[p.name], i] = 1.0 / given[by_name[p.name]][1]
            made[i] = True
            continue
        target = np.zeros(len(index))
        for term, coefficient in p.terms:
            if term not in parameters.idle:
                target[index[term]] = coefficient
        rows = np.flatnonzero(target)
        columns = np.flatnonzero((basis[rows] != 0.0).any(axis=0))
        involved = np.flatnonzero((basis[:, columns] != 0.0).any(axis=1) | (target != 0.0))
        small = basis[np.ix_(involved, columns)]
        if columns.size:
            sizes = np.linalg.norm(small, axis=0)
            solution = np.linalg.lstsq(small / sizes, target[involved], rcond=None)[0] / sizes
            left = target[involved] - small @ solution
            made[i] = bool(np.abs(left).max() < SPANNED)
            if made[i]:
                makes[columns, i] = solution
    return makes, made
