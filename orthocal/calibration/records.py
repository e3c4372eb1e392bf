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
from orthocal.io.fields import FileRecord, Many, Matrix, SizeOrInf, SizeOrNaN, Vector
from orthocal.printers.settings import DeltaSettings
from orthocal.robot.description import HEAVIEST_KG
from orthocal.robot.files import MOST_FILES, is_inner_path
from orthocal.sensors.protocol import GaugeZero
from orthocal.sensors.registry import RecordedSensor
from orthocal.session.session import Posture, Purpose
from orthocal.statistics.identifiability import Identifiability
from orthocal.statistics.noise import Noise
from orthocal.text import shorten
from orthocal.units import InUnit, Unit


@dataclass(frozen=True, slots=True, eq=False)
class Versions(FileRecord):
    """Versions of the software that made a calibration."""

    orthocal: str
    python: str
    pin: str
    casadi: str
    numpy: str
    scipy: str


def _require_inner_path(name: str) -> str:
    """Refuse a path that leads out of the robot's directory."""
    if not is_inner_path(name):
        raise ValueError(f"found '{shorten(name)}'; expected a path inside the robot's directory")
    return name


InnerPath = Annotated[str, AfterValidator(_require_inner_path)]


@dataclass(frozen=True, slots=True)
class RobotFile(FileRecord):
    """File of the calibrated robot."""

    name: InnerPath
    """Path in the robot's directory."""
    sha256: str
    text: str | None = None
    """Content of a text file."""
    base64: str | None = None
    """Content of a binary file."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotRecord(FileRecord):
    """The calibrated robot with its files."""

    name: InnerPath
    reference: str
    """Packaged name or path, as in the session."""
    directory: str | None
    """Directory of the files at the time of the calibration; None for a packaged robot."""
    sha256: str
    """Checksum of the URDF and the YAML."""
    files: Annotated[Many[RobotFile], Field(max_length=MOST_FILES)]
    """URDF, YAML and meshes."""
    legs: Many[tuple[str, PositiveInSI]]
    """Legs and their nominal lengths, [m]."""
    travel: Many[tuple[str, Unit, Number | None, Number | None]]
    """Drives, their units, and the limits of their travel, [unit]; None without a limit."""
    tolerances: Many[tuple[str, PositiveNumber]] = ()
    """Tolerances that the session states in place of those of the robot: names or globs with a unit
    suffix, and the values in these units."""
    effects: Many[str] | None = None
    """Chosen effects beside geometry; None for those of the robot's YAML."""
    adjusted: bool = False
    """True if sessions with different mechanical adjustments were calibrated together."""


@dataclass(frozen=True, slots=True, eq=False)
class SessionRecord(FileRecord):
    """The calibrated session."""

    path: str | None
    readings_path: str | None
    title: str
    source: str
    sha256: str
    controller_offsets: Many[Number] | None
    """Active offsets, [m, rad]; None if not stated."""
    controller_origin: tuple[Number, Number, Number]
    """Machine coordinates (G53) of the world's origin, [m]."""
    purpose: Purpose | None
    """Model and free errors that the session states."""
    seed: Count | None
    """Seed of simulated readings; None for measured readings."""
    compensation: Many[JointTrim] = ()
    """Compensation of the controller for each drive; empty if there is none."""
    firmware: DeltaSettings | None = None
    """Settings of the firmware of a delta printer."""
    adjusted: Many[tuple[str, Number]] = ()
    """Mechanical adjustments since the machine was built, with their amounts, [m]."""
    parts: Many[SessionRecord] = ()
    """Sessions that were joined into this one."""


@dataclass(frozen=True, slots=True, eq=False)
class SolverRecord(FileRecord):
    """Solver, its settings and its result."""

    name: SolverKind
    status: str
    iterations: Count
    """Iterations of all solutions."""
    seconds_build: Number
    """Time for building the functions and the program, [s]."""
    seconds_solve: Number
    """Time of all solutions, [s]."""
    hessian: str
    loss: LossKind
    """Loss function: squares or pseudo-Huber."""
    loss_width: PositiveInSI
    """Residual at which the loss changes from square to linear, [standard deviations]."""
    noise_converged: bool = True
    """True if the noise of a reading agrees with that of the previous solution."""

    @property
    def shows_linearisation_error(self) -> bool:
        """True if the difference from the linearised estimate is the linearisation error.

        With a robust loss it is not, because the linearised estimate uses squares.
        """
        return self.name != "linearised" and self.loss == "squares"


@dataclass(frozen=True, slots=True, eq=False)
class ParameterEstimate(FileRecord, InUnit):
    """Estimate of one error parameter."""

    name: str
    unit: Unit
    value: Number
    """Estimate of the nonlinear model, [unit]."""
    linear: Number
    """Linearised estimate, [unit]."""
    std: SizeOrNaN
    """Standard deviation from noise, priors and unmodelled errors, [unit]; NaN if unknown."""
    std_scatter: SizeOrNaN
    """Part of `std` from the noise of the readings, [unit]."""
    std_scaled: SizeOrNaN
    """Part of `std` from errors whose tolerances the tolerance scale multiplies, [unit]."""
    prior_std: PositiveInSI
    """Prior standard deviation, [unit]."""
    scaled: bool
    """True if the tolerance scale multiplies its prior standard deviation."""
    free: bool
    resolvable: bool
    """True if the readings alone determine it better than its prior."""
    start: Number
    """Value at which the readings were linearised: the active one in the controller, [unit]."""
    prior: bool
    """True if its prior was used."""
    mean: Number
    """Prior mean, [unit]."""
    lower: Number | None
    """Lower bound, [unit]."""
    upper: Number | None
    """Upper bound, [unit]."""
    at_bound: Literal["lower", "upper"] | None
    """Bound that holds the estimate, so that its standard deviation is 0; None if no bound does."""
    interval: tuple[Number, Number] | None
    """Profile-likelihood interval for the probability of the expanded uncertainty, [unit]; None if
    it was not requested."""

    @property
    def data_share(self) -> float:
        """Share of the prior variance that the readings removed, 0 to 1; NaN without a prior."""
        if not (self.free and self.prior) or self.at_bound or math.isnan(self.std):
            return math.nan
        return max(1.0 - (self.std / self.prior_std) ** 2, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class PostureRecord(Posture, FileRecord):
    """A posture of the session."""

    values: Vector
    drives: Vector
    passive: Vector
    """Passive coordinates of the calibrated machine, [m, rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class GaugeRecord(FileRecord):
    """A gauge that was read."""

    name: str
    """Name; "" if it is the only gauge."""
    sigma: PositiveInSI | None
    """Stated standard deviation of a reading, [m]."""
    resolution: PositiveInSI | None
    """Resolution, [m]."""
    range: tuple[Number, Number] | None
    """Lowest and highest reading, [m]."""
    noise: Noise
    """Noise of a reading of this gauge."""
    readings: Count
    """Number of readings; a difference counts as two."""


@dataclass(frozen=True, slots=True, eq=False)
class SetupRecord(FileRecord):
    """A setup of the session."""

    name: str
    sensor: Annotated[RecordedSensor, Field(alias="reads")]
    """Sensor of the setup."""
    gauge: str
    """Name of its gauge."""
    active: Many[Number] | None
    """Active offsets, [m, rad]; None for those of the session."""
    zero: Number | None
    """Estimated gauge zero, [m]; None if only differences were read."""
    aligned_at: str
    """Posture in which the operator aligned the gauge."""
    zero_kind: GaugeZero = "free"
    """Kind of the zero: estimated, or known to be 0."""
    payload: Annotated[Number, Field(ge=0.0, le=HEAVIEST_KG)] = 0.0
    """Mass on the tool, [kg]."""
    compensation: Many[JointTrim] | None = None
    """Compensation of the controller; None for that of the session."""
    adjusted: Many[tuple[str, Number]] | None = None
    """Mechanical adjustments with their amounts, [m]; None for those of the session."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationRecord(FileRecord):
    """Identified error parameters of a robot, with their uncertainty and provenance, as plain data.

    The record contains everything that is needed to repeat the calibration: readings, postures,
    sensors, gauges, free and known parameters, bounds and priors.
    """

    versions: Versions
    robot_record: Annotated[RobotRecord, Field(alias="robot")]
    session: SessionRecord
    model: str
    prior: bool
    """True if priors were used."""
    solver: SolverRecord
    parameters: Annotated[Many[ParameterEstimate], Field(min_length=1)]
    """Free parameters, then known parameters."""
    sensors: Many[ParameterEstimate]
    """Nuisance parameters of the sensors."""
    model_covariance: Matrix
    """Covariance of the free errors of the machine from noise and priors, without unmodelled
    errors, shape (n_machine, n_machine), [SI]."""
    noise_covariance: Matrix
    """Part of it from the noise of the readings, shape (n_machine, n_machine), [SI]."""
    scaled_covariance: Matrix
    """Part of it from priors that the tolerance scale multiplies, shape (n_machine, n_machine),
    [SI]."""
    unmodelled: UnmodelledEffect
    """Unmodelled errors and the bias that they cause."""
    identifiability: Identifiability
    """Resolvable directions and groups of inseparable parameters."""
    base: bool
    """True if free parameters are base parameters: values of linear combinations."""
    noise: Noise
    """Noise of one reading of the first gauge."""
    noise_coverage: SizeOrNaN
    """Coverage factor of the parts of uncertainties from noise; NaN if the noise is unknown."""
    rows_are_differences: bool
    critical: SizeOrInf
    """Critical value: rows with a larger absolute studentised residual are outliers. Infinite if
    the noise is unknown."""
    residuals: Annotated[Many[ResidualRow], Field(min_length=1)]
    postures: Many[PostureRecord]
    setups: Many[SetupRecord]
    gauges: Many[GaugeRecord]
    tolerance_scale: ToleranceScale = AS_STATED
    """Scale of the tolerances of all errors of the geometry except offsets. Prior standard
    deviations and covariances contain it."""
    assessment: Assessment | None = None
    """Assessment; None if there is none."""
