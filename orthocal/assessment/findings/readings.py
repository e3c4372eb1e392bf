"""What single readings and setups show: wrong signs, slips, repeated readings that differ."""

from __future__ import annotations

import math

from orthocal.assessment.findings.finding import Finding, Place, place_of
from orthocal.assessment.wording import joined, mm, signed
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.refit import restore_session
from orthocal.errors import ClosureError, RobotError
from orthocal.estimation.diagnostics.idealisation import find_idealised
from orthocal.estimation.diagnostics.residual_rows import ResidualRow
from orthocal.units import MM

NOTABLE_IDEALISATION = 1 / 3
"""Of a reading's standard deviation that an idealisation must exceed to be told."""

MANY_SUSPICIOUS = 0.2
"""Part of the readings above which it is not the readings that are wrong."""

CLEARLY_FURTHER = 1.5
"""Times the residual of another that one of two repeated readings must have to be the wrong one."""


def find_turned(calibration: Calibration) -> list[Finding]:
    """A setup that was read with the wrong sign."""
    turned = calibration.turned
    if turned is None:
        return []
    names = (turned.name, *turned.also)
    text = (
        f"The readings of setup {joined(names, 'or')} seem to have the wrong sign. As they are, "
        f"they differ from what all others say by {mm(turned.as_read)} mm (r.m.s.); with the sign "
        f"turned by {mm(turned.turned)} mm."
    )
    if not math.isfinite(turned.as_read):
        text = (
            f"The readings of setup {joined(names, 'or')} seem to have the wrong sign: with the "
            "sign turned they are such as the machine would show, as they are they are not."
        )
    return [
        Finding(
            "turned setup",
            "stops",
            text,
            "See which way the gauge stood and whether a minus was forgotten; then turn the signs, "
            "or `direction`, and calibrate again.",
            numbers={
                "as_read_rms_mm": turned.as_read / MM,
                "turned_rms_mm": turned.turned / MM,
                "log_likelihood_ratio": turned.evidence,
            },
            places=tuple(Place(setup=name) for name in names),
        )
    ]


def find_line(calibration: Calibration) -> list[Finding]:
    """Whether it matters that a gauge touches a rod, where readings are said to be of a line."""
    sigma = calibration.noise.sigma
    try:
        found = find_idealised(restore_session(calibration))
    except (ClosureError, RobotError):  # the findings of the tool say so
        return []
    if found is None or not found.size > NOTABLE_IDEALISATION * sigma:
        return []
    return [
        Finding(
            "line in the air",
            "informs",
            f"Readings are taken as of the line between a leg's rods. On a rod itself they may "
            f"be {mm(found.size)} mm off that (one standard deviation, setup {found.setup}).",
            f"Say in the session what is touched (`touches: {found.touches}`, and the gauge's "
            "`tip`).",
            {"off_line_mm": found.size / MM, "sigma_mm": sigma / MM},
            (Place(setup=found.setup),),
        )
    ]


def stands_out(calibration: Calibration) -> tuple[ResidualRow, ...]:
    """Rows that all others contradict, the worst first; none where they are too many for that."""
    rows = calibration.suspicious
    return rows if len(rows) <= MANY_SUSPICIOUS * len(calibration.residuals) else ()


def find_suspicious(calibration: Calibration) -> list[Finding]:
    """Readings that all the others contradict, by file and line."""
    rows, count = calibration.suspicious, len(calibration.residuals)
    if not rows:
        return []
    if not stands_out(calibration):
        text = (
            f"{len(rows)} of {count} readings contradict all others by what this model and its "
            "tolerances allow: it is the model or the tolerances, not single readings."
        )
        numbers = {"readings": float(len(rows)), "of": float(count)}
        return [Finding("many contradicted", "informs", text, numbers=numbers)]
    found = [_suspicion(calibration, r) for r in rows]
    if len(rows) > 2 and len({r.setup for r in rows}) == 1:
        name = rows[0].setup
        found.append(
            Finding(
                "suspicious setup",
                "informs",
                f"All {len(rows)} suspicious readings are of setup {name}.",
                "Look at its sign, direction and section first.",
                numbers={"readings": float(len(rows))},
                places=(Place(setup=name),),
            )
        )
    return found


def _suspicion(calibration: Calibration, row: ResidualRow) -> Finding:
    cycle = f", cycle {row.cycle}" if row.cycle > 1 else ""
    return Finding(
        "suspicious reading",
        "warns",
        f"{calibration.where(row)}: {row.label}{cycle}, reads {signed(row.measured / MM)} mm, "
        f"{row.studentised:+.1f} of its σ from what all others say; without it {row.influenced} "
        f"would change by {row.influence:.1f} of its σ.",
        "Look at what stands out, read it again if it is wrong, and calibrate again.",
        numbers={
            "measured_mm": row.measured / MM,
            "expected_mm": row.predicted / MM,
            "cycle": float(row.cycle),
            "studentised": row.studentised,
            "influence": row.influence,
        },
        places=(place_of(calibration, row),),
    )


def find_scattered(calibration: Calibration) -> list[Finding]:
    """Whether repeated readings scatter more than the gauge's σ allows, and where most."""
    worst, gauge = _most_scattered(calibration), gauge_scatter(calibration)
    if not worst or gauge is None:
        return []
    scatter = calibration.noise.cycles_sigma
    shown = ", ".join(f"{signed(r.measured / MM)} in cycle {r.cycle}" for r in worst[:6])
    odd = _odd_one_out(worst)
    first = [r for r in worst if r is odd]
    where = (
        f"the one that stands apart is in {calibration.where(odd)}"
        if odd is not None
        else f"see {joined([calibration.where(r) for r in worst])}"
    )
    return [
        Finding(
            "scattered cycles",
            "warns",
            f"Repeated readings scatter by {mm(scatter)} mm, more than the gauge's {mm(gauge)} mm "
            f"explain. They differ most at {worst[0].label}: {shown} mm; {where}.",
            "Check these for a wrong sign or row before anything is entered, and read them again.",
            numbers={"scatter_mm": scatter / MM, "gauge_mm": gauge / MM},
            places=tuple(
                place_of(calibration, r) for r in [*first, *(r for r in worst if r is not odd)]
            ),
        )
    ]


def gauge_scatter(calibration: Calibration) -> float | None:
    """What repeated readings of the gauge may scatter by: its σ, and rounding to its steps, [m]."""
    sigma, step = calibration.session.gauge_sigma, calibration.session.gauge_resolution
    return None if sigma is None else math.hypot(sigma, (step or 0.0) / math.sqrt(12.0))


def _most_scattered(calibration: Calibration) -> list[ResidualRow]:
    """Repeated readings that differ most, where they differ by more than the gauge explains."""
    if not calibration.noise.cycles_scatter_more(gauge_scatter(calibration)):
        return []
    groups: dict[str, list[ResidualRow]] = {}
    for row in calibration.residuals:
        groups.setdefault(row.label, []).append(row)

    def spread(rows: list[ResidualRow]) -> float:
        return max(r.measured for r in rows) - min(r.measured for r in rows)

    return max(groups.values(), key=spread)


def _odd_one_out(rows: list[ResidualRow]) -> ResidualRow | None:
    """The repeated reading that is wrong: it differs from the others, which agree.

    Of two the one that is further from what the model says; None where neither is clearly.
    """
    if len(rows) == 2:
        right, wrong = sorted(rows, key=lambda r: abs(r.residual))
        return wrong if abs(wrong.residual) > CLEARLY_FURTHER * abs(right.residual) else None
    ordered = sorted(rows, key=lambda r: r.measured)
    values = [r.measured for r in ordered]
    below, above = values[1] - values[0], values[-1] - values[-2]
    if above > below:
        return ordered[-1] if above > values[-2] - values[0] else None
    return ordered[0] if below > values[-1] - values[1] else None
