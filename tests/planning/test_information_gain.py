"""Gains of readings, against posterior covariances."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from orthocal.planning.candidates import AlignedParameter, CandidateSetup
from orthocal.planning.information_gain import Pairs, PointGain, SetupGain

SIGMA, STATE, READINGS = 0.5, 5, 7


def draw(seed):
    """A kind of setup, what others say of the state, and what the state does."""
    rng = np.random.default_rng(seed)
    slopes, own = rng.normal(size=(READINGS, STATE)), rng.normal(size=(READINGS, 2))
    h = rng.uniform(0.0, 3.0, READINGS)
    together = np.abs(h[:, None] - h[None]) < 1.2
    spread = own @ own.T + 1.0
    kind = CandidateSetup("k", np.arange(READINGS), slopes, spread, together)
    says = rng.normal(size=(STATE, STATE))
    return kind, says @ says.T + np.eye(STATE), rng.normal(size=(STATE, 2))


def left(kind, information, root, rows):
    """tr(T C) with these readings, by the inverse of all that is said."""
    rows = list(rows)
    spread = kind.covariance[np.ix_(rows, rows)] + SIGMA**2 * np.eye(len(rows))
    slopes = kind.jacobian[rows]
    whole = information + slopes.T @ np.linalg.inv(spread) @ slopes
    return np.trace(root.T @ np.linalg.inv(whole) @ root)


@pytest.fixture(params=range(6))
def drawn(request):
    kind, information, root = draw(request.param)
    taking = SetupGain.of(
        kind, np.linalg.inv(information), np.linalg.inv(information) @ root, SIGMA
    )
    return kind, information, root, taking


def test_a_gain_is_the_reduction_of_the_error(drawn):
    kind, information, root, taking = drawn
    for rows in ([2], [0, 3], [1, 4, 6, 2]):
        taken = left(kind, information, root, []) - left(kind, information, root, rows)
        assert taking.gains(np.array([rows])) == pytest.approx(taken, rel=1e-9)


def test_the_gain_of_a_reading_in_place_of_another(drawn):
    kind, information, root, taking = drawn
    rows = [5, 1, 3]
    gains = taking.exchange_gains(rows)
    for place in range(len(rows)):
        others = rows[:place] + rows[place + 1 :]
        for more in set(range(READINGS)) - set(others):
            both = (
                left(kind, information, root, others),
                left(kind, information, root, [*others, more]),
            )
            assert gains[place, more] == pytest.approx(both[0] - both[1], rel=1e-9)


def test_the_best_pair_of_an_absolute_setup(drawn):
    kind, *_, taking = drawn
    taking = replace(taking, setup=replace(kind, absolute=True))
    pairs = Pairs.of(taking.setup).with_count(2)
    gains = taking.gains(np.column_stack([pairs.first, pairs.second]))
    (gain, pair), *_ = taking.best_pairs(pairs, 1)
    assert gain == pytest.approx(gains.max(), rel=1e-9)
    assert taking.gains(np.array([pair])) == pytest.approx(gain, rel=1e-9)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_readings_are_completed_greedily(drawn, count):
    kind, information, root, taking = drawn
    for _, pair in taking.best_pairs(Pairs.of(kind).with_count(count), 3):
        gain, chosen = taking.complete(pair, count)
        expected = list(pair)
        while len(expected) < count:
            rest = [r for r in np.flatnonzero(kind.reachable[pair[0]]) if r not in expected]
            expected.append(min(rest, key=lambda r: left(kind, information, root, [*expected, r])))
        assert list(chosen) == expected
        taken = left(kind, information, root, []) - left(kind, information, root, chosen)
        assert gain == pytest.approx(taken, rel=1e-9)


@pytest.mark.parametrize("count", [2, 4, 6])
def test_best_pairs_have_the_largest_gains_and_share_no_reading(drawn, count):
    """Two readings beside a zero of which nothing is known are worth their difference."""
    kind, _, _, taking = drawn

    def worth(pair):
        i, j = pair
        across = taking.effect[i] - taking.effect[j]
        spread = taking.spread
        scatter = spread[i, i] + spread[j, j] - 2.0 * spread[i, j] + 2.0 * SIGMA**2
        return float(across @ across) / scatter

    left = [
        p
        for p in permutations(range(READINGS), 2)
        if kind.reachable[p] and kind.reachable[p[0]].sum() >= count
    ]
    found = taking.best_pairs(Pairs.of(kind).with_count(count), 3)
    for gain, pair in found:
        assert gain == pytest.approx(max(map(worth, left)), rel=1e-12)
        assert pair in left
        left = [p for p in left if not set(p) & set(pair)]
    assert len(found) == 3 or not left


def begin(kind, first):
    """The setup with its gauge aligned in the posture of one reading."""
    moved = sum(np.outer(a.sensitivity, a.jacobian[first]) for a in kind.aligned)
    return replace(kind, jacobian=kind.jacobian + moved, aligned=())


@pytest.mark.parametrize("seed", range(6))
def test_gains_with_the_gauge_aligned_in_the_first_posture(seed):
    """What a hand sets by the machine is elsewhere with each beginning: low rank against anew."""
    kind, information, root = draw(seed)
    rng = np.random.default_rng(seed)
    by_hand = tuple(
        AlignedParameter(rng.normal(size=READINGS), rng.normal(size=(READINGS, STATE)))
        for _ in range(2)
    )
    kind, covariance = replace(kind, aligned=by_hand), np.linalg.inv(information)
    found = SetupGain.of(kind, covariance, covariance @ root, SIGMA).best_pairs(
        Pairs.of(kind).with_count(3), 3
    )
    assert len({first for _, (first, _) in found}) == len(found) > 0
    for gain, (first, second) in found:
        begun = SetupGain.of(begin(kind, first), covariance, covariance @ root, SIGMA)
        again = SetupGain.of(kind, covariance, covariance @ root, SIGMA).begin_with(first)
        assert again.spread == pytest.approx(begun.spread, abs=1e-10)
        assert again.effect == pytest.approx(begun.effect, abs=1e-10)
        assert again.variance == pytest.approx(begun.variance, abs=1e-10)
        across = begun.effect[first] - begun.effect[second]
        ends = begun.spread[[first, second]][:, [first, second]]
        scatter = ends[0, 0] + ends[1, 1] - 2.0 * ends[0, 1] + 2.0 * SIGMA**2
        assert gain == pytest.approx(float(across @ across) / scatter, rel=1e-10)
        for rows in ([first, second], [first, (second + 1) % READINGS, second]):
            (exact,) = begun.gains(np.array([rows]))
            (whole,) = SetupGain.of(kind, covariance, covariance @ root, SIGMA).gains(
                np.array([rows])
            )
            assert whole == pytest.approx(exact, rel=1e-10)
        alone = begin(kind, first).jacobian[[first, second]]
        assert kind.jacobian_of([first, second]) == pytest.approx(alone, abs=1e-14)


POINTS, WIDE = 6, 3


def draw_points(seed):
    """A setup of points, each of three numbers, what others say of the state, what it does."""
    rng = np.random.default_rng(seed)
    rows = POINTS * WIDE
    slopes, own = rng.normal(size=(rows, STATE)), rng.normal(size=(rows, 2))
    together = np.ones((POINTS, POINTS), dtype=bool)
    setup = CandidateSetup("k", np.arange(0, rows, WIDE), slopes, own @ own.T, together, width=WIDE)
    says = rng.normal(size=(STATE, STATE))
    return setup, says @ says.T + np.eye(STATE), rng.normal(size=(STATE, 2))


@pytest.fixture(params=range(4))
def drawn_points(request):
    setup, information, root = draw_points(request.param)
    covariance = np.linalg.inv(information)
    gain = PointGain.of(setup, covariance, covariance @ root, SIGMA)

    def reduction(points):
        rows = [WIDE * i + c for i in points for c in range(WIDE)]
        return left(setup, information, root, []) - left(setup, information, root, rows)

    return gain, reduction


def test_the_gain_of_points_is_the_reduction_of_the_error(drawn_points):
    gain, reduction = drawn_points
    for points in ([2], [0, 3], [5, 1, 4, 2]):
        assert gain.gains(np.array([points])) == pytest.approx(reduction(points), rel=1e-9)


def test_the_gain_of_a_point_in_place_of_another(drawn_points):
    gain, reduction = drawn_points
    points = [5, 1, 3]
    gains = gain.exchange_gains(points)
    for place in range(len(points)):
        others = points[:place] + points[place + 1 :]
        for more in set(range(POINTS)) - set(others):
            expected = reduction([*others, more]) - reduction(others)
            assert gains[place, more] == pytest.approx(expected, rel=1e-9)


def test_points_are_completed_greedily_from_the_best_one(drawn_points):
    gain, reduction = drawn_points
    pairs = gain.best_pairs(Pairs.of(gain.setup).with_count(2), 2)
    (value, pair), (_, second) = pairs
    assert value == pytest.approx(reduction(pair), rel=1e-9)
    assert pair[0] == max(range(POINTS), key=lambda i: reduction([i]))
    assert not set(pair) & set(second)
    expected = [pair[0]]
    while len(expected) < 4:
        rest = [i for i in range(POINTS) if i not in expected]
        expected.append(max(rest, key=lambda i: reduction([*expected, i])))
    gains, chosen = gain.grow(pair, 4)
    assert list(chosen) == expected
    assert gains == pytest.approx([reduction(chosen[: k + 1]) for k in range(4)], rel=1e-9)


def test_points_of_one_number_are_readings():
    """A block of width one, with a known gauge zero, is the reading of `SetupGain`."""
    setup, information, root = draw_points(0)
    single = replace(setup, rows=np.arange(POINTS), jacobian=setup.jacobian[::WIDE], width=1,
                     covariance=setup.covariance[::WIDE, ::WIDE], absolute=True)  # fmt: skip
    covariance = np.linalg.inv(information)
    both = [
        kind.of(single, covariance, covariance @ root, SIGMA) for kind in (PointGain, SetupGain)
    ]
    one, other = (gain.exchange_gains([4, 0, 2]) for gain in both)
    np.testing.assert_allclose(one, other, rtol=1e-9)
    one, other = (gain.grow((1, 3), 5) for gain in both)
    assert one[1] == other[1]
    assert one[0] == pytest.approx(other[0], rel=1e-9)
