"""Bootstrap of a session: scatter of the estimates from resampled readings.

Each draw resamples the residuals, or complete cycles of each setup, and repeats the calibration.
Cycles preserve a drift within a cycle. With priors, the scatter shows the effect of noise on the
estimates, not their total uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.errors import ParameterError, SessionError
from orthocal.estimation.choice import Choice, resolve_choice
from orthocal.estimation.fit import Fit, fit_problem
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.estimation.weighting import leverages
from orthocal.observation.observations import Observations
from orthocal.robot.parameters import Parameter
from orthocal.session.points import base_name
from orthocal.session.session import Session
from orthocal.statistics.zeros import zero_shares
from orthocal.study.runner import StudyTable
from orthocal.study.study import Columns, Study, columns_in_edge_units, prepare_once, require_counts

Resampled = Literal["residuals", "cycles"]

SMALLEST_SHARE = 1e-6
"""Share of a reading's noise in its residual below which the residual cannot be rescaled."""


@dataclass(frozen=True, eq=False)
class BootstrapStudy(Study):
    """Repeated calibrations of a session with resampled residuals or cycles."""

    kind: ClassVar[str] = "bootstrap"
    counted: ClassVar[str] = "draws"

    choice: Choice
    by: Resampled
    draws: int
    seed: int

    @property
    def count(self) -> int:
        """Number of draws."""
        return self.draws

    def prepare(self) -> _Prepared:
        """Fit of the session, and the data to resample."""
        session = self.session
        problem = CalibrationProblem(session, self.choice.select(session.robot.parameters))
        fit = fit_problem(problem, options=SolverOptions(solver="variable-projection"))
        problem = fit.problem  # with the noise of each gauge
        return _Prepared(
            fit=fit,
            residuals=_rescaled_residuals(fit),
            cycles=find_cycles(session, problem.observations) if self.by == "cycles" else (),
            program=BatchSolver(problem, options=fit.program.options),
        )

    def run(self, prepared: _Prepared, task: int) -> Columns:
        """Estimates of each draw."""
        numbers = self.case_numbers(task)
        generators = (np.random.default_rng((self.seed, n)) for n in numbers)
        values = np.array([prepared.draw(rng, self.by) for rng in generators])
        theta = prepared.program.solve(values, sigma=prepared.fit.sigma).theta
        estimates = columns_in_edge_units("", prepared.fit.problem, theta)
        return {"draw": list(numbers), **estimates}


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Data shared by all draws."""

    fit: Fit
    residuals: Array
    """Residuals rescaled to the noise, with mean 0, shape (n,), [noise-scaled m]."""
    cycles: tuple[tuple[Indices, ...], ...]
    """Entries of each cycle of each setup, with the same order of places in all cycles."""
    program: BatchSolver

    def draw(self, rng: np.random.Generator, by: Resampled) -> Array:
        """Resampled readings of the session, shape (n_entries,), [noise-scaled m]."""
        fitted, measured = self.fit.prediction, self.fit.problem.values
        if by == "residuals":
            return np.asarray(fitted + rng.choice(self.residuals, size=fitted.size))
        values = np.array(measured)
        for cycles in self.cycles:
            drawn = rng.integers(len(cycles), size=len(cycles))
            for entries, k in zip(cycles, drawn, strict=True):
                values[entries] = measured[cycles[k]]
        return values


def build_bootstrap_study(
    session: Session,
    choice: Choice | str | None = None,
    *,
    by: Resampled = "residuals",
    draws: int = 1000,
    seed: int = 0,
) -> BootstrapStudy:
    """Build a study of the scatter of estimates from resampled readings.

    Args:
        session: The session.
        choice: Identified errors, or the name of a model; default: the session's choice, or
            `offsets`.
        by: Whether residuals or complete cycles of each setup are resampled.
        draws: Number of draws.
        seed: Seed of the draws.

    Raises:
        ParameterError: If `by` is unknown, or there is no draw.
        SessionError: If there is nothing to resample.
        NotIdentifiableError: If neither readings nor a prior determine a parameter.
        SolverError: If the solver does not converge.
        ClosureError: If the machine cannot reach a posture.
    """
    if by not in get_args(Resampled):
        expected = " or ".join(get_args(Resampled))
        raise ParameterError(f"found {by!r}; expected {expected}", where="by")
    require_counts(draws=draws)
    study = BootstrapStudy(session, resolve_choice(choice, session), by, draws, seed)
    prepare_once(study)  # refuses a session that cannot be resampled
    return study


def find_cycles(session: Session, observations: Observations) -> tuple[tuple[Indices, ...], ...]:
    """Entries of each cycle of each setup.

    Raises:
        SessionError: If a setup has one cycle, or cycles with different postures.
    """
    cycle = np.zeros(observations.size, dtype=np.int64)
    for r, plus, minus in zip(session.readings, observations.plus, observations.minus, strict=True):
        cycle[[plus, minus] if minus >= 0 else [plus]] = r.cycle
    setup_names, cycles_of_setups = list(session.setups), []
    for setup in np.unique(observations.setup):
        of_setup = np.flatnonzero(observations.setup == setup)
        cycles = []
        for c in np.unique(cycle[of_setup]):
            entries = of_setup[cycle[of_setup] == c]
            cycles.append(entries[np.argsort(observations.place[entries], kind="stable")])
        places = {tuple(observations.place[entries]) for entries in cycles}
        problem = "has one cycle of readings; expected several in each setup"
        if len(cycles) > 1:
            problem = "has cycles with different postures or conditions; expected the same in each"
        if len(cycles) < 2 or len(places) > 1:
            raise SessionError(
                f"{problem}, or --by residuals",
                where=f"{session.path or 'session'}: setups.{base_name(setup_names[setup])}",
            )
        cycles_of_setups.append(tuple(cycles))
    return tuple(cycles_of_setups)


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Scatter of the estimates of one parameter."""

    parameter: Parameter
    estimate: float
    """Estimate from the session itself, [SI]."""
    std: float
    """Standard deviation of the draws, [SI]."""
    standard_error: float
    """Sampling standard error of `std`, [SI]."""
    low: float
    """Lower end of the interval that contains 95 % of the draws, [SI]."""
    high: float
    """Upper end of the interval that contains 95 % of the draws, [SI]."""
    predicted: float
    """Standard deviation from noise, from the covariance, [SI]."""
    model_std: float
    """Standard deviation that includes the prior, from the covariance, [SI]."""


@dataclass(frozen=True, slots=True, eq=False)
class BootstrapSummary:
    """Summary of a bootstrap study."""

    draws: int
    sigma: float
    """Standard deviation of a reading in the calibration of the session, [m]."""
    parameters: tuple[Scatter, ...]
    fewest_cycles: int | None
    """Smallest number of cycles of a setup; None if residuals are resampled."""


def summarise_bootstrap(study: BootstrapStudy, table: StudyTable) -> BootstrapSummary:
    """Summary of the table of a bootstrap study.

    The scatter of draws from c cycles is too small by the factor √((c − 1)/c), which is corrected.
    """
    prepared: _Prepared = prepare_once(study)
    fit, correction, cycles = prepared.fit, 1.0, None
    if study.by == "cycles":
        cycles = min(len(c) for c in prepared.cycles)
        correction = float(np.sqrt(cycles / (cycles - 1)))
    noise = np.sqrt(fit.noise_covariance().diagonal())
    total = np.sqrt(np.diag(fit.covariance()))
    rows = []
    for i, p in enumerate(fit.problem.machine_selection.parameters):
        values = np.array(table.columns[f"{p.name}_{p.edge_unit}"], dtype=np.float64)
        estimate = float(fit.solution.theta[i])
        draws = estimate + correction * (values / p.edge_factor - estimate)
        std = float(draws.std(ddof=1)) if values.size > 1 else np.nan
        low, high = np.quantile(draws, [0.025, 0.975])
        rows.append(
            Scatter(
                parameter=p,
                estimate=estimate,
                std=std,
                standard_error=std / np.sqrt(2.0 * max(values.size - 1, 1)),
                low=float(low),
                high=float(high),
                predicted=float(noise[i]),
                model_std=float(total[i]),
            )
        )
    return BootstrapSummary(len(table), fit.sigma, tuple(rows), cycles)


def _rescaled_residuals(fit: Fit) -> Array:
    """Residuals divided by √(1 − leverage), so that they are as large as the noise, with mean 0.

    Raises:
        SessionError: If parameters and gauge zeros explain all residuals.
    """
    observations = fit.problem.observations
    covariance = fit.information.posterior(
        sigma=fit.sigma, precision=fit.problem.prior_precision, at_bound=fit.at_bound
    ).covariance
    leverage = leverages(fit.jacobian, observations, covariance, fit.sigma)
    share = 1.0 - leverage - zero_shares(observations)[observations.zero]
    if not share.sum() > 1.0:
        raise SessionError(
            "has no residuals to resample: there are not more independent readings than "
            "parameters; expected more readings, or a smaller model",
            where=str(fit.problem.session.path or "session"),
        )
    usable = share > SMALLEST_SHARE
    residuals = fit.residual[usable] / np.sqrt(share[usable])
    return np.asarray(residuals - residuals.mean())
