"""Whether a machine has changed between sessions that are calibrated together, and what of it.

A change is a step of one parameter from a session on. With it and without it the sessions have all
else in common: every error of the machine, whether it was fitted or not, at its tolerance (or at so
many times that as the readings ask for); offsets of drives are taken for unknown. Each gauge stood
anew. What is tested is only what such a machine cannot show (`contrasts.py`).

Offsets and the sums that the robot's YAML names, such as a leg's length, are tested one by one,
each from every session on; then whether anything at all has changed that these do not explain. A
single wrong reading that explains as much is held to be the reason. Where a leg's length explains
no more than a drive's offset, it is the drive that is named: zeros are lost sooner.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthocal.estimation.diagnostics.unmodelled import OtherErrors
from orthocal.estimation.fit import Fit
from orthocal.hypotheses.sessions.candidates import Columns, Step, gather_columns
from orthocal.hypotheses.sessions.change_records import (
    Change,
    Changes,
    OtherChange,
    TestedChange,
)
from orthocal.hypotheses.sessions.changed_machine import fit_changed_machine
from orthocal.hypotheses.sessions.contrasts import (
    Common,
    find_excess_of_machine,
    take_out_common,
    with_excess,
)
from orthocal.hypotheses.sessions.joint_readings import (
    hold_together,
    label_sessions,
    standard_deviations,
)
from orthocal.statistics.chance import BY_CHANCE, chance_of_excess
from orthocal.statistics.distributions import f_tail

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

ANYTHING = 0.003
"""Probability that sessions of one machine are said to differ in more than drives and legs."""

NEARLY = 6.0
"""χ² by which another explanation may be worse and still be as good."""

CLEARLY = 12.0
"""χ² by which an error of another part must explain more than drives and legs to be preferred:
there are some hundred of them, and zeros are lost sooner than a part bends."""

BENT = 0.1
"""Part of a χ² that it may be off by, for what bends in the machine and how gauges stand."""

MOST_CHANGES = 6
"""That are told of one machine."""

MOST_READINGS = 4
"""Single readings that are set aside before the sessions are held against each other."""

MOST_PARTS = 3
"""Of a machine that are named where any of them may have changed."""

LEAST_DOF = 3.0
"""Degrees of freedom below which residuals do not tell the noise."""


@dataclass(frozen=True, slots=True, eq=False)
class _Noise:
    """What readings scatter by."""

    scale: float
    """Times the standard deviations that they are in; NaN where nothing tells it."""
    dof: float


def find_session_changes(fit: Fit, others: OtherErrors) -> Changes | None:
    """What of a machine has changed between the sessions of a fit; None for a single one.

    Args:
        fit: The fit of several sessions together.
        others: Errors of the machine that it left out.
    """
    labels, session = label_sessions(fit.problem)
    if len(labels) < 2:
        return None
    columns = gather_columns(fit, others)
    sigma, known_dof = standard_deviations(fit)
    plain = hold_together(fit, columns, session, sigma)
    excess = find_excess_of_machine(plain, columns.unsure)
    common = take_out_common(with_excess(plain, columns.unsure, excess))
    machine = np.flatnonzero(columns.flat | columns.unsure | columns.held)
    tests = _test_machine(common, machine)
    noise = _noise(common, tests, known_dof)
    tested = _tested(columns, common, labels, noise)
    none = Changes(
        sessions=labels,
        dof=noise.dof,
        times_tolerances=excess,
        tested=tested,
        found=(),
        other=None,
    )
    if not math.isfinite(none.threshold):
        return none
    steps, left = _select(columns, common, none.threshold * noise.scale)
    if left is not common:
        tests = _test_machine(left, machine)
    other = _anything(columns, left, machine, labels, noise, tests)
    if other is None:
        other = _better_elsewhere(columns, common, labels, steps, noise)
    if other is not None or not steps:
        return replace(none, other=other)
    fitted = fit_changed_machine(fit, columns, left, steps, session=session, sigma=sigma)
    found = [
        _told(columns, common, labels, steps, i, size, noise.scale * std)
        for i, (size, std) in enumerate(fitted)
        if abs(size) > none.threshold * noise.scale * std
    ]
    return replace(none, found=tuple(found))


def _test_machine(common: Common, machine: Indices) -> list[tuple[float, float]]:
    """χ² of any change of the machine from the second session on, and so on, with its dof."""
    return [common.test_together(machine, k) for k in range(1, common.contrasts.n_sessions)]


def _noise(common: Common, tests: list[tuple[float, float]], known_dof: float) -> _Noise:
    """What readings scatter by, changes from any one session on taken out.

    Args:
        common: What is left of the readings.
        tests: Of any change of the machine.
        known_dof: Degrees of freedom of their standard deviations; 0 where these are not known.
    """
    contrasts = common.contrasts
    taken, count = max(tests, key=lambda t: t[0])
    rest, dof = max(common.square - taken, 0.0), contrasts.dof - count
    if known_dof == 0.0:
        if dof < LEAST_DOF:
            return _Noise(math.nan, 0.0)
        return _Noise(math.sqrt(rest / dof), dof)
    cycles = 0.0 if math.isinf(known_dof) else known_dof
    if dof - cycles >= 1.0 and chance_of_excess(rest, dof, cycles_dof=cycles) < BY_CHANCE:
        return _Noise(math.sqrt((rest - cycles) / (dof - cycles)), dof - cycles)
    return _Noise(1.0, known_dof)


def _tested(
    columns: Columns, common: Common, labels: Sequence[str], noise: _Noise
) -> tuple[TestedChange, ...]:
    """Each named suspect from each session on, by itself."""
    named = columns.named
    found = []
    for k in range(1, len(labels)):
        scores, information = common.test(columns.makes[:, named], k)
        for i, score, told in zip(named.tolist(), scores, information, strict=True):
            p = columns.suspects[i].parameter
            known = told > 0.0 and math.isfinite(noise.scale)
            size = float(score / told) if known else math.nan
            std = float(noise.scale / math.sqrt(told)) if known else math.nan
            found.append(TestedChange(p.name, p.unit, labels[k], size, std))
    return tuple(found)


def _select(columns: Columns, common: Common, limit: float) -> tuple[list[Step], Common]:
    """Changes of named suspects, the clearest first, until none is beyond a limit."""
    steps: list[Step] = []
    readings = 0
    while len(steps) < MOST_CHANGES:
        squares = _squares(columns, common, columns.named)
        best = max(squares, key=lambda s: s.square)
        if best.square <= limit**2:
            break
        left, told = common.single_readings()
        single = np.where(told > 0.0, left**2 / np.where(told > 0.0, told, 1.0), 0.0)
        entry, contrasts = int(single.argmax()), common.contrasts
        if single[entry] > best.square:
            readings += 1
            if readings > MOST_READINGS:
                break
            common = take_out_common(contrasts.extend(contrasts.reading(entry)))
            continue
        near = [s for s in squares if s.square > max(best.square - NEARLY, limit**2)]
        drives = [s for s in near if columns.suspects[s.suspect].part == "drive"]
        steps.append(max(drives or near, key=lambda s: s.square))
        common = _take_out(columns, common, steps[-1:])
    return steps, common


def _take_out(columns: Columns, common: Common, steps: Sequence[Step]) -> Common:
    """With changes of unknown size taken out, too."""
    contrasts = common.contrasts
    for step in steps:
        moved = contrasts.column(columns.makes[:, step.suspect], step.session)
        contrasts = contrasts.extend(moved / max(float(np.linalg.norm(moved)), 1e-300))
    return take_out_common(contrasts)


def _squares(columns: Columns, common: Common, suspects: Indices) -> list[Step]:
    """χ² of each of some suspects from each session on."""
    found = []
    for k in range(1, common.contrasts.n_sessions):
        scores, information = common.test(columns.makes[:, suspects], k)
        for i, score, told in zip(suspects.tolist(), scores, information, strict=True):
            found.append(Step(i, k, float(score**2 / told) if told > 0.0 else 0.0))
    return found


def _anything(
    columns: Columns,
    common: Common,
    machine: Indices,
    labels: Sequence[str],
    noise: _Noise,
    tests: list[tuple[float, float]],
) -> OtherChange | None:
    """Whether the machine is another from some session on, whatever has changed of it."""
    chances = {k: _chance(*test, noise) for k, test in enumerate(tests, start=1)}
    since = min(chances, key=lambda k: chances[k])
    if chances[since] >= ANYTHING / len(chances):
        return None
    parts = _parts_alone(columns, common, machine, noise, len(labels) - 1)
    return OtherChange(labels[since], chances[since], parts)


def _chance(square: float, dof: float, noise: _Noise) -> float:
    """Probability that the noise alone makes a χ² as large."""
    if dof == 0.0:
        return 1.0
    scaled = square / noise.scale**2
    if math.isinf(noise.dof):
        return chance_of_excess(scaled, dof)
    return f_tail(dof, noise.dof, scaled / dof)


def _parts_alone(
    columns: Columns, common: Common, machine: Indices, noise: _Noise, count: int
) -> tuple[str, ...]:
    """Parts of a machine of which a single error would explain what is left."""
    squares = _squares(columns, common, np.arange(len(columns.suspects)))
    best = max(squares, key=lambda s: s.square)
    left = _take_out(columns, common, [best])
    if min(_chance(*test, noise) for test in _test_machine(left, machine)) < ANYTHING / count:
        return ()
    near = [s for s in squares if s.square > best.square - NEARLY * noise.scale**2]
    parts = dict.fromkeys(columns.suspects[s.suspect].words for s in near)
    return tuple(parts) if len(parts) <= MOST_PARTS else ()


def _better_elsewhere(
    columns: Columns, common: Common, labels: Sequence[str], steps: Sequence[Step], noise: _Noise
) -> OtherChange | None:
    """Whether a single error of another part explains more than drives and legs do."""
    if not steps:
        return None
    squares = _squares(columns, common, np.arange(len(columns.suspects)))
    best = max(squares, key=lambda s: s.square)
    least = common.square - _take_out(columns, common, steps).square
    margin = NEARLY * noise.scale**2
    clearly = CLEARLY * noise.scale**2 * (2 - len(steps))
    if best.square <= (1.0 + BENT) * least + clearly:
        return None
    parts = dict.fromkeys(
        columns.suspects[s.suspect].words for s in squares if s.square > best.square - margin
    )
    chance = _chance(best.square, 1.0, noise)
    return OtherChange(labels[best.session], chance, tuple(parts)[:MOST_PARTS])


def _told(
    columns: Columns,
    common: Common,
    labels: Sequence[str],
    steps: Sequence[Step],
    which: int,
    size: float,
    std: float,
) -> Change:
    """A change that was found, and what may as well be the reason."""
    step = steps[which]
    rest = _take_out(columns, common, [s for s in steps if s is not step])
    squares = _squares(columns, rest, columns.named)
    own = next(s for s in squares if (s.suspect, s.session) == (step.suspect, step.session))
    near = [s for s in squares if s.square > own.square - NEARLY]
    suspect = columns.suspects[step.suspect]
    others = dict.fromkeys(s.suspect for s in near if s.suspect != step.suspect)
    times = [s.session for s in near if s.suspect == step.suspect and s.session != step.session]
    return Change(
        name=suspect.parameter.name,
        unit=suspect.parameter.unit,
        part=suspect.part,
        of=suspect.of,
        since=labels[step.session],
        size=size,
        std=std,
        perhaps=tuple(columns.suspects[i].parameter.name for i in others),
        perhaps_since=tuple(labels[k] for k in times),
    )
