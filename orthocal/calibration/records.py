"""What a calibration is as plain data: these records are the schema of calibration.json."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from orthocal.calibration.assessment_record import Assessment
from orthocal.estimation.diagnostics.residual_rows import ResidualRow
from orthocal.estimation.diagnostics.unmodelled import Unmodelled
from orthocal.estimation.loss import LossKind
from orthocal.estimation.options import SolverKind
from orthocal.hypotheses.reversed_setup import TurnedSetup
from orthocal.hypotheses.sessions.change_records import Changes
from orthocal.io.documents import Count, Number, PositiveInSI, PositiveNumber
from orthocal.io.fields import CLOSED, Many, Matrix, SizeOrInf, SizeOrNaN, Sizes
from orthocal.sensors.protocol import Sensor
from orthocal.sensors.registry import RECORDED
from orthocal.statistics.identifiability import Identifiability
from orthocal.statistics.noise import Noise
from orthocal.units import InUnit, Unit


@dataclass(frozen=True, slots=True, eq=False)
class RobotRecord:
    """The robot that was calibrated."""

    __pydantic_config__ = CLOSED

    name: str
    reference: str
    """As the session names it: a packaged name or a path."""
    folder: str | None
    """Folder of a robot that does not come with orthocal."""
    sha256: str
    """Of its URDF and YAML."""
    legs: Many[tuple[str, PositiveInSI]]
    """Legs and their nominal lengths, [m]."""
    travel: Many[tuple[str, Unit, Number | None, Number | None]]
    """Drives, their units, and the ends of their travel, [unit]; None where there is none."""
    tolerances: Many[tuple[str, PositiveNumber]] = ()
    """Names or globs with their units, and the tolerances in these units that the session states
    instead of the robot's."""


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
    parts: Many[SessionRecord] = ()
    """The sessions that were joined into this one."""


@dataclass(frozen=True, slots=True, eq=False)
class SolverRecord:
    """How the solution was found."""

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
    """What residuals cost: their squares, or Huber's smooth loss."""
    loss_width: PositiveInSI
    """Where that turns from square to linear, [standard deviations]."""

    @property
    def tells_linearisation(self) -> bool:
        """Whether what it found, less the linearised estimate, is what linearising costs.

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
    """Exact estimate, [unit]."""
    linear: Number
    """Linearised estimate, [unit]."""
    std: SizeOrNaN
    """Standard deviation, [unit]; NaN if nothing tells."""
    tolerance: PositiveInSI
    """One standard deviation before the calibration, [unit]."""
    free: bool
    identifiable: bool
    """Whether the readings alone tell it better than its tolerance."""
    start: Number
    """What the controller already corrects: the point of linearisation, [unit]."""
    prior: bool
    """Whether its tolerance acted as a prior."""
    mean: Number
    """Mean of that prior, [unit]."""
    lower: Number | None
    """Lower bound, [unit]."""
    upper: Number | None
    """Upper bound, [unit]."""
    at_bound: Literal["lower", "upper"] | None
    """Which bound holds it: it has no standard deviation then, and others hold with it there."""
    interval: tuple[Number, Number] | None
    """Profile-likelihood interval of 95 %, [unit], where it was asked for; widened by errors of the
    machine that were not free, at their tolerances."""

    @property
    def data_share(self) -> float:
        """How much the readings said: 1 − posterior/prior variance; NaN without a prior."""
        if not (self.free and self.prior) or self.at_bound:
            return math.nan
        return 1.0 - (self.std / self.tolerance) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class PostureRecord:
    """A posture of the session."""

    __pydantic_config__ = CLOSED

    name: str
    drives: Many[Number]
    """Commanded drive coordinates, controller offsets taken off, [m, rad]."""
    passive: Many[Number]
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
    """Standard deviation of a reading as found, [m]; NaN if nothing tells."""
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
    """Estimated zero of the gauge, [m]; None where only differences were given."""
    aligned_at: str
    """Posture in which the operator aligned the gauge."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationRecord:
    """Identified error parameters of a robot, with their uncertainty and provenance: plain data.

    What a calibration was made from is among it, so that it can be made again: readings, postures,
    sensors, gauges, and what was free, held, bounded and known beforehand.
    """

    __pydantic_config__ = CLOSED

    version: Annotated[str, Field(alias="orthocal")]
    """Of orthocal."""
    robot_record: Annotated[RobotRecord, Field(alias="robot")]
    session: SessionRecord
    model: str
    prior: bool
    """Whether tolerances acted as a prior."""
    solver: SolverRecord
    parameters: Annotated[Many[ParameterEstimate], Field(min_length=1)]
    """Free parameters, then those held at a known value."""
    sensors: Many[ParameterEstimate]
    """What was not known of the sensors, estimated with them."""
    sensor_bias: Sizes
    """Standard deviations of what these take on of errors that were not free, (n,), [SI]."""
    covariance: Matrix
    """Of the free parameters, shape (n_free, n_free), [SI]."""
    unmodelled: Unmodelled
    """What errors that were not free do to the estimate."""
    identifiability: Identifiability
    """What the readings tell, and what they cannot tell apart."""
    base: bool
    """Whether free parameters are base parameters: each the value of a whole combination."""
    noise: Noise
    """Of one reading of the (first) gauge."""
    rows_are_differences: bool
    critical: SizeOrInf
    """Studentised residuals beyond this are suspicious; infinite if nothing tells the noise."""
    residuals: Annotated[Many[ResidualRow], Field(min_length=1)]
    turned: TurnedSetup | None
    """The setup that seems to have been read with the wrong sign."""
    postures: Many[PostureRecord]
    setups: Many[SetupRecord]
    gauges: Many[GaugeRecord]
    changes: Changes | None = None
    """What has changed between the sessions; None for a single one."""
    assessment: Assessment | None = None
    """Verdict, findings, what to enter and the tool error; None if it was not assessed."""
