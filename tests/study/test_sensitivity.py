"""Study of sensitivity: the paper's factors, and central differences with Pinocchio."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_plans import effect_plan
from machines import place

from orthocal import load_plan
from orthocal.effects.compensation import JointTrim
from orthocal.errors import ClosureError, SessionError
from orthocal.planning.first_plan import Displacements, build_paper_plan
from orthocal.session.session import Gauge
from orthocal.study.runner import run_study
from orthocal.study.sensitivity import build_sensitivity_study, summarise_sensitivity

LENGTH = 0.31025


@pytest.fixture(scope="module")
def offsets(orthoglide):
    study = build_sensitivity_study(orthoglide, ["*.offset"])
    return summarise_sensitivity(study, run_study(study))


def test_each_approach_has_its_row():
    """Derivatives with respect to backlash have opposite signs from both sides."""
    plan = effect_plan("backlash")
    rows = [r for r in plan.readings if r.cycle == 1 and r.approach in ("ppp", "nnn")]
    study = build_sensitivity_study(plan.select(rows), ["*.backlash"])
    found = summarise_sensitivity(study, run_study(study))
    labels = [posture for posture, output in found.rows if not output.startswith("tool")]
    assert {text.rpartition("approach ")[2] for text in labels} == {"ppp)", "nnn)"}
    by_row = dict(zip(found.rows, found.derivatives, strict=True))
    for (posture, output), row in by_row.items():
        other = by_row.get((posture.replace("ppp", "nnn"), output))
        if "ppp" in posture and other is not None:
            assert row == pytest.approx(-other)


def test_active_offsets_of_the_same_postures_change_no_derivative(orthoglide):
    """The machine stops in the same places, whatever its controller adds."""
    plan = build_paper_plan(orthoglide, Displacements(), Gauge(None, None, None))
    plans = plan, plan.with_controller([5e-3, -5e-3, 10e-3])
    studies = [build_sensitivity_study(p, ["*.offset"]) for p in plans]
    one, other = (summarise_sensitivity(s, run_study(s)) for s in studies)
    assert one.rows == other.rows
    assert other.derivatives == pytest.approx(one.derivatives, abs=1e-8)


def test_studies_with_other_tables_of_the_controller_are_others():
    """Tables are in other files than the session.yaml."""
    plan = effect_plan("backlash")
    at = [[0.1, 0.0, 0.0], [0.3, 1.0, -1.0], [0.5, 0.0, 0.0]]
    trims = [JointTrim(table=np.array(at) * [1.0, size, size]) for size in (1e-5, 2e-5)]
    plans = (replace(plan, compensation=(t, *[JointTrim()] * 2)) for t in (*trims, trims[0]))
    assert len({build_sensitivity_study(p, ["*.backlash"]).digest for p in plans}) == 2


def test_points_are_read_with_the_conditions_of_each_setup():
    """From both sides. Expansion has no effect at the reference temperature."""
    plan = effect_plan("backlash", "thermal", setups=("yx",))
    names = ["*.backlash", "legs.expansion"]
    study = build_sensitivity_study(plan, names, points=[[0.06, 0.0, 0.0]])
    found = summarise_sensitivity(study, run_study(study))
    approaches = {r.approach: r.conditions for r in reversed(plan.readings)}  # the first ones
    labels = [posture for posture, output in found.rows if output == "yx"]
    assert len(labels) == len(approaches) == 4
    assert set(labels) == {f"point_1 (approach {approach})" for approach in approaches}
    *backlash, expansion = (found.parameters.index(n) for n in study.parameters)
    for approach, conditions in approaches.items():
        one = row(found, f"point_1 (approach {approach})", "yx")
        opposite = approach.translate(str.maketrans("pn", "np"))
        other = row(found, f"point_1 (approach {opposite})", "yx")
        # the temperatures differ by some kelvins, lengths by some 1e-5
        assert one[backlash] == pytest.approx(-other[backlash], rel=1e-4)
        tools = [
            [row(found, f"point_1 (approach {a})", f"tool {axis}")[backlash] for axis in "xyz"]
            for a in (approach, opposite)
        ]
        assert tools[0] == pytest.approx(-np.array(tools[1]))
        # a drive stops short by half of its backlash, and moves the tool along its axis
        sides = [0.5 if letter == "n" else -0.5 for letter in approach]
        assert np.diagonal(tools[0]) == pytest.approx(sides)
        assert np.abs(one[backlash]).max() > 0.1
        assert (one[expansion] == 0.0) == (conditions.temperature == 20.0)


def row(summary, posture, reads):
    return summary.derivatives[summary.rows.index((posture, reads))]


@pytest.mark.parametrize(("posture", "moved"), [("x_max", 60.0), ("x_min", -100.0)])
def test_factors_of_the_paper(offsets, posture, moved):
    """Equation (6) at the tool: 1 and tan α; equation (7) in readings."""
    alpha = np.arcsin(moved * 1e-3 / LENGTH)
    t, s = np.tan(alpha), np.sin(alpha)
    expected = np.array([[1, 0, 0], [t, 1, 0], [t, 0, 1]])
    tool = np.array([row(offsets, posture, f"tool {a}") for a in "xyz"])
    assert np.abs(tool - expected).max() < 1e-8
    less_zero = row(offsets, posture, "yx") - row(offsets, "zero", "yx")
    assert np.abs(less_zero - [(0.5 + s) * t, s, 0.0]).max() < 1e-8
    assert set(offsets.units) == {"mm/mm"}


def test_derivatives_agree_with_central_differences(orthoglide):
    """Any errors, any place: central differences, loops closed by Pinocchio."""
    names = ["x_swivel.rz", "y_coupler.x", "z_slide.scale", "frame.y_foot_end.ry"]
    point = [0.02, -0.03, 0.04]
    study = build_sensitivity_study(orthoglide, names, points=[point])
    found = summarise_sensitivity(study, run_study(study))
    posture = study.session.postures["point_1"]
    assert set(found.parameters) == set(names)
    for i, name in enumerate(found.parameters):
        parameter = orthoglide.parameters[name]
        step = 0.1 * parameter.prior_std
        ends = [
            place(orthoglide.with_errors({name: s * step}), posture.drives, "tcp") for s in (1, -1)
        ]
        expected = (ends[0] - ends[1]) / (2 * step)
        edge = expected / 1e-3 / parameter.edge_factor
        own = [row(found, "point_1", f"tool {a}")[i] for a in "xyz"]
        assert np.abs(np.array(own) - edge).max() < 1e-6 * max(1.0, np.abs(edge).max())
        assert found.units[i] == f"mm/{parameter.edge_unit}"
        along_x = found.rows.index(("point_1", "tool x"))
        expected_um = expected[0] * parameter.prior_std
        assert found.per_prior_std[along_x, i] == pytest.approx(expected_um, abs=1e-10)


def test_points_without_contact(root):
    """The ball of a gauge is at a fixed place on the base."""
    plan = load_plan(root / "examples/workshop/plan.yaml")
    with pytest.raises(SessionError, match="point_1"):
        build_sensitivity_study(plan, points=[[0.01, 0.02, 0.03]])


def test_unreachable_points(orthoglide):
    with pytest.raises(ClosureError, match="point_1"):
        build_sensitivity_study(orthoglide, points=[[0.5, 0.0, 0.0]])
    with pytest.raises(ClosureError, match="x_max"):
        build_sensitivity_study(orthoglide, displacements=Displacements(0.5, -0.1))
