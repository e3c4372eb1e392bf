"""The parts of a calibration's result: plain data, as they stand in calibration.json."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from orthocal.identification.loss import LossKind
from orthocal.identification.options import SolverKind
from orthocal.identification.uncertainty import NoiseSource, chance_of_excess
from orthocal.robot.parameters import InUnit, Unit
from orthocal.sensors.protocol import Sensor


@dataclass(frozen=True, slots=True, eq=False)
class RobotRecord:
    """The robot that was calibrated."""

    name: str
    reference: str
    """As the session names it: a packaged name or a path."""
    folder: str | None
    """Folder of a robot that does not come with orthocal."""
    sha256: str
    """Of its URDF and YAML."""
    legs: tuple[tuple[str, float], ...]
    """Legs and their nominal lengths, [m]."""
    travel: tuple[tuple[str, Unit, float | None, float | None], ...]
    """Drives, their units, and the ends of their travel, [unit]; None where there is none."""


@dataclass(frozen=True, slots=True, eq=False)
class SessionRecord:
    """The session that it was calibrated from."""

    path: str | None
    readings_path: str | None
    title: str
    source: str
    sha256: str
    gauge_sigma: float | None
    """[m]."""
    gauge_resolution: float | None
    """[m]."""
    controller_offsets: tuple[float, ...] | None
    """Offsets active in the controller, [m, rad]; None where not stated."""
    parts: tuple[SessionRecord, ...] = ()
    """The sessions that were joined into this one."""


@dataclass(frozen=True, slots=True, eq=False)
class SolverRecord:
    """How the solution was found."""

    name: SolverKind
    status: str
    iterations: int
    """In all solutions until sigma had settled."""
    seconds_build: float
    """Building all functions and the program, once, [s]."""
    seconds_solve: float
    """All solutions until sigma had settled, [s]."""
    hessian: str
    loss: LossKind
    """What residuals cost: their squares, or Huber's smooth loss."""
    loss_width: float
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

    name: str
    unit: Unit
    value: float
    """Exact estimate, [unit]."""
    linear: float
    """Linearised estimate, [unit]."""
    std: float
    """Standard deviation, [unit]; NaN if nothing tells."""
    tolerance: float
    """One standard deviation before the calibration, [unit]."""
    free: bool
    identifiable: bool
    """Whether the readings alone tell it better than its tolerance."""
    start: float
    """What the controller already corrects: the point of linearisation, [unit]."""
    prior: bool
    """Whether its tolerance acted as a prior."""
    mean: float
    """Mean of that prior, [unit]."""
    lower: float | None
    """Lower bound, [unit]."""
    upper: float | None
    """Upper bound, [unit]."""
    at_bound: Literal["lower", "upper"] | None
    """Which bound holds it: it has no standard deviation then, and others hold with it there."""
    interval: tuple[float, float] | None
    """Profile-likelihood interval of 95 %, [unit], where it was asked for; widened by errors of the
    machine that were not free, at their tolerances."""

    @property
    def data_share(self) -> float:
        """How much the readings said: 1 − posterior/prior variance; NaN without a prior."""
        if not (self.free and self.prior) or self.at_bound:
            return math.nan
        return 1.0 - (self.std / self.tolerance) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class NoiseRecord:
    """Standard deviation of one reading of the indicator; see `uncertainty.Noise`."""

    reading_sigma: float
    """[m]; a difference of two readings has √2 of it."""
    source: NoiseSource
    cycles_sigma: float
    cycles_dof: int
    residual_sigma: float
    residual_dof: float

    def chance_in_residuals(self, sigma: float) -> float:
        """Probability that readings of a standard deviation [m] leave residuals as large."""
        return chance_of_excess(
            (self.residual_sigma / sigma) ** 2 * self.residual_dof, self.residual_dof
        )

    def chance_in_cycles(self, sigma: float) -> float:
        """Probability that readings of a standard deviation [m] scatter as much when repeated."""
        return chance_of_excess((self.cycles_sigma / sigma) ** 2 * self.cycles_dof, self.cycles_dof)


@dataclass(frozen=True, slots=True, eq=False)
class ResidualRow:
    """One row of the session's readings; measured = nominal + deviation = predicted + residual."""

    setup: str
    posture: str
    minus: str | None
    cycle: int
    measured: float
    """[m]."""
    nominal: float
    """What the machine would show as the controller knows it, with the best gauge zero, [m]."""
    linear: float
    """The same for the linearised estimate, [m]."""
    predicted: float
    """The same for the calibrated machine, [m]."""
    line: int | None
    """Line in the CSV."""
    file: str | None
    """The CSV, where it is not that of the session."""
    studentised: float
    """Error of the row as all others see it, in its standard deviations; NaN if they do not."""
    influence: float
    """Largest change of a parameter without this row, in its standard deviations."""
    influenced: str
    """Which parameter that is."""
    unseen: float
    """Error of predicting it from all other setups, [m]; NaN if they do not determine the model."""

    @property
    def deviation(self) -> float:
        """Measured less nominal, [m]: the residual before calibration."""
        return self.measured - self.nominal

    @property
    def residual(self) -> float:
        """Measured less predicted, [m]: the residual after calibration."""
        return self.measured - self.predicted

    @property
    def postures(self) -> str:
        """Posture, or one less another, in words."""
        return f"{self.posture} − {self.minus}" if self.minus else self.posture

    @property
    def label(self) -> str:
        """Setup and postures in words."""
        return f"{self.setup} {self.postures}"


def rows_by_setup(rows: Iterable[ResidualRow]) -> dict[str, list[ResidualRow]]:
    """Rows of every setup, in their order."""
    groups: dict[str, list[ResidualRow]] = {}
    for row in rows:
        groups.setdefault(row.setup, []).append(row)
    return groups


def root_mean_square(values: Iterable[float]) -> float:
    """Of what is known; NaN if nothing is."""
    known = [v for v in values if math.isfinite(v)]
    return math.sqrt(sum(v * v for v in known) / len(known)) if known else math.nan


@dataclass(frozen=True, slots=True, eq=False)
class PostureRecord:
    """A posture of the session."""

    name: str
    drives: tuple[float, ...]
    """Commanded drive coordinates, controller offsets taken off, [m, rad]."""
    passive: tuple[float, ...]
    """Passive coordinates of the calibrated machine, [m, rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class GaugeRecord:
    """A gauge that was read."""

    name: str
    """"" for an only one."""
    sigma: float | None
    """Standard deviation of a reading as stated, [m]."""
    resolution: float | None
    """[m]."""
    noise: float
    """Standard deviation of a reading as found, [m]; NaN if nothing tells."""
    readings: int
    """Of it, differences taken apart."""


@dataclass(frozen=True, slots=True, eq=False)
class SetupRecord:
    """A setup of the session."""

    name: str
    sensor: Sensor
    """What stood there."""
    zero: float | None
    """Estimated zero of the gauge, [m]; None where only differences were given."""


@dataclass(frozen=True, slots=True, eq=False)
class TurnedSetup:
    """A setup whose readings agree with all others once their sign is turned."""

    name: str
    as_read: float
    """Root mean square of what they differ by from what all others say, [m]; NaN if not known."""
    turned: float
    """The same with the sign turned, [m]."""
    evidence: float
    """Logarithm of the factor by which the turned sign makes all readings more likely."""
    also: tuple[str, ...] = ()
    """Setups of which it is nearly as likely that they are the one."""


@dataclass(frozen=True, slots=True, eq=False)
class ControllerEntry(InUnit):
    """What to enter into the controller for one drive."""

    drive: str
    unit: Unit
    active: float | None
    """Offset now in the controller, [unit]; None where the session does not say."""
    identified: float
    """Offset of the identified machine, [unit]."""
    enter: float
    """Offset to enter, [unit]; what to add to the present one where that is not known."""
    change: float
    """enter − active, [unit]."""
    std: float
    """Standard deviation from all that is not known, [unit]; NaN if nothing tells."""
    scatter: float
    """What the scatter of the readings has in it, [unit]."""
    held: Literal["known", "lower bound", "upper bound"] | None
    """What holds it instead of the readings."""
