"""Print whether ± contains the truth if few contrasts determine the tolerance scale.

python tests/benchmarks/few_contrasts.py    5000 machines of every session and scale, 10 s

Machines are linear (`linear_machines.py`), and the scale is estimated for each of them, without a
test of significance. Exit code 1 if the mean coverage of a kind of parameter is below the 99 %
binomial band of one parameter. It may be above: k = 2 covers 95.45 %.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

from intervals import coverage_band
from linear_machines import LinearMachines

from orthocal import load_session

ROOT = Path(__file__).parents[2]
SESSIONS = ("table1/experiment-2", "raw-cycles", "workshop")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machines", type=int, default=5000, help="of every session and scale")
    count, kept = parser.parse_args().machines, True
    low, high = (n / count for n in coverage_band(count))
    sys.stdout.write(f"99 % band of {count} machines: {low:.4f} to {high:.4f}\n")
    for name in SESSIONS:
        machines = LinearMachines(load_session(ROOT / "examples" / name))
        for scale in (2.83, 6.0):
            covered = machines.cover(scale, count)
            sys.stdout.write(f"{name}, {machines.count_contrasts(scale):.2f} contrasts at {scale}:")
            for kind in ("scaled", "offset", "mounting"):
                share = float(covered[getattr(machines, f"is_{kind}")].mean())
                sys.stdout.write(f" {kind} {share:.4f}")
                kept &= share >= low
            sys.stdout.write("\n")
            sys.stdout.flush()
    sys.exit(0 if kept else 1)


if __name__ == "__main__":
    main()
