"""A researcher's own program: orthocal's model, closures and readings, and a constraint on top.

The three legs were cut from one bar to a stop: by how much each is off is not known, but the sum of
the three is. CasADi differentiates the whole; what orthocal finds without the constraint and how
well stands beside it.
"""

from pathlib import Path

import casadi as ca
import numpy as np

import orthocal

session = orthocal.load_session(Path(__file__).parent / "raw-cycles")
choice = orthocal.Choice("lengths")
problem = orthocal.CalibrationProblem(session, choice.select(session.robot.parameters))
program = orthocal.NonlinearProgram(problem)

nlp = program.expressions()
total = sum(nlp.errors[f"{leg}_leg.length"] for leg in "xyz")
constraints = ca.vertcat(nlp.constraints, total / 1e-3)  # scaled like the rest: 1 for 1 mm

solver = ca.nlpsol(
    "own",
    "ipopt",
    {"x": nlp.variables, "p": nlp.parameters, "f": nlp.objective, "g": constraints},
    {"ipopt": {"print_level": 0, "sb": "yes"}, "print_time": False},
)
sigma = orthocal.calibrate(session, choice).noise.sigma
lower, upper = program.variable_bounds()
found = solver(
    x0=program.initial_variables(sigma=sigma),
    p=program.parameter_values(sigma=sigma),
    lbx=lower,
    ubx=upper,
    lbg=0.0,
    ubg=0.0,
)
own = (found["x"].full()[: problem.n_free, 0] * problem.theta_scale)[: problem.n_machine]

free = orthocal.calibrate(session, choice)
print("parameter        free [mm]   the sum held at 0 [mm]")
for p, value in zip(free.free, own, strict=True):
    print(f"{p.name:<16}{p.value * 1e3:+9.4f}{value * 1e3:+15.4f}")

row = np.array([p.name.endswith("length") for p in free.free], dtype=float)
values, covariance = np.array([p.value for p in free.free]), free.model_covariance
gain = covariance @ row / (row @ covariance @ row)
apart = np.abs(values - gain * (row @ values) - own).max()
print(f"From the covariance alone it would be the same, to {apart * 1e6:.2f} um.")
