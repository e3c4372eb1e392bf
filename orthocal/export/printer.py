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
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from orthocal.arrays import Array
from orthocal.assessment.assess import assessment_of
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.assessment.tool_error import assess_tool
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError, ExportError
from orthocal.kinematics.workspace import Workspace, box_workspace
from orthocal.printers.firmwares import FIRMWARES
from orthocal.printers.settings import DeltaSettings, FirmwareName
from orthocal.units import DEG, MM

FIRST_LAYER = 10.0
"""Weight λ of the mean squared height of the first layer against that of the tool error. A print
holds by its first layer: a weight of 10 makes it twice as flat for 5 % more tool error."""

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
    found = least_squares(
        partial(_residuals, targets, present), start, x_scale=SCALES[:free], method="lm"
    )
    settings = replace(_changed(present, found.x), firmware=firmware)
    tool = assessment_of(calibration).tool
    return FirmwareFit(
        settings=settings,
        now=_measure(targets, present, np.zeros(3)),
        new=_measure(targets, settings, np.array(settings.homed) - present.homed),
        tool_unknown=math.nan if tool is None else tool.compensated,
        layer_unknown=layer_unknown,
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
    unknown = math.nan
    if accuracy.after is not None:
        unknown = math.sqrt(float(accuracy.after.aligned_covariance[:, 2, 2].mean()))
    return _Targets(space.points, space.weights, carriages, layer, layer_carriages), unknown


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


def _page(calibration: Calibration, fit: FirmwareFit) -> str:
    """README.md: what to do, the values, what remains."""
    settings, present = fit.settings, calibration.session.firmware
    known = FIRMWARES[settings.firmware]
    steps = (
        *STEPS[settings.firmware],
        "Probe the bed again, and import the new log into another directory. The height of the "
        "probe (z offset) stays as it is: set it by paper as before.",
    )
    rows = [("radius", settings.radius / MM, 0.0 if present is None else present.radius / MM, "mm")]
    for name, size, unit in (("rods", MM, "mm"), ("angles", DEG, "°"), ("endstops", MM, "mm")):
        words = {"rods": "rod", "angles": "direction of tower", "endstops": "endstop"}[name]
        for k, tower in enumerate("abc"):
            old = 0.0 if present is None else getattr(present, name)[k]
            rows.append((f"{words} {tower}", getattr(settings, name)[k] / size, old / size, unit))
    table = [f"| {name} | {old:.3f} | {new:.3f} | {unit} |" for name, new, old, unit in rows]
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
            "| | now | new | |",
            "|---|---|---|---|",
            *table,
            "",
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
