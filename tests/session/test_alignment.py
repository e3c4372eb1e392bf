"""Alignment posture of a gauge: stated or by rule, independent of the order of the rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from calibrated import UNJUDGED, calibrated, plan_of, session_of

from orthocal import (
    SessionError,
    assess_tool,
    draw_errors,
    join_sessions,
    load_calibration,
    load_plan,
    load_session,
    restore_session,
    simulate_session,
    write_calibration,
    write_session,
)
from orthocal.assessment.fit_findings import find_fit_findings
from orthocal.calibration.identify import identify
from orthocal.estimation.tolerance_scale import AS_STATED
from orthocal.measurement.motion.guidance import guide
from orthocal.measurement.motion.motion import plan_motion
from orthocal.output.sheet.gauge_position import GaugePosition
from orthocal.session.session import Gauge
from orthocal.statistics.chance import confidence_factor

QUICK = {"solver": "variable-projection"}
ORDER = {"reversed": lambda n: np.arange(n)[::-1], "shuffled": np.random.default_rng(5).permutation}


@pytest.fixture(scope="module")
def workshop():
    """Readings whose setups state no alignment posture."""
    session = session_of("workshop")
    setups = {name: replace(s, aligned_at=None) for name, s in session.setups.items()}
    return replace(session, setups=setups)


def ordered(session, order):
    """The session with its rows in another order."""
    rows = [session.readings[i] for i in ORDER[order](len(session.readings))]
    return replace(session, readings=tuple(rows))


@pytest.fixture(scope="module")
def calibration():
    return calibrated("workshop", "full", **UNJUDGED)


def test_the_order_of_rows_changes_no_estimate(workshop, calibration):
    other, _ = identify(
        ordered(workshop, "shuffled"),
        "full",
        find_scale=lambda _: calibration.tolerance_scale,
        **QUICK,
    )
    scale = np.array([p.prior_std for p in calibration.free])
    expected, found = (np.array([p.value for p in c.free]) for c in (calibration, other))
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-9)
    unit = np.outer(scale, scale)
    np.testing.assert_allclose(
        other.total_covariance / unit, calibration.total_covariance / unit, atol=1e-9
    )
    tools = [assess_tool(c) for c in (calibration, other)]
    np.testing.assert_allclose(
        tools[1].deviation_with_entries, tools[0].deviation_with_entries, atol=1e-12
    )
    assert tools[1].after.sizes.reported.rms == pytest.approx(
        tools[0].after.sizes.reported.rms, rel=1e-9
    )


def with_two_gauges(setups_of_second, scale_of_second):
    """Simulated readings of two dials; those of the second scatter more or less than stated."""
    plan = plan_of("raw-cycles")
    gauges = {"dial": Gauge(5e-6, 1e-5), "fine": Gauge(2e-6, 1e-6)}
    setups = {
        name: replace(setup, gauge="fine" if i in setups_of_second else "dial")
        for i, (name, setup) in enumerate(plan.setups.items())
    }
    plan = replace(plan, gauges=gauges, setups=setups)
    errors = draw_errors(plan.robot, plan.robot.parameters.select_model("full"), seed=4)
    session = simulate_session(plan, errors, seed=4).session
    exact = simulate_session(plan, errors, seed=4, sigma=0.0).session.values
    scale = [scale_of_second if setups[r.setup].gauge == "fine" else 1.0 for r in session.readings]
    return session.with_values(exact + scale * (session.values - exact))


def with_other_gauge_first(session):
    return replace(
        session,
        gauges=dict(reversed(session.gauges.items())),
        setups=dict(reversed(session.setups.items())),
        readings=session.readings[::-1],
    )


@pytest.mark.parametrize(
    ("setups_of_second", "scale", "settings", "cycles"),
    [({1, 3, 5}, 5.0, {}, False), ({1}, 5.0, {}, True), ({1, 3, 5}, 5.0, {"loss": "huber"}, False)],
    ids=["more", "few readings", "robust"],
)
def test_the_order_of_gauges_changes_no_estimate(setups_of_second, scale, settings, cycles):
    session = with_two_gauges(setups_of_second, scale)
    if not cycles:
        session = session.select([r for r in session.readings if r.cycle == 1])
    settings = {"choice": "full"} | settings | QUICK
    found = [
        identify(s, find_scale=lambda _: AS_STATED, **settings)[0]
        for s in (session, with_other_gauge_first(session))
    ]
    assert [c.gauges[0].name for c in found] == ["dial", "fine"]
    one, other = ({g.name: g.noise for g in c.gauges} for c in found)
    for name, noise in one.items():
        assert other[name].source == noise.source
        for key in ("sigma", "dof", "residual_sigma", "residual_dof"):
            assert getattr(other[name], key) == pytest.approx(getattr(noise, key), rel=1e-9)
    assert found[1].noise.source == found[0].noise.source
    assert found[1].noise.dof == pytest.approx(found[0].noise.dof, rel=1e-9)
    # iterations of the robust loss end at smaller changes than this
    within = 1e-8 if "loss" in settings else 1e-9
    for quantity in (
        lambda c: [p.value / p.prior_std for p in c.free],
        lambda c: [p.std / p.prior_std for p in c.free],
        lambda c: c.expanded_uncertainties / [p.prior_std for p in c.free],
    ):
        assert quantity(found[1]) == pytest.approx(quantity(found[0]), abs=within)
    spectra = [c.identifiability for c in found]
    assert spectra[1].observability == pytest.approx(spectra[0].observability, rel=within)
    assert spectra[1].threshold == pytest.approx(spectra[0].threshold, rel=within)
    # the unit of the Jacobian is metres of the gauge with the least noise
    finest = min(noise.sigma for noise in one.values())
    assert spectra[0].threshold == pytest.approx(finest, rel=within)
    findings = [  # setups of different legs are equally idealised
        [(f.kind, f.text) for f in find_fit_findings(c) if f.kind != "line assumed"] for c in found
    ]
    assert findings[1] == findings[0]


def test_the_mechanical_zero_is_the_default_where_it_is_read(workshop):
    assert set(workshop.alignment_postures.values()) == {"zero"}
    assert set(ordered(workshop, "reversed").alignment_postures.values()) == {"zero"}


def test_otherwise_the_default_is_the_posture_nearest_to_the_zero(workshop):
    rows = tuple(r for r in workshop.readings if r.posture != "zero")
    session = replace(workshop, readings=rows)
    nearest = {"x": "x_max", "y": "y_max", "z": "z_max"}  # +60 mm against -100 mm
    assert session.alignment_postures == {
        name: nearest[setup.sensor.leg] for name, setup in session.setups.items()
    }


def test_among_equally_near_postures_the_first_is_the_default(workshop):
    leg = next(iter(workshop.setups.values())).sensor.leg
    setups = {n: s for n, s in workshop.setups.items() if s.sensor.leg == leg}
    postures = dict(reversed(list(workshop.postures.items())))
    for name in ("x_max", "x_min"):  # equally far from the zero
        sign = 1.0 if name == "x_max" else -1.0
        drives = workshop.robot.drive_zero + sign * np.array([0.05, 0.0, 0.0])
        postures[name] = replace(postures[name], drives=drives)
    rows = tuple(
        r for r in workshop.readings if r.setup in setups and r.posture in ("x_max", "x_min")
    )
    session = replace(workshop, setups=setups, postures=postures, readings=rows)
    first = next(n for n in postures if n in ("x_max", "x_min"))
    assert set(session.alignment_postures.values()) == {first}


def test_a_useless_gauge_does_not_change_the_coverage_factor():
    """The few readings of the other gauge determine the noise that matters."""
    plan = plan_of("raw-cycles")
    once = [r for r in plan.readings if r.cycle == 1]
    alone = replace(plan, gauges={"dial": Gauge(None)}, readings=tuple(once))
    alone = replace(alone, setups={n: replace(s, gauge="dial") for n, s in plan.setups.items()})
    errors = draw_errors(plan.robot, ["*.offset"], seed=2)
    alone = simulate_session(alone, errors, seed=3, sigma=20e-6).session
    useless = {f"{n}_2": replace(s, name=f"{n}_2", gauge="bad") for n, s in alone.setups.items()}
    readings = [
        replace(r, setup=f"{r.setup}_2", cycle=c) for r in alone.readings for c in range(1, 6)
    ]
    noise = 2e-3 * np.random.default_rng(4).normal(size=len(readings))
    both = replace(
        alone,
        gauges={"dial": Gauge(None), "bad": Gauge(None)},
        setups=alone.setups | useless,
        readings=(
            *alone.readings,
            *(replace(r, value=r.value + v) for r, v in zip(readings, noise, strict=True)),
        ),
    )
    first, second = (
        identify(s, "offsets", find_scale=lambda _: AS_STATED, **QUICK)[0] for s in (alone, both)
    )
    assert second.noise.dof > 50.0 > 10.0 > first.noise.dof
    for one, other in zip(first.free, second.free, strict=True):
        assert other.std_scatter == pytest.approx(one.std_scatter, rel=0.01)
    expected = confidence_factor(first.noise.dof)
    assert first.noise_coverage == expected > 2.1
    assert second.noise_coverage == pytest.approx(expected, rel=1e-3)


def test_a_stated_posture_changes_estimates(workshop, calibration):
    setups = {n: replace(s, aligned_at=f"{s.sensor.leg}_min") for n, s in workshop.setups.items()}
    other, _ = identify(replace(workshop, setups=setups), "full", **QUICK)
    change = [abs(a.value - b.value) for a, b in zip(other.free, calibration.free, strict=True)]
    assert max(change) > 1e-6


def test_files_state_the_posture(workshop, calibration, tmp_path):
    setups = {n: replace(s, aligned_at=f"{s.sensor.leg}_max") for n, s in workshop.setups.items()}
    write_session(replace(workshop, setups=setups), tmp_path / "stated")
    write_session(workshop, tmp_path / "default")
    for folder, expected in (("stated", "{}_max"), ("default", "zero")):
        document = yaml.safe_load((tmp_path / folder / "session.yaml").read_text("utf-8"))
        for setup in document["setups"].values():
            assert setup["aligned_at"] == expected.format(setup["leg"])
    again = load_session(tmp_path / "stated")
    assert again.alignment_postures == {n: s.aligned_at for n, s in setups.items()}
    write_calibration(calibration, tmp_path / "calibration.json")
    loaded = load_calibration(tmp_path / "calibration.json")
    assert restore_session(loaded).alignment_postures == workshop.alignment_postures


def test_joined_sessions_keep_their_postures(workshop):
    setups = {n: replace(s, aligned_at=f"{s.sensor.leg}_max") for n, s in workshop.setups.items()}
    joined = join_sessions([workshop, replace(workshop, setups=setups)])
    own = [name.partition("/")[2] for name in joined.alignment_postures.values()]
    assert own == ["zero"] * len(setups) + [s.aligned_at for s in setups.values()]


def test_an_unknown_posture_is_refused(workshop, tmp_path):
    file = write_session(workshop, tmp_path / "session")
    document = yaml.safe_load(file.read_text("utf-8"))
    name = next(iter(document["setups"]))
    document["setups"][name]["aligned_at"] = "nowhere"
    file.write_text(yaml.safe_dump(document))
    with pytest.raises(SessionError) as caught:
        load_session(file)
    assert caught.value.where == f"{file}: setups.{name}.aligned_at"
    assert "nowhere" in caught.value.problem


OFF_AXIS = (0.004, 0.005, -0.003)
"""Tool position of an alignment posture, [m]."""

PLAN_OFF_AXIS = """
robot: orthoglide
gauge: {{sigma_mm: 0.005, tip: {{{tip}}}}}
postures: {{zero: {{tcp_mm: [0, 0, 0]}}, off_axis: {{tcp_mm: [4, 5, -3]}}}}
setups:
  xy: {{leg: x, direction: y, section: {{fraction: 0.5}}, touches: a, aligned_at: {at}{more}}}
  yz: {{leg: y, direction: z, section: {{fraction: 0.4}}, touches: b, aligned_at: {at}{more}}}
"""
BALL, BLADE = "ball: {radius_mm: 1.5}", "blade: {width_mm: 20}"
"""Tips of a gauge, as keys."""


def displacements(tmp_path, *, tip=BALL, at="off_axis", more=""):
    """Displacements of the tips of a plan, by setup, [m]."""
    file = tmp_path / "session.yaml"
    file.write_text(PLAN_OFF_AXIS.format(tip=tip, at=at, more=more))
    plan = load_plan(file)
    return plan, {name: setup.sensor.beside for name, setup in plan.setups.items()}


def test_a_ball_is_centred_on_the_rod_in_its_alignment_posture(tmp_path):
    """Rods are parallel to their leg, so their lateral position in the section is that of a leg."""
    plan, found = displacements(tmp_path)
    length = plan.robot.legs["x"].length
    for name, leg, lateral, fraction in (("xy", 0, 2, 0.5), ("yz", 1, 0, 0.4)):
        across = np.delete(OFF_AXIS, leg)
        shadow = np.sqrt(length**2 - across @ across)
        slide = OFF_AXIS[leg] + shadow
        expected = np.zeros(3)
        expected[lateral] = (slide - (1.0 - fraction) * length) / shadow * OFF_AXIS[lateral]
        assert abs(expected[lateral]) > 1e-3
        np.testing.assert_allclose(found[name], expected, atol=1e-8)
    # the sheet states the distance from the centre line in the alignment posture
    guidance = guide(plan)
    for motion in plan_motion(plan):
        position = GaugePosition(plan, motion, guidance, ())
        assert np.linalg.norm(position.lateral_offset) < 1e-8
    assert load_session(write_session(plan.with_values([0.0] * 4), tmp_path / "copy")).setups[
        "xy"
    ].sensor.beside == pytest.approx(found["xy"], abs=1e-12)


@pytest.mark.parametrize(
    "keys",
    [{"at": "zero"}, {"tip": BLADE}, {"more": ", beside_mm: [0, 0, 0]"}],
    ids=["aligned in the mechanical zero", "blade", "stated displacement"],
)
def test_other_tips_are_where_the_mechanical_zero_has_the_rod(tmp_path, keys):
    plan, found = displacements(tmp_path, **keys)
    assert set(found.values()) == {(0.0, 0.0, 0.0)}
    copy = load_session(write_session(plan.with_values([-0.0] * 4), tmp_path / "copy"))
    assert "-0" not in (tmp_path / "copy" / "readings.csv").read_text()
    assert {s.sensor.beside for s in copy.setups.values()} == {(0.0, 0.0, 0.0)}
