"""One verdict for the same readings, whichever command asks."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from commands import run_orthocal
from drawn_machines import DrawnMachines
from effect_plans import write_plan

import orthocal
from orthocal import (
    Choice,
    Gauge,
    assess_tool,
    calibrate,
    check_session,
    compare_models,
    load_calibration,
    load_plan,
    load_session,
    simulate_session,
    write_calibration,
    write_session,
)
from orthocal.assessment import assess, comparison
from orthocal.assessment.judgement import judge_session
from orthocal.calibration.assessment_record import EXIT_CODES, Finding, FindingKind, Severity
from orthocal.output.text.summary import result_json
from orthocal.session.session import Conditions

UNITS = ("_mm", "_um", "_mrad", "_deg")

PURE = {
    *("cycle", "finer", "ratio", "tolerance_scale", "log_likelihood_ratio", "log_evidence"),
    "log_evidence_against_chosen",
    *("independent_readings", "parameters", "chance", "part_of_std", "readings", "missing"),
    *("largest_change_over_std",),
}
"""Numbers of findings without a unit."""


@pytest.fixture(scope="module")
def plan(root):
    return load_plan(root / "examples/raw-cycles/plan.yaml")


@pytest.fixture(scope="module")
def cycles(root):
    return load_session(root / "examples/raw-cycles")


@pytest.fixture(scope="module")
def workshop(root):
    return load_session(root / "examples/workshop")


@pytest.fixture(scope="module")
def table1(root):
    names = ("1-printed", "1-corrected", "2", "3")
    return {n: load_session(root / f"examples/table1/experiment-{n}") for n in names}


def reverse(session, setup):
    signs = np.array([-1.0 if r.setup == setup else 1.0 for r in session.readings])
    return session.with_values(signs * session.values)


def change(session, row, value):
    values = session.values.copy()
    values[row] = value
    return session.with_values(values)


def swap(session, one, other):
    values = session.values.copy()
    values[[one, other]] = values[[other, one]]
    return session.with_values(values)


def displace(session, setup, by):
    rows = [i for i, r in enumerate(session.readings) if r.setup == setup]
    values = session.values.copy()
    values[rows[len(rows) // 2 :]] += by
    return session.with_values(values)


def drift(session, by):
    """Session in which the gauge of each setup moves from its first reading to its last."""
    values = session.values.copy()
    for setup in session.setups:
        rows = [i for i, r in enumerate(session.readings) if r.setup == setup]
        values[rows] += by * np.linspace(0.0, 1.0, len(rows))
    return session.with_values(values)


def with_backlash(folder):
    """A machine whose robot lacks the backlash that its readings show."""
    plan = load_plan(write_plan(folder, effects="screw: {lead_mm: 10}")).with_effects(["backlash"])
    plan = plan.select([r for r in plan.readings if r.setup in ("yx", "xy", "xz")])
    errors = {"y_slide.backlash": 50e-6, "x_slide.offset": 0.1e-3}
    return simulate_session(plan, errors, seed=4).session.with_effects([])


def spoilt(cycles, workshop, table1, folder):
    """Sessions by what is wrong with them, with the verdict that they deserve."""
    largest, backlash = int(np.abs(cycles.values).argmax()), with_backlash(folder)
    coarse = replace(cycles.gauge, resolution=10e-3)
    return {
        "sound": (cycles, "enter"),
        "workshop": (workshop, "enter"),
        "experiment 2": (table1["2"], "enter"),
        "experiment 3": (table1["3"], "enter"),
        "experiment 1 as printed": (table1["1-printed"], "reject"),
        "experiment 1 corrected": (table1["1-corrected"], "reject"),
        "reversed setup": (reverse(cycles, "zx"), "review"),
        "reversed sign": (change(cycles, largest, -cycles.values[largest]), "review"),
        "decimal point": (change(cycles, largest, 0.1 * cycles.values[largest]), "review"),
        "inches": (cycles.with_values(np.round(cycles.values / 25.4, 7)), "review"),
        "resolution": (cycles.with_gauge(coarse), "review"),
        "swapped rows": (swap(cycles, 1, 2), "review"),
        "displaced gauge": (displace(cycles, "yx", 0.2e-3), "review"),
        "drift": (drift(cycles, 0.1e-3), "review"),
        "backlash": (backlash, "review"),
        "backlash in the model": (backlash.with_effects(["backlash"]), "enter"),
    }


CASES = [
    *("sound", "workshop", "experiment 2", "experiment 3", "experiment 1 as printed"),
    *("experiment 1 corrected", "reversed setup", "reversed sign", "decimal point", "inches"),
    *(
        "resolution",
        "swapped rows",
        "displaced gauge",
        "drift",
        "backlash",
        "backlash in the model",
    ),
]


@pytest.fixture(scope="module")
def cases(cycles, workshop, table1, tmp_path_factory):
    return spoilt(cycles, workshop, table1, tmp_path_factory.mktemp("backlash") / "plan")


def calibrated(cases, case, model="offsets"):
    """Calibration of a copy of a case, which is judged by itself."""
    return calibrate(replace(cases[case][0]), model, solver="variable-projection")


@pytest.mark.parametrize("case", ["sound", "reversed sign", "experiment 1 as printed", "backlash"])
def test_every_command_has_the_same_verdict(cases, case, tmp_path):
    """One case for each verdict: in the document, as exit code, and by what is exported."""
    session, expected = cases[case]
    write_session(session, tmp_path / "session")
    code = EXIT_CODES[expected]
    for command in (
        ("check", tmp_path / "session"),
        ("calibrate", tmp_path / "session"),
        ("calibrate", tmp_path / "session", "--model", "full", "--solver", "variable-projection"),
        ("compare", tmp_path / "session", "--models", "offsets"),
    ):
        done = run_orthocal(tmp_path, *command, "--json")
        decision = json.loads(done.stdout)["decision"]
        assert (decision["verdict"], decision["exit_code"]) == (expected, code)
        assert done.returncode == code
    path = write_calibration(calibrated(cases, case), tmp_path / "calibration.json")
    words = ["export", path, "--to", "yaml", "--out", tmp_path / "out"]
    assert run_orthocal(tmp_path, *words).returncode == code
    assert (tmp_path / "out").exists() == (expected == "enter")
    anyway = ["--anyway"] if expected != "enter" else []
    words = ["export", path, "--to", "yaml", "--out", tmp_path / "anyway"]
    assert run_orthocal(tmp_path, *words, *anyway).returncode == 0


@pytest.mark.parametrize("case", CASES)
def test_the_judgement_does_not_depend_on_the_model(cases, case, tmp_path):
    """Each calibration has the findings of a check; they are of known kinds, and load again."""
    session, expected = cases[case]
    found = [f for f in check_session(session).findings if f.severity != "note"]
    for model in ("offsets", "full"):
        calibration = calibrated(cases, case, model)
        assessment = calibration.assessment
        own = [f for f in assessment.findings if f.severity != "note"]
        assert [f.to_document() for f in own] == [f.to_document() for f in found]
        assert assessment.decision.verdict == expected
        require_known_findings(calibration, tmp_path / f"{model}.json")


def require_known_findings(calibration, path):
    document = json.loads(result_json(calibration))
    for finding in document["findings"]:
        assert finding["kind"] in get_args(FindingKind)
        assert finding["severity"] in get_args(Severity)
        assert finding["text"].endswith((".", "?"))
        for name in finding["numbers"]:
            assert name in PURE or name.endswith(UNITS), name
        for place in finding["places"]:
            assert any(v is not None for v in place.values())
    path.write_text(json.dumps(document))
    loaded = load_calibration(path)
    assert loaded.assessment.to_document() == calibration.assessment.to_document()


def test_an_unfinished_session_is_checked_as_far_as_it_was_read(cycles, root, tmp_path):
    """The verdict is that of the readings that are there; calibrate refuses and names the lines."""
    wrong = reverse(cycles, "yx")
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
    for command in (["calibrate", "."], ["compare", "."]):
        done = run_orthocal(tmp_path, *command)
        assert (done.returncode, done.stdout) == (2, "")
        assert "readings.csv: 4 of 54 readings are missing (lines 5, 7 to 9); " in done.stderr
    path.write_text("\n".join([lines[0], *(x.rpartition(",")[0] + "," for x in lines[1:])]) + "\n")
    done = run_orthocal(tmp_path, "check", ".")
    assert (done.returncode, done.stdout) == (2, "")
    assert "no reading is entered yet" in done.stderr


def test_readings_are_judged_once(cycles, monkeypatch):
    """Once in a calculation, and not again with their judgement: the result is the same."""
    sessions = []

    def count(session):
        sessions.append(session)
        return judge_session(session)

    for module in (assess, comparison):
        monkeypatch.setattr(module, "judge_session", count)
    judgement = judge_session(cycles)
    given = calibrate(cycles, "full", judgement=judgement)
    compared = compare_models(cycles, models=["offsets", "lengths"], judgement=judgement)
    assert check_session(cycles, judgement=judgement).decision.verdict == "enter"
    assert sessions == []
    assert calibrate(cycles, "full").assessment.to_document() == given.assessment.to_document()
    assert sessions == [cycles]
    again = compare_models(cycles, models=["offsets", "lengths"])
    assert again.assessment.to_document() == compared.assessment.to_document()
    assert sessions == [cycles, cycles]
    assert judge_session(reverse(cycles, "zx")).verdict == "review"
    assert judge_session(cycles).verdict == "enter"


@pytest.mark.parametrize("command", ["check", "calibrate", "compare"])
def test_a_command_judges_once(root, command, monkeypatch):
    sessions = []

    def count(session):
        sessions.append(session)
        return judge_session(session)

    monkeypatch.setattr(orthocal, "judge_session", count, raising=False)
    for module in (assess, comparison):
        monkeypatch.setattr(module, "judge_session", count)
    assert run_orthocal(root, command, "examples/table1/experiment-2").returncode == 0
    assert len(sessions) == 1


NOTES = {
    "model error": lambda c, t: calibrate(t["2"]),
    "no redundancy": lambda c, t: calibrate(c, "full", solver="variable-projection"),
    "noise unknown": lambda c, t: calibrate(
        replace(t["2"], readings=t["2"].readings[1:4]).with_gauge(Gauge(None, None, None))
    ),
    "no offset": lambda c, t: calibrate(c, Choice(free=["x_leg.length"])),
    "no change needed": lambda c, t: calibrate(t["3"]),
    "fits": lambda c, t: calibrate(c),
    "backlash not stated": lambda c, t: calibrate(
        replace(
            c.with_effects(["backlash"]),
            readings=tuple(replace(r, conditions=Conditions("ppp")) for r in c.readings),
        )
    ),
    "earlier readings": lambda c, t: calibrate(c.with_controller(np.full(3, 1e-3))),
}


@pytest.mark.parametrize("kind", NOTES)
def test_notes_never_change_the_verdict(kind, cycles, table1):
    found = NOTES[kind](cycles, table1).assessment
    assert found.of_kind(kind)
    assert found.decision.verdict == "enter"
    assert all(f.severity == "note" for f in found.findings)


def test_an_offset_at_a_bound_is_to_be_reviewed(cycles):
    bounds = {"x_slide.offset_m": (-1e-3, 0.5e-3)}
    found = calibrate(cycles, Choice("offsets", bounds=bounds)).assessment
    (held,) = found.of_kind("held by a bound")
    assert held.numbers == {"value_mm": pytest.approx(0.5)}
    assert found.decision.verdict == "review"


def test_two_gauges_are_each_held_to_their_own_resolution(workshop):
    """Dials of 0.005 and 0.0001 mm: no reading is finer than the dial that shows it."""
    fine = replace(workshop.gauge, resolution=1e-7, sigma=1e-6)
    coarse = replace(workshop.gauge, resolution=5e-6)
    names = list(workshop.setups)
    setups = {
        n: replace(s, gauge="fine" if i % 2 else "coarse")
        for i, (n, s) in enumerate(workshop.setups.items())
    }
    values = [
        round(r.value / (1e-7 if names.index(r.setup) % 2 else 5e-6))
        * (1e-7 if names.index(r.setup) % 2 else 5e-6)
        + (1e-7 if names.index(r.setup) % 2 else 0.0)
        for r in workshop.readings
    ]
    both = replace(workshop, gauges={"coarse": coarse, "fine": fine}, setups=setups).with_values(
        values
    )
    assert "finer than the gauge" not in {f.kind for f in judge_session(both).findings}


def test_the_tool_error_is_that_of_the_accuracy(workshop):
    calibration = calibrate(workshop, solver="variable-projection")
    tool, accuracy = calibration.assessment.tool, assess_tool(calibration)
    known = accuracy.after.sizes.reported.rms
    left = accuracy.measure(accuracy.deviation_with_entries).reported.rms
    assert tool.entered == pytest.approx(math.hypot(left, known), rel=1e-9)
    assert tool.compensated == pytest.approx(known, rel=1e-9)
    assert tool.region == "±60 mm"


def test_a_robot_without_a_tool_is_out_of_reach(table1):
    bare = replace(table1["2"], robot=replace(table1["2"].robot, tcp=None))
    found = calibrate(bare).assessment
    assert found.decision.verdict == "enter"
    assert found.of_kind("out of reach")
    assert found.tool is None


@pytest.mark.parametrize("seed", range(3))
def test_sound_machines_are_never_accused(plan, seed):
    """Before their offsets were entered and, with all other errors as they are, after."""
    machines = DrawnMachines(plan, model="full")
    drawn = machines.draw(np.random.default_rng(70 + seed))
    for scale in (1.0, 0.0):
        values = np.where(machines.is_offset, scale * drawn, drawn)
        errors = machines.machine.error_values(values)
        session = simulate_session(plan, errors, seed=seed).session
        found = check_session(session)
        assert [f.kind for f in found.findings if f.severity != "note"] == []
        assert found.decision.verdict == "enter"


def test_unknown_numbers_are_null():
    document = Finding("fits", "note", "It fits.", numbers={"a_mm": math.nan}).to_document()
    assert document["numbers"] == {"a_mm": None}
