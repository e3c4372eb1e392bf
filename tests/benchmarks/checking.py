"""Print which mistakes in readings are found and named, and how many sound sessions are accused.

python tests/benchmarks/checking.py                     a few sessions of every example
python tests/benchmarks/checking.py --sessions 10 --sound 334
python tests/benchmarks/checking.py --pairs 40          two reversed signs in different setups
python tests/benchmarks/checking.py --effects 1000      effects that the model lacks
python tests/benchmarks/checking.py --backlash 1000     backlash that was entered as stated, or not
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from made_mistakes import SIZES, is_named, make_mistakes, sound_machine, sound_session
from rich import box
from rich.console import Console
from rich.table import Table
from typer.testing import CliRunner
from unmodelled_machines import EffectSearch, plan_with_conditions, read_machines

from orthocal import check_session, join_sessions, load_plan, simulate_session
from orthocal.assessment.judgement import judge_session
from orthocal.cli import make_program
from orthocal.effects.compensation import JointTrim
from orthocal.hypotheses import family_scores, search
from orthocal.hypotheses.families.wrong_readings import inconsistent_groups
from orthocal.hypotheses.family_scores import CLEAR_LOG_BAYES, SIMILAR_LOG_BAYES
from orthocal.hypotheses.hypothesis import Rows
from orthocal.hypotheses.linear_model import LinearModel

EXAMPLES = ("raw-cycles", "sweep", "workshop")
ROOT = Path(__file__).parents[2]

LEGEND = """
Machines with all errors at their tolerances, offsets entered in every second session.
  size    over the noise of a reading; empty: as the readings have it
  found   anything was said
  placed  what was said first is where the mistake is, or one of several said is it
  named   by its kind and its rows, and nothing beside
  wrong   something was named, and nothing beside, that shares no row with the mistake
"""


def count_mistakes(example: str, sessions: int, sizes: tuple[float, ...]) -> dict:
    """(kind, size) to how many were made, found, placed, named, and named wrongly."""
    plan = load_plan(ROOT / "examples" / example / "plan.yaml")
    counts: dict = defaultdict(lambda: [0, 0, 0, 0, 0])
    for seed in range(sessions):
        session = sound_session(plan, seed, entered=seed % 2 == 1)
        for name, size, made in make_mistakes(session, seed, sizes=sizes):
            found = search.find_anomalies(session.with_values(made.values)).found
            told = [a.explanation for a in found[:1]]
            every = [e for a in found[:1] for e in (a.explanation, *a.alternatives)]
            named = [is_named(e, made) for e in every]
            placed = [frozenset(e.rows) == made.rows for e in told]
            alone = bool(found) and not found[0].alternatives
            row = counts[name, size]
            row[0] += 1
            row[1] += bool(told)
            row[2] += any(named) or any(placed)
            row[3] += alone and named[0]
            row[4] += alone and not set(told[0].rows) & made.rows
    return counts


def count_accused(example: str, sessions: int) -> int:
    """Sound sessions that `check` asks to review or rejects."""
    plan = load_plan(ROOT / "examples" / example / "plan.yaml")
    made = (sound_session(plan, seed, entered=seed % 2 == 1) for seed in range(sessions))
    return sum(check_session(session).decision.verdict != "enter" for session in made)


def new_plan():
    """The plan that `orthocal new` makes for a machine of the packaged dimensions."""
    machine = "--leg-mm 310.25 --travel-mm=190:390 --attachment-mm 40 --rods-apart-mm 80"
    more = "--rod-radius-mm 5 --counts up --at-zero-mm 310.25"
    with tempfile.TemporaryDirectory() as folder:
        done = CliRunner().invoke(
            make_program(), ["new", f"{folder}/m", *machine.split(), *more.split()]
        )
        assert done.exit_code == 0, done.output
        plan = load_plan(f"{folder}/m/first/session.yaml")
    return plan


def reverse_two_signs(plan, pairs: int) -> Iterator[tuple[object, frozenset[int]]]:
    """Sessions in which the signs of two readings of different setups are reversed."""
    for seed in range(pairs):
        session = sound_session(plan, seed, entered=seed % 2 == 1)
        rng = np.random.default_rng((seed, 11))
        while True:
            one, other = rng.choice(len(session.readings), 2, replace=False)
            values = session.values
            apart = session.readings[one].setup != session.readings[other].setup
            if apart and values[one] and values[other]:
                break
        values[[one, other]] *= -1.0
        yield session.with_values(values), frozenset((int(one), int(other)))


class _Exhaustive(search._Search):
    """A search that linearises far more sets of at most two hypotheses anew."""

    def compare(self, rows: frozenset[int]) -> tuple[float, float]:
        """Log evidence of the true pair, and of the best other set of one or two hypotheses."""
        state, table = self.sound, Rows(self.session, self.session.values)
        families = family_scores.list_families(self.model, table, grouped=True)
        scored = list(self.scorer.score(state, families))
        scored += list(self.scorer.score(state, inconsistent_groups(table)))
        sets = [(t,) for t in self.scorer.shortlist(scored)]
        sets += self.scorer.pairs(state, scored)[0]
        family = next(
            f for f, _ in scored
            if (e := f.explain(0)).kind == "reversed sign" and e.scope == "reading"
        )  # fmt: skip
        truth = tuple(self.scorer.term(family, i) for i in sorted(rows))
        own = self.sets.evaluate(truth, state.about).log_posterior
        keys = frozenset(t.explanation for t in truth)
        others = [
            self.sets.evaluate(s, state.about).log_posterior
            for s in sets
            if frozenset(t.explanation for t in s) != keys
        ]
        return own - state.log_posterior, max(others, default=-np.inf) - state.log_posterior


def count_pairs(plan, pairs: int) -> dict[str, int]:
    """Pairs of reversed signs that can be named, that are, and what is reported of the others."""
    counts = dict.fromkeys(("made", "can be named", "named", "others beyond 7", "reported"), 0)
    for session, rows in reverse_two_signs(plan, pairs):
        found = search.find_anomalies(session)
        refitted = family_scores.MAX_REFITTED, family_scores.MAX_REFITTED_PAIRS
        family_scores.MAX_REFITTED, family_scores.MAX_REFITTED_PAIRS = 40, 100
        own, other = _Exhaustive(session, LinearModel(session)).compare(rows)
        family_scores.MAX_REFITTED, family_scores.MAX_REFITTED_PAIRS = refitted
        can = own >= CLEAR_LOG_BAYES and own - other >= SIMILAR_LOG_BAYES
        kinds = {a.explanation.kind for a in found.found}
        told = frozenset(i for a in found.found for i in a.explanation.rows)
        alone = not any(a.alternatives for a in found.found)
        named = kinds == {"reversed sign"} and told == rows and alone
        counts["made"] += 1
        counts["can be named"] += can
        counts["named"] += can and named
        beyond = not can and max(own, other) >= CLEAR_LOG_BAYES
        counts["others beyond 7"] += beyond
        counts["reported"] += beyond and bool(found.found)
    return counts


def print_pairs(console: Console, pairs: int) -> None:
    """Print how often two reversed signs in different setups are named."""
    plans = {name: load_plan(ROOT / "examples" / name / "plan.yaml") for name in EXAMPLES[::2]}
    table = Table("plan", "made", "can be named", "named", "others beyond 7", "reported")
    for name, plan in {"new": new_plan(), **plans}.items():
        table.add_row(name, *map(str, count_pairs(plan, pairs).values()))
    console.print(table)


EFFECTS = {
    None: (1.0, 1.0),
    "backlash": (1.0, 1.0),
    "thermal": (10.0, 1.0),
    "screw": (3.0, 1.0),
    "drift": (1.0, 8.0),
}
"""Effects of the machines: the factor of their tolerances that readings of a dial show, and the
minutes between the readings; with 8 a session has the length of a working day."""

ENOUGH = 5.0
"""Gain in ln evidence of the true effect from which on it has to be named."""


def print_effects(console: Console, machines: int) -> None:
    """Print how often effects that the model lacks are named, and how often by a wrong name."""
    table = Table("effect", "times tolerance", "machines", "gain > 5", "of these named", "others")
    for effect, (level, pace) in EFFECTS.items():
        plan = plan_with_conditions(pace=pace)
        count = machines if effect is None else max(machines // 5, 1)
        readings = read_machines(plan, effect, count, level=level, seed=5)
        tool = EffectSearch(plan, effect)
        found = [tool.name(values) for values in readings]
        enough = [n for n in found if n.gain > ENOUGH]
        named = sum(n.effects[:1] == (effect,) for n in enough)
        others = sum(bool(n.effects) and n.effects[0] != effect for n in found)
        share = f"{named / len(enough):.3f}" if enough else ""
        row = (effect or "none", f"{level:g}", count, len(enough), share, others)
        table.add_row(*map(str, row))
    console.print(table)


def print_misnamed(console: Console, sessions: int) -> None:
    """Print how many mistakes in sessions with conditions are taken for an effect."""
    plan = plan_with_conditions(("yx", "xy", "xz")).with_effects([])
    plan = plan.select([r for r in plan.readings if r.cycle < 3])  # without closing readings
    made = named = 0
    for seed in range(sessions):
        session = sound_session(plan, seed, entered=True)
        for name, _, mistake in make_mistakes(session, seed, sizes=(5.0,)):
            found = search.find_anomalies(session.with_values(mistake.values)).found
            made += 1
            taken = [a.explanation.kind for a in found if a.explanation.amounts]
            if taken and not a_drift(mistake):
                named += 1
                console.print(f"{name}: {', '.join(taken)}")
    console.print(f"{named} of {made} mistakes taken for an effect")


ENTERED = {
    "as stated": (1.0, 1.0, 1.0),
    "not at all": (0.0, 0.0, 0.0),
    "by half": (0.5, 0.5, 0.5),
    "but for one drive": (1.0, 0.0, 1.0),
}
"""Compensation of the controller relative to the stated one, and what it is called."""


def compensated_session(plan, seed: int, parts, *, level: float, earlier: bool):
    """A session that states backlash to 0.01 mm, and may follow one without compensation.

    Args:
        plan: Readings of each session.
        seed: Of the machine and its readings.
        parts: Compensation of the controller relative to the stated one, shape (n_drives,).
        level: Factor of the tolerances of backlash of the machine.
        earlier: Whether a session without compensation precedes.
    """
    errors, _ = sound_machine(plan, seed, entered=True)
    names = [f"{d.name}.backlash" for d in plan.robot.drives]
    errors |= {n: level * errors[n] for n in names}
    rng = np.random.default_rng((seed, 5))
    stated = [max(round(errors[n] + 5e-6 * rng.normal(), 5), 0.0) for n in names]
    near = [errors[f"{d.name}.offset"] + 20e-6 * rng.normal() for d in plan.robot.drives]

    def measured(active, seed):
        trims = tuple(JointTrim(b) for b in active)
        used = replace(plan.with_controller(near), compensation=trims)
        return simulate_session(used, errors, seed=seed).session

    session = measured(np.multiply(stated, parts), seed)
    session = replace(session, compensation=tuple(JointTrim(b) for b in stated))
    return join_sessions([measured((0.0,) * 3, seed + 10**6), session]) if earlier else session


def print_backlash(console: Console, sessions: int) -> None:
    """Print how often a wrongly entered backlash is named, and how many sound sessions are accused.

    A tenth as many sessions have each mistake.
    """
    table = Table("sessions", "entered", "times tolerance", "made", "accused", "named")
    for earlier in (False, True):
        plan = plan_with_conditions(("yx", "xy", "xz") if earlier else None)
        plan = plan.with_effects(["backlash"])
        for name, parts in ENTERED.items():
            wrong = tuple(d.name for d, p in zip(plan.robot.drives, parts, strict=True) if p < 1.0)
            count = sessions // (4 if not wrong else 40)
            for level in (1.0, 3.0):
                accused = named = 0
                for seed in range(count):
                    session = compensated_session(plan, seed, parts, level=level, earlier=earlier)
                    judgement = judge_session(session)
                    accused += judgement.verdict != "enter"
                    kinds = [a.explanation.kind.partition(" ")[0] for a in judgement.anomalies]
                    drives = [a.explanation.drives for a in judgement.anomalies]
                    named += kinds == ["backlash"] and (drives == [wrong] or not wrong)
                row = ("two" if earlier else "one", name, f"{level:g}", count, accused, named)
                table.add_row(*map(str, row))
    console.print(table)


def a_drift(mistake) -> bool:
    """Whether a mistake is a drift, which is an effect too."""
    return "drift" in mistake.kinds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sessions", type=int, default=2, help="with mistakes, of every example")
    parser.add_argument("--sound", type=int, default=20, help="without, of every example")
    parser.add_argument("--example", action="append", choices=EXAMPLES)
    parser.add_argument("--size", action="append", type=float)
    parser.add_argument("--pairs", type=int, help="pairs of reversed signs on each plan")
    parser.add_argument("--effects", type=int, help="machines without and, a fifth, with effects")
    parser.add_argument("--backlash", type=int, help="sessions that state backlash")
    given = parser.parse_args()
    console = Console(width=100)
    if given.effects:
        print_effects(console, given.effects)
        print_misnamed(console, given.sessions)
        return
    if given.backlash:
        print_backlash(console, given.backlash)
        return
    if given.pairs:
        print_pairs(console, given.pairs)
        return
    for example in given.example or EXAMPLES:
        counts = count_mistakes(example, given.sessions, tuple(given.size or SIZES))
        table = Table(
            "mistake", "size", "made", "found", "placed", "named", "wrong", box=box.SIMPLE
        )
        for (name, size), (made, *others) in counts.items():
            shares = [f"{n / made:.2f}" for n in others]
            table.add_row(name, f"{size:g}" if size else "", str(made), *shares)
        every = [sum(row[k] for row in counts.values()) for k in range(5)]
        shares = [f"{n / max(every[0], 1):.2f}" for n in every[1:]]
        table.add_row("all", "", str(every[0]), *shares)
        console.print(f"\n{example}")
        console.print(table)
        accused = count_accused(example, given.sound)
        console.print(f"{accused} of {given.sound} sound sessions accused")
    console.print(LEGEND)


if __name__ == "__main__":
    main()
