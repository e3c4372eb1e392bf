"""BACKLASH, COMP_FILE and periodic errors of screws in exports, run in LinuxCNC.

The recorded motors move slides with backlash and periodic screws. The simulation shares no formula
with the effects: a slide follows its screw with a hysteresis.
"""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise, product
from unittest.mock import patch

import numpy as np
import pytest
from calibrated import SOUND, calibrated
from commands import run_orthocal
from effect_plans import write_plan
from linuxcnc import Joint, few_nodes, play, require_linuxcnc, run_program
from programs import read_polyline
from test_linuxcnc import (
    ACTIVE,
    SWITCH,
    Core,
    from_pieces,
    homes_of,
    joints_at_switch,
    joints_of,
    require_followed,
)

from orthocal import (
    Choice,
    ExportOptions,
    Machine,
    ParameterError,
    calibrate,
    export_calibration,
    load_plan,
    load_robot,
    simulate_session,
    write_calibration,
)
from orthocal.assessment.controller_entries import entered_offsets, find_screws, offsets_to_enter
from orthocal.effects.compensation import JointTrim
from orthocal.export.approach_sides import ApproachSides, find_lags
from orthocal.export.correction_field import CorrectionField
from orthocal.export.linuxcnc.drive_compensation import PeriodicErrors, find_periodic_errors
from orthocal.export.linuxcnc.instructions import describe_compensation
from orthocal.gcode.interpreter import Interpreter
from orthocal.gcode.path import Motion, Paths, arc_about
from orthocal.gcode.program import ProgramCorrector
from orthocal.gcode.reversals import split_at_reversals
from orthocal.gcode.segmentation import AT_BORDER, segment_motions
from orthocal.io.files import write_files
from orthocal.measurement.files.linuxcnc_ini import read_controller_joints
from orthocal.units import MM, UM

EFFECTS = "backlash: {tolerance_mm: 0.08}, screw: {lead_mm: 10, periodic_tolerance_mm: 0.02}"

JOINTS = {"y_slide": "{counts: down}", "z_slide": "{counts: down, at_zero_mm: 0}"}

TRUTH = {
    "x_slide.offset": 1.2 * MM,
    "y_slide.offset": -0.8 * MM,
    "z_slide.offset": 0.5 * MM,
    "x_slide.backlash": 60e-6,
    "y_slide.backlash": 40e-6,
    "z_slide.backlash": 25e-6,
    "x_slide.screw_sin": 12e-6,
    "y_slide.screw_cos": -9e-6,
    "z_slide.screw_sin": -6e-6,
    "z_slide.screw_cos": 7e-6,
}

LATCHED = (1, -1, -1)
"""Sign of the search; with the other one the switch may open before the backlash is taken up."""

ROUNDING = np.sqrt(3.0) * 0.5e-6
"""Effect of offsets that are entered to 1 µm, [m]."""

PATH_ERROR = 1e-6
"""Largest distance of the actual path from the programmed one, [m]."""


@pytest.fixture(scope="module", autouse=True)
def cheap_modules():
    with few_nodes():
        yield


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    folder = write_plan(
        tmp_path_factory.mktemp("compensated") / "plan", effects=EFFECTS, joints=JOINTS
    )
    plan = load_plan(folder).with_controller(ACTIVE)
    session = simulate_session(plan, TRUTH, seed=4, sigma=0.5e-6).session
    result = calibrate(session, Choice("offsets"), solver="variable-projection", judgement=SOUND)
    # unmodelled errors make some backlash and periodic errors insignificant, which this machine has
    # as identified
    entered = tuple(replace(e, enter=e.identified) for e in result.assessment.backlash)
    unmodelled = replace(result.unmodelled, leakage=0.0 * result.unmodelled.leakage)
    stds = dict(zip((p.name for p in result.free), np.diag(result.model_covariance), strict=True))
    parameters = (
        replace(p, std=float(np.sqrt(stds[p.name])), std_scaled=0.0) if p.free else p
        for p in result.parameters
    )
    assessment = replace(result.assessment, backlash=entered)
    return replace(
        result, assessment=assessment, unmodelled=unmodelled, parameters=tuple(parameters)
    )


def follow(calibration, motors):
    """Tool of the calibrated machine for recorded motors, shape (K, 3), [m]."""
    return tool_of(calibration, play(screws_of(calibration, motors), backlash_of(calibration)))


def screws_of(calibration, motors):
    """Positions of the screws for motors, shape (K, 3), [m]."""
    turns = 2.0 * np.pi * motors / 10e-3
    sine, cosine = (of_drives(calibration, kind) for kind in ("screw_sin", "screw_cos"))
    return motors + sine * np.sin(turns) + cosine * np.cos(turns)


def tool_of(calibration, slides):
    """Tool for actual positions of the slides, shape (K, 3), [m]."""
    rigid = {n: v for n, v in calibration.errors.items() if n.endswith(".offset")}
    return Machine(load_robot("orthoglide"), rigid).forward(slides)


def backlash_of(calibration):
    return of_drives(calibration, "backlash")


def of_drives(calibration, kind):
    return np.array([calibration.errors[f"{d.name}.{kind}"] for d in calibration.robot.drives])


def old_home_offsets(calibration):
    """HOME_OFFSET of each joint during the measurement, [m]."""
    return tuple(joints_at_switch(calibration, SWITCH))


CENTRE, RADIUS = (12.0, -8.0, 15.0), 16.0
CORNERS = [
    (24.0, -14.0, 12.0),
    (28.0, -8.0, 15.0),
    (-35.0, 20.0, -25.0),
    (-35.0, -30.0, 10.0),
    (10.0, -20.0, 20.0),
]
PATH = CENTRE, RADIUS, CORNERS
COUNTS = [150, 5, 100, 60, 60]
TAKEN_UP = 0.5
"""Distance after which all backlash is taken up, [mm]."""
REVERSING = 0.3
"""Distance from a corner within which drives take up their backlash in milliseconds, [mm]."""


def run(calibration, files, tmp_path, *, module, inverse=None, homes=None):
    write_files(tmp_path, files)
    tables = {name: text for name, text in files.items() if name.endswith(".comp")}
    program = [
        "G21 G90 G61 G1 X24 Y-14 Z12 F6000",  # far enough that all backlash is taken up
        "G21 G90 G61 F1500 G1 X28 Y-8 Z15",
        "G2 X28 Y-8 Z15 I-16 J0",
        *(f"G1 X{x:g} Y{y:g} Z{z:g} F6000" for x, y, z in CORNERS[2:]),
    ]
    lines = files["kinematics.ini" if module else "joints.ini"]
    joints = joints_of(calibration, old_home_offsets(calibration) if homes is None else homes)
    joints = [replace(j, latched=sign) for j, sign in zip(joints, LATCHED, strict=True)]
    motors = run_program(
        program, joints, lines=lines, module=tmp_path if module else inverse, files=tables
    )
    points = follow(calibration, motors * MM)[::5] / MM
    away = [np.linalg.norm(points - corner, axis=1) for corner in CORNERS]
    return points[(away[0] > TAKEN_UP) & (np.min(away, axis=0) > REVERSING)]


@pytest.mark.acceptance
def test_module_and_backlash_keep_the_path(calibration, tmp_path):
    require_linuxcnc()
    options = ExportOptions(module=True, within=0.05e-6, latched=LATCHED)
    files = export_calibration(calibration, "linuxcnc", anyway=True, options=options)
    assert len(re.findall(r"^BACKLASH = ", files["kinematics.ini"], re.M)) == 3
    actual = run(calibration, files, tmp_path, module=True)
    require_followed(from_pieces(actual, *PATH), PATH_ERROR, COUNTS)


@pytest.mark.acceptance
def test_tables_and_home_offset_keep_the_path(calibration, tmp_path):
    """The module of a machine without errors stands for nominal kinematics."""
    require_linuxcnc()
    old = old_home_offsets(calibration)
    options = ExportOptions(module=False, latched=LATCHED, home_offsets=old)
    files = export_calibration(calibration, "linuxcnc", anyway=True, options=options)
    assert sorted(name for name in files if name.endswith(".comp")) == [
        f"joint_{i}.comp" for i in range(3)
    ]
    rows = files["joint_0.comp"].splitlines()
    assert len(rows) == 256
    stated = float(re.search(r"error is up to ([\d.]+) µm", files["README.md"])[1])
    assert 0.1 < stated < 1.0
    nominal = tmp_path / "nominal"
    plan = load_plan(write_plan(tmp_path / "plain", effects="", joints=JOINTS))
    exact = simulate_session(plan.with_controller(np.zeros(3)), {}, exact=True).session
    plain = calibrate(exact, "offsets", solver="variable-projection", judgement=SOUND)
    module = export_calibration(plain, "linuxcnc", anyway=True, options=ExportOptions(module=True))
    write_files(nominal, module)
    files = {**files, "joints.ini": module["kinematics.ini"] + files["joints.ini"]}
    actual = run(calibration, files, tmp_path, module=False, inverse=nominal)
    within = PATH_ERROR + stated * 1e-6 + ROUNDING
    require_followed(from_pieces(actual, *PATH), within, COUNTS)


@pytest.mark.parametrize(
    ("options", "where"),
    [
        ({"module": True, "latched": (1, 1)}, "--latched"),
        ({"module": False, "latched": LATCHED}, "--home-offset"),
    ],
)
def test_export_with_backlash_needs_home_offsets_and_latch_directions(calibration, options, where):
    with pytest.raises(ParameterError) as caught:
        export_calibration(calibration, "linuxcnc", anyway=True, options=ExportOptions(**options))
    assert caught.value.where == where


def home_offsets(lines):
    return [float(v) for v in re.findall(r"^HOME_OFFSET = (\S+)", lines, re.M)]


def enter_export(calibration, folder, options):
    """Session of a calibration with its export entered into the controller, and the files."""
    files = export_calibration(calibration, "linuxcnc", anyway=True, options=options)
    write_files(folder, files)
    session = replace(
        calibration.session,
        compensation=read_controller_joints(folder / "joints.ini", calibration.robot).compensation,
        controller_offsets=tuple(offsets_to_enter(calibration).tolist()),
    )
    return session, files


@pytest.fixture(scope="module")
def under_tables(calibration, tmp_path_factory):
    """Calibration of a session under exported tables, and its HOME_OFFSET."""
    folder, old = tmp_path_factory.mktemp("tables"), old_home_offsets(calibration)
    options = ExportOptions(module=False, latched=LATCHED, home_offsets=old)
    record, files = enter_export(calibration, folder, options)
    entered = tuple(np.array(home_offsets(files["joints.ini"])) * MM)
    return replace(calibration, session=record), entered


def test_a_table_of_corrections_counts_the_tables_of_the_controller(under_tables):
    """Its points are those that corrected programs command."""
    under, _ = under_tables
    text = export_calibration(under, "table", anyway=True)["corrections.csv"]
    rows = np.loadtxt(text.splitlines(), delimiter=",", skiprows=1) * MM
    field = CorrectionField(under, entered_offsets(under), within=1e-6)
    commanded, refused = field.exactly(rows[::40, :3])
    assert not refused
    assert rows[::40, :3] + rows[::40, 3:] == pytest.approx(commanded, abs=2e-9)
    uncorrected = under.machine.inverse(rows[::40, :3]) + entered_offsets(under)
    assert np.abs(under.displacement(uncorrected)).max() > 1e-6


def test_second_export_under_the_exported_tables_is_the_same(under_tables):
    """HOME_OFFSET of the session already contains the trims of the tables."""
    under, entered = under_tables
    options = ExportOptions(module=False, latched=LATCHED, home_offsets=entered)
    again = export_calibration(under, "linuxcnc", anyway=True, options=options)
    assert np.abs(np.array(home_offsets(again["joints.ini"])) * MM - entered).max() < 2e-7
    for e in find_screws(under):  # straight lines between rows that are 0.106 of a turn apart
        size = np.linalg.norm(e.identified)
        assert e.active == pytest.approx(np.sinc(0.106) ** 2 * e.identified, abs=0.01 * size)


def test_a_table_that_is_kept_moves_with_home_offset():
    """An exact table stays exact: its trims at each position of the slide do not change."""
    calibration = calibrated("table1/experiment-2")
    joints = np.linspace(0.1, 0.4, 256)
    wave = 1e-5 * np.sin(joints / (0.2 * MM))
    trim = JointTrim(0.0, np.column_stack([joints, wave + 5e-6, wave - 5e-6]))
    record = replace(calibration.session, compensation=(JointTrim(), trim, JointTrim(2e-5)))
    calibration = replace(calibration, session=record)
    options = ExportOptions(home_offsets=(0.3, 0.3, 0.3))
    files = export_calibration(calibration, "linuxcnc", anyway=True, options=options)
    moved = np.loadtxt(files["joint_1.comp"].splitlines()) * MM
    shift = offsets_to_enter(calibration)[1] - calibration.active_offsets[1]
    assert abs(shift) > 0.1 * MM
    assert moved - trim.table == pytest.approx(np.tile([shift, 0.0, 0.0], (256, 1)), abs=1e-9)
    assert home_offsets(files["joints.ini"]) == pytest.approx(
        (0.3 + offsets_to_enter(calibration)) / MM, abs=1e-4
    )
    assert "move with HOME_OFFSET" in files["README.md"]
    assert "as during the measurement. Keep" in files["README.md"]


@pytest.fixture(scope="module")
def complete(tmp_path_factory):
    """Calibration of all errors of a machine whose y screw has no periodic error."""
    effects = EFFECTS.replace("0.02", "0.04")
    plan = load_plan(write_plan(tmp_path_factory.mktemp("screws") / "plan", effects=effects))
    plan = plan.with_controller(np.zeros(3))
    truth = {n: v for n, v in TRUTH.items() if not n.startswith("y_slide.screw")}
    truth |= {"x_slide.screw_cos": -11e-6, "z_slide.screw_sin": -15e-6}
    session = simulate_session(plan, truth, seed=4, sigma=1e-6).session
    return calibrate(session, "full", solver="variable-projection", judgement=SOUND)


def test_significant_periodic_errors_are_entered(complete):
    """The significance of A and B agrees with sampling."""
    rng = np.random.default_rng(0)
    names = [p.name for p in complete.free]
    entries = find_screws(complete)
    assert [e.enter.any() for e in entries] == [True, False, True]
    for e in entries:
        at = [names.index(f"{e.drive}.screw_{k}") for k in ("sin", "cos")]
        covariance = complete.total_covariance[np.ix_(at, at)]
        assert e.identified == pytest.approx([complete.free[i].value for i in at])
        drawn = rng.multivariate_normal(np.zeros(2), covariance, 200_000)
        inverse = np.linalg.inv(covariance)
        drawn = np.einsum("ni,ij,nj->n", drawn, inverse, drawn)
        farther = np.mean(drawn > e.identified @ inverse @ e.identified)
        assert (farther < 0.05) == e.enter.any()
    (finding,) = complete.assessment.of_kind("periodic errors")
    shown = [(e.drive, np.hypot(*e.enter) / UM) for e in entries if e.enter.any()]
    assert re.findall(r"(\w_slide) (\d+) ±", finding.text) == [(d, f"{a:.0f}") for d, a in shown]
    options = ExportOptions(module=False, latched=LATCHED, home_offsets=(0.3, 0.3, 0.3))
    files = export_calibration(complete, "linuxcnc", anyway=True, options=options)
    tables = sorted(name for name in files if name.endswith(".comp"))
    assert tables == ["joint_0.comp", "joint_2.comp"]
    listed = re.search(r"Periodic error of the screw unchanged[^:]*:\*\* (.*)", files["README.md"])
    (y,) = (e for e in entries if e.drive == "y_slide")
    assert listed[1] == f"JOINT_1 (±{y.uncertainty / MM:.3f} mm)."
    backlash = re.findall(r"^BACKLASH = (\S+)", files["joints.ini"], re.M)
    assert len(backlash) == 1  # that of y, which has no table


def test_again_names_the_tables_of_an_export(complete, tmp_path):
    """Without --ini, the new session does not state them; other lines differ from the export."""
    write_calibration(complete, tmp_path / "one.json")
    words = ["again", "one.json", "--anyway", "--out"]
    done = run_orthocal(tmp_path, *words, "without")
    assert done.returncode == 0, done.stderr
    assert "a table (COMP_FILE) for x_slide and z_slide" in " ".join(done.stderr.split())
    options = ExportOptions(module=False, latched=LATCHED, home_offsets=(0.3, 0.3, 0.3))
    for name, text in export_calibration(
        complete, "linuxcnc", anyway=True, options=options
    ).items():
        (tmp_path / name).write_text(text)
    lines = (tmp_path / "joints.ini").read_text()
    for comp in ("joint_0.comp", "joint_2.comp"):
        lines = lines.replace(f"COMP_FILE = {comp}\nCOMP_FILE_TYPE = 1\n", "")
    (tmp_path / "without.ini").write_text(lines)
    done = run_orthocal(tmp_path, *words, "other", "--ini", "without.ini")
    text = " ".join(done.stderr.split())
    assert "JOINT_0 has BACKLASH 0 or none instead of a table (COMP_FILE)" in text
    assert "JOINT_1" not in text


@pytest.mark.parametrize("end", [0, 1])
def test_a_switch_at_a_limit_stays_within_the_limits(calibration, end):
    """Half of the backlash is in HOME_OFFSET, but not in the position of the slide."""
    drives = zip(calibration.robot.drives, ACTIVE, strict=True)
    limits = [np.array(d.joint_limits) + d.direction * active for d, active in drives]
    old = tuple(float(pair[end]) for pair in limits)
    outside = 0

    def lines(latched):
        options = ExportOptions(module=False, latched=latched, home_offsets=old)
        files = export_calibration(calibration, "linuxcnc", anyway=True, options=options)
        return files["joints.ini"].split("[JOINT_")[1:]

    default = lines(None)
    for prefix, latched in (("", (1, 1, 1)), (r"(?:.* negative: )", (-1, -1, -1))):
        stated = lines(latched)
        low, homes, high = (
            [float(re.search(rf"(?m)^{key} = (\S+)", text)[1]) for text in stated]
            for key in ("MIN_LIMIT", "HOME_OFFSET", "MAX_LIMIT")
        )
        # without a direction the lines state the numbers of both
        for i, key in product(range(3), ("MIN_LIMIT", "HOME_OFFSET", "MAX_LIMIT")):
            found = re.findall(rf"(?m)^{prefix}{key} = (\S+)", default[i])
            found = found or re.findall(rf"(?m)^{key} = (\S+)", default[i])
            assert found == re.findall(rf"(?m)^{key} = (\S+)", stated[i])
        for i, d in enumerate(calibration.robot.drives):
            assert low[i] <= homes[i] <= high[i]
            change = d.direction * (offsets_to_enter(calibration)[i] - ACTIVE[i])
            shifted = (limits[i] + change) / MM
            widened = np.abs(np.array([low[i], high[i]]) - shifted)
            assert widened[1 - end] < 1e-4
            assert widened[end] < 0.06  # half of the backlash and the periodic error
            outside += widened[end] > 1e-3
    assert outside == 3  # for one of both directions of latching each


def test_limits_that_an_earlier_export_widened_contain_the_switch(calibration):
    """The INI file in use states them, so the travel of the robot does not narrow them."""
    drives = zip(calibration.robot.drives, ACTIVE, strict=True)
    travel = [np.array(d.joint_limits) + d.direction * active for d, active in drives]
    widened = tuple((low, high + 20e-6) for low, high in map(tuple, travel))
    old = tuple(high for _, high in widened)
    stated = ExportOptions(module=False, latched=(1, 1, 1), home_offsets=old, joint_limits=widened)
    lines = export_calibration(calibration, "linuxcnc", anyway=True, options=stated)["joints.ini"]
    high = [float(v) for v in re.findall(r"^MAX_LIMIT = (\S+)", lines, re.M)]
    assert all(home <= limit for home, limit in zip(home_offsets(lines), high, strict=True))


def test_a_backlash_that_does_not_change_needs_no_direction_of_latching(calibration):
    homes = homes_of(calibration)
    assert any(home.compensation.backlash for home in homes)
    changed, same = (
        describe_compensation(joints, module=True)
        for joints in (homes, [replace(home, was=home.compensation) for home in homes])
    )
    assert "latched in" in changed
    assert "latch" not in same.lower()
    assert "as during the measurement" in same


@pytest.mark.acceptance
def test_linuxcnc_leaves_a_switch_at_a_limit(calibration, tmp_path):
    """Homed at the switch, it would refuse to move if HOME_OFFSET were outside the soft limits.

    The switches are at the outer ends of travel, and homing latches them on the way inwards.
    """
    require_linuxcnc()
    drives, latched = calibration.robot.drives, tuple(-sign for sign in LATCHED)
    old = tuple(float(d.to_joint(d.upper + a)) for d, a in zip(drives, ACTIVE, strict=True))
    options = ExportOptions(module=False, latched=latched, home_offsets=old)
    files = export_calibration(calibration, "linuxcnc", anyway=True, options=options)
    write_files(tmp_path, files)
    homes = home_offsets(files["joints.ini"])
    joints = [
        Joint(d.direction, d.upper / MM, h, h, latched=sign)
        for d, h, sign in zip(drives, homes, latched, strict=True)
    ]
    program = []
    for distance in (5.0, 10.0):
        x, y, z = (h + distance * sign for h, sign in zip(homes, latched, strict=True))
        program.append(f"G21 G90 G1 X{x:.4f} Y{y:.4f} Z{z:.4f} F3000")
    tables = {name: text for name, text in files.items() if name.endswith(".comp")}
    slides = run_program(program, joints, lines=files["joints.ini"], files=tables)
    expected = [d.upper / MM - 10.0 for d in drives]
    assert np.abs(slides[-1] - expected).max() < 0.2


def test_insignificant_periodic_error_is_entered_if_the_tool_error_decreases(complete):
    """The y screw dominates the tool error only if the other errors are known.

    The covariance of the screws is unchanged, so that x and z are significant.
    """
    names = [p.name for p in complete.free]
    screws = np.array([".screw_" in name for name in names])
    cross = screws[:, None] != screws[None]
    for known, entered in ((3.0, False), (1e-3, True)):
        covariance = np.array(complete.model_covariance)
        covariance[np.ix_(~screws, ~screws)] *= known**2
        covariance[cross] = 0.0
        covariance[np.ix_(screws, screws)] *= 0.2
        x, y, z = find_screws(replace(complete, model_covariance=covariance))
        assert x.enter.any()
        assert z.enter.any()
        assert np.linalg.norm(y.identified) < 1.2 * y.uncertainty
        assert y.enter.any() == entered


def test_insignificant_change_keeps_a_table(complete, tmp_path):
    """Under the exported tables only the z screw has a significant change."""
    options = ExportOptions(module=False, latched=LATCHED, home_offsets=(0.3, 0.3, 0.3))
    session, files = enter_export(complete, tmp_path, options)
    kept = tuple(replace(e, active=e.enter) for e in complete.assessment.backlash)
    under = replace(
        complete,
        session=session,
        model_covariance=100.0 * complete.model_covariance,
        assessment=replace(complete.assessment, backlash=kept),
        parameters=tuple(
            replace(p, value=p.value + 0.2 * MM * (p.name == "z_slide.screw_sin"))
            for p in complete.parameters
        ),
    )
    x, _, z = find_screws(under)
    assert not x.change.any()
    assert z.change.any()
    entered = tuple(np.array(home_offsets(files["joints.ini"])) * MM)
    options = replace(options, home_offsets=entered)
    again = export_calibration(under, "linuxcnc", anyway=True, options=options)
    assert "joint_0.comp" not in again
    assert "joint_2.comp" in again


def test_module_and_tables_together_are_the_exact_correction(under_tables, tmp_path):
    """A controller that adds the tables to the module moves the slides to their places.

    A slide lags behind its screw by half of the backlash, on both sides.
    """
    under, entered = under_tables
    options = ExportOptions(module=True, within=0.05e-6, latched=LATCHED, home_offsets=entered)
    files = export_calibration(under, "linuxcnc", anyway=True, options=options)
    write_files(tmp_path, files)
    named = re.findall(r"^COMP_FILE = (\S+)\nCOMP_FILE_TYPE = 1$", files["kinematics.ini"], re.M)
    assert named == [f"joint_{i}_module.comp" for i in range(3)]
    assert "BACKLASH" not in files["kinematics.ini"]
    stated = float(
        re.search(r"entries of a table the error is up to ([\d.]+) µm", files["README.md"])[1]
    )
    assert stated < 0.1
    core = Core(tmp_path, files, periodic=True)
    robot, errors = under.robot, under.errors
    points = np.random.default_rng(1).uniform(-0.05, 0.05, (300, 3))
    rigid = {n: v for n, v in errors.items() if n.endswith(".offset")}
    slides = Machine(load_robot("orthoglide"), rigid).inverse(points)
    joints = core.inverse(points / MM) * MM
    for i, (d, was) in enumerate(zip(robot.drives, under.session.compensation, strict=True)):
        table = np.loadtxt(tmp_path / named[i]) * MM
        latching = 1 if LATCHED[i] > 0 else 2
        home = entered[i]
        begin = np.interp(home, was.table[:, 0], was.table[:, latching])
        begin -= np.interp(home, table[:, 0], table[:, latching])
        sine, cosine, backlash = (
            errors[f"{d.name}.{kind}"] for kind in ("screw_sin", "screw_cos", "backlash")
        )
        for grew, column in ((1.0, 1), (-1.0, 2)):
            trim = np.interp(joints[:, i], table[:, 0], table[:, column])
            motors = d.from_joint(joints[:, i] + begin + trim) - under.active_offsets[i]
            screws = slides[:, i] + d.direction * grew * 0.5 * backlash
            turns = 2.0 * np.pi * motors / 10e-3
            missed = motors + sine * np.sin(turns) + cosine * np.cos(turns) - screws
            assert np.abs(missed).max() < stated * 1e-6 + 0.05e-6


@pytest.mark.acceptance
def test_module_and_tables_keep_the_path(under_tables, tmp_path):
    require_linuxcnc()
    under, entered = under_tables
    options = ExportOptions(module=True, within=0.05e-6, latched=LATCHED, home_offsets=entered)
    files = export_calibration(under, "linuxcnc", anyway=True, options=options)
    actual = run(under, files, tmp_path, module=True, homes=entered)
    require_followed(from_pieces(actual, *PATH), PATH_ERROR, COUNTS)


def test_module_with_backlash_states_its_error_on_one_side(calibration):
    """Backlash shifts the phase of the periodic error by half of its size."""
    options = ExportOptions(module=True, latched=LATCHED)
    page = export_calibration(calibration, "linuxcnc", anyway=True, options=options)["README.md"]
    stated = float(re.search(r"On one side the error is up to ([\d.]+) µm", page)[1])
    periodic = find_periodic_errors(calibration.robot, calibration.errors)
    half = [0.5 * calibration.errors[f"{d.name}.backlash"] for d in calibration.robot.drives]
    at = np.linspace(0.2, 0.21, 4001)[:, None] * np.ones(3)
    error = np.abs(periodic.invert(at + half) - periodic.invert(at) - half).max()
    assert error <= stated * 1e-6 < 1.2 * error


def test_periodic_errors_are_inverted_exactly():
    errors = PeriodicErrors(5e-3, np.array([9e-6, 0.0]), np.array([-4e-6, 0.0]))
    coordinates = np.random.default_rng(0).uniform(0.1, 0.4, (200, 2))
    assert np.abs(errors.invert(coordinates + errors(coordinates)) - coordinates).max() < 1e-15
    assert np.abs(errors(coordinates)[:, 0]).max() > 9e-6


# ---- corrected programs that take up backlash

SPACING = 0.1
"""Distance of the points at which a corrected program is followed, [mm]."""

SHORT = [*CORNERS[:2], (18.0, -4.0, 9.0), (16.0, -10.0, 13.0)]
PART = (24.0, -8.0, 15.0), 4.0, SHORT
PROGRAM = [
    "G21 G90 G0 X{:g} Y{:g} Z{:g}".format(*SHORT[0]),
    "G1 X28 Y-8 Z15 F600",
    "G2 X28 Y-8 Z15 I-4 J0",
    *(f"G1 X{x:g} Y{y:g} Z{z:g}" for x, y, z in SHORT[2:]),
]


def points_along(lines):
    """Points along a program of straight lines, shape (K, 3), [mm]."""
    corners = np.array([point for written in read_polyline(lines).values() for point, _ in written])
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    counts = np.maximum(np.ceil(lengths / SPACING).astype(int), 1)
    pieces = zip(corners[:-1], corners[1:], counts, strict=True)
    return np.vstack([a + (b - a) * np.linspace(0, 1, n + 1)[1:, None] for a, b, n in pieces])


def run_corrected(calibration, field, *, backlash):
    """Tool of the calibrated machine along a corrected program, shape (K, 3), [mm]."""
    lags = find_lags(calibration.robot, calibration.errors)
    sides = ApproachSides(calibration, ACTIVE, lags) if backlash else None
    interpreter = Interpreter(axes=field.axes, offsets={})
    corrector = ProgramCorrector(interpreter, field, file="p.ngc", within=WITHIN, sides=sides)
    text = "".join(corrector.run(f"{line}\n" for line in PROGRAM))
    points = points_along(text.splitlines())
    motors = Machine(load_robot("orthoglide"), {}).inverse(points * MM) - ACTIVE
    return after_start(follow(calibration, motors))


def after_start(tool):
    """Points after all backlash is taken up, shape (K, 3), [mm]."""
    points = tool / MM
    return points[np.linalg.norm(points - SHORT[0], axis=1) > TAKEN_UP]


WITHIN = 1e-6


def test_corrected_program_takes_up_backlash(calibration):
    field = CorrectionField(calibration, ACTIVE, within=WITHIN)
    pieces = from_pieces(run_corrected(calibration, field, backlash=True), *PART)
    require_followed(pieces, WITHIN, COUNTS[:4])
    ignored = from_pieces(run_corrected(calibration, field, backlash=False), *PART)
    assert ignored.min(axis=0).max() > 20 * WITHIN


def test_points_on_a_side_of_the_backlash(calibration):
    """The slope of the screws' periodic errors changes the lag by up to 0.5 %."""
    rng = np.random.default_rng(2)
    points, sides = rng.uniform(-0.04, 0.04, (200, 3)), rng.choice([-1.0, 1.0], (200, 3))
    field = CorrectionField(calibration, ACTIVE, within=WITHIN)
    lags = find_lags(calibration.robot, calibration.errors)
    middle = field.exactly(points)[0]
    commanded = ApproachSides(calibration, ACTIVE, lags).command(middle, sides)
    screws = screws_of(
        calibration, Machine(load_robot("orthoglide"), {}).inverse(commanded) - ACTIVE
    )
    tool = tool_of(calibration, screws - 0.5 * sides * backlash_of(calibration))
    assert np.abs(tool - points).max() < SECOND_ORDER


def test_points_at_the_border_are_refused(calibration):
    """Where a leg would be square to its slide, central differences of the drives do not exist."""
    lags = find_lags(calibration.robot, calibration.errors)
    (leg, *_) = calibration.robot.legs.values()
    border = [0.0, leg.length - 1e-6, 0.0]
    sides = ApproachSides(calibration, ACTIVE, lags)
    commanded = sides.command(np.array([[0.0, 0.0, 0.0], border]), np.ones((2, 3)))
    assert np.isfinite(commanded).all(axis=1).tolist() == [True, False]
    paths = Paths.from_motions([Motion((0.0, 0.0, 0.0), tuple(border))])
    (refused,) = segment_motions(paths, lambda points: (points, {}), tolerance=1e-3, sides=sides)
    assert refused.reason == AT_BORDER


SECOND_ORDER = 0.01e-6
"""Second order of the lags, [m]."""


def motors_of(calibration, points):
    """Motors of a controller that adds trims to nominal kinematics, shape (K, 3), [m]."""
    displayed = Machine(load_robot("orthoglide"), {}).inverse(points * MM)
    motors = displayed - calibration.active_offsets
    trims = zip(calibration.robot.drives, calibration.session.compensation, strict=True)
    for i, (drive, trim) in enumerate(trims):
        joints = drive.to_joint(displayed[:, i])
        steps = np.append(1.0, np.diff(joints))
        moved = np.maximum.accumulate(np.where(steps != 0.0, np.arange(len(steps)), 0))
        grew = steps[moved] > 0.0
        if trim.table is None:
            added = np.where(grew, 0.5, -0.5) * trim.backlash
        else:
            up, down = (np.interp(joints, trim.table[:, 0], trim.table[:, k]) for k in (1, 2))
            added = np.where(grew, up, down)
        motors[:, i] += drive.direction * added
    return motors


@pytest.mark.parametrize("controller", ["tables", "half of the backlash"])
def test_program_for_a_controller_with_compensation(
    controller, calibration, under_tables, tmp_path
):
    """`correct` omits what the controller of the measurement compensates."""
    result, _ = under_tables
    if controller != "tables":
        backlash = [calibration.errors[f"{d.name}.backlash"] for d in calibration.robot.drives]
        trims = tuple(JointTrim(0.5 * b) for b in backlash)
        result = replace(calibration, session=replace(calibration.session, compensation=trims))
    (tmp_path / "one").mkdir()
    write_calibration(result, tmp_path / "one/calibration.json")
    (tmp_path / "part.ngc").write_text("\n".join([*PROGRAM, ""]))
    words = ["correct", "one", "part.ngc", "--offsets", "active", "--anyway", "--out", "good.ngc"]
    # the alignment of the program with the uncorrected machine has a test of its own
    with patch("orthocal.cli.correct._find_workspace", lambda _: None):
        done = run_orthocal(tmp_path, *words)
    assert done.returncode == 0, done.stderr
    points = points_along((tmp_path / "good.ngc").read_text().splitlines())
    tool = after_start(follow(calibration, motors_of(result, points)))
    assert from_pieces(tool, *PART).min(axis=0).max() < WITHIN + SIDED
    # a controller without compensation would need another program
    motors = Machine(load_robot("orthoglide"), {}).inverse(points * MM) - result.active_offsets
    tool = after_start(follow(calibration, motors))
    assert from_pieces(tool, *PART).min(axis=0).max() > 10 * WITHIN


SIDED = 1.0e-6
"""Part of the periodic errors that depends on the side, in drives: 0.2 µm each, [m]."""


class DrivesAsCoordinates:
    """Sides of drives that are the coordinates of the tool."""

    def __init__(self):
        self.current, self.farthest = np.zeros(3), np.full(3, np.nan)

    def drives(self, points):
        return points

    def command(self, points, sides):
        return points


def test_motions_are_divided_where_a_drive_reverses():
    """If the drives are the coordinates, a circle reverses each of two twice."""

    at = (10e-3, 0.0, 0.0)
    arc = arc_about(at, at, (0.0, 0.0), plane=17, clockwise=False, turns=1)
    paths = Paths.from_motions(
        [Motion((0.0, 0.0, 0.0), at), Motion(at, at, arc), Motion(at, (0.0, 0.0, 5e-3))]
    )
    sides = DrivesAsCoordinates()
    parts = split_at_reversals(paths, sides)
    assert parts.motion.tolist() == [0, *[1] * 4, 2]
    assert parts.start[1:5] == pytest.approx([0.0, 0.25, 0.5, 0.75], abs=1e-6)
    assert parts.sides.astype(int).tolist() == [
        *([1, 0, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 1])
    ]
    assert parts.takes_up.all()
    assert sides.current.tolist() == [-1.0, 1.0, 1.0]


@pytest.mark.parametrize("at_once", [1000, 7])
def test_drives_that_move_slowly_reverse_too(at_once):
    """Lines of 0.01 mm in x, in which z moves by 0.09 µm up, then down, while y trembles."""
    up = np.repeat([1.0, -1.0], 50)
    lines = np.arange(101.0)[:, None] * [1e-5, 0.0, 0.0]
    lines[1:, 2] = 0.09e-6 * np.cumsum(up)
    lines[:, 1] = 0.04e-6 * (-1.0) ** np.arange(101)
    motions = [Motion(a, b) for a, b in pairwise(map(tuple, lines))]
    sides, found, taken_up = DrivesAsCoordinates(), [], []
    for first in range(0, 100, at_once):
        parts = split_at_reversals(Paths.from_motions(motions[first : first + at_once]), sides)
        found += parts.sides.astype(int).tolist()
        taken_up += parts.takes_up.tolist()
    assert found == [[1, 0, 0], *[[1, 0, 1]] * 50, *[[1, 0, -1]] * 49]
    assert np.flatnonzero(taken_up).tolist() == [0, 1, 51]
    # after a motion that was not followed, only the direction counts
    sides.farthest = np.full(3, 1.0)
    split_at_reversals(Paths.from_motions([Motion((0.0, 0.0, 0.0), (1e-3, 0.0, 0.0))]), sides)
    assert sides.current.tolist() == [1.0, 0.0, -1.0]


def test_latch_direction_is_positive_by_default(calibration):
    """The lines then also state HOME_OFFSET of the other direction."""

    def export(**options):
        options = ExportOptions(home_offsets=(0.3, 0.3, 0.3), **options)
        return export_calibration(calibration, "linuxcnc", anyway=True, options=options)

    signs = "# signs of HOME_LATCH_VEL: [+, +, +]\n"  # stated for the next commands
    for module, file in ((True, "kinematics.ini"), (False, "joints.ini")):
        default, stated = (export(module=module, latched=s) for s in (None, (1, 1, 1)))
        assert (signs in default[file], signs in stated[file]) == (False, True)
        for name in {"joints.ini", "orthocal_core.c"} & default.keys():
            bare = "".join(
                line
                for line in default[name].splitlines(keepends=True)
                if not line.startswith("# if HOME_LATCH_VEL")
            )
            assert bare == stated[name].replace(signs, "")
        page = " ".join(default["README.md"].split())
        assert "assumed" in page
        assert "assumed" not in stated["README.md"]
        # a module displaces the joints, and HOME_OFFSET remains
        displaced = "The module contains half" if module else "is subtracted from HOME_OFFSET"
        assert re.findall("The module contains half|is .* from HOME_OFFSET", page) == [displaced]
    lines = default["joints.ini"]
    other = [float(v) for v in re.findall(r"negative: HOME_OFFSET = (\S+)", lines)]
    opposite = home_offsets(export(module=False, latched=(-1, -1, -1))["joints.ini"])
    assert other == opposite
    backlash = [TRUTH[f"{d.name}.backlash"] / MM for d in calibration.robot.drives]
    assert np.abs(np.array(opposite) - home_offsets(lines) - backlash).max() < 5e-3
