"""The wheel, installed into a clean environment, calibrates from another directory."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from email.parser import HeaderParser

import pytest
from environments import declared, make_environment

pytestmark = pytest.mark.acceptance


@pytest.fixture(scope="module")
def wheel(root, tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, root],
        check=True,
        capture_output=True,
    )
    (built,) = folder.glob("*.whl")
    return built


def requirements_of(wheel):
    """What the wheel says that it needs."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        text = archive.read(name).decode()
    found = HeaderParser().parsestr(text).get_all("Requires-Dist")
    assert found
    return found


def test_the_wheel_holds_robots_and_types(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert "orthocal/_robots/orthoglide/orthoglide.urdf" in names
    assert "orthocal/_robots/orthoglide/orthoglide.yaml" in names
    assert "orthocal/export/linuxcnc/templates/orthocal_core.c" in names
    assert "orthocal/export/linuxcnc/templates/orthocal_core.h" in names
    assert {"orthocal/py.typed", "orthocal/__init__.pyi"} <= set(names)
    for name in ("web/scene.html", "web/scene.css", "web/scene.js"):
        assert f"orthocal/viewer/{name}" in names
    assert "orthocal/output/report/report.css" in names
    assert not [n for n in names if n.startswith(("tests", "examples"))]


def test_the_installed_wheel_calibrates_from_elsewhere(wheel, root, tmp_path):
    """A fresh environment: the wheel and what it declares, nothing else."""
    needed = declared(requirements_of(wheel))
    python = make_environment(tmp_path / "env", needed)
    pip = [sys.executable, "-m", "uv", "pip"]
    into = ["--quiet", "--python", python]
    install = ["install", "--no-index", "--no-deps", *into, wheel]
    subprocess.run([*pip, *install], check=True)
    check = subprocess.run([*pip, "check", "--python", python], capture_output=True, text=True)
    assert check.returncode == 0, check.stderr
    freeze = [*pip, "freeze", "--python", python]
    listed = subprocess.run(freeze, capture_output=True, text=True, check=True)
    assert len(listed.stdout.splitlines()) == 1 + len(needed)
    elsewhere = tmp_path / "elsewhere"
    session = elsewhere / "session"
    session.mkdir(parents=True)
    for name in ("session.yaml", "readings.csv"):
        text = (root / "examples/table1/experiment-2" / name).read_text()
        (session / name).write_text(text)
    done = subprocess.run(
        [tmp_path / "env/bin/orthocal", "calibrate", "session", "--json", "--out", "out"],
        cwd=elsewhere,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "Warning" not in done.stderr
    document = json.loads(done.stdout)
    assert document["parameters"][0]["value"] == pytest.approx(-0.5268e-3, abs=5e-6)
    assert document["robot"]["directory"] is None
    assert (elsewhere / "out/report.html").stat().st_size > 1e6
