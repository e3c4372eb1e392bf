"""Approximate inverse kinematics of a calibrated machine: a closed form and a polynomial.

    q(p, T) = nominal(p) + f(clamp(p)) + (clamp(T) − T₀) g(clamp(p))

f is a polynomial of the lowest total degree that meets the tolerance. On a machine that expands
with its temperature T, g is a polynomial of the same degree, per kelvin from the reference T₀.
Beyond the region their argument is clamped to the faces. The error is evaluated at points that are
not fitted: inside the region and on its faces, edges and corners, over the range of temperatures.
It is the distance of the calibrated machine, with its loops closed, from the commanded point.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from decimal import ROUND_CEILING, Decimal

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
from orthocal.kinematics.loop_closure import find_beyond_travel, require_within_travel
from orthocal.kinematics.workspace import cube_limits, describe_box, grid_points, tool_at_zero
from orthocal.robot.description import HIGHEST_C, LOWEST_C
from orthocal.robot.model import Robot
from orthocal.units import MM, UM

LETTERS = "XYZABC"
"""Coordinates of LinuxCNC in its order."""

MAX_DEGREE = {1: 14, 2: 14, 3: 10}
"""Highest degree by number of coordinates; higher degrees cost more than they gain."""

EXTRA_NODES = 3
"""Number of nodes per coordinate, minus the highest degree."""

CHECKS = 1000
"""Number of checked points inside the region, and number on its faces and edges."""

QUICK_CHECKS = 100
"""Number of the last checked points, on the surface, that refuse low degrees quickly."""

ERROR_MARGIN = 1.1
"""Assumed ratio of the largest error to the largest error at the checked points."""

BEYOND_FACE = 5e-3
"""Distance beyond a face for which the error is stated, [m]."""

LONGER_TOOL = 10e-3
"""Change of the tool's length for which the error is stated, [m]."""

TEMPERATURE_RANGE = 15.0
"""Smallest range to both sides of the reference temperature that a module covers, [K]."""

HEAVIER_PAYLOAD = 1.0
"""Change of the payload for which the error is stated, [kg]."""

ALL_ROWS = slice(None)


@dataclass(frozen=True, slots=True, eq=False)
class ThermalChange:
    """Change of the correction with the temperature of the machine."""

    reference: float
    """Temperature at which the change is 0, [°C]."""
    lowest: float
    """Lower limit to which the temperature is clamped, [°C]."""
    highest: float
    """Upper limit to which the temperature is clamped, [°C]."""
    per_kelvin: Polynomial
    """Change of the drive coordinates, [m/K, rad/K]."""

    def __call__(self, points: Array, temperature: float) -> Array:
        """Changes of the drive coordinates, shape (k, n_drives), [m, rad].

        Args:
            points: Points of the region, shape (k, n), [m].
            temperature: Temperature of the machine, [°C].
        """
        warmer = min(max(temperature, self.lowest), self.highest) - self.reference
        return np.asarray(warmer * self.per_kelvin(points))


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedInverse:
    """Approximate inverse kinematics: drive coordinates for points of the tool."""

    nominal: NominalForm
    correction: Polynomial
    """Correction of the drive coordinates over the region, [m, rad]."""
    thermal: ThermalChange | None = None
    """Change of the correction with temperature; None if the machine does not depend on it."""

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
            points: Points of the tool, shape (k, n), [m].
            temperature: Temperature of the machine, [°C]; the reference by default.
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
    """Function from points of the tool to encoder coordinates without offsets."""
    tool: Array
    """Tip in the frame of the robot's tool centre point, shape (3,), [m]."""
    coordinates: tuple[int, ...]
    """Indices of the world coordinates that the drives command."""
    achieved: float
    """Largest error of the tip at the checked points times ERROR_MARGIN, [m]."""
    checked: int
    """Number of checked points."""
    nominal_error: float | None
    """Largest error with nominal kinematics and the offsets active during the measurement, [m];
    None for a robot without a closed form, or if a point is out of reach."""
    error_beyond: float | None
    """Largest error 5 mm beyond the faces, [m]; None if the machine does not reach that far."""
    error_of_longer_tool: float
    """Largest error for a tip 10 mm farther in any direction, [m]."""
    error_without_thermometer: float | None
    """Largest error without a thermometer over the range of temperatures, [m]; None if the machine
    does not depend on temperature."""
    payload: float | None
    """Mass on the tool for which the approximation holds, [kg]; None if the machine does not depend
    on it."""
    error_of_heavier_payload: float | None
    """Largest error with 1 kg more on the tool, [m]; None if the machine does not depend on it."""

    @property
    def region(self) -> str:
        """Limits of the region in mm, such as X -60 to 60, Y -60 to 60."""
        limits = zip(self.coordinates, self.inverse.lower, self.inverse.upper, strict=True)
        return ", ".join(
            f"{LETTERS[k]} {millimetres([low])} to {millimetres([high])}" for k, low, high in limits
        )


def millimetres(values: Iterable[float]) -> str:
    """Lengths in mm to 1 nm, separated by commas."""
    return ", ".join(f"{round(float(v) / MM, 6) + 0.0:g}" for v in values)


def rounded_up(value: float) -> str:
    """Number with two significant digits, rounded up."""
    if not math.isfinite(value) or value <= 0.0:
        return f"{value:g}"
    number = Decimal(f"{value:.12g}")  # without the rounding errors of binary numbers
    step = Decimal(1).scaleb(number.adjusted() - 1)
    return f"{number.quantize(step, ROUND_CEILING).normalize():f}"


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
    """Passive coordinates at the checked points, from which the closure of the loops starts, shape
    (n_checks, n_passive), [m, rad]."""

    def error(
        self,
        checks: Array,
        inverse: CorrectedInverse,
        *,
        at_reference: bool = False,
        rows: slice = ALL_ROWS,
    ) -> float:
        """Largest error at the checked points, [m]; infinite if a point is out of reach.

        Args:
            checks: Checked points, shape (n_checks, n), [m].
            inverse: The approximation.
            at_reference: Whether the approximation assumes the reference temperature.
            rows: Selection of the checked points.
        """
        points = checks[rows]
        drives = inverse(points, None if at_reference else self.temperature)
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

    Periodic errors of the drives' screws are not included (`drive_compensation.py`).

    Args:
        calibration: The calibration.
        within: Largest error of the tip, [m].
        tool: Tip in the frame of the robot's tool centre point, shape (3,), [m].
        half_side: Half the side of a cube around the mechanical zero, [m]; by default the region
            is the workspace.
        payload: Mass on the tool in addition to the platform, [kg]; none by default.

    Raises:
        ExportError: If no degree meets the tolerance; states the best error. If the machine has no
            tool or does not reach the region.
        ParameterError: If the payload is out of range, or the machine does not depend on it.
    """
    robot = calibration.robot
    UseConditions(payload=payload).require_valid(robot, prefix="--")
    box = _find_box(calibration, half_side)
    middle, half = tool_at_zero(robot) + 0.5 * box.sum(axis=1), 0.5 * (box[:, 1] - box[:, 0])
    n = middle.size
    max_degree = MAX_DEGREE[n]
    nodes = grid_points(*[chebyshev_line(max_degree + EXTRA_NODES)] * n)
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
    for degree in range(1, max_degree + 1):
        fit = PolynomialFit(nodes, total_degree(n, degree))
        thermal = change and ThermalChange(*change[0], fit(middle, half, change[1]))
        inverse = CorrectedInverse(form, fit(middle, half, corrections), thermal)
        if _largest_error(states, checks, inverse, rows=slice(-QUICK_CHECKS, None)) <= within:
            error = _largest_error(states, checks, inverse)
            if error <= within:
                return _assess(calibration, states, inverse, checks, error, payload)
        refused.append(inverse)
    best = min(_largest_error(states, checks, inverse) for inverse in refused)
    raise ExportError(
        f"no polynomial of a degree up to {max_degree} keeps the tool within {within / UM:g} µm "
        f"over {describe_box(box)}; the smallest error is {rounded_up(best / UM)} µm"
    )


def _largest_error(
    states: Sequence[_State], checks: Array, inverse: CorrectedInverse, *, rows: slice = ALL_ROWS
) -> float:
    """Largest error in all states at the checked points, times ERROR_MARGIN, [m]."""
    return ERROR_MARGIN * max(state.error(checks, inverse, rows=rows) for state in states)


def _reach_states(
    calibration: Calibration,
    tool: ArrayLike,
    payload: float | None,
    *,
    corners: Array,
    nodes: Array,
    checks: Array,
) -> list[_State]:
    """Compute states of the machine, first at the reference temperature, then over its range.

    Args:
        calibration: The calibration.
        tool: Tip in the frame of the robot's tool centre point, shape (3,), [m].
        payload: Mass on the tool, [kg].
        corners: Points that are reached first, to fail fast, shape (2^n, n), [m].
        nodes: Points of the fit, shape (n_nodes, n), [m].
        checks: Points at which errors are evaluated, shape (n_checks, n), [m].

    Raises:
        ClosureError: If a point is out of reach.
    """
    robot = calibration.robot
    errors = without_periodic_errors(robot, calibration.errors)
    states = list[_State]()
    start, at_checks = None, None
    for temperature, is_fitted in _list_temperatures(robot):
        conditions = UseConditions(temperature=temperature, payload=payload)
        tip, drives = ToolTip(calibration, tool, errors=errors, conditions=conditions), None
        if not states:
            tip.reach(corners)
        if is_fitted:
            drives, passive = tip.reach(nodes, start=start)
            start = np.hstack([drives, passive])
            require_within_travel(robot, drives, ["a point"] * len(drives))
        at_checks = tip.reach(checks) if at_checks is None else at_checks
        states.append(_State(temperature, tip, drives, *at_checks))
    return states


def _list_temperatures(robot: Robot) -> list[tuple[float | None, bool]]:
    """Temperatures, [°C], and whether the machine is fitted at them.

    The reference comes first (None if the machine has none), then the ends of the range, then
    temperatures between them, which are only checked.
    """
    use = stated_use(robot)
    if use is None or use["temperature"] is None:
        return [(None, True)]
    reference, (low, high) = neutral_values(robot)["temperature"], use["temperature"]
    ends = (
        max(min(low, reference - TEMPERATURE_RANGE), LOWEST_C),
        min(max(high, reference + TEMPERATURE_RANGE), HIGHEST_C),
    )
    between = [(0.5 * (end + reference), False) for end in ends]
    return [(reference, True), *((end, True) for end in ends), *between]


def _find_change(states: Sequence[_State]) -> tuple[tuple[float, float, float], Array] | None:
    """Change of the drive coordinates at the nodes with temperature; None without temperatures.

    Returns:
        Reference, lowest and highest temperature, [°C]; slopes of the least-squares lines through
        the first state (the reference) and near the other fitted ones, shape (n_nodes, n_drives),
        [m/K, rad/K].
    """
    fitted = [(s.temperature, s.drives) for s in states if s.drives is not None]
    if len(fitted) == 1:
        return None
    temperatures = np.array([t for t, _ in fitted], dtype=np.float64)
    drives = np.array([d for _, d in fitted])
    differences = temperatures - temperatures[0]
    per_kelvin = np.tensordot(differences, drives - drives[0], axes=1)
    limits = float(temperatures[0]), float(temperatures.min()), float(temperatures.max())
    return limits, per_kelvin / (differences @ differences)


def _assess(
    calibration: Calibration,
    states: Sequence[_State],
    inverse: CorrectedInverse,
    checks: Array,
    error: float,
    payload: float | None,
) -> Approximation:
    """Compute the errors of an approximation."""
    first = states[0]
    depends_on_payload, heavier = "payload" in effects_by_condition(calibration.robot), None
    if depends_on_payload:
        payload = payload or 0.0
        conditions = UseConditions(temperature=first.temperature, payload=payload + HEAVIER_PAYLOAD)
        errors = without_periodic_errors(calibration.robot, calibration.errors)
        tip = ToolTip(calibration, first.tip.tool, errors=errors, conditions=conditions)
        heavier = replace(first, tip=tip).error(checks, inverse)
    return Approximation(
        inverse=inverse,
        tool=first.tip.tool,
        coordinates=tuple(first.tip.coordinates),
        achieved=error,
        checked=len(checks),
        nominal_error=_nominal_error(first, inverse.nominal, checks, calibration.active_offsets),
        error_beyond=_error_beyond(first.tip, inverse, calibration),
        error_of_longer_tool=_error_of_longer_tool(first.tip, first.expected, first.passive),
        error_without_thermometer=max(
            (s.error(checks, inverse, at_reference=True) for s in states[1:]), default=None
        ),
        payload=payload,
        error_of_heavier_payload=heavier,
    )


def check_points(n: int, *, count: int = CHECKS, seed: int = 1) -> Array:
    """Points inside a cube of ±1 and on its faces, edges and corners, shape (2 count + 2^n, n).

    Only the corners are nodes of the fit.
    """
    generator = np.random.default_rng(seed)
    inside, surface = generator.uniform(-1.0, 1.0, (2, count, n))
    face = generator.integers(0, n, count)
    surface[np.arange(count), face] = generator.choice([-1.0, 1.0], count)
    edges = generator.random((count, n)) < 0.3
    surface[edges] = generator.choice([-1.0, 1.0], int(edges.sum()))
    return np.concatenate([inside, surface, corners(n)])


def corners(n: int) -> Array:
    """Corners of a cube of ±1, shape (2^n, n)."""
    return grid_points(*[[-1.0, 1.0]] * n)


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
    """Replace a ClosureError by an error that names the region.

    Raises:
        ExportError: If the machine does not reach the region.
    """
    try:
        yield
    except ClosureError as e:
        reason = f"the machine does not reach {describe_box(box)} ({e.reason})"
        raise ExportError(f"{reason}; state a smaller --half-side-mm") from None


def _tip_error(
    tip: ToolTip, points: Array, drives: Array, *, start: Array | None = None
) -> float | None:
    """Largest distance of the tip from its target at drive coordinates, [m]; None out of reach."""
    try:
        error = tip.place(drives, start=start) - tip.targets(points)
    except ClosureError:
        return None
    return float(np.linalg.norm(error, axis=1).max())


def _nominal_error(state: _State, form: NominalForm, checks: Array, offsets: Array) -> float | None:
    """Largest error with nominal kinematics and offsets, [m]; None without a closed form."""
    if isinstance(form, Tangent):
        return None
    return _tip_error(state.tip, checks, form(checks) - offsets, start=state.passive)


def _error_beyond(
    tip: ToolTip, inverse: CorrectedInverse, calibration: Calibration
) -> float | None:
    """Largest error at a distance of BEYOND_FACE from the faces, [m]; None out of reach."""
    box = inverse.correction
    surface = check_points(box.middle.size, count=100, seed=2)[100:]
    points = box.middle + (box.half + BEYOND_FACE) * surface
    drives = inverse(points)
    if not np.isfinite(drives).all():
        return None
    if find_beyond_travel(calibration.robot, drives):
        return None
    return _tip_error(tip, points, drives)


def _error_of_longer_tool(tip: ToolTip, drives: Array, passive: Array) -> float:
    """Largest error for a tip displaced by LONGER_TOOL, because of the platform's tilt, [m]."""
    tilt = (tip.poses(drives, passive)[:, :3, :3] - tip.level)[:, tip.coordinates]
    return float(LONGER_TOOL * np.linalg.svd(tilt, compute_uv=False).max())
