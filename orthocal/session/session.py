"""A measuring session: postures, gauge setups and readings, in SI units.

A reading is the value of a gauge in a posture, or the difference of the values in two postures. The
unknown gauge zero cancels in a difference.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from orthocal.arguments import require_array
from orthocal.arrays import Array, Triple
from orthocal.effects.compensation import Compensation
from orthocal.effects.loading import with_effects
from orthocal.errors import SessionError
from orthocal.io.documents import Number, describe_missing
from orthocal.io.fields import FileRecord, read_only
from orthocal.io.html import paragraph, table
from orthocal.printers.settings import DeltaSettings
from orthocal.robot.model import Robot
from orthocal.sensors.protocol import GaugeZero, Sensor, is_difference
from orthocal.units import MM

DISTANCE_DECIMALS = 9
"""Decimals in m and rad to which distances from the mechanical zero are compared."""


PostureForm = Literal["tcp", "joints"]
"""Kind of the commanded coordinates: of the tool centre point or of the drives."""


@dataclass(frozen=True, slots=True)
class Purpose(FileRecord):
    """Model and free errors that a session states for `calibrate`.

    Of joined sessions, those that state nothing follow the others.
    """

    model: str | None = None
    """Model of the robot's YAML."""
    free: tuple[str, ...] = ()
    """Names or globs of free errors in addition to a model, or without one; '!' excludes."""


@dataclass(frozen=True, slots=True, eq=False)
class Gauge:
    """Gauge: an indicator or another instrument.

    Args:
        sigma: Standard deviation of one reading, [m].
        resolution: Step of the display, [m].
        range: Lowest and highest reading, [m].

    Raises:
        ValueError: If `sigma` or `resolution` is no positive number, or the range not two numbers.
    """

    sigma: float | None = None
    resolution: float | None = None
    range: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name, value in (("sigma", self.sigma), ("resolution", self.resolution)):
            if value is not None and not 0.0 < value < math.inf:
                raise ValueError(f"{name}: found {value!r}; expected a positive number, in m")
        if self.range is not None and not (len(self.range) == 2 and self.range[0] < self.range[1]):
            raise ValueError(
                f"range: found {self.range!r}; expected the lowest and the highest reading, in m"
            )

    @property
    def middle(self) -> float:
        """Reading in the middle of the range, to which the operator sets the dial, [m]."""
        return 0.0 if self.range is None else 0.5 * sum(self.range)

    @property
    def half_range(self) -> float:
        """Range to either side of the middle, [m]; infinite if it is not stated."""
        return math.inf if self.range is None else 0.5 * (self.range[1] - self.range[0])


@dataclass(frozen=True, slots=True, eq=False)
class Posture:
    """A commanded machine position.

    Args:
        name: Name in the session.
        form: Kind of `values`: `tcp` or `joints`.
        values: Commanded coordinates of the tool centre point, shape (n_coordinates,), [m], or of
            the drives, shape (n_drives,), [m, rad].
        drives: Commanded drive coordinates minus the active offsets, shape (n_drives,), [m, rad].

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
    """Mounted sensor with one gauge zero.

    Args:
        name: Name in the session.
        sensor: Sensor, with the part of the machine that it measures.
        gauge: Name of its gauge among the gauges of the session.
        active: Active offsets during this setup, shape (n_drives,), [m, rad]; by default those of
            the session.
        aligned_at: Posture in which the operator aligned the gauge; by default the one selected by
            `Session.alignment_postures`.
        zero: Gauge zero: estimated from the setup's readings, or known to be 0 (absolute readings).
        payload: Mass on the tool during this setup, [kg].
        adjusted: Mechanical adjustments during this setup, name to amount, [m]; by default those of
            the session.
        compensation: Compensation of the controller during this setup; by default that of the
            session.
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
class Conditions(FileRecord):
    """Stated conditions of a reading.

    Args:
        approach: Letter for each drive in the robot's order: p if its coordinate increased in the
            last motion, n if it decreased, u if unknown.
        temperature: Temperature of the machine, [°C].
        time: Time of the reading, with or without time zone.
    """

    approach: Annotated[str, Field(pattern="^[pnu]+$")] | None = None
    temperature: Annotated[Number | None, Field(alias="temperature_C")] = None
    time: datetime | None = None


ReadingKey = (
    tuple[str, str, str | None, CycleNumber] | tuple[str, str, str | None, CycleNumber, str]
)
"""Setup, posture, subtracted posture, cycle, and the approach if it is known."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """Reading of a gauge in a posture, or difference of two.

    Args:
        setup: Name of the setup.
        posture: Name of the posture.
        minus: Posture whose reading is subtracted; None for a single reading.
        cycle: Number of the repetition, from 1.
        value: Value, [m]; NaN before it is read.
        line: Line in the CSV, for messages.
        file: Path to the CSV; by default that of the session.
        conditions: Conditions of a single reading; None for a difference, or if none are stated.
    """

    setup: str
    posture: str
    minus: str | None = None
    cycle: int = 1
    value: float = math.nan
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
        """Setup, postures, cycle and known approach. They identify the reading in its session."""
        place = self.setup, self.posture, self.minus, self.cycle
        return place if self.approach is None else (*place, self.approach)

    @property
    def postures(self) -> str:
        """Posture with its approach, or difference of postures, in words."""
        return describe_postures(self.posture, self.minus, self.approach)

    @property
    def label(self) -> str:
        """Setup and postures in words; in joined sessions the session is named once."""
        return f"{self.setup} {self.within_session(self.postures)}"

    def within_session(self, postures: str) -> str:
        """Names of postures without the label of the session, which the setup has too."""
        label, slash, _ = self.setup.partition("/")
        return postures.replace(f"{label}/", "") if slash else postures

    @property
    def label_with_cycle(self) -> str:
        """Setup and postures in words, and the cycle unless it is the first."""
        return self.label + (f", cycle {self.cycle}" if self.cycle > 1 else "")

    @property
    def is_read(self) -> bool:
        """True if the reading has a value."""
        return not math.isnan(self.value)


def known_approach(conditions: Conditions | None) -> str | None:
    """Directions of the drives' last motions; None if all are unknown."""
    approach = None if conditions is None else conditions.approach
    return approach if approach is not None and approach.strip("u") else None


def describe_postures(posture: str, minus: str | None, approach: str | None) -> str:
    """Postures of a reading in words, with the approach if it is known."""
    if minus:
        return f"{posture} − {minus}"
    return posture if approach is None else f"{posture} (approach {approach})"


def split_label(name: str, *, joined: bool) -> tuple[str, str]:
    """Label of the session of a name, and the name within that session.

    Args:
        name: Name of a setup, a posture, a gauge or an artefact. In joined sessions it begins with
            the label of its session and a slash; an unnamed gauge is the label alone.
        joined: Whether the name is of joined sessions; otherwise the label is "".
    """
    if not joined:
        return "", name
    label, _, within = name.partition("/")
    return label, within


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Session:
    """Session: postures, setups and readings of one robot."""

    robot: Robot
    robot_reference: str
    """Name or path of the robot in the session file."""
    title: str = ""
    source: str = ""
    gauges: Mapping[str, Gauge]
    """Name to gauge; a single gauge may have the name ""."""
    postures: Mapping[str, Posture]
    setups: Mapping[str, Setup]
    readings: tuple[Reading, ...]
    controller_offsets: Array | None = None
    """Active offsets, shape (n_drives,), [m, rad]; None if not stated."""
    compensation: Compensation = ()
    """Compensation of backlash and errors of screws by the controller, and home positions of its
    joints; empty if not stated."""
    controller_origin: Triple = (0.0, 0.0, 0.0)
    """Machine coordinates (G53) of the world's origin, [m]."""
    offsets_from: Path | None = None
    """Path to the calibration whose offsets were entered; None if not stated."""
    firmware: DeltaSettings | None = None
    """Settings of the firmware of a delta printer; postures are in its coordinates."""
    adjusted: Mapping[str, float] = field(default_factory=dict)
    """Mechanical adjustments since the machine was built, name to amount, [m]; absent ones are 0.
    Readings are taken with these adjustments."""
    path: Path | None = None
    """Path to the session.yaml; None for a session that is not from a file."""
    readings_path: Path | None = None
    sha256: str = ""
    parts: tuple[Session, ...] = ()
    """Sessions that were joined into this one, if they are available."""
    joined: bool = False
    """True if sessions were joined. Names then begin with the label of their session and a slash:
    `split_label`."""
    purpose: Purpose | None = None
    """Model and free errors that the session states."""
    seed: int | None = None
    """Seed of simulated readings; None for measured readings."""

    def __repr__(self) -> str:
        counts = f"{len(self.readings)} readings in {len(self.setups)} setups"
        return f"<Session of {self.robot.name}: {counts}>"

    @property
    def labels(self) -> tuple[str, ...]:
        """Label of the session of each setup, shape (n_setups,); "" unless sessions were joined."""
        return tuple(split_label(name, joined=self.joined)[0] for name in self.setups)

    def was_read_from(self, digest: str) -> bool:
        """True if the session was read from the files of a digest; "" is the digest of none."""
        return bool(digest) and self.sha256 == digest

    @property
    def gauges_with_readings(self) -> dict[str, Gauge]:
        """Name to gauge, of the gauges with readings."""
        used = {self.setups[r.setup].gauge for r in self.readings}
        return {name: gauge for name, gauge in self.gauges.items() if name in used}

    @property
    def gauge(self) -> Gauge:
        """The first gauge with readings. The noise of other gauges is stated relative to it."""
        return next(iter((self.gauges_with_readings or self.gauges).values()))

    def distinguish_gauge(self, gauge: str) -> str:
        """Name of a gauge; empty if the readings of the session have no other."""
        return gauge if len(self.gauges_with_readings) > 1 else ""

    def path_of(self, label: str) -> Path | None:
        """Path to the session.yaml of a joined session by its label; None if unknown."""
        names = list(dict.fromkeys(self.labels))
        if len(self.parts) != len(names) or label not in names:
            return None
        return self.parts[names.index(label)].path

    def locate_gauge_key(self, gauge: str, key: str) -> str:
        """File and key of a gauge, for messages."""
        label, name = split_label(gauge, joined=self.joined)
        file = self.path_of(label) if self.joined else self.path
        path = f"gauges.{name}.{key}" if name else f"gauge.{key}"
        return path if file is None else f"{file}: {path}"

    def refuse_missing(self, gauges: Iterable[str], key: str, reason: str) -> None:
        """Refuse gauges that do not state a key.

        Args:
            gauges: Names of the gauges without the key.
            key: The key.
            reason: End of the message, from its punctuation mark.

        Raises:
            SessionError: If there are such gauges; names all of them.
        """
        missing = [self.locate_gauge_key(gauge, key) for gauge in gauges]
        if missing:
            file, mark, _ = missing[0].rpartition(": ")
            others = [name.removeprefix(file + mark) for name in missing[1:]]
            raise SessionError(f"{describe_missing(others)}{reason}", where=missing[0])

    def with_gauge(self, gauge: Gauge) -> Session:
        """Session with one gauge for all setups."""
        setups = {name: replace(s, gauge="") for name, s in self.setups.items()}
        return replace(self, gauges={"": gauge}, setups=setups)

    @property
    def active_offsets(self) -> Array:
        """Active offsets, shape (n_drives,), [m, rad]; 0 if not stated."""
        if self.controller_offsets is None:
            return np.zeros(len(self.robot.drives))
        return self.controller_offsets

    @property
    def zero_drives(self) -> Array:
        """Commanded drive coordinates of the mechanical zero with the active offsets of each setup.

        Shape (n_setups, n_drives), [m, rad].
        """
        active = [self.active_during(name) for name in self.setups]
        return np.asarray(self.robot.drive_zero - np.array(active))

    def active_during(self, setup: str) -> Array:
        """Active offsets during the readings of a setup, shape (n_drives,), [m, rad]."""
        stated = self.setups[setup].active
        return self.active_offsets if stated is None else stated

    @property
    def alignment_postures(self) -> dict[str, str]:
        """Setup to the posture in which the operator aligned its gauge.

        It is the posture that the setup states (`aligned_at`). Otherwise it is the posture read by
        the setup that is nearest to the mechanical zero in drive coordinates. Of equally near ones
        it is the first in the order of `postures`, so that the order of readings does not matter. A
        setup without readings is treated as one that reads all postures.
        """
        index = {name: i for i, name in enumerate(self.postures)}
        postures_read: dict[str, set[int]] = {name: set() for name in self.setups}
        for r in self.readings:
            postures_read[r.setup].update(index[p] for p in (r.posture, r.minus) if p is not None)
        names, drives = list(index), np.array([p.drives for p in self.postures.values()])
        aligned_at = {}
        for setup, zero in zip(self.setups.values(), self.zero_drives, strict=True):
            if setup.aligned_at is not None:
                aligned_at[setup.name] = setup.aligned_at
                continue
            candidates = np.array(sorted(postures_read[setup.name]) or range(len(names)))
            distances = np.linalg.norm(drives[candidates] - zero, axis=1).round(DISTANCE_DECIMALS)
            aligned_at[setup.name] = names[candidates[int(distances.argmin())]]
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
        """True for a difference of two readings, not for one reading of a posture or a pair."""
        return is_difference(reading.minus, self.setups[reading.setup].sensor)

    def where(self, reading: Reading) -> str:
        """File and line of a reading, for messages."""
        file = reading.file or self.readings_path
        if file is None or reading.line is None:
            return f"reading {reading.label}"
        return f"{file}:{reading.line}"

    def _repr_html_(self) -> str:
        """Table of the setups and their readings for a notebook."""
        rows = []
        for setup in self.setups.values():
            readings = [r for r in self.readings if r.setup == setup.name]
            values = [r.value / MM for r in readings if r.is_read]
            extremes = (f"{min(values):+.3f}", f"{max(values):+.3f}") if values else ("", "")
            rows.append((setup.name, setup.sensor.describe(), str(len(readings)), *extremes))
        kind = "differences" if self.only_differences else "readings"
        summary = f"{len(self.readings)} {kind} in {len(self.postures)} postures"
        headers = ("setup", "sensor", kind, "smallest [mm]", "largest [mm]")
        return (
            paragraph(f"Session on {self.robot.name}: {self.title}")
            + (paragraph(f"Source: {self.source}") if self.source else "")
            + table(headers, rows, left=2)
            + paragraph(summary)
        )

    def select(self, readings: Sequence[Reading]) -> Session:
        """Session with some of its readings, and the setups and postures that they need.

        Alignment postures are those of the complete session.
        """
        setups_read = {r.setup for r in readings}
        aligned_at = {n: p for n, p in self.alignment_postures.items() if n in setups_read}
        postures_used = {p for r in readings for p in (r.posture, r.minus)} | set(
            aligned_at.values()
        )
        return replace(
            self,
            readings=tuple(readings),
            setups={n: replace(self.setups[n], aligned_at=p) for n, p in aligned_at.items()},
            postures={n: p for n, p in self.postures.items() if n in postures_used},
            sha256="",
        )

    def with_controller(self, offsets: ArrayLike) -> Session:
        """Session of the same postures with other active offsets, of no stated calibration.

        Args:
            offsets: Active offsets, shape (n_drives,), [m, rad].
        """
        active = require_array(offsets, shape=(len(self.robot.drives),), argument="offsets")
        shift = self.active_offsets - active
        postures = {
            name: replace(p, drives=read_only(p.drives + shift))
            for name, p in self.postures.items()
        }
        return replace(
            self,
            postures=postures,
            controller_offsets=read_only(active),
            offsets_from=None,
            sha256="",
        )

    def on_printer(self, robot: Robot, homed: ArrayLike) -> Session:
        """Session of a printer in the coordinates of its robot before settings changed.

        A session without settings is returned unchanged.

        Settings change the nominal dimensions and the coordinates of the homed carriages, but not
        the travel of the carriages below their endstops. Stated tolerances and effects of the
        session stay.

        Args:
            robot: Robot with other nominal dimensions.
            homed: Coordinates of its homed carriages, shape (3,), [m].
        """
        if self.firmware is None:
            return self
        change = np.asarray(homed, dtype=np.float64) - self.firmware.homed
        drives = {name: read_only(p.drives + change) for name, p in self.postures.items()}
        plain = replace(robot, parameters=robot.parameters.defaults)
        here = with_effects(plain, self.robot.chosen_effects)
        return replace(
            self,
            robot=here.with_tolerances(self.robot.parameters.stated),
            firmware=self.firmware.moved(change),
            postures={name: Posture(name, "joints", d, d) for name, d in drives.items()},
        )

    def with_tolerances(self, tolerances: Mapping[str, float]) -> Session:
        """Session of the robot with other tolerances.

        Args:
            tolerances: Name or glob with unit suffix to a tolerance (±2 prior standard deviations).

        Raises:
            ParameterError: If a name or unit is unknown, or a number is out of range.
        """
        robot = self.robot.with_tolerances(tolerances)
        return self if robot is self.robot else replace(self, robot=robot)

    def with_effects(self, names: Sequence[str] | None) -> Session:
        """Session of the robot with chosen effects beside geometry and drives.

        Args:
            names: Names of the effects; None for those of the robot's YAML.

        Raises:
            ParameterError: If an effect is unknown, or a tolerance is of an effect not chosen.
            RobotError: If an effect needs keys that the robot's YAML lacks.
        """
        return replace(self, robot=with_effects(self.robot, names))

    def with_values(self, values: Sequence[float] | Array) -> Session:
        """Session with other readings.

        Args:
            values: Readings, shape (n_readings,), [m]; NaN for readings without a value.

        Raises:
            TypeError: If the values are not real numbers.
            ValueError: If their number differs, or one is infinite.
        """
        shape = (len(self.readings),)
        value_array = require_array(values, shape=shape, argument="values", missing=True)
        readings = tuple(
            replace(r, value=float(v)) for r, v in zip(self.readings, value_array, strict=True)
        )
        return replace(self, readings=readings, sha256="")
