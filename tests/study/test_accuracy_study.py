"""Study of accuracy: against the covariance, and single machines against Pinocchio."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrated import plan_of
from gauges import exact, with_gauges
from machines import place
from tolerances import TRUTH_BACK

from orthocal import Choice, load_robot
from orthocal.errors import ParameterError, SessionError
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.workspace import cube, gauss_box
from orthocal.planning.first_plan import Displacements, build_paper_plan
from orthocal.session.session import Gauge
from orthocal.study.accuracy import build_accuracy_study, summarise_accuracy
from orthocal.study.random_machines import CALIBRATED, OUT_OF_RANGE
from orthocal.study.runner import StudyTable, run_study
from orthocal.study.study import run_task

NEAR = {"*.offset_mm": 0.4}
SIGMA = 5e-6


@pytest.fixture(scope="module")
def workshop():
    return plan_of("workshop")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "model"), [("workshop", "full"), ("raw-cycles", "offsets")])
def test_tool_error_agrees_with_the_covariance(name, model):
    """All errors are random, all or offsets are identified, gauges have mounting errors."""
    study = build_accuracy_study(plan_of(name), Choice(model, tolerances=NEAR), machines=110)
    result = summarise_accuracy(study, run_study(study))
    assert result.machines > 105
    assert abs(result.after - result.predicted.reported.rms) < 3.0 * result.standard_error
    assert result.standard_error < 0.05 * result.after
    for e in result.parameters:
        assert abs(e.rms - e.predicted) < 4.5 * e.standard_error + 0.02 * e.predicted


@pytest.mark.slow
def test_gauges_of_different_noise(workshop):
    """Unmodelled errors increase the weights of each gauge, whichever is the first."""
    noise = {"coarse": 10e-6, "fine": 0.5e-6}

    def study_of(*order, machines=3):
        gauges = {name: Gauge(noise[name]) for name in order}
        session = with_gauges(workshop, gauges, set(list(workshop.setups)[::2]))
        choice = Choice("offsets", tolerances=NEAR)
        return build_accuracy_study(session, choice, machines=machines, half_side=0.05)

    columns, predicted = [], []
    for order in (noise, reversed(noise)):
        study = study_of(*order)
        columns.append(run_study(study).columns)
        predicted.append(study.predicted.reported.rms)
    for name in ("tool_um", "error.x_slide.offset_mm"):
        assert columns[0][name] == pytest.approx(columns[1][name], rel=1e-6, abs=1e-6)
    assert predicted[0] == pytest.approx(predicted[1], rel=1e-6)
    study = study_of(*noise, machines=60)
    found = summarise_accuracy(study, run_study(study))
    assert abs(found.after - found.predicted.reported.rms) < 3.0 * found.standard_error


def test_standard_errors_of_the_papers_plan():
    """1.942 σ of a single reading, computed independently: twelve differences, weighted."""
    robot = load_robot("orthoglide")
    plan = build_paper_plan(robot, Displacements(), Gauge(SIGMA, None, None))
    choice = Choice("offsets", tolerances={"*.offset_mm": 0.1})
    study = build_accuracy_study(plan, choice, drawn=["*.offset"], machines=1000)
    prepared = study.prepare()  # without the tool errors of `run_study`
    measured = prepared.measure(range(1000))
    theta, converged = prepared.model.estimate(measured.values)
    assert converged.all()
    errors = theta - prepared.model.identified_part(measured.errors, prepared.error_names)
    spread = np.sqrt((errors**2).mean(axis=0)) / SIGMA
    standard_error = 1.942 / np.sqrt(2.0 * 1000)
    assert np.abs(spread - 1.942).max() < 3.0 * standard_error + 0.0005


def test_estimates_without_noise_equal_the_truth(orthoglide):
    plan = build_paper_plan(orthoglide, Displacements(), Gauge(1e-12, None, None))
    choice = Choice("offsets", tolerances={"*.offset_mm": 4.0})
    table = run_study(build_accuracy_study(plan, choice, drawn=["*.offset"], machines=60))
    for axis in "xyz":
        missed = np.array(table.columns[f"error.{axis}_slide.offset_mm"])
        assert np.abs(missed).max() * 1e-3 < TRUTH_BACK
        assert np.std(table.columns[f"true.{axis}_slide.offset_mm"]) > 1.0
    assert max(table.columns["tool_um"]) < 1e-3


def test_tool_error_of_one_machine_agrees_with_pinocchio(workshop):
    """Tool errors with true and estimated errors, loops closed by Pinocchio."""
    choice = Choice("full", tolerances=NEAR)
    study = build_accuracy_study(workshop, choice, machines=4, half_side=0.05)
    rows = run_task(study, 0)
    robot, prepared = workshop.robot, study.prepare()
    space = gauss_box(robot, [[-0.05, 0.05]] * 3)
    drives = LoopClosure(robot).inverse(space.points)
    drawn, _ = prepared.draw(2)
    truth = dict(zip(study.drawn, drawn * prepared.truth.theta_scale, strict=False))
    found = {}
    for p in prepared.model.problem.machine_selection.parameters:
        true, error = (rows[f"{kind}.{p.name}_{p.edge_unit}"][2] for kind in ("true", "error"))
        found[p.name] = (true + error) / p.edge_factor
    real, known, nominal = (
        np.array([place(robot.with_errors(e), d, "tcp") for d in drives])
        for e in (truth, found, {})
    )
    for column, field in (("tool_um", real - known), ("before_um", real - nominal)):
        aligned = space.remove_motion(field, nominal)
        rms = np.sqrt(space.weights @ (aligned**2).sum(axis=1))
        assert rows[column][2] == pytest.approx(rms * 1e6, rel=1e-6)


def test_gauss_points_agree_with_a_fine_grid(orthoglide):
    few, many = gauss_box(orthoglide, [[-0.06, 0.06]] * 3), cube(orthoglide, points_per_side=21)

    def square(space):
        x, y, z = space.points.T
        return space.weights @ (x * y + 0.3 * z**2 - 1e-3) ** 2

    assert square(few) == pytest.approx(square(many), rel=1e-3)


def test_fixed_errors(workshop):
    study = build_accuracy_study(
        exact(workshop), Choice("offsets"), fixed={"x_slide.offset": 1e-3}, machines=3
    )
    rows = run_task(study, 0)
    assert rows["true.x_slide.offset_mm"] == [1.0] * 3
    assert rows["true.y_slide.offset_mm"] == [0.0] * 3
    assert np.abs(rows["error.x_slide.offset_mm"]).max() < 0.05
    assert len(set(rows["error.x_slide.offset_mm"])) == 3
    assert len(set(rows["before_um"])) == 1


def test_readings_out_of_range_are_counted(workshop):
    narrow = replace(workshop, gauges={"": Gauge(SIGMA, 1e-5, (-0.5e-3, 0.5e-3))})
    study = build_accuracy_study(narrow, "offsets", drawn=["*.offset"], machines=100)
    table = run_study(study)
    status = table.columns["status"]
    found = summarise_accuracy(study, table)
    assert found.failed[OUT_OF_RANGE] == status.count(OUT_OF_RANGE) > 50
    assert found.machines == status.count(CALIBRATED)
    bad = status.index(OUT_OF_RANGE)
    assert table.columns["tool_um"][bad] is None


def test_report_without_a_calibrated_machine(workshop):
    from orthocal.output.text.study import report_study

    study = build_accuracy_study(workshop, "offsets", machines=2)
    rows = run_task(study, 0)
    for name in rows:
        rows[name] = [OUT_OF_RANGE] * 2 if name == "status" else [None] * 2
    table = StudyTable(study, rows)
    report = report_study(table)
    assert report.document["machines"] == 0
    assert not report.tables
    assert report.draw().startswith("<?xml")


def test_an_unknown_fixed_error_is_refused(workshop):
    with pytest.raises(ParameterError, match="not an error parameter"):
        build_accuracy_study(workshop, fixed={"x_slide.offset_mm": 1.0})


def test_missing_noise(workshop):
    silent = replace(workshop, gauges={"": Gauge(None, 1e-5, None)})
    with pytest.raises(SessionError, match=r"gauge.sigma_mm: is missing"):
        build_accuracy_study(silent)
