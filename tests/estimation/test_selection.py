"""What is free: models, globs, tolerances, bounds and known values."""

from __future__ import annotations

import numpy as np
import pytest
from calibrated import identified, session_of

from orthocal import draw_errors
from orthocal.errors import ParameterError
from orthocal.estimation.choice import Choice
from orthocal.estimation.selection import (
    read_bounds,
    read_known,
    read_tolerances,
    select_parameters,
)


@pytest.fixture(scope="module")
def parameters(orthoglide):
    return orthoglide.parameters


@pytest.fixture(scope="module")
def session():
    return session_of("raw-cycles")


def test_the_complete_model_with_priors_is_the_default_and_offsets_have_none(parameters):
    chosen, full = select_parameters(parameters), select_parameters(parameters, model="full")
    assert (chosen.names, chosen.label) == (full.names, "full")
    assert chosen.prior.all()
    offsets = select_parameters(parameters, model="offsets")
    assert offsets.names == ("x_slide.offset", "y_slide.offset", "z_slide.offset")
    assert offsets.label == "offsets"
    assert not offsets.prior.any()


def test_globs_come_instead_of_a_model_or_on_top_of_it(parameters):
    alone = select_parameters(parameters, free=["*.offset", "x_coupler.*"])
    assert len(alone.names) == 3 + 6
    assert alone.label == "*.offset x_coupler.*"
    on_top = select_parameters(parameters, model="full", free=["!y_*", "frame.tcp.x"])
    of_y = sum(n.startswith("y_") for n in parameters.select_model("full"))
    assert len(on_top.names) == 129 - of_y + 1
    assert on_top.label == "full !y_* frame.tcp.x"


def test_a_tolerance_holds_for_what_its_glob_matches(parameters):
    stds = {"*.offset": 2e-3, "x_slide.offset": 1e-3}
    chosen = select_parameters(parameters, model="lengths", prior_stds=stds)
    assert chosen.prior_stds == pytest.approx([1e-3, 2e-3, 2e-3, 1e-4, 1e-4, 1e-4])


def test_known_values_are_held_or_become_a_prior(parameters):
    known = {"x_leg.length": (0.12e-3, 0.02e-3), "y_leg.length": 0.05e-3}
    chosen = select_parameters(parameters, model="offsets", known=known)
    assert chosen.names[-1] == "x_leg.length"
    assert list(chosen.prior) == [False, False, False, True]
    assert chosen.mean[-1] == 0.12e-3
    assert chosen.prior_stds[-1] == 0.02e-3
    assert chosen.fixed == {"y_leg.length": 0.05e-3}


def test_bounds_are_open_where_none_is_given(parameters):
    chosen = select_parameters(parameters, model="offsets", bounds={"x_*.offset": (-1e-3, np.inf)})
    assert chosen.lower[0] == -1e-3
    assert np.isinf(chosen.upper).all()
    assert np.isinf(chosen.lower[1:]).all()


def test_bounds_below_zero_of_a_parameter_that_is_never_negative_are_refused(session):
    parameters = session.with_effects(["backlash"]).robot.parameters
    free = ["*.offset", "x_slide.backlash"]

    def select(low, high):
        return select_parameters(parameters, free=free, bounds={"x_slide.backlash": (low, high)})

    chosen = select(-1e-3, 1e-3)
    assert (chosen.lower[-1], chosen.upper[-1]) == (0.0, 1e-3)
    for high in (-1e-3, 0.0):
        with pytest.raises(ParameterError, match="backlash' is never negative") as raised:
            select(-2e-3, high)
        assert raised.value.where == "bounds"


def test_names_from_an_iterator_are_kept(session):
    names = ["x_slide.offset", "y_slide.offset"]
    choice = Choice(free=iter(names), effects=iter(["backlash"]))
    assert choice == Choice(free=tuple(names), effects=("backlash",))
    assert choice.select(session.robot.parameters).names == tuple(names)
    result = identified(session, Choice(free=iter(names)), profile=iter(names[:1]))
    assert result["x_slide.offset"].interval is not None
    assert list(draw_errors(session.robot, iter(names), seed=0)) == names


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ({"free": ["x_leg.length", "x_coupler.x"]}, "are partly the same error: x_leg.length is"),
        ({"model": "full", "known": {"x_leg.length": 1e-4}}, "are partly the same error"),
        ({"free": ["*.offset", "!*"]}, "nothing to identify"),
        ({"free": ["w_*"]}, r"'w_\*' matches no error parameter"),
        ({"free": ["x_slid.offset"]}, r"did you mean x_slide\.offset"),
        ({"model": "all"}, "'all' is not a model"),
        ({"prior_stds": {"x_leg.length": 1e-4}}, "matches no free parameter"),
        ({"prior_stds": {"*.offset": 1e-12}}, "is 2e-09 mm; expected at least 2e-06 mm"),
        ({"model": "full", "prior_stds": {"x_*": 1e-3}}, "matches parameters in m, ppm and rad"),
        ({"bounds": {"*.offset": (1e-3, -1e-3)}}, "bounds: the lower bound of"),
        ({"known": {"x_slid.offset": 0.0}}, "did you mean x_slide.offset"),
        ({"known": {"x_slide.offset": float("nan")}}, "expected a finite number"),
        ({"known": {"x_slide.offset": (0.0, 0.0)}}, "the tolerance of 'x_slide.offset' is 0"),
    ],
)
def test_choices_that_make_no_sense_are_refused(parameters, choice, message):
    with pytest.raises(ParameterError, match=message):
        select_parameters(parameters, **choice)


def test_a_known_sum_of_zero_has_free_parts(parameters):
    chosen = select_parameters(parameters, model="full", known={"x_leg.length": 0.0})
    assert "x_coupler.x" in chosen.names


def test_texts_carry_their_units(parameters):
    known = read_known(
        ["x_leg.length_mm=0.12±0.04", "x_coupler.rx_mrad=-0.5+-0.2", "y_leg.length_um=7"],
        parameters,
        where="--known",
    )
    tolerances = read_tolerances(["*.offset_mm=4"], parameters, where="-")
    bounds = read_bounds(["x_slide.offset_mm=-2:", "x_coupler.rx_mrad=:1"], parameters, where="-")
    choice = Choice("lengths", known=known, tolerances=tolerances, bounds=bounds)
    selection = choice.select(parameters)
    at = dict(zip(selection.names, range(len(selection.names)), strict=True))
    for name, mean, spread in (
        ("x_leg.length", 0.12e-3, 0.02e-3),
        ("x_coupler.rx", -0.5e-3, 0.1e-3),
        ("x_slide.offset", 0.0, 2e-3),
    ):
        assert selection.mean[at[name]] == pytest.approx(mean)
        assert selection.prior_stds[at[name]] == pytest.approx(spread)
    assert selection.fixed == {"y_leg.length": pytest.approx(7e-6)}
    slide, coupler = at["x_slide.offset"], at["x_coupler.rx"]
    assert (selection.lower[slide], selection.upper[slide]) == (-2e-3, np.inf)
    assert (selection.lower[coupler], selection.upper[coupler]) == (-np.inf, 1e-3)


@pytest.mark.parametrize(
    ("read", "text", "message"),
    [
        (read_known, "x_slide.offset_mm", "expected NAME=VALUE or NAME=VALUE±TOLERANCE"),
        (read_known, "x_slide.offset=1", "carries no unit"),
        (read_known, "x_slide.offset_mm=1±", "expected a number"),
        (read_known, "x_slide.offset_mm=1±a", "expected a number"),
        (read_known, "x_slide.offset_mrad=1", "has the wrong unit"),
        (read_tolerances, "*.offset_mrad=1", "x_slide.offset, which it matches, is in mm"),
        (read_tolerances, "w.offset_mm=1", "matches no error parameter"),
        (read_tolerances, "offset_mm=1", r"'offset_mm' matches no .* mean \*\.offset_mm"),
        (read_bounds, "x_slide.offset_mm=:", "expected NAME=LOWEST:HIGHEST"),
        (read_bounds, "x_slide.offset_mm=1", "expected NAME=LOWEST:HIGHEST"),
        (read_bounds, "x_slide.offset_mm=a:b", "expected a number"),
    ],
)
def test_texts_that_do_not_fit_are_named(parameters, read, text, message):
    with pytest.raises(ParameterError, match=message) as caught:
        read([text], parameters, where="--x")
    assert caught.value.where == "--x"
