"""Search over pairs against brute force."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from orthocal.hypotheses.likelihood import build_likelihood
from orthocal.hypotheses.pairs import Singles, find_pairs

N, ROWS, EDITS = 9, 20, 14


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(2)
    likelihood = build_likelihood(rng.normal(size=(N, 4)), sigma=0.3, dof=N, stated=True)
    changed_rows = np.zeros((ROWS, N), dtype=bool)
    changed_rows[np.arange(ROWS), np.arange(ROWS) % N] = True
    singles = Singles(
        rng.normal(size=(EDITS, N)),
        rng.normal(size=(ROWS - EDITS, N)),
        rng.normal(size=ROWS),
        changed_rows,
    )
    return likelihood, 2.0 * rng.normal(size=N), singles


def brute_force(likelihood, deviation, singles):
    found = {}
    for a, b in combinations(range(ROWS), 2):
        if (singles.changed_rows[a] & singles.changed_rows[b]).any():
            continue
        changed = deviation + sum(singles.edits[m] for m in (a, b) if m < EDITS)
        effects = [singles.effects[m - EDITS] for m in (a, b) if m >= EDITS]
        score = likelihood.score_set(changed, [np.array(effects)] if effects else [])
        found[a, b] = score.log_likelihood + singles.prior[a] + singles.prior[b]
    return found


def test_all_pairs_have_the_evidence_of_brute_force(case):
    found = find_pairs(*case)
    expected = brute_force(*case)
    assert len(found.members) == len(expected)
    for members, log in zip(found.members, found.log_posterior, strict=True):
        a, b = sorted(members.tolist())
        assert log == pytest.approx(expected[a, b])
    assert (np.diff(found.log_posterior) <= 0.0).all()


def test_a_bound_omits_only_unlikely_pairs(case):
    every = find_pairs(*case)
    least = float(every.log_posterior[20])
    some = find_pairs(*case, min_log=least)
    kept = every.log_posterior > least + 4.0
    assert {tuple(sorted(m)) for m in every.members[kept].tolist()} <= {
        tuple(sorted(m)) for m in some.members.tolist()
    }
    assert len(some.members) < len(every.members)
