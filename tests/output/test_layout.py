"""Tables in narrow terminals: words break, numbers never."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from calibrated import EXPERIMENT_2, calibrated

from orthocal import SolverOptions, load_session, validate_calibration
from orthocal.assessment.comparison import compare_models
from orthocal.output.text.layout import table_of, to_text
from orthocal.output.text.summary import render_result

FAST = SolverOptions("variable-projection")
NUMBER = re.compile(r"[-+−]?\d+(?:\.\d+)?")


@pytest.fixture(scope="module")
def results(root, experiment_2):
    calibration = calibrated(EXPERIMENT_2)
    afterwards = load_session(root / "examples/table1/experiment-3")
    unstated = replace(afterwards, controller_offsets=None)
    return {
        "offsets": calibration,
        "validation": validate_calibration(calibration, unstated),
        "comparison": compare_models(experiment_2, models=["offsets", "lengths"], options=FAST),
    }


@pytest.mark.parametrize("details", [True, False], ids=["details", "answer"])
@pytest.mark.parametrize("name", ["offsets", "validation", "comparison"])
def test_no_number_is_cut_however_narrow_it_gets(name, details, results):
    content = render_result(results[name], details=details, all_rows=details)
    numbers = set(NUMBER.findall(to_text(content, width=400)))
    assert numbers
    for width in (40, 80):
        narrow = to_text(content, width=width)
        assert max(len(line) for line in narrow.splitlines()) <= width
        assert not re.search(r"\d…|\.…", narrow)
        assert numbers - set(NUMBER.findall(narrow)) == set(), width


def test_a_wide_table_is_printed_row_by_row():
    row = ("x_slide.offset", "-0.527", "-1.759 … +0.705", "mm")
    table = table_of(("parameter", "exact", "interval", "unit"), [row])
    assert to_text(table, width=60).splitlines()[-1].split()[0] == "x_slide.offset"
    assert to_text(table, width=30).splitlines() == [
        "x_slide.offset",
        "  exact: -0.527",
        "  interval: -1.759 … +0.705",
        "  unit: mm",
    ]


def test_words_are_cut_only_where_the_table_does_not_fit_otherwise():
    row = ("frame.x_rod_b_tip.x", "ball on the leg", "+0.003")
    table = table_of(("parameter", "gauge", "value [mm]"), [row], left=2)
    for width, is_whole in ((80, True), (40, True), (36, True), (35, False)):
        text = to_text(table, width=width)
        assert max(map(len, text.splitlines())) <= width
        assert set(row[1].split()) <= set(text.split())
        assert (row[0] in text.split()) == is_whole, width
