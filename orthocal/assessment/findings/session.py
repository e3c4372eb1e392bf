"""Mistakes made while reading and writing down, as findings: of a session, before any fit."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace

from orthocal.arguments import require_kind
from orthocal.assessment.findings.decision import Decision
from orthocal.assessment.findings.finding import Finding, Kind, Place, Severity
from orthocal.assessment.findings.readings import find_turned
from orthocal.assessment.plausibility import MOST_PLACES, find_finer
from orthocal.assessment.wording import mm, signed, um
from orthocal.calibration.calibrate import calibrate
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.refit import restore_session
from orthocal.errors import OrthocalError
from orthocal.hypotheses.mistake import Mistake, find_mistakes
from orthocal.measurement.joining import split_sessions
from orthocal.session.session import Session
from orthocal.statistics.chance import chance_of_excess
from orthocal.units import MM, UM

NO_CHANCE = 1e-6
"""Probability of what is no chance, in a thousand sessions either."""

LARGEST_ODDS = 1e6
"""Odds above which no number is told."""

DRIFTING: tuple[Kind, ...] = ("drift", "suspicious posture")
"""Kinds that may be the machine's, though they concern many readings."""

MISTAKES: tuple[Kind, ...] = (
    "wrong unit",
    "decimal place",
    "turned reading",
    "misread dial",
    "suspicious posture",
    "suspicious setup",
    "exchanged readings",
    "shifted rows",
    "stuck dial",
    "bumped stand",
    "drift",
    "one of several",
)
"""Kinds that only a check of the readings names."""

SHADOWS: tuple[Kind, ...] = (
    "turned setup",
    "suspicious reading",
    "suspicious setup",
    "many contradicted",
    "scattered cycles",
    "tolerances exceeded",
    "too little left",
    "finer than the dial",
)
"""What a mistake shows besides, once its right name is known."""

TELLING: tuple[Kind, ...] = ("turned setup", "suspicious reading", "wrong size")
"""What of a fit names a mistake, too."""


def check_session(session: Session, model: str | None = None) -> tuple[Finding, ...]:
    """Mistakes made while reading and writing down: where, why, what mends them, and how sure.

    Readings are held against a machine of which the tolerances alone are known, so that no fit is
    needed, and against each other where they were repeated. A mistake is named where it makes
    readings far likelier than none does, and than any other; else it is one of several. Where there
    is none, a calibration is asked whether a setup was read with the wrong sign: it takes offsets
    to be anything, and may see what lies within their tolerances.

    Args:
        session: The session.
        model: Errors that the machine may have, as a model of the robot; all by default.

    Returns:
        Findings; none where nothing is odd.

    Raises:
        ClosureError: If the machine cannot reach a posture.
        ParameterError: If the model is unknown.
        TypeError: If the session is of another kind.
    """
    require_kind(session, Session, expected="a Session, such as load_session(...)")
    found = _find(session, model)
    if any(f.kind == "wrong unit" for f in found):
        return tuple(found)
    every = [_find_finer(session, gauge) for gauge in session.gauges]
    if not found:
        every += _find_turned_by_fit(session, model)
        every += [_find_scattered(session, gauge) for gauge in session.gauges]
    return (*found, *(f for f in every if f is not None))


def _find_turned_by_fit(session: Session, model: str | None) -> list[Finding]:
    """Setups of each session by itself that a calibration of it takes to be turned."""
    found: list[Finding] = []
    for part in split_sessions(session):
        # a session that cannot be calibrated, as one that is half measured, tells nothing here
        with suppress(OrthocalError):
            found += find_turned(calibrate(part, model, solver="eliminated"))
    return found


def _find_finer(session: Session, gauge: str) -> Finding | None:
    """Readings of a gauge that are finer than it shows."""
    own = [i for i, r in enumerate(session.readings) if session.setups[r.setup].gauge == gauge]
    return find_finer(
        [session.readings[i].value for i in own],
        session.gauges[gauge].resolution,
        where=lambda k: session.where(session.readings[own[k]]),
        place=lambda k: _place(session, own[k]),
    )


def _find_scattered(session: Session, gauge: str) -> Finding | None:
    """Readings of a gauge that were repeated and are far from what they were, in several places.

    Where many readings are wrong no single mistake stands out; that they do not repeat does.
    """
    known = session.gauges[gauge]
    if known.sigma is None:
        return None
    sigma = math.hypot(known.sigma, (known.resolution or 0.0) / math.sqrt(12.0))
    places: dict[tuple[str, str, str | None], list[int]] = {}
    for i, r in enumerate(session.readings):
        if session.setups[r.setup].gauge == gauge:
            places.setdefault((r.setup, r.posture, r.minus), []).append(i)
    repeated = [rows for rows in places.values() if len(rows) > 1]
    if not repeated:
        return None
    values = session.values

    def scatter(rows: list[int]) -> float:
        own = values[rows]
        single = 2.0 if session.readings[rows[0]].minus else 1.0
        return float(((own - own.mean()) ** 2).sum()) / single

    square, dof = sum(map(scatter, repeated)), sum(len(rows) - 1 for rows in repeated)
    if chance_of_excess(square / sigma**2, dof) > NO_CHANCE:
        return None
    worst = max(repeated, key=scatter)
    shown = ", ".join(
        f"{signed(values[i] / MM)} in {session.where(session.readings[i])}" for i in worst[:4]
    )
    size = math.sqrt(square / dof)
    return Finding(
        "scattered cycles",
        "warns",
        f"Repeated readings scatter by {mm(size)} mm, more than the gauge's {mm(sigma)} mm "
        f"explain. They differ most at {session.readings[worst[0]].label}: {shown} mm.",
        "Look at these for a wrong sign or row, and read them again.",
        numbers={"scatter_mm": size / MM, "gauge_mm": sigma / MM},
        places=tuple(_place(session, i) for i in worst[:MOST_PLACES]),
    )


def decide_session(session: Session, model: str | None = None) -> Decision:
    """Whether anything speaks against measuring on, or calibrating; arguments as `check_session`.

    Raises:
        ClosureError, ParameterError, TypeError: As `check_session`.
    """
    findings = check_session(session, model)
    if not findings:
        count = len(session.readings)
        text = (
            f"The {count} readings agree with each other and with a machine within its tolerances, "
            "as far as they can tell."
        )
        numbers = {"readings": float(count)}
        told = Finding("nothing odd", "informs", text, numbers=numbers)
        return Decision("nothing odd", text, "", (told,))
    order = {"stops": 0, "warns": 1, "informs": 2}
    ranked = tuple(sorted(findings, key=lambda f: order[f.severity]))
    return Decision("something odd", ranked[0].text, ranked[0].action, ranked)


def add_mistakes(calibration: Calibration, found: list[Finding]) -> list[Finding]:
    """Findings of a calibration with the mistakes of its session, each told once.

    A mistake that is named explains what contradictions it leaves in a fit; one that a fit names
    as well, or that is but one of several, is not told again.
    """
    mistakes = _mistakes_of(calibration)
    told = [f for f in found if f.kind in TELLING]
    sure = [m for m in mistakes if m.kind != "one of several"]
    new = [m for m in sure if not any(_is_same(m, f) for f in told)]
    if not new:
        unsure = [m for m in mistakes if m not in sure]
        return [*found, *([] if told or sure else unsure)]
    if all(m.kind == "suspicious reading" for m in new):
        return [*found, *new]
    kept = [f for f in found if f.kind not in SHADOWS or any(_is_same(m, f) for m in sure)]
    if any(f.severity == "stops" for f in found if f not in kept):
        new = [replace(m, severity="stops") for m in new]
    return [*kept, *new]


def _mistakes_of(calibration: Calibration) -> tuple[Finding, ...]:
    def find() -> tuple[Finding, ...]:
        try:
            session = restore_session(calibration)
            return tuple(_find(session, None))
        except OrthocalError:  # the findings of the tool say so
            return ()

    return calibration.remember("mistakes", find)


def _find(session: Session, model: str | None) -> list[Finding]:
    """Mistakes of each session by itself: between them the machine may have changed."""
    return [
        _finding(part, mistake)
        for part in split_sessions(session)
        for mistake in find_mistakes(part, model)
    ]


def _is_same(one: Finding, other: Finding) -> bool:
    """Whether a fit names the same mistake."""
    if one.kind != other.kind:
        return False
    key = {(p.setup, p.line, p.posture) for p in one.places}
    if one.kind == "turned setup":
        return {p.setup for p in one.places} == {p.setup for p in other.places}
    return bool(key & {(p.setup, p.line, p.posture) for p in other.places})


def _finding(session: Session, mistake: Mistake) -> Finding:
    if mistake.others:
        return _one_of_several(session, mistake)
    single = len(mistake.rows) == 1
    severity: Severity = "warns" if single or mistake.kind in DRIFTING else "stops"
    first = session.readings[mistake.rows[0]]
    text = f"{session.where(first)}: it looks as if {mistake.text}."
    if mistake.perhaps:
        text = f"{session.where(first)}: it looks as if {' or '.join(mistake.perhaps)}."
    if mistake.expected is not None:
        text += (
            f" It reads {signed(first.value / MM)} mm; the others foretell "
            f"{signed(mistake.expected / MM)} mm."
        )
    numbers = _numbers(mistake)
    if mistake.expected is not None:
        numbers |= {
            "measured_mm": first.value / MM,
            "expected_mm": mistake.expected / MM,
            "cycle": float(first.cycle),
        }
    return Finding(
        mistake.kind,
        severity,
        f"{text} {_sureness(mistake)}",
        mistake.mend,
        numbers=numbers,
        places=_places(session, mistake),
    )


def _one_of_several(session: Session, mistake: Mistake) -> Finding:
    every = (mistake, *mistake.others)
    ways = "; ".join(f"{m.text} ({session.where(session.readings[m.rows[0]])})" for m in every)
    places = [p for m in every for p in _places(session, m)[:1]]
    return Finding(
        "one of several",
        "warns",
        f"The readings contradict each other as if one of these had happened: {ways}. "
        f"{_sureness(mistake)}",
        "Look at these readings, and read again what may be wrong.",
        numbers=_numbers(mistake),
        places=tuple(places),
    )


def _numbers(mistake: Mistake) -> dict[str, float]:
    return {
        "before_rms_um": mistake.before / UM,
        "after_rms_um": mistake.after / UM,
        "log_likelihood_ratio": mistake.evidence,
    }


def _sureness(mistake: Mistake) -> str:
    """What is left before and after, and the odds."""
    odds = math.exp(min(mistake.evidence, math.log(LARGEST_ODDS)))
    told = f"more than {LARGEST_ODDS:,.0f}" if odds > 0.999 * LARGEST_ODDS else f"{odds:,.0f}"
    sure = f"dds that something is wrong: {told} to 1."
    if mistake.kind == "stuck dial" or not math.isfinite(mistake.before + mistake.after):
        return f"O{sure}"
    before, after = um(mistake.before), um(mistake.after)
    if mistake.after < mistake.before:
        return f"Mended, {after} µm r.m.s. remain instead of {before} µm; o{sure}"
    return f"As they are {before} µm r.m.s. remain, mended {after} µm; o{sure}"


def _places(session: Session, mistake: Mistake) -> tuple[Place, ...]:
    if mistake.setups:
        return tuple(Place(setup=name) for name in mistake.setups[:MOST_PLACES])
    return tuple(_place(session, i) for i in mistake.rows[:MOST_PLACES])


def _place(session: Session, row: int) -> Place:
    reading = session.readings[row]
    file = reading.file or session.readings_path
    known = reading.line is not None
    return Place(
        file=str(file) if known and file is not None else None,
        line=reading.line,
        setup=reading.setup,
        posture=reading.posture + (f" − {reading.minus}" if reading.minus else ""),
    )
