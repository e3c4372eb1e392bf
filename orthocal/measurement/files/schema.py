"""Keys of a session.yaml, with their units."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from orthocal.effects.adjustment import LARGEST_AMOUNT_MM
from orthocal.io.documents import Count, Name, Number, PositiveNumber
from orthocal.printers.settings import DeltaSettings, FirmwareName, Three
from orthocal.robot.description import HEAVIEST_KG
from orthocal.sensors.mounting import LARGEST_SCALE
from orthocal.sensors.protocol import LARGEST_READING
from orthocal.sensors.tips import TipKeys
from orthocal.session.session import Gauge
from orthocal.units import DEG, MM, MRAD, Unit

Vector = Annotated[list[Number], Field(min_length=1, max_length=12)]

LARGEST_READING_MM = LARGEST_READING / MM

COARSEST_MM = 10.0
"""No resolution and no standard deviation of an indicator is larger; a ruler's is 1 mm."""

MOST_POSTURES = 5_000
"""Postures of a session; each takes a closing of the loops and its variables in the program."""

MOST_SETUPS = 1_000
"""Setups of a session; each has an unknown zero of its own."""

MOST_READINGS = 50_000
"""Largest number of readings of a session or a plan, four times the largest that was tested. A
calibration needs 10 kB for each."""

MOST_GAUGES = 100
"""Gauges of a session."""

MOST_NAMES = 1_000
"""Names or globs of errors; the largest robots have some hundred errors."""

GaugeLength = Annotated[PositiveNumber, Field(le=COARSEST_MM)]
GaugeEnd = Annotated[Number, Field(ge=-LARGEST_READING_MM, le=LARGEST_READING_MM)]

Adjusted = Annotated[Number, Field(ge=-LARGEST_AMOUNT_MM, le=LARGEST_AMOUNT_MM)]


OFFSET_KEYS: dict[str, tuple[Unit, float]] = {
    "offsets_mm": ("m", MM),
    "offsets_deg": ("rad", DEG),
    "offsets_mrad": ("rad", MRAD),
}
"""Keys of `controller` to the unit of the drives they are of, and the factor to it."""


class _Keys(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class GaugeKeys(_Keys):
    """The indicator."""

    sigma_mm: GaugeLength | None = None
    resolution_mm: GaugeLength | None = None
    range_mm: Annotated[list[GaugeEnd], Field(min_length=2, max_length=2)] | None = None
    tip: TipKeys | None = None
    """What it touches with, in setups that do not say so themselves."""
    scale_tolerance: Annotated[Number, Field(ge=0.0, le=LARGEST_SCALE)] | None = None
    """How well it shows a millimetre, likewise."""

    def to_gauge(self) -> Gauge:
        """The gauge in SI units."""
        return Gauge(
            None if self.sigma_mm is None else self.sigma_mm * MM,
            None if self.resolution_mm is None else self.resolution_mm * MM,
            None if self.range_mm is None else (self.range_mm[0] * MM, self.range_mm[1] * MM),
        )

    @model_validator(mode="after")
    def _range_rises(self) -> GaugeKeys:
        if self.range_mm is not None and not self.range_mm[0] < self.range_mm[1]:
            raise ValueError(f"range_mm|found {self.range_mm}; expected [lowest, highest]")
        return self


class PostureKeys(_Keys):
    """A commanded machine position."""

    tcp_mm: Vector | None = None
    joints_mm: Vector | None = None
    joints_deg: Vector | None = None

    @model_validator(mode="after")
    def _one_form(self) -> PostureKeys:
        stated = self.model_dump(exclude_none=True)
        if len(stated) != 1:
            shown = " and ".join(stated) or "none"
            raise ValueError(
                f"found {shown}; expected one of {', '.join(PostureKeys.model_fields)}"
            )
        return self

    @property
    def stated(self) -> tuple[str, list[float]]:
        """Key of the posture, and its coordinates in the key's unit."""
        ((key, values),) = self.model_dump(exclude_none=True).items()
        return key, values


BACKLASH_KEYS: dict[str, tuple[Unit, float]] = {
    "backlash_mm": ("m", MM),
    "backlash_deg": ("rad", DEG),
}
"""Keys of `controller` for the compensated backlash, likewise."""

LARGEST_TRIM = 5.0
"""Largest backlash or trim that a controller compensates, mm or degrees."""

Trim = Annotated[Number, Field(ge=0.0, le=LARGEST_TRIM)]
Trims = Annotated[list[Trim], Field(min_length=1, max_length=12)]


class FirmwareKeys(_Keys):
    """Settings of the firmware of a delta printer during the measurement."""

    name: FirmwareName
    radius_mm: PositiveNumber
    rods_mm: tuple[PositiveNumber, PositiveNumber, PositiveNumber]
    angles_deg: Three = (210.0, 330.0, 90.0)
    homed_mm: Three
    """Coordinates of the carriages at their endstops."""
    tilts: tuple[Number, Number] = (0.0, 0.0)
    """Tilts of the bed, RepRapFirmware only."""
    probe_mm: Three = (0.0, 0.0, 0.0)
    """Tip of the probe from the nozzle."""

    @model_validator(mode="after")
    def _rods_are_longer(self) -> FirmwareKeys:
        if min(self.rods_mm) <= self.radius_mm:
            raise ValueError(f"rods_mm|found {self.rods_mm}; expected more than the radius")
        return self

    def to_settings(self) -> DeltaSettings:
        """The settings in SI units."""
        rods, angles, homed, probe = (
            (a * unit, b * unit, c * unit)
            for (a, b, c), unit in (
                (self.rods_mm, MM),
                (self.angles_deg, DEG),
                (self.homed_mm, MM),
                (self.probe_mm, MM),
            )
        )
        return DeltaSettings(self.name, self.radius_mm * MM, rods, homed, angles, self.tilts, probe)


class ControllerKeys(_Keys):
    """Corrections of the controller: one number per drive of the kind, in their order."""

    offsets_mm: Vector | None = None
    """Of prismatic drives."""
    offsets_deg: Vector | None = None
    """Of revolute drives."""
    offsets_mrad: Vector | None = None
    """The same."""
    backlash_mm: Trims | None = None
    """Backlash that it takes up, of prismatic drives."""
    backlash_deg: Trims | None = None
    """Of revolute drives."""
    comp_file: Annotated[list[str | None], Field(min_length=1, max_length=12)] | None = None
    """Table of trims for each drive (COMP_FILE of LinuxCNC, type 1); null for none."""
    firmware: FirmwareKeys | None = None
    """Firmware of a delta printer, in whose coordinates the postures are."""

    @property
    def stated(self) -> list[str]:
        """The keys of offsets that are given."""
        return [key for key in OFFSET_KEYS if getattr(self, key) is not None]

    @model_validator(mode="after")
    def _one_form_a_kind(self) -> ControllerKeys:
        if not self.model_dump(exclude_none=True):
            raise ValueError(f"found none; expected {', '.join(type(self).model_fields)}")
        if {"offsets_deg", "offsets_mrad"} <= set(self.stated):
            raise ValueError("found offsets_deg and offsets_mrad; expected one of them")
        return self


class CalibrationKeys(_Keys):
    """Model, free errors and tolerances of the calibration."""

    model: str | None = None
    """A model of the robot's YAML."""
    free: Annotated[list[str], Field(max_length=MOST_NAMES)] = []
    """Names or globs that are free too, or instead of a model."""
    tolerances: Annotated[dict[str, PositiveNumber], Field(max_length=MOST_NAMES)] = {}
    """Name or glob with its unit to another tolerance than the robot's, ±2 standard deviations."""
    effects: Annotated[list[str], Field(max_length=MOST_NAMES)] | None = None
    """Effects beside geometry; by default those that the robot's YAML names."""


class SessionKeys(_Keys):
    """A session.yaml, or a plan: the same without `readings`."""

    robot: str
    title: str = ""
    source: str = ""
    gauge: GaugeKeys = None  # type: ignore[assignment] # absent; what is given has keys
    """Of a session with one gauge."""
    gauges: Annotated[dict[Name, GaugeKeys], Field(min_length=1, max_length=MOST_GAUGES)] = None  # type: ignore[assignment] # likewise
    """Of a session with several; its setups name theirs."""
    postures: Annotated[dict[Name, PostureKeys], Field(min_length=1, max_length=MOST_POSTURES)]
    payload_kg: Annotated[Number, Field(ge=0.0, le=HEAVIEST_KG)] = 0.0
    """Mass on the tool during the measurement."""
    controller: ControllerKeys | None = None
    adjusted_mm: Annotated[dict[Name, Adjusted], Field(max_length=MOST_NAMES)] = {}
    """Mechanical adjustments since the machine was built, name to amount."""
    calibration: CalibrationKeys | None = None
    setups: Annotated[dict[Name, dict[str, Any]], Field(min_length=1, max_length=MOST_SETUPS)]
    """What each may say is the sensor's own affair; see `orthocal.sensors.registry`."""
    cycles: Annotated[int, Field(ge=1, le=1000)] = 1
    """In a plan: how often the postures are gone through."""
    readings: str | None = None
    seed: Count | None = None
    """Seed of simulated readings."""

    @property
    def named_gauges(self) -> dict[str, GaugeKeys]:
        """Gauges by name; that of a session with one may have the name ""."""
        return self.gauges or {"": self.gauge or GaugeKeys()}

    @model_validator(mode="after")
    def _one_form_of_gauges(self) -> SessionKeys:
        if self.gauge is not None and self.gauges is not None:
            raise ValueError("found gauge and gauges; expected one of them")
        return self
