"""Wrong units, decimal points and signs of setups, cycles, legs, gauges or all readings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.hypotheses.anomaly import AnomalyKind, Explanation, Scope
from orthocal.hypotheses.hypothesis import Family, Rows
from orthocal.units import MM

UNITS = (25.4, 1.0 / 25.4, 1e3, 1e-3)
"""Factors that correct readings in inches, readings in mm stated as inches, m, and µm."""

DECIMAL_POINTS = (10.0, 0.1, 100.0, 0.01)
"""Factors that correct a misplaced decimal point."""

MAX_RELATIVE_STEP = 10.0
"""Largest plausible step of the corrected numbers, relative to the noise."""

MIN_RELATIVE_STEP = 1e-3
"""Smallest plausible step of the corrected numbers, relative to the noise. Nobody reads a dial more
finely; such numbers were computed."""

READ_FRACTION = 0.1
"""Smallest part of a gauge's division that is read."""

MAX_DECIMALS = 8
"""Largest number of decimals, in mm, of a step."""

STEP_TOLERANCE = 1e-5
"""Largest distance of a number from a multiple of the step, in steps: rounding errors."""

MAX_PAIRED_SETUPS = 24
"""Number of setups of a session above which pairs of setups are not tested."""


def wrong_units_and_signs(rows: Rows) -> Iterator[Family]:
    """Hypotheses that all readings of a group have a wrong unit, decimal point or sign.

    Groups are the session, legs, gauges and setups. In addition, pairs of setups may have reversed
    signs, and cycles a wrong unit or decimal point.
    """
    reversed_groups = [g for g in _reverse_groups(rows) if rows.written[list(g.rows)].all()]
    if not reversed_groups:
        return
    yield factor_family(rows, reversed_groups)
    setups = [name for name, indices in rows.setups.items() if rows.written[indices].all()]
    if 3 < len(setups) <= MAX_PAIRED_SETUPS:  # of fewer, a pair is all of them or all but one
        pairs = combinations(setups, 2)
        yield factor_family(rows, [_reverse("setups", rows.of_setups(p), p) for p in pairs])
    # not cycles of a single reading, such as the closing one, nor of all readings but one
    reversed_cycles = [
        _reverse("cycle", indices, names=(setup,), cycle=cycle)
        for (setup, cycle), indices in rows.cycles.items()
        if setup in setups and 1 < len(indices) < len(rows.setups[setup]) - 1
    ]
    groups = reversed_groups + reversed_cycles
    yield _scale(rows, groups, "wrong unit", UNITS)
    yield _scale(rows, groups, "decimal point", DECIMAL_POINTS)


def factor_family(
    rows: Rows, explanations: Sequence[Explanation], *, size: int | None = None
) -> Family:
    """Family of hypotheses that correct their rows by a factor.

    Decimal points are omitted if the gauge cannot have shown the corrected numbers.

    Args:
        rows: The rows.
        explanations: The explanations, with factors.
        size: Number of possible mistakes of this kind; the number of explanations by default.
    """
    size = len(explanations) if size is None else size
    explanations = _without_unreadable(rows, explanations)
    factors = np.array([e.factor for e in explanations], dtype=np.float64)
    changes = [
        (f - 1.0) * rows.values[list(e.rows)] for f, e in zip(factors, explanations, strict=True)
    ]
    # the likelihood is a density of the readings, so a change of their scale changes it
    dimensions = np.array([_dimensions(rows, e) for e in explanations])
    volume = dimensions * np.log(np.abs(factors))
    return Family.edited(rows, explanations, changes, size=size, log_volume=volume)


def _without_unreadable(rows: Rows, explanations: Sequence[Explanation]) -> list[Explanation]:
    """Explanations without those decimal points whose corrected numbers no gauge shows.

    If the session has finer numbers than a gauge shows, they are means, and all may be as fine.
    """
    steps = decimal_steps(rows.values)
    divisions = np.array([rows.gauge(i).resolution or 0.0 for i in range(rows.count)])
    smallest_steps = np.minimum(READ_FRACTION * divisions, steps[rows.written].min(initial=np.inf))

    def can_be_read(explanation: Explanation) -> bool:
        concerned, factor = list(explanation.rows), explanation.factor or 1.0
        smallest = (1.0 - STEP_TOLERANCE) * smallest_steps[concerned].max()
        return bool(factor * steps[concerned].min() >= smallest)

    return [e for e in explanations if e.kind != "decimal point" or can_be_read(e)]


def _reverse(
    scope: Scope,
    indices: Indices,
    setups: tuple[str, ...] = (),
    names: tuple[str, ...] = (),
    cycle: int | None = None,
) -> Explanation:
    """Explanation that the sign of all rows of a group is reversed.

    Args:
        scope: Kind of the group.
        indices: Rows of the group.
        setups: Setups that belong to the group with all their rows.
        names: Name of the leg, gauge or setup in messages.
        cycle: Number of a cycle; None for other groups.
    """
    concerned = tuple(indices.tolist())
    return Explanation("reversed sign", scope, concerned, setups, names, cycle, factor=-1.0)


def _reverse_groups(rows: Rows) -> list[Explanation]:
    """Explanations that the sign of the session, a leg, a gauge or a setup is reversed."""
    setup_names = tuple(rows.setups)
    explanations = [_reverse("session", np.arange(rows.count), setup_names)]
    for (scope, name), setups in rows.groups.items():
        explanations.append(_reverse(scope, rows.of_setups(setups), setups, (name,)))
    if len(setup_names) > 1:
        explanations += [
            _reverse("setup", indices, (name,)) for name, indices in rows.setups.items()
        ]
    return explanations


def _scale(
    rows: Rows,
    groups: Sequence[Explanation],
    kind: AnomalyKind,
    factors: tuple[float, ...],
) -> Family:
    """Family of groups multiplied by each factor after which the decimal step is plausible.

    The step is compared with the largest noise of the gauges of a group. With factors below 1 any
    step is plausible: they make it finer.

    Args:
        rows: The rows.
        groups: Explanations of the groups by a reversed sign.
        kind: Kind of the new explanations.
        factors: Factors that correct the readings.
    """
    of_rows = decimal_steps(rows.values)
    noise_of_rows = np.array([rows.sigma(i) for i in range(rows.count)])
    steps = [of_rows[list(g.rows)].min() for g in groups]
    sigmas = [noise_of_rows[list(g.rows)].max() for g in groups]
    explanations = [
        replace(g, kind=kind, factor=factor)
        for factor in factors
        for g, step, sigma in zip(groups, steps, sigmas, strict=True)
        if factor < 1.0 or MIN_RELATIVE_STEP * sigma <= factor * step <= MAX_RELATIVE_STEP * sigma
    ]
    return factor_family(rows, explanations, size=len(groups) * len(factors))


def _dimensions(rows: Rows, group: Explanation) -> int:
    """Number of independent readings in a group: its rows minus the free zeros of its setups."""
    if not group.setups:
        return len(group.rows)
    session = rows.session
    setups = {session.readings[i].setup for i in group.rows if rows.single[i]}
    return len(group.rows) - sum(session.setups[name].zero == "free" for name in setups)


def decimal_steps(values: Array) -> Array:
    """Largest decimal step (1 mm, 0.1 mm, …) that divides each value, [m]; 0 if there is none."""
    result = np.zeros(len(values))
    for decimals in reversed(range(MAX_DECIMALS + 1)):
        step = 10.0**-decimals * MM
        integers = np.round(values / step)
        divides = np.abs(values / step - integers) < STEP_TOLERANCE
        result[divides & ((integers != 0.0) | (values == 0.0))] = step
    return result
