"""Judgement of readings: one verdict for the same readings by every command and model."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from calibrated import UNJUDGED, identified, session_of
from commands import run_orthocal
from effect_plans import FEW, sided_plan
from gauges import with_gauges

import orthocal
from orthocal import (
    Choice,
    Gauge,
    SolverOptions,
    calibrate,
    check_session,
    compare_models,
    load_calibration,
    simulate_session,
    write_calibration,
    write_session,
)
from orthocal.assessment import judgement as judgement_module
from orthocal.assessment.fit_findings import find_fit_findings
from orthocal.assessment.judgement import judge_session
from orthocal.assessment.wording import describe_actions, parameter_places, review
from orthocal.calibration.assessment_record import EXIT_CODES, Finding, FindingKind, Place, Severity
from orthocal.hypotheses.hypothesis import Rows
from orthocal.measurement.files.readings_checks import describe_missing
from orthocal.measurement.joining import join_sessions
from orthocal.observation.gauge_noise import noise_floor
from orthocal.output.text.answer import render_decision
from orthocal.output.text.layout import to_text
from orthocal.output.text.summary import result_json
from orthocal.session.session import Conditions
from orthocal.units import DRIVE_UNITS, EDGE_UNITS

pytestmark = pytest.mark.usefixtures("module_of_few_tool_points")

QUICK = {"solver": "variable-projection"}

UNITS = ("_um", *(f"_{unit}" for unit, _ in (*EDGE_UNITS.values(), *DRIVE_UNITS.values())))

PURE = {
    *("cycle", "finer", "ratio", "tolerance_scale", "log_posterior_odds", "log_evidence"),
    "log_evidence_against_chosen",
    *("independent_readings", "parameters", "chance", "part_of_std", "readings", "missing"),
    *("largest_change_over_std",),
}
"""Numbers of findings without a unit."""


@pytest.fixture(scope="module")
def cycles():
    return session_of("raw-cycles")


@pytest.fixture(scope="module")
def workshop():
    return session_of("workshop")


@pytest.fixture(scope="module")
def table1():
    return {n: session_of(f"table1/experiment-{n}") for n in ("1-printed", "2", "3")}


def change(session, row, value):
    values = session.values.copy()
    values[row] = value
    return session.with_values(values)


def displace(session, by, setup=None):
    """Session in which the gauge of a setup is displaced, or those of all setups drift."""
    values = session.values
    for name, rows in Rows(session).setups.items():
        if setup is None:
            values[rows] += by * np.linspace(0.0, 1.0, len(rows))
        elif name == setup:
            values[rows[len(rows) // 2 :]] += by
    return session.with_values(values)


VERDICTS = {"sound": "enter", "backlash in the model": "enter", "experiment 1 as printed": "reject"}
VERDICTS |= dict.fromkeys(
    ("inches", "resolution", "displaced gauge", "drift", "backlash"), "review"
)
"""Verdict of each case."""


@pytest.fixture(scope="module")
def cases(cycles, table1):
    cycles = cycles.select([r for r in cycles.readings if r.cycle <= 2])
    largest = int(np.abs(cycles.values).argmax())
    errors = {"y_slide.backlash": 50e-6, "x_slide.offset": 0.1e-3}
    backlash = simulate_session(sided_plan(FEW), errors, seed=4).session
    coarse = replace(cycles.gauge, resolution=10e-3)
    return {
        "sound": table1["2"],
        "experiment 1 as printed": table1["1-printed"],
        "reversed sign": change(cycles, largest, -cycles.values[largest]),
        "inches": cycles.with_values(np.round(cycles.values / 25.4, 7)),
        "resolution": cycles.with_gauge(coarse),
        "displaced gauge": displace(cycles, 0.2e-3, "yx"),
        "drift": displace(cycles, 0.1e-3),
        "backlash": backlash.with_effects([]),  # the model lacks it
        "backlash in the model": backlash,
    }


@pytest.mark.parametrize("case", ["sound", "experiment 1 as printed"])
def test_every_command_has_the_same_verdict(cases, case, judged, tmp_path):
    session, expected = cases[case], VERDICTS[case]
    write_session(session, tmp_path / "session")
    code = EXIT_CODES[expected]
    for command in (
        ("check", "session"),
        ("compare", "session", "--models", "offsets"),
        ("calibrate", "session"),
    ):
        done = run_orthocal(tmp_path, *command, "--json")
        decision = json.loads(done.stdout)["decision"]
        assert (decision["verdict"], decision["exit_code"]) == (expected, code)
        assert done.returncode == code
    assert len(judged) == 3
    (tmp_path / "calibration.json").write_text(done.stdout)
    words = ["export", "calibration.json", "--to", "yaml", "--out", "out"]
    assert run_orthocal(tmp_path, *words).returncode == code
    assert (tmp_path / "out").exists() == (expected == "enter")
    if expected != "enter":
        assert run_orthocal(tmp_path, *words, "--anyway").returncode == 0


@pytest.mark.parametrize("case", [c for c in VERDICTS if c != "sound"])
def test_a_case_has_its_verdict(cases, case):
    checked = check_session(cases[case])
    assert checked.decision.verdict == VERDICTS[case]
    require_known_findings(checked.to_document()["findings"])


def test_the_judgement_does_not_depend_on_the_model(cases, tmp_path):
    session = cases["reversed sign"]
    checked = check_session(session)
    assert checked.decision.verdict == "review"
    calibration = calibrate(session, "offsets", **QUICK)
    assert of_readings(calibration.assessment) == of_readings(checked)
    assert calibration.assessment.decision.verdict == "review"
    require_known_findings(json.loads(result_json(calibration))["findings"])
    loaded = load_calibration(write_calibration(calibration, tmp_path / "calibration.json"))
    assert loaded.assessment.to_document() == calibration.assessment.to_document()


def of_readings(assessment):
    return [f.to_document() for f in assessment.findings if f.severity != "note"]


def require_known_findings(findings):
    """Refuse unknown kinds, numbers without unit, and places without content."""
    for finding in findings:
        assert finding["kind"] in get_args(FindingKind)
        assert finding["severity"] in get_args(Severity)
        assert finding["text"].endswith((".", "?"))
        for name in finding["numbers"]:
            assert name in PURE or name.endswith(UNITS), name
        for place in finding["places"]:
            assert any(v is not None for v in place.values())


def test_the_readings_of_an_unfinished_session_are_judged(cycles, root, tmp_path):
    """`check` counts the missing ones; `calibrate` refuses and names their lines."""
    signs = np.array([-1.0 if r.setup == "yx" else 1.0 for r in cycles.readings])
    wrong = cycles.with_values(signs * cycles.values)
    read = [i for i, r in enumerate(wrong.readings) if r.setup in ("yx", "xy") or r.cycle == 1]
    missing = sorted(set(range(len(wrong.readings))) - set(read))
    rows = [
        replace(r, value=r.value if i in read else math.nan) for i, r in enumerate(wrong.readings)
    ]
    expected = check_session(wrong.select([wrong.readings[i] for i in read]))
    found = check_session(replace(wrong, readings=tuple(rows)))
    (count,) = found.of_kind("readings missing")
    assert count.numbers == {"readings": len(rows), "missing": len(missing)}
    assert [p.line for p in count.places] == [i + 2 for i in missing][: len(count.places)]
    other = [f.to_document() for f in found.findings if f is not count]
    assert other == [f.to_document() for f in expected.findings]
    assert found.decision.verdict == expected.decision.verdict == "review"

    path = tmp_path / "readings.csv"
    shutil.copytree(root / "examples/raw-cycles", tmp_path, dirs_exist_ok=True)
    lines = path.read_text().splitlines()
    for line in (5, 7, 8, 9):
        lines[line - 1] = lines[line - 1].rpartition(",")[0] + ","
    path.write_text("\n".join(lines) + "\n")
    done = run_orthocal(tmp_path, "check", ".")
    assert (done.returncode, done.stderr) == (0, "")
    assert "4 of 54 readings are missing (lines 5, 7 to 9)." in done.stdout
    done = run_orthocal(tmp_path, "calibrate", ".")
    assert (done.returncode, done.stdout) == (2, "")
    assert "readings.csv: 4 of 54 readings are missing (lines 5, 7 to 9); " in done.stderr
    path.write_text("\n".join([lines[0], *(x.rpartition(",")[0] + "," for x in lines[1:])]) + "\n")
    done = run_orthocal(tmp_path, "check", ".")
    assert (done.returncode, done.stdout) == (2, "")
    assert "no reading is entered yet" in done.stderr


def test_missing_readings_of_joined_sessions_have_lines_of_their_files(experiment_2):
    def unread(label, *rows):
        file = Path(label) / "readings.csv"
        readings = [replace(r, line=i + 2) for i, r in enumerate(experiment_2.readings)]
        for i in rows:
            readings[i] = replace(readings[i], value=math.nan)
        return replace(experiment_2, readings=tuple(readings), readings_path=file)

    session = join_sessions([unread("a", 3), unread("b", 1, 3)])
    places = "a/readings.csv: line 5; b/readings.csv: lines 3, 5"
    assert describe_missing(session) == f"3 of 12 readings are missing ({places})"


def test_a_step_in_a_list_names_all_drives_and_repeats_the_condition():
    """The text of the finding is not before it."""
    drives = parameter_places("x_slide", "z_slide")
    findings = [
        review("not entered", "Not entered.", "Enter them.", drives),
        review("swapped rows", "Swapped.", "If so, swap them.", [Place(setup="xy", line=3)]),
    ]
    assert describe_actions(findings).splitlines()[1:] == [
        "  1. x_slide, z_slide: enter them.",
        "  2. Setup xy, line 3: if this was the mistake, swap them.",
    ]


def test_the_next_step_of_a_decision_is_about_each_finding(cycles):
    """Each action is stated once, in the list; after three the number of the others."""
    largest = np.abs(cycles.values).argsort()[::-1]
    wrong = change(cycles, largest[0], -cycles.values[largest[0]])
    other = next(i for i in largest if wrong.readings[i].setup != wrong.readings[largest[0]].setup)
    assessed = check_session(change(wrong, other, -cycles.values[other]))
    lead, second = [f for f in assessed.findings if f.severity == "review"]
    lines = assessed.decision.action.splitlines()[1:]
    assert len(lines) == 2
    for line, finding in zip(lines, (lead, second), strict=True):
        assert finding.action.removeprefix("If so, ")[1:] in line
        assert f"line {finding.places[0].line}:" in line
    text = " ".join(to_text(render_decision(assessed)).split())
    assert text.count(" ".join(second.action.split())[1:]) == 1
    five = [replace(lead, action=f"Do {i}.") for i in range(5)]
    assert [line.split()[0] for line in describe_actions(five).splitlines()[1:]] == [
        "1.", "2.", "3.", "Then",
    ]  # fmt: skip
    assert "2 further" in describe_actions(five)
    assert describe_actions([lead]) == describe_actions([lead, lead]) == lead.action


@pytest.fixture
def judged(monkeypatch):
    sessions = []

    def count(session):
        sessions.append(session)
        return judge_session(session)

    for module in (orthocal, judgement_module):
        monkeypatch.setattr(module, "judge_session", count, raising=False)
    return sessions


def test_readings_are_judged_once(table1, judged):
    session = table1["2"]
    judgement = judge_session(session)
    stated = calibrate(session, "offsets", judgement=judgement, **QUICK)
    options = SolverOptions(**QUICK)
    compare_models(session, models=["offsets"], judgement=judgement, options=options)
    assert check_session(session, judgement=judgement).decision.verdict == "enter"
    assert judged == []
    judged_again = calibrate(session, "offsets", **QUICK).assessment
    assert judged_again.to_document() == stated.assessment.to_document()
    assert judged == [session]


NOTES = {
    "compensation not stated, common approach": lambda c: calibrate(
        replace(
            c.with_effects(["backlash"]),
            readings=tuple(
                replace(r, conditions=Conditions("ppp")) for r in c.readings if r.cycle == 1
            ),
        ),
        **QUICK,
    ),
    "earlier readings": lambda c: calibrate(c.with_controller(np.full(3, 1e-3)), **UNJUDGED),
}


@pytest.mark.parametrize("kinds", NOTES)
def test_notes_never_change_the_verdict(kinds, cycles):
    """tests/output/test_summary.py has those about a fit."""
    found = NOTES[kinds](cycles).assessment
    assert all(map(found.of_kind, kinds.split(", ")))
    assert found.decision.verdict == "enter"
    assert all(f.severity == "note" for f in found.findings)


def test_an_offset_at_a_bound_is_to_be_reviewed(cycles):
    bounds = {"x_slide.offset_m": (-1e-3, 0.5e-3)}
    found = calibrate(cycles, Choice("offsets", bounds=bounds), **UNJUDGED).assessment
    (held,) = found.of_kind("held by a bound")
    assert held.numbers == {"value_mm": pytest.approx(0.5)}
    assert found.decision.verdict == "review"
    bounds = {"x_slide.scale_ppm": (-1.0, 1.0)}
    choice = Choice(free=["*.offset", "x_slide.scale"], bounds=bounds)
    (held,) = calibrate(cycles, choice, **UNJUDGED).assessment.of_kind("held by a bound")
    assert held.severity == "note"
    assert [*held.numbers] == ["value_ppm"]
    assert abs(held.numbers["value_ppm"]) == pytest.approx(1.0)


def test_readings_are_compared_with_the_resolution_of_their_gauge(workshop):
    """Dials of 0.005 and 0.0001 mm: no reading is finer than the dial that shows it."""
    names = list(workshop.setups)[1::2]
    gauges = {"coarse": Gauge(1e-6, 5e-6), "fine": Gauge(1e-6, 1e-7)}
    fine = np.array([r.setup in names for r in workshop.readings])
    steps = np.where(fine, 1e-7, 5e-6)
    values = (np.round(workshop.values / steps) + fine) * steps
    both = with_gauges(workshop, gauges, names).with_values(values)
    assert "finer than the gauge" not in {f.kind for f in judge_session(both).findings}


def test_residuals_are_compared_with_the_stated_noise_and_rounding():
    """Half a step as noise: rounding adds a third to the variance and is no error of the model."""
    plan = session_of("sweep").with_gauge(Gauge(5e-6, 10e-6, None))
    floor = noise_floor(5e-6, 10e-6)
    for seed in range(3):
        session = simulate_session(plan, {"x_slide.offset": 0.1e-3}, seed=seed).session
        calibration = identified(session, "offsets")
        assert 5e-6 < calibration.gauges[0].noise.residual_sigma < 1.15 * floor
        assert "model error" not in {f.kind for f in find_fit_findings(calibration)}
    errors = {"x_slide.offset": 0.1e-3, "x_slide.rz": 1e-3, "y_swivel.rx": 1e-3}
    calibration = identified(simulate_session(plan, errors, seed=1).session, "offsets")
    (excess,) = (f for f in find_fit_findings(calibration) if f.kind == "model error")
    assert calibration.gauges[0].noise.residual_sigma > 1.15 * floor
    assert "the stated scatter of the gauge (0.005 mm)" in excess.text


def test_unknown_numbers_are_null():
    document = Finding("fits", "note", "It fits.", numbers={"a_mm": math.nan}).to_document()
    assert document["numbers"] == {"a_mm": None}
