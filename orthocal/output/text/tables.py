"""The parts of a calibration's summary and of its report, as tables and lines."""

from __future__ import annotations

import math

from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.assessment.fit_findings import find_held, find_unresolved
from orthocal.assessment.words.fit import FEW_NAMES
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.records import ParameterEstimate
from orthocal.estimation.diagnostics.residual_rows import ResidualRow
from orthocal.output.text.layout import add_row, choose_rows, counted, mm, plain, signed, table_of
from orthocal.statistics.chance import expanded_uncertainty
from orthocal.units import MM, UM

MANY_PARAMETERS = 12
"""Parameters above which only those that the readings tell are listed."""

NOTHING = 1e-8
"""Deviations below this are none, [m]."""

TOLD = 0.5
"""Share of its variance that the readings must take from a parameter to be listed then."""

MOST_TERMS = 5
"""Terms of a combination that are printed."""

MOST_GROUPS = 6
"""Groups that are not told apart that are listed."""

MOST_PAIRS = 8
"""Correlated pairs that are listed."""

_SOURCES = {
    "cycles": "from repeated cycles",
    "residuals": "from the residuals",
    "gauge": "as given for the gauge",
    "unknown": "unknown",
}


def render_parameters(calibration: Calibration, *, all_rows: bool = False) -> RenderableType:
    """Parameters that the readings determine, or all: estimate and expanded uncertainty."""
    c, prior = calibration, calibration.prior
    linear = c.solver.name == "linearised"
    both = c.solver.tells_linearisation
    profiled = any(p.interval for p in c.free)
    by_noise = all_rows and any(p.std_scatter < p.std for p in c.free)
    table = table_of(
        "parameter",
        *(["linearised"] if linear else ["linear", "exact"]),
        "±",
        *(["by noise"] if by_noise else []),
        *(["resolved"] if prior else []),
        *(["95 % profile interval"] if profiled else []),
        *(["exact − linear"] if both and not (prior or profiled) else []),
        *(["in std"] if both and not profiled else []),
        "unit",
    )
    few = all_rows or len(c.free) <= MANY_PARAMETERS
    uncertainties = c.expanded_uncertainties.tolist()
    listed = [
        row for row in zip(c.free, uncertainties, strict=True) if few or _worth_listing(row[0])
    ]
    for p, half in listed:
        f = p.edge_factor
        noise = float(expanded_uncertainty(p.std_scatter, p.std_scatter, dof=c.dof))
        add_row(
            table,
            p.name,
            *([] if linear else [signed(p.linear * f)]),
            signed(p.value * f),
            "at bound" if p.at_bound else plain(half * f),
            *([plain(noise * f)] if by_noise else []),
            *([_share(p)] if prior else []),
            *([_interval(*p.interval, f) if p.interval else ""] if profiled else []),
            *([signed((p.value - p.linear) * f, 4)] if both and not (prior or profiled) else []),
            *([_ratio(p.value - p.linear, p.std)] if both and not profiled else []),
            p.edge_unit,
        )
    return Group(table, *_parameter_notes(c, left_out=len(c.free) - len(listed), by_noise=by_noise))


def _parameter_notes(c: Calibration, *, left_out: int, by_noise: bool) -> list[RenderableType]:
    """Sentences under the table of the parameters."""
    notes = []
    if left_out:
        notes.append(
            f"{left_out} more of which the readings tell less than half; --all lists every "
            "parameter."
        )
    held = [p for p in c.parameters if not p.free]
    if held:
        values = ", ".join(f"{p.name} = {p.value * p.edge_factor:g} {p.edge_unit}" for p in held)
        notes.append(f"Held at known values: {values}")
    notes += [found.text for found in find_held(c)]
    if by_noise:
        notes.append("by noise: the part of ± that is due to the noise of the readings.")
    if c.prior:
        notes.append("resolved: part of the prior variance that the readings removed")
    pairs = c.correlated(above=0.5)
    if pairs:
        words = ", ".join(f"{a} with {b} {r:+.2f}" for a, b, r in pairs[:MOST_PAIRS])
        more = f", and {len(pairs) - MOST_PAIRS} more" if len(pairs) > MOST_PAIRS else ""
        notes.append(f"Correlations above 0.5: {words}{more}")
    return [Text(note) for note in notes]


def _share(p: ParameterEstimate) -> str:
    """How much the readings told of a parameter, where that can be said."""
    return f"{p.data_share:.0%}" if math.isfinite(p.data_share) else ""


def _worth_listing(p: ParameterEstimate) -> bool:
    return (
        p.name.endswith(".offset")
        or p.at_bound is not None
        or p.interval is not None
        or not p.prior
        or p.data_share >= TOLD
    )


def _ratio(value: float, std: float) -> str:
    return f"{value / std:+.3f}" if std > 0.0 else ""


def _interval(low: float, high: float, factor: float) -> str:
    if not (math.isfinite(low) and math.isfinite(high)):
        return "unknown"
    return f"{signed(low * factor)} … {signed(high * factor)}"


def render_identifiability(calibration: Calibration, *, all_rows: bool = False) -> RenderableType:
    """Identifiable combinations of parameters, and those that the readings cannot separate."""
    found = calibration.identifiability
    count = found.singular_values.size
    taken = found.n_readings - calibration.spare_readings
    o = found.observability
    sight = f"singular values above the noise, {found.threshold / UM:.3g} µm a tolerance"
    if calibration.base:
        lines = [
            f"{count} base parameters: sums of errors, each of which the readings tell apart from "
            f"those before it and better than its tolerance ({sight})."
        ]
    else:
        lines = [
            f"{found.rank} of {count} combinations of parameters, each better than its tolerance "
            f"({sight}); perfect readings of this kind would tell {found.structural_rank}."
        ]
    lines.append(
        f"Of {counted(found.n_readings, 'independent reading')} the parameters can take up "
        + (f"{taken}; the others check the model." if taken < found.n_readings else "all.")
    )
    if found.rank:
        lines.append(
            f"Condition number {found.condition:.3g}; observability O1 {o['O1'] / MM:.3g} mm, "
            f"O2 {o['O2']:.3g}, O3 {o['O3'] / MM:.3g} mm, O4 {o['O4'] / MM:.3g} mm, "
            f"O5 {o['O5'] / MM:.3g} mm a tolerance: of {counted(found.rank, 'direction')}, and "
            "to be compared only with plans that see as many."
        )
    hidden = find_unresolved(calibration)
    alike = [f.text for f in hidden if f.kind == "inseparable"]
    shown = alike if all_rows else alike[:MOST_GROUPS]
    lines += shown
    if len(shown) < len(alike):
        lines.append(f"{len(alike) - len(shown)} more such groups; --all lists them.")
    for below in (f for f in hidden if f.kind == "below the noise"):
        names = [p.parameter or "" for p in below.places]
        if len(names) <= FEW_NAMES:
            lines.append(below.text)
        else:
            listed = ", ".join(names) if all_rows else "--all lists them"
            lines.append(f"{below.text.removesuffix('.')} ({listed}).")
    sums = [c for c in found.base if len(c.terms) > 1]
    if calibration.base:
        most = None if all_rows else MOST_TERMS
        lines += [f"{c.terms[0][0]} stands for {c.shorten(most)}" for c in sums]
    elif all_rows:
        lines += [f"Told as one: {c.formula}" for c in sums]
    return Group(*(Text(line) for line in lines))


def render_residuals(
    calibration: Calibration, *, all_rows: bool = False, worst_first: bool = False
) -> RenderableType:
    """Readings before and after, the worst of many or all, in their order or the worst first."""
    noise = calibration.noise.sigma

    def spread(row: ResidualRow) -> float:
        return noise * (math.sqrt(2.0) if row.minus else 1.0)

    found = calibration.residuals
    if worst_first:
        found = tuple(sorted(found, key=lambda r: -max(abs(r.deviation), abs(r.residual))))
    rows, note = choose_rows(found, all_rows)
    cycles = any(r.cycle != 1 for r in calibration.residuals)
    raw = not calibration.rows_are_differences
    columns = ["setup", "posture", *(["cycle"] if cycles else []), "measured [mm]"]
    table = table_of(
        *columns, "before [mm]", "after [mm]", "in σ", "studentised", "moves by", left=2
    )
    for r in rows:
        add_row(
            table,
            r.setup,
            r.postures,
            *([str(r.cycle)] if cycles else []),
            signed(r.measured / MM),
            signed(r.deviation / MM),
            signed(r.residual / MM),
            f"{r.residual / spread(r):+.1f}" if spread(r) > 0.0 else "",
            f"{r.studentised:+.1f}" if math.isfinite(r.studentised) else "",
            f"{r.influence:.1f}",
        )
    parts: list[RenderableType] = [table]
    if raw:
        parts.append(Text("Before and after: measured less model, each with its best gauge zeros."))
    parts.append(
        Text(
            "studentised: as all other readings see it, in its σ; moves by: the σ by which a "
            "parameter would change without it, at most"
        )
    )
    if note:
        parts.append(Text(note))
    return Group(*parts)


def render_fit(calibration: Calibration) -> RenderableType:
    """Root mean squares before and after, and the noise."""
    c, noise = calibration, calibration.noise
    table = table_of("", "before", "after", "")
    for name, before, after in (
        ("r.m.s. [mm]", c.rms_before, c.rms_after),
        ("largest [mm]", c.largest_before, c.largest_after),
    ):
        change = f"{after / before - 1.0:+.0%}" if before > NOTHING else ""
        add_row(table, name, mm(before), mm(after), change)
    row = "a difference" if c.rows_are_differences else "a reading"
    dof = "" if math.isinf(c.dof) else f", {c.dof:.3g} degrees of freedom"
    text = f"σ of {row}: {mm(c.sigma)} mm, {_SOURCES[noise.source]}{dof}"
    if c.rows_are_differences and math.isfinite(noise.sigma):
        text += f" (of one reading {mm(noise.sigma)} mm)"
    lines: list[RenderableType] = [table, Text(text)]
    if noise.cycles_dof > 0 and noise.source != "cycles":
        lines.append(
            Text(
                f"σ of a reading from repeated cycles: {mm(noise.cycles_sigma)} mm, "
                f"{noise.cycles_dof} degrees of freedom"
            )
        )
    if c.session.gauge_sigma is not None:
        text = f"σ given for the gauge: {mm(c.session.gauge_sigma)} mm a reading"
        if c.rows_are_differences:
            text += f", {mm(c.session.gauge_sigma * math.sqrt(2.0))} mm a difference"
        lines.append(Text(text))
    return Group(*lines)
