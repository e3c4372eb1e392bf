"""Artefacts of sensors at the tool: displaced between setups, or with a wrong stated dimension.

Setups share an artefact, such as the fixed ball of a bar, a square, or the station of a tracker. If
it is displaced before a setup, its placement and its errors have new values in all later setups. A
square that was turned over without a statement is such a case: its error changes its sign.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.hypotheses.anomaly import Explanation, Scope
from orthocal.hypotheses.hypothesis import Family, Rows
from orthocal.hypotheses.linear_model import LinearModel
from orthocal.hypotheses.row_changes import dimension_changes, nuisance_columns
from orthocal.observation.sensor_groups import nuisance_parameters
from orthocal.session.session import Session, split_label

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
    explained = []
    for dimension, changes in dimension_changes(model).items():
        gauges: dict[str, list[str]] = {}
        for name in changes:
            _, gauge = split_label(session.setups[name].gauge, joined=session.joined)
            gauges.setdefault(gauge, []).append(name)
        for of_gauge in gauges.values():
            for k in range(1, len(model.order)):
                later = [model.labels[i] for i in model.order[k:]]
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


def _each_and_all(changes: Mapping[str, Array]) -> list[tuple[str, ...]]:
    """Each setup alone, and all of them if there are several."""
    each: list[tuple[str, ...]] = [(name,) for name in changes]
    return [*each, tuple(changes)] if len(each) > 1 else each
