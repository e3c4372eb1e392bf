"""orthocal: calibration of Orthoglide-type parallel robots from dial-indicator readings.

session = orthocal.load_session("examples/table1/experiment-2")
calibration = orthocal.calibrate(session)
print(orthocal.summarize(calibration))
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "Calibration": "orthocal.calibration.calibration",
    "CalibrationProblem": "orthocal.estimation.problem",
    "Choice": "orthocal.estimation.choice",
    "LiveScene": "orthocal.viewer.live",
    "Loss": "orthocal.estimation.loss",
    "NonlinearProgram": "orthocal.estimation.solvers.ipopt",
    "OrthocalError": "orthocal.errors",
    "Robot": "orthocal.robot.model",
    "Scene": "orthocal.viewer.scene",
    "Session": "orthocal.measurement.session",
    "SolverOptions": "orthocal.estimation.options",
    "assess_tool": "orthocal.assess.accuracy",
    "calibrate": "orthocal.calibration.calibrate",
    "compare_models": "orthocal.assess.comparison",
    "decide": "orthocal.assess.findings.calibration",
    "draw_errors": "orthocal.measurement.synthetic",
    "draw_scene": "orthocal.show.scene.drawing",
    "load_calibration": "orthocal.calibration.file",
    "load_plan": "orthocal.measurement.session_file",
    "load_robot": "orthocal.robot.loading",
    "load_session": "orthocal.measurement.session_file",
    "simulate_session": "orthocal.measurement.synthetic",
    "summarize": "orthocal.show.summary",
    "validate_calibration": "orthocal.assess.validation",
    "write_report": "orthocal.show.report.page",
    "write_session": "orthocal.measurement.session_output",
}

__all__ = [
    "Calibration",
    "CalibrationProblem",
    "Choice",
    "LiveScene",
    "Loss",
    "NonlinearProgram",
    "OrthocalError",
    "Robot",
    "Scene",
    "Session",
    "SolverOptions",
    "assess_tool",
    "calibrate",
    "compare_models",
    "decide",
    "draw_errors",
    "draw_scene",
    "load_calibration",
    "load_plan",
    "load_robot",
    "load_session",
    "simulate_session",
    "summarize",
    "validate_calibration",
    "write_report",
    "write_session",
]

if TYPE_CHECKING:
    from orthocal.assess.accuracy import assess_tool
    from orthocal.assess.comparison import compare_models
    from orthocal.assess.findings.calibration import decide
    from orthocal.assess.validation import validate_calibration
    from orthocal.calibration.calibrate import calibrate
    from orthocal.calibration.calibration import Calibration
    from orthocal.calibration.file import load_calibration
    from orthocal.errors import OrthocalError
    from orthocal.estimation.choice import Choice
    from orthocal.estimation.loss import Loss
    from orthocal.estimation.options import SolverOptions
    from orthocal.estimation.problem import CalibrationProblem
    from orthocal.estimation.solvers.ipopt import NonlinearProgram
    from orthocal.measurement.session import Session
    from orthocal.measurement.session_file import load_plan, load_session
    from orthocal.measurement.session_output import write_session
    from orthocal.measurement.synthetic import draw_errors, simulate_session
    from orthocal.robot.loading import load_robot
    from orthocal.robot.model import Robot
    from orthocal.show.report.page import write_report
    from orthocal.show.scene.drawing import draw_scene
    from orthocal.show.summary import summarize
    from orthocal.viewer.live import LiveScene
    from orthocal.viewer.scene import Scene


def __getattr__(name: str) -> Any:  # noqa: ANN401 - any of the names above
    """Import what is asked for when it is asked for: start-up stays fast."""
    if name not in _HOMES:
        raise AttributeError(f"module 'orthocal' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
