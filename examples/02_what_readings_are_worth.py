"""What a sweep along the axes cannot tell, and displaced lines can: errors at the tool.

Both sessions are simulated, on one machine with all errors at tolerance. No calibration reads the
truth; it is used at the end to see how far each one is from it.
"""

from pathlib import Path

import numpy as np

import orthocal
from orthocal.measurement.synthetic import load_errors
from orthocal.robot.assembly import Assembly
from orthocal.study.accuracy import assess_tool, cube, find_remaining_errors

EXAMPLES = Path(__file__).parent
TOLERANCES = {"*.offset": 2e-3}  # the workshop's word for its offsets, one sigma, in m

robot = orthocal.load_robot("orthoglide")
space = cube(robot)  # ±60 mm around the mechanical zero
drives = Assembly(robot).inverse(space.points)  # as a nominal controller commands them
truth = Assembly(robot, fixed=load_errors(EXAMPLES / "sweep/truth.yaml", robot))
real = truth.forward(drives)


def error_at_tool(predicted: np.ndarray) -> float:
    """R.m.s. over the cube, the common shift taken out, in µm."""
    error = predicted - real
    error -= space.weights @ error
    return 1e6 * float(np.sqrt(space.weights @ (error**2).sum(axis=1)))


print(f"{'':26}{'readings':>10}{'promised':>10}{'achieved':>10}   µm at the tool")
print(f"{'nominal':26}{'':>10}{'':>10}{error_at_tool(Assembly(robot).forward(drives)):10.0f}")
results = {}
for name in ("sweep", "lines"):
    session = orthocal.load_session(EXAMPLES / name)
    for model in ("offsets", "full"):
        result = orthocal.calibrate(session, model=model, tolerances=TOLERANCES)
        promised = 1e6 * assess_tool(result, space).after.relative.rms
        achieved = error_at_tool(result.forward(drives))
        label = f"{name}, {model}"
        print(f"{label:26}{len(session.readings):>10}{promised:10.0f}{achieved:10.0f}")
        results[name, model] = result

sweep, lines = (results[name, "full"] for name in ("sweep", "lines"))
print("\nWhat the sweep leaves open at the tool, in tolerances of each error:")
for found in find_remaining_errors(sweep, assess_tool(sweep, space)):
    parts = ", ".join(f"{name} {share:+.1f}" for name, share in found.parts[:4])
    print(f"  {1e6 * found.rms:3.0f} µm: {parts}")

print("\nParameters of which the readings took away more than 9/10 of what was open (variance):")
for name, result in (("sweep", sweep), ("lines", lines)):
    told = [p.name for p in result.free if p.data_share > 0.9]
    print(f"  {name}: {', '.join(told)}")

pairs = [p for p in sweep.correlated(above=0.9) if "slide.r" in p[0]]
print("\nOn the axes a leg that tilts because its own axis points wrong looks like one whose")
print("neighbour does. The sweep takes for one, and the lines tell apart:")
for a, b, correlation in pairs:
    names = [p.name for p in lines.free]
    apart = lines.correlation[names.index(a), names.index(b)]
    print(f"  {a} and {b}: correlation {correlation:+.2f} in the sweep, {apart:+.2f} on lines")
