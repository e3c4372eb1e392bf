"""Measuring plan: the setups, their postures, and the expected tool error after the calibration."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from orthocal.assessment.effect_limits import EffectLimits, find_limits
from orthocal.assessment.remaining_errors import RemainingError, rank_errors
from orthocal.effects.loading import robot_effects, with_effects
from orthocal.errors import ParameterError
from orthocal.estimation.choice import Choice, resolve_choice
from orthocal.kinematics.workspace import Workspace
from orthocal.measurement.motion.approach import usual_approaches
from orthocal.planning.candidates import (
    FEWEST,
    Candidates,
    indicator_of,
    list_candidates,
    measure_candidates,
)
from orthocal.planning.cost_curve import (
    HOUR,
    MOST_SETUPS,
    Stage,
    compute_curve,
    find_enough,
    find_scale,
    scale_curve,
)
from orthocal.planning.equipment import Equipment
from orthocal.planning.expected_error import (
    Criterion,
    Expected,
    ToolForecast,
    noise_of,
    state_noise,
)
from orthocal.planning.further_readings import FurtherReadings, find_further_readings
from orthocal.planning.plan_comparison import Alternative, Comparison
from orthocal.planning.planned_session import build_session
from orthocal.planning.ranking import best_of
from orthocal.planning.selection import KILLED, PlannedSetup, PlannedSetups, SetupSearch
from orthocal.planning.sensor_gains import SensorGain, find_sensor_gains
from orthocal.planning.timed_search import TimedSearch
from orthocal.robot.model import Robot
from orthocal.runtime.worker_pool import call_in_parallel, run_in_parallel, worker_budget
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.session.session import Purpose, Session

MODEL = "full"
"""Model that a plan identifies by default: the complete machine with priors."""

READINGS_A_SETUP = (3, 5, 9, 16)
"""Numbers of readings of a setup that are tried for a given time."""

USUAL_SETUPS = 6

GOAL = 0.4
"""Limit of backlash after a plan, in its limit before, that plans reach if they can: the tool may
be used from both sides, or the controller compensates backlash."""

EMPHASIS = 3.0
"""Factor of tool errors from backlash in the search for a plan that reaches the goal."""

MORE_FOR_APPROACH = 2 / 3
"""Further readings of a setup where each posture can be approached from either side."""

SIMPLER = 3e-2
"""Relative increase of the error, in total, for tips on the crests of their rods."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuringPlan:
    """Readings in the order of measuring, and the expected tool error after the calibration."""

    session: Session
    """Setups, postures and readings; each setup ends with its first posture. Readings are 0."""
    forecast: ToolForecast
    criterion: Criterion
    minutes: float
    known: Expected
    """Expected error before: from the priors of the machine; of a session, after its readings."""
    expected: Expected
    """Expected error after, with offsets that are near those that the controller corrects; with
    readings of a session without active offsets, with offsets anywhere within tolerances."""
    first_round: Expected
    """The same with offsets anywhere within their tolerances."""
    compared: tuple[Alternative, ...]
    """Usual plans at equal cost."""
    helps: tuple[Alternative, ...]
    """The same readings by other gauges."""
    stage: Stage
    """This plan, without the readings that close its setups."""
    curve: tuple[Stage, ...]
    """Expected error with setups added one after the other."""
    equipment: Equipment
    candidates: int
    """Number of candidate readings."""
    complements: bool
    """Whether the readings complement those of a session."""
    effects: tuple[EffectLimits, ...] = ()
    """Limits of the effects beside geometry, before and after."""
    further: tuple[FurtherReadings, ...] = ()
    """Readings for the effects that this plan does not determine."""
    complete: Session | None = None
    """The readings with those that they complement, in the course of a day."""

    def find_sensor_gains(self) -> tuple[SensorGain, ...]:
        """Gains of an hour with each usual sensor after these readings, the largest first."""
        session = self.session if self.complete is None else self.complete
        return find_sensor_gains(self.forecast, session, self.expected)

    def find_remaining(self, *, count: int = 3) -> tuple[RemainingError, ...]:
        """Combinations of errors with the largest effect at the tool after these readings."""
        forecast = self.forecast
        return rank_errors(
            forecast.align(forecast.jacobian),
            self.expected.covariance,
            weights=forecast.workspace.weights,
            prior_stds=self.expected.prior_stds,
            names=self.expected.names,
            count=count,
        )

    @property
    def better_usual_plans(self) -> list[tuple[float, tuple[PlannedSetup, ...]]]:
        """Smaller expected errors of usual plans of equal cost, with their setups.

        The search minimises the error about the nominal machine, and prefers simple setups.
        """
        errors = [
            (usual.expected.rms_by(self.criterion), usual.planned)
            for usual in self.compared
            if usual.expected is not None
        ]
        return [better for better in errors if better[0] < self.expected.rms_by(self.criterion)]

    @property
    def enough(self) -> Stage | None:
        """Stage after which another hour gains less than 5 %; None if there is none."""
        return find_enough(self.curve)


def plan_readings(
    robot: Robot,
    choice: Choice | str | None = None,
    *,
    setups: int | None = None,
    readings: int | None = None,
    hours: float | None = None,
    equipment: Equipment | None = None,
    measured: Session | None = None,
    workspace: Workspace | None = None,
    criterion: Criterion = "aligned",
    seed: int = 0,
    starts: int | None = None,
    reference: str = "",
    workers: int = 1,
    report: Callable[[str], None] | None = None,
) -> MeasuringPlan:
    """Choose the setups and readings with the smallest expected tool error.

    Args:
        robot: The robot.
        choice: Parameters to identify, or a model; by default as `measured` states, or "full".
        setups: Number of setups; by default 6, or as many as `hours` allow.
        readings: Number of readings, at least 2 per setup, beside the first postures that are read
            again; by default 3 per setup, and 4 more in six with backlash, or as `hours` allow.
        hours: Available time; not with numbers.
        equipment: Available gauge, tip and region.
        measured: Existing readings, which the plan complements.
        workspace: Region over which the tool error is computed; by default the robot's.
        criterion: Figure to minimise; see `planning.expected_error.Criterion`.
        seed: Seed of the random starts; the plan depends on nothing else that is random.
        starts: Number of starts of the search; by default 3, or more for few candidates.
        reference: Name of the robot in the session; by default its own.
        workers: Number of processes; the plan does not depend on it.
        report: Called with a line of text as the work proceeds.

    Raises:
        ParameterError: If numbers contradict each other, or there are no candidates.
        RobotError: If the drives do not command the tool.
        SessionError: If the repeatability of the existing readings is unknown.
    """
    work = _Work(criterion, seed, starts, workers, report or (lambda text: None))
    measured = None if measured is None else state_noise(measured)
    chosen = resolve_choice(choice, measured, default_model=MODEL)
    robot, measured = _with_choice(robot, measured, chosen)
    equipment = equipment or Equipment()
    counts: Sequence[list[int]] | float
    counts = options = _list_counts(setups, readings, hours, equipment, robot)
    if equipment.owned and setups is None and readings is None:
        counts = HOUR * hours if hours is not None else equipment.minutes(*_totals(options[0]))
    forecast = ToolForecast(robot, chosen.select(robot.parameters), workspace)
    session = list_candidates(robot, equipment, reference=reference)
    session = replace(session, purpose=Purpose(chosen.model, tuple(chosen.free)))
    return _plan(session, counts, forecast, equipment, measured, work)


def _totals(counts: Sequence[int]) -> tuple[int, int]:
    """Numbers of setups and of readings, with the closing ones."""
    return len(counts), sum(counts) + len(counts)


@dataclass(frozen=True, slots=True, eq=False)
class _Work:
    """Criterion and course of a search; fields as in `plan_readings`."""

    criterion: Criterion
    seed: int
    starts: int | None
    workers: int
    report: Callable[[str], None]


def _plan(
    session: Session,
    options: Sequence[list[int]] | float,
    forecast: ToolForecast,
    equipment: Equipment,
    measured: Session | None,
    work: _Work,
) -> MeasuringPlan:
    """Plan with the smallest expected error.

    Args:
        session: All candidate readings.
        options: Possible numbers of readings of each setup, or the available time, [min].
        forecast: Expected errors of the robot.
        equipment: Gauge, tip and region.
        measured: Existing readings.
        work: Criterion and course of the search.
    """
    work.report(f"computing {len(session.readings)} candidate readings")
    candidates = measure_candidates(
        session, forecast.problem(session), spare_range=equipment.spare_range
    )
    search = SetupSearch.of(
        candidates,
        forecast.prior_of(candidates.problem, candidates.state, measured),
        forecast.weigh(work.criterion, len(candidates.state)),
    )
    timed = TimedSearch(search, equipment.durations(session), equipment.once)
    planned = _search_setups(timed, candidates, options, work)

    def compare(planned: PlannedSetups) -> Comparison:
        plan = build_session(candidates, planned.setups, measured)
        return Comparison(candidates, plan, equipment, forecast, measured)

    work.report("comparing the plan with others")
    plan = _evaluate(timed, planned, compare(planned), work)
    better = min(plan.better_usual_plans, key=lambda usual: usual[0], default=None)
    if better is None:
        return plan
    work.report("searching from a usual plan, which is better")
    error, setups = better
    improved = search.improve(setups)
    expected = compare(improved).expect_plan()
    best = improved if expected.rms_by(work.criterion) < error else search.plan_of(setups)
    return _evaluate(timed, best, compare(best), work)


def _search_setups(
    timed: TimedSearch,
    candidates: Candidates,
    options: Sequence[list[int]] | float,
    work: _Work,
) -> PlannedSetups:
    """Setups with the smallest error for a time, or one of the possible numbers of readings."""
    search = timed.search

    def report(start: int, _: float) -> None:
        work.report(f"search {start} finished")

    if isinstance(options, float):
        work.report(f"choosing setups for {options:.0f} min")

        def choose(weighted: SetupSearch) -> PlannedSetups:
            within = replace(timed, search=weighted)
            return within.choose(options, starts=work.starts, workers=work.workers, report=report)
    else:
        counts = options[0]
        if len(options) > 1:
            counts = _choose_counts(search, work.seed, work.workers, options)
        work.report(f"choosing readings of {len(counts)} setup{'s' * (len(counts) > 1)}")

        def choose(weighted: SetupSearch) -> PlannedSetups:
            return weighted.choose(
                counts, seed=work.seed, starts=work.starts, workers=work.workers, report=report
            )

    sides = _find_sides(candidates, candidates.session.robot)
    planned = _choose_setups(search, sides, choose)
    return _simplify(candidates, planned, search, sides)


def _with_choice(
    robot: Robot, measured: Session | None, choice: Choice
) -> tuple[Robot, Session | None]:
    """Robot and measured session with the chosen effects and tolerances."""
    if measured is not None:
        measured = choice.applied_to(measured)
        return measured.robot, measured
    if choice.effects is not None:
        robot = with_effects(robot, choice.effects)
    return robot.with_tolerances(choice.tolerances), None


def _find_sides(candidates: Candidates, robot: Robot) -> list[int]:
    """Indices in the state of the parameters that depend on the side of approach."""
    names = {
        error.name
        for effect in robot_effects(robot)
        if "approach" in effect.conditions
        for error in effect.errors
    }
    return [i for i, name in enumerate(candidates.state) if name in names]


def _choose_setups(
    search: SetupSearch, sides: list[int], choose: Callable[[SetupSearch], PlannedSetups]
) -> PlannedSetups:
    """Setups with the smallest error that reach the goal for backlash, if any do.

    If those with the smallest error miss it, effects of the side of approach count more.

    Args:
        search: Search for the smallest error.
        sides: Indices of the parameters that depend on the side of approach.
        choose: Choose setups by a search.
    """
    first = choose(search)
    prior = np.asarray(np.linalg.inv(search.prior))
    root = search.weigh(prior)
    if search.weigh(prior) is not root or _is_reached(first, sides):
        return first
    emphasised = root.copy()
    emphasised[sides] *= EMPHASIS
    planned = choose(replace(search, weigh=lambda covariance: emphasised))
    if not _is_reached(planned, sides):
        return first
    return replace(planned, error=search.error_of(planned.information))


def _is_reached(planned: PlannedSetups, sides: list[int]) -> bool:
    """True if all limits, relative to those before, are within the goal."""
    variance = np.diag(np.linalg.inv(planned.information))[sides]
    return bool(np.sqrt(variance.max(initial=0.0)) <= GOAL)


def _evaluate(
    search: TimedSearch,
    planned: PlannedSetups,
    comparison: Comparison,
    work: _Work,
) -> MeasuringPlan:
    """Plan with its expected errors, and those of others."""
    plan, measured, forecast = comparison.plan, comparison.measured, comparison.forecast
    joined = comparison.join(comparison.equipment.in_course(plan))
    setups, readings = len(planned.setups), sum(len(s.chosen) for s in planned.setups)
    minutes = comparison.equipment.minutes_of(plan)
    each = None if comparison.equipment.owned else round(readings / setups)
    with worker_budget(work.workers):
        curve, helps, compared, expected, first_round, nominal, known, limits = call_in_parallel(
            (
                lambda: compute_curve(search, each, setups),
                comparison.list_alternatives,
                comparison.list_usual_plans,
                comparison.expect_plan,
                lambda: forecast.after(joined, entered=False),
                lambda: forecast.about_nominal(joined),
                lambda: (
                    forecast.before
                    if measured is None
                    else forecast.after(measured, entered=comparison.entered)
                ),
                lambda: find_limits(forecast.problem(joined), noise_of(joined)),
            ),
            killed=KILLED,
        )
    stage = Stage(setups, readings, minutes, planned.error)
    factor, remainder = find_scale(stage.error, expected, nominal, work.criterion)
    return MeasuringPlan(
        session=plan,
        forecast=forecast,
        criterion=work.criterion,
        minutes=minutes,
        known=known,
        expected=expected,
        first_round=first_round,
        compared=compared,
        helps=helps,
        stage=scale_curve([stage], factor, remainder)[0],
        curve=scale_curve(curve, factor, remainder),
        equipment=comparison.equipment,
        candidates=len(comparison.candidates.session.readings),
        complements=measured is not None,
        effects=limits,
        further=find_further_readings(comparison, limits),
        complete=joined,
    )


def _list_counts(
    setups: int | None,
    readings: int | None,
    hours: float | None,
    equipment: Equipment,
    robot: Robot,
) -> list[list[int]]:
    """Possible numbers of readings of each setup; arguments as for `plan_readings`."""
    if hours is not None:
        if setups is not None or readings is not None:
            raise ParameterError("found with --setups or --readings; expected one", where="--hours")
        options = []
        for most in READINGS_A_SETUP:
            count = int(hours * HOUR / equipment.minutes(1, most + 1))
            if 1 <= count <= MOST_SETUPS:
                options.append([most] * count)
        if not options and not equipment.owned:
            least = equipment.minutes(1, READINGS_A_SETUP[0] + 1) / HOUR
            raise ParameterError(
                f"found {hours:g}; expected at least {least:.2g}, a setup of "
                f"{READINGS_A_SETUP[0]} readings, and at most {MOST_SETUPS} setups",
                where="--hours",
            )
        return options
    count = USUAL_SETUPS if setups is None else setups
    each = READINGS_A_SETUP[0] + (MORE_FOR_APPROACH if usual_approaches(robot) else 0.0)
    total = math.ceil(each * count - 1e-9) if readings is None else readings
    if not 1 <= count <= MOST_SETUPS:
        raise ParameterError(f"found {count}; expected 1 to {MOST_SETUPS}", where="--setups")
    if total < FEWEST * count:
        raise ParameterError(
            f"found {total}; expected at least {FEWEST * count}, {FEWEST} for each of {count} "
            "setups: the first one only determines the gauge zero",
            where="--readings",
        )
    return [[total // count + (i < total % count) for i in range(count)]]


def _choose_counts(
    search: SetupSearch, seed: int, workers: int, options: Sequence[list[int]]
) -> list[int]:
    """Numbers of readings of each setup with the smallest error after one start."""
    work = partial(_quick_error, search, seed, options)
    errors = dict(run_in_parallel(work, range(len(options)), workers, killed=KILLED))
    return options[best_of(range(len(options)), lambda i: -errors[i])]


def _quick_error(search: SetupSearch, seed: int, options: Sequence[list[int]], which: int) -> float:
    """Error after one start; infinite where there is no plan."""
    with suppress(ParameterError):
        return search.choose(options[which], seed=seed, starts=1).error
    return math.inf


def _simplify(
    candidates: Candidates, planned: PlannedSetups, search: SetupSearch, sides: list[int]
) -> PlannedSetups:
    """Plan with tips nearer to the rods in the mechanical zero, at little cost.

    A goal for the parameters that depend on the side of approach stays reached.
    """
    session, setups = candidates.session, candidates.setups

    indicators = {
        which: sensor
        for which, setup in enumerate(setups)
        if (sensor := indicator_of(session.setups[setup.name])) is not None
    }

    def distance(which: int) -> float:
        return float(np.linalg.norm(indicators[which].beside))

    def without_lateral(which: int) -> LegIndicator:
        return replace(indicators[which], beside=(0.0, 0.0, 0.0))

    most, reached = (1.0 + SIMPLER) * planned.error, _is_reached(planned, sides)
    for k, old in enumerate(planned.setups):
        if old.candidate not in indicators:
            continue
        candidate = setups[old.candidate]
        postures = [session.readings[i].place[1:] for i in candidate.rows[list(old.chosen)]]
        base = without_lateral(old.candidate)
        others = planned.information - search.information_of(old)
        for which in sorted(indicators, key=distance):
            if distance(which) >= distance(old.candidate):
                break
            if without_lateral(which) != base:
                continue
            rows = {session.readings[r].place[1:]: i for i, r in enumerate(setups[which].rows)}
            if not set(postures) <= set(rows):
                continue
            new = PlannedSetup(which, tuple(rows[p] for p in postures))
            if not setups[which].reachable[new.chosen[0], list(new.chosen)].all():
                continue
            information = others + search.information_of(new)
            error = search.error_of(information)
            setups_now = (*planned.setups[:k], new, *planned.setups[k + 1 :])
            changed = PlannedSetups(setups_now, information, error)
            if error <= most and (_is_reached(changed, sides) or not reached):
                planned = changed
                break
    return planned
