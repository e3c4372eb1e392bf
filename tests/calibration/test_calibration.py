"""The result as an object and as a file; the sigma rounds beside a prior."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from tolerances import CLOSED_FORM, KINEMATICS

from orthocal import (
    Choice,
    calibrate,
    load_calibration,
    load_plan,
    load_session,
    parameter_table,
    simulate_session,
    summarize,
)
from orthocal.assessment.controller_entries import find_entries
from orthocal.calibration.file import calibration_document, calibration_json, write_calibration
from orthocal.errors import ClosureError
from orthocal.kinematics import orthoglide as closed_form
from orthocal.statistics.chance import COVERAGE, confidence_factor

TRUTH = {"x_slide.offset": 1.2e-3, "y_slide.offset": -0.8e-3, "z_slide.offset": 0.5e-3}


@pytest.fixture(scope="module")
def result(raw_cycles):
    return calibrate(raw_cycles)


@pytest.mark.parametrize("model", ["offsets", "lengths"])
@pytest.mark.parametrize("example", ["raw-cycles", "table1/experiment-2", "table1/experiment-3"])
def test_the_file_gives_the_same_object_back(root, tmp_path, example, model):
    calibration = calibrate(load_session(root / "examples" / example), model)
    again = load_calibration(write_calibration(calibration, tmp_path / "calibration.json"))
    assert calibration_document(again) == calibration_document(calibration)
    assert calibration_json(again) == calibration_json(calibration)
    assert [p.name for p in again.free] == [p.name for p in calibration.free]
    assert np.array_equal(again.total_covariance, calibration.total_covariance)
    joints = np.full(3, 0.31)
    assert (
        np.abs(again.machine.forward(joints) - calibration.machine.forward(joints)).max()
        < KINEMATICS
    )


def test_the_file_has_what_was_promised(result):
    document = json.loads(calibration_json(result))
    assert document["schema"] == "orthocal/calibration/11"
    assert {
        "robot",
        "session",
        "model",
        "solver",
        "parameters",
        "model_covariance",
        "noise_covariance",
        "scaled_covariance",
        "sigma",
        "dof",
        "rms_before",
        "rms_after",
        "residuals",
        "versions",
    } <= set(document)
    assert {
        "name",
        "unit",
        "value",
        "std",
        "std_scatter",
        "std_scaled",
        "prior_std",
        "scaled",
        "free",
        "identifiable",
    } <= set(document["parameters"][0])
    assert {
        "setup",
        "posture",
        "minus",
        "cycle",
        "measured",
        "nominal",
        "predicted",
        "residual",
    } <= set(document["residuals"][0])
    assert len(document["robot"]["sha256"]) == 64
    assert document["solver"]["name"] == "ipopt"


def test_the_truth_is_within_its_interval(result):
    for p in result.free:
        assert abs(p.value - TRUTH[p.name]) < confidence_factor(result.dof) * p.std


def test_measured_is_prediction_and_residual(result, raw_cycles):
    for row, reading in zip(result.residuals, raw_cycles.readings, strict=True):
        assert row.measured == reading.value
        assert row.predicted + row.residual == pytest.approx(reading.value, abs=1e-15)
    assert result.rms_after < result.rms_before
    by_setup = {}
    for row in result.residuals:
        by_setup.setdefault(row.setup, []).append(row.residual)
    assert all(abs(sum(v)) < 1e-12 for v in by_setup.values())  # best zeros leave no mean


def test_forward_and_inverse_are_those_of_the_machine_found(result):
    offsets = [result[f"{k}_slide.offset"].value for k in "xyz"]
    points = np.random.default_rng(0).uniform(-0.08, 0.05, (20, 3))
    joints = closed_form.inverse(points, length=0.31025, offsets=offsets)
    assert np.abs(result.machine.forward(joints) - points).max() < CLOSED_FORM
    assert np.abs(result.machine.inverse(points) - joints).max() < CLOSED_FORM


def test_the_controller_is_told_the_whole_offset_and_the_change(root):
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    active = np.array([1e-3, 0.0, 0.4e-3])
    postures = {n: replace(p, drives=p.drives - active) for n, p in plan.postures.items()}
    plan = replace(plan, postures=postures, controller_offsets=active)
    session = simulate_session(plan, TRUTH, exact=True).session
    entries = find_entries(calibrate(session))
    assert [e.active for e in entries] == pytest.approx(active)
    assert [e.enter for e in entries] == pytest.approx(list(TRUTH.values()), abs=1e-9)
    assert [e.change for e in entries] == pytest.approx(
        np.array(list(TRUTH.values())) - active, abs=1e-9
    )


def test_an_unknown_controller_is_told_what_to_add(root):
    entries = find_entries(calibrate(load_session(root / "examples/table1/experiment-3")))
    assert all(e.active is None for e in entries)
    assert entries[1].enter == entries[1].change


def test_as_many_parameters_as_readings_leave_sigma_to_the_gauge(experiment_2):
    chosen = {"yx", "xy", "xz"}
    few = replace(
        experiment_2, readings=tuple(r for r in experiment_2.readings if r.setup in chosen)
    )
    result = calibrate(few)
    assert result.noise.source == "gauge"
    assert math.isinf(result.dof)
    assert result.sigma == pytest.approx(math.hypot(0.02e-3, 0.01e-3 / math.sqrt(12.0)) * 2**0.5)
    silent = calibrate(few.with_gauge(replace(few.gauge, sigma=None)))
    assert silent.noise.source == "unknown"
    assert math.isnan(silent.free[0].std)


def test_perfect_readings_leave_nothing(root):
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    result = calibrate(simulate_session(plan, TRUTH, exact=True).session)
    assert np.abs([p.value - TRUTH[p.name] for p in result.free]).max() < 1e-9
    assert result.rms_after < 1e-12


def test_beside_a_prior_sigma_is_settled_with_the_solution(root):
    """Readings of 50 µm said to be of 5: the residuals win, and the weights with them."""
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    rows = tuple(r for r in plan.readings if r.cycle == 1)
    plan = replace(plan, readings=rows).with_gauge(replace(plan.gauge, sigma=5e-6, resolution=None))
    session = simulate_session(plan, {**TRUTH, "x_leg.length": 2e-4}, seed=2, sigma=50e-6).session
    result = calibrate(session, "lengths")
    assert result.noise.source == "residuals"
    assert 25e-6 < result.sigma < 100e-6
    assert result.prior


def test_an_unknown_parameter_is_a_key_error(result):
    with pytest.raises(KeyError):
        result["w_slide.offset"]


def test_every_doubt_of_an_offset_is_in_what_is_entered(root):
    """Scatter, mounting of the gauges, and errors that were left out, at their tolerances."""
    result = calibrate(load_session(root / "examples/sweep"), "offsets")
    bias = np.diag(result.unmodelled.bias_covariance)
    variance = np.diag(result.model_covariance)
    for entry, known, own in zip(find_entries(result), variance, bias, strict=True):
        assert entry.std == pytest.approx(np.sqrt(known + own))
        assert entry.std_scatter**2 < known
        assert entry.std > 10.0 * entry.std_scatter
        assert entry.held is None


def test_an_offset_has_one_standard_deviation_everywhere(experiment_2):
    """Table, file, value to enter and the printed ± agree for the paper's Experiment 2."""
    result = calibrate(experiment_2)
    document = json.loads(calibration_json(result))
    table = {p["name"]: p for p in parameter_table(result)}
    in_file = {p["name"]: p for p in document["parameters"]}
    entries = {e["drive"]: e for e in document["assessment"]["entries"]}
    printed = {cells[0]: cells for cells in map(str.split, summarize(result).splitlines()) if cells}
    factor = confidence_factor(result.tolerance_scale.contrasts)
    for i, drive in enumerate(("x_slide", "y_slide", "z_slide")):
        found = table[f"{drive}.offset"]
        std, scatter, scaled = found["std"], found["std_scatter"], found["std_scaled"]
        assert 0.0 < scatter < scaled < std
        assert std == pytest.approx(result.standard_deviations[i], rel=1e-12)
        for other in (in_file[f"{drive}.offset"], entries[drive]):
            assert other["std"] == pytest.approx(std, rel=1e-12)
            assert other["std_scatter"] == pytest.approx(scatter, rel=1e-12)
            assert other["std_scaled"] == pytest.approx(scaled, rel=1e-12)
        rest = math.sqrt(std**2 - scatter**2 - scaled**2)
        half = math.hypot(COVERAGE * scatter, factor * scaled, COVERAGE * rest)
        assert float(printed[drive][-2]) == pytest.approx(half * 1e3, abs=0.5e-3)
        assert (found["high"] - found["low"]) / 2 == pytest.approx(half, rel=1e-9)


def test_what_a_bound_or_a_known_value_holds_is_not_proved(experiment_2):
    bounded = calibrate(
        experiment_2,
        Choice(bounds={"x_slide.offset_m": (-0.2e-3, 2e-3)}, known={"y_slide.offset_m": 0.5e-3}),
    )
    held = {e.drive: e.held for e in find_entries(bounded)}
    assert held == {"x_slide": "lower bound", "y_slide": "known", "z_slide": None}
    text = summarize(bounded, details=True)
    rows = {line.split()[0]: line for line in text.splitlines() if line.strip()}
    assert "lower bound" in rows["x_slide"]
    assert "known" in rows["y_slide"]
    judged = bounded.assessment.of_kind("must change", "not significant", "no change needed")
    assert {p.parameter for f in judged for p in f.places} == {"z_slide"}


def test_students_factor_counts_for_what_the_readings_told(experiment_2):
    """Three contrasts determine the scale of a prior; noise and the prior of offsets are stated."""
    result = calibrate(experiment_2, "lengths")
    half = dict(zip([p.name for p in result.free], result.expanded_uncertainties, strict=True))
    factor = confidence_factor(result.tolerance_scale.contrasts)
    assert half["x_leg.length"] == pytest.approx(factor * result["x_leg.length"].std, rel=0.02)
    offset = result["x_slide.offset"]
    rest = offset.std**2 - offset.std_scatter**2 - offset.std_scaled**2
    assert offset.std_scatter > 0.0
    assert rest > 0.0
    expected = math.hypot(2.0 * offset.std_scatter, factor * offset.std_scaled, 2.0 * rest**0.5)
    assert half["x_slide.offset"] == pytest.approx(expected, rel=1e-12)


def test_cycles_that_are_all_equal_scatter_by_the_resolution(raw_cycles):
    first = {(r.setup, r.posture): r.value for r in raw_cycles.readings if r.cycle == 1}
    values = [first[r.setup, r.posture] for r in raw_cycles.readings]
    for model in ("offsets", "full"):
        result = calibrate(raw_cycles.with_values(values), model)
        assert result.noise.cycles_sigma == pytest.approx(0.01e-3 / np.sqrt(12.0))
        assert np.isfinite(result.total_covariance).all()
        assert "unknown" not in summarize(result, details=True)
    zero = calibrate(raw_cycles.with_values(np.zeros(len(values))), "full")
    assert zero["x_slide.offset"].std > 0.1e-3  # one with other errors, as its tolerance says


def test_one_free_parameter_alone(experiment_2):
    rows = experiment_2.readings[:1]
    result = calibrate(replace(experiment_2, readings=rows), Choice(base=True))
    assert len(result.free) == 1
    assert np.isfinite(result.total_covariance).all()


def test_the_machine_goes_no_further_than_its_drives(experiment_2):
    machine = calibrate(experiment_2).machine
    with pytest.raises(ClosureError, match="x_slide_mm is 391; the drive reaches from 120 to 390"):
        machine.forward([0.391, 0.31, 0.31])
