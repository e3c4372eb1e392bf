"""Print what identification takes, over the size of the session, and beside SciPy on Pinocchio.

python tests/benchmarks/run.py            up to 12 030 readings
python tests/benchmarks/run.py --large    up to 100 050 readings; takes 3 GB and some minutes
"""

from __future__ import annotations

import argparse
import os
from typing import get_args

# as the command line does it, for the peer too: threads of small matrices get in each other's way
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from cases import MODEL, SIGMA, SWEEP, Timing, measure_apart, simulate
from peer import PeerProblem
from rich import box
from rich.console import Console
from rich.table import Table

from orthocal.estimation.options import SolverKind

SIZES = (SWEEP, 303, 1203)
LARGE_SIZES = (3003, 10005)

PEER_SIZES = (SWEEP, 303)
"""Larger ones take the peer minutes."""

COLUMNS = (
    "postures",
    "readings",
    "build\ns",
    "solve\ns",
    "iter.",
    "again\ns",
    "iter.",
    "µs a\nreading",
    "MB\nbefore",
    "MB\npeak",
    "peer\ns",
    "ratio",
    "ratio\nagain",
)

WIDTH = 100
"""Of the table, also where the output is no terminal."""

LEGEND = f"""
All parameters of model '{MODEL}' with their tolerances as prior, sigma {SIGMA * 1e6:g} µm.
  build, solve   from a session to its solution, in a fresh process with its libraries loaded
  again          other readings, same program
  µs a reading   build and solve
  MB             most memory held: before building (libraries, simulation), and until solved
  peer           scipy.optimize.least_squares on Pinocchio, finite differences (peer.py)
  ratio          peer over build and solve; over again
"""


def time_peer(n_postures: int) -> float:
    """Seconds that the peer takes."""
    session = simulate(n_postures)
    names = session.robot.parameters.select_model(MODEL)
    return PeerProblem(session, names=names, sigma=SIGMA).solve().seconds


def format_row(timing: Timing, peer: float | None) -> list[str]:
    """One line of the table."""
    compared = ["", "", ""]
    if peer is not None:
        ratios = peer / timing.seconds, peer / timing.seconds_again
        compared = [f"{peer:.2f}", *(f"{ratio:.1f}" for ratio in ratios)]
    return [
        str(timing.postures),
        str(timing.readings),
        f"{timing.seconds_build:.2f}",
        f"{timing.seconds_solve:.2f}",
        str(timing.iterations),
        f"{timing.seconds_again:.2f}",
        str(timing.iterations_again),
        f"{timing.microseconds_per_reading:.0f}",
        f"{timing.peak_before:.0f}",
        f"{timing.peak:.0f}",
        *compared,
    ]


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description="What identification takes.")
    parser.add_argument("--large", action="store_true", help="up to 100 050 readings as well")
    kinds = get_args(SolverKind)
    parser.add_argument("--solver", choices=kinds, default="variable-projection", help="which one")
    arguments = parser.parse_args()
    sizes = SIZES + (LARGE_SIZES if arguments.large else ())
    table = Table(box=box.SIMPLE, padding=(0, 0, 0, 1))
    for name in COLUMNS:
        table.add_column(name, justify="right", no_wrap=True)
    console = Console(width=WIDTH)
    with console.status("measuring") as status:
        for n in sizes:
            status.update(f"measuring {n} postures")
            peer = time_peer(n) if n in PEER_SIZES else None
            table.add_row(*format_row(measure_apart(n, arguments.solver), peer))
    console.print(table, LEGEND)


if __name__ == "__main__":
    main()
