"""Formats of numbers, lists and directions in sentences, and sentences about what to enter."""

from __future__ import annotations

import math

import numpy as np
import pytest

from orthocal.assessment.wording import (
    describe_actions,
    mm,
    name_direction,
    name_offsets,
    plain,
    review,
    signed,
    tool_mm,
    um,
)
from orthocal.assessment.words import entries as words
from orthocal.calibration.assessment_record import Place
from orthocal.text import uncapitalised


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_numbers_that_are_not_finite_are_unknown(value):
    assert {f(value) for f in (tool_mm, mm, um, plain, signed)} == {"unknown"}


def test_zero_has_no_minus():
    assert (mm(-1e-9), plain(-1e-5), signed(-1e-5)) == ("0.000", "0.000", "+0.000")
    assert (um(-1e-9), um(-21e-6), um(-19.96e-6)) == ("0.0", "-21", "-20.0")
    assert (mm(-2e-6), signed(2e-3)) == ("-0.002", "+0.002")


def test_tool_errors_have_two_digits():
    sizes = (0.0, 0.4e-6, 12.3e-6, 0.123e-3, 1.23e-3, 12.3e-3, 123e-3)
    assert [tool_mm(v) for v in sizes] == [
        "0.000 mm", "0.000 mm", "0.012 mm", "0.12 mm", "1.2 mm", "12 mm", "123 mm",
    ]  # fmt: skip


def test_findings_of_one_action_count_each():
    actions = ["Read it.", "Check it.", "Mount it.", "Clean it.", "Clean it.", "Read it."]
    findings = [review("fits", f"Finding {i}.", action) for i, action in enumerate(actions)]
    assert describe_actions(findings).splitlines()[-1].strip() == "Then 2 further findings above."
    assert describe_actions(findings[:4]).endswith("Then 1 further finding above.")


def test_names_keep_their_capitals():
    finding = review("fits", "text", "LinuxCNC must home.", (Place(setup="yx", line=3),))
    other = review("fits", "text", "Read it again.", (Place(setup="yx"), Place(setup="zx")))
    lines = describe_actions([finding, other]).splitlines()
    assert lines[1:] == [
        "  1. Setup yx, line 3: LinuxCNC must home.",
        "  2. Setups yx, zx: read it again.",
    ]
    texts = [uncapitalised(t) for t in ("URDF of it", "Of it", "A-b", "")]
    assert texts == ["URDF of it", "of it", "a-b", ""]


def test_directions_and_offsets():
    assert name_direction(np.array([0.0, -2.0, 0.0])) == "−y"
    assert name_direction(np.array([3.0, 0.0, -4.0])) == "(0.60, 0.00, −0.80)"
    assert name_direction(np.zeros(3)) == "(0.00, 0.00, 0.00)"
    assert name_offsets(["a"], firmware=False) == "the offset of a"
    assert name_offsets(["a", "b"], firmware=False) == "the offsets of a and b"
    assert name_offsets(["a_slide", "b_slide"], firmware=True) == "the endstops of towers a and b"


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
