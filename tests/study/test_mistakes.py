"""The main loop to its end: what a machine shows whose offsets were entered, rightly or wrongly."""

from __future__ import annotations

import numpy as np
import pytest
from fleets import Fleet

from orthocal import calibrate, load_plan, simulate_session, summarize, validate_calibration
from orthocal.study.entering import entered_offsets, find_entries
from orthocal.study.mistakes import MULTIPLES, find_mistake


@pytest.fixture(scope="module")
def plan(root):
    return load_plan(root / "examples/raw-cycles/plan.yaml")


@pytest.fixture(scope="module")
def machines(plan):
    """Errors of three machines with all errors at tolerance, and what was identified of each."""
    fleet, found = Fleet(plan), []
    for seed in range(3):
        drawn = fleet.draw(np.random.default_rng(40 + seed))
        # offsets that differ clearly between the drives
        drawn[fleet.is_offset] = np.roll([1.4e-3, -0.9e-3, 0.7e-3], seed)
        errors = dict(zip(fleet.machine.free, drawn, strict=True))
        found.append((errors, calibrate(simulate_session(plan, errors, seed=seed).session)))
    return found


@pytest.mark.parametrize("machine", range(3))
@pytest.mark.parametrize(
    ("kind", "drives"),
    [
        (None, ()),
        ("not entered", (0, 1, 2)),
        ("wrong sign", (0, 1, 2)),
        ("entered twice", (0, 1, 2)),
        ("not entered", (0,)),
        ("not entered", (1, 2)),
        ("wrong sign", (1,)),
        ("entered twice", (2,)),
    ],
)
def test_what_went_wrong_in_entering_is_named(plan, machines, machine, kind, drives):
    errors, calibration = machines[machine]
    right = entered_offsets(calibration)
    active = right.copy()
    for i in drives:
        active[i] -= MULTIPLES[kind] * right[i]
    measured = simulate_session(plan.with_controller(active), errors, seed=7).session
    # what was read, with the session saying that all was entered as identified
    session = plan.with_controller(right).with_values(measured.values)
    result = validate_calibration(calibration, session)
    text = " ".join(summarize(result).split())
    assert "Check the signs" not in text
    if kind is None:
        assert result.mistake is None
        assert result.confirmed
        return
    names = [d.name for d in plan.robot.drives]
    assert result.confirmed is False
    assert result.mistake.kind == kind
    assert result.mistake.drives == tuple(names[i] for i in drives)
    assert result.mistake.active == pytest.approx(active, abs=1e-9)
    assert result.mistake.rms < 2.0 * calibration.rms_after
    # what to do: the identified offsets, whole
    assert "What belongs into the controller" in text
    for entry, said in zip(find_entries(calibration), result.enter, strict=True):
        assert said.enter == entry.enter
        assert f"{entry.enter * 1e3:+.3f}" in text
    words = {"not entered": "were not entered", "wrong sign": "with the wrong sign"}
    assert words.get(kind, "were entered twice") in text


def test_a_machine_that_has_changed_is_no_mistake_of_entering(plan, machines):
    errors, calibration = machines[0]
    right = entered_offsets(calibration)
    changed = {**errors, "y_slide.offset": errors["y_slide.offset"] + 0.37e-3}
    session = simulate_session(plan.with_controller(right), changed, seed=3).session
    result = validate_calibration(calibration, session)
    assert result.confirmed is False
    assert result.mistake is None
    text = " ".join(summarize(result).split())
    assert "no mistake in entering the offsets explains it" in text
    assert "Calibrate again from this session" in text
    entered = {e.drive: e.enter for e in result.enter}
    assert entered["y_slide"] - right[1] == pytest.approx(0.37e-3, abs=0.05e-3)


def test_a_mistake_solved_by_hand():
    """Two drives, each seen by itself: the second was entered with its sign turned."""
    slopes = np.array([[1.0, 0.0], [0.0, 2.0], [0.0, -2.0]])
    change = np.array([1.0, 3.0])
    found = find_mistake(
        slopes @ [0.0, 6.0],
        slopes,
        change,
        entered=change,
        names=("a", "b"),
        rounding=np.zeros(2),
    )
    assert (found.kind, found.drives, found.all_drives) == ("wrong sign", ("b",), False)
    assert found.active == pytest.approx([1.0, -3.0])
    assert found.rms == pytest.approx(0.0, abs=1e-12)
    elsewhere = np.array([0.5, -4.0, -4.0])
    assert (
        find_mistake(
            elsewhere, slopes, change, entered=change, names=("a", "b"), rounding=np.zeros(2)
        )
        is None
    )
