"""Selection of the free parameters: models, globs, priors, known values, bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthocal.arrays import Array, Mask
from orthocal.errors import ParameterError, errors_at
from orthocal.estimation.tolerance_scale import AS_STATED, ToleranceScale
from orthocal.io.documents import parse_number
from orthocal.io.fields import read_only
from orthocal.robot.parameters import (
    Parameter,
    ParameterSet,
    require_prior_std,
    split_assignment,
)
from orthocal.units import Unit, show_limit

KnownWithStd = float | tuple[float, float]
"""Known value, or value and prior standard deviation, [SI]."""

KnownWithTolerance = float | tuple[float, float]
"""Known value, or value and tolerance (±2 prior standard deviations), in the unit of its key."""

COMPLETE_MODELS = ("full", "complete")
"""Names of complete models, in order of preference."""

LARGEST_KNOWN_RATIO = 100.0
"""Ratio of a known value to its prior standard deviation above which it is a length or an angle of
the machine instead of an error."""


def complete_model(parameters: ParameterSet) -> str:
    """Name of a robot's complete model; the largest model if none has such a name."""
    for name in COMPLETE_MODELS:
        if name in parameters.models:
            return name
    return max(parameters.models, key=lambda m: len(parameters.select_model(m)))


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """Free parameters of a problem, with priors and bounds."""

    label: str
    """Model and added patterns, as on the command line."""
    parameters: tuple[Parameter, ...]
    """Free parameters, with the priors of this selection."""
    prior: Mask
    """Mask of the parameters with a prior, shape (n_free,)."""
    scaled: Mask
    """Mask of the parameters whose prior the tolerance scale multiplies, shape (n_free,)."""
    mean: Array
    """Mean of each prior, shape (n_free,), [SI]."""
    lower: Array
    """Lower bounds, -inf for none, shape (n_free,), [SI]."""
    upper: Array
    """Upper bounds, inf for none, shape (n_free,), [SI]."""
    fixed: Mapping[str, float]
    """Known values of parameters that are not free, [SI]."""
    tolerance_scale: ToleranceScale = AS_STATED
    """Factor on tolerances, which the priors include."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(p.name for p in self.parameters)

    @property
    def prior_stds(self) -> Array:
        """Prior standard deviation of each free parameter, shape (n_free,), [SI]."""
        return np.array([p.prior_std for p in self.parameters])

    def held_at_bound(self, at_bound: NDArray[np.int8]) -> Mask:
        """Mask of the parameters that a bound determines, shape (n_free,).

        A parameter that is never negative, such as backlash, does not count if it is 0: its
        covariance is that of the unbounded estimate.

        Args:
            at_bound: -1, 0 or 1 for each parameter at its lower, no or its upper bound, shape
                (n_free,).
        """
        never_negative = np.array([p.positive for p in self.parameters]) & (self.lower == 0.0)
        return np.asarray((at_bound != 0) & ~((at_bound < 0) & never_negative))

    def with_nuisance(self, parameters: Sequence[Parameter]) -> Selection:
        """Selection with nuisance parameters appended, which have priors of mean 0."""
        n = len(parameters)
        return replace(
            self,
            parameters=(*self.parameters, *parameters),
            prior=np.append(self.prior, np.ones(n, dtype=bool)),
            scaled=np.append(self.scaled, np.zeros(n, dtype=bool)),
            mean=read_only(np.append(self.mean, np.zeros(n))),
            lower=read_only(np.append(self.lower, [_lowest(p) for p in parameters])),
            upper=read_only(np.append(self.upper, np.full(n, np.inf))),
        )

    def keep(self, names: Sequence[str]) -> Selection:
        """Selection of some of the parameters without priors; the other parameters are 0."""
        index = [self.names.index(name) for name in names]
        return replace(
            self,
            parameters=tuple(self.parameters[i] for i in index),
            prior=np.zeros(len(index), dtype=bool),
            scaled=self.scaled[index],
            mean=read_only(np.zeros(len(index))),
            lower=read_only(self.lower[index]),
            upper=read_only(self.upper[index]),
        )


def select_parameters(
    parameters: ParameterSet,
    *,
    model: str | None = None,
    free: Sequence[str] = (),
    prior: bool | None = None,
    known: Mapping[str, KnownWithStd] | None = None,
    prior_stds: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    tolerance_scale: ToleranceScale = AS_STATED,
) -> Selection:
    """Select the free parameters of a robot.

    Args:
        parameters: Parameters of the robot.
        model: A model of the robot's YAML; by default the complete model, or none if `free` is
            stated.
        free: Names or globs of further free parameters; '!' excludes.
        prior: Use priors; by default True, unless only offsets are free.
        known: Names, mapped to a known value, which is fixed, or to a value and its standard
            deviation, which become the prior of a free parameter, [SI].
        prior_stds: Names or globs, mapped to prior standard deviations that replace those of the
            robot, [SI].
        bounds: Names or globs, mapped to lowest and highest value, ±inf for open, [SI].
        tolerance_scale: Factor on the tolerances of all errors of the geometry except offsets;
            standard deviations of `known` are not scaled.

    Raises:
        ParameterError: If a name, glob or model is unknown, no parameter is free, two
            parameters contain the same elementary error, or a number is invalid.
    """
    base = complete_model(parameters) if model is None and not free else model
    patterns = [] if base is None else parameters.patterns(base)
    with errors_at("free"):
        chosen = set(parameters.select([*patterns, *free]))
    fixed, priors = _split_known(parameters, known or {})
    chosen = (chosen | set(priors)) - set(fixed)
    names = [n for n in parameters.names if n in chosen]
    if not names:
        raise ParameterError("no free parameters: there is nothing to identify")
    _refuse_overlap(parameters, [*names, *(n for n, v in fixed.items() if v != 0.0)])

    stds = _find_stds(parameters, names, prior_stds or {}, tolerance_scale)
    stds.update({n: s for n, (_, s) in priors.items()})
    lower, upper = _find_bounds(parameters, names, bounds or {})
    always_prior = {*priors, *parameters.of_effects}
    only_offsets = all(parameters.are_offsets(n) for n in names if n not in always_prior)
    use_priors = not only_offsets if prior is None else prior
    return Selection(
        label=label_choice(base, free),
        parameters=tuple(replace(parameters[n], prior_std=stds[n]) for n in names),
        prior=np.array([use_priors or n in always_prior for n in names]),
        scaled=np.array([n not in priors and parameters.are_scaled(n) for n in names]),
        mean=read_only([priors.get(n, (0.0, 0.0))[0] for n in names]),
        lower=read_only(lower),
        upper=read_only(upper),
        fixed=fixed,
        tolerance_scale=tolerance_scale,
    )


def _find_stds(
    parameters: ParameterSet,
    names: Sequence[str],
    prior_stds: Mapping[str, float],
    tolerance_scale: ToleranceScale,
) -> dict[str, float]:
    """Prior standard deviations of free parameters, times the tolerance scale, [SI].

    Those of the robot are the default.
    """
    stds = {n: parameters[n].prior_std for n in names}
    for glob, value in prior_stds.items():
        with errors_at("tolerances"):
            for name in _match_free(parameters, glob, names):
                stds[name] = require_prior_std(value, parameters.defaults[name])
    factors = tolerance_scale.factors(parameters, tuple(names)).tolist()
    return {n: std * factor for (n, std), factor in zip(stds.items(), factors, strict=True)}


def _split_known(
    parameters: ParameterSet, known: Mapping[str, KnownWithStd]
) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """Fixed values, and means and standard deviations of priors, [SI]."""
    fixed: dict[str, float] = {}
    priors: dict[str, tuple[float, float]] = {}
    for name, entry in known.items():
        with errors_at("known"):
            parameter = parameters[name]
            _refuse_length(entry[0] if isinstance(entry, tuple) else entry, parameter)
            if isinstance(entry, tuple):
                std = require_prior_std(entry[1], parameters.defaults[name])
                priors[name] = (_require_finite(entry[0], name), std)
            else:
                fixed[name] = _require_finite(entry, name)
    return fixed, priors


def _find_bounds(
    parameters: ParameterSet, names: list[str], bounds: Mapping[str, tuple[float, float]]
) -> tuple[Array, Array]:
    """Lowest and highest values of free parameters, shape (n_free,) each, [SI]."""
    lower = np.array([_lowest(parameters[n]) for n in names])
    upper = np.full(len(names), np.inf)
    for glob, (low, high) in bounds.items():
        with errors_at("bounds"):
            if not low < high:
                raise ParameterError(f"the lower bound of '{glob}' is not below the upper one")
            for name in _match_free(parameters, glob, names):
                i = names.index(name)
                lower[i], upper[i] = max(low, lower[i]), high
                if not lower[i] < high:
                    parameter = parameters[name]
                    bound = f"{high * parameter.edge_factor:g} {parameter.edge_unit}"
                    raise ParameterError(
                        f"'{name}' is never negative, but its upper bound is {bound}"
                    )
    return lower, upper


def read_known(
    texts: Sequence[str], parameters: ParameterSet, *, where: str
) -> dict[str, KnownWithTolerance]:
    """Read known values from texts such as x_leg.length_mm=0.12 or x_leg.length_mm=0.12±0.02.

    Returns:
        Keys with unit, mapped to a value, or to a value and its tolerance: `Choice.known`.

    Raises:
        ParameterError: If a text is not valid.
    """
    result: dict[str, KnownWithTolerance] = {}
    names: set[str] = set()
    for text in texts:
        key, quantity = split_assignment(text, "NAME=VALUE or NAME=VALUE±TOLERANCE", where)
        value, sign, tolerance = quantity.replace("+/-", "±").replace("+-", "±").partition("±")
        number = _number(value, where, key)
        with errors_at(where):
            name, _ = parameters.read_quantity(key, number)
        if name in names:
            raise ParameterError(f"'{name}' is stated twice", where=where)
        names.add(name)
        result[key] = (number, _number(tolerance, where, key)) if sign else number
    return result


def read_tolerances(
    texts: Sequence[str], parameters: ParameterSet, *, where: str
) -> dict[str, float]:
    """Read tolerances from texts such as *.offset_mm=2, for `Choice.tolerances`.

    Raises:
        ParameterError: If a text is not valid.
    """
    result = {}
    for text in texts:
        key, number = split_assignment(text, "NAME=VALUE", where)
        with errors_at(where):
            parameters.read_glob(key)
        result[key] = _number(number, where, key)
    return result


def read_bounds(
    texts: Sequence[str], parameters: ParameterSet, *, where: str
) -> dict[str, tuple[float, float]]:
    """Read bounds from texts such as x_slide.offset_mm=-2:2, for `Choice.bounds`.

    One side may be empty.

    Raises:
        ParameterError: If a text is not valid.
    """
    form = "NAME=LOWEST:HIGHEST"
    result = {}
    for text in texts:
        key, numbers = split_assignment(text, form, where)
        low, colon, high = numbers.partition(":")
        if not colon:
            raise ParameterError(f"found '{text}'; expected {form}", where=where)
        with errors_at(where):
            parameters.read_glob(key)
        if not (low.strip() or high.strip()):
            raise ParameterError(f"found '{text}'; expected {form}", where=where)
        result[key] = (
            _number(low, where, key) if low.strip() else -math.inf,
            _number(high, where, key) if high.strip() else math.inf,
        )
    return result


def _number(text: str, where: str, name: str) -> float:
    """Number that a text such as KEY=VALUE states for its key."""
    return parse_number(text.strip(), where=where, name=name, error=ParameterError)


def _match_free(parameters: ParameterSet, glob: str, free: Sequence[str]) -> list[str]:
    """Names of the free parameters that a glob matches.

    Raises:
        ParameterError: If there are none, or if they have different units.
    """
    matches = [n for n in parameters.select([glob]) if n in free]
    if not matches:
        raise ParameterError(f"'{glob}' matches no free parameter")
    units: set[Unit] = {parameters[n].unit for n in matches}
    if len(units) > 1:
        *others, last = sorted("ppm" if u == "1" else u for u in units)
        raise ParameterError(f"'{glob}' matches parameters in {', '.join(others)} and {last}")
    return matches


def _refuse_overlap(parameters: ParameterSet, names: Sequence[str]) -> None:
    """Refuse two parameters that contain the same elementary error."""
    owners: dict[str, str] = {}
    for name in names:
        for term, _ in parameters[name].terms:
            if term in owners:
                larger = max(name, owners[term], key=lambda n: len(parameters[n].terms))
                terms = ", ".join(t for t, _ in parameters[larger].terms)
                parts = ",".join(f"!{t}" for t, _ in parameters[larger].terms)
                raise ParameterError(
                    f"'{owners[term]}' and '{name}' are partly the same error: {larger} is the sum "
                    f"of {terms}; exclude it, or its parts by '{parts}'"
                )
            owners[term] = name


def _lowest(parameter: Parameter) -> float:
    """Default lower bound of a parameter."""
    return 0.0 if parameter.positive else -math.inf


def label_choice(model: str | None, free: Sequence[str]) -> str:
    """Label of a choice: model and added patterns, as on the command line."""
    return " ".join([*([] if model is None else [model]), *free])


def _refuse_length(value: float, parameter: Parameter) -> None:
    """Refuse a known value that is a length or an angle of the machine instead of an error."""
    if abs(value) > LARGEST_KNOWN_RATIO * parameter.prior_std:
        factor, unit = parameter.edge_factor, parameter.edge_unit
        limit = show_limit(parameter.prior_std) * factor
        raise ParameterError(
            f"'{parameter.name}' is {value * factor:g} {unit}; expected the deviation from nominal "
            f"(its tolerance is {limit:g} {unit}), not the length itself"
        )


def _require_finite(value: float, name: str) -> float:
    """Refuse a known value that is not finite; return it as a float."""
    if not math.isfinite(value):
        raise ParameterError(f"the known value of '{name}' is {value}; expected a finite number")
    return float(value)
