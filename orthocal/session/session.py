"""A measuring session: postures, gauge setups and readings, in SI units.

A reading is what the indicator shows in a posture, or the difference of two postures, in which the
indicator's unknown zero drops out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from orthocal.arguments import require_array
from orthocal.arrays import Array
from orthocal.effects.compensation import Compensation
from orthocal.effects.loading import with_effects
from orthocal.io.documents import Number
from orthocal.io.fields import CLOSED, read_only
from orthocal.io.html import paragraph, table
from orthocal.printers.settings import DeltaSettings
from orthocal.robot.model import Robot
from orthocal.sensors.protocol import GaugeZero, Sensor, is_difference
from orthocal.units import MM

ALIKE = 9
"""Decimals to which distances of postures from the mechanical zero are compared, [m, rad]."""


PostureForm = Literal["tcp", "joints"]
"""What commands a posture: coordinates of the tool centre point or of the drives."""


@dataclass(frozen=True, slots=True)
class Purpose:
    """Default model and free errors of `calibrate`."""

    __pydantic_config__ = CLOSED

    model: str | None = None
    """A model of the robot's YAML."""
    free: tuple[str, ...] = ()
    """Names or globs that are free too, or instead of a model; '!' takes out."""


@dataclass(frozen=True, slots=True, eq=False)
class Gauge:
    """The indicator.

    Args:
        sigma: Standard deviation of one reading, [m].
        resolution: Step of the display, [m].
        range: Lowest and highest reading, [m].
    """

    sigma: float | None = None
    resolution: float | None = None
    range: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Posture:
    """A commanded machine position.

    Args:
        name: Name in the session.
        form: Meaning of `values`: `tcp` or `joints`.
        values: Commanded coordinates, of the tool centre point [m] or of the drives [m, rad].
        drives: Commanded drive coordinates ρ minus the active offsets, [m, rad].

    Raises:
        ValueError: If the form is unknown.
    """

    name: str
    form: PostureForm
    values: Array
    drives: Array

    def __post_init__(self) -> None:
        if self.form not in get_args(PostureForm):
            raise ValueError(f"form: found {self.form!r}; expected 'tcp' or 'joints'")


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """A sensor mounted at one place, with one gauge zero.

    Args:
        name: Name in the session.
        sensor: Sensor, with the part of the machine that it measures.
        gauge: Name of what shows its readings, among the session's gauges.
        active: Offsets active in the controller during this setup, shape (n_drives,), [m, rad]; by
            default those of the session.
        aligned_at: Posture in which the operator aligned the gauge; None for the rule of
            `Session.alignment_postures`.
        zero: Gauge zero: estimated from the setup's readings, or known to be 0 (absolute readings).
        payload: Mass on the tool while the setup was read, [kg].
        adjusted: Mechanical adjustments during this setup, name to amount, [m]; by default those of
            the session.
        compensation: What the controller compensated in the drives during this setup; by default
            that of the session.
    """

    name: str
    sensor: Sensor
    gauge: str = ""
    active: Array | None = None
    aligned_at: str | None = None
    zero: GaugeZero = "free"
    payload: float = 0.0
    adjusted: Mapping[str, float] | None = None
    compensation: Compensation | None = None


CycleNumber = Annotated[int, Field(ge=1, lt=10**9)]


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions under which a reading was taken, as stated.

    Args:
        approach: A letter for each drive in the robot's order: p if its coordinate grew in its last
            motion, n if it fell, u if unknown.
        temperature: Temperature of the machine, [°C].
        time: Time of the reading, with or without time zone.
    """

    __pydantic_config__ = CLOSED

    approach: Annotated[str, Field(pattern="^[pnu]+$")] | None = None
    temperature: Annotated[Number | None, Field(alias="temperature_C")] = None
    time: datetime | None = None


ReadingKey = (
    tuple[str, str, str | None, CycleNumber] | tuple[str, str, str | None, CycleNumber, str]
)
"""Setup, posture, posture whose reading is taken off, cycle, and the approach where one is
known."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """Reading of the indicator in a posture, or its difference between two.

    Args:
        setup: Name of the setup.
        posture: Name of the posture.
        minus: Posture whose reading is subtracted; None for a reading as shown.
        cycle: Number of the repetition.
        value: Value, [m]; NaN in a recording before it is read.
        line: Line in the CSV, for messages.
        file: The CSV; that of the session where not given.
        conditions: Conditions of a reading as shown; None for a difference, or where nothing is
            stated.
    """

    setup: str
    posture: str
    minus: str | None = None
    cycle: int = 1
    value: float = 0.0
    line: int | None = None
    file: Path | None = None
    conditions: Conditions | None = None

    @property
    def approach(self) -> str | None:
        """Directions of the drives' last motions; None if all are unknown."""
        return known_approach(self.conditions)

    @property
    def place(self) -> tuple[str, str, str | None, str | None]:
        """Setup, postures and approach: readings with the same place repeat each other."""
        return self.setup, self.posture, self.minus, self.approach

    @property
    def key(self) -> ReadingKey:
        """Setup, postures, cycle and known approach, which identify the reading in its session."""
        place = self.setup, self.posture, self.minus, self.cycle
        return place if self.approach is None else (*place, self.approach)

    @property
    def postures(self) -> str:
        """Posture with its approach, or one less another, in words."""
        return describe_postures(self.posture, self.minus, self.approach)

    @property
    def label(self) -> str:
        """Setup and postures in words."""
        return f"{self.setup} {self.postures}"

    @property
    def label_with_cycle(self) -> str:
        """Setup and postures in words, and the cycle from the second on."""
        return self.label + (f", cycle {self.cycle}" if self.cycle > 1 else "")

    @property
    def is_read(self) -> bool:
        """True if there is a value."""
        return not math.isnan(self.value)


def known_approach(conditions: Conditions | None) -> str | None:
    """Directions of the drives' last motions; None if all are unknown."""
    approach = None if conditions is None else conditions.approach
    return approach if approach is not None and approach.strip("u") else None


def describe_postures(posture: str, minus: str | None, approach: str | None) -> str:
    """Postures of a reading in words, with the approach where one is known."""
    if minus:
        return f"{posture} − {minus}"
    return posture if approach is None else f"{posture} (approach {approach})"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Session:
    """A session of gauge readings on a robot."""

    robot: Robot
    robot_reference: str
    """As the file names it."""
    title: str = ""
    source: str = ""
    gauges: Mapping[str, Gauge]
    """Name to gauge; an only one may have the name ""."""
    postures: Mapping[str, Posture]
    setups: Mapping[str, Setup]
    readings: tuple[Reading, ...]
    controller_offsets: Array | None = None
    """Offsets active in the controller, shape (n_drives,), [m, rad]; None where not stated."""
    compensation: Compensation = ()
    """Backlash and errors of screws that the controller compensates; empty for none."""
    firmware: DeltaSettings | None = None
    """Settings of the firmware of a delta printer, in whose coordinates the postures are."""
    adjusted: Mapping[str, float] = field(default_factory=dict)
    """Mechanical adjustments since the machine was built, name to amount, [m]; 0 where absent. The
    errors of the machine are those under these adjustments."""
    path: Path | None = None
    """The session.yaml, or None for a session that is not from a file."""
    readings_path: Path | None = None
    sha256: str = ""
    parts: tuple[Session, ...] = ()
    """The sessions that were joined into this one, where they are at hand."""
    joined: bool = False
    """Whether several were, so that names begin with that of their session and a slash."""
    purpose: Purpose | None = None
    """Model and free errors that the session states."""
    seed: int | None = None
    """Seed of simulated readings; None for measured readings."""

    @property
    def gauge(self) -> Gauge:
        """The gauge; of several the first, by which the others' noise is measured."""
        return next(iter(self.gauges.values()))

    def with_gauge(self, gauge: Gauge) -> Session:
        """Session with one gauge in place of all gauges."""
        setups = {name: replace(s, gauge="") for name, s in self.setups.items()}
        return replace(self, gauges={"": gauge}, setups=setups)

    @property
    def active_offsets(self) -> Array:
        """Offsets active in the controller, 0 where not stated, shape (n_drives,), [m, rad]."""
        if self.controller_offsets is None:
            return np.zeros(len(self.robot.drives))
        return self.controller_offsets

    @property
    def zero_drives(self) -> Array:
        """Commanded drive coordinates of the mechanical zero with the active offsets of each setup.

        Shape (n_setups, n_drives), [m, rad].
        """
        stated = [s.active for s in self.setups.values()]
        active = [self.active_offsets if a is None else a for a in stated]
        return np.asarray(self.robot.drive_zero - np.array(active))

    @property
    def alignment_postures(self) -> dict[str, str]:
        """Posture in which the operator aligned the gauge, by setup.

        The one that the setup states (`aligned_at`); otherwise, of the postures that the setup
        reads, the one nearest to the mechanical zero in drive coordinates, the first in the order
        of `postures` among equals. It does not depend on the order of the readings. A setup without
        readings counts as one that reads all postures.
        """
        order = {name: i for i, name in enumerate(self.postures)}
        read: dict[str, set[int]] = {name: set() for name in self.setups}
        for r in self.readings:
            read[r.setup].update(order[p] for p in (r.posture, r.minus) if p is not None)
        names, drives = list(order), np.array([p.drives for p in self.postures.values()])
        aligned_at = {}
        for setup, zero in zip(self.setups.values(), self.zero_drives, strict=True):
            if setup.aligned_at is not None:
                aligned_at[setup.name] = setup.aligned_at
                continue
            among = np.array(sorted(read[setup.name]) or range(len(names)))
            distances = np.linalg.norm(drives[among] - zero, axis=1).round(ALIKE)
            aligned_at[setup.name] = names[among[int(distances.argmin())]]
        return aligned_at

    @property
    def values(self) -> Array:
        """All readings, shape (n_readings,), [m]."""
        return np.array([r.value for r in self.readings])

    @property
    def only_differences(self) -> bool:
        """True if every reading is a difference of two postures."""
        return all(map(self.is_difference, self.readings))

    def is_difference(self, reading: Reading) -> bool:
        """True for a difference of two postures, not for a single reading of one or of a pair."""
        return is_difference(reading.minus, self.setups[reading.setup].sensor)

    def where(self, reading: Reading) -> str:
        """File and line of a reading, for messages."""
        file = reading.file or self.readings_path
        if file is None or reading.line is None:
            return f"reading {reading.label}"
        return f"{file}:{reading.line}"

    def _repr_html_(self) -> str:
        """In a notebook: the setups and what was read in each."""
        rows = []
        for setup in self.setups.values():
            values = [r.value / MM for r in self.readings if r.setup == setup.name]
            span = (f"{min(values):+.3f}", f"{max(values):+.3f}") if values else ("", "")
            rows.append((setup.name, setup.sensor.describe(), str(len(values)), *span))
        kind = "differences" if self.only_differences else "readings"
        about = f"{len(self.readings)} {kind} in {len(self.postures)} postures"
        headers = ("setup", "what is read", kind, "least [mm]", "largest [mm]")
        return (
            paragraph(f"Session on {self.robot.name}: {self.title}")
            + (paragraph(f"Source: {self.source}") if self.source else "")
            + table(headers, rows, left=2)
            + paragraph(about)
        )

    def select(self, readings: Sequence[Reading]) -> Session:
        """Session with some of its readings, and the setups and postures they need.

        Gauges stay aligned where they were (`alignment_postures` of the whole session).
        """
        read = {r.setup for r in readings}
        aligned_at = {n: p for n, p in self.alignment_postures.items() if n in read}
        used = {p for r in readings for p in (r.posture, r.minus)} | set(aligned_at.values())
        return replace(
            self,
            readings=tuple(readings),
            setups={n: replace(self.setups[n], aligned_at=p) for n, p in aligned_at.items()},
            postures={n: p for n, p in self.postures.items() if n in used},
            sha256="",
        )

    def with_controller(self, offsets: ArrayLike) -> Session:
        """Session with other offsets active in the controller than it states.

        Args:
            offsets: Shape (n_drives,), [m, rad].
        """
        active = require_array(offsets, shape=(len(self.robot.drives),), argument="offsets")
        shift = self.active_offsets - active
        postures = {
            name: replace(p, drives=read_only(p.drives + shift))
            for name, p in self.postures.items()
        }
        return replace(self, postures=postures, controller_offsets=read_only(active), sha256="")

    def with_tolerances(self, given: Mapping[str, float]) -> Session:
        """Session of the robot with other tolerances.

        Args:
            given: Name or glob with its unit to a limit of ±2 prior standard deviations.

        Raises:
            ParameterError: If a name or unit is unknown, or a number makes no sense.
        """
        robot = self.robot.with_tolerances(given)
        return self if robot is self.robot else replace(self, robot=robot)

    def with_effects(self, names: Sequence[str] | None) -> Session:
        """Session of the robot with chosen effects beside those of geometry and drives.

        Args:
            names: Names of the effects; None for those that the robot's YAML names.

        Raises:
            ParameterError, RobotError: As `orthocal.effects.loading.with_effects`.
        """
        return replace(self, robot=with_effects(self.robot, names))

    def with_values(self, values: Sequence[float] | Array) -> Session:
        """Session with other readings.

        Args:
            values: Shape (n_readings,), [m].
        """
        new = require_array(values, shape=(len(self.readings),), argument="values")
        changed = tuple(replace(r, value=float(v)) for r, v in zip(self.readings, new, strict=True))
        return replace(self, readings=changed, sha256="")
