"""The session that is measured next: what was identified is active, and nothing is read yet."""

from __future__ import annotations

import shutil

import pytest
from commands import orthocal

from orthocal import load_calibration, load_plan
from orthocal.assessment.controller_entries import entered_offsets

pytestmark = pytest.mark.usefixtures("without_plots")


@pytest.fixture(scope="module")
def calibrated(root, tmp_path_factory, without_plots):
    """raw-cycles in a folder of its own, and its calibration beside it."""
    folder = tmp_path_factory.mktemp("again")
    shutil.copytree(root / "examples/raw-cycles", folder / "first")
    assert orthocal("calibrate", folder / "first", "--out", folder / "one").returncode == 0
    return folder


def test_it_is_the_same_session_with_offsets_active(calibrated, tmp_path):
    out = tmp_path / "second"
    code, text, err = orthocal("again", calibrated / "one", "--out", out)
    assert code == 0, err
    first, second = load_plan(calibrated / "first"), load_plan(out)
    found = load_calibration(calibrated / "one")
    assert second.active_offsets == pytest.approx(entered_offsets(found), abs=0.6e-7)
    assert second.active_offsets != pytest.approx(first.active_offsets, abs=1e-5)
    assert [(r.setup, r.posture, r.cycle) for r in second.readings] == [
        (r.setup, r.posture, r.cycle) for r in first.readings
    ]
    for name, posture in first.postures.items():  # commanded alike, so elsewhere in truth
        assert second.postures[name].values.tolist() == posture.values.tolist()
    rows = (out / "readings.csv").read_text().splitlines()
    assert len(rows) == 1 + len(first.readings)
    assert all(row.endswith(",") for row in rows[1:])
    assert (second.title, second.source) == ("three cycles Zero, Max, Min for all legs", "")
    assert "x_slide +1." in text
    assert f"orthocal validate {calibrated / 'one'} {out}" in text
    assert (out / "sheet.html").read_text().startswith("<!DOCTYPE html>")
    code, _, err = orthocal("again", calibrated / "one", "--out", out)
    assert (code, err) == (
        2,
        f"orthocal: {out}/session.yaml: exists already; expected a new directory\n",
    )


def test_what_is_to_be_reviewed_is_not_measured_again(calibrated, tmp_path):
    wrong = tmp_path / "wrong"
    shutil.copytree(calibrated / "first", wrong)
    lines = (wrong / "readings.csv").read_text().splitlines()
    head, *rows = (line.rsplit(",", 1) for line in lines)
    turned = [f"{a},{-float(v) if a.startswith('zy') else v}" for a, v in rows]
    (wrong / "readings.csv").write_text("\n".join([",".join(head), *turned]) + "\n")
    code, _, _ = orthocal("calibrate", wrong, "--out", tmp_path / "cal")
    assert code == 3
    code, _, err = orthocal("again", tmp_path / "cal", "--out", tmp_path / "next")
    assert code == 3
    decision = load_calibration(tmp_path / "cal").assessment.decision
    assert decision.verdict == "review"
    assert err.startswith(f"orthocal: {decision.headline} ")
    assert not (tmp_path / "next").exists()
    code, _, _ = orthocal("again", tmp_path / "cal", "--anyway", "--out", tmp_path / "next")
    assert code == 0


def test_of_several_sessions_one_is_named(calibrated, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(calibrated / "first", other)
    table = other / "readings.csv"
    head, first, *rows = table.read_text().splitlines()
    row, value = first.rsplit(",", 1)
    table.write_text("\n".join([head, f"{row},{float(value) + 0.01:.2f}", *rows]) + "\n")
    both = [calibrated / "first", other]
    code, _, err = orthocal("calibrate", *both, "--out", tmp_path / "cal")
    assert code in (0, 3), err
    code, _, err = orthocal("again", tmp_path / "cal", "--anyway", "--out", tmp_path / "next")
    assert code == 2
    assert "--session: is missing: the calibration is of several sessions" in err
    words = ["--anyway", "--session", other, "--out", tmp_path / "next"]
    code, _, err = orthocal("again", tmp_path / "cal", *words)
    assert code == 0, err


def test_a_copy_is_no_second_session(calibrated, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(calibrated / "first", copy)
    file = copy / "session.yaml"
    file.write_text(file.read_text() + "# Tuesday\n")
    code, _, err = orthocal("calibrate", calibrated / "first", copy)
    assert code == 2
    assert err == (
        f"orthocal: {copy}/readings.csv: has the same readings as {calibrated}/first/session.yaml"
        ": a copy that was not measured again?\n"
    )
