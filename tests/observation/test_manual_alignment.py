"""Balls are aligned with the actual rod: its distance from the nominal rod, by other ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrated import identified
from workshop import Workshop

from orthocal import draw_errors, load_plan, simulate_session
from orthocal.kinematics.error_map import error_map
from orthocal.measurement.joining import join_sessions
from orthocal.observation.model import ObservationModel
from orthocal.observation.sensor_groups import nuisance_parameters

MM = 1e-3
OFFSETS = ("x_slide.offset", "y_slide.offset", "z_slide.offset")


@pytest.fixture
def plan(root):
    return load_plan(root / "examples/workshop/plan.yaml")


def laterals(session, errors):
    """Setup to how far its ball is beside the drawing, [m]."""
    known = [p.name for p in nuisance_parameters(session).parameters]
    found = ObservationModel(session).alignment(error_map(session.robot).expand(errors))
    named = dict(zip(known, found.tolist(), strict=True))
    assert all(v == 0.0 for name, v in named.items() if not name.endswith(".lateral"))
    return {name: named[f"setup.{name}.lateral"] for name in session.setups}


def test_it_is_where_pinocchio_has_the_rod_to_first_order(plan):
    """All errors at once, offsets of up to 13 mm: what is left falls with their square."""
    for session in (plan, plan.with_controller([1 * MM, -2 * MM, 0.5 * MM])):
        active = dict(zip(OFFSETS, session.active_offsets.tolist(), strict=True))
        drawn = draw_errors(plan.robot, ["*"], seed=26)
        left = []
        for share in (1.0, 0.1):
            errors = {n: active.get(n, 0.0) + share * v for n, v in drawn.items()}
            found, workshop = laterals(session, errors), Workshop(session, errors)
            off = [found[name] - workshop.beside(name) for name in session.setups]
            left.append(np.abs(off).max())
            assert np.abs(list(found.values())).max() > share * 5 * MM
        assert left[0] < 0.3 * MM
        assert left[1] < 0.013 * left[0]


def test_nothing_is_beside_where_the_controller_corrects_all(plan):
    active = [1 * MM, -2 * MM, 0.5 * MM]
    found = laterals(plan.with_controller(active), dict(zip(OFFSETS, active, strict=True)))
    assert max(map(abs, found.values())) < 1e-12


def test_sessions_that_are_joined_keep_what_was_active_in_each(plan):
    truth = dict(zip(OFFSETS, (1.2 * MM, -0.8 * MM, 0.5 * MM), strict=True))
    entered = plan.with_controller([1.1 * MM, -0.7 * MM, 0.4 * MM])
    joined = join_sessions([plan, entered])
    found = laterals(joined, truth)
    for label, session in (("workshop-1", plan), ("workshop-2", entered)):
        for name, value in laterals(session, truth).items():
            assert found[f"{label}/{name}"] == pytest.approx(value, abs=1e-15)


def test_blades_and_exact_mountings_are_at_their_nominal_position(plan):
    setups = {
        n: replace(s, sensor=replace(s.sensor, mounting=replace(s.sensor.mounting, lateral=0.0)))
        for n, s in plan.setups.items()
    }
    assert not ObservationModel(replace(plan, setups=setups)).alignment.aligned.any()


def test_both_solvers_find_one_optimum(plan):
    """Millimetres of offsets, so that balls are a millimetre beside the drawing."""
    errors = {**draw_errors(plan.robot, ["*"], seed=5), **dict.fromkeys(OFFSETS, 1.5 * MM)}
    session = simulate_session(plan, errors, seed=1).session
    results = (identified(session, "full", solver=s) for s in ("variable-projection", "ipopt"))
    projected, other = ([*result.free, *result.sensors] for result in results)
    for p, q in zip(projected, other, strict=True):
        assert abs(p.value - q.value) < 1e-4 * p.prior_std


def test_a_ball_over_its_rod_is_recovered_as_such(plan):
    """Exact readings of a machine with large offsets: all gauges stand as they should."""
    truth = dict(zip(OFFSETS, (3 * MM, -2.5 * MM, 2 * MM), strict=True))
    session = simulate_session(plan, truth, exact=True).session
    result = identified(session, "offsets")
    for name, value in truth.items():
        assert result[name].value == pytest.approx(value, abs=1e-9)
    for p in result.sensors:
        assert abs(p.value) < 1e-6 * p.prior_std
