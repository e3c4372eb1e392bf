"""Measuring plan: the setups, their postures, and the expected tool error after the calibration."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from types import NoneType

import numpy as np

from orthocal.arguments import require_kind, require_seed
from orthocal.assessment.effect_limits import EffectLimits
from orthocal.assessment.remaining_errors import RemainingError, rank_errors
from orthocal.effects.loading import robot_effects, with_effects
from orthocal.errors import ParameterError
from orthocal.estimation.choice import Choice, resolve_choice
from orthocal.kinematics.workspace import Workspace
from orthocal.measurement.motion.approach import usual_approaches
from orthocal.planning.candidates import (
    MIN_READINGS,
    Candidates,
    list_candidates,
    measure_candidates,
)
from orthocal.planning.cost_curve import (
    HOUR,
    Stage,
    compute_curve,
    find_enough,
    find_scale,
    scale_curve,
)
from orthocal.planning.equipment import Equipment, indicators
from orthocal.planning.expected_error import (
    CRITERIA,
    Criterion,
    Expected,
    ToolForecast,
    state_noise,
)
from orthocal.planning.further_readings import FurtherReadings, find_further_readings
from orthocal.planning.owned_sensors import SLACK
from orthocal.planning.plan_comparison import Alternative, Comparison
from orthocal.planning.planned_session import build_session
from orthocal.planning.ranking import best_of, is_less
from orthocal.planning.selection import KILLED, PlannedSetup, PlannedSetups, SetupSearch
from orthocal.planning.sensor_gains import SensorGain, find_sensor_gains
from orthocal.planning.timed_search import MAX_SETUPS, TimedSearch
from orthocal.robot.model import Robot
from orthocal.runtime.worker_pool import call_in_parallel, run_in_parallel, worker_budget
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.session.points import names_in_files
from orthocal.session.session import Purpose, Session

MODEL = "full"
"""Model that a plan identifies by default: the complete machine with priors."""

READINGS_PER_SETUP = (3, 5, 9, 16)
"""Possible numbers of readings of a setup in a plan for a given time."""

USUAL_SETUPS = 6
"""Default number of setups."""

APPROACH_GOAL = 0.4
"""Largest remaining part of the uncertainty of backlash that a plan aims for. Then the tool can be
used from both sides, or the controller compensates backlash."""

APPROACH_EMPHASIS = 3.0
"""Factor of tool errors from backlash in a second search, for a plan that reaches the goal."""

EXTRA_FOR_APPROACH = 2 / 3
"""Additional readings per setup if postures can be approached from either side."""

SIMPLICITY_TOLERANCE = 3e-2
"""Accepted relative increase of the error, in total, for tips nearer to their rods' crests."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuringPlan:
    """Readings in the order of measuring, and the expected tool error after the calibration."""

    session: Session
    """Setups, postures and readings with value 0; each setup ends with its first posture."""
    forecast: ToolForecast
    criterion: Criterion
    minutes: float
    before: Expected
    """Expected error before: from the priors of the machine, or after the readings of a session."""
    expected: Expected
    """Expected error after the plan, with small offsets because the controller corrects them. If
    the complemented session has no active offsets, they are drawn from their priors."""
    first_round: Expected
    """Expected error after the plan, with offsets drawn from their priors."""
    usual_plans: tuple[Alternative, ...]
    """Usual plans at equal cost."""
    other_gauges: tuple[Alternative, ...]
    """This plan with other gauges."""
    stage: Stage
    """This plan as a point of the curve."""
    curve: tuple[Stage, ...]
    """Expected error after each of several setups that are added one by one."""
    equipment: Equipment
    candidates: int
    """Number of candidate readings."""
    complements_session: bool
    """Whether the readings complement those of a session."""
    effects: tuple[EffectLimits, ...]
    """Limits of the effects beside geometry, before and after the plan."""
    further: tuple[FurtherReadings, ...]
    """Further readings for the effects that this plan does not determine."""
    all_readings: Session
    """Planned readings with expected times and temperatures, joined with the existing readings."""
    unusable: Mapping[str, float]
    """Gauges that the plan cannot use, with the range to either side that they would need, [m]."""
    unchosen: Mapping[str, float]
    """Stated gauges that could be used but are not in the plan, mapped to the range to either side
    that their readings need, [m]; to 0 if they are within their range."""

    def find_sensor_gains(self) -> tuple[SensorGain, ...]:
        """Gains of an hour with each usual sensor after these readings, the largest first."""
        return find_sensor_gains(self.forecast, self.all_readings, self.expected)

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
        """Usual plans of equal cost with a smaller expected error: the errors and the setups.

        They exist because the search minimises the error about the nominal machine and prefers
        simple setups.
        """
        usual_plans = [
            (usual.expected.rms_by(self.criterion), usual.planned)
            for usual in self.usual_plans
            if usual.expected is not None
        ]
        error = self.expected.rms_by(self.criterion)
        return [plan for plan in usual_plans if is_less(plan[0], error)]

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
        setups: Number of setups; by default 6, or the number that `hours` allow.
        readings: Number of readings without the closing ones, at least 2 per setup. By default 3
            per setup, with backlash 2/3 more, or the number that `hours` allow.
        hours: Available time; excludes `setups` and `readings`.
        equipment: Available gauge, tip and region.
        measured: Existing readings, which the plan complements.
        workspace: Region over which the tool error is computed; by default the robot's.
        criterion: Figure to minimise about the nominal machine; see `expected_error.Criterion`.
            The errors that the plan states are means over machines within their tolerances.
        seed: Seed of the random starts of the search.
        starts: Number of starts of the search; by default 3, or more for few candidates.
        reference: Name of the robot in the session; by default that of the model.
        workers: Number of processes; the plan does not depend on it.
        report: Called with a line of text as the work proceeds.

    Raises:
        ParameterError: If numbers contradict each other, the criterion is unknown, or there are no
            candidate readings.
        RobotError: If the drives do not command the tool.
        SessionError: If the repeatability of the existing readings is unknown.
        TypeError: If an argument is of another kind.
    """
    _require_arguments(robot, measured, equipment, criterion, seed)
    options = _SearchOptions(criterion, seed, starts, workers, report or (lambda text: None))
    measured = None if measured is None else state_noise(measured)
    chosen = resolve_choice(choice, measured, default_model=MODEL)
    robot, measured = _with_choice(robot, measured, chosen)
    equipment = equipment or Equipment()
    counts_or_minutes = _counts_or_minutes(setups, readings, hours, equipment, robot)
    forecast = ToolForecast(robot, chosen.select(robot.parameters), workspace)
    session = list_candidates(robot, equipment, reference=reference)
    session = replace(session, purpose=Purpose(chosen.model, tuple(chosen.free)))
    return _plan(session, counts_or_minutes, forecast, equipment, measured, options)


def _require_arguments(
    robot: object, measured: object, equipment: object, criterion: str, seed: int
) -> None:
    """Refuse arguments of `plan_readings` of another kind, and an unknown criterion."""
    require_kind(robot, Robot, expected="a Robot, such as load_robot(...)")
    require_kind(measured, (Session, NoneType), expected="a Session, as load_session returns")
    require_kind(equipment, (Equipment, NoneType), expected="Equipment(...)")
    require_seed(seed)
    if criterion not in CRITERIA:
        raise ParameterError(
            f"found '{criterion}'; expected one of {', '.join(CRITERIA)}", where="criterion"
        )


@dataclass(frozen=True, slots=True, eq=False)
class _SearchOptions:
    """Criterion and options of a search; fields as in `plan_readings`."""

    criterion: Criterion
    seed: int
    starts: int | None
    workers: int
    report: Callable[[str], None]


def _plan(
    session: Session,
    counts_or_minutes: Sequence[list[int]] | float,
    forecast: ToolForecast,
    equipment: Equipment,
    measured: Session | None,
    options: _SearchOptions,
) -> MeasuringPlan:
    """Plan with the smallest expected error.

    Args:
        session: All candidate readings.
        counts_or_minutes: Lists of the numbers of readings of each setup, or the available time,
            [min].
        forecast: Expected errors of the robot.
        equipment: Gauge, tip and region.
        measured: Existing readings.
        options: Criterion and options of the search.
    """
    options.report(f"computing {len(session.readings)} candidate readings")
    candidates = measure_candidates(
        session,
        forecast.problem(session),
        spare_range=equipment.spare_range,
        entered=measured is not None and bool(np.any(measured.active_offsets)),
    )
    search = SetupSearch.of(
        candidates,
        forecast.prior_information(candidates.problem, candidates.state, measured),
        forecast.weight_of(options.criterion, len(candidates.state)),
    )
    timed = TimedSearch(search, equipment.durations(session), equipment.once)
    planned = _search_setups(timed, candidates, counts_or_minutes, options)

    def compare(planned: PlannedSetups) -> Comparison:
        plan = build_session(candidates, planned.setups, measured)
        return Comparison(candidates, plan, equipment, forecast, measured)

    options.report("comparing the plan with others")
    plan = _evaluate(timed, planned, compare(planned), options)
    better = min(plan.better_usual_plans, key=lambda usual: usual[0], default=None)
    if better is None:
        return plan
    options.report("searching from a usual plan, because it is better")
    error, setups = better
    if isinstance(counts_or_minutes, float):
        improved = timed.improve(setups, counts_or_minutes)
    else:
        improved = search.improve(setups)
    comparison = compare(improved)
    expected = comparison.expect(comparison.plan)
    if not is_less(expected.rms_by(options.criterion), error):
        improved = search.plan_of(setups)
        comparison = compare(improved)
    return _evaluate(timed, improved, comparison, options)


def _search_setups(
    timed: TimedSearch,
    candidates: Candidates,
    counts_or_minutes: Sequence[list[int]] | float,
    options: _SearchOptions,
) -> PlannedSetups:
    """Setups with the smallest error for a time, or one of the possible numbers of readings."""
    search = timed.search

    def report(start: int, _: float) -> None:
        options.report(f"search {start} finished")

    if isinstance(counts_or_minutes, float):
        options.report(f"choosing setups for {counts_or_minutes:.0f} min")

        def choose(weighted: SetupSearch) -> PlannedSetups:
            weighted_timed = replace(timed, search=weighted)
            return weighted_timed.choose(
                counts_or_minutes, starts=options.starts, workers=options.workers, report=report
            )
    else:
        counts, first = counts_or_minutes[0], None
        if len(counts_or_minutes) > 1:
            counts, first = _choose_counts(search, options.seed, options.workers, counts_or_minutes)
        options.report(f"choosing readings of {len(counts)} setup{'s' * (len(counts) > 1)}")

        def choose(weighted: SetupSearch) -> PlannedSetups:
            return weighted.choose(
                counts,
                seed=options.seed,
                starts=options.starts,
                workers=options.workers,
                report=report,
                first=first if weighted is search else None,
            )

    of_approach = _find_approach_parameters(candidates)
    planned = _choose_setups(search, of_approach, choose)
    return _simplify(candidates, planned, search, of_approach)


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


def _find_unchosen(comparison: Comparison) -> dict[str, float]:
    """Stated gauges that could be used but are not in the plan.

    Returns:
        Name to the range to either side that its readings need, if that exceeds its range, [m];
        otherwise to 0.
    """
    candidates = comparison.candidates
    planned = {names_in_files(s)[1] for s in comparison.plan.setups.values()}
    unchosen = {}
    for owned in comparison.equipment.owned:
        if owned.name in planned or owned.name in candidates.unusable:
            continue
        needed = candidates.needed.get(owned.name, 0.0)
        unchosen[owned.name] = needed if needed > owned.gauge.half_range else 0.0
    return unchosen


def _find_approach_parameters(candidates: Candidates) -> list[int]:
    """Indices in the state of the parameters of effects that depend on the approach."""
    names = {
        error.name
        for effect in robot_effects(candidates.session.robot)
        if "approach" in effect.conditions
        for error in effect.errors
    }
    return [i for i, name in enumerate(candidates.state) if name in names]


def _choose_setups(
    search: SetupSearch, of_approach: list[int], choose: Callable[[SetupSearch], PlannedSetups]
) -> PlannedSetups:
    """Setups with the smallest error that reach the goal for backlash, if any do.

    If the best setups miss the goal, a second search emphasises effects of the approach. This is
    possible only if the weight does not depend on the covariance.

    Args:
        search: Search for the smallest error.
        of_approach: Indices of the parameters that depend on the approach.
        choose: Function that chooses setups by a search.
    """
    first = choose(search)
    prior = np.asarray(np.linalg.inv(search.prior))
    root = search.weight(prior)
    if search.weight(prior) is not root or _is_reached(first, of_approach):
        return first
    emphasised = root.copy()
    emphasised[of_approach] *= APPROACH_EMPHASIS
    planned = choose(replace(search, weight=lambda covariance: emphasised))
    if not _is_reached(planned, of_approach):
        return first
    return replace(planned, error=search.error_of(planned.information))


def _is_reached(planned: PlannedSetups, of_approach: list[int]) -> bool:
    """True if the posterior standard deviations, in prior std, are within the goal."""
    variance = np.diag(np.linalg.inv(planned.information))[of_approach]
    return bool(np.sqrt(variance.max(initial=0.0)) <= APPROACH_GOAL)


def _evaluate(
    search: TimedSearch,
    planned: PlannedSetups,
    comparison: Comparison,
    options: _SearchOptions,
) -> MeasuringPlan:
    """Compute the expected errors of a plan and of its alternatives."""
    plan, measured, forecast = comparison.plan, comparison.measured, comparison.forecast
    joined = comparison.join(comparison.equipment.schedule(plan))
    setups, readings = len(planned.setups), sum(len(s.chosen) for s in planned.setups)
    minutes = comparison.equipment.minutes_of(plan)
    each = None if comparison.equipment.owned else round(readings / setups)
    with worker_budget(options.workers):
        curve, other_gauges, usual_plans, expected, first_round, nominal, before, limits = (
            call_in_parallel(
                (
                    lambda: compute_curve(search, each, setups),
                    comparison.list_alternatives,
                    comparison.list_usual_plans,
                    lambda: comparison.expect(plan),
                    lambda: forecast.after(joined, entered=False),
                    lambda: forecast.about_nominal(joined),
                    lambda: (
                        forecast.before
                        if measured is None
                        else forecast.after(measured, entered=comparison.entered)
                    ),
                    lambda: forecast.limits(joined),
                ),
                killed=KILLED,
            )
        )
    stage = Stage(setups, readings, minutes, planned.error)  # without the closing readings
    factor, constant = find_scale(stage.error, expected, nominal, options.criterion)
    return MeasuringPlan(
        session=plan,
        forecast=forecast,
        criterion=options.criterion,
        minutes=minutes,
        before=before,
        expected=expected,
        first_round=first_round,
        usual_plans=usual_plans,
        other_gauges=other_gauges,
        stage=scale_curve([stage], factor, constant)[0],
        curve=scale_curve(curve, factor, constant),
        equipment=comparison.equipment,
        candidates=len(comparison.candidates.session.readings),
        complements_session=measured is not None,
        effects=limits,
        further=find_further_readings(comparison, limits),
        all_readings=joined,
        unusable=comparison.candidates.unusable,
        unchosen=_find_unchosen(comparison),
    )


def _counts_or_minutes(
    setups: int | None,
    readings: int | None,
    hours: float | None,
    equipment: Equipment,
    robot: Robot,
) -> Sequence[list[int]] | float:
    """Possible lists of the numbers of readings of each setup, or the available time, [min].

    Setups of several sensors share a time unless their number is stated. The arguments are those of
    `plan_readings`.
    """
    if hours is not None:
        if setups is not None or readings is not None:
            raise ParameterError(
                "found together with setups or readings; state hours, or setups and readings",
                where="hours",
            )
        if not 0.0 < hours < math.inf:
            raise ParameterError(f"found {hours:g}; expected a positive number", where="hours")
        if equipment.owned:
            return HOUR * hours
        counts = {
            each: int(hours * HOUR / max(equipment.minutes(1, each + 1), SLACK))
            for each in READINGS_PER_SETUP
        }
        options = [[each] * count for each, count in counts.items() if 1 <= count <= MAX_SETUPS]
        if not options:
            min_hours = equipment.minutes(1, READINGS_PER_SETUP[0] + 1) / HOUR
            raise ParameterError(
                f"found {hours:g}; expected at least {min_hours:.2g}, a setup of "
                f"{READINGS_PER_SETUP[0]} readings, and at most {MAX_SETUPS} setups",
                where="hours",
            )
        return options
    count = USUAL_SETUPS if setups is None else setups
    mean = READINGS_PER_SETUP[0] + (EXTRA_FOR_APPROACH if usual_approaches(robot) else 0.0)
    total = math.ceil(mean * count - 1e-9) if readings is None else readings
    if not 1 <= count <= MAX_SETUPS:
        raise ParameterError(f"found {count}; expected 1 to {MAX_SETUPS}", where="setups")
    if total < MIN_READINGS * count:
        raise ParameterError(
            f"found {total}; expected at least {MIN_READINGS * count}, {MIN_READINGS} for each of "
            f"{count} setups: a single reading only determines the gauge zero",
            where="readings",
        )
    if equipment.owned and setups is None and readings is None:
        return float(equipment.minutes(count, total + count))
    return [[total // count + (i < total % count) for i in range(count)]]


def _choose_counts(
    search: SetupSearch, seed: int, workers: int, options: Sequence[list[int]]
) -> tuple[list[int], PlannedSetups | None]:
    """Numbers of readings of each setup with the smallest error after one start, and its plan."""
    start = partial(_start, search, seed, options)
    plans = dict(run_in_parallel(start, range(len(options)), workers, killed=KILLED))
    errors = [math.inf if (plan := plans[i]) is None else plan.error for i in range(len(options))]
    best = best_of(range(len(options)), lambda i: -errors[i])
    return options[best], plans[best]


def _start(
    search: SetupSearch, seed: int, options: Sequence[list[int]], which: int
) -> PlannedSetups | None:
    """Plan after one start; None without a plan."""
    with suppress(ParameterError):
        return search.choose(options[which], seed=seed, starts=1)
    return None


def _simplify(
    candidates: Candidates, planned: PlannedSetups, search: SetupSearch, of_approach: list[int]
) -> PlannedSetups:
    """Place tips nearer to the rods in the mechanical zero if the error grows little.

    A goal that the plan reaches for the parameters of the approach is still reached.
    """
    session, setups = candidates.session, candidates.setups
    at_legs = indicators(session)
    sensors = {i: at_legs[s.name] for i, s in enumerate(setups) if s.name in at_legs}

    def distance(which: int) -> float:
        return float(np.linalg.norm(sensors[which].beside))

    def without_lateral(which: int) -> LegIndicator:
        return replace(sensors[which], beside=(0.0, 0.0, 0.0))

    max_error = (1.0 + SIMPLICITY_TOLERANCE) * planned.error
    reached = _is_reached(planned, of_approach)
    for k, old in enumerate(planned.setups):
        if old.candidate not in sensors:
            continue
        candidate = setups[old.candidate]
        postures = [session.readings[i].place[1:] for i in candidate.rows[list(old.chosen)]]
        base = without_lateral(old.candidate)
        others = planned.information - search.information_of(old)
        for which in sorted(sensors, key=distance):
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
            changed = search.exchanged(planned, k, new, others)
            if changed.error <= max_error and (_is_reached(changed, of_approach) or not reached):
                planned = changed
                break
    return planned
