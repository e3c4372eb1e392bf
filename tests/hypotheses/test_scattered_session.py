"""Readings of which many are wrong: they do not repeat, without a single evident mistake."""

from __future__ import annotations

import numpy as np
import pytest

from orthocal import check_session


def shuffle_cycle(session, cycle, seed):
    """The readings of a cycle, each in another row of it."""
    values = session.values
    rows = np.array([i for i, r in enumerate(session.readings) if r.cycle == cycle])
    values[rows] = values[np.random.default_rng(seed).permutation(rows)]
    return session.with_values(values)


def test_readings_that_do_not_repeat_are_found(raw_cycles):
    assessment = check_session(shuffle_cycle(raw_cycles, 2, 3))
    (finding,) = assessment.of_kind("scattered repeats")
    assert finding.severity == "review"
    assert finding.text.startswith("Repeated readings scatter by 0.")
    assert finding.places
    numbers = finding.numbers
    assert numbers["scatter_mm"] > 10.0 * numbers["gauge_mm"]
    assert numbers["gauge_mm"] == pytest.approx(np.hypot(0.01, 0.01 / 12**0.5), rel=1e-12)
