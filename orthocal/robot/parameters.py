"""Error parameters of a robot: names, units, tolerances and elementary errors.

Effects define the elementary errors of a machine (`orthocal.effects`). A parameter is one
elementary error or a named sum of several. Parameters of the nominal machine are 0.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Literal

import numpy as np

from orthocal.arguments import require_numbers
from orthocal.arrays import Array
from orthocal.errors import ParameterError, errors_at
from orthocal.text import composed
from orthocal.units import EDGE_UNITS, UNIT_SUFFIXES, InUnit, Unit, read_limit, show_limit, tidy

COMPLETE: Literal["complete"] = "complete"
"""Keyword for a model of all observable errors."""

LARGEST_PRIOR_RATIO = 200.0
"""Largest ratio of a prior standard deviation to that of the robot; larger values have a wrong
unit."""

SMALLEST_PRIOR_STD = 1e-9
"""Smallest prior standard deviation, [m, rad or 1], because parameters are scaled by it."""

AXES = ("x", "y", "z", "rx", "ry", "rz")
"""Components of a twist, translation first."""


def require_prior(name: str, unit: str, std: float) -> None:
    """Check unit and prior standard deviation of a parameter.

    Raises:
        ValueError: If one of them is invalid; names the parameter.
    """
    if unit not in EDGE_UNITS:
        raise ValueError(f"{name}: unit: found {unit!r}; expected one of {', '.join(EDGE_UNITS)}")
    if not 0.0 <= std < math.inf:
        raise ValueError(f"{name}: prior_std: found {std!r}; expected a number of at least 0")


@dataclass(frozen=True, slots=True)
class ElementaryError:
    """Elementary error: one parameter of an effect.

    Raises:
        ValueError: If the unit is unknown, or the standard deviation no number of at least 0.
    """

    name: str
    """Name of the parameter, such as x_slide.offset."""
    kind: str
    """`offset` or `scale` of a drive, `translation` or `rotation` of a placement, or the name of
    another effect."""
    owner: str
    """Name of the drive, joint or frame. Errors of other effects name a part of the machine; those
    of each setup have ""."""
    unit: Unit
    """SI unit."""
    prior_std: float
    """Standard deviation before the calibration, [unit]."""
    of_frame: bool = False
    """True if the owner is a frame, False if it is a joint."""
    axis: int = -1
    """Component of the twist of a placement, 0 to 5; -1 for errors of other kinds."""
    complete: bool = True
    """False for an error of a placement that no complete model contains. All others are part of it
    unless they are redundant; those of named effects are part of every model."""
    positive: bool = False
    """True for a value of at least 0 with a half-normal prior."""

    def __post_init__(self) -> None:
        require_prior(self.name, self.unit, self.prior_std)


@dataclass(frozen=True, slots=True)
class Parameter(InUnit):
    """Named error parameter."""

    name: str
    """Name, such as x_slide.offset."""
    unit: Unit
    """SI unit."""
    prior_std: float
    """Standard deviation before the calibration, [unit]."""
    terms: tuple[tuple[str, float], ...]
    """Elementary errors that it adds, with coefficients."""
    positive: bool = False
    """True for a value of at least 0 with a half-normal prior."""


class ParameterSet:
    """All error parameters of a robot, by name, in a fixed order.

    Args:
        elementary: All elementary errors.
        parameters: All parameters: elementary errors and named sums.
        models: Names of models, mapped to patterns of parameter names or COMPLETE.
        find_redundant: Function that finds the redundant elementary errors; called at most once.
    """

    def __init__(
        self,
        elementary: Iterable[ElementaryError] = (),
        parameters: Iterable[Parameter] = (),
        models: Mapping[str, Sequence[str]] | None = None,
        *,
        find_redundant: Callable[[], frozenset[str]] = frozenset,
    ) -> None:
        self.elementary = {e.name: e for e in elementary}
        self._parameters = {p.name: p for p in parameters}
        self._models = dict(models or {})
        self._find_redundant = find_redundant
        self.defaults: ParameterSet = self
        """Parameters with the tolerances of the robot's YAML."""
        self.stated: Mapping[str, float] = {}
        """Tolerances that differ from the defaults (see `with_tolerances`)."""

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self._parameters.values())

    def __len__(self) -> int:
        return len(self._parameters)

    def __contains__(self, name: object) -> bool:
        return name in self._parameters

    def __getitem__(self, name: str) -> Parameter:
        try:
            return self._parameters[name]
        except KeyError:
            raise ParameterError(
                f"'{name}' is not an error parameter{suggest(name, self._parameters)}"
            ) from None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters in order."""
        return tuple(self._parameters)

    @property
    def models(self) -> tuple[str, ...]:
        """Names of the robot's models."""
        return tuple(self._models)

    def patterns(self, model: str) -> tuple[str, ...]:
        """Patterns for `select` of the free parameters of a model, effects included.

        Raises:
            ParameterError: If there is no such model.
        """
        if model not in self._models:
            raise ParameterError(
                f"'{model}' is not a model of this robot; models: {', '.join(self._models)}"
            )
        patterns = self._models[model]
        if patterns == COMPLETE:
            return self.complete
        return (*patterns, *self.of_effects)

    @cached_property
    def complete(self) -> tuple[str, ...]:
        """Elementary errors of the complete model, in order."""
        return tuple(n for n in self.of_parts if n not in self.redundant)

    @cached_property
    def of_parts(self) -> tuple[str, ...]:
        """Elementary errors of the complete model and redundant ones, in order."""
        return tuple(e.name for e in self.elementary.values() if e.complete)

    @cached_property
    def of_effects(self) -> tuple[str, ...]:
        """Errors of effects other than geometry and drives, in order; every model contains them."""
        return tuple(
            e.name
            for e in self.elementary.values()
            if e.complete and e.axis < 0 and e.kind not in ("offset", "scale")
        )

    @cached_property
    def redundant(self) -> frozenset[str]:
        """Elementary errors that neither the tool nor a gauge can observe."""
        return self._find_redundant() if self.defaults is self else self.defaults.redundant

    def coefficients(self, errors: Sequence[str], names: Sequence[str]) -> Array:
        """Contribution of one unit of each named parameter to each error, (n_errors, n_names).

        Raises:
            ParameterError: If a name is unknown.
        """
        rows = {error: i for i, error in enumerate(errors)}
        result = np.zeros((len(errors), len(names)))
        for j, name in enumerate(names):
            for term, coefficient in self[name].terms:
                if term in rows:
                    result[rows[term], j] = coefficient
        return result

    def are_offsets(self, name: str) -> bool:
        """True if a parameter is the offset of a drive or a sum of offsets.

        Raises:
            ParameterError: If the name is unknown.
        """
        return all(self.elementary[term].kind == "offset" for term, _ in self[name].terms)

    def are_scaled(self, name: str) -> bool:
        """True for a rigid-body parameter (`are_rigid`) that is not an offset.

        The tolerance scale multiplies the tolerances of these parameters.

        Raises:
            ParameterError: If the name is unknown.
        """
        return self.are_rigid(name) and not self.are_offsets(name)

    def are_rigid(self, name: str) -> bool:
        """True if a parameter consists of placement errors, drive offsets and drive scales.

        Raises:
            ParameterError: If the name is unknown.
        """
        errors = (self.elementary[term] for term, _ in self[name].terms)
        return all(e.axis >= 0 or e.kind in ("offset", "scale") for e in errors)

    def select(self, patterns: Iterable[str]) -> tuple[str, ...]:
        """Names selected by a list of globs, in the order of the set.

        A pattern adds the matching names; a pattern that begins with '!' removes them.

        Raises:
            ParameterError: If a pattern matches no parameter.
        """
        chosen: set[str] = set()
        for pattern in patterns:
            names = _match(pattern.removeprefix("!"), self._parameters)
            if pattern.startswith("!"):
                chosen.difference_update(names)
            else:
                chosen.update(names)
        return tuple(name for name in self._parameters if name in chosen)

    def without_sums(self, names: Sequence[str]) -> tuple[str, ...]:
        """Names without those sums whose elementary errors are also among the names."""
        listed = set(names)
        return tuple(
            n
            for n in names
            if len(self[n].terms) == 1 or not listed & {t for t, _ in self[n].terms}
        )

    def without_terms(self, names: Iterable[str], terms: Set[str]) -> tuple[str, ...]:
        """Names of those parameters that contain none of the elementary errors `terms`."""
        return tuple(n for n in names if not terms & {term for term, _ in self[n].terms})

    def select_model(self, model: str) -> tuple[str, ...]:
        """Names of the free parameters of a model of the robot's YAML.

        Raises:
            ParameterError: If there is no such model.
        """
        return self.select(self.patterns(model))

    def with_tolerances(self, tolerances: Mapping[str, float]) -> ParameterSet:
        """Parameters with some tolerances replaced.

        Args:
            tolerances: Names or globs with unit, such as `*.offset_mm`, mapped to limits of ±2
                prior standard deviations in that unit. Earlier stated tolerances remain unless
                these match all their parameters. Later entries replace earlier ones. Entries that
                change nothing are omitted.

        Raises:
            ParameterError: If a name or unit is unknown, or a number is implausible.
            TypeError: If `tolerances` does not map names to numbers.
        """
        globs = self.read_tolerances(tolerances)
        matched = {name for glob in globs for name in self.select([glob])}
        remaining = {
            key: value
            for key, value in self.stated.items()
            if not matched.issuperset(self.select([self.read_glob(key)[0]]))
        }
        stated = remaining | dict(tolerances)
        if stated == self.stated:
            return self
        parameters = self._replaced(stated)
        for key in list(stated):  # entries that change nothing are omitted
            without = {k: v for k, v in stated.items() if k != key}
            if self._replaced(without) == parameters:
                stated = without
        if stated == self.stated:
            return self
        result = ParameterSet(self.elementary.values(), parameters.values(), self._models)
        result.defaults, result.stated = self.defaults, stated
        return result

    def _replaced(self, stated: Mapping[str, float]) -> dict[str, Parameter]:
        """Parameters by name with stated tolerances instead of the defaults.

        Raises:
            ParameterError: If a name or unit is unknown, or a number is implausible.
        """
        parameters = {p.name: p for p in self.defaults}
        for glob, value in self.defaults.read_tolerances(stated).items():
            for name in self.defaults.select([glob]):
                std = require_prior_std(value, self.defaults[name])
                parameters[name] = replace(parameters[name], prior_std=std)
        return parameters

    def limit_of(self, name: str) -> float:
        """Tolerance of a parameter, a limit of ±2 prior standard deviations, [`edge_unit`].

        Raises:
            ParameterError: If the name is unknown.
        """
        return tidy(show_limit(self[name].prior_std) * self[name].edge_factor)

    def read_quantity(self, key: str, value: float) -> tuple[str, float]:
        """Parameter name and SI value of a key with unit, such as x_slide.offset_mm.

        Raises:
            ParameterError: If the unit is missing or wrong, or the name is unknown.
        """
        name, unit, factor = split_unit(key)
        _check_unit(key, unit, self[name])
        return name, value * factor

    def read_glob(self, key: str) -> tuple[str, float]:
        """Glob and factor to SI of a key with unit, such as *.offset_mm.

        Raises:
            ParameterError: If the unit is missing or wrong, or the glob matches nothing.
        """
        glob, unit, factor = split_unit(key)
        try:
            names = self.select([glob])
        except ParameterError:
            keys = [f"{p.name}_{p.edge_unit}" for p in self]
            keys += [f"*.{key.rpartition('.')[2]}" for key in keys]
            hint = suggest(key, dict.fromkeys(keys))
            raise ParameterError(f"'{key}' matches no error parameter{hint}") from None
        for name in names:
            _check_unit(key, unit, self[name])
        return glob, factor

    def read_tolerances(self, tolerances: Mapping[str, float]) -> dict[str, float]:
        """Prior standard deviations of stated tolerances by name or glob, [SI].

        Args:
            tolerances: Names or globs with unit, mapped to limits of ±2 prior standard deviations.

        Raises:
            ParameterError: If a name or unit is unknown, or a glob is stated in two units.
            TypeError: If `tolerances` does not map names to numbers.
        """
        require_numbers(tolerances, argument="tolerances")
        result: dict[str, float] = {}
        for key, value in tolerances.items():
            with errors_at("tolerances"):
                glob, factor = self.read_glob(key)
                if glob in result:
                    raise ParameterError(f"'{glob}' is stated twice")
            result[glob] = read_limit(value) * factor
        return result

    def expand(self, values: Mapping[str, float]) -> dict[str, float]:
        """Elementary errors of parameter values, without those that are 0.

        Args:
            values: Names of parameters, mapped to values, [unit of the parameter].

        Raises:
            ParameterError: If a name is unknown, or a value is not finite.
            TypeError: If `values` does not map names to numbers.
        """
        require_numbers(values, argument="errors")
        totals: dict[str, float] = {}
        for name, value in values.items():
            if not math.isfinite(value):
                raise ParameterError(f"'{name}' is {value}; expected a finite number")
            for term, coefficient in self[name].terms:
                totals[term] = totals.get(term, 0.0) + coefficient * value
        return {name: value for name, value in totals.items() if value != 0.0}


def require_prior_std(value: float, parameter: Parameter) -> float:
    """Refuse an implausible prior standard deviation.

    Args:
        value: Prior standard deviation, [unit of the parameter].
        parameter: Parameter with the tolerance of the robot's YAML.

    Raises:
        ParameterError: If it is too small or too large; states the tolerance and its limit.
    """
    unit, factor = parameter.edge_unit, show_limit(parameter.edge_factor)
    if not (math.isfinite(value) and value >= SMALLEST_PRIOR_STD):
        raise ParameterError(
            f"the tolerance of '{parameter.name}' is {value * factor:g} {unit}; expected at least "
            f"{SMALLEST_PRIOR_STD * factor:g} {unit}"
        )
    if value > LARGEST_PRIOR_RATIO * parameter.prior_std:
        raise ParameterError(
            f"the tolerance of '{parameter.name}' is {value * factor:g} {unit}; expected at most "
            f"{LARGEST_PRIOR_RATIO:g} times that of the robot, "
            f"{parameter.prior_std * factor:g} {unit}"
        )
    return float(value)


def split_unit(key: str) -> tuple[str, Unit, float]:
    """Name, unit and factor to SI of a key with unit suffix.

    Raises:
        ParameterError: If the suffix is missing or unknown.
    """
    for suffix, (unit, factor) in UNIT_SUFFIXES.items():
        if key.endswith(suffix):
            return key.removesuffix(suffix), unit, factor
    raise ParameterError(
        f"'{key}' carries no unit; expected one of the suffixes {', '.join(UNIT_SUFFIXES)}, "
        "for example '*.offset_mm'"
    )


def build_parameters(
    elementary: Sequence[ElementaryError],
    *,
    sums: Mapping[str, Sequence[str]],
    overrides: Mapping[str, float],
    models: Mapping[str, Sequence[str]],
    find_redundant: Callable[[], frozenset[str]],
    further: Iterable[Parameter] = (),
) -> ParameterSet:
    """Build the parameter set of a robot.

    Args:
        elementary: All elementary errors, in order.
        sums: Names of sums, mapped to elementary errors; a leading '-' subtracts.
        overrides: Names or globs with unit, mapped to tolerances (±2 prior standard deviations);
            later entries replace earlier ones.
        models: Names of models, mapped to patterns or COMPLETE.
        find_redundant: Function that finds the redundant elementary errors.
        further: Parameters in addition to the errors and their sums.

    Raises:
        ParameterError: If a name is unknown or repeated, a unit is missing or wrong, terms of a sum
            differ in unit, or a model selects nothing.
    """
    by_name = {e.name: e for e in elementary}
    parameters = {
        e.name: Parameter(e.name, e.unit, e.prior_std, ((e.name, 1.0),), e.positive)
        for e in elementary
    }
    for name, members in sums.items():
        if name in parameters:
            raise ParameterError(f"parameters.{name}: an elementary error has this name")
        parameters[name] = _sum_errors(name, members, by_name)
    for parameter in further:
        if parameter.name in parameters:
            raise ParameterError(f"parameters.{parameter.name}: an adjustment has this name")
        parameters[parameter.name] = parameter
    for key, value in overrides.items():
        glob, unit, factor = split_unit(key)
        with errors_at("tolerances.overrides"):
            names = _match(glob, parameters)
        for name in names:
            _check_unit(key, unit, parameters[name])
            parameters[name] = replace(parameters[name], prior_std=read_limit(value) * factor)
    result = ParameterSet(elementary, parameters.values(), models, find_redundant=find_redundant)
    for model, patterns in models.items():
        if patterns == COMPLETE:
            continue
        with errors_at(f"models.{model}"):
            chosen = result.select(patterns)
        if not chosen:
            raise ParameterError(f"models.{model}: selects no error parameter")
    return result


def _sum_errors(
    name: str, members: Sequence[str], errors: Mapping[str, ElementaryError]
) -> Parameter:
    """Named sum of elementary errors, with the tolerance of the first term.

    Raises:
        ParameterError: If a term is unknown or repeated, or the units differ.
    """
    terms: dict[str, float] = {}
    for member in members:
        term = member.removeprefix("-")
        if term not in errors:
            raise ParameterError(
                f"parameters.{name}: '{term}' is not an elementary error{suggest(term, errors)}"
            )
        if term in terms:
            raise ParameterError(f"parameters.{name}: '{term}' occurs twice")
        terms[term] = -1.0 if term != member else 1.0
    first = errors[next(iter(terms))]
    for term in terms:
        if errors[term].unit != first.unit:
            raise ParameterError(
                f"parameters.{name}: '{term}' is in {errors[term].unit}, "
                f"'{first.name}' in {first.unit}; a sum needs one unit"
            )
    return Parameter(name, first.unit, first.prior_std, tuple(terms.items()))


def _match(pattern: str, names: Collection[str]) -> list[str]:
    """Names that a glob matches; a name matches itself, whatever its characters.

    Raises:
        ParameterError: If there is none; suggests similar names.
    """
    glob = composed(pattern)
    matched = [glob] if glob in names else [name for name in names if fnmatchcase(name, glob)]
    if not matched:
        raise ParameterError(f"'{glob}' matches no error parameter{suggest(glob, names)}")
    return matched


def _check_unit(key: str, unit: Unit, parameter: Parameter) -> None:
    """Refuse a key whose unit is not that of the parameter.

    Raises:
        ParameterError: If the units differ; names the unit that users read.
    """
    if unit != parameter.unit:
        matched = ", which it matches," if set(key) & set("*?[") else ""
        raise ParameterError(
            f"'{key}' has the wrong unit; {parameter.name}{matched} is in {parameter.edge_unit}"
        )


def is_offset(name: str) -> bool:
    """True for the name of a drive's offset, which the controller corrects."""
    return name.endswith(".offset")


def suggest(name: str, names: Iterable[str]) -> str:
    """Hint with at most three similar names, for the end of a message; "" without any."""
    close = difflib.get_close_matches(name, list(names), n=3, cutoff=0.5)
    return f"; did you mean {', '.join(close)}?" if close else ""


def split_assignment(text: str, form: str, where: str) -> tuple[str, str]:
    """Key and value of an option such as KEY=VALUE, without blanks around them.

    Raises:
        ParameterError: If there is no '='.
    """
    key, equals, value = text.partition("=")
    if not equals:
        raise ParameterError(f"found '{text}'; expected {form}", where=where)
    return composed(key.strip()), value.strip()
