"""Plots show the numbers of the calibration, and a page can hold several of them."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from calibrated import EXPERIMENT_2, UNJUDGED, calibrated, identified, session_of
from scipy import stats

from orthocal import Choice
from orthocal.output.report import figure as style
from orthocal.output.report import parameter_plots, reading_plots, study_plots
from orthocal.output.report.page import _correlations
from orthocal.output.text import layout
from orthocal.output.text.tables import render_fit, render_readings
from orthocal.study.bootstrap import BootstrapSummary, Scatter
from orthocal.study.sensitivity import SensitivitySummary
from orthocal.units import MM

PLOTS = (
    reading_plots.plot_residuals,
    reading_plots.plot_setups,
    reading_plots.plot_spread,
    parameter_plots.plot_linearised,
    parameter_plots.plot_parameters,
    parameter_plots.plot_correlations,
    parameter_plots.plot_singular_values,
)

SVG = "{http://www.w3.org/2000/svg}"
HREF = "{http://www.w3.org/1999/xlink}href"

UNIT = 1e-12
"""[mm, σ, %] Numbers of which only the unit was changed."""

PLACE = 1e-3
"""[pt] Positions in a file, which has six decimals of them."""

QUANTILE = 1e-9
"""[1] Normal quantiles by two routes."""

LARGEST = 250_000
"""[byte] Of a plot, however many readings there are."""

NAMES = ("$\\frac{$", "<b>&\"'", "机器", "bell\x07", "n" * 200)
"""Names that a file may contain."""


@pytest.fixture(scope="module")
def table1():
    return calibrated(EXPERIMENT_2)


@pytest.fixture(scope="module")
def sweep():
    return calibrated("sweep", "full", **UNJUDGED)


@pytest.fixture(scope="module")
def raw():
    return calibrated("raw-cycles")


@pytest.fixture(scope="module")
def bound(experiment_2):
    choice = Choice(bounds={"x_slide.offset_m": (-0.1e-3, 0.1e-3)})
    return identified(experiment_2, choice)


@pytest.fixture(scope="module")
def unknown(experiment_2):
    """A single reading with unknown noise."""
    session = experiment_2.select(experiment_2.readings[:1])
    return identified(session.with_gauge(replace(session.gauge, sigma=None)), "full")


@pytest.fixture(scope="module")
def many(sweep):
    """More than 12,000 readings, each with a spread of its own."""
    noise = np.random.default_rng(3).normal(0.0, sweep.sigma, (75, len(sweep.residuals)))
    rows = [
        replace(r, cycle=k + 1, measured=r.measured + float(noise[k, i]))
        for k in range(75)
        for i, r in enumerate(sweep.residuals)
    ]
    return replace(sweep, residuals=tuple(rows))


@pytest.fixture(scope="module")
def drawn(table1, unknown):
    """Every plot of a calibration, and some of another one."""
    others = (plot(unknown) for plot in PLOTS[::2])
    return [*[plot(table1) for plot in PLOTS], *filter(None, others)]


def worst(row):
    """Sorts the largest residual to the front."""
    return -abs(row.measured - row.predicted)


def line(axes, label):
    """x and y of the markers with a label."""
    found = next(a for a in axes.lines if str(a.get_label()).startswith(label))
    return np.asarray(found.get_xdata(), float), np.asarray(found.get_ydata(), float)


def segments(axes):
    """Ends of horizontal lines, shape (n, 2), and where they are."""
    ends = np.array(axes.collections[0].get_segments())
    return ends[:, :, 0], ends[:, 0, 1]


def row_names(axes):
    return [t.get_text() for t in axes.get_yticklabels()]


def title(figure):
    return figure.texts[0].get_text()


def texts(svg):
    return ["".join(e.itertext()) for e in ElementTree.fromstring(svg).iter(f"{SVG}text")]


def test_plots_are_inline_elements_that_scale_and_have_a_title(drawn):
    for svg in drawn:
        assert svg.startswith("<svg ")
        assert svg.endswith("</svg>")
        root = ElementTree.fromstring(svg)
        assert root.get("role") == "img"
        assert len(root.get("aria-label")) > 20
        assert root[0].tag == f"{SVG}title"
        assert root[0].text == root.get("aria-label")
        assert root.get("width") is None
        assert root.get("height") is None
        assert root.get("viewBox").startswith("0 0 518.4 ")
        assert root.get("style").startswith("width:720px;max-width:100%;height:auto")


def test_plots_refer_to_nothing_outside_and_do_not_style_the_page(drawn):
    for svg in drawn:
        inside = re.sub(r'xmlns(:\w+)?="[^"]*"', "", svg)
        assert "http" not in inside
        assert "<!--" not in svg
        tags = {e.tag.removeprefix(SVG) for e in ElementTree.fromstring(svg).iter()}
        assert tags.isdisjoint({"style", "metadata", "script", "image", "a"})
        assert "text" in tags  # not drawn as outlines


def test_ids_do_not_collide_on_one_page_and_all_references_are_kept(drawn):
    seen = set()
    for svg in drawn:
        elements = list(ElementTree.fromstring(svg).iter())
        ids = [e.get("id") for e in elements if e.get("id")]
        assert len(set(ids)) == len(ids)
        assert seen.isdisjoint(ids)
        seen.update(ids)
        used = [e.get(HREF).removeprefix("#") for e in elements if e.get(HREF)]
        used += re.findall(r"url\(#([^)]*)\)", svg)
        assert used
        assert set(used) <= set(ids)


def test_settings_of_matplotlib_are_neither_used_nor_changed(table1):
    usual = reading_plots.plot_residuals(table1)
    with matplotlib.rc_context({"font.size": 20.0, "svg.fonttype": "path", "axes.grid": True}):
        before = dict(matplotlib.rcParams)
        assert reading_plots.plot_residuals(table1) == usual
        assert dict(matplotlib.rcParams) == before


def test_pyplot_is_not_needed(root):
    assert not [p for p in (root / "orthocal").rglob("*.py") if "pyplot" in p.read_text()]


def test_names_from_files_are_shown_unchanged(table1):
    rows = [
        replace(r, setup=NAMES[i % 5], posture=NAMES[(i + 1) % 5], minus=None)
        for i, r in enumerate(table1.residuals)
    ]
    names = [f"{name}.offset" for name in NAMES[:3]]
    parameters = [replace(p, name=n) for p, n in zip(table1.parameters, names, strict=True)]
    setups = tuple(replace(table1.setups[0], name=name) for name in NAMES)
    strange = replace(table1, setups=setups, residuals=tuple(rows), parameters=tuple(parameters))
    found = {}
    for plot in PLOTS:
        svg = plot(strange)
        assert "<b>" not in svg
        assert "\x07" not in svg
        found[plot.name] = set(texts(svg)) if svg else set()
    assert {"$\\frac{$ <b>&\"'", "<b>&\"' 机器", "机器 bell\\x07"} <= found["residuals"]
    shown = found["setups"]
    assert {"$\\frac{$", "<b>&\"'", "机器", "bell\\x07"} <= shown
    (long,) = (t for t in shown if t.startswith("nnn"))
    assert long == "n" * 22 + "…" + "n" * 21
    assert set(names) <= found["parameters"]
    assert set(names) <= found["correlations"]


def test_long_names_remain_distinct_and_leave_space_for_the_plot(table1):
    long = "left_front_upper_arm_parallelogram_bar_link_{}".format
    parameters = tuple(replace(p, name=long(p.name)) for p in table1.parameters)
    matrix = parameter_plots.plot_correlations.figure(replace(table1, parameters=parameters))
    assert len(set(row_names(matrix.axes[0]))) == 2
    names, rows = tuple(map(long, range(6))), tuple((long(i), "yx") for i in range(12))
    changes = np.ones((12, 6)) * MM
    summary = SensitivitySummary(rows, names, ("mm/mm",) * 6, changes, changes)
    figure = study_plots.plot_sensitivity.figure(summary)
    figure.draw_without_rendering()
    axes = figure.axes[0]
    assert len({t.get_text() for t in axes.get_xticklabels()}) == 6
    assert axes.get_position().height * figure.get_figheight() > 12 * 0.1  # rows of readable names
    scatter = [Scatter(SimpleNamespace(name=n), *[MM] * 7) for n in names]
    figure = study_plots.plot_bootstrap.figure(BootstrapSummary(10, MM, tuple(scatter), None))
    assert max(map(len, row_names(figure.axes[0]))) == layout.LONGEST_NAME


def test_intervals_of_the_bootstrap_are_named_with_the_number_of_parameters():
    scatter = [
        Scatter(SimpleNamespace(name=f"p{i}"), 0.0, MM, MM, -MM, MM, MM, MM) for i in range(41)
    ]
    figure = study_plots.plot_bootstrap.figure(BootstrapSummary(10, MM, tuple(scatter), None))
    (axes,) = figure.axes
    assert title(figure).endswith("the first 40 of 41 parameters")
    assert axes.get_xlabel() == "draw − estimate [predicted standard deviation]"
    assert axes.get_legend_handles_labels()[1] == [
        *("predicted interval", "95 % of the draws", "estimate")
    ]


@pytest.mark.parametrize(
    ("largest", "ends"), [(4.1, [0.1, 1.0, 5.0]), (2.0, [0.1, 2.0]), (0.6, [0.01, 0.1, 1.0])]
)
def test_colours_of_sensitivities_have_a_scale_with_name_and_ends(largest, ends):
    changes = np.array([[largest, -0.3]]) * MM
    summary = SensitivitySummary((("zero", "yx"),), ("a", "b"), ("mm/mm",) * 2, changes, changes)
    bar = study_plots.plot_sensitivity.figure(summary).axes[1]
    assert bar.get_ylabel() == f"change [µm], logarithmic beyond ±{ends[0] * 1e3:g}"
    ticks = np.array([*-np.array(ends)[::-1], 0.0, *ends]) * 1e3
    np.testing.assert_allclose(np.sort(bar.get_yticks()), ticks)
    np.testing.assert_allclose(bar.get_ylim(), ticks[[0, -1]])


def test_tool_errors_of_exact_machines_and_their_prediction_are_on_the_axis():
    table = SimpleNamespace(columns={"before_um": [0.0, 0.0], "tool_um": [3.0, np.nan]})
    (axes,) = study_plots.plot_machines.figure(table, 70.0).axes
    low, high = axes.get_xlim()
    assert 1e-5 < low < line(axes, "before")[0].min()
    assert high > 70.0
    assert axes.get_ylim()[0] == 0.0


def test_readings_are_listed_before_and_after_the_largest_residual_first(table1):
    figure = reading_plots.plot_residuals.figure(table1)
    axes = figure.axes[0]
    rows = sorted(table1.residuals, key=worst)
    assert row_names(axes) == [r.label for r in rows]
    assert row_names(axes)[0] == "xy y_max − y_min"
    bottom, top = axes.get_ylim()
    assert bottom > top  # the first row is the highest
    for label, values in (
        ("before", [r.measured - r.nominal for r in rows]),
        ("after", [r.measured - r.predicted for r in rows]),
    ):
        x, y = line(axes, label)
        np.testing.assert_allclose(x, np.array(values) * 1e3, atol=UNIT)
        np.testing.assert_array_equal(y, np.arange(6))
    low, high = axes.get_xlim()
    assert low < -1.14
    assert high > 2.0 * table1.sigma * 1e3
    assert axes.get_xlabel() == "measured − model [mm]"


def test_markers_in_the_file_are_where_the_deviations_are(table1):
    root = ElementTree.fromstring(reading_plots.plot_residuals(table1))
    found = [e for e in root.iter(f"{SVG}use") if "#e69f00" in e.get("style", "")]
    assert len(found) == 7  # six readings, and one in the legend
    by_height = sorted(found, key=lambda e: float(e.get("y")))[1:]
    place = np.array([float(e.get("x")) for e in by_height])
    values = [r.deviation for r in sorted(table1.residuals, key=worst)]
    slope, start = np.polyfit(values, place, 1)
    assert slope > 0.0
    assert np.abs(start + slope * np.array(values) - place).max() < PLACE


def test_the_band_is_two_sigma_of_each_row(table1):
    mixed = [replace(r, minus=r.minus if i < 3 else None) for i, r in enumerate(table1.residuals)]
    mixed_up = replace(table1, residuals=tuple(mixed), rows_are_differences=False)
    for calibration, word in ((table1, "difference"), (mixed_up, "row")):
        axes = reading_plots.plot_residuals.figure(calibration).axes[0]
        (band,) = axes.containers
        assert band.get_label() == f"±2 σ of a {word}"
        rows = sorted(calibration.residuals, key=worst)
        sigma = np.array([table1.sigma / (1.0 if r.minus else np.sqrt(2)) for r in rows]) * 1e3
        left = np.array([bar.get_x() for bar in band])
        width = np.array([bar.get_width() for bar in band])
        np.testing.assert_allclose(left, -2.0 * sigma, atol=UNIT)
        np.testing.assert_allclose(width, 4.0 * sigma, atol=UNIT)


def test_of_many_readings_the_largest_are_shown_with_a_note(sweep):
    figure = reading_plots.plot_residuals.figure(sweep)
    assert title(figure) == "Readings before and after calibration: the 40 largest residuals of 162"
    x, _ = line(figure.axes[0], "before")
    rows = sorted(sweep.residuals, key=worst)[:40]
    np.testing.assert_allclose(x, [r.deviation * 1e3 for r in rows], atol=UNIT)


def test_a_wrong_reading_comes_first_although_the_machine_deviated_more_before(sweep):
    best = min(sweep.residuals, key=lambda r: abs(r.deviation))
    wrong = replace(best, predicted=best.measured - 0.1e-3)
    rows = tuple(wrong if r is best else r for r in sweep.residuals)
    assert sorted(abs(r.deviation) for r in rows)[-reading_plots.MAX_ROWS] > 0.1e-3
    calibration = replace(sweep, residuals=rows)
    x, _ = line(reading_plots.plot_residuals.figure(calibration).axes[0], "after")
    np.testing.assert_allclose(x[0], 0.1, atol=UNIT)
    listed = layout.to_text(render_readings(calibration, all_rows=True, worst_first=True))
    first = listed.splitlines()[2].split()
    assert first[0] == wrong.setup
    assert "+0.100" in first


def test_plots_of_many_readings_stay_small(many):
    for name in ("residuals", "setups", "spread"):
        plot = getattr(reading_plots, f"plot_{name}")
        assert len(plot(many)) < LARGEST


def test_an_unknown_noise_is_named_once(unknown):
    assert "correlations are unknown, because the noise" in _correlations(unknown)
    assert layout.to_text(render_fit(unknown)).rstrip().endswith("σ of a difference: unknown")


def test_cycles_are_named_where_there_are_some(raw, table1):
    names = row_names(reading_plots.plot_residuals.figure(raw).axes[0])
    assert names[0] == "xy zero, cycle 3"
    assert all(", cycle " in n for n in names)
    assert not any(
        "cycle" in n for n in row_names(reading_plots.plot_residuals.figure(table1).axes[0])
    )


def test_setups_are_sorted_by_their_residuals(raw):
    figure = reading_plots.plot_setups.figure(raw)
    axes = figure.axes[0]
    names = row_names(axes)
    assert sorted(names) == sorted({r.setup for r in raw.residuals})

    def rms(name, attribute):
        values = [getattr(r, attribute) * 1e3 for r in raw.residuals if r.setup == name]
        return np.sqrt(np.mean(np.square(values)))

    for label, attribute, shift in (
        ("before", "deviation", -0.2),
        ("after", "residual", 0.0),
        ("predicted", "prediction_error", 0.2),
    ):
        x, y = line(axes, label)
        np.testing.assert_allclose(x, [rms(n, attribute) for n in names], rtol=UNIT)
        np.testing.assert_allclose(y, np.arange(6) + shift, atol=UNIT)
    after, _ = line(axes, "after")
    assert (np.diff(after) <= 0.0).all()
    np.testing.assert_allclose(line(axes, "σ of a reading")[0], raw.sigma * 1e3, atol=UNIT)
    assert axes.get_xscale() == "log"
    looks = [(a.get_marker(), a.get_color()) for a in axes.lines[:3]]
    assert len({marker for marker, _ in looks}) == len({colour for _, colour in looks}) == 3


def test_setups_that_no_other_predicts_have_no_such_marker(table1, unknown):
    def forget(row):
        return replace(row, prediction_error=np.nan) if row.setup in ("xy", "zy") else row

    calibration = replace(table1, residuals=tuple(map(forget, table1.residuals)))
    axes = reading_plots.plot_setups.figure(calibration).axes[0]
    _, y = line(axes, "predicted")
    names = row_names(axes)
    assert {names[round(v - 0.2)] for v in y} == {"yx", "zx", "xz", "yz"}
    labels = [a.get_label() for a in reading_plots.plot_setups.figure(unknown).axes[0].lines]
    assert labels == ["before", "after"]


def test_the_worst_of_many_setups_are_shown(sweep, monkeypatch):
    monkeypatch.setattr(reading_plots, "MAX_ROWS", 5)
    figure = reading_plots.plot_setups.figure(sweep)
    assert title(figure).endswith("the 5 worst of 18")
    assert len(row_names(figure.axes[0])) == 5


def test_setups_without_any_error_stay_on_a_logarithmic_axis(table1):
    rows = tuple(replace(r, predicted=r.measured, nominal=r.measured) for r in table1.residuals)
    axes = reading_plots.plot_setups.figure(replace(table1, residuals=rows)).axes[0]
    assert (line(axes, "after")[0] == reading_plots.SMALLEST_LENGTH / MM).all()
    low, high = axes.get_xlim()
    assert 0.0 < low < reading_plots.SMALLEST_LENGTH * 1e3 < table1.sigma * 1e3 < high


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.3, 0.4], [0.2, 0.5]),
        ([0.12, 1.14], [0.1, 0.2, 0.5, 1.0, 2.0]),
        ([2e-3, 0.4], [1e-3, 1e-2, 1e-1, 1.0]),
        ([1.0, 1.0], [0.5, 1.0, 2.0]),
    ],
)
def test_logarithmic_axes_have_round_ticks_on_both_sides(values, expected):
    with style.house_style():
        axes = style.open_figure(3.0, "").subplots()
        style.scale_log(axes, "x", np.array(values))
        np.testing.assert_allclose(axes.get_xticks(), expected)
        np.testing.assert_allclose(axes.get_xlim(), [expected[0], expected[-1]])


def test_ticks_of_many_decades_do_not_crowd():
    with style.house_style():
        axes = style.open_figure(3.0, "").subplots()
        style.scale_log(axes, "y", np.array([1e-13, 20.0]))
        assert 5 <= len(axes.get_yticks()) <= 9
        assert axes.get_ylim()[0] < 1e-13
        assert axes.get_ylim()[1] > 20.0


def test_residuals_are_plotted_against_normal_quantiles(raw):
    axes = reading_plots.plot_spread.figure(raw).axes[0]
    x, y = line(axes, "residuals after: 54")
    np.testing.assert_allclose(y, np.sort([r.residual * 1e3 for r in raw.residuals]), atol=UNIT)
    np.testing.assert_allclose(x, stats.norm.ppf((np.arange(54) + 0.5) / 54), atol=QUANTILE)
    assert (y[np.abs(x) < 1.0].max()) < 2.0 * raw.sigma * 1e3


def test_rows_of_several_gauges_are_compared_with_their_own_noise():
    """A dial of 0.01 mm beside one that scatters 60 times as much."""
    joined = identified([session_of("raw-cycles"), session_of("workshop")])
    sigma = {g.name: g.noise.sigma for g in joined.gauges}
    assert len({round(s, 9) for s in sigma.values()}) == 2
    own = [r.residual / sigma[r.setup.partition("/")[0]] for r in joined.residuals]
    axes = reading_plots.plot_spread.figure(joined).axes[0]
    _, y = line(axes, f"residuals after: {len(own)}")
    np.testing.assert_allclose(y, np.sort(own), atol=UNIT)
    assert axes.get_ylabel() == "residual after [σ of its gauge]"
    (band,) = reading_plots.plot_residuals.figure(joined).axes[0].containers
    assert len({round(b.get_width(), 9) for b in band}) == 2
    shown = layout.to_text(render_readings(joined, all_rows=True))
    rows = [text.split() for text in shown.splitlines() if "/" in text]
    assert all(f"{v:+.1f}" in cells for v, cells in zip(own, rows, strict=True))


def test_lines_of_the_spread_are_sigma_less_what_was_fitted(table1, raw):
    for calibration in (table1, raw):
        axes = reading_plots.plot_spread.figure(calibration).axes[0]
        word = "difference" if calibration is table1 else "reading"
        x, y = line(axes, f"σ of a {word}: {calibration.sigma * 1e3:.2g} mm")
        slope = y[1] / x[1]
        part = np.sqrt(calibration.noise.residual_dof / len(calibration.residuals))
        np.testing.assert_allclose(slope, calibration.sigma * 1e3 * part, rtol=UNIT)
        given_x, given_y = line(axes, "σ stated for the gauge")
        given = calibration.gauges[0].sigma * calibration.row_factor
        np.testing.assert_allclose(
            given_y[1] / given_x[1] / slope, given / calibration.sigma, rtol=UNIT
        )
    # where σ is from the residuals, that is their root mean square
    x, y = line(reading_plots.plot_spread.figure(table1).axes[0], "σ of a difference")
    np.testing.assert_allclose(y[1] / x[1], table1.rms_after * 1e3, rtol=QUANTILE)


def test_differences_count_as_readings_where_both_are(table1):
    rows = [replace(r, minus=None if i else r.minus) for i, r in enumerate(table1.residuals)]
    calibration = replace(table1, residuals=tuple(rows), rows_are_differences=False)
    _, y = line(reading_plots.plot_spread.figure(calibration).axes[0], "residuals")
    own = [r.residual * 1e3 / (np.sqrt(2) if i == 0 else 1.0) for i, r in enumerate(rows)]
    np.testing.assert_allclose(y, np.sort(own), atol=UNIT)


def test_of_many_residuals_the_outermost_all_stay(many):
    x, y = line(reading_plots.plot_spread.figure(many).axes[0], "residuals after: 500 of 12150")
    assert x.size == reading_plots.MAX_POINTS
    values = np.sort([r.residual * 1e3 for r in many.residuals])
    np.testing.assert_allclose(y[:100], values[:100], atol=UNIT)
    np.testing.assert_allclose(y[-100:], values[-100:], atol=UNIT)
    assert (np.diff(x) > 0.0).all()


def test_unknown_noise_has_neither_band_nor_line(unknown):
    assert not reading_plots.plot_residuals.figure(unknown).axes[0].containers
    assert len(reading_plots.plot_spread.figure(unknown).axes[0].lines) == 1


def test_error_of_linearising_is_in_sigma_the_largest_first(sweep):
    figure = parameter_plots.plot_linearised.figure(sweep)
    axes = figure.axes[0]
    x, _ = line(axes, "exact − linearised")
    free = sweep.free
    every = np.array([(p.value - p.linear) / p.std for p in free])
    np.testing.assert_allclose(np.abs(x), np.sort(np.abs(every))[::-1][:20], atol=UNIT)
    worst = free[int(np.abs(every).argmax())]
    cost = f"{(worst.value - worst.linear) * 1e3:+.4f}".replace("-", "−")
    assert row_names(axes)[0] == f"{worst.name} ({cost} mm)"
    limits = [a.get_xdata()[0] for a in axes.lines if a.get_linestyle() == ":"]
    assert limits == [-0.1, 0.1]
    assert axes.get_xlim()[0] < -0.1
    assert axes.get_xlim()[1] > 0.1


def test_the_linearised_solution_is_omitted_if_it_is_not_comparable(table1, bound, unknown):
    assert parameter_plots.plot_linearised(table1)
    assert parameter_plots.plot_linearised(unknown) == ""
    robust = replace(table1, solver=replace(table1.solver, loss="huber"))
    assert parameter_plots.plot_linearised(robust) == ""
    assert [p.name for _, p in parameter_plots._linearisation_shifts(bound)] == [
        *("y_slide.offset", "z_slide.offset")
    ]
    first, *rest = table1.parameters
    open_one = replace(table1, parameters=(replace(first, std=np.inf), *rest))
    assert [p.name for _, p in parameter_plots._linearisation_shifts(open_one)] == [
        p.name for p in rest
    ]


def test_few_parameters_are_in_their_units(table1):
    figure = parameter_plots.plot_parameters.figure(table1)
    (axes,) = figure.axes  # without a prior the readings told all
    assert axes.get_xlabel() == "estimate [mm]"
    assert row_names(axes) == ["x_slide.offset", "y_slide.offset", "z_slide.offset"]
    x, _ = line(axes, "estimate")
    np.testing.assert_allclose(x, [p.value * 1e3 for p in table1.free], atol=UNIT)
    ends, y = segments(axes)
    intervals = np.array(table1.intervals) * 1e3
    np.testing.assert_allclose(ends, intervals, atol=UNIT)
    np.testing.assert_array_equal(y, np.arange(3))
    assert not axes.containers


def test_many_parameters_are_in_tolerances_the_best_determined_first(sweep):
    figure = parameter_plots.plot_parameters.figure(sweep)
    axes, beside = figure.axes
    assert (
        title(figure)
        == "Estimates with 95 % intervals: 30 of 129, offsets, then the best determined"
    )
    assert axes.get_xlabel() == "estimate [tolerance]"
    names = row_names(axes)
    assert len(names) == 30
    assert all(n.endswith(".offset") for n in names[:3])
    shares = [sweep[n].data_share for n in names]
    assert (np.diff(shares[3:]) <= 0.0).all()
    others = [p.data_share for p in sweep.free if p.name not in names]
    assert max(others) <= shares[-1]
    x, _ = line(axes, "estimate")
    scale = np.array([0.5 / sweep[n].prior_std for n in names])
    np.testing.assert_allclose(x, [sweep[n].value for n in names] * scale, atol=UNIT)
    ends, _ = segments(axes)
    own = dict(zip([p.name for p in sweep.free], sweep.intervals, strict=True))
    intervals = np.array([own[n] for n in names]) * scale[:, None]
    np.testing.assert_allclose(ends, intervals, atol=UNIT)
    (band,) = axes.containers
    assert [(b.get_x(), b.get_width()) for b in band] == [(-1.0, 2.0)] * 30
    widths = [b.get_width() for b in beside.containers[0]]
    np.testing.assert_allclose(widths, np.array(shares) * 100.0, atol=UNIT)
    assert beside.get_ylim() == axes.get_ylim()


def test_the_band_of_a_parameter_is_where_its_prior_was(sweep):
    known = replace(sweep.parameters[0], mean=0.01, prior_std=0.005, std=0.004)
    without = replace(sweep.parameters[1], prior=False)
    parameters = (known, without, *sweep.parameters[2:])
    axes = parameter_plots.plot_parameters.figure(replace(sweep, parameters=parameters)).axes[0]
    (band,) = axes.containers
    bars = {round(b.get_y() + 0.5): (b.get_x(), b.get_width()) for b in band}
    names = row_names(axes)
    assert len(bars) == 29
    assert names.index(without.name) not in bars
    np.testing.assert_allclose(bars[names.index(known.name)], (0.0, 2.0), atol=UNIT)


def test_a_parameter_at_its_bound_is_marked_as_such(bound):
    axes = parameter_plots.plot_parameters.figure(bound).axes[0]
    x, y = line(axes, "at its bound")
    assert row_names(axes)[int(y[0])] == "x_slide.offset at lower bound"
    np.testing.assert_allclose(x, [bound["x_slide.offset"].value * 1e3], atol=UNIT)
    assert line(axes, "estimate")[0].size == 2
    assert len(segments(axes)[0]) == 2


def test_without_noise_there_are_estimates_but_no_intervals(unknown):
    svg = parameter_plots.plot_parameters(unknown)
    assert "no intervals: the noise is unknown" in texts(svg)
    axes = parameter_plots.plot_parameters.figure(unknown).axes[0]
    assert not axes.collections
    assert line(axes, "estimate")[0].size == 30


def test_few_correlations_are_printed_as_numbers(table1):
    figure = parameter_plots.plot_correlations.figure(table1)
    axes = figure.axes[0]
    r = table1.correlation
    shown = {
        (t.get_position()[0], t.get_position()[1]): t.get_text().replace("−", "-")
        for t in axes.texts
    }
    expected = {(j + 0.5, i - 0.5): f"{r[i, j]:+.2f}" for i in (1, 2) for j in range(i)}
    assert shown == expected
    assert not any("-" in t.get_text() for t in axes.texts)
    assert row_names(axes) == ["y_slide.offset", "z_slide.offset"]
    assert [t.get_text() for t in axes.get_xticklabels()] == ["x_slide.offset", "y_slide.offset"]
    assert figure.axes == [axes]  # numbers need no bar of colours
    (cells,) = axes.collections
    np.testing.assert_allclose(cells.get_array(), [r[1, 0], r[2, 0], r[2, 1]], atol=UNIT)
    assert (cells.norm.vmin, cells.norm.vmax) == (-1.0, 1.0)
    weak, strong = cells.cmap(cells.norm([0.0, 0.95]))
    assert weak[:3].min() > 0.9 > strong[:3].max()


def test_numbers_have_the_signs_that_axes_have():
    assert [layout.typeset(v, 2) for v in (-0.25, 0.25, -0.001, 0.0)] == [
        *("−0.25", "+0.25", "0.00", "0.00")
    ]


def test_of_many_parameters_those_with_the_strongest_correlations_are_shown(sweep, monkeypatch):
    monkeypatch.setattr(parameter_plots, "MAX_CORRELATED", 10)
    figure = parameter_plots.plot_correlations.figure(sweep)
    assert title(figure).endswith("the 10 of 129 parameters with the strongest")
    axes = figure.axes[0]
    names = [axes.get_xticklabels()[0].get_text(), *row_names(axes)]
    order = [p.name for p in sweep.free]
    index = [order.index(n) for n in names]
    assert index == sorted(index)
    size = np.abs(sweep.correlation)
    np.fill_diagonal(size, 0.0)
    strongest = size.max(axis=1)
    assert strongest[index].min() >= np.sort(strongest)[-10]
    (a, b, _), *_ = sweep.correlated(above=0.0)
    assert {a, b} <= set(names)


def test_negative_correlations_are_marked_without_colour(sweep):
    axes = parameter_plots.plot_correlations.figure(sweep).axes[0]
    (cells,) = axes.collections
    assert len(cells.get_paths()) == 40 * 39 / 2
    centres = np.array([p.vertices[:4].mean(axis=0) for p in cells.get_paths()])
    negative = np.asarray(cells.get_array()) < -parameter_plots.SIGN_LIMIT
    marked = np.concatenate([a.get_xydata() for a in axes.lines])
    assert {tuple(p) for p in marked} == {tuple(p) for p in centres[negative]}
    assert 0 < len(marked) < 100
    assert {a.get_marker() for a in axes.lines} == {"_"}


def test_correlations_need_two_parameters(table1, bound, unknown):
    one = {key: getattr(table1, key)[:1, :1] for key in ("model_covariance", "noise_covariance")}
    leakage = table1.unmodelled.leakage[:1]
    single = replace(
        table1,
        parameters=table1.parameters[:1],
        unmodelled=replace(table1.unmodelled, leakage=leakage),
        **one,
    )
    assert parameter_plots.plot_correlations(single) == ""
    assert parameter_plots.plot_correlations(unknown) == ""
    shown = texts(parameter_plots.plot_correlations(bound))
    assert "x_slide.offset" not in shown
    assert {"y_slide.offset", "z_slide.offset"} <= set(shown)


def test_singular_values_above_the_noise_are_filled(sweep):
    found = sweep.identifiability
    figure = parameter_plots.plot_singular_values.figure(sweep)
    assert title(figure).endswith(f"{found.rank} of 129 parameter combinations are above the noise")
    axes = figure.axes[0]
    values = found.singular_values * 1e3
    x, y = line(axes, "above the noise")
    np.testing.assert_array_equal(x, np.arange(1, found.rank + 1))
    np.testing.assert_allclose(y, values[: found.rank], rtol=UNIT)
    x, y = line(axes, "below the noise")
    np.testing.assert_array_equal(x, np.arange(found.rank + 1, found.structural_rank + 1))
    np.testing.assert_allclose(y, values[found.rank : found.structural_rank], rtol=UNIT)
    faces = [a.get_markerfacecolor() for a in axes.lines[:2]]
    assert faces == [style.AFTER, "white"]
    np.testing.assert_allclose(line(axes, "σ of a reading")[1], found.threshold * 1e3)
    assert axes.get_yscale() == "log"
    assert axes.get_xlabel().endswith(f"({129 - found.structural_rank} more are zero)")


def test_all_singular_values_are_named_where_none_is_zero(table1):
    axes = parameter_plots.plot_singular_values.figure(table1).axes[0]
    assert axes.get_xlabel() == "parameter combination, the best determined first"
    assert len(axes.lines) == 2


def test_unknown_noise_is_not_called_noise(unknown):
    axes = parameter_plots.plot_singular_values.figure(unknown).axes[0]
    labels = [str(a.get_label()) for a in axes.lines]
    assert any(text.startswith("rounding: the noise is unknown") for text in labels)
    assert not any(text.startswith("σ") for text in labels)


def test_singular_values_that_are_all_zero_are_not_shown(table1):
    nothing = replace(
        table1.identifiability,
        singular_values=np.zeros(3),
        threshold=0.0,
        rank=0,
        structural_rank=0,
    )
    assert parameter_plots.plot_singular_values(replace(table1, identifiability=nothing)) == ""


def test_nothing_is_cut_off_and_no_labels_overlap(sweep, many, table1):
    figures = [
        reading_plots.plot_residuals.figure(many),
        reading_plots.plot_setups.figure(sweep),
        reading_plots.plot_spread.figure(table1),
        parameter_plots.plot_linearised.figure(sweep),
        parameter_plots.plot_parameters.figure(sweep),
        parameter_plots.plot_correlations.figure(sweep),
        parameter_plots.plot_singular_values.figure(sweep),
    ]
    for figure in figures:
        with style.house_style():
            figure.draw_without_rendering()
            inside = figure.bbox.padded(1.0)
            for box in (b for axes in figure.axes for b in label_boxes(axes)):
                assert inside.contains(box.x0, box.y0)
                assert inside.contains(box.x1, box.y1)
            for axes in figure.axes:
                for side in (ticks(axes.xaxis), ticks(axes.yaxis)):
                    boxes = [t.get_window_extent() for t in side if t.get_text()]
                    for a, b in pairwise(boxes):
                        assert not a.padded(-0.5).overlaps(b.padded(-0.5))
            for legend in figure.legends:
                box = legend.get_window_extent()
                assert inside.contains(box.x1, box.y1)
                assert not any(box.overlaps(axes.bbox) for axes in figure.axes)


def label_boxes(axes):
    shown = [*ticks(axes.xaxis), *ticks(axes.yaxis), axes.xaxis.label, axes.yaxis.label]
    return [t.get_window_extent() for t in shown if t.get_text()]


def ticks(axis):
    """Labels that are seen."""
    low, high = sorted(axis.get_view_interval())
    found = [t for t in axis.get_major_ticks() if low <= t.get_loc() <= high]
    return [label for t in found for label in (t.label1, t.label2) if label.get_visible()]
