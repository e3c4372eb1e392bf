"""What to enter into a controller that takes nothing but offsets."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import plans
import pytest
from drawn_machines import DrawnMachines
from machines import write_orthoglide

from orthocal import Choice, calibrate, load_plan, simulate_session
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.assessment.controller_entries import (
    choose_offsets,
    compute_entries,
    entered_offsets,
    find_entries,
)
from orthocal.assessment.judgement import find_tolerance_scale
from orthocal.assessment.tool_error import assess_placed, summarise_tool
from orthocal.calibration.identify import identify
from orthocal.kinematics.loop_closure import LoopClosure, nominal_closure


@pytest.fixture(scope="module")
def quarter(tmp_path_factory):
    """The paper's plan for a machine with legs of 250 mm, travel in proportion."""
    folder = tmp_path_factory.mktemp("quarter")
    write_orthoglide(folder / "machine", 0.25)
    plan = plans.paper(max=48.0, min=-80.0)
    plan |= {"robot": "machine", "cycles": 3}
    plan["gauge"] = {"sigma_mm": 0.01, "resolution_mm": 0.01, "range_mm": [-20, 20]}
    return load_plan(plans.write(folder, plan))


def error_left(plan, errors, offsets, space):
    """R.m.s. error at the tool of a machine with offsets in its controller, aligned, [m]."""
    nominal = nominal_closure(plan.robot)
    drives = nominal.inverse(space.points)
    moved = LoopClosure(plan.robot, fixed=errors).forward(drives - offsets) - nominal.forward(
        drives
    )
    aligned = space.remove_motion(moved, space.points)
    return float(np.sqrt(space.weights @ (aligned**2).sum(axis=1)))


def test_offsets_alone_are_entered_as_they_are(root):
    result = calibrate(root / "examples/sweep", "offsets")
    for entry in find_entries(result):
        assert entry.enter == entry.identified == result[f"{entry.drive}.offset"].value


def test_offsets_are_chosen_by_least_error_at_the_tool(quarter):
    """No offsets nearby leave less; the gain is how the choice follows from the parameters."""
    machines = DrawnMachines(quarter)
    errors = machines.machine.error_values(machines.draw(np.random.default_rng(1)))
    result = calibrate(simulate_session(quarter, errors, seed=1).session, "full")
    tool = find_tool(result)
    space = tool.workspace
    best = entered_offsets(result)
    least = error_left(quarter, result.errors, best, space)
    for i in range(3):
        for step in (-20e-6, 20e-6):
            other = best.copy()
            other[i] += step
            assert error_left(quarter, result.errors, other, space) > least
    identified = np.array([e.identified for e in find_entries(result)])
    assert error_left(quarter, result.errors, identified, space) > 1.2 * least
    # the gain by differences: an error a little larger, chosen again. The gain is that of the
    # offsets that were active, some mm away
    gain = choose_offsets(tool, best, drives=range(3)).gain
    name, step = "x_slide.ry", 1e-5
    parameters = tuple(
        replace(p, value=p.value + step) if p.name == name else p for p in result.parameters
    )
    moved = replace(result, parameters=parameters, assessment=None)
    change = (entered_offsets(moved) - best) / step
    column = gain[:, list(tool.free).index(name)]
    assert change == pytest.approx(column, abs=0.05 * np.abs(column).max())


@pytest.mark.slow
def test_what_is_promised_with_the_offsets_entered_is_kept(quarter):
    """Ten machines of 250 mm with all errors at tolerance: chosen offsets of the full model leave
    less than its identified ones and than those of offsets alone, and what was said."""
    machines = DrawnMachines(quarter)
    left = {"chosen": [], "identified": [], "offsets": [], "promised": []}
    for seed in range(10):
        drawn = machines.draw(np.random.default_rng(100 + seed))
        errors = machines.machine.error_values(drawn)
        session = simulate_session(quarter, errors, seed=seed).session
        (full, _), (alone, _) = (
            identify(session, m, solver="variable-projection", find_scale=find_tolerance_scale)
            for m in ("full", "offsets")
        )
        tool = find_tool(full)
        entries = compute_entries(full, tool)
        for name, offsets in (
            ("chosen", [e.enter for e in entries]),
            ("identified", [e.identified for e in entries]),
            ("offsets", alone.offsets),
        ):
            left[name].append(error_left(quarter, errors, np.array(offsets), tool.workspace))
        accuracy = assess_placed(full, tool, entries)
        promised = summarise_tool(full, accuracy)
        left["promised"].append(promised.entered)
    rms = {name: np.sqrt(np.mean(np.square(values))) for name, values in left.items()}
    assert rms["chosen"] < 0.9 * rms["identified"]
    assert rms["chosen"] < 0.9 * rms["offsets"]
    # ten machines, a handful of combinations of errors decide each
    assert rms["chosen"] == pytest.approx(rms["promised"], rel=0.3)


@pytest.fixture(scope="module")
def summed(tmp_path_factory, root):
    """The Orthoglide with a sum of all its offsets, of which one names the machine's error."""
    folder = tmp_path_factory.mktemp("summed")
    shutil.copytree(root / "robots/orthoglide", folder / "machine")
    for path in (folder / "machine").glob("orthoglide.*"):
        path.rename(path.with_stem("machine"))
    described = folder / "machine/machine.yaml"
    listed = "  parameters:\n    common: [x_slide.offset, y_slide.offset, -z_slide.offset]\n"
    text = described.read_text().replace("  parameters:\n", listed, 1)
    described.write_text(text.replace("{offset_mm: 10,", "{offset_mm: 0.1,"))  # one by one
    text = (root / "examples/raw-cycles/plan.yaml").read_text()
    (folder / "plan.yaml").write_text(text.replace("robot: orthoglide", "robot: machine"))
    plan = load_plan(folder / "plan.yaml")
    return simulate_session(plan, {"common": 1.4e-3}, seed=1).session


def test_offsets_that_were_identified_as_a_sum_are_entered(summed):
    """Whatever a parameter is called: what it adds to a drive's offset belongs to that drive."""
    result = calibrate(summed, Choice(free=["common"]))
    assert not result.prior  # as with offsets
    entries = {e.drive: e for e in find_entries(result)}
    value, std = result["common"].value, result["common"].std
    assert value == pytest.approx(1.4e-3, abs=4.0 * std)
    for drive, sign in (("x_slide", 1.0), ("y_slide", 1.0), ("z_slide", -1.0)):
        assert entries[drive].enter == pytest.approx(sign * value, rel=1e-12)
        assert entries[drive].std == pytest.approx(std, rel=1e-12)
    assert result.assessment.decision.verdict == "enter"
    assert result.assessment.tool.entered > 0.0


def test_offsets_beside_other_sums_are_entered_too(summed):
    """With lengths free the offsets are chosen at the tool, by the sum as by single ones."""
    result = calibrate(summed, Choice(free=["common", "*_leg.length"]))
    entries = find_entries(result)
    assert [e.drive for e in entries] == ["x_slide", "y_slide", "z_slide"]
    assert all(np.isfinite(e.std) for e in entries)
    assert entries[2].identified == -result["common"].value
