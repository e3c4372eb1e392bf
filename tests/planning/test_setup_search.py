"""Search among candidates, compared with enumeration and with least squares."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np
import pytest

from orthocal.planning.candidates import AlignedParameter, Candidates, CandidateSetup
from orthocal.planning.planned_session import order_postures
from orthocal.planning.selection import Gains, PlannedSetup, SetupSearch
from orthocal.runtime import worker_pool

SIGMA = 0.5
STATE = 4


def draw_candidates(rng, *, setups=3, readings=4, nuisance=1, aligned=0):
    """Random candidate setups, and the sensitivities of their readings to nuisance parameters."""
    candidates, sensitivities = [], []
    for k in range(setups):
        jacobian = rng.normal(size=(readings, STATE))
        of_nuisance = 0.5 * rng.normal(size=(readings, nuisance))
        h = np.sort(rng.uniform(0.0, 3.0, readings))
        reachable = np.abs(h[:, None] - h[None]) < 2.0
        covariance = of_nuisance @ of_nuisance.T
        parameters = tuple(
            AlignedParameter(rng.normal(size=readings), rng.normal(size=(readings, STATE)))
            for _ in range(aligned)
        )
        candidates.append(
            CandidateSetup(
                f"k{k}", np.arange(readings), jacobian, covariance, reachable, parameters
            )
        )
        sensitivities.append(of_nuisance)
    return Candidates(None, None, tuple(candidates), SIGMA, tuple("abcd"), 0.0), sensitivities


@dataclass
class Constant:
    """Weight that does not depend on the covariance."""

    root: np.ndarray

    def __call__(self, covariance):
        return self.root


def search_among(candidates, root):
    return SetupSearch.of(candidates, np.eye(STATE), Constant(root))


def posterior(candidates, sensitivities, setups):
    """Covariance of the state by least squares over state, nuisance parameters and zeros."""
    count = len(setups)
    width = sensitivities[0].shape[1] + 1
    rows = []
    for place, s in enumerate(setups):
        candidate = candidates.setups[s.candidate]
        for i in s.chosen:
            row = np.zeros(STATE + count * width)
            row[:STATE] = candidate.jacobian[i]
            for parameter in candidate.aligned:
                row[:STATE] += parameter.sensitivity[i] * parameter.jacobian[s.chosen[0]]
            first = STATE + place * width
            row[first : first + width] = [*sensitivities[s.candidate][i], 1.0]
            rows.append(row / SIGMA)
    design = np.array(rows)
    precision = np.ones(STATE + count * width)
    precision[STATE + width - 1 :: width] = 0.0  # gauge zeros have no prior
    return np.linalg.inv(design.T @ design + np.diag(precision))[:STATE, :STATE]


def list_setups(candidates, count):
    """All setups with this number of readings, by their first reading and the others."""
    for k, candidate in enumerate(candidates.setups):
        for first in range(len(candidate.rows)):
            others = [i for i in np.flatnonzero(candidate.reachable[first]) if i != first]
            for chosen in combinations(others, count - 1):
                yield PlannedSetup(k, (first, *(int(i) for i in chosen)))


def information(candidates, sensitivities, setup):
    """Information of one setup about the state."""
    return np.linalg.inv(posterior(candidates, sensitivities, [setup])) - np.eye(STATE)


def test_rounding_does_not_choose_between_mirrored_readings():
    """Readings with the opposite approach have equal gains."""
    rng = np.random.default_rng(5)
    candidates, _ = draw_candidates(rng, aligned=1)

    def mirror(setup):
        approach = np.repeat([1.0, -1.0], len(setup.rows))
        jacobian = np.tile(setup.jacobian, (2, 1))
        jacobian[:, -1] = approach
        return replace(
            setup,
            rows=np.arange(approach.size),
            jacobian=jacobian * (1.0 + 1e-12 * rng.normal(size=jacobian.shape)),
            covariance=np.tile(setup.covariance, (2, 2)),
            reachable=np.tile(setup.reachable, (2, 2)),
            aligned=tuple(
                AlignedParameter(np.tile(a.sensitivity, 2), np.tile(a.jacobian, (2, 1)))
                for a in setup.aligned
            ),
        )

    def choose():
        rounded = replace(candidates, setups=tuple(mirror(s) for s in candidates.setups))
        return search_among(rounded, np.eye(STATE)).choose([3, 3, 2], starts=2).setups

    first = choose()
    assert all(choose() == first for _ in range(3))


@pytest.mark.parametrize(("seed", "aligned"), [(0, 0), (1, 1)])
def test_a_plan_is_nearly_the_best_of_all(seed, aligned):
    rng = np.random.default_rng(seed)
    candidates, sensitivities = draw_candidates(rng, aligned=aligned)
    root = rng.normal(size=(STATE, 2))
    search = search_among(candidates, root)
    plan = search.choose([3, 2])
    threes, twos = (
        np.array([information(candidates, sensitivities, s) for s in list_setups(candidates, n)])
        for n in (3, 2)
    )
    covariances = np.linalg.inv(np.eye(STATE) + threes[:, None] + twos)
    best = np.sqrt(np.trace(root.T @ covariances @ root, axis1=2, axis2=3).min())
    assert best * (1.0 - 1e-9) <= plan.error < 1.01 * best
    # error and information agree with least squares
    expected = posterior(candidates, sensitivities, plan.setups)
    assert plan.error == pytest.approx(np.sqrt(np.trace(root.T @ expected @ root)), rel=1e-4)
    covariance = np.linalg.inv(np.eye(STATE) + search.information_of(*plan.setups))
    assert covariance == pytest.approx(expected, rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("forked", [True, False])
def test_the_plan_is_the_same_to_the_last_bit_by_any_number_of_processes(monkeypatch, forked):
    """All readings of a setup differ and are within the range of the gauge."""
    monkeypatch.setattr(worker_pool, "can_fork", lambda: forked)
    rng = np.random.default_rng(5)
    candidates, _ = draw_candidates(rng, setups=6, readings=8)
    root, reports = rng.normal(size=(STATE, STATE)), {1: [], 2: []}

    def choose(workers):
        return search_among(candidates, root).choose(
            [3, 4],
            seed=7,
            starts=5,
            workers=workers,
            report=lambda *words: reports[workers].append(words),
        )

    alone, together = choose(1), choose(2)
    assert together.setups == alone.setups
    assert together.error == alone.error
    assert together.information.tobytes() == alone.information.tobytes()
    assert [start for start, _ in reports[1]] == [1, 2, 3, 4, 5]
    assert reports[2] == reports[1]
    for s in alone.setups:
        assert len(set(s.chosen)) == len(s.chosen)
        assert candidates.setups[s.candidate].reachable[s.chosen[0], list(s.chosen)].all()


def test_the_rough_error_needs_a_constant_weight():
    """The weight of the worst point, for example, depends on the covariance."""
    rng = np.random.default_rng(2)
    candidates, _ = draw_candidates(rng, readings=6)
    root, prior = rng.normal(size=(STATE, 2)), np.eye(STATE)
    search = search_among(candidates, root)
    constant = Gains.of(search, prior)
    changing = Gains.of(replace(search, weight=lambda covariance: covariance @ root), prior)
    for setup in list_setups(candidates, 3):
        error = search.error_of(prior + search.information_of(setup))
        gain = constant.gain_of(search.reduced[setup.candidate])
        assert constant.rough_error(setup, gain) == pytest.approx(error, rel=1e-9)
        assert changing.rough_error(setup, gain) == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_the_path_through_postures_is_nearly_the_shortest(seed):
    points = np.random.default_rng(seed).normal(size=(7, 3))
    path = order_postures(points)
    assert path[0] == 0
    assert sorted(path) == list(range(7))

    def length(order):
        closed = points[[*order, order[0]]]
        return np.linalg.norm(np.diff(closed, axis=0), axis=1).sum()

    shortest = min(length((0, *others)) for others in permutations(range(1, 7)))
    assert length(path) < 1.1 * shortest
