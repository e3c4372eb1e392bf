"""What a calibration means, in sentences."""

from __future__ import annotations

import math

from orthocal.identification.calibration import Calibration
from orthocal.identification.records import ResidualRow, root_mean_square, rows_by_setup
from orthocal.identification.uncertainty import BY_CHANCE, confidence_factor
from orthocal.output.layout import mm, plain, signed
from orthocal.study.accuracy import find_excess
from orthocal.study.entering import find_entries
from orthocal.study.plausibility import find_doubts

WORST_SUSPICIOUS = 5
"""Suspicious readings that are named."""

MANY_SUSPICIOUS = 0.2
"""Part of the readings above which it is not the readings that are wrong."""

FAR_BEYOND = 4.0
"""Times the tolerances beyond which it is readings or description that are wrong."""

CLEARLY_FURTHER = 1.5
"""Times the residual of another that one of two repeated readings must have to be the wrong one."""

STANDSTILL = 1e-6
"""Part of a tolerance by which a parameter must move to have moved."""


def advise(calibration: Calibration) -> str:
    """Whether to enter what was identified, in a sentence or two; empty where no offset was."""
    if not find_entries(calibration):
        return ""
    turned = calibration.turned
    excess = find_excess(calibration)
    suspicious = len(calibration.suspicious)
    if turned is not None:
        return (
            "Do not enter these yet: the readings of setup "
            f"{' or '.join((turned.name, *turned.also))} seem to have the wrong "
            f"sign. As they are, they differ from what all others say by {mm(turned.as_read)} mm "
            f"(r.m.s.); with the sign turned by {mm(turned.turned)} mm."
        )
    doubts = find_doubts(calibration)
    if doubts and doubts[0].kind == "postures":
        return f"Do not enter these. {doubts[0].words}"
    if excess > FAR_BEYOND:
        return (
            f"Do not enter these yet: what remains is {excess:.1f} times what a machine within its "
            f"tolerances would leave.{_worst_setup(calibration)}"
        )
    if doubts:
        return f"Before you enter these make sure of this. {doubts[0].words}"
    if 0 < suspicious <= MANY_SUSPICIOUS * len(calibration.residuals):
        word = "reading contradicts" if suspicious == 1 else "readings contradict"
        return f"Before you enter these read again: {suspicious} {word} all others."
    scattered = _find_scattered(calibration)
    if scattered:
        return (
            f"Before you enter these read {scattered[0].label} again: repeated readings of it "
            "differ by more than the gauge's σ explains, as with a wrong sign or row."
        )
    if calibration.noise.source == "unknown":
        return "Enter these only if you must: nothing tells how far they can be trusted."
    if calibration.spare_readings <= 0:
        chance = calibration.chance_within_tolerances
        if chance is not None and chance >= BY_CHANCE:
            return (
                "Enter these, and measure again to confirm them: no reading is left to check "
                "them, but the readings are such as a machine within its tolerances shows."
            )
        return "Enter these only if you must: no reading is left to check them."
    if calibration.has_model_error:
        return (
            "Enter these, and measure again: they are the best for the postures measured, but what "
            "remains is error of the model, or of a whole setup, not noise."
        )
    if calibration.noise.source == "residuals" and calibration.session.gauge_sigma is None:
        return (
            "Enter these, and measure again: only what remains says how large the noise is, so "
            "error of the model, or of a whole setup, would look like noise. Repeat readings in "
            "cycles, or give gauge.sigma_mm."
        )
    return (
        "Enter these, and measure again to confirm them: what remains is what the noise of the "
        "readings leaves."
    )


def _worst_setup(calibration: Calibration) -> str:
    """Which setup is furthest from what all others say, in a sentence."""
    groups = rows_by_setup(calibration.residuals)
    sizes = {n: root_mean_square(r.unseen for r in rows) for n, rows in groups.items()}
    known = [n for n, size in sizes.items() if math.isfinite(size)]
    if not known:
        return ""
    worst = max(known, key=lambda n: sizes[n])
    return (
        f" Look at setup {worst} first: it differs by {mm(sizes[worst])} mm (r.m.s.) from what all "
        "others say."
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
    elif noise.source == "gauge" and calibration.spare_readings > 0:
        sentences.append(
            "What remains is no more than the σ given for the gauge: that is what standard "
            "deviations rest on."
        )
    elif noise.source == "gauge":
        sentences.append("Standard deviations rest on the σ given for the gauge alone.")
    if noise.source == "residuals" and noise.cycles_dof > 0:
        ratio = noise.residual_sigma / noise.cycles_sigma
        sentences.append(
            f"What remains is {ratio:.1f} times what repeated cycles scatter by "
            f"({mm(noise.cycles_sigma)} mm a reading): it is error of the model"
            f"{_blame(calibration)}; not noise. Standard deviations are taken from the residuals."
        )
    elif noise.source == "residuals" and gauge is not None:
        ratio = noise.residual_sigma / gauge
        if calibration.has_model_error:
            sentences.append(
                f"What remains, σ = {mm(calibration.sigma)} mm of {row}, is {_times(ratio)} "
                f"what the gauge itself would leave ({mm(gauge * factor)} mm): it is error of the "
                f"model{_blame(calibration)}; not noise of the gauge."
                + (
                    ""
                    if calibration.suspicious
                    else f" With the model '{calibration.model}' it will stay."
                )
            )
        elif noise.chance_in_residuals(gauge) > 1.0 - BY_CHANCE:
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
        scatter = _gauge_scatter(calibration)
        fits = (
            "the model fits."
            if scatter is None or noise.chance_in_cycles(scatter) >= BY_CHANCE
            else "but they scatter by more than the gauge explains."
        )
        sentences.append(f"What remains is what repeated cycles scatter by: {fits}")
    sentences += [doubt.words for doubt in find_doubts(calibration)]
    sentences += _explain_cycles(calibration)
    sentences += _explain_check(calibration)
    sentences += _explain_suspicious(calibration)
    sentences += _explain_linearisation(calibration)
    sentences += _explain_trust(calibration)
    sentences += _explain_standstill(calibration)
    return sentences


def _blame(calibration: Calibration) -> str:
    """What kind of error of the model it may be that remains."""
    excess = find_excess(calibration)
    left_out = calibration.unmodelled.residual_rms
    if excess == 1.0 and left_out > 0.0:
        return (
            " (legs, axes, mounting): no more than a machine within its tolerances leaves, "
            f"{mm(left_out)} mm"
        )
    return " (legs, axes, mounting), or a wrong sign, direction or setup"


def _explain_check(calibration: Calibration) -> list[str]:
    """Whether any reading is left to check the model."""
    found = calibration.identifiability
    if calibration.spare_readings > 0:
        return []
    return [
        f"The parameters can take up all {found.n_readings} independent readings, and none is left "
        "to check the model: `orthocal compare` says what the readings support."
    ]


def _explain_suspicious(calibration: Calibration) -> list[str]:
    """Rows that all the others contradict, by file and line."""
    rows = calibration.suspicious
    if not rows:
        return []
    if len(rows) > MANY_SUSPICIOUS * len(calibration.residuals):
        return [
            f"{len(rows)} of {len(calibration.residuals)} readings contradict all others by what "
            "this model and its tolerances allow: it is the model or the tolerances, not single "
            "readings."
        ]
    words = [
        f"{calibration.where(r)}: {r.label}{f', cycle {r.cycle}' if r.cycle > 1 else ''}, reads "
        f"{signed(r.measured * 1e3)} mm, {r.studentised:+.1f} of its σ from what all others say; "
        f"without it {r.influenced} would change by {r.influence:.1f} of its σ"
        for r in rows[:WORST_SUSPICIOUS]
    ]
    more = len(rows) - len(words)
    return [
        "Suspicious readings, to be looked at and read again (none was left out): "
        + "; ".join(words)
        + (f"; and {more} more." if more else ".")
        + (
            f" All are of setup {rows[0].setup}: look at its sign, direction and section first."
            if len(rows) > 2 and len({r.setup for r in rows}) == 1
            else ""
        )
    ]


def _explain_standstill(calibration: Calibration) -> list[str]:
    """Why nothing moved, if nothing did."""
    if any(abs(p.value - p.start) > STANDSTILL * p.tolerance for p in calibration.free):
        return []
    unseen = calibration.identifiability.unseen
    if len(unseen) == len(calibration.free):
        return [
            "Nothing moved: no reading depends on any free parameter, so all stay at their start."
        ]
    return [
        "Nothing moved: the readings show no deviation that these parameters would explain "
        f"(r.m.s. {mm(calibration.rms_before)} mm before). What the controller has is right, or "
        "the readings are those of a machine without errors."
    ]


def _explain_linearisation(calibration: Calibration) -> list[str]:
    if not calibration.solver.tells_linearisation:
        return []
    shifts = [
        (abs(p.value - p.linear), std, p)
        for p, std in zip(calibration.free, calibration.total_std.tolist(), strict=True)
    ]
    largest, std, parameter = max(shifts, key=lambda s: s[0] / max(s[1], 1e-300))
    if math.isnan(std) or std <= 0.0:
        return []
    return [
        f"Linearising costs at most {plain(largest * parameter.edge_factor)} "
        f"{parameter.edge_unit} ({parameter.name}), {largest / std:.2g} of its σ."
    ]


def _explain_trust(calibration: Calibration) -> list[str]:
    """Which offsets are proved, errors that were not identified taken at their tolerances."""
    entries = [e for e in find_entries(calibration) if e.held is None]
    sentences: list[str] = []
    k = calibration.confidence_factor
    if math.isinf(k) or math.isnan(calibration.sigma) or calibration.noise.source == "gauge":
        return sentences
    normal = confidence_factor(math.inf)
    clear: list[str] = []
    vague: list[str] = []
    for e in entries:
        rest = math.sqrt(max(e.std**2 - e.scatter**2, 0.0))
        proved = abs(e.change) > math.hypot(k * e.scatter, normal * rest)
        (clear if proved else vague).append(e.drive)
    if clear:
        sentences.append(
            f"Offsets that must change (95 %, with all that is not known): {', '.join(clear)}."
        )
    if vague:
        sentences.append(
            f"Offsets that might as well stay as they are (their 95 % interval, with all that is "
            f"not known, includes no change): {', '.join(vague)}. The values are still the best "
            "estimate."
        )
    return sentences


def _explain_cycles(calibration: Calibration) -> list[str]:
    """Whether repeated readings scatter more than the gauge's σ allows, and where most."""
    worst, gauge = _find_scattered(calibration), _gauge_scatter(calibration)
    if not worst or gauge is None:
        return []
    shown = ", ".join(f"{signed(r.measured * 1e3)} in cycle {r.cycle}" for r in worst[:6])
    odd = _odd_one_out(worst)
    return [
        f"Repeated readings scatter by {mm(calibration.noise.cycles_sigma)} mm, more than the "
        f"gauge's {mm(gauge)} mm explain. They differ most at {worst[0].label}: {shown} mm; "
        + (
            f"the one that stands apart is in {calibration.where(odd)}."
            if odd is not None
            else f"see {' and '.join(calibration.where(r) for r in worst)}."
        )
        + " Check these for a wrong sign or row before "
        "anything is entered."
    ]


def _find_scattered(calibration: Calibration) -> list[ResidualRow]:
    """Repeated readings that differ most, where they differ by more than the gauge explains."""
    noise, gauge = calibration.noise, _gauge_scatter(calibration)
    if noise.cycles_dof == 0 or gauge is None or noise.chance_in_cycles(gauge) >= BY_CHANCE:
        return []
    groups: dict[str, list[ResidualRow]] = {}
    for row in calibration.residuals:
        groups.setdefault(row.label, []).append(row)

    def spread(rows: list[ResidualRow]) -> float:
        return max(r.measured for r in rows) - min(r.measured for r in rows)

    return max(groups.values(), key=spread)


def _gauge_scatter(calibration: Calibration) -> float | None:
    """What repeated readings of the gauge may scatter by: its σ, and rounding to its steps, [m]."""
    sigma, step = calibration.session.gauge_sigma, calibration.session.gauge_resolution
    return None if sigma is None else math.hypot(sigma, (step or 0.0) / math.sqrt(12.0))


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


def _times(ratio: float) -> str:
    return f"{ratio:.1f} times" if ratio < 3.0 else f"{ratio:.0f} times"
