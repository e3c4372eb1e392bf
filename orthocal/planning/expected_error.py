"""What readings will leave unknown at the tool, before any is taken.

Of a machine within its tolerances, to first order about the nominal one: the posterior of what is
identified, and what errors that are not identified do to it and by themselves (as
`assess.accuracy` has it of a calibration).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from orthocal.assessment.tool_error import (
    ErrorSize,
    ErrorSizes,
    ToolUncertainty,
    measure_uncertainty,
)
from orthocal.errors import ClosureError, RobotError, SessionError
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.estimation.problem import CalibrationProblem, build_problem
from orthocal.estimation.selection import Selection
from orthocal.estimation.weighting import split_by_gauge
from orthocal.kinematics.function_cache import cached_per_robot
from orthocal.kinematics.loop_closure import nominal_assembly
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.kinematics.workspace import (
    FEWEST_ALIGNED,
    Workspace,
    largest_cube,
    tool_at_zero,
)
from orthocal.observation.observations import build_observations
from orthocal.robot.model import Robot
from orthocal.runtime.worker_pool import call_on_cores, lent_cores
from orthocal.session.session import Session
from orthocal.statistics.information import posterior_covariance
from orthocal.statistics.noise import estimate_repeatability, noise_floor
from orthocal.statistics.zeros import project_out_zeros

Array = NDArray[np.float64]

Criterion = Literal["aligned", "relative", "absolute", "worst", "A", "D", "E"]
"""What a plan makes small: the r.m.s. error at the tool in its three forms, the error at the worst
point (shift and rotation out), or the covariance of the parameters in their tolerances: its trace,
determinant or largest eigenvalue."""

CRITERIA: tuple[Criterion, ...] = ("aligned", "relative", "absolute", "worst", "A", "D", "E")

WORST_POWER = 8.0
"""The mean of this power of the points' variances stands for the largest of them."""

MACHINES = 12
"""Machines that are drawn to foretell what is left."""

ENTERED = 0.1
"""Of their tolerances: what offsets are off by once they were entered."""

ROOM = 1.08
"""How much further a machine gets than to the corners of the cube that it is judged by."""

NEARLY_SINGULAR = 10.0
"""What moves the tool most over what moves it least, by drives, where nothing is promised."""

VAGUE = 1e-8
"""Inverse variance of a parameter without a prior, [1 per tolerance²]: nothing is known of it."""


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """What readings would leave unknown."""

    tool: ToolUncertainty
    names: tuple[str, ...]
    """Free parameters of the machine, then those that are not identified."""
    tolerances: Array
    """[SI]."""
    covariance: Array
    """Of what the estimate has wrong, shape (n, n), [SI]."""

    lost: float = 0.0
    """Share of the readings that do not exist on machines within their tolerances: the tip passes
    what it should touch."""

    @property
    def sizes(self) -> ErrorSizes:
        """Of the error at the tool."""
        return self.tool.sizes

    @property
    def headline(self) -> ErrorSize:
        """The one that decides."""
        return self.tool.sizes.headline


class ToolForecast:
    """Errors at the tool of machines within their tolerances, by what is read of them.

    Args:
        robot: The robot.
        selection: What is identified.
        others: Errors that are not identified, and by how much they may be off, [SI]; by default
            all of the machine's, by their tolerances.
        workspace: Where the tool's error counts; by default the largest cube around the zero that
            the machine reaches, of ±60 mm at most.

    Raises:
        RobotError: If the robot has no tool centre point.
        ClosureError: If the machine cannot reach the workspace.
    """

    def __init__(
        self,
        robot: Robot,
        selection: Selection,
        workspace: Workspace | None = None,
        *,
        others: Mapping[str, float] | None = None,
    ) -> None:
        self.robot, self.selection = robot, selection
        self.workspace = default_workspace(robot) if workspace is None else workspace
        parameters = robot.parameters
        free = selection.names
        taken = {parameters[n].terms[0][0] for n in (*free, *selection.fixed)}
        self.others = tuple(
            n
            for n in (machine_errors(robot) if others is None else others)
            if not taken & {term for term, _ in parameters[n].terms}
        )
        self.names = (*free, *self.others)
        own = {**(others or {}), **{p.name: p.tolerance for p in selection.parameters}}
        self.tolerances = np.array([own.get(n, parameters[n].tolerance) for n in self.names])
        nominal = nominal_assembly(robot)
        drives, passive = nominal.reach(self.workspace.points)
        self.positions = nominal.tcp(drives, passive)
        sensitivity = ToolSensitivity(robot, free=self.names)
        self.jacobian = sensitivity(drives, passive=passive)
        """∂p/∂θ, shape (K, 3, n_names), [m per parameter unit]."""

    @property
    def before(self) -> Expected:
        """What is unknown of a machine of which nothing was read."""
        return self._expected(np.diag(self.tolerances**2))

    def align(self, field: Array) -> Array:
        """Tool errors with shift and rotation taken out, shape (K, 3, ...)."""
        if len(self.positions) < FEWEST_ALIGNED:
            return self.workspace.remove_shift(field)
        return self.workspace.remove_motion(field, self.positions)

    def problem(self, session: Session) -> CalibrationProblem:
        """The calibration that a session's readings will be for."""
        return weigh_readings(CalibrationProblem(session, self.selection))

    def after(
        self,
        session: Session,
        *,
        sigma: float | None = None,
        weight: float | None = None,
        entered: bool = True,
        machines: Sequence[Array] | None = None,
    ) -> Expected:
        """What a session's readings leave unknown, whatever they will be.

        The mean of machines drawn from the tolerances, with gauges as they may stand, each to first
        order about itself: a ball beside the crest of its rod tells less than one on top of it.

        Args:
            session: What is read where; its readings do not matter.
            sigma: Standard deviation of a reading, [m]; what is stated of the gauge by default.
            weight: The one that readings are taken to have when they are weighed, [m]: more than
                sigma where the model leaves errors out; the same by default.
            entered: Whether the drives' offsets are near what the controller corrects already, as
                they are once they were entered; else they are drawn from their tolerances, too.
            machines: Others than those that are drawn: free parameters of the session's problem,
                shape (n_free,) each, [SI].
        """
        problem = self.problem(session)
        others = self._slopes_of_others(session)
        noise = noise_of(session) if sigma is None else sigma
        drawn = list(self._draw(problem, entered=entered)) if machines is None else machines
        _, closed, reached = problem.simulate(np.array(drawn))

        def posteriors(part: Iterable[int]) -> list[tuple[Array | None, float]]:
            passive = [closed[i] if reached[i] else None for i in range(len(drawn))]
            return [
                self._posterior(problem, others, drawn[i], noise, weight, passive[i]) for i in part
            ]

        parts = np.array_split(np.arange(len(drawn)), lent_cores())
        each = [f for part in call_on_cores([partial(posteriors, p) for p in parts]) for f in part]
        found = [covariance for covariance, _ in each if covariance is not None]
        lost = sum(share / len(drawn) for _, share in each)
        if not found:
            raise ClosureError(
                "cannot be read on machines within their tolerances", posture="the planned ones"
            )
        return replace(self._expected(np.mean(found, axis=0)), lost=lost)

    def about_nominal(self, session: Session, *, sigma: float | None = None) -> Expected:
        """The same to first order about the nominal machine: what a search makes small."""
        problem = self.problem(session)
        others = self._slopes_of_others(session)
        noise = noise_of(session) if sigma is None else sigma
        covariance, _ = self._posterior(problem, others, problem.reference, noise)
        if covariance is None:
            raise ClosureError("cannot be read", posture="the planned ones")
        return self._expected(covariance)

    def _slopes_of_others(self, session: Session) -> Array | None:
        """How one tolerance of what is not identified moves a session's readings, [m]."""
        if not self.others:
            return None
        n = len(self.selection.names)
        own = dict(zip(self.others, self.tolerances[n:].tolist(), strict=True))
        free = build_problem(session, free=self.others, prior=True, tolerances=own)
        problem = weigh_readings(free)
        _, slopes = problem.linearise(np.zeros(problem.n_free))
        return slopes[:, : len(self.others)]

    def _draw(self, problem: CalibrationProblem, *, entered: bool) -> Iterator[Array]:
        """Machines within their tolerances, and how their gauges stand, [SI]."""
        offsets = [i for i, name in enumerate(problem.free) if name.endswith(".offset")]
        for seed in range(MACHINES):
            drawn = np.random.default_rng(seed).normal(size=problem.n_free) * problem.theta_scale
            if entered:
                drawn[offsets] *= ENTERED
            # without a prior nothing is known: a tolerance is what it is taken to be
            yield problem.reference + drawn

    def _posterior(
        self,
        problem: CalibrationProblem,
        others: Array | None,
        theta: Array,
        noise: float,
        weight: float | None = None,
        passive: Array | None = None,
    ) -> tuple[Array | None, float]:
        """Covariance of what the estimate has wrong about a machine, (n_names, n_names), [SI].

        And the share of readings that do not exist there; None where too few do.
        """
        o, n = problem.observations, problem.n_machine
        try:
            _, jacobian = problem.linearise(theta, passive)
        except ClosureError:
            return None, 1.0
        good = np.asarray(np.isfinite(jacobian).all(axis=1))
        lost = 1.0 - float(good.mean())
        if good.sum() <= o.n_zeros:
            return None, lost
        jacobian, part = jacobian[good], o.only(good)
        precision = np.maximum(problem.prior_precision, VAGUE)
        weight = noise if weight is None else weight
        slopes = project_out_zeros(jacobian, part)
        inverse = posterior_covariance(slopes, sigma=weight, precision=precision)
        scale = problem.theta_scale[:n]
        spread = inverse
        if weight != noise:  # they scatter by less than they are weighed by
            gain = inverse @ slopes.T
            spread = inverse - (weight**2 - noise**2) / weight**4 * (gain @ gain.T)
        known = spread[:n, :n] * np.outer(scale, scale)
        if others is None:
            return known, lost
        other = project_out_zeros(others[good], part)
        leak = (inverse @ (slopes.T @ other) / weight**2)[:n] * scale[:, None]
        left = np.diag(self.tolerances[n:] ** 2)
        taken = leak * self.tolerances[n:]
        return np.block([[known + leak @ leak.T, -taken], [-taken.T, left]]), lost

    def _expected(self, covariance: Array) -> Expected:
        tool = measure_uncertainty(self.jacobian, covariance, self.workspace, self.positions)
        return Expected(tool, self.names, self.tolerances, covariance)

    def weigh(self, criterion: Criterion, n_state: int) -> Weigher:
        """What a criterion makes of the covariance of a state that begins with what is free."""
        n = len(self.selection.names)
        scaled = self.jacobian[:, :, :n] * self.tolerances[:n]
        if criterion in ("aligned", "worst"):
            field = self.align(scaled)
        elif criterion == "relative":
            field = self.workspace.remove_shift(scaled)
        else:
            field = scaled
        padded = np.zeros((*field.shape[:2], n_state))
        padded[:, :, :n] = field
        return Weigher(criterion, padded, self.workspace.weights, n)


class Weigher:
    """R with tr(Rᵀ C R) the square of what a criterion makes small.

    Args:
        criterion: Which.
        field: Tool errors by the state, shape (K, 3, n_state), [m per tolerance].
        weights: Of the points, shape (K,).
        n: Parameters of the machine, the first of the state.
    """

    def __init__(self, criterion: Criterion, field: Array, weights: Array, n: int) -> None:
        self._criterion, self._field, self._weights, self._n = criterion, field, weights, n
        self._constant = None if criterion in ("worst", "D", "E") else self._mean_square()

    def __call__(self, covariance: Array) -> Array:
        """R for a covariance of the state, shape (n_state, p)."""
        if self._constant is not None:
            return self._constant
        if self._criterion == "worst":
            return self._worst(covariance)
        n, size = self._n, len(covariance)
        root = np.zeros((size, n if self._criterion == "D" else 1))
        if self._criterion == "E":
            values, vectors = np.linalg.eigh(covariance[:n, :n])
            root[:n, 0] = vectors[:, -1] if values.size else 0.0
            return root
        # of the determinant's n-th root the slope is itself times the inverse, over n
        values, vectors = np.linalg.eigh(covariance[:n, :n])
        mean = float(np.exp(np.mean(np.log(np.maximum(values, 1e-300)))))
        root[:n] = vectors * np.sqrt(mean / (n * np.maximum(values, 1e-300)))
        return root

    def _mean_square(self) -> Array:
        if self._criterion == "A":
            size = self._field.shape[2]
            return np.asarray(np.eye(size)[:, : self._n] / np.sqrt(self._n))
        flat = np.sqrt(self._weights)[:, None, None] * self._field
        return _root(flat.reshape(-1, flat.shape[2]))

    def _worst(self, covariance: Array) -> Array:
        variance = np.einsum("kin,nm,kim->k", self._field, covariance, self._field, optimize=True)
        share = (variance / variance.max()) ** (WORST_POWER - 1.0)
        total = float(np.mean(share * variance / variance.max()))
        weights = share * total ** (1.0 / WORST_POWER - 1.0) / len(share)
        flat = np.sqrt(weights)[:, None, None] * self._field
        return _root(flat.reshape(-1, flat.shape[2]))


def _root(rows: Array) -> Array:
    """R with R Rᵀ = rowsᵀ rows, of as few columns as it takes, shape (n, p)."""
    values, vectors = np.linalg.eigh(rows.T @ rows)
    kept = values > values[-1] * 1e-14
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def noise_of(session: Session) -> float:
    """Standard deviation of a reading, as stated of the (first) gauge, [m]."""
    return noise_floor(session.gauge.sigma, session.gauge.resolution)


def weigh_readings(problem: CalibrationProblem) -> CalibrationProblem:
    """The same problem with readings that count by what is stated of their gauges."""
    session = problem.session
    groups = split_by_gauge(session, problem.observations)
    if len(groups) < 2:
        return problem
    noise = np.ones(problem.observations.size)
    for group in groups:
        own = noise_floor(group.gauge.sigma, group.gauge.resolution)
        noise[group.entries] = own / noise_of(session)
    return problem.with_noise(noise)


def state_noise(session: Session) -> Session:
    """A session whose gauges all state their sigma; from repeated cycles where they do not.

    Raises:
        SessionError: If nothing tells the noise of a gauge.
    """
    o = build_observations(session)
    gauges = dict(session.gauges)
    for group in split_by_gauge(session, o):
        if group.gauge.sigma is not None or group.gauge.resolution is not None:
            continue
        values = o.values(session.values)[group.entries]
        sigma, dof = estimate_repeatability(values, o.only(group.entries))
        if not (dof and sigma > 0.0):
            key = f"gauges.{group.name}.sigma_mm" if group.name else "gauge.sigma_mm"
            raise SessionError(
                "is missing: without the scatter of its readings no plan can say what they are "
                "worth",
                where=key if session.path is None else f"{session.path}: {key}",
            )
        gauges[group.name] = replace(group.gauge, sigma=sigma)
    return replace(session, gauges=gauges)


@cached_per_robot(maxsize=8)
def default_workspace(robot: Robot) -> Workspace:
    """The largest cube around the zero that the nominal machine reaches, of ±60 mm at most.

    With some room: where a machine just gets to it is singular, or another one does not.

    Raises:
        RobotError: If the drives do not command the tool.
        ClosureError: If the tool hardly moves.
    """
    if robot.tcp is None or len(robot.tcp.coordinates) != len(robot.drives):
        raise RobotError(
            "the drives do not command the tool: nothing can be said of it", where=str(robot.yaml)
        )
    lower = np.array([d.lower for d in robot.drives])
    upper = np.array([d.upper for d in robot.drives])

    middle, moved = tool_at_zero(robot), list(robot.tcp.coordinates)
    sensitivity = ToolSensitivity(robot, free=[f"{d.name}.offset" for d in robot.drives])

    def reach(points: Array) -> None:
        drives, passive = nominal_assembly(robot).reach(middle + ROOM * (points - middle))
        if (drives < lower).any() or (drives > upper).any():
            raise ClosureError("is beyond the travel of a drive", posture="a corner")
        if (np.linalg.cond(sensitivity(drives, passive=passive)[:, moved]) > NEARLY_SINGULAR).any():
            raise ClosureError("is nearly singular", posture="a corner")

    found = largest_cube(robot, reach)
    if found is None:
        raise ClosureError("cannot be reached: the tool hardly moves", posture="mechanical zero")
    return found
