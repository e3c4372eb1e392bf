"""Which mistakes the readings speak for: all that are known, weighed against each other.

Each edit makes the readings more or less likely. All together, with equal weights for families and
for the edits of each, they are one hypothesis against that of no mistake; its likelihood ratio
exceeds e^c by chance once in e^c sound sessions at most (Markov's inequality), however many edits
are tried. What is named must be far likelier than all other edits; else it is one of several.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthocal.hypotheses.edits import Edit, Family, Table
from orthocal.hypotheses.families.displaced_gauge import find_moved
from orthocal.hypotheses.families.inconsistent_group import find_loose
from orthocal.hypotheses.families.row_offset import find_shifted
from orthocal.hypotheses.families.single_reading import find_single
from orthocal.hypotheses.families.swapped_rows import find_exchanged
from orthocal.hypotheses.families.unit_and_sign import find_scaled
from orthocal.hypotheses.likelihood import log_of_sum
from orthocal.hypotheses.mistake import Mistake
from orthocal.hypotheses.reading_model import Linearised, ReadingModel
from orthocal.session.session import Session

Array = NDArray[np.float64]

CLEARLY = 7.0
"""Logarithm of the factor by which mistakes must make readings likelier: by chance once in e⁷ =
1,100 sessions."""

NEARLY = 3.0
"""Logarithm of the factor up to which another mistake is nearly as likely."""

FAMILIES = 24.0
"""Families that share what is likely beforehand."""

MOST_ROUNDS = 4
"""Mistakes that are sought one after the other."""

MOST_REFITTED = 6
"""Edits that are linearised where they lead."""

LARGEST_EXCESS = 5.0
"""Times its tolerances that no machine's errors are."""

LARGEST_NOISE = 2.5
"""Times what is stated of it that no noise is, once mistakes are mended."""

IN_A_ROW = ("bumped stand", "shifted rows", "stuck dial")
"""Kinds of mistake that begin somewhere and go on."""

MOST_OTHERS = 3
"""Others that are told where several are nearly as likely."""

MOST_ROWS = 1500
"""Rows of a session beyond which none is looked at by itself."""


@dataclass(frozen=True, slots=True, eq=False)
class _Weighed:
    """An edit, and how much likelier it makes the readings."""

    edit: Edit
    change: Array
    wrong: Array | None
    prior: float
    """Logarithms of its weight, and of what it does to volumes."""
    unknown: tuple[int, ...]
    loose: Array | None
    evidence: float


def find_mistakes(session: Session, model: str | None = None) -> tuple[Mistake, ...]:
    """Mistakes that the readings speak for, each once those before it were mended.

    None is told where what they leave is not what a machine shows: then something else is odd.

    Args:
        session: The session.
        model: Errors that the machine may have; all that change something by default.

    Raises:
        ClosureError: If the machine cannot reach a posture.
        RobotError: If the closures of the robot depend on each other.
        ParameterError: If the model is unknown.
    """
    if len(session.readings) < 2:
        return ()
    readings = ReadingModel(session, model)
    if readings.dof < 1:
        return ()
    found: list[Mistake] = []
    about, plausible = readings.reference_machine(), True
    for _ in range(MOST_ROUNDS):
        step = _find_one(readings, Table(session), about)
        if step is None:
            break
        found.append(step.mistake)
        about, plausible = step.about, step.plausible
        if step.mistake.others or step.mistake.kind == "stuck dial":
            break
        session = session.with_values(step.mended)
    return tuple(found) if plausible else ()


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """A mistake that was found, and what there is once it is mended."""

    mistake: Mistake
    mended: Array
    """Rows, shape (n_rows,), [m]."""
    about: Linearised
    """The machine that they are of."""
    plausible: bool
    """Whether they are what a machine shows."""


def _find_one(readings: ReadingModel, table: Table, start: Linearised) -> _Step | None:
    """The likeliest mistake, with others that are nearly as likely."""
    values = table.values
    about = readings.settle(values, None, start)
    deviation = readings.deviations(values[None], about)[0]
    sound = float(about.likelihood.weigh(deviation[None])[0])
    known = list(_weigh(readings, table, about, deviation, sound, _families(readings, table)))
    if not known or log_of_sum(np.concatenate([e for _, e in known])) < CLEARLY:
        return None
    if table.count <= MOST_ROWS:
        known += _weigh(readings, table, about, deviation, sound, find_loose(table))
    weighed = [w for family, evidence in known for w in _likeliest(family, evidence)]
    tried = [_refit(readings, values, w, sound, about) for w in _shortlist(weighed)]
    ranked = sorted(tried, key=lambda r: -r.weighed.evidence)
    # of several mistakes at once a single one leaves readings that no machine shows
    whole = [r for r in ranked if r.plausible]
    single = [r for r in ranked if r.weighed.wrong is not None and len(r.weighed.edit.rows) == 1]
    chosen = whole or single
    if not chosen or chosen[0].weighed.evidence < CLEARLY:
        return None
    best, least = chosen[0], chosen[0].weighed.evidence - NEARLY
    near = [r for r in chosen[1:] if r.weighed.evidence > least]
    here = [r for r in near if _is_same_place(best.weighed.edit, r.weighed.edit)]
    before = readings.left_at_first(values, about)
    mistake = _told(readings, best, before, here)
    others = [_told(readings, r, before, []) for r in near if r not in here][:MOST_OTHERS]
    return _Step(replace(mistake, others=tuple(others)), best.mended, best.about, bool(whole))


def _is_same_place(one: Edit, other: Edit) -> bool:
    """Whether two edits concern the same rows, or tails that begin a row apart."""
    if set(one.rows) == set(other.rows):
        return len(one.rows) == 1 or one.kind == other.kind or not (one.setups or other.setups)
    apart = set(one.rows) ^ set(other.rows)
    return one.kind == other.kind and one.kind in IN_A_ROW and len(apart) <= 1


def _families(readings: ReadingModel, table: Table) -> Iterator[Family]:
    yield from find_scaled(table, readings.sigma)
    yield from find_moved(table)
    if table.count <= MOST_ROWS:
        yield from find_single(table)
        yield from find_exchanged(table)
        yield from find_shifted(table)


def _weigh(
    readings: ReadingModel,
    table: Table,
    about: Linearised,
    deviation: Array,
    sound: float,
    families: Iterable[Family],
) -> Iterator[tuple[Family, Array]]:
    """Families, and how much likelier each of their edits makes the readings."""
    for family in families:
        if family.unknown:
            logs = np.array(
                [_weigh_unknown(readings, table, about, deviation, u) for u in family.unknown]
            )
        elif family.loose:
            of_each = [readings.entries(rows) for rows in family.loose]
            logs = np.array([about.likelihood.weigh_loose(deviation, r)[0] for r in of_each])
            logs -= sound
        else:
            wrong = None if family.wrong is None else readings.entries(family.wrong)
            edited = deviation + readings.entries(family.change)
            logs = about.likelihood.weigh(edited, wrong) - sound
        yield family, logs + _prior(family)


def _prior(family: Family) -> Array:
    """Logarithms of the weights of edits, and of what they do to volumes."""
    prior = np.full(len(family.edits), -np.log(family.size * FAMILIES))
    return prior + family.log_volume if family.log_volume.size else prior


def _likeliest(family: Family, evidence: Array) -> Iterator[_Weighed]:
    prior = _prior(family)
    for h in np.argsort(-evidence)[:MOST_REFITTED].tolist():
        yield _Weighed(
            family.edits[h](),
            family.change[h],
            None if family.wrong is None else family.wrong[h],
            float(prior[h]),
            family.unknown[h] if family.unknown else (),
            family.loose[h] if family.loose else None,
            float(evidence[h]),
        )


def _weigh_unknown(
    readings: ReadingModel,
    table: Table,
    about: Linearised,
    deviation: Array,
    rows: tuple[int, ...],
) -> float:
    """Readings that repeat what the dial showed before, by a dial that shows steps."""
    marks = np.zeros((len(rows), table.count))
    marks[np.arange(len(rows)), list(rows)] = 1.0
    setup = table.session.readings[rows[0]].setup
    gauge = table.session.gauges[table.session.setups[setup].gauge]
    step = gauge.resolution or readings.sigma
    gain = about.likelihood.weigh_without(deviation, readings.entries(marks))
    return gain - len(rows) * float(np.log(step))


def _shortlist(weighed: list[_Weighed]) -> list[_Weighed]:
    """The likeliest, and the likeliest of each kind that is not far behind."""
    ranked = sorted(weighed, key=lambda w: -w.evidence)
    kinds: dict[str, _Weighed] = {}
    for w in ranked:
        if w.evidence > 0.0:
            kinds.setdefault(w.edit.kind, w)
    chosen = ranked[: MOST_REFITTED // 2]
    more = [w for w in kinds.values() if w not in chosen]
    return [*chosen, *more][:MOST_REFITTED]


@dataclass(frozen=True, slots=True, eq=False)
class _Refitted:
    """An edit, linearised where the readings are that it makes."""

    weighed: _Weighed
    about: Linearised
    mended: Array
    """Rows, shape (n_rows,), [m]."""
    plausible: bool


def _refit(
    readings: ReadingModel, values: Array, w: _Weighed, sound: float, about: Linearised
) -> _Refitted:
    if w.unknown:
        return _Refitted(w, about, values, plausible=True)
    if w.loose is not None:
        return _refit_loose(readings, values, w, w.loose, sound, about)
    rows = values + w.change
    own = readings.settle(rows, w.wrong, about)
    wrong = None if w.wrong is None else readings.entries(w.wrong[None])
    deviation = readings.deviations(rows[None], own)
    logs = own.likelihood.weigh(deviation, wrong)
    excess, noise, amount = own.likelihood.settle(deviation[0], None if wrong is None else wrong[0])
    if w.wrong is not None:
        rows = rows - amount * w.wrong
    return _Refitted(
        replace(w, evidence=float(logs[0]) - sound + w.prior),
        own,
        rows,
        excess < LARGEST_EXCESS and (noise < LARGEST_NOISE or not readings.stated),
    )


def _refit_loose(
    readings: ReadingModel,
    values: Array,
    w: _Weighed,
    loose: Array,
    sound: float,
    about: Linearised,
) -> _Refitted:
    marks, own, rows = readings.entries(loose), about, values
    for _ in range(2):
        deviation = readings.deviations(values[None], own)[0]
        logs, amounts = own.likelihood.weigh_loose(deviation, marks)
        rows = values - amounts @ loose
        own, last = readings.settle(rows, None, own), own
    excess, noise, _ = last.likelihood.settle(readings.deviations(rows[None], last)[0])
    return _Refitted(
        replace(w, evidence=logs - sound + w.prior),
        last,
        rows,
        excess < LARGEST_EXCESS and (noise < LARGEST_NOISE or not readings.stated),
    )


def _told(
    readings: ReadingModel, found: _Refitted, before: float, here: list[_Refitted]
) -> Mistake:
    """A mistake as it is told.

    Args:
        readings: The readings.
        found: The edit that mends it.
        before: What is left before it is mended, r.m.s., [m].
        here: Others of the same place that are nearly as likely.
    """
    w = found.weighed
    edit = w.edit
    after = before if w.unknown else readings.left_over(found.mended, found.about)
    kind, mend = edit.kind, edit.mend
    perhaps: tuple[str, ...] = ()
    ways = [r.weighed.edit for r in here if set(r.weighed.edit.rows) == set(edit.rows)]
    if any(way.kind != edit.kind for way in ways):
        kind = "suspicious reading" if len(edit.rows) == 1 else "suspicious posture"
        mend = "Read it again, or leave it out."
        perhaps = tuple(way.text for way in (edit, *ways))
    return Mistake(
        kind,
        edit.text,
        mend,
        edit.rows,
        edit.setups,
        w.evidence,
        before,
        after,
        float(found.mended[edit.rows[0]]) if len(edit.rows) == 1 else None,
        perhaps,
    )
