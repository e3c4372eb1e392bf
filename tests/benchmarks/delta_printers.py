"""Print the errors of simulated delta printers before and after their calibration.

python tests/benchmarks/delta_printers.py                  five printers
python tests/benchmarks/delta_printers.py --printers 100   the long form, 15 minutes

Each printer has all errors of the complete model, a tilted bed, and 41 probed points with a noise
of 0.02 mm. Its settings come from Klipper's way (`klipper_peer.py`), and from orthocal through its
export to Klipper; both are then used by the printer as it really is. Exit code 1 if a promise is
not kept: errors of the first layer and of the tool within 1.15 of the expected ones, 95 % of
independent intervals that contain the truth.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from intervals import LIMIT, coverage_band, recorded_scores
from klipper_peer import calibrate_as_klipper
from simulated_printer import Printer, nominal, read_settings, rings, write_log

from orthocal import calibrate, draw_errors
from orthocal.assessment.printer_settings import fit_firmware
from orthocal.measurement.importing.printer_log import import_printer_log
from orthocal.printers.firmwares import FIRMWARES
from orthocal.units import MM

NOISE_MM = 0.02
TRIGGER_MM = 1.85
TILT = 2.5e-3
"""Standard deviation of the bed's slope along x and y."""
WITHIN = 1.15
HALF_MM = 70.0


@dataclass
class Result:
    """One printer, [mm]."""

    layer: tuple
    """RMS height of the first layer: before, with Klipper's settings, with ours."""
    tool: tuple
    """RMS tool error above the bed, likewise."""
    expected: tuple
    """Expected RMS height of the first layer and tool error with ours."""
    covered: np.ndarray
    """Whether independent 95 % intervals contain the truth."""
    verdict: str
    seconds: tuple
    """Of Klipper's way and of ours."""


def disc(radius):
    """Points of equal areas, none of them probed, shape (127, 2), [mm]."""
    points = [np.zeros(2)]
    for ring in range(1, 7):
        a = 2.0 * np.pi * (np.arange(6 * ring) + 0.3) / (6 * ring)
        points += list(radius * ring / 6.0 * np.column_stack([np.cos(a), np.sin(a)]))
    return np.array(points)


def first_layer(printer, settings):
    """RMS height above the bed of a first layer that is printed at height 0, [mm]."""
    xy = disc(math.sqrt(2.0) * HALF_MM)
    heights = printer.above_bed(settings.travel(np.column_stack([xy, np.zeros(len(xy))])))
    return float(np.sqrt(np.mean(heights**2)))


def tool_error(printer, settings):
    """RMS deviation over the volume of a printed box, placed on the bed as it comes, [mm]."""
    line = np.arange(-6, 7, 2) / 7.0  # middles of seven equal parts
    x, y, z = (v.ravel() for v in np.meshgrid(line, line, line))
    wanted = np.column_stack([x * HALF_MM, y * HALF_MM, (z + 1.0) * HALF_MM])
    reached = printer.nozzle(settings.travel(wanted)) @ bed_axes(printer)
    off = reached - wanted
    arms = np.column_stack([-wanted[:, 1], wanted[:, 0]])
    motion = np.zeros((len(off), 3, 3))
    motion[:, 0, 0] = motion[:, 1, 1] = 1.0
    motion[:, :2, 2] = arms
    a, b = motion.reshape(-1, 3), off.ravel()
    rest = (b - a @ np.linalg.lstsq(a, b, rcond=None)[0]).reshape(-1, 3)
    return float(np.sqrt(np.mean((rest**2).sum(axis=1))))


def bed_axes(printer):
    """Axes of the bed in columns, the third one its normal."""
    normal = np.array([-printer.tilt[0], -printer.tilt[1], 1.0])
    normal /= np.linalg.norm(normal)
    x = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(normal, x), normal])


def draw_printer(folder, seed):
    """A printer with random errors and a random slope of its bed."""
    log = Path(folder) / "nominal.txt"
    log.write_text(write_log("klipper", nominal(), rings(), np.zeros(len(rings()))))
    robot = import_printer_log(log).session.robot
    errors = draw_errors(robot, robot.parameters.select_model("full"), seed=seed)
    tilt = TILT * np.random.default_rng((seed, 1)).normal(size=2)
    return Printer(robot, errors, tuple(tilt), TRIGGER_MM)


def examine(folder, seed, *, solver="variable-projection"):
    """Probe a printer, calibrate it in both ways, and use both settings."""
    printer, rng, settings = draw_printer(folder, seed), np.random.default_rng((seed, 2)), nominal()
    z = printer.probe(settings, rings(), noise=NOISE_MM, rng=rng)
    log = Path(folder) / "log.txt"
    log.write_text(write_log("klipper", settings, rings(), z, -TRIGGER_MM))
    began = time.process_time()
    theirs, _ = calibrate_as_klipper(
        settings, settings.travel(np.column_stack([rings(), z])), TRIGGER_MM
    )
    between = time.process_time()
    calibration = calibrate(import_printer_log(log).session, solver=solver)
    fit = fit_firmware(calibration, "klipper")
    seconds = between - began, time.process_time() - between
    ours = read_settings("klipper", FIRMWARES["klipper"].config_lines(fit.settings))
    used = settings, theirs, ours
    return Result(
        layer=tuple(first_layer(printer, s) for s in used),
        tool=tuple(tool_error(printer, s) for s in used),
        expected=(
            math.hypot(fit.new.layer_rms, fit.layer_uncertainty) / MM,
            math.hypot(fit.new.tool_rms, fit.tool_uncertainty) / MM,
        ),
        covered=intervals(calibration, printer.errors),
        verdict=calibration.assessment.decision.verdict,
        seconds=seconds,
    )


def intervals(calibration, errors):
    """Whether independent 95 % intervals contain the truth."""
    return np.abs(recorded_scores(calibration, errors)[0]) < LIMIT


def report(results):
    """Print the errors; whether every promise is kept."""
    lines, kept = [], True
    for name, k, field in (("first layer", 0, "layer"), ("tool error", 1, "tool")):
        before, theirs, ours = np.sqrt(np.mean([np.square(getattr(r, field)) for r in results], 0))
        expected = math.sqrt(np.mean([r.expected[k] ** 2 for r in results]))
        better = sum(getattr(r, field)[2] < getattr(r, field)[1] for r in results)
        lines.append(
            f"{name}: before {before:.3f}, Klipper {theirs:.3f}, ours {ours:.3f} mm RMS "
            f"(expected {expected:.3f}, ratio {ours / expected:.2f}); ours is better on "
            f"{better} of {len(results)} printers"
        )
        kept &= len(results) < 20 or ours < WITHIN * expected
    covered = np.concatenate([r.covered for r in results])
    low, high = coverage_band(covered.size)
    lines.append(
        f"{covered.sum()} of {covered.size} intervals contain the truth (99 % band {low:.0f} to "
        f"{high:.0f})"
    )
    kept &= bool(low <= covered.sum() <= high)
    verdicts = [r.verdict for r in results]
    lines.append(f"verdicts: { {v: verdicts.count(v) for v in set(verdicts)} }")
    a, b = np.mean([r.seconds for r in results], axis=0)
    lines.append(f"time: Klipper {a:.1f} s, ours {b:.1f} s for each printer")
    sys.stdout.write("\n".join(lines) + "\n")
    return kept


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--printers", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="seed of the first printer")
    given = parser.parse_args()
    results = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(given.first, given.first + given.printers):
            results.append(examine(folder, seed))
            if sys.stderr.isatty():
                sys.stderr.write(f"\r{len(results)}")
    sys.exit(0 if report(results) else 1)


if __name__ == "__main__":
    main()
