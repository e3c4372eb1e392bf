"""Print whether ± and tool error hold on machines whose errors exceed their tolerances.

python tests/benchmarks/worse_machines.py                  30 machines of every factor and model
python tests/benchmarks/worse_machines.py --machines 300   the long form
python tests/benchmarks/worse_machines.py --profile        with profile intervals of one offset

Machines are read as the paper's second experiment. Exit code 1 if ± contains too few offsets or
mountings, or if the tool error exceeds its prediction: of all machines at a factor of 1, else of
those whose factor was found above 1, since three contrasts show a factor of 2.83 in half of the
machines only.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from scaled_machines import calibrate_machines
from scipy.stats import binom

from orthocal import load_session

ROOT = Path(__file__).parents[2]
WITHIN = 1.15
"""Largest ratio of the RMS tool error of machines to the predicted one."""


def report(outcome, *, scaled):
    """Print the results of a factor and a model; whether both promises are kept."""
    judged = outcome.found if scaled else np.full(len(outcome.found), True)
    covered, n = int(outcome.covered[judged].sum()), outcome.covered[judged].size
    # three offsets of a machine are wrong together
    least = 3 * binom.ppf(0.005, n // 3, 0.95)
    mounted, n_mounted = int(outcome.mounted[judged].sum()), outcome.mounted[judged].size
    least_mounted = binom.ppf(0.005, n_mounted, 0.95)
    profiled, n_profiled = int(outcome.profiled[judged].sum()), outcome.profiled[judged].size
    least_profiled = binom.ppf(0.005, n_profiled, 0.95) if n_profiled else 0
    true, predicted = np.sqrt(np.mean(outcome.tool[judged] ** 2, axis=0))
    sys.stdout.write(
        f"  found above 1: {outcome.found.mean():.0%}; all machines: "
        f"{outcome.covered.mean():.3f} covered\n"
        f"  {covered} of {n} offsets within ± (at least {least:.0f}); tool error over prediction "
        f"{true / predicted:.2f} (at most {WITHIN})\n"
        f"  {mounted} of {n_mounted} mountings within ± (at least {least_mounted:.0f})\n"
    )
    if n_profiled:
        sys.stdout.write(
            f"  {profiled} of {n_profiled} offsets within their profile intervals "
            f"(at least {least_profiled:.0f})\n"
        )
    if scaled and not outcome.found.all():
        rest = ~outcome.found
        true_rest, predicted_rest = np.sqrt(np.mean(outcome.tool[rest] ** 2, axis=0))
        sys.stdout.write(
            f"  factor not found: {outcome.covered[rest].mean():.3f} covered; tool error over "
            f"prediction {true_rest / predicted_rest:.2f}\n"
        )
    sys.stdout.flush()
    kept = covered >= least and mounted >= least_mounted and profiled >= least_profiled
    return kept and true < WITHIN * predicted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machines", type=int, default=30, help="of every factor and model")
    parser.add_argument("--profile", action="store_true", help="profile intervals, of one offset")
    stated = parser.parse_args()
    options = {"count": stated.machines, "profile": ["x_slide.offset"] if stated.profile else []}
    session, kept = load_session(ROOT / "examples/table1/experiment-2"), True
    for factor in (1.0, 2.83):
        for model in ("offsets", "full"):
            sys.stdout.write(f"errors at {factor} times their tolerances, model {model}\n")
            outcome = calibrate_machines(session, model, factor=factor, **options)
            kept &= report(outcome, scaled=factor > 1.0)
    sys.exit(0 if kept else 1)


if __name__ == "__main__":
    main()
