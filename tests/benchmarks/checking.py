"""Print which mistakes in readings are found and named, and how many sound sessions are accused.

python tests/benchmarks/checking.py                     a few sessions of every example
python tests/benchmarks/checking.py --sessions 10 --sound 334
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import defaultdict
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

from made_mistakes import SIZES, is_named, make_mistakes, sound_session
from rich import box
from rich.console import Console
from rich.table import Table

from orthocal import load_plan
from orthocal.hypotheses.search import find_mistakes

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
            told = find_mistakes(session.with_values(made.values))
            named = [is_named(m, made) for t in told[:1] for m in (t, *t.others)]
            placed = [frozenset(t.rows) == made.rows for t in told[:1]]
            alone = bool(told) and not told[0].others
            row = counts[name, size]
            row[0] += 1
            row[1] += bool(told)
            row[2] += any(named) or any(placed)
            row[3] += alone and named[0]
            row[4] += alone and not set(told[0].rows) & made.rows
    return counts


def count_accused(example: str, sessions: int) -> int:
    """Sound sessions of which a mistake is told."""
    plan = load_plan(ROOT / "examples" / example / "plan.yaml")
    return sum(
        bool(find_mistakes(sound_session(plan, seed, entered=seed % 2 == 1)))
        for seed in range(sessions)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sessions", type=int, default=2, help="with mistakes, of every example")
    parser.add_argument("--sound", type=int, default=20, help="without, of every example")
    parser.add_argument("--example", action="append", choices=EXAMPLES)
    parser.add_argument("--size", action="append", type=float)
    given = parser.parse_args()
    console = Console(width=100)
    for example in given.example or EXAMPLES:
        counts = count_mistakes(example, given.sessions, tuple(given.size or SIZES))
        table = Table(
            "mistake", "size", "made", "found", "placed", "named", "wrong", box=box.SIMPLE
        )
        for (name, size), (made, *others) in counts.items():
            shares = [f"{n / made:.2f}" for n in others]
            table.add_row(name, f"{size:g}" if size else "", str(made), *shares)
        every = [sum(row[k] for row in counts.values()) for k in range(5)]
        table.add_row("all", "", str(every[0]), *(f"{n / every[0]:.2f}" for n in every[1:]))
        console.print(f"\n{example}")
        console.print(table)
        accused = count_accused(example, given.sound)
        console.print(f"{accused} of {given.sound} sound sessions accused")
    console.print(LEGEND)


if __name__ == "__main__":
    main()
