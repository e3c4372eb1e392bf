"""Sentences about what to enter, for one and for several readings or drives."""

from __future__ import annotations

import pytest

from orthocal.assessment.words import entries as words

ONE, TWO = ("x_slide",), ("x_slide", "y_slide")


@pytest.mark.parametrize("drives", [ONE, TWO])
def test_changes_are_added_unless_the_offsets_stay(drives):
    assert words.controller_not_stated(drives, keep=False).action
    assert not words.controller_not_stated(drives, keep=True).action
    assert "last session, bar," in words.controller_not_stated(drives, keep=True, last="bar").text
