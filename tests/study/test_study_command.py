"""The command `study`: what it prints, writes and refuses."""

from __future__ import annotations

import json
import sys

import pytest

from orthocal.cli import main

FILES = {"results.jsonl", "results.parquet", "study.json", "study.svg"}


def run(monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["orthocal", "study", *map(str, words)])
    with pytest.raises(SystemExit) as e:
        main()
    found = capsys.readouterr()
    return e.value.code or 0, found.out, found.err


QUICK = {
    "accuracy": [
        *("examples/workshop/plan.yaml", "--machines", 110, "--model", "offsets"),
        *("--tolerance", "*.offset_mm=0.2"),
    ],
    "linearisation": ["--sizes", 6, "--directions", 50, "--largest-mm", 10],
    "sensitivity": ["--free", "offsets"],
    "bootstrap": ["examples/table1/experiment-2", "--draws", 300],
}
ANSWERS = {
    "accuracy": "µm are left at the tool of 110 machines",
    "linearisation": "The paper's six equations miss more than the resolution",
    "sensitivity": "3 errors in 39 rows of readings and tool coordinates",
    "bootstrap": "Estimates scatter",
}


@pytest.mark.parametrize("kind", QUICK)
def test_the_answer_comes_first_and_files_are_written(monkeypatch, capsys, tmp_path, root, kind):
    monkeypatch.chdir(root)
    words = [kind, *QUICK[kind], "--out", tmp_path]
    words += [] if kind == "sensitivity" else ["--workers", 1]
    code, out, err = run(monkeypatch, capsys, *words)
    assert code == 0
    assert ANSWERS[kind] in " ".join(out.split())
    assert out.splitlines()[0].startswith(" ".join(ANSWERS[kind].split()[:1])) or kind == "accuracy"
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
    before = {f.name: f.read_bytes() for f in tmp_path.iterdir()}
    code, again, _ = run(monkeypatch, capsys, *words)
    assert (code, again) == (0, out)
    assert {f.name: f.read_bytes() for f in tmp_path.iterdir()} == before


def test_json_is_on_stdout_alone(monkeypatch, capsys, root):
    monkeypatch.chdir(root)
    words = ["sensitivity", "--at", "10,-20,30", "--leg-mm", "250", "--json"]
    code, out, err = run(monkeypatch, capsys, *words)
    assert (code, err) == (0, "")
    document = json.loads(out)
    assert len(document["summary"]["parameters"]) == 129
    assert {r["posture"] for r in document["summary"]["rows"]} == {"point_1"}


def test_a_longer_leg_is_another_machine(monkeypatch, capsys):
    found = []
    for leg in ("200", "310.25"):
        words = ["linearisation", "--leg-mm", leg, "--along", "1,-0.6,0.3", "--sizes", "1"]
        words += ["--largest-mm", "2", "--json"]  # displacements are as long as legs
        code, out, _ = run(monkeypatch, capsys, *words)
        assert code == 0
        found.append(json.loads(out)["summary"]["methods"][0]["missed_mm"][0])
    assert found[0] > 1.2 * found[1]


def test_ctrl_c_says_how_to_go_on(monkeypatch, capsys, tmp_path):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("orthocal.study.runner.run_task", stop)
    for out, word in (([], "with --out it could go on"), (["--out", tmp_path], "the same command")):
        code, _, err = run(monkeypatch, capsys, "sensitivity", "--free", "offsets", *out)
        assert code == 130
        assert f"orthocal: stopped; {word}" in err


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
            "--workers: found with --dask, which has its own; expected one",
        ),
        (
            ["linearisation", "orthoglide", "--along", "1,2"],
            "--along: found 1, 2; expected 3",
        ),
        (["linearisation", "orthoglide", "--along", "1,b,2"], "--along: part is 'b'; expected"),
        (["linearisation", "--leg-mm", "-5"], "--leg-mm: legs of -5 mm; expected 20 to 5000 mm"),
        (["linearisation", "--min-mm", "5"], "--min-mm: found 5; expected a number below 0"),
        (["linearisation", "--largest-mm", "0"], "--largest-mm: found 0; expected a number above"),
        (["linearisation", "--sigma-mm", "-1"], "--sigma-mm: found -1; expected a number above 0"),
        (["linearisation", "--max-mm", "400"], "x_max"),
        (["linearisation", "--max-mm", "-4"], "--max-mm: found -4; expected a number above 0, and"),
        (["accuracy", "orthoglide"], "orthoglide: is a robot; expected a session.yaml: `orthocal"),
        (["linearisation", "tests/robots/biglide"], "biglide: has no legs x, y, z along"),
        (["linearisation", "tests/robots/biglide", "--leg-mm", "200"], "is of the robot orthogl"),
        (["sensitivity", "--at", "1,2"], "--at: '1,2' has 2 numbers; expected 3"),
        (["sensitivity", "--free", "nothing"], "nothing"),
        (["bootstrap", "examples/raw-cycles", "--by", "chance"], "--by: found 'chance'; expected"),
        (["bootstrap", "examples/workshop", "--by", "cycles"], "was read in one cycle; expected"),
    ],
)
def test_what_makes_no_sense_is_refused(monkeypatch, capsys, root, words, message):
    monkeypatch.chdir(root)
    code, out, err = run(monkeypatch, capsys, *words)
    assert (code, out) == (2, "")
    assert message in err
    assert len(err.splitlines()) == 1


def test_a_folder_of_another_study_is_left_as_it_is(monkeypatch, capsys, tmp_path, root):
    monkeypatch.chdir(root)
    out = ["--out", tmp_path]
    assert run(monkeypatch, capsys, "sensitivity", "--free", "offsets", *out)[0] == 0
    before = {f.name: f.read_bytes() for f in tmp_path.iterdir()}
    code, _, err = run(monkeypatch, capsys, "sensitivity", "--free", "lengths", *out)
    assert code == 2
    assert "results.jsonl: is of another study, which differs in parameters" in err
    assert {f.name: f.read_bytes() for f in tmp_path.iterdir()} == before
    code, _, _ = run(monkeypatch, capsys, "sensitivity", "--free", "lengths", *out, "--force")
    assert code == 0
