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

if TYPE_CHECKING:  # the public names; each is imported when it is first used
    from orthocal.assessment.adjustment_plan import AdjustmentPlan as AdjustmentPlan
    from orthocal.assessment.adjustment_plan import plan_adjustments as plan_adjustments
    from orthocal.assessment.assess import assess as assess
    from orthocal.assessment.assess import calibrate as calibrate
    from orthocal.assessment.assess import check_session as check_session
    from orthocal.assessment.comparison import Comparison as Comparison
    from orthocal.assessment.comparison import compare_models as compare_models
    from orthocal.assessment.judgement import Judgement as Judgement
    from orthocal.assessment.judgement import judge_session as judge_session
    from orthocal.assessment.recommendation import Recommendation as Recommendation
    from orthocal.assessment.recommendation import recommend_model as recommend_model
    from orthocal.assessment.tool_error import ToolAccuracy as ToolAccuracy
    from orthocal.assessment.tool_error import assess_tool as assess_tool
    from orthocal.assessment.validation import Validation as Validation
    from orthocal.assessment.validation import validate_calibration as validate_calibration
    from orthocal.builder.biglide import Biglide as Biglide
    from orthocal.builder.build import make_robot as make_robot
    from orthocal.builder.dimensions import Dimensions as Dimensions
    from orthocal.builder.linear_delta import LinearDelta as LinearDelta
    from orthocal.builder.orthoglide import InclinedOrthoglide as InclinedOrthoglide
    from orthocal.builder.orthoglide import Orthoglide as Orthoglide
    from orthocal.calibration.adjusting import adjust_calibration as adjust_calibration
    from orthocal.calibration.assessment_record import Assessment as Assessment
    from orthocal.calibration.assessment_record import Decision as Decision
    from orthocal.calibration.assessment_record import Finding as Finding
    from orthocal.calibration.calibration import Calibration as Calibration
    from orthocal.calibration.file import load_calibration as load_calibration
    from orthocal.calibration.file import write_calibration as write_calibration
    from orthocal.calibration.machine import Machine as Machine
    from orthocal.calibration.refit import repeat_calibration as repeat_calibration
    from orthocal.calibration.refit import restore_session as restore_session
    from orthocal.calibration.tables import parameter_table as parameter_table
    from orthocal.calibration.tables import reading_table as reading_table
    from orthocal.effects.loading import load_robot as load_robot
    from orthocal.effects.protocol import Effect as Effect
    from orthocal.effects.protocol import EffectKeys as EffectKeys
    from orthocal.effects.registry import register_effect as register_effect
    from orthocal.errors import CalibrationFileError as CalibrationFileError
    from orthocal.errors import ClosureError as ClosureError
    from orthocal.errors import ExportError as ExportError
    from orthocal.errors import GcodeError as GcodeError
    from orthocal.errors import NotIdentifiableError as NotIdentifiableError
    from orthocal.errors import OrthocalError as OrthocalError
    from orthocal.errors import OutputError as OutputError
    from orthocal.errors import ParameterError as ParameterError
    from orthocal.errors import RobotError as RobotError
    from orthocal.errors import SessionError as SessionError
    from orthocal.errors import SolverError as SolverError
    from orthocal.errors import UnreachableError as UnreachableError
    from orthocal.estimation.choice import Choice as Choice
    from orthocal.estimation.loss import Loss as Loss
    from orthocal.estimation.options import SolverOptions as SolverOptions
    from orthocal.estimation.problem import CalibrationProblem as CalibrationProblem
    from orthocal.estimation.solvers.ipopt import NonlinearProgram as NonlinearProgram
    from orthocal.export.formats import export_calibration as export_calibration
    from orthocal.export.linuxcnc.export import ExportOptions as ExportOptions
    from orthocal.kinematics.conditions import UseConditions as UseConditions
    from orthocal.kinematics.workspace import Workspace as Workspace
    from orthocal.measurement.files.session_file import load_plan as load_plan
    from orthocal.measurement.files.session_file import load_session as load_session
    from orthocal.measurement.files.write_session import write_session as write_session
    from orthocal.measurement.importing.import_readings import TableImport as TableImport
    from orthocal.measurement.importing.import_readings import TableOptions as TableOptions
    from orthocal.measurement.importing.import_readings import import_readings as import_readings
    from orthocal.measurement.importing.import_readings import write_import as write_import
    from orthocal.measurement.joining import join_sessions as join_sessions
    from orthocal.observation.simulate import draw_errors as draw_errors
    from orthocal.observation.simulate import simulate_session as simulate_session
    from orthocal.output.report.page import write_report as write_report
    from orthocal.output.scene.drawing import draw_scene as draw_scene
    from orthocal.output.text.summary import summarize as summarize
    from orthocal.planning.equipment import Equipment as Equipment
    from orthocal.planning.plan import MeasuringPlan as MeasuringPlan
    from orthocal.planning.plan import plan_readings as plan_readings
    from orthocal.robot.model import Robot as Robot
    from orthocal.robot.parameters import ElementaryError as ElementaryError
    from orthocal.sensors.leg_indicator import LegIndicator as LegIndicator
    from orthocal.sensors.leg_indicator import Section as Section
    from orthocal.sensors.mounting import Mounting as Mounting
    from orthocal.sensors.protocol import Contact as Contact
    from orthocal.sensors.protocol import Frames as Frames
    from orthocal.sensors.protocol import NuisanceParameter as NuisanceParameter
    from orthocal.sensors.protocol import Sensor as Sensor
    from orthocal.sensors.protocol import SetupKeys as SetupKeys
    from orthocal.sensors.protocol import TouchingTip as TouchingTip
    from orthocal.sensors.protocol import View as View
    from orthocal.sensors.registry import register_sensor as register_sensor
    from orthocal.sensors.tips import Tip as Tip
    from orthocal.session.session import Conditions as Conditions
    from orthocal.session.session import Gauge as Gauge
    from orthocal.session.session import Posture as Posture
    from orthocal.session.session import Reading as Reading
    from orthocal.session.session import Session as Session
    from orthocal.session.session import Setup as Setup
    from orthocal.study.accuracy import build_accuracy_study as build_accuracy_study
    from orthocal.study.bootstrap import build_bootstrap_study as build_bootstrap_study
    from orthocal.study.linearisation import build_linearisation_study as build_linearisation_study
    from orthocal.study.runner import StudyTable as StudyTable
    from orthocal.study.runner import run_study as run_study
    from orthocal.study.sensitivity import build_sensitivity_study as build_sensitivity_study
    from orthocal.study.study import Study as Study
    from orthocal.viewer.live import LiveScene as LiveScene
    from orthocal.viewer.scene import Scene as Scene

_NAMES = {
    "assessment.adjustment_plan": "AdjustmentPlan plan_adjustments",
    "assessment.assess": "assess calibrate check_session",
    "assessment.comparison": "Comparison compare_models",
    "assessment.judgement": "Judgement judge_session",
    "assessment.recommendation": "Recommendation recommend_model",
    "assessment.tool_error": "ToolAccuracy assess_tool",
    "assessment.validation": "Validation validate_calibration",
    "builder.biglide": "Biglide",
    "builder.build": "make_robot",
    "builder.dimensions": "Dimensions",
    "builder.linear_delta": "LinearDelta",
    "builder.orthoglide": "InclinedOrthoglide Orthoglide",
    "calibration.adjusting": "adjust_calibration",
    "calibration.assessment_record": "Assessment Decision Finding",
    "calibration.calibration": "Calibration",
    "calibration.file": "load_calibration write_calibration",
    "calibration.machine": "Machine",
    "calibration.refit": "repeat_calibration restore_session",
    "calibration.tables": "parameter_table reading_table",
    "effects.loading": "load_robot",
    "effects.protocol": "Effect EffectKeys",
    "effects.registry": "register_effect",
    "errors": (
        "CalibrationFileError ClosureError ExportError GcodeError NotIdentifiableError "
        "OrthocalError OutputError ParameterError RobotError SessionError SolverError "
        "UnreachableError"
    ),
    "estimation.choice": "Choice",
    "estimation.loss": "Loss",
    "estimation.options": "SolverOptions",
    "estimation.problem": "CalibrationProblem",
    "estimation.solvers.ipopt": "NonlinearProgram",
    "export.formats": "export_calibration",
    "export.linuxcnc.export": "ExportOptions",
    "kinematics.conditions": "UseConditions",
    "kinematics.workspace": "Workspace",
    "measurement.files.session_file": "load_plan load_session",
    "measurement.files.write_session": "write_session",
    "measurement.importing.import_readings": (
        "TableImport TableOptions import_readings write_import"
    ),
    "measurement.joining": "join_sessions",
    "observation.simulate": "draw_errors simulate_session",
    "output.report.page": "write_report",
    "output.scene.drawing": "draw_scene",
    "output.text.summary": "summarize",
    "planning.equipment": "Equipment",
    "planning.plan": "MeasuringPlan plan_readings",
    "robot.model": "Robot",
    "robot.parameters": "ElementaryError",
    "sensors.leg_indicator": "LegIndicator Section",
    "sensors.mounting": "Mounting",
    "sensors.protocol": "Contact Frames NuisanceParameter Sensor SetupKeys TouchingTip View",
    "sensors.registry": "register_sensor",
    "sensors.tips": "Tip",
    "session.session": "Conditions Gauge Posture Reading Session Setup",
    "study.accuracy": "build_accuracy_study",
    "study.bootstrap": "build_bootstrap_study",
    "study.linearisation": "build_linearisation_study",
    "study.runner": "StudyTable run_study",
    "study.sensitivity": "build_sensitivity_study",
    "study.study": "Study",
    "viewer.live": "LiveScene",
    "viewer.scene": "Scene",
}
"""Modules, mapped to their public names: those that type checkers import above."""

_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = sorted(_MODULES)

if not TYPE_CHECKING:  # type checkers report unknown names

    def __getattr__(name: str) -> Any:  # noqa: ANN401 - any public name
        """Import a public name on first use, so that start-up stays fast."""
        if name not in _MODULES:
            raise AttributeError(f"module 'orthocal' has no attribute '{name}'")
        return getattr(import_module(f"orthocal.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
