"""Print whether the promises of calibrations hold for machines with effects beside geometry.

python tests/benchmarks/effects.py                  100 machines of every case
python tests/benchmarks/effects.py --machines 300   the long form

Machines have all errors and the effects at their priors, and are read by a simulator that shares no
formula with orthocal. Exit code 1 if a promise is not kept: the tool error, its bound, the coverage
of the intervals, or what identifying effects costs where there are none.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "effects"))

import numpy as np
from effect_machines import (
    BESIDE_BOUND,
    COST,
    EFFECTS,
    EffectMachines,
    identify_nothing,
    rms,
    write_plan,
)
from intervals import coverage_band
from scipy.stats import binom

WITHIN = 1.15
"""Largest ratio of the RMS tool error over machines to the predicted one."""

CASES = {**{name: (name,) for name in EFFECTS}, "all": EFFECTS}


def show(line):
    """Print a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def report(name, outcome):
    """Print the results of a case; whether its promises are kept."""
    found, predicted = rms(outcome.found), rms(outcome.predicted)
    show(f"{name}: tool error {1e6 * found:.1f} µm, predicted {1e6 * predicted:.1f} µm")
    show(f"  ratio {found / predicted:.3f} (at most {WITHIN}) of {len(outcome.found)} machines")
    show(f"  over its bound {found / outcome.bound:.3f} (at most {BESIDE_BOUND})")
    kept = found < WITHIN * predicted and found < BESIDE_BOUND * outcome.bound
    for kind, covered in (
        ("all directions", outcome.covered),
        ("determined by the readings", outcome.covered_determined),
    ):
        inside, n = int(covered.sum()), covered.size
        low, high = coverage_band(n)
        show(f"  {kind}: {inside} of {n} intervals hold (99 % band {low:.0f} to {high:.0f})")
        kept &= bool(low <= inside <= high)
    if outcome.covered_backlash.size:
        covered, n = int(outcome.covered_backlash.sum()), outcome.covered_backlash.size
        low = binom.ppf(0.005, n, 0.95)
        show(
            f"  {covered} of {n} backlashes within their intervals (at least {low:.0f}), "
            f"{outcome.at_bound} estimated as 0"
        )
        kept &= covered >= low
    return kept


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machines", type=int, default=100, help="of every case")
    parser.add_argument("--case", action="append", choices=[*CASES, "none"])
    stated = parser.parse_args()
    kept = True
    with tempfile.TemporaryDirectory() as directory:
        folder = write_plan(Path(directory) / "plan")
        for name in stated.case or [*CASES, "none"]:
            if name == "none":
                told, plain = identify_nothing(folder, stated.machines)
                show(
                    f"none: tool error {1e6 * told:.1f} µm with effects identified, "
                    f"{1e6 * plain:.1f} µm without; ratio {told / plain:.3f} (at most {COST})"
                )
                kept &= told < COST * plain
                continue
            machines = EffectMachines(folder, CASES[name])
            truth = machines.draw(np.random.default_rng(1), stated.machines)
            kept &= report(name, machines.identify(truth, np.random.default_rng(2)))
    sys.exit(0 if kept else 1)


if __name__ == "__main__":
    main()
