"""Gains of readings, compared with posterior covariances."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from orthocal.planning.candidates import AlignedParameter, CandidateSetup
from orthocal.planning.information_gain import Pairs, PointGain, SetupGain, stack_setups

SIGMA, STATE, READINGS = 0.5, 5, 7
POINTS, WIDTH = 6, 3


def draw(seed):
    """Candidate setup, information of other setups about the state, and root of the weight.

    The gauge zero is known if the seed is odd.
    """
    rng = np.random.default_rng(seed)
    jacobian, of_nuisance = rng.normal(size=(READINGS, STATE)), rng.normal(size=(READINGS, 2))
    h = rng.uniform(0.0, 3.0, READINGS)
    reachable = np.abs(h[:, None] - h[None]) < 1.2
    covariance, rows = of_nuisance @ of_nuisance.T, np.arange(READINGS)
    setup = CandidateSetup("k", rows, jacobian, covariance, reachable, absolute=bool(seed % 2))
    return setup, *draw_others(rng)


def draw_points(seed):
    """Candidate setup of points, each of three numbers; information and root as in `draw`."""
    rng = np.random.default_rng(seed)
    rows = POINTS * WIDTH
    jacobian, of_nuisance = rng.normal(size=(rows, STATE)), rng.normal(size=(rows, 2))
    covariance, reachable = of_nuisance @ of_nuisance.T, np.ones((POINTS, POINTS), dtype=bool)
    first = np.arange(0, rows, WIDTH)
    setup = CandidateSetup("k", first, jacobian, covariance, reachable, width=WIDTH)
    return setup, *draw_others(rng)


def draw_others(rng):
    """Information of other setups about the state, and root of the weight."""
    rows = rng.normal(size=(STATE, STATE))
    return rows @ rows.T + np.eye(STATE), rng.normal(size=(STATE, 2))


def weighted_trace(setup, information, root, chosen):
    """tr(T C) with some readings or points, by the inverse of the total information.

    A free gauge zero is one more parameter without a prior.
    """
    rows = [setup.width * i + c for i in chosen for c in range(setup.width)]
    covariance = setup.covariance[np.ix_(rows, rows)] + SIGMA**2 * np.eye(len(rows))
    free = int(not setup.absolute and setup.width == 1 and len(rows) > 0)
    jacobian = np.hstack([setup.jacobian[rows], np.ones((len(rows), free))])
    total = np.pad(information, (0, free)) + jacobian.T @ np.linalg.inv(covariance) @ jacobian
    return np.trace(root.T @ np.linalg.inv(total)[:STATE, :STATE] @ root)


def gain_of(kind, setup, information, root):
    """Gain of a kind (class) by a setup."""
    covariance = np.linalg.inv(information)
    return kind.of(setup, covariance, covariance @ root, SIGMA)


def gain_and_reduction(kind, setup, information, root):
    """Gain of a setup, and the reduction of the error by chosen readings or points."""

    def reduction(chosen, without=()):
        before, after = (weighted_trace(setup, information, root, r) for r in (without, chosen))
        return before - after

    return gain_of(kind, setup, information, root), reduction


@pytest.fixture(params=range(4))
def drawn(request):
    return gain_and_reduction(SetupGain, *draw(request.param))


@pytest.fixture(params=range(2))
def drawn_points(request):
    return gain_and_reduction(PointGain, *draw_points(request.param))


@pytest.fixture(
    params=[(SetupGain, draw, seed) for seed in range(4)] + [(PointGain, draw_points, 0)]
)
def drawn_of_both(request):
    kind, draw, seed = request.param
    return gain_and_reduction(kind, *draw(seed))


def test_a_gain_is_the_reduction_of_the_error(drawn_of_both):
    gain, reduction = drawn_of_both
    for chosen in ([2], [0, 3], [1, 4, 5, 2]):
        expected = pytest.approx(reduction(chosen), rel=1e-9, abs=1e-12)
        assert gain.gains(np.array([chosen])) == expected


def test_the_gain_of_a_reading_or_point_in_place_of_another(drawn_of_both):
    gain, reduction = drawn_of_both
    chosen = [5, 1, 3]
    gains = gain.exchange_gains(chosen)
    for place in range(len(chosen)):
        others = chosen[:place] + chosen[place + 1 :]
        for new in set(range(len(gain.setup.rows))) - set(others):
            expected = reduction([*others, new], without=others)
            assert gains[place, new] == pytest.approx(expected, rel=1e-9)


def test_the_best_pair_of_an_absolute_setup(drawn):
    gain, _ = drawn
    gain = replace(gain, setup=replace(gain.setup, absolute=True))
    pairs = Pairs.of(gain.setup).with_count(2)
    gains = gain.gains(np.column_stack([pairs.first, pairs.second]))
    (best, pair), *_ = gain.best_pairs(pairs, 1)
    assert best == pytest.approx(gains.max(), rel=1e-9)
    assert gain.gains(np.array([pair])) == pytest.approx(best, rel=1e-9)


@pytest.mark.parametrize("count", [2, 4])
def test_readings_are_completed_greedily(drawn, count):
    gain, reduction = drawn
    for _, pair in gain.best_pairs(Pairs.of(gain.setup).with_count(count), 3):
        gains, chosen = gain.grow(pair, count)
        expected = list(pair)
        while len(expected) < count:
            possible = np.flatnonzero(gain.setup.reachable[pair[0]])
            further = [r for r in possible if r not in expected]
            expected.append(max(further, key=lambda r: reduction([*expected, r])))
        assert list(chosen) == expected
        assert gains[-1] == pytest.approx(reduction(chosen), rel=1e-9)


@pytest.mark.parametrize("count", [2, 4, 6])
def test_best_pairs_have_the_largest_gains_and_share_no_reading(drawn, count):
    """With a free gauge zero the gain of a pair is that of its difference."""
    gain, _ = drawn
    gain = replace(gain, setup=replace(gain.setup, absolute=False))
    spread, reachable = gain.spread, gain.setup.reachable

    def of_difference(pair):
        i, j = pair
        effect = gain.effect[i] - gain.effect[j]
        variance = spread[i, i] + spread[j, j] - 2.0 * spread[i, j] + 2.0 * SIGMA**2
        return float(effect @ effect) / variance

    possible = [
        p
        for p in permutations(range(READINGS), 2)
        if reachable[p] and reachable[p[0]].sum() >= count
    ]
    found = gain.best_pairs(Pairs.of(gain.setup).with_count(count), 3)
    for value, pair in found:
        assert value == pytest.approx(max(map(of_difference, possible)), rel=1e-12)
        assert pair in possible
        possible = [p for p in possible if not set(p) & set(pair)]
    assert len(found) == 3 or not possible


@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize("count", [2, 4, 8])
def test_stacked_setups_have_the_best_pairs_of_each(absolute, count):
    """Setups of two gauges and two sizes, some of which cannot have as many readings."""
    setups = [replace(draw(seed)[0], absolute=absolute, gauge="ab"[seed % 2]) for seed in range(6)]
    few = np.arange(5)
    setups += [
        replace(
            k,
            rows=few,
            jacobian=k.jacobian[:5],
            covariance=k.covariance[:5, :5],
            reachable=k.reachable[:5, :5],
        )
        for k in setups[:3]
    ]
    _, information, root = draw(0)
    covariance = np.linalg.inv(information)
    stacks = list(stack_setups(setups, range(len(setups))))
    assert {(s.gauge, s.jacobian.shape[:2]) for s in stacks} == {
        ("a", (3, 7)), ("b", (3, 7)), ("a", (2, 5)), ("b", (1, 5)),
    }  # fmt: skip
    found = {
        which: (gain, pair)
        for stack in stacks
        for gain, which, pair in stack.best_pairs(covariance, covariance @ root, SIGMA**2, count)
    }
    for which, setup in enumerate(setups):
        gain = gain_of(SetupGain, setup, information, root)
        expected = gain.best_pairs(Pairs.of(setup).with_count(count), 1)
        assert (which in found) == bool(expected)
        for value, pair in expected:
            assert found[which] == (pytest.approx(value, rel=1e-9), pair)


def align(setup, first):
    """Setup with its gauge aligned in the posture of one reading."""
    change = sum(np.outer(a.sensitivity, a.jacobian[first]) for a in setup.aligned)
    return replace(setup, jacobian=setup.jacobian + change, aligned=())


@pytest.mark.parametrize("seed", range(4))
def test_gains_with_the_gauge_aligned_in_the_first_posture(seed):
    """Low-rank changes give the numbers of a setup that was aligned before."""
    setup, information, root = draw(seed)
    rng = np.random.default_rng(seed)
    parameters = tuple(
        AlignedParameter(rng.normal(size=READINGS), rng.normal(size=(READINGS, STATE)))
        for _ in range(2)
    )
    setup = replace(setup, aligned=parameters, absolute=False)
    gain = gain_of(SetupGain, setup, information, root)
    found = gain.best_pairs(Pairs.of(setup).with_count(3), 3)
    assert len({first for _, (first, _) in found}) == len(found) > 0
    for value, (first, second) in found:
        before = gain_of(SetupGain, align(setup, first), information, root)
        again = gain.begin_with(first)
        assert again.spread == pytest.approx(before.spread, abs=1e-10)
        assert again.effect == pytest.approx(before.effect, abs=1e-10)
        assert again.variance == pytest.approx(before.variance, abs=1e-10)
        effect = before.effect[first] - before.effect[second]
        spread = before.spread[np.ix_([first, second], [first, second])]
        variance = spread[0, 0] + spread[1, 1] - 2.0 * spread[0, 1] + 2.0 * SIGMA**2
        assert value == pytest.approx(float(effect @ effect) / variance, rel=1e-10)
        for rows in ([first, second], [first, (second + 1) % READINGS, second]):
            (expected,) = before.gains(np.array([rows]))
            assert gain.gains(np.array([rows])) == pytest.approx(expected, rel=1e-10)
        jacobian = align(setup, first).jacobian[[first, second]]
        assert setup.jacobian_of([first, second]) == pytest.approx(jacobian, abs=1e-14)


def test_points_are_completed_greedily_from_the_best_one(drawn_points):
    gain, reduction = drawn_points
    (value, pair), (_, second) = gain.best_pairs(Pairs.of(gain.setup).with_count(2), 2)
    assert value == pytest.approx(reduction(pair), rel=1e-9)
    assert pair[0] == max(range(POINTS), key=lambda i: reduction([i]))
    assert not set(pair) & set(second)
    expected = [pair[0]]
    while len(expected) < 4:
        further = [i for i in range(POINTS) if i not in expected]
        expected.append(max(further, key=lambda i: reduction([*expected, i])))
    gains, chosen = gain.grow(pair, 4)
    assert list(chosen) == expected
    assert gains == pytest.approx([reduction(chosen[: k + 1]) for k in range(4)], rel=1e-9)
