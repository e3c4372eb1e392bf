"""Whether sessions that were calibrated together are of one machine."""

from __future__ import annotations

import math
from collections.abc import Sequence

from orthocal.assessment.findings.finding import Finding, Place
from orthocal.assessment.wording import joined, plain, signed
from orthocal.calibration.calibration import Calibration
from orthocal.hypotheses.sessions.change_records import Change, Changes, OtherChange, TestedChange

LEAST_CHANCE = 1e-4
"""Probability below which it is not told how small it is."""


def find_machine_changes(calibration: Calibration) -> list[Finding]:
    """What has changed between sessions; or that nothing has, and what would have been seen.

    A setup that was read with the wrong sign is its own reason why sessions differ.
    """
    changes = calibration.changes
    if changes is None or calibration.turned is not None:
        return []
    if changes.found:
        return [_moved(calibration, changes)]
    if changes.other is not None:
        return [_otherwise(calibration, changes, changes.other)]
    return [_nothing(calibration, changes)]


def _moved(calibration: Calibration, changes: Changes) -> Finding:
    """Drives and legs that have changed."""
    told = [_told(changes, c) for c in changes.found]
    text = f"The machine changed between the sessions: {joined(told)}."
    first = changes.found[0]
    unsure = [f"{c.name} from {joined(c.perhaps, 'or')}" for c in changes.found if c.perhaps]
    if unsure:
        text += f" These readings cannot tell {joined(unsure)}."
    if first.perhaps_since:
        text += f" It may as well be so since {joined(first.perhaps_since, 'or')}."
    numbers = {}
    for c in changes.found:
        numbers[f"{c.name}_by_{c.edge_unit}"] = c.size * c.edge_factor
        numbers[f"{c.name}_std_{c.edge_unit}"] = c.std * c.edge_factor
    last = max((c.since for c in changes.found), key=changes.sessions.index)
    file = _file_of(calibration, changes, last)
    action = _apart(changes, last)
    unstated = _unstated(calibration, changes)
    if unstated and all(c.part == "drive" for c in changes.found):
        action = (
            f"Say which offsets were active (`controller.offsets_mm`) in {joined(unstated)}: if "
            f"others had been entered, it is that. Else: {action[0].lower()}{action[1:]}"
        )
    else:
        action += _see_first(changes, last)
    return Finding(
        "machine changed",
        "stops",
        text,
        action,
        numbers,
        tuple(Place(file=file, parameter=c.name) for c in changes.found),
    )


def _told(changes: Changes, change: Change) -> str:
    """A change in words: what, by how much, since when."""
    size = f"{signed(change.size * change.edge_factor)} ± {plain(change.std * change.edge_factor)}"
    verb = "moved" if change.part == "drive" else "changed"
    what = change.of if change.part == "drive" else change.name
    if change.part == "drive" and not change.name.endswith(".offset"):
        what, verb = change.name, "changed"
    before = changes.sessions[changes.sessions.index(change.since) - 1]
    return f"{what} {verb} by {size} {change.edge_unit} between {before} and {change.since}"


def _otherwise(calibration: Calibration, changes: Changes, other: OtherChange) -> Finding:
    """Sessions that are not of one machine, for another reason than a drive or a leg."""
    before = changes.sessions[changes.sessions.index(other.since) - 1]
    if other.parts:
        parts = joined(other.parts, "or")
        what = f"something of {parts} changed, and no offset of a drive explains it"
    else:
        what = (
            "no single drive or leg explains how: several parts changed, or a gauge moved while "
            "it was read"
        )
    chance = max(other.chance, LEAST_CHANCE)
    less = "less than " if other.chance < LEAST_CHANCE else ""
    text = (
        f"The sessions up to {before} and from {other.since} on are not of one machine (chance "
        f"{less}{chance:.2%}): {what}."
    )
    file = _file_of(calibration, changes, other.since)
    return Finding(
        "machine changed",
        "stops",
        text,
        _apart(changes, other.since) + _see_first(changes, other.since),
        {"chance": other.chance},
        () if file is None else (Place(file=file),),
    )


def _apart(changes: Changes, since: str) -> str:
    """Which sessions to calibrate by themselves."""
    later = changes.sessions[changes.sessions.index(since) :]
    if len(later) == 1:
        which = f"{later[0]} alone"
    else:
        which = f"{joined(later)} together, without those before"
    return f"Calibrate {which}: what is entered must be of the machine as it is now."


def _see_first(changes: Changes, since: str) -> str:
    """What looks like a change: offsets that were entered, and are not told."""
    later = changes.sessions[changes.sessions.index(since) :]
    return (
        f" But first make sure that {joined(later)} {'says' if len(later) == 1 else 'say'} which "
        "offsets were active (`controller.offsets_mm`): those that were entered since look alike."
    )


def _nothing(calibration: Calibration, changes: Changes) -> Finding:
    """That nothing is known to have changed, and what would have been seen."""
    offsets = {f"{drive}.offset" for drive, *_ in calibration.robot_record.travel}
    tested = [t for t in changes.tested if t.name in offsets]
    blind = [t for t in tested if not math.isfinite(changes.seen_from(t))]
    seen = [t for t in tested if t not in blind]
    if not seen:
        return Finding(
            "change not known",
            "informs",
            "Whether the machine changed between the sessions cannot be told: "
            + (
                "nothing tells the noise of the readings."
                if changes.dof == 0.0
                else "they have too little in common."
            ),
            "Read some of the same setups and postures in each session.",
        )
    sizes = _largest(changes, seen)
    words = [f"{plain(size)} {unit}" for unit, size in sizes.items()]
    text = (
        "Between the sessions nothing moved: a change of one offset by "
        f"{joined(words, 'or')} would have been seen."
    )
    if blind:
        names = dict.fromkeys(t.name.removesuffix(".offset") for t in blind)
        text += f" Whether {joined(tuple(names), 'or')} moved cannot be told."
    numbers = {f"seen_from_{unit}": size for unit, size in sizes.items()}
    return Finding("nothing changed", "informs", text, numbers=numbers)


def _largest(changes: Changes, tested: Sequence[TestedChange]) -> dict[str, float]:
    """Size from which on each of some changes would have been seen, by unit."""
    sizes: dict[str, float] = {}
    for t in tested:
        size = changes.seen_from(t) * t.edge_factor
        sizes[t.edge_unit] = max(sizes.get(t.edge_unit, 0.0), size)
    return sizes


def _unstated(calibration: Calibration, changes: Changes) -> list[str]:
    """Sessions that do not say which offsets were active in the controller."""
    parts = calibration.session.parts
    if len(parts) != len(changes.sessions):
        return []
    return [
        label
        for label, part in zip(changes.sessions, parts, strict=True)
        if part.controller_offsets is None
    ]


def _file_of(calibration: Calibration, changes: Changes, label: str) -> str | None:
    """The session.yaml of a session."""
    parts = calibration.session.parts
    if len(parts) != len(changes.sessions):
        return None
    return parts[changes.sessions.index(label)].path
