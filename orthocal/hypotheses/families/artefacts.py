"""Artefacts of sensors at the tool: displaced between setups, or with a wrong stated dimension.

Setups share an artefact, such as the fixed ball of a bar, a square, or the station of a tracker. If
it is displaced before a setup, its placement and its errors have new values in all later setups. A
square that was turned over without a statement is such a case: its error changes its sign.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.hypotheses.anomaly import Explanation, Scope
from orthocal.hypotheses.hypothesis import Family, Rows
from orthocal.hypotheses.linear_model import CACHE_SIZE, LinearModel
from orthocal.observation.model import predict_readings
from orthocal.observation.sensor_groups import nuisance_parameters
from orthocal.sensors.protocol import DIMENSION_STEP, stated_dimensions
from orthocal.session.session import Session, Setup, split_label

MIN_RELATIVE_CHANGE = 0.5
"""Smallest change of the readings by one prior std of a considered parameter, relative to the
noise."""


def wrong_artefacts(model: LinearModel, rows: Rows) -> Iterator[Family]:
    """Artefacts displaced between setups, and dimensions that differ from the stated ones.

    A dimension may differ in all setups of a gauge from a session on, such as the length of a bar.

    Args:
        model: The linearised model.
        rows: The rows.
    """
    yield _displaced(model, rows)
    yield _other_dimensions(model, rows)
    yield _readjusted(model, rows)


def shared_placements(session: Session) -> dict[str, dict[str, Indices]]:
    """Nuisance parameters of artefacts that several setups share.

    Returns:
        Artefact, such as `ball.post`, to setup, to indices of the artefact's parameters among the
        nuisance parameters of the session.
    """
    shared: dict[str, dict[str, Indices]] = {}
    nuisance = nuisance_parameters(session)
    for setup, indices in zip(session.setups.values(), nuisance.of_setup, strict=True):
        label, _ = split_label(setup.name, joined=session.joined)
        indices_by_artefact: dict[str, list[int]] = {}
        for u, i in zip(setup.sensor.nuisance_parameters, indices, strict=False):
            if u.shared_by is not None and not u.of_gauge:
                artefact = ".".join(u.shared_by.split(".")[:2])
                indices_by_artefact.setdefault(f"{label}/{artefact}".lstrip("/"), []).append(i)
        for artefact, of_artefact in indices_by_artefact.items():
            shared.setdefault(artefact, {})[setup.name] = np.array(of_artefact)
    return {artefact: setups for artefact, setups in shared.items() if len(setups) > 1}


def _displaced(model: LinearModel, rows: Rows) -> Family:
    """An artefact displaced before a setup: all its parameters have new values from there on."""
    explanations, groups = [], []
    columns = nuisance_columns(model)
    for artefact, placements in shared_placements(rows.session).items():
        names = sorted(placements, key=lambda name: rows.setups[name][0])
        for k in range(1, len(names)):
            later = names[k:]
            later_rows = rows.of_setups(later)
            if rows.of_setups(names[:k]).max() > later_rows.min():
                continue
            parameters = np.unique(np.concatenate([placements[name] for name in later]))
            changes = np.zeros((parameters.size, rows.count))
            changes[:, later_rows] = columns[np.ix_(parameters, later_rows)]
            sizes = np.abs(changes).max(axis=1)
            visible = sizes > MIN_RELATIVE_CHANGE * model.sigma
            if visible.any():
                concerned, setups = tuple(later_rows.tolist()), tuple(later)
                explanations.append(
                    Explanation("displaced artefact", "setups", concerned, setups, (artefact,))
                )
                groups.append(changes[visible] / sizes[visible, None])
    return Family.of(explanations, groups=groups)


def _other_dimensions(model: LinearModel, rows: Rows) -> Family:
    """A wrong stated dimension in one setup, or in all setups that state it."""
    return _with_dimensions(
        rows,
        [
            (Explanation("wrong dimension", "setups", (), setups, dimension), changes)
            for dimension, changes in dimension_changes(model).items()
            for setups in _each_and_all(changes)
        ],
    )


def _readjusted(model: LinearModel, rows: Rows) -> Family:
    """A dimension that differs in several setups of a gauge from one session on."""
    session = rows.session
    label = dict(zip(session.setups, session.labels, strict=True))
    labels = model.sessions.ordered_labels
    explained = []
    for dimension, changes in dimension_changes(model).items():
        gauges: dict[str, list[str]] = {}
        for name in changes:
            _, gauge = split_label(session.setups[name].gauge, joined=session.joined)
            gauges.setdefault(gauge, []).append(name)
        for of_gauge in gauges.values():
            for k in range(1, len(labels)):
                later = labels[k:]
                setups = tuple(n for n in of_gauge if label[n] in later)
                if not 1 < len(setups) < len(of_gauge):  # one setup: `_other_dimensions`
                    continue
                names, since = (*dimension, later[0]), (later[0],)
                e = Explanation("readjusted dimension", "setups", (), setups, names, sessions=since)
                explained.append((e, changes))
    return _with_dimensions(rows, explained)


def _with_dimensions(
    rows: Rows, explained: Sequence[tuple[Explanation, Mapping[str, Array]]]
) -> Family:
    """Family of other dimensions.

    Args:
        rows: The rows.
        explained: Explanations without rows, and the changes of the rows by each setup that states
            the dimension.
    """
    explanations, shapes = [], []
    for e, changes in explained:
        change = np.sum([changes[name] for name in e.setups], axis=0)
        concerned = np.flatnonzero(change)
        scope: Scope = "setup" if len(e.setups) == 1 else "setups"
        explanations.append(replace(e, scope=scope, rows=tuple(concerned.tolist())))
        shapes.append(change[concerned])
    return Family.with_effects(rows, explanations, shapes)


@lru_cache(maxsize=CACHE_SIZE)
def nuisance_columns(model: LinearModel) -> Array:
    """Change of the rows by one prior std of each nuisance parameter, [m].

    The shape is (n_nuisance, n_rows). The machine has no errors. Gauge zeros are not projected out.
    """
    problem = model.problem
    passive = model.at_reference(keep_jacobian=False).passive
    _, jacobian = problem.predict_and_jacobian(problem.active_theta, passive)
    columns = jacobian[:, problem.n_machine :] * problem.noise_ratio[:, None]
    return problem.observations.rows(columns).T


@lru_cache(maxsize=CACHE_SIZE)
def dimension_changes(model: LinearModel) -> Mapping[tuple[str, str], Mapping[str, Array]]:
    """Derivative of the rows with respect to each dimension that setups state.

    The machine has no errors.

    Returns:
        Key of the dimension and its stated value, to setup, to the derivative, shape (n_rows,).
    """
    session, o = model.problem.session, model.problem.observations
    setups = {r.setup: session.setups[r.setup] for r in session.readings}
    enlarged: dict[str, Setup] = {}
    dimensions: dict[str, tuple[str, str]] = {}
    for name, setup in setups.items():
        for key, sensor in stated_dimensions(setup.sensor).items():
            enlarged[name] = replace(setup, sensor=sensor)
            dimensions[name] = key, _stated_value(setup.sensor.to_keys(), key)
    if not enlarged:
        return {}
    other = replace(session, setups={**session.setups, **enlarged})
    passive = model.at_reference(keep_jacobian=False).passive
    stated, changed = (
        o.rows(predict_readings(s, observations=o, passive=passive)) for s in (session, other)
    )
    change = (changed - stated) / DIMENSION_STEP
    changes: dict[tuple[str, str], dict[str, Array]] = {}
    for name, dimension in dimensions.items():
        of_setup = [r.setup == name for r in session.readings]
        changes.setdefault(dimension, {})[name] = np.where(of_setup, change, 0.0)
    return changes


def _stated_value(keys: Mapping[str, Any], key: str) -> str:
    """Value of a key of a setup such as artefact.height_mm, as text."""
    first, _, others = key.partition(".")
    return _stated_value(keys[first], others) if others else f"{keys[first]:g}"


def _each_and_all(changes: Mapping[str, Array]) -> list[tuple[str, ...]]:
    """Each setup alone, and all of them if there are several."""
    each: list[tuple[str, ...]] = [(name,) for name in changes]
    return [*each, tuple(changes)] if len(each) > 1 else each
