"""Records of a calibration as plain data: the schema of calibration.json."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from orthocal.calibration.assessment_record import Assessment
from orthocal.effects.compensation import JointTrim
from orthocal.estimation.diagnostics.residual_rows import ResidualRow
from orthocal.estimation.diagnostics.unmodelled import UnmodelledEffect
from orthocal.estimation.loss import LossKind
from orthocal.estimation.options import SolverKind
from orthocal.estimation.tolerance_scale import AS_STATED, ToleranceScale
from orthocal.io.documents import Count, Number, PositiveInSI, PositiveNumber
from orthocal.io.fields import CLOSED, Many, Matrix, SizeOrInf, SizeOrNaN, Vector
from orthocal.printers.settings import DeltaSettings
from orthocal.robot.description import HEAVIEST_KG
from orthocal.robot.files import MOST_FILES, is_inner_path
from orthocal.sensors.protocol import GaugeZero, Sensor
from orthocal.sensors.registry import RECORDED
from orthocal.session.session import Posture, Purpose
from orthocal.statistics.identifiability import Identifiability
from orthocal.statistics.noise import Noise
from orthocal.text import shorten
from orthocal.units import InUnit, Unit


@dataclass(frozen=True, slots=True, eq=False)
class Versions:
    """Versions of the software that made a calibration."""

    __pydantic_config__ = CLOSED

    orthocal: str
    python: str
    pin: str
    casadi: str
    numpy: str
    scipy: str


def _require_inner_path(name: str) -> str:
    if not is_inner_path(name):
        raise ValueError(f"found '{shorten(name)}'; expected a path inside the robot's directory")
    return name


InnerPath = Annotated[str, AfterValidator(_require_inner_path)]


@dataclass(frozen=True, slots=True)
class RobotFile:
    """A file of the robot that was calibrated."""

    __pydantic_config__ = CLOSED

    name: InnerPath
    """Path in the robot's directory."""
    sha256: str
    text: str | None = None
    """Content of a text file."""
    base64: str | None = None
    """Content of another file."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotRecord:
    """The robot that was calibrated, with its files."""

    __pydantic_config__ = CLOSED

    name: InnerPath
    reference: str
    """Packaged name or path, as in the session."""
    directory: str | None
    """Directory of the files at the time of the calibration; None for a packaged robot."""
    sha256: str
    """Of the URDF and the YAML."""
    files: Annotated[Many[RobotFile], Field(max_length=MOST_FILES)]
    """URDF, YAML, and the meshes of drawings."""
    legs: Many[tuple[str, PositiveInSI]]
    """Legs and their nominal lengths, [m]."""
    travel: Many[tuple[str, Unit, Number | None, Number | None]]
    """Drives, their units, and the ends of their travel, [unit]; None where there is none."""
    tolerances: Many[tuple[str, PositiveNumber]] = ()
    """Names or globs with their units, and the tolerances in these units that the session states
    instead of the robot's."""
    effects: Many[str] | None = None
    """Effects beside geometry that were chosen; None for those that the robot's YAML names."""
    adjusted: bool = False
    """True if sessions with different mechanical adjustments were calibrated together."""


@dataclass(frozen=True, slots=True, eq=False)
class SessionRecord:
    """The session that it was calibrated from."""

    __pydantic_config__ = CLOSED

    path: str | None
    readings_path: str | None
    title: str
    source: str
    sha256: str
    gauge_sigma: PositiveInSI | None
    """[m]."""
    gauge_resolution: PositiveInSI | None
    """[m]."""
    controller_offsets: Many[Number] | None
    """Offsets active in the controller, [m, rad]; None where not stated."""
    purpose: Purpose | None
    """Model and free errors that the session states."""
    seed: Count | None
    """Seed of simulated readings; None for measured readings."""
    compensation: Many[JointTrim] = ()
    """What the controller compensated in the joint of each drive; empty for nothing."""
    firmware: DeltaSettings | None = None
    """Settings of the firmware of a delta printer."""
    adjusted: Many[tuple[str, Number]] = ()
    """Mechanical adjustments since the machine was built and their amounts, [m]."""
    parts: Many[SessionRecord] = ()
    """The sessions that were joined into this one."""


@dataclass(frozen=True, slots=True, eq=False)
class SolverRecord:
    """Solver, its settings and its result."""

    __pydantic_config__ = CLOSED

    name: SolverKind
    status: str
    iterations: Count
    """In all solutions until sigma had settled."""
    seconds_build: Number
    """Building all functions and the program, once, [s]."""
    seconds_solve: Number
    """All solutions until sigma had settled, [s]."""
    hessian: str
    loss: LossKind
    """Loss: squares, or the pseudo-Huber loss."""
    loss_width: PositiveInSI
    """Residual at which the loss turns from square to linear, [standard deviations]."""

    @property
    def tells_linearisation(self) -> bool:
        """True if its estimate less the linearised one is the error of linearisation.

        Not with a robust loss: the linearised estimate is by squares.
        """
        return self.name != "linearised" and self.loss == "squares"


@dataclass(frozen=True, slots=True, eq=False)
class ParameterEstimate(InUnit):
    """One error parameter."""

    __pydantic_config__ = CLOSED

    name: str
    unit: Unit
    value: Number
    """Estimate of the nonlinear model, [unit]."""
    linear: Number
    """Linearised estimate, [unit]."""
    std: SizeOrNaN
    """Standard deviation from noise, priors (also of the mounting), and unmodelled errors with
    their stated priors, [unit]. NaN if unknown."""
    std_scatter: SizeOrNaN
    """Part of `std` that is due to the noise of the readings, [unit]."""
    prior_std: PositiveInSI
    """One standard deviation before the calibration, [unit]."""
    free: bool
    identifiable: bool
    """True if the readings alone determine it better than its prior."""
    start: Number
    """What the controller already corrects: the point of linearisation, [unit]."""
    prior: bool
    """Whether its prior was used."""
    mean: Number
    """Mean of that prior, [unit]."""
    lower: Number | None
    """Lower bound, [unit]."""
    upper: Number | None
    """Upper bound, [unit]."""
    at_bound: Literal["lower", "upper"] | None
    """Bound that holds it. It then counts as fixed, with the standard deviation 0."""
    interval: tuple[Number, Number] | None
    """Profile-likelihood interval of 95 %, [unit], where it was asked for; widened by errors of the
    machine that were not free, at their tolerances."""

    @property
    def data_share(self) -> float:
        """Share of the prior variance that the readings removed, 0 to 1; NaN without a prior."""
        if not (self.free and self.prior) or self.at_bound or math.isnan(self.std):
            return math.nan
        return max(1.0 - (self.std / self.prior_std) ** 2, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class PostureRecord(Posture):
    """A posture of the session."""

    __pydantic_config__ = CLOSED

    values: Vector
    drives: Vector
    passive: Vector
    """Passive coordinates of the calibrated machine, [m, rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class GaugeRecord:
    """A gauge that was read."""

    __pydantic_config__ = CLOSED

    name: str
    """"" for an only one."""
    sigma: PositiveInSI | None
    """Standard deviation of a reading as stated, [m]."""
    resolution: PositiveInSI | None
    """[m]."""
    range: tuple[Number, Number] | None
    """Lowest and highest reading, [m]."""
    noise: SizeOrNaN
    """Estimated standard deviation of a reading, [m]; NaN if it is unknown."""
    readings: Count
    """Of it, differences taken apart."""


@dataclass(frozen=True, slots=True, eq=False)
class SetupRecord:
    """A setup of the session."""

    __pydantic_config__ = CLOSED

    name: str
    sensor: Annotated[Sensor, RECORDED, Field(alias="reads")]
    """What stood there."""
    gauge: str
    """Name of what showed its readings."""
    active: Many[Number] | None
    """Offsets active in the controller, [m, rad], where they were not those of the session."""
    zero: Number | None
    """Zero of the gauge, [m]; None where only differences were given."""
    aligned_at: str
    """Posture in which the operator aligned the gauge."""
    zero_kind: GaugeZero = "free"
    """Whether the zero was estimated or known to be 0."""
    payload: Annotated[Number, Field(ge=0.0, le=HEAVIEST_KG)] = 0.0
    """Mass on the tool, [kg]."""
    compensation: Many[JointTrim] | None = None
    """What the controller compensated, where it was not that of the session."""
    adjusted: Many[tuple[str, Number]] | None = None
    """Mechanical adjustments and their amounts, [m], where they were not those of the session."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationRecord:
    """Identified error parameters of a robot, with their uncertainty and provenance: plain data.

    What a calibration was made from is among it, so that it can be made again: readings, postures,
    sensors, gauges, and what was free, held, bounded and known beforehand.
    """

    __pydantic_config__ = CLOSED

    versions: Versions
    robot_record: Annotated[RobotRecord, Field(alias="robot")]
    session: SessionRecord
    model: str
    prior: bool
    """Whether priors were used."""
    solver: SolverRecord
    parameters: Annotated[Many[ParameterEstimate], Field(min_length=1)]
    """Free parameters, then those held at a known value."""
    sensors: Many[ParameterEstimate]
    """Nuisance parameters of the sensors."""
    model_covariance: Matrix
    """Covariance of the free errors of the machine by noise and priors, without unmodelled errors,
    shape (n_machine, n_machine), [SI]."""
    noise_covariance: Matrix
    """Part of it that is due to the noise of the readings, shape (n_machine, n_machine), [SI]."""
    unmodelled: UnmodelledEffect
    """Unmodelled errors and the bias that they cause."""
    identifiability: Identifiability
    """Resolvable directions and groups of inseparable parameters."""
    base: bool
    """Whether free parameters are base parameters: each the value of a whole combination."""
    noise: Noise
    """Of one reading of the (first) gauge."""
    rows_are_differences: bool
    critical: SizeOrInf
    """Limit of studentised residuals for outliers; infinite if the noise is unknown."""
    residuals: Annotated[Many[ResidualRow], Field(min_length=1)]
    postures: Many[PostureRecord]
    setups: Many[SetupRecord]
    gauges: Many[GaugeRecord]
    tolerance_scale: ToleranceScale = AS_STATED
    """Factor on the tolerances of all errors of the geometry except offsets, which prior standard
    deviations, covariances and everything that follows from them contain."""
    assessment: Assessment | None = None
    """Verdict, findings, what to enter and the tool error; None if it was not assessed."""
