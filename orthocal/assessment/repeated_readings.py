"""Repeated readings of a posture: their scatter, closing readings, and both sides of approach."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.assessment.wording import signed
from orthocal.assessment.words import plausibility as words
from orthocal.assessment.words.anomalies import MAX_PLACES, place_of
from orthocal.assessment.words.remedies import command_to_restart
from orthocal.calibration.assessment_record import Finding
from orthocal.hypotheses.hypothesis import Rows, group_rows
from orthocal.hypotheses.linear_model import linear_model
from orthocal.measurement.joining import split_sessions
from orthocal.measurement.motion.approach import label_reading
from orthocal.observation.gauge_noise import ROUNDING_ERROR, stated_sigma, usual_difference
from orthocal.session.session import Session
from orthocal.statistics.chance import BY_CHANCE, chance_of_excess
from orthocal.units import MM

MISTAKE_PROBABILITY = 1e-6
"""Probability by chance below which differences of repeated readings are a mistake."""

EXCHANGED_EVIDENCE = 10.0
"""ln evidence above which the sides of approach of a setup are exchanged."""

EQUAL_EVIDENCE = 1.5
"""Difference of ln evidence up to which two explanations are equally good."""

WIDE_BACKLASH = 5.0
"""Standard deviation of a backlash in this search, in prior standard deviations: worn screws."""


@dataclass(frozen=True, slots=True, eq=False)
class _Repeats:
    """Readings of one place in one setup, at least two; see `Observations.place`."""

    rows: Indices
    square: float
    """Sum of squared deviations from their mean, relative to the variance of a reading."""
    difference: float
    """The last reading minus the first, [m]."""
    is_closing: bool
    """Whether the first reading of the setup is repeated after other postures."""

    @property
    def dof(self) -> int:
        """Degrees of freedom."""
        return len(self.rows) - 1


def find_scattered(session: Session) -> tuple[Finding, ...]:
    """Findings about repeated readings that differ by far more than the noise of their gauge.

    If single setups alone differ from their first readings at their end, something moved there.
    Otherwise the readings do not repeat, without an evident mistake.
    """
    findings = []
    for part in split_sessions(session):
        for gauge in part.gauges:
            repeats = _list_repeats(part, gauge)
            if moved := _find_moved(repeats, usual_difference(part.gauges[gauge])):
                findings.append(_describe_closings(session, part, gauge, moved))
            elif _is_scattered(repeats):
                findings.append(_describe_scatter(part, gauge, repeats))
    return tuple(findings)


def _list_repeats(session: Session, gauge: str) -> list[_Repeats]:
    """Repeated readings of a gauge; none if its noise is not stated."""
    if session.gauges[gauge].sigma is None:
        return []
    variance, values, rows = stated_sigma(session.gauges[gauge]) ** 2, session.values, Rows(session)
    by_hand = rows.written & ~rows.paired
    repeats = []
    for repeated in group_rows(linear_model(session).problem.observations.row_places).values():
        setup = session.readings[repeated[0]].setup
        if len(repeated) < 2 or session.setups[setup].gauge != gauge:
            continue
        read = values[repeated]
        entries = 1.0 + session.is_difference(session.readings[repeated[0]])
        of_setup = rows.setups[setup]
        between = int(np.searchsorted(of_setup, repeated[-1])) - len(repeated) + 1
        repeats.append(
            _Repeats(
                repeated,
                float(((read - read.mean()) ** 2).sum()) / entries / variance,
                float(read[-1] - read[0]),
                is_closing=bool(
                    repeated[0] == of_setup[0] and between > 0 and by_hand[repeated[0]]
                ),
            )
        )
    return repeats


def _find_moved(repeats: Sequence[_Repeats], usual: float) -> list[_Repeats]:
    """Closing readings that show that something moved, if all other readings repeat.

    Args:
        repeats: Repeated readings of a gauge.
        usual: Largest usual difference of two readings, [m].
    """
    moved = [
        r
        for r in repeats
        if r.is_closing
        and abs(r.difference) > usual + ROUNDING_ERROR
        and chance_of_excess(r.square, r.dof) * len(repeats) <= BY_CHANCE
    ]
    if len(moved) > max(1, len(repeats) // 2):
        return []
    return [] if _is_scattered([r for r in repeats if r not in moved]) else moved


def _is_scattered(repeats: Iterable[_Repeats]) -> bool:
    """True if repeated readings differ by more than the noise."""
    square, dof = sum(r.square for r in repeats), sum(r.dof for r in repeats)
    return bool(dof) and chance_of_excess(square, dof) <= MISTAKE_PROBABILITY


def _describe_scatter(session: Session, gauge: str, repeats: Sequence[_Repeats]) -> Finding:
    """Finding about readings of a gauge that do not repeat."""
    sigma, values = stated_sigma(session.gauges[gauge]), session.values
    square, dof = sum(r.square for r in repeats), sum(r.dof for r in repeats)
    worst = max(repeats, key=lambda r: r.square).rows
    shown = ", ".join(
        f"{signed(values[i] / MM)} mm" + (f" in line {line}" if line is not None else "")
        for i, line in ((i, session.readings[i].line) for i in worst[:4])
    )
    return words.scattered_repeats(
        sigma * math.sqrt(square / dof),
        sigma,
        label_reading(session.robot, session.readings[worst[0]]),
        shown,
        [place_of(session, i) for i in worst[:MAX_PLACES]],
        session.distinguish_gauge(gauge),
    )


def _describe_closings(
    session: Session,
    part: Session,
    gauge: str,
    closings: Sequence[_Repeats],
) -> Finding:
    """Finding about closing readings that differ from the first ones.

    Args:
        session: All sessions.
        part: The session of the closing readings.
        gauge: Name of their gauge.
        closings: Repeated first readings of setups that end with a closing reading.
    """
    last = [int(r.rows[-1]) for r in closings]
    setups = [
        (part.readings[i].setup, r.difference, [part.readings[j].line for j in r.rows[[0, -1]]])
        for i, r in zip(last, closings, strict=True)
    ]
    return words.differing_closings(
        setups,
        usual_difference(part.gauges[gauge]),
        command_to_restart(session, part.readings[last[0]]),
        [place_of(part, i) for i in last],
    )


def find_exchanged_sides(session: Session) -> tuple[Finding, ...]:
    """Findings about setups whose readings from both sides differ as a negative backlash would.

    A backlash is at least 0 and the same in all setups. If the differences agree with backlashes
    only if p and n are exchanged in all setups, in one or in all but one, they were exchanged.
    """
    findings = []
    for part in split_sessions(session):
        exchanged = _find_exchanged(_list_differences(part), part)
        if exchanged:
            rows = np.concatenate([d.rows for d in exchanged])
            findings.append(
                words.exchanged_sides(
                    [line for i in rows if (line := part.readings[i].line) is not None],
                    [d.setup for d in exchanged],
                    [place_of(part, i) for i in rows[:MAX_PLACES].tolist()],
                )
            )
    return tuple(findings)


@dataclass(frozen=True, slots=True, eq=False)
class _Differences:
    """Differences of the readings of a setup from two sides, relative to their std."""

    setup: str
    rows: Indices
    """Rows with both sides."""
    values: Array
    """Differences without compensated backlash, shape (n,)."""
    effects: Array
    """Differences per unit of the backlash of each drive, shape (n, n_drives), [1/m, 1/rad]."""


def _find_exchanged(setups: Sequence[_Differences], session: Session) -> Sequence[_Differences]:
    """Setups whose sides are exchanged."""
    count = len(setups)
    if not count:
        return []
    from scipy.optimize import nnls

    stds = [session.robot.parameters[name].prior_std for name in _backlashes(session)]
    values = np.concatenate([*(d.values for d in setups), np.zeros(len(stds))])
    as_stated = np.ones(count)
    choices = [
        -as_stated,
        *(s * (1.0 - 2.0 * np.eye(count)[k]) for s in (1, -1) for k in range(count)),
    ]

    def misfit(signs: Array) -> float:
        """Smallest sum of squares with backlashes that are at least 0 and have wide priors."""
        effects = [sign * d.effects for sign, d in zip(signs, setups, strict=True)]
        wide = np.diag(1.0 / (WIDE_BACKLASH * np.array(stds)))
        return float(nnls(np.vstack([*effects, wide]), values)[1] ** 2)

    misfits = [misfit(signs) for signs in choices]
    if 0.5 * (misfit(as_stated) - min(misfits)) < EXCHANGED_EVIDENCE:
        return []
    # all setups if they agree as well, otherwise as few as possible
    equal = (m < min(misfits) + 2.0 * EQUAL_EVIDENCE for m in misfits)
    agreeing = [signs for signs, is_equal in zip(choices, equal, strict=True) if is_equal]
    best = min(agreeing, key=lambda signs: (signs is not choices[0], (signs < 0.0).sum()))
    return [d for sign, d in zip(best, setups, strict=True) if sign < 0.0]


def _backlashes(session: Session) -> list[str]:
    """Names of the backlashes of the drives; none for a machine without this effect."""
    names = [f"{d.name}.backlash" for d in session.robot.drives]
    return names if set(names) <= set(session.robot.parameters.names) else []


def _list_differences(session: Session) -> list[_Differences]:
    """Differences of the mean readings of one posture from two sides, by setup."""
    names = _backlashes(session)
    if len({r.approach for r in session.readings}) < 2 or not names:
        return []
    problem = linear_model(session).problem
    linear, plus = problem.linearisation_at_active, problem.observations.plus
    columns = [problem.free.index(name) for name in names]
    ratio = problem.noise_ratio[plus]
    deviations = session.values - ratio * linear.reading[plus]
    by_backlash = linear.jacobian[plus][:, columns] / problem.theta_scale[columns] * ratio[:, None]
    rows, listed = Rows(session), []
    for name, of_setup in rows.setups.items():
        single = of_setup[rows.single[of_setup] & ~rows.paired[of_setup]]
        pairs, sigma = [], stated_sigma(session.gauges[session.setups[name].gauge])
        for read in group_rows(session.readings[i].posture for i in single).values():
            approaches = group_rows(session.readings[i].approach for i in single[read])
            first, *others = (single[read][k] for k in approaches.values())
            pairs += [(first, other) for other in others]
        if not pairs or not sigma:
            continue
        stds = [sigma * math.sqrt(1.0 / len(a) + 1.0 / len(b)) for a, b in pairs]
        values, effects = (
            np.array([v[b].mean(axis=0) - v[a].mean(axis=0) for a, b in pairs])
            / (np.array(stds)[:, None] if v.ndim > 1 else stds)
            for v in (deviations, by_backlash)
        )
        used = np.unique(np.concatenate([i for pair in pairs for i in pair]))
        listed.append(_Differences(name, used, values, effects))
    return listed
