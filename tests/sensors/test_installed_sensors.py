"""Sensors of installed packages, found by their entry points."""

from __future__ import annotations

import shutil
from importlib.metadata import entry_points

import pytest
from commands import run_orthocal

from orthocal import load_plan
from orthocal.errors import SessionError
from orthocal.sensors.registry import GROUP, sensor_kinds

PLAN = """robot: orthoglide
postures:
  zero: {tcp_mm: [0, 0, 0]}
  x_max: {tcp_mm: [60, 0, 0]}
gauge: {sigma_mm: 0.002}
setups:
  tx: {sensor: tool, tool: x, slope_tolerance: 0.004}
"""


@pytest.fixture
def install(root, tmp_path, monkeypatch):
    """Installs a package whose entry point has this value, and returns a plan that uses it."""

    def install(value, name="tool"):
        site = tmp_path / "site"
        info = site / "probe_sensors-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: probe-sensors\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{GROUP}]\n{name} = {value}\n")
        shutil.copy(root / "tests/tool_coordinate.py", site / "installed_tool.py")
        monkeypatch.syspath_prepend(site)
        (tmp_path / "plan.yaml").write_text(PLAN)
        return tmp_path / "plan.yaml"

    return install


def test_a_session_may_name_it(install):
    plan = load_plan(install("installed_tool:ToolCoordinate"))
    assert type(plan.setups["tx"].sensor).__module__ == "installed_tool"
    assert "tool" in sensor_kinds()


def test_the_command_line_knows_it(install, tmp_path):
    plan = install("installed_tool:ToolCoordinate")
    words = ["simulate", plan, "--error", "x_slide.offset_mm=1", "--seed", "1"]
    done = run_orthocal(tmp_path, *words, "--out", "out")
    assert done.returncode == 0, done.stderr
    assert "sensor: tool" in (tmp_path / "out/session.yaml").read_text()


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("tool", "no_such_module:ToolCoordinate", "ModuleNotFoundError"),
        ("tool", "installed_tool:NoSuchClass", "AttributeError"),
        ("tool", "installed_tool:ToolKeys", "ToolKeys is not a sensor with kind = 'tool'"),
        ("laser", "installed_tool:ToolCoordinate", "is not a sensor with kind = 'laser'"),
    ],
)
def test_one_that_cannot_be_loaded_is_refused(install, name, value, reason):
    plan = install(value, name=name)
    plan.write_text(PLAN.replace("sensor: tool,", f"sensor: {name},"))
    with pytest.raises(SessionError) as caught:
        load_plan(plan)
    message = str(caught.value)
    assert message.startswith(
        f"{plan}: setups.tx.sensor: the sensor '{name}' of package probe-sensors"
    )
    assert reason in message


def test_without_such_packages_there_are_the_built_in_kinds():
    own = {"leg", "ball_bar", "tool_indicator", "probe", "points", "distance"}
    assert set(sensor_kinds()) == own | {e.name for e in entry_points(group=GROUP)}
