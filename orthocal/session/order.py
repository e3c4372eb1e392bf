"""Order in which the readings of a session are taken."""

from __future__ import annotations

from collections.abc import Sequence, Set

from orthocal.session.points import base_name
from orthocal.session.session import Reading


def order_of_measurement(readings: Sequence[Reading]) -> list[int]:
    """Indices of readings in the order of measurement.

    The readings of a setup precede those of the next setup. Its closing reading, which repeats the
    first posture, is the last one: rows that were added after it are read before it.

    Args:
        readings: Readings in the order of their rows.
    """
    lines = [i if r.line is None else r.line for i, r in enumerate(readings)]
    used = frozenset(lines)
    by_setup: dict[str, list[int]] = {}
    for i, r in enumerate(readings):
        by_setup.setdefault(base_name(r.setup), []).append(i)
    order = []
    for indices in by_setup.values():
        visits = _visits([readings[i] for i in indices])
        first, last = _closing(visits, [lines[i] for i in indices], used)
        order += indices[:first] + indices[last:] + indices[first:last]
    return order


def _visits(readings: Sequence[Reading]) -> list[bool]:
    """True for each reading of a setup that is taken where the setup begins."""
    begin = readings[0].minus or readings[0].posture, readings[0].approach
    again = [r.minus is None and (r.posture, r.approach) == begin for r in readings[1:]]
    return [True, *again]


def _closing(visits: Sequence[bool], lines: Sequence[int], used: Set[int]) -> tuple[int, int]:
    """Begin and end of the closing readings in the rows of a setup; two equal ones without any.

    A visit of the first posture begins another cycle, and closes nothing, if at least as many lines
    follow it in the file as are between it and the visit before. Blank lines of deleted rows count.

    Args:
        visits: True for each row in the first posture.
        lines: Lines of the rows.
        used: Lines of all setups.
    """
    end = max(n for n, visit in enumerate(visits) if visit) + 1
    begin = end
    while begin > 0 and visits[begin - 1]:
        begin -= 1
    if begin == 0:
        return end, end
    of_setup = set(lines)
    before = max(line for line, visit in zip(lines[:begin], visits[:begin], strict=True) if visit)
    possible = range(before + 1, lines[begin])
    between = sum(line in of_setup or line not in used for line in possible)
    following = range(lines[end - 1] + 1, lines[end - 1] + 1 + between)
    return (end, end) if of_setup.issuperset(following) else (begin, end)
