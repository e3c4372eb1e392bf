"""Keys of a session.yaml, with their units.

The text of a validator's error is `key|problem` where the problem belongs to one key.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from orthocal.arrays import triple
from orthocal.effects.adjustment import LARGEST_AMOUNT_MM
from orthocal.io.documents import Count, Keys, Name, Number, OneKey, PositiveNumber
from orthocal.printers.settings import DeltaSettings, FirmwareName, Three
from orthocal.robot.description import HEAVIEST_KG
from orthocal.sensors.mounting import ScaleTolerance
from orthocal.sensors.protocol import LARGEST_READING
from orthocal.sensors.tips import TipKeys
from orthocal.session.session import Gauge
from orthocal.units import DEG, DRIVE_UNITS, MM, UNIT_SUFFIXES, Unit

LONGEST_PATH = 1000
"""Largest number of characters of a path."""

MAX_DRIVES = 12
"""Largest number of drives, and of coordinates of a posture."""

Coordinates = Annotated[list[Number], Field(min_length=1, max_length=MAX_DRIVES)]

LARGEST_READING_MM = LARGEST_READING / MM
"""Largest reading of any sensor, [mm]."""

COARSEST_MM = 10.0
"""Largest accepted resolution or noise of a gauge, [mm] (a ruler: 1 mm)."""

MOST_POSTURES = 5_000
"""Largest number of postures of a session. Each adds a loop closure and its variables to the
optimisation."""

MOST_SETUPS = 1_000
"""Largest number of setups of a session. Each adds a gauge zero."""

MOST_READINGS = 50_000
"""Largest number of readings of a session or a plan, four times the largest that was tested. A
calibration needs 10 kB per reading."""

MOST_GAUGES = 100
"""Largest number of gauges of a session."""

MOST_NAMES = 1_000
"""Largest number of names or globs of errors; the largest robots have some hundred errors."""

LARGEST_TRIM = 5.0
"""Largest backlash or trim that a controller compensates, [mm] or degrees."""

FARTHEST_ORIGIN_MM = 1e5
"""Largest machine coordinate of the world's origin, [mm]."""

OriginCoordinate = Annotated[Number, Field(ge=-FARTHEST_ORIGIN_MM, le=FARTHEST_ORIGIN_MM)]

GaugeNoise = Annotated[PositiveNumber, Field(le=COARSEST_MM)]
ReadingLimit = Annotated[Number, Field(ge=-LARGEST_READING_MM, le=LARGEST_READING_MM)]

Adjusted = Annotated[Number, Field(ge=-LARGEST_AMOUNT_MM, le=LARGEST_AMOUNT_MM)]

BacklashValue = Annotated[Number, Field(ge=0.0, le=LARGEST_TRIM)]
BacklashValues = Annotated[list[BacklashValue], Field(min_length=1, max_length=MAX_DRIVES)]

Quantity = Literal["offsets", "backlash", "home_offset"]
"""Quantity of which a controller has a value for each drive."""


class GaugeKeys(Keys):
    """Keys of a gauge."""

    sigma_mm: GaugeNoise | None = None
    """Standard deviation of a reading."""
    resolution_mm: GaugeNoise | None = None
    range_mm: Annotated[list[ReadingLimit], Field(min_length=2, max_length=2)] | None = None
    """Lowest and highest reading."""
    tip: TipKeys | None = None
    """Tip; a setup may override it."""
    scale_tolerance: ScaleTolerance | None = None
    """Tolerance of the scale factor, dimensionless; a setup may override it."""

    def to_gauge(self) -> Gauge:
        """Gauge in SI units."""
        return Gauge(
            None if self.sigma_mm is None else self.sigma_mm * MM,
            None if self.resolution_mm is None else self.resolution_mm * MM,
            None if self.range_mm is None else (self.range_mm[0] * MM, self.range_mm[1] * MM),
        )

    @model_validator(mode="after")
    def _require_increasing_range(self) -> GaugeKeys:
        """Refuse a range whose lowest reading is not below the highest."""
        if self.range_mm is not None and not self.range_mm[0] < self.range_mm[1]:
            raise ValueError(f"range_mm|found {self.range_mm}; expected [lowest, highest]")
        return self


class PostureKeys(OneKey):
    """Keys of a posture: commanded tool coordinates or drive coordinates."""

    tcp_mm: Coordinates | None = None
    """Commanded coordinates of the tool centre point, from the mechanical zero."""
    joints_mm: Coordinates | None = None
    """Drive coordinates of a robot with prismatic drives, in the order of the drives."""
    joints_deg: Coordinates | None = None
    """Drive coordinates of a robot with revolute drives, in the order of the drives."""


class FirmwareKeys(Keys):
    """Settings of the firmware of a delta printer during the measurement."""

    name: FirmwareName
    radius_mm: PositiveNumber
    """Horizontal distance between the ends of a rod with the nozzle in the middle."""
    rods_mm: tuple[PositiveNumber, PositiveNumber, PositiveNumber]
    """Lengths of the rods of each tower."""
    angles_deg: Three = (210.0, 330.0, 90.0)
    """Directions of the towers, anticlockwise from the x axis."""
    homed_mm: Three
    """Coordinates of the carriages at their endstops."""
    tilts: tuple[Number, Number] = (0.0, 0.0)
    """Slopes of the bed along x and y, dimensionless; RepRapFirmware only."""
    probe_mm: Three = (0.0, 0.0, 0.0)
    """Tip of the probe from the nozzle."""

    @model_validator(mode="after")
    def _require_long_rods(self) -> FirmwareKeys:
        """Refuse rods that do not reach from the towers to the middle."""
        if min(self.rods_mm) <= self.radius_mm:
            raise ValueError(f"rods_mm|found {self.rods_mm}; expected more than the radius")
        return self

    def to_settings(self) -> DeltaSettings:
        """Settings in SI units."""
        return DeltaSettings(
            self.name,
            self.radius_mm * MM,
            triple(self.rods_mm, MM),
            triple(self.homed_mm, MM),
            triple(self.angles_deg, DEG),
            self.tilts,
            triple(self.probe_mm, MM),
        )


class ControllerKeys(Keys):
    """Active corrections of the controller.

    A list has one number per prismatic or revolute drive, in the order of the robot's drives.
    """

    offsets_mm: Coordinates | None = None
    """Active offsets of prismatic drives."""
    offsets_deg: Coordinates | None = None
    """Active offsets of revolute drives."""
    offsets_mrad: Coordinates | None = None
    """Active offsets of revolute drives, instead of `offsets_deg`."""
    backlash_mm: BacklashValues | None = None
    """Compensated backlash of prismatic drives."""
    backlash_deg: BacklashValues | None = None
    """Compensated backlash of revolute drives."""
    home_offset_mm: Coordinates | None = None
    """Position of the joints of prismatic drives at their home switches (HOME_OFFSET)."""
    home_offset_deg: Coordinates | None = None
    """The same of revolute drives."""
    comp_file: Annotated[list[str | None], Field(min_length=1, max_length=MAX_DRIVES)] | None = None
    """Table of trims for each drive (COMP_FILE of LinuxCNC, type 1); null for none."""
    firmware: FirmwareKeys | None = None
    """Firmware of a delta printer, in whose coordinates the postures are stated."""
    origin_mm: tuple[OriginCoordinate, OriginCoordinate, OriginCoordinate] | None = None
    """Machine coordinates (G53) of the world's origin; 0, 0, 0 by default."""

    def stated(self, quantity: Quantity) -> list[str]:
        """Keys of a quantity that are stated."""
        return [key for key in drive_value_keys(quantity) if getattr(self, key) is not None]

    @model_validator(mode="after")
    def _require_one_angle_unit(self) -> ControllerKeys:
        """Refuse offsets of revolute drives in two units, and keys without a value."""
        if not self.model_dump(exclude_none=True):
            raise ValueError(f"found none; expected {', '.join(type(self).model_fields)}")
        if {"offsets_deg", "offsets_mrad"} <= set(self.stated("offsets")):
            raise ValueError("found offsets_deg and offsets_mrad; expected one of them")
        return self


def drive_value_keys(quantity: Quantity, *units: Unit) -> dict[str, tuple[Unit, float]]:
    """Keys of `controller` with values of drives: SI unit of these drives and factor to SI.

    Args:
        quantity: Beginning of the keys.
        units: SI units of the drives; all by default. A session states one key for each of them.
    """
    return {
        key: UNIT_SUFFIXES[suffix]
        for key in ControllerKeys.model_fields
        if (suffix := key.removeprefix(quantity)) in UNIT_SUFFIXES
        and UNIT_SUFFIXES[suffix][0] in (units or DRIVE_UNITS)
    }


class CalibrationKeys(Keys):
    """Model, free errors and tolerances of the calibration."""

    model: str | None = None
    """Name of a model of the robot's YAML."""
    free: Annotated[list[str], Field(max_length=MOST_NAMES)] = []
    """Names or globs of errors that are free in addition to a model, or without one."""
    tolerances: Annotated[dict[str, PositiveNumber], Field(max_length=MOST_NAMES)] = {}
    """Tolerances (±2 prior standard deviations) that replace those of the robot. A key is a name or
    glob of errors with the suffix of its unit."""
    effects: Annotated[list[str], Field(max_length=MOST_NAMES)] | None = None
    """Effects beside geometry; by default those of the robot's YAML."""


def _require_path(text: str) -> str:
    """Refuse an empty text, and characters that no path on one line has."""
    if not text.isprintable() or not 0 < len(text) <= LONGEST_PATH:
        raise ValueError(f"found {text[:40]!r}; expected a path")
    return text


PathText = Annotated[str, AfterValidator(_require_path)]
"""Path on one line."""


class SessionKeys(Keys):
    """Keys of a session.yaml, or of a plan, which has no `readings`."""

    robot: str
    """Name of a packaged robot, or path to its directory."""
    title: str = ""
    source: str = ""
    gauge: GaugeKeys = None  # type: ignore[assignment] # None if absent; null in a file is refused
    """Gauge of a session with one gauge."""
    gauges: Annotated[dict[Name, GaugeKeys], Field(min_length=1, max_length=MOST_GAUGES)] = None  # type: ignore[assignment] # as for `gauge`
    """Gauges by name of a session with several; each setup names its gauge."""
    postures: Annotated[dict[Name, PostureKeys], Field(min_length=1, max_length=MOST_POSTURES)]
    payload_kg: Annotated[Number, Field(ge=0.0, le=HEAVIEST_KG)] = 0.0
    """Mass on the tool during the measurement."""
    controller: ControllerKeys | None = None
    offsets_from: PathText | None = None
    """Path to the calibration whose offsets were entered, relative to the file."""
    adjusted_mm: Annotated[dict[Name, Adjusted], Field(max_length=MOST_NAMES)] = {}
    """Amounts of the mechanical adjustments since the machine was built, by name."""
    calibration: CalibrationKeys | None = None
    setups: Annotated[dict[Name, dict[str, Any]], Field(min_length=1, max_length=MOST_SETUPS)]
    """Keys of each setup by name; validated by its sensor, see `orthocal.sensors.registry`."""
    cycles: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of cycles of all postures in a plan."""
    readings: str | None = None
    """File name of the readings.csv."""
    seed: Count | None = None
    """Seed of simulated readings."""

    @property
    def named_gauges(self) -> dict[str, GaugeKeys]:
        """Gauges by name; the gauge under `gauge` is named ""."""
        return self.gauges or {"": self.gauge or GaugeKeys()}

    @model_validator(mode="after")
    def _require_one_gauge_key(self) -> SessionKeys:
        """Refuse both `gauge` and `gauges`."""
        if self.gauge is not None and self.gauges is not None:
            raise ValueError("found gauge and gauges; expected one of them")
        return self
