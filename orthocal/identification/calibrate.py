"""From a session to a calibration: the one call that most users need."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal import __version__
from orthocal.arguments import require_kind, require_names
from orthocal.errors import ClosureError, NotIdentifiableError, ParameterError
from orthocal.identification.calibration import Calibration
from orthocal.identification.calibration_file import require_loadable
from orthocal.identification.choice import Choice
from orthocal.identification.cross_validation import predict_unseen
from orthocal.identification.diagnostics import Diagnostics, diagnose_readings
from orthocal.identification.fit import Fit, first_sigma, fit_problem
from orthocal.identification.identifiability import (
    Identifiability,
    analyse_identifiability,
    find_base_parameters,
)
from orthocal.identification.linear import Linearisation, linearise_at_reference
from orthocal.identification.loss import Loss, LossKind
from orthocal.identification.options import SolverKind, SolverOptions
from orthocal.identification.problem import CalibrationProblem
from orthocal.identification.profile import profile_interval
from orthocal.identification.records import (
    GaugeRecord,
    NoiseRecord,
    ParameterEstimate,
    PostureRecord,
    ResidualRow,
    RobotRecord,
    SessionRecord,
    SetupRecord,
    SolverRecord,
)
from orthocal.identification.selection import Selection
from orthocal.identification.turned import find_turned_setup
from orthocal.identification.uncertainty import (
    Information,
    confidence_factor,
    estimate_repeatability,
    marginalise,
    project_out_zeros,
)
from orthocal.identification.unmodelled import (
    Unmodelled,
    find_other_errors,
    measure_unmodelled,
)
from orthocal.identification.weighting import split_by_gauge
from orthocal.kinematics.assembly import as_rows
from orthocal.measurement.joining import join_sessions
from orthocal.measurement.session import Session
from orthocal.measurement.session_file import load_session
from orthocal.robot.loading import packaged_robots
from orthocal.robot.model import read_only
from orthocal.robot.parameters import Parameter

Array = NDArray[np.float64]


MAX_BASE_ROUNDS = 8


def calibrate(
    session: Session | str | Path | Sequence[Session | str | Path],
    choice: Choice | str | None = None,
    *,
    loss: Loss | LossKind | None = None,
    solver: SolverOptions | SolverKind = "ipopt",
    profile: Sequence[str] = (),
    start: ArrayLike | None = None,
) -> Calibration:
    """Identify the errors of a machine from a session, exactly, with their uncertainty.

    Args:
        session: The session, or the path to one; or several, which are fitted together.
        choice: Which errors are free, and what is known of them; or the name of a model. Offsets
            by default.
        loss: What a residual costs: `squares` (the default), `huber`, or one with its own width.
        solver: `ipopt` on the whole program, the reference; `eliminated`, the same optimum sooner;
            `linearised`, as the paper; or one with its own settings.
        profile: Names or globs of free parameters whose profile-likelihood intervals are wanted.
        start: Free parameters to start from, shape (n_free,), [SI]; by default the linearised
            solution.

    Raises:
        NotIdentifiableError: If the readings leave a parameter open and there is no prior.
        SolverError: If the solver does not converge.
        ClosureError: If the machine cannot reach a posture.
        ParameterError: If the model or a name is unknown.
        TypeError: If an argument is of another kind.
        ValueError: If there are not as many free parameters to start from as there are.
    """
    session = _gather(session)
    require_names(profile, argument="profile")
    require_kind(choice, (Choice, str, type(None)), expected="a Choice, or the name of a model")
    chosen = choice if isinstance(choice, Choice) else Choice(choice)
    options = _solver_options(solver, loss)
    problem = CalibrationProblem(session, chosen.select(session.robot.parameters))
    if start is not None:
        start, _ = as_rows(start, problem.n_free, "free parameters to start from")
        if start.shape != (1, problem.n_free) or not np.isfinite(start).all():
            raise ValueError(f"expected {problem.n_free} finite numbers to start from")
        start = start[0]
    whole = None
    if chosen.base:
        whole = problem
        fit = _fit_base(whole, options=options, start=start)
    else:
        fit = fit_problem(problem, options=options, start=start)
    profiled = _match_profiled(fit.problem, profile)
    intervals = {name: profile_interval(fit, name) for name in profiled}
    return assemble_calibration(fit, whole=whole, intervals=intervals)


def _solver_options(
    solver: SolverOptions | SolverKind, loss: Loss | LossKind | None
) -> SolverOptions:
    require_kind(solver, (SolverOptions, str), expected="a solver's name, or SolverOptions(...)")
    require_kind(loss, (Loss, str, type(None)), expected="a loss's name, or Loss(...)")
    options = solver if isinstance(solver, SolverOptions) else SolverOptions(solver=solver)
    if loss is None:
        return options
    return replace(options, loss=loss if isinstance(loss, Loss) else Loss(loss))


def _gather(given: Session | str | Path | Sequence[Session | str | Path]) -> Session:
    """What was given as one session."""
    several: list[Session | str | Path]
    several = list(given) if isinstance(given, (list, tuple)) else [given]  # type: ignore[list-item]
    found = []
    for one in several:
        if not isinstance(one, Session):
            require_kind(one, (str, Path), expected="a Session, or the path to one")
            one = load_session(one)
        found.append(one)
    return join_sessions(found)


def repeat_calibration(calibration: Calibration, session: Session) -> Calibration:
    """The same parameters, with the same priors and bounds, identified from another session.

    Its rows' nominal values are those of the machine as it was calibrated before.

    Raises:
        NotIdentifiableError, SolverError, ClosureError: As `calibrate`.
    """
    nominal = np.array([p.value for p in calibration.free])
    return assemble_calibration(repeat_fit(calibration, session), nominal=nominal)


def repeat_fit(calibration: Calibration, session: Session) -> Fit:
    """The fit of `repeat_calibration`."""
    free = calibration.free
    parameters = session.robot.parameters
    selection = Selection(
        label=calibration.model,
        parameters=tuple(replace(parameters[p.name], tolerance=p.tolerance) for p in free),
        prior=np.array([p.prior for p in free]),
        mean=read_only([p.mean for p in free]),
        lower=read_only([-np.inf if p.lower is None else p.lower for p in free]),
        upper=read_only([np.inf if p.upper is None else p.upper for p in free]),
        fixed={p.name: p.value for p in calibration.parameters if not p.free},
    )
    solver = calibration.solver
    options = SolverOptions(solver=solver.name, loss=Loss(solver.loss, solver.loss_width))
    return fit_problem(CalibrationProblem(session, selection), options=options)


def assemble_calibration(
    fit: Fit,
    *,
    whole: CalibrationProblem | None = None,
    intervals: Mapping[str, tuple[float, float]] | None = None,
    nominal: Array | None = None,
) -> Calibration:
    """The record of a solved problem.

    Args:
        fit: The solved problem.
        whole: The problem with all parameters, where those that were solved for are its base
            parameters.
        intervals: Profile-likelihood intervals by name, [SI].
        nominal: Free parameters of the machine that readings are held against, shape (n_free,),
            [SI]; what the controller already corrects by default.

    Raises:
        SolverError: If the result makes no sense.
    """
    problem, noise, loss = fit.problem, fit.noise, fit.loss
    session = problem.session
    n = problem.n_machine
    covariance = fit.covariance()
    # a base parameter is the whole combination: nothing of it is left out
    others = find_other_errors(fit, spoken_for=() if whole is None else whole.free)
    unmodelled = measure_unmodelled(fit, others)
    estimates = _estimates(fit, covariance, _widen(fit, unmodelled, intervals or {}))
    diagnostics = diagnose_readings(fit)
    residuals = _residual_rows(fit, diagnostics, nominal)
    factor = np.sqrt(2.0) if session.only_differences else 1.0
    calibration = Calibration(
        robot_record=_robot_record(session),
        session=_session_record(session),
        model=problem.selection.label,
        prior=bool(problem.machine_selection.prior.any()),
        solver=SolverRecord(
            name=fit.program.options.solver,
            status=fit.solution.status,
            iterations=fit.iterations,
            seconds_build=fit.seconds_build,
            seconds_solve=fit.seconds_solve,
            hessian=fit.solution.hessian,
            loss=loss.kind,
            loss_width=loss.width,
        ),
        parameters=(*estimates[:n], *_held_estimates(problem)),
        sensors=estimates[n:],
        covariance=read_only(covariance[:n, :n]),
        unmodelled=unmodelled,
        identifiability=_identifiability(fit, whole),
        base=whole is not None,
        noise=NoiseRecord(
            reading_sigma=noise.sigma,
            source=noise.source,
            cycles_sigma=noise.cycles_sigma,
            cycles_dof=noise.cycles_dof,
            residual_sigma=noise.residual_sigma,
            residual_dof=noise.residual_dof,
        ),
        sigma=noise.sigma * float(factor),
        dof=noise.dof,
        rows_are_differences=session.only_differences,
        residuals=residuals,
        turned=find_turned_setup(fit, others, residuals),
        critical=diagnostics.critical,
        postures=tuple(
            PostureRecord(name, tuple(p.drives.tolist()), tuple(fit.solution.passive[i].tolist()))
            for i, (name, p) in enumerate(session.postures.items())
        ),
        setups=_setup_records(fit),
        gauges=_gauge_records(fit),
        version=__version__,
    )
    require_loadable(calibration)
    calibration.remember("robot", lambda: session.robot)  # no need to load it again
    return calibration


def _fit_base(
    problem: CalibrationProblem, *, options: SolverOptions | None, start: ArrayLike | None
) -> Fit:
    """Solve a problem in base parameters: what cannot be told apart is told as one.

    How many there are depends on the noise, and that on what they leave: until both agree.
    """
    information = linearise_at_reference(problem).information
    repeatability = estimate_repeatability(problem.values, problem.observations)
    sigma = first_sigma(problem.session, repeatability)
    leads: list[str] = []
    for _ in range(MAX_BASE_ROUNDS):
        factor = information.factor[:, : problem.n_machine]
        machine = problem.machine_selection.parameters
        found = find_base_parameters(factor, machine, threshold=sigma)
        if not found:
            raise NotIdentifiableError(
                "the readings tell none of the free parameters", parameters=problem.free
            )
        chosen = [c.terms[0][0] for c in found]
        if chosen == leads:
            break
        leads = chosen
        reduced = CalibrationProblem(problem.session, problem.machine_selection.keep(leads))
        fit = fit_problem(reduced, options=options, start=start)
        sigma = max(fit.sigma, sigma)  # no more parameters than before
    return fit


def _match_profiled(problem: CalibrationProblem, patterns: Sequence[str]) -> list[str]:
    if not patterns:
        return []
    found = [n for n in problem.robot.parameters.select(patterns) if n in problem.free]
    if not found:
        raise ParameterError(
            f"{', '.join(patterns)}: no free parameter to find the interval of",
        )
    return found


def _identifiability(fit: Fit, whole: CalibrationProblem | None) -> Identifiability:
    """Of the free parameters; of base parameters, together with what they stand for."""

    def analyse(information: Information, parameters: Sequence[Parameter]) -> Identifiability:
        return analyse_identifiability(
            information,
            parameters,
            sigma=fit.noise.sigma,
            n_postures=fit.problem.n_postures,
            n_readings=fit.independent_readings,
        )

    def of_machine(linearisation: Linearisation) -> Identifiability:
        machine = linearisation.problem.machine_selection.parameters
        information = marginalise(linearisation.information, len(machine), sigma=fit.sigma)
        return analyse(information, machine)

    own = of_machine(fit.linearisation)
    if whole is None:
        return own
    # how well the base parameters are told; which they are follows from the whole
    found = of_machine(linearise_at_reference(whole.with_noise(fit.problem.noise)))
    return replace(found, singular_values=own.singular_values, rank=own.structural_rank)


def _widen(
    fit: Fit, unmodelled: Unmodelled, intervals: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Intervals of what the noise explains, with the errors of the machine that were left out."""
    spread = confidence_factor(np.inf) * np.sqrt(np.diag(unmodelled.bias_covariance))
    result = {}
    for name, ends in intervals.items():
        i = fit.problem.free.index(name)
        value, more = float(fit.solution.theta[i]), float(spread[i])
        low, high = (math.hypot(value - end, more) for end in ends)
        selection = fit.problem.selection
        result[name] = (
            max(value - low, float(selection.lower[i])),
            min(value + high, float(selection.upper[i])),
        )
    return result


def _estimates(
    fit: Fit, covariance: Array, intervals: Mapping[str, tuple[float, float]]
) -> tuple[ParameterEstimate, ...]:
    problem, solution = fit.problem, fit.solution
    selection = problem.selection
    std = np.sqrt(np.diag(covariance))
    told = fit.machine_information.determined(sigma=fit.noise.sigma)
    determined = np.append(told, np.zeros(problem.n_free - told.size, dtype=bool))
    words: dict[int, Literal["lower", "upper"] | None] = {-1: "lower", 0: None, 1: "upper"}
    return tuple(
        ParameterEstimate(
            name=p.name,
            unit=p.unit,
            value=float(solution.theta[i]),
            linear=float(fit.linear[i]),
            std=float(std[i]),
            tolerance=p.tolerance,
            free=True,
            identifiable=bool(determined[i]),
            start=float(problem.reference[i]),
            prior=bool(selection.prior[i]),
            mean=float(problem.prior_mean[i]),
            lower=_bound(selection.lower[i]),
            upper=_bound(selection.upper[i]),
            at_bound=words[int(solution.at_bound[i])],
            interval=intervals.get(p.name),
        )
        for i, p in enumerate(problem.parameters)
    )


def _held_estimates(problem: CalibrationProblem) -> tuple[ParameterEstimate, ...]:
    estimates = []
    for name, value in problem.fixed.items():
        p = problem.robot.parameters[name]
        estimates.append(
            ParameterEstimate(
                name=name,
                unit=p.unit,
                value=value,
                linear=value,
                std=0.0,
                tolerance=p.tolerance,
                free=False,
                identifiable=False,
                start=value,
                prior=False,
                mean=0.0,
                lower=None,
                upper=None,
                at_bound=None,
                interval=None,
            )
        )
    return tuple(estimates)


def _bound(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _robot_record(session: Session) -> RobotRecord:
    robot = session.robot
    packaged = packaged_robots().get(session.robot_reference)
    folder = None if packaged is not None else str(robot.folder.resolve())
    return RobotRecord(
        name=robot.name,
        reference=session.robot_reference,
        folder=folder,
        sha256=robot.sha256,
        legs=tuple((name, leg.length) for name, leg in robot.legs.items()),
        travel=tuple((d.name, d.unit, _bound(d.lower), _bound(d.upper)) for d in robot.drives),
    )


def _session_record(session: Session) -> SessionRecord:
    offsets = session.controller_offsets
    return SessionRecord(
        path=None if session.path is None else str(session.path),
        readings_path=None if session.readings_path is None else str(session.readings_path),
        title=session.title,
        source=session.source,
        sha256=session.sha256,
        gauge_sigma=session.gauge.sigma,
        gauge_resolution=session.gauge.resolution,
        controller_offsets=None if offsets is None else tuple(offsets.tolist()),
        parts=tuple(_session_record(part) for part in session.parts),
    )


def _residual_rows(
    fit: Fit, diagnostics: Diagnostics, nominal_theta: Array | None
) -> tuple[ResidualRow, ...]:
    """Readings beside what three machines would show, each with its best gauge zeros."""
    problem, o = fit.problem, fit.problem.observations
    measured, session, noise = problem.values, problem.session, problem.noise[o.plus]

    def fitted(prediction: Array) -> Array:
        residual = project_out_zeros(measured - prediction, o, weights=fit.weights)
        return session.values - noise * o.rows(residual)

    reference = problem.reference if nominal_theta is None else nominal_theta
    nominal = fitted(problem.predict(reference))
    try:
        by_linear = fitted(problem.predict(fit.linear))
    except ClosureError:  # the linearised machine cannot be assembled
        by_linear = np.full(len(session.readings), np.nan)
    predicted = session.values - noise * o.rows(fit.residual)
    unseen = noise * predict_unseen(fit)
    return tuple(
        ResidualRow(
            setup=r.setup,
            posture=r.posture,
            minus=r.minus,
            cycle=r.cycle,
            measured=r.value,
            nominal=float(nominal[i]),
            linear=float(by_linear[i]),
            predicted=float(predicted[i]),
            line=r.line,
            file=None if r.file is None else str(r.file),
            studentised=float(diagnostics.studentised[i]),
            influence=float(diagnostics.influence[i]),
            influenced=problem.free[diagnostics.influenced[i]],
            unseen=float(unseen[i]),
        )
        for i, r in enumerate(session.readings)
    )


def _gauge_records(fit: Fit) -> tuple[GaugeRecord, ...]:
    problem = fit.problem
    return tuple(
        GaugeRecord(
            name=g.name,
            sigma=g.gauge.sigma,
            resolution=g.gauge.resolution,
            noise=fit.noise.sigma * float(problem.noise[g.entries][0]),
            readings=int(g.entries.sum()),
        )
        for g in split_by_gauge(problem.session, problem.observations)
    )


def _setup_records(fit: Fit) -> tuple[SetupRecord, ...]:
    o = fit.problem.observations
    noise = np.ones(o.n_zeros)
    noise[o.zero] = fit.problem.noise
    zeros = {
        name: float(fit.solution.zeros[i] * noise[i])
        for i, (name, real) in enumerate(zip(o.zero_setup, o.zero_real, strict=True))
        if real
    }
    return tuple(
        SetupRecord(s.name, s.sensor, zeros.get(s.name))
        for s in fit.problem.session.setups.values()
    )
