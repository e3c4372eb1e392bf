"""Anomalies of a session in words, for the findings of `check`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from orthocal.hypotheses.anomaly import Anomalies, Anomaly, Explanation
from orthocal.hypotheses.search import find_anomalies
from orthocal.session.session import Session
from orthocal.units import MM

MistakeKind = Literal[
    "wrong unit",
    "decimal place",
    "turned setup",
    "turned reading",
    "misread dial",
    "suspicious reading",
    "suspicious posture",
    "suspicious setup",
    "exchanged readings",
    "shifted rows",
    "stuck dial",
    "bumped stand",
    "drift",
]

KINDS: dict[str, MistakeKind] = {
    "wrong unit": "wrong unit",
    "decimal point": "decimal place",
    "misread dial": "misread dial",
    "outlier": "suspicious reading",
    "inconsistent posture": "suspicious posture",
    "inconsistent setup": "suspicious setup",
    "swapped rows": "exchanged readings",
    "row offset": "shifted rows",
    "stuck dial": "stuck dial",
    "displaced gauge": "bumped stand",
    "drift": "drift",
}

UNITS = {25.4: "in inches", 1e3: "in m", 1e-3: "in µm"}
"""Factor that corrects readings to the unit they were written in; else mm taken for inches."""


@dataclass(frozen=True, slots=True, eq=False)
class Mistake:
    """An anomaly with its wording."""

    kind: MistakeKind
    text: str
    """What was done, as the end of a sentence that begins with "as if"."""
    mend: str
    """Remedy, as a sentence."""
    rows: tuple[int, ...]
    """Rows of the session, the first one first."""
    setups: tuple[str, ...]
    evidence: float
    before: float
    """RMS residual of a machine within its tolerances, [m]."""
    after: float
    """The same once it is corrected, [m]."""
    expected: float | None
    """Predicted value of a single row, [m]."""
    perhaps: tuple[str, ...] = ()
    """Causes that are nearly as likely, each as `text`."""
    others: tuple[Mistake, ...] = ()
    """Anomalies elsewhere that are nearly as likely."""


def find_mistakes(session: Session, model: str | None = None) -> tuple[Mistake, ...]:
    """Anomalies of a session with their wording; arguments as `find_anomalies`.

    None where they do not explain the readings: then something else is wrong.
    """
    found = find_anomalies(session, model)
    if not found.explained:
        return ()
    return tuple(_mistake(session, found, a) for a in found.found)


def _mistake(session: Session, found: Anomalies, anomaly: Anomaly) -> Mistake:
    main = _worded(session, found, anomaly.explanation, anomaly)
    others = (_worded(session, found, e, anomaly) for e in anomaly.alternatives)
    perhaps = tuple(_text(session, e) for e in anomaly.causes)
    mend = "Read it again, or leave it out." if perhaps else main.mend
    return Mistake(
        main.kind,
        main.text,
        mend,
        main.rows,
        main.setups,
        anomaly.log_evidence,
        found.rms_before,
        found.rms_after,
        anomaly.expected,
        perhaps,
        tuple(others),
    )


def _worded(session: Session, found: Anomalies, e: Explanation, anomaly: Anomaly) -> Mistake:
    return Mistake(
        _kind(e),
        _text(session, e),
        _remedy(session, e),
        e.rows,
        e.setups,
        anomaly.log_evidence,
        found.rms_before,
        found.rms_after,
        None,
    )


def _kind(e: Explanation) -> MistakeKind:
    if e.kind == "reversed sign":
        return "turned setup" if e.setups else "turned reading"
    return KINDS.get(e.kind, "suspicious setup")


def _row(session: Session, i: int) -> str:
    r = session.readings[i]
    return r.label + (f", cycle {r.cycle}" if r.cycle > 1 else "")


def _subject(session: Session, e: Explanation) -> str:
    """Readings that an explanation concerns, as a noun."""
    if e.scope == "reading":
        return _row(session, e.rows[0])
    if e.scope == "posture":
        return f"{session.readings[e.rows[0]].label} in all cycles"
    if e.scope == "cycle":
        return f"setup {e.names[0]}, cycle {e.cycle}"
    if e.scope in ("leg", "gauge"):
        return f"the readings of {e.scope} {e.names[0]}"
    if e.scope == "session":
        return "all readings"
    return " and ".join(
        ("setup " if len(e.setups) == 1 else "setups ") + n if not k else n
        for k, n in enumerate(e.setups)
    )


def _text(session: Session, e: Explanation) -> str:
    words: dict[str, Callable[[], str]] = {
        "wrong unit": lambda: _scaled(
            session, e, UNITS.get(e.factor or 0.0, "in mm but taken for inches")
        ),
        "decimal point": lambda: (
            _scaled(session, e, "with the decimal point in the wrong place")
            if e.setups or e.scope == "cycle"
            else f"the decimal point of {_subject(session, e)} is in the wrong place"
        ),
        "reversed sign": lambda: f"the sign of {_subject(session, e)} was turned",
        "misread dial": lambda: (
            f"{_subject(session, e)} was read {abs(e.amount or 0.0) / MM:g} mm too "
            f"{'high' if (e.amount or 0.0) > 0 else 'low'}, by a turn or a mark of the dial"
        ),
        "outlier": lambda: f"{_subject(session, e)} was misread or mistyped",
        "inconsistent posture": lambda: (
            f"{_subject(session, e)} was misread or mistyped"
            if e.scope == "posture"
            else f"the machine was elsewhere than in posture {e.names[0]} whenever that was read"
        ),
        "inconsistent setup": lambda: f"setup {e.setups[0]} was another one than is said",
        "swapped rows": lambda: _swapped(session, e),
        "row offset": lambda: _offset(session, e),
        "stuck dial": lambda: (
            f"the dial stuck in setup {e.names[0]}: from {_row(session, e.rows[0])} on it shows "
            f"the same {len(e.rows)} times"
        ),
        "displaced gauge": lambda: _displaced(session, e),
        "drift": lambda: (
            f"the readings of setup {e.setups[0]} drifted from the first to the last"
            if len(e.setups) == 1
            else "the readings of every setup drifted alike from its first to its last"
        ),
    }
    return words.get(e.kind, lambda: f"session {', '.join(e.sessions)}: {e.kind}")()


def _scaled(session: Session, e: Explanation, how: str) -> str:
    subject = _subject(session, e)
    be = "were" if subject.startswith(("all", "the")) else "was"
    return f"{subject} {be} written {how}"


def _displaced(session: Session, e: Explanation) -> str:
    if e.scope == "cycle":
        return f"the gauge of setup {e.names[0]} was set anew for cycle {e.cycle}, or touched"
    return (
        f"the stand of setup {e.names[0]} was bumped before {_row(session, e.rows[0])}: all its "
        "later readings are shifted"
    )


def _offset(session: Session, e: Explanation) -> str:
    first = _row(session, e.rows[0])
    if e.missing:
        return (
            f"{first} was not read, and all later readings of setup {e.names[0]} stand in the row "
            "before their own"
        )
    return (
        f"the reading before {first} was written twice, and all later readings of setup "
        f"{e.names[0]} stand in the row after their own"
    )


def _swapped(session: Session, e: Explanation) -> str:
    half = len(e.rows) // 2
    names = {
        "reading": lambda: (
            f"the readings {_row(session, e.rows[0])} and {_row(session, e.rows[half])}"
        ),
        "posture": lambda: f"{e.names[1]} and {e.names[2]} in all cycles of setup {e.names[0]}",
        "postures": lambda: f"the readings of postures {e.names[0]} and {e.names[1]} in all setups",
        "setups": lambda: f"the readings of setups {e.setups[0]} and {e.setups[1]}",
        "legs": lambda: f"the readings of legs {e.names[0]} and {e.names[1]}",
        "setup": lambda: (
            f"the first and the last rows of setup {e.setups[0]}, which was written backwards,"
        ),
    }
    return f"{names[e.scope]()} were exchanged"


def _remedy(session: Session, e: Explanation) -> str:
    again = "Read it again, or leave it out."
    if e.scope == "reading" and (e.factor is not None or e.kind == "misread dial"):
        old = session.readings[e.rows[0]].value / MM
        new = old - (e.amount or 0.0) / MM if e.factor is None else old * e.factor
        return f"If so, write {new:+.6g} instead of {old:+.6g}."
    if e.kind == "reversed sign" and e.setups:
        return (
            "See which way the gauge stood and whether a minus was forgotten; then turn the signs, "
            "or `direction`."
        )
    if e.factor is not None:
        return f"If so, multiply these by {e.factor:.6g}."
    if e.kind == "displaced gauge" and e.scope == "cycle":
        return f"If so, read cycle {e.cycle} again, or leave it out."
    if e.kind == "row offset":
        if e.missing:
            return "If so, move them down by a row and read what is missing."
        return "If so, move them up by a row and read the last one again."
    remedies = {
        "inconsistent setup": "Look at its leg, direction and section, and at how its gauge stood; "
        "then read it again, or leave it out.",
        "swapped rows": "If so, exchange them again.",
        "stuck dial": "See whether the plunger moves freely and touches, and read these again.",
        "displaced gauge": f"If so, read setup {''.join(e.names[:1])} again, or make a setup of "
        "its own of what was read after that.",
        "drift": "Let the machine and the stand come to one temperature, return to the first "
        "posture at the end, and read it again.",
    }
    if e.kind == "inconsistent posture" and e.scope == "postures":
        return "Look at its coordinates, and read it again."
    return remedies.get(e.kind, again)
