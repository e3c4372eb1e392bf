"""Traces: bins against pointwise readings, reversals, noise, mistakes in files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from commands import orthocal

from orthocal import draw_errors, load_session, write_session
from orthocal.errors import SessionError
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.variable_projection import VariableProjection
from orthocal.kinematics.loop_closure import LoopClosure, nominal_closure
from orthocal.measurement.files.session_file import load_plan
from orthocal.measurement.importing.traces import (
    Trace,
    bin_trace,
    bin_traces,
    read_trace,
    with_traces,
)
from orthocal.session.session import Conditions, Posture, Reading

RADIUS, SIGMA = 50e-3, 2e-6
CENTRE, SHIFT, LENGTH = np.array([0.0, 0.0, 0.0]), np.array([0.8e-3, -0.5e-3, 0.3e-3]), 0.4e-3
PLANES = {"xy": (0, 1), "yz": (1, 2), "zx": (2, 0)}
PLAN = """robot: orthoglide
controller: {offsets_mm: [0, 0, 0]}
gauge: {sigma_mm: 0.002, resolution_mm: 0.001, range_mm: [-5, 5]}
postures: {right: {tcp_mm: [50, 0, 0]}, up: {tcp_mm: [0, 0, 50]}}
setups:
"""
SETUP = (
    "  {}: {{sensor: ball_bar, ball: post, centre_mm: [0, 0, 0], length_mm: 50, "
    "length_tolerance_mm: unknown}}\n"
)


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    folder = tmp_path_factory.mktemp("traces")
    (folder / "plan.yaml").write_text(PLAN + "".join(map(SETUP.format, PLANES)))
    return load_plan(folder / "plan.yaml")


def circle(plane, count, *, turns=1.0):
    """Commanded positions on a circle, there and back again."""
    angle = 2.0 * np.pi * turns * (1.0 - np.abs(np.linspace(-1.0, 1.0, count)))
    points = np.zeros((count, 3))
    points[:, PLANES[plane][0]] = RADIUS * np.cos(angle)
    points[:, PLANES[plane][1]] = RADIUS * np.sin(angle)
    return points


@pytest.fixture(scope="module")
def machine(plan):
    """Free errors, their true values, and the function that reads a trace of the machine."""
    names = plan.robot.parameters.select_model("full")
    errors = draw_errors(plan.robot, names, seed=4, tolerances={"*.offset_mm": 1.0})
    closure = LoopClosure(plan.robot, free=list(errors))
    truth = np.array(list(errors.values()))

    def read(points, seed):
        drives = nominal_closure(plan.robot).inverse(points)
        balls = closure.forward(drives, theta=truth)
        noise = SIGMA * np.random.default_rng(seed).normal(size=len(points))
        return np.linalg.norm(balls - CENTRE - SHIFT, axis=1) - RADIUS - LENGTH + noise

    return errors, read


@pytest.fixture(scope="module")
def there_and_back(machine):
    """Trace of a circle with 3,000 samples."""
    points = circle("xy", 3000)
    return Trace(points, machine[1](points, 0))


def write_trace(trace, folder):
    """The trace as a file."""
    rows = np.column_stack([trace.points, trace.values]) * 1e3
    head = "x_mm,y_mm,z_mm,reading_mm"
    np.savetxt(folder / "xy.csv", rows, delimiter=",", header=head, comments="", fmt="%.7f")
    return folder / "xy.csv"


def solve(session, sigma):
    problem = build_problem(session, model="full", prior_stds={"*.offset": 0.5e-3})
    values = problem.observations.values(session.values)
    found = VariableProjection(problem).solve(sigma=sigma, values=values)
    _, jacobian = problem.predict_and_jacobian(found.theta)
    information = jacobian.T @ jacobian / sigma**2 + np.diag(problem.prior_precision)
    n = problem.n_machine
    scale = problem.theta_scale[:n]
    std = np.sqrt(np.diag(np.linalg.inv(information))[:n]) * scale
    return problem.free[:n], found.theta[:n], std


@pytest.mark.slow
def test_bins_give_the_answer_of_all_points(plan, machine):
    """2,250 points of three half circles, each a reading, and averaged in bins."""
    _, read = machine
    traces, postures, readings = {}, {}, []
    closure = nominal_closure(plan.robot)
    for i, plane in enumerate(PLANES):
        points = circle(plane, 750, turns=0.5)
        values = read(points, i)
        traces[plane] = Trace(points, values)
        for k, (p, d, v) in enumerate(zip(points, closure.inverse(points), values, strict=True)):
            postures[f"{plane}{k}"] = Posture(f"{plane}{k}", "tcp", p, d)
            readings.append(Reading(plane, f"{plane}{k}", value=float(v)))
    binned = with_traces(plan, bin_traces(plan, traces))
    assert len(binned.readings) < 700
    pointwise = replace(plan, postures=postures, readings=tuple(readings))
    names, all_points, std = solve(pointwise, SIGMA)
    again, in_bins, std_of_bins = solve(binned, binned.gauge.sigma)
    assert names == again
    assert np.abs((in_bins - all_points) / std).max() < 0.1
    assert std_of_bins == pytest.approx(std, rel=0.15)


def test_a_reversal_ends_a_bin_and_changes_the_approach(plan, machine):
    _, read = machine
    points = circle("xy", 4000, turns=0.3)
    session = with_traces(plan, bin_traces(plan, {"xy": Trace(points, read(points, 0))}))
    approaches = [r.approach for r in session.readings]
    first, second = (approaches[: len(approaches) // 2], approaches[len(approaches) // 2 :])
    assert {a[0] for a in first} <= {"n", "u"}  # x falls from the right side up
    assert {a[0] for a in second} <= {"p", "u"}
    assert approaches[0][:2] == approaches[-1][:2].translate(str.maketrans("pn", "np"))
    angle = [np.arctan2(p.values[1], p.values[0]) for p in session.postures.values()]
    largest = int(np.argmax(angle))
    assert 0.45 * len(angle) < largest < 0.55 * len(angle)


def test_noise_of_bins_is_that_of_their_means(plan, machine):
    _, read = machine
    points = circle("yz", 6_000)
    trace = Trace(points, read(points, 7))
    binned = bin_trace(trace)
    count = len(points) / len(binned.values)
    assert binned.std == pytest.approx(SIGMA / np.sqrt(count), rel=0.15)
    exact = Trace(points, trace.values - SIGMA * np.random.default_rng(7).normal(size=len(points)))
    order = [int(np.abs(points - p).sum(axis=1).argmin()) for p in binned.points[:20]]
    missed = binned.values[:20] - exact.values[order]
    assert np.abs(missed).max() < 4.0 * binned.std


def test_a_trace_comes_from_a_file_and_goes_into_a_session(plan, there_and_back, tmp_path):
    points, values = there_and_back.points, there_and_back.values
    rows = np.column_stack([np.arange(3000) / 1e3, points * 1e3, values * 1e3])
    head = "time_s,x_mm,y_mm,z_mm,reading_mm"
    np.savetxt(tmp_path / "xy.csv", rows, delimiter=",", header=head, comments="", fmt="%.7f")
    trace = read_trace(tmp_path / "xy.csv", plan.robot)
    np.testing.assert_allclose(trace.points, points, atol=1e-10)
    session = with_traces(plan, bin_traces(plan, {"xy": trace}))
    write_session(session, tmp_path / "session")
    again = load_session(tmp_path / "session")
    np.testing.assert_allclose(again.values, session.values, atol=1e-9)
    assert all(isinstance(r.conditions, Conditions) for r in again.readings)


def test_bins_with_few_samples_are_counted(plan, there_and_back, tmp_path):
    """Two stretches of the path have one sample in ten, as after a lost connection."""
    sample = np.arange(3000)
    lost = ((sample > 500) & (sample < 600)) | ((sample > 2000) & (sample < 2050))
    kept = ~lost | (sample % 10 == 0)
    trace = Trace(there_and_back.points[kept], there_and_back.values[kept])
    binned = bin_trace(trace)
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(trace.points, axis=0), axis=1)))
    half = along[-1] / 2
    edges = np.append(np.linspace(0.0, half, 80)[:-1], np.linspace(half, 2.0 * half, 80))
    counts = np.histogram(along, edges)[0]
    assert binned.unused_bins == (counts < 8).sum() == 6
    assert binned.unused_samples == counts[counts < 8].sum()
    assert len(binned.values) + binned.unused_bins == len(counts)
    file = write_trace(trace, tmp_path)
    done = orthocal("trace", plan.path, f"xy={file}", "--out", tmp_path / "s")
    sentence = (
        f"{binned.unused_bins} of {len(counts)} bins ({binned.unused_samples} samples) were not "
        "used: a bin needs 8 samples at different positions"
    )
    assert sentence in done.stderr
    assert f"{len(trace.values)} samples" in done.stderr
    assert {r.setup for r in load_session(tmp_path / "s").readings} == {"xy"}
    words = ("trace", plan.path, f"xy={file}", "--out", tmp_path / "s")
    assert orthocal(*words).returncode == 2  # it would overwrite
    assert orthocal(*words[:2], "xy.csv", *words[3:]).returncode == 2


@pytest.mark.parametrize(
    ("text", "problem", "line"),
    [
        ("x_mm,y_mm,reading_mm\n1,2,3\n", "'z_mm' is missing", ":1"),
        ("x_mm,y_mm,z_mm,reading_mm\n1,2,3\n", "has 3 fields; expected 4", ":2"),
        ("x_mm,y_mm,z_mm,reading_mm\n1,2,3,a\n", "reading_mm", ":2"),
        ("x_mm,y_mm,z_mm,reading_mm\n1,2,3,4\n", "has 1 samples", "t.csv"),
    ],
)
def test_a_wrong_trace_is_refused(plan, tmp_path, text, problem, line):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(SessionError, match=problem) as caught:
        read_trace(tmp_path / "t.csv", plan.robot)
    assert str(caught.value.where).endswith(line)


def test_a_trace_at_rest_is_refused(plan):
    with pytest.raises(SessionError, match="does not move"):
        with_traces(plan, bin_traces(plan, {"xy": Trace(np.zeros((100, 3)), np.zeros(100))}))
    with pytest.raises(SessionError, match="is not a setup"):
        with_traces(plan, bin_traces(plan, {"ab": Trace(circle("xy", 100), np.zeros(100))}))


@pytest.mark.parametrize("samples", [500, 1000])
def test_a_trace_with_few_samples_is_refused(plan, samples):
    """Most of its bins have fewer samples than a line and its noise need."""
    trace = Trace(circle("xy", samples), np.zeros(samples))
    with pytest.raises(SessionError, match=f"has {samples} samples on a path of") as caught:
        with_traces(plan, bin_traces(plan, {"xy": trace}))
    assert "expected at least 8" in str(caught.value)
