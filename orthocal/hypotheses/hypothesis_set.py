"""Sets of hypotheses: terms, scores and comparison of two sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthocal.arrays import Array
from orthocal.hypotheses.anomaly import Explanation
from orthocal.hypotheses.hypothesis import MachineShift, SystematicEffect
from orthocal.hypotheses.likelihood import Score
from orthocal.hypotheses.linearisation import ModelLinearisation
from orthocal.session.session import Session
from orthocal.units import LIMIT

MIN_LOST = 2
"""Number of wrong readings that are as simple as lost steps."""

MAX_ALTERNATIVES = 8
"""Most alternatives of an anomaly that are listed."""


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """One hypothesis of a set."""

    explanation: Explanation
    prior: float
    """Logarithm of its prior probability, including the volume factor."""
    change: Array | None = None
    """Correction of the rows, shape (n_rows,), [m]."""
    effects: Array | None = None
    """Effects of unknown amounts on the rows, shape (k, n_rows)."""
    systematic: SystematicEffect | None = None
    """Effect of the machine; its change and columns are in `change` and `effects`."""
    silent: NDArray[np.int64] | None = None
    """Rows without information."""
    shift: MachineShift | None = None
    known: bool = True
    """Whether the amount of the shift is known."""
    unit: float = 1.0
    """Unit of the amount of a single effect: the noise of its gauge relative to the first one."""

    @property
    def unknown_shift(self) -> MachineShift | None:
        """Machine shift of unknown amount; None without one."""
        return None if self.known else self.shift


@dataclass(frozen=True, slots=True, eq=False)
class HypothesisSet:
    """A set of hypotheses, linearised about the machine that it implies."""

    terms: tuple[Term, ...]
    score: Score
    about: ModelLinearisation
    remaining: Array
    """Deviation of the corrected entries, shape (n_entries,), [m]."""
    corrected: Array
    """Corrected rows, shape (n_rows,), [m]."""
    amounts: tuple[Array, ...]
    """Unknown amounts of each term, [m] times its unit; of machine shifts in units of their
    direction."""
    stds: tuple[Array, ...]
    """Standard deviations of the amounts."""

    @property
    def log_posterior(self) -> float:
        """Logarithm of marginal likelihood times prior probability."""
        return self.score.log_likelihood + sum(t.prior for t in self.terms)

    @property
    def size(self) -> tuple[int, int, int]:
        """Numbers of hypotheses, of rows and of drives; a simpler set has a smaller size.

        A mistake in entering the numbers of all drives is simpler than one of some of them, and
        that is simpler than an unknown number. Lost steps are less simple than one wrong reading.
        """
        explanations = [t.explanation for t in self.terms]
        rows = sum(len(e.rows) if e.first is None else MIN_LOST for e in explanations)
        return len(self.terms), rows, sum(map(_count_drives, explanations))

    @property
    def changes_are_significant(self) -> bool:
        """True if no change of the machine by an unknown amount may be 0, at 95 %."""
        return all(
            abs(a[0]) > LIMIT * std[0]
            for t, a, std in zip(self.terms, self.amounts, self.stds, strict=True)
            if t.unknown_shift is not None
        )


def _count_drives(e: Explanation) -> int:
    """Drives or settings with wrong numbers: 0 if all have them, 2 if the number is unknown."""
    if e.names and not e.rows:  # settings of a printer
        return len(e.names)
    if e.active:
        return 0 if len(e.drives) == len(e.active) else len(e.drives)
    return 2 if e.parameters and not e.rows else 0


def split_amounts(terms: Sequence[Term], amounts: Array) -> tuple[Array, ...]:
    """Split amounts by term.

    Args:
        terms: The hypotheses.
        amounts: Amounts of all effects and unknown shifts, then of all silent rows, shape (k,).
    """
    sizes = [
        len(t.effects) if t.effects is not None else int(t.unknown_shift is not None) for t in terms
    ]
    silent = [0 if t.silent is None else len(t.silent) for t in terms]
    effect_ends, silent_ends = np.cumsum([0, *sizes]), np.cumsum([sum(sizes), *silent])
    ends = [silent_ends if n else effect_ends for n in silent]
    return tuple(amounts[e[i] : e[i + 1]] for i, e in enumerate(ends))


def correct_rows(rows: Array, terms: Sequence[Term], amounts: Sequence[Array]) -> Array:
    """Subtract the effects of unknown amounts and the errors of silent rows from the rows."""
    corrected = rows.copy()
    for t, a in zip(terms, amounts, strict=True):
        if t.effects is not None:
            corrected -= a @ t.effects
        elif t.silent is not None:
            corrected[t.silent] -= a
    return corrected


def explain_with_amounts(state: HypothesisSet) -> list[Explanation]:
    """Explanations of all terms with their estimated amounts."""
    explanations = []
    for term, amounts, stds in zip(state.terms, state.amounts, state.stds, strict=True):
        e = term.explanation
        unit = term.unit if term.shift is None else term.shift.unit
        single = term.effects is not None and len(term.effects) == 1 and e.kind != "row offset"
        if term.systematic is not None:
            e = _with_parameters(e, term.systematic, amounts, stds)
        elif single or term.unknown_shift is not None:
            e = replace(e, amount=float(amounts[0] * unit), std=float(stds[0] * unit))
        explanations.append(e)
    return explanations


def _with_parameters(
    e: Explanation, effect: SystematicEffect, amounts: Array, stds: Array
) -> Explanation:
    """Explanation with the estimated parameters of an effect.

    Args:
        e: The explanation.
        effect: The effect.
        amounts: Estimates of its parameters, shape (k,), [prior std].
        stds: Standard deviations of the estimates, shape (k,), [prior std].
    """
    values = np.where(effect.positive, np.maximum(amounts, 0.0), amounts)
    return replace(
        e,
        amount=float(np.ptp(effect.change + values @ effect.columns)),
        parameters=tuple(p.name for p in effect.parameters),
        units=tuple(p.unit for p in effect.parameters),
        amounts=tuple((values * effect.prior_stds).tolist()),
        stds=tuple((stds * effect.prior_stds).tolist()),
    )


def is_same_place(one: HypothesisSet, other: HypothesisSet) -> bool:
    """True if two sets concern the same rows, hypothesis by hypothesis."""
    return len(one.terms) == len(other.terms) and not any(_unmatched(one.terms, other.terms))


def adds_a_setup(other: HypothesisSet, chosen: HypothesisSet) -> bool:
    """True if another set is the chosen one with the sign of one more setup reversed."""
    return len(other.terms) == len(chosen.terms) and all(
        t is u
        or (
            t.explanation.kind == u.explanation.kind == "reversed sign"
            and t.explanation.scope == "setups"
            and set(t.explanation.setups) > set(u.explanation.setups) > set()
        )
        for t, u in zip(other.terms, chosen.terms, strict=True)
    )


def share_rows(one: Term, other: Term) -> bool:
    """True if two hypotheses concern a common row."""
    return bool(set(one.explanation.rows) & set(other.explanation.rows))


def distinct_terms(terms: Sequence[Term]) -> list[Term]:
    """Hypotheses that share no row with a preceding one."""
    distinct: list[Term] = []
    for t in terms:
        if not any(share_rows(t, preceding) for preceding in distinct):
            distinct.append(t)
    return distinct


def _unmatched(one: Sequence[Term], other: Sequence[Term]) -> tuple[list[Term], list[Term]]:
    """Hypotheses of each set without a matching one in the other set."""

    def without(a: Sequence[Term], b: Sequence[Term]) -> list[Term]:
        return [t for t in a if not any(t.explanation.agrees_with(u.explanation) for u in b)]

    return without(one, other), without(other, one)


def is_local(session: Session, state: HypothesisSet, near: Sequence[HypothesisSet]) -> bool:
    """True if the alternatives concern only setups of the chosen set."""

    def setups(s: HypothesisSet) -> set[str]:
        return {session.readings[i].setup for t in s.terms for i in t.explanation.rows}

    return all(setups(s) <= setups(state) for s in near)


def find_alternatives(
    term: Term, near: Sequence[tuple[HypothesisSet, HypothesisSet]]
) -> tuple[tuple[Explanation, ...], tuple[Explanation, ...]]:
    """Other causes in the same rows, and alternatives in other rows, the most likely first.

    Args:
        term: A hypothesis.
        near: Pairs of a chosen set of hypotheses and a nearly as likely set.
    """
    e = term.explanation
    causes: dict[tuple[object, ...], Explanation] = {}
    alternatives: dict[Explanation, None] = {}
    for chosen, s in sorted(near, key=lambda pair: -pair[1].log_posterior):
        if not any(t is term for t in chosen.terms):
            continue
        only_chosen, only_other = _unmatched(chosen.terms, s.terms)
        if any(t is term for t in only_chosen):
            for t, explanation in zip(s.terms, explain_with_amounts(s), strict=True):
                if any(t is o for o in only_other):
                    alternatives[explanation] = None
            continue
        for cause in explain_with_amounts(s):
            if set(cause.rows) == set(e.rows) and e.agrees_with(cause) and cause.kind != e.kind:
                amount = cause.amount if cause.kind == "misread dial" else None
                causes.setdefault((cause.kind, cause.factor, amount), cause)
    return tuple(causes.values()), tuple(alternatives)[:MAX_ALTERNATIVES]
