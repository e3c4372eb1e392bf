"""Contents of the reports of studies: answer, tables, figure and plain data of each kind."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthocal.kinematics.workspace import describe_box
from orthocal.output.study.report import (
    Curve,
    CurveFigure,
    Figure,
    IntervalFigure,
    MatrixFigure,
    ReportTable,
    StudyReport,
    to_json,
)
from orthocal.output.text.layout import counted, plain
from orthocal.study.accuracy import (
    AccuracyStudy,
    AccuracySummary,
    EstimationError,
    summarise_accuracy,
)
from orthocal.study.bootstrap import BootstrapSummary, summarise_bootstrap
from orthocal.study.linearisation import (
    LinearisationSummary,
    MethodErrors,
    summarise_linearisation,
)
from orthocal.study.runner import StudyTable
from orthocal.study.sensitivity import SensitivitySummary, summarise_sensitivity
from orthocal.units import UM

Array = NDArray[np.float64]

MOST_ROWS = 12
"""Parameters in a table unless all are asked for."""

MOST_COLUMNS = 6
"""Parameters in the table of derivatives unless all are asked for."""

MOST_INTERVALS = 40
MOST_MATRIX_COLUMNS = 40
"""Parameters in a figure."""

SIGNIFICANT = 3.0
"""Standard errors by which a result differs significantly from its prediction."""

LINEAR_PREDICTION_ERROR = 0.1
"""Relative error that a first-order prediction may have."""

SMALLEST_DRAWN_MM = 1e-4

BEFORE, AFTER, NOISE, RESOLUTION = "#E69F00", "#0072B2", "#009E73", "#777777"
"""Colours of curves and lines, as in the report of a calibration."""

METHOD_NAMES = {
    "six": "paper, six equations",
    "twelve": "paper, twelve equations",
    "twelve_gls": "paper, twelve, weighted",
    "first_order": "first order",
    "steps_2": "two Gauss-Newton steps",
    "steps_3": "three Gauss-Newton steps",
    "exact": "exact solution",
}


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
        "study": table.study.document,
        "digest": table.study.digest,
        "rows": len(table),
        "answer": report.answer,
        "summary": report.document,
    }
    return to_json(document)


def _accuracy(table: StudyTable, all_rows: bool) -> StudyReport:
    study: Any = table.study
    s = summarise_accuracy(study, table)
    predicted = {name: math.nan for name in ("aligned_um", "shift_out_um", "absolute_um")}
    if s.predicted is not None:
        sizes = s.predicted.sizes
        values = (s.predicted.headline.rms, sizes.relative.rms, sizes.absolute.rms)
        predicted = {name: v / UM for name, v in zip(predicted, values, strict=True)}
    parameters = []
    for e in s.parameters:
        f, unit = e.parameter.edge_factor, e.parameter.edge_unit
        std = {"rms": e.rms * f, "standard_error": e.standard_error * f}
        std["predicted"] = e.predicted * f
        parameters.append({"name": e.parameter.name, "unit": unit, **std, "relative": e.relative})
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
        "predicted": None if s.predicted is None else predicted,
        "parameters": parameters,
    }
    tables: tuple[ReportTable, ...] = ()
    if s.machines:
        tables = (_tool_table(s, predicted), _estimate_table(s.parameters, all_rows))
    notes = [
        f"Not calibrated: {counted(n, 'machine')} ({reason})." for reason, n in s.failed.items()
    ]
    answer = _accuracy_answer(study, s, predicted["aligned_um"] * UM)
    return StudyReport(answer, tables, _accuracy_figure(table, predicted), document, tuple(notes))


def _accuracy_answer(study: AccuracyStudy, s: AccuracySummary, predicted: float) -> str:
    if not s.machines:
        reasons = ", ".join(f"{n}: {reason}" for reason, n in s.failed.items())
        return f"None of the machines could be calibrated ({reasons})."
    sentences = [
        f"Expected tool error after calibration: {_um(s.after)} µm RMS (before: {_um(s.before)} "
        f"µm), over the workspace {describe_box(np.array(study.box))} after aligning the "
        "workpiece.",
        f"Mean of {counted(s.machines, 'machine')}, standard error {_um(s.standard_error)} µm; "
        f"95 % of the machines are below {_um(s.percentile_95)} µm.",
        "The controller corrects all identified errors.",
    ]
    if math.isfinite(predicted):
        difference = s.after - predicted
        limit = max(SIGNIFICANT * s.standard_error, LINEAR_PREDICTION_ERROR * predicted)
        worse = ", significantly less" if difference > limit and not study.fixed else ""
        kind = " for machines within their tolerances" if study.fixed else ""
        sentences.append(f"The covariance predicts {_um(predicted)} µm{kind}{worse}.")
    return " ".join(sentences)


def _tool_table(s: AccuracySummary, predicted: dict[str, float]) -> ReportTable:
    aligned, shift, absolute = (_um(v * UM) for v in predicted.values())
    rows = (
        ("aligned", _um(s.before), _um(s.after), _um(s.standard_error), aligned),
        ("translation removed", "", _um(s.shift_removed), "", shift),
        ("absolute", "", _um(s.absolute), "", absolute),
        ("worst point, aligned", "", _um(s.worst_point), "", ""),
    )
    header = ("[µm]", "before", "after", "std. error", "predicted")
    return ReportTable("Tool error, RMS", header, rows)


def _estimate_table(errors: tuple[EstimationError, ...], all_rows: bool) -> ReportTable:
    shown = errors if all_rows else errors[:MOST_ROWS]
    rows = []
    for e in shown:
        f = e.parameter.edge_factor
        values = [_number(v * f) for v in (e.rms, e.standard_error, e.predicted)]
        relative = f"{100.0 * e.relative:.0f} %"
        rows.append((e.parameter.name, *values, relative, e.parameter.edge_unit))
    header = ("parameter", "error", "std. error", "predicted", "of its prior", "unit")
    omitted = ""
    if len(shown) < len(errors):
        omitted = f"The {len(shown)} least certain of {len(errors)}; --all lists all."
    return ReportTable("Errors of the estimates, RMS", header, rows, omitted=omitted)


def _accuracy_figure(table: StudyTable, predicted: dict[str, float]) -> Figure:
    curves = []
    for name, color, label in (
        ("before_um", BEFORE, "before calibration"),
        ("tool_um", AFTER, "after calibration"),
    ):
        values = np.array(table.columns.get(name, []), dtype=np.float64)
        values = np.sort(values[np.isfinite(values)])
        if values.size:
            share = 100.0 * (np.arange(values.size) + 1) / values.size
            curves.append(Curve(label, values, share, color))
    rms = predicted["aligned_um"]
    return CurveFigure(
        title="Share of machines below a tool error",
        label="Tool error before and after calibration",
        x_label="tool error, workpiece aligned [µm]",
        y_label="machines [%]",
        curves=tuple(curves),
        height=3.2,
        vertical=(("predicted RMS", rms),) if math.isfinite(rms) else (),
    )


def _bootstrap(table: StudyTable, all_rows: bool) -> StudyReport:
    s = summarise_bootstrap(table.study, table)  # type: ignore[arg-type] # by its kind
    shown = s.parameters if all_rows else s.parameters[:MOST_ROWS]
    rows, parameters = [], []
    for p in s.parameters:
        f, unit = p.parameter.edge_factor, p.parameter.edge_unit
        names = ("estimate", "std", "standard_error", "low", "high", "predicted", "total_std")
        v = {name: float(getattr(p, name) * f) for name in names}
        parameters.append({"name": p.parameter.name, "unit": unit, **v})
        stds = (_number(v[name]) for name in ("std", "predicted"))
        interval = f"{v['low']:+.3f} … {v['high']:+.3f}"
        total = _number(v["total_std"])
        rows.append((p.parameter.name, f"{v['estimate']:+.3f}", *stds, interval, total, unit))
    header = ("parameter", "estimate", "std", "predicted std", "95 % of draws", "total std", "unit")
    omitted = ""
    if len(shown) < len(rows):
        omitted = f"The first {len(shown)} of {len(rows)}; --all lists all."
    notes = (
        "std and predicted std: by noise alone. Total std: with the prior, but without errors "
        "that are not identified.",
    )
    document = {
        "draws": s.draws,
        "sigma_um": s.sigma / UM,
        "fewest_cycles": s.fewest_cycles,
        "parameters": parameters,
    }
    tables = (ReportTable("Estimates", header, rows[: len(shown)], omitted=omitted),)
    return StudyReport(_bootstrap_answer(s), tables, _bootstrap_figure(s), document, notes)


def _bootstrap_answer(s: BootstrapSummary) -> str:
    known = [p for p in s.parameters if p.predicted > 0.0 and math.isfinite(p.std)]
    if not known:
        return "The estimates do not scatter."
    ratios = np.array([p.std / p.predicted for p in known])
    text = (
        f"Scatter of the estimates: {float(np.median(ratios)):.2f} times the standard deviation "
        f"that the covariance predicts from noise ({ratios.min():.2f} to {ratios.max():.2f} times, "
        f"{counted(s.draws, 'draw')})."
    )
    if s.fewest_cycles is not None:
        uncertainty = 1.0 / math.sqrt(2.0 * (s.fewest_cycles - 1) * len(known))
        text += (
            f" With {s.fewest_cycles} cycles the standard error of this ratio is about "
            f"{100.0 * uncertainty:.0f} %."
        )
    return text


def _bootstrap_figure(s: BootstrapSummary) -> Figure:
    shown = s.parameters[:MOST_INTERVALS]
    unit = np.array([p.predicted or math.nan for p in shown])
    low, high = (
        np.array([getattr(p, end) - p.estimate for p in shown]) / unit for end in ("low", "high")
    )
    names = tuple(p.parameter.name for p in shown)
    title = "Intervals of 95 % of the draws, in predicted standard deviations"
    return IntervalFigure(title, "Intervals of the draws", names, low, high, band=1.96)


def _linearisation(table: StudyTable, all_rows: bool) -> StudyReport:
    s = summarise_linearisation(table.study, table)  # type: ignore[arg-type] # by its kind
    count = len(s.sizes)
    chosen = sorted({round(i) for i in np.linspace(0, count - 1, min(count, 8))})
    errors = [(METHOD_NAMES[m.name], *(_number(m.errors[i]) for i in chosen)) for m in s.methods]
    errors.append(("linearised reading", *(_number(s.reading[i]) for i in chosen)))
    steps = (str(s.steps[i] or "none") for i in chosen)
    errors.append(("Gauss-Newton steps to convergence", *steps))
    limits = [
        (METHOD_NAMES[m.name], *("-" if v is None else f"{v:.3g}" for v in _limits(m)))
        for m in s.methods
    ]
    sizes = tuple(f"{s.sizes[i]:.3g}" for i in chosen)
    limit_header = ("smallest size", "error > resolution", "error > standard error", "fails")
    tables = (
        ReportTable(
            "Error of the estimates, RMS over directions [mm]", ("size [mm]", *sizes), errors
        ),
        ReportTable("Limits of the methods [mm]", limit_header, limits),
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
    return StudyReport(_linearisation_answer(s), tables, _linearisation_figure(s), document)


def _limits(m: MethodErrors) -> tuple[float | None, ...]:
    return m.exceeds_resolution, m.exceeds_noise, m.fails


def _linearisation_answer(s: LinearisationSummary) -> str:
    methods = {m.name: m for m in s.methods}
    sentences = []
    for name, subject in (
        ("six", "the paper's six equations"),
        ("first_order", "the first-order solution"),
    ):
        if name in methods:
            sentences.append(
                _limit_sentence(f"The error of {subject}", methods[name], s.resolution)
            )
    converged = [size for size, n in zip(s.sizes, s.steps, strict=True) if n is not None]
    if converged and len(converged) == len(s.sizes):
        most = max(n for n in s.steps if n is not None)
        steps = counted(most, "Gauss-Newton step")
        sentences.append(f"Convergence needs at most {steps} up to {s.sizes[-1]:g} mm.")
    elif converged:
        sentences.append(f"Undamped Gauss-Newton steps converge up to {max(converged):.3g} mm.")
    fails = methods["exact"].fails
    if fails is not None:
        sentences.append(f"The exact solver fails in a direction from {fails:.3g} mm on.")
    if s.measurable is not None and s.measurable < s.sizes[-1]:
        sentences.append(f"Machines can be measured in all directions up to {s.measurable:.3g} mm.")
    return " ".join(sentences)


def _limit_sentence(subject: str, m: MethodErrors, resolution: float) -> str:
    def size(value: float | None) -> str:
        return "for no size" if value is None else f"from a size of {value:.2g} mm on"

    noise = f"the standard error ({m.standard_error:.3f} mm) {size(m.exceeds_noise)}."
    if not resolution > 0.0:
        return f"{subject} exceeds {noise}"
    first = f"{subject} exceeds the resolution ({resolution:g} mm) {size(m.exceeds_resolution)}"
    return f"{first}, {noise}"


def _linearisation_figure(s: LinearisationSummary) -> Figure:
    looks = {
        "six": (BEFORE, "-", 3.0),
        "first_order": (AFTER, "-", 1.5),
        "steps_2": (AFTER, "--", 1.5),
        "steps_3": (AFTER, ":", 1.5),
    }
    curves = [
        Curve(METHOD_NAMES[m.name], s.sizes, m.errors, *looks[m.name])
        for m in s.methods
        if m.name in looks
    ]
    noise = next(m for m in s.methods if m.name == "first_order").standard_error
    lines = [("standard error", noise, NOISE)]
    if s.resolution > 0.0:
        lines.append(("resolution", s.resolution, RESOLUTION))
    finite = [m.errors[np.isfinite(m.errors)].max(initial=0.0) for m in s.methods]
    return CurveFigure(
        title="Error of linearised identification",
        label="Error of linearised identification by the size of the machine's errors",
        x_label="largest error of the machine [mm]",
        y_label="error of the estimates [mm]",
        curves=tuple(curves),
        height=3.6,
        y_range=(SMALLEST_DRAWN_MM, max(*finite, 10.0 * SMALLEST_DRAWN_MM)),
        horizontal=tuple(lines),
    )


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
    derivatives = ReportTable(
        f"First derivatives at the nominal machine [{units}]",
        ("posture", "output", *(s.parameters[i] for i in shown)),
        rows,
        left=2,
        omitted=""
        if len(shown) == count
        else f"The {len(shown)} most influential of {count} errors; --all lists all.",
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
    drawn = np.sort(largest_first[:MOST_MATRIX_COLUMNS])
    number = f"{len(drawn)} of {count}" if len(drawn) < count else f"{count}"
    figure = MatrixFigure(
        title=f"Change by one prior standard deviation of each error [µm], {number} errors",
        label="Sensitivity of each reading to each error",
        rows=tuple(f"{posture}  {output}" for posture, output in s.rows),
        columns=tuple(s.parameters[i] for i in drawn),
        values=s.per_prior_std[:, drawn] / UM,
    )
    return StudyReport(_sensitivity_answer(s), (derivatives,), figure, document)


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
