"""Wording of findings about changes of the machine between sessions."""

from __future__ import annotations

import math
from collections.abc import Sequence

from orthocal.assessment.wording import joined, plain, signed
from orthocal.calibration.assessment_record import Finding, Place
from orthocal.hypotheses.sessions.change_records import Change, Changes, OtherChange, TestedChange
from orthocal.session.session import Session

LEAST_CHANCE = 1e-4
"""Probability below which no number is printed."""


def describe_changes(session: Session, changes: Changes) -> Finding:
    """Changes between sessions; or that there is none, and from which size on it would be seen."""
    if changes.found:
        return _parts(session, changes)
    if changes.other is not None:
        return _unexplained(session, changes, changes.other)
    return _no_change(session, changes)


def _parts(session: Session, changes: Changes) -> Finding:
    """Drives and legs that have changed."""
    listed = joined([_describe(changes, c) for c in changes.found])
    text = f"The machine changed between the sessions: {listed}."
    first = changes.found[0]
    unsure = [f"{c.name} from {joined(c.perhaps, 'or')}" for c in changes.found if c.perhaps]
    if unsure:
        text += f" These readings do not distinguish {joined(unsure)}."
    if first.perhaps_since:
        text += f" It may also be so since {joined(first.perhaps_since, 'or')}."
    numbers = {}
    for c in changes.found:
        numbers[f"{c.name}_by_{c.edge_unit}"] = c.size * c.edge_factor
        numbers[f"{c.name}_std_{c.edge_unit}"] = c.std * c.edge_factor
    last = max((c.since for c in changes.found), key=changes.sessions.index)
    file = _file_of(session, changes, last)
    action = _apart(changes, last)
    unstated = _unstated(session, changes)
    if unstated and all(c.part == "drive" for c in changes.found):
        action = (
            f"State the offsets that were active (`controller.offsets_mm`) in {joined(unstated)}: "
            f"if others had been entered, that is the reason. Otherwise: {_lower(action)}"
        )
    else:
        action += _offsets_first(changes, last)
    return Finding(
        "machine changed",
        "review",
        text,
        action,
        numbers,
        tuple(Place(file=file, parameter=c.name) for c in changes.found),
    )


def _describe(changes: Changes, change: Change) -> str:
    """A change: what, by how much, since when."""
    size = f"{signed(change.size * change.edge_factor)} ± {plain(change.std * change.edge_factor)}"
    offset = change.part == "drive" and change.name.endswith(".offset")
    what, verb = (change.of, "moved") if offset else (change.name, "changed")
    before = changes.sessions[changes.sessions.index(change.since) - 1]
    return f"{what} {verb} by {size} {change.edge_unit} between {before} and {change.since}"


def _unexplained(session: Session, changes: Changes, other: OtherChange) -> Finding:
    """Sessions that are not of one machine, for another reason than a drive or a leg."""
    before = changes.sessions[changes.sessions.index(other.since) - 1]
    if other.parts:
        what = f"{joined(other.parts, 'or')} changed; no offset of a drive explains it"
    else:
        what = (
            "no single drive or leg explains it: several parts changed, or a gauge was displaced "
            "while it was read"
        )
    less = "less than " if other.chance < LEAST_CHANCE else ""
    file = _file_of(session, changes, other.since)
    return Finding(
        "machine changed",
        "review",
        f"The sessions up to {before} and from {other.since} on are not of one machine (chance "
        f"{less}{max(other.chance, LEAST_CHANCE):.2%}): {what}.",
        _apart(changes, other.since) + _offsets_first(changes, other.since),
        {"chance": other.chance},
        () if file is None else (Place(file=file),),
    )


def _apart(changes: Changes, since: str) -> str:
    later = changes.sessions[changes.sessions.index(since) :]
    if len(later) == 1:
        which = f"{later[0]} alone"
    else:
        which = f"{joined(later)} together, without those before"
    return f"Calibrate {which}: the values to enter must belong to the machine as it is now."


def _offsets_first(changes: Changes, since: str) -> str:
    later = changes.sessions[changes.sessions.index(since) :]
    states = "states" if len(later) == 1 else "state"
    return (
        f" But first make sure that {joined(later)} {states} the active offsets "
        "(`controller.offsets_mm`): offsets entered in between look the same."
    )


def _no_change(session: Session, changes: Changes) -> Finding:
    offsets = {f"{drive.name}.offset" for drive in session.robot.drives}
    tested = [t for t in changes.tested if t.name in offsets]
    seen = [t for t in tested if math.isfinite(changes.seen_from(t))]
    unseen = dict.fromkeys(t.name.removesuffix(".offset") for t in tested if t not in seen)
    if not seen:
        why = (
            "the noise of the readings is unknown"
            if changes.dof == 0.0
            else "the sessions have too few setups and postures in common"
        )
        return Finding(
            "change unknown",
            "note",
            f"Whether the machine changed between the sessions is unknown: {why}.",
            "Read some of the same setups and postures in each session.",
        )
    sizes = _largest(changes, seen)
    words = joined([f"{plain(size)} {unit}" for unit, size in sizes.items()], "or")
    text = (
        f"No change between the sessions. A change of one offset by {words} would have been "
        "detected."
    )
    if unseen:
        text += f" A change of {joined(tuple(unseen), 'or')} would not."
    return Finding(
        "no change", "note", text, numbers={f"seen_from_{u}": size for u, size in sizes.items()}
    )


def _largest(changes: Changes, tested: Sequence[TestedChange]) -> dict[str, float]:
    """Size from which on each of some changes is detected, by unit."""
    sizes: dict[str, float] = {}
    for t in tested:
        size = changes.seen_from(t) * t.edge_factor
        sizes[t.edge_unit] = max(sizes.get(t.edge_unit, 0.0), size)
    return sizes


def _unstated(session: Session, changes: Changes) -> list[str]:
    """Sessions that do not state the offsets that were active."""
    if len(session.parts) != len(changes.sessions):
        return []
    pairs = zip(changes.sessions, session.parts, strict=True)
    return [label for label, part in pairs if part.controller_offsets is None]


def _file_of(session: Session, changes: Changes, label: str) -> str | None:
    """The session.yaml of a session."""
    if len(session.parts) != len(changes.sessions):
        return None
    path = session.parts[changes.sessions.index(label)].path
    return None if path is None else str(path)


def _lower(sentence: str) -> str:
    return sentence[:1].lower() + sentence[1:]
