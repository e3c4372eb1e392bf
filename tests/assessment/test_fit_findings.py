"""Findings about the parameters of a fit: tolerances, bounds and linearisation."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from calibrated import identified, session_of

from orthocal.assessment.fit_findings import _above_tolerances, _linearisation
from orthocal.units import MM, PPM


@pytest.fixture(scope="module")
def calibration():
    return identified(session_of("raw-cycles"), "offsets")


def test_the_error_of_an_effect_is_compared_with_its_stated_value(calibration):
    robot = session_of("raw-cycles").with_effects(["backlash"]).robot
    stated = replace(
        calibration.free[0], name="x_slide.backlash", mean=0.2 * MM, prior_std=2e-3 * MM
    )

    def find(value_mm):
        return _above_tolerances(
            SimpleNamespace(robot=robot, free=[replace(stated, value=value_mm * MM)])
        )

    assert not find(0.2)
    assert not find(0.205)
    for value, sign in ((0.22, "+"), (0.18, "-")):
        (found,) = find(value)
        assert f"{sign}0.020 mm from its stated value, 5 times its tolerance" in found.text
        expected = {"value_mm": value, "tolerance_mm": 4e-3}
        assert found.numbers == pytest.approx(expected)
    (found,) = _above_tolerances(
        SimpleNamespace(robot=robot, free=[replace(stated, mean=0.0, value=0.02 * MM)])
    )
    assert "is estimated to be 0.020 mm, 5 times its tolerance" in found.text
    expansion = replace(stated, unit="1/K", mean=0.0, value=20 * PPM, prior_std=2 * PPM)
    (found,) = _above_tolerances(SimpleNamespace(robot=robot, free=[expansion]))
    assert "is estimated to be 20.000 ppm/K, 5 times" in found.text
    assert [*found.numbers] == ["value_ppm_per_K", "tolerance_ppm_per_K"]


def test_a_parameter_at_a_bound_does_not_hide_the_linearisation_error(calibration):
    first, second, third = (
        replace(p, value=1e-3, linear=1e-3 + change, std=std)
        for p, change, std in zip(
            calibration.free, (1e-3, 1e-5, 1e-3), (0.0, 1e-5, np.nan), strict=True
        )
    )
    solver = SimpleNamespace(shows_linearisation_error=True)
    (found,) = _linearisation(SimpleNamespace(solver=solver, free=[first, second, third]))
    assert found.places[0].parameter == second.name
    assert found.numbers == pytest.approx({"part_of_std": 1.0})
    assert not _linearisation(SimpleNamespace(solver=solver, free=[first, third]))
