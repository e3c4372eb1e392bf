"""The nonlinear program: derivatives, perfect data, and agreement of solvers."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from derivatives import assert_program_derivatives
from models import TRUTH
from scipy.optimize import least_squares
from tolerances import SAME_OPTIMUM, TRUTH_BACK

from orthocal import load_session, simulate_session
from orthocal.errors import OrthocalError, SolverError
from orthocal.estimation.loss import SQUARES, Loss
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import LENGTH_SCALE, build_problem
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.statistics.zeros import project_out_zeros

HUBER = Loss("huber")


@pytest.fixture(scope="module")
def perfect(exact_plan):
    return simulate_session(exact_plan, TRUTH, exact=True).session


def point(program, problem, size, seed=0):
    """A point of the program near closed loops, with every variable moved."""
    rng = np.random.default_rng(seed)
    functions = program.functions()
    n = functions["nlp"].size1_in(0)
    x = size * rng.normal(size=n)
    passive = np.tile(problem.robot.reference_passive, problem.n_states)
    scale = np.tile(problem.passive_scale, problem.n_states)
    x[n - passive.size :] += passive / scale + 5.0 * rng.normal(size=passive.size)
    return x, program.parameter_values(sigma=2e-4, excluded=[1, 4])


@pytest.mark.parametrize(("model", "loss"), [("offsets", HUBER), ("full", SQUARES)], ids=str)
def test_derivatives_of_the_program_are_exact(perfect, model, loss):
    problem = build_problem(perfect, model=model, prior=True)
    program = NonlinearProgram(problem, options=SolverOptions(hessian="exact", loss=loss))
    x, p = point(program, problem, 1.5)
    assert_program_derivatives(program.functions(), x, p, weight=0.7, directions=12, seed=1)


def test_the_gauss_newton_hessian_is_the_exact_one_without_curvature(perfect):
    """At zero residuals and zero multipliers they are the same."""
    problem = build_problem(perfect, prior=True, model="offsets")
    theta = np.array(list(TRUTH.values()))
    passive = problem.close(theta)
    left = problem.values - problem.predict(theta, passive)
    zeros = [left[problem.observations.zero == i].mean() / LENGTH_SCALE for i in range(6)]
    x = np.r_[theta / problem.theta_scale, zeros, (passive / problem.passive_scale).ravel()]
    matrices = []
    for hessian in ("exact", "gauss-newton"):
        program = NonlinearProgram(problem, options=SolverOptions(hessian=hessian))
        f, p = program.functions(), program.parameter_values(sigma=1e-5)
        lam = np.zeros(f["nlp"].size1_out(1))
        matrices.append(np.asarray(f["hess_lag"](x, p, 1.0, lam).full()))
    scale = np.abs(matrices[0]).max()
    assert np.abs(matrices[0] - matrices[1]).max() / scale < 1e-9


@pytest.mark.parametrize("hessian", ["gauss-newton", "exact"])
def test_perfect_data_give_the_truth_back_from_any_start(perfect, hessian):
    problem = build_problem(perfect, model="offsets")
    program = NonlinearProgram(problem, options=SolverOptions(hessian=hessian))
    random = np.random.default_rng(0).uniform(-0.02, 0.02, (4, 3))
    for start in ([0.02, -0.02, 0.02], *random):
        solution = program.solve(sigma=1e-5, start=start)
        assert np.abs(solution.theta - list(TRUTH.values())).max() < TRUTH_BACK
        assert solution.closure < 1e-11


def test_another_solver_finds_the_same(exact_plan):
    """SciPy's least squares on the reduced problem, loops closed by Newton at every step."""
    session = simulate_session(exact_plan, TRUTH, seed=4).session
    problem = build_problem(session, model="lengths")
    solution = NonlinearProgram(problem).solve(sigma=1e-5)

    def residuals(theta_hat):
        left = problem.values - problem.predict(theta_hat * problem.theta_scale)
        whitened = project_out_zeros(left, problem.observations) / 1e-5
        return np.r_[whitened, theta_hat * problem.has_prior]

    other = least_squares(
        residuals, np.zeros(problem.n_free), jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-12
    )
    assert np.abs(other.x * problem.theta_scale - solution.theta).max() < SAME_OPTIMUM
    assert other.cost == pytest.approx(solution.objective, rel=1e-9)


def test_not_converged_is_an_error_and_never_a_result(exact_plan):
    session = simulate_session(exact_plan, TRUTH, seed=7).session
    program = NonlinearProgram(
        build_problem(session, model="offsets"), options=SolverOptions(max_iterations=1)
    )
    with pytest.raises(SolverError, match="Ipopt did not converge: Maximum_Iterations") as caught:
        program.solve(sigma=1e-5)
    assert caught.value.iterations == 1
    assert caught.value.exit_code == 1


def test_expressions_are_the_observation_model(root):
    """Balls aligned by eye, all errors: readings, residuals, q, closures, nuisance by name."""
    problem = build_problem(load_session(root / "examples/workshop"), model="full")
    program, sigma = NonlinearProgram(problem), 1e-5
    e = program.expressions()
    theta = 0.3 * problem.theta_scale * np.random.default_rng(0).normal(size=problem.n_free)
    x, p = program.initial_variables(theta, sigma=sigma), program.parameter_values(sigma=sigma)
    o, n = problem.observations, problem.n_machine

    def value(expression):
        function = ca.Function("f", [e.variables, e.parameters], [expression])
        return np.asarray(function(x, p).full()).reshape(-1)

    zeros = value(e.zeros)
    readings = value(e.readings)
    assert np.abs(readings - zeros[o.zero] - problem.predict(theta)).max() < 1e-13
    assert np.array_equal(value(e.residuals), problem.values - readings)
    assert list(e.nuisance) == list(problem.free[n:])
    assert np.abs(value(ca.vertcat(*e.nuisance.values())) - theta[n:]).max() < 1e-15
    assert np.abs(value(ca.vertcat(*e.errors.values())) - theta).max() < 1e-15
    passive = problem.close(theta)
    assert list(e.passive) == list(e.closures) == list(problem.session.postures)
    for q, name in zip(passive, problem.session.postures, strict=True):
        assert np.abs(value(e.passive[name]) - q).max() < 1e-14
        assert np.abs(value(e.closures[name])).max() < 1e-12


def test_expressions_and_bounds_are_the_program(exact_plan):
    """A session with zeros that are known: they stay 0, and the optimum is that of `solve`."""
    setups = {n: replace(s, zero="known") for n, s in exact_plan.setups.items() if n == "yx"}
    plan = replace(exact_plan, setups={**exact_plan.setups, **setups})
    session = simulate_session(plan, TRUTH, seed=2).session
    problem, sigma = build_problem(session, model="offsets"), 5e-6
    assert problem.observations.zero_known.any()
    program = NonlinearProgram(problem)
    e = program.expressions()
    functions = {"x": e.variables, "p": e.parameters, "f": e.objective, "g": e.constraints}
    quiet = {"ipopt": {"print_level": 0, "sb": "yes"}, "print_time": False}
    lower, upper = program.variable_bounds()
    x, p = program.initial_variables(sigma=sigma), program.parameter_values(sigma=sigma)
    solver = ca.nlpsol("own", "ipopt", functions, quiet)
    found = solver(x0=x, p=p, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)["x"]
    zeros = ca.Function("zeros", [e.variables], [e.zeros])(found)
    assert np.abs(zeros.full()[problem.observations.zero_known]).max() < 1e-12
    theta = found.full()[: problem.n_free, 0]
    optimum = program.solve(sigma=sigma).theta / problem.theta_scale
    assert np.abs(theta - optimum).max() < 1e-4


@pytest.mark.parametrize(
    ("options", "named"),
    [({"nonsense": 1}, "nonsense"), ({"tol": "abc"}, "tol"), ({"max_iter": -3}, "max_iter")],
)
def test_an_option_that_ipopt_refuses_is_named(experiment_2, options, named, capfd):
    problem = build_problem(experiment_2, model="offsets")
    with pytest.raises(OrthocalError, match=f"'{named}'"):
        NonlinearProgram(
            problem, options=SolverOptions(ipopt={"mu_strategy": "adaptive", **options})
        )
    capfd.readouterr()


def test_a_linear_solver_that_is_not_installed_is_named(experiment_2, capfd):
    """Ipopt accepts the name, and loads the library when it solves."""
    options = SolverOptions(ipopt={"hsllib": "absent.so", "linear_solver": "ma57"})
    program = NonlinearProgram(build_problem(experiment_2, model="offsets"), options=options)
    with pytest.raises(OrthocalError, match="'linear_solver': 'ma57'") as caught:
        program.solve(sigma=1e-5)
    assert not isinstance(caught.value, SolverError)
    assert "iterations" not in str(caught.value)
    capfd.readouterr()


def test_options_reach_ipopt(experiment_2):
    problem = build_problem(experiment_2, model="offsets")
    with pytest.raises(SolverError):
        NonlinearProgram(problem, options=SolverOptions(ipopt={"max_iter": 1})).solve(sigma=1e-5)
    with pytest.raises(ValueError, match="ipopt has"):
        SolverOptions(ipopt={"tol": None})


def test_programs_of_other_noise_share_the_exact_hessian(experiment_2):
    problem = build_problem(experiment_2, model="offsets")
    program = NonlinearProgram(problem)
    built = program._exact
    louder = problem.with_noise_ratio(2.0 * problem.noise_ratio)
    other = program.with_problem(louder)._exact
    assert other._functions is built._functions
    assert other.problem is louder
    fresh = NonlinearProgram(louder, options=SolverOptions(hessian="exact"))
    found, expected = (p.solve(sigma=1e-5) for p in (other, fresh))
    assert found.objective == pytest.approx(expected.objective, rel=1e-9)
    assert found.objective == pytest.approx(built.solve(sigma=2e-5).objective, rel=1e-9)
