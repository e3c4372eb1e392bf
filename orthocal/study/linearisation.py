"""Study of linearisation: first-order and exact solutions for increasing errors.

Readings are exact and gauges have no mounting errors, so that errors of estimates result from the
equations alone. Noise and resolution serve as a comparison.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from orthocal.arguments import require_kind, require_names
from orthocal.arrays import Array, Indices, Mask
from orthocal.errors import ClosureError, ParameterError, SolverError
from orthocal.estimation.fit import require_determined
from orthocal.estimation.linear import (
    SIX_ROWS,
    TWELVE_ROWS,
    LinearProblem,
    invert_equation_8,
    leg_parallelism_matrix,
    linearise_problem,
    twelve_row_covariance,
)
from orthocal.estimation.problem import CalibrationProblem, build_problem
from orthocal.estimation.solvers.variable_projection import VariableProjection
from orthocal.observation.gauge_noise import stated_sigma
from orthocal.planning.expected_error import with_gauge_noise
from orthocal.planning.first_plan import PAPER_GAUGE, Displacements, build_paper_plan
from orthocal.robot.model import Robot
from orthocal.sensors.mounting import EXACT
from orthocal.session.session import Gauge, Session
from orthocal.statistics.zeros import project_out_zeros
from orthocal.study.random_machines import NO_CONTACT, NOT_ASSEMBLED
from orthocal.study.runner import StudyTable
from orthocal.study.study import Columns, Study, prepare_once, require_counts
from orthocal.units import MM

IDENTIFIED = "identified"

MAX_STEPS = 20
"""Largest number of undamped Gauss-Newton steps."""

CONVERGED = 1e-6
"""Error of the estimates below which Gauss-Newton steps have converged, [m, rad]."""

SOLVED = 1e-9
"""Error of the estimates below which they are the exact solution, [m, rad]."""

LARGEST_SIZE = 50.0
"""Default size of the last machine: its largest error component, [mm or mrad]."""

SMALLEST_SIZE = 0.1
"""Size of the first machine, [mm or mrad]."""

METHODS = ("six", "twelve", "twelve_gls", "first_order", "steps_2", "steps_3", "exact")
"""The paper's equations by ordinary and generalised least squares; the general first-order
solution, which is one Gauss-Newton step; two and three steps; the exact solution."""


@dataclass(frozen=True, eq=False)
class LinearisationStudy(Study):
    """Machines with increasing errors that are identified to first order and exactly."""

    kind: ClassVar[str] = "linearisation"
    counted: ClassVar[str] = "machines"

    free: tuple[str, ...]
    """Names of the parameters that have errors and are identified."""
    sizes: tuple[float, ...]
    """Largest error component of each machine, [mm or mrad]."""
    directions: tuple[tuple[float, ...], ...]
    """Errors of machines divided by the largest component."""
    displacements: Displacements | None
    """Displacements of the paper's plan; None for other plans, without the paper's equations."""
    sigma: float
    """Standard deviation of a reading, [m]."""
    resolution: float
    """Resolution of a reading, [m]."""

    @property
    def count(self) -> int:
        """Number of machines: each size in each direction."""
        return len(self.sizes) * len(self.directions)

    def prepare(self) -> _Prepared:
        """The problem, its linearisation, and the paper's equations."""
        problem = build_problem(self.session, free=self.free, prior=False)
        if problem.n_free > problem.n_machine:
            raise ParameterError(
                f"{problem.free[problem.n_machine]} is a nuisance parameter; this study requires "
                "exact sensors, which only indicators support",
                where="sensors",
            )
        if all(stated_sigma(g) > 0.0 for g in self.session.gauges_with_readings.values()):
            problem = with_gauge_noise(problem)  # readings are weighted as in a calibration
        linearisation = linearise_problem(problem)
        require_determined(problem, linearisation.information)
        paper = {}
        if self.displacements is not None:
            paper = _paper_solutions(problem.session, self.displacements)
        return _Prepared(problem, linearisation, VariableProjection(problem), paper)

    def run(self, prepared: _Prepared, task: int) -> Columns:
        """Errors of each method's estimates, [mm or mrad]; None where the method fails."""
        numbers = np.array(self.case_numbers(task))
        sizes = np.array(self.sizes)[numbers // len(self.directions)]
        directions = numbers % len(self.directions)
        errors = np.array(self.directions)[directions] * sizes[:, None] * MM
        columns = {"size": sizes.tolist(), "direction": directions.tolist()}
        return {**columns, **prepared.identify(errors)}

    @property
    def standard_errors(self) -> dict[str, float]:
        """Method to the largest standard error of an estimate from noise, [m, rad]."""
        prepared: _Prepared = prepare_once(self)
        return prepared.standard_errors(self.sigma)


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Data shared by all machines."""

    problem: CalibrationProblem
    linearisation: LinearProblem
    program: VariableProjection
    paper: Mapping[str, Array]
    """Paper methods, mapped to matrices from single readings to offsets, shape (3, n_entries);
    empty for other plans."""

    def identify(self, errors: Array) -> dict[str, list[Any]]:
        """Errors of each method's estimates.

        Args:
            errors: True errors of the machines, shape (n_sets, n_free), [SI].
        """
        problem = self.problem
        readings, _, assembled = problem.simulate(errors)
        measurable = assembled & np.isfinite(readings).all(axis=1)
        columns: dict[str, list[Any]] = {}

        def add(name: str, theta: Array) -> None:
            error = np.abs(theta - errors).max(axis=1) / MM
            columns[name] = np.where(measurable, error, np.nan).tolist()

        change = readings - problem.predict(problem.active_theta, problem.active_passive)
        for name, solution in self.paper.items():
            add(name, change @ solution.T)
        centred = project_out_zeros(change.T, problem.observations).T
        unit_rows = np.vstack([np.zeros(centred.shape[1]), np.eye(centred.shape[1])])
        start, *rows = (replace(self.linearisation, residual=y).solve(sigma=1.0) for y in unit_rows)
        first_order = start + centred @ (np.array(rows) - start)
        add("first_order", first_order)
        steps, iterates, exact = self._iterate(readings, first_order, errors, measurable)
        for k, theta in enumerate(iterates):
            add(f"steps_{k + 2}", theta)
        add("exact", exact)
        linear = errors / problem.theta_scale @ self.linearisation.jacobian.T
        nonlinear = (centred - linear) * problem.noise_ratio
        nonlinearity = _largest_difference(nonlinear, problem) / MM
        reason = np.where(assembled, NO_CONTACT, NOT_ASSEMBLED)
        return {
            "status": np.where(measurable, IDENTIFIED, reason).tolist(),
            "reading_mm": np.where(measurable, nonlinearity, np.nan).tolist(),
            "steps": [int(n) if n else None for n in steps],
            **columns,
        }

    def _iterate(
        self, readings: Array, first_order: Array, errors: Array, measurable: Mask
    ) -> tuple[Indices, list[Array], Array]:
        """Undamped Gauss-Newton iterations, of which the first-order solution is the first step.

        Returns:
            Numbers of steps to convergence, shape (n_sets,), 0 without convergence; the estimates
            after two and three steps; the exact estimates, NaN if the solver fails.
        """
        theta, active = np.array(first_order), np.array(measurable)
        steps, iterates = np.zeros(len(readings), dtype=np.int64), []
        with np.errstate(all="ignore"):
            for step in range(1, MAX_STEPS + 1):
                error = np.abs(theta - errors).max(axis=1)
                steps = np.where(active & (steps == 0) & (error <= CONVERGED), step, steps)
                if 1 < step <= 3:
                    iterates.append(np.where(active[:, None], theta, np.nan))
                active &= (error > SOLVED) | (step <= 3)
                if not active.any():
                    break
                theta[active], succeeded = self.step(readings[active], theta[active])
                active[np.flatnonzero(active)[~succeeded]] = False
        solved = np.abs(theta - errors).max(axis=1) <= SOLVED
        exact = np.where(solved[:, None], theta, np.nan)
        for i in np.flatnonzero(measurable & ~solved):
            with suppress(SolverError, ClosureError):
                exact[i] = self.program.solve(sigma=1e-6, values=readings[i]).theta
        return steps, iterates, exact

    def step(self, readings: Array, theta: Array) -> tuple[Array, Mask]:
        """One Gauss-Newton step for each machine; NaN if its readings cannot be predicted.

        Args:
            readings: Readings, shape (n_sets, n_entries), [noise-scaled m].
            theta: Parameters, shape (n_sets, n_free), [SI].
        """
        problem = self.problem
        _, passive, closed = problem.simulate(theta)
        if not closed.any():
            return np.full_like(theta, np.nan), closed
        predicted, jacobian = problem.predict_and_jacobian(theta[closed], passive[closed])
        finite = np.isfinite(predicted).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
        predicted, jacobian = predicted[finite], jacobian[finite]
        predictable = np.array(closed)
        predictable[np.flatnonzero(closed)[~finite]] = False
        next_theta = np.full_like(theta, np.nan)
        if predictable.any():
            by_entry = np.moveaxis(jacobian, 0, -1)
            flat = by_entry.reshape(by_entry.shape[0], -1)
            centred = project_out_zeros(flat, problem.observations).reshape(by_entry.shape)
            residual = project_out_zeros(
                (readings[predictable] - predicted).T, problem.observations
            ).T
            inverse = np.linalg.pinv(np.moveaxis(centred, -1, 0))
            step = (inverse @ residual[..., None])[..., 0]
            next_theta[predictable] = theta[predictable] + step * problem.theta_scale
        return next_theta, predictable

    def standard_errors(self, sigma: float) -> dict[str, float]:
        """Largest standard error of an estimate by noise, for each method, [m, rad].

        Args:
            sigma: Standard deviation of a reading of the first gauge, [m]. The others have their
                own, by which readings are weighted.
        """
        errors = {
            name: sigma * float(np.sqrt((solution**2).sum(axis=1).max()))
            for name, solution in self.paper.items()
        }
        jacobian = self.linearisation.jacobian / self.problem.theta_scale
        variances = np.linalg.inv(jacobian.T @ jacobian).diagonal()
        general = sigma * float(np.sqrt(variances.max()))
        return {**errors, **dict.fromkeys(METHODS[3:], general)}


def _require_arguments(source: object, sizes: Sequence[float]) -> None:
    """Refuse a source or sizes of `build_linearisation_study` of another kind.

    Raises:
        TypeError: If the source is of another kind.
        ParameterError: If a size is not positive.
    """
    require_kind(source, (Robot, Session), expected="a Robot or a Session")
    for size in sizes:
        if not 0.0 < size < math.inf:
            raise ParameterError(f"found {size}; expected a positive size", where="sizes")


def build_linearisation_study(
    source: Robot | Session,
    *,
    free: Sequence[str] = ("*.offset",),
    largest: float = LARGEST_SIZE,
    count: int = 40,
    directions: int = 25,
    along: Sequence[float] | None = None,
    sizes: Sequence[float] | None = None,
    displacements: Displacements | None = None,
    gauge: Gauge | None = None,
    seed: int = 0,
) -> LinearisationStudy:
    """Build a study of the errors of linearised identification.

    Args:
        source: A robot of Orthoglide type, measured as in the paper; or a session of any robot.
        free: Names or globs of the errors that increase and are identified.
        largest: Largest size of a machine, [mm or mrad]: its largest error component.
        count: Number of sizes, a geometric sequence from 0.1 mm; the largest alone with 1.
        directions: Number of random directions of the errors.
        along: One direction in place of random ones: a number for each error.
        sizes: Sizes in place of `largest` and `count`, [mm or mrad].
        displacements: Displacements of the paper's postures.
        gauge: Gauge of the comparison; default: that of the session or of the paper.
        seed: Seed of the directions.

    Raises:
        ParameterError: If nothing can be identified, or a number is invalid.
        RobotError: If the robot cannot be measured by the paper's plan.
    """
    _require_arguments(source, [largest, *(() if sizes is None else sizes)])
    require_counts(count=count, directions=directions)
    robot = source if isinstance(source, Robot) else source.robot
    names = robot.parameters.select(require_names(free, argument="free"))
    if not {robot.parameters[n].unit for n in names} <= {"m", "rad"}:
        raise ParameterError("expected lengths and angles; a scale has no mm", where="--free")
    paper_displacements = None
    if isinstance(source, Robot):
        displacements = displacements or Displacements()
        source = build_paper_plan(source, displacements, gauge or PAPER_GAUGE)
        if names == tuple(f"{d.name}.offset" for d in robot.drives):
            paper_displacements = displacements
    gauge = gauge or source.gauge
    if along is None:
        vectors = np.random.default_rng(seed).normal(size=(directions, len(names)))
    else:
        vectors = _read_direction(along, names)
    unit_vectors = vectors / np.abs(vectors).max(axis=1, keepdims=True)
    if sizes is None:
        sizes = np.geomspace(largest, min(SMALLEST_SIZE, largest), count)[::-1].tolist()
    return LinearisationStudy(
        session=_idealise(source),
        free=tuple(names),
        sizes=tuple(float(f"{v:.4g}") for v in sizes),
        directions=tuple(tuple(v.tolist()) for v in unit_vectors),
        displacements=paper_displacements,
        sigma=stated_sigma(gauge),
        resolution=gauge.resolution or 0.0,
    )


def _idealise(session: Session) -> Session:
    """Session of the same postures with readings of 0, exact mountings and no active offsets.

    Errors are those that the active offsets do not correct: equations are linear about them.
    """
    if session.active_offsets.any():
        session = session.with_controller(np.zeros(len(session.robot.drives)))
    setups = dict(session.setups)
    for name, setup in setups.items():
        sensor: Any = setup.sensor
        if hasattr(sensor, "mounting"):
            setups[name] = replace(setup, sensor=replace(sensor, mounting=EXACT))
    return replace(session, setups=setups).with_values(np.zeros(len(session.readings)))


def _read_direction(along: Sequence[float], names: Sequence[str]) -> Array:
    """Stated direction of the errors, shape (1, n_errors)."""
    vector = np.array([along], dtype=np.float64)
    if vector.shape[1] != len(names) or not np.abs(vector).max() > 0.0:
        raise ParameterError(
            f"found {', '.join(f'{v:g}' for v in along)}; expected {len(names)} numbers, not "
            f"all 0: {', '.join(names)}",
            where="--along",
        )
    return vector


def _paper_solutions(session: Session, displacements: Displacements) -> dict[str, Array]:
    """Matrix of each paper method from single readings to offsets, shape (3, n_entries)."""
    differences = _paper_differences(session)
    plus, minus = ([TWELVE_ROWS.index(f"{name}{sign}") for name in SIX_ROWS] for sign in "+-")
    six, twelve = (
        leg_parallelism_matrix(
            length=next(iter(session.robot.legs.values())).length,
            displacement_max=displacements.maximum,
            displacement_min=displacements.minimum,
            rows=n,
        )
        for n in (6, 12)
    )
    weighted = invert_equation_8(twelve, covariance=twelve_row_covariance())
    return {
        "six": invert_equation_8(six) @ (differences[plus] - differences[minus]),
        "twelve": invert_equation_8(twelve) @ differences,
        "twelve_gls": weighted @ differences,
    }


def _paper_differences(session: Session) -> Array:
    """Matrix of the differences between extreme and zero postures, in the rows of eq. (8)."""
    row = {(r.setup, r.posture): i for i, r in enumerate(session.readings)}
    differences = np.zeros((len(TWELVE_ROWS), len(row)))
    for k, name in enumerate(TWELVE_ROWS):
        setup, end = name[:2], "max" if name[2] == "+" else "min"
        differences[k, row[setup, f"{setup[1]}_{end}"]] = 1.0
        differences[k, row[setup, "zero"]] = -1.0
    return differences


def _largest_difference(values: Array, problem: CalibrationProblem) -> Array:
    """Largest difference of two entries with the same free zero, or entry with a known zero.

    Shape (n_sets,).
    """
    o = problem.observations
    sizes = [
        np.abs(values[:, o.zero == z]).max(axis=1)
        if o.zero_known[z]
        else np.ptp(values[:, o.zero == z], axis=1)
        for z in np.unique(o.zero)
    ]
    return np.asarray(np.max(sizes, axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class MethodErrors:
    """Errors of the estimates of one method for increasing errors of the machine."""

    name: str
    errors: Array
    """Largest error of an estimate for each size, RMS over the directions, [mm or mrad]; NaN if the
    method fails in a direction."""
    standard_error: float
    """Standard error from noise, [mm or mrad]."""
    exceeds_resolution: float | None
    """Size above which the error exceeds the resolution, [mm or mrad]; None if never."""
    exceeds_noise: float | None
    """Size above which the error exceeds the standard error, [mm or mrad]; None if never."""
    fails: float | None
    """Smallest size at which the method fails in a direction, [mm or mrad]; None if never."""


@dataclass(frozen=True, slots=True, eq=False)
class LinearisationSummary:
    """Summary of a linearisation study."""

    sizes: Array
    """Sizes of the machines, ascending, [mm or mrad]."""
    methods: tuple[MethodErrors, ...]
    reading: Array
    """Largest error of a linearised difference of readings for each size, RMS over the directions,
    [mm]."""
    steps: tuple[int | None, ...]
    """Gauss-Newton steps to convergence in all directions for each size; None if any diverges."""
    resolution: float
    """Resolution of a reading, [mm]."""
    measurable: float | None
    """Largest size at which machines can be measured in all directions; None if there is none."""


def summarise_linearisation(study: LinearisationStudy, table: StudyTable) -> LinearisationSummary:
    """Summary of the table of a linearisation study."""
    columns = table.columns
    size = np.array(columns["size"], dtype=np.float64)
    identified = np.array(columns["status"], dtype=object) == IDENTIFIED
    sizes = np.unique(size)
    measurable_sizes = [float(s) for s in sizes if identified[size == s].all()]
    standard_errors, resolution = study.standard_errors, study.resolution / MM

    def by_size(name: str) -> Array:
        values = np.array(columns[name], dtype=np.float64)
        samples = [values[(size == s) & identified] for s in sizes]
        return np.array([np.sqrt(np.mean(v**2)) if v.size else np.nan for v in samples])

    methods = []
    for name in (m for m in METHODS if m in columns):
        errors, standard_error = by_size(name), standard_errors[name] / MM
        failed = np.isnan(errors) & np.isin(sizes, measurable_sizes)
        if name == "exact":
            failed |= errors > SOLVED / MM
        methods.append(
            MethodErrors(
                name=name,
                errors=errors,
                standard_error=standard_error,
                exceeds_resolution=_crossing(sizes, errors, resolution),
                exceeds_noise=_crossing(sizes, errors, standard_error),
                fails=float(sizes[failed].min()) if failed.any() else None,
            )
        )
    # infinite without convergence; 0 if no machine could be measured
    counts = np.array([n or np.inf for n in columns["steps"]], dtype=np.float64)
    largest_counts = [counts[(size == s) & identified].max(initial=0.0) for s in sizes]
    return LinearisationSummary(
        sizes=sizes,
        methods=tuple(methods),
        reading=by_size("reading_mm"),
        steps=tuple(int(n) if 0.0 < n < np.inf else None for n in largest_counts),
        resolution=resolution,
        measurable=max(measurable_sizes) if measurable_sizes else None,
    )


def _crossing(sizes: Array, values: Array, level: float) -> float | None:
    """Size above which values exceed a level, interpolated on logarithmic scales; None if never."""
    above = np.flatnonzero(values > level)
    if not above.size or not level > 0.0:
        return None
    k = int(above[0])
    if k == 0 or not values[k - 1] > 0.0:
        return float(sizes[k])
    share = np.log(level / values[k - 1]) / np.log(values[k] / values[k - 1])
    return float(sizes[k - 1] * (sizes[k] / sizes[k - 1]) ** share)
