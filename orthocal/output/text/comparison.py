"""A comparison of models as tables and sentences."""

from __future__ import annotations

import math

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.assessment.comparison import Comparison
from orthocal.assessment.wording import counted, mm, plain, signed, tool_mm, um
from orthocal.assessment.words.anomalies import describe_evidence
from orthocal.assessment.words.entries import describe_region, find_settings_errors
from orthocal.calibration.assessment_record import FindingKind
from orthocal.output.text.answer import STYLES, render_decision
from orthocal.output.text.layout import (
    EXPANDED,
    NOISE_SOURCES,
    bullets,
    choose_worst,
    indented,
    noted,
    section,
    table_of,
)
from orthocal.robot.parameters import is_offset
from orthocal.units import MM

MORE = "--details prints scores, estimates and residuals of each model."

RESEARCH: tuple[FindingKind, ...] = (
    *("recommended", "not recommended", "tool error", "linearisation cost"),
    *("noise as stated", "noise from cycles", "common approach"),
)
"""Kinds of findings that the short answer replaces, or that only the details list."""


def render_comparison(
    comparison: Comparison, *, details: bool = False, all_rows: bool = False
) -> RenderableType:
    """A comparison as rich renderables: the short answer, and on demand the details."""
    c, assessed = comparison, comparison.assessment
    answer: list[RenderableType] = [
        Text("Comparison of models", style="bold"),
        *([Text(c.title)] if c.title else []),
        Text(),
    ]
    recommended = assessed.of_kind("recommended")
    if recommended:
        answer += [
            Text(assessed.decision.headline, style=STYLES[assessed.decision.verdict]),
            Text(recommended[0].text),
            Text(),
            indented(_tool_errors(c)),
            bullets([f.words for f in assessed.findings if f.kind not in RESEARCH]),
        ]
    else:
        answer.append(render_decision(assessed))
    if not (details or all_rows):
        return Group(*answer, Text(MORE))
    further = [f.words for f in assessed.findings if f.kind in RESEARCH and f not in recommended]
    further += [e for f in assessed.findings if (e := describe_evidence(f))]
    sigmas = [
        f"σ of a reading{f' of the gauge {name!r}' if len(c.noises) > 1 else ''}: "
        f"{mm(noise.sigma)} mm, {NOISE_SOURCES[noise.source]}"
        for name, noise in c.noises.items()
    ]
    noise = "; ".join([counted(c.independent, "independent reading"), *sigmas])
    return Group(
        *answer,
        section("Further findings", bullets([noise, *further])),
        section("Scores", _scores(c)),
        *([section("Effects", _effects(c))] if c.effects and c.effects.weighed else []),
        section("Estimates", _estimates(c, all_rows)),
        section("Residuals by model", _residuals(c, all_rows)),
    )


def _tool_errors(comparison: Comparison) -> RenderableType:
    """Expected tool errors of each model, as `calibrate` states them for it."""
    rows, entering = [], "offsets"
    for result, assessed in zip(comparison.results, comparison.assessments, strict=True):
        tool, only = assessed.tool, result.calibration.only_offsets
        if tool is None:
            rows.append((result.model, "unknown", "", ""))
            continue
        corrected = "" if only else tool_mm(tool.compensated)
        now, entered = tool.now, tool.entered
        if result.calibration.session.firmware is not None:
            now, entered, entering = *find_settings_errors(assessed), "settings"
        rows.append((result.model, tool_mm(now), tool_mm(entered), corrected))
    rows += [(u.model, "not identifiable", "", "") for u in comparison.undetermined]
    headers = ("model", "tool error now", f"with its {entering}", "identified errors corrected")
    regions = dict.fromkeys(describe_region(a.tool) for a in comparison.assessments if a.tool)
    return noted(table_of(headers, rows), *regions)


def _scores(comparison: Comparison) -> RenderableType:
    rows: list[tuple[str, ...]] = []
    chosen = comparison.recommendation
    for result in comparison.results:
        after = None if result.tool is None else result.tool.after
        checked = result.calibration.is_checked
        evidence = math.nan if chosen is None else chosen.log_evidence_of(result.model)
        for score in (result.linearised, result.exact):
            first = score.method == "linearised"
            # without redundancy the residuals do not check the model
            fits = (
                plain(score.rms / MM, 4),
                _short(score.chi_square),
                f"{score.dof:.1f}",
                _short(score.aicc if score.dof >= FEWEST_DOF else math.inf),
                _short(score.bic),
            )
            row = (
                result.model if first else "",
                "linear" if first else "exact",
                str(result.n_free) if first else "",
                f"{result.effective:.1f}" if first else "",
                *(fits if checked else ("–",) * len(fits)),
                f"{evidence:+.1f}" if first and math.isfinite(evidence) else "",
                plain(score.prediction_rms / MM, 4),
                "" if after is None or first else um(after.sizes.reported.rms),
            )
            rows.append(row)
    for u in comparison.undetermined:
        rows.append((u.model, "", str(u.n_free), "", "not identifiable", *([""] * 7)))
    sizes = ("free", "effective", "RMS [mm]", "χ²", "dof", "AICc", "BIC", "ln evidence")
    return noted(
        table_of(("model", "", *sizes, "CV [mm]", "uncertainty [µm]"), rows, left=2),
        "–: no redundant reading checks this model; for AICc, hardly 3 degrees of freedom or fewer",
        "effective: number of parameters that the readings determine",
        "AICc, BIC: lower is better; ln evidence (0: complete model): higher is better",
        "CV: cross-validation, RMS error of predicting each setup from all others",
        "uncertainty: of the tool after calibration, RMS, workpiece aligned",
    )


def _effects(comparison: Comparison) -> RenderableType:
    weighed = comparison.effects.weighed if comparison.effects else ()
    rows = [
        (", ".join(w.effects) or "none", f"{w.log_evidence:+.1f}", plain(w.prediction_rms / MM, 4))
        for w in weighed
    ]
    return table_of(("effects", "ln evidence", "CV [mm]"), rows)


def _estimates(comparison: Comparison, all_rows: bool) -> RenderableType:
    results = comparison.results
    if not results:
        return Text("No model is identifiable.")
    names = list(dict.fromkeys(n for r in results for n in r.exact.estimates))
    small = [r for r in results if r.n_free <= 12]
    named = {n for r in small for n in r.exact.estimates}
    shown = [n for n in names if all_rows or n in named or is_offset(n)]
    parameters = results[0].calibration.robot.parameters
    half = {
        (r.model, p.name): uncertainty * p.edge_factor
        for r in results
        for p, uncertainty in zip(
            r.calibration.free, r.calibration.expanded_uncertainties.tolist(), strict=True
        )
    }
    rows = []
    for name in shown:
        p, label = parameters[name], name
        for r in (r for r in results if name in r.exact.estimates):
            values = (s.estimates[name] * p.edge_factor for s in (r.linearised, r.exact))
            rows.append(
                (label, r.model, *map(signed, values), plain(half[r.model, name]), p.edge_unit)
            )
            label = ""
    omitted = len(names) - len(shown)
    return noted(
        table_of(("parameter", "model", "linear", "exact", "±", "unit"), rows, left=2),
        EXPANDED,
        f"{omitted} more; --all lists every parameter." if omitted else "",
    )


def _residuals(comparison: Comparison, all_rows: bool) -> RenderableType:
    results = comparison.results
    if not results:
        return Text("No model is identifiable.")
    largest = np.abs([r.exact.residuals for r in results]).max(axis=0)
    order, note = choose_worst(range(len(largest)), largest.__getitem__, all_rows=all_rows)
    rows = [
        (comparison.labels[i], *(signed(r.exact.residuals[i] / MM) for r in results)) for i in order
    ]
    return noted(table_of(("reading", *(f"{r.model} [mm]" for r in results)), rows), note)


FEWEST_DOF = 3.0
"""Degrees of freedom below which AICc is decided by its correction, and hundredths of a parameter
move it by more than the readings do."""


def _short(value: float) -> str:
    if math.isinf(value):
        return "–"
    return f"{value:.1f}" if math.isfinite(value) else "unknown"
