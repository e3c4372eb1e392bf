"""Choice of the setups and readings that make the expected tool error small.

Setups are added one after the other, each with the readings of largest gain (`information_gain`).
Then each setup, and each of its readings, is exchanged for a better one until little is gained.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import zip_longest
from typing import cast

import numpy as np
from threadpoolctl import threadpool_limits

from orthocal.arrays import Array
from orthocal.errors import ParameterError
from orthocal.planning.candidates import FEWEST, AlignedParameter, Candidates, CandidateSetup
from orthocal.planning.information_gain import Gain, Pairs, PointGain, SetupGain
from orthocal.planning.ranking import first_largest, is_less, sort_by
from orthocal.runtime.worker_pool import run_in_parallel
from orthocal.units import MM

LEAST_IMPROVEMENT = 1e-3
"""Relative improvement by one round of exchanges that justifies another round."""

MOST_ROUNDS = 8

MOST_REFINED = 4
"""Candidate setups whose readings are exchanged, to find the best of them."""

MOST_COMPLETED = 12
"""Candidate setups of each gauge for which more than the best pair of readings is computed."""

MOST_PAIRS = 3
"""Pairs of readings from which the readings of a setup are completed."""

MOST_PASSES = 4
"""Passes through the readings of a setup that exchange them."""

FEWEST_STARTS, MOST_STARTS = 3, 30

CANDIDATES_A_START = 20_000
"""Product of candidates and starts, at least, up to MOST_STARTS: few candidates, many starts."""

KILLED = "a process that chose readings was killed"

ROUGH = 1e-6
"""Relative rounding error of an error that is computed without an inverse."""

FEW = 2_000
"""Number of candidates up to which setups are ranked with the gauge aligned in each posture."""

UNSEEN = 1e-12
"""Relative singular value below which no reading depends on a direction of the state."""

Weigh = Callable[[Array], Array]
"""R with T = R Rᵀ for a covariance of the state, shape (n_state, p); constant for mean squares."""


@dataclass(frozen=True, slots=True)
class PlannedSetup:
    """Setup of a plan."""

    candidate: int
    """Index of the candidate setup."""
    chosen: tuple[int, ...]
    """Indices of its readings; the gauge is aligned in the first one."""


@dataclass(frozen=True, slots=True, eq=False)
class PlannedSetups:
    """Setups of a plan."""

    setups: tuple[PlannedSetup, ...]
    information: Array
    """Inverse covariance of the state from the setups and the prior, shape (n_state, n_state)."""
    error: float
    """Criterion as an error: √tr(T C)."""


_Start = Sequence[tuple[int, PlannedSetup | None]]
"""Beginning of a search: readings of each setup, and the setup if it was drawn at random, or None
where the best one is added."""


@dataclass(frozen=True, slots=True, eq=False)
class SetupSearch:
    """Search among candidates for the setups with the smallest expected error."""

    candidates: Candidates
    prior: Array
    """Inverse prior covariance of the state, shape (n_state, n_state)."""
    weigh: Weigh
    basis: Array
    """B, orthogonal directions of the state on which readings depend, shape (n_seen, n_state)."""
    reduced: tuple[CandidateSetup, ...]
    """Candidate setups with Jacobians by these directions, A Bᵀ."""
    pairs: dict[tuple[int, int], Pairs] = field(default_factory=dict)
    """Possible first pairs, by candidate setup and number of readings; filled by the search."""

    @staticmethod
    def of(candidates: Candidates, prior: Array, weigh: Weigh) -> SetupSearch:
        """Search among candidates.

        Args:
            candidates: Candidate setups and readings.
            prior: Inverse prior covariance of the state.
            weigh: Weight of the state.
        """
        jacobians = [
            s for k in candidates.setups for s in (k.jacobian, *(a.jacobian for a in k.aligned))
        ]
        triangle = np.linalg.qr(np.vstack(jacobians), mode="r")  # half the time of a single SVD
        _, sizes, directions = np.linalg.svd(triangle, full_matrices=False)
        basis = directions[sizes > UNSEEN * sizes.max(initial=0.0)]
        reduced = tuple(
            replace(
                k,
                jacobian=k.jacobian @ basis.T,
                aligned=tuple(
                    AlignedParameter(a.sensitivity, a.jacobian @ basis.T) for a in k.aligned
                ),
            )
            for k in candidates.setups
        )
        return SetupSearch(candidates.without_session, np.array(prior), weigh, basis, reduced)

    def choose(
        self,
        counts: Sequence[int],
        *,
        seed: int = 0,
        starts: int | None = None,
        workers: int = 1,
        report: Callable[[int, float], None] | None = None,
    ) -> PlannedSetups:
        """Setups with given numbers of readings and the smallest expected error.

        Args:
            counts: Readings of each setup, at least 2, shape (n_setups,).
            seed: Seed of the setups with which all starts but the first begin.
            starts: Number of starts, of which the best is returned. By default 3, and more for few
                candidates.
            workers: Number of processes; the result does not depend on it.
            report: Called after each start with its number and the smallest error so far.
        """
        if starts is None:
            wanted = CANDIDATES_A_START // self.candidates.count
            starts = int(np.clip(wanted, FEWEST_STARTS, MOST_STARTS))
        if starts < 1:
            raise ValueError("expected at least one start")
        drawn = self._draw_starts(counts, seed, starts)
        done: dict[int, PlannedSetups] = {}
        reported, best = 0, None
        work = partial(_run, self, drawn)
        for start, setups in run_in_parallel(work, range(starts), workers, killed=KILLED):
            done[start] = setups
            while reported in done:
                if best is None or is_less(done[reported].error, best.error):
                    best = done[reported]
                reported += 1
                if report is not None:
                    report(reported, best.error)
        return cast(PlannedSetups, best)

    def grow(self, counts: Sequence[int]) -> Iterator[PlannedSetups]:
        """Plans with one setup more each, nearly as good as those of `choose`.

        After each addition one of the setups is exchanged in turn: the first ones were chosen
        without the others.
        """
        plan = self.empty
        for n, count in enumerate(counts):
            plan = self._extend(plan, self._find_best(plan.information, count))
            if n:
                plan = self._exchange(plan, (n - 1) % (n + 1))
            yield plan

    def plan_of(self, setups: Sequence[PlannedSetup]) -> PlannedSetups:
        """Plan of given setups."""
        information = self.prior + self.information_of(*setups)
        return PlannedSetups(tuple(setups), information, self.error_of(information))

    def improve(self, setups: Sequence[PlannedSetup]) -> PlannedSetups:
        """Plan from given setups, which are exchanged for better ones."""
        return self.run([(len(s.chosen), s) for s in setups])

    def run(self, start: _Start) -> PlannedSetups:
        """Setups of one start: added one after the other, then exchanged."""
        with threadpool_limits(1):  # on several threads sums may be rounded differently
            plan = self.empty
            for count, drawn in start:
                plan = self._extend(plan, drawn or self._find_best(plan.information, count))
            for _ in range(MOST_ROUNDS):
                before = plan.error
                for k in range(len(plan.setups)):
                    plan = self._exchange(plan, k)
                if plan.error > before * (1.0 - LEAST_IMPROVEMENT):
                    break
            return plan

    @property
    def empty(self) -> PlannedSetups:
        """Plan without a setup."""
        return PlannedSetups((), self.prior, self.error_of(self.prior))

    def _extend(self, plan: PlannedSetups, added: PlannedSetup) -> PlannedSetups:
        information = plan.information + self.information_of(added)
        return PlannedSetups((*plan.setups, added), information, self.error_of(information))

    def information_of(self, *setups: PlannedSetup) -> Array:
        """Inverse covariance of the state from the readings of setups, (n_state, n_state)."""
        total = np.zeros_like(self.prior)
        for planned in setups:
            if len(planned.chosen) < FEWEST:
                raise ValueError(f"found {len(planned.chosen)} readings; expected {FEWEST} or more")
            setup, noise = self.candidates.setups[planned.candidate], self.candidates.sigma**2
            jacobian, rows = setup.jacobian_of(planned.chosen), setup.numbers(planned.chosen)
            spread = setup.covariance[np.ix_(rows, rows)] + noise * np.eye(len(rows))
            total += jacobian.T @ np.linalg.solve(spread, jacobian)
        return total

    def error_of(self, information: Array) -> float:
        """Criterion as an error, for an inverse covariance of the state."""
        covariance = _inverse(information)
        root = self.weigh(covariance)
        return float(np.sqrt(np.vdot(root, covariance @ root)))

    def _draw_starts(self, counts: Sequence[int], seed: int, starts: int) -> Sequence[_Start]:
        """First start without random numbers; in the others the first half of setups is random."""
        rng, half = np.random.default_rng(seed), (len(counts) + 1) // 2
        drawn: list[_Start] = [[(count, None) for count in counts]]
        for _ in range(1, starts):
            shuffled = [counts[i] for i in rng.permutation(len(counts))]
            setups = [self._draw_setup(n, rng) for n in shuffled[:half]]
            drawn.append(list(zip_longest(shuffled, setups)))
        return drawn

    def _draw_setup(self, count: int, rng: np.random.Generator) -> PlannedSetup | None:
        """Random setup; None where the drawn one cannot have that many readings."""
        which = int(rng.integers(len(self.candidates.setups)))
        reachable = self.candidates.setups[which].reachable
        able = np.flatnonzero(reachable.sum(axis=1) >= count)
        if not able.size or count < self.candidates.setups[which].fewest:
            return None
        first = int(rng.choice(able))
        others = np.flatnonzero(reachable[first])
        remainder = rng.choice(others[others != first], size=count - 1, replace=False)
        return PlannedSetup(which, (first, *(int(i) for i in remainder)))

    def _find_best(self, information: Array, count: int) -> PlannedSetup:
        """Setup with the largest gain, given the information of others."""
        ranked = Gains.of(self, information).rank(count)
        if not ranked:
            raise ParameterError(
                f"no setup can have {count} readings within the gauge's range, of which the "
                f"tolerances of the machine need {self.candidates.spare_range / MM:.2g} mm to "
                "either side; expected fewer readings a setup, a larger range, smaller tolerances "
                "such as --tolerance '*.offset_mm=2', or more postures",
                where="plan",
            )
        return ranked[0]

    def _exchange(self, plan: PlannedSetups, k: int) -> PlannedSetups:
        """Plan with one setup exchanged for the best one beside the others."""
        old, best = plan.setups[k], plan
        others = plan.information - self.information_of(old)
        gains = Gains.of(self, others)
        ranked = gains.rank(len(old.chosen))[:MOST_REFINED]
        restarted = (s for r in ranked for s in gains.restart(r))
        for new in dict.fromkeys(gains.exchange_readings(s) for s in (old, *restarted)):
            new = gains.exchange_first(new)
            if gains.rough_error(new) > best.error * (1.0 + ROUGH):
                continue
            information = others + self.information_of(new)
            error = self.error_of(information)
            if is_less(error, best.error):
                setups = (*plan.setups[:k], new, *plan.setups[k + 1 :])
                best = PlannedSetups(setups, information, error)
        return best


def _run(search: SetupSearch, starts: Sequence[_Start], which: int) -> PlannedSetups:
    return search.run(starts[which])


@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """Gains of all candidate setups, given the information of others."""

    search: SetupSearch
    covariance: Array
    """B C Bᵀ, shape (n_seen, n_seen)."""
    root: Array
    """B C R, shape (n_seen, p)."""
    total: float | None
    """tr(T C); None where T depends on C."""
    averaged: bool
    """Whether setups are ranked with the alignment averaged over all postures."""
    computed: dict[tuple[int, int | None, bool], Gain] = field(default_factory=dict)
    """Gains so far, by candidate setup, first reading, and whether alignment is averaged."""

    @staticmethod
    def of(search: SetupSearch, information: Array) -> Gains:
        """Gains beside an inverse covariance of the state."""
        covariance = _inverse(information)
        root = search.weigh(covariance)
        constant = search.weigh(covariance) is root
        total = float(np.vdot(root, covariance @ root)) if constant else None
        known = search.basis @ covariance
        averaged = search.candidates.count > FEW
        return Gains(search, known @ search.basis.T, known @ root, total, averaged)

    def setup(self, which: int, first: int | None = None) -> Gain:
        """Gain of a candidate setup, begun with one of its readings."""
        key = which, first if self.search.reduced[which].aligned else None, False
        if key not in self.computed:
            reduced = self.search.reduced[which]
            self.computed[key] = (
                self._compute(reduced) if key[1] is None else self.setup(which).begun(key[1])
            )
        return self.computed[key]

    def _ranking_setup(self, which: int) -> Gain:
        """Gain for ranking: of many candidates with the alignment averaged over all postures.

        That takes half the time.
        """
        reduced = self.search.reduced[which]
        if not (reduced.aligned and self.averaged):
            return self.setup(which)
        key = which, None, True
        if key not in self.computed:
            self.computed[key] = self._compute(replace(reduced, aligned=()))
        return self.computed[key]

    def _compute(self, setup: CandidateSetup) -> Gain:
        kind = SetupGain if setup.width == 1 else PointGain
        return kind.of(setup, self.covariance, self.root, self.search.candidates.sigma)

    def _pairs(self, which: int, count: int) -> Pairs:
        key, pairs = (which, count), self.search.pairs
        if key not in pairs:
            pairs[key] = Pairs.of(self.search.reduced[which], count)
        return pairs[key]

    def rough_error(self, planned: PlannedSetup) -> float:
        """Error with a setup, without an inverse; 0 where the weight depends on the covariance."""
        if self.total is None:
            return 0.0
        (gain,) = self.setup(planned.candidate).gains(np.array([planned.chosen]))
        return math.sqrt(max(self.total - gain, 0.0))

    def exchange_first(self, planned: PlannedSetup) -> PlannedSetup:
        """Setup that starts from another reading, chosen before or not, if that gains more."""
        setup, chosen = self.search.reduced[planned.candidate], planned.chosen
        if not setup.aligned:
            return planned
        begun_with = [(first, *(i for i in chosen if i != first)) for first in chosen]
        first = np.setdiff1d(np.arange(len(setup.rows)), chosen)
        remainder = np.broadcast_to(chosen[1:], (len(first), len(chosen) - 1))
        sets = np.vstack([begun_with, np.column_stack([first, remainder])])
        able = sets[setup.reachable[sets[:, :1], sets].all(axis=1)]
        best = first_largest(self.setup(planned.candidate).gains(able))
        return PlannedSetup(planned.candidate, tuple(able[best].tolist()))

    def rank(self, count: int) -> list[PlannedSetup]:
        """Best readings of each candidate setup, completed greedily; largest gain first.

        Only setups of each gauge whose best pair of readings gains most are completed.
        """
        completed = []
        for which, pair in self.begin(count):
            if count < self.search.reduced[which].fewest:
                continue
            gain, chosen = self.setup(which, pair[0]).complete(pair, count)
            completed.append((gain, PlannedSetup(which, chosen)))
        return [planned for _, planned in sort_by(completed, lambda c: c[0])]

    def begin(
        self, count: int, gauges: Collection[str] | None = None
    ) -> list[tuple[int, tuple[int, int]]]:
        """Setups of each gauge whose best pair of readings gains most, with this pair.

        Args:
            count: Number of readings that the range of the gauge allows beside the first one.
            gauges: Names of the gauges; by default all.
        """
        present = [
            (gain, which, pair)
            for which, setup in enumerate(self.search.reduced)
            if (gauges is None or setup.gauge in gauges) and self._pairs(which, count).flat.size
            for gain, pair in self._ranking_setup(which).best_pairs(self._pairs(which, count), 1)
        ]
        of_gauge: Counter[str] = Counter()
        begun = []
        for _, which, pair in sort_by(present, lambda p: p[0]):
            gauge = self.search.reduced[which].gauge
            of_gauge[gauge] += 1
            if of_gauge[gauge] <= MOST_COMPLETED:
                begun.append((which, pair))
        return begun

    def restart(self, planned: PlannedSetup) -> list[PlannedSetup]:
        """Setup completed greedily from each of the best pairs of readings."""
        which, count = planned.candidate, len(planned.chosen)
        return [
            PlannedSetup(which, self.setup(which, pair[0]).complete(pair, count)[1])
            for _, pair in self.setup(which).best_pairs(self._pairs(which, count), MOST_PAIRS)
        ]

    def exchange_readings(self, planned: PlannedSetup) -> PlannedSetup:
        """Setup with each reading in turn exchanged for the best one beside the others."""
        setup, chosen = self.search.reduced[planned.candidate], list(planned.chosen)
        for _ in range(MOST_PASSES):
            before = list(chosen)
            gain = self.setup(planned.candidate, chosen[0])
            gains = gain.exchange_gains(chosen)
            for place, old in enumerate(before):
                others = chosen[:place] + chosen[place + 1 :]
                # from another first reading the gauge must reach all others
                allowed = np.array(
                    setup.reachable[chosen[0]] if place else setup.reachable[:, others].all(axis=1)
                )
                allowed[others] = False
                chosen[place] = first_largest(np.where(allowed, gains[place], -1.0))
                if chosen[place] != old:
                    gains = gain.exchange_gains(chosen)
            if chosen == before:
                break
        return PlannedSetup(planned.candidate, tuple(chosen))


def _inverse(information: Array) -> Array:
    inverse = np.linalg.inv(information)
    return np.asarray(0.5 * (inverse + inverse.T), dtype=np.float64)
