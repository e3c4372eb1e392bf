"""What the paper's own readings tell of all errors of a machine, and what more of them add.

Simulated, on one machine with all errors at tolerance, by a gauge that stands and points exactly
as the session says. No calibration reads the truth; it is used at the end to see how far each one
is from it. Errors of the tool are told with shift and rotation of the whole region taken out: a
workpiece is aligned on the machine.
"""

from pathlib import Path

import numpy as np

import orthocal
from orthocal.assess.accuracy import assess_tool, find_remaining_errors
from orthocal.kinematics.assembly import Assembly
from orthocal.kinematics.workspace import cube
from orthocal.measurement.synthetic import load_errors

EXAMPLES = Path(__file__).parent
TOLERANCES = {"*.offset_mm": 2.0}  # the workshop's word for its offsets, one sigma

robot = orthocal.load_robot("orthoglide")
space = cube(robot)  # ±60 mm around the mechanical zero
drives = Assembly(robot).inverse(space.points)  # as a nominal controller commands them
errors = load_errors(EXAMPLES / "sweep/truth.yaml", robot)
real = Assembly(robot, fixed=errors).forward(drives)


def error_at_tool(predicted: np.ndarray) -> float:
    """R.m.s. over the cube, shift and rotation taken out, in µm."""
    error = space.remove_motion(predicted - real, space.points)
    return 1e6 * float(np.sqrt(space.weights @ (error**2).sum(axis=1)))


paper = orthocal.load_plan(EXAMPLES / "raw-cycles/plan.yaml")  # seven postures, three cycles
sessions = {
    "the paper's": orthocal.simulate_session(paper, errors, seed=1).session,
    "sweep": orthocal.load_session(EXAMPLES / "sweep"),
    "lines": orthocal.load_session(EXAMPLES / "lines"),
}
print(f"{'':26}{'readings':>10}{'promised':>10}{'achieved':>10}   µm at the tool")
print(f"{'nominal':26}{'':>10}{'':>10}{error_at_tool(Assembly(robot).forward(drives)):10.0f}")
results = {}
for name, session in sessions.items():
    for model in ("offsets", "full"):
        result = orthocal.calibrate(session, orthocal.Choice(model=model, tolerances=TOLERANCES))
        promised = 1e6 * assess_tool(result, space).after.sizes.aligned.rms
        achieved = error_at_tool(result.machine.forward(drives))
        label = f"{name}, {model}"
        print(f"{label:26}{len(session.readings):>10}{promised:10.1f}{achieved:10.1f}")
        results[name, model] = result

full = {name: results[name, "full"] for name in sessions}
print("\nWhat the paper's readings leave open at the tool, in tolerances of each error:")
left = full["the paper's"]
for found in find_remaining_errors(left, assess_tool(left, space)):
    parts = ", ".join(f"{name} {share:+.1f}" for name, share in found.parts[:4])
    print(f"  {1e6 * found.rms:4.1f} µm: {parts}")

print("\nOn the axes a leg that tilts because its own axis points wrong looks like one whose")
print("neighbour does: with shift and rotation out it matters little. Displaced lines tell them")
print("apart, for a gauge whose own direction is known as well as that; no stand keeps it so.")
names = [p.name for p in full["sweep"].free]
for a, b, correlation in full["sweep"].correlated(above=0.9):
    if "slide.r" in a:
        apart = full["lines"].correlation[names.index(a), names.index(b)]
        print(f"  {a} and {b}: correlation {correlation:+.2f} in the sweep, {apart:+.2f} on lines")
