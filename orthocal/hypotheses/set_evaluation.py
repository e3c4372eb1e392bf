"""Evaluation of sets of hypotheses: relinearised at the errors that each set implies."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthocal.arrays import Array, Indices
from orthocal.hypotheses.hypothesis import (
    MachineShift,
    SystematicEffect,
    sparse_rows,
    to_dense,
)
from orthocal.hypotheses.hypothesis_set import (
    HypothesisSet,
    Term,
    correct_rows,
    split_amounts,
)
from orthocal.hypotheses.likelihood import AmountPrior, Likelihood, Score
from orthocal.hypotheses.linear_model import (
    LARGEST_ERROR,
    MAX_RELINEARISATIONS,
    SMALL_CHANGE,
    LinearModel,
)
from orthocal.hypotheses.linearisation import LinearisationPoint, ModelLinearisation
from orthocal.statistics.zeros import project_out_zeros

EFFECT_SCALES = np.array([1.0, 4.0])
"""Grid of amplitudes of the parameters of an effect, [prior std]."""

LARGEST_CHANGE = 100.0
"""Largest plausible change of an error of the machine between two sessions, [prior std]."""

LARGEST_FIRST_STEP = 50.0
"""Largest error after the first relinearisation, [prior std]; beyond it, loops rarely close."""


class SetEvaluator:
    """Evaluation of sets of hypotheses about the readings of one session.

    Args:
        model: The linearised model.
        values: The readings, shape (n_rows,), [m].

    Attributes:
        reference: The linearisation about the machine without errors.
        sound: The set without hypotheses.
    """

    def __init__(self, model: LinearModel, values: Array) -> None:
        self.model, self.values = model, values
        self.reference = model.at_reference(keep_jacobian=model.has_shifts)
        self.sound = self.evaluate((), self.reference)

    def most_likely(self, terms: Sequence[Term] = ()) -> HypothesisSet | None:
        """The set of some hypotheses about its most likely machine; None if it is not possible."""
        rows = self.evaluate(terms, self.sound.about).corrected if terms else self.values
        nearest = self.model.most_likely(rows)
        point = LinearisationPoint(nearest.theta, (), nearest.passive)
        (about,) = self.model.linearise_all([point], keep_jacobian=self.model.has_shifts)
        return None if about is None else self.evaluate(terms, about)

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
                [p for _, p in steps], keep_jacobian=self.model.has_shifts
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
        shifts = [_known_shifts(terms) for terms in term_sets]
        shifted = iter(self._linearise_shifted([s for s in shifts if s]))
        states = []
        for terms, known in zip(term_sets, shifts, strict=True):
            unknown = sum(t.unknown_shift is not None for t in terms)
            about = next(shifted) if known else self.sound.about if unknown else start
            state = self._evaluate_about(terms, about or start, np.zeros(unknown))
            states.append(state if about else _without_likelihood(state))
        return states

    def _linearise_shifted(
        self, shifts: Sequence[list[MachineShift]]
    ) -> list[ModelLinearisation | None]:
        """Linearise with known machine shifts.

        It is about the errors without anomalies, or the reference where their readings are not
        possible, as for a tip that misses its rod. None where neither is possible.
        """
        if not shifts:  # such as for the set without anomalies itself
            return []
        results: list[ModelLinearisation | None] = [None] * len(shifts)
        for about in (self.sound.about, self.reference):
            missing = [i for i, one in enumerate(results) if one is None]
            points = [LinearisationPoint(about.theta, shifts[i], about.passive) for i in missing]
            for i, one in zip(
                missing, self.model.linearise_all(points, keep_jacobian=True), strict=True
            ):
                results[i] = one
        return results

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
        unknown = [t.unknown_shift for t in state.terms if t.unknown_shift is not None]
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
        groups, steps = self._vectors(terms, about)
        silent = [t.silent for t in terms if t.silent is not None]
        priors = [
            None if t.systematic is None else prior_of(t.systematic)
            for t in terms
            if t.effects is not None or t.unknown_shift is not None
        ]
        deviation = self.model.entries(rows[None])[0] - about.expected + applied @ steps
        if silent:
            rows_without = np.concatenate(silent)
            score, remaining = score_silent(
                self.model, about.likelihood, deviation, rows_without, groups, priors=priors
            )
        else:
            score = about.likelihood.score_set(deviation, groups, priors=priors)
            remaining = deviation - (score.amounts @ np.concatenate(groups) if groups else 0.0)
        amounts, stds = (split_amounts(terms, a) for a in (score.amounts, score.stds))
        changes = [
            abs(a[0]) * np.abs(t.unknown_shift.direction).max()
            for t, a in zip(terms, amounts, strict=True)
            if t.unknown_shift is not None
        ]
        state = HypothesisSet(
            tuple(terms), score, about, remaining, correct_rows(rows, terms, amounts), amounts, stds
        )
        excessive = max(changes, default=0.0) > LARGEST_CHANGE
        return _without_likelihood(state) if excessive else state

    def _vectors(
        self, terms: Sequence[Term], about: ModelLinearisation
    ) -> tuple[list[Array], Array]:
        """Effects of the terms on the entries, zeros projected out.

        Returns:
            Effects of each term, (k, n_entries) each; and effects of unknown shifts,
            (n, n_entries).
        """
        model, groups, steps = self.model, [], []
        for t in terms:
            if t.effects is not None:
                groups.append(model.entries(t.effects))
            elif t.unknown_shift is not None:
                groups.append(model.shift_entries(about, t.unknown_shift)[None])
                steps.append(groups[-1][0])
        return groups, np.array(steps).reshape(len(steps), -1 if steps else about.expected.size)


def score_silent(
    model: LinearModel,
    likelihood: Likelihood,
    deviation: Array,
    silent: Indices,
    groups: Sequence[Array] = (),
    *,
    priors: Sequence[AmountPrior | None] = (),
) -> tuple[Score, Array]:
    """Marginal likelihood of the other rows, if some single rows have no information.

    Args:
        model: The model.
        likelihood: Likelihood of all entries.
        deviation: Readings minus predictions, shape (n_entries,), zeros projected out, [m].
        silent: Rows without information.
        groups: Effects per unit, zeros projected out, (k, n_entries) each.
        priors: Prior of the amounts of each group, as in `Likelihood.score_set`.

    Returns:
        The score, with the errors of the silent rows, [m], behind the amounts; and the deviation
        without effects and errors, shape (n_entries,), [m].
    """
    o, ratio = model.problem.observations, model.problem.noise_ratio
    entries = o.plus[silent]
    informative = np.ones(o.size)
    informative[entries] = 0.0

    def restrict(vectors: Array) -> Array:
        return np.asarray(project_out_zeros(vectors.T, o, weights=informative).T * informative)

    restricted = likelihood.restricted(restrict, entries.size)
    score = restricted.score_set(
        restrict(deviation[None])[0], [restrict(g) for g in groups], priors=priors
    )
    corrected = deviation - (score.amounts @ np.concatenate(groups) if groups else 0.0)
    remaining = likelihood.predict(restrict(corrected[None])[0], restricted, score)
    errors = project_out_zeros(corrected - remaining, o, weights=informative)[entries]
    errors = errors * ratio[entries]
    # volumes of the removed coordinates: the noise ratios, and the shares of the zeros that remain
    totals = np.bincount(o.zero, minlength=o.n_zeros)
    shares = np.bincount(o.zero, informative, minlength=o.n_zeros) / np.maximum(totals, 1)
    shares = shares[~o.zero_known & (shares > 0.0)]
    volume = np.log(ratio[entries]).sum() - 0.5 * np.log(shares).sum()
    log_likelihood = score.log_likelihood + volume + 0.5 * entries.size * np.log(2.0 * np.pi)
    score = replace(
        score,
        log_likelihood=float(log_likelihood),
        amounts=np.append(score.amounts, errors),
        stds=np.append(score.stds, np.full(entries.size, np.inf)),
    )
    return score, remaining


def _without_likelihood(state: HypothesisSet) -> HypothesisSet:
    """The set as one that cannot be true about its linearisation."""
    return replace(state, score=replace(state.score, log_likelihood=-np.inf))


def _known_shifts(terms: Sequence[Term]) -> list[MachineShift]:
    """Machine shifts of known amounts."""
    return [t.shift for t in terms if t.shift is not None and t.known]


def _applied(state: HypothesisSet) -> Array:
    """Estimated amounts of the unknown machine shifts, shape (n,)."""
    pairs = zip(state.terms, state.amounts, strict=True)
    return np.array([a[0] for t, a in pairs if t.unknown_shift is not None])


def _are_small(errors: Array) -> bool:
    """True if no error exceeds LARGEST_ERROR, [prior std]."""
    return bool(np.abs(errors).max(initial=0.0) < LARGEST_ERROR)


def prior_of(effect: SystematicEffect) -> AmountPrior:
    """Prior of the parameters of an effect, in prior std."""
    return AmountPrior(EFFECT_SCALES, effect.positive)


def marks(groups: Sequence[NDArray[np.int64]], count: int) -> Array:
    """Indicator vectors of groups of rows, shape (len(groups), count)."""
    return to_dense(sparse_rows(groups, [np.ones(len(g)) for g in groups], count))
