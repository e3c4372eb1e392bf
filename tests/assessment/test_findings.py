"""What is found in a calibration, and the one decision that follows from it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from fleets import Fleet
from gauges import exact
from orthocal.assessment.findings.calibration import decide
from orthocal.assessment.findings.finding import Finding, Kind, Severity
from orthocal.assessment.findings.validation import decide_validation

from orthocal import (
    Choice,
    calibrate,
    load_calibration,
    load_plan,
    load_session,
    simulate_session,
    validate_calibration,
)
from orthocal.assessment.tool_error import assess_tool, expect_after_offsets
from orthocal.calibration.file import calibration_document
from orthocal.output.text.printed_json import printed_calibration, printed_validation

UNITS = ("_mm", "_um", "_mrad", "_deg")

PURE = {
    *("cycle", "studentised", "influence", "readings", "of", "finer", "times", "times_tolerances"),
    *("log_likelihood_ratio", "independent_readings", "parameters", "chance", "part_of_sigma"),
    *("largest_change_over_std",),
}
"""Numbers of findings that have no unit."""


@pytest.fixture(scope="module")
def plan(root):
    return load_plan(root / "examples/raw-cycles/plan.yaml")


@pytest.fixture(scope="module")
def cycles(root):
    return load_session(root / "examples/raw-cycles")


@pytest.fixture(scope="module")
def table1(root):
    return {n: load_session(root / f"examples/table1/experiment-{n}") for n in (2, 3)}


def turned(session, setup):
    values = [-r.value if r.setup == setup else r.value for r in session.readings]
    return session.with_values(values)


def off(session, row, by):
    values = session.values.copy()
    values[row] += by
    return session.with_values(values)


def silent(session):
    return session.with_gauge(replace(session.gauge, sigma=None))


@pytest.fixture(scope="module")
def spoilt(cycles, table1):
    """Calibrations by what is the matter with them, with the answer and the kind that decides."""
    first = replace(cycles, readings=tuple(r for r in cycles.readings if r.cycle == 1))
    three = replace(table1[2], readings=table1[2].readings[1:4])
    huge = {"x_max": 2e-3, "x_min": -1e-3}
    leg = [r.value + huge.get(r.posture, 0.0) * (r.setup == "zx") for r in cycles.readings]
    plan = load_plan(cycles.path.with_name("plan.yaml"))
    ideal = simulate_session(plan, {}, exact=True).session
    still = ideal.with_gauge(replace(ideal.gauge, resolution=None))
    return {
        "sound": (calibrate(cycles), "enter", "fits"),
        "model error": (calibrate(table1[2]), "enter", "model error"),
        "one cycle": (calibrate(silent(first)), "enter", "noise not known apart"),
        "full": (calibrate(cycles, "full"), "enter", "nothing to check by"),
        "turned": (calibrate(turned(cycles, "zx")), "do not enter", "turned setup"),
        "one leg": (calibrate(cycles.with_values(leg)), "do not enter", "suspicious setup"),
        "one reading": (
            calibrate(off(cycles, 4, 0.2e-3)),
            "check before entering",
            "suspicious reading",
        ),
        "inches": (
            calibrate(cycles.with_values(np.round(cycles.values / 25.4, 7))),
            "do not enter",
            "wrong unit",
        ),
        "three readings": (calibrate(three), "check before entering", "nothing to check by"),
        "no word": (calibrate(silent(three)), "check before entering", "noise unknown"),
        "no offset": (
            calibrate(cycles, Choice(free=["x_leg.length"])),
            "nothing to enter",
            "no offset",
        ),
        "entered": (calibrate(table1[3]), "nothing to enter", "nothing worth changing"),
        "still": (
            calibrate(still),
            "nothing to enter",
            "nothing moved",
        ),
        "bound": (
            calibrate(cycles, Choice(bounds={"x_slide.offset_m": (-1e-3, 0.5e-3)})),
            "check before entering",
            "held by a bound",
        ),
    }


CASES = [
    *("sound", "model error", "one cycle", "full", "turned", "one leg", "one reading", "inches"),
    *("three readings", "no word", "no offset", "entered", "still", "bound"),
]


@pytest.mark.parametrize("case", CASES)
def test_one_decision_follows_from_the_gravest_finding(spoilt, case):
    calibration, answer, kind = spoilt[case]
    found = decide(calibration)
    assert found.answer == answer
    (lead,) = found.of_kind(kind)[:1]
    assert lead.text == found.reason or kind == "suspicious reading"
    assert found.exit_code == (3 if answer == "do not enter" else 0)
    order = [get_args(Severity).index(f.severity) for f in found.findings]
    assert order == sorted(order)
    if answer == "enter":
        assert not any(f.severity != "informs" for f in found.findings)
    if answer == "do not enter":
        assert found.findings[0] is lead
        assert lead.severity == "stops"


@pytest.mark.parametrize("case", CASES)
def test_findings_are_of_a_known_kind_with_units_and_load_again(spoilt, case, tmp_path):
    calibration, *_ = spoilt[case]
    document = json.loads(printed_calibration(calibration))
    for finding in document["findings"]:
        assert finding["kind"] in get_args(Kind)
        assert finding["severity"] in get_args(Severity)
        assert finding["text"].endswith((".", "?", ")"))
        assert not finding["action"] or finding["action"].endswith(".")
        for name in finding["numbers"]:
            assert name in PURE or name.endswith(UNITS), name
        for place in finding["places"]:
            assert set(place) == {"file", "line", "setup", "posture", "parameter"}
            assert any(v is not None for v in place.values())
    # what is printed is a calibration, too: what follows from it is found anew
    path = tmp_path / "calibration.json"
    document["decision"] = {"answer": "enter"}
    path.write_text(json.dumps(document))
    loaded = load_calibration(path)
    assert decide(loaded).to_document() == decide(calibration).to_document()
    assert "decision" not in calibration_document(loaded)


def test_a_turned_setup_is_found_with_its_numbers_and_place(spoilt):
    (found,) = decide(spoilt["turned"][0]).of_kind("turned setup")
    assert [p.setup for p in found.places] == ["zx"]
    assert found.numbers["as_read_rms_mm"] == pytest.approx(0.401, abs=0.001)
    assert found.numbers["turned_rms_mm"] == pytest.approx(0.008, abs=0.001)
    assert found.numbers["log_likelihood_ratio"] > 8.0
    assert "calibrate again" in found.action


def test_a_turned_setup_that_nothing_foretells_has_no_unknown_in_its_words(spoilt):
    calibration = spoilt["turned"][0]
    blind = replace(calibration.turned, as_read=math.nan, turned=math.nan)
    (found,) = decide(replace(calibration, turned=blind)).of_kind("turned setup")
    assert "unknown" not in found.text
    assert "setup zx seem to have the wrong sign" in found.text
    assert found.to_document()["numbers"]["turned_rms_mm"] is None


def test_a_suspicious_reading_is_found_with_file_and_line(spoilt, cycles):
    (found,) = decide(spoilt["one reading"][0]).of_kind("suspicious reading")
    (place,) = found.places
    row = cycles.readings[4]
    assert (place.setup, place.posture, place.line) == (row.setup, row.posture, row.line)
    assert place.file == str(cycles.readings_path)
    n = found.numbers
    assert n["measured_mm"] == pytest.approx((row.value + 0.2e-3) * 1e3)
    # some of an error is taken for the machine's; how much does not depend on its size
    of = exact(cycles)
    sound, little, much = (calibrate(off(of, 4, by)).residuals[4] for by in (0.0, 1e-5, 0.2e-3))
    left = (little.residual - sound.residual) / 1e-5
    assert (much.residual - sound.residual) / 0.2e-3 == pytest.approx(left, rel=0.01)
    difference = (n["measured_mm"] - n["expected_mm"]) * 1e-3
    assert difference == pytest.approx(sound.residual + left * 0.2e-3, abs=2e-6)


def test_where_readings_stand_out_they_are_to_be_looked_at_before_a_setup(root):
    """A single wrong sign of 14 mm is far beyond all tolerances, and it is its own reason."""
    session = load_session(root / "tests/sessions/lines")
    row = next(i for i, r in enumerate(session.readings) if r.value > 13.5e-3)
    found = decide(calibrate(off(session, row, -2.0 * session.values[row])))
    assert found.answer == "do not enter"
    assert found.action.startswith("If so, write +14.")
    (turned,) = found.of_kind("turned reading")
    assert [p.line for p in turned.places] == [session.readings[row].line]
    assert not found.of_kind("suspicious reading", "tolerances exceeded")


def test_slips_are_not_held_against_the_machine(root):
    """Seven wrong readings leave more than its tolerances would: they are the reason, not it."""
    session = load_session(root / "tests/sessions/lines")
    values = session.values.copy()
    values[[4, 50, 100, 150, 200, 220, 250]] += 0.5e-3
    found = decide(calibrate(session.with_values(values)))
    (beyond,) = found.of_kind("tolerances exceeded")
    assert beyond.severity == "informs"
    assert "this machine seems" not in beyond.text
    assert "readings that all others contradict may be why" in beyond.text


def test_a_turned_setup_is_the_only_reason_not_to_enter(root):
    """What it leaves is its own doing: no other sign, row or machine is accused beside it."""
    session = load_session(root / "tests/sessions/lines")
    found = decide(calibrate(turned(session, "yx")))
    assert [f.kind for f in found.findings if f.severity == "stops"] == ["turned setup"]
    (beyond,) = found.of_kind("tolerances exceeded")
    assert beyond.numbers["times_tolerances"] > 100.0
    assert "machine is as much worse" not in beyond.text


def test_when_most_are_contradicted_no_reading_is_accused(table1):
    found = decide(calibrate(table1[2], "full"))
    assert not found.of_kind("suspicious reading")
    (many,) = found.of_kind("many contradicted")
    assert many.numbers["of"] == 6.0
    assert many.severity == "informs"


def test_the_tool_is_promised_what_the_assessment_says(spoilt):
    calibration, *_ = spoilt["full"]
    (found,) = decide(calibration).of_kind("at the tool")
    accuracy = assess_tool(calibration)
    expected = expect_after_offsets(calibration, accuracy)
    assert found.numbers["expected_um"] == pytest.approx(expected * 1e6)
    now = accuracy.measure(accuracy.deviation).headline.rms
    assert found.numbers["known_to_be_off_um"] == pytest.approx(now * 1e6)
    assert found.numbers["expected_as_it_is_um"] > found.numbers["known_to_be_off_um"]


def test_offsets_are_left_alone_only_where_that_costs_nothing(cycles, plan):
    """Changes below their ± that would make the tool better are to be entered all the same."""
    errors = {"x_slide.offset": 0.25e-3, "y_slide.offset": -0.25e-3, "z_slide.offset": 0.2e-3}
    calibration = calibrate(simulate_session(plan, errors, seed=3).session)
    stds = calibration.total_std
    assert all(abs(p.value) < s for p, s in zip(calibration.free, stds, strict=True))
    found = decide(calibration)
    assert found.answer == "enter"
    n = found.of_kind("at the tool")[0].numbers
    assert n["expected_as_it_is_um"] > 1.05 * n["expected_um"]


def test_a_robot_without_a_tool_is_out_of_reach(table1):
    bare = replace(table1[2], robot=replace(table1[2].robot, tcp=None))
    found = decide(calibrate(bare))
    assert found.answer == "enter"
    (reach,) = found.of_kind("out of reach")
    assert "no tool centre point" in reach.text
    assert not found.of_kind("at the tool")


def test_what_a_bound_holds_and_what_is_not_stated_is_found(table1):
    bounded = calibrate(table1[3], Choice(bounds={"x_slide.offset_m": (-1e-3, -0.5e-3)}))
    found = decide(bounded)
    (held,) = found.of_kind("held by a bound")
    assert held.places[0].parameter == "x_slide.offset"
    assert held.numbers == {"value_mm": pytest.approx(-0.5)}
    assert "upper bound, -0.5 mm" in held.text
    assert found.of_kind("controller not stated")
    assert not decide(calibrate(table1[2])).of_kind("controller not stated")


@pytest.mark.parametrize("seed", range(3))
def test_sound_machines_are_never_accused(plan, seed):
    """Before their offsets were entered and, with all other errors as they are, after."""
    fleet = Fleet(plan)
    drawn = fleet.draw(np.random.default_rng(70 + seed))
    for scale in (1.0, 0.0):
        values = np.where(fleet.is_offset, scale * drawn, drawn)
        errors = fleet.machine.split_errors(values)
        session = simulate_session(plan, errors, seed=seed).session
        for model in ("offsets", "full"):
            found = decide(calibrate(session, model))
            graver = [f.kind for f in found.findings if f.severity != "informs"]
            assert graver == []
            assert found.answer in ("enter", "nothing to enter")


def test_a_validation_is_decided(table1, plan):
    confirmed = validate_calibration(calibrate(table1[2]), table1[3])
    found = decide_validation(confirmed)
    assert (found.answer, found.exit_code) == ("confirmed", 0)
    assert found.findings[0].numbers["achieved_rms_mm"] == pytest.approx(0.213, abs=0.001)
    assert [f.kind for f in found.findings] == [
        *("as expected", "repeats", "controller not stated"),
    ]
    errors = {"x_slide.offset": 1.2e-3, "y_slide.offset": -0.8e-3, "z_slide.offset": 0.5e-3}
    calibration = calibrate(simulate_session(plan, errors, seed=1).session)
    again = simulate_session(plan, errors, seed=2).session  # nothing was entered
    claimed = replace(again, controller_offsets=None)
    refused = validate_calibration(calibration, claimed)
    found = decide_validation(refused)
    assert (found.answer, found.exit_code) == ("not confirmed", 3)
    assert [f.kind for f in found.findings[:2]] == ["more than expected", "not entered"]
    cause = found.findings[1]
    assert {p.parameter for p in cause.places} == {"x_slide", "y_slide", "z_slide"}
    assert cause.numbers["x_slide_by_mm"] == pytest.approx(-1.2, abs=0.03)
    document = json.loads(printed_validation(refused))
    assert document["decision"]["answer"] == "not confirmed"
    assert document["findings"][1]["kind"] == "not entered"
    assert document["mistake"]["kind"] == "not entered"
    few = tuple(r for r in table1[2].readings if r.setup in ("yx", "xy", "xz"))
    blind = validate_calibration(calibrate(replace(table1[2], readings=few)), table1[3])
    assert decide_validation(blind).answer == "cannot be told"
    assert decide_validation(blind).exit_code == 0


def test_numbers_that_are_not_known_are_none():
    document = Finding("fits", "informs", "It fits.", numbers={"a_mm": math.nan}).to_document()
    assert document["numbers"] == {"a_mm": None}
