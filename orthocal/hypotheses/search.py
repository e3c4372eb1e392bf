"""Search for anomalies: all hypotheses are compared by one marginal likelihood.

Families share the prior probability equally, and so do the hypotheses of each family. In at most
one of e^c sound sessions the Bayes factor of their mixture against no anomaly exceeds e^c (Markov's
inequality). This does not depend on the number of hypotheses. Anomalies are added one by one
(forward selection), in small sessions also in pairs (`pairs.py`). Anomalies that others explain are
removed again (backward elimination). The most likely hypotheses are relinearised.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from orthocal.arrays import Array
from orthocal.hypotheses.anomaly import Anomalies, Anomaly, AnomalyKind
from orthocal.hypotheses.families.effects import find_effects, unmodelled_effects
from orthocal.hypotheses.families.sessions import MAX_DRIVES
from orthocal.hypotheses.families.wrong_readings import inconsistent_groups
from orthocal.hypotheses.family_scores import (
    CLEAR_LOG_BAYES,
    COARSE_MARGIN,
    N_FAMILIES,
    REFIT_LOG_BAYES,
    SIMILAR_LOG_BAYES,
    FamilyScorer,
    list_families,
)
from orthocal.hypotheses.hypothesis import Family, Rows, SystematicEffect
from orthocal.hypotheses.hypothesis_set import (
    HypothesisSet,
    Term,
    adds_a_setup,
    distinct_terms,
    explain_with_amounts,
    find_alternatives,
    is_local,
    is_same_place,
    share_rows,
)
from orthocal.hypotheses.likelihood import log_of_sum
from orthocal.hypotheses.linear_model import LinearModel, linear_model
from orthocal.hypotheses.set_evaluation import SetEvaluator
from orthocal.session.session import Session

CLEAR_EFFECT_LOG_BAYES = 4.5
"""Smallest log Bayes factor, without prior probabilities, of a reported effect that the model
lacks. It is smaller than CLEAR_LOG_BAYES because such effects are usual. By chance at most one of
90 sessions reaches it, far fewer in simulations (`tests/benchmarks/checking.py --effects 1000`)."""

MAX_ANOMALIES = 4
"""Most anomalies that are sought in a session."""

MAX_COMBINED = 5
"""Number of the most likely single hypotheses that are combined in pairs if none of them alone
makes the readings plausible."""

MIN_GAIN = 0.1
"""Smallest gain of log posterior by which another machine fits readings without anomaly better."""

LARGEST_TOLERANCE_SCALE = 5.0
"""Upper limit of the tolerance scale of a plausible machine."""

UNUSUAL_TOLERANCE_SCALE = 2.0
"""Tolerance scale above which a machine without anomaly is compared with the most likely one."""

LARGEST_NOISE_SCALE = 2.5
"""Upper limit of the noise scale of a plausible gauge with a stated noise."""


Near = list[tuple[HypothesisSet, HypothesisSet]]
"""Pairs of the set after a step and a nearly as likely one."""


def find_anomalies(session: Session) -> Anomalies:
    """Find the anomalies of a session.

    Args:
        session: A session, or several joined ones.

    Raises:
        ClosureError: If the machine cannot reach a posture.
        RobotError: If closures of the robot depend on each other.
    """
    linear = linear_model(session)
    if len(session.readings) < 2 or linear.dof < 1:
        return Anomalies((), True, 0.0, 0.0, 1.0)
    return _Search(session, linear).run()


def find_suspected_rows(session: Session) -> tuple[int, ...]:
    """Rows of the most likely single mistakes, however weak their evidence.

    A row offset counts with its first row only: the others are right but for their place.

    Args:
        session: Readings that contradict each other.

    Raises:
        ClosureError: If the machine cannot reach a posture.
        RobotError: If closures of the robot depend on each other.
    """
    search = _Search(session, linear_model(session))
    return search.suspected_rows(search.sound)


class _Search:
    """The search in one session."""

    def __init__(self, session: Session, model: LinearModel) -> None:
        self.session, self.model = session, model
        self.effects = find_effects(model)
        self.sets = SetEvaluator(model, session.values)
        self.sound = self.sets.sound
        self.scorer = FamilyScorer(model, self.sound.about)

    def run(self) -> Anomalies:
        """Search by forward selection and backward elimination.

        Readings without anomaly are first explained by a machine near the reference, which shows
        mistakes best. If something is found or that machine is unusual, the most likely machine of
        all is compared with it, and the search is repeated about that one if it is as likely.
        """
        state, near = self._search()
        unusual = state.score.tolerance_scale > UNUSUAL_TOLERANCE_SCALE
        if state.terms or unusual or not self.is_plausible(state):
            sound = self.sets.most_likely()
            if sound is not None and sound.log_posterior > self.sound.log_posterior + MIN_GAIN:
                needed = max((_needed(t) for t in state.terms), default=CLEAR_LOG_BAYES)
                self.sound = sound
                if state.log_posterior < sound.log_posterior + needed:
                    self.scorer = FamilyScorer(self.model, sound.about)
                    state, near = self._search()
        return self._result(*self._confirm(state), near)

    def _search(self) -> tuple[HypothesisSet, Near]:
        """Select hypotheses about the present sound set; returns as `_select` does.

        A wrong unit or decimal point of many readings also explains a small part of several gross
        errors. If one is found, the search is repeated without such groups of readings. A
        correction is not proposed if it increases the residuals and the readings stay implausible.
        """
        state, near = self._select(grouped=True)
        if any(t.explanation.factor and len(t.explanation.rows) > 1 for t in state.terms):
            other = self._select(grouped=False)
            if other[0].log_posterior > state.log_posterior + SIMILAR_LOG_BAYES or self._worsens(
                state
            ):
                state, near = other
        return (self.sound, []) if self._worsens(state) else (state, near)

    def _worsens(self, state: HypothesisSet) -> bool:
        """True if a correction increases the residuals and the readings are implausible."""
        before, after = (self.model.rms(s.remaining, s.about) for s in (self.sound, state))
        return after > before and not self.is_plausible(state)

    def _select(self, *, grouped: bool) -> tuple[HypothesisSet, Near]:
        """Select a set of hypotheses step by step.

        Args:
            grouped: Whether units and signs of groups of readings are considered.

        Returns:
            The set; and nearly as likely ones.
        """
        state = self.sound
        near: Near = []
        while len(state.terms) < MAX_ANOMALIES:
            extended, alternatives = self._step(state, grouped=grouped)
            if extended is None:
                break
            state = self._eliminate(extended)
            near += [(extended, s) for s in alternatives]
            if alternatives and not is_local(self.session, state, alternatives):
                break
        return state, near

    def _step(
        self, state: HypothesisSet, *, grouped: bool
    ) -> tuple[HypothesisSet | None, list[HypothesisSet]]:
        """The best set with one or two further hypotheses, and nearly as likely other sets."""
        rows = Rows(self.session, state.corrected)
        families = [
            *list_families(self.model, rows, grouped=grouped),
            *unmodelled_effects(rows, self._lacking(state)),
        ]
        scored = list(self.scorer.score(state, families))
        likely_effects = [
            self.scorer.term(f, 0)
            for f, evidence in scored
            if f.systematic
            and evidence[0] > CLEAR_EFFECT_LOG_BAYES - np.log(N_FAMILIES) - COARSE_MARGIN
        ]
        totals = [log_of_sum(evidence) for _, evidence in scored]
        pairs: list[tuple[Term, Term]] = []
        total = -np.inf
        if len(state.terms) + 2 <= MAX_ANOMALIES:
            pairs, total = self.scorer.pairs(state, scored)
        best = float(log_of_sum(np.array([*totals, total]))) if totals else -np.inf
        far = self.sets.evaluate_all(
            [(*state.terms, t) for t in self.scorer.far_terms(scored)], self.sets.reference
        )
        is_far_clear = any(_is_clear(s, state) for s in far)
        if best < REFIT_LOG_BAYES and not likely_effects and not is_far_clear:
            return None, []
        scored += list(self.scorer.score(state, inconsistent_groups(rows)))
        single = self.scorer.shortlist(scored)
        additions = [
            *((t,) for t in (*likely_effects, *single)),
            *pairs,
            *self._drive_combinations(state, scored),
        ]
        extended = far + self.sets.evaluate_all(
            [(*state.terms, *added) for added in additions], state.about
        )
        likeliest = max(extended, key=lambda s: s.log_posterior)
        if not self.is_plausible(likeliest) and len(state.terms) + 2 <= MAX_ANOMALIES:
            extended += self._combine(state, single)
        ranked = sorted(extended, key=lambda s: s.log_posterior, reverse=True)
        # correcting one of several anomalies leads to implausible readings
        plausible = [s for s in ranked if self.is_plausible(s)]
        if plausible and plausible[0].log_posterior > ranked[0].log_posterior - CLEAR_LOG_BAYES:
            ranked = plausible
        clear = [s for s in ranked if _is_clear(s, state)]
        if not clear or clear[0].log_posterior < ranked[0].log_posterior - SIMILAR_LOG_BAYES:
            return None, []
        if not _is_clear(ranked[0], state):
            return clear[0], []
        near = _nearly_as_likely(ranked, plausible)
        if _needed(ranked[0].terms[-1]) < CLEAR_LOG_BAYES:
            near = [s for s in near if _is_clear(s, state)]
        simplest = min(near, key=lambda s: s.size)
        if is_same_place(simplest, near[0]):
            simplest = near[0]
        # a setup whose sign makes no difference casts no doubt on the other one
        return simplest, [s for s in near if s is not simplest and not adds_a_setup(s, simplest)]

    def _lacking(self, state: HypothesisSet) -> list[SystematicEffect]:
        """Effects of the machine that a state lacks."""
        present = {t.systematic.name for t in state.terms if t.systematic is not None}
        return [e for e in self.effects if e.name not in present]

    def _drive_combinations(
        self, state: HypothesisSet, scored: list[tuple[Family, Array]]
    ) -> Iterator[tuple[Term, ...]]:
        """Changes of two or more drives between the same sessions."""
        present = {(t.explanation.drives, t.explanation.sessions) for t in state.terms}
        by_sessions: dict[tuple[str, ...], list[Term]] = {}
        for family, _ in scored:
            for h in range(len(family.shifts) if not family.known else 0):
                e = family.explain(h)
                lost = e.kind == "lost steps"
                if e.drives and not lost and (e.drives, e.sessions) not in present:
                    by_sessions.setdefault(e.sessions, []).append(self.scorer.term(family, h))
        for terms in by_sessions.values():
            if len(terms) <= MAX_DRIVES:
                for count in range(2, min(len(terms), MAX_ANOMALIES - len(state.terms)) + 1):
                    yield from combinations(terms, count)

    def _combine(self, state: HypothesisSet, single: list[Term]) -> list[HypothesisSet]:
        """Sets with two of the most likely hypotheses, if neither suffices alone.

        In the best pair each hypothesis is also replaced by others of the same rows.
        """
        pairs = combinations(distinct_terms(single)[:MAX_COMBINED], 2)
        sets = self.sets.evaluate_all([(*state.terms, *pair) for pair in pairs], state.about)
        if not sets:
            return []
        one, other = max(sets, key=lambda s: s.log_posterior).terms[-2:]
        variants = [
            (t, partner)
            for replaced, partner in ((one, other), (other, one))
            for t in single
            if t is not replaced and not share_rows(t, partner) and share_rows(t, replaced)
        ]
        return sets + self.sets.evaluate_all(
            [(*state.terms, *pair) for pair in variants], state.about
        )

    def is_plausible(self, state: HypothesisSet) -> bool:
        """True if a machine near its tolerances explains the corrected readings."""
        score = state.score
        quiet = score.noise_scale < LARGEST_NOISE_SCALE or not self.model.stated
        return score.tolerance_scale < LARGEST_TOLERANCE_SCALE and quiet

    def _eliminate(self, state: HypothesisSet) -> HypothesisSet:
        """Remove hypotheses that the others make superfluous."""
        while len(state.terms) > 1:
            needed = [min(SIMILAR_LOG_BAYES, _needed(removed)) for removed in state.terms]
            evaluated = self.sets.evaluate_all(_reduced(state), self.sound.about)
            reduced = zip(needed, evaluated, strict=True)
            needed_gain, best = max(reduced, key=lambda pair: pair[1].log_posterior)
            if best.log_posterior < state.log_posterior - needed_gain:
                break
            state = best
        return state

    def _confirm(self, state: HypothesisSet) -> tuple[HypothesisSet, list[HypothesisSet]]:
        """Remove hypotheses that the others and a plausible machine make superfluous.

        One hypothesis alone remains: several similar ones may have been clear together.

        Returns:
            The set, and the sets without each of its hypotheses, about the most likely machine of
            their readings if that is more likely.
        """
        while len(state.terms) > 1:
            near = self.sets.evaluate_all(_reduced(state), self.sound.about)
            reoptimised = [self.sets.most_likely(s.terms) or s for s in near]
            without = [
                max(pair, key=lambda s: s.log_posterior)
                for pair in zip(near, reoptimised, strict=True)
            ]
            superfluous = [
                s
                for t, s in zip(state.terms, without, strict=True)
                if self.is_plausible(s) and state.log_posterior < s.log_posterior + _needed(t)
            ]
            if not superfluous:
                return state, without
            state = max(superfluous, key=lambda s: s.log_posterior)
        return state, [self.sound for _ in state.terms]

    def _expected(self, state: HypothesisSet, row: int) -> float:
        """Prediction of a row from all other corrected rows, as in a recording, [m]."""
        mean, _ = self.model.predict_row(state.corrected, row)
        return float(state.corrected[row]) if math.isnan(mean) else mean

    def suspected_rows(self, state: HypothesisSet) -> tuple[int, ...]:
        """Rows of the most likely mistakes besides those of a state; see `find_suspected_rows`."""
        families = list_families(self.model, Rows(self.session, state.corrected), grouped=False)
        scored = list(self.scorer.score(state, families))
        least = max(float(e.max(initial=-np.inf)) for _, e in scored) - SIMILAR_LOG_BAYES
        likely = [f.explain(int(h)) for f, e in scored for h in np.flatnonzero(e > least)]
        rows = {i for e in likely for i in (e.rows[:1] if e.kind == "row offset" else e.rows)}
        return tuple(sorted(rows))

    def _result(self, state: HypothesisSet, without: list[HypothesisSet], near: Near) -> Anomalies:
        """Anomalies of a state, with nearly as likely causes and alternatives.

        Args:
            state: The state.
            without: Sets without each of its hypotheses.
            near: Nearly as likely sets.
        """
        sound = self.sound
        anomalies = []
        for term, e, reduced in zip(state.terms, explain_with_amounts(state), without, strict=True):
            causes, alternatives = find_alternatives(term, near)
            row = e.rows[0] if len(e.rows) == 1 else None
            if causes and e.rows:
                causes = (e, *causes)
                kind: AnomalyKind = "inconsistent posture" if row is None else "outlier"
                e = replace(e, kind=kind, factor=None, amount=None)
            anomalies.append(
                Anomaly(
                    e,
                    state.log_posterior - reduced.log_posterior,
                    None if row is None else self._expected(state, row),
                    causes,
                    alternatives,
                )
            )
        explained = any(t.silent is not None for t in state.terms) or self.is_plausible(state)
        return Anomalies(
            tuple(anomalies),
            explained,
            self.model.rms(sound.remaining, sound.about),
            self.model.rms(state.remaining, state.about),
            state.score.tolerance_scale,
            () if explained or not state.terms else self.suspected_rows(state),
            state.log_posterior,
        )


def _reduced(state: HypothesisSet) -> list[list[Term]]:
    """Hypotheses of a set without each of them."""
    return [[t for t in state.terms if t is not removed] for removed in state.terms]


def _is_clear(extended: HypothesisSet, state: HypothesisSet) -> bool:
    """True if the evidence for an extended set against a state suffices to report it."""
    gain = extended.log_posterior - state.log_posterior
    return gain >= max(_needed(t) for t in extended.terms[len(state.terms) :])


def _needed(term: Term) -> float:
    """Smallest gain of log posterior of a reported hypothesis."""
    return (
        CLEAR_LOG_BAYES
        if term.systematic is None
        else CLEAR_EFFECT_LOG_BAYES - float(np.log(N_FAMILIES))
    )


def _nearly_as_likely(
    ranked: list[HypothesisSet], plausible: list[HypothesisSet]
) -> list[HypothesisSet]:
    """The most likely sets and, if the best one adds a pair, single hypotheses.

    A pair excludes a single hypothesis only if its second anomaly alone would be reported. Another
    set with a change of the machine that may be 0 is left out: the set without it is simpler.
    """
    best = ranked[0].log_posterior
    ranked = [s for s in ranked if s is ranked[0] or s.changes_are_significant]
    near = [s for s in ranked if s.log_posterior > best - SIMILAR_LOG_BAYES]
    alone = [s for s in plausible if len(s.terms) < len(ranked[0].terms)]
    if alone and alone[0].log_posterior > best - CLEAR_LOG_BAYES:
        level = alone[0].log_posterior - SIMILAR_LOG_BAYES
        near += [s for s in alone if s.log_posterior > level and s not in near]
    return near
