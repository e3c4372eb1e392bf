"""Settings of a printer's firmware that were active in a log instead of those that it states.

A log states positions p of the nozzle. The stated settings s assign the carriages s⁻¹(p) to them.
With other settings a, the carriages were at a⁻¹(p), and the nozzle was at

    s(a⁻¹(p))

within the errors of the stated settings.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import SessionError
from orthocal.hypotheses.anomaly import AnomalyKind, Explanation
from orthocal.hypotheses.families.artefacts import nuisance_columns
from orthocal.hypotheses.hypothesis import Family, Patterns, sparse_rows
from orthocal.hypotheses.joined_sessions import divide_sessions
from orthocal.hypotheses.linear_model import LinearModel
from orthocal.measurement.joining import settings_of_sessions
from orthocal.observation.sensor_groups import fixed_parameters
from orthocal.printers.settings import EQUAL, DeltaSettings
from orthocal.sensors.protocol import reads_pairs, states_readings
from orthocal.session.session import Session, split_label

PARTS = {
    "radius": [0],
    "rods": [1, 2, 3],
    "tower angles": [4, 5, 6],
    "endstops": [7, 8, 9],
    "tilts of the bed": [10, 11],
}
"""Parts of the settings, with their indices in `_to_vector`."""

OF_ONE_TOWER = {"rod": "rods", "angle of tower": "tower angles", "endstop": "endstops"}
"""Names of settings of one tower, and their parts."""

Mistake = tuple[AnomalyKind, tuple[str, ...], Array]
"""Kind of mistake, names of the settings concerned (none: all of them), and the active settings as
in `_to_vector`."""


def changes_between_logs(model: LinearModel) -> Iterator[Family]:
    """Changes between the logs of a printer: of its active settings, or of its bed."""
    if len(model.sessions.labels) > 1 and model.problem.session.firmware is not None:
        yield _wrong_settings(model)
        yield _moved_bed(model)


def _wrong_settings(model: LinearModel) -> Family:
    """Settings of an earlier log that were active in a later one, or interchanged settings."""
    session = model.problem.session
    settings_of = settings_of_sessions(session)
    explanations, rows, changes = [], [], []
    before: DeltaSettings | None = None
    for label in model.sessions.ordered_labels:
        stated = settings_of.get(label)
        if stated is None:
            continue
        log = _Log.of(session, label, stated)
        mistakes = () if before is None else enter_settings_wrongly(before, stated)
        for kind, names, active in mistakes if log.rows else ():
            with suppress(SessionError):  # rods that do not reach a point
                changes.append(-log.excess(_from_vector(stated, active)))
                rows.append(log.rows)
                explanations.append(Explanation(kind, "session", names=names, sessions=(label,)))
        before = stated
    edits = Patterns(sparse_rows(rows, changes, len(session.readings)))
    return Family.of(explanations, edits=edits)


def _moved_bed(model: LinearModel) -> Family:
    """A bed with another tilt and form from a log on."""
    session = model.problem.session
    names, of_printer = model.problem.free[model.problem.n_machine :], fixed_parameters(session)
    fixed = [i for i, name in enumerate(names) if name in of_printer]
    columns = nuisance_columns(model)[fixed]
    label_of_row = [split_label(r.setup, joined=True)[0] for r in session.readings]
    explanations, groups = [], []
    for sessions, apart in divide_sessions(model.sessions.order):
        labels = tuple(model.sessions.labels[k] for k in sessions)
        later = np.isin(label_of_row, labels)
        sizes = [np.abs(columns[:, rows]).max(axis=1, initial=0.0) for rows in (later, ~later)]
        shared = np.minimum(*sizes) > model.sigma
        if shared.any() and not apart:
            explanations.append(Explanation("bed moved", "session", sessions=labels[:1]))
            groups.append(np.where(later, columns, 0.0)[shared] / sizes[0][shared, None])
    return Family.of(explanations, groups=groups)


def enter_settings_wrongly(before: DeltaSettings, stated: DeltaSettings) -> Iterator[Mistake]:
    """Settings that a firmware may have instead of the stated ones, each set once.

    There are none if the stated settings equal the previous ones.

    Args:
        before: Previous settings.
        stated: Settings that were to be entered.
    """
    old, new = _to_vector(before), _to_vector(stated)
    seen = [new]
    if np.abs(old - new).max() <= EQUAL:
        return
    for kind, names, active in (*_keep(old, new, stated), *_interchange(new)):
        if min(np.abs(active - other).max() for other in seen) > EQUAL:
            seen.append(active)
            yield kind, names, active


def _keep(old: Array, new: Array, stated: DeltaSettings) -> Iterator[Mistake]:
    """Settings of which all, those of one command, some parts, or a single one are the old ones."""
    kind: AnomalyKind = "settings not entered"
    yield kind, (), old
    if stated.firmware != "klipper":
        trims = PARTS["endstops"]
        height = np.mean if stated.firmware == "reprapfirmware" else np.min
        lifted = height(new[trims]) - height(old[trims])
        for name, kept, added in (
            ("values of M665", range(7), -lifted),
            ("values of M666", range(7, 12), lifted),
        ):
            active = _replaced(new, kept, old)
            active[trims] += added
            yield kind, (name,), active
    for count in range(1, len(PARTS)):
        for names in combinations(PARTS, count):
            yield kind, names, _replaced(new, [k for name in names for k in PARTS[name]], old)
    for name, part in OF_ONE_TOWER.items():
        for k, tower in zip(PARTS[part], "abc", strict=True):
            yield kind, (f"{name} {tower}",), _replaced(new, [k], old)


def _interchange(new: Array) -> Iterator[Mistake]:
    """Endstops or rods of two towers, interchanged."""
    for name in ("rods", "endstops"):
        for one, other in combinations(range(3), 2):
            active, places = new.copy(), PARTS[name]
            active[[places[one], places[other]]] = new[[places[other], places[one]]]
            towers = f"{name} of towers {'abc'[one]} and {'abc'[other]}"
            yield "settings interchanged", (towers,), active


def _replaced(new: Array, places: Sequence[int], old: Array) -> Array:
    """Copy of settings with the old ones in some places."""
    mixed = new.copy()
    mixed[list(places)] = old[list(places)]
    return mixed


def _to_vector(s: DeltaSettings) -> Array:
    """Radius, rods, angles, endstops and tilts, shape (12,), [m, rad, 1]."""
    return np.array([s.radius, *s.rods, *s.angles, *s.endstops, *s.tilts])


def _from_vector(stated: DeltaSettings, values: Array) -> DeltaSettings:
    """Settings with the homed carriages of the stated ones, from a vector as in `_to_vector`."""
    radius, *others = values.tolist()
    settings = replace(
        stated,
        radius=radius,
        rods=tuple(others[:3]),
        angles=tuple(others[3:6]),
        tilts=tuple(others[9:]),
        shift=(0.0, 0.0, 0.0),
    )
    homed = settings.middle + others[6:9]
    settings = replace(settings, homed=tuple(homed.tolist()))
    return settings.moved(np.array(stated.homed) - homed)


@dataclass(frozen=True, slots=True, eq=False)
class _Log:
    """Readings of a log that depend on the positions of the nozzle."""

    settings: DeltaSettings
    """Stated settings."""
    rows: list[int]
    """Rows of probed heights and printed distances."""
    carriages: Array
    """Coordinates of the carriages in both postures of each row, equal for a height,
    shape (n, 2, 3), [m]."""
    heights: Array
    """Mask of rows with heights, shape (n,)."""

    @classmethod
    def of(cls, session: Session, label: str, settings: DeltaSettings) -> _Log:
        """Log of a session with a label."""
        rows, carriages, heights = [], [], []
        for i, r in enumerate(session.readings):
            sensor = session.setups[r.setup].sensor
            probed = states_readings(sensor) and r.minus is None
            measured = reads_pairs(sensor)
            if (probed or measured) and split_label(r.setup, joined=True)[0] == label:
                rows.append(i)
                postures = r.posture, r.minus or r.posture
                carriages.append([session.postures[p].drives for p in postures])
                heights.append(probed)
        return cls(settings, rows, np.array(carriages), np.array(heights, dtype=bool))

    def excess(self, active: DeltaSettings) -> Array:
        """Excess of the readings by active settings that are not the stated ones, shape (n,), [m].

        Raises:
            SessionError: If the rods of the active settings do not reach a position.
        """
        stated = self.settings.forward(self.carriages.reshape(-1, 3))
        actual = self.settings.forward(active.inverse(stated))
        stated, actual = (p.reshape(-1, 2, 3) for p in (stated, actual))
        lengths = [np.linalg.norm(p[:, 0] - p[:, 1], axis=1) for p in (stated, actual)]
        heights = actual[:, 0, 2] - stated[:, 0, 2]
        return np.where(self.heights, heights, lengths[1] - lengths[0])
