"""Exports for LinuxCNC, compiled and run, compared with the calibrated machine."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from calibrated import UNJUDGED
from commands import run_orthocal
from linuxcnc import (
    Joint,
    enter_lines,
    few_nodes,
    filter_program,
    require_linuxcnc,
    run_program,
)
from programs import distances, rigid_motion
from test_correction_field import tips

from orthocal import (
    ExportError,
    ParameterError,
    calibrate,
    export_calibration,
    load_plan,
    load_robot,
    simulate_session,
    write_calibration,
)
from orthocal.assessment.assess import assessment_of
from orthocal.assessment.controller_entries import offsets_to_enter
from orthocal.assessment.wording import tool_mm
from orthocal.calibration.calibration import Machine
from orthocal.export.linuxcnc.approximation import approximate, rounded_up
from orthocal.export.linuxcnc.c_source import write_core
from orthocal.export.linuxcnc.drive_compensation import find_active_compensation, find_compensation
from orthocal.export.linuxcnc.export import ExportOptions, export_linuxcnc
from orthocal.export.linuxcnc.home_offsets import find_homes
from orthocal.export.linuxcnc.nominal_form import SlidesWithRods, Tangent, find_nominal_form
from orthocal.export.tool_tip import ToolTip
from orthocal.io.files import write_files
from orthocal.kinematics.workspace import box_workspace, tool_at_zero
from orthocal.observation.simulate import load_errors
from orthocal.robot.loading import packaged_robots

MM = 1e-3

WITHIN = 0.05e-6
"""Tolerance of the modules, [m]."""

TOOL = (5 * MM, 0.0, -50 * MM)

ACTIVE = np.array([0.4, -0.1, 0.2]) * MM

PATH = 0.5e-6
"""Tolerance of the path, [m]: 0.05 µm of the module, 0.04 of homing, 0.03 of the interpolator,
which smooths each point with its neighbours, and rounding by LinuxCNC."""

# ---- machines


@pytest.fixture(scope="module")
def mixed(root, tmp_path_factory):
    """An Orthoglide with three joint conventions."""
    folder = tmp_path_factory.mktemp("robots") / "orthoglide"
    shutil.copytree(packaged_robots()["orthoglide"], folder)
    file = folder / "orthoglide.yaml"
    text = file.read_text()
    for drive, joint in {
        "y_slide": "{counts: down}",
        "z_slide": "{counts: down, at_zero_mm: 0}",
    }.items():
        entry = f"{drive}: {{zero_mm: 310.25"
        assert entry in text
        text = text.replace(entry, f"{entry}, joint: {joint}")
    file.write_text(text)
    return folder


ENTERED = 0.2e-6
"""Tolerance of HOME_OFFSET, [m]: three drives home to 0.02 µm; their offsets are multiples of 1 µm,
to which they are entered."""


def calibrated(root, folder, example, truth, model, *, active=ACTIVE):
    """Calibration of exact readings of a machine with errors and active offsets."""
    text = (root / f"examples/{example}/plan.yaml").read_text()
    listed = ", ".join(f"{v / MM:g}" for v in active)
    for old, new in {
        "robot: orthoglide": f"robot: {folder}",
        "offsets_mm: [0, 0, 0]": f"offsets_mm: [{listed}]",
    }.items():
        assert old in text
        text = text.replace(old, new)
    plan = folder.parent / f"{example}.yaml"
    plan.write_text(text)
    loaded = load_plan(plan)
    errors = load_errors(truth, loaded.robot) if not isinstance(truth, dict) else truth
    return calibrate(simulate_session(loaded, errors, exact=True).session, model, **UNJUDGED)


@pytest.fixture(scope="module")
def full(root, mixed):
    return calibrated(root, mixed, "sweep", root / "examples/sweep/truth.yaml", "full")


OFFSETS = {"x_slide.offset": 1.2 * MM, "y_slide.offset": -0.8 * MM, "z_slide.offset": 0.5 * MM}


@pytest.fixture(scope="module")
def offsets(root, mixed):
    return calibrated(root, mixed, "raw-cycles", OFFSETS, "offsets")


@pytest.fixture(scope="module")
def exported(full):
    """Files of a module for a tool."""
    options = ExportOptions(within=WITHIN, tool=TOOL)
    with few_nodes(degree=6):
        return export_calibration(full, "linuxcnc", anyway=True, options=options)


def machine_of(robot, errors):
    """Substitute for the calibration of a machine with known errors."""
    n = len(robot.drives)
    return SimpleNamespace(
        assessment=SimpleNamespace(entries=(), backlash=()),
        robot=robot,
        errors=errors,
        active_offsets=np.zeros(n),
        machine=Machine(robot, errors),
        session=SimpleNamespace(title="*/ known", controller_offsets=None, compensation=()),
    )


# ---- the core in C


class Core:
    """orthocal_core.c, compiled with strict warnings."""

    def __init__(self, folder, files, *, periodic=False):
        if shutil.which("gcc") is None:
            if os.environ.get("ORTHOCAL_LINUXCNC") == "required":
                pytest.fail("a C compiler is required here")
            pytest.skip("no C compiler to build the exported core with: there is no gcc")
        write_files(folder, files)
        strict = "-std=c99 -O2 -Wall -Wextra -Werror -pedantic -Wshadow -Wvla".split()
        done = subprocess.run(
            ["gcc", *strict, "-fPIC", "-shared", "-o", "core.so", "orthocal_core.c", "-lm"],
            cwd=folder,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        used = subprocess.run(["nm", "-u", "core.so"], cwd=folder, capture_output=True, text=True)
        # the core needs no other functions except the stack protector
        functions = {"sqrt", "sin", "cos", "sincos"} if periodic else {"sqrt"}
        needed = {line.split()[1] for line in used.stdout.splitlines() if line.split()[0] == "U"}
        assert {name.split("@")[0] for name in needed} <= {*functions, "__stack_chk_fail"}
        self.n = int(re.search(r"#define ORTHOCAL_DRIVES (\d)", files["orthocal_core.h"])[1])
        self.library = ctypes.CDLL(str(folder / "core.so"))
        self.type = ctypes.c_double * self.n

    def inverse(self, points, *, untouched=7.0):
        """Joints in mm or degrees, (k, n), for points in mm; NaN for refused points."""
        return self._each(self.library.orthocal_inverse, points, lambda p: [untouched] * self.n)

    def forward(self, joints, *, start):
        return self._each(self.library.orthocal_forward, joints, lambda _: start)

    def _each(self, function, rows, start):
        results = []
        for row in rows:
            result = self.type(*start(row))
            if function(self.type(*row), result) != 0:
                assert list(result) == list(start(row))
                result = [np.nan] * self.n
            results.append(list(result))
        return np.array(results)


@pytest.fixture(scope="module")
def core(tmp_path_factory, exported):
    return Core(tmp_path_factory.mktemp("core"), exported)


def drives_of(calibration, joints):
    """Drive coordinates of the encoders, [m], for LinuxCNC's joints, mm."""
    columns = zip(calibration.robot.drives, (joints * MM).T, ACTIVE, strict=True)
    return np.stack([d.from_joint(j) - active for d, j, active in columns], axis=-1)


def test_core_reaches_the_targets_of_the_tip(full, core):
    points = np.random.default_rng(7).uniform(-0.06, 0.06, (400, 3))
    tip = ToolTip(full, TOOL)
    drives = drives_of(full, core.inverse(points / MM))
    assert np.linalg.norm(tip.place(drives) - (points + TOOL), axis=1).max() < WITHIN
    # a level platform needs other drive coordinates
    level = full.machine.inverse(points[:20])
    assert np.abs(drives[:20] - level).max() > 20e-6


def test_core_without_a_tool_equals_the_calibrated_machine(full, tmp_path):
    """At points that were neither fitted nor checked. Nodes and checks are those of a user."""
    approximation = approximate(full, within=WITHIN)
    core = Core(tmp_path, write_core(full, approximation, homes_of(full)))
    points = np.random.default_rng(8).uniform(-0.06, 0.06, (1000, 3))
    errors = full.machine.forward(drives_of(full, core.inverse(points / MM))) - points
    assert np.linalg.norm(errors, axis=1).max() < approximation.achieved <= WITHIN


def test_tip_equals_pinocchio(full, core):
    """Pinocchio closes the loops of a robot with these errors."""
    points = np.random.default_rng(9).uniform(-0.06, 0.06, (8, 3))
    drives = drives_of(full, core.inverse(points / MM))
    reached = tips(full.robot, full.errors, drives, np.array(TOOL))
    assert np.linalg.norm(reached - points - TOOL, axis=1).max() < WITHIN


def test_forward_inverts_inverse(core):
    points = np.random.default_rng(10).uniform(-60.0, 60.0, (2000, 3))
    for start in ([0.0, 0.0, 0.0], [55.0, -55.0, 55.0], [1e9, float("nan"), -1e9]):
        assert np.abs(core.forward(core.inverse(points), start=start) - points).max() < 1e-9
    # outside the region the correction is constant
    outside = points * 1.4
    assert np.abs(core.forward(core.inverse(outside), start=[0.0] * 3) - outside).max() < 1e-9


def test_correction_beyond_the_region_is_that_of_the_nearest_face(full, core):
    form = find_nominal_form(full.robot, np.zeros(3), np.full(3, 0.06))
    outside = np.array([[75.0, 10.0, -80.0], [-61.0, 0.0, 0.0], [0.0, 70.0, 20.0]])
    added = [
        drives_of(full, core.inverse(p)) - form(p * MM)
        for p in (outside, np.clip(outside, -60.0, 60.0))
    ]
    assert np.abs(added[0] - added[1]).max() < 1e-12
    assert np.abs(added[0]).max() > 0.1 * MM


def test_core_refuses_points_and_joints_out_of_reach(core):
    nan, inf = float("nan"), float("inf")
    rows = [[nan, 0, 0], [0, inf, 0], [0, 400.0, 0], [1e200, 1e200, 1e200]]
    assert np.isnan(core.inverse(rows)).all()
    rows = [[nan, 0, 0], [inf, 0, 0], [1e300, -1e300, 1e300], [-4000.0, 4000.0, 4000.0]]
    assert np.isnan(core.forward(rows, start=[1.0, 2.0, 3.0])).all()


def test_slides_with_rods_are_identified(orthoglide):
    form = find_nominal_form(orthoglide, np.zeros(3), np.full(3, 0.06))
    assert isinstance(form, SlidesWithRods)
    assert np.array_equal(form.axes, np.eye(3))
    assert np.array_equal(form.anchors, np.zeros((3, 3)))
    assert np.array_equal(form.lengths, [0.31025] * 3)


@pytest.mark.parametrize("name", ["biglide", "fivebar"])
def test_core_of_planar_robots(root, tmp_path, name):
    """Slides have a closed form, motors a linear one."""
    folder = tmp_path / name
    shutil.copytree(root / "tests/robots" / name, folder)
    errors = {"x_slide.offset": 1e-3, "y_tip.x": 2e-4} if name == "biglide" else {}
    if name == "fivebar":
        with open(folder / "fivebar.yaml", "a") as file:
            file.write(
                "orthocal:\n  tcp: {frame: end_a, coordinates: [x, y]}\n"
                "  drives: {motor_b: {joint: {counts: down, at_zero_deg: 30}}}\n"
            )
        errors = {"motor_a.offset": 0.01, "motor_b.offset": -0.02, "elbow_a.y": 3e-4}
    robot = load_robot(folder)
    errors = {k: v for k, v in errors.items() if k in robot.parameters.elementary}
    known = machine_of(robot, errors)
    approximation = approximate(known, within=1e-7, half_side=0.02)
    assert isinstance(
        approximation.inverse.nominal, Tangent if name == "fivebar" else SlidesWithRods
    )
    files = write_core(known, approximation, homes_of(known))
    assert "*/ known" not in files["orthocal_core.c"]
    core = Core(tmp_path, files)
    points = tool_at_zero(robot) + np.random.default_rng(1).uniform(-0.02, 0.02, (500, 2))
    joints = core.inverse(points / MM)
    assert np.abs(core.forward(joints, start=[0.0, 0.0]) - points / MM).max() < 1e-9
    factor = np.deg2rad(1.0) if name == "fivebar" else MM
    drives = [d.from_joint(j * factor) for d, j in zip(robot.drives, joints.T, strict=True)]
    reached = known.machine.forward(np.stack(drives, axis=-1))[:, :2]
    assert np.abs(reached - points).max() < 1e-7


# ---- refusals and options


def test_unreachable_tolerance_is_refused_with_the_best_error(full):
    with (
        few_nodes(),
        pytest.raises(ExportError, match=r"within 1e-09 µm over ±60 mm; the smallest error is"),
    ):
        approximate(full, within=1e-15)
    with pytest.raises(ExportError, match=r"does not reach ±150 mm \(.*smaller --half-side-mm"):
        approximate(full, within=1e-6, half_side=0.15)


def test_larger_tolerance_gives_a_lower_degree(full, exported):
    with few_nodes():
        approximation = approximate(full, within=5e-6)
    assert (
        f"#define DEGREE {approximation.inverse.correction.degree}\n"
        not in exported["orthocal_core.c"]
    )
    assert approximation.inverse.correction.degree < 4
    assert 1e-7 < approximation.achieved <= 5e-6
    assert approximation.error_beyond > approximation.achieved
    # the tilt is a few milliradians
    assert 1e-6 < approximation.error_of_longer_tool < 100e-6
    assert approximation.nominal_error > 1 * MM


def test_rounded_up():
    numbers = {0.02801: "0.029", 0.028: "0.028", 12.1: "13", 1.0: "1", 99.2: "100", 184.3: "190"}
    assert [rounded_up(v) for v in numbers] == list(numbers.values())
    # a number of two digits is not changed
    numbers = [f"0.{digits}" for digits in range(11, 100) if digits % 10]
    assert [rounded_up(float(text)) for text in numbers] == numbers


REFUSED = {
    "--tool 1,2": "--tool: found '1,2'; expected 3 numbers, X,Y,Z",
    "--tool 0,0,nan": "--tool: Z is 'nan'; expected a finite number",
    "--tool 0,0,1e6": "--tool: found 0, 0, 1e+06 mm; expected",
    "--within 0": "--within: found 0 µm; expected more than 0",
    "--within nan": "--within: found nan µm",
    "--half-side-mm -3": "--half-side-mm: found -3 mm; expected more than 0",
    "--home-offset 1;2;3": "found '1;2;3'; expected 3 numbers, x_slide,y_slide,z_slide",
    "--home-offset 1,2,inf": "--home-offset: z_slide is 'inf'; expected a finite number",
    "--within 1": "--within: is an option of a kinematics module, and the",
    "--to yaml --tool 0,0,0": "--tool: is an option of --to linuxcnc only",
    "--to yaml --ini a.ini": "--ini: is an option of --to linuxcnc only",
    "--to linux --ini a.ini": "--to: found 'linux'; expected one of",
    "--to yaml --offsets": "--module or --offsets: is an option of --to linuxcnc only",
    "--module --payload 1": "--payload: found 1.0; no effect of the machine",
    "--payload 1": "--payload: is an option of a kinematics module, and the",
    "--module --half-side-mm 250": "the machine does not reach ±250 mm",
}
"""Options, and what is said of them."""


@pytest.mark.parametrize("words", REFUSED)
def test_bad_options_are_refused(offsets, tmp_path, words):
    file = write_calibration(offsets, tmp_path / "calibration.json")
    to = [] if "--to " in words else ["--to", "linuxcnc"]
    done = run_orthocal(tmp_path, "export", file, *to, "--out", "out", "--anyway", *words.split())
    assert done.returncode == (3 if "reach" in REFUSED[words] else 2)
    assert REFUSED[words] in " ".join(done.stderr.split())
    assert not (tmp_path / "out").exists()


# ---- HOME_OFFSET


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"latched": (1, 2, 1)}, "--latched: found 2; expected 1, 0 or -1"),
        ({"joint_limits": ((0.0, 1.0), (1.0, -1.0), (0.0, 1.0))}, "--ini: found limits 1 and -1"),
        ({"joint_limits": ((0.0, np.nan),) * 3}, "--ini: found limits 0 and nan"),
        ({"joint_limits": ((0.0, 1.0),)}, "--ini: found 1 range; expected 3"),
        (
            {"joint_limits": ((0.0, 1.0), (0.6, 0.7), (-1.0, 1.0))},
            r"JOINT_1 \(y_slide\) has soft limits 600.000 mm to 700.000 mm; the travel .* is 2",
        ),
    ],
)
def test_limits_and_signs_that_cannot_be_are_refused(offsets, options, message):
    with pytest.raises(ParameterError, match=message):
        export_linuxcnc(offsets, ExportOptions(module=False, **options))


def test_unknown_home_offsets_are_written_as_changes(offsets):
    files = export_calibration(offsets, "linuxcnc")
    assert list(files) == ["README.md", "joints.ini"]
    lines = files["joints.ini"]
    assert "[JOINT_0]\n# x_slide, counts up: +0.800 mm\n" in lines
    assert "# HOME_OFFSET = present value +0.800\n# MIN_LIMIT = present value +0.800" in lines
    assert not re.search(r"^(HOME_OFFSET|M.._LIMIT)", lines, re.M)
    assert "[JOINT_1]\n# y_slide, counts down: +0.700 mm\n" in lines
    assert "[JOINT_2]\n# z_slide, counts down: -0.300 mm\n" in lines
    assert "| JOINT_1 | y_slide | down | present value +0.700 | +0.700 |" in files["README.md"]
    assert "offsets_mm: [1.2, -0.8, 0.5]" in files["README.md"]


def test_home_offsets_and_limits_are_ini_lines(offsets, tmp_path):
    file = write_calibration(offsets, tmp_path / "calibration.json")
    words = ["export", file, "--to", "linuxcnc", "--out", "out"]
    assert run_orthocal(tmp_path, *words, "--home-offset", "350,300.5,-20").returncode == 0
    ini = enter_lines("[JOINT_1]\nHOME = 3\n", (tmp_path / "out/joints.ini").read_text())
    assert "[JOINT_0]\nHOME_OFFSET = 350.800\nMIN_LIMIT = 121.200\nMAX_LIMIT = 391.200" in ini
    # joint 620.5 - c: the limits swap
    assert "[JOINT_1]\nHOME = 3\nHOME_OFFSET = 301.200\nMIN_LIMIT = 231.300\n" in ini
    assert "[JOINT_2]\nHOME_OFFSET = -20.300\n" in ini
    page = (tmp_path / "out/README.md").read_text()
    assert "300.500 → **301.200**" in page


def test_module_files_state_tool_limits_and_error(full, exported):
    assert set(exported) == {
        "README.md",
        "kinematics.ini",
        "orthocal_kins.c",
        "orthocal_core.c",
        "orthocal_core.h",
    }
    assert "HOME_OFFSET remains that of the measurement" in exported["README.md"]
    assert "for a tip at 5, 0, -50 mm" in exported["README.md"]
    assert "HOME_OFFSET =" not in exported["kinematics.ini"]
    assert "restore the old INI lines" in exported["README.md"]
    assert "[AXIS_Z]\nMIN_LIMIT = -60\nMAX_LIMIT = 60\n" in exported["kinematics.ini"]
    assert "# x_slide\nTYPE = LINEAR\nMIN_LIMIT = 120.400\n" in exported["kinematics.ini"]
    stated = float(re.search(r"within ([\d.]+) µm", exported["README.md"])[1])
    assert 0.0 < stated <= WITHIN * 1e6
    assert (
        f"identified errors corrected: {tool_mm(assessment_of(full).tool.compensated)} RMS"
        in exported["README.md"]
    )


def test_module_of_offsets_alone(offsets):
    """The correction of nominal legs is constant, and HOME_OFFSET does not change."""
    options = ExportOptions(module=True, home_offsets=(0.35, 0.3, -0.02))
    with few_nodes():
        files = export_calibration(offsets, "linuxcnc", options=options)
    assert "identified offsets only; a module was requested" in files["README.md"]
    assert "(JOINT_0 350.000, JOINT_1 300.000, JOINT_2 -20.000)" in files["README.md"]
    assert "HOME_OFFSET = 300.000\n" in files["kinematics.ini"]
    assert "#define DEGREE 1\n" in files["orthocal_core.c"]
    assert "within 0.001 µm" in files["README.md"]


def test_limits_of_the_axes_are_those_of_region_and_controller(offsets):
    """The controller displays 2 mm less in X than the module will."""
    session = replace(offsets.session, controller_origin=(-0.002, 0.0, 0.0))
    moved = replace(offsets, session=session)
    axes = ((-0.045, 0.04), (-0.07, 0.03), (-np.inf, np.inf))
    options = ExportOptions(module=True, axis_limits=axes)
    with few_nodes():
        files = export_calibration(moved, "linuxcnc", options=options)
    limits = re.findall(r"AXIS_(.)]\nMIN_LIMIT = (\S+)\nMAX_LIMIT = (\S+)", files["kinematics.ini"])
    assert limits == [("X", "-43", "42"), ("Y", "-60", "30"), ("Z", "-60", "60")]
    assert "to it and to the limits of your INI file" in files["README.md"]
    axes = ((-0.045, 0.04), (0.06, 0.09), (-np.inf, np.inf))
    with few_nodes(), pytest.raises(ParameterError, match=r"--ini: \[AXIS_Y\] has .* 60, 90 mm"):
        export_linuxcnc(moved, replace(options, axis_limits=axes))


def test_offsets_of_a_complete_model(full):
    """HOME_OFFSET has the offsets that minimise the tool error, not the identified ones."""
    old = (0.35, 0.3, -0.02)
    options = ExportOptions(module=False, home_offsets=old)
    files = export_calibration(full, "linuxcnc", options=options)
    assert set(files) == {"README.md", "joints.ini"}
    assert "These offsets minimise the tool error" in files["README.md"]
    lines = re.findall(r"^HOME_OFFSET = (\S+)", files["joints.ini"], re.M)
    changed = np.array(lines, dtype=float) * 1e-3 - old
    ways = np.array([d.direction for d in full.robot.drives])
    assert changed == pytest.approx(ways * (offsets_to_enter(full) - full.active_offsets), abs=1e-9)
    assert np.abs(changed - ways * (full.offsets - full.active_offsets)).max() > 1e-6
    with pytest.raises(ParameterError) as e:
        export_calibration(full, "linuxcnc", options=replace(options, within=1e-6))
    assert str(e.value) == (
        "--within: is an option of a kinematics module, and --offsets requests HOME_OFFSET"
    )


# ---- LinuxCNC itself


def homes_of(calibration):
    new, before = (f(calibration, None) for f in (find_compensation, find_active_compensation))
    return find_homes(calibration, new, before)


def from_pieces(points, centre, radius, corners):
    """Distances from a circle in a plane of constant z and from each line, [mm] to [m]."""
    across = np.hypot(points[:, 0] - centre[0], points[:, 1] - centre[1]) - radius
    lines = [distances(points, np.array(ends)) for ends in pairwise(corners)]
    return np.array([np.hypot(across, points[:, 2] - centre[2]), *lines]) * MM


def require_followed(pieces, within, counts):
    """Require that every point is near a piece, and that each piece has enough points."""
    assert pieces.min(axis=0).max() < within
    assert (np.count_nonzero(pieces < within, axis=1) > counts).all()


def joints_at_switch(calibration, switch):
    """HOME_OFFSET during the measurement of joints with switches at these slides, [m]."""
    places = zip(calibration.robot.drives, switch, ACTIVE, strict=True)
    return [float(d.to_joint(s + active)) for d, s, active in places]


SWITCH = np.array([352.0, 340.0, 331.0]) * MM


def joints_of(calibration, home_offsets):
    return [
        Joint(d.direction, float(s) / MM, h / MM, float(d.to_joint(d.zero)) / MM)
        for d, s, h in zip(calibration.robot.drives, SWITCH, home_offsets, strict=True)
    ]


FILTERED = 0.3
"""Tolerance of filtered programs, [µm]."""


@pytest.fixture
def filtered(root, full, tmp_path):
    """Function that opens a program as LinuxCNC's window does, with the INI lines of the page."""
    write_calibration(full, tmp_path / "calibration.json")
    page = (root / "docs/controllers.md").read_text()
    ini = re.search(r"(?m)(?:^    .+\n)+", page[page.index("    [FILTER]") :])[0]
    ini = "".join(f"{line.strip()}\n" for line in ini.splitlines())
    tip = ",".join(f"{v / MM:g}" for v in TOOL)
    for old, new in {
        "/home/me/.venv/bin/orthocal": f"{sys.executable} -m orthocal",
        "/home/me/out/two": f"{tmp_path} --anyway --within {FILTERED}",
        "--tool 0,0,-50": f"--tool {tip}",
    }.items():
        assert old in ini
        ini = ini.replace(old, new)

    def open_program(lines, *, name="it's a part.ngc"):
        (tmp_path / "result").mkdir(exist_ok=True)
        (tmp_path / name).write_text("".join(f"{line}\n" for line in lines))
        result = tmp_path / "result" / name
        code, message, progress = filter_program(ini, tmp_path / name, result)
        return code, message, progress, result.read_text() if result.exists() else None

    return open_program


@pytest.mark.acceptance
def test_linuxcnc_follows_a_path_with_a_filtered_program(root, mixed, full, filtered, tmp_path):
    """With nominal kinematics, the tip of the calibrated machine follows a circle and lines."""
    centre, radius = (10.0, -8.0, 15.0), 5.0
    corners = [(15.0, -8.0, 15.0), (-10.0, 6.0, -8.0), (-8.0, -14.0, 5.0)]
    program = [
        "G21 G90 G61 G0 X15 Y-8 Z15 (begins)",
        "N1 F6000 G2 X15 Y-8 Z15 I-5 J0",
        *(f"G1 X{x:g} Y{y:g} Z{z:g}" for x, y, z in corners[1:]),
    ]
    code, message, progress, text = filtered(program)
    assert code == 0, message
    assert "For a tip at 5, 0, -50 mm" in message
    assert progress[-1] == 100
    assert progress == sorted(progress)
    nominal = calibrated(root, mixed, "raw-cycles", {}, "offsets", active=np.zeros(3))
    options = ExportOptions(module=True)
    with few_nodes():
        files = export_calibration(nominal, "linuxcnc", anyway=True, options=options)
    write_files(tmp_path, files)
    slides = run_program(
        [line for line in text.splitlines() if not line.startswith("; ")],  # the first one moves
        joints_of(full, joints_at_switch(full, SWITCH)),
        lines=files["kinematics.ini"],
        module=tmp_path,
    )
    tip = ToolTip(full, TOOL)
    # in the frame of motions without correction, in which a work zero is touched off
    workspace = box_workspace(full.robot, assessment_of(full).tool.box)
    jogged = tip.place(Machine(full.robot, {}).inverse(workspace.points) - ACTIVE)
    targets = tip.targets(workspace.points)
    rotation, translation = rigid_motion(targets, jogged, workspace.weights)
    aligned = (tip.place(slides[::5] * MM) - translation) @ rotation
    points = (aligned - np.array(TOOL)) / MM

    path = centre, radius, corners
    require_followed(from_pieces(points, *path), FILTERED * 1e-6 + PATH, [150, 80, 60])
    # without the filter the errors are large
    unfiltered = Machine(full.robot, {}).forward(slides[::5] * MM + ACTIVE) / MM
    assert from_pieces(unfiltered, *path).min(axis=0).max() > 0.05 * MM


@pytest.mark.acceptance
def test_linuxcnc_window_shows_the_message_of_a_refused_program(filtered):
    code, message, _, text = filtered(["G21 G0 X0 Y0 Z0", "G81 X1 Z-1 R1 F100"])
    assert (code, text) == (2, "")
    assert message.startswith("orthocal: ")
    assert "part.ngc:2: found G81, which is a canned cycle" in message
    assert message.count("\n") == 1
    # file names without a filter in the INI
    assert filtered(["G0 X0 Y0 Z0"], name="part.nc")[0] is None
    assert filtered(["G0 X0 Y0 Z0"], name="PART.NGC")[0] is None


@pytest.mark.acceptance
def test_linuxcnc_follows_a_path_with_the_exported_module(full, tmp_path):
    """The calibrated machine follows a circle off centre and lines in space."""
    require_linuxcnc()
    options = ExportOptions(within=WITHIN)
    with few_nodes(degree=6):
        files = export_calibration(full, "linuxcnc", anyway=True, options=options)
    write_files(tmp_path, files)
    centre, radius = (12.0, -8.0, 15.0), 16.0
    corners = [(28.0, -8.0, 15.0), (-35.0, 20.0, -25.0), (-35.0, -30.0, 10.0)]
    program = [
        "G21 G90 G61 G1 X28 Y-8 Z15 F6000",
        "G21 G90 G61 F6000 G2 X28 Y-8 Z15 I-16 J0",
        *(f"G1 X{x:g} Y{y:g} Z{z:g}" for x, y, z in corners[1:]),
    ]
    old = joints_at_switch(full, SWITCH)
    slides = run_program(
        program, joints_of(full, old), lines=files["kinematics.ini"], module=tmp_path
    )

    path = centre, radius, corners
    tool = full.machine.forward(slides[::5] * MM) / MM
    require_followed(from_pieces(tool, *path), PATH, [150, 100, 80])
    # the errors of the machine are large
    nominal = Machine(full.robot, {}).forward(slides[::5] * MM + ACTIVE) / MM
    assert from_pieces(nominal, *path).min(axis=0).max() > 1.0 * MM


@pytest.mark.acceptance
def test_linuxcnc_reaches_the_target_with_the_exported_home_offset(offsets):
    """One joint counts up, two count down."""
    require_linuxcnc()
    old = joints_at_switch(offsets, SWITCH)
    machine = Machine(offsets.robot, OFFSETS)
    point = np.array([20.0, -15.0, 30.0]) * MM
    options = ExportOptions(home_offsets=tuple(old))
    entered = export_calibration(offsets, "linuxcnc", options=options)["joints.ini"]
    drives = Machine(offsets.robot, {}).inverse(point)  # nominal kinematics
    joints = [float(d.to_joint(r)) / MM for d, r in zip(offsets.robot.drives, drives, strict=True)]
    words = " ".join(f"{letter}{v:.7f}" for letter, v in zip("XYZ", joints, strict=True))
    program = [f"G21 G90 G1 {words} F6000", "G4 P0.15"]
    slides = run_program(program, joints_of(offsets, old), lines=entered)
    assert np.linalg.norm(machine.forward(slides[-1] * MM) - point) < ENTERED
    # with the previous offsets the error is large
    assert np.linalg.norm(machine.forward(drives - ACTIVE) - point) > 0.5 * MM
