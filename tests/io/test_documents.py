"""JSON and CSV from strangers: valid documents, and limits that refuse the others promptly."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace

import pytest
from calibrated import EXPERIMENT_2, UNJUDGED, calibrated

from orthocal import Choice, calibrate, load_calibration, load_session
from orthocal.assessment.controller_entries import find_entries
from orthocal.calibration.file import calibration_document, write_calibration
from orthocal.errors import OrthocalError, SessionError, SolverError
from orthocal.io.documents import MOST_JSON_VALUES, csv_rows, read_json
from orthocal.measurement.files.readings_file import read_rows

PROMPT = 5.0
"""Largest processor time of a refusal, [s]."""


@pytest.fixture
def refused(tmp_path):
    """Message of a document that must be refused promptly."""

    def read(text):
        path = tmp_path / "file"
        path.write_text(text, encoding="utf-8")
        began = time.process_time()
        with pytest.raises(OrthocalError) as caught:
            read_json(path, error=SessionError)
        assert time.process_time() - began < PROMPT
        assert caught.value.exit_code == 2
        assert len(str(caught.value)) < 500
        return str(caught.value)

    return read


@pytest.mark.parametrize("digits", [101, 4000, 4301, 100_000])
def test_long_numbers_are_refused(digits, refused):
    message = refused(f'{{"a": [{"9" * digits}]}}')
    assert f"has {digits} characters" in message


@pytest.mark.parametrize("depth", [50, 5000, 100_000])
def test_deep_lists_are_refused(depth, refused):
    message = refused(f'{{"a": {"[" * depth}{"]" * depth}}}')
    assert "more than 20 deep" in message or "recursion" in message


def test_many_keys_are_read_promptly(tmp_path, refused):
    path = tmp_path / "good"
    path.write_text(json.dumps({str(i): i for i in range(100_000)}))
    began = time.process_time()
    assert len(read_json(path, error=SessionError)) == 100_000
    assert time.process_time() - began < PROMPT
    twice = ",".join(f'"{i}": 0' for i in [*range(40_000), 39_999])
    assert "the key '39999' occurs twice" in refused(f"{{{twice}}}")


def test_many_values_are_refused(refused):
    message = refused("[" + "[]," * MOST_JSON_VALUES + "[]]")
    assert f"expected at most {MOST_JSON_VALUES}" in message


def test_a_csv_with_too_many_rows_is_refused():
    lines = ["a,b\n", *["1,2\n"] * 1000]
    rows = csv_rows(lines, name="f", required=("a", "b"), most=1000)
    with pytest.raises(SessionError, match="has more than 1000 rows"):
        list(rows)


@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
def test_line_ends_of_readings(ending, tmp_path):
    path = tmp_path / "readings.csv"
    lines = ["setup,posture,reading_mm", "yx,zero,1", "", "yx,x_max,2", ""]
    rows = list(read_rows(path, ending.join(lines).encode()))
    assert [(r.line, r.posture, r.reading_mm) for r in rows] == [
        (2, "zero", "1"),
        (4, "x_max", "2"),
    ]


@pytest.mark.parametrize("where", ["key", "value", "item"])
@pytest.mark.parametrize("text", ["\\ud800", "\\u001b", "\\u0085", "\\u0000"])
def test_control_characters_are_refused(where, text, refused):
    document = {"key": f'{{"{text}": 1}}', "value": f'{{"a": "{text}"}}', "item": f'["{text}"]'}
    message = refused(document[where])
    assert "half of a surrogate pair" in message or "control character" in message


# ---- calibration.json


@pytest.fixture(scope="module")
def document():
    return calibration_document(calibrated(EXPERIMENT_2))


def change(document, keys, value):
    copy = json.loads(json.dumps(document))
    *path, last = keys
    inner = copy
    for key in path:
        inner = inner[key]
    inner[last] = value
    return copy


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (["gauges", 0, "sigma"], 0, "gauges[0].sigma: found '0'; expected greater than 0"),
        (["gauges", 0, "sigma"], 1e-300, "expected at least 1e-16"),
        (["noise", "residual_sigma"], -1.0, "expected greater than or equal to 0"),
        (["identifiability", "n_postures"], 10**30, "expected less than or equal to 1000000000"),
        (["identifiability", "n_readings"], 10**400, "has 401 characters"),
        (["solver", "iterations"], 10**30, "expected less than or equal to 1000000000"),
        (["noise", "cycles_dof"], -1, "expected greater than or equal to 0"),
        (["residuals", 0, "minus"], "", "residuals[0].minus: found ''"),
        (["residuals", 0, "line"], 10**30, "expected less than or equal to 1000000000"),
        (["identifiability", "singular_values", 2], 0.0, "only 2 singular values are above 0"),
        (["identifiability", "singular_values", 2], -1.0, "expected numbers of at least 0"),
        (["identifiability", "singular_values", 0], 0.0, "the largest first"),
        (["identifiability", "rank"], 4, "identifiability.rank: found 4"),
        (["model_covariance"], [], "covariance: expected 3 × 3 numbers"),
        (["parameters", 0, "prior_std"], 0, "expected greater than 0"),
        (["robot", "directory"], "a\x00b", "a text contains a control character"),
        (["session", "title"], "\ud800", "half of a surrogate pair"),
        (["setups", 1, "gauge"], "w", "setups[1].gauge: 'w' is not among the file's gauges"),
        (["gauges", 0, "range"], [0.005, -0.005], "gauges[0].range: expected the lowest reading"),
        (["setups", 0, "active"], [0.0], "setups[0].active: has 1 numbers; expected 3"),
        (["setups", 1, "name"], "xy", "setups[1].name: 'xy' occurs twice"),
        (["sensors", 1, "name"], "w", "sensors[1]: found 'w' in rad; the setups have 'setup.xy.pi"),
        (["sensors"], [], "sensors[0]: found nothing; the setups have 'setup.xy.roll' in rad"),
        (["assessment", "entries", 1, "drive"], "w", "assessment.entries[1].drive: 'w' is not am"),
        (["residuals"], [0] * 30_000, "residuals[0]: found '0'; expected keys and values"),
        (["model_covariance"], [["a"] * 3] * 10_000, "covariance[0][0]: found 'a'"),
    ],
    ids=lambda v: None if isinstance(v, list | str) and len(v) > 40 else str(v)[:40],
)
def test_invalid_values_of_a_calibration_are_refused(keys, value, message, document, tmp_path):
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(change(document, keys, value)))
    began = time.process_time()
    with pytest.raises(OrthocalError) as caught:
        find_entries(load_calibration(path))
    assert time.process_time() - began < PROMPT
    assert message in str(caught.value)


def test_a_calibration_without_free_parameters_is_refused(document, tmp_path):
    empty = change(document, ["model_covariance"], [])
    empty["parameters"] = [{**p, "free": False} for p in empty["parameters"]]
    empty["noise_covariance"] = []
    empty["unmodelled"]["leakage"] = []
    (tmp_path / "calibration.json").write_text(json.dumps(empty))
    with pytest.raises(OrthocalError, match="parameters: contains no free parameter"):
        load_calibration(tmp_path)


# ---- round trips


@pytest.mark.parametrize(
    ("name", "model"), [("table1/experiment-2", "offsets"), ("raw-cycles", "full")]
)
def test_a_written_calibration_reads_the_same(model, name, tmp_path):
    """18 readings beside 126 errors leave a hundredth of a degree of freedom, for example."""
    calibration = calibrated(name, model, **UNJUDGED)
    found = load_calibration(write_calibration(calibration, tmp_path / "calibration.json"))
    assert calibration_document(found) == calibration_document(calibration)


def test_the_smallest_values_of_a_session_are_read_again(root, tmp_path):
    source = root / "examples/table1/experiment-2"
    text = (source / "session.yaml").read_text(encoding="utf-8")
    (tmp_path / "readings.csv").write_bytes((source / "readings.csv").read_bytes())
    small = text.replace("sigma_mm: 0.02", "sigma_mm: 1.0e-9", 1)
    small = small.replace("resolution_mm: 0.01", "resolution_mm: 1.0e-9", 1)
    assert small != text
    (tmp_path / "session.yaml").write_text(small, encoding="utf-8")
    calibration = calibrate(
        load_session(tmp_path), Choice(tolerances={"*.offset_m": 2e-9}, model="offsets", prior=True)
    )
    found = load_calibration(write_calibration(calibration, tmp_path / "calibration.json"))
    assert calibration_document(found) == calibration_document(calibration)


def test_an_implausible_estimate_is_refused(raw_cycles, monkeypatch):
    module = sys.modules["orthocal.calibration.build_record"]
    original = module._estimates

    def absurd(*args, **kwargs):
        return tuple(replace(p, value=2.6e15) for p in original(*args, **kwargs))

    monkeypatch.setattr(module, "_estimates", absurd)
    with pytest.raises(SolverError, match=r"the result is implausible \(x_slide.offset is 2.6e"):
        calibrate(raw_cycles, **UNJUDGED)


def test_a_result_that_could_not_be_loaded_is_not_written(tmp_path):
    result = calibrated(EXPERIMENT_2)
    absurd = replace(result, model_covariance=1e12 * result.model_covariance)
    with pytest.raises(SolverError, match=r"the result is implausible \(calibration.json: "):
        write_calibration(absurd, tmp_path / "calibration.json")
    assert not list(tmp_path.iterdir())
