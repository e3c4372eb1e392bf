"""All findings of a validation, and the one decision that follows from them."""

from __future__ import annotations

from orthocal.assessment.entry_mistakes import EnteringMistake, Mistake
from orthocal.assessment.findings.decision import Answer, Decision
from orthocal.assessment.findings.finding import Finding, Kind, Place, places_of
from orthocal.assessment.validation import FurtherChange, Validation
from orthocal.assessment.wording import joined, mm, signed
from orthocal.units import MM

REMOVED = 0.7
"""Part of the deviations below which a further fit is said to remove them."""

MOST_NAMED = 3
"""Parameters that are named of those that would change."""

AGAIN = "Calibrate again from this session."

ENTER_WHOLE = "Enter what stands below, whole and in place of what is active, and measure again."

_MISTAKES: dict[Mistake, tuple[Kind, str]] = {
    "not entered": ("not entered", "were not entered: what was active before still is"),
    "wrong sign": ("wrong sign", "were entered with the wrong sign"),
    "entered twice": ("entered twice", "were entered twice, or on top of what was active"),
    "identified": (
        "wrong column",
        "are those of the column 'identified', not of the column 'enter'",
    ),
    "interchanged": ("interchanged", "were interchanged"),
}


def decide_validation(validation: Validation) -> Decision:
    """Whether a calibration is confirmed, why, what to do next, and all that was found."""
    findings = find_validation_findings(validation)
    answers: dict[bool | None, Answer] = {
        True: "confirmed",
        False: "not confirmed",
        None: "cannot be told",
    }
    lead = findings[0]
    cause = findings[1] if findings[1:] and findings[1].severity != "informs" else None
    reason = lead.text if cause is None else f"{lead.text} {cause.text}"
    action = lead.action if cause is None else cause.action
    return Decision(answers[validation.confirmed], reason, action, findings)


def find_validation_findings(validation: Validation) -> tuple[Finding, ...]:
    """All that is recognised in a validation: how it stands, why, and what else is to be known."""
    return (
        _standing(validation),
        *_causes(validation),
        _repetition(validation),
        *_unstated(validation),
    )


def _standing(validation: Validation) -> Finding:
    """Whether the deviations are those that were expected."""
    achieved, expected = validation.achieved_rms, validation.expected_rms
    numbers = {
        "expected_rms_mm": expected / MM,
        "achieved_rms_mm": achieved / MM,
        "refit_rms_mm": validation.refit_rms / MM,
        "chance": validation.excess_probability,
    }
    places = _worst_row(validation)
    if validation.as_expected is None:
        return Finding(
            "nothing expected",
            "informs",
            "Whether this is as expected cannot be told: the calibration had no readings to spare "
            "that would say what to expect.",
            "Calibrate from more readings, then measure again.",
            numbers,
        )
    if not validation.as_expected:
        return Finding(
            "more than expected",
            "stops",
            f"The calibration is not confirmed: r.m.s. {mm(achieved)} mm was achieved where "
            f"{mm(expected)} mm was expected, more than chance explains.",
            numbers=numbers,
            places=places,
        )
    if validation.nothing_to_change:
        return Finding(
            "as expected",
            "informs",
            f"The calibration is confirmed: r.m.s. {mm(achieved)} mm was achieved where "
            f"{mm(expected)} mm was expected, and a further fit would change no parameter beyond "
            "chance.",
            numbers=numbers,
        )
    changed = [c.name for c in validation.changes if c.significant]
    if validation.mistake is not None:
        text = (
            "The calibration is not confirmed, though the deviations are no larger than expected."
        )
        return Finding("further change", "stops", text, "", numbers, places_of(*changed))
    return Finding(
        "further change",
        "stops",
        f"The deviations are as expected, but a further fit would change {', '.join(changed)} "
        "beyond the standard error.",
        AGAIN,
        numbers,
        places_of(*changed),
    )


def _causes(validation: Validation) -> list[Finding]:
    """What may have happened where the calibration is not confirmed, and what to do."""
    if validation.confirmed is not False:
        return []
    mistake = validation.mistake
    if mistake is not None:
        found = _one_differs if mistake.kind == "one differs" else _slip
        return [found(validation, mistake)]
    if validation.as_expected:
        return []
    if validation.refit_rms < REMOVED * validation.achieved_rms:
        return [_changed(validation)]
    return [
        Finding(
            "not the offsets",
            "stops",
            "Other offsets would not help, so those entered are not to blame: the readings "
            "scatter more than before, or something else has moved.",
            "Read again, and look at what holds the gauge.",
        )
    ]


def _slip(validation: Validation, mistake: EnteringMistake) -> Finding:
    """A known mistake in entering."""
    kind, words = _MISTAKES[mistake.kind]
    whose = "The offsets" if mistake.all_drives else f"The offsets of {joined(mistake.drives)}"
    return Finding(
        kind,
        "stops",
        f"{whose} seem not to be in the controller as identified: they {words}. That leaves r.m.s. "
        f"{mm(mistake.rms)} mm of these readings unexplained.",
        ENTER_WHOLE,
        _mistake_numbers(validation, mistake),
        places_of(*mistake.drives),
    )


def _one_differs(validation: Validation, mistake: EnteringMistake) -> Finding:
    """One drive's offset explains it: another was entered, or its zero has moved."""
    entry = next(e for e in validation.enter if e.drive == mistake.drives[0])
    return Finding(
        "one drive differs",
        "stops",
        f"The offset of {entry.drive} alone explains it: what is in the controller seems to be "
        f"{signed(mistake.by[0] * entry.edge_factor)} {entry.edge_unit} from what the session "
        f"says. That leaves r.m.s. {mm(mistake.rms)} mm of these readings unexplained.",
        "Look there first, for a slip of the pen. If the controller holds what the session says, "
        "the zero of this drive has moved: then enter what stands below.",
        _mistake_numbers(validation, mistake),
        places_of(entry.drive),
    )


def _mistake_numbers(validation: Validation, mistake: EnteringMistake) -> dict[str, float]:
    """What is in the controller less what was to be entered, drive by drive, and what is left."""
    units = {e.drive: (e.edge_factor, e.edge_unit.replace("°", "deg")) for e in validation.enter}
    found = {"left_rms_mm": mistake.rms / MM}
    for drive, by in zip(mistake.drives, mistake.by, strict=True):
        factor, unit = units.get(drive, (1.0, "si"))
        found[f"{drive}_by_{unit}"] = by * factor
    return found


def _changed(validation: Validation) -> Finding:
    """A further fit would remove it, and no mistake in entering explains it."""
    largest = _by_size(validation)
    names = [c.name for c in largest[:MOST_NAMED]]
    told = "" if any(c.significant for c in largest) else " No single parameter is told apart."
    return Finding(
        "geometry changed",
        "stops",
        f"A further fit would take it to {mm(validation.refit_rms)} mm, and no mistake in "
        "entering the offsets explains it: the geometry has changed, or the gauge stood "
        f"elsewhere than the session says.{told} Most would change, in their σ: "
        f"{', '.join(names)}.",
        AGAIN,
        {"refit_rms_mm": validation.refit_rms / MM},
        places_of(*names),
    )


def _by_size(validation: Validation) -> list[FurtherChange]:
    """Changes by how many of their σ they are, the largest first."""
    return sorted(validation.changes, key=lambda c: -abs(c.change) / max(c.std, 1e-300))


def _worst_row(validation: Validation) -> tuple[Place, ...]:
    """The reading that is furthest off."""
    worst = max(validation.rows, key=lambda r: abs(r.deviation))
    return (Place(line=worst.line, setup=worst.setup, posture=worst.postures),)


def _repetition(validation: Validation) -> Finding:
    """Whether what remains is the same in both sessions."""
    found = validation.repetition
    if found.repeats is None:
        text = f"Whether what remains repeats cannot be told: {found.untold}."
        return Finding("repetition unknown", "informs", text)
    numbers = {
        "correlation": found.correlation,
        "rows": float(found.matched),
        "chance": found.chance,
    }
    sizes = f"(correlation {found.correlation:.3f} over {found.matched} rows; chance"
    if found.repeats:
        return Finding(
            "repeats",
            "informs",
            f"What remains repeats {sizes} {found.chance:.1%}): it is error of the model, which "
            "more readings of the same kind will not remove.",
            numbers=numbers,
        )
    reason = (
        "it is nothing that the calibration has left, but new"
        if validation.as_expected is False
        else "it looks like noise"
    )
    return Finding(
        "does not repeat",
        "informs",
        f"What remains does not repeat beyond chance {sizes} {found.chance:.0%}): {reason}.",
        numbers=numbers,
    )


def _unstated(validation: Validation) -> list[Finding]:
    """Whether the session says which offsets were active."""
    if validation.offsets_stated:
        return []
    text = "The session does not state which offsets were active; the identified ones are taken."
    return [Finding("controller not stated", "informs", text)]
