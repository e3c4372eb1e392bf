"""Mistakes as people make them while they read a dial and fill in a sheet, in simulated ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from orthocal import draw_errors, simulate_session
from orthocal.errors import OrthocalError
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.hypotheses.anomaly import PERSISTENT, Explanation

MM = 1e-3
SIZES = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Over the noise of a reading, with its rounding."""


@dataclass(frozen=True)
class Made:
    """A mistake that was made."""

    values: np.ndarray
    rows: frozenset[int]
    kinds: tuple[str, ...]
    """By which it is named rightly."""


class Sheet:
    """The rows of a session, and a hand that makes mistakes in them."""

    def __init__(self, session, rng):
        self.session, self.rng, self.values = session, rng, session.values.copy()
        self.setups: dict[str, np.ndarray] = {}
        self.cycles: dict[tuple[str, int], np.ndarray] = {}
        self.repeated: dict[tuple[str, str], np.ndarray] = {}
        for table, key in (
            (self.setups, lambda r: r.setup),
            (self.cycles, lambda r: (r.setup, r.cycle)),
            (self.repeated, lambda r: (r.setup, r.label)),
        ):
            for i, r in enumerate(session.readings):
                table[key(r)] = np.append(table.get(key(r), np.empty(0, int)), i)
        gauge = session.gauge
        self.noise = float(np.hypot(gauge.sigma, (gauge.resolution or 0.0) / np.sqrt(12.0)))

    def pick(self, table):
        return table[list(table)[self.rng.integers(len(table))]]

    def pick_two(self, table):
        one, other = self.rng.choice(len(table), 2, replace=False)
        keys = list(table)
        return table[keys[one]], table[keys[other]]

    def row(self):
        return np.array([int(self.rng.integers(self.values.size))])

    @property
    def legs(self):
        """Legs that are read; with a sensor at the tool, its frames, too."""
        return sorted({s.sensor.place for s in self.session.setups.values()})

    def leg(self):
        return self.legs[self.rng.integers(len(self.legs))]

    def of_leg(self, leg):
        names = [n for n, s in self.session.setups.items() if s.sensor.place == leg]
        return np.concatenate([self.setups[n] for n in names])

    @property
    def has_cycles(self):
        return len(self.cycles) > len(self.setups)

    def every(self):
        return np.arange(self.values.size)

    def sign(self):
        return 1.0 if self.rng.random() < 0.5 else -1.0

    def times(self, rows, factor, *kinds):
        values = self.values.copy()
        values[rows] *= factor
        step = (self.session.gauge.resolution or 1e-6) * min(factor, 1.0) if factor > 0 else None
        if step is not None:  # as many figures as people write
            values[rows] = np.round(values[rows] / step) * step
        return Made(values, frozenset(rows.tolist()), kinds)

    def plus(self, rows, by, *kinds):
        values = self.values.copy()
        values[rows] += np.round(by / 1e-6) * 1e-6
        return Made(values, frozenset(np.atleast_1d(rows).tolist()), kinds)

    def swapped(self, one, other):
        values = self.values.copy()
        values[one], values[other] = self.values[other], self.values[one]
        return Made(values, frozenset([*one.tolist(), *other.tolist()]), ("swapped rows",))

    def missed(self, rows, at):
        values, rest = self.values.copy(), rows[at:]
        values[rest[:-1]] = self.values[rest[1:]]
        return Made(values, frozenset(rest.tolist()), ("row offset",))

    def doubled(self, rows, at):
        values, rest = self.values.copy(), rows[at:]
        values[rest] = self.values[rows[at - 1 : -1]]
        return Made(values, frozenset(rest.tolist()), ("row offset",))

    def stuck(self, rows, begin, count):
        values, run = self.values.copy(), rows[begin : begin + count]
        values[run] = values[run[0]]
        return Made(values, frozenset(run.tolist()), ("stuck dial",))


Make = Callable[[Sheet], Made | None]


def plain_mistakes() -> dict[str, Make]:
    """Mistakes whose size the readings give."""

    def with_cycles(make: Make) -> Make:
        return lambda s: make(s) if s.has_cycles else None

    def posture(factor: float, kind: str) -> Make:
        return with_cycles(lambda s: s.times(s.pick(s.repeated), factor, kind))

    def leg(factor: float, kind: str) -> Make:
        return lambda s: s.times(s.of_leg(s.leg()), factor, kind)

    def one(factor: float, kind: str) -> Make:
        return lambda s: s.times(s.row(), factor, kind)

    def setup(factor: float, kind: str) -> Make:
        return lambda s: s.times(s.pick(s.setups), factor, kind)

    def every(factor: float, kind: str) -> Make:
        return lambda s: s.times(s.every(), factor, kind)

    def neighbours(s: Sheet):
        rows = s.pick(s.cycles)
        k = int(s.rng.integers(rows.size - 1))
        return s.swapped(rows[k : k + 1], rows[k + 1 : k + 2])

    def apart(s: Sheet):
        rows = s.pick(s.cycles)
        if rows.size < 2:
            return None
        i, j = sorted(s.rng.choice(rows.size, 2, replace=False))
        return s.swapped(rows[[i]], rows[[j]]) if j > i + 1 else s.swapped(rows[[0]], rows[[-1]])

    def across(s: Sheet):
        at: dict[tuple[str, int], list[int]] = {}
        for i, r in enumerate(s.session.readings):
            at.setdefault((r.posture, r.cycle), []).append(i)
        rows = np.array(s.pick({k: v for k, v in at.items() if len(v) > 1}))
        i, j = s.rng.choice(rows.size, 2, replace=False)
        return s.swapped(rows[[i]], rows[[j]])

    def postures(s: Sheet):
        name = list(s.setups)[s.rng.integers(len(s.setups))]
        return s.swapped(*s.pick_two({k: v for k, v in s.repeated.items() if k[0] == name}))

    def postures_everywhere(s: Sheet):
        sets: dict[str, list[int]] = {}
        for i, r in enumerate(s.session.readings):
            sets.setdefault(r.posture, []).append(i)
        first = s.session.readings[int(s.row()[0])].setup
        seen = [p for p in sets if any(s.session.readings[i].setup == first for i in sets[p])]
        a, b = s.rng.choice(seen, 2, replace=False)
        where = {(s.session.readings[i].setup, s.session.readings[i].cycle): i for i in sets[b]}
        pairs = [
            (i, where[key])
            for i in sets[a]
            if (key := (s.session.readings[i].setup, s.session.readings[i].cycle)) in where
        ]
        return s.swapped(np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs]))

    def legs(s: Sheet):
        if len(s.legs) < 2:
            return None
        one, other = (s.of_leg(s.legs[i]) for i in s.rng.choice(len(s.legs), 2, replace=False))
        return s.swapped(one, other) if one.size == other.size else None

    def backwards(s: Sheet):
        rows = s.pick(s.setups)
        half = rows.size // 2
        return s.swapped(rows[:half], rows[::-1][:half]) if half > 1 else None

    def shift(which: str, part: float) -> Make:
        def make(s: Sheet):
            rows = s.pick(s.cycles if which.endswith("cycle") else s.setups)
            rows = s.every() if which.endswith("session") else rows
            at = min(
                max(int(part * rows.size), 0 if which.startswith("missed") else 1), rows.size - 2
            )
            return s.doubled(rows, at) if which.startswith("doubled") else s.missed(rows, at)

        return make

    def stick(count: int) -> Make:
        def make(s: Sheet):
            rows = s.pick(s.setups)
            if rows.size < count:
                return None
            return s.stuck(rows, int(s.rng.integers(rows.size - count + 1)), count)

        return make

    def transposed(s: Sheet):
        row = s.row()
        text = f"{abs(float(s.values[row[0]])) / MM:.2f}"
        turned = float(text[:-2] + text[-1] + text[-2]) * MM
        by = turned - float(text) * MM
        return s.plus(row, by, "outlier") if abs(by) > 0.2 * MM else None

    def two_slips(s: Sheet):
        a, b = s.rng.choice(s.values.size, 2, replace=False)
        first = s.plus(a, s.sign() * 60.0 * s.noise)
        values = first.values.copy()
        values[b] += s.sign() * 60.0 * s.noise
        return Made(values, frozenset([int(a), int(b)]), ("outlier",))

    return {
        "all in inches": every(1 / 25.4, "wrong unit"),
        "all in mm, said to be inches": every(25.4, "wrong unit"),
        "all in um": every(1e3, "wrong unit"),
        "all in m": every(1e-3, "wrong unit"),
        "all ten times": every(10.0, "decimal point"),
        "all a tenth": every(0.1, "decimal point"),
        "all a hundred times": every(100.0, "decimal point"),
        "setup in inches": setup(1 / 25.4, "wrong unit"),
        "setup in um": setup(1e3, "wrong unit"),
        "setup in m": setup(1e-3, "wrong unit"),
        "setup ten times": setup(10.0, "decimal point"),
        "setup a tenth": setup(0.1, "decimal point"),
        "cycle of a setup ten times": with_cycles(
            lambda s: s.times(s.pick(s.cycles), 10.0, "decimal point")
        ),
        "leg in inches": leg(1 / 25.4, "wrong unit"),
        "leg ten times": leg(10.0, "decimal point"),
        "sign of a reading": one(-1.0, "reversed sign"),
        "sign of a posture, all cycles": posture(-1.0, "reversed sign"),
        "sign of a setup": setup(-1.0, "reversed sign"),
        "sign of two setups": lambda s: s.times(
            np.concatenate(s.pick_two(s.setups)), -1.0, "reversed sign"
        ),
        "sign of a leg": leg(-1.0, "reversed sign"),
        "sign of all": every(-1.0, "reversed sign"),
        "reading ten times": one(10.0, "decimal point"),
        "reading a tenth": one(0.1, "decimal point"),
        "reading a hundred times": one(100.0, "decimal point"),
        "posture ten times, all cycles": posture(10.0, "decimal point"),
        "neighbouring rows exchanged": neighbours,
        "rows of a setup exchanged": apart,
        "rows of two setups exchanged": across,
        "postures exchanged, all cycles": with_cycles(postures),
        "postures exchanged, all setups": postures_everywhere,
        "setups exchanged": lambda s: s.swapped(*s.pick_two(s.setups)),
        "legs exchanged": legs,
        "setup written backwards": backwards,
        "step missed early": shift("missed", 0.1),
        "step missed in the middle": shift("missed", 0.5),
        "step doubled early": shift("doubled", 0.1),
        "step doubled in the middle": shift("doubled", 0.5),
        "step missed in a cycle": with_cycles(shift("missed cycle", 0.0)),
        "dial stuck for 3": stick(3),
        "dial stuck for 6": stick(6),
        "dial stuck for 9": stick(9),
        "misread by 1 mm": lambda s: s.plus(s.row(), s.sign() * 1.0 * MM, "misread dial"),
        "misread by 0.5 mm": lambda s: s.plus(s.row(), s.sign() * 0.5 * MM, "misread dial"),
        "misread by 0.1 mm": lambda s: s.plus(s.row(), s.sign() * 0.1 * MM, "misread dial"),
        "digits transposed": transposed,
        "two slips": two_slips,
        "step missed, all later setups": shift("missed session", 0.3),
        "step doubled, all later setups": shift("doubled session", 0.3),
    }


def sized_mistakes(size: float) -> dict[str, Make]:
    """Mistakes of so many times the noise."""

    def by(s: Sheet) -> float:
        return s.sign() * size * s.noise

    def bump(s: Sheet):
        rows = s.pick(s.setups)
        if rows.size < 4:
            return None
        return s.plus(rows[int(s.rng.integers(2, rows.size - 1)) :], by(s), "displaced gauge")

    def bump_between(s: Sheet):
        if not s.has_cycles:
            return None
        rows = s.pick(s.setups)
        cycles = [s.session.readings[i].cycle for i in rows]
        at = cycles.index(int(s.rng.integers(2, max(cycles) + 1)))
        return s.plus(rows[at:], by(s), "displaced gauge")

    def reset(s: Sheet):
        inner = {k: v for k, v in s.cycles.items() if k[1] == 2}
        return s.plus(s.pick(inner), by(s), "displaced gauge") if inner else None

    def drift(s: Sheet):
        rows = s.pick(s.setups)
        ramp = by(s) * np.linspace(0.0, 1.0, rows.size)
        return s.plus(rows, ramp, "drift") if rows.size > 3 else None

    def drift_all(s: Sheet):
        values, size = s.values.copy(), by(s)
        for rows in s.setups.values():
            if rows.size < 4:
                return None
            values[rows] += size * np.linspace(0.0, 1.0, rows.size)
        return Made(values, frozenset(s.every().tolist()), ("drift",))

    def posture(s: Sheet):
        rows = s.pick(s.repeated)
        return s.plus(rows, by(s), "inconsistent posture") if rows.size > 1 else None

    return {
        "slip": lambda s: s.plus(s.row(), by(s), "outlier"),
        "slip, all cycles": posture,
        "stand bumped": bump,
        "stand bumped between cycles": bump_between,
        "gauge set anew for a cycle": reset,
        "drift of a setup": drift,
        "drift of all setups": drift_all,
    }


def sound_session(plan, seed: int, *, entered: bool):
    """A session of a machine with all errors at their tolerances; see `sound_machine`."""
    return sound_machine(plan, seed, entered=entered)[1]


def sound_machine(plan, seed: int, *, entered: bool):
    """Errors of a machine at their tolerances, and a session of it.

    With its offsets `entered`, up to 20 µm, or at 0.4 of their tolerance.
    """
    robot = plan.robot
    for attempt in range(20):
        errors = draw_errors(robot, machine_errors(robot), seed=1000 * attempt + seed)
        offsets = [f"{d.name}.offset" for d in robot.drives]
        used = plan
        if entered:
            rng = np.random.default_rng((seed, attempt))
            near = [errors[n] + 20e-6 * rng.normal() for n in offsets]
            used = plan.with_controller(near)
        else:
            errors.update({n: errors[n] * 0.4 for n in offsets})
        try:
            return errors, simulate_session(used, errors, seed=seed).session
        except OrthocalError:
            continue
    raise AssertionError("no machine shows readings within the gauge's range")


def make_mistakes(session, seed: int, *, sizes=SIZES) -> Iterator[tuple[str, float, Made]]:
    """Every mistake once in a session: its name, its size over the noise (0: as it is), and it."""
    for k, (name, make) in enumerate(plain_mistakes().items()):
        made = make(Sheet(session, np.random.default_rng((seed, k))))
        if made is not None and not np.array_equal(made.values, session.values):
            yield name, 0.0, made
    for size in sizes:
        for k, (name, make) in enumerate(sized_mistakes(size).items()):
            made = make(Sheet(session, np.random.default_rng((seed, k, 7))))
            if made is not None:
                yield name, size, made


def is_named(explanation: Explanation, made: Made) -> bool:
    """Whether an explanation has the kind and the rows of a mistake that was made."""
    if explanation.kind not in made.kinds:
        return False
    rows = set(explanation.rows)
    if explanation.kind in PERSISTENT:  # a row more or less
        return len(rows ^ made.rows) <= 1
    return rows == made.rows or (len(made.rows) == 2 and len(rows) == 1 and rows < made.rows)
