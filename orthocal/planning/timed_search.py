"""Choice of setups of several gauges within a measuring time.

Each gauge has its own times for a setup and a reading. Setups with the largest gain per minute are
added until the time is used. Then each setup is replaced, by the best one that its time allows or
by several that gain most per minute, until little is gained.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import NamedTuple

from threadpoolctl import threadpool_limits

from orthocal.errors import ParameterError
from orthocal.planning.candidates import FEWEST
from orthocal.planning.owned_sensors import SLACK, Duration
from orthocal.planning.ranking import best_of, sort_by
from orthocal.planning.selection import (
    KILLED,
    LEAST_IMPROVEMENT,
    MOST_REFINED,
    ROUGH,
    Gains,
    PlannedSetup,
    PlannedSetups,
    SetupSearch,
)
from orthocal.runtime.worker_pool import run_in_parallel

READINGS = (2, 3, 4, 6, 9, 12, 16, 24, 32, 48, 64, 96)
"""Numbers of readings of a setup that are tried."""

MOST_ROUNDS = 4

MOST_PAIRED = 3
"""Setups up to which two are exchanged together: in a short time single ones do not fit."""

UNLIMITED = 1e6
"""Minutes beyond any plan."""


class _Option(NamedTuple):
    gain: float
    minutes: float
    planned: PlannedSetup


class _Step(NamedTuple):
    """A further setup of a growing plan."""

    rate: float
    """Gain per minute."""
    others: tuple[PlannedSetup, ...]
    """Setups that stay."""
    planned: PlannedSetup


def _rate(option: _Option) -> float:
    """Gain per minute."""
    return option.gain / max(option.minutes, SLACK)


def _accuracy(plan: PlannedSetups) -> float:
    return -plan.error


@dataclass(frozen=True, slots=True, eq=False)
class TimedSearch:
    """Search for the setups with the smallest expected error within a time."""

    search: SetupSearch
    durations: Mapping[str, Duration]
    """Of each gauge to use, by its name."""
    once: frozenset[str] = frozenset()
    """Gauges of which a plan has one setup at most: a bed does not move."""

    def choose(
        self,
        minutes: float,
        *,
        starts: int | None = None,
        workers: int = 1,
        report: Callable[[int, float], None] | None = None,
    ) -> PlannedSetups:
        """Setups within a time, the best of several starts.

        The first start begins with the setup of largest gain per minute, each other one with the
        best setup of one gauge.

        Args:
            minutes: Available time.
            starts: Number of starts; by default one more than gauges.
            workers: Number of processes; the result does not depend on it.
            report: Called after each start with its number and its error.

        Raises:
            ParameterError: If no setup fits into the time or the range of its gauge.
        """
        gauges = dict.fromkeys(s.gauge for s in self.search.reduced)
        begun: list[str | None] = [None, *gauges] if len(gauges) > 1 else [None]
        begun = begun[:starts]
        work = partial(_run, self, minutes, begun)
        done: dict[int, PlannedSetups] = {}
        for which, planned in run_in_parallel(work, range(len(begun)), workers, killed=KILLED):
            done[which] = planned
            if report is not None:
                report(len(done), planned.error)
        best = best_of((done[i] for i in sorted(done)), _accuracy)
        if not best.setups:
            shortest = min(d.of(FEWEST) for d in self.durations.values())
            raise ParameterError(
                f"found {minutes:.3g} min; expected at least {shortest:.3g} min, a setup of "
                f"{FEWEST} readings, and a gauge whose range the tolerances of the machine allow",
                where="plan",
            )
        return best

    def run(self, minutes: float, first: str | None) -> PlannedSetups:
        """Setups of one start.

        Args:
            minutes: Available time.
            first: Gauge of the first setup; by default the one with the largest gain per minute.
        """
        with threadpool_limits(1):  # on several threads sums may be rounded differently
            plan = self.search.empty
            if first is not None:
                options = self._list_options(plan, 0.5 * minutes)
                of_gauge = [o for o in options if self._gauge(o.planned) == first]
                if of_gauge:
                    best = best_of(of_gauge, lambda o: o.gain)
                    plan = self.search.plan_of([best.planned])
            plan = self._improve(self._fill(plan, minutes), minutes, together=1)
            if len(plan.setups) > MOST_PAIRED:
                return plan
            return self._improve(plan, minutes, together=2)

    def _improve(self, plan: PlannedSetups, minutes: float, *, together: int) -> PlannedSetups:
        """Plan with setups exchanged, one or two of them at a time, until little is gained."""
        for _ in range(MOST_ROUNDS):
            before = plan.error
            for old in combinations(plan.setups, together):
                if Counter(old) <= Counter(plan.setups):  # and not exchanged since
                    plan = self._exchange(plan, old, minutes)
            if plan.error > before * (1.0 - LEAST_IMPROVEMENT):
                break
        return plan

    def fill(self, minutes: float) -> PlannedSetups:
        """Setups within a time, of the largest gain per minute, without exchanges."""
        return self._fill(self.search.empty, minutes)

    def grow(self) -> Iterator[PlannedSetups]:
        """Plans with one setup more each, or with more readings of a setup that can be used once.

        Each step has the largest gain per minute.
        """
        plan = self.search.empty
        while steps := [*self._additions(plan), *self._enlargements(plan)]:
            step = best_of(steps, lambda s: s.rate)
            plan = self._with(self.search.plan_of(step.others), step.planned)
            yield plan

    def _additions(self, plan: PlannedSetups) -> Iterator[_Step]:
        """Steps that add a setup to a plan."""
        for option in self._list_options(plan, UNLIMITED):
            yield _Step(_rate(option), plan.setups, option.planned)

    def _enlargements(self, plan: PlannedSetups) -> Iterator[_Step]:
        """Steps that give more readings to a setup that can be used once."""
        for old in plan.setups:
            gauge = self._gauge(old)
            if gauge not in self.once:
                continue
            others = tuple(s for s in plan.setups if s is not old)
            without = self.search.plan_of(others)
            known, used = without.error**2 - plan.error**2, self.minutes([old])
            alone = replace(self, durations={gauge: self.durations[gauge]})
            for option in alone._list_options(without, UNLIMITED):
                if len(option.planned.chosen) > len(old.chosen):
                    further = max(option.minutes - used, SLACK)
                    yield _Step((option.gain - known) / further, others, option.planned)

    def minutes(self, setups: Sequence[PlannedSetup]) -> float:
        """Minutes of setups with their closing readings."""
        return sum(self.durations[self._gauge(s)].of(len(s.chosen)) for s in setups)

    def _gauge(self, planned: PlannedSetup) -> str:
        return self.search.reduced[planned.candidate].gauge

    def _with(self, plan: PlannedSetups, added: PlannedSetup) -> PlannedSetups:
        information = plan.information + self.search.information_of(added)
        error = self.search.error_of(information)
        return PlannedSetups((*plan.setups, added), information, error)

    def _fill(self, plan: PlannedSetups, minutes: float) -> PlannedSetups:
        """Plan with further setups of largest gain per minute, until none fits."""
        while True:
            left = minutes - self.minutes(plan.setups)
            options = self._list_options(plan, left)
            if not options:
                return plan
            plan = self._with(plan, best_of(options, _rate).planned)

    def _list_options(self, plan: PlannedSetups, minutes: float) -> list[_Option]:
        """Setups that fit into a time, with their gains beside those of a plan."""
        used = self.once & {self._gauge(setup) for setup in plan.setups}
        most = {
            name: 0 if name in used else d.most(minutes, READINGS[-1])
            for name, d in self.durations.items()
        }
        able = {name for name, count in most.items() if count >= FEWEST}
        if not able:
            return []
        gains, options = Gains.of(self.search, plan.information), list[_Option]()
        for which, pair in gains.begin(FEWEST, able):
            gauge = self.search.reduced[which].gauge
            reached, chosen = gains.setup(which, pair[0]).grow(pair, most[gauge])
            counts = {n for n in READINGS if n < len(chosen)} | {len(chosen)}
            for count in counts - set(range(self.search.reduced[which].fewest)):
                duration = self.durations[gauge].of(count)
                planned = PlannedSetup(which, chosen[:count])
                options.append(_Option(reached[count - 1], duration, planned))
        return options

    def _exchange(
        self, plan: PlannedSetups, old: Sequence[PlannedSetup], minutes: float
    ) -> PlannedSetups:
        """Plan with setups exchanged for those of largest gain, in all or per minute."""
        others = list(plan.setups)
        for setup in old:
            others.remove(setup)
        information = plan.information - self.search.information_of(*old)
        without = replace(plan, setups=tuple(others), information=information)
        options = self._list_options(without, minutes - self.minutes(others))
        if not options:
            return plan
        rate = best_of(options, _rate).planned
        plans = [plan, self._fill(self._with(without, rate), minutes)]
        refined = self._refine(without, old[0] if len(old) == 1 else None, options)
        plans.append(self._fill(refined, minutes))
        return best_of(plans, _accuracy)

    def _refine(
        self, without: PlannedSetups, old: PlannedSetup | None, options: Sequence[_Option]
    ) -> PlannedSetups:
        """Plan with the best of several setups added, their readings exchanged."""
        gains = Gains.of(self.search, without.information)
        likely: dict[int, PlannedSetup] = {}
        for option in sort_by(options, lambda o: o.gain):
            likely.setdefault(option.planned.candidate, option.planned)
        tried = [*([] if old is None else [old]), *list(likely.values())[:MOST_REFINED]]
        best: PlannedSetups | None = None
        for new in dict.fromkeys(gains.exchange_readings(s) for s in tried):
            new = gains.exchange_first(new)
            if best is None or gains.rough_error(new) <= best.error * (1.0 + ROUGH):
                changed = self._with(without, new)
                best = changed if best is None else best_of([best, changed], _accuracy)
        return without if best is None else best


def _run(
    search: TimedSearch, minutes: float, starts: Sequence[str | None], which: int
) -> PlannedSetups:
    return search.run(minutes, starts[which])
