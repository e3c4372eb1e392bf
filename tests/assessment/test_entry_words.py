"""Sentences about what to enter, for one and for several readings or drives."""

from __future__ import annotations

import pytest

from orthocal.assessment.words import entries as words

ONE, TWO = ("x_slide",), ("x_slide", "y_slide")


@pytest.mark.parametrize(
    ("readings", "within", "text"),
    [
        (1, True, "The reading agrees with a machine within its tolerances."),
        (1, False, "There is no second reading to compare the reading with."),
        (2, True, "The 2 readings agree with each other and with a machine within its tolerances."),
        (2, False, "The 2 readings agree with each other."),
    ],
)
def test_a_single_reading_agrees_with_no_other(readings, within, text):
    assert words.no_anomaly(readings, within_tolerances=within).text == text


def test_drives_and_verbs_have_one_number():
    assert words.must_change(ONE).text == "x_slide changes by more than its uncertainty."
    assert words.not_significant(TWO, keep=False).text == (
        "x_slide and y_slide change by less than their uncertainty. "
        "Enter all offsets together: the tool error depends on all of them."
    )
    assert words.not_significant(ONE, keep=True).text == (
        "x_slide changes by less than its uncertainty."
    )


@pytest.mark.parametrize("drives", [ONE, TWO])
def test_changes_are_added_unless_the_offsets_stay(drives):
    assert words.controller_not_stated(drives, keep=False).action
    assert not words.controller_not_stated(drives, keep=True).action
    assert "last session, bar," in words.controller_not_stated(drives, keep=True, last="bar").text
