"""Choice of setups of several gauges within a measuring time.

Each gauge has separate durations of a setup and a reading. Setups with the largest gain per minute
are added until the time is used. Then each setup is replaced by the best one that fits, or by
several with the largest gain per minute, until the gain is small.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import NamedTuple

from orthocal.errors import ParameterError
from orthocal.planning.candidates import MIN_READINGS
from orthocal.planning.owned_sensors import SLACK, Duration
from orthocal.planning.ranking import best_of, sort_by
from orthocal.planning.selection import (
    KILLED,
    MAX_REFINED,
    MIN_IMPROVEMENT,
    ROUNDING_ERROR,
    Gains,
    PlannedSetup,
    PlannedSetups,
    SetupSearch,
)
from orthocal.runtime.threads import one_thread
from orthocal.runtime.worker_pool import run_in_parallel

READINGS = (2, 3, 4, 6, 9, 12, 16, 24, 32, 48, 64, 96)
"""Possible numbers of readings of a setup."""

MAX_SETUPS = 40
"""Most setups of a plan."""

MAX_ROUNDS = 4
"""Most rounds of exchanges."""

MAX_PAIRED_SETUPS = 3
"""Most setups of a plan in which two are exchanged together, because single ones rarely fit into a
short time."""

UNLIMITED = 1e6
"""Time longer than any plan, [min]."""


class _Option(NamedTuple):
    """Possible additional setup."""

    gain: float
    """Reduction of tr(T C)."""
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


def _negative_error(plan: PlannedSetups) -> float:
    """Negative error, to find the best plan."""
    return -plan.error


@dataclass(frozen=True, slots=True, eq=False)
class TimedSearch:
    """Search for the setups with the smallest expected error within a time."""

    search: SetupSearch
    durations: Mapping[str, Duration]
    """Durations with each gauge to use, by its name."""
    once: frozenset[str] = frozenset()
    """Names of the gauges with at most one setup in a plan: a bed does not move."""

    def choose(
        self,
        minutes: float,
        *,
        starts: int | None = None,
        workers: int = 1,
        report: Callable[[int, float], None] | None = None,
    ) -> PlannedSetups:
        """Choose setups within a time as the best of several starts.

        The first start begins with the setup of largest gain per minute. Each other start begins
        with the best setup of one gauge.

        Args:
            minutes: Available time.
            starts: Largest number of starts; by default one more than the number of gauges.
            workers: Number of processes; the result does not depend on it.
            report: Called after each start with its number and its error.

        Raises:
            ParameterError: If no setup fits into the time or the range of its gauge.
        """
        gauges = dict.fromkeys(s.gauge for s in self.search.reduced)
        first_gauges: list[str | None] = [None, *gauges] if len(gauges) > 1 else [None]
        first_gauges = first_gauges[:starts]
        work = partial(self._run_start, minutes, first_gauges)
        done: dict[int, PlannedSetups] = {}
        indices = range(len(first_gauges))
        for which, planned in run_in_parallel(work, indices, workers, killed=KILLED):
            done[which] = planned
            if report is not None:
                report(len(done), planned.error)
        best = best_of((done[i] for i in sorted(done)), _negative_error)
        if not best.setups:
            shortest = min(d.of(MIN_READINGS) for d in self.durations.values())
            raise ParameterError(
                f"found {minutes:.3g} min; expected at least {shortest:.3g} min, a setup of "
                f"{MIN_READINGS} readings, and a gauge with a sufficient range for the tolerances "
                "of the machine",
                where="plan",
            )
        return best

    def _run_start(self, minutes: float, starts: Sequence[str | None], which: int) -> PlannedSetups:
        """Setups of one start.

        Args:
            minutes: Available time.
            starts: Gauge of the first setup of each start; None for the largest gain per minute.
            which: Index of the start.
        """
        setups, first = [], starts[which]
        if first is not None:
            with one_thread():
                options = self._list_options(self.search.empty, 0.5 * minutes)
            of_gauge = [o for o in options if self._gauge(o.planned) == first]
            if of_gauge:
                setups.append(best_of(of_gauge, lambda o: o.gain).planned)
        return self.improve(setups, minutes)

    def improve(self, setups: Sequence[PlannedSetup], minutes: float) -> PlannedSetups:
        """Plan with these setups and further ones, exchanged for better ones within a time."""
        with one_thread():
            plan = self.fill(self.search.plan_of(setups), minutes)
            plan = self._exchange_all(plan, minutes, count=1)
            if len(plan.setups) > MAX_PAIRED_SETUPS:
                return plan
            return self._exchange_all(plan, minutes, count=2)

    def _exchange_all(self, plan: PlannedSetups, minutes: float, *, count: int) -> PlannedSetups:
        """Exchange `count` setups at a time until the gain is small."""
        unimproved: set[tuple[PlannedSetup, ...]] = set()  # no better setups were found for these
        for _ in range(MAX_ROUNDS):
            before = plan.error
            for old in combinations(plan.setups, count):
                if old in unimproved or not Counter(old) <= Counter(plan.setups):
                    continue
                exchanged = self._exchange(plan, old, minutes)
                unimproved = {*unimproved, old} if exchanged is plan else set()
                plan = exchanged
            if plan.error > before * (1.0 - MIN_IMPROVEMENT):
                break
        return plan

    def fill(self, plan: PlannedSetups, minutes: float) -> PlannedSetups:
        """Add setups of largest gain per minute to a plan until none fits into a time."""
        while len(plan.setups) < MAX_SETUPS and (
            options := self._list_options(plan, minutes - self.minutes(plan.setups))
        ):
            plan = self.search.extend(plan, best_of(options, _rate).planned)
        return plan

    def grow(self) -> Iterator[PlannedSetups]:
        """Add setups one by one, or readings to a setup that can be used once.

        Each step has the largest gain per minute.

        Yields:
            The plan after each step.
        """
        plan = self.search.empty
        while steps := [*self._additions(plan), *self._enlargements(plan)]:
            step = best_of(steps, lambda s: s.rate)
            plan = self.search.extend(self.search.plan_of(step.others), step.planned)
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
            old_gain, old_minutes = without.error**2 - plan.error**2, self.minutes([old])
            alone = replace(self, durations={gauge: self.durations[gauge]})
            for option in alone._list_options(without, UNLIMITED):
                if len(option.planned.chosen) > len(old.chosen):
                    further = max(option.minutes - old_minutes, SLACK)
                    yield _Step((option.gain - old_gain) / further, others, option.planned)

    def minutes(self, setups: Sequence[PlannedSetup]) -> float:
        """Minutes of setups with their closing readings."""
        return sum(self.durations[self._gauge(s)].of(len(s.chosen)) for s in setups)

    def _gauge(self, planned: PlannedSetup) -> str:
        """Name of the gauge of a setup."""
        return self.search.reduced[planned.candidate].gauge

    def _list_options(self, plan: PlannedSetups, minutes: float) -> list[_Option]:
        """Setups that fit into a time, with their gains in addition to a plan."""
        used = self.once & {self._gauge(setup) for setup in plan.setups}
        max_counts = {
            name: 0 if name in used else d.max_readings(minutes, READINGS[-1])
            for name, d in self.durations.items()
        }
        gauges = {name for name, count in max_counts.items() if count >= MIN_READINGS}
        if not gauges:
            return []
        gains, options = Gains.of(self.search, plan.information), list[_Option]()
        for which, pair, gain in gains.begin(MIN_READINGS, gauges):
            gauge = self.search.reduced[which].gauge
            gain_after, chosen = gain.grow(pair, max_counts[gauge])
            counts = {n for n in READINGS if n < len(chosen)} | {len(chosen)}
            for count in counts - set(range(self.search.reduced[which].min_readings)):
                duration = self.durations[gauge].of(count)
                planned = PlannedSetup(which, chosen[:count])
                options.append(_Option(gain_after[count - 1], duration, planned))
        return options

    def _exchange(
        self, plan: PlannedSetups, old: Sequence[PlannedSetup], minutes: float
    ) -> PlannedSetups:
        """Plan with setups exchanged for those of largest gain, total or per minute."""
        others = list(plan.setups)
        for setup in old:
            others.remove(setup)
        information = plan.information - self.search.information_of(*old)
        without = replace(plan, setups=tuple(others), information=information)
        options = self._list_options(without, minutes - self.minutes(others))
        if not options:
            return plan
        fastest = best_of(options, _rate).planned
        plans = [plan, self.fill(self.search.extend(without, fastest), minutes)]
        refined = self._refine(without, old[0] if len(old) == 1 else None, options)
        plans.append(self.fill(refined, minutes))
        return best_of(plans, _negative_error)

    def _refine(
        self, without: PlannedSetups, old: PlannedSetup | None, options: Sequence[_Option]
    ) -> PlannedSetups:
        """Add the best of several setups after exchanging their readings."""
        gains = Gains.of(self.search, without.information)
        by_candidate: dict[int, PlannedSetup] = {}
        for option in sort_by(options, lambda o: o.gain):
            by_candidate.setdefault(option.planned.candidate, option.planned)
        setups = [*([] if old is None else [old]), *list(by_candidate.values())[:MAX_REFINED]]
        best: PlannedSetups | None = None
        for new, rough_error in gains.refine(setups):
            if best is None or rough_error <= best.error * (1.0 + ROUNDING_ERROR):
                changed = self.search.extend(without, new)
                best = changed if best is None else best_of([best, changed], _negative_error)
        return without if best is None else best
