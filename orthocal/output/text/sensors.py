"""What is told of gauges and sensors: their noise, and what was not known of them."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.calibration.calibration import Calibration
from orthocal.output.text.layout import add_row, mm, plain, signed, table_of
from orthocal.statistics.chance import expanded_uncertainty

NOTE = "Identified with the machine."


def render_parts(calibration: Calibration) -> tuple[RenderableType, ...]:
    """All of them in one; nothing where one gauge is all there is."""
    parts = []
    if len(calibration.gauges) > 1:
        parts.append(_gauges(calibration))
    if calibration.sensors:
        parts.append(_sensors(calibration))
    return (Group(*parts),) if parts else ()


def _gauges(calibration: Calibration) -> RenderableType:
    table = table_of("gauge", "readings", "σ stated", "σ found", "unit")
    for gauge in calibration.gauges:
        stated = "" if gauge.sigma is None else mm(gauge.sigma)
        add_row(table, gauge.name, str(gauge.readings), stated, mm(gauge.noise), "mm")
    return Group(
        table,
        Text("Readings count by the σ found: from repeated cycles or from what is left of them."),
    )


def _sensors(calibration: Calibration) -> RenderableType:
    table = table_of("of the sensors", "found", "±", "tolerance", "unit")
    for p in calibration.sensors:
        f = p.edge_factor
        half = float(expanded_uncertainty(p.std, p.std_scatter, dof=calibration.dof))
        cells = signed(p.value * f), plain(half * f), plain(p.tolerance * f)
        add_row(table, p.name, *cells, p.edge_unit)
    return Group(table, Text(NOTE))
