"""Report of a calibration: a page with the values to enter, their accuracy, and the evidence.

The page is self-contained and needs no network.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from importlib import resources
from pathlib import Path

from rich.console import Group

from orthocal.assessment.circular_deviation import find_circles
from orthocal.assessment.tool_error import ToolAccuracy, assess_tool
from orthocal.assessment.wording import mm, plain, signed
from orthocal.calibration.calibration import Calibration, require_calibration
from orthocal.calibration.records import SessionRecord
from orthocal.errors import ClosureError, OrthocalError, RobotError
from orthocal.io.files import require_suffix, write_file
from orthocal.io.html import escape, heading, items, page, paragraph, table
from orthocal.output.report.parameter_plots import (
    MAX_IN_DETAIL,
    plot_correlations,
    plot_linearised,
    plot_parameters,
    plot_singular_values,
)
from orthocal.output.report.reading_plots import (
    plot_circle,
    plot_residuals,
    plot_setups,
    plot_spread,
)
from orthocal.output.report.tool_map import Field, plot_tool_map
from orthocal.output.scene.drawing import draw_scene
from orthocal.output.text.accuracy import FurtherHour, expect_further_hour, render_accuracy
from orthocal.output.text.adjustment import render_adjustments
from orthocal.output.text.answer import (
    name_values,
    render_answer,
    render_method,
    render_subject,
    render_values,
)
from orthocal.output.text.layout import to_markup
from orthocal.output.text.tables import (
    describe_change,
    render_findings,
    render_fit,
    render_identifiability,
    render_parameters,
    render_readings,
    render_sensors,
)
from orthocal.text import list_some
from orthocal.units import MM, show_limit
from orthocal.viewer.scene import frame_of

MAX_OPEN_ROWS = 40
"""Largest number of readings whose list is initially open."""

MAX_LISTED_ROWS = 300
"""Largest number of readings that are all listed."""

MAX_NAMED = 9
"""Largest number of parameters that the provenance lists."""

GLOSSARY = (
    "σ: standard deviation of one reading, from repeated cycles if there are any. Residuals larger "
    "than chance explains replace it, and the stated one is its lower limit.",
    "tolerance: limit of an error before the calibration; 19 of 20 errors are within it. From the "
    "robot's YAML or --tolerance.",
    "resolved: how much the readings improved a value: 0 % not at all, 100 % completely.",
    "before: measured minus nominal reading with the active offsets. after: measured minus "
    "calibrated reading. Both use fitted gauge zeros.",
    "predicted: readings of a setup, predicted from all other setups.",
    "studentised: deviation of a reading from its prediction by all other readings, divided by its "
    "standard deviation. influence: largest change of a parameter without this reading, in its "
    "standard deviations.",
    "workpiece aligned on the machine: tool error after the best alignment, which removes one "
    "translation and one rotation of the workspace.",
    "uncertainty before calibration: RMS uncertainty of the tool position with every error within "
    "its tolerance. After calibration: with the readings. worst point: the largest value in the "
    "workspace.",
    "combination: errors that the readings show only as a sum. It is resolvable if half its "
    "tolerance changes the readings by more than their noise. Condition number and observability "
    "indices O1 to O5 are measures of identifiability.",
)
"""Explanations of the report's terms."""


def build_report(calibration: Calibration, *, saved: Path | None = None) -> str:
    """Report of a calibration as a self-contained HTML page.

    Args:
        calibration: The calibration.
        saved: Directory of the calibration; by default the directory that it was loaded from.

    Raises:
        OrthocalError: If the robot is missing or differs from the calibrated one.
    """
    require_calibration(calibration)
    title = f"Calibration of {calibration.robot_record.name}: {calibration.session.title}"
    sensors = render_sensors(calibration)
    if saved is None and calibration.path is not None:
        saved = calibration.path.parent
    saved = saved and saved.resolve()
    further = expect_further_hour(calibration)
    sections = [
        ("verdict", "Verdict", _verdict(calibration, saved, further)),
        ("tool", "Tool error", _tool(calibration, further)),
        *_adjustments(calibration, saved),
        ("fit", "Residuals", _fit(calibration)),
        ("residuals", "Readings", _readings(calibration)),
        *_circles(calibration),
        ("parameters", "Parameters", _parameters(calibration)),
        *([("sensors", "Gauges and sensors", to_markup(sensors))] if sensors else []),
        ("scene", "Scene", _scene(calibration)),
        ("words", "Glossary", items(GLOSSARY)),
        ("provenance", "Provenance", _provenance(calibration)),
        ("research", "For research", _research(calibration)),
    ]
    links = "".join(f'<a href="#{name}">{escape(words)}</a>' for name, words, _ in sections)
    body = "".join(
        f'<section id="{name}">{heading(words)}{content}</section>'
        for name, words, content in sections
    )
    head = to_markup(Group(render_subject(calibration), render_method(calibration, effort=False)))
    style = (resources.files("orthocal.output.report") / "report.css").read_text(encoding="utf-8")
    header = f"<header>{heading('Calibration report', level=1)}{head}<nav>{links}</nav></header>"
    return page(title, style, f"{header}\n<main>{body}</main>", scripts=True)


OTHER_KINDS = (".csv", ".json", ".urdf", ".yaml", ".yml")
"""Suffixes of files that are no report."""


def write_report(calibration: Calibration, path: str | Path) -> Path:
    """Write the report of a calibration.

    Raises:
        OrthocalError: If the report cannot be built or written, or if the name is that of another
            kind of file.
    """
    file = Path(path)
    require_suffix(file, ".html", OTHER_KINDS)
    write_file(file, build_report(calibration))
    return file


def _verdict(calibration: Calibration, saved: Path | None, further: FurtherHour) -> str:
    """Content of the section with the verdict, the values to enter and the findings."""
    before, after = calibration.rms_before, calibration.rms_after
    change = f" ({percent})" if (percent := describe_change(before, after)) else ""
    fit = (
        f"Deviations of the readings: {mm(before)} mm RMS before, {mm(after)} mm after "
        f"calibration{change}; largest {mm(calibration.largest_before)} mm before, "
        f"{mm(calibration.largest_after)} mm after."
    )
    return (
        to_markup(render_answer(calibration, heading=False, saved=saved, further=further))
        + heading(name_values(calibration), level=3)
        + to_markup(render_values(calibration))
        + paragraph(fit)
        + heading("Findings", level=3)
        + to_markup(render_findings(calibration))
    )


def _tool(calibration: Calibration, further: FurtherHour) -> str:
    """Content of the section with the tool error."""
    try:
        accuracy = assess_tool(calibration)
    except (ClosureError, RobotError) as e:
        return paragraph(f"The tool error cannot be computed: {e}.")
    words = render_accuracy(calibration, accuracy, further)
    return to_markup(words) + _maps(calibration, accuracy)


def _adjustments(calibration: Calibration, saved: Path | None) -> list[tuple[str, str, str]]:
    """Section with the plan of adjustments; empty for a robot without adjustments."""
    if not calibration.robot.declared.adjustments:
        return []
    content = to_markup(render_adjustments(calibration, saved=saved))
    return [("adjustment", "Mechanical adjustment", content)]


def _maps(calibration: Calibration, accuracy: ToolAccuracy) -> str:
    """Maps of the tool error with captions."""
    scale = calibration.tolerance_scale.factor
    times = f"{scale:.1f} times " if scale > 1.0 else ""
    captions: dict[Field, str] = {
        "now": "Actual minus commanded position of the tool, with the offsets that were active "
        "during the measurement. All maps are for a workpiece that is aligned on the machine: one "
        "translation and one rotation are removed.",
        "entered": "Actual minus commanded position of the tool with the offsets above, without "
        "any other correction.",
        "uncertainty": "Uncertainty of the tool position after calibration: RMS in space, "
        f"with unidentified errors within {times}their tolerances.",
    }
    return "".join(
        _figure(plot_tool_map(calibration, accuracy, which=which), caption)
        for which, caption in captions.items()
    )


def _fit(calibration: Calibration) -> str:
    """Content of the section with the residuals."""
    parts = [to_markup(render_fit(calibration))]
    text = (
        "Predicted: readings of each setup, predicted from all other setups. Predictions nearly as "
        "close as the fit confirm the model. Larger errors do not refute it: a setup may measure "
        "errors of the machine that no other setup measures."
    )
    if all(math.isnan(r.prediction_error) for r in calibration.residuals):
        text = "No setup can be predicted: the other setups do not determine the model."
    parts.append(_figure(plot_setups(calibration), text))
    parts.append(
        _figure(
            plot_spread(calibration),
            "Residuals that are pure noise lie on the line. A steeper or bent curve indicates an "
            "error of the model, single points far from the line indicate wrong readings.",
        )
    )
    return "".join(parts)


def _readings(calibration: Calibration) -> str:
    """Content of the section with the readings."""
    all_rows = len(calibration.residuals) <= MAX_LISTED_ROWS
    listed = to_markup(render_readings(calibration, all_rows=all_rows, worst_first=True))
    summary = "All readings" if all_rows else "The largest"
    few = len(calibration.residuals) <= MAX_OPEN_ROWS
    return _figure(plot_residuals(calibration), "") + _details(summary, listed, shown=few)


def _circles(calibration: Calibration) -> list[tuple[str, str, str]]:
    """Section with the circles of ball bars; empty without circles."""
    figures = [
        _figure(
            plot_circle(circle),
            "Deviations of the radius from the least-squares circle, magnified. G: circular "
            "deviation (ISO 230-4), the range of these deviations.",
        )
        for circle in find_circles(calibration)
    ]
    return [("circles", "Circular deviation", "".join(figures))] if figures else []


def _parameters(calibration: Calibration) -> str:
    """Content of the section with the parameters."""
    listed = to_markup(render_parameters(calibration, all_rows=True))
    few = len(calibration.free) <= MAX_IN_DETAIL
    return _figure(plot_parameters(calibration), "") + (
        listed if few else _details("All parameters", listed)
    )


def _research(calibration: Calibration) -> str:
    """Content of the section for research: linearisation, correlations, identifiability."""
    few = len(calibration.free) <= MAX_IN_DETAIL
    tables = to_markup(render_identifiability(calibration, all_rows=True))
    linearised = _figure(
        plot_linearised(calibration),
        "Exact solution minus the solution of the linear equations, as in the paper.",
    )
    return (
        linearised
        + heading("Correlations", level=3)
        + _correlations(calibration)
        + heading("Identifiability", level=3)
        + _figure(plot_singular_values(calibration), "")
        + (tables if few else _details("Tables", tables))
    )


def _correlations(calibration: Calibration) -> str:
    """Plot and table of the correlations."""
    figure = plot_correlations(calibration)
    if not figure and len(calibration.free) > 1:
        return paragraph("The correlations are unknown, because the noise of the readings is.")
    if not figure:
        return paragraph("A single parameter has no correlations.")
    pairs = calibration.correlated(above=0.5)
    if not pairs:
        return _figure(figure, "No correlation is above 0.5.")
    rows = [(a, b, signed(r, 2)) for a, b, r in pairs[:20]]
    more = f", the strongest 20 of {len(pairs)}" if len(pairs) > 20 else ""
    return _figure(figure, f"The table lists pairs above 0.5{more}.") + table(
        ("parameter", "with", "correlation"), rows, left=2
    )


def _provenance(calibration: Calibration) -> str:
    """Table of robot, sessions, assumptions and software."""
    robot, session, solver = calibration.robot_record, calibration.session, calibration.solver
    rows: list[tuple[str, str]] = [
        ("Robot", f"{robot.name} ({robot.reference})"),
        ("SHA-256 of the robot's files", robot.sha256),
        *(
            row
            for part in session.parts or (session,)
            for row in (
                ("Session", part.title),
                ("Source", part.source or "not stated"),
                ("File", part.path or "none"),
                ("SHA-256 of the session's files", part.sha256 or "none"),
                ("Offsets active during the measurement", _active_offsets(calibration, part)),
            )
        ),
        *((f"Gauge {g.name}".rstrip(), _stated_sigma(g.sigma)) for g in calibration.gauges),
        (
            "Model",
            f"{calibration.model}: {len(calibration.free)} free parameters, "
            + ("tolerances as a prior" if calibration.prior else "no prior"),
        ),
        *_assumptions(calibration),
        (
            "Solver",
            f"{solver.name}, {solver.status}, {solver.iterations} iterations, "
            f"{solver.hessian} Hessian, loss: {solver.loss}",
        ),
        ("Software", ", ".join(f"{n} {v}" for n, v in asdict(calibration.versions).items())),
    ]
    return table(("", ""), rows, left=2)


def _active_offsets(calibration: Calibration, session: SessionRecord) -> str:
    """Offsets of the controller during a session."""
    if session.controller_offsets is None:
        return "not stated"
    return ", ".join(
        f"{d.name} {signed(v * d.edge_factor)} {d.edge_unit}"
        for d, v in zip(calibration.robot.drives, session.controller_offsets, strict=True)
    )


def _stated_sigma(sigma: float | None) -> str:
    """Stated standard deviation of a reading of a gauge, [m]."""
    return "σ not stated" if sigma is None else f"σ {plain(sigma / MM)} mm per reading"


def _assumptions(calibration: Calibration) -> list[tuple[str, str]]:
    """Tolerances, known values and bounds that the user stated."""
    defaults = calibration.robot.parameters.defaults
    factor = calibration.tolerance_scale.factor
    tolerances, known_values, bounds = [], [], []
    for p in calibration.parameters:
        f, unit = p.edge_factor, p.edge_unit
        if not p.free:
            known_values.append(f"{p.name} {p.value * f:g} {unit}")
            continue
        stated, default = (
            show_limit(std) * f
            for std in (p.prior_std / (factor if p.scaled else 1.0), defaults[p.name].prior_std)
        )
        if p.prior and (p.mean != 0.0 or not calibration.prior):
            known_values.append(f"{p.name} {p.mean * f:g} ± {show_limit(p.prior_std) * f:g} {unit}")
        elif not math.isclose(stated, default):
            tolerances.append(f"{p.name} {stated:g} {unit} instead of {default:g}")
        if p.lower is not None or p.upper is not None:
            low, high = ("∞" if v is None else f"{v * f:g}" for v in (p.lower, p.upper))
            bounds.append(f"{p.name} {low} … {high} {unit}".replace(" ∞ …", " −∞ …"))
    rows = [
        (name, list_some(texts, MAX_NAMED, separator="; "))
        for name, texts in (
            ("Tolerances", tolerances),
            ("Known values", known_values),
            ("Bounds", bounds),
        )
        if texts
    ]
    if factor != 1.0:
        rows.append(("Tolerance scale", f"{factor:.2f}, tolerances of legs, axes and drive scales"))
    return rows or [("Assumptions", "the tolerances of the robot")]


def _scene(calibration: Calibration) -> str:
    """3-D scene in a frame, or the reason why it cannot be drawn."""
    try:
        scene = draw_scene(calibration)
    except OrthocalError as e:  # the report is useful without the scene
        return paragraph(f"The scene cannot be drawn: {e}.")
    hint = (
        "Drag to turn, scroll to zoom, press Play to go through the measurement. Open Controls "
        "shows and hides single parts."
    )
    return frame_of(scene.to_html(), height="640px") + paragraph(hint, kind="screen")


def _figure(svg: str, caption: str) -> str:
    """HTML of a figure with a caption; "" without a plot."""
    if not svg:
        return ""
    element = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f"<figure>{svg}{element}</figure>"


def _details(summary: str, content: str, *, shown: bool = False) -> str:
    """HTML of content that is shown and hidden by its summary."""
    opening = "<details open>" if shown else "<details>"
    return f"{opening}<summary>{escape(summary)}</summary>{content}</details>"
