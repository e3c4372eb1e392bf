"""What commands overwrite: their own results; nothing of somebody else; no measured reading."""

from __future__ import annotations

import shutil
from functools import cache
from unittest.mock import patch

import pytest
from calibrated import EXPERIMENT_2, calibrated
from commands import run_orthocal
from conftest import marked_pictures
from folders import files_of
from linuxcnc import few_nodes

from orthocal import write_calibration
from orthocal.cli.overwriting import WRITTEN
from orthocal.export.linuxcnc import approximation, export


@pytest.fixture(scope="module", autouse=True)
def cheap_results(short_reports, judged_sessions):
    """Short reports, and one module of few nodes: complete ones have tests of their own."""

    @cache
    def approximate(**options):
        return approximation.approximate(calibrated(EXPERIMENT_2), **options)

    with (
        few_nodes(),
        marked_pictures(),
        patch.object(export, "approximate", lambda _, **o: approximate(**o)),
    ):
        yield


MINE = "# my notes about orthocal\n"
PROGRAM = "G21 G90\nG0 X0 Y0 Z0\nG1 X10 Y-10 F300\nM2\n"

QUICK = ("--solver", "linearised")

RESULTS = {
    ("report", "one"): ["report.html"],
    ("sheet", "session", "--out", "out"): ["sheet.html", "01-xy.ngc"],
    ("calibrate", "session", *QUICK, "--out", "out"): ["calibration.json"],
    ("export", "one", "--to", "yaml", "--out", "out"): ["errors.yaml"],
    ("export", "one", "--to", "table", "--out", "out"): ["corrections.csv"],
    ("export", "one", "--to", "urdf", "--out", "out"): ["orthoglide.urdf", "orthoglide.yaml"],
    ("export", "one", "--to", "linuxcnc", "--out", "out"): ["README.md", "joints.ini"],
    ("export", "one", "--to", "linuxcnc", "--module", "--within", "10", "--out", "out"): [
        *("kinematics.ini", "orthocal_core.c"),
    ],
    ("study", "sensitivity", "session", "--out", "out"): ["study.json", "study.svg"],
    ("correct", "one", "program.ngc", "--out", "out/part.ngc"): ["part.ngc"],
}
"""A command and the names of results that it writes."""


@pytest.fixture
def folder(root, tmp_path):
    """A session, a calibration of it and a program."""
    shutil.copytree(root / "examples" / EXPERIMENT_2, tmp_path / "session")
    (tmp_path / "one").mkdir()
    write_calibration(calibrated(EXPERIMENT_2), tmp_path / "one/calibration.json")
    (tmp_path / "program.ngc").write_text(PROGRAM)
    return tmp_path


@pytest.mark.parametrize("words", RESULTS, ids=lambda words: RESULTS[words][0])
def test_a_result_replaces_its_own_alone(folder, words):
    names = RESULTS[words]
    out = folder / ("one" if words[0] == "report" else "out")
    for _ in range(2):  # the second one replaces the first
        done = run_orthocal(folder, *words)
        assert done.returncode == 0, done.stderr
    written = {name: (out / name).read_bytes() for name in names}
    for name in names:
        file = out / name
        for other in out.iterdir():
            if other.name != "calibration.json" or name == "calibration.json":
                other.unlink()
        file.write_text(MINE)
        done = run_orthocal(folder, *words)
        assert done.returncode == 2
        where = file.relative_to(folder)
        refusal = f"{where}: exists, and orthocal did not write it; --force overwrites it"
        assert refusal in done.stderr
        assert file.read_text() == MINE
        assert {p.name for p in out.iterdir()} <= {name, "calibration.json"}
        file.unlink()
    for name in names:
        (out / name).write_text(MINE)
    assert run_orthocal(folder, *words, "--force").returncode == 0
    for name in names:
        if name not in ("calibration.json", "report.html"):  # these state times
            assert (out / name).read_bytes() == written[name]


def test_lines_for_a_controller_are_not_replaced_by_others(folder):
    """They record what was entered, and `again --ini` reads them."""
    words = ("export", "one", "--to", "linuxcnc", "--out", "out")
    homes = ("--home-offset", "75,-75,75")
    assert run_orthocal(folder, *words, *homes).returncode == 0
    lines = folder / "out/joints.ini"
    entered = lines.read_text()
    edited = entered.replace("HOME_OFFSET = ", "HOME_OFFSET = 1", 1)
    for text, options in ((entered, ()), (edited, homes)):
        lines.write_text(text)
        before = files_of(folder / "out")
        done = run_orthocal(folder, *words, *options)
        assert done.returncode == 2
        assert "out/joints.ini: contains other lines" in done.stderr
        assert files_of(folder / "out") == before
    assert run_orthocal(folder, *words, *homes, "--force").returncode == 0
    assert lines.read_text() == entered


def test_the_exported_robot_does_not_replace_the_nominal_one(folder, root):
    shutil.copytree(root / "robots/orthoglide", folder / "robot")
    done = run_orthocal(folder, "export", "one", "--to", "urdf", "--out", "robot")
    assert done.returncode == 2
    assert "robot/orthoglide.urdf: exists, and" in done.stderr


def test_exports_are_marked_once(folder):
    """Also that of a calibration of an exported robot."""
    words = ("export", "one", "--to", "urdf", "--out", "out")
    assert run_orthocal(folder, *words).returncode == 0
    session = folder / "session/session.yaml"
    session.write_text(session.read_text().replace("robot: orthoglide", "robot: ../out"))
    assert run_orthocal(folder, "calibrate", "session", *QUICK, "--out", "one").returncode == 0
    assert run_orthocal(folder, *words).returncode == 0
    for name in ("orthoglide.urdf", "orthoglide.yaml"):
        assert (folder / "out" / name).read_text().count(WRITTEN) == 1


def test_measured_readings_are_never_replaced(folder):
    trace = folder / "trace.csv"
    trace.write_text("x_mm,y_mm,z_mm,reading_mm\n0,0,0,0\n")
    for words in (
        ("plan", "orthoglide"),
        ("again", "one"),
        ("simulate", "session", "--error", "x_slide.offset_mm=1"),
        ("trace", "session", f"yx={trace}"),
    ):
        for force in ([], ["--force"]):
            before = files_of(folder / "session")
            done = run_orthocal(folder, *words, "--out", "session", *force)
            assert done.returncode == 2, words
            assert ("does not overwrite" if force else "exists already") in done.stderr
            assert files_of(folder / "session") == before


INVALID = {
    "a robot that is not there": lambda text: text.replace("robot: orthoglide", "robot: gone"),
    "a key that does not exist": lambda text: text + "colour: blue\n",
    "no YAML": lambda text: text + "] [\n",
    "no session.yaml": None,
    "a plan without the table": lambda text: text.replace("readings: readings.csv\n", ""),
}


TABLES = [
    ("setup;posture;cycle;reading_mm\nyx;zero;1;-0,02\nyx;x_max;1;\n", "1 reading,"),
    ("setup,posture,x_mm,y_mm,z_mm\ntrack,a,1.5,2,3\n", "1 reading,"),
    ("Aufbau\tStellung\tMesswert\nyx\tzero\t0,5\nyx\tx_max\t.3\n", "2 readings"),
]
AS_MEASURED = (None, "6 readings")


@pytest.mark.parametrize(
    ("invalid", "table", "count"),
    [*((name, *AS_MEASURED) for name in INVALID), *(("no YAML", *table) for table in TABLES)],
)
def test_readings_of_a_session_that_does_not_load_are_not_replaced(folder, invalid, table, count):
    change, session = INVALID[invalid], folder / "session/session.yaml"
    if change is None:
        session.unlink()
    else:
        session.write_text(change(session.read_text()))
    readings = folder / "session/readings.csv"
    if table is not None:
        readings.write_text(table)
    before = readings.read_bytes()
    words = ("again", "one", "--out", "session", "--force")
    done = run_orthocal(folder, *words)
    assert done.returncode == 2
    assert f"session/readings.csv: contains {count}" in done.stderr
    assert "--force does not overwrite" in done.stderr
    assert readings.read_bytes() == before


@pytest.mark.parametrize("table", [None, "setup,posture,cycle,reading_mm\nyx,zero,1,\n", ""])
def test_a_plan_that_does_not_load_is_replaced(folder, table):
    session, readings = folder / "session/session.yaml", folder / "session/readings.csv"
    session.write_text(session.read_text() + "colour: blue\n")
    readings.unlink()
    if table is not None:
        readings.write_text(table)
    assert run_orthocal(folder, "again", "one", "--out", "session", "--force").returncode == 0


def test_a_new_plan_removes_what_orthocal_wrote_of_an_earlier_one(folder):
    """Programs of other setups would move the machine through postures of the earlier plan."""
    session = folder / "session"
    (session / "readings.csv").unlink()
    old = {"07-old.ngc": "(orthocal: old, setup old, 7 of 7)\n", "08-mine.ngc": PROGRAM}
    old |= {"plan.json": '{"schema": "orthocal/plan/1"}\n', "plan.svg": "<svg/>", "a.txt": MINE}
    for name, text in old.items():
        (session / name).write_text(text)
    done = run_orthocal(folder, "again", "one", "--out", "session", "--force")
    assert done.returncode == 0
    assert "Removed from the earlier plan: 07-old.ngc, plan.json, plan.svg\n" in done.stderr
    names = {p.name for p in session.iterdir()}
    assert {"08-mine.ngc", "a.txt", "01-xy.ngc", "sheet.html"} <= names
    assert not names & {"07-old.ngc", "plan.json", "plan.svg"}
