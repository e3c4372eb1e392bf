"""A plan: which setups to take, in which postures to read them, and what that will be worth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from orthocal.assessment.remaining_errors import RemainingError, rank_errors
from orthocal.errors import ParameterError
from orthocal.estimation.choice import Choice, choose
from orthocal.estimation.problem import CalibrationProblem
from orthocal.kinematics.workspace import Workspace
from orthocal.measurement.joining import join_sessions
from orthocal.planning.candidates import (
    FEWEST,
    Candidates,
    distance_beside,
    list_candidates,
    measure_candidates,
    replace_beside,
)
from orthocal.planning.equipment import Means
from orthocal.planning.expected_error import (
    VAGUE,
    Criterion,
    Expected,
    ToolForecast,
    noise_of,
    state_noise,
)
from orthocal.planning.marginal_gain import (
    HOUR,
    Stage,
    add_rest,
    find_curve,
    find_enough,
    order_by_worth,
)
from orthocal.planning.ordering import order_postures
from orthocal.planning.plan_comparison import Alternative, list_alternatives, list_usual_plans
from orthocal.planning.selection import (
    KILLED,
    Chosen,
    Opened,
    Weigh,
    choose_setups,
    error_left,
    information_of,
)
from orthocal.robot.model import Robot
from orthocal.runtime.worker_pool import call_on_cores, lent, run_on_cores
from orthocal.session.session import Posture, Purpose, Reading, Session, Setup
from orthocal.statistics.zeros import project_out_zeros
from orthocal.units import UM

Array = NDArray[np.float64]

READINGS_A_SETUP = (3, 5, 9, 16)
"""What is tried where hours are given instead of numbers."""

MOST_SETUPS = 40

SIMPLER = 3e-2
"""Part of the error that may be lost in all for tips that stand on the crests of their rods."""

TOLD = 1e-3
"""Part of the error by which a start must better it to be told."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuringPlan:
    """Which readings to take, in the order of measuring, and what they will be worth."""

    session: Session
    """Setups, postures and readings; each setup ends where it began. Readings are 0."""
    forecast: ToolForecast
    criterion: Criterion
    minutes: float
    known: Expected
    """What is unknown before: of the machine's tolerances, or beside what was measured."""
    expected: Expected
    """What is unknown after, with offsets that are near what the controller corrects."""
    first_round: Expected
    """The same with offsets anywhere within their tolerances."""
    compared: tuple[Alternative, ...]
    """Usual plans at equal cost."""
    helps: tuple[Alternative, ...]
    """The same readings with other means."""
    curve: tuple[Stage, ...]
    """What is left after each setup, and after more of them."""
    means: Means
    candidates: int
    """Readings that were chosen from."""

    def find_remaining(self, *, count: int = 3) -> tuple[RemainingError, ...]:
        """The combinations of errors that matter most at the tool after these readings."""
        forecast = self.forecast
        return rank_errors(
            forecast.align(forecast.jacobian),
            self.expected.covariance,
            weights=forecast.workspace.weights,
            tolerances=self.expected.tolerances,
            names=self.expected.names,
            count=count,
        )

    @property
    def enough(self) -> Stage | None:
        """From when on another hour takes less than 5 % off; None where it goes on doing so."""
        return find_enough(self.curve)


def plan_readings(
    robot: Robot,
    choice: Choice | str | None = None,
    *,
    setups: int | None = None,
    readings: int | None = None,
    hours: float | None = None,
    means: Means | None = None,
    measured: Session | None = None,
    workspace: Workspace | None = None,
    criterion: Criterion = "aligned",
    seed: int = 0,
    starts: int | None = None,
    reference: str = "",
    workers: int = 1,
    report: Callable[[str], None] | None = None,
) -> MeasuringPlan:
    """Choose setups and readings that leave the least unknown at the tool.

    Args:
        robot: The robot.
        choice: What will be identified, or the name of a model; by default what the session that
            was measured is for, or `full`. The plan says it in its file.
        setups: How many to take; by default 6, or what `hours` allow.
        readings: In all of them together, at least 2 a setup; by default 3 a setup, or what `hours`
            allow. Each setup's first posture is read again at its end, on top of these.
        hours: How long one has; not with numbers.
        means: What one has to measure with.
        measured: Readings that there are already: the plan comes on top of them.
        workspace: Where the tool's error counts; by default the largest cube that is reached.
        criterion: What is made small.
        seed: Of random starts; the same plan comes from the same seed.
        starts: How often the search begins anew; by default 3 times, or more for a small choice.
        reference: How the session names the robot; its name by default.
        workers: Processes; the same plan comes from any number of them.
        report: Told how the search goes on.

    Raises:
        ParameterError: If numbers do not fit each other, or nothing can be chosen from.
        RobotError: If the drives do not command a tool.
        SessionError: If nothing tells the noise of the readings that there are.
    """
    measured = None if measured is None else state_noise(measured)
    means = means or Means()
    chosen = choose(choice, measured, usual="full")
    robot = (robot if measured is None else measured.robot).with_tolerances(chosen.tolerances)
    measured = None if measured is None else measured.with_tolerances(chosen.tolerances)
    forecast = ToolForecast(robot, chosen.select(robot.parameters), workspace)
    session = list_candidates(robot, means, reference=reference)
    candidates = measure_candidates(
        session, forecast.problem(session), spare_range=means.spare_range
    )
    prior = _prior(candidates, forecast, measured)
    weigh = forecast.weigh(criterion, len(candidates.state))
    counts = _counts(
        setups,
        readings,
        hours,
        means,
        _Trials(candidates.bare, prior, weigh, seed, workers),
    )

    in_metres, least = criterion not in ("A", "D", "E"), math.inf

    def told(start: int, left: float) -> None:
        nonlocal least
        if report is not None and left < (1.0 - TOLD) * least:
            least = left
            size = f"{left / UM:.4g} µm" if in_metres else f"{left:.4g}"
            report(f"start {start}: {size}")

    found = choose_setups(
        candidates,
        counts,
        prior=prior,
        weigh=weigh,
        seed=seed,
        starts=starts,
        workers=workers,
        report=told,
    )
    found = _simplify(candidates, found, weigh)
    found = replace(found, setups=order_by_worth(candidates, found, prior, weigh))
    plan = build_session(candidates, found.setups, measured)
    plan = replace(plan, purpose=Purpose(chosen.model, tuple(chosen.free)))
    whole = plan if measured is None else join_sessions([measured, plan])
    calls = (
        lambda: find_curve(candidates, found, counts, means, prior, weigh),
        lambda: list_alternatives(plan, means, forecast, measured),
        lambda: list_usual_plans(candidates, plan, means, forecast, measured),
        lambda: forecast.after(whole),
        lambda: forecast.after(whole, entered=False),
        lambda: forecast.about_nominal(whole),
        lambda: forecast.before if measured is None else forecast.after(measured),
    )
    with lent(workers):
        found_out = call_on_cores(calls, killed=KILLED)
    curve, helps, compared, expected, first_round, here, known = found_out
    return MeasuringPlan(
        session=plan,
        forecast=forecast,
        criterion=criterion,
        minutes=means.minutes(len(plan.setups), len(plan.readings)),
        known=known,
        expected=expected,
        first_round=first_round,
        compared=compared,
        helps=helps,
        curve=add_rest(curve, len(found.setups), expected, here, criterion),
        means=means,
        candidates=len(candidates.session.readings),
    )


def build_session(
    candidates: Candidates, chosen: Sequence[Opened], measured: Session | None = None
) -> Session:
    """The session of setups that were chosen: named, in the order of measuring.

    Each setup begins where its gauge is set, goes on with little movement, and ends where it began.
    """
    source = candidates.session
    taken = set() if measured is None else set(measured.setups)
    setups: dict[str, Setup] = {}
    readings: list[Reading] = []
    used: dict[str, Posture] = {}
    legs = list(source.robot.legs)

    def place(opened: Opened) -> tuple[int, str]:
        sensor = source.setups[candidates.kinds[opened.kind].name].sensor
        leg = sensor.place[1]
        return (legs.index(leg) if leg in legs else len(legs), candidates.kinds[opened.kind].name)

    for opened in sorted(chosen, key=place):
        kind = candidates.kinds[opened.kind]
        old = source.setups[kind.name]
        name = _setup_name(kind.name, {*taken, *setups})
        rows = [source.readings[i] for i in kind.rows[list(opened.chosen)]]
        points = np.array([source.postures[r.posture].values for r in rows])
        order = order_postures(points)
        setups[name] = replace(old, name=name)
        readings += [replace(rows[i], setup=name) for i in order]
        readings.append(replace(rows[0], setup=name, cycle=2))
        used.update((r.posture, source.postures[r.posture]) for r in rows)
    plan = replace(
        source,
        title="Planned readings",
        setups=setups,
        readings=tuple(readings),
        postures={n: p for n, p in source.postures.items() if n in used},
    )
    if measured is None or measured.controller_offsets is None:
        return plan
    return plan.with_controller(measured.controller_offsets)


def _setup_name(kind: str, taken: set[str]) -> str:
    """A short name for a setup: direction and leg, with a number where there are several."""
    short = kind.partition("_")[0]
    if short not in taken:
        return short
    return next(f"{short}_{i}" for i in range(2, len(taken) + 3) if f"{short}_{i}" not in taken)


def _prior(candidates: Candidates, forecast: ToolForecast, measured: Session | None) -> Array:
    """What is known of the state before: its tolerances, and what was measured."""
    problem = candidates.problem
    index = [problem.free.index(name) for name in candidates.state]
    prior = np.diag(np.maximum(problem.prior_precision[index], VAGUE))
    if measured is None:
        return np.asarray(prior)
    return np.asarray(prior + _said(forecast.problem(measured), candidates.state, measured))


def _said(problem: CalibrationProblem, state: Sequence[str], measured: Session) -> Array:
    """What a session says of the state, all else that it does not know taken out."""
    _, jacobian = problem.linearise(problem.reference)
    slopes = project_out_zeros(jacobian, problem.observations)
    whole = slopes.T @ slopes / noise_of(measured) ** 2
    rest = [i for i, name in enumerate(problem.free) if name not in state]
    own = [problem.free.index(name) for name in state if name in problem.free]
    where = [i for i, name in enumerate(state) if name in problem.free]
    inner = whole[np.ix_(rest, rest)] + np.diag(np.maximum(problem.prior_precision[rest], VAGUE))
    cross = whole[np.ix_(own, rest)]
    told = whole[np.ix_(own, own)]
    if rest:
        told = told - cross @ np.linalg.solve(inner, cross.T)
    result = np.zeros((len(state), len(state)))
    result[np.ix_(where, where)] = told
    return result


def _counts(
    setups: int | None,
    readings: int | None,
    hours: float | None,
    means: Means,
    trials: _Trials,
) -> list[int]:
    """Readings of each setup."""
    if hours is not None:
        if setups is not None or readings is not None:
            raise ParameterError("found with --setups or --readings; expected one", where="--hours")
        options = []
        for each in READINGS_A_SETUP:
            count = int(hours * HOUR / means.minutes(1, each + 1))
            if 1 <= count <= MOST_SETUPS:
                options.append([each] * count)
        if not options:
            least = means.minutes(1, READINGS_A_SETUP[0] + 1) / HOUR
            raise ParameterError(
                f"found {hours:g}; expected at least {least:.2g}, a setup of "
                f"{READINGS_A_SETUP[0]} readings, and at most {MOST_SETUPS} setups",
                where="--hours",
            )
        return trials.best(options)
    count = 6 if setups is None else setups
    total = 3 * count if readings is None else readings
    if not 1 <= count <= MOST_SETUPS:
        raise ParameterError(f"found {count}; expected 1 to {MOST_SETUPS}", where="--setups")
    if total < FEWEST * count:
        raise ParameterError(
            f"found {total}; expected at least {FEWEST * count}, {FEWEST} for each of {count} "
            "setups: one alone says nothing beside its gauge's zero",
            where="--readings",
        )
    return [total // count + (i < total % count) for i in range(count)]


@dataclass(frozen=True, slots=True, eq=False)
class _Trials:
    """Quick plans."""

    candidates: Candidates
    prior: Array
    weigh: Weigh
    seed: int
    workers: int

    def best(self, options: Sequence[list[int]]) -> list[int]:
        """The numbers of readings of each setup that leave least."""
        work = partial(self.left, options)
        left = dict(run_on_cores(work, range(len(options)), self.workers, killed=KILLED))
        return options[min(range(len(options)), key=left.__getitem__)]

    def left(self, options: Sequence[list[int]], which: int) -> float:
        """What a plan with so many readings leaves; infinite where none can be."""
        with suppress(ParameterError):
            return choose_setups(
                self.candidates,
                options[which],
                prior=self.prior,
                weigh=self.weigh,
                seed=self.seed,
                starts=1,
            ).left
        return math.inf


def _simplify(candidates: Candidates, found: Chosen, weigh: Weigh) -> Chosen:
    """The same readings with tips nearer to where rods lie in the zero, where that costs little."""
    session, kinds = candidates.session, candidates.kinds

    def beside(kind: int) -> float:
        return distance_beside(session.setups[kinds[kind].name].sensor)

    most = (1.0 + SIMPLER) * found.left
    for k, old in enumerate(found.setups):
        postures = [session.readings[i].posture for i in kinds[old.kind].rows[list(old.chosen)]]
        base = replace_beside(session.setups[kinds[old.kind].name].sensor)
        others = found.information - information_of(candidates, [old])
        for which in sorted(range(len(kinds)), key=beside):
            if beside(which) >= beside(old.kind):
                break
            if replace_beside(session.setups[kinds[which].name].sensor) != base:
                continue
            rows = {session.readings[r].posture: i for i, r in enumerate(kinds[which].rows)}
            if not set(postures) <= set(rows):
                continue
            new = Opened(which, tuple(rows[p] for p in postures))
            if not kinds[which].together[new.chosen[0], list(new.chosen)].all():
                continue
            information = others + information_of(candidates, [new])
            left = error_left(information, weigh)
            if left <= most:
                setups = (*found.setups[:k], new, *found.setups[k + 1 :])
                found = Chosen(setups, information, left)
                break
    return found
