"""Scenes without a browser: poses compared with Pinocchio, arrows with residuals."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from calibrated import (
    EXPERIMENT_2,
    UNJUDGED,
    calibrated,
    identified,
    rename_setups,
    scene_of,
    session_of,
)
from effect_plans import effect_plan
from gauges import exact
from meshcat.geometry import MeshBasicMaterial, Sphere
from tolerances import KINEMATICS

from orthocal import calibrate, draw_scene, load_robot, load_session
from orthocal.assessment.controller_entries import find_entries
from orthocal.assessment.tool_error import assess_tool
from orthocal.calibration.file import load_calibration, write_calibration
from orthocal.errors import ParameterError, SessionError
from orthocal.measurement.files.session_file import load_plan
from orthocal.measurement.joining import join_sessions
from orthocal.observation.simulate import simulate_session
from orthocal.output.scene import drawing, readings, tool_errors
from orthocal.output.scene.deviations import (
    measure_deviations,
    measurement_of_calibration,
    measurement_of_session,
)
from orthocal.output.sheet.page import sheet_files
from orthocal.sensors.leg_indicator import DIRECTIONS
from orthocal.viewer import machine as machine_scene
from orthocal.viewer.scene import FRAME_RATE, Scene, round_scale
from orthocal.viewer.shapes import arrow_parts, dial_distance, head_length


@pytest.fixture(scope="module")
def calibration():
    return calibrated(EXPERIMENT_2)


@pytest.fixture(scope="module")
def scene():
    return scene_of(EXPERIMENT_2)


@pytest.fixture(scope="module")
def full():
    return calibrated("sweep", "full", **UNJUDGED)


@pytest.fixture(scope="module")
def overview(full):
    """The complete model, not enlarged."""
    return draw_scene(full, exaggeration=1.0)


@pytest.fixture(scope="module")
def true_scale(full):
    """A posture of the complete model, not enlarged."""
    return draw_scene(full, posture="y_+60", exaggeration=1.0)


@cache
def session_scene(name):
    """Scene of the session of an example, without a calibration."""
    return draw_scene(session_of(name))


def world(scene, path):
    """Pose of a node in the world."""
    names = path.split("/")
    pose = np.eye(4)
    for i in range(len(names)):
        pose = pose @ scene.pose("/".join(names[: i + 1]))
    return pose


def placed(robot, drives, passive):
    """Poses of all links by Pinocchio alone."""
    data = robot.model.createData()
    q = robot.configuration(robot.joint_coordinates(drives, passive))
    pin.framesForwardKinematics(robot.model, data, q)
    return {
        f.name: data.oMf[i].homogeneous
        for i, f in enumerate(robot.model.frames)
        if f.type == pin.FrameType.BODY
    }


def links(scene, machine):
    return {path.split("/")[1] for path in scene.nodes if path.startswith(f"{machine}/")}


def arrow_length(scene, path):
    """Length of an arrow from its foot to the tip of its head."""
    shaft, head = scene.pose(f"{path}/shaft"), scene.pose(f"{path}/head")
    width = readings.arrow_width(dial(scene))
    assert np.isclose(shaft[2, 2], head[2, 3], atol=1e-8)
    return head[2, 3] + head[2, 2] * head_length(width)


def dial(scene):
    """Radius of the dials."""
    shape = next(
        c["object"]["geometries"][0]
        for c in scene.commands
        if c["type"] == "set_object" and c["path"].endswith("/case")
    )
    return shape["radiusTop"]


def hidden(scene):
    """Nodes that are initially hidden."""
    return {
        c["path"].strip("/")
        for c in scene.commands
        if c["type"] == "set_property" and c["property"] == "visible" and not c["value"]
    }


def animation(scene):
    """Node to its tracks: property to times [s] and values."""
    command = next(c for c in scene.commands if c["type"] == "set_animation")
    found = {}
    for part in command["animations"]:
        found[part["path"].strip("/")] = {
            t["name"].strip("."): (
                np.array([k["time"] for k in t["keys"]]) / part["clip"]["fps"],
                np.array([k["value"] for k in t["keys"]]),
            )
            for t in part["clip"]["tracks"]
        }
    return found


# ---- the machine


def test_true_scale_is_the_calibrated_machine_of_pinocchio(full, true_scale):
    """Calibrated links and ghost in a posture, with loops closed by Pinocchio."""
    posture = next(p for p in full.postures if p.name == "y_+60")
    scene = true_scale
    machine = full.robot.with_errors(full.errors)
    passive = machine.close_with_pinocchio(posture.drives, np.array(posture.passive))
    real = placed(machine, posture.drives, passive)
    for link in links(scene, drawing.SOLID):
        pose = world(scene, f"{drawing.SOLID}/{link}")
        assert np.abs(pose - real[link]).max() < KINEMATICS
    robot = full.robot
    start = robot.close_with_pinocchio(posture.drives, np.array(posture.passive))
    nominal = placed(robot, posture.drives, start)
    ghosts = links(scene, drawing.GHOST)
    assert "base" not in ghosts
    assert "x_rod_a" in ghosts
    for link in ghosts:
        pose = world(scene, f"{drawing.GHOST}/{link}")
        assert np.abs(pose - nominal[link]).max() < KINEMATICS


def test_deviation_is_enlarged_by_the_stated_factor(full, true_scale):
    true = true_scale
    large = draw_scene(full, posture="y_+60", exaggeration=25.0)
    assert large.exaggeration == 25.0
    assert any("× 25" in fact for fact in large.facts)
    assert any("true scale" in fact for fact in true.facts)
    moved = []
    for link in links(true, drawing.GHOST):
        ghost = world(true, f"{drawing.GHOST}/{link}")
        small = world(true, f"{drawing.SOLID}/{link}")
        big = world(large, f"{drawing.SOLID}/{link}")
        assert np.abs(world(large, f"{drawing.GHOST}/{link}") - ghost).max() < KINEMATICS
        shift = small[:3, 3] - ghost[:3, 3]
        moved.append(np.linalg.norm(shift))
        assert big[:3, 3] - ghost[:3, 3] == pytest.approx(25.0 * shift, abs=KINEMATICS)
        turn = pin.log3(ghost[:3, :3].T @ small[:3, :3])
        assert pin.log3(ghost[:3, :3].T @ big[:3, :3]) == pytest.approx(25.0 * turn, abs=1e-9)
    assert max(moved) > 1e-3


def test_default_factor_makes_the_largest_deviation_a_twentieth_of_the_machine(scene):
    size = np.ptp(scene.camera.points, axis=0).max()
    fact = next(f for f in scene.facts if "largest" in f)
    largest = float(fact.split("largest ")[1].split(" mm")[0]) * 1e-3
    assert 0.03 * size < scene.exaggeration * largest <= 0.0501 * size


def test_machine_without_deviation_needs_no_ghost(root):
    """The true and the estimated machine are the nominal one."""
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    session = simulate_session(plan, {}, exact=True).session
    scene = draw_scene(calibrate(session, **UNJUDGED))
    assert not links(scene, drawing.GHOST)
    assert scene.exaggeration == 1.0
    assert "does not deviate" in " ".join(scene.facts)
    assert "No gauge shows a deviation" in scene.headline


def test_each_session_has_its_own_offsets(root):
    """The nominal machine of a joined calibration stands where its controller assumed it."""
    first = load_session(root / "examples/raw-cycles")
    offsets = np.array([1e-3, -2e-3, 0.5e-3])
    postures = {n: replace(p, drives=p.drives - offsets) for n, p in first.postures.items()}
    second = replace(first, controller_offsets=offsets, postures=postures, title="second")
    second = second.with_values(second.values + 1e-6)
    joined = identified([replace(first, title="first"), second])
    measured = measurement_of_calibration(joined)
    assert {tuple(v) for v in measured.active.values()} <= {(0.0, 0.0, 0.0), tuple(offsets)}
    for name, drives in measured.drives.items():
        target = drives + measured.active.get(name, measured.offsets)
        expected = first.postures[name.rpartition("/")[2]].drives
        assert target == pytest.approx(expected, abs=1e-12)
    robot, drives = first.robot, first.postures["x_max"].drives
    target = placed(robot, drives, robot.close_with_pinocchio(drives, robot.reference_passive))
    shown = [(joined, f"raw-cycles-{day}/x_max") for day in (1, 2)]
    for subject, posture in (*shown, (identified(second), "x_max")):
        ghost = world(draw_scene(subject, posture=posture), f"{drawing.GHOST}/platform")
        assert np.abs(ghost - target["platform"]).max() < 1e-11


def test_readings_of_several_approaches_are_not_averaged():
    plan = effect_plan("backlash")
    truth = {"x_slide.backlash": 60e-6}
    session = simulate_session(plan, truth, seed=1, sigma=1e-7).session
    rows = measure_deviations(session)
    approaches = {r.approach for r in session.readings}
    assert len(approaches) > 2
    assert {r.approach for r in rows} == approaches
    assert all(f"approach {r.approach}" in r.where for r in rows)
    assert max(r.cycles for r in rows) == max(
        Counter((r.setup, r.posture, r.approach) for r in session.readings).values()
    )


# ---- gauges and arrows


def test_arrows_are_as_long_as_the_residuals(scene, calibration):
    assert set(readings.BEFORE + "/" + r.setup for r in calibration.residuals) == {
        p.rsplit("/", 1)[0] for p in scene.nodes if p.startswith(readings.BEFORE)
    }
    for row in calibration.residuals:
        for node, value in ((readings.BEFORE, row.deviation), (readings.AFTER, row.residual)):
            path = f"{node}/{row.setup}"
            assert arrow_length(scene, path) == pytest.approx(value * scene.arrow_scale, abs=1e-9)
            setup = next(s for s in calibration.setups if s.name == row.setup)
            along = scene.pose(path)[:3, 2]
            assert along == pytest.approx(np.array(DIRECTIONS[setup.sensor.direction]))
    arrows = [e.text for e in scene.legend if e.nodes[0] in (readings.BEFORE, readings.AFTER)]
    assert len(arrows) == 2
    assert all(text.endswith(f"(× {scene.arrow_scale:g})") for text in arrows)


def test_arrow_that_is_shorter_than_its_head_is_a_smaller_head():
    width = 0.01
    for length in (0.2, 0.03, 0.001, -0.001, -0.2):
        _, ((*_, foot),), ((*_, head),) = arrow_parts([length], width)
        assert foot + head * head_length(width) == pytest.approx(length)
        assert abs(head) <= 1.0
        assert np.sign(head) == np.sign(length)
    assert arrow_parts([0.0], width)[2][0, 0] < 1e-5


def test_gauges_touch_the_leg_at_their_section(scene, calibration):
    for setup in calibration.setups:
        tip = scene.pose(f"{readings.GAUGES}/{setup.name}")[:3, 3]
        line = scene.pose(f"{machine_scene.LINES}/leg {setup.sensor.leg}")
        along = line[:3, 2] / np.linalg.norm(line[:3, 2])
        off = tip - line[:3, 3]
        assert np.linalg.norm(off - (off @ along) * along) < KINEMATICS
        leg = calibration.robot.legs[setup.sensor.leg]
        plane = leg.axis @ leg.reference_root + setup.sensor.section.value * leg.length
        assert leg.axis @ tip == pytest.approx(plane, abs=KINEMATICS)
        stem = scene.pose(f"{readings.GAUGES}/{setup.name}")[:3, 2]
        assert stem == pytest.approx(np.array(DIRECTIONS[setup.sensor.direction]))


@pytest.mark.parametrize("name", ["raw-cycles", "linear_delta"])
def test_label_points_to_the_dial_or_fixed_ball_of_its_gauge(name):
    session, scene = session_of(name), session_scene(name)
    labels = [label for label in scene.labels if label.node.startswith(readings.GAUGES)]
    assert len(labels) == len(session.setups)
    for label in labels:
        part = "fixed" if f"{label.node}/fixed" in scene.nodes else "case"
        shape = world(scene, f"{label.node}/{part}")[:3, 3]
        assert label.at[0] == pytest.approx(shape, abs=KINEMATICS)


@pytest.mark.parametrize(
    ("posture", "tool_mm", "read", "direction"),
    [
        ("bar6", (-41.782, -41.782, 10.419), "bar", (-0.6963666, -0.6963666, 0.17365)),
        ("bed25", (70.0, 70.0, 0.0), "bed", (0.0, 0.0, -1.0)),
    ],
)
def test_gauge_label_and_arrow_follow_the_tool(posture, tool_mm, read, direction):
    """Of the bar, whose fixed ball is at the origin, and of the dial above the bed."""
    scene, tool = session_scene("linear_delta"), np.array(tool_mm) / 1e3
    tracks, size = animation(scene), dial(scene)
    stop, step = next((i, s) for i, s in enumerate(scene.steps) if s.name == posture)

    def value(path, name):
        times, values = tracks[path][name]
        return values[np.flatnonzero(np.isclose(times, step.start))[0]]

    for setup in ("bar", "bed"):
        assert value(f"{readings.GAUGES}/{setup}", "visible") == (setup == read)
    arrow = f"{readings.BEFORE}/{read}"
    shift = value(arrow, "position") - tool
    assert np.linalg.norm(shift) < 1.1 * size
    assert shift @ direction == pytest.approx(0.0, abs=1e-6)
    if read == "bar":
        x, y, z, w = value(arrow, "quaternion")
        assert pin.Quaternion(w, x, y, z).toRotationMatrix()[:, 2] == pytest.approx(
            np.array(direction), abs=1e-5
        )
    label = next(s for s in scene.labels if s.node == f"{readings.GAUGES}/{read}")
    place = np.zeros(3) if read == "bar" else tool - dial_distance(size) * np.array(direction)
    assert label.at[stop] == pytest.approx(place, abs=1e-6)
    assert label.texts[stop].endswith(posture)


def test_posture_shows_only_gauges_that_read_it():
    assert hidden(draw_scene(session_of("linear_delta"), posture="bar6")) == {
        f"{readings.GAUGES}/bed"
    }


def test_no_shape_hides_an_arrow_at_the_tool_or_the_line_of_a_leg_with_one_rod(root):
    """The arrow may be inside of the tool or of the bed."""

    def in_front(scene):
        shapes = [c for c in scene.commands if c["type"] == "set_object"]
        looks = {c["path"].strip("/"): c["object"]["materials"][0] for c in shapes}
        nodes = {path for path, look in looks.items() if look.get("depthTest") is False}
        assert all(looks[path]["transparent"] for path in nodes)  # drawn last
        return {"/".join(path.split("/")[:2]) for path in nodes}

    assert in_front(session_scene("raw-cycles")) == set()
    assert in_front(session_scene("linear_delta")) == {
        f"{readings.BEFORE}/{name}" for name in ("bed", "bar")
    }
    lines = {f"{machine_scene.LINES}/leg {name}" for name in ("left", "right")}
    assert in_front(draw_scene(load_robot(root / "examples/fivebar"))) == lines


def test_scene_states_the_offsets_to_enter(scene, calibration):
    """The leg with the largest deviation, x, is not the one with the largest offset, z."""
    fact = next(f for f in scene.facts if f.startswith("Offsets to enter"))
    for entry in find_entries(calibration):
        assert f"{entry.drive} {entry.enter * 1e3:+.3f}".replace("-", "−") + " mm" in fact
    decision = replace(calibration.assessment.decision, verdict="review")
    doubtful = replace(calibration, assessment=replace(calibration.assessment, decision=decision))
    assert not any("Offsets to enter" in fact for fact in draw_scene(doubtful).facts)


def test_of_many_gauges_the_overview_names_the_worst(full, overview):
    scene = overview
    named = [
        label.texts[0].split()[0] for label in scene.labels if label.texts[0] and label.rank > 0
    ]
    assert len(named) == 6
    worst = max(full.residuals, key=lambda r: abs(r.deviation))
    assert worst.setup in named
    assert len({p.split("/")[1] for p in scene.nodes if p.startswith(readings.GAUGES)}) == 18


@pytest.mark.parametrize("name", [EXPERIMENT_2, "lines"])
def test_deviations_of_a_session_are_those_of_its_calibration(name):
    """Two ways to the same numbers: without a fit, and from the residuals of a fit."""
    session = exact(session_of(name))  # without nuisance parameters of the mounting
    rows = identified(session).residuals
    mean = {}
    for row in rows:
        mean.setdefault((row.setup, row.posture, row.minus), []).append(row.deviation)
    found = {(d.setup, d.posture, d.minus): d.before for d in measure_deviations(session)}
    assert found.keys() == mean.keys()
    for key, values in mean.items():
        assert found[key] == pytest.approx(np.mean(values), abs=1e-10)


def test_deviations_of_joined_sessions_are_those_of_each(raw_cycles):
    """Each with its active offsets, and the nominal machine where its controller assumed it."""
    second = raw_cycles.with_controller([1e-3, -2e-3, 0.5e-3])
    joined = join_sessions([raw_cycles, second.with_values(second.values)])
    found = [(d.setup.partition("/")[2], d.before) for d in measure_deviations(joined)]
    alone = [(d.setup, d.before) for s in (raw_cycles, second) for d in measure_deviations(s)]
    assert [setup for setup, _ in found] == [setup for setup, _ in alone]
    assert [v for _, v in found] == pytest.approx([v for _, v in alone], abs=1e-12)
    measured = measurement_of_session(joined)
    for name, drives in measured.drives.items():
        expected = raw_cycles.postures[name.partition("/")[2]].drives
        assert drives + measured.active[name] == pytest.approx(expected, abs=1e-12)
    with pytest.raises(SessionError, match="plan each session by itself"):
        sheet_files(joined)


def test_session_shows_the_nominal_machine_and_the_deviations(raw_cycles):
    scene = draw_scene(raw_cycles)
    assert links(scene, drawing.MACHINE)
    assert not links(scene, drawing.SOLID)
    assert not [p for p in scene.nodes if p.startswith(readings.AFTER)]
    worst = max(measure_deviations(raw_cycles), key=lambda d: abs(d.before))
    assert f"{abs(worst.before) * 1e3:.3f} mm in setup {worst.setup}, " in scene.headline


def test_plan_shows_the_places_of_the_gauges(root):
    scene = draw_scene(load_plan(root / "tests/sessions/lines/plan.yaml"))
    assert scene.headline == "A plan: 270 readings in 135 postures, none measured yet."
    assert not [p for p in scene.nodes if p.startswith(readings.BEFORE)]
    assert {label.texts[0] for label in scene.labels if label.rank >= 0.0} == {
        *("yx", "zx", "xy", "zy", "xz", "yz")
    }


# ---- animation


def test_measurement_goes_from_zero_through_every_leg():
    scene = scene_of("raw-cycles")
    names = [s.name for s in scene.steps]
    legs = [["zero", f"{leg}_max", f"{leg}_min"] for leg in "xyz"]
    assert names == ["overview", *legs[0], *legs[1], *legs[2], "overview"]
    ends = [(s.start, s.end) for s in scene.steps]
    assert all(a < b for a, b in ends)
    assert all(a[1] < b[0] for a, b in pairwise(ends))


def test_animation_reaches_every_posture_at_the_stated_time(full, overview):
    scene = overview
    tracks = animation(scene)
    machine = full.robot.with_errors(full.errors)
    postures = {p.name: p for p in full.postures}
    for step in scene.steps[1:-1:7]:
        if step.name not in postures:
            continue
        posture = postures[step.name]
        passive = machine.close_with_pinocchio(posture.drives, np.array(posture.passive))
        real = placed(machine, posture.drives, passive)
        for link in ("x_slider", "y_rod_b", "platform"):
            track = tracks[f"{drawing.SOLID}/{link}"]
            times, values = track["position"]
            for time in (step.start, step.end):
                at = values[np.flatnonzero(np.isclose(times, time))[0]]
                assert at == pytest.approx(real[link][:3, 3], abs=KINEMATICS)
            if "quaternion" in track:
                times, values = track["quaternion"]
                x, y, z, w = values[np.flatnonzero(np.isclose(times, step.start))[0]]
                turn = pin.Quaternion(w, x, y, z).toRotationMatrix()
                assert turn == pytest.approx(real[link][:3, :3], abs=1e-11)


def test_arrows_follow_the_readings_of_every_posture():
    found, scene = calibrated("raw-cycles"), scene_of("raw-cycles")
    tracks, head = animation(scene), head_length(readings.arrow_width(dial(scene)))
    step = next(s for s in scene.steps if s.name == "y_min")
    for setup in ("xy", "zy", "yx"):
        rows = [r for r in found.residuals if r.setup == setup and r.posture == "y_min"]
        for node, kind in ((readings.BEFORE, "deviation"), (readings.AFTER, "residual")):
            mean = np.mean([getattr(r, kind) for r in rows]) if rows else 0.0
            track = tracks[f"{node}/{setup}/head"]
            k = np.flatnonzero(np.isclose(track["position"][0], step.start))[0]
            length = track["position"][1][k][2] + track["scale"][1][k][2] * head
            assert length == pytest.approx(mean * scene.arrow_scale, abs=1e-6)
            assert ("yx" == setup) == (not rows)
    assert "leg y: xy" in step.caption


def test_animation_and_legend_name_nodes_that_are_drawn(scene):
    for node in {*animation(scene), *(n for entry in scene.legend for n in entry.nodes)}:
        assert any(n == node or n.startswith(f"{node}/") for n in scene.nodes), node


def test_many_postures_are_thinned_out_for_the_animation(monkeypatch):
    monkeypatch.setattr("orthocal.output.scene.deviations.MAX_STOPS", 20)
    scene = draw_scene(session_of("sweep"))
    assert len(scene.steps) == 22
    assert any("shows 20 of 30 stops" in fact for fact in scene.facts)


def test_no_joint_leaps_between_two_frames(scene):
    """Links move in small steps: the loops stay on one branch."""
    times, values = animation(scene)[f"{drawing.SOLID}/platform"]["position"]
    assert np.abs(np.diff(values, axis=0)).max() < 0.03
    assert np.diff(times).max() < 2.0
    assert times[-1] * FRAME_RATE > 100


# ---- errors of the tool


def test_errors_of_the_tool_are_those_of_the_calibration(full):
    scene = draw_scene(full, show="tool")
    whole = assess_tool(full)  # aligned over the whole workspace
    middles = np.isin(np.round(whole.workspace.points, 9), [-0.06, 0.0, 0.06]).all(axis=1)
    corners = np.flatnonzero(middles)
    targets = whole.targets[corners]
    for node, deviation in (
        (tool_errors.TOOL_NOW, whole.align(whole.deviation)[corners]),
        (tool_errors.TOOL_ENTERED, whole.align(whole.deviation_with_entries)[corners]),
    ):
        for i in (0, 13, 26):
            pose = scene.pose(f"{node}/point {i + 1}")
            assert pose[:3, 3] == pytest.approx(targets[i], abs=KINEMATICS)
            size = np.linalg.norm(deviation[i])
            assert pose[:3, 2] == pytest.approx(deviation[i] / size, abs=1e-9)
            head = scene.pose(f"{node}/point {i + 1}/head")
            width = head_length(0.006 * np.ptp(scene.camera.points, axis=0).max())
            length = head[2, 3] + head[2, 2] * width
            assert length == pytest.approx(size * scene.tool_scale, rel=1e-3)
    told = [e.text for e in scene.legend if e.nodes[0].startswith("Tool error")]
    assert len(told) == 3
    assert all(text.endswith(f"(× {scene.tool_scale:g})") for text in told)
    assert scene.steps[0].caption == "Overview at the mechanical zero"  # no gauge is shown
    ball = scene.pose(f"{tool_errors.TOOL_UNCERTAINTY}/point 5")[:3, :3]
    assert ball @ ball.T == pytest.approx(
        scene.tool_scale**2 * whole.after.aligned_covariance[corners[4]], rel=1e-6, abs=1e-16
    )


def test_choice_of_what_is_shown_at_first(scene):
    assert hidden(scene) == {tool_errors.TOOL_NOW, tool_errors.TOOL_UNCERTAINTY}
    assert hidden(scene_of(EXPERIMENT_2, show="tool")) == {
        *(readings.GAUGES, readings.BEFORE, readings.AFTER)
    }
    assert hidden(scene_of(EXPERIMENT_2, show="all")) == set()


def test_a_name_like_an_identifier_is_kept():
    """Of 36 characters with four hyphens."""
    scene, path = Scene("hyphens"), f"Gauges/{'a-' * 4}{'b' * 20}"
    scene.add(path, Sphere(1.0), MeshBasicMaterial())
    assert (len(f"/{path}"), scene.nodes) == (36, (path,))


def test_pose_of_a_missing_node_is_an_error(scene):
    assert (scene.pose("/Leg lines/leg x") == scene.pose("Leg lines/leg x")).all()
    with pytest.raises(KeyError, match="Leg lines/leg w"):
        scene.pose("Leg lines/leg w")


# ---- any robot


def test_axes_are_in_view(root):
    """Here the origin is at one end of the machine."""
    scene = draw_scene(load_robot(root / "examples/fivebar"))
    names = [label.at[0] for label in scene.labels if label.node.startswith(machine_scene.AXES)]
    assert len(names) == 3
    points = np.array(scene.camera.points)
    assert (points.min(axis=0) - 1e-4 <= np.min(names, axis=0)).all()
    assert (points.max(axis=0) + 1e-4 >= np.max(names, axis=0)).all()


@pytest.mark.parametrize(
    ("subject", "options", "message"),
    [
        ("calibration", {"posture": "x_mx"}, "'x_mx' is not a posture; postures: x_max, x_min"),
        ("orthoglide", {"posture": "zero"}, "a robot has no postures"),
        ("experiment_2", {"exaggeration": 2.0}, "applies to a calibration only"),
        ("orthoglide", {"exaggeration": 2.0}, "applies to a calibration only"),
        ("calibration", {"exaggeration": 0.0}, "expected a positive number"),
        ("calibration", {"exaggeration": -1.0}, "expected a positive number"),
        ("calibration", {"exaggeration": np.nan}, "expected a positive number"),
        ("calibration", {"exaggeration": np.inf}, "expected a positive number"),
        ("calibration", {"show": "everything"}, "'everything' is none of readings, tool, all"),
    ],
)
def test_invalid_options_are_refused(request, subject, options, message):
    with pytest.raises(ParameterError, match=message):
        draw_scene(request.getfixturevalue(subject), **options)


def test_the_stated_largest_exaggeration_is_possible(calibration):
    with pytest.raises(ParameterError, match="expected at most") as refused:
        draw_scene(calibration, exaggeration=1e6)
    largest = float(str(refused.value).rpartition(" ")[2])
    assert draw_scene(calibration, posture="x_max", exaggeration=largest).exaggeration == largest
    with pytest.raises(ParameterError, match=f"expected at most {largest:.0f}$"):
        draw_scene(calibration, posture="x_max", exaggeration=largest + 1.0)


def test_arrows_at_one_contact_are_beside_each_other(scene):
    """Both gauges of a leg touch it at the same point."""
    for one, two in (("yx", "zx"), ("xy", "zy"), ("xz", "yz")):
        for node in (readings.BEFORE, readings.AFTER):
            feet = [scene.pose(f"{node}/{name}")[:3, 3] for name in (one, two)]
            assert np.linalg.norm(feet[0] - feet[1]) > 0.01


@pytest.mark.parametrize("posture", [None, "x_max"])
def test_arrows_do_not_reach_through_the_ground(calibration, posture):
    scene = draw_scene(calibration, posture=posture)
    ground = scene.pose(machine_scene.GROUND)[2, 3]
    for row in calibration.residuals:
        pose = scene.pose(f"{readings.BEFORE}/{row.setup}")
        shown = posture is None or row.posture == posture
        length = row.deviation * scene.arrow_scale if shown else 0.0
        assert (pose[:3, 3] + length * pose[:3, 2])[2] > ground


def test_headline_of_the_tool_states_error_and_uncertainty(calibration):
    scene = scene_of(EXPERIMENT_2, show="tool")
    found = assess_tool(calibration)
    largest = np.linalg.norm(found.align(found.deviation), axis=1).max() * 1e6
    assert scene.headline.startswith(f"Tool error now: up to {largest:.0f} µm over ±60 mm")
    known = found.after.sizes.aligned.largest
    assert f"With all identified errors corrected: up to {known * 1e6:.0f} µm RMS" in scene.headline
    (told,) = (e.text for e in scene.legend if e.nodes == (tool_errors.TOOL_UNCERTAINTY,))
    assert f"errors at {calibration.tolerance_scale.factor:.1f} × tolerances" in told


def test_only_machines_sessions_and_calibrations_are_drawn():
    with pytest.raises(TypeError, match="found a str; expected a Calibration"):
        draw_scene("out/experiment-2")


# ---- the page


def test_loaded_calibration_makes_the_same_page(calibration, scene, tmp_path):
    path = write_calibration(calibration, tmp_path / "calibration.json")
    assert draw_scene(load_calibration(path)).to_html() == scene.to_html()


def test_the_page_is_what_meshcats_own_interface_gives(scene):
    assert scene.visualizer.static_html() == scene.to_html()


def test_links_with_any_name_move(root, tmp_path):
    """Drawing and animation use the same node name for a link."""
    folder = tmp_path / "biglide"
    shutil.copytree(root / "tests/robots/biglide", folder)
    path = folder / "biglide.urdf"
    text = path.read_text()
    link = re.findall(r'<child link="([^"]+)"', text)[0]
    path.write_text(text.replace(f'"{link}"', '"constructor"'))
    scene = draw_scene(load_robot(folder))
    paths = [*animation(scene), *scene.nodes]
    assert any("/constructor (name)" in path for path in animation(scene))
    assert not [path for path in paths if "constructor" in path.split("/")]


def test_names_from_files_stay_in_the_data(raw_cycles):
    """Titles, setups and postures from files can neither end a script nor begin an element."""
    evil = "</script><img src=x onerror=alert(1)>"
    names = {r.setup for r in raw_cycles.readings}
    session = rename_setups(raw_cycles, {n: f"{n}/{evil}" for n in raw_cycles.setups})
    session = replace(session, title=evil, source=evil)
    scene = draw_scene(session)
    page = scene.to_html()
    assert page.lower().count("</script>") == draw_scene(raw_cycles).to_html().count("</script>")
    assert "<img" not in page
    gauges = {p.split("/")[1] for p in scene.nodes if p.startswith(readings.GAUGES)}
    assert len(gauges) == len(names)
    assert "<img" not in scene._repr_html_()


@pytest.mark.parametrize(
    ("value", "rounded"),
    [(0.3, 1.0), (1.19, 1.0), (13.0, 12.0), (99.0, 80.0), (250.0, 250.0), (np.inf, 1.0)],
)
def test_scales_are_round_and_never_too_large(value, rounded):
    assert round_scale(value) == rounded
