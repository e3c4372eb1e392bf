"""Settings of a delta printer's firmware with the smallest error, from a calibration.

A firmware has a radius, three towers, three rods and three endstops as settings φ. Let h be the
coordinates of the carriages that bring the real nozzle to p. The firmware computes the position
f(h + Δ; φ), with Δ the change of its homed carriages. φ and Δ minimise the difference between the
computed and the real position above the bed. A translation s and a rotation γ in the plane of the
bed are free, because no print shows them:

    min Σ wₖ |f(h(pₖ) + Δ; φ) − Rz(γ) pₖ − s|² + λ Σ z²(first layer)

The sum is over points pₖ with weights wₖ. Rz(γ) is the rotation about z, and z the error of the
height of the first layer, which has the additional weight λ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from orthocal.arrays import Array
from orthocal.assessment.calibrated_tool import TOOL_CACHE_SIZE, find_tool, place_tool
from orthocal.assessment.controller_entries import lowers
from orthocal.assessment.tool_error import assess_placed
from orthocal.calibration.assessment_record import ToolErrorSummary
from orthocal.calibration.calibration import Calibration, propagate_stds
from orthocal.calibration.refit import restore_covariances
from orthocal.errors import ClosureError, ExportError, SessionError
from orthocal.io.fields import read_only
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.kinematics.workspace import Workspace, box_workspace
from orthocal.printers.firmwares import FIRMWARES
from orthocal.printers.settings import DeltaSettings, FirmwareName
from orthocal.session.session import split_label
from orthocal.units import DEG, MM

FIRST_LAYER = 10.0
"""Weight λ of the mean squared height of the first layer, relative to that of the tool error. The
first layer holds the print. The weight of 10 makes it twice as flat for 5 % more tool error."""

WORTH_LAYER = 0.01 * MM
"""Smallest reduction of the RMS height error of the first layer that is worth new settings, [m]:
half of the scatter of a probe."""

DIFFERENCE_STEP = 1e-5
"""Step of central differences, [m]."""

RINGS = 6
"""Number of rings of points of the first layer."""

UNKNOWN_SCALES = (MM, *(10.0 * MM,) * 2, *(MM,) * 6, 10.0 * MM, *(MM,) * 4)
"""Scales of the unknowns of the fit, as in `_residuals`: radius, angles a and b, rods, homed
carriages, rotation and translation of the print, tilts, [m, rad]."""


PERCENT = 0.01
"""Unit of tilts of the bed, [1]."""


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
    tool_uncertainty: float
    """RMS uncertainty of the tool error after the calibration, [m]."""
    layer_uncertainty: float
    """RMS uncertainty of the heights of the first layer, [m]."""
    rows: tuple[SettingRow, ...]
    """Settings one by one: radius, rods, towers, endstops, and tilts if the firmware has them."""
    gain: Array
    """Derivative of the settings with respect to the free errors of the machine and the nuisance
    parameters, shape (12, n), [SI]."""

    def expect_tool(self, error: FirmwareError) -> float:
        """Expected tool error with the uncertainty of the calibration, RMS, [m]."""
        return math.hypot(error.tool_rms, self.tool_uncertainty)

    def expect_layer(self, error: FirmwareError) -> float:
        """Expected height error of the first layer with its uncertainty, RMS, [m]."""
        return math.hypot(error.layer_rms, self.layer_uncertainty)

    @property
    def worth_entering(self) -> bool:
        """True if the new settings lower the expected errors enough to be entered."""
        lowered = self.expect_layer(self.now) - self.expect_layer(self.new)
        tool = lowers(self.expect_tool(self.now), self.expect_tool(self.new))
        return tool or not lowered < WORTH_LAYER


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
class _Points:
    """Carriages of the calibrated machine at positions of its nozzle.

    Derivatives are in the axes of the bed, with respect to the n free errors of the machine and
    nuisance parameters, or with respect to the carriages.
    """

    points: Array
    """Positions of the nozzle, shape (K, 3), [m]."""
    carriages: Array
    """Coordinates of the carriages, shape (K, 3), [m]."""
    jacobian: Array
    """Derivative of the points with respect to errors, shape (K, 3, n), [m per SI unit]."""
    by_drives: Array
    """Derivative of the points with respect to the carriages, shape (K, 3, 3), [1]."""

    def deviation(self, settings: DeltaSettings, change: Array) -> Array:
        """Computed minus real positions with settings, shape (K, 3), [m].

        Args:
            settings: The settings.
            change: Change of the homed carriages, shape (3,), [m].
        """
        return np.asarray(settings.forward(self.carriages + change) - self.points)

    def deviation_gain(self, settings: DeltaSettings, change: Array) -> Array:
        """Change of the deviations by errors at constant real positions, shape (K, 3, n)."""
        by_carriages = _differentiate(settings, self.carriages + change)
        return np.asarray(by_carriages @ np.linalg.solve(self.by_drives, self.jacobian))


@dataclass(frozen=True, slots=True, eq=False)
class _Targets:
    """Points at which settings of a firmware are fitted."""

    space: _Points
    """Points over the workspace."""
    weights: Array
    """Weights of these points, shape (K,)."""
    layer: _Points
    """Points of the first layer, on the bed."""


@lru_cache(maxsize=TOOL_CACHE_SIZE)
def fit_firmware(
    calibration: Calibration, firmware: FirmwareName, *, tool: ToolErrorSummary | None = None
) -> FirmwareFit:
    """Settings of a firmware with the smallest tool error.

    Cached, because an export writes the settings and prints them.

    Args:
        calibration: Calibration whose session states the present settings of the firmware.
        firmware: Firmware of the new settings.
        tool: Tool error after the calibration; by default that of its assessment.

    Raises:
        SessionError: If the session states no settings.
        ExportError: If the machine does not reach the workspace, no setup measured the bed, or the
            best settings are implausible.
    """
    from scipy.optimize import least_squares

    present = calibration.session.firmware
    if present is None:
        raise SessionError(
            "the calibrated session states no settings of a firmware (controller.firmware); "
            f"{firmware} needs a session that `orthocal import LOG DIRECTORY` makes"
        )
    bed = _find_bed(calibration)
    targets, layer_uncertainty = _find_targets(calibration, bed)
    start, columns = _initial_settings(present, firmware), _unknown_columns(firmware)
    solution = least_squares(
        lambda y: _residuals(targets, start, columns @ y),
        np.zeros(columns.shape[1]),
        x_scale=(UNKNOWN_SCALES @ columns) / columns.sum(axis=0),
        method="lm",
    )
    settings = _apply_changes(start, columns @ solution.x)
    if problem := settings.find_problem():
        raise ExportError(
            f"the best settings are implausible: {problem}. Compare the settings of the log with "
            "those of the printer: others may have been active while the bed was probed"
        )
    if tool is None and calibration.assessment is not None:
        tool = calibration.assessment.tool
    homed_change = np.array(settings.homed) - present.homed
    gain = _setting_gain(targets, settings, solution.jac, homed_change)
    return FirmwareFit(
        settings=settings,
        now=_evaluate(targets, present, np.zeros(3)),
        new=_evaluate(targets, settings, homed_change),
        tool_uncertainty=math.nan if tool is None else tool.compensated,
        layer_uncertainty=layer_uncertainty,
        rows=_setting_rows(calibration, settings, gain),
        gain=read_only(gain),
    )


def _initial_settings(present: DeltaSettings, firmware: FirmwareName) -> DeltaSettings:
    """Present settings without what the firmware lacks: different rods, tilts."""
    rod = float(np.mean(present.rods))
    return replace(
        present,
        firmware=firmware,
        rods=(rod, rod, rod) if FIRMWARES[firmware].equal_rods else present.rods,
        tilts=present.tilts if FIRMWARES[firmware].tilts else (0.0, 0.0),
    )


def _unknown_columns(firmware: FirmwareName) -> Array:
    """Change of the settings (in the order of `_apply_changes`) per unknown, shape (14, n), [1].

    A firmware without tilts, or with one length for all rods, has fewer unknowns.
    """
    columns = np.eye(len(UNKNOWN_SCALES))
    if not FIRMWARES[firmware].tilts:
        columns = columns[:, :-2]
    if FIRMWARES[firmware].equal_rods:
        common = columns[:, 3:6].sum(axis=1, keepdims=True)
        columns = np.concatenate([columns[:, :3], common, columns[:, 6:]], axis=1)
    return columns


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
    n = targets.space.jacobian.shape[-1]
    computed = targets.space.deviation_gain(settings, homed_change)
    heights = targets.layer.deviation_gain(settings, homed_change)[:, 2]
    change = np.sqrt(targets.weights)[:, None, None] * computed
    layer = math.sqrt(FIRST_LAYER / len(heights)) * heights
    change = np.concatenate([change.reshape(-1, n), layer])
    gain = _unknown_columns(settings.firmware) @ np.linalg.lstsq(jacobian, change, rcond=None)[0]
    rods = np.array(settings.rods)[:, None] * gain[3:6] - settings.radius * gain[:1]
    endstops = gain[6:9] - rods / (settings.middle - settings.shift)[:, None]
    fixed = np.zeros((1, n))
    return np.concatenate([gain[:1], gain[3:6], gain[1:3], fixed, endstops, gain[-2:]])


def _setting_rows(
    calibration: Calibration, settings: DeltaSettings, gain: Array
) -> tuple[SettingRow, ...]:
    """Settings before and after.

    Args:
        calibration: The calibration.
        settings: The new settings.
        gain: Derivative of radius, rods, angles, endstops and tilts with respect to errors,
            shape (12, n), [SI].
    """
    present = calibration.session.firmware or settings
    uncertainties = np.full(len(gain), np.nan)
    if not calibration.unmodelled.prior_stds.size:
        stds = propagate_stds(gain, restore_covariances(calibration))
        uncertainties = calibration.expand(*stds)
    values = [("radius", present.radius / MM, settings.radius / MM, MM, "mm")]
    for field, label, scale, unit in (
        ("rods", "rod", MM, "mm"),
        ("angles", "direction of tower", DEG, "°"),
        ("endstops", "endstop", MM, "mm"),
    ):
        for k, tower in enumerate("abc"):
            now, new = (getattr(s, field)[k] / scale for s in (present, settings))
            values.append((f"{label} {tower}", float(now), float(new), scale, unit))
    if FIRMWARES[settings.firmware].tilts:
        for axis, now, new in zip("xy", present.tilts, settings.tilts, strict=True):
            values.append((f"tilt along {axis}", now / PERCENT, new / PERCENT, PERCENT, "%"))
    shown = uncertainties[: len(values)].tolist()
    return tuple(
        SettingRow(name, now, new, u / scale, unit)
        for (name, now, new, scale, unit), u in zip(values, shown, strict=True)
    )


@lru_cache(maxsize=TOOL_CACHE_SIZE)
def _find_targets(calibration: Calibration, bed: str) -> tuple[_Targets, float]:
    """Points over the workspace and on the bed, and the uncertainty of heights on the bed, [m].

    Args:
        calibration: The calibration.
        bed: Name of the setup that measured the bed.

    Raises:
        ExportError: If the machine does not reach the points.
    """
    robot, tool = calibration.robot, find_tool(calibration)
    tilt, rotation_derivative = _find_bed_rotation(calibration, bed)
    if tool is None:
        raise ExportError("the machine does not reach a workspace")
    limits = tool.workspace.limits
    space = box_workspace(robot, limits)
    layer = _layer_points(limits)
    offsets = calibration.active_offsets
    try:
        carriages, layer_carriages = (
            calibration.machine.inverse(p @ tilt.T) + offsets for p in (space.points, layer)
        )
        placed = place_tool(calibration, Workspace.even(layer))
        after = assess_placed(calibration, placed, (), ()).after
    except ClosureError as e:
        raise ExportError(f"the calibrated machine does not reach the bed: {e}") from None
    to_errors, to_drives = (
        ToolSensitivity(robot, free=names, values=calibration.errors)
        for names in (
            [p.name for p in calibration.free],
            [f"{d.name}.offset" for d in robot.drives],
        )
    )

    def place(points: Array, carriages: Array) -> _Points:
        closed = to_errors.closure.close(carriages)
        nozzle, drives = (tilt.T @ of(carriages, passive=closed) for of in (to_errors, to_drives))
        by_bed = -np.einsum("ijk,nj->nik", rotation_derivative, points)
        return _Points(points, carriages, np.concatenate([nozzle, by_bed], axis=2), drives)

    layer_uncertainty = math.nan
    if after is not None:
        layer_uncertainty = math.sqrt(float(after.aligned_covariance[:, 2, 2].mean()))
    targets = _Targets(place(space.points, carriages), space.weights, place(layer, layer_carriages))
    return targets, layer_uncertainty


def _find_bed(calibration: Calibration) -> str:
    """Name of the last setup that measured the bed with a probe.

    Raises:
        ExportError: If no probe measured the bed.
    """
    beds = [s.name for s in calibration.setups if s.sensor.kind == "probe"]
    if not beds:
        raise ExportError(
            "these readings determine no settings: no setup measured the bed with a probe, so the "
            "plane of prints is unknown. Calibrate them together with the log of a probed bed"
        )
    return beds[-1]


def _find_bed_rotation(calibration: Calibration, bed: str) -> tuple[Array, Array]:
    """Rotation from the axes of the bed to those of the machine, and its derivative.

    Joined logs share roll and yaw of the bed.

    Returns:
        The rotation, shape (3, 3); and its derivative with respect to nuisance parameters, shape
        (3, 3, n), [1/rad]. Element i, j, k of this is the change of coordinate i of a point per
        unit of coordinate j and parameter k.
    """
    from scipy.spatial.transform import Rotation

    _, shared = split_label(bed, joined=bool(calibration.session.parts))
    angles = {f"setup.{shared}.{angle}": 0.0 for angle in ("roll", "yaw")}  # about x and y
    axes = dict(zip(angles, np.eye(3), strict=False))
    derivative = np.zeros((3, 3, len(calibration.sensors)))
    for k, p in enumerate(calibration.sensors):
        if p.name in angles:
            angles[p.name] = p.value
            derivative[:, :, k] = np.cross(axes[p.name], np.eye(3)).T
    return np.asarray(Rotation.from_euler("xy", [*angles.values()]).as_matrix()), derivative


def _layer_points(limits: Array) -> Array:
    """Points of equal areas within the circle around the workspace on the bed, (M, 3), [m]."""
    middle, half = limits[:2].mean(axis=1), 0.5 * (limits[:2, 1] - limits[:2, 0])
    points = [np.zeros(2)]
    for ring in range(1, RINGS + 1):
        angles = 2.0 * np.pi * np.arange(6 * ring) / (6 * ring)
        points += list(ring / RINGS * np.column_stack([np.cos(angles), np.sin(angles)]))
    xy = middle + math.sqrt(2.0) * half * np.array(points)
    return np.column_stack([xy, np.full(len(xy), limits[2, 0])])


def _apply_changes(settings: DeltaSettings, x: Array) -> DeltaSettings:
    """Settings with changes of radius, angles a and b, rods, homed carriages and tilts.

    The angle of tower c is unchanged, because it defines the axes of the print.
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
    from scipy.spatial.transform import Rotation

    settings = _apply_changes(present, x)
    change = np.array(settings.homed) - present.homed
    aligned = targets.space.points @ Rotation.from_euler("z", x[9]).as_matrix().T
    aligned[:, :2] += x[10:12]
    error = settings.forward(targets.space.carriages + change) - aligned
    heights = targets.layer.deviation(settings, change)[:, 2]
    weighted = np.sqrt(targets.weights)[:, None] * error
    return np.concatenate([weighted.ravel(), math.sqrt(FIRST_LAYER / len(heights)) * heights])


def _evaluate(targets: _Targets, settings: DeltaSettings, change: Array) -> FirmwareError:
    """Errors of settings with homed carriages changed by `change`, shape (3,), [m].

    The best translation in x and y and rotation about z are removed from the tool errors.
    """
    error = targets.space.deviation(settings, change)
    by_alignment = np.zeros((len(error), 3, 3))  # with respect to x, y and the rotation
    by_alignment[:, 0, 0] = by_alignment[:, 1, 1] = 1.0
    by_alignment[:, 0, 2] = -targets.space.points[:, 1]
    by_alignment[:, 1, 2] = targets.space.points[:, 0]
    root = np.sqrt(np.repeat(targets.weights, 3))[:, None]
    columns, flat = by_alignment.reshape(-1, 3), error.reshape(-1, 1)
    alignment = np.linalg.lstsq(root * columns, root * flat, rcond=None)[0]
    lengths = np.linalg.norm((flat - columns @ alignment).reshape(-1, 3), axis=1)
    heights = targets.layer.deviation(settings, change)[:, 2]
    return FirmwareError(
        tool_rms=math.sqrt(float(targets.weights @ lengths**2)),
        tool_largest=float(lengths.max()),
        layer_rms=math.sqrt(float(np.mean(heights**2))),
        layer_largest=float(np.abs(heights).max()),
    )
