"""Simulated sessions: labelled, repeatable, and with the noise that was asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import marked_pictures
from gauges import exact
from tolerances import KINEMATICS

from orthocal import draw_errors, load_plan, load_session, simulate_session, write_session
from orthocal.errors import ParameterError, SessionError
from orthocal.estimation.problem import build_problem
from orthocal.measurement.motion.motion import plan_motion
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import build_observations
from orthocal.observation.sensor_groups import nuisance_parameters
from orthocal.observation.simulate import collect_errors, load_errors, truth_document
from orthocal.output.sheet.page import sheet_files

ERRORS = {"x_slide.offset": 1.2e-3, "y_slide.offset": -0.8e-3, "z_slide.offset": 0.5e-3}


@pytest.fixture(scope="module")
def plan(root):
    return load_plan(root / "examples/raw-cycles/plan.yaml")


def test_exact_readings_are_the_predictions_from_where_a_setup_begins(plan):
    """A dial is set in the first posture of its setup, wherever in the world that is."""
    simulated = simulate_session(plan, ERRORS, exact=True)
    o = build_observations(plan)
    predicted = predict_readings(plan, ERRORS, observations=o)
    for i, name in enumerate(plan.setups):
        own = o.setup == i
        assert simulated.session.values[own][0] == 0.0
        shown = predicted[own] - predicted[own][0]
        assert np.abs(simulated.session.values[own] - shown).max() < KINEMATICS
        assert simulated.zeros[name] == -predicted[own][0]


def test_a_dial_is_zeroed_in_the_first_posture_also_on_displaced_lines(root):
    """At the coordinate of a line displaced by 20 mm no dial of ±5 mm could be read."""
    lines = load_plan(root / "tests/sessions/lines/plan.yaml")
    session = simulate_session(lines, ERRORS, seed=1).session
    first = {r.setup: r.value for r in reversed(session.readings)}
    assert max(abs(v) for v in first.values()) < 0.25e-3


def test_one_seed_is_one_session_which_states_that_it_is_simulated(plan, tmp_path):
    one, again, other = (simulate_session(plan, ERRORS, seed=s).session for s in (1, 1, 2))
    assert np.array_equal(one.values, again.values)
    assert not np.array_equal(one.values, other.values)
    assert one.title.startswith("Simulated: ")
    assert "Simulated by orthocal, not measured (seed 1)" in one.source
    write_session(simulate_session(plan, ERRORS, seed=np.int64(3)).session, tmp_path)
    assert load_session(tmp_path).seed == 3


def test_noise_zeros_and_rounding_are_as_asked(plan):
    fine = exact(plan).with_gauge(replace(plan.gauge, resolution=None))
    predicted = predict_readings(plan, ERRORS)
    residuals = []
    for seed in range(40):
        simulated = simulate_session(fine, ERRORS, seed=seed)
        zero = np.array([simulated.zeros[r.setup] for r in plan.readings])
        residuals.append(simulated.session.values - predicted - zero)
    spread = np.std(residuals)
    assert abs(spread / 0.01e-3 - 1.0) < 4.0 / np.sqrt(2 * 40 * 54)  # four standard errors
    rounded = simulate_session(plan, ERRORS).session.values / 0.01e-3
    assert np.abs(rounded - np.round(rounded)).max() < 1e-9


def test_the_shipped_session_is_what_its_truth_gives(root, plan):
    """Whoever runs the command in the plan's comment gets the files that are there."""
    errors = load_errors(root / "examples/raw-cycles/machine.yaml", plan.robot)
    simulated = simulate_session(plan, errors, seed=1)
    shipped = load_session(root / "examples/raw-cycles")
    assert np.abs(simulated.session.values - shipped.values).max() < KINEMATICS
    assert truth_document(simulated) == (root / "examples/raw-cycles/truth.yaml").read_text()
    assert load_errors(root / "examples/raw-cycles/truth.yaml", plan.robot) == errors


SEEDS = {"sweep": 2, "workshop": 5, "biglide": 1, "inclined_orthoglide": 1, "linear_delta": 1}


@pytest.mark.parametrize(("name", "seed"), SEEDS.items())
def test_shipped_readings_are_those_of_the_shipped_truth(root, name, seed):
    folder = root / "examples" / name
    plan = load_plan(folder / "plan.yaml")
    nuisance = nuisance_parameters(plan).parameters
    errors = load_errors(folder / "truth.yaml", plan.robot, nuisance)
    if name == "sweep":  # as the comment of its plan states
        errors |= {p.name: 0.0 for p in nuisance}
    simulated = simulate_session(plan, errors, seed=seed).session
    assert f"--seed {seed} " in (folder / "plan.yaml").read_text()
    assert np.abs(simulated.values - load_session(folder).values).max() < KINEMATICS


def test_drawn_errors_have_their_tolerances(orthoglide):
    draws = [draw_errors(orthoglide, ["*", "!frame.*"], seed=s) for s in range(60)]
    scaled = np.array(
        [[v / orthoglide.parameters[n].prior_std for n, v in d.items()] for d in draws]
    )
    assert abs(scaled.std() - 1.0) < 4.0 / np.sqrt(2 * scaled.size)
    assert abs(scaled.mean()) < 4.0 / np.sqrt(scaled.size)


def test_drawn_errors_share_no_numbers_with_noise_and_sensors(plan):
    """With one seed for all, as in `simulate --draw '*' --seed 2`."""
    fine = plan.with_gauge(replace(plan.gauge, resolution=None, range=None))
    names = list(draw_errors(plan.robot, ["*"], seed=0))
    problem = build_problem(fine, free=names, prior=True)
    drawn, sensors, shown = [], [], []
    for seed in range(60):
        errors = draw_errors(plan.robot, ["*"], seed=seed)
        simulated = simulate_session(fine, errors, seed=seed)
        zeros = [simulated.zeros[r.setup] for r in plan.readings]
        drawn.append([errors[n] for n in names])
        sensors.append(list(simulated.nuisance.values()))
        shown.append(simulated.session.values - zeros)
    theta = np.hstack([drawn, sensors])
    noise = (shown - problem.simulate(theta)[0]) / plan.gauge.sigma
    drawn, sensors = np.split(theta / problem.theta_scale, [problem.n_machine], axis=1)
    others = np.hstack([noise, sensors])
    assert min(np.abs(d[:, None] - o).min() for d, o in zip(drawn, others, strict=True)) > 1e-9
    correlations = drawn.T @ others / len(drawn)
    assert np.abs(correlations).max() < 6.0 / np.sqrt(len(drawn))


def test_errors_are_drawn_then_read_then_given(tmp_path, orthoglide):
    file, single = tmp_path / "errors.yaml", ["y_slide.offset_mm=3"]
    file.write_text("errors: {x_slide.offset_mm: 1, y_slide.offset_mm: 2}\n")
    found = collect_errors(orthoglide, file=file, single=single, draw="offsets", seed=4)
    drawn = draw_errors(orthoglide, ["*.offset"], seed=4)["z_slide.offset"]
    assert found == dict(zip(ERRORS, (1e-3, 3e-3, drawn), strict=True))
    with pytest.raises(ParameterError, match="state them by --errors"):
        collect_errors(orthoglide)


def test_errors_may_be_stated_with_blanks(orthoglide):
    """As in the options of `calibrate`."""
    single, draw = ["y_slide.offset_mm = 3"], "x_slide.offset, *_leg.length, !z_leg.*"
    assert list(collect_errors(orthoglide, single=single, draw=draw)) == [
        "x_slide.offset",
        "x_leg.length",
        "y_leg.length",
        "y_slide.offset",
    ]


def test_a_setup_has_the_nuisance_parameter_that_is_stated(plan):
    """The others are drawn as without it."""
    setup = next(iter(plan.setups))
    name = f"setup.{setup}.roll"
    nuisance = nuisance_parameters(plan).parameters
    single = [f"{name}_mrad=200"]
    mounting = collect_errors(plan.robot, single=single, nuisance=nuisance)
    assert mounting == {name: pytest.approx(0.2)}
    stated = simulate_session(plan, {**ERRORS, **mounting}, seed=3)
    drawn = simulate_session(plan, ERRORS, seed=3)
    assert stated.nuisance == {**drawn.nuisance, **mounting}
    assert stated.errors == ERRORS
    of_setup = np.array([r.setup == setup for r in plan.readings])
    changed = stated.session.values != drawn.session.values
    assert changed[of_setup].any()
    assert not changed[~of_setup].any()
    with pytest.raises(ParameterError, match="--error"):
        collect_errors(plan.robot, single=single)


def test_a_gauge_keeps_its_errors_between_sessions(plan, tmp_path):
    """Its scale is that of truth.yaml; setups are mounted anew, and a text goes before the file."""
    first, nuisance = simulate_session(plan, ERRORS, seed=1), nuisance_parameters(plan).parameters
    file = tmp_path / "truth.yaml"
    file.write_text(truth_document(first))
    errors = collect_errors(plan.robot, file=file, nuisance=nuisance)
    second = simulate_session(plan, errors, seed=2)
    drawn = simulate_session(plan, ERRORS, seed=2)
    scale = first.nuisance["gauge.scale"]
    assert second.nuisance["gauge.scale"] == pytest.approx(scale, abs=1e-9)
    others = {k: v for k, v in drawn.nuisance.items() if k != "gauge.scale"}
    assert {k: v for k, v in second.nuisance.items() if k != "gauge.scale"} == others
    single = ["gauge.scale_ppm=500"]
    assert collect_errors(plan.robot, file=file, single=single, nuisance=nuisance)[
        "gauge.scale"
    ] == pytest.approx(500e-6)
    assert "gauge.scale" not in collect_errors(plan.robot, file=file)  # a study has no gauge


def test_readings_beyond_the_gauge_are_refused(plan):
    with pytest.raises(SessionError, match=r"the simulated reading .* the gauge's range ends at"):
        simulate_session(plan, {"x_slide.offset": 25e-3, "y_slide.offset": -25e-3})


def test_a_dial_is_set_so_that_all_readings_are_within_its_range(plan):
    """The range is 0.1 mm larger than the readings need; a usual setting is within 0.2 mm of 0."""
    exact_plan = predict_readings(plan, ERRORS)
    setups = [r.setup for r in plan.readings]
    apart = exact_plan - [exact_plan[setups.index(name)] for name in setups]
    half = np.abs(apart).max() + 0.1e-3
    narrow = plan.with_gauge(replace(plan.gauge, range=(-half, half)))
    for seed in range(20):
        assert np.abs(simulate_session(narrow, ERRORS, seed=seed).session.values).max() <= half


def test_a_dial_is_set_to_the_middle_of_its_range(plan):
    """A dial of 0 to 10 mm is set to 5 mm, as the sheet says; ±5 mm remain to either side."""
    dials = [replace(plan.gauge, range=limits) for limits in ((-5e-3, 5e-3), (0.0, 10e-3))]
    plans = [plan.with_gauge(dial) for dial in dials]
    symmetric, shifted = (simulate_session(p, {}, exact=True).session.values for p in plans)
    assert shifted == pytest.approx(symmetric + 5e-3, abs=KINEMATICS)
    stops = [[s for motion in plan_motion(p) for s in motion.stops] for p in plans]
    for symmetric_stop, stop in zip(*stops, strict=True):
        assert stop.expected == pytest.approx(symmetric_stop.expected + 5e-3, abs=KINEMATICS)
        assert stop.lift == symmetric_stop.lift
    with marked_pictures():
        assert "the hand must return to 5 within" in sheet_files(plans[1])["sheet.html"]


def test_errors_are_drawn_with_the_tolerances_given(orthoglide):
    patterns = ["*.offset", "x_coupler.*"]
    own = draw_errors(orthoglide, patterns, seed=4)
    other = draw_errors(orthoglide, patterns, seed=4, tolerances={"*.offset_m": 4e-3})
    for name, value in own.items():
        factor = 0.4 if name.endswith(".offset") else 1.0
        assert other[name] == pytest.approx(factor * value)


def test_a_simulated_session_states_that_it_is_simulated(plan):
    session = simulate_session(plan, ERRORS, seed=5).session
    assert session.title.startswith("Simulated: ")
    assert "Simulated by orthocal, not measured (seed 5)" in session.source
