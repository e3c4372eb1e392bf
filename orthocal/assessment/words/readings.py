"""Wording of findings about mistakes in readings."""

from __future__ import annotations

import math

from orthocal.assessment.wording import signed, um
from orthocal.calibration.assessment_record import Finding, FindingKind, Place
from orthocal.hypotheses.mistake import Mistake, MistakeKind
from orthocal.session.session import Session
from orthocal.units import MM, UM

MOST_PLACES = 20
"""Places of a finding that are kept."""

LARGEST_ODDS = 1e6
"""Odds above which no number is printed."""

KINDS: dict[MistakeKind, FindingKind] = {
    "wrong unit": "wrong unit",
    "decimal place": "decimal point",
    "turned setup": "reversed setup",
    "turned reading": "reversed reading",
    "misread dial": "misread dial",
    "suspicious reading": "outlier",
    "suspicious posture": "inconsistent posture",
    "suspicious setup": "inconsistent setup",
    "exchanged readings": "swapped readings",
    "shifted rows": "row offset",
    "stuck dial": "stuck dial",
    "bumped stand": "displaced gauge",
    "drift": "drift",
}


def describe_mistake(session: Session, mistake: Mistake) -> Finding:
    """A mistake in the readings, or several that are nearly as likely."""
    if mistake.others:
        return _ambiguous(session, mistake)
    first = session.readings[mistake.rows[0]]
    ways = mistake.perhaps or (mistake.text,)
    text = f"{session.where(first)}: it looks as if {' or '.join(ways)}."
    numbers = _numbers(mistake)
    if mistake.expected is not None:
        text += (
            f" It reads {signed(first.value / MM)} mm; the other readings predict "
            f"{signed(mistake.expected / MM)} mm."
        )
        numbers |= {
            "measured_mm": first.value / MM,
            "expected_mm": mistake.expected / MM,
            "cycle": float(first.cycle),
        }
    return Finding(
        KINDS[mistake.kind],
        "review",
        f"{text} {_odds(mistake)}",
        mistake.mend,
        numbers=numbers,
        places=_places(session, mistake),
    )


def _ambiguous(session: Session, mistake: Mistake) -> Finding:
    every = (mistake, *mistake.others)
    ways = "; ".join(f"{m.text} ({session.where(session.readings[m.rows[0]])})" for m in every)
    return Finding(
        "ambiguous",
        "review",
        f"The readings contradict each other as if one of these had happened: {ways}. "
        f"{_odds(mistake)}",
        "Look at these readings, and read again what may be wrong.",
        numbers=_numbers(mistake),
        places=tuple(p for m in every for p in _places(session, m)[:1]),
    )


def _numbers(mistake: Mistake) -> dict[str, float]:
    return {
        "before_rms_um": mistake.before / UM,
        "after_rms_um": mistake.after / UM,
        "log_likelihood_ratio": mistake.evidence,
    }


def _odds(mistake: Mistake) -> str:
    """Residuals before and after the correction, and the odds."""
    odds = math.exp(min(mistake.evidence, math.log(LARGEST_ODDS)))
    number = f"more than {LARGEST_ODDS:,.0f}" if odds > 0.999 * LARGEST_ODDS else f"{odds:,.0f}"
    words = f"odds that something is wrong: {number} to 1."
    if mistake.kind == "stuck dial" or not math.isfinite(mistake.before + mistake.after):
        return f"{words[0].upper()}{words[1:]}"
    before, after = um(mistake.before), um(mistake.after)
    return f"Residual {before} µm RMS as written, {after} µm once corrected; {words}"


def _places(session: Session, mistake: Mistake) -> tuple[Place, ...]:
    if mistake.setups:
        return tuple(Place(setup=name) for name in mistake.setups[:MOST_PLACES])
    return tuple(place_of(session, i) for i in mistake.rows[:MOST_PLACES])


def place_of(session: Session, row: int) -> Place:
    """File, line, setup and posture of a row."""
    reading = session.readings[row]
    file = reading.file or session.readings_path
    known = reading.line is not None
    return Place(
        file=str(file) if known and file is not None else None,
        line=reading.line,
        setup=reading.setup,
        posture=reading.posture + (f" − {reading.minus}" if reading.minus else ""),
    )
