"""The same parameters, identified from another session."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from orthocal.calibration.calibration import Calibration
from orthocal.calibration.recording import assemble_calibration
from orthocal.estimation.fit import Fit, fit_problem
from orthocal.estimation.loss import Loss
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.selection import Selection
from orthocal.measurement.session import Session
from orthocal.robot.model import read_only


def repeat_calibration(calibration: Calibration, session: Session) -> Calibration:
    """The same parameters, with the same priors and bounds, identified from another session.

    Its rows' nominal values are those of the machine as it was calibrated before.

    Raises:
        NotIdentifiableError, SolverError, ClosureError: As `calibrate`.
    """
    nominal = np.array([p.value for p in calibration.free])
    return assemble_calibration(repeat_fit(calibration, session), nominal=nominal)


def repeat_fit(calibration: Calibration, session: Session) -> Fit:
    """The fit of `repeat_calibration`."""
    free = calibration.free
    parameters = session.robot.parameters
    selection = Selection(
        label=calibration.model,
        parameters=tuple(replace(parameters[p.name], tolerance=p.tolerance) for p in free),
        prior=np.array([p.prior for p in free]),
        mean=read_only([p.mean for p in free]),
        lower=read_only([-np.inf if p.lower is None else p.lower for p in free]),
        upper=read_only([np.inf if p.upper is None else p.upper for p in free]),
        fixed={p.name: p.value for p in calibration.parameters if not p.free},
    )
    solver = calibration.solver
    options = SolverOptions(solver=solver.name, loss=Loss(solver.loss, solver.loss_width))
    return fit_problem(CalibrationProblem(session, selection), options=options)
