from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path

import pytest

# as the command line does it: threads of small matrices get in each other's way
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
from orthocal import load_robot, load_session
from orthocal.measurement.session import Session
from orthocal.robot.model import Robot

# nothing that tests keep outlives them; the workers of one run share it
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ["ORTHOCAL_CACHE"] = tempfile.mkdtemp(prefix="orthocal-tests-")
    atexit.register(shutil.rmtree, os.environ["ORTHOCAL_CACHE"], ignore_errors=True)
# processes of tests need not compile what they import
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

ROOT = Path(__file__).parents[1]


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
