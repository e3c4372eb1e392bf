"""Export of a calibration to the firmware of a delta printer.

A firmware knows a radius, three towers, three rods and three endstops. With the carriages at the
coordinates that bring the real nozzle to p, it believes the nozzle at f(h + Δ; φ). Its settings φ
and the changes Δ of its homed carriages are chosen so that what it believes is where the nozzle is
above the bed, but for a shift and turn in the plane of the bed, which no print shows:

    min Σ wₖ |f(h(pₖ) + Δ; φ) − Rz(γ) pₖ − s|² + λ Σ z²(first layer)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

from orthocal.arrays import Array
from orthocal.assessment.assess import assessment_of
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.assessment.tool_error import assess_tool
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.refit import restore_covariances
from orthocal.errors import ClosureError, ExportError
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.kinematics.workspace import Workspace, box_workspace
from orthocal.printers.firmwares import FIRMWARES
from orthocal.printers.settings import DeltaSettings, FirmwareName
from orthocal.units import DEG, MM

FIRST_LAYER = 10.0
"""Weight λ of the mean squared height of the first layer against that of the tool error. A print
holds by its first layer: a weight of 10 makes it twice as flat for 5 % more tool error."""

SLOPE_STEP = 1e-5
"""Step of central differences, [m]."""

RINGS = 6
"""Rings of points of the first layer."""

SCALES = (MM, *(10 * MM,) * 3, *(MM,) * 6, 10 * MM, MM, MM, MM, MM)
"""Sizes of the unknowns: radius, angles [rad], rods, carriages, turn, shift, tilts."""


@dataclass(frozen=True, slots=True)
class FirmwareError:
    """Errors of a firmware's kinematics against the calibrated machine, [m]."""

    tool_rms: float
    """Over the workspace, with shift and turn in the plane of the bed removed."""
    tool_largest: float
    layer_rms: float
    """Height of the first layer above the bed."""
    layer_largest: float


@dataclass(frozen=True, slots=True, eq=False)
class FirmwareFit:
    """New settings of a firmware."""

    settings: DeltaSettings
    now: FirmwareError
    """With the present settings."""
    new: FirmwareError
    tool_unknown: float
    """RMS tool error that the readings leave, [m]."""
    layer_unknown: float
    """RMS height of the first layer that they leave, [m]."""
    rows: tuple[SettingRow, ...]
    """The settings one by one: radius, rods, towers, endstops."""
    gain: Array
    """Derivative of the settings by the free errors of the machine and the nuisance parameters,
    shape (10, n), [SI]."""


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
    """Carriages of the calibrated machine and where its nozzle is above the bed."""

    points: Array
    """Shape (K, 3), [m]."""
    weights: Array
    carriages: Array
    layer_points: Array
    """On the bed, shape (M, 3), [m]."""
    layer_carriages: Array
    jacobian: Array
    """Change of the points that the carriages reach, in the axes of the bed, by the free errors of
    the machine and the nuisance parameters, shape (K, 3, n), [m per SI unit]."""
    layer_jacobian: Array
    """The same of `layer_points`, shape (M, 3, n)."""
    by_drives: Array
    """Change of the points by the carriages, in the axes of the bed, shape (K, 3, 3), [1]."""
    layer_by_drives: Array
    """The same of `layer_points`, shape (M, 3, 3)."""


def fit_firmware(calibration: Calibration, firmware: FirmwareName) -> FirmwareFit:
    """Settings of a firmware with the least tool error.

    Args:
        calibration: A calibration whose session states the settings of the firmware.
        firmware: The firmware of the new settings.

    Raises:
        ExportError: If the session states none, or the machine does not reach the workspace.
    """
    present = calibration.session.firmware
    if present is None:
        raise ExportError(
            "the session states no settings of a firmware (controller.firmware); "
            "`orthocal import LOG DIRECTORY` makes a session that does"
        )
    targets, layer_unknown = _find_targets(calibration)
    free = 15 if FIRMWARES[firmware].tilts else 13
    start = np.zeros(free)
    solution = least_squares(
        partial(_residuals, targets, present), start, x_scale=SCALES[:free], method="lm"
    )
    settings = replace(_changed(present, solution.x), firmware=firmware)
    tool = assessment_of(calibration).tool
    moved = np.array(settings.homed) - present.homed
    gain = _setting_gain(targets, settings, solution, moved)
    return FirmwareFit(
        settings=settings,
        now=_measure(targets, present, np.zeros(3)),
        new=_measure(targets, settings, moved),
        tool_unknown=math.nan if tool is None else tool.compensated,
        layer_unknown=layer_unknown,
        rows=_setting_rows(calibration, settings, gain),
        gain=gain,
    )


def _slopes(settings: DeltaSettings, carriages: Array) -> Array:
    """Derivative of what a firmware believes by its carriages, shape (K, 3, 3), [1]."""
    steps = SLOPE_STEP * np.eye(3)
    ends = [settings.forward(carriages + s) - settings.forward(carriages - s) for s in steps]
    return np.stack(ends, axis=2) / (2.0 * SLOPE_STEP)


def _setting_gain(
    targets: _Targets, settings: DeltaSettings, found: OptimizeResult, moved: Array
) -> Array:
    """Derivative of the settings by the errors that were identified, shape (n_settings, n), [SI].

    At the least squares Jᵀr = 0, so dx = −(JᵀJ)⁻¹ Jᵀ dr. With errors dθ more, the carriages that
    bring the nozzle to a point change by dh = −(∂p/∂h)⁻¹ T dθ, T the sensitivity of the nozzle, and
    what the firmware believes by dr = ∂f/∂h dh. Endstops follow from the homed carriages:
    e = h − √(rod² − radius²).

    Args:
        targets: The points.
        settings: The new settings.
        found: The solved least squares.
        moved: Change of the homed carriages, shape (3,), [m].
    """
    n = targets.jacobian.shape[-1]
    believed, layer = (
        _slopes(settings, carriages + moved) @ np.linalg.solve(by_drives, jacobian)
        for carriages, by_drives, jacobian in (
            (targets.carriages, targets.by_drives, targets.jacobian),
            (targets.layer_carriages, targets.layer_by_drives, targets.layer_jacobian),
        )
    )
    change = np.sqrt(targets.weights)[:, None, None] * believed
    layer = math.sqrt(FIRST_LAYER / len(targets.layer_points)) * layer[:, 2]
    change = np.concatenate([change.reshape(-1, n), layer])
    gain = np.asarray(np.linalg.lstsq(found.jac, change, rcond=None)[0])
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
        gain: Derivative of radius, rods, angles and endstops, shape (10, n), [SI].
    """
    present = calibration.session.firmware or settings
    uncertain = np.full(len(gain), np.nan)
    if not calibration.unmodelled.prior_stds.size:
        stds = [
            np.sqrt(np.einsum("ij,jk,ik->i", gain, c, gain))
            for c in restore_covariances(calibration)
        ]
        uncertain = calibration.expand(*stds)
    values = [("radius", present.radius / MM, settings.radius / MM, MM, "mm")]
    for name, size, unit in (("rods", MM, "mm"), ("angles", DEG, "°"), ("endstops", MM, "mm")):
        words = {"rods": "rod", "angles": "direction of tower", "endstops": "endstop"}[name]
        for k, tower in enumerate("abc"):
            now, new = (getattr(s, name)[k] / size for s in (present, settings))
            values.append((f"{words} {tower}", float(now), float(new), size, unit))
    return tuple(
        SettingRow(name, now, new, float(u) / size, unit)
        for (name, now, new, size, unit), u in zip(values, uncertain.tolist(), strict=True)
    )


def _find_targets(calibration: Calibration) -> tuple[_Targets, float]:
    """Points over the workspace and on the bed, and what is unknown of the latter's heights, [m].

    Raises:
        ExportError: If the machine does not reach them.
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
    unknown, turn = math.nan, _bed_turn(calibration)
    of_errors, of_drives = (
        ToolSensitivity(robot, free=names, values=calibration.errors)
        for names in (
            [p.name for p in calibration.free],
            [f"{d.name}.offset" for d in robot.drives],
        )
    )
    jacobians = [
        np.concatenate([tilt.T @ of_errors(c), -np.einsum("ijk,nj->nik", turn, p)], axis=2)
        for p, c in ((space.points, carriages), (layer, layer_carriages))
    ]
    by_drives = [tilt.T @ of_drives(c) for c in (carriages, layer_carriages)]
    if accuracy.after is not None:
        unknown = math.sqrt(float(accuracy.after.aligned_covariance[:, 2, 2].mean()))
    parts = space.points, space.weights, carriages, layer, layer_carriages
    return _Targets(*parts, *jacobians, *by_drives), unknown


def _bed_tilt(calibration: Calibration) -> Array:
    """Rotation from the axes of the bed to those of the machine, shape (3, 3).

    Raises:
        ExportError: If no probe measured the bed.
    """
    for setup in calibration.setups:
        if setup.sensor.kind == "probe":
            value = {p.name: p.value for p in calibration.sensors}
            yaw, roll = (value.get(f"setup.{setup.name}.{k}", 0.0) for k in ("yaw", "roll"))
            return np.asarray(Rotation.from_euler("xy", [roll, yaw]).as_matrix())
    raise ExportError("no setup measured the bed with a probe: the plane of the print is unknown")


def _bed_turn(calibration: Calibration) -> Array:
    """Derivative of the tilt of the bed by the nuisance parameters, (3, 3, n_nuisance), [1/rad].

    Element i, j, k: change of coordinate i of a point by its coordinate j and parameter k.
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
    """Points of the circle around the workspace on the bed, of equal areas, shape (M, 3), [m]."""
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
    tilts = (settings.tilts[0] + x[12], settings.tilts[1] + x[13]) if len(x) > 13 else (0.0, 0.0)
    return replace(
        settings,
        radius=settings.radius + x[0],
        angles=(a + x[1], b + x[2], c),
        rods=tuple(rods.tolist()),
        homed=tuple(homed.tolist()),
        tilts=tilts,
    )


def _residuals(targets: _Targets, present: DeltaSettings, x: Array) -> Array:
    """Weighted errors of changed settings, with a turn and a shift in the plane of the bed."""
    settings = _changed(present, x)
    change = np.array(settings.homed) - present.homed
    turned = targets.points @ Rotation.from_euler("z", x[9]).as_matrix().T
    turned[:, :2] += x[10:12]
    error = settings.forward(targets.carriages + change) - turned
    heights = settings.forward(targets.layer_carriages + change)[:, 2] - targets.layer_points[:, 2]
    weighted = np.sqrt(targets.weights)[:, None] * error
    return np.concatenate([weighted.ravel(), math.sqrt(FIRST_LAYER / len(heights)) * heights])


def _measure(targets: _Targets, settings: DeltaSettings, change: Array) -> FirmwareError:
    """Errors of settings whose homed carriages changed by `change`, [m]."""
    error = settings.forward(targets.carriages + change) - targets.points
    motions = np.zeros((len(error), 3, 3))
    motions[:, 0, 0] = motions[:, 1, 1] = 1.0
    motions[:, 0, 2], motions[:, 1, 2] = -targets.points[:, 1], targets.points[:, 0]
    root = np.sqrt(np.repeat(targets.weights, 3))[:, None]
    flat = error.reshape(-1, 1)
    taken = np.linalg.lstsq(root * motions.reshape(-1, 3), root * flat, rcond=None)[0]
    lengths = np.linalg.norm((flat - motions.reshape(-1, 3) @ taken).reshape(-1, 3), axis=1)
    heights = settings.forward(targets.layer_carriages + change)[:, 2] - targets.layer_points[:, 2]
    return FirmwareError(
        tool_rms=math.sqrt(float(targets.weights @ lengths**2)),
        tool_largest=float(lengths.max()),
        layer_rms=math.sqrt(float(np.mean(heights**2))),
        layer_largest=float(np.abs(heights).max()),
    )


def export_printer(calibration: Calibration, firmware: FirmwareName) -> dict[str, str]:
    """Lines with the settings, and a README.md.

    Raises:
        ExportError: If the session states no settings, or the machine does not reach its bed.
    """
    fit = fit_firmware(calibration, firmware)
    known = FIRMWARES[firmware]
    return {known.file: known.config_lines(fit.settings), "README.md": _page(calibration, fit)}


STEPS: dict[FirmwareName, Sequence[str]] = {
    "klipper": (
        "Replace these lines in your `printer.cfg`. Values of a part `SAVE_CONFIG` at its end take "
        "precedence: replace them there.",
        "`RESTART`, then home.",
    ),
    "marlin": (
        "Send the lines of `marlin.gcode`. `M500` saves them. Without EEPROM, change the values "
        "of the same names in `Configuration.h`.",
        "Home (`G28`). A mesh of `G29` from before is old: `M420 S0`.",
    ),
    "reprapfirmware": (
        "Replace `M665` and `M666` in `config.g`. Delete these commands in `config-override.g`.",
        "Restart, then home (`G28`). A height map from before is old: `G29 S2`.",
    ),
}
"""How to enter the settings."""


UNCERTAIN = (
    "± is the uncertainty of a setting by itself (95 %). Settings compensate each other: with a "
    "longer radius, longer rods are as flat."
)


def _plain(number: float) -> str:
    return f"{number:.3f}" if math.isfinite(number) else ""


def describe_settings(fit: FirmwareFit) -> str:
    """Table of the settings, before and after, as text."""
    lines = [f"  {'':20}{'now':>10}{'new':>10}{'±':>9}"]
    lines += [
        f"  {r.name:20}{r.now:10.3f}{r.new:10.3f}{_plain(r.uncertainty):>9}  {r.unit}"
        for r in fit.rows
    ]
    return "\n".join(lines)


def _page(calibration: Calibration, fit: FirmwareFit) -> str:
    """README.md: what to do, the values, what remains."""
    settings = fit.settings
    known = FIRMWARES[settings.firmware]
    steps = (
        *STEPS[settings.firmware],
        "Probe the bed again, and import the new log into another directory. The height of the "
        "probe (z offset) stays as it is: set it by paper as before.",
    )
    table = [
        f"| {r.name} | {r.now:.3f} | {r.new:.3f} | {_plain(r.uncertainty)} | {r.unit} |"
        for r in fit.rows
    ]
    return "\n".join(
        [
            f"# Settings for {known.title}",
            "",
            f"`{known.file}`:",
            "",
            "```",
            known.config_lines(settings).rstrip(),
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
            *_expectations(known.title, fit),
            "",
        ]
    )


def _expectations(title: str, fit: FirmwareFit) -> list[str]:
    """Table of errors, and what limits them."""

    def row(words: str, *values: float) -> str:
        return f"| {words} | {' | '.join(f'{v / MM:.3f}' for v in values)} |"

    tool = math.hypot(fit.new.tool_rms, fit.tool_unknown)
    layer = math.hypot(fit.new.layer_rms, fit.layer_unknown)
    return [
        "| mm | now | new | largest, new |",
        "|---|---|---|---|",
        row(
            "tool error that the settings leave, RMS over the workspace",
            fit.now.tool_rms,
            fit.new.tool_rms,
            fit.new.tool_largest,
        ),
        row(
            "height of the first layer that they leave, RMS",
            fit.now.layer_rms,
            fit.new.layer_rms,
            fit.new.layer_largest,
        ),
        "",
        f"{title} has no other settings for the geometry. The calibration identified errors that "
        "they cannot express, such as towers that lean.",
        "",
        f"With what the readings leave unknown, expect a tool error of {tool / MM:.2g} mm RMS, and "
        f"a first layer of {layer / MM:.2g} mm RMS. A bed alone hardly shows the size of a print: "
        "longer rods with a larger radius are as flat. Measure a large print, or the rods.",
    ]
