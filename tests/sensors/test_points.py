"""Points: readings against Pinocchio and SciPy, unknown frames, covariances, a tracker alone."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from calibrated import SOUND, UNJUDGED
from commands import orthocal
from machines import frame_pose
from scipy.spatial.transform import Rotation
from sensor_machines import assert_promises, calibrate_machines
from tolerances import CLOSED_FORM, SAME_NUMBER

from orthocal import calibrate, check_session, load_plan, load_session, write_session
from orthocal.errors import SessionError
from orthocal.kinematics.workspace import cube
from orthocal.measurement.files.point_rows import locate_stations
from orthocal.observation.model import predict_readings
from orthocal.observation.sensor_groups import nuisance_parameters
from orthocal.observation.simulate import simulate_session
from orthocal.output.text.answer import render_subject
from orthocal.output.text.layout import to_text
from orthocal.sensors.points import fit_station
from orthocal.study.bootstrap import build_bootstrap_study
from orthocal.study.sensitivity import build_sensitivity_study
from orthocal.units import MM

SIGMA = 10e-6
TARGET_MM = (3.0, -4.0, -40.0)
ERRORS = {"x_slide.offset": 0.7e-3, "y_slide.offset": -0.4e-3, "z_swivel.rx": 1.5e-3}
STATION = (2.0, 1.5, -0.4)
"""Position of a tracker, [m]."""

PREDICTED_MM = 0.1
"""[mm] Predictions of points by eight others: ten times their standard deviation."""

COVARIANCE_UM2 = [[90.0, 40.0, -10.0], [40.0, 60.0, 5.0], [-10.0, 5.0, 400.0]]


def grid(folder, keys="", *, side=3):
    """Plan of a tracker that sees the target in a grid of postures."""
    values = np.linspace(-50.0, 50.0, side)
    points = np.array(np.meshgrid(values, values, values)).reshape(3, -1).T
    postures = "".join(f"  p{i}: {{tcp_mm: {p.tolist()}}}\n" for i, p in enumerate(points))
    folder.mkdir(exist_ok=True)
    (folder / "plan.yaml").write_text(
        f"robot: orthoglide\ncontroller: {{offsets_mm: [0, 0, 0]}}\ngauge: {{sigma_mm: 0.01}}\n"
        f"postures:\n{postures}"
        f"setups:\n  track: {{sensor: points, target_mm: {list(TARGET_MM)}{keys}}}\n"
    )
    return load_plan(folder / "plan.yaml")


def test_readings_are_coordinates_of_the_target_in_the_station(tmp_path):
    """Machine by Pinocchio; a station anywhere, with errors of its pose and scale."""
    plan = grid(tmp_path, ", scale_tolerance: 0.001", side=2)
    names = [p.name for p in nuisance_parameters(plan).parameters]
    assert names == [f"station.track.{k}" for k in ("x", "y", "z", "rx", "ry", "rz", "scale")]
    position, rotation = np.array([2.1, -3.4, 0.7]), np.array([0.3, -1.1, 0.5])
    setups = {
        n: replace(s, sensor=replace(s.sensor, position=tuple(position), rotation=tuple(rotation)))
        for n, s in plan.setups.items()
    }
    plan = replace(plan, setups=setups)
    nuisance = np.array([4e-3, -2e-3, 1e-3, 0.02, -0.01, 0.03, 5e-4])
    found = predict_readings(plan, ERRORS, nuisance=nuisance)
    machine = plan.robot.with_errors(ERRORS)
    turned = Rotation.from_euler("xyz", nuisance[3:6])
    for row, reading in enumerate(plan.readings):
        pose = frame_pose(machine, plan.postures[reading.posture].drives, plan.robot.tcp.frame)
        target = pose.act(1e-3 * np.array(TARGET_MM))
        seen = turned.inv().apply(target - nuisance[:3])
        seen = Rotation.from_rotvec(rotation).inv().apply(seen - position)
        expected = (1.0 + nuisance[6]) * seen["xyz".index(reading.setup[-2])]
        assert abs(found[row] - expected) < CLOSED_FORM


def test_a_point_is_one_reading_in_all_answers(tmp_path):
    session = simulate_session(grid(tmp_path, side=2), ERRORS, seed=1).session
    assert session.title == "Simulated"  # the plan has none
    lines = [replace(r, line=i // 3 + 2) for i, r in enumerate(session.readings)]
    complete = replace(session, readings=tuple(lines))
    text = to_text(render_subject(calibrate(complete, "offsets", **UNJUDGED)))
    assert "Measured: 8 readings in 8 postures, 1 setup on the tool" in text
    found = check_session(complete, judgement=SOUND)
    assert found.of_kind("no anomaly")[0].numbers == {"readings": 8.0}
    lines[3:6] = [replace(r, value=np.nan) for r in lines[3:6]]
    found = check_session(replace(session, readings=tuple(lines)), judgement=SOUND)
    (missing,) = found.of_kind("readings missing")
    assert missing.numbers == {"readings": 8.0, "missing": 1.0}
    assert missing.text == "1 of 8 readings is missing (line 3)."


def test_the_station_is_that_of_scipy():
    rng = np.random.default_rng(0)
    points, turned = rng.normal(size=(7, 3)), Rotation.from_rotvec([2.0, -0.4, 1.0])
    targets = turned.apply(points) + [1.0, -2.0, 3.0] + 0.01 * rng.normal(size=(7, 3))
    position, rotation = fit_station(points, targets)
    middle = points.mean(axis=0), targets.mean(axis=0)
    expected, _ = Rotation.align_vectors(targets - middle[1], points - middle[0])
    np.testing.assert_allclose(rotation, expected.as_rotvec(), atol=SAME_NUMBER)
    np.testing.assert_allclose(position, middle[1] - expected.apply(middle[0]), atol=SAME_NUMBER)
    with pytest.raises(SessionError, match="line"):
        fit_station(np.outer(np.arange(4.0), [1.0, 2.0, 0.5]), targets[:4])


@pytest.mark.parametrize("wrong", [[4], [0, 7]])
def test_grossly_wrong_points_do_not_move_the_station(wrong):
    """Reversed signs and an error of 100 mm; the residuals of the others are 0.2 mm."""
    rng = np.random.default_rng(2)
    targets = rng.uniform(-0.05, 0.05, size=(9, 3))
    turned = Rotation.from_rotvec([0.1, 0.2, -0.3])
    points = turned.inv().apply(targets - STATION) + 0.2e-3 * rng.normal(size=(9, 3))
    expected = fit_station(np.delete(points, wrong, axis=0), np.delete(targets, wrong, axis=0))
    mistyped = points.copy()
    mistyped[wrong[0], 2] *= -1.0
    mistyped[wrong[1:], 0] += 0.1
    assert fit_station(mistyped, targets) == expected
    assert fit_station(points, targets) != expected


def test_points_in_one_cycle_cannot_be_resampled_by_cycles(tmp_path):
    """The message names the setup of the file."""
    session = simulate_session(grid(tmp_path, side=2), ERRORS, seed=3).session
    with pytest.raises(SessionError, match="one cycle") as refused:
        build_bootstrap_study(session, "offsets", by="cycles", draws=2)
    assert refused.value.where.endswith("setups.track")


@pytest.mark.parametrize(
    ("keys", "name"),
    [
        ("", "z_mm"),
        (f", covariance_um2: {COVARIANCE_UM2}", r"the coordinate along principal axis \d"),
    ],
)
def test_a_coordinate_out_of_range_is_named(tmp_path, keys, name):
    """Most points are missing: those that are read decide between a wrong unit and one mistake."""
    plan = grid(tmp_path, keys, side=2)
    number_by_posture = {p: 100.0 for p in [*plan.postures][:3]}
    number_by_posture["p2"] = 4e7
    rows = (f"track,{p},1,2,{number_by_posture.get(p)}" for p in plan.postures)
    rows = (row.replace(",1,2,None", ",,,") for row in rows)
    text = "setup,posture,x_mm,y_mm,z_mm\n" + "\n".join(rows)
    (tmp_path / "readings.csv").write_text(text)
    (tmp_path / "plan.yaml").write_text(
        (tmp_path / "plan.yaml").read_text() + "readings: readings.csv\n"
    )
    wrong = []
    load_plan(tmp_path / "plan.yaml", wrong=wrong)
    (error,) = wrong
    assert error.where.endswith(":4")
    assert re.match(name, error.problem)
    assert "decimal point" in error.problem


def tracked(folder):
    """Session of a tracker at STATION, and its points, shape (27, 3), [mm]."""
    plan = grid(folder)
    setups = {
        n: replace(s, sensor=replace(s.sensor, position=STATION, rotation=(0.1, 0.2, -0.3)))
        for n, s in plan.setups.items()
    }
    session = simulate_session(replace(plan, setups=setups), {"x_slide.offset": 1e-3}, seed=4)
    return session.session, session.session.values.reshape(27, 3) / MM


@pytest.mark.parametrize(
    ("point", "axis", "factor", "kind"),
    [(13, 0, -1.0, "reversed sign"), (20, 1, 0.1, "decimal point"), (5, 0, 1.03, "outlier")],
)
def test_check_names_a_mistyped_point_alone(tmp_path, point, axis, factor, kind):
    session, points = tracked(tmp_path)
    values = session.values
    values = np.where(np.arange(81) == 3 * point + axis, factor * values, values)
    write_session(session.with_values(values), tmp_path / "session", decimals=6)
    findings = [
        f
        for f in check_session(load_session(tmp_path / "session")).findings
        if f.severity != "note"
    ]
    assert [(f.kind, f.places[0].line) for f in findings] == [(kind, point + 2)]
    expected = points[point, axis]
    assert findings[0].numbers["expected_mm"] == pytest.approx(expected, abs=PREDICTED_MM)


@pytest.mark.parametrize("mistype", [[1.0, 1.0, -1.0], [1.01, 1.0, 1.0]])
def test_a_mistyped_coordinate_does_not_change_the_predictions_of_the_others(tmp_path, mistype):
    """After nine points of 27, the wrong one is the last; eight are in the file."""
    session, points = tracked(tmp_path)
    in_file = np.where(np.arange(81) < 3 * 8, session.values, np.nan)
    write_session(session.with_values(in_file), tmp_path / "session", decimals=4)
    line = " ".join(f"{v:.4f}" for v in points[8] * mistype)
    _, out, _ = orthocal("record", tmp_path / "session", typed=f"{line}\nquit\n")
    predicted = re.findall(r"predict ([xyz]) (\S+) ±", out)[-3:]
    assert [axis for axis, _ in predicted] == ["x", "y", "z"]
    assert [float(v) for _, v in predicted] == pytest.approx(points[8], abs=PREDICTED_MM)
    wrong = "xyz"[int(np.argmax(np.abs(np.subtract(mistype, 1.0))))]
    assert re.findall(r"! Line 10 ([xyz]) differs", out) == [wrong]


def test_points_without_all_coordinates_do_not_locate_the_station(tmp_path):
    session, _ = tracked(tmp_path)
    rows = [r for r in session.readings if r.setup != "track[x]"]
    located = locate_stations(session.select(rows), partial=True)
    assert located.setups["track[y]"].sensor.position == STATION


def test_principal_axes_weigh_points_by_their_covariance(tmp_path):
    """r' C⁻¹ r of each point is the sum of the squared residuals of its three sensors."""
    plan = grid(tmp_path, f", covariance_um2: {COVARIANCE_UM2}", side=2)
    assert list(plan.setups) == ["track[1]", "track[2]", "track[3]"]
    r = 1e-5 * np.random.default_rng(1).normal(size=3)
    expected = r @ np.linalg.solve(1e-12 * np.array(COVARIANCE_UM2), r)
    sensors = [(s.sensor, plan.gauges[s.gauge].sigma) for s in plan.setups.values()]
    found = sum((np.dot(sensor.along, r) / sigma) ** 2 for sensor, sigma in sensors)
    assert found == pytest.approx(expected, rel=SAME_NUMBER)


@pytest.mark.parametrize(
    ("keys", "station"),
    [("", "track"), (f", covariance_um2: {COVARIANCE_UM2}", "track"), (", station: left", "left")],
)
def test_a_simulated_session_comes_back_from_its_files(tmp_path, keys, station):
    session = simulate_session(grid(tmp_path, keys, side=2), ERRORS, seed=3).session
    write_session(session, tmp_path / "session", decimals=9)
    header = (tmp_path / "session" / "readings.csv").read_text().partition("\n")[0]
    assert header == "setup,posture,x_mm,y_mm,z_mm"
    again = load_session(tmp_path / "session")
    np.testing.assert_allclose(again.values, session.values, atol=2e-12)
    assert {n: s.sensor.in_file for n, s in again.setups.items()} == {
        n: s.sensor.in_file for n, s in session.setups.items()
    }
    assert {s.sensor.station for s in again.setups.values()} == {station}
    assert [g.sigma for g in again.gauges.values()] == pytest.approx(
        [g.sigma for g in session.gauges.values()]
    )


def test_a_row_can_state_its_covariance(tmp_path):
    session = simulate_session(grid(tmp_path, side=2), ERRORS, seed=3).session
    write_session(session, tmp_path / "session")
    file = tmp_path / "session" / "readings.csv"
    head, *rows = file.read_text().splitlines()
    head += ",cov_xx_um2,cov_yy_um2,cov_zz_um2,cov_xy_um2,cov_xz_um2,cov_yz_um2"
    rows = [rows[0] + ",90,60,400,40,-10,5", rows[1] + ",25,36,49,0,0,0"] + [
        f"{row},,,,,," for row in rows[2:]
    ]
    file.write_text("\n".join([head, *rows]) + "\n")
    found = load_session(tmp_path / "session")
    assert [n for n in found.setups if not n.endswith("]") or len(n) > len("track[x]")] == [
        *("track[12]", "track[22]", "track[32]"),
        *("track[x3]", "track[y3]", "track[z3]"),
    ]
    assert [found.gauges[f"[track[{k}3]]"].sigma for k in "xyz"] == [5e-6, 6e-6, 7e-6]
    write_session(found, tmp_path / "again")
    again = load_session(tmp_path / "again")
    np.testing.assert_allclose(again.values, found.values, atol=2e-9)
    assert list(again.setups) == list(found.setups)
    # along the same axes, the values of a study do not show the covariance
    file.write_text(file.read_text().replace(",25,36,49,", ",25,64,49,"))
    sessions = (found, load_session(file.parent))
    assert len({build_sensitivity_study(s, ["*.offset"]).digest for s in sessions}) == 2


@pytest.mark.slow
def test_a_tracker_alone_identifies_the_complete_model(tmp_path, orthoglide):
    """Machines with all errors; the readings determine 12 axes of each."""
    outcome = calibrate_machines(grid(tmp_path), cube(orthoglide, points_per_side=3), count=40)
    assert_promises(outcome)
    assert outcome.predicted < SIGMA
    assert outcome.bound == pytest.approx(outcome.predicted, rel=0.05)


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        ("track,p0,1,2,", "z_mm is empty"),
        ("track,p0,1,2,x", "z_mm"),
        ("track[x],p0,1,2,3", "is not a setup; setups: track"),
    ],
)
def test_a_wrong_row_is_refused_by_its_line(tmp_path, row, problem):
    session = simulate_session(grid(tmp_path, side=2), ERRORS, seed=3).session
    write_session(session, tmp_path / "session")
    file = tmp_path / "session" / "readings.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([lines[0], row, *lines[2:]]) + "\n")
    with pytest.raises(SessionError, match=problem) as caught:
        load_session(tmp_path / "session")
    assert str(caught.value.where).endswith(":2")
