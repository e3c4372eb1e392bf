"""Wording of findings about a fit: residuals, noise, parameters."""

from __future__ import annotations

from collections.abc import Sequence

from orthocal.assessment.wording import mm, named, note, plain, times
from orthocal.calibration.assessment_record import Finding, Place
from orthocal.calibration.records import ParameterEstimate
from orthocal.statistics.identifiability import Combination
from orthocal.units import MM

FEW_NAMES = 6
"""Parameters up to which all are named."""


def noise_unknown() -> Finding:
    """Finding that neither residuals nor the session determine the noise."""
    return note(
        "noise unknown",
        "There are as many parameters as readings and the session does not state the gauge's "
        "noise: the uncertainty is unknown.",
        "State gauge.sigma_mm, or repeat the readings in cycles.",
    )


def noise_from_residuals(sigma: float) -> Finding:
    """Only the residuals say how large the noise is."""
    return note(
        "noise from residuals",
        "The noise is estimated from the residuals alone, so an error of the model looks like "
        "noise.",
        "Repeat readings in cycles, or state gauge.sigma_mm.",
        sigma_mm=sigma / MM,
    )


def noise_as_stated(sigma: float) -> Finding:
    """Uncertainties rest on the stated noise alone."""
    return note(
        "noise as stated",
        "The uncertainty rests on the stated noise of the gauge.",
        sigma_mm=sigma / MM,
    )


def noise_from_cycles(scatter: float) -> Finding:
    """Uncertainties rest on the scatter of repeated readings alone."""
    return note(
        "noise as stated",
        "The uncertainty rests on the scatter of repeated readings.",
        scatter_mm=scatter / MM,
    )


def fits_stated_noise(sigma: float) -> Finding:
    """Residuals agree with the stated noise."""
    return note(
        "fits", "The residuals agree with the stated noise of the gauge.", sigma_mm=sigma / MM
    )


def fits_cycles(scatter: float) -> Finding:
    """Residuals agree with the scatter of repeated readings."""
    return note(
        "fits",
        "The residuals agree with the scatter of repeated readings: the model fits.",
        scatter_mm=scatter / MM,
    )


def model_error(
    sigma: float, reference: float, *, source: str, row: str, factor: float, larger: bool
) -> Finding:
    """Residuals exceed the noise: errors that the model leaves out.

    Args:
        sigma: Standard deviation of a reading from the residuals, [m].
        reference: The same from the noise, [m].
        source: Of the reference, in words.
        row: What a row is: a reading or a difference.
        factor: Standard deviation of a row over that of a reading.
        larger: Whether a larger model may explain it.
    """
    return note(
        "model error",
        f"After the fit, {row} still deviates by {mm(sigma * factor)} mm, "
        f"{times(sigma / reference)} {source} ({mm(reference * factor)} mm). Errors of legs, "
        "axes and mounting cause this, not noise.",
        "`orthocal compare` shows whether the readings support a larger model." if larger else "",
        sigma_mm=sigma / MM,
        noise_mm=reference / MM,
        ratio=sigma / reference,
    )


def gauge_overstated(sigma: float, stated: float) -> Finding:
    """Residuals are far smaller than the stated noise."""
    return note(
        "gauge overstated",
        f"The residuals are only {sigma / stated:.2g} of the stated noise: it is too large, or the "
        "readings were smoothed.",
        sigma_mm=sigma / MM,
        gauge_sigma_mm=stated / MM,
        ratio=sigma / stated,
    )


def no_redundancy(readings: int, parameters: int) -> Finding:
    """The parameters can take up every independent reading."""
    return note(
        "no redundancy",
        f"With {readings} independent readings and {parameters} parameters the fit cannot be "
        "checked against the readings. It relies on the stated tolerances.",
        independent_readings=float(readings),
        parameters=float(parameters),
    )


def nothing_depends(names: Sequence[str]) -> Finding:
    """No reading depends on any free parameter."""
    return note(
        "nothing moved",
        "No reading depends on any free parameter, so all keep their start values.",
        "Read setups and postures that depend on the parameters.",
        named(*names),
    )


def nothing_deviates(rms: float) -> Finding:
    """The readings show no deviation that the parameters explain."""
    return note(
        "nothing moved",
        f"The readings show no deviation that these parameters explain (RMS {mm(rms)} mm).",
        before_rms_mm=rms / MM,
    )


def held_by_bound(p: ParameterEstimate, *, offset: bool) -> Finding:
    """A bound holds a parameter."""
    return Finding(
        "held by a bound",
        "review" if offset else "note",
        f"{p.name} is at its {p.at_bound} bound, {p.value * p.edge_factor:g} {p.edge_unit}. The "
        "readings ask for a value beyond it. Its uncertainty is unknown, and that of the others "
        "holds with it at the bound.",
        "Make sure that this bound is intended.",
        {f"value_{p.edge_unit}" if p.unit != "1" else "value": p.value * p.edge_factor},
        named(p.name),
    )


def linearisation_error(p: ParameterEstimate, change: float, std: float) -> Finding:
    """Largest difference of the linearised and the exact estimate."""
    return note(
        "linearisation error",
        f"Linearisation changes the estimates by at most {plain(change * p.edge_factor)} "
        f"{p.edge_unit} ({p.name}), {change / std:.2g} times its standard deviation.",
        "",
        named(p.name),
        part_of_std=change / std,
    )


def inseparable(combination: Combination) -> Finding:
    """Parameters that these readings determine only as a sum."""
    return note(
        "inseparable",
        f"Determined only in combination: {combination.words}.",
        "",
        named(*combination.names),
    )


def below_noise(names: Sequence[str]) -> Finding:
    """Parameters that move no reading by more than the noise."""
    count = len(names)
    listed = f" ({', '.join(names)})" if count <= FEW_NAMES else ""
    noun = "parameter moves" if count == 1 else "parameters move"
    return note(
        "below the noise",
        f"{count} {noun} all readings together by less than the noise, at one prior standard "
        f"deviation{listed}.",
        "",
        named(*names),
        parameters=float(count),
    )


def line_assumed(size: float, setup: str, touches: str, sigma: float) -> Finding:
    """Readings are modelled as of the line between the rods, which nothing touches."""
    return note(
        "line assumed",
        "orthocal assumes that the gauge reads the centre line between the two rods of a leg. On "
        f"a rod the readings differ by about {mm(size)} mm (setup {setup}).",
        f"If it touched a rod, state `touches: {touches}` and the gauge's `tip`.",
        (Place(setup=setup),),
        off_line_mm=size / MM,
        sigma_mm=sigma / MM,
    )
