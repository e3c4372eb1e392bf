"""The short answer: the decision first, one page at most, the same wherever it is shown."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import plans
import pytest
from folders import session_folder
from machines import write_orthoglide
from orthocal.assessment.findings.calibration import decide
from rich.console import Group

from orthocal import (
    Choice,
    Loss,
    SolverOptions,
    calibrate,
    load_plan,
    load_session,
    simulate_session,
    summarize,
)
from orthocal.output.report.page import build_report
from orthocal.output.text.answer import _suspicion, render_answer
from orthocal.output.text.layout import to_text
from orthocal.output.text.summary import render_calibration

MOST_LINES = 40

NOT_SAID = (
    *("studentised", "singular value", "O1", "ipopt", "aicc", "identifiability", "condition"),
)
"""Words of the field that a short answer does without."""

EXAMPLES = [
    *("raw-cycles", "sweep", "lines"),
    *(f"table1/experiment-{n}" for n in ("1-printed", "1-corrected", "2", "3")),
]


def machine_of_250_mm(folder):
    write_orthoglide(folder / "short", 0.25, travel=(0.15, 0.28))
    plan = plans.paper(max=20.0, min=-40.0)
    plan |= {"robot": "short", "gauge": {"sigma_mm": 0.005, "range_mm": [-20, 20]}}
    errors = {"x_slide.offset": 1e-3}
    return simulate_session(load_plan(plans.write(folder, plan)), errors, seed=1).session


@pytest.fixture(scope="module")
def answers(root, tmp_path_factory):
    """Calibrations of all examples, and of what may be the matter with them."""
    found = {n: calibrate(load_session(session_folder(root, n))) for n in EXAMPLES}
    cycles = load_session(root / "examples/raw-cycles")
    sign = np.where([r.setup == "zx" for r in cycles.readings], -1.0, 1.0)
    found["turned"] = calibrate(cycles.with_values(sign * cycles.values))
    lines = load_session(root / "tests/sessions/lines")
    sign = np.where([r.setup == "yx" for r in lines.readings], -1.0, 1.0)
    found["turned lines"] = calibrate(lines.with_values(sign * lines.values))
    slips = cycles.values.copy()
    slips[[4, 11, 20, 31, 40, 47, 52]] += 0.3e-3
    found["slips"] = calibrate(cycles.with_values(slips))
    loss = SolverOptions(loss=Loss("huber"))
    found["huber"] = calibrate(cycles.with_values(slips), solver=loss)
    found["inches"] = calibrate(cycles.with_values(np.round(cycles.values / 25.4, 7)))
    found["full"] = calibrate(load_session(root / "examples/sweep"), "full")
    found["lengths"] = calibrate(cycles, "lengths")
    found["250 mm"] = calibrate(machine_of_250_mm(tmp_path_factory.mktemp("short")))
    bare = replace(cycles, robot=replace(cycles.robot, tcp=None))
    found["no tool"] = calibrate(bare)
    found["no offset"] = calibrate(cycles, Choice(free=["x_leg.length"]))
    return found


CASES = [
    *EXAMPLES,
    *(
        "turned",
        "turned lines",
        "slips",
        "huber",
        "inches",
        "full",
        "lengths",
        "250 mm",
        "no tool",
        "no offset",
    ),
]


@pytest.mark.parametrize("name", CASES)
def test_an_answer_is_short_and_in_plain_words(answers, name):
    for width in (80, 100):
        text = to_text(render_calibration(answers[name]), width=width)
        assert len(text.splitlines()) <= MOST_LINES
        assert max(len(line) for line in text.splitlines()) <= width
        for word in NOT_SAID:
            assert word.lower() not in text.lower()
        assert "nan" not in text.split()
        assert "  \n" not in text
        assert "\n\n\n" not in text


@pytest.mark.parametrize("name", CASES)
def test_what_was_measured_comes_first_then_the_decision_and_then_the_rest(answers, name):
    calibration = answers[name]
    decision = decide(calibration)
    text = " ".join(summarize(calibration).split())
    parts = [
        "Calibration of orthoglide" if name != "250 mm" else "Calibration of machine",
        f"Machine: legs of {'250' if name == '250 mm' else '310.25'} mm, travel",
        "Measured: ",
        f"{decision.headline} {decision.reason}",
        *([f"Next: {decision.action}"] if decision.action else []),
        "--details shows",
    ]
    places = [text.index(" ".join(part.split())) for part in parts if "machine" not in part]
    assert places == sorted(places), places
    assert text.count(decision.headline) == 1


@pytest.mark.parametrize("name", CASES)
def test_nothing_grave_is_kept_back(answers, name):
    """Whatever stops or warns is said; readings that stand out are named or counted."""
    calibration = answers[name]
    decision = decide(calibration)
    text = " ".join(summarize(calibration).split())
    for finding in decision.findings:
        if finding.severity != "informs" and finding.kind != "suspicious reading":
            assert " ".join(finding.text.split()) in text
    found = decision.of_kind("suspicious reading")
    if decision.of_kind("turned setup"):
        return
    for finding in found[:5]:
        place = finding.places[0]
        assert f"line {place.line}: {place.setup} {place.posture}" in text
    assert (f"and {len(found) - 5} more" in text) == (len(found) > 5)


def test_suspicious_readings_are_named_by_file_and_line(answers, root):
    text = summarize(answers["huber"])
    rows = load_session(root / "examples/raw-cycles").readings
    lines = {int(n) for n in re.findall(r"line (\d+): ", text)}
    assert len(lines) == 5
    assert lines <= {rows[i].line for i in (4, 11, 20, 31, 40, 47, 52)}
    assert "readings.csv:" in text
    assert "Check before you enter these. 7 readings contradict all others." in text


def test_a_reading_that_the_fit_gives_way_to_does_not_contradict_itself(answers):
    first = decide(answers["huber"]).of_kind("suspicious reading")[0]
    assert "mm, expected" in _suspicion(first)
    followed = replace(
        first, numbers=first.numbers | {"expected_mm": first.numbers["measured_mm"] + 1e-5}
    )
    assert _suspicion(followed).endswith("mm; the fit gives way, all others say otherwise")


def test_a_turned_setup_accuses_no_single_reading_and_offers_nothing_to_type(answers):
    text = summarize(answers["turned lines"])
    assert answers["turned lines"].suspicious
    assert "Suspicious" not in text
    assert "x_slide" not in text
    assert "At the tool" not in text
    # all of that stands in the details
    assert "Suspicious readings" in summarize(answers["turned lines"], details=True)


@pytest.mark.parametrize("name", ["table1/experiment-2", "raw-cycles", "250 mm"])
def test_what_to_enter_has_one_spread_of_all_that_is_not_known(answers, name):
    calibration = answers[name]
    text = summarize(calibration)
    for p, std in zip(calibration.free, calibration.total_std, strict=True):
        row = next(
            t for t in text.splitlines() if t.split()[:1] == [p.name.removesuffix(".offset")]
        )
        assert row.split()[-3:] == [f"{p.value * 1e3:+.3f}", f"{std * 1e3:.3f}", "mm"]
    assert text.count("±:") == 1
    assert "one standard deviation of all that is not known" in " ".join(text.split())


def test_the_tool_is_promised_in_micrometres(answers):
    for name in ("table1/experiment-2", "full", "250 mm"):
        calibration = answers[name]
        n = decide(calibration).of_kind("at the tool")[0].numbers
        text = " ".join(summarize(calibration).split())
        assert f"At the tool expect {n['expected_um']:.0f} µm with these entered" in text or (
            f"At the tool expect {n['expected_um']:.1f} µm with these entered" in text
        )
    assert "In a controller that knows all errors: " in " ".join(summarize(answers["full"]).split())
    text = " ".join(summarize(answers["table1/experiment-2"]).split())
    assert "at 2.1 times their tolerances" in text
    text = " ".join(summarize(answers["table1/experiment-3"]).split())
    assert "At the tool expect 126 µm as it is" in text
    assert "Leave the offsets as they are" in text
    assert "no tool centre point" in " ".join(summarize(answers["no tool"]).split())


def test_long_names_and_paths_leave_it_short(answers):
    """A title, a path and setups as long as they may be."""
    calibration = answers["huber"]
    long = "a-very-long-name-" * 12
    rows = tuple(replace(r, setup=f"{r.setup}-{long[:40]}") for r in calibration.residuals)
    setups = tuple(replace(s, name=f"{s.name}-{long[:40]}") for s in calibration.setups)
    session = replace(calibration.session, title=long * 3, readings_path=f"/{long}/readings.csv")
    text = to_text(
        render_calibration(replace(calibration, session=session, residuals=rows, setups=setups)),
        width=80,
    )
    assert len(text.splitlines()) <= MOST_LINES


def test_details_and_all_hold_the_answer_and_the_rest(answers):
    for name in ("table1/experiment-2", "turned"):
        calibration = answers[name]
        answer = to_text(render_answer(calibration))
        details = summarize(calibration, details=True)
        assert details.startswith(answer)
        for title in (
            *("How it was done", "What was identified", "What the readings tell"),
            *("Readings before and after", "How well it fits", "At the tool", "What it means"),
            "What to enter into the controller",
        ):
            assert f"\n{title}\n" in details
            assert f"\n{title}\n" not in summarize(calibration)
        assert summarize(calibration, all_rows=True).startswith(answer)
        assert "ipopt: Solve_Succeeded" in details
    assert len(summarize(answers["sweep"], all_rows=True).splitlines()) > 162


def test_notebook_and_report_show_the_same_answer(answers):
    reports = {}
    for name in ("table1/experiment-2", "turned", "slips"):
        calibration = answers[name]
        decision = decide(calibration)
        notebook, reports[name] = calibration._repr_html_(), build_report(calibration)
        for page in (notebook, reports[name]):
            assert decision.headline in page
            for finding in decision.findings:
                if finding.severity == "stops":
                    assert finding.text.replace("'", "&#x27;") in page
        assert "studentised" not in notebook
    report = reports["turned"]
    # what was found stands in the long form, though it is not to be entered
    assert report.index("Do not enter these.") < report.index("<td>x_slide</td>")


def test_an_answer_without_heading_is_the_rest_of_it(answers):
    whole = to_text(Group(render_answer(answers["sweep"])))
    assert whole.endswith(to_text(render_answer(answers["sweep"], heading=False)))
