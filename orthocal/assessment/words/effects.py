"""Wording of findings about effects that readings do not show or do not separate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from orthocal.assessment.wording import joined, note, parameter_places
from orthocal.calibration.assessment_record import Finding, Place
from orthocal.effects.protocol import Condition, Effect
from orthocal.observation.conditions import COLUMNS_OF_CONDITIONS
from orthocal.text import spans

EFFECT_NOUNS = {
    "backlash": "the backlash of the drives",
    "thermal": "thermal expansion",
    "screw": "the periodic error of the screws",
    "drift": "the drift of the gauge",
}
"""Noun phrases for the effects of orthocal."""


def identify_effects(effects: Sequence[str]) -> str:
    """Advice to identify effects, whose names are stated."""
    return f"Calibrate with `--effects {','.join(effects)}`."


def approach_not_stated() -> Finding:
    """Finding about readings without stated side of approach."""
    return note(
        "effect not shown",
        "No reading states from which side its posture was approached: the backlash of the drives "
        "is not estimated, and their tolerance is assumed.",
        "State it in the column `approach`.",
    )


def condition_incomplete(
    effect: Effect,
    condition: Condition,
    lines: Sequence[int],
    count: int,
    total: int,
    *,
    two_postures: bool,
) -> Finding:
    """Finding about readings without a condition that an effect needs.

    Args:
        effect: The effect.
        condition: The condition.
        lines: Their lines, ascending; empty if unknown or in several files.
        count: Number of these readings.
        total: Number of all readings.
        two_postures: Whether one of them belongs to two postures, so that it states no condition.
    """
    where = f" ({spans(lines, 'line')})" if lines else ""
    stated = f"their {condition}"
    if condition == "approach":
        stated = "from which side their posture was approached"
    noun = EFFECT_NOUNS.get(effect.name, effect.describe())
    action = f"Complete the column `{COLUMNS_OF_CONDITIONS[condition]}`."
    if two_postures:
        action = (
            "Differences and distances of two postures cannot state it: calibrate without them, or "
            f"without {noun} (`--effects none`)."
        )
    return note(
        "effect not shown",
        f"{count} of {total} readings{where} do not state {stated}. `calibrate` needs it for "
        f"{noun}.",
        action,
        missing=float(count),
    )


def approached_from_one_side(drives: Mapping[str, str], *, common: bool) -> Finding:
    """Finding about drives that all readings approach from one side.

    Args:
        drives: Drive to a posture that would show its backlash.
        common: Whether all readings have the same approach, as a plan chose it. Then the short
            answer does not contain the finding.
    """
    postures = joined(list(dict.fromkeys(drives.values())))
    return note(
        "common approach" if common else "effect not shown",
        f"All readings approach {joined(list(drives))} from the same side. They cannot show "
        f"{'its' if len(drives) == 1 else 'their'} backlash, whatever its size.",
        f"Approach {postures} also from the other side.",
        parameter_places(*drives),
    )


def one_temperature(temperature: float | None, setup: str) -> Finding:
    """Finding about readings at one temperature, or without stated temperature.

    Args:
        temperature: The temperature, [°C]; None if no reading states it.
        setup: Setup that would show expansion at another temperature; empty if none would.
    """
    text = (
        "No reading states its temperature"
        if temperature is None
        else f"All readings were taken at {temperature:g} °C"
    )
    return note(
        "effect not shown",
        f"{text}. The readings do not show how legs and screws expand: the stated coefficients are "
        f"assumed.{'' if setup else ' At other temperatures these readings would not show it.'}",
        f"Read setup {setup} again at another temperature, and state it in `temperature_C`."
        if setup
        else "",
        (Place(setup=setup),) if setup else (),
    )


def effects_alike(
    one: Effect, other: Effect, parameters: Sequence[str], partners: Sequence[str]
) -> Finding:
    """Finding about parameters of effects that change the readings alike."""
    first, second = (EFFECT_NOUNS.get(e.name, e.describe()) for e in (one, other))
    pairs_text = f"{joined(parameters)} from {joined(partners)}" if partners else joined(parameters)
    reason = (
        f"{first} and {second} change them alike"
        if one is not other
        else f"these parts of {first} change them alike"
    )
    return note(
        "effects inseparable",
        f"These readings do not separate {pairs_text}: {reason}.",
        _separating({one.name, other.name}),
        parameter_places(*parameters, *partners),
    )


def _separating(effects: set[str]) -> str:
    """Advice about readings that separate effects."""
    if effects == {"thermal"}:
        return "A gauge at the tool, read at two temperatures, separates them."
    if "backlash" in effects:
        return "Approach the same postures also from the other side."
    if "screw" in effects:
        return "Read postures at other fractions of a turn of the screws."
    return (
        "Return to the first posture at the end of each setup, and read one setup again at another "
        "temperature."
    )
