"""Scores of single hypotheses of all families, to first order, and of pairs of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from orthocal.arrays import Array
from orthocal.hypotheses.families.artefacts import wrong_artefacts
from orthocal.hypotheses.families.displaced_gauge import displaced_gauges
from orthocal.hypotheses.families.printer_settings import changes_between_logs
from orthocal.hypotheses.families.row_order import row_offsets, swapped_rows
from orthocal.hypotheses.families.sessions import changes_between_sessions, lost_steps
from orthocal.hypotheses.families.unit_and_sign import wrong_units_and_signs
from orthocal.hypotheses.families.wrong_readings import wrong_readings
from orthocal.hypotheses.hypothesis import Family, Patterns, Rows, to_dense
from orthocal.hypotheses.hypothesis_set import HypothesisSet, Term
from orthocal.hypotheses.likelihood import Products, log_of_sum
from orthocal.hypotheses.linear_model import LinearModel
from orthocal.hypotheses.linearisation import ModelLinearisation
from orthocal.hypotheses.pairs import Singles, find_pairs
from orthocal.hypotheses.set_evaluation import marks, prior_of, score_silent

CLEAR_LOG_BAYES = 7.0
"""Smallest log Bayes factor of a reported anomaly. By chance at most one of e⁷ = 1,100 sessions
reaches it."""

SIMILAR_LOG_BAYES = 3.0
"""Largest log Bayes factor against another explanation that is nearly as likely."""

REFIT_LOG_BAYES = 4.0
"""Smallest log Bayes factor, to first order, of hypotheses that are relinearised."""

N_FAMILIES = 34.0
"""Number of families that share the prior probability equally. Each effect that the model lacks
counts as a family. Families of printers replace those of controllers with offsets."""

MAX_REFITTED = 8
"""Most single hypotheses that are relinearised in each step."""

MAX_REFITTED_PAIRS = 12
"""Most pairs that are relinearised in each step."""

COARSE_MARGIN = 2.0
"""A pair is omitted if its log Bayes factor on the coarse grid is below −COARSE_MARGIN. The sum
over the full grid may exceed its largest term by COARSE_MARGIN + REFIT_LOG_BAYES."""

PAIR_MARGIN = CLEAR_LOG_BAYES + SIMILAR_LOG_BAYES
"""A pair is omitted if the best single hypothesis exceeds its log Bayes factor by this."""

MAX_PAIRED_ROWS = 60
"""Most rows of a session in which pairs of hypotheses are considered."""

LARGEST_VOLUME = float(np.log(1000.0))
"""Largest logarithm of the volume factor of a family that is considered in pairs."""

MIN_RELATIVE_CHANGE = 1e-3
"""Smallest change of the readings by one prior std of a considered shift, relative to the noise."""

CHUNK_SIZE = 4096
"""Number of hypotheses that are scored at once, to limit the memory."""


class FamilyScorer:
    """Scores of the hypotheses of families.

    Args:
        model: The linearised model.
        sound: The linearisation without anomalies.
    """

    def __init__(self, model: LinearModel, sound: ModelLinearisation) -> None:
        self.model, self.sound = model, sound
        self._n_rows = model.problem.observations.plus.size

    def score(
        self, state: HypothesisSet, families: Iterable[Family]
    ) -> Iterator[tuple[Family, Array]]:
        """Log Bayes factor of each hypothesis added to a state, to first order, with its prior."""
        likelihood = state.about.likelihood
        base = likelihood.products(state.remaining[None])
        sound = float(likelihood.score(base)[0])
        for family in families:
            if not family.count:
                continue
            if family.shifts:
                logs = self._score_shifts(state, family)
            elif family.edits is not None or family.effects is not None:
                logs = np.concatenate(
                    [
                        self._score_rows(state, family, slice(k, k + CHUNK_SIZE), base)
                        for k in range(0, family.count, CHUNK_SIZE)
                    ]
                )
            else:
                terms = (self.term(family, h) for h in range(family.count))
                logs = np.array([self._score_alone(state, t) for t in terms])
            yield family, logs - sound + _prior(family)

    def _score_alone(self, state: HypothesisSet, term: Term) -> float:
        """Log likelihood of a state with a term of several effects or of silent rows."""
        likelihood, deviation = state.about.likelihood, state.remaining
        if term.silent is not None:
            return score_silent(self.model, likelihood, deviation, term.silent)[0].log_likelihood
        prior = None if term.systematic is None else prior_of(term.systematic)
        if term.change is not None:
            deviation = deviation + self.model.entries(term.change[None])[0]
        effects = self.model.entries(np.asarray(term.effects))
        return likelihood.score_set(deviation, [effects], priors=[prior]).log_likelihood

    def _score_rows(
        self, state: HypothesisSet, family: Family, chosen: slice, base: Products
    ) -> Array:
        """Log likelihoods of some edits and effects of a family, shape (h,)."""
        model, about, deviation = self.model, state.about, state.remaining
        products, inner = base, np.zeros(1)
        edits = None if family.edits is None else family.edits.select(chosen)
        if edits is not None:  # products of the deviation d plus the change c: |d + c|²
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
        unit = model.relative_noise(effects)
        added = Products(added.along * unit[:, None], added.square * unit**2)
        return about.likelihood.score(products, added, (cross + inner) * unit)

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

    def term(self, family: Family, h: int) -> Term:
        """Hypothesis number h of a family, as a term of a set."""
        prior = float(_prior(family)[h])
        explanation = family.explain(h)
        if family.groups:
            group = family.groups[h]
            marked = group if isinstance(group, np.ndarray) else marks(group, self._n_rows)
            effects, unit = self._relative(marked)
            return Term(explanation, prior, effects=effects, unit=float(unit[0]))
        if family.systematic:
            effect = family.systematic[h]
            return Term(explanation, prior, -effect.change, effect.columns, effect)
        if family.silent:
            return Term(explanation, prior, silent=family.silent[h])
        if family.shifts:
            shift = family.shifts[h]
            if not family.known:  # a unit amount changes the readings by at most 1 m
                size = float(np.abs(self.model.shift_entries(self.sound, shift)).max()) or 1.0
                shift = replace(shift, direction=shift.direction / size, unit=1.0 / size)
            return Term(explanation, prior, shift=shift, known=family.known)
        edit = None if family.edits is None else family.edits.one(h)
        if family.effects is None:
            return Term(explanation, prior, edit)
        effects, unit = self._relative(family.effects.one(h)[None])
        return Term(explanation, prior, edit, effects, unit=float(unit[0]))

    def _relative(self, effects: Array) -> tuple[Array, Array]:
        """Effects on the rows (k, n_rows) per amount relative to the noise, and its unit (k,)."""
        unit = self.model.relative_noise(Patterns(effects))
        return effects * unit[:, None], unit

    def shortlist(self, scored: Sequence[tuple[Family, Array]]) -> list[Term]:
        """The most likely single hypotheses, and the most likely one of each kind."""
        ranked = sorted(
            (
                (float(evidence[h]), i, h)
                for i, (family, evidence) in enumerate(scored)
                if not family.systematic
                for h in np.argsort(-evidence)[:MAX_REFITTED].tolist()
            ),
            reverse=True,
        )
        # half of the places for the best of all, the others for the best of each other kind
        terms = [self.term(scored[i][0], h) for _, i, h in ranked[: 3 * MAX_REFITTED]]
        chosen = terms[: MAX_REFITTED // 2]
        kinds = {(t.explanation.kind, t.explanation.scope) for t in chosen}
        for (evidence, _, _), t in zip(ranked, terms, strict=False):
            key = (t.explanation.kind, t.explanation.scope)
            if evidence > 0.0 and key not in kinds:
                kinds.add(key)
                chosen.append(t)
        return chosen[:MAX_REFITTED]

    def far_terms(self, scored: Sequence[tuple[Family, Array]]) -> list[Term]:
        """Reversed signs of absolute readings, except of pairs of setups.

        They are far from the linearisation about the readings as stated, where a fixed ball is on
        the opposite side of its nominal position. So their evidence to first order does not count.
        """
        setups = self.model.problem.session.setups
        absolute = {name for name, setup in setups.items() if setup.zero == "known"}
        return [
            self.term(family, h)
            for family, _ in scored
            if family.log_volume is not None and absolute
            for h, e in enumerate(map(family.explain, range(family.count)))
            if e.kind == "reversed sign" and e.scope != "setups" and absolute.intersection(e.setups)
        ]

    def pairs(
        self, state: HypothesisSet, scored: Sequence[tuple[Family, Array]]
    ) -> tuple[list[tuple[Term, Term]], float]:
        """The most likely pairs of hypotheses, and the log of their summed Bayes factors."""
        is_small = self._n_rows <= MAX_PAIRED_ROWS
        edits = [f for f, _ in scored if f.edits is not None and _is_paired(f)]
        effects = [f for f, _ in scored if f.effects is not None and _is_paired(f)]
        families = [*edits, *effects]
        if not is_small or not families:
            return [], -np.inf
        likelihood = state.about.likelihood
        sound = float(likelihood.score(likelihood.products(state.remaining[None]))[0])
        best_single = max(float(e.max(initial=-np.inf)) for _, e in scored)
        rows = [
            np.vstack([np.zeros((0, self._n_rows)), *(to_dense(p.to_sparse()) for p in part if p)])
            for part in ([f.edits for f in edits], [f.effects for f in effects])
        ]
        rows[1], _ = self._relative(rows[1])
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
        chosen = pairs.members[evidence > REFIT_LOG_BAYES - SIMILAR_LOG_BAYES][:MAX_REFITTED_PAIRS]
        return [
            (self.term(*hypotheses[a]), self.term(*hypotheses[b])) for a, b in chosen.tolist()
        ], float(log_of_sum(evidence))


def list_families(model: LinearModel, rows: Rows, *, grouped: bool) -> Iterator[Family]:
    """All families of mistakes.

    Args:
        model: The linearised model.
        rows: The rows.
        grouped: Whether units and signs of groups of readings are considered.
    """
    if grouped:
        yield from wrong_units_and_signs(rows)
    yield from displaced_gauges(rows)
    yield from wrong_artefacts(model, rows)
    yield from wrong_readings(rows)
    yield from swapped_rows(rows)
    yield from row_offsets(rows)
    yield from changes_between_sessions(model)
    yield from changes_between_logs(model)
    yield from lost_steps(model, rows)


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
