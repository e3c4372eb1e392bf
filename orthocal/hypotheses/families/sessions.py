"""Changes between joined sessions: other offsets in the controller than stated, a changed machine.

A session whose offsets E are stated but whose controller holds C shows a machine that is E − C off.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, permutations

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.hypotheses.anomaly import AnomalyKind, Explanation
from orthocal.hypotheses.hypothesis import Family, MachineShift
from orthocal.hypotheses.linear_model import LinearModel, linear_model
from orthocal.session.session import Session

MOST_DRIVES = 6
"""Drives up to which all choices among them are considered."""

MOST_DIVIDED = 5
"""Sessions up to which all divisions in two are considered, in whatever order they were joined."""

DETECTED = 5.5
"""Change, over its standard deviation, from which on its evidence is clear."""

ROUNDING = 1e-6
"""Difference of offsets that counts as none, [m, rad]."""


def changes_between_sessions(model: LinearModel) -> Iterator[Family]:
    """Offsets that are not as stated, and machines that changed; none for a single session."""
    if len(model.labels) < 2:
        return
    offsets = _wrong_offsets(model)
    if offsets is not None:
        yield offsets
    yield from _changed(model)


def _wrong_offsets(model: LinearModel) -> Family | None:
    drives = [d.name for d in model.problem.robot.drives]
    place, active, labels = model.offsets, model.active, model.labels
    scale = model.problem.theta_scale
    tried: list[tuple[AnomalyKind, int, tuple[int, ...], Array]] = []
    befores = [np.zeros(len(drives)), *active[model.order]]
    for before, k in zip(befores, model.order.tolist(), strict=False):
        tried += [(kind, k, moved, c) for kind, moved, c in enter_wrongly(before, active[k])]
    if not tried or len(place) < len(drives):
        return None

    explanations = [
        Explanation(
            kind,
            "session",
            drives=tuple(drives[i] for i in moved),
            offsets=tuple(c.tolist()),
            sessions=(labels[k],),
        )
        for kind, k, moved, c in tried
    ]
    shifts = []
    for _, k, _, c in tried:
        direction = np.zeros(scale.size)
        for i, name in enumerate(drives):
            direction[place[name]] = (active[k, i] - c[i]) / scale[place[name]]
        shifts.append(MachineShift(np.arange(len(labels)) == k, direction))
    return Family.of(explanations, shifts=shifts)


def enter_wrongly(
    before: Array, stated: Array
) -> Iterator[tuple[AnomalyKind, tuple[int, ...], Array]]:
    """Offsets that may be in a controller instead of those stated.

    Args:
        before: Offsets that were active before, shape (n_drives,), [m, rad].
        stated: Offsets that were to be entered, shape (n_drives,), [m, rad].

    Yields:
        Kind, drives concerned, and the offsets, each set of offsets once.
    """
    change, n = stated - before, stated.size
    ways: tuple[tuple[AnomalyKind, Array], ...] = (
        ("offsets not entered", before),
        ("offsets not entered", np.zeros(n)),
        ("offsets reversed", -stated),
        ("offsets reversed", before - change),
        ("offsets entered twice", 2.0 * stated),
        ("offsets entered twice", before + stated),
        ("offsets entered twice", stated + change),
    )
    seen: set[tuple[int, ...]] = {(0,) * n}

    def is_new(values: Array) -> bool:
        key = tuple(np.round((values - stated) / ROUNDING).astype(np.int64).tolist())
        new = key not in seen
        seen.add(key)
        return new

    for kind, values in ways:
        other = np.flatnonzero(np.abs(values - stated) > ROUNDING).tolist()
        sizes = range(len(other), 0, -1) if n <= MOST_DRIVES else (len(other),)
        for drives in (d for count in sizes if count for d in combinations(other, count)):
            entered = stated.copy()
            entered[list(drives)] = values[list(drives)]
            if is_new(entered):
                yield kind, drives, entered
    if n > MOST_DRIVES:
        return
    for order in permutations(range(n)):
        entered = stated[list(order)]
        if is_new(entered):
            moved = np.abs(entered - stated) > ROUNDING
            yield "offsets interchanged", tuple(np.flatnonzero(moved).tolist()), entered


def _changed(model: LinearModel) -> Iterator[Family]:
    """One parameter that differs from a session on, by an unknown amount."""
    problem = model.problem
    parameters, drive_of = problem.robot.parameters, {v: k for k, v in model.offsets.items()}
    place = {name: i for i, name in enumerate(problem.free[: problem.n_machine])}
    single: list[tuple[str, Array]] = []
    other: list[tuple[str, Array]] = []
    for name, i in place.items():
        direction = np.zeros(problem.n_free)
        direction[i] = 1.0 / problem.theta_scale[i]
        (single if i in drive_of else other).append((name, direction))
    for p in parameters:
        if len(p.terms) > 1 and p.name not in place and all(t in place for t, _ in p.terms):
            direction = np.zeros(problem.n_free)
            for term, coefficient in p.terms:
                direction[place[term]] = coefficient / problem.theta_scale[place[term]]
            other.append((p.name, direction))
    for directions in (single, other):
        if directions:
            yield _steps(model, directions, drive_of, place)


def _steps(
    model: LinearModel,
    directions: list[tuple[str, Array]],
    drive_of: dict[int, str],
    place: dict[str, int],
) -> Family:
    labels, active = model.labels, model.active
    explanations, shifts = [], []
    for later, apart in divide_sessions(model.order):
        sessions = np.isin(np.arange(len(labels)), later)
        named = tuple(labels[k] for k in (later if apart else later[:1]))
        between = np.abs(active[sessions][:, None] - active[~sessions]).max(axis=2)
        entered = bool(between.min() > ROUNDING)
        for name, direction in directions:
            drive = drive_of.get(place.get(name, -1))
            explanations.append(
                Explanation(
                    "offset of one drive" if entered and drive else "machine changed",
                    "session",
                    drives=() if drive is None else (drive,),
                    parameters=(name,),
                    sessions=named,
                    apart=apart,
                )
            )
            shifts.append(MachineShift(sessions, direction))
    return Family.of(explanations, shifts=shifts, known=False)


def divide_sessions(order: Indices) -> Iterator[tuple[list[int], bool]]:
    """Sessions in which a machine may differ from the others.

    Args:
        order: Sessions in the order of measuring, shape (n_sessions,).

    Yields:
        Those from one on, in the order of measuring. Of few sessions also any others, not more than
        half of them, as their order may have been stated wrongly; and whether they are such.
    """
    sessions, n = order.tolist(), len(order)
    for k in range(1, n):
        yield sessions[k:], False
    if n > MOST_DIVIDED:
        return
    steps = [set(sessions[k:]) for k in range(1, n)] + [set(sessions[:k]) for k in range(1, n)]
    seen: list[set[int]] = []
    for size in range(1, n // 2 + 1):
        for some in map(list, combinations(sessions, size)):
            others = set(sessions) - set(some)
            if set(some) not in steps and others not in seen:
                seen.append(set(some))
                yield some, True


def detectable_changes(session: Session) -> dict[str, float]:
    """Smallest change of each drive's offset between joined sessions that would be detected.

    Args:
        session: Joined sessions.

    Returns:
        Drive to size, [SI]; infinite where no change would be. Empty for a single session.

    Raises:
        ClosureError: If the machine cannot reach a posture.
    """
    model = linear_model(session)
    if len(model.labels) < 2 or model.dof < 1:
        return {}
    problem, offsets = model.problem, model.offsets
    about = model.at_reference(slopes=True)
    sizes = dict.fromkeys(offsets, 0.0)
    sessions = np.arange(len(model.labels))
    steps = [np.isin(sessions, later) for later, apart in divide_sessions(model.order) if not apart]
    for drive, i in offsets.items():
        direction = np.zeros(problem.n_free)
        direction[i] = 1.0 / problem.theta_scale[i]
        shifts = [MachineShift(later, direction) for later in steps]
        effects = np.array([model.shift_entries(about, s) for s in shifts])
        _, stds = about.likelihood.estimate_amounts(np.zeros_like(about.expected), effects)
        sizes[drive] = DETECTED * float(stds.max())
    return sizes
