"""orthocal plan: output, files and refused input."""

from __future__ import annotations

import html
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from dataclasses import replace

import pytest
from commands import run_orthocal
from plan_searches import candidates_of, search_among
from planned import FEW
from processes import children_of, is_running, until
from uncompared import uncompared

from orthocal import MeasuringPlan, load_plan, load_session, plan_readings, summarize, write_session
from orthocal.planning.equipment import USUAL_BALL, Equipment
from orthocal.planning.expected_error import CRITERIA
from orthocal.runtime import worker_pool
from orthocal.runtime.interrupts import INTERRUPTED
from orthocal.session.session import Purpose

pytestmark = pytest.mark.usefixtures("without_sensor_gains", "module_of_few_machines")

QUICK = ["--along", "3", "--across-mm", "0", "--sections", "0.5", "--starts", "1"]
BACKLASHES = ("0,0", "-0.1", "0,0,9", "none", "0.02,,0")
"""Values that are refused."""
DIAL = """sigma_mm: 0.002
resolution_mm: 0.001
range_mm: [-1, 1]
tip: {blade: {width_mm: 20}}
direction_tolerance_mrad: 10
"""


def test_a_plan_is_written_ready_to_measure(tmp_path):
    dial = tmp_path / "dial.yaml"
    dial.write_text(DIAL)
    out = tmp_path / "monday"
    entered = ["--tolerance", "*.offset_mm=1"]
    backlash = ["--backlash", "0,0.02,0"]
    words = ["plan", "orthoglide", *QUICK, *entered, *backlash, "--gauge", dial, "--out", out]
    code, text, err = run_orthocal(".", *words)
    assert code == 0
    assert "24 readings (6 closing) in 6 setups, about 72 min" in text
    assert re.search(r"this plan +6 +24 ", text)
    assert len(text.splitlines()) <= 45
    assert {p.name for p in out.iterdir()} == {
        *("session.yaml", "readings.csv", "plan.json", "plan.svg", "sheet.html"),
        *("01-yx.ngc", "02-zx.ngc", "03-xy.ngc", "04-zy.ngc", "05-xz.ngc", "06-yz.ngc"),
    }
    session = load_plan(out)
    assert session.purpose == Purpose("full")
    assert session.robot.parameters.stated == {"*.offset_mm": 1.0}
    assert [trim.backlash for trim in session.compensation] == pytest.approx([0.0, 2e-5, 0.0])
    assert session.gauge.range == (-1e-3, 1e-3)
    assert {s.sensor.tip.form for s in session.setups.values()} == {"blade"}
    assert {s.sensor.mounting.direction for s in session.setups.values()} == {5e-3}
    rows = (out / "readings.csv").read_text().splitlines()
    assert rows[0] == "setup,posture,cycle,reading_mm"
    assert all(row.endswith(",") for row in rows[1:])
    assert len(rows) == 1 + 24
    assert "an empty readings.csv" in err
    assert "not stated" not in err
    next_commands = [f"orthocal record {out}", f"orthocal calibrate {out} --out {out}-calibration"]
    assert [line.strip() for line in err.splitlines()[-2:]] == next_commands
    document = json.loads((out / "plan.json").read_text())
    assert document["readings"] + document["closing_readings"] == 24
    assert (out / "plan.svg").read_text().startswith('<?xml version="1.0"')
    # existing files are not overwritten
    code, _, err = run_orthocal(".", *words)
    assert code == 2
    assert f"orthocal: {out / 'session.yaml'}: exists already; --force overwrites it" in err


def test_the_plan_does_not_depend_on_the_number_of_processes(monkeypatch, tmp_path):
    """Processes compare numbers of readings, run searches and evaluate the plan."""
    monkeypatch.setattr(worker_pool, "can_fork", lambda: True)
    results = []
    for workers in (1, 2):
        out = tmp_path / str(workers) / "plan"  # printed commands name its last part
        few = "--model offsets --hours 0.4".split()
        words = [*QUICK[:-1], 2, *few, "--workers", workers, "--out", out]
        with uncompared():
            code, text, err = run_orthocal(".", "plan", "orthoglide", *words)
        assert code == 0
        files = {p.name: p.read_bytes() for p in out.iterdir()}
        results.append((text, err.replace(str(out), ""), files))
    assert results[0] == results[1]


def test_an_error_in_a_worker_process_is_reported(monkeypatch):
    monkeypatch.setattr(worker_pool, "can_fork", lambda: True)
    words = ["orthoglide", *QUICK[:-1], 2, "--tolerance", "*.offset_mm=80", "--workers", 2]
    code, out, err = run_orthocal(".", "plan", *words)
    assert (code, out) == (2, "")
    last = err.splitlines()[-1]
    words = "no setup can have 3 readings within the gauge's range, of which the tolerances"
    assert last.startswith(f"orthocal: plan: {words} of the machine need")


@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux only")
def test_an_interrupted_plan_ends_its_worker_processes(tmp_path):
    out = tmp_path / "monday"
    many = ["--along", "5", "--sections", "0.5", "--starts", "100", "--workers", "2"]
    words = ["plan", "orthoglide", *many, "--out", str(out)]
    run = subprocess.Popen(
        [sys.executable, "-m", "orthocal", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    until(lambda: len(children_of(run.pid)) == 2)
    children = [int(p) for p in children_of(run.pid)]
    os.kill(run.pid, signal.SIGINT)  # to the parent alone
    assert run.wait() == INTERRUPTED
    until(lambda: not any(is_running(p) for p in children))
    assert b"bug" not in run.stderr.read()
    run.stderr.close()
    assert not out.exists()


def test_a_dial_without_a_tip_has_the_usual_ball(tmp_path):
    """A dial of the packaged sessions without a tip reads the centre line, as in the paper."""
    dial, out = tmp_path / "dial.yaml", tmp_path / "out"
    dial.write_text("sigma_mm: 0.005\nrange_mm: [-5, 5]\n")
    words = ["plan", "orthoglide", *QUICK, "--gauge", dial, "--out", out]
    with uncompared():
        code, _, err = run_orthocal(".", *words)
    assert code == 0
    assert f"Gauge: ball of 3 mm diameter (not stated in {dial}). State another tip" in err
    assert {s.sensor.tip for s in load_plan(out).setups.values()} == {USUAL_BALL}


def test_offsets_that_too_few_readings_do_not_determine_are_named():
    with uncompared():
        code, text, err = run_orthocal(".", "plan", "orthoglide", *QUICK, "--hours", "0.2")
    assert code == 0
    leg, direction = re.search(r"leg ([xyz]), gauge in -?([xyz])", text).groups()
    (other,) = {"x", "y", "z"} - {leg, direction}
    words = " ".join(text.split())
    assert f"These readings do not determine the offset of {other}_slide." in words
    assert err.endswith("--out DIRECTORY writes session, sheet and programs.\n")


def test_further_setups_of_a_session_are_planned(root, tmp_path):
    session = tmp_path / "workshop"
    moved = replace(load_session(root / "examples/workshop"), controller_origin=(0.1, 0.0, 0.0))
    write_session(moved, session)
    option, out = ["--tolerance", "*.offset_mm=8"], tmp_path / "out"
    words = ["plan", session, "--add", 2, *QUICK, *option, "--out", out]
    with uncompared():
        code, text, err = run_orthocal(".", *words)
    assert code == 0
    assert load_plan(out).controller_origin == moved.controller_origin
    document = json.loads((out / "plan.json").read_text())
    assert document["setups"] == 2
    assert document["expected"]["aligned_um"] < document["before"]["aligned_um"]
    calibrating = ["orthocal", "calibrate", str(session), str(out), *option]
    assert shlex.split(err.splitlines()[-1]) == [*calibrating, "--out", f"{out}-calibration"]
    inside = f"orthocal calibrate {os.path.relpath(session, out)} . {shlex.join(option)}"
    inside += " --out ../out-calibration"
    assert f"<code>{inside}</code>" in html.unescape((out / "sheet.html").read_text())
    assert f"# {inside}\n" in (out / "session.yaml").read_text()
    printed = " ".join(text.split())
    words = r"([\d.]+) mm with these readings added, ([\d.]+) mm with those of the session alone"
    after, before = map(float, re.search(words, printed).groups())
    assert after < before
    assert "now" not in printed.partition("Beyond")[0]


def plan_for(robot, criterion):
    return plan_readings(
        robot, "full", setups=3, equipment=Equipment(**FEW), criterion=criterion, starts=1
    )


@pytest.fixture(scope="module")
def headline(orthoglide):
    """Plan with the smallest RMS tool error after alignment."""
    return plan_for(orthoglide, "aligned")


def test_a_plan_is_summarised(headline):
    assert isinstance(headline, MeasuringPlan)
    assert "with all identified errors corrected " in summarize(headline)
    assert "Largest contributions" in summarize(headline, details=True)


def test_other_gauges_without_a_gain_are_not_listed(headline):
    first, second, *_ = headline.other_gauges
    mirror = replace(first, name="a mirror", expected=headline.expected)
    text = summarize(replace(headline, other_gauges=(mirror,)))
    assert "a mirror: " not in text
    assert "None (a mirror) gains 2 %" in text
    better = replace(second, expected=halve(headline.expected))
    text = summarize(replace(headline, other_gauges=(mirror, better)))
    assert f"The same readings with {second.name}: " in text
    assert "mirror" not in text


def test_a_number_of_setups_is_proposed_unless_the_plan_is_as_good(headline):
    enough = headline.enough
    proposed = f"With {enough.setups} setups"
    shorter = replace(enough, minutes=enough.minutes - 15.0, error=1.05 * enough.error)
    sentence = summarize(replace(headline, stage=shorter)).split(proposed)[1]
    assert "µm after a second measurement. More setups" in " ".join(sentence.split())
    for factor, minutes in ((0.99, -15.0), (1.01, 1.0)):
        as_good = replace(enough, minutes=enough.minutes + minutes, error=factor * enough.error)
        assert "setups gain less than 5 % an hour" in summarize(replace(headline, stage=as_good))
        assert proposed not in summarize(replace(headline, stage=as_good))
    longer = replace(as_good, minutes=enough.minutes + 60.0)
    assert proposed in summarize(replace(headline, stage=longer))


def halve(expected):
    """Expected tool error of half the size."""
    sizes = expected.tool.sizes
    half = replace(sizes.aligned, rms=0.5 * sizes.aligned.rms)
    return replace(expected, tool=replace(expected.tool, sizes=replace(sizes, aligned=half)))


@pytest.fixture(scope="module")
def searches(headline):
    """A search for each criterion, and the information of its plan."""
    equipment = Equipment(along=5, across=0.0, sections=(0.4, 0.6))
    forecast, found = headline.forecast, {}
    candidates = candidates_of(forecast, equipment, spare_range=3.0)
    for criterion in CRITERIA:
        search = search_among(candidates, forecast, criterion=criterion)
        found[criterion] = search, search.choose([3, 3, 3], starts=1).information
    return found


@pytest.mark.parametrize("criterion", CRITERIA[1:])
def test_a_plan_is_best_by_its_criterion(searches, criterion):
    """The other plan minimises the RMS tool error after alignment."""
    (own, of_own), (other, of_other) = searches[criterion], searches["aligned"]
    assert own.error_of(of_own) < 0.9995 * own.error_of(of_other)
    assert other.error_of(of_other) < 0.995 * other.error_of(of_own)


def test_a_plan_has_the_criterion_that_is_stated(orthoglide, headline):
    with uncompared():
        plan = plan_for(orthoglide, "A")
    assert plan.criterion == "A"
    traces = []
    for p in (plan, headline):
        after = p.forecast.about_nominal(p.session)
        traces.append((after.covariance.diagonal() / after.prior_stds**2).sum())
    assert traces[0] < traces[1]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        *((["orthoglide", f"--backlash={b}"], "orthocal: --backlash: ") for b in BACKLASHES),
        (["orthoglide", "--backlash", 0, "--ini", "mill.ini"], "--backlash: found with --ini; exp"),
        (["nowhere"], "nowhere: there is no such file or directory"),
        (["orthoglide", "--add", 2], "--add: needs a session; found a robot"),
        (["orthoglide", "--criterion", "F"], "criterion: found 'F'; expected one of aligned"),
        (["orthoglide", "--box", "-10"], "--box: found '-10'; expected half the side of a cube"),
        (["orthoglide", "--box", "5:1"], "--box: found '5:1'; expected half the side of a cube"),
        (["orthoglide", "--box", "-5:1,-5:1"], "--box: has 2 ranges; expected one for all, or one"),
        (["orthoglide", "--workspace-mm", "x"], "--workspace-mm: it is 'x'; expected a number"),
        (
            ["orthoglide", "--workspace-mm", "120"],
            "--workspace-mm: the machine does not reach the workspace ±120 mm (cannot be reached: "
            "joint 'z_slide' would be at 395.1 mm, outside its limits 120 ... 390 mm); the "
            "largest box of this shape is ±79 mm",
        ),
        (["orthoglide", "--sections", "0.5,1.5"], "--sections: found 1.5; expected 0 (root) to 1"),
        (["orthoglide", "--sections", "half"], "--sections: part is 'half'; expected a number"),
        (["orthoglide", "--touches", "c"], "touches: 'c' is not a rod of leg x; rods: a, b"),
        (["orthoglide", "--model", "all"], "'all' is not a model of this robot; models: offsets"),
        (
            ["orthoglide", "--minutes-per-setup", 0],
            "--minutes-per-setup: found 0; expected a number between 0 and",
        ),
    ],
)
def test_invalid_options_are_refused(words, message):
    code, out, err = run_orthocal(".", "plan", *words)
    assert (code, out) == (2, "")
    assert message in err.splitlines()[-1]
    assert "computing" not in err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("range_mm: [-1, 1]\n", "dial.yaml: sigma_mm: is missing; a plan needs the repeatability"),
        ("sigma_mm: 0.005\nstand: block\n", "dial.yaml: stand: unknown key"),
        ("sigma_mm: 0.005\ndirection_tolerance_mrad: -1\n", "direction_tolerance_mrad: found '-1'"),
        ("- 1\n", "dial.yaml: "),
    ],
)
def test_an_invalid_dial_is_refused(tmp_path, text, message):
    dial = tmp_path / "dial.yaml"
    dial.write_text(text)
    code, _, err = run_orthocal(".", "plan", "orthoglide", "--gauge", dial)
    assert code == 2
    assert message in err


def test_the_controller_is_stated_once(tmp_path):
    words = ["--backlash", "0", "--ini", tmp_path / "machine.ini"]
    code, _, err = run_orthocal(".", "plan", "orthoglide", *words)
    assert (code, err) == (2, "orthocal: --backlash: found with --ini; expected one\n")
