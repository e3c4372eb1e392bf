"""Choice of the setups and readings with the smallest expected tool error.

Setups are added one by one, each with the readings of largest gain (`information_gain`). Then each
setup and each of its readings is exchanged for a better one, until the gain is small.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, zip_longest
from typing import cast

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import ParameterError
from orthocal.planning.candidates import MIN_READINGS, AlignedParameter, Candidates, CandidateSetup
from orthocal.planning.information_gain import (
    Gain,
    Pairs,
    PointGain,
    SetupGain,
    SetupStack,
    stack_setups,
)
from orthocal.planning.ranking import first_largest, is_less, sort_by
from orthocal.runtime.threads import one_thread
from orthocal.runtime.worker_pool import run_in_parallel
from orthocal.units import MM

MIN_IMPROVEMENT = 1e-3
"""Relative improvement by one round of exchanges that justifies another round."""

MAX_ROUNDS = 8
"""Most rounds of exchanges."""

MAX_REFINED = 4
"""Most candidate setups whose readings are exchanged in the search for a better setup."""

MAX_COMPLETED = 12
"""Most candidate setups of each gauge for which more than the best pair of readings is computed."""

MAX_PAIRS = 3
"""Most pairs of readings from which the readings of a setup are completed."""

MAX_PASSES = 4
"""Most passes that exchange each reading of a setup."""

MIN_STARTS, MAX_STARTS = 3, 30
"""Fewest and most starts by default. Two more than one reduce the error by 0 to 5 %."""

MIN_TOTAL_CANDIDATES = 20_000
"""Smallest product of the numbers of candidates and starts, with at most MAX_STARTS starts."""

KILLED = "a process that chose readings was killed"

ROUNDING_ERROR = 1e-6
"""Relative rounding error of the errors of `Gains.refine`."""

MAX_EXACTLY_RANKED = 2_000
"""Most candidate readings with which setups are ranked with the gauge aligned in each posture."""

NEGLIGIBLE = 1e-12
"""Relative singular value of directions of the state that no reading depends on."""

WeightFunction = Callable[[Array], Array]
"""Root R of the weight T = R Rᵀ for a covariance of the state, shape (n_state, p). It does not
depend on the covariance for mean squares."""


@dataclass(frozen=True, slots=True)
class PlannedSetup:
    """Setup of a plan."""

    candidate: int
    """Index of the candidate setup."""
    chosen: tuple[int, ...]
    """Indices of its readings in the candidate setup; the gauge is aligned in the first one."""


@dataclass(frozen=True, slots=True, eq=False)
class PlannedSetups:
    """Setups of a plan."""

    setups: tuple[PlannedSetup, ...]
    information: Array
    """Inverse covariance of the state from the setups and the prior, shape (n_state, n_state)."""
    error: float
    """Value of the criterion, √tr(T C)."""


_Start = Sequence[tuple[int, PlannedSetup | None]]
"""Start of a search: number of readings of each setup; and a randomly drawn setup, or None to add
the best one."""


@dataclass(frozen=True, slots=True, eq=False)
class SetupSearch:
    """Search among candidates for the setups with the smallest expected error."""

    candidates: Candidates
    prior: Array
    """Inverse prior covariance of the state, shape (n_state, n_state)."""
    weight: WeightFunction
    basis: Array
    """Orthonormal directions B of the state on which readings depend, (n_directions, n_state)."""
    reduced: tuple[CandidateSetup, ...]
    """Candidate setups with Jacobians A Bᵀ with respect to these directions."""
    pairs: tuple[Pairs, ...]
    """First pairs of readings of each candidate setup."""
    stacks: tuple[SetupStack, ...]
    """Candidate setups that are ranked together, with the alignment averaged over all postures."""

    @staticmethod
    def of(candidates: Candidates, prior: Array, weight: WeightFunction) -> SetupSearch:
        """Search among candidates.

        Args:
            candidates: Candidate setups and readings.
            prior: Inverse prior covariance of the state, shape (n_state, n_state).
            weight: Function for the root of the weight of the state.
        """
        jacobians = [
            s for k in candidates.setups for s in (k.jacobian, *(a.jacobian for a in k.aligned))
        ]
        triangle = np.linalg.qr(np.vstack(jacobians), mode="r")  # halves the time of the SVD
        _, singular, directions = np.linalg.svd(triangle, full_matrices=False)
        basis = directions[singular > NEGLIGIBLE * singular.max(initial=0.0)]
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
        averaged = candidates.count > MAX_EXACTLY_RANKED
        return SetupSearch(
            candidates.without_session,
            np.array(prior),
            weight,
            basis,
            reduced,
            pairs=tuple(map(Pairs.of, reduced)),
            stacks=tuple(
                stack_setups(
                    reduced,
                    [
                        i
                        for i, k in enumerate(reduced)
                        if k.width == 1 and (averaged or not k.aligned)
                    ],
                )
            ),
        )

    def choose(
        self,
        counts: Sequence[int],
        *,
        seed: int = 0,
        starts: int | None = None,
        workers: int = 1,
        report: Callable[[int, float], None] | None = None,
        first: PlannedSetups | None = None,
    ) -> PlannedSetups:
        """Choose setups with stated numbers of readings and the smallest expected error.

        Args:
            counts: Number of readings of each setup, at least 2, shape (n_setups,).
            seed: Seed of the random setups with which all starts except the first begin.
            starts: Number of starts, of which the best is returned. By default 3, and more for few
                candidates.
            workers: Number of processes; the result does not depend on it.
            report: Called after each start with its number and the smallest error so far.
            first: Result of the first start, if it is known.

        Raises:
            ValueError: If `starts` is below 1.
        """
        if starts is None:
            starts = MIN_TOTAL_CANDIDATES // self.candidates.count
            starts = int(np.clip(starts, MIN_STARTS, MAX_STARTS))
        if starts < 1:
            raise ValueError("expected at least one start")
        drawn = self._draw_starts(counts, seed, starts)
        known = [] if first is None else [(0, first)]
        done: dict[int, PlannedSetups] = {}
        reported, best = 0, None
        work = partial(self._run_start, drawn)
        searched = run_in_parallel(work, range(len(known), starts), workers, killed=KILLED)
        for start, setups in chain(known, searched):
            done[start] = setups
            while reported in done:
                if best is None or is_less(done[reported].error, best.error):
                    best = done[reported]
                reported += 1
                if report is not None:
                    report(reported, best.error)
        return cast(PlannedSetups, best)

    def grow(self, counts: Sequence[int]) -> Iterator[PlannedSetups]:
        """Add setups one by one; the plans are nearly as good as those of `choose`.

        After each addition one of the setups is exchanged in turn, because earlier setups were
        chosen without later ones.

        Yields:
            The plan after each addition.
        """
        plan = self.empty
        for n, count in enumerate(counts):
            plan = self.extend(plan, self._find_best(plan.information, count))
            if n:
                plan = self._exchange(plan, (n - 1) % (n + 1))
            yield plan

    def plan_of(self, setups: Sequence[PlannedSetup]) -> PlannedSetups:
        """Plan with these setups."""
        information = self.prior + self.information_of(*setups)
        return PlannedSetups(tuple(setups), information, self.error_of(information))

    def improve(self, setups: Sequence[PlannedSetup]) -> PlannedSetups:
        """Plan with these setups exchanged for better ones."""
        return self.run([(len(s.chosen), s) for s in setups])

    def _run_start(self, starts: Sequence[_Start], which: int) -> PlannedSetups:
        return self.run(starts[which])

    def run(self, start: _Start) -> PlannedSetups:
        """Add the setups of one start one by one, then exchange them."""
        with one_thread():
            plan = self.empty
            for count, drawn in start:
                plan = self.extend(plan, drawn or self._find_best(plan.information, count))
            unimproved: set[int] = set()  # setups of this plan for which no better one was found
            for _ in range(MAX_ROUNDS):
                before = plan.error
                for k in range(len(plan.setups)):
                    if k not in unimproved:
                        exchanged = self._exchange(plan, k)
                        unimproved = {*unimproved, k} if exchanged is plan else set()
                        plan = exchanged
                if plan.error > before * (1.0 - MIN_IMPROVEMENT):
                    break
            return plan

    @property
    def empty(self) -> PlannedSetups:
        """Plan without a setup."""
        return PlannedSetups((), self.prior, self.error_of(self.prior))

    def extend(self, plan: PlannedSetups, added: PlannedSetup) -> PlannedSetups:
        """Plan with an additional setup."""
        information = plan.information + self.information_of(added)
        return PlannedSetups((*plan.setups, added), information, self.error_of(information))

    def information_of(self, *setups: PlannedSetup) -> Array:
        """Inverse covariance of the state from the readings of setups, (n_state, n_state).

        Raises:
            ValueError: If a setup has fewer than two readings.
        """
        total = np.zeros_like(self.prior)
        for planned in setups:
            if len(planned.chosen) < MIN_READINGS:
                raise ValueError(
                    f"found {len(planned.chosen)} readings; expected {MIN_READINGS} or more"
                )
            setup = self.candidates.setups[planned.candidate]
            jacobian = setup.jacobian_of(planned.chosen)
            weights = setup.weights_of(planned.chosen, self.candidates.sigma**2)
            total += jacobian.T @ weights @ jacobian
        return total

    def error_of(self, information: Array) -> float:
        """Value of the criterion for an inverse covariance of the state."""
        covariance = _inverse(information)
        root = self.weight(covariance)
        return float(np.sqrt(np.vdot(root, covariance @ root)))

    def _draw_starts(self, counts: Sequence[int], seed: int, starts: int) -> Sequence[_Start]:
        """Starts of the search: the first without random setups, the others with half of them."""
        rng, half = np.random.default_rng(seed), (len(counts) + 1) // 2
        drawn: list[_Start] = [[(count, None) for count in counts]]
        for _ in range(1, starts):
            shuffled = [counts[i] for i in rng.permutation(len(counts))]
            setups = [self._draw_setup(n, rng) for n in shuffled[:half]]
            drawn.append(list(zip_longest(shuffled, setups)))
        return drawn

    def _draw_setup(self, count: int, rng: np.random.Generator) -> PlannedSetup | None:
        """Random setup; None if the drawn candidate cannot have `count` readings."""
        which = int(rng.integers(len(self.candidates.setups)))
        reachable = self.candidates.setups[which].reachable
        possible = np.flatnonzero(reachable.sum(axis=1) >= count)
        if not possible.size or count < self.candidates.setups[which].min_readings:
            return None
        first = int(rng.choice(possible))
        others = np.flatnonzero(reachable[first])
        others = rng.choice(others[others != first], size=count - 1, replace=False)
        return PlannedSetup(which, (first, *(int(i) for i in others)))

    def _find_best(self, information: Array, count: int) -> PlannedSetup:
        """Setup with the largest gain, given the information of others."""
        ranked = Gains.of(self, information).rank(count)
        if not ranked:
            raise ParameterError(
                f"no setup can have {count} readings within the gauge's range, of which the "
                f"tolerances of the machine need {self.candidates.spare_range / MM:.2g} mm to "
                "either side; expected fewer readings per setup, a larger range, smaller "
                "tolerances such as --tolerance '*.offset_mm=2', or more postures",
                where="plan",
            )
        return ranked[0]

    def _exchange(self, plan: PlannedSetups, k: int) -> PlannedSetups:
        """Plan with one setup exchanged for the best one in addition to the others."""
        old, best = plan.setups[k], plan
        others = plan.information - self.information_of(old)
        gains = Gains.of(self, others)
        ranked = gains.rank(len(old.chosen))[:MAX_REFINED]
        for new, rough_error in gains.refine([old], restarted=ranked):
            if new == old or rough_error > best.error * (1.0 + ROUNDING_ERROR):
                continue
            exchanged = self.exchanged(plan, k, new, others)
            if is_less(exchanged.error, best.error):
                best = exchanged
        return best

    def exchanged(
        self, plan: PlannedSetups, k: int, new: PlannedSetup, others: Array
    ) -> PlannedSetups:
        """Plan with one setup exchanged.

        Args:
            plan: The plan.
            k: Index of the setup.
            new: The other setup.
            others: Inverse covariance of the state without setup k, shape (n_state, n_state).
        """
        information = others + self.information_of(new)
        setups = (*plan.setups[:k], new, *plan.setups[k + 1 :])
        return PlannedSetups(setups, information, self.error_of(information))


@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """Gains of all candidate setups, conditional on the information of others."""

    search: SetupSearch
    covariance: Array
    """B C Bᵀ, shape (n_directions, n_directions)."""
    root: Array
    """B C R, shape (n_directions, p)."""
    total: float | None
    """tr(T C); None if T depends on C."""

    @staticmethod
    def of(search: SetupSearch, information: Array) -> Gains:
        """Gains in addition to an inverse covariance of the state."""
        covariance = _inverse(information)
        root = search.weight(covariance)
        constant = search.weight(covariance) is root
        total = float(np.vdot(root, covariance @ root)) if constant else None
        reduced = search.basis @ covariance
        return Gains(search, reduced @ search.basis.T, reduced @ root, total)

    def gain_of(self, setup: CandidateSetup) -> Gain:
        """Gain by a candidate setup."""
        kind = SetupGain if setup.width == 1 else PointGain
        return kind.of(setup, self.covariance, self.root, self.search.candidates.sigma)

    def refine(
        self, setups: Sequence[PlannedSetup], *, restarted: Sequence[PlannedSetup] = ()
    ) -> list[tuple[PlannedSetup, float]]:
        """Setups with each reading exchanged for a better one, without repetition.

        Args:
            setups: The setups.
            restarted: Setups that are first completed greedily from each of their best pairs.

        Returns:
            Setups, and the error with each from its gain; 0 if T depends on the covariance.
        """
        candidates = {s.candidate for s in (*setups, *restarted)}
        gain_of = {which: self.gain_of(self.search.reduced[which]) for which in candidates}
        starts = [*setups, *(s for r in restarted for s in self._restart(r, gain_of[r.candidate]))]
        exchanged = dict.fromkeys(_exchange_readings(s, gain_of[s.candidate]) for s in starts)
        refined = [_exchange_first(s, gain_of[s.candidate]) for s in exchanged]
        return [(s, self.rough_error(s, gain_of[s.candidate])) for s in refined]

    def rough_error(self, planned: PlannedSetup, gain: Gain) -> float:
        """Error with an additional setup, from its gain; 0 if T depends on the covariance."""
        if self.total is None:
            return 0.0
        return math.sqrt(max(self.total - float(gain.gains(np.array([planned.chosen]))[0]), 0.0))

    def _restart(self, planned: PlannedSetup, gain: Gain) -> list[PlannedSetup]:
        """Setups completed greedily from each of the best pairs of readings."""
        which, count = planned.candidate, len(planned.chosen)
        pairs = gain.best_pairs(self.search.pairs[which].with_count(count), MAX_PAIRS)
        return [
            PlannedSetup(which, gain.begin_with(pair[0]).grow(pair, count)[1]) for _, pair in pairs
        ]

    def rank(self, count: int) -> list[PlannedSetup]:
        """Best readings of candidate setups, completed greedily; largest gain first.

        Only the best setups of `begin` are completed.
        """
        completed = []
        for which, pair, gain in self.begin(count):
            if count < self.search.reduced[which].min_readings:
                continue
            gains, chosen = gain.grow(pair, count)
            completed.append((gains[-1], PlannedSetup(which, chosen)))
        return [planned for _, planned in sort_by(completed, lambda c: c[0])]

    def begin(
        self, count: int, gauges: Collection[str] | None = None
    ) -> list[tuple[int, tuple[int, int], Gain]]:
        """Candidate setups that begin with their best pairs of readings, the largest gain first.

        At most MAX_COMPLETED setups of each gauge are listed. With many candidates they are ranked
        with the alignment averaged over all postures, in half the time.

        Args:
            count: Number of readings that the gauge's range must allow.
            gauges: Names of the gauges; by default all.

        Returns:
            The candidate setup, the pair, and the gain with the gauge aligned in its first reading.
        """
        listed: Counter[str] = Counter()
        best = []
        for _, which, pair in sort_by(self._best_pairs(count, gauges), lambda c: c[0]):
            setup = self.search.reduced[which]
            listed[setup.gauge] += 1
            if listed[setup.gauge] <= MAX_COMPLETED:
                best.append((which, pair, self.gain_of(setup).begin_with(pair[0])))
        return best

    def _best_pairs(
        self, count: int, gauges: Collection[str] | None
    ) -> list[tuple[float, int, tuple[int, int]]]:
        """Gain, candidate setup and best pair of readings of each setup, in the order of setups."""
        search, noise = self.search, self.search.candidates.sigma**2
        ranked, stacked = [], set[int]()
        for stack in search.stacks:
            stacked.update(stack.which.tolist())
            if gauges is None or stack.gauge in gauges:
                ranked += stack.best_pairs(self.covariance, self.root, noise, count)
        for which in set(range(len(search.reduced))) - stacked:
            setup, pairs = search.reduced[which], search.pairs[which].with_count(count)
            if (gauges is None or setup.gauge in gauges) and pairs.first.size:
                best = self.gain_of(setup).best_pairs(pairs, 1)
                ranked += [(gain, which, pair) for gain, pair in best]
        return sorted(ranked, key=lambda r: r[1])


def _exchange_first(planned: PlannedSetup, gain: Gain) -> PlannedSetup:
    """Setup that begins with another reading, chosen or not, if this gains more."""
    setup, chosen = gain.setup, planned.chosen
    if not setup.aligned:
        return planned
    reordered = [(first, *(i for i in chosen if i != first)) for first in chosen]
    new_first = np.setdiff1d(np.arange(len(setup.rows)), chosen)
    others = np.broadcast_to(chosen[1:], (len(new_first), len(chosen) - 1))
    sets = np.vstack([reordered, np.column_stack([new_first, others])])
    possible = sets[setup.reachable[sets[:, :1], sets].all(axis=1)]
    best = first_largest(gain.gains(possible))
    return PlannedSetup(planned.candidate, tuple(possible[best].tolist()))


def _exchange_readings(planned: PlannedSetup, gain: Gain) -> PlannedSetup:
    """Setup with each reading in turn exchanged for the best one in addition to the others."""
    setup, chosen = gain.setup, list(planned.chosen)
    for _ in range(MAX_PASSES):
        before = list(chosen)
        aligned = gain.begin_with(chosen[0])
        gains = aligned.exchange_gains(chosen)
        for place, old in enumerate(before):
            others = chosen[:place] + chosen[place + 1 :]
            # the range about a new first reading must contain all others
            allowed = np.array(
                setup.reachable[chosen[0]] if place else setup.reachable[:, others].all(axis=1)
            )
            allowed[others] = False
            chosen[place] = first_largest(np.where(allowed, gains[place], -1.0))
            if chosen[place] != old:
                gains = aligned.exchange_gains(chosen)
        if chosen == before:
            break
    return PlannedSetup(planned.candidate, tuple(chosen))


def _inverse(information: Array) -> Array:
    """Symmetric inverse of a symmetric matrix."""
    inverse = np.linalg.inv(information)
    return np.asarray(0.5 * (inverse + inverse.T), dtype=np.float64)
