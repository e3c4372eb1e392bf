"""Tool error after calibrations with a dial indicator, as expected and actual.

Simulated: machines with all errors within their tolerances. A ball touches a rod, with realistic
misalignment of the gauge: the paper's seven postures, 18 readings. Measure, calibrate, enter the
offsets, measure again. Only the last step uses the true errors: it compares the calibrated tool
with the actual one. The workpiece is aligned on the machine.
"""

from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

import orthocal

MACHINES = 4
FIRST = {"*.offset_mm": 4.0}  # limits of the offsets, ±2 standard deviations
AGAIN = {"*.offset_mm": 1.0}  # once they were entered
EXACT = orthocal.Mounting(direction=0.0, section=0.0, lateral=0.0, scale=0.0)

plan = orthocal.load_plan(Path(__file__).parent / "workshop/plan.yaml")
nominal = orthocal.Machine(plan.robot, {})


def simplify(session: orthocal.Session) -> orthocal.Session:
    """The same readings as if an exact gauge had touched the line between the rods."""
    setups = {}
    for name, setup in session.setups.items():
        s = setup.sensor
        line = orthocal.LegIndicator(s.leg, s.direction, s.section, EXACT)
        setups[name] = replace(setup, sensor=line)
    return replace(session, setups=setups)


expected, actual = defaultdict(list), defaultdict(list)  # mean squares of tool errors, by label


def evaluate(
    label: str,
    session: orthocal.Session,
    model: str,
    real: orthocal.Machine,
    judgement: orthocal.Judgement | None = None,
) -> orthocal.Calibration:
    """Calibrate, and compare the calibrated tool with the actual one."""
    result = orthocal.calibrate(session, model, solver="variable-projection", judgement=judgement)
    tool = orthocal.assess_tool(result)
    drives = nominal.inverse(tool.workspace.points) - result.active_offsets
    errors = tool.measure(result.machine.forward(drives) - real.forward(drives))
    actual[label].append(errors.aligned.rms**2)
    expected[label].append(tool.after.sizes.aligned.rms**2)
    return result


for seed in range(MACHINES):
    names = plan.robot.parameters.patterns("full")
    errors = orthocal.draw_errors(plan.robot, names, seed=seed, tolerances=FIRST)
    real = orthocal.Machine(plan.robot, errors)

    first = orthocal.simulate_session(plan, errors, seed=seed).session.with_tolerances(FIRST)
    judgement = orthocal.judge_session(first)  # does not depend on the model
    evaluate("first round, offsets", first, "offsets", real, judgement)
    calibration = evaluate("first round, full", first, "full", real, judgement)
    evaluate("  as of a line, exactly", simplify(first), "full", real)

    # the offsets that `orthocal calibrate` prints, and the same readings once more
    entered = plan.with_controller(np.round([e.enter for e in calibration.assessment.entries], 6))
    second = orthocal.simulate_session(entered, errors, seed=100 + seed).session
    second = second.with_tolerances(AGAIN)
    judgement = orthocal.judge_session(second)
    evaluate("offsets entered, offsets", second, "offsets", real, judgement)
    evaluate("offsets entered, full", second, "full", real, judgement)

print(f"{f'tool error of {MACHINES} machines, µm RMS':36}{'expected':>10}{'actual':>10}")
for label, squares in actual.items():
    sizes = (1e6 * np.sqrt(np.mean(v)) for v in (expected[label], squares))
    print(f"{label:36}" + "".join(f"{size:10.1f}" for size in sizes))
print("\nOffsets alone do not correct legs and axes. While the offsets are millimetres wrong, a")
print("ball half a millimetre beside its place costs accuracy. Later it hardly matters.")
