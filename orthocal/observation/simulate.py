"""Simulated readings of a machine with known errors.

Sessions of simulated readings are always marked as such.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import yaml
from pydantic import Field

from orthocal.arguments import require_kind, require_names, require_numbers, require_seed
from orthocal.arrays import Array
from orthocal.effects.adjustment import (
    LARGEST_AMOUNT_MM,
    SUFFIX,
    require_adjustment,
    subtract_amounts,
)
from orthocal.errors import ParameterError, SessionError, errors_at
from orthocal.io.documents import Keys, Number, parse_number, read_yaml, validate
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import Observations, build_observations
from orthocal.observation.sensor_groups import OF_GAUGE, nuisance_parameters
from orthocal.robot.model import Robot
from orthocal.robot.parameters import Parameter, ParameterSet, split_assignment
from orthocal.robot.redundant import require_independent_rows
from orthocal.session.session import Gauge, Reading, Session
from orthocal.units import MM, to_mm

LARGEST_ZERO = 0.2e-3
"""Largest distance of the first reading of a setup from the middle of the range, [m]. The first
reading is uniformly distributed."""

SPARE_NOISE = 5.0
"""Distance that all readings keep from the ends of the range if possible, in standard deviations of
their noise. If necessary, the operator sets the dial to another value."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedSession:
    """Session of simulated readings, and the true values of all parameters."""

    session: Session
    """Session with the simulated readings."""
    errors: Mapping[str, float]
    """True values of the error parameters by name, [SI]; 0 where absent."""
    zeros: Mapping[str, float]
    """True gauge zeros by setup, [m]."""
    nuisance: Mapping[str, float] = field(default_factory=dict)
    """True values of the nuisance parameters by name, [SI]."""


def draw_errors(
    robot: Robot,
    patterns: Sequence[str],
    *,
    seed: int,
    tolerances: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Draw errors from their priors: independent, normal with mean 0, or half-normal.

    A tolerance is ±2 standard deviations, so that about one error in twenty exceeds it.

    Args:
        robot: The robot.
        patterns: Names or globs of the parameters to draw; '!' excludes. If a sum and its terms are
            selected, only the terms are drawn.
        seed: Seed of the random numbers; `simulate_session` with the same seed draws other numbers.
        tolerances: Names or globs with their unit, such as `*.offset_mm`, mapped to tolerances that
            replace those of the robot.

    Returns:
        Names of the parameters, mapped to values, [SI].

    Raises:
        ParameterError: If a pattern matches nothing, or a tolerance is not valid.
        TypeError: If an argument has a wrong type.
    """
    require_kind(robot, Robot, expected="a Robot, such as load_robot(...)")
    patterns = require_names(patterns, argument="patterns")
    require_seed(seed)
    # a spawned stream is independent of those of noise (seed), of nuisance parameters (seed, 1)
    # and of studies (seed, number)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))
    parameters = robot.parameters.with_tolerances(tolerances or {})
    chosen = parameters.without_sums(parameters.select(patterns))
    drawn = {n: float(rng.normal() * parameters[n].prior_std) for n in chosen}
    return {n: abs(v) if parameters[n].positive else v for n, v in drawn.items()}


def simulate_session(
    plan: Session,
    errors: Mapping[str, float],
    *,
    seed: int = 0,
    sigma: float | None = None,
    exact: bool = False,
) -> SimulatedSession:
    """Simulate the readings of a plan, or of the rows of a session, on a machine with errors.

    Args:
        plan: Setups, postures and rows.
        errors: Errors of the machine after all adjustments that the plan states: names of
            parameters, mapped to values, [SI]. Absent errors are 0, absent nuisance parameters of
            the setups are drawn.
        seed: Seed of noise, gauge zeros and nuisance parameters.
        sigma: Standard deviation of a reading, [m]; that of the gauge by default.
        exact: Simulate no noise, no rounding and no drawn mounting errors; the first reading of
            each setup is then in the middle of its gauge's range.

    Raises:
        SessionError: If the noise is not stated, a reading does not exist, or it is outside the
            range of the gauge.
        ClosureError: If the machine cannot reach a posture.
        ParameterError: If the name of an error is unknown.
        RobotError: If closure rows of the robot are linearly dependent.
        TypeError: If an argument has a wrong type.
        ValueError: If sigma is not a number of at least 0, or the seed is invalid.
    """
    require_kind(plan, Session, expected="a Session, such as load_plan(...)")
    require_numbers(errors, argument="errors")
    require_seed(seed)
    if sigma is not None and not 0.0 <= sigma < math.inf:
        raise ValueError(f"sigma: found {sigma!r}; expected a number of at least 0")
    require_independent_rows(plan.robot)
    rng = np.random.default_rng(seed)
    observations = build_observations(plan)
    nuisance = nuisance_parameters(plan).parameters
    drawn = np.zeros(len(nuisance)) if exact else _draw_nuisance(nuisance, seed)
    truth = {p.name: errors.get(p.name, float(v)) for p, v in zip(nuisance, drawn, strict=True)}
    machine_errors = {name: value for name, value in errors.items() if name not in truth}
    entries = predict_readings(
        plan, machine_errors, observations=observations, nuisance=np.array(list(truth.values()))
    )
    entries, zeros = show_readings(plan, observations, entries, rng=rng, sigma=sigma, exact=exact)
    rows = observations.rows(entries)
    _require_readable(plan, rows)
    session = replace(
        plan.with_values(rows),
        gauges={
            name: replace(g, resolution=None) if exact else g for name, g in plan.gauges.items()
        },
        title=_mark_title(plan.title),
        source=f"Simulated by orthocal, not measured (seed {seed})",
        path=None,
        readings_path=None,
        seed=seed,
    )
    return SimulatedSession(session, machine_errors, zeros, truth)


def _mark_title(title: str) -> str:
    """Title that begins with the word "Simulated"."""
    if title.startswith("Simulated"):
        return title
    return f"Simulated: {title}" if title else "Simulated"


def _require_readable(plan: Session, rows: Array) -> None:
    """Refuse simulated readings that do not exist or are outside the range of their gauge.

    Args:
        plan: The session whose rows are simulated.
        rows: Readings, shape (n_rows,), [m].

    Raises:
        SessionError: If a reading is refused.
    """
    for reading, value in zip(plan.readings, rows, strict=True):
        if not math.isfinite(value):
            raise SessionError(
                f"the simulated reading {reading.label} does not exist: on this machine the tip "
                "misses the rod; use smaller errors or another seed"
            )
        gauge_name, limits = plan.setups[reading.setup].gauge, limits_of(plan, reading)
        if limits is not None and not limits[0] <= value <= limits[1]:
            limit = limits[0] if value < limits[0] else limits[1]
            raise SessionError(
                f"the simulated reading {reading.label} is {value / MM:.3f} mm; the gauge's "
                f"range ends at {limit / MM:g} mm. Such a machine needs a gauge with more range"
                f"{', or offsets that are entered before' * (not plan.active_offsets.any())}; use "
                "smaller errors or another seed",
                where=plan.locate_gauge_key(gauge_name, "range_mm"),
            )


def show_readings(
    plan: Session,
    observations: Observations,
    entries: Array,
    *,
    rng: np.random.Generator,
    sigma: float | None = None,
    exact: bool = False,
) -> tuple[Array, dict[str, float]]:
    """Add gauge zeros, noise and rounding to exact readings.

    Args:
        plan: Setups, postures and rows.
        observations: The entries of the plan.
        entries: Exact readings with gauge zeros at 0, shape (n_entries,), [m].
        rng: Generator of zeros and noise.
        sigma: Standard deviation of a reading, [m]; that of the gauge by default.
        exact: Add no noise and no rounding; the first reading of each setup is then in the middle
            of its gauge's range.

    Returns:
        Readings of the gauges, shape (n_entries,), [m], and gauge zeros by setup, [m].

    Raises:
        SessionError: If the noise is not stated.
    """
    gauges = [plan.gauges[s.gauge] for s in plan.setups.values()]
    if sigma is None and not exact:
        used = dict.fromkeys(s.gauge for s in plan.setups.values())
        without_noise = [name for name in used if plan.gauges[name].sigma is None]
        plan.refuse_missing(without_noise, "sigma_mm", ": the noise to simulate is not stated")
    noise = np.array([(g.sigma if sigma is None else sigma) or 0.0 for g in gauges])
    # the operator sets the dial near the middle of its range in the first posture of a setup
    zeros = dict.fromkeys(plan.setups, 0.0)
    for i, (name, setup) in enumerate(plan.setups.items()):
        if setup.zero == "known":
            continue
        of_setup = entries[observations.setup == i]
        first = float(of_setup[:1].sum())  # 0 for a setup without readings
        zeros[name] = gauges[i].middle - first
        if not exact:
            zeros[name] += _draw_setting(of_setup - first, gauges[i], noise[i], rng)
    entries = entries + np.array(list(zeros.values()))[observations.setup]
    if not exact:
        entries = entries + noise[observations.setup] * rng.normal(size=observations.size)
        for i, gauge in enumerate(gauges):
            if gauge.resolution is not None:
                of_setup = observations.setup == i
                divisions = np.round(entries[of_setup] / gauge.resolution)
                entries[of_setup] = divisions * gauge.resolution
    return entries, zeros


def _draw_setting(deviations: Array, gauge: Gauge, sigma: float, rng: np.random.Generator) -> float:
    """First reading of a setup relative to the middle of the gauge's range, [m].

    It keeps all readings of the setup within the range if this is possible.

    Args:
        deviations: Exact readings minus the first one, shape (n,), [m].
        gauge: The gauge.
        sigma: Standard deviation of a reading, [m].
        rng: Generator.
    """
    shown = float(rng.uniform(-LARGEST_ZERO, LARGEST_ZERO))
    half = gauge.half_range - SPARE_NOISE * sigma
    low, high = -half - min(deviations, default=0.0), half - max(deviations, default=0.0)
    return round(float(np.clip(shown, low, high)) if low <= 0.0 <= high else shown, 6)


def _draw_nuisance(nuisance: Sequence[Parameter], seed: int) -> Array:
    """Random values of nuisance parameters from their priors, shape (n,), [SI].

    They have a generator of their own, so that the noise does not depend on them.
    """
    drawn = np.random.default_rng((seed, 1)).normal(size=len(nuisance))
    drawn *= np.array([p.prior_std for p in nuisance], dtype=np.float64)
    positive = np.array([p.positive for p in nuisance], dtype=np.bool_)
    return np.where(positive, np.abs(drawn), drawn)


def limits_of(plan: Session, reading: Reading) -> tuple[float, float] | None:
    """Lowest and highest possible value of a reading, [m]; None without a stated range."""
    limits = plan.gauges[plan.setups[reading.setup].gauge].range
    if limits is None or not plan.is_difference(reading):
        return limits
    return limits[0] - limits[1], limits[1] - limits[0]


class _TruthKeys(Keys):
    """Keys of a file of errors, such as truth.yaml."""

    errors: Annotated[dict[str, Number], Field(min_length=1)]
    adjusted_mm: dict[
        str, Annotated[Number, Field(ge=-LARGEST_AMOUNT_MM, le=LARGEST_AMOUNT_MM)]
    ] = {}
    """Mechanical adjustments of the machine that has these errors."""
    zeros_mm: dict[str, Number] = {}
    """Gauge zeros by setup; not used."""
    sensors: dict[str, Number] = {}
    """Nuisance parameters by name with unit."""


def load_errors(
    path: str | Path,
    robot: Robot,
    nuisance: Iterable[Parameter] = (),
    *,
    adjusted: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Load errors from a YAML file: `errors:` with keys such as x_slide.offset_mm.

    A gauge keeps its errors, such as the scale of a dial or the length of a bar. They are loaded
    from `sensors` of the file. Setups are mounted again, so that their mounting errors are ignored.

    The errors are those of a machine with the mechanical adjustments `adjusted_mm` of the file, by
    default none. The differences between `adjusted` and these adjustments are added.

    Args:
        path: The file, such as a truth.yaml.
        robot: The robot.
        nuisance: Nuisance parameters of the plan to simulate.
        adjusted: Mechanical adjustments of the machine to simulate: names, mapped to amounts, [m].
            None leaves the errors as in the file.

    Returns:
        Names of parameters, mapped to values, [SI].

    Raises:
        ParameterError: If a key is not valid; names file and key.
    """
    file = Path(path)
    data = read_yaml(file, error=ParameterError)
    keys = validate(_TruthKeys, data, where=str(file), error=ParameterError)
    errors = read_errors(keys.errors, robot.parameters, where=f"{file}: errors")
    for name in keys.adjusted_mm:
        require_adjustment(robot, name, where=f"{file}: adjusted_mm", error=ParameterError)
    if adjusted is not None:
        before = {name: amount * MM for name, amount in keys.adjusted_mm.items()}
        for name, change in subtract_amounts(adjusted, before).items():
            errors[name + SUFFIX] = errors.get(name + SUFFIX, 0.0) + change
    of_gauges = ParameterSet((), (p for p in nuisance if p.name.startswith(OF_GAUGE)))
    known = {k: v for k, v in keys.sensors.items() if k.rpartition("_")[0] in of_gauges}
    return errors | read_errors(known, of_gauges, where=f"{file}: sensors")


def collect_errors(
    robot: Robot,
    *,
    file: Path | None = None,
    single: Sequence[str] = (),
    draw: str | None = None,
    nuisance: Iterable[Parameter] = (),
    adjusted: Mapping[str, float] | None = None,
    seed: int = 0,
) -> dict[str, float]:
    """Collect errors that are drawn, from a file and from single texts; later ones replace earlier.

    Args:
        robot: The robot.
        file: YAML file for `load_errors`.
        single: Texts such as x_slide.offset_mm=1.2.
        draw: Model of the robot, or names and globs separated by commas, to draw.
        nuisance: Nuisance parameters of a plan: texts may state any, a file those of gauges.
        adjusted: Mechanical adjustments of the machine to simulate, for the errors of a file; see
            `load_errors`.
        seed: Seed of the random numbers.

    Returns:
        Names of parameters, mapped to values, [SI].

    Raises:
        ParameterError: If a name, unit or number is not valid, or there are no errors.
    """
    errors, nuisance = dict[str, float](), tuple(nuisance)
    if draw is not None:
        models = robot.parameters.models
        is_model = draw in models
        names = tuple(name.strip() for name in draw.split(","))
        patterns = robot.parameters.patterns(draw) if is_model else names
        if all(p.startswith("!") for p in patterns):
            raise ParameterError(
                f"found '{draw}', which only excludes errors; expected errors to draw before it, "
                f"such as '*,{draw}'",
                where="--draw",
            )
        try:
            errors.update(draw_errors(robot, patterns, seed=seed))
        except ParameterError:
            raise ParameterError(
                f"'{draw}' is neither a model ({', '.join(models)}) nor the name of an error "
                "parameter",
                where="--draw",
            ) from None
    if file is not None:
        errors.update(load_errors(file, robot, nuisance, adjusted=adjusted))
    parameters = ParameterSet((), (*robot.parameters, *nuisance))
    for text in single:
        key, number = split_assignment(text, "NAME=VALUE", "--error")
        value = parse_number(number, where="--error", name=key, error=ParameterError)
        errors.update(read_errors({key: value}, parameters, where="--error"))
    if not errors:
        raise ParameterError("no errors; state them by --errors, --error or --draw")
    return errors


def read_errors(
    values: Mapping[str, float], parameters: ParameterSet, *, where: str
) -> dict[str, float]:
    """Read errors from keys with unit suffix.

    Returns:
        Names of parameters, mapped to values, [SI].

    Raises:
        ParameterError: If a key is unknown or repeated; names it.
    """
    errors: dict[str, float] = {}
    for key, value in values.items():
        with errors_at(where):
            name, si = parameters.read_quantity(key, value)
        if name in errors:
            raise ParameterError(f"'{name}' is stated twice", where=where)
        errors[name] = si
    return errors


def quantity(parameter: Parameter, value: float) -> tuple[str, float]:
    """Key of a parameter in truth.yaml, and a value in the unit of the key.

    Args:
        parameter: The parameter.
        value: The value, [SI].
    """
    key = f"{parameter.name}_{parameter.edge_unit}"
    return key, _nine_digits(value * parameter.edge_factor)


def _nine_digits(value: float) -> float:
    """Number with nine digits, so that files do not depend on rounding errors of the simulation."""
    return float(f"{value:.9g}")


def drawn_gauge_errors(simulated: SimulatedSession, stated: Iterable[str]) -> dict[str, float]:
    """Errors of the gauges that were drawn, by their keys in truth.yaml.

    Args:
        simulated: The simulated session.
        stated: Names of the parameters whose values were stated.
    """
    drawn, stated = simulated.nuisance, set(stated)
    parameters = nuisance_parameters(simulated.session).parameters
    gauges = (p for p in parameters if p.name.startswith(OF_GAUGE) and p.name not in stated)
    return dict(quantity(p, drawn[p.name]) for p in gauges if drawn[p.name])


def truth_document(simulated: SimulatedSession) -> str:
    """Text of truth.yaml: errors, gauge zeros and nuisance parameters of a simulated session."""
    parameters = simulated.session.robot.parameters
    errors = simulated.errors
    document = {"errors": dict(quantity(parameters[n], v) for n, v in errors.items())}
    if adjusted := simulated.session.adjusted:
        document["adjusted_mm"] = {name: to_mm(amount) for name, amount in adjusted.items()}
    document["zeros_mm"] = {name: _nine_digits(v / MM) for name, v in simulated.zeros.items()}
    if simulated.nuisance:
        by_name = {p.name: p for p in nuisance_parameters(simulated.session).parameters}
        nuisance = simulated.nuisance
        document["sensors"] = dict(quantity(by_name[n], v) for n, v in nuisance.items())
    head = "# The truth behind the simulated readings beside this file. No calibration reads it.\n"
    return head + str(yaml.safe_dump(document, sort_keys=False, default_flow_style=False))
