from __future__ import annotations

import atexit
import gc
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from unittest.mock import patch

import pytest

# as the command line does it, before NumPy is imported: threads of small matrices get in each
# other's way
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MKL_NUM_THREADS", "1")
os.environ.setdefault("VECLIB_MAXIMUM_THREADS", "1")
from gauges import exact
from planned import FEW

import orthocal
from orthocal import load_plan, load_robot, load_session
from orthocal.robot import loading
from orthocal.robot.model import Robot
from orthocal.session.session import Session

# nothing that tests keep outlives them; the workers of one run share it
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ["ORTHOCAL_CACHE"] = tempfile.mkdtemp(prefix="orthocal-tests-")
    atexit.register(shutil.rmtree, os.environ["ORTHOCAL_CACHE"], ignore_errors=True)
# processes of tests need not compile what they import
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# a job in the background of a shell script ignores Ctrl-C, and so would its processes
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

ROOT = Path(__file__).parents[1]

WANTED_BY_ALL = """
from orthocal import load_robot
from orthocal.kinematics.loop_closure import nominal_closure

robot = load_robot("orthoglide")
nominal_closure(robot).close([robot.drive_zero] * 100)
"""
"""Fills the cache with what takes long to compile."""


def pytest_sessionstart(session):
    """While workers begin, one process compiles what else each of them would."""
    if session.config.getoption("numprocesses", None) and "PYTEST_XDIST_WORKER" not in os.environ:
        process = subprocess.Popen(
            [sys.executable, "-c", WANTED_BY_ALL], stdout=subprocess.DEVNULL, cwd=ROOT
        )
        session.config.add_cleanup(process.wait)


MORE_GARBAGE = (20_000, 20, 20)
"""Objects, and passes, after which garbage is looked for."""

LONGEST = ("test_examples.py", "test_command_line_use.py", "test_fuzz.py")
"""Files with tests that take as long as a hundred others."""

IN_LINUXCNC = (
    "test_drive_compensation.py",
    "test_linuxcnc.py",
    "test_module_conditions.py",
    "test_motion.py",
)
"""Files that run LinuxCNC: one after the other on a worker, they do not wait for its lock."""


def pytest_collection_modifyitems(items):
    """What takes longest begins first: at the end others would wait for it."""
    first = (*LONGEST, *IN_LINUXCNC)
    place = {name: i for i, name in enumerate(first)}
    items.sort(key=lambda item: place.get(item.path.name, len(first)))


def pytest_collection_finish():
    """What is there now stays: to look through it for garbage again and again takes its time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*MORE_GARBAGE)


def load_afresh(robot):
    """A robot as a new process loads it."""
    loading._build_robot.cache_clear()
    return load_robot(robot)


@pytest.fixture(scope="module")
def short_reports():
    """Reports and sheets with marks for plots, scenes and pictures, without gains of sensors."""
    from orthocal.output.report import page
    from orthocal.output.text.accuracy import FurtherHour

    with (
        marked_plots(),
        marked_pictures(),
        patch.object(page, "expect_further_hour", lambda _: FurtherHour(0.0, ())),
        patch.object(page, "_scene", lambda _: "<!-- scene -->"),
    ):
        yield


@contextmanager
def marked_plots():
    """Marks in place of plots."""
    from orthocal.output.report.figure import Plot

    with patch.object(Plot, "__call__", lambda plot, *_, **__: f'<svg id="{plot.name}"/>'):
        yield


@contextmanager
def marked_pictures():
    """Marks in place of pictures of the machine on sheets; tests/output/sheet has the pictures."""
    from orthocal.output.sheet import page

    with patch.object(page, "draw_machine", lambda *_: "<svg/>"):
        yield


@contextmanager
def marked_reports():
    """A mark in place of reports, which have tests of their own."""
    from orthocal.output.report import page

    with patch.object(page, "build_report", lambda *_, **__: "<html></html>"):
        yield


@pytest.fixture(scope="module")
def assessed_once():
    """A calibration without an assessment, which several texts state, is assessed once."""
    from orthocal.assessment import assess

    with patch.object(assess, "assess", cache(assess.assess)):
        yield


@contextmanager
def no_sensor_gains():
    """Plans and details without gains of usual sensors, which have tests of their own."""
    from orthocal.planning import first_plan, plan, sensor_gains

    with ExitStack() as patches:
        for module in (sensor_gains, first_plan, plan):
            patches.enter_context(patch.object(module, "find_sensor_gains", lambda *_: ()))
        yield


def module_fixture(manager):
    """A context manager as a fixture for all tests of a module."""
    return pytest.fixture(scope="module")(manager.__wrapped__)


@contextmanager
def judged_once():
    """Equal readings of files with equal tolerances are judged once."""
    from orthocal.assessment import judgement

    judge, judged = judgement.judge_session, {}

    def judge_once(session):
        parameters = session.robot.parameters
        key = session.sha256, session.robot.sha256, str(parameters.stated), parameters.names
        if not session.sha256:
            return judge(session)
        if key not in judged:
            judged[key] = judge(session)
        return judged[key]

    with (
        patch.object(judgement, "judge_session", judge_once),
        patch.object(orthocal, "judge_session", judge_once),
    ):
        yield


@contextmanager
def plans_of_few_candidates():
    """Plans of commands with few candidates and one start; tests/planning verify plans."""
    from uncompared import few_balls, few_machines, uncompared

    from orthocal.planning import tool_candidates

    def plan_readings(*args, starts=None, **options):
        return plan(*args, starts=1, **options)

    plan, equipment = orthocal.plan_readings, orthocal.Equipment
    with (
        patch.object(orthocal, "Equipment", lambda **stated: equipment(**stated | FEW)),
        patch.object(orthocal, "plan_readings", plan_readings),
        few_balls(2),
        patch.object(tool_candidates, "BED_POINTS", 5),
        uncompared(),
        few_machines(),
    ):
        yield


@contextmanager
def few_tool_points():
    """Tool errors over 27 points instead of 125 under several conditions of use."""
    from orthocal.assessment import calibrated_tool
    from orthocal.kinematics.conditions import sample_use
    from orthocal.kinematics.workspace import box_workspace

    def find_few(robot, require_reach=None):
        found = find_workspace(robot, require_reach)
        if sample_use(robot).size == 1:
            return found
        return box_workspace(robot, found.limits, points_per_side=3)

    find_workspace = calibrated_tool.find_workspace
    with patch.object(calibrated_tool, "find_workspace", find_few):
        yield


judged_sessions = module_fixture(judged_once)
quick_plans = module_fixture(plans_of_few_candidates)
without_sensor_gains = pytest.fixture(no_sensor_gains.__wrapped__)
module_without_sensor_gains = module_fixture(no_sensor_gains)
module_of_few_tool_points = module_fixture(few_tool_points)


@pytest.fixture(scope="module")
def module_of_few_machines():
    """Plans of all tests of a module with expected errors of few machines."""
    from uncompared import few_machines

    with few_machines():
        yield


@pytest.fixture(scope="session")
def root() -> Path:
    return ROOT


@pytest.fixture(scope="session")
def orthoglide() -> Robot:
    return load_robot("orthoglide")


@pytest.fixture(scope="session")
def fivebar() -> Robot:
    return load_robot(ROOT / "tests/robots/fivebar")


@pytest.fixture(scope="session")
def biglide() -> Robot:
    return load_robot(ROOT / "tests/robots/biglide")


@pytest.fixture(scope="session")
def experiment_2() -> Session:
    return load_session(ROOT / "examples/table1/experiment-2")


@pytest.fixture(scope="session")
def raw_cycles() -> Session:
    return load_session(ROOT / "examples/raw-cycles")


@pytest.fixture(scope="session")
def exact_plan() -> Session:
    """Lines read in zero, maximum and minimum postures, by gauges whose mounting is known."""
    return exact(load_plan(ROOT / "examples/raw-cycles/plan.yaml"))
