"""How far estimates scatter by what the readings themselves show: the session drawn anew.

From residuals, or from whole cycles of each setup, which may drift within themselves. Beside a
prior that is what the readings' noise does to estimates, not all that is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import SessionError
from orthocal.estimation.choice import Choice, choose
from orthocal.estimation.fit import Fit, fit_problem
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.solvers.batch import BatchProgram
from orthocal.estimation.weighting import leverages
from orthocal.observation.observations import Observations
from orthocal.robot.parameters import Parameter
from orthocal.session.session import Session
from orthocal.statistics.zeros import project_out_zeros
from orthocal.study.runner import StudyTable
from orthocal.study.shipped_functions import ShippedSession
from orthocal.study.study import Columns, Study, prepare_once

Array = NDArray[np.float64]

DRAWS_A_TASK = 250

How = Literal["residuals", "cycles"]

ALL_TAKEN = 1e-6
"""Part of a reading below which parameters and zeros leave nothing of its noise."""


@dataclass(frozen=True, eq=False)
class BootstrapStudy(Study):
    """A session drawn anew from its own residuals or cycles, and calibrated each time."""

    kind: ClassVar[str] = "bootstrap"
    counted: ClassVar[str] = "draws"

    session: ShippedSession
    choice: Choice
    how: How
    draws: int
    seed: int

    @property
    def record(self) -> dict[str, Any]:
        """All that the table depends on."""
        return {
            **self.session.record,
            "choice": self.choice.document,
            "how": self.how,
            "draws": self.draws,
            "seed": self.seed,
        }

    @property
    def task_sizes(self) -> tuple[int, ...]:
        """Draws of each task."""
        whole, rest = divmod(self.draws, DRAWS_A_TASK)
        return (DRAWS_A_TASK,) * whole + ((rest,) if rest else ())

    def prepare(self) -> _Prepared:
        """The session's own fit, and what is drawn from it."""
        return _Prepared.of(self)

    def run(self, prepared: _Prepared, task: int) -> Columns:
        """Estimates of each draw."""
        first = task * DRAWS_A_TASK
        numbers = range(first, first + self.task_sizes[task])
        values = prepared.draw_each(self, numbers)
        fit = prepared.fit
        theta = prepared.program.solve(values, sigma=fit.sigma).theta
        columns: dict[str, list[Any]] = {"draw": list(numbers)}
        for i, p in enumerate(fit.problem.machine_selection.parameters):
            columns[f"{p.name}_{p.edge_unit}"] = (theta[:, i] * p.edge_factor).tolist()
        return columns


@dataclass(frozen=True, eq=False)
class _Prepared:
    """What all draws share."""

    fit: Fit
    values: Array
    """Readings as single ones, shape (n_entries,), [m of the first gauge]."""
    fitted: Array
    """The same without noise, gauge zeros at 0."""
    residuals: Array
    """As large as the noise that parameters and zeros have taken part of, with mean 0."""
    cycles: tuple[tuple[NDArray[np.int64], ...], ...]
    """Entries of each cycle of each setup, those of a setup in the same order of postures."""
    program: BatchProgram

    @classmethod
    def of(cls, study: BootstrapStudy) -> _Prepared:
        session = study.session.unpack()
        fit = fit_session(session, study.choice)
        cycles = find_cycles(session, fit.problem.observations) if study.how == "cycles" else ()
        return cls(
            fit=fit,
            values=fit.problem.values,
            fitted=fit.prediction,
            residuals=_free_residuals(fit),
            cycles=cycles,
            program=BatchProgram(fit.problem, options=fit.program.options),
        )

    def draw_each(self, study: BootstrapStudy, numbers: Sequence[int]) -> Array:
        """Readings of these draws, shape (n_draws, n_entries)."""
        rngs = (np.random.default_rng((study.seed, n)) for n in numbers)
        return np.array([self.draw(rng, study.how) for rng in rngs])

    def draw(self, rng: np.random.Generator, how: How) -> Array:
        """The session's readings drawn anew, shape (n_entries,), [m of the first gauge]."""
        if how == "residuals":
            drawn = rng.choice(self.residuals, size=self.fitted.size)
            return np.asarray(self.fitted + drawn)
        values = np.array(self.values)
        for own in self.cycles:
            taken = rng.integers(len(own), size=len(own))
            for place, which in zip(own, taken, strict=True):
                values[place] = self.values[own[which]]
        return values


def build_bootstrap_study(
    session: Session,
    choice: Choice | str | None = None,
    *,
    how: How = "residuals",
    draws: int = 1000,
    seed: int = 0,
) -> BootstrapStudy:
    """A study of how far estimates scatter by what a session's readings show.

    Args:
        session: The session.
        choice: What is identified, or the name of a model; by default what the session is for, or
            offsets.
        how: From residuals, or from the cycles of each setup.
        draws: How often the session is drawn anew.
        seed: Of the draws.

    Raises:
        SessionError: If there is nothing to draw from.
        NotIdentifiableError, SolverError, ClosureError: As `calibrate`.
    """
    chosen = choose(choice, session)
    study = BootstrapStudy(ShippedSession.of(session), chosen, how, draws, seed)
    prepare_once(study)  # refuses what cannot be drawn from
    return study


def fit_session(session: Session, choice: Choice) -> Fit:
    """The session's own calibration."""
    problem = CalibrationProblem(session, choice.select(session.robot.parameters))
    return fit_problem(problem, options=SolverOptions(solver="eliminated"))


def find_cycles(
    session: Session, observations: Observations
) -> tuple[tuple[NDArray[np.int64], ...], ...]:
    """Entries of each cycle of each setup.

    Raises:
        SessionError: If a setup has one cycle, or cycles in which other postures were read.
    """
    cycle = np.zeros(observations.size, dtype=np.int64)
    for r, plus, minus in zip(session.readings, observations.plus, observations.minus, strict=True):
        cycle[[plus, minus] if minus >= 0 else [plus]] = r.cycle
    names, found = list(session.setups), []
    for setup in np.unique(observations.setup):
        own = np.flatnonzero(observations.setup == setup)
        parts = []
        for c in np.unique(cycle[own]):
            entries = own[cycle[own] == c]
            parts.append(entries[np.argsort(observations.posture[entries], kind="stable")])
        where = f"{session.path or 'session'}: setups.{names[setup]}"
        if len(parts) < 2:
            raise SessionError(
                "was read in one cycle; expected several in each setup, or --by residuals",
                where=where,
            )
        postures = [tuple(observations.posture[p]) for p in parts]
        if len(set(postures)) > 1:
            raise SessionError(
                "has cycles in which other postures were read; expected the same in each, or "
                "--by residuals",
                where=where,
            )
        found.append(tuple(parts))
    return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """How far the estimate of one parameter scatters."""

    parameter: Parameter
    estimate: float
    """Of the session itself, [SI]."""
    std: float
    """Of the draws, [SI]."""
    doubt: float
    """Of that, from so many draws, [SI]."""
    low: float
    high: float
    """Ends of the interval that holds 95 % of the draws, [SI]."""
    foretold: float
    """What noise does to the estimate, by the analytic covariance, [SI]."""
    unknown: float
    """All that is unknown of it by the analytic covariance, the prior's part too, [SI]."""


@dataclass(frozen=True, slots=True, eq=False)
class BootstrapSummary:
    """What a session drawn anew says."""

    draws: int
    sigma: float
    """Standard deviation of a reading by the session's own calibration, [m]."""
    parameters: tuple[Scatter, ...]
    fewest_cycles: int | None
    """Of a setup; None where residuals were drawn."""


def summarise_bootstrap(study: BootstrapStudy, table: StudyTable) -> BootstrapSummary:
    """What a session drawn anew says.

    Of few cycles the draws scatter too little, by √((c − 1)/c): their scatter is made up for that.
    """
    fit: Fit = prepare_once(study).fit
    problem = fit.problem
    noise, whole = np.sqrt(_scatter(fit).diagonal()), np.sqrt(np.diag(fit.covariance()))
    cycles = None
    more = 1.0
    if study.how == "cycles":
        found = find_cycles(problem.session, problem.observations)
        cycles = min(len(c) for c in found)
        more = float(np.sqrt(cycles / (cycles - 1)))
    rows = []
    for i, p in enumerate(problem.machine_selection.parameters):
        values = np.array(table.columns[f"{p.name}_{p.edge_unit}"], dtype=np.float64)
        values = values / p.edge_factor
        middle = float(fit.solution.theta[i])
        spread = middle + more * (values - middle)
        std = float(spread.std(ddof=1)) if values.size > 1 else np.nan
        low, high = np.quantile(spread, [0.025, 0.975])
        rows.append(
            Scatter(
                parameter=p,
                estimate=middle,
                std=std,
                doubt=std / np.sqrt(2.0 * max(values.size - 1, 1)),
                low=float(low),
                high=float(high),
                foretold=float(noise[i]),
                unknown=float(whole[i]),
            )
        )
    return BootstrapSummary(len(table), fit.sigma, tuple(rows), cycles)


def _free_residuals(fit: Fit) -> Array:
    """Residuals made as large as the noise: parameters and zeros have taken part of each.

    Raises:
        SessionError: If they have taken all of it.
    """
    o = fit.problem.observations
    inverse = fit.information.covariance(
        sigma=fit.sigma, precision=fit.problem.prior_precision, held=fit.held
    )
    taken = leverages(fit.jacobian, o, inverse, fit.sigma)
    left = 1.0 - taken - 1.0 / np.bincount(o.zero, minlength=o.n_zeros)[o.zero]
    if not left.sum() > 1.0:
        raise SessionError(
            "leaves no residuals to draw from: its readings are no more than what is identified; "
            "expected more readings, or a smaller model",
            where=str(fit.problem.session.path or "session"),
        )
    kept = left > ALL_TAKEN
    own = fit.residual[kept] / np.sqrt(left[kept])
    return np.asarray(own - own.mean())


def _scatter(fit: Fit) -> Array:
    """Covariance of the machine's estimates by noise alone, [SI]: C Jᵀ J C/σ²."""
    problem, n = fit.problem, fit.problem.n_machine
    inverse = fit.information.covariance(
        sigma=fit.sigma, precision=problem.prior_precision, held=fit.held
    )
    slopes = project_out_zeros(fit.jacobian, problem.observations)
    gain = inverse @ slopes.T / fit.sigma
    scale = problem.theta_scale[:n]
    return np.asarray((gain @ gain.T)[:n, :n] * np.outer(scale, scale))
