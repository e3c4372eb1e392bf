"""Reports of studies: answer, tables, plot and plain data of each kind, as text and as JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic_core import to_jsonable_python
from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.assessment.wording import counted, joined, plain, tool_mm
from orthocal.io.documents import format_json
from orthocal.kinematics.workspace import describe_box
from orthocal.output.text.layout import noted, section, table_of
from orthocal.study.accuracy import (
    AccuracyStudy,
    AccuracySummary,
    EstimationError,
    summarise_accuracy,
)
from orthocal.study.bootstrap import BootstrapSummary, Scatter, summarise_bootstrap
from orthocal.study.linearisation import LinearisationSummary, MethodErrors, summarise_linearisation
from orthocal.study.runner import StudyTable
from orthocal.study.sensitivity import SensitivitySummary, summarise_sensitivity
from orthocal.units import UM

MOST_ROWS = 12
"""Parameters in a table unless all are asked for."""

MOST_COLUMNS = 6
"""Parameters in the table of derivatives unless all are asked for."""

SIGNIFICANT = 3.0
"""Standard errors by which a result differs significantly from its prediction."""

LINEAR_PREDICTION_ERROR = 0.1
"""Relative error that a first-order prediction may have."""

LEAST_COST = 0.02
"""Share of the tool error below which ignoring an effect costs nothing that matters."""

METHOD_NAMES = {
    "six": "paper, six equations",
    "twelve": "paper, twelve equations",
    "twelve_gls": "paper, twelve, weighted",
    "first_order": "first order",
    "steps_2": "two Gauss-Newton steps",
    "steps_3": "three Gauss-Newton steps",
    "exact": "exact solution",
}


@dataclass(frozen=True, slots=True, eq=False)
class StudyReport:
    """Answer, tables, plot and plain data of a study."""

    kind: str
    """Kind of the study."""
    answer: str
    tables: tuple[RenderableType, ...]
    """Tables with their titles."""
    plotted: tuple[Any, ...]
    """Arguments of the plot."""
    document: dict[str, Any]
    """Summary as plain data."""
    notes: tuple[str, ...] = ()

    def draw(self) -> str:
        """Draw the plot as an SVG file."""
        from orthocal.output.report.study_plots import PLOTS

        return PLOTS[self.kind].document(*self.plotted)


def report_study(table: StudyTable, *, all_rows: bool = False) -> StudyReport:
    """The report of a study of any kind.

    Args:
        table: Result of the study.
        all_rows: Whether tables list all parameters.
    """
    builders: dict[str, Callable[[StudyTable, bool], StudyReport]] = {
        "accuracy": _accuracy,
        "linearisation": _linearisation,
        "sensitivity": _sensitivity,
        "bootstrap": _bootstrap,
    }
    return builders[table.study.kind](table, all_rows)


def study_json(table: StudyTable, report: StudyReport) -> str:
    """A study and its summary as JSON; names of keys end with the unit."""
    document = {
        "schema": "orthocal/study/1",
        "study": table.study.document,
        "digest": table.study.digest,
        "rows": len(table),
        "answer": report.answer,
        "summary": report.document,
    }
    return format_json(to_jsonable_python(document, inf_nan_mode="null"))


def render_report(report: StudyReport) -> RenderableType:
    """A report as text, the answer first."""
    return Group(Text(report.answer, style="bold"), *report.tables, *map(Text, report.notes))


def _parameters(
    estimates: Sequence[EstimationError | Scatter], names: Sequence[str]
) -> list[dict[str, Any]]:
    """Name and unit of each parameter, and attributes of its estimate in this unit."""
    return [
        {
            "name": e.parameter.name,
            "unit": e.parameter.edge_unit,
            **{name: float(getattr(e, name) * e.parameter.edge_factor) for name in names},
        }
        for e in estimates
    ]


def _accuracy(table: StudyTable, all_rows: bool) -> StudyReport:
    study: Any = table.study
    s = summarise_accuracy(study, table)
    predicted = dict.fromkeys(("aligned_um", "shift_out_um", "absolute_um"), math.nan)
    if s.predicted is not None:
        sizes = s.predicted.sizes
        values = (s.predicted.reported.rms, sizes.relative.rms, sizes.absolute.rms)
        predicted = {name: v / UM for name, v in zip(predicted, values, strict=True)}
    parameters = _parameters(s.parameters, ("rms", "standard_error", "predicted"))
    for row, e in zip(parameters, s.parameters, strict=True):
        row["relative"] = e.relative
    document = {
        "machines": s.machines,
        "failed": dict(s.failed),
        "before_um": s.before / UM,
        "after_um": s.after / UM,
        "after_standard_error_um": s.standard_error / UM,
        "percentile_95_um": s.percentile_95 / UM,
        "worst_point_um": s.worst_point / UM,
        "shift_out_um": s.shift_removed / UM,
        "absolute_um": s.absolute / UM,
        "effects": list(study.effects),
        "ignored": list(study.ignored),
        "after_all_effects_um": None if s.all_effects is None else s.all_effects / UM,
        "cost_standard_error_um": s.cost_standard_error / UM,
        "predicted": None if s.predicted is None else predicted,
        "parameters": parameters,
    }
    tables: tuple[RenderableType, ...] = ()
    if s.machines:
        rows = [
            (
                *(_number(p[name]) for name in ("rms", "standard_error", "predicted")),
                f"{100.0 * p['relative']:.0f} %",
            )
            for p in parameters
        ]
        header = ("error", "std. error", "predicted", "of its prior")
        estimates = _parameter_table(header, parameters, rows, "The {} least certain", all_rows)
        tables = (_tool_table(s, predicted), section("Errors of the estimates, RMS", estimates))
    notes = tuple(
        f"Not calibrated: {counted(n, 'machine')} ({reason})." for reason, n in s.failed.items()
    )
    aligned = predicted["aligned_um"]
    answer = _accuracy_answer(study, s, aligned * UM)
    return StudyReport("accuracy", answer, tables, (table, aligned), document, notes)


def _accuracy_answer(study: AccuracyStudy, s: AccuracySummary, predicted: float) -> str:
    if not s.machines:
        reasons = ", ".join(f"{n}: {reason}" for reason, n in s.failed.items())
        return f"None of the machines could be calibrated ({reasons})."
    sentences = [] if s.all_effects is None else [_cost_sentence(study, s, s.all_effects)]
    sentences += [
        f"Expected tool error after calibration: {tool_mm(s.after)} RMS (before: "
        f"{tool_mm(s.before)}), over the workspace {describe_box(np.array(study.box))} after "
        "aligning the workpiece.",
        f"RMS over {counted(s.machines, 'machine')}, standard error {_um(s.standard_error)} µm; "
        f"95 % of the machines are below {tool_mm(s.percentile_95)}.",
        "The controller corrects all identified errors.",
    ]
    if math.isfinite(predicted):
        difference = s.after - predicted
        limit = max(SIGNIFICANT * s.standard_error, LINEAR_PREDICTION_ERROR * predicted)
        worse = ", significantly less" if difference > limit and not study.fixed else ""
        kind = " for machines within their tolerances" if study.fixed else ""
        sentences.append(f"The covariance predicts {tool_mm(predicted)}{kind}{worse}.")
    return " ".join(sentences)


def _cost_sentence(study: AccuracyStudy, s: AccuracySummary, identified: float) -> str:
    """Cost of ignoring effects that the machines have."""
    named = joined(study.ignored)
    sizes = f"{tool_mm(s.after)} RMS at the tool, {tool_mm(identified)} if"
    which = "it is" if len(study.ignored) == 1 else "they are"
    cost = s.after - identified
    if cost > max(SIGNIFICANT * s.cost_standard_error, LEAST_COST * identified):
        return f"Ignoring {named} costs {tool_mm(cost)}: {sizes} {which} identified."
    return f"Ignoring {named} costs nothing noticeable: {sizes} {which} identified."


def _tool_table(s: AccuracySummary, predicted: dict[str, float]) -> RenderableType:
    aligned, shift, absolute = (_um(v * UM) for v in predicted.values())
    rows = (
        ("aligned", _um(s.before), _um(s.after), _um(s.standard_error), aligned),
        ("translation removed", "", _um(s.shift_removed), "", shift),
        ("absolute", "", _um(s.absolute), "", absolute),
        ("worst point, aligned", "", _um(s.worst_point), "", ""),
    )
    header = ("[µm]", "before", "after", "std. error", "predicted")
    return section("Tool error, RMS", table_of(header, rows))


def _parameter_table(
    header: Sequence[str],
    parameters: Sequence[dict[str, Any]],
    rows: Sequence[Sequence[str]],
    order: str,
    all_rows: bool,
) -> RenderableType:
    """Table with a row of numbers for each parameter, for the first ones only or for all.

    Args:
        header: Headers of the numbers.
        parameters: The parameters, with their names and units.
        rows: Numbers of each parameter.
        order: Words for the parameters that are listed; {} is their number.
        all_rows: Whether to list all.
    """
    cells = [(p["name"], *row, p["unit"]) for p, row in zip(parameters, rows, strict=True)]
    shown = cells if all_rows else cells[:MOST_ROWS]
    omitted = ""
    if len(shown) < len(cells):
        omitted = f"{order.format(len(shown))} of {len(cells)}; --all lists all."
    return noted(table_of(("parameter", *header, "unit"), shown), omitted)


def _bootstrap(table: StudyTable, all_rows: bool) -> StudyReport:
    s = summarise_bootstrap(table.study, table)  # type: ignore[arg-type] # by its kind
    names = ("estimate", "std", "standard_error", "low", "high", "predicted", "model_std")
    parameters = _parameters(s.parameters, names)
    rows = [
        (
            f"{p['estimate']:+.3f}",
            *(_number(p[name]) for name in ("std", "predicted")),
            f"{p['low']:+.3f} … {p['high']:+.3f}",
            _number(p["model_std"]),
        )
        for p in parameters
    ]
    header = ("estimate", "std", "predicted std", "95 % of draws", "model std")
    estimates = _parameter_table(header, parameters, rows, "The first {}", all_rows)
    notes = (
        "std and predicted std: by noise alone. Model std: with the prior, but without errors "
        "that are not identified.",
    )
    document = {
        "draws": s.draws,
        "sigma_um": s.sigma / UM,
        "fewest_cycles": s.fewest_cycles,
        "parameters": parameters,
    }
    tables = (section("Estimates", estimates),)
    return StudyReport("bootstrap", _bootstrap_answer(s), tables, (s,), document, notes)


def _bootstrap_answer(s: BootstrapSummary) -> str:
    scattered = [p for p in s.parameters if p.predicted > 0.0 and math.isfinite(p.std)]
    if not scattered:
        return "The estimates do not scatter."
    ratios = np.array([p.std / p.predicted for p in scattered])
    text = (
        f"Scatter of the estimates: {float(np.median(ratios)):.2f} times the standard deviation "
        f"that the covariance predicts from noise ({ratios.min():.2f} to {ratios.max():.2f} times, "
        f"{counted(s.draws, 'draw')})."
    )
    if s.fewest_cycles is not None:
        uncertainty = 1.0 / math.sqrt(2.0 * (s.fewest_cycles - 1) * len(scattered))
        text += (
            f" With {s.fewest_cycles} cycles the standard error of this ratio is about "
            f"{100.0 * uncertainty:.0f} %."
        )
    return text


def _linearisation(table: StudyTable, all_rows: bool) -> StudyReport:
    s = summarise_linearisation(table.study, table)  # type: ignore[arg-type] # by its kind
    count = len(s.sizes)
    chosen = sorted({round(i) for i in np.linspace(0, count - 1, min(count, 8))})
    errors = [(METHOD_NAMES[m.name], *(_number(m.errors[i]) for i in chosen)) for m in s.methods]
    errors.append(("linearised reading", *(_number(s.reading[i]) for i in chosen)))
    steps = (str(s.steps[i] or "none") for i in chosen)
    errors.append(("Gauss-Newton steps to convergence", *steps))
    limits = [
        (
            METHOD_NAMES[m.name],
            *(
                "-" if size is None else f"{size:.3g}"
                for size in (m.exceeds_resolution, m.exceeds_noise, m.fails)
            ),
        )
        for m in s.methods
    ]
    sizes = tuple(f"{s.sizes[i]:.3g}" for i in chosen)
    limit_header = ("smallest size", "error > resolution", "error > standard error", "fails")
    tables = (
        section(
            "Error of the estimates, RMS over directions [mm]",
            table_of(("size [mm]", *sizes), errors),
        ),
        section("Limits of the methods [mm]", table_of(limit_header, limits)),
    )
    document = {
        "sizes_mm": s.sizes.tolist(),
        "resolution_mm": s.resolution,
        "reading_mm": s.reading.tolist(),
        "steps": list(s.steps),
        "measurable_up_to_mm": s.measurable,
        "methods": [
            {
                "name": m.name,
                "error_mm": m.errors.tolist(),
                "standard_error_mm": m.standard_error,
                "exceeds_resolution_from_mm": m.exceeds_resolution,
                "exceeds_noise_from_mm": m.exceeds_noise,
                "fails_from_mm": m.fails,
            }
            for m in s.methods
        ],
    }
    answer = _linearisation_answer(s)
    return StudyReport("linearisation", answer, tables, (s, METHOD_NAMES), document)


def _linearisation_answer(s: LinearisationSummary) -> str:
    methods = {m.name: m for m in s.methods}
    sentences = []
    for name, subject in (
        ("six", "The paper's six equations are"),
        ("first_order", "The first-order solution is"),
    ):
        if name in methods:
            sentences.append(_limit_sentence(subject, methods[name], s.resolution))
    converged = [size for size, n in zip(s.sizes, s.steps, strict=True) if n is not None]
    if converged and len(converged) == len(s.sizes):
        most = max(n for n in s.steps if n is not None)
        steps = counted(most, "Gauss-Newton step")
        sentences.append(f"Convergence needs at most {steps} up to {s.sizes[-1]:g} mm.")
    elif converged:
        sentences.append(f"Undamped Gauss-Newton steps converge up to {max(converged):.3g} mm.")
    fails = methods["exact"].fails
    if fails is not None:
        sentences.append(f"The exact solver fails for some errors of {fails:.3g} mm.")
    if s.measurable is not None and s.measurable < s.sizes[-1]:
        sentences.append(f"Machines can be measured in all directions up to {s.measurable:.3g} mm.")
    return " ".join(sentences)


def _limit_sentence(subject: str, m: MethodErrors, resolution: float) -> str:
    def size(value: float | None) -> str:
        return "for no size of the errors" if value is None else f"for errors above {value:.2g} mm"

    noise = f"by more than the standard error ({m.standard_error:.3f} mm) {size(m.exceeds_noise)}."
    if not resolution > 0.0:
        return f"{subject} wrong {noise}"
    first = f"by more than the resolution ({resolution:g} mm) {size(m.exceeds_resolution)}"
    return f"{subject} wrong {first}, and {noise}"


def _sensitivity(table: StudyTable, all_rows: bool) -> StudyReport:
    s = summarise_sensitivity(table.study, table)  # type: ignore[arg-type] # by its kind
    count = len(s.parameters)
    largest_first = np.argsort(-np.abs(s.per_prior_std).max(axis=0), kind="stable")
    shown = np.sort(largest_first[: count if all_rows else MOST_COLUMNS])
    rows = [
        (posture, output, *(f"{round(row[i], 4) + 0.0:+.4f}" for i in shown))
        for (posture, output), row in zip(s.rows, s.derivatives, strict=True)
    ]
    units = ", ".join(sorted({s.units[i] for i in shown}))
    omitted = f"The {len(shown)} most influential of {count} errors; --all lists all."
    derivatives = section(
        f"First derivatives at the nominal machine [{units}]",
        noted(
            table_of(("posture", "output", *(s.parameters[i] for i in shown)), rows, left=2),
            omitted if len(shown) < count else "",
        ),
    )
    document = {
        "parameters": [{"name": n, "unit": u} for n, u in zip(s.parameters, s.units, strict=True)],
        "rows": [
            {
                "posture": posture,
                "output": output,
                "derivatives": row.tolist(),
                "um_per_prior_std": (moved / UM).tolist(),
            }
            for (posture, output), row, moved in zip(
                s.rows, s.derivatives, s.per_prior_std, strict=True
            )
        ],
    }
    return StudyReport("sensitivity", _sensitivity_answer(s), (derivatives,), (s,), document)


def _sensitivity_answer(s: SensitivitySummary) -> str:
    i, k = np.unravel_index(np.abs(s.per_prior_std).argmax(), s.per_prior_std.shape)
    posture, output = s.rows[i]
    return (
        f"Derivatives of {counted(len(s.rows), 'output')} (readings and tool coordinates) by "
        f"{counted(len(s.parameters), 'error')}. Largest change: {output} in posture {posture} "
        f"by {s.per_prior_std[i, k] / UM:+.0f} µm for one prior standard deviation of "
        f"{s.parameters[k]}."
    )


def _um(value: float) -> str:
    """A length in µm; empty for NaN."""
    size = value / UM
    if not math.isfinite(size):
        return ""
    return plain(size, 0 if abs(size) >= 100.0 else 1)


def _number(value: float) -> str:
    """A number with three significant digits, at most six decimals; empty for NaN."""
    if not math.isfinite(value):
        return ""
    if abs(value) < 5e-7:
        return "0"
    return f"{value:.3g}" if abs(value) >= 1e-4 else f"{value:.6f}"
