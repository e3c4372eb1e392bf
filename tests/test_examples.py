"""Examples run headless and stay short; commands and Python of all pages run as they stand."""

from __future__ import annotations

import json
import re
import shutil
from functools import cache

import numpy as np
import pytest
from commands import run_here, run_line, run_orthocal, run_script
from conftest import ROOT

import orthocal
from orthocal import calibrate, draw_scene, load_session
from orthocal.effects import registry as effect_registry
from orthocal.errors import NotIdentifiableError
from orthocal.observation.simulate import load_errors
from orthocal.sensors import registry as sensor_registry
from orthocal.session.session import Purpose

pytestmark = pytest.mark.usefixtures("short_reports")

SCRIPTS = sorted((ROOT / "examples").glob("[0-9]*.py"))


@pytest.fixture(scope="module")
def run_example(tmp_path_factory):
    """What a script prints; run once, elsewhere, for all that look at it."""
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    return cache(lambda script: run_script(elsewhere, script))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.name)
def test_an_example_runs_from_anywhere(run_example, script):
    done = run_example(script)
    assert done.returncode == 0
    assert done.stderr == ""
    assert done.stdout
    assert len(script.read_text().splitlines()) <= 80


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(language, page):
    """What a page shows of a language."""
    text = (ROOT / page).read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def commands(page):
    """Those of a page's shell blocks that are orthocal's, or make files for it; `make` runs these
    tests. Where one ends otherwise than well, a comment behind it says so."""
    found = []
    for block in blocks("sh", page):
        for line in block.replace("\\\n", " ").splitlines():
            command, _, comment = line.partition("  # ")
            if command.startswith(("orthocal ", "printf ", "cp ", "sed ", "mkdir ")):
                code = re.search(r"exit code (\d+)", comment)
                found.append((command, int(code[1]) if code else 0))
    return found


def with_code(language):
    return [p.relative_to(ROOT).as_posix() for p in PAGES if blocks(language, p)]


TUTORIAL = "docs/tutorial.md"


@pytest.fixture(scope="module")
def beside_examples(tmp_path_factory):
    """Makes a folder with a copy of the examples, and a place for what is written."""

    def make():
        folder = tmp_path_factory.mktemp("page")
        shutil.copytree(ROOT / "examples", folder / "examples")
        (folder / "out").mkdir()
        return folder

    return make


@pytest.fixture
def registries():
    """Sensors and effects that a page registers exist within the test only."""
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
def test_the_python_of_a_page_runs(beside_examples, registries, page):
    folder = beside_examples()
    for code in blocks("python", page):
        done = run_here(folder, lambda code=code: exec(code, {"__name__": "__main__"}))
        assert (done.returncode, done.stderr) == (0, "")


@pytest.fixture(scope="module")
def run_page(beside_examples, short_reports):
    """What each command of a page prints, run once, one after the other, as they stand."""

    @cache
    def run(page):
        folder, found = beside_examples(), {}
        for command, expected in commands(page):
            done = run_line(folder, command)
            assert done.returncode == expected, f"{command}: {done.stderr}"
            found[command.strip()] = done.stdout
        return found

    return run


@pytest.mark.parametrize("page", [p for p in with_code("sh") if p != TUTORIAL])
def test_the_commands_of_a_page_run(run_page, page):
    """One after the other, as they stand, in a folder with a copy of the examples."""
    assert run_page(page)


def test_what_the_tutorial_shows_is_what_its_commands_print(root, tmp_path):
    """A text after commands holds lines that the last of them prints."""
    (tmp_path / "out").mkdir()
    text = (root / TUTORIAL).read_text()
    printed, shown = [], 0
    for language, block in re.findall(r"```(sh|text)\n(.*?)```", text, flags=re.DOTALL):
        if language == "sh":
            for line in block.replace("\\\n", " ").splitlines():
                done = run_line(tmp_path, line)
                assert done.returncode == 0, f"{line}: {done.stderr}"
                printed = [said.rstrip() for said in done.stdout.splitlines()]
            continue
        shown += 1
        assert [line for line in block.splitlines() if line.rstrip() not in printed] == []
    assert shown >= 4
    # the smallest tool error alone leaves ±17 µm here, tips nearer to the rods as much
    plan = json.loads((tmp_path / "mill/first/plan.json").read_text())
    (backlash,) = plan["effects"]
    assert backlash["effect"] == "backlash"
    assert backlash["after"] <= 16e-6
    assert f"the backlash to ±{backlash['after'] * 1e3:.3f} mm" in " ".join(text.split())
    assert plan["readings"] + plan["closing_readings"] <= 28
    second = orthocal.load_calibration(tmp_path / "out/two")
    enter = next(e.enter for e in second.assessment.entries if e.drive == "x_slide") * 1e3
    identified = second["x_slide.offset"].value * 1e3
    said = " ".join((root / "docs/results.md").read_text().split())
    assert f"x_slide has {enter:+.3f} mm to enter and {identified:+.3f} mm identified" in said


def test_the_reference_has_every_name(root):
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
        (
            "docs/planning.md",
            "Expected tool error",
            "plan orthoglide --tolerance '*.offset_mm=4' --out out/monday",
        ),
        (
            "docs/planning.md",
            "The paper's six equations are",
            "study linearisation orthoglide --out out/linearisation",
        ),
    ],
)
def test_printed_results_on_a_page_are_the_real_ones(root, run_page, page, title, command):
    """By the command as it stands there, or else without what is written beside."""
    shown = next(b for b in blocks("text", page) if title in b)
    of_page = f"orthocal {command}" in [c for c, _ in commands(page)]
    said = run_page(page)[f"orthocal {command}"] if of_page else said_by(root, command)
    assert of_page == ("--out" in command)
    printed = [line.rstrip() for line in said.splitlines()]
    for line in shown.splitlines():
        assert line.rstrip() in printed
    if title.startswith("Calibration"):  # the whole of it
        assert [line.rstrip() for line in shown.splitlines()] == printed


@cache
def said_by(folder, command):
    """What a command prints."""
    return run_orthocal(folder, *command.split()).stdout


def test_what_is_said_of_the_papers_readings_is_what_the_example_prints(run_example):
    """The table holds actual tool errors, which the expected ones agree with."""
    text = (ROOT / "docs/results.md").read_text()
    script = ROOT / "examples/02_what_readings_are_worth.py"
    done = run_example(script)
    rows = {}
    for line in done.stdout.split("\n\n")[0].splitlines()[1:]:
        rows[line[:36].strip()] = [float(v) / 1e3 for v in line[36:].split()]
    kept = {label: sizes[1] for label, sizes in rows.items()}
    first = f"{kept['first round, offsets']:.2f} mm | {kept['first round, full']:.2f} mm"
    again = f"{kept['offsets entered, offsets']:.2f} mm | {kept['offsets entered, full']:.3f} mm"
    assert f"| 18 readings: zero, maximum and minimum in six setups | {first} |" in text
    assert f"| 18 more, with these offsets entered | {again} |" in text
    promised, left = rows["as of a line, exactly"]
    assert left > 1.4 * promised  # a wrong gauge promises too much
    for label in ("first round, full", "offsets entered, full"):
        promised, left = rows[label]
        assert left < 1.15 * promised  # as promised


def test_the_enlargement_and_the_residuals_on_the_pages_are_right(root):
    text = " ".join((ROOT / "README.md").read_text().split())
    said = " ".join((ROOT / "docs/results.md").read_text().split())
    calibration = calibrate(root / "examples/table1/experiment-2")
    scene = draw_scene(calibration)
    enlarged = f"enlarged {scene.exaggeration:g} times, arrows {scene.arrow_scale:g} times"
    assert enlarged in text
    assert "the residuals are ten times the noise of the gauge" in said
    noise, gauge = calibration.noise, calibration.session.gauge_sigma
    assert noise.residual_sigma / gauge == pytest.approx(10.0, abs=0.5)


def test_the_session_that_a_page_shows_can_be_read(tmp_path):
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
def test_simulated_sessions_of_packaged_robots_give_the_truth(root, name):
    """Each says that it is simulated, and the offsets to enter are within their uncertainty."""
    folder = root / "examples" / name
    assert (folder / "session.yaml").read_text().startswith("# Simulated readings, not measured.")
    session = load_session(folder)
    truth = load_errors(folder / "truth.yaml", session.robot)
    found = calibrate(session)
    for drive in session.robot.drives:
        estimate = found[f"{drive.name}.offset"]
        assert abs(estimate.value - truth[estimate.name]) < 3.0 * estimate.std
