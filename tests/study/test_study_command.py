"""The command `study`: what it prints, writes and refuses."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import nullcontext

import pytest
from commands import run_orthocal
from processes import children_of, is_running, until

from orthocal.runtime import interrupts

FILES = {"results.jsonl", "results.parquet", "study.json", "study.svg"}


QUICK = {
    "accuracy": [
        *("examples/workshop/plan.yaml", "--machines", 110, "--model", "offsets"),
        *("--tolerance", "*.offset_mm=0.4", "--draw", "*.offset"),
    ],
    "linearisation": ["--sizes", 6, "--directions", 50, "--largest-mm", 10],
    "sensitivity": ["--free", "offsets"],
    "bootstrap": ["examples/table1/experiment-2", "--draws", 300],
}
ANSWERS = {
    "accuracy": "Expected tool error after calibration",
    "linearisation": "The paper's six equations are wrong by more than the resolution",
    "sensitivity": "Derivatives of 39 outputs (readings and tool coordinates) by 3 errors",
    "bootstrap": "Scatter of the estimates",
}


@pytest.mark.parametrize("kind", QUICK)
def test_answer_and_files(tmp_path, root, kind):
    words = [kind, *QUICK[kind], "--out", tmp_path]
    words += [] if kind == "sensitivity" else ["--workers", 1]
    code, out, err = run_orthocal(root, "study", *words)
    assert code == 0
    assert ANSWERS[kind] in " ".join(out.split())
    assert out.startswith(ANSWERS[kind].split()[0])
    assert {f.name for f in tmp_path.iterdir()} == FILES
    assert f"Wrote {tmp_path / 'study.json'}" in err
    if kind != "sensitivity":
        assert " left\n" in err
    document = json.loads((tmp_path / "study.json").read_text())
    assert document["study"]["kind"] == kind
    assert ANSWERS[kind] in document["answer"]
    picture = (tmp_path / "study.svg").read_text()
    assert picture.startswith('<?xml version="1.0"')
    assert "mathdefault" not in picture
    if kind == "bootstrap":
        before = {f.name: f.read_bytes() for f in tmp_path.iterdir()}
        code, again, _ = run_orthocal(root, "study", *words)
        assert (code, again) == (0, out)
        assert {f.name: f.read_bytes() for f in tmp_path.iterdir()} == before


def test_json_output(root):
    """Of one point, and of two lengths of the legs."""
    documents = []
    for leg in ("250", "310.25"):
        words = ["sensitivity", "--at", "10,-20,30", "--leg-mm", leg, "--json"]
        code, out, err = run_orthocal(root, "study", *words)
        assert (code, err) == (0, "")
        documents.append(json.loads(out)["summary"])
    for summary in documents:
        assert len(summary["parameters"]) == 129
        assert {r["posture"] for r in summary["rows"]} == {"point_1"}
    assert documents[0]["rows"] != documents[1]["rows"]


def test_without_a_directory_an_interrupt_names_the_option(root, monkeypatch):
    messages = []

    def record(message):
        messages.append(message)
        return nullcontext()

    monkeypatch.setattr(interrupts, "message_at_interrupt", record)
    assert run_orthocal(root, "study", "sensitivity", "--free", "offsets")[0] == 0
    assert messages == ["orthocal: stopped; with --out it can be resumed"]


def test_interrupt_ends_workers_and_names_the_way_to_resume(tmp_path, root):
    words = ["bootstrap", str(root / "examples/raw-cycles"), "--draws", "100000", "--workers", "2"]
    words += ["--out", str(tmp_path)]
    command = [sys.executable, "-m", "orthocal", "study", *words]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, process_group=0
    )
    until(lambda: len(children_of(process.pid)) == 2)
    children = [int(pid) for pid in children_of(process.pid)]
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the workers as well
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    last = errors.splitlines()[-1]
    assert "the same command resumes it" in last
    assert "Traceback" not in errors
    until(lambda: not any(map(is_running, children)))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["accuracy", "nowhere"], "nowhere: there is no such file"),
        (["accuracy", "examples/workshop", "--model", "all"], "'all' is not a model"),
        (["accuracy", "examples/workshop", "--draw", "nothing"], "nothing"),
        (["accuracy", "examples/workshop", "--error", "x_slide.offset"], "expected NAME=VALUE"),
        (["accuracy", "examples/workshop", "--half-side-mm", "0"], "--half-side-mm: found '0'"),
        (["accuracy", "examples/workshop", "--tolerance", "*.offset=2"], "--tolerance"),
        (
            ["accuracy", "examples/workshop", "--dask", "tcp://127.0.0.1:1", "--workers", "2"],
            "--workers: cannot be combined with --dask",
        ),
        (["linearisation", "orthoglide", "--along", "1,2"], "--along: found 1, 2; expected 3"),
        (["linearisation", "orthoglide", "--along", "1,b,2"], "--along: part is 'b'; expected"),
        (["linearisation", "--along", "1,0,0", "--directions", 2], "--directions: cannot be"),
        (["linearisation", "--leg-mm", "-5"], "--leg-mm: legs of -5 mm; expected 20 to 5000 mm"),
        (["linearisation", "--min-mm", "5"], "--min-mm: found 5; expected a number between"),
        (["linearisation", "--largest-mm", "0"], "--largest-mm: found 0; expected a number"),
        (["linearisation", "--sigma-mm", "-1"], "--sigma-mm: found -1; expected a number"),
        (["linearisation", "--max-mm", "400"], "x_max"),
        (
            ["linearisation", "examples/raw-cycles", "--min-mm", "-5"],
            "--min-mm: is for a robot; found a session",
        ),
        (["linearisation", "--max-mm", "-4"], "--max-mm: found -4; expected a number"),
        (["accuracy", "orthoglide"], "orthoglide: is a robot; expected a session.yaml, which"),
        (["linearisation", "tests/robots/biglide"], "biglide: has no legs x, y, z along"),
        (
            ["linearisation", "tests/robots/biglide", "--leg-mm", "200"],
            "applies to the robot orthogl",
        ),
        (["sensitivity", "--at", "1,2"], "--at: '1,2' has 2 numbers; expected 3"),
        (["sensitivity", "--free", "nothing"], "nothing"),
        (["bootstrap", "examples/raw-cycles", "--by", "chance"], "--by: found 'chance'; expected"),
        (
            ["bootstrap", "examples/workshop", "--model", "offsets", "--by", "cycles"],
            "has one cycle of readings; expected",
        ),
    ],
)
def test_invalid_arguments(root, words, message):
    code, out, err = run_orthocal(root, "study", *words)
    assert (code, out) == (2, "")
    assert message in err
    assert len(err.splitlines()) == 1


def test_directory_of_another_study(tmp_path, root):
    out = ["--out", tmp_path]
    assert run_orthocal(root, "study", "sensitivity", "--free", "offsets", *out)[0] == 0
    before = {f.name: f.read_bytes() for f in tmp_path.iterdir()}
    code, _, err = run_orthocal(root, "study", "sensitivity", "--free", "lengths", *out)
    assert code == 2
    assert "results.jsonl: belongs to another study (different: parameters)" in err
    assert {f.name: f.read_bytes() for f in tmp_path.iterdir()} == before
    code, _, _ = run_orthocal(root, "study", "sensitivity", "--free", "lengths", *out, "--force")
    assert code == 0
