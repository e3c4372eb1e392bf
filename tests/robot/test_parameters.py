"""Names, units, tolerances and selections of error parameters."""

from __future__ import annotations

import pytest
from linkages import joint, make_robot
from models import JOINTS


def test_joints_and_drives_have_the_designed_126_parameters(orthoglide):
    p = orthoglide.parameters
    full = p.select(JOINTS)
    assert len(full) == 126

    # of 21 × 6 components the three along the drives are left out: the offsets are the same
    assert "x_slide.x" not in p
    assert "x_slide.y" in full
    assert p.select_model("lengths") == (
        *p.select_model("offsets"),
        "x_leg.length",
        "y_leg.length",
        "z_leg.length",
    )


def test_patterns_add_and_take_out_in_their_order(orthoglide):
    p = orthoglide.parameters
    assert p.select(["*.offset", "!y_*"]) == ("x_slide.offset", "z_slide.offset")
    assert p.select(["!y_*", "*.offset"]) == tuple(f"{k}_slide.offset" for k in "xyz")


def test_a_name_with_the_characters_of_a_glob_matches_itself(tmp_path):
    yaml = "closed_loop: []\ntype: []\nname_mot: ['j[0]', j0]\n"
    overrides = "orthocal: {tolerances: {overrides: {'j[0].offset_mm': 3}}}\n"
    slides = [joint(n, "base", (0, 0, 0), "x", kind="prismatic") for n in ("j[0]", "j0")]
    p = make_robot(tmp_path / "slides", "".join(slides), yaml + overrides).parameters
    assert p.select(["j[0].offset"]) == ("j[0].offset",)
    assert p.select(["j[0].off*"]) == ("j0.offset",)
    assert p.select_model("full")[:2] == ("j[0].offset", "j0.offset")
    assert p["j[0].offset"].prior_std == pytest.approx(1.5e-3)
    assert p["j0.offset"].prior_std == pytest.approx(5e-3)


def test_units_are_part_of_the_names_in_files(orthoglide):
    p = orthoglide.parameters
    assert p.read_quantity("x_slide.offset_mm", 1.5) == ("x_slide.offset", 0.0015)
    assert p.read_quantity("x_coupler.rx_mrad", 2.0) == ("x_coupler.rx", 0.002)
    assert p.read_quantity("x_slide.scale_ppm", 3.0) == ("x_slide.scale", 3e-6)


def test_named_sums_spread_over_their_elementary_errors(orthoglide):
    p = orthoglide.parameters
    found = p.expand({"x_leg.length": 1e-3, "x_coupler.x": 1e-4})
    assert found == {"x_coupler.x": 1.1e-3, "frame.x_rod_b_tip.x": 1e-3}
