"""orthocal: calibration of Orthoglide-type parallel robots from dial-indicator readings.

Five lines do the main job:

    import orthocal

    session = orthocal.load_session("examples/table1/experiment-2")
    calibration = orthocal.calibrate(session)
    print(orthocal.summarize(calibration))
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "Assessment": "orthocal.calibration.assessment_record",
    "Recommendation": "orthocal.assessment.recommendation",
    "assess": "orthocal.assessment.assess",
    "recommend_model": "orthocal.assessment.recommendation",
    "Calibration": "orthocal.calibration.calibration",
    "CalibrationFileError": "orthocal.errors",
    "CalibrationProblem": "orthocal.estimation.problem",
    "Choice": "orthocal.estimation.choice",
    "ClosureError": "orthocal.errors",
    "Comparison": "orthocal.assessment.comparison",
    "Decision": "orthocal.calibration.assessment_record",
    "ExportError": "orthocal.errors",
    "ExportOptions": "orthocal.export.options",
    "Finding": "orthocal.calibration.assessment_record",
    "Gauge": "orthocal.session.session",
    "GcodeError": "orthocal.errors",
    "LiveScene": "orthocal.viewer.live",
    "Loss": "orthocal.estimation.loss",
    "Machine": "orthocal.calibration.machine",
    "Means": "orthocal.planning.equipment",
    "MeasuringPlan": "orthocal.planning.plan",
    "NonlinearProgram": "orthocal.estimation.solvers.ipopt",
    "NotIdentifiableError": "orthocal.errors",
    "OrthocalError": "orthocal.errors",
    "OutputError": "orthocal.errors",
    "ParameterError": "orthocal.errors",
    "Posture": "orthocal.session.session",
    "Reading": "orthocal.session.session",
    "Robot": "orthocal.robot.model",
    "RobotError": "orthocal.errors",
    "Scene": "orthocal.viewer.scene",
    "Sensor": "orthocal.sensors.protocol",
    "Session": "orthocal.session.session",
    "SessionError": "orthocal.errors",
    "Setup": "orthocal.session.session",
    "Sizes": "orthocal.robot.builder.dimensions",
    "SolverError": "orthocal.errors",
    "SolverOptions": "orthocal.estimation.options",
    "Study": "orthocal.study.study",
    "StudyTable": "orthocal.study.runner",
    "TableImport": "orthocal.measurement.importing.import_readings",
    "TableOptions": "orthocal.measurement.importing.import_readings",
    "ToolAccuracy": "orthocal.assessment.tool_error",
    "UnreachableError": "orthocal.errors",
    "Validation": "orthocal.assessment.validation",
    "Workspace": "orthocal.kinematics.workspace",
    "assess_tool": "orthocal.assessment.tool_error",
    "build_accuracy_study": "orthocal.study.accuracy_options",
    "build_bootstrap_study": "orthocal.study.bootstrap",
    "build_linearisation_study": "orthocal.study.linearisation",
    "build_sensitivity_study": "orthocal.study.sensitivity",
    "calibrate": "orthocal.assessment.assess",
    "check_session": "orthocal.assessment.assess",
    "compare_models": "orthocal.assessment.comparison",
    "draw_errors": "orthocal.observation.simulate",
    "draw_scene": "orthocal.output.scene.drawing",
    "export_calibration": "orthocal.export.formats",
    "find_changes": "orthocal.calibration.refit",
    "import_readings": "orthocal.measurement.importing.import_readings",
    "join_sessions": "orthocal.measurement.joining",
    "load_calibration": "orthocal.calibration.file",
    "load_plan": "orthocal.measurement.files.session_file",
    "load_robot": "orthocal.robot.loading",
    "load_session": "orthocal.measurement.files.session_file",
    "make_robot": "orthocal.robot.builder.build",
    "parameter_table": "orthocal.calibration.tables",
    "reading_table": "orthocal.calibration.tables",
    "plan_readings": "orthocal.planning.plan",
    "register_sensor": "orthocal.sensors.registry",
    "repeat_calibration": "orthocal.calibration.refit",
    "restore_session": "orthocal.calibration.refit",
    "run_study": "orthocal.study.runner",
    "simulate_session": "orthocal.observation.simulate",
    "summarize": "orthocal.output.text.summary",
    "validate_calibration": "orthocal.assessment.validation",
    "write_calibration": "orthocal.calibration.file",
    "write_import": "orthocal.measurement.importing.import_readings",
    "write_report": "orthocal.output.report.page",
    "write_session": "orthocal.measurement.files.write_session",
}

__all__ = [
    "Assessment",
    "Calibration",
    "CalibrationFileError",
    "CalibrationProblem",
    "Choice",
    "ClosureError",
    "Comparison",
    "Decision",
    "ExportError",
    "ExportOptions",
    "Finding",
    "Gauge",
    "GcodeError",
    "LiveScene",
    "Loss",
    "Machine",
    "Means",
    "MeasuringPlan",
    "NonlinearProgram",
    "NotIdentifiableError",
    "OrthocalError",
    "OutputError",
    "ParameterError",
    "Posture",
    "Reading",
    "Recommendation",
    "Robot",
    "RobotError",
    "Scene",
    "Sensor",
    "Session",
    "SessionError",
    "Setup",
    "Sizes",
    "SolverError",
    "SolverOptions",
    "Study",
    "StudyTable",
    "TableImport",
    "TableOptions",
    "ToolAccuracy",
    "UnreachableError",
    "Validation",
    "Workspace",
    "assess",
    "assess_tool",
    "build_accuracy_study",
    "build_bootstrap_study",
    "build_linearisation_study",
    "build_sensitivity_study",
    "calibrate",
    "check_session",
    "compare_models",
    "draw_errors",
    "draw_scene",
    "export_calibration",
    "find_changes",
    "import_readings",
    "join_sessions",
    "load_calibration",
    "load_plan",
    "load_robot",
    "load_session",
    "make_robot",
    "parameter_table",
    "plan_readings",
    "reading_table",
    "recommend_model",
    "register_sensor",
    "repeat_calibration",
    "restore_session",
    "run_study",
    "simulate_session",
    "summarize",
    "validate_calibration",
    "write_calibration",
    "write_import",
    "write_report",
    "write_session",
]

if TYPE_CHECKING:
    from orthocal.assessment.assess import assess, calibrate, check_session
    from orthocal.assessment.comparison import Comparison, compare_models
    from orthocal.assessment.recommendation import Recommendation, recommend_model
    from orthocal.assessment.tool_error import ToolAccuracy, assess_tool
    from orthocal.assessment.validation import Validation, validate_calibration
    from orthocal.calibration.assessment_record import Assessment, Decision, Finding
    from orthocal.calibration.calibration import Calibration
    from orthocal.calibration.file import load_calibration, write_calibration
    from orthocal.calibration.machine import Machine
    from orthocal.calibration.refit import find_changes, repeat_calibration, restore_session
    from orthocal.calibration.tables import parameter_table, reading_table
    from orthocal.errors import (
        CalibrationFileError,
        ClosureError,
        ExportError,
        GcodeError,
        NotIdentifiableError,
        OrthocalError,
        OutputError,
        ParameterError,
        RobotError,
        SessionError,
        SolverError,
        UnreachableError,
    )
    from orthocal.estimation.choice import Choice
    from orthocal.estimation.loss import Loss
    from orthocal.estimation.options import SolverOptions
    from orthocal.estimation.problem import CalibrationProblem
    from orthocal.estimation.solvers.ipopt import NonlinearProgram
    from orthocal.export.formats import export_calibration
    from orthocal.export.options import ExportOptions
    from orthocal.kinematics.workspace import Workspace
    from orthocal.measurement.files.session_file import load_plan, load_session
    from orthocal.measurement.files.write_session import write_session
    from orthocal.measurement.importing.import_readings import (
        TableImport,
        TableOptions,
        import_readings,
        write_import,
    )
    from orthocal.measurement.joining import join_sessions
    from orthocal.observation.simulate import draw_errors, simulate_session
    from orthocal.output.report.page import write_report
    from orthocal.output.scene.drawing import draw_scene
    from orthocal.output.text.summary import summarize
    from orthocal.planning.equipment import Means
    from orthocal.planning.plan import MeasuringPlan, plan_readings
    from orthocal.robot.builder.build import make_robot
    from orthocal.robot.builder.dimensions import Sizes
    from orthocal.robot.loading import load_robot
    from orthocal.robot.model import Robot
    from orthocal.sensors.protocol import Sensor
    from orthocal.sensors.registry import register_sensor
    from orthocal.session.session import Gauge, Posture, Reading, Session, Setup
    from orthocal.study.accuracy_options import build_accuracy_study
    from orthocal.study.bootstrap import build_bootstrap_study
    from orthocal.study.linearisation import build_linearisation_study
    from orthocal.study.runner import StudyTable, run_study
    from orthocal.study.sensitivity import build_sensitivity_study
    from orthocal.study.study import Study
    from orthocal.viewer.live import LiveScene
    from orthocal.viewer.scene import Scene


def __getattr__(name: str) -> Any:  # noqa: ANN401 - any of the names above
    """Import what is asked for when it is asked for: start-up stays fast."""
    if name not in _HOMES:
        raise AttributeError(f"module 'orthocal' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
