"""Wrong numbers of the controller, lost steps, and changes of the machine between joined sessions.

If a session states the offsets or backlashes E but its controller has C, its machine appears to
have errors that differ by E − C.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations, permutations

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.estimation.problem import CalibrationProblem
from orthocal.hypotheses.anomaly import AnomalyKind, Explanation
from orthocal.hypotheses.hypothesis import Family, MachineShift, Rows
from orthocal.hypotheses.joined_sessions import divide_sessions
from orthocal.hypotheses.linear_model import LinearModel, linear_model
from orthocal.session.session import Session

MAX_DRIVES = 6
"""Most drives of a robot of which all subsets are considered."""

MIN_READINGS = 4
"""Fewest readings of a session before and after a loss of steps; wrong readings explain fewer."""

LOG_PROBABILITY_OF_LOSS = -3.0
"""Logarithm of the prior probability of lost steps relative to other families. Drives lose steps
more rarely than a gauge is displaced, which looks the same in the last setup."""

MAX_SCORED = 2_000_000
"""Most readings of all hypotheses of lost steps together. In larger sessions fewer readings are
considered."""

DETECTABLE_CHANGE = 5.5
"""Smallest change, relative to its standard deviation, with clear evidence."""

ROUNDING = 1e-6
"""Differences of stated numbers up to this are neglected, [m, rad]."""

Mistake = tuple[AnomalyKind, tuple[int, ...], Array]
"""Kind of mistake, indices of the drives concerned, and the numbers in the controller, shape
(n_drives,), [m, rad]."""

Enter = Callable[[Array, Array], Iterator[Mistake]]
"""Mistakes of entering numbers, from the previous and the stated ones."""


def changes_between_sessions(model: LinearModel) -> Iterator[Family]:
    """Wrongly entered numbers and changes of the machine; for a single session only backlash."""
    yield from _of_controller(model, "backlash", model.sessions.compensated, enter_backlash_wrongly)
    if len(model.sessions.labels) > 1:
        yield from _of_controller(model, "offset", model.sessions.active, enter_wrongly)
        yield from _changed(model)


def _of_controller(
    model: LinearModel, parameter: str, stated: Array, enter: Enter
) -> Iterator[Family]:
    """Numbers of a session that were entered wrongly, each mistake once.

    Args:
        model: The linearised model.
        parameter: Name of the error of a drive that the controller corrects.
        stated: Stated numbers, shape (n_sessions, n_drives), [m, rad].
        enter: Mistakes of entering them.
    """
    drives = [d.name for d in model.problem.robot.drives]
    names = [f"{name}.{parameter}" for name in drives]
    if not set(names) <= set(model.problem.free):
        return
    place = [model.problem.free.index(name) for name in names]
    explanations, shifts = [], []
    previous = [np.zeros(len(drives)), *stated[model.sessions.order]]
    for before, k in zip(previous, model.sessions.order.tolist(), strict=False):
        for kind, concerned, active in enter(before, stated[k]):
            explanations.append(
                Explanation(
                    kind,
                    "session",
                    drives=tuple(drives[i] for i in concerned),
                    parameters=tuple(names[i] for i in concerned),
                    active=tuple(active.tolist()),
                    sessions=tuple(filter(None, model.sessions.labels[k : k + 1])),
                )
            )
            changes = dict(zip(place, stated[k] - active, strict=True))
            direction = _direction(model.problem, changes)
            shifts.append(MachineShift(model.sessions.of_entry == k, direction))
    yield Family.of(explanations, shifts=shifts)


def _direction(problem: CalibrationProblem, changes: Mapping[int, float]) -> Array:
    """Change of all free parameters, shape (n_free,), [prior std], from those of some, [SI]."""
    direction = np.zeros(problem.n_free)
    for i, change in changes.items():
        direction[i] = change / problem.theta_scale[i]
    return direction


def enter_wrongly(before: Array, stated: Array) -> Iterator[Mistake]:
    """Offsets that the controller may have instead of the stated ones.

    Args:
        before: Previously active offsets, shape (n_drives,), [m, rad].
        stated: Offsets that were to be entered, shape (n_drives,), [m, rad].
    """
    change, n = stated - before, stated.size
    mistakes: list[tuple[AnomalyKind, Array]] = [
        ("offsets not entered", before),
        ("offsets not entered", np.zeros(n)),
        ("offsets reversed", -stated),
        ("offsets reversed", before - change),
        ("offsets entered twice", 2.0 * stated),
        ("offsets entered twice", before + stated),
        ("offsets entered twice", stated + change),
    ]
    if n <= MAX_DRIVES:
        mistakes += [("offsets interchanged", stated[list(p)]) for p in permutations(range(n))]
    return _by_drives(stated, mistakes)


def enter_backlash_wrongly(before: Array, stated: Array) -> Iterator[Mistake]:
    """Backlashes that the controller may compensate instead of the stated ones.

    A controller in which half of the lost motion is entered compensates half of it.

    Args:
        before: Previously compensated backlashes, shape (n_drives,), [m, rad].
        stated: Backlashes that were to be entered, shape (n_drives,), [m, rad].
    """
    return _by_drives(
        stated,
        [
            ("backlash not entered", before),
            ("backlash not entered", np.zeros_like(stated)),
            ("backlash halved", 0.5 * stated),
            ("backlash entered twice", 2.0 * stated),
        ],
    )


def _by_drives(stated: Array, mistakes: Sequence[tuple[AnomalyKind, Array]]) -> Iterator[Mistake]:
    """Mistakes of all drives and of some of them, each set of numbers once.

    Args:
        stated: Stated numbers, shape (n_drives,), [m, rad].
        mistakes: Kind of mistake, and numbers of all drives in the controller, (n_drives,).
    """
    n = stated.size
    seen: set[tuple[int, ...]] = {(0,) * n}
    for kind, values in mistakes:
        differing = np.flatnonzero(np.abs(values - stated) > ROUNDING).tolist()
        apart = n <= MAX_DRIVES and kind != "offsets interchanged"
        for count in range(len(differing), 0 if apart else len(differing) - 1, -1):
            for drives in combinations(differing, count):
                active = stated.copy()
                active[list(drives)] = values[list(drives)]
                key = tuple(np.round((active - stated) / ROUNDING).astype(np.int64).tolist())
                if key not in seen:
                    seen.add(key)
                    yield kind, drives, active


def _changed(model: LinearModel) -> Iterator[Family]:
    """One parameter that changes between sessions by an unknown amount."""
    problem, offsets = model.problem, {f"{drive}.offset": drive for drive in model.offsets}
    place = {name: i for i, name in enumerate(problem.free[: problem.n_machine])}
    changes = {name: {i: 1.0} for name, i in place.items()}
    for p in problem.robot.parameters:
        if len(p.terms) > 1 and p.name not in place and all(t in place for t, _ in p.terms):
            changes[p.name] = {place[term]: coefficient for term, coefficient in p.terms}
    directions = {name: _direction(problem, change) for name, change in changes.items()}
    yield _steps(model, {n: d for n, d in directions.items() if n in offsets}, offsets)
    yield _steps(model, {n: d for n, d in directions.items() if n not in offsets}, {})


def _steps(
    model: LinearModel, directions: Mapping[str, Array], offsets: Mapping[str, str]
) -> Family:
    """Change in each direction for each division of the sessions.

    Args:
        model: The linearised model.
        directions: Name of a parameter to its change, shape (n_free,), [prior std].
        offsets: Name of an offset to its drive.
    """
    labels, active = model.sessions.labels, model.sessions.active
    explanations, shifts = [], []
    for later, apart in divide_sessions(model.sessions.order):
        sessions = model.sessions.are_in(later)
        names = tuple(labels[k] for k in (later if apart else later[:1]))
        differences = np.abs(active[sessions][:, None] - active[~sessions]).max(axis=2)
        entered = bool(differences.min() > ROUNDING)
        for name, direction in directions.items():
            drive = offsets.get(name)
            explanations.append(
                Explanation(
                    "offset of one drive" if entered and drive else "machine changed",
                    "session",
                    drives=() if drive is None else (drive,),
                    parameters=(name,),
                    sessions=names,
                    apart=apart,
                )
            )
            shifts.append(MachineShift(sessions[model.sessions.of_entry], direction))
    return Family.of(explanations, shifts=shifts, known=False)


def lost_steps(model: LinearModel, rows: Rows) -> Iterator[Family]:
    """Loss of steps of a drive within a session; none if no offset is identified.

    Large single sessions have none (see `LinearModel.has_shifts`).

    Args:
        model: The linearised model.
        rows: The rows.
    """
    if not model.has_shifts:
        return
    problem, explanations, shifts = model.problem, [], []
    plus, minus = problem.observations.plus, problem.observations.minus
    session_of_row = model.sessions.of_entry[plus]
    for drive, i in model.offsets.items():
        direction = _direction(problem, {i: 1.0})
        for k, label in enumerate(model.sessions.labels):
            of_session = np.flatnonzero(session_of_row == k)
            for first in _first_readings(of_session, len(model.offsets) * rows.count):
                later = of_session[of_session >= first]
                entries = np.zeros(problem.observations.size, dtype=np.bool_)
                entries[plus[later]] = True
                entries[minus[later][minus[later] >= 0]] = True
                explanations.append(
                    Explanation(
                        "lost steps",
                        "session",
                        first=int(first),
                        drives=(drive,),
                        parameters=(problem.free[i],),
                        sessions=tuple(filter(None, (label,))),
                    )
                )
                shifts.append(MachineShift(entries, direction))
    rarity = np.full(len(shifts), LOG_PROBABILITY_OF_LOSS)
    yield Family.of(explanations, shifts=shifts, known=False, log_volume=rarity)


def _first_readings(rows: Indices, size: int) -> Indices:
    """First readings after a loss that are considered, evenly spaced in large sessions.

    Args:
        rows: Rows of the session, in the order of measuring.
        size: Number of readings in the hypotheses of one place.
    """
    possible = rows[MIN_READINGS : rows.size - MIN_READINGS + 1]
    step = max(1, -(-possible.size * size // MAX_SCORED))
    return possible[::step]


def detectable_changes(session: Session) -> dict[str, float]:
    """Smallest detectable change of each drive's offset between joined sessions.

    Args:
        session: Joined sessions.

    Returns:
        Drive to change, [SI]; infinite if no change is detectable. Empty for a single session.

    Raises:
        ClosureError: If the machine cannot reach a posture.
    """
    model = linear_model(session)
    if len(model.sessions.labels) < 2 or model.dof < 1:
        return {}
    problem, offsets = model.problem, model.offsets
    about = model.at_reference(keep_jacobian=True)
    changes = dict.fromkeys(offsets, 0.0)
    sessions = model.sessions
    steps = [
        sessions.are_in(later) for later, apart in divide_sessions(sessions.order) if not apart
    ]
    for drive, i in offsets.items():
        direction = _direction(problem, {i: 1.0})
        shifts = [MachineShift(later[sessions.of_entry], direction) for later in steps]
        effects = np.array([model.shift_entries(about, s) for s in shifts])
        _, stds = about.likelihood.estimate_amounts(np.zeros_like(about.expected), effects)
        changes[drive] = DETECTABLE_CHANGE * float(stds.max())
    return changes
