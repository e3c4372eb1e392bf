"""Search for anomalies: all hypotheses are compared by one marginal likelihood.

Families share the prior probability equally, and so do the hypotheses of each family. In at most
one of e^c sound sessions the Bayes factor of their mixture against no anomaly exceeds e^c (Markov's
inequality). This does not depend on the number of hypotheses. Anomalies are added one by one
(forward selection), in small sessions also in pairs (`pairs.py`). Anomalies that others explain are
removed again (backward elimination). The most likely hypotheses are relinearised.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from orthocal.arrays import Array, Indices
from orthocal.hypotheses.anomaly import Anomalies, Anomaly, AnomalyKind
from orthocal.hypotheses.families.artefacts import wrong_artefacts
from orthocal.hypotheses.families.displaced_gauge import displaced_gauges
from orthocal.hypotheses.families.effects import find_effects, unmodelled_effects
from orthocal.hypotheses.families.inconsistent_group import inconsistent_groups
from orthocal.hypotheses.families.row_offset import row_offsets
from orthocal.hypotheses.families.sessions import MAX_DRIVES, changes_between_sessions
from orthocal.hypotheses.families.single_reading import wrong_readings
from orthocal.hypotheses.families.swapped_rows import swapped_rows
from orthocal.hypotheses.families.unit_and_sign import wrong_units_and_signs
from orthocal.hypotheses.hypothesis import (
    Family,
    MachineShift,
    Rows,
    SystematicEffect,
    sparse_rows,
    to_dense,
)
from orthocal.hypotheses.hypothesis_set import (
    HypothesisSet,
    Term,
    correct_rows,
    distinct_terms,
    explain_with_amounts,
    find_alternatives,
    is_local,
    is_same_place,
    negative_log_posterior,
    share_rows,
    split_amounts,
)
from orthocal.hypotheses.likelihood import AmountPrior, Products, log_of_sum
from orthocal.hypotheses.linear_model import (
    LARGEST_ERROR,
    MAX_RELINEARISATIONS,
    SMALL_CHANGE,
    LinearisationPoint,
    LinearModel,
    ModelLinearisation,
    linear_model,
)
from orthocal.hypotheses.pairs import Singles, find_pairs
from orthocal.session.session import Session

CLEAR_LOG_BAYES = 7.0
"""Smallest log Bayes factor of a reported anomaly. By chance at most one of e⁷ = 1,100 sessions
reaches it."""

CLEAR_EFFECT_LOG_BAYES = 4.5
"""Smallest log Bayes factor, without prior probabilities, of a reported effect that the model
lacks. It is smaller than CLEAR_LOG_BAYES because such effects are usual. By chance at most one of
90 sessions reaches it, far fewer in simulations (`tests/benchmarks/checking.py --effects 1000`)."""

EFFECT_SCALES = np.array([1.0, 4.0])
"""Grid of amplitudes of the parameters of an effect, [prior std]."""

SIMILAR_LOG_BAYES = 3.0
"""Largest log Bayes factor against another explanation that is nearly as likely."""

REFIT_LOG_BAYES = 4.0
"""Smallest log Bayes factor, to first order, of hypotheses that are relinearised."""

N_FAMILIES = 31.0
"""Number of families that share the prior probability; each effect is as likely as a family."""

MAX_ANOMALIES = 4
"""Most anomalies that are sought in a session."""

MAX_REFITTED = 8
"""Most single hypotheses that are relinearised in each step."""

MAX_REFITTED_PAIRS = 12
"""Most pairs that are relinearised in each step."""

COARSE_MARGIN = 2.0
"""A pair is omitted if its log Bayes factor on the coarse grid is below −COARSE_MARGIN. The sum
over the full grid may exceed its largest term by COARSE_MARGIN + REFIT_LOG_BAYES."""

PAIR_MARGIN = CLEAR_LOG_BAYES + SIMILAR_LOG_BAYES
"""A pair is omitted if the best single hypothesis exceeds its log Bayes factor by this."""

MAX_COMBINED = 5
"""Number of the most likely single hypotheses that are combined in pairs if none of them alone
makes the readings plausible."""

MAX_PAIRED_ROWS = 60
"""Most rows of a session in which pairs of hypotheses are considered."""

LARGEST_TOLERANCE_SCALE = 5.0
"""Upper limit of the tolerance scale of a plausible machine."""

LARGEST_NOISE_SCALE = 2.5
"""Upper limit of the noise scale of a plausible gauge with a stated noise."""

LARGEST_CHANGE = 100.0
"""Largest plausible change of an error of the machine between two sessions, [prior std]."""

LARGEST_VOLUME = float(np.log(1000.0))
"""Largest logarithm of the volume factor of a family that is considered in pairs."""

MIN_RELATIVE_CHANGE = 1e-3
"""Smallest change of the readings by one prior std of a considered shift, relative to the noise."""

LARGEST_FIRST_STEP = 50.0
"""Largest error after the first relinearisation, [prior std]; beyond it, loops rarely close."""

CHUNK_SIZE = 4096
"""Number of hypotheses that are scored at once, to limit the memory."""


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
        return Anomalies((), 0.0, True, 0.0, 0.0, 1.0, 1.0)
    return _Search(session, linear).run()


class _Search:
    """The search in one session."""

    def __init__(self, session: Session, model: LinearModel) -> None:
        self.session = session
        self.model = model
        self.values = session.values
        self.keep_jacobian = len(model.labels) > 1
        self.effects = find_effects(model)
        start = model.at_reference(keep_jacobian=self.keep_jacobian)
        self.sound = self.evaluate((), start)

    def run(self) -> Anomalies:
        """Search by forward selection and backward elimination.

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
        return self._result(*((self.sound, []) if self._worsens(state) else (state, near)))

    def _worsens(self, state: HypothesisSet) -> bool:
        """True if a correction increases the residuals and the readings are implausible."""
        before, after = (self.model.rms(s.remaining, s.about) for s in (self.sound, state))
        return after > before and not self.is_plausible(state)

    def _select(
        self, *, grouped: bool
    ) -> tuple[HypothesisSet, list[tuple[HypothesisSet, HypothesisSet]]]:
        """Select a set of hypotheses step by step.

        Args:
            grouped: Whether units and signs of groups of readings are considered.

        Returns:
            The set; and pairs of the set after a step and a nearly as likely one.
        """
        state = self.sound
        near: list[tuple[HypothesisSet, HypothesisSet]] = []
        while len(state.terms) < MAX_ANOMALIES:
            extended, alternatives = self._step(state, grouped=grouped)
            if extended is None:
                break
            state = self._eliminate(extended)
            near += [(extended, s) for s in alternatives]
            if alternatives and not is_local(self.session, state, alternatives):
                break
        return state, near

    def evaluate(self, terms: Sequence[Term], start: ModelLinearisation) -> HypothesisSet:
        """Score a set of hypotheses, relinearised as in `evaluate_all`."""
        (state,) = self.evaluate_all([terms], start)
        return state

    def evaluate_all(
        self, term_sets: Iterable[Sequence[Term]], start: ModelLinearisation
    ) -> list[HypothesisSet]:
        """Score sets of hypotheses, each relinearised at the errors that it implies.

        The first step may exceed LARGEST_ERROR. Readings are not linear over offsets of some mm,
        and the nonlinear part looks like errors far beyond their tolerances. Such a step does not
        count unless the next one returns within LARGEST_ERROR. No step exceeds LARGEST_FIRST_STEP.
        """
        tracks = [[state] for state in self._begin(list(term_sets), start)]
        unfinished = tracks
        for k in range(MAX_RELINEARISATIONS):
            points = [self._next_point(states[-1], first=k == 0) for states in unfinished]
            steps = [(t, p) for t, p in zip(unfinished, points, strict=True) if p is not None]
            abouts = self.model.linearise_all(
                [p for _, p in steps], keep_jacobian=self.keep_jacobian
            )
            unfinished = []
            for (states, _), about in zip(steps, abouts, strict=True):
                if about is not None:
                    before = states[-1]
                    states.append(self._evaluate_about(before.terms, about, _applied(before)))
                    unfinished.append(states)
        return [
            next((s for s in reversed(states[1:]) if _are_small(s.about.theta)), states[0])
            for states in tracks
        ]

    def _begin(
        self, term_sets: Sequence[Sequence[Term]], start: ModelLinearisation
    ) -> list[HypothesisSet]:
        """Score sets of hypotheses about a start.

        Sets with machine shifts start from the linearisation without anomalies.
        """
        model, shifts = self.model, [_known_shifts(terms) for terms in term_sets]
        if any(t.shift is not None for terms in term_sets for t in terms):
            sound = self.sound.about
            points = [LinearisationPoint(sound.theta, s, sound.passive) for s in shifts if s]
            shifted = iter(model.linearise_all(points, keep_jacobian=True))
        states = []
        for terms, known in zip(term_sets, shifts, strict=True):
            about = start
            if known:
                about = next(shifted) or model.linearise(
                    sound.theta, known, sound.passive, keep_jacobian=True
                )
            elif any(map(_is_unknown_shift, terms)):
                about = sound
            states.append(
                self._evaluate_about(terms, about, np.zeros(sum(map(_is_unknown_shift, terms))))
            )
        return states

    def _next_point(self, state: HypothesisSet, *, first: bool) -> LinearisationPoint | None:
        """Errors that a set implies, to linearise about; None if they are too near or too far."""
        errors = state.about.errors_for(
            state.remaining,
            noise_scale=state.score.noise_scale,
            tolerance_scale=state.score.tolerance_scale,
        )
        if np.abs(errors - state.about.theta).max(initial=0.0) < SMALL_CHANGE:
            return None
        if not _are_small(errors) and (not first or np.abs(errors).max() > LARGEST_FIRST_STEP):
            return None
        unknown = [t.shift for t in state.terms if t.shift is not None and not t.known]
        shifts = [
            replace(s, direction=s.direction * a)
            for s, a in zip(unknown, _applied(state), strict=True)
        ]
        return LinearisationPoint(
            errors, [*_known_shifts(state.terms), *shifts], state.about.passive
        )

    def _evaluate_about(
        self, terms: Sequence[Term], about: ModelLinearisation, applied: Array
    ) -> HypothesisSet:
        """Score a set of hypotheses about one linearisation.

        Args:
            terms: The hypotheses.
            about: The linearisation.
            applied: Amounts of the unknown machine shifts that the linearisation contains, (n,).
        """
        rows = self.values + sum((t.change for t in terms if t.change is not None), 0.0)
        groups, silent, steps = self._vectors(terms, about)
        priors = [
            None if t.systematic is None else _prior_of(t.systematic)
            for t in terms
            if t.effects is not None or (t.shift is not None and not t.known)
        ]
        deviation = self.model.entries(rows[None])[0] - about.expected + applied @ steps
        score = about.likelihood.score_set(deviation, groups, silent, priors=priors)
        effects = [*groups, *([] if silent is None else [silent])]
        remaining = deviation - (score.amounts @ np.concatenate(effects) if effects else 0.0)
        amounts, stds = (split_amounts(terms, a) for a in (score.amounts, score.stds))
        changes = [
            abs(a[0]) * np.abs(t.shift.direction).max()
            for t, a in zip(terms, amounts, strict=True)
            if t.shift is not None and not t.known
        ]
        if max(changes, default=0.0) > LARGEST_CHANGE:
            score = replace(score, log_likelihood=-np.inf)
        return HypothesisSet(
            tuple(terms), score, about, remaining, correct_rows(rows, terms, amounts), amounts, stds
        )

    def _vectors(
        self, terms: Sequence[Term], about: ModelLinearisation
    ) -> tuple[list[Array], Array | None, Array]:
        """Effects of the terms on the entries, zeros projected out.

        Returns:
            Effects of each term, (k, n_entries) each; indicators of silent rows, (m, n_entries), or
            None; and effects of unknown shifts, (n, n_entries).
        """
        model, groups, silent, steps = self.model, [], [], []
        for t in terms:
            if t.effects is not None:
                groups.append(model.entries(t.effects))
            elif t.shift is not None and not t.known:
                groups.append(model.shift_entries(about, t.shift)[None])
                steps.append(groups[-1][0])
            elif t.silent is not None:
                silent.append(model.entries(_marks(list(t.silent[:, None]), self.values.size)))
        return (
            groups,
            np.concatenate(silent) if silent else None,
            np.array(steps).reshape(len(steps), -1 if steps else about.expected.size),
        )

    def _step(
        self, state: HypothesisSet, *, grouped: bool
    ) -> tuple[HypothesisSet | None, list[HypothesisSet]]:
        """The best set with one or two further hypotheses, and nearly as likely other sets."""
        rows = Rows(self.session, state.corrected)
        families = [
            *_families(self.model, rows, grouped=grouped),
            *unmodelled_effects(rows, self._lacking(state)),
        ]
        scored = list(self._score(state, families))
        likely_effects = [
            self._term(f, 0, rows)
            for f, evidence in scored
            if f.systematic
            and evidence[0] > CLEAR_EFFECT_LOG_BAYES - np.log(N_FAMILIES) - COARSE_MARGIN
        ]
        totals = [log_of_sum(evidence) for _, evidence in scored if evidence.size]
        pairs, total = self._pairs(state, scored)
        best = float(log_of_sum(np.array([*totals, total]))) if totals else -np.inf
        if best < REFIT_LOG_BAYES and not likely_effects:
            return None, []
        scored += list(self._score(state, inconsistent_groups(rows)))
        single = self._shortlist(scored, rows)
        additions = [
            *((t,) for t in (*likely_effects, *single)),
            *pairs,
            *self._drive_combinations(state, scored, rows),
        ]
        extended = self.evaluate_all([(*state.terms, *added) for added in additions], state.about)
        likeliest = min(extended, key=negative_log_posterior)
        if not self.is_plausible(likeliest) and len(state.terms) + 2 <= MAX_ANOMALIES:
            extended += self._combine(state, single)
        ranked = sorted(extended, key=negative_log_posterior)
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
        return simplest, [s for s in near if s is not simplest]

    def _lacking(self, state: HypothesisSet) -> list[SystematicEffect]:
        """Effects of the machine that a state lacks."""
        present = {t.systematic.name for t in state.terms if t.systematic is not None}
        return [e for e in self.effects if e.name not in present]

    def _drive_combinations(
        self, state: HypothesisSet, scored: list[tuple[Family, Array]], rows: Rows
    ) -> Iterator[tuple[Term, ...]]:
        """Changes of two or more drives between the same sessions."""
        present = {(t.explanation.drives, t.explanation.sessions) for t in state.terms}
        by_sessions: dict[tuple[str, ...], list[Term]] = {}
        for family, _ in scored:
            for h in range(len(family.shifts) if not family.known else 0):
                e = family.explain(h)
                if e.drives and (e.drives, e.sessions) not in present:
                    by_sessions.setdefault(e.sessions, []).append(self._term(family, h, rows))
        for terms in by_sessions.values():
            if len(terms) <= MAX_DRIVES:
                for count in range(2, min(len(terms), MAX_ANOMALIES - len(state.terms)) + 1):
                    yield from combinations(terms, count)

    def _combine(self, state: HypothesisSet, single: list[Term]) -> list[HypothesisSet]:
        """Sets with two of the most likely hypotheses, if neither suffices alone.

        In the best pair each hypothesis is also replaced by others of the same rows.
        """
        pairs = combinations(distinct_terms(single)[:MAX_COMBINED], 2)
        sets = self.evaluate_all([(*state.terms, *pair) for pair in pairs], state.about)
        if not sets:
            return []
        one, other = min(sets, key=negative_log_posterior).terms[-2:]
        variants = [
            (t, partner)
            for replaced, partner in ((one, other), (other, one))
            for t in single
            if t is not replaced and not share_rows(t, partner) and share_rows(t, replaced)
        ]
        return sets + self.evaluate_all([(*state.terms, *pair) for pair in variants], state.about)

    def is_plausible(self, state: HypothesisSet) -> bool:
        """True if a machine near its tolerances explains the corrected readings."""
        score = state.score
        quiet = score.noise_scale < LARGEST_NOISE_SCALE or not self.model.stated
        return score.tolerance_scale < LARGEST_TOLERANCE_SCALE and quiet

    def _eliminate(self, state: HypothesisSet) -> HypothesisSet:
        """Remove hypotheses that the others make superfluous."""
        while len(state.terms) > 1:
            sets = [[t for t in state.terms if t is not removed] for removed in state.terms]
            needed = [min(SIMILAR_LOG_BAYES, _needed(removed)) for removed in state.terms]
            reduced = zip(needed, self.evaluate_all(sets, self.sound.about), strict=True)
            needed_gain, best = max(reduced, key=lambda pair: pair[1].log_posterior)
            if best.log_posterior < state.log_posterior - needed_gain:
                break
            state = best
        return state

    def _score(
        self, state: HypothesisSet, families: Iterable[Family]
    ) -> Iterator[tuple[Family, Array]]:
        """Log Bayes factor of each hypothesis added to a state, to first order, with its prior."""
        likelihood = state.about.likelihood
        deviation = state.remaining
        base = likelihood.products(deviation[None])
        sound, rows_count = float(likelihood.score(base)[0]), self.values.size
        for family in families:
            if family.groups:
                logs = np.array(
                    [
                        likelihood.score_set(
                            deviation, [self.model.entries(_vectors(g, rows_count))]
                        ).log_likelihood
                        for g in family.groups
                    ]
                )
            elif family.systematic:
                logs = np.array(
                    [
                        likelihood.score_set(
                            deviation - self.model.entries(e.change[None])[0],
                            [self.model.entries(e.columns)],
                            priors=[_prior_of(e)],
                        ).log_likelihood
                        for e in family.systematic
                    ]
                )
            elif family.silent:
                logs = np.array(
                    [
                        likelihood.score_set(
                            deviation,
                            silent=self.model.entries(_marks(list(rows[:, None]), rows_count)),
                        ).log_likelihood
                        for rows in family.silent
                    ]
                )
            elif family.shifts:
                logs = self._score_shifts(state, family)
            else:
                logs = np.concatenate(
                    [
                        self._score_rows(state, family, slice(k, k + CHUNK_SIZE), base)
                        for k in range(0, family.count, CHUNK_SIZE)
                    ]
                )
            yield family, logs - sound + _prior(family)

    def _score_rows(
        self, state: HypothesisSet, family: Family, chosen: slice, base: Products
    ) -> Array:
        """Log likelihoods of some edits and effects of a family, shape (h,)."""
        model, about, deviation = self.model, state.about, state.remaining
        products, inner = base, np.zeros(1)
        edits = None if family.edits is None else family.edits.select(chosen)
        if edits is not None:
            changed, cross = model.products(edits, about, deviation)
            products = Products(
                base.along + changed.along, base.square + 2.0 * cross + changed.square
            )
        if family.effects is None:
            return about.likelihood.score(products)
        effects = family.effects.select(chosen)
        added, cross = model.products(effects, about, deviation)
        if edits is not None:
            inner = model.inner(edits, effects)
        return about.likelihood.score(products, added, cross + inner)

    def _score_shifts(self, state: HypothesisSet, family: Family) -> Array:
        """Log likelihoods of the machine shifts of a family, shape (h,)."""
        likelihood = state.about.likelihood
        vectors = np.array([self.model.shift_entries(state.about, s) for s in family.shifts])
        if family.known:
            return likelihood.score(likelihood.products(state.remaining - vectors))
        size = np.abs(vectors).max(axis=1, keepdims=True)
        prior_stds = np.array([np.abs(s.direction).max() for s in family.shifts])[:, None]
        visible = size > MIN_RELATIVE_CHANGE * self.model.sigma * prior_stds
        vectors = np.where(visible, vectors, 0.0) / np.where(visible, size, 1.0)
        base, cross = likelihood.products(state.remaining[None]), vectors @ state.remaining
        return likelihood.score(base, likelihood.products(vectors), cross)

    def _term(self, family: Family, h: int, rows: Rows) -> Term:
        """Hypothesis number h of a family, as a term of a set."""
        prior = float(_prior(family)[h])
        explanation = family.explain(h)
        if family.groups:
            return Term(explanation, prior, effects=_vectors(family.groups[h], rows.count))
        if family.systematic:
            effect = family.systematic[h]
            return Term(explanation, prior, -effect.change, effect.columns, effect)
        if family.silent:
            return Term(explanation, prior, silent=family.silent[h])
        if family.shifts:
            shift = family.shifts[h]
            if not family.known:  # a unit amount changes the readings by at most 1 m
                size = float(np.abs(self.model.shift_entries(self.sound.about, shift)).max()) or 1.0
                shift = replace(shift, direction=shift.direction / size, unit=1.0 / size)
            return Term(explanation, prior, shift=shift, known=family.known)
        return Term(
            explanation,
            prior,
            None if family.edits is None else family.edits.one(h),
            None if family.effects is None else family.effects.one(h)[None],
        )

    def _shortlist(self, scored: list[tuple[Family, Array]], rows: Rows) -> list[Term]:
        """The most likely single hypotheses, and the most likely one of each kind.

        Reversed signs of absolute readings are always included, except of pairs of setups. They are
        far from the linearisation: a fixed ball is on the opposite side of its nominal position.
        """
        ranked = sorted(
            (
                (float(evidence[h]), i, h)
                for i, (family, evidence) in enumerate(scored)
                if not family.systematic
                for h in np.argsort(-evidence)[:MAX_REFITTED].tolist()
            ),
            reverse=True,
        )
        terms = [self._term(scored[i][0], h, rows) for _, i, h in ranked[: 3 * MAX_REFITTED]]
        chosen = terms[: MAX_REFITTED // 2]
        kinds = {(t.explanation.kind, t.explanation.scope) for t in chosen}
        for (evidence, _, _), t in zip(ranked, terms, strict=False):
            key = (t.explanation.kind, t.explanation.scope)
            if evidence > 0.0 and key not in kinds:
                kinds.add(key)
                chosen.append(t)
        chosen = chosen[:MAX_REFITTED]
        present = {t.explanation for t in chosen}
        absolute = {s.name for s in self.session.setups.values() if s.zero == "known"}
        return chosen + [
            self._term(family, h, rows)
            for family, _ in scored
            if family.log_volume is not None and absolute
            for h, e in enumerate(map(family.explain, range(family.count)))
            if e.kind == "reversed sign" and e.scope != "setups" and absolute.intersection(e.setups)
            if e not in present
        ]

    def _pairs(
        self, state: HypothesisSet, scored: list[tuple[Family, Array]]
    ) -> tuple[list[tuple[Term, Term]], float]:
        """The most likely pairs of hypotheses, and the log of their summed Bayes factors."""
        is_small = self.values.size <= MAX_PAIRED_ROWS
        edits = [f for f, _ in scored if f.edits is not None and _is_paired(f)]
        effects = [f for f, _ in scored if f.effects is not None and _is_paired(f)]
        families = [*edits, *effects]
        if not is_small or not families or len(state.terms) + 2 > MAX_ANOMALIES:
            return [], -np.inf
        likelihood = state.about.likelihood
        sound = float(likelihood.score(likelihood.products(state.remaining[None]))[0])
        best_single = max(float(e.max(initial=-np.inf)) for _, e in scored)
        rows = [
            np.vstack(
                [np.zeros((0, self.values.size)), *(to_dense(p.to_sparse()) for p in part if p)]
            )
            for part in ([f.edits for f in edits], [f.effects for f in effects])
        ]
        singles = Singles(
            self.model.entries(rows[0]),
            self.model.entries(rows[1]),
            np.concatenate([_prior(f) for f in families]),
            np.vstack(rows) != 0.0,
        )
        min_log = sound + max(-COARSE_MARGIN, best_single - PAIR_MARGIN)
        pairs = find_pairs(likelihood, state.remaining, singles, min_log=min_log)
        evidence = pairs.log_posterior - sound
        if not evidence.size:
            return [], -np.inf
        hypotheses = [(f, h) for f in families for h in range(f.count)]
        corrected = Rows(self.session, state.corrected)

        def term(m: int) -> Term:
            return self._term(*hypotheses[m], corrected)

        chosen = pairs.members[evidence > REFIT_LOG_BAYES - SIMILAR_LOG_BAYES][:MAX_REFITTED_PAIRS]
        return [(term(a), term(b)) for a, b in chosen.tolist()], float(log_of_sum(evidence))

    def _expected(self, state: HypothesisSet, row: int) -> float:
        """Prediction of a row from all other corrected rows, as in a recording, [m]."""
        mean, _ = self.model.predict_row(state.corrected, row)
        return float(state.corrected[row]) if math.isnan(mean) else mean

    def _result(
        self, state: HypothesisSet, near: list[tuple[HypothesisSet, HypothesisSet]]
    ) -> Anomalies:
        """Anomalies of a state, with nearly as likely causes and alternatives."""
        sound = self.sound
        anomalies = []
        for term, e in zip(state.terms, explain_with_amounts(state), strict=True):
            others = [t for t in state.terms if t is not term]
            without = self.evaluate(others, sound.about) if others else sound
            causes, alternatives = find_alternatives(term, near)
            row = e.rows[0] if len(e.rows) == 1 else None
            if causes and e.rows:
                causes = (e, *causes)
                kind: AnomalyKind = "inconsistent posture" if row is None else "outlier"
                e = replace(e, kind=kind, factor=None, amount=None)
            anomalies.append(
                Anomaly(
                    e,
                    state.log_posterior - without.log_posterior,
                    None if row is None else self._expected(state, row),
                    causes,
                    alternatives,
                )
            )
        silent = any(t.silent is not None for t in state.terms)
        return Anomalies(
            tuple(anomalies),
            state.log_posterior - sound.log_posterior,
            silent or self.is_plausible(state),
            self.model.rms(sound.remaining, sound.about),
            self.model.rms(state.remaining, state.about),
            state.score.tolerance_scale,
            state.score.noise_scale,
        )


def _is_unknown_shift(term: Term) -> bool:
    """True if a hypothesis is a machine shift of unknown amount."""
    return term.shift is not None and not term.known


def _known_shifts(terms: Sequence[Term]) -> list[MachineShift]:
    """Machine shifts of known amounts."""
    return [t.shift for t in terms if t.shift is not None and t.known]


def _applied(state: HypothesisSet) -> Array:
    """Estimated amounts of the unknown machine shifts, shape (n,)."""
    pairs = zip(state.terms, state.amounts, strict=True)
    return np.array([a[0] for t, a in pairs if _is_unknown_shift(t)])


def _are_small(errors: Array) -> bool:
    """True if no error exceeds LARGEST_ERROR, [prior std]."""
    return bool(np.abs(errors).max(initial=0.0) < LARGEST_ERROR)


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

    A pair excludes a single hypothesis only if its second anomaly alone would be reported.
    """
    best = ranked[0].log_posterior
    near = [s for s in ranked if s.log_posterior > best - SIMILAR_LOG_BAYES]
    alone = [s for s in plausible if len(s.terms) < len(ranked[0].terms)]
    if alone and alone[0].log_posterior > best - CLEAR_LOG_BAYES:
        level = alone[0].log_posterior - SIMILAR_LOG_BAYES
        near += [s for s in alone if s.log_posterior > level and s not in near]
    return near


def _families(model: LinearModel, rows: Rows, *, grouped: bool) -> Iterator[Family]:
    """All families of mistakes.

    Args:
        model: The linearised model.
        rows: The rows.
        grouped: Whether units and signs of groups of readings are considered.
    """
    if grouped:
        yield from wrong_units_and_signs(rows, model.sigma)
    yield from displaced_gauges(rows, model.sigma)
    yield from wrong_artefacts(model, rows)
    yield from wrong_readings(rows)
    yield from swapped_rows(rows)
    yield from row_offsets(rows)
    yield from changes_between_sessions(model)


def _is_paired(family: Family) -> bool:
    """True if a family has edits or effects, not both, and no large volume factor."""
    if family.systematic or (family.edits is None and family.effects is None):
        return False
    if family.edits is not None and family.effects is not None:
        return False
    return family.log_volume is None or family.log_volume.max(initial=0.0) <= LARGEST_VOLUME


def _prior(family: Family) -> Array:
    """Logarithms of prior probabilities, with the volume factors, shape (h,)."""
    prior = np.full(family.count, -np.log(family.size * N_FAMILIES))
    return prior if family.log_volume is None else prior + family.log_volume


def _prior_of(effect: SystematicEffect) -> AmountPrior:
    """Prior of the parameters of an effect, in prior std."""
    return AmountPrior(EFFECT_SCALES, effect.positive)


def _vectors(group: Sequence[Indices] | Array, count: int) -> Array:
    """Effects of a group per unit, shape (k, count)."""
    return group if isinstance(group, np.ndarray) else _marks(group, count)


def _marks(groups: Sequence[NDArray[np.int64]], count: int) -> Array:
    """Indicator vectors of groups of rows, shape (len(groups), count)."""
    return to_dense(sparse_rows(groups, [np.ones(len(g)) for g in groups], count))
