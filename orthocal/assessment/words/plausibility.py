"""Wording of findings about implausible readings and settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from orthocal.assessment.wording import (
    joined,
    lines_in_file,
    named,
    note,
    parameter_places,
    reject,
    review,
    signed,
    times,
)
from orthocal.calibration.assessment_record import Finding, Place
from orthocal.robot.parameters import Parameter
from orthocal.text import spans
from orthocal.units import DRIVE_UNITS, MM, UM, Unit, show_limit


def wrong_dimensions(legs: str, nominal: float, measured: float) -> Finding:
    """Finding that the nominal machine would have moved the gauge far more than it moved.

    Args:
        legs: Legs of the robot in words.
        nominal: RMS motion of the gauge on the nominal machine, [m].
        measured: Measured RMS motion, [m].
    """
    return reject(
        "wrong dimensions",
        f"The postures do not belong to this machine: the robot with {legs} would have moved the "
        f"gauge by {nominal / MM:.1f} mm RMS, and it moved by {measured / MM:.1f} mm.",
        "Check `robot`, the joint coordinates of the postures and the unit of the readings.",
        nominal_rms_mm=nominal / MM,
        measured_rms_mm=measured / MM,
    )


def beyond_tolerances(
    scale: float,
    limit: float,
    suspected: Sequence[Place],
    *,
    firmware: bool,
) -> Finding:
    """Finding that only errors of many times the stated tolerances explain the readings.

    Args:
        scale: Factor between errors and tolerances.
        limit: Largest factor of a machine in working order.
        suspected: Readings that are the likeliest to be wrong, if any is.
        firmware: Whether the readings are from a log of a printer.
    """
    check = (
        "Check that the settings of the log are those with which it was probed. Then clean the bed "
        "and the nozzle, and probe again."
        if firmware
        else "Check signs, lines and setups, and that robot and dimensions are those of this "
        "machine. If all are right, adjust the machine mechanically first."
    )
    return reject(
        "beyond tolerances",
        f"Only errors of {times(scale)} the stated tolerances explain these readings. Above "
        f"{limit:g} times, the readings are wrong or the machine is out of adjustment.",
        f"{_describe_suspected(suspected)}{check}",
        suspected,
        tolerance_scale=scale,
    )


def outstanding_error(parameter: Parameter, error: float) -> Finding:
    """Finding about one error far beyond its tolerance, [SI], that explains the readings."""
    error, tolerance = (v * parameter.edge_factor for v in (error, show_limit(parameter.prior_std)))
    unit, key_unit = parameter.unit_in_text, parameter.edge_unit
    action = (
        "Measure that place or part again. If it is so far off, state its true value or a larger "
    )
    kind, _, name = parameter.name.partition(".")
    if kind == "setup":
        action = (
            f"Read setup {name.rpartition('.')[0]} again: a wrong reading, such as a dial misread "
            "by one turn, may look the same. If the readings were right, state the true value or a "
            "larger "
        )
    return reject(
        "outstanding error",
        f"One error explains these readings almost alone: {parameter.name} of about {error:+.3g} "
        f"{unit}. Its tolerance is ±{tolerance:g} {unit}.",
        f"{action}tolerance.",
        parameter_places(parameter.name),
        **{f"error_{key_unit}": error, f"tolerance_{key_unit}": tolerance},
    )


def _describe_suspected(places: Sequence[Place]) -> str:
    """Sentence about readings that are the likeliest to be wrong; "" without lines of one file."""
    lines = lines_in_file(places)
    if not lines:
        return ""
    return f"If a single reading is wrong, it is most likely in {spans(lines, 'line')}. "


def above_tolerances(scale: float) -> Finding:
    """Finding that errors of the machine exceed their tolerances by a plausible factor."""
    return note(
        "above tolerances",
        f"Errors of legs and axes are about {times(scale)} their tolerances; the calculation "
        "allows for it.",
        tolerance_scale=scale,
    )


@dataclass(frozen=True, slots=True)
class GaugeKeys:
    """Gauge of a finding and the places of its keys."""

    name: str
    """Name of the gauge; empty if the readings have no other."""
    resolution: str
    """File and key of its resolution."""
    sigma: str
    """File and key of its noise."""


def _named(gauge: str) -> str:
    """Name of one of several gauges after its noun."""
    return f" '{gauge}'" if gauge else ""


def finer_than_gauge(
    count: int,
    total: int,
    step: float,
    where: str,
    value: float,
    places: Sequence[Place],
    *,
    setups: Sequence[str],
    inches: bool,
    keys: GaugeKeys,
) -> Finding:
    """Finding about readings between the steps of the gauge.

    It is a note about fewer than half of the readings, unless these are all of a setup.

    Args:
        count: Number of readings between the steps.
        total: Number of readings of the gauge.
        step: Step of the gauge, [m].
        where: File and line of the first of them.
        value: Its value, [m].
        places: Places of them.
        setups: Setups with only such readings.
        inches: Whether all readings of the gauge are multiples of the step if they are in inches.
        keys: The gauge.
    """
    first = f"The first is {value / MM:.6g} mm in {where}."
    beginning = (
        f"The gauge{_named(keys.name)} shows steps of {step / MM:g} mm ({keys.resolution}), but "
        f"{count} of its {total} readings"
    )
    few = 2 * count < total
    if few and setups:
        beginning += f" (all of {named('setup', setups)})"
    text, action = (
        f"{beginning} have more digits, or are in inches. {first}",
        "Make sure that the readings are in mm, not in inches, and that the resolution is right"
        f"{', and that each setup names its gauge' if keys.name else ''}.",
    )
    if inches:
        text, action = (
            f"All {total} readings of the gauge{_named(keys.name)} appear to be in inches: "
            "multiplied by 25.4, they are multiples of the resolution, "
            f"{step / MM:g} mm. {first}",
            "If so, multiply these readings by 25.4, or use `orthocal import --unit inch`.",
        )
    describe = review
    if few and not setups:
        describe = note
        text = f"{beginning} have more digits. {first}"
        action = "If they are neither means nor read between two marks, correct them."
    return describe(
        "finer than the gauge",
        text,
        action,
        places,
        readings_between_steps=float(count),
        resolution_mm=step / MM,
    )


def _stated_resolution(step: float, keys: GaugeKeys) -> str:
    """Beginning of a sentence about the stated resolution of a gauge, [m]."""
    return (
        f"The stated resolution of the gauge{_named(keys.name)} is {step / MM:g} mm "
        f"({keys.resolution}), but"
    )


def coarser_than_range(step: float, limits: tuple[float, float], keys: GaugeKeys) -> Finding:
    """Finding that the stated range of the gauge has only a few of its steps."""
    low, high = (limit / MM for limit in limits)
    return review(
        "resolution too coarse",
        f"{_stated_resolution(step, keys)} its range is {low:g} … {high:g} mm.",
        "Make sure that its resolution_mm and its range_mm are in mm.",
        resolution_mm=step / MM,
        range_mm=high - low,
    )


def coarser_than_readings(
    count: int,
    total: int,
    step: float,
    where: str,
    value: float,
    places: Sequence[Place],
    *,
    keys: GaugeKeys,
) -> Finding:
    """Finding that readings contradict the stated resolution of the gauge."""
    return review(
        "resolution too coarse",
        f"{_stated_resolution(step, keys)} {count} of its {total} readings lie between such steps. "
        f"The first is {value / MM:.6g} mm in {where}.",
        "Make sure that its resolution_mm is right, and that the readings are in mm.",
        places,
        readings_between_steps=float(count),
        resolution_mm=step / MM,
    )


def finer_than_readings(
    total: int, step: float, coarser: float, keys: GaugeKeys, *, noise_stated: bool
) -> Finding:
    """Finding that all readings are multiples of a coarser step than the stated one, [m].

    Args:
        total: Number of readings of the gauge.
        step: Its stated resolution, [m].
        coarser: Step of which the readings are multiples, [m].
        keys: The gauge.
        noise_stated: Whether the noise of the gauge is stated.
    """
    noise = " Such rounding causes more scatter than its stated noise." if noise_stated else ""
    return review(
        "resolution too fine",
        f"{_stated_resolution(step, keys)} all its {total} readings are multiples of "
        f"{coarser / MM:g} mm.{noise}",
        f"State `resolution_mm: {coarser / MM:g}`, and the noise of this gauge in sigma_mm; or "
        "write all digits that the gauge shows.",
        resolution_mm=step / MM,
        coarser_mm=coarser / MM,
    )


def residuals_too_small(residual: float, rounding: float, step: float) -> Finding:
    """Finding about residuals that are smaller than the rounding to steps of the gauge, [m]."""
    return review(
        "residuals too small",
        f"The readings agree to {residual / UM:.2g} µm. Rounding to the gauge's resolution of "
        f"{step / MM:g} mm alone leaves {rounding / UM:.2g} µm. They are in another unit, were "
        "computed, or the dial did not move.",
        "Make sure that the readings are what the dial showed, in mm.",
        residual_um=residual / UM,
        rounding_um=rounding / UM,
        resolution_mm=step / MM,
    )


def sigma_too_large(
    stated: float, keys: GaugeKeys, *, scatter: float | None = None, step: float = 0.0
) -> Finding:
    """Finding about a stated noise far above the scatter or the resolution of the gauge.

    Args:
        stated: Stated noise, [m].
        keys: The gauge.
        scatter: Scatter of the readings, [m]; None to compare with the resolution.
        step: Resolution of the gauge, [m].
    """
    shown = (
        f"Its resolution is {step / MM:g} mm."
        if scatter is None
        else f"Its readings scatter by {scatter / MM:.2g} mm."
    )
    reference = step if scatter is None else scatter
    return review(
        "sigma too large",
        f"The stated noise of the gauge{_named(keys.name)} is {stated / MM:g} mm ({keys.sigma}). "
        f"{shown}",
        "Make sure that its sigma_mm is in mm.",
        gauge_sigma_mm=stated / MM,
        **{"resolution_mm" if scatter is None else "scatter_mm": reference / MM},
        ratio=stated / reference,
    )


def postures_too_near(posture: str, distances: Mapping[Unit, tuple[float, float]]) -> Finding:
    """Finding about a posture that is much closer to another one than the others.

    Args:
        posture: Name of the posture.
        distances: Unit of drives, mapped to the distance of the posture from the other one and to
            the largest distance of postures, [unit].
    """
    shown = {
        DRIVE_UNITS[unit][0]: [value / DRIVE_UNITS[unit][1] for value in values]
        for unit, values in distances.items()
    }
    near = joined([f"{gap:.2g} {unit}" for unit, (gap, _) in shown.items()])
    apart = joined([f"{largest:.0f} {unit}" for unit, (_, largest) in shown.items()])
    return review(
        "postures too near",
        f"Posture '{posture}' is {near} from another one; others are up to {apart} apart.",
        "Make sure that its coordinates are in the stated unit, such as mm, not in metres.",
        (Place(posture=posture),),
        **{f"gap_{unit}": gap for unit, (gap, _) in shown.items()},
        **{f"largest_{unit}": largest for unit, (_, largest) in shown.items()},
    )


def legs_differ(legs: str, lengths: dict[str, float]) -> Finding:
    """Finding about legs of different nominal lengths on a machine with equal drives."""
    return review(
        "legs differ",
        f"The nominal machine has legs of different lengths ({legs}) and drives that are alike.",
        "Make sure that the length was changed in every place of the URDF.",
        **{f"{name}_mm": length / MM for name, length in lengths.items()},
    )


def scattered_repeats(
    scatter: float, gauge: float, label: str, shown: str, places: Sequence[Place], name: str
) -> Finding:
    """Finding about repeated readings that differ by far more than the gauge's noise.

    Args:
        scatter: Scatter of repeated readings, [m].
        gauge: Noise of the gauge, [m].
        label: Reading that differs most.
        shown: Its values with their lines.
        places: Places of these values.
        name: Name of the gauge; empty if there is only one.
    """
    return review(
        "scattered repeats",
        f"Repeated readings scatter by {scatter / MM:.2g} mm; the gauge{_named(name)} alone by "
        f"{gauge / MM:.2g} mm as stated. They differ most at {label}: {shown}.",
        "Check these lines for a wrong sign or a wrong line, and read them again. If they are "
        "right, state a larger sigma_mm.",
        places,
        scatter_mm=scatter / MM,
        gauge_mm=gauge / MM,
    )


def exchanged_sides(
    lines: Sequence[int], setups: Sequence[str], places: Sequence[Place]
) -> Finding:
    """Finding about setups whose readings show a backlash with the opposite sign.

    Args:
        lines: Their lines with stated sides, ascending, if they are known.
        setups: Their names.
        places: Places of their readings.
    """
    where = f" ({spans(lines, 'line')})" if lines else ""
    these = "this setup" if len(setups) == 1 else "these setups"
    return review(
        "sides exchanged",
        f"In {named('setup', setups)}{where} the effect of the backlash has the opposite sign: the "
        "sides of approach seem to be exchanged.",
        "Check the column `approach`: p if the coordinate of a drive grew in its last motion, n if "
        "it fell; a joint that counts down displays the opposite. Correct it, or read "
        f"{these} again. If it is right, the controller compensates more backlash than the session "
        "states.",
        places,
    )


def differing_closings(
    setups: Sequence[tuple[str, float, Sequence[int | None]]],
    usual: float,
    command: str,
    places: Sequence[Place],
) -> Finding:
    """Finding about closing readings that differ from the first readings of their setups.

    Args:
        setups: Name of each setup, its closing reading minus its first one, [m], and their lines.
        usual: Largest usual difference, [m].
        command: Command that reads the first of these setups again; empty if that is impossible.
        places: Places of the closing readings.
    """
    described = []
    for name, difference, lines in setups:
        known = [line for line in lines if line is not None]
        where = f", {spans(known, 'line')}" if known else ""
        described.append(f"{name} ({signed(difference / MM)} mm{where})")
    noun = "setup" if len(setups) == 1 else "setups"
    again = "read the setup again" if len(setups) == 1 else "read these setups again"
    others = "" if len(setups) == 1 else ", likewise the others"
    remedy = f"{again}: {command}{others}" if command else f"omit the {noun}"
    return review(
        "differing closing reading",
        f"The closing reading differs from the first one by more than {usual / MM:.2g} mm in "
        f"{named('setup', described)}. The gauge or the machine was displaced, or a reading is "
        "wrong.",
        f"Check both readings. If they are right, {remedy}.",
        places,
        largest_difference_mm=max(abs(d) for _, d, _ in setups) / MM,
    )
