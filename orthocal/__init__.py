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
    "Calibration": "orthocal.identification.calibration",
    "CalibrationProblem": "orthocal.identification.problem",
    "Choice": "orthocal.identification.choice",
    "LiveScene": "orthocal.output.view.live",
    "Loss": "orthocal.identification.loss",
    "NonlinearProgram": "orthocal.identification.solvers.ipopt",
    "OrthocalError": "orthocal.errors",
    "Robot": "orthocal.robot.model",
    "Scene": "orthocal.output.view.scene",
    "Session": "orthocal.measurement.session",
    "SolverOptions": "orthocal.identification.options",
    "assess_tool": "orthocal.study.accuracy",
    "calibrate": "orthocal.identification.calibrate",
    "compare_models": "orthocal.study.comparison",
    "decide": "orthocal.study.findings.calibration",
    "draw_errors": "orthocal.measurement.synthetic",
    "draw_scene": "orthocal.output.view.drawing",
    "load_calibration": "orthocal.identification.calibration_file",
    "load_plan": "orthocal.measurement.session_file",
    "load_robot": "orthocal.robot.loading",
    "load_session": "orthocal.measurement.session_file",
    "simulate_session": "orthocal.measurement.synthetic",
    "summarize": "orthocal.output.summary",
    "validate_calibration": "orthocal.study.validation",
    "write_report": "orthocal.output.report.page",
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
    from orthocal.errors import OrthocalError
    from orthocal.identification.calibrate import calibrate
    from orthocal.identification.calibration import Calibration
    from orthocal.identification.calibration_file import load_calibration
    from orthocal.identification.choice import Choice
    from orthocal.identification.loss import Loss
    from orthocal.identification.options import SolverOptions
    from orthocal.identification.problem import CalibrationProblem
    from orthocal.identification.solvers.ipopt import NonlinearProgram
    from orthocal.measurement.session import Session
    from orthocal.measurement.session_file import load_plan, load_session
    from orthocal.measurement.session_output import write_session
    from orthocal.measurement.synthetic import draw_errors, simulate_session
    from orthocal.output.report.page import write_report
    from orthocal.output.summary import summarize
    from orthocal.output.view.drawing import draw_scene
    from orthocal.output.view.live import LiveScene
    from orthocal.output.view.scene import Scene
    from orthocal.robot.loading import load_robot
    from orthocal.robot.model import Robot
    from orthocal.study.accuracy import assess_tool
    from orthocal.study.comparison import compare_models
    from orthocal.study.findings.calibration import decide
    from orthocal.study.validation import validate_calibration


def __getattr__(name: str) -> Any:  # noqa: ANN401 - any of the names above
    """Import what is asked for when it is asked for: start-up stays fast."""
    if name not in _HOMES:
        raise AttributeError(f"module 'orthocal' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
