"""Choice of the free parameters by the user, with units in the keys of numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from orthocal.arguments import require_kind, require_names, require_numbers
from orthocal.errors import ParameterError, errors_at
from orthocal.estimation.selection import (
    KnownWithStd,
    KnownWithTolerance,
    Selection,
    complete_model,
    label_choice,
    select_parameters,
)
from orthocal.estimation.tolerance_scale import AS_STATED, ToleranceScale
from orthocal.robot.parameters import ParameterSet
from orthocal.session.session import Purpose, Session
from orthocal.units import read_limit


@dataclass(frozen=True, slots=True)
class Choice:
    """Free errors of the machine, their priors, known values and bounds.

    Keys of numbers end with the unit, as on the command line: {"x_leg.length_mm": 0.12}.
    `orthocal.units.UNIT_SUFFIXES` has all suffixes, such as _mm, _mrad and _ppm.

    Args:
        model: A model of the robot's YAML: `offsets`, `lengths`, `full` or another. By default
            that of the session, otherwise the complete model.
        free: Names or globs to add to the model. Without a model they are the only free errors.
            '!' excludes.
        prior: Use priors; by default True, unless only offsets are free.
        known: Names with unit, mapped to a known value, which is fixed, or to a value and its
            tolerance (±2 prior standard deviations), which become the prior.
        tolerances: Names or globs with unit, mapped to tolerances (±2 prior standard deviations)
            that replace those of the session or robot, also where readings are judged.
        bounds: Names or globs with unit, mapped to lowest and highest value, ±inf for open.
        base: Identify base parameters without priors. One parameter of each indistinguishable
            combination remains free and represents the combination.
        effects: Effects in addition to geometry, such as `backlash`. Every model identifies their
            errors. By default those of the session, otherwise those of the robot's YAML.

    Raises:
        TypeError: If an argument has a wrong type.
    """

    model: str | None = None
    free: Sequence[str] = ()
    prior: bool | None = None
    known: Mapping[str, KnownWithTolerance] = field(default_factory=dict)
    tolerances: Mapping[str, float] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    base: bool = False
    effects: Sequence[str] | None = None

    def __post_init__(self) -> None:
        require_kind(self.model, (str, type(None)), expected="the name of a model")
        object.__setattr__(self, "free", require_names(self.free, argument="free"))
        if self.effects is not None:
            effects = require_names(self.effects, argument="effects")
            object.__setattr__(self, "effects", effects)
        require_numbers(self.known, argument="known", counts=(1, 2))
        require_numbers(self.tolerances, argument="tolerances")
        require_numbers(self.bounds, argument="bounds", counts=(2,))
        if not isinstance(self.prior, bool | None):
            kind = type(self.prior).__name__
            raise TypeError(f"prior: found a {kind}; expected True, False or None")
        if not isinstance(self.base, bool):
            raise TypeError(f"base: found a {type(self.base).__name__}; expected True or False")
        # a value and its tolerance are a list in JSON and YAML
        known = {k: tuple(v) if isinstance(v, list) else v for k, v in self.known.items()}
        object.__setattr__(self, "known", known)

    @property
    def document(self) -> dict[str, Any]:
        """Choice as plain data."""
        return asdict(self)

    def applied_to(self, session: Session) -> Session:
        """Session whose robot has the chosen effects and tolerances.

        Raises:
            ParameterError: If an effect or a tolerance is not valid.
            RobotError: If an effect needs keys that the robot's YAML lacks.
        """
        if self.effects is not None:
            session = session.with_effects(self.effects)
        return session.with_tolerances(self.tolerances)

    def select(
        self, parameters: ParameterSet, *, tolerance_scale: ToleranceScale = AS_STATED
    ) -> Selection:
        """Select the free parameters of a robot, in SI.

        Args:
            parameters: Parameters of the robot.
            tolerance_scale: Factor on their tolerances.

        Raises:
            ParameterError: If a name, unit, glob or model is unknown, one is stated twice, a known
                value, tolerance or bound is invalid, or a tolerance has no effect.
        """
        parameters = parameters.with_tolerances(self.tolerances)
        with_tolerance = [key for key, value in self.known.items() if isinstance(value, tuple)]
        if self.base and (self.prior or with_tolerance):
            listed = ", ".join(with_tolerance)
            raise ParameterError(
                "base parameters are identified without any prior"
                + (f"; state {listed} as known without ±" if listed else ""),
                where="base",
            )
        selection = select_parameters(
            parameters,
            model=self.model,
            free=self.free,
            prior=self.prior,
            known=_known_in_si(self.known, parameters),
            bounds=_bounds_in_si(self.bounds, parameters),
            tolerance_scale=tolerance_scale,
        )
        _require_used(self.tolerances, parameters, selection)
        return selection


def resolve_choice(
    choice: Choice | str | None, session: Session | None, *, default_model: str | None = None
) -> Choice:
    """Choice of the user; otherwise the model of the session; otherwise the default model.

    Args:
        choice: A choice, or the name of a model.
        session: The measured session, or several joined ones.
        default_model: Model if neither states one; the complete model by default.

    Raises:
        ParameterError: If no model is chosen and the joined sessions state different ones.
        TypeError: If an argument has a wrong type.
    """
    require_kind(choice, (Choice, str, type(None)), expected="a Choice, or the name of a model")
    chosen = choice if isinstance(choice, Choice) else Choice(choice)
    if chosen.model is not None or chosen.free:
        return chosen
    sessions = () if session is None else session.parts or (session,)
    purposes = {s.purpose: s for s in sessions if s.purpose is not None}
    if len(purposes) > 1:
        models = "; ".join(
            f"{label_choice(p.model, p.free)} in {s.path or s.title}" for p, s in purposes.items()
        )
        problem = f"sessions are for different models: {models}; choose one"
        raise ParameterError(problem, where="model")
    if default_model is None and session is not None:
        default_model = complete_model(session.robot.parameters)
    purpose = next(iter(purposes), Purpose(default_model))
    return replace(chosen, model=purpose.model, free=purpose.free)


def _require_used(
    tolerances: Mapping[str, float], parameters: ParameterSet, selection: Selection
) -> None:
    """Refuse tolerances of sums that are not free. Such sums have the tolerances of their terms."""
    used = {*selection.names, *parameters.elementary}
    for key in tolerances:
        glob, _ = parameters.read_glob(key)
        if used.isdisjoint(parameters.select([glob])):
            raise ParameterError(
                f"'{glob}' matches only sums that are not free; state tolerances of their terms",
                where="tolerances",
            )


def _known_in_si(
    known: Mapping[str, KnownWithTolerance], parameters: ParameterSet
) -> dict[str, KnownWithStd]:
    """Known values, or pairs of value and prior standard deviation, by name, [SI]."""
    result: dict[str, KnownWithStd] = {}
    for key, value in known.items():
        with errors_at("known"):
            name, factor = parameters.read_quantity(key, 1.0)
        if name in result:
            raise ParameterError(f"'{name}' is stated twice", where="known")
        if isinstance(value, tuple):
            result[name] = (value[0] * factor, read_limit(value[1]) * factor)
        else:
            result[name] = value * factor
    return result


def _bounds_in_si(
    bounds: Mapping[str, tuple[float, float]], parameters: ParameterSet
) -> dict[str, tuple[float, float]]:
    """Lowest and highest values by name or glob, [SI]."""
    result: dict[str, tuple[float, float]] = {}
    for key, (low, high) in bounds.items():
        with errors_at("bounds"):
            glob, factor = parameters.read_glob(key)
            if glob in result:
                raise ParameterError(f"'{glob}' is stated twice")
        result[glob] = (low * factor, high * factor)
    return result
