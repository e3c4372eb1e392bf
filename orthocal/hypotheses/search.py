"""Search for anomalies: all hypotheses scored by one marginal likelihood, several at once.

Families of hypotheses share the prior probability, and the hypotheses of each share that of their
family. The Bayes factor of their mixture against no anomaly exceeds e^c by chance in at most one of
e^c sound sessions (Markov's inequality), however many are tried. Anomalies are added one after the
other (forward selection), in small sessions also in pairs (`pairs.py`). Those that the others
explain are removed again (backward elimination). The best ones are linearised anew.
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
from orthocal.hypotheses.families.sessions import MOST_DRIVES, changes_between_sessions
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
    FURTHEST,
    MOST_ROUNDS,
    NEAR,
    LinearisationPoint,
    LinearModel,
    ModelLinearisation,
    linear_model,
)
from orthocal.hypotheses.pairs import Singles, find_pairs
from orthocal.session.session import Session

CLEARLY = 7.0
"""Least logarithm of the Bayes factor of a reported anomaly. By chance at most one of e⁷ = 1,100
sessions reaches it."""

EFFECT_CLEARLY = 4.5
"""Least logarithm of the Bayes factor, without the prior probability, of a reported effect that the
model lacks. It is smaller than CLEARLY because such effects are usual. By chance at most one of 90
sessions reaches it, far fewer in simulations (`tests/benchmarks/checking.py --effects 1000`)."""

EFFECT_SCALES = np.array([1.0, 4.0])
"""Grid of amplitudes of the parameters of an effect, [prior std]."""

NEARLY = 3.0
"""Logarithm of the Bayes factor up to which another explanation is nearly as likely."""

WORTH_REFITTING = 4.0
"""Least logarithm of the Bayes factor, to first order, of hypotheses that are linearised anew."""

FAMILIES = 31.0
"""Families of mistakes that share the prior probability; each effect is as likely as a family."""

MOST_ANOMALIES = 4
"""Anomalies that are sought in a session."""

MOST_REFITTED = 8
"""Single hypotheses that are linearised anew in each step."""

MOST_PAIRS_REFITTED = 12
"""Pairs that are linearised anew."""

COARSE = 2.0
"""A pair is omitted after the coarse grid if its logarithm of the Bayes factor is below −COARSE.
The sum over the full grid may exceed its largest term by COARSE + WORTH_REFITTING."""

FAR_BEHIND = CLEARLY + NEARLY
"""A pair is omitted if its logarithm of the Bayes factor is smaller by this than that of the best
single hypothesis."""

MOST_COMBINED = 5
"""Number of the most likely single hypotheses that are combined in pairs, if none of them alone
leads to plausible readings."""

MOST_PAIRED = 60
"""Rows of a session up to which pairs of hypotheses are considered."""

LARGEST_TOLERANCE_SCALE = 5.0
"""Tolerance scale that no machine reaches."""

LARGEST_NOISE_SCALE = 2.5
"""Noise scale that no gauge with a stated noise reaches."""

LARGEST_CHANGE = 100.0
"""Change of an error of the machine, in prior std, that no machine makes between two sessions."""

LARGEST_VOLUME = float(np.log(1000.0))
"""Largest logarithm of the factor on volumes of a family that is considered in pairs."""

LEAST_EFFECT = 1e-3
"""Least change of the readings by one prior std of a considered change, relative to the noise."""

EXTREME = 50.0
"""Errors, in prior std, about which nothing is linearised: hardly a machine with them closes."""

CHUNK = 4096
"""Number of hypotheses that are scored at a time, to limit the memory."""


def find_anomalies(session: Session) -> Anomalies:
    """Anomalies of a session, from its readings and its robot.

    Args:
        session: A session, or several joined ones; rows that were not read are not in it.

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
        self.slopes = len(model.labels) > 1
        self.effects = find_effects(model)
        start = model.at_reference(slopes=self.slopes)
        self.sound = self.evaluate((), start)

    def run(self) -> Anomalies:
        """Forward selection, backward elimination and their result.

        A wrong unit or decimal point of many readings also explains a small part of several gross
        errors. If one is found, the search is repeated with single readings only. A correction is
        not proposed if it increases the residuals and leads to implausible readings.
        """
        state, near = self._select(grouped=True)
        if any(t.explanation.factor and len(t.explanation.rows) > 1 for t in state.terms):
            other = self._select(grouped=False)
            if other[0].log_posterior > state.log_posterior + NEARLY or self._worsens(state):
                state, near = other
        return self._result(*((self.sound, []) if self._worsens(state) else (state, near)))

    def _worsens(self, state: HypothesisSet) -> bool:
        """True if a correction increases the residuals and leads to implausible readings."""
        before, after = (self.model.rms(s.remaining, s.about) for s in (self.sound, state))
        return after > before and not self.is_plausible(state)

    def _select(
        self, *, grouped: bool
    ) -> tuple[HypothesisSet, list[tuple[HypothesisSet, HypothesisSet]]]:
        """A set of hypotheses, and others nearly as likely beside each step that led to it.

        Args:
            grouped: Whether units and signs of groups of readings are considered.
        """
        state = self.sound
        near: list[tuple[HypothesisSet, HypothesisSet]] = []
        while len(state.terms) < MOST_ANOMALIES:
            extended, alternatives = self._step(state, grouped=grouped)
            if extended is None:
                break
            state = self._eliminate(extended)
            near += [(extended, s) for s in alternatives]
            if alternatives and not is_local(self.session, state, alternatives):
                break
        return state, near

    def evaluate(self, terms: Sequence[Term], start: ModelLinearisation) -> HypothesisSet:
        """Score a set of hypotheses as `evaluate_all` does."""
        (state,) = self.evaluate_all([terms], start)
        return state

    def evaluate_all(
        self, several: Iterable[Sequence[Term]], start: ModelLinearisation
    ) -> list[HypothesisSet]:
        """Score sets of hypotheses, each linearised at the errors that it implies.

        The first step may exceed FURTHEST, because readings are not linear over offsets of some mm:
        the nonlinear part looks like errors far beyond their tolerances. Such a step does not count
        unless the next step returns within FURTHEST. No step exceeds EXTREME.
        """
        tracks = [[state] for state in self._begin(list(several), start)]
        moving = tracks
        for k in range(MOST_ROUNDS):
            points = [self._next_point(states[-1], first=k == 0) for states in moving]
            steps = [(t, p) for t, p in zip(moving, points, strict=True) if p is not None]
            abouts = self.model.linearise_all([p for _, p in steps], slopes=self.slopes)
            moving = []
            for (states, _), about in zip(steps, abouts, strict=True):
                if about is not None:
                    before = states[-1]
                    states.append(self._evaluate_about(before.terms, about, _applied(before)))
                    moving.append(states)
        return [
            next((s for s in reversed(states[1:]) if _is_near(s.about.theta)), states[0])
            for states in tracks
        ]

    def _begin(
        self, several: Sequence[Sequence[Term]], start: ModelLinearisation
    ) -> list[HypothesisSet]:
        """Sets of hypotheses about a start; those that change the machine about the sound one."""
        model, shifts = self.model, [_known_shifts(terms) for terms in several]
        if any(t.shift is not None for terms in several for t in terms):
            sound = self.sound.about
            points = [LinearisationPoint(sound.theta, s, sound.passive) for s in shifts if s]
            shifted = iter(model.linearise_all(points, slopes=True))
        states = []
        for terms, known in zip(several, shifts, strict=True):
            about = start
            if known:
                about = next(shifted) or model.linearise(
                    sound.theta, known, sound.passive, slopes=True
                )
            elif any(map(_is_free, terms)):
                about = sound
            states.append(self._evaluate_about(terms, about, np.zeros(sum(map(_is_free, terms)))))
        return states

    def _next_point(self, state: HypothesisSet, *, first: bool) -> LinearisationPoint | None:
        """The errors that a set implies, to linearise about; None if they are near or too far."""
        errors = state.about.errors_for(
            state.remaining,
            noise_scale=state.score.noise_scale,
            tolerance_scale=state.score.tolerance_scale,
        )
        if np.abs(errors - state.about.theta).max(initial=0.0) < NEAR:
            return None
        if not _is_near(errors) and (not first or np.abs(errors).max() > EXTREME):
            return None
        free = [t.shift for t in state.terms if t.shift is not None and not t.known]
        shifts = [
            replace(s, direction=s.direction * a)
            for s, a in zip(free, _applied(state), strict=True)
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
            applied: Amounts of the unknown machine shifts that are in it.
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
        every = [*groups, *([] if silent is None else [silent])]
        remaining = deviation - (score.amounts @ np.concatenate(every) if every else 0.0)
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
        """Effects of each term on the entries, silent rows, and effects of unknown shifts."""
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
        """The best set with one or two hypotheses more, and others nearly as likely."""
        rows = Rows(self.session, state.corrected)
        families = [
            *_families(self.model, rows, grouped=grouped),
            *unmodelled_effects(rows, self._lacking(state)),
        ]
        scored = list(self._score(state, families))
        effects = [
            self._term(f, 0, rows)
            for f, evidence in scored
            if f.systematic and evidence[0] > EFFECT_CLEARLY - np.log(FAMILIES) - COARSE
        ]
        totals = [log_of_sum(evidence) for _, evidence in scored if evidence.size]
        pairs, total = self._pairs(state, scored)
        best = float(log_of_sum(np.array([*totals, total]))) if totals else -np.inf
        if best < WORTH_REFITTING and not effects:
            return None, []
        scored += list(self._score(state, inconsistent_groups(rows)))
        single = self._shortlist(scored, rows)
        chosen = [
            *((t,) for t in (*effects, *single)),
            *pairs,
            *self._moved_together(state, scored, rows),
        ]
        tried = self.evaluate_all([(*state.terms, *more) for more in chosen], state.about)
        likeliest = min(tried, key=negative_log_posterior)
        if not self.is_plausible(likeliest) and len(state.terms) + 2 <= MOST_ANOMALIES:
            tried += self._combine(state, single)
        ranked = sorted(tried, key=negative_log_posterior)
        # a single anomaly of several leads to implausible readings
        plausible = [s for s in ranked if self.is_plausible(s)]
        if plausible and plausible[0].log_posterior > ranked[0].log_posterior - CLEARLY:
            ranked = plausible
        clear = [s for s in ranked if _is_clear(s, state)]
        if not clear or clear[0].log_posterior < ranked[0].log_posterior - NEARLY:
            return None, []
        if not _is_clear(ranked[0], state):
            return clear[0], []
        near = _nearly_as_likely(ranked, plausible)
        if _needed(ranked[0].terms[-1]) < CLEARLY:
            near = [s for s in near if _is_clear(s, state)]
        simplest = min(near, key=lambda s: s.size)
        if is_same_place(simplest, near[0]):
            simplest = near[0]
        return simplest, [s for s in near if s is not simplest]

    def _lacking(self, state: HypothesisSet) -> list[SystematicEffect]:
        """Effects of the machine that a state lacks."""
        have = {t.systematic.name for t in state.terms if t.systematic is not None}
        return [e for e in self.effects if e.name not in have]

    def _moved_together(
        self, state: HypothesisSet, scored: list[tuple[Family, Array]], rows: Rows
    ) -> Iterator[tuple[Term, ...]]:
        """Changes of two or more drives between the same sessions."""
        before = {(t.explanation.drives, t.explanation.sessions) for t in state.terms}
        since: dict[tuple[str, ...], list[Term]] = {}
        for family, _ in scored:
            for h in range(len(family.shifts) if not family.known else 0):
                e = family.explain(h)
                if e.drives and (e.drives, e.sessions) not in before:
                    since.setdefault(e.sessions, []).append(self._term(family, h, rows))
        for terms in since.values():
            if len(terms) <= MOST_DRIVES:
                for count in range(2, min(len(terms), MOST_ANOMALIES - len(state.terms)) + 1):
                    yield from combinations(terms, count)

    def _combine(self, state: HypothesisSet, single: list[Term]) -> list[HypothesisSet]:
        """Sets with two of the most likely hypotheses, if neither suffices alone."""
        apart = combinations(distinct_terms(single)[:MOST_COMBINED], 2)
        tried = self.evaluate_all([(*state.terms, *more) for more in apart], state.about)
        if not tried:
            return []
        one, other = min(tried, key=negative_log_posterior).terms[-2:]
        others = [
            (t, partner)
            for out, partner in ((one, other), (other, one))
            for t in single
            if t is not out and not share_rows(t, partner) and share_rows(t, out)
        ]
        return tried + self.evaluate_all([(*state.terms, *more) for more in others], state.about)

    def is_plausible(self, state: HypothesisSet) -> bool:
        """True if a machine near its tolerances explains the corrected readings."""
        score = state.score
        quiet = score.noise_scale < LARGEST_NOISE_SCALE or not self.model.stated
        return score.tolerance_scale < LARGEST_TOLERANCE_SCALE and quiet

    def _eliminate(self, state: HypothesisSet) -> HypothesisSet:
        """Remove hypotheses that the others make superfluous."""
        while len(state.terms) > 1:
            sets = [[t for t in state.terms if t is not out] for out in state.terms]
            needed = [min(NEARLY, _needed(out)) for out in state.terms]
            fewer = zip(needed, self.evaluate_all(sets, self.sound.about), strict=True)
            least, best = max(fewer, key=lambda pair: pair[1].log_posterior)
            if best.log_posterior < state.log_posterior - least:
                break
            state = best
        return state

    def _score(
        self, state: HypothesisSet, families: Iterable[Family]
    ) -> Iterator[tuple[Family, Array]]:
        """Log evidence of each hypothesis of families beside those of a state, to first order."""
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
                        self._score_rows(state, family, slice(k, k + CHUNK), base)
                        for k in range(0, family.count, CHUNK)
                    ]
                )
            yield family, logs - sound + _prior(family)

    def _score_rows(
        self, state: HypothesisSet, family: Family, chosen: slice, base: Products
    ) -> Array:
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
        likelihood = state.about.likelihood
        vectors = np.array([self.model.shift_entries(state.about, s) for s in family.shifts])
        if family.known:
            return likelihood.score(likelihood.products(state.remaining - vectors))
        size = np.abs(vectors).max(axis=1, keepdims=True)
        prior_stds = np.array([np.abs(s.direction).max() for s in family.shifts])[:, None]
        seen = size > LEAST_EFFECT * self.model.sigma * prior_stds
        vectors = np.where(seen, vectors, 0.0) / np.where(seen, size, 1.0)
        base, cross = likelihood.products(state.remaining[None]), vectors @ state.remaining
        return likelihood.score(base, likelihood.products(vectors), cross)

    def _term(self, family: Family, h: int, rows: Rows) -> Term:
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
            if not family.known:
                size = float(np.abs(self.model.shift_entries(self.sound.about, shift)).max())
                size = size or 1.0
                shift = replace(shift, direction=shift.direction / size, unit=1.0 / size)
            return Term(explanation, prior, shift=shift, known=family.known)
        return Term(
            explanation,
            prior,
            None if family.edits is None else family.edits.one(h),
            None if family.effects is None else family.effects.one(h)[None],
        )

    def _shortlist(self, scored: list[tuple[Family, Array]], rows: Rows) -> list[Term]:
        """The most likely single hypotheses, and the most likely one of each kind."""
        ranked = sorted(
            (
                (float(evidence[h]), i, h)
                for i, (family, evidence) in enumerate(scored)
                if not family.systematic
                for h in np.argsort(-evidence)[:MOST_REFITTED].tolist()
            ),
            reverse=True,
        )
        terms = [self._term(scored[i][0], h, rows) for _, i, h in ranked[: 3 * MOST_REFITTED]]
        chosen = terms[: MOST_REFITTED // 2]
        kinds = {(t.explanation.kind, t.explanation.scope) for t in chosen}
        for (evidence, _, _), t in zip(ranked, terms, strict=False):
            key = (t.explanation.kind, t.explanation.scope)
            if evidence > 0.0 and key not in kinds:
                kinds.add(key)
                chosen.append(t)
        return chosen[:MOST_REFITTED]

    def _pairs(
        self, state: HypothesisSet, scored: list[tuple[Family, Array]]
    ) -> tuple[list[tuple[Term, Term]], float]:
        """The most likely pairs of hypotheses, and the log evidence of all of them together."""
        few = self.values.size <= MOST_PAIRED
        edits = [f for f, _ in scored if f.edits is not None and _is_paired(f)]
        effects = [f for f, _ in scored if f.effects is not None and _is_paired(f)]
        families = [*edits, *effects]
        if not few or not families or len(state.terms) + 2 > MOST_ANOMALIES:
            return [], -np.inf
        likelihood = state.about.likelihood
        sound = float(likelihood.score(likelihood.products(state.remaining[None]))[0])
        single = max(float(e.max(initial=-np.inf)) for _, e in scored)
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
        least = sound + max(-COARSE, single - FAR_BEHIND)
        pairs = find_pairs(likelihood, state.remaining, singles, least=least)
        evidence = pairs.log_posterior - sound
        if not evidence.size:
            return [], -np.inf
        hypotheses = [(f, h) for f in families for h in range(f.count)]
        corrected = Rows(self.session, state.corrected)

        def term(m: int) -> Term:
            return self._term(*hypotheses[m], corrected)

        chosen = pairs.members[evidence > WORTH_REFITTING - NEARLY][:MOST_PAIRS_REFITTED]
        return [(term(a), term(b)) for a, b in chosen.tolist()], float(log_of_sum(evidence))

    def _expected(self, state: HypothesisSet, row: int) -> float:
        """Prediction of a row by the others, corrected, as a recording prints it, [m]."""
        mean, _ = self.model.predict_row(state.corrected, row)
        return float(state.corrected[row]) if math.isnan(mean) else mean

    def _result(
        self, state: HypothesisSet, near: list[tuple[HypothesisSet, HypothesisSet]]
    ) -> Anomalies:
        """Records of the anomalies of a state, and of sets that are nearly as likely."""
        sound = self.sound
        named = []
        for term, e in zip(state.terms, explain_with_amounts(state), strict=True):
            without = [t for t in state.terms if t is not term]
            fewer = self.evaluate(without, sound.about) if without else sound
            causes, alternatives = find_alternatives(term, near)
            row = e.rows[0] if len(e.rows) == 1 else None
            if causes and e.rows:
                causes = (e, *causes)
                kind: AnomalyKind = "inconsistent posture" if row is None else "outlier"
                e = replace(e, kind=kind, factor=None, amount=None)
            named.append(
                Anomaly(
                    e,
                    state.log_posterior - fewer.log_posterior,
                    None if row is None else self._expected(state, row),
                    causes,
                    alternatives,
                )
            )
        silent = any(t.silent is not None for t in state.terms)
        return Anomalies(
            tuple(named),
            state.log_posterior - sound.log_posterior,
            silent or self.is_plausible(state),
            self.model.rms(sound.remaining, sound.about),
            self.model.rms(state.remaining, state.about),
            state.score.tolerance_scale,
            state.score.noise_scale,
        )


def _is_free(term: Term) -> bool:
    """True if a hypothesis changes the machine by an unknown amount."""
    return term.shift is not None and not term.known


def _known_shifts(terms: Sequence[Term]) -> list[MachineShift]:
    """Changes of the machine by known amounts."""
    return [t.shift for t in terms if t.shift is not None and t.known]


def _applied(state: HypothesisSet) -> Array:
    """Amounts of the changes of the machine by unknown ones, shape (n,)."""
    pairs = zip(state.terms, state.amounts, strict=True)
    return np.array([a[0] for t, a in pairs if _is_free(t)])


def _is_near(errors: Array) -> bool:
    """True if errors, in prior std, are those of a machine that is linearised about."""
    return bool(np.abs(errors).max(initial=0.0) < FURTHEST)


def _is_clear(found: HypothesisSet, state: HypothesisSet) -> bool:
    """True if a set is so much more likely than a state, which it extends, that it is reported."""
    gain = found.log_posterior - state.log_posterior
    return gain >= max(_needed(t) for t in found.terms[len(state.terms) :])


def _needed(term: Term) -> float:
    """Gain of log posterior from which on a hypothesis is reported."""
    return CLEARLY if term.systematic is None else EFFECT_CLEARLY - float(np.log(FAMILIES))


def _nearly_as_likely(
    ranked: list[HypothesisSet], plausible: list[HypothesisSet]
) -> list[HypothesisSet]:
    """The most likely sets; of a pair also single hypotheses, if they are not clearly less likely.

    The second anomaly of a pair needs the evidence that it would need after the first.
    """
    best = ranked[0].log_posterior
    near = [s for s in ranked if s.log_posterior > best - NEARLY]
    alone = [s for s in plausible if len(s.terms) < len(ranked[0].terms)]
    if alone and alone[0].log_posterior > best - CLEARLY:
        level = alone[0].log_posterior - NEARLY
        near += [s for s in alone if s.log_posterior > level and s not in near]
    return near


def _families(model: LinearModel, rows: Rows, *, grouped: bool = True) -> Iterator[Family]:
    if grouped:
        yield from wrong_units_and_signs(rows, model.sigma)
    yield from displaced_gauges(rows, model.sigma)
    yield from wrong_artefacts(model, rows)
    yield from wrong_readings(rows)
    yield from swapped_rows(rows)
    yield from row_offsets(rows)
    yield from changes_between_sessions(model)


def _is_paired(family: Family) -> bool:
    """True if a family takes part in the search over pairs.

    Those that change the machine do not, nor those that scale a volume of many readings.
    """
    if family.systematic or (family.edits is None and family.effects is None):
        return False
    if family.edits is not None and family.effects is not None:
        return False
    return family.log_volume is None or family.log_volume.max(initial=0.0) <= LARGEST_VOLUME


def _prior(family: Family) -> Array:
    """Logarithms of prior probabilities, with the factor on volumes, shape (h,)."""
    prior = np.full(family.count, -np.log(family.size * FAMILIES))
    return prior if family.log_volume is None else prior + family.log_volume


def _prior_of(effect: SystematicEffect) -> AmountPrior:
    """Prior of the parameters of an effect, in prior std."""
    return AmountPrior(EFFECT_SCALES, effect.positive)


def _vectors(group: Sequence[Indices] | Array, count: int) -> Array:
    """Effects of a group per unit, shape (k, count)."""
    return group if isinstance(group, np.ndarray) else _marks(group, count)


def _marks(groups: Sequence[NDArray[np.int64]], count: int) -> Array:
    """One vector per group of rows that is 1 there, shape (len(groups), count)."""
    return to_dense(sparse_rows(groups, [np.ones(len(g)) for g in groups], count))
