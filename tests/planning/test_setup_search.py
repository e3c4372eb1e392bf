"""Search among candidates: against enumeration, and its errors against least squares."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np
import pytest

from orthocal.planning.candidates import AlignedParameter, Candidates, CandidateSetup
from orthocal.planning.planned_session import order_postures
from orthocal.planning.selection import Gains, PlannedSetup, SetupSearch
from orthocal.runtime import worker_pool as cores

SIGMA = 0.5
STATE = 4
ZERO = 1e3
"""Standard deviation of a zero, large beside SIGMA."""


def draw_candidates(rng, *, kinds=3, readings=4, own=1, hands=0):
    """Kinds of a random problem, and their unknowns, which the choice never sees.

    With hands so much of each gauge is set by the machine where a setup begins.
    """
    found, unknowns = [], []
    for k in range(kinds):
        slopes, mine = rng.normal(size=(readings, STATE)), 0.5 * rng.normal(size=(readings, own))
        h = np.sort(rng.uniform(0.0, 3.0, readings))
        together = np.abs(h[:, None] - h[None]) < 2.0
        spread = mine @ mine.T + ZERO**2
        by_hand = tuple(
            AlignedParameter(rng.normal(size=readings), rng.normal(size=(readings, STATE)))
            for _ in range(hands)
        )
        found.append(
            CandidateSetup(f"k{k}", np.arange(readings), slopes, spread, together, by_hand)
        )
        unknowns.append(mine)
    return Candidates(None, None, tuple(found), SIGMA, tuple("abcd"), 0.0), unknowns


def posterior(candidates, unknowns, setups, prior):
    """Covariance of the state by least squares over state, unknowns and zeros together."""
    count = len(setups)
    width = unknowns[0].shape[1] + 1
    rows = []
    for place, s in enumerate(setups):
        kind = candidates.setups[s.candidate]
        for i in s.chosen:
            row = np.zeros(STATE + count * width)
            row[:STATE] = kind.jacobian[i]
            for hand in kind.aligned:
                row[:STATE] += hand.sensitivity[i] * hand.jacobian[s.chosen[0]]
            own = STATE + place * width
            row[own : own + width] = [*unknowns[s.candidate][i], 1.0]
            rows.append(row / SIGMA)
    whole = np.array(rows)
    known = np.zeros(STATE + count * width)
    known[STATE:] = 1.0
    known[STATE + width - 1 :: width] = 1.0 / ZERO**2
    information = whole.T @ whole + np.diag(known)
    information[:STATE, :STATE] += prior
    return np.linalg.inv(information)[:STATE, :STATE]


def every_setup(candidates, count):
    """All setups that can take so many readings, by their first and their others."""
    for k, kind in enumerate(candidates.setups):
        for first in range(len(kind.rows)):
            others = [i for i in np.flatnonzero(kind.reachable[first]) if i != first]
            for rest in combinations(others, count - 1):
                yield PlannedSetup(k, (first, *(int(i) for i in rest)))


def information(candidates, unknowns, setup):
    """What one setup says of the state: its unknowns and zero are of it alone."""
    own = np.linalg.inv(posterior(candidates, unknowns, [setup], np.eye(STATE)))
    return own - np.eye(STATE)


@pytest.mark.parametrize("hands", [0, 1])
def test_rounding_does_not_choose_between_mirrored_readings(hands):
    """Readings from the other side gain as much: the plan is the same on every processor."""
    rng = np.random.default_rng(5)
    candidates, _ = draw_candidates(rng, hands=hands)

    def both_sides(setup):
        side = np.repeat([1.0, -1.0], len(setup.rows))
        jacobian = np.tile(setup.jacobian, (2, 1))
        jacobian[:, -1] = side
        return replace(
            setup,
            rows=np.arange(side.size),
            jacobian=jacobian * (1.0 + 1e-12 * rng.normal(size=jacobian.shape)),
            covariance=np.tile(setup.covariance, (2, 2)),
            reachable=np.tile(setup.reachable, (2, 2)),
            aligned=tuple(
                AlignedParameter(np.tile(a.sensitivity, 2), np.tile(a.jacobian, (2, 1)))
                for a in setup.aligned
            ),
        )

    def choose():
        rounded = replace(candidates, setups=tuple(both_sides(s) for s in candidates.setups))
        return (
            SetupSearch.of(rounded, np.eye(STATE), lambda _: np.eye(STATE))
            .choose([3, 3, 2], seed=0, starts=2)
            .setups
        )

    first = choose()
    assert all(choose() == first for _ in range(10))


@pytest.mark.parametrize("hands", [0, 1, 2])
@pytest.mark.parametrize("seed", range(8))
def test_a_plan_is_nearly_the_best_of_all(seed, hands):
    rng = np.random.default_rng(seed)
    candidates, unknowns = draw_candidates(rng, hands=hands)
    root, prior = rng.normal(size=(STATE, 2)), np.eye(STATE)
    found = SetupSearch.of(candidates, prior, lambda _: root).choose([3, 2], seed=0)
    threes, twos = (
        np.array([information(candidates, unknowns, s) for s in every_setup(candidates, count)])
        for count in (3, 2)
    )
    pairs = np.linalg.inv(prior + threes[:, None] + twos)
    best = np.sqrt(np.trace(root.T @ pairs @ root, axis1=2, axis2=3).min())
    assert best * (1.0 - 1e-9) <= found.error < 1.01 * best
    # and what it says of itself is what least squares say
    own = posterior(candidates, unknowns, found.setups, prior)
    assert found.error == pytest.approx(np.sqrt(np.trace(root.T @ own @ root)), rel=1e-4)
    search = SetupSearch.of(candidates, prior, lambda _: root)
    assert np.linalg.inv(prior + search.information_of(*found.setups)) == pytest.approx(
        own, rel=1e-3, abs=1e-6
    )


def test_every_setup_stays_in_the_range_of_the_gauge():
    rng = np.random.default_rng(3)
    candidates, _ = draw_candidates(rng, kinds=4, readings=8)
    root = rng.normal(size=(STATE, STATE))
    found = SetupSearch.of(candidates, np.eye(STATE), lambda _: root).choose([4, 3, 3])
    for s in found.setups:
        kind = candidates.setups[s.candidate]
        assert len(set(s.chosen)) == len(s.chosen)
        assert kind.reachable[s.chosen[0], list(s.chosen)].all()


def test_the_same_seed_gives_the_same_plan():
    rng = np.random.default_rng(5)
    candidates, _ = draw_candidates(rng, kinds=6, readings=8)
    root = rng.normal(size=(STATE, STATE))
    first, second = (
        SetupSearch.of(candidates, np.eye(STATE), lambda _: root).choose([3, 3], seed=7)
        for _ in range(2)
    )
    assert first.setups == second.setups


@pytest.mark.parametrize("forked", [True, False])
def test_any_number_of_processes_chooses_the_same_to_the_last_bit(monkeypatch, forked):
    monkeypatch.setattr(cores, "can_fork", lambda: forked)
    rng = np.random.default_rng(5)
    candidates, _ = draw_candidates(rng, kinds=6, readings=8)
    root, told = rng.normal(size=(STATE, STATE)), {}

    def choose(workers):
        told[workers] = []
        return SetupSearch.of(candidates, np.eye(STATE), Always(root)).choose(
            [3, 3],
            seed=7,
            starts=5,
            workers=workers,
            report=lambda *words: told[workers].append(words),
        )

    alone, together = choose(1), choose(2)
    assert together.setups == alone.setups
    assert together.error == alone.error
    assert together.information.tobytes() == alone.information.tobytes()
    assert [start for start, _ in told[1]] == [1, 2, 3, 4, 5]
    assert told[2] == told[1]


@dataclass
class Always:
    """What the state does, whatever is known of it."""

    root: np.ndarray

    def __call__(self, covariance):
        return self.root


def test_the_rough_error_needs_a_constant_weight():
    """The error of the worst point, say, is another one for each covariance."""
    rng = np.random.default_rng(2)
    candidates, _ = draw_candidates(rng, kinds=3, readings=6)
    root, prior = rng.normal(size=(STATE, 2)), np.eye(STATE)
    search = SetupSearch.of(candidates, prior, Always(root))
    steady = Gains.of(search, prior)
    changing = Gains.of(
        SetupSearch.of(candidates, prior, lambda covariance: covariance @ root), prior
    )
    for opened in every_setup(candidates, 3):
        left = search.error_of(prior + search.information_of(opened))
        gain = steady.gain_of(search.reduced[opened.candidate])
        assert steady.rough_error(opened, gain) == pytest.approx(left, rel=1e-9)
        assert changing.rough_error(opened, gain) == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_the_path_through_postures_is_nearly_the_shortest(seed):
    points = np.random.default_rng(seed).normal(size=(7, 3))
    way = order_postures(points)
    assert way[0] == 0
    assert sorted(way) == list(range(7))

    def length(order):
        closed = points[[*order, order[0]]]
        return np.linalg.norm(np.diff(closed, axis=0), axis=1).sum()

    shortest = min(length((0, *rest)) for rest in permutations(range(1, 7)))
    assert length(way) < 1.1 * shortest
