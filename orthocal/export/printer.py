"""Export of a calibration to the firmware of a delta printer.

A firmware has a radius, three towers, three rods and three endstops as settings φ. Let h be the
coordinates of the carriages that bring the real nozzle to p. The firmware computes the position
f(h + Δ; φ), with Δ the change of its homed carriages. φ and Δ minimise the difference between the
computed and the real position above the bed. A translation s and a rotation γ in the plane of the
bed are free, because no print shows them:

    min Σ wₖ |f(h(pₖ) + Δ; φ) − Rz(γ) pₖ − s|² + λ Σ z²(first layer)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from orthocal.arrays import Array
from orthocal.assessment.assess import assessment_of
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.assessment.tool_error import assess_tool
from orthocal.calibration.calibration import Calibration, propagate_stds
from orthocal.calibration.refit import restore_covariances
from orthocal.errors import ClosureError, ExportError
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.kinematics.workspace import Workspace, box_workspace
from orthocal.printers.firmwares import FIRMWARES
from orthocal.printers.settings import DeltaSettings, FirmwareName
from orthocal.units import DEG, MM

FIRST_LAYER = 10.0
"""Weight λ of the mean squared height of the first layer, relative to that of the tool error. The
first layer holds the print. The weight of 10 makes it twice as flat for 5 % more tool error."""

DIFFERENCE_STEP = 1e-5
"""Step of central differences, [m]."""

RINGS = 6
"""Number of rings of points of the first layer."""

UNKNOWN_SCALES = (MM, *(10.0 * MM,) * 2, *(MM,) * 6, 10.0 * MM, *(MM,) * 4)
"""Scales of the unknowns of the fit, as in `_residuals`: radius, angles a and b, rods, homed
carriages, rotation and translation of the print, tilts, [m, rad]."""


@dataclass(frozen=True, slots=True)
class FirmwareError:
    """Errors of a firmware's kinematics relative to the calibrated machine, [m].

    Tool errors are over the workspace, with translation and rotation in the plane of the bed
    removed. Layer errors are heights of the first layer above the bed.
    """

    tool_rms: float
    tool_largest: float
    layer_rms: float
    layer_largest: float


@dataclass(frozen=True, slots=True, eq=False)
class FirmwareFit:
    """New settings of a firmware."""

    settings: DeltaSettings
    now: FirmwareError
    """Errors with the present settings."""
    new: FirmwareError
    """Errors with the new settings."""
    tool_unknown: float
    """RMS uncertainty of the tool error after the calibration, [m]."""
    layer_unknown: float
    """RMS uncertainty of the heights of the first layer, [m]."""
    rows: tuple[SettingRow, ...]
    """Settings one by one: radius, rods, towers, endstops."""
    gain: Array
    """Derivative of the settings with respect to the free errors of the machine and the nuisance
    parameters, shape (10, n), [SI]."""


@dataclass(frozen=True, slots=True)
class SettingRow:
    """A setting before and after, with its expanded uncertainty."""

    name: str
    now: float
    new: float
    uncertainty: float
    """Expanded uncertainty of the new value; NaN if it is unknown."""
    unit: str
    """Unit of the numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class _Targets:
    """Carriages of the calibrated machine, and positions of its nozzle above the bed.

    Derivatives are in the axes of the bed, with respect to the n free errors of the machine and
    nuisance parameters, or with respect to the carriages.
    """

    points: Array
    """Positions of the nozzle in the workspace, shape (K, 3), [m]."""
    weights: Array
    """Weights of these points, shape (K,)."""
    carriages: Array
    """Coordinates of the carriages at these points, shape (K, 3), [m]."""
    layer_points: Array
    """Positions of the nozzle on the bed, shape (M, 3), [m]."""
    layer_carriages: Array
    """Coordinates of the carriages at the points on the bed, shape (M, 3), [m]."""
    jacobian: Array
    """Derivative of the points with respect to errors, shape (K, 3, n), [m per SI unit]."""
    layer_jacobian: Array
    """Derivative of the points on the bed with respect to errors, shape (M, 3, n)."""
    by_drives: Array
    """Derivative of the points with respect to the carriages, shape (K, 3, 3), [1]."""
    layer_by_drives: Array
    """Derivative of the points on the bed with respect to the carriages, shape (M, 3, 3)."""


def fit_firmware(calibration: Calibration, firmware: FirmwareName) -> FirmwareFit:
    """Settings of a firmware with the smallest tool error.

    Args:
        calibration: Calibration whose session states the present settings of the firmware.
        firmware: Firmware of the new settings.

    Raises:
        ExportError: If the session states no settings, or the machine does not reach the workspace.
    """
    present = calibration.session.firmware
    if present is None:
        raise ExportError(
            "the session states no settings of a firmware (controller.firmware); "
            "`orthocal import LOG DIRECTORY` makes a session with them"
        )
    targets, layer_unknown = _find_targets(calibration)
    start, unknowns = _start(present, firmware), _unknowns(firmware)
    solution = least_squares(
        lambda y: _residuals(targets, start, unknowns @ y),
        np.zeros(unknowns.shape[1]),
        x_scale=(UNKNOWN_SCALES @ unknowns) / unknowns.sum(axis=0),
        method="lm",
    )
    settings = _changed(start, unknowns @ solution.x)
    tool = assessment_of(calibration).tool
    homed_change = np.array(settings.homed) - present.homed
    gain = _setting_gain(targets, settings, solution.jac, homed_change)
    return FirmwareFit(
        settings=settings,
        now=_measure(targets, present, np.zeros(3)),
        new=_measure(targets, settings, homed_change),
        tool_unknown=math.nan if tool is None else tool.compensated,
        layer_unknown=layer_unknown,
        rows=_setting_rows(calibration, settings, gain),
        gain=gain,
    )


def _start(present: DeltaSettings, firmware: FirmwareName) -> DeltaSettings:
    """Present settings, as a firmware can have them."""
    rod = float(np.mean(present.rods))
    return replace(
        present,
        firmware=firmware,
        rods=(rod, rod, rod) if FIRMWARES[firmware].equal_rods else present.rods,
        tilts=present.tilts if FIRMWARES[firmware].tilts else (0.0, 0.0),
    )


def _unknowns(firmware: FirmwareName) -> Array:
    """Settings that each unknown of the fit changes, as in `_changed`, shape (14, n), [1]."""
    unknowns = np.eye(len(UNKNOWN_SCALES))
    if not FIRMWARES[firmware].tilts:
        unknowns = unknowns[:, :-2]
    if FIRMWARES[firmware].equal_rods:
        common = unknowns[:, 3:6].sum(axis=1, keepdims=True)
        unknowns = np.concatenate([unknowns[:, :3], common, unknowns[:, 6:]], axis=1)
    return unknowns


def _differentiate(settings: DeltaSettings, carriages: Array) -> Array:
    """Derivative of the computed position with respect to the carriages, shape (K, 3, 3), [1]."""
    steps = DIFFERENCE_STEP * np.eye(3)
    differences = [settings.forward(carriages + s) - settings.forward(carriages - s) for s in steps]
    return np.stack(differences, axis=2) / (2.0 * DIFFERENCE_STEP)


def _setting_gain(
    targets: _Targets, settings: DeltaSettings, jacobian: Array, homed_change: Array
) -> Array:
    """Derivative of the settings with respect to the free errors, shape (n_settings, n), [SI].

    At the minimum Jᵀr = 0, so dx = −(JᵀJ)⁻¹ Jᵀ dr. For a change dθ of the errors, the carriages
    that bring the nozzle to a point change by dh = −(∂p/∂h)⁻¹ T dθ, with T the sensitivity of the
    nozzle. The computed position changes by dr = ∂f/∂h dh. Endstops follow from the homed
    carriages: e = h − √(rod² − radius²).

    Args:
        targets: The points.
        settings: The new settings.
        jacobian: Derivative of the residuals with respect to the unknowns, shape (m, k).
        homed_change: Change of the homed carriages, shape (3,), [m].
    """
    n = targets.jacobian.shape[-1]
    computed, layer = (
        _differentiate(settings, carriages + homed_change) @ np.linalg.solve(by_drives, errors)
        for carriages, by_drives, errors in (
            (targets.carriages, targets.by_drives, targets.jacobian),
            (targets.layer_carriages, targets.layer_by_drives, targets.layer_jacobian),
        )
    )
    change = np.sqrt(targets.weights)[:, None, None] * computed
    layer = math.sqrt(FIRST_LAYER / len(targets.layer_points)) * layer[:, 2]
    change = np.concatenate([change.reshape(-1, n), layer])
    gain = _unknowns(settings.firmware) @ np.linalg.lstsq(jacobian, change, rcond=None)[0]
    rods = np.array(settings.rods)[:, None] * gain[3:6] - settings.radius * gain[:1]
    endstops = gain[6:9] - rods / settings.middle[:, None]
    fixed = np.zeros((1, n))
    return np.concatenate([gain[:1], gain[3:6], gain[1:3], fixed, endstops])


def _setting_rows(
    calibration: Calibration, settings: DeltaSettings, gain: Array
) -> tuple[SettingRow, ...]:
    """Settings before and after.

    Args:
        calibration: The calibration.
        settings: The new settings.
        gain: Derivative of radius, rods, angles and endstops with respect to errors, (10, n), [SI].
    """
    present = calibration.session.firmware or settings
    uncertainties = np.full(len(gain), np.nan)
    if not calibration.unmodelled.prior_stds.size:
        stds = propagate_stds(gain, restore_covariances(calibration))
        uncertainties = calibration.expand(*stds)
    values = [("radius", present.radius / MM, settings.radius / MM, MM, "mm")]
    for field, label, size, unit in (
        ("rods", "rod", MM, "mm"),
        ("angles", "direction of tower", DEG, "°"),
        ("endstops", "endstop", MM, "mm"),
    ):
        for k, tower in enumerate("abc"):
            now, new = (getattr(s, field)[k] / size for s in (present, settings))
            values.append((f"{label} {tower}", float(now), float(new), size, unit))
    return tuple(
        SettingRow(name, now, new, float(u) / size, unit)
        for (name, now, new, size, unit), u in zip(values, uncertainties.tolist(), strict=True)
    )


def _find_targets(calibration: Calibration) -> tuple[_Targets, float]:
    """Points over the workspace and on the bed, and the uncertainty of heights on the bed, [m].

    Raises:
        ExportError: If the machine does not reach the points.
    """
    robot, tool, tilt = calibration.robot, find_tool(calibration), _bed_tilt(calibration)
    if tool is None:
        raise ExportError("the machine does not reach a workspace")
    limits = tool.workspace.limits
    space = box_workspace(robot, limits)
    layer = _disc(limits)
    offsets = calibration.active_offsets
    try:
        carriages, layer_carriages = (
            calibration.machine.inverse(p @ tilt.T) + offsets for p in (space.points, layer)
        )
        accuracy = assess_tool(calibration, Workspace.even(layer))
    except ClosureError as e:
        raise ExportError(f"the calibrated machine does not reach the bed: {e}") from None
    layer_unknown, turn = math.nan, _bed_turn(calibration)
    to_errors, to_drives = (
        ToolSensitivity(robot, free=names, values=calibration.errors)
        for names in (
            [p.name for p in calibration.free],
            [f"{d.name}.offset" for d in robot.drives],
        )
    )
    jacobians = [
        np.concatenate([tilt.T @ to_errors(c), -np.einsum("ijk,nj->nik", turn, p)], axis=2)
        for p, c in ((space.points, carriages), (layer, layer_carriages))
    ]
    by_drives = [tilt.T @ to_drives(c) for c in (carriages, layer_carriages)]
    if accuracy.after is not None:
        layer_unknown = math.sqrt(float(accuracy.after.aligned_covariance[:, 2, 2].mean()))
    points = space.points, space.weights, carriages, layer, layer_carriages
    return _Targets(*points, *jacobians, *by_drives), layer_unknown


def _bed_tilt(calibration: Calibration) -> Array:
    """Rotation from the axes of the bed to those of the machine, shape (3, 3).

    Raises:
        ExportError: If no probe measured the bed.
    """
    for setup in calibration.setups:
        if setup.sensor.kind == "probe":
            values = {p.name: p.value for p in calibration.sensors}
            yaw, roll = (values.get(f"setup.{setup.name}.{k}", 0.0) for k in ("yaw", "roll"))
            return np.asarray(Rotation.from_euler("xy", [roll, yaw]).as_matrix())
    raise ExportError("no setup measured the bed with a probe: the plane of the print is unknown")


def _bed_turn(calibration: Calibration) -> Array:
    """Derivative of the bed's rotation with respect to nuisance parameters, (3, 3, n), [1/rad].

    Element i, j, k: change of coordinate i of a point per unit of coordinate j and parameter k.
    """
    turn = np.zeros((3, 3, len(calibration.sensors)))
    for k, parameter in enumerate(calibration.sensors):
        axis = {"roll": [1.0, 0.0, 0.0], "yaw": [0.0, 1.0, 0.0]}.get(
            parameter.name.rpartition(".")[2]
        )
        if axis is not None:
            turn[:, :, k] = np.cross(axis, np.eye(3)).T
    return turn


def _disc(limits: Array) -> Array:
    """Points of equal areas within the circle around the workspace on the bed, (M, 3), [m]."""
    middle, half = limits[:2].mean(axis=1), 0.5 * (limits[:2, 1] - limits[:2, 0])
    points = [np.zeros(2)]
    for ring in range(1, RINGS + 1):
        angles = 2.0 * np.pi * np.arange(6 * ring) / (6 * ring)
        points += list(ring / RINGS * np.column_stack([np.cos(angles), np.sin(angles)]))
    xy = middle + math.sqrt(2.0) * half * np.array(points)
    return np.column_stack([xy, np.full(len(xy), limits[2, 0])])


def _changed(settings: DeltaSettings, x: Array) -> DeltaSettings:
    """Settings with changes of radius, angles a and b, rods, homed carriages and tilts.

    Tower c keeps its angle: it fixes the axes of the print.
    """
    rods, homed = np.array(settings.rods) + x[3:6], np.array(settings.homed) + x[6:9]
    a, b, c = settings.angles
    return replace(
        settings,
        radius=settings.radius + x[0],
        angles=(a + x[1], b + x[2], c),
        rods=tuple(rods.tolist()),
        homed=tuple(homed.tolist()),
        tilts=(settings.tilts[0] + x[12], settings.tilts[1] + x[13]),
    )


def _residuals(targets: _Targets, present: DeltaSettings, x: Array) -> Array:
    """Weighted errors of changed settings, with a free translation and rotation in the bed's plane.

    Args:
        targets: The points.
        present: Present settings.
        x: Changes of the settings, then rotation x[9] and translation x[10:12].
    """
    settings = _changed(present, x)
    change = np.array(settings.homed) - present.homed
    aligned = targets.points @ Rotation.from_euler("z", x[9]).as_matrix().T
    aligned[:, :2] += x[10:12]
    error = settings.forward(targets.carriages + change) - aligned
    heights = settings.forward(targets.layer_carriages + change)[:, 2] - targets.layer_points[:, 2]
    weighted = np.sqrt(targets.weights)[:, None] * error
    return np.concatenate([weighted.ravel(), math.sqrt(FIRST_LAYER / len(heights)) * heights])


def _measure(targets: _Targets, settings: DeltaSettings, change: Array) -> FirmwareError:
    """Errors of settings with homed carriages changed by `change`, shape (3,), [m]."""
    error = settings.forward(targets.carriages + change) - targets.points
    motions = np.zeros((len(error), 3, 3))
    motions[:, 0, 0] = motions[:, 1, 1] = 1.0
    motions[:, 0, 2], motions[:, 1, 2] = -targets.points[:, 1], targets.points[:, 0]
    root = np.sqrt(np.repeat(targets.weights, 3))[:, None]
    columns, flat = motions.reshape(-1, 3), error.reshape(-1, 1)
    motion = np.linalg.lstsq(root * columns, root * flat, rcond=None)[0]
    lengths = np.linalg.norm((flat - columns @ motion).reshape(-1, 3), axis=1)
    heights = settings.forward(targets.layer_carriages + change)[:, 2] - targets.layer_points[:, 2]
    return FirmwareError(
        tool_rms=math.sqrt(float(targets.weights @ lengths**2)),
        tool_largest=float(lengths.max()),
        layer_rms=math.sqrt(float(np.mean(heights**2))),
        layer_largest=float(np.abs(heights).max()),
    )


def export_printer(calibration: Calibration, firmware: FirmwareName) -> dict[str, str]:
    """File with the new settings of a firmware, and README.md.

    Raises:
        ExportError: If the session states no settings, or the machine does not reach its bed.
    """
    fit = fit_firmware(calibration, firmware)
    target = FIRMWARES[firmware]
    return {target.file: target.config_lines(fit.settings), "README.md": _page(calibration, fit)}


_SEND = (
    "Send the lines of `marlin.gcode`. `M500` saves them. Without EEPROM, change the values of the "
    "same names in `Configuration.h`."
)
_HOME = "Home (`G28`). An existing mesh of `G29` is no longer valid: `M420 S0`."

STEPS: dict[FirmwareName, Sequence[str]] = {
    "klipper": (
        "Replace these lines in your `printer.cfg`. Values of a part `SAVE_CONFIG` at its end take "
        "precedence: replace them there.",
        "`RESTART`, then home.",
    ),
    "marlin": (
        f"{_SEND} If `M503` prints no A, B and C in `M665`, your Marlin has one length for all "
        "rods: export with `--to marlin1`.",
        _HOME,
    ),
    "marlin1": (_SEND, _HOME),
    "reprapfirmware": (
        "Replace `M665` and `M666` in `config.g`. Delete these commands in `config-override.g`.",
        "Restart, then home (`G28`). An existing height map is no longer valid: `G29 S2`.",
    ),
}
"""How to enter the settings."""


UNCERTAIN = (
    "± is the uncertainty of a single setting (95 %). Settings compensate each other: longer rods "
    "with a larger radius print equally flat."
)


def _format(number: float) -> str:
    """Number with three decimals; empty if it is unknown."""
    return f"{number:.3f}" if math.isfinite(number) else ""


def describe_settings(fit: FirmwareFit) -> str:
    """Table of the present and the new settings as text."""
    lines = [f"  {'':20}{'now':>10}{'new':>10}{'±':>9}"]
    lines += [
        f"  {r.name:20}{r.now:10.3f}{r.new:10.3f}{_format(r.uncertainty):>9}  {r.unit}"
        for r in fit.rows
    ]
    return "\n".join(lines)


def _page(calibration: Calibration, fit: FirmwareFit) -> str:
    """README.md: steps, settings and expected errors."""
    settings = fit.settings
    firmware = FIRMWARES[settings.firmware]
    steps = (
        *STEPS[settings.firmware],
        "Probe the bed again, and import the new log into another directory. The height of the "
        "probe (z offset) does not change: set it with paper as before.",
    )
    table = [
        f"| {r.name} | {r.now:.3f} | {r.new:.3f} | {_format(r.uncertainty)} | {r.unit} |"
        for r in fit.rows
    ]
    return "\n".join(
        [
            f"# Settings for {firmware.title}",
            "",
            f"`{firmware.file}`:",
            "",
            "```",
            firmware.config_lines(settings).rstrip(),
            "```",
            "",
            *(f"{i}. {step}" for i, step in enumerate(steps, start=1)),
            "",
            "| | now | new | ± | |",
            "|---|---|---|---|---|",
            *table,
            "",
            *([] if calibration.unmodelled.prior_stds.size else [UNCERTAIN, ""]),
            "## What to expect",
            "",
            *_expectations(firmware.title, fit),
            "",
        ]
    )


def _expectations(title: str, fit: FirmwareFit) -> list[str]:
    """Table of the expected errors, and their limits."""

    def row(words: str, *values: float) -> str:
        return f"| {words} | {' | '.join(f'{v / MM:.3f}' for v in values)} |"

    tool = math.hypot(fit.new.tool_rms, fit.tool_unknown)
    layer = math.hypot(fit.new.layer_rms, fit.layer_unknown)
    return [
        "| mm | now | new | largest, new |",
        "|---|---|---|---|",
        row(
            "tool error of the settings, RMS over the workspace",
            fit.now.tool_rms,
            fit.new.tool_rms,
            fit.new.tool_largest,
        ),
        row(
            "height error of the first layer, RMS",
            fit.now.layer_rms,
            fit.new.layer_rms,
            fit.new.layer_largest,
        ),
        "",
        f"{title} has no other settings for the geometry. The calibration identified errors that "
        "they cannot express, such as towers that lean.",
        "",
        f"With the uncertainty of the calibration, expect a tool error of {tool / MM:.2g} mm RMS, "
        f"and a height error of the first layer of {layer / MM:.2g} mm RMS. A probed bed hardly "
        "determines the size of a print: longer rods with a larger radius print equally flat. "
        "Measure a large print, or the rods.",
    ]
