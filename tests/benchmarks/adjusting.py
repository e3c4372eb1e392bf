"""Tool error of simulated machines after the planned adjustments, over that promised.

    .venv/bin/python tests/benchmarks/adjusting.py [MACHINES]

Machines have all errors at their priors, axes within 6 mrad. Readings are simulated with noise and
mounting, calibrated, and adjusted as planned: shims are set with errors, loops are closed by
Pinocchio alone.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from rich.console import Console

sys.path.insert(0, str(Path(__file__).parents[1]))

from adjusting import reached, shimmed_plan

from orthocal import adjust_calibration, calibrate, draw_errors, plan_adjustments, simulate_session

LARGEST = 1.15
"""Largest ratio of the root mean square tool error to the one promised."""


def main(machines: int) -> int:
    folder = Path(tempfile.mkdtemp()) / "mill"
    plan, squares, console = shimmed_plan(folder), [], Console(highlight=False)
    patterns = plan.robot.parameters.patterns("full")
    for seed in range(machines):
        errors = draw_errors(plan.robot, patterns, seed=seed)
        session = simulate_session(plan, errors, seed=seed, sigma=3e-6).session
        calibration = calibrate(session, solver="variable-projection")
        planned = plan_adjustments(calibration)
        adjusted = adjust_calibration(calibration, planned.amounts)
        after = reached(errors, adjusted, planned.amounts, seed=seed)
        before = reached(errors, calibration, {}, seed=seed)
        promised = planned.after.entered, planned.before.entered
        squares.append((after**2, promised[0] ** 2, before**2, promised[1] ** 2))
        console.print(
            f"{seed:3d} {planned.judgement:14s} {len(planned.adjustments):2d} adjustments, before "
            f"{before * 1e6:5.1f} µm (promised {promised[1] * 1e6:5.1f}), after "
            f"{after * 1e6:5.1f} µm ({promised[0] * 1e6:5.1f})"
        )
    after, promised, before, expected = np.sqrt(np.mean(squares, axis=0))
    ratio = after / promised
    console.print(f"before {before * 1e6:.1f} µm, ratio {before / expected:.3f}")
    console.print(f"after {after * 1e6:.1f} µm, ratio {ratio:.3f}; expected at most {LARGEST}")
    return int(ratio > LARGEST)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 30))
