"""Conditions of use in words: those that were stated, and those that were assumed."""

from __future__ import annotations

from collections.abc import Collection

from orthocal.assessment.assess import assessment_of
from orthocal.assessment.wording import joined, tool_mm
from orthocal.assessment.words.entries import describe_use
from orthocal.calibration.calibration import Calibration
from orthocal.effects.loading import neutral_values
from orthocal.kinematics.conditions import (
    CONDITION_OF,
    UseCondition,
    UseConditions,
    effects_by_condition,
)


def describe_assumed(
    calibration: Calibration,
    conditions: UseConditions,
    *,
    fields: Collection[UseCondition] = tuple(CONDITION_OF),
) -> str:
    """Conditions that a command assumes because they are not stated, and what that costs.

    Args:
        calibration: The calibration.
        conditions: The stated conditions.
        fields: Conditions that the command can take.

    Returns:
        "" for a machine that depends on none of the missing ones.
    """
    effects = effects_by_condition(calibration.robot)
    missing = [f for f in fields if f in effects and getattr(conditions, f) is None]
    if not missing:
        return ""
    names = joined([f"{_assumption(calibration, f)} (--{f})" for f in missing])
    text = f"Assumed: {names}."
    tool = assessment_of(calibration).tool
    if tool is None or tool.use is None or len(missing) < len(effects):
        return text
    return (
        f"{text} Expected tool error with all identified errors corrected, "
        f"{describe_use(tool.use.stated)}: {tool_mm(tool.use.unstated)} RMS without stating them, "
        f"{tool_mm(tool.compensated)} if they are stated."
    )


def describe_conditions_of(
    calibration: Calibration,
    conditions: UseConditions,
    *,
    fields: Collection[UseCondition] = tuple(CONDITION_OF),
) -> str:
    """Conditions of a tool error or a program: as stated, otherwise as assumed.

    Args:
        calibration: The calibration.
        conditions: The stated conditions.
        fields: Conditions that the command can take.

    Returns:
        "" for a machine that depends on none of them.
    """
    forms = {"approach": "approach {}", "temperature": "{:g} °C", "payload": "payload {:g} kg"}
    values = {f: getattr(conditions, f) for f in effects_by_condition(calibration.robot)}
    words = [
        _assumption(calibration, f) if value is None else forms[f].format(value)
        for f, value in values.items()
        if f in fields
    ]
    return f"Conditions: {joined(words)}." if words else ""


def _assumption(calibration: Calibration, name: UseCondition) -> str:
    """Value of a condition that is not stated."""
    if name == "approach":
        return "the middle of both sides of each drive"
    if name == "payload":
        return "no payload"
    return f"{neutral_values(calibration.robot)['temperature']:g} °C"
