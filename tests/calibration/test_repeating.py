"""Calibrations repeated from their files, checks of the files, and tables."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil

import pytest
from calibrated import UNJUDGED, calibrated, session_of

from orthocal import (
    Choice,
    load_calibration,
    parameter_table,
    reading_table,
    repeat_calibration,
    restore_session,
    write_calibration,
)
from orthocal.calibration.file import calibration_document
from orthocal.calibration.identify import identify
from orthocal.calibration.refit import restore_covariances
from orthocal.errors import CalibrationFileError

CASES = [
    (["raw-cycles"], "offsets", "huber", "ipopt"),
    (["raw-cycles"], "lengths", "squares", "variable-projection"),
    (["table1/experiment-2", "table1/experiment-3"], "offsets", "squares", "variable-projection"),
]


@pytest.mark.parametrize(("names", "model", "loss", "solver"), CASES)
def test_a_calibration_is_repeated_from_its_file(tmp_path, names, model, loss, solver):
    choice = Choice(model, bounds={"x_slide.offset_mm": (-0.5, 4.0)}, known={})
    made, _ = identify([session_of(n) for n in names], choice, loss=loss, solver=solver)
    loaded = load_calibration(write_calibration(made, tmp_path / "calibration.json"))
    again = repeat_calibration(loaded, restore_session(loaded))
    for p, q in zip(made.parameters, again.parameters, strict=True):
        assert q.name == p.name
        assert q.value == pytest.approx(p.value, abs=1e-6 * p.prior_std)
        assert q.std == pytest.approx(p.std, rel=1e-5, nan_ok=True)
        assert q.at_bound == p.at_bound
    for p, q in zip(made.residuals, again.residuals, strict=True):
        assert (q.label, q.cycle, q.line, q.measured) == (p.label, p.cycle, p.line, p.measured)
        assert q.predicted == pytest.approx(p.predicted, abs=1e-10)
    for p, q in zip(made.setups, again.setups, strict=True):
        assert (p.zero is None) == (q.zero is None)
        assert p.zero is None or q.zero == pytest.approx(p.zero, abs=1e-9)


@pytest.mark.parametrize(
    "keys",
    [
        "leg: y, direction: z, section: {fraction: 0.5}",
        "sensor: ball_bar, centre_mm: [50, 0, -100], length_mm: 100",
        "sensor: tool_indicator, direction: z, artefact: {kind: plate}",
        "sensor: probe",
        "sensor: points",
    ],
)
def test_a_setup_without_readings_is_no_obstacle(root, tmp_path, keys):
    """It has not been measured yet, and its gauge has not been read."""
    folder = tmp_path / "session"
    shutil.copytree(root / "examples/table1/experiment-2", folder)
    text = (folder / "session.yaml").read_text()
    text = re.sub(r"(?m)^gauge: (\{.*\}).*", r"gauges: {a: \1, b: {sigma_mm: 0.002}}", text)
    text = text.replace(": {leg:", ": {gauge: a, leg:")
    text = text.replace("\nsetups:", f"\nsetups:\n  later: {{gauge: b, {keys}}}")
    (folder / "session.yaml").write_text(text)
    made, _ = identify(folder, solver="variable-projection")
    loaded = load_calibration(write_calibration(made, tmp_path / "calibration.json"))
    again = repeat_calibration(loaded, restore_session(loaded))
    assert again.offsets == pytest.approx(made.offsets, abs=1e-9)
    assert again.offsets == pytest.approx(calibrated("table1/experiment-2").offsets, abs=1e-9)


@pytest.mark.parametrize("loss", ["huber", "squares"])
def test_the_covariance_of_a_calibration_follows_from_its_record(loss):
    made, _ = identify(session_of("workshop"), "full", loss=loss, solver="variable-projection")
    covariance, of_noise, _ = restore_covariances(made)
    n = len(made.free)
    assert covariance[:n, :n] == pytest.approx(made.model_covariance, rel=1e-6, abs=1e-18)
    assert of_noise[:n, :n] == pytest.approx(made.noise_covariance, rel=1e-6, abs=1e-18)


@pytest.fixture(scope="module")
def document():
    return calibration_document(calibrated("table1/experiment-2"))


def edit(document, place, change, path):
    """Write a document with one changed number, at a place given by its keys."""
    edited = json.loads(json.dumps(document))
    part = edited
    for key in place[:-1]:
        part = part[key]
    change(part, place[-1])
    path.write_text(json.dumps(edited))
    return path


def shift(part, key):
    part[key] = part[key] * (1.0 + 1e-6) + 1e-9


def remove(part, key):
    del part[key]


EDITED = [
    ("sigma",),
    ("dof",),
    ("rms_before",),
    ("rms_after",),
    ("largest_before",),
    ("largest_after",),
    ("identifiability", "condition"),
    ("identifiability", "observability", "O3"),
    ("residuals", 4, "residual"),
    ("residuals", 4, "predicted"),
    ("parameters", 1, "std"),
    ("parameters", 1, "std_scatter"),
    ("parameters", 1, "std_scaled"),
    ("model_covariance", 1, 1),
    ("noise_covariance", 1, 1),
    ("scaled_covariance", 1, 1),
    ("unmodelled", "leakage", 1, 1),
]


@pytest.mark.parametrize("place", EDITED, ids=lambda p: ".".join(map(str, p)))
def test_a_number_that_does_not_follow_from_the_others_is_refused(document, tmp_path, place):
    path = edit(document, place, shift, tmp_path / "calibration.json")
    with pytest.raises(CalibrationFileError, match="the other numbers of the file give"):
        load_calibration(path)


def test_a_number_in_place_of_derived_numbers_is_named(document, tmp_path):
    def replace_by_number(part, key):
        part[key] = 5

    place = ("identifiability", "observability")
    path = edit(document, place, replace_by_number, tmp_path / "calibration.json")
    with pytest.raises(CalibrationFileError, match=r"observability: found 5; expected keys and"):
        load_calibration(path)


@pytest.mark.parametrize("place", [p for p in EDITED if "residual" in p[-1:] or len(p) == 1])
def test_a_number_that_follows_from_the_others_may_be_omitted(document, tmp_path, place):
    path = edit(document, place, remove, tmp_path / "calibration.json")
    assert calibration_document(load_calibration(path)) == document


def test_tables_are_plain_records():
    made = calibrated("raw-cycles", "lengths", **UNJUDGED)
    parameters, readings = parameter_table(made), reading_table(made)
    assert [p["name"] for p in parameters if p["of"] == "machine"] == [
        p.name for p in made.parameters
    ]
    assert [p["name"] for p in parameters if p["of"] == "sensor"] == [p.name for p in made.sensors]
    assert made.sensors
    assert [r["residual"] for r in readings] == [r.residual for r in made.residuals]
    low, high = made.intervals[0]
    assert (parameters[0]["low"], parameters[0]["high"]) == (low, high)
    for table in (parameters, readings):
        assert len({tuple(record) for record in table}) == 1  # one header for all
        assert json.loads(json.dumps(table, allow_nan=False)) == table
        writer = csv.DictWriter(io.StringIO(), table[0])
        writer.writerows(table)
