"""Settings for the firmware of a printer: a probed bed, new settings, the bed probed again.

The printer and its firmwares are simulated by a model of their own (`simulated_printer.py`).
"""

from __future__ import annotations

import re
from contextlib import chdir
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibrated import SOUND, identified
from commands import run_orthocal
from conftest import marked_reports
from simulated_printer import Printer, nominal, read_settings, rings, write_log, write_settings

from orthocal import (
    ExportError,
    SessionError,
    assess,
    calibrate,
    draw_errors,
    draw_scene,
    export_calibration,
    join_sessions,
    judge_session,
    load_calibration,
    load_session,
    validate_calibration,
    write_calibration,
)
from orthocal.assessment.printer_settings import _find_targets, fit_firmware
from orthocal.assessment.wording import tool_mm
from orthocal.calibration.refit import restore_covariances, restore_session
from orthocal.export.printer import describe_next
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.measurement.importing.printer_log import import_printer_log, write_printer_import
from orthocal.observation.sensor_groups import nuisance_parameters
from orthocal.output.scene.tool_errors import TOOL_ENTERED
from orthocal.output.text.accuracy import FIRMWARE_NOTE
from orthocal.output.text.answer import PRINT
from orthocal.output.text.layout import to_text
from orthocal.output.text.validation import render_validation
from orthocal.printers.firmwares import FIRMWARES
from orthocal.units import DEG, MM, UM

NOISE_MM = 0.02
TRIGGER_MM = 1.85

PROMISE = 2.0
"""Ratio of an RMS height of the first layer to the promised one; that of a few unknown directions
of the bed scatters by half."""


SHARE = 0.2
"""Part of the uncertainty by which estimates are displaced."""

SECOND_ORDER = 0.1
"""Part that the derivative omits, the curvature of residuals that are not 0: residuals of 0.2 mm
times 1/(200 mm) beside a least eigenvalue of JᵀJ of 5e-3."""

EXPRESSED = 2e-6
"""[m] A tower beside its direction is on a slightly larger radius, which three firmwares share."""

pytestmark = pytest.mark.usefixtures("assessed_once")


def make_printer(folder, seed, *, tilt=(0.002, -0.003)):
    """A printer with all errors of the complete model, and its robot as an import makes it."""
    log = folder / "nominal.txt"
    log.write_text(write_log("klipper", nominal(), rings(), np.zeros(41)))
    robot = import_printer_log(log).session.robot
    errors = draw_errors(robot, robot.parameters.select_model("full"), seed=seed)
    return Printer(robot, errors, tilt, TRIGGER_MM)


def probe_log(firmware, printer, settings, rng, *, step=1):
    """Log of a bed that is probed with given settings, at each of the points or fewer."""
    xy = rings()[::step]
    z = printer.probe(settings, xy, noise=NOISE_MM, rng=rng)
    return write_log(firmware, settings, xy, z, -TRIGGER_MM)


def promised(page):
    """RMS height of the first layer that the README expects, [mm]."""
    return float(re.search(r"height of the first layer \| [\d.]+ \| ([\d.]+) \|", page)[1])


def test_walk_of_the_owner_of_a_printer(tmp_path):
    """Paste a log, get an answer and lines; enter them; the bed is flat as promised."""
    rng, firmware = np.random.default_rng(1), "reprapfirmware"
    printer, settings = make_printer(tmp_path, 4), nominal()
    (tmp_path / "log.txt").write_text(probe_log(firmware, printer, settings, rng))
    for command in (
        ("import", "log.txt", "bed"),
        ("calibrate", "bed", "--out", "one", "--solver", "variable-projection"),
        ("export", "one", "--to", firmware, "--out", "new"),
    ):
        with marked_reports():
            done = run_orthocal(tmp_path, *command)
        assert done.returncode == 0, done.stderr
    shown = [line.split() for line in done.stdout.splitlines()]
    assert shown[0] == ["now", "new", "±"]
    assert [" ".join(row[:3]) for row in shown[11:13]] == ["tilt along x", "tilt along y"]
    assert (len(shown), shown[13][0]) == (16, "Next:")
    lines = (tmp_path / "new" / FIRMWARES[firmware].file).read_text()
    new = read_settings(firmware, lines, m851=-TRIGGER_MM)
    before = printer.probe(settings, rings()) - TRIGGER_MM
    after = printer.probe(new, rings()) - TRIGGER_MM
    assert np.sqrt(np.mean(before**2)) > 0.5
    promise = promised((tmp_path / "new" / "README.md").read_text())
    assert np.sqrt(np.mean(after**2)) < PROMISE * promise
    assert promise < 0.05
    compared = run_orthocal(tmp_path, "compare", "bed", "--models", "full").stdout
    fit = fit_firmware(load_calibration(tmp_path / "one"), firmware)
    row = next(line.split() for line in compared.splitlines() if line.split()[:1] == ["full"])
    errors = [tool_mm(fit.expect_tool(e)) for e in (fit.now, fit.new)]
    assert " ".join(row).startswith(f"full {' '.join(errors)} ")
    (tmp_path / "part.gcode").write_text("G21 G90\nG1 X9 F600\n")
    for command in (  # which know no settings of a firmware
        ("correct", "one", "part.gcode", "--out", "corrected.gcode"),
        ("export", "one", "--to", "table", "--out", "refused"),
        ("export", "one", "--to", "linuxcnc", "--offsets", "--out", "refused"),
        ("again", "one", "--out", "refused"),
    ):
        done = run_orthocal(tmp_path, *command)
        assert (done.returncode, f"--to {firmware}" in done.stderr) == (2, True)


def test_implausible_settings_are_not_proposed(calibrated):
    """All towers are 0.18 rad from their places. The export refuses this, too."""
    _, calibration = calibrated
    angles = (210 * DEG, 330 * DEG, 90 * DEG - 0.18)
    firmware = replace(calibration.session.firmware, angles=angles)
    session = replace(calibration.session, firmware=firmware)
    turned = replace(calibration, session=session, assessment=None)
    assessment = assess(turned, judgement=SOUND)
    (finding,) = assessment.of_kind("settings unknown")
    assert "tower a is at 19" in finding.text
    assert assessment.decision.reason == finding.text
    with pytest.raises(ExportError) as refused:
        export_calibration(replace(turned, assessment=assessment), "klipper")
    assert finding.text.endswith(f"{refused.value.problem[1:]}.")


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A calibration of a printer whose errors are known, in the place of its estimate."""
    folder = tmp_path_factory.mktemp("printer")
    printer = make_printer(folder, 8)
    (folder / "log.txt").write_text(
        probe_log("klipper", printer, nominal(), np.random.default_rng(2))
    )
    session = import_printer_log(folder / "log.txt").session
    return printer, calibrate(session, solver="linearised", judgement=SOUND)


def test_no_nearby_settings_are_better(calibrated):
    """The stated errors are those of the calibrated machine, and each change makes them worse."""
    _, calibration = calibrated
    fit = fit_firmware(calibration, "klipper")
    targets, _ = _find_targets(calibration, "bed")
    closure = LoopClosure(calibration.robot, fixed=calibration.errors)
    real = closure.forward(targets.layer.carriages)
    value = {p.name: p.value for p in calibration.sensors}
    roll, yaw = (value[f"setup.bed.{k}"] for k in ("roll", "yaw"))
    normal = np.array([np.cos(roll) * np.sin(yaw), -np.sin(roll), np.cos(roll) * np.cos(yaw)])
    assert np.abs(real @ normal).max() < 1e-9

    def cost(settings):
        change = np.array(settings.homed) - calibration.session.firmware.homed
        believed = settings.forward(targets.space.carriages + change)
        off = believed - targets.space.points
        arms = np.column_stack([-targets.space.points[:, 1], targets.space.points[:, 0]])
        basis = np.zeros((len(off), 3, 3))
        basis[:, 0, 0] = basis[:, 1, 1] = 1.0
        basis[:, :2, 2] = arms
        root = np.sqrt(np.repeat(targets.weights, 3))
        a, b = root[:, None] * basis.reshape(-1, 3), root * off.ravel()
        rest = b - a @ np.linalg.lstsq(a, b, rcond=None)[0]
        heights = settings.forward(targets.layer.carriages + change)[:, 2]
        return rest @ rest + 10.0 * np.mean(heights**2), np.sqrt(rest @ rest)

    best, rms = cost(fit.settings)
    assert rms == pytest.approx(fit.new.tool_rms, rel=1e-4)
    s = fit.settings
    for name in ("rods", "homed", "angles"):
        for k in range(2 if name == "angles" else 3):
            for step in (0.05 * MM, -0.05 * MM):
                values = list(getattr(s, name))
                values[k] += step
                assert cost(replace(s, **{name: tuple(values)}))[0] > best
    assert cost(replace(s, radius=s.radius + 0.05 * MM))[0] > best
    assert cost(replace(s, radius=s.radius - 0.05 * MM))[0] > best


def require_flat(printer, fit):
    """Require the promised height of the first layer with the lines of a fit."""
    firmware = fit.settings.firmware
    lines = FIRMWARES[firmware].config_lines(fit.settings)
    flat = printer.probe(read_settings(firmware, lines, -TRIGGER_MM), rings()) - TRIGGER_MM
    expected = np.hypot(fit.new.layer_rms, fit.layer_uncertainty) / MM
    assert np.sqrt(np.mean(flat**2)) < PROMISE * expected


@pytest.mark.parametrize("firmware", ["klipper", "marlin", "reprapfirmware"])
def test_the_bed_is_flat_with_the_lines_of_each_firmware(calibrated, firmware):
    """As the printer of the session reads them."""
    printer, calibration = calibrated
    require_flat(printer, fit_firmware(calibration, firmware))


def test_one_length_for_all_rods(calibrated):
    """Marlin 1.1 has no trims of rods, and B is a radius there: the lines have neither."""
    printer, calibration = calibrated
    fit, free = (fit_firmware(calibration, name) for name in ("marlin1", "marlin"))
    assert len(set(fit.settings.rods)) == 1
    assert len(set(free.settings.rods)) == 3
    assert fit.new.tool_rms > free.new.tool_rms
    rods = np.array([r.uncertainty for r in fit.rows[1:4]])
    assert rods == pytest.approx(np.full(3, rods[0]))
    require_flat(printer, fit)


@pytest.fixture(scope="module")
def probed_again(calibrated, tmp_path_factory):
    """Session of the bed after the settings of the export were entered."""
    printer, calibration = calibrated
    lines = FIRMWARES["klipper"].config_lines(fit_firmware(calibration, "klipper").settings)
    new = read_settings("klipper", lines)
    log = tmp_path_factory.mktemp("again") / "log.txt"
    log.write_text(probe_log("klipper", printer, new, np.random.default_rng(3), step=2))
    return import_printer_log(log).session


def test_settings_change_coordinates_but_no_travel(calibrated, probed_again):
    """The endstops stay, and the firmware is as much at a place as before."""
    _, calibration = calibrated
    before, here = calibration.session.firmware, probed_again
    moved = here.on_printer(calibration.robot, before.homed)
    assert moved.firmware.homed == before.homed
    assert moved.firmware.endstops == pytest.approx(here.firmware.endstops, abs=1e-12)
    for name, posture in here.postures.items():
        drives = moved.postures[name].drives
        travel = here.firmware.homed - posture.drives
        assert before.homed - drives == pytest.approx(travel, abs=1e-12)
        where = here.firmware.forward(posture.drives)
        assert moved.firmware.forward(drives) == pytest.approx(where, abs=1e-12)
        assert moved.firmware.inverse(where)[0] == pytest.approx(drives, abs=1e-12)
    assert probed_again.robot.sha256 != calibration.robot.sha256


def test_settings_keep_stated_tolerances_and_effects(calibrated, probed_again):
    """Those of the session itself, also where the other robot states some of its own."""
    robot = calibrated[1].robot
    homed = calibrated[1].session.firmware.homed
    glob = "*.offset_mm"
    here = probed_again.with_effects(["drift"]).with_tolerances({glob: 7.0})
    for other in (robot, robot.with_tolerances({glob: 3.0})):
        moved = here.on_printer(other, homed).robot
        assert moved.effect_names == ("drift",)
        assert moved.parameters.stated == {glob: 7.0}
        assert not probed_again.on_printer(other, homed).robot.parameters.stated


@pytest.fixture(scope="module")
def not_entered(calibrated, tmp_path_factory):
    """Directory and validation of a bed that is probed again with the settings of the first log."""
    printer, calibration = calibrated
    folder = tmp_path_factory.mktemp("logs")
    for name, seed in (("one", 2), ("two", 4)):
        log = folder / f"{name}.txt"
        rng = np.random.default_rng(seed)
        log.write_text(probe_log("klipper", printer, nominal(), rng, step=2))
        write_printer_import(import_printer_log(log), folder / name)
    with chdir(folder):
        record = replace(calibration.session, path="one/session.yaml")
        two = load_session("two")  # its settings are rounded, unlike those of the calibration
        return folder, validate_calibration(replace(calibration, session=record), two)


def test_settings_that_were_not_entered_are_named(not_entered):
    _, validation = not_entered
    assert validation.confirmed
    assert not validation.nothing_to_change
    (change,) = validation.assessment.of_kind("further change")
    assert "new ones are not active" in change.text
    (stated,) = validation.joint.assessment.of_kind("settings improve")
    assert stated.text in change.text
    fit = fit_firmware(validation.joint, "klipper")
    errors = [fit.expect_layer(fit.now), fit.expect_layer(fit.new)]
    numbers = [stated.numbers[f"layer_{name}_um"] for name in ("now", "best")]
    assert numbers == pytest.approx(np.array(errors) / UM, rel=1e-6)
    assert numbers[0] > 5.0 * numbers[1]


@pytest.mark.parametrize(
    ("active", "kind", "names"),
    [
        (lambda _, new: new, None, ()),
        (lambda old, _: old, "settings not entered", ()),
        (
            lambda old, new: replace(old, endstops=new.endstops),
            "settings not entered",
            ["radius", "rods", "tower angles"],
        ),
        (
            lambda old, new: replace(new, angles=np.array([*new.angles[:1], *old.angles[1:]])),
            "settings not entered",
            ["angle of tower b"],
        ),
        (
            lambda _, new: replace(new, endstops=new.endstops[[2, 1, 0]]),
            "settings interchanged",
            ["endstops of towers a and c"],
        ),
        (
            lambda _, new: replace(new, endstops=np.add(new.endstops, [0.25, -0.25, 0.0])),
            "bed moved",
            [],
        ),
    ],
)
def test_active_settings_that_a_log_does_not_state_are_named(
    calibrated, tmp_path, active, kind, names
):
    """Positions in the console belong to the active settings, and are read with the stated ones.

    The angle of tower c is the same in both.
    """
    printer, calibration = calibrated
    lines = FIRMWARES["klipper"].config_lines(fit_firmware(calibration, "klipper").settings)
    stated, rng, xy = read_settings("klipper", lines), np.random.default_rng(5), rings()[::2]
    z = printer.probe(active(nominal(), stated), xy, noise=NOISE_MM, rng=rng)
    cfg, log = tmp_path / "printer.cfg", tmp_path / "log.txt"
    cfg.write_text(f"{write_settings('klipper', stated)}[probe]\nz_offset: {TRIGGER_MM}\n")
    points = zip(xy, z, strict=True)
    log.write_text("".join(f"probe at {x:.3f},{y:.3f} is z={h:.6f}\n" for (x, y), h in points))
    validation = validate_calibration(calibration, import_printer_log(log, settings=[cfg]).session)
    assert validation.confirmed == (kind is None)
    if kind is None:
        assert validation.mistake is None
        assert validation.refit.rms_before == pytest.approx(validation.expected_rms, rel=0.5)
        assert validation.expected_rms < 2.0 * NOISE_MM * MM
        return
    assert (validation.mistake.explanation.kind, validation.mistake.explanation.names) == (
        kind,
        tuple(names),
    )
    decision = validation.assessment.decision
    assert (decision.verdict, decision.exit_code) == ("review", 3)
    assert "printer.cfg" in decision.action
    assert "probe again" in decision.action


def test_no_command_names_sessions_that_are_not_found_from_here(not_entered, monkeypatch):
    """Paths of a calibration are those of the directory in which it was made."""
    folder, validation = not_entered
    monkeypatch.chdir(folder)
    assert "orthocal calibrate one two " in to_text(render_validation(validation))
    (folder / "elsewhere").mkdir()
    monkeypatch.chdir(folder / "elsewhere")
    shown = " ".join(to_text(render_validation(validation)).split())
    assert "orthocal calibrate" not in shown
    assert "in the directory in which the calibration was made" in shown


def test_logs_of_a_printer_share_their_bed_unless_its_setup_has_another_name(calibrated):
    """Another sensor of a machine is mounted anew in each session."""
    _, calibration = calibrated
    one = restore_session(calibration)
    bed = one.setups["bed"]
    remounted = replace(
        one,
        setups={"bed2": replace(bed, name="bed2")},
        readings=tuple(replace(r, setup="bed2") for r in one.readings),
    )
    without = [replace(s, firmware=None) for s in (one, one)]
    for sessions, names in (
        ((one, one), {"setup.bed"}),
        ((one, remounted), {"setup.bed", "setup.bed2"}),
        (without, {"setup.session-1/bed", "setup.session-2/bed"}),
    ):
        joined = join_sessions([replace(s, sha256="", path=None) for s in sessions])
        parameters = nuisance_parameters(joined).parameters
        assert {p.name for p in parameters} == {f"{n}.{k}" for n in names for k in ("yaw", "roll")}


def test_the_second_probing_ends_the_walk(calibrated, probed_again):
    """It confirms the first, and nothing more has to be entered."""
    _, calibration = calibrated
    validation = validate_calibration(calibration, probed_again)
    assert validation.confirmed
    assert validation.nothing_to_change
    assert validation.enter == ()
    (kept,) = validation.assessment.of_kind("no change needed")
    assert "Nothing more has to be entered" in kept.text
    fit = fit_firmware(validation.joint, "klipper")
    assert not fit.worth_entering
    now = fit.expect_layer(fit.now), fit.expect_tool(fit.now)
    assert (kept.numbers["layer_now_um"], kept.numbers["now_um"]) == pytest.approx(
        np.array(now) / UM, rel=1e-6
    )
    assert now[0] < 0.05 * MM
    assert validation.assessment.decision.verdict == "enter"
    present = validation.joint.session.firmware
    assert present.endstops == pytest.approx(probed_again.firmware.endstops, abs=1e-12)
    before = fit_firmware(calibration, "klipper")
    assert before.worth_entering
    sizes = [[r.uncertainty for r in f.rows] for f in (fit, before)]
    assert (np.array(sizes[0]) <= sizes[1]).all()  # of both beds, only that of the last counts
    assert PRINT in to_text(render_validation(validation))
    assert describe_next(fit, Path("one"), Path("new")).startswith("Next: print.")


def test_old_settings_that_are_given_last_are_noted(calibrated, probed_again):
    """Only new ones have corrections of single towers."""
    old = replace(restore_session(calibrated[1]), sha256="")
    for sessions, noted in (([old, probed_again], False), ([probed_again, old], True)):
        orders = [
            f for f in judge_session(join_sessions(sessions)).findings if f.kind == "wrong order"
        ]
        assert [f.severity for f in orders] == ["note"] * noted
        assert all("settings are assumed" in f.text for f in orders)


def test_an_endstop_that_moved_is_named(calibrated, probed_again):
    """By 0.4 mm between the probings."""
    _, calibration = calibrated
    shift = np.array([0.0, 0.4 * MM, 0.0])
    moved = {
        name: replace(p, values=p.values + shift, drives=p.drives + shift)
        for name, p in probed_again.postures.items()
    }
    validation = validate_calibration(calibration, replace(probed_again, postures=moved))
    assert validation.confirmed is False
    change = validation.mistake.explanation
    assert change.drives == ("b_slide",)
    assert abs(change.amount) == pytest.approx(0.4 * MM, abs=3.0 * change.std)
    assert "endstop of tower b" in validation.assessment.decision.reason
    assert "export its settings" in validation.assessment.decision.action


def test_uncertainty_of_the_settings(calibrated):
    """Errors beside the identified ones change the settings as the derivative says."""
    _, calibration = calibrated
    fit = fit_firmware(calibration, "klipper")
    covariance, _, _ = restore_covariances(calibration)
    n = len(calibration.free)
    assert covariance[:n, :n] == pytest.approx(calibration.model_covariance, rel=1e-6, abs=1e-18)
    of_sensors = [p.std for p in calibration.sensors]
    assert np.sqrt(np.diag(covariance)[n:]) == pytest.approx(of_sensors, rel=1e-6)
    assert not fit.gain[10:].any()  # no tilts
    spread = 2.0 * np.sqrt(np.diag(fit.gain @ covariance @ fit.gain.T))[:10]
    sizes = np.array([MM] * 4 + [DEG] * 3 + [MM] * 3)
    stated = np.array([r.uncertainty for r in fit.rows])
    assert (stated >= 0.99 * spread / sizes).all()
    assert (stated < 1.3 * spread / sizes + 1e-12).all()  # Student's factor
    rng = np.random.default_rng(3)
    errors = SHARE * rng.multivariate_normal(np.zeros(len(covariance)), covariance)
    ends = [fit_firmware(_displaced(calibration, s * errors), "klipper") for s in (1.0, -1.0)]
    new = np.array([[r.new for r in end.rows] for end in ends]) * sizes
    change = 0.5 * (new[0] - new[1])
    missed = np.abs(change - fit.gain[:10] @ errors)
    assert (missed <= SECOND_ORDER * SHARE * spread + 1e-9).all()


def _displaced(calibration, errors):
    """The calibration with other estimates: those of the free errors and of the sensors."""
    values = [p.value for p in (*calibration.free, *calibration.sensors)] + errors
    n = len(calibration.free)
    free = dict(zip([p.name for p in calibration.free], values, strict=False))
    return replace(
        calibration,
        parameters=tuple(
            replace(p, value=free.get(p.name, p.value)) for p in calibration.parameters
        ),
        sensors=tuple(
            replace(p, value=v) for p, v in zip(calibration.sensors, values[n:], strict=True)
        ),
    )


def test_a_machine_that_the_firmware_can_express_is_met(calibrated):
    """Errors of radius, rods, towers and endstops alone leave nothing, and come back."""
    _, calibration = calibrated
    known = {
        **{f"{k}_slide.x": -1.1e-3 for k in "abc"},  # outwards
        "a_slide.z": 0.7e-3,
        "b_slide.offset": -0.6e-3,
        "a_coupler.x": 0.4e-3,
        "frame.a_rod_b_tip.x": 0.4e-3,
    }
    given = {p.name for p in calibration.parameters}
    assert set(known) <= given
    free = tuple(replace(p, value=known.get(p.name, 0.0)) for p in calibration.parameters)
    flat = tuple(replace(p, value=0.0) for p in calibration.sensors)
    machine = replace(calibration, parameters=free, sensors=flat)
    fit = fit_firmware(machine, "klipper")
    present = machine.session.firmware
    assert fit.new.tool_largest < EXPRESSED
    assert fit.settings.radius - present.radius == pytest.approx(1.1e-3, abs=5e-6)
    assert np.array(fit.settings.rods) - present.rods == pytest.approx([4e-4, 0, 0], abs=1e-6)
    turned = np.diff(np.array(fit.settings.angles) - present.angles)
    assert np.abs(turned) == pytest.approx([0.7e-3 / 0.1411, 0.0], abs=5e-5)


def test_accuracy_of_a_printer_names_no_offsets(calibrated, tmp_path, without_sensor_gains):
    """It has none: its firmware has settings. Names of parameters such as a_slide.offset remain."""
    _, calibration = calibrated
    write_calibration(calibration, tmp_path / "one")
    done = run_orthocal(tmp_path, "accuracy", "one")
    assert done.returncode == 0, done.stderr
    assert "offset" not in re.sub(r"\w+\.offset", "", done.stdout)
    assert FIRMWARE_NOTE in " ".join(done.stdout.split())


def test_other_sessions_are_refused(root):
    calibration = identified(load_session(root / "examples/raw-cycles"), "offsets")
    with pytest.raises(SessionError, match=r"controller\.firmware"):
        export_calibration(calibration, "klipper", anyway=True)


def test_offsets_of_a_printer_are_not_to_be_entered(calibrated, tmp_path):
    """Its firmware takes settings; a session that measures again comes from a new log."""
    _, calibration = calibrated
    assert calibration.assessment.entries == ()
    assert calibration.assessment.decision.verdict == "enter"
    assert not any(TOOL_ENTERED in entry.nodes for entry in draw_scene(calibration).legend)
    write_calibration(calibration, tmp_path / "one")
    done = run_orthocal(tmp_path, "again", "one", "--out", "two")
    assert done.returncode == 2
    assert "import" in done.stderr
    assert not (tmp_path / "two").exists()
    again = load_calibration(tmp_path / "one")
    assert again.session.firmware == calibration.session.firmware
    assert fit_firmware(again, "klipper").settings == fit_firmware(calibration, "klipper").settings
