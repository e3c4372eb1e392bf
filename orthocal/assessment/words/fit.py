"""Wording of findings about a fit: residuals, noise, parameters."""

from __future__ import annotations

from collections.abc import Sequence

from orthocal.assessment.wording import (
    counted,
    mm,
    note,
    parameter_places,
    plain,
    review,
    signed,
    times,
)
from orthocal.calibration.assessment_record import Finding, Place
from orthocal.calibration.records import ParameterEstimate
from orthocal.statistics.identifiability import Combination
from orthocal.units import MM, show_limit

MAX_LISTED = 6
"""Number of parameters above which they are not listed."""


def noise_unknown(assumed: float) -> Finding:
    """Finding that neither residuals nor the session determine the noise.

    Args:
        assumed: Standard deviation of a reading by which the values were estimated, [m].
    """
    return note(
        "noise unknown",
        "There are as many parameters as readings, so these do not show the noise, and the session "
        f"does not state the noise of the gauge. The values assume {mm(assumed)} mm. The "
        "uncertainty is unknown.",
        "State the noise of each gauge (sigma_mm), or repeat the readings in cycles.",
        sigma_mm=assumed / MM,
    )


def noise_not_converged(sigma: float, *, gauges: int) -> Finding:
    """Finding that the noise still differs between the last two solutions."""
    several = "Calibrate without the readings of one gauge, to see which contradicts the others."
    return note(
        "no convergence",
        "The estimated noise of a reading differs between the last two solutions, so the values "
        "and their ± are approximate.",
        "State sigma_mm of the gauge, or repeat all readings in cycles."
        if gauges == 1
        else several,
        sigma_mm=sigma / MM,
    )


def no_solution() -> Finding:
    """Finding that the solver fails with these readings."""
    return note("no convergence", "The solver finds no machine that fits these readings.")


def noise_from_residuals(sigma: float) -> Finding:
    """Finding that the noise is known from the residuals only."""
    return note(
        "noise from residuals",
        "The noise is estimated from the residuals alone, so unmodelled errors count as noise. "
        "Whether the machine is within its tolerances is not checked, and ± may be too small.",
        "Repeat readings in cycles, or state the noise of each gauge (sigma_mm).",
        sigma_mm=sigma / MM,
    )


def noise_as_stated(sigma: float) -> Finding:
    """Finding that uncertainties depend on the stated noise alone."""
    return note(
        "noise as stated",
        "The uncertainty rests on the stated noise of the gauge.",
        sigma_mm=sigma / MM,
    )


def noise_from_cycles(scatter: float) -> Finding:
    """Finding that uncertainties depend on the scatter of repeated readings alone."""
    return note(
        "noise from cycles",
        "The uncertainty rests on the scatter of repeated readings.",
        scatter_mm=scatter / MM,
    )


def fits(sigma: float, source: str) -> Finding:
    """Finding that the residuals agree with the noise.

    Args:
        sigma: Standard deviation of a reading, [m].
        source: Noun phrase for the source of the noise.
    """
    return note("fits", f"The residuals agree with {source}.", sigma_mm=sigma / MM)


def model_error(
    sigma: float,
    reference: float,
    *,
    source: str,
    row_noun: str,
    row_factor: float,
    may_enlarge_model: bool,
) -> Finding:
    """Finding that the residuals exceed the noise because of unmodelled errors.

    Args:
        sigma: Standard deviation of a reading from the residuals, [m].
        reference: Standard deviation of a reading from the noise, [m].
        source: Noun phrase for the source of the reference.
        row_noun: Noun phrase for a row: a reading or a difference.
        row_factor: Ratio of the standard deviation of a row to that of a reading.
        may_enlarge_model: Whether a larger model may explain the residuals.
    """
    return note(
        "model error",
        f"After the calibration {row_noun} still deviates by about {mm(sigma * row_factor)} mm, "
        f"{times(sigma / reference)} {source} ({mm(reference * row_factor)} mm). Probable cause: "
        "errors of legs, axes and mounting.",
        "`orthocal compare` shows whether the readings support a larger model."
        if may_enlarge_model
        else "",
        sigma_mm=sigma / MM,
        noise_mm=reference / MM,
        ratio=sigma / reference,
    )


def gauge_overstated(sigma: float, stated: float, of_gauge: str) -> Finding:
    """Finding that the residuals are far smaller than the stated noise.

    Args:
        sigma: Standard deviation of a reading from the residuals, [m].
        stated: That of the gauge, [m].
        of_gauge: Phrase such as " of the gauge 'dial'"; empty if there is only one gauge.
    """
    return note(
        "gauge overstated",
        f"The residuals{of_gauge} are only {sigma / stated:.2g} of the stated noise: the stated "
        "noise is too large, or the readings were smoothed.",
        sigma_mm=sigma / MM,
        gauge_sigma_mm=stated / MM,
        ratio=sigma / stated,
    )


def no_redundancy(readings: int, parameters: int, *, mounting: bool, again: bool) -> Finding:
    """Finding that the fit has no redundant readings.

    Args:
        readings: Number of independent readings.
        parameters: Number of free errors of the machine.
        mounting: True if readings beyond those that determine the errors serve the mounting of
            gauges.
        again: True if readings after a change of the offsets are among them.
    """
    further = " and the mounting of the gauges" if mounting else ""
    check = "" if again else " Only new readings can check it."
    return note(
        "no redundancy",
        f"There {'is' if readings == 1 else 'are'} {counted(readings, 'independent reading')} for "
        f"{parameters} possible errors{further}, so the result relies on the stated "
        f"tolerances.{check}",
        independent_readings=float(readings),
        parameters=float(parameters),
    )


def no_sensitivity(names: Sequence[str]) -> Finding:
    """Finding that the effects of all free parameters on the readings are below the noise."""
    return note(
        "no sensitivity",
        "The effects of all free parameters on the readings are below the noise, so all keep "
        "their start values.",
        "Read setups and postures that depend on the parameters.",
        parameter_places(*names),
    )


def nothing_deviates(rms: float) -> Finding:
    """Finding that the readings show no deviation that the parameters explain."""
    return note(
        "no deviation",
        f"The readings show no deviation that these parameters explain (RMS {mm(rms)} mm).",
        before_rms_mm=rms / MM,
    )


def held_by_bound(parameter: ParameterEstimate, *, offset: bool) -> Finding:
    """Finding about a parameter at a bound; `offset` if it is an offset, to be reviewed."""
    value = parameter.value * parameter.edge_factor
    return (review if offset else note)(
        "held by a bound",
        f"{parameter.name} is at its {parameter.at_bound} bound, {value:g} "
        f"{parameter.unit_in_text}. The best fit is beyond this bound. The uncertainty of this "
        "parameter is unknown; that of the other parameters assumes this value.",
        "Make sure that this bound is intended.",
        parameter_places(parameter.name),
        **{f"value_{parameter.edge_unit}": value},
    )


def effect_above_tolerance(parameter: ParameterEstimate) -> Finding:
    """Finding about an error of an effect, such as a backlash, far above its tolerance."""
    unit, factor = parameter.unit_in_text, parameter.edge_factor
    tolerance, error = show_limit(parameter.prior_std), parameter.value - parameter.mean
    estimate = f"{parameter.name} is estimated to be {plain(parameter.value * factor)} {unit}"
    consequence = "the estimate is too small"
    if parameter.mean:
        estimate += f", {signed(error * factor)} {unit} from its stated value"
        consequence = "the estimate is too close to the stated value"
    return note(
        "above tolerances",
        f"{estimate}, {times(abs(error) / tolerance)} its tolerance. With so small a tolerance "
        f"{consequence}.",
        "Check this part of the machine. If it is so far off, state a larger tolerance and "
        "calibrate again.",
        parameter_places(parameter.name),
        **{
            f"value_{parameter.edge_unit}": parameter.value * factor,
            f"tolerance_{parameter.edge_unit}": tolerance * factor,
        },
    )


def linearisation_error(parameter: ParameterEstimate, change: float, std: float) -> Finding:
    """Finding about the difference of the linearised and the exact estimate of a parameter.

    Args:
        parameter: Parameter with the largest difference relative to its standard deviation.
        change: The difference, [SI].
        std: Standard deviation of the parameter, [SI].
    """
    return note(
        "linearisation error",
        "Most changed by linearisation, relative to its uncertainty: "
        f"{parameter.name} by {plain(change * parameter.edge_factor)} {parameter.unit_in_text}, "
        f"{change / std:.2g} times its standard deviation.",
        "",
        parameter_places(parameter.name),
        part_of_std=change / std,
    )


def inseparable(combination: Combination) -> Finding:
    """Finding about parameters that the readings determine only as a linear combination."""
    return note(
        "inseparable",
        f"Determined only in combination: {combination.words}.",
        "",
        parameter_places(*combination.names),
    )


def below_noise(names: Sequence[str]) -> Finding:
    """Finding about parameters whose effect on the readings is smaller than the noise."""
    count = len(names)
    listed = f" ({', '.join(names)})" if count <= MAX_LISTED else ""
    effect, remains = ("effect", "remains") if count == 1 else ("effects", "remain")
    return note(
        "below the noise",
        f"The {effect} of {counted(count, 'parameter')}{listed} on the readings {remains} below "
        "the noise, at one prior standard deviation.",
        "",
        parameter_places(*names),
        parameters=float(count),
    )


def line_assumed(difference: float, setup: str, touches: str, sigma: float) -> Finding:
    """Finding about a gauge that is modelled by the centre line of the leg, where there is no rod.

    Args:
        difference: Difference of the readings on the rod, [m].
        setup: Setup of the gauge.
        touches: Name of the rod.
        sigma: Standard deviation of a reading, [m].
    """
    return note(
        "line assumed",
        "orthocal assumes that the gauge reads the centre line between the two rods of a leg. On "
        f"rod {touches} the readings differ by about {mm(difference)} mm (setup {setup}).",
        f"If it touched a rod, state that rod (such as `touches: {touches}`) and its `tip`.",
        (Place(setup=setup),),
        off_line_mm=difference / MM,
        sigma_mm=sigma / MM,
    )
