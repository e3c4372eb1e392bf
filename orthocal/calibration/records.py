"""The parts of a calibration's result: plain data, as they stand in calibration.json."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from orthocal.estimation.loss import LossKind
from orthocal.estimation.options import SolverKind
from orthocal.sensors.protocol import Sensor
from orthocal.statistics.chance import chance_of_excess
from orthocal.statistics.noise import NoiseSource
from orthocal.units import InUnit, Unit


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
