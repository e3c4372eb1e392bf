"""The short answer: the decision first, one page at most, the same wherever it is shown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import plans
import pytest
from calibrated import UNJUDGED, calibrated, session_of
from conftest import marked_plots
from machines import write_orthoglide
from rich.console import Group
from scipy.stats import t as student

from orthocal import Choice, calibrate, load_plan, simulate_session, summarize
from orthocal.assessment.controller_entries import expanded_uncertainty
from orthocal.assessment.words.entries import describe_tool_error
from orthocal.output.report import page
from orthocal.output.report.page import build_report
from orthocal.output.text.answer import (
    LISTED,
    MORE,
    MOST_LISTED,
    name_values,
    next_session,
    render_answer,
)
from orthocal.output.text.layout import to_text
from orthocal.output.text.summary import render_result
from orthocal.output.text.tables import RECOMMENDING
from orthocal.statistics.chance import coverage_factor

MOST_LINES = 40

NOT_SAID = (
    *("studentised", "singular value", "O1", "ipopt", "aicc", "identifiability", "condition"),
)
"""Words of the field that a short answer does without."""

EXAMPLES = {"raw-cycles": None, **{f"table1/experiment-{n}": None for n in ("1-printed", "2", "3")}}
"""Examples and their models; None for the model of the session, which is offsets."""


def machine_of_250_mm(folder):
    write_orthoglide(folder / "short", 0.25, travel=(0.15, 0.28))
    plan = plans.paper(max=20.0, min=-40.0)
    plan |= {"robot": "short", "gauge": {"sigma_mm": 0.005, "range_mm": [-20, 20]}}
    errors = {"x_slide.offset": 1e-3}
    return simulate_session(load_plan(plans.write(folder, plan)), errors, seed=1).session


class Answers(dict):
    """Calibrations by name, each made when it is first asked for."""

    def __init__(self, directory):
        super().__init__()
        self.directory, self.cycles = directory, session_of("raw-cycles")

    def __missing__(self, name):
        self[name] = calibrated(name, EXAMPLES[name]) if name in EXAMPLES else OTHERS[name](self)
        return self[name]


def words_of(calibration, **options):
    return " ".join(summarize(calibration, **options).split())


def reversed_sign(session, setup):
    sign = np.where([r.setup == setup for r in session.readings], -1.0, 1.0)
    return session.with_values(sign * session.values)


def outliers(session):
    values = session.values.copy()
    values[[4, 11, 20, 31, 40, 47, 52]] += 0.3e-3
    return session.with_values(values)


def without_tool(session):
    return replace(session, robot=replace(session.robot, tcp=None))


def judged(session, choice=None, **options):
    """Calibration by variable projection."""
    return calibrate(session, choice, **{"solver": "variable-projection", **options})


OTHERS = {
    "turned": lambda a: judged(reversed_sign(a.cycles, "zx")),
    "huber": lambda a: judged(outliers(a.cycles), loss="huber"),
    "full": lambda a: calibrated("sweep", "full", **UNJUDGED),
    "250 mm": lambda a: calibrate(machine_of_250_mm(a.directory), "offsets", **UNJUDGED),
    "no tool": lambda a: calibrate(without_tool(a.cycles), **UNJUDGED),
    "no offset": lambda a: calibrate(a.cycles, Choice(free=["x_leg.length"]), **UNJUDGED),
}
"""Other calibrations: mistakes in the readings, other machines and models."""

pytestmark = pytest.mark.usefixtures("without_sensor_gains")

CASES = [*EXAMPLES, *OTHERS]


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    return Answers(tmp_path_factory.mktemp("short"))


@pytest.mark.parametrize("name", CASES)
def test_an_answer_is_short_in_order_and_states_all_that_decides(answers, name):
    calibration = answers[name]
    text, details = words_of(calibration), words_of(calibration, all_rows=True)
    assert_short(calibration)
    assert_order(calibration, text, leg="250" if name == "250 mm" else "310.25")
    assert_findings(calibration.assessment, text, details)
    assert_tool_error(calibration, text, details)
    if name == "no offset":
        (note,) = calibration.assessment.of_kind("no offset")
        assert (note.severity, calibration.assessment.decision.verdict) == ("note", "enter")


def assert_short(calibration):
    """In plain words, whatever the width of the terminal."""
    for width in (80, 100):
        text = to_text(render_result(calibration), width=width)
        assert len(text.splitlines()) <= MOST_LINES
        assert max(len(line) for line in text.splitlines()) <= width
        for word in NOT_SAID:
            assert word.lower() not in text.lower()
        assert "nan" not in text.split()
        assert "  \n" not in text
        assert "\n\n\n" not in text


def assert_order(calibration, text, *, leg):
    """Subject, decision and next step."""
    found = calibration.assessment
    parts = [
        f"Calibration of {calibration.robot_record.name}, model '{calibration.model}'",
        f"Machine: legs of {leg} mm, travel",
        "Measured: ",
        f"{found.decision.headline} {found.decision.reason}",
        *(f.text for f in found.of_kind("tool error") if found.decision.verdict == "enter"),
        "Next: ",
        MORE,
    ]
    places = [text.index(" ".join(part.split())) for part in parts]
    assert places == sorted(places), places
    assert text.count(found.decision.headline) == 1
    if found.decision.verdict != "enter":
        assert f"Next: {found.decision.action}".strip() in text


def assert_findings(found, text, details):
    """Whatever decides is shown, up to the most that are listed, the gravest first."""
    grave = [f for f in found.findings if f.severity != "note"]
    for finding in grave[: MOST_LISTED + 1]:
        assert " ".join(finding.text.split()) in text
    order = {"reject": 0, "review": 1, "note": 2}
    ranks = [order[f.severity] for f in found.findings]
    assert ranks == sorted(ranks)
    omitted = () if found.decision.verdict == "enter" else RECOMMENDING
    listed = [f for f in found.findings if f.kind not in omitted]
    assert all(" ".join(f.text.split()) in details for f in listed)


def assert_tool_error(calibration, text, details):
    """In one sentence everywhere: the short answer, the section of the tool and the findings."""
    found = calibration.assessment
    if found.tool is None:
        assert found.decision.verdict == "enter"
        assert found.of_kind("out of reach")[0].text in text
        return
    sentence = describe_tool_error(found.tool, keep=found.keeps_offsets)
    (stated,) = found.of_kind("tool error")
    assert stated.text == sentence
    assert stated.numbers["entered_um"] == pytest.approx(found.tool.entered * 1e6)
    shown = found.decision.verdict == "enter"
    assert text.count(sentence) == shown
    assert details.count(sentence) == 3 * shown
    assert ("With all identified errors corrected: " in text) == (
        shown and not calibration.only_offsets
    )


@pytest.mark.parametrize("name", ["table1/experiment-2", "raw-cycles"])
def test_values_to_enter_have_their_expanded_uncertainty(answers, name):
    calibration = answers[name]
    lines = [line.split() for line in summarize(calibration).splitlines()]
    for e in calibration.assessment.entries:
        half = expanded_uncertainty(calibration, e)
        assert half >= (2.0 - 1e-12) * e.std
        (row,) = [cells for cells in lines if cells[:1] == [e.drive]]
        assert row[-3:] == [f"{e.enter * 1e3:+.3f}", f"{half * 1e3:.3f}", "mm"]


@pytest.mark.parametrize(
    ("name", "verdict"), [("table1/experiment-1-printed", "reject"), ("turned", "review")]
)
def test_doubtful_readings_offer_nothing_to_enter(answers, name, verdict):
    """Neither values nor the tool error with them; the details list values, not to be entered."""
    calibration = answers[name]
    assert calibration.assessment.decision.verdict == verdict
    short, details = summarize(calibration), summarize(calibration, details=True)
    assert "x_slide" not in short.split()
    assert "Values to enter" not in details
    assert "x_slide" in details.partition("\nValues (do not enter them)\n")[2].split()
    (tool,) = calibration.assessment.of_kind("tool error")
    assert not any(tool.text in text for text in (short, details))


def test_the_scale_of_the_tolerances_is_listed(answers):
    calibration = answers["table1/experiment-2"]
    (found,) = calibration.assessment.of_kind("above tolerances")
    assert found.numbers["tolerance_scale"] == calibration.tolerance_scale.factor > 1.0
    assert found.kind in LISTED
    assert " ".join(found.text.split()) in words_of(calibration)


def test_long_names_and_paths_leave_it_short(answers):
    """A title, a path and setups as long as they may be."""
    calibration = answers["huber"]
    long = "a-very-long-name-" * 12
    rows = tuple(replace(r, setup=f"{r.setup}-{long[:40]}") for r in calibration.residuals)
    setups = tuple(replace(s, name=f"{s.name}-{long[:40]}") for s in calibration.setups)
    session = replace(calibration.session, title=long * 3, readings_path=f"/{long}/readings.csv")
    text = to_text(
        render_result(replace(calibration, session=session, residuals=rows, setups=setups)),
        width=80,
    )
    assert len(text.splitlines()) <= MOST_LINES


def test_details_and_all_hold_the_answer_and_the_rest(answers):
    for name in ("table1/experiment-2", "turned"):
        calibration = answers[name]
        answer = to_text(render_answer(calibration))
        short, details = summarize(calibration), summarize(calibration, details=True)
        assert details.startswith(answer)
        for title in (
            *("Method", "Parameters", "Readings", "Residuals", "Tool error"),
            *("Findings", name_values(calibration), "For research"),
        ):
            assert f"\n{title}\n" in details
            assert f"\n{title}\n" not in short
        assert summarize(calibration, all_rows=True).startswith(answer)
        assert f"Solver: {calibration.solver.name}, {calibration.solver.status}" in details
    assert len(summarize(answers["full"], all_rows=True).splitlines()) > 162


def test_notebook_and_report_show_the_same_answer(answers):
    with marked_plots(), patch.object(page, "_scene", lambda _: ""):
        report = build_report(answers["turned"])
    for name in ("table1/experiment-2", "turned"):
        found, notebook = answers[name].assessment, answers[name]._repr_html_()
        for shown in (notebook, report) if name == "turned" else (notebook,):
            assert found.decision.headline in shown
            for finding in found.findings:
                stated = found.decision.verdict == "enter" and finding.kind == "tool error"
                if finding.severity != "note" or stated:
                    assert finding.text.replace("'", "&#x27;") in shown
        assert "studentised" not in notebook
    headline = answers["turned"].assessment.decision.headline
    assert report.index(headline) < report.index("<td>x_slide</td>")


def test_an_answer_without_heading_is_the_rest_of_it(answers):
    whole = to_text(Group(render_answer(answers["raw-cycles"])))
    assert whole.endswith(to_text(render_answer(answers["raw-cycles"], heading=False)))


@pytest.mark.parametrize(
    ("session", "new"), [("mill/first", "mill/second"), ("mill/other", "mill/other-again")]
)
def test_the_next_session_is_named_after_the_last_one(answers, session, new):
    calibration = answers["full"]
    record = replace(calibration.session, path=f"{session}/session.yaml")
    named = replace(calibration, session=record)
    saved = Path("mill/first-calibration")
    assert next_session(named, saved) == Path(new)
    unknown = replace(calibration, session=replace(record, path=None))
    assert next_session(unknown, saved) == Path("mill/first-calibration-again")


def test_few_contrasts_widen_the_scaled_errors(answers):
    """Six differences and three offsets: Student's factor, 3.18 of three contrasts, for the scaled
    tolerances."""
    calibration = answers["table1/experiment-2"]
    factor = coverage_factor(calibration.tolerance_scale.contrasts)
    assert factor == pytest.approx(student.ppf(0.975, calibration.tolerance_scale.contrasts))
    for e in calibration.assessment.entries:
        expected = np.sqrt(4.0 * (e.std**2 - e.std_scaled**2) + factor**2 * e.std_scaled**2)
        assert expanded_uncertainty(calibration, e) == pytest.approx(expected, rel=1e-9)
