"""What people read: everything that was promised is there, and is true."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from orthocal.output.text.explanation import advise, explain_fit

from orthocal import Choice, calibrate, load_session, summarize


@pytest.fixture(scope="module")
def table1(root):
    return calibrate(load_session(root / "examples/table1/experiment-2"))


def line(text, beginning):
    return next(row for row in text.splitlines() if row.strip().startswith(beginning))


def test_linear_and_exact_stand_side_by_side(table1):
    row = line(summarize(table1, details=True), "y_slide.offset").split()
    assert row[1:4] == ["+0.599", "+0.592", "0.517"]
    assert row[-3:] == ["-0.0068", "-0.013", "mm"]


def test_every_reading_is_listed_before_and_after(table1):
    text = summarize(table1, details=True)
    assert line(text, "zx").split() == [
        "zx",
        "x_max",
        "−",
        "x_min",
        "-1.140",
        "-1.140",
        "-0.130",
        "-0.5",
        "-0.6",
        "0.6",
    ]
    assert line(text, "r.m.s.").split()[-3:] == ["0.622", "0.195", "-69%"]
    assert line(text, "largest").split()[-3:] == ["1.140", "0.278", "-76%"]


def test_sigma_is_held_against_the_gauges_own(table1):
    text = " ".join(summarize(table1, details=True).split())
    assert "σ of a difference: 0.276 mm, from the residuals, 3 degrees of freedom" in text
    assert "σ given for the gauge: 0.020 mm a reading, 0.028 mm a difference" in text
    assert (
        "is 10 times what the gauge itself would leave (0.028 mm): it is error of the model" in text
    )


def test_it_says_what_to_type_and_what_to_believe(table1):
    text = summarize(table1, details=True)
    entered = text[text.index("What to enter into the controller") :]
    assert line(entered, "z_slide").split() == [*("z_slide", "+0.000", "-1.761", "0.519", "mm")]
    assert "Offsets that must change (95 %, with all that is not known): z_slide." in text


def test_an_unstated_controller_is_said_to_be_so(root):
    text = summarize(calibrate(load_session(root / "examples/table1/experiment-3")), details=True)
    assert "add to the present offset" in text
    assert "does not state the offsets that were active" in text


def _silent(session):
    """The same readings, with no word on the gauge: its cycles tell the noise."""
    return session.with_gauge(replace(session.gauge, sigma=None))


def test_readings_that_fit_are_said_to_fit(raw_cycles):
    sentences = explain_fit(calibrate(_silent(raw_cycles)))
    assert "What remains is what repeated cycles scatter by: the model fits." in sentences


def test_cycles_that_cannot_explain_the_residuals_are_said_to_be_model_error(raw_cycles):
    values = raw_cycles.values.copy()
    for i, r in enumerate(raw_cycles.readings):
        if (r.setup, r.posture) == ("yx", "x_max"):
            values[i] += 0.3e-3  # every time again
    result = calibrate(raw_cycles.with_values(values))
    assert result.noise.source == "residuals"
    assert "times what repeated cycles scatter by" in " ".join(explain_fit(result))


def test_one_wrong_sign_among_cycles_is_pointed_at(raw_cycles):
    """Every single reading of 0.1 mm or more, its sign turned in one cycle of three."""
    turned = 0
    for i, r in enumerate(raw_cycles.readings):
        if abs(r.value) >= 0.1e-3 and i % 4 == 0:
            values = raw_cycles.values.copy()
            values[i] = -values[i]
            text = " ".join(explain_fit(calibrate(raw_cycles.with_values(values))))
            assert f"readings.csv:{r.line}: " in text
            if f"the sign of {r.label}" in text:
                turned += 1
                continue
            assert f"They differ most at {r.label}" in text
            assert "Check these for a wrong sign or row" in text
    assert turned >= 6


def test_a_prior_marks_what_the_readings_leave_open(root):
    result = calibrate(load_session(root / "examples/table1/experiment-2"), "lengths")
    text = summarize(result, details=True)
    assert line(text, "x_leg.length").split()[4] == "0%"
    assert line(text, "x_slide.offset").split()[4] == "99%"
    assert "told: how much of what the tolerance left open" in text
    assert "tolerances as prior" in text


def test_many_readings_are_cut_unless_all_are_asked_for(raw_cycles):
    result = calibrate(raw_cycles)
    long = replace(result, residuals=result.residuals * 3)
    assert "The 20 largest of 162" in summarize(long, details=True)
    assert "The 20 largest" not in summarize(long, all_rows=True)


def test_names_from_files_are_not_markup(table1):
    first = table1.residuals[0].setup
    rows = (replace(table1.residuals[0], setup="[red]y"), *table1.residuals[1:])
    setups = tuple(replace(s, name="[red]y") if s.name == first else s for s in table1.setups)
    titled = replace(table1.session, title="[bold]x[/nonsense]")
    text = summarize(replace(table1, residuals=rows, setups=setups, session=titled), details=True)
    assert "[red]y " in text
    assert "[bold]x[/nonsense]" in text


# ---- whether to enter what was identified


def turn(session, setup):
    values = [-r.value if r.setup == setup else r.value for r in session.readings]
    return session.with_values(values)


def test_sound_readings_are_to_be_entered(raw_cycles):
    assert advise(calibrate(_silent(raw_cycles))) == (
        "Enter these, and measure again. What remains is what repeated cycles scatter by: the "
        "model fits. Measure again with these in the controller (`orthocal again` makes that "
        "session), and hold it against this calibration: `orthocal validate`."
    )


def test_error_of_the_model_is_to_be_measured_again(experiment_2):
    text = advise(calibrate(experiment_2))
    assert text.startswith("Enter these, and measure again. What remains, σ = 0.276 mm ")
    assert "it is error of the model" in text


def test_a_setup_of_the_wrong_sign_is_named_before_anything_is_entered(raw_cycles):
    text = advise(calibrate(turn(raw_cycles, "zx")))
    assert text.startswith(
        "Do not enter these. The readings of setup zx seem to have the wrong sign."
    )
    assert "by 0.402 mm (r.m.s.); with the sign turned by 0.007 mm" in text
    for shown in (False, True):
        summary = summarize(calibrate(turn(raw_cycles, "zx")), details=shown)
        assert "Do not enter these. The readings of setup zx seem" in " ".join(summary.split())


def test_readings_far_beyond_all_tolerances_are_not_to_be_entered(raw_cycles):
    """One leg's readings off by millimetres: the setup that differs most from others is named."""
    wrong = {"x_max": 2e-3, "x_min": -1e-3}
    values = [
        r.value + (wrong.get(r.posture, 0.0) if r.setup == "zx" else 0.0)
        for r in raw_cycles.readings
    ]
    text = advise(calibrate(raw_cycles.with_values(values)))
    assert text.startswith("Do not enter these. ")
    assert "it looks as if setup zx was another one than is said" in text


def test_one_wrong_reading_is_to_be_read_again(raw_cycles):
    values = raw_cycles.values.copy()
    values[4] += 0.2e-3
    text = advise(calibrate(raw_cycles.with_values(values)))
    setup = raw_cycles.readings[4].setup
    assert text.startswith(
        f"Check before you enter these. 1 reading contradicts all others (setup {setup})."
    )
    assert "read it again if it is wrong" in text


def test_readings_that_do_not_repeat_are_to_be_read_again(raw_cycles):
    """One sign of eighteen readings of each cycle: no single reading stands out of so few."""
    two = replace(raw_cycles, readings=tuple(r for r in raw_cycles.readings if r.cycle < 3))
    values = two.values.copy()
    wrong = next(i for i, r in enumerate(two.readings) if (r.setup, r.posture) == ("xz", "z_min"))
    values[wrong] *= -1.0
    spoilt = calibrate(two.with_values(values))
    text = " ".join(explain_fit(spoilt))
    assert "They differ most at xz z_min: " in text
    where = f"readings.csv:{two.readings[wrong].line}."
    assert f"the one that stands apart is in {two.readings_path.parent}/{where}" in text
    text = advise(replace(spoilt, critical=math.inf))
    assert text.startswith("Check before you enter these. Repeated readings scatter by ")
    assert "They differ most at xz z_min: " in text
    assert "Check these for a wrong sign or row before anything is entered" in text


def test_noise_that_only_the_residuals_tell_does_not_confirm_the_model(raw_cycles):
    once = tuple(r for r in raw_cycles.readings if r.cycle == 1)
    silent = replace(raw_cycles, readings=once).with_gauge(replace(raw_cycles.gauge, sigma=None))
    text = advise(calibrate(silent))
    assert text.startswith(
        "Enter these, and measure again. Only what remains says how large the noise is"
    )


def test_without_word_or_check_it_is_said(experiment_2):
    silent = experiment_2.with_gauge(replace(experiment_2.gauge, sigma=None))
    three = replace(silent, readings=silent.readings[1:4])
    assert "nothing tells how far they can be trusted" in advise(calibrate(three))
    given = replace(experiment_2, readings=experiment_2.readings[1:4])
    text = advise(calibrate(given))
    assert text.startswith("Check before you enter these. ")
    assert "none is left to check the model: nothing says whether these are right" in text


def test_nothing_is_advised_where_no_offset_was_identified(raw_cycles):
    assert advise(calibrate(raw_cycles, Choice(free=["x_leg.length"]))) == ""
