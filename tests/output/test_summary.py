"""Answer and details of a calibration: numbers of tables and sentences."""

from __future__ import annotations

from dataclasses import replace

import pytest
from calibrated import EXPERIMENT_2, UNJUDGED, calibrated
from rich.text import Text

from orthocal import calibrate, draw_errors, simulate_session, summarize
from orthocal.assessment.fit_findings import describe_gauge
from orthocal.output.text.summary import result_json
from orthocal.planning.plan import MeasuringPlan

pytestmark = pytest.mark.usefixtures("without_sensor_gains")


@pytest.fixture(scope="module")
def table1():
    return calibrated(EXPERIMENT_2)


def line(text, beginning):
    return next(row for row in text.splitlines() if row.strip().startswith(beginning))


def test_linear_and_exact_estimates_are_in_one_row(table1):
    row = line(summarize(table1, details=True), "y_slide.offset").split()
    assert row[1:4] == ["+0.599", "+0.592", "3.127"]
    assert row[-3:] == ["-0.0068", "-0.007", "mm"]


def test_every_reading_is_listed_before_and_after(table1):
    text = summarize(table1, details=True)
    row = line(text, "zx").split()
    assert row == "zx x_max − x_min -1.140 -1.140 -0.130 -0.5 -0.6 0.6".split()
    assert line(text, "RMS [mm]").split()[-3:] == ["0.622", "0.195", "-69%"]
    assert line(text, "largest").split()[-3:] == ["1.140", "0.278", "-76%"]


def test_sigma_is_compared_with_that_of_the_gauge(table1):
    text = " ".join(summarize(table1, details=True).split())
    assert "σ of a difference: 0.276 mm, from the residuals, 3 degrees of freedom" in text
    assert "σ stated for the gauge: 0.020 mm a reading, 0.028 mm a difference" in text
    (found,) = table1.assessment.of_kind("model error")
    assert found.numbers["ratio"] == pytest.approx(10.0, abs=0.3)
    assert found.text in " ".join(text.split())


def test_details_list_the_values_to_enter_and_significant_changes(table1):
    text = summarize(table1, details=True)
    assert line(text, "z_slide").split() == [*("z_slide", "+0.000", "-1.761", "3.140", "mm")]
    (found,) = table1.assessment.of_kind("not significant")
    assert {p.parameter for p in found.places} == {"x_slide", "y_slide", "z_slide"}
    assert found.text in " ".join(text.split())


def test_json_of_another_result_is_refused():
    with pytest.raises(TypeError, match="found a str; expected a Calibration, a Validation"):
        result_json("calibration.json")


def test_all_rows_of_a_plan_include_its_details(monkeypatch):
    shown = []
    monkeypatch.setattr(
        "orthocal.output.text.plan.render_plan",
        lambda plan, *, details: shown.append(details) or Text(),
    )
    plan = object.__new__(MeasuringPlan)
    for details, all_rows in ((False, False), (False, True), (True, False)):
        summarize(plan, details=details, all_rows=all_rows)
    assert shown == [False, True, True]


def test_an_unstated_controller_is_noted():
    result = calibrated("table1/experiment-3")
    (found,) = result.assessment.of_kind("controller not stated")
    text = " ".join(summarize(result, details=True).split())
    assert found.text in " ".join(text.split())
    assert result.assessment.entries[0].active is None


def _silent(session):
    """The session without a stated noise: that of its cycles remains."""
    return session.with_gauge(replace(session.gauge, sigma=None))


def every_time(session):
    """A machine with errors of three times their tolerances; only offsets are identified."""
    errors = draw_errors(session.robot, ["*.rx", "*.ry", "*.rz", "*.length"], seed=1)
    larger = {name: 3.0 * value for name, value in errors.items()}
    return calibrate(simulate_session(session, larger, seed=1).session, "offsets", **UNJUDGED)


def once(session):
    rows = tuple(r for r in session.readings if r.cycle == 1)
    return calibrate(_silent(replace(session, readings=rows)), **UNJUDGED)


def three_rows(session):
    return calibrate(_silent(replace(session, readings=session.readings[1:4])), **UNJUDGED)


def three_stated_rows(session):
    return calibrate(replace(session, readings=session.readings[1:4]), **UNJUDGED)


EXPLAINED = {
    "fits": (lambda c, e: calibrate(_silent(c), **UNJUDGED), {"sigma_mm": 0.0102}),
    "gauge overstated": (
        lambda c, e: calibrate(c.with_gauge(replace(c.gauge, sigma=5e-5)), "full", **UNJUDGED),
        {"ratio": 0.195, "gauge_sigma_mm": 0.05},
    ),
    "model error": (lambda c, e: calibrated(EXPERIMENT_2), {"ratio": 9.8, "sigma_mm": 0.195}),
    "model error beside cycles": (lambda c, e: every_time(c), {"ratio": 6.27}),
    "noise from residuals": (lambda c, e: once(c), {}),
    "noise unknown": (lambda c, e: three_rows(e), {"sigma_mm": 0.0104}),
    "no redundancy": (lambda c, e: three_stated_rows(e), {"parameters": 3.0}),
}
"""Kinds of findings that explain a fit, the calibration, and numbers."""


@pytest.mark.parametrize("case", EXPLAINED)
def test_a_fit_is_explained(raw_cycles, experiment_2, case):
    make, numbers = EXPLAINED[case]
    result = make(raw_cycles, experiment_2)
    (found,) = result.assessment.of_kind(case.removesuffix(" beside cycles"))
    assert result.assessment.decision.verdict == "enter"
    assert all(f.severity == "note" for f in result.assessment.findings)
    for name, value in numbers.items():
        assert found.numbers[name] == pytest.approx(value, rel=0.02)
    assert " ".join(found.text.split()) in " ".join(summarize(result, details=True).split())


@pytest.mark.parametrize(
    ("joined", "names", "attribute"),
    [
        (False, ("",), ""),
        (False, ("dial", "bar"), " of the gauge 'dial'"),
        (True, ("second",), ""),
        (True, ("second", "first"), " of session second"),
        (True, ("second/dial", "first/dial"), " of the gauge 'dial' of session second"),
    ],
)
def test_a_gauge_of_several_is_named(table1, joined, names, attribute):
    gauges = tuple(replace(table1.gauges[0], name=name) for name in names)
    record = replace(table1.session, parts=(table1.session,) * (2 * joined))
    calibration = replace(table1, gauges=gauges, session=record)
    assert describe_gauge(calibration, names[0]) == attribute


def test_a_prior_marks_what_the_readings_leave_open():
    result = calibrated(EXPERIMENT_2, "lengths")
    text = summarize(result, details=True)
    assert line(text, "x_leg.length").split()[4] == "0%"
    assert line(text, "x_slide.offset").split()[4] == "96%"
    assert "resolved: how much the readings improved a value" in text
    assert "tolerances as prior" in text


def test_many_readings_are_cut_unless_all_are_asked_for():
    result = calibrated("raw-cycles")
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
