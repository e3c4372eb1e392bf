"""What all errors of a machine are worth to somebody with a dial, and what spoils it.

Simulated: machines with all errors within their tolerances, read by a ball on a rod with a dial
that stands as crooked as a hand makes it: the paper's seven postures, 18 readings. The main loop
twice: measure, calibrate, enter the offsets, measure again. No calibration reads the truth; it is
used at the end to see how far each one is from it. Errors of the tool are told with shift and
rotation of the whole region taken out: a workpiece is aligned on the machine.
"""

from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

import orthocal
from orthocal import Calibration, Choice, Session
from orthocal.assessment.controller_entries import entered_offsets
from orthocal.assessment.tool_error import assess_tool
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.workspace import cube
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.sensors.mounting import EXACT

MACHINES = 4
FIRST = {"*.offset_mm": 4.0}  # limits of the offsets, ±2 standard deviations
AGAIN = {"*.offset_mm": 1.0}  # once they were entered

plan = orthocal.load_plan(Path(__file__).parent / "workshop/plan.yaml")
robot, space = plan.robot, cube(plan.robot, points_a_side=5)  # ±60 mm around the mechanical zero
drives = LoopClosure(robot).inverse(space.points)  # as a nominal controller commands them


def simplify(session: Session) -> Session:
    """The same readings as if an exact dial had touched the line between the rods."""
    setups = {}
    for name, setup in session.setups.items():
        s = setup.sensor
        setups[name] = replace(setup, sensor=LegIndicator(s.leg, s.direction, s.section, EXACT))
    return replace(session, setups=setups)


promised, kept = defaultdict(list), defaultdict(list)  # mean squares at the tool, by what was done


def hold(label: str, session: Session, choice: Choice, real: LoopClosure) -> Calibration:
    """Calibrate, and hold the calibrated tool against the real one."""
    result = orthocal.calibrate(session, choice, solver="variable-projection")
    at = drives - result.active_offsets
    left = space.remove_motion(result.machine.forward(at) - real.forward(at), space.points)
    kept[label].append(space.weights @ (left**2).sum(axis=1))
    promised[label].append(assess_tool(result, space).after.sizes.aligned.rms ** 2)
    return result


for seed in range(MACHINES):
    errors = orthocal.draw_errors(
        robot, robot.parameters.patterns("full"), seed=seed, tolerances=FIRST
    )
    real = LoopClosure(robot, fixed=errors)

    first = orthocal.simulate_session(plan, errors, seed=seed).session
    hold("first round, offsets", first, Choice("offsets", tolerances=FIRST), real)
    found = hold("first round, full", first, Choice("full", tolerances=FIRST), real)
    hold("  as of a line, exactly", simplify(first), Choice("full", tolerances=FIRST), real)

    # what `orthocal calibrate` says to enter, and the same readings once more
    entered = plan.with_controller(np.round(entered_offsets(found), 6))
    second = orthocal.simulate_session(entered, errors, seed=100 + seed).session
    hold("offsets entered, offsets", second, Choice("offsets", tolerances=AGAIN), real)
    hold("offsets entered, full", second, Choice("full", tolerances=AGAIN), real)

print(f"{'µm at the tool, of ' + str(MACHINES) + ' machines':36}{'promised':>10}{'kept':>10}")
for label, squares in kept.items():
    sizes = (1e6 * np.sqrt(np.mean(v)) for v in (promised[label], squares))
    print(f"{label:36}" + "".join(f"{size:10.1f}" for size in sizes))
print("\nOffsets alone leave what legs and axes do. With offsets millimetres off, a ball half a")
print("millimetre beside its place tells less; once they are entered, it hardly matters.")
