"""Search over pairs against brute force."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from orthocal.hypotheses.likelihood import build_likelihood
from orthocal.hypotheses.pairs import Singles, find_pairs

N, ROWS = 9, 20


@pytest.fixture(scope="module")
def case():
    """Twenty hypotheses: twelve edits, six effects, two edits with an effect."""
    rng = np.random.default_rng(2)
    likelihood, _, _ = build_likelihood(rng.normal(size=(N, 4)), sigma=0.3, dof=N, stated=True)
    edits = rng.normal(size=(ROWS, N))
    effects = rng.normal(size=(ROWS, N))
    edits[14:], effects[:12] = 0.0, 0.0
    order = rng.permutation(ROWS)
    touched = np.zeros((ROWS, N), dtype=bool)
    touched[np.arange(ROWS), np.arange(ROWS) % N] = True
    singles = Singles(edits[order], effects[order], rng.normal(size=ROWS), touched)
    return likelihood, 2.0 * rng.normal(size=N), singles


def brute_force(likelihood, deviation, singles):
    found = {}
    for a, b in combinations(range(ROWS), 2):
        if (singles.touched[a] & singles.touched[b]).any():
            continue
        effects = [w for w in (singles.effects[a], singles.effects[b]) if w.any()]
        changed = deviation + singles.edits[a] + singles.edits[b]
        groups = [np.array(effects)] if effects else []
        score = likelihood.score_set(changed, groups).log_likelihood
        found[a, b] = score + singles.prior[a] + singles.prior[b]
    return found


def test_all_pairs_have_the_evidence_of_brute_force(case):
    found = find_pairs(*case)
    expected = brute_force(*case)
    assert len(found.members) == len(expected)
    for members, log in zip(found.members, found.log_posterior, strict=True):
        a, b = sorted(members.tolist())
        assert log == pytest.approx(expected[a, b])
    assert (np.diff(found.log_posterior) <= 0.0).all()


def test_a_bound_leaves_out_only_unlikely_pairs(case):
    every = find_pairs(*case)
    least = float(every.log_posterior[20])
    some = find_pairs(*case, least=least)
    kept = every.log_posterior > least + 4.0
    assert {tuple(sorted(m)) for m in every.members[kept].tolist()} <= {
        tuple(sorted(m)) for m in some.members.tolist()
    }
    assert len(some.members) < len(every.members)
