"""What linearising costs: solutions to first order against the exact one, as errors grow.

Readings are exact, and gauges stand as they are said to: what is missed is missed by the equations.
Noise and resolution stand beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ClosureError, ParameterError, SolverError
from orthocal.estimation.choice import Choice
from orthocal.estimation.fit import require_determined
from orthocal.estimation.linear import (
    SIX_ROWS,
    TWELVE_ROWS,
    Linearisation,
    leg_parallelism_matrix,
    linearise_at_reference,
    solve_equation_8,
    twelve_row_covariance,
)
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.selection import Selection
from orthocal.estimation.solvers.variable_projection import VariableProjection
from orthocal.robot.model import Robot
from orthocal.sensors.mounting import EXACT
from orthocal.session.session import Gauge, Session
from orthocal.statistics.noise import noise_floor
from orthocal.statistics.zeros import project_out_zeros
from orthocal.study.paper import PAPER_GAUGE, Displacements, build_paper_plan
from orthocal.study.shipped_functions import ShippedSession
from orthocal.study.study import Columns, Study, prepare_once
from orthocal.units import MM

Array = NDArray[np.float64]

MACHINES_A_TASK = 250

IDENTIFIED = "identified"
NO_MACHINE = "cannot be assembled"

MOST_STEPS = 20
"""Of Gauss-Newton, undamped."""

EXACT_ENOUGH = 1e-6
"""What a solution misses at most that is as good as the exact one, [m, rad]."""

SOLVED = 1e-9
"""What the exact solution misses at most, [m, rad]."""

LARGEST = 50.0
"""Errors that are looked at by default, [mm]."""

SMALLEST = 0.1

METHODS = ("six", "twelve", "twelve_gls", "first_order", "steps_2", "steps_3", "exact")
"""The paper's equations, ordinary and generalised least squares; the general first-order solution,
which is one Gauss-Newton step, two and three of them; the exact one."""

METHOD_WORDS = {
    "six": "the paper's six equations",
    "twelve": "the paper's twelve",
    "twelve_gls": "twelve, weighed by their covariance",
    "first_order": "general first order",
    "steps_2": "two Gauss-Newton steps",
    "steps_3": "three Gauss-Newton steps",
    "exact": "exact",
}


@dataclass(frozen=True, eq=False)
class LinearisationStudy(Study):
    """Machines whose errors grow, identified to first order and exactly."""

    kind: ClassVar[str] = "linearisation"
    counted: ClassVar[str] = "machines"

    session: ShippedSession
    free: tuple[str, ...]
    """Names of the parameters that are identified, and are off."""
    sizes: tuple[float, ...]
    """Largest error of each machine, [mm or mrad]."""
    directions: tuple[tuple[float, ...], ...]
    """Errors of machines over the largest of them."""
    displacements: Displacements | None
    """Of the paper's plan; None for another one, of which the paper's equations know nothing."""
    sigma: float
    """Standard deviation of a reading, [m]."""
    resolution: float
    """Of a reading, [m]."""

    @property
    def record(self) -> dict[str, Any]:
        """All that the table depends on."""
        d = self.displacements
        return {
            **self.session.record,
            "free": list(self.free),
            "sizes": list(self.sizes),
            "directions": [list(v) for v in self.directions],
            "displacements": None if d is None else [d.maximum, d.minimum],
            "sigma": self.sigma,
            "resolution": self.resolution,
        }

    @property
    def task_sizes(self) -> tuple[int, ...]:
        """Machines of each task."""
        whole, rest = divmod(len(self.sizes) * len(self.directions), MACHINES_A_TASK)
        return (MACHINES_A_TASK,) * whole + ((rest,) if rest else ())

    def prepare(self) -> _Prepared:
        """The problem, to first order, and the paper's equations."""
        session = self.session.unpack()
        selection = Choice(free=self.free, prior=False).select(session.robot.parameters)
        return _Prepared.of(session, selection, self.displacements)

    def run(self, prepared: _Prepared, task: int) -> Columns:
        """What each way misses of each machine, [mm or mrad]; None where it comes to nothing."""
        first = task * MACHINES_A_TASK
        numbers = np.arange(first, first + self.task_sizes[task])
        sizes = np.array(self.sizes)[numbers // len(self.directions)]
        which = numbers % len(self.directions)
        errors = np.array(self.directions)[which] * sizes[:, None] * MM
        return {"size": sizes.tolist(), "direction": which.tolist(), **prepared.identify(errors)}

    @property
    def standard_errors(self) -> dict[str, float]:
        """Largest standard deviation of an estimate by noise, for each way, [m, rad]."""
        found: dict[str, float] = prepare_once(self).standard_errors(self.sigma)
        return found


@dataclass(frozen=True, eq=False)
class _Prepared:
    """What all machines share."""

    problem: CalibrationProblem
    linearisation: Linearisation
    program: VariableProjection
    matrices: Mapping[int, Array] | None
    """The paper's, by their number of rows."""
    rows: Array | None
    """Entries of the paper's twelve differences, less those of the zero, shape (12, n_entries)."""

    @classmethod
    def of(
        cls, session: Session, selection: Selection, displacements: Displacements | None
    ) -> _Prepared:
        problem = CalibrationProblem(session, selection)
        if problem.n_free > problem.n_machine:
            raise ParameterError(
                f"{problem.free[problem.n_machine]} is not known: this study takes sensors for "
                "exact, and knows how only of indicators",
                where="sensors",
            )
        linearisation = linearise_at_reference(problem)
        require_determined(problem, linearisation.information)
        matrices = rows = None
        if displacements is not None:
            length = next(iter(session.robot.legs.values())).length
            matrices = {
                n: leg_parallelism_matrix(
                    length=length,
                    displacement_max=displacements.maximum,
                    displacement_min=displacements.minimum,
                    rows=n,
                )
                for n in (6, 12)
            }
            rows = _differences(session)
        return cls(problem, linearisation, VariableProjection(problem), matrices, rows)

    def identify(self, errors: Array) -> dict[str, list[Any]]:
        """What each way misses of machines with these errors, shape (n_sets, n_free), [SI]."""
        problem = self.problem
        read, good = self._read(errors)
        change = read - problem.predict(problem.reference, problem.reference_passive)
        found: dict[str, Array] = {}

        def missed(theta: Array) -> Array:
            return np.where(good, np.abs(theta - errors).max(axis=1) / MM, np.nan)

        if self.matrices is not None and self.rows is not None:
            twelve = change @ self.rows.T
            six = np.stack([_max_less_min(twelve.T, name) for name in SIX_ROWS], axis=1)
            for name, rows, covariance in (
                ("six", six, None),
                ("twelve", twelve, None),
                ("twelve_gls", twelve, twelve_row_covariance()),
            ):
                matrix = self.matrices[rows.shape[1]]
                unit = np.eye(rows.shape[1])  # what solves is linear: each row alone, then sums
                own = [solve_equation_8(matrix, y, covariance=covariance).offsets for y in unit]
                found[name] = missed(rows @ np.array(own))
        centred = project_out_zeros(change.T, problem.observations).T
        unit = np.vstack([np.zeros(centred.shape[1]), np.eye(centred.shape[1])])
        start, *own = (replace(self.linearisation, residual=y).solve(sigma=1.0) for y in unit)
        foretold = errors / problem.theta_scale @ self.linearisation.slopes.T
        theta = start + centred @ (np.array(own) - start)
        found["first_order"] = missed(theta)
        steps, trail, exact = self._iterate(read, theta, errors, good)
        for k, found_there in enumerate(trail):
            found[f"steps_{k + 2}"] = missed(found_there)
        found["exact"] = missed(exact)
        reading = _spread(centred - foretold, problem) / MM
        return {
            "status": np.where(good, IDENTIFIED, NO_MACHINE).tolist(),
            "reading_mm": np.where(good, reading, np.nan).tolist(),
            "steps": [int(n) if n else None for n in steps],
            **{name: values.tolist() for name, values in found.items()},
        }

    def _read(self, errors: Array) -> tuple[Array, NDArray[np.bool_]]:
        """What machines show, shape (n_sets, n_entries), [m], and which can be assembled."""
        problem = self.problem
        readings, _, reached = problem.simulate(errors)
        return readings, reached

    def _iterate(
        self, read: Array, first: Array, errors: Array, good: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], list[Array], Array]:
        """Gauss-Newton, undamped, from the first-order solution: one step.

        Returns:
            Steps after which a machine is as good as found, 0 for never, shape (n_sets,); what two
            and three of them find; and what the exact solver finds, NaN for nothing.
        """
        theta = np.array(first)
        steps, trail = np.zeros(len(read), dtype=np.int64), []
        on = np.array(good)
        with np.errstate(all="ignore"):
            for step in range(1, MOST_STEPS + 1):
                off = np.abs(theta - errors).max(axis=1)
                steps = np.where(on & (steps == 0) & (off <= EXACT_ENOUGH), step, steps)
                if 1 < step <= 3:
                    trail.append(np.where(on[:, None], theta, np.nan))
                on &= (off > SOLVED) | (step <= 3)
                if not on.any():
                    break
                theta[on], alive = self._step(read[on], theta[on])
                on[np.flatnonzero(on)[~alive]] = False
        exact = np.where((np.abs(theta - errors).max(axis=1) <= SOLVED)[:, None], theta, np.nan)
        for i in np.flatnonzero(good & np.isnan(exact).any(axis=1)):
            with suppress(SolverError, ClosureError):
                exact[i] = self.program.solve(sigma=1e-6, values=read[i]).theta
        return steps, trail, exact

    def _step(self, read: Array, theta: Array) -> tuple[Array, NDArray[np.bool_]]:
        """One step of each machine, and which can be assembled before it."""
        problem = self.problem
        _, passive, alive = problem.simulate(theta)
        found = np.full_like(theta, np.nan)
        if alive.any():
            reading, jacobian = problem.linearise(theta[alive], passive[alive])
            jacobian = np.moveaxis(jacobian, 0, -1)
            shape = jacobian.shape
            flat = project_out_zeros(jacobian.reshape(shape[0], -1), problem.observations)
            slopes = np.moveaxis(flat.reshape(shape), -1, 0)
            left = project_out_zeros((read[alive] - reading).T, problem.observations).T
            inverse = np.linalg.pinv(slopes)
            step = (inverse @ left[..., None])[..., 0]
            found[alive] = theta[alive] + step * problem.theta_scale
        return found, alive

    def standard_errors(self, sigma: float) -> dict[str, float]:
        """Largest standard deviation of an estimate by noise, for each way, [m, rad]."""
        result = {}
        if self.matrices is not None and self.rows is not None:
            six = np.array([_max_less_min(self.rows, name) for name in SIX_ROWS])
            for name, differences, covariance in (
                ("six", six, None),
                ("twelve", self.rows, None),
                ("twelve_gls", self.rows, twelve_row_covariance()),
            ):
                matrix = self.matrices[len(differences)]
                whiten = np.eye(len(matrix))
                if covariance is not None:
                    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
                gain = np.linalg.pinv(whiten @ matrix) @ whiten @ differences
                result[name] = sigma * float(np.sqrt((gain**2).sum(axis=1).max()))
        slopes = self.linearisation.slopes / self.problem.theta_scale
        own = sigma * float(np.sqrt(np.linalg.inv(slopes.T @ slopes).diagonal().max()))
        return {**result, **{m: own for m in METHODS[3:]}}


def build_linearisation_study(
    source: Robot | Session,
    *,
    free: Sequence[str] = ("*.offset",),
    largest: float = LARGEST,
    count: int = 40,
    directions: int = 25,
    along: Sequence[float] | None = None,
    sizes: Sequence[float] | None = None,
    displacements: Displacements | None = None,
    gauge: Gauge | None = None,
    seed: int = 0,
) -> LinearisationStudy:
    """A study of what linearising costs.

    Args:
        source: A robot of the Orthoglide's kind, read by the paper's plan; or a session, of any
            robot, to whose readings the paper's equations say nothing.
        free: Names or globs of the errors that grow and are identified.
        largest: Of the sizes, [mm or mrad].
        count: Of sizes, from 0.1 mm on, each larger than the one before by the same factor.
        directions: Of errors, drawn at random.
        along: One direction instead, of as many numbers as errors.
        sizes: Instead of `largest` and `count`, [mm or mrad].
        displacements: Of the paper's postures.
        gauge: Whose noise and resolution stand beside it; that of the session, or the paper's.
        seed: Of the directions.

    Raises:
        ParameterError: If nothing can be identified, or numbers do not fit.
        SessionError, RobotError: If the robot cannot be read by the paper's plan.
    """
    robot = source if isinstance(source, Robot) else source.robot
    names = robot.parameters.select(free)
    units = {robot.parameters[n].unit for n in names}
    if not units <= {"m", "rad"}:
        raise ParameterError("expected lengths and angles: a scale has no mm", where="--free")
    if isinstance(source, Robot):
        moved = displacements or Displacements()
        session = build_paper_plan(source, moved, gauge or PAPER_GAUGE)
        offsets = tuple(f"{d.name}.offset" for d in robot.drives)
        paper = moved if names == offsets else None
    else:
        session, paper = source, None
    if along is None:
        drawn = np.random.default_rng(seed).normal(size=(directions, len(names)))
    else:
        drawn = np.array([along], dtype=np.float64)
        if drawn.shape[1] != len(names) or not np.abs(drawn).max() > 0.0:
            raise ParameterError(
                f"found {', '.join(f'{v:g}' for v in along)}; expected {len(names)} numbers, not "
                f"all 0: {', '.join(names)}",
                where="--along",
            )
    # what is said to be the size of (1, −0.6, 0.3) is its largest
    unit = drawn / np.abs(drawn).max(axis=1, keepdims=True)
    steps = np.geomspace(min(SMALLEST, largest), largest, count) if sizes is None else sizes
    shown = gauge or session.gauge
    exact = {n: replace(s, sensor=_exactly(s.sensor)) for n, s in session.setups.items()}
    session = replace(session, setups=exact).with_values(np.zeros(len(session.readings)))
    return LinearisationStudy(
        session=ShippedSession.of(session),
        free=tuple(names),
        sizes=tuple(float(f"{v:.4g}") for v in steps),
        directions=tuple(tuple(v.tolist()) for v in unit),
        displacements=paper,
        sigma=noise_floor(shown.sigma, shown.resolution),
        resolution=shown.resolution or 0.0,
    )


def _differences(session: Session) -> Array:
    """Maximum and minimum less zero of each setup of the paper's plan, in the order of eq. (8)."""
    row = {(r.setup, r.posture): i for i, r in enumerate(session.readings)}
    result = np.zeros((len(TWELVE_ROWS), len(row)))
    for k, name in enumerate(TWELVE_ROWS):
        setup, end = name[:2], "max" if name[2] == "+" else "min"
        result[k, row[setup, f"{setup[1]}_{end}"]] = 1.0
        result[k, row[setup, "zero"]] = -1.0
    return result


def _max_less_min(twelve: Array, name: str) -> Array:
    """A row of the reduced system, of the twelve."""
    return np.asarray(twelve[TWELVE_ROWS.index(f"{name}+")] - twelve[TWELVE_ROWS.index(f"{name}-")])


def _spread(values: Array, problem: CalibrationProblem) -> Array:
    """Largest difference of two values that share a zero, shape (n_sets,)."""
    zero = problem.observations.zero
    spans = [np.ptp(values[:, zero == z], axis=1) for z in np.unique(zero)]
    return np.asarray(np.max(spans, axis=0))


def _exactly(sensor: Any) -> Any:  # noqa: ANN401 - whatever has a standing
    return replace(sensor, standing=EXACT) if hasattr(sensor, "standing") else sensor
