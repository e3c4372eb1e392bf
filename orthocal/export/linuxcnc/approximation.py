"""Inverse kinematics of a calibrated machine in few numbers: a closed form and a polynomial.

    q(p, T) = nominal(p) + f(clamp(p)) + (clamp(T) − T₀) g(clamp(p))

f is a polynomial of the lowest total degree that meets the tolerance. On a machine that expands
with its temperature T, g is one of the same degree, per kelvin from the reference T₀. Beyond the
region their argument is clamped to the faces. The error is evaluated at points that are not fitted:
inside the region and on its faces, edges and corners, at temperatures over their range. There the
calibrated machine, with its loops closed, is compared with the commanded point.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.calibration.calibration import Calibration
from orthocal.effects.loading import neutral_values
from orthocal.errors import ClosureError, ExportError
from orthocal.export.linuxcnc.drive_compensation import without_periodic_errors
from orthocal.export.linuxcnc.nominal_form import NominalForm, Tangent, find_nominal_form
from orthocal.export.polynomial import Polynomial, PolynomialFit, chebyshev_line, total_degree
from orthocal.export.tool_tip import ToolTip
from orthocal.kinematics.conditions import UseConditions, effects_by_condition, stated_use
from orthocal.kinematics.loop_closure import find_beyond_travel
from orthocal.kinematics.workspace import cube_limits, describe_box, grid_points, tool_at_zero
from orthocal.robot.description import HIGHEST_C, LOWEST_C
from orthocal.robot.model import Robot
from orthocal.units import MM, UM

LETTERS = "XYZABC"
"""Coordinates of LinuxCNC in its order."""

MOST_DEGREE = {1: 14, 2: 14, 3: 10}
"""Number of coordinates to the highest degree; higher ones gain less than they cost."""

EXTRA_NODES = 3
"""Nodes a side beyond the highest degree."""

CHECKED = 1000
"""Number of checked points inside the region, and on its faces, edges and corners."""

CHECKED_FIRST = 100
"""Number of points at which degrees that are too low are refused, of those on the surface."""

RESERVE = 1.1
"""Factor on the largest error at the checked points."""

BEYOND = 5e-3
"""Distance beyond a face at which the error is stated, [m]."""

LONGER = 10e-3
"""Change of the tool's length of which the effect is stated, [m]."""

WARMER = 15.0
"""Temperatures to both sides of the reference that a module covers at least, [K]."""

HEAVIER = 1.0
"""Change of the payload of which the effect is stated, [kg]."""

EVERY = slice(None)


@dataclass(frozen=True, slots=True, eq=False)
class ThermalChange:
    """Change of the correction with the temperature of the machine."""

    reference: float
    """Temperature without a change, [°C]."""
    lowest: float
    highest: float
    """Limits to which the temperature is clamped, [°C]."""
    per_kelvin: Polynomial
    """Change of the drive coordinates, [m/K, rad/K]."""

    def __call__(self, points: Array, temperature: float) -> Array:
        """Changes, shape (k, n_drives), [m, rad], at points of the region, shape (k, n), [m]."""
        warmer = min(max(temperature, self.lowest), self.highest) - self.reference
        return np.asarray(warmer * self.per_kelvin(points))


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedInverse:
    """Drive coordinates for points of the tool."""

    nominal: NominalForm
    correction: Polynomial
    """Correction of the drive coordinates over the region, [m, rad]."""
    thermal: ThermalChange | None = None
    """Its change with temperature; None for a machine that does not depend on it."""

    @property
    def lower(self) -> Array:
        """Smallest coordinates of the region, shape (n,), [m]."""
        return np.asarray(self.correction.middle - self.correction.half)

    @property
    def upper(self) -> Array:
        """Largest coordinates of the region, shape (n,), [m]."""
        return np.asarray(self.correction.middle + self.correction.half)

    def __call__(self, points: Array, temperature: float | None = None) -> Array:
        """Drive coordinates, shape (k, n_drives), [m, rad].

        Args:
            points: Shape (k, n), [m].
            temperature: Of the machine, [°C]; the reference by default.
        """
        clamped = np.clip(points, self.lower, self.upper)
        drives = self.nominal(points) + self.correction(clamped)
        if self.thermal is not None and temperature is not None:
            drives = drives + self.thermal(clamped, temperature)
        return np.asarray(drives)


@dataclass(frozen=True, slots=True, eq=False)
class Approximation:
    """Approximate inverse kinematics with their errors."""

    inverse: CorrectedInverse
    """Points of the tool to drive coordinates of the encoders, without offsets."""
    tool: Array
    """Tip in the frame of the robot's tool centre point, shape (3,), [m]."""
    coordinates: tuple[int, ...]
    """World coordinates that the drives control."""
    achieved: float
    """Largest error of the tip at the checked points, with the reserve, [m]."""
    checked: int
    """Number of checked points."""
    nominal: float | None
    """Largest error with nominal kinematics and the offsets active during the measurement, [m];
    None for a robot without a closed form."""
    beyond: float | None
    """Largest error 5 mm beyond the faces, [m]; None if the machine does not reach that far."""
    longer: float
    """Largest error for a tip 10 mm farther in any direction, [m]."""
    unheated: float | None
    """Largest error within the range of temperatures of a module without a thermometer, [m]; None
    for a machine that does not depend on the temperature."""
    payload: float | None
    """Mass on the tool for which it holds, [kg]; None for a machine that does not depend on it."""
    heavier: float | None
    """Largest error with 1 kg more on the tool, [m]; None as `payload`."""

    @property
    def region(self) -> str:
        """Limits of the region, mm: X -60 to 60, Y -60 to 60."""
        limits = zip(self.coordinates, self.inverse.lower, self.inverse.upper, strict=True)
        return ", ".join(
            f"{LETTERS[k]} {millimetres([low])} to {millimetres([high])}" for k, low, high in limits
        )


def millimetres(values: Iterable[float]) -> str:
    """Lengths in mm to 1 nm, separated by commas."""
    return ", ".join(f"{round(float(v) / MM, 6) + 0.0:g}" for v in values)


def rounded_up(value: float) -> str:
    """Number with two digits, rounded up."""
    if not math.isfinite(value) or value <= 0.0:
        return f"{value:g}"
    decimals = 1 - math.floor(math.log10(value))
    return f"{math.ceil(value * 10.0**decimals) / 10.0**decimals:.2g}"


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """The machine at one temperature."""

    temperature: float | None
    tip: ToolTip
    drives: Array | None
    """Drive coordinates at the nodes of the fit, shape (n_nodes, n_drives), [m, rad]; None at a
    temperature that is not fitted."""
    expected: Array
    """Drive coordinates at the checked points at the reference temperature, shape (n_checks,
    n_drives), [m, rad]."""
    passive: Array
    """Passive coordinates there, from which loops are closed, (n_checks, n_passive), [m, rad]."""

    def error(
        self,
        checks: Array,
        inverse: CorrectedInverse,
        *,
        cold: bool = False,
        rows: slice = EVERY,
    ) -> float:
        """Largest error at the checked points, [m]; infinite out of reach.

        Args:
            checks: Shape (n_checks, n), [m].
            inverse: The approximation.
            cold: Whether it does not know the temperature.
            rows: Points that are checked.
        """
        points = checks[rows]
        drives = inverse(points, None if cold else self.temperature)
        tip_error = _tip_error(self.tip, points, drives, start=self.passive[rows])
        return math.inf if tip_error is None else tip_error


def approximate(
    calibration: Calibration,
    *,
    within: float,
    tool: ArrayLike = (0.0, 0.0, 0.0),
    half_side: float | None = None,
    payload: float | None = None,
) -> Approximation:
    """Inverse kinematics of the lowest degree that meets a tolerance.

    Periodic errors of the drives' screws are no part of it (`drive_compensation.py`).

    Args:
        calibration: The calibration.
        within: Largest distance of the tip from where it belongs, [m].
        tool: The tip in the frame of the robot's tool centre point, shape (3,), [m].
        half_side: Half the side of a cube around the mechanical zero, [m]; by default the region
            is the workspace.
        payload: Mass on the tool beside the platform, [kg]; none by default.

    Raises:
        ExportError: If no degree meets the tolerance, with the best error; if the machine has no
            tool or does not reach the region.
        ParameterError: If the payload is out of range, or nothing depends on it.
    """
    robot = calibration.robot
    UseConditions(payload=payload).require_valid(robot, prefix="--")
    box = _find_box(calibration, half_side)
    middle, half = tool_at_zero(robot) + 0.5 * box.sum(axis=1), 0.5 * (box[:, 1] - box[:, 0])
    n = middle.size
    most = MOST_DEGREE[n]
    nodes = grid_points(chebyshev_line(most + EXTRA_NODES), n)
    checks = middle + half * check_points(n)
    with _reached(box):
        states = _reach_states(
            calibration,
            tool,
            payload,
            corners=middle + half * corners(n),
            nodes=middle + half * nodes,
            checks=checks,
        )
    form = find_nominal_form(robot, middle, half)
    corrections = np.asarray(states[0].drives) - form(middle + half * nodes)
    change, refused = _find_change(states), list[CorrectedInverse]()
    for degree in range(1, most + 1):
        fit = PolynomialFit(nodes, total_degree(n, degree))
        thermal = None if change is None else change.fitted(fit, middle, half)
        inverse = CorrectedInverse(form, fit(middle, half, corrections), thermal)
        if _largest_error(states, checks, inverse, rows=slice(-CHECKED_FIRST, None)) <= within:
            error = _largest_error(states, checks, inverse)
            if error <= within:
                return _describe(calibration, states, inverse, checks, error, payload)
        refused.append(inverse)
    best = min(_largest_error(states, checks, inverse) for inverse in refused)
    raise ExportError(
        f"no polynomial of a degree up to {most} keeps the tool within {within / UM:g} µm "
        f"over {describe_box(box)}; the best of them reaches {rounded_up(best / UM)} µm"
    )


def _largest_error(
    states: Sequence[_State], checks: Array, inverse: CorrectedInverse, *, rows: slice = EVERY
) -> float:
    """Largest error in all states at the checked points, with the reserve, [m]."""
    return RESERVE * max(state.error(checks, inverse, rows=rows) for state in states)


def _reach_states(
    calibration: Calibration,
    tool: ArrayLike,
    payload: float | None,
    *,
    corners: Array,
    nodes: Array,
    checks: Array,
) -> list[_State]:
    """The machine at the reference temperature first, then over the range of temperatures.

    Args:
        calibration: The calibration.
        tool: As for `approximate`.
        payload: As for `approximate`.
        corners: Points that are tried first, shape (2^n, n), [m].
        nodes: Points of the fit, shape (n_nodes, n), [m].
        checks: Points at which errors are evaluated, shape (n_checks, n), [m].

    Raises:
        ClosureError: If a point is out of reach.
    """
    robot = calibration.robot
    errors = without_periodic_errors(robot, calibration.errors)
    labels, states = ["a point"] * len(nodes), list[_State]()
    start, checked = None, None
    for temperature, fitted in _list_temperatures(robot):
        conditions = UseConditions(temperature=temperature, payload=payload)
        tip, drives = ToolTip(calibration, tool, errors=errors, conditions=conditions), None
        if not states:
            tip.reach(corners)  # fails fast
        if fitted:
            drives, passive = tip.reach(nodes, start=start)
            start = np.hstack([drives, passive])
            for failure in find_beyond_travel(robot, drives, labels).values():
                raise failure
        checked = tip.reach(checks) if checked is None else checked
        states.append(_State(temperature, tip, drives, *checked))
    return states


def _list_temperatures(robot: Robot) -> list[tuple[float | None, bool]]:
    """Temperatures, [°C], and whether the machine is fitted there.

    First the reference, None without one; then the ends of the range; then temperatures between
    them, at which the machine is only checked.
    """
    use = stated_use(robot)
    if use is None or use["temperature"] is None:
        return [(None, True)]
    reference, (low, high) = neutral_values(robot)["temperature"], use["temperature"]
    ends = (
        max(min(low, reference - WARMER), LOWEST_C),
        min(max(high, reference + WARMER), HIGHEST_C),
    )
    between = [(0.5 * (end + reference), False) for end in ends]
    return [(reference, True), *((end, True) for end in ends), *between]


@dataclass(frozen=True, slots=True, eq=False)
class _Change:
    """Change of the drive coordinates at the nodes with temperature."""

    temperatures: Array
    """The reference first, [°C]."""
    per_kelvin: Array
    """Shape (n_nodes, n_drives), [m/K, rad/K]."""

    def fitted(self, fit: PolynomialFit, middle: Array, half: Array) -> ThermalChange:
        """The change as a polynomial of a box."""
        t = self.temperatures
        limits = float(t[0]), float(t.min()), float(t.max())
        return ThermalChange(*limits, fit(middle, half, self.per_kelvin))


def _find_change(states: Sequence[_State]) -> _Change | None:
    """The straight line through the reference, the first state, that is nearest to the ends."""
    fitted = [(s.temperature, s.drives) for s in states if s.drives is not None]
    if len(fitted) == 1:
        return None
    temperatures = np.array([t for t, _ in fitted], dtype=np.float64)
    drives = np.array([d for _, d in fitted])
    warmer = temperatures - temperatures[0]
    slopes = np.tensordot(warmer, drives - drives[0], axes=1) / (warmer @ warmer)
    return _Change(temperatures, slopes)


def _describe(
    calibration: Calibration,
    states: Sequence[_State],
    inverse: CorrectedInverse,
    checks: Array,
    error: float,
    payload: float | None,
) -> Approximation:
    """An approximation with its errors; the arguments are those of its making."""
    first = states[0]
    loaded, heavier = "payload" in effects_by_condition(calibration.robot), None
    if loaded:
        payload = payload or 0.0
        conditions = UseConditions(temperature=first.temperature, payload=payload + HEAVIER)
        errors = without_periodic_errors(calibration.robot, calibration.errors)
        tip = ToolTip(calibration, first.tip.tool, errors=errors, conditions=conditions)
        heavier = replace(first, tip=tip).error(checks, inverse)
    return Approximation(
        inverse=inverse,
        tool=first.tip.tool,
        coordinates=tuple(first.tip.coordinates),
        achieved=error,
        checked=len(checks),
        nominal=_nominal_error(first.tip, inverse.nominal, checks, calibration.active_offsets),
        beyond=_error_beyond(first.tip, inverse, calibration),
        longer=_error_of_longer_tool(first.tip, first.expected, first.passive),
        unheated=max((s.error(checks, inverse, cold=True) for s in states[1:]), default=None),
        payload=payload,
        heavier=heavier,
    )


def check_points(n: int, *, count: int = CHECKED, seed: int = 1) -> Array:
    """Points inside a cube of ±1 and on its faces, edges and corners, shape (2 count + 2^n, n).

    Only the corners are nodes of the fit.
    """
    generator = np.random.default_rng(seed)
    inside, outside = generator.uniform(-1.0, 1.0, (2, count, n))
    pinned = generator.integers(0, n, count)
    outside[np.arange(count), pinned] = generator.choice([-1.0, 1.0], count)
    edges = generator.random((count, n)) < 0.3
    outside[edges] = generator.choice([-1.0, 1.0], int(edges.sum()))
    return np.concatenate([inside, outside, corners(n)])


def corners(n: int) -> Array:
    """Corners of a cube of ±1, shape (2^n, n)."""
    return grid_points(np.array([-1.0, 1.0]), n)


def _find_box(calibration: Calibration, half_side: float | None) -> Array:
    """Region relative to the mechanical zero, shape (n_coordinates, 2), [m]."""
    if half_side is not None:
        return cube_limits(calibration.robot, half_side)
    tool = find_tool(calibration)
    if tool is None:
        raise ExportError("the machine has no tool that its drives command over a region")
    return tool.workspace.limits


@contextmanager
def _reached(box: Array) -> Iterator[None]:
    """Name the region if the machine does not reach it.

    Raises:
        ExportError: In place of `ClosureError`.
    """
    try:
        yield
    except ClosureError as e:
        reason = f"the machine does not reach {describe_box(box)} ({e.reason})"
        raise ExportError(f"{reason}; give a smaller --half-side-mm") from None


def _tip_error(
    tip: ToolTip, points: Array, drives: Array, *, start: Array | None = None
) -> float | None:
    """Largest distance of the tip from its target at drive coordinates, [m]; None out of reach."""
    try:
        off = tip.place(drives, start=start) - tip.targets(points)
    except ClosureError:
        return None
    return float(np.linalg.norm(off, axis=1).max())


def _nominal_error(tip: ToolTip, form: NominalForm, points: Array, offsets: Array) -> float | None:
    """Largest error with nominal kinematics and offsets, [m]; None without a closed form."""
    return None if isinstance(form, Tangent) else _tip_error(tip, points, form(points) - offsets)


def _error_beyond(
    tip: ToolTip, inverse: CorrectedInverse, calibration: Calibration
) -> float | None:
    """Largest error beyond the faces, [m]."""
    box = inverse.correction
    outside = check_points(box.middle.size, count=100, seed=2)[100:]
    points = box.middle + (box.half + BEYOND) * outside
    drives = inverse(points)
    if not np.isfinite(drives).all():
        return None
    if find_beyond_travel(calibration.robot, drives, [""] * len(drives)):
        return None
    return _tip_error(tip, points, drives)


def _error_of_longer_tool(tip: ToolTip, drives: Array, passive: Array) -> float:
    """Largest error for a tip farther from the platform, by its tilt, [m]."""
    tilt = (tip.poses(drives, start=passive)[:, :3, :3] - tip.level)[:, tip.coordinates]
    return float(LONGER * np.linalg.svd(tilt, compute_uv=False).max())
