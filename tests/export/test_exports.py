"""Exports by what they do: a nominal controller that obeys them, and the real machine's tool."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest

from orthocal import (
    ExportError,
    ParameterError,
    calibrate,
    export_calibration,
    load_plan,
    load_session,
    simulate_session,
    write_calibration,
)
from orthocal.assess.entering import entered_offsets
from orthocal.cli import main
from orthocal.kinematics.assembly import Assembly, nominal_assembly
from orthocal.measurement.synthetic import load_errors

ROUNDED = 0.5e-9 * np.sqrt(3.0) * 1.5
"""[m] Corrections are written to 1e-6 mm."""


@pytest.fixture(scope="module")
def full(root):
    return calibrate(load_session(root / "examples/sweep"), "full")


@pytest.fixture(scope="module")
def turned(root):
    """A machine whose setup zy was read with the wrong sign: not to be entered."""
    from dataclasses import replace

    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    truth = {"x_slide.offset": 1.2e-3, "y_slide.offset": -0.8e-3, "z_slide.offset": 0.5e-3}
    session = simulate_session(plan, truth, seed=1).session
    rows = [replace(r, value=-r.value) if r.setup == "zy" else r for r in session.readings]
    return calibrate(replace(session, readings=tuple(rows)))


def test_corrections_bring_the_real_tool_where_it_is_wanted(full):
    """Without them it is off by tenths of a millimetre; by another assembly than the export's."""
    text = export_calibration(full, "table")["corrections.csv"]
    rows = list(csv.DictReader(io.StringIO(text)))
    point, change = (
        np.array([[float(r[f"{d}{k}_mm"]) for k in "xyz"] for r in rows]) * 1e-3 for d in ("", "d")
    )
    assert len(rows) == 343
    nominal, real = nominal_assembly(full.robot), Assembly(full.robot, fixed=full.errors)
    offsets = entered_offsets(full)
    reached = real.forward(nominal.inverse(point + change) - offsets)
    assert np.abs(reached - point).max() < ROUNDED
    uncorrected = real.forward(nominal.inverse(point) - offsets)
    assert np.abs(uncorrected - point).max() > 50e-6


def test_corrections_of_offsets_alone_are_none(experiment_2):
    text = export_calibration(calibrate(experiment_2), "table")["corrections.csv"]
    assert {r[f"d{k}_mm"] for r in csv.DictReader(io.StringIO(text)) for k in "xyz"} == {"0.000000"}


def test_parameters_are_read_again_as_they_were(full, tmp_path):
    path = tmp_path / "errors.yaml"
    path.write_text(export_calibration(full, "yaml")["errors.yaml"])
    again = load_errors(path, full.robot)
    assert again.keys() == full.errors.keys()
    for name, value in full.errors.items():
        assert again[name] == pytest.approx(value, rel=1e-11)
    assert "#   x_slide_mm: " in path.read_text()


def test_what_is_not_to_be_entered_is_not_exported_unless_told_so(turned, tmp_path, capsys):
    with pytest.raises(ExportError, match="Do not enter these"):
        export_calibration(turned, "yaml")
    assert "errors.yaml" in export_calibration(turned, "yaml", anyway=True)
    file = write_calibration(turned, tmp_path / "calibration.json")
    words = ["export", str(file), "--to", "yaml", "--out", str(tmp_path / "out")]
    assert run(words) == 3
    assert "Do not enter these" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert run([*words, "--anyway"]) == 0
    assert (tmp_path / "out/errors.yaml").exists()


def test_unknown_formats_and_machines_without_a_tool(experiment_2):
    with pytest.raises(ParameterError, match="found 'xml'; expected one of yaml, table"):
        export_calibration(calibrate(experiment_2), "xml")


def run(words):
    import sys

    old, sys.argv = sys.argv, ["orthocal", *words]
    try:
        main()
    except SystemExit as e:
        return e.code
    finally:
        sys.argv = old
