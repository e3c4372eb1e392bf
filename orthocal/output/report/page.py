"""A calibration as one page: what to enter, how far to believe it, and why.

The order is that of mrcal's tour: first how well the tool is known, then whether the model fits,
then the residuals and all the rest. Plots are drawn into the page, which asks nothing of a network.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from rich.console import Group

from orthocal.arguments import require_kind
from orthocal.assessment.assess import assessment_of
from orthocal.assessment.tool_error import ToolAccuracy, assess_tool
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError, OrthocalError, RobotError
from orthocal.io.files import write_file
from orthocal.io.html import escape, heading, items, paragraph, table
from orthocal.output.report.parameter_plots import (
    plot_correlations,
    plot_linearised,
    plot_parameters,
    plot_singular_values,
)
from orthocal.output.report.reading_plots import plot_residuals, plot_setups, plot_spread
from orthocal.output.report.rich_markup import to_markup
from orthocal.output.report.tool_map import Field, plot_tool_map
from orthocal.output.scene.drawing import draw_scene
from orthocal.output.text.accuracy import render_tool
from orthocal.output.text.answer import render_answer
from orthocal.output.text.entries import entry_table, render_meaning
from orthocal.output.text.heading import render_heading
from orthocal.output.text.layout import bullets, mm, plain, signed
from orthocal.output.text.sensors import render_parts
from orthocal.output.text.tables import (
    render_fit,
    render_identifiability,
    render_parameters,
    render_residuals,
)
from orthocal.units import MM
from orthocal.viewer.scene import frame_of

FEW_ROWS = 40
"""Readings up to which the list of all is open."""

ALL_ROWS = 300
"""Readings up to which all are listed."""

MOST_NAMED = 9
"""Parameters of which provenance says what was given for them."""

GLOSSARY = (
    "σ: one standard deviation of a reading, from repeated cycles, else from the residuals, else "
    "as given for the gauge. ± σ: one standard deviation from all that is not known, errors of the "
    "machine that were left out at their tolerances; scatter: the part of it that the noise of the "
    "readings has.",
    "tolerance: one standard deviation of what the workshop can be trusted with, from the robot's "
    "YAML or --tolerance. told: the share of what it left open that the readings took away.",
    "before: measured less what the machine would show as the controller knows it; after: measured "
    "less what the calibrated machine shows; each with its best gauge zeros.",
    "predicted: a setup's readings as all other setups foretell them.",
    "studentised: how far a reading is from what all others say of it, in its own σ. moves by: the "
    "σ by which a parameter would change without it, at most.",
    "shift and rotation taken out: less the shift and the rotation of the whole cube that take "
    "most of the error away. A workpiece that is aligned on the machine never sees them.",
    "not known before: with every error at its tolerance, offsets too; after: with what the "
    "readings told. worst point: one standard deviation there.",
    "combination: a direction in which the errors can change together. The readings tell one if a "
    "tolerance along it moves them together by more than their noise. Condition number and "
    "observability O1 to O5 are the field's indices of how well.",
)
"""Words that a machine builder need not know."""

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
)


def build_report(calibration: Calibration) -> str:
    """The report of a calibration as one HTML page that holds all it needs.

    Raises:
        OrthocalError: If the robot cannot be found, or is not the one that was calibrated.
    """
    require_kind(calibration, Calibration, expected="a Calibration, such as load_calibration(...)")
    title = f"Calibration of {calibration.robot_record.name}: {calibration.session.title}"
    sections = [
        ("verdict", "What to enter, and can it be believed?", _verdict(calibration)),
        ("tool", "How well is the tool known?", _tool(calibration)),
        ("fit", "Does the model fit?", _fit(calibration)),
        ("residuals", "Readings before and after, the worst first", _residuals(calibration)),
        ("parameters", "What was identified", _parameters(calibration)),
        *([("sensors", "Gauges and sensors", own)] if (own := _sensors(calibration)) else []),
        ("correlations", "What hangs together", _correlations(calibration)),
        ("identifiability", "What the readings can tell", _identifiability(calibration)),
        ("words", "What the words mean", items(GLOSSARY)),
        ("provenance", "Where this is from", _provenance(calibration)),
        ("scene", "The machine", _scene(calibration)),
    ]
    links = "".join(f'<a href="#{name}">{escape(words)}</a>' for name, words, _ in sections)
    body = "".join(
        f'<section id="{name}">{heading(words)}{content}</section>'
        for name, words, content in sections
    )
    head = to_markup(render_heading(calibration, effort=False))
    style = (resources.files("orthocal.output.report") / "report.css").read_text(encoding="utf-8")
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        f'<title>{escape(title)}</title>\n<link rel="icon" href="data:,">\n'
        f"<style>\n{style}</style>\n</head>\n<body>\n"
        f"<header>{heading('Calibration report', level=1)}{head}"
        f"<nav>{links}</nav></header>\n<main>{body}</main>\n</body>\n</html>\n"
    )


def write_report(calibration: Calibration, path: str | Path) -> Path:
    """Write the report of a calibration.

    Raises:
        OrthocalError: If it cannot be built or written.
    """
    write_file(Path(path), build_report(calibration))
    return Path(path)


def _verdict(calibration: Calibration) -> str:
    before, after = calibration.rms_before, calibration.rms_after
    change = f" ({after / before - 1.0:+.0%})" if before > 1e-8 else ""
    told = (
        f"Deviations of {mm(before)} mm (r.m.s.) become residuals of {mm(after)} mm{change}: the "
        f"largest was {mm(calibration.largest_before)} mm and is {mm(calibration.largest_after)} "
        "mm."
    )
    found = assessment_of(calibration)
    answer = to_markup(render_answer(calibration, heading=False))
    meaning = Group()
    if found.entries:
        # what the answer leaves out: where the sliders are, and what is not to be entered
        told_all = found.decision.verdict != "reject" and calibration.only_offsets
        listed = [] if told_all else [entry_table(calibration)]
        meaning = Group(*listed, *render_meaning(calibration))
    return (
        answer
        + heading("What these numbers are", level=3)
        + to_markup(meaning)
        + paragraph(told)
        + heading("What it means", level=3)
        + to_markup(bullets([f.words for f in found.findings]))
    )


def _tool(calibration: Calibration) -> str:
    words = to_markup(render_tool(calibration))
    try:
        return words + _maps(calibration, assess_tool(calibration))
    except (ClosureError, RobotError):  # the words say why
        return words


def _maps(calibration: Calibration, found: ToolAccuracy) -> str:
    excess = calibration.tolerance_scale
    times = f"{excess:.1f} times " if excess > 1.0 else ""
    captions: dict[Field, str] = {
        "now": "Where the tool is, less where it is sent, with the controller as it was while "
        "measuring; shift and rotation of the whole cube are taken out here and below: a "
        "workpiece is aligned on the machine.",
        "left": "The same once the offsets above are entered, in a controller that knows of "
        "nothing else.",
        "unknown": "What is not known of the tool's position after this calibration: one standard "
        f"deviation in space, errors that were not identified at {times}their tolerances.",
    }
    return "".join(
        _figure(plot_tool_map(calibration, found, which=which), words)
        for which, words in captions.items()
    )


def _fit(calibration: Calibration) -> str:
    parts = [to_markup(render_fit(calibration))]
    if any(r.unseen == r.unseen for r in calibration.residuals):
        text = (
            "Predicted: every setup from all the others. A model that fits predicts what it has "
            "not seen nearly as well as what it was fitted to."
        )
    else:
        text = "No setup can be predicted from the others: they do not determine the model alone."
    parts.append(_figure(plot_setups(calibration), text))
    parts.append(
        _figure(
            plot_spread(calibration),
            "Residuals that are noise lie on the line. A steeper or bent row is error of the "
            "model; single readings far off are mistakes of reading.",
        )
    )
    parts.append(
        _figure(
            plot_linearised(calibration),
            "The solution of the linear equations, as in the paper, against the exact one.",
        )
    )
    return "".join(parts)


def _residuals(calibration: Calibration) -> str:
    every = len(calibration.residuals) <= ALL_ROWS
    listed = to_markup(render_residuals(calibration, all_rows=every, worst_first=True))
    words = "All readings" if every else "The largest"
    few = len(calibration.residuals) <= FEW_ROWS
    return _figure(plot_residuals(calibration), "") + _details(words, listed, shown=few)


def _parameters(calibration: Calibration) -> str:
    listed = to_markup(render_parameters(calibration, all_rows=True))
    few = len(calibration.free) <= 12
    return _figure(plot_parameters(calibration), "") + (
        listed if few else _details("All parameters", listed)
    )


def _sensors(calibration: Calibration) -> str:
    return "".join(to_markup(part) for part in render_parts(calibration))


def _correlations(calibration: Calibration) -> str:
    figure = plot_correlations(calibration)
    if not figure:
        return paragraph("One parameter alone has nothing to hang together with.")
    pairs = calibration.correlated(above=0.5)
    if not pairs:
        return _figure(figure, "No correlation is above 0.5.")
    rows = [(a, b, signed(r, 2)) for a, b, r in pairs[:20]]
    more = f" The strongest 20 of {len(pairs)}." if len(pairs) > 20 else ""
    return _figure(figure, f"Pairs above 0.5 stand below.{more}") + table(
        ("parameter", "with", "correlation"), rows, left=2
    )


def _identifiability(calibration: Calibration) -> str:
    few = len(calibration.free) <= 12
    words = to_markup(render_identifiability(calibration, all_rows=True))
    return _figure(plot_singular_values(calibration), "") + (
        words if few else _details("In words", words)
    )


def _provenance(calibration: Calibration) -> str:
    robot, session, solver = calibration.robot_record, calibration.session, calibration.solver
    sigma = session.gauge_sigma
    active = "not stated"
    if session.controller_offsets is not None:
        active = ", ".join(
            f"{d.name} {signed(v * d.edge_factor)} {d.edge_unit}"
            for d, v in zip(calibration.robot.drives, session.controller_offsets, strict=True)
        )
    rows: list[tuple[str, str]] = [
        ("Robot", f"{robot.name} ({robot.reference})"),
        ("its files, SHA-256", robot.sha256),
        *(
            row
            for part in session.parts or (session,)
            for row in (
                ("Session", part.title),
                ("Source", part.source or "not stated"),
                ("File", part.path or "none"),
                ("its files, SHA-256", part.sha256 or "none"),
            )
        ),
        ("Gauge", "σ not stated" if sigma is None else f"σ {plain(sigma / MM)} mm a reading"),
        ("Offsets active while measuring", active),
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
        ("orthocal", calibration.version),
    ]
    return table(("", ""), rows, left=2)


def _assumptions(calibration: Calibration) -> list[tuple[str, str]]:
    """What was given beside the readings, of every parameter that it was given for."""
    usual = calibration.robot.parameters.own
    tolerances, known, bounds = [], [], []
    for p in calibration.parameters:
        f, unit = p.edge_factor, p.edge_unit
        if not p.free:
            known.append(f"{p.name} {p.value * f:g} {unit}")
            continue
        if p.prior and (p.mean != 0.0 or not calibration.prior):
            known.append(f"{p.name} {p.mean * f:g} ± {p.tolerance * f:g} {unit}")
        elif p.tolerance != usual[p.name].tolerance:
            usually = usual[p.name].tolerance * f
            tolerances.append(f"{p.name} {p.tolerance * f:g} {unit} instead of {usually:g}")
        if p.lower is not None or p.upper is not None:
            low, high = ("∞" if v is None else f"{v * f:g}" for v in (p.lower, p.upper))
            bounds.append(f"{p.name} {low} … {high} {unit}".replace(" ∞ …", " −∞ …"))
    rows = [
        (name, _some(texts))
        for name, texts in (("Tolerances", tolerances), ("Known values", known), ("Bounds", bounds))
        if texts
    ]
    return rows or [("Given beside the readings", "nothing: the robot's own tolerances hold")]


def _some(texts: Sequence[str]) -> str:
    """All of a few, the first of many."""
    more = len(texts) - MOST_NAMED
    return "; ".join(texts[:MOST_NAMED]) + (f"; and {more} more" if more > 0 else "")


def _scene(calibration: Calibration) -> str:
    try:
        scene = draw_scene(calibration)
    except OrthocalError as e:  # the numbers stand without it
        return paragraph(f"It cannot be drawn: {e}.")
    hint = (
        "Drag to turn, scroll to come nearer; play to go through the measurement. Open Controls is "
        "a tree of all parts, to show and hide."
    )
    return frame_of(scene.to_html(), height="640px") + paragraph(hint, kind="screen")


def _figure(svg: str, caption: str) -> str:
    if not svg:
        return ""
    words = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f"<figure>{svg}{words}</figure>"


def _details(words: str, content: str, *, shown: bool = False) -> str:
    opening = "<details open>" if shown else "<details>"
    return f"{opening}<summary>{escape(words)}</summary>{content}</details>"
