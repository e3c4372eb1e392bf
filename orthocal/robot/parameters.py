"""Error parameters of a robot: names, units, tolerances, and the elementary errors they stand for.

An elementary error is one component of the twist δ = (translation, rotation) by which a placement
is off, placement · exp6(δ), or a drive's offset or scale error:

    x_slide.offset    ρ commanded, ρ + Δρ in truth (paper, equation 1)
    x_slide.scale     ρ (1 + s) in truth
    x_coupler.rx      rotation of the placement of joint x_coupler about its own x axis
    frame.tcp.z       translation of frame tcp along its own z axis

A parameter is one elementary error or a named sum of several. All are 0 for the nominal machine.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property
from glob import escape, has_magic
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from orthocal.arguments import require_numbers
from orthocal.errors import ParameterError
from orthocal.text import composed
from orthocal.units import UNIT_SUFFIXES, InUnit, Unit

Kind = Literal["offset", "scale", "translation", "rotation"]

COMPLETE: Literal["complete"] = "complete"
"""A model of every error that changes something."""

LARGEST_TOLERANCE = 200.0
"""Times the robot's own tolerance that no other is: it is in another unit."""

SMALLEST_TOLERANCE = 1e-9
"""[m, rad or 1]. Parameters are scaled by their tolerances: with less they would hardly move."""

AXES = ("x", "y", "z", "rx", "ry", "rz")
"""Components of a twist, translation first."""


@dataclass(frozen=True, slots=True)
class ElementaryError:
    """One component by which one drive, joint placement or frame placement is off."""

    name: str
    kind: Kind
    owner: str
    """Name of the drive, joint or frame."""
    of_frame: bool
    """Whether the owner is a frame, not a joint."""
    axis: int
    """Component of the twist, 0 to 5; -1 for offset and scale."""
    unit: Unit


@dataclass(frozen=True, slots=True)
class Parameter(InUnit):
    """A named error parameter."""

    name: str
    unit: Unit
    tolerance: float
    """One standard deviation, [unit]."""
    terms: tuple[tuple[str, float], ...]
    """Elementary errors it adds to, with coefficients."""


class ParameterSet:
    """All error parameters of a robot, by name, in a fixed order."""

    def __init__(
        self,
        elementary: Iterable[ElementaryError],
        parameters: Iterable[Parameter],
        models: Mapping[str, Sequence[str]],
        *,
        parts: Collection[str] = (),
    ) -> None:
        self.elementary = {e.name: e for e in elementary}
        self._parameters = {p.name: p for p in parameters}
        self._models = dict(models)
        self._parts = frozenset(parts)
        self.find_idle: Callable[[], frozenset[str]] = frozenset
        """Finds the elementary errors that change nothing; asked once, and only when needed."""
        self.own: ParameterSet = self
        """The same with the tolerances of the robot's YAML."""
        self.stated: Mapping[str, float] = {}
        """Tolerances that hold instead of those; see `with_tolerances`."""

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
                f"'{name}' is not an error parameter{_suggest(name, self._parameters)}"
            ) from None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters, in order."""
        return tuple(self._parameters)

    @property
    def models(self) -> tuple[str, ...]:
        """Names of the robot's models."""
        return tuple(self._models)

    def patterns(self, model: str) -> tuple[str, ...]:
        """What a model frees: names and globs, as for `select`.

        Raises:
            ParameterError: If there is no such model.
        """
        if model not in self._models:
            raise ParameterError(
                f"'{model}' is not a model of this robot; models: {', '.join(self._models)}"
            )
        given = self._models[model]
        return tuple(escape(n) for n in self.complete) if given == COMPLETE else tuple(given)

    @cached_property
    def complete(self) -> tuple[str, ...]:
        """Elementary errors of the machine's parts that change something, in order.

        What changes something is found by rank (`find_idle`), not by a list. Sums of errors are no
        further ones.
        """
        return tuple(n for n in self.of_parts if n not in self.idle)

    @cached_property
    def of_parts(self) -> tuple[str, ...]:
        """Elementary errors of drives, joints and where loops end, in order."""
        return tuple(
            e.name for e in self.elementary.values() if not e.of_frame or e.owner in self._parts
        )

    @cached_property
    def idle(self) -> frozenset[str]:
        """Elementary errors that change neither the tool nor what a gauge touches."""
        return self.find_idle()

    def coefficients(self, errors: Sequence[str], names: Sequence[str]) -> NDArray[np.float64]:
        """What one unit of each named parameter adds to each error, (n_errors, n_names).

        Raises:
            ParameterError: If a name is unknown.
        """
        result = np.zeros((len(errors), len(names)))
        for j, name in enumerate(names):
            for term, coefficient in self[name].terms:
                if term in errors:
                    result[list(errors).index(term), j] = coefficient
        return result

    def are_offsets(self, name: str) -> bool:
        """Whether a parameter is an offset of a drive, or of several.

        Raises:
            ParameterError: If the name is unknown.
        """
        return all(self.elementary[term].kind == "offset" for term, _ in self[name].terms)

    def select(self, patterns: Iterable[str]) -> tuple[str, ...]:
        """Names that a list of globs leaves, in the order of the set.

        Each pattern adds the names it matches; one that begins with '!' takes them out again.

        Raises:
            ParameterError: If a pattern matches no parameter.
        """
        chosen: set[str] = set()
        for pattern in patterns:
            without = pattern.startswith("!")
            glob = composed(pattern.removeprefix("!"))
            found = self._matched(glob)
            if not found:
                raise ParameterError(
                    f"'{glob}' matches no error parameter{_suggest(glob, self._parameters)}"
                )
            chosen.difference_update(found) if without else chosen.update(found)
        return tuple(name for name in self._parameters if name in chosen)

    def _matched(self, glob: str) -> list[str]:
        if has_magic(glob):
            return [name for name in self._parameters if fnmatchcase(name, glob)]
        return [glob] if glob in self._parameters else []

    def select_model(self, model: str) -> tuple[str, ...]:
        """Names of the free parameters of a model of the robot's YAML.

        Raises:
            ParameterError: If there is no such model.
        """
        return self.select(self.patterns(model))

    def with_tolerances(self, given: Mapping[str, float]) -> ParameterSet:
        """The same errors, some with other tolerances.

        Args:
            given: Name or glob with its unit, such as `*.offset_mm`, to one standard deviation in
                that unit; they come on top of those that are stated already, and later ones win.

        Raises:
            ParameterError: If a name or unit is unknown, or a number makes no sense.
        """
        stated = {k: v for k, v in self.stated.items() if k not in given} | dict(given)
        if not stated:
            return self
        parameters = {p.name: p for p in self.own}
        for glob, value in self.own.read_tolerances(stated).items():
            for name in self.own.select([glob]):
                size = require_tolerance(value, self.own[name])
                parameters[name] = replace(parameters[name], tolerance=size)
        elementary = self.elementary.values()
        found = ParameterSet(elementary, parameters.values(), self._models, parts=self._parts)
        found.find_idle = lambda: self.idle
        found.own, found.stated = self.own, stated
        return found

    def read_quantity(self, key: str, value: float) -> tuple[str, float]:
        """Parameter name and SI value of a key that carries its unit, such as x_slide.offset_mm.

        Raises:
            ParameterError: If the suffix is missing or of another unit, or the name unknown.
        """
        name, unit, factor = split_unit(key)
        if name not in self._parameters:
            raise ParameterError(
                f"'{name}' is not an error parameter{_suggest(name, self._parameters)}"
            )
        _check_unit(key, unit, self[name])
        return name, value * factor

    def read_glob(self, key: str) -> tuple[str, float]:
        """Glob and factor to SI of a key that carries its unit, such as *.offset_mm.

        Raises:
            ParameterError: If the suffix is missing, or of another unit than what the glob matches.
        """
        glob, unit, factor = split_unit(key)
        for name in self.select([glob]):
            if self[name].unit != unit:
                raise ParameterError(
                    f"'{key}' has the wrong unit; {name} is in {self[name].edge_unit}"
                )
        return glob, factor

    def read_tolerances(self, given: Mapping[str, float]) -> dict[str, float]:
        """Names or globs with their units to numbers, as names or globs to numbers in SI.

        Raises:
            ParameterError: If a name or unit is unknown.
        """
        require_numbers(given, argument="tolerances")
        result = {}
        for key, value in given.items():
            try:
                glob, factor = self.read_glob(key)
            except ParameterError as e:
                raise ParameterError(e.problem, where=e.where or "tolerances") from None
            result[glob] = value * factor
        return result

    def expand(self, values: Mapping[str, float]) -> dict[str, float]:
        """Elementary errors that parameter values amount to; only those that are not zero.

        Args:
            values: Parameter name to value, [unit of the parameter].

        Raises:
            ParameterError: If a name is unknown.
        """
        require_numbers(values, argument="errors")
        total: dict[str, float] = {}
        for name, value in values.items():
            if not math.isfinite(value):
                raise ParameterError(f"'{name}' is {value}; expected a finite number")
            for term, coefficient in self[name].terms:
                total[term] = total.get(term, 0.0) + coefficient * value
        return {name: value for name, value in total.items() if value != 0.0}


def require_tolerance(value: float, parameter: Parameter) -> float:
    """Refuse a standard deviation that no machine's error has.

    Args:
        value: [unit of the parameter].
        parameter: With the robot's own tolerance.

    Raises:
        ParameterError: Naming both.
    """
    unit, factor = parameter.edge_unit, parameter.edge_factor
    if not (math.isfinite(value) and value >= SMALLEST_TOLERANCE):
        raise ParameterError(
            f"the tolerance of '{parameter.name}' is {value * factor:g} {unit}; expected at least "
            f"{SMALLEST_TOLERANCE * factor:g} {unit}"
        )
    if value > LARGEST_TOLERANCE * parameter.tolerance:
        raise ParameterError(
            f"the tolerance of '{parameter.name}' is {value * factor:g} {unit}; expected at most "
            f"{LARGEST_TOLERANCE:g} times the robot's own, {parameter.tolerance * factor:g} {unit}"
        )
    return float(value)


def split_unit(key: str) -> tuple[str, Unit, float]:
    """Name, unit and factor to SI of a key that carries its unit as suffix.

    Raises:
        ParameterError: If there is no known suffix.
    """
    for suffix, (unit, factor) in UNIT_SUFFIXES.items():
        if key.endswith(suffix):
            return key.removesuffix(suffix), unit, factor
    raise ParameterError(
        f"'{key}' carries no unit; expected one of the suffixes {', '.join(UNIT_SUFFIXES)}"
    )


def build_parameters(
    elementary: Sequence[ElementaryError],
    *,
    sums: Mapping[str, Sequence[str]],
    tolerances: Mapping[str, float],
    overrides: Mapping[str, float],
    models: Mapping[str, Sequence[str]],
    parts: Collection[str] = (),
) -> ParameterSet:
    """The parameter set of a robot.

    Args:
        elementary: All elementary errors, in order.
        sums: Name of a sum to names of elementary errors; a leading '-' subtracts.
        tolerances: Keys `offset:m`, `offset:rad`, `translation`, `rotation`, `scale` to one
            standard deviation, [m, rad, m, rad, 1].
        overrides: Parameter name or glob with its unit as suffix to a tolerance; later ones win.
        models: Model name to patterns, or to COMPLETE.
        parts: Frames that are parts of the machine.

    Raises:
        ParameterError: If a name is unknown, taken twice, or of another unit than its sum.
    """
    by_name = {e.name: e for e in elementary}

    def tolerance(error: ElementaryError) -> float:
        key = f"offset:{error.unit}" if error.kind == "offset" else error.kind
        return tolerances[key]

    parameters = {
        e.name: Parameter(e.name, e.unit, tolerance(e), ((e.name, 1.0),)) for e in elementary
    }
    for name, members in sums.items():
        if name in parameters:
            raise ParameterError(f"parameters.{name}: this name is taken by an elementary error")
        terms: dict[str, float] = {}
        for member in members:
            plain = member.removeprefix("-")
            if plain not in by_name:
                raise ParameterError(
                    f"parameters.{name}: '{plain}' is not an elementary error"
                    f"{_suggest(plain, by_name)}"
                )
            if plain in terms:
                raise ParameterError(f"parameters.{name}: '{plain}' stands twice")
            terms[plain] = -1.0 if plain != member else 1.0
        first = by_name[next(iter(terms))]
        for plain in terms:
            if by_name[plain].unit != first.unit:
                raise ParameterError(
                    f"parameters.{name}: '{plain}' is in {by_name[plain].unit}, "
                    f"'{first.name}' in {first.unit}; a sum needs one unit"
                )
        parameters[name] = Parameter(name, first.unit, tolerance(first), tuple(terms.items()))
    for key, value in overrides.items():
        glob, unit, factor = split_unit(key)
        found = [name for name in parameters if fnmatchcase(name, glob)]
        if not found:
            raise ParameterError(
                f"tolerances.overrides: '{glob}' matches no error parameter"
                f"{_suggest(glob, parameters)}"
            )
        for name in found:
            old = parameters[name]
            _check_unit(key, unit, old)
            parameters[name] = Parameter(name, old.unit, value * factor, old.terms)
    result = ParameterSet(elementary, parameters.values(), models, parts=parts)
    for model, patterns in models.items():
        if patterns == COMPLETE:
            continue
        try:
            chosen = result.select(patterns)
        except ParameterError as e:
            raise ParameterError(f"models.{model}: {e.problem}") from None
        if not chosen:
            raise ParameterError(f"models.{model}: leaves no error parameter free")
    return result


def _check_unit(key: str, unit: Unit, parameter: Parameter) -> None:
    if unit != parameter.unit:
        raise ParameterError(
            f"'{key}' has the wrong unit; {parameter.name} is in {parameter.edge_unit}"
        )


def _suggest(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), n=3, cutoff=0.5)
    return f"; did you mean {', '.join(close)}?" if close else ""
