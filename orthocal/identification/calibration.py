"""The result of a calibration, in memory and as calibration.json.

It holds all that a report, a scene or an export needs: none of them asks for the session again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.documents import write_text
from orthocal.errors import CalibrationFileError, ParameterError, RobotError
from orthocal.identification.uncertainty import NoiseSource, confidence_factor
from orthocal.robot.assembly import Assembly
from orthocal.robot.loading import load_robot, packaged_robots
from orthocal.robot.model import Robot
from orthocal.robot.parameters import InUnit, Unit

Array = NDArray[np.float64]

SCHEMA = "orthocal/calibration/1"


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


@dataclass(frozen=True, slots=True, eq=False)
class SessionRecord:
    """The session that it was calibrated from."""

    path: str | None
    title: str
    source: str
    sha256: str
    gauge_sigma: float | None
    """[m]."""
    gauge_resolution: float | None
    """[m]."""
    controller_offsets: tuple[float, ...] | None
    """Offsets active in the controller, [m, rad]; None where not stated."""


@dataclass(frozen=True, slots=True, eq=False)
class SolverRecord:
    """How the exact solution was found."""

    name: str
    status: str
    iterations: int
    seconds: float
    """Building and solving."""
    hessian: str


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

    @property
    def deviation(self) -> float:
        """Measured less nominal, [m]: the residual before calibration."""
        return self.measured - self.nominal

    @property
    def residual(self) -> float:
        """Measured less predicted, [m]: the residual after calibration."""
        return self.measured - self.predicted

    @property
    def label(self) -> str:
        """Setup and postures in words."""
        return f"{self.setup} {self.posture}" + (f" − {self.minus}" if self.minus else "")


@dataclass(frozen=True, slots=True, eq=False)
class PostureRecord:
    """A posture of the session."""

    name: str
    drives: tuple[float, ...]
    """Commanded drive coordinates, controller offsets taken off, [m, rad]."""
    passive: tuple[float, ...]
    """Passive coordinates of the calibrated machine, [m, rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class SetupRecord:
    """A setup of the session."""

    name: str
    leg: str
    direction: str
    section_form: str
    section_value: float
    """[m], or 1 for a fraction."""
    zero: float | None
    """Estimated zero of the gauge, [m]; None where only differences were given."""


@dataclass(frozen=True, slots=True, eq=False)
class ControllerEntry:
    """What to enter into the controller for one drive."""

    drive: str
    unit: Unit
    active: float | None
    """Offset now in the controller, [unit]; None where the session does not say."""
    enter: float
    """Offset to enter, [unit]; what to add to the present one where that is not known."""
    change: float
    """enter − active, [unit]."""
    std: float
    """[unit]."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Identified error parameters of a robot, with their uncertainty and provenance."""

    robot_record: RobotRecord
    session: SessionRecord
    model: str
    prior: bool
    """Whether tolerances acted as a prior."""
    solver: SolverRecord
    parameters: tuple[ParameterEstimate, ...]
    """Free parameters, then those held at a known value."""
    covariance: Array
    """Of the free parameters, shape (n_free, n_free), [SI]."""
    noise: NoiseRecord
    sigma: float
    """Standard deviation of one row of the readings, [m]: of a difference where all are."""
    dof: float
    """Degrees of freedom of sigma."""
    rows_are_differences: bool
    residuals: tuple[ResidualRow, ...]
    postures: tuple[PostureRecord, ...]
    setups: tuple[SetupRecord, ...]
    version: str
    """Of orthocal."""
    path: Path | None = None
    """Where it was loaded from."""
    _robot: list[Robot] = field(default_factory=list)

    def __getitem__(self, name: str) -> ParameterEstimate:
        for p in self.parameters:
            if p.name == name:
                return p
        raise KeyError(name)

    @property
    def free(self) -> tuple[ParameterEstimate, ...]:
        """Free parameters, in the order of the covariance."""
        return tuple(p for p in self.parameters if p.free)

    @property
    def errors(self) -> dict[str, float]:
        """Parameter name to exact estimate, [SI]."""
        return {p.name: p.value for p in self.parameters}

    @property
    def rms_before(self) -> float:
        """Root mean square of the deviations, [m]."""
        return _rms([r.deviation for r in self.residuals])

    @property
    def rms_after(self) -> float:
        """Root mean square of the residuals, [m]."""
        return _rms([r.residual for r in self.residuals])

    @property
    def largest_before(self) -> float:
        """Largest absolute deviation, [m]."""
        return max(abs(r.deviation) for r in self.residuals)

    @property
    def largest_after(self) -> float:
        """Largest absolute residual, [m]."""
        return max(abs(r.residual) for r in self.residuals)

    @property
    def row_factor(self) -> float:
        """Standard deviation of a row over that of one reading: √2 if all rows are differences."""
        return math.sqrt(2.0) if self.rows_are_differences else 1.0

    @property
    def confidence_factor(self) -> float:
        """Standard deviations on either side of an estimate in its 95 % interval."""
        return confidence_factor(self.dof)

    @property
    def robot(self) -> Robot:
        """The nominal robot.

        Raises:
            RobotError: If it cannot be found or loaded.
            CalibrationFileError: If its files are not those that were calibrated.
        """
        if not self._robot:
            self._robot.append(self._load_robot())
        return self._robot[0]

    def controller_entries(self) -> tuple[ControllerEntry, ...]:
        """What to enter into the controller; empty where no offset was identified."""
        active = self.session.controller_offsets
        entries = []
        for i, drive in enumerate(self.robot.drives):
            estimate = next((p for p in self.parameters if p.name == f"{drive.name}.offset"), None)
            if estimate is None:
                continue
            now = None if active is None else active[i]
            change = estimate.value - (now or 0.0)
            entries.append(
                ControllerEntry(drive.name, drive.unit, now, estimate.value, change, estimate.std)
            )
        return tuple(entries)

    def forward(self, joints: ArrayLike, *, names: Sequence[str] | None = None) -> Array:
        """Tool centre point of the calibrated machine.

        Args:
            joints: Drive coordinates as the encoders give them, without any offset of the
                controller, shape (K, n_drives) or (n_drives,), [m, rad].
            names: What to call the rows in messages.

        Returns:
            Shape (K, 3) or (3,), [m].

        Raises:
            ClosureError: If the machine cannot be at such coordinates.
        """
        return Assembly(self.robot, fixed=self.errors).forward(joints, names=names)

    def inverse(self, points: ArrayLike, *, names: Sequence[str] | None = None) -> Array:
        """Drive coordinates that bring the calibrated machine's tool to given points.

        Args:
            points: Shape (K, n_drives) or (n_drives,), [m].
            names: What to call the rows in messages.

        Returns:
            Drive coordinates as the encoders give them, shape (K, n_drives) or (n_drives,).

        Raises:
            ClosureError: If a point cannot be reached.
        """
        return Assembly(self.robot, fixed=self.errors).inverse(points, names=names)

    def to_document(self) -> dict[str, Any]:
        """As plain data: the content of calibration.json."""
        return {
            "schema": SCHEMA,
            "orthocal": self.version,
            "robot": _plain(self.robot_record),
            "session": _plain(self.session),
            "model": self.model,
            "prior": self.prior,
            "solver": _plain(self.solver),
            "parameters": [_plain(p) for p in self.parameters],
            "covariance": [[_number(v) for v in row] for row in self.covariance.tolist()],
            "sigma": _number(self.sigma),
            "dof": _number(self.dof),
            "noise": _plain(self.noise),
            "rows_are_differences": self.rows_are_differences,
            "rms_before": self.rms_before,
            "rms_after": self.rms_after,
            "largest_before": self.largest_before,
            "largest_after": self.largest_after,
            "residuals": [{**_plain(r), "residual": r.residual} for r in self.residuals],
            "postures": [_plain(p) for p in self.postures],
            "setups": [_plain(s) for s in self.setups],
        }

    def to_json(self) -> str:
        """As the text of calibration.json."""
        return json.dumps(self.to_document(), indent=1, allow_nan=False) + "\n"

    def save(self, path: str | Path) -> Path:
        """Write calibration.json.

        Raises:
            OrthocalError: If it cannot be written.
        """
        write_text(Path(path), self.to_json())
        return Path(path)

    def _load_robot(self) -> Robot:
        record = self.robot_record
        where = None if self.path is None else str(self.path)
        if record.folder is None:
            if record.name not in packaged_robots():
                raise CalibrationFileError(
                    f"names the robot '{record.name}', which does not come with this orthocal",
                    where=where,
                )
            robot = load_robot(record.name)
        else:
            folder = Path(record.folder)
            if not folder.is_dir() and self.path is not None:
                folder = self.path.parent / record.reference
            try:
                robot = load_robot(folder)
            except RobotError as e:
                if e.where is not None:
                    raise
                raise CalibrationFileError(
                    f"'{record.reference}' is neither a robot of orthocal "
                    f"({', '.join(packaged_robots())}) nor a folder ({folder})",
                    where=None if where is None else f"{where}: robot",
                ) from None
        if robot.sha256 != record.sha256:
            raise CalibrationFileError(
                f"was made for another version of robot '{record.name}': the files in "
                f"{robot.folder} have changed since",
                where=where,
            )
        self._check_against(robot)
        return robot

    def _check_against(self, robot: Robot) -> None:
        """Refuse names and numbers that do not fit the robot: a file can be edited."""
        prefix = "" if self.path is None else f"{self.path}: "
        if self.model not in robot.parameters.models:
            raise CalibrationFileError(
                f"'{self.model}' is not a model of this robot; "
                f"models: {', '.join(robot.parameters.models)}",
                where=f"{prefix}model",
            )
        for i, p in enumerate(self.parameters):
            where = f"{prefix}parameters[{i}]"
            try:
                known = robot.parameters[p.name]
            except ParameterError as e:
                raise CalibrationFileError(e.problem, where=f"{where}.name") from None
            if p.unit != known.unit:
                raise CalibrationFileError(
                    f"found '{p.unit}'; {p.name} is in {known.unit}", where=f"{where}.unit"
                )
        offsets = self.session.controller_offsets
        if offsets is not None and len(offsets) != len(robot.drives):
            raise CalibrationFileError(
                f"has {len(offsets)} numbers; expected {len(robot.drives)}, one a drive: "
                f"{', '.join(d.name for d in robot.drives)}",
                where=f"{prefix}session.controller_offsets",
            )


def _rms(values: list[float]) -> float:
    return math.sqrt(sum(v * v for v in values) / len(values))


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _plain(record: Any) -> dict[str, Any]:  # noqa: ANN401 - any of the records above
    result = {}
    for name in record.__slots__:
        value = getattr(record, name)
        if isinstance(value, float):
            value = _number(value)
        elif isinstance(value, tuple):
            value = list(value)
        result[name] = value
    return result
