"""Setups read with the wrong sign are found, and nobody else is accused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import plans
import pytest
from fleets import Fleet
from folders import session_folder
from gauges import exact
from machines import write_orthoglide

from orthocal import calibrate, load_plan, load_session, simulate_session
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.hypotheses.reversed_setup import CLEARLY, weigh_signs
from orthocal.statistics.zeros import project_out_zeros


def turn(session, setup):
    values = [-r.value if r.setup == setup else r.value for r in session.readings]
    return session.with_values(values)


@pytest.mark.parametrize(
    ("session", "model", "setup"),
    [
        *(("raw-cycles", "offsets", s) for s in ("yx", "zx", "xy", "zy", "xz", "yz")),
        ("sweep", "full", "zy_50"),
        ("lines", "offsets", "yx"),
    ],
)
def test_a_setup_with_its_sign_turned_is_found(root, session, model, setup):
    """It and no other; what it would leave with the right sign is what Ipopt, without it, misses.

    All others read the same, turned or not; sigma, which weighs a prior, is that of the turned one.
    """
    right = load_session(session_folder(root, session))
    assert calibrate(right, model).turned is None
    found = calibrate(turn(right, setup), model).turned
    assert found.name == setup
    sigma = fit_problem(build_problem(turn(right, setup), model=model)).sigma
    problem = build_problem(right, model=model)
    o = problem.observations
    out = np.flatnonzero(o.setup == list(right.setups).index(setup))
    solved = NonlinearProgram(problem).solve(sigma=sigma, left_out=out)
    missed = project_out_zeros(problem.values - problem.predict(solved.theta), o)[out]
    # up to the curvature between the two solutions
    assert found.turned == pytest.approx(np.sqrt(np.mean(missed**2)), rel=0.02)


@pytest.mark.parametrize("setup", ["zx", "xy", "xz", "yz"])
def test_a_turned_setup_is_found_among_coarse_readings(root, setup):
    """Deviations of 0.12 to 0.26 mm, two cycles with 20 µm."""
    plan = exact(load_plan(root / "examples/raw-cycles/plan.yaml"))
    truth = {"x_slide.offset": 0.8e-3, "y_slide.offset": -0.45e-3, "z_slide.offset": 0.3e-3}
    session = simulate_session(plan, truth, sigma=20e-6, seed=1).session
    two = replace(session, readings=tuple(r for r in session.readings if r.cycle < 3))
    assert calibrate(two).turned is None
    assert calibrate(turn(two, setup)).turned.name == setup


@pytest.mark.parametrize("number", ["1-printed", "1-corrected", "2", "3"])
def test_one_difference_a_setup_cannot_tell_of_its_sign(root, number):
    session = load_session(root / f"examples/table1/experiment-{number}")
    for setup in (None, *session.setups):
        given = session if setup is None else turn(session, setup)
        assert calibrate(given).turned is None


@pytest.fixture(scope="module")
def raw_plan(root):
    return load_plan(root / "examples/raw-cycles/plan.yaml")


@pytest.fixture(scope="module")
def fleet(raw_plan):
    return Fleet(raw_plan)


def accused(fleet, fit):
    name, evidence, _ = weigh_signs(fit, fleet.others)
    return name if evidence > CLEARLY else None


@pytest.mark.slow
@pytest.mark.parametrize(("level", "found"), [(0.0, 59), (0.3, 59), (1.0, 56), (3.0, 49)])
def test_turned_setups_are_found_among_sixty_machines(fleet, level, found):
    """Offsets within their tolerances, all other errors so many times theirs."""
    o, names, count = fleet.problem.observations, list(fleet.plan.setups), 0
    for machine in range(60):
        rng = np.random.default_rng(machine)
        values = fleet.read(rng, fleet.draw(rng, level=level))
        setup = machine % len(names)
        fit = fleet.fit(np.where(o.setup == setup, -values, values))
        name = accused(fleet, fit)
        assert name in (None, names[setup]) or level > 1.0
        count += name == names[setup]
    assert count >= found


def dense_plan(tmp_path_factory, length=None, plan=plans.paper):
    folder = tmp_path_factory.mktemp("plan")
    document = plan()
    document["gauge"] = {"sigma_mm": 0.005, "resolution_mm": 0.01, "range_mm": [-20, 20]}
    if length is not None:
        write_orthoglide(folder / "machine", length)
        document["robot"] = "machine"
    return load_plan(plans.write(folder, document))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "model", "count"),
    [
        ("cycles", "offsets", 60),
        ("cycles", "full", 20),
        ("250 mm", "offsets", 60),
        ("100 mm", "offsets", 30),
        ("sweep", "offsets", 20),
        ("sweep", "full", 10),
    ],
)
def test_nobody_is_accused_whose_offsets_were_entered(
    fleet, raw_plan, tmp_path_factory, kind, model, count
):
    """200 machines with errors of 0.3, 1 and 3 tolerances, measured before and after entering."""
    if kind == "cycles":
        own = fleet if model == "offsets" else Fleet(raw_plan, model=model)
    elif kind == "sweep":
        own = Fleet(dense_plan(tmp_path_factory, plan=plans.sweep), model=model)
    else:
        length = float(kind.split()[0]) * 1e-3
        scaled = {k: v * length / 0.31025 for k, v in {"max": 60.0, "min": -100.0}.items()}
        paper = lambda: plans.paper(**scaled)  # noqa: E731
        own = Fleet(dense_plan(tmp_path_factory, length, paper), model=model)
    for machine in range(count):
        rng = np.random.default_rng(7000 + machine)
        errors = own.draw(rng, level=(0.3, 1.0, 3.0)[machine % 3])
        first = own.fit(own.read(rng, errors))
        assert accused(own, first) is None
        again = own.fit(own.read(rng, own.enter(errors, first)))
        assert accused(own, again) is None


def test_the_main_loop_walked_twice_accuses_nobody(raw_plan):
    """Through sessions, with the entered offsets stated: what the fleet takes a short way to."""
    fleet = Fleet(raw_plan)
    rng = np.random.default_rng(3)
    errors = fleet.machine.split_errors(fleet.draw(rng))
    first = calibrate(simulate_session(raw_plan, errors, seed=1).session)
    assert first.turned is None
    offsets = np.array([first[f"{d.name}.offset"].value for d in raw_plan.robot.drives])
    again = raw_plan.with_controller(offsets)
    session = simulate_session(again, errors, seed=2).session
    second = calibrate(session)
    assert second.turned is None
    assert second.rms_before < 1.5 * first.rms_after
    short = fleet.fit(session.values)
    entered = fit_problem(build_problem(session, model="offsets"))
    np.testing.assert_allclose(
        short.solution.theta[:3] + offsets, entered.solution.theta[:3], rtol=0.0, atol=1e-9
    )
