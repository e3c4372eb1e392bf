"""Mistakes made in sound sessions: which are found, which are named, and what sound ones show.

`python tests/benchmarks/checking.py` prints the shares of all kinds.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from made_mistakes import Sheet, is_named, make_mistakes, plain_mistakes, sound_session
from typer.testing import CliRunner

from orthocal import (
    calibrate,
    check_session,
    load_plan,
    load_session,
    simulate_session,
)
from orthocal.assessment.words.readings import KINDS, _odds
from orthocal.cli.run import app
from orthocal.hypotheses.edits import Table
from orthocal.hypotheses.families.single_reading import find_single
from orthocal.hypotheses.families.swapped_rows import find_exchanged
from orthocal.hypotheses.families.unit_and_sign import find_scaled
from orthocal.hypotheses.search import find_mistakes
from orthocal.observation.simulate import draw_errors

TOLD = 40
"""Kinds of mistake that are made here at least."""


@pytest.fixture(scope="module")
def cycles(root):
    return load_session(root / "examples/raw-cycles")


@pytest.fixture(scope="module")
def sheet(root):
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    return Sheet(sound_session(plan, 0, entered=False), np.random.default_rng(2))


def turned(session, row):
    values = session.values.copy()
    values[row] *= -1.0
    return session.with_values(values)


def anomalies(session):
    """Findings that decide about the readings of a session."""
    return [f for f in check_session(session).findings if f.severity != "note"]


UNDONE = [
    *("sign of a reading", "sign of a setup", "sign of two setups", "sign of a leg", "sign of all"),
    *("sign of a posture, all cycles", "neighbouring rows exchanged", "rows of a setup exchanged"),
    *("rows of two setups exchanged", "postures exchanged, all cycles", "setups exchanged"),
    *("postures exchanged, all setups", "legs exchanged", "setup written backwards"),
    *("misread by 1 mm", "misread by 0.1 mm", "all in um", "setup ten times", "leg ten times"),
    *("reading ten times", "cycle of a setup ten times"),
]


@pytest.mark.parametrize("name", UNDONE)
def test_an_edit_undoes_the_mistake(sheet, name):
    made = plain_mistakes()[name](sheet)
    table = Table(sheet.session.with_values(made.values))
    families = [*find_single(table), *find_scaled(table, sheet.noise), *find_exchanged(table)]
    best = min(
        float(np.abs(made.values + change - sheet.values).max())
        for family in families
        if family.wrong is None
        for change in family.change
    )
    assert best < 1e-9


@pytest.mark.parametrize("example", ["raw-cycles", "workshop", "table1/experiment-2"])
def test_sound_readings_are_not_accused(root, example):
    assert anomalies(load_session(root / "examples" / example)) == []


def test_a_turned_reading_is_named_with_its_line_and_what_it_should_be(cycles):
    row = next(i for i, r in enumerate(cycles.readings) if r.value > 0.4e-3 and r.cycle == 2)
    (found,) = anomalies(turned(cycles, row))
    assert (found.kind, found.severity) == ("reversed reading", "review")
    assert [p.line for p in found.places] == [cycles.readings[row].line]
    n = found.numbers
    assert n["expected_mm"] == pytest.approx(cycles.values[row] * 1e3, abs=1e-9)
    assert n["after_rms_um"] < 0.2 * n["before_rms_um"]


def test_a_mistake_is_told_once_and_by_its_name(cycles):
    row = next(i for i, r in enumerate(cycles.readings) if r.value > 0.4e-3 and r.cycle == 2)
    found = calibrate(turned(cycles, row)).assessment
    assert [f.kind for f in found.findings if f.severity != "note"] == ["reversed reading"]
    assert found.decision.verdict == "review"


def test_a_slip_is_told_once(cycles):
    values = cycles.values.copy()
    values[4] += 0.23e-3
    found = calibrate(cycles.with_values(values)).assessment
    (told,) = [f for f in found.findings if f.severity != "note"]
    assert told.kind in KINDS.values()
    assert [p.line for p in told.places] == [cycles.readings[4].line]


def test_signs_of_all_cannot_be_told_where_offsets_are_not_known(cycles):
    """A machine whose offsets are as far to the other side shows the same."""
    assert anomalies(cycles.with_values(-cycles.values)) == []


def test_a_setup_whose_readings_are_of_nothing_that_is_known_is_named_as_a_whole(cycles):
    huge = {"x_max": 2e-3, "x_min": -1e-3}
    values = [r.value + huge.get(r.posture, 0.0) * (r.setup == "zx") for r in cycles.readings]
    (found,) = anomalies(cycles.with_values(values))
    assert (found.kind, [p.setup for p in found.places]) == ("inconsistent setup", ["zx"])


def test_what_is_no_session_is_refused():
    with pytest.raises(TypeError):
        check_session(3)


def test_the_command_says_what_it_found(root, tmp_path):
    runner, folder = CliRunner(), root / "examples/raw-cycles"
    sound = runner.invoke(app, ["check", str(folder)])
    assert sound.exit_code == 0
    assert sound.stdout.startswith("No anomaly found. The 54 readings agree")
    (tmp_path / "session.yaml").write_text((folder / "session.yaml").read_text())
    rows = (folder / "readings.csv").read_text().replace("x_max,2,0.44", "x_max,2,-0.44")
    (tmp_path / "readings.csv").write_text(rows)
    odd = runner.invoke(app, ["check", str(tmp_path)])
    assert odd.exit_code == 3
    assert odd.stdout.startswith("Check these readings first.")
    assert "Next: If so, write +0.44 instead of -0.44." in odd.stdout
    printed = runner.invoke(app, ["check", str(tmp_path), "--json"])
    assert printed.exit_code == 3
    document = json.loads(printed.stdout)
    assert document["decision"]["verdict"] == "review"
    assert document["findings"][0]["kind"] == "reversed reading"
    assert document["findings"][0]["places"][0]["line"] == 15


@pytest.mark.slow
def test_mistakes_are_found_and_named(root):
    """Bounds are what was measured at this seed, less a tenth."""
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    session = sound_session(plan, 0, entered=False)
    kinds, found, named, wrong = set(), 0, 0, []
    for name, size, made in make_mistakes(session, 0, sizes=()):
        kinds.add(name)
        told = find_mistakes(session.with_values(made.values))
        found += bool(told)
        named += bool(told) and not told[0].others and is_named(told[0], made)
        if told and not told[0].others and not set(told[0].rows) & made.rows:
            wrong.append((name, size))
    assert len(kinds) >= TOLD
    assert found >= FOUND * len(kinds)
    assert named >= NAMED * len(kinds)
    assert not wrong


FOUND = 0.70
"""Share of kinds that is found at least."""

NAMED = 0.55
"""Share of kinds that is named at least, and nothing beside."""


@pytest.mark.slow
@pytest.mark.parametrize("example", ["raw-cycles", "workshop"])
def test_hardly_a_sound_session_is_accused(root, example):
    """Machines with all errors at their tolerances, offsets entered or not."""
    plan = load_plan(root / f"examples/{example}/plan.yaml")
    accused = [
        seed
        for seed in range(1000, 1030)
        if anomalies(sound_session(plan, seed, entered=seed % 2 == 1))
    ]
    assert not accused


def test_a_mistake_whose_mending_no_machine_shows_says_the_odds_alone(cycles):
    row = next(i for i, r in enumerate(cycles.readings) if r.value > 0.4e-3 and r.cycle == 2)
    (found, *_) = find_mistakes(turned(cycles, row))
    assert "once corrected" in _odds(found)
    assert _odds(replace(found, after=math.inf)).startswith("Odds that something is wrong: ")


def test_what_a_calibration_stops_at_a_check_has_named(root):
    """A turned setup within the tolerances of offsets, which a check alone takes for theirs."""
    plan = load_plan(root / "examples/workshop/plan.yaml")
    offsets = dict.fromkeys((f"{axis}_slide.offset_m" for axis in "xyz"), 1e-3)
    patterns = plan.robot.parameters.patterns("full")
    errors = draw_errors(plan.robot, patterns, seed=5, tolerances=offsets)
    session = simulate_session(plan, errors, seed=5).session
    assert anomalies(session) == []
    signs = [-1.0 if r.setup == "zy" else 1.0 for r in session.readings]
    other = session.with_values(np.array(signs) * session.values)
    assert list(find_mistakes(other)) == []
    (found,) = anomalies(other)
    assert (found.kind, found.severity) == ("reversed setup", "review")
    assert [p.setup for p in found.places] == ["zy"]
