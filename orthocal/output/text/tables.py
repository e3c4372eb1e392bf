"""Tables of a calibration, in its printed details and in its report."""

from __future__ import annotations

import math
from collections.abc import Callable

from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.assessment.assess import assessment_of
from orthocal.assessment.fit_findings import find_held, find_unresolved
from orthocal.assessment.wording import counted, mm, plain, signed
from orthocal.assessment.words.anomalies import describe_evidence
from orthocal.assessment.words.fit import MAX_LISTED
from orthocal.calibration.assessment_record import FindingKind
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.records import ParameterEstimate
from orthocal.calibration.refit import restore_session
from orthocal.estimation.diagnostics.residual_rows import ResidualRow, largest_first
from orthocal.observation.sensor_groups import nominal_values
from orthocal.output.text.answer import name_values
from orthocal.output.text.layout import (
    NOISE_SOURCES,
    bullets,
    noted,
    residual_table,
    table_of,
    table_of_records,
)
from orthocal.robot.parameters import is_offset
from orthocal.text import list_some
from orthocal.units import MM, UM, show_limit

MANY_PARAMETERS = 12
"""Number of parameters above which only identified ones are listed."""

RECOMMENDING: tuple[FindingKind, ...] = (
    "no change needed",
    "must change",
    "not significant",
    "tool error",
)
"""Kinds of findings that recommend values, which doubtful readings do not."""

NOTHING = 1e-8
"""Deviations below this are zero, [m]."""

LISTED_SHARE = 0.5
"""Share of the prior variance that the readings remove from a listed parameter, at least."""

MOST_TERMS = 5
"""Largest number of printed terms of a combination."""

MOST_GROUPS = 6
"""Largest number of listed groups of inseparable parameters."""

MOST_PAIRS = 8
"""Largest number of listed pairs of correlated parameters."""


def render_parameters(calibration: Calibration, *, all_rows: bool = False) -> RenderableType:
    """Estimates and expanded uncertainties of the identified parameters, or of all."""
    c, prior = calibration, calibration.prior
    profiled = any(p.interval for p in c.free)
    by_noise = all_rows and any(p.std_scatter < p.std for p in c.free)
    in_std = c.solver.shows_linearisation_error and not profiled
    shifts = in_std and not prior
    few = all_rows or len(c.free) <= MANY_PARAMETERS
    rows = []
    for p, half in zip(c.free, c.expanded_uncertainties.tolist(), strict=True):
        if not (few or _is_listed(p)):
            continue
        f, shift = p.edge_factor, p.value - p.linear
        row = {"parameter": p.name}
        if c.solver.name == "linearised":
            row["linearised"] = signed(p.value * f)
        else:
            row |= {"linear": signed(p.linear * f), "exact": signed(p.value * f)}
        row["±"] = "at bound" if p.at_bound else plain(half * f)
        if by_noise:
            noise = min(half, float(c.expand(p.std_scatter, p.std_scatter, 0.0)))
            row["± by noise"] = plain(noise * f)
        if prior:
            row["resolved"] = f"{p.data_share:.0%}" if math.isfinite(p.data_share) else ""
        if profiled:
            row["95 % profile interval"] = _interval(*p.interval, f) if p.interval else ""
        if shifts:
            row["exact − linear"] = signed(shift * f, 4)
        if in_std:
            header = "in std" if shifts else "exact − linear [std]"
            row[header] = f"{shift / p.std:+.3f}" if p.std > 0.0 else ""
        rows.append(row | {"unit": p.edge_unit})
    notes = _parameter_notes(c, omitted=len(c.free) - len(rows), by_noise=by_noise)
    return noted(table_of_records(rows), *notes)


def _parameter_notes(c: Calibration, *, omitted: int, by_noise: bool) -> list[str]:
    """Sentences under the table of the parameters."""
    notes = []
    if not c.only_offsets and assessment_of(c).entries:
        enter = " to enter" * (assessment_of(c).decision.verdict == "enter")
        notes.append(f"Offsets of the drives. The best ones{enter} differ: see {name_values(c)}.")
    if omitted:
        notes.append(f"{omitted} more are resolved by less than half; --all lists them.")
    held = [p for p in c.parameters if not p.free]
    if held:
        values = ", ".join(f"{p.name} = {p.value * p.edge_factor:g} {p.edge_unit}" for p in held)
        notes.append(f"Held at known values: {values}")
    notes += [finding.text for finding in find_held(c)]
    if by_noise:
        notes.append("± by noise: part of ± that is due to the noise of the readings")
    if c.prior:
        notes.append("resolved: how much the readings improved a value; 100 %: completely")
    pairs = c.correlated(above=0.5)
    if pairs:
        listed = list_some([f"{a} with {b} {r:+.2f}" for a, b, r in pairs], MOST_PAIRS)
        notes.append(f"Correlations above 0.5: {listed}")
    return notes


def _is_listed(p: ParameterEstimate) -> bool:
    return (
        is_offset(p.name)
        or p.at_bound is not None
        or p.interval is not None
        or not p.prior
        or p.data_share >= LISTED_SHARE
    )


def _interval(low: float, high: float, factor: float) -> str:
    if not (math.isfinite(low) and math.isfinite(high)):
        return "unknown"
    return f"{signed(low * factor)} … {signed(high * factor)}"


def render_identifiability(calibration: Calibration, *, all_rows: bool = False) -> RenderableType:
    """Identifiable combinations of parameters, and inseparable parameters."""
    spectrum, base = calibration.identifiability, calibration.base
    count = spectrum.singular_values.size
    threshold = f"{spectrum.threshold / UM:.3g} µm per prior standard deviation"
    if base:
        lines = [
            f"{count} base parameters: combinations of errors that the readings separate, with "
            f"singular values above the noise ({threshold})."
        ]
    else:
        lines = [
            f"Rank {spectrum.rank} of {count}: combinations of parameters with singular values "
            f"above the noise ({threshold}). Rank without noise: {spectrum.structural_rank}."
        ]
    nuisance, checks = round(spectrum.n_nuisance, 1), round(calibration.redundancy, 1)
    of_sensors = f", {nuisance:g} the nuisance parameters of the gauges" if nuisance else ""
    readings = counted(spectrum.n_readings, "independent reading")
    lines.append(
        f"{readings}: {calibration.structural_rank} determine the errors of the machine"
        f"{of_sensors}, {f'{checks:g}' if checks else 'none'} check the model."
    )
    if spectrum.rank:
        o = spectrum.observability
        lines.append(
            f"Condition number {spectrum.condition:.3g}. Observability indices, per prior standard "
            f"deviation: O1 {o['O1'] / MM:.3g} mm, O2 {o['O2']:.3g}, O3 {o['O3'] / MM:.3g} mm, "
            f"O4 {o['O4'] / MM:.3g} mm, O5 {o['O5'] / MM:.3g} mm. Compare them only between plans "
            "of the same rank."
        )
    hidden = find_unresolved(calibration)
    groups = [f.text for f in hidden if f.kind == "inseparable"]
    lines += groups if all_rows else groups[:MOST_GROUPS]
    if not all_rows and len(groups) > MOST_GROUPS:
        lines.append(f"{len(groups) - MOST_GROUPS} more such groups; --all lists them.")
    for below in (f for f in hidden if f.kind == "below the noise"):
        names = [p.parameter or "" for p in below.places]
        lines.append(below.text)
        if len(names) > MAX_LISTED:
            lines[-1] += f" They are {', '.join(names)}." if all_rows else " --all lists them."
    sums = [c for c in spectrum.base if len(c.terms) > 1]
    if base:
        most = None if all_rows else MOST_TERMS
        lines += [f"{c.terms[0][0]} represents {c.shorten(most)}" for c in sums]
    elif all_rows:
        lines += [f"Base parameter: {c.formula}" for c in sums]
    return Group(*map(Text, lines))


def render_findings(calibration: Calibration) -> RenderableType:
    """All findings about readings and values to enter.

    `render_identifiability` lists those about identifiability. Findings about values to enter are
    omitted if the readings are doubtful.
    """
    assessment = assessment_of(calibration)
    trusted = assessment.decision.verdict == "enter"
    omitted = ("inseparable", "below the noise", *(() if trusted else RECOMMENDING))
    return bullets(
        [
            f"{f.words} {describe_evidence(f)}".strip()
            for f in assessment.findings
            if f.kind not in omitted
        ]
    )


def render_readings(
    calibration: Calibration, *, all_rows: bool = False, worst_first: bool = False
) -> RenderableType:
    """Readings before and after calibration, the worst of many or all."""
    residuals = calibration.residuals
    if worst_first:
        residuals = tuple(largest_first(residuals))
    notes = [
        "before, after: measured less nominal, measured less calibrated",
        "studentised: deviation from the prediction by all other readings, in its σ; influence: "
        "largest change of a parameter without this reading, in its σ",
    ]
    if not calibration.rows_are_differences:
        notes[0] += ", each with its best gauge zeros"
    columns: dict[str, Callable[[ResidualRow], str]] = {
        "measured [mm]": lambda r: signed(r.measured / MM),
        "before [mm]": lambda r: signed(r.deviation / MM),
        "after [mm]": lambda r: signed(r.residual / MM),
        "in σ": lambda r: _ratio(r.residual, calibration.row_sigma(r)),
        "studentised": lambda r: f"{r.studentised:+.1f}" if math.isfinite(r.studentised) else "",
        "influence": lambda r: f"{r.influence:.1f}",
    }
    return residual_table(residuals, columns, *notes, all_rows=all_rows)


def _ratio(value: float, std: float) -> str:
    return f"{value / std:+.1f}" if std > 0.0 else ""


def describe_change(before: float, after: float) -> str:
    """Relative change by the calibration, such as "-93%"; "" for negligible deviations, [m]."""
    return f"{after / before - 1.0:+.0%}" if before > NOTHING else ""


def render_fit(calibration: Calibration) -> RenderableType:
    """RMS and largest deviation before and after calibration, and the noise."""
    c, noise = calibration, calibration.noise
    sizes = {
        "RMS [mm]": (c.rms_before, c.rms_after),
        "largest [mm]": (c.largest_before, c.largest_after),
    }
    rows = [(name, *map(mm, ends), describe_change(*ends)) for name, ends in sizes.items()]
    table = table_of(("", "before", "after", ""), rows)
    if len(c.gauges) > 1:
        return noted(table, *(f"σ of {g.name}: {mm(g.noise.sigma)} mm" for g in c.gauges))
    row = "a difference" if c.rows_are_differences else "a reading"
    dof = "" if math.isinf(c.dof) else f", {round(c.dof, 1):g} degrees of freedom"
    text = f"σ of {row}: {mm(c.sigma)} mm, {NOISE_SOURCES[noise.source]}{dof}"
    if not math.isfinite(noise.sigma):
        text = f"σ of {row}: {NOISE_SOURCES['unknown']}"
    elif c.rows_are_differences:
        text += f" (of one reading {mm(noise.sigma)} mm)"
    lines = [text]
    if noise.cycles_dof > 0 and noise.source != "cycles":
        lines.append(
            f"σ of a reading from repeated cycles: {mm(noise.cycles_sigma)} mm, "
            f"{noise.cycles_dof} degrees of freedom"
        )
    stated = c.gauges[0].sigma
    if stated is not None and noise.source != "gauge":
        text = f"σ stated for the gauge: {mm(stated)} mm a reading"
        if c.rows_are_differences:
            text += f", {mm(stated * math.sqrt(2.0))} mm a difference"
        lines.append(text)
    return noted(table, *lines)


def render_sensors(calibration: Calibration) -> RenderableType | None:
    """Noise of several gauges, and nuisance parameters; None if there is neither."""
    parts: list[RenderableType] = []
    if len(calibration.gauges) > 1:
        stated = ["" if g.sigma is None else mm(g.sigma) for g in calibration.gauges]
        rows = [
            (g.name, str(g.readings), text, mm(g.noise.sigma), "mm")
            for g, text in zip(calibration.gauges, stated, strict=True)
        ]
        table = table_of(("gauge", "readings", "σ stated", "σ estimated", "unit"), rows)
        note = "Weights are by σ estimated: from repeated cycles, else from the residuals."
        parts.append(noted(table, note))
    if calibration.sensors:
        rows, nominal = [], nominal_values(restore_session(calibration))
        for p in calibration.sensors:
            half = calibration.expand_estimate(p)
            f = p.edge_factor
            actual = nominal.get(p.name, 0.0) + p.value
            limits = (plain(half * f), plain(show_limit(p.prior_std) * f))
            rows.append((p.name, signed(actual * f), *limits, p.edge_unit))
        table = table_of(("nuisance parameter", "estimate", "±", "tolerance", "unit"), rows)
        meaning = "Estimated together with the errors of the machine."
        if any(p.name in nominal for p in calibration.sensors):
            meaning += " Lengths and positions are actual ones, not differences from stated ones."
        parts.append(noted(table, meaning))
    return Group(*parts) if parts else None
