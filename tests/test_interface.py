"""The Python interface: what is of another kind or shape is refused in words, not from inside."""

from __future__ import annotations

import pickle
import re
from copy import deepcopy
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from calibrated import EXPERIMENT_2, calibrated, identified

from orthocal import (
    CalibrationProblem,
    Choice,
    Effect,
    ElementaryError,
    Frames,
    Gauge,
    LiveScene,
    Machine,
    NonlinearProgram,
    NuisanceParameter,
    SolverOptions,
    UseConditions,
    assess,
    assess_tool,
    build_accuracy_study,
    build_linearisation_study,
    calibrate,
    compare_models,
    draw_scene,
    load_calibration,
    load_plan,
    load_robot,
    load_session,
    parameter_table,
    plan_readings,
    reading_table,
    recommend_model,
    register_effect,
    register_sensor,
    restore_session,
    simulate_session,
    summarize,
    validate_calibration,
    write_report,
    write_session,
)
from orthocal.assessment.tool_error import Workspace
from orthocal.calibration.file import write_calibration
from orthocal.errors import OrthocalError, ParameterError
from orthocal.estimation.problem import build_problem
from orthocal.kinematics.loop_closure import LoopClosure


@pytest.fixture(scope="module")
def calibration():
    return calibrated(EXPERIMENT_2)


@pytest.mark.parametrize("load", [load_session, load_plan, load_calibration, load_robot])
@pytest.mark.parametrize("value", [5, None, 1.5, [], "", "a\0b", "x" * 300, "/dev/null", "\udcff"])
def test_what_is_no_path_or_none_of_ours(load, value):
    with pytest.raises((OrthocalError, TypeError)):
        load(value)


ARGUMENTS = [
    ({"model": 5}, "found a int; expected the name of a model"),
    ({"free": 5}, "free: found 5; expected a list of names or globs"),
    ({"free": [5]}, "free: found [5]; expected a list of names or globs"),
    ({"free": "x_slide.offset"}, "expected a list of names or globs"),
    ({"known": 5}, "known: found a int; expected a mapping of names to numbers"),
    ({"known": {"x_slide.offset": "a"}}, "expected a name and a number or 2 numbers"),
    ({"known": {"x_slide.offset": (1, 2, 3)}}, "expected a name and a number or 2 numbers"),
    ({"tolerances": 5}, "tolerances: found a int; expected a mapping"),
    ({"tolerances": {"x_slide.offset": "a"}}, "expected a name and a number"),
    ({"bounds": {"x_slide.offset": 5}}, "expected a name and 2 numbers"),
    ({"bounds": {"x_slide.offset": (1, 2, 3)}}, "expected a name and 2 numbers"),
    ({"bounds": {"x_slide.offset": ("a", "b")}}, "expected a name and 2 numbers"),
    ({"prior": "x"}, "prior: found a str; expected True, False or None"),
    ({"base": "x"}, "base: found a str; expected True or False"),
]
"""Of a choice."""

OTHER_ARGUMENTS = [
    ({"choice": 5}, "found a int; expected a Choice, or the name of a model"),
    ({"profile": 5}, "profile: found 5; expected a list of names or globs"),
    ({"solver": 5}, "found a int; expected a solver's name, or SolverOptions(...)"),
    ({"solver": {}}, "found a dict; expected a solver's name, or SolverOptions(...)"),
    ({"loss": 5}, "found a int; expected a loss's name, or Loss(...)"),
    ({"start": [1]}, "found the shape (1,); expected 3 start values per row"),
    ({"start": "a"}, "found str; expected 3 start values per row"),
    ({"start": [0.0, 0.0, np.nan]}, "expected 3 finite numbers to start from"),
]
"""Of `calibrate`."""


@pytest.mark.parametrize(
    ("arguments", "message"), [*ARGUMENTS, *OTHER_ARGUMENTS], ids=lambda v: str(v)[:40]
)
def test_wrong_arguments(arguments, message, experiment_2):
    is_of_choice = (arguments, message) in ARGUMENTS
    act = Choice if is_of_choice else partial(calibrate, experiment_2)
    with pytest.raises((TypeError, ValueError), match=re.escape(message)):
        act(**arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        {"known": {"x_slide.offset": 2}},
        {"known": {"x_slide.offset": (2, 0.1)}},
        {"tolerances": {"*.offset": 2}},
        {"bounds": {"x_slide.offset": (-2, 2)}},
    ],
)
def test_millimetres_cannot_pass_for_metres(arguments, experiment_2):
    """2 where 2 mm is meant: a number without its unit is refused, and its key is named."""
    (kind,) = arguments
    with pytest.raises(ParameterError, match=rf"{kind}: '.*offset' carries no unit; expected one"):
        calibrate(experiment_2, Choice(**arguments))
    angles = {"known": {"x_slide.offset_mrad": 2.0}}
    with pytest.raises(ParameterError, match=r"has the wrong unit; x_slide\.offset is in mm"):
        calibrate(experiment_2, Choice(**angles))


def test_a_choice_in_any_unit_is_the_same_choice(experiment_2):
    found = [
        identified(experiment_2, Choice(known={f"y_slide.offset_{u}": v})).total_covariance
        for u, v in (("mm", (0.5, 0.1)), ("um", (500.0, 100.0)), ("m", (0.5e-3, 0.1e-3)))
    ]
    for other in found[1:]:
        assert other == pytest.approx(found[0], rel=1e-9)


def test_a_list_is_a_value_and_its_tolerance(orthoglide):
    """JSON and YAML have no tuples."""
    choices = [Choice(known={"y_slide.offset_mm": v}) for v in ((0.5, 0.1), [0.5, 0.1])]
    found = [c.select(orthoglide.parameters) for c in choices]
    assert np.array_equal(found[0].mean, found[1].mean)
    assert np.array_equal(found[0].prior_stds, found[1].prior_stds)
    with pytest.raises(ParameterError, match="state y_slide"):
        replace(choices[1], base=True).select(orthoglide.parameters)


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("known", (0.5, 500.0)),
        ("tolerances", (1.0, 1000.0)),
        ("bounds", ((-1.0, 1.0), (-5.0, 5.0))),
    ],
)
def test_one_name_in_two_units_is_refused(orthoglide, kind, values):
    stated = dict(zip(("x_slide.offset_mm", "x_slide.offset_um"), values, strict=True))
    with pytest.raises(ParameterError, match=f"{kind}: 'x_slide.offset' is stated twice"):
        Choice(**{kind: stated}).select(orthoglide.parameters)


OPTIONS = {
    "hessian": ["x"],
    "tolerance": [0, "a", 10**400, True],
    "closure_tolerance": [float("nan")],
    "max_iterations": ["a", -1, True, 2_000_000],
    "print_level": [1.5, 13],
    "loss": ["huber"],
}


@pytest.mark.parametrize("name", OPTIONS)
def test_options_of_the_solver(name):
    for value in OPTIONS[name]:
        with pytest.raises((TypeError, ValueError), match="expected"):
            SolverOptions(**{name: value})


def test_options_are_copied_and_numbers_of_any_type():
    ipopt = {"mu_strategy": "adaptive"}
    options = SolverOptions(max_iterations=np.int64(7), tolerance=np.float32(0.5), ipopt=ipopt)
    ipopt["mu_strategy"] = "monotone"
    assert options.ipopt == {"mu_strategy": "adaptive"}


def test_arrays_are_read_only(calibration, experiment_2, orthoglide):
    problem = build_problem(experiment_2)
    for array in (
        *(orthoglide.drive_index, orthoglide.passive_index, orthoglide.drive_gain),
        *(problem.active_theta, problem.theta_scale, problem.prior_precision),
        *(problem.zero_incidence, calibration.identifiability.singular_values),
    ):
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 1.0


SHAPES = [5, None, [1, 2], [[1, 2]], np.zeros((2, 2, 3)), [], "abc", {}, [1j, 0, 0], [["a"] * 3]]


@pytest.mark.parametrize("value", SHAPES, ids=lambda v: str(v)[:20])
def test_coordinates_of_other_shapes(value, calibration, orthoglide):
    closure = LoopClosure(orthoglide)
    for act in (
        calibration.machine.forward,
        calibration.machine.inverse,
        closure.close,
        closure.forward,
        closure.inverse,
        lambda v: closure.tcp(v, v),
    ):
        with pytest.raises(ValueError, match=r"expected 3 .* per row"):
            act(value)


def test_names_theta_and_start_of_other_lengths(calibration, orthoglide):
    zero = orthoglide.drive_zero
    with pytest.raises(ValueError, match="found 1 names for 2 rows"):
        calibration.machine.forward([zero, zero], names=["a"])
    with pytest.raises(ValueError, match="expected 1 values of the free parameters per row"):
        LoopClosure(orthoglide, free=["x_slide.offset"]).close(zero, theta=[1.0, 2.0])
    with pytest.raises(ValueError, match="expected 18 start values per row"):
        LoopClosure(orthoglide).close(zero, start=[1.0, 2.0])
    with pytest.raises(ValueError, match="expected 18 passive coordinates per row"):
        LoopClosure(orthoglide).tcp(zero, [1.0])
    with pytest.raises(TypeError, match="expected a Robot"):
        LoopClosure(5)


@pytest.mark.parametrize(
    ("build", "arguments"),
    [
        (build_accuracy_study, {"machines": -1}),
        (build_linearisation_study, {"count": 0}),
        (build_linearisation_study, {"directions": 1.5}),
        (build_linearisation_study, {"sizes": [np.nan]}),
        (build_linearisation_study, {"largest": 0.0}),
    ],
)
def test_numbers_of_studies(build, arguments, experiment_2):
    with pytest.raises(ParameterError, match=r"expected a (whole number of at least 1|positive)"):
        build(experiment_2, **arguments)


def test_a_loaded_robot_which_others_share_is_read_only(orthoglide):
    assert load_robot("orthoglide") is load_robot("orthoglide")
    with pytest.raises(TypeError, match="does not support item assignment"):
        orthoglide.legs["x"] = orthoglide.legs["y"]
    with pytest.raises(TypeError, match="does not support item assignment"):
        orthoglide.legs["x"].rods["a"] = orthoglide.legs["x"].rods["b"]


@pytest.mark.parametrize("copied", [lambda x: pickle.loads(pickle.dumps(x)), deepcopy])
def test_sessions_and_calibrations_can_be_pickled(copied, calibration, experiment_2, orthoglide):
    errors = {"x_slide.offset": 1e-3}
    values = [
        simulate_session(s, errors, exact=True).session.values
        for s in (experiment_2, copied(experiment_2))
    ]
    np.testing.assert_array_equal(*values)
    other = copied(calibration)
    assert [(p.name, p.value) for p in other] == [*calibration.errors.items()]
    assert "x_slide.offset" in other
    assert "x_slide" not in other
    decisions = [c.assessment.decision.to_document() for c in (other, calibration)]
    assert decisions[0] == decisions[1]
    robot = copied(orthoglide.with_tolerances({"*.offset_mm": 1.0}))
    assert robot.parameters.redundant == orthoglide.parameters.redundant
    posture = orthoglide.reference_passive
    for got, expected in zip(
        robot.evaluate_constraints(robot.drive_zero + 1e-3, posture),
        orthoglide.evaluate_constraints(orthoglide.drive_zero + 1e-3, posture),
        strict=True,
    ):
        np.testing.assert_array_equal(got, expected)
    with pytest.raises(TypeError):
        robot.content["orthoglide.yaml"] = b""


def test_a_machine_keeps_its_errors(orthoglide):
    errors = {"x_slide.offset": 1e-3}
    machine = Machine(orthoglide, errors)
    before = machine.forward(orthoglide.drive_zero)
    errors["x_slide.offset"] = 2e-3
    assert np.array_equal(machine.forward(orthoglide.drive_zero), before)


def test_no_points_and_points_far_beyond_all_numbers(calibration):
    assert calibration.machine.forward(np.zeros((0, 3))).shape == (0, 3)
    assert calibration.machine.inverse(np.zeros((0, 3))).shape == (0, 3)
    with pytest.raises(OrthocalError, match="cannot be reached"):
        calibration.machine.inverse([1e308, 0.0, 0.0])


class Misspelt(Effect):
    name = "misspelt"
    conditions = ("temprature",)


def test_positions_in_a_plane_have_drive_coordinates(biglide):
    machine = Machine(biglide, {})
    drives = biglide.drive_zero + np.array([0.01, -0.02])
    assert machine.inverse(machine.forward(drives)) == pytest.approx(drives, abs=1e-12)
    assert machine.inverse([machine.forward(drives)])[0] == pytest.approx(drives, abs=1e-12)


def test_other_things_than_calibrations_and_sessions(calibration, experiment_2, tmp_path):
    for act, message in (
        (lambda: calibrate(5), "expected a Session, the path to one, or a list of them"),
        (lambda: calibrate([5]), "expected a Session, or the path to one"),
        (lambda: write_report(5, tmp_path / "x.html"), "expected a Calibration"),
        (
            lambda: summarize(5),
            "expected a Calibration, a Comparison, a Validation, a MeasuringPlan or a StudyTable",
        ),
        (lambda: assess(5), "expected a Calibration"),
        (lambda: validate_calibration(5, experiment_2), "expected a Calibration"),
        (lambda: validate_calibration(calibration, 5), "expected a Session"),
        (lambda: compare_models(5), "expected a Session"),
        (lambda: compare_models(experiment_2, models=5), "models: found 5"),
        (lambda: compare_models(experiment_2, models="full"), "expected a list of names"),
        (lambda: assess_tool(5), "expected a Calibration"),
        (lambda: parameter_table(5), "expected a Calibration"),
        (lambda: reading_table(experiment_2), "expected a Calibration"),
        (lambda: CalibrationProblem(experiment_2, "full"), "expected a Selection"),
        (lambda: simulate_session(5, {}), "expected a Session"),
        (lambda: recommend_model("raw-cycles"), "expected a Session"),
        (lambda: assess_tool(calibration, np.zeros((5, 3))), "expected a Workspace"),
        (lambda: assess_tool(calibration, conditions="ppp"), "expected UseConditions"),
        (lambda: NonlinearProgram(experiment_2), "expected a CalibrationProblem"),
        (lambda: plan_readings("orthoglide"), "expected a Robot"),
        (lambda: plan_readings(experiment_2.robot, measured="x"), "expected a Session"),
        (lambda: plan_readings(experiment_2.robot, equipment="x"), "expected Equipment"),
        (lambda: Machine("orthoglide", {}), "expected a Robot"),
        (lambda: Machine(experiment_2.robot, [1]), "errors: found a list"),
        (lambda: build_linearisation_study("x"), "expected a Robot or a Session"),
        (lambda: build_linearisation_study(experiment_2, free="*.offset"), "expected a list"),
        (lambda: simulate_session(experiment_2, 5), "errors: found a int; expected a mapping"),
        (lambda: simulate_session(experiment_2, {"x_slide.offset": "a"}), "expected a name and"),
        (lambda: draw_scene("nonsense"), "expected a Calibration, a Session or a Robot"),
        (lambda: LiveScene(5), "expected a Scene"),
        (lambda: experiment_2.robot.with_errors(5), "errors: found a int; expected a mapping"),
        (lambda: calibration.machine.inverse(np.zeros(3), conditions="ppp"), "UseConditions"),
        (lambda: restore_session(experiment_2), "expected a Calibration"),
        (lambda: Frames("tcp"), "Frames.in_posture: found 'tcp'"),
        (lambda: register_effect(Misspelt), "found 'temprature'; expected one of approach, t"),
        (lambda: write_session(calibration, tmp_path / "s"), "expected a Session"),
        (lambda: register_sensor("wire"), "expected a class"),
        (lambda: register_sensor(Gauge), "is not a sensor"),
        (lambda: register_effect(Gauge), "is not an Effect"),
    ):
        with pytest.raises(TypeError, match=re.escape(message)):
            act()
    for act, message in (
        (lambda: Workspace.even(np.zeros((0, 3))), "found the shape (0, 3); expected points"),
        (lambda: LiveScene(draw_scene(experiment_2), port=10**6), "expected 0 to 65535"),
        (lambda: Gauge(range=(5e-3, -5e-3)), "expected the lowest and the highest reading"),
        (lambda: NuisanceParameter("tilt", "rad", -1.0), "tilt: prior_std: found -1.0"),
        (lambda: NuisanceParameter("tilt", "mm", 1.0), "tilt: unit: found 'mm'"),
        (lambda: ElementaryError("x.play", "play", "x", "m", np.nan), "x.play: prior_std"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            act()
    with pytest.raises(OrthocalError, match="expected 3 letters"):
        calibration.machine.inverse(np.zeros(3), conditions=UseConditions(5))
    problem = build_problem(experiment_2, model="offsets")
    with pytest.raises(ValueError, match="expected 22 free parameters, or the 3 of"):
        problem.predict(np.zeros(4))
    with pytest.raises(OrthocalError, match="file names cannot have"):
        write_calibration(calibration, tmp_path / "a\0b")
