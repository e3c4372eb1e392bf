"""Examples run headless and are short; commands and Python of all pages run unchanged."""

from __future__ import annotations

import json
import re
import shutil
from contextlib import nullcontext
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest
from calibrated import identified
from commands import run_here, run_line, run_orthocal, run_script
from conftest import ROOT, marked_reports, no_sensor_gains, plans_of_few_candidates
from uncompared import uncompared

import orthocal
from orthocal import calibrate, draw_scene, load_session
from orthocal.effects import registry as effect_registry
from orthocal.errors import NotIdentifiableError
from orthocal.observation.simulate import load_errors
from orthocal.planning import selection
from orthocal.sensors import registry as sensor_registry
from orthocal.session.session import Purpose

pytestmark = [
    pytest.mark.acceptance,
    pytest.mark.usefixtures("short_reports", "judged_sessions"),
]

SCRIPTS = sorted((ROOT / "examples").glob("[0-9]*.py"))


@pytest.fixture(scope="module")
def run_example(tmp_path_factory):
    """Function that runs a script once, in a temporary directory."""
    directory = tmp_path_factory.mktemp("elsewhere")
    return cache(lambda script: run_script(directory, script))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.name)
def test_example_runs_from_anywhere(run_example, script):
    done = run_example(script)
    assert done.returncode == 0
    assert done.stderr == ""
    assert done.stdout
    assert len(script.read_text().splitlines()) <= 80


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
WITH_REPORTS = ("README.md", "docs/viewing.md")
"""Pages whose commands build reports; on the others a mark replaces them."""

SHOWN = {"docs/adjusting.md": 3, "docs/controllers.md": 3, "docs/measuring.md": 2}
"""Pages that show what commands print, with the number of texts; plans of others start once."""

PLAN = "plan orthoglide --tolerance '*.offset_mm=4' --out out/monday"
"""Command whose plan its page shows with others; plans on pages of SHOWN are compared with none,
and those of other pages have few candidates, too."""


def blocks(language, page):
    """Code blocks of a language on a page."""
    text = (ROOT / page).read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def lines_of(block):
    """Commands of a shell block, with continued lines joined."""
    return block.replace("\\\n", " ").splitlines()


def commands(page):
    """Commands of a page for orthocal and for its files, with exit codes stated in comments."""
    rows = []
    for line in (line for block in blocks("sh", page) for line in lines_of(block)):
        command, _, comment = line.partition("  # ")
        if command.startswith(("orthocal ", "printf ", "cp ", "sed ", "mkdir ")):
            code = re.search(r"exit code (\d+)", comment)
            rows.append((command.strip(), int(code[1]) if code else 0))
    return rows


def with_code(language):
    return [p.relative_to(ROOT).as_posix() for p in PAGES if blocks(language, p)]


TUTORIAL = "docs/tutorial.md"


@pytest.fixture(scope="module")
def make_directory(tmp_path_factory):
    """Function that makes a directory with a copy of the examples and an empty `out`."""

    def make():
        directory = tmp_path_factory.mktemp("page")
        shutil.copytree(ROOT / "examples", directory / "examples")
        (directory / "out").mkdir()
        return directory

    return make


@pytest.fixture
def registries():
    """Sensors and effects that a page registers are removed after the test."""
    kinds = [
        (sensor_registry.sensor_kinds, sensor_registry.unregister_sensor),
        (effect_registry.effect_names, effect_registry.unregister_effect),
    ]
    before = [set(names()) for names, _ in kinds]
    yield
    for (names, unregister), known in zip(kinds, before, strict=True):
        for name in set(names()) - known:
            unregister(name)


@pytest.mark.parametrize("page", with_code("python"))
def test_python_of_a_page_runs(make_directory, registries, page):
    directory = make_directory()
    for code in blocks("python", page):
        done = run_here(directory, lambda code=code: exec(code, {"__name__": "__main__"}))
        assert (done.returncode, done.stderr) == (0, "")


@pytest.fixture(scope="module")
def run_page(make_directory, short_reports):
    """Function that runs the commands of a page in order, once: its directory, what each prints."""

    @cache
    def run(page):
        directory, printed = make_directory(), {}
        reports = nullcontext() if page in WITH_REPORTS else marked_reports()
        plans = nullcontext() if page in SHOWN else patch.object(selection, "MIN_STARTS", 1)
        with reports, plans, no_sensor_gains():
            for command, expected in commands(page):
                if command == f"orthocal {PLAN}":
                    quick = nullcontext()
                else:
                    quick = uncompared() if page in SHOWN else plans_of_few_candidates()
                with quick:
                    done = run_line(directory, command)
                assert done.returncode == expected, f"{command}: {done.stderr}"
                printed[command] = done.stdout
        return directory, printed

    return run


@pytest.mark.parametrize("page", [p for p in with_code("sh") if p != TUTORIAL])
def test_commands_of_a_page_run(run_page, page):
    assert run_page(page)[1]


def test_tutorial_shows_what_its_commands_print(root, tmp_path):
    """A text after commands holds lines that the last of them prints."""
    (tmp_path / "out").mkdir()
    text = (root / TUTORIAL).read_text()
    printed, shown = [], 0
    for language, block in re.findall(r"```(sh|text)\n(.*?)```", text, flags=re.DOTALL):
        if language == "sh":
            for line in lines_of(block):
                with marked_reports(), no_sensor_gains(), uncompared():
                    done = run_line(tmp_path, line)
                assert done.returncode == 0, f"{line}: {done.stderr}"
                printed = [row.rstrip() for row in done.stdout.splitlines()]
            continue
        shown += 1
        assert [line for line in block.splitlines() if line.rstrip() not in printed] == []
    assert shown >= 4
    # a plan for the tool error alone determines the backlash to ±17 µm, as do nearer tips
    plan = json.loads((tmp_path / "mill/first/plan.json").read_text())
    (backlash,) = plan["effects"]
    assert backlash["effect"] == "backlash"
    assert backlash["after"] <= 16e-6
    assert f"the backlash to ±{backlash['after'] * 1e3:.3f} mm" in " ".join(text.split())
    assert plan["readings"] + plan["closing_readings"] <= 28


@pytest.mark.parametrize(("page", "texts"), SHOWN.items())
def test_a_page_shows_what_its_commands_print(root, run_page, page, texts):
    """A text that follows commands shows lines that the last of them prints."""
    (_, printed), last, shown = run_page(page), "", 0
    text = (root / page).read_text()
    for language, block in re.findall(r"```(\w+)\n(.*?)```", text, flags=re.DOTALL):
        if language == "sh":
            last = [line.partition("  # ")[0].strip() for line in lines_of(block)][-1]
        elif language == "text" and last:
            lines = [line.rstrip() for line in printed[last].splitlines()]
            assert [line for line in block.splitlines() if line.rstrip() not in lines] == []
            shown += 1
            last = ""
    assert shown == texts


@pytest.mark.parametrize(
    ("page", "start", "file"),
    [
        ("docs/controllers.md", "[JOINT_0]", "out/enter/joints.ini"),
        ("docs/controllers.md", "controller:", "out/mill/second/session.yaml"),
        ("docs/measuring.md", "setups:\n  bar:", "out/bar/session.yaml"),
    ],
)
def test_a_page_shows_what_is_in_a_file(root, run_page, page, start, file):
    text = (root / page).read_text()
    assert file in text
    (shown,) = re.findall(rf"```(?:ini|yaml)\n({re.escape(start)}.*?)```", text, flags=re.DOTALL)
    assert shown in (run_page(page)[0] / file).read_text()


def test_reference_has_every_name(root):
    text = (root / "docs/reference.md").read_text()
    assert set(re.findall(r"::? orthocal\.(\w+)$", text, flags=re.M)) == set(orthocal.__all__)


EXPERIMENT = "examples/table1/experiment-2"
CALIBRATE = f"calibrate {EXPERIMENT}"


@pytest.mark.parametrize(
    ("page", "title", "command"),
    [
        ("README.md", "Calibration of orthoglide", f"{CALIBRATE} --out out/experiment-2"),
        ("docs/results.md", "Calibration of orthoglide", f"{CALIBRATE} --out out/experiment-2"),
        ("docs/results.md", "Parameters\n", f"{CALIBRATE} --details"),
        ("docs/results.md", "Tool error\n", f"{CALIBRATE} --details"),
        ("docs/results.md", "Recommended model", f"compare {EXPERIMENT}"),
        ("docs/planning.md", "Expected tool error", PLAN),
        (
            "docs/planning.md",
            "The paper's six equations are",
            "study linearisation orthoglide --out out/linearisation",
        ),
    ],
)
def test_results_on_a_page_are_what_the_command_prints(root, run_page, page, title, command):
    """The page states the command, or the command without --out."""
    shown = next(b for b in blocks("text", page) if title in b)
    of_page = f"orthocal {command}" in [c for c, _ in commands(page)]
    out = run_page(page)[1][f"orthocal {command}"] if of_page else output_of(root, command)
    assert of_page == ("--out" in command)
    printed = [line.rstrip() for line in out.splitlines()]
    lines = [line.rstrip() for line in shown.splitlines()]
    if title.startswith("Calibration"):  # the complete output
        assert lines == printed
    assert set(lines) <= set(printed)


@cache
def output_of(folder, command):
    return run_orthocal(folder, *command.split()).stdout


def test_results_of_the_papers_readings_are_those_of_the_example(run_example):
    """The table holds actual tool errors, which agree with the expected ones."""
    text = (ROOT / "docs/results.md").read_text()
    script = ROOT / "examples/02_what_readings_are_worth.py"
    done = run_example(script)
    rows = {}
    for line in done.stdout.split("\n\n")[0].splitlines()[1:]:
        rows[line[:36].strip()] = [float(v) / 1e3 for v in line[36:].split()]
    mm = {label: actual for label, (_, actual) in rows.items()}
    first = f"{mm['first round, offsets']:.2f} mm | {mm['first round, full']:.2f} mm"
    again = f"{mm['offsets entered, offsets']:.2f} mm | {mm['offsets entered, full']:.3f} mm"
    assert f"| 18 readings: zero, maximum and minimum in six setups | {first} |" in text
    assert f"| 18 more, with these offsets entered | {again} |" in text
    expected, actual = rows["as of a line, exactly"]
    assert actual > 1.4 * expected  # a wrong gauge model is too optimistic
    for label in ("first round, full", "offsets entered, full"):
        expected, actual = rows[label]
        assert actual < 1.15 * expected


def test_enlargement_and_residuals_on_the_pages_are_correct(root):
    text = " ".join((ROOT / "README.md").read_text().split())
    results = " ".join((ROOT / "docs/results.md").read_text().split())
    calibration = calibrate(root / "examples/table1/experiment-2")
    scene = draw_scene(calibration)
    enlarged = f"enlarged {scene.exaggeration:g} times, arrows {scene.arrow_scale:g} times"
    assert enlarged in text
    assert "the residuals are ten times the noise of the gauge" in results
    noise, gauge = calibration.noise, calibration.gauges[0].sigma
    assert noise.residual_sigma / gauge == pytest.approx(10.0, abs=0.5)


def test_the_five_bar_of_a_page_is_the_example(root):
    """Its tool is where circles about the ends of both arms intersect."""
    _, _, text = (root / "examples/fivebar/fivebar.yaml").read_text().partition("\n")
    assert text in blocks("yaml", "docs/robots.md")
    robot = orthocal.load_robot(root / "examples/fivebar")
    assert {"frame.tip1.x", "frame.tip2.x"} <= set(robot.parameters.complete)
    zero = np.sqrt(0.2**2 - (0.06 + 0.15 * np.cos(np.radians(50))) ** 2)
    base = -0.15 * np.sin(np.radians(50)) - zero
    for angles in ([130.0, 50.0], [117.0, 62.0], [150.0, 55.0]):
        ends = [
            np.array([side * 0.06 + 0.15 * np.cos(a), base + 0.15 * np.sin(a)])
            for side, a in zip((-1, 1), np.radians(angles), strict=True)
        ]
        half = 0.5 * (ends[1] - ends[0])
        across = np.array([-half[1], half[0]]) / np.linalg.norm(half)
        tool = ends[0] + half + across * np.sqrt(0.2**2 - half @ half)
        found = orthocal.Machine(robot, {}).forward(np.radians(angles))
        assert np.abs(found[:2] - tool).max() < 1e-6  # the URDF states the base to 1 µm


def test_session_on_a_page_can_be_read(tmp_path):
    (session,) = blocks("yaml", "docs/sessions.md")
    readings = next(b for b in blocks("text", "docs/sessions.md") if "reading_mm" in b)
    (tmp_path / "session.yaml").write_text(session)
    (tmp_path / "readings.csv").write_text(readings)
    loaded = load_session(tmp_path)
    np.testing.assert_allclose(loaded.values, [0.0, 0.21e-3, -0.18e-3], rtol=1e-12)
    assert loaded.purpose == Purpose("full")
    assert loaded.robot.parameters.stated == {"*.offset_mm": 4.0}
    with pytest.raises(NotIdentifiableError, match=r"do not determine z_slide\.offset"):
        calibrate(loaded, "offsets")  # "If readings leave an offset open, orthocal says so."


@pytest.mark.parametrize("name", ["biglide", "inclined_orthoglide", "linear_delta"])
def test_simulated_examples_give_the_true_offsets(root, name):
    folder = root / "examples" / name
    assert (folder / "session.yaml").read_text().startswith("# Simulated readings, not measured.")
    session = load_session(folder)
    truth = load_errors(folder / "truth.yaml", session.robot)
    calibration = identified(session)
    for drive in session.robot.drives:
        estimate = calibration[f"{drive.name}.offset"]
        assert abs(estimate.value - truth[estimate.name]) < 3.0 * estimate.std
