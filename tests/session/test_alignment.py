"""Alignment posture of a gauge: stated or by rule, independent of the order of the rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from calibrated import calibrated, session_of

from orthocal import (
    SessionError,
    assess_tool,
    join_sessions,
    load_calibration,
    load_session,
    restore_session,
    write_calibration,
    write_session,
)
from orthocal.calibration.identify import identify

QUICK = {"solver": "variable-projection"}
ORDER = {"reversed": lambda n: np.arange(n)[::-1], "shuffled": np.random.default_rng(5).permutation}


@pytest.fixture(scope="module")
def workshop():
    return session_of("workshop")


def ordered(session, order):
    """The session with its rows in another order."""
    rows = [session.readings[i] for i in ORDER[order](len(session.readings))]
    return replace(session, readings=tuple(rows))


@pytest.fixture(scope="module")
def calibration():
    return calibrated("workshop", "full", **QUICK)


@pytest.mark.parametrize("order", ORDER)
def test_the_order_of_rows_changes_no_estimate(order, workshop, calibration):
    other, _ = identify(
        ordered(workshop, order),
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
