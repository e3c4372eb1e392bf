"""Calibrations as records and files: noise, uncertainties, and the machine."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import closed_form
import numpy as np
import pytest
from calibrated import UNJUDGED, calibrated, identified, plan_of, session_of
from models import TRUTH
from tolerances import CLOSED_FORM, KINEMATICS

from orthocal import (
    Choice,
    Machine,
    calibrate,
    load_calibration,
    parameter_table,
    simulate_session,
    summarize,
    write_report,
)
from orthocal.assessment.controller_entries import find_entries
from orthocal.calibration.file import calibration_document, calibration_json, write_calibration
from orthocal.calibration.identify import identify
from orthocal.errors import ClosureError, OrthocalError, ParameterError
from orthocal.statistics.chance import COVERAGE, confidence_factor

QUICK = {"solver": "variable-projection"}


@pytest.fixture(scope="module")
def result():
    return calibrated("raw-cycles")


def test_a_loaded_calibration_is_the_written_one(tmp_path):
    calibration = calibrated("table1/experiment-2")
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


def test_the_file_has_the_documented_keys(result):
    document = json.loads(calibration_json(result))
    assert document["schema"] == "orthocal/calibration/18"
    keys = "robot session model solver parameters model_covariance noise_covariance versions "
    keys += "scaled_covariance sigma dof rms_before rms_after residuals"
    of_parameter = "name unit value std std_scatter std_scaled prior_std scaled free resolvable"
    of_row = "setup posture minus cycle measured nominal predicted residual"
    for part, expected in (
        (document, keys),
        (document["parameters"][0], of_parameter),
        (document["residuals"][0], of_row),
    ):
        assert set(expected.split()) <= set(part)
    assert len(document["robot"]["sha256"]) == 64
    assert document["solver"]["name"] == "ipopt"


def test_measured_is_prediction_and_residual(result, raw_cycles):
    for row, reading in zip(result.residuals, raw_cycles.readings, strict=True):
        assert row.measured == reading.value
        assert row.predicted + row.residual == pytest.approx(reading.value, abs=1e-15)
    assert result.rms_after < result.rms_before
    by_setup = {}
    for row in result.residuals:
        by_setup.setdefault(row.setup, []).append(row.residual)
    assert all(abs(sum(v)) < 1e-12 for v in by_setup.values())  # by the best zeros


def test_forward_and_inverse_are_those_of_the_identified_machine(result):
    offsets = [result[f"{k}_slide.offset"].value for k in "xyz"]
    points = np.random.default_rng(0).uniform(-0.08, 0.05, (20, 3))
    joints = closed_form.inverse(points, length=0.31025, offsets=offsets)
    assert np.abs(result.machine.forward(joints) - points).max() < CLOSED_FORM
    assert np.abs(result.machine.inverse(points) - joints).max() < CLOSED_FORM


def test_offsets_to_enter_include_the_active_ones():
    active = np.array([1e-3, 0.0, 0.4e-3])
    plan = plan_of("raw-cycles").with_controller(active)
    session = simulate_session(plan, TRUTH, exact=True).session
    entries = find_entries(identified(session))
    assert [e.active for e in entries] == pytest.approx(active)
    assert [e.enter for e in entries] == pytest.approx(list(TRUTH.values()), abs=1e-9)
    assert [e.change for e in entries] == pytest.approx(
        np.array(list(TRUTH.values())) - active, abs=1e-9
    )


def test_without_stated_offsets_the_changes_are_entered():
    entries = find_entries(calibrated("table1/experiment-3"))
    assert all(e.active is None for e in entries)
    assert entries[1].enter == entries[1].change


def test_without_redundant_readings_sigma_is_that_of_the_gauge(experiment_2):
    chosen = {"yx", "xy", "xz"}
    few = experiment_2.select([r for r in experiment_2.readings if r.setup in chosen])
    result = identified(few)
    assert result.noise.source == "gauge"
    assert math.isinf(result.dof)
    assert result.sigma == pytest.approx(math.hypot(0.02e-3, 0.01e-3 / math.sqrt(12.0)) * 2**0.5)
    silent = identified(few.with_gauge(replace(few.gauge, sigma=None)))
    assert silent.noise.source == "unknown"
    assert math.isnan(silent.free[0].std)


def test_exact_readings_give_the_true_offsets():
    result = identified(simulate_session(plan_of("raw-cycles"), TRUTH, exact=True).session)
    assert np.abs([p.value - TRUTH[p.name] for p in result.free]).max() < 1e-9
    assert result.rms_after < 1e-12


def test_with_priors_sigma_and_solution_agree():
    """Readings with a noise of 50 µm, stated as 5 µm: the residuals decide."""
    plan = plan_of("raw-cycles")
    plan = plan.select([r for r in plan.readings if r.cycle == 1])
    plan = plan.with_gauge(replace(plan.gauge, sigma=5e-6, resolution=None))
    session = simulate_session(plan, {**TRUTH, "x_leg.length": 2e-4}, seed=2, sigma=50e-6).session
    result = identified(session, "lengths")
    assert result.noise.source == "residuals"
    assert 25e-6 < result.sigma < 100e-6
    assert result.prior


def test_an_unknown_parameter_is_a_key_error(result):
    with pytest.raises(KeyError, match=r"x_slide\.ofset; did you mean x_slide\.offset"):
        result["x_slide.ofset"]


def test_the_uncertainty_of_an_entry_has_all_parts():
    """Scatter, mounting of the gauges, and unmodelled errors at their tolerances."""
    result = identified(session_of("sweep"), "offsets")
    bias = np.diag(result.unmodelled.bias_covariance)
    variance = np.diag(result.model_covariance)
    for entry, fitted, unmodelled in zip(find_entries(result), variance, bias, strict=True):
        assert entry.std == pytest.approx(np.sqrt(fitted + unmodelled))
        assert entry.std_scatter**2 < fitted
        assert entry.std > 10.0 * entry.std_scatter
        assert entry.held is None


def test_all_outputs_state_the_same_standard_deviation():
    """Table, file, value to enter and the printed ± of the paper's Experiment 2."""
    result = calibrated("table1/experiment-2")
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


def test_offsets_at_a_bound_or_with_a_known_value_are_not_significant(experiment_2):
    bounded = calibrate(
        experiment_2,
        Choice(bounds={"x_slide.offset_m": (-0.2e-3, 2e-3)}, known={"y_slide.offset_m": 0.5e-3}),
        **UNJUDGED,
    )
    held = {e.drive: e.held for e in find_entries(bounded)}
    assert held == {"x_slide": "lower bound", "y_slide": "known", "z_slide": None}
    text = summarize(bounded, details=True)
    rows = {line.split()[0]: line for line in text.splitlines() if line.strip()}
    assert "lower bound" in rows["x_slide"]
    assert "known" in rows["y_slide"]
    judged = bounded.assessment.of_kind("must change", "not significant", "no change needed")
    assert {p.parameter for f in judged for p in f.places} == {"z_slide"}


def test_students_factor_applies_to_the_scaled_prior(experiment_2):
    """Three contrasts determine its scale; noise and the prior of offsets are as stated."""
    result = calibrate(experiment_2, "lengths", **QUICK)
    half = dict(zip([p.name for p in result.free], result.expanded_uncertainties, strict=True))
    factor = confidence_factor(result.tolerance_scale.contrasts)
    assert half["x_leg.length"] == pytest.approx(factor * result["x_leg.length"].std, rel=0.02)
    offset = result["x_slide.offset"]
    rest = offset.std**2 - offset.std_scatter**2 - offset.std_scaled**2
    assert offset.std_scatter > 0.0
    assert rest > 0.0
    expected = math.hypot(2.0 * offset.std_scatter, factor * offset.std_scaled, 2.0 * rest**0.5)
    assert half["x_slide.offset"] == pytest.approx(expected, rel=1e-12)


@pytest.mark.usefixtures("without_sensor_gains")
def test_cycles_that_are_all_equal_scatter_by_the_resolution(raw_cycles):
    first = {(r.setup, r.posture): r.value for r in raw_cycles.readings if r.cycle == 1}
    values = [first[r.setup, r.posture] for r in raw_cycles.readings]
    for model in ("offsets", "full"):
        result = identified(raw_cycles.with_values(values), model)
        assert result.noise.cycles_sigma == pytest.approx(0.01e-3 / np.sqrt(12.0))
        assert np.isfinite(result.total_covariance).all()
    result = calibrate(raw_cycles.with_values(values), "offsets", **UNJUDGED)
    assert "unknown" not in summarize(result, details=True)
    zero, _ = identify(raw_cycles.with_values(np.zeros(len(values))), "full", **QUICK)
    assert zero["x_slide.offset"].std > 0.1e-3  # inseparable from other errors


def test_one_free_parameter_alone(experiment_2):
    rows = experiment_2.readings[:1]
    result = identified(replace(experiment_2, readings=rows), Choice(base=True))
    assert len(result.free) == 1
    assert np.isfinite(result.total_covariance).all()


def test_coordinates_beyond_the_travel_are_refused():
    machine = calibrated("table1/experiment-2").machine
    with pytest.raises(ClosureError, match="x_slide_mm is 391; the drive reaches from 120 to 390"):
        machine.forward([0.391, 0.31, 0.31])
    with pytest.raises(ClosureError, match="posture 'posture 1' z_slide_mm is 391"):
        machine.forward([[0.31, 0.31, 0.391], [0.391, 0.31, 0.31]])
    with pytest.raises(ValueError, match="found 1 names for 2 rows"):
        machine.forward([[0.31, 0.31, 0.31]] * 2, names=["a"])


def test_unknown_errors_of_a_machine_are_refused(orthoglide):
    with pytest.raises(ParameterError, match=r"x_slide\.offsett.*x_slide\.offset"):
        Machine(orthoglide, {"x_slide.offsett": 1e-3})


def test_records_are_shown_in_a_line(result):
    """As the last line of a notebook's cell shows them."""
    shown = [repr(record) for record in (result, session_of("raw-cycles"), result.robot)]
    words = ("model 'offsets', 54 readings", "54 readings in 6 setups", "x_slide, y_slide, z_slide")
    assert all(word in text for word, text in zip(words, shown, strict=True))
    assert max(map(len, shown)) < 100


def test_readings_are_not_overwritten_by_results(tmp_path):
    result = calibrated("raw-cycles")
    readings = tmp_path / "readings.csv"
    readings.write_text("mine")
    for write, suffix in ((write_calibration, ".json"), (write_report, ".html")):
        with pytest.raises(OrthocalError, match=f"expected a name with {suffix}"):
            write(result, readings)
    assert readings.read_text() == "mine"
