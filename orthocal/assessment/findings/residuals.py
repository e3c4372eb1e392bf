"""What a fit leaves: noise, error of the model, a machine beyond its tolerances, or no check."""

from __future__ import annotations

import math

from orthocal.assessment.findings.finding import Finding, Place
from orthocal.assessment.findings.readings import gauge_scatter, stands_out
from orthocal.assessment.tool_error import find_excess
from orthocal.assessment.wording import mm, times
from orthocal.calibration.calibration import Calibration
from orthocal.estimation.diagnostics.residual_rows import root_mean_square, rows_by_setup
from orthocal.statistics.chance import BY_CHANCE, chance_of_excess
from orthocal.units import MM

FAR_BEYOND = 4.0
"""Times the tolerances beyond which it is readings or description that are wrong."""


def find_tolerances(calibration: Calibration) -> list[Finding]:
    """Whether more remains than a machine within its tolerances would leave."""
    excess = find_excess(calibration)
    if excess <= 1.0:
        return []
    text = f"What remains is {excess:.1f} times what a machine within its tolerances would leave"
    numbers = {
        "times_tolerances": excess,
        "left_rms_mm": calibration.rms_after / MM,
        "tolerated_rms_mm": calibration.unmodelled.residual_rms / MM,
    }
    if calibration.turned is not None or excess <= FAR_BEYOND:
        if calibration.turned is not None:
            text += ", with setups as they were read."
        elif stands_out(calibration):
            text += ": readings that all others contradict may be why."
        else:
            text += ": this machine seems to be as much worse than its tolerances."
        return [Finding("tolerances exceeded", "informs", text, numbers=numbers)]
    text += (
        ": a sign, a row or a setup is wrong, or the machine is as much worse and wants adjusting "
        "first."
    )
    name, size = _worst_setup(calibration)
    action, places = "Look at signs, rows and setups first.", ()
    if stands_out(calibration):
        action = "Look at the readings first that all others contradict."
    elif name:
        action = (
            f"Look at setup {name} first: it differs by {mm(size)} mm (r.m.s.) from what all "
            "others say."
        )
        numbers["worst_setup_rms_mm"] = size / MM
    setups = (Place(setup=name),) if name else places
    return [Finding("tolerances exceeded", "stops", text, action, numbers, setups)]


def _worst_setup(calibration: Calibration) -> tuple[str, float]:
    """Which setup is furthest from what all others say, and by how much, [m]."""
    groups = rows_by_setup(calibration.residuals)
    sizes = {n: root_mean_square(r.unseen for r in rows) for n, rows in groups.items()}
    known = {n: size for n, size in sizes.items() if math.isfinite(size)}
    worst = max(known, key=lambda n: known[n], default="")
    return worst, known.get(worst, math.nan)


def chance_within_tolerances(calibration: Calibration) -> float | None:
    """Probability that a machine within its tolerances shows such readings, or odder ones.

    Beside a prior what is left of the readings and what the parameters took of their tolerances
    add up to χ² of the readings as the prior foretells them. None where the noise is not known
    but from the residuals.
    """
    known = calibration.noise.source in ("cycles", "gauge") and calibration.sigma > 0.0
    free = calibration.free
    if not known or not calibration.prior or any(p.at_bound for p in free):
        return None
    rows = calibration.residuals
    left = sum((r.residual / calibration.sigma) ** 2 for r in rows)
    taken = sum(((p.value - p.mean) / p.tolerance) ** 2 for p in free if p.prior)
    zeros = len({r.setup for r in rows if r.minus is None})
    dof = len(rows) - zeros - sum(not p.prior for p in free)
    return chance_of_excess(left + taken, dof) if dof > 0 else None


def find_check(calibration: Calibration) -> list[Finding]:
    """Whether any reading is left to check the model."""
    if calibration.spare_readings > 0:
        return []
    count, chance = calibration.identifiability.n_readings, chance_within_tolerances(calibration)
    text = (
        f"The parameters can take up all {count} independent readings, and none is left to check "
        "the model"
    )
    numbers = {"independent_readings": float(count), "parameters": float(len(calibration.free))}
    if chance is not None and chance >= BY_CHANCE:
        return [
            Finding(
                "nothing to check by",
                "informs",
                f"{text}; but the readings are such as a machine within its tolerances shows.",
                "",
                {**numbers, "chance": chance},
            )
        ]
    return [
        Finding(
            "nothing to check by",
            "warns",
            f"{text}: nothing says whether these are right.",
            "Read more setups or postures; `orthocal compare` says what the readings support.",
            numbers,
        )
    ]


def find_remainder(calibration: Calibration) -> list[Finding]:
    """What remains, held against what the noise of the readings would leave."""
    source = calibration.noise.source
    if source == "unknown":
        return [
            Finding(
                "noise unknown",
                "warns",
                "As many parameters as readings and no word on the gauge: nothing tells how far "
                "they can be trusted.",
                "Give gauge.sigma_mm, or repeat the readings in cycles, and read more postures.",
            )
        ]
    if source == "gauge":
        return [_rests_on_gauge(calibration)]
    if source == "cycles":
        return _within_cycles(calibration)
    if calibration.noise.cycles_dof > 0:
        return [_beyond_cycles(calibration)]
    if calibration.session.gauge_sigma is not None:
        return [_against_gauge(calibration, calibration.session.gauge_sigma)]
    return [
        Finding(
            "noise not known apart",
            "informs",
            "Only what remains says how large the noise is, so error of the model, or of a whole "
            "setup, would look like noise.",
            "Repeat readings in cycles, or give gauge.sigma_mm.",
            {"sigma_mm": calibration.sigma / MM},
        )
    ]


def _rests_on_gauge(calibration: Calibration) -> Finding:
    numbers = {"sigma_mm": calibration.noise.sigma / MM}
    if calibration.spare_readings > 0:
        return Finding(
            "fits",
            "informs",
            "What remains is no more than the σ given for the gauge: that is what standard "
            "deviations rest on.",
            numbers=numbers,
        )
    text = "Standard deviations rest on the σ given for the gauge alone."
    return Finding("noise as given", "informs", text, numbers=numbers)


def _within_cycles(calibration: Calibration) -> list[Finding]:
    """Residuals that repeated cycles explain; none where these scatter too much themselves."""
    noise = calibration.noise
    if noise.cycles_scatter_more(gauge_scatter(calibration)):
        return []
    text = "What remains is what repeated cycles scatter by: the model fits."
    return [Finding("fits", "informs", text, numbers={"scatter_mm": noise.cycles_sigma / MM})]


def _beyond_cycles(calibration: Calibration) -> Finding:
    noise = calibration.noise
    ratio = noise.residual_sigma / noise.cycles_sigma
    return Finding(
        "model error",
        "informs",
        f"What remains is {ratio:.1f} times what repeated cycles scatter by "
        f"({mm(noise.cycles_sigma)} mm a reading): it is error of the model{_blame(calibration)}; "
        "not noise.",
        _larger_model(calibration),
        {
            "sigma_mm": noise.residual_sigma / MM,
            "scatter_mm": noise.cycles_sigma / MM,
            "times": ratio,
        },
    )


def _against_gauge(calibration: Calibration, gauge: float) -> Finding:
    """Residuals held against the gauge's own σ, [m]."""
    noise, factor = calibration.noise, calibration.row_factor
    ratio = noise.residual_sigma / gauge
    row = "a difference" if calibration.rows_are_differences else "a reading"
    numbers = {
        "sigma_mm": noise.residual_sigma / MM,
        "gauge_sigma_mm": gauge / MM,
        "times": ratio,
    }
    if noise.leaves_more(gauge):
        stays = "" if calibration.suspicious else f" With the model '{calibration.model}' it stays."
        return Finding(
            "model error",
            "informs",
            f"What remains, σ = {mm(calibration.sigma)} mm of {row}, is {times(ratio)} what the "
            f"gauge itself would leave ({mm(gauge * factor)} mm): it is error of the model"
            f"{_blame(calibration)}; not noise of the gauge.{stays}",
            _larger_model(calibration),
            numbers,
        )
    if noise.leaves_less(gauge):
        return Finding(
            "gauge overstated",
            "informs",
            f"What remains is only {ratio:.2g} of what the gauge's own σ would leave: the σ given "
            "for the gauge is too large, or readings were smoothed.",
            numbers=numbers,
        )
    return Finding(
        "fits",
        "informs",
        "What remains is what the gauge's own σ would leave: the model is good enough for these "
        "readings.",
        numbers=numbers,
    )


def _larger_model(calibration: Calibration) -> str:
    """What to do about error of the model that may be told by a larger one."""
    if not calibration.only_offsets:
        return ""
    return "`orthocal compare` says whether the readings support a larger model."


def _blame(calibration: Calibration) -> str:
    """What kind of error of the model it may be that remains."""
    left_out = calibration.unmodelled.residual_rms
    if find_excess(calibration) == 1.0 and left_out > 0.0:
        return (
            " (legs, axes, mounting): no more than a machine within its tolerances leaves, "
            f"{mm(left_out)} mm"
        )
    return " (legs, axes, mounting), or a wrong sign, direction or setup"
