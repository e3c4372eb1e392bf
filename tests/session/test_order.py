"""Order of measurement: setups one after another, closing readings last."""

from __future__ import annotations

import pytest

from orthocal.session.order import order_of_measurement
from orthocal.session.session import Conditions, Reading


def read(text):
    """Readings of words such as s:a, s:a-b for a difference, and s:a/p for an approach."""
    rows = []
    for word in text.split():
        setup, _, place = word.partition(":")
        place, _, approach = place.partition("/")
        posture, _, minus = place.partition("-")
        conditions = Conditions(approach) if approach else None
        rows.append(Reading(setup, posture, minus or None, len(rows) + 1, conditions=conditions))
    return rows


@pytest.mark.parametrize(
    ("rows", "order"),
    [
        ("s:a s:b s:c s:a", "0123"),
        ("s:a s:b s:c s:a s:d", "01243"),  # a posture that was added later
        ("s:a s:b s:c s:a t:a t:b t:a s:b s:c", "012783456"),  # repeats of a complete setup
        ("s:a s:b s:c s:a s:a", "01234"),
        ("s:a s:b s:c s:a s:a s:c", "012534"),
        ("s:a s:b s:c s:a s:b s:c", "012345"),  # cycles without a closing reading
        ("s:a s:b s:c s:a s:b s:c s:a", "0123456"),
        ("s:a s:b s:a s:c s:a s:d", "012345"),  # every other posture is the first
        ("s:a s:a s:b s:b s:c s:c", "012345"),
        ("s:a s:b s:c s:d", "0123"),
        ("s:a", "0"),
        ("s:a/p s:b s:c s:a/n s:d", "01234"),  # from the other side
        ("s:b-a s:c-a s:d-a s:a s:e-a", "01243"),
        ("s:b-a s:c-a s:b-a s:d-a", "0123"),
        ("s:a t:a s:b t:b", "0213"),
        ("p[x]:a p[y]:a p[x]:b p[y]:b p[x]:c p[y]:c p[x2]:a p[y2]:a p[x]:d p[y]:d", "0123458967"),
    ],
)
def test_the_closing_reading_is_the_last_of_its_setup(rows, order):
    assert "".join(map(str, order_of_measurement(read(rows)))) == order
