"""Solvers side by side: each checks the others."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from calibrated import identified, session_of
from gauges import exact

from orthocal import load_calibration, load_session
from orthocal.calibration.file import calibration_json
from orthocal.errors import ClosureError, OrthocalError, SolverError
from orthocal.estimation.fit import build_program
from orthocal.estimation.linear import (
    SIX_ROWS,
    invert_equation_8,
    leg_parallelism_matrix,
    linearise_problem,
)
from orthocal.estimation.loss import Loss
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.estimation.solvers.linearised import LinearisedProgram
from orthocal.estimation.solvers.variable_projection import VariableProjection, _Acceleration

AGREED = 1e-6
"""Largest difference of two solvers' parameters, [prior std]."""

CHOICES = {
    "plain": {},
    "bounds": {"bounds": {"x_slide.offset": (-0.1e-3, 0.1e-3), "y_slide.offset": (0.6e-3, np.inf)}},
    "known": {"known": {"x_slide.offset": 0.3e-3, "y_slide.offset": (0.1e-3, 0.05e-3)}},
}


@cache
def problem_of(example, model, choice):
    """Problem of an example; tests do not change it."""
    return build_problem(session_of(example), model=model, **CHOICES[choice])


def solve_by_both(problem, *, loss, sigma, **options):
    """Solutions by variable projection and by Ipopt."""
    kinds = ("variable-projection", "ipopt")
    chosen = (SolverOptions(solver=kind, loss=Loss(loss)) for kind in kinds)
    return [build_program(problem, o).solve(sigma=sigma, **options) for o in chosen]


COMPARED = [
    ("squares", "table1/experiment-1-printed", "full", "known"),
    ("squares", "raw-cycles", "offsets", "bounds"),
    ("squares", "sweep", "lengths", "bounds"),
    ("huber", "table1/experiment-1-printed", "full", "plain"),
]
"""Each loss, example, model and choice, with large outliers in the first example."""


@pytest.mark.parametrize(("loss", "example", "model", "choice"), COMPARED)
def test_two_solvers_find_one_optimum(loss, example, model, choice):
    problem = problem_of(example, model, choice)
    ours, ipopts = solve_by_both(problem, loss=loss, sigma=20e-6)
    difference = np.abs(ours.theta - ipopts.theta) / problem.theta_scale
    assert difference.max() < AGREED
    assert np.abs(ours.zeros - ipopts.zeros).max() < 1e-9
    assert np.abs(ours.passive - ipopts.passive).max() < 1e-8
    assert ours.objective == pytest.approx(ipopts.objective, rel=1e-6)
    assert (ours.at_bound == ipopts.at_bound).all()
    if choice == "bounds":
        assert ours.at_bound.any()
    # on the straight part of Huber's loss steps by Gauss and Newton do not converge
    assert ipopts.hessian == ("exact" if loss == "huber" else "gauss-newton")


@pytest.mark.parametrize(
    ("example", "model", "choice"),
    [
        ("table1/experiment-2", "full", "plain"),
        ("raw-cycles", "lengths", "bounds"),
        ("raw-cycles", "full", "known"),
    ],
)
def test_the_linearised_solver_is_least_squares_about_the_active_offsets(example, model, choice):
    """As SciPy's bounded least squares on stacked rows has it."""
    problem = problem_of(example, model, choice)
    found = LinearisedProgram(problem).solve(sigma=20e-6)
    expected = linearise_problem(problem).solve(sigma=20e-6)
    assert np.abs(found.theta - expected).max() < 1e-9 * problem.theta_scale.max()
    assert np.abs(problem.close(found.theta) - found.passive).max() < 1e-12


FAR_OFFSETS = (9.3657e-3, 5.7675e-3, 8.9786e-3)
"""[m] As Ipopt finds them with either Hessian. The machine was drawn with 10.5, 5.0 and 8.8 mm."""


def test_a_machine_with_offsets_of_a_centimetre_has_one_optimum(root):
    """From no errors, first steps of 46 tolerances end in a local minimum, or nowhere."""
    problem, sigma = build_problem(load_session(root / "tests/sessions/far-offsets")), 5.7735e-6
    ipopts = NonlinearProgram(problem).solve(sigma=sigma)
    batch = BatchSolver(problem).solve(problem.values[None], sigma=sigma)
    assert batch.solved_alone.all()  # by variable projection
    assert (np.abs(batch.theta[0] - ipopts.theta) / problem.theta_scale).max() < AGREED
    assert batch.objective[0] == pytest.approx(ipopts.objective, rel=1e-6)
    offsets = [batch.theta[0, problem.free.index(f"{axis}_slide.offset")] for axis in "xyz"]
    assert offsets == pytest.approx(FAR_OFFSETS, abs=1e-7)
    assert batch.objective[0] < problem.observations.size


def test_the_linearised_solver_minimises_a_robust_loss():
    """By differences of the cost of the linear problem."""
    problem = problem_of("raw-cycles", "lengths", "plain")
    sigma, loss = 5e-6, Loss("huber")
    options = SolverOptions(solver="linearised", loss=loss)
    found = LinearisedProgram(problem, options=options).solve(sigma=sigma)
    squares = LinearisedProgram(problem).solve(sigma=sigma)
    prediction, jacobian = problem.predict_and_jacobian(problem.active_theta)
    o, scale = problem.observations, problem.theta_scale

    def cost(theta, zeros):
        left = problem.values - prediction - jacobian @ ((theta - problem.active_theta) / scale)
        off = problem.prior_precision * (theta - problem.prior_mean) / scale
        return loss.value((left - zeros[o.zero]) / sigma).sum() + 0.5 * off @ off

    assert np.abs(found.theta - squares.theta).max() > 1e-7
    least = cost(found.theta, found.zeros)
    for i in range(problem.n_free):
        for step in (-1e-4, 1e-4):
            moved = np.array(found.theta)
            moved[i] += step * scale[i]
            assert cost(moved, found.zeros) > least
    for i in range(o.n_zeros):
        for step in (-1e-8, 1e-8):
            moved = np.array(found.zeros)
            moved[i] += step
            assert cost(found.theta, moved) > least


def test_a_calibration_states_its_solver(tmp_path):
    session = exact(session_of("table1/experiment-2"))
    found = {
        kind: identified(session, solver=kind)
        for kind in ("ipopt", "variable-projection", "linearised")
    }
    for kind, result in found.items():
        assert result.solver.name == kind
        path = tmp_path / "calibration.json"
        path.write_text(calibration_json(result))
        assert load_calibration(path).solver.name == kind
    complete, projected, linearised = found.values()
    assert complete.solver.status == "Solve_Succeeded"
    assert min(complete.solver.iterations, complete.solver.seconds_solve) > 0
    assert projected.model_covariance == pytest.approx(complete.model_covariance, rel=1e-6)
    for p, q, r in zip(complete.free, projected.free, linearised.free, strict=True):
        assert q.value == pytest.approx(p.value, abs=1e-11)
        assert r.value != p.value
        assert r.value == pytest.approx(r.linear, abs=1e-12)
        assert r.value == pytest.approx(p.linear, abs=1e-12)


def test_an_unknown_solver_is_refused():
    with pytest.raises(OrthocalError, match="the solver is 'newton'; expected one of ipopt"):
        SolverOptions(solver="newton")


def test_readings_are_excluded_and_parameters_prescribed():
    problem = problem_of("raw-cycles", "lengths", "plain")
    given = {"excluded": [3, 11], "prescribed": {0: 0.4e-3}}
    ours, ipopts = solve_by_both(problem, loss="squares", sigma=10e-6, **given)
    assert np.abs((ours.theta - ipopts.theta) / problem.theta_scale).max() < AGREED
    assert ours.theta[0] == pytest.approx(0.4e-3, abs=1e-15)
    assert not ours.at_bound.any()
    free, _ = solve_by_both(problem, loss="squares", sigma=10e-6)
    assert np.abs(free.theta - ours.theta).max() > 1e-5


def test_the_gradient_vanishes_by_central_differences():
    """No derivative of the solver's own is asked."""
    problem = problem_of("table1/experiment-1-printed", "lengths", "plain")
    solution = VariableProjection(problem).solve(sigma=20e-6)
    o = problem.observations

    def objective(theta):
        deviation = problem.values - problem.predict(theta)
        counts = np.bincount(o.zero, minlength=o.n_zeros)
        residual = deviation - (np.bincount(o.zero, deviation) / counts)[o.zero]
        off = problem.prior_precision * (theta - problem.prior_mean) / problem.theta_scale
        return 0.5 * (residual @ residual) / 20e-6**2 + 0.5 * (off @ off)

    assert objective(solution.theta) == pytest.approx(solution.objective, rel=1e-9)
    for i, scale in enumerate(problem.theta_scale):
        step = np.zeros(problem.n_free)
        step[i] = 1e-3 * scale
        up, down = objective(solution.theta + step), objective(solution.theta - step)
        curvature = up + down - 2.0 * objective(solution.theta)
        # where the parabola through the three points has its lowest, in steps
        assert abs(0.5 * (down - up) / curvature) < 1e-4


def test_no_convergence_is_an_error():
    problem = problem_of("sweep", "full", "plain")
    with pytest.raises(SolverError, match=r"the step is still .* after 1 iterations"):
        VariableProjection(problem, options=SolverOptions(max_iterations=1)).solve(sigma=5e-6)


@pytest.mark.parametrize("solver", ["ipopt", "linearised", "variable-projection"])
def test_readings_without_a_value_are_refused(solver):
    problem = problem_of("table1/experiment-1-printed", "offsets", "plain")
    program = build_program(problem, SolverOptions(solver=solver))
    values = np.array(problem.values)
    with pytest.raises(ValueError, match=r"values: found the shape \(5,\); expected \(12,\)"):
        program.solve(sigma=1e-5, values=values[:5])
    values[[1, 4]] = np.nan
    with pytest.raises(ValueError, match="values: 2 of 12 readings have no value"):
        program.solve(sigma=1e-5, values=values)


def test_a_start_at_which_the_tip_misses_the_rod_is_refused():
    problem = problem_of("workshop", "offsets", "plain")
    start = np.zeros(problem.n_free)
    start[problem.free.index("z_slide.offset")] = 25e-3
    with pytest.raises(SolverError, match="cannot start: with the start values of the errors"):
        VariableProjection(problem).solve(sigma=1e-5, start=start)


def test_acceleration_ends_linear_iterations_after_as_many_steps_as_parameters():
    """Steps that become shorter by these factors alone would take hundreds of iterations."""
    ratios, optimum = np.array([-0.9, 0.5, 0.95]), np.array([3.0, -2.0, 1.0])
    theta, acceleration = np.zeros(3), _Acceleration()
    for _ in range(5):
        step = (1.0 - ratios) * (optimum - theta)
        theta = theta + acceleration.accelerate(theta, step)
    assert theta == pytest.approx(optimum, abs=1e-9)


class LineTask:
    """Stub of a task with one parameter: prescribed steps, and an objective with closed loops."""

    sigma, low, high = 1.0, np.array([-10.0]), np.array([10.0])

    def __init__(self, steps, objective, *, farthest=np.inf):
        self.steps, self.objective, self.farthest = iter(steps), objective, farthest

    def step(self, state, jacobian):
        return np.array([next(self.steps)])

    def at(self, theta, passive):
        if theta[0] > self.farthest:
            raise ClosureError("is out of reach", posture="far")
        return SimpleNamespace(theta=theta, passive=None, objective=self.objective(theta[0]))

    def linearise(self, theta, passive):
        return SimpleNamespace(jacobian=np.ones((1, 1)))

    def descend(self):
        """Descend from 0 with closed loops."""
        program = object.__new__(VariableProjection)
        program.options = SolverOptions(solver="variable-projection")
        begin = self.at(np.zeros(1), None), self.linearise(None, None)
        return program._descend(self, begin, 50, open_loops=False)


def test_a_halved_step_is_no_convergence():
    """At 1 the step is still 0.2, but only a part of 1/2048 of it improves the fit."""
    task = LineTask([1.0, 0.2, 0.2], lambda x: 10.0 - x if x <= 1.0 + 1.2e-4 else 100.0)
    with pytest.raises(SolverError, match="no step improves the fit") as raised:
        task.descend()
    assert raised.value.iterations == 3
    optimum, _, iterations = LineTask([1.0, 1e-9], lambda x: (1.0 + 1e-9 - x) ** 2).descend()
    assert (optimum.theta[0], iterations) == (pytest.approx(1.0, abs=1e-12, rel=1e-8), 2)


def test_a_posture_that_no_step_reaches_is_named():
    task = LineTask([1.0], lambda x: -x, farthest=0.0)
    with pytest.raises(ClosureError, match="posture 'far' is out of reach"):
        task.descend()
    task = LineTask([1.0], abs, farthest=0.5)  # shorter steps are possible, but worse
    with pytest.raises(SolverError, match="no step improves the fit"):
        task.descend()


def test_linearised_offsets_of_the_paper_are_those_of_equation_8():
    """Residuals and offsets of Experiment 2 by the matrix of the paper."""
    session = exact(session_of("table1/experiment-2"))
    problem = build_problem(session, model="offsets")
    matrix = leg_parallelism_matrix(
        length=0.31025, displacement_max=0.06, displacement_min=-0.1, rows=6
    )
    rows = {(r.setup, r.posture): r.value for r in session.readings}
    assert len(rows) == 6
    differences = [rows[name, f"{name[1]}_max"] for name in SIX_ROWS]
    offsets = invert_equation_8(matrix) @ differences
    assert LinearisedProgram(problem).solve(sigma=1e-5).theta == pytest.approx(offsets, abs=1e-8)
