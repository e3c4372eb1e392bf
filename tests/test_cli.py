"""Commands: files, output, exit codes and help."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil

import pytest
import yaml
from calibrated import identified
from commands import orthocal
from conftest import marked_reports
from typer.main import get_command

import orthocal as package
from orthocal import (
    __version__,
    check_session,
    load_calibration,
    load_plan,
    load_session,
    write_session,
)
from orthocal.assessment.controller_entries import offsets_to_enter
from orthocal.cli.run import PANELS, make_program
from orthocal.measurement.recording import open_recording

pytestmark = pytest.mark.usefixtures(
    "short_reports", "module_without_sensor_gains", "judged_sessions"
)


@pytest.fixture(scope="module")
def experiment(root):
    return root / "examples/table1/experiment-2"


@pytest.fixture(scope="module")
def written(experiment, tmp_path_factory, short_reports):
    """Directory of the experiment's calibration, and the output of `calibrate --json`."""
    folder = tmp_path_factory.mktemp("written") / "new/folder"
    return folder, orthocal("calibrate", experiment, "--json", "--out", folder)


@pytest.fixture
def calibrated(written, tmp_path):
    """Copy of the calibration that a test may change."""
    return shutil.copytree(written[0], tmp_path / "calibrated")


def test_calibrate_writes_a_calibration_and_a_report(written):
    folder, (code, _, err) = written
    assert code == 0
    assert err == f"Wrote {folder / 'calibration.json'} and {folder / 'report.html'}\n"
    calibration = load_calibration(folder)
    assert calibration["x_slide.offset"].value == pytest.approx(-0.5268e-3, abs=5e-6)
    assert {p.name for p in folder.iterdir()} == {"calibration.json", "report.html"}
    assert "Values to enter" in (folder / "report.html").read_text()


def test_report_is_written_to_the_default_and_to_a_stated_file(written, calibrated, tmp_path):
    # the next commands name the directory of the calibration, and one beside it
    page = (calibrated / "report.html").read_text().replace(str(written[0]), str(calibrated))
    page = page.replace(str(written[0].parent), str(calibrated.parent))
    (calibrated / "report.html").unlink()
    (tmp_path / "pages").mkdir()
    for words, target in (
        ([], calibrated / "report.html"),
        (["--out", tmp_path / "pages"], tmp_path / "pages/report.html"),
    ):
        code, out, err = orthocal("report", calibrated, *words)
        assert (code, out, err) == (0, "", f"Wrote {target}\n")
        assert target.read_text() == page
    with marked_reports():
        target = tmp_path / "new/mine.html"
        code, out, err = orthocal("report", calibrated, "--out", target)
    assert (code, out, err) == (0, "", f"Wrote {target}\n")


def test_view_writes_pages_of_calibrations_sessions_and_robots(
    calibrated, experiment, root, tmp_path
):
    options = "--posture x_max --exaggerate 1 --show all".split()
    for subject, words, *expected in (
        (calibrated / "calibration.json", options, "Machine, calibrated", "true scale"),
        (calibrated, [], "Machine, calibrated"),
        (experiment, [], "Machine, nominal"),
        (root / "tests/sessions/lines/plan.yaml", [], "none measured yet"),
        (root / "tests/robots/fivebar", [], "Mechanical zero", "motor_a"),
    ):
        page = tmp_path / "pages/view.html"
        code, out, err = orthocal("view", subject, "--html", page, *words)
        assert (code, out, err) == (0, "", f"Wrote {page}\n")
        assert [text for text in expected if text not in page.read_text(encoding="utf-8")] == []


@pytest.mark.parametrize(
    ("browser", "words"),
    [
        ("/nowhere/chromium", "a picture needs Chromium, which was not found"),
        ("false", "false took no picture"),
    ],
)
def test_picture_without_a_browser_is_refused(monkeypatch, tmp_path, browser, words):
    monkeypatch.setenv("ORTHOCAL_CHROMIUM", browser)
    code, _, err = orthocal("view", "orthoglide", "--png", tmp_path / "a.png")
    assert code == 2
    assert words in err
    assert ("write the page with --html" in err) == (browser != "false")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def reversed_setup(root, tmp_path_factory, short_reports):
    """Directory of a calibration of readings with a reversed setup zx, and its output."""
    folder = tmp_path_factory.mktemp("reversed")
    session = load_session(root / "examples/raw-cycles")
    signs = [-1.0 if r.setup == "zx" else 1.0 for r in session.readings]
    write_session(session.with_values(session.values * signs), folder / "session")
    words = ["calibrate", folder / "session", "--details", "--out", folder / "out"]
    return folder / "out", orthocal(*words)


def test_verdict_review_exits_3_and_writes_all_files(reversed_setup):
    folder, (code, out, err) = reversed_setup
    assert code == 3
    assert err.startswith("Wrote ")
    assert "Parameters" in out
    assert {p.name for p in folder.iterdir()} == {"calibration.json", "report.html"}
    assessment = load_calibration(folder).assessment
    decision = assessment.decision
    assert f"{decision.headline} {decision.reason}" in " ".join(out.split())
    assert (decision.verdict, decision.exit_code) == ("review", 3)
    assert assessment.findings[0].kind == "reversed sign"
    assert assessment.findings[0].places[0].setup == "zx"
    assert not assessment.of_kind("model error")  # the reversed signs explain the residuals


def test_again_refuses_the_verdict_review(reversed_setup, tmp_path):
    words = ["again", reversed_setup[0], "--out", tmp_path / "next"]
    code, _, err = orthocal(*words)
    assert code == 3
    decision = load_calibration(reversed_setup[0]).assessment.decision
    assert err.startswith(f"orthocal: {decision.headline} ")
    assert not (tmp_path / "next").exists()
    assert orthocal(*words, "--anyway").returncode == 0


def test_again_writes_the_same_plan_with_active_offsets(calibrated, experiment, tmp_path):
    out = tmp_path / "second"
    code, text, err = orthocal("again", calibrated, "--out", out)
    assert code == 0, err
    assert "other numbers" not in err
    first, second = load_plan(experiment), load_plan(out)
    entered = offsets_to_enter(load_calibration(calibrated))
    assert second.active_offsets == pytest.approx(entered, abs=1e-12)
    assert second.active_offsets != pytest.approx(first.active_offsets, abs=1e-5)
    assert [(r.setup, r.posture, r.minus, r.cycle) for r in second.readings] == [
        (r.setup, r.posture, r.minus, r.cycle) for r in first.readings
    ]
    for name, posture in first.postures.items():
        assert second.postures[name].values.tolist() == posture.values.tolist()
    rows = (out / "readings.csv").read_text().splitlines()
    assert len(rows) == 1 + len(first.readings)
    assert all(row.endswith(",") for row in rows[1:])
    assert (second.title, second.source) == (first.title, "")
    assert "x_slide -0.527 mm" in text
    assert f"orthocal validate {calibrated} {out}" in text
    validated = f"orthocal validate {os.path.relpath(calibrated, out)} ."
    assert f"<code>{validated}</code>" in (out / "sheet.html").read_text()
    assert f"# {validated}\n" in (out / "session.yaml").read_text()
    assert second.offsets_from.resolve() == calibrated.resolve()
    code, _, err = orthocal("sheet", out, "--force", "--dwell", 2)
    assert (code, validated in (out / "sheet.html").read_text()) == (0, True)
    code, _, err = orthocal("again", calibrated, "--out", out)
    assert code == 2
    assert err == f"orthocal: {out}/session.yaml: exists already; --force overwrites it\n"


def test_sheet_and_programs_have_the_lines_of_the_new_table(calibrated, experiment, tmp_path):
    """A deleted row leaves a blank line, and the new table has none."""
    shutil.copytree(experiment, tmp_path / "first")
    table = tmp_path / "first/readings.csv"
    head, *rows = table.read_text().splitlines(keepends=True)
    table.write_text("".join([head, *rows[:4], "\n", *rows[4:7], "\n", *rows[7:]]))
    out = tmp_path / "second"
    words = ("again", calibrated, "--session", tmp_path / "first", "--out", out)
    code, _, err = orthocal(*words)
    note = "The new lines therefore have other numbers: measure with the new sheet only."
    assert (code, note in " ".join(err.split())) == (0, True)
    rows = (out / "readings.csv").read_text().splitlines()
    programmed = {}
    for program in out.glob("*.ngc"):
        text = program.read_text()
        for line, posture in re.findall(r"\(reading line (\d+), posture (\w+)", text):
            programmed[int(line)] = program.stem[3:], posture
    expected = {i: tuple(row.split(",")[:2]) for i, row in enumerate(rows[1:], 2)}
    assert programmed == expected
    sheet = (out / "sheet.html").read_text()
    printed = re.findall(r'<tr[^>]*><td class="number">(\d+)</td>', sheet)
    assert set(map(int, printed)) == set(expected)


def test_rows_of_the_new_table_are_in_the_order_of_measurement(calibrated, experiment, tmp_path):
    """A row that `record` added has the last line of the old table."""
    shutil.copytree(experiment, tmp_path / "first")
    with open_recording(tmp_path / "first") as recording:
        recording.repeat(0)
        setup = recording.rows[0].setup
    out = tmp_path / "second"
    words = ("again", calibrated, "--session", tmp_path / "first", "--out", out)
    code, _, err = orthocal(*words)
    assert (code, "other numbers" in err) == (0, True)
    rows = [(r.setup, r.cycle) for r in load_plan(out).readings]
    assert rows[:2] == [(setup, 1), (setup, 2)]


def test_offsets_are_changes_if_no_session_states_the_active_ones(experiment, tmp_path):
    """Entered as total offsets they would replace those of the controller."""
    first = tmp_path / "first"
    shutil.copytree(experiment, first)
    text = (first / "session.yaml").read_text()
    text = re.sub(r"(?m)^controller:.*\n", "", text)
    (first / "session.yaml").write_text(text)
    with marked_reports():
        assert orthocal("calibrate", first, "--out", tmp_path / "one")[0] == 0
    code, text, err = orthocal("again", tmp_path / "one", "--out", tmp_path / "second")
    assert code == 0, err
    assert "Add these to the active offsets" in text
    assert "x_slide -0.527 mm" in text


def test_again_with_a_session_states_the_backlash_of_the_calibration(experiment, tmp_path):
    """The session names the rows only; its controller may have compensated nothing."""
    first = shutil.copytree(experiment, tmp_path / "first")
    text = (first / "session.yaml").read_text()
    text = re.sub(r"(?m)^controller: {", "controller: {backlash_mm: [0.03, 0.02, 0.01], ", text)
    (first / "session.yaml").write_text(text)
    quick = "--solver", "linearised"
    with marked_reports():
        assert orthocal("calibrate", first, *quick, "--out", tmp_path / "one")[0] == 0
    words = ("--session", experiment, "--out", tmp_path / "second")
    code, text, err = orthocal("again", tmp_path / "one", *words)
    assert code == 0, err
    second = load_plan(tmp_path / "second")
    assert [t.backlash for t in second.compensation] == pytest.approx([3e-5, 2e-5, 1e-5])
    assert "x_slide" in text.partition("compensates this backlash")[2]


def test_printed_json_is_the_file_with_decision_and_findings(written, tmp_path):
    folder, (_, out, _) = written
    printed = json.loads(out)
    document = json.loads((folder / "calibration.json").read_text())
    assert set(printed) - set(document) == {"decision", "findings"}
    assert {k: printed[k] for k in document} == document
    assert printed["decision"] == document["assessment"]["decision"] | {"exit_code": 0}
    assert printed["decision"]["verdict"] == "enter"
    (tmp_path / "again.json").write_text(out)
    assert load_calibration(tmp_path / "again.json").assessment.decision.verdict == "enter"


def test_details_and_all_rows_lengthen_the_answer(experiment, written, monkeypatch):
    made = load_calibration(written[0])
    monkeypatch.setattr(package, "calibrate", lambda *_, **__: made)
    short, details, everything = (
        orthocal("calibrate", experiment, *words).stdout for words in ([], ["--details"], ["--all"])
    )
    assert len(short.splitlines()) <= 40
    assert "studentised" not in short
    assert "studentised" in details
    assert len(everything) > len(details) > len(short)


def test_only_the_called_command_is_built():
    names = [name for panel in PANELS.values() for name in panel]
    for name in names:
        program = make_program(name)
        assert len(program.registered_commands) + len(program.registered_groups) == 1
    for called in ("", "--help", "nonsense"):
        program = make_program(called)
        assert len(program.registered_commands) + len(program.registered_groups) == len(names)


def test_help_explains_exit_code_3():
    for command, words in (
        ("check", "check the readings"),
        ("calibrate", "is not `enter`"),
        ("compare", "is not `enter`"),
        ("validate", "it is not"),
    ):
        text = " ".join(orthocal(command, "--help")[1].split())
        assert words in text[text.index("3: ") :]


def test_compare_recommends_a_model_and_exits_with_the_verdict(experiment):
    """Also one that is not compared. `test_examples.py` has the output for all models."""
    words = ["--models", "offsets,full", "--repeat", experiment.parent / "experiment-3"]
    code, out, err = orthocal("compare", experiment, *words)
    assert code == 0
    for model in ("offsets", "full"):  # progress
        assert f"model {model}," in err
    assert "Recommended model: full." in out
    assert "unknown whether the same deviations remain in 'Experiment 3" in " ".join(out.split())
    code, out, _ = orthocal("compare", experiment, "--models", "offsets", "--json")
    assert code == 0
    document = json.loads(out)
    assert [m["model"] for m in document["models"]] == ["offsets"]
    assert document["recommendation"]["model"] == "full"
    assert document["decision"]["verdict"] == "enter"


def test_accuracy_over_a_cube_and_at_points(calibrated, tmp_path):
    code, out, _ = orthocal("accuracy", calibrated, "--half-side-mm", 40)
    assert code == 0
    assert "Over the workspace ±40 mm" in out
    points = tmp_path / "points.csv"
    points.write_text("x_mm,y_mm,z_mm\n0,0,0\n10,20,-30.5\n")
    code, out, err = orthocal("accuracy", calibrated, points)
    assert code == 0
    assert "Errors are absolute" in err
    assert err.endswith(f"  orthocal accuracy {calibrated}\n")
    rows = list(csv.DictReader(io.StringIO(out)))
    assert [r["z_mm"] for r in rows] == ["0", "-30.5"]
    # in the mechanical zero an offset displaces the tool by its own amount
    assert float(rows[0]["absolute_z_um"]) == pytest.approx(-1760, abs=5)
    assert float(rows[0]["std_x_um"]) > 387
    code, out, _ = orthocal("accuracy", calibrated, points, "--json")
    assert json.loads(out)["points"] == 2
    assert json.loads(out)["decision"]["verdict"] == "enter"


def test_accuracy_refuses_a_verdict_against_entering(root, tmp_path):
    """With --anyway its first line is that of `calibrate`."""
    printed = tmp_path / "out"
    experiment = root / "examples/table1/experiment-1-printed"
    code, answer, _ = orthocal("calibrate", experiment, "--out", printed)
    assert code == 3
    code, out, err = orthocal("accuracy", printed)
    assert (code, out) == (3, "")
    assert err.startswith("orthocal: Do not enter offsets from these readings. ")
    _, out, _ = orthocal("accuracy", printed, "--anyway")
    words = " ".join(answer.split())
    assert out.startswith("Do not enter offsets from these readings. ")
    assert " ".join(out.split())[:100] in words


def test_options_for_free_known_and_bounded_parameters(experiment):
    code, out, err = orthocal(
        "calibrate", experiment, "--json",
        "--model", "lengths", "--free", "x_coupler.rz,!z_leg.length",
        "--known", "y_leg.length_mm=0.05±0.02", "--known", "z_slide.offset_mm=0.2",
        "--tolerance", "*.offset_mm=4", "--bound", "x_slide.offset_mm=-0.2:1",
        "--profile", "y_leg.length",
    )  # fmt: skip
    assert code == 3  # an offset is at its bound
    assert err == ""
    rows = {p["name"]: p for p in json.loads(out)["parameters"]}
    assert list(rows) == [
        "x_slide.offset", "y_slide.offset", "x_coupler.rz", "x_leg.length", "y_leg.length",
        "z_slide.offset",
    ]  # fmt: skip
    assert rows["x_slide.offset"]["at_bound"] == "lower"
    assert rows["y_slide.offset"]["prior_std"] == 2e-3
    assert (rows["y_leg.length"]["mean"], rows["y_leg.length"]["prior_std"]) == (5e-5, 1e-5)
    assert rows["y_leg.length"]["interval"][0] < rows["y_leg.length"]["value"]
    assert rows["z_slide.offset"]["free"] is False
    assert rows["z_slide.offset"]["value"] == 0.2e-3


def test_options_for_base_parameters_and_hubers_loss(root):
    code, out, _ = orthocal(
        "calibrate", root / "examples/raw-cycles", "--free", "*.offset,x_swivel.x", "--base",
        "--loss", "huber", "--details",
    )  # fmt: skip
    assert code == 0
    assert "3 base parameters, no prior, Huber's loss" in out
    assert "represents" in out


def test_simulated_session_gives_the_true_errors(root, tmp_path):
    plan = root / "examples/raw-cycles/plan.yaml"
    words = ("simulate", plan, "--out", tmp_path / "s", "--exact")
    code, _, err = orthocal(
        *words, "--error", "x_slide.offset_mm=1.5", "--error", "z_slide.offset_mm=-0.25"
    )
    assert code == 0
    assert "54 simulated readings" in err
    names = {p.name for p in (tmp_path / "s").iterdir()}
    assert names == {"session.yaml", "readings.csv", "truth.yaml"}
    assert "Simulated" in load_session(tmp_path / "s").title
    found = identified(load_session(tmp_path / "s"))
    assert found["x_slide.offset"].value == pytest.approx(1.5e-3, abs=1e-8)
    assert found["y_slide.offset"].value == pytest.approx(0.0, abs=1e-8)
    code, _, err = orthocal(*words, "--error", "x_slide.offset_mm=1")
    assert code == 2
    assert "exists already; --force overwrites it" in err


def test_drawn_errors_of_gauges_are_printed(root, tmp_path):
    """They are new if the file states no errors of these gauges, and kept if it does."""
    one, two = tmp_path / "one", tmp_path / "two"
    plan, machine = root / "examples/raw-cycles", root / "examples/raw-cycles/machine.yaml"
    code, _, err = orthocal("simulate", plan, "--errors", machine, "--out", one)
    assert code == 0
    truth = yaml.safe_load((one / "truth.yaml").read_text())["sensors"]
    scale = f"gauge.scale_ppm {truth['gauge.scale_ppm']:.4g}"
    words = f"Drawn, because {machine} does not state these errors of gauges: {scale}. To simulate"
    assert f"{words} the same gauges again: --errors {one}/truth.yaml" in " ".join(err.split())
    again = ("simulate", plan, "--errors", one / "truth.yaml", "--seed", "2", "--out", two)
    code, _, err = orthocal(*again)
    assert (code, "Drawn" in err) == (0, False)
    kept = yaml.safe_load((two / "truth.yaml").read_text())["sensors"]
    assert kept["gauge.scale_ppm"] == truth["gauge.scale_ppm"]
    assert kept["setup.yx.roll_mrad"] != truth["setup.yx.roll_mrad"]


def test_simulated_errors_depend_on_the_seed(root, tmp_path):
    plan = root / "examples/raw-cycles/plan.yaml"
    texts = []
    for folder, seed in (("a", 3), ("b", 3), ("c", 4)):
        words = ["--draw", "*_leg.length,x_coupler.*", "--seed", seed]
        assert orthocal("simulate", plan, "--out", tmp_path / folder, *words).returncode == 0
        texts.append((tmp_path / folder / "truth.yaml").read_text())
    assert texts[0] == texts[1] != texts[2]
    assert "z_leg.length_mm" in texts[0]


def test_solve_without_convergence_exits_1(experiment, monkeypatch, tmp_path):
    from orthocal.estimation.solvers import ipopt as nlp

    monkeypatch.setattr(nlp, "CONVERGED", frozenset())
    code, out, err = orthocal("calibrate", experiment, "--out", tmp_path / "none")
    assert code == 1
    assert out == ""
    assert "did not converge" in err
    assert not (tmp_path / "none").exists()


@pytest.fixture(scope="module")
def swapped(root, tmp_path_factory):
    """Directory of a session with two swapped readings, and its decision."""
    folder = tmp_path_factory.mktemp("swapped") / "session"
    session = load_session(root / "examples/workshop")
    values = session.values.copy()
    values[[12, 13]] = values[[13, 12]]
    write_session(session.with_values(values), folder)
    return folder, check_session(load_session(folder)).decision


@pytest.mark.parametrize(
    "words",
    [["calibrate", "--model", "offsets"], ["compare", "--models", "offsets", "--json"]],
    ids=" ".join,
)
def test_verdict_is_printed_although_the_solver_fails(swapped, monkeypatch, words):
    from orthocal.estimation.solvers import ipopt as nlp

    monkeypatch.setattr(nlp, "CONVERGED", frozenset())
    folder, decision = swapped
    code, out, err = orthocal(*words, folder)
    assert code == 3
    assert "converge" not in err
    if "--json" in words:
        document = json.loads(out)
        assert document["decision"] == decision.to_document()
        assert document["findings"][-1]["kind"] == "no convergence"
    else:
        printed = " ".join(out.split())
        assert f"{decision.headline} {decision.reason}" in printed
        assert printed.count("no machine that fits") == 1


def test_internal_error_exits_70(experiment, monkeypatch):
    from orthocal.assessment import assess

    def broken(*_, **__):
        raise RuntimeError("no such thing")

    monkeypatch.setattr(assess, "calibrate", broken)
    code, _, err = orthocal("calibrate", experiment)
    assert code == 70
    assert "this is a bug of orthocal" in err


def commands_of(text):
    """Panels of a help page, each a dictionary of commands and their lines."""
    panels = {}
    for line in text.splitlines():
        if re.fullmatch(r"[A-Z]\w+:", line):
            panels[line[:-1]] = rows = {}
        elif panels and line.strip():
            name, *words = line.split()
            assert line.startswith(f"  {name} "), f"the line before is too long for: {line}"
            rows[name] = " ".join(words)
    panels.pop("Options")
    return panels


def test_help_lists_the_commands_in_the_order_of_use(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = orthocal("--help")
    assert code == 0
    panels = commands_of(out)
    assert {panel: tuple(rows) for panel, rows in panels.items()} == PANELS
    assert list(panels) == ["Prepare", "Measure", "Calibrate", "Use", "Study"]
    assert "..." not in out.partition("\n")[2]
    assert "…" not in out
    assert max(map(len, out.splitlines())) <= 80
    lines = [line for rows in panels.values() for line in rows.values()]
    assert all(line.endswith(".") for line in lines)
    assert "Commands" in commands_of(orthocal("study", "--help")[1])


def test_every_command_has_help(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    names = [name for panel in PANELS.values() for name in panel if name != "study"]
    names += [f"study {name}" for name in commands_of(orthocal("study", "--help")[1])["Commands"]]
    assert len(names) == 24
    program = get_command(make_program())
    for name in names:
        made = program.commands["study"] if name.startswith("study ") else program
        assert [p.name for p in made.commands[name.split()[-1]].params if not p.help] == []
        code, out, _ = orthocal(*name.split(), "--help")
        assert code == 0
        assert f"orthocal {name} " in out.splitlines()[0]
        assert max(map(len, out.splitlines())) <= 80
        if name != "record":
            assert not re.search(r"\b(folder|told|stand|holds|by hand|own)\b", out), name


def test_version():
    assert orthocal("--version")[1].strip() == __version__


@pytest.fixture(scope="module")
def days(root, tmp_path_factory, short_reports):
    """Directory of the sessions of two days and of their calibration, and its output."""
    folder = tmp_path_factory.mktemp("days")
    plan, truth = root / "examples/raw-cycles/plan.yaml", root / "examples/raw-cycles/machine.yaml"
    sessions = folder / "monday", folder / "tuesday"
    for seed, day in enumerate(sessions):
        orthocal("simulate", plan, "--errors", truth, "--seed", seed, "--out", day)
    return folder, orthocal("calibrate", *sessions, "--details", "--out", folder / "out")


def test_several_sessions_have_one_calibration(days):
    folder, (code, out, _) = days
    assert code == 0
    assert "108 readings of 2 sessions in 7 postures, 12 setups on legs" in out
    for day in ("monday", "tuesday"):
        row = next(line.split() for line in out.splitlines() if f" {day} " in line)
        assert row[1:3] == ["54", "0.010"]
    report = (folder / "out/report.html").read_text()
    assert "Gauges and sensors" in report
    assert report.count("monday/session.yaml") == 1


def test_sessions_with_the_same_readings_are_refused(days, tmp_path):
    monday, tuesday = days[0] / "monday", days[0] / "tuesday"
    code, out, err = orthocal("calibrate", monday, tuesday, monday)
    assert (code, out) == (2, "")
    assert (
        "monday/session.yaml: is the same session as one before it; its readings would count" in err
    )
    copy = shutil.copytree(monday, tmp_path / "copy")
    with (copy / "session.yaml").open("a") as stream:
        stream.write("# Tuesday\n")
    code, _, err = orthocal("calibrate", monday, copy)
    assert code == 2
    assert err == (
        f"orthocal: {copy}/readings.csv: has the same readings as {monday}/session.yaml: a copy "
        "that was not measured again?\n"
    )
    head, first, *rows = (monday / "readings.csv").read_text().splitlines()
    (copy / "readings.csv").write_text("\n".join([head, first, f"{rows[0]}1", *rows[1:-1]]) + "\n")
    code, _, err = orthocal("check", monday, copy)
    assert code == 2
    assert f"{monday}/session.yaml except line 3: a copy" in err


@pytest.mark.parametrize("several", [False, True], ids=["one session", "two sessions"])
def test_copies_of_calibrated_sessions_do_not_validate(days, tmp_path, several):
    """With all readings, and with one of them changed."""
    one, session = days[0] / "out", days[0] / "tuesday"
    if not several:
        one = tmp_path / "one"
        words = ["--solver", "linearised", "--out", one]
        assert orthocal("calibrate", session, *words).returncode == 0
    copy = shutil.copytree(session, tmp_path / "copy")
    with (copy / "session.yaml").open("a") as stream:
        stream.write("# after entering\n")
    original = f"{session}/session.yaml"
    code, out, err = orthocal("validate", one, copy)
    assert (code, out) == (2, "")
    assert err == (
        f"orthocal: {copy}/readings.csv: has the same readings as {original}: a copy that was not "
        "measured again?\n"
    )
    head, *rows = (copy / "readings.csv").read_text().splitlines()
    rows[1] += "1"
    (copy / "readings.csv").write_text("\n".join([head, *rows]) + "\n")
    code, _, err = orthocal("validate", one, copy)
    assert code == 2
    assert f"{original} except line 3: a copy" in err
    code, _, err = orthocal("validate", one, session)
    assert "belongs to the calibration itself" in err


def test_again_repeats_the_last_of_several_sessions(days, tmp_path):
    words = ["again", days[0] / "out", "--anyway", "--out"]
    code, _, err = orthocal(*words, tmp_path / "next")
    assert code == 0, err
    named = "The readings are those of the last session, "
    assert f"{named}{days[0] / 'tuesday/session.yaml'}; --session" in err
    code, _, err = orthocal(*words, tmp_path / "chosen", "--session", days[0] / "tuesday")
    assert code == 0, err
    assert named not in err
    rows = [(tmp_path / name / "readings.csv").read_text() for name in ("next", "chosen")]
    assert rows[0] == rows[1]


def test_export_refuses_a_module_beside_offsets(days, tmp_path):
    words = ["export", days[0] / "out", "--anyway", "--to", "linuxcnc", "--out", tmp_path / "out"]
    assert orthocal(*words, "--offsets")[0] == 0
    code, _, err = orthocal(*words, "--module")
    assert code == 2
    assert "joints.ini" in err
    assert not (tmp_path / "out/kinematics.ini").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--seed nine", "'--seed': found 'nine'; expected an integer"),
        ("--seed -1", "'--seed': found '-1'; expected at least 0"),
        ("--across-mm far", "'--across-mm': found 'far'; expected a number"),
        ("--along 99", "'--along': found '99'; expected at most 50"),
        ("--gauge one.yaml --gauge two.yaml", "'--gauge': is stated twice; expected once"),
    ],
)
def test_wrong_values_of_options_are_refused(words, message):
    code, out, err = orthocal("plan", "orthoglide", *words.split())
    assert (code, out) == (2, "")
    assert f"Invalid value for {message}\n" in err


def test_exchanged_arguments_of_validate_are_named(root, tmp_path):
    session, calibration = root / "examples/raw-cycles", tmp_path / "one"
    calibration.mkdir()
    (calibration / "calibration.json").write_text("{}")
    code, _, err = orthocal("validate", session, calibration)
    assert (code, err.endswith(f": orthocal validate {calibration} {session}\n")) == (2, True)


def test_exchanged_arguments_of_import_are_named(root, tmp_path):
    table, session = tmp_path / "t.csv", tmp_path / "session"
    table.write_text("setup;posture;reading_mm\n")
    shutil.copytree(root / "examples/raw-cycles", session)
    code, _, err = orthocal("import", session, table)
    assert code == 2
    assert err == (
        f"orthocal: {table}: is no session; expected first the table, then the session: "
        f"orthocal import {table} {session}\n"
    )
    code, _, err = orthocal("import", table, tmp_path)
    assert (code, f"{tmp_path}: is no session; sessions there: {session}" in err) == (2, True)
    code, _, err = orthocal("import", table, tmp_path / "none")
    assert code == 2
    assert "Expected a table and a session.yaml or its directory, or a log and a new" in err
