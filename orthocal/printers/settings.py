"""Settings of a delta printer's firmware, and its closed-form kinematics.

The firmware's model has three vertical towers at (radius cos φᵢ, radius sin φᵢ) and rods of length
Lᵢ. The coordinate of a carriage is the height of its hinges above the hinges of the platform with
the nozzle at height 0:

    hᵢ = √(Lᵢ² − (x − xᵢ)² − (y − yᵢ)²) + z + x τx + y τy

Only RepRapFirmware has the tilts τ. A homed carriage has the coordinate `homed`, which determines
the heights and trims of the endstops. Sources: klippy/kinematics/delta.py of Klipper,
Marlin/src/module/delta.cpp of Marlin, LinearDeltaKinematics.cpp of RepRapFirmware.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from orthocal.arrays import Array, triple
from orthocal.errors import SessionError
from orthocal.io.documents import Number
from orthocal.io.fields import FileRecord
from orthocal.units import DEG, MM

FirmwareName = Literal["klipper", "marlin", "marlin1", "reprapfirmware"]
"""Name of a firmware; marlin1 is Marlin 1.1, which has one length for all rods."""

Positive: TypeAlias = Annotated[Number, Field(gt=0.0)]
Three: TypeAlias = tuple[Number, Number, Number]

DESIGN_ANGLES = (210 * DEG, 330 * DEG, 90 * DEG)
"""Nominal directions of the towers a, b and c, [rad]."""

EQUAL = 1e-9
"""Largest difference of equal settings, [m, rad]."""

MAX_TOWER_ANGLE = 10 * DEG
"""Largest deviation of a tower from its nominal direction, [rad]."""

MAX_ROD_DIFFERENCE = 0.05
"""Largest difference of a rod from the mean, relative to the mean. Rods are made in one batch, but
a fit without priors may yield rods that differ by a factor of two."""

RODS_PER_RADIUS = (1.2, 5.0)
"""Smallest and largest ratio of rod and radius."""


@dataclass(frozen=True, slots=True)
class DeltaSettings(FileRecord):
    """Settings of a firmware."""

    firmware: FirmwareName
    radius: Positive
    """Horizontal distance between the hinges of carriage and platform at the middle, [m]."""
    rods: tuple[Positive, Positive, Positive]
    """Lengths of the rods, [m]."""
    homed: Three
    """Coordinates of the carriages at their endstops, [m]."""
    angles: Three = DESIGN_ANGLES
    """Directions of the towers, [rad]."""
    tilts: tuple[Number, Number] = (0.0, 0.0)
    """Tilts of the bed about y and x, [1]; RepRapFirmware only."""
    probe: Three = (0.0, 0.0, 0.0)
    """Position of the probe's tip at the trigger relative to the nozzle, [m]."""
    shift: Three = (0.0, 0.0, 0.0)
    """Coordinates of the carriages less those of the firmware, [m]; not 0 if they refer to the
    coordinates of earlier settings."""

    @property
    def towers(self) -> Array:
        """Positions of the towers, shape (3, 2), [m]."""
        angles = np.array(self.angles)
        return self.radius * np.column_stack([np.cos(angles), np.sin(angles)])

    @property
    def middle(self) -> Array:
        """Coordinates of the carriages with the nozzle at 0, shape (3,), [m]."""
        return np.sqrt(np.array(self.rods) ** 2 - self.radius**2) + self.shift

    @property
    def corrects_towers(self) -> bool:
        """True if rods, endstops or angles between the towers differ, unlike those of a design."""
        turned = np.subtract(self.angles, DESIGN_ANGLES)
        return any(float(np.ptp(v)) > EQUAL for v in (self.rods, turned, self.endstops))

    @property
    def endstops(self) -> Array:
        """Heights of the nozzle at the endstops (Klipper: position_endstop), shape (3,), [m]."""
        return np.array(self.homed) - self.middle

    def equals(self, other: DeltaSettings | None) -> bool:
        """True for the same firmware and numbers, but for their rounding."""
        if other is None or self.firmware != other.firmware:
            return False
        ours, theirs = (
            np.array([s.radius, *s.rods, *s.homed, *s.angles, *s.tilts, *s.probe, *s.shift])
            for s in (self, other)
        )
        return float(np.abs(ours - theirs).max()) <= EQUAL

    def moved(self, change: Array) -> DeltaSettings:
        """Same settings with coordinates of the carriages that differ by `change`, (3,), [m]."""
        homed, shift = triple(change + self.homed), triple(change + self.shift)
        return replace(self, homed=homed, shift=shift)

    def inverse(self, points: ArrayLike) -> Array:
        """Coordinates of the carriages at nozzle positions (K, 3), shape (K, 3), [m].

        Raises:
            SessionError: If the rods are too short for a position.
        """
        p = np.atleast_2d(np.asarray(points, dtype=np.float64))
        distance = p[:, None, :2] - self.towers
        squared = np.array(self.rods) ** 2 - np.sum(distance**2, axis=2)
        if (squared <= 0.0).any():
            x, y, z = p[int(np.argmax((squared <= 0.0).any(axis=1)))] / MM
            raise SessionError(
                f"the firmware's rods do not reach x {x:g}, y {y:g}, z {z:g} mm; expected a "
                "position within the radius of the printer"
            )
        height = p[:, 2] + p[:, :2] @ np.array(self.tilts)
        return np.asarray(np.sqrt(squared) + height[:, None] + self.shift)

    def forward(self, carriages: ArrayLike) -> Array:
        """Nozzle positions at coordinates of the carriages (K, 3), shape (K, 3), [m].

        Differences of the three spheres |p − cᵢ|² = Lᵢ² are linear and give x and y as functions of
        z. The first sphere is then a quadratic equation whose lower root is below the carriages.
        """
        h = np.atleast_2d(np.asarray(carriages, dtype=np.float64)) - self.shift
        t, rods = self.towers, np.array(self.rods)
        power = np.sum(t**2, axis=1) + h**2 - rods**2
        inverse = np.linalg.inv(2.0 * (t[1:] - t[0]))
        base = (power[:, 1:] - power[:, :1]) @ inverse.T
        slope = -2.0 * (h[:, 1:] - h[:, :1]) @ inverse.T
        start = base - t[0]
        a = 1.0 + np.sum(slope**2, axis=1)
        b = np.sum(start * slope, axis=1) - h[:, 0]
        c = np.sum(start**2, axis=1) + h[:, 0] ** 2 - rods[0] ** 2
        z = (-b - np.sqrt(b**2 - a * c)) / a
        xy = base + slope * z[:, None]
        return np.column_stack([xy, z - xy @ np.array(self.tilts)])

    def touched(self, carriages: ArrayLike) -> Array:
        """Positions of the probe's tip at coordinates of the carriages (K, 3), (K, 3), [m]."""
        return np.asarray(self.forward(carriages) + self.probe)

    def require_plausible(self) -> None:
        """Refuse implausible settings, such as the result of a failed fit.

        Raises:
            SessionError: If a setting is implausible; names it.
        """
        if problem := self.find_problem():
            raise SessionError(problem)

    def find_problem(self) -> str:
        """First implausible setting, and what is expected; empty if all are plausible."""
        mean = float(np.mean(self.rods))
        for rod, tower in zip(self.rods, "abc", strict=True):
            if abs(rod - mean) > MAX_ROD_DIFFERENCE * mean:
                others = ", ".join(f"{v / MM:g}" for v in self.rods)
                return (
                    f"the rods of tower {tower} are {rod / MM:g} mm (a, b, c: {others}); expected "
                    f"measured lengths, at most {100 * MAX_ROD_DIFFERENCE:g} % from their mean"
                )
        low, high = (self.radius * ratio for ratio in RODS_PER_RADIUS)
        if not low <= mean <= high:
            return (
                f"rods of {mean / MM:g} mm with a radius of {self.radius / MM:g} mm; expected "
                f"{low / MM:g} to {high / MM:g} mm"
            )
        for angle, design, tower in zip(self.angles, DESIGN_ANGLES, "abc", strict=True):
            if abs(angle - design) > MAX_TOWER_ANGLE:
                return (
                    f"tower {tower} is at {angle / DEG:g}°; expected {design / DEG:g}° within "
                    f"{MAX_TOWER_ANGLE / DEG:g}°"
                )
        return ""
