"""Accuracy study with effects that the calibration identifies or ignores."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from commands import run_orthocal
from effect_machines import write_plan
from independent import Expansion, IndependentMachine, States

from orthocal import Choice, load_plan
from orthocal.errors import ParameterError, SessionError
from orthocal.kinematics.conditions import sample_use
from orthocal.output.text.study import report_study
from orthocal.study.accuracy import build_accuracy_study, summarise_accuracy
from orthocal.study.runner import run_study
from orthocal.study.study import run_task

NEAR = {"*.offset_mm": 1.0}
USED = "{approach: both, temperature_C: [24, 30]}"
LETTERS = {"p": 1.0, "n": -1.0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Plan of 60 readings of a machine that is used from both sides, at 24 to 30 °C."""
    directory = write_plan(tmp_path_factory.mktemp("study") / "plan")
    file = directory / "machine" / "machine.yaml"
    file.write_text(file.read_text().replace("\n  tcp: ", f"\n  use: {USED}\n  tcp: "))
    return directory


def study_of(folder, effects, identified, *, machines=3, seed=0):
    choice = Choice("full", tolerances=NEAR, effects=identified)
    plan = load_plan(folder)
    return build_accuracy_study(
        plan, choice, effects=effects, machines=machines, seed=seed, half_side=0.05
    )


def test_the_tool_of_a_machine_agrees_with_the_independent_one(folder):
    """Before a calibration, from both sides of each drive and at two temperatures."""
    study = study_of(folder, ("backlash", "thermal"), ("thermal",))
    rows, p = run_task(study, 0), study.prepare()
    drawn, _ = p.draw(1)
    truth = dict(zip(study.drawn, drawn * p.truth.theta_scale, strict=False))
    machine = IndependentMachine(folder / "machine", truth, expansion=Expansion())
    use, drives = sample_use(p.truth.robot), p.tool.drives
    assert use.size == 8
    assert {c.temperature for c in use.conditions} == {27 - 3**0.5, 27 + 3**0.5}
    tools = [
        machine.tool(
            States(
                drives,
                np.tile([LETTERS[letter] for letter in c.approach], (len(drives), 1)),
                np.full(len(drives), c.temperature),
            )
        )
        for c in use.conditions
    ]
    tool = np.concatenate([np.reshape(t, (-1, 3)) for t in tools])
    field = p.tool.workspace.remove_motion(tool - p.tool.positions, p.tool.positions)
    rms = np.sqrt(p.tool.workspace.weights @ (field**2).sum(axis=1))
    assert rows["before_um"][1] == pytest.approx(1e6 * rms, rel=1e-6)
    backlash = [v for n, v in truth.items() if n.endswith(".backlash")]
    assert len(backlash) == 3
    assert min(backlash) > 0.0


def test_ignored_backlash_costs_what_the_covariance_predicts(folder):
    count = 10
    study = study_of(folder, ("backlash",), (), machines=count)
    assert study.ignored == ("backlash",)
    table = run_study(study, workers=1)
    s = summarise_accuracy(study, table)
    assert s.machines == count
    assert abs(s.after - s.predicted.reported.rms) < 3.0 * s.standard_error
    # half the backlash of three drives remains
    remaining = np.sqrt(3.0) * 0.5 * 0.02e-3
    assert s.after > np.hypot(0.95 * s.all_effects, 0.8 * remaining)
    identified = study_of(folder, ("backlash",), ("backlash",), machines=3)
    known = run_study(identified, workers=1)
    assert summarise_accuracy(identified, known).all_effects is None
    same = table.columns["tool_all_effects_um"]
    assert known.columns["tool_um"] == pytest.approx(same[:3], rel=1e-9)
    assert s.all_effects == pytest.approx(1e-6 * np.sqrt(np.mean(np.square(same))), rel=1e-9)
    tools = np.array([table.columns[c] for c in ("tool_um", "tool_all_effects_um")]) * 1e-6
    costs = [-np.subtract(*np.sqrt((np.delete(tools, i, 1) ** 2).mean(1))) for i in range(count)]
    jackknife = np.std(costs) * np.sqrt(count - 1)
    # two estimates of a standard error; they differ by the order of 1/count
    assert s.cost_standard_error == pytest.approx(jackknife, rel=1.5 / count)
    document = report_study(table).document
    assert document["ignored"] == ["backlash"]
    assert document["after_all_effects_um"] == pytest.approx(1e6 * s.all_effects)


@pytest.mark.parametrize("effect", ["thermal", "drift"])
def test_effects_that_change_a_perfect_machine_are_not_predicted(folder, effect):
    assert study_of(folder, (effect,), ()).predicted is None


def test_machines_without_an_effect_can_be_calibrated_with_it(folder):
    study = study_of(folder, (), ("backlash",))
    assert not study.ignored
    rows = run_task(study, 0)
    assert rows["true.x_slide.backlash_mm"] == [0.0] * 3
    assert min(rows["error.x_slide.backlash_mm"]) >= 0.0
    assert max(rows["tool_um"]) < max(rows["before_um"])


def test_a_worker_has_the_effects_of_the_study(folder):
    study = study_of(folder, ("backlash",), ())
    copy = pickle.loads(pickle.dumps(study))
    assert copy == study
    assert copy.session.robot.effect_names == ()
    assert run_task(copy, 0) == run_task(study, 0)


def test_effects_are_part_of_the_record(folder):
    one = study_of(folder, ("backlash",), ("backlash",))
    others = [study_of(folder, ("backlash",), ()), study_of(folder, ("backlash", "screw"), ())]
    assert len({study.digest for study in (one, *others)}) == 3


def test_unknown_effects_and_missing_conditions_are_refused(folder):
    with pytest.raises(ParameterError, match="'wear' is not an effect"):
        study_of(folder, ("wear",), ())
    plan = load_plan(folder)
    bare = plan.select(plan.readings)
    bare = bare.with_values([0.0] * len(bare.readings))
    bare = replace(bare, readings=tuple(replace(r, conditions=None) for r in bare.readings))
    with pytest.raises(SessionError, match="approach"):
        build_accuracy_study(bare, Choice("full", effects=()), effects=("backlash",), machines=2)


def test_the_command_prints_the_cost_of_ignoring_an_effect(folder, root):
    words = ["study", "accuracy", folder, "--effects", "backlash", "--machines", 8]
    code, out, _ = run_orthocal(root, *words, "--ignore", "backlash", "--workers", 1)
    assert code == 0
    answer = " ".join(out.split())
    assert answer.startswith("Ignoring backlash costs 0.0")
    assert " mm RMS at the tool, 0.0" in answer
    code, out, err = run_orthocal(root, *words, "--ignore", "thermal")
    assert (code, out) == (2, "")
    assert "--ignore" in err
    assert "'thermal'" in err
