"""The main loop to its end: what a machine shows whose offsets were entered, rightly or wrongly."""

from __future__ import annotations

import numpy as np
import pytest
from fleets import Fleet

from orthocal import (
    Choice,
    calibrate,
    draw_errors,
    load_plan,
    simulate_session,
    summarize,
    validate_calibration,
)
from orthocal.assessment.controller_entries import entered_offsets, find_entries
from orthocal.assessment.entry_mistakes import find_mistake


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
        errors = fleet.machine.split_errors(drawn)
        session = simulate_session(plan, errors, seed=seed).session
        found.append((errors, calibrate(session, solver="eliminated")))
    return found


BEFORE = np.array([-0.5e-3, -1.0e-3, 0.3e-3])
"""Offsets that are active already when a machine is calibrated for the second time."""


@pytest.fixture(scope="module")
def second_round(plan, machines):
    """The same machines, measured with other offsets in the controller than none."""
    return [
        (errors, calibrate(simulate_session(plan.with_controller(BEFORE), errors, seed=i).session))
        for i, (errors, _) in enumerate(machines)
    ]


# what is in the controller instead of E, where A were active and I were identified
SLIPS = {
    "right": (None, lambda e, a: e),
    "left as it was": ("not entered", lambda e, a: a),
    "left at nothing": ("not entered", lambda e, a: 0.0 * e),
    "sign": ("wrong sign", lambda e, a: -e),
    "change with its sign turned": ("wrong sign", lambda e, a: 2.0 * a - e),
    "twice": ("entered twice", lambda e, a: 2.0 * e),
    "on top": ("entered twice", lambda e, a: a + e),
    "change on top": ("entered twice", lambda e, a: 2.0 * e - a),
    "turned about": ("interchanged", lambda e, a: e[[1, 2, 0]]),
}


WHERE = [(0, False, (0, 1, 2)), (1, True, (0, 1, 2)), (2, True, (1,)), (0, True, (0, 2))]
"""Machine, whether in the second round, and the drives that the slip is of."""


@pytest.mark.parametrize(
    ("machine", "again", "drives", "slip"),
    [
        (*where, slip)
        for where in WHERE
        for slip in SLIPS
        if slip != "turned about" or len(where[2]) == 3  # takes all three
    ],
)
def test_what_went_wrong_in_entering_is_named(
    plan, machines, second_round, machine, again, slip, drives
):
    kind, enter = SLIPS[slip]
    errors, calibration = (second_round if again else machines)[machine]
    before = BEFORE if again else np.zeros(3)
    right = entered_offsets(calibration)
    active = right.copy()
    active[list(drives)] = enter(right, before)[list(drives)]
    measured = simulate_session(plan.with_controller(active), errors, seed=7).session
    # what was read, with the session saying that all was entered as identified
    session = plan.with_controller(right).with_values(measured.values)
    result = validate_calibration(calibration, session)
    text = " ".join(summarize(result).split())
    if np.abs(active - right).max() < 1e-9:
        assert result.mistake is None
        assert result.confirmed
        return
    names = [d.name for d in plan.robot.drives]
    assert result.confirmed is False
    assert result.mistake.active == pytest.approx(active, abs=0.03e-3)
    assert result.mistake.rms < 2.0 * calibration.rms_after
    # two ways to one number, or a number that is another drive's, cannot be told apart
    assert result.mistake.kind == kind or _is_alike(right, before, active, result.mistake.kind)
    if result.mistake.kind == kind:
        assert set(result.mistake.drives) == {names[i] for i in drives if active[i] != right[i]}
    # what to do: the identified offsets, whole
    assert "What belongs into the controller" in text
    for entry, said in zip(find_entries(calibration), result.enter, strict=True):
        assert said.enter == entry.enter
        assert f"{entry.enter * 1e3:+.3f}" in text


def _is_alike(right, before, active, kind):
    """Whether a slip of another kind leaves nearly the same in the controller."""
    ways = [w(right, before) for k, w in SLIPS.values() if k == kind]
    return all(
        abs(active[i] - right[i]) < 0.05e-3 or any(abs(active[i] - w[i]) < 0.05e-3 for w in ways)
        for i in range(3)
    )


@pytest.mark.slow
def test_of_readings_of_rods_too(root):
    """Eighteen readings by a ball, all errors identified: few, yet each mistake is named."""
    plan = load_plan(root / "examples/workshop/plan.yaml")
    tolerances = {"*.offset_mm": 2.0}
    for seed in (0, 1, 5):
        errors = draw_errors(plan.robot, ["*"], seed=seed, tolerances=tolerances)
        session = simulate_session(plan, errors, seed=seed).session
        choice = Choice("full", tolerances=tolerances)
        calibration = calibrate(session, choice, solver="eliminated")
        right = entered_offsets(calibration)
        for slip in ("right", "left as it was", "sign", "twice"):
            kind, enter = SLIPS[slip]
            entered = plan.with_controller(enter(right, np.zeros(3)))
            measured = simulate_session(entered, errors, seed=1000 + seed).session
            claimed = plan.with_controller(right).with_values(measured.values)
            found = validate_calibration(calibration, claimed)
            assert found.confirmed is (slip == "right"), (seed, slip)
            assert (found.mistake and found.mistake.kind) == kind, (seed, slip)


def test_the_column_beside_it(plan, machines):
    """The identified offsets of a full model, entered instead of those that belong there."""
    errors, _ = machines[0]
    session = simulate_session(plan, errors, seed=3).session
    calibration = calibrate(session, "full")
    entries = find_entries(calibration)
    identified = np.array([e.identified for e in entries])
    right = entered_offsets(calibration)
    assert np.abs(identified - right).max() > 0.1e-3
    measured = simulate_session(plan.with_controller(identified), errors, seed=4).session
    claimed = plan.with_controller(right).with_values(measured.values)
    found = validate_calibration(calibration, claimed).mistake
    assert found.kind == "identified"
    assert found.active == pytest.approx(identified, abs=0.05e-3)


def test_a_machine_that_has_changed_is_no_mistake_of_entering(plan, machines):
    errors, calibration = machines[0]
    right = entered_offsets(calibration)
    changed = {**errors, "y_slide.offset": errors["y_slide.offset"] + 0.37e-3}
    session = simulate_session(plan.with_controller(right), changed, seed=3).session
    result = validate_calibration(calibration, session)
    assert result.confirmed is False
    assert (result.mistake.kind, result.mistake.drives) == ("one differs", ("y_slide",))
    assert result.mistake.by == pytest.approx([-0.37e-3], abs=0.05e-3)
    (found,) = result.assessment.of_kind("one drive differs")
    assert [p.parameter for p in found.places] == ["y_slide"]
    assert found.text in " ".join(summarize(result).split())
    entered = {e.drive: e.enter for e in result.enter}
    assert entered["y_slide"] - right[1] == pytest.approx(0.37e-3, abs=0.05e-3)


def test_a_mistake_solved_by_hand():
    """Two drives, each seen by itself: the second was entered with its sign turned."""
    slopes = np.array([[1.0, 0.0], [0.0, 2.0], [0.0, -2.0]])
    change = np.array([1.0, 3.0])
    known = {
        "spread": np.zeros((3, 1)),
        "sigma": 0.01,
        "model_sigma": 0.01,
        "model_dof": 1e6,
        "dof": 3,
        "before": np.zeros(2),
        "identified": change,
        "entered": change,
        "names": ("a", "b"),
        "rounding": np.full(2, 1e-9),
    }

    def find(missing):
        return find_mistake(lambda c: slopes @ (missing - (change - c)), slopes, **known)

    found = find([0.0, 6.0])
    assert (found.kind, found.drives, found.all_drives) == ("wrong sign", ("b",), False)
    assert found.active == pytest.approx([1.0, -3.0])
    assert found.by == pytest.approx([-6.0])
    assert found.rms == pytest.approx(0.0, abs=1e-12)
    # one drive by itself, and two at once that no slip explains
    found = find([0.4, 0.0])
    assert (found.kind, found.drives) == ("one differs", ("a",))
    assert found.by == pytest.approx([-0.4])
    assert find([1.7, -1.1]) is None
