"""Calibrations and validations as text that people read: tables, then what they mean."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable

from rich import box
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text
from scipy import special

from orthocal.identification.calibration import Calibration
from orthocal.identification.records import ResidualRow
from orthocal.study.validation import Validation

MANY_ROWS = 60
"""Readings above which only the worst are listed, unless all are asked for."""

WORST_ROWS = 20

WIDTH = 100

_SOURCES = {
    "cycles": "from repeated cycles",
    "residuals": "from the residuals",
    "gauge": "as given for the gauge",
    "unknown": "unknown",
}


def summarize(result: Calibration | Validation, *, all_rows: bool = False) -> str:
    """A calibration or a validation as plain text.

    Args:
        result: What to summarise.
        all_rows: List every reading, however many there are.
    """
    stream = io.StringIO()
    console = Console(file=stream, width=WIDTH, no_color=True, highlight=False)
    console.print(_render(result, all_rows))
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()) + "\n"


def print_summary(result: Calibration | Validation, *, all_rows: bool = False) -> None:
    """Print a calibration or a validation on the terminal, in colour."""
    Console(highlight=False).print(_render(result, all_rows))


def _render(result: Calibration | Validation, all_rows: bool) -> RenderableType:
    if isinstance(result, Calibration):
        return render_calibration(result, all_rows=all_rows)
    return render_validation(result, all_rows=all_rows)


def render_calibration(calibration: Calibration, *, all_rows: bool = False) -> RenderableType:
    """A calibration as rich renderables."""
    return Group(
        _heading(calibration),
        _section("What was identified", _parameter_table(calibration)),
        _section("Readings before and after", _residual_table(calibration, all_rows)),
        _section("How well it fits", _fit_table(calibration)),
        _section("What it means", _sentences(explain_fit(calibration))),
        _section("What to enter into the controller", _controller_table(calibration)),
    )


def render_validation(validation: Validation, *, all_rows: bool = False) -> RenderableType:
    """A validation as rich renderables."""
    table = _table("", "expected", "achieved", "further fit")
    rows = (
        ("r.m.s. [mm]", validation.expected_rms, validation.achieved_rms, validation.refit_rms),
        (
            "largest [mm]",
            validation.expected_largest,
            validation.achieved_largest,
            validation.refit_largest,
        ),
    )
    for name, *values in rows:
        _add(table, name, *(_mm(v) for v in values))
    changes = _table("parameter", "change", "± σ", "unit", "beyond chance (95 % for all)?")
    for c in validation.changes:
        _add(
            changes,
            c.name,
            _signed(c.change * c.edge_factor),
            _plain(c.std * c.edge_factor),
            c.edge_unit,
            "yes" if c.significant else "no",
        )
    return Group(
        Text("Validation of a calibration", style="bold"),
        Text(validation.title),
        _section("Deviations with the identified offsets in the controller", table),
        _section("What a further fit would still change", changes),
        _section("Readings of the new session", _validation_rows(validation, all_rows)),
        _section("What it means", _sentences(explain_validation(validation))),
    )


def explain_fit(calibration: Calibration) -> list[str]:
    """Sentences on what remains, what linearisation costs, and what can be believed."""
    sentences = []
    noise, factor = calibration.noise, calibration.row_factor
    row = "a difference" if calibration.rows_are_differences else "a reading"
    gauge = calibration.session.gauge_sigma
    if noise.source == "unknown":
        sentences.append(
            "As many parameters as readings and no word on the gauge: nothing tells how far the "
            "numbers can be trusted."
        )
    elif noise.source == "gauge":
        sentences.append(
            "There are no readings to spare: standard deviations rest on the σ given for the "
            "gauge alone, and a wrong model would not show."
        )
    if noise.source == "residuals" and noise.cycles_dof > 0:
        ratio = noise.residual_sigma / noise.cycles_sigma
        sentences.append(
            f"What remains is {ratio:.1f} times what repeated cycles scatter by "
            f"({_mm(noise.cycles_sigma)} mm a reading): it is error of the model, not noise. "
            "Standard deviations are taken from the residuals."
        )
    elif noise.source == "residuals" and gauge is not None:
        ratio = noise.residual_sigma / gauge
        low, high = _ratio_interval(noise.residual_dof)
        if ratio > high:
            sentences.append(
                f"What remains, σ = {_mm(calibration.sigma)} mm of {row}, is {ratio:.0f} times "
                f"what the gauge itself would leave ({_mm(gauge * factor)} mm): it is error of the "
                f"model (legs, axes, mounting), or a wrong sign, direction or setup; not noise of "
                f"the gauge. With the model '{calibration.model}' it will stay."
            )
        elif ratio < low:
            sentences.append(
                f"What remains is only {ratio:.2g} of what the gauge's own σ would leave: the σ "
                "given for the gauge is too large, or readings were smoothed."
            )
        else:
            sentences.append(
                "What remains is what the gauge's own σ would leave: the model is good enough "
                "for these readings."
            )
    elif noise.source == "cycles":
        sentences.append("What remains is what repeated cycles scatter by: the model fits.")
    sentences += _explain_cycles(calibration)
    sentences += _explain_linearisation(calibration)
    sentences += _explain_trust(calibration)
    return sentences


def explain_validation(validation: Validation) -> list[str]:
    """The verdict of a validation and its reasons."""
    sentences = []
    achieved, expected = _mm(validation.achieved_rms), _mm(validation.expected_rms)
    if validation.as_expected is None:
        sentences.append(
            "Whether this is as expected cannot be told: the calibration had no readings to spare "
            "that would say what to expect."
        )
    elif validation.as_expected and validation.nothing_to_change:
        sentences.append(
            f"The calibration is confirmed: r.m.s. {achieved} mm was achieved where {expected} mm "
            "was expected, and a further fit would change no parameter beyond its standard error."
        )
    elif not validation.as_expected:
        sentences.append(
            f"The calibration is not confirmed: r.m.s. {achieved} mm was achieved where {expected} "
            "mm was expected, more than chance explains. "
            + (
                "No parameter would change, so the offsets are not to blame: the readings scatter "
                "more than before, or something has moved."
                if validation.nothing_to_change
                else "Check the signs of the offsets in the controller first."
            )
        )
    else:
        names = ", ".join(c.name for c in validation.changes if c.significant)
        sentences.append(
            f"The deviations are as expected, but a further fit would change {names} beyond the "
            "standard error: calibrate again from this session."
        )
    repeat = validation.residuals_repeat
    if repeat is None:
        sentences.append("Whether what remains repeats cannot be told: too few rows are shared.")
    elif repeat:
        sentences.append(
            f"What remains repeats (correlation {validation.correlation:.3f} over "
            f"{validation.matched} rows; chance {validation.chance:.1%}): it is error of the "
            "model, which more readings of the same kind will not remove."
        )
    else:
        sentences.append(
            f"What remains does not repeat (correlation {validation.correlation:.3f} over "
            f"{validation.matched} rows): it looks like noise."
        )
    if not validation.offsets_stated:
        sentences.append(
            "The session does not state which offsets were active; the identified ones are taken."
        )
    return sentences


def _explain_linearisation(calibration: Calibration) -> list[str]:
    shifts = [(abs(p.value - p.linear), p) for p in calibration.free]
    largest, parameter = max(shifts, key=lambda s: s[0] / max(s[1].std, 1e-300))
    if math.isnan(parameter.std) or parameter.std <= 0.0:
        return []
    return [
        f"Linearising costs at most {_plain(largest * parameter.edge_factor)} "
        f"{parameter.edge_unit} ({parameter.name}), {largest / parameter.std:.2g} of its σ."
    ]


def _explain_trust(calibration: Calibration) -> list[str]:
    k = calibration.confidence_factor
    if math.isinf(k) or math.isnan(calibration.sigma) or calibration.noise.source == "gauge":
        return []
    told = {p.name for p in calibration.free if p.identifiable}
    entries = [e for e in calibration.controller_entries() if f"{e.drive}.offset" in told]
    vague = [e.drive for e in entries if abs(e.change) <= k * e.std]
    clear = [e.drive for e in entries if abs(e.change) > k * e.std]
    sentences = []
    if clear:
        sentences.append(f"Offsets that the readings prove (95 %): {', '.join(clear)}.")
    if vague:
        sentences.append(
            f"Offsets whose 95 % interval holds no change at all: {', '.join(vague)}. They are "
            "still the best estimate, but do not expect much of them."
        )
    if len(calibration.free) == len(calibration.controller_entries()):
        sentences.append(
            "± σ is what the scatter leaves open if legs and axes are perfect; where they are "
            "not, these are the offsets that make up for it best in the postures measured."
        )
    return sentences


def _explain_cycles(calibration: Calibration) -> list[str]:
    """Whether repeated readings scatter more than the gauge's σ allows, and where most."""
    noise, gauge = calibration.noise, calibration.session.gauge_sigma
    if noise.cycles_dof == 0 or gauge is None:
        return []
    if noise.cycles_sigma / gauge <= _ratio_interval(noise.cycles_dof)[1]:
        return []
    groups: dict[tuple[str, str], list[ResidualRow]] = {}
    for row in calibration.residuals:
        groups.setdefault((row.setup, row.label), []).append(row)

    def spread(rows: list[ResidualRow]) -> float:
        return max(r.measured for r in rows) - min(r.measured for r in rows)

    worst = max(groups.values(), key=spread)
    shown = ", ".join(f"{_signed(r.measured * 1e3)} in cycle {r.cycle}" for r in worst[:6])
    return [
        f"Repeated readings scatter by {_mm(noise.cycles_sigma)} mm, more than the gauge's "
        f"{_mm(gauge)} mm explain. They differ most at {worst[0].label}: {shown} mm. Check these "
        "for a wrong sign or row before anything is entered."
    ]


def _ratio_interval(dof: float) -> tuple[float, float]:
    """Where a standard deviation from dof degrees of freedom lies, as a ratio, 98 %."""
    low, high = (float(special.chdtri(dof, p)) for p in (0.99, 0.01))
    return math.sqrt(low / dof), math.sqrt(high / dof)


def _heading(calibration: Calibration) -> RenderableType:
    session, solver = calibration.session, calibration.solver
    kind = "differences" if calibration.rows_are_differences else "readings"
    legs = ", ".join(sorted({s.leg for s in calibration.setups}))
    lines = [
        Text(
            f"Calibration of {calibration.robot_record.name}, model '{calibration.model}'",
            style="bold",
        ),
        Text(session.title),
    ]
    if session.source:
        lines.append(Text(f"Source: {session.source}"))
    used = {r.posture for r in calibration.residuals} | {
        r.minus for r in calibration.residuals if r.minus
    }
    lines.append(
        Text(
            f"Measured: {len(calibration.residuals)} {kind} in {len(used)} postures, "
            f"{len(calibration.setups)} setups on legs {legs}"
        )
    )
    prior = "tolerances as prior" if calibration.prior else "no prior"
    lines.append(
        Text(
            f"Solved: {len(calibration.free)} parameters, {prior}; Ipopt {solver.status}, "
            f"{solver.iterations} iterations, {solver.seconds_build + solver.seconds_solve:.2f} s"
        )
    )
    return Group(*lines)


def _parameter_table(calibration: Calibration) -> RenderableType:
    table = _table(
        "parameter", "linear", "exact", "± σ", "95 % interval", "exact − linear", "in σ", "unit"
    )
    k = calibration.confidence_factor
    for p in calibration.free:
        f = p.edge_factor
        half = k * p.std * f
        interval = f"{_signed(p.value * f - half)} … {_signed(p.value * f + half)}"
        _add(
            table,
            p.name + ("" if p.identifiable else " *"),
            _signed(p.linear * f),
            _signed(p.value * f),
            _plain(p.std * f),
            interval if math.isfinite(half) else "unknown",
            _signed((p.value - p.linear) * f, 4),
            f"{(p.value - p.linear) / p.std:+.3f}" if p.std > 0.0 else "",
            p.edge_unit,
        )
    held = [p for p in calibration.parameters if not p.free]
    notes: list[RenderableType] = [table]
    if held:
        values = ", ".join(f"{p.name} = {p.value * p.edge_factor:g} {p.edge_unit}" for p in held)
        notes.append(Text(f"Held at known values: {values}"))
    if any(not p.identifiable for p in calibration.free):
        notes.append(
            Text(
                "* the readings alone do not tell it better than its tolerance, "
                "which acts as a prior"
            )
        )
    return Group(*notes)


def _residual_table(calibration: Calibration, all_rows: bool) -> RenderableType:
    noise = calibration.noise.reading_sigma

    def spread(row: ResidualRow) -> float:
        return noise * (math.sqrt(2.0) if row.minus else 1.0)

    rows, note = _choose_rows(calibration.residuals, all_rows)
    cycles = any(r.cycle != 1 for r in calibration.residuals)
    raw = not calibration.rows_are_differences
    columns = ["setup", "posture", *(["cycle"] if cycles else []), "measured [mm]"]
    table = _table(*columns, "before [mm]", "after [mm]", "after in σ", left=2)
    for r in rows:
        where = f"{r.posture} − {r.minus}" if r.minus else r.posture
        _add(
            table,
            r.setup,
            where,
            *([str(r.cycle)] if cycles else []),
            _signed(r.measured * 1e3),
            _signed(r.deviation * 1e3),
            _signed(r.residual * 1e3),
            f"{r.residual / spread(r):+.1f}" if spread(r) > 0.0 else "",
        )
    parts: list[RenderableType] = [table]
    if raw:
        parts.append(Text("Before and after: measured less model, each with its best gauge zeros."))
    if note:
        parts.append(Text(note))
    return Group(*parts)


def _validation_rows(validation: Validation, all_rows: bool) -> RenderableType:
    rows, note = _choose_rows(validation.rows, all_rows)
    cycles = any(r.cycle != 1 for r in validation.rows)
    table = _table(
        "setup",
        "posture",
        *(["cycle"] if cycles else []),
        "deviation [mm]",
        "after a further fit [mm]",
        left=2,
    )
    for r in rows:
        _add(
            table,
            r.setup,
            f"{r.posture} − {r.minus}" if r.minus else r.posture,
            *([str(r.cycle)] if cycles else []),
            _signed(r.deviation * 1e3),
            _signed(r.residual * 1e3),
        )
    return Group(table, Text(note)) if note else table


def _choose_rows(
    rows: tuple[ResidualRow, ...], all_rows: bool
) -> tuple[Iterable[ResidualRow], str]:
    if all_rows or len(rows) <= MANY_ROWS:
        return rows, ""
    worst = sorted(rows, key=lambda r: -abs(r.residual))[:WORST_ROWS]
    return worst, f"The {WORST_ROWS} largest of {len(rows)}; --all lists every reading."


def _fit_table(calibration: Calibration) -> RenderableType:
    c, noise = calibration, calibration.noise
    table = _table("", "before", "after", "")
    change = c.rms_after / c.rms_before - 1.0 if c.rms_before > 0.0 else 0.0
    _add(table, "r.m.s. [mm]", _mm(c.rms_before), _mm(c.rms_after), f"{change:+.0%}")
    change = c.largest_after / c.largest_before - 1.0 if c.largest_before > 0.0 else 0.0
    _add(table, "largest [mm]", _mm(c.largest_before), _mm(c.largest_after), f"{change:+.0%}")
    row = "a difference" if c.rows_are_differences else "a reading"
    dof = "" if math.isinf(c.dof) else f", {c.dof:.3g} degrees of freedom"
    text = f"σ of {row}: {_mm(c.sigma)} mm, {_SOURCES[noise.source]}{dof}"
    if c.rows_are_differences and math.isfinite(noise.reading_sigma):
        text += f" (of one reading {_mm(noise.reading_sigma)} mm)"
    lines: list[RenderableType] = [table, Text(text)]
    if noise.cycles_dof > 0 and noise.source != "cycles":
        lines.append(
            Text(
                f"σ of a reading from repeated cycles: {_mm(noise.cycles_sigma)} mm, "
                f"{noise.cycles_dof} degrees of freedom"
            )
        )
    if c.session.gauge_sigma is not None:
        text = f"σ given for the gauge: {_mm(c.session.gauge_sigma)} mm a reading"
        if c.rows_are_differences:
            text += f", {_mm(c.session.gauge_sigma * math.sqrt(2.0))} mm a difference"
        lines.append(Text(text))
    return Group(*lines)


def _controller_table(calibration: Calibration) -> RenderableType:
    entries = calibration.controller_entries()
    if not entries:
        return Text("Nothing: no offset was identified.")
    stated = entries[0].active is not None
    if stated:
        table = _table("drive", "active now", "enter", "± σ", "unit")
    else:
        table = _table("drive", "add to the present offset", "± σ", "unit")
    for e in entries:
        factor, unit = (1e3, "mm") if e.unit == "m" else (1e3, "mrad")
        now = [] if e.active is None else [_signed(e.active * factor)]
        _add(table, e.drive, *now, _signed(e.enter * factor), _plain(e.std * factor), unit)
    notes = [
        Text("An offset is what to add to the encoder's coordinate to get the slider's true one."),
    ]
    if not stated:
        notes.append(
            Text(
                "The session does not state the offsets that were active: there is no `controller`."
            )
        )
    if len(calibration.free) > len(entries):
        notes.append(
            Text(
                "The other parameters need a controller with a model of the machine; offsets alone "
                "are best taken from the model 'offsets'."
            )
        )
    return Group(table, *notes)


def _section(title: str, body: RenderableType) -> RenderableType:
    return Group(Text(), Text(title, style="bold cyan"), Padding(body, (0, 0, 0, 2)))


def _sentences(sentences: list[str]) -> RenderableType:
    return Group(*(Text(f"• {s}") for s in sentences))


def _table(*columns: str, left: int = 1) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(Text(column), justify="left" if i < left or column == "unit" else "right")
    return table


def _add(table: Table, *cells: str) -> None:
    """Add a row of plain text: names come from files, and are not markup."""
    table.add_row(*(Text(cell) for cell in cells))


def _mm(value: float) -> str:
    return _plain(value * 1e3)


def _plain(value: float, decimals: int = 3) -> str:
    return f"{value:.{decimals}f}" if math.isfinite(value) else "unknown"


def _signed(value: float, decimals: int = 3) -> str:
    return f"{value:+.{decimals}f}" if math.isfinite(value) else "unknown"
